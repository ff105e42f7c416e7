"""The state of a running training: saved atomically, bound to what it was made from."""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch

from dine.errors import DineError
from dine.files import atomic_path, held, read_json, storage_errors, write_json


class Interrupted(DineError):
    """The run was asked to stop; its state is saved."""


ASKED = "asked.json"


@contextlib.contextmanager
def one_writer(folder: Path, identity: dict[str, str]) -> Iterator[None]:
    """Hold a run folder; a second process that wants it is refused.

    One that was refused leaves its ``identity`` behind, for :func:`check_still_wanted`.

    Raises:
        DineError: another process is training in the folder.
        StorageError: the folder cannot be written.
    """
    with held(folder / "lock") as who:
        if who:
            write_json(folder / ASKED, identity)
            raise DineError(
                f"{folder} is in use by {who}; wait for it or stop it, then run the same command "
                "again."
            )
        with storage_errors(folder):
            (folder / ASKED).unlink(missing_ok=True)
        yield


def check_still_wanted(folder: Path, identity: dict[str, str], name: str) -> None:
    """Refuse to finish a training that, while it ran, was asked for with something else.

    Its results would take the place of those that were asked for, and look newer.

    Raises:
        DineError: what was refused meanwhile has another identity.
    """
    asked = folder / ASKED
    if not asked.exists():
        return
    wanted = read_json(asked)
    changed = [key for key in identity if wanted.get(key) != identity[key]]
    if changed:
        raise DineError(
            f"{name} is finished, but was asked for with other {', '.join(changed)} while it ran; "
            "nothing is written. Run the command with the new settings again."
        )


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
