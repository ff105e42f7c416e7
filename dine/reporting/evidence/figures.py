"""Figures of the report on the evidence."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from dine.config import STAGE1
from dine.evaluation.statistics import NO_BACKBONE
from dine.reporting.evidence.comparisons import GROUPS, LARGE, PAPER_PRIOR, EvidenceStatistics, at
from dine.reporting.figures import method_styles, new_figure, plain, plain_axes
from dine.reporting.names import VALUES, display_name, signed

_COLOURS = {
    "none": "#999999",
    "classical": "#E69F00",
    "network": "#D55E00",
    "control": "#555555",
    "prior": "#0072B2",
    "data term": "#CC79A7",
    "test time": "#009E73",
    "other": "#56B4E9",
}
_MARKERS = "o^sDvP*X<>phd"
_BESIDE = {"loc": "outside right upper", "fontsize": 8, "frameon": False}


def forest_figure(evidence: EvidenceStatistics, place: tuple[str, str]) -> Figure | None:
    """Relative difference of the mean at large levels to the reference, one row per method."""
    data = at(evidence.large, place)
    methods = [name for name in evidence.rivals if (data["method"] == name).any()]
    if not methods:
        return None
    # Top to bottom: the heading of each group, then its methods.
    rows: list[tuple[str, str | None]] = []
    for name in methods:
        group = evidence.methods[name].group
        rows += [(group, None)] if not rows or rows[-1][0] != group else []
        rows.append((group, name))
    where = ", ".join(display_name(x) for x in place if x != NO_BACKBONE)
    figure = new_figure(
        10.4,
        1.7 + 0.27 * len(rows),
        f"{where}: difference to {evidence.title(evidence.reference)}",
        evidence.origin(place[0]),
        f"All levels from {LARGE:g} on. Bars: 95 % bootstrap interval over objects. Filled: "
        "p < 0.05 (Wilcoxon). Triangles: beyond the axis.",
    )
    panels = figure.subplots(1, 2, sharey=True)
    for axes, value in zip(panels, VALUES, strict=True):
        some = data[data["value"] == value].set_index("method")
        ends = 100 * some[["ci_low", "ci_high"]].div(some["mean_reference"], axis=0)
        some = some.assign(low=ends["ci_low"], high=ends["ci_high"])
        shown = ["relative", "low", "high"]
        inner = [name for name in some.index if name in evidence.candidates] or list(some.index)
        reach = float(np.clip(1.1 * some.loc[inner, shown].abs().max(axis=None), 5, 100))
        for y, (group, name) in enumerate(rows):
            if name in some.index:
                _forest_row(axes, y, some.loc[name], _COLOURS[group], reach)
        axes.axvline(0, color="black", linewidth=1)
        axes.set_xlim(-reach, reach)
        name = VALUES[value][0].partition(" ×")[0]
        axes.set_xlabel(f"{name}: lower ← difference (%) → higher", fontsize=9)
        axes.tick_params(axis="y", length=0)
        plain_axes(axes).grid(axis="y", visible=False)
    panels[0].set_ylim(len(rows) - 0.4, -0.6)
    texts = [GROUPS[g] if n is None else plain(evidence.title(n)) for g, n in rows]
    panels[0].set_yticks(range(len(rows)), texts, fontsize=9)
    for label, (_, name) in zip(panels[0].get_yticklabels(), rows, strict=True):
        label.set_fontweight("bold" if name is None else "normal")
    return figure


def _forest_row(axes: Any, y: int, row: pd.Series, colour: str, reach: float) -> None:
    x = row["relative"]
    dot = {
        "color": colour,
        "markerfacecolor": "white" if row["verdict"] == "none" else colour,
        "ms": 6,
    }
    if abs(x) > reach:
        axes.plot(0.98 * np.sign(x) * reach, y, ">" if x > 0 else "<", **dot)
    else:
        axes.plot([row["low"], row["high"]], [y, y], color=colour, linewidth=1.6)
        axes.plot(x, y, "o", **dot)
    axes.text(
        1.02, y, f"{signed(x, 1)} %", transform=axes.get_yaxis_transform(), va="center",
        fontsize=8, color="#333333",
    )  # fmt: skip


def main_methods(evidence: EvidenceStatistics, dataset: str) -> list[str]:
    """Few enough to tell their lines apart: the paper's, and the best of each other group."""
    places = [place for place in evidence.judged if place[0] == dataset]

    def best(methods: Sequence[str]) -> list[str]:
        return list(evidence.ranking(methods, "mce", places).index[:1])

    network = [STAGE1] if STAGE1 in evidence.methods else evidence.of_group("network")[:1]
    priors = evidence.of_group("prior")
    picked = [*best(evidence.classical), *network, evidence.reference]
    picked += [PAPER_PRIOR] if PAPER_PRIOR in evidence.methods else []
    picked += best([name for name in priors if name != PAPER_PRIOR])
    for group in ("data term", "test time"):
        picked += best(evidence.of_group(group))
    return list(dict.fromkeys(picked))


def level_figure(evidence: EvidenceStatistics, dataset: str) -> Figure | None:
    """Mean correspondence error of the main methods over levels; beneath, against the reference."""
    means = evidence.by_level
    methods = main_methods(evidence, dataset)
    means = means[(means["dataset"] == dataset) & means["method"].isin(methods) & ~means["partial"]]
    if means["mce_mean"].isna().all():
        return None
    backbones = [backbone for name, backbone in evidence.places if name == dataset]
    count = len(backbones)
    figure = new_figure(
        4.6 * count + 2.2,
        6.6,
        f"{display_name(dataset)}: correspondence error over levels",
        evidence.origin(dataset),
        "Below: filled where p < 0.05 after Holm. Best of a group: at levels from "
        f"{LARGE:g} on. Curves that leave the lower panels are cut off.",
    )
    panels = figure.subplots(
        2, count, sharex=True, sharey="row", squeeze=False, height_ratios=(3, 2)
    )
    reach = 5.0
    for (above, below), backbone in zip(panels.T, backbones, strict=True):
        here = at(means, (dataset, backbone)).sort_values("level")
        cells = at(evidence.cells, (dataset, backbone)).query("value == 'mce'")
        below.axhline(0, color="#555555", linewidth=1)
        for method, (colour, marker) in method_styles(methods).items():
            line = here[here["method"] == method]
            dot = {"marker": marker, "color": colour, "ms": 5}
            above.plot(line["level"], line["mce_mean"], **dot, label=plain(evidence.title(method)))
            line = cells[cells["method"] == method].sort_values("level")
            below.plot(line["level"], line["relative"], color=colour, linewidth=1)
            sure = line["verdict"] != "none"
            for some, face in ((line[sure], colour), (line[~sure], "white")):
                style = dot | {"linestyle": "none", "markerfacecolor": face}
                below.plot(some["level"], some["relative"], **style)
            if method in evidence.candidates and evidence.methods[method].group != "network":
                reach = np.fmax(reach, 1.15 * line["relative"].abs().max())
        above.set_title(display_name(backbone) if backbone != NO_BACKBONE else "", fontsize=11)
        below.set_xlabel("Deformation level")
        for axes in (above, below):
            plain_axes(axes)
    panels[0, 0].set_ylim(bottom=0)
    panels[1, 0].set_ylim(-min(reach, 100), min(reach, 100))
    panels[0, 0].set_ylabel("Mean correspondence error")
    panels[1, 0].set_ylabel("Against the reference (%)")
    figure.legend(*panels[0, 0].get_legend_handles_labels(), **_BESIDE)
    return figure


def plausibility_figure(evidence: EvidenceStatistics, dataset: str) -> Figure | None:
    """Accuracy against roughness and folding, one point per method and backbone."""
    shown = [n for n in evidence.methods if n in (evidence.reference, *evidence.rivals)]
    means = evidence.pooled
    means = means[(means["dataset"] == dataset) & means["method"].isin(shown)]
    means = means[means["mce_mean"].notna()]
    if means.empty:
        return None
    methods = [name for name in shown if (means["method"] == name).any()]
    backbones = [backbone for name, backbone in evidence.places if name == dataset]
    figure = new_figure(
        10.6,
        0.6 + max(3.4 * len(backbones), 0.2 * len(methods) + 1.2),
        f"{display_name(dataset)}: accuracy against plausibility",
        evidence.origin(dataset),
        "Clean targets, all levels. Dashed: mean roughness of the true fields. Best: low, and near "
        "the dashed line.",
    )
    panels = figure.subplots(len(backbones), 2, sharey="row", sharex="col", squeeze=False)
    handles = {}
    for name in methods:
        group = evidence.methods[name].group
        marker = _MARKERS[evidence.of_group(group).index(name) % len(_MARKERS)]
        edge = "black" if name == evidence.reference else "white"
        style = {"color": _COLOURS[group], "ms": 8, "markeredgecolor": edge}
        for line, backbone in zip(panels, backbones, strict=True):
            row = at(means, (dataset, backbone)).query("method == @name")
            for axes, column, scale in zip(line, ("roughness", "folding"), (1, 100), strict=True):
                (handle,) = axes.plot(
                    scale * row[f"{column}_mean"], row["mce_mean"], marker, **style
                )
        handles[plain(evidence.title(name))] = handle
    for line, backbone in zip(panels, backbones, strict=True):
        line[0].axvline(evidence.roughness_true[dataset], color="black", linestyle="--", lw=1)
        label = f"{display_name(backbone)}\n" if backbone != NO_BACKBONE else ""
        line[0].set_ylabel(f"{label}Mean correspondence error", fontsize=9)
    for axes in panels.flat:
        plain_axes(axes)
    panels[-1, 0].set_xlabel("Roughness of the field")
    panels[-1, 1].set_xlabel("Folding (% of the places)")
    figure.legend(list(handles.values()), list(handles), **_BESIDE)
    return figure
