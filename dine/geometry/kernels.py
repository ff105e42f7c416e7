"""How kernels are compiled, and those of geometry. numba takes a while to import, so this module is
imported where a kernel is called."""

from __future__ import annotations

import math

import numba

# Not the full fast-math set: infinities must keep their meaning, and sums are split by hand.
_FAST = {"contract", "nsz", "nnan", "arcp", "afn"}
jit = numba.njit(cache=True, nogil=True, fastmath=_FAST, error_model="numpy")
_reordered = numba.njit(cache=True, nogil=True, fastmath={*_FAST, "reassoc"}, error_model="numpy")


@_reordered
def distance_sums(places, sites, weights, sums, first, last):
    """For places (m, 3) ``first`` to ``last``, Σ weight · distance over sites (3, n), with weights
    (d, n), into ``sums`` (m, d); all float64."""
    for i in range(first, last):
        x, y, z = places[i, 0], places[i, 1], places[i, 2]
        for column in range(len(weights)):
            total = 0.0
            for j in range(sites.shape[1]):
                a, b, c = x - sites[0, j], y - sites[1, j], z - sites[2, j]
                total += weights[column, j] * math.sqrt(a * a + b * b + c * c)
            sums[i, column] = total
