"""Where source and target lie to each other: rigid alignment and the normalised frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import trimesh.registration
from scipy.spatial import cKDTree

from dine.errors import DataError

# A rigid motion must lower the mean squared distance this much, or deformations of round objects
# would pass for rotations; so must starts at other rotations, or symmetric objects would be turned.
_MUCH_BETTER = 0.5
_ICP = {"max_iterations": 60, "threshold": 1e-7, "scale": False, "reflection": False}


@dataclass(frozen=True)
class Frame:
    """original = normalised · scale + center.

    Attributes:
        center: (3,) mean of the source's points, in their units.
        scale: largest distance of one from the center, same units.
    """

    center: np.ndarray
    scale: float

    @classmethod
    def of(cls, points: np.ndarray) -> Frame:
        """The frame of (N, 3) source points.

        Raises:
            DataError: all points coincide.
        """
        center = points.mean(axis=0)
        scale = float(np.linalg.norm(points - center, axis=1).max())
        if not scale > 0:
            raise DataError("All points of the source coincide; expected the surface of an object.")
        return cls(center, scale)

    def normalise(self, points: np.ndarray) -> np.ndarray:
        return (points - self.center) / self.scale

    def restore(self, points: np.ndarray) -> np.ndarray:
        return points * self.scale + self.center


def transformed(points: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    """(N, 3) points moved by a 4×4 matrix."""
    return points @ matrix[:3, :3].T + matrix[:3, 3]


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

    Iterative closest points (trimesh) from where the points are, from coinciding middles, and from
    coinciding principal axes; the last are taken only if they fit much better, since a symmetric
    object fits about as well the wrong way round. The identity is kept unless something fits much
    better.

    With ``partial`` the target is brought onto the source, of which it is a part, and the inverse
    is returned: every point of the part has a counterpart in the whole, but not the other way.
    """
    if partial:
        return np.linalg.inv(_alignment(target, source, both_ways=False))
    return _alignment(source, target, both_ways=True)


def _alignment(a: np.ndarray, b: np.ndarray, *, both_ways: bool) -> np.ndarray:
    tree = cKDTree(b)

    def misfit(matrix: np.ndarray) -> float:
        moved = transformed(a, matrix)
        there = float((tree.query(moved)[0] ** 2).mean())
        return there + float((cKDTree(moved).query(b)[0] ** 2).mean()) if both_ways else there

    def improved(start: np.ndarray) -> tuple[float, np.ndarray]:
        matrix, _, _ = trimesh.registration.icp(a, b, initial=start, **_ICP)
        return misfit(matrix), matrix

    def shifted(rotation: np.ndarray) -> np.ndarray:
        start = np.eye(4)
        start[:3, :3] = rotation
        start[:3, 3] = b.mean(axis=0) - rotation @ a.mean(axis=0)
        return start

    axes = [np.linalg.svd(x - x.mean(axis=0), full_matrices=False)[2] for x in (a, b)]
    rotations = []
    for signs in ((1, 1), (1, -1), (-1, 1), (-1, -1)):
        third = np.linalg.det(axes[1].T @ np.diag([*signs, 1.0]) @ axes[0])
        rotations.append(axes[1].T @ np.diag([*signs, np.sign(third)]) @ axes[0])
    best = (misfit(np.eye(4)), np.eye(4))
    near = min(
        (improved(start) for start in (np.eye(4), shifted(np.eye(3)))), key=lambda found: found[0]
    )
    if near[0] < _MUCH_BETTER * best[0]:
        best = near
    turned = min((improved(shifted(r)) for r in rotations), key=lambda found: found[0])
    return turned[1] if turned[0] < _MUCH_BETTER * best[0] else best[1]
