"""Bayesian coherent point drift, written from its paper, since no kept library has it.

O. Hirose, "A Bayesian Formulation of Coherent Point Drift", IEEE TPAMI 43 (2021). Target points are
drawn from a mixture of Gaussians around the moved source points T(y + v), plus uniform outliers;
T is a similarity transform and v a Gaussian process. Variational Bayes alternates between who
belongs to whom, the posterior of v, and T with the variance of the mixture. Names follow the paper:
y source, x target, v displacement, u = y + v, ν matches of each source point, σ² of the mixture.

Three things make it fast. The kernel matrix is replaced by a root of low rank, which is all that
the posterior needs; once the mixture is narrow, only close pairs of points are compared; and while
it is wide, very many pairs are compared in single precision.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.linalg import cho_factor, cho_solve, solve_triangular
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist
from scipy.special import digamma

from dine.errors import DataError
from dine.priors.gaussian import covariance_root

# In standard deviations of the mixture, which weigh e^-18 there, and in units of the source.
_REACH = 6.0
_NEAR = 0.3
# Pairs of points from which densities are in single precision, and what close then means. Squared
# distances are off by some 1e-6, which is little for mixtures as wide as that.
_MANY = 2**22
_NEAR_OF_MANY = 0.1
_LEAST_EXPONENT = np.float32(-60)
_BLOCK = 64
_LEAST_MATCHES = 1e-20
_LEAST_VARIANCE = 1e-12


class Similarity(NamedTuple):
    """points · scale · rotationᵀ + translation."""

    scale: float
    rotation: np.ndarray
    translation: np.ndarray

    def __call__(self, points: np.ndarray) -> np.ndarray:
        return self.scale * points @ self.rotation.T + self.translation

    def inverse(self, points: np.ndarray) -> np.ndarray:
        return (points - self.translation) @ self.rotation / self.scale


class Result(NamedTuple):
    """What :func:`bcpd` found.

    Attributes:
        moved: (N, 3) source points where they belong, in the units given.
        matched: (N,) expected number of target points of each source point.
        sigma: standard deviation of the mixture at the end, in the units given.
        iterations: done until nothing changed.
    """

    moved: np.ndarray
    matched: np.ndarray
    sigma: float
    iterations: int


class _Matches(NamedTuple):
    """Sums of the matching probabilities P (N, M): over targets, over sources, and P x."""

    source: np.ndarray
    target: np.ndarray
    pulled: np.ndarray


@dataclass(frozen=True)
class Parameters:
    """Settings of :func:`bcpd`, named as in the paper.

    Attributes:
        beta: width of the Gaussian kernel, in standard deviations of the source.
        lam: λ; displacements have an expected length of √(3 / λ) of these.
        outliers: ω in [0, 1), the share of target points that belong to no source point.
        gamma: factor on the standard deviation that the mixture starts with.
        kappa: concentration of the mixing weights; infinite for equal ones.
        uncertain: let the posterior variance of v count; otherwise its mean stands for v.
        rank: most columns of the root of the kernel matrix.
        iterations: at most.
        least_iterations: at least; the variance may rest before it falls.
        tolerance: stop once σ changes less than this.
    """

    beta: float = 2.0
    lam: float = 2.0
    outliers: float = 0.1
    gamma: float = 1.0
    kappa: float = math.inf
    uncertain: bool = True
    rank: int = 300
    iterations: int = 500
    least_iterations: int = 30
    tolerance: float = 1e-4


def bcpd(source: np.ndarray, target: np.ndarray, options: Parameters | None = None) -> Result:
    """Register (N, 3) source points to (M, 3) target points; the target's order does not matter.

    Both clouds are first brought to zero mean and unit variance per coordinate, as the author's
    program does, so ``beta``, ``lam`` and ``tolerance`` mean the same whatever the units.

    Raises:
        DataError: a cloud whose points coincide.
    """
    options = options or Parameters()
    y, _, _ = _standardised(source, "source")
    x, center_x, unit_x = _standardised(target, "target")
    state = _State(y, x, options)
    for iteration in range(1, options.iterations + 1):
        before = state.variance
        state.update()
        resting = abs(math.sqrt(state.variance) - math.sqrt(before)) < options.tolerance
        if resting and iteration >= options.least_iterations:
            break
    moved = state.moved * unit_x + center_x
    return Result(moved, state.matched, math.sqrt(state.variance) * unit_x, iteration)


class _State:
    """Everything that the iterations change, for standardised clouds y and x."""

    def __init__(self, y: np.ndarray, x: np.ndarray, options: Parameters):
        self.y, self.x, self.options = y, x, options
        count, self.dim = y.shape
        self.root = covariance_root(
            y, (options.beta,), (1.0,), rank=options.rank, tolerance=1e-6
        ).root
        self.tree = cKDTree(x)
        # A box a little larger than the target, since points on its faces would cost nothing.
        volume = float(np.prod(np.ptp(x, axis=0) * (len(x) + 1) / len(x)))
        self.outlier = options.outliers / max(volume, 1e-9)
        self.transform = Similarity(1.0, np.eye(self.dim), np.zeros(self.dim))
        self.moved, self.spread = y, np.zeros(count)
        self.matched = np.zeros(count)
        self.mixing = np.full(count, 1 / count)
        self.variance = options.gamma**2 * float(cdist(y, x, "sqeuclidean").mean()) / self.dim

    def update(self) -> None:
        """One iteration: matches, then the posterior of v, then the transform and the variance."""
        matches = self._expected_matches()
        self.matched = np.maximum(matches.source, _LEAST_MATCHES)
        mean_match = matches.pulled / self.matched[:, None]
        u = self._posterior(mean_match)
        if math.isfinite(self.options.kappa):
            total, kappa = float(self.matched.sum()), self.options.kappa
            prior = kappa * len(self.y)
            self.mixing = np.exp(digamma(kappa + self.matched) - digamma(prior + total))
        self._fit_mixture(u, matches, mean_match)

    def _expected_matches(self) -> _Matches:
        """Who belongs to whom."""
        options, variance, dim = self.options, self.variance, self.dim
        share = (1 - options.outliers) * self.mixing / (2 * math.pi * variance) ** (dim / 2)
        if options.uncertain:
            share = share * np.exp(-0.5 * dim * self.transform.scale**2 * self.spread / variance)
        return _matched(self.moved, self.x, self.tree, variance, share, self.outlier)

    def _posterior(self, mean_match: np.ndarray) -> np.ndarray:
        """u = y + v, with v's posterior of covariance root · inverse(system) · rootᵀ."""
        weight = self.matched * (self.transform.scale**2 / self.variance)
        root = self.root
        system = (root * weight[:, None]).T @ root
        system[np.diag_indices_from(system)] += self.options.lam
        factor = cho_factor(system, lower=True, overwrite_a=True, check_finite=False)
        residual = weight[:, None] * (self.transform.inverse(mean_match) - self.y)
        u = self.y + root @ cho_solve(factor, root.T @ residual, check_finite=False)
        if self.options.uncertain:
            half = solve_triangular(factor[0], root.T, lower=True, check_finite=False)
            self.spread = np.einsum("kn,kn->n", half, half)
        return u

    def _fit_mixture(self, u: np.ndarray, matches: _Matches, mean_match: np.ndarray) -> None:
        """The similarity transform and the variance of the mixture."""
        total = float(self.matched.sum())
        mean_spread = float(self.matched @ self.spread) / total
        self.transform = _similarity(u, mean_match, self.matched, mean_spread)
        self.moved = self.transform(u)
        misfit = float(
            matches.target @ (self.x**2).sum(axis=1)
            - 2 * (matches.pulled * self.moved).sum()
            + self.matched @ (self.moved**2).sum(axis=1)
        )
        variance = misfit / (total * self.dim) + self.transform.scale**2 * mean_spread
        self.variance = max(variance, _LEAST_VARIANCE)


def _standardised(points: np.ndarray, what: str) -> tuple[np.ndarray, np.ndarray, float]:
    """Points of zero mean and unit mean variance, with the mean and the unit taken from them."""
    points = np.asarray(points, dtype=np.float64)
    center = points.mean(axis=0)
    unit = math.sqrt(float(((points - center) ** 2).mean()))
    if not unit > 0:
        raise DataError(f"All points of the {what} coincide; expected the surface of an object.")
    return (points - center) / unit, center, unit


def _matched(
    moved: np.ndarray,
    x: np.ndarray,
    tree: cKDTree,
    variance: float,
    share: np.ndarray,
    outlier: float,
) -> _Matches:
    """Matches of (N, 3) moved sources, weighted by their shares (N,), and (M, 3) targets."""
    reach = _REACH * math.sqrt(variance)
    many = len(moved) * len(x) > _MANY
    if reach < (_NEAR_OF_MANY if many else _NEAR):
        near = cKDTree(moved).sparse_distance_matrix(tree, reach, output_type="ndarray")
        i, j = near["i"], near["j"]
        density = share[i] * np.exp(near["v"] ** 2 / (-2 * variance))
        of_target = np.bincount(j, density, len(x)) + outlier
        probability = density / np.maximum(of_target, np.finfo(float).tiny)[j]
        pulled = [np.bincount(i, probability * axis[j], len(moved)) for axis in x.T]
        return _Matches(
            np.bincount(i, probability, len(moved)),
            np.bincount(j, probability, len(x)),
            np.stack(pulled, axis=1),
        )
    if many:
        return _matched_of_many(moved, x, variance, share, outlier)
    density = cdist(moved, x, "sqeuclidean")
    density /= -2 * variance
    np.exp(density, out=density)
    density *= share[:, None]
    of_target = np.maximum(density.sum(axis=0) + outlier, np.finfo(float).tiny)
    density /= of_target
    return _Matches(density.sum(axis=1), density.sum(axis=0), density @ x)


def _matched_of_many(
    moved: np.ndarray, x: np.ndarray, variance: float, share: np.ndarray, outlier: float
) -> _Matches:
    """As :func:`_matched`, in single precision."""
    # One product gives the exponents: −‖m − x‖² / 2σ².
    rows = np.column_stack([moved / variance, (moved**2).sum(axis=1) / (-2 * variance)])
    rows = np.column_stack([rows, np.ones(len(moved))]).astype(np.float32)
    columns = np.vstack([x.T, np.ones(len(x)), (x**2).sum(axis=1) / (-2 * variance)])
    columns = columns.astype(np.float32)
    density = np.empty((len(moved), len(x)), np.float32)
    for first in range(0, len(moved), _BLOCK):
        block = density[first : first + _BLOCK]
        np.matmul(rows[first : first + _BLOCK], columns, out=block)
        # Numbers below 1e-38 would be slow.
        np.clip(block, _LEAST_EXPONENT, 0, out=block)
        np.exp(block, out=block)
    explained = (share.astype(np.float32) @ density).astype(np.float64)
    of_target = explained + outlier
    weighted = np.column_stack([x, np.ones(len(x))]) / of_target[:, None]
    drawn = share[:, None] * (density @ weighted.astype(np.float32))
    return _Matches(drawn[:, 3], explained / of_target, drawn[:, :3])


def _similarity(
    u: np.ndarray, match: np.ndarray, matched: np.ndarray, mean_spread: float
) -> Similarity:
    """The transform of (N, 3) points u onto their mean matches, weighted by ``matched`` (N,)."""
    weight = matched / matched.sum()
    center_u, center_x = weight @ u, weight @ match
    apart = u - center_u
    cross = (weight[:, None] * (match - center_x)).T @ apart
    left, stretch, right = np.linalg.svd(cross)
    # The last axis is turned where a mirror image would fit better.
    sign = np.ones(len(stretch))
    sign[-1] = np.sign(np.linalg.det(left @ right))
    rotation = (left * sign) @ right
    own = float(weight @ (apart**2).sum(axis=1)) + u.shape[1] * mean_spread
    scale = float(stretch @ sign) / own
    return Similarity(scale, rotation, center_x - scale * rotation @ center_u)
