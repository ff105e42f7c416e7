"""Figures of a report. Each function returns a ``Figure``; ``save_figure`` writes PNG and PDF.

Only ``Figure`` objects are used, never ``pyplot``, so that nothing depends on or leaves behind
global state. Every figure says where its data come from.
"""

from __future__ import annotations

import os
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from dine.errors import DataError
from dine.files import atomic_path
from dine.io import announced
from dine.reporting import names
from dine.reporting.names import CD_SCALE, VALUES, display_name, rank
from dine.reporting.tables import published, summary
from dine.results import CLEAN, condition_key

if TYPE_CHECKING:
    from dine.data.pairs import PairSet

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
_ERROR_COLOURS = "coolwarm"
_UNIT = "×10⁻⁴"
_POINTS = {"linewidth": 0, "rasterized": True}  # thousands of paths in a PDF are slow to show
_SMALL = {"fontsize": 8, "frameon": False}


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
    canvas = FigureCanvasAgg(figure)
    paths = []
    for suffix, metadata in (
        ("png", {"Software": None}),
        ("pdf", {"CreationDate": None, "Creator": None, "Producer": None}),
    ):
        path = Path(f"{path_stem}.{suffix}")
        with atomic_path(path) as temporary:
            canvas.print_figure(temporary, dpi=150, metadata=metadata, facecolor="white")
        figure.set_layout_engine("none")  # found once; it takes as long as drawing
        paths.append(path)
    return paths


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
        **_SMALL,
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
            axes.set_ylabel(f"Chamfer distance {_UNIT}")
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


def read_group(path: str | os.PathLike, condition: str, field: str) -> tuple[np.ndarray, ...]:
    """``(pair names, values)`` of one condition from a point error or prediction file.

    ``condition`` is a key such as ``deformation`` or ``outliers_25``.

    Raises:
        DataError: the file cannot be read or lacks the condition or the field.
    """
    try:
        with announced.hdf5(path) as stream:
            group = stream[condition]
            return group["pair"].asstr()[:], group[field][:]
    except FileNotFoundError as error:
        raise DataError(f"{path} does not exist.") from error
    except KeyError as error:
        raise DataError(f"{path} holds no {condition}/{field}; evaluate that condition.") from error
    except OSError as error:
        raise DataError(f"{path} is not a readable HDF5 file ({error}).") from error


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
    axes.set_xlabel(f"Squared distance of a registered point to the clean target {_UNIT}")
    axes.set_ylabel("Points")
    title = f"Tail above {CD_SCALE * threshold:.4g} {_UNIT} (dotted)"
    axes.legend(title=title, fontsize=9, title_fontsize=9, frameon=False, alignment="left")
    return figure


# ---------------------------------------------------------------------------- qualitative


@dataclass(frozen=True)
class ExamplePair:
    """One test pair for the qualitative figure.

    Attributes:
        label: of the row.
        source: (N, 3).
        target: (M, 3), without corruption.
        registered: (N, 3) registered points by method.
        errors: (N,) of these, as they are to be coloured.
        seen: (M, 3) the target that methods saw, if it is not the one without corruption.
    """

    label: str
    source: np.ndarray
    target: np.ndarray
    registered: Mapping[str, np.ndarray]
    errors: Mapping[str, np.ndarray]
    seen: np.ndarray | None = None


def pick_examples(dataset: str, backbone: str, metrics: pd.DataFrame) -> list[tuple[str, str, str]]:
    """``(condition key, pair, label)`` of a typical hard case of every condition.

    From the strongest corruption of each condition, and there the largest deformation level, the
    pair with the median error of Stage 1: a rule, so that no case is chosen by its looks.
    """
    of_place = (metrics["dataset"] == dataset) & (metrics["backbone"] == backbone)
    rows = metrics[of_place & (metrics["method"] == "stage1")]
    picks = []
    for condition in (CLEAN, "noise", "outliers"):
        part = rows[rows["condition"] == condition]
        if part.empty:
            continue
        part = part[part["corruption"] == part["corruption"].max()]
        if part["level"].notna().any():
            part = part[part["level"] == part["level"].max()]
        part = part.sort_values(["cd", "pair"], ignore_index=True)
        row = part.iloc[(len(part) - 1) // 2]
        label = names.setting_name(condition, row["corruption"])
        if not np.isnan(row["level"]):
            label += f"\nlevel {row['level']:g}"
        picks.append((condition_key(condition, row["corruption"]), str(row["pair"]), label))
    return picks


def load_examples(
    picks: Sequence[tuple[str, str, str]],
    pairs: PairSet,
    predictions: Mapping[str, str | os.PathLike],
    point_errors: Mapping[str, str | os.PathLike],
) -> list[ExamplePair]:
    """Gather the clouds of ``pick_examples``; the two mappings give one file per method.

    Errors are squared distances to the clean target, in the unit of the tables.
    """
    listed = np.asarray(pairs.name).astype(str)
    examples = []
    for key, pair, label in picks:
        index = _find(listed, pair, "the pairs")
        source = np.asarray(pairs.source[index])
        registered, errors = {}, {}
        for method, path in predictions.items():
            known, displacement = read_group(path, key, "displacement")
            registered[method] = source + displacement[_find(known, pair, path)]
            known, squared = read_group(point_errors[method], key, "squared_distance")
            errors[method] = CD_SCALE * squared[_find(known, pair, point_errors[method])]
        examples.append(
            ExamplePair(label, source, np.asarray(pairs.target[index]), registered, errors)
        )
    return examples


def _find(listed: np.ndarray, pair: str, where: Any) -> int:
    found = np.flatnonzero(listed == pair)
    if not len(found):
        raise DataError(f"Pair {pair} is not in {where}; evaluate the same pairs again.")
    return int(found[0])


def qualitative_figure(
    examples: Sequence[ExamplePair],
    title: str,
    origin: str,
    *,
    titles: Mapping[str, str] | None = None,
    error: str = f"Squared distance to the clean target {_UNIT}",
    note: str = "Grey: clean target. Median Stage 1 case at the largest level and strongest "
    "corruption.",
) -> Figure:
    """3D views: source and target before, then each method's result coloured by point error.

    One colour scale for all panels, up to the 98th percentile of the errors shown.

    Args:
        examples: one row each.
        title: of the figure.
        origin: of the data.
        titles: of the methods, in the order of the columns; by default that of the tables.
        error: what the colours mean.
        note: beneath the figure.
    """
    known = examples[0].registered
    titles = titles or {name: display_name(name) for name in method_styles(known)}
    titles = {name: plain(text) for name, text in titles.items() if name in known}
    shown = np.concatenate([e for example in examples for e in example.errors.values()])
    norm = Normalize(0, float(np.percentile(shown, 98)))
    size = (2.6 * (1 + len(titles)) + 1, 2.1 * len(examples) + 0.9)
    figure = new_figure(*size, title, origin, note)
    panels = _views(figure, len(examples), 1 + len(titles))
    for example, line in zip(examples, panels, strict=True):
        _example_row(line, example, list(titles), norm)
    panels[0, 0].legend(**_SMALL, loc="upper left", markerscale=2)
    for axes, text in zip(panels[0], ["Before", *titles.values()], strict=True):
        axes.set_title(text, fontsize=11)
    scale = ScalarMappable(norm, _ERROR_COLOURS)
    figure.colorbar(scale, ax=panels, shrink=0.6, extend="max", label=error)
    return figure


def _example_row(
    line: Sequence[Any], example: ExamplePair, methods: Sequence[str], norm: Normalize
) -> None:
    centre, rotation = _principal_frame(example.source)
    source, target = ((x - centre) @ rotation for x in (example.source, example.target))
    limits = _cube(np.concatenate([source, target]))
    for axes in line:
        _bare_axes(axes, limits)
    seen = target if example.seen is None else (example.seen - centre) @ rotation
    line[0].scatter(*source.T, s=4, color="#E69F00", label="source", **_POINTS)
    line[0].scatter(*seen.T, s=4, color="#999999", label="target", **_POINTS)
    line[0].text2D(
        -0.02, 0.5, example.label, rotation=90, va="center", ha="right",
        transform=line[0].transAxes, multialignment="center",
    )  # fmt: skip
    for axes, method in zip(line[1:], methods, strict=True):
        axes.scatter(*target.T, s=2, color="#BBBBBB", alpha=0.5, **_POINTS)
        cloud = (example.registered[method] - centre) @ rotation
        colours = {"c": example.errors[method], "cmap": _ERROR_COLOURS, "norm": norm}
        axes.scatter(*cloud.T, s=6, **colours, depthshade=False, **_POINTS)


def _views(figure: Figure, down: int, across: int) -> np.ndarray:
    """Panels (down, across) to look at clouds in."""
    return figure.subplots(down, across, squeeze=False, subplot_kw={"projection": "3d"})


def _principal_frame(cloud: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Centre and rotation that lay a cloud's broad side flat, so that a surface faces the viewer.

    The signs are fixed by the largest entries, since those of singular vectors are arbitrary.
    """
    centre = cloud.mean(axis=0)
    _, _, axes = np.linalg.svd(cloud - centre, full_matrices=False)
    largest = np.abs(axes).argmax(axis=1)
    axes = axes * np.sign(axes[np.arange(3), largest])[:, None]
    axes[2] = np.cross(axes[0], axes[1])
    return centre, axes.T


def _cube(cloud: np.ndarray) -> list[tuple[float, float]]:
    middle = (cloud.min(axis=0) + cloud.max(axis=0)) / 2
    half = float(np.ptp(cloud, axis=0).max()) / 2
    return [(centre - half, centre + half) for centre in middle]


def _bare_axes(axes: Any, limits: list[tuple[float, float]]) -> None:
    axes.set(xlim=limits[0], ylim=limits[1], zlim=limits[2])
    axes.set_box_aspect((1, 1, 1), zoom=1.4)
    axes.view_init(elev=62, azim=-75)
    axes.set_axis_off()


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
    drawn[0].legend(**_SMALL)
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
        axes.legend(**_SMALL)
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
        for name in [*known, *(name for name in found if name.startswith("val"))]
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
    panels[0].legend(**_SMALL)
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


def pca_modes_figure(
    mean: np.ndarray,
    modes: np.ndarray,
    explained_variance: np.ndarray,
    source: np.ndarray,
    title: str,
    origin: str,
) -> Figure:
    """The first modes on the source, at −2 and +2 standard deviations around the mean field.

    ``modes`` (n_c, N, 3) are displacements per unit of a coefficient whose variance is
    ``explained_variance``; ``mean`` and ``source`` are (N, 3). Colour and arrows show the mode's
    own share of the displacement.
    """
    count = min(3, len(modes))
    steps = 2 * np.sqrt(explained_variance[:count])[:, None, None] * modes[:count]
    lengths = np.linalg.norm(steps, axis=2)
    norm = Normalize(0, float(lengths.max()) or 1.0)
    centre, rotation = _principal_frame(source)
    base = (source + mean - centre) @ rotation
    limits = _cube(
        np.concatenate([(base + sign * s @ rotation) for s in steps for sign in (-1, 1)])
    )
    arrows = np.linspace(0, len(source) - 1, min(len(source), 150)).astype(int)
    note = "Points: mean field ± 2 standard deviations of one mode. Arrows: from the mean field."
    figure = new_figure(3.1 * count + 1, 5.6, title, origin, note)
    panels = _views(figure, 2, count)
    for line, sign in zip(panels, (-1, 1), strict=True):
        for mode, axes in enumerate(line):
            step = sign * steps[mode] @ rotation
            _bare_axes(axes, limits)
            _coloured(axes, base + step, lengths[mode], norm)
            axes.quiver(
                *base[arrows].T, *step[arrows].T, color="#333333", linewidth=0.5, alpha=0.7,
                arrow_length_ratio=0.3,
            )  # fmt: skip
            axes.set_title(f"Mode {mode + 1}, {'+' if sign > 0 else '−'}2 sd", fontsize=10)
    scale = ScalarMappable(norm, "viridis")
    figure.colorbar(scale, ax=panels, shrink=0.6, label="Displacement by the mode")
    return figure


def _coloured(axes: Any, cloud: np.ndarray, values: np.ndarray, norm: Normalize) -> None:
    axes.scatter(*cloud.T, s=5, c=values, cmap="viridis", norm=norm, **_POINTS)


def prior_samples_figure(
    source: np.ndarray, samples: np.ndarray, title: str, origin: str
) -> Figure:
    """A source (N, 3) moved by fields (S, N, 3) that were drawn from a prior."""
    centre, rotation = _principal_frame(source)
    lengths = np.linalg.norm(samples, axis=2)
    # A prior with heavy tails must not hide what most of its points do.
    norm = Normalize(0, float(np.quantile(lengths, 0.98)) or 1.0)
    base = (source - centre) @ rotation
    limits = _cube(np.concatenate([base * 1.3, base]))
    count = len(samples)
    figure = new_figure(3.1 * (count + 1) + 0.8, 3.4, title, origin, "Left: the source as it is.")
    panels = _views(figure, 1, count + 1)
    fields = [np.zeros_like(source), *samples]
    for number, (axes, field) in enumerate(zip(panels[0], fields, strict=True)):
        _bare_axes(axes, limits)
        _coloured(axes, base + field @ rotation, np.linalg.norm(field, axis=1), norm)
        axes.set_title("Source" if number == 0 else f"Sample {number}", fontsize=10)
    scale = ScalarMappable(norm, "viridis")
    figure.colorbar(scale, ax=panels, shrink=0.7, label="Displacement")
    return figure
