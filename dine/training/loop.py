"""The training loop: deterministic in its seed, interruptible at any moment.

All randomness is a function of (seed, step), never of a generator's running state, so a resumed run
takes exactly the steps that an undisturbed one would have taken.
"""

from __future__ import annotations

import csv
import io
import logging
import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch

from dine.config import Training
from dine.data.batch import GRAPH_NEIGHBOURS, Batch, make_batch
from dine.data.pairs import PairSet
from dine.errors import DataError, DineError
from dine.files import write_text
from dine.geometry.chamfer import chamfer_distance
from dine.geometry.graph import Graph, neighbour_graph
from dine.models.backbones import Backbone
from dine.progress import Progress
from dine.training.objective import Objective
from dine.training.state import Interrupted, StopRequest, load_state, one_writer, save_state

log = logging.getLogger(__name__)

HISTORY_COLUMNS = ("step", "loss", "data", "penalty", "grad_norm", "learning_rate", "seconds")
VALIDATION_COLUMNS = ("val_cd", "val_mce")


class Batches:
    """Batches of a pair set, with the sources' graphs made once per distinct source."""

    def __init__(self, pairs: PairSet, device: torch.device):
        self.pairs = pairs
        self.device = device
        self._graphs: dict[bytes, Graph] = {}

    def __len__(self) -> int:
        return len(self.pairs)

    def _graph(self, index: int) -> Graph:
        source = self.pairs.source[index]
        key = source.tobytes()
        if key not in self._graphs:
            self._graphs[key] = neighbour_graph(source, GRAPH_NEIGHBOURS)
        return self._graphs[key]

    def get(
        self,
        indices: np.ndarray,
        rng: np.random.Generator | None = None,
        targets: np.ndarray | None = None,
    ) -> tuple[Batch, torch.Tensor]:
        """A batch and its true displacements (B, N, 3).

        With ``rng`` every target's point order is shuffled, so that a network cannot learn the
        correspondence from the order. ``targets`` (P, M, 3) stands in for the clean targets.
        """
        clouds = [(self.pairs.target if targets is None else targets)[i] for i in indices]
        if rng is not None:
            clouds = [cloud[rng.permutation(len(cloud))] for cloud in clouds]
        batch = make_batch(
            [self.pairs.source[i] for i in indices], clouds, [self._graph(i) for i in indices]
        )
        truth = torch.from_numpy(self.pairs.target[indices] - self.pairs.source[indices])
        return batch.to(self.device), truth.to(self.device)


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


def order_of(step: int, batch_size: int, count: int, seed: int) -> np.ndarray:
    """Pair indices of one step: each epoch is a fresh permutation that depends on the seed only."""
    positions = np.arange(step * batch_size, (step + 1) * batch_size)
    epochs = positions // count
    orders = {e: np.random.default_rng([seed, 0, e]).permutation(count) for e in np.unique(epochs)}
    return np.array([orders[e][p] for e, p in zip(epochs, positions % count, strict=True)])


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
    """Mean Chamfer distance and correspondence error over some validation pairs."""
    backbone.eval()
    distances, errors = [], []
    for index in spread(len(batches), wanted):
        batch, truth = batches.get(np.array([index]), np.random.default_rng([1, index]))
        displacement = backbone(batch).displacement
        moved = batch.source + displacement
        distances.append(chamfer_distance(moved, batch.target).item())
        errors.append((displacement - truth).norm(dim=-1).mean().item())
    backbone.train()
    return {"val_cd": float(np.mean(distances)), "val_mce": float(np.mean(errors))}


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
    device: str = "auto",
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
        device: ``auto``, ``cpu`` or ``cuda``.
        on_step: called after each step (tests interrupt there).

    Returns:
        One row per step: step, loss, data, penalty, gradient norm, learning rate, seconds; every
        validation adds ``val_cd`` and ``val_mce`` to its row.

    Raises:
        Interrupted: SIGTERM or SIGINT came; the state is saved.
        DineError: the folder is in use, or the loss stopped being finite.
    """
    for split, pairs in (("train", train_pairs), ("validation", val_pairs)):
        if len(pairs) == 0:
            raise DataError(f"There are no {split} pairs; the dataset has too few base objects.")
    target = chosen_device(device)
    backbone.to(target).train()
    if objective.prior is not None:
        objective.prior.to(target)
    optimiser = torch.optim.AdamW(
        backbone.parameters(), lr=settings.learning_rate, weight_decay=settings.weight_decay
    )
    batches, val_batches = Batches(train_pairs, target), Batches(val_pairs, target)
    path = folder / "state.pt"
    with one_writer(folder):
        state, message = load_state(path, identity)
        log.info("%s: %s", name, message)
        start, history = 0, []
        if state is not None:
            backbone.load_state_dict(state["model"])
            optimiser.load_state_dict(state["optimiser"])
            start, history = state["step"], state["history"]

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
            write_text(folder / "history.csv", history_csv(history))

        saved = time.monotonic()
        elapsed = history[-1]["seconds"] if history else 0.0
        began = time.monotonic() - elapsed
        with StopRequest() as stop, Progress(name, settings.steps, start) as progress:
            for step in range(start, settings.steps):
                rate = learning_rate(settings, step)
                for group in optimiser.param_groups:
                    group["lr"] = rate
                indices = order_of(step, settings.batch_size, len(batches), seed)
                batch, truth = batches.get(indices, np.random.default_rng([seed, 1, step]))
                loss, parts = objective(batch, backbone(batch).displacement, truth)
                optimiser.zero_grad(set_to_none=True)
                loss.backward()
                norm = torch.nn.utils.clip_grad_norm_(backbone.parameters(), settings.clip)
                value = loss.item()
                if not math.isfinite(value + norm.item()):
                    raise DineError(
                        f"{name} diverged at step {step}: loss {value}, gradient norm "
                        f"{norm.item()}; lower learning_rate or the prior's weight."
                    )
                optimiser.step()
                row = {
                    "step": step + 1,
                    "loss": value,
                    **parts,
                    "grad_norm": norm.item(),
                    "learning_rate": rate,
                    "seconds": time.monotonic() - began,
                }
                last = step + 1 == settings.steps
                if last or (step + 1) % settings.validate_every == 0:
                    row |= validate(backbone, val_batches, settings.validation_pairs)
                history.append(row)
                progress.update(1, loss=np.mean([r["loss"] for r in history[-50:]]))
                if on_step is not None:
                    on_step(step)
                if last or stop.signal or time.monotonic() - saved > settings.save_seconds:
                    save(step + 1)
                    saved = time.monotonic()
                if stop.signal and not last:
                    raise Interrupted(
                        f"{name} was stopped after step {step + 1} of {settings.steps}; run the "
                        "same command again to go on from there."
                    )
    return history
