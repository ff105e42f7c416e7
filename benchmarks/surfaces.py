"""Errors of registrations of two scans that share nothing: one row a condition.

    python benchmarks/surfaces.py ../shared/meshes [--points] [--half tuned] [--only remeshed]

Every mesh of ``objects`` is registered to a copy that the published recipe deforms (a synthetic
deformation of a real shape) and whose mesh is simplified to 55 % of its faces, so that the two
share neither vertices nor faces; likewise with noise, with a hole, larger deformations, bending,
and as clouds of points. Faces, liver and hippocampus are real deformed pairs, whose targets are
simplified too. Errors are mean distances of moved vertices from their true places in percent of the
object's radius: mean, median and largest over objects, beside those unregistered and after rigid
alignment, and the median CPU seconds. Of parts that overlap, what both show is measured.
``--half tuned`` and ``--half kept`` take every second object: settings were chosen on the tuned
ones.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np
import torch
from known_pairs import conditions, radius

from dine.registration.model import load_model
from dine.registration.register import register


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("meshes", type=Path)
    parser.add_argument("--half", choices=["tuned", "kept"], help="of the objects")
    parser.add_argument("--only", nargs="+", help="words in the conditions wanted")
    parser.add_argument("--points", action="store_true", help="do not go on to the surfaces")
    parser.add_argument("--each", action="store_true", help="a line for every object, too")
    parser.add_argument("--threads", type=int, default=1)
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    model = load_model()
    columns = ["targets", "pairs", "unregistered", "rigid", "mean", "median", "largest"]
    columns += ["worse than rigid", "expected", "plausible", "CPU seconds"]
    print("| " + " | ".join(columns) + " |\n" + "|---" * len(columns) + "|")
    for condition, pairs in conditions(arguments.meshes, arguments.half).items():
        if arguments.only and not any(word in condition for word in arguments.only):
            continue
        rows = []
        for name, source, target, truth in pairs:
            began = time.process_time()
            result = register(source, target, model=model, surfaces=not arguments.points)
            seconds = time.process_time() - began
            unit = radius(source) / 100
            places = (
                source.vertices,
                result.alignment.align(source.vertices),
                result.moved.vertices,
            )
            errors = [np.nanmean(np.linalg.norm(x - truth, axis=1)) / unit for x in places]
            expected = result.trust.expected_error
            expected = np.nan if expected is None else expected / unit
            rows.append((*errors, expected, result.trust.verdict == "plausible", seconds))
            if arguments.each:
                numbers = " ".join(f"{value:.2f}" for value in rows[-1])
                print(f"  {condition}, {name}: {numbers} {result.trust.reasons}", flush=True)
        before, rigid, after, expected, plausible, seconds = np.array(rows).T
        numbers = [f"{value.mean():.1f}" for value in (before, rigid)]
        numbers += [f"{value:.2f}" for value in (after.mean(), np.median(after), after.max())]
        numbers += [f"{(after > rigid).sum()}", f"{np.nanmean(expected):.2f}"]
        numbers += [f"{plausible.sum():.0f}", f"{np.median(seconds):.1f}"]
        print(f"| {condition} | {len(rows)} | " + " | ".join(numbers) + " |", flush=True)


if __name__ == "__main__":
    main()
