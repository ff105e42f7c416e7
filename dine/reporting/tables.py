"""Tables of a run beside the published ones.

Means are over test pairs; ± is the sample standard deviation over them (ddof = 1). The paper does
not say which of the two it uses; from ten pairs on they differ by less than 6 %. Chamfer distances
are squared, symmetric, in the normalised frame, and shown in units of 1e-4 as in the paper.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from importlib import resources
from typing import Any

import numpy as np
import pandas as pd

from dine.config import CONTROL, STAGE1
from dine.evaluation import statistics
from dine.evaluation.statistics import Spread, comparisons, rounded
from dine.reporting import names
from dine.reporting.comparisons import effects, training_chance, verdict_cells
from dine.reporting.loading import origin_of
from dine.reporting.names import CD_SCALE, DASH, display_name, in_order, mean_and_deviation, rank
from dine.reporting.table import Cell, Columns, Table, laid_out
from dine.results import CLEAN, PAPER_TABLES, table_name, trained_on

CORRUPTIONS = ("outliers", "noise", "resampled")
BASELINES = (STAGE1, CONTROL)

_SETTING = ["condition", "corruption", "level"]
_SERIES = ["backbone", "method"]
_MEAN = "mean ± sample standard deviation over test pairs"
_BOLD = (
    "Bold: lower than the control of the same backbone, and the 95 % interval of the difference "
    "holds no zero."
)


@dataclass(frozen=True)
class Kind:
    """What a table of means is of: its title, what its caption says of it, and which numbers."""

    title: str
    caption: str
    conditions: tuple[str, ...]
    value: str = "cd"
    scale: float = CD_SCALE
    decimals: int = 2
    in_paper: bool = False


KINDS = {
    "deformation": Kind(
        "Increasing deformation",
        f"Chamfer distance in units of 10⁻⁴ to the target: {_MEAN}; lower is better. {_BOLD}",
        (CLEAN,),
        in_paper=True,
    ),
    "corruption": Kind(
        "Outliers and noise",
        "Chamfer distance in units of 10⁻⁴ to the clean target under outliers (% of the points) "
        f"and Gaussian noise (σ), pooled over deformation levels: {_MEAN}; lower is better. "
        f"{_BOLD}",
        CORRUPTIONS,
        in_paper=True,
    ),
    "correspondence": Kind(
        "Correspondence error",
        "Mean distance between a registered point and its true counterpart, in the normalised "
        f"frame, {_MEAN}; lower is better. Unlike the Chamfer distance it sees points that slid "
        f"along the surface. {_BOLD}",
        tuple(names.CONDITIONS),
        value="mce",
        scale=1.0,
        decimals=4,
    ),
    "observed": Kind(
        "Against the observed target",
        "Chamfer distance to the observed target, with its outliers and noise, in units of 10⁻⁴, "
        f"{_MEAN}. A method that follows the corruption scores well here and badly against the "
        f"clean target. {_BOLD}",
        CORRUPTIONS,
        value="cd_observed",
    ),
}
"""Tables of means, by the beginning of their names."""


# -------------------------------------------------------------------------------- numbers


def published() -> pd.DataFrame:
    """The paper's Tables 1 to 3, keyed like the metrics: corruption 0 and a level for deformation,
    no level and sigma or percent as corruption for noise and outliers."""
    source = resources.files("dine.reporting").joinpath("published_results.csv")
    with source.open(encoding="utf-8") as stream:
        frame = pd.read_csv(stream)
    frame = frame.rename(columns={"cd_mean_1e-4": "published_mean", "cd_std_1e-4": "published_std"})
    # The paper's "level" of a corruption is its strength: sigma, or outliers as a fraction.
    strength = frame["level"].where(frame["condition"] != "outliers", frame["level"] * 100)
    deformation = frame["condition"] == CLEAN
    frame["corruption"] = strength.mask(deformation, 0.0)
    frame["level"] = frame["level"].where(deformation)
    return rounded(frame)


def summary(
    metrics: pd.DataFrame, value: str = "cd", scale: float = CD_SCALE, pool_levels: bool = False
) -> pd.DataFrame:
    """``mean`` and ``std`` of ``scale`` times a metric over ``n`` pairs, averaged over seeds.

    The standard deviation of a single pair is missing, not zero. With ``pool_levels`` all
    deformation levels count together and ``level`` is missing.
    """
    scaled = metrics.assign(**{value: scale * metrics[value]})
    found = statistics.summary(scaled, (value,), pool_levels=pool_levels)
    named = {"pairs": "n", f"{value}_mean": "mean", f"{value}_sd": "std"}
    return found.rename(columns=named)[["dataset", *_SETTING, *_SERIES, *named.values()]]


def _decided(metrics: pd.DataFrame, value: str, spread: Spread) -> pd.DataFrame:
    """``comparisons`` with the control: by level on clean targets, pooled on others."""
    levels = metrics["level"].where(metrics["condition"] == CLEAN)
    found = comparisons(metrics.assign(level=levels), CONTROL, (value,), spread=spread)
    return found[found["level"].notna() == (found["condition"] == CLEAN)]


def _compare(
    dataset: str, metrics: pd.DataFrame, kind: Kind, reference: pd.DataFrame, spread: Spread
) -> pd.DataFrame:
    """Tidy numbers of one dataset: ours and, where ``reference`` has them, the published ones.

    With what each method differs by from the control, as ``statistics.comparisons`` says it.
    """
    rows = metrics[(metrics["dataset"] == dataset) & metrics["condition"].isin(kind.conditions)]
    rows = rows[rows[kind.value].notna()]
    decided = _decided(rows, kind.value, spread)
    if kind.value == "cd":
        # The source as it is, as a method of no backbone: every method shares the same pairs.
        first = rows.drop_duplicates(["condition", "corruption", "pair"])
        bare = {"backbone": "", "method": "unregistered", "cd": first["cd_unregistered"]}
        rows = pd.concat([rows, first.assign(**bare)])
    clean = rows["condition"] == CLEAN
    means = [
        summary(rows[some], kind.value, kind.scale, pool_levels=pooled)
        for some, pooled in ((clean, False), (~clean, True))
    ]
    keys = [*_SETTING, *_SERIES]
    data = pd.concat(means).drop(columns="dataset")
    data = data.merge(reference[[*keys, "published_mean", "published_std"]], on=keys, how="outer")
    data["n"] = data["n"].fillna(0).astype(int)
    columns = [*keys, "relative", "low", "high", "verdict"]
    data = data.merge(decided[columns], on=keys, how="left")
    data["verdict"] = data["verdict"].fillna("")
    data.insert(0, "dataset", dataset)
    data.insert(1, "origin", origin_of(dataset, metrics) or "")
    return in_order(data, keys)


def gains(metrics: pd.DataFrame, spread: Spread = 0.0) -> pd.DataFrame:
    """What each prior adds: reductions of the mean Chamfer distance in percent, on shared pairs.

    One row per dataset, backbone, prior and setting (deformation by level, corruptions pooled over
    levels). ``gain_over_lambda0`` is the effect of the prior, ``lambda0_gain_over_stage1`` that of
    the longer training alone; negative values are losses. ``low`` and ``high`` are its 95 %
    interval and ``verdict`` what follows, as of ``statistics.comparisons``. Only pairs evaluated
    with every method present count; columns of a method that was not run are missing.
    """
    frame = rounded(metrics)
    frame["cd"] = CD_SCALE * frame["cd"]
    frame["level"] = frame["level"].where(frame["condition"] == CLEAN)
    records = []
    keys = ["dataset", "backbone", *_SETTING]
    for key, rows in frame.groupby(keys, dropna=False):
        wide = rows.pivot(index="pair", columns="method", values="cd").dropna()
        if wide.empty:
            continue
        priors = wide.columns.difference(BASELINES)
        mean = wide.mean().reindex([*BASELINES, *priors])
        stage1, control = mean["stage1"], mean["lambda0"]
        for method in priors:
            better = (wide[method] < wide["lambda0"]).mean() if "lambda0" in wide else np.nan
            records.append(
                {
                    **dict(zip(keys, key, strict=True)),
                    "method": method,
                    "n": len(wide),
                    "stage1_mean": stage1,
                    "lambda0_mean": control,
                    "mean": mean[method],
                    "lambda0_gain_over_stage1": _gain(stage1, control),
                    "gain_over_stage1": _gain(stage1, mean[method]),
                    "gain_over_lambda0": _gain(control, mean[method]),
                    "pairs_better_than_lambda0": 100 * better,
                }
            )
    columns = [
        *("dataset", "backbone", "method", *_SETTING, "n", "stage1_mean", "lambda0_mean", "mean"),
        *("lambda0_gain_over_stage1", "gain_over_stage1", "gain_over_lambda0"),
        "pairs_better_than_lambda0",
    ]
    found = pd.DataFrame(records, columns=columns)
    keys = ["dataset", *_SERIES, *_SETTING]
    decided = _decided(metrics, "cd", spread)
    # An interval of the difference, turned into one of the reduction.
    turned = decided.assign(low=-decided["high"], high=-decided["low"])
    found = found.merge(turned[[*keys, "low", "high", "verdict"]], on=keys, how="left")
    return in_order(found, keys)


def _gain(before: float, after: float) -> float:
    return 100 * (1 - after / before) if before > 0 else np.nan


# ------------------------------------------------------------------------------- findings


def findings(metrics: pd.DataFrame, *, spread: Spread = 0.0) -> list[Table]:
    """Verdicts on clean targets, then those under other conditions and by other measures.

    Empty where no prior was evaluated beside the control.
    """
    control = effects(metrics, spread=spread)
    errors = effects(metrics, value="mce", spread=spread)
    first = effects(metrics, STAGE1, spread=spread)
    clean = control[control["condition"] == CLEAN]
    others = [
        control[control["condition"] != CLEAN].assign(measure=lambda x: x["condition"]),
        errors[errors["condition"] == CLEAN].assign(measure="mce"),
        first[first["condition"] == CLEAN].assign(measure=STAGE1),
    ]
    caption = _CAPTION + training_chance(spread)
    made = [
        ("Does a prior lower the Chamfer distance on clean targets?", caption, clean),
        (
            "Under other conditions, and by other measures",
            "",
            in_order(pd.concat(others), ["measure", "objects", "method"]),
        ),
    ]
    return [
        Table("", title, text, **laid_out(_by_place(data)), data=data)
        for title, text, data in made
        if len(data)
    ]


_MEASURES = {
    **{key: f"Chamfer distance, {text.lower()}" for key, text in names.CONDITIONS.items()},
    "mce": "Mean correspondence error",
    STAGE1: "Chamfer distance, against Stage 1",
}


def _by_place(data: pd.DataFrame) -> Columns:
    """A row for each kind of objects and prior, or ``measure`` of these; a column for each place.

    A place is a dataset with a backbone, whether the objects are known or not.
    """
    data = data.assign(dataset=data["dataset"].map(trained_on))
    keys = ["measure", "objects", "method"] if "measure" in data else ["objects", "method"]
    rows = list(data[keys].drop_duplicates().itertuples(index=False, name=None))
    columns: Columns = {}
    if len(keys) > 2:
        columns["", "Measure"] = [_MEASURES[row[0]] for row in rows]
    columns["", "Objects"] = [names.OBJECTS[row[-2]].capitalize() for row in rows]
    columns["", "Prior"] = [display_name(row[-1]) for row in rows]
    for place, here in in_order(data, ["dataset", "backbone"]).groupby(
        ["dataset", "backbone"], sort=False
    ):
        columns[tuple(map(display_name, place))] = verdict_cells(here, keys, rows)
    return columns


_CAPTION = (
    "Lower, higher or undecided: the mean of the prior against that of the control, which was "
    "trained alike but with λ = 0. Beside it the difference in percent of the control's mean, over "
    "all levels and strengths, and its 95 % interval. Where that holds zero, the matter is "
    "undecided. The interval is of the test pairs that both methods share: drawn by deformation "
    "where the object is known, and by object where it is unseen. "
    "Known objects are those that were trained on, under deformations that were not; the prior is "
    "defined for these. Unseen objects were not trained on at all."
)


# -------------------------------------------------------------------------------- tables


def mean_table(kind: str, dataset: str, metrics: pd.DataFrame, spread: Spread = 0.0) -> Table:
    """Means of one of ``KINDS`` by method and setting, with the published ones beneath.

    Levels of the run that the paper lacks, and the reverse, both appear.
    """
    about = KINDS[kind]
    clean = about.conditions == (CLEAN,)
    number = PAPER_TABLES.get((dataset, not clean)) if about.in_paper else None
    paper = published()
    data = _compare(dataset, metrics, about, paper[paper["table"] == number], spread)
    caption = [_origin_sentence(dataset, metrics, number is not None), about.caption]
    if about.in_paper and (data["method"] == "lambda0").any():
        caption.append(
            "The control is trained like the priors, from the same start with the same steps and "
            "seed, but with λ = 0."
        )
    if number:
        caption.append(
            "The paper has no values for the unregistered source and the control"
            + ("." if clean else ", and does not say how it combined deformation levels here.")
        )
    title = f"{about.title}: {display_name(dataset)}"
    layout = _layout(data, about.decimals, number is not None)
    if not about.in_paper:
        data = data.drop(columns=["published_mean", "published_std"])
    if about.scale != 1:
        scaled = ("mean", "std", "published_mean", "published_std")
        data = data.rename(columns={name: f"{name}_1e-4" for name in scaled})
    return Table(
        name=table_name(dataset, not clean) if about.in_paper else f"{kind}_{dataset}",
        title=f"{title} (Table {number} of the paper)" if number else title,
        caption=" ".join(caption),
        **layout,
        data=data,
    )


def gain_table(dataset: str, metrics: pd.DataFrame, spread: Spread = 0.0) -> Table:
    """What does the prior add over longer training? The rows of ``gains`` for one dataset."""
    data = gains(metrics[metrics["dataset"] == dataset], spread)
    data.insert(1, "origin", origin_of(dataset, metrics) or "")
    rows = data.to_dict("records")
    settings = [_setting_label(row) for row in rows]
    columns: Columns = {
        ("", "Backbone"): data["backbone"].map(display_name),
        ("", "Prior"): data["method"].map(display_name),
        ("", "Setting"): [setting for setting, _ in settings],
        ("", "Level"): [level for _, level in settings],
        ("", "Pairs"): data["n"],
    }
    reduction = "Reduction of the mean CD"
    for label, name in (
        ("Control over Stage 1", "lambda0_gain_over_stage1"),
        ("Prior over Stage 1", "gain_over_stage1"),
        ("Prior over control", "gain_over_lambda0"),
    ):
        columns[reduction, label] = [names.percent(value, 1) for value in data[name]]
    columns[reduction, "95 % interval"] = [
        DASH if np.isnan(row["low"]) else f"{names.interval(row['low'], row['high'])} %"
        for row in rows
    ]
    columns["", "Verdict"] = [Cell(x or DASH, verdict=x) for x in data["verdict"].fillna("")]
    better = data["pairs_better_than_lambda0"]
    columns["", "Pairs better than control"] = [
        DASH if np.isnan(value) else f"{value:.0f} %" for value in better
    ]
    return Table(
        name=f"gains_{dataset}",
        title=f"What does the prior add over longer training? {display_name(dataset)}",
        caption=f"{_origin_sentence(dataset, metrics, False)} Reduction of the mean "
        "Chamfer distance in percent on the pairs that all methods share; negative values are "
        "losses. The control differs from the prior only in λ = 0. The interval is that of the "
        "reduction over the control: of the test pairs, drawn by deformation where the object is "
        "known and by object otherwise. Undecided: it holds zero." + training_chance(spread),
        **laid_out(columns),
        data=data.rename(
            columns={name: f"{name}_1e-4" for name in data if name.endswith("mean")}
            | {
                name: f"{name}_percent"
                for name in data
                if "gain" in name or name.startswith("pairs_") or name in ("low", "high")
            }
        ),
    )


def all_tables(metrics: pd.DataFrame, spread: Spread = 0.0) -> list[Table]:
    """Every table that the metrics have rows for: the paper's first, then the supplementary.

    ``spread`` is how much differences vary with the training; see ``statistics.comparisons``.
    """
    tables, comparisons, supplementary = [], [], []
    for dataset in sorted(metrics["dataset"].unique(), key=lambda name: rank(name, names.DATASETS)):
        rows = metrics[metrics["dataset"] == dataset]
        corrupted = rows["condition"].isin(CORRUPTIONS)
        if (rows["condition"] == CLEAN).any():
            tables.append(mean_table("deformation", dataset, rows, spread))
        if corrupted.any():
            tables.append(mean_table("corruption", dataset, rows, spread))
            supplementary.append(mean_table("observed", dataset, rows, spread))
        if rows["mce"].notna().any():
            supplementary.append(mean_table("correspondence", dataset, rows, spread))
        if not set(rows["method"]) <= set(BASELINES):
            gain = gain_table(dataset, rows, spread)
            comparisons += [gain] if gain.rows else []
    tables.sort(key=lambda table: (not table.name.startswith("table"), table.name))
    return tables + comparisons + supplementary


# ---------------------------------------------------------------------------------- words


def _origin_sentence(dataset: str, metrics: pd.DataFrame, with_paper: bool) -> str:
    origin = origin_of(dataset, metrics)
    known = trained_on(dataset)
    name = display_name(known)
    if origin is None:
        return f"This run has no results on {name}; only the published values are shown."
    rows = metrics[metrics["dataset"] == dataset]
    objects = " and ".join(names.OBJECTS[kind] for kind in sorted(set(rows["objects"])))
    if known not in names.DATASETS or origin not in ("synthetic", "bases"):
        return f"DINE on {name} ({names.ORIGINS[origin]}), {objects}."
    text = f"DINE on {names.ORIGINS[origin]} in the layout of {name}, {objects}"
    if with_paper:
        text += (
            f"; published values are on the real {name} data and are not comparable in absolute "
            "terms"
        )
    return f"{text}."


def _layout(data: pd.DataFrame, decimals: int, with_paper: bool) -> dict[str, tuple]:
    """Header and display rows: settings down, methods by backbone across, ours above published."""
    series = in_order(data[_SERIES].drop_duplicates(), _SERIES)
    bare = series["method"] == "unregistered"
    series = pd.concat([series[bare], series[~bare]])
    labels = ["Setting", "Level"] if (data["condition"] != CLEAN).any() else ["Level"]
    header = [("", label) for label in [*labels, *(["Values"] if with_paper else []), "Pairs"]]
    header += [tuple(map(display_name, key)) for key in series.itertuples(index=False)]
    rows = []
    for _, values in data.groupby(_SETTING, dropna=False, sort=False):
        label = _setting_label(values.iloc[0])[-len(labels) :]
        found = series.merge(values, on=_SERIES, how="left").to_dict("records")
        means = [
            Cell(mean_and_deviation(x["mean"], x["std"], decimals), x["verdict"] == "lower")
            for x in found
        ]
        head = [*label, *(["this run"] if with_paper else []), _count(values)]
        rows.append((*map(Cell, head), *means))
        if with_paper:
            # The paper prints its Table 3 with one decimal.
            digits = 1 if "Setting" in labels else 2
            head = [*("" for _ in labels), "paper", DASH]
            head += [
                mean_and_deviation(x["published_mean"], x["published_std"], digits) for x in found
            ]
            rows.append(tuple(map(Cell, head)))
    return {"header": tuple(header), "rows": tuple(rows)}


def _setting_label(row: Mapping[str, Any]) -> tuple[str, str]:
    condition, corruption, level = (row[name] for name in _SETTING)
    if condition == "outliers":
        return "Outliers", f"{corruption:g} %"
    if condition == "noise":
        return "Noise", f"σ = {corruption:g}"
    if condition != CLEAN:
        return names.CONDITIONS.get(condition, condition), DASH
    return "Deformation", "not given" if np.isnan(level) else f"{level:g}"


def _count(values: pd.DataFrame) -> str:
    counts = values.loc[values["n"] > 0, "n"]
    if counts.empty:
        return DASH
    low, high = counts.min(), counts.max()
    return f"{low}" if low == high else f"{low}{DASH}{high}"
