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
from pathlib import Path
from typing import Any

import numpy as np
import torch

from dine.config import Training, check_shares
from dine.data.loading import Batches, Request
from dine.data.pairs import PairSet
from dine.errors import ConfigError, DataError, DineError
from dine.evaluation.quality import roughness
from dine.files import write_text
from dine.geometry.chamfer import chamfer_distance
from dine.models.backbones import Backbone
from dine.models.devices import chosen_device, leased
from dine.models.state import Interrupted, StopRequest, load_state, one_writer, save_state
from dine.progress import Progress
from dine.results import Network
from dine.training.objective import Loss, Objective
from dine.training.parallel import Alone, Team, run_together

log = logging.getLogger(__name__)

STATE = "state.pt"
MEASURED = ("loss", "data", "penalty", "grad_norm")
HISTORY_COLUMNS = ("step", *MEASURED, "learning_rate", "seconds")
VALIDATION_COLUMNS = ("val_cd", "val_mce", "val_roughness")


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
    if settings.schedule == "constant":
        return settings.learning_rate
    cosine = 0.5 * (1 + math.cos(math.pi * step / settings.steps))
    return settings.learning_rate * (0.01 + 0.99 * cosine)


def spread(count: int, wanted: int) -> np.ndarray:
    """At most ``wanted`` of ``count`` indices, evenly spread."""
    return np.unique(np.linspace(0, count - 1, min(wanted, count)).round().astype(int))


@torch.no_grad()
def validate(backbone: Backbone, batches: Batches, wanted: int) -> dict[str, float]:
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
    writer = csv.DictWriter(stream, [*HISTORY_COLUMNS, *VALIDATION_COLUMNS], lineterminator="\n")
    writer.writeheader()
    for row in history:
        writer.writerow(
            {k: format(v, ".8g") if isinstance(v, float) else v for k, v in row.items()}
        )
    return stream.getvalue()


def train(
    backbone: Backbone,
    objective: Objective,
    train_pairs: PairSet,
    val_pairs: PairSet,
    settings: Training,
    *,
    seed: int,
    folder: Path,
    identity: dict[str, str],
    name: str,
    train_targets: np.ndarray | None = None,
    val_targets: np.ndarray | None = None,
    device: str = "auto",
    processes: int = 1,
    on_step: Callable[[int], None] | None = None,
) -> list[dict[str, Any]]:
    """Train in place, resuming from ``folder`` when its state has the same ``identity``.

    Args:
        backbone: trained in place; its initial weights are part of the identity.
        objective: what is minimised.
        train_pairs: cycled through in an order drawn from the seed.
        val_pairs: measured every ``settings.validate_every`` steps; never trained on.
        settings: steps, rates and the rest.
        seed: of the order of pairs and of the targets' points.
        folder: where state and running history are kept.
        identity: digests that a saved state must share to be used (settings, inputs, code).
        name: shown with the progress.
        train_targets: (P, M, 3), stand in for the training pairs' own targets.
        val_targets: likewise for the validation pairs.
        device: ``auto``, ``cpu`` or ``cuda``.
        processes: that share every batch, on all nodes together; on CUDA each has a device of its
            own. Their number changes the result by rounding only, and is no part of the identity.
        on_step: called after each step (tests interrupt there).

    Returns:
        One row per step: step, loss, data, penalty, gradient norm, learning rate, seconds; every
        validation adds ``val_cd`` and ``val_mce`` to its row.

    Raises:
        Interrupted: SIGTERM or SIGINT came; the state is saved.
        ConfigError: the processes cannot share a batch equally.
        DineError: the folder is in use, a process died, or the loss stopped being finite.
    """
    for split, pairs in (("train", train_pairs), ("validation", val_pairs)):
        if len(pairs) == 0:
            raise DataError(f"There are no {split} pairs; the dataset has too few base objects.")
    try:
        check_shares(settings.batch_size, processes)
    except ValueError as error:
        raise ConfigError(f"{error}.") from None
    work = functools.partial(
        _train,
        backbone=backbone,
        objective=objective,
        train_pairs=train_pairs,
        val_pairs=val_pairs,
        train_targets=train_targets,
        val_targets=val_targets,
        settings=settings,
        seed=seed,
        folder=folder,
        identity=identity,
        name=name,
        on_step=on_step,
    )
    chosen = chosen_device(device)
    if processes == 1:
        with leased(chosen) as devices, StopRequest() as stop:
            return work(Alone(devices[0], stop))
    run_together(processes, chosen, work)
    state, _ = load_state(folder / STATE, identity)
    backbone.load_state_dict(state["model"])
    return state["history"]


def _train(
    team: Team,
    *,
    backbone: Backbone,
    objective: Objective,
    train_pairs: PairSet,
    val_pairs: PairSet,
    train_targets: np.ndarray | None,
    val_targets: np.ndarray | None,
    settings: Training,
    seed: int,
    folder: Path,
    identity: dict[str, str],
    name: str,
    on_step: Callable[[int], None] | None,
) -> list[dict[str, Any]]:
    """One process's part of :func:`train`."""
    backbone.to(team.device).train()
    if objective.prior is not None:
        objective.prior.to(team.device)
    optimiser = torch.optim.AdamW(
        backbone.parameters(),
        lr=settings.learning_rate,
        weight_decay=settings.weight_decay,
        fused=True,
    )
    batches = Batches(train_pairs, team.device, train_targets, settings.parts)
    val_batches = Batches(val_pairs, team.device, val_targets)
    path = folder / STATE
    with one_writer(folder, identity) if team.leads else contextlib.nullcontext():
        team.wait()  # until the folder is ours
        state, message = load_state(path, identity)
        log.info("%s: %s", name, message)
        start, history = 0, []
        if state is not None:
            backbone.load_state_dict(state["model"])
            optimiser.load_state_dict(state["optimiser"])
            start, history = state["step"], state["history"]
        loss_of = team.share(Loss(backbone, objective))

        def save(step: int) -> None:
            save_state(
                path,
                {
                    "identity": identity,
                    "step": step,
                    "model": backbone.state_dict(),
                    "optimiser": optimiser.state_dict(),
                    "history": history,
                },
            )
            write_text(Network(folder).history, history_csv(history))

        saved = time.monotonic()
        elapsed = history[-1]["seconds"] if history else 0.0
        began = time.monotonic() - elapsed
        steps = range(start, settings.steps)
        stream = batches.stream(
            share_of(team, step, settings.batch_size, len(batches), seed) for step in steps
        )
        with (
            torch.random.fork_rng(devices=[]),
            contextlib.closing(stream),
            Progress(name, settings.steps, start, quiet=not team.leads) as progress,
        ):
            for step, (batch, truth) in zip(steps, stream, strict=True):
                seed_torch(seed, step, team.rank)
                rate = learning_rate(settings, step)
                for group in optimiser.param_groups:
                    group["lr"] = rate
                loss, data, penalty = loss_of(batch, truth)
                optimiser.zero_grad(set_to_none=True)
                loss.backward()
                norm = torch.nn.utils.clip_grad_norm_(backbone.parameters(), settings.clip)
                # All numbers in one transfer: on a GPU each of its own would stall the step.
                values = team.mean(torch.stack([loss.detach(), data, penalty, norm]))
                measured = dict(zip(MEASURED, values, strict=True))
                if not all(map(math.isfinite, values)):
                    raise DineError(
                        f"{name} diverged at step {step}: loss {measured['loss']}, gradient norm "
                        f"{measured['grad_norm']}; lower learning_rate or the prior's weight."
                    )
                optimiser.step()
                row = {
                    "step": step + 1,
                    **measured,
                    "learning_rate": rate,
                    "seconds": time.monotonic() - began,
                }
                history.append(row)
                last = step + 1 == settings.steps
                if team.leads:
                    if last or (step + 1) % settings.validate_every == 0:
                        row |= validate(backbone, val_batches, settings.validation_pairs)
                    progress.update(1, loss=np.mean([r["loss"] for r in history[-50:]]))
                    if on_step is not None:
                        on_step(step)
                stopping = team.stopping
                late = time.monotonic() - saved > settings.save_seconds
                if team.leads and (last or late or stopping):
                    save(step + 1)
                    saved = time.monotonic()
                if stopping and not last:
                    team.wait()  # until the state is saved
                    raise Interrupted(
                        f"{name} was stopped after step {step + 1} of {settings.steps}; run the "
                        "same command again to go on from there."
                    )
    team.wait()  # until the last state is saved, which other nodes read
    return history
