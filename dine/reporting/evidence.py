"""Does a deformation prior help, which one, where and by how much: the report on the evidence.

Every number comes from ``metrics.csv`` files by way of ``dine.evaluation.statistics``; so do the
sentences. A *place* is a dataset with a backbone. Methods without a network are shown at every
place of their datasets.
"""

from __future__ import annotations

import functools
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from dine.config import CONTROL, STAGE1
from dine.errors import DataError
from dine.evaluation import statistics
from dine.evaluation.statistics import NO_BACKBONE
from dine.files import atomic_path, read_json, write_text
from dine.provenance import versions
from dine.reporting import figures as draw
from dine.reporting import html, tables
from dine.reporting.tables import CD_SCALE, Cell, Table, display_name
from dine.results import CLEAN

GROUPS = {
    "none": "Unregistered",
    "classical": "Classical",
    "network": "Network",
    "control": "Control",
    "prior": "Trained with a prior",
    "data term": "Other data term",
    "test time": "Refined at test time",
    "other": "Other",
}
"""Heading by group of methods, in the order of the tables."""
PAPER_PRIOR = "pca"
LARGE = 0.4
"""Deformation level from which on deformations count as large."""
SIGNIFICANT = 0.05
FEW_OBJECTS = 20
"""Below this many objects bootstrap intervals are clearly too narrow, see docs/metrics.md."""

_KEYS = ["dataset", "backbone", "method", "seed", "condition", "corruption", "pair"]
_TEXT = ("dataset", "backbone", "method", "origin", "pair", "object", "condition")
_NUMBERS = ("seed", "level", "corruption", *statistics.SUMMARISED, "roughness_true")
# Numbers that evaluate may leave out: unknown level or correspondences, time that was not measured.
_MAY_LACK = {"level", "seconds", "mce", "accuracy_2_5", "accuracy_5", "far_points"}
_DECIMALS = 6  # levels and corruptions that passed through float32 must still meet
_DASH = "–"
_LOWER, _HIGHER, _PARTIAL = "▼", "▲", "†"
_MARKS = {"lower": f" {_LOWER}", "higher": f" {_HIGHER}", "none": ""}

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

WORDS = {
    "Mean correspondence error (MCE)": "Distance between where a point was put and where it "
    "really went, averaged over the points. The source fits into a sphere of radius 1, so 0.05 is "
    "2.5 % of its diameter. This is what matters for finding a structure again.",
    "Chamfer distance (CD)": "How well the two surfaces lie on each other (squared, shown in units "
    "of 10⁻⁴). It does not see points that slid along the surface to a wrong place.",
    "Level": f"Strength of the deformation. From {LARGE:g} on it counts as large here.",
    "λ": "How much the prior counts in training. With λ = 0 it does not count at all: what is then "
    "gained is gained by longer training alone.",
    "Failure": "A pair whose points are off by more than 5 % of the diameter on average.",
    "Roughness, folding": "How much neighbouring points move apart, and the share of places that "
    "are turned inside out. Tissue does not tear or fold: a roughness near that of the true field "
    "is plausible, a larger one means noise or tears, a smaller one stiffness.",
    f"{_LOWER} and {_HIGHER}": "Significantly lower or higher than the reference on the same "
    "pairs: p < 0.05 in Wilcoxon's signed-rank test, corrected by Holm over the levels. "
    f"{_LOWER} is better.",
    "Interval": "95 % interval of the mean difference, found by drawing whole objects anew.",
    "Effect, wins": "Rank-biserial correlation, −1 where the method is lower on every pair and 1 "
    "where it is higher; and the share of the pairs on which it is lower.",
    _PARTIAL: "Evaluated on some of the pairs only; compared with the reference on these.",
}


# -------------------------------------------------------------------------------------- input


@dataclass(frozen=True)
class Method:
    """A method as the report shows it."""

    name: str
    title: str
    group: str
    description: str

    @property
    def kind(self) -> str:
        return GROUPS[self.group]


@dataclass(frozen=True)
class Picture:
    """A drawn PNG to show among the examples; the dataset says where its data come from."""

    dataset: str
    png: Path
    caption: str


@dataclass(frozen=True)
class Finding:
    """A sentence and, beneath it, what it sums up."""

    text: str
    parts: tuple[str, ...] = ()


def load_evidence(paths: Iterable[Path]) -> pd.DataFrame:
    """Read ``metrics.csv`` files of any datasets, backbones, methods and seeds into one frame.

    Raises:
        DataError: a file is missing, lacks a column or holds values that cannot be used, the same
            evaluation stands in two rows, or a dataset mixes origins.
    """
    frames = [_load_one(Path(path)) for path in paths]
    if not frames:
        raise DataError("No metrics files were given; evaluate a model first.")
    metrics = pd.concat(frames, ignore_index=True)
    repeated = metrics[metrics.duplicated(_KEYS)]
    if len(repeated):
        what = ", ".join(f"{name} {value}" for name, value in repeated.iloc[0][_KEYS].items())
        raise DataError(f"The metrics files hold the same evaluation twice ({what}).")
    for dataset, found in metrics.groupby("dataset")["origin"].unique().items():
        if len(found) > 1:
            raise DataError(
                f"The metrics files of {dataset} mix data of different origins "
                f"({', '.join(sorted(found))}); their numbers cannot stand in one table."
            )
    return metrics


def _load_one(path: Path) -> pd.DataFrame:
    try:
        # As text first: a pair may be called "NA" or "007".
        frame = pd.read_csv(path, dtype=str, keep_default_na=False)
    except FileNotFoundError as error:
        raise DataError(f"{path} does not exist.") from error
    except (OSError, ValueError) as error:
        raise DataError(f"{path} is not a readable CSV file ({error}).") from error
    missing = [name for name in (*_TEXT, *_NUMBERS) if name not in frame]
    if missing:
        raise DataError(f"{path} lacks the column(s) {', '.join(missing)}; evaluate again.")
    if frame.empty:
        raise DataError(f"{path} holds no rows.")
    frame = frame[[*_TEXT, *_NUMBERS]]
    for name in _TEXT:
        if (frame[name] == "").any():
            raise DataError(f"{path}: column {name} is empty in some rows.")
    for name in _NUMBERS:
        try:
            numbers = pd.to_numeric(frame[name]).astype(float)
        except (TypeError, ValueError) as error:
            raise DataError(f"{path}: column {name} is not numeric ({error}).") from error
        bad = np.isinf(numbers) | (numbers.isna() if name not in _MAY_LACK else False)
        if bad.any():
            raise DataError(
                f"{path}: column {name} holds {frame.loc[bad, name].iloc[0] or 'nothing'} in data "
                f"row {int(np.argmax(bad)) + 1}; it must be a finite number."
            )
        frame[name] = numbers.round(_DECIMALS) if name in ("level", "corruption") else numbers
    for name, allowed in (
        ("condition", tables.CONDITION_NAMES),
        ("origin", tables.ORIGIN_NAMES),
    ):
        unknown = frame.loc[~frame[name].isin(list(allowed)), name]
        if len(unknown):
            raise DataError(
                f"{path}: unknown {name} {unknown.iloc[0]!r}; expected one of {', '.join(allowed)}."
            )
    return frame.astype({"seed": int})


def _known_methods(
    metrics: pd.DataFrame, described: Mapping[str, Mapping[str, Any]]
) -> dict[str, Method]:
    """The methods of the metrics in the order of the tables."""
    present = list(metrics["method"].unique())
    found = []
    for name in [
        *(n for n in described if n in present),
        *(n for n in present if n not in described),
    ]:
        entry = described.get(name, {})
        group = str(entry.get("group", "other"))
        if group not in GROUPS:
            raise DataError(
                f"The method {name} has the unknown group {group!r}; expected one of "
                f"{', '.join(GROUPS)}."
            )
        title, text = str(entry.get("title") or name), str(entry.get("description") or "")
        found.append(Method(name, title, group, text))
    order = list(GROUPS)
    return {m.name: m for m in sorted(found, key=lambda m: order.index(m.group))}


# --------------------------------------------------------------------------------- statistics


class Evidence:
    """The statistics behind the report, each computed once and only when it is asked for.

    Args:
        metrics: as ``load_evidence`` returns them.
        methods: title, group and description by method; see ``build_evidence``.
        reference: what all methods are compared with.

    Raises:
        DataError: the reference is missing, nothing can be compared with it, or a group is unknown.
    """

    def __init__(
        self,
        metrics: pd.DataFrame,
        methods: Mapping[str, Mapping[str, Any]],
        reference: str = CONTROL,
    ):
        self.metrics = metrics
        self.methods = _known_methods(metrics, methods)
        self.reference = reference
        self.clean = metrics[metrics["condition"] == CLEAN]
        if not (self.clean["method"] == reference).any():
            raise DataError(
                f"The metrics hold no clean targets of the reference {reference!r}; they have "
                f"{', '.join(self.methods)}."
            )
        self.large_rows = self.clean[self.clean["level"] >= LARGE]
        self.places = self._places()
        if self.comparisons.empty:
            raise DataError(f"The metrics hold no method to compare with {reference!r}.")

    def _places(self) -> list[tuple[str, str]]:
        found = {
            (dataset, backbone)
            for dataset, rows in self.metrics.groupby("dataset")
            for backbone in set(rows["backbone"]) - {NO_BACKBONE} or {NO_BACKBONE}
        }
        return sorted(
            found,
            key=lambda place: (
                tables.rank(place[0], tables.DATASET_NAMES),
                tables.rank(place[1], tables.BACKBONE_NAMES),
            ),
        )

    @property
    def datasets(self) -> list[str]:
        return list(dict.fromkeys(dataset for dataset, _ in self.places))

    def title(self, method: str) -> str:
        return self.methods[method].title

    def titles(self, methods: Iterable[str]) -> str:
        return join([self.title(name) for name in methods])

    def origin(self, dataset: str) -> str | None:
        return tables.origin_of(dataset, self.metrics)

    def where(self, dataset: str, backbone: str | None = None) -> str:
        """A place as captions name it; data that were made are always said to be."""
        origin = self.origin(dataset)
        text = f"{display_name(dataset)} ({tables.ORIGIN_NAMES[origin]})"
        return text if backbone in (None, NO_BACKBONE) else f"{text}, {display_name(backbone)}"

    def of_group(self, *groups: str) -> list[str]:
        return [m.name for m in self.methods.values() if m.group in groups]

    @functools.cached_property
    def classical(self) -> list[str]:
        """Methods without a network that do register."""
        with_network = set(self.metrics.loc[self.metrics["backbone"] != NO_BACKBONE, "method"])
        return [
            m.name
            for m in self.methods.values()
            if m.group == "classical"
            or (m.name not in with_network and m.group != "none" and m.name != "unregistered")
        ]

    @property
    def rivals(self) -> list[str]:
        """What is compared with the reference: all that registers."""
        out = {self.reference, "unregistered", *self.of_group("none")}
        return [name for name in self.methods if name not in out]

    @property
    def candidates(self) -> list[str]:
        """The rivals with a network."""
        return [name for name in self.rivals if name not in self.classical]

    # ---- compared with the reference

    @functools.cached_property
    def comparisons(self) -> pd.DataFrame:
        """``compare`` of every method with the reference, with a ``verdict``."""
        return self._compare_all(self.metrics)

    @functools.cached_property
    def large(self) -> pd.DataFrame:
        """The same for clean targets of all large levels together."""
        found = self._compare_all(self.large_rows)
        return self.comparisons.iloc[:0] if found.empty else found[found["level"].isna()]

    def _compare_all(self, metrics: pd.DataFrame) -> pd.DataFrame:
        found = [self._compare(metrics, name) for name in self.methods if name != self.reference]
        found = [table for table in found if table is not None]
        if not found:
            return pd.DataFrame()
        table = pd.concat(found, ignore_index=True)
        sure = table["p_holm"] < SIGNIFICANT
        verdict = np.where(table["difference"] < 0, "lower", "higher")
        return table.assign(verdict=np.where(sure & (table["difference"] != 0), verdict, "none"))

    def _compare(self, metrics: pd.DataFrame, method: str) -> pd.DataFrame | None:
        """On the pairs that both were evaluated on, since slow methods may have seen fewer."""
        ours, theirs = (metrics[metrics["method"] == x] for x in (method, self.reference))
        if not set(self._places_of(ours)) & set(self._places_of(theirs)):
            return None
        keys = ["dataset", "condition", "corruption", "pair"]
        shared = ours[keys].drop_duplicates().merge(theirs[keys].drop_duplicates())
        if shared.empty:
            return None
        rows = pd.concat([ours.merge(shared), theirs.merge(shared)])
        return statistics.compare(rows, method, self.reference)

    def _places_of(self, rows: pd.DataFrame) -> list[tuple[str, str]]:
        known = set(zip(rows["dataset"], rows["backbone"], strict=True))
        return [p for p in self.places if p in known or (p[0], NO_BACKBONE) in known]

    @functools.cached_property
    def cells(self) -> pd.DataFrame:
        """``comparisons`` on clean targets, one row per place, method, level and value."""
        table = self.comparisons
        return table[(table["condition"] == CLEAN) & table["level"].notna()]

    def overall(self, place: tuple[str, str]) -> pd.DataFrame:
        """``comparisons`` on clean targets of all levels together at a place."""
        table = at(self.comparisons, place)
        return table[(table["condition"] == CLEAN) & table["level"].isna()]

    @functools.cached_property
    def goal(self) -> pd.DataFrame:
        """How many large levels each rival improves, by place.

        ``levels``: large levels of the reference there; ``both``: of these, with a significantly
        lower mean of both values; ``both_lower``: the same without a test; ``mce``, ``cd``: with a
        significantly lower one of these; ``worse``: with a significantly higher one of any.
        """
        records = []
        large = self.cells[self.cells["level"] >= LARGE]
        for place in self.places:
            here = at(self.large_rows, place)
            levels = here.loc[here["method"] == self.reference, "level"].nunique()
            for method in self.rivals:
                some = at(large, place)
                some = some[some["method"] == method]
                if some.empty:
                    continue
                lower = some.assign(is_=some["difference"] < 0).pivot(
                    index="level", columns="value", values="is_"
                )
                verdict = some.pivot(index="level", columns="value", values="verdict")
                verdict = verdict.reindex(columns=["mce", "cd"])
                records.append(
                    {
                        **dict(zip(("dataset", "backbone"), place, strict=True)),
                        "method": method,
                        "levels": levels,
                        "both": int((verdict == "lower").all(axis=1).sum()),
                        "both_lower": int(
                            lower.reindex(columns=["mce", "cd"]).eq(True).all(axis=1).sum()
                        ),
                        **{v: int((verdict[v] == "lower").sum()) for v in ("mce", "cd")},
                        "worse": int((verdict == "higher").any(axis=1).sum()),
                    }
                )
        columns = [*("dataset", "backbone", "method", "levels", "both", "both_lower"), "mce", "cd"]
        return pd.DataFrame(records, columns=[*columns, "worse"])

    # ---- means

    @functools.cached_property
    def by_level(self) -> pd.DataFrame:
        return self._summary(self.clean, False)

    @functools.cached_property
    def pooled(self) -> pd.DataFrame:
        return self._summary(self.clean, True)

    @functools.cached_property
    def large_means(self) -> pd.DataFrame:
        return self._summary(self.large_rows, True)

    def _summary(self, rows: pd.DataFrame, pool: bool) -> pd.DataFrame:
        """``summary`` at every place, with ``partial``: evaluated on fewer pairs than others."""
        table = self.at_places(statistics.summary(rows, pool_levels=pool))
        most = table.groupby(["dataset", "backbone", "level"], dropna=False)["pairs"]
        return table.assign(partial=table["pairs"] < most.transform("max"))

    def at_places(self, table: pd.DataFrame) -> pd.DataFrame:
        """Rows of methods without a network, repeated for every backbone of their dataset."""
        found = []
        for place in self.places:
            own = at(table, place)
            bare = at(table, (place[0], NO_BACKBONE))
            bare = bare[~bare["method"].isin(own["method"])].assign(backbone=place[1])
            found.append(own if place[1] == NO_BACKBONE else pd.concat([own, bare]))
        return pd.concat(found, ignore_index=True)

    def ranking(
        self, methods: Sequence[str], value: str, places: Sequence[tuple[str, str]] | None = None
    ) -> pd.Series:
        """Mean over places of the mean at large levels, lowest first, of methods seen at all."""
        places = self.places if places is None else places
        some = self.large_means
        some = some[some["method"].isin(list(methods)) & ~some["partial"]]
        wide = some.pivot(index="method", columns=["dataset", "backbone"], values=f"{value}_mean")
        return wide.reindex(columns=list(places)).dropna().mean(axis=1).sort_values()

    @functools.cached_property
    def roughness_true(self) -> pd.Series:
        """Mean roughness of the true fields by dataset."""
        pairs = self.clean.drop_duplicates(["dataset", "pair"])
        return pairs.groupby("dataset")["roughness_true"].mean()

    @functools.cached_property
    def corrupted(self) -> pd.DataFrame:
        """Means under each corruption, and on clean targets of the same pairs."""
        keys = ["dataset", "backbone", "method", "seed", "pair"]
        values = ["mce", "cd"]
        rows = self.metrics[self.metrics["condition"] != CLEAN]
        both = rows.merge(self.clean[[*keys, *values]], on=keys, suffixes=("", "_clean"))
        group = both.groupby(["dataset", "backbone", "method", "condition", "corruption"])
        means = group[[*values, *(f"{v}_clean" for v in values)]].mean()
        means["pairs"] = group["pair"].nunique()
        means["levels"] = group["level"].agg(lambda x: " ".join(f"{v:g}" for v in np.unique(x)))
        means = means.reset_index()
        for value in values:
            means[f"{value}_change_percent"] = 100 * (means[value] / means[f"{value}_clean"] - 1)
        return self.at_places(means)


def at(table: pd.DataFrame, place: tuple[str, str]) -> pd.DataFrame:
    """Rows of one place."""
    return table[(table["dataset"] == place[0]) & (table["backbone"] == place[1])]


def join(names: Sequence[str]) -> str:
    """``a, b and c``."""
    return " and ".join([", ".join(names[:-1]), names[-1]] if len(names) > 1 else names)


# ----------------------------------------------------------------------------------- findings

_VALUES = {
    "mce": ("mean correspondence error", "MCE", 1.0, 4),
    "cd": ("Chamfer distance", "CD", CD_SCALE, 2),
}


def findings(evidence: Evidence) -> list[Finding]:
    """What the numbers say, in sentences."""
    found = [
        _paper_prior(evidence),
        _best(evidence, evidence.of_group("prior"), "Of the methods trained with a prior"),
        _best(evidence, [evidence.reference, *evidence.rivals], "Of all methods"),
        *_goal(evidence),
        _no_help(evidence),
        _basis(evidence),
        _limits(evidence),
    ]
    return [finding for finding in found if finding is not None]


def _paper_prior(evidence: Evidence) -> Finding | None:
    if evidence.reference == PAPER_PRIOR:
        return None
    cells = evidence.cells[evidence.cells["method"] == PAPER_PRIOR]
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
            for value, (_, name, _, _) in _VALUES.items()
            if (here["value"] == value).any()
        ]
        if counts:
            parts.append(f"{evidence.where(*place)}: {'; '.join(counts)}.")
    reference = evidence.title(evidence.reference)
    return Finding(
        f"The paper's prior, {evidence.title(PAPER_PRIOR)}, {answer.format(reference)}. Of "
        f"{len(cells)} comparisons (each level, by MCE and by CD) {lower} "
        f"{_are(lower)} significantly lower and {higher} significantly higher; the others may be "
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


def _are(count: int) -> str:
    return "is" if count == 1 else "are"


def _best(evidence: Evidence, methods: Sequence[str], who: str) -> Finding | None:
    methods = [name for name in methods if name in evidence.methods]
    if len(methods) < 2:
        return None
    if evidence.large_rows.empty:
        return Finding(f"{who}: no pair has a level of at least {LARGE:g}.")
    winners: dict[str, list[str]] = {}
    for value, (long, _, scale, decimals) in _VALUES.items():
        order = evidence.ranking(methods, value)
        if order.empty:
            continue
        unit = " ×10⁻⁴" if scale != 1 else ""
        reference = evidence.ranking([evidence.reference], value)
        beside = ""
        if len(reference) and order.index[0] != evidence.reference:
            change = 100 * (order.iloc[0] / reference.iloc[0] - 1)
            beside = f", {_signed(change, 1)} % against {evidence.title(evidence.reference)}"
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
        for value, (_, name, _, _) in _VALUES.items():
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
        text += (
            f" {'Of the networks, closest' if reached else 'Closest'} is "
            f"{evidence.title(closest)}: {row['both']} of {needed} cells hold; both means are "
            f"lower, significantly or not, in {row['both_lower']}, and in {row['worse']} at least "
            "one is significantly higher."
        )
        shown = [closest]
    return [Finding(text), *_against_classical(evidence, shown)]


def _against_classical(evidence: Evidence, methods: Sequence[str]) -> list[Finding]:
    if not methods:
        return []
    means = evidence.by_level
    classical = means[means["method"].isin(evidence.classical)]
    if classical.empty:
        return [
            Finding(
                "No classical method (one without a network) was evaluated, so how "
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
        for value, (_, name, _, _) in _VALUES.items():
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
        who = f"{evidence.titles(below)} {_are(len(below))}"
    text = (
        f"Against the best classical method of each level ({evidence.titles(rivals)}): {who} "
        "lower by both measures at every level, on every dataset and with every backbone."
    )
    if left_out:
        text += f" {evidence.titles(left_out)}: left out where evaluated on some pairs only."
    return [Finding(text, tuple(parts))]


def _no_help(evidence: Evidence) -> Finding:
    verdict = evidence.cells.groupby("method")["verdict"].agg(set)
    treated = [
        n for n in evidence.candidates if evidence.methods[n].group != "network" and n in verdict
    ]
    worse = [n for n in treated if "higher" in verdict[n] and "lower" not in verdict[n]]
    nothing = [n for n in treated if verdict[n] == {"none"}]
    text = "What did not help: "
    reference = evidence.title(evidence.reference)
    if worse:
        text += (
            f"{evidence.titles(worse)} {_are(len(worse))} significantly worse than {reference} at "
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
            f"{_count(rows['object'].nunique(), 'object')} at {_count(len(levels), 'level')}"
        )
        if len(seeds):
            low, high = seeds.min(), seeds.max()
            text += f", {_count(high, 'training seed')} of each network"
            text += f" ({low} of some)" if low < high else ""
        parts.append(f"{text}.")
    made = [d for d in evidence.datasets if evidence.origin(d) == "synthetic"]
    note = "All data are synthetic." if len(made) == len(evidence.datasets) else ""
    if made and not note:
        note = f"The data of {join([display_name(d) for d in made])} are synthetic."
    text = "What this rests on: the same test pairs for all methods, averaged over seeds."
    return Finding(f"{text} {note}".strip(), tuple(parts))


def _count(count: int, noun: str) -> str:
    return f"{count} {noun}{'' if count == 1 else 's'}"


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
        f"one comparison, not over the {_count(len(evidence.rivals), 'method')} compared."
    )
    return Finding("What cannot be concluded:", tuple(parts))


# ------------------------------------------------------------------------------------- tables


def _slug(*names: str) -> str:
    """A name for a file from names that may hold anything."""
    return "_".join(re.sub(r"[^A-Za-z0-9_.-]+", "-", name).strip("-.") or "x" for name in names)


def _minus(text: str) -> str:
    return text.replace("-", "−")


def _number(value: float, decimals: int, scale: float = 1.0) -> str:
    # Adding 0 makes −0 a 0.
    return _DASH if pd.isna(value) else _minus(f"{round(scale * value, decimals) + 0:.{decimals}f}")


def _signed(value: float, decimals: int) -> str:
    return _DASH if pd.isna(value) else _minus(f"{round(value, decimals) + 0:+.{decimals}f}")


def _percent(share: float) -> str:
    return _number(share, 1, 100)


def _p(value: float) -> str:
    if pd.isna(value):
        return _DASH
    return "< 0.001" if value < 0.001 else f"{value:.3f}"


def _verdicts(comparisons: pd.DataFrame, value: str, *keys: str) -> dict[tuple, str]:
    """The mark of each method and setting; those of all levels have no level."""
    found = {}
    for row in comparisons[comparisons["value"] == value].to_dict("records"):
        setting = ("all" if pd.isna(row[key]) else row[key] for key in keys)
        found[row["method"], *setting] = _MARKS[row["verdict"]]
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


_NAMES = (("", "Kind"), ("", "Method"))


def level_table(evidence: Evidence, place: tuple[str, str], value: str) -> Table:
    """Means of a value by method and deformation level at a place."""
    long, name, scale, decimals = _VALUES[value]
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
    extras = value == "mce"
    rows, kinds = [], _Kinds(evidence)
    for method in evidence.methods:
        mine = shown[shown["method"] == method].set_index("level")
        if mine.empty:
            continue
        cells = kinds.cells(method)
        for level in settings:
            if level not in mine.index or pd.isna(mine.loc[level, column]):
                cells.append(Cell(_DASH))
                continue
            number = round(scale * mine.loc[level, column], decimals)
            partial = bool(mine.loc[level, "partial"])
            text = f"{number:.{decimals}f}{_PARTIAL if partial else ''}"
            best = not partial and method in set(can_win["method"]) and number == lowest[level]
            cells.append(Cell(text + marks.get((method, level), ""), best))
        if extras:
            all_ = mine.loc["all"]
            cells += [
                Cell(_percent(all_["failure_rate"])),
                Cell(_percent(all_["folding_mean"])),
                Cell(_number(all_["roughness_mean"], 3)),
                Cell(_DASH if pd.isna(all_["seconds_mean"]) else f"{all_['seconds_mean']:.3g}"),
            ]
        rows.append(tuple(cells))
    header = [*_NAMES, *(("Level", f"{level:g}") for level in levels), ("All levels", name)]
    if extras:
        pooled = ("Failures (%)", "Folding (%)", "Roughness", "Seconds a pair")
        header += [("All levels", label) for label in pooled]
    unit = " in units of 10⁻⁴" if scale != 1 else ""
    caption = (
        f"{evidence.where(*place)}, clean targets. {long[0].upper()}{long[1:]}{unit}, mean over "
        f"test pairs and seeds; lower is better. Bold: lowest of the methods that register. "
        f"{_LOWER} significantly lower, {_HIGHER} significantly higher than "
        f"{evidence.title(evidence.reference)} (p < 0.05 after Holm)."
    )
    if extras:
        true = evidence.roughness_true[place[0]]
        caption += f" The true fields have a roughness of {true:.3f}."
    if data["partial"].any():
        caption += f" {_PARTIAL} evaluated on some of the pairs only."
    return Table(
        name=f"{value}_{_slug(*place)}",
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
                cells.append(Cell(str(here[name].iloc[0]) if len(here) else _DASH))
        rows.append(tuple(cells))
    header = [*_NAMES, ("", "Goal cells")]
    for place in places:
        levels = at(goal, place)["levels"].max()
        group = ", ".join(display_name(x) for x in place if x != NO_BACKBONE)
        group += f": of {_count(levels, 'level')}"
        header += [(group, label) for label in (f"MCE {_LOWER}", f"CD {_LOWER}")]
        header += [(group, f"both {_LOWER}"), (group, f"any {_HIGHER}")]
    return Table(
        name="goal",
        title=f"At how many levels from {LARGE:g} on is each method significantly better?",
        caption=f"{join([evidence.where(d) for d in evidence.datasets])}, clean targets. Number of "
        f"levels with a significantly lower ({_LOWER}) mean than "
        f"{evidence.title(evidence.reference)} by MCE, by CD and by both, and with a significantly "
        f"higher ({_HIGHER}) one by any. Goal cells: both, at all places together; the goal is all "
        f"{needed}.",
        header=tuple(header),
        rows=tuple(rows),
        data=goal,
    )


def answer_table(
    evidence: Evidence, place: tuple[str, str], value: str, *, by_level: bool = False
) -> Table | None:
    """Every method against the reference at a place: all levels together, or each."""
    long, name, scale, decimals = _VALUES[value]
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
                    Cell(_percent(row["failures_method"])),
                    Cell(_percent(row["failures_reference"])),
                    Cell(_p(row["p_failures"])),
                ]
            rows.append(tuple(cells))
    unit = " ×10⁻⁴" if scale != 1 else ""
    group = f"{long[0].upper()}{long[1:]}{unit}"
    labels = ("Mean", "Reference", "Difference [95 % interval]", "%", "p", "Effect", "Wins (%)")
    header = [*_NAMES, *([("", "Level")] if by_level else []), ("", "Pairs")]
    header += [(group, label) for label in labels]
    if failures:
        header += [("Failures", label) for label in ("%", "Reference %", "p")]
    which = "each level" if by_level else "all levels together"
    caption = (
        f"{evidence.where(*place)}, clean targets, {which}. {long[0].upper()}{long[1:]}{unit}. "
        "Difference: method minus reference, so negative is better; interval: bootstrap over "
        "objects; %: of the reference's mean; p: Wilcoxon"
        + (", after Holm over the levels" if by_level else "")
        + "; effect: rank-biserial, −1 to 1; wins: pairs on which the method is lower."
    )
    if failures:
        caption += " Failures: pairs with an MCE above 0.1, p by McNemar's test."
    return Table(
        name=f"{'levels' if by_level else 'answer'}_{value}_{_slug(*place)}",
        title=f"{name} against {evidence.title(evidence.reference)}, {which}: "
        f"{evidence.where(*place)}",
        caption=caption,
        header=tuple(header),
        rows=tuple(rows),
        data=data,
    )


def _compared(row: Mapping[str, Any], scale: float, decimals: int) -> list[Cell]:
    low, high = (_number(row[name], decimals, scale) for name in ("ci_low", "ci_high"))
    interval = "" if pd.isna(row["ci_low"]) else f" [{low}, {high}]"
    mark = _MARKS[row["verdict"]]
    return [
        Cell(_number(row["mean_method"], decimals, scale)),
        Cell(_number(row["mean_reference"], decimals, scale)),
        Cell(_number(row["difference"], decimals, scale) + interval),
        Cell(_signed(row["relative"], 1) + mark, bool(mark)),
        Cell(_p(row["p_holm"])),
        Cell(_signed(row["effect"], 2)),
        Cell(_number(row["win_rate"], 0, 100)),
    ]


def corruption_table(evidence: Evidence, place: tuple[str, str], value: str) -> Table | None:
    """Means under noise, outliers and on resampled targets, and the change from clean ones."""
    data = at(evidence.corrupted, place)
    if data.empty:
        return None
    long, name, scale, decimals = _VALUES[value]
    order = {"deformation": 0, "noise": 1, "outliers": 2, "resampled": 3}
    settings = sorted(
        set(zip(data["condition"], data["corruption"], strict=True)),
        key=lambda setting: (order[setting[0]], setting[1]),
    )
    here = at(evidence.comparisons, place)
    corrupted = here[(here["condition"] != CLEAN) & here["level"].isna()]
    marks = _verdicts(corrupted, value, "condition", "corruption")
    lowest = {}
    able = data[data["method"].isin([evidence.reference, *evidence.rivals])]
    for key, some in able.groupby(["condition", "corruption"]):
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
                cells += [Cell(_DASH)] * 2
                continue
            row = mine.loc[setting]
            number = round(scale * row[value], decimals)
            bold = number == lowest.get(setting) and method in set(able["method"])
            text = f"{number:.{decimals}f}{marks.get((method, *setting), '')}"
            cells += [Cell(text, bold), Cell(_signed(row[f"{value}_change_percent"], 0))]
        rows.append(tuple(cells))
    header = list(_NAMES)
    for setting in settings:
        levels = data.loc[
            (data["condition"] == setting[0]) & (data["corruption"] == setting[1]), "levels"
        ].iloc[0]
        group = f"{_setting(*setting)} (level {levels.replace(' ', ', ')})"
        header += [(group, name), (group, "% to clean")]
    unit = " in units of 10⁻⁴" if scale != 1 else ""
    return Table(
        name=f"corrupted_{value}_{_slug(*place)}",
        title=f"{name} with imperfect targets: {evidence.where(*place)}",
        caption=f"{evidence.where(*place)}. {long[0].upper()}{long[1:]}{unit} to the clean target, "
        "mean over test pairs and seeds, and its change from the same pairs with clean targets. "
        f"{_LOWER} and {_HIGHER}: significantly lower and higher than "
        f"{evidence.title(evidence.reference)} under the same corruption, all these levels "
        "together. Bold: lowest of the methods that register.",
        header=tuple(header),
        rows=tuple(rows),
        data=data,
    )


def _setting(condition: str, corruption: float) -> str:
    if condition == "noise":
        return f"Noise σ = {corruption:g}"
    if condition == "outliers":
        return f"{corruption:g} % outliers"
    return tables.CONDITION_NAMES[condition]


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
            for value, (_, _, scale, decimals) in _VALUES.items():
                seeds, pairs = row[f"{value}_seed_sd"], row[f"{value}_sd"]
                cells += [
                    _number(row[f"{value}_mean"], decimals, scale),
                    _number(seeds, decimals, scale),
                    _number(pairs, decimals, scale),
                    _number(compared.get((method, value), np.nan), decimals, scale),
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
        rows.append(tuple(Cell(_diagnosed(evidence, *entry)) for entry in record.items()))
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


def _diagnosed(evidence: Evidence, name: str, value: Any) -> str:
    if name == "prior":
        return evidence.title(value) if value in evidence.methods else display_name(value)
    if isinstance(value, str):
        return display_name(value)
    if value is None or pd.isna(value):
        return _DASH
    return _minus(f"{value:.4g}")


def _places_named(evidence: Evidence, data: pd.DataFrame) -> list[str]:
    return [evidence.where(d) for d in dict.fromkeys(data["dataset"])]


# ------------------------------------------------------------------------------------ figures


def _plain_text(text: str) -> str:
    """Text that a figure shows as it is: dollars would begin a formula."""
    return text.replace("$", r"\$")


def _styles(methods: Iterable[str]) -> dict[str, tuple[str, str]]:
    """Colour and marker by method; the paper's have those of the other figures."""
    methods = list(dict.fromkeys(methods))
    own = draw.method_styles(tables.METHOD_NAMES)
    others = [name for name in methods if name not in own]
    more = {n: _MORE_STYLES[i % len(_MORE_STYLES)] for i, n in enumerate(others)}
    return {name: own.get(name) or more[name] for name in methods}


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
    figure = draw._new(
        10.4,
        1.7 + 0.27 * len(rows),
        f"{_title(place)}: difference to {_plain_text(evidence.title(evidence.reference))}",
        evidence.origin(place[0]),
        f"All levels from {LARGE:g} on. Bars: 95 % bootstrap interval over objects. Filled: "
        "p < 0.05 (Wilcoxon). Triangles: beyond the axis.",
    )
    panels = figure.subplots(1, 2, sharey=True)
    for axes, (value, (long, _, _, _)) in zip(panels, _VALUES.items(), strict=True):
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
                1.02, y, f"{_signed(x, 1)} %", transform=axes.get_yaxis_transform(),
                va="center", fontsize=8, color="#333333",
            )  # fmt: skip
        axes.set_xlim(-reach, reach)
        axes.set_xlabel(f"{long[0].upper()}{long[1:]}: lower ← difference (%) → higher", fontsize=9)
        draw._plain(axes).grid(axis="y", visible=False)
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


def _title(place: Sequence[str]) -> str:
    return _plain_text(", ".join(display_name(x) for x in place if x != NO_BACKBONE))


def main_methods(evidence: Evidence, dataset: str) -> list[str]:
    """Few enough to tell their lines apart: the paper's, and the best of each other group."""
    places = [place for place in evidence.places if place[0] == dataset]

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
    figure = draw._new(
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
            draw._plain(axes)
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
    figure = draw._new(
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
            draw._plain(axes)
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
    values = [name for name in _VALUES if curve[name].notna().any()]
    rough = curve["roughness"].notna().any() and "mce" in values
    chosen_by = join(sorted({str(s.get("criterion", "cd")).upper() for s in searches}))
    count = len(values) + int(rough)
    figure = draw._new(
        4.3 * count + 0.8,
        4.4,
        f"{_title(place)}: weight of the prior",
        origin,
        f"Validation pairs. Star: chosen λ (lowest {chosen_by}). Dashed: λ = 0, longer training "
        "alone.",
    )
    panels = list(figure.subplots(1, count, squeeze=False)[0])
    for axes, value in zip(panels, values, strict=False):
        long, _, scale, _ = _VALUES[value]
        # Every prior has the same control.
        for control in curve.loc[curve["lambda"] == 0, value].dropna().unique():
            axes.axhline(scale * control, color="#555555", linestyle="--", linewidth=1)
        axes.set_xscale("log")
        axes.set_xlabel("Prior weight λ")
        axes.set_ylabel(f"{long[0].upper()}{long[1:]}{' ×10⁻⁴' if scale != 1 else ''}")
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
        places = [("lambda", value, _VALUES[value][2], above) for value in values]
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
        draw._plain(axes)
    if rough:
        panels[-1].legend(fontsize=8, frameon=False)
    figure.legend(
        *panels[0].get_legend_handles_labels(), loc="outside right upper", fontsize=8, frameon=False
    )
    return figure


# ------------------------------------------------------------------------------------- report


@dataclass(frozen=True)
class Drawing:
    """A figure to be saved under a name."""

    name: str
    caption: str
    figure: Figure


@dataclass(frozen=True)
class Folded:
    """What opens on a click."""

    title: str
    parts: tuple[Table, ...]


Item = Table | Drawing | Folded | html.ReportFigure


@dataclass(frozen=True)
class Section:
    name: str
    title: str
    text: tuple[str, ...]
    items: tuple[Item | None, ...]


def sections(
    evidence: Evidence,
    searches: Sequence[Mapping[str, Any]] = (),
    diagnostics: Sequence[tuple[Mapping[str, Any], Path | None]] = (),
    examples: Sequence[Picture] = (),
) -> list[Section]:
    """Everything below the findings, in reading order; what there is nothing of is left out."""
    places = evidence.places
    found = [
        Section(
            "main",
            "Every method at every level",
            ("Rows are methods, columns are levels of deformation.",),
            tuple(level_table(evidence, p, v) for p in places for v in _VALUES),
        ),
        Section("answer", "Better than the reference?", *_answer(evidence)),
        Section(
            "effects",
            "How much better?",
            ("Left of zero is better. An interval that crosses zero allows for no difference.",),
            (
                *(_forest(evidence, place) for place in places),
                *(_over_levels(evidence, dataset) for dataset in evidence.datasets),
            ),
        ),
        Section(
            "corrupted",
            "Noise, outliers and other points",
            (
                "Real scans are noisy and never have the same points twice. Targets were corrupted "
                "or sampled anew; errors are to the true places all the same.",
            ),
            tuple(corruption_table(evidence, p, v) for p in places for v in _VALUES),
        ),
        Section(
            "plausibility",
            "Accuracy against plausibility",
            (
                "A prior is to make fields plausible without making them wrong. Roughness near "
                "that of the true fields and little folding are plausible.",
            ),
            (
                *(_plausibility(evidence, dataset) for dataset in evidence.datasets),
                *_searched(evidence, searches),
            ),
        ),
        Section("seeds", "Seeds", *_seeds(evidence)),
        Section(
            "priors",
            "The priors themselves",
            (),
            (
                diagnostics_table(evidence, [record for record, _ in diagnostics]),
                *(_samples(evidence, record, png) for record, png in diagnostics),
            ),
        ),
        Section(
            "examples",
            "Examples",
            (),
            tuple(
                html.ReportFigure("", f"{evidence.where(x.dataset)}: {x.caption}", x.png)
                for x in examples
            ),
        ),
    ]
    return [section for section in found if any(item is not None for item in section.items)]


def _answer(evidence: Evidence) -> tuple[tuple[str, ...], tuple[Item | None, ...]]:
    reference = evidence.title(evidence.reference)
    text = (
        f"Every method against {reference}, pair by pair. What counts as evidence is a difference "
        "that is significant, of a size that matters, and larger than what another training would "
        "change (see Seeds).",
    )
    folded = Folded(
        "Every level",
        tuple(
            table
            for place in evidence.places
            for value in _VALUES
            if (table := answer_table(evidence, place, value, by_level=True)) is not None
        ),
    )
    goal = None if evidence.goal.empty else goal_table(evidence)
    pooled = [answer_table(evidence, p, value) for p in evidence.places for value in _VALUES]
    return text, (goal, *pooled, folded)


def _forest(evidence: Evidence, place: tuple[str, str]) -> Drawing | None:
    return _drawing(
        f"effects_{_slug(*place)}",
        f"{evidence.where(*place)}: difference of the mean to "
        f"{evidence.title(evidence.reference)} in percent, all levels from {LARGE:g} on.",
        forest_figure(evidence, place),
    )


def _over_levels(evidence: Evidence, dataset: str) -> Drawing | None:
    return _drawing(
        f"levels_{_slug(dataset)}",
        f"{evidence.where(dataset)}: mean correspondence error over levels, of the main methods "
        "and the best of each kind.",
        level_figure(evidence, dataset),
    )


def _plausibility(evidence: Evidence, dataset: str) -> Drawing | None:
    return _drawing(
        f"plausibility_{_slug(dataset)}",
        f"{evidence.where(dataset)}: mean correspondence error against roughness and folding of "
        "the fields, one mark per method.",
        plausibility_figure(evidence, dataset),
    )


def _drawing(name: str, caption: str, figure: Figure | None) -> Drawing | None:
    return None if figure is None else Drawing(name, caption, figure)


def _searched(evidence: Evidence, searches: Sequence[Mapping[str, Any]]) -> list[Drawing]:
    by_place: dict[tuple[str, str], list[Mapping[str, Any]]] = {}
    for search in searches:
        by_place.setdefault((search["dataset"], search["backbone"]), []).append(search)
    found = []
    for place, some in by_place.items():
        origin = evidence.origin(place[0])
        caption = (
            f"{evidence.where(*place)}: errors on validation pairs over the weight λ of each prior."
        )
        figure = search_figure(evidence, place, some, origin)
        found.append(Drawing(f"lambda_{_slug(*place)}", caption, figure))
    return found


def _seeds(evidence: Evidence) -> tuple[tuple[str, ...], tuple[Item | None, ...]]:
    text = (
        "Training again from other random numbers gives another network. The tests above average "
        "over trainings and ask about pairs; this is how much the trainings differ.",
    )
    return text, (seed_table(evidence),)


def _samples(
    evidence: Evidence, record: Mapping[str, Any], png: Path | None
) -> html.ReportFigure | None:
    if png is None:
        return None
    prior = _diagnosed(evidence, "prior", record["prior"])
    where = evidence.where(record["dataset"], record["backbone"])
    return html.ReportFigure("", f"{where}: samples of {prior}.", png)


def build_evidence(
    metrics: Sequence[Path],
    out: Path,
    *,
    methods: Mapping[str, Mapping[str, Any]],
    reference: str = CONTROL,
    searches: Sequence[Path] = (),
    diagnostics: Sequence[Path] = (),
    examples: Sequence[Picture] = (),
    config: Mapping[str, Any] | None = None,
) -> None:
    """Write ``report.html``, ``tables/*.csv``, ``tables/all.md`` and ``figures/*`` (PNG, PDF).

    Args:
        metrics: ``metrics.csv`` files of ``dine evaluate``.
        out: folder to write into.
        methods: by name as in the metrics: ``title``, ``group`` (of ``GROUPS``) and
            ``description``, one sentence. Methods without an entry have their name as title.
        reference: what the methods are compared with.
        searches: results of λ searches: ``dataset``, ``backbone``, ``selected``, ``curve`` and,
            possibly, ``criterion``.
        diagnostics: what ``diagnose`` found, with ``dataset``, ``backbone`` and ``prior``; a PNG of
            the same name beside is shown as the prior's samples.
        examples: further pictures.
        config: the resolved configuration.

    Raises:
        DataError: a file cannot be used, see ``load_evidence``, or is of a dataset that the
            metrics do not have; or methods were evaluated on pairs that do not meet.
    """
    evidence = Evidence(load_evidence(metrics), methods, reference)
    known = set(evidence.datasets)
    found = [_read(path, ("dataset", "backbone", "curve"), known) for path in searches]
    diagnosed = []
    for path in map(Path, diagnostics):
        png = path.with_suffix(".png")
        record = _read(path, ("dataset", "backbone", "prior"), known)
        diagnosed.append((record, png if png.is_file() else None))
    for picture in examples:
        if picture.dataset not in known:
            raise DataError(
                f"{picture.png} is of {picture.dataset}, of which there are no metrics."
            )
    parts = sections(evidence, found, diagnosed, examples)
    write = functools.partial(_shown, out)
    shown = [
        {
            "name": section.name,
            "title": section.title,
            "text": section.text,
            "shown": [write(item) for item in section.items if item is not None],
        }
        for section in parts
    ]
    shown.append({"name": "methods", "title": "Methods", "text": [], "shown": []})
    listed = [x for s in parts for x in s.items if isinstance(x, Table)]
    write_text(out / "tables" / "all.md", "\n\n".join(tables.to_markdown(x) for x in listed))
    _write_csv(evidence.comparisons, out / "tables" / "comparisons.csv")
    html.render(
        out / "report.html",
        "evidence.html",
        reference=evidence.title(reference),
        origins=html.origins(evidence.metrics),
        findings=findings(evidence),
        words=WORDS,
        sections=shown,
        methods=list(evidence.methods.values()),
        versions=versions(),
        config=html.as_yaml(config),
    )


def _read(path: Path, keys: Sequence[str], datasets: set[str]) -> dict[str, Any]:
    record = read_json(path)
    missing = [key for key in keys if not isinstance(record, dict) or key not in record]
    if missing:
        raise DataError(f"{path} lacks {', '.join(missing)}.")
    if record["dataset"] not in datasets:
        raise DataError(f"{path} is of {record['dataset']}, of which there are no metrics.")
    return record


def _write_csv(data: pd.DataFrame, path: Path) -> None:
    with atomic_path(path) as temporary:
        data.to_csv(temporary, index=False, float_format="%.10g")


def _shown(out: Path, item: Item) -> dict[str, Any]:
    """Write an item's files; what the template needs of it."""
    if isinstance(item, Folded):
        return {
            "kind": "folded",
            "title": item.title,
            "parts": [_shown(out, part) for part in item.parts],
        }
    if isinstance(item, Table):
        _write_csv(item.data, out / "tables" / f"{item.name}.csv")
        return {"kind": "table", **html.shown_table(item)}
    if isinstance(item, Drawing):
        png = draw.save_figure(item.figure, out / "figures" / item.name)[0]
        item = html.ReportFigure("", item.caption, png)
    caption, image, width = html.embedded(item)
    return {"kind": "figure", "caption": caption, "image": image, "width": width}
