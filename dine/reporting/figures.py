"""Figures of a report. Each function returns a ``Figure``; ``save_figure`` writes PNG and PDF.

Only ``Figure`` objects are used, never ``pyplot``, so that nothing depends on or leaves behind
global state. Every figure says where its data come from.
"""

from __future__ import annotations

import os
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
from dine.reporting import tables
from dine.reporting.tables import CD_SCALE, display_name
from dine.results import condition_key

if TYPE_CHECKING:
    from dine.data.pairs import PairSet

# Okabe-Ito colours, which stay apart for colour-blind readers; the markers differ as well.
_STYLES = {
    "stage1": ("#D55E00", "o"),
    "lambda0": ("#555555", "s"),
    "pca": ("#0072B2", "^"),
    "flow": ("#009E73", "D"),
}
_OTHER_STYLES = [("#CC79A7", "v"), ("#E69F00", "P"), ("#56B4E9", "X")]
_ERROR_COLOURS = "coolwarm"
_UNIT = "×10⁻⁴"


def method_styles(methods: Iterable[str]) -> dict[str, tuple[str, str]]:
    """Colour and marker by method, in the order of the tables."""
    ordered = sorted(set(methods), key=lambda name: tables.rank(name, tables.METHOD_NAMES))
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
        paths.append(path)
    return paths


def new_figure(width: float, height: float, title: str, origin: str, note: str = "") -> Figure:
    figure = Figure(figsize=(width, height), layout="constrained")
    figure.suptitle(f"{title} ({tables.ORIGIN_NAMES[origin]})", fontsize=12)
    if note:
        figure.supxlabel(note, fontsize=8, color="#444444")
    return figure


def plain_axes(axes: Any) -> Any:
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(True, color="#E5E5E5", linewidth=0.6)
    axes.set_axisbelow(True)
    return axes


# --------------------------------------------------------------------------- distances


def distance_figure(dataset: str, metrics: pd.DataFrame, condition: str = "deformation") -> Figure:
    """Mean Chamfer distance over level or corruption strength; one panel per backbone.

    Bands show one sample standard deviation; hollow dashed markers are the published means.
    """
    clean = condition == "deformation"
    rows = metrics[(metrics["dataset"] == dataset) & (metrics["condition"] == condition)]
    key = "level" if clean else "corruption"
    ours = tables.summary(rows, pool_levels=not clean).dropna(subset=key)
    if ours.empty:
        raise DataError(f"The metrics hold no {condition} rows of {dataset} with a {key} to plot.")
    paper = tables.published()
    paper = paper[(paper["dataset"] == dataset) & (paper["condition"] == condition)]
    backbones = sorted(
        ours["backbone"].unique(), key=lambda name: tables.rank(name, tables.BACKBONE_NAMES)
    )
    styles = method_styles(ours["method"])
    origin = str(rows["origin"].iloc[0])
    note = "Bands: ± one standard deviation over test pairs."
    if len(paper):
        note += f" Hollow, dashed: published means on the real {display_name(dataset)} data."
    names = {"deformation": "increasing deformation", "outliers": "outliers", "noise": "noise"}
    figure = new_figure(
        5.2 * len(backbones) + 0.4,
        4.3,
        f"{display_name(dataset)}: {names[condition]}",
        origin,
        note,
    )
    panels = figure.subplots(1, len(backbones), sharey=True, squeeze=False)[0]
    for axes, backbone in zip(panels, backbones, strict=True):
        for method, (colour, marker) in styles.items():
            line = ours[(ours["backbone"] == backbone) & (ours["method"] == method)]
            line = line.sort_values(key)
            if len(line):
                x, mean, std = (line[name].to_numpy(float) for name in (key, "mean", "std"))
                axes.plot(x, mean, color=colour, marker=marker, ms=5, label=display_name(method))
                low = np.maximum(mean - std, 0)
                axes.fill_between(x, low, mean + std, color=colour, alpha=0.13, linewidth=0)
            line = paper[(paper["backbone"] == backbone) & (paper["method"] == method)]
            line = line.sort_values(key)
            if len(line):
                axes.plot(
                    line[key],
                    line["published_mean"],
                    color=colour,
                    marker=marker,
                    ms=5,
                    markerfacecolor="white",
                    linestyle="--",
                    linewidth=1,
                    label=f"{display_name(method)}, paper",
                )
        axes.set_title(display_name(backbone), fontsize=11)
        axes.set_xlabel(
            {"deformation": "Deformation level", "outliers": "Outliers (%)", "noise": "Noise σ"}[
                condition
            ]
        )
        axes.set_ylim(bottom=0)
        plain_axes(axes).legend(fontsize=8, frameon=False)
    panels[0].set_ylabel(f"Chamfer distance {_UNIT}")
    return figure


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


def tail_shares(
    errors: Mapping[str, np.ndarray], threshold: float | None = None
) -> tuple[float, dict[str, float]]:
    """Share of points, by method, with a squared distance above ``threshold``.

    Without a threshold it is the 99th percentile of Stage 1 (of the first method where Stage 1 is
    absent), whose own share is then 1 % and the yardstick for the others.
    """
    if threshold is None:
        reference = errors["stage1"] if "stage1" in errors else next(iter(errors.values()))
        threshold = float(np.percentile(reference, 99))
    return threshold, {name: float(np.mean(e > threshold)) for name, e in errors.items()}


def histogram_figure(
    errors: Mapping[str, np.ndarray], title: str, origin: str, threshold: float | None = None
) -> Figure:
    """Per-point squared distances to the target by method, as the paper's Figure 4 (log count)."""
    threshold, shares = tail_shares(errors, threshold)
    # A few stray points must not squeeze the rest: the last bin takes everything beyond.
    top = max(float(np.percentile(e, 99.99, method="lower")) for e in errors.values())
    edge = CD_SCALE * max(top, threshold, np.finfo(np.float32).tiny)
    figure = new_figure(6.6, 4.4, title, origin, "The last bin also holds all larger distances.")
    axes = plain_axes(figure.subplots())
    for method, (colour, _) in method_styles(errors).items():
        axes.hist(
            np.minimum(CD_SCALE * np.ravel(errors[method]), edge),
            bins=np.linspace(0, edge, 81),
            histtype="step",
            linewidth=1.5,
            color=colour,
            log=True,
            label=f"{display_name(method)}: {100 * shares[method]:.2f} % above",
        )
    axes.axvline(CD_SCALE * threshold, color="black", linestyle=":", linewidth=1)
    axes.set_xlabel(f"Squared distance of a registered point to the clean target {_UNIT}")
    axes.set_ylabel("Points")
    axes.legend(
        title=f"Tail above {CD_SCALE * threshold:.4g} {_UNIT} (dotted)",
        fontsize=9,
        title_fontsize=9,
        frameon=False,
        alignment="left",
    )
    return figure


# ---------------------------------------------------------------------------- qualitative


@dataclass(frozen=True)
class Example:
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


def pick_examples(
    dataset: str, backbone: str, metrics: pd.DataFrame, method: str = "stage1"
) -> list[tuple[str, str, str]]:
    """``(condition key, pair, label)`` of a typical hard case of every condition.

    From the strongest corruption of each condition, and there the largest deformation level, the
    pair with the median error of ``method``: a rule, so that no case is chosen by its looks.
    """
    rows = metrics[
        (metrics["dataset"] == dataset)
        & (metrics["backbone"] == backbone)
        & (metrics["method"] == method)
    ]
    picks = []
    for condition in ("deformation", "noise", "outliers"):
        part = rows[rows["condition"] == condition]
        if part.empty:
            continue
        part = part[part["corruption"] == part["corruption"].max()]
        if part["level"].notna().any():
            part = part[part["level"] == part["level"].max()]
        part = part.sort_values(["cd", "pair"], ignore_index=True)
        row = part.iloc[(len(part) - 1) // 2]
        label = tables.setting_text(condition, row["corruption"])
        if not np.isnan(row["level"]):
            label += f"\nlevel {row['level']:g}"
        picks.append((condition_key(condition, row["corruption"]), str(row["pair"]), label))
    return picks


def load_examples(
    picks: Sequence[tuple[str, str, str]],
    pairs: PairSet,
    predictions: Mapping[str, str | os.PathLike],
    point_errors: Mapping[str, str | os.PathLike],
) -> list[Example]:
    """Gather the clouds of ``pick_examples``; the two mappings give one file per method.

    Errors are squared distances to the clean target, in the unit of the tables.
    """
    names = np.asarray(pairs.name).astype(str)
    examples = []
    for key, pair, label in picks:
        index = _find(names, pair, "the pairs")
        source = np.asarray(pairs.source[index])
        registered, errors = {}, {}
        for method, path in predictions.items():
            known, displacement = read_group(path, key, "displacement")
            registered[method] = source + displacement[_find(known, pair, path)]
            known, squared = read_group(point_errors[method], key, "squared_distance")
            errors[method] = CD_SCALE * squared[_find(known, pair, point_errors[method])]
        examples.append(Example(label, source, np.asarray(pairs.target[index]), registered, errors))
    return examples


def _find(names: np.ndarray, pair: str, where: Any) -> int:
    found = np.flatnonzero(names == pair)
    if not len(found):
        raise DataError(f"Pair {pair} is not in {where}; evaluate the same pairs again.")
    return int(found[0])


def qualitative_figure(
    examples: Sequence[Example],
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
    methods = [name for name in titles if name in known]
    shown = np.concatenate([e for example in examples for e in example.errors.values()])
    norm = Normalize(0, float(np.percentile(shown, 98)))
    columns = 1 + len(methods)
    figure = new_figure(
        2.6 * columns + 1,
        2.1 * len(examples) + 0.9,
        title,
        origin,
        note,
    )
    panels = figure.subplots(len(examples), columns, squeeze=False, subplot_kw={"projection": "3d"})
    for row, (example, line) in enumerate(zip(examples, panels, strict=True)):
        centre, rotation = _principal_frame(example.source)
        view = [(cloud - centre) @ rotation for cloud in (example.source, example.target)]
        limits = _cube(np.concatenate(view))
        for axes in line:
            _bare_axes(axes, limits)
        before = example.target if example.seen is None else example.seen
        line[0].scatter(*view[0].T, s=4, color="#E69F00", linewidth=0, label="source")
        line[0].scatter(
            *((before - centre) @ rotation).T, s=4, color="#999999", linewidth=0, label="target"
        )
        line[0].text2D(
            -0.02, 0.5, example.label, rotation=90, va="center", ha="right",
            transform=line[0].transAxes, multialignment="center",
        )  # fmt: skip
        for axes, method in zip(line[1:], methods, strict=True):
            axes.scatter(*view[1].T, s=2, color="#BBBBBB", linewidth=0, alpha=0.5)
            axes.scatter(
                *((example.registered[method] - centre) @ rotation).T,
                s=6,
                c=example.errors[method],
                cmap=_ERROR_COLOURS,
                norm=norm,
                linewidth=0,
                depthshade=False,
            )
        if row == 0:
            line[0].legend(fontsize=8, frameon=False, loc="upper left", markerscale=2)
            for axes, name in zip(line, ["Before", *map(titles.get, methods)], strict=True):
                axes.set_title(name, fontsize=11)
    figure.colorbar(
        ScalarMappable(norm, _ERROR_COLOURS),
        ax=panels,
        shrink=0.6,
        extend="max",
        label=error,
    )
    return figure


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


def lambda_figure(search: Mapping[str, Any], origin: str) -> Figure:
    """Validation errors over the prior weight, with the choice and the λ = 0 control marked."""
    curve = pd.DataFrame(search["curve"]).astype({"lambda": float, "cd": float, "mce": float})
    labels = {
        "cd": (CD_SCALE, f"Mean Chamfer distance {_UNIT}"),
        "mce": (1.0, "Mean correspondence error"),
    }
    columns = [name for name in labels if curve[name].notna().any()]
    title = f"Choice of λ: {display_name(search['dataset'])}, {display_name(search['backbone'])}"
    note = "Validation pairs. Star: chosen λ. Dashed: λ = 0, longer training alone."
    figure = new_figure(4.8 * len(columns), 4.2, title, origin, note)
    panels = figure.subplots(1, len(columns), squeeze=False)[0]
    for axes, column in zip(panels, columns, strict=True):
        scale, label = labels[column]
        for prior, (colour, marker) in method_styles(curve["prior"]).items():
            line = curve[curve["prior"] == prior].sort_values("lambda").dropna(subset=column)
            for value in line.loc[line["lambda"] == 0, column]:
                axes.axhline(scale * value, color=colour, linestyle="--", linewidth=1)
            line = line[line["lambda"] > 0]
            x, y = line["lambda"].to_numpy(), scale * line[column].to_numpy()
            axes.plot(x, y, color=colour, marker=marker, label=display_name(prior))
            chosen = np.isclose(x, search["selected"].get(prior, np.nan), rtol=1e-6, atol=0)
            axes.plot(
                x[chosen], y[chosen], color=colour, marker="*", ms=17, markeredgecolor="black",
                linestyle="none", zorder=3,
            )  # fmt: skip
        axes.set_xscale("log")
        axes.set_xlabel("Prior weight λ")
        axes.set_ylabel(label)
        plain_axes(axes)
    panels[0].legend()
    return figure


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
    names = list(dict.fromkeys(name for frame in histories.values() for name in frame))
    columns = [
        name
        for name in [*known, *(name for name in names if name.startswith("val"))]
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
    panels[0].legend(fontsize=8, frameon=False)
    return figure


# ------------------------------------------------------------------------------ PCA prior


def pca_spectrum_figure(
    explained_variance: np.ndarray, explained_variance_ratio: np.ndarray, title: str, origin: str
) -> Figure:
    """Explained variance per component (log) and its cumulative share."""
    component = np.arange(1, len(explained_variance) + 1)
    cumulative = 100 * np.cumsum(explained_variance_ratio)
    figure = new_figure(9.6, 3.8, title, origin)
    left, right = figure.subplots(1, 2)
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
    count: int = 3,
) -> Figure:
    """The first modes on the source, at −2 and +2 standard deviations around the mean field.

    ``modes`` (n_c, N, 3) are displacements per unit of a coefficient whose variance is
    ``explained_variance``. Colour and arrows show the mode's own share of the displacement.
    """
    count = min(count, len(modes))
    steps = 2 * np.sqrt(explained_variance[:count])[:, None, None] * modes[:count]
    lengths = np.linalg.norm(steps, axis=2)
    norm = Normalize(0, float(lengths.max()) or 1.0)
    centre, rotation = _principal_frame(source)
    base = (source + mean - centre) @ rotation
    limits = _cube(
        np.concatenate([(base + sign * s @ rotation) for s in steps for sign in (-1, 1)])
    )
    arrows = np.linspace(0, len(source) - 1, min(len(source), 150)).astype(int)
    figure = new_figure(
        3.1 * count + 1,
        5.6,
        title,
        origin,
        "Points: mean field ± 2 standard deviations of one mode. Arrows: from the mean field.",
    )
    panels = figure.subplots(2, count, squeeze=False, subplot_kw={"projection": "3d"})
    for line, sign in zip(panels, (-1, 1), strict=True):
        for mode, axes in enumerate(line):
            step = sign * steps[mode] @ rotation
            _bare_axes(axes, limits)
            axes.scatter(
                *(base + step).T, s=5, c=lengths[mode], cmap="viridis", norm=norm, linewidth=0
            )
            axes.quiver(
                *base[arrows].T, *step[arrows].T, color="#333333", linewidth=0.5, alpha=0.7,
                arrow_length_ratio=0.3,
            )  # fmt: skip
            axes.set_title(f"Mode {mode + 1}, {'+' if sign > 0 else '−'}2 sd", fontsize=10)
    figure.colorbar(
        ScalarMappable(norm, "viridis"), ax=panels, shrink=0.6, label="Displacement by the mode"
    )
    return figure


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
    panels = figure.subplots(1, count + 1, subplot_kw={"projection": "3d"})
    fields = [np.zeros_like(source), *samples]
    for number, (axes, field) in enumerate(zip(panels, fields, strict=True)):
        _bare_axes(axes, limits)
        colour = np.linalg.norm(field, axis=1)
        axes.scatter(
            *(base + field @ rotation).T, s=5, c=colour, cmap="viridis", norm=norm, linewidth=0
        )
        axes.set_title("Source" if number == 0 else f"Sample {number}", fontsize=10)
    figure.colorbar(
        ScalarMappable(norm, "viridis"), ax=list(panels), shrink=0.7, label="Displacement"
    )
    return figure
