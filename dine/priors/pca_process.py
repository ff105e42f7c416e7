"""Full-field Gaussian prior: principal components, and a process for what they miss."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple, Self

import numpy as np
import torch
from torch import Tensor

from dine.config import GaussianProcessArguments, PCAProcessArguments
from dine.priors.base import PRIORS, Sample
from dine.priors.gaussian import LinearGaussian
from dine.priors.gaussian_process import Factor, GaussianProcessPrior
from dine.priors.pca import PCAPrior
from dine.priors.pca_residual import held_out_residuals
from dine.priors.sources import SourceCache, members, one_source, source_labels


class _Pair(NamedTuple):
    """Both parts of the covariance at n points.

    Attributes:
        process: of each coordinate (n) of what the components miss.
        modes: of all 3n coordinates whitened by ``process``: unit noise and the components.
    """

    process: Factor
    modes: Factor

    @property
    def log_det(self) -> Tensor:
        """() of the covariance of all 3n coordinates."""
        return 3 * self.process.log_det + self.modes.log_det

    def whiten(self, field: Tensor) -> Tensor:
        """(n, 3) to (n, 3) of unit covariance."""
        return self.modes.whiten(self.process.whiten(field).reshape(-1, 1)).view(-1, 3)

    def noise(self, field: Tensor) -> Tensor:
        """Mean (n, 3) of what is independent between the points, given the whole field (n, 3)."""
        # S²C⁻¹d with C⁻¹ = Wᵀ(whitening of the modes)²W and W = PS⁻¹, both P and that symmetric.
        twice = self.modes.whiten(self.whiten(field).reshape(-1, 1)).view(-1, 3)
        deviation = self.process.deviation
        return deviation * self.process.whiten(deviation * twice)


@PRIORS.register("pca_process")
class PCAProcessPrior(PCAPrior):
    """p(D | X) = N(D; μ, S V Σ_reg Vᵀ S + (K(X, X) + ε²I) ⊗ I₃), with S = diag(σ + ε_σ).

    One Gaussian of the whole field: the covariance in the span is that of :class:`PCAPrior`, and
    K + ε²I is a :class:`~dine.priors.gaussian_process.GaussianProcessPrior` on the field's own
    source, fitted to what principal components miss of fields held out. So a field may leave the
    span where that is smooth. The penalty is minus twice the log density without constants. The
    number of points is that of the fit; points that a mask leaves out are integrated over.

    A new source costs a singular value decomposition of 3N × n_c numbers besides the process's
    factor; both are kept for the last few sources, after which a field costs O(N (r + n_c)).

    Buffers: those of :class:`PCAPrior`, and of the process under ``process``.
    """

    conditional = True

    def __init__(self, points: int, components: int, widths: Sequence[float], rank: int):
        super().__init__(points, components)
        self.process = GaussianProcessPrior(widths, rank)
        self.shape.update(self.process.shape)
        self._pairs: SourceCache[_Pair] = SourceCache()

    @classmethod
    def _fit(cls, sample: Sample, given: PCAProcessArguments) -> Self:
        """The span of all fields, the process by folds.

        Fields of one source are held out together. The process is that of highest likelihood for
        what the components of the other folds miss, in the units of the fields. Where fewer than
        two fields can be held out, as with two fields altogether, no components are known, and it
        is fitted to the fields about their mean. ``notes["process"]`` are those of the process.
        """
        fields = sample.fields
        labels = source_labels(sample.source, len(fields))
        prior = cls._of_span(fields, given, widths=given.widths, rank=given.rank)
        missed = list(
            held_out_residuals(fields, given.components, labels, given.folds, sample.seed)
        )
        rows = np.concatenate([np.zeros(0, int), *(part.rows for part in missed)])
        if len(rows) < 2:
            rows, residual = np.arange(len(fields)), fields - fields.mean(axis=0)
        else:
            standard = np.concatenate([part.residual for part in missed])
            residual = fields.std(axis=0) * standard.reshape(-1, *fields.shape[1:])
        prior._fit_process(Sample(residual, sample.source[rows], sample.seed), given)
        return prior

    def _fit_process(self, missed: Sample, given: PCAProcessArguments) -> None:
        if missed.fields.any():
            own = given.model_dump(include=set(GaussianProcessArguments.model_fields))
            self.process = GaussianProcessPrior.fit(
                missed.fields, source=missed.source, seed=missed.seed, **own
            )
            self.notes["process"] = self.process.notes
        else:  # nothing is missed: only the least noise is left
            self.process.amplitudes.zero_()
            self.process.affine.zero_()
            self.process.noise.fill_(given.least_noise)

    def _pair(self, points: np.ndarray, valid: np.ndarray | None, like: Tensor) -> _Pair:
        """Both parts at points (n, 3), those at ``valid`` (N,) of the source."""
        key = None if valid is None else valid.tobytes()
        return self._pairs.get(
            points,
            (key, self.process.scales(), like.dtype, like.device),
            lambda: self._factorised(points, valid, like),
        )

    def _factorised(self, points: np.ndarray, valid: np.ndarray | None, like: Tensor) -> _Pair:
        rows = slice(None) if valid is None else valid
        process = self.process.factorised(points, torch.zeros((), dtype=torch.float64))
        modes = torch.from_numpy(self.root()[:, rows])
        # One column for each component and coordinate, so that all are whitened at once.
        columns = modes.permute(1, 0, 2).reshape(len(points), -1)
        whitened = process.whiten(columns).view(len(points), len(modes), 3).permute(0, 2, 1)
        root = whitened.reshape(3 * len(points), len(modes)).numpy()
        return _Pair(process.to(like), Factor.of_root(root, np.ones((len(root), 1)), like))

    def _members(
        self, displacement: Tensor, mask: Tensor | None, source: Tensor | None
    ) -> Iterator[tuple[Tensor, _Pair]]:
        """Each member of a batch without what ``mask`` leaves out: field minus mean, covariance."""
        self.check_size(displacement)
        batch = members(displacement, mask, source, self.registered_name)
        for index, (field, points) in enumerate(batch):
            valid = None if mask is None or mask[index].all() else mask[index].cpu().numpy()
            mean = self.mean.view(-1, 3)
            mean = mean if valid is None else mean[mask[index]]
            yield field - mean, self._pair(points, valid, field)

    def penalty(
        self, displacement: Tensor, mask: Tensor | None = None, source: Tensor | None = None
    ) -> Tensor:
        """Quadratic form of the field's Gaussian, (B, N, 3) to (B,); 3N on average.

        Points that ``mask`` leaves out are integrated over.
        """
        parts = self._members(displacement, mask, source)
        return torch.stack([pair.whiten(field).square().sum() for field, pair in parts])

    def log_prob(self, displacement: Tensor, source: Tensor | None = None) -> Tensor:
        """Log density of the field's 3N coordinates given its source."""
        values = []
        for field, pair in self._members(displacement, None, source):
            log_det = pair.log_det + field.numel() * math.log(2 * math.pi)
            values.append(-0.5 * (pair.whiten(field).square().sum() + log_det))
        return torch.stack(values)

    def sample(
        self,
        count: int,
        generator: torch.Generator | None = None,
        source: Tensor | None = None,
    ) -> Tensor:
        """Fields (count, N, 3) of the source (N, 3), noise included."""
        points = one_source(source, self.registered_name)
        self.check_size(torch.from_numpy(points)[None])
        inside = super().sample(count, generator)
        return inside + self.process.sample(count, generator, source)

    def smoothed(self, displacement: Tensor, source: Tensor | None = None) -> Tensor:
        """Mean of components and smooth part given the whole field (B, N, 3), without noise."""
        parts = self._members(displacement, None, source)
        return displacement - torch.stack([pair.noise(field) for field, pair in parts])

    def gaussian(self, source: np.ndarray) -> LinearGaussian:
        """The components as modes and the process, without ε, as kernel, at N points of a source.

        Raises:
            DataError: the source has another number of points than the fields of the fit.
        """
        span = super().gaussian(source)
        return LinearGaussian(span.mean, span.modes, self.process.gaussian(source).kernel)
