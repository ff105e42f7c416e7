"""Refining a field against the surface of the target: the last stage between two scans.

Points drawn on two scans lie beside each other, up to half a spacing along the surface. Distances
between points cannot see below that; distances to the surface can. As in
:mod:`dine.refinement.refine`, the field is the most probable one under a Gaussian prior, here given
that every source point lies near the plane through its nearest target point. How far along this
plane is left to the prior, so that surfaces slide into place (point-to-plane distances: Chen and
Medioni, 1992, Object modelling by registration of multiple range images).

Each round finds nearest neighbours in place and normal, both ways, and solves for the field. Their
standard deviation falls from round to round, as in deterministic annealing. Weights fall off with
the distance (Geman and McClure), so that what one scan lacks pulls at nothing. The plane lies half
way between those of both points, which a turn of either changes less (Rusinkiewicz, 2019, A
symmetric objective function for ICP). All lengths are in the normalised frame.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree
from threadpoolctl import threadpool_limits

from dine.geometry.oriented import MovingNormals, OrientedPoints, fitted_planes, unit
from dine.priors.gaussian import LinearGaussian, Posterior


@dataclass(frozen=True)
class SurfaceOptions:
    """How to refine against a surface.

    Attributes:
        rounds: of matching and solving.
        first: standard deviation of the distance across the surface in the first round.
        last: the same in the last round, or the roughness of the target where that is more; it
            falls geometrically.
        along: precision of a match along the surface. It only damps: more holds slides up, and
            random places of the drawn points show in the field.
        reach: distance, in standard deviations, at which the weight has fallen to a quarter.
        steepest: largest angle between the normals of a match, in degrees.
        turning: half the distance, in standard deviations, that counts as much as opposite normals.
        seen: how many target points look for source points, at most.
        part: the target shows a part of the source; its points then look for source points, but not
            the other way.
    """

    rounds: int = 40
    first: float = 0.08
    last: float = 0.004
    along: float = 1.0
    reach: float = 3.0
    steepest: float = 70.0
    turning: float = 2.0
    seen: int = 8000
    part: bool = False


DEFAULTS = SurfaceOptions()
# Share of the clear matches whose normals agree from which signs are known.
_ONE_SIDED = 0.9


def refine_on_surface(
    source: OrientedPoints,
    target: OrientedPoints,
    starts: Sequence[np.ndarray],
    prior: LinearGaussian,
    options: SurfaceOptions = DEFAULTS,
) -> Posterior:
    """The field after some rounds, as the posterior of the last one.

    From every start the first half of the rounds; the most probable of the fields there goes on.
    Where the matches are more probable if nothing but the prior's mean happened, that is kept: what
    is left then follows from where points happened to be drawn.

    Args:
        source: (N, 3) points, spread evenly.
        target: (M, 3) points, as many as there are time for.
        starts: fields (N, 3) to start from.
        prior: of fields at the source points.
        options: how many rounds, and of what.
    """
    search = _Search(source, target, options)
    search.tell_sides(starts[0])
    # Neither noise nor what planes through neighbours miss of a curved surface is to be followed.
    rough = float(np.median(fitted_planes(target.points)[1]))
    last = min(max(options.last, rough), options.first)
    schedule = np.geomspace(options.first, last, options.rounds)
    half = len(schedule) // 2 if len(starts) > 1 else 0

    def after(field: np.ndarray, deviations: np.ndarray) -> Posterior:
        for deviation in deviations:
            posterior = Posterior(prior, *search.observed(field, deviation)[:2])
            field = posterior.mean
        return posterior

    def improbability(posterior: Posterior) -> float:
        return search.observed(posterior.mean, schedule[half])[2] + posterior.energy

    # Small systems, for which many threads only wait for each other.
    with threadpool_limits(1, user_api="blas"):
        if half:
            starts = [min((after(x, schedule[:half]) for x in starts), key=improbability).mean]
        end = after(starts[0], schedule[half:])
        _, precision, misfit = search.observed(prior.mean, schedule[-1])
        if misfit < search.observed(end.mean, schedule[-1])[2] + end.energy + end.complexity:
            still = np.einsum("nab,nb->na", precision, prior.mean)
            return Posterior(prior, still, precision)
        return end


class _Search:
    """Finds what the target says of a field's points."""

    def __init__(self, source: OrientedPoints, target: OrientedPoints, options: SurfaceOptions):
        self.source, self.target, self.options = source, target, options
        self.normals = MovingNormals(source)
        self.least = np.cos(np.radians(options.steepest))
        count = len(target.points)
        self.asking = np.arange(count)
        if count > options.seen:
            self.asking = np.random.default_rng(6).permutation(count)[: options.seen]
        self.signs = (1.0, -1.0)

    def tell_sides(self, field: np.ndarray) -> None:
        """Find out, where a field (N, 3) brings the source, which normals are the same side's."""
        moved = self.source.points + field
        nearest = cKDTree(self.target.points).query(moved)[1]
        product = np.einsum("nc,nc->n", self.normals(moved), self.target.normals[nearest])
        clear = np.abs(product) > self.least
        same = (product[clear] > 0).mean() if clear.any() else 0.5
        if same > _ONE_SIDED:
            self.signs = (1.0,)
        elif same < 1 - _ONE_SIDED:
            self.signs = (-1.0,)

    def observed(self, field: np.ndarray, deviation: float) -> tuple[np.ndarray, np.ndarray, float]:
        """For each source point the sums of precision · displacement (N, 3) and of precisions
        (N, 3, 3) over its matches, and how badly the field (N, 3) explains these: −log of their
        density up to a constant."""
        options = self.options
        moved = self.source.points + field
        count = len(moved)
        index, matched, ours = self._matches(moved, options.turning * deviation)
        theirs = self.target.normals[matched]
        offset = self.target.points[matched] - moved[index]
        agreeing = np.einsum("nc,nc->n", ours, theirs) > self.least
        if options.part:
            agreeing[:count] = False
        # What lies beyond the end of a surface finds its rim, wherever it belongs.
        agreeing &= ~np.concatenate(
            [self.target.rim[matched[:count]], self.source.rim[index[count:]]]
        )
        normal = unit(ours + theirs)
        # As much weight for the target's points as for the source's.
        scale = np.ones(len(index))
        scale[count:] = count / len(self.asking)
        squared = (offset**2).sum(axis=1) / (options.reach * deviation) ** 2
        unexplained = np.where(agreeing, squared / (1 + squared), 1.0)
        misfit = 0.5 * options.reach**2 * float((scale * unexplained).sum())

        along = options.along * scale * agreeing / (1 + squared) ** 2
        # What comes on top across the surface.
        across = (along / options.along * (deviation**-2 - options.along))[:, None] * normal
        precision = np.zeros((count, 3, 3))
        for a in range(3):
            for b in range(a + 1):
                value = np.bincount(index, across[:, a] * normal[:, b], count)
                precision[:, a, b] = precision[:, b, a] = value
        precision += np.bincount(index, along, count)[:, None, None] * np.eye(3)
        wanted = offset + field[index]
        pull = along[:, None] * wanted + across * np.einsum("nc,nc->n", normal, wanted)[:, None]
        pulled = np.column_stack([np.bincount(index, column, count) for column in pull.T])
        return pulled, precision, misfit

    def _matches(
        self, moved: np.ndarray, turning: float
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Indices of source and target points that are nearest, first those that the source asks
        for; and the normals (n, 3) of the source's, on the target's side."""
        normals = self.normals(moved)
        there = np.hstack([self.target.points, turning * self.target.normals])
        tree, asking = cKDTree(there), there[self.asking]
        ways = []
        for sign in self.signs:
            here = np.hstack([moved, sign * turning * normals])
            (away, to), (back, asked) = tree.query(here), cKDTree(here).query(asking)
            index = np.concatenate([np.arange(len(moved)), asked])
            matched = np.concatenate([to, self.asking])
            ways.append((np.concatenate([away, back]), index, matched, sign * normals[index]))
        if len(ways) == 1:
            return ways[0][1:]
        first, second = ways
        nearer = first[0] <= second[0]
        return tuple(
            np.where(nearer if a.ndim == 1 else nearer[:, None], a, b)
            for a, b in zip(first[1:], second[1:], strict=True)
        )
