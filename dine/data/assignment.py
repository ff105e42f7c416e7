"""The cheapest one-to-one assignment of points to a template, exactly, without a cost matrix.

Every point has a price, and what it costs an entry of the template is their squared distance less
this price. Free entries take turns: each gets its cheapest point or, where that is taken, sets off
the cheapest chain of exchanges that ends at a free point (a shortest path). The prices along the
chain then fall so far that every entry still holds the point that costs it least. An assignment of
that kind is the cheapest of all (Kuhn and Munkres; Jonker and Volgenant), whatever the prices were
at the start. The rest is speed:

* Prices from a coarser, blurred problem (Sinkhorn) leave few chains, and short ones.
* An entry looks at its cheapest points alone. As prices only fall, no other point can come to cost
  it less than the dearest of them did at first. Where a chain gets to that cost, the entry looks at
  all points; once that has happened often, the cheapest points are looked up anew.
"""

from __future__ import annotations

import heapq

import numba
import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist

# Fastest, or close to it, from 256 to 4096 points on meshes, scans and primitives.
_CANDIDATES = 32
_BLURS = (0.1, 0.02, 0.005)
_SWEEPS = 20


def cheapest_assignment(points: np.ndarray, template: np.ndarray, coarse: np.ndarray) -> np.ndarray:
    """The one-to-one assignment with the least sum of squared distances.

    Moving the points or scaling them all alike changes nothing.

    Args:
        points: (N, D) finite points.
        template: (N, D) points in the unit ball.
        coarse: (M, D) points spread as the template, best about N / 8: not needed for the result,
            but for finding it fast.

    Returns:
        (N,) permutation; point ``order[i]`` is assigned to entry i of the template. Which one of
        several equally cheap assignments it is follows from the arguments alone.
    """
    points = points - points.mean(axis=0)
    size = np.sqrt((points**2).sum() / (template**2).sum())
    # Plain arrays alone, since every other kind would be compiled for once more.
    points = np.array(points / (size or 1.0), order="C")
    template = np.array(template, order="C")
    prices = _blurred_prices(points, coarse)
    point_of = np.full(len(points), -1)
    entry_of = np.full(len(points), -1)
    done = False
    while not done:
        candidates, limits = _cheapest_points(points, template, prices)
        done = _assign(points, template, prices, candidates, limits, point_of, entry_of)
    return point_of


def _blurred_prices(points: np.ndarray, coarse: np.ndarray) -> np.ndarray:
    """Prices at which the points spread evenly, up to a blur, over the coarse template."""
    cost = cdist(coarse, points, "sqeuclidean").astype(np.float32)
    share = np.float32(len(points) / len(coarse))
    rents, prices = np.zeros(len(coarse), np.float32), cost.min(axis=0)
    for blur in np.float32(_BLURS):
        # The floor keeps all factors within float32, however far off a point is.
        kernel = np.exp(np.maximum((rents[:, None] + prices - cost) / blur, -25))
        b = np.ones_like(prices)
        for _ in range(_SWEEPS):
            # Unlike a matrix product, einsum adds up in one order on any number of threads.
            a = share / np.einsum("ij,j->i", kernel, b)
            b = 1 / np.einsum("ij,i->j", kernel, a)
        rents += blur * np.log(a)
        prices += blur * np.log(b)
    return prices.astype(np.float64)


def _cheapest_points(
    points: np.ndarray, template: np.ndarray, prices: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The (N, k) cheapest points of each entry, cheapest first, and what others cost at least.

    With the square root of (highest price - price) as a further coordinate of the points, the
    cheapest are the nearest.
    """
    top = prices.max()
    lifted = np.column_stack([points, np.sqrt(top - prices)])
    entries = np.column_stack([template, np.zeros(len(template))])
    ranks = np.arange(1, min(_CANDIDATES, len(points)) + 1)
    distances, nearest = cKDTree(lifted).query(entries, k=ranks)
    # A little less, since the distances are rounded.
    return nearest, distances[:, -1] ** 2 * (1 - 1e-12) - top


_jit = numba.njit(cache=True, error_model="numpy")


@_jit
def _cost(points, template, prices, i, j):
    total = -prices[j]
    for axis in range(points.shape[1]):
        total += (template[i, axis] - points[j, axis]) ** 2
    return total


@_jit
def _assign(points, template, prices, candidates, limits, point_of, entry_of):
    """Give every free entry a point, in place; False once the candidates are out of date."""
    count = len(points)
    for i in range(count):
        cheapest = candidates[i, 0]
        if point_of[i] < 0 and entry_of[cheapest] < 0:
            point_of[i], entry_of[cheapest] = cheapest, i

    everything = np.arange(count)
    length = np.empty(count)  # of the shortest path to a point so far; -inf once that is settled
    via = np.empty(count, np.int64)  # the entry before it
    start = np.empty(count)  # what is to be added to the costs of an entry on a path
    full_looks = 0
    for free in range(count):
        if point_of[free] >= 0:
            continue
        if full_looks > count // 4:
            return False
        length[:] = np.inf
        settled = [(0.0, 0) for _ in range(0)]
        shortest, end = np.inf, -1  # to a free point
        # (length, point), or (length from which all points matter to an entry, -1 - entry)
        heap = [(limits[free], -1 - free)]
        i, looked_at = free, candidates[free]
        start[free] = 0.0
        while i >= 0:
            for j in looked_at:
                reached = start[i] + _cost(points, template, prices, i, j)
                if reached < length[j] and reached < shortest:
                    length[j], via[j] = reached, i
                    if entry_of[j] < 0:
                        shortest, end = reached, j
                    else:
                        heapq.heappush(heap, (reached, j))
            i = -1
            while i < 0 and len(heap) > 0 and heap[0][0] < shortest:
                reached, j = heapq.heappop(heap)
                if j < 0:
                    i, looked_at = -1 - j, everything
                    full_looks += 1
                elif reached == length[j]:
                    settled.append((reached, j))
                    length[j] = -np.inf
                    i = entry_of[j]
                    looked_at = candidates[i]
                    start[i] = reached - _cost(points, template, prices, i, j)
                    heapq.heappush(heap, (start[i] + limits[i], -1 - i))
        for reached, j in settled:
            prices[j] -= shortest - reached
        while end >= 0:
            i = via[end]
            entry_of[end] = i
            point_of[i], end = end, point_of[i]
    return True
