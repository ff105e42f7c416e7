"""Many shapes of corresponding vertices in one frame (generalised Procrustes analysis)."""

from __future__ import annotations

import numpy as np

from dine.geometry.rigid import motion_between, transformed

_ITERATIONS = 100
_CONVERGED = 1e-10


def laid_onto(points: np.ndarray, others: np.ndarray, used: np.ndarray) -> np.ndarray:
    """(V, 3) points moved rigidly so that those of a mask (V,) have the least squared distances
    from the corresponding (V, 3) others (Kabsch)."""
    return transformed(points, motion_between(points[used], others[used]))


def centroid_size(points: np.ndarray) -> float:
    """Root of the summed squared distances of (V, 3) points from their mean."""
    return float(np.linalg.norm(points - points.mean(axis=0)))


def generalised_procrustes(
    shapes: np.ndarray, reference: np.ndarray, used: np.ndarray
) -> np.ndarray:
    """Shapes (K, V, 3) moved rigidly so that they lie as close to their mean as they can, which
    lies as the reference (V, 3) does.

    Each is laid onto the mean of all in turn until that no longer changes (Gower, 1975). Only
    the vertices of a mask (V,) count.
    """
    mean, size = reference, centroid_size(reference[used])
    for _ in range(_ITERATIONS):
        shapes = np.stack([laid_onto(shape, mean, used) for shape in shapes])
        # The mean of aligned shapes turns and drifts with none of them; it is held in place.
        after = laid_onto(shapes.mean(axis=0), reference, used)
        change, mean = float(np.linalg.norm((after - mean)[used])), after
        if change <= _CONVERGED * size:
            break
    return np.stack([laid_onto(shape, mean, used) for shape in shapes])
