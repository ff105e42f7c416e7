"""The neighbour graph of the source on which belief propagation runs."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor


@dataclass(frozen=True)
class Graph:
    """Directed edges of a symmetric graph, sorted by ``head``.

    Attributes:
        tail: (E,) int64, the node a message leaves.
        head: (E,) int64, the node it reaches.
        reverse: (E,) int64, the position of the edge head → tail.
        nodes: number of nodes.
    """

    tail: Tensor
    head: Tensor
    reverse: Tensor
    nodes: int

    def to(self, device: torch.device | str) -> Graph:
        return Graph(
            self.tail.to(device), self.head.to(device), self.reverse.to(device), self.nodes
        )

    @cached_property
    def start(self) -> Tensor:
        """(nodes + 1,) int64: the edges that reach node i are start[i]…start[i + 1]."""
        nodes = torch.arange(self.nodes + 1, device=self.head.device)
        return torch.searchsorted(self.head, nodes)


def neighbour_graph(points: np.ndarray, k: int) -> Graph:
    """Symmetrised k-nearest-neighbour graph (self excluded) of (N, 3) points.

    Two points are joined, in both directions, when either is among the k nearest of the other.
    """
    count = len(points)
    k = min(k, count - 1)
    if k < 1:
        empty = torch.zeros(0, dtype=torch.int64)
        return Graph(empty, empty, empty, count)
    _, index = cKDTree(points).query(points, k=k + 1)
    rows = np.repeat(np.arange(count), k + 1)
    columns = index.ravel()
    # Where duplicates exist a point need not be its own first neighbour, so drop self by value
    # and the surplus neighbour by rank.
    is_self = (index == np.arange(count)[:, None]).any(axis=1)
    keep = rows != columns
    keep.reshape(count, k + 1)[~is_self, k] = False
    rows, columns = rows[keep], columns[keep]
    keys = np.unique(np.concatenate([rows * count + columns, columns * count + rows]))
    head, tail = keys // count, keys % count
    reverse = np.searchsorted(keys, tail * count + head)
    return Graph(
        torch.from_numpy(tail.copy()),
        torch.from_numpy(head.copy()),
        torch.from_numpy(reverse),
        count,
    )


def batch_graphs(graphs: list[Graph], stride: int) -> Graph:
    """One graph over a padded batch, in which node i of member b becomes b·stride + i."""
    node_offset = 0
    edge_offset = 0
    tails, heads, reverses = [], [], []
    for graph in graphs:
        tails.append(graph.tail + node_offset)
        heads.append(graph.head + node_offset)
        reverses.append(graph.reverse + edge_offset)
        node_offset += stride
        edge_offset += len(graph.tail)
    return Graph(torch.cat(tails), torch.cat(heads), torch.cat(reverses), node_offset)
