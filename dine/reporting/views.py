"""Views of clouds: typical pairs before and after, modes of a prior and fields drawn from it."""

from __future__ import annotations

import os
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from dine.errors import DataError
from dine.io import announced
from dine.reporting import names
from dine.reporting.figures import SMALL, UNIT, method_styles, new_figure, plain
from dine.reporting.names import CD_SCALE, display_name
from dine.results import CLEAN, condition_key

if TYPE_CHECKING:
    from dine.data.pairs import PairSet

_ERROR_COLOURS = "coolwarm"
_POINTS = {"linewidth": 0, "rasterized": True}  # thousands of paths in a PDF are slow to show


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
    error: str = f"Squared distance to the clean target {UNIT}",
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
    clouds, names = panels[0, 0].get_legend_handles_labels()
    figure.legend(clouds, names, **SMALL, loc="outside lower left", ncols=2, markerscale=2)
    for axes, text in zip(panels[0], ["Before", *titles.values()], strict=True):
        axes.set_title(text, fontsize=11)
    scale = ScalarMappable(norm, _ERROR_COLOURS)
    bar = figure.colorbar(scale, ax=panels, shrink=0.6, extend="max")
    bar.set_label(textwrap.fill(error, int(8 * size[1])), fontsize=9)
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
