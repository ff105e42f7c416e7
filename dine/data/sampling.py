"""Points on a surface, and what index i means across objects.

A prior over whole displacement fields compares entry i of one field with entry i of another, so
the same entry should sit at the same place of every object. Sampled points come in no order, and
different objects share no vertices; a convention puts the points of each object in an order that
makes entry i mean about the same place everywhere. It is computed from the source alone, once for
each undeformed object, and holds for all of its targets.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from dine.errors import ConfigError, DataError
from dine.geometry.surface import Surface

_GOLDEN_ANGLE = np.pi * (3 - np.sqrt(5))


@dataclass(frozen=True, eq=False)
class SurfaceSamples:
    """N points fixed to a surface by barycentric coordinates, so that they move along with it.

    Attributes:
        faces_vertices: (N, 3) int64 indices of the vertices that each point lies between; for a
            cloud, the index of its vertex three times.
        weights: (N, 3) float64, not negative, each row summing to 1; for a cloud 1, 0, 0.
    """

    faces_vertices: np.ndarray
    weights: np.ndarray

    def __len__(self) -> int:
        return len(self.weights)

    def __getitem__(self, order: np.ndarray) -> SurfaceSamples:
        """The samples picked or reordered by an index array."""
        return SurfaceSamples(self.faces_vertices[order], self.weights[order])

    def places(self, vertices: np.ndarray) -> np.ndarray:
        """The (N, 3) float64 places of the samples on (V, 3) vertices of the same topology.

        Raises:
            DataError: not (V, 3), or fewer vertices than the samples refer to.
        """
        vertices = np.asarray(vertices, dtype=np.float64)
        needed = int(self.faces_vertices.max()) + 1
        if vertices.ndim != 2 or vertices.shape[1] != 3 or len(vertices) < needed:
            raise DataError(
                f"Samples of a surface of at least {needed} vertices have no places on vertices "
                f"of shape {vertices.shape}; expected the same vertices in the same order."
            )
        return np.einsum("nk,nkd->nd", self.weights, vertices[self.faces_vertices])


def sample_surface(surface: Surface, points: int, rng: np.random.Generator) -> SurfaceSamples:
    """Draw points uniformly by area on a mesh, or vertices without replacement from a cloud.

    The draw depends on the shape of the surface and not on its position or units.

    Raises:
        DataError: a cloud of fewer vertices than ``points``, or a mesh without area.
    """
    if surface.faces is None:
        if len(surface.vertices) < points:
            raise DataError(
                f"{surface.name} has {len(surface.vertices)} vertices and no faces, too few to "
                f"draw {points} points; lower the number of points or provide a mesh."
            )
        index = rng.choice(len(surface.vertices), size=points, replace=False)
        return SurfaceSamples(
            np.repeat(index[:, None], 3, axis=1), np.tile([1.0, 0, 0], (points, 1))
        )

    reach = surface.area_reach
    if not reach[-1] > np.finfo(np.float64).tiny:
        raise DataError(
            f"{surface.name}: the {len(surface.faces)} triangles have no area to draw points from; "
            "repair or remove the file."
        )
    # "right" skips triangles without area, whose reach is that of the one before.
    face = np.searchsorted(reach, rng.random(points) * reach[-1], side="right")
    # Folding the unit square along its diagonal makes the draw uniform within the triangle.
    square = rng.random((points, 2))
    outside = square.sum(axis=1) > 1
    square[outside] = 1 - square[outside]
    weights = np.column_stack([1 - square.sum(axis=1), square])
    return SurfaceSamples(surface.faces[face], np.maximum(weights, 0.0))


def fibonacci_sphere(count: int) -> np.ndarray:
    """(count, 3) points spread evenly over the unit sphere, from the north pole to the south."""
    height = 1 - (2 * np.arange(count) + 1) / count
    angle = _GOLDEN_ANGLE * np.arange(count)
    radius = np.sqrt(1 - height**2)
    return np.column_stack([radius * np.cos(angle), radius * np.sin(angle), height])


def sunflower_disc(count: int) -> np.ndarray:
    """(count, 2) points spread evenly over the unit disc, from its middle outwards (Vogel)."""
    radius = np.sqrt((np.arange(count) + 0.5) / count)
    angle = _GOLDEN_ANGLE * np.arange(count)
    return np.column_stack([radius * np.cos(angle), radius * np.sin(angle)])


def _transport(points: np.ndarray, template: Callable[[int], np.ndarray]) -> np.ndarray:
    """Entry i: the point that the cheapest one-to-one assignment gives to template point i."""
    from dine.data.assignment import cheapest_assignment  # compiled: numba takes a while to import

    count = len(points)
    return cheapest_assignment(points, template(count), template(count // 8 or 1))


def _sphere(points: np.ndarray) -> np.ndarray:
    return _transport(points, fibonacci_sphere)


def _disc(points: np.ndarray) -> np.ndarray:
    return _transport(points[:, :2], sunflower_disc)


def _lexicographic(points: np.ndarray) -> np.ndarray:
    return np.lexsort(points.T[::-1])


def _none(points: np.ndarray) -> np.ndarray:
    return np.arange(len(points))


CONVENTIONS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "sphere": _sphere,
    "disc": _disc,
    "lexicographic": _lexicographic,
    "none": _none,
}
"""Functions from (N, 3) source points to their (N,) order, by name; see ``convention_order``."""


def convention_order(points: np.ndarray, convention: str) -> np.ndarray:
    """The order that puts the points of one source in convention.

    The convention:

    * ``sphere``, for closed shapes. The template is the Fibonacci sphere of N points, t_i = (r cos
      a, r sin a, z) with z = 1 - (2i + 1)/N, r = sqrt(1 - z²), a = i·pi·(3 - sqrt 5). Among all
      one-to-one assignments of the N source points to the N template points, take the one with the
      least sum of squared distances. Entry i is the source point assigned to t_i.
    * ``disc``, for 2.5D patches seen along z. The same with the sunflower disc t_i = (r cos a,
      r sin a), r = sqrt((i + 1/2)/N), and the x and y of the points.
    * ``lexicographic``. Sorted by x, then y, then z, as SimTool writes vertices.
    * ``none``. The random order of sampling: a control in which an index means nothing.

    The first two depend neither on the position, nor the units, nor the incoming order of the
    points. No convention turns an object: objects are compared in the pose of their files.

    Plain coordinates are assigned on purpose: standardising or whitening them, stretching them to
    a unit box, or projecting them to directions first agreed less, or no better, between objects.

    Args:
        points: (N, 3) points of one source.
        convention: a name in ``CONVENTIONS``.

    Returns:
        (N,) permutation; ``points[order]`` is in convention.

    Raises:
        ConfigError: unknown name.
    """
    if convention not in CONVENTIONS:
        raise ConfigError(
            f"Unknown convention {convention!r}; expected one of {', '.join(CONVENTIONS)}."
        )
    return CONVENTIONS[convention](np.asarray(points, dtype=np.float64))


def neighbourhood_agreement(
    points: np.ndarray, *, k: int = 10, pairs: int = 200, rng: np.random.Generator
) -> dict[str, float]:
    """How far the same index means the same place on different objects.

    Args:
        points: (P, N, 3) sources of P >= 2 different objects, all in one convention.
        k: neighbours of a point.
        pairs: pairs of different objects to draw and average over.
        rng: draws them.

    Returns:
        ``shared``: mean share of the k nearest neighbours of entry i in one object, by index, that
        are also among the k nearest of entry i in the other. ``chance``: the same for unrelated
        orders, k/(N - 1). ``distance``: mean distance from entry i of one object to entry i of the
        other, as a share of the mean distance when entries are paired at random.

    Raises:
        DataError: fewer than two objects, or not more than k points.
    """
    points = np.asarray(points, dtype=np.float64)
    if points.ndim != 3 or points.shape[2] != 3 or len(points) < 2 or points.shape[1] <= k:
        raise DataError(
            f"Agreement needs at least 2 objects of more than {k} points, (P, N, 3); found "
            f"{points.shape}."
        )
    objects, count, _ = points.shape
    neighbours = [_neighbours(cloud, k) for cloud in points]
    shared, matched, random = [], [], []
    for _ in range(pairs):
        a, b = rng.choice(objects, size=2, replace=False)
        shared.append(_shared(neighbours[a], neighbours[b]))
        matched.append(np.linalg.norm(points[a] - points[b], axis=1).mean())
        mixed = points[b][rng.permutation(count)]
        random.append(np.linalg.norm(points[a] - mixed, axis=1).mean())
    return {
        "shared": float(np.mean(shared)),
        "chance": k / (count - 1),
        "distance": float(np.mean(matched) / np.mean(random)),
    }


def agreement_ceiling(
    surface: Surface,
    *,
    points: int,
    convention: str,
    k: int = 10,
    pairs: int = 4,
    rng: np.random.Generator,
) -> float:
    """``shared`` of ``neighbourhood_agreement`` between independent samplings of one object.

    Two draws from the same surface disagree by chance, so different objects cannot be expected to
    agree any better than this.

    Raises:
        DataError: as ``sample_surface``.
        ConfigError: unknown convention.
    """

    def draw() -> np.ndarray:
        cloud = sample_surface(surface, points, rng).places(surface.vertices)
        return _neighbours(cloud[convention_order(cloud, convention)], k)

    return float(np.mean([_shared(draw(), draw()) for _ in range(pairs)]))


def _neighbours(cloud: np.ndarray, k: int) -> np.ndarray:
    """(N, k) indices of the nearest other points."""
    found = cKDTree(cloud).query(cloud, k + 1)[1]
    itself = found == np.arange(len(cloud))[:, None]
    # Among coincident points, a point may be missing from its own neighbours.
    itself[~itself.any(axis=1), -1] = True
    return found[~itself].reshape(len(cloud), k)


def _shared(first: np.ndarray, second: np.ndarray) -> float:
    return float((first[:, :, None] == second[:, None, :]).any(axis=2).mean())
