"""Distances between clouds, and of corresponding points.

Definitions, units and sources of all of them: docs/reference/metrics.md.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from dine.threads import available

# Fewer places are looked up before threads have begun.
_WORTH_SHARING = 2000


def nearest(
    tree: cKDTree, places: np.ndarray, k: int | list[int] = 1, within: float = np.inf
) -> tuple[np.ndarray, np.ndarray]:
    """Distances and indices of the points of a tree that are nearest to places (N, d), on the
    threads there are: (N,) each, or (N, j) where ``k`` lists j ranks.

    Farther than ``within`` nothing is found: infinity, and the number of points as the index.
    """
    workers = available() if len(places) >= _WORTH_SHARING else 1
    return tree.query(places, k, distance_upper_bound=within, workers=workers)


def distances(a: np.ndarray, b: np.ndarray | cKDTree) -> np.ndarray:
    """Distance (N,), not squared, of each of (N, 3) points to the nearest of (M, 3), or of those
    in a tree."""
    tree = b if isinstance(b, cKDTree) else cKDTree(b)
    return nearest(tree, a)[0]


def spacings(points: np.ndarray) -> np.ndarray:
    """Distance (N,) of each of (N, 3) points to the nearest other one."""
    return nearest(cKDTree(points), points, [2])[0][:, 0]


def distance_measures(*directions: np.ndarray) -> dict[str, float]:
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


def surface_distance(
    moved: np.ndarray, target: np.ndarray, *, shown: tuple[float, float] = (1.0, 1.0)
) -> dict[str, float]:
    """How far (N, 3) moved points are from (M, 3) target points, in their units.

    Named as in :func:`distance_measures`.

    Only the shares ``shown`` of the moved and of the target points count, the nearest ones: what
    the other scan does not show is not held against the result. A share of 0 leaves the direction
    out.
    """
    directions = []
    # From the target first: sums of floating-point numbers depend on their order.
    for points, others, share in ((target, moved, shown[1]), (moved, target, shown[0])):
        if share > 0:
            apart = distances(points, others)
            counted = max(1, round(share * len(apart)))
            directions.append(np.sort(apart)[:counted] if counted < len(apart) else apart)
    return distance_measures(*directions)


def chamfer(a: np.ndarray, b: np.ndarray) -> float:
    """Symmetric squared Chamfer distance of clouds (N, 3) and (M, 3), as the paper's L_CD."""
    return surface_distance(a, b)["chamfer"]


def landmark_errors(moved: np.ndarray, target: np.ndarray) -> dict[str, float]:
    """Mean and largest distance between corresponding landmarks (target registration error)."""
    errors = np.linalg.norm(moved - target, axis=1)
    return {"mean": float(errors.mean()), "max": float(errors.max())}
