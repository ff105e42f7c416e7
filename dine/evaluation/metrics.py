"""Metrics from stored predictions; nothing is registered again here."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np
import pandas as pd
from scipy.spatial import cKDTree

from dine.data.fields import put_names, put_numbers
from dine.data.pairs import PairSet, read_pairs, read_variant_subset
from dine.errors import ConfigError, DataError
from dine.evaluation.predictions import Prediction, read_predictions
from dine.evaluation.quality import correspondence
from dine.files import atomic_path
from dine.geometry.distance import chamfer, distance_measures, distances
from dine.geometry.folding import folding, neighbourhoods, roughness
from dine.results import CLEAN, KNOWN, UNSEEN, condition_key

POINT_ERRORS_FORMAT = "dine-point-errors"


@dataclass(frozen=True)
class Labels:
    """What is written into every row.

    Attributes:
        dataset: its name.
        backbone: ``none`` for methods without one.
        seed: of the training, where there was one.
    """

    dataset: str
    backbone: str
    seed: int = 0


@dataclass(frozen=True, eq=False)
class _Known:
    """What all predictions of a pair are measured with, float64, normalised frame."""

    source: np.ndarray
    target: np.ndarray
    target_tree: cKDTree
    neighbours: np.ndarray
    unregistered: float
    roughness: float

    @classmethod
    def of(cls, pairs: PairSet, index: int) -> _Known:
        source, target = (x[index].astype(np.float64) for x in (pairs.source, pairs.target))
        neighbours = neighbourhoods(source)
        return cls(
            source,
            target,
            cKDTree(target),
            neighbours,
            chamfer(source, target),
            roughness(source, target - source, neighbours),
        )


class _TestPairs:
    """The test pairs of a file, and the targets that models saw in place of the clean ones.

    Raises:
        DataError: a file is missing, damaged or made from other pairs.
    """

    def __init__(self, path: Path, variants: list[Path]):
        everything = read_pairs(path)
        test = everything.split == "test"
        self.path = path
        self.pairs = everything.select(index=test)
        self.position = {name: i for i, name in enumerate(self.pairs.name)}
        self.observed: dict[str, dict[str, np.ndarray]] = {}
        for variant_path in variants:
            some, variant = read_variant_subset(variant_path, self.pairs)
            key = condition_key(variant.condition, variant.level)
            targets = dict(zip(some.name.tolist(), variant.target, strict=True))
            self.observed[key] = targets
        self._known_object, self._cluster = everything.known[test], everything.cluster[test]
        self._measured_with: dict[int, _Known] = {}

    def known(self, index: int) -> _Known:
        """What a pair is measured with, computed once."""
        if index not in self._measured_with:
            self._measured_with[index] = _Known.of(self.pairs, index)
        return self._measured_with[index]

    def facts(self, index: int) -> dict[str, object]:
        """The columns that say which pair it is."""
        return {
            "origin": str(self.pairs.attributes.get("origin", "unknown")),
            "pair": self.pairs.name[index],
            "object": self.pairs.object[index],
            "objects": KNOWN if self._known_object[index] else UNSEEN,
            "cluster": self._cluster[index],
            "level": float(self.pairs.level[index]),
        }

    def seen(self, prediction: Prediction, path: Path) -> dict[str, np.ndarray] | None:
        """The targets of a prediction's pairs by name; None where these are the clean ones.

        Raises:
            DataError: the prediction, read from ``path``, is not one of these pairs and targets.
        """
        names = prediction.pair.tolist()
        _require(names, self.position, path, self.path)
        targets = None
        if prediction.condition != CLEAN:
            key = condition_key(prediction.condition, prediction.corruption)
            if key not in self.observed:
                raise DataError(f"{path} has the condition {key}, but no variant file was given.")
            targets = self.observed[key]
            _require(names, targets, path, f"the variant file of {key}")
        if prediction.displacement.shape[1:] != self.pairs.source.shape[1:]:
            raise DataError(
                f"{path} has fields of {prediction.displacement.shape[1]} points, but "
                f"{self.path} has {self.pairs.source.shape[1]}."
            )
        return targets


def evaluate(
    predictions: Mapping[str, Path],
    pairs_path: Path,
    variants: list[Path],
    out: Path,
    point_errors: Path | None,
    *,
    labels: Labels,
) -> None:
    """Write one row per method, predicted test pair and condition, and the per-point errors.

    ``out`` (CSV) has the columns of docs/reference/metrics.md. Distances are to the clean target in
    the normalised frame and not squared, but for ``cd``, ``cd_observed`` (to the target that the
    model saw) and ``cd_unregistered`` (of the source as it is), which are symmetric squared Chamfer
    distances, and for ``mce_original``, which is in the units of the files. ``seconds`` is empty
    where the predictions do not say it. Predictions and variants may be of some of the test pairs.
    ``point_errors`` (HDF5) has, per condition, ``pair`` and ``squared_distance`` (P, N).

    Args:
        predictions: of one or more methods, by their names.
        pairs_path: the pairs they were made of.
        variants: the corrupted targets they were made with.
        out: one row per pair and condition.
        point_errors: squared distances of the moved points to the clean target, of a single
            method; None for no file.
        labels: of all rows.

    Raises:
        DataError: a file is missing, damaged or made from other pairs, or lacks what the
            predictions name.
        ConfigError: per-point errors of several methods.
    """
    if point_errors is not None and len(predictions) > 1:
        raise ConfigError("Per-point errors are written for one method at a time.")
    test = _TestPairs(pairs_path, variants)
    rows = []
    errors: dict[str, tuple[np.ndarray, np.ndarray]] = {}
    found = [(m, path, p) for m, path in predictions.items() for p in read_predictions(path)]
    for method, path, prediction in found:
        first = {"dataset": labels.dataset, "backbone": labels.backbone, "method": method}
        first["seed"] = labels.seed
        measured, squared = _rows(test, prediction, path)
        rows += [first | row for row in measured]
        key = condition_key(prediction.condition, prediction.corruption)
        errors[key] = (prediction.pair, squared)
    if point_errors is not None:
        _write_point_errors(point_errors, errors)
    with atomic_path(out) as temporary:
        pd.DataFrame(rows).to_csv(temporary, index=False, float_format="%.9g")


def _rows(
    test: _TestPairs, prediction: Prediction, path: Path
) -> tuple[list[dict[str, object]], np.ndarray]:
    """One row per pair of a prediction, read from ``path``, without its labels.

    Also the squared distances (P, N), float32, of the moved points to the clean target.
    """
    seen = test.seen(prediction, path)
    rows = []
    squared = np.empty(prediction.displacement.shape[:2], np.float32)
    for number, name in enumerate(prediction.pair.tolist()):
        index = test.position[name]
        target = None if seen is None else seen[name].astype(np.float64)
        values, distance = _measure(test.known(index), prediction.displacement[number], target)
        squared[number] = distance**2
        rows.append(
            {
                **test.facts(index),
                "condition": prediction.condition,
                "corruption": prediction.corruption,
                **values,
                "mce_original": values["mce"] * float(test.pairs.scale[index]),
                "seconds": np.nan if prediction.seconds is None else prediction.seconds[number],
            }
        )
    return rows, squared


def _write_point_errors(path: Path, errors: dict[str, tuple[np.ndarray, np.ndarray]]) -> None:
    with atomic_path(path) as temporary, h5py.File(temporary, "w") as file:
        file.attrs["format"] = POINT_ERRORS_FORMAT
        for key, (pair, values) in errors.items():
            group = file.create_group(key)
            put_names(group, pair)
            text = "(P, N) squared distance of each moved source point to the clean target"
            put_numbers(group, "squared_distance", values, text, by_row=False)


def _require(
    names: list[str], known: Collection[str], predictions: Path, where: Path | str
) -> None:
    missing = [name for name in names if name not in known]
    if missing:
        raise DataError(f"{predictions} names the pair {missing[0]!r}, unknown to {where}.")


def _measure(
    known: _Known, displacement: np.ndarray, seen: np.ndarray | None
) -> tuple[dict[str, float], np.ndarray]:
    """All measures of a field (N, 3) and the distances (N,) of its points to the clean target.

    ``seen`` (M, 3) is the target that the model saw, None for the clean one.
    """
    moved = known.source + displacement
    moved_tree = cKDTree(moved)
    distance = distances(moved, known.target_tree)
    clean = distance_measures(distance, distances(known.target, moved_tree))
    errors = correspondence(moved, known.target)
    cd_observed = clean["chamfer"]
    if seen is not None:
        cd_observed = distance_measures(distances(moved, seen), distances(seen, moved_tree))[
            "chamfer"
        ]
    field = displacement.astype(np.float64)
    values = {
        "cd": clean["chamfer"],
        "cd_observed": cd_observed,
        "cd_unregistered": known.unregistered,
        "mce": errors.pop("mce"),
        "cd_unsquared": clean["chamfer_unsquared"],
        "hd95": clean["hd95"],
        "hausdorff": clean["hausdorff"],
        **errors,
        "folding": folding(known.source, field, known.neighbours),
        "roughness": roughness(known.source, field, known.neighbours),
        "roughness_true": known.roughness,
    }
    return values, distance
