"""Register known deformations of real meshes, and real deformed pairs; print one table.

    python benchmarks/registrations.py ../shared/meshes [--backbone deftransnet] [--map 0]

Every mesh of ``objects`` is registered to a copy that the published recipe deforms (a synthetic
deformation of a real shape); in ``pairs``, meshes of one folder with equal faces are registered to
each other. Source and target points are drawn independently. Errors are distances of moved vertices
from their true places, in percent of the object's radius.
"""

from __future__ import annotations

import argparse
import zlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch

from dine.data.deformation import rbf_displacement
from dine.data.readers import read_surface
from dine.data.surface import Surface
from dine.registration.register import load_model, register

RECIPE = {"control_percent": 5, "width": 0.4, "amplitude": 0.15, "points": 1024}
LEVEL = 0.4


def deformed_copies(folder: Path) -> Iterator[tuple[str, Surface, Surface, np.ndarray | None]]:
    for path in sorted(folder.glob("*.ply")):
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
    parser.add_argument("--backbone", default="robust_defreg")
    parser.add_argument("--weights", type=Path)
    parser.add_argument("--map", type=int, default=40, dest="rounds")
    parser.add_argument("--prealign", default="auto")
    parser.add_argument("--threads", type=int, default=2)
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    model = load_model(arguments.backbone, weights=arguments.weights)
    print("| object | error before | after | expected | HD95 before | after | seconds | verdict |")
    print("|---|---|---|---|---|---|---|---|")
    for group in (
        deformed_copies(arguments.meshes / "objects"),
        real_pairs(arguments.meshes / "pairs"),
    ):
        errors = []
        for name, source, target, truth in group:
            result = register(
                source,
                target,
                model=model,
                rounds=arguments.rounds,
                partial="partial" in name,
                prealign=arguments.prealign,
            )
            report = result.report
            unit = report["normalisation"]["scale"] / 100
            before = after = np.nan
            if truth is not None:
                before = np.linalg.norm(source.vertices - truth, axis=1).mean() / unit
                after = np.linalg.norm(result.moved.vertices - truth, axis=1).mean() / unit
                errors.append((before, after))
            expected = result.trust.expected_error
            expected = np.nan if expected is None else expected / unit
            hd95 = [report[when]["hd95"] / unit for when in ("before", "after")]
            print(
                f"| {name} | {before:.1f} | {after:.1f} | {expected:.1f} | {hd95[0]:.1f} "
                f"| {hd95[1]:.1f} | {report['seconds']:.1f} | {result.trust.verdict} |",
                flush=True,
            )
        before, after = np.mean(errors, axis=0)
        print(f"| **mean** | **{before:.1f}** | **{after:.1f}** | | | | | |", flush=True)


if __name__ == "__main__":
    main()
