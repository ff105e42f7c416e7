"""Edge convolution, and the maximum of a normalised linear map, without their large tensors.

A linear map is a library's matrix product on a tile of rows; what comes before and after it passes
over the same tile while it is in the cache. Of an edge convolution only the second activation
(B·N·k × C) is kept for the backward pass; the first is made again from the points' features.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from dine.geometry.neighbours import Neighbours
from dine.models.compiled.parallel import jit, run
from dine.models.compiled.rows import (
    Rows,
    Statistics,
    _finish,
    activate,
    activation_gradient,
    add_sums,
    block_rows,
    norm_gradient,
)


@jit
def _group_maximum(z, valid, origin, length, step, k, highest, argmax, first, last):
    """Maximum over the valid rows of each group of k rows, and which row it was."""
    per_member = -(-length // k)
    for block in range(first, last):
        member, begin, end = block_rows(block, length, step)
        start = member * length
        for left in range(begin, end, k):
            group = member * per_member + (left - start) // k
            highest[group] = -np.inf
            argmax[group] = 0
            for row in range(left, min(left + k, end)):
                if valid[row]:
                    which = np.int32(row - left)
                    for c in range(z.shape[1]):
                        better = z[row - origin, c] > highest[group, c]
                        argmax[group, c] = which if better else argmax[group, c]
                        highest[group, c] = z[row - origin, c] if better else highest[group, c]


@jit
def _maximum_gradient(
    z,
    valid,
    argmax,
    grad,
    mean,
    scale,
    mean_grad,
    mean_product,
    origin,
    length,
    step,
    k,
    first,
    last,
):
    """Gradient before the norm in place of the rows z before it; see ``LinearMaximum``."""
    per_member = -(-length // k)
    for block in range(first, last):
        member, begin, end = block_rows(block, length, step)
        start = member * length
        for left in range(begin, end, k):
            group = member * per_member + (left - start) // k
            for row in range(left, min(left + k, end)):
                if valid[row]:
                    which = np.int32(row - left)
                    for c in range(z.shape[1]):
                        normalised = (z[row - origin, c] - mean[member, c]) * scale[member, c]
                        g = grad[group, c] if argmax[group, c] == which else 0
                        g = g - mean_grad[member, c] - normalised * mean_product[member, c]
                        z[row - origin, c] = scale[member, c] * g
                else:
                    z[row - origin] = 0


class _Maximum:
    """max over groups of the norm of y Wᵀ: the norm keeps the order, so it comes last."""

    def __init__(self, rows: Rows, weight: Tensor, valid: np.ndarray):
        self.rows, self.weight, self.valid = rows, weight, valid
        channels = len(weight)
        self.statistics = Statistics(rows, channels, valid)
        self.highest = weight.new_empty(rows.members * rows.groups, channels).numpy()
        self.argmax = np.empty(self.highest.shape, np.int32)

    def add(self, y: Tensor, buffer: Tensor, first: int, last: int) -> None:
        """Take in the blocks first…last, whose rows are y (R, C)."""
        rows = self.rows
        z = torch.mm(y, self.weight.t(), out=buffer[: len(y)]).numpy()
        origin = rows.first_row(first)
        add_sums(z, self.statistics, origin, first, last)
        place = (origin, rows.length, rows.step, rows.group)
        run(_group_maximum, first, last, z, self.valid, *place, self.highest, self.argmax)

    def finish(self, eps: float) -> Tensor:
        """(B, G, C); zero at groups without a valid row."""
        dtype = self.highest.dtype
        self.mean, self.scale = self.statistics.normalisation(eps, dtype)
        shape = (self.rows.members, self.rows.groups, -1)
        highest = self.highest.reshape(shape)
        self.empty = np.isneginf(highest[..., 0])
        highest = (highest - self.mean[:, None]) * self.scale[:, None]
        highest[self.empty] = 0
        self.highest = highest
        return torch.from_numpy(highest)

    def begin_gradient(self, grad: Tensor) -> None:
        """Take the gradient (B, G, C) of the result."""
        dtype = self.highest.dtype
        # Not a product: what comes back to padded points may be NaN.
        grad = np.where(self.empty[..., None], dtype.type(0), grad.numpy())
        count = self.statistics.counts
        product = np.einsum("bgc,bgc->bc", grad, self.highest, dtype=np.float64)
        self.means = [
            (grad.sum(axis=1, dtype=np.float64) / count).astype(dtype),
            (product / count).astype(dtype),
        ]
        self.grad = np.ascontiguousarray(grad.reshape(-1, grad.shape[-1]))
        self.to_weight = torch.zeros_like(self.weight)

    def gradient(self, y: Tensor, buffer: Tensor, out: Tensor, first: int, last: int) -> None:
        """Gradient of the rows y of some blocks into ``out``; adds to that of the weight."""
        rows = self.rows
        z = torch.mm(y, self.weight.t(), out=buffer[: len(y)])
        run(
            _maximum_gradient,
            first,
            last,
            z.numpy(),
            self.valid,
            self.argmax,
            self.grad,
            self.mean,
            self.scale,
            *self.means,
            rows.first_row(first),
            rows.length,
            rows.step,
            rows.group,
        )
        self.to_weight.addmm_(z.t(), y)
        torch.mm(z, self.weight, out=out)


class LinearMaximum(torch.autograd.Function):
    """Instance norm of y Wᵀ over the rows of each member, then the maximum over groups of rows.

    Args of ``apply``: y (B, L, C), weight (C', C), rows in a group, mask (B, L) or None, eps. The
    result is (B, ⌈L / group⌉, C').
    """

    @staticmethod
    def forward(
        ctx, y: Tensor, weight: Tensor, group: int, mask: Tensor | None, eps: float
    ) -> Tensor:
        y = y.detach().contiguous()
        rows = Rows(*y.shape[:2], group)
        maximum = _Maximum(rows, weight.detach(), rows.valid(mask))
        flat = y.view(-1, y.shape[2])
        buffer = y.new_empty(rows.largest_tile(len(weight)), len(weight))
        for first, last, part in rows.tiles(len(weight)):
            maximum.add(flat[part], buffer, first, last)
        out = maximum.finish(eps)
        ctx.save_for_backward(y)
        ctx.maximum = maximum
        return out

    @staticmethod
    def backward(ctx, grad: Tensor):
        (y,) = ctx.saved_tensors
        maximum = ctx.maximum
        rows, width = maximum.rows, len(maximum.weight)
        maximum.begin_gradient(grad)
        flat = y.view(-1, y.shape[2])
        out = torch.empty_like(flat)
        buffer = y.new_empty(rows.largest_tile(width), width)
        for first, last, part in rows.tiles(width):
            maximum.gradient(flat[part], buffer, out[part], first, last)
        return out.view(y.shape), maximum.to_weight, None, None, None


@jit
def _edge_sums(near, own, neighbour, valid, k, length, step, total, spread, count, first, last):
    """Sums over blocks of the edges near[j] + own[i]."""
    channels = near.shape[1]
    s = np.empty(channels, near.dtype)
    q = np.empty(channels, near.dtype)
    shift = np.empty(channels, near.dtype)
    base = np.empty(channels, near.dtype)
    for block in range(first, last):
        _, begin, end = block_rows(block, length, step)
        s[:] = 0
        q[:] = 0
        shift[:] = 0
        found = 0
        for left in range(begin, end, k):
            i = left // k
            for row in range(left, left + k):
                if valid[row]:
                    j = neighbour[row]
                    if found == 0:
                        for c in range(channels):
                            shift[c] = near[j, c] + own[i, c]
                    found += 1
                    for c in range(channels):
                        base[c] = own[i, c] - shift[c]
                    for c in range(channels):
                        value = near[j, c] + base[c]
                        s[c] += value
                        q[c] += value * value
        _finish(total, spread, count, block, shift, s, q, found)


@jit
def _edge_activate(
    near, own, neighbour, valid, mean, scale, slope, k, origin, length, step, y, first, last
):
    """LeakyReLU of the normalised edges near[j] + own[i] into y, whose row 0 is ``origin``."""
    channels = near.shape[1]
    base = np.empty(channels, near.dtype)
    factor = np.empty(channels, near.dtype)
    for block in range(first, last):
        member, begin, end = block_rows(block, length, step)
        factor[:] = scale[member]
        for left in range(begin, end, k):
            i = left // k
            for c in range(channels):
                base[c] = (own[i, c] - mean[member, c]) * factor[c]
            for row in range(left, left + k):
                if valid[row]:
                    j = neighbour[row]
                    for c in range(channels):
                        value = near[j, c] * factor[c] + base[c]
                        y[row - origin, c] = value if value >= 0 else value * slope
                else:
                    y[row - origin] = 0


@jit
def _edge_gradient(
    grad,
    near,
    own,
    neighbour,
    valid,
    mean,
    scale,
    mean_grad,
    mean_product,
    k,
    length,
    step,
    to_own,
    first,
    last,
):
    """Gradient of the edges near[j] + own[i], in place, and its sum over each point's edges."""
    channels = near.shape[1]
    base = np.empty(channels, near.dtype)
    total = np.empty(channels, near.dtype)
    for block in range(first, last):
        member, begin, end = block_rows(block, length, step)
        for left in range(begin, end, k):
            i = left // k
            total[:] = 0
            for c in range(channels):
                base[c] = own[i, c] - mean[member, c]
            for row in range(left, left + k):
                if valid[row]:
                    j = neighbour[row]
                    for c in range(channels):
                        normalised = (near[j, c] + base[c]) * scale[member, c]
                        g = grad[row, c] - mean_grad[member, c]
                        g = scale[member, c] * (g - normalised * mean_product[member, c])
                        grad[row, c] = g
                        total[c] += g
                else:
                    grad[row] = 0
            to_own[i] = total


@jit
def _add_edges(grad, edges, start, out, first, last):
    """Sum of the rows of ``grad`` at the edges that end in each point."""
    for j in range(first, last):
        out[j] = 0
        for position in range(start[j], start[j + 1]):
            edge = edges[position]
            for c in range(grad.shape[1]):
                out[j, c] += grad[edge, c]


@jit
def _sort_edges(neighbour, start, edges):
    """Counting sort of the edges by the point that they end in."""
    for j in neighbour:
        start[j + 1] += 1
    for j in range(len(start) - 1):
        start[j + 1] += start[j]
    place = start[:-1].copy()
    for edge in range(len(neighbour)):
        j = neighbour[edge]
        edges[place[j]] = edge
        place[j] += 1


class Edges:
    """The edges i → its neighbours of a batch, in the form that the kernels take.

    Attributes:
        rows: members of N·k edges in groups of k.
        neighbour: (B·N·k,) int32, counted over the whole batch.
        valid: (B·N·k,) bool.
        start, order: the edges that end in point j are order[start[j]:start[j + 1]].
    """

    def __init__(self, neighbours: Neighbours):
        index = neighbours.index
        batch, points, k = index.shape
        member = points * torch.arange(batch).view(-1, 1, 1)
        self.rows = Rows(batch, points * k, k)
        self.neighbour = (index + member).to(torch.int32).numpy().ravel()
        self.valid = self.rows.valid(neighbours.mask)
        self.start = np.zeros(batch * points + 1, np.int64)
        self.order = np.empty(len(self.neighbour), np.int32)
        _sort_edges(self.neighbour, self.start, self.order)


class EdgeConvolution(torch.autograd.Function):
    """Norm, LeakyReLU, linear, norm, LeakyReLU, linear, norm, maximum, of near[j] + own[i].

    Args of ``apply``: near and own (B, N, C), two weights (C, C), edges, slope, eps. The result is
    (B, N, C), before the last LeakyReLU.
    """

    @staticmethod
    def forward(
        ctx,
        near: Tensor,
        own: Tensor,
        middle: Tensor,
        last_weight: Tensor,
        edges: Edges,
        slope: float,
        eps: float,
    ) -> Tensor:
        near, own = near.detach().contiguous(), own.detach().contiguous()
        middle, last_weight = middle.detach(), last_weight.detach()
        rows, valid, channels = edges.rows, edges.valid, near.shape[2]
        points = [x.numpy().reshape(-1, channels) for x in (near, own)]
        dtype = points[0].dtype
        slope = dtype.type(slope)
        place = (rows.length, rows.step)
        statistics = Statistics(rows, channels, valid)
        run(
            _edge_sums,
            0,
            rows.blocks,
            *points,
            edges.neighbour,
            valid,
            rows.group,
            *place,
            statistics.total,
            statistics.spread,
            statistics.count,
        )
        first_norm = (statistics, *statistics.normalisation(eps, dtype))
        statistics = Statistics(rows, channels, valid)
        kept = near.new_empty(len(valid), channels)
        buffer = near.new_empty(rows.largest_tile(channels), channels)
        for first, last, part in rows.tiles(channels):
            y = buffer[: part.stop - part.start]
            run(
                _edge_activate,
                first,
                last,
                *points,
                edges.neighbour,
                valid,
                *first_norm[1:],
                slope,
                rows.group,
                part.start,
                *place,
                y.numpy(),
            )
            z = torch.mm(y, middle.t(), out=kept[part])
            add_sums(z.numpy(), statistics, part.start, first, last)
        second_norm = (statistics, *statistics.normalisation(eps, dtype))
        maximum = _Maximum(rows, last_weight, valid)
        for first, last, part in rows.tiles(channels):
            y = kept[part]
            run(
                activate,
                first,
                last,
                y.numpy(),
                valid,
                *second_norm[1:],
                slope,
                part.start,
                *place,
            )
            maximum.add(y, buffer, first, last)
        ctx.save_for_backward(near, own, middle, kept)
        ctx.edges, ctx.slope, ctx.maximum = edges, slope, maximum
        ctx.first_norm, ctx.second_norm = first_norm, second_norm
        return maximum.finish(eps)

    @staticmethod
    def backward(ctx, grad: Tensor):
        near, own, middle, kept = ctx.saved_tensors
        edges, maximum, slope = ctx.edges, ctx.maximum, ctx.slope
        rows, valid, channels = edges.rows, edges.valid, near.shape[2]
        points = [x.numpy().reshape(-1, channels) for x in (near, own)]
        dtype = points[0].dtype
        place = (rows.length, rows.step)
        sums = np.empty((2, rows.blocks, channels))
        out = torch.empty_like(kept)
        size = rows.largest_tile(channels)
        buffer, other = near.new_empty(2, size, channels)

        statistics, _, scale = ctx.second_norm
        maximum.begin_gradient(grad)
        for first, last, part in rows.tiles(channels):
            y, g = kept[part], out[part]
            maximum.gradient(y, buffer, g, first, last)
            tile = (g.numpy(), y.numpy(), valid, slope, part.start, *place)
            run(activation_gradient, first, last, *tile, *sums)
        means = [x.astype(dtype) for x in statistics.means(*sums)]

        to_middle = torch.zeros_like(middle)
        statistics, *first_norm = ctx.first_norm
        for first, last, part in rows.tiles(channels):
            size = part.stop - part.start
            g, y, z = out[part], buffer[:size], other[:size]
            run(
                norm_gradient,
                first,
                last,
                g.numpy(),
                kept[part].numpy(),
                valid,
                slope,
                scale,
                *means,
                part.start,
                *place,
                z.numpy(),
            )
            run(
                _edge_activate,
                first,
                last,
                *points,
                edges.neighbour,
                valid,
                *first_norm,
                slope,
                rows.group,
                part.start,
                *place,
                y.numpy(),
            )
            to_middle.addmm_(z.t(), y)
            torch.mm(z, middle, out=g)
            tile = (g.numpy(), y.numpy(), valid, slope, part.start, *place)
            run(activation_gradient, first, last, *tile, *sums)
        means = [x.astype(dtype) for x in statistics.means(*sums)]

        to_near, to_own = torch.empty_like(near), torch.empty_like(own)
        run(
            _edge_gradient,
            0,
            rows.blocks,
            out.numpy(),
            *points,
            edges.neighbour,
            valid,
            *first_norm,
            *means,
            rows.group,
            *place,
            to_own.numpy().reshape(-1, channels),
        )
        run(
            _add_edges,
            0,
            len(edges.start) - 1,
            out.numpy(),
            edges.order,
            edges.start,
            to_near.numpy().reshape(-1, channels),
        )
        return to_near, to_own, to_middle, maximum.to_weight, None, None, None
