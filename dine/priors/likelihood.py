"""Maximum-likelihood fits in steps, as of flows: they can be stopped and gone on with."""

from __future__ import annotations

import contextlib
import copy
import logging
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torch.optim.lr_scheduler import LRScheduler

from dine.progress import Progress
from dine.state import Interrupted, StopRequest, load_state, one_writer, save_state

log = logging.getLogger(__name__)

CLIP = 1.0
"""Largest norm of a step's gradient."""


@dataclass(frozen=True)
class Unfinished:
    """Where a fit keeps its state.

    Attributes:
        folder: of the state, held by the fit while it runs.
        identity: digests that a saved state must share to be used (settings, inputs, code).
        name: shown with the progress.
        save_seconds: longest time between two saved states.
    """

    folder: Path
    identity: dict[str, str]
    name: str
    save_seconds: float = 20.0

    @property
    def state(self) -> Path:
        return self.folder / "state.pt"


class Best:
    """The weights at which a measure, looked at now and then, was lowest; the first ones count.

    Attributes:
        value: that measure.
        step: at which it was.
    """

    def __init__(self, flow: nn.Module, measure: Callable[[], float], every: int, patience: int):
        self.measure, self.every, self.patience = measure, every, patience
        self.value, self.step = measure(), 0
        self.weights = copy.deepcopy(flow.state_dict())

    def look(self, flow: nn.Module, step: int) -> bool:
        """Take the weights after ``step`` if they are better; True where none were for too long."""
        value = self.measure()
        if value < self.value:
            self.value, self.step = value, step
            self.weights = copy.deepcopy(flow.state_dict())
            return False
        return step - self.step >= self.patience

    def state_dict(self) -> dict:
        return {"value": self.value, "step": self.step, "weights": self.weights}

    def load_state_dict(self, state: dict) -> None:
        self.value, self.step, self.weights = state["value"], state["step"], state["weights"]


@dataclass(frozen=True, eq=False)
class Ascent:
    """What is stepped uphill, and how.

    Attributes:
        flow: whose parameters ``optimiser`` steps.
        log_density: of rows (B, F), (B,).
        optimiser: of the flow's parameters.
        schedule: of the learning rate, a step at a time.
        best: ends the fit early, and its weights are those the flow is left with.
    """

    flow: nn.Module
    log_density: Callable[[Tensor], Tensor]
    optimiser: torch.optim.Optimizer
    schedule: LRScheduler | None = None
    best: Best | None = None

    def step(self, rows: Tensor) -> float:
        """One step towards the highest mean log density of some rows; its loss."""
        loss = -self.log_density(rows).mean()
        self.optimiser.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(self.flow.parameters(), CLIP)
        self.optimiser.step()
        if self.schedule is not None:
            self.schedule.step()
        return loss.item()

    def is_done(self, step: int, steps: int) -> bool:
        """Whether ``step`` is the last of at most ``steps``."""
        last = step == steps
        if self.best is not None and (last or step % self.best.every == 0):
            return self.best.look(self.flow, step) or last
        return last

    def state_dict(self) -> dict[str, dict]:
        return {name: part.state_dict() for name, part in self._parts().items()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        for name, part in self._parts().items():
            part.load_state_dict(state[name])

    def _parts(self) -> dict[str, Any]:
        names = ("flow", "optimiser", "schedule", "best")
        return {name: part for name in names if (part := getattr(self, name)) is not None}


def maximise_likelihood(
    ascent: Ascent,
    draw: Callable[[torch.Generator], Tensor],
    *,
    steps: int,
    seed: int,
    unfinished: Unfinished | None = None,
) -> None:
    """Step a flow's parameters, in place, towards the highest mean log density of drawn rows.

    Args:
        ascent: the flow, its density and its optimiser.
        draw: a step's rows, with the numbers of the generator that it is given.
        steps: at most so many.
        seed: of the generator.
        unfinished: where the state is kept; on a CPU a fit that was stopped, however, goes on from
            there to the same parameters, bit for bit. None where it need not be kept.

    Raises:
        Interrupted: SIGTERM or SIGINT came, and the state is saved.
        DineError: another process fits in the folder.
    """
    generator = torch.Generator().manual_seed(seed)
    with contextlib.ExitStack() as stack:
        kept, start, name = None, 0, "fit"
        if unfinished is not None:
            stop = stack.enter_context(StopRequest())
            stack.enter_context(one_writer(unfinished.folder, unfinished.identity))
            kept = _Kept(unfinished, ascent, generator, stop)
            start, name = kept.resume(), unfinished.name
        progress = stack.enter_context(Progress(name, steps, start, quiet=unfinished is None))
        for step in range(start + 1, steps + 1):
            progress.update(1, loss=ascent.step(draw(generator)))
            if ascent.is_done(step, steps):
                break
            if kept is not None:
                kept.after(step, steps)
    if ascent.best is not None:
        ascent.flow.load_state_dict(ascent.best.weights)


class _Kept:
    """The state of a fit, saved now and then and when the fit is to stop."""

    def __init__(
        self, where: Unfinished, ascent: Ascent, generator: torch.Generator, stop: StopRequest
    ):
        self.where, self.ascent, self.generator, self.stop = where, ascent, generator, stop

    def resume(self) -> int:
        """Take over a saved state, if there is one of this fit; steps that are done."""
        state, message = load_state(self.where.state, self.where.identity)
        log.info("%s: %s", self.where.name, message)
        self.saved = time.monotonic()
        if state is None:
            return 0
        self.ascent.load_state_dict(state)
        self.generator.set_state(state["generator"])
        return state["step"]

    def after(self, step: int, steps: int) -> None:
        """Save after a step if that is due.

        Raises:
            Interrupted: the fit was asked to stop; the state is saved.
        """
        stopping = self.stop.signal is not None
        if stopping or time.monotonic() - self.saved > self.where.save_seconds:
            state = self.ascent.state_dict() | {
                "identity": self.where.identity,
                "step": step,
                "generator": self.generator.get_state(),
            }
            save_state(self.where.state, state)
            self.saved = time.monotonic()
        if stopping:
            raise Interrupted(
                f"{self.where.name} was stopped after step {step} of {steps}; run the same "
                "command again to go on from there."
            )
