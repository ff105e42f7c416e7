"""What a run says in short: each prior against the control, with intervals, and nothing more.

A sentence is only as strong as its interval, which holds the chance of the test pairs and that of
the training (:func:`dine.evaluation.statistics.verdicts`); where it holds zero, the sentence says
undecided.
"""

from __future__ import annotations

import pandas as pd

from dine.config import CONTROL, STAGE1
from dine.evaluation.statistics import verdicts
from dine.reporting import tables
from dine.reporting.tables import CONDITION_NAMES, OBJECTS_NAMES, display_name
from dine.results import CLEAN, KNOWN, trained_on


def effects(
    metrics: pd.DataFrame, reference: str = CONTROL, value: str = "cd", *, spread: float = 0.0
) -> pd.DataFrame:
    """Every prior against a reference under each condition, all its levels and strengths together.

    The columns of ``statistics.verdicts``, and ``objects``, ``known`` or ``unseen``.
    """
    # A pair counts once for each strength; drawn by cluster, its rows stay together.
    strength = metrics["corruption"].map("{:g}".format)
    pooled = metrics.assign(corruption=0.0, pair=metrics["pair"] + " " + strength)
    found = verdicts(pooled[pooled[value].notna()], reference, value, spread=spread)
    found = found[found["level"].isna() & ~found["method"].isin([STAGE1, CONTROL])]
    kinds = metrics.groupby("dataset")["objects"].first()
    found = found.assign(objects=found["dataset"].map(kinds))
    names = {"method": tables.METHOD_NAMES, "backbone": tables.BACKBONE_NAMES, "objects": [KNOWN]}
    return found.sort_values(
        ["objects", "method", "dataset", "backbone"],
        key=lambda column: column.map(lambda x: tables.rank(x, names.get(column.name, ()))),
        kind="stable",
        ignore_index=True,
    )


def interval(row: pd.Series) -> str:
    """A difference in percent of the reference, with its interval."""
    ends = f" ({row['low']:+.0f} to {row['high']:+.0f})" if pd.notna(row["low"]) else ""
    return f"{row['relative']:+.0f} %{ends}".replace("-", "−")


def headlines(metrics: pd.DataFrame, *, spread: float = 0.0) -> list[str]:
    """A sentence for each kind of objects and each prior: against the control, on clean targets."""
    table = effects(metrics, spread=spread)
    table = table[table["condition"] == CLEAN]
    groups = table.groupby(["objects", "method"], sort=False)
    found = [_headline(method, kind, rows, metrics) for (kind, method), rows in groups]
    return found or ["No prior was evaluated in this run, so there is nothing to compare."]


def _headline(method: str, objects: str, rows: pd.DataFrame, metrics: pd.DataFrame) -> str:
    name = display_name(method)
    words = {
        "lower": f"{name} has a lower mean Chamfer distance than the control on",
        "higher": f"{name} has a higher mean Chamfer distance than the control on",
        "undecided": f"whether {name} differs from the control is undecided on",
    }
    parts = []
    for verdict, text in words.items():
        some = rows[rows["verdict"] == verdict]
        places = [f"{_place(row)} {interval(row)}" for _, row in some.iterrows()]
        if places:
            parts.append(f"{text} {', '.join(places)}")
    made = {tables.ORIGIN_NAMES[tables.origin_of(name, metrics)] for name in rows["dataset"]}
    kind = f"{OBJECTS_NAMES[objects].capitalize()} ({', '.join(sorted(made))})"
    return f"{kind}: {'; '.join(parts)}."


def _place(row: pd.Series) -> str:
    return f"{display_name(trained_on(row['dataset']))} with {display_name(row['backbone'])}"


def overview(metrics: pd.DataFrame, *, spread: float = 0.0) -> tuple[list[str], list[list[str]]]:
    """Header and rows of a table: each prior's differences under every condition."""
    control = effects(metrics, spread=spread)
    columns = {
        f"CD, {CONDITION_NAMES[name].lower()}": control[control["condition"] == name]
        for name in CONDITION_NAMES
        if (control["condition"] == name).any()
    }
    errors = effects(metrics, value="mce", spread=spread)
    columns["MCE, deformation"] = errors[errors["condition"] == CLEAN]
    first = effects(metrics, STAGE1, spread=spread)
    columns["CD, deformation, against Stage 1"] = first[first["condition"] == CLEAN]
    keys = ["objects", "dataset", "backbone", "method"]
    places = control[keys].drop_duplicates()
    cells = {
        name: {tuple(row[keys]): _cell(row) for _, row in table.iterrows()}
        for name, table in columns.items()
    }
    rows = [
        [
            OBJECTS_NAMES[place[0]].capitalize(),
            display_name(trained_on(place[1])),
            *map(display_name, place[2:]),
            *(found.get(place, "–") for found in cells.values()),
        ]
        for place in places.itertuples(index=False, name=None)
    ]
    return ["Objects", "Dataset", "Backbone", "Prior", *columns], rows


def _cell(row: pd.Series) -> str:
    return f"{row['verdict']}: {interval(row)}"
