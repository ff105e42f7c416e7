"""What a prior of one organ says of what a scan does not show, and what others say.

Deformations are known, so the true place of every vertex is. A scan shows a share of the surface
from one side, with noise. Errors are mean distances of vertices from their true places: hidden and
seen ones, and of a ball of radius 0.05 in the middle of the thickest part. All lengths are in
radii of the template.

The methods with a prior share alignment, matching and schedule, and differ in the prior alone.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import get_args

import numpy as np
import pandas as pd
from scipy.spatial.transform import Rotation

from dine.classical.methods import CLASSICAL
from dine.config import OrganTrial, Simulation, TrialMethod
from dine.geometry.interpolation import FittedDisplacement
from dine.geometry.oriented import evenly
from dine.geometry.rigid import motion_between, rigid_alignment, transformed
from dine.geometry.surface import Surface
from dine.priors.gaussian import LinearGaussian, Posterior, covariance_root
from dine.priors.organ import OrganPrior
from dine.progress import Progress
from dine.refinement.process import SURFACE
from dine.registration.organ import (
    OrganField,
    Placed,
    deviation_and_bound,
    organ_field,
    rough_alignments,
)
from dine.registration.shapes import dense_points
from dine.simulation.fields import OrganDeformations
from dine.trials.conditions import of_mechanics, of_size
from dine.trials.mechanics import inside_points

log = logging.getLogger(__name__)

SEEN, NOISE = 0.4, 0.005
SHARES = (0.2, 0.4, 0.6, 0.8, 0.99)
NOISES = (0.0, 0.01, 0.02)
# Degrees that a scan is turned by where its pose is to be found.
_TURNED = 15
# Points that Bayesian CPD moves; seen vertices whose true places are given; hidden ones whose
# bounds are looked at.
_FEW, _GIVEN, _BOUNDED = 1000, 800, 500
_RANK, _TOLERANCE = 300, 1e-4
# How often the template is turned as the places given say, where the pose is not known.
_POSES = 3
ERRORS = ("hidden", "seen", "target")
COLUMNS = ["about", "condition", "method", "deformation", *ERRORS, "within"]


@dataclass(frozen=True)
class Case:
    """One deformation and what is seen of it, in radii.

    Attributes:
        template: of V vertices.
        truth: (V, 3) true places of the vertices.
        deep: (M, 3) true places of the points inside.
        scan: what is seen.
        seen: (V,) bool, vertices of it.
        motion: that the scan was turned by, which is not told; None if it lies as it is.
    """

    template: Surface
    truth: np.ndarray
    deep: np.ndarray
    scan: Surface
    seen: np.ndarray
    motion: Rotation | None = None

    def turned(self, number: int) -> Case:
        """The same, turned by some angle about a drawn axis."""
        rng = np.random.default_rng([4, number])
        motion = Rotation.from_rotvec(np.radians(_TURNED) * rng.normal(size=3) / np.sqrt(3))
        scan = replace(self.scan, vertices=motion.apply(self.scan.vertices))
        return replace(self, scan=scan, motion=motion)

    def shown(self, places: np.ndarray) -> np.ndarray:
        """Places (N, 3) as the scan lies."""
        return places if self.motion is None else self.motion.apply(places)

    def as_it_lay(self, places: np.ndarray) -> np.ndarray:
        """Places (N, 3) of the scan where it had not been turned."""
        return places if self.motion is None else self.motion.inv().apply(places)

    def errors(self, vertices: np.ndarray, deep: np.ndarray) -> dict[str, float]:
        """Of moved vertices (V, 3) and points inside (M, 3)."""
        vertices, deep = self.as_it_lay(vertices), self.as_it_lay(deep)
        error = np.linalg.norm(vertices - self.truth, axis=1)
        return {
            "hidden": float(error[~self.seen].mean()),
            "seen": float(error[self.seen].mean()),
            "target": float(np.linalg.norm(deep - self.deep, axis=1).mean()),
        }


def seen_of(fields: OrganDeformations, share: float = SEEN, noise: float = NOISE) -> list[Case]:
    """For each deformation the faces that lie farthest in a drawn direction, up to a share of the
    area, with noise."""
    template = fields.template
    inside = fields.voxels.carrier(inside_points(template))
    found = []
    for number, (field, nodes) in enumerate(zip(fields.vertices, fields.nodes, strict=True)):
        rng = np.random.default_rng([3, number])
        truth = template.vertices + field
        corners = truth[template.faces]
        area = np.linalg.norm(
            np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1
        )
        order = np.argsort(-corners.mean(axis=1) @ rng.normal(size=3))
        kept = order[np.cumsum(area[order]) <= share * area.sum()]
        used, index = np.unique(template.faces[kept], return_inverse=True)
        seen = np.zeros(len(truth), bool)
        seen[used] = True
        places = truth[used] + noise * rng.normal(size=(len(used), 3))
        scan = Surface(places, index.reshape(-1, 3), "scan")
        deep = inside_points(template) + inside @ nodes
        found.append(Case(template, truth, deep, scan, seen))
    return found


# --- methods: from a case to errors -----------------------------------------------------------

Method = Callable[[Case], dict[str, float]]


@dataclass(frozen=True)
class Methods:
    """What is compared.

    Attributes:
        prior: of the template.
        one_patch: the same of simulations that are all held at one patch; None to leave it out.
    """

    prior: OrganPrior
    one_patch: OrganPrior | None = None

    @cached_property
    def by_name(self) -> dict[str, Method]:
        """In the order in which they are shown."""
        prior = self.prior
        smooth = replace(
            prior,
            mean=np.zeros_like(prior.mean),
            modes=prior.modes[:0],
            widths=SURFACE.widths,
            amplitudes=SURFACE.amplitudes,
        )
        alone = replace(prior, amplitudes=[1e-4] * len(prior.widths))
        found: dict[str, Method] = {
            "unregistered": lambda case: case.errors(case.template.vertices, _deep(case)),
            "rigid": _rigid,
            "bcpd": _bcpd,
            "smooth": lambda case: _registered(case, smooth),
            "pca": lambda case: _registered(case, alone),
            "pca_process": lambda case: _registered(case, prior),
        }
        if self.one_patch is not None:
            found["one_patch"] = lambda case: _registered(case, self.one_patch)
        return found | {"places_given": lambda case: _with_places(case, prior)}


def _deep(case: Case) -> np.ndarray:
    return inside_points(case.template)


def _rigid(case: Case) -> dict[str, float]:
    matrix = rigid_alignment(dense_points(case.template), dense_points(case.scan), partial=True)
    return case.errors(*(transformed(x, matrix) for x in (case.template.vertices, _deep(case))))


def _bcpd(case: Case) -> dict[str, float]:
    few = case.template.vertices[evenly(case.template.vertices, _FEW)]
    field = FittedDisplacement(few, CLASSICAL.get("bcpd")()(few, case.scan.vertices))
    return case.errors(*(x + field(x) for x in (case.template.vertices, _deep(case))))


def _registered(case: Case, prior: OrganPrior) -> dict[str, float]:
    """By the search of ``dine register --prior``; the pose is found where it was turned."""
    loose = case.motion is not None
    matrices = [np.eye(4)]
    if loose:
        matrices = rough_alignments(case.template, case.scan, partial=True)
    began = time.process_time()
    field, _ = organ_field(prior, case.scan, matrices, loose=loose, partial=True, seed=0)
    log.debug("%.2f CPU seconds", time.process_time() - began)
    return _measured(case, field)


def _with_places(case: Case, prior: OrganPrior) -> dict[str, float]:
    """Where the true places of seen vertices are given: what matching better could reach."""
    vertices = case.template.vertices
    given = np.flatnonzero(case.seen)
    given = given[evenly(vertices[given], _GIVEN)]
    here, there = vertices[given], case.shown(case.truth)[given]
    loose = case.motion is not None
    placed = Placed.lying(prior, motion_between(here, there) if loose else np.eye(4), loose)
    field = _given(placed, given, there)
    for _ in range(_POSES if loose else 0):
        placed = placed.turned(field.posterior)
        field = _given(placed, given, there)
    return _measured(case, field)


def _given(placed: Placed, given: np.ndarray, there: np.ndarray) -> OrganField:
    """The field that brings given vertices of a template to places (N, 3) of the scan."""
    prior, alignment = placed.prior, placed.alignment
    places = alignment.normalise(prior.template.vertices[given])
    root = covariance_root(places, prior.widths, prior.amplitudes, rank=_RANK, tolerance=_TOLERANCE)
    mean, modes = placed.at(prior.at_vertices()[given], places)
    precision = np.tile(NOISE**-2 * np.eye(3), (len(given), 1, 1))
    pulled = NOISE**-2 * (alignment.frame.normalise(there) - places)
    posterior = Posterior(LinearGaussian(mean, modes, root.root), pulled, precision)
    return OrganField(placed, posterior, root, 0.0)


def _measured(case: Case, field: OrganField) -> dict[str, float]:
    """Errors, and the share of hidden vertices within their bound."""
    prior, alignment = field.placed.prior, field.placed.alignment
    places = alignment.normalise(case.template.vertices)
    moved = alignment.restore(places + field.at(prior.at_vertices(), places))
    deep = alignment.normalise(_deep(case))
    moved_deep = alignment.restore(deep + field.anywhere()(deep))
    hidden = np.flatnonzero(~case.seen)
    few = hidden[:: max(1, len(hidden) // _BOUNDED)]
    _, bound = deviation_and_bound(field.covariance(prior.at_vertices()[few], places[few]))
    error = np.linalg.norm(case.as_it_lay(moved) - case.truth, axis=1)
    return case.errors(moved, moved_deep) | {"within": float((error[few] <= bound).mean())}


# --- questions --------------------------------------------------------------------------------


def asked(
    about: str, truth: OrganDeformations, held: np.ndarray, settings: Simulation
) -> Iterator[tuple[str, list[Case]]]:
    """The conditions of a question and their cases.

    Args:
        about: ``methods``, one condition; ``seen``, shares, noise and pose; ``mechanics``, what
            simulations may be wrong about; ``size``, amplitudes.
        truth: deformations by other mechanics, which the first two are about.
        held: (V,) bool, where what is held may be, for the others.
        settings: of the simulations that a prior was learned of, for the others.
    """
    if about == "methods":
        yield f"{100 * SEEN:g} % seen", seen_of(truth)
    elif about == "seen":
        for share in SHARES:
            yield f"{100 * share:g} % seen", seen_of(truth, share)
        for noise in NOISES:
            yield f"noise of {100 * noise:g} %", seen_of(truth, noise=noise)
        cases = [case.turned(number) for number, case in enumerate(seen_of(truth))]
        yield f"turned by some {_TURNED} degrees, pose found", cases
    else:
        simulated = {"mechanics": of_mechanics, "size": of_size}[about]
        settings = settings.model_copy(update={"fields": len(truth.vertices)})
        for label, fields in simulated(truth.template, held, settings):
            yield label, seen_of(fields)


def trial(
    about: str,
    methods: Methods,
    truth: OrganDeformations,
    held: np.ndarray,
    settings: OrganTrial,
) -> pd.DataFrame:
    """Errors of the methods that are compared, a row for each condition, method and deformation."""
    compared = get_args(TrialMethod) if about == "methods" else settings.compared
    rows = []
    by_name = {name: method for name, method in methods.by_name.items() if name in compared}
    conditions = list(asked(about, truth, held, settings.simulation))
    total = len(conditions) * len(by_name) * len(truth.vertices)
    with Progress(about, total, unit="registration") as progress:
        for condition, cases in conditions:
            for name, method in by_name.items():
                for number, case in enumerate(cases):
                    labels = {"about": about, "condition": condition, "method": name}
                    rows.append({**labels, "deformation": number, **method(case)})
                    progress.update()
    return pd.DataFrame(rows, columns=COLUMNS)
