"""How two scans lie to each other: rigid alignment, and whether one lacks what the other shows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np

from dine.data.sampling import convention_order
from dine.errors import ConfigError
from dine.geometry.distance import spacings
from dine.geometry.oriented import evenly
from dine.geometry.rigid import (
    Alignment,
    check_rigid,
    motion_between,
    overlapping_alignments,
    rigid_alignments,
)
from dine.geometry.surface import Surface
from dine.progress import stage
from dine.registration.correspondence import correspond
from dine.registration.shapes import drawn
from dine.registration.surfaces import FULL, QUICK, Detail
from dine.registration.types import Correspondence, Model, Motion, Overlap, Pair, Settings
from dine.threads import each

# Share of the surfaces without counterpart from which parts are looked for, and shares of both
# scans past the other's end: where a mesh has a rim, and where ends are a guess.
_LACKING = 0.1
_PAST_THE_RIM, _PAST_THE_END = (0.015, 0.0), (0.03, 0.02)
# Share without counterpart up to which what was found of wholes need not be found again, and by how
# much −log of the evidence may then be more, at a quick look, than of another alignment.
_LITTLE = 0.01
_HARDLY_WORSE = 10.0
# Alignments that are carried to the end, and the share of a scan that the other shows from which it
# lies within that. By how much −log of the evidence may be more than the likeliest's for that, how
# many radii these are apart, and by how much less a later one's must be in the end.
_CARRIED = 3
_WITHIN = 0.96
_ABOUT_AS_GOOD = 40.0
_ALIKE = 0.1
_BETTER = 50.0
# What both show is not likely so many times larger on one.
_STRETCHED = 4.0
# Points by whose distances areas are compared.
_SPREAD = 200
# Mean distance between fields that are the same but for details.
_THE_SAME = 0.02


class _Look(NamedTuple):
    """An alignment, and what was found of it.

    Attributes:
        stretch: how many times larger what both show is on the target than on the source.
    """

    pair: Pair
    found: Correspondence
    stretch: float

    @property
    def stretched(self) -> bool:
        """Whether that is more than tissue stretches."""
        return not 1 / _STRETCHED < self.stretch < _STRETCHED


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
    if settings.overlap is Overlap.BOTH:
        return _of_parts(pairs, model, settings)
    pair, whole = _most_probable(pairs, model, settings)
    whole = replace(whole, overlap=settings.overlap)
    if settings.overlap is Overlap.AUTO and lacks(pair, whole):
        as_parts = replace(settings, overlap=Overlap.BOTH)
        others = aligned_pairs(source, target, as_parts, model.convention)
        return _of_parts(others, model, as_parts, (pair, whole))
    return pair, whole


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


def lacks(pair: Pair, found: Correspondence) -> bool:
    """Whether a scan seems to lack what the other shows."""
    if found.unmet is None:
        return False
    scans = pair.source, pair.target
    rim = any(scan.faces is not None and len(scan.rim) for scan in scans)
    more, less = _PAST_THE_RIM if rim else _PAST_THE_END
    least, most = sorted(found.shown)
    return found.unmet > _LACKING or (least < 1 - more and most <= 1 - less)


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
    found = [(pairs[0], correspond(pairs[0], model, settings))]
    if found[0][1].improbability is not None and settings.overlap is Overlap.AUTO:
        found += [(pair, correspond(pair, model, settings)) for pair in pairs[1:]]
    return min(found, key=lambda one: one[1].improbability or 0.0)


def _of_parts(
    pairs: Sequence[Pair],
    model: Model,
    settings: Settings,
    whole: tuple[Pair, Correspondence] | None = None,
) -> tuple[Pair, Correspondence]:
    """The most probable where each scan may show what the other does not.

    Which alignment is right shows only once the source is deformed, and parts can fit by chance,
    the wrong way round, say. All are looked at quickly. The first is carried to the end and kept,
    unless another is clearly more probable.

    Args:
        whole: what was found of the scans as wholes, which goes on as parts, counts as much as the
            first, and is given back where that changes nothing.
    """
    known = [whole] if whole else []
    larger = _extent(pairs[0].goal) / _extent(pairs[0].start)

    def look(pair: Pair, before: Correspondence | None, detail: Detail) -> _Look:
        found = correspond(pair, model, settings, detail, before)
        ours, theirs = found.shown
        return _Look(pair, found, larger * theirs / ours if ours else np.inf)

    quick = each(lambda one: look(*one, QUICK), [*known, *((pair, None) for pair in pairs)])
    for one in quick:
        if one.found.improbability is None:  # the same points, which leave nothing open
            return one.pair, replace(one.found, overlap=settings.overlap)
    least = min(one.found.improbability for one in quick)
    if whole and _stays(*whole, quick):
        return whole[0], replace(whole[1], at_a_look=least)
    carried = [*known, *((pair, None) for pair in _worth_more(quick[len(known) :]))]
    ends = each(lambda one: look(*one, FULL), carried)
    # Where the files lay the scans, and where they were found as wholes, has more for it.
    usual = len(known) + 1
    best = min(ends[:usual], key=_unlikely)
    other = min(ends[usual:], key=_unlikely, default=best)
    if _unlikely(other) < _unlikely(best, _BETTER):
        best = other
    rival = any(_rivals(end, best) for end in ends)
    if whole and (best.stretched or _same(*whole, best)):
        return whole[0], replace(whole[1], rival=rival, at_a_look=least)
    return best.pair, replace(best.found, overlap=settings.overlap, rival=rival, at_a_look=least)


def at_a_look(source: Surface, target: Surface, model: Model, settings: Settings) -> float:
    """The least −log of the evidence that quick looks at two scans as parts find, with no more than
    their rigid alignments to start from."""
    settings = replace(settings, overlap=Overlap.BOTH)
    pairs = aligned_pairs(source, target, settings, model.convention)
    found = each(lambda pair: correspond(pair, model, settings, QUICK), pairs)
    known = (one.improbability for one in found if one.improbability is not None)
    return min(known, default=np.inf)


def _stays(pair: Pair, whole: Correspondence, looks: Sequence[_Look]) -> bool:
    """Whether what was found of wholes leaves hardly anything without counterpart, and quick looks,
    the first of which goes on from there, see nothing better."""
    if whole.unmet > _LITTLE or not _same(pair, whole, looks[0], _ALIKE):
        return False
    return _unlikely(looks[0], _HARDLY_WORSE) <= min(_unlikely(look) for look in looks)


def _rivals(look: _Look, best: _Look) -> bool:
    """Whether it is another way, about as probable as the best."""
    if look.stretched or _unlikely(look, _BETTER) > _unlikely(best):
        return False
    return not _same(look.pair, look.found, best, _ALIKE)


def _unlikely(look: _Look, less: float = 0.0) -> tuple[bool, float]:
    """What orders correspondences of parts, the likeliest first: that what both show is not much
    larger on one, and then −log of the evidence, less so much."""
    return look.stretched, look.found.improbability - less


def _extent(points: np.ndarray) -> float:
    """Proportional to the area that (N, 3) points cover, however dense they are."""
    some = points[evenly(points, _SPREAD)]
    return float(np.median(spacings(some)) ** 2)


def _worth_more(looks: Sequence[_Look]) -> list[Pair]:
    """Alignments to be carried to the end: the first, the likeliest, the likeliest by which neither
    scan lies within the other, and those that are about as probable as the likeliest.

    Few points say little against a part that is bent so that it lies within another.
    """
    ranked = sorted(looks, key=_unlikely)
    overlapping = [look for look in ranked if max(look.found.shown) < _WITHIN]
    close = [look for look in ranked if _unlikely(look, _ABOUT_AS_GOOD) <= _unlikely(ranked[0])]
    kept, fields = [], []
    for look in [looks[0], ranked[0], *overlapping[:1], *close]:
        moved = _moved(look.pair, look.found, looks[0].pair)
        if all(_apart(moved, other) > _ALIKE for other in fields):
            kept.append(look.pair)
            fields.append(moved)
    return kept[:_CARRIED]


def _moved(pair: Pair, found: Correspondence, at: Pair) -> np.ndarray:
    """Where the source's points of another pair belong (N, 3), in radii."""
    return Motion(pair.alignment, found.interpolated())(at.places) / at.alignment.frame.scale


def _apart(a: np.ndarray, b: np.ndarray) -> float:
    """Mean distance of corresponding points (N, 3)."""
    return float(np.linalg.norm(a - b, axis=1).mean())


def _same(pair: Pair, found: Correspondence, other: _Look, about: float = _THE_SAME) -> bool:
    """Whether two correspondences leave the source in the same place."""
    return _apart(_moved(pair, found, pair), _moved(other.pair, other.found, pair)) < about
