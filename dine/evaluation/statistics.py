"""Whether a difference between two methods is more than chance: paired tests and intervals.

All functions take the rows of one or more ``metrics.csv`` in one frame. Values are averaged over
training seeds first, so that a pair counts once however often a method was trained; what the seeds
differ by is reported beside. Definitions and sources: docs/reference/metrics.md.
"""

from __future__ import annotations

import functools
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence

import numpy as np
import pandas as pd
from scipy import stats

from dine.config import Evaluation
from dine.errors import DataError
from dine.evaluation.quality import FAILURE
from dine.results import CLEAN, NO_BACKBONE

SUMMARISED = (
    *("cd", "mce", "hd95", "accuracy_2_5", "accuracy_5", "far_points"),
    *("folding", "roughness", "seconds"),
)
"""Metrics of ``summary``, which adds the failure rate."""

FEWEST_CLUSTERS = 5
"""With fewer, an interval from drawing them anew says next to nothing."""

SIGNIFICANT = 0.05
# Beside a 95 % interval, at either end.
_TAIL = (1 - 0.95) / 2

_GROUP = ["dataset", "backbone", "condition", "corruption"]
_COMPARED = [
    *(*_GROUP, "level", "method", "value", "pairs", "clusters", "mean_method", "mean_reference"),
    *("difference", "relative", "low", "high", "verdict", "significant"),
]
_PAIR = ["pair", "object", "cluster", "level"]
_NEEDED = ["dataset", "backbone", "method", "seed", *_PAIR, "condition", "corruption"]
# Levels and corruptions that passed through float32 must still meet; real ones lie far apart.
_DECIMALS = 6


Spread = float | Mapping[str, float]
"""How much differences vary with the training; see :func:`comparisons`."""


# ----------------------------------------------------------------------------- small functions


def spread_of(settings: Evaluation) -> dict[str, float]:
    """By condition, as configured."""
    return {CLEAN: settings.training_spread, "outliers": settings.training_spread_outliers}


def spread_under(spread: Spread, condition: str = CLEAN) -> float:
    """How much differences vary with the training under a condition."""
    if isinstance(spread, Mapping):
        return spread.get(condition, spread.get(CLEAN, 0.0))
    return spread


def holm(p: Sequence[float] | np.ndarray) -> np.ndarray:
    """Adjusted p-values (m,) of m tests that hold together with their family-wise error rate.

    In increasing order, p̃_(i) = max over j ≤ i of min(1, (m − j + 1) p_(j)). NaN stays NaN and
    does not count as a test. Holm (1979), Scandinavian Journal of Statistics 6.
    """
    p = np.asarray(p, dtype=float)
    adjusted = np.full(p.shape, np.nan)
    tests = np.flatnonzero(~np.isnan(p))
    order = tests[np.argsort(p[tests], kind="stable")]
    steps = p[order] * np.arange(len(order), 0, -1)
    adjusted[order] = np.minimum(np.maximum.accumulate(steps), 1)
    return adjusted


def rank_biserial(differences: np.ndarray) -> float:
    """Matched-pairs rank-biserial correlation of (P,) differences, from −1 to 1.

    (W₊ − W₋) / (W₊ + W₋) with W₊ and W₋ the sums of the ranks of |d| over positive and negative
    differences; zeros are left out, as in Wilcoxon's test, and 0 is returned where nothing remains.
    −1: all differences are negative. Kerby (2014), Comprehensive Psychology 3.
    """
    differences, ranks = _ranked(differences)
    if len(differences) == 0:
        return 0.0
    return float((np.sign(differences) * ranks).sum() / ranks.sum())


def _ranked(differences: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The differences that are not zero, and the ranks of their sizes."""
    differences = np.asarray(differences, dtype=float)
    differences = differences[differences != 0]
    return differences, stats.rankdata(np.abs(differences))


def wilcoxon(differences: np.ndarray) -> float:
    """Two-sided p-value of Wilcoxon's signed-rank test that (P,) differences are symmetric about 0.

    Zeros are left out; 1 where nothing remains. Exact up to 50 differences without ties (and up to
    13 with), normal approximation corrected for ties otherwise. Wilcoxon (1945), Biometrics
    Bulletin 1.
    """
    differences, ranks = _ranked(differences)
    if len(differences) == 0:
        return 1.0
    if len(ranks) <= 13 and len(np.unique(ranks)) < len(ranks):
        return _over_all_signs(ranks, differences > 0)
    return float(stats.wilcoxon(differences).pvalue)


def _over_all_signs(ranks: np.ndarray, positive: np.ndarray) -> float:
    """Two-sided p-value of the sum of ``ranks`` (P,) that are ``positive``, among all 2^P choices.

    That of scipy, which tries one after another and takes a hundred times as long.
    """
    doubled = np.rint(2 * ranks).astype(int)  # shared ranks are halves
    counts = np.ones(1)  # of the choices with each sum
    for rank in doubled:
        added = np.zeros(len(counts) + rank)
        added[: len(counts)] = counts
        added[rank:] += counts
        counts = added
    observed = doubled[positive].sum()
    tail = min(counts[: observed + 1].sum(), counts[observed:].sum())
    return float(min(1, 2 * tail / counts.sum()))


def cluster_bootstrap(
    differences: np.ndarray,
    clusters: np.ndarray,
    *,
    samples: int = 2000,
    seed: int = 0,
) -> tuple[float, float]:
    """95 % percentile bootstrap interval of the mean of (P,) differences of clusters (P,).

    Whole clusters are drawn with replacement, as many as there are, because pairs of one object are
    not independent: pairs drawn one by one would give too narrow an interval. With fewer than two
    clusters nothing is known about the spread between them, and both ends are NaN.
    Davison and Hinkley (1997), Bootstrap Methods and their Application, section 3.8.
    """
    differences = np.asarray(differences, dtype=float)
    _, member = np.unique(np.asarray(clusters), return_inverse=True)
    sizes = np.bincount(member)
    count = len(sizes)
    if count < 2:
        return float("nan"), float("nan")
    sums = np.bincount(member, weights=differences)
    drawn = _drawn(count, samples, seed)
    means = (drawn @ sums) / (drawn @ sizes)
    low, high = np.quantile(means, [_TAIL, 1 - _TAIL])
    return float(low), float(high)


@functools.lru_cache(maxsize=8)
def _drawn(count: int, samples: int, seed: int) -> np.ndarray:
    """How often each of ``count`` clusters is drawn (samples, count); many tables ask the same."""
    generator = np.random.default_rng(seed)
    drawn = generator.multinomial(count, np.full(count, 1 / count), size=samples).astype(float)
    drawn.setflags(write=False)
    return drawn


def mcnemar(a: np.ndarray, b: np.ndarray) -> float:
    """Exact two-sided p-value that two (P,) boolean outcomes on the same pairs are as frequent.

    Only the pairs count in which the outcomes differ: under the null hypothesis the number of those
    with ``a`` is binomial with probability ½. 1 where no pair differs. McNemar (1947),
    Psychometrika 12.
    """
    a, b = np.asarray(a, dtype=bool), np.asarray(b, dtype=bool)
    only_a, only_b = int((a & ~b).sum()), int((b & ~a).sum())
    if only_a + only_b == 0:
        return 1.0
    return float(stats.binomtest(only_a, only_a + only_b, 0.5).pvalue)


# ------------------------------------------------------------------------------------ pairing


def paired(
    metrics: pd.DataFrame,
    method: str,
    reference: str,
    value: str,
    *,
    backbone: str | None = None,
) -> pd.DataFrame:
    """Two methods on the same pairs, within a backbone, each averaged over the seeds of both.

    A method whose rows have the backbone ``none`` is compared with those of every backbone. What
    only one of the two was evaluated on (a whole dataset, backbone, condition or corruption) cannot
    be compared and is left out, as are pairs for which the value is missing for both.

    Args:
        metrics: rows of ``metrics.csv``.
        method: the method in question.
        reference: what it is compared with.
        value: column to compare, lower or higher being better.
        backbone: of this backbone only; by default, of all.

    Returns:
        One row per dataset, backbone, condition, corruption and pair: these, ``object``, ``level``,
        ``method`` and ``reference`` (the values) and ``difference`` (method − reference), in the
        unit of the value.

    Raises:
        DataError: a column is missing, the methods have nothing in common, a pair was evaluated
            twice, or the two (or two seeds of one) were evaluated on different pairs.
    """
    aligned, _ = _aligned(_tidy(metrics, [value]), method, reference, [value], backbone)
    return aligned[value]


def _aligned(
    rows: pd.DataFrame, method: str, reference: str, values: Sequence[str], backbone: str | None
) -> tuple[dict[str, pd.DataFrame], dict[str, pd.DataFrame]]:
    """``paired`` by value, and the rows of each seed under ``method`` and ``reference``.

    ``rows`` are those of ``_tidy``; what is returned is of the groups that the two share.
    """
    ours, theirs = (rows[rows["method"] == name] for name in (method, reference))
    for name, found in ((method, ours), (reference, theirs)):
        if found.empty:
            raise DataError(f"The metrics hold no rows of the method {name!r}.")
    backbones = sorted({*ours["backbone"], *theirs["backbone"]} - {NO_BACKBONE}) or [NO_BACKBONE]
    if backbone is not None:
        backbones = [name for name in backbones if name == backbone]
    joined, seeds = [], {"method": [], "reference": []}
    for name in backbones:
        mine, other = _of_same_seeds(_of_backbone(ours, name), _of_backbone(theirs, name))
        shared = mine[_GROUP].drop_duplicates().merge(other[_GROUP].drop_duplicates())
        if shared.empty:
            continue
        mine, other = mine.merge(shared), other.merge(shared)
        joined.append(_joined(_over_seeds(mine, *values), _over_seeds(other, *values), values))
        seeds["method"].append(mine)
        seeds["reference"].append(other)
    if not joined:
        where = "" if backbone is None else f" with the backbone {backbone!r}"
        raise DataError(
            f"The methods {method!r} and {reference!r} have no dataset and condition in "
            f"common{where}."
        )
    both = pd.concat(joined, ignore_index=True)
    return (
        {value: _with_value(both, value) for value in values},
        {name: pd.concat(parts, ignore_index=True) for name, parts in seeds.items()},
    )


def _of_backbone(rows: pd.DataFrame, backbone: str) -> pd.DataFrame:
    own = rows[rows["backbone"] == backbone]
    if own.empty:
        own = rows[rows["backbone"] == NO_BACKBONE]
    return own.assign(trained=own["backbone"], backbone=backbone)


def _of_same_seeds(ours: pd.DataFrame, theirs: pd.DataFrame) -> tuple[pd.DataFrame, pd.DataFrame]:
    """The seeds that both were trained with; all, where one of them needs no training.

    A method that was trained with the first seed alone must not be compared with the mean of three.
    """
    common = set(ours["seed"]) & set(theirs["seed"])
    trained = all((NO_BACKBONE not in set(rows["trained"])) for rows in (ours, theirs))
    if not trained or not common:
        return ours, theirs
    return ours[ours["seed"].isin(common)], theirs[theirs["seed"].isin(common)]


def _joined(ours: pd.DataFrame, theirs: pd.DataFrame, values: Sequence[str]) -> pd.DataFrame:
    """The pairs of both; the reference's values are called ``<value>_of_reference``."""
    keys = [*_GROUP, *_PAIR]
    both = ours[[*keys, "method", *values]].merge(
        theirs[[*keys, "method", *values]], on=keys, how="outer", suffixes=("", "_of_reference")
    )
    for value in values:
        alone = both[value].isna() != both[f"{value}_of_reference"].isna()
        if alone.any():
            row = both[alone].iloc[0]
            raise DataError(
                f"{ours['method'].iloc[0]!r} and {theirs['method'].iloc[0]!r} were evaluated on "
                f"different pairs of {row['dataset']} ({row['condition']}, {row['backbone']}): "
                f"{int(alone.sum())} have a {value} of one only, such as {row['pair']!r}."
            )
    return both


def _with_value(both: pd.DataFrame, value: str) -> pd.DataFrame:
    """The pairs that have a value, with its ``difference``."""
    known = both[both[value].notna()]
    ours, theirs = known[value], known[f"{value}_of_reference"]
    return known[[*_GROUP, *_PAIR]].assign(method=ours, reference=theirs, difference=ours - theirs)


def rounded(metrics: pd.DataFrame) -> pd.DataFrame:
    """Levels and corruptions as keys that meet."""
    keys = ("level", "corruption")
    return metrics.assign(**{name: metrics[name].astype(float).round(_DECIMALS) for name in keys})


def _tidy(metrics: pd.DataFrame, values: Iterable[str]) -> pd.DataFrame:
    """The columns needed, with keys that meet, or the reason why it cannot be."""
    values = list(dict.fromkeys(values))
    missing = [name for name in [*_NEEDED, *values] if name not in metrics]
    if missing:
        raise DataError(f"The metrics lack the column(s) {', '.join(missing)}.")
    rows = rounded(metrics[[*_NEEDED, *values]])
    repeated = rows[rows.duplicated([*_GROUP, "method", "seed", "pair"])]
    if len(repeated):
        row = repeated.iloc[0]
        raise DataError(
            f"The metrics hold the pair {row['pair']!r} of {row['dataset']} twice for "
            f"{row['method']} with seed {row['seed']}."
        )
    return rows


def _over_seeds(rows: pd.DataFrame, *values: str) -> pd.DataFrame:
    """Mean over seeds per pair, with ``seeds``, how many there are."""
    keys = [*_GROUP, "method"]
    if rows["seed"].nunique() == 1:  # no mean to take, and no seed that lacks a pair
        return rows[[*keys, *_PAIR, *values]].assign(seeds=1)
    grouped = rows.groupby([*keys, *_PAIR], dropna=False, sort=False)
    means = grouped[list(values)].mean().join(grouped["seed"].nunique().rename("seeds"))
    means = means.reset_index()
    expected = rows.groupby(keys)["seed"].nunique().rename("expected").reset_index()
    means = means.merge(expected, on=keys)
    short = means[means["seeds"] != means["expected"]]
    if len(short):
        row = short.iloc[0]
        raise DataError(
            f"The seeds of {row['method']} were evaluated on different pairs of {row['dataset']} "
            f"({row['condition']}, {row['backbone']}): {row['pair']!r} has {row['seeds']} of "
            f"{row['expected']}."
        )
    return means.drop(columns="expected")


# --------------------------------------------------------------------------------- comparison


def compare(
    metrics: pd.DataFrame,
    method: str,
    reference: str,
    *,
    values: Sequence[str] = ("cd", "mce"),
) -> pd.DataFrame:
    """Is a method better than a reference, by how much, and could it be chance?

    One row per dataset, backbone, condition, corruption, deformation level and value, and one of
    all levels together, whose ``level`` is NaN. Columns beside these:

    - ``method``, ``reference``: the names; ``pairs``, ``objects``, ``clusters``: how many;
      ``seeds_method``, ``seeds_reference``: how many trainings were averaged;
    - ``mean_method``, ``mean_reference``, ``difference`` (method − reference, in the unit of the
      value) and ``relative`` (difference in percent of the reference);
    - ``ci_low``, ``ci_high``: 95 % interval of the difference, see ``cluster_bootstrap``;
    - ``p``: ``wilcoxon``; ``p_holm``: adjusted by ``holm`` over the levels (and corruptions) of one
      dataset, backbone, condition and value. Rows of all levels are a family of their own;
    - ``effect``: ``rank_biserial``, negative where the method is lower;
      ``win_rate``: share of the pairs in which it is lower, ties half;
    - ``failures_method``, ``failures_reference``: share of the pairs with a mean correspondence
      error (over seeds) above 0.1; ``p_failures``: ``mcnemar`` of these;
    - ``seed_sd_method``, ``seed_sd_reference``: standard deviation (ddof = 1) over seeds of the
      mean over pairs; NaN with one seed.

    Args:
        metrics: rows of ``metrics.csv``.
        method: the method in question.
        reference: what it is compared with.
        values: columns to compare.

    Raises:
        DataError: see ``paired``.
    """
    rows = _tidy(metrics, ["mce", *values])
    found, by_seed = _aligned(rows, method, reference, list(dict.fromkeys(["mce", *values])), None)
    failed = _failed(found["mce"])
    records = []
    for value in values:
        aligned = found[value].merge(failed, on=[*_GROUP, "pair"], how="left")
        spread = {side: _seed_spread(rows, value) for side, rows in by_seed.items()}
        names = {"value": value, "method": method, "reference": reference}
        for level, at_level in _levels(aligned):
            for key, some in at_level.groupby(_GROUP, sort=False):
                place = {**dict(zip(_GROUP, key, strict=True)), "level": level}
                seeds = {
                    f"{name}_{side}": number
                    for side in ("method", "reference")
                    for name, number in spread[side][_hashable((*key, level))].items()
                }
                measured = {**_difference(some), **_failures(some)}
                records.append({**place, **names, **measured, **seeds})
    if not records:
        raise DataError(f"No pair has a {' or a '.join(values)} to compare.")
    return _in_order(pd.DataFrame(records), values)


def _failed(errors: pd.DataFrame) -> pd.DataFrame:
    """Whether the mean correspondence error of each pair counts as a failure, as numbers.

    Pairs without known correspondences can neither fail nor succeed: NaN once merged.
    """
    return errors[[*_GROUP, "pair"]].assign(
        failed_method=(errors["method"] > FAILURE).astype(float),
        failed_reference=(errors["reference"] > FAILURE).astype(float),
    )


def _in_order(table: pd.DataFrame, values: Sequence[str]) -> pd.DataFrame:
    """The rows of ``compare`` by place, value and level, with p-values adjusted by family."""
    family = [*_GROUP[:-1], "value", table["level"].isna().rename("all")]
    table.insert(
        table.columns.get_loc("p") + 1, "p_holm", table.groupby(family)["p"].transform(holm)
    )
    order = {value: i for i, value in enumerate(values)}
    return table.sort_values(
        [*_GROUP, "value", "level"],
        key=lambda column: column.map(order) if column.name == "value" else column,
        kind="stable",
        ignore_index=True,
    )


def comparisons(
    metrics: pd.DataFrame,
    reference: str,
    values: Sequence[str] = ("cd", "mce"),
    *,
    spread: Spread = 0.0,
) -> pd.DataFrame:
    """Every method against a reference, within each dataset and backbone, and what follows.

    On the pairs that both were evaluated on, since slow methods may have seen fewer. Methods of the
    backbone ``none`` are compared at every backbone of their dataset. Empty where the reference
    was not evaluated beside any other method. Columns beside those of :func:`compare`:

    - ``low``, ``high``: 95 % interval of ``relative``, in percent of the reference's mean. It joins
      two sources of chance as independent: that of the pairs (:func:`cluster_bootstrap`, widened
      for n clusters by t / 1.96 · √(n / (n − 1)) with the 97.5 % quantile t of n − 1 degrees of
      freedom: Hesterberg (2015), The American Statistician 69, section 5.3), and that of the
      training, as another seed or the rounding of another CPU gives another network from the same
      data: ± 1.96 ``spread`` / √(number of seeds). NaN with fewer than ``FEWEST_CLUSTERS``;
    - ``verdict``: ``lower`` or ``higher`` where that interval holds no zero, else ``undecided``;
    - ``significant``: ``lower`` or ``higher`` where p < 0.05 after Holm, else ``none``. It says
      nothing about how other trainings would differ.

    Args:
        metrics: rows of ``metrics.csv``.
        reference: the method that the others are compared with.
        values: columns to compare.
        spread: standard deviation, over trainings, of a difference between two methods' means, as
            a share of the reference's mean; one for all conditions, or by condition, where that on
            clean targets (``deformation``) is that of conditions that are not named.

    Raises:
        DataError: see :func:`paired`.
    """
    found = []
    for _, rows in metrics.groupby("dataset", sort=False):
        backbones = [x for x in rows["backbone"].unique() if x != NO_BACKBONE]
        for backbone in backbones or [NO_BACKBONE]:
            here = rows[rows["backbone"].isin([backbone, NO_BACKBONE])]
            for method in here["method"].unique():
                some = here[here["method"].isin([method, reference])]
                keys = ["condition", "corruption", "pair"]
                shared = some.groupby(keys)["method"].transform("nunique") == 2
                if shared.any():
                    found.append(compare(some[shared], method, reference, values=values))
    if not found:
        return pd.DataFrame(columns=_COMPARED)
    table = pd.concat(found, ignore_index=True)
    low, high = _interval(table, spread)
    sure = table["p_holm"] < SIGNIFICANT
    return table.assign(
        low=low,
        high=high,
        verdict=np.select([high < 0, low > 0], ["lower", "higher"], "undecided"),
        significant=np.select(
            [sure & (table["difference"] < 0), sure & (table["difference"] > 0)],
            ["lower", "higher"],
            "none",
        ),
    )


def _interval(table: pd.DataFrame, spread: Spread) -> tuple[pd.Series, pd.Series]:
    """``low`` and ``high`` of :func:`comparisons`."""
    percent = 100 / table["mean_reference"].where(table["mean_reference"] > 0)
    share = table["condition"].map(functools.partial(spread_under, spread))
    chance = 1.96 * 100 * share / np.sqrt(table[["seeds_method", "seeds_reference"]].min(axis=1))
    clusters = table["clusters"].where(table["clusters"] >= FEWEST_CLUSTERS)
    wider = stats.t.ppf(0.975, clusters - 1) / 1.96 * np.sqrt(clusters / (clusters - 1))
    low, high = (
        table["relative"]
        + sign * np.hypot((table[end] - table["difference"]) * percent * wider, chance)
        for sign, end in ((-1, "ci_low"), (1, "ci_high"))
    )
    return low, high


def _levels(rows: pd.DataFrame) -> Iterable[tuple[float, pd.DataFrame]]:
    """Each deformation level with its rows, and NaN with all; pairs may be of no known level."""
    yield from rows.groupby("level")
    yield float("nan"), rows


def _hashable(key: tuple) -> tuple:
    """NaN equals no NaN, so it cannot be looked up."""
    return tuple("all" if isinstance(x, float) and np.isnan(x) else x for x in key)


def _difference(rows: pd.DataFrame) -> dict[str, float]:
    """The columns of ``compare`` that follow from the aligned values of some pairs."""
    ours, theirs = rows["method"].mean(), rows["reference"].mean()
    difference = rows["difference"].to_numpy()
    clusters = rows["cluster"].to_numpy()
    low, high = cluster_bootstrap(difference, clusters)
    return {
        "pairs": len(rows),
        "objects": rows["object"].nunique(),
        "clusters": len(np.unique(clusters)),
        "mean_method": ours,
        "mean_reference": theirs,
        "difference": difference.mean(),
        "relative": 100 * difference.mean() / theirs if theirs else np.nan,
        "ci_low": low,
        "ci_high": high,
        "p": wilcoxon(difference),
        "effect": rank_biserial(difference),
        "win_rate": (difference < 0).mean() + (difference == 0).mean() / 2,
    }


def _failures(rows: pd.DataFrame) -> dict[str, float]:
    """The columns of ``compare`` on failures."""
    ours, theirs = rows[["failed_method", "failed_reference"]].to_numpy().T
    known = ~np.isnan(ours)
    if not known.any():
        return dict.fromkeys(("failures_method", "failures_reference", "p_failures"), np.nan)
    ours, theirs = ours[known], theirs[known]
    return {
        "failures_method": ours.mean(),
        "failures_reference": theirs.mean(),
        "p_failures": mcnemar(ours, theirs),
    }


def _seed_spread(rows: pd.DataFrame, value: str) -> dict[tuple, dict[str, float]]:
    """Number of seeds and standard deviation of their means, by group and level."""
    if rows["seed"].nunique() == 1:
        return defaultdict(lambda: {"seeds": 1, "seed_sd": float("nan")})
    found = {}
    for extra in (["level"], []):
        means = rows.groupby([*_GROUP, *extra, "seed"], sort=False)[value].mean()
        places = means.groupby(level=[*_GROUP, *extra], sort=False)
        spread = pd.DataFrame({"seeds": places.size(), "seed_sd": places.std(ddof=1)})
        for key, seeds, deviation in spread.itertuples(name=None):
            place = _hashable(key if extra else (*key, float("nan")))
            found[place] = {"seeds": seeds, "seed_sd": deviation}
    return found


def summary(
    metrics: pd.DataFrame, values: Sequence[str] = SUMMARISED, *, pool_levels: bool = False
) -> pd.DataFrame:
    """Mean and spread of every method by dataset, backbone, condition, corruption and level.

    Values are averaged over seeds per pair first. ``pairs`` and ``seeds`` count; for each metric of
    ``values``, ``<metric>_mean`` and ``<metric>_sd`` are mean and standard deviation (ddof = 1)
    over pairs, and ``<metric>_seed_sd`` the standard deviation over seeds of their means over pairs
    (NaN with one seed). ``mce_pairs_median`` and ``mce_pairs_p95`` are over pairs;
    ``failure_rate`` is the share of the pairs with an ``mce`` above 0.1, and its
    ``failure_rate_seed_sd`` that of each seed's own rate. Units are those of the metrics.

    Args:
        metrics: rows of ``metrics.csv``.
        values: metrics to summarise.
        pool_levels: all deformation levels together; ``level`` is then NaN.

    Raises:
        DataError: a column is missing, a pair was evaluated twice, or seeds of one method were
            evaluated on different pairs.
    """
    measured = list(dict.fromkeys([*values, "mce"]))
    rows = _tidy(metrics, measured)
    keys = ["dataset", "backbone", "method", "condition", "corruption", "level"]
    found = [*measured, "failure_rate"]

    def with_failures(frame: pd.DataFrame) -> pd.DataFrame:
        failed = (frame["mce"] > FAILURE).astype(float).where(frame["mce"].notna())
        frame = frame.assign(failure_rate=failed)
        return frame.assign(level=np.nan) if pool_levels else frame

    over_pairs = with_failures(_over_seeds(rows, *measured)).groupby(keys, dropna=False)
    by_seed = with_failures(rows).groupby([*keys, "seed"], dropna=False)[found].mean()
    mean, sd = over_pairs[found].mean(), over_pairs[found].std(ddof=1)
    seed_sd = by_seed.groupby(level=keys, dropna=False).std(ddof=1)
    columns = {"pairs": over_pairs.size(), "seeds": over_pairs["seeds"].max()}
    for name in values:
        columns |= {f"{name}_mean": mean[name], f"{name}_sd": sd[name]}
        columns[f"{name}_seed_sd"] = seed_sd[name]
        if name == "mce":
            columns["mce_pairs_median"] = over_pairs["mce"].median()
            columns["mce_pairs_p95"] = over_pairs["mce"].quantile(0.95)
    columns |= {
        "failure_rate": mean["failure_rate"],
        "failure_rate_seed_sd": seed_sd["failure_rate"],
    }
    return pd.DataFrame(columns).reset_index()
