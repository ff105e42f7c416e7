"""Gaussian fields in few dimensions: what a most probable field in closed form needs of a prior."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.distance import cdist


@dataclass(frozen=True)
class LinearGaussian:
    """Fields D = mean + Σ_k z_k modes_k + kernel · C, with all z and C independent N(0, 1).

    Attributes:
        mean: (N, 3).
        modes: (R, N, 3), whose amplitudes couple points and coordinates; R may be 0.
        kernel: (N, r) root of a covariance between points, which the three coordinates share
            without being correlated; r may be 0.
    """

    mean: np.ndarray
    modes: np.ndarray
    kernel: np.ndarray

    @classmethod
    def of_kernel(cls, kernel: np.ndarray) -> LinearGaussian:
        """Zero mean and no modes."""
        points = len(kernel)
        return cls(np.zeros((points, 3)), np.zeros((0, points, 3)), kernel)


def squared_exponential(
    a: np.ndarray,
    b: np.ndarray,
    widths: Sequence[float],
    amplitudes: Sequence[float],
    affine: float = 0.0,
) -> np.ndarray:
    """(N, M) covariance of one coordinate between points a (N, 3) and b (M, 3).

    Σ_m amplitude_m² exp(−‖a − b‖² / 2 width_m²) + affine² (a·b + 1): smooth motions at some widths
    on top of a random affine one, all in the units of the points.
    """
    squared = cdist(a, b, "sqeuclidean")
    total = affine**2 * (a @ b.T + 1)
    for width, amplitude in zip(widths, amplitudes, strict=True):
        total += amplitude**2 * np.exp(squared / (-2 * width**2))
    return total


def covariance_root(
    points: np.ndarray,
    widths: Sequence[float],
    amplitudes: Sequence[float],
    affine: float = 0.0,
    *,
    rank: int = 128,
    tolerance: float = 1e-4,
) -> np.ndarray:
    """(N, r) root L of :func:`squared_exponential` at points (N, 3), with L Lᵀ ≈ K.

    Pivoted Cholesky (Harbrecht, Peters and Schneider, 2012): each step takes the point that the
    earlier ones explain least, until the largest variance left is below ``tolerance`` times the
    largest at the start, or ``rank`` steps are done. N·r² operations, and r columns of K.
    """
    points = np.asarray(points, dtype=np.float64)
    left = affine**2 * ((points**2).sum(axis=1) + 1) + float(np.square(amplitudes).sum())
    enough = tolerance * left.max()
    root = np.zeros((len(points), min(rank, len(points))))
    for column in range(root.shape[1]):
        pivot = int(np.argmax(left))
        if left[pivot] <= enough:
            return root[:, :column]
        row = squared_exponential(points, points[pivot : pivot + 1], widths, amplitudes, affine)
        known = root[:, :column]
        root[:, column] = (row[:, 0] - known @ known[pivot]) / np.sqrt(left[pivot])
        left = np.maximum(left - root[:, column] ** 2, 0)
    return root
