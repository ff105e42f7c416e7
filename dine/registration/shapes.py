"""What is registered: scans in any accepted form, whether they can be, and points drawn on them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from dine.data.sampling import SurfaceSamples, sample_surface
from dine.errors import ConfigError, DataError
from dine.geometry.distance import nearest
from dine.geometry.oriented import evenly
from dine.geometry.surface import Surface
from dine.io.readers import read_surface
from dine.io.text import format_stem
from dine.registration.objects import array_of, surface_of

Shape = str | Path | Surface | np.ndarray | tuple[np.ndarray, np.ndarray] | Any
"""A file, a surface, (V, 3) points, vertices and faces, or a mesh or cloud of trimesh, Open3D,
PyVista or meshio. Arrays may be tensors of PyTorch."""

POINTS = 1024
FEWEST = 16
# Extents that differ by more than this come from other units or other objects.
_LARGEST_RATIO = 3.0
# Tissue hardly grows or shrinks that much, but from inches to centimetres it is 2.54.
_UNUSUAL_RATIO = 1.5
# Fewer than so many points beside each other belong to nothing.
_COMPANY = 3
_APART = 0.25
_UNUSUAL_GAP = 10.0
# Points spread evenly for each that is drawn of a cloud.
_EVENLY = 2
# Vertices that are looked at first.
_LOOKED_AT = 2000
_UNITS = {1000: "metres and millimetres", 100: "metres and centimetres", 10: "cm and mm"}
_UNITS |= {25.4: "inches and millimetres", 2.54: "inches and centimetres"}


def as_surface(shape: Shape, name: str) -> Surface:
    """Any accepted form as a surface.

    Raises:
        DataError: a file that cannot be read, an array of another shape, or another object.
    """
    if isinstance(shape, Surface):
        return shape
    if isinstance(shape, str | Path):
        return read_surface(shape)
    if isinstance(shape, tuple) and len(shape) == 2:
        vertices, faces = (None if part is None else array_of(part) for part in shape)
        return Surface(vertices, faces, name=f"The {name}")
    return surface_of(shape, f"The {name}")


def checked_points(points: Any) -> np.ndarray:
    """(M, 3) finite points, as float64; M may be 0.

    Raises:
        DataError: another shape, no numbers, or some that are not finite.
    """
    try:
        found = np.asarray(array_of(points), dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise DataError(f"The points are no array of numbers ({error}).") from None
    if found.ndim != 2 or found.shape[1] != 3 or not np.isfinite(found).all():
        raise DataError(
            f"The points have the shape {found.shape}; expected finite numbers of shape (M, 3)."
        )
    return found


def shapes_by_name(paths: Sequence[Path]) -> dict[str, Path]:
    """Files by their stem.

    Raises:
        ConfigError: two of the same stem.
    """
    named = {format_stem(path): path for path in paths}
    if len(named) < len(paths):
        raise ConfigError("Two of the shapes to move along have the same name; rename one.")
    return named


Points = np.ndarray | str | Path
"""(L, 3) points, or a file of them."""


def checked_landmarks(
    landmarks: tuple[Points, Points], source: Surface, target: Surface
) -> tuple[np.ndarray, np.ndarray]:
    """Corresponding (L, 3) points of source and target, as float64.

    Points of a file that states its space (LPS or RAS) are brought into that of the scan. 3D Slicer
    takes scans that state none to be in LPS, and so it is here.

    Raises:
        DataError: unreadable, other shapes, or of different numbers.
    """
    scans = (source, target)
    here, there = (_in_space_of(x, scan) for x, scan in zip(landmarks, scans, strict=True))
    if here.shape != there.shape or here.ndim != 2 or here.shape[1] != 3:
        raise DataError(
            f"The landmarks have shapes {here.shape} and {there.shape}; expected as many rows "
            "of three coordinates on the source as on the target, in the same order."
        )
    if not (np.isfinite(here).all() and np.isfinite(there).all()):
        raise DataError("The landmarks hold NaN or infinite coordinates; leave these points out.")
    return here, there


def _in_space_of(points: Points, scan: Surface) -> np.ndarray:
    if isinstance(points, str | Path):
        from dine.io.slicer import in_space

        return in_space(read_surface(points), scan.space or "LPS")
    return np.asarray(array_of(points), dtype=np.float64)


def check_spaces(source: Surface, others: Iterable[Surface]) -> None:
    """Refuse scans that are stated to be in different patient coordinates.

    Raises:
        DataError: one is in LPS and one in RAS.
    """
    for other in others:
        if None not in (source.space, other.space) and source.space != other.space:
            raise DataError(
                f"{source.name} is in {source.space} and {other.name} in {other.space}; export "
                "both in the same coordinates."
            )


def check_sizes(source: Surface, target: Surface, partial: bool) -> list[str]:
    """What to say of sizes that differ much.

    Raises:
        DataError: a shape is a single place, or sizes differ so much that units must.
    """
    sizes = [_size(source, "source"), _size(target, "target")]
    ratio = max(sizes) / min(sizes)
    larger, other = (source, target) if sizes[0] > sizes[1] else (target, source)
    units = [text for factor, text in _UNITS.items() if 0.7 < ratio / factor < 1.4]
    guess = (
        f" Perhaps one is in {units[0].replace(' and ', ' and the other in ')}." if units else ""
    )
    if ratio > _LARGEST_RATIO:
        raise DataError(
            f"{larger.name} is {ratio:.3g} times larger than {other.name}; both must be in the "
            f"same units and show the same object.{guess}"
        )
    if ratio > _UNUSUAL_RATIO and not partial:
        return [f"{larger.name} is {ratio:.2g} times larger than {other.name}.{guess}"]
    return []


def _size(surface: Surface, what: str) -> float:
    places = surface.vertices[surface.used]
    middle = np.median(places, axis=0)
    distance = np.linalg.norm(places - middle, axis=1)
    size = float(np.median(distance) or distance.mean())
    if len(places) == 1 or size <= 1e-12 * np.abs(middle).max():
        raise DataError(
            f"All points of {surface.name}, the {what}, coincide; expected the surface of an "
            "object."
        )
    return size


def _on_a_line(points: np.ndarray) -> bool:
    widths = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return widths[1] <= 1e-6 * widths[0]


def drawn(surface: Surface, points: int, rng: np.random.Generator, what: str) -> SurfaceSamples:
    """Points of a surface; all of a cloud that has fewer.

    Raises:
        ConfigError: fewer than 16 points are asked for.
        DataError: there are fewer, or all lie on one line.
    """
    if points < FEWEST:
        raise ConfigError(f"The number of points is {points}; expected at least {FEWEST}.")
    extent = surface.vertices[surface.used]
    # What some points leave is not of a line.
    if _on_a_line(extent[:: max(len(extent) // _LOOKED_AT, 1)]) and _on_a_line(extent):
        raise DataError(
            f"All points of {surface.name}, the {what}, lie on one line; expected the surface of "
            "an object."
        )
    if surface.faces is not None:
        return sample_surface(surface, points, rng)
    _, first = np.unique(surface.vertices, axis=0, return_index=True)
    if len(first) < FEWEST:
        raise DataError(
            f"{surface.name}, the {what}, has {len(first)} distinct points; expected at least "
            f"{FEWEST}."
        )
    index = np.sort(first[near_points(surface.vertices[first])])
    if len(index) > points:
        # Scanners see some regions more densely than others; that says nothing of the object.
        index = index[evenly(surface.vertices[index], _EVENLY * points)]
        index = rng.permutation(index)[:points]
    return SurfaceSamples(index[:, None].repeat(3, axis=1), np.tile([1.0, 0, 0], (len(index), 1)))


def near_points(points: np.ndarray) -> np.ndarray:
    """Mask (N,) of the points of a cloud that are not apart from all others, as wrong ones are.

    Apart: the third neighbour is farther than a quarter of the distance from the median point that
    19 of 20 points have, and than ten times what is usual. Parts of an object are denser than that.
    """
    count = len(points)
    if count <= _COMPANY:
        return np.ones(count, bool)
    gap = nearest(cKDTree(points), points, [_COMPANY + 1])[0][:, 0]
    distance = np.linalg.norm(points - np.median(points, axis=0), axis=1)
    size = np.quantile(distance, 0.95, method="lower")
    return gap <= max(_APART * size, _UNUSUAL_GAP * np.median(gap))


def dense_points(surface: Surface) -> np.ndarray:
    """Points to measure distances with: four times as many as the network sees."""
    if surface.faces is None:
        return surface.vertices[near_points(surface.vertices)]
    rng = np.random.default_rng(5)
    return sample_surface(surface, 4 * POINTS, rng).places(surface.vertices)
