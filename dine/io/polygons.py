"""Triangles of polygons and strips, as files list them: corners of all cells one after another."""

from __future__ import annotations

import numpy as np


def fans(ends: np.ndarray) -> np.ndarray:
    """Triangles of polygons; those of fewer than 3 corners have none.

    Args:
        ends: (P,) where each polygon ends in the list of all corners.

    Returns:
        (F, 3) places in that list.
    """
    first, step = _triangles(ends)
    return np.column_stack([first, first + step + 1, first + step + 2])


def strips(ends: np.ndarray) -> np.ndarray:
    """Triangles of strips, every second one turned round; arguments as of :func:`fans`."""
    first, step = _triangles(ends)
    start, odd = first + step, step % 2
    return np.column_stack([start, start + 1 + odd, start + 2 - odd])


def _triangles(ends: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Of each triangle, where its cell begins and its number in the cell."""
    starts = np.append(0, ends)[:-1]
    counts = np.maximum(ends - starts - 2, 0)
    step = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)
    return np.repeat(starts, counts), step


def small(ends: np.ndarray) -> bool:
    """Whether a cell has 1 or 2 corners: points and edges among the faces."""
    counts = np.diff(ends, prepend=0)
    return bool(((counts > 0) & (counts < 3)).any())


def counted(table: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Corners of all cells, and where each ends, of a list of each cell's length and corners.

    Raises:
        ValueError: the lengths do not add up.
    """
    starts, place = [], 0
    while place < len(table):
        starts.append(place)
        place += 1 + max(int(table[place]), 0)
    if place != len(table):
        raise ValueError("the lengths of its cells do not add up")
    ends = np.array([*starts[1:], place], dtype=np.int64) - np.arange(1, len(starts) + 1)
    return np.delete(table, starts), ends
