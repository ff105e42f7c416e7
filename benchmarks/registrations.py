"""Register known deformations of real meshes, and real deformed pairs; print one table.

    python benchmarks/registrations.py ../shared/meshes [--backbone deftransnet] [--map 0]

    python benchmarks/registrations.py ../shared/meshes --weights W --prior P --calibration C \
        --held-out results/own/own/pairs.h5 --shipped      # weights of your own beside the shipped

    python benchmarks/registrations.py ../shared/meshes --verdicts 0.05 0.1 0.2 0.4 0.8 \
        bent-60 bent-150 other mirrored parts-0.8           # does the verdict tell good from bad?

Every mesh of ``objects`` is registered to a copy that the published recipe deforms (a synthetic
deformation of a real shape); in ``pairs``, meshes of one folder with equal faces are registered to
each other. Source and target points are drawn independently. Errors are distances of moved vertices
from their true places, before, after rigid alignment alone and after registration, in percent of
the object's radius.

With ``--verdicts``, meshes are registered to copies deformed by the recipe at some levels, to
copies bent along their longest axis by some degrees, to other objects of the same size, to mirror
images of deformed copies, or as parts that each show a share, and counted: a result is bad if its
error is above 95 % of that of rigid alignment alone, or above 15 %, and where no place is right.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch
from known_pairs import (
    Pair,
    bent_copies,
    both_partial,
    deformed_copies,
    mirrored_copies,
    other_objects,
    real_pairs,
)

from dine.data.pairs import read_pairs
from dine.registration.model import load_model
from dine.registration.register import register
from dine.registration.types import Model


def verdict_pairs(objects: Path, case: str) -> Iterator[Pair]:
    kind, _, number = case.rpartition("-")
    try:
        if case == "other":
            return other_objects(objects)
        if case == "mirrored":
            return mirrored_copies(objects)
        if kind == "parts":
            return both_partial(deformed_copies(objects), float(number))
        if kind == "bent":
            return bent_copies(objects, float(number))
        return deformed_copies(objects, level=float(case))
    except ValueError:
        sys.exit(
            f"--verdicts got {case!r}; expected levels, bent-DEGREES, other, mirrored, parts-SHARE."
        )


def count_verdicts(objects: Path, cases: list[str], model: Model) -> None:
    print("| targets | good | of these plausible | bad | of these plausible |")
    print("|---|---|---|---|---|")
    for case in cases:
        counts = {(good, plausible): 0 for good in (True, False) for plausible in (True, False)}
        for name, source, target, truth in verdict_pairs(objects, case):
            result = register(source, target, model=model)
            good = False
            if truth is not None:
                aligned = result.alignment.align(source.vertices)
                errors = [
                    np.nanmean(np.linalg.norm(places - truth, axis=1))
                    / result.alignment.frame.scale
                    for places in (aligned, result.moved.vertices)
                ]
                good = bool(errors[1] <= min(0.95 * errors[0], 0.15))
            counts[good, result.trust.verdict == "plausible"] += 1
            if not good and result.trust.verdict == "plausible":
                print(f"  {case}, {name}: wrong, and called plausible", flush=True)
        found = [
            (sum(counts[good, p] for p in (True, False)), counts[good, True])
            for good in (True, False)
        ]
        print(
            f"| {case} | " + " | ".join(str(n) for pair in found for n in pair) + " |", flush=True
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("meshes", type=Path)
    parser.add_argument("--backbone")
    for file in ("weights", "prior", "calibration"):
        parser.add_argument(f"--{file}", type=Path)
    parser.add_argument("--held-out", type=Path, help="pairs file; only its objects for the tests")
    parser.add_argument("--shipped", action="store_true", help="errors of shipped weights, too")
    parser.add_argument(
        "--verdicts",
        nargs="+",
        help="count verdicts: levels, bent-DEGREES, other, mirrored, parts-SHARE",
    )
    parser.add_argument("--map", type=int, default=40, dest="rounds")
    parser.add_argument("--prealign", default="auto")
    parser.add_argument("--threads", type=int, default=2)
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    files = {file: getattr(arguments, file) for file in ("weights", "prior", "calibration")}
    model = load_model(arguments.backbone, **files)
    if arguments.verdicts:
        count_verdicts(arguments.meshes / "objects", arguments.verdicts, model)
        return
    shipped = load_model(model.backbone.registered_name) if arguments.shipped else None
    only = None
    if arguments.held_out:
        pairs = read_pairs(arguments.held_out)
        only = set(pairs.object[pairs.split == "test"].tolist())
    columns = ["error before", "aligned", "after", *["shipped"] * arguments.shipped, "expected"]
    columns = ["object", *columns, "HD95 before", "after", "CPU seconds", "verdict"]
    print("| " + " | ".join(columns) + " |\n" + "|---" * len(columns) + "|")
    for group in (
        deformed_copies(arguments.meshes / "objects", only),
        real_pairs(arguments.meshes / "pairs"),
    ):
        errors = []
        for name, source, target, truth in group:
            settings = {
                "rounds": arguments.rounds,
                "partial": "partial" in name,
                "prealign": arguments.prealign,
            }
            began = time.process_time()
            result = register(source, target, model=model, **settings)
            seconds = time.process_time() - began
            report = result.report
            unit = report["normalisation"]["scale"] / 100
            places = [source.vertices]
            places += [result.alignment.align(source.vertices)]
            places += [result.moved.vertices]
            if shipped:
                places += [register(source, target, model=shipped, **settings).moved.vertices]
            found = [np.nan] * len(places)
            if truth is not None:
                found = [np.linalg.norm(x - truth, axis=1).mean() / unit for x in places]
                errors.append(found)
            expected = result.trust.expected_error
            found.append(np.nan if expected is None else expected / unit)
            found += [report[when]["hd95"] / unit for when in ("before", "after")]
            numbers = " | ".join(f"{value:.1f}" for value in [*found, seconds])
            print(f"| {name} | {numbers} | {result.trust.verdict} |", flush=True)
        if errors:
            means = " | ".join(f"**{x:.1f}**" for x in np.mean(errors, axis=0)[: len(places)])
            print(f"| **mean** | {means} | | | | | |", flush=True)


if __name__ == "__main__":
    main()
