"""What is fixed of the search for a most probable field: two smooth processes, and outliers.

At test time (:mod:`dine.refinement.refine`) as in training (:mod:`dine.training.unrolled`).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from dine.priors.gaussian import CovarianceRoot, LinearGaussian, covariance_root

OUTLIERS = 0.1
"""Share of the target points that lie anywhere, and not near a moved source point."""
BOX = 8.0
"""Volume in which these lie, normalised frame."""


class Smoothness(NamedTuple):
    """A Gaussian process of displacements: widths and standard deviations, normalised frame.

    ``affine`` is the standard deviation of an affine part, ``least`` the smallest one of the
    distances between moved points and their targets; ``rank`` and ``tolerance`` are those of
    :func:`~dine.priors.gaussian.covariance_root`.
    """

    widths: tuple[float, ...]
    amplitudes: tuple[float, ...]
    affine: float
    least: float
    rank: int
    tolerance: float = 1e-4

    def fitted(self, points: np.ndarray) -> CovarianceRoot:
        """A root at (N, 3) points, which goes on to others."""
        return covariance_root(
            points,
            self.widths,
            self.amplitudes,
            self.affine,
            rank=self.rank,
            tolerance=self.tolerance,
        )

    def at(self, points: np.ndarray) -> LinearGaussian:
        """The prior of fields at (N, 3) points."""
        return LinearGaussian.of_kernel(self.fitted(points).root)


# Chosen on the validation pairs of both synthetic datasets (60) and on 40 resampled ones of the
# pretraining data.
STIFF = Smoothness((1.5, 0.4), (0.2, 0.04), 0.05, 0.01, 128)
LOOSE = Smoothness((1.5, 0.4, 0.25), (0.5, 0.2, 0.04), 0.5, 0.004, 200)
# These on every second of 23 real shapes with synthetic deformations (benchmarks/surfaces.py).
STIFFER = Smoothness((1.5, 0.5), (0.1, 0.02), 0.05, 0.01, 128)
STIFF_AND_BENT = Smoothness((1.5, 0.5), (0.2, 0.05), 0.1, 0.01, 128)
SURFACE = Smoothness((1.5, 0.5, 0.25), (0.5, 0.2, 0.04), 0.3, 0.004, 300, 1e-5)
# Of which each is taken where it makes what was found between surfaces more probable than the one
# before: how finely things move is not the same for a face as for an organ.
FINER = tuple(SURFACE._replace(widths=(1.5, 0.5, width)) for width in (0.18, 0.12))
