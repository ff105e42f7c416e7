"""Whether a displacement field is one of tissue: what it turns inside out, and its local strain.

Definitions, units and sources of all of them: docs/reference/metrics.md.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from dine.geometry.distance import nearest

_NEIGHBOURS = 12
_RIDGE = 1e-3


def neighbourhoods(points: np.ndarray) -> np.ndarray:
    """Rows (N, k) of the 12 points nearest to each of (N, 3), or of all others where fewer."""
    count = min(_NEIGHBOURS + 1, len(points))
    return nearest(cKDTree(points), points, [*range(1, count + 1)])[1][:, 1:]


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
