"""What λ decides: Stage 2 from a finished run's Stage 1, with λ over many powers of ten.

    python benchmarks/lambda_range.py RESULTS… --work FOLDER [--steps 600] [--priors pca]
        [--lambdas 0.0001 0.01 1e6] [--datasets synbench] [--backbone robust_defreg]

Each RESULTS is the folder of a finished run. Every training has the run's seed and Stage 2, but
ends with its last weights, and is kept in FOLDER, so that the same command goes on where it was
stopped. λ = 0 is the control. Where λ is a million the data term is far below the rounding of the
loss: the network is trained on the prior alone. Printed as Markdown: Chamfer distance
(×1e-4) and mean correspondence error on all validation pairs, means over the runs; in brackets the
difference of the Chamfer distance to the control's, in percent, from run to run.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import torch

from dine import config as dine_config
from dine.config import CONTROL, STAGE1, Stage2
from dine.files import digest, file_digest, read_json
from dine.reporting.names import CD_SCALE, display_name
from dine.results import Network, Results
from dine.training.stage2 import stage2
from dine.training.stages import Order

LAMBDAS = (1e-4, 1e-3, 1e-2, 1e-1, 1.0, 1e6)
ALL = 10_000


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("results", nargs="+", type=Path)
    parser.add_argument("--work", type=Path, required=True)
    parser.add_argument("--steps", type=int, help="by default those of the run")
    parser.add_argument("--priors", nargs="+", default=["pca", "pca_residual"])
    parser.add_argument("--lambdas", nargs="+", type=float, default=LAMBDAS)
    parser.add_argument("--datasets", nargs="+", help="by default all of the run")
    parser.add_argument("--backbone", default="robust_defreg")
    parser.add_argument("--threads", type=int, default=1)
    return parser.parse_args()


def errors(
    folder: Path, work: Path, place: tuple[str, str], prior: str, weight: float, steps: int | None
) -> tuple[float, float]:
    """Chamfer distance and correspondence error on validation pairs after one Stage 2."""
    settings, files = dine_config.load(folder / "config.yaml"), Results(folder)
    dataset, backbone = place
    given: Stage2 = settings.stage2
    changed = {"validation_pairs": ALL, "keep": "last", "steps": steps or given.steps}
    changed["validate_every"] = changed["steps"]
    stage = given.model_copy(update=changed)
    model = files.run(dataset, backbone, STAGE1).model
    # Runs may share seed and settings, and results must not be taken for those of another run.
    told = digest([stage.model_dump(), file_digest(model), settings.seed])[:12]
    out = work / told / dataset / backbone / prior / f"{weight:g}"
    if not Network(out).record.exists():
        stage2(
            files.data(dataset).pairs,
            model,
            stage,
            Order(settings.seed, out, f"{dataset} {prior} {weight:g}"),
            variant=prior,
            prior=None if prior == CONTROL else files.prior(dataset, backbone, prior),
            weight=weight,
        )
    final = read_json(Network(out).record)["final"]
    return final["val_cd"], final["val_mce"]


def main() -> None:
    asked = arguments()
    torch.set_num_threads(asked.threads)
    datasets = asked.datasets or list(dine_config.load(asked.results[0] / "config.yaml").datasets)
    print(
        "| synthetic data | prior | λ = 0 | " + " | ".join(f"{x:g}" for x in asked.lambdas) + " |"
    )
    print("|---" * (len(asked.lambdas) + 3) + "|")
    for dataset in datasets:
        place = (dataset, asked.backbone)

        def of_runs(prior: str, weight: float, place=place) -> np.ndarray:
            return np.array(
                [errors(x, asked.work, place, prior, weight, asked.steps) for x in asked.results]
            )

        control = of_runs(CONTROL, 0.0)
        cd, mce = control.mean(axis=0)
        for prior in asked.priors:
            cells = [display_name(dataset), display_name(prior), f"{CD_SCALE * cd:.1f}; {mce:.3f}"]
            for weight in asked.lambdas:
                found = of_runs(prior, weight)
                change = 100 * (found[:, 0] / control[:, 0] - 1)
                low, high = change.min(), change.max()
                to = f"{low:+.0f}" if len(change) == 1 else f"{low:+.0f} to {high:+.0f}"
                mean = found.mean(axis=0)
                cells.append(f"{CD_SCALE * mean[0]:.1f} ({to} %); {mean[1]:.3f}")
            print("| " + " | ".join(cells).replace("-", "−") + " |", flush=True)


if __name__ == "__main__":
    main()
