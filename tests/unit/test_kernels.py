"""Compiled kernels and eager forms against each other and against the plain formulas."""

import numpy as np
import pytest
import reference
import torch

from dine.data.batch import make_batch
from dine.geometry.chamfer import chamfer_distance
from dine.geometry.graph import neighbour_graph
from dine.geometry.neighbours import Neighbours, nearest_neighbours, squared_distances
from dine.models import belief_propagation as bp
from dine.models import compiled, features
from dine.models.backbones import BACKBONES
from dine.models.compiled.convolution import EdgeConvolution, Edges
from dine.models.compiled.messages import BeliefPropagation
from dine.models.compiled.rows import NormLeakyReLU

pytestmark = pytest.mark.numerical
EPS = features.NORM_EPS
BOTH = pytest.mark.parametrize("path", ["compiled", "eager"])


def generator(seed):
    return torch.Generator().manual_seed(seed)


def eager_only(monkeypatch, path):
    """Switch the kernels off, as on a GPU."""
    if path == "eager":
        monkeypatch.setattr(compiled, "supported", lambda *tensors: False)


def cloud(points, seed):
    return torch.rand(points, 3, dtype=torch.float64, generator=generator(seed)) * 2 - 1


# --- whole backbones ------------------------------------------------------------------------------


@BOTH
@pytest.mark.parametrize("name", ["robust_defreg", "deftransnet"])
def test_backbones_follow_their_formulas(name, path, monkeypatch):
    eager_only(monkeypatch, path)
    torch.manual_seed(0)
    # PyTorch's own start leaves no parameter at zero.
    backbone = BACKBONES.get(name)(candidates=24, initialisation="default").double()
    source, target = cloud(90, 1), cloud(70, 2)
    batch = make_batch([source.numpy()], [target.numpy()], dtype=torch.float64)
    found = backbone(batch).displacement
    chamfer_distance(source + found, batch.target).sum().backward()
    state = {key: value.detach().clone() for key, value in backbone.state_dict().items()}
    for value in state.values():
        value.requires_grad_()
    expected = reference.register(state, source, target, count=24)
    reference.chamfer_distance(source + expected, target).backward()
    assert (found[0] - expected).abs().max() < 1e-9
    gradients = {key: value.grad for key, value in backbone.named_parameters()}
    largest = max(value.grad.abs().max() for value in state.values())
    for key, value in state.items():
        assert (gradients[key] - value.grad).abs().max() < 1e-9 * largest, key


# --- messages -------------------------------------------------------------------------------------


def problem(points=12, count=7, seed=0, dtype=torch.float64):
    rng = np.random.default_rng(seed)
    graph = neighbour_graph(rng.normal(size=(points, 3)), 4)
    displacement = torch.from_numpy(rng.normal(size=(points, count, 3))).to(dtype)
    cost = torch.from_numpy(rng.random((points, count))).to(dtype)
    return cost, displacement, graph


PROPAGATE = pytest.mark.parametrize("propagate", [BeliefPropagation.apply, bp.propagate_eager])


@PROPAGATE
@pytest.mark.parametrize("updates", [0, 1, 2, 4])
@pytest.mark.parametrize("count", [1, 7, 8, 300])
def test_propagation_and_its_gradient_follow_the_definition(propagate, updates, count):
    cost, displacement, graph = problem(count=count)
    edges = list(zip(graph.tail.tolist(), graph.head.tolist(), strict=True))
    weight = torch.rand(cost.shape, dtype=torch.float64, generator=generator(1))
    results = []
    for function in (
        lambda cost: propagate(cost, displacement, graph, 10.0, updates),
        lambda cost: reference.propagate(cost, displacement, edges, updates),
    ):
        leaf = cost.clone().requires_grad_()
        belief = function(leaf)
        (belief * weight).sum().backward()
        with torch.no_grad():  # winners are not kept then
            assert (function(cost) - belief).abs().max() < 1e-11
        results.append((belief.detach(), leaf.grad))
    for found, expected in zip(*results, strict=True):
        assert (found - expected).abs().max() < 1e-10


def test_messages_name_their_winners():
    h, displacement, graph = problem()
    h = torch.rand(len(graph.tail), 7, dtype=torch.float64, generator=generator(2))
    messages, argmin = bp.send_messages(h, displacement, graph, 10.0, True)
    for e, (i, j) in enumerate(zip(graph.tail.tolist(), graph.head.tolist(), strict=True)):
        square = (displacement[i][:, None] - displacement[j][None]).square().sum(2)
        best = (h[e][:, None] + 10 * square).min(dim=0)
        assert (messages[e] - best.values).abs().max() < 1e-12
        assert torch.equal(argmin[e].long(), best.indices)


def test_compiled_and_eager_propagation_agree_in_float32():
    cost, displacement, graph = problem(points=60, count=40, dtype=torch.float32)
    found = BeliefPropagation.apply(cost, displacement, graph, 10.0, 2)
    expected = bp.propagate_eager(*(x.double() for x in (cost, displacement)), graph, 10.0, 2)
    assert (found - expected).abs().max() < 1e-3


def test_read_out_stays_inside_the_hull_of_the_candidates():
    displacement = torch.rand(1, 5, 8, 3, generator=generator(3))
    belief = torch.rand(1, 5, 8, generator=generator(4))
    out = bp.read_out(bp.Candidates(None, displacement, None), belief)
    assert (out <= displacement.amax(2) + 1e-6).all()
    assert (out >= displacement.amin(2) - 1e-6).all()


# --- candidates -----------------------------------------------------------------------------------


@BOTH
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_candidates_are_the_nearest_in_feature_space(path, dtype, monkeypatch):
    eager_only(monkeypatch, path)
    source, target = torch.rand(2, 2, 600, 3, dtype=dtype, generator=generator(5))
    target = target[:, :500]
    a = torch.rand(2, 600, 5, dtype=dtype, generator=generator(6)).requires_grad_()
    b = torch.rand(2, 500, 5, dtype=dtype, generator=generator(7)).requires_grad_()
    mask = torch.ones(2, 500, dtype=torch.bool)
    mask[1, 480:] = False
    found = bp.select_candidates(source, target, a, b, 20, mask)
    table = (a[:, :, None] - b[:, None]).square().mean(3)
    ranked = table.detach().masked_fill(~mask[:, None], torch.inf)
    expected = ranked.topk(20, dim=2, largest=False).indices.sort(dim=2).values
    assert torch.equal(found.index.sort(dim=2).values, expected)
    rows = torch.arange(2)[:, None, None]
    assert torch.equal(found.displacement, target[rows, found.index] - source[:, :, None])
    tolerance = 1e-12 if dtype == torch.float64 else 1e-5
    exact = table.gather(2, found.index)
    assert (found.cost - exact).abs().max() < tolerance
    weight = torch.rand(exact.shape, dtype=dtype, generator=generator(8))
    gradients = [
        torch.autograd.grad((x * weight).sum(), (a, b), retain_graph=True)
        for x in (found.cost, exact)
    ]
    for one, other in zip(*gradients, strict=True):
        assert (one - other).abs().max() < 100 * tolerance


def test_equal_features_still_give_distinct_candidates():
    same = torch.ones(1, 40, 4)
    points = cloud(40, 9).float()[None]
    found = bp.select_candidates(points, points, same, same, 7)
    assert torch.equal(found.index[0], torch.arange(7).expand(40, 7))
    assert (found.cost == 0).all()


def test_a_small_target_has_candidates_of_no_weight():
    points = cloud(30, 10).float()[None]
    mask = torch.arange(30)[None] < 5
    feature = torch.rand(1, 30, 4, generator=generator(11))
    found = bp.select_candidates(points, points, feature, feature, 8, mask)
    assert ((found.cost == bp.INVALID_COST).sum(2) == 3).all()


# --- neighbours -----------------------------------------------------------------------------------


@pytest.mark.parametrize("masked", [False, True])
def test_neighbours_are_the_nearest_of_the_same_member(masked):
    queries, points = (torch.stack([cloud(40, s), cloud(40, s + 1) + 0.1]) for s in (12, 14))
    query_mask = point_mask = None
    if masked:
        query_mask = torch.arange(40) < torch.tensor([[40], [33]])
        point_mask = torch.arange(40) < torch.tensor([[40], [3]])
    found = nearest_neighbours(queries, points, 6, query_mask, point_mask)
    distances = squared_distances(queries, points)
    if masked:
        distances = distances.masked_fill(~point_mask[:, None], torch.inf)
    near, index = distances.topk(6, dim=2, largest=False)
    for member in range(2):
        for query in range(40):
            valid = near[member, query].isfinite()
            if masked and not query_mask[member, query]:
                valid[:] = False
            expected = set(index[member, query][valid].tolist())
            kept = slice(None) if found.mask is None else found.mask[member, query]
            assert set(found.index[member, query][kept].tolist()) == expected
    assert (found.mask is None) == (not masked)


def test_neighbours_of_values_that_are_not_finite_do_not_crash():
    points = torch.full((1, 5, 3), torch.nan)
    assert nearest_neighbours(points, points, 2).index.shape == (1, 5, 2)


# --- norms and convolutions -----------------------------------------------------------------------


@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("slope", [0.01, 1.0])
def test_norm_and_its_gradient(masked, slope):
    # More rows than one block of the kernel, in two members.
    x = 3 + torch.randn(2, 300, 5, dtype=torch.float64, generator=generator(20))
    mask = torch.ones(2, 300, dtype=torch.bool)
    if masked:
        mask[1, 250:] = False
    weight = torch.randn(2, 300, 5, dtype=torch.float64, generator=generator(21))
    weight = weight * mask.unsqueeze(-1)
    used = mask if masked else None
    results = []
    for function in (
        lambda x: NormLeakyReLU.apply(x, slope, used, EPS),
        lambda x: features.instance_norm_eager(x, used, slope),
    ):
        leaf = x.clone().requires_grad_()
        y = function(leaf) * mask.unsqueeze(-1)
        (y * weight).sum().backward()
        results.append((y.detach(), leaf.grad * mask.unsqueeze(-1)))
    for found, expected in zip(*results, strict=True):
        assert (found - expected).abs().max() < 1e-10


@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("length", [128, 150])
def test_linear_maximum_and_its_gradient(masked, length, monkeypatch):
    x = 2 * torch.randn(2, length, 6, dtype=torch.float64, generator=generator(22)) - 1
    weight = torch.randn(5, 6, dtype=torch.float64, generator=generator(23))
    mask = None
    if masked:
        mask = torch.arange(length) < torch.tensor([[length], [70]])
    results = []
    for path in ("compiled", "eager"):
        eager_only(monkeypatch, path)
        leaves = x.clone().requires_grad_(), weight.clone().requires_grad_()
        y = features.linear_maximum(*leaves, 32, mask)
        assert y.shape == (2, -(-length // 32), 5)
        (y * y.detach().sin()).sum().backward()
        results.append((y.detach(), *(leaf.grad for leaf in leaves)))
    for found, expected in zip(*results, strict=True):
        assert (found - expected).abs().max() < 1e-10
    if masked:  # groups without a row
        assert (results[0][0][1, 3:] == 0).all()


@pytest.mark.parametrize("masked", [False, True])
def test_edge_convolution_and_its_gradient(masked):
    random = generator(24)
    inputs = [torch.randn(2, 100, 8, dtype=torch.float64, generator=random) for _ in range(2)]
    inputs += [torch.randn(8, 8, dtype=torch.float64, generator=random) for _ in range(2)]
    index = torch.randint(0, 100, (2, 100, 7), generator=random)
    mask = None
    if masked:
        mask = torch.rand(2, 100, 7, generator=random) < 0.8
        mask[1, 60:] = False
    neighbours = Neighbours(index, mask)
    slope = features.EdgeConv.SLOPE
    results = []
    for function in (
        lambda *x: EdgeConvolution.apply(*x, Edges(neighbours), slope, EPS),
        lambda *x: features.edge_convolution(*x, neighbours, slope),
    ):
        leaves = [x.clone().requires_grad_() for x in inputs]
        y = function(*leaves)
        (y * y.detach().sin()).sum().backward()
        results.append((y.detach(), *(leaf.grad for leaf in leaves)))
    for found, expected in zip(*results, strict=True):
        assert (found - expected).abs().max() < 1e-9
    if masked:
        assert (results[0][0][1, 60:] == 0).all()


def test_norm_statistics_survive_a_large_offset_in_float32():
    x = 1000 + torch.randn(1, 5000, 3, generator=generator(25))
    y = NormLeakyReLU.apply(x, 1.0, None, EPS)
    exact = features.instance_norm_eager(x.double())
    assert (y - exact).abs().max() < 1e-3


def test_results_do_not_depend_on_the_number_of_threads():
    cost, displacement, graph = problem(points=80, count=20, dtype=torch.float32)
    near, own = torch.randn(2, 1, 900, 8, generator=generator(26))
    weights = torch.randn(2, 8, 8, generator=generator(27))
    edges = Edges(nearest_neighbours(near[..., :3], near[..., :3], 9))
    threads = torch.get_num_threads()
    try:
        found = []
        for count in (1, 3):
            torch.set_num_threads(count)
            leaves = [x.clone().requires_grad_() for x in (near, own, cost)]
            x = EdgeConvolution.apply(*leaves[:2], *weights, edges, 0.01, EPS)
            belief = BeliefPropagation.apply(leaves[2], displacement, graph, 10.0, 2)
            (x.sin().sum() + belief.sin().sum()).backward()
            found.append((x, belief, *(leaf.grad for leaf in leaves)))
    finally:
        torch.set_num_threads(threads)
    for one, three in zip(*found, strict=True):
        assert torch.equal(one, three)
