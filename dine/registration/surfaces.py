"""From points to surfaces: the last stage of a registration, on as much of both as there is."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.linalg import solve
from scipy.spatial import cKDTree

from dine.data.sampling import sample_surface
from dine.geometry.distance import nearest, spacings
from dine.geometry.interpolation import within_reach
from dine.geometry.oriented import (
    Curve,
    OrientedPoints,
    evenly,
    fitted_planes,
    fitted_quadrics,
    rim_curve,
    rim_points,
    unit,
)
from dine.geometry.surface import Surface
from dine.priors.gaussian import CovarianceRoot, LinearGaussian
from dine.progress import stage
from dine.refinement.process import FINER, STIFF_AND_BENT, STIFFER, SURFACE
from dine.refinement.surface import (
    NO_GUIDES,
    OnSurface,
    Outline,
    SurfaceOptions,
    refine_on_surface,
)
from dine.registration.shapes import near_points
from dine.registration.types import Correspondence, Overlap, Pair, Settings

# Drawn for each that is kept, so that what is kept lies evenly.
_DRAWN = 4
# Error of a coarse field, which a start that the process allows is fitted to.
_COARSE_ERROR = 0.01
# Where scans overlap: what points beyond the other's end cost, against others without counterpart;
# how stiff fields are found, each from the one before; and how the search goes on from these.
_MISSING = 0.06
_ROUGHLY = ((STIFFER, 0.35, 20), (STIFF_AND_BENT, 0.15, 10))
_ROUGH_END = 0.05
_GOING_ON = (0.08, 0.04)
# Points through which a plane is laid to see how rough a mesh is, and the cosine between planes and
# faces below which its faces are not followed: 20 degrees.
_SMOOTHED = 24
_NOISY = 0.94
_LOOKED_AT = 2000


class Detail(NamedTuple):
    """How closely two surfaces are looked at.

    Attributes:
        source: points of it, spread evenly.
        target: points of it.
        rank: of the process.
        rounds: for each part of the search.
        last: the least standard deviation across the surface.
        settling: how often, at the end, noise and the scale of the prior are estimated.
    """

    source: int = 2000
    target: int = 20_000
    rank: int = SURFACE.rank
    rounds: int = SurfaceOptions.rounds
    last: float = SurfaceOptions.last
    settling: int = 3


FULL = Detail()
# Which of several alignments are worth more.
QUICK = Detail(400, 2000, 120, 8, 0.02, 0)
# Whether a mirror image fits better.
CLOSE = Detail(500, 2500, STIFFER.rank, 8, 0.02, 0)


@dataclass(frozen=True)
class ProcessField:
    """A field of a Gaussian process, given by amplitudes (r, 3) of its root; goes on anywhere.

    Farther than two radii from the object it is what it is there.
    """

    root: CovarianceRoot
    amplitudes: np.ndarray

    def __call__(self, places: np.ndarray) -> np.ndarray:
        """The displacement (M, 3) at places (M, 3), normalised frame."""
        return self.root.field(within_reach(places), self.amplitudes)


def oriented_points(surface: Surface, count: int, rng: np.random.Generator) -> OrientedPoints:
    """At most ``count`` points of a surface and its normals there.

    Drawn by area from a mesh; of a cloud those that cover it evenly. The faces of a noisy mesh lie
    every way; planes through neighbours replace them there; of a cloud they are those of quadrics.
    """
    if surface.faces is None:
        points = surface.vertices[near_points(surface.vertices)]
        points = points[evenly(points, count)]
        normals = fitted_quadrics(points)
        return OrientedPoints(points, normals, rim_points(points, normals))
    samples = sample_surface(surface, count, rng)
    corners = surface.vertices[samples.faces_vertices]
    normals = unit(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]))
    points = samples.places(surface.vertices)
    # They were drawn one independently of the other, so the first say how all are.
    some = slice(_LOOKED_AT)
    product = np.einsum("nc,nc->n", fitted_planes(points, _SMOOTHED, some)[0], normals[some])
    if np.median(np.abs(product)) < _NOISY:
        planes, _ = fitted_planes(points, _SMOOTHED)
        same_side = np.einsum("nc,nc->n", planes, normals) >= 0
        normals = planes * np.where(same_side, 1.0, -1.0)[:, None]
    ends = np.zeros(len(surface.vertices), bool)
    ends[surface.rim] = True
    rim = ends[samples.faces_vertices].any(axis=1)
    # In the order of a tree neighbours follow each other, which makes searches quicker.
    return OrientedPoints(points, normals, rim).at(cKDTree(points).indices)


def rim_of(surface: Surface, spacing: float) -> Curve:
    """Where a mesh ends, a point for each ``spacing`` of its length; no points of a cloud."""
    return rim_curve(surface.vertices, surface.rim, spacing)


def refined_on_surfaces(
    pair: Pair, found: Correspondence, settings: Settings, detail: Detail = FULL
) -> Correspondence:
    """What was found between points, refined between the surfaces that they were drawn on."""
    stage("surfaces")
    moving, fixed = _outlines(pair, settings, detail)
    guides = settings.guide.within(pair.alignment) if settings.guide else NO_GUIDES
    places = np.vstack([moving.places, guides.places])

    @functools.cache
    def root_of(number: int) -> CovarianceRoot:
        return (SURFACE, *FINER)[number]._replace(rank=detail.rank).fitted(places)

    root = root_of(0)
    prior = LinearGaussian.of_kernel(root.root)
    finer = (LinearGaussian.of_kernel(root_of(n).root) for n in range(1, 1 + len(FINER)))
    starts = [np.zeros_like(places)]
    if found.field.any():
        starts.insert(0, root.root @ _fitted(root.at(found.start), found.field))
    options = _options(settings.overlap, detail)
    if settings.overlap is Overlap.BOTH:
        # Of parts, a loose field would make wholes of each other: first, some that hardly bend.
        field, starts = starts[0], starts[:-1]
        for process, first, rounds in _ROUGHLY:
            stiff = LinearGaussian.of_kernel(process.fitted(places).root)
            roughly = _rough(options, first, rounds)
            rough = refine_on_surface(moving, fixed, [field], stiff, roughly, guides)
            field = rough.posterior.mean
            starts.append(root.root @ _fitted(root.root, field))
        options = replace(options, firsts=_GOING_ON)
    end = refine_on_surface(moving, fixed, starts, prior, options, guides, finer)
    posterior, root = end.posterior, root_of(end.finer).times(end.scale)
    anywhere = ProcessField(root, posterior.alone)
    # What the surfaces leave open, the larger the more moved: none of it if nothing did.
    deviation = posterior.scale * np.sqrt(posterior.variance(root.at(found.start)))
    unmet, shown, lacking = _covered(end, settings.overlap)
    closest = nearest(cKDTree(moving.surface.points), found.start)[1]
    return replace(
        found,
        field=anywhere(found.start),
        anywhere=anywhere,
        indicator=deviation,
        improbability=end.improbability,
        unmet=unmet,
        shown=shown,
        supported=~lacking[closest],
    )


def _outlines(pair: Pair, settings: Settings, detail: Detail) -> tuple[Outline, Outline]:
    """Of both surfaces as they are aligned, normalised frame."""
    rng = np.random.default_rng([7, settings.seed])
    source, target = (
        surface.similar(normalise(surface.vertices))
        for surface, normalise in (
            (pair.source, pair.alignment.normalise),
            (pair.target, pair.alignment.frame.normalise),
        )
    )
    drawn = oriented_points(source, _DRAWN * detail.source, rng)
    drawn = drawn.at(evenly(drawn.points, detail.source))
    spacing = float(np.median(spacings(drawn.points)))
    seen = oriented_points(target, detail.target, rng)
    return (
        Outline(drawn, rim_of(source, spacing), *_measured(source)),
        Outline(seen, rim_of(target, spacing / 4), *_measured(target)),
    )


def _measured(surface: Surface) -> tuple[int, float]:
    """How many points a surface was measured at, and the median distance between those of a cloud;
    0 of a mesh."""
    points = surface.vertices
    if surface.faces is not None:
        return len(points), 0.0
    points = points[near_points(points)]
    some = points[:: max(len(points) // _LOOKED_AT, 1)]
    return len(points), float(np.median(nearest(cKDTree(points), some, [2])[0][:, 0]))


def _rough(
    options: SurfaceOptions, first: float, rounds: int, end: float = _ROUGH_END
) -> SurfaceOptions:
    # What settles afterwards changes no improbability, and no field that is only a start.
    ends = {"firsts": (first,), "between": end, "last": end}
    return replace(options, **ends, rounds=rounds, settling=0)


def improbabilities(pairs: Sequence[Pair], settings: Settings, detail: Detail) -> list[float]:
    """How little each of several alignments of two scans explains: −log of the evidence, up to a
    constant, of the surfaces and a field that hardly bends, on few points."""
    rng = np.random.default_rng([8, settings.seed])
    source = oriented_points(pairs[0].source, _DRAWN * detail.source, rng)
    source = source.at(evenly(source.points, detail.source))
    target = oriented_points(pairs[0].target, detail.target, rng)
    none = Curve(np.zeros((0, 3)), np.zeros((0, 3)))
    options = _rough(_options(settings.overlap, detail), _ROUGHLY[0][1], detail.rounds, detail.last)
    found = []
    for pair in pairs:
        normals = source.normals @ pair.alignment.matrix[:3, :3].T
        here = source._replace(points=pair.alignment.normalise(source.points), normals=normals)
        there = target._replace(points=pair.alignment.frame.normalise(target.points))
        prior = STIFFER.at(here.points)
        start = np.zeros_like(here.points)
        end = refine_on_surface(Outline(here, none), Outline(there, none), [start], prior, options)
        found.append(end.improbability)
    return found


def _options(overlap: Overlap, detail: Detail) -> SurfaceOptions:
    return SurfaceOptions(
        rounds=detail.rounds,
        last=detail.last,
        settling=detail.settling if overlap in (Overlap.AUTO, Overlap.BOTH) else 0,
        parts=overlap is Overlap.BOTH,
        missing=_MISSING if overlap is Overlap.BOTH else 1.0,
        source_looks=overlap is not Overlap.TARGET_IN_SOURCE,
        target_looks=overlap is not Overlap.SOURCE_IN_TARGET,
    )


def _covered(end: OnSurface, overlap: Overlap) -> tuple[float, tuple[float, float], np.ndarray]:
    """Of what was found, the share that should lie on the other scan and does not, the shares of
    both scans that the other shows, and the source points (N,) that the target does not show."""
    source, target = end.source, end.target
    if overlap is Overlap.TARGET_IN_SOURCE:
        return target.unmet, (0.0, 1.0), ~source.met
    if overlap is Overlap.SOURCE_IN_TARGET:
        return source.unmet, (1.0, 0.0), np.zeros(len(source.met), bool)
    shown = tuple(1 - float(side.beyond.mean()) for side in (source, target))
    if not any(shown):
        # Nowhere near each other: then all of both should lie on the other, and does not.
        return 1.0, (1.0, 1.0), source.beyond
    # What one scan lacks by a hole, the other does not.
    return min(source.unmet, target.unmet), shown, source.beyond


def _fitted(kernel: np.ndarray, field: np.ndarray) -> np.ndarray:
    """Amplitudes (r, 3) of the most probable field that is nearly ``field`` (N, 3), of a process
    whose root at its places is this kernel (N, r)."""
    precision = 1 / _COARSE_ERROR**2
    # The three coordinates do not know of each other, and share a system.
    system = precision * kernel.T @ kernel
    system[np.diag_indices_from(system)] += 1
    return solve(system, precision * kernel.T @ field, assume_a="pos")
