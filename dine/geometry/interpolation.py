"""Interpolate a field known at some points of an object to any other point of or near it.

A displacement is interpolated as a sum of three parts, each of which takes what the one before
leaves over:

1. the rigid motion of all samples, which may safely be followed anywhere;
2. a linear part along those principal axes of the samples that are at least ``_WIDE`` as wide as
   the widest. Across a thin patch it cannot be told from the patch's bending, and following it
   there would throw points beside the patch far off;
3. the biharmonic spline of three dimensions (radial kernel r) through the rest.

Of other values only the last part is used.

This was chosen on 1024 samples. Mean errors, in object radii, of fields of
``dine.data.deformation`` at level 0.5 with noise of 0.03 a coordinate: at the vertices of ten
closed shapes, half way from these to the middle and at 1.3 times their distance from it, and 0.5
below six tissue patches:

    =========================================  =======  ========  =======  ===========
    interpolation                              surface  half way  outside  below patch
    =========================================  =======  ========  =======  ===========
    this sum                                   0.031    0.020     0.044    0.083
    kernel r, linear polynomial                0.031    0.020     0.042    0.123
    thin-plate spline                          0.046    0.058     0.094    0.290
    thin-plate spline, smoothing 0.01          0.022    0.022     0.045    0.114
    thin-plate spline, nearest 50 samples      0.047    > 1e11    > 1e11   2.2
    =========================================  =======  ========  =======  ===========

Bending and stretching gave the same picture. On a fifth of the points, held out of fields that the
pretrained networks predicted for test pairs, it is 0.0402 (Robust-DefReg) and 0.0502 (DefTransNet)
from the truth, the plain thin-plate spline 0.0418 and 0.0521, the best smoothed one 0.0393 and
0.0495, the predictions themselves 0.0414 and 0.0508. So smoothing would gain 1 to 2 % at most, and
is left out: samples keep the values that they were given.
"""

from __future__ import annotations

import numpy as np
from scipy.linalg import solve
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist
from scipy.spatial.transform import Rotation

from dine.errors import DataError
from dine.threads import run

REACH = 2.0
"""Beyond so many radii from the middle of the samples only the rigid motion still changes."""
# Least width of a principal axis, as a share of the widest, that a linear part is fitted along.
_WIDE = 0.2
# Samples that are solved for at once: a dense system of 128 MiB.
_MOST_SITES = 4096
# Keeps samples that nearly coincide solvable.
_SMOOTHING = 1e-9
# Weight of "not turned" against all samples, which settles what too few of them leave open.
_UNTURNED = 1e-7


class FittedDisplacement:
    """A displacement known at n samples, fitted once and evaluated anywhere.

    Constant and rigid fields are interpolated exactly (to 1e-6) everywhere, affine ones within two
    radii (the largest distance of a sample from the mean of all) unless the samples are nearly
    flat. Farther out it is the rigid motion plus what the rest amounts to at two radii.

    Samples get back their own values, up to 4096 of them; of more, neighbours are averaged until
    4096 remain. Any number from one up will do, and they may coincide (the mean of their values is
    used) or lie in a plane or on a line (what they leave open is taken as not turned and not
    stretched). Memory grows by little more than the result; 500,000 queries of 1024 samples take
    about 1 s.

    Args:
        points: (n, 3) samples, n >= 1.
        displacement: (n, 3) at the samples, in the units of ``points``.

    Raises:
        DataError: another shape, or numbers that are NaN or infinite.
    """

    def __init__(self, points: np.ndarray, displacement: np.ndarray):
        points, displacement = _checked(points, displacement, 3)
        self.points, self.displacement = points, displacement
        self._centre, self._radius = _extent(points)
        sites = (points - self._centre) / self._radius
        sites, field = _thinned(sites, displacement / self._radius)
        self._middle, self._shift = sites.mean(axis=0), field.mean(axis=0)
        offset = sites - self._middle
        self._turn = _rotation(offset, offset + field - self._shift).as_matrix().T - np.eye(3)
        rest = field - self._rigid(sites)
        self._gradient = _gradient(offset, rest)
        rest -= offset @ self._gradient
        self._spline = _Spline(sites, rest)

    def _rigid(self, places: np.ndarray) -> np.ndarray:
        return (places - self._middle) @ self._turn + self._shift

    def __call__(self, queries: np.ndarray) -> np.ndarray:
        """The displacement (m, 3), float64 and finite, at (m, 3) queries; m may be 0.

        Raises:
            DataError: another shape, or numbers that are NaN or infinite.
        """
        places = (_finite("queries", queries, 3) - self._centre) / self._radius
        near = within_reach(places)
        affine = self._rigid(places) + (near - self._middle) @ self._gradient
        return (affine + self._spline(near)) * self._radius


class FittedValues:
    """Values known at n samples, such as an uncertainty, fitted once and evaluated anywhere.

    They stay between the least and the largest sample everywhere. All else is as for
    :class:`FittedDisplacement`.

    Args:
        points: (n, 3) samples, n >= 1.
        values: (n, d) at the samples, d >= 1, each column in units of its own.

    Raises:
        DataError: another shape, or numbers that are NaN or infinite.
    """

    def __init__(self, points: np.ndarray, values: np.ndarray):
        points, values = _checked(points, values, None)
        self._centre, self._radius = _extent(points)
        self._bounds = values.min(axis=0), values.max(axis=0)
        self._spline = _Spline(*_thinned((points - self._centre) / self._radius, values))

    def __call__(self, queries: np.ndarray) -> np.ndarray:
        """The values (m, d), float64 and finite, at (m, 3) queries; m may be 0.

        Raises:
            DataError: another shape, or numbers that are NaN or infinite.
        """
        places = (_finite("queries", queries, 3) - self._centre) / self._radius
        values = self._spline(within_reach(places))
        return np.clip(values, *self._bounds)


def _checked(
    points: np.ndarray, field: np.ndarray, columns: int | None
) -> tuple[np.ndarray, np.ndarray]:
    points, field = _finite("points", points, 3), _finite("field", field, columns)
    if len(points) == 0 or len(points) != len(field):
        raise DataError(
            f"A field of {len(field)} rows at {len(points)} points cannot be interpolated; "
            "expected one row a point, and at least one."
        )
    return points, field


def _extent(points: np.ndarray) -> tuple[np.ndarray, float]:
    """Middle of points, and how far the farthest is from it: 1 where all are in one place."""
    centre = points.mean(axis=0)
    return centre, np.linalg.norm(points - centre, axis=1).max() or 1.0


def _finite(name: str, array: np.ndarray, columns: int | None) -> np.ndarray:
    array = np.asarray(array, dtype=np.float64)
    if array.ndim != 2 or array.shape[1] != (columns or max(1, array.shape[1])):
        raise DataError(
            f"The {name} to interpolate a field have the shape {array.shape}; expected (rows, "
            f"{columns or 'at least 1'})."
        )
    if not np.isfinite(array).all():
        raise DataError(f"The {name} to interpolate a field hold NaN or infinite numbers.")
    return array


def _thinned(sites: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distinct sites, at most ``_MOST_SITES``: means over groups, of places and of values."""
    same = np.lexsort(sites.T)
    new = (np.diff(sites[same], axis=0) != 0).any(axis=1)
    sites, values = _group_means(sites, values, same, np.flatnonzero(np.append(True, new)))
    if len(sites) > _MOST_SITES:
        near = cKDTree(sites).indices  # neighbours in space follow each other
        first = np.arange(_MOST_SITES) * len(sites) // _MOST_SITES
        sites, values = _group_means(sites, values, near, first)
    return sites, values


def _group_means(
    sites: np.ndarray, values: np.ndarray, order: np.ndarray, first: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Means over the runs of rows, taken in ``order``, that begin at the positions ``first``."""
    count = np.diff(first, append=len(order))[:, None]
    return tuple(np.add.reduceat(array[order], first) / count for array in (sites, values))


def _rotation(before: np.ndarray, after: np.ndarray) -> Rotation:
    """The rotation about the origin that fits best; of equally good ones, the smallest."""
    axes = np.eye(3)
    weights = np.concatenate([np.ones(len(before)), np.full(3, _UNTURNED * len(before))])
    return Rotation.align_vectors(
        np.concatenate([after, axes]), np.concatenate([before, axes]), weights
    )[0]


def _gradient(sites: np.ndarray, values: np.ndarray) -> np.ndarray:
    """(3, d) slopes of a least-squares linear fit along the wide principal axes of the sites."""
    scores, widths, axes = np.linalg.svd(sites, full_matrices=False)
    wide = widths > _WIDE * widths[0]
    return axes[wide].T @ (scores[:, wide].T @ values / widths[wide, None])


class _Spline:
    """A constant and Σ weight · distance, through values (n, d) at sites (n, 3).

    The same as SciPy's ``RBFInterpolator`` of the linear kernel, evaluated in less than half the
    time by a compiled sum.
    """

    def __init__(self, sites: np.ndarray, values: np.ndarray):
        count = len(sites)
        system = np.ones((count + 1, count + 1))
        system[:count, :count] = -cdist(sites, sites)
        system[np.arange(count), np.arange(count)] = _SMOOTHING
        system[count, count] = 0
        right = np.vstack([values, np.zeros((1, values.shape[1]))])
        self._sites, self._weights = sites, solve(system, right, overwrite_a=True)

    def __call__(self, places: np.ndarray) -> np.ndarray:
        """The values (m, d) at places (m, 3)."""
        from dine.geometry.kernels import distance_sums

        sites, weights = (np.ascontiguousarray(x.T) for x in (self._sites, self._weights[:-1]))
        found = np.empty((len(places), len(weights)))
        run(distance_sums, 0, len(places), np.ascontiguousarray(places), sites, weights, found)
        return self._weights[-1] - found


def within_reach(places: np.ndarray) -> np.ndarray:
    """Places farther out than ``REACH`` drawn straight towards the middle."""
    squared = np.einsum("nc,nc->n", places, places)
    if not (squared > REACH**2).any():
        return places
    return places * (REACH / np.maximum(np.sqrt(squared), REACH))[:, None]
