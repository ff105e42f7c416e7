"""Numbers that say how well a moved source fits, and whether its field is one of soft tissue."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

_NEIGHBOURS = 12
_RIDGE = 1e-3


def distances(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Distance, not squared, of each of (N, 3) points to the nearest of (M, 3)."""
    return cKDTree(b).query(a)[0]


def fit(moved: np.ndarray, target: np.ndarray, *, partial: bool = False) -> dict[str, float]:
    """How well (N, 3) moved points fit (M, 3) target points, in their units.

    ``chamfer`` is the paper's symmetric sum of mean squared distances (squared units),
    ``chamfer_unsquared`` the sum of mean distances, ``hausdorff`` and ``hd95`` the larger of both
    directions' maximum and 95th percentile. With ``partial`` only the distances from the target
    count: source regions that the target does not show are not held against the result.
    """
    directions = [distances(target, moved)]
    if not partial:
        directions.append(distances(moved, target))
    return {
        "chamfer": float(sum((d**2).mean() for d in directions)),
        "chamfer_unsquared": float(sum(d.mean() for d in directions)),
        "hd95": float(max(np.percentile(d, 95) for d in directions)),
        "hausdorff": float(max(d.max() for d in directions)),
    }


def folding(points: np.ndarray, displacement: np.ndarray) -> float:
    """Share of neighbourhoods that a field turns inside out: determinant of I + ∇d not positive.

    The gradient of the displacement (N, 3) is fitted by least squares to the 12 nearest of the
    points (N, 3). A small ridge settles the direction across the surface, along which neighbours do
    not differ, at no change.
    """
    count = min(_NEIGHBOURS + 1, len(points))
    if count < 4:
        return 0.0
    index = cKDTree(points).query(points, k=count)[1][:, 1:]
    x = points[index] - points[:, None]
    d = displacement[index] - displacement[:, None]
    gram = np.einsum("nki,nkj->nij", x, x)
    ridge = _RIDGE * np.trace(gram, axis1=1, axis2=2)[:, None, None] * np.eye(3)
    ridge += np.finfo(np.float64).tiny * np.eye(3)
    gradient = np.linalg.solve(gram + ridge, np.einsum("nki,nkj->nij", x, d))
    return float((np.linalg.det(np.eye(3) + gradient) <= 0).mean())


def landmark_errors(moved: np.ndarray, target: np.ndarray) -> dict[str, float]:
    """Mean and largest distance between corresponding landmarks (target registration error)."""
    errors = np.linalg.norm(moved - target, axis=1)
    return {"mean": float(errors.mean()), "max": float(errors.max())}
