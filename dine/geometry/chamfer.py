"""Chamfer distance and the nearest neighbours that it is made of."""

from __future__ import annotations

import torch
from torch import Tensor


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


def nearest(
    a: Tensor, b: Tensor, a_mask: Tensor | None = None, b_mask: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Indices of the nearest neighbours, both ways: (B, N) into ``b`` and (B, M) into ``a``.

    Masks are True at valid points; entries of invalid points are meaningless.
    """
    with torch.no_grad():
        distances = squared_distances(a, b)
        if b_mask is not None:
            distances = distances.masked_fill(~b_mask.unsqueeze(1), torch.inf)
        if a_mask is not None:
            distances = distances.masked_fill(~a_mask.unsqueeze(2), torch.inf)
        return distances.argmin(dim=2), distances.argmin(dim=1)


def gather_points(points: Tensor, index: Tensor) -> Tensor:
    """Rows of ``points`` (B, N, C) at ``index`` (B, L): (B, L, C)."""
    return points.gather(1, index.unsqueeze(-1).expand(-1, -1, points.shape[-1]))


def nearest_squared(
    a: Tensor, b: Tensor, a_mask: Tensor | None = None, b_mask: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Squared distance of each point to the other set: (B, N) from ``a``, (B, M) from ``b``.

    Differentiable in both sets; entries of invalid points are zero.
    """
    to_b, to_a = nearest(a, b, a_mask, b_mask)
    # Differences of the matched points are exact where the expansion above cancels.
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
