"""How far to trust a registration: compared with validation pairs of known correspondence."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from dine.evaluation.quality import FAILURE
from dine.registration.calibration import Calibration

_RARE = 99.0
_FOLDED = 0.02
# Less is within what two draws of points from one surface make of a field.
_LOWERED = 0.5

GOOD, DOUBTFUL, IMPLAUSIBLE = "plausible", "doubtful", "implausible"


@dataclass(frozen=True)
class Trust:
    """What the report says about a result.

    Attributes:
        verdict: ``plausible``, ``doubtful`` (unlike the validation pairs in some way, or a
            result that a check speaks against) or ``implausible`` (folded, or far outside what the
            training fields look like).
        reasons: plain sentences, empty where there is nothing to say.
        percentiles: of this result among the validation pairs, by name, 0 to 100.
        expected_error: mean over the surface, in the units of the source; None without calibration.
    """

    verdict: str
    reasons: tuple[str, ...]
    percentiles: dict[str, float]
    expected_error: float | None


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
    values: dict[str, float],
    expected_error: float | None,
    *,
    checks: Mapping[str, float] | None = None,
    notes: tuple[str, ...] = (),
) -> Trust:
    """Compare values of a result (normalised frame, names as in the calibration) with the rest.

    ``checks`` need no validation pairs: ``remaining``, the Chamfer distance that is left, as a
    share of that before (after rigid alignment); ``uncertain``, the expected error as a share of
    the displacement, means of both; ``inconsistency``, how far points end up from where they began
    (mean, normalised) when registered to the target and back.
    """
    reasons = list(notes)
    checks = checks or {}
    if checks.get("remaining", 0.0) > _LOWERED:
        reasons.append(
            f"{100 * checks['remaining']:.0f} % of the Chamfer distance before is left: what was "
            "moved may be noise, and the source as it was (or rigidly aligned) as good."
        )
    if checks.get("uncertain", 0.0) > 1:
        reasons.append(
            "The expected error is larger than the displacement found, so there may be none."
        )
    if checks.get("inconsistency", 0.0) > FAILURE:
        reasons.append(
            "Registered to the target and back, points end up "
            f"{100 * checks['inconsistency']:.0f} % of the object's radius from where they began, "
            "so the correspondence is uncertain however well the surfaces fit."
        )
    percentiles = {}
    serious = 0
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
    usual = max(calibration.reference["folding"]) if calibration else 0.0
    if serious >= 2 or folded > max(5 * _FOLDED, 2 * usual):
        verdict = IMPLAUSIBLE
    elif reasons:
        verdict = DOUBTFUL
    else:
        verdict = GOOD
    return Trust(verdict, tuple(reasons), percentiles, expected_error)
