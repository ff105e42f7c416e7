"""What a run says in short: verdicts on each prior against the control, with intervals.

A verdict is only as strong as its interval, which holds the chance of the test pairs and that of
the training (:func:`dine.evaluation.statistics.verdicts`); where that holds zero, it is undecided.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import pandas as pd

from dine.config import CONTROL, STAGE1
from dine.evaluation.statistics import verdicts
from dine.reporting import names
from dine.reporting.names import DASH, change, display_name, in_order
from dine.reporting.table import Cell, Columns, Table, laid_out
from dine.results import CLEAN, trained_on


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


def findings(metrics: pd.DataFrame, *, spread: float = 0.0) -> list[Table]:
    """Verdicts on clean targets, then those under other conditions and by other measures.

    Empty where no prior was evaluated beside the control.
    """
    control = effects(metrics, spread=spread)
    errors = effects(metrics, value="mce", spread=spread)
    first = effects(metrics, STAGE1, spread=spread)
    clean = control[control["condition"] == CLEAN]
    others = [
        control[control["condition"] != CLEAN].assign(measure=lambda x: x["condition"]),
        errors[errors["condition"] == CLEAN].assign(measure="mce"),
        first[first["condition"] == CLEAN].assign(measure=STAGE1),
    ]
    caption = _CAPTION + (training_chance(spread) if spread else "")
    made = [
        ("Does a prior lower the Chamfer distance on clean targets?", caption, clean),
        (
            "Under other conditions, and by other measures",
            "",
            in_order(pd.concat(others), ["measure", "objects", "method"]),
        ),
    ]
    return [
        Table("", title, text, **laid_out(_by_place(data)), data=data)
        for title, text, data in made
        if len(data)
    ]


_MEASURES = {
    **{key: f"Chamfer distance, {text.lower()}" for key, text in names.CONDITIONS.items()},
    "mce": "Mean correspondence error",
    STAGE1: "Chamfer distance, against Stage 1",
}


def _by_place(data: pd.DataFrame) -> Columns:
    """A row for each kind of objects and prior, or ``measure`` of these; a column for each place.

    A place is a dataset with a backbone, whether the objects are known or not.
    """
    data = data.assign(dataset=data["dataset"].map(trained_on))
    keys = ["measure", "objects", "method"] if "measure" in data else ["objects", "method"]
    rows = list(data[keys].drop_duplicates().itertuples(index=False, name=None))
    columns: Columns = {}
    if len(keys) > 2:
        columns["", "Measure"] = [_MEASURES[row[0]] for row in rows]
    columns["", "Objects"] = [names.OBJECTS[row[-2]].capitalize() for row in rows]
    columns["", "Prior"] = [display_name(row[-1]) for row in rows]
    for place, here in in_order(data, ["dataset", "backbone"]).groupby(
        ["dataset", "backbone"], sort=False
    ):
        found = here.set_index(keys).to_dict("index")
        columns[tuple(map(display_name, place))] = verdict_cells(found.get(row) for row in rows)
    return columns


def verdict_cells(rows: Iterable[dict | None], name: str = "verdict") -> list[Cell]:
    """Verdicts with the difference in percent of the reference and its interval."""
    return [
        Cell(DASH)
        if row is None
        else Cell(
            f"{row[name]}: {change(row['relative'], row['low'], row['high'])}",
            row[name] == "lower",
            row[name],
        )
        for row in rows
    ]


_CAPTION = (
    "Lower, higher or undecided: the mean of the prior against that of the control, which was "
    "trained alike but with λ = 0. Beside it the difference in percent of the control's mean, over "
    "all levels and strengths, and its 95 % interval. Where that holds zero, the matter is "
    "undecided. The interval is of the test pairs that both methods share: drawn by deformation "
    "where the object is known, and by object where it is unseen. "
    "Known objects are those that were trained on, under deformations that were not; the prior is "
    "defined for these. Unseen objects were not trained on at all."
)


def training_chance(spread: float) -> str:
    """What an interval holds besides the chance of the pairs; ``spread`` is a share."""
    return (
        " It also holds the chance of the training: another seed, or another CPU's rounding, gives "
        f"another network, whose difference varies by {100 * spread:g} % of the reference "
        "(standard deviation; evaluation.training_spread)."
    )
