"""Progress of long steps: a bar where a person watches, plain lines in the log."""

from __future__ import annotations

import logging
import sys
import time

from tqdm import tqdm

log = logging.getLogger("dine")

LOG_SECONDS = 10.0


class Progress:
    """A bar on an interactive terminal and, every ten seconds, a line in the log.

    Use as a context manager; call :meth:`update` after each unit of work. With ``quiet`` there is
    no bar.
    """

    def __init__(
        self, name: str, total: int, done: int = 0, unit: str = "step", quiet: bool = False
    ):
        self.name, self.total, self.done, self.unit = name, total, done, unit
        self._bar = tqdm(
            total=total,
            initial=done,
            desc=name,
            unit=unit,
            disable=quiet or not sys.stderr.isatty(),
            dynamic_ncols=True,
            leave=False,
        )
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
