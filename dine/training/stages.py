"""What all trainings share, from files to files; Stage 1 and pretraining."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from dine.config import BackboneConfig, Compute, Stage1, Training
from dine.data.pairs import PairSet, read_seen
from dine.errors import CheckpointError, ConfigError
from dine.files import digest, file_digest, write_json, write_text
from dine.models.backbones import BACKBONES, Backbone
from dine.models.checkpoint import load_backbone, save_backbone, shipped_weights
from dine.models.devices import chosen_device
from dine.models.inference import COMPUTE
from dine.provenance import code_digest, run_record
from dine.results import Network
from dine.state import check_still_wanted
from dine.training.data_terms import DATA_TERMS
from dine.training.loop import Seen, TrainingJob, history_csv, train
from dine.training.objective import Objective


def new_backbone(kind: str, arguments: dict[str, Any], seed: int) -> Backbone:
    """A backbone with random weights that depend on the seed only."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        try:
            return BACKBONES.get(kind)(**arguments)
        except TypeError as error:
            raise ConfigError(
                f"The backbone {kind!r} does not take these arguments: {error}."
            ) from None


def starting_backbone(kind: str, arguments: dict[str, Any], start: str, seed: int) -> Backbone:
    """Stage 1's first weights: ``random``, ``pretrained``, or a file.

    Raises:
        CheckpointError: the file holds another backbone, or other arguments than asked for.
    """
    backbone = new_backbone(kind, arguments, seed)
    if start == "random":
        return backbone
    path = shipped_weights(kind) if start == "pretrained" else Path(start)
    given, _ = load_backbone(path)
    # How random weights start is no matter where weights are given.
    theirs, ours = ({**x.arguments, "initialisation": None} for x in (given, backbone))
    if given.registered_name != backbone.registered_name or theirs != ours:
        raise CheckpointError(
            f"{path} holds {given.registered_name} with {given.arguments}; the configuration asks "
            f"for {backbone.registered_name} with {backbone.arguments}."
        )
    return given


@dataclass(frozen=True)
class Order:
    """Who asks for a training, and where its results go.

    Attributes:
        seed: of initial weights and of the order of pairs.
        out: the folder of the results.
        name: shown with the progress.
        compute: how to compute.
    """

    seed: int
    out: Path
    name: str
    compute: Compute = COMPUTE


@dataclass(frozen=True)
class Start:
    """What a training starts from.

    Attributes:
        step: the command whose code a saved state is bound to, with that of the classes picked by
            name.
        backbone: trained in place.
        objective: what is minimised.
        inputs: digests of what the start depends on.
        facts: for the record.
    """

    step: str
    backbone: Backbone
    objective: Objective
    inputs: dict[str, Any]
    facts: dict[str, Any]


def run(
    start: Start,
    settings: Training,
    order: Order,
    pairs: list[Path],
    targets: list[Path] | None = None,
) -> None:
    """Train and write ``model.safetensors``, ``history.csv`` and ``run.json``.

    Where there are other targets, every pair is trained on twice: with its own and with that.
    """
    compute, name, backbone = order.compute, order.name, start.backbone
    inputs = {"pairs": [file_digest(path) for path in pairs], **start.inputs}
    if targets:
        inputs["targets"] = [file_digest(path) for path in targets]
    identity = _identity(start, settings, order, inputs)
    seen = _twice(Seen(*read_seen(pairs, targets, "train")))
    validated = Seen(*read_seen(pairs, targets, "val"))
    backbone.precision = compute.precision
    job = TrainingJob(start.objective, settings, order.seed, order.out / "training", identity, name)
    began = time.monotonic()
    history = train(
        backbone, job, seen, validated, device=compute.device, processes=compute.processes
    )
    check_still_wanted(job.folder, identity, name)
    made = Network(order.out)
    # Weights carry nothing that differs between two equal runs, so they can be compared by bytes.
    save_backbone(made.model, backbone, name=name, seed=order.seed, steps=settings.steps)
    write_text(made.history, history_csv(history))
    measured = {
        "train_pairs": len(seen.pairs),
        "val_pairs": len(validated.pairs),
        "inputs": inputs,
        "identity": identity,
        "training_seconds": history[-1]["seconds"],
        "wall_seconds": time.monotonic() - began,
        "final": {k: v for k, v in history[-1].items() if k != "step"},
    }
    computed = _computed(compute)
    record = run_record(
        settings.model_dump(), order.seed, name=name, **computed, **measured, **start.facts
    )
    write_json(made.record, record)


def _identity(
    start: Start, settings: Training, order: Order, inputs: dict[str, Any]
) -> dict[str, str]:
    """Digests that a saved state must share to be used."""
    backbone, prior = start.backbone, start.objective.prior
    classes = [backbone.registered_name, settings.data_term]
    if prior is not None:
        classes.append(prior.registered_name)
    return {
        "settings": digest(settings.model_dump()),
        "backbone": digest([backbone.registered_name, backbone.arguments]),
        "seed": str(order.seed),
        "precision": order.compute.precision,
        "inputs": digest(inputs),
        "code": code_digest(start.step, *classes),
    }


def _computed(compute: Compute) -> dict[str, Any]:
    """How it was computed, for the record."""
    return {
        "device": str(chosen_device(compute.device)),
        "processes": compute.processes,
        "precision": compute.precision,
        "threads": torch.get_num_threads(),
    }


def _twice(seen: Seen) -> Seen:
    """Each pair with its own target and with the other one, where there are others."""
    if seen.targets is None:
        return seen
    targets = np.concatenate([seen.pairs.target, seen.targets])
    return Seen(PairSet.concatenate([seen.pairs, seen.pairs]), targets)


def stage1(pairs: Path, backbone: BackboneConfig, settings: Stage1, order: Order) -> None:
    """Train a backbone on the data term alone."""
    start, kind = settings.start, backbone.kind
    network = starting_backbone(kind, backbone.arguments, start, order.seed)
    if start != "random":
        start = file_digest(shipped_weights(kind) if start == "pretrained" else start)
    facts = {"stage": 1, "backbone": kind, "arguments": network.arguments}
    objective = Objective(DATA_TERMS.get(settings.data_term)())
    run(Start("stage1", network, objective, {"start": start}, facts), settings, order, [pairs])


def pretrain(
    pairs: list[Path],
    backbone: BackboneConfig,
    settings: Training,
    order: Order,
    targets: list[Path] | None = None,
) -> None:
    """Train weights to start from, on the true displacements of synthetic pairs.

    ``targets`` are variants of all pairs of each file, such as resampled ones, to train on as well.
    """
    kind, arguments = backbone.kind, backbone.arguments
    facts = {"stage": 0, "backbone": kind, "data": "synthetic", "arguments": arguments}
    network = new_backbone(kind, arguments, order.seed)
    objective = Objective(DATA_TERMS.get(settings.data_term)())
    start = Start("pretrain", network, objective, {"start": "random"}, facts)
    run(start, settings, order, pairs, targets)
