"""Paired comparisons of methods, against computations by hand and scipy's own."""

import itertools

import numpy as np
import pandas as pd
import pytest
from samples import only
from scipy import stats

from dine.errors import DataError
from dine.evaluation.statistics import (
    SUMMARISED,
    cluster_bootstrap,
    compare,
    comparisons,
    holm,
    mcnemar,
    paired,
    rank_biserial,
    summary,
    wilcoxon,
)

pytestmark = pytest.mark.numerical


def rows(method, mce, *, seed=0, levels=(0.5,), per_object=1, **changes):
    """Metrics of made-up pairs; ``mce`` has one value per pair and level, level by level."""
    mce = np.atleast_2d(mce)
    records = []
    for level, values in zip(levels, mce, strict=True):
        for i, value in enumerate(values):
            records.append(
                {
                    **{"dataset": "d", "backbone": "b", "method": method, "seed": seed},
                    **{"pair": f"{level}/{i}", "object": str(i // per_object), "level": level},
                    "cluster": str(i // per_object),
                    **{"condition": "deformation", "corruption": 0.0},
                    **{"cd": value**2, "mce": value, "hd95": 2 * value},
                    **{"accuracy_2_5": 0.5, "accuracy_5": 0.75, "far_points": 0.25},
                    **{"folding": 0.0, "roughness": 0.1, "seconds": np.nan},
                    **changes,
                }
            )
    return pd.DataFrame(records)


# ----------------------------------------------------------------------------- small functions


def test_holm_by_hand():
    # Holm's own kind of example: 4·0.005, 3·0.01, 2·0.03, and 0.04 may not fall below the last.
    np.testing.assert_allclose(holm([0.01, 0.04, 0.03, 0.005]), [0.03, 0.06, 0.06, 0.02])
    np.testing.assert_allclose(holm([0.6, 0.5]), [1, 1])
    np.testing.assert_allclose(holm([0.02, np.nan, 0.03]), [0.04, np.nan, 0.04])
    assert holm([]).shape == (0,)


def test_holm_never_helps_and_keeps_the_order():
    p = np.random.default_rng(0).random(20) ** 3
    adjusted = holm(p)
    assert (adjusted >= p).all()
    assert (np.diff(adjusted[np.argsort(p)]) >= 0).all()
    assert adjusted.min() == pytest.approx(20 * p.min())


def test_rank_biserial_by_hand():
    # Ranks of |1|, |−2|, |3|, |−4| are 1 to 4: (1 + 3 − 2 − 4) / 10.
    assert rank_biserial([1, -2, 3, -4]) == pytest.approx(-0.2)
    assert rank_biserial([0, 0, 5, 1]) == 1
    assert rank_biserial([-1, -1]) == -1
    # Tied ranks are shared: 1.5 each.
    assert rank_biserial([1, -1, 3]) == pytest.approx(3 / 6)
    assert rank_biserial([0, 0]) == 0


def naive_wilcoxon(d):
    """The share of all sign patterns whose statistic is at least as far from its mean."""
    d = d[d != 0]
    ranks = stats.rankdata(np.abs(d))
    observed = abs(ranks @ np.sign(d))
    patterns = np.array(list(itertools.product([-1, 1], repeat=len(d))))
    return (np.abs(patterns @ ranks) >= observed - 1e-9).mean()


@pytest.mark.parametrize(
    "d",
    [
        [0.1, -0.2, 0.3, 0.4, 0.5],
        [1.0],
        [0.0, 0.0, 2.0, -1.0, 3.0, 4.0],
        [1.0, 1.0, -1.0, 2.0, 2.0, 3.0],
        [1.0, -1.0, 1.0, 2.0, -3.0, 2.0, 4.0, 5.0, -5.0, 5.0, 6.0, 6.0, 7.0],
    ],
)
def test_wilcoxon_is_exact_for_small_samples(d):
    assert wilcoxon(np.array(d)) == pytest.approx(naive_wilcoxon(np.array(d)))


def test_wilcoxon_of_large_samples_and_of_no_difference():
    d = np.random.default_rng(0).normal(0.2, 1, 300)
    assert wilcoxon(d) == pytest.approx(stats.wilcoxon(d, method="asymptotic").pvalue)
    assert wilcoxon(np.zeros(5)) == 1
    assert wilcoxon(np.repeat([1.0, -1.0, 0.0], 40)) == pytest.approx(1)


def test_p_values_are_uniform_where_nothing_differs():
    rng = np.random.default_rng(0)
    p = [wilcoxon(rng.normal(size=40)) for _ in range(400)]
    assert stats.kstest(p, "uniform").pvalue > 0.01


def test_mcnemar_is_a_binomial_test_of_the_discordant_pairs():
    a = np.array([1, 1, 1, 1, 1, 0, 1, 0, 0], bool)
    b = np.array([0, 0, 0, 0, 0, 1, 1, 0, 0], bool)
    assert mcnemar(a, b) == pytest.approx(stats.binomtest(5, 6).pvalue)
    # By hand: patterns at least as uneven as 5 to 1 are 6 + 1, both ways, of 64.
    assert mcnemar(a, b) == pytest.approx(2 * 7 / 64)
    assert mcnemar(b, a) == pytest.approx(mcnemar(a, b))
    assert mcnemar(a, a) == 1


def naive_bootstrap(d, clusters, samples, rng):
    names = np.unique(clusters)
    means = []
    for _ in range(samples):
        drawn = rng.choice(names, len(names))
        means.append(np.concatenate([d[clusters == name] for name in drawn]).mean())
    return np.quantile(means, [0.025, 0.975])


def test_bootstrap_draws_whole_clusters():
    rng = np.random.default_rng(0)
    clusters = rng.integers(0, 12, 60)
    d = rng.normal(size=12)[clusters] + 0.3 * rng.normal(size=60)
    found = cluster_bootstrap(d, clusters, samples=20000)
    np.testing.assert_allclose(found, naive_bootstrap(d, clusters, 20000, rng), atol=0.02)
    assert cluster_bootstrap(d, clusters) == cluster_bootstrap(d, clusters)
    assert cluster_bootstrap(d, clusters) != cluster_bootstrap(d, clusters, seed=1)


def test_bootstrap_covers_the_true_mean():
    # A percentile interval of 40 clusters is slightly too narrow: 93.4 % in a longer simulation.
    rng = np.random.default_rng(1)
    covered = 0
    for _ in range(600):
        d = 0.5 + rng.normal(size=(40, 1)) + 0.5 * rng.normal(size=(40, 5))
        low, high = cluster_bootstrap(d.ravel(), np.repeat(np.arange(40), 5), samples=500)
        covered += low < 0.5 < high
    assert 0.91 < covered / 600 < 0.96


def test_clusters_widen_the_interval_of_correlated_pairs():
    rng = np.random.default_rng(0)
    d = (rng.normal(size=(30, 1)) + 0.1 * rng.normal(size=(30, 10))).ravel()
    together = np.ptp(cluster_bootstrap(d, np.repeat(np.arange(30), 10)))
    alone = np.ptp(cluster_bootstrap(d, np.arange(300)))
    assert together > 2.5 * alone
    assert np.isnan(cluster_bootstrap(d, np.zeros(300))).all()


# ------------------------------------------------------------------------------------ pairing


def test_pairs_meet_whatever_their_order_and_seeds_are_averaged():
    metrics = pd.concat(
        [
            rows("new", [0.1, 0.2], seed=0),
            rows("new", [0.3, 0.4], seed=1),
            *(
                rows("old", [0.5, 0.7], seed=seed)
                .iloc[::-1]
                .assign(level=np.float32(0.5), corruption=1e-9)
                for seed in (0, 1)
            ),
        ]
    )
    found = paired(metrics, "new", "old", "mce").sort_values("pair")
    np.testing.assert_allclose(found["method"], [0.2, 0.3])
    np.testing.assert_allclose(found["reference"], [0.5, 0.7])
    np.testing.assert_allclose(found["difference"], [-0.3, -0.4])


def test_only_seeds_that_both_were_trained_with_are_compared():
    new = rows("new", [0.1, 0.2], seed=0)
    old = [rows("old", np.array([0.5, 0.7]) + seed, seed=seed) for seed in range(3)]
    table = compare(pd.concat([new, *old]), "new", "old", values=["mce"])
    row = only(table, level=0.5, value="mce")
    assert (row["seeds_method"], row["seeds_reference"]) == (1, 1)
    assert row["difference"] == pytest.approx(-0.45)
    turned = compare(pd.concat([new, *old]), "old", "new", values=["mce"])
    assert only(turned, level=0.5, value="mce")["difference"] == pytest.approx(0.45)


def test_a_method_without_backbone_meets_every_backbone():
    classical = rows("cpd", [0.5, 0.5], backbone="none")
    ours = [rows("new", [0.1, 0.2]), rows("new", [0.2, 0.3], backbone="c")]
    found = paired(pd.concat([classical, *ours]), "new", "cpd", "mce")
    assert found["backbone"].tolist() == ["b", "b", "c", "c"]
    found = paired(pd.concat([classical, *ours]), "cpd", "new", "mce", backbone="c")
    np.testing.assert_allclose(found["difference"], [0.3, 0.2])
    other = rows("icp", [0.7, 0.8], backbone="none")
    found = paired(pd.concat([classical, other]), "cpd", "icp", "mce")
    assert found["backbone"].tolist() == ["none", "none"]


def test_methods_that_cannot_be_paired_are_refused():
    new = rows("new", [0.1, 0.2, 0.3])
    old = rows("old", [0.1, 0.2, 0.3])
    with pytest.raises(DataError, match=r"different pairs of d .* 1 have a mce .* '0\.5/2'"):
        paired(pd.concat([new, old.iloc[:2]]), "new", "old", "mce")
    with pytest.raises(DataError, match="different pairs"):
        compare(pd.concat([new, old.assign(object="x")]), "new", "old")
    with pytest.raises(DataError, match="no rows of the method 'older'"):
        paired(new, "new", "older", "mce")
    with pytest.raises(DataError, match="no dataset and condition in common"):
        paired(pd.concat([new, old.assign(backbone="c")]), "new", "old", "mce")
    with pytest.raises(DataError, match="with the backbone 'c'"):
        paired(pd.concat([new, old]), "new", "old", "mce", backbone="c")
    with pytest.raises(DataError, match=r"'0\.5/0' of d twice for new with seed 0"):
        paired(pd.concat([new, new, old]), "new", "old", "mce")
    with pytest.raises(DataError, match=r"seeds of new .* has 1 of 2"):
        paired(
            pd.concat([new, new.iloc[:2].assign(seed=1), old, old.assign(seed=1)]),
            "new",
            "old",
            "mce",
        )
    with pytest.raises(DataError, match="lack the column"):
        paired(new.drop(columns="seed"), "new", "old", "mce")


def test_what_only_one_was_evaluated_on_is_left_out():
    new = pd.concat([rows("new", [0.1, 0.2]), rows("new", [0.1, 0.2], condition="resampled")])
    found = paired(pd.concat([new, rows("old", [0.2, 0.2])]), "new", "old", "mce")
    assert found["condition"].tolist() == ["deformation"] * 2


def test_pairs_without_correspondences_count_only_by_distance():
    metrics = pd.concat([rows("new", [0.1, 0.2]), rows("old", [0.2, 0.3])])
    metrics.loc[metrics["pair"] == "0.5/1", "mce"] = np.nan
    table = compare(metrics, "new", "old")
    assert only(table, level=0.5, value="cd")["pairs"] == 2
    row = only(table, level=0.5, value="mce")
    assert (row["pairs"], row["failures_reference"]) == (1, 1)
    unknown = compare(metrics.assign(mce=np.nan), "new", "old")
    assert unknown["value"].unique().tolist() == ["cd"]
    assert unknown[["failures_method", "p_failures"]].isna().all(axis=None)
    with pytest.raises(DataError, match="No pair has a mce"):
        compare(metrics.assign(mce=np.nan), "new", "old", values=["mce"])


# --------------------------------------------------------------------------------- comparison


def test_compare_against_naive_computations():
    rng = np.random.default_rng(0)
    levels = (0.2, 0.5, 0.8)
    old = rng.uniform(0.05, 0.2, (3, 20))
    new = old - rng.normal([[0.02], [0.005], [0.0]], 0.02, (3, 20))
    metrics = pd.concat(
        [
            rows("new", new, levels=levels, per_object=4),
            rows("old", old, levels=levels, per_object=4),
        ]
    )
    table = compare(metrics, "new", "old")
    assert len(table) == 8
    assert table["level"].isna().sum() == 2
    assert table["value"].tolist() == ["cd"] * 4 + ["mce"] * 4
    p = []
    for i, level in enumerate(levels):
        row = only(table, level=level, value="mce")
        d = new[i] - old[i]
        assert (row["pairs"], row["objects"]) == (20, 5)
        assert row["difference"] == pytest.approx(d.mean())
        assert row["relative"] == pytest.approx(100 * (new[i].mean() / old[i].mean() - 1))
        assert row["p"] == pytest.approx(stats.wilcoxon(new[i], old[i]).pvalue)
        assert row["win_rate"] == pytest.approx((d < 0).mean())
        assert row["ci_low"] < row["difference"] < row["ci_high"]
        low, high = cluster_bootstrap(d, np.arange(20) // 4)
        assert (row["ci_low"], row["ci_high"]) == pytest.approx((low, high))
        assert row["effect"] == pytest.approx(rank_biserial(d))
        assert row["failures_method"] == pytest.approx((new[i] > 0.1).mean())
        assert row["failures_reference"] == pytest.approx((old[i] > 0.1).mean())
        assert row["p_failures"] == pytest.approx(mcnemar(new[i] > 0.1, old[i] > 0.1))
        assert np.isnan(row["seed_sd_method"])
        p.append(row["p"])
    some = table[(table["value"] == "mce") & table["level"].notna()]
    np.testing.assert_allclose(some["p_holm"], holm(p))
    every = only(table, level=np.nan, value="mce")
    assert every["p"] == every["p_holm"] == pytest.approx(wilcoxon((new - old).ravel()))
    assert (every["pairs"], every["objects"]) == (60, 5)
    apart = compare(metrics.assign(cluster=metrics["pair"]), "new", "old", values=["mce"])
    row = only(apart, level=0.2)
    assert (row["objects"], row["clusters"]) == (5, 20)
    expected = cluster_bootstrap(new[0] - old[0], [f"0.2/{i}" for i in range(20)])
    assert (row["ci_low"], row["ci_high"]) == pytest.approx(expected)
    squared = only(table, level=0.2, value="cd")
    assert squared["difference"] == pytest.approx((new[0] ** 2 - old[0] ** 2).mean())


def test_a_method_against_itself_is_no_different():
    metrics = pd.concat([rows("new", [0.1, 0.2, 0.3]), rows("old", [0.1, 0.2, 0.3])])
    for row in compare(metrics, "new", "old").itertuples():
        assert row.p == row.p_holm == row.p_failures == 1
        assert row.difference == row.effect == row.relative == 0
        assert row.win_rate == 0.5


def test_seeds_count_once_and_their_spread_is_reported():
    seeds = [rows("new", np.array([0.1, 0.3]) + 0.01 * seed, seed=seed) for seed in range(3)]
    table = compare(pd.concat([*seeds, rows("old", [0.2, 0.4], backbone="none")]), "new", "old")
    row = only(table, level=0.5, value="mce")
    assert (row["pairs"], row["seeds_method"], row["seeds_reference"]) == (2, 3, 1)
    assert row["mean_method"] == pytest.approx(0.21)
    assert row["seed_sd_method"] == pytest.approx(0.01)
    assert np.isnan(row["seed_sd_reference"])
    assert only(table, level=np.nan, value="mce")["seed_sd_method"] == pytest.approx(0.01)


def test_conditions_and_corruptions_are_apart_but_corrected_together():
    rng = np.random.default_rng(0)
    parts = []
    for condition, corruption in (("deformation", 0), ("noise", 0.01), ("noise", 0.03)):
        where = {"condition": condition, "corruption": corruption, "levels": (0.1, 0.2)}
        for method in ("new", "old"):
            parts.append(rows(method, rng.random((2, 12)), **where))
    table = compare(pd.concat(parts), "new", "old", values=["mce"])
    assert len(table) == 9
    noise = table[(table["condition"] == "noise") & table["level"].notna()]
    assert len(noise) == 4
    np.testing.assert_allclose(noise["p_holm"], holm(noise["p"]))
    pooled = table[(table["condition"] == "noise") & table["level"].isna()]
    np.testing.assert_allclose(pooled["p_holm"], holm(pooled["p"]))


def test_pairs_of_unknown_level_count_in_the_row_of_all():
    metrics = pd.concat([rows("new", [0.1, 0.2]), rows("old", [0.2, 0.3])]).assign(level=np.nan)
    table = compare(metrics, "new", "old", values=["mce"])
    assert len(table) == 1
    assert table["pairs"].tolist() == [2]


# ----------------------------------------------------------------------------------- verdicts


def six_objects(seeds=1):
    """Differences −0.1 of three objects and −0.02 of three to 0.2: −30 %."""
    return pd.concat(
        rows(method, mce, seed=seed, per_object=2)
        for seed in range(seeds)
        for method, mce in (("new", [0.1, 0.1, 0.18, 0.18] * 3), ("old", [0.2] * 12))
    )


@pytest.mark.parametrize(
    ("spread", "seeds", "verdict"),
    [(0.0, 1, "lower"), (0.1, 1, "lower"), (0.2, 1, "undecided"), (0.2, 4, "lower")],
)
def test_verdicts_join_the_chance_of_pairs_and_of_training(spread, seeds, verdict):
    metrics = six_objects(seeds)
    found = comparisons(metrics, "old", ("mce",), spread=spread)
    row = only(found, level=0.5)
    assert (row["method"], row["pairs"], row["clusters"]) == ("new", 12, 6)
    assert row["relative"] == pytest.approx(-30)
    # Student's t of 5 degrees of freedom, and a mean of 6.
    wider = 2.570582 / 1.96 * np.sqrt(6 / 5)
    drawn = only(compare(metrics, "new", "old", values=("mce",)), level=0.5)
    training = 196 * spread / np.sqrt(seeds)
    for end, of_pairs in (("low", "ci_low"), ("high", "ci_high")):
        half = np.hypot(100 * (drawn[of_pairs] + 0.06) / 0.2 * wider, training)
        assert abs(row[end] + 30) == pytest.approx(half, rel=1e-5)
    assert row["low"] < -30 < row["high"]
    assert row["verdict"] == verdict
    assert len(found) == 2


@pytest.mark.parametrize(
    ("spread", "half"), [({"deformation": 0.1}, 0.1), ({"deformation": 0.1, "noise": 0.3}, 0.3)]
)
def test_the_chance_of_training_may_be_another_under_another_condition(spread, half):
    clean = comparisons(six_objects(1), "old", ("mce",), spread=0.1)
    noisy = six_objects(1).assign(condition="noise")
    both = comparisons(pd.concat([six_objects(1), noisy]), "old", ("mce",), spread=spread)
    same = comparisons(noisy, "old", ("mce",), spread=half)
    for name in ("low", "high"):
        of = {row["condition"]: row[name] for row in both.to_dict("records") if row["level"] == 0.5}
        assert of["deformation"] == only(clean, level=0.5)[name]
        assert of["noise"] == only(same, level=0.5)[name]


def test_verdicts_turn_with_the_reference_and_need_five_clusters():
    turned = only(comparisons(six_objects(), "new", ("mce",)), level=0.5)
    assert turned["verdict"] == "higher"
    metrics = six_objects()
    for lost, decided in ((["5"], True), (["4", "5"], False)):
        some = metrics[~metrics["cluster"].isin(lost)]
        found = comparisons(some, "old", ("mce",))
        assert set(found["verdict"]) == {"lower" if decided else "undecided"}
        assert found["low"].isna().all() == (not decided)


def test_verdicts_are_of_shared_pairs_and_need_the_reference():
    metrics = six_objects()
    part = metrics[metrics["method"] == "new"].iloc[2:].assign(method="part")
    found = comparisons(pd.concat([metrics, part]), "old", ("mce",))
    assert only(found, level=0.5, method="part")["pairs"] == 10
    assert comparisons(metrics, "absent", ("mce",)).empty
    elsewhere = metrics[metrics["method"] == "new"].assign(backbone="c")
    assert set(comparisons(pd.concat([metrics, elsewhere]), "old", ("mce",))["backbone"]) == {"b"}


# ------------------------------------------------------------------------------------ summary


def test_summary_is_over_pairs_after_seeds():
    values = np.array([[0.05, 0.12, 0.30], [0.07, 0.06, 0.34]])
    metrics = pd.concat(rows("new", mce, seed=seed) for seed, mce in enumerate(values))
    row = summary(metrics).iloc[0]
    mean = values.mean(axis=0)
    assert (row["pairs"], row["seeds"]) == (3, 2)
    assert row["mce_mean"] == pytest.approx(mean.mean())
    assert row["mce_sd"] == pytest.approx(mean.std(ddof=1))
    assert row["mce_seed_sd"] == pytest.approx(values.mean(axis=1).std(ddof=1))
    assert row["mce_pairs_median"] == pytest.approx(np.median(mean))
    assert row["mce_pairs_p95"] == pytest.approx(np.percentile(mean, 95))
    assert row["failure_rate"] == pytest.approx(1 / 3)
    assert row["failure_rate_seed_sd"] == pytest.approx(np.std([2 / 3, 1 / 3], ddof=1))
    assert row["cd_mean"] == pytest.approx((values**2).mean())
    assert np.isnan(row["seconds_mean"])
    for name in SUMMARISED:
        assert {f"{name}_mean", f"{name}_sd", f"{name}_seed_sd"} <= set(row.index)


def test_summary_has_a_row_per_method_and_level_or_pools_these():
    metrics = pd.concat(
        rows(method, [[0.1, 0.2], [0.3, 0.5]], levels=(0.1, 0.2)) for method in ("a", "b")
    )
    assert len(summary(metrics)) == 4
    pooled = summary(metrics, pool_levels=True)
    assert pooled["pairs"].tolist() == [4, 4]
    assert pooled["mce_mean"].tolist() == pytest.approx([0.275] * 2)
    assert pooled["level"].isna().all()
    with pytest.raises(DataError, match="lack the column"):
        summary(metrics.drop(columns="hd95"))
