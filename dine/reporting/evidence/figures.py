"""Figures of the report on the evidence."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from dine.config import STAGE1
from dine.evaluation.statistics import NO_BACKBONE
from dine.reporting import figures as draw
from dine.reporting.evidence.comparisons import GROUPS, LARGE, PAPER_PRIOR, Evidence, at
from dine.reporting.evidence.wording import VALUES, capital, join, signed
from dine.reporting.tables import METHOD_NAMES, display_name

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
_MORE_STYLES = [
    *(("#CC79A7", "v"), ("#E69F00", "P"), ("#56B4E9", "X"), ("#000000", "<")),
    *(("#8C6D31", ">"), ("#7B4173", "p"), ("#A6BD2B", "h"), ("#9E9E9E", "d")),
]


def forest_figure(evidence: Evidence, place: tuple[str, str]) -> Figure | None:
    """Relative difference of the mean at large levels to the reference, one row per method."""
    data = at(evidence.large, place)
    methods = [name for name in evidence.rivals if (data["method"] == name).any()]
    if not methods:
        return None
    # Top to bottom: the heading of each group, then its methods.
    rows: list[tuple[str, str | None]] = []
    for name in methods:
        group = evidence.methods[name].group
        if not rows or rows[-1][0] != group:
            rows.append((group, None))
        rows.append((group, name))
    figure = draw.new_figure(
        10.4,
        1.7 + 0.27 * len(rows),
        f"{_title(place)}: difference to {_plain_text(evidence.title(evidence.reference))}",
        evidence.origin(place[0]),
        f"All levels from {LARGE:g} on. Bars: 95 % bootstrap interval over objects. Filled: "
        "p < 0.05 (Wilcoxon). Triangles: beyond the axis.",
    )
    panels = figure.subplots(1, 2, sharey=True)
    for axes, (value, (long, _, _, _)) in zip(panels, VALUES.items(), strict=True):
        some = data[data["value"] == value].set_index("method")
        ends = 100 * some[["ci_low", "ci_high"]].div(some["mean_reference"], axis=0)
        inner = [name for name in some.index if name in evidence.candidates] or list(some.index)
        inner = np.r_[ends.loc[inner].to_numpy().ravel(), some.loc[inner, "relative"]]
        reach = float(np.clip(1.1 * np.nanmax(np.abs(inner)), 5, 100))
        axes.axvline(0, color="black", linewidth=1)
        for y, (group, name) in enumerate(rows):
            if name is None or name not in some.index:
                continue
            row, colour = some.loc[name], _COLOURS[group]
            x, (low, high) = row["relative"], ends.loc[name]
            face = colour if row["verdict"] != "none" else "white"
            if abs(x) > reach:
                marker, spot = (">", reach) if x > 0 else ("<", -reach)
                axes.plot(0.98 * spot, y, marker, color=colour, markerfacecolor=face, ms=6)
            else:
                axes.plot([low, high], [y, y], color=colour, linewidth=1.6)
                axes.plot(x, y, "o", color=colour, markerfacecolor=face, ms=6)
            axes.text(
                1.02, y, f"{signed(x, 1)} %", transform=axes.get_yaxis_transform(),
                va="center", fontsize=8, color="#333333",
            )  # fmt: skip
        axes.set_xlim(-reach, reach)
        axes.set_xlabel(f"{capital(long)}: lower ← difference (%) → higher", fontsize=9)
        draw.plain_axes(axes).grid(axis="y", visible=False)
    panels[0].set_ylim(len(rows) - 0.4, -0.6)
    panels[0].set_yticks(
        range(len(rows)),
        [GROUPS[g] if n is None else _plain_text(evidence.title(n)) for g, n in rows],
        fontsize=9,
    )
    for axes in panels:
        axes.tick_params(axis="y", length=0)
    for label, (_, name) in zip(panels[0].get_yticklabels(), rows, strict=True):
        label.set_fontweight("bold" if name is None else "normal")
    return figure


def main_methods(evidence: Evidence, dataset: str) -> list[str]:
    """Few enough to tell their lines apart: the paper's, and the best of each other group."""
    places = [place for place in evidence.judged if place[0] == dataset]

    def best(methods: Sequence[str]) -> list[str]:
        return list(evidence.ranking(methods, "mce", places).index[:1])

    network = [STAGE1] if STAGE1 in evidence.methods else evidence.of_group("network")[:1]
    paper = [PAPER_PRIOR] if PAPER_PRIOR in evidence.methods else []
    others = [name for name in evidence.of_group("prior") if name != PAPER_PRIOR]
    picked = [
        *best(evidence.classical),
        *network,
        evidence.reference,
        *paper,
        *best(others),
        *best(evidence.of_group("data term")),
        *best(evidence.of_group("test time")),
    ]
    return list(dict.fromkeys(picked))


def level_figure(evidence: Evidence, dataset: str) -> Figure | None:
    """Mean correspondence error of the main methods over levels; beneath, against the reference."""
    means = evidence.by_level
    methods = main_methods(evidence, dataset)
    means = means[(means["dataset"] == dataset) & means["method"].isin(methods) & ~means["partial"]]
    if means["mce_mean"].isna().all():
        return None
    backbones = [backbone for name, backbone in evidence.places if name == dataset]
    figure = draw.new_figure(
        4.6 * len(backbones) + 2.2,
        6.6,
        f"{_plain_text(display_name(dataset))}: correspondence error over levels",
        evidence.origin(dataset),
        "Below: filled where p < 0.05 after Holm. Best of a group: at levels from "
        f"{LARGE:g} on. Curves that leave the lower panels are cut off.",
    )
    panels = figure.subplots(
        2, len(backbones), sharex=True, sharey="row", squeeze=False, height_ratios=(3, 2)
    )
    reach = 5.0
    for column, backbone in enumerate(backbones):
        above, below = panels[:, column]
        here = at(means, (dataset, backbone))
        cells = at(evidence.cells, (dataset, backbone)).query("value == 'mce'")
        below.axhline(0, color=_styles([evidence.reference])[evidence.reference][0], linewidth=1)
        for method, (colour, marker) in _styles(methods).items():
            line = here[here["method"] == method].sort_values("level")
            label = _plain_text(evidence.title(method))
            above.plot(
                line["level"], line["mce_mean"], color=colour, marker=marker, ms=5, label=label
            )
            line = cells[cells["method"] == method].sort_values("level")
            below.plot(line["level"], line["relative"], color=colour, linewidth=1)
            sure = line["verdict"] != "none"
            for some, face in ((line[sure], colour), (line[~sure], "white")):
                below.plot(
                    some["level"], some["relative"], marker, color=colour, ms=5,
                    markerfacecolor=face,
                )  # fmt: skip
            if method in evidence.candidates and evidence.methods[method].group != "network":
                reach = max(reach, 1.15 * float(line["relative"].abs().max()))
        above.set_title(display_name(backbone) if backbone != NO_BACKBONE else "", fontsize=11)
        above.set_ylim(bottom=0)
        below.set_xlabel("Deformation level")
        for axes in (above, below):
            draw.plain_axes(axes)
    reach = min(reach, 100) if np.isfinite(reach) else 100
    panels[1, 0].set_ylim(-reach, reach)
    panels[0, 0].set_ylabel("Mean correspondence error")
    panels[1, 0].set_ylabel("Against the reference (%)")
    figure.legend(
        *panels[0, 0].get_legend_handles_labels(),
        loc="outside right upper",
        fontsize=8,
        frameon=False,
    )
    return figure


def plausibility_figure(evidence: Evidence, dataset: str) -> Figure | None:
    """Accuracy against roughness and folding, one point per method and backbone."""
    means = evidence.pooled
    shown = [evidence.reference, *evidence.rivals]
    means = means[(means["dataset"] == dataset) & means["method"].isin(shown)]
    means = means[means["mce_mean"].notna()]
    if means.empty:
        return None
    backbones = [backbone for name, backbone in evidence.places if name == dataset]
    methods = [name for name in shown if (means["method"] == name).any()]
    methods.sort(key=list(evidence.methods).index)
    figure = draw.new_figure(
        10.6,
        0.6 + max(3.4 * len(backbones), 0.2 * len(methods) + 1.2),
        f"{_plain_text(display_name(dataset))}: accuracy against plausibility",
        evidence.origin(dataset),
        "Clean targets, all levels. Dashed: mean roughness of the true fields. Best: low, and near "
        "the dashed line.",
    )
    panels = figure.subplots(len(backbones), 2, sharey="row", sharex="col", squeeze=False)
    handles = {}
    for line, backbone in zip(panels, backbones, strict=True):
        here = at(means, (dataset, backbone)).set_index("method")
        for axes, (column, scale) in zip(
            line, (("roughness_mean", 1), ("folding_mean", 100)), strict=True
        ):
            seen: dict[str, int] = {}
            for name in methods:
                group = evidence.methods[name].group
                marker = _MARKERS[seen.setdefault(group, 0) % len(_MARKERS)]
                seen[group] += 1
                if name not in here.index:
                    continue
                row = here.loc[name]
                edge = "black" if name == evidence.reference else "white"
                (handles[name],) = axes.plot(
                    scale * row[column], row["mce_mean"], marker, color=_COLOURS[group], ms=8,
                    markeredgecolor=edge, markeredgewidth=0.8, linestyle="none",
                )  # fmt: skip
            draw.plain_axes(axes)
        line[0].axvline(evidence.roughness_true[dataset], color="black", linestyle="--", lw=1)
        label = f"{display_name(backbone)}\n" if backbone != NO_BACKBONE else ""
        line[0].set_ylabel(f"{label}Mean correspondence error", fontsize=9)
    panels[-1, 0].set_xlabel("Roughness of the field")
    panels[-1, 1].set_xlabel("Folding (% of the places)")
    figure.legend(
        [handles[name] for name in methods],
        [_plain_text(evidence.title(name)) for name in methods],
        loc="outside right upper",
        fontsize=8,
        frameon=False,
    )
    return figure


def search_figure(
    evidence: Evidence, place: tuple[str, str], searches: Sequence[Mapping[str, Any]], origin: str
) -> Figure:
    """Validation errors over λ and, where the search has it, the error against the roughness."""
    curve = pd.DataFrame([row for search in searches for row in search["curve"]])
    for name in ("lambda", "cd", "mce", "roughness"):
        curve[name] = curve[name].astype(float) if name in curve else np.nan
    selected = {k: v for search in searches for k, v in search.get("selected", {}).items()}
    values = [name for name in VALUES if curve[name].notna().any()]
    rough = curve["roughness"].notna().any() and "mce" in values
    chosen_by = join(sorted({str(s.get("criterion", "cd")).upper() for s in searches}))
    count = len(values) + int(rough)
    figure = draw.new_figure(
        4.3 * count + 0.8,
        4.4,
        f"{_title(place)}: weight of the prior",
        origin,
        f"Validation pairs. Star: chosen λ (lowest {chosen_by}). Dashed: λ = 0, longer training "
        "alone.",
    )
    panels = list(figure.subplots(1, count, squeeze=False)[0])
    for axes, value in zip(panels, values, strict=False):
        long, _, scale, _ = VALUES[value]
        # Every prior has the same control.
        for control in curve.loc[curve["lambda"] == 0, value].dropna().unique():
            axes.axhline(scale * control, color="#555555", linestyle="--", linewidth=1)
        axes.set_xscale("log")
        axes.set_xlabel("Prior weight λ")
        axes.set_ylabel(f"{capital(long)}{' ×10⁻⁴' if scale != 1 else ''}")
    if rough:
        control = curve[curve["lambda"] == 0].drop_duplicates(["roughness", "mce"])
        panels[-1].plot(
            control["roughness"], control["mce"], "s", color="#555555", zorder=4, label="λ = 0"
        )
        panels[-1].set_xlabel("Roughness of the field")
        panels[-1].set_ylabel("Mean correspondence error")
    for prior, (colour, marker) in _styles(curve["prior"]).items():
        line = curve[(curve["prior"] == prior)].sort_values("lambda")
        known = evidence.title(prior) if prior in evidence.methods else display_name(prior)
        above = line[line["lambda"] > 0]
        chosen = above[np.isclose(above["lambda"], selected.get(prior, np.nan), rtol=1e-6, atol=0)]
        places = [("lambda", value, VALUES[value][2], above) for value in values]
        places += [("roughness", "mce", 1.0, line)] if rough else []
        for axes, (x, y, scale, some) in zip(panels, places, strict=True):
            some = some.dropna(subset=[x, y])
            axes.plot(
                some[x], scale * some[y], color=colour, marker=marker, ms=5, linewidth=1.2,
                label=_plain_text(known) if axes is panels[0] else None,
            )  # fmt: skip
            axes.plot(
                chosen[x], scale * chosen[y], "*", color=colour, ms=15, markeredgecolor="black",
                zorder=3,
            )  # fmt: skip
    for axes in panels:
        draw.plain_axes(axes)
    if rough:
        panels[-1].legend(fontsize=8, frameon=False)
    figure.legend(
        *panels[0].get_legend_handles_labels(), loc="outside right upper", fontsize=8, frameon=False
    )
    return figure


def _title(place: Sequence[str]) -> str:
    return _plain_text(", ".join(display_name(x) for x in place if x != NO_BACKBONE))


def _plain_text(text: str) -> str:
    """Text that a figure shows as it is: dollars would begin a formula."""
    return text.replace("$", r"\$")


def _styles(methods: Iterable[str]) -> dict[str, tuple[str, str]]:
    """Colour and marker by method; the paper's have those of the other figures."""
    methods = list(dict.fromkeys(methods))
    own = draw.method_styles(METHOD_NAMES)
    others = [name for name in methods if name not in own]
    more = {n: _MORE_STYLES[i % len(_MORE_STYLES)] for i, n in enumerate(others)}
    return {name: own.get(name) or more[name] for name in methods}
