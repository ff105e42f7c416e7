"""Smoothness prior: neighbours move alike. Nothing but its scale is learned; the plain control."""

from __future__ import annotations

import math
from typing import NamedTuple, Self

import numpy as np
import torch
from scipy.linalg import eigh
from torch import Tensor

from dine.config import SmoothnessArguments
from dine.errors import ConfigError, DataError
from dine.geometry.graph import neighbour_graph
from dine.priors.base import PRIORS, Prior, Sample, check_sizes
from dine.priors.gaussian import LinearGaussian
from dine.priors.sources import SourceCache, members, one_source, source_labels

TYPICAL = 64.0
"""The penalty's mean over the fields of the fit: what 64 principal components cost."""

_LEAST_LENGTH = 1e-4  # squared, as a share of the mean squared edge: for points that coincide


class _Edges(NamedTuple):
    """Every edge of a source's graph once: its ends (E,) and its weight (E,), 1/(E·length²)."""

    head: Tensor
    tail: Tensor
    weight: Tensor

    def roughness(self, field: Tensor) -> Tensor:
        """Mean over the edges of ‖d_i − d_j‖²/‖x_i − x_j‖², (n, 3) to ()."""
        difference = field.index_select(0, self.head) - field.index_select(0, self.tail)
        return (self.weight * difference.square().sum(1)).sum()

    def laplacian(self, points: int) -> np.ndarray:
        """(n, n) matrix L with roughness = tr(DᵀLD)."""
        head, tail = self.head.cpu().numpy(), self.tail.cpu().numpy()
        weight = self.weight.cpu().double().numpy()
        matrix = np.zeros((points, points))
        matrix[head, tail] = -weight
        matrix[tail, head] = -weight
        matrix[np.diag_indices(points)] = -matrix.sum(axis=1)
        return matrix


def _edges(points: np.ndarray, neighbours: int, like: Tensor) -> _Edges:
    """Edges between points (n, 3), in dtype and on device of ``like``."""
    graph = neighbour_graph(points, neighbours)
    once = graph.head < graph.tail
    head, tail = graph.head[once], graph.tail[once]
    squared = np.square(points[head] - points[tail]).sum(axis=1, dtype=np.float64)
    if len(squared):
        squared = np.maximum(squared, max(_LEAST_LENGTH * squared.mean(), np.finfo(float).tiny))
    weight = torch.from_numpy(1 / (max(len(squared), 1) * squared))
    return _Edges(head.to(like.device), tail.to(like.device), weight.to(like))


@PRIORS.register("smoothness")
class SmoothnessPrior(Prior):
    """An elastic net on the source's neighbour graph, anchored weakly where it is.

    With the roughness R(D | X), the mean over the edges of the symmetrised graph of nearest
    neighbours of ‖d_i − d_j‖²/‖x_i − x_j‖², and the magnitude M(D) = mean_i ‖d_i‖², the penalty is

        64 [(1 − w) R/R̄ + w M/M̄],

    where R̄ and M̄ are means over the fields of the fit, whose own mean is therefore 64. The first
    term leaves translations free; the second, weak one makes the density proper: with the graph
    Laplacian L, R = tr(DᵀLD), that is a Gaussian whose three coordinates are independent with
    precision P = 3N [(1 − w) L/R̄ + w I/(N M̄)], the scale of highest likelihood. Its quadratic form
    is 3N/64 times the penalty.

    Buffers: ``roughness`` R̄ () and ``magnitude`` M̄ ().
    """

    conditional = True

    def __init__(self, neighbours: int, anchor: float):
        check_sizes("smoothness", neighbours=neighbours)
        if not (isinstance(anchor, float) and 0 < anchor < 1):
            raise ConfigError(f"The anchor of the smoothness prior is {anchor!r}; expected 0 to 1.")
        super().__init__(neighbours=neighbours, anchor=anchor)
        self.register_buffer("roughness", torch.ones(()))
        self.register_buffer("magnitude", torch.ones(()))
        self._graphs: SourceCache[_Edges] = SourceCache()

    @classmethod
    def _fit(cls, sample: Sample, given: SmoothnessArguments) -> Self:
        """The scale of the fields; those that only translate are refused."""
        fields, source, _ = sample
        neighbours = given.neighbours
        prior = cls(neighbours=neighbours, anchor=given.anchor)
        labels = source_labels(source, len(fields))
        exact = torch.zeros((), dtype=torch.float64)
        roughness = np.zeros(len(fields))
        for label in np.unique(labels):
            rows = np.flatnonzero(labels == label)
            edges = _edges(source[rows[0]], neighbours, exact)
            for row in rows:
                roughness[row] = edges.roughness(torch.from_numpy(fields[row]))
        magnitude = np.square(fields).sum(axis=2).mean(axis=1)
        # Rounding alone leaves a little roughness in a translation.
        if roughness.mean() <= 1e-12 * magnitude.mean():
            raise DataError("No displacement field bends or stretches; a prior cannot be fitted.")
        prior.roughness.fill_(roughness.mean())
        prior.magnitude.fill_(magnitude.mean())
        prior.notes = {
            "samples": len(fields),
            "sources": len(np.unique(labels)),
            "roughness": float(roughness.mean()),
            "magnitude": float(magnitude.mean()),
        }
        return prior

    def _graph(self, points: np.ndarray, like: Tensor) -> _Edges:
        neighbours = self.shape["neighbours"]
        return self._graphs.get(
            points, (like.dtype, like.device), lambda: _edges(points, neighbours, like)
        )

    def penalty(
        self, displacement: Tensor, mask: Tensor | None = None, source: Tensor | None = None
    ) -> Tensor:
        """The energy, (B, N, 3) to (B,); that of the remaining cloud where ``mask`` is False."""
        anchor = self.shape["anchor"]
        values = []
        for field, points in members(displacement, mask, source, self.registered_name):
            rough = self._graph(points, field).roughness(field) / self.roughness
            far = field.square().sum(1).mean() / self.magnitude
            values.append(TYPICAL * ((1 - anchor) * rough + anchor * far))
        return torch.stack(values)

    def precision(self, points: np.ndarray) -> np.ndarray:
        """(N, N) precision P of one coordinate of the fields of points (N, 3)."""
        count, anchor = len(points), self.shape["anchor"]
        edges = self._graph(points, self.roughness)
        matrix = (1 - anchor) / self.roughness.item() * edges.laplacian(count)
        matrix[np.diag_indices(count)] += anchor / (count * self.magnitude.item())
        return 3 * count * matrix

    def log_prob(self, displacement: Tensor, source: Tensor | None = None) -> Tensor:
        """Log density of the field's 3N coordinates given its source, (B, N, 3) to (B,); O(N³)."""
        penalty = self.penalty(displacement, source=source)
        constants = []
        for _, points in members(displacement, None, source, self.registered_name):
            factor = np.linalg.cholesky(self.precision(points))
            half = np.log(factor.diagonal()).sum() - 0.5 * len(points) * math.log(2 * math.pi)
            constants.append(3 * half)
        energy = 3 * displacement.shape[1] / TYPICAL * penalty
        return torch.tensor(constants).to(penalty) - 0.5 * energy

    def sample(
        self,
        count: int,
        generator: torch.Generator | None = None,
        source: Tensor | None = None,
    ) -> Tensor:
        """Fields (count, N, 3) of the source (N, 3); O(N³)."""
        points = one_source(source, self.registered_name)
        like = self.roughness
        noise = torch.randn(count, len(points), 3, generator=generator, dtype=like.dtype)
        # P = FFᵀ: F⁻ᵀ times white noise has the covariance P⁻¹.
        factor = torch.from_numpy(np.linalg.cholesky(self.precision(points))).to(like)
        return torch.linalg.solve_triangular(factor.T, noise.to(like.device), upper=True)

    def gaussian(self, source: np.ndarray) -> LinearGaussian:
        """The 128 directions of largest variance of P⁻¹ at the points (N, 3) of a source; O(N³)."""
        last = min(128, len(source)) - 1
        values, vectors = eigh(self.precision(source), subset_by_index=(0, last))
        return LinearGaussian.of_kernel(vectors / np.sqrt(values))
