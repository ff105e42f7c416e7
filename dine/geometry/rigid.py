"""Where source and target lie to each other: rigid alignment."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import trimesh.registration
from scipy.spatial import cKDTree

from dine.errors import DataError
from dine.geometry.frame import Frame

# A rigid motion must lower the mean squared distance this much, or deformations of round objects
# would pass for rotations; so must starts at other rotations, or symmetric objects would be turned.
_MUCH_BETTER = 0.5
_KEPT = 0.75
_SOME = 300
_ITERATIONS = 60
_SETTLED = 1e-5


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
    """The 4×4 rigid motion that brings (N, 3) source points onto (M, 3) target points.

    Trimmed iterative closest points, both ways, from where the points are, from coinciding middles,
    and from coinciding principal axes; the last are taken only if they fit much better, since a
    symmetric object fits about as well the wrong way round. The identity is kept unless something
    fits much better. The farthest quarter of the distances counts for nothing, as it may belong to
    what one of the two lacks (Chetverikov et al., 2005, Image and Vision Computing 23).

    With ``partial`` the target is brought onto the source, of which it is a part, and the inverse
    is returned: every point of the part has a counterpart in the whole, but not the other way.
    """
    # In units of the object, so that nothing depends on those of the file.
    centre = np.median(source, axis=0)
    size = float(np.median(np.linalg.norm(source - centre, axis=1))) or 1.0
    a, b = ((points - centre) / size for points in (source, target))
    if partial:
        motion = np.linalg.inv(_best_motion(b, a, both_ways=False))
    else:
        motion = _best_motion(a, b, both_ways=True)
    motion[:3, 3] = size * motion[:3, 3] + centre - motion[:3, :3] @ centre
    return motion


def _best_motion(a: np.ndarray, b: np.ndarray, *, both_ways: bool) -> np.ndarray:
    # Where it ends is found with some of the points, and where exactly with all.
    some = _Matching(*(x[:: max(1, len(x) // _SOME)] for x in (a, b)), both_ways)

    def best_of(starts: Iterable[np.ndarray]) -> tuple[float, np.ndarray]:
        return min((some.improved(start) for start in starts), key=lambda result: result[0])

    best = (some.misfit(np.eye(4)), np.eye(4))
    near = best_of([np.eye(4), _between_middles(a, b, np.eye(3))])
    if near[0] < _MUCH_BETTER * best[0]:
        best = near
    turned = best_of(_between_middles(a, b, rotation) for rotation in _between_axes(a, b))
    if turned[0] < _MUCH_BETTER * best[0]:
        best = turned
    if (best[1] == np.eye(4)).all():
        return best[1]
    return _Matching(a, b, both_ways).improved(best[1])[1]


class _Matching:
    """Nearest points of (N, 3) points a, once moved, and (M, 3) points b; in one or both ways."""

    def __init__(self, a: np.ndarray, b: np.ndarray, both_ways: bool):
        self.a, self.b, self.both_ways = a, b, both_ways
        self.tree = cKDTree(b)

    def pairs(self, matrix: np.ndarray) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
        """For each way the distances of the nearest three quarters, and their indices in a, b."""
        moved = transformed(self.a, matrix)
        distance, there = self.tree.query(moved)
        found = [(distance, np.arange(len(moved)), there)]
        if self.both_ways:
            distance, back = cKDTree(moved).query(self.b)
            found.append((distance, back, np.arange(len(self.b))))
        return [_nearest(*way) for way in found]

    def misfit(self, matrix: np.ndarray) -> float:
        return sum(float((distance**2).mean()) for distance, _, _ in self.pairs(matrix))

    def improved(self, matrix: np.ndarray) -> tuple[float, np.ndarray]:
        """The misfit where iterative closest points end, and the motion there."""
        for _ in range(_ITERATIONS):
            ways = self.pairs(matrix)
            ours, theirs = (np.concatenate([way[side] for way in ways]) for side in (1, 2))
            last = matrix
            matrix, _, _ = trimesh.registration.procrustes(
                self.a[ours], self.b[theirs], reflection=False, scale=False
            )
            if np.abs(matrix - last).max() < _SETTLED:
                break
        return self.misfit(matrix), matrix


def _nearest(*columns: np.ndarray) -> tuple[np.ndarray, ...]:
    """The rows whose first column, a distance, is among the smallest."""
    kept = np.argsort(columns[0], kind="stable")[: max(3, round(_KEPT * len(columns[0])))]
    return tuple(column[kept] for column in columns)


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
