"""The paper's steps, each from files to files: Stage 1, fields, priors, search of λ, Stage 2."""

from __future__ import annotations

import contextlib
import logging
import math
import time
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from dine.config import (
    CONTROL,
    Compute,
    LambdaSearch,
    PriorConfig,
    Stage1,
    Stage2,
    Training,
    check_arguments,
)
from dine.data.fields import TrainingFields, read_fields, write_training_fields
from dine.data.loading import Batches
from dine.data.pairs import PairSet, read_seen
from dine.errors import CheckpointError, ConfigError, DataError
from dine.files import digest, file_digest, read_json, write_json, write_text
from dine.models.backbones import BACKBONES, Backbone, marginal_deviation
from dine.models.checkpoint import load_backbone, save_backbone
from dine.priors import PRIORS, load_prior
from dine.progress import Progress
from dine.provenance import code_digest, run_record
from dine.training.data_terms import DATA_TERMS
from dine.training.loop import VALIDATION_COLUMNS, history_csv, train
from dine.training.objective import Objective
from dine.training.parallel import chosen_device

log = logging.getLogger(__name__)

COMPUTE = Compute()

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
    if given.registered_name != backbone.registered_name or given.arguments != backbone.arguments:
        raise CheckpointError(
            f"{path} holds {given.registered_name} with {given.arguments}; the configuration asks "
            f"for {backbone.registered_name} with {backbone.arguments}."
        )
    return given


def _run(
    backbone: Backbone,
    objective: Objective,
    pairs_paths: list[Path],
    settings: Training,
    *,
    seed: int,
    out: Path,
    name: str,
    compute: Compute,
    inputs: dict[str, Any],
    facts: dict[str, Any],
    targets_paths: list[Path] | None = None,
) -> None:
    """Train and write ``model.safetensors``, ``history.csv`` and ``run.json`` into ``out``.

    Where there are other targets, every pair is trained on twice: with its own and with that.
    """
    inputs = {"pairs": [file_digest(path) for path in pairs_paths], **inputs}
    if targets_paths:
        inputs["targets"] = [file_digest(path) for path in targets_paths]
    identity = {
        "settings": digest(settings.model_dump()),
        "backbone": digest([backbone.registered_name, backbone.arguments]),
        "seed": str(seed),
        "precision": compute.precision,
        "inputs": digest(inputs),
        "code": code_digest("model", "training", *(["priors"] if objective.prior else [])),
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
    # Weights carry nothing that differs between two equal runs, so they can be compared by bytes.
    save_backbone(out / "model.safetensors", backbone, name=name, seed=seed, steps=settings.steps)
    write_text(out / "history.csv", history_csv(history))
    write_json(
        out / "run.json",
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
    _run(
        backbone,
        Objective(DATA_TERMS.get(settings.data_term)()),
        [pairs],
        settings,
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
    _run(
        new_backbone(kind, arguments, seed),
        Objective(DATA_TERMS.get(settings.data_term)()),
        pairs,
        settings,
        seed=seed,
        out=out,
        name=f"pretraining/{kind}",
        compute=compute,
        targets_paths=targets,
        inputs={"start": "random"},
        facts={"stage": 0, "backbone": kind, "data": "synthetic", "arguments": arguments},
    )


class Fields(NamedTuple):
    """Displacement (P, N, 3) float32 of some pairs, normalised frame.

    With the standard deviation (P, N) of the marginals, where the backbone has them, and the wall
    time (P,) of each pair's batch, shared out.
    """

    displacement: np.ndarray
    spread: np.ndarray | None
    seconds: np.ndarray


@torch.no_grad()
def predict_fields(
    backbone: Backbone,
    pairs: PairSet,
    *,
    name: str,
    batch_size: int = 4,
    compute: Compute = COMPUTE,
    targets: np.ndarray | None = None,
) -> Fields:
    """Displacement fields of all pairs, in the pairs' order.

    ``targets`` (P, M, 3) stands in for the clean targets. Each target's points come in a shuffled
    order, as in training.
    """
    device = chosen_device(compute.device)
    backbone.precision = compute.precision
    backbone.to(device).eval()
    batches = Batches(pairs, device, targets)
    fields = np.empty(pairs.source.shape, np.float32)
    spread = np.full(pairs.source.shape[:2], np.nan, np.float32)
    seconds = np.empty(len(pairs))
    starts = range(0, len(pairs), batch_size)
    parts = [np.arange(start, min(start + batch_size, len(pairs))) for start in starts]
    stream = batches.stream((part, [(2, index) for index in part]) for part in parts)
    with contextlib.closing(stream), Progress(name, len(pairs), unit="pair") as progress:
        for part, (batch, _) in zip(parts, stream, strict=True):
            began = time.perf_counter()
            found = backbone(batch)
            fields[part] = found.displacement.cpu().numpy()
            deviation = marginal_deviation(backbone, found)
            if deviation is not None:
                spread[part] = deviation.cpu().numpy()
            seconds[part] = (time.perf_counter() - began) / len(part)
            progress.update(len(part))
    return Fields(fields, None if np.isnan(spread).any() else spread, seconds)


def dump_fields(
    model: Path,
    pairs: Path,
    out: Path,
    *,
    name: str,
    batch_size: int = 4,
    targets: Path | None = None,
    compute: Compute = COMPUTE,
) -> None:
    """Write a model's displacement fields of the training split to HDF5.

    ``targets``, a variant of all pairs, stands in for the pairs' own targets.
    """
    backbone, _ = load_backbone(model)
    train_pairs, seen = read_seen([pairs], [targets] if targets else None, "train")
    fields = predict_fields(
        backbone, train_pairs, name=name, batch_size=batch_size, compute=compute, targets=seen
    )
    write_training_fields(
        out,
        train_pairs.name,
        TrainingFields(
            fields.displacement,
            train_pairs.source,
            train_pairs.displacement,
            str(train_pairs.attributes.get("convention", "none")),
        ),
        model=file_digest(model),
        pairs=file_digest(pairs),
    )


def fit_prior(fields: list[Path], prior: PriorConfig, *, seed: int, out: Path) -> None:
    """Fit a prior to dumped fields, of one or more files, and write it, frozen."""
    arguments = check_arguments(prior)
    began = time.monotonic()
    parts = [read_fields(path) for path in fields]
    if len({(part.source.shape[1], part.convention) for part in parts}) > 1:
        raise DataError(
            "The files of fields hold different numbers of points or orders of them; fit one at a "
            "time."
        )
    source = np.concatenate([part.source for part in parts])
    chosen = [part.true if prior.fields == "exact" else part.displacement for part in parts]
    displacement = np.concatenate(chosen)
    if prior.fields == "shuffled":
        order = np.tile(np.arange(displacement.shape[1]), (len(displacement), 1))
        order = np.random.default_rng([6, seed]).permuted(order, axis=1)
        displacement = np.take_along_axis(displacement, order[..., None], axis=1)
    fitted = PRIORS.get(prior.kind).fit(displacement, seed=seed, source=source, **arguments)
    # Where a prior is used on other points, these must be brought into its order.
    fitted.notes["convention"] = parts[0].convention if prior.fields != "shuffled" else "none"
    digests = [file_digest(path) for path in fields]
    fitted.save(out, arguments=arguments, fields=digests, fitted_to=prior.fields, seed=seed)
    log.info("fitted the %s prior in %.1f s", prior.kind, time.monotonic() - began)


def selected_lambda(path: Path, prior: str) -> float:
    """λ for a prior, from the file of the search.

    Raises:
        DataError: the file is not a search's result.
    """
    result = read_json(path)
    try:
        selected = result["selected"]
        weight = float(selected.get(prior, selected[result["default"]]))
        if not 0 <= weight < math.inf:
            raise ValueError("λ is no number from 0 on")
        return weight
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError):
        raise DataError(f"{path} is not the result of `dine search-lambda`.") from None


def stage2(
    pairs: Path,
    model: Path,
    settings: Stage2,
    *,
    variant: str,
    prior: Path | None,
    weight: float,
    seed: int,
    out: Path,
    name: str,
    compute: Compute = COMPUTE,
) -> None:
    """Refine a Stage-1 model with λ times a frozen prior.

    ``lambda0`` is the control without; other variants without a prior differ in the data term.
    """
    if variant == CONTROL and prior is not None:
        raise ConfigError(f"The variant {variant!r} takes no prior.")
    backbone, facts = load_backbone(model)
    _run(
        backbone,
        Objective(
            DATA_TERMS.get(settings.data_term)(), load_prior(prior) if prior else None, weight
        ),
        [pairs],
        settings,
        seed=seed,
        out=out,
        name=name,
        compute=compute,
        inputs={
            "model": file_digest(model),
            "prior": file_digest(prior) if prior else None,
            "lambda": weight,
        },
        facts={"stage": 2, "variant": variant, "lambda": weight, "backbone": facts["backbone"]},
    )


def search_lambda(
    pairs: Path,
    model: Path,
    priors: dict[str, Path],
    stage: Stage2,
    search: LambdaSearch,
    *,
    seed: int,
    out: Path,
    compute: Compute = COMPUTE,
) -> None:
    """Try each λ on a shortened Stage 2; the lowest mean of the criterion on validation pairs wins.

    λ = 0 is trained too, once, for comparison, but never chosen. Each candidate's result is kept,
    so that an interrupted search goes on with the next one.
    """
    # One validation, at the end, on more pairs than training looks at.
    settings = stage.model_copy(
        update={
            "steps": search.steps,
            "validate_every": search.steps,
            "validation_pairs": search.validation_pairs,
        }
    )
    folder = out.with_name(f"{out.stem}_candidates")
    curve = []
    runs: list[tuple[str, float]] = [(CONTROL, 0.0)]
    runs += [(prior, weight) for prior in priors for weight in sorted(search.candidates)]
    for prior, weight in runs:
        here = folder / f"{prior}_{weight:g}"
        stage2(
            pairs,
            model,
            settings,
            variant=prior,
            prior=priors.get(prior),
            weight=weight,
            seed=seed,
            out=here,
            name=f"search of λ: {prior} {weight:g}",
            compute=compute,
        )
        final = read_json(here / "run.json")["final"]
        # The control is every prior's value at λ = 0.
        for label in priors if prior == CONTROL else (prior,):
            errors = {name.removeprefix("val_"): final[name] for name in VALIDATION_COLUMNS}
            curve.append({"prior": label, "lambda": weight, **errors})
    selected = {}
    for prior in priors:
        tried = [row for row in curve if row["prior"] == prior and row["lambda"] > 0]
        selected[prior] = min(tried, key=lambda row: row[search.criterion])["lambda"]
    write_json(
        out,
        {
            "dataset": search.dataset,
            "backbone": search.backbone,
            "default": next(iter(priors)),
            "selected": selected,
            "criterion": search.criterion,
            "curve": curve,
            "steps": search.steps,
            "validation_pairs": search.validation_pairs,
            "seed": seed,
        },
    )
