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
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path

import fast_simplification
import numpy as np
import torch
from registrations import bent_copies, deformed_copies, real_pairs

from dine.data.sampling import sample_surface
from dine.geometry.surface import Surface
from dine.registration.model import load_model
from dine.registration.register import register

Pair = tuple[str, Surface, Surface, np.ndarray]
KEPT_FACES = 0.55


def remeshed(surface: Surface, kept: float = KEPT_FACES) -> Surface:
    """With other vertices and fewer faces."""
    vertices, faces = fast_simplification.simplify(
        surface.vertices.astype(np.float32), surface.faces.astype(np.int32), 1 - kept
    )
    return Surface(vertices, faces, surface.name)


def radius(surface: Surface) -> float:
    return float(np.linalg.norm(surface.vertices - surface.vertices.mean(axis=0), axis=1).max())


def with_noise(surface: Surface, rng: np.random.Generator) -> Surface:
    moved = surface.vertices + 0.01 * radius(surface) * rng.normal(size=surface.vertices.shape)
    return Surface(moved, surface.faces, surface.name)


def with_hole(surface: Surface, rng: np.random.Generator) -> Surface:
    """Without the 15 % of its faces that are nearest to one of them."""
    middles = surface.vertices[surface.faces].mean(axis=1)
    distance = np.linalg.norm(middles - middles[rng.integers(len(middles))], axis=1)
    return part(surface, distance > np.quantile(distance, 0.15))[0]


def part(surface: Surface, faces: np.ndarray) -> tuple[Surface, np.ndarray]:
    """The given faces (F,) alone, and the vertices that remain."""
    used, index = np.unique(surface.faces[faces], return_inverse=True)
    return Surface(surface.vertices[used], index.reshape(-1, 3), surface.name), used


def as_clouds(pairs: Iterator[Pair], count: int) -> Iterator[Pair]:
    for name, source, target, truth in pairs:
        rng = np.random.default_rng(zlib.crc32(name.encode()))
        ours = sample_surface(source, count, rng)
        places = ours.places(source.vertices)
        other = sample_surface(target, count, rng).places(target.vertices)
        yield name, Surface(places), Surface(other), ours.places(truth)


def both_partial(pairs: Iterator[Pair], seen: float) -> Iterator[Pair]:
    """Each shows a share of the faces, from opposite ends of the longest axis.

    The truth of vertices that the target does not show is NaN.
    """
    for name, source, _, truth in pairs:
        middles = source.vertices[source.faces].mean(axis=1)
        axis = np.linalg.svd(middles - middles.mean(axis=0), full_matrices=False)[2][0]
        along = middles @ axis
        ours, used = part(source, along < np.quantile(along, seen))
        theirs, shown = part(Surface(truth, source.faces), along > np.quantile(along, 1 - seen))
        known = np.full_like(truth, np.nan)
        known[shown] = truth[shown]
        yield name, ours, remeshed(theirs), known[used]


def changed(pairs: Iterator[Pair], *changes: Callable[..., Surface]) -> Iterator[Pair]:
    """Targets after some changes, in which the truth stays what it was."""
    for name, source, target, truth in pairs:
        rng = np.random.default_rng(zlib.crc32(name.encode()))
        for change in changes:
            target = change(target) if change is remeshed else change(target, rng)
        yield name, source, target, truth


def conditions(meshes: Path, half: str | None) -> dict[str, Iterator[Pair]]:
    names = [path.stem for path in sorted((meshes / "objects").glob("*.ply"))]
    only = {None: names, "tuned": names[::2], "kept": names[1::2]}[half]

    def copies(level: float = 0.4) -> Iterator[Pair]:
        return deformed_copies(meshes / "objects", set(only), level)

    def bent() -> Iterator[Pair]:
        found = bent_copies(meshes / "objects", 150)
        return (pair for pair in found if pair[0] in only)

    def real(word: str) -> Iterator[Pair]:
        found = real_pairs(meshes / "pairs")
        return (pair for pair in found if word in pair[0] and "partial" not in pair[0])

    return {
        "remeshed": changed(copies(), remeshed),
        "noise 1 %": changed(copies(), remeshed, with_noise),
        "hole 15 %": changed(copies(), remeshed, with_hole),
        "level 0.8": changed(copies(0.8), remeshed),
        "bent 150": changed(bent(), remeshed),
        "clouds of 1024": as_clouds(copies(), 1024),
        "clouds of 4096": as_clouds(copies(), 4096),
        "clouds of 16384": as_clouds(copies(), 16384),
        "both partial 80 %": both_partial(copies(), 0.8),
        "itself": ((name, source, source, source.vertices) for name, source, _, _ in copies()),
        "faces": changed(real("face"), remeshed),
        "liver": changed(real("liver 1"), remeshed),
        "hippocampus": changed(real("hippocampus"), remeshed),
    }


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
