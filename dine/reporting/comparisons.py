"""How methods compare with a reference: the one way in which tables, figures and pages do it.

Every number comes by way of :func:`dine.evaluation.statistics.comparisons`; so do the verdicts. A
*place* is a dataset with a backbone. Methods without a network are shown at every place of their
datasets.
"""

from __future__ import annotations

import functools
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from dine.config import CONTROL, STAGE1
from dine.errors import DataError
from dine.evaluation import statistics
from dine.evaluation.statistics import NO_BACKBONE, Spread, spread_under
from dine.reporting import names
from dine.reporting.loading import origin_of
from dine.reporting.names import DASH, change, display_name, in_order, rank
from dine.reporting.table import Cell
from dine.results import CLEAN, trained_on

Place = tuple[str, str]
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

_PLACE = ["dataset", "backbone"]


def effects(
    metrics: pd.DataFrame, reference: str = CONTROL, value: str = "cd", *, spread: Spread = 0.0
) -> pd.DataFrame:
    """Every prior against a reference under each condition, all its levels and strengths together.

    The columns of ``statistics.comparisons``, and ``objects``, ``known`` or ``unseen``.
    """
    # A pair counts once for each strength; drawn by cluster, its rows stay together.
    strength = metrics["corruption"].map("{:g}".format)
    pooled = metrics.assign(corruption=0.0, level=np.nan, pair=metrics["pair"] + " " + strength)
    pooled = pooled[pooled[value].notna()]
    found = statistics.comparisons(pooled, reference, (value,), spread=spread)
    found = found[~found["method"].isin([STAGE1, CONTROL])]
    kinds = metrics.groupby("dataset")["objects"].first()
    found = found.assign(objects=found["dataset"].map(kinds))
    return in_order(found, ["objects", "method", "dataset", "backbone"])


def verdict_cells(data: pd.DataFrame, keys: list[str], rows: Iterable[Any]) -> list[Cell]:
    """Verdicts with the difference in percent of the reference and its interval.

    Args:
        data: comparisons, of one place and value.
        keys: what tells its rows apart.
        rows: the values of ``keys`` in the rows of the table; a dash where there are none.
    """
    found = data.set_index(keys).to_dict("index")
    cells = []
    for key in rows:
        row = found.get(key)
        if row is None:
            cells.append(Cell(DASH))
        else:
            said = change(row["relative"], row["low"], row["high"])
            verdict = row["verdict"]
            cells.append(Cell(f"{verdict}: {said}", verdict == "lower", verdict))
    return cells


def training_chance(spread: Spread) -> str:
    """What an interval holds besides the chance of the pairs; empty if that is nothing."""
    shares = [spread_under(spread, condition) for condition in (CLEAN, "outliers")]
    if not any(shares):
        return ""
    clean, outliers = (f"{100 * share:g} %" for share in shares)
    more = "" if clean == outliers else f", with outliers by {outliers}"
    return (
        " It also holds the chance of the training: another seed, or another CPU's rounding, gives "
        f"another network, whose difference varies by {clean} of the reference{more} "
        "(standard deviation; evaluation.training_spread)."
    )


@dataclass(frozen=True)
class ReportedMethod:
    """A method as the report shows it."""

    name: str
    title: str
    group: str
    description: str

    @property
    def kind(self) -> str:
        return GROUPS[self.group]


def _known_methods(
    present: Sequence[str], described: Mapping[str, Mapping[str, Any]]
) -> dict[str, ReportedMethod]:
    """The methods of the metrics in the order of the tables."""
    found = []
    for name in dict.fromkeys([*(n for n in described if n in present), *present]):
        entry = described.get(name, {})
        group = str(entry.get("group", "other"))
        if group not in GROUPS:
            raise DataError(
                f"The method {name} has the unknown group {group!r}; expected one of "
                f"{', '.join(GROUPS)}."
            )
        title, text = str(entry.get("title") or name), str(entry.get("description") or "")
        found.append(ReportedMethod(name, title, group, text))
    order = list(GROUPS)
    return {m.name: m for m in sorted(found, key=lambda m: order.index(m.group))}


class EvidenceStatistics:
    """The comparisons behind the evidence, each computed once and only when it is asked for.

    Args:
        metrics: as ``load_metrics`` returns them.
        methods: title, group and description by method; see ``build_evidence``.
        reference: what all methods are compared with.
        aside: backbones and datasets that are shown, but neither count for the goal nor for the
            order of methods.
        spread: how much differences vary with the training; see ``statistics.comparisons``.

    Raises:
        DataError: the reference is missing, nothing can be compared with it, or a group is unknown.
    """

    def __init__(
        self,
        metrics: pd.DataFrame,
        methods: Mapping[str, Mapping[str, Any]],
        reference: str = CONTROL,
        aside: Collection[str] = (),
        spread: Spread = 0.0,
    ):
        self.metrics = metrics
        self.methods = _known_methods(list(metrics["method"].unique()), methods)
        self.reference = reference
        self.spread = spread
        self.clean = metrics[metrics["condition"] == CLEAN]
        if not (self.clean["method"] == reference).any():
            raise DataError(
                f"The metrics hold no clean targets of the reference {reference!r}; they have "
                f"{', '.join(self.methods)}."
            )
        self.large_rows = self.clean[self.clean["level"] >= LARGE]
        self.places = self._places()
        # Few methods are tried with such backbones, so they would decide which can win at all; and
        # such datasets are too small to.
        self.judged = [
            place for place in self.places if not {trained_on(place[0]), place[1]} & set(aside)
        ] or self.places
        if self.comparisons.empty:
            raise DataError(f"The metrics hold no method to compare with {reference!r}.")

    def _places(self) -> list[Place]:
        found = {
            (dataset, backbone)
            for dataset, rows in self.metrics.groupby("dataset")
            for backbone in set(rows["backbone"]) - {NO_BACKBONE} or {NO_BACKBONE}
        }
        orders = (names.DATASETS, names.BACKBONES)
        return sorted(found, key=lambda place: tuple(map(rank, place, orders)))

    @property
    def datasets(self) -> list[str]:
        return list(dict.fromkeys(dataset for dataset, _ in self.places))

    def title(self, method: str) -> str:
        return self.methods[method].title

    def origin(self, dataset: str) -> str | None:
        return origin_of(dataset, self.metrics)

    def where(self, dataset: str, backbone: str | None = None) -> str:
        """A place as captions name it; data that were made are always said to be."""
        text = f"{display_name(dataset)} ({names.ORIGINS[self.origin(dataset)]})"
        return text if backbone in (None, NO_BACKBONE) else f"{text}, {display_name(backbone)}"

    def of_group(self, *groups: str) -> list[str]:
        return [m.name for m in self.methods.values() if m.group in groups]

    @property
    def classical(self) -> list[str]:
        """Methods by others that learn nothing; our own may have no network either."""
        return self.of_group("classical")

    @property
    def rivals(self) -> list[str]:
        """What is compared with the reference: all that registers."""
        out = {self.reference, "unregistered", *self.of_group("none")}
        return [name for name in self.methods if name not in out]

    @property
    def candidates(self) -> list[str]:
        """The rivals that are not classical."""
        return [name for name in self.rivals if name not in self.classical]

    # ---- compared with the reference

    @functools.cached_property
    def comparisons(self) -> pd.DataFrame:
        """``statistics.comparisons`` of every method, in their order."""
        return self._compared(self.metrics)

    @functools.cached_property
    def large(self) -> pd.DataFrame:
        """The same for clean targets of all large levels together."""
        # Without a level each pair counts only among all.
        return self._compared(self.large_rows.assign(level=np.nan))

    def _compared(self, metrics: pd.DataFrame) -> pd.DataFrame:
        table = statistics.comparisons(metrics, self.reference, spread=self.spread)
        return self._in_order(table, "method", *_PLACE)

    def _in_order(self, table: pd.DataFrame, *keys: str) -> pd.DataFrame:
        order = list(self.methods)
        return table.sort_values(
            list(keys),
            key=lambda column: column.map(order.index) if column.name == "method" else column,
            kind="stable",
            ignore_index=True,
        )

    @functools.cached_property
    def cells(self) -> pd.DataFrame:
        """``comparisons`` on clean targets, one row per place, method, level and value."""
        table = self.comparisons
        return table[(table["condition"] == CLEAN) & table["level"].notna()]

    def overall(self, place: Place, condition: str = CLEAN) -> pd.DataFrame:
        """``comparisons`` under a condition, all levels together, at a place."""
        table = at(self.comparisons, place)
        return table[(table["condition"] == condition) & table["level"].isna()]

    @functools.cached_property
    def goal(self) -> pd.DataFrame:
        """How many large levels each rival improves, by place.

        ``levels``: large levels of the reference there; ``both``: of these, with a significantly
        lower mean of both values; ``both_lower``: the same without a test; ``mce``, ``cd``: with a
        significantly lower one of these; ``worse``: with a significantly higher one of any. Of all
        levels at which a classical method was evaluated on all pairs (``classical_levels``),
        ``below_classical_mce`` and ``below_classical_cd``: with a lower mean than the best of them.
        """
        keys = [*_PLACE, "method"]
        some = pd.concat([at(self.cells, place) for place in self.judged])
        some = some[(some["level"] >= LARGE) & some["method"].isin(self.rivals)]
        lower = some["significant"] == "lower"
        by_value = {value: lower & (some["value"] == value) for value in ("mce", "cd")}
        some = some.assign(**by_value, below=some["difference"] < 0)
        levels = some.assign(worse=some["significant"] == "higher").groupby([*keys, "level"])
        counts = levels[["mce", "cd", "worse"]].any()
        counts.insert(0, "both", counts["mce"] & counts["cd"])
        counts.insert(1, "both_lower", levels["below"].sum() == 2)
        counts = counts.groupby(level=keys).sum().reset_index()
        means = self.by_level
        reference = means[(means["method"] == self.reference) & (means["level"] >= LARGE)]
        every = reference.groupby(_PLACE).size().rename("levels").reset_index()
        counts = counts.merge(every, on=_PLACE).merge(self._below_classical(), on=keys, how="left")
        counts.insert(3, "levels", counts.pop("levels"))
        ordered = self._in_order(counts, "method")
        return pd.concat([at(ordered, place) for place in self.judged], ignore_index=True)

    def _below_classical(self) -> pd.DataFrame:
        means = self.by_level[~self.by_level["partial"]]
        keys, values = [*_PLACE, "level"], ["mce_mean", "cd_mean"]
        best = means[means["method"].isin(self.classical)].groupby(keys)[values].min()
        ours = means[means["method"].isin(self.candidates)]
        both = ours.merge(best.reset_index(), on=keys, suffixes=("", "_best"))
        found = both[[*_PLACE, "method"]].assign(classical_levels=1)
        for value in ("mce", "cd"):
            below = both[f"{value}_mean"] < both[f"{value}_mean_best"]
            found[f"below_classical_{value}"] = below.astype(int)
        return found.groupby([*_PLACE, "method"]).sum().reset_index()

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
        return self._at_places(statistics.summary(rows, pool_levels=pool))

    def _at_places(self, table: pd.DataFrame) -> pd.DataFrame:
        """Rows of methods without a network, repeated for every backbone of their dataset.

        With ``partial``: whether others were evaluated on more pairs.
        """
        found = []
        for place in self.places:
            own = at(table, place)
            bare = at(table, (place[0], NO_BACKBONE))
            bare = bare[~bare["method"].isin(own["method"])].assign(backbone=place[1])
            found.append(own if place[1] == NO_BACKBONE else pd.concat([own, bare]))
        table = pd.concat(found, ignore_index=True)
        setting = [*_PLACE, "condition", "corruption", *(["level"] if "level" in table else [])]
        most = table.groupby(setting, dropna=False)["pairs"].transform("max")
        return table.assign(partial=table["pairs"] < most)

    def ranking(
        self, methods: Sequence[str], value: str, places: Sequence[Place] | None = None
    ) -> pd.Series:
        """Mean over places of the mean at large levels, lowest first, of methods seen at all."""
        places = self.judged if places is None else places
        some = self.large_means
        some = some[some["method"].isin(list(methods)) & ~some["partial"]]
        wide = some.pivot(index="method", columns=_PLACE, values=f"{value}_mean")
        return wide.reindex(columns=list(places)).dropna().mean(axis=1).sort_values()

    @functools.cached_property
    def roughness_true(self) -> pd.Series:
        """Mean roughness of the true fields by dataset."""
        pairs = self.clean.drop_duplicates(["dataset", "pair"])
        return pairs.groupby("dataset")["roughness_true"].mean()

    @functools.cached_property
    def corrupted(self) -> pd.DataFrame:
        """Means under each corruption, and on clean targets of the same pairs."""
        keys = [*_PLACE, "method", "seed", "pair"]
        values = ["mce", "cd"]
        rows = self.metrics[self.metrics["condition"] != CLEAN]
        both = rows.merge(self.clean[[*keys, *values]], on=keys, suffixes=("", "_clean"))
        group = both.groupby([*_PLACE, "method", "condition", "corruption"])
        means = group[[*values, *(f"{v}_clean" for v in values)]].mean()
        means["pairs"] = group["pair"].nunique()
        means["levels"] = group["level"].agg(lambda x: " ".join(f"{v:g}" for v in np.unique(x)))
        means = means.reset_index()
        for value in values:
            means[f"{value}_change_percent"] = 100 * (means[value] / means[f"{value}_clean"] - 1)
        return self._at_places(means)


def at(table: pd.DataFrame, place: Place) -> pd.DataFrame:
    """Rows of one place."""
    return table[(table["dataset"] == place[0]) & (table["backbone"] == place[1])]
