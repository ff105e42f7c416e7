"""How far to trust a registration: what is measured of it, and a verdict from that."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from dine.geometry.distance import spacings, surface_distance
from dine.geometry.interpolation import FittedValues
from dine.geometry.oriented import evenly
from dine.geometry.rigid import Alignment, rigid_alignments, transformed
from dine.geometry.surface import Surface
from dine.registration.calibration import Calibration, field_values
from dine.registration.overlap import at_a_look
from dine.registration.shapes import dense_points
from dine.registration.surfaces import CLOSE, improbabilities
from dine.registration.types import (
    Correspondence,
    ExpectedError,
    Model,
    Motion,
    Overlap,
    Pair,
    Settings,
    Trust,
)

_RARE = 99.0
_FOLDED = 0.05
# Less is within what two draws of points from one surface make of a field.
_LOWERED = 0.5
# Object radii; who has not moved farther needs no better.
_SMALL = 0.01
# 5 % of the diameter, at which the evaluation calls a point lost.
_INCONSISTENT = 0.1
# Of the surface, and of the radius: on the strongest deformations of benchmarks/surfaces.py.
_UNMET = 0.15
_UNSURE = 0.06

GOOD, DOUBTFUL, IMPLAUSIBLE = "plausible", "doubtful", "implausible"


# Mean displacement, in radii, below which the scans lie on each other as they are.
_LYING_ON = 0.03
# What the mirrored source lowers the improbability to, if the target is its mirror image: 0.25 to
# 0.78 of real shapes that are flipped and not symmetric, not below 0.9 of any that are not flipped;
# of parts 0.5 to 0.97 and not below 0.94.
_MIRROR_FITS = 0.85
# At how many times the mean distance of rigidly aligned points it is looked at more closely: what
# is nearly symmetric aligns as well either way, and tells only when it is bent.
_MIRROR_NEARER = 1.1
# Points by which it is aligned.
_ALIGNED = 500
_ACROSS = np.array([-1.0, 1.0, 1.0])

MIRRORED = (
    "The target looks like a mirror image of the source, such as a left organ for a right one: "
    "mirrored, the source fits much better. If the two are the same side, one file is flipped; "
    "otherwise mirror one of them first (change the sign of one coordinate)."
)


@dataclass(frozen=True)
class Measures:
    """What is measured of a result.

    Attributes:
        before: distances of source and target as they were, in the units of the source; named as
            in :func:`~dine.geometry.distance.distance_measures`.
        aligned: the same after rigid alignment.
        after: the same after registration.
        normalised: values of the field in the normalised frame, named as in a calibration.
        checks: what needs no validation pairs; see :func:`assess`.
    """

    before: dict[str, float]
    aligned: dict[str, float]
    after: dict[str, float]
    normalised: dict[str, float]
    checks: dict[str, float]


def expected_error(
    calibration: Calibration | None, correspondence: Correspondence, pair: Pair
) -> ExpectedError | None:
    """The calibrated error of all vertices and points; None without calibration or indicator."""
    if calibration is None or correspondence.indicator is None:
        return None
    error = calibration.expected_error(correspondence.indicator)
    everywhere = FittedValues(correspondence.start, error[:, None])
    vertices = everywhere(pair.alignment.normalise(pair.source.vertices))[:, 0]
    scale = pair.alignment.frame.scale
    return ExpectedError(vertices * scale, error * scale)


def measure(
    pair: Pair,
    correspondence: Correspondence,
    motion: Motion,
    model: Model,
    settings: Settings,
    expected: ExpectedError | None,
) -> Measures:
    """Distances on dense points, values of the field as a calibration knows them, and checks."""
    shown = correspondence.shown
    source, target = dense_points(pair.source), dense_points(pair.target)
    aligned = surface_distance(pair.alignment.align(source), target, shown=shown)
    after = surface_distance(motion(source), target, shown=shown)
    # Points alone cannot tell a small motion from where they happened to be drawn: two draws from
    # one surface are apart by their spacing.
    floor = 0.0
    if settings.surfaces:
        sides = (points for points, share in ((target, shown[0]), (source, shown[1])) if share)
        floor = sum(float((spacings(points) ** 2).mean()) for points in sides)
    checks = {"remaining": _remaining(aligned["chamfer"], after["chamfer"], floor)}
    if correspondence.inconsistency is not None:
        checks["inconsistency"] = correspondence.inconsistency
    if expected is not None:
        # What the target does not show is not held against the rest.
        seen = correspondence.supported | ~correspondence.supported.any()
        moved_by = float(np.linalg.norm(correspondence.field[seen], axis=1).mean())
        unsure = float(expected.points[seen].mean()) / pair.alignment.frame.scale
        checks["uncertain"] = unsure / max(moved_by, _SMALL)
        checks["unsure"] = unsure
    if correspondence.unmet is not None:
        checks["unmet"] = correspondence.unmet
    # Where points come in another order than the prior's, it says nothing of their field.
    prior = model.prior if model.convention != "none" else None
    start, field, goal = correspondence.start, correspondence.field, correspondence.goal
    values = field_values(start, field, goal, prior, shown=shown)
    before = surface_distance(source, target, shown=shown)
    return Measures(before, aligned, after, values, checks)


def _remaining(before: float, after: float, floor: float) -> float:
    """What is left of a Chamfer distance above its floor, if it has one; 0 where there was hardly
    any."""
    if floor == 0:
        return after / before if before > 0 else 1.0
    return max(after - floor, 0.0) / (before - floor) if before > 2 * floor else 0.0


_UNLIKE = {
    "initial": "Source and target differ more than {p:.0f} % of the validation pairs did before "
    "registration; the model has not been tested on such a pair.",
    "final": "The moved source fits the target worse than {p:.0f} % of the validation pairs did.",
    "reach": "The largest displacement exceeds that of {p:.0f} % of the validation pairs.",
    "in_span": "Under the prior the field is less likely than {p:.0f} % of the validation fields.",
    "residual": "The field lies further outside the prior's principal components than {p:.0f} % of "
    "the validation fields.",
}
_SERIOUS = {"final", "in_span", "residual"}


def assess(
    calibration: Calibration | None,
    values: Mapping[str, float],
    expected_error: float | None,
    *,
    checks: Mapping[str, float] | None = None,
    notes: tuple[str, ...] = (),
    remarks: tuple[str, ...] = (),
) -> Trust:
    """Compare values of a result (normalised frame, names as in the calibration) with the rest.

    ``checks`` need no validation pairs: ``remaining``, the Chamfer distance that is left, as a
    share of that before (after rigid alignment); ``uncertain``, the expected error as a share
    of the displacement (of a hundredth of the radius at least), means of both over what the target
    shows; ``unsure``, that mean expected error (normalised); ``unmet``, the share of the surface
    that lies on none of the other scan's; ``inconsistency``, how far points end up from where they
    began (mean, normalised) when registered to the target and back.

    ``notes`` speak against the result, ``remarks`` do not.
    """
    reasons = [*notes, *_from_checks(checks or {})]
    percentiles: dict[str, float] = {}
    serious, usual = 0, 0.0
    folded = values.get("folding", 0.0)
    if folded > _FOLDED:
        reasons.append(
            f"The field turns {100 * folded:.0f} % of the neighbourhoods inside out, which tissue "
            "does not do."
        )
    if calibration is None:
        reasons.append(
            "There is no calibration for these weights and settings, so nothing more can be said."
        )
    else:
        percentiles, unlike, serious = _compared(calibration, values)
        reasons += unlike
        usual = max(calibration.reference["folding"])
    if serious >= 2 or folded > max(5 * _FOLDED, 2 * usual):
        verdict = IMPLAUSIBLE
    else:
        verdict = DOUBTFUL if reasons else GOOD
    return Trust(verdict, (*reasons, *remarks), percentiles, expected_error)


def _from_checks(checks: Mapping[str, float]) -> list[str]:
    """What speaks against a result, whatever it was calibrated with."""
    reasons = []
    if checks.get("remaining", 0.0) > _LOWERED:
        reasons.append(
            f"{100 * checks['remaining']:.0f} % of the Chamfer distance before is left: what was "
            "moved may be noise, and the source as it was (or rigidly aligned) as good."
        )
    if checks.get("uncertain", 0.0) > 1:
        reasons.append(
            "The expected error is larger than the displacement found, so there may be none."
        )
    if checks.get("unsure", 0.0) > _UNSURE:
        reasons.append(
            f"The expected error is {100 * checks['unsure']:.0f} % of the object's radius: the "
            "surfaces leave open how they moved."
        )
    if checks.get("unmet", 0.0) > _UNMET:
        reasons.append(
            f"{100 * checks['unmet']:.0f} % of the surface does not come to lie on the other scan, "
            "so the correspondence may be wrong."
        )
    if checks.get("inconsistency", 0.0) > _INCONSISTENT:
        reasons.append(
            "Registered to the target and back, points end up "
            f"{100 * checks['inconsistency']:.0f} % of the object's radius from where they began, "
            "so the correspondence is uncertain however well the surfaces fit."
        )
    return reasons


def _compared(
    calibration: Calibration, values: Mapping[str, float]
) -> tuple[dict[str, float], list[str], int]:
    """Percentiles among the validation pairs, what is unlike them, and how serious that is."""
    percentiles, reasons, serious = {}, [], 0
    for name, value in values.items():
        if name not in calibration.reference:
            continue
        percentiles[name] = calibration.percentile(name, value)
        highest = calibration.reference[name][-1]
        if name in _UNLIKE and percentiles[name] >= _RARE and value > highest:
            reasons.append(_UNLIKE[name].format(p=min(percentiles[name], 100)))
            serious += name in _SERIOUS
            # Four times what was ever seen is no matter of percentiles any more.
            serious += name in _SERIOUS and value > 4 * highest
    return percentiles, reasons, serious


def mirrored(surface: Surface) -> Surface:
    """The mirror image, in the plane across the first axis; normals of faces still point out."""
    faces = None if surface.faces is None else surface.faces[:, ::-1]
    return Surface(surface.vertices * _ACROSS, faces, surface.name)


def looks_mirrored(pair: Pair, found: Correspondence, model: Model, settings: Settings) -> bool:
    """Whether the mirror image of the source fits the target much better.

    Judged before anything but stiff fields bends them, which make a shape its mirror image less
    easily than the fields of a registration do. Symmetric objects fit as well either way.
    """
    near = np.linalg.norm(found.field, axis=1).mean() < _LYING_ON
    if near or found.improbability is None:
        return False
    whole = found.overlap is Overlap.AUTO
    if whole and not _mirrored_whole(pair, settings):
        return False
    # As wholes, parts fit as badly one way as the other, and a little better either way.
    if found.at_a_look is not None:
        image = at_a_look(mirrored(pair.source), pair.target, model, settings)
        return image < _MIRROR_FITS * found.at_a_look
    return whole


def _mirrored_whole(pair: Pair, settings: Settings) -> bool:
    """The same of two scans that show the same."""
    # Stiff fields make up for what fewer points tell less of the alignment.
    places, seen = (
        x[evenly(x, _ALIGNED)] for x in (pair.places, pair.alignment.restore(pair.goal))
    )
    nearest = _MIRROR_NEARER * _apart(pair.alignment.align(places), seen)
    image = mirrored(pair.source)
    otherwise = [
        replace(pair, source=image, alignment=Alignment.of(places * _ACROSS, motion))
        for motion in rigid_alignments(places * _ACROSS, seen)
        if _apart(transformed(places * _ACROSS, motion), seen) <= nearest
    ]
    if not otherwise:
        return False
    as_given = improbabilities([pair], settings, CLOSE)[0]
    return min(improbabilities(otherwise, settings, CLOSE)) < _MIRROR_FITS * as_given


def _apart(a: np.ndarray, b: np.ndarray) -> float:
    """Mean distance of (N, 3) points to the nearest of (M, 3) others, and of these to those."""
    return surface_distance(a, b)["chamfer_unsquared"]
