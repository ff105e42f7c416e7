"""What the numbers say, in sentences."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd

from dine.data.pairs import RESAMPLED
from dine.evaluation.statistics import NO_BACKBONE
from dine.reporting.evidence.comparisons import LARGE, PAPER_PRIOR, Evidence, at
from dine.reporting.evidence.wording import VALUES, are, count_of, join, signed
from dine.reporting.tables import display_name

FEW_OBJECTS = 20
"""Below this many objects bootstrap intervals are too narrow, see docs/reference/metrics.md."""


@dataclass(frozen=True)
class Finding:
    """A sentence and, beneath it, what it sums up."""

    text: str
    parts: tuple[str, ...] = ()


def all_findings(evidence: Evidence) -> list[Finding]:
    """What the numbers say, in sentences."""
    found = [
        _paper_prior(evidence),
        _best(evidence, evidence.of_group("prior"), "Of the methods trained with a prior"),
        _best(evidence, [evidence.reference, *evidence.rivals], "Of all methods"),
        *_goal(evidence),
        _other_points(evidence),
        _no_help(evidence),
        _basis(evidence),
        _limits(evidence),
    ]
    return [finding for finding in found if finding is not None]


def _paper_prior(evidence: Evidence) -> Finding | None:
    if evidence.reference == PAPER_PRIOR:
        return None
    cells = evidence.judged_cells
    cells = cells[cells["method"] == PAPER_PRIOR]
    if cells.empty:
        return Finding(
            f"The paper's prior ({PAPER_PRIOR}) was not evaluated on the same targets as "
            f"{evidence.title(evidence.reference)}, so nothing is said about it."
        )
    lower, higher = ((cells["verdict"] == x).sum() for x in ("lower", "higher"))
    if lower and higher:
        answer = "is significantly better than {} at some levels and significantly worse at others"
    elif lower == len(cells):
        answer = "is significantly better than {} at every level, by both measures"
    elif lower:
        answer = "is significantly better than {} at some levels and significantly worse at none"
    elif higher:
        answer = "is significantly worse than {} at some levels and significantly better at none"
    else:
        answer = "cannot be told from {}: no difference is significant"
    parts = []
    for place in evidence.places:
        here = at(cells, place)
        counts = [
            _tally(here[here["value"] == value], name)
            for value, (_, name, _, _) in VALUES.items()
            if (here["value"] == value).any()
        ]
        if counts:
            parts.append(f"{evidence.where(*place)}: {'; '.join(counts)}.")
    reference = evidence.title(evidence.reference)
    return Finding(
        f"The paper's prior, {evidence.title(PAPER_PRIOR)}, {answer.format(reference)}. Of "
        f"{len(cells)} comparisons (each level, by MCE and by CD) {lower} "
        f"{are(lower)} significantly lower and {higher} significantly higher; the others may be "
        "chance.",
        tuple(parts),
    )


def _tally(cells: pd.DataFrame, name: str) -> str:
    lower = int((cells["difference"] < 0).sum())
    sure, worse = (int((cells["verdict"] == x).sum()) for x in ("lower", "higher"))
    return (
        f"{name} lower at {lower} of {len(cells)} levels ({sure} significantly), significantly "
        f"higher at {worse}"
    )


def _best(evidence: Evidence, methods: Sequence[str], who: str) -> Finding | None:
    methods = [name for name in methods if name in evidence.methods]
    if len(methods) < 2:
        return None
    if evidence.large_rows.empty:
        return Finding(f"{who}: no pair has a level of at least {LARGE:g}.")
    winners: dict[str, list[str]] = {}
    for value, (long, _, scale, decimals) in VALUES.items():
        order = evidence.ranking(methods, value)
        if order.empty:
            continue
        unit = " ×10⁻⁴" if scale != 1 else ""
        reference = evidence.ranking([evidence.reference], value)
        beside = ""
        if len(reference) and order.index[0] != evidence.reference:
            change = 100 * (order.iloc[0] / reference.iloc[0] - 1)
            beside = f", {signed(change, 1)} % against {evidence.title(evidence.reference)}"
        winners.setdefault(order.index[0], []).append(
            f"{long} ({scale * order.iloc[0]:.{decimals}f}{unit}{beside})"
        )
    if not winners:
        return Finding(f"{who}: none was evaluated on every dataset with every backbone.")
    words = [
        f"{evidence.title(name)} has the lowest {' and the lowest '.join(won)}"
        for name, won in winners.items()
    ]
    parts = []
    for place in evidence.places:
        best: dict[str, list[str]] = {}
        for value, (_, name, _, _) in VALUES.items():
            for winner in evidence.ranking(methods, value, [place]).index[:1]:
                best.setdefault(evidence.title(winner), []).append(name)
        if best:
            winners_here = join([f"{winner} ({join(by)})" for winner, by in best.items()])
            parts.append(f"{evidence.where(*place)}: {winners_here}.")
    text = (
        f"{who}, over all levels from {LARGE:g} on and all datasets and backbones: "
        f"{', and '.join(words)}."
    )
    return Finding(text, tuple(parts) if len(evidence.places) > 1 else ())


def _goal(evidence: Evidence) -> list[Finding]:
    """Whether a method reaches the goal, and how it stands against classical methods."""
    goal = evidence.goal
    if goal.empty:
        return [Finding(f"Goal: no method can be judged at levels from {LARGE:g} on.")]
    reference = evidence.title(evidence.reference)
    # Cells at which the reference was evaluated; places that a method lacks count against it.
    needed = sum(goal.groupby(["dataset", "backbone"])["levels"].max())
    total = goal.groupby("method", sort=False)[["levels", "both", "both_lower", "worse"]].sum()
    reached = [n for n in total.index if total.loc[n, "both"] == needed]
    partly = [
        n
        for n in total.index
        if total.loc[n, "both"] == total.loc[n, "levels"] and n not in reached
    ]
    text = (
        f"Goal: mean MCE and mean CD both significantly lower than {reference} at every level from "
        f"{LARGE:g} on, on every dataset with every backbone ({needed} cells). "
    )
    shown = [name for name in reached if name in evidence.candidates]
    if reached:
        text += f"Reached by {evidence.titles(reached)}."
    else:
        text += "No method reaches it."
    if partly:
        text += (
            f" {evidence.titles(partly)} {'reach' if len(partly) > 1 else 'reaches'} it wherever "
            "evaluated, which was not everywhere."
        )
    candidates = [name for name in evidence.candidates if name in total.index]
    if not shown and candidates:
        gain = evidence.large.query("value == 'mce'").groupby("method")["relative"].mean()
        closest = max(
            candidates,
            key=lambda n: (total.loc[n, "both"], total.loc[n, "both_lower"], -gain.get(n, np.inf)),
        )
        row = total.loc[closest]
        others = total.index.isin(evidence.classical).any()
        text += (
            f" {'Of the methods that are not classical, closest' if others else 'Closest'} is "
            f"{evidence.title(closest)}: {row['both']} of {needed} cells hold; both means are "
            f"lower, significantly or not, in {row['both_lower']}, and in {row['worse']} at least "
            "one is significantly higher."
        )
        shown = [closest]
    if len(evidence.judged) < len(evidence.places):
        judged = {name for place in evidence.judged for name in place}
        others = (place for place in evidence.places if place not in evidence.judged)
        aside = dict.fromkeys(name for place in others for name in place if name not in judged)
        text += (
            f" {join([display_name(name) for name in aside])}, with few methods or pairs, "
            f"{'do' if len(aside) > 1 else 'does'} not count here or in the order of methods."
        )
    return [Finding(text), *_against_classical(evidence, shown)]


def _against_classical(evidence: Evidence, methods: Sequence[str]) -> list[Finding]:
    if not methods:
        return []
    means = evidence.by_level
    means = pd.concat([at(means, place) for place in evidence.judged])
    classical = means[means["method"].isin(evidence.classical)]
    if classical.empty:
        return [
            Finding(
                "No classical method was evaluated, so how "
                f"{evidence.titles(methods)} {'compares' if len(methods) == 1 else 'compare'} with "
                "these is not known."
            )
        ]
    left_out = [
        n for n in evidence.classical if classical.loc[classical["method"] == n, "partial"].any()
    ]
    classical = classical[~classical["partial"]]
    keys = ["dataset", "backbone", "level"]
    below, parts = [], []
    for method in methods:
        counts, all_lower = [], True
        for value, (_, name, _, _) in VALUES.items():
            column = f"{value}_mean"
            best = classical.groupby(keys)[column].min().rename("best").reset_index()
            both = means[(means["method"] == method) & ~means["partial"]].merge(best, on=keys)
            both = both.dropna(subset=[column, "best"])
            lower = int((both[column] < both["best"]).sum())
            all_lower &= lower == len(both) > 0
            counts.append(f"{name} at {lower} of {len(both)} levels")
        parts.append(f"{evidence.title(method)} is lower in {' and in '.join(counts)}.")
        below += [method] if all_lower else []
    if classical.empty:
        return [Finding("Classical methods were evaluated on some of the pairs only.")]
    rivals = sorted(set(classical["method"]), key=list(evidence.methods).index)
    if len(methods) == 1:
        who = f"{evidence.titles(methods)} is{'' if below else ' not'}"
    elif len(below) in (0, len(methods)):
        who = "all that reach the goal are" if below else "none that reaches the goal is"
    else:
        who = f"{evidence.titles(below)} {are(len(below))}"
    text = (
        f"Against the best classical method of each level ({evidence.titles(rivals)}): {who} "
        "lower by both measures at every level, on every dataset and with every backbone."
    )
    if left_out:
        text += f" {evidence.titles(left_out)}: left out where evaluated on some pairs only."
    return [Finding(text, tuple(parts))]


def _other_points(evidence: Evidence) -> Finding | None:
    """Where targets hold other points than sources, which decides how far the rest carries."""
    means = evidence.corrupted
    means = means[(means["condition"] == RESAMPLED) & means["method"].isin(evidence.methods)]
    if means.empty:
        return None
    able = {evidence.reference, *evidence.rivals}
    parts = []
    for place in evidence.places:
        here = at(means, place)
        here = here[here["pairs"] == here["pairs"].max()].set_index("method")["mce"]
        here = here[here.index.isin(able)].sort_values()
        if len(here) < 2:
            continue
        # The best of all, and what readers will look for beside it.
        shown = [here.index[0]]
        for group in (evidence.classical, evidence.of_group("test time"), [evidence.reference]):
            shown += [name for name in here.index if name in group and name not in shown][:1]
        values = join([f"{evidence.title(name)} {here[name]:.4f}" for name in shown])
        parts.append(f"{evidence.where(*place)}: {values}.")
    text = (
        "The pairs above hold the same points in source and target, which two scans never do, and "
        "a method may match them one to one. Where targets were sampled anew instead, mean "
        "correspondence errors are:"
    )
    return Finding(text, tuple(parts)) if parts else None


def _no_help(evidence: Evidence) -> Finding:
    verdict = evidence.judged_cells.groupby("method")["verdict"].agg(set)
    treated = [
        n for n in evidence.candidates if evidence.methods[n].group != "network" and n in verdict
    ]
    worse = [n for n in treated if "higher" in verdict[n] and "lower" not in verdict[n]]
    nothing = [n for n in treated if verdict[n] == {"none"}]
    text = "What did not help: "
    reference = evidence.title(evidence.reference)
    if worse:
        text += (
            f"{evidence.titles(worse)} {are(len(worse))} significantly worse than {reference} at "
            "some level and significantly better at none."
        )
    else:
        text += (
            f"no method is significantly worse than {reference} at some level without being "
            "significantly better at another."
        )
    if nothing:
        text += f" {evidence.titles(nothing)} cannot be told from it at any level."
    return Finding(text)


def _basis(evidence: Evidence) -> Finding:
    parts = []
    for dataset in evidence.datasets:
        rows = evidence.clean[evidence.clean["dataset"] == dataset]
        networks = rows[rows["backbone"] != NO_BACKBONE]
        seeds = networks.groupby(["backbone", "method"])["seed"].nunique()
        levels = rows["level"].dropna().unique()
        text = (
            f"{evidence.where(dataset)}: {rows['pair'].nunique()} test pairs of "
            f"{count_of(rows['object'].nunique(), 'object')} at {count_of(len(levels), 'level')}"
        )
        if len(seeds):
            low, high = seeds.min(), seeds.max()
            text += f", {count_of(high, 'training seed')} of each network"
            text += f" ({low} of some)" if low < high else ""
        parts.append(f"{text}.")
    made = [d for d in evidence.datasets if evidence.origin(d) == "synthetic"]
    note = "All data are synthetic." if len(made) == len(evidence.datasets) else ""
    if made and not note:
        note = f"The data of {join([display_name(d) for d in made])} are synthetic."
    text = (
        "What this rests on: the same test pairs for all methods, averaged over seeds; differences "
        "are between trainings of the same seeds."
    )
    return Finding(f"{text} {note}".strip(), tuple(parts))


def _limits(evidence: Evidence) -> Finding:
    clean = evidence.clean
    parts = []
    if any(evidence.origin(d) in ("synthetic", "bases") for d in evidence.datasets):
        parts.append(
            "Whether any of this holds on real tissue: the deformations were generated by the same "
            "kind of recipe in training and test."
        )
    objects = clean.groupby("dataset")["object"].nunique()
    if objects.min() < FEW_OBJECTS:
        low, high = objects.min(), objects.max()
        parts.append(
            f"How other objects would do: with {low if low == high else f'{low} to {high}'} test "
            "objects a dataset the intervals are too narrow and the p-values, which take pairs of "
            "one object as independent, too small."
        )
    networks = clean[clean["backbone"] != NO_BACKBONE]
    seeds = networks.groupby(["dataset", "backbone", "method"])["seed"].nunique()
    if len(seeds) and seeds.min() == 1:
        many = "Some networks were" if seeds.max() > 1 else "Every network was"
        parts.append(f"How much another training would differ: {many} trained once.")
    if len(seeds) and 1 < seeds.max() < 10:
        parts.append(
            f"How trainings spread: {seeds.max()} seeds give a rough idea only; a difference no "
            "larger than the spread over seeds (see Seeds) is not established by a small p."
        )
    parts.append(
        "That the best of many methods is as good as it looks: p is corrected over the levels of "
        f"one comparison, not over the {count_of(len(evidence.rivals), 'method')} compared."
    )
    return Finding("What cannot be concluded:", tuple(parts))
