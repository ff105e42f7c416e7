"""Move one scan onto another: from two surfaces in any units to a moved surface and a report."""

from __future__ import annotations

import time
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from dine import __version__
from dine.errors import ConfigError
from dine.files import file_digest
from dine.geometry.distance import landmark_errors
from dine.geometry.surface import Surface
from dine.models.devices import chosen_device
from dine.progress import stage
from dine.refinement.refine import ROUNDS
from dine.registration.assessment import (
    MIRRORED,
    Measures,
    assess,
    expected_error,
    looks_mirrored,
    measure,
)
from dine.registration.model import load_model
from dine.registration.overlap import correspondence_of
from dine.registration.shapes import (
    POINTS,
    Points,
    Shape,
    as_surface,
    check_sizes,
    check_spaces,
    checked_landmarks,
)
from dine.registration.types import (
    Correspondence,
    ExpectedError,
    Guide,
    Model,
    Motion,
    Overlap,
    Pair,
    RegistrationResult,
    Settings,
    Trust,
)
from dine.threads import together

# Share of the source without counterpart that is more than a rim.
_WORTH_SAYING = 0.02
_RIVAL = (
    "Another way to lay the scans on each other explains them about as well; check that the moved "
    "source lies the right way round, or align the scans first."
)

if TYPE_CHECKING:
    from dine.priors.organ import OrganPrior


def register(
    source: Shape,
    target: Shape,
    *,
    model: Model | None = None,
    prealign: str | np.ndarray = "auto",
    apply: Mapping[str, Shape] | None = None,
    landmarks: tuple[Points, Points] | None = None,
    guide: tuple[Points, Points] | None = None,
    guide_error: float | None = None,
    rounds: int = ROUNDS,
    surfaces: bool = True,
    overlap: str = "auto",
    partial: bool = False,
    points: int = POINTS,
    seed: int = 0,
    device: str = "auto",
    prior: OrganPrior | str | Path | None = None,
) -> RegistrationResult:
    """Register a source to a target, of any number of points and in any (the same) units.

    The network sees ``points`` points of each, drawn by area from a mesh and without replacement
    from a cloud. Its field is interpolated to all source vertices
    (:mod:`dine.geometry.interpolation`).

    Args:
        source: what moves.
        target: what it moves onto.
        model: from :func:`load_model`; by default the shipped Robust-DefReg.
        prealign: ``auto`` (rigid, by iterative closest points), ``off``, or a rigid 4×4 matrix that
            brings the source to the target.
        apply: further shapes in the source's frame to move along, by name.
        landmarks: corresponding (L, 3) points of source and target, or files of them, to measure
            with only.
        guide: likewise, to keep to: points that belong together, and to align by if they tell how.
        guide_error: standard deviation of each of their coordinates, in the units of the source; by
            default a hundredth of its radius.
        rounds: of refinement at test time (most probable smooth field); 0 for the network's own.
        surfaces: go on from the points to the surfaces that they were drawn on (meshes), or to all
            points (clouds); not without rounds.
        overlap: which part of the object each scan shows. ``auto``: the same, or parts that overlap
            if that leaves much without counterpart; ``target-in-source`` and ``source-in-target``:
            one shows a part of the other; ``both``: each shows what the other does not. Regions
            without counterpart follow the others instead of being pulled onto the part.
        partial: the same as ``overlap="target-in-source"``.
        points: points that the network sees; it was trained with 1024.
        seed: of the draws.
        device: ``auto``, ``cpu`` or ``cuda``.
        prior: of the organ that ``source`` is the template of, or its file (``dine learn``); it
            takes the network's place, so model, rounds, surfaces and points cannot be chosen. See
            :mod:`dine.registration.organ`.

    Raises:
        DataError: unreadable or unusable shapes, such as points on a line, or of other sizes.
        ConfigError: unusable settings.
    """
    chosen = _overlap(overlap, partial)
    if guide is None and guide_error is not None:
        raise ConfigError(
            "The error of landmarks to keep to (guide_error) needs such landmarks (guide)."
        )
    if prior is not None:
        if chosen not in (Overlap.AUTO, Overlap.TARGET_IN_SOURCE):
            raise ConfigError(
                f"With the prior of an organ the overlap is {chosen}; expected auto or "
                "target-in-source, since the template is whole."
            )
        network = {"model": model, "surfaces": not surfaces}
        network |= {"rounds": rounds != ROUNDS, "points": points != POINTS}
        _refuse_network(network)
    source, target = as_surface(source, "source"), as_surface(target, "target")
    kept = guide and Guide(*checked_landmarks(guide, source, target), guide_error)
    if prior is not None:
        how = (prealign, chosen is Overlap.TARGET_IN_SOURCE, seed, kept)
        return _with_prior(source, target, prior, how, apply or {}, landmarks)
    device = chosen_device(device)
    settings = Settings(prealign, rounds, chosen, points, seed, device, surfaces, kept)
    return _registered(source, target, model, settings, apply or {}, landmarks)


def _overlap(name: str, partial: bool) -> Overlap:
    chosen = Overlap.of(name)
    if not partial:
        return chosen
    if chosen not in (Overlap.AUTO, Overlap.TARGET_IN_SOURCE):
        raise ConfigError(f"The overlap is {chosen}, which is not partial; leave out one of both.")
    return Overlap.TARGET_IN_SOURCE


def _with_prior(
    source: Surface,
    target: Surface,
    prior: OrganPrior | str | Path,
    settings: tuple[str | np.ndarray, bool, int, Guide | None],
    apply: Mapping[str, Shape],
    landmarks: tuple[Points, Points] | None,
) -> RegistrationResult:
    """By the prior of an organ; ``settings`` are alignment, partial, seed and guiding landmarks."""
    # Nothing else needs these.
    from dine.priors.organ import OrganPrior, load_organ_prior
    from dine.registration.organ import OrganSettings, register_organ

    stage("reading, and the organ's field")
    return register_organ(
        source,
        target,
        prior if isinstance(prior, OrganPrior) else load_organ_prior(prior),
        OrganSettings(*settings),
        apply={name: as_surface(shape, name) for name, shape in apply.items()},
        landmarks=landmarks,
    )


def _refuse_network(chosen: Mapping[str, Any]) -> None:
    names = [name for name, value in chosen.items() if value]
    if names:
        raise ConfigError(
            f"With the prior of an organ there is no network to choose {', '.join(names)} of; "
            "leave that out."
        )


def _registered(
    source: Surface,
    target: Surface,
    model: Model | None,
    settings: Settings,
    apply: Mapping[str, Shape],
    landmarks: tuple[Points, Points] | None,
) -> RegistrationResult:
    began = time.perf_counter()
    stage("reading")
    model = model or load_model()
    further = {name: as_surface(shape, name) for name, shape in apply.items()}
    marks = None if landmarks is None else checked_landmarks(landmarks, source, target)
    check_spaces(source, (target, *further.values()))
    notes = check_sizes(source, target, settings.overlap is not Overlap.AUTO)
    pair, correspondence = correspondence_of(source, target, model, settings)
    stage("measures")
    if correspondence.rival:
        notes.append(_RIVAL)
    motion = Motion(pair.alignment, correspondence.interpolated())
    calibration = model.calibration_for(settings, correspondence.overlap)
    mirrored, (moved, expected, measures) = together(
        lambda: looks_mirrored(pair, correspondence, model, settings),
        lambda: _measured(pair, correspondence, motion, model, settings),
    )
    if mirrored:
        notes.append(MIRRORED)
    displacement = moved.vertices - source.vertices
    trust = assess(
        calibration,
        measures.normalised,
        expected and expected.mean,
        checks=measures.checks,
        notes=tuple(notes),
        remarks=(*_parts(settings, correspondence), *_support(correspondence)),
    )
    report = _report(pair, correspondence, displacement, measures, trust, model)
    report["settings"] = settings.described(len(pair.start))
    report["overlap_found"] = str(correspondence.overlap)
    if marks is not None:
        report["landmarks"] = _landmarks(*marks, motion)
    applied = {name: motion.surface(surface) for name, surface in further.items()}
    report["seconds"] = time.perf_counter() - began
    return RegistrationResult(
        source,
        target,
        moved,
        displacement,
        expected and expected.vertices,
        applied,
        pair.places,
        pair.alignment.restore(correspondence.moved) - pair.places,
        expected and expected.points,
        correspondence.supported,
        trust,
        report,
        alignment=pair.alignment,
        motion=motion,
        applied_from={name: surface.vertices for name, surface in further.items()},
    )


def _measured(
    pair: Pair, correspondence: Correspondence, motion: Motion, model: Model, settings: Settings
) -> tuple[Surface, ExpectedError | None, Measures]:
    """The moved source, how far it is expected to be off, and what is measured of it."""
    moved = motion.surface(pair.source)
    calibration = model.calibration_for(settings, correspondence.overlap)
    expected = expected_error(calibration, correspondence, pair)
    return moved, expected, measure(pair, correspondence, motion, model, settings, expected)


def _parts(settings: Settings, correspondence: Correspondence) -> tuple[str, ...]:
    """What to say where parts turned out to be missing."""
    if settings.overlap is correspondence.overlap or settings.overlap is not Overlap.AUTO:
        return ()
    return ("A scan seems to show what the other does not: they were registered as parts.",)


def _support(correspondence: Correspondence) -> tuple[str, ...]:
    """What to say of source points that the target does not show."""
    lacking = 1 - correspondence.supported.mean()
    if lacking < _WORTH_SAYING:
        return ()
    share = f"{100 * lacking:.0f} % of the source"
    return (f"{share} has no counterpart in the target and follows the rest.",)


def _report(
    pair: Pair,
    correspondence: Correspondence,
    displacement: np.ndarray,
    measures: Measures,
    trust: Trust,
    model: Model,
) -> dict[str, Any]:
    """What the JSON report says, but for settings, landmarks and time."""
    lengths = np.linalg.norm(displacement, axis=1)[pair.source.used]
    alignment = pair.alignment
    return {
        "dine": __version__,
        "source": _described(pair.source),
        "target": _described(pair.target),
        "before": measures.before,
        "aligned": measures.aligned,
        "after": measures.after,
        "normalised": measures.normalised,
        "folding": measures.normalised["folding"],
        "displacement": {"mean": float(lengths.mean()), "max": float(lengths.max())},
        "trust": {
            "verdict": trust.verdict,
            "reasons": list(trust.reasons),
            "percentiles": trust.percentiles,
            "checks": measures.checks,
            "expected_error": trust.expected_error,
        },
        "alignment": alignment.matrix.tolist(),
        "normalisation": {
            "center": alignment.frame.center.tolist(),
            "scale": alignment.frame.scale,
        },
        "supported": float(correspondence.supported.mean()),
        "backbone": model.backbone.registered_name,
        "weights": {"file": model.weights.name, "sha256": file_digest(model.weights)},
        "prior": model.prior_path
        and {"file": model.prior_path.name, "sha256": file_digest(model.prior_path)},
    }


def _described(surface: Surface) -> dict[str, Any]:
    about = {"name": surface.name, "vertices": len(surface.vertices), "space": surface.space}
    return about | {"left_out": list(surface.left_out)}


def _landmarks(here: np.ndarray, there: np.ndarray, motion: Motion) -> dict[str, Any]:
    return {
        "count": len(here),
        "before": landmark_errors(here, there),
        "after": landmark_errors(motion(here), there),
    }
