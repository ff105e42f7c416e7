"""Metrics from stored predictions; nothing is registered again here."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pandas as pd
from scipy.spatial import cKDTree

from dine.data.fields import put_names
from dine.data.pairs import PairSet, read_pairs, read_variant
from dine.errors import DataError
from dine.evaluation.predictions import read_predictions
from dine.files import atomic_path
from dine.results import CLEAN, condition_key

POINT_ERRORS_FORMAT = "dine-point-errors"


def nearest_squared(a: np.ndarray, b: np.ndarray, tree: cKDTree | None = None) -> np.ndarray:
    """Squared distance of each of (N, 3) points to the nearest of (M, 3), float64 (N,)."""
    distance, _ = (tree or cKDTree(b)).query(a)
    return distance**2


def chamfer(a: np.ndarray, b: np.ndarray) -> float:
    """Symmetric squared Chamfer distance of two clouds, as the paper's L_CD."""
    return float(nearest_squared(a, b).mean() + nearest_squared(b, a).mean())


def evaluate(
    predictions: Path,
    pairs_path: Path,
    variants: list[Path],
    out: Path,
    point_errors: Path,
    *,
    dataset: str,
    backbone: str,
    method: str,
) -> None:
    """Write one row per test pair and condition, and the per-point errors for the histogram.

    Columns of ``out`` (CSV), all in the normalised frame: ``cd`` symmetric squared Chamfer distance
    to the clean target, ``cd_observed`` the same to the target that the model saw,
    ``cd_unregistered`` of the source as it is to the clean target, ``mce`` mean distance (not
    squared) between a moved source point and its true position.
    ``point_errors`` (HDF5) has, per condition, ``pair`` and ``squared_distance`` (P, N).
    """
    pairs = read_pairs(pairs_path, split="test")
    position = {name: i for i, name in enumerate(pairs.name)}
    observed = {}
    for path in variants:
        variant = read_variant(path, pairs)
        observed[condition_key(variant.condition, variant.level)] = variant.target
    origin = str(pairs.attributes.get("origin", "unknown"))
    unregistered = [chamfer(pairs.source[i], pairs.target[i]) for i in range(len(pairs))]
    rows = []
    errors: dict[str, tuple[np.ndarray, np.ndarray]] = {}
    for prediction in read_predictions(predictions):
        key = condition_key(prediction.condition, prediction.corruption)
        if prediction.condition != CLEAN and key not in observed:
            raise DataError(
                f"{predictions} has the condition {key}, but no variant file was given."
            )
        per_point = np.empty(prediction.displacement.shape[:2], np.float32)
        for row, name in enumerate(prediction.pair):
            if name not in position:
                raise DataError(f"{predictions} names the pair {name!r}, unknown to {pairs_path}.")
            index = position[name]
            moved = pairs.source[index].astype(np.float64) + prediction.displacement[row]
            target = pairs.target[index].astype(np.float64)
            per_point[row] = nearest_squared(moved, target)
            cd = float(
                nearest_squared(moved, target).mean() + nearest_squared(target, moved).mean()
            )
            seen = cd if key == CLEAN else chamfer(moved, observed[key][index].astype(np.float64))
            rows.append(
                {
                    **_identity(pairs, index, dataset, backbone, method, origin),
                    "condition": prediction.condition,
                    "corruption": prediction.corruption,
                    "cd": cd,
                    "cd_observed": seen,
                    "cd_unregistered": unregistered[index],
                    "mce": float(np.linalg.norm(moved - target, axis=1).mean()),
                }
            )
        errors[key] = (prediction.pair, per_point)
    with atomic_path(point_errors) as temporary, h5py.File(temporary, "w") as file:
        file.attrs["format"] = POINT_ERRORS_FORMAT
        for key, (names, values) in errors.items():
            group = file.create_group(key)
            put_names(group, names)
            data = group.create_dataset("squared_distance", data=values, fletcher32=True)
            data.attrs["description"] = (
                "(P, N) squared distance of each moved source point to the clean target"
            )
    with atomic_path(out) as temporary:
        pd.DataFrame(rows).to_csv(temporary, index=False, float_format="%.9g")


def _identity(
    pairs: PairSet, index: int, dataset: str, backbone: str, method: str, origin: str
) -> dict[str, object]:
    return {
        "dataset": dataset,
        "backbone": backbone,
        "method": method,
        "origin": origin,
        "pair": pairs.name[index],
        "object": pairs.object[index],
        "level": float(pairs.level[index]),
    }
