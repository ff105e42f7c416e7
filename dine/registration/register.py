"""Move one scan onto another: from two surfaces in any units to a moved surface and a report."""

from __future__ import annotations

import logging
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.spatial import cKDTree

from dine import __version__
from dine.data.sampling import SurfaceSamples, convention_order, sample_surface
from dine.errors import ConfigError, DataError
from dine.files import file_digest
from dine.geometry.distance import distances, landmark_errors, surface_distance
from dine.geometry.folding import folding
from dine.geometry.frame import Frame
from dine.geometry.interpolation import FittedDisplacement, FittedValues
from dine.geometry.rigid import check_rigid, rigid_alignment, transformed
from dine.geometry.surface import Surface
from dine.io.readers import read_surface
from dine.models.checkpoint import load_backbone
from dine.models.devices import chosen_device
from dine.priors import load_prior
from dine.refinement.refine import ROUNDS, Options, refine
from dine.registration.calibration import (
    Calibration,
    find_field,
    load_calibration,
    plausibility,
)
from dine.registration.trust import Trust, assess
from dine.training.stages import WEIGHTS, shipped_weights

log = logging.getLogger(__name__)

Shape = str | Path | Surface | np.ndarray | tuple[np.ndarray, np.ndarray]
"""A file, a surface, (V, 3) points, or vertices and faces."""

POINTS = 1024
FEWEST = 16
# Extents that differ by more than this come from other units or other objects.
_LARGEST_RATIO = 3.0
# Tissue hardly grows or shrinks that much, but from inches to centimetres it is 2.54.
_UNUSUAL_RATIO = 1.5
_UNITS = {1000: "metres and millimetres", 100: "metres and centimetres", 10: "cm and mm"}
_UNITS |= {25.4: "inches and millimetres", 2.54: "inches and centimetres"}
# A source point is shown by the target if a target point ends up within so many spacings of it.
_RETURN = 3.0


@dataclass(frozen=True)
class Model:
    """Weights with what belongs to them; see :func:`load_model`."""

    backbone: Any
    weights: Path
    facts: dict[str, Any]
    prior: Any = None
    prior_path: Path | None = None
    calibration: Calibration | None = None

    @property
    def convention(self) -> str:
        """The order of points that the prior was fitted in; ``none`` where it does not say."""
        return str(self.prior.notes.get("convention", "none")) if self.prior else "none"


def load_model(
    backbone: str | None = None,
    *,
    weights: str | Path | None = None,
    prior: str | Path | None = None,
    calibration: str | Path | None = None,
) -> Model:
    """Weights, prior and calibration, by name or from files.

    Args:
        backbone: a backbone with shipped weights, by default ``robust_defreg``; must fit
            ``weights`` where these are given.
        weights: a file of weights, ours or as published by the authors of the backbones.
        prior: a file of a fitted prior; by default the shipped one with the shipped weights.
        calibration: a file of ``dine calibrate``, likewise.

    Raises:
        ConfigError: no shipped weights of this name, or other weights than the backbone's.
        CheckpointError: a file is missing, damaged, or something else.
        DataError: the calibration was made with other weights or another prior.
    """
    shipped = weights is None
    if shipped:
        backbone = backbone or "robust_defreg"
    path = shipped_weights(backbone) if shipped else Path(weights)
    network, facts = load_backbone(path)
    if backbone not in (None, network.registered_name):
        raise ConfigError(
            f"{path} holds weights of {network.registered_name}, not of {backbone}; leave out the "
            "backbone or name the right one."
        )
    if shipped:
        prior = prior or _beside(f"{backbone}.prior.safetensors")
        calibration = calibration or _beside(f"{backbone}.calibration.json")
    found = load_calibration(Path(calibration)) if calibration else None
    for what, file in (("model", path), ("prior", prior)):
        if found and found.facts.get(what) != (file_digest(Path(file)) if file else None):
            raise DataError(
                f"{calibration} was made with another {what} than {file or 'none'}; run "
                f"`dine calibrate` for this {what}."
            )
    return Model(
        network,
        path,
        facts,
        load_prior(prior) if prior else None,
        Path(prior) if prior else None,
        found,
    )


def _beside(name: str) -> Path | None:
    path = WEIGHTS / name
    return path if path.is_file() else None


@dataclass(frozen=True)
class RegistrationResult:
    """A source moved onto a target. All lengths are in the units of the source.

    Attributes:
        source: as given.
        target: as given.
        moved: the source with its vertices moved, same order and faces.
        displacement: (V, 3) moved minus source vertices; includes the rigid alignment.
        uncertainty: (V,) expected distance from the true place, or None without calibration.
        applied: moved further points or surfaces, by name.
        points: (n, 3) sampled source points that the network saw, where they are in the source.
        point_displacement: (n, 3) of these.
        point_uncertainty: (n,) of these, or None.
        supported: (n,) bool, points that the target shows; all, unless ``partial``.
        trust: how far to trust the result.
        report: everything that the JSON report says.
    """

    source: Surface
    target: Surface
    moved: Surface
    displacement: np.ndarray
    uncertainty: np.ndarray | None
    applied: dict[str, Surface]
    points: np.ndarray
    point_displacement: np.ndarray
    point_uncertainty: np.ndarray | None
    supported: np.ndarray
    trust: Trust
    report: dict[str, Any] = field(default_factory=dict)

    @property
    def distance_to_target(self) -> np.ndarray:
        """(V,) distance of every moved vertex to the nearest sampled place of the target."""
        return distances(self.moved.vertices, _dense(self.target))


def as_surface(shape: Shape, name: str) -> Surface:
    """Any accepted form as a surface.

    Raises:
        DataError: a file that cannot be read, or an array of another shape.
    """
    if isinstance(shape, Surface):
        return shape
    if isinstance(shape, str | Path):
        return read_surface(shape)
    if isinstance(shape, tuple):
        return Surface(shape[0], shape[1], name=f"The {name}")
    return Surface(np.asarray(shape), name=f"The {name}")


def register(
    source: Shape,
    target: Shape,
    *,
    model: Model | None = None,
    prealign: str | np.ndarray = "auto",
    apply: Mapping[str, Shape] | None = None,
    landmarks: tuple[np.ndarray, np.ndarray] | None = None,
    rounds: int = ROUNDS,
    partial: bool = False,
    points: int = POINTS,
    seed: int = 0,
    device: str = "auto",
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
        landmarks: corresponding (L, 3) points of source and target, to measure with only.
        rounds: of refinement at test time (most probable smooth field); 0 for the network's own.
        partial: the target shows a part of the source only. Regions without counterpart follow the
            others instead of being pulled onto the part.
        points: points that the network sees; it was trained with 1024.
        seed: of the draws.
        device: ``auto``, ``cpu`` or ``cuda``.

    Raises:
        DataError: unreadable or unusable shapes, such as points on a line, or of other sizes.
        ConfigError: unusable settings.
    """
    began = time.perf_counter()
    model = model or load_model()
    source, target = as_surface(source, "source"), as_surface(target, "target")
    notes = _check_sizes(source, target, partial)
    rng = np.random.default_rng([4, seed])
    samples = _draw(source, points, rng, "source")
    seen = _draw(target, points, rng, "target").places(target.vertices)
    places = samples.places(source.vertices)
    matrix = _aligned(prealign, places, seen, partial)
    frame = Frame.of(transformed(places, matrix))
    start = frame.normalise(transformed(places, matrix))
    order = convention_order(start, model.convention)
    places, start = places[order], start[order]
    goal = frame.normalise(seen)
    where = chosen_device(device)
    if rounds < 0:
        raise ConfigError(f"The number of rounds is {rounds}; expected 0 or more.")
    inconsistency = None
    if partial:
        found, supported = _from_part(start, goal, rounds)
        spread = None
        if not supported.all():
            notes.append(
                f"{100 * (~supported).mean():.0f} % of the source has no counterpart in the target "
                "and follows the rest."
            )
    else:
        found, spread = find_field(model.backbone, start, goal, where, rounds)
        supported = np.ones(len(start), bool)
        inconsistency = _inconsistency(model, start, goal, found, where, rounds)
    return _result(
        began,
        model,
        source,
        target,
        frame,
        matrix,
        places,
        start,
        goal,
        found,
        spread,
        supported,
        inconsistency,
        apply or {},
        landmarks,
        tuple(notes),
        {
            "rounds": rounds,
            "partial": partial,
            "points": len(start),
            "seed": seed,
            "prealign": prealign if isinstance(prealign, str) else "given",
            "device": str(where),
        },
    )


def _result(
    began: float,
    model: Model,
    source: Surface,
    target: Surface,
    frame: Frame,
    matrix: np.ndarray,
    places: np.ndarray,
    start: np.ndarray,
    goal: np.ndarray,
    found: np.ndarray,
    spread: np.ndarray | None,
    supported: np.ndarray,
    inconsistency: float | None,
    apply: Mapping[str, Shape],
    landmarks: tuple[np.ndarray, np.ndarray] | None,
    notes: tuple[str, ...],
    settings: dict[str, Any],
) -> RegistrationResult:
    fitted = FittedDisplacement(start, found)

    def move(vertices: np.ndarray) -> np.ndarray:
        aligned = frame.normalise(transformed(vertices, matrix))
        return frame.restore(aligned + fitted(aligned))

    def moved_surface(surface: Surface) -> Surface:
        return Surface(move(surface.vertices), surface.faces, name=surface.name)

    partial = settings["partial"]
    calibration = model.calibration
    if calibration and (partial or settings["rounds"] != calibration.facts.get("rounds")):
        calibration = None
    moved = moved_surface(source)
    displacement = moved.vertices - source.vertices
    uncertainty = at_points = expected = None
    if calibration is not None and spread is not None:
        error = calibration.expected_error(spread)
        aligned = frame.normalise(transformed(source.vertices, matrix))
        uncertainty = FittedValues(start, error[:, None])(aligned)[:, 0] * frame.scale
        at_points = error * frame.scale
        expected = float(at_points.mean())
    values = {
        "initial": surface_distance(start, goal, partial=partial)["chamfer"],
        "final": surface_distance(start + found, goal, partial=partial)["chamfer"],
        "reach": float(np.linalg.norm(found, axis=1).max()),
        "folding": folding(start, found),
    }
    if model.prior is not None and model.convention != "none":
        values |= plausibility(model.prior, found, start) or {}
    dense_target = _dense(target)
    dense_source = _dense(source)
    aligned = surface_distance(transformed(dense_source, matrix), dense_target, partial=partial)
    after = surface_distance(move(dense_source), dense_target, partial=partial)
    checks = {"remaining": _ratio(after["chamfer"], aligned["chamfer"])}
    if inconsistency is not None:
        checks["inconsistency"] = inconsistency
    if at_points is not None:
        moved_by = float(np.linalg.norm(found, axis=1).mean()) * frame.scale
        checks["uncertain"] = _ratio(float(at_points.mean()), moved_by)
    trust = assess(calibration, values, expected, checks=checks, notes=notes)
    report: dict[str, Any] = {
        "dine": __version__,
        "source": {"name": source.name, "vertices": len(source.vertices)},
        "target": {"name": target.name, "vertices": len(target.vertices)},
        "before": surface_distance(dense_source, dense_target, partial=partial),
        "aligned": aligned,
        "after": after,
        "normalised": values,
        "folding": values["folding"],
        "displacement": {
            "mean": float(np.linalg.norm(displacement, axis=1).mean()),
            "max": float(np.linalg.norm(displacement, axis=1).max()),
        },
        "trust": {
            "verdict": trust.verdict,
            "reasons": list(trust.reasons),
            "percentiles": trust.percentiles,
            "checks": checks,
            "expected_error": trust.expected_error,
        },
        "alignment": matrix.tolist(),
        "normalisation": {"center": frame.center.tolist(), "scale": frame.scale},
        "supported": float(supported.mean()),
        "backbone": model.backbone.registered_name,
        "weights": {"file": model.weights.name, "sha256": file_digest(model.weights)},
        "prior": model.prior_path
        and {"file": model.prior_path.name, "sha256": file_digest(model.prior_path)},
        "settings": settings,
    }
    if landmarks is not None:
        here, there = (np.asarray(x, dtype=np.float64) for x in landmarks)
        if here.shape != there.shape or here.ndim != 2 or here.shape[1] != 3:
            raise DataError(
                f"The landmarks have shapes {here.shape} and {there.shape}; expected as many rows "
                "of three coordinates on the source as on the target, in the same order."
            )
        report["landmarks"] = {
            "count": len(here),
            "before": landmark_errors(here, there),
            "after": landmark_errors(move(here), there),
        }
    applied = {name: moved_surface(as_surface(shape, name)) for name, shape in apply.items()}
    report["seconds"] = time.perf_counter() - began
    return RegistrationResult(
        source,
        target,
        moved,
        displacement,
        uncertainty,
        applied,
        places,
        frame.restore(start + found) - places,
        at_points,
        supported,
        trust,
        report,
    )


def _draw(surface: Surface, points: int, rng: np.random.Generator, what: str) -> SurfaceSamples:
    """Points of a surface; all of a cloud that has fewer."""
    if points < FEWEST:
        raise ConfigError(f"The number of points is {points}; expected at least {FEWEST}.")
    count = points
    if surface.faces is None:
        count = min(points, len(np.unique(surface.vertices, axis=0)))
        if count < FEWEST:
            raise DataError(
                f"{surface.name}, the {what}, has {count} distinct points; expected at least "
                f"{FEWEST}."
            )
    extent = surface.vertices - surface.vertices.mean(axis=0)
    widths = np.linalg.svd(extent, compute_uv=False)
    if widths[1] <= 1e-6 * widths[0]:
        raise DataError(
            f"All points of {surface.name}, the {what}, lie on one line; expected the surface of "
            "an object."
        )
    if count == len(surface.vertices) and surface.faces is None:
        index = np.arange(count)[:, None].repeat(3, axis=1)
        return SurfaceSamples(index, np.tile([1.0, 0, 0], (count, 1)))
    if surface.faces is None:
        _, first = np.unique(surface.vertices, axis=0, return_index=True)
        chosen = rng.permutation(first)[:count]
        return SurfaceSamples(chosen[:, None].repeat(3, axis=1), np.tile([1.0, 0, 0], (count, 1)))
    return sample_surface(surface, count, rng)


def _dense(surface: Surface) -> np.ndarray:
    """Points to measure distances with: four times as many as the network sees."""
    if surface.faces is None:
        return surface.vertices
    rng = np.random.default_rng(5)
    return sample_surface(surface, 4 * POINTS, rng).places(surface.vertices)


def _check_sizes(source: Surface, target: Surface, partial: bool) -> list[str]:
    """What to say of sizes that differ much.

    Raises:
        DataError: a shape is a single place, or sizes differ so much that units must.
    """
    sizes = []
    for surface, what in ((source, "source"), (target, "target")):
        middle = surface.vertices.mean(axis=0)
        sizes.append(float(np.linalg.norm(surface.vertices - middle, axis=1).mean()))
        if len(surface.vertices) == 1 or sizes[-1] <= 1e-12 * np.abs(middle).max():
            raise DataError(
                f"All points of {surface.name}, the {what}, coincide; expected the surface of an "
                "object."
            )
    ratio = max(sizes) / min(sizes)
    larger, other = (source, target) if sizes[0] > sizes[1] else (target, source)
    units = [text for factor, text in _UNITS.items() if 0.7 < ratio / factor < 1.4]
    guess = (
        f" Perhaps one is in {units[0].replace(' and ', ' and the other in ')}." if units else ""
    )
    if ratio > _LARGEST_RATIO:
        raise DataError(
            f"{larger.name} is {ratio:.3g} times larger than {other.name}; both must be in the "
            f"same units and show the same object.{guess}"
        )
    if ratio > _UNUSUAL_RATIO and not partial:
        return [f"{larger.name} is {ratio:.2g} times larger than {other.name}.{guess}"]
    return []


def _aligned(
    how: str | np.ndarray, source: np.ndarray, target: np.ndarray, partial: bool
) -> np.ndarray:
    if not isinstance(how, str):
        return check_rigid(how)
    if how == "off":
        return np.eye(4)
    if how == "auto":
        return rigid_alignment(source, target, partial=partial)
    raise ConfigError(f"The alignment is {how!r}; expected auto, off or a 4×4 matrix.")


def _from_part(start: np.ndarray, goal: np.ndarray, rounds: int) -> tuple[np.ndarray, np.ndarray]:
    """Displacement (N, 3) and support (N,) of source points whose target is a part of them.

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
    reach = _RETURN * float(np.median(cKDTree(start).query(start, k=2)[0][:, 1]))
    supported = distances(start, places) < reach
    if supported.sum() < FEWEST:
        raise DataError(
            "Hardly any part of the source is found in the target; check that both show the same "
            "object, or leave out `partial`."
        )
    return FittedDisplacement(places, -back)(start), supported


def _inconsistency(
    model: Model,
    start: np.ndarray,
    goal: np.ndarray,
    found: np.ndarray,
    where: torch.device,
    rounds: int,
) -> float:
    """Mean distance from where they began of points moved to the target and, by the field of the
    opposite registration, back; normalised frame.

    A wrong correspondence can fit as well as the right one, but is seldom found from both sides.
    """
    frame = Frame.of(goal)
    seen, whole = frame.normalise(goal), frame.normalise(start)
    back = find_field(model.backbone, seen, whole, where, rounds)[0] * frame.scale
    places = start + found
    return float(np.linalg.norm(found + FittedDisplacement(goal, back)(places), axis=1).mean())


def _ratio(value: float, of: float) -> float:
    return value / of if of > 0 else 1.0


def shapes_by_name(paths: Sequence[Path]) -> dict[str, Path]:
    """Files by their stem.

    Raises:
        ConfigError: two of the same stem.
    """
    named = {path.stem: path for path in paths}
    if len(named) < len(paths):
        raise ConfigError("Two of the shapes to move along have the same name; rename one.")
    return named
