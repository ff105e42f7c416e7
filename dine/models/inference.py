"""Displacement fields of a trained backbone."""

from __future__ import annotations

import contextlib
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

from dine.config import Compute
from dine.data.fields import TrainingFields, write_training_fields
from dine.data.loading import Batches
from dine.data.pairs import PairSet, read_seen
from dine.files import file_digest
from dine.models.backbones import Backbone, marginal_deviation
from dine.models.checkpoint import load_backbone
from dine.models.devices import chosen_device, leased
from dine.progress import Progress

COMPUTE = Compute()


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
    backbone.precision = compute.precision
    fields = np.empty(pairs.source.shape, np.float32)
    spread = np.full(pairs.source.shape[:2], np.nan, np.float32)
    seconds = np.empty(len(pairs))
    starts = range(0, len(pairs), batch_size)
    parts = [np.arange(start, min(start + batch_size, len(pairs))) for start in starts]
    requests = ((part, [(2, index) for index in part]) for part in parts)
    with (
        leased(chosen_device(compute.device)) as [device],
        contextlib.closing(Batches(pairs, device, targets).stream(requests)) as stream,
        Progress(name, len(pairs), unit="pair") as progress,
    ):
        backbone.to(device).eval()
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
