"""Work shared out among torch's number of threads.

Compiled kernels, NumPy's loops and products and SciPy's search trees release the interpreter lock,
so threads of Python do. Shares are whole pieces of work, each as it would be alone, so results do
not depend on the number of threads.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import cache
from itertools import pairwise
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

# Within a piece of work that is one of several at a time there are no further threads to be had.
_here = threading.local()


def available() -> int:
    """How many threads the caller may use: torch's number, or one within a shared piece of work."""
    if getattr(_here, "sharing", False):
        return 1
    import torch  # takes a while, and not all that may share work out uses it

    return torch.get_num_threads()


@cache
def _pool(threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads)


@contextmanager
def _sharing() -> Iterator[None]:
    before = getattr(_here, "sharing", False)
    _here.sharing = True
    try:
        yield
    finally:
        _here.sharing = before


def _at_once(calls: Sequence[Callable[[], None]]) -> None:
    """Call all, each on a thread of its own, the first on this one; return once all are done."""

    def shared(call: Callable[[], None]) -> None:
        with _sharing():
            call()

    others = [_pool(len(calls) - 1).submit(shared, call) for call in calls[1:]]
    try:
        shared(calls[0])
    finally:
        # What they write to may go once this returns.
        faults = [other.exception() for other in others]
    for fault in faults:
        if fault is not None:
            raise fault


def share(items: Sequence[Any], work: Callable[[int, Any], None]) -> None:
    """Call ``work(worker, item)`` for all items, on the threads there are.

    A worker does one item at a time, so it can have memory of its own. Library products inside take
    one thread each: sharing out whole items costs far fewer meetings of threads than sharing out
    every product, which shows wherever the machine does something else, too.
    """
    threads = min(available(), len(items))
    if threads <= 1:
        for item in items:
            work(0, item)
        return
    left = iter(items)

    def worker(number: int) -> None:
        for item in left:  # one thread at a time advances it, under the interpreter lock
            work(number, item)

    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        _at_once([lambda number=number: worker(number) for number in range(threads)])
    finally:
        torch.set_num_threads(before)


def each(work: Callable[[Any], Any], items: Iterable[Any]) -> list[Any]:
    """``work(item)`` of all items, which do not know of each other, in their order.

    Library products inside take one thread each, those of BLAS too.
    """
    items = list(items)
    if min(available(), len(items)) <= 1:
        return [work(item) for item in items]
    found: list[Any] = [None] * len(items)

    def keep(_: int, number: int) -> None:
        found[number] = work(items[number])

    # Limits that the items set themselves end in any order; here all are the same.
    with threadpool_limits(1, user_api="blas"):
        share(range(len(items)), keep)
    return found


def together(*calls: Callable[[], Any]) -> list[Any]:
    """What some calls give that do not know of each other, in their order, as :func:`each`."""
    return each(lambda call: call(), calls)


def run(kernel: Callable, first: int, last: int, *arguments: Any) -> None:
    """Call ``kernel(*arguments, first, last)``, split over the threads there are."""
    threads = min(available(), last - first)
    if threads <= 1:
        kernel(*arguments, first, last)
        return
    bounds = np.linspace(first, last, threads + 1).astype(int).tolist()
    parts = list(pairwise(bounds))
    _at_once([lambda part=part: kernel(*arguments, *part) for part in parts])
