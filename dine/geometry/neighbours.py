"""Nearest neighbours within the members of a padded batch.

On the CPU one k-d tree holds the whole batch: a fourth coordinate keeps its members apart, so
there is one query, whose cost grows as N log N. Elsewhere distances are one matrix.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from dine.geometry.distance import nearest


def squared_distances(a: Tensor, b: Tensor) -> Tensor:
    """Squared Euclidean distances, (B, N, C) and (B, M, C) to (B, N, M).

    Uses |a|² + |b|² − 2a·b after moving both sets by the mean of ``a``, which keeps the
    cancellation error small; results are clamped at zero.
    """
    origin = a.detach().mean(dim=1, keepdim=True)
    a, b = a - origin, b - origin
    product = torch.baddbmm(
        a.square().sum(-1, keepdim=True) + b.square().sum(-1).unsqueeze(1),
        a,
        b.transpose(1, 2),
        alpha=-2,
    )
    return product.clamp_min(0)


def gather_points(points: Tensor, index: Tensor) -> Tensor:
    """Rows of ``points`` (B, N, C) at ``index`` (B, L): (B, L, C)."""
    return points.gather(1, index.unsqueeze(-1).expand(-1, -1, points.shape[-1]))


@dataclass(frozen=True)
class Neighbours:
    """Neighbours of Q query points among the P points of the same member.

    Attributes:
        index: (B, Q, k) int64, in 0…P−1.
        mask: (B, Q, k) bool, False at neighbours that do not exist: of a padded query point, or in
            a member with fewer than k valid points. None where all exist.
    """

    index: Tensor
    mask: Tensor | None


@torch.no_grad()
def nearest_neighbours(
    queries: Tensor,
    points: Tensor,
    k: int,
    query_mask: Tensor | None = None,
    point_mask: Tensor | None = None,
) -> Neighbours:
    """The ``k`` nearest of (B, P, 3) points to each of (B, Q, 3) queries, in no set order.

    Masks (B, Q) and (B, P) are True at valid points. Without a mask, k is at most P.
    """
    k = min(k, points.shape[1])
    if points.device.type == "cpu":
        index, found = _by_tree(queries, points, k, query_mask, point_mask)
    else:
        distances = squared_distances(queries, points)
        if point_mask is not None:
            distances = distances.masked_fill(~point_mask.unsqueeze(1), torch.inf)
        distances, index = distances.topk(k, dim=2, largest=False, sorted=False)
        found = distances.isfinite()
    if query_mask is None and point_mask is None:
        return Neighbours(index, None)
    return Neighbours(index, found if query_mask is None else found & query_mask.unsqueeze(-1))


def _by_tree(
    queries: Tensor,
    points: Tensor,
    k: int,
    query_mask: Tensor | None,
    point_mask: Tensor | None,
) -> tuple[Tensor, Tensor]:
    batch, count, _ = points.shape
    # A diverged network's values are caught where its loss is looked at.
    finite = [np.nan_to_num(x.numpy()).astype(np.float64) for x in (queries, points)]
    # Wider than any distance within a member, so that half of it bounds the search.
    width = 1 + 8 * max(float(np.abs(x).max(initial=0)) for x in finite)
    if batch > 1:
        member = width * np.arange(batch)[:, None, None]
        finite = [
            np.concatenate([x, np.broadcast_to(member, (*x.shape[:2], 1))], axis=2) for x in finite
        ]
    query, tree = (x.reshape(-1, x.shape[-1]) for x in finite)
    rows = np.arange(len(tree))
    if point_mask is not None:
        rows = rows[point_mask.numpy().ravel()]
    asked = np.arange(len(query))
    if query_mask is not None:
        asked = asked[query_mask.numpy().ravel()]
    _, position = nearest(cKDTree(tree[rows]), query[asked], [*range(1, k + 1)], within=width / 2)
    index = np.zeros((len(query), k), np.int64)
    # A neighbour that is missing has the position one past the last.
    index[asked] = np.append(rows % count, 0)[position]
    found = np.zeros((len(query), k), np.bool_)
    found[asked] = position < len(rows)
    shape = (*queries.shape[:2], k)
    return torch.from_numpy(index).view(shape), torch.from_numpy(found).view(shape)
