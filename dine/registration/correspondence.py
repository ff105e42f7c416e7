"""Which point went where, once aligned: the network's field, its refinement, and the way back."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from dine.data.batch import make_batch
from dine.errors import DataError
from dine.geometry.distance import distances, spacings
from dine.geometry.frame import Frame
from dine.geometry.interpolation import FittedDisplacement
from dine.models.backbones import Backbone, marginal_deviation
from dine.progress import stage
from dine.refinement.refine import DEFAULTS, Observed, Options, refine
from dine.registration.shapes import FEWEST
from dine.registration.surfaces import FULL, Detail, refined_on_surfaces
from dine.registration.types import Correspondence, Model, Overlap, Pair, Settings

# A source point is shown by the target if a target point ends up within so many spacings of it.
_RETURN = 3.0
# Points that end so close to each other are the same, and the share of such from which all are.
_SAME = 1e-9
_SHARED = 0.5


def correspond(
    pair: Pair,
    model: Model,
    settings: Settings,
    detail: Detail = FULL,
    before: Correspondence | None = None,
) -> Correspondence:
    """Where the source's points belong.

    Args:
        detail: of the look at surfaces.
        before: what is known already, and what the drawn points are asked for otherwise.

    Raises:
        DataError: the target, a part of the source, ends up beside it.
    """
    found = before or _from_points(pair, model, settings)
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
