"""How kernels are compiled and shared out among threads."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from itertools import pairwise
from typing import Any

import numba
import numpy as np
import torch

# Not the full fast-math set: infinities must keep their meaning, and sums are split by hand.
_FAST = {"contract", "nsz", "nnan", "arcp", "afn"}
jit = numba.njit(cache=True, nogil=True, fastmath=_FAST, error_model="numpy")


@cache
def _pool(threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads)


def share(items: Sequence[Any], work: Callable[[int, Any], None]) -> None:
    """Call ``work(worker, item)`` for all items, on torch's number of threads.

    A worker does one item at a time, so it can have memory of its own. Library products inside take
    one thread each: sharing out whole items costs far fewer meetings of threads than sharing out
    every product, which shows wherever the machine does something else, too.
    """
    threads = min(torch.get_num_threads(), len(items))
    if threads <= 1:
        for item in items:
            work(0, item)
        return
    left = iter(items)

    def worker(number: int) -> None:
        for item in left:  # one thread at a time advances it, under the interpreter lock
            work(number, item)

    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        others = [_pool(threads - 1).submit(worker, number) for number in range(1, threads)]
        worker(0)
        for other in others:
            other.result()
    finally:
        torch.set_num_threads(before)


def run(kernel, first: int, last: int, *arguments) -> None:
    """Call ``kernel(*arguments, first, last)``, split over torch's number of threads."""
    threads = min(torch.get_num_threads(), last - first)
    if threads <= 1:
        kernel(*arguments, first, last)
        return
    bounds = np.linspace(first, last, threads + 1).astype(int).tolist()
    parts = list(pairwise(bounds))
    others = [_pool(threads - 1).submit(kernel, *arguments, *part) for part in parts[1:]]
    kernel(*arguments, *parts[0])
    for other in others:
        other.result()
