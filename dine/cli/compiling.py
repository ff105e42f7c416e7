"""Says when kernels are compiled, which takes seconds on the first run after an installation."""

from __future__ import annotations

import functools

from numba.core import event

from dine import progress


class _Notice(event.Listener):
    """Looks out for kernels of ours that numba finds no compiled form of."""

    def on_start(self, event: event.Event) -> None:
        if event.data["dispatcher"].py_func.__module__.startswith("dine."):
            _say()

    def on_end(self, event: event.Event) -> None:
        pass


@functools.cache
def _say() -> None:
    """Once in this process."""
    progress.remark("compiling once (about 6 s)")


@functools.cache
def say_when_compiling() -> None:
    """From here on, in this process."""
    event.register("numba:compile", _Notice())
