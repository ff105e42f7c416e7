"""Chamfer distance and neighbour graph against loops written from their definitions."""

import numpy as np
import pytest
import torch

from dine.data.batch import make_batch
from dine.errors import DataError
from dine.geometry.chamfer import chamfer_distance, nearest_squared
from dine.geometry.graph import batch_graphs, neighbour_graph
from dine.geometry.neighbours import squared_distances

pytestmark = pytest.mark.numerical


def cloud(count, seed=0):
    return np.random.default_rng(seed).normal(size=(count, 3))


def naive_chamfer(a, b):
    forth = np.mean([min(np.sum((x - y) ** 2) for y in b) for x in a])
    back = np.mean([min(np.sum((x - y) ** 2) for x in a) for y in b])
    return forth + back


def test_chamfer_follows_its_definition():
    a, b = cloud(17), cloud(23, seed=1)
    found = chamfer_distance(torch.from_numpy(a)[None], torch.from_numpy(b)[None])
    assert found.item() == pytest.approx(naive_chamfer(a, b), rel=1e-12)


def test_chamfer_of_shifted_grids_is_known():
    grid = torch.cartesian_prod(*[torch.arange(4.0)] * 3)[None]
    shifted = grid + torch.tensor([0.1, 0.0, 0.0])
    assert chamfer_distance(grid, shifted).item() == pytest.approx(0.02, rel=1e-5)
    assert chamfer_distance(grid, grid).item() == 0


def test_chamfer_with_masks_ignores_padding():
    pairs = [(cloud(9), cloud(12, 1)), (cloud(5, 2), cloud(20, 3))]
    batch = make_batch(*zip(*pairs, strict=True), dtype=torch.float64)
    found = chamfer_distance(batch.source, batch.target, batch.source_mask, batch.target_mask)
    for value, pair in zip(found, pairs, strict=True):
        assert value.item() == pytest.approx(naive_chamfer(*pair), rel=1e-12)
    forth, back = nearest_squared(batch.source, batch.target, batch.source_mask, batch.target_mask)
    assert (forth[1, 5:] == 0).all()
    assert (back[0, 12:] == 0).all()


def test_chamfer_gradient():
    a = torch.from_numpy(cloud(6))[None].requires_grad_()
    b = torch.from_numpy(cloud(7, 1))[None].requires_grad_()
    assert torch.autograd.gradcheck(chamfer_distance, (a, b))


def test_squared_distances_far_from_the_origin_stay_accurate_in_float32():
    a = torch.from_numpy(cloud(50)).float()[None] + 1000
    exact = torch.cdist(a.double(), a.double()) ** 2
    assert (squared_distances(a, a) - exact).abs().max() < 1e-3


def test_graph_is_the_symmetrised_neighbour_graph():
    points, k = cloud(40), 5
    graph = neighbour_graph(points, k)
    distance = np.linalg.norm(points[:, None] - points[None], axis=2)
    near = np.argsort(distance, axis=1)[:, 1 : k + 1]
    expected = {(i, j) for i in range(40) for j in near[i]}
    expected |= {(j, i) for i, j in expected}
    found = list(zip(graph.tail.tolist(), graph.head.tolist(), strict=True))
    assert len(found) == len(set(found))
    assert set(found) == expected
    assert (graph.tail[graph.reverse] == graph.head).all()
    assert (graph.head[graph.reverse] == graph.tail).all()
    assert (graph.head.diff() >= 0).all()


def test_graph_with_duplicate_points_has_no_loops():
    points = np.repeat(cloud(4), 5, axis=0)
    graph = neighbour_graph(points, 3)
    assert (graph.tail != graph.head).all()
    # Every point keeps its full number of neighbours.
    assert torch.bincount(graph.head).min() >= 3


@pytest.mark.parametrize("count", [1, 2, 4])
def test_graph_of_very_few_points(count):
    graph = neighbour_graph(cloud(count), 10)
    assert len(graph.tail) == count * (count - 1)


def test_batched_graphs_do_not_mix_members():
    graphs = [neighbour_graph(cloud(8), 3), neighbour_graph(cloud(6, 1), 3)]
    joined = batch_graphs(graphs, stride=8)
    member = joined.tail // 8
    assert (member == joined.head // 8).all()
    second = member == 1
    assert torch.equal(joined.tail[second] - 8, graphs[1].tail)
    assert (joined.tail[joined.reverse] == joined.head).all()


@pytest.mark.parametrize(
    ("source", "match"),
    [
        (np.zeros((0, 3)), r"source 0 has shape \(0, 3\)"),
        (np.zeros((4, 2)), r"source 0 has shape \(4, 2\)"),
        (np.full((4, 3), np.nan), "source 0 holds NaN"),
    ],
)
def test_bad_clouds_are_refused(source, match):
    with pytest.raises(DataError, match=match):
        make_batch([source], [np.zeros((4, 3))])
