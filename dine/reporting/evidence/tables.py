"""Tables of the report on the evidence."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from dine.evaluation.statistics import NO_BACKBONE
from dine.reporting.evidence.comparisons import LARGE, Evidence, at
from dine.reporting.evidence.wording import (
    DASH,
    HIGHER,
    LOWER,
    MARKS,
    PARTIAL,
    VALUES,
    capital,
    count_of,
    join,
    minus,
    number,
    p_value,
    percent,
    signed,
    slug,
)
from dine.reporting.tables import Cell, Table, display_name, setting_text
from dine.results import CLEAN

_NAMES = (("", "Kind"), ("", "Method"))
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


def level_table(evidence: Evidence, place: tuple[str, str], value: str) -> Table:
    """Means of a value by method and deformation level at a place."""
    long, name, scale, decimals = VALUES[value]
    column = f"{value}_mean"
    data = pd.concat([at(evidence.by_level, place), at(evidence.pooled, place)])
    levels = sorted(data["level"].dropna().unique())
    here = at(evidence.comparisons, place)
    marks = _verdicts(here[here["condition"] == CLEAN], value, "level")
    shown = data.assign(level=data["level"].where(data["level"].notna(), "all"))
    settings: list[Any] = [*levels, "all"]
    can_win = shown[
        ~shown["partial"] & shown["method"].isin([evidence.reference, *evidence.rivals])
    ]
    lowest = (scale * can_win.groupby("level")[column].min()).round(decimals)
    able = set(can_win["method"])
    extras = value == "mce"
    rows, kinds = [], _Kinds(evidence)
    for method in evidence.methods:
        mine = shown[shown["method"] == method].set_index("level")
        if mine.empty:
            continue
        cells = kinds.cells(method)
        for level in settings:
            if level not in mine.index or pd.isna(mine.loc[level, column]):
                cells.append(Cell(DASH))
                continue
            mean = round(scale * mine.loc[level, column], decimals)
            partial = bool(mine.loc[level, "partial"])
            text = f"{mean:.{decimals}f}{PARTIAL if partial else ''}"
            best = not partial and method in able and mean == lowest[level]
            cells.append(Cell(text + marks.get((method, level), ""), best))
        if extras:
            all_ = mine.loc["all"]
            cells += [
                Cell(percent(all_["failure_rate"])),
                Cell(percent(all_["folding_mean"])),
                Cell(number(all_["roughness_mean"], 3)),
                Cell(DASH if pd.isna(all_["seconds_mean"]) else f"{all_['seconds_mean']:.3g}"),
            ]
        rows.append(tuple(cells))
    header = [*_NAMES, *(("Level", f"{level:g}") for level in levels), ("All levels", name)]
    if extras:
        pooled = ("Failures (%)", "Folding (%)", "Roughness", "Seconds a pair")
        header += [("All levels", label) for label in pooled]
    unit = " in units of 10⁻⁴" if scale != 1 else ""
    caption = (
        f"{evidence.where(*place)}, clean targets. {capital(long)}{unit}, mean over "
        f"test pairs and seeds; lower is better. Bold: lowest of the methods that register. "
        f"{LOWER} significantly lower, {HIGHER} significantly higher than "
        f"{evidence.title(evidence.reference)} (p < 0.05 after Holm)."
    )
    if extras:
        true = evidence.roughness_true[place[0]]
        caption += f" The true fields have a roughness of {true:.3f}."
    if data["partial"].any():
        caption += f" {PARTIAL} evaluated on some of the pairs only."
    return Table(
        name=f"{value}_{slug(*place)}",
        title=f"{name} by level: {evidence.where(*place)}",
        caption=caption,
        header=tuple(header),
        rows=tuple(rows),
        data=data,
    )


def goal_table(evidence: Evidence) -> Table:
    """At how many large levels each method is significantly better, by place."""
    goal = evidence.goal
    places = [place for place in evidence.places if len(at(goal, place))]
    rows, kinds = [], _Kinds(evidence)
    needed = int(sum(at(goal, place)["levels"].max() for place in places))
    for method in evidence.rivals:
        mine = goal[goal["method"] == method]
        if mine.empty:
            continue
        cells = [*kinds.cells(method), Cell(f"{mine['both'].sum()} of {needed}")]
        for place in places:
            here = at(mine, place)
            for name in ("mce", "cd", "both", "worse"):
                cells.append(Cell(str(here[name].iloc[0]) if len(here) else DASH))
        rows.append(tuple(cells))
    header = [*_NAMES, ("", "Goal cells")]
    for place in places:
        levels = at(goal, place)["levels"].max()
        group = ", ".join(display_name(x) for x in place if x != NO_BACKBONE)
        group += f": of {count_of(levels, 'level')}"
        header += [(group, label) for label in (f"MCE {LOWER}", f"CD {LOWER}")]
        header += [(group, f"both {LOWER}"), (group, f"any {HIGHER}")]
    return Table(
        name="goal",
        title=f"At how many levels from {LARGE:g} on is each method significantly better?",
        caption=f"{join([evidence.where(d) for d in evidence.datasets])}, clean targets. Number of "
        f"levels with a significantly lower ({LOWER}) mean than "
        f"{evidence.title(evidence.reference)} by MCE, by CD and by both, and with a significantly "
        f"higher ({HIGHER}) one by any. Goal cells: both, at all places together; the goal is all "
        f"{needed}.",
        header=tuple(header),
        rows=tuple(rows),
        data=goal,
    )


def answer_table(
    evidence: Evidence, place: tuple[str, str], value: str, *, by_level: bool = False
) -> Table | None:
    """Every method against the reference at a place: all levels together, or each."""
    long, name, scale, decimals = VALUES[value]
    data = at(evidence.cells, place) if by_level else evidence.overall(place)
    data = data[data["method"].isin(evidence.rivals) & (data["value"] == value)]
    if data.empty:
        return None
    failures = value == "mce"
    rows, kinds = [], _Kinds(evidence)
    for method in evidence.rivals:
        for row in data[data["method"] == method].to_dict("records"):
            cells = kinds.cells(method)
            cells += [Cell(f"{row['level']:g}")] if by_level else []
            cells += [Cell(str(row["pairs"])), *_compared(row, scale, decimals)]
            if failures:
                cells += [
                    Cell(percent(row["failures_method"])),
                    Cell(percent(row["failures_reference"])),
                    Cell(p_value(row["p_failures"])),
                ]
            rows.append(tuple(cells))
    unit = " ×10⁻⁴" if scale != 1 else ""
    group = f"{capital(long)}{unit}"
    labels = ("Mean", "Reference", "Difference [95 % interval]", "%", "p", "Effect", "Wins (%)")
    header = [*_NAMES, *([("", "Level")] if by_level else []), ("", "Pairs")]
    header += [(group, label) for label in labels]
    if failures:
        header += [("Failures", label) for label in ("%", "Reference %", "p")]
    which = "each level" if by_level else "all levels together"
    caption = (
        f"{evidence.where(*place)}, clean targets, {which}. {capital(long)}{unit}. "
        "Difference: method minus reference, so negative is better; interval: bootstrap over "
        "objects; %: of the reference's mean; p: Wilcoxon"
        + (", after Holm over the levels" if by_level else "")
        + "; effect: rank-biserial, −1 to 1; wins: pairs on which the method is lower."
    )
    if failures:
        caption += " Failures: pairs with an MCE above 0.1, p by McNemar's test."
    return Table(
        name=f"{'levels' if by_level else 'answer'}_{value}_{slug(*place)}",
        title=f"{name} against {evidence.title(evidence.reference)}, {which}: "
        f"{evidence.where(*place)}",
        caption=caption,
        header=tuple(header),
        rows=tuple(rows),
        data=data,
    )


def _compared(row: Mapping[str, Any], scale: float, decimals: int) -> list[Cell]:
    low, high = (number(row[name], decimals, scale) for name in ("ci_low", "ci_high"))
    interval = "" if pd.isna(row["ci_low"]) else f" [{low}, {high}]"
    mark = MARKS[row["verdict"]]
    return [
        Cell(number(row["mean_method"], decimals, scale)),
        Cell(number(row["mean_reference"], decimals, scale)),
        Cell(number(row["difference"], decimals, scale) + interval),
        Cell(signed(row["relative"], 1) + mark, bool(mark)),
        Cell(p_value(row["p_holm"])),
        Cell(signed(row["effect"], 2)),
        Cell(number(row["win_rate"], 0, 100)),
    ]


def corruption_table(evidence: Evidence, place: tuple[str, str], value: str) -> Table | None:
    """Means under noise, outliers and on resampled targets, and the change from clean ones."""
    data = at(evidence.corrupted, place)
    if data.empty:
        return None
    long, name, scale, decimals = VALUES[value]
    order = {"deformation": 0, "noise": 1, "outliers": 2, "resampled": 3}
    settings = sorted(
        set(zip(data["condition"], data["corruption"], strict=True)),
        key=lambda setting: (order[setting[0]], setting[1]),
    )
    here = at(evidence.comparisons, place)
    corrupted = here[(here["condition"] != CLEAN) & here["level"].isna()]
    marks = _verdicts(corrupted, value, "condition", "corruption")
    lowest = {}
    able = {evidence.reference, *evidence.rivals}
    for key, some in data[data["method"].isin(able)].groupby(["condition", "corruption"]):
        full = some[some["pairs"] == some["pairs"].max()]
        lowest[key] = round(scale * full[value].min(), decimals)
    rows, kinds = [], _Kinds(evidence)
    for method in evidence.methods:
        mine = data[data["method"] == method].set_index(["condition", "corruption"])
        if mine.empty:
            continue
        cells = kinds.cells(method)
        for setting in settings:
            if setting not in mine.index or pd.isna(mine.loc[setting, value]):
                cells += [Cell(DASH)] * 2
                continue
            row = mine.loc[setting]
            mean = round(scale * row[value], decimals)
            bold = mean == lowest.get(setting) and method in able
            text = f"{mean:.{decimals}f}{marks.get((method, *setting), '')}"
            cells += [Cell(text, bold), Cell(signed(row[f"{value}_change_percent"], 0))]
        rows.append(tuple(cells))
    header = list(_NAMES)
    for setting in settings:
        levels = data.loc[
            (data["condition"] == setting[0]) & (data["corruption"] == setting[1]), "levels"
        ].iloc[0]
        group = f"{setting_text(*setting)} (level {levels.replace(' ', ', ')})"
        header += [(group, name), (group, "% to clean")]
    unit = " in units of 10⁻⁴" if scale != 1 else ""
    return Table(
        name=f"corrupted_{value}_{slug(*place)}",
        title=f"{name} with imperfect targets: {evidence.where(*place)}",
        caption=f"{evidence.where(*place)}. {capital(long)}{unit} to the clean target, "
        "mean over test pairs and seeds, and its change from the same pairs with clean targets. "
        f"{LOWER} and {HIGHER}: significantly lower and higher than "
        f"{evidence.title(evidence.reference)} under the same corruption, all these levels "
        "together. Bold: lowest of the methods that register.",
        header=tuple(header),
        rows=tuple(rows),
        data=data,
    )


def seed_table(evidence: Evidence) -> Table | None:
    """How much trainings differ, beside how much pairs differ."""
    data = evidence.pooled[evidence.pooled["seeds"] > 1]
    if data.empty:
        return None
    rows = []
    for place in evidence.places:
        here = at(data, place).set_index("method")
        compared = evidence.overall(place).set_index(["method", "value"])["difference"]
        for method in [name for name in evidence.methods if name in here.index]:
            row = here.loc[method]
            cells = [*map(display_name, place), evidence.title(method), f"{row['seeds']:g}"]
            for value, (_, _, scale, decimals) in VALUES.items():
                seeds, pairs = row[f"{value}_seed_sd"], row[f"{value}_sd"]
                cells += [
                    number(row[f"{value}_mean"], decimals, scale),
                    number(seeds, decimals, scale),
                    number(pairs, decimals, scale),
                    number(compared.get((method, value), np.nan), decimals, scale),
                ]
            rows.append(tuple(Cell(text) for text in cells))
    labels = ("Mean", "sd over seeds", "sd over pairs", "minus reference")
    groups = ("Mean correspondence error", "Chamfer distance ×10⁻⁴")
    header = [("", label) for label in ("Dataset", "Backbone", "Method", "Seeds")]
    header += [(group, label) for group in groups for label in labels]
    shown = [d for d in evidence.datasets if (data["dataset"] == d).any()]
    return Table(
        name="seeds",
        title="Spread over seeds and over pairs",
        caption=f"{join([evidence.where(d) for d in shown])}, clean targets, all levels together. "
        "Sd over seeds: standard deviation of the means of the trainings; sd over pairs: of the "
        "pairs, averaged over seeds. A difference from the reference no larger than the sd over "
        "seeds may be luck of the training.",
        header=tuple(header),
        rows=tuple(rows),
        data=data,
    )


def diagnostics_table(evidence: Evidence, found: Sequence[Mapping[str, Any]]) -> Table | None:
    """What ``diagnose`` found about each prior on fields that were not used for the fit."""
    if not found:
        return None
    data = pd.DataFrame(found)
    # A mapping or a list inside would not be a cell.
    data = data[[c for c in data if not data[c].map(lambda x: isinstance(x, dict | list)).any()]]
    columns = [*(c for c in _DIAGNOSED if c in data), *(c for c in data if c not in _DIAGNOSED)]
    rows = []
    for record in data[columns].to_dict("records"):
        rows.append(tuple(Cell(diagnosed(evidence, *entry)) for entry in record.items()))
    return Table(
        name="diagnostics",
        title="What the priors know",
        caption=f"{join(_places_named(evidence, data))}. Measured on fields that were not used for "
        "the fit, normalised frame. −log p: negative log-likelihood, lower is better; only values "
        "per coordinate compare between priors. Generalisation: how far the prior's closest field "
        "is from a new one, lower is better. Specificity: how far samples are from the nearest "
        "training field; low is realistic, but a prior that repeats what it saw has 0.",
        header=tuple(("", _DIAGNOSED.get(name, name)) for name in columns),
        rows=tuple(rows),
        data=data[columns],
    )


def diagnosed(evidence: Evidence, name: str, value: Any) -> str:
    if name == "prior":
        return evidence.title(value) if value in evidence.methods else display_name(value)
    if isinstance(value, str):
        return display_name(value)
    if value is None or pd.isna(value):
        return DASH
    return minus(f"{value:.4g}")


def _places_named(evidence: Evidence, data: pd.DataFrame) -> list[str]:
    return [evidence.where(d) for d in dict.fromkeys(data["dataset"])]


def _verdicts(comparisons: pd.DataFrame, value: str, *keys: str) -> dict[tuple, str]:
    """The mark of each method and setting; those of all levels have no level."""
    found = {}
    for row in comparisons[comparisons["value"] == value].to_dict("records"):
        setting = ("all" if pd.isna(row[key]) else row[key] for key in keys)
        found[row["method"], *setting] = MARKS[row["verdict"]]
    return found


class _Kinds:
    """First column of a table: the heading of a group, only where it begins."""

    def __init__(self, evidence: Evidence):
        self.evidence = evidence
        self.last = ""

    def cells(self, method: str) -> list[Cell]:
        kind = self.evidence.methods[method].kind
        first, self.last = kind != self.last, kind
        name = self.evidence.title(method)
        if method == self.evidence.reference:
            name += " (reference)"
        return [Cell(kind if first else ""), Cell(name)]
