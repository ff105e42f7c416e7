"""A batch of pairs: padded clouds, masks and the source's neighbour graph."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, is_dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from dine.errors import DataError
from dine.geometry.graph import Graph, batch_graphs, neighbour_graph

GRAPH_NEIGHBOURS = 10
"""Neighbours of the belief-propagation graph, as published."""


@dataclass(frozen=True)
class Batch:
    """Pairs padded to equal size.

    Attributes:
        source: (B, N, 3) in the normalised frame, zero where padded.
        target: (B, M, 3) in the source's frame, zero where padded.
        source_mask: (B, N) bool, True at valid points; None when nothing is padded.
        target_mask: (B, M) bool, likewise.
        graph: neighbour graph of the sources over B·N nodes.
    """

    source: Tensor
    target: Tensor
    source_mask: Tensor | None
    target_mask: Tensor | None
    graph: Graph

    def __len__(self) -> int:
        return len(self.source)

    def to(self, device: torch.device | str, non_blocking: bool = False) -> Batch:
        """The same batch with every tensor on ``device``."""
        return _with_tensors(self, lambda tensor: tensor.to(device, non_blocking=non_blocking))

    def pin_memory(self) -> Batch:
        """The same batch in memory that a GPU can fetch from while the CPU goes on."""
        return _with_tensors(self, torch.Tensor.pin_memory)


def _with_tensors(value: Any, change: Callable[[Tensor], Tensor]) -> Any:
    """A dataclass with every tensor in it changed, those of nested dataclasses too."""
    if isinstance(value, Tensor):
        return change(value)
    if not is_dataclass(value):
        return value
    return type(value)(*(_with_tensors(getattr(value, f.name), change) for f in fields(value)))


def make_batch(
    sources: Sequence[np.ndarray],
    targets: Sequence[np.ndarray],
    graphs: Sequence[Graph] | None = None,
    dtype: torch.dtype = torch.float32,
) -> Batch:
    """Pad (N_b, 3) sources and (M_b, 3) targets of any sizes into one batch.

    ``graphs`` takes the sources' neighbour graphs where they are known already, since they depend
    on the source alone.

    Raises:
        DataError: a cloud is empty, not (N, 3), or not finite.
    """
    for what, clouds in (("source", sources), ("target", targets)):
        for index, cloud in enumerate(clouds):
            shape = np.shape(cloud)
            if len(shape) != 2 or shape[1] != 3 or shape[0] == 0:
                raise DataError(f"{what} {index} has shape {shape}; expected (points, 3).")
            if not np.isfinite(cloud).all():
                raise DataError(f"{what} {index} holds NaN or infinite coordinates.")
    if graphs is None:
        graphs = [neighbour_graph(np.asarray(cloud), GRAPH_NEIGHBOURS) for cloud in sources]
    source, source_mask = _pad(sources, dtype)
    target, target_mask = _pad(targets, dtype)
    return Batch(
        source, target, source_mask, target_mask, batch_graphs(list(graphs), source.shape[1])
    )


def _pad(clouds: Sequence[np.ndarray], dtype: torch.dtype) -> tuple[Tensor, Tensor | None]:
    sizes = [len(cloud) for cloud in clouds]
    padded = torch.zeros(len(clouds), max(sizes), 3, dtype=dtype)
    for row, cloud in zip(padded, clouds, strict=True):
        row[: len(cloud)] = torch.as_tensor(np.asarray(cloud), dtype=dtype)
    if min(sizes) == max(sizes):
        return padded, None
    return padded, torch.arange(max(sizes)) < torch.tensor(sizes).unsqueeze(1)
