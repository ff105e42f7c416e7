"""Refining one field at test time: the most probable field, by expectation–maximisation.

The network's field is taken as a noisy observation of the true one, and the true one as drawn from
a Gaussian prior. Expectation assigns target points to moved source points softly, with a share of
outliers (as in coherent point drift; Myronenko and Song, 2010); maximisation is one linear solve
under the prior. Rounds start from a point beyond the last field, along the last step (Nesterov's
momentum, with restarts), which saves most of them.

First, the field is stiff: few motions are probable, so that few wrong ones are. Two starts guard
against a network that is mistaken as a whole: its field, and no displacement; the most probable
result goes on. Then the prior is loosened to finish. Where source and target hold the same points,
the loose field ends on them, and is the better one. Where each scan has points of its own, it ends
between them and has only followed their noise, so the stiff field, at half time, is kept.

A prior has few dimensions (:class:`~dine.priors.gaussian.LinearGaussian`), so a round costs N·M
operations for the expectation and N·r² for the solve.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.spatial import cKDTree
from threadpoolctl import threadpool_limits

from dine.priors.gaussian import LinearGaussian, covariance_root

ROUNDS = 40

# In the normalised frame; chosen on the validation pairs of both synthetic datasets (60) and on 40
# resampled ones of the pretraining data.
_OUTLIERS = 0.1
_BOX = 8.0
_LEAST_ERROR = 0.03
_UNKNOWN = 0.05
_SETTLED = 1e-4
_LEAST_EXPONENT = np.float32(-60)
# Same points: moved points are this close to targets, in spacings of these. On validation pairs it
# is below 0.13 where the field is right and above 0.6 with noise or with points drawn anew.
_SAME = 0.3


class Smoothness(NamedTuple):
    """A Gaussian process of displacements: widths and standard deviations, normalised frame.

    ``affine`` is the standard deviation of an affine part, ``least`` the smallest one of the
    distances between moved points and their targets.
    """

    widths: tuple[float, ...]
    amplitudes: tuple[float, ...]
    affine: float
    least: float
    rank: int

    def at(self, points: np.ndarray) -> LinearGaussian:
        """The prior of fields at (N, 3) points."""
        root = covariance_root(points, self.widths, self.amplitudes, self.affine, rank=self.rank)
        return LinearGaussian.of_kernel(root)


STIFF = Smoothness((1.5, 0.4), (0.2, 0.04), 0.05, 0.01, 128)
LOOSE = Smoothness((1.5, 0.4, 0.25), (0.5, 0.2, 0.04), 0.5, 0.004, 200)


class _Result(NamedTuple):
    field: np.ndarray
    variance: float
    improbability: float

    def rank(self) -> float:
        return self.improbability


def expected_error(spread: np.ndarray | None, points: int) -> np.ndarray:
    """Error (N,) to expect of a network's field, from the deviation (N,) of its marginals.

    Roughly: sharp marginals may still be wrong, and some backbones have none.
    """
    return np.full(points, _UNKNOWN) if spread is None else np.maximum(spread, _LEAST_ERROR)


def refine(
    source: np.ndarray,
    target: np.ndarray,
    displacement: np.ndarray | None,
    error: np.ndarray | None,
    *,
    rounds: int = ROUNDS,
    part: bool = False,
    prior: LinearGaussian | None = None,
) -> np.ndarray:
    """The field (N, 3) after some rounds of expectation–maximisation, all in the normalised frame.

    Args:
        source: (N, 3) points.
        target: (M, 3) points.
        displacement: (N, 3) of the network, or None to start from no displacement alone.
        error: (N,) its expected errors, or standard deviations; None likewise.
        rounds: of the stiff field, at most, and half as many to finish; points of their own, as in
            two scans, get only the first half. With 0 the network's field is smoothed only.
        part: the source is a part of what the target shows. Every source point then looks for
            targets; otherwise every target looks for source points, which would stretch the part.
        prior: to finish with, in place of the loose process; its result is then always taken.
    """
    # Small systems, for which many threads only wait for each other.
    with threadpool_limits(1, user_api="blas"):
        model = _Model(source, target, STIFF.at(source), STIFF.least, int(part))
        starts = [np.zeros_like(source)]
        if displacement is not None:
            # Neighbours err alike, so a point says less about the field than its own error does.
            smoothed, _ = model.most_probable(displacement, 1 / np.maximum(2 * error, 0.02) ** 2)
            if rounds == 0:
                return smoothed
            starts.insert(0, smoothed)
        found = [model.rounds(start, rounds) for start in starts]
        early = min((half for half, _ in found), key=_Result.rank)
        if part and prior is None:
            return early.field
        late = min((end for _, end in found), key=_Result.rank)
        finish = _Model(source, target, prior or LOOSE.at(source), LOOSE.least, int(part))
        _, loose = finish.rounds(late.field, rounds // 2, late.variance)
    if prior is None and not _same_points(source + loose.field, target):
        return early.field
    return loose.field


def _same_points(moved: np.ndarray, target: np.ndarray) -> bool:
    tree = cKDTree(target)
    if len(target) < 2:
        return False
    spacing = np.median(tree.query(target, k=2)[0][:, 1])
    return bool(np.median(tree.query(moved)[0]) < _SAME * spacing)


class _Model:
    """One pair under a prior; ``axis`` 0 shares every target out among source points, 1 inversely.

    Distances and densities are in float32, which the least standard deviations forgive.
    """

    def __init__(
        self,
        source: np.ndarray,
        target: np.ndarray,
        prior: LinearGaussian,
        least: float,
        axis: int,
    ):
        self.source, self.prior, self.least, self.axis = source, prior, least, axis
        # With a column of ones, which sums up the weights on the way.
        self._target = np.column_stack([target, np.ones(len(target))]).astype(np.float32)
        # One product gives −2·x·y + ‖y‖² for all pairs.
        self._columns = np.empty((4, len(target)), np.float32)
        self._columns[:3] = -2 * target.T
        self._columns[3] = (target**2).sum(axis=1)
        self._rows = np.ones((len(source), 4), np.float32)
        # Written again in every round: fresh memory would cost more than the arithmetic.
        self._distances, self._weights = np.empty((2, len(source), len(target)), np.float32)

    def most_probable(self, value: np.ndarray, precision: np.ndarray) -> tuple[np.ndarray, float]:
        """Field, and half its squared length in the prior's own coordinates.

        Given values (N, 3) of some precision (N,) each.
        """
        prior = self.prior
        deviation = value - prior.mean
        weighted = prior.kernel * precision[:, None]
        own = prior.kernel.T @ weighted
        own[np.diag_indices_from(own)] += 1
        own_factor = cho_factor(own, lower=True, overwrite_a=True, check_finite=False)
        seen = weighted.T @ deviation
        shared = np.zeros(0)
        if len(prior.modes):
            # The kernel's part is the same for all coordinates, and is eliminated first.
            flat = prior.modes.reshape(len(prior.modes), -1)
            heavy = prior.modes * precision[None, :, None]
            system = flat @ heavy.reshape(flat.shape).T
            system[np.diag_indices_from(system)] += 1
            right = heavy.reshape(flat.shape) @ deviation.ravel()
            cross = np.einsum("rnc,nk->ckr", heavy, prior.kernel, optimize=True)
            for coordinate in range(3):
                solved = cho_solve(own_factor, cross[coordinate], check_finite=False)
                system -= cross[coordinate].T @ solved
                right -= solved.T @ seen[:, coordinate]
            shared = cho_solve(cho_factor(system, lower=True), right, check_finite=False)
            seen = seen - np.einsum("ckr,r->kc", cross, shared)
        alone = cho_solve(own_factor, seen, check_finite=False)
        field = prior.mean + prior.kernel @ alone
        if len(shared):
            field += np.tensordot(shared, prior.modes, axes=1)
        return field, 0.5 * float((shared**2).sum() + (alone**2).sum())

    def _squared(self, moved: np.ndarray) -> np.ndarray:
        """(N, M) squared distances of moved points to targets, float32, valid until the next."""
        self._rows[:, :3] = moved
        squared = np.matmul(self._rows, self._columns, out=self._distances)
        squared += (moved**2).sum(axis=1).astype(np.float32)[:, None]
        return np.maximum(squared, 0, out=squared)

    def _densities(self, squared: np.ndarray, variance: float) -> np.ndarray:
        """(N, M) exp(−squared / 2 variance), float32, valid until the next.

        None is so small that arithmetic with it were slow, which is from 1e-38 downwards.
        """
        exponent = np.multiply(squared, np.float32(-0.5 / variance), out=self._weights)
        np.maximum(exponent, _LEAST_EXPONENT, out=exponent)
        return np.exp(exponent, out=exponent)

    def rounds(
        self, field: np.ndarray, rounds: int, variance: float | None = None
    ) -> tuple[_Result, _Result]:
        """The fields after half of the rounds and after all, and how badly they explain targets.

        That is −log p(targets | field) − log p(field) up to a constant. The variance of the
        distances is estimated from the start where it is not given.
        """
        axis, source, least = self.axis, self.source, self.least**2
        squared = self._squared(source + field)
        if variance is None:
            variance = max(float(np.minimum(squared.min(axis=axis), 0.1).mean()), least)
        outlier = _OUTLIERS / _BOX
        last, momentum, energy, settled = field, 0, 0.0, False
        half = _Result(field, variance, np.inf)
        for number in range(rounds + 1):
            factor = (1 - _OUTLIERS) / squared.shape[axis] / (2 * np.pi * variance) ** 1.5
            weight = self._densities(squared, variance)
            likelihood = factor * weight.sum(axis=axis).astype(np.float64) + outlier
            improbability = energy - float(np.log(likelihood).sum())
            if number == rounds // 2:
                half = _Result(last, variance, improbability)
            if settled or number == rounds:
                break
            share = (factor / likelihood).astype(np.float32)
            weight *= share[None, :] if axis == 0 else share[:, None]
            drawn = weight @ self._target
            mass = drawn[:, 3].astype(np.float64)
            pulled = drawn[:, :3] - mass[:, None] * source
            precision = np.maximum(mass / variance, 1e-9)
            found, energy = self.most_probable(pulled / variance / precision[:, None], precision)
            step = found - last
            if momentum and ((found - field) * step).sum() < 0:
                momentum = 0
            momentum += 1
            # The last field is one that maximises, not one beyond.
            settled = float((step**2).sum(axis=1).mean()) < _SETTLED**2
            beyond = 0.0 if settled or number == rounds - 1 else momentum / (momentum + 3)
            last, field = found, found + beyond * step
            squared = self._squared(source + field)
            distance = float(np.vdot(weight, squared))
            variance = max(distance / (3 * max(mass.sum(), 1e-9)), least)
        end = _Result(field, variance, improbability)
        return (half if number >= rounds // 2 else end), end
