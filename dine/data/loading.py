"""Batches of a pair set: shuffled by key, and the next one made while this one is in use."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import torch
from torch import Tensor

from dine.data.batch import GRAPH_NEIGHBOURS, Batch, make_batch
from dine.data.pairs import PairSet
from dine.geometry.graph import Graph, neighbour_graph

Loaded = tuple[Batch, Tensor]
"""A batch and its true displacements (B, N, 3)."""

Request = tuple[Sequence[int], Sequence[Sequence[int]] | None]
"""Pair indices, and for each a key that seeds the shuffle of its target; None leaves the order."""


class Batches:
    """Batches on a device, with the sources' graphs made once per distinct source.

    Targets are shuffled so that a network cannot learn the correspondence from the points' order.
    Each pair has its own key, so its shuffle does not depend on what shares its batch.

    Args:
        pairs: where the batches come from.
        device: where they go.
        targets: (P, M, 3), stands in for the pairs' clean targets; the truth stays theirs.
        parts: share of the shuffled pairs whose source is cut down to a part of itself, which then
            gives the frame.
    """

    def __init__(
        self,
        pairs: PairSet,
        device: torch.device,
        targets: np.ndarray | None = None,
        parts: float = 0.0,
    ):
        self.pairs = pairs
        self.device = device
        self.parts = parts
        self._targets = pairs.target if targets is None else targets
        self._graphs: dict[bytes, Graph] = {}

    def __len__(self) -> int:
        return len(self.pairs)

    def get(self, indices: Sequence[int], keys: Sequence[Sequence[int]] | None = None) -> Loaded:
        """One batch, at once."""
        return self._send(self._make(indices, keys))

    def stream(self, requests: Iterable[Request]) -> Iterator[Loaded]:
        """:meth:`get` for each request, one ahead: made in a thread while the caller computes."""
        with ThreadPoolExecutor(1, "batches") as thread:
            ahead = None
            for request in requests:
                ready, ahead = ahead, thread.submit(self._make, *request)
                if ready is not None:
                    yield self._send(ready.result())
            if ahead is not None:
                yield self._send(ahead.result())

    def _graph(self, index: int) -> Graph:
        source = self.pairs.source[index]
        key = source.tobytes()
        if key not in self._graphs:
            self._graphs[key] = neighbour_graph(source, GRAPH_NEIGHBOURS)
        return self._graphs[key]

    def _make(self, indices: Sequence[int], keys: Sequence[Sequence[int]] | None) -> Loaded:
        sources = [self.pairs.source[i] for i in indices]
        clouds = [self._targets[i] for i in indices]
        graphs = [self._graph(i) for i in indices]
        moves = [self.pairs.target[i] - self.pairs.source[i] for i in indices]
        for row, key in enumerate(keys or ()):
            rng = np.random.default_rng(key)
            clouds[row] = clouds[row][rng.permutation(len(clouds[row]))]
            if self.parts and rng.random() < self.parts:
                kept = _part(sources[row], rng)
                center = sources[row][kept].mean(axis=0)
                source = sources[row][kept] - center
                scale = np.linalg.norm(source, axis=1).max()
                sources[row] = source / scale
                clouds[row] = (clouds[row] - center) / scale
                moves[row] = moves[row][kept] / scale
                graphs[row] = neighbour_graph(sources[row], GRAPH_NEIGHBOURS)
        batch = make_batch(sources, clouds, graphs)
        truth = torch.zeros_like(batch.source)
        for row, move in zip(truth, moves, strict=True):
            row[: len(move)] = torch.from_numpy(move)
        if self.device.type != "cuda":
            return batch, truth
        # A thread starts on the first GPU, which belongs to another process where there are more.
        with torch.cuda.device(self.device):
            return batch.pin_memory(), truth.pin_memory()

    def _send(self, loaded: Loaded) -> Loaded:
        batch, truth = loaded
        return (
            batch.to(self.device, non_blocking=True),
            truth.to(self.device, non_blocking=True),
        )


def _part(points: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Indices of the 30 to 90 % of (N, 3) points that are nearest to a random one."""
    center = points[rng.integers(len(points))]
    share = rng.uniform(0.3, 0.9)
    order = np.argsort(np.linalg.norm(points - center, axis=1), kind="stable")
    return np.sort(order[: max(GRAPH_NEIGHBOURS + 1, round(share * len(points)))])
