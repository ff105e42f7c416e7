"""What every method registers: the test split, clean and corrupted; and writing its fields."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import h5py
import numpy as np

from dine.data.pairs import PairSet, read_pairs, read_variant_subset
from dine.errors import DataError
from dine.evaluation.predictions import FORMAT, Prediction, put_prediction
from dine.files import atomic_path
from dine.progress import Progress
from dine.results import CLEAN, condition_key


class Condition(NamedTuple):
    """Test pairs under one condition, with the targets (P, M, 3) that methods see."""

    name: str
    corruption: float
    pairs: PairSet
    targets: np.ndarray

    @property
    def key(self) -> str:
        return condition_key(self.name, self.corruption)


def evaluation_conditions(pairs_path: Path, variants: Sequence[Path]) -> list[Condition]:
    """The clean test pairs, then each variant, of all of them or of some.

    Raises:
        DataError: there are no test pairs, or a variant belongs to other pairs.
    """
    pairs = read_pairs(pairs_path, split="test")
    if len(pairs) == 0:
        raise DataError(f"{pairs_path} has no test pairs.")
    found = [Condition(CLEAN, 0.0, pairs, pairs.target)]
    for path in variants:
        some, variant = read_variant_subset(path, pairs)
        found.append(Condition(variant.condition, variant.level, some, variant.target))
    return found


def write_predictions(
    out: Path,
    conditions: Sequence[Condition],
    fields: Callable[[Condition], Prediction],
    **facts: str,
) -> None:
    """Write the predictions of a method under every condition atomically."""
    with atomic_path(out) as temporary, h5py.File(temporary, "w") as file:
        file.attrs.update(format=FORMAT, **facts)
        for condition in conditions:
            put_prediction(file.create_group(condition.key), fields(condition))


def each_pair(
    condition: Condition,
    name: str,
    register: Callable[[int, np.ndarray, np.ndarray], np.ndarray],
) -> Prediction:
    """Fields and wall times of a method that takes one pair after another.

    ``register`` gets a row, its source (N, 3) and its target (M, 3), float64. The target's points
    come in a shuffled order, so that no method can profit from theirs.
    """
    fields = np.empty(condition.pairs.source.shape, np.float32)
    seconds = np.empty(len(fields))
    with Progress(f"{name} {condition.key}", len(fields), unit="pair") as progress:
        for row, (source, target) in enumerate(
            zip(condition.pairs.source, condition.targets, strict=True)
        ):
            order = np.random.default_rng([7, row]).permutation(len(target))
            began = time.perf_counter()
            fields[row] = register(row, source.astype(float), target[order].astype(float))
            seconds[row] = time.perf_counter() - began
            progress.update()
    return Prediction(
        condition.name, condition.corruption, condition.pairs.name, fields, None, seconds
    )
