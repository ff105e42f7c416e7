"""Tables of a run beside the published ones, as tidy CSV, Markdown and LaTeX.

Means are over test pairs; ± is the sample standard deviation over them (ddof = 1). The paper does
not say which of the two it uses; from ten pairs on they differ by less than 6 %. Chamfer distances
are squared, symmetric, in the normalised frame, and shown in units of 1e-4 as in the paper.

A dataset whose test pairs are both of objects that were trained on and of others is shown as two:
under its own name the known objects, and with ``_unseen`` behind it the others.
"""

from __future__ import annotations

import functools
import os
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import Path

import numpy as np
import pandas as pd

from dine.errors import DataError
from dine.evaluation.statistics import verdicts
from dine.files import atomic_path, write_text
from dine.results import CLEAN, KNOWN, PAPER_TABLES, UNSEEN, table_name, trained_on, unseen_of

CD_SCALE = 1e4
COLUMNS = [
    *("dataset", "backbone", "method", "seed", "origin", "pair", "object", "objects", "cluster"),
    *("level", "condition", "corruption", "cd", "cd_observed", "cd_unregistered", "mce"),
]
DATASET_NAMES = {"deformedtissue": "DeformedTissue", "synbench": "SynBench"}
BACKBONE_NAMES = {
    "robust_defreg": "Robust-DefReg",
    "deftransnet": "DefTransNet",
    "robust_defreg_geometric": "Robust-DefReg, geometric start",
}
METHOD_NAMES = {
    "stage1": "Stage 1",
    "lambda0": "Control (λ = 0)",
    "pca": "DINE-PCA",
    "pca_residual": "PCA with residual",
    "flow": "DINE-Flow",
    "unregistered": "Unregistered",
}
ORIGIN_NAMES = {
    "synthetic": "synthetic data",
    "bases": "real base meshes with synthetic deformations",
    "path": "data supplied by the user",
    "doi": "published data",
}
# The paper's order: its Table 3 lists outliers before noise.
CONDITION_NAMES = {
    "deformation": "Deformation",
    "outliers": "Outliers",
    "noise": "Noise",
    "resampled": "Other points",
}
CORRUPTIONS = ("outliers", "noise", "resampled")
OBJECTS_NAMES = {KNOWN: "known objects", UNSEEN: "unseen objects"}
BASELINES = ("stage1", "lambda0")

_PAPER_TABLES = {
    number: (dataset, CORRUPTIONS if corrupted else ("deformation",))
    for (dataset, corrupted), number in PAPER_TABLES.items()
}
_BOLD = (
    "Bold: lower than the control of the same backbone, and the 95 % interval of the difference "
    "holds no zero."
)
_SETTING = ["condition", "corruption", "level"]
_SERIES = ["backbone", "method"]
_TEXT_COLUMNS = ("dataset", *_SERIES, "origin", "pair", "object", "objects", "cluster")
_DASH = "–"
# Levels and corruptions that passed through float32 must still meet; real ones lie far apart.
_KEY_DECIMALS = 6


@dataclass(frozen=True)
class Cell:
    """One entry of a displayed table, as plain text."""

    text: str
    bold: bool = False


@dataclass(frozen=True)
class Table:
    """A table to read (``header``, ``rows``) and the tidy numbers behind it (``data``).

    ``header`` holds (group, label) per column; adjacent columns of one group share a heading, and
    the group of a row-label column is empty.
    """

    name: str
    title: str
    caption: str
    header: tuple[tuple[str, str], ...]
    rows: tuple[tuple[Cell, ...], ...]
    data: pd.DataFrame


# ---------------------------------------------------------------------------------- input


def load_metrics(paths: Iterable[str | os.PathLike]) -> pd.DataFrame:
    """Read per-pair metrics files into one frame.

    ``mce`` may be empty (pairs without known correspondences) and so may ``level``; every Chamfer
    distance must be a finite number of at least 0.

    Raises:
        DataError: a file is missing, lacks a column or holds values that cannot be used, or the
            files contradict each other.
    """
    frames = [_load_one(Path(path)) for path in paths]
    metrics = combined(frames, ["dataset", *_SERIES, "seed", "condition", "corruption", "pair"])
    kinds = metrics.groupby("dataset")["objects"].transform("nunique")
    apart = (kinds > 1) & (metrics["objects"] == UNSEEN)
    return metrics.assign(dataset=metrics["dataset"].mask(apart, metrics["dataset"].map(unseen_of)))


def combined(frames: Sequence[pd.DataFrame], key: list[str]) -> pd.DataFrame:
    """The rows of all frames; columns ``key`` tell evaluations apart.

    Raises:
        DataError: no frames, the same evaluation in two rows, or a dataset of mixed origins.
    """
    if not frames:
        raise DataError("No metrics files were given; evaluate a model first.")
    metrics = pd.concat(frames, ignore_index=True)
    repeated = metrics[metrics.duplicated(key)]
    if len(repeated):
        what = ", ".join(f"{name} {value}" for name, value in repeated.iloc[0][key].items())
        raise DataError(f"The metrics files hold the same evaluation twice ({what}).")
    for dataset, origins in metrics.groupby("dataset")["origin"].unique().items():
        if len(origins) > 1:
            raise DataError(
                f"The metrics files of {dataset} mix data of different origins "
                f"({', '.join(sorted(origins))}); their numbers cannot stand in one table."
            )
    return metrics


def _load_one(path: Path) -> pd.DataFrame:
    try:
        frame = pd.read_csv(path, dtype=dict.fromkeys(_TEXT_COLUMNS, str))
    except FileNotFoundError as error:
        raise DataError(f"{path} does not exist.") from error
    except (OSError, ValueError) as error:
        raise DataError(f"{path} is not a readable CSV file ({error}).") from error
    missing = [name for name in COLUMNS if name not in frame]
    if missing:
        raise DataError(f"{path} lacks the column(s) {', '.join(missing)}.")
    if frame.empty:
        raise DataError(f"{path} holds no rows.")
    for name in _TEXT_COLUMNS:
        if frame[name].isna().any():
            raise DataError(f"{path}: column {name} is empty in some rows.")
    for name in ("seed", "level", "corruption", "cd", "cd_observed", "cd_unregistered", "mce"):
        try:
            frame[name] = pd.to_numeric(frame[name]).astype(float)
        except (TypeError, ValueError) as error:
            raise DataError(f"{path}: column {name} is not numeric ({error}).") from error
        if name in ("level", "mce"):
            continue
        bad = ~(np.isfinite(frame[name]) & (frame[name] >= 0))
        if bad.any():
            raise DataError(
                f"{path}: column {name} holds {frame.loc[bad, name].iloc[0]} in data row "
                f"{int(np.argmax(bad)) + 1}; it must be a finite number of at least 0."
            )
    for name, allowed in (
        ("condition", CONDITION_NAMES),
        ("origin", ORIGIN_NAMES),
        ("objects", OBJECTS_NAMES),
    ):
        unknown = frame.loc[~frame[name].isin(list(allowed)), name]
        if len(unknown):
            raise DataError(
                f"{path}: unknown {name} {unknown.iloc[0]!r}; expected one of {', '.join(allowed)}."
            )
    return frame[COLUMNS]


@functools.cache
def _published() -> pd.DataFrame:
    source = resources.files("dine.reporting").joinpath("published_results.csv")
    with source.open(encoding="utf-8") as stream:
        frame = pd.read_csv(stream)
    frame = frame.rename(columns={"cd_mean_1e-4": "published_mean", "cd_std_1e-4": "published_std"})
    # The paper's "level" of a corruption is its strength: sigma, or outliers as a fraction.
    strength = frame["level"].where(frame["condition"] != "outliers", frame["level"] * 100)
    deformation = frame["condition"] == "deformation"
    frame["corruption"] = strength.mask(deformation, 0.0)
    frame["level"] = frame["level"].where(deformation)
    return _rounded(frame)


def published() -> pd.DataFrame:
    """The paper's Tables 1 to 3, keyed like the metrics: corruption 0 and a level for deformation,
    no level and sigma or percent as corruption for noise and outliers."""
    return _published().copy()


def _rounded(frame: pd.DataFrame) -> pd.DataFrame:
    keys = {name: frame[name].astype(float).round(_KEY_DECIMALS) for name in _SETTING[1:]}
    return frame.assign(**keys)


# -------------------------------------------------------------------------------- numbers


def summary(
    metrics: pd.DataFrame, value: str = "cd", scale: float = CD_SCALE, pool_levels: bool = False
) -> pd.DataFrame:
    """Mean and sample standard deviation of ``scale`` times a metric over pairs.

    One row per dataset, condition, corruption, level, backbone and method, with the number ``n``
    of pairs. The standard deviation of a single pair is missing, not zero. With ``pool_levels``
    all deformation levels count together and ``level`` is missing.
    """
    frame = _rounded(metrics)
    frame[value] = scale * frame[value]
    if pool_levels:
        frame["level"] = np.nan
    grouped = frame.groupby(["dataset", *_SETTING, *_SERIES], dropna=False)[value]
    return grouped.agg(n="count", mean="mean", std="std").reset_index()


def _unregistered(metrics: pd.DataFrame) -> pd.DataFrame:
    """The source as it is, as a method of no backbone: every method shares the same pairs."""
    frame = metrics.drop_duplicates(["dataset", "condition", "corruption", "pair"])
    return frame.assign(backbone="", method="unregistered", cd=frame["cd_unregistered"])


def _compare(
    dataset: str,
    metrics: pd.DataFrame,
    conditions: tuple[str, ...],
    value: str = "cd",
    scale: float = CD_SCALE,
    reference: pd.DataFrame | None = None,
    spread: float = 0.0,
) -> pd.DataFrame:
    """Tidy numbers of one dataset: ours and, where ``reference`` has them, the published ones.

    With what each method differs by from the control, as ``statistics.verdicts`` says it.
    """
    rows = metrics[(metrics["dataset"] == dataset) & metrics["condition"].isin(conditions)]
    rows = rows[rows[value].notna()]
    decided = verdicts(rows, "lambda0", value, spread=spread)
    if value == "cd":
        rows = pd.concat([rows, _unregistered(rows)])
    clean = rows["condition"] == "deformation"
    ours = pd.concat(
        [summary(rows[clean], value, scale), summary(rows[~clean], value, scale, pool_levels=True)]
    ).drop(columns="dataset")
    if reference is None:
        reference = published().iloc[:0]
    reference = reference[
        (reference["dataset"] == dataset) & reference["condition"].isin(conditions)
    ]
    data = ours.merge(
        reference[[*_SETTING, *_SERIES, "published_mean", "published_std"]],
        on=[*_SETTING, *_SERIES],
        how="outer",
    )
    data["n"] = data["n"].fillna(0).astype(int)
    clean = decided["condition"] == CLEAN
    decided = decided[decided["level"].notna() == clean]
    data = data.merge(
        decided[[*_SETTING, *_SERIES, "relative", "low", "high", "verdict"]],
        on=[*_SETTING, *_SERIES],
        how="left",
    )
    data["verdict"] = data["verdict"].fillna("")
    data.insert(0, "dataset", dataset)
    data.insert(1, "origin", origin_of(dataset, metrics) or "")
    return data.sort_values([*_SETTING, *_SERIES], key=_sort_key, kind="stable", ignore_index=True)


def _sort_key(column: pd.Series) -> pd.Series:
    known = {
        "condition": CONDITION_NAMES,
        "backbone": {"": "", **BACKBONE_NAMES},
        "method": METHOD_NAMES,
    }.get(column.name)
    return column if known is None else column.map(lambda name: rank(name, known))


def rank(name: str, known: Iterable[str]) -> str:
    """A sort key: known names in their order, then the others by alphabet."""
    order = list(known)
    return f"{order.index(name) if name in order else len(order):03d} {name}"


def gains(metrics: pd.DataFrame, spread: float = 0.0) -> pd.DataFrame:
    """What each prior adds: reductions of the mean Chamfer distance in percent, on shared pairs.

    One row per dataset, backbone, prior and setting (deformation by level, corruptions pooled over
    levels). ``gain_over_lambda0`` is the effect of the prior, ``lambda0_gain_over_stage1`` that of
    the longer training alone; negative values are losses. ``low`` and ``high`` are its 95 %
    interval and ``verdict`` what follows, as of ``statistics.verdicts``. Only pairs evaluated with
    every method present count; columns of a method that was not run are missing.
    """
    frame = _rounded(metrics)
    decided = verdicts(frame, "lambda0", spread=spread)
    decided = decided[decided["level"].notna() == (decided["condition"] == CLEAN)]
    frame["cd"] = CD_SCALE * frame["cd"]
    frame.loc[frame["condition"] != "deformation", "level"] = np.nan
    records = []
    keys = ["dataset", "backbone", *_SETTING]
    for key, rows in frame.groupby(keys, dropna=False):
        wide = rows.pivot(index="pair", columns="method", values="cd").dropna()
        if wide.empty:
            continue
        mean = wide.mean().reindex([*BASELINES, *wide.columns.difference(BASELINES)])
        for method in mean.index[len(BASELINES) :]:
            control = wide.get("lambda0")
            records.append(
                {
                    **dict(zip(keys, key, strict=True)),
                    "method": method,
                    "n": len(wide),
                    "stage1_mean": mean["stage1"],
                    "lambda0_mean": mean["lambda0"],
                    "mean": mean[method],
                    "lambda0_gain_over_stage1": _gain(mean["stage1"], mean["lambda0"]),
                    "gain_over_stage1": _gain(mean["stage1"], mean[method]),
                    "gain_over_lambda0": _gain(mean["lambda0"], mean[method]),
                    "pairs_better_than_lambda0": np.nan
                    if control is None
                    else 100 * float((wide[method] < control).mean()),
                }
            )
    columns = [
        *("dataset", "backbone", "method", *_SETTING, "n", "stage1_mean", "lambda0_mean", "mean"),
        *("lambda0_gain_over_stage1", "gain_over_stage1", "gain_over_lambda0"),
        "pairs_better_than_lambda0",
    ]
    found = pd.DataFrame(records, columns=columns)
    # An interval of the difference, turned into one of the reduction.
    turned = decided.assign(low=-decided["high"], high=-decided["low"])
    turned = turned[["dataset", *_SERIES, *_SETTING, "low", "high", "verdict"]]
    found = found.merge(turned, on=["dataset", *_SERIES, *_SETTING], how="left")
    return found.sort_values(
        ["dataset", *_SERIES, *_SETTING], key=_sort_key, kind="stable", ignore_index=True
    )


def _gain(before: float, after: float) -> float:
    return 100 * (1 - after / before) if before > 0 else np.nan


# --------------------------------------------------------------------------------- tables


def paper_table(number: int, metrics: pd.DataFrame, spread: float = 0.0) -> Table:
    """Table 1, 2 or 3 of the paper: this run's values with the published ones beneath.

    Levels of the run that the paper lacks, and the reverse, both appear.
    """
    dataset, conditions = _PAPER_TABLES[number]
    frame = published()
    return _cd_table(dataset, metrics, conditions, frame[frame["table"] == number], number, spread)


def deformation_table(dataset: str, metrics: pd.DataFrame, spread: float = 0.0) -> Table:
    """Chamfer distance by deformation level: Table 1 or 2 where the paper has one."""
    return _any_table(dataset, metrics, (CLEAN,), spread)


def corruption_table(dataset: str, metrics: pd.DataFrame, spread: float = 0.0) -> Table:
    """Chamfer distance under outliers and noise: Table 3 where the paper has one."""
    return _any_table(dataset, metrics, CORRUPTIONS, spread)


def _any_table(
    dataset: str, metrics: pd.DataFrame, conditions: tuple[str, ...], spread: float
) -> Table:
    for number, content in _PAPER_TABLES.items():
        if content == (dataset, conditions):
            return paper_table(number, metrics, spread)
    return _cd_table(dataset, metrics, conditions, None, None, spread)


def _cd_table(
    dataset: str,
    metrics: pd.DataFrame,
    conditions: tuple[str, ...],
    reference: pd.DataFrame | None,
    number: int | None,
    spread: float,
) -> Table:
    data = _compare(dataset, metrics, conditions, reference=reference, spread=spread)
    clean = conditions == ("deformation",)
    title = "Increasing deformation" if clean else "Outliers and noise"
    caption = [
        _origin_sentence(dataset, metrics, reference is not None),
        "Chamfer distance in units of 10⁻⁴",
        "to the target:"
        if clean
        else "to the clean target under outliers (% of the points) and Gaussian noise (σ), pooled "
        "over deformation levels:",
        "mean ± sample standard deviation over test pairs; lower is better.",
        _BOLD,
    ]
    if (data["method"] == "lambda0").any():
        caption.append(
            "The control is trained like the priors, from the same start with the same steps and "
            "seed, but with λ = 0."
        )
    if number:
        caption.append(
            "The paper has no values for the unregistered source and the control"
            + ("." if clean else ", and does not say how it combined deformation levels here.")
        )
    return Table(
        name=table_name(dataset, corrupted=not clean),
        title=f"{title}: {display_name(dataset)}"
        + (f" (Table {number} of the paper)" if number else ""),
        caption=" ".join(caption),
        **_layout(data, decimals=2, with_paper=reference is not None),
        data=data.rename(
            columns={
                name: f"{name}_1e-4" for name in ("mean", "std", "published_mean", "published_std")
            }
        ),
    )


def correspondence_table(dataset: str, metrics: pd.DataFrame, spread: float = 0.0) -> Table:
    """Mean correspondence error in every setting; pairs without correspondences do not count."""
    data = _compare(dataset, metrics, tuple(CONDITION_NAMES), "mce", 1.0, spread=spread)
    return Table(
        name=f"correspondence_{dataset}",
        title=f"Correspondence error: {display_name(dataset)}",
        caption=f"{_origin_sentence(dataset, metrics, False)} Mean distance between a "
        "registered point and its true counterpart, in the normalised frame, mean ± sample "
        "standard deviation over test pairs; lower is better. Unlike the Chamfer distance it sees "
        f"points that slid along the surface. {_BOLD}",
        **_layout(data, decimals=4, with_paper=False),
        data=data.drop(columns=["published_mean", "published_std"]),
    )


def observed_table(dataset: str, metrics: pd.DataFrame, spread: float = 0.0) -> Table:
    """Table 3's settings against the corrupted target that the model sees."""
    data = _compare(dataset, metrics, CORRUPTIONS, "cd_observed", spread=spread)
    return Table(
        name=f"observed_{dataset}",
        title=f"Against the observed target: {display_name(dataset)}",
        caption=f"{_origin_sentence(dataset, metrics, False)} Chamfer distance to the "
        "observed target, with its outliers and noise, in units of 10⁻⁴, mean ± sample standard "
        "deviation over test pairs. A method that follows the corruption scores well here and "
        f"badly against the clean target. {_BOLD}",
        **_layout(data, decimals=2, with_paper=False),
        data=data.drop(columns=["published_mean", "published_std"]).rename(
            columns={"mean": "mean_1e-4", "std": "std_1e-4"}
        ),
    )


def gain_table(dataset: str, metrics: pd.DataFrame, spread: float = 0.0) -> Table:
    """What does the prior add over longer training? The rows of ``gains`` for one dataset."""
    data = gains(metrics[metrics["dataset"] == dataset], spread)
    data.insert(1, "origin", origin_of(dataset, metrics) or "")
    rows = []
    for row in data.itertuples(index=False):
        rows.append(
            tuple(
                Cell(text)
                for text in (
                    display_name(row.backbone),
                    display_name(row.method),
                    *_setting_label(row.condition, row.corruption, row.level),
                    str(row.n),
                    _signed(row.lambda0_gain_over_stage1),
                    _signed(row.gain_over_stage1),
                    _signed(row.gain_over_lambda0),
                    _interval(row.low, row.high),
                    _DASH if pd.isna(row.verdict) else row.verdict,
                    _DASH
                    if np.isnan(row.pairs_better_than_lambda0)
                    else f"{row.pairs_better_than_lambda0:.0f} %",
                )
            )
        )
    header = (
        *(("", label) for label in ("Backbone", "Prior", "Setting", "Level", "Pairs")),
        ("Reduction of the mean CD", "Control over Stage 1"),
        ("Reduction of the mean CD", "Prior over Stage 1"),
        ("Reduction of the mean CD", "Prior over control"),
        ("Reduction of the mean CD", "95 % interval"),
        ("", "Verdict"),
        ("", "Pairs better than control"),
    )
    return Table(
        name=f"gains_{dataset}",
        title=f"What does the prior add over longer training? {display_name(dataset)}",
        caption=f"{_origin_sentence(dataset, metrics, False)} Reduction of the mean "
        "Chamfer distance in percent on the pairs that all methods share; negative values are "
        "losses. The control differs from the prior only in λ = 0. The interval is that of the "
        "reduction over the control: of the test pairs, drawn by deformation where the object is "
        f"known and by object otherwise{_spread_text(spread)}. Undecided: it holds zero.",
        header=header,
        rows=tuple(rows),
        data=data.rename(
            columns={name: f"{name}_1e-4" for name in data if name.endswith("mean")}
            | {
                name: f"{name}_percent"
                for name in data
                if "gain" in name or name.startswith("pairs_") or name in ("low", "high")
            }
        ),
    )


def all_tables(metrics: pd.DataFrame, spread: float = 0.0) -> list[Table]:
    """Every table that the metrics have rows for: the paper's first, then the supplementary.

    ``spread`` is how much differences vary with the training; see ``statistics.verdicts``.
    """
    tables, comparisons, supplementary = [], [], []
    for dataset in sorted(metrics["dataset"].unique(), key=lambda name: rank(name, DATASET_NAMES)):
        rows = metrics[metrics["dataset"] == dataset]
        corrupted = rows["condition"].isin(CORRUPTIONS)
        if (rows["condition"] == "deformation").any():
            tables.append(deformation_table(dataset, rows, spread))
        if corrupted.any():
            tables.append(corruption_table(dataset, rows, spread))
            supplementary.append(observed_table(dataset, rows, spread))
        if rows["mce"].notna().any():
            supplementary.append(correspondence_table(dataset, rows, spread))
        if len(gains(rows)):
            comparisons.append(gain_table(dataset, rows, spread))
    tables.sort(key=lambda table: (not table.name.startswith("table"), table.name))
    return tables + comparisons + supplementary


def origin_of(dataset: str, metrics: pd.DataFrame) -> str | None:
    """The origin of a dataset's pairs, or None where the metrics have none of it."""
    origins = metrics.loc[metrics["dataset"] == dataset, "origin"]
    return None if origins.empty else str(origins.iloc[0])


def _origin_sentence(dataset: str, metrics: pd.DataFrame, with_paper: bool) -> str:
    origin = origin_of(dataset, metrics)
    known = trained_on(dataset)
    name = display_name(known)
    if origin is None:
        return f"This run has no results on {name}; only the published values are shown."
    rows = metrics[metrics["dataset"] == dataset]
    objects = " and ".join(OBJECTS_NAMES[kind] for kind in sorted(set(rows["objects"])))
    if known not in DATASET_NAMES or origin not in ("synthetic", "bases"):
        return f"DINE on {name} ({ORIGIN_NAMES[origin]}), {objects}."
    text = f"DINE on {ORIGIN_NAMES[origin]} in the layout of {name}, {objects}"
    if with_paper:
        text += (
            f"; published values are on the real {name} data and are not comparable in absolute "
            "terms"
        )
    return f"{text}."


def _layout(data: pd.DataFrame, decimals: int, with_paper: bool) -> dict:
    """Header and display rows: settings down, methods by backbone across, ours above published."""
    series = data[_SERIES].drop_duplicates().sort_values(_SERIES, key=_sort_key)
    columns = list(series[series["method"] != "unregistered"].itertuples(index=False, name=None))
    # Shown even without results of this run, so that an empty table still says what is missing.
    baseline = [("", "unregistered")] if (series["method"] == "unregistered").any() else []
    corrupted = bool((data["condition"] != "deformation").any())
    labels = (["Setting"] if corrupted else []) + ["Level"]
    header = [("", label) for label in [*labels, *(["Values"] if with_paper else []), "Pairs"]]
    header += [("", display_name(method)) for _, method in baseline]
    header += [(display_name(backbone), display_name(method)) for backbone, method in columns]
    rows = []
    for setting, values in data.groupby(_SETTING, dropna=False, sort=False):
        label = [Cell(text) for text in _setting_label(*setting)][-len(labels) :]
        values = values.set_index(_SERIES)
        ours, paper = [], []
        for key in [*baseline, *columns]:
            if key not in values.index:
                ours.append(Cell(_DASH))
                paper.append(Cell(_DASH))
                continue
            value = values.loc[key]
            text = _plus_minus(value["mean"], value["std"], decimals)
            ours.append(Cell(text, value["verdict"] == "lower"))
            # The paper prints its Table 3 with one decimal.
            digits = 2 if setting[0] == "deformation" else 1
            paper.append(Cell(_plus_minus(value["published_mean"], value["published_std"], digits)))
        source = [Cell("this run")] if with_paper else []
        rows.append((*label, *source, Cell(_count(values["n"])), *ours))
        if with_paper:
            blank = [Cell("")] * len(label)
            rows.append((*blank, Cell("paper"), Cell(_DASH), *paper))
    return {"header": tuple(header), "rows": tuple(rows)}


def display_name(key: str) -> str:
    """The name to show for a dataset, backbone or method; unknown ones are shown as they are."""
    known = trained_on(key)
    if known != key:
        return f"{display_name(known)}, {OBJECTS_NAMES[UNSEEN]}"
    return {**DATASET_NAMES, **BACKBONE_NAMES, **METHOD_NAMES}.get(key, key)


def setting_text(condition: str, corruption: float) -> str:
    """A condition and its strength, in words."""
    if condition == "noise":
        return f"Noise σ = {corruption:g}"
    if condition == "outliers":
        return f"{corruption:g} % outliers"
    return "Clean" if condition == "deformation" else CONDITION_NAMES[condition]


def _setting_label(condition: str, corruption: float, level: float) -> tuple[str, str]:
    if condition == "outliers":
        return "Outliers", f"{corruption:g} %"
    if condition == "noise":
        return "Noise", f"σ = {corruption:g}"
    if condition != "deformation":
        return CONDITION_NAMES.get(condition, condition), _DASH
    return "Deformation", "not given" if np.isnan(level) else f"{level:g}"


def _plus_minus(mean: float, std: float, decimals: int) -> str:
    if np.isnan(mean):
        return _DASH
    return f"{mean:.{decimals}f}" + ("" if np.isnan(std) else f" ± {std:.{decimals}f}")


def _count(counts: pd.Series) -> str:
    counts = counts[counts > 0]
    if counts.empty:
        return _DASH
    low, high = counts.min(), counts.max()
    return f"{low}" if low == high else f"{low}{_DASH}{high}"


def _interval(low: float, high: float) -> str:
    if np.isnan(low):
        return _DASH
    return f"{low:+.0f} to {high:+.0f} %".replace("-", "−")


def _spread_text(spread: float) -> str:
    """What an interval holds besides the chance of the pairs."""
    if not spread:
        return ""
    return f", and of the training, from run to run ± {100 * spread:g} % (standard deviation)"


def _signed(percent: float) -> str:
    return _DASH if np.isnan(percent) else f"{percent:+.1f} %".replace("-", "−")


# -------------------------------------------------------------------------------- writing


def write_table(table: Table, path_stem: str | os.PathLike) -> list[Path]:
    """Write ``<stem>.csv`` (tidy numbers), ``<stem>.md`` and ``<stem>.tex``; return the paths."""
    paths = [Path(f"{path_stem}.{suffix}") for suffix in ("csv", "md", "tex")]
    with atomic_path(paths[0]) as temporary:
        table.data.to_csv(temporary, index=False, float_format="%.10g")
    write_text(paths[1], to_markdown(table))
    write_text(paths[2], to_latex(table))
    return paths


def to_markdown(table: Table) -> str:
    """A GitHub-style table under its title, with the caption beneath."""
    lines = [f"### {_markdown(table.title)}", ""]
    names = [_markdown(f"{group}: {label}" if group else label) for group, label in table.header]
    lines += [f"| {' | '.join(names)} |", f"|{' --- |' * len(names)}"]
    for row in table.rows:
        cells = [f"**{_markdown(c.text)}**" if c.bold else _markdown(c.text) for c in row]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join([*lines, "", _markdown(table.caption), ""])


def _markdown(text: str) -> str:
    return re.sub(r"([\\`*_|<\[\]])", r"\\\1", text)


def to_latex(table: Table) -> str:
    """A booktabs table to ``\\input``; needs the packages booktabs and graphicx."""
    columns = "".join("c" if group else "l" for group, _ in table.header)
    # Shrinks a wide table to the text width as the paper does, but never enlarges a narrow one.
    width = r"\ifdim\width>\textwidth\textwidth\else\width\fi"
    lines = [
        r"% Needs \usepackage{booktabs} and \usepackage{graphicx}.",
        r"\begin{table}[t]",
        r"\centering",
        rf"\caption{{{_latex(table.title)}. {_latex(table.caption)}}}",
        rf"\label{{tab:{re.sub('[^a-z0-9]+', '-', table.name.lower())}}}",
        rf"\resizebox{{{width}}}{{!}}{{%",
        rf"\begin{{tabular}}{{{columns}}}",
        r"\toprule",
        *_latex_groups(table.header),
        " & ".join(_latex(label) for _, label in table.header) + r" \\",
        r"\midrule",
    ]
    for row in table.rows:
        cells = [rf"\textbf{{{_latex(c.text)}}}" if c.bold else _latex(c.text) for c in row]
        lines.append(" & ".join(cells) + r" \\")
    return "\n".join([*lines, r"\bottomrule", r"\end{tabular}%", "}", r"\end{table}", ""])


def header_groups(header: tuple[tuple[str, str], ...]) -> list[tuple[str, int]]:
    """Runs of columns under one heading, as (group, number of columns)."""
    groups: list[tuple[str, int]] = []
    for group, _ in header:
        if groups and groups[-1][0] == group:
            groups[-1] = (group, groups[-1][1] + 1)
        else:
            groups.append((group, 1))
    return groups


def _latex_groups(header: tuple[tuple[str, str], ...]) -> list[str]:
    cells, rules, start = [], [], 1
    for group, width in header_groups(header):
        cells.append(rf"\multicolumn{{{width}}}{{c}}{{{_latex(group)}}}")
        if group:
            rules.append(rf"\cmidrule(lr){{{start}-{start + width - 1}}}")
        start += width
    return [" & ".join(cells) + r" \\", "".join(rules)] if rules else []


_LATEX = {
    "\\": r"\textbackslash{}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    **{character: f"\\{character}" for character in "&%$#_{}"},
    "±": r"$\pm$",
    "10⁻⁴": r"$10^{-4}$",
    "λ": r"$\lambda$",
    "σ": r"$\sigma$",
    "−": "$-$",
    "–": "--",
}
_LATEX_PATTERN = re.compile("|".join(re.escape(text) for text in _LATEX))


def _latex(text: str) -> str:
    return _LATEX_PATTERN.sub(lambda match: _LATEX[match[0]], text)
