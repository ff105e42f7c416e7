"""Maximum-likelihood fits in steps, as of flows: they can be stopped and gone on with."""

from __future__ import annotations

import contextlib
import copy
import logging
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor, nn
from torch.optim.lr_scheduler import LRScheduler

from dine.models.state import Interrupted, StopRequest, load_state, one_writer, save_state
from dine.progress import Progress

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


def maximise_likelihood(
    flow: nn.Module,
    log_density: Callable[[Tensor], Tensor],
    draw: Callable[[torch.Generator], Tensor],
    optimiser: torch.optim.Optimizer,
    *,
    steps: int,
    seed: int,
    schedule: LRScheduler | None = None,
    best: Best | None = None,
    unfinished: Unfinished | None = None,
) -> None:
    """Step a flow's parameters, in place, towards the highest mean log density of drawn rows.

    Args:
        flow: whose parameters ``optimiser`` steps.
        log_density: of rows (B, F), (B,).
        draw: a step's rows, with the numbers of the generator that it is given.
        optimiser: steps.
        steps: at most so many.
        seed: of the generator.
        schedule: of the learning rate, a step at a time.
        best: ends the fit early, and its weights are those the flow is left with.
        unfinished: where the state is kept; on a CPU a fit that was stopped, however, goes on from
            there to the same parameters, bit for bit. None where it need not be kept.

    Raises:
        Interrupted: SIGTERM or SIGINT came, and the state is saved.
        DineError: another process fits in the folder.
    """
    generator = torch.Generator().manual_seed(seed)
    parts = {"flow": flow, "optimiser": optimiser, "schedule": schedule, "best": best}
    parts = {name: part for name, part in parts.items() if part is not None}
    start = 0
    with contextlib.ExitStack() as stack:
        stop = None
        if unfinished is not None:
            stop = stack.enter_context(StopRequest())
            stack.enter_context(one_writer(unfinished.folder, unfinished.identity))
            state, message = load_state(unfinished.state, unfinished.identity)
            log.info("%s: %s", unfinished.name, message)
            if state is not None:
                for name, part in parts.items():
                    part.load_state_dict(state[name])
                generator.set_state(state["generator"])
                start = state["step"]
        name = "fit" if unfinished is None else unfinished.name
        progress = stack.enter_context(Progress(name, steps, start, quiet=unfinished is None))
        saved = time.monotonic()
        for step in range(start + 1, steps + 1):
            loss = -log_density(draw(generator)).mean()
            optimiser.zero_grad()
            loss.backward()
            torch.nn.utils.clip_grad_norm_(flow.parameters(), CLIP)
            optimiser.step()
            if schedule is not None:
                schedule.step()
            progress.update(1, loss=loss.item())
            last = step == steps
            if best is not None and (last or step % best.every == 0):
                last |= best.look(flow, step)
            if last:
                break
            stopping = stop is not None and stop.signal is not None
            if unfinished is not None and (
                stopping or time.monotonic() - saved > unfinished.save_seconds
            ):
                state = {name: part.state_dict() for name, part in parts.items()}
                state |= {
                    "identity": unfinished.identity,
                    "step": step,
                    "generator": generator.get_state(),
                }
                save_state(unfinished.state, state)
                saved = time.monotonic()
            if stopping:
                raise Interrupted(
                    f"{unfinished.name} was stopped after step {step} of {steps}; run the same "
                    "command again to go on from there."
                )
    if best is not None:
        flow.load_state_dict(best.weights)
