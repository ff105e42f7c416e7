"""Edge convolution, and the maximum of a normalised linear map, without their large tensors.

A linear map is a library's matrix product on a tile of rows; what comes before and after it passes
over the same tile while it is in the cache. Of an edge convolution only the second activation
(B·N·k × C) is kept for the backward pass; the first is made again from the points' features.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from dine.geometry.kernels import jit
from dine.geometry.neighbours import Neighbours
from dine.models.compiled.rows import (
    Rows,
    Statistics,
    Tile,
    activate,
    activation_gradient,
    block_rows,
    finish_sums,
    norm_gradient,
    sums,
)
from dine.threads import run, share


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


class _Buffers:
    """Memory for a tile's rows (R, C), for each worker."""

    def __init__(self, like: Tensor, tiles: list[Tile], channels: int):
        self._like, self._rows, self._channels = like, max(map(len, tiles)), channels
        self._kept: dict[int, Tensor] = {}

    def get(self, worker: int, tile: Tile) -> Tensor:
        if worker not in self._kept:
            self._kept[worker] = self._like.new_empty(self._rows, self._channels)
        return self._kept[worker][: len(tile)]


class _Maximum:
    """max over groups of the norm of y Wᵀ: the norm keeps the order, so it comes last."""

    def __init__(self, rows: Rows, weight: Tensor, valid: np.ndarray):
        self.rows, self.weight, self.valid = rows, weight, valid
        self.tiles = rows.tiles(len(weight))
        self.statistics = Statistics(rows, len(weight), valid)
        self.highest = weight.new_empty(rows.members * rows.groups, len(weight)).numpy()
        self.argmax = np.empty(self.highest.shape, np.int32)

    def add(self, y: Tensor, tile: Tile, buffer: Tensor) -> None:
        """Take in a tile, whose rows are y (R, C)."""
        rows, blocks = self.rows, (tile.first, tile.last)
        z = torch.mm(y, self.weight.t(), out=buffer).numpy()
        place = (tile.rows.start, rows.length, rows.step)
        sums(z, self.valid, *place, *self.statistics.sums, *blocks)
        _group_maximum(z, self.valid, *place, rows.group, self.highest, self.argmax, *blocks)

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
        self._to_weight = self.weight.new_empty(len(self.tiles), *self.weight.shape)

    def gradient(self, y: Tensor, tile: Tile, buffer: Tensor, out: Tensor) -> None:
        """Gradient of a tile's rows y into ``out``, and of the weight."""
        rows = self.rows
        z = torch.mm(y, self.weight.t(), out=buffer)
        _maximum_gradient(
            z.numpy(),
            self.valid,
            self.argmax,
            self.grad,
            self.mean,
            self.scale,
            *self.means,
            tile.rows.start,
            rows.length,
            rows.step,
            rows.group,
            tile.first,
            tile.last,
        )
        torch.mm(z.t(), y, out=self._to_weight[tile.number])
        torch.mm(z, self.weight, out=out)

    def weight_gradient(self) -> Tensor:
        """The sum over tiles, in their order whoever worked on them."""
        return self._to_weight.sum(dim=0)


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
        buffers = _Buffers(y, maximum.tiles, len(weight))
        share(
            maximum.tiles,
            lambda worker, tile: maximum.add(flat[tile.rows], tile, buffers.get(worker, tile)),
        )
        out = maximum.finish(eps)
        ctx.save_for_backward(y)
        ctx.maximum, ctx.mask = maximum, mask
        return out

    @staticmethod
    def backward(ctx, grad: Tensor):
        """Without the large tensor y Wᵀ: what the norm adds to its gradient is linear in y.

        With n̂ the normalised values, the gradient before the norm is scale · (g − mean g −
        n̂ · mean(g n̂)), where g is zero but at the maxima. So its sparse part takes a few rows of y
        and W, and its dense part two small products of the Gram matrix yᵀy.
        """
        (y,) = ctx.saved_tensors
        maximum = ctx.maximum
        maximum.begin_gradient(grad)
        weight, group = maximum.weight, maximum.rows.group
        mean, scale, mean_grad, mean_product = (
            torch.from_numpy(x) for x in (maximum.mean, maximum.scale, *maximum.means)
        )
        if ctx.mask is not None:
            y = y * ctx.mask.unsqueeze(-1)
        dense = scale.square() * mean_product
        constant = dense * mean - scale * mean_grad
        out = y @ -((weight.t() * dense.unsqueeze(1)) @ weight)
        out += (constant @ weight).unsqueeze(1)
        if ctx.mask is not None:
            out *= ctx.mask.unsqueeze(-1)
        to_weight = constant.t() @ y.sum(dim=1)
        to_weight -= ((weight * dense.unsqueeze(-1)) @ (y.transpose(1, 2) @ y)).sum(dim=0)

        sparse = torch.from_numpy(maximum.grad).view(grad.shape) * scale.unsqueeze(1)
        member, place, channel = sparse.nonzero(as_tuple=True)
        values = sparse[member, place, channel].unsqueeze(1)
        argmax = torch.from_numpy(maximum.argmax).view(grad.shape)
        row = place * group + argmax[member, place, channel]
        # Adds in order, unlike index_put_ on several threads.
        out.flatten(0, 1).index_add_(0, member * y.shape[1] + row, values * weight[channel])
        to_weight.index_add_(0, channel, values * y[member, row])
        return out, to_weight, None, None, None


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
        finish_sums(total, spread, count, block, shift, s, q, found)


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
        size = (rows.length, rows.step)
        maximum = _Maximum(rows, last_weight, valid)
        buffers = _Buffers(near, maximum.tiles, channels)

        first = Statistics(rows, channels, valid)
        graph = (*points, edges.neighbour, valid)
        run(_edge_sums, 0, rows.blocks, *graph, rows.group, *size, *first.sums)
        first_norm = first.normalisation(eps, dtype)

        second = Statistics(rows, channels, valid)
        kept = near.new_empty(len(valid), channels)

        def linear(worker: int, tile: Tile) -> None:
            y = buffers.get(worker, tile)
            blocks, place = (tile.first, tile.last), (tile.rows.start, *size)
            norm = (*first_norm, slope)
            _edge_activate(*graph, *norm, rows.group, *place, y.numpy(), *blocks)
            z = torch.mm(y, middle.t(), out=kept[tile.rows]).numpy()
            sums(z, valid, *place, *second.sums, *blocks)

        share(maximum.tiles, linear)
        second_norm = second.normalisation(eps, dtype)

        def reduce(worker: int, tile: Tile) -> None:
            y = kept[tile.rows]
            blocks, place = (tile.first, tile.last), (tile.rows.start, *size)
            activate(y.numpy(), valid, *second_norm, slope, *place, *blocks)
            maximum.add(y, tile, buffers.get(worker, tile))

        share(maximum.tiles, reduce)
        ctx.save_for_backward(near, own, middle, kept)
        ctx.edges, ctx.slope, ctx.maximum = edges, slope, maximum
        ctx.first, ctx.second = (first, *first_norm), (second, *second_norm)
        return maximum.finish(eps)

    @staticmethod
    def backward(ctx, grad: Tensor):
        near, own, middle, kept = ctx.saved_tensors
        edges, maximum, slope = ctx.edges, ctx.maximum, ctx.slope
        rows, valid, channels = edges.rows, edges.valid, near.shape[2]
        points = [x.numpy().reshape(-1, channels) for x in (near, own)]
        dtype = points[0].dtype
        size = (rows.length, rows.step)
        graph = (*points, edges.neighbour, valid)
        block_sums = np.empty((2, rows.blocks, channels))
        out = torch.empty_like(kept)
        buffers, others = (_Buffers(near, maximum.tiles, channels) for _ in range(2))

        second, _, second_scale = ctx.second
        maximum.begin_gradient(grad)

        def after_norm(worker: int, tile: Tile) -> None:
            y, g = kept[tile.rows], out[tile.rows]
            maximum.gradient(y, tile, buffers.get(worker, tile), g)
            place = (tile.rows.start, *size)
            blocks = (tile.first, tile.last)
            activation_gradient(g.numpy(), y.numpy(), valid, slope, *place, *block_sums, *blocks)

        share(maximum.tiles, after_norm)
        means = [x.astype(dtype) for x in second.means(*block_sums)]

        first, *first_norm = ctx.first
        to_middle = middle.new_empty(len(maximum.tiles), *middle.shape)

        def after_edges(worker: int, tile: Tile) -> None:
            g, y, z = out[tile.rows], buffers.get(worker, tile), others.get(worker, tile)
            blocks, place = (tile.first, tile.last), (tile.rows.start, *size)
            values = (g.numpy(), kept[tile.rows].numpy(), valid, slope, second_scale)
            norm_gradient(*values, *means, *place, z.numpy(), *blocks)
            norm = (*first_norm, slope)
            _edge_activate(*graph, *norm, rows.group, *place, y.numpy(), *blocks)
            torch.mm(z.t(), y, out=to_middle[tile.number])
            torch.mm(z, middle, out=g)
            activation_gradient(g.numpy(), y.numpy(), valid, slope, *place, *block_sums, *blocks)

        share(maximum.tiles, after_edges)
        means = [x.astype(dtype) for x in first.means(*block_sums)]

        to_near, to_own = torch.empty_like(near), torch.empty_like(own)
        flat = (to_near.numpy().reshape(-1, channels), to_own.numpy().reshape(-1, channels))
        norm = (*first_norm, *means)
        grad = out.numpy()
        run(_edge_gradient, 0, rows.blocks, grad, *graph, *norm, rows.group, *size, flat[1])
        run(_add_edges, 0, len(flat[0]), grad, edges.order, edges.start, flat[0])
        weights = (to_middle.sum(dim=0), maximum.weight_gradient())
        return to_near, to_own, *weights, None, None, None
