"""Chamfer distance."""

from __future__ import annotations

from torch import Tensor

from dine.geometry.neighbours import gather_points, nearest_neighbours


def nearest_squared(
    a: Tensor, b: Tensor, a_mask: Tensor | None = None, b_mask: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Squared distance of each point to the other set: (B, N) from ``a``, (B, M) from ``b``.

    Differentiable in both sets; entries of invalid points are zero.
    """
    to_b = nearest_neighbours(a.detach(), b.detach(), 1, a_mask, b_mask).index.squeeze(-1)
    to_a = nearest_neighbours(b.detach(), a.detach(), 1, b_mask, a_mask).index.squeeze(-1)
    from_a = (a - gather_points(b, to_b)).square().sum(-1)
    from_b = (b - gather_points(a, to_a)).square().sum(-1)
    if a_mask is not None:
        from_a = from_a.masked_fill(~a_mask, 0)
    if b_mask is not None:
        from_b = from_b.masked_fill(~b_mask, 0)
    return from_a, from_b


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
