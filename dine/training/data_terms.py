"""How well a displaced source fits its target: what training and refinement by gradient minimise.

All lengths are in the normalised frame, in which the source has unit radius; a point's residual is
its distance d to the nearest point of the other cloud.
"""

from __future__ import annotations

import torch
from torch import Tensor

from dine.data.batch import Batch
from dine.errors import ConfigError
from dine.geometry.chamfer import chamfer_distance, masked_mean, nearest, nearest_squared
from dine.registry import Registry

DATA_TERMS: Registry[DataTerm] = Registry("data term")


class DataTerm:
    """Measures how well a displaced source fits; callable, giving one value per pair.

    Registered terms, and those named by import path in the configuration, are made without
    arguments there; in Python their parameters are keyword arguments.
    """

    registered_name: str

    def __call__(self, batch: Batch, displacement: Tensor, truth: Tensor | None) -> Tensor:
        """(B, N, 3) predicted and, where known, true displacement to (B,)."""
        raise NotImplementedError


@DATA_TERMS.register("chamfer")
class Chamfer(DataTerm):
    """Symmetric squared Chamfer distance between moved source and target (the paper's L_CD)."""

    def __call__(self, batch: Batch, displacement: Tensor, truth: Tensor | None) -> Tensor:
        return chamfer_distance(
            batch.source + displacement, batch.target, batch.source_mask, batch.target_mask
        )


@DATA_TERMS.register("l1")
class TrueDisplacement(DataTerm):
    """Mean absolute error of the displacement's coordinates; needs the true displacement."""

    def __call__(self, batch: Batch, displacement: Tensor, truth: Tensor | None) -> Tensor:
        if truth is None:
            raise ConfigError("The data term 'l1' needs pairs with a known true displacement.")
        return masked_mean((displacement - truth).abs().mean(-1), batch.source_mask)


class ResidualTerm(DataTerm):
    """mean_i ρ(d_i) over the moved source plus mean_j ρ(d_j) over the target.

    A subclass says what a residual costs; ρ(d) = d² would be the Chamfer distance.
    """

    def cost(self, squared: Tensor) -> Tensor:
        """ρ, elementwise, of squared residuals d²."""
        raise NotImplementedError

    def __call__(self, batch: Batch, displacement: Tensor, truth: Tensor | None) -> Tensor:
        from_source, from_target = nearest_squared(
            batch.source + displacement, batch.target, batch.source_mask, batch.target_mask
        )
        return masked_mean(self.cost(from_source), batch.source_mask) + masked_mean(
            self.cost(from_target), batch.target_mask
        )


@DATA_TERMS.register("hyperbolic")
class Hyperbolic(ResidualTerm):
    """Hyperbolic Chamfer distance: ρ(d) = arccosh(1 + α d²).

    Lin et al., "Hyperbolic Chamfer Distance for Point Cloud Completion", ICCV 2023. A residual
    pulls with √(2α) / √(1 + α d²/2): with about the same force up to d = 1/√α, with less beyond,
    where Chamfer's force grows. Residuals of exactly zero have zero gradient.

    Args:
        alpha: α > 0, per squared length. The default 1 is that of the authors' code.

    Raises:
        ConfigError: ``alpha`` is not positive.
    """

    def __init__(self, *, alpha: float = 1.0):
        self.alpha = positive("alpha", alpha)

    def cost(self, squared: Tensor) -> Tensor:
        # arccosh(1 + α d²) = 2 arsinh(d √(α/2)), which keeps its digits at small d.
        return 2 * torch.asinh((self.alpha / 2) ** 0.5 * _root(squared))


@DATA_TERMS.register("landau")
class Landau(ResidualTerm):
    """Landau-weighted Chamfer distance: ρ(d) = exp(−(x + exp(−x)) / 2) · (1 − exp(−x)), x = d/s.

    Lin et al., "Loss Distillation via Gradient Matching for Point Cloud Completion with Weighted
    Chamfer Distance", IROS 2024. The weight is Moyal's approximation of the Landau distribution
    without its 1/√(2π); this is the form of the authors' code, with gradients through the weight,
    but with means over points in place of their sums. ρ rises up to x = ln(2 + √3) ≈ 1.32 and then
    falls: what is farther away is pushed off, though weakly. Residuals of exactly zero have zero
    gradient.

    Args:
        scale: s > 0, a length. The default 1 is that of the paper, which has no parameter, for
            objects of about our size.

    Raises:
        ConfigError: ``scale`` is not positive.
    """

    def __init__(self, *, scale: float = 1.0):
        self.scale = positive("scale", scale)

    def cost(self, squared: Tensor) -> Tensor:
        x = _root(squared) / self.scale
        return torch.exp((x + torch.exp(-x)) / -2) * -torch.expm1(-x)


@DATA_TERMS.register("correntropy")
class Correntropy(ResidualTerm):
    """Correntropy-induced distance of the residuals: ρ(d) = 1 − exp(−d² / 2σ²).

    Liu, Pokharel and Príncipe, "Correntropy: Properties and Applications in Non-Gaussian Signal
    Processing", IEEE Transactions on Signal Processing 55, 2007: the square of their metric CIM
    with a kernel that is 1 at zero, also known as Welsch's function. Residuals pull hardest at
    d = σ and hardly beyond 3σ.

    Args:
        sigma: σ > 0, a length. The default 0.1 is a tenth of the object's radius: above the
            spacing of 1024 points on a surface (about 0.06), below the outliers that matter.

    Raises:
        ConfigError: ``sigma`` is not positive.
    """

    def __init__(self, *, sigma: float = 0.1):
        self.sigma = positive("sigma", sigma)

    def cost(self, squared: Tensor) -> Tensor:
        return -torch.expm1(squared / (-2 * self.sigma**2))


@DATA_TERMS.register("density_aware")
class DensityAware(DataTerm):
    """Density-aware Chamfer distance, between 0 and 1.

    ½ mean_i (1 − w_i exp(−α d_i²)) + ½ mean_j (1 − w_j exp(−α d_j²)), w = min(1, (η/n)^ν), where n
    points of the same cloud share the nearest neighbour, and η would if all were shared equally:
    the ratio of the clouds' sizes. Wu et al., "Density-aware Chamfer Distance as a Comprehensive
    Metric for Point Cloud Completion", NeurIPS 2021; distances squared as in the authors' code. For
    clouds of unequal size this is their DCD-E without the mean over η neighbours. The weights
    carry no gradient.

    Args:
        alpha: α > 0, per squared length. As a metric the authors set 1000, with which residuals
            beyond 0.07 pull no more: too few to train on, since displacements here are larger.
            They train with 40 to 200; with our default 40 the pull is hardest at
            d = 1/√(2α) ≈ 0.11, about twice the spacing of 1024 points at unit radius.
        n_lambda: ν ≥ 0. 1 is the paper's formula; the default 0.5 is what the authors train with;
            with 0 density does not matter.

    Raises:
        ConfigError: ``alpha`` is not positive, or ``n_lambda`` negative.
    """

    def __init__(self, *, alpha: float = 40.0, n_lambda: float = 0.5):
        self.alpha = positive("alpha", alpha)
        if not n_lambda >= 0:
            raise ConfigError(f"n_lambda must not be negative, found {n_lambda}.")
        self.n_lambda = n_lambda

    def __call__(self, batch: Batch, displacement: Tensor, truth: Tensor | None) -> Tensor:
        moved = batch.source + displacement
        found = nearest(moved, batch.target, batch.source_mask, batch.target_mask)
        source = _valid(found.from_a, batch.source_mask)
        target = _valid(found.from_b, batch.target_mask)
        there = self._one_way(found.from_a, found.in_b, source, target)
        back = self._one_way(found.from_b, found.in_a, target, source)
        return (there + back) / 2

    def _one_way(self, squared: Tensor, index: Tensor, valid: Tensor, other: Tensor) -> Tensor:
        """Mean cost (B,) of points (B, N), nearest to those of the other cloud at ``index``.

        ``valid`` (B, N) and ``other`` (B, M) are 1 at the clouds' valid points and 0 elsewhere.
        """
        sharing = torch.zeros_like(other).scatter_add(1, index, valid).gather(1, index)
        count = valid.sum(1)
        evenly = count / other.sum(1)
        weight = (evenly.unsqueeze(1) / sharing).clamp_max(1) ** self.n_lambda
        return (valid * (1 - weight * torch.exp(-self.alpha * squared))).sum(1) / count


def _valid(like: Tensor, mask: Tensor | None) -> Tensor:
    """A mask as ones and zeros."""
    return torch.ones_like(like) if mask is None else mask.to(like)


def positive(name: str, value: float) -> float:
    """A term's parameter, checked.

    Raises:
        ConfigError: it is not positive.
    """
    if not value > 0:
        raise ConfigError(f"{name} must be positive, found {value}.")
    return value


def _root(squared: Tensor) -> Tensor:
    """√d² with zero gradient at zero, where that of the root is infinite."""
    positive = squared > 0
    return torch.where(positive, torch.where(positive, squared, 1).sqrt(), 0)
