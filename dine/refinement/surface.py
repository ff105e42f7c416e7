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

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree
from threadpoolctl import threadpool_limits

from dine.geometry.distance import nearest, spacings
from dine.geometry.oriented import (
    Curve,
    MovingNormals,
    OrientedPoints,
    evenly,
    fitted_planes,
    unit,
)
from dine.priors.gaussian import LinearGaussian, Posterior, most_probable
from dine.threads import each


@dataclass(frozen=True)
class SurfaceOptions:
    """How to refine against a surface.

    Attributes:
        firsts: standard deviations of the distance across the surface that the search begins with,
            from every start.
        between: the same where the most probable of the fields found so far is taken.
        last: the same at the end, or the roughness of the target where that is more.
        finest: the least that it may fall to once it is estimated.
        settling: how many times, at the end, it and the prior's scale are estimated from what was
            found.
        rounds: of matching and solving, as many for each part of the search; the standard deviation
            falls geometrically.
        along: precision of a match along the surface. It only damps: more holds slides up, and
            random places of the drawn points show in the field.
        reach: distance, in standard deviations, at which the weight has fallen to a quarter.
        steepest: largest angle between the normals of a match, in degrees.
        turning: half the distance, in standard deviations, that counts as much as opposite normals.
        missing: what a point past the place where the other scan ends costs, as a share of what one
            costs that should lie on it and does not.
        source_looks: source points look for target points, as they should not where the target
            shows a part of the source.
        target_looks: likewise. Where only one of the scans looks, surfaces end anywhere.
        parts: each scan shows what the other does not. Where one was cut the other goes on, so rims
            do not belong on rims, and a match must be the nearest from both sides, roughly: what
            only one shows would find something of the other wherever that ends.
        tried_modes: while several fields are tried so many of the prior's modes are used, the first
            ones; None for all.
        tried_columns: likewise of its kernel's columns.
    """

    firsts: tuple[float, ...] = (0.08, 0.2)
    between: float = 0.03
    last: float = 0.004
    finest: float = 0.003
    settling: int = 0
    rounds: int = 20
    along: float = 1.0
    reach: float = 3.0
    steepest: float = 70.0
    turning: float = 2.0
    missing: float = 1.0
    source_looks: bool = True
    target_looks: bool = True
    parts: bool = False
    tried_modes: int | None = None
    tried_columns: int = 150

    @property
    def both_look(self) -> bool:
        """Whether either scan may end where the other does."""
        return self.source_looks and self.target_looks


DEFAULTS = SurfaceOptions()
# While several fields are tried: points of the source, of the target and of those that look for the
# source. Of the one that goes on so many look.
_FEWER_POINTS, _FEWER_TARGETS, _FEWER_LOOKING = 1000, 5000, 2000
_LOOKING = 8000
# Points at which the roughness of the target is looked at.
_ROUGHNESS_POINTS = 4000
# Mean distance of fields that are the same.
_AGREED = 0.01
# Share of the clear matches whose normals agree from which signs are known.
_ONE_SIDED = 0.9
# How much farther than the nearest to its partner a point may be, where scans are parts.
_RECIPROCAL = 2.0
# Standard deviation over the median distance from the mean, of a Gaussian.
_TO_DEVIATION = 1.4826
# Rounds after each estimate; its limits: a standard deviation, shares of the prior's scale, and the
# share of the observations that the field is taken to follow at most.
_SETTLING_ROUNDS = 3
_COARSEST = 0.05
_SCALES = (0.1, 1.0)
_FOLLOWED = 0.8
# Of the scale under one prior, about what is left under the next finer one.
_FINER_SCALE = 0.6
# How far off planes are between the points of a cloud, for each square of their median distance: as
# on spheres of radius 0.08 half way between points twice as far apart.
_OFF_BETWEEN = 24.0


class Outline(NamedTuple):
    """A surface and where it ends.

    Attributes:
        surface: (N, 3) points of it.
        rim: (E, 3) points of the curve that it ends at; E may be 0.
        measured: how many points it was measured at, if that is known: those drawn on the faces
            between them say nothing new.
        gaps: median distance between the points of a cloud; 0 of a mesh, whose faces are known.
    """

    surface: OrientedPoints
    rim: Curve
    measured: int | None = None
    gaps: float = 0.0

    @property
    def places(self) -> np.ndarray:
        """(N + E, 3), all of them."""
        return np.vstack([self.surface.points, self.rim.points])


class Guides(NamedTuple):
    """Points of the source that are known to belong somewhere.

    Attributes:
        places: (L, 3) where they are; L may be 0.
        displacement: (L, 3) from there to where they belong.
        error: standard deviation of each coordinate.
    """

    places: np.ndarray
    displacement: np.ndarray
    error: float

    def observed(self, field: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
        """As of :class:`_Search`, at these points (L, 3)."""
        exact = self.error**-2
        misfit = 0.5 * exact * float(((self.displacement - field) ** 2).sum())
        precision = np.tile(exact * np.eye(3), (len(field), 1, 1))
        return exact * self.displacement, precision, misfit


NO_GUIDES = Guides(np.zeros((0, 3)), np.zeros((0, 3)), 1.0)


class Coverage(NamedTuple):
    """Which points of one scan come to lie on the other.

    Attributes:
        met: (N,) bool, points on the other's surface.
        beyond: (N,) bool, points past the place where the other ends, so that it cannot show them.
    """

    met: np.ndarray
    beyond: np.ndarray

    @property
    def unmet(self) -> float:
        """Share of the points that are neither."""
        return 1 - float((self.met | self.beyond).mean())


class OnSurface(NamedTuple):
    """What was found between two surfaces.

    Attributes:
        posterior: of the last round.
        improbability: −log of its evidence: misfit + energy + complexity; of parts, that under the
            scale of the prior which makes it least.
        source: which of the source's points lie on the target.
        target: which of the target's points, of those that look for the source, lie on it.
        scale: the posterior's prior has so many times the standard deviations of the one given.
        finer: how many of the finer priors were taken, one after the other; the last of them, times
            ``scale``, is the posterior's.
    """

    posterior: Posterior
    improbability: float
    source: Coverage
    target: Coverage
    scale: float = 1.0
    finer: int = 0


def refine_on_surface(
    source: Outline,
    target: Outline,
    starts: Sequence[np.ndarray],
    prior: LinearGaussian,
    options: SurfaceOptions = DEFAULTS,
    guides: Guides = NO_GUIDES,
    finer: Iterable[LinearGaussian] = (),
) -> OnSurface:
    """The field after some rounds.

    Fields are found from every start, and with every first standard deviation until all starts lead
    to the same, on fewer points; the most probable of them goes on on all. Where the matches are
    more probable if nothing but the prior's mean happened, that is kept: what is left then follows
    from where points happened to be drawn. Otherwise what is found may settle: see
    :class:`SurfaceOptions`. Once settled, it goes on under each of the finer priors in turn as long
    as these make it more probable.

    Args:
        source: points spread evenly.
        target: points, as many as there are time for.
        starts: fields (N + E + L, 3) to start from, at the source's places and then the guides'.
        prior: of fields there.
        options: how many rounds, and of what.
        guides: observed as they are, in every round.
        finer: further priors of the same mean, asked for one by one; of meshes only.
    """
    # Neither noise nor what planes through neighbours miss of a curved surface is to be followed.
    some = spread(len(target.surface.points), _ROUGHNESS_POINTS)
    rough = float(np.median(fitted_planes(target.surface.points, at=some)[1]))
    last = max(options.last, rough, _OFF_BETWEEN * max(source.gaps, target.gaps) ** 2)
    between = max(options.between, last)
    search = _Search(source, target, options, _LOOKING, guides)
    search.tell_sides(starts[0])
    # Small systems, for which many threads only wait for each other.
    with threadpool_limits(1, user_api="blas"):
        fields = _fields(search, source, target, starts, prior, between)
        start = min(fields, key=lambda found: found[1] + search.observed(found[0], between)[2])[0]
        end = search.posterior(start, prior, np.geomspace(between, last, options.rounds))
        improbability = search.observed(end.mean, last)[2] + end.energy + end.complexity
        _, precision, misfit = search.observed(prior.mean, last)
        scale, taken = 1.0, 0
        if misfit < improbability:
            still = np.einsum("nab,nb->na", precision, prior.mean)
            end, improbability = Posterior(prior, still, precision), misfit
        else:
            if options.parts:
                # Parts laid wrongly on each other fit as well, but only if they are bent more.
                improbability -= end.saving(_SCALES[0])
            if options.settling:
                # Settled fields, each judged by what it says itself, could not be compared.
                known = [x.measured for x in (source, target) if x.measured is not None]
                count = min(known, default=None)
                end, scale, last = search.settled(end, prior, last, count)
                if not search.from_cloud:
                    end, scale, last, taken = search.finer(end, finer, scale, last, count)
    return OnSurface(end, improbability, *search.coverage(end.mean, last), scale, taken)


def _fields(
    search: _Search,
    source: Outline,
    target: Outline,
    starts: Sequence[np.ndarray],
    prior: LinearGaussian,
    between: float,
) -> Iterator[tuple[np.ndarray, float]]:
    """Fields (N + E + L, 3) down to some standard deviation, on fewer points; their energies."""
    count, rank = len(source.surface.points), search.options.tried_columns
    modes = prior.modes[: search.options.tried_modes]
    guided = np.arange(len(source.places), len(prior.mean))
    inside = evenly(source.surface.points, _FEWER_POINTS)
    rim = np.arange(0, len(source.rim.points), 2)
    few = _Search(
        source._replace(surface=source.surface.at(inside), rim=source.rim.at(rim)),
        target._replace(
            surface=target.surface.at(spread(len(target.surface.points), _FEWER_TARGETS))
        ),
        search.options,
        _FEWER_LOOKING,
        search.guides,
    )
    few.signs = search.signs
    rows = np.concatenate([inside, count + rim, guided])
    # A pivoted root's first columns are a root of lower rank.
    less = LinearGaussian(prior.mean[rows], modes.take(rows, axis=1), prior.kernel[rows, :rank])
    for first in search.options.firsts:
        schedule = np.geomspace(max(first, between), between, search.options.rounds)
        ends = []
        descend = partial(few.posterior, prior=less, schedule=schedule)
        for found in each(descend, [start[rows] for start in starts]):
            field = prior.mean + prior.kernel[:, :rank] @ found.alone
            field += np.tensordot(found.shared, modes, axes=1)
            ends.append(field)
            yield field, found.energy
        apart = np.ptp(ends, axis=0)
        if len(ends) > 1 and np.linalg.norm(apart, axis=1).mean() < _AGREED:
            return


def spread(count: int, some: int) -> np.ndarray:
    """At most ``some`` of the indices below ``count``, the same ones each time."""
    if count <= some:
        return np.arange(count)
    return np.sort(np.random.default_rng(6).permutation(count)[:some])


class _Search:
    """Finds what the target says of a field's points."""

    def __init__(
        self,
        source: Outline,
        target: Outline,
        options: SurfaceOptions,
        looking: int,
        guides: Guides,
    ):
        """At most ``looking`` target points look for the source."""
        self.guides = guides
        self.source, self.target, self.options = source.surface, target.surface, options
        self.rims = _Rims(source.rim, target.rim, options)
        self.from_cloud = max(source.gaps, target.gaps) > 0
        self.normals = MovingNormals(self.source, curved=source.gaps > 0)
        self.least = np.cos(np.radians(options.steepest))
        self.asking = spread(len(self.target.points), looking)
        target_spacing, source_spacing = (
            float(np.median(spacings(x.points))) for x in (self.target, self.source)
        )
        self.spacings = (2 * target_spacing, source_spacing)
        self.signs = (1.0, -1.0)
        self.places = cKDTree(self.target.points)

    def posterior(
        self, field: np.ndarray, prior: LinearGaussian, schedule: np.ndarray
    ) -> Posterior:
        """From a field (N + E + L, 3), the last posterior of a schedule of standard deviations."""
        for deviation in schedule[:-1]:
            field = most_probable(prior, *self.observed(field, deviation)[:2])
        return Posterior(prior, *self.observed(field, schedule[-1])[:2])

    def settled(
        self,
        found: Posterior,
        prior: LinearGaussian,
        deviation: float,
        measured: int | None,
        scale: float = 1.0,
    ) -> tuple[Posterior, float, float]:
        """What comes of a posterior if the standard deviation across the surface and the prior's
        scale are those that it makes most likely itself; with the scale and the deviation.

        As many independent observations are taken for granted as points were measured, however
        many were drawn (MacKay, 1992, Bayesian interpolation, section 4). Of clouds the deviation
        stays: it stands for planes that are wrong, which points of the same planes do not tell.
        """
        options = self.options
        matches = 2 * len(self.source.points)
        count = matches if measured is None else min(measured, matches)
        for _ in range(options.settling):
            free = max(count - found.determined, (1 - _FOLLOWED) * count)
            if not self.from_cloud:
                left = self._left_across(found.mean, deviation) * np.sqrt(matches / free)
                deviation = float(np.clip(left, options.finest, _COARSEST))
            scale = float(np.clip(scale * found.scale, *_SCALES))
            schedule = np.full(_SETTLING_ROUNDS, deviation)
            found = self.posterior(found.mean, prior.times(scale), schedule)
        return found, scale, deviation

    def finer(
        self,
        found: Posterior,
        priors: Iterable[LinearGaussian],
        scale: float,
        deviation: float,
        measured: int | None,
    ) -> tuple[Posterior, float, float, int]:
        """What comes of a settled posterior under priors that let more happen within short
        distances; with the scale, the deviation, and how many priors were taken.

        Compared by the evidence of the very observations that the field settled with (MacKay, 1992,
        section 3). Of clouds it would say how wrong their planes are.
        """
        taken = 0
        for prior in priors:
            # What a finer prior adds to the length of short motions, its scale has to take back.
            smaller = max(_FINER_SCALE * scale, _SCALES[0])
            other = found.under(prior.times(smaller))
            if other.evidence <= found.evidence:
                break
            taken += 1
            found, scale, deviation = self.settled(other, prior, deviation, measured, smaller)
        return found, scale, deviation, taken

    def _left_across(self, field: np.ndarray, deviation: float) -> float:
        """Standard deviation of the distance across the surface that a field (N + E + L, 3) leaves,
        by its median."""
        moved = self.source.points + field[: len(self.source.points)]
        index, matched, ours = self._matches(moved, self.options.turning * deviation)
        offset, normal, _, agreeing = self._apart(moved, index, matched, ours)
        agreeing &= ~self._beyond(moved, index, matched, deviation)
        across = np.abs(np.einsum("nc,nc->n", normal[agreeing], offset[agreeing]))
        return _TO_DEVIATION * float(np.median(across)) if len(across) else 0.0

    def tell_sides(self, field: np.ndarray) -> None:
        """Find out, where a field (N, 3) brings the source, which normals are the same side's."""
        moved = self.source.points + field[: len(self.source.points)]
        closest = nearest(self.places, moved)[1]
        product = np.einsum("nc,nc->n", self.normals(moved), self.target.normals[closest])
        clear = np.abs(product) > self.least
        same = (product[clear] > 0).mean() if clear.any() else 0.5
        if same > _ONE_SIDED:
            self.signs = (1.0,)
        elif same < 1 - _ONE_SIDED:
            self.signs = (-1.0,)

    def observed(self, field: np.ndarray, deviation: float) -> tuple[np.ndarray, np.ndarray, float]:
        """For each source place the sums of precision · displacement (N + E + L, 3) and of
        precisions (N + E + L, 3, 3) over its matches, and how badly the field (N + E + L, 3)
        explains these: −log of their density up to a constant."""
        count = len(self.source.points)
        ends = len(field) - len(self.guides.places)
        pulled, precision, misfit = zip(
            self._on_surface(field[:count], deviation),
            self.rims.observed(field[count:ends], deviation),
            self.guides.observed(field[ends:]),
            strict=True,
        )
        return np.concatenate(pulled), np.concatenate(precision), sum(misfit)

    def _on_surface(
        self, field: np.ndarray, deviation: float
    ) -> tuple[np.ndarray, np.ndarray, float]:
        """The same of points (N, 3) inside the surface."""
        options = self.options
        moved = self.source.points + field
        count = len(moved)
        index, matched, ours = self._matches(
            moved, options.turning * deviation, options.source_looks
        )
        offset, normal, squared, agreeing = self._apart(moved, index, matched, ours)
        squared /= (options.reach * deviation) ** 2
        agreeing[:count] &= options.source_looks
        agreeing[count:] &= options.target_looks
        # What lies beyond the end of a surface finds its rim, wherever it belongs.
        beyond = self._beyond(moved, index, matched, deviation)
        agreeing &= ~beyond
        # As much weight for the target's points as for the source's.
        scale = np.ones(len(index))
        scale[count:] = count / len(self.asking)
        unexplained = np.where(beyond, options.missing, 1.0)
        unexplained[agreeing] = (squared / (1 + squared))[agreeing]
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

    def _apart(
        self, moved: np.ndarray, index: np.ndarray, matched: np.ndarray, ours: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Of matches, first those that the source looked for: the offset (n, 3) to the target, the
        normal (n, 3) half way, the squared distance (n,), and whether normals agree (n,).

        Distance counts across the surface, and along it beyond the spacing of the points: the
        nearest drawn point is not where it might be drawn.
        """
        theirs = self.target.normals[matched]
        offset = self.target.points[matched] - moved[index]
        normal = unit(ours + theirs)
        across = np.einsum("nc,nc->n", normal, offset)
        beside = np.sqrt(np.maximum((offset**2).sum(axis=1) - across**2, 0))
        count = len(moved)
        for rows, spacing in zip((slice(count), slice(count, None)), self.spacings, strict=True):
            beside[rows] = np.maximum(beside[rows] - spacing, 0)
        agreeing = np.einsum("nc,nc->n", ours, theirs) > self.least
        return offset, normal, across**2 + beside**2, agreeing

    def coverage(self, field: np.ndarray, deviation: float) -> tuple[Coverage, Coverage]:
        """Which points of the source and of the target a field (N + E + L, 3) brings together."""
        count = len(self.source.points)
        moved = self.source.points + field[:count]
        index, matched, ours = self._matches(moved, self.options.turning * deviation)
        _, _, squared, agreeing = self._apart(moved, index, matched, ours)
        met = agreeing & (squared < (self.options.reach * deviation) ** 2)
        beyond = self._beyond(moved, index, matched, deviation) & ~met
        return tuple(
            Coverage(met[side], beyond[side]) for side in (slice(count), slice(count, None))
        )

    def _beyond(
        self, moved: np.ndarray, index: np.ndarray, matched: np.ndarray, deviation: float
    ) -> np.ndarray:
        """Matches (n,), first those that the source looked for, that found where the other ends.

        Of parts also those whose point found another that is much nearer to it (reciprocal
        correspondences: Pajdla and Van Gool, 1995, Matching of 3-D curves using semi-differential
        invariants).
        """
        count = len(moved)
        beyond = np.concatenate([self.target.rim[matched[:count]], self.source.rim[index[count:]]])
        if self.options.parts:
            there = self.target.points[matched]
            back = np.concatenate(
                [
                    nearest(cKDTree(moved), there[:count])[0],
                    nearest(self.places, moved)[0][index[count:]],
                ]
            )
            away = np.linalg.norm(there - moved[index], axis=1)
            beyond |= away > _RECIPROCAL * back + deviation + self.spacings[1]
        return beyond

    def _matches(
        self, moved: np.ndarray, turning: float, source_asks: bool = True
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Indices of source and target points that are nearest, first those that the source asks
        for, or any if it does not; and the normals (n, 3) of the source's, on the target's
        side."""
        normals = self.normals(moved)
        there = np.hstack([self.target.points, turning * self.target.normals])
        asking, count = there[self.asking], len(moved)
        tree = _tree(there) if source_asks else None
        nothing = np.zeros(count), np.zeros(count, int)
        ways = []
        for sign in self.signs:
            here = np.hstack([moved, sign * turning * normals])
            away, to = nearest(tree, here) if tree else nothing
            back, asked = nearest(_tree(here), asking)
            index = np.concatenate([np.arange(count), asked])
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


def _tree(places: np.ndarray) -> cKDTree:
    """One that is soon made, for places (n, k) that are asked about once."""
    return cKDTree(places, leafsize=24, balanced_tree=False)


class _Rims:
    """Finds what the end of the target's surface says of the end of the source's.

    A rim is to lie on a rim, wherever along it. Both must be nearest to each other, roughly: the
    edge of a hole in one scan then finds nothing in the other.
    """

    def __init__(self, source: Curve, target: Curve, options: SurfaceOptions):
        self.source, self.target, self.options = source, target, options
        self.tree = cKDTree(target.points)
        some = len(target.points) and len(source.points)
        self.off = options.parts or not (options.both_look and some)

    def observed(self, field: np.ndarray, deviation: float) -> tuple[np.ndarray, np.ndarray, float]:
        """As of :class:`_Search`, at the rim's points (E, 3)."""
        count = len(field)
        if self.off:
            return np.zeros((count, 3)), np.zeros((count, 3, 3)), 0.0
        options = self.options
        moved = self.source.points + field
        away, to = nearest(self.tree, moved)
        back = nearest(cKDTree(moved), self.target.points[to])[0]
        squared = away**2 / (options.reach * deviation) ** 2
        known = away <= 2 * back + deviation
        unexplained = np.where(known, squared / (1 + squared), options.missing)
        misfit = 0.5 * options.reach**2 * float(unexplained.sum())
        weight = known / (1 + squared) ** 2
        tangent = self.target.tangents[to]
        along = weight * (options.along - deviation**-2)
        precision = along[:, None, None] * tangent[:, :, None] * tangent[:, None, :]
        precision += (weight / deviation**2)[:, None, None] * np.eye(3)
        wanted = self.target.points[to] - self.source.points
        return np.einsum("nab,nb->na", precision, wanted), precision, misfit
