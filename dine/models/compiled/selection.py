"""The K smallest entries of every row, and the gradient of the costs that they become."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from dine.geometry.kernels import jit
from dine.threads import run

_BLOCK = 2**18
"""Entries of a block of distances, so that it stays in a core's cache."""


@jit
def _count(keys, threshold):
    found = np.int32(0)
    for m in range(len(keys)):
        found = np.int32(found + np.int32(keys[m] <= threshold))
    return found


@jit
def _smallest(bits, count, start, source, target, index, cost, moves, first, last):
    """Bisect each row's threshold on the bits of its values, then collect what lies below.

    The bits of floats that are not negative sort as integers.
    """
    width = bits.shape[2]
    kind = bits.dtype.type
    keys = np.empty(width, bits.dtype)
    chosen = np.empty(count + 1, np.int64)
    for item in range(first, last):
        member, row = item // bits.shape[1], item % bits.shape[1]
        low, high = kind(np.iinfo(bits.dtype).max), kind(0)
        for m in range(width):
            # Cancellation leaves distances of zero slightly negative.
            keys[m] = max(bits[member, row, m], kind(0))
            low, high = min(low, keys[m]), max(high, keys[m])
        while low < high:
            middle = kind(low + ((high - low) >> 1))
            found = _count(keys, middle)
            if found > count:
                high = middle
            else:
                low = kind(middle + kind(1))
                if found == count:
                    break
        # All below ``low`` and, where equal values cross the threshold, the first of those at it.
        ties = count - _count(keys, kind(low - kind(1)))
        taken = 0
        for m in range(width):
            chosen[taken] = m
            equal = (keys[m] == low) & (ties > 0)
            ties -= equal
            taken += (keys[m] < low) | equal
            if taken == count:
                break
        point = start + row
        for k in range(count):
            m = chosen[k]
            index[member, point, k] = m
            cost[member, point, k] = keys[m]
            for axis in range(3):
                moves[member, point, k, axis] = (
                    target[member, m, axis] - source[member, point, axis]
                )


@jit
def _spread(grad, index, start, width, out, first, last):
    """Rows of a dense (B, rows, M) matrix from (B, N, K) entries and their columns."""
    rows = out.shape[1]
    for item in range(first, last):
        member, row = item // rows, item % rows
        out[member, row, :width] = 0
        for k in range(grad.shape[2]):
            out[member, row, index[member, start + row, k]] += grad[member, start + row, k]


def _rows_at_once(batch: int, columns: int) -> int:
    return max(1, _BLOCK // (batch * columns))


def nearest_candidates(
    source: Tensor,
    target: Tensor,
    source_features: Tensor,
    target_features: Tensor,
    count: int,
    target_mask: Tensor | None,
) -> tuple[Tensor, Tensor, Tensor]:
    """The ``count`` targets nearest in feature space, in blocks of rows, without gradient.

    Returns:
        index (B, N, K), displacement (B, N, K, 3), squared distance of the features (B, N, K);
        infinite at invalid targets.
    """
    source, target = source.detach().contiguous(), target.detach().contiguous()
    origin = source_features.detach().mean(dim=1, keepdim=True)
    a, b = source_features.detach() - origin, target_features.detach() - origin
    batch, points, _ = a.shape
    # One product gives |a|² + |b|² − 2a·b.
    a_square, b_square = a.square().sum(-1, keepdim=True), b.square().sum(-1, keepdim=True)
    if target_mask is not None:
        b_square = b_square.masked_fill(~target_mask.unsqueeze(-1), torch.inf)
    a = torch.cat([-2 * a, a_square, torch.ones_like(a_square)], dim=2)
    b = torch.cat([b, torch.ones_like(b_square), b_square], dim=2).transpose(1, 2)
    index = torch.empty(batch, points, count, dtype=torch.int64)
    cost = a.new_empty(batch, points, count)
    moves = a.new_empty(batch, points, count, 3)
    bits = np.int32 if a.dtype == torch.float32 else np.int64
    rows = _rows_at_once(batch, b.shape[2])
    for start in range(0, points, rows):
        distances = a[:, start : start + rows] @ b
        run(
            _smallest,
            0,
            distances.shape[0] * distances.shape[1],
            distances.numpy().view(bits),
            count,
            start,
            source.numpy(),
            target.numpy(),
            index.numpy(),
            cost.numpy().view(bits),
            moves.numpy(),
        )
    return index, moves, cost


class CandidateCost(torch.autograd.Function):
    """Mean squared difference (B, N, K) of features (B, N, C) and those at their candidates.

    ``cost`` holds the values already; only the gradient is worked out here.
    """

    @staticmethod
    def forward(ctx, source: Tensor, target: Tensor, index: Tensor, cost: Tensor) -> Tensor:
        ctx.save_for_backward(source, target, index)
        return cost / source.shape[-1]

    @staticmethod
    def backward(ctx, grad: Tensor):
        source, target, index = ctx.saved_tensors
        grad = grad.contiguous() * (2 / source.shape[-1])
        batch, points, _ = grad.shape
        width = target.shape[1]
        rows = _rows_at_once(batch, width)
        to_source = grad.sum(-1, keepdim=True) * source
        to_target = torch.zeros_like(target)
        received = grad.new_zeros(batch, width, 1)
        weights = grad.new_empty(batch, min(rows, points), width)
        ones = source.new_ones(batch, points, 1)
        for start in range(0, points, rows):
            part = slice(start, min(start + rows, points))
            block = weights[:, : part.stop - start]
            run(
                _spread,
                0,
                batch * (part.stop - start),
                grad.numpy(),
                index.numpy(),
                start,
                width,
                block.numpy(),
            )
            torch.baddbmm(to_source[:, part], block, target, alpha=-1, out=to_source[:, part])
            to_target.baddbmm_(block.transpose(1, 2), source[:, part], alpha=-1)
            received.baddbmm_(block.transpose(1, 2), ones[:, part])
        return to_source, to_target + received * target, None, None
