"""Tables of what a prior of one organ is worth: a table for each question."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd

from dine.errors import DataError
from dine.evaluation.statistics import cluster_bootstrap
from dine.reporting.names import DASH, number, signed
from dine.reporting.table import Table, laid_out
from dine.trials.organ import COLUMNS, ERRORS

TITLES = {
    "methods": "What is not seen, by method",
    "seen": "Share seen, noise and pose",
    "mechanics": "What simulations are wrong about",
    "size": "Amplitude",
}
METHODS = {
    "unregistered": "Unregistered",
    "rigid": "Rigid",
    "bcpd": "Bayesian CPD",
    "smooth": "Smooth process",
    "pca": "PCA",
    "pca_process": "PCA + process",
    "one_patch": "PCA + process, held at one patch",
    "places_given": "The same, places of seen vertices given",
}
REFERENCE = "pca_process"
_LABELS = {"hidden": "Hidden", "seen": "Seen", "target": "Ball inside"}
_CAPTION = (
    "Mean distances from the true places in percent of the radius, over {deformations} synthetic "
    "deformations of each template; in brackets the 95 % interval of the mean and, after the "
    "semicolon, the median. Difference: of the hidden error to that of PCA + process on the same "
    "deformations. Bound: share of the hidden vertices within their 90 % bound."
)


def load_trials(measured: Sequence[tuple[str, Path]]) -> pd.DataFrame:
    """Rows of some trials, in percent of the radius, with the name of the template of each.

    Raises:
        DataError: not a table of ``dine organ-trial``.
    """
    found = []
    for name, path in measured:
        try:
            rows = pd.read_csv(path)
        except (OSError, ValueError) as error:
            raise DataError(f"{path} is not a readable table ({error}).") from None
        if list(rows.columns) != COLUMNS or not set(rows["about"]) <= set(TITLES):
            raise DataError(f"{path} is not a table of `dine organ-trial`.")
        found.append(rows.assign(template=name))
    rows = pd.concat(found, ignore_index=True)
    rows[list(ERRORS)] *= 100
    return rows


def trial_tables(rows: pd.DataFrame) -> list[Table]:
    """One table for each question that was asked."""
    return [
        _table(about, rows[rows["about"] == about])
        for about in TITLES
        if about in set(rows["about"])
    ]


def _table(about: str, rows: pd.DataFrame) -> Table:
    keys = ["template", "condition", "method"]
    groups = list(rows.groupby(keys, sort=False))
    data = pd.DataFrame(
        [dict(zip(keys, key, strict=True)) | _measured(group, rows) for key, group in groups]
    )
    columns = {
        ("", "Template"): data["template"],
        ("", "Condition"): data["condition"],
        ("", "Method"): data["method"].map(METHODS),
    }
    for name, label in _LABELS.items():
        columns["Error", label] = [_shown(row, name) for _, row in data.iterrows()]
    columns["Hidden", "Difference"] = [_shown_difference(row) for _, row in data.iterrows()]
    columns["Hidden", "Bound"] = [
        DASH if np.isnan(x) else f"{number(x, 0, 100)} %" for x in data["within"]
    ]
    counts = rows.groupby("template")["deformation"].nunique()
    spread = "–".join(str(x) for x in sorted({counts.min(), counts.max()}))
    caption = _CAPTION.format(deformations=spread)
    return Table(f"organ_{about}", TITLES[about], caption, **laid_out(columns), data=data)


def _measured(group: pd.DataFrame, rows: pd.DataFrame) -> dict[str, float]:
    """Means, intervals and medians of one method under one condition."""
    found: dict[str, float] = {"deformations": len(group)}
    for name in ERRORS:
        low, high = cluster_bootstrap(group[name].to_numpy(), group["deformation"].to_numpy())
        found |= {name: group[name].mean(), f"{name}_low": low, f"{name}_high": high}
        found[f"{name}_median"] = group[name].median()
    same = (rows["template"] == group["template"].iloc[0]) & (
        rows["condition"] == group["condition"].iloc[0]
    )
    reference = rows[same & (rows["method"] == REFERENCE)].set_index("deformation")["hidden"]
    apart = (group.set_index("deformation")["hidden"] - reference).dropna()
    low, high = cluster_bootstrap(apart.to_numpy(), np.asarray(apart.index))
    found |= {"difference": apart.mean(), "difference_low": low, "difference_high": high}
    return found | {"within": group["within"].mean()}


def _shown(row: pd.Series, name: str) -> str:
    low, high, middle = (number(row[f"{name}_{end}"], 1) for end in ("low", "high", "median"))
    return f"{number(row[name], 1)} ({low} to {high}; {middle})"


def _shown_difference(row: pd.Series) -> str:
    if row["method"] == REFERENCE or np.isnan(row["difference"]):
        return DASH
    low, high = (signed(row[f"difference_{end}"], 1) for end in ("low", "high"))
    return f"{signed(row['difference'], 1)} ({low} to {high})"
