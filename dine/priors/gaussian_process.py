"""Gaussian-process prior: fields of any source, from how far apart its points are."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple, Self

import numpy as np
import torch
from scipy.linalg import lapack
from scipy.optimize import minimize
from scipy.spatial.distance import cdist
from threadpoolctl import threadpool_limits
from torch import Tensor

from dine.config import GaussianProcessArguments
from dine.errors import ConfigError, DataError
from dine.priors.base import PRIORS, Prior, Sample, check_sizes
from dine.priors.gaussian import LinearGaussian, covariance_root
from dine.priors.sources import (
    SourceCache,
    members,
    one_source,
    source_labels,
)

_TOLERANCE = 1e-6  # of the largest variance: where a root counts as exact


class Factor(NamedTuple):
    """Covariance of n numbers, S(I + U diag(s²) Uᵀ)S with S = diag(deviation).

    Attributes:
        deviation: (n, 1) standard deviation of what is independent between them.
        basis: U (n, r), orthonormal columns.
        strength: s² (r,).
        log_det: () of the covariance.
    """

    deviation: Tensor
    basis: Tensor
    strength: Tensor
    log_det: Tensor

    @classmethod
    def of_root(cls, root: np.ndarray, deviation: np.ndarray, like: Tensor) -> Factor:
        """Of the covariance LLᵀ + S² with root L (n, r), in dtype and on device of ``like``."""
        # Small, and the same with any number of threads.
        with threadpool_limits(1, user_api="blas"):
            basis, singular, _ = np.linalg.svd(root / deviation, full_matrices=False)
        log_det = 2 * np.log(deviation).sum() + np.log1p(singular**2).sum()
        return cls(
            *(torch.from_numpy(a).to(like) for a in (deviation, basis, singular**2)),
            torch.tensor(log_det).to(like),
        )

    def to(self, like: Tensor) -> Factor:
        """The same in dtype and on device of ``like``."""
        return Factor(*(tensor.to(like) for tensor in self))

    def whiten(self, field: Tensor) -> Tensor:
        """Columns (n, c) to (n, c) of unit covariance: squares to sum up, of which none cancel."""
        scaled = field / self.deviation
        shrink = 1 - (1 + self.strength).rsqrt()
        return scaled - self.basis @ (shrink[:, None] * (self.basis.T @ scaled))


@PRIORS.register("gaussian_process")
class GaussianProcessPrior(Prior):
    """p(D | X) = Π_c N(D_c; 0, K(X, X) + ε²I), the three coordinates c of D independent.

    K is :func:`dine.priors.gaussian.squared_exponential`: smooth motions at fixed widths with
    fitted amplitudes on top of a random affine motion; ε is what the points do independently. The
    points X are those of the field's own source, so the number of points and their order are free.

    A field of N points costs O(N r): K is replaced by ΦΦᵀ plus the diagonal of what the root Φ
    (N, r), a pivoted Cholesky factor, leaves out, so that every point keeps its variance (the fully
    independent training conditional of Snelson and Ghahramani, 2006, with the pivots as inducing
    points). Everything here follows from that model; with r = N it is exact. The factors of the
    last few sources are kept. The penalty is minus twice the log density without constants.

    Buffers: ``amplitudes`` (M,), one for each width; ``affine`` () and ``noise`` ε ().
    """

    conditional = True

    def __init__(self, widths: Sequence[float], rank: int):
        check_sizes("gaussian_process", rank=rank)
        if not all(isinstance(width, int | float) and 0 < width < math.inf for width in widths):
            raise ConfigError(f"The widths of the process are {widths!r}; expected positive ones.")
        super().__init__(widths=list(widths), rank=rank)
        self.register_buffer("amplitudes", torch.ones(len(widths)))
        self.register_buffer("affine", torch.ones(()))
        self.register_buffer("noise", torch.ones(()))
        self._factors: SourceCache[Factor] = SourceCache()

    @classmethod
    def _fit(cls, sample: Sample, given: GaussianProcessArguments) -> Self:
        """Amplitudes and noise of highest likelihood.

        Seven numbers or so need no more than a part of the data: at most ``points`` points of each
        field, evenly spaced by index, and the fields of at most ``sources`` different sources,
        drawn by the seed. ``notes["nll_per_coordinate"]`` is the negative log-likelihood of these
        per coordinate.
        """
        fields, source, seed = sample
        if not fields.any():
            raise DataError("All displacement fields are zero; a prior cannot be fitted to them.")
        points = min(given.points, fields.shape[1])
        few = np.linspace(0, fields.shape[1] - 1, points).round().astype(int)
        labels = source_labels(source, len(fields))
        chosen = np.random.default_rng(seed).permutation(np.unique(labels))[: given.sources]
        groups = []
        for label in np.sort(chosen):
            rows = np.flatnonzero(labels == label)
            # All coordinates of all fields of a source are draws from the same Gaussian.
            values = fields[rows][:, few].transpose(1, 0, 2).reshape(len(few), -1)
            groups.append((source[rows[0], few], values))
        fitted, nll = _most_likely(groups, given.widths, given.least_noise)

        prior = cls(widths=given.widths, rank=given.rank)
        prior.amplitudes.copy_(torch.from_numpy(fitted[:-2]))
        prior.affine.fill_(fitted[-2])
        prior.noise.fill_(fitted[-1])
        prior.notes = {
            "samples": len(fields),
            "sources": len(np.unique(labels)),
            "sources_used": len(groups),
            "points_used": len(few),
            "nll_per_coordinate": nll,
            "amplitudes": fitted[:-2].tolist(),
            "affine": float(fitted[-2]),
            "noise": float(fitted[-1]),
        }
        return prior

    def scales(self) -> tuple[tuple[float, ...], float, float]:
        """Amplitudes, affine amplitude and noise as plain numbers."""
        return tuple(self.amplitudes.tolist()), self.affine.item(), self.noise.item()

    def factorised(self, points: np.ndarray, like: Tensor) -> Factor:
        """The covariance of one coordinate at points (n, 3), in dtype and on device of ``like``."""
        points = np.asarray(points, dtype=np.float64)
        widths, rank = self.shape["widths"], self.shape["rank"]
        amplitudes, affine, noise = self.scales()
        fitted = covariance_root(
            points, widths, amplitudes, affine, rank=rank, tolerance=_TOLERANCE
        )
        root = fitted.root
        variance = affine**2 * ((points**2).sum(axis=1) + 1) + float(np.square(amplitudes).sum())
        left_out = np.maximum(variance - np.square(root).sum(axis=1), 0)
        return Factor.of_root(root, np.sqrt(left_out + noise**2)[:, None], like)

    def _factor(self, points: np.ndarray, like: Tensor) -> Factor:
        """The same, kept for the sources last seen."""
        return self._factors.get(
            points,
            (self.scales(), like.dtype, like.device),
            lambda: self.factorised(points, like),
        )

    def penalty(
        self, displacement: Tensor, mask: Tensor | None = None, source: Tensor | None = None
    ) -> Tensor:
        """Quadratic form of the field's Gaussian, (B, N, 3) to (B,); 3N on average.

        Points that ``mask`` leaves out are integrated over.
        """
        return torch.stack(
            [
                self._factor(points, field).whiten(field).square().sum()
                for field, points in members(displacement, mask, source, self.registered_name)
            ]
        )

    def log_prob(self, displacement: Tensor, source: Tensor | None = None) -> Tensor:
        """Log density of the field's 3N coordinates given its source."""
        values = []
        for field, points in members(displacement, None, source, self.registered_name):
            factor = self._factor(points, field)
            log_det = factor.log_det + len(points) * math.log(2 * math.pi)
            values.append(-0.5 * (factor.whiten(field).square().sum() + 3 * log_det))
        return torch.stack(values)

    def sample(
        self,
        count: int,
        generator: torch.Generator | None = None,
        source: Tensor | None = None,
    ) -> Tensor:
        """Fields (count, N, 3) of the source (N, 3), noise included."""
        points = one_source(source, self.registered_name)
        factor = self._factor(points, self.amplitudes)
        like = {"generator": generator, "dtype": self.amplitudes.dtype}
        latent = torch.randn(count, len(factor.strength), 3, **like).to(self.amplitudes.device)
        noise = torch.randn(count, len(points), 3, **like).to(self.amplitudes.device)
        smooth = factor.basis @ (factor.strength.sqrt()[:, None] * latent)
        return factor.deviation * (smooth + noise)

    def smoothed(self, displacement: Tensor, source: Tensor | None = None) -> Tensor:
        """Mean of the smooth part given the whole field (B, N, 3): what is left without noise."""
        means = []
        for field, points in members(displacement, None, source, self.registered_name):
            factor = self._factor(points, field)
            kept = factor.strength / (1 + factor.strength)
            latent = kept[:, None] * (factor.basis.T @ (field / factor.deviation))
            means.append(factor.deviation * (factor.basis @ latent))
        return torch.stack(means)

    def gaussian(self, source: np.ndarray) -> LinearGaussian:
        """The smooth part, without ε, at the points (N, 3) of a source."""
        amplitudes, affine, _ = self.scales()
        return LinearGaussian.of_kernel(
            covariance_root(
                source, self.shape["widths"], amplitudes, affine, rank=self.shape["rank"]
            ).root
        )


def _most_likely(
    groups: list[tuple[np.ndarray, np.ndarray]], widths: Sequence[float], least_noise: float
) -> tuple[np.ndarray, float]:
    """Amplitudes at the widths, of the affine part and of the noise that maximise the likelihood.

    The covariance is linear in their squares θ with known matrices B: for c draws Y of n points,
    ∂/∂θ_m of the negative log-likelihood is ½ Σ (c·K⁻¹ − K⁻¹YYᵀK⁻¹) ∘ B_m. Minimised over log θ
    by L-BFGS-B, whose bounds keep amplitudes from running to zero and ε above ``least_noise``.

    Args:
        groups: for each source its points (n, 3) and draws (n, c).
        widths: (M,).
        least_noise: the smallest ε.

    Returns:
        (M + 2,) amplitudes, and the negative log-likelihood per number.
    """
    parts = []
    for points, _ in groups:
        squared = cdist(points, points, "sqeuclidean")
        smooth = [np.exp(squared / (-2 * width**2)) for width in widths]
        parts.append(np.stack([*smooth, points @ points.T + 1, np.eye(len(points))]))
    numbers = sum(values.size for _, values in groups)
    overall = math.sqrt(sum(np.square(values).sum() for _, values in groups) / numbers)

    def objective(log_variance: np.ndarray) -> tuple[float, np.ndarray]:
        variance = np.exp(log_variance)
        total, slope = 0.0, np.zeros(len(variance))
        for (_, values), matrices in zip(groups, parts, strict=True):
            covariance = np.tensordot(variance, matrices, axes=1)
            # Symmetric: the order of the axes only decides whether LAPACK has to copy.
            factor, fault = lapack.dpotrf(covariance.T, lower=1, overwrite_a=1, clean=1)
            if fault:
                raise DataError("A covariance of the Gaussian process is not positive definite.")
            total += values.shape[1] * np.log(factor.diagonal()).sum()
            inverse, _ = lapack.dpotri(factor, lower=1)
            inverse = np.tril(inverse) + np.tril(inverse, -1).T
            weights = inverse @ values
            total += 0.5 * np.vdot(values, weights)
            excess = values.shape[1] * inverse - weights @ weights.T
            slope += 0.5 * matrices.reshape(len(matrices), -1) @ excess.ravel()
        return total / numbers, slope * variance / numbers

    least = np.full(len(widths) + 2, (1e-3 * overall) ** 2)
    least[-1] = least_noise**2
    most = np.full(len(least), (100 * max(overall, least_noise)) ** 2)
    start = np.full(len(least), overall**2 / (len(widths) + 1))
    start[-1] = (0.1 * overall) ** 2
    bounds = np.log(np.column_stack([least, most]))
    with threadpool_limits(1, user_api="blas"):  # small systems, many of them
        found = minimize(
            objective,
            np.clip(np.log(start), *bounds.T),
            jac=True,
            method="L-BFGS-B",
            bounds=bounds,
            options={"maxiter": 60, "ftol": 1e-8},
        )
    return np.exp(found.x / 2), float(found.fun) + 0.5 * math.log(2 * math.pi)
