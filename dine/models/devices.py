"""Which device computes, and who holds it: of one user's jobs no two share a GPU."""

from __future__ import annotations

import contextlib
import logging
import os
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import torch

from dine.errors import ConfigError, DineError
from dine.files import held

log = logging.getLogger(__name__)

LEASES = "DINE_LEASES"
"""Environment variable: the folder of the leases, or ``off``."""

POLL_SECONDS = 1.0


def chosen_device(name: str) -> torch.device:
    """``auto``, ``cpu`` or ``cuda`` as a device.

    Raises:
        DineError: ``cuda`` where there is none.
    """
    if name == "cuda" and not torch.cuda.is_available():
        raise DineError("The device 'cuda' was asked for, but no CUDA device is available here.")
    if name == "auto":
        name = "cuda" if torch.cuda.is_available() else "cpu"
    return torch.device(name)


@contextlib.contextmanager
def leased(device: torch.device, count: int = 1) -> Iterator[list[torch.device]]:
    """Hold ``count`` devices that no other process of this user holds, waiting until they are free.

    Only devices that CUDA_VISIBLE_DEVICES shows are taken, so what a cluster has assigned is kept.
    The operating system ends the lease of a process that dies. A CPU is not held.

    Args:
        device: its type is what counts.
        count: all of them are taken at once or none, so two jobs never wait for each other.

    Raises:
        ConfigError: fewer devices are here, held or not.
        DineError: the folder of the leases belongs to another user.
    """
    if device.type != "cuda":
        yield [device] * count
        return
    here = torch.cuda.device_count()
    if count > here:
        raise ConfigError(
            f"`processes` is {count}, and each needs a device of its own, but the number of CUDA "
            f"devices here is {here}."
        )
    if os.environ.get(LEASES) == "off":
        yield [torch.device("cuda", index) for index in range(count)]
        return
    with _held_of(_names(), count) as indices:
        yield [torch.device("cuda", index) for index in indices]


def _names() -> list[str]:
    """A name of each visible CUDA device that is the same for every process of the machine."""
    # Indices are not: CUDA_VISIBLE_DEVICES and containers number devices anew.
    properties = map(torch.cuda.get_device_properties, range(torch.cuda.device_count()))
    return [str(found.uuid) for found in properties]


def _folder() -> Path:
    """Where leases lie: the same for all processes of this user on this machine."""
    if given := os.environ.get(LEASES):
        return Path(given)
    if os.name != "posix":
        return Path(tempfile.gettempdir()) / "dine-leases"
    # Not TMPDIR, which a cluster may set for each job.
    folder = Path(f"/tmp/dine-leases-{os.getuid()}")
    folder.mkdir(mode=0o700, exist_ok=True)
    if folder.stat().st_uid != os.getuid():
        raise DineError(
            f"{folder} belongs to another user, so devices cannot be leased there; set {LEASES} to "
            "a folder of yours on this machine, or to off."
        )
    return folder


@contextlib.contextmanager
def _held_of(names: list[str], count: int) -> Iterator[list[int]]:
    """Hold ``count`` of the named devices and give their indices."""
    folder = _folder()
    said = None
    while True:
        holders = {}
        with contextlib.ExitStack() as stack:
            indices = []
            # Looking around takes turns: otherwise two jobs could each find half of what they need.
            with held(folder / "turn") as busy:
                if busy is None:
                    for index, name in enumerate(names):
                        if len(indices) == count:
                            break
                        lease = held(folder / name, again=True)
                        with contextlib.ExitStack() as attempt:
                            if who := attempt.enter_context(lease):
                                holders[index] = who
                            else:
                                indices.append(index)
                                stack.push(attempt.pop_all())
            if len(indices) == count:
                yield indices
                return
        if holders and holders != said:
            log.info(
                "waiting for %d of %d CUDA devices: %s",
                count,
                len(names),
                ", ".join(f"{index} is held by {who}" for index, who in holders.items()),
            )
            said = holders
        time.sleep(POLL_SECONDS)
