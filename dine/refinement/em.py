"""Expectation–maximisation for one pair under a Gaussian prior.

Expectation assigns target points to moved source points softly, with a share of outliers (as in
coherent point drift; Myronenko and Song, 2010); maximisation is one linear solve under the prior.
Rounds start from a point beyond the last field, along the last step (Nesterov's momentum, with
restarts), which saves most of them.

A prior has few dimensions (:class:`~dine.priors.gaussian.LinearGaussian`), so a round costs N·M
operations for the expectation and N·r² for the solve. All lengths are in the normalised frame.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from dine.priors.gaussian import LinearGaussian
from dine.refinement.process import BOX, OUTLIERS

_SETTLED = 1e-4
_LEAST_EXPONENT = np.float32(-60)
_UNSEEN = 1e-9


class Estimate(NamedTuple):
    """A field (N, 3), the variance of its distances to the targets, and how improbable it is."""

    field: np.ndarray
    variance: float
    improbability: float


class Matches(NamedTuple):
    """Source points whose target is known.

    Attributes:
        known: (N,) bool, at source points.
        target: (N,) index of the target point, of no meaning where nothing is known.
    """

    known: np.ndarray
    target: np.ndarray

    def displacement(self, source: np.ndarray, target: np.ndarray) -> np.ndarray:
        """(N, 3) from source to matched target points, zero where nothing is known."""
        return np.where(self.known[:, None], target[self.target] - source, 0.0)


class Mixture:
    """One pair under a prior: targets as a mixture of Gaussians around moved source points.

    ``axis`` 0 shares every target out among source points, 1 inversely. Distances and densities
    are in float32, which the least standard deviations forgive.
    """

    def __init__(
        self,
        source: np.ndarray,
        target: np.ndarray,
        prior: LinearGaussian,
        least: float,
        axis: int,
        matches: Matches | None = None,
    ):
        """``matches`` are taken as certain to ``least``; the rounds look for the other points."""
        self.source, self.prior, self.least, self.axis = source, prior, least, axis
        self._free: slice | np.ndarray = slice(None)
        self._known = np.zeros(0, int)
        if matches is not None:
            self._known = np.flatnonzero(matches.known)
            self._value = matches.displacement(source, target)[self._known]
            self._free = np.flatnonzero(~matches.known)
            target = np.delete(target, matches.target[self._known], axis=0)
        # With a column of ones, which sums up the weights on the way.
        self._target = np.column_stack([target, np.ones(len(target))]).astype(np.float32)
        # One product gives −2·x·y + ‖y‖² for all pairs.
        self._columns = np.empty((4, len(target)), np.float32)
        self._columns[:3] = -2 * target.T
        self._columns[3] = (target**2).sum(axis=1)
        self._rows = np.ones((len(source[self._free]), 4), np.float32)
        # Written again in every round: fresh memory would cost more than the arithmetic.
        self._distances, self._weights = np.empty((2, len(self._rows), len(target)), np.float32)

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

    @property
    def free(self) -> int:
        """How many points of the source or of the target, whichever are fewer, have no match."""
        return min(self._distances.shape)

    def from_matches(self, field: np.ndarray | None = None, error: float = 1.0) -> np.ndarray:
        """The most probable field (N, 3) given the matches.

        With a ``field`` (N, 3), also given that it is right elsewhere but for this error.
        """
        free = len(self._rows)
        if field is None:
            return self._solve(np.zeros((free, 3)), np.zeros(free), 1.0)[0]
        return self._solve(field[self._free], np.ones(free), error**2)[0]

    def _squared(self, moved: np.ndarray) -> np.ndarray:
        """(N, M) squared distances of moved points to targets, float32, valid until the next.

        Of those that have no match, as everywhere below.
        """
        moved = moved[self._free]
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

    def _solve(
        self, pulled: np.ndarray, mass: np.ndarray, variance: float
    ) -> tuple[np.ndarray, float]:
        """The most probable field, from sums of displacements (N, 3) and of weights (N,)."""
        weak = np.maximum(mass / variance, _UNSEEN)
        mean = pulled / variance / weak[:, None]
        if not len(self._known):
            return self.most_probable(mean, weak)
        value, precision = np.empty((len(self.source), 3)), np.empty(len(self.source))
        value[self._free], precision[self._free] = mean, weak
        value[self._known], precision[self._known] = self._value, 1 / self.least**2
        return self.most_probable(value, precision)

    def rounds(
        self,
        field: np.ndarray,
        rounds: int,
        variance: float | None = None,
        *,
        only_half: bool = False,
    ) -> tuple[Estimate, Estimate]:
        """The fields after half of the rounds and after all, and how badly they explain targets.

        That is −log p(targets | field) − log p(field) up to a constant. The variance of the
        distances is estimated from the start where it is not given. With ``only_half`` the second
        half is left out, and the second field of no meaning.
        """
        axis, source, least = self.axis, self.source, self.least**2
        squared = self._squared(source + field)
        if variance is None:
            variance = max(float(np.minimum(squared.min(axis=axis), 0.1).mean()), least)
        outlier = OUTLIERS / BOX
        last, momentum, energy, settled = field, 0, 0.0, False
        half = Estimate(field, variance, np.inf)
        for number in range(rounds + 1):
            factor = (1 - OUTLIERS) / squared.shape[axis] / (2 * np.pi * variance) ** 1.5
            weight = self._densities(squared, variance)
            likelihood = factor * weight.sum(axis=axis).astype(np.float64) + outlier
            improbability = energy - float(np.log(likelihood).sum())
            if number == rounds // 2:
                half = Estimate(last, variance, improbability)
                settled |= only_half
            if settled or number == rounds:
                break
            share = (factor / likelihood).astype(np.float32)
            weight *= share[None, :] if axis == 0 else share[:, None]
            drawn = weight @ self._target
            mass = drawn[:, 3].astype(np.float64)
            pulled = drawn[:, :3] - mass[:, None] * source[self._free]
            solved, energy = self._solve(pulled, mass, variance)
            step = solved - last
            if momentum and ((solved - field) * step).sum() < 0:
                momentum = 0
            momentum += 1
            # The last field is one that maximises, not one beyond.
            settled = float((step**2).sum(axis=1).mean()) < _SETTLED**2
            beyond = 0.0 if settled or number == rounds - 1 else momentum / (momentum + 3)
            last, field = solved, solved + beyond * step
            squared = self._squared(source + field)
            distance = float(np.vdot(weight, squared))
            variance = max(distance / (3 * max(mass.sum(), 1e-9)), least)
        end = Estimate(field, variance, improbability)
        return (half if number >= rounds // 2 else end), end
