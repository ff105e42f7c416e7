"""Register known deformations of real meshes, and real deformed pairs; print one table.

    python benchmarks/registrations.py ../shared/meshes [--backbone deftransnet] [--map 0]

    python benchmarks/registrations.py ../shared/meshes --weights W --prior P --calibration C \
        --held-out results/own/own/pairs.h5 --shipped      # weights of your own beside the shipped

    python benchmarks/registrations.py ../shared/meshes --verdicts 0.05 0.1 0.2 0.4 0.8 \
        bent-60 bent-150 other                             # does the verdict tell good from bad?

Every mesh of ``objects`` is registered to a copy that the published recipe deforms (a synthetic
deformation of a real shape); in ``pairs``, meshes of one folder with equal faces are registered to
each other. Source and target points are drawn independently. Errors are distances of moved vertices
from their true places, before, after rigid alignment alone and after registration, in percent of
the object's radius.

With ``--verdicts``, meshes are registered to copies deformed by the recipe at some levels, to
copies bent along their longest axis by some degrees, or to other objects of the same size, and
counted: a result is bad if its error is above 95 % of that of rigid alignment alone, or above 15 %.
"""

from __future__ import annotations

import argparse
import time
import zlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch

from dine.data.deformation import rbf_displacement
from dine.data.pairs import read_pairs
from dine.geometry.surface import Surface
from dine.io.readers import read_surface
from dine.registration.model import load_model
from dine.registration.register import register
from dine.registration.types import Model

RECIPE = {"control_percent": 5, "width": 0.4, "amplitude": 0.15, "points": 1024}
LEVEL = 0.4


def deformed_copies(
    folder: Path, only: set[str] | None = None, level: float = LEVEL
) -> Iterator[tuple[str, Surface, Surface, np.ndarray | None]]:
    for path in sorted(folder.glob("*.ply")):
        if only is not None and path.stem not in only:
            continue
        source = read_surface(path)
        rng = np.random.default_rng(zlib.crc32(path.stem.encode()))
        moved = source.vertices + rbf_displacement(source, level=level, rng=rng, **RECIPE)
        target = Surface(moved, source.faces, name=f"{path.name}, deformed")
        yield path.stem, source, target, moved


def bent_copies(
    folder: Path, degrees: float
) -> Iterator[tuple[str, Surface, Surface, np.ndarray | None]]:
    for path in sorted(folder.glob("*.ply")):
        source = read_surface(path)
        middle = source.vertices.mean(axis=0)
        sample = source.vertices[:: max(1, len(source.vertices) // 3000)] - middle
        axes = np.linalg.svd(sample, full_matrices=False)[2]
        along, across, third = ((source.vertices - middle) @ axes.T).T
        radius = np.ptp(along) / np.radians(degrees)
        angle, reach = along / radius, radius - across
        bent = np.column_stack([reach * np.sin(angle), radius - reach * np.cos(angle), third])
        moved = bent @ axes + middle
        yield path.stem, source, Surface(moved, source.faces, name=f"{path.name}, bent"), moved


def other_objects(folder: Path) -> Iterator[tuple[str, Surface, Surface, np.ndarray | None]]:
    paths = sorted(folder.glob("*.ply"))

    def scaled(path: Path) -> Surface:
        surface = read_surface(path)
        places = surface.vertices - surface.vertices.mean(axis=0)
        return Surface(places / np.linalg.norm(places, axis=1).mean(), surface.faces, path.name)

    for path, other in zip(paths, paths[7:] + paths[:7], strict=True):
        yield path.stem, scaled(path), scaled(other), None


def count_verdicts(objects: Path, cases: list[str], model: Model) -> None:
    print("| targets | good | of these plausible | bad | of these plausible |")
    print("|---|---|---|---|---|")
    for case in cases:
        if case == "other":
            group = other_objects(objects)
        elif case.startswith("bent-"):
            group = bent_copies(objects, float(case.removeprefix("bent-")))
        else:
            group = deformed_copies(objects, level=float(case))
        counts = {(good, plausible): 0 for good in (True, False) for plausible in (True, False)}
        for _, source, target, truth in group:
            result = register(source, target, model=model)
            good = False
            if truth is not None:
                aligned = result.alignment.align(source.vertices)
                errors = [
                    np.linalg.norm(places - truth, axis=1).mean() / result.alignment.frame.scale
                    for places in (aligned, result.moved.vertices)
                ]
                good = bool(errors[1] <= min(0.95 * errors[0], 0.15))
            counts[good, result.trust.verdict == "plausible"] += 1
        found = [
            (sum(counts[good, p] for p in (True, False)), counts[good, True])
            for good in (True, False)
        ]
        print(
            f"| {case} | " + " | ".join(str(n) for pair in found for n in pair) + " |", flush=True
        )


def real_pairs(folder: Path) -> Iterator[tuple[str, Surface, Surface, np.ndarray | None]]:
    face = folder / "face_expressions"
    for path in sorted(face.glob("*.ply")):
        if path.stem != "neutral":
            target = read_surface(path)
            yield f"face, {path.stem}", read_surface(face / "neutral.ply"), target, target.vertices
    for part in ("dentate", "hipp"):
        source, target = (
            read_surface(folder / "hippocampus" / f"{part}_{state}.ply")
            for state in ("canonical", "unfold")
        )
        yield f"hippocampus, {part}", source, target, target.vertices
    liver = folder / "liver"
    source, target = (read_surface(liver / f"liver1_{x}.ply") for x in ("source", "deformed"))
    yield "liver 1", source, target, target.vertices
    yield (
        "liver 1, partial",
        source,
        read_surface(liver / "liver1_partial_target.ply"),
        target.vertices,
    )
    for number in (2, 3):
        files = (liver / f"liver{number}_{x}.ply" for x in ("source", "partial_target"))
        yield f"liver {number}, partial", *(read_surface(path) for path in files), None


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("meshes", type=Path)
    parser.add_argument("--backbone")
    for file in ("weights", "prior", "calibration"):
        parser.add_argument(f"--{file}", type=Path)
    parser.add_argument("--held-out", type=Path, help="pairs file; only its objects for the tests")
    parser.add_argument("--shipped", action="store_true", help="errors of shipped weights, too")
    parser.add_argument("--verdicts", nargs="+", help="count verdicts: levels, bent-DEGREES, other")
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
