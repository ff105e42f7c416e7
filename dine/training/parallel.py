"""Who takes part in a training: one process, or several that share every batch."""

from __future__ import annotations

import contextlib
import importlib.util
import itertools
import logging
import logging.handlers
import multiprocessing
import os
import pickle
import re
import signal
import socket
import threading
from collections.abc import Callable
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn
from torch.multiprocessing import (
    ProcessExitedException,
    ProcessRaisedException,
    start_processes,
)

from dine.errors import ConfigError, DineError
from dine.extras import missing
from dine.models.devices import leased
from dine.state import Interrupted, StopRequest

START = "spawn"
"""How processes are started: CUDA does not survive a fork of a process that has used it."""
GRACE_SECONDS = 5.0
"""How long the others may take to notice that one process has died, before they are ended."""


class Nodes(NamedTuple):
    """The machines that a training runs on: the same command, started once on each of them."""

    count: int = 1
    rank: int = 0
    address: str = "127.0.0.1"
    """Of the first one, where all processes meet."""
    port: int | None = None
    """There; None for any that is free, where there is one machine."""


_trainings = itertools.count()


def nodes_here() -> Nodes:
    """The machines as ``srun --ntasks-per-node=1`` tells them; one machine otherwise.

    MASTER_ADDR and MASTER_PORT say where processes meet, in place of the first node and a port that
    follows from the job's number.

    Raises:
        ConfigError: several tasks on a node.
    """
    found = os.environ
    count = int(found.get("SLURM_STEP_NUM_NODES", 1))
    if count == 1:
        return Nodes()
    tasks = int(found.get("SLURM_STEP_NUM_TASKS", count))
    if tasks != count:
        raise ConfigError(
            f"`srun` started {tasks} tasks on {count} nodes; start one on each "
            "(--ntasks-per-node=1) and let --processes say how many processes they have together."
        )
    # Trainings follow one another in one command, and the last one's port may still be in use.
    port = int(found.get("MASTER_PORT") or 20000 + int(found["SLURM_JOB_ID"]) % 8000)
    port += next(_trainings)
    address = found.get("MASTER_ADDR") or first_host(found["SLURM_STEP_NODELIST"])
    return Nodes(count, int(found["SLURM_NODEID"]), address, port)


def first_host(nodes: str) -> str:
    """The first of Slurm's list of hosts, such as ``gpu[07-09,12]`` or ``a1,b2``."""
    name, _, numbers = re.match(r"([^\[,]+)(\[([^\],-]+))?", nodes).groups(default="")
    return name + (numbers or "")


class Alone:
    """A training in this process; ``torch.distributed`` is not touched."""

    rank, size, leads = 0, 1, True

    def __init__(self, device: torch.device, stop: StopRequest):
        self.device = device
        self._stop = stop

    @property
    def stopping(self) -> bool:
        """Whether to stop after this step."""
        return self._stop.signal is not None

    def share(self, module: nn.Module) -> nn.Module:
        """The module in the form whose gradients are averaged over the processes."""
        return module

    def mean(self, values: Tensor) -> list[float]:
        """Some numbers, averaged over the processes."""
        return values.tolist()

    def wait(self) -> None:
        """Go on when every process has come here."""


class Member:
    """One of several processes, held together by Lightning Fabric.

    The first one leads: it alone writes, validates and shows progress.
    """

    def __init__(self, devices: list[torch.device], nodes: Nodes, stop: Any):
        from lightning_fabric import Fabric
        from lightning_fabric.plugins.environments import LightningEnvironment

        logging.getLogger("lightning_fabric").setLevel(logging.WARNING)
        self._fabric = Fabric(
            accelerator=devices[0].type,
            # Fabric takes a number of CPU processes, but indices of CUDA devices.
            devices=[d.index for d in devices] if devices[0].type == "cuda" else len(devices),
            num_nodes=nodes.count,
            strategy="ddp",
            # Whatever cluster this runs on, our own parent has started us.
            plugins=[LightningEnvironment()],
        )
        self._fabric.launch()
        self.rank, self.size = self._fabric.global_rank, self._fabric.world_size
        self.leads = self.rank == 0
        self.device = self._fabric.device
        self.stopping = False
        self._stop = stop
        self._parent = multiprocessing.parent_process()

    def share(self, module: nn.Module) -> nn.Module:
        return self._fabric.setup_module(module)

    def mean(self, values: Tensor) -> list[float]:
        # All must stop after the same step, so the wish to do so travels with the numbers.
        wish = bool(self._stop.value) or not self._parent.is_alive()
        values = torch.cat([values, values.new_tensor([wish])])
        *values, wishes = self._fabric.all_reduce(values, reduce_op="mean").tolist()
        self.stopping = wishes > 0
        return values

    def wait(self) -> None:
        self._fabric.barrier()


Team = Alone | Member


def run_together(count: int, device: torch.device, work: Callable[[Team], Any]) -> None:
    """Call ``work`` in ``count`` new processes, each with its own :class:`Member`.

    SIGTERM and SIGINT to this process, and its death, make them all stop after the same step. When
    one of them dies the others are ended. On several nodes this is called on each of them, and
    starts that node's share of the processes.

    Args:
        count: number of processes, on all nodes; on CUDA each takes a device of its own.
        device: its type is what counts.
        work: can be pickled; its result is dropped, so it leaves what it makes in files.

    Raises:
        DineError: what ``work`` raised, or a process died.
        ConfigError: more processes than CUDA devices, nodes cannot share the processes equally, or
            Lightning Fabric is not installed.
    """
    if importlib.util.find_spec("lightning_fabric") is None:
        raise missing("lightning_fabric", "More than one process")
    nodes = nodes_here()
    if count % nodes.count:
        raise ConfigError(
            f"`processes` is {count}, which {nodes.count} nodes cannot share equally; make it a "
            "multiple of the number of nodes."
        )
    with leased(device, count // nodes.count) as devices:
        _start(devices, nodes, work)


def _start(devices: list[torch.device], nodes: Nodes, work: Callable[[Team], Any]) -> None:
    """Start this node's processes and stay until they have ended."""
    count = len(devices)
    context = multiprocessing.get_context(START)
    stop = context.RawValue("b", 0)
    reader, writer = context.Pipe(duplex=False)
    part = _Part(
        devices,
        nodes if nodes.port else nodes._replace(port=_free_port()),
        max(1, torch.get_num_threads() // count),
        stop,
        writer,
        logging.getLogger().level,
        pickle.dumps(work),
    )
    died = None
    errors: list[DineError] = []
    listener = threading.Thread(target=_listen, args=(reader, errors))
    with StopRequest() as request:
        with _signals_held_back():
            team = start_processes(_take_part, (part,), count, join=False, start_method=START)
        writer.close()
        listener.start()
        try:
            while not team.join(timeout=0.2, grace_period=GRACE_SECONDS):
                stop.value = request.signal is not None
        except ProcessExitedException as error:
            how = error.signal_name or f"exit code {error.exit_code}"
            died = DineError(
                f"Process {error.error_index + 1} of {count} died ({how}); run the same command "
                "again to go on from the last saved state."
            )
        except ProcessRaisedException as error:
            died = error
        finally:
            for process in team.processes:  # none is left unless this process is interrupted
                process.kill()
                process.join()
            listener.join()
    # What we say ourselves explains more than how a process ended of it.
    if errors or died:
        raise errors[0] if errors else died


@contextlib.contextmanager
def _signals_held_back():
    """Processes started here never see SIGTERM and SIGINT: only their parent tells them to stop.

    Both often come to a whole group of processes, and would end those that are still starting.
    """
    # Were it to start with the first process, it would let the signals through again.
    resource_tracker.ensure_running()
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGTERM, signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def _listen(reader: Connection, errors: list[DineError]) -> None:
    """Log what the processes log and keep their errors, until the last of them has ended."""
    with reader, contextlib.suppress(EOFError):
        while True:
            message = reader.recv()
            if isinstance(message, DineError):
                errors.append(message)
            else:
                logging.getLogger(message.name).handle(message)


class _ToParent(logging.handlers.QueueHandler):
    def enqueue(self, record: logging.LogRecord) -> None:
        self.queue.send(record)


class _Part(NamedTuple):
    """What the processes of a node are given; ``work`` pickled by us.

    Left to torch, it would have all processes train the same weights in one memory.
    """

    devices: list[torch.device]
    nodes: Nodes
    threads: int
    stop: Any
    writer: Connection
    level: int
    work: bytes


def _take_part(rank: int, given: _Part) -> None:
    """What each process runs."""
    os.environ |= {
        "MASTER_ADDR": given.nodes.address,
        "MASTER_PORT": str(given.nodes.port),
        "LOCAL_RANK": str(rank),
        "NODE_RANK": str(given.nodes.rank),
        "OMP_NUM_THREADS": str(given.threads),  # else Fabric sets its own number
    }
    torch.set_num_threads(given.threads)
    if rank == 0 and given.nodes.rank == 0:
        logging.getLogger().setLevel(given.level)
        logging.getLogger().addHandler(_ToParent(given.writer))
    try:
        pickle.loads(given.work)(Member(given.devices, given.nodes, given.stop))
    except DineError as error:
        with contextlib.suppress(OSError):  # the parent is dead
            given.writer.send(error)
        if not isinstance(error, Interrupted):  # which all agree on
            raise
