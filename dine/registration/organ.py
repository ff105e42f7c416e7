"""Registration of one organ with a prior of its own: its template, and a whole or partial scan.

The template starts where the prior expects it. Each round lays points of the scan onto its surface
and solves for the most probable field (:mod:`dine.refinement.surface`). How the organ lies is part
of the field, as small rigid motions; what is found of these turns the template before the field is
sought again. The prior says in which ways organs deform; how much this one did, which the bounds
hang on, is taken from the scan (MacKay, 1992, Bayesian interpolation). Lengths are in the
normalised frame, radii of the template.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy.sparse import csr_matrix, vstack
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from dine import __version__
from dine.data.sampling import sample_surface
from dine.errors import ConfigError, DataError
from dine.geometry.distance import distances, landmark_errors, surface_distance
from dine.geometry.folding import folding
from dine.geometry.interpolation import FittedDisplacement
from dine.geometry.oriented import Curve, OrientedPoints, evenly, unit
from dine.geometry.rigid import Alignment, check_rigid, motion_between, rigid_alignments
from dine.geometry.surface import Surface
from dine.geometry.voxels import NodeField, Voxels
from dine.priors.gaussian import CovarianceRoot, LinearGaussian, Posterior, covariance_root
from dine.priors.organ import OrganPrior
from dine.refinement.surface import (
    NO_GUIDES,
    Outline,
    SurfaceOptions,
    refine_on_surface,
    spread,
)
from dine.registration.assessment import DOUBTFUL, GOOD, IMPLAUSIBLE
from dine.registration.shapes import check_sizes, check_spaces, checked_landmarks, dense_points
from dine.registration.surfaces import oriented_points
from dine.registration.types import Guide, Motion, RegistrationResult, Trust

SOURCE_POINTS = 1500
TARGET_POINTS = 8000
_DRAWN = 4
_RANK, _TOLERANCE = 120, 3e-3
# Standard deviations of how an organ lies after rigid alignment, radii and radians.
_SHIFT, _TURN = 0.1, 0.15
# Points of template and scan that are aligned rigidly. Then what finds out how it lies, so many
# times, on so many points; then the field.
_ALIGNED = 1000
_POSE = SurfaceOptions(firsts=(0.1,), between=0.05, last=0.03, rounds=6)
_POSES = 2
_POSE_POINTS, _POSE_TARGETS = 500, 2000
_FIELD = SurfaceOptions(firsts=(0.08, 0.15), last=0.02, rounds=10)
# What is far less than matches are sure of is left out while the pose is looked for and several
# fields are tried: components that leave so much, but for so many at the least, and all but so many
# columns of a process that is no larger than this.
_LEFT, _ROUGH_MODES = 0.005, 30
_SMALL, _ROUGH_RANK = 0.02, 30
# Share of the vertices that are to lie within their bounds; and how much wider these are than if
# prior and matches were right, which was chosen on shapes that docs/guide/organ.md does not show.
BOUND = 0.9
_WIDER = 1.4
BOUND_NAME = "bound_90"
# Parts of the radius: what a scan that shows the organ is near to, and what counts as seen.
_NEAR, _SEEN = 0.1, 0.05
_SHOWN = 0.5
# How much deformations are of what is usual: from here on it is worth a word, and no less is taken
# to be known. Not below 1, or bounds would be narrowest where a scan shows the side that is held,
# which moves little whatever the rest does.
_UNUSUAL, _LEAST_SCALE = 2.0, 1.0
_APART = 0.03
_FOLDED, _INSIDE_OUT = 0.02, 0.1
Start = Callable[[np.ndarray], np.ndarray]
"""A field, of places (N, 3) in the normalised frame."""
_NO_RIM = Curve(np.zeros((0, 3)), np.zeros((0, 3)))


@dataclass(frozen=True)
class Placed:
    """A prior whose template lies as an alignment says; ``loose`` if it may lie a bit otherwise."""

    prior: OrganPrior
    alignment: Alignment
    loose: bool

    @classmethod
    def lying(cls, prior: OrganPrior, matrix: np.ndarray, loose: bool) -> Placed:
        """As a 4×4 matrix says, by the template's own vertices: those that no face uses may lie
        anywhere."""
        alignment = Alignment.of(prior.template.vertices[prior.template.used], matrix)
        return cls(prior, alignment, loose)

    @cached_property
    def rotation(self) -> np.ndarray:
        """(3, 3), of the alignment."""
        return self.alignment.matrix[:3, :3]

    def at(self, carrier: csr_matrix, places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Mean (N, 3) and modes (R, N, 3) at places (N, 3) that a carrier leads to; the first six
        are rigid, if it lies loosely."""
        mean, modes = self.prior.at(carrier)
        mean, modes = mean @ self.rotation.T, modes @ self.rotation.T
        return mean, np.concatenate([self._rigid(places), modes]) if self.loose else modes

    def moved(self, carrier: csr_matrix, places: np.ndarray, amplitudes: np.ndarray) -> np.ndarray:
        """Displacement (N, 3) there where the modes have amplitudes (R,)."""
        rigid, own = np.split(amplitudes, [6 if self.loose else 0])
        prior = self.prior
        found = carrier @ (prior.mean + np.tensordot(own, prior.modes, axes=1)) @ self.rotation.T
        return found + np.tensordot(rigid, self._rigid(places), axes=1) if self.loose else found

    @staticmethod
    def _rigid(places: np.ndarray) -> np.ndarray:
        """(6, N, 3) small motions along and about the axes."""
        axes = np.eye(3)[:, None]
        shifts = np.broadcast_to(_SHIFT * axes, (3, *places.shape))
        return np.concatenate([shifts, _TURN * np.cross(axes, places[None])])

    def turned(self, posterior: Posterior) -> Placed:
        """Lying as the rigid modes of a posterior say."""
        shift, turn = _SHIFT * posterior.shared[:3], _TURN * posterior.shared[3:6]
        motion = np.eye(4)
        motion[:3, :3] = Rotation.from_rotvec(turn).as_matrix()
        frame = self.alignment.frame
        middle = frame.center
        motion[:3, 3] = middle + frame.scale * shift - motion[:3, :3] @ middle
        return Placed.lying(self.prior, motion @ self.alignment.matrix, self.loose)


@dataclass(frozen=True)
class OrganField:
    """What was found of the field of a template, in the normalised frame.

    Attributes:
        placed: the prior, as the template lies.
        posterior: of the field at points of the surface.
        root: of the process, at these.
        improbability: −log of the evidence, up to a constant of the scan.
    """

    placed: Placed
    posterior: Posterior
    root: CovarianceRoot
    improbability: float

    def at(self, carrier: csr_matrix, places: np.ndarray) -> np.ndarray:
        """Displacement (N, 3) at places (N, 3) that a carrier leads to."""
        moved = self.placed.moved(carrier, places, self.posterior.shared)
        return moved + self.root.field(places, self.posterior.alone)

    def covariance(self, carrier: csr_matrix, places: np.ndarray) -> np.ndarray:
        """(N, 3, 3) of it, or more where the organ deformed more than is usual under the prior."""
        _, modes = self.placed.at(carrier, places)
        scale = _WIDER * max(self.posterior.scale, _LEAST_SCALE)
        return scale**2 * self.posterior.covariance(self.root.at(places), modes)

    def anywhere(self) -> NodeField | FittedDisplacement:
        """The field at any places (M, 3): by the prior's own inside where it has one, or else
        interpolated from the vertices."""
        prior, alignment = self.placed.prior, self.placed.alignment
        if prior.voxels is None:
            places = alignment.normalise(prior.template.vertices)
            return FittedDisplacement(places, self.at(prior.at_vertices(), places))
        found, frame = prior.voxels, prior.frame
        field = self.at(prior.inside(found.nodes), alignment.normalise(found.nodes))
        nodes, edge = frame.normalise(found.nodes), found.edge / frame.scale
        voxels = Voxels(nodes, found.cubes, found.inside, edge)
        return NodeField(voxels, field, self.placed.rotation)

    def bounds(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Standard deviation and bound (M,) at points (M, 3) in the template's units; those of the
        nearest vertex where nothing is known inside."""
        carrier, points = _known_at(self.placed.prior, points)
        places = self.placed.alignment.normalise(points)
        return deviation_and_bound(self.covariance(carrier, places))


def _known_at(prior: OrganPrior, points: np.ndarray) -> tuple[csr_matrix, np.ndarray]:
    """The carrier to points (M, 3) in the template's units, and these; the nearest vertices where
    nothing is known inside."""
    carrier = prior.inside(points)
    if carrier is not None:
        return carrier, points
    nearest = cKDTree(prior.template.vertices).query(points)[1]
    return prior.at_vertices()[nearest], prior.template.vertices[nearest]


def deviation_and_bound(covariance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Root mean square (M,) of the lengths of Gaussian vectors with covariances (M, 3, 3), and the
    length (M,) that ``BOUND`` of them are below.

    The squared length as a multiple of a χ² with the same mean and variance (Satterthwaite).
    """
    mean = np.trace(covariance, axis1=1, axis2=2)
    squares = np.einsum("mab,mab->m", covariance, covariance)
    unit_ = squares / np.maximum(mean, np.finfo(float).tiny)
    degrees = np.clip(mean / np.maximum(unit_, np.finfo(float).tiny), 1, 3)
    return np.sqrt(mean), np.sqrt(unit_ * chi2.ppf(BOUND, degrees))


@dataclass(frozen=True)
class _Search:
    """A scan, and points of the template to lay it onto.

    Attributes:
        carrier: (N, V + n) from values of the prior to those at the points.
        places: (N, 3) of the points, template's units.
        normals: (N, 3) of these.
        scan: in the units of the target.
        partial: it shows a part of the organ only.
        guide: landmarks to keep to, if any, whose carrier (L, V + n) is ``guided``.
    """

    carrier: csr_matrix
    places: np.ndarray
    normals: np.ndarray
    scan: OrientedPoints
    partial: bool
    guide: Guide | None = None
    guided: csr_matrix | None = None

    @classmethod
    def of(cls, prior: OrganPrior, target: Surface, partial: bool, seed: int) -> _Search:
        """Points that cover the template and the target evenly."""
        rng = np.random.default_rng([8, seed])
        template = prior.template
        samples = sample_surface(template, _DRAWN * SOURCE_POINTS, rng)
        kept = evenly(samples.places(template.vertices), SOURCE_POINTS)
        samples = samples[kept]
        corners = template.vertices[samples.faces_vertices]
        normals = unit(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]))
        scan = oriented_points(target, TARGET_POINTS, rng)
        places = samples.places(template.vertices)
        return cls(prior.on_surface(samples), places, normals, scan, partial)

    def keeping_to(self, prior: OrganPrior, guide: Guide | None) -> _Search:
        """The same with landmarks, which are observed as they are in every round."""
        if guide is None:
            return self
        carrier, places = _known_at(prior, guide.here)
        # What is known at the nearest vertex is taken to hold there.
        kept = replace(guide, here=places, there=guide.there + places - guide.here)
        return replace(self, guide=kept, guided=carrier)

    def fewer(self) -> _Search:
        """The same with fewer points of both."""
        kept = evenly(self.places, _POSE_POINTS)
        some = spread(len(self.scan.points), _POSE_TARGETS)
        return replace(
            self,
            carrier=self.carrier[kept],
            places=self.places[kept],
            normals=self.normals[kept],
            scan=self.scan.at(some),
        )

    def posed(self, placed: Placed) -> Placed:
        """Lying as is found on few points, by the components that deform most."""
        prior, few = placed.prior, self.fewer()
        modes, rank = _enough(prior)
        rough = replace(placed, prior=replace(prior, modes=prior.modes[:modes]))
        for _ in range(_POSES):
            rough = rough.turned(few.found(rough, _POSE, rank=rank).posterior)
        return replace(rough, prior=prior)

    def found(
        self,
        placed: Placed,
        options: SurfaceOptions,
        starts: Sequence[Start] = (),
        rank: int = _RANK,
    ) -> OrganField:
        """The most probable field, from the prior's mean, and from others too."""
        alignment, prior = placed.alignment, placed.prior
        places = alignment.normalise(self.places)
        inner = np.zeros(len(places), bool)
        moving = OrientedPoints(places, self.normals @ placed.rotation.T, inner)
        fixed = self.scan._replace(points=alignment.frame.normalise(self.scan.points))
        carrier, guides = self.carrier, NO_GUIDES
        if self.guide is not None:
            guides = self.guide.within(alignment)
            carrier, places = vstack([carrier, self.guided]), np.vstack([places, guides.places])
        root = covariance_root(
            places, prior.widths, prior.amplitudes, rank=rank, tolerance=_TOLERANCE
        )
        mean, modes = placed.at(carrier, places)
        tried, columns = _enough(prior)
        options = replace(
            options,
            source_looks=not self.partial,
            tried_modes=tried + (6 if placed.loose else 0),
            tried_columns=columns,
        )
        found = refine_on_surface(
            Outline(moving, _NO_RIM),
            Outline(fixed, _NO_RIM),
            [mean, *(start(places) for start in starts)],
            LinearGaussian(mean, modes, root.root),
            options,
            guides,
        )
        return OrganField(placed, found.posterior, root, found.improbability)


def _enough(prior: OrganPrior) -> tuple[int, int]:
    """How many components and columns of the process a rough search needs."""
    modes = max(_ROUGH_MODES, int((prior.left_after > _LEFT).sum()))
    return modes, _ROUGH_RANK if np.linalg.norm(prior.amplitudes) <= _SMALL else _RANK


def organ_field(
    prior: OrganPrior,
    target: Surface,
    matrices: Sequence[np.ndarray],
    *,
    loose: bool,
    partial: bool,
    seed: int,
    starts: Sequence[Start] = (),
) -> tuple[OrganField, _Search]:
    """The field that brings a template, aligned by one of some 4×4 matrices, onto a scan of it.

    ``loose`` if the alignment is not known exactly. ``starts`` are further fields to begin with,
    beside the prior's mean.
    """
    search = _Search.of(prior, target, partial, seed)
    return _most_probable(search, prior, matrices, loose, starts), search


def _most_probable(
    search: _Search,
    prior: OrganPrior,
    matrices: Sequence[np.ndarray],
    loose: bool,
    starts: Sequence[Start] = (),
) -> OrganField:
    found = []
    for matrix in matrices:
        placed = Placed.lying(prior, matrix, loose)
        if loose:
            placed = search.posed(placed)
        found.append(search.found(placed, _FIELD, starts))
    return min(found, key=lambda field: field.improbability)


@dataclass(frozen=True)
class OrganSettings:
    """How to register with a prior of an organ; as for
    :func:`~dine.registration.register.register`."""

    prealign: str | np.ndarray
    partial: bool
    seed: int
    guide: Guide | None = None

    def described(self) -> dict[str, Any]:
        """For the report."""
        how = self.prealign if isinstance(self.prealign, str) else "given"
        guides = 0 if self.guide is None else len(self.guide.here)
        return {"prealign": how, "partial": self.partial, "seed": self.seed, "guides": guides}


def register_organ(
    source: Surface,
    target: Surface,
    prior: OrganPrior,
    settings: OrganSettings,
    *,
    apply: Mapping[str, Surface],
    landmarks: tuple[np.ndarray, np.ndarray] | None,
) -> RegistrationResult:
    """The template of a prior registered to a whole or partial scan of the organ.

    Raises:
        DataError: another mesh than the prior's template, shapes of other sizes, or a scan that
            shows hardly anything of the organ.
        ConfigError: unusable settings.
    """
    began = time.perf_counter()
    prior.check(source)
    marks = None if landmarks is None else checked_landmarks(landmarks, source, target)
    check_spaces(source, (target, *apply.values()))
    notes = check_sizes(source, target, settings.partial)
    matrices, loose = _motions(source, target, settings)
    search = _Search.of(prior, target, settings.partial, settings.seed)
    search = search.keeping_to(prior, settings.guide)
    field = _most_probable(search, prior, matrices, loose)
    report = {"settings": settings.described()}
    result = _result(field, search, source, target, report)
    trust = _trust(field, report, notes, float(result.uncertainty[source.used].mean()))
    report["trust"] = {
        "verdict": trust.verdict,
        "reasons": list(trust.reasons),
        "percentiles": trust.percentiles,
        "expected_error": trust.expected_error,
    }
    report["applied"] = {}
    for name, surface in apply.items():
        bound = field.placed.alignment.frame.scale * field.bounds(surface.vertices)[1]
        moved = result.motion.surface(surface)
        result.applied[name] = replace(moved, data={**surface.data, BOUND_NAME: bound})
        result.applied_from[name] = surface.vertices
        report["applied"][name] = {BOUND_NAME: _summary(bound)}
    if marks is not None:
        here, there = marks
        after = landmark_errors(result.motion(here), there)
        before = landmark_errors(here, there)
        report["landmarks"] = {"count": len(here), "before": before, "after": after}
    report["seconds"] = time.perf_counter() - began
    return replace(result, trust=trust)


def _result(
    field: OrganField,
    search: _Search,
    source: Surface,
    target: Surface,
    report: dict[str, Any],
) -> RegistrationResult:
    """The moved template with bounds; what is said of it goes into the report."""
    prior, alignment = field.placed.prior, field.placed.alignment
    scale = alignment.frame.scale
    vertices = alignment.normalise(source.vertices)
    moved = replace(
        source, vertices=alignment.restore(vertices + field.at(prior.at_vertices(), vertices))
    )
    places = alignment.normalise(search.places)
    moved_points = places + field.at(search.carrier, places)
    shown = distances(moved_points, alignment.frame.normalise(search.scan.points)) < _SEEN
    known = deviation_and_bound(field.covariance(search.carrier, places))
    near, weights = _nearest(places, vertices)
    deviation, bound = (scale * (x[near] * weights).sum(axis=1) for x in known)
    report |= _report(field, search, source, target, moved)
    report |= {
        "supported": float(shown.mean()),
        "uncertainty": _summary(deviation[source.used]),
        BOUND_NAME: _summary(bound[source.used]),
    }
    return RegistrationResult(
        source,
        target,
        moved,
        moved.vertices - source.vertices,
        deviation,
        {},
        search.places,
        alignment.restore(moved_points) - search.places,
        scale * known[0],
        shown,
        Trust(GOOD, (), {}, None),
        report,
        alignment=alignment,
        motion=Motion(alignment, field.anywhere()),
        bound=bound,
    )


def _motions(
    source: Surface, target: Surface, settings: OrganSettings
) -> tuple[list[np.ndarray], bool]:
    """The 4×4 matrices to begin with, and whether they may be improved on."""
    how = settings.prealign
    if not isinstance(how, str):
        return [check_rigid(how)], False
    if how == "off":
        return [np.eye(4)], False
    if how != "auto":
        raise ConfigError(f"The alignment is {how!r}; expected auto, off or a 4×4 matrix.")
    if settings.guide is not None and settings.guide.tells_rotation:
        return [motion_between(settings.guide.here, settings.guide.there)], True
    return rough_alignments(source, target, partial=settings.partial), True


def rough_alignments(source: Surface, target: Surface, *, partial: bool) -> list[np.ndarray]:
    """The 4×4 rigid motions that may bring a template onto a scan, roughly: the search for a field
    mends them."""
    dense = (dense_points(surface) for surface in (source, target))
    return rigid_alignments(*(x[evenly(x, _ALIGNED)] for x in dense), partial=partial)


def _nearest(places: np.ndarray, queries: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Indices (M, 3) of the places (N, 3) nearest to queries (M, 3), and weights (M, 3)."""
    distance, near = cKDTree(places).query(queries, k=3)
    weights = 1 / np.maximum(distance, 1e-9)
    return near, weights / weights.sum(axis=1, keepdims=True)


def _summary(values: np.ndarray) -> dict[str, float]:
    return {"mean": float(values.mean()), "max": float(values.max())}


def _report(
    field: OrganField,
    search: _Search,
    source: Surface,
    target: Surface,
    moved: Surface,
) -> dict[str, Any]:
    """What the JSON report says, but for bounds, trust, landmarks and time.

    Raises:
        DataError: little of the scan is anywhere near the moved template.
    """
    alignment = field.placed.alignment
    shown = (0.0 if search.partial else 1.0, 1.0)
    seen = dense_points(target)
    surfaces = (source, replace(source, vertices=alignment.align(source.vertices)), moved)
    ours = [dense_points(surface) for surface in surfaces]
    before, aligned, after = (surface_distance(x, seen, shown=shown) for x in ours)
    apart = distances(seen, ours[2]) / alignment.frame.scale
    if (apart < _NEAR).mean() < _SHOWN:
        raise DataError(
            f"{target.name} shows hardly anything of {source.name}: "
            f"{100 * (apart >= _NEAR).mean():.0f} % of it stays farther away than a tenth of the "
            "radius; check that it is this organ, and how it lies (--prealign)."
        )
    places = alignment.normalise(search.places)
    lengths = np.linalg.norm(moved.vertices - source.vertices, axis=1)[source.used]
    return {
        "dine": __version__,
        "source": {"name": source.name, "vertices": len(source.vertices)},
        "target": {"name": target.name, "vertices": len(target.vertices)},
        "before": before,
        "aligned": aligned,
        "after": after,
        "folding": folding(places, field.at(search.carrier, places)),
        "apart": float(np.quantile(apart, 0.95)),
        "displacement": _summary(lengths),
        "alignment": alignment.matrix.tolist(),
        "normalisation": {
            "center": alignment.frame.center.tolist(),
            "scale": alignment.frame.scale,
        },
        "backbone": None,
        "weights": None,
        "organ_prior": {
            "components": len(field.placed.prior.modes),
            "fields": field.placed.prior.facts.get("fields"),
            "scale": field.posterior.scale,
        },
    }


def _trust(field: OrganField, report: dict[str, Any], notes: list[str], deviation: float) -> Trust:
    """What the result itself says of how far to trust it."""
    reasons = list(notes)
    if report["folding"] > _FOLDED:
        reasons.append(
            f"The field turns {100 * report['folding']:.0f} % of the neighbourhoods inside out, "
            "which tissue does not do."
        )
    if report["apart"] > _APART:
        reasons.append(
            f"A twentieth of the scan stays farther than {100 * report['apart']:.0f} % of the "
            "radius away from the moved template; what it shows there is something else, or "
            "nothing that the prior knows."
        )
    if field.posterior.scale > _UNUSUAL:
        reasons.append(
            f"The organ deformed {field.posterior.scale:.1f} times more than is usual under the "
            "prior."
        )
    verdict = DOUBTFUL if reasons else GOOD
    if report["folding"] > _INSIDE_OUT:
        verdict = IMPLAUSIBLE
    return Trust(verdict, tuple(reasons), {}, deviation)
