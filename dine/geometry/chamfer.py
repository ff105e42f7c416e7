"""Chamfer distance."""

from __future__ import annotations

from typing import NamedTuple

from torch import Tensor

from dine.geometry.neighbours import gather_points, nearest_neighbours


class Nearest(NamedTuple):
    """What is nearest to what between two clouds.

    Attributes:
        from_a: (B, N) squared distance of each point of a to b, zero at invalid points.
        from_b: (B, M) likewise from b to a.
        in_b: (B, N) int64, the point of b that is nearest to each of a; 0 at invalid points.
        in_a: (B, M) int64, likewise.
    """

    from_a: Tensor
    from_b: Tensor
    in_b: Tensor
    in_a: Tensor


def nearest(
    a: Tensor, b: Tensor, a_mask: Tensor | None = None, b_mask: Tensor | None = None
) -> Nearest:
    """Nearest points of (B, N, 3) in (B, M, 3) and the other way; masks are True at valid points.

    The squared distances are differentiable in both clouds.
    """
    in_b = nearest_neighbours(a.detach(), b.detach(), 1, a_mask, b_mask).index.squeeze(-1)
    in_a = nearest_neighbours(b.detach(), a.detach(), 1, b_mask, a_mask).index.squeeze(-1)
    from_a = (a - gather_points(b, in_b)).square().sum(-1)
    from_b = (b - gather_points(a, in_a)).square().sum(-1)
    if a_mask is not None:
        from_a = from_a.masked_fill(~a_mask, 0)
    if b_mask is not None:
        from_b = from_b.masked_fill(~b_mask, 0)
    return Nearest(from_a, from_b, in_b, in_a)


def nearest_squared(
    a: Tensor, b: Tensor, a_mask: Tensor | None = None, b_mask: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Squared distance of each point to the other set: (B, N) from ``a``, (B, M) from ``b``.

    Differentiable in both sets; entries of invalid points are zero.
    """
    found = nearest(a, b, a_mask, b_mask)
    return found.from_a, found.from_b


def masked_mean(values: Tensor, mask: Tensor | None) -> Tensor:
    """Mean over the last dimension of (B, N) values, counting valid entries only: (B,)."""
    if mask is None:
        return values.mean(-1)
    return values.masked_fill(~mask, 0).sum(-1) / mask.sum(-1)


def chamfer_distance(
    a: Tensor, b: Tensor, a_mask: Tensor | None = None, b_mask: Tensor | None = None
) -> Tensor:
    """Symmetric squared Chamfer distance per pair, (B,): the paper's L_CD.

    mean over a of min_b ‖a − b‖² plus mean over b of min_a ‖a − b‖², in squared units of the
    input (the paper's tables show it ×1e4). ``a`` is (B, N, 3), ``b`` (B, M, 3); masks (B, N) and
    (B, M) are True at valid points.
    """
    from_a, from_b = nearest_squared(a, b, a_mask, b_mask)
    return masked_mean(from_a, a_mask) + masked_mean(from_b, b_mask)
