"""A prior: every displacement vector is a draw from one Gaussian."""

import math
from typing import Self

import numpy as np
import torch
from torch import Tensor

from dine.geometry.chamfer import masked_mean
from dine.priors import Prior
from dine.priors.base import check_fields


class VectorGaussian(Prior):
    """Independent vectors from N(mean, LLᵀ); the penalty is their mean Mahalanobis distance².

    Buffers: ``mean`` (3,) and ``factor`` L (3, 3).
    """

    def __init__(self, points: int):
        super().__init__(points=points)  # stored with the buffers, to build the module again
        self.register_buffer("mean", torch.zeros(3))
        self.register_buffer("factor", torch.eye(3))

    @classmethod
    def fit(
        cls,
        fields: np.ndarray,
        *,
        seed: int = 0,
        source: np.ndarray | None = None,
        epsilon: float = 1e-6,
    ) -> Self:
        """Fit to (K, N, 3) fields; ``epsilon`` is added to the covariance's diagonal."""
        fields = check_fields(fields)
        vectors = fields.reshape(-1, 3)
        covariance = np.cov(vectors.T) + epsilon * np.eye(3)
        prior = cls(points=fields.shape[1])
        prior.mean.copy_(torch.from_numpy(vectors.mean(axis=0)))
        prior.factor.copy_(torch.from_numpy(np.linalg.cholesky(covariance)))
        prior.notes = {"vectors": len(vectors)}
        return prior.freeze()

    def _squared(self, displacement: Tensor) -> Tensor:
        """Squared Mahalanobis distance of each vector, (B, N, 3) to (B, N)."""
        offset = (displacement - self.mean).transpose(1, 2)
        return torch.linalg.solve_triangular(self.factor, offset, upper=False).square().sum(1)

    def penalty(
        self, displacement: Tensor, mask: Tensor | None = None, source: Tensor | None = None
    ) -> Tensor:
        return masked_mean(self._squared(displacement), mask)

    def log_prob(self, displacement: Tensor, source: Tensor | None = None) -> Tensor:
        constant = 1.5 * math.log(2 * math.pi) + self.factor.diagonal().log().sum()
        return -(0.5 * self._squared(displacement) + constant).sum(-1)

    def sample(
        self,
        count: int,
        generator: torch.Generator | None = None,
        source: Tensor | None = None,
    ) -> Tensor:
        noise = torch.randn(count, self.shape["points"], 3, generator=generator).to(self.mean)
        return self.mean + noise @ self.factor.T
