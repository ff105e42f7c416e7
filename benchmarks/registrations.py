"""Register known deformations of real meshes, and real deformed pairs; print one table.

    python benchmarks/registrations.py ../shared/meshes [--backbone deftransnet] [--map 0]

    python benchmarks/registrations.py ../shared/meshes --weights W --prior P --calibration C \
        --held-out results/own/own/pairs.h5 --shipped      # weights of your own beside the shipped

Every mesh of ``objects`` is registered to a copy that the published recipe deforms (a synthetic
deformation of a real shape); in ``pairs``, meshes of one folder with equal faces are registered to
each other. Source and target points are drawn independently. Errors are distances of moved vertices
from their true places, before, after rigid alignment alone and after registration, in percent of
the object's radius.
"""

from __future__ import annotations

import argparse
import zlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch

from dine.data.deformation import rbf_displacement
from dine.data.pairs import read_pairs
from dine.data.readers import read_surface
from dine.data.surface import Surface
from dine.registration.frame import transformed
from dine.registration.register import load_model, register

RECIPE = {"control_percent": 5, "width": 0.4, "amplitude": 0.15, "points": 1024}
LEVEL = 0.4


def deformed_copies(
    folder: Path, only: set[str] | None
) -> Iterator[tuple[str, Surface, Surface, np.ndarray | None]]:
    for path in sorted(folder.glob("*.ply")):
        if only is not None and path.stem not in only:
            continue
        source = read_surface(path)
        rng = np.random.default_rng(zlib.crc32(path.stem.encode()))
        moved = source.vertices + rbf_displacement(source, level=LEVEL, rng=rng, **RECIPE)
        target = Surface(moved, source.faces, name=f"{path.name}, deformed")
        yield path.stem, source, target, moved


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
    parser.add_argument("--map", type=int, default=40, dest="rounds")
    parser.add_argument("--prealign", default="auto")
    parser.add_argument("--threads", type=int, default=2)
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    files = {file: getattr(arguments, file) for file in ("weights", "prior", "calibration")}
    model = load_model(arguments.backbone, **files)
    shipped = load_model(model.backbone.registered_name) if arguments.shipped else None
    only = None
    if arguments.held_out:
        pairs = read_pairs(arguments.held_out)
        only = set(pairs.object[pairs.split == "test"].tolist())
    columns = ["error before", "aligned", "after", *["shipped"] * arguments.shipped, "expected"]
    columns = ["object", *columns, "HD95 before", "after", "seconds", "verdict"]
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
            result = register(source, target, model=model, **settings)
            report = result.report
            unit = report["normalisation"]["scale"] / 100
            places = [source.vertices]
            places += [transformed(source.vertices, np.array(report["alignment"]))]
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
            numbers = " | ".join(f"{value:.1f}" for value in [*found, report["seconds"]])
            print(f"| {name} | {numbers} | {result.trust.verdict} |", flush=True)
        means = " | ".join(f"**{value:.1f}**" for value in np.mean(errors, axis=0)[: len(places)])
        print(f"| **mean** | {means} | | | | | |", flush=True)


if __name__ == "__main__":
    main()
