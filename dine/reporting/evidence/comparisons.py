"""The metrics, and how every method compares with the reference on them."""

from __future__ import annotations

import functools
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from dine.config import CONTROL
from dine.errors import DataError
from dine.evaluation import statistics
from dine.evaluation.statistics import NO_BACKBONE
from dine.reporting import tables
from dine.reporting.evidence.wording import join
from dine.reporting.tables import display_name
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

_KEYS = ["dataset", "backbone", "method", "seed", "condition", "corruption", "pair"]
_TEXT = ("dataset", "backbone", "method", "origin", "pair", "object", "cluster", "condition")
_NUMBERS = ("seed", "level", "corruption", *statistics.SUMMARISED, "roughness_true")
# Numbers that evaluate may leave out: unknown level or correspondences, time that was not measured.
_MAY_LACK = {"level", "seconds", "mce", "accuracy_2_5", "accuracy_5", "far_points"}
_DECIMALS = 6  # levels and corruptions that passed through float32 must still meet


# ------------------------------------------------------------------------------------------- input


def load_evidence(paths: Iterable[Path]) -> pd.DataFrame:
    """Read ``metrics.csv`` files of any datasets, backbones, methods and seeds into one frame.

    Raises:
        DataError: a file is missing, lacks a column or holds values that cannot be used, the same
            evaluation stands in two rows, or a dataset mixes origins.
    """
    return tables.combined([_load_one(Path(path)) for path in paths], _KEYS)


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


# -------------------------------------------------------------------------------------- statistics


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


class Evidence:
    """The statistics behind the report, each computed once and only when it is asked for.

    Args:
        metrics: as ``load_evidence`` returns them.
        methods: title, group and description by method; see ``build_evidence``.
        reference: what all methods are compared with.
        aside: backbones and datasets that are shown, but neither count for the goal nor for the
            order of methods.

    Raises:
        DataError: the reference is missing, nothing can be compared with it, or a group is unknown.
    """

    def __init__(
        self,
        metrics: pd.DataFrame,
        methods: Mapping[str, Mapping[str, Any]],
        reference: str = CONTROL,
        aside: Collection[str] = (),
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
        # Few methods are tried with such backbones, so they would decide which can win at all; and
        # such datasets are too small to.
        self.judged = [p for p in self.places if not set(p) & set(aside)] or self.places
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
        """``compare`` of every method with the reference, with a ``verdict``."""
        return self._compare_all(self.metrics)

    @functools.cached_property
    def large(self) -> pd.DataFrame:
        """The same for clean targets of all large levels together."""
        # Without a level each pair counts only among all.
        found = self._compare_all(self.large_rows.assign(level=np.nan))
        return self.comparisons.iloc[:0] if found.empty else found

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

    @functools.cached_property
    def judged_cells(self) -> pd.DataFrame:
        """Those of the places that count."""
        return pd.concat([at(self.cells, place) for place in self.judged])

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
        for place in self.judged:
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
        places = self.judged if places is None else places
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
