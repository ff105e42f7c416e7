"""Tables of the report on the evidence."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from dine.data.pairs import RESAMPLED
from dine.evaluation.statistics import NO_BACKBONE
from dine.reporting import names
from dine.reporting.comparisons import (
    LARGE,
    EvidenceStatistics,
    Place,
    at,
    training_chance,
    verdict_cells,
)
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
from dine.reporting.table import Cell, Columns, Table, laid_out
from dine.results import CLEAN

LOWER, HIGHER = MARKS["lower"], MARKS["higher"]
GOAL_CELLS = f"Levels with both {LOWER} / any {HIGHER}"
Row = Mapping[str, Any]
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


def _methods(evidence: EvidenceStatistics, methods: Iterable[str]) -> Columns:
    """The first columns: what kind of method, and which."""
    methods = list(methods)
    reference = {evidence.reference: " (reference)"}
    return {
        ("", "Kind"): [evidence.methods[name].kind for name in methods],
        ("", "Method"): [evidence.title(name) + reference.get(name, "") for name in methods],
    }


def _all_data(evidence: EvidenceStatistics, datasets: Iterable[str] | None = None) -> str:
    return join([evidence.where(name) for name in datasets or evidence.datasets])


def _short_place(place: Place) -> str:
    return ", ".join(display_name(x) for x in place if x != NO_BACKBONE)


def _marked(text: str, verdict: Any) -> str:
    return f"{text} {MARKS.get(verdict, '')}".strip()


def written(comparisons: pd.DataFrame) -> pd.DataFrame:
    """Comparisons as files of the evidence name them: ``verdict`` is of the test there."""
    named = comparisons.rename(columns={"verdict": "decided", "significant": "verdict"})
    last = ["low", "high", "decided"]
    return named[[*(name for name in named if name not in last), *last]]


# --------------------------------------------------------------------------------- in short


def basis_table(evidence: EvidenceStatistics) -> Table:
    """What everything rests on: the test pairs and trainings of each dataset."""
    networks = evidence.clean[evidence.clean["backbone"] != NO_BACKBONE]
    seeds = networks.groupby(["dataset", "backbone", "method"])["seed"].nunique()
    data = evidence.clean.groupby("dataset")[["pair", "object", "level"]].nunique()
    data["fewest_seeds"] = seeds.groupby("dataset").min()
    data["most_seeds"] = seeds.groupby("dataset").max()
    data = data.reindex(evidence.datasets)
    judged = dict(evidence.judged)
    seeds = "Trainings of a network"
    columns = {
        ("", "Dataset"): [evidence.where(name) for name in data.index],
        ("", "Test pairs"): data["pair"],
        ("", "Objects"): data["object"],
        ("", "Levels"): data["level"],
        (seeds, "Seeds, fewest"): [number(x, 0) for x in data["fewest_seeds"]],
        (seeds, "Seeds, most"): [number(x, 0) for x in data["most_seeds"]],
        ("", "Counts for the goal"): ["yes" if name in judged else "no" for name in data.index],
    }
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
    title = "What this rests on"
    return Table("basis", title, caption, **laid_out(columns), data=data.reset_index())


def overview_table(evidence: EvidenceStatistics) -> Table:
    """Lower, higher or undecided on clean targets: every method, at every place, by both values."""
    columns = _methods(evidence, evidence.rivals)
    for value, (long, _, _, _) in VALUES.items():
        for place in evidence.places:
            found = evidence.overall(place)
            found = found[found["value"] == value]
            columns[long, _short_place(place)] = verdict_cells(found, ["method"], evidence.rivals)
    reference = evidence.title(evidence.reference)
    caption = (
        f"{_all_data(evidence)}, clean targets. Difference of the mean over all levels to "
        f"{reference}, in percent of it, with its 95 % interval, of the pairs drawn by cluster. "
        "Lower or higher: the interval holds no zero. Otherwise the matter is undecided."
    )
    caption += training_chance(evidence.spread)
    title = f"Lower or higher than {reference}?"
    return Table("", title, caption, **laid_out(columns), data=evidence.comparisons)


def verdict_table(evidence: EvidenceStatistics, place: Place) -> Table:
    """Lower, higher or undecided: every method against the reference at a place."""
    data = pd.concat([evidence.overall(place, condition) for condition in (CLEAN, RESAMPLED)])
    data = data[data["method"].isin(evidence.rivals)]
    methods = list(dict.fromkeys(data["method"]))
    levels = (
        at(evidence.cells, place).groupby(["value", "method"])["significant"].agg(list).to_dict()
    )
    columns = _methods(evidence, methods)
    for value, (long, _, _, _) in VALUES.items():
        for condition in dict.fromkeys(data["condition"]):
            label = "Clean targets" if condition == CLEAN else names.CONDITIONS[condition]
            found = data[(data["value"] == value) & (data["condition"] == condition)]
            columns[long, label] = verdict_cells(found, ["method"], methods)
        tallies = [levels.get((value, name), []) for name in methods]
        columns[long, f"Levels {LOWER} / {HIGHER}"] = [
            f"{x.count('lower')} / {x.count('higher')} of {len(x)}" for x in tallies
        ]
    reference, where = evidence.title(evidence.reference), evidence.where(*place)
    return Table(
        f"verdicts_{slug(*place)}",
        f"Lower or higher than {reference}? {where}",
        f"{where}. Difference of the mean over all levels to {reference}, in percent of it, with "
        f"its 95 % interval. Bold: lower. {LOWER} / {HIGHER}: levels of clean targets with a "
        "significantly lower and higher mean.",
        **laid_out(columns),
        data=written(data),
    )


def goal_table(evidence: EvidenceStatistics) -> Table | None:
    """Whether a method is significantly better at all large levels, and which is the best."""
    goal = evidence.goal
    if goal.empty:
        return None
    methods = [evidence.reference, *evidence.rivals]
    needed = int(goal.groupby(["dataset", "backbone"])["levels"].max().sum())
    total = goal.groupby("method").sum(numeric_only=True).reindex(methods)
    columns = _methods(evidence, methods)
    for value in VALUES:
        columns[f"Mean, levels from {LARGE:g} on", VALUES[value][0]] = _ranked(evidence, value)
    columns["", "Reached"] = [
        Cell(DASH if pd.isna(x) else f"{x:g} of {needed}", x == needed) for x in total["both"]
    ]
    columns["", "Evaluated"] = [number(x, 0) for x in total["levels"]]
    columns["", "Both lower"] = [number(x, 0) for x in total["both_lower"]]
    for value in VALUES:
        below = zip(total[f"below_classical_{value}"], total["classical_levels"], strict=True)
        columns["Below the best classical", VALUES[value][1]] = [
            f"{x:g} of {levels:g}" if levels > 0 else DASH for x, levels in below
        ]
    for place in dict.fromkeys(zip(goal["dataset"], goal["backbone"], strict=True)):
        found = at(goal, place).set_index("method").to_dict("index")
        columns[GOAL_CELLS, _short_place(place)] = [
            "{both} / {worse} of {levels}".format(**found[name]) if name in found else DASH
            for name in methods
        ]
    reference = evidence.title(evidence.reference)
    return Table(
        "goal",
        f"Goal: significantly better at every level from {LARGE:g} on",
        f"{_all_data(evidence)}, clean targets. The goal: mean MCE and mean CD both significantly "
        f"lower ({LOWER}) than those of {reference} at every level from {LARGE:g} on, on every "
        f"dataset with every backbone, {needed} cells. Reached: cells of these; evaluated: cells "
        "in which the method was evaluated; both lower: with both means lower, significantly or "
        "not. Mean: over these levels, datasets and backbones, of what was evaluated everywhere; "
        f"in brackets against {reference}; bold: the lowest. Below the best classical: levels with "
        "a mean below that of the best classical method that was evaluated on all pairs.",
        **laid_out(columns),
        data=goal,
    )


def _ranked(evidence: EvidenceStatistics, value: str) -> list[Cell]:
    """The mean at large levels of the reference and every rival, with the change in percent."""
    methods = [evidence.reference, *evidence.rivals]
    means = evidence.ranking(methods, value)
    _, _, scale, decimals = VALUES[value]
    cells = []
    for name in methods:
        text = number(means.get(name), decimals, scale)
        if name != evidence.reference and {name, evidence.reference} <= set(means.index):
            change = 100 * (means[name] / means[evidence.reference] - 1)
            text += f" ({signed(change, 1)} %)"
        cells.append(Cell(text, name in means.index[:1]))
    return cells


# ------------------------------------------------------------------------------ in detail


def mean_table(
    evidence: EvidenceStatistics, place: Place, value: str, *, corrupted: bool = False
) -> Table | None:
    """Means of a value by method at a place: by level, or with imperfect targets."""
    _, name, scale, decimals = VALUES[value]
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
    marks = marks.loc[marks["value"] == value, ["method", *keys, "significant"]]
    shown = shown.merge(marks, on=["method", *keys], how="left")
    shown["mean"] = (scale * shown["mean"]).round(decimals)
    can_win = shown["method"].isin([evidence.reference, *evidence.rivals]) & ~shown["partial"]
    shown["best"] = shown["mean"].where(can_win)
    methods = [name for name in evidence.methods if name in set(shown["method"])]
    columns = _methods(evidence, methods)
    for (condition, corruption, level), some in shown.groupby(keys, dropna=False):
        some = some.assign(best=some["best"] == some["best"].min()).set_index("method")
        rows = some.reindex(methods).to_dict("records")
        group = "All levels" if pd.isna(level) else "Level"
        if corrupted:
            levels = some["levels"].iloc[0].replace(" ", ", ")
            group = f"{names.setting_name(condition, corruption)} (level {levels})"
        label = name if pd.isna(level) else f"{level:g}"
        columns[group, label] = [_mean_cell(row, decimals) for row in rows]
        if corrupted:
            changes = [signed(row[f"{value}_change_percent"], 0) for row in rows]
            columns[group, "% to clean"] = changes
        elif pd.isna(level) and value == "mce":
            columns |= _pooled(rows)
    kind = "with imperfect targets" if corrupted else "by level"
    return Table(
        name=f"{'corrupted_' if corrupted else ''}{value}_{slug(*place)}",
        title=f"{name} {kind}: {evidence.where(*place)}",
        caption=_mean_caption(evidence, place, value, shown, corrupted),
        **laid_out(columns),
        data=data,
    )


def _mean_cell(row: Row, decimals: int) -> Cell:
    if pd.isna(row["mean"]):
        return Cell(DASH)
    text = f"{row['mean']:.{decimals}f}{PARTIAL if row['partial'] else ''}"
    return Cell(_marked(text, row["significant"]), bool(row["best"]))


def _pooled(rows: Sequence[Row]) -> Columns:
    """What is known besides, over all levels."""
    group = "All levels"
    return {
        (group, "Failures (%)"): [number(row["failure_rate"], 1, 100) for row in rows],
        (group, "Folding (%)"): [number(row["folding_mean"], 1, 100) for row in rows],
        (group, "Roughness"): [number(row["roughness_mean"], 3) for row in rows],
        (group, "Seconds a pair"): [short(float(f"{row['seconds_mean']:.3g}")) for row in rows],
    }


def _mean_caption(
    evidence: EvidenceStatistics, place: Place, value: str, shown: pd.DataFrame, corrupted: bool
) -> str:
    where, long = evidence.where(*place), VALUES[value][0]
    if corrupted:
        text = (
            f"{where}. {long} to the clean target, mean over test pairs and seeds, and its change "
            "from the same pairs with clean targets."
        )
    else:
        text = f"{where}, clean targets. {long}, mean over test pairs and seeds."
    text += (
        f" Lower is better. Bold: lowest of the methods that register. {LOWER} significantly "
        f"lower, {HIGHER} significantly higher than {evidence.title(evidence.reference)} (p < 0.05 "
        f"after Holm){' under the same corruption, levels together' if corrupted else ''}."
    )
    if not corrupted and value == "mce":
        true = evidence.roughness_true[place[0]]
        text += f" The true fields have a roughness of {true:.3f}."
    return text + (f" {PARTIAL} on some of the pairs only." if shown["partial"].any() else "")


def answer_table(
    evidence: EvidenceStatistics, place: Place, value: str, *, by_level: bool = False
) -> Table | None:
    """Every method against the reference at a place: all levels together, or each."""
    long, name, scale, decimals = VALUES[value]
    data = at(evidence.cells, place) if by_level else evidence.overall(place)
    data = data[data["method"].isin(evidence.rivals) & (data["value"] == value)]
    if data.empty:
        return None
    rows = data.to_dict("records")
    columns = _methods(evidence, data["method"])
    if by_level:
        columns["", "Level"] = [f"{row['level']:g}" for row in rows]
    columns["", "Pairs"] = data["pairs"]
    for label, key in (("Mean", "mean_method"), ("Reference", "mean_reference")):
        columns[long, label] = [number(row[key], decimals, scale) for row in rows]
    columns[long, "Difference [95 % interval]"] = [_difference(x, decimals, scale) for x in rows]
    columns[long, "%"] = [
        Cell(_marked(signed(row["relative"], 1), row["significant"]), row["significant"] in MARKS)
        for row in rows
    ]
    columns[long, "p"] = [p_value(row["p_holm"]) for row in rows]
    columns[long, "Effect"] = [signed(row["effect"], 2) for row in rows]
    columns[long, "Wins (%)"] = [number(row["win_rate"], 0, 100) for row in rows]
    if value == "mce":
        for label, key in (("%", "failures_method"), ("Reference %", "failures_reference")):
            columns["Failures", label] = [number(row[key], 1, 100) for row in rows]
        columns["Failures", "p"] = [p_value(row["p_failures"]) for row in rows]
    which = "each level" if by_level else "all levels together"
    where = evidence.where(*place)
    return Table(
        name=f"{'levels' if by_level else 'answer'}_{value}_{slug(*place)}",
        title=f"{name} against {evidence.title(evidence.reference)}, {which}: {where}",
        caption=f"{where}, clean targets, {which}. Difference: method minus reference, so negative "
        "is better; interval: bootstrap over clusters; %: of the reference's mean; p: Wilcoxon"
        f"{', after Holm over the levels' if by_level else ''}; effect: rank-biserial, −1 to 1; "
        "wins: pairs on which the method is lower."
        + (" Failures: pairs with an MCE above 0.1, p by McNemar's test." * (value == "mce")),
        **laid_out(columns),
        data=written(data),
    )


def _difference(row: Row, decimals: int, scale: float) -> str:
    text = number(row["difference"], decimals, scale)
    ends = [number(row[name], decimals, scale) for name in ("ci_low", "ci_high")]
    return text if pd.isna(row["ci_low"]) else f"{text} [{', '.join(ends)}]"


def seed_table(evidence: EvidenceStatistics) -> Table | None:
    """How much trainings differ, beside how much pairs differ."""
    data = evidence.pooled[evidence.pooled["seeds"] > 1]
    if data.empty:
        return None
    labels = {"mean": "Mean", "seed_sd": "sd over seeds", "sd": "sd over pairs"}
    columns: Columns = {
        ("", "Dataset"): data["dataset"].map(display_name),
        ("", "Backbone"): data["backbone"].map(display_name),
        ("", "Method"): data["method"].map(evidence.title),
        ("", "Seeds"): data["seeds"],
    }
    for value, (long, _, scale, decimals) in VALUES.items():
        for name, label in labels.items():
            column = data[f"{value}_{name}"]
            columns[long, label] = [number(x, decimals, scale) for x in column]
    return Table(
        name="seeds",
        title="Spread over seeds and over pairs",
        caption=f"{_all_data(evidence, dict.fromkeys(data['dataset']))}, clean targets, all levels "
        "together. Sd over seeds: standard deviation of the means of the trainings; sd over pairs: "
        "of the pairs, averaged over seeds. A difference from the reference no larger than the sd "
        "over seeds may be luck of the training.",
        **laid_out(columns),
        data=data,
    )


def diagnostics_table(evidence: EvidenceStatistics, found: Sequence[Row]) -> Table | None:
    """What ``diagnose`` found about each prior on fields that were not used for the fit."""
    if not found:
        return None
    data = pd.DataFrame(found)
    # A mapping or a list inside would not be a cell.
    data = data[[c for c in data if not data[c].map(lambda x: isinstance(x, dict | list)).any()]]
    data = data[[*(c for c in _DIAGNOSED if c in data), *(c for c in data if c not in _DIAGNOSED)]]
    titles = {name: method.title for name, method in evidence.methods.items()}
    priors = data["prior"].map(lambda name: titles.get(name, name))
    columns = {
        ("", _DIAGNOSED.get(name, name)): priors if name == "prior" else data[name] for name in data
    }
    columns = {key: [short(value) for value in column] for key, column in columns.items()}
    return Table(
        name="diagnostics",
        title="What the priors know",
        caption=f"{_all_data(evidence, dict.fromkeys(data['dataset']))}. Measured on fields that "
        "were not used for the fit, normalised frame. −log p: negative log-likelihood, lower is "
        "better; only values per coordinate compare between priors. Generalisation: how far the "
        "prior's closest field is from a new one, lower is better. Specificity: how far samples "
        "are from the nearest training field; low is realistic, but a prior that repeats what it "
        "saw has 0.",
        **laid_out(columns),
        data=data,
    )
