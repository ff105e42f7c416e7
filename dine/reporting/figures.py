"""Figures of a report. Each function returns a ``Figure``; ``save_figure`` writes PNG and PDF.

Only ``Figure`` objects are used, never ``pyplot``, so that nothing depends on or leaves behind
global state. Every figure says where its data come from.
"""

from __future__ import annotations

import os
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.backends.backend_pdf import FigureCanvasPdf
from matplotlib.figure import Figure

from dine.config import STAGE1
from dine.errors import DataError
from dine.evaluation.statistics import NO_BACKBONE
from dine.files import atomic_path
from dine.reporting import names
from dine.reporting.comparisons import GROUPS, LARGE, PAPER_PRIOR, EvidenceStatistics, at
from dine.reporting.names import CD_SCALE, VALUES, display_name, rank, signed
from dine.reporting.tables import published, summary
from dine.results import CLEAN

# Okabe-Ito colours, which stay apart for colour-blind readers; the markers differ as well.
_STYLES = {
    "stage1": ("#D55E00", "o"),
    "lambda0": ("#555555", "s"),
    "pca": ("#0072B2", "^"),
    "flow": ("#009E73", "D"),
}
_OTHER_STYLES = [
    *(("#CC79A7", "v"), ("#E69F00", "P"), ("#56B4E9", "X"), ("#000000", "<")),
    *(("#8C6D31", ">"), ("#7B4173", "p"), ("#A6BD2B", "h"), ("#9E9E9E", "d")),
]
UNIT = "×10⁻⁴"
SMALL = {"fontsize": 8, "frameon": False}


def method_styles(methods: Iterable[str]) -> dict[str, tuple[str, str]]:
    """Colour and marker by method, in the order of the tables."""
    ordered = sorted(set(methods), key=lambda name: rank(name, names.METHODS))
    others = [name for name in ordered if name not in _STYLES]
    return {
        name: _STYLES.get(name) or _OTHER_STYLES[others.index(name) % len(_OTHER_STYLES)]
        for name in ordered
    }


def save_figure(figure: Figure, path_stem: str | os.PathLike) -> list[Path]:
    """Write ``<stem>.png`` (150 dpi) and ``<stem>.pdf``; return the paths.

    The files carry no dates or versions, so that the same numbers give the same bytes.
    """
    figure.set_dpi(150)
    figure.set_facecolor("white")  # whatever the user's style is
    png, pdf = (Path(f"{path_stem}.{suffix}") for suffix in ("png", "pdf"))
    # Not through `savefig`, which draws every figure once more to see what it needs.
    with atomic_path(png) as temporary:
        FigureCanvasAgg(figure).print_png(temporary, metadata={"Software": None})
    figure.set_layout_engine("none")  # found once; it takes as long as drawing
    nothing = {"CreationDate": None, "Creator": None, "Producer": None}
    with atomic_path(pdf) as temporary:
        FigureCanvasPdf(figure).print_pdf(temporary, metadata=nothing)
    return [png, pdf]


def new_figure(width: float, height: float, title: str, origin: str, note: str = "") -> Figure:
    """An empty figure, inches; its title says where the data come from."""
    figure = Figure(figsize=(width, height), layout="constrained")
    title = f"{plain(title)} ({names.ORIGINS[origin]})"
    figure.suptitle(textwrap.fill(title, int(11.5 * width)), fontsize=11)
    if note:
        figure.supxlabel(textwrap.fill(note, int(17 * width)), fontsize=8, color="#444444")
    return figure


def legend_below(figure: Figure, panels: Iterable[Any], columns: int, note: str = "") -> None:
    """One legend for all panels, of the fullest one, with a note above."""
    fullest = max(panels, key=lambda axes: len(axes.get_legend_handles_labels()[1]))
    handles, labels = fullest.get_legend_handles_labels()
    title = textwrap.fill(note, int(17 * figure.get_figwidth()))
    figure.legend(
        handles, labels, title=title, title_fontsize=8, loc="outside lower center", ncols=columns,
        **SMALL,
    )  # fmt: skip


def plain_axes(axes: Any) -> Any:
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(True, color="#E5E5E5", linewidth=0.6)
    axes.set_axisbelow(True)
    return axes


def plain(text: str) -> str:
    """Text that a figure shows as it is: dollars would begin a formula."""
    return text.replace("$", r"\$")


# --------------------------------------------------------------------------- distances


def distance_figure(dataset: str, metrics: pd.DataFrame, condition: str = CLEAN) -> Figure:
    """Mean Chamfer distance over level or corruption strength; one panel per backbone.

    Bands show one sample standard deviation; hollow dashed markers are the published means.
    """
    clean = condition == CLEAN
    rows = metrics[(metrics["dataset"] == dataset) & (metrics["condition"] == condition)]
    key = "level" if clean else "corruption"
    ours = summary(rows, pool_levels=not clean).dropna(subset=key)
    if ours.empty:
        raise DataError(f"The metrics hold no {condition} rows of {dataset} with a {key} to plot.")
    paper = published()
    paper = paper[(paper["dataset"] == dataset) & (paper["condition"] == condition)]
    backbones = sorted(ours["backbone"].unique(), key=lambda name: rank(name, names.BACKBONES))
    styles = method_styles(ours["method"])
    note = "Bands: ± one standard deviation over test pairs."
    if len(paper):
        note += f" Hollow, dashed: published means on the real {display_name(dataset)} data."
    title, label = {
        "deformation": ("increasing deformation", "Deformation level"),
        "outliers": ("outliers", "Outliers (%)"),
        "noise": ("noise", "Noise σ"),
    }[condition]
    title = f"{display_name(dataset)}: {title}"
    # Beside a table of up to two backbones; that of more is too wide for anything beside it.
    down, across = (len(backbones), 1) if len(backbones) < 3 else (1, len(backbones))
    size = (5.2 if across == 1 else 4.2 * across, 2.9 * down + 1.8)
    figure = new_figure(*size, title, str(rows["origin"].iloc[0]))
    panels = figure.subplots(down, across, sharex=True, sharey=True, squeeze=False).ravel()
    for axes, backbone in zip(panels, backbones, strict=True):
        for method, style in styles.items():
            here = [x[(x["backbone"] == backbone) & (x["method"] == method)] for x in (ours, paper)]
            _distance_lines(axes, *(x.sort_values(key) for x in here), key, style)
        axes.set_title(display_name(backbone), fontsize=11)
        plain_axes(axes)
        if axes.get_subplotspec().is_last_row():
            axes.set_xlabel(label)
        if axes.get_subplotspec().is_first_col():
            axes.set_ylabel(f"Chamfer distance {UNIT}")
    panels[0].set_ylim(bottom=0)
    legend_below(figure, panels, 2 if across == 1 else 4, note)
    return figure


def _distance_lines(
    axes: Any, ours: pd.DataFrame, paper: pd.DataFrame, key: str, style: tuple[str, str]
) -> None:
    """One method's means over ``key`` with their band, and the published ones."""
    line = {"color": style[0], "marker": style[1], "ms": 5}
    if len(ours):
        x, mean, std = (ours[name].to_numpy(float) for name in (key, "mean", "std"))
        axes.plot(x, mean, **line, label=display_name(ours["method"].iloc[0]))
        low = np.maximum(mean - std, 0)
        axes.fill_between(x, low, mean + std, color=style[0], alpha=0.13, linewidth=0)
    if len(paper):
        label = f"{display_name(paper['method'].iloc[0])}, paper"
        hollow = {"markerfacecolor": "white", "linestyle": "--", "linewidth": 1}
        axes.plot(paper[key], paper["published_mean"], **line, **hollow, label=label)


# --------------------------------------------------------------------------- point errors


def histogram_figure(errors: Mapping[str, np.ndarray], title: str, origin: str) -> Figure:
    """Per-point squared distances to the target by method, as the paper's Figure 4 (log count).

    The tail is what lies above the 99th percentile of Stage 1 (of the first method where Stage 1 is
    absent), whose own share is then 1 % and the yardstick for the others.
    """
    reference = errors["stage1"] if "stage1" in errors else next(iter(errors.values()))
    threshold = float(np.percentile(reference, 99))
    # A few stray points must not squeeze the rest: the last bin takes everything beyond.
    top = max(float(np.percentile(e, 99.99, method="lower")) for e in errors.values())
    edge = CD_SCALE * max(top, threshold, np.finfo(np.float32).tiny)
    figure = new_figure(6.6, 4.4, title, origin, "The last bin also holds all larger distances.")
    axes = plain_axes(figure.subplots())
    for method, (colour, _) in method_styles(errors).items():
        share = 100 * np.mean(errors[method] > threshold)
        axes.hist(
            np.minimum(CD_SCALE * np.ravel(errors[method]), edge),
            bins=np.linspace(0, edge, 81),
            histtype="step",
            linewidth=1.5,
            color=colour,
            log=True,
            label=f"{display_name(method)}: {share:.2f} % above",
        )
    axes.axvline(CD_SCALE * threshold, color="black", linestyle=":", linewidth=1)
    axes.set_xlabel(f"Squared distance of a registered point to the clean target {UNIT}")
    axes.set_ylabel("Points")
    title = f"Tail above {CD_SCALE * threshold:.4g} {UNIT} (dotted)"
    axes.legend(title=title, fontsize=9, title_fontsize=9, frameon=False, alignment="left")
    return figure


# ------------------------------------------------------------------------------- training


def _criterion(search: Mapping[str, Any]) -> str:
    """How a search chose λ."""
    value = str(search.get("criterion", "cd")).upper()
    tolerance = float(search.get("tolerance", 0))
    return (
        f"largest within {tolerance:.0%} of the lowest {value}" if tolerance else f"lowest {value}"
    )


def search_figure(
    searches: Sequence[Mapping[str, Any]], where: str, origin: str, titles: Mapping[str, str] = {}
) -> Figure:
    """Validation errors over the prior weight, with the choice and the λ = 0 control marked.

    Where the search has them, the error against the roughness of the fields as well.

    Args:
        searches: results of ``dine search-lambda`` with one dataset and backbone.
        where: these, for the title.
        origin: of the data.
        titles: of priors; others have the name of the tables.
    """
    curve = pd.DataFrame([row for search in searches for row in search["curve"]])
    for name in ("lambda", "cd", "mce", "roughness"):
        curve[name] = curve[name].astype(float) if name in curve else np.nan
    chosen = {k: v for search in searches for k, v in search.get("selected", {}).items()}
    curve["chosen"] = np.isclose(
        curve["lambda"], curve["prior"].map(chosen).astype(float), rtol=1e-6, atol=0
    )
    panels = [("lambda", value) for value in VALUES if curve[value].notna().any()]
    if curve["roughness"].notna().any() and curve["mce"].notna().any():
        panels.append(("roughness", "mce"))
    criteria = sorted({_criterion(search) for search in searches})
    note = f"Validation pairs. Star: chosen λ ({names.join(criteria)}). "
    note += "Dashed: λ = 0, longer training alone."
    figure = new_figure(4.3 * len(panels) + 0.8, 4.2, f"Choice of λ: {where}", origin, note)
    drawn = figure.subplots(1, len(panels), squeeze=False)[0]
    for axes, (x, value) in zip(drawn, panels, strict=True):
        _search_lines(axes, curve.dropna(subset=[x, value]), x, value, titles)
        axes.set_xlabel("Prior weight λ" if x == "lambda" else "Roughness of the field")
        axes.set_ylabel(VALUES[value][0])
        plain_axes(axes)
    drawn[0].legend(**SMALL)
    return figure


def _search_lines(
    axes: Any, curve: pd.DataFrame, x: str, value: str, titles: Mapping[str, str]
) -> None:
    scale = VALUES[value][2]
    control = curve[curve["lambda"] == 0].drop_duplicates([x, value])
    if x == "lambda":
        # Every prior has the same control.
        for height in control[value].unique():
            axes.axhline(scale * height, color="#555555", linestyle="--", linewidth=1)
        axes.set_xscale("log")
        curve = curve[curve["lambda"] > 0]
    else:
        axes.plot(control[x], scale * control[value], "s", color="#555555", zorder=4, label="λ = 0")
        axes.legend(**SMALL)
    for prior, (colour, marker) in method_styles(curve["prior"]).items():
        line = curve[curve["prior"] == prior].sort_values("lambda")
        label = plain(titles.get(prior) or display_name(prior)) if x == "lambda" else None
        axes.plot(
            line[x], scale * line[value], color=colour, marker=marker, ms=5, lw=1.2, label=label
        )
        star = line[line["chosen"]]
        dot = {"color": colour, "ms": 15, "markeredgecolor": "black", "zorder": 3}
        axes.plot(star[x], scale * star[value], "*", **dot)


def training_figure(histories: Mapping[str, pd.DataFrame], title: str, origin: str) -> Figure:
    """Loss terms, gradient norm and validation values over the steps, one line per method."""
    known = {
        "loss": "Training loss",
        "data": "Data term",
        "penalty": "Prior penalty",
        "grad_norm": "Gradient norm",
        "val_cd": "Validation Chamfer distance",
        "val_mce": "Validation correspondence error",
        "val_roughness": "Validation roughness",
    }
    found = dict.fromkeys(name for frame in histories.values() for name in frame)
    columns = [
        name
        for name in dict.fromkeys([*known, *(name for name in found if name.startswith("val"))])
        if any(name in frame and frame[name].notna().any() for frame in histories.values())
    ]
    if not columns:
        raise DataError("The training histories hold no values to plot.")
    across = min(3, len(columns))
    down = -(-len(columns) // across)
    figure = new_figure(4.2 * across, 3.1 * down + 0.5, title, origin)
    panels = figure.subplots(down, across, squeeze=False).ravel()
    for axes, name in zip(panels, columns, strict=False):
        for method, (colour, _) in method_styles(histories).items():
            frame = histories[method]
            if name not in frame:
                continue
            line = frame[["step", name]].dropna()
            axes.plot(
                line["step"], line[name], color=colour, linewidth=1.2,
                marker="." if len(line) < 40 else None, label=display_name(method),
            )  # fmt: skip
        if all((frame[name].dropna() > 0).all() for frame in histories.values() if name in frame):
            axes.set_yscale("log")
        axes.set_xlabel("Step")
        axes.set_title(known.get(name, name), fontsize=10)
        plain_axes(axes)
    for axes in panels[len(columns) :]:
        axes.set_visible(False)
    panels[0].legend(**SMALL)
    return figure


# ------------------------------------------------------------------------------ PCA prior


def pca_spectrum_figure(
    explained_variance: np.ndarray, explained_variance_ratio: np.ndarray, title: str, origin: str
) -> Figure:
    """Explained variance per component (log) and its cumulative share."""
    component = np.arange(1, len(explained_variance) + 1)
    cumulative = 100 * np.cumsum(explained_variance_ratio)
    figure = new_figure(4.6, 5.6, title, origin)
    left, right = figure.subplots(2, 1)
    colour = _STYLES["pca"][0]
    left.semilogy(component, explained_variance, color=colour, marker=".")
    left.set_ylabel("Explained variance")
    right.plot(component, cumulative, color=colour, marker=".")
    enough = int(np.searchsorted(cumulative, 90)) + 1
    if enough <= len(component):
        right.axvline(enough, color="black", linestyle=":", linewidth=1)
        right.set_title(f"90 % with {enough} of {len(component)} components", fontsize=10)
    else:
        right.set_title(f"{cumulative[-1]:.1f} % with all {len(component)} components", fontsize=10)
    right.set_ylabel("Cumulative explained variance (%)")
    right.set_ylim(0, 103)
    for axes in (left, right):
        axes.set_xlabel("Component")
        plain_axes(axes)
    return figure


# ------------------------------------------------------------------------------- evidence

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
        f"All levels from {LARGE:g} on. Bars: 95 % bootstrap interval over clusters. Filled: "
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
        "markerfacecolor": "white" if row["significant"] == "none" else colour,
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
            sure = line["significant"] != "none"
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
    # Lower than the title, which is as wide as a figure of one backbone.
    beside = _BESIDE | {"loc": "outside right center"}
    figure.legend(*panels[0, 0].get_legend_handles_labels(), **beside)
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
