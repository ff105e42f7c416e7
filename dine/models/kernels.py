"""Compiled CPU kernels of the two hot paths; their eager forms, beside the callers, work anywhere.

*Messages*: one edge costs K² candidate pairs of three multiply-adds, a comparison and two
selections. The inner loop runs over the receiver's candidates, so it vectorises and its operands
stay in the first cache level; the winner, which the backward pass needs, comes along at no extra
pass over memory.

*Normalisation*: the edge tensors (30 720 × 64 at 1024 points) exceed the caches, so their cost is
the number of passes over memory. Statistics, normalisation, activation and the maximum over
neighbours take one pass each way here. Sums run over fixed blocks of rows that are added in a fixed
order, so results do not depend on the number of threads.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from functools import cache
from itertools import pairwise

import numba
import numpy as np
import torch
from torch import Tensor

MAX_CANDIDATES = 32767
"""Winners are stored as 16-bit integers."""

_ROWS = 256

# Not the full fast-math set: infinities must keep their meaning, and sums are split by hand.
_FAST = {"contract", "nsz", "nnan", "arcp", "afn"}
_jit = numba.njit(cache=True, nogil=True, fastmath=_FAST, error_model="numpy")


def supported(*tensors: Tensor) -> bool:
    """Whether the compiled kernels take these tensors: float32 or float64 on the CPU."""
    return all(
        t.device.type == "cpu" and t.dtype in (torch.float32, torch.float64) for t in tensors
    )


@cache
def _pool(threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads)


def _run(kernel, count: int, *arguments) -> None:
    """Call ``kernel(*arguments, first, last)`` over ``count`` items on torch's number of threads.

    The kernels release the interpreter lock.
    """
    threads = min(torch.get_num_threads(), count)
    if threads <= 1:
        kernel(*arguments, 0, count)
        return
    bounds = np.linspace(0, count, threads + 1).astype(int).tolist()
    pool = _pool(threads)
    parts = [pool.submit(kernel, *arguments, first, last) for first, last in pairwise(bounds)]
    for part in parts:
        part.result()


# --- messages -------------------------------------------------------------------------------------


@_jit
def _send(h, planes, squares, tail, head, factor, messages, argmin, first, last):
    count = h.shape[1]
    best = np.empty(count, h.dtype)
    winner = np.empty(count, np.int32)
    for edge in range(first, last):
        i, j = tail[edge], head[edge]
        x, y, z = planes[j, 0], planes[j, 1], planes[j, 2]
        best[:] = np.inf
        winner[:] = 0
        for a in range(count):
            cost = h[edge, a] + squares[i, a]
            ax = factor * planes[i, 0, a]
            ay = factor * planes[i, 1, a]
            az = factor * planes[i, 2, a]
            for b in range(count):
                value = cost + ax * x[b] + ay * y[b] + az * z[b]
                better = value < best[b]
                best[b] = value if better else best[b]
                winner[b] = a if better else winner[b]
        for b in range(count):
            messages[edge, b] = best[b] + squares[j, b]
            argmin[edge, b] = winner[b]


@_jit
def _scatter(grad, argmin, out, first, last):
    for edge in range(first, last):
        for b in range(grad.shape[1]):
            out[edge, argmin[edge, b]] += grad[edge, b]


def send_messages(
    h: Tensor, displacement: Tensor, tail: Tensor, head: Tensor, smoothness: float
) -> tuple[Tensor, Tensor]:
    """Messages (E, K) and their winners (E, K, int16); see ``belief_propagation.send_messages``."""
    h = h.detach().contiguous()
    displacement = displacement.detach()
    squares = displacement.square().sum(-1).mul_(smoothness)
    planes = displacement.transpose(1, 2).contiguous()
    messages = torch.empty_like(h)
    argmin = torch.empty(h.shape, dtype=torch.int16)
    values = h.numpy()
    _run(
        _send,
        len(h),
        values,
        planes.numpy(),
        squares.numpy(),
        tail.numpy(),
        head.numpy(),
        values.dtype.type(-2 * smoothness),
        messages.numpy(),
        argmin.numpy(),
    )
    return messages, argmin


def scatter_rows(grad: Tensor, argmin: Tensor) -> Tensor:
    """Add (E, K) gradients up at the winners, row by row: out[e, argmin[e, b]] += grad[e, b]."""
    out = torch.zeros_like(grad)
    _run(_scatter, len(grad), grad.contiguous().numpy(), argmin.numpy(), out.numpy())
    return out


# --- normalisation --------------------------------------------------------------------------------


@_jit
def _sums(x, valid, shift, total, square, first, last):
    """Per block of rows and channel: sums of x − shift and its square over valid rows."""
    channels = x.shape[1]
    for block in range(first, last):
        s = np.zeros(channels, x.dtype)
        q = np.zeros(channels, x.dtype)
        for row in range(block * _ROWS, min((block + 1) * _ROWS, x.shape[0])):
            if valid[row]:
                for c in range(channels):
                    value = x[row, c] - shift[c]
                    s[c] += value
                    q[c] += value * value
        total[block] = s
        square[block] = q


@_jit
def _apply(x, mean, scale, slope, y, first, last):
    for block in range(first, last):
        for row in range(block * _ROWS, min((block + 1) * _ROWS, x.shape[0])):
            for c in range(x.shape[1]):
                value = (x[row, c] - mean[c]) * scale[c]
                y[row, c] = value if value >= 0 else value * slope


@_jit
def _gradient_sums(grad, y, valid, slope, total, product, first, last):
    """Per block: sums of g' and g'·x̂, where g' is the gradient before the activation."""
    channels = y.shape[1]
    inverse = 1 / slope
    for block in range(first, last):
        s = np.zeros(channels, y.dtype)
        p = np.zeros(channels, y.dtype)
        for row in range(block * _ROWS, min((block + 1) * _ROWS, y.shape[0])):
            if valid[row]:
                for c in range(channels):
                    negative = y[row, c] < 0
                    g = grad[row, c] * slope if negative else grad[row, c]
                    s[c] += g
                    p[c] += g * (y[row, c] * inverse if negative else y[row, c])
        total[block] = s
        product[block] = p


@_jit
def _gradient(grad, y, valid, slope, scale, mean_grad, mean_product, out, first, last):
    inverse = 1 / slope
    for block in range(first, last):
        for row in range(block * _ROWS, min((block + 1) * _ROWS, y.shape[0])):
            if valid[row]:
                for c in range(y.shape[1]):
                    negative = y[row, c] < 0
                    g = grad[row, c] * slope if negative else grad[row, c]
                    normalised = y[row, c] * inverse if negative else y[row, c]
                    out[row, c] = scale[c] * (g - mean_grad[c] - normalised * mean_product[c])
            else:
                out[row] = 0


@_jit
def _group_max(x, valid, highest, argmax, first, last):
    """Maximum over the valid rows of each group: x is (groups, k, C)."""
    for group in range(first, last):
        highest[group] = -np.inf
        argmax[group] = 0
        for k in range(x.shape[1]):
            if valid[group, k]:
                for c in range(x.shape[2]):
                    better = x[group, k, c] > highest[group, c]
                    highest[group, c] = x[group, k, c] if better else highest[group, c]
                    argmax[group, c] = k if better else argmax[group, c]


@_jit
def _group_gradient(x, valid, argmax, grad, mean, scale, mean_grad, mean_product, out, first, last):
    for group in range(first, last):
        for k in range(x.shape[1]):
            if valid[group, k]:
                for c in range(x.shape[2]):
                    normalised = (x[group, k, c] - mean[c]) * scale[c]
                    g = grad[group, c] if argmax[group, c] == k else 0
                    out[group, k, c] = scale[c] * (g - mean_grad[c] - normalised * mean_product[c])
            else:
                out[group, k] = 0


def _blocks(rows: int) -> int:
    return -(-rows // _ROWS)


def _statistics(x: np.ndarray, valid: np.ndarray, eps: float) -> tuple[np.ndarray, ...]:
    """Mean, 1/√(biased variance + eps) and count of the valid rows of (L, C)."""
    blocks = _blocks(len(x))
    # Any value near the mean avoids the cancellation of E[x²] − E[x]².
    shift = np.ascontiguousarray(x[int(valid.argmax())])
    total = np.empty((blocks, x.shape[1]), x.dtype)
    square = np.empty_like(total)
    _run(_sums, blocks, x, valid, shift, total, square)
    count = int(valid.sum())
    offset = total.sum(axis=0, dtype=np.float64) / count
    variance = np.maximum(square.sum(axis=0, dtype=np.float64) / count - offset**2, 0)
    mean = (shift + offset).astype(x.dtype)
    return mean, (1 / np.sqrt(variance + eps)).astype(x.dtype), count


def _rows_valid(mask: Tensor | None, batch: int, rows: int) -> np.ndarray:
    if mask is None:
        return np.ones((batch, rows), np.bool_)
    return mask.contiguous().numpy()


class NormLeakyReLU(torch.autograd.Function):
    """LeakyReLU(instance norm) of (B, L, C) over L; slope 1 is the norm alone.

    Only the output is kept for the backward pass: the slope is positive, so the normalised value
    can be recovered from it.
    """

    @staticmethod
    def forward(ctx, x: Tensor, slope: float, mask: Tensor | None, eps: float) -> Tensor:
        x = x.detach().contiguous()
        y = torch.empty_like(x)
        valid = _rows_valid(mask, *x.shape[:2])
        scales = []
        for values, ok, out in zip(x.numpy(), valid, y.numpy(), strict=True):
            mean, scale, _ = _statistics(values, ok, eps)
            _run(_apply, _blocks(len(values)), values, mean, scale, values.dtype.type(slope), out)
            scales.append(scale)
        ctx.save_for_backward(y)
        ctx.slope, ctx.valid, ctx.scales = slope, valid, scales
        return y

    @staticmethod
    def backward(ctx, grad: Tensor):
        (y,) = ctx.saved_tensors
        out = torch.empty_like(y)
        rows = zip(
            grad.contiguous().numpy(), y.numpy(), ctx.valid, ctx.scales, out.numpy(), strict=True
        )
        for g, values, valid, scale, target in rows:
            blocks = _blocks(len(values))
            slope = values.dtype.type(ctx.slope)
            total = np.empty((blocks, values.shape[1]), values.dtype)
            product = np.empty_like(total)
            _run(_gradient_sums, blocks, g, values, valid, slope, total, product)
            count = int(valid.sum())
            mean_grad = (total.sum(axis=0, dtype=np.float64) / count).astype(values.dtype)
            mean_product = (product.sum(axis=0, dtype=np.float64) / count).astype(values.dtype)
            _run(_gradient, blocks, g, values, valid, slope, scale, mean_grad, mean_product, target)
        return out, None, None, None


class NormMax(torch.autograd.Function):
    """Instance norm of (B, G, k, C) over all G·k rows, then the maximum over k: (B, G, C).

    The norm keeps the order of values, so only the maxima are ever normalised.
    """

    @staticmethod
    def forward(ctx, x: Tensor, mask: Tensor | None, eps: float) -> Tensor:
        x = x.detach().contiguous()
        batch, groups, k, channels = x.shape
        y = torch.empty(batch, groups, channels, dtype=x.dtype)
        argmax = torch.empty(batch, groups, channels, dtype=torch.int32)
        valid = _rows_valid(mask, batch, groups * k).reshape(batch, groups, k)
        statistics = []
        rows = zip(x.numpy(), valid, y.numpy(), argmax.numpy(), strict=True)
        for values, ok, highest, winner in rows:
            mean, scale, count = _statistics(values.reshape(-1, channels), ok.reshape(-1), eps)
            _run(_group_max, groups, values, ok, highest, winner)
            np.subtract(highest, mean, out=highest)
            np.multiply(highest, scale, out=highest)
            highest[~ok.any(axis=1)] = 0
            statistics.append((mean, scale, count))
        ctx.save_for_backward(x, y, argmax)
        ctx.valid, ctx.statistics = valid, statistics
        return y

    @staticmethod
    def backward(ctx, grad: Tensor):
        x, y, argmax = ctx.saved_tensors
        out = torch.empty_like(x)
        rows = zip(
            x.numpy(),
            y.numpy(),
            argmax.numpy(),
            ctx.valid,
            ctx.statistics,
            grad.contiguous().numpy(),
            out.numpy(),
            strict=True,
        )
        for values, highest, winner, ok, (mean, scale, count), g, target in rows:
            g = g * ok.any(axis=1, keepdims=True)
            mean_grad = (g.sum(axis=0, dtype=np.float64) / count).astype(values.dtype)
            product = np.einsum("gc,gc->c", g, highest, dtype=np.float64)
            mean_product = (product / count).astype(values.dtype)
            _run(
                _group_gradient,
                len(values),
                values,
                ok,
                winner,
                g,
                mean,
                scale,
                mean_grad,
                mean_product,
                target,
            )
        return out, None, None
