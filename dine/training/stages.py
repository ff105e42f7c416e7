"""What all trainings share, from files to files; Stage 1 and pretraining."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np
import torch

from dine.config import Compute, Stage1, Training
from dine.data.pairs import PairSet, read_seen
from dine.errors import CheckpointError, ConfigError
from dine.files import digest, file_digest, write_json, write_text
from dine.models.backbones import BACKBONES, Backbone
from dine.models.checkpoint import load_backbone, save_backbone
from dine.models.devices import chosen_device
from dine.models.inference import COMPUTE
from dine.models.state import check_still_wanted
from dine.provenance import code_digest, run_record
from dine.results import Network
from dine.training.data_terms import DATA_TERMS
from dine.training.loop import history_csv, train
from dine.training.objective import Objective

WEIGHTS = Path(__file__).resolve().parents[1] / "weights"


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


def shipped_weights(kind: str) -> Path:
    """The pretrained weights that come with the package.

    Raises:
        ConfigError: there are none for this backbone.
    """
    path = WEIGHTS / f"{kind}.safetensors"
    if not path.is_file():
        raise ConfigError(
            f"There are no pretrained weights for the backbone {kind!r}; set `stage1.start` to "
            "random or to a file of weights."
        )
    return path


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


def run(
    backbone: Backbone,
    objective: Objective,
    pairs_paths: list[Path],
    settings: Training,
    *,
    step: str,
    seed: int,
    out: Path,
    name: str,
    compute: Compute,
    inputs: dict[str, Any],
    facts: dict[str, Any],
    targets_paths: list[Path] | None = None,
) -> None:
    """Train and write ``model.safetensors``, ``history.csv`` and ``run.json`` into ``out``.

    ``step`` is the command whose code a saved state is bound to, with that of the classes picked by
    name. Where there are other targets, every pair is trained on twice: with its own and with that.
    """
    inputs = {"pairs": [file_digest(path) for path in pairs_paths], **inputs}
    if targets_paths:
        inputs["targets"] = [file_digest(path) for path in targets_paths]
    classes = [backbone.registered_name, settings.data_term]
    if objective.prior is not None:
        classes.append(objective.prior.registered_name)
    identity = {
        "settings": digest(settings.model_dump()),
        "backbone": digest([backbone.registered_name, backbone.arguments]),
        "seed": str(seed),
        "precision": compute.precision,
        "inputs": digest(inputs),
        "code": code_digest(step, *classes),
    }
    train_pairs, train_targets = read_seen(pairs_paths, targets_paths, "train")
    val_pairs, val_targets = read_seen(pairs_paths, targets_paths, "val")
    if train_targets is not None:
        train_targets = np.concatenate([train_pairs.target, train_targets])
        train_pairs = PairSet.concatenate([train_pairs, train_pairs])
    backbone.precision = compute.precision
    began = time.monotonic()
    history = train(
        backbone,
        objective,
        train_pairs,
        val_pairs,
        settings,
        train_targets=train_targets,
        val_targets=val_targets,
        seed=seed,
        folder=out / "training",
        identity=identity,
        name=name,
        device=compute.device,
        processes=compute.processes,
    )
    check_still_wanted(out / "training", identity, name)
    made = Network(out)
    # Weights carry nothing that differs between two equal runs, so they can be compared by bytes.
    save_backbone(made.model, backbone, name=name, seed=seed, steps=settings.steps)
    write_text(made.history, history_csv(history))
    write_json(
        made.record,
        run_record(
            settings.model_dump(),
            seed,
            name=name,
            device=str(chosen_device(compute.device)),
            processes=compute.processes,
            precision=compute.precision,
            threads=torch.get_num_threads(),
            train_pairs=len(train_pairs),
            val_pairs=len(val_pairs),
            inputs=inputs,
            identity=identity,
            training_seconds=history[-1]["seconds"],
            wall_seconds=time.monotonic() - began,
            final={k: v for k, v in history[-1].items() if k != "step"},
            **facts,
        ),
    )


def stage1(
    pairs: Path,
    kind: str,
    arguments: dict[str, Any],
    settings: Stage1,
    *,
    seed: int,
    out: Path,
    name: str,
    compute: Compute = COMPUTE,
) -> None:
    """Train a backbone on the data term alone."""
    backbone = starting_backbone(kind, arguments, settings.start, seed)
    start = settings.start
    if start != "random":
        start = file_digest(shipped_weights(kind) if start == "pretrained" else start)
    run(
        backbone,
        Objective(DATA_TERMS.get(settings.data_term)()),
        [pairs],
        settings,
        step="stage1",
        seed=seed,
        out=out,
        name=name,
        compute=compute,
        inputs={"start": start},
        facts={"stage": 1, "backbone": kind, "arguments": backbone.arguments},
    )


def pretrain(
    pairs: list[Path],
    kind: str,
    arguments: dict[str, Any],
    settings: Training,
    *,
    seed: int,
    out: Path,
    targets: list[Path] | None = None,
    compute: Compute = COMPUTE,
) -> None:
    """Train weights to start from, on the true displacements of synthetic pairs.

    ``targets`` are variants of all pairs of each file, such as resampled ones, to train on as well.
    """
    run(
        new_backbone(kind, arguments, seed),
        Objective(DATA_TERMS.get(settings.data_term)()),
        pairs,
        settings,
        step="pretrain",
        seed=seed,
        out=out,
        name=f"pretraining/{kind}",
        compute=compute,
        targets_paths=targets,
        inputs={"start": "random"},
        facts={"stage": 0, "backbone": kind, "data": "synthetic", "arguments": arguments},
    )
