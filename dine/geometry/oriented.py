"""Points with normals: evenly thinned, found in a cloud, and moved along with a field."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.sparse import csr_matrix
from scipy.spatial import cKDTree

from dine.geometry.distance import nearest

NEIGHBOURS = 12
"""Points of a cloud that its normals follow from, each included."""
# Neighbours on the other side of a thin wall do not say how this side lies.
_SAME_SIDE = 0.3
_REGULAR = 1e-6
# Points that a quadric is laid through, and how far its curvatures are held down: as shares of the
# weight of the points, or of the slopes where points move.
_THROUGH = 10
_HELD = 0.01
_HELD_MOVING = 0.001
# Neighbours of a point, and the angle in degrees that they leave open at the end of a surface.
_AROUND = 20
_OPEN = 140.0
_EVERYWHERE = slice(None)


class OrientedPoints(NamedTuple):
    """Points of a surface with its normals.

    Attributes:
        points: (N, 3).
        normals: (N, 3) unit vectors, whose signs may mean nothing.
        rim: (N,) bool, points where the surface ends.
    """

    points: np.ndarray
    normals: np.ndarray
    rim: np.ndarray

    def at(self, index: np.ndarray) -> OrientedPoints:
        """Some of them, by index or mask."""
        return OrientedPoints(self.points[index], self.normals[index], self.rim[index])


class Curve(NamedTuple):
    """Points of a curve, such as where a surface ends.

    Attributes:
        points: (E, 3).
        tangents: (E, 3) unit vectors along the curve, of either sign.
    """

    points: np.ndarray
    tangents: np.ndarray

    def at(self, index: np.ndarray) -> Curve:
        """Some of them, by index or mask."""
        return Curve(self.points[index], self.tangents[index])


def unit(vectors: np.ndarray) -> np.ndarray:
    """(N, 3) vectors at length 1; those without length stay as they are."""
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return vectors / np.where(length > 0, length, 1)


def fitted_planes(
    points: np.ndarray, neighbours: int = NEIGHBOURS, at: np.ndarray | slice = _EVERYWHERE
) -> tuple[np.ndarray, np.ndarray]:
    """Unit normals (M, 3) of a cloud (N, 3), of arbitrary signs, and how rough it is there (M,), at
    all of its points or those of the index ``at``.

    The normal is the direction in which the neighbours of a point vary least, the roughness their
    standard deviation in it. Hoppe et al. (1992), Surface reconstruction from unorganized points.
    """
    near = points[_nearest(points, neighbours, at)]
    offset = near - near.mean(axis=1, keepdims=True)
    moments = np.einsum("nka,nkb->nab", offset, offset) / near.shape[1]
    variances, axes = np.linalg.eigh(moments)
    return axes[:, :, 0], np.sqrt(np.maximum(variances[:, 0], 0))


def fitted_quadrics(points: np.ndarray) -> np.ndarray:
    """Unit normals (N, 3) of a cloud (N, 3) where quadrics through the neighbours of each point lie
    on it, of arbitrary signs.

    Neighbours on one side of a point tilt a plane through them where the surface bends; a quadric
    bends along. Cazals and Pouget (2005), Estimating differential quantities using polynomial
    fitting of osculating jets; curvatures are held down a little, which few neighbours need.
    """
    normals, _ = fitted_planes(points)
    offset = points[_nearest(points, _THROUGH)] - points[:, None]
    squared = (offset**2).sum(axis=2)
    size = np.sqrt(np.maximum(squared.max(axis=1), 1e-20))
    weight = np.exp(-2 * squared / size[:, None] ** 2)
    # Once for the axes that they are heights above, and once from there.
    for _ in range(2):
        first, second = _tangents(normals)
        u, v, height = (
            np.einsum("nkc,nc->nk", offset, axis) / size[:, None]
            for axis in (first, second, normals)
        )
        terms = np.stack([np.ones_like(u), u, v, u * u, u * v, v * v], axis=2)
        system = np.einsum("nka,nk,nkb->nab", terms, weight, terms)
        held = np.diag([0, 0, 0, _HELD, _HELD, _HELD]) + 1e-9 * np.eye(6)
        system += held * weight.sum(axis=1)[:, None, None]
        right = np.einsum("nka,nk,nk->na", terms, weight, height)
        slope = np.linalg.solve(system, right[:, :, None])[:, 1:3, 0]
        normals = unit(normals - slope[:, :1] * first - slope[:, 1:] * second)
    return normals


def rim_points(points: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Mask (N,) of the points of a cloud (N, 3) where its surface ends: neighbours leave a wide
    angle open.

    Of evenly drawn points inside a surface, one in some hundred is taken for such.
    """
    offset = points[_nearest(points, _AROUND)] - points[:, None]
    first, second = _tangents(normals)
    angle = np.arctan2(
        np.einsum("nkc,nc->nk", offset, second), np.einsum("nkc,nc->nk", offset, first)
    )
    angle = np.sort(angle[:, 1:], axis=1)
    if angle.shape[1] == 0:
        return np.zeros(len(points), bool)
    gap = np.diff(angle, axis=1, append=angle[:, :1] + 2 * np.pi)
    return gap.max(axis=1) > np.radians(_OPEN)


def _nearest(points: np.ndarray, count: int, at: np.ndarray | slice = _EVERYWHERE) -> np.ndarray:
    """Indices (M, k) of the points that are nearest to each of some, itself first; k is at most
    N."""
    count = min(count, len(points))
    return nearest(cKDTree(points), points[at], [*range(1, count + 1)])[1]


def rim_curve(vertices: np.ndarray, edges: np.ndarray, spacing: float) -> Curve:
    """Points on edges (B, 2) between vertices (V, 3), one for each ``spacing`` of their length."""
    first = vertices[edges[:, 0]]
    along = vertices[edges[:, 1]] - first
    length = np.linalg.norm(along, axis=1)
    ends = np.cumsum(length)
    place = np.arange(spacing / 2, ends[-1] if len(ends) else 0.0, spacing)
    edge = np.searchsorted(ends, place)
    share = (place - ends[edge] + length[edge]) / length[edge]
    return Curve(first[edge] + share[:, None] * along[edge], unit(along[edge]))


def evenly(points: np.ndarray, count: int) -> np.ndarray:
    """Indices of at most ``count`` of (N, 3) points that cover them evenly, however dense they lie.

    One point of every occupied cell of a grid, the nearest to the middle of its cell; the cells are
    as small as ``count`` allows.
    """
    if len(points) <= count:
        return np.arange(len(points))
    low = points.min(axis=0)
    size = float(np.ptp(points, axis=0).max()) or 1.0
    # A surface of this size fills about so many cells; halving the interval finds the rest.
    least, most = size / (4 * np.sqrt(count) + 4), 2 * size
    for _ in range(12):
        middle = np.sqrt(least * most)
        if len(np.unique(_cells(points - low, middle))) > count:
            least = middle
        else:
            most = middle
    _, first, cell = np.unique(_cells(points - low, most), return_index=True, return_inverse=True)
    middle = (np.floor((points - low) / most) + 0.5) * most
    order = np.lexsort((((points - low - middle) ** 2).sum(axis=1), cell))
    return np.sort(order[np.searchsorted(cell[order], np.arange(len(first)))])


def _cells(offset: np.ndarray, edge: float) -> np.ndarray:
    """A number for the cell of every point (N, 3)."""
    place = np.floor(offset / edge).astype(np.int64)
    across = place.max(axis=0) + 1
    return (place[:, 0] * across[1] + place[:, 1]) * across[2] + place[:, 2]


class MovingNormals:
    """The normals of points (N, 3) whose neighbours on the surface move along with them.

    Called with the moved points (N, 3): two tangents of each are least-squares combinations of the
    offsets to its neighbours, found once, and their cross product is the normal, with the sign of
    the one given.

    Args:
        oriented: the points.
        neighbours: of each.
        curved: the slopes are those of quadrics through the neighbours and not of planes, which
            says more where few points show how the surface bends.
    """

    def __init__(self, oriented: OrientedPoints, neighbours: int = 16, curved: bool = False):
        points, normals = oriented.points, oriented.normals
        count = len(points)
        near = nearest(cKDTree(points), points, [*range(2, min(neighbours, count - 1) + 2)])[1]
        offset = points[near] - points[:, None]
        same = np.einsum("nkc,nc->nk", normals[near], normals)
        weight = (same > _SAME_SIDE) / np.maximum((offset**2).sum(axis=2), 1e-12)
        along = np.stack(
            [np.einsum("nkc,nc->nk", offset, axis) for axis in _tangents(normals)], axis=2
        )
        slopes = _slopes(along, weight, curved)
        rows = np.repeat(np.arange(count), near.shape[1])
        self._operators = []
        for axis in range(2):
            matrix = csr_matrix((slopes[:, :, axis].ravel(), (rows, near.ravel())), (count, count))
            matrix.setdiag(matrix.diagonal() - slopes[:, :, axis].sum(axis=1))
            self._operators.append(matrix)
        self._sign = np.ones((count, 1))
        agreeing = np.einsum("nc,nc->n", self(points), normals)
        self._sign = np.where(agreeing < 0, -1.0, 1.0)[:, None]

    def __call__(self, moved: np.ndarray) -> np.ndarray:
        """(N, 3) unit normals once the points are moved to (N, 3)."""
        first, second = (operator @ moved for operator in self._operators)
        return unit(np.cross(first, second)) * self._sign


def _tangents(normals: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Two unit vectors (N, 3) across each normal and each other."""
    flat = np.abs(normals[:, :1]) < 0.9
    first = unit(np.cross(normals, np.where(flat, [[1.0, 0, 0]], [[0, 1.0, 0]])))
    return first, np.cross(normals, first)


def _slopes(along: np.ndarray, weight: np.ndarray, curved: bool) -> np.ndarray:
    """(N, k, 2): what the values at the neighbours of each point, at (N, k, 2) places along the
    surface from it and of weights (N, k), count for the two slopes of a value at the point."""
    terms, held = along, np.zeros(2)
    if curved:
        size = np.maximum(np.abs(along).max(axis=(1, 2)), 1e-12)[:, None]
        u, v = along[:, :, 0], along[:, :, 1]
        terms = np.stack([u, v, u * u / size, u * v / size, v * v / size], axis=2)
        held = np.array([0, 0, *3 * [_HELD_MOVING]])
    system = np.einsum("nka,nk,nkb->nab", terms, weight, terms)
    spread = np.trace(system[:, :2, :2], axis1=1, axis2=2)[:, None, None]
    system += (_REGULAR * spread + 1e-12) * np.eye(len(held)) + spread * np.diag(held)
    return np.einsum("nka,nk,nab->nkb", terms, weight, np.linalg.inv(system)[:, :, :2])
