"""The one loader of evaluation results: ``metrics.csv`` files to one tidy table."""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pandas as pd

from dine.errors import DataError
from dine.evaluation.statistics import SUMMARISED, rounded
from dine.reporting import names
from dine.results import UNSEEN, unseen_of

_NUMBERS = [
    *("seed", "level", "corruption", "cd_observed", "cd_unregistered", "roughness_true"),
    *SUMMARISED,
]

_TEXT = ("dataset", "backbone", "method", "origin", "pair", "object", "objects", "cluster")
_ALLOWED = {
    "condition": names.CONDITIONS,
    "origin": names.ORIGINS,
    "objects": names.OBJECTS,
}
_KEYS = ["dataset", "backbone", "method", "seed", "condition", "corruption", "pair"]
# What evaluate may leave out: unknown level or correspondences, time that was not measured.
_MAY_LACK = {"level", "seconds", "mce", "accuracy_2_5", "accuracy_5", "far_points"}


def load_metrics(paths: Iterable[str | os.PathLike]) -> pd.DataFrame:
    """Read ``metrics.csv`` of any datasets, backbones, methods and seeds into one frame.

    A dataset whose test pairs are both of objects that were trained on and of others is shown as
    two: under its own name the known objects, and with ``_unseen`` behind it the others.

    Args:
        paths: files of ``dine evaluate``. Columns: see ``docs/reference/metrics.md``.

    Raises:
        DataError: a file is missing, lacks a column or holds values that cannot be used, the same
            evaluation stands in two rows, or a dataset mixes origins.
    """
    frames = [_read_one(Path(path)) for path in paths]
    if not frames:
        raise DataError("No metrics files were given; evaluate a model first.")
    metrics = pd.concat(frames, ignore_index=True)
    repeated = metrics[metrics.duplicated(_KEYS)]
    if len(repeated):
        what = ", ".join(f"{name} {value}" for name, value in repeated.iloc[0][_KEYS].items())
        raise DataError(f"The metrics files hold the same evaluation twice ({what}).")
    for dataset, origins in metrics.groupby("dataset")["origin"].unique().items():
        if len(origins) > 1:
            raise DataError(
                f"The metrics files of {dataset} mix data of different origins "
                f"({', '.join(sorted(origins))}); their numbers cannot stand in one table."
            )
    kinds = metrics.groupby("dataset")["objects"].transform("nunique")
    apart = (kinds > 1) & (metrics["objects"] == UNSEEN)
    return metrics.assign(dataset=metrics["dataset"].mask(apart, metrics["dataset"].map(unseen_of)))


def _read_one(path: Path) -> pd.DataFrame:
    try:
        # As text first: a pair may be called "NA" or "007".
        frame = pd.read_csv(path, dtype=str, keep_default_na=False)
    except FileNotFoundError as error:
        raise DataError(f"{path} does not exist.") from error
    except (OSError, ValueError) as error:
        raise DataError(f"{path} is not a readable CSV file ({error}).") from error
    columns = [*_TEXT, "condition", *_NUMBERS]
    missing = [name for name in columns if name not in frame]
    if missing:
        raise DataError(f"{path} lacks the column(s) {', '.join(missing)}; evaluate again.")
    if frame.empty:
        raise DataError(f"{path} holds no rows.")
    frame = frame[columns]
    for name in (*_TEXT, "condition"):
        if (frame[name] == "").any():
            raise DataError(f"{path}: column {name} is empty in some rows.")
    for name, allowed in _ALLOWED.items():
        unknown = frame.loc[~frame[name].isin(list(allowed)), name]
        if len(unknown):
            raise DataError(
                f"{path}: unknown {name} {unknown.iloc[0]!r}; expected one of {', '.join(allowed)}."
            )
    read = {name: _read_numbers(frame[name], path) for name in _NUMBERS}
    return rounded(frame.assign(**read)).astype({"seed": int})


def _read_numbers(column: pd.Series, path: Path) -> pd.Series:
    try:
        values = pd.to_numeric(column).astype(float)
    except (TypeError, ValueError) as error:
        raise DataError(f"{path}: column {column.name} is not numeric ({error}).") from error
    bad = np.isinf(values) | (values < 0)
    if column.name not in _MAY_LACK:
        bad |= values.isna()
    if bad.any():
        raise DataError(
            f"{path}: column {column.name} holds {column[bad].iloc[0] or 'nothing'} in data row "
            f"{int(np.argmax(bad)) + 1}; it must be a finite number of at least 0."
        )
    return values


def origin_of(dataset: str, metrics: pd.DataFrame) -> str | None:
    """The origin of a dataset's pairs, or None where the metrics have none of it."""
    origins = metrics.loc[metrics["dataset"] == dataset, "origin"]
    return None if origins.empty else str(origins.iloc[0])
