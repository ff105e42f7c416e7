"""Belief propagation: one edge costs K² candidate pairs of three multiply-adds and a minimum.

The inner loop runs over the receiver's candidates, so it vectorises, for four of the sender's at a
time, so that the receiver's coordinates are loaded once for the four. The winners cost as much
again and are kept only where a gradient follows.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from dine.geometry.graph import Graph
from dine.geometry.kernels import jit
from dine.threads import run

_STEP = 4


@jit
def _minimum(cost, planes, factor, other, best):
    """best[b] = min_a cost[a] + factor·planes[:, a]·other[:, b]."""
    x, y, z = other[0], other[1], other[2]
    best[:] = np.inf
    for a in range(0, len(cost), _STEP):
        c0, c1, c2, c3 = cost[a], cost[a + 1], cost[a + 2], cost[a + 3]
        x0, x1 = factor * planes[0, a], factor * planes[0, a + 1]
        x2, x3 = factor * planes[0, a + 2], factor * planes[0, a + 3]
        y0, y1 = factor * planes[1, a], factor * planes[1, a + 1]
        y2, y3 = factor * planes[1, a + 2], factor * planes[1, a + 3]
        z0, z1 = factor * planes[2, a], factor * planes[2, a + 1]
        z2, z3 = factor * planes[2, a + 2], factor * planes[2, a + 3]
        for b in range(len(best)):
            v0 = c0 + x0 * x[b] + y0 * y[b] + z0 * z[b]
            v1 = c1 + x1 * x[b] + y1 * y[b] + z1 * z[b]
            v2 = c2 + x2 * x[b] + y2 * y[b] + z2 * z[b]
            v3 = c3 + x3 * x[b] + y3 * y[b] + z3 * z[b]
            v0 = v0 if v0 < v1 else v1
            v2 = v2 if v2 < v3 else v3
            v0 = v0 if v0 < v2 else v2
            best[b] = v0 if v0 < best[b] else best[b]


@jit
def _minimum_and_winner(cost, planes, factor, other, best, winner):
    x, y, z = other[0], other[1], other[2]
    best[:] = np.inf
    winner[:] = 0
    for a in range(0, len(cost), _STEP):
        c0, c1, c2, c3 = cost[a], cost[a + 1], cost[a + 2], cost[a + 3]
        x0, x1 = factor * planes[0, a], factor * planes[0, a + 1]
        x2, x3 = factor * planes[0, a + 2], factor * planes[0, a + 3]
        y0, y1 = factor * planes[1, a], factor * planes[1, a + 1]
        y2, y3 = factor * planes[1, a + 2], factor * planes[1, a + 3]
        z0, z1 = factor * planes[2, a], factor * planes[2, a + 1]
        z2, z3 = factor * planes[2, a + 2], factor * planes[2, a + 3]
        a0 = np.int32(a)
        for b in range(len(best)):
            v0 = c0 + x0 * x[b] + y0 * y[b] + z0 * z[b]
            v1 = c1 + x1 * x[b] + y1 * y[b] + z1 * z[b]
            v2 = c2 + x2 * x[b] + y2 * y[b] + z2 * z[b]
            v3 = c3 + x3 * x[b] + y3 * y[b] + z3 * z[b]
            low, who = best[b], winner[b]
            who = a0 if v0 < low else who
            low = v0 if v0 < low else low
            who = np.int32(a0 + 1) if v1 < low else who
            low = v1 if v1 < low else low
            who = np.int32(a0 + 2) if v2 < low else who
            low = v2 if v2 < low else low
            who = np.int32(a0 + 3) if v3 < low else who
            low = v3 if v3 < low else low
            best[b] = low
            winner[b] = who


@jit
def _update(
    unary,
    belief,
    previous,
    reverse,
    planes,
    squares,
    factor,
    tail,
    start,
    messages,
    winners,
    out,
    first,
    last,
):
    """One update at the heads first…last; ``previous``, ``messages``, ``winners`` may be empty."""
    count = belief.shape[1]
    cost = np.full(planes.shape[2], np.inf, belief.dtype)
    best = np.empty(count, belief.dtype)
    winner = np.empty(count, np.int32)
    for j in range(first, last):
        out[j] = unary[j]
        for edge in range(start[j], start[j + 1]):
            i = tail[edge]
            for a in range(count):
                cost[a] = belief[i, a] + squares[i, a]
            if len(previous):
                back = reverse[edge]
                for a in range(count):
                    cost[a] -= previous[back, a]
            if len(winners):
                _minimum_and_winner(cost, planes[i], factor, planes[j], best, winner)
                for b in range(count):
                    winners[edge, b] = winner[b]
            else:
                _minimum(cost, planes[i], factor, planes[j], best)
            for b in range(count):
                best[b] += squares[j, b]
                out[j, b] += best[b]
            if len(messages):
                messages[edge] = best


@jit
def _update_gradient(grad, later, winners, reverse, tail, start, sent, total, first, last):
    """Gradient of one update to the beliefs before it, at the tails first…last.

    ``later`` (E, K) is the gradient of the next update's edge costs, which had these messages
    subtracted; it may be empty, as may ``sent``, which takes this update's.
    """
    count = grad.shape[1]
    row = np.empty(count, grad.dtype)
    for i in range(first, last):
        for back in range(start[i], start[i + 1]):
            edge, j = reverse[back], tail[back]
            row[:] = 0
            if len(later):
                for b in range(count):
                    row[winners[edge, b]] += grad[j, b] - later[back, b]
            else:
                for b in range(count):
                    row[winners[edge, b]] += grad[j, b]
            for a in range(count):
                total[i, a] += row[a]
            if len(sent):
                sent[edge] = row


class BeliefPropagation(torch.autograd.Function):
    """Beliefs (V, K) after some updates; see ``belief_propagation.propagate``.

    Args of ``apply``: unary costs (V, K), displacement (V, K, 3), graph, smoothness, updates.
    """

    @staticmethod
    def forward(
        ctx, cost: Tensor, displacement: Tensor, graph: Graph, smoothness: float, updates: int
    ) -> Tensor:
        cost = cost.detach().contiguous()
        count, edges = cost.shape[1], len(graph.tail)
        keep = ctx.needs_input_grad[0]
        # A multiple of the unrolled step; what is added costs infinity, so it never wins.
        planes = cost.new_zeros(len(cost), 3, -(-count // _STEP) * _STEP)
        planes[:, :, :count] = displacement.detach().transpose(1, 2)
        squares = displacement.detach().square().sum(-1).mul_(smoothness)
        kind = torch.uint8 if count <= 256 else torch.int32
        empty = cost.new_empty(0, count)
        belief, previous, winners = cost, empty, []
        for update in range(updates):
            messages = empty if update + 1 == updates else cost.new_empty(edges, count)
            winners.append(torch.empty(edges if keep else 0, count, dtype=kind))
            out = torch.empty_like(cost)
            run(
                _update,
                0,
                len(cost),
                cost.numpy(),
                belief.numpy(),
                previous.numpy(),
                graph.reverse.numpy(),
                planes.numpy(),
                squares.numpy(),
                cost.numpy().dtype.type(-2 * smoothness),
                graph.tail.numpy(),
                graph.start.numpy(),
                messages.numpy(),
                winners[-1].numpy(),
                out.numpy(),
            )
            belief, previous = out, messages
        if keep:
            ctx.graph = graph
            ctx.save_for_backward(*winners)
        return belief if updates else cost.clone()

    @staticmethod
    def backward(ctx, grad: Tensor):
        graph = ctx.graph
        grad = grad.contiguous()
        total, later = grad.clone(), grad.new_empty(0, grad.shape[1])
        for left, winners in reversed(list(enumerate(ctx.saved_tensors))):
            before = torch.zeros_like(grad)
            sent = grad.new_empty(len(winners) if left else 0, grad.shape[1])
            run(
                _update_gradient,
                0,
                len(grad),
                grad.numpy(),
                later.numpy(),
                winners.numpy(),
                graph.reverse.numpy(),
                graph.tail.numpy(),
                graph.start.numpy(),
                sent.numpy(),
                before.numpy(),
            )
            total += before
            grad, later = before, sent
        return total, None, None, None, None
