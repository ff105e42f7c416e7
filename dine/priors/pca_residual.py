"""Full-field Gaussian prior that is not blind outside the principal components."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any, NamedTuple, Self

import numpy as np
import torch
from torch import Tensor

from dine.config import PCAResidualArguments
from dine.priors.base import PRIORS, Sample
from dine.priors.gaussian import LinearGaussian
from dine.priors.pca import PCAPrior
from dine.priors.sources import held_out_folds, source_labels

LEAST_VARIANCE = 1e-4
"""Smallest σ²: a hundredth of each coordinate's standard deviation, squared."""


class Missed(NamedTuple):
    """What principal components miss of fields that were held out.

    Attributes:
        rows: (k,) indices of these fields.
        residual: (k, 3N) in the coordinates standardised over all fields.
        components: how many there were.
    """

    rows: np.ndarray
    residual: np.ndarray
    components: int


def held_out_residuals(
    fields: np.ndarray, components: int, labels: np.ndarray, folds: int, seed: int
) -> Iterator[Missed]:
    """What the principal components of the other folds miss of each fold's fields.

    The fields (K, N, 3) of the fit itself would give far too little: K − 1 components leave nothing
    of them. Folds are left out where the others do not have two fields.

    Args:
        fields: (K, N, 3).
        components: principal components, of which a fold may allow fewer.
        labels: (K,) fields with equal labels are held out together.
        folds: number of folds.
        seed: of the division into folds.
    """
    flat = fields.reshape(len(fields), -1)
    spread = flat.std(axis=0)
    unit = (flat - flat.mean(axis=0)) / np.where(spread > 0, spread, 1)
    for held in held_out_folds(labels, folds, seed):
        if np.count_nonzero(~held) < 2:
            continue
        centre = unit[~held].mean(axis=0)
        basis = np.linalg.svd(unit[~held] - centre, full_matrices=False)[2]
        basis = basis[: min(components, np.count_nonzero(~held) - 1)]
        offset = unit[held] - centre
        yield Missed(np.flatnonzero(held), offset - offset @ basis.T @ basis, len(basis))


def residual_variance(
    fields: np.ndarray, components: int, labels: np.ndarray, folds: int, seed: int
) -> float | None:
    """Mean square per remaining dimension of :func:`held_out_residuals`; None where none are."""
    total, dimensions = 0.0, 0
    for missed in held_out_residuals(fields, components, labels, folds, seed):
        total += np.square(missed.residual).sum()
        dimensions += missed.residual.size - len(missed.rows) * missed.components
    return float(total / dimensions) if dimensions else None


@PRIORS.register("pca_residual")
class PCAResidualPrior(PCAPrior):
    """Probabilistic PCA in the standardised coordinates D̃ (Tipping and Bishop, 1999).

    p(D̃) = N(z; 0, Σ_reg) · N(r; 0, σ²I) with z = VᵀD̃ as in :class:`PCAPrior` and the residual
    r = D̃ − Vz in the other 3N − n_c dimensions. The penalty is minus twice the log density without
    its constants, zᵀ Σ_reg⁻¹ z + ‖r‖²/σ².

    Buffers: those of :class:`PCAPrior` and ``variance`` σ² ().
    """

    def __init__(self, points: int, components: int, **shape: Any):
        super().__init__(points, components)
        self.shape.update(shape)
        self.register_buffer("variance", torch.ones(()))

    @classmethod
    def _fit(cls, sample: Sample, given: PCAResidualArguments) -> Self:
        """The span of all fields, σ² by cross-validation.

        Where the sources are given, fields of one source are held out together.
        ``notes["residual_variance"]`` has σ² before it is kept from falling below
        ``LEAST_VARIANCE``, and ``notes["residual_variance_in_sample"]`` what it would be without
        cross-validation.
        """
        prior = cls._of_span(sample.fields, given)
        labels = source_labels(sample.source, len(sample.fields))
        prior._fit_residual(sample.fields, labels, given.folds, sample.seed)
        return prior

    def _fit_residual(self, fields: np.ndarray, labels: np.ndarray, folds: int, seed: int) -> None:
        found = residual_variance(fields, self.shape["components"], labels, folds, seed)
        # Two fields leave nothing to hold out; then a residual is as likely as the fields' spread.
        self.variance.fill_(1.0 if found is None else max(found, LEAST_VARIANCE))
        squares = self.residual(torch.from_numpy(fields).to(self.mean))
        left = len(fields) * max(self._left_over(), 1)
        self.notes["residual_variance"] = found
        self.notes["residual_variance_in_sample"] = squares.sum().item() / left

    def _left_over(self) -> int:
        """Dimensions outside the span."""
        return 3 * self.shape["points"] - self.shape["components"]

    def penalty(
        self, displacement: Tensor, mask: Tensor | None = None, source: Tensor | None = None
    ) -> Tensor:
        self.check_complete(mask)
        normalised = self.normalised(displacement)
        latent = normalised @ self.basis.T
        residual = (normalised - latent @ self.basis).square().sum(1)
        return self._span_term(latent) + residual / self.variance

    def _span_term(self, latent: Tensor) -> Tensor:
        """Minus twice the log density of (B, n_c) latent coordinates, without constants."""
        return self.whitened(latent).square().sum(1)

    def log_prob(self, displacement: Tensor, source: Tensor | None = None) -> Tensor:
        """Log density of the whole field: of its 3N coordinates in the normalised frame."""
        log_det = 2 * torch.linalg.cholesky(self.covariance).diagonal().log().sum()
        log_det = log_det + self._left_over() * self.variance.log() + 2 * self.scale.log().sum()
        constant = 3 * self.shape["points"] * math.log(2 * math.pi)
        return -0.5 * (self.penalty(displacement) + log_det + constant)

    def sample(
        self,
        count: int,
        generator: torch.Generator | None = None,
        source: Tensor | None = None,
    ) -> Tensor:
        noise = self._noise(count, self.shape["components"], generator)
        field = self._noise(count, len(self.mean), generator)
        residual = self.variance.sqrt() * (field - field @ self.basis.T @ self.basis)
        return self._field(self._draw_latent(noise) @ self.basis + residual)

    def gaussian(self, source: np.ndarray) -> LinearGaussian:
        """As :meth:`PCAPrior.gaussian`: the span alone.

        The residual is white noise in 3N dimensions, which neither a few modes nor a kernel of low
        rank can represent; whoever uses this model has an observation noise of their own.
        """
        return super().gaussian(source)
