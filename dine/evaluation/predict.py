"""Register the test split and its corrupted variants, and keep the fields."""

from __future__ import annotations

from pathlib import Path

from dine.config import Compute
from dine.evaluation.conditions import Condition, evaluation_conditions, write_predictions
from dine.evaluation.predictions import Prediction
from dine.files import file_digest
from dine.models.checkpoint import load_backbone
from dine.models.inference import COMPUTE, predict_fields
from dine.results import CLEAN


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

    def fields(condition: Condition) -> Prediction:
        found = predict_fields(
            backbone,
            condition.pairs,
            name=f"{name} {condition.key}",
            batch_size=batch_size,
            compute=compute,
            targets=None if condition.name == CLEAN else condition.targets,
        )
        return Prediction(condition.name, condition.corruption, condition.pairs.name, *found)

    write_predictions(
        out,
        evaluation_conditions(pairs_path, variants),
        fields,
        model=file_digest(model),
        pairs=file_digest(pairs_path),
        name=name,
    )
