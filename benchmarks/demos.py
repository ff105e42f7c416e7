"""The five demo pairs of the authors' checkpoint, with our weights; print one table.

    python benchmarks/demos.py ../shared/published/robust_defreg_modelnet10_predictions.npz

The file holds source, target, true correspondence and the authors' predicted displacement of each
pair, in their frame. Our weights have never seen these objects. Mean correspondence errors, of the
network alone and refined at test time.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import torch

from dine.models.checkpoint import load_backbone, shipped_weights
from dine.refinement.refine import ROUNDS, Options, refine
from dine.registration.correspondence import predict_and_refine


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("predictions", type=Path)
    with np.load(parser.parse_args().predictions) as file:
        stored = dict(file)
    names = sorted({key.split("/")[0] for key in stored})
    rows: dict[str, list[float]] = {}
    for name in names:
        source, target = (stored[f"{name}/{x}"].astype(float) for x in ("source", "target"))
        truth = target[stored[f"{name}/target_index_of_source"]]

        def record(method: str, field: np.ndarray, source=source, truth=truth) -> None:
            error = np.linalg.norm(source + field - truth, axis=1).mean()
            rows.setdefault(method, []).append(float(error))

        record("authors' checkpoint", stored[f"{name}/displacement"])
        for kind in ("robust_defreg", "deftransnet"):
            backbone, _ = load_backbone(shipped_weights(kind))
            for rounds, what in ((0, "network alone"), (ROUNDS, "refined")):
                field, _ = predict_and_refine(
                    backbone, source, target, torch.device("cpu"), Options(rounds)
                )
                record(f"our {kind}, {what}", field)
        record("refinement without a network", refine(source, target).mean)
    print("| |", " | ".join(names), "|")
    print("|---" * (len(names) + 1) + "|")
    for method, errors in rows.items():
        print(f"| {method} |", " | ".join(f"{error:.3f}" for error in errors), "|")


if __name__ == "__main__":
    main()
