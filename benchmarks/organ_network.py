"""What a network that was trained on one organ adds to the organ's own prior.

    snakemake -j1 all --configfile config/organ.yaml        # with the folder of one mesh set
    python benchmarks/organ_network.py results/organ organ

Test pairs are deformations of the organ that nothing was trained on; their targets are drawn anew,
as two scans share no points. The prior (``dine learn``) is of the deformations that the networks
were trained on. One row a level: mean distances of the drawn source points from their true places
in percent of the radius, of the networks alone, and of the most probable field under the prior
from its own mean and from the network's field too, with half the width of the 95 % interval over
deformations of the last one's difference.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np

from dine.config import OrganLearning
from dine.data.obtain import obtained
from dine.data.pairs import RESAMPLED, PairSet, read_pairs
from dine.evaluation.predictions import read_predictions
from dine.geometry.interpolation import FittedDisplacement
from dine.io.readers import read_surface
from dine.priors.organ import OrganPrior
from dine.priors.organ_learning import learn
from dine.registration.organ import organ_field
from dine.results import Results
from dine.simulation.fields import OrganDeformations

BACKBONE, RUNS = "robust_defreg", ("stage1", "stage2/pca")


def learned(pairs: PairSet, folder: Path) -> OrganPrior:
    """The prior of the deformations that were trained on."""
    known = pairs.select("train")
    template = read_surface(folder / str(known.source_file[0]))
    moved = [read_surface(folder / str(name)).vertices for name in known.target_file]
    fields = (np.stack(moved) - template.vertices).astype(np.float32)
    return learn(template, [OrganDeformations(template, fields)], OrganLearning())


def from_prior(
    prior: OrganPrior, pairs: PairSet, row: int, folder: Path, network: np.ndarray | None
) -> tuple[float, float]:
    """Error and CPU seconds of a pair, from the prior's mean and from a network's field (N, 3)."""
    scan = read_surface(folder / str(pairs.target_file[row]))
    frame, own, samples = pairs.frame(row), prior.frame, pairs.samples(row)
    starts = []
    if network is not None:
        found = FittedDisplacement(pairs.source[row].astype(float), network)
        scale = frame.scale / own.scale
        starts.append(lambda places: scale * found(frame.normalise(own.restore(places))))
    began = time.process_time()
    field, _ = organ_field(
        prior, scan, [np.eye(4)], loose=False, partial=False, seed=0, starts=starts
    )
    seconds = time.process_time() - began
    places = own.normalise(samples.places(prior.template.vertices))
    moved = own.restore(places + field.at(prior.on_surface(samples), places))
    return error(pairs, row, frame.normalise(moved) - pairs.source[row]), seconds


def error(pairs: PairSet, row: int, field: np.ndarray) -> float:
    return float(np.linalg.norm(field - pairs.displacement[row], axis=1).mean())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("results", type=Path)
    parser.add_argument("dataset")
    arguments = parser.parse_args()
    files = Results(arguments.results)
    data = files.data(arguments.dataset)
    folder = obtained(data.raw)[0].folder
    every = read_pairs(data.pairs)
    prior, pairs = learned(every, folder), every.select("test")
    networks = {}
    for run in RUNS:
        path = files.network(arguments.dataset, BACKBONE, run).predictions
        (found,) = (p for p in read_predictions(path) if p.condition == RESAMPLED)
        order = {name: row for row, name in enumerate(found.pair.tolist())}
        networks[run] = found.displacement[[order[name] for name in pairs.name.tolist()]]
    table = []
    for row in range(len(pairs)):
        alone = [error(pairs, row, fields[row]) for fields in networks.values()]
        mean, seconds = from_prior(prior, pairs, row, folder, None)
        both, _ = from_prior(prior, pairs, row, folder, networks[RUNS[-1]][row].astype(float))
        table.append([error(pairs, row, 0 * pairs.source[row]), *alone, mean, both, seconds])
    table = np.array(table)
    columns = ["level", "unregistered", *RUNS, "prior, from its mean", "and from the network"]
    print(f"{len(pairs)} pairs, {len(prior.modes)} components of {prior.facts['fields']} fields")
    print("| " + " | ".join([*columns, "difference", "CPU seconds"]) + " |\n" + "|---" * 8 + "|")
    for level in [*np.unique(pairs.level), None]:
        some = table if level is None else table[pairs.level == level]
        shown = [f"{100 * x:.2f}" for x in some[:, :5].mean(axis=0)]
        change = 100 * (some[:, 4] - some[:, 3])
        half = 1.96 * change.std(ddof=1) / np.sqrt(len(change))
        shown += [f"{change.mean():+.2f} ± {half:.2f}", f"{np.median(some[:, 5]):.1f}"]
        print(f"| {'all' if level is None else level} | " + " | ".join(shown) + " |")


if __name__ == "__main__":
    main()
