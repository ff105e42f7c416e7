"""Instance norm over the rows of (B, L, C), in blocks of rows.

The edge tensors (30 720 × 64 at 1024 points) exceed the caches, so what they cost is the number of
passes over memory. Rows are therefore dealt with in tiles that stay in the second cache level, and
a tile consists of blocks, each of one member, whose sums are added up in a fixed order.

``valid`` (B·L) marks the rows that count; others give zeros.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from dine.geometry.kernels import jit
from dine.threads import run

_BLOCK_ROWS = 256
_TILE_ENTRIES = 2**17


@dataclass(frozen=True)
class Tile:
    """Some consecutive blocks: number of the tile, first and last block, rows among the B·L."""

    number: int
    first: int
    last: int
    rows: slice

    def __len__(self) -> int:
        return self.rows.stop - self.rows.start


@dataclass(frozen=True)
class Rows:
    """How B members of ``length`` rows, in groups of ``group`` rows, are cut into blocks.

    Whole groups make up a block; the last group of a member may be shorter than the others.
    """

    members: int
    length: int
    group: int = 1

    @property
    def groups(self) -> int:
        """Groups of one member."""
        return -(-self.length // self.group)

    @property
    def step(self) -> int:
        """Rows of a whole block."""
        return self.group * max(1, _BLOCK_ROWS // self.group)

    @property
    def per_member(self) -> int:
        """Blocks of one member."""
        return -(-self.length // self.step)

    @property
    def blocks(self) -> int:
        return self.members * self.per_member

    def first_row(self, block: int) -> int:
        member, inner = divmod(block, self.per_member)
        return member * self.length + min(inner * self.step, self.length)

    def tiles(self, channels: int) -> list[Tile]:
        """The blocks in tiles that suit a core's cache."""
        blocks = max(1, _TILE_ENTRIES // (self.step * channels))
        tiles = []
        for number, first in enumerate(range(0, self.blocks, blocks)):
            last = min(first + blocks, self.blocks)
            rows = slice(self.first_row(first), self.first_row(last))
            tiles.append(Tile(number, first, last, rows))
        return tiles

    def valid(self, mask: Tensor | None) -> np.ndarray:
        """A mask of B·L rows, in the order of the rows."""
        if mask is None:
            return np.ones(self.members * self.length, np.bool_)
        return mask.contiguous().numpy().ravel()


@jit
def block_rows(block, length, step):
    """Member, first and last row of a block, rows counted over all members."""
    per_member = -(-length // step)
    member, inner = block // per_member, block % per_member
    begin = member * length
    return member, begin + inner * step, begin + min((inner + 1) * step, length)


class Statistics:
    """Mean and variance of the valid rows of every member, from sums over blocks.

    Blocks measure from one of their own rows, which avoids the cancellation of E[x²] − E[x]².
    """

    def __init__(self, rows: Rows, channels: int, valid: np.ndarray):
        self.rows = rows
        self.total = np.empty((rows.blocks, channels))
        self.spread = np.empty((rows.blocks, channels))
        self.count = np.empty(rows.blocks)
        self.valid = valid

    @property
    def sums(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Where kernels put the sums of their blocks."""
        return self.total, self.spread, self.count

    def normalisation(self, eps: float, dtype: np.dtype) -> tuple[np.ndarray, np.ndarray]:
        """Mean and 1/√(biased variance + eps): both (B, C)."""
        shape = (self.rows.members, self.rows.per_member, -1)
        count = self.count.reshape(shape)
        total, spread = self.total.reshape(shape), self.spread.reshape(shape)
        self.counts = np.maximum(count.sum(axis=1), 1)
        mean = total.sum(axis=1) / self.counts
        offset = total / np.maximum(count, 1) - mean[:, None]
        variance = (spread + count * offset**2).sum(axis=1) / self.counts
        return mean.astype(dtype), (1 / np.sqrt(variance + eps)).astype(dtype)

    def means(self, *sums: np.ndarray) -> list[np.ndarray]:
        """Block sums (blocks, C) to means over the valid rows of every member (B, C)."""
        shape = (self.rows.members, self.rows.per_member, -1)
        return [x.reshape(shape).sum(axis=1) / self.counts for x in sums]


@jit
def finish_sums(total, spread, count, block, shift, s, q, found):
    count[block] = found
    for c in range(len(s)):
        mean = s[c] / max(found, 1)
        total[block, c] = s[c] + found * np.float64(shift[c])
        spread[block, c] = max(q[c] - s[c] * mean, 0)


@jit
def sums(x, valid, origin, length, step, total, spread, count, first, last):
    """Sums over blocks of x, whose row 0 is row ``origin``."""
    channels = x.shape[1]
    s = np.empty(channels, x.dtype)
    q = np.empty(channels, x.dtype)
    shift = np.empty(channels, x.dtype)
    for block in range(first, last):
        _, begin, end = block_rows(block, length, step)
        s[:] = 0
        q[:] = 0
        shift[:] = 0
        found = 0
        for row in range(begin, end):
            if valid[row]:
                if found == 0:
                    shift[:] = x[row - origin]
                found += 1
                for c in range(channels):
                    value = x[row - origin, c] - shift[c]
                    s[c] += value
                    q[c] += value * value
        finish_sums(total, spread, count, block, shift, s, q, found)


@jit
def activate(x, valid, mean, scale, slope, origin, length, step, first, last):
    """LeakyReLU of the normalised rows, in place."""
    for block in range(first, last):
        member, begin, end = block_rows(block, length, step)
        for row in range(begin, end):
            if valid[row]:
                for c in range(x.shape[1]):
                    value = (x[row - origin, c] - mean[member, c]) * scale[member, c]
                    x[row - origin, c] = value if value >= 0 else value * slope
            else:
                x[row - origin] = 0


@jit
def activation_gradient(grad, y, valid, slope, origin, length, step, total, product, first, last):
    """Gradient before the activation, in place of that after it; sums of it and of it times x̂.

    x̂, the normalised value, is recovered from the output y: the slope is positive.
    """
    channels = y.shape[1]
    inverse = 1 / slope
    s = np.empty(channels, y.dtype)
    p = np.empty(channels, y.dtype)
    for block in range(first, last):
        _, begin, end = block_rows(block, length, step)
        s[:] = 0
        p[:] = 0
        for row in range(begin, end):
            if valid[row]:
                for c in range(channels):
                    value = y[row - origin, c]
                    g = grad[row - origin, c]
                    g = g * slope if value < 0 else g
                    grad[row - origin, c] = g
                    s[c] += g
                    p[c] += g * (value * inverse if value < 0 else value)
        for c in range(channels):
            total[block, c] = s[c]
            product[block, c] = p[c]


@jit
def norm_gradient(
    grad, y, valid, slope, scale, mean_grad, mean_product, origin, length, step, out, first, last
):
    """Gradient before the norm from that after it; ``out`` may be ``grad`` itself."""
    inverse = 1 / slope
    for block in range(first, last):
        member, begin, end = block_rows(block, length, step)
        for row in range(begin, end):
            if valid[row]:
                for c in range(y.shape[1]):
                    value = y[row - origin, c]
                    value = value * inverse if value < 0 else value
                    g = grad[row - origin, c] - mean_grad[member, c]
                    out[row - origin, c] = scale[member, c] * (g - value * mean_product[member, c])
            else:
                out[row - origin] = 0


class NormLeakyReLU(torch.autograd.Function):
    """LeakyReLU(instance norm) of (B, L, C) over L; slope 1 is the norm alone.

    Args of ``apply``: x, slope, mask (B, L) or None, eps.
    """

    @staticmethod
    def forward(ctx, x: Tensor, slope: float, mask: Tensor | None, eps: float) -> Tensor:
        y = x.detach().clone(memory_format=torch.contiguous_format)
        rows = Rows(*x.shape[:2])
        values = y.numpy().reshape(-1, x.shape[2])
        statistics = Statistics(rows, x.shape[2], rows.valid(mask))
        place = (0, rows.length, rows.step)
        run(sums, 0, rows.blocks, values, statistics.valid, *place, *statistics.sums)
        mean, scale = statistics.normalisation(eps, values.dtype)
        slope = values.dtype.type(slope)
        valid = statistics.valid
        run(activate, 0, rows.blocks, values, valid, mean, scale, slope, *place)
        ctx.save_for_backward(y)
        ctx.slope, ctx.scale, ctx.statistics = slope, scale, statistics
        return y

    @staticmethod
    def backward(ctx, grad: Tensor):
        (y,) = ctx.saved_tensors
        statistics, rows = ctx.statistics, ctx.statistics.rows
        values = y.numpy().reshape(-1, y.shape[2])
        out = grad.clone(memory_format=torch.contiguous_format)
        changed = out.numpy().reshape(values.shape)
        total, product = np.empty((2, rows.blocks, y.shape[2]))
        place = (0, rows.length, rows.step)
        common = (changed, values, statistics.valid, ctx.slope)
        run(activation_gradient, 0, rows.blocks, *common, *place, total, product)
        means = [x.astype(values.dtype) for x in statistics.means(total, product)]
        run(norm_gradient, 0, rows.blocks, *common, ctx.scale, *means, *place, changed)
        return out, None, None, None
