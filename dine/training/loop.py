"""The training loop: deterministic in its seed, interruptible at any moment.

All randomness is a function of (seed, step), never of a generator's running state, so a resumed run
takes exactly the steps that an undisturbed one would have taken.
"""

from __future__ import annotations

import contextlib
import csv
import functools
import io
import logging
import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from dine.config import Training, check_shares
from dine.data.batch import Batch
from dine.data.loading import Batches, Request
from dine.data.pairs import PairSet
from dine.errors import ConfigError, DataError, DineError
from dine.files import write_text
from dine.geometry.chamfer import chamfer_distance
from dine.geometry.folding import roughness
from dine.models.backbones import Backbone
from dine.models.devices import chosen_device, leased
from dine.optimiser import AdamW
from dine.progress import Progress
from dine.results import Network
from dine.state import Interrupted, StopRequest, load_state, one_writer, save_state
from dine.training.objective import Loss, Objective
from dine.training.parallel import Alone, Team, run_together

log = logging.getLogger(__name__)

STATE = "state.pt"
MEASURED = ("loss", "data", "penalty", "grad_norm")
HISTORY_COLUMNS = ("step", *MEASURED, "learning_rate", "seconds")
VALIDATION_COLUMNS = ("val_cd", "val_mce", "val_roughness")
KEPT = "kept_step"
"""In the last row of the history: the step whose weights are kept, where these are the best."""


def order_of(step: int, batch_size: int, count: int, seed: int) -> np.ndarray:
    """Pair indices of one step: each epoch is a fresh permutation that depends on the seed only."""
    positions = np.arange(step * batch_size, (step + 1) * batch_size)
    epochs = positions // count
    orders = {e: np.random.default_rng([seed, 0, e]).permutation(count) for e in np.unique(epochs)}
    return np.array([orders[e][p] for e, p in zip(epochs, positions % count, strict=True)])


def seed_torch(seed: int, step: int, rank: int) -> None:
    """Seed what a backbone may draw in a step, such as dropout."""
    state = np.random.SeedSequence([seed, 3, step, rank]).generate_state(1, np.uint64)
    torch.manual_seed(int(state[0]))


def share_of(team: Team, step: int, batch_size: int, count: int, seed: int) -> Request:
    """What one process takes of a step's batch."""
    positions = np.split(np.arange(batch_size), team.size)[team.rank]
    return (
        order_of(step, batch_size, count, seed)[positions],
        [(seed, 1, step, position) for position in positions],
    )


def learning_rate(settings: Training, step: int) -> float:
    """The scheduled rate of a step."""
    rate = settings.learning_rate * min(1.0, (step + 1) / (settings.warmup + 1))
    if settings.schedule == "constant":
        return rate
    cosine = 0.5 * (1 + math.cos(math.pi * step / settings.steps))
    return rate * (0.01 + 0.99 * cosine)


def spread(count: int, wanted: int) -> np.ndarray:
    """At most ``wanted`` of ``count`` indices, evenly spread."""
    return np.unique(np.linspace(0, count - 1, min(wanted, count)).round().astype(int))


@torch.no_grad()
def validation_errors(backbone: Backbone, batches: Batches, wanted: int) -> dict[str, float]:
    """Mean Chamfer distance, correspondence error and roughness over some validation pairs."""
    backbone.eval()
    values = []
    rough = []
    requests = (([index], [(1, index)]) for index in spread(len(batches), wanted))
    for batch, truth in batches.stream(requests):
        displacement = backbone(batch).displacement
        distance = chamfer_distance(batch.source + displacement, batch.target)
        error = (displacement - truth).norm(dim=-1)
        values.append(torch.stack([distance.mean(), error.mean()]))
        points, field = (x[0].double().cpu().numpy() for x in (batch.source, displacement))
        rough.append(roughness(points, field))
    backbone.train()
    distance, error = np.mean(torch.stack(values).tolist(), axis=0).tolist()
    return {"val_cd": distance, "val_mce": error, "val_roughness": float(np.mean(rough))}


def history_csv(history: list[dict[str, Any]]) -> str:
    """The history as CSV text."""
    stream = io.StringIO()
    columns = [*HISTORY_COLUMNS, *VALIDATION_COLUMNS, KEPT]
    writer = csv.DictWriter(stream, columns, lineterminator="\n")
    writer.writeheader()
    for row in history:
        writer.writerow(
            {k: format(v, ".8g") if isinstance(v, float) else v for k, v in row.items()}
        )
    return stream.getvalue()


@dataclass(frozen=True)
class Seen:
    """Pairs, and targets (P, M, 3) that stand in for their own, if there are any."""

    pairs: PairSet
    targets: np.ndarray | None = None

    def batches(self, device: torch.device, parts: float = 0.0) -> Batches:
        """For training or validation; see :class:`~dine.data.loading.Batches`."""
        return Batches(self.pairs, device, self.targets, parts)


@dataclass(frozen=True)
class TrainingJob:
    """One training, apart from the network and the pairs.

    Attributes:
        objective: what is minimised.
        settings: steps, rates and the rest.
        seed: of the order of pairs and of the targets' points.
        folder: where state and running history are kept.
        identity: digests that a saved state must share to be used (settings, inputs, code).
        name: shown with the progress.
    """

    objective: Objective
    settings: Training
    seed: int
    folder: Path
    identity: dict[str, str]
    name: str

    @property
    def state(self) -> Path:
        return self.folder / STATE


def train(
    backbone: Backbone,
    job: TrainingJob,
    seen: Seen,
    validated: Seen,
    *,
    device: str = "auto",
    processes: int = 1,
    on_step: Callable[[int], None] | None = None,
) -> list[dict[str, Any]]:
    """Train in place, resuming from the job's folder when its state has the same identity.

    Args:
        backbone: trained in place; its initial weights are part of the identity.
        job: what to minimise, how, and where the state is kept.
        seen: pairs that are trained on, cycled through in an order drawn from the seed.
        validated: measured every ``validate_every`` steps; never trained on.
        device: ``auto``, ``cpu`` or ``cuda``.
        processes: that share every batch, on all nodes together; on CUDA each has a device of its
            own. Their number changes the result by rounding only, and is no part of the identity.
        on_step: called after each step (tests interrupt there).

    Returns:
        One row per step: step, loss, data, penalty, gradient norm, learning rate, seconds; every
        validation adds ``val_cd`` and ``val_mce`` to its row; the last has ``kept_step``, the step
        whose weights are kept, if these are the best.

    Raises:
        Interrupted: SIGTERM or SIGINT came; the state is saved.
        ConfigError: the processes cannot share a batch equally.
        DineError: the folder is in use, a process died, or the loss stopped being finite.
    """
    for split, some in (("train", seen), ("validation", validated)):
        if len(some.pairs) == 0:
            raise DataError(f"There are no {split} pairs; the dataset has too few base objects.")
    try:
        check_shares(job.settings.batch_size, processes)
    except ValueError as error:
        raise ConfigError(f"{error}.") from None
    work = functools.partial(
        _train, backbone=backbone, job=job, seen=seen, validated=validated, on_step=on_step
    )
    chosen = chosen_device(device)
    if processes == 1:
        with leased(chosen) as devices, StopRequest() as stop:
            return work(Alone(devices[0], stop))
    run_together(processes, chosen, work)
    state, _ = load_state(job.state, job.identity)
    backbone.load_state_dict(state["model"])
    return state["history"]


def _train(
    team: Team,
    *,
    backbone: Backbone,
    job: TrainingJob,
    seen: Seen,
    validated: Seen,
    on_step: Callable[[int], None] | None,
) -> list[dict[str, Any]]:
    """One process's part of :func:`train`."""
    with one_writer(job.folder, job.identity) if team.leads else contextlib.nullcontext():
        team.wait()  # until the folder is ours
        trainer = _Trainer(team, backbone, job)
        start = trainer.resume()
        trainer.take_steps(start, seen, validated.batches(team.device), on_step)
    team.wait()  # until the last state is saved, which other nodes read
    return trainer.history


class _Trainer:
    """One process's network and optimiser, and what was measured so far."""

    def __init__(self, team: Team, backbone: Backbone, job: TrainingJob):
        self.team, self.backbone, self.job = team, backbone, job
        self.history: list[dict[str, Any]] = []
        self.best: dict[str, Any] | None = None
        """Step, error and weights of the best validation, where those are kept."""
        backbone.to(team.device).train()
        if job.objective.prior is not None:
            job.objective.prior.to(team.device)
        self.optimiser = AdamW(
            backbone.parameters(),
            lr=job.settings.learning_rate,
            weight_decay=job.settings.weight_decay,
            fused=True,
        )

    def resume(self) -> int:
        """Take over a saved state, if there is one of this job; steps that are done."""
        state, message = load_state(self.job.state, self.job.identity)
        log.info("%s: %s", self.job.name, message)
        if state is None:
            return 0
        self.backbone.load_state_dict(state["model"])
        self.optimiser.load_state_dict(state["optimiser"])
        self.history, self.best = state["history"], state["best"]
        return state["step"]

    def save(self, step: int) -> None:
        """State and history after so many steps."""
        save_state(
            self.job.state,
            {
                "identity": self.job.identity,
                "step": step,
                "model": self.backbone.state_dict(),
                "optimiser": self.optimiser.state_dict(),
                "history": self.history,
                "best": self.best,
            },
        )
        write_text(Network(self.job.folder).history, history_csv(self.history))

    def take_steps(
        self, start: int, seen: Seen, validated: Batches, on_step: Callable[[int], None] | None
    ) -> None:
        """All steps from ``start`` on; see :func:`train`."""
        team, job, settings = self.team, self.job, self.job.settings
        batches = seen.batches(team.device, settings.parts)
        loss_of = team.share(Loss(self.backbone, job.objective))
        steps = range(start, settings.steps)
        stream = batches.stream(
            share_of(team, step, settings.batch_size, len(batches), job.seed) for step in steps
        )
        saved = time.monotonic()
        began = saved - (self.history[-1]["seconds"] if self.history else 0.0)
        with (
            torch.random.fork_rng(devices=[]),
            contextlib.closing(stream),
            Progress(job.name, settings.steps, start, quiet=not team.leads) as progress,
        ):
            if team.leads and start == 0 and settings.keep == "best":
                self._validated(0, validated)
            for step, (batch, truth) in zip(steps, stream, strict=True):
                row = self._step(step, loss_of, batch, truth)
                row["seconds"] = time.monotonic() - began
                self.history.append(row)
                last = step + 1 == settings.steps
                if team.leads:
                    if last or (step + 1) % settings.validate_every == 0:
                        row |= self._validated(step + 1, validated)
                    progress.update(1, loss=np.mean([r["loss"] for r in self.history[-50:]]))
                    if on_step is not None:
                        on_step(step)
                stopping = team.stopping
                late = time.monotonic() - saved > settings.save_seconds
                if team.leads and last and self.best is not None:
                    row[KEPT] = self.best["step"]
                    self.backbone.load_state_dict(self.best["model"])
                if team.leads and (last or late or stopping):
                    self.save(step + 1)
                    saved = time.monotonic()
                if stopping and not last:
                    team.wait()  # until the state is saved
                    raise Interrupted(
                        f"{job.name} was stopped after step {step + 1} of {settings.steps}; run "
                        "the same command again to go on from there."
                    )

    def _validated(self, step: int, validated: Batches) -> dict[str, float]:
        """Errors after so many steps, whose weights are remembered if they are the best so far."""
        settings = self.job.settings
        found = validation_errors(self.backbone, validated, settings.validation_pairs)
        better = self.best is None or found["val_cd"] < self.best["val_cd"]
        if settings.keep == "best" and better:
            model = {name: x.detach().clone() for name, x in self.backbone.state_dict().items()}
            self.best = {"step": step, "val_cd": found["val_cd"], "model": model}
        return found

    def _step(
        self, step: int, loss_of: Callable[..., tuple[Tensor, ...]], batch: Batch, truth: Tensor
    ) -> dict[str, Any]:
        """One step of the optimiser, and its row of the history but for the time."""
        job = self.job
        seed_torch(job.seed, step, self.team.rank)
        rate = learning_rate(job.settings, step)
        for group in self.optimiser.param_groups:
            group["lr"] = rate
        loss, data, penalty = loss_of(batch, truth)
        self.optimiser.zero_grad(set_to_none=True)
        loss.backward()
        norm = torch.nn.utils.clip_grad_norm_(self.backbone.parameters(), job.settings.clip)
        # All numbers in one transfer: on a GPU each of its own would stall the step.
        values = self.team.mean(torch.stack([loss.detach(), data, penalty, norm]))
        measured = dict(zip(MEASURED, values, strict=True))
        if not all(map(math.isfinite, values)):
            raise DineError(
                f"{job.name} diverged at step {step}: loss {measured['loss']}, gradient norm "
                f"{measured['grad_norm']}; lower learning_rate or the prior's weight."
            )
        self.optimiser.step()
        return {"step": step + 1, **measured, "learning_rate": rate}
