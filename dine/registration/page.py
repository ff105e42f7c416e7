"""What the page on a registration shows, and the words that explain it there."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from dine.geometry.surface import Surface
from dine.registration.types import RegistrationResult
from dine.viewer.view import View

# Files of shapes do not say in what they are measured.
_UNIT = "units of the files"

_VERDICTS = {
    "plausible": "Nothing unusual was found, which is no proof: look whether it fits, and where it "
    "is unsure.",
    "doubtful": "A check speaks against it, or it is unlike what the method was validated on. Look "
    "closely before you use it.",
    "implausible": "It is unlike what the method was validated on in several serious ways, or "
    "turns parts inside out. Do not use it as it is.",
}

_SCALARS = {
    "displacement": "How far each vertex was moved, rigid alignment apart.",
    "distance to target": "From each moved vertex to the nearest place of the target: how well it "
    "fits, not whether it is the right place.",
    "expected error": "How far each vertex is expected to be from its true place, judged by pairs "
    "for which that is known. On other kinds of objects it compares places rather than bounds "
    "errors.",
}

# With a prior of the organ the same values come from the prior.
_OF_ORGANS = {
    "expected error": (
        "posterior deviation",
        "Standard deviation of each vertex's place that the prior of the organ leaves, given the "
        "scan. Large where the scan shows nothing.",
    ),
    "bound 90": (
        "90 % bound",
        "Distance from the true place that nine of ten vertices are to stay below, by the prior of "
        "the organ.",
    ),
}

_FACTS = {
    "HD95": "Distance below which 95 % of each surface lies from the other, before and after.",
    "Largest displacement": "Of any vertex, rigid alignment included.",
    "Folded": "Share of neighbourhoods turned inside out, which tissue does not do.",
    "Expected error": "Mean over the surface; see the colours of that name.",
    "Posterior deviation": "Mean over all vertices of what the prior leaves open.",
    "90 % bound": "Mean over all vertices.",
}


def view_of(result: RegistrationResult, source: Surface, scalars: Mapping[str, np.ndarray]) -> View:
    """The page of a registration.

    Args:
        result: from ``register``.
        source: the rigidly aligned source, which is shown to deform.
        scalars: (V,) values on its vertices, by name.
    """
    renamed = _OF_ORGANS if result.bound is not None else {}
    explained = _SCALARS | dict(renamed.values())
    explained |= _FACTS | {"verdict": _VERDICTS.get(result.trust.verdict, "")}
    if result.report["settings"]["partial"]:
        explained["HD95"] = "Distance below which 95 % of the target lies from the source."
    shown = {renamed.get(name, (name,))[0]: values for name, values in scalars.items()}
    start = {n: result.alignment.align(x) for n, x in result.applied_from.items()}
    further = {
        n: (replace(x, vertices=start[n]), x.vertices)
        for n, x in result.applied.items()
        if n in start
    }
    return View(
        source,
        result.target,
        result.moved.vertices,
        f"{Path(result.source.name).name} → {Path(result.target.name).name}",
        scalars=shown,
        units=dict.fromkeys(shown, _UNIT),
        facts=_facts(result),
        unit=_UNIT,
        verdict=result.trust.verdict,
        reasons=result.trust.reasons,
        explained=explained,
        further=further,
    )


def _number(value: float) -> str:
    """Three digits, as many as lengths deserve."""
    return f"{value:,.0f}" if 1000 <= abs(value) < 1e9 else f"{value:#.3g}".rstrip(".")


def _facts(result: RegistrationResult) -> dict[str, str]:
    report = result.report
    facts = {
        "HD95": " → ".join(_number(report[when]["hd95"]) for when in ("before", "after")),
        "Largest displacement": _number(report["displacement"]["max"]),
        "Folded": f"{100 * report['folding']:.1f} %",
    }
    if result.bound is not None and result.uncertainty is not None:
        facts["Posterior deviation"] = _number(result.uncertainty.mean())
        facts["90 % bound"] = _number(result.bound.mean())
    elif result.trust.expected_error is not None:
        facts["Expected error"] = _number(result.trust.expected_error)
    facts["Network"] = str(report["backbone"] or "none, the prior of an organ")
    facts["Time"] = f"{report['seconds']:.1f} s"
    return facts
