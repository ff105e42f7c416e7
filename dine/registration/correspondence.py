"""Which point went where: alignment, the network's field, its refinement, and the way back."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np
import torch

from dine.data.batch import make_batch
from dine.data.sampling import convention_order
from dine.errors import ConfigError, DataError
from dine.geometry.distance import distances, spacings
from dine.geometry.frame import Frame
from dine.geometry.interpolation import FittedDisplacement
from dine.geometry.rigid import (
    Alignment,
    check_rigid,
    motion_between,
    overlapping_alignments,
    rigid_alignments,
)
from dine.geometry.surface import Surface
from dine.models.backbones import Backbone, marginal_deviation
from dine.progress import stage
from dine.refinement.refine import DEFAULTS, Observed, Options, refine
from dine.registration.shapes import FEWEST, drawn
from dine.registration.surfaces import FULL, QUICK, Detail, refined_on_surfaces
from dine.registration.types import Correspondence, Model, Motion, Overlap, Pair, Settings
from dine.threads import each

# A source point is shown by the target if a target point ends up within so many spacings of it.
_RETURN = 3.0
# Points that end so close to each other are the same, and the share of such from which all are.
_SAME = 1e-9
_SHARED = 0.5
# Share of the surfaces without counterpart, and shares of both scans past the other's end, from
# which scans are tried as parts that overlap. What one scan lacks by a hole, the other does not.
_LACKING = 0.1
_PAST_THE_END = (0.03, 0.02)
_AS_WELL = 0.02
# Share of each scan that the other shows, from which `auto` takes them for parts; and from which
# one lies within the other, which is the less likely answer.
_OVERLAP = 0.43
_WITHIN = 0.96
# Alignments that are carried to the end: the first, and others that a quick look finds about as
# probable as the likeliest and farther than so many radii from those; and what a later one must
# lower the improbability to.
_CARRIED = 3
_ABOUT_AS_GOOD = 1.1
_ALIKE = 0.1
_BETTER = 0.9


def correspondence_of(
    source: Surface, target: Surface, model: Model, settings: Settings
) -> tuple[Pair, Correspondence]:
    """Points of both scans, aligned, and where those of the source belong.

    Raises:
        DataError: too few points, points on a line, a matrix that is not rigid, or a part that ends
            up beside the other scan.
        ConfigError: unusable settings.
    """
    _check(settings)
    pairs = aligned_pairs(source, target, settings, model.convention)
    found = _most_probable(pairs, model, settings)
    may_lie_otherwise = isinstance(settings.prealign, str) and settings.prealign == "auto"
    if settings.overlap is Overlap.AUTO and may_lie_otherwise and lacks(found[1]):
        as_parts = replace(settings, overlap=Overlap.BOTH)
        pairs = aligned_pairs(source, target, as_parts, model.convention)
        parts = _most_probable(pairs, model, as_parts)
        more = parts[1].unmet - found[1].unmet
        if min(parts[1].shown) > _OVERLAP and more < _AS_WELL:
            return parts[0], replace(parts[1], overlap=Overlap.BOTH)
    return found[0], replace(found[1], overlap=settings.overlap)


def _check(settings: Settings) -> None:
    rounds = settings.rounds
    if rounds < 0:
        raise ConfigError(f"The number of rounds is {rounds}; expected 0 or more.")
    if settings.overlap is Overlap.BOTH and not (settings.surfaces and rounds):
        raise ConfigError(
            "Where each scan shows what the other does not (overlap both), only surfaces tell what "
            "belongs together; allow surfaces and rounds of refinement."
        )
    if settings.guide is not None and not (settings.surfaces and rounds):
        raise ConfigError(
            "Landmarks guide the refinement on surfaces only; allow surfaces and rounds of "
            "refinement."
        )


def lacks(found: Correspondence) -> bool:
    """Whether more has no counterpart than one scan lacks by a hole."""
    if found.unmet is None:
        return False
    more, less = _PAST_THE_END
    parts = min(found.shown) < 1 - more and max(found.shown) < 1 - less
    return parts or found.unmet > _LACKING


def aligned_pairs(
    source: Surface, target: Surface, settings: Settings, convention: str
) -> list[Pair]:
    """Points of both, drawn, aligned and normalised; those of the source in a convention.

    One pair for each alignment that is worth a try, the most likely first.

    Raises:
        DataError: too few points, points on a line, or a matrix that is not rigid.
        ConfigError: unusable settings.
    """
    stage("alignment")
    rng = np.random.default_rng([4, settings.seed])
    samples = drawn(source, settings.points, rng, "source")
    seen = drawn(target, settings.points, rng, "target").places(target.vertices)
    places = samples.places(source.vertices)
    pairs = []
    for motion in _motions(settings, places, seen):
        alignment = Alignment.of(places, motion)
        start = alignment.normalise(places)
        order = convention_order(start, convention)
        goal = alignment.frame.normalise(seen)
        pairs.append(Pair(source, target, alignment, places[order], start[order], goal))
    return pairs


def _motions(settings: Settings, source: np.ndarray, target: np.ndarray) -> list[np.ndarray]:
    how = settings.prealign
    if not isinstance(how, str):
        return [check_rigid(how)]
    if how == "off":
        return [np.eye(4)]
    if how == "auto":
        if settings.guide is not None and settings.guide.tells_rotation:
            return [motion_between(settings.guide.here, settings.guide.there)]
        return _RIGID[settings.overlap](source, target)
    raise ConfigError(f"The alignment is {how!r}; expected auto, off or a 4×4 matrix.")


_RIGID = {
    Overlap.AUTO: rigid_alignments,
    Overlap.BOTH: overlapping_alignments,
    Overlap.TARGET_IN_SOURCE: partial(rigid_alignments, partial=True),
    # What brings the target onto a part of it, undone.
    Overlap.SOURCE_IN_TARGET: lambda source, target: [
        np.linalg.inv(motion) for motion in rigid_alignments(target, source, partial=True)
    ],
}


def _most_probable(
    pairs: Sequence[Pair], model: Model, settings: Settings
) -> tuple[Pair, Correspondence]:
    """Of several alignments the one whose correspondence explains the surfaces best.

    The first where surfaces are not looked at, or little of one scan is to be seen.
    """
    if settings.overlap is Overlap.BOTH:
        return _of_parts(pairs, model, settings)
    found = [(pairs[0], correspond(pairs[0], model, settings))]
    if found[0][1].improbability is not None and settings.overlap is Overlap.AUTO:
        found += [(pair, correspond(pair, model, settings)) for pair in pairs[1:]]
    return min(found, key=lambda one: one[1].improbability or 0.0)


def _of_parts(
    pairs: Sequence[Pair], model: Model, settings: Settings
) -> tuple[Pair, Correspondence]:
    """The same where each scan shows what the other does not.

    Which alignment is right shows only once the source is deformed, and parts can fit by chance:
    the wrong way round, say, one within the other. All are looked at quickly. The first is carried
    to the end and kept, unless another is clearly more probable.
    """
    looks = each(lambda pair: (pair, correspond(pair, model, settings, QUICK)), pairs)
    for pair, found in looks:
        if found.improbability is None:  # the same points, which leave nothing open
            return pair, found
    best = None
    for one in each(lambda pair: (pair, correspond(pair, model, settings)), _worth_more(looks)):
        if best is None or _unlikely(one[1]) < _unlikely(best[1], _BETTER):
            best = one
    return best


def _unlikely(found: Correspondence, share: float = 1.0) -> tuple[bool, float]:
    """What orders correspondences of parts, the likeliest first: that neither lies within the
    other, and then a share of the improbability."""
    return max(found.shown) > _WITHIN, share * found.improbability


def _worth_more(looks: Sequence[tuple[Pair, Correspondence]]) -> list[Pair]:
    """Alignments to be carried to the end, given what a quick look at each found: the first, and of
    the others those that are about as probable as the likeliest."""
    first, *others = looks
    others.sort(key=lambda look: _unlikely(look[1]))
    likeliest = min((found for _, found in looks), key=_unlikely)
    places = first[0].places
    kept, fields = [], []
    for pair, found in [first, *others]:
        worth = not kept or _unlikely(found) <= _unlikely(likeliest, _ABOUT_AS_GOOD)
        moved = Motion(pair.alignment, found.anywhere)(places) / pair.alignment.frame.scale
        if worth and all(np.linalg.norm(moved - x, axis=1).mean() > _ALIKE for x in fields):
            kept.append(pair)
            fields.append(moved)
    return kept[:_CARRIED]


def correspond(
    pair: Pair, model: Model, settings: Settings, detail: Detail = FULL
) -> Correspondence:
    """Where the source's points belong; ``detail``: of the look at surfaces.

    Raises:
        DataError: the target, a part of the source, ends up beside it.
    """
    found = _from_points(pair, model, settings)
    if not (settings.surfaces and settings.rounds):
        return found
    # Scans that hold the same points say of each where it went.
    if settings.guide is None and (distances(found.moved, pair.goal) < _SAME).mean() >= _SHARED:
        return replace(found, indicator=np.zeros(len(found.start)))
    return refined_on_surfaces(pair, found, settings, detail)


def _from_points(pair: Pair, model: Model, settings: Settings) -> Correspondence:
    """What the drawn points alone say; nothing where each scan has some that the other lacks."""
    if settings.overlap is Overlap.BOTH:
        return _still(pair)
    if settings.overlap is Overlap.TARGET_IN_SOURCE:
        stage("points")
        return _from_part(pair.start, pair.goal, settings.rounds)
    if settings.overlap is Overlap.SOURCE_IN_TARGET:
        stage("points")
        options = Options(settings.rounds, part=True)
        return replace(_still(pair), field=refine(pair.start, pair.goal, options=options).mean)
    # Points drawn on a mesh lie between its vertices.
    shared = pair.source.faces is None and pair.target.faces is None
    there = one_way(model.backbone, pair.start, pair.goal, settings, shared)
    if settings.surfaces and settings.rounds:
        return there  # surfaces will say more
    # The way back has a frame of its own, in which the target is the source.
    frame = Frame.of(pair.goal)
    seen, whole = frame.normalise(pair.goal), frame.normalise(pair.start)
    back = one_way(model.backbone, seen, whole, settings, shared).field * frame.scale
    return replace(there, inconsistency=_inconsistency(there, back))


def _still(pair: Pair) -> Correspondence:
    """No displacement."""
    start = pair.start
    return Correspondence(start, pair.goal, np.zeros_like(start), None, np.ones(len(start), bool))


def one_way(
    backbone: Backbone,
    start: np.ndarray,
    goal: np.ndarray,
    settings: Settings,
    shared: bool = True,
) -> Correspondence:
    """Where the points ``start`` (N, 3) belong among those of ``goal`` (M, 3), normalised frame,
    without the check of the way back. ``shared``: both may hold the same points."""
    options = Options(settings.rounds, shared=shared)
    field, indicator = predict_and_refine(backbone, start, goal, settings.device, options)
    return Correspondence(start, goal, field, indicator, np.ones(len(start), bool))


@torch.no_grad()
def predict_and_refine(
    backbone: Backbone,
    source: np.ndarray,
    target: np.ndarray,
    device: torch.device,
    options: Options = DEFAULTS,
) -> tuple[np.ndarray, np.ndarray | None]:
    """Displacement (N, 3) and what tells its errors apart (N,), float64, normalised frame.

    The network's field, refined in some rounds (see :func:`~dine.refinement.refine.refine`); 0
    leaves it as it is. Errors of the network's own field grow with the standard deviation of its
    marginals (None from a backbone without). What is left after refinement has little to do with
    that, but grows with how far a point moved, and with how far the network would have moved it
    elsewhere: their sum is taken. How well it ranks errors is among the facts of a calibration.
    """
    stage("network")
    batch = make_batch([source], [target]).to(device)
    result = backbone.to(device).eval()(batch)
    predicted = result.displacement[0].double().cpu().numpy()
    deviation = marginal_deviation(backbone, result)
    deviation = None if deviation is None else deviation[0].double().cpu().numpy()
    if options.rounds == 0:
        return predicted, deviation
    stage("points")
    observed = Observed.of_network(predicted, deviation)
    refined = refine(source, target, observed, options=options).mean
    elsewhere = np.linalg.norm(refined - predicted, axis=1)
    return refined, np.linalg.norm(refined, axis=1) + elsewhere


def _from_part(start: np.ndarray, goal: np.ndarray, rounds: int) -> Correspondence:
    """Source points whose target is a part of them.

    The part is registered to the whole, in which each of its points has a counterpart; the inverse
    is known where they end up and interpolated from there. Networks mistake parts for wholes, so
    they have no say.

    Raises:
        DataError: the part ends up beside the source.
    """
    frame = Frame.of(goal)
    part, whole = frame.normalise(goal), frame.normalise(start)
    back = refine(part, whole, options=Options(rounds, part=True)).mean * frame.scale
    places = goal + back
    reach = _RETURN * float(np.median(spacings(start)))
    supported = distances(start, places) < reach
    if supported.sum() < FEWEST:
        raise DataError(
            "Hardly any part of the source is found in the target; check that both show the same "
            "object, or leave the overlap to `auto`."
        )
    return Correspondence(start, goal, FittedDisplacement(places, -back)(start), None, supported)


def _inconsistency(there: Correspondence, back: np.ndarray) -> float:
    """Mean distance from where they began of points moved to the target and, by the field (M, 3)
    of the opposite registration, back; normalised frame.

    A wrong correspondence can fit as well as the right one, but is seldom found from both sides.
    """
    returned = there.field + FittedDisplacement(there.goal, back)(there.moved)
    return float(np.linalg.norm(returned, axis=1).mean())
