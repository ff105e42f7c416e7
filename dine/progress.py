"""Progress of long steps: a bar where a person watches, plain lines in the log."""

from __future__ import annotations

import logging
import sys
import time
from collections.abc import Sequence
from typing import Any

from tqdm import tqdm

log = logging.getLogger("dine")

LOG_SECONDS = 10.0
ELSEWHERE: dict[str, Any] = {"elsewhere": True}
"""``extra`` of a line of the log that the person at the terminal sees in another way."""

_hidden = False
_watching: Stages | None = None


def hide(hidden: bool = True) -> None:
    """Show no bars from here on, or show them again."""
    global _hidden
    _hidden = hidden


def hidden() -> bool:
    """Whether the person who started this wants to see results and errors only."""
    return _hidden


def stage(name: str) -> None:
    """Say that a stage of a task begins, to the :class:`Stages` that are open, if any."""
    if _watching is not None:
        _watching.begin(name)


def remark(text: str) -> None:
    """Say why something takes longer than it usually does."""
    if _watching is not None:
        _watching.remark(text)
    else:
        log.info(text)


def _line(quiet: bool = False, **settings: Any) -> tqdm:
    """A bar, or a line that changes; disabled where nobody watches."""
    off = quiet or _hidden or not sys.stderr.isatty()
    return tqdm(disable=off, dynamic_ncols=True, leave=False, **settings)


class Stages:
    """Stages of one task: a line that changes on a terminal, otherwise a line of the log for each.

    With the names of the usual stages, in their ``order``, a bar beside the line says how far this
    is; it does not go back where stages come again. Use as a context manager. While it is open,
    :func:`stage` and :func:`remark` anywhere below it reach it.
    """

    def __init__(self, order: Sequence[str] = ()):
        form = "{bar:20} {elapsed} {desc}" if order else "{desc}"
        self._shown = _line(total=len(order) or None, bar_format=form)
        self._order = order
        self._name, self._began = "", time.monotonic()

    def __enter__(self) -> Stages:
        global _watching
        _watching = self
        return self

    def begin(self, name: str) -> None:
        """Go on to a stage; nothing if it is the one that is under way."""
        if name == self._name:
            return
        self._end()
        self._name, self._began = name, time.monotonic()
        if name in self._order:
            self._shown.n = max(self._shown.n, self._order.index(name))
        self._say(name)

    def remark(self, text: str) -> None:
        """Say something of the stage that is under way."""
        self._say(f"{self._name}: {text}")

    def _say(self, text: str) -> None:
        log.info(text, extra=None if self._shown.disable else ELSEWHERE)
        self._shown.set_description_str(f"{text} …")

    def _end(self) -> None:
        if self._name:
            log.debug("%s took %.2f s", self._name, time.monotonic() - self._began)

    def __exit__(self, *error) -> None:
        global _watching
        _watching = None
        self._end()
        self._shown.close()


class Progress:
    """A bar on an interactive terminal and, every ten seconds, a line in the log.

    Use as a context manager; call :meth:`update` after each unit of work. With ``quiet`` there is
    no bar.
    """

    def __init__(
        self, name: str, total: int, done: int = 0, unit: str = "step", quiet: bool = False
    ):
        self.name, self.total, self.done, self.unit = name, total, done, unit
        self._bar = _line(quiet, total=total, initial=done, desc=name, unit=unit)
        self._first, self._start = done, time.monotonic()
        self._logged = self._start

    def __enter__(self) -> Progress:
        return self

    def update(self, count: int = 1, **values: float) -> None:
        """Count work as done and show some values, such as the loss."""
        self.done += count
        if values:
            self._bar.set_postfix({key: f"{value:.3g}" for key, value in values.items()}, False)
        self._bar.update(count)
        now = time.monotonic()
        if now - self._logged >= LOG_SECONDS or self.done == self.total:
            self._logged = now
            rate = (now - self._start) / max(self.done - self._first, 1)
            left = rate * (self.total - self.done)
            shown = "".join(f", {key} {value:.4g}" for key, value in values.items())
            log.info(
                "%s: %s %d of %d%s, %.0f s left",
                self.name,
                self.unit,
                self.done,
                self.total,
                shown,
                left,
            )

    def __exit__(self, *error) -> None:
        self._bar.close()
