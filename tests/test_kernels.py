"""Compiled kernels and eager forms against each other and against plain loops."""

import numpy as np
import pytest
import torch

from dine.geometry.graph import neighbour_graph
from dine.models import belief_propagation as bp
from dine.models import features, kernels

EPS = features.NORM_EPS


def problem(points=12, count=7, seed=0, dtype=torch.float64):
    rng = np.random.default_rng(seed)
    graph = neighbour_graph(rng.normal(size=(points, 3)), 4)
    displacement = torch.from_numpy(rng.normal(size=(points, count, 3))).to(dtype)
    h = torch.from_numpy(rng.random((len(graph.tail), count))).to(dtype)
    return h, displacement, graph


def naive_messages(h, displacement, graph, smoothness):
    out = np.empty(h.shape)
    winner = np.empty(h.shape, int)
    for e, (i, j) in enumerate(zip(graph.tail.tolist(), graph.head.tolist(), strict=True)):
        for b in range(h.shape[1]):
            costs = [
                h[e, a] + smoothness * np.sum((displacement[i, a] - displacement[j, b]) ** 2)
                for a in range(h.shape[1])
            ]
            winner[e, b] = int(np.argmin(costs))
            out[e, b] = costs[winner[e, b]]
    return out, winner


@pytest.mark.parametrize("send", [bp.send_messages, bp.send_messages_eager])
def test_messages_follow_their_definition(send):
    h, displacement, graph = problem()
    messages, argmin = send(h, displacement, graph, 10.0, True)
    expected, winner = naive_messages(h.numpy(), displacement.numpy(), graph, 10.0)
    assert np.abs(messages.numpy() - expected).max() < 1e-12
    assert (argmin.numpy() == winner).all()


def test_compiled_and_eager_messages_agree_in_float32():
    h, displacement, graph = problem(points=60, count=40, dtype=torch.float32)
    compiled, _ = bp.send_messages(h, displacement, graph, 10.0, True)
    eager, _ = bp.send_messages_eager(h, displacement, graph, 10.0, False)
    assert (compiled - eager).abs().max() < 1e-4


def naive_propagation(cost, displacement, graph, updates, smoothness=10.0):
    edges = list(zip(graph.tail.tolist(), graph.head.tolist(), strict=True))
    m = {edge: np.zeros(cost.shape[1]) for edge in edges}
    for _ in range(updates):
        new = {}
        for i, j in edges:
            h = cost[i] + sum(m[k, t] for k, t in edges if t == i) - m[j, i]
            table = h[:, None] + smoothness * np.sum(
                (displacement[i][:, None] - displacement[j][None]) ** 2, axis=2
            )
            new[i, j] = table.min(axis=0)
        m = new
    return np.stack([cost[i] + sum(m[k, t] for k, t in edges if t == i) for i in range(len(cost))])


def test_propagation_follows_its_definition():
    _, displacement, graph = problem()
    cost = torch.rand(12, 7, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    candidates = bp.Candidates(torch.zeros(1, 12, 7), displacement[None], cost[None])
    found = bp.propagate(candidates, graph)[0].numpy()
    expected = naive_propagation(cost.numpy(), displacement.numpy(), graph, updates=2)
    assert np.abs(found - expected).max() < 1e-11


def test_propagation_gradient():
    _, displacement, graph = problem(points=6, count=4)
    cost = torch.rand(1, 6, 4, dtype=torch.float64, generator=torch.Generator().manual_seed(2))

    def run(cost):
        candidates = bp.Candidates(torch.zeros(1, 6, 4), displacement[None], cost)
        return bp.read_out(candidates, bp.propagate(candidates, graph), temperature=2.0)

    assert torch.autograd.gradcheck(run, (cost.requires_grad_(),))


def test_read_out_stays_inside_the_hull_of_the_candidates():
    displacement = torch.rand(1, 5, 8, 3, generator=torch.Generator().manual_seed(3))
    belief = torch.rand(1, 5, 8, generator=torch.Generator().manual_seed(4))
    out = bp.read_out(bp.Candidates(None, displacement, None), belief)
    assert (out <= displacement.amax(2) + 1e-6).all()
    assert (out >= displacement.amin(2) - 1e-6).all()


@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("slope", [0.01, 1.0])
def test_norm_and_its_gradient(masked, slope):
    generator = torch.Generator().manual_seed(5)
    # More rows than one block of the kernel, in two members.
    x = 3 + torch.randn(2, 300, 5, dtype=torch.float64, generator=generator)
    mask = torch.ones(2, 300, dtype=torch.bool)
    mask[1, 250:] = False
    weight = torch.randn(2, 300, 5, dtype=torch.float64, generator=generator)
    weight = weight * mask.unsqueeze(-1)
    used = mask if masked else None
    if not masked:
        mask = torch.ones_like(mask)
    results = []
    for function in (
        lambda x: kernels.NormLeakyReLU.apply(x, slope, used, EPS),
        lambda x: features.instance_norm_eager(x, used, slope),
    ):
        leaf = x.clone().requires_grad_()
        y = function(leaf) * mask.unsqueeze(-1)
        (y * weight).sum().backward()
        results.append((y.detach(), leaf.grad * mask.unsqueeze(-1)))
    for compiled, eager in zip(*results, strict=True):
        assert (compiled - eager).abs().max() < 1e-10


@pytest.mark.parametrize("masked", [False, True])
def test_normalised_maximum_and_its_gradient(masked):
    generator = torch.Generator().manual_seed(6)
    x = 2 * torch.randn(2, 9, 4, 5, dtype=torch.float64, generator=generator) - 1
    mask = torch.ones(2, 36, dtype=torch.bool)
    if masked:
        mask[1, 21:] = False  # a group with some rows, and groups with none
    weight = torch.randn(2, 9, 5, dtype=torch.float64, generator=generator)
    used = mask if masked else None
    results = []
    for function in (features.normalised_maximum, features.normalised_maximum_eager):
        leaf = x.clone().requires_grad_()
        y = function(leaf, used)
        (y * weight).sum().backward()
        results.append((y.detach(), leaf.grad))
    for compiled, eager in zip(*results, strict=True):
        assert (compiled - eager).abs().max() < 1e-10


def test_norm_statistics_survive_a_large_offset_in_float32():
    x = 1000 + torch.randn(1, 5000, 3, generator=torch.Generator().manual_seed(7))
    y = kernels.NormLeakyReLU.apply(x, 1.0, None, EPS)
    exact = features.instance_norm_eager(x.double())
    assert (y - exact).abs().max() < 1e-3


def test_results_do_not_depend_on_the_number_of_threads():
    h, displacement, graph = problem(points=80, count=20, dtype=torch.float32)
    x = torch.randn(2, 3000, 8, generator=torch.Generator().manual_seed(8))
    threads = torch.get_num_threads()
    try:
        found = []
        for count in (1, 3):
            torch.set_num_threads(count)
            found.append(
                (
                    kernels.send_messages(h, displacement, graph.tail, graph.head, 10.0)[0],
                    kernels.NormLeakyReLU.apply(x, 0.01, None, EPS),
                )
            )
    finally:
        torch.set_num_threads(threads)
    for one, three in zip(*found, strict=True):
        assert torch.equal(one, three)
