"""Refining one field at test time: the most probable field, by expectation–maximisation.

The network's field is taken as a noisy observation of the true one, and the true one as drawn from
a Gaussian prior (:mod:`dine.refinement.em`).

First, the field is stiff: few motions are probable, so that few wrong ones are. Two starts guard
against a network that is mistaken as a whole: its field, and no displacement. Then the prior is
loosened to finish. Where source and target hold the same points, the loose field meets them
somewhere, and matching goes on from there (:mod:`dine.refinement.shared_points`). Where each scan
has points of its own, the loose field has only followed their noise, so of the stiff fields at half
time the most probable one is kept.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from threadpoolctl import threadpool_limits

from dine.priors.gaussian import LinearGaussian
from dine.refinement.em import Estimate, Mixture
from dine.refinement.process import LOOSE, STIFF
from dine.threads import each

ROUNDS = 40

# In the normalised frame; chosen on the validation pairs of both synthetic datasets (60) and on 40
# resampled ones of the pretraining data.
_LEAST_ERROR = 0.03
_UNKNOWN = 0.05
# Share of matched points at which no other start is tried.
_ENOUGH = 0.5


class Observed(NamedTuple):
    """A field to start from: (N, 3) displacements, and the error (N,) to expect of each."""

    displacement: np.ndarray
    error: np.ndarray

    @classmethod
    def of_network(cls, displacement: np.ndarray, deviation: np.ndarray | None) -> Observed:
        """A network's field, whose marginals have this standard deviation (N,), if it has any.

        Roughly: sharp marginals may still be wrong.
        """
        if deviation is None:
            return cls(displacement, np.full(len(displacement), _UNKNOWN))
        return cls(displacement, np.maximum(deviation, _LEAST_ERROR))


@dataclass(frozen=True)
class Options:
    """How to refine.

    Attributes:
        rounds: of the stiff field, at most, and half as many to finish; points of their own, as in
            two scans, keep the field of the first half. With 0 the observed field is smoothed only.
        part: the source is a part of what the target shows. Every source point then looks for
            targets; otherwise every target looks for source points, which would stretch the part.
        shared: source and target may hold the same points, which is looked for. Points drawn on two
            meshes never do; then the rounds end with the first half.
    """

    rounds: int = ROUNDS
    part: bool = False
    shared: bool = True


DEFAULTS = Options()


class Refined(NamedTuple):
    """A most probable field: its mean (N, 3), and its variance (N,) where that is known."""

    mean: np.ndarray
    variance: np.ndarray | None = None


def refine(
    source: np.ndarray,
    target: np.ndarray,
    observed: Observed | None = None,
    *,
    prior: LinearGaussian | None = None,
    options: Options = DEFAULTS,
) -> Refined:
    """The field after some rounds of expectation–maximisation, all in the normalised frame.

    Args:
        source: (N, 3) points.
        target: (M, 3) points.
        observed: the network's field, or None to start from no displacement alone.
        prior: to finish with, in place of the loose process; its result is then always taken.
        options: how many rounds, and of what.
    """
    # Small systems, for which many threads only wait for each other.
    with threadpool_limits(1, user_api="blas"):
        stiff = STIFF.at(source)

        def mixture() -> Mixture:
            return Mixture(source, target, stiff, STIFF.least, int(options.part))

        starts = [np.zeros_like(source)]
        if observed is not None:
            # Neighbours err alike, so a point says less about the field than its own error does.
            precision = 1 / np.maximum(2 * observed.error, 0.02) ** 2
            smoothed, _ = mixture().most_probable(observed.displacement, precision)
            if options.rounds == 0:
                return Refined(smoothed)
            starts.insert(0, smoothed)
        alone = prior is None and (options.part or not options.shared)
        searched = each(
            lambda start: mixture().rounds(start, options.rounds, only_half=alone), starts
        )
        early = min((half for half, _ in searched), key=lambda half: half.improbability)
        if alone:
            return Refined(early.field)
        ends = [end for _, end in searched]
        field, share = _finished(source, target, ends, prior or LOOSE.at(source), options)
    return Refined(field if share or prior is not None else early.field)


def _finished(
    source: np.ndarray,
    target: np.ndarray,
    ends: list[Estimate],
    prior: LinearGaussian,
    options: Options,
) -> tuple[np.ndarray, float]:
    """Of the fields (N, 3) that go on under a prior, the one that matches most, and the share."""
    from dine.refinement.shared_points import SharedPoints  # scans seldom hold the same points

    loose = Mixture(source, target, prior, LOOSE.least, int(options.part))
    shared = SharedPoints(source, target)
    best, most = None, 0.0
    for end in sorted(ends, key=lambda end: end.improbability):
        _, further = loose.rounds(end.field, options.rounds // 2, end.variance)
        field, share = shared.grow(further.field, prior)
        if best is None or share > most:
            best, most = field, share
        if most >= _ENOUGH:
            break
    return best, most
