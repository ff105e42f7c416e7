"""Sparse loopy belief propagation (sLBP): from feature similarity to a displacement field.

Every source point chooses among its K candidate displacements; min-sum messages on the source's
neighbour graph make neighbours agree. One update sends, along each directed edge i → j,

    m_{i→j}(b) = min_a [ h_{ij}(a) + s·‖c_i(a) − c_j(b)‖² ],
    h_{ij}(a)  = u_i(a) + Σ_{k→i} m_{k→i}(a) − m_{j→i}(a),

with candidate displacements c, unary costs u and smoothness s. The minimisation over K×K candidate
pairs per edge is the hot path of the whole system; see :func:`send_messages`.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from dine.geometry.chamfer import gather_points, squared_distances
from dine.geometry.graph import Graph
from dine.models import kernels

INVALID_COST = 1e6
"""Unary cost of a padded candidate: large enough never to win, small enough to stay finite."""


@dataclass(frozen=True)
class Candidates:
    """Candidate target points of every source point.

    Attributes:
        index: (B, N, K) rows of the target.
        displacement: (B, N, K, 3) target point minus source point, without gradient.
        cost: (B, N, K) unary cost: mean over channels of the squared feature difference.
    """

    index: Tensor
    displacement: Tensor
    cost: Tensor


def select_candidates(
    source: Tensor,
    target: Tensor,
    source_features: Tensor,
    target_features: Tensor,
    count: int,
    target_mask: Tensor | None = None,
) -> Candidates:
    """The ``count`` target points nearest in feature space, for each source point.

    Targets with fewer points than ``count`` use all of theirs; the surplus costs INVALID_COST.
    """
    distances = squared_distances(source_features, target_features)
    with torch.no_grad():
        ranked = distances.detach()
        if target_mask is not None:
            ranked = ranked.masked_fill(~target_mask.unsqueeze(1), torch.inf)
        count = min(count, target.shape[1])
        index = ranked.topk(count, dim=2, largest=False, sorted=False).indices
        chosen = gather_points(target, index.flatten(1)).view(*index.shape, 3)
        displacement = chosen - source.unsqueeze(2)
    cost = distances.gather(2, index) / source_features.shape[-1]
    if target_mask is not None:
        valid = target_mask.unsqueeze(1).expand(-1, source.shape[1], -1).gather(2, index)
        cost = cost.masked_fill(~valid, INVALID_COST)
        # Candidates beyond a small target repeat a valid displacement, so that sums stay tame.
        displacement = displacement.masked_fill(~valid.unsqueeze(-1), 0)
    return Candidates(index, displacement, cost)


class _MinSum(torch.autograd.Function):
    """m_e(b) = min_a [ h_e(a) + s‖c_tail(a) − c_head(b)‖² ] for every edge e."""

    @staticmethod
    def forward(ctx, h: Tensor, displacement: Tensor, graph: Graph, smoothness: float) -> Tensor:
        needs_gradient = ctx.needs_input_grad[0]
        messages, argmin = send_messages(h, displacement, graph, smoothness, needs_gradient)
        if needs_gradient:
            ctx.save_for_backward(argmin)
        return messages

    @staticmethod
    def backward(ctx, grad: Tensor):
        (argmin,) = ctx.saved_tensors
        if kernels.supported(grad):
            return kernels.scatter_rows(grad, argmin), None, None, None
        scattered = torch.zeros_like(grad).scatter_add_(1, argmin.to(torch.int64), grad)
        return scattered, None, None, None


def send_messages(
    h: Tensor, displacement: Tensor, graph: Graph, smoothness: float, with_argmin: bool
) -> tuple[Tensor, Tensor | None]:
    """One message update, without gradient.

    Args:
        h: (E, K) cost of the tail's candidates, per edge.
        displacement: (V, K, 3) candidate displacements of every node.
        graph: directed edges over the V nodes.
        smoothness: weight s of the squared difference.
        with_argmin: also return which candidate won.

    Returns:
        (E, K) messages to the head's candidates, and the (E, K) winners, which may be None where
        they were not asked for.
    """
    if kernels.supported(h) and h.shape[1] <= kernels.MAX_CANDIDATES:
        return kernels.send_messages(h, displacement, graph.tail, graph.head, smoothness)
    return send_messages_eager(h, displacement, graph, smoothness, with_argmin)


def send_messages_eager(
    h: Tensor, displacement: Tensor, graph: Graph, smoothness: float, with_argmin: bool
) -> tuple[Tensor, Tensor | None]:
    """:func:`send_messages` in plain PyTorch, on any device.

    ‖c − c'‖² = ‖c‖² − 2c·c' + ‖c'‖² makes the update a batched rank-3 product followed by a
    minimum; chunks of edges keep the K×K matrices in cache.
    """
    edges, count = h.shape
    squares = displacement.square().sum(-1) * smoothness
    messages = torch.empty_like(h)
    argmin = torch.empty(h.shape, dtype=torch.int16, device=h.device) if with_argmin else None
    chunk = 64 if h.device.type == "cpu" else max(1, 2**28 // (count * count))
    for start in range(0, edges, chunk):
        part = slice(start, start + chunk)
        tail, head = graph.tail[part], graph.head[part]
        cost = (h[part] + squares[tail]).unsqueeze(1)
        table = torch.baddbmm(
            cost, displacement[head], displacement[tail].transpose(1, 2), alpha=-2 * smoothness
        )
        if with_argmin:
            messages[part], best = table.min(dim=2)
            argmin[part] = best.to(torch.int16)
        else:
            messages[part] = table.amin(dim=2)
    return messages.add_(squares[graph.head]), argmin


def propagate(
    candidates: Candidates, graph: Graph, *, smoothness: float = 10.0, updates: int = 2
) -> Tensor:
    """Beliefs (B, N, K): unary costs plus all incoming messages after ``updates`` updates.

    The published loop makes three updates but reads the sum before the last, so two matter.
    """
    shape = candidates.cost.shape
    cost = candidates.cost.flatten(0, 1)
    displacement = candidates.displacement.flatten(0, 1).contiguous()
    belief = cost
    messages = None
    for _ in range(updates):
        h = belief[graph.tail]
        if messages is not None:
            h = h - messages[graph.reverse]
        messages = _MinSum.apply(h, displacement, graph, smoothness)
        belief = cost.index_add(0, graph.head, messages)
    return belief.view(shape)


def read_out(candidates: Candidates, belief: Tensor, temperature: float = 50.0) -> Tensor:
    """Expected displacement under softmax(−temperature·belief): (B, N, 3).

    A convex combination of candidates, so the moved point stays inside the target's hull.
    """
    weights = torch.softmax(-temperature * belief, dim=-1)
    return torch.einsum("bnk,bnkd->bnd", weights, candidates.displacement)
