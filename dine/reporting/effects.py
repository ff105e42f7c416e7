"""What a run says in short: each prior against the control, with intervals, and nothing more.

A sentence is only as strong as its interval, which holds the chance of the test pairs and that of
the training (:func:`dine.evaluation.statistics.verdicts`); where it holds zero, the sentence says
undecided.
"""

from __future__ import annotations

import numpy as np
import pandas as pd

from dine.config import CONTROL, STAGE1
from dine.evaluation.statistics import verdicts
from dine.reporting import names
from dine.reporting.loading import origin_of
from dine.reporting.names import DASH, change, display_name, in_order
from dine.reporting.table import Cell, Table
from dine.results import CLEAN, trained_on

_KEYS = ["objects", "dataset", "backbone", "method"]


def effects(
    metrics: pd.DataFrame, reference: str = CONTROL, value: str = "cd", *, spread: float = 0.0
) -> pd.DataFrame:
    """Every prior against a reference under each condition, all its levels and strengths together.

    The columns of ``statistics.verdicts``, and ``objects``, ``known`` or ``unseen``.
    """
    # A pair counts once for each strength; drawn by cluster, its rows stay together.
    strength = metrics["corruption"].map("{:g}".format)
    pooled = metrics.assign(corruption=0.0, level=np.nan, pair=metrics["pair"] + " " + strength)
    found = verdicts(pooled[pooled[value].notna()], reference, value, spread=spread)
    found = found[~found["method"].isin([STAGE1, CONTROL])]
    kinds = metrics.groupby("dataset")["objects"].first()
    found = found.assign(objects=found["dataset"].map(kinds))
    return in_order(found, ["objects", "method", "dataset", "backbone"])


def headlines(control: pd.DataFrame, metrics: pd.DataFrame) -> list[str]:
    """A sentence for each kind of objects and each prior, on clean targets.

    ``control`` is the table of ``effects`` against the control.
    """
    table = control[control["condition"] == CLEAN]
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
        places = [
            f"{display_name(trained_on(row['dataset']))} with {display_name(row['backbone'])} "
            f"{change(row['relative'], row['low'], row['high'])}"
            for row in rows[rows["verdict"] == verdict].to_dict("records")
        ]
        if places:
            parts.append(f"{text} {', '.join(places)}")
    made = {names.ORIGINS[origin_of(name, metrics)] for name in rows["dataset"]}
    kind = f"{names.OBJECTS[objects].capitalize()} ({', '.join(sorted(made))})"
    return f"{kind}: {'; '.join(parts)}."


def overview(control: pd.DataFrame, metrics: pd.DataFrame, *, spread: float = 0.0) -> Table | None:
    """Each prior's differences under every condition, with what follows; None without priors.

    ``control`` is the table of ``effects`` against the control.
    """
    if control.empty:
        return None
    errors = effects(metrics, value="mce", spread=spread)
    first = effects(metrics, STAGE1, spread=spread)
    columns = {
        f"CD, {text.lower()}": control[control["condition"] == name]
        for name, text in names.CONDITIONS.items()
        if (control["condition"] == name).any()
    }
    columns["MCE, deformation"] = errors[errors["condition"] == CLEAN]
    columns["CD, deformation, against Stage 1"] = first[first["condition"] == CLEAN]
    found = [table.set_index(_KEYS).to_dict("index") for table in columns.values()]
    rows = []
    for place in control[_KEYS].drop_duplicates().itertuples(index=False, name=None):
        head = [names.OBJECTS[place[0]].capitalize(), display_name(trained_on(place[1]))]
        cells = [verdict_cell(table.get(place)) for table in found]
        rows.append((*map(Cell, [*head, *map(display_name, place[2:])]), *cells))
    header = ("Objects", "Dataset", "Backbone", "Prior", *columns)
    caption = _CAPTION.format(chance=training_chance(spread) if spread else "")
    return Table("", "", caption, tuple(("", name) for name in header), tuple(rows), control)


def verdict_cell(row: dict | None, name: str = "verdict") -> Cell:
    """A verdict with the difference in percent of the reference and its interval."""
    if row is None:
        return Cell(DASH)
    text = f"{row[name]}: {change(row['relative'], row['low'], row['high'])}"
    return Cell(text, row[name] == "lower")


_CAPTION = (
    "Differences of the means in percent of the control's (or Stage 1's), over all levels and "
    "strengths; negative: the prior is lower. In brackets the 95 % interval, of the test pairs "
    "that both methods share: drawn by deformation where the object is known, and by object where "
    "it is unseen.{chance} Lower or higher: the interval holds no zero. Otherwise the matter is "
    "undecided. Known objects are those that were trained on, under deformations that were not; "
    "the prior is defined for these. Unseen objects were not trained on at all."
)


def training_chance(spread: float) -> str:
    """What an interval holds besides the chance of the pairs; ``spread`` is a share."""
    return (
        " It also holds the chance of the training: another seed, or another CPU's rounding, gives "
        f"another network, whose difference varies by {100 * spread:g} % of the reference "
        "(standard deviation; evaluation.training_spread)."
    )
