"""Tables of the report on the evidence."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
import pandas as pd

from dine.data.pairs import RESAMPLED
from dine.evaluation.statistics import NO_BACKBONE
from dine.reporting import names
from dine.reporting.effects import training_chance, verdict_cell
from dine.reporting.evidence.comparisons import LARGE, Evidence, at
from dine.reporting.names import (
    DASH,
    MARKS,
    PARTIAL,
    VALUES,
    display_name,
    join,
    number,
    p_value,
    short,
    signed,
    slug,
)
from dine.reporting.table import Cell, Column, Table, laid_out
from dine.results import CLEAN

LOWER, HIGHER = MARKS["lower"], MARKS["higher"]
Place = tuple[str, str]
_DIAGNOSED = {
    "dataset": "Dataset",
    "backbone": "Backbone",
    "prior": "Prior",
    "nll": "−log p",
    "nll_per_coordinate": "−log p per coordinate",
    "nll_per_component": "−log p per component",
    "generalisation": "Generalisation",
    "specificity": "Specificity",
    "in_span": "Distance in the span",
    "residual": "Residual",
}


def _methods(evidence: Evidence) -> list[Column]:
    """The first columns: what kind of method, and which."""

    def title(row: Mapping[str, Any]) -> str:
        reference = " (reference)" if row["method"] == evidence.reference else ""
        return evidence.title(row["method"]) + reference

    return [
        Column("Kind", lambda row: evidence.methods[row["method"]].kind),
        Column("Method", title),
    ]


def _shows(name: str, decimals: int, scale: float = 1.0) -> Callable[[Mapping[str, Any]], str]:
    return lambda row: number(row[name], decimals, scale)


def _all_data(evidence: Evidence) -> str:
    return join([evidence.where(dataset) for dataset in evidence.datasets])


def _short_place(place: Place) -> str:
    return ", ".join(display_name(x) for x in place if x != NO_BACKBONE)


# --------------------------------------------------------------------------------- in short


def basis_table(evidence: Evidence) -> Table:
    """What everything rests on: the test pairs and trainings of each dataset."""
    networks = evidence.clean[evidence.clean["backbone"] != NO_BACKBONE]
    seeds = networks.groupby(["dataset", "backbone", "method"])["seed"].nunique()
    grouped = evidence.clean.groupby("dataset")
    data = grouped[["pair", "object", "level"]].nunique().reindex(evidence.datasets)
    data["fewest_seeds"] = seeds.groupby("dataset").min()
    data["most_seeds"] = seeds.groupby("dataset").max()
    data["counts"] = [name in dict(evidence.judged) for name in data.index]
    columns = [
        Column("Dataset", lambda row: evidence.where(row["dataset"])),
        Column("Test pairs", lambda row: row["pair"]),
        Column("Objects", lambda row: row["object"]),
        Column("Levels", lambda row: row["level"]),
        Column("Seeds, fewest", _shows("fewest_seeds", 0), "Trainings of a network"),
        Column("Seeds, most", _shows("most_seeds", 0), "Trainings of a network"),
        Column("Counts for the goal", lambda row: "yes" if row["counts"] else "no"),
    ]
    data = data.reset_index()
    caption = (
        f"{_all_data(evidence)}. The same test pairs for all methods, averaged over seeds; "
        "differences are between trainings of the same seeds."
    )
    aside = [_short_place(place) for place in evidence.places if place not in evidence.judged]
    if aside:
        caption += (
            f" {'; '.join(aside)}: shown, but with few methods or pairs, so no part of the goal "
            "or of the order of methods."
        )
    layout = laid_out(data.to_dict("records"), columns)
    return Table("basis", "What this rests on", caption, **layout, data=data)


def verdict_table(evidence: Evidence, place: Place) -> Table:
    """Lower, higher or undecided: every method against the reference at a place."""
    levels = at(evidence.cells, place).groupby(["value", "method"])["verdict"].agg(list).to_dict()
    tables = [evidence.overall(place, condition) for condition in (CLEAN, RESAMPLED)]
    data = pd.concat(tables, ignore_index=True)
    data = data[data["method"].isin(evidence.rivals)]
    keys = ["condition", "value", "method"]
    found = {tuple(row[key] for key in keys): row for row in data.to_dict("records")}

    def tally(row: Mapping[str, Any], value: str) -> str:
        here = levels.get((value, row["method"]), [])
        return f"{here.count('lower')} / {here.count('higher')} of {len(here)}"

    columns = _methods(evidence)
    for value, (long, _, _, _) in VALUES.items():
        for condition in dict.fromkeys(data["condition"]):
            columns.append(
                Column(
                    "Clean targets" if condition == CLEAN else names.CONDITIONS[condition],
                    lambda row, setting=(condition, value): verdict_cell(
                        found.get((*setting, row["method"])), "decided"
                    ),
                    long,
                )
            )
        columns.append(Column(f"Levels {LOWER} / {HIGHER}", partial(tally, value=value), long))
    records = [{"method": m} for m in evidence.rivals if m in set(data["method"])]
    reference = evidence.title(evidence.reference)
    return Table(
        f"verdicts_{slug(*place)}",
        f"Lower or higher than {reference}? {evidence.where(*place)}",
        f"{evidence.where(*place)}. Difference of the mean over all levels to {reference}, in "
        "percent of it, with its 95 % interval, of the pairs, drawn by object."
        + (training_chance(evidence.spread) if evidence.spread else "")
        + " Lower (bold) or higher: the interval holds no zero. Otherwise it is undecided. "
        f"{LOWER} / {HIGHER}: levels of clean targets with a significantly lower and higher mean "
        "(p < 0.05 after Holm).",
        **laid_out(records, columns),
        data=data,
    )


def goal_table(evidence: Evidence) -> Table | None:
    """Whether a method is significantly better at all large levels, and which is the best."""
    goal = evidence.goal
    if goal.empty:
        return None
    every = [evidence.reference, *evidence.rivals]
    order = {value: evidence.ranking(every, value) for value in VALUES}
    needed = int(goal.groupby(["dataset", "backbone"])["levels"].max().sum())
    found = {(*row[:2], row[2]): row for row in goal.itertuples(index=False)}
    total = goal.groupby("method").sum(numeric_only=True)

    def mean(row: Mapping[str, Any], value: str) -> Cell:
        _, _, scale, decimals = VALUES[value]
        means = order[value]
        if row["method"] not in means:
            return Cell(DASH)
        text = number(means[row["method"]], decimals, scale)
        if row["method"] != evidence.reference and evidence.reference in means:
            change = means[row["method"]] / means[evidence.reference] - 1
            text += f" ({signed(100 * change, 1)} %)"
        return Cell(text, row["method"] == means.index[0])

    def of_classical(row: Mapping[str, Any], value: str) -> str:
        levels = row["classical_levels"]
        return f"{row[f'below_classical_{value}']:g} of {levels:g}" if levels > 0 else DASH

    def of_place(row: Mapping[str, Any], place: Place) -> str:
        cell = found.get((*place, row["method"]))
        return f"{cell.mce} · {cell.cd} · {cell.both} / {cell.worse}" if cell else DASH

    columns = _methods(evidence)
    group = f"Mean, levels from {LARGE:g} on"
    columns += [Column(VALUES[v][0], partial(mean, value=v), group) for v in VALUES]
    columns += [
        Column("Reached", lambda row: Cell(f"{row['both']:g} of {needed}", row["both"] == needed)),
        Column("Evaluated", _shows("levels", 0)),
        Column("Both lower", _shows("both_lower", 0)),
    ]
    group = "Below the best classical"
    columns += [Column(VALUES[v][1], partial(of_classical, value=v), group) for v in VALUES]
    group = f"MCE {LOWER} · CD {LOWER} · both {LOWER} / any {HIGHER}"
    for place in dict.fromkeys(zip(goal["dataset"], goal["backbone"], strict=True)):
        text = f"{_short_place(place)}, of {at(goal, place)['levels'].max()}"
        columns.append(Column(text, partial(of_place, place=place), group))
    rows = total.reindex(every).rename_axis("method").reset_index()
    reference = evidence.title(evidence.reference)
    return Table(
        "goal",
        f"Goal: significantly better at every level from {LARGE:g} on",
        f"{_all_data(evidence)}, clean targets. The goal: mean MCE and mean CD both significantly "
        f"lower ({LOWER}) than those of {reference} at every level from {LARGE:g} on, on every "
        f"dataset with every backbone, {needed} cells. Reached: cells of these; evaluated: cells "
        "in which the method was evaluated; both lower: with both means lower, significantly or "
        "not. Mean: over these levels, datasets and backbones, for what was evaluated everywhere; "
        f"in brackets against {reference}; bold: the lowest. Below the best classical: of all "
        "levels, those with a mean below that of the best classical method of the level that was "
        "evaluated on all pairs. By place: levels with a significantly lower mean by MCE, by CD, "
        "by both, and with a significantly higher one by any.",
        **laid_out(rows.to_dict("records"), columns),
        data=goal,
    )


# ------------------------------------------------------------------------------ in detail


def mean_table(
    evidence: Evidence, place: Place, value: str, *, corrupted: bool = False
) -> Table | None:
    """Means of a value by method at a place: by level, or with imperfect targets."""
    long, name, scale, decimals = VALUES[value]
    if corrupted:
        data = at(evidence.corrupted, place)
        shown = data.assign(level=np.nan, mean=data[value])
    else:
        data = pd.concat([at(evidence.by_level, place), at(evidence.pooled, place)])
        shown = data.assign(mean=data[f"{value}_mean"])
    if data.empty:
        return None
    keys = ["condition", "corruption", "level"]
    marks = at(evidence.comparisons, place)
    marks = marks.loc[marks["value"] == value, ["method", *keys, "verdict"]]
    shown = shown.merge(marks, on=["method", *keys], how="left")
    shown["mean"] = (scale * shown["mean"]).round(decimals)
    shown["setting"] = shown.groupby(keys, dropna=False).ngroup()
    can_win = shown["method"].isin([evidence.reference, *evidence.rivals]) & ~shown["partial"]
    lowest = shown["mean"].where(can_win).groupby(shown["setting"]).transform("min")
    shown["best"] = can_win & (shown["mean"] == lowest)
    found = {(row["method"], row["setting"]): row for row in shown.to_dict("records")}

    def mean(record: Mapping[str, Any], setting: int) -> Cell:
        row = found.get((record["method"], setting))
        if row is None or pd.isna(row["mean"]):
            return Cell(DASH)
        mark = MARKS.get(row["verdict"], "")
        text = f"{row['mean']:.{decimals}f}{PARTIAL if row['partial'] else ''} {mark}"
        return Cell(text.strip(), row["best"])

    def change(record: Mapping[str, Any], setting: int) -> str:
        return signed(found.get((record["method"], setting), {}).get(f"{value}_change_percent"), 0)

    columns = _methods(evidence)
    for row in shown.drop_duplicates("setting").sort_values("setting").to_dict("records"):
        setting = row["setting"]
        if corrupted:
            levels = row["levels"].replace(" ", ", ")
            group = f"{names.setting_name(row['condition'], row['corruption'])} (level {levels})"
            columns.append(Column(name, partial(mean, setting=setting), group))
            columns.append(Column("% to clean", partial(change, setting=setting), group))
        elif pd.isna(row["level"]):
            columns.append(Column(name, partial(mean, setting=setting), "All levels"))
        else:
            columns.append(Column(f"{row['level']:g}", partial(mean, setting=setting), "Level"))
    if not corrupted and value == "mce":
        columns += _POOLED
    pooled = at(evidence.pooled, place).set_index("method").to_dict("index")
    records = [
        {"method": method, **pooled.get(method, {})}
        for method in evidence.methods
        if method in set(shown["method"])
    ]
    kind = "with imperfect targets" if corrupted else "by level"
    return Table(
        name=f"{'corrupted_' if corrupted else ''}{value}_{slug(*place)}",
        title=f"{name} {kind}: {evidence.where(*place)}",
        caption=_mean_caption(evidence, place, value, shown, corrupted),
        **laid_out(records, columns),
        data=data,
    )


_POOLED = [
    Column("Failures (%)", _shows("failure_rate", 1, 100), "All levels"),
    Column("Folding (%)", _shows("folding_mean", 1, 100), "All levels"),
    Column("Roughness", _shows("roughness_mean", 3), "All levels"),
    Column(
        "Seconds a pair",
        lambda row: DASH if pd.isna(row["seconds_mean"]) else f"{row['seconds_mean']:.3g}",
        "All levels",
    ),
]


def _mean_caption(
    evidence: Evidence, place: Place, value: str, shown: pd.DataFrame, corrupted: bool
) -> str:
    where, long = evidence.where(*place), VALUES[value][0]
    reference = evidence.title(evidence.reference)
    if corrupted:
        text = (
            f"{where}. {long} to the clean target, mean over test pairs and seeds, and its change "
            "from the same pairs with clean targets."
        )
    else:
        text = f"{where}, clean targets. {long}, mean over test pairs and seeds."
    text += (
        f" Lower is better. Bold: lowest of the methods that register. {LOWER} significantly "
        f"lower, {HIGHER} significantly higher than {reference} (p < 0.05 after Holm)"
        f"{' under the same corruption, all these levels together' if corrupted else ''}."
    )
    if not corrupted and value == "mce":
        true = evidence.roughness_true[place[0]]
        text += f" The true fields have a roughness of {true:.3f}."
    return text + (f" {PARTIAL} on some of the pairs only." if shown["partial"].any() else "")


def answer_table(
    evidence: Evidence, place: Place, value: str, *, by_level: bool = False
) -> Table | None:
    """Every method against the reference at a place: all levels together, or each."""
    long, name, scale, decimals = VALUES[value]
    data = at(evidence.cells, place) if by_level else evidence.overall(place)
    data = data[data["method"].isin(evidence.rivals) & (data["value"] == value)]
    if data.empty:
        return None

    def difference(row: Mapping[str, Any]) -> str:
        found = [number(row[x], decimals, scale) for x in ("difference", "ci_low", "ci_high")]
        return found[0] if pd.isna(row["ci_low"]) else f"{found[0]} [{found[1]}, {found[2]}]"

    def relative(row: Mapping[str, Any]) -> Cell:
        mark = MARKS.get(row["verdict"], "")
        return Cell(f"{signed(row['relative'], 1)} {mark}".strip(), bool(mark))

    columns = [
        *_methods(evidence),
        *([Column("Level", lambda row: f"{row['level']:g}")] if by_level else []),
        Column("Pairs", lambda row: row["pairs"]),
        Column("Mean", _shows("mean_method", decimals, scale), long),
        Column("Reference", _shows("mean_reference", decimals, scale), long),
        Column("Difference [95 % interval]", difference, long),
        Column("%", relative, long),
        Column("p", lambda row: p_value(row["p_holm"]), long),
        Column("Effect", lambda row: signed(row["effect"], 2), long),
        Column("Wins (%)", _shows("win_rate", 0, 100), long),
    ]
    if value == "mce":
        columns += [
            Column("%", _shows("failures_method", 1, 100), "Failures"),
            Column("Reference %", _shows("failures_reference", 1, 100), "Failures"),
            Column("p", lambda row: p_value(row["p_failures"]), "Failures"),
        ]
    which = "each level" if by_level else "all levels together"
    return Table(
        name=f"{'levels' if by_level else 'answer'}_{value}_{slug(*place)}",
        title=f"{name} against {evidence.title(evidence.reference)}, {which}: "
        f"{evidence.where(*place)}",
        caption=f"{evidence.where(*place)}, clean targets, {which}. Difference: method minus "
        "reference, so negative is better; interval: bootstrap over objects; %: of the "
        f"reference's mean; p: Wilcoxon{', after Holm over the levels' if by_level else ''}; "
        "effect: rank-biserial, −1 to 1; wins: pairs on which the method is lower."
        + (" Failures: pairs with an MCE above 0.1, p by McNemar's test." * (value == "mce")),
        **laid_out(data.to_dict("records"), columns),
        data=data,
    )


def seed_table(evidence: Evidence) -> Table | None:
    """How much trainings differ, beside how much pairs differ."""
    data = evidence.pooled[evidence.pooled["seeds"] > 1]
    if data.empty:
        return None
    compared = evidence.comparisons
    compared = compared[(compared["condition"] == CLEAN) & compared["level"].isna()]
    keys = ["dataset", "backbone", "method"]
    wide = compared.pivot(index=keys, columns="value", values="difference")
    wide = wide.reindex(columns=list(VALUES)).add_suffix("_difference").reset_index()
    order = list(evidence.methods)
    shown = data.merge(wide, on=keys, how="left")
    shown = pd.concat(
        at(shown, place).sort_values("method", key=lambda x: x.map(order.index))
        for place in evidence.places
    )
    columns = [
        Column("Dataset", lambda row: display_name(row["dataset"])),
        Column("Backbone", lambda row: display_name(row["backbone"])),
        Column("Method", lambda row: evidence.title(row["method"])),
        Column("Seeds", lambda row: f"{row['seeds']:g}"),
    ]
    labels = {"mean": "Mean", "seed_sd": "sd over seeds", "sd": "sd over pairs"}
    labels["difference"] = "minus reference"
    for value, (long, _, scale, decimals) in VALUES.items():
        columns += [
            Column(text, _shows(f"{value}_{name}", decimals, scale), long)
            for name, text in labels.items()
        ]
    datasets = [d for d in evidence.datasets if (data["dataset"] == d).any()]
    return Table(
        name="seeds",
        title="Spread over seeds and over pairs",
        caption=f"{join([*map(evidence.where, datasets)])}, clean targets, all levels together. "
        "Sd over seeds: standard deviation of the means of the trainings; sd over pairs: of the "
        "pairs, averaged over seeds. A difference from the reference no larger than the sd over "
        "seeds may be luck of the training.",
        **laid_out(shown.to_dict("records"), columns),
        data=data,
    )


def diagnostics_table(evidence: Evidence, found: Sequence[Mapping[str, Any]]) -> Table | None:
    """What ``diagnose`` found about each prior on fields that were not used for the fit."""
    if not found:
        return None
    data = pd.DataFrame(found)
    # A mapping or a list inside would not be a cell.
    data = data[[c for c in data if not data[c].map(lambda x: isinstance(x, dict | list)).any()]]
    data = data[[*(c for c in _DIAGNOSED if c in data), *(c for c in data if c not in _DIAGNOSED)]]

    def shown(row: Mapping[str, Any], name: str) -> str:
        known = name == "prior" and row[name] in evidence.methods
        return evidence.title(row[name]) if known else short(row[name])

    return Table(
        name="diagnostics",
        title="What the priors know",
        caption=f"{join([evidence.where(d) for d in dict.fromkeys(data['dataset'])])}. Measured on "
        "fields that were not used for the fit, normalised frame. −log p: negative "
        "log-likelihood, lower is better; only values per coordinate compare between priors. "
        "Generalisation: how far the prior's closest field is from a new one, lower is better. "
        "Specificity: how far samples are from the nearest training field; low is realistic, but "
        "a prior that repeats what it saw has 0.",
        **laid_out(
            data.to_dict("records"),
            [Column(_DIAGNOSED.get(x, x), partial(shown, name=x)) for x in data],
        ),
        data=data,
    )
