"""The report on the evidence, from made-up metrics whose truth is known."""

import json
import re

import numpy as np
import pandas as pd
import pytest
from matplotlib.figure import Figure
from test_html import Page

from dine.errors import DataError
from dine.evaluation import statistics
from dine.reporting import evidence_tables as tables
from dine.reporting import figures
from dine.reporting.comparisons import EvidenceStatistics, at
from dine.reporting.evidence import ExamplePicture, Files, build_evidence
from dine.reporting.figures import save_figure
from dine.reporting.loading import load_metrics

pytestmark = pytest.mark.numerical
DATASETS = ("deformedtissue", "synbench")
BACKBONES = ("robust_defreg", "deftransnet")
LEVELS = (0.2, 0.4, 0.6, 0.8)
OBJECTS = 12
# Error of a method as a factor of the reference's: everywhere, or by place or level.
EFFECTS = {
    "unregistered": 4.0,
    "cpd": 1.3,
    "stage1": 1.1,
    "lambda0": 1.0,
    "pca": 0.8,
    "gp": 0.9,
    "smooth": 1.15,
    "map": 0.7,
}
BARE = ("unregistered", "cpd", "relaxed")
METHODS = {
    "unregistered": {"title": "Unregistered", "group": "none"},
    "cpd": {"title": "CPD", "group": "classical", "description": "Coherent point drift."},
    "stage1": {"title": "Stage 1", "group": "network"},
    "lambda0": {"title": "λ = 0", "group": "control"},
    "pca": {"title": "PCA prior", "group": "prior", "description": "The paper's."},
    "gp": {"title": "Gaussian process", "group": "prior"},
    "smooth": {"title": "Smoothness", "group": "control"},
    "map": {"title": "MAP", "group": "test time"},
    "relaxed": {"title": "Relaxed", "group": "test time"},
}


def made_up(effects=None, *, datasets=DATASETS, backbones=BACKBONES, seeds=3, corrupted=True):
    """Rows as ``dine evaluate`` writes them; ``effects`` may be functions of place and level."""
    effects = EFFECTS if effects is None else effects
    rng = np.random.default_rng(3)
    conditions = [("deformation", 0.0)]
    if corrupted:
        conditions += [("noise", 0.03), ("outliers", 25.0), ("resampled", 1.0)]
    rows = []
    for dataset in datasets:
        for condition, corruption in conditions:
            for level in LEVELS if condition == "deformation" else (0.6,):
                hard = np.exp(0.3 * np.random.default_rng(int(10 * level)).normal(size=OBJECTS))
                if condition != "deformation":
                    hard = 1.5 * hard
                for method, effect in effects.items():
                    for backbone in ("none",) if method in BARE else backbones:
                        factor = effect(dataset, backbone, level) if callable(effect) else effect
                        for seed in range(1 if method in BARE else seeds):
                            noise = np.exp(0.02 * rng.normal(size=OBJECTS))
                            mce = 0.1 * level * factor * hard * noise
                            rows.append(
                                pd.DataFrame(
                                    {
                                        **{"dataset": dataset, "backbone": backbone},
                                        **{"method": method, "seed": seed, "origin": "synthetic"},
                                        "pair": [f"{level}-{i:03d}" for i in range(OBJECTS)],
                                        "object": [f"{i:03d}" for i in range(OBJECTS)],
                                        "objects": "unseen",
                                        "cluster": [f"{i:03d}" for i in range(OBJECTS)],
                                        **{"level": level, "condition": condition},
                                        **{"corruption": corruption, "cd": mce**2, "mce": mce},
                                        **{"cd_observed": mce**2, "cd_unregistered": 0.01},
                                        **{"hd95": 2 * mce, "accuracy_2_5": 0.5},
                                        **{"accuracy_5": 0.75, "far_points": 0.25},
                                        **{"folding": 0.01 * factor, "roughness": 0.3 * factor},
                                        **{"roughness_true": 0.25, "seconds": np.nan},
                                    }
                                )
                            )
    return pd.concat(rows, ignore_index=True)


def written(metrics, folder):
    """One file per dataset, backbone, method and seed."""
    paths = []
    for key, rows in metrics.groupby(["dataset", "backbone", "method", "seed"]):
        paths.append(folder / f"{'-'.join(str(re.sub('[^a-z0-9]', '', str(k))) for k in key)}.csv")
        rows.to_csv(paths[-1], index=False)
    return paths


def compared(*args, **options):
    return EvidenceStatistics(made_up(*args, **options), METHODS)


def shown(table):
    """The text of a table's cells by method and column."""
    headings = [f"{group} {label}".strip() for group, label in table.header]
    rows = {}
    for row in table.rows:
        cells = dict(zip(headings, row, strict=True))
        rows[cells["Method"].text] = cells
    return rows


def goals(evidence):
    """Cells of the goal by method: reached, evaluated, and those with both means lower."""
    columns = ("Reached", "Evaluated", "Both lower")
    rows = shown(tables.goal_table(evidence))
    return {name: tuple(row[x].text for x in columns) for name, row in rows.items()}


def best(evidence):
    """The methods whose means at large levels are shown as the lowest, by MCE and CD."""
    group = "Mean, levels from 0.4 on"
    labels = (f"{group} Mean correspondence error", f"{group} Chamfer distance ×10⁻⁴")
    rows = shown(tables.goal_table(evidence))
    return [[name for name, row in rows.items() if row[label].bold] for label in labels]


def verdicts(evidence, place, method):
    """What is said of a method on clean targets, and at how many levels: MCE and CD."""
    cells = shown(tables.verdict_table(evidence, place))[method]
    groups = ("Mean correspondence error", "Chamfer distance ×10⁻⁴")
    clean = [cells[f"{group} Clean targets"].text for group in groups]
    return clean + [cells[f"{group} Levels ▼ / ▲"].text for group in groups]


def search(folder, **changes):
    curve = [
        {"prior": "pca", "lambda": x, "cd": 1e-4 * (2 - x), "mce": 0.05 + x, "roughness": 0.4 - x}
        for x in (0.0, 0.1, 0.2)
    ]
    values = {"dataset": "synbench", "backbone": "robust_defreg", "default": "pca"}
    values |= {"selected": {"pca": 0.1}, "curve": curve, "criterion": "mce", **changes}
    folder.mkdir(exist_ok=True)
    (folder / "lambda.json").write_text(json.dumps(values))
    return folder / "lambda.json"


# -------------------------------------------------------------------------------------- input


def test_strings_stay_strings_and_floats_meet(tmp_path):
    metrics = made_up({"lambda0": 1.0}, datasets=("d",), seeds=1, corrupted=False)
    metrics["pair"] = ["NA", *(f"{i:05d}" for i in range(1, len(metrics)))]
    metrics["level"] = metrics["level"].astype(np.float32).astype(float)
    found = load_metrics(written(metrics, tmp_path))
    assert set(found["pair"]) == set(metrics["pair"])
    assert set(found["level"]) == set(LEVELS)
    assert found["seconds"].isna().all()
    assert found["seed"].dtype.kind == "i"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda m: m.drop(columns=["mce", "seed"]), "lacks the column.* seed, mce; evaluate again"),
        (lambda m: m.assign(cd="x"), "column cd is not numeric"),
        (lambda m: m.assign(roughness=np.nan), "column roughness holds nothing in data row 1"),
        (lambda m: m.assign(cd=np.inf), "column cd holds inf"),
        (lambda m: m.assign(origin="moon"), "unknown origin 'moon'"),
        (lambda m: m.assign(condition="rain"), "unknown condition 'rain'"),
        (lambda m: m.assign(object=""), "column object is empty"),
        (lambda m: m.iloc[:0], "holds no rows"),
    ],
)
def test_unusable_files_are_refused(tmp_path, change, message):
    metrics = made_up({"lambda0": 1.0}, datasets=("d",), backbones=("b",), seeds=1)
    change(metrics).to_csv(tmp_path / "m.csv", index=False)
    with pytest.raises(DataError, match=message):
        load_metrics([tmp_path / "m.csv"])


def test_files_that_contradict_each_other_are_refused(tmp_path):
    metrics = made_up({"lambda0": 1.0, "pca": 1.0}, datasets=("d",), backbones=("b",), seeds=1)
    paths = written(metrics, tmp_path)
    with pytest.raises(DataError, match=r"same evaluation twice .*dataset d, backbone b, method"):
        load_metrics([*paths, paths[0]])
    changed = metrics["method"] == "pca"
    written(metrics.assign(origin=np.where(changed, "doi", "synthetic")), tmp_path)
    with pytest.raises(DataError, match=r"different origins \(doi, synthetic\)"):
        load_metrics(paths)
    with pytest.raises(DataError, match="does not exist"):
        load_metrics([tmp_path / "none.csv"])
    with pytest.raises(DataError, match="No metrics files"):
        load_metrics([])


def test_reference_and_groups_are_checked(tmp_path):
    metrics = made_up({"pca": 1.0, "gp": 1.0}, datasets=("d",), backbones=("b",), seeds=1)
    with pytest.raises(DataError, match="reference 'lambda0'; they have pca, gp"):
        EvidenceStatistics(metrics, {})
    with pytest.raises(DataError, match="pca has the unknown group 'magic'"):
        EvidenceStatistics(metrics, {"pca": {"group": "magic"}}, "gp")
    with pytest.raises(DataError, match="no method to compare with 'gp'"):
        EvidenceStatistics(metrics[metrics["method"] == "gp"], {}, "gp")
    assert EvidenceStatistics(metrics, {}, "gp").methods["pca"].title == "pca"
    assert EvidenceStatistics(metrics, {}, "gp").methods["pca"].kind == "Other"


# ----------------------------------------------------------------------------------- findings


@pytest.fixture(scope="module")
def evidence(tmp_path_factory):
    metrics = made_up()
    # Targets were corrupted on one of the datasets only.
    metrics = metrics[(metrics["condition"] == "deformation") | (metrics["dataset"] == "synbench")]
    paths = written(metrics, tmp_path_factory.mktemp("metrics"))
    return EvidenceStatistics(load_metrics(paths), METHODS)


def test_verdicts_where_the_goal_is_reached(evidence):
    for place in evidence.places:
        mce, cd, *levels = verdicts(evidence, place, "PCA prior")
        assert re.fullmatch(r"lower: −(19|20|21) % \(−\d+ to −\d+\)", mce)
        assert re.fullmatch(r"lower: −3\d % \(−\d+ to −\d+\)", cd)
        assert levels == ["4 / 0 of 4", "4 / 0 of 4"]
        assert verdicts(evidence, place, "Smoothness")[0].startswith("higher: +1")
    rows = shown(tables.verdict_table(evidence, ("synbench", "deftransnet")))
    assert rows["MAP"]["Mean correspondence error Clean targets"].bold
    assert not rows["Smoothness"]["Mean correspondence error Clean targets"].bold
    assert re.match(
        r"lower: −(29|30|31) %", rows["MAP"]["Mean correspondence error Other points"].text
    )
    # Of what was not evaluated nothing is said, nor of what registers nothing or is the reference.
    assert "Mean correspondence error Other points" not in next(
        iter(shown(tables.verdict_table(evidence, ("deformedtissue", "deftransnet"))).values())
    )
    assert {"Unregistered", "λ = 0", "λ = 0 (reference)"}.isdisjoint(rows)
    found = goals(evidence)
    reached = {name for name, cells in found.items() if cells[0] == "12 of 12"}
    assert reached == {"PCA prior", "Gaussian process", "MAP"}
    assert found["CPD"] == ("0 of 12", "12", "0")
    assert best(evidence) == [["MAP"], ["MAP"]]
    cells = shown(tables.goal_table(evidence))
    mean = cells["PCA prior"]["Mean, levels from 0.4 on Mean correspondence error"].text
    assert re.fullmatch(r"0\.0\d+ \(−(19|20)\.\d %\)", mean)
    below = [cells[name]["Below the best classical MCE"].text for name in ("MAP", "Smoothness")]
    assert below == ["16 of 16", "16 of 16"]
    assert cells["CPD"]["Below the best classical MCE"].text == "–"


def test_findings_have_every_method_at_every_place(evidence):
    table = tables.overview_table(evidence)
    rows = shown(table)
    assert list(rows) == [evidence.title(name) for name in evidence.rivals]
    places = [
        f"{d}, {b}"
        for d in ("DeformedTissue", "SynBench")
        for b in ("Robust-DefReg", "DefTransNet")
    ]
    values = ("Mean correspondence error", "Chamfer distance ×10⁻⁴")
    assert table.header[2:] == tuple((value, place) for value in values for place in places)
    for place, name in zip(evidence.places, places, strict=True):
        whole = shown(tables.verdict_table(evidence, place))
        for method, row in rows.items():
            for value in values:
                assert row[f"{value} {name}"] == whole[method][f"{value} Clean targets"]


def test_what_the_numbers_rest_on(evidence):
    rows = [[cell.text for cell in row] for row in tables.basis_table(evidence).rows]
    assert rows == [
        ["DeformedTissue (synthetic data)", "48", "12", "4", "3", "3", "yes"],
        ["SynBench (synthetic data)", "48", "12", "4", "3", "3", "yes"],
    ]


def test_the_chance_of_the_training_widens_intervals_and_undecides():
    metrics = made_up({"lambda0": 1.0, "pca": 0.9}, datasets=("synbench",), seeds=1)
    place = ("synbench", "deftransnet")
    for spread, said in ((0.0, "lower: −10 % "), (0.1, "undecided: −10 % (−30 to +10)")):
        evidence = EvidenceStatistics(metrics, METHODS, spread=spread)
        mce, _, *levels = verdicts(evidence, place, "PCA prior")
        assert mce.startswith(said)
        # Tests ask about the pairs alone.
        assert levels == ["4 / 0 of 4"] * 2


def test_verdicts_where_the_goal_is_missed():
    def here_only(dataset, backbone, level):
        return 0.8 if (dataset, backbone) == ("synbench", "deftransnet") or level < 0.5 else 1.0

    effects = {"lambda0": 1.0, "pca": here_only, "gp": 1.0, "cpd": 0.9}
    evidence = compared(effects, seeds=1, corrupted=False)
    found = goals(evidence)
    assert found["CPD"] == ("12 of 12", "12", "12")
    assert found["PCA prior"][:2] == ("6 of 12", "12")
    cells = shown(tables.goal_table(evidence))["PCA prior"]
    assert cells[f"{tables.GOAL_CELLS} SynBench, DefTransNet"].text == "3 / 0 of 3"
    assert cells[f"{tables.GOAL_CELLS} SynBench, Robust-DefReg"].text == "1 / 0 of 3"
    below = cells["Below the best classical MCE"].text
    assert re.fullmatch(r"(1[0-3]) of 16", below)
    assert verdicts(evidence, ("synbench", "robust_defreg"), "PCA prior")[2] == "2 / 0 of 4"
    del effects["cpd"]
    evidence = compared(effects, seeds=1, datasets=("synbench",), corrupted=False)
    assert goals(evidence)["PCA prior"][:2] == ("4 of 6", "6")
    # Without a classical method nothing is said about them.
    assert (
        shown(tables.goal_table(evidence))["PCA prior"]["Below the best classical MCE"].text == "–"
    )


def test_verdicts_where_the_prior_hurts():
    effects = {"lambda0": 1.0, "pca": 1.2, "gp": 1.1}
    evidence = compared(effects, seeds=1, datasets=("synbench",), corrupted=False)
    for place in evidence.places:
        mce, _, *levels = verdicts(evidence, place, "PCA prior")
        assert mce.startswith("higher: +2")
        assert levels == ["0 / 4 of 4"] * 2
    assert best(evidence) == [["λ = 0 (reference)"]] * 2
    assert goals(evidence)["Gaussian process"] == ("0 of 6", "6", "0")
    cells = shown(tables.goal_table(evidence))["PCA prior"]
    assert cells[f"{tables.GOAL_CELLS} SynBench, DefTransNet"].text == "0 / 3 of 3"
    assert [cell.text for cell in tables.basis_table(evidence).rows[0][4:6]] == ["1", "1"]


def test_verdicts_where_the_prior_does_both_or_nothing():
    effects = {"lambda0": 1.0, "pca": lambda d, b, level: 0.8 if level > 0.5 else 1.2}
    evidence = compared(effects, datasets=("synbench",), corrupted=False)
    for place in evidence.places:
        assert verdicts(evidence, place, "PCA prior")[2:] == ["2 / 2 of 4"] * 2
    evidence = compared({"lambda0": 1.0, "pca": 1.0}, datasets=("d",), corrupted=False)
    mce, _, *levels = verdicts(evidence, ("d", "deftransnet"), "PCA prior")
    assert mce.startswith("undecided")
    assert levels == ["0 / 0 of 4"] * 2


def test_a_method_must_be_evaluated_everywhere_to_reach_the_goal():
    metrics = made_up(
        {"lambda0": 1.0, "pca": 0.8, "gp": 0.7}, datasets=("synbench",), corrupted=False
    )
    metrics = metrics[(metrics["method"] != "gp") | (metrics["backbone"] == "deftransnet")]
    evidence = EvidenceStatistics(metrics, METHODS)
    assert goals(evidence)["PCA prior"] == ("6 of 6", "6", "6")
    assert goals(evidence)["Gaussian process"] == ("3 of 6", "3", "3")
    # It cannot be ranked over all backbones, but it can where it was.
    assert best(evidence) == [["PCA prior"], ["PCA prior"]]
    place = ("synbench", "deftransnet")
    assert shown(tables.mean_table(evidence, place, "mce"))["Gaussian process"][
        "All levels MCE"
    ].bold
    assert list(evidence.ranking(list(METHODS), "mce", [place]).index[:1]) == ["gp"]


def test_a_method_without_a_network_is_classical_only_by_its_group():
    effects = {"unregistered": 4.0, "lambda0": 1.0, "pca": 0.9, "cpd": 0.95, "relaxed": 0.7}
    evidence = compared(effects, seeds=2, datasets=("synbench",), corrupted=False)
    assert evidence.classical == ["cpd"]
    assert evidence.candidates == ["pca", "relaxed"]
    assert best(evidence) == [["Relaxed"], ["Relaxed"]]
    reached = {name for name, cells in goals(evidence).items() if cells[0] == "6 of 6"}
    assert reached == {"CPD", "PCA prior", "Relaxed"}
    cells = shown(tables.goal_table(evidence))["Relaxed"]
    for value in ("MCE", "CD"):
        assert cells[f"Below the best classical {value}"].text == "8 of 8"
    for place in evidence.places:
        assert shown(tables.answer_table(evidence, place, "mce"))["Relaxed"]["Pairs"].text == "48"
        cells = shown(tables.mean_table(evidence, place, "mce"))["Relaxed"]["Level 0.8"]
        assert cells.bold
        assert cells.text.endswith(" ▼")
    assert figures.main_methods(evidence, "synbench") == ["cpd", "lambda0", "pca", "relaxed"]
    del effects["cpd"]
    evidence = compared(effects, seeds=1, datasets=("synbench",), corrupted=False)
    assert evidence.classical == []


def test_large_levels_may_be_missing():
    metrics = made_up({"lambda0": 1.0, "pca": 0.8, "gp": 0.9}, datasets=("d",), corrupted=False)
    evidence = EvidenceStatistics(metrics[metrics["level"] < 0.4], METHODS)
    assert tables.goal_table(evidence) is None
    assert verdicts(evidence, ("d", "deftransnet"), "PCA prior")[0].startswith("lower")
    assert figures.forest_figure(evidence, evidence.places[0]) is None


# ------------------------------------------------------------------------------------- tables


def test_level_table_holds_means_marks_and_the_lowest(evidence):
    place = ("synbench", "robust_defreg")
    rows = shown(tables.mean_table(evidence, place, "mce"))
    clean = at(evidence.clean, place)
    for name, mark in (("pca", " ▼"), ("smooth", " ▲"), ("lambda0", "")):
        mine = clean[clean["method"] == name]
        title = METHODS[name]["title"] + (" (reference)" if name == "lambda0" else "")
        mean = mine.loc[mine["level"] == 0.6, "mce"].mean()
        assert rows[title]["Level 0.6"].text == f"{mean:.4f}{mark}"
        assert rows[title]["All levels MCE"].text == f"{mine['mce'].mean():.4f}{mark}"
    assert [name for name, cells in rows.items() if cells["Level 0.6"].bold] == ["MAP"]
    assert rows["MAP"]["All levels Roughness"].text == "0.210"
    assert rows["MAP"]["All levels Folding (%)"].text == "0.7"
    assert rows["MAP"]["All levels Seconds a pair"].text == "–"
    over_seeds = clean[clean["method"] == "smooth"].groupby("pair")["mce"].mean()
    failed = f"{100 * (over_seeds > 0.1).mean():.1f}"
    assert rows["Smoothness"]["All levels Failures (%)"].text == failed
    # Without a network: the same at every backbone.
    other = shown(tables.mean_table(evidence, ("synbench", "deftransnet"), "mce"))
    assert other["CPD"]["Level 0.8"].text == rows["CPD"]["Level 0.8"].text
    cd = shown(tables.mean_table(evidence, place, "cd"))
    mean = clean.loc[(clean["method"] == "map") & (clean["level"] == 0.8), "cd"].mean()
    assert cd["MAP"]["Level 0.8"].text == f"{1e4 * mean:.2f} ▼"


def test_answer_table_holds_the_statistics(evidence):
    place = ("deformedtissue", "deftransnet")
    expected = statistics.compare(at(evidence.clean, place), "pca", "lambda0")
    row = expected[expected["level"].isna() & (expected["value"] == "mce")].iloc[0]
    cells = shown(tables.answer_table(evidence, place, "mce"))["PCA prior"]
    low, high = (f"{row[name]:.4f}".replace("-", "−") for name in ("ci_low", "ci_high"))
    group = "Mean correspondence error"
    difference = f"{row['difference']:.4f}".replace("-", "−")
    assert cells[f"{group} Difference [95 % interval]"].text == f"{difference} [{low}, {high}]"
    assert cells[f"{group} Mean"].text == f"{row['mean_method']:.4f}"
    assert cells[f"{group} %"].text == f"{row['relative']:.1f} ▼".replace("-", "−")
    assert cells[f"{group} p"].text == "< 0.001"
    assert cells[f"{group} Wins (%)"].text == "100"
    assert cells["Failures Reference %"].text == f"{100 * row['failures_reference']:.1f}"
    assert cells["Pairs"].text == "48"
    table = tables.answer_table(evidence, place, "cd", by_level=True)
    assert len(table.rows) == 4 * len(evidence.rivals)
    assert set(table.data["verdict"]) <= {"lower", "higher", "none"}
    row = expected[(expected["level"] == 0.4) & (expected["value"] == "cd")].iloc[0]
    names = [label for _, label in table.header]
    (cells,) = [r for r in table.rows if r[1].text == "PCA prior" and r[2].text == "0.4"]
    assert cells[names.index("Reference")].text == f"{1e4 * row['mean_reference']:.2f}"


def test_goal_table_counts_levels(evidence):
    table = tables.goal_table(evidence)
    rows = shown(table)
    assert rows["MAP"]["Reached"].text == "12 of 12"
    assert rows["Smoothness"]["Reached"].text == "0 of 12"
    assert rows["Smoothness"][f"{tables.GOAL_CELLS} SynBench, DefTransNet"].text == "0 / 3 of 3"
    counts = ["levels", "both", "both_lower", "mce", "cd", "worse"]
    mine = at(table.data, ("synbench", "deftransnet")).set_index("method")[counts]
    assert mine.loc["map"].tolist() == [3, 3, 3, 3, 3, 0]
    assert mine.loc["smooth"].tolist() == [3, 0, 0, 0, 0, 3]


def test_corruption_table_compares_with_the_same_clean_pairs(evidence):
    place = ("synbench", "robust_defreg")
    table = tables.mean_table(evidence, place, "mce", corrupted=True)
    groups = list(dict.fromkeys(group for group, _ in table.header if group))
    assert groups == [
        "Noise σ = 0.03 (level 0.6)",
        "25 % outliers (level 0.6)",
        "Other points (level 0.6)",
    ]
    cells = shown(table)["MAP"]
    rows = at(evidence.metrics, place).query("method == 'map' and level == 0.6")
    noisy, clean = (
        rows.loc[rows["condition"] == x, "mce"].mean() for x in ("noise", "deformation")
    )
    assert cells[f"{groups[0]} MCE"].text == f"{noisy:.4f} ▼"
    assert cells[f"{groups[0]} % to clean"].text == f"{100 * (noisy / clean - 1):+.0f}"


def test_seed_table_shows_the_spread_of_trainings(evidence):
    table = tables.seed_table(evidence)
    (cells,) = [
        r for r in table.rows if [c.text for c in r[:3]] == ["SynBench", "DefTransNet", "MAP"]
    ]
    rows = at(evidence.clean, ("synbench", "deftransnet")).query("method == 'map'")
    sd = rows.groupby("seed")["mce"].mean().std(ddof=1)
    assert [c.text for c in cells[3:6]] == ["3", f"{rows['mce'].mean():.4f}", f"{sd:.4f}"]
    assert not any(row[2].text == "CPD" for row in table.rows)


def test_a_method_seen_on_some_pairs_only_is_compared_on_these():
    metrics = made_up(
        {"lambda0": 1.0, "pca": 0.9, "cpd": 0.5}, datasets=("synbench",), corrupted=False
    )
    few = (metrics["method"] != "cpd") | metrics["object"].isin(["000", "001", "002"])
    evidence = EvidenceStatistics(metrics[few], METHODS)
    place = ("synbench", "robust_defreg")
    assert shown(tables.answer_table(evidence, place, "mce"))["CPD"]["Pairs"].text == "12"
    table = tables.mean_table(evidence, place, "mce")
    cells = shown(table)
    assert "†" in cells["CPD"]["Level 0.8"].text
    assert cells["PCA prior"]["Level 0.8"].bold
    assert "some of the pairs only" in table.caption
    assert best(evidence) == [["PCA prior"], ["PCA prior"]]
    below = shown(tables.goal_table(evidence))["PCA prior"]["Below the best classical MCE"]
    assert below.text == "–"


# ------------------------------------------------------------------------------------- figures


def test_forest_figure_has_a_row_for_every_method(evidence):
    figure = figures.forest_figure(evidence, ("synbench", "robust_defreg"))
    left = figure.axes[0]
    names = [label.get_text() for label in left.get_yticklabels()]
    assert [n for n in names if n in {m["title"] for m in METHODS.values()}] == [
        *("CPD", "Stage 1", "Smoothness", "PCA prior", "Gaussian process", "MAP"),
    ]
    texts = {round(t.get_position()[1]): t.get_text() for t in left.texts}
    large = at(evidence.large, ("synbench", "robust_defreg"))
    row = large[(large["method"] == "map") & (large["value"] == "mce")].iloc[0]
    rows = at(evidence.large_rows, ("synbench", "robust_defreg"))
    expected = statistics.compare(rows, "map", "lambda0")
    expected = expected[expected["level"].isna() & (expected["value"] == "mce")].iloc[0]
    for name in ("pairs", "relative", "ci_low", "ci_high", "p_holm", "seed_sd_method"):
        assert row[name] == expected[name]
    assert texts[names.index("MAP")] == f"{row['relative']:.1f} %".replace("-", "−")
    assert "synthetic data" in figure.get_suptitle()


def test_main_methods_are_few_and_the_best_of_their_group(evidence):
    main = figures.main_methods(evidence, "synbench")
    assert main == ["cpd", "stage1", "lambda0", "pca", "gp", "map"]


# -------------------------------------------------------------------------------------- report


@pytest.fixture(scope="module")
def report(tmp_path_factory):
    """A complete report of one dataset, with names that must be escaped."""
    folder = tmp_path_factory.mktemp("report")
    few = {name: EFFECTS[name] for name in ("unregistered", "cpd", "lambda0", "pca", "gp")}
    methods = METHODS | {"gp": {"title": "<b>GP</b> $a$ & $b", "group": "prior"}}
    diagnostics = folder / "pca.json"
    diagnostics.write_text(
        json.dumps(
            {
                **{"dataset": "synbench", "backbone": "robust_defreg", "prior": "pca"},
                **{"nll": -12.3456, "generalisation": 0.0125, "specificity": None},
            }
        )
    )
    figure = Figure(figsize=(2, 1))
    figure.subplots().plot([0, 1])
    save_figure(figure, folder / "pca")
    files = Files(
        written(made_up(few, datasets=("synbench",), seeds=2), folder),
        [search(folder)],
        [diagnostics],
        [ExamplePicture("synbench", folder / "pca.png", "A liver.")],
    )
    config = {"note": "<script>alert(1)</script>", "evaluation": {"training_spread": 0.05}}
    build_evidence(files, folder / "out", methods=methods, config=config)
    return folder / "out"


def test_report_is_one_self_contained_page(report):
    text = (report / "report.html").read_text(encoding="utf-8")
    page = Page(text)
    assert {"script", "link", "b"}.isdisjoint(re.findall(r"<(\w+)", text))
    assert not re.search(r"url\(|@import|https?:", text)
    for address in page.addresses:
        assert address[1:] in page.ids if address[0] == "#" else address.startswith("data:image/")
    assert len(page.images) == 2 + 1 + 1 + 1 + 1 + 1
    for image in page.images:
        assert "SynBench (synthetic data)" in image["alt"]
    for title in ("findings", "main", "answer", "corrupted", "plausibility", "seeds", "priors"):
        assert title in page.ids
    # A figure stands beside the table of its numbers.
    for name in ("effects", "levels"):
        assert (
            report / "figures" / f"{name}_synbench{'_deftransnet' * (name == 'effects')}.png"
        ).exists()
    beside = [part.partition("</table>")[0] for part in text.split('class="beside"')[1:]]
    assert len(beside) == 3
    assert all("<table" in part and "<img" in part for part in beside)
    for part in (
        "SynBench: synthetic data.",
        "<b>GP</b> $a$ & $b",
        "<script>alert(1)</script>",
        "CPD (Classical) Coherent point drift.",
        "varies by 5 % of the reference",
        "PCA prior −12.35 0.0125 –",
        "SynBench (synthetic data): A liver.",
        "dine",
    ):
        assert part in page.words, part


def test_every_caption_says_that_data_are_synthetic(report):
    text = (report / "report.html").read_text(encoding="utf-8")
    captions = re.findall(r'<p class="note">(.*?)</p>|<figcaption>(.*?)</figcaption>', text, re.S)
    assert len(captions) > 15
    assert all("synthetic data" in "".join(caption) for caption in captions)


def test_report_writes_tables_and_figures(report):
    table = pd.read_csv(report / "tables" / "comparisons.csv")
    assert {"p_holm", "ci_low", "verdict", "p_failures"} <= set(table)
    assert set(table["condition"]) == {"deformation", "noise", "outliers", "resampled"}
    names = {path.stem for path in (report / "tables").glob("*.csv")}
    for place in ("synbench_robust_defreg", "synbench_deftransnet"):
        for kind in ("mce", "cd", "answer_mce", "answer_cd", "levels_mce", "corrupted_cd"):
            assert f"{kind}_{place}" in names
    assert {"goal", "seeds", "diagnostics"} <= names
    text = (report / "tables" / "all.md").read_text(encoding="utf-8")
    assert "### MCE by level: SynBench (synthetic data), Robust-DefReg" in text
    drawn = {path.name for path in (report / "figures").iterdir()}
    for stem in ("effects_synbench_deftransnet", "levels_synbench", "plausibility_synbench"):
        assert {f"{stem}.png", f"{stem}.pdf"} <= drawn
    assert "lambda_synbench_robust_defreg.png" in drawn


def test_parts_without_data_are_left_out(tmp_path):
    metrics = made_up({"lambda0": 1.0, "pca": 0.9}, datasets=("liver",), seeds=1, corrupted=False)
    metrics = metrics[metrics["backbone"] == "deftransnet"].assign(origin="path")
    build_evidence(Files(written(metrics, tmp_path)), tmp_path / "out", methods={})
    page = Page((tmp_path / "out" / "report.html").read_text(encoding="utf-8"))
    assert {"corrupted", "seeds", "priors", "examples"}.isdisjoint(page.ids)
    assert {"main", "answer", "methods"} <= page.ids
    assert "synthetic" not in page.words
    assert "Configuration" not in page.words
    assert "How much another training would differ" in page.words


def test_files_of_unknown_datasets_are_refused(tmp_path):
    metrics = made_up({"lambda0": 1.0, "pca": 0.9}, datasets=("d",), seeds=1, corrupted=False)
    paths = written(metrics, tmp_path)
    with pytest.raises(DataError, match="is of synbench, of which there are no metrics"):
        build_evidence(Files(paths, [search(tmp_path)]), tmp_path, methods={})
    bad = tmp_path / "bad.json"
    bad.write_text("{}")
    with pytest.raises(DataError, match="lacks dataset"):
        build_evidence(Files(paths, diagnostics=[bad]), tmp_path, methods={})
    picture = ExamplePicture("moon", tmp_path / "x.png", "")
    with pytest.raises(DataError, match="is of moon"):
        build_evidence(Files(paths, examples=[picture]), tmp_path, methods={})
    assert not any((tmp_path / name).exists() for name in ("report.html", "figures"))


def test_backbones_of_the_evidence_alone_decide_nothing():
    metrics = made_up(datasets=("synbench",), seeds=1, corrupted=False)
    # With the backbone on trial only the reference and PCA were evaluated.
    some = metrics[metrics["method"].isin(["lambda0", "pca"])]
    some = some[some["backbone"] == "deftransnet"].assign(backbone="on_trial")
    both = pd.concat([metrics, some], ignore_index=True)
    plain, aside, counted = (
        EvidenceStatistics(metrics, METHODS),
        EvidenceStatistics(both, METHODS, aside=("on_trial",)),
        EvidenceStatistics(both, METHODS),
    )
    assert ("synbench", "on_trial") in aside.places
    assert aside.judged == plain.places
    methods = list(METHODS)
    assert aside.ranking(methods, "mce").equals(plain.ranking(methods, "mce"))
    assert len(counted.ranking(methods, "mce")) < len(plain.ranking(methods, "mce"))
    assert set(aside.goal["backbone"]) == set(plain.goal["backbone"])
    caption = tables.basis_table(aside).caption
    assert "SynBench, on_trial: shown, but with few methods or pairs" in caption
    assert "few methods or pairs" not in tables.basis_table(plain).caption


def test_test_sets_are_shown_and_decide_nothing():
    effects = {name: EFFECTS[name] for name in ("unregistered", "cpd", "lambda0", "pca", "map")}
    metrics = made_up(effects, seeds=1, corrupted=False)
    few = metrics[metrics["dataset"] == "synbench"].assign(dataset="scans", origin="path")
    both = pd.concat([metrics, few[few["level"] < 0.4]], ignore_index=True)
    plain, aside = (
        EvidenceStatistics(metrics, METHODS),
        EvidenceStatistics(both, METHODS, aside=("scans",)),
    )
    assert {place for place in aside.places if place[0] == "scans"}
    assert aside.judged == plain.places
    assert aside.ranking(list(METHODS), "cd").equals(plain.ranking(list(METHODS), "cd"))
    assert aside.goal.equals(plain.goal)
    table = tables.basis_table(aside)
    assert "scans, DefTransNet: shown, but with few methods or pairs" in table.caption
    assert [row[-1].text for row in table.rows] == ["yes", "yes", "no"]
    assert "data supplied by the user" in aside.where("scans")


def test_targets_of_other_points_have_verdicts_of_their_own():
    """There, another method wins than where points are shared."""
    metrics = made_up(seeds=1)
    other = metrics["condition"] == "resampled"
    means = metrics[other].groupby(["dataset", "backbone", "method"])["mce"].mean()
    best = metrics["method"] == "cpd"
    metrics.loc[other & best, "mce"] = 0.001 * means.min()
    evidence = EvidenceStatistics(metrics, METHODS)
    value = metrics.loc[other & best, "mce"].mean()
    place = ("deformedtissue", "robust_defreg")
    cells = shown(tables.verdict_table(evidence, place))["CPD"]
    assert cells["Mean correspondence error Clean targets"].text.startswith("higher: +3")
    assert cells["Mean correspondence error Other points"].text.startswith("lower: −100 %")
    cells = shown(tables.mean_table(evidence, place, "mce", corrupted=True))
    group = "Other points (level 0.6) MCE"
    assert cells["CPD"][group].text == f"{value:.4f} ▼"
    assert [name for name, row in cells.items() if row[group].bold] == ["CPD"]
    reference = means["deformedtissue", "robust_defreg", "lambda0"]
    assert cells["λ = 0 (reference)"][group].text == f"{reference:.4f}"
