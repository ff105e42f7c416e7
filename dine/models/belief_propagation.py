"""Sparse loopy belief propagation (sLBP): from feature similarity to a displacement field.

Every source point chooses among its K candidate displacements; min-sum messages on the source's
neighbour graph make neighbours agree. One update sends, along each directed edge i → j,

    m_{i→j}(b) = min_a [ h_{ij}(a) + s·‖c_i(a) − c_j(b)‖² ],
    h_{ij}(a)  = u_i(a) + Σ_{k→i} m_{k→i}(a) − m_{j→i}(a),

with candidate displacements c, unary costs u and smoothness s. The minimisation over K×K candidate
pairs per edge is the hot path of the whole system; on the CPU it is compiled.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from dine.geometry.graph import Graph
from dine.geometry.neighbours import gather_points, squared_distances
from dine.models import compiled

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
    count = min(count, target.shape[1])
    clouds = (source, target, source_features, target_features)
    if compiled.supported(*clouds):
        from dine.models.compiled.selection import CandidateCost, nearest_candidates

        index, displacement, cost = nearest_candidates(*clouds, count, target_mask)
        cost = CandidateCost.apply(source_features, target_features, index, cost)
    else:
        index, displacement, cost = select_candidates_eager(*clouds, count, target_mask)
    if target_mask is not None:
        valid = cost.detach().isfinite()
        cost = cost.masked_fill(~valid, INVALID_COST)
        # Candidates beyond a small target repeat a valid displacement, so that sums stay tame.
        displacement = displacement.masked_fill(~valid.unsqueeze(-1), 0)
    return Candidates(index, displacement, cost)


def select_candidates_eager(
    source: Tensor,
    target: Tensor,
    source_features: Tensor,
    target_features: Tensor,
    count: int,
    target_mask: Tensor | None,
) -> tuple[Tensor, Tensor, Tensor]:
    """Index, displacement and cost (infinite at invalid targets) in plain PyTorch."""
    distances = squared_distances(source_features, target_features)
    if target_mask is not None:
        distances = distances.masked_fill(~target_mask.unsqueeze(1), torch.inf)
    index = distances.detach().topk(count, dim=2, largest=False, sorted=False).indices
    chosen = gather_points(target, index.flatten(1)).view(*index.shape, 3)
    cost = distances.gather(2, index) / source_features.shape[-1]
    return index, (chosen - source.unsqueeze(2)).detach(), cost


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
        scattered = torch.zeros_like(grad).scatter_add_(1, argmin.to(torch.int64), grad)
        return scattered, None, None, None


def send_messages(
    h: Tensor, displacement: Tensor, graph: Graph, smoothness: float, with_argmin: bool
) -> tuple[Tensor, Tensor | None]:
    """One message update in plain PyTorch, without gradient.

    ‖c − c'‖² = ‖c‖² − 2c·c' + ‖c'‖² makes the update a batched rank-3 product followed by a
    minimum; chunks of edges bound the memory of the K×K matrices.

    Args:
        h: (E, K) cost of the tail's candidates, per edge.
        displacement: (V, K, 3) candidate displacements of every node.
        graph: directed edges over the V nodes.
        smoothness: weight s of the squared difference.
        with_argmin: also return which candidate won.

    Returns:
        (E, K) messages to the head's candidates, and the (E, K) winners, or None.
    """
    edges, count = h.shape
    squares = displacement.square().sum(-1) * smoothness
    messages = torch.empty_like(h)
    argmin = torch.empty(h.shape, dtype=torch.int32, device=h.device) if with_argmin else None
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
            argmin[part] = best.to(torch.int32)
        else:
            messages[part] = table.amin(dim=2)
    return messages.add_(squares[graph.head]), argmin


def propagate(
    candidates: Candidates, graph: Graph, *, smoothness: float = 10.0, updates: int = 2
) -> Tensor:
    """Beliefs (B, N, K): unary costs plus all incoming messages after ``updates`` updates.

    The published loop makes three updates but reads the sum before the last, so two matter.
    """
    cost = candidates.cost.flatten(0, 1)
    displacement = candidates.displacement.flatten(0, 1).contiguous()
    propagated = propagate_eager
    if compiled.supported(cost):
        from dine.models.compiled.messages import BeliefPropagation

        propagated = BeliefPropagation.apply
    belief = propagated(cost, displacement, graph, smoothness, updates)
    return belief.view(candidates.cost.shape)


def propagate_eager(
    cost: Tensor, displacement: Tensor, graph: Graph, smoothness: float, updates: int
) -> Tensor:
    """:func:`propagate` in plain PyTorch, on any device; nodes counted over the batch, (V, K)."""
    belief = cost
    messages = None
    for _ in range(updates):
        h = belief[graph.tail]
        if messages is not None:
            h = h - messages[graph.reverse]
        messages = _MinSum.apply(h, displacement, graph, smoothness)
        belief = cost.index_add(0, graph.head, messages)
    return belief


def read_out(candidates: Candidates, belief: Tensor, temperature: float = 50.0) -> Tensor:
    """Expected displacement under softmax(−temperature·belief): (B, N, 3).

    A convex combination of candidates, so the moved point stays inside the target's hull.
    """
    weights = torch.softmax(-temperature * belief, dim=-1)
    return torch.einsum("bnk,bnkd->bnd", weights, candidates.displacement)


def marginal_variance(
    candidates: Candidates, belief: Tensor, displacement: Tensor, temperature: float = 50.0
) -> Tensor:
    """Expected squared distance from the read-out to the candidates under the marginals: (B, N).

    In squared units of the candidates, summed over coordinates: 0 where one candidate has all the
    weight. It says how sure the network is, not how right; that takes a calibration.
    """
    weights = torch.softmax(-temperature * belief, dim=-1)
    squares = (candidates.displacement - displacement.unsqueeze(2)).square().sum(-1)
    return (weights * squares).sum(-1)
