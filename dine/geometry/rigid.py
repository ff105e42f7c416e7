"""Where source and target lie to each other: rigid alignment."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from dine.errors import DataError
from dine.geometry.distance import nearest
from dine.geometry.frame import Frame
from dine.geometry.oriented import evenly
from dine.threads import each

# A rigid motion must lower the mean squared distance this much, or deformations of round objects
# would pass for rotations; so must starts at other rotations, or symmetric objects would be turned.
_MUCH_BETTER = 0.5
# Points looked at where scans overlap, and at first of others.
_FEWER = 400
# Where scans overlap: distances, in median radii, that count a quarter, at first and last; rounds;
# how far motions that are the same are apart; and how many are given beside none.
_WIDE, _NARROW = 0.8, 0.1
_ROUNDS = 20
_ALIKE = 0.1
_TRIED = 6
# The change of the mean squared distance at which iterative closest points end.
_SETTLED = 1e-7
# Rounds on few points, and ways round that are then tried on all.
_FIRST_ROUNDS = 20
_TURNS = 2


def transformed(points: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    """(N, 3) points moved by a 4×4 matrix."""
    return points @ matrix[:3, :3].T + matrix[:3, 3]


@dataclass(frozen=True)
class Alignment:
    """A rigid motion of the source to the target, and the normalised frame there.

    Attributes:
        matrix: (4, 4) rotation and translation, from the source's coordinates to the target's.
        frame: of the aligned source, in the target's coordinates.
    """

    matrix: np.ndarray
    frame: Frame

    @classmethod
    def of(cls, points: np.ndarray, matrix: np.ndarray) -> Alignment:
        """That of (N, 3) source points which a matrix aligns.

        Raises:
            DataError: all points coincide.
        """
        return cls(matrix, Frame.of(transformed(points, matrix)))

    def align(self, points: np.ndarray) -> np.ndarray:
        """(N, 3) points of the source in the target's coordinates."""
        return transformed(points, self.matrix)

    def normalise(self, points: np.ndarray) -> np.ndarray:
        """(N, 3) points of the source in the frame; of the target: ``frame.normalise``."""
        return self.frame.normalise(self.align(points))

    def restore(self, points: np.ndarray) -> np.ndarray:
        """(N, 3) points of the frame in the target's coordinates, where moved points belong."""
        return self.frame.restore(points)

    def unalign(self, points: np.ndarray) -> np.ndarray:
        """(N, 3) points of the target's coordinates in the source's: undoes :meth:`align`."""
        return (points - self.matrix[:3, 3]) @ self.matrix[:3, :3]


def check_rigid(matrix: np.ndarray, name: str = "The given alignment") -> np.ndarray:
    """A 4×4 rotation and translation, as float64.

    Raises:
        DataError: another shape, or a matrix that scales, shears or mirrors.
    """
    matrix = np.asarray(matrix, dtype=np.float64)
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
        raise DataError(f"{name} has shape {matrix.shape}; expected a finite 4×4 matrix.")
    rotation = matrix[:3, :3]
    rigid = np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-4)
    if not rigid or np.linalg.det(rotation) < 0 or not np.allclose(matrix[3], [0, 0, 0, 1]):
        raise DataError(
            f"{name} is not a rotation and a translation; it scales, shears or mirrors. Scale the "
            "file itself instead."
        )
    return matrix


def rigid_alignment(source: np.ndarray, target: np.ndarray, *, partial: bool = False) -> np.ndarray:
    """The first of :func:`rigid_alignments`."""
    return rigid_alignments(source, target, partial=partial)[0]


def rigid_alignments(
    source: np.ndarray, target: np.ndarray, *, partial: bool = False
) -> list[np.ndarray]:
    """The 4×4 rigid motions that may bring (N, 3) source points onto (M, 3) target points.

    The one that fits best comes first. A second one turns the source less: what was deformed much
    can fit better the wrong way round, which shows only once it is deformed back.

    Iterative closest points from where the points are, from coinciding middles, and from
    coinciding principal axes; the last are taken only if they fit much better, since a symmetric
    object fits about as well the wrong way round. The identity is kept unless something fits much
    better.

    With ``partial`` the target is brought onto the source, of which it is a part, and the inverse
    is returned: every point of the part has a counterpart in the whole, but not the other way.
    """
    frame = _frame(source)
    a, b = frame.normalise(source), frame.normalise(target)
    if partial:
        motions = [np.linalg.inv(motion) for motion in _motions(b, a, both_ways=False)]
    else:
        motions = _motions(a, b, both_ways=True)
    return [_in_units(motion, frame) for motion in motions]


def overlapping_alignments(source: np.ndarray, target: np.ndarray) -> list[np.ndarray]:
    """4×4 rigid motions that may bring (N, 3) source points onto (M, 3) target points, of which
    each has some that the other lacks: no motion, and then those that fit best.

    Iterative closest points both ways, whose weights fall off with the distance (Geman and
    McClure), from no motion and from rotations that cover all evenly. Which of them is right shows
    only once the source is deformed, so several are given, no two alike.
    """
    frame = _frame(source)
    a, b = (frame.normalise(points) for points in (source, target))
    a, b = (points[evenly(points, _FEWER)] for points in (a, b))
    tree = cKDTree(b)
    found = each(lambda start: _robust(a, b, tree, start), _robust_starts(a, b))
    found.sort(key=lambda one: one[0])
    chosen = [np.eye(4)]
    for _, motion in found:
        apart = [np.linalg.norm(transformed(a, motion) - transformed(a, x), axis=1) for x in chosen]
        if len(chosen) <= _TRIED and min(x.mean() for x in apart) > _ALIKE:
            chosen.append(motion)
    return [_in_units(motion, frame) for motion in chosen]


def _frame(points: np.ndarray) -> Frame:
    """In which a tolerance means the same in metres: around the median of (N, 3) points."""
    centre = np.median(points, axis=0)
    return Frame(centre, float(np.median(np.linalg.norm(points - centre, axis=1))) or 1.0)


def _in_units(motion: np.ndarray, frame: Frame) -> np.ndarray:
    """A 4×4 motion within a frame as one of the original units."""
    motion[:3, 3] = frame.scale * motion[:3, 3] + frame.center - motion[:3, :3] @ frame.center
    return motion


def _robust_starts(a: np.ndarray, b: np.ndarray) -> Iterator[np.ndarray]:
    """No motion, coinciding middles, and middles turned by each of the 24 rotations of a cube, from
    the axes of the files and from the principal ones."""
    yield np.eye(4)
    turns = Rotation.create_group("O").as_matrix()
    for frame in (np.eye(3), _between_axes(a, b)[0]):
        for turn in turns:
            yield _between_middles(a, b, frame @ turn)


def _robust(
    a: np.ndarray, b: np.ndarray, tree: cKDTree, motion: np.ndarray
) -> tuple[float, np.ndarray]:
    """How badly what is found from a start fits, and the 4×4 motion."""
    for reach in np.geomspace(_WIDE, _NARROW, _ROUNDS):
        moved = transformed(a, motion)
        (there, to), (back, asked) = nearest(tree, moved), nearest(cKDTree(moved), b)
        ours = np.concatenate([np.arange(len(a)), asked])
        theirs = np.concatenate([to, np.arange(len(b))])
        squared = np.concatenate([there, back]) ** 2 / reach**2
        weight = 1 / (1 + squared) ** 2
        motion = motion_between(a[ours], b[theirs], weight)
    return float((squared / (1 + squared)).mean()), motion


def motion_between(a: np.ndarray, b: np.ndarray, weight: np.ndarray | None = None) -> np.ndarray:
    """The 4×4 rigid motion of least squared distances, weighted by (n,), of corresponding points
    (n, 3), which do not lie on a line (Kabsch)."""
    share = np.full(len(a), 1 / len(a)) if weight is None else weight / weight.sum()
    middle, other = share @ a, share @ b
    cross = (b - other).T @ (share[:, None] * (a - middle))
    left, _, right = np.linalg.svd(cross)
    # The last axis is turned where a mirror image would fit better.
    left[:, 2] *= np.sign(np.linalg.det(left) * np.linalg.det(right))
    motion = np.eye(4)
    motion[:3, :3] = left @ right
    motion[:3, 3] = other - motion[:3, :3] @ middle
    return motion


class _ClosestPoints:
    """Iterative closest points (Besl and McKay, 1992) from (N, 3) points to (M, 3) others."""

    def __init__(self, a: np.ndarray, b: np.ndarray, both_ways: bool):
        """``both_ways``: how well a motion fits is seen from both."""
        # In the order of a tree neighbours follow each other, and their neighbours are at hand.
        self.a, self.b, self.both_ways = a[cKDTree(a).indices], b, both_ways
        self.tree = cKDTree(b)

    def misfit(self, motion: np.ndarray) -> float:
        """Mean squared distance to the nearest other point after a 4×4 motion."""
        moved = transformed(self.a, motion)
        there = float((nearest(self.tree, moved)[0] ** 2).mean())
        if not self.both_ways:
            return there
        return there + float((nearest(cKDTree(moved), self.b)[0] ** 2).mean())

    def best(
        self, starts: Iterable[np.ndarray], count: int = 1, rounds: int = 60
    ) -> list[tuple[float, np.ndarray]]:
        """Misfits and 4×4 motions that some starts lead to, of those that fit best."""
        found = each(lambda start: self._improved(start, rounds), starts)
        return sorted(found, key=lambda one: one[0])[:count]

    def _improved(self, motion: np.ndarray, rounds: int) -> tuple[float, np.ndarray]:
        """What a start leads to, and its misfit."""
        before = np.inf
        for _ in range(rounds):
            closest = self.b[nearest(self.tree, transformed(self.a, motion))[1]]
            motion = motion_between(self.a, closest)
            apart = transformed(self.a, motion) - closest
            squared = float((apart**2).sum(axis=1).mean())
            if before - squared < _SETTLED:
                break
            before = squared
        return self.misfit(motion), motion


def _motions(a: np.ndarray, b: np.ndarray, *, both_ways: bool) -> list[np.ndarray]:
    search = _ClosestPoints(a, b, both_ways)
    best = (search.misfit(np.eye(4)), np.eye(4))
    [near] = search.best([np.eye(4), _between_middles(a, b, np.eye(3))])
    if near[0] < _MUCH_BETTER * best[0]:
        best = near
    turns = [_between_middles(a, b, rotation) for rotation in _between_axes(a, b)]
    # Which way round is worth a try shows on few points.
    few = _ClosestPoints(*(points[evenly(points, _FEWER)] for points in (a, b)), both_ways)
    [turned] = search.best(motion for _, motion in few.best(turns, _TURNS, _FIRST_ROUNDS))
    return [turned[1], best[1]] if turned[0] < _MUCH_BETTER * best[0] else [best[1]]


def _between_middles(a: np.ndarray, b: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    """The motion of this rotation that brings the middle of (N, 3) points to that of others."""
    motion = np.eye(4)
    motion[:3, :3] = rotation
    motion[:3, 3] = b.mean(axis=0) - rotation @ a.mean(axis=0)
    return motion


def _between_axes(a: np.ndarray, b: np.ndarray) -> list[np.ndarray]:
    """The four rotations that bring the principal axes of (N, 3) points onto those of others."""
    axes = [np.linalg.svd(x - x.mean(axis=0), full_matrices=False)[2] for x in (a, b)]
    rotations = []
    for signs in ((1, 1), (1, -1), (-1, 1), (-1, -1)):
        third = np.linalg.det(axes[1].T @ np.diag([*signs, 1.0]) @ axes[0])
        rotations.append(axes[1].T @ np.diag([*signs, np.sign(third)]) @ axes[0])
    return rotations
