"""Pairs of meshes whose truth is known: synthetic deformations of real shapes, and real ones.

Every generator yields name, source, target and where the source's vertices belong, in the units of
the files: (V, 3), NaN where the target does not show it, or None where nothing is known.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Iterator
from pathlib import Path

import fast_simplification
import numpy as np

from dine.data.deformation import rbf_displacement
from dine.data.sampling import sample_surface
from dine.geometry.distance import surface_distance
from dine.geometry.rigid import rigid_alignments, transformed
from dine.geometry.surface import Surface
from dine.io.readers import read_surface
from dine.registration.assessment import mirrored

Pair = tuple[str, Surface, Surface, np.ndarray | None]
RECIPE = {"control_percent": 5, "width": 0.4, "amplitude": 0.15, "points": 1024}
LEVEL = 0.4
KEPT_FACES = 0.55
AS_NEAR = 1.15


def deformed_copies(
    folder: Path, only: set[str] | None = None, level: float = LEVEL
) -> Iterator[Pair]:
    for path in sorted(folder.glob("*.ply")):
        if only is not None and path.stem not in only:
            continue
        source = read_surface(path)
        rng = np.random.default_rng(zlib.crc32(path.stem.encode()))
        moved = source.vertices + rbf_displacement(source, level=level, rng=rng, **RECIPE)
        target = Surface(moved, source.faces, name=f"{path.name}, deformed")
        yield path.stem, source, target, moved


def bent_copies(folder: Path, degrees: float) -> Iterator[Pair]:
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


def other_objects(folder: Path) -> Iterator[Pair]:
    paths = sorted(folder.glob("*.ply"))

    def scaled(path: Path) -> Surface:
        surface = read_surface(path)
        places = surface.vertices - surface.vertices.mean(axis=0)
        return Surface(places / np.linalg.norm(places, axis=1).mean(), surface.faces, path.name)

    for path, other in zip(paths, paths[7:] + paths[:7], strict=True):
        yield path.stem, scaled(path), scaled(other), None


def mirrored_copies(folder: Path, level: float = 0.2) -> Iterator[Pair]:
    """Deformed copies with the sign of one coordinate changed, so that no place is right; not of
    symmetric objects, which are what they are either way."""
    for name, source, target, _ in deformed_copies(folder, level=level):
        if not symmetric(source):
            yield name, source, mirrored(target), None


def symmetric(surface: Surface) -> bool:
    """Whether points of the mirror image lie nearly as near to points of the surface as others of
    its own do."""
    rng = np.random.default_rng(0)
    points, others = (sample_surface(surface, 1000, rng).places(surface.vertices) for _ in range(2))
    image = others * [-1, 1, 1]
    nearest = min(
        _apart(transformed(image, motion), points) for motion in rigid_alignments(image, points)
    )
    return nearest < AS_NEAR * _apart(others, points)


def _apart(a: np.ndarray, b: np.ndarray) -> float:
    return surface_distance(a, b)["chamfer_unsquared"]


def real_pairs(folder: Path) -> Iterator[Pair]:
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
