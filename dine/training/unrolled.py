"""A data term through the refinement: what counts is the field after some rounds of it.

A network whose field is refined at test time need not fit the target itself; it has to lead the
refinement there. So the first rounds of :mod:`dine.refinement.refine` are computed here in
PyTorch, from the network's field and differentiable in it: the smoothing under the stiff Gaussian
process, then expectation–maximisation as in :mod:`dine.refinement.em`, without momentum.

What a field has beyond the process, such as noise from point to point, is smoothed away and costs
nothing. All lengths are in the normalised frame.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from dine.data.batch import Batch
from dine.errors import ConfigError
from dine.geometry.chamfer import chamfer_distance
from dine.priors.sources import SourceCache, members
from dine.refinement.process import BOX, OUTLIERS, STIFF
from dine.training.data_terms import DATA_TERMS, DataTerm, positive

# Distances from which on targets are nobody's at first, so that a few of them decide nothing.
_FAR = 0.1
# Weights below exp(−60) are none: arithmetic with the smallest numbers is slow.
_LEAST_EXPONENT = -60.0


@DATA_TERMS.register("refined")
class RefinedTerm(DataTerm):
    """Symmetric squared Chamfer distance of the refined field.

    A round costs N·M operations for the assignment and N·r² for the solve, for r dimensions of the
    process (about 90 of 1024 points); for the gradient it keeps three arrays of N·M numbers. The
    solve is in double precision, as its matrix is ill-conditioned where targets are close.

    Args:
        rounds: of expectation–maximisation; with 0 the field is smoothed only.
        deviation: standard deviation of the network's displacements, as observations of the true
            ones. The default 0.1 is that of the refinement for a network without marginals.

    Raises:
        ConfigError: ``rounds`` is negative, or ``deviation`` not positive.
    """

    def __init__(self, *, rounds: int = 4, deviation: float = 0.1):
        if rounds < 0:
            raise ConfigError(f"rounds must not be negative, found {rounds}.")
        self.rounds = rounds
        self.deviation = positive("deviation", deviation)
        self._roots: SourceCache[Tensor] = SourceCache()

    def __call__(self, batch: Batch, displacement: Tensor, truth: Tensor | None) -> Tensor:
        refined = self.refined(batch, displacement)
        return chamfer_distance(
            batch.source + refined, batch.target, batch.source_mask, batch.target_mask
        )

    def refined(self, batch: Batch, displacement: Tensor) -> Tensor:
        """The fields (B, N, 3) after the rounds, zero where padded."""
        fields = []
        found = members(displacement, batch.source_mask, batch.source, "stiff")
        for row, (field, points) in enumerate(found):
            source, target = batch.source[row], batch.target[row]
            mask = batch.source_mask
            if mask is not None:
                source = source[mask[row]]
            if batch.target_mask is not None:
                target = target[batch.target_mask[row]]
            field = self._one(source, target, field, self._root(points, field.device))
            if mask is not None:
                full = torch.zeros_like(batch.source[row])
                field = full.masked_scatter(mask[row].unsqueeze(1), field)
            fields.append(field)
        return torch.stack(fields)

    def _root(self, points: np.ndarray, device: torch.device) -> Tensor:
        """(n, r) root of the stiff process at points (n, 3), float64."""
        return self._roots.get(
            points, device, lambda: torch.from_numpy(STIFF.at(points).kernel).to(device)
        )

    def _one(self, source: Tensor, target: Tensor, field: Tensor, root: Tensor) -> Tensor:
        """The field (n, 3) of one pair without padding, n and m points."""
        same = source.new_full((len(source),), 1 / self.deviation**2, dtype=root.dtype)
        field = _most_probable(root, same, field.to(root) / self.deviation**2).to(source)
        weight = None
        for _ in range(self.rounds):
            squared = _squared(source + field, target)
            if weight is None:
                variance = squared.amin(0).clamp_max(_FAR).mean()
            else:
                variance = (weight * squared).sum() / (3 * weight.sum().clamp_min(1e-9))
            variance = variance.clamp_min(STIFF.least**2)
            weight = _assigned(squared, variance)
            mass = weight.sum(1)
            pulled = weight @ target - mass[:, None] * source
            precision = (mass / variance).to(root)
            field = _most_probable(root, precision, (pulled / variance).to(root)).to(source)
        return field


def _most_probable(root: Tensor, precision: Tensor, pull: Tensor) -> Tensor:
    """The most probable field (n, 3) under a process with this root (n, r).

    Given values of some precision (n,), which ``pull`` (n, 3) is the product of.
    """
    alone = torch.eye(root.shape[1], dtype=root.dtype, device=root.device)
    system = alone + root.T @ (root * precision[:, None])
    return root @ torch.cholesky_solve(root.T @ pull, torch.linalg.cholesky(system))


def _squared(moved: Tensor, target: Tensor) -> Tensor:
    """(n, m) squared distances of moved points to targets."""
    lengths = moved.square().sum(1, keepdim=True) + target.square().sum(1)
    return torch.addmm(lengths, moved, target.T, alpha=-2).clamp_min(0)


def _assigned(squared: Tensor, variance: Tensor) -> Tensor:
    """(n, m) share of every source point in every target, whose sum is below 1 for outliers."""
    exponent = squared / (-2 * variance)
    exponent = torch.nn.functional.threshold(exponent, _LEAST_EXPONENT, -math.inf)
    # Outliers as one more source point, relative to the density of the others at distance 0.
    other = OUTLIERS / BOX * len(squared) / (1 - OUTLIERS) * (2 * math.pi * variance) ** 1.5
    return torch.cat([exponent, other.log().expand(1, squared.shape[1])]).softmax(0)[:-1]
