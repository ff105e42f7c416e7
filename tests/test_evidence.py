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
from dine.reporting.evidence import (
    Evidence,
    Picture,
    build_evidence,
    figures,
    load_evidence,
    tables,
)
from dine.reporting.evidence.comparisons import at
from dine.reporting.evidence.findings import all_findings
from dine.reporting.figures import save_figure

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
    return Evidence(made_up(*args, **options), METHODS)


def said(evidence):
    """All findings as one text, and each by its beginning."""
    return "\n".join(" | ".join((f.text, *f.parts)) for f in all_findings(evidence))


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
    found = load_evidence(written(metrics, tmp_path))
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
        load_evidence([tmp_path / "m.csv"])


def test_files_that_contradict_each_other_are_refused(tmp_path):
    metrics = made_up({"lambda0": 1.0, "pca": 1.0}, datasets=("d",), backbones=("b",), seeds=1)
    paths = written(metrics, tmp_path)
    with pytest.raises(DataError, match=r"same evaluation twice .*dataset d, backbone b, method"):
        load_evidence([*paths, paths[0]])
    changed = metrics["method"] == "pca"
    written(metrics.assign(origin=np.where(changed, "doi", "synthetic")), tmp_path)
    with pytest.raises(DataError, match=r"different origins \(doi, synthetic\)"):
        load_evidence(paths)
    with pytest.raises(DataError, match="does not exist"):
        load_evidence([tmp_path / "none.csv"])
    with pytest.raises(DataError, match="No metrics files"):
        load_evidence([])


def test_reference_and_groups_are_checked(tmp_path):
    metrics = made_up({"pca": 1.0, "gp": 1.0}, datasets=("d",), backbones=("b",), seeds=1)
    with pytest.raises(DataError, match="reference 'lambda0'; they have pca, gp"):
        Evidence(metrics, {})
    with pytest.raises(DataError, match="pca has the unknown group 'magic'"):
        Evidence(metrics, {"pca": {"group": "magic"}}, "gp")
    with pytest.raises(DataError, match="no method to compare with 'gp'"):
        Evidence(metrics[metrics["method"] == "gp"], {}, "gp")
    assert Evidence(metrics, {}, "gp").methods["pca"].title == "pca"
    assert Evidence(metrics, {}, "gp").methods["pca"].kind == "Other"


# ----------------------------------------------------------------------------------- findings


@pytest.fixture(scope="module")
def evidence(tmp_path_factory):
    metrics = made_up()
    # Targets were corrupted on one of the datasets only.
    metrics = metrics[(metrics["condition"] == "deformation") | (metrics["dataset"] == "synbench")]
    paths = written(metrics, tmp_path_factory.mktemp("metrics"))
    return Evidence(load_evidence(paths), METHODS)


def test_findings_where_the_goal_is_reached(evidence):
    words = said(evidence)
    assert (
        "The paper's prior, PCA prior, is significantly better than λ = 0 at every level, by both "
        "measures. Of 32 comparisons (each level, by MCE and by CD) 32 are significantly lower and "
        "0 significantly higher"
    ) in words
    assert (
        "SynBench (synthetic data), DefTransNet: MCE lower at 4 of 4 levels (4 significantly), "
        "significantly higher at 0; CD lower at 4 of 4 levels (4 significantly)"
    ) in words
    assert re.search(
        r"trained with a prior.*PCA prior has the lowest mean correspondence error \(0\.0\d+, "
        r"−(19|20)\.\d % against λ = 0\) and the lowest Chamfer distance \(\d+\.\d\d ×10⁻⁴, "
        r"−3\d\.\d %",
        words,
    )
    assert re.search(r"Of all methods.*MAP has the lowest mean correspondence error", words)
    assert "every backbone (12 cells). Reached by PCA prior, Gaussian process and MAP." in words
    assert (
        "best classical method of each level (CPD): all that reach the goal are lower by both"
        in words
    )
    assert "MAP is lower in MCE at 16 of 16 levels and in CD at 16 of 16 levels." in words
    assert "What did not help: Smoothness is significantly worse than λ = 0 at some level" in words
    assert "All data are synthetic." in words
    assert "48 test pairs of 12 objects at 4 levels, 3 training seeds of each network." in words
    assert "with 12 test objects a dataset the intervals are too narrow" in words
    assert "How much another training would differ" not in words


def test_findings_where_the_goal_is_missed():
    def here_only(dataset, backbone, level):
        return 0.8 if (dataset, backbone) == ("synbench", "deftransnet") or level < 0.5 else 1.0

    effects = {"lambda0": 1.0, "pca": here_only, "gp": 1.0, "cpd": 0.9}
    words = said(compared(effects, seeds=1, corrupted=False))
    assert "PCA prior, is significantly better than λ = 0 at some levels and significantly" in words
    # CPD reaches it, but is classical: the goal is judged for the others beside it.
    assert "Reached by CPD. Of the methods that are not classical, closest is PCA prior:" in words
    assert "closest is PCA prior: 6 of 12 cells hold" in words
    assert "best classical method of each level (CPD): PCA prior is not lower" in words
    del effects["cpd"]
    words = said(compared(effects, seeds=1, datasets=("synbench",), corrupted=False))
    assert "No method reaches it. Closest is PCA prior: 4 of 6 cells hold" in words
    assert "No classical method was evaluated, so how PCA prior compares" in words


def test_findings_where_the_prior_hurts():
    effects = {"lambda0": 1.0, "pca": 1.2, "gp": 1.1}
    words = said(compared(effects, seeds=1, datasets=("synbench",), corrupted=False))
    assert "is significantly worse than λ = 0 at some levels and significantly better" in words
    assert "0 are significantly lower and 16 significantly higher" in words
    assert "MCE lower at 0 of 4 levels (0 significantly), significantly higher at 4" in words
    assert "Of all methods, over all levels" in words
    assert "λ = 0 has the lowest mean correspondence error (0." in words
    assert "No method reaches it. Closest is Gaussian process: 0 of 6 cells hold" in words
    assert "What did not help: PCA prior and Gaussian process are significantly worse" in words
    assert "Every network was trained once." in words


def test_findings_where_the_prior_does_both_or_nothing():
    effects = {"lambda0": 1.0, "pca": lambda d, b, level: 0.8 if level > 0.5 else 1.2}
    words = said(compared(effects, datasets=("synbench",), corrupted=False))
    assert "better than λ = 0 at some levels and significantly worse at others" in words
    assert "8 are significantly lower and 8 significantly higher" in words
    assert "no method is significantly worse than λ = 0 at some level without being" in words
    words = said(compared({"lambda0": 1.0, "pca": 1.0}, datasets=("d",), corrupted=False))
    assert "PCA prior, cannot be told from λ = 0: no difference is significant" in words
    assert "at another. PCA prior cannot be told from it at any level." in words
    words = said(compared({"lambda0": 1.0, "gp": 0.9}, datasets=("d",), corrupted=False))
    assert "The paper's prior (pca) was not evaluated on the same targets as λ = 0" in words


def test_a_method_must_be_evaluated_everywhere_to_reach_the_goal():
    metrics = made_up(
        {"lambda0": 1.0, "pca": 0.8, "gp": 0.7}, datasets=("synbench",), corrupted=False
    )
    metrics = metrics[(metrics["method"] != "gp") | (metrics["backbone"] == "deftransnet")]
    words = said(Evidence(metrics, METHODS))
    assert "Reached by PCA prior. Gaussian process reaches it wherever evaluated" in words
    # It cannot be ranked over all backbones, but it can where it was.
    assert "DefTransNet: Gaussian process (MCE and CD)." in words
    assert "PCA prior has the lowest mean correspondence error" in words


def test_a_method_without_a_network_is_classical_only_by_its_group():
    effects = {"unregistered": 4.0, "lambda0": 1.0, "pca": 0.9, "cpd": 0.95, "relaxed": 0.7}
    evidence = compared(effects, seeds=2, datasets=("synbench",), corrupted=False)
    assert evidence.classical == ["cpd"]
    assert evidence.candidates == ["pca", "relaxed"]
    words = said(evidence)
    assert re.search("Of all methods, over all levels .*: Relaxed has the lowest mean", words)
    assert "Reached by CPD, PCA prior and Relaxed." in words
    assert "best classical method of each level (CPD): all that reach the goal are lower" in words
    assert "Relaxed is lower in MCE at 8 of 8 levels and in CD at 8 of 8 levels." in words
    for place in evidence.places:
        assert shown(tables.answer_table(evidence, place, "mce"))["Relaxed"]["Pairs"].text == "48"
        cells = shown(tables.level_table(evidence, place, "mce"))["Relaxed"]["Level 0.8"]
        assert cells.bold
        assert cells.text.endswith(" ▼")
    assert figures.main_methods(evidence, "synbench") == ["cpd", "lambda0", "pca", "relaxed"]
    del effects["cpd"]
    evidence = compared(effects, seeds=1, datasets=("synbench",), corrupted=False)
    assert evidence.classical == []
    words = said(evidence)
    assert "No classical method was evaluated, so how PCA prior and Relaxed compare" in words


def test_large_levels_may_be_missing():
    metrics = made_up({"lambda0": 1.0, "pca": 0.8, "gp": 0.9}, datasets=("d",), corrupted=False)
    evidence = Evidence(metrics[metrics["level"] < 0.4], METHODS)
    words = said(evidence)
    assert "no pair has a level of at least 0.4" in words
    assert "Goal: no method can be judged at levels from 0.4 on" in words
    assert figures.forest_figure(evidence, evidence.places[0]) is None


# ------------------------------------------------------------------------------------- tables


def shown(table):
    """The text of a table's cells by method and column."""
    names = [f"{group} {label}".strip() for group, label in table.header]
    rows = {}
    for row in table.rows:
        cells = dict(zip(names, row, strict=True))
        rows[cells["Method"].text] = cells
    return rows


def test_level_table_holds_means_marks_and_the_lowest(evidence):
    place = ("synbench", "robust_defreg")
    rows = shown(tables.level_table(evidence, place, "mce"))
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
    other = shown(tables.level_table(evidence, ("synbench", "deftransnet"), "mce"))
    assert other["CPD"]["Level 0.8"].text == rows["CPD"]["Level 0.8"].text
    cd = shown(tables.level_table(evidence, place, "cd"))
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
    rows = shown(tables.goal_table(evidence))
    assert rows["MAP"]["Goal cells"].text == "12 of 12"
    assert rows["Smoothness"]["Goal cells"].text == "0 of 12"
    assert rows["Smoothness"]["SynBench, DefTransNet: of 3 levels any ▲"].text == "3"


def test_corruption_table_compares_with_the_same_clean_pairs(evidence):
    place = ("synbench", "robust_defreg")
    table = tables.corruption_table(evidence, place, "mce")
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
    evidence = Evidence(metrics[few], METHODS)
    place = ("synbench", "robust_defreg")
    assert shown(tables.answer_table(evidence, place, "mce"))["CPD"]["Pairs"].text == "12"
    table = tables.level_table(evidence, place, "mce")
    cells = shown(table)
    assert "†" in cells["CPD"]["Level 0.8"].text
    assert cells["PCA prior"]["Level 0.8"].bold
    assert "some of the pairs only" in table.caption
    assert "Of all methods" in said(evidence)
    assert "CPD has the lowest" not in said(evidence)
    assert "Classical methods were evaluated on some of the pairs only." in said(evidence)


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
    build_evidence(
        written(made_up(few, datasets=("synbench",), seeds=2), folder),
        folder / "out",
        methods=methods,
        searches=[search(folder)],
        diagnostics=[diagnostics],
        examples=[Picture("synbench", folder / "pca.png", "A liver.")],
        config={"note": "<script>alert(1)</script>"},
    )
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
    for title in ("main", "answer", "effects", "corrupted", "plausibility", "seeds", "priors"):
        assert title in page.ids
    for part in (
        "SynBench: synthetic data.",
        "<b>GP</b> $a$ & $b",
        "<script>alert(1)</script>",
        "CPD (Classical) Coherent point drift.",
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
    build_evidence(written(metrics, tmp_path), tmp_path / "out", methods={})
    page = Page((tmp_path / "out" / "report.html").read_text(encoding="utf-8"))
    assert {"corrupted", "seeds", "priors", "examples"}.isdisjoint(page.ids)
    assert {"main", "answer", "methods"} <= page.ids
    assert "synthetic" not in page.words
    assert "Configuration" not in page.words
    assert "How much another training would differ: Every network was trained once." in page.words


def test_files_of_unknown_datasets_are_refused(tmp_path):
    metrics = made_up({"lambda0": 1.0, "pca": 0.9}, datasets=("d",), seeds=1, corrupted=False)
    paths = written(metrics, tmp_path)
    with pytest.raises(DataError, match="is of synbench, of which there are no metrics"):
        build_evidence(paths, tmp_path, methods={}, searches=[search(tmp_path)])
    bad = tmp_path / "bad.json"
    bad.write_text("{}")
    with pytest.raises(DataError, match="lacks dataset"):
        build_evidence(paths, tmp_path, methods={}, diagnostics=[bad])
    picture = Picture("moon", tmp_path / "x.png", "")
    with pytest.raises(DataError, match="is of moon"):
        build_evidence(paths, tmp_path, methods={}, examples=[picture])
    assert not (tmp_path / "report.html").exists()


def test_search_figure_shows_choice_and_control(evidence, tmp_path):
    values = json.loads(search(tmp_path).read_text())
    figure = figures.search_figure(evidence, ("synbench", "robust_defreg"), [values], "synthetic")
    mce, cd, trade = figure.axes
    assert [line.get_ydata()[0] for line in mce.lines if line.get_linestyle() == "--"] == [0.05]
    (star,) = [line for line in cd.lines if line.get_marker() == "*"]
    np.testing.assert_allclose(star.get_ydata(), [1.9])
    assert trade.get_xlabel() == "Roughness of the field"
    for row in values["curve"]:
        del row["roughness"]
    figure = figures.search_figure(evidence, ("synbench", "robust_defreg"), [values], "synthetic")
    assert len(figure.axes) == 2


def test_backbones_of_the_evidence_alone_decide_nothing():
    metrics = made_up(datasets=("synbench",), seeds=1)
    # With the backbone on trial only the reference and PCA were evaluated.
    some = metrics[metrics["method"].isin(["lambda0", "pca"])]
    some = some[some["backbone"] == "deftransnet"].assign(backbone="on_trial")
    both = pd.concat([metrics, some], ignore_index=True)
    plain, aside, counted = (
        Evidence(metrics, METHODS),
        Evidence(both, METHODS, aside=("on_trial",)),
        Evidence(both, METHODS),
    )
    assert ("synbench", "on_trial") in aside.places
    assert aside.judged == plain.places
    methods = list(METHODS)
    assert aside.ranking(methods, "mce").equals(plain.ranking(methods, "mce"))
    assert len(counted.ranking(methods, "mce")) < len(plain.ranking(methods, "mce"))
    assert set(aside.goal["backbone"]) == set(plain.goal["backbone"])
    assert "on_trial, with few methods or pairs, does not count" in said(aside)
    assert "few methods were tried" not in said(plain)


def test_test_sets_are_shown_and_decide_nothing():
    metrics = made_up(seeds=1, corrupted=False)
    few = metrics[metrics["dataset"] == "synbench"].assign(dataset="scans", origin="path")
    both = pd.concat([metrics, few[few["level"] < 0.4]], ignore_index=True)
    plain, aside = Evidence(metrics, METHODS), Evidence(both, METHODS, aside=("scans",))
    assert {place for place in aside.places if place[0] == "scans"}
    assert aside.judged == plain.places
    assert aside.ranking(list(METHODS), "cd").equals(plain.ranking(list(METHODS), "cd"))
    assert aside.goal.equals(plain.goal)
    assert "scans, with few methods or pairs, does not count" in said(aside)
    assert "data supplied by the user" in aside.where("scans")


def test_targets_of_other_points_have_a_sentence_of_their_own():
    """There, another method wins than where points are shared."""
    metrics = made_up(seeds=1)
    other = metrics["condition"] == "resampled"
    means = metrics[other].groupby(["dataset", "backbone", "method"])["mce"].mean()
    best = metrics["method"] == "cpd"
    metrics.loc[other & best, "mce"] = 0.001 * means.min()
    text = said(Evidence(metrics, METHODS))
    value = metrics.loc[other & best, "mce"].mean()
    part = text[text.index("Where targets were sampled anew") :].split(" | ")[1]
    assert part.startswith(f"DeformedTissue (synthetic data), Robust-DefReg: CPD {value:.4f}")
    reference = means["deformedtissue", "robust_defreg", "lambda0"]
    assert f"{reference:.4f}" in part
    clean = metrics[metrics["condition"] == "deformation"]
    assert "sampled anew" not in said(Evidence(clean, METHODS))
