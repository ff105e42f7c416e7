"""How well a moved source fits, how close to the truth it is, and whether its field is of tissue.

Definitions, units and sources of all of them: docs/metrics.md.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

FAILURE = 0.1
"""Correspondence error in the normalised frame above which a point, or a pair by its mean, is lost:
5 % of the diameter of the source, which is 2 there."""
WITHIN = {"accuracy_2_5": 0.05, "accuracy_5": FAILURE}
"""Largest error of an accurate point by metric, in the normalised frame: 2.5 and 5 % of the
diameter."""

_NEIGHBOURS = 12
_RIDGE = 1e-3


def distances(a: np.ndarray, b: np.ndarray | cKDTree) -> np.ndarray:
    """Distance (N,), not squared, of each of (N, 3) points to the nearest of (M, 3), or of those
    in a tree."""
    tree = b if isinstance(b, cKDTree) else cKDTree(b)
    return tree.query(a)[0]


def agreement(*directions: np.ndarray) -> dict[str, float]:
    """Numbers of the nearest distances (N,), not squared, in one direction or in both.

    ``chamfer`` is the paper's symmetric sum of mean squared distances (squared units),
    ``chamfer_unsquared`` the sum of mean distances, ``hausdorff`` and ``hd95`` the larger of both
    directions' maximum and 95th percentile.
    """
    return {
        "chamfer": float(sum((d**2).mean() for d in directions)),
        "chamfer_unsquared": float(sum(d.mean() for d in directions)),
        "hd95": float(max(np.percentile(d, 95) for d in directions)),
        "hausdorff": float(max(d.max() for d in directions)),
    }


def fit(moved: np.ndarray, target: np.ndarray, *, partial: bool = False) -> dict[str, float]:
    """How well (N, 3) moved points fit (M, 3) target points, in their units; see ``agreement``.

    With ``partial`` only the distances from the target count: source regions that the target does
    not show are not held against the result.
    """
    directions = [distances(target, moved)]
    if not partial:
        directions.append(distances(moved, target))
    return agreement(*directions)


def chamfer(a: np.ndarray, b: np.ndarray) -> float:
    """Symmetric squared Chamfer distance of clouds (N, 3) and (M, 3), as the paper's L_CD."""
    return fit(a, b)["chamfer"]


def correspondence(moved: np.ndarray, target: np.ndarray) -> dict[str, float]:
    """Distances, not squared, of (N, 3) moved points from their true places (N, 3), normalised.

    ``mce``, ``mce_median`` and ``mce_p95`` are mean, median and 95th percentile over the points,
    ``accuracy_2_5`` and ``accuracy_5`` the shares with an error of at most 2.5 and 5 % of the
    diameter (0.05 and 0.1), ``far_points`` the share above 0.1.
    """
    errors = np.linalg.norm(moved - target, axis=1)
    median, p95 = np.percentile(errors, (50, 95))
    return {
        "mce": float(errors.mean()),
        "mce_median": float(median),
        "mce_p95": float(p95),
        **{name: float((errors <= limit).mean()) for name, limit in WITHIN.items()},
        "far_points": float((errors > FAILURE).mean()),
    }


def neighbourhoods(points: np.ndarray) -> np.ndarray:
    """Rows (N, k) of the 12 points nearest to each of (N, 3), or of all others where fewer."""
    count = min(_NEIGHBOURS + 1, len(points))
    return cKDTree(points).query(points, k=[*range(1, count + 1)])[1][:, 1:]


def folding(
    points: np.ndarray, displacement: np.ndarray, neighbours: np.ndarray | None = None
) -> float:
    """Share of neighbourhoods that a field turns inside out: determinant of I + ∇d not positive.

    The gradient of the displacement (N, 3) is fitted by least squares to the 12 nearest of the
    points (N, 3), whose ``neighbourhoods`` may be given. A small ridge settles the direction across
    the surface, along which neighbours do not differ, at no change.
    """
    if len(points) < 4:
        return 0.0
    x, d = _differences(points, displacement, neighbours)
    gram = x.transpose(0, 2, 1) @ x
    ridge = _RIDGE * np.trace(gram, axis1=1, axis2=2)[:, None, None] * np.eye(3)
    ridge += np.finfo(np.float64).tiny * np.eye(3)
    gradient = np.linalg.solve(gram + ridge, x.transpose(0, 2, 1) @ d)
    return float((np.linalg.det(np.eye(3) + gradient) <= 0).mean())


def roughness(
    points: np.ndarray, displacement: np.ndarray, neighbours: np.ndarray | None = None
) -> float:
    """Local strain of a field: root mean over points i and their neighbours j of
    ‖d_i − d_j‖² / ‖x_i − x_j‖².

    Without unit; 0 for a translation, of order s for a stretch by 1 + s. ``neighbours`` as in
    ``folding``. Points at one place have no strain between them and do not count.
    """
    x, d = _differences(points, displacement, neighbours)
    apart = (x**2).sum(axis=2)
    valid = apart > 0
    if not valid.any():
        return 0.0
    return float(np.sqrt(((d**2).sum(axis=2)[valid] / apart[valid]).mean()))


def _differences(
    points: np.ndarray, displacement: np.ndarray, neighbours: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray]:
    """Of places and displacements (N, k, 3) between points and their neighbours."""
    index = neighbourhoods(points) if neighbours is None else neighbours
    return points[index] - points[:, None], displacement[index] - displacement[:, None]


def landmark_errors(moved: np.ndarray, target: np.ndarray) -> dict[str, float]:
    """Mean and largest distance between corresponding landmarks (target registration error)."""
    errors = np.linalg.norm(moved - target, axis=1)
    return {"mean": float(errors.mean()), "max": float(errors.max())}
