"""What tables, figures and pages call things, and how they write numbers."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence

import pandas as pd

from dine.results import KNOWN, UNSEEN, trained_on

CD_SCALE = 1e4
"""Chamfer distances are shown in units of 1e-4, as in the paper."""

DATASETS = {"deformedtissue": "DeformedTissue", "synbench": "SynBench"}
"""Those of the paper."""
BACKBONES = {
    "robust_defreg": "Robust-DefReg",
    "deftransnet": "DefTransNet",
    "robust_defreg_geometric": "Robust-DefReg, geometric start",
}
METHODS = {
    "stage1": "Stage 1",
    "lambda0": "Control (λ = 0)",
    "pca": "DINE-PCA",
    "pca_residual": "PCA with residual",
    "flow": "DINE-Flow",
    "unregistered": "Unregistered",
}
ORIGINS = {
    "synthetic": "synthetic data",
    "bases": "real base meshes with synthetic deformations",
    "path": "data supplied by the user",
    "doi": "published data",
}
# The paper's order: its Table 3 lists outliers before noise.
CONDITIONS = {
    "deformation": "Deformation",
    "outliers": "Outliers",
    "noise": "Noise",
    "resampled": "Other points",
}
OBJECTS = {KNOWN: "known objects", UNSEEN: "unseen objects"}
VALUES = {
    "mce": ("Mean correspondence error", "MCE", 1.0, 4),
    "cd": ("Chamfer distance ×10⁻⁴", "CD", CD_SCALE, 2),
}
"""Compared values by column: long name with its unit, short name, factor and decimals shown."""

DASH = "–"
MARKS = {"lower": "▼", "higher": "▲"}
"""What is significantly lower or higher than the reference."""
PARTIAL = "†"


def display_name(key: str) -> str:
    """The name to show for a dataset, backbone or method; unknown ones are shown as they are."""
    known = trained_on(key)
    if known != key:
        return f"{display_name(known)}, {OBJECTS[UNSEEN]}"
    return {**DATASETS, **BACKBONES, **METHODS}.get(key, key)


def setting_name(condition: str, corruption: float) -> str:
    """A condition and its strength, in words."""
    if condition == "noise":
        return f"Noise σ = {corruption:g}"
    if condition == "outliers":
        return f"{corruption:g} % outliers"
    return "Clean" if condition == "deformation" else CONDITIONS[condition]


def rank(name: str, known: Iterable[str]) -> str:
    """A sort key: known names in their order, then the others by alphabet."""
    order = list(known)
    return f"{order.index(name) if name in order else len(order):03d} {name}"


def in_order(frame: pd.DataFrame, keys: list[str]) -> pd.DataFrame:
    """Rows sorted by some columns, names as the paper has them."""
    orders = {
        "condition": CONDITIONS,
        "measure": [*CONDITIONS, "mce"],
        "backbone": ["", *BACKBONES],
        "method": METHODS,
        "objects": [KNOWN],
        "dataset": [],
    }

    def ranks(column: pd.Series) -> pd.Series:
        order = orders.get(column.name)
        return column if order is None else column.map(lambda name: rank(name, order))

    return frame.sort_values(keys, key=ranks, kind="stable", ignore_index=True)


def slug(*names: str) -> str:
    """A name for a file from names that may hold anything."""
    return "_".join(re.sub(r"[^A-Za-z0-9_.-]+", "-", name).strip("-.") or "x" for name in names)


def join(names: Sequence[str]) -> str:
    """``a, b and c``."""
    return " and ".join([", ".join(names[:-1]), names[-1]] if len(names) > 1 else names)


# -------------------------------------------------------------------------------- numbers


def minus(text: str) -> str:
    return text.replace("-", "−")


def number(value: float, decimals: int, scale: float = 1.0) -> str:
    # Adding 0 makes −0 a 0.
    return DASH if pd.isna(value) else minus(f"{round(scale * value, decimals) + 0:.{decimals}f}")


def signed(value: float, decimals: int) -> str:
    return DASH if pd.isna(value) else minus(f"{value:+.{decimals}f}")


def percent(value: float, decimals: int) -> str:
    return DASH if pd.isna(value) else f"{signed(value, decimals)} %"


def short(value: object) -> str:
    """A number with four digits that count, a name, or a dash for nothing."""
    if isinstance(value, str):
        return display_name(value)
    if value is None or pd.isna(value):
        return DASH
    return minus(f"{value:.4g}") if isinstance(value, float) else str(value)


def interval(low: float, high: float) -> str:
    return f"{signed(low, 0)} to {signed(high, 0)}"


def change(relative: float, low: float, high: float) -> str:
    """A difference in percent of the reference, with its interval."""
    return f"{signed(relative, 0)} %" + (f" ({interval(low, high)})" if pd.notna(low) else "")


def p_value(value: float) -> str:
    if pd.isna(value):
        return DASH
    return "< 0.001" if value < 0.001 else f"{value:.3f}"


def mean_and_deviation(mean: float, deviation: float, decimals: int) -> str:
    """Both where there are both; a single pair has no deviation."""
    if pd.isna(mean):
        return DASH
    return f"{mean:.{decimals}f}" + ("" if pd.isna(deviation) else f" ± {deviation:.{decimals}f}")
