"""Full-field Gaussian prior in the span of the principal components (the paper's main prior)."""

from __future__ import annotations

import logging
import math
from typing import TYPE_CHECKING, Any, Self

import numpy as np
import torch
from torch import Tensor

from dine.errors import DataError
from dine.priors.base import PRIORS, Prior, Sample, check_sizes
from dine.priors.gaussian import LinearGaussian

if TYPE_CHECKING:
    from dine.config import PCAArguments

log = logging.getLogger(__name__)


@PRIORS.register("pca")
class PCAPrior(Prior):
    """p(D) = N(z; 0, Σ_reg) with z = Vᵀ(D − μ)/(σ + ε_σ), the vectorised field D in ℝ³ᴺ.

    The penalty is the paper's Mahalanobis distance zᵀ Σ_reg⁻¹ z (no factor ½). Whatever a field
    does outside the span of V costs nothing.

    Buffers: ``mean`` and ``scale`` (= σ + ε_σ), both (3N,), ``basis`` Vᵀ (n_c, 3N),
    ``covariance`` Σ_reg (n_c, n_c).
    """

    def __init__(self, points: int, components: int):
        check_sizes("pca", points=points, components=components)
        super().__init__(points=points, components=components)
        size = 3 * points
        self.register_buffer("mean", torch.zeros(size))
        self.register_buffer("scale", torch.ones(size))
        self.register_buffer("basis", torch.zeros(components, size))
        self.register_buffer("covariance", torch.eye(components))

    @classmethod
    def _fit(cls, sample: Sample, given: PCAArguments) -> Self:
        """Of the fields alone.

        K fields span at most K − 1 directions about their mean, so fewer components are kept when
        K is small; ``notes["components_requested"]`` then tells what was asked for.
        """
        return cls._of_span(sample.fields, given)

    @classmethod
    def _of_span(cls, fields: np.ndarray, given: PCAArguments, **shape: Any) -> Self:
        """The prior with span and latent covariance of the fields; ``shape`` goes to the class."""
        # Only fitting needs scikit-learn, which takes a while to import.
        from dine.extras import extras_needed

        with extras_needed():
            from sklearn.covariance import empirical_covariance, shrunk_covariance
            from sklearn.decomposition import PCA

        flat = fields.reshape(len(fields), -1)
        kept = min(given.components, len(flat) - 1, flat.shape[1])
        mean = flat.mean(axis=0)
        scale = flat.std(axis=0) + given.epsilon_std
        normalised = (flat - mean) / scale
        if not normalised.any():
            raise DataError("All displacement fields are equal; a prior cannot be fitted to them.")
        # Deterministic solvers: results must not depend on a random projection. With more fields
        # than coordinates, their covariance is the smaller matrix by far.
        solver = "full" if len(flat) <= flat.shape[1] else "covariance_eigh"
        pca = PCA(n_components=kept, svd_solver=solver).fit(normalised)
        latent = normalised @ pca.components_.T
        covariance = shrunk_covariance(empirical_covariance(latent), given.shrinkage)
        covariance += given.epsilon_covariance * np.eye(kept)

        prior = cls(points=fields.shape[1], components=kept, **shape)
        for name, value in (
            ("mean", mean),
            ("scale", scale),
            ("basis", pca.components_),
            ("covariance", covariance),
        ):
            getattr(prior, name).copy_(torch.from_numpy(np.ascontiguousarray(value)))
        prior.notes = {
            "samples": len(flat),
            "explained_variance": pca.explained_variance_.tolist(),
            "explained_variance_ratio": pca.explained_variance_ratio_.tolist(),
        }
        if kept < given.components:
            prior.notes["components_requested"] = given.components
            log.warning(
                "%d fields allow %d principal components; %d were asked for.",
                len(flat),
                kept,
                given.components,
            )
        return prior

    def check_size(self, displacement: Tensor) -> None:
        """Refuse fields of another number of points.

        Raises:
            DataError: they are not (B, N, 3) with the N of the fit.
        """
        if displacement.shape[1:] != (self.shape["points"], 3):
            raise DataError(
                f"The PCA prior was fitted to fields of {self.shape['points']} points; found a "
                f"field of shape {tuple(displacement.shape[1:])}."
            )

    def normalised(self, displacement: Tensor) -> Tensor:
        """Standardised coordinates (D − μ)/(σ + ε_σ), (B, N, 3) to (B, 3N)."""
        self.check_size(displacement)
        return (displacement.flatten(1) - self.mean) / self.scale

    def latent(self, displacement: Tensor) -> Tensor:
        """Latent coordinates z, (B, N, 3) to (B, n_c)."""
        return self.normalised(displacement) @ self.basis.T

    def whitened(self, latent: Tensor) -> Tensor:
        """L⁻¹z with the Cholesky factor of Σ_reg = LLᵀ, (B, n_c) to (B, n_c)."""
        factor = torch.linalg.cholesky(self.covariance)
        return torch.linalg.solve_triangular(factor, latent.T, upper=False).T

    def mahalanobis(self, displacement: Tensor) -> Tensor:
        """zᵀ Σ_reg⁻¹ z = ‖L⁻¹z‖², (B, N, 3) to (B,); n_c on average over the fields of the fit."""
        return self.whitened(self.latent(displacement)).T.square().sum(0)

    def residual(self, displacement: Tensor) -> Tensor:
        """‖D̃ − Vz‖² outside the span, in standardised coordinates, (B, N, 3) to (B,)."""
        normalised = self.normalised(displacement)
        return (normalised - normalised @ self.basis.T @ self.basis).square().sum(1)

    def projected(self, displacement: Tensor) -> Tensor:
        """The closest field of the span in standardised coordinates, (B, N, 3) to (B, N, 3)."""
        return self._field(self.latent(displacement) @ self.basis)

    def check_complete(self, mask: Tensor | None) -> None:
        """Refuse fields of which ``mask`` (B, N) leaves points out.

        Raises:
            DataError: it does.
        """
        if mask is not None and not mask.all():
            raise DataError("The PCA prior needs complete fields; it cannot skip points.")

    def penalty(
        self, displacement: Tensor, mask: Tensor | None = None, source: Tensor | None = None
    ) -> Tensor:
        self.check_complete(mask)
        return self.mahalanobis(displacement)

    def log_prob(self, displacement: Tensor, source: Tensor | None = None) -> Tensor:
        """Log density of the latent coordinates z."""
        factor = torch.linalg.cholesky(self.covariance)
        log_det = 2 * factor.diagonal().log().sum()
        constant = self.shape["components"] * math.log(2 * math.pi)
        return -0.5 * (self.mahalanobis(displacement) + log_det + constant)

    def sample(
        self,
        count: int,
        generator: torch.Generator | None = None,
        source: Tensor | None = None,
    ) -> Tensor:
        latent = self._draw_latent(self._noise(count, self.shape["components"], generator))
        return self._field(latent @ self.basis)

    def _noise(self, count: int, width: int, generator: torch.Generator | None) -> Tensor:
        """Standard normal numbers (count, width)."""
        like = {"generator": generator, "dtype": self.mean.dtype}
        return torch.randn(count, width, **like).to(self.mean.device)

    def _draw_latent(self, noise: Tensor) -> Tensor:
        """Latent coordinates from (count, n_c) standard normal numbers."""
        return noise @ torch.linalg.cholesky(self.covariance).T

    def _field(self, standardised: Tensor) -> Tensor:
        """Fields (B, N, 3) from standardised coordinates (B, 3N)."""
        return (self.mean + self.scale * standardised).view(len(standardised), -1, 3)

    def modes(self) -> np.ndarray:
        """Displacement per unit of each latent coordinate: (n_c, N, 3)."""
        return (self.basis * self.scale).view(-1, self.shape["points"], 3).numpy()

    def root(self) -> np.ndarray:
        """Displacement per unit of each whitened coordinate, σ ⊙ VL with Σ_reg = LLᵀ: (n_c, N, 3).

        In float64.
        """
        scale, basis, covariance = map(_exact, (self.scale, self.basis, self.covariance))
        modes = scale * (np.linalg.cholesky(covariance).T @ basis)
        return modes.reshape(-1, self.shape["points"], 3)

    def gaussian(self, source: np.ndarray) -> LinearGaussian:
        """Mean μ and modes σ ⊙ VL with Σ_reg = LLᵀ; the source (N, 3) only has to fit in length.

        Raises:
            DataError: the source has another number of points than the fields of the fit.
        """
        points = self.shape["points"]
        if len(source) != points:
            raise DataError(
                f"The PCA prior was fitted to fields of {points} points; found a source of "
                f"{len(source)}."
            )
        return LinearGaussian(
            _exact(self.mean).reshape(points, 3), self.root(), np.zeros((points, 0))
        )


def _exact(tensor: Tensor) -> np.ndarray:
    return tensor.detach().cpu().numpy().astype(np.float64)
