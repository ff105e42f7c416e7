"""The state of a running training: saved atomically, bound to what it was made from."""

from __future__ import annotations

import contextlib
import os
import signal
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import filelock
import torch

from dine.errors import DineError
from dine.files import atomic_path


class Interrupted(DineError):
    """The run was asked to stop; its state is saved."""


@contextlib.contextmanager
def one_writer(folder: Path) -> Iterator[None]:
    """Hold a run folder; a second process that wants it is refused.

    The operating system lets go of the lock when the holder dies, however it dies.

    Raises:
        DineError: another process is training in the folder.
    """
    folder.mkdir(parents=True, exist_ok=True)
    holder = folder / "holder.txt"
    lock = filelock.FileLock(folder / "lock", timeout=0)
    try:
        lock.acquire()
    except filelock.Timeout:
        who = holder.read_text().strip() if holder.exists() else "another process"
        raise DineError(
            f"{folder} is in use by {who}; wait for it or stop it, then run the same command again."
        ) from None
    try:
        holder.write_text(f"process {os.getpid()}\n")
        yield
    finally:
        holder.unlink(missing_ok=True)
        lock.release()


class StopRequest:
    """Turns SIGTERM and SIGINT into a flag that the training loop reads between steps."""

    def __init__(self):
        self.signal: int | None = None

    def __enter__(self):
        self._previous = {}
        # Handlers can be set in the main thread only; elsewhere the caller deals with signals.
        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGTERM, signal.SIGINT):
                self._previous[number] = signal.signal(number, self._note)
        return self

    def _note(self, number, frame):
        if self.signal is not None:  # asked twice: stop at once
            raise KeyboardInterrupt
        self.signal = number

    def __exit__(self, *error):
        for number, handler in self._previous.items():
            signal.signal(number, handler)


def save_state(path: Path, state: dict[str, Any]) -> None:
    """Write a training state; the previous one stays until the new one is whole."""
    with atomic_path(path) as temporary:
        torch.save(state, temporary)


def load_state(path: Path, identity: dict[str, str]) -> tuple[dict[str, Any] | None, str]:
    """The saved state if it belongs to ``identity``, and a sentence on what was found."""
    if not path.exists():
        return None, "starting from the beginning"
    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
        saved = dict(state["identity"])
        step = int(state["step"])
    except Exception:  # a damaged file fails in as many ways as there are readers
        return None, f"{path} is damaged and is not used; starting from the beginning"
    changed = [key for key in identity if saved.get(key) != identity[key]]
    if changed:
        return None, (
            f"the saved state was made with other {', '.join(changed)} and is not used; "
            "starting from the beginning"
        )
    return state, f"going on from step {step}"
