"""Refining one field at test time: the most probable field, by expectation–maximisation.

The network's field is taken as a noisy observation of the true one, and the true one as drawn from
a Gaussian prior (:mod:`dine.registration.expectation`).

First, the field is stiff: few motions are probable, so that few wrong ones are. Two starts guard
against a network that is mistaken as a whole: its field, and no displacement. Then the prior is
loosened to finish. Where source and target hold the same points, the loose field meets them
somewhere, and matching goes on from there (:mod:`dine.registration.shared_points`). Where each scan
has points of its own, the loose field has only followed their noise, so of the stiff fields at half
time the most probable one is kept.
"""

from __future__ import annotations

import numpy as np
from threadpoolctl import threadpool_limits

from dine.priors.gaussian import LOOSE, STIFF, LinearGaussian
from dine.registration.expectation import Model
from dine.registration.shared_points import SharedPoints

ROUNDS = 40

# In the normalised frame; chosen on the validation pairs of both synthetic datasets (60) and on 40
# resampled ones of the pretraining data.
_LEAST_ERROR = 0.03
_UNKNOWN = 0.05
# Share of matched points at which no other start is tried.
_ENOUGH = 0.5


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
            two scans, keep the field of the first half. With 0 the network's field is smoothed
            only.
        part: the source is a part of what the target shows. Every source point then looks for
            targets; otherwise every target looks for source points, which would stretch the part.
        prior: to finish with, in place of the loose process; its result is then always taken.
    """
    # Small systems, for which many threads only wait for each other.
    with threadpool_limits(1, user_api="blas"):
        model = Model(source, target, STIFF.at(source), STIFF.least, int(part))
        starts = [np.zeros_like(source)]
        if displacement is not None:
            # Neighbours err alike, so a point says less about the field than its own error does.
            smoothed, _ = model.most_probable(displacement, 1 / np.maximum(2 * error, 0.02) ** 2)
            if rounds == 0:
                return smoothed
            starts.insert(0, smoothed)
        found = [model.rounds(start, rounds) for start in starts]
        early = min((half for half, _ in found), key=lambda half: half.improbability)
        if part and prior is None:
            return early.field
        final = prior or LOOSE.at(source)
        finish = Model(source, target, final, LOOSE.least, int(part))
        shared = SharedPoints(source, target)
        best, most = None, 0.0
        for _, end in sorted(found, key=lambda halves: halves[1].improbability):
            _, loose = finish.rounds(end.field, rounds // 2, end.variance)
            field, share = shared.grow(loose.field, final)
            if best is None or share > most:
                best, most = field, share
            if most >= _ENOUGH:
                break
    return best if most or prior is not None else early.field
