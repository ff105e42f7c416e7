"""Register the test split and its corrupted variants, and keep the fields."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np

from dine.config import Compute
from dine.data.fields import put_fields
from dine.data.pairs import read_pairs, read_variant
from dine.errors import DataError
from dine.evaluation.predictions import FORMAT
from dine.files import atomic_path, file_digest
from dine.models.checkpoint import load_backbone
from dine.results import CLEAN, condition_key
from dine.training.stages import COMPUTE, predict_fields


def predict(
    model: Path,
    pairs_path: Path,
    variants: list[Path],
    out: Path,
    *,
    name: str,
    batch_size: int = 4,
    compute: Compute = COMPUTE,
) -> None:
    """Predict the clean test split and its corrupted variants, and write all fields to HDF5."""
    backbone, _ = load_backbone(model)
    pairs = read_pairs(pairs_path, split="test")
    if len(pairs) == 0:
        raise DataError(f"{pairs_path} has no test pairs.")
    conditions: list[tuple[str, float, np.ndarray | None]] = [(CLEAN, 0.0, None)]
    for path in variants:
        variant = read_variant(path, pairs)
        conditions.append((variant.condition, variant.level, variant.target))
    with atomic_path(out) as temporary, h5py.File(temporary, "w") as file:
        file.attrs.update(
            format=FORMAT, model=file_digest(model), pairs=file_digest(pairs_path), name=name
        )
        for condition, corruption, targets in conditions:
            key = condition_key(condition, corruption)
            fields = predict_fields(
                backbone,
                pairs,
                name=f"{name} {key}",
                batch_size=batch_size,
                compute=compute,
                targets=targets,
            )
            group = file.create_group(key)
            group.attrs.update(condition=condition, corruption=corruption)
            put_fields(group, pairs.name, fields)
