import re

import numpy as np
import pandas as pd
import pytest
from samples import evaluation, only

from dine.errors import DataError
from dine.reporting import tables
from dine.reporting.loading import load_metrics
from dine.reporting.table import Cell, Table, to_latex, to_markdown, write_table

PAPER_TABLES = {
    1: ("deformation", "deformedtissue"),
    2: ("deformation", "synbench"),
    3: ("corruption", "deformedtissue"),
}


def paper_table(number, metrics, spread=0.0):
    return tables.mean_table(*PAPER_TABLES[number], metrics, spread)


def row(method, pair, cd, **changes):
    return evaluation(**{"method": method, "pair": pair, "cd": cd, "mce": 10 * cd, **changes})


@pytest.fixture
def metrics():
    """Three times two pairs at level 0.7: means 20, 15 and 8, in units of 1e-4."""
    values = {"stage1": (18e-4, 22e-4), "lambda0": (10e-4, 20e-4), "pca": (5e-4, 11e-4)}
    return pd.DataFrame(
        [
            row(method, f"{name}{number}", cd)
            for method, pair in values.items()
            for number in range(3)
            for name, cd in zip("ab", pair, strict=True)
        ]
    )


def cells(table, source, label):
    """Display cells of one row by (group, label) of the header."""
    names = [name for _, name in table.header]
    current = None
    for line in table.rows:
        current = line[names.index("Level")].text or current
        if current == label and line[names.index("Values")].text == source:
            return dict(zip(table.header, line, strict=True))
    raise AssertionError(f"no row {label} {source}")


# --------------------------------------------------------------------------------- loading


def write(path, rows):
    pd.DataFrame(rows).to_csv(path, index=False)
    return path


def test_load_metrics_joins_files(tmp_path, metrics):
    first = write(tmp_path / "stage1.csv", metrics.iloc[:6])
    second = write(tmp_path / "rest.csv", metrics.iloc[6:].assign(mce=np.nan, level=np.nan))
    loaded = load_metrics([first, second])
    assert list(loaded["method"]) == ["stage1"] * 6 + ["lambda0"] * 6 + ["pca"] * 6
    assert loaded["mce"].isna().sum() == loaded["level"].isna().sum() == 12


def test_load_metrics_keeps_numeric_pair_names_as_text(tmp_path):
    path = write(tmp_path / "m.csv", [row("pca", "007", 1e-4, object="12")])
    assert load_metrics([path])["pair"].tolist() == ["007"]


def test_missing_columns_are_named_with_the_file(tmp_path, metrics):
    path = write(tmp_path / "short.csv", metrics.drop(columns=["mce", "level"]))
    with pytest.raises(DataError, match=r"short\.csv lacks the column\(s\) level, mce"):
        load_metrics([path])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"cd": -1e-4}, "column cd holds -0.0001 in data row 2"),
        ({"cd": np.nan}, "column cd holds nothing in data row 2"),
        ({"cd_unregistered": np.inf}, "column cd_unregistered holds inf"),
        ({"cd": "many"}, "column cd is not numeric"),
        ({"pair": None}, "column pair is empty"),
        ({"condition": "fog"}, "unknown condition 'fog'"),
        ({"origin": "moon"}, "unknown origin 'moon'"),
        ({"objects": "lost"}, "unknown objects 'lost'"),
        ({"cluster": None}, "column cluster is empty"),
    ],
)
def test_unusable_values_are_refused(tmp_path, changes, message):
    path = write(tmp_path / "bad.csv", [row("pca", "a", 1e-4), row("pca", "b", 1e-4) | changes])
    with pytest.raises(DataError, match=message) as error:
        load_metrics([path])
    assert "bad.csv" in str(error.value)


def test_contradicting_files_are_refused(tmp_path, metrics):
    path = write(tmp_path / "m.csv", metrics)
    with pytest.raises(DataError, match=r"the same evaluation twice .*method stage1.*pair a"):
        load_metrics([path, path])
    other = write(tmp_path / "o.csv", [row("flow", "a", 1e-4, origin="doi")])
    with pytest.raises(DataError, match=r"different origins \(doi, synthetic\)"):
        load_metrics([path, other])


@pytest.mark.parametrize("content", [None, "", "dataset,backbone\n", "\x00\xff"])
def test_unreadable_files_are_refused(tmp_path, content):
    path = tmp_path / "m.csv"
    if content is not None:
        path.write_text(content, encoding="latin-1")
    with pytest.raises(DataError, match=r"m\.csv"):
        load_metrics([path])
    with pytest.raises(DataError, match="No metrics files"):
        load_metrics([])


# --------------------------------------------------------------------------------- numbers


def test_summary_gives_mean_and_sample_deviation(metrics):
    data = tables.summary(metrics)
    stage1 = only(data, method="stage1")
    assert stage1["n"] == 6
    assert stage1["mean"] == pytest.approx(20)
    assert stage1["std"] == pytest.approx(np.sqrt(4.8))
    assert only(data, method="pca")["mean"] == pytest.approx(8)


def test_a_single_pair_has_no_deviation(metrics):
    data = tables.summary(metrics.iloc[:1])
    assert np.isnan(data["std"].item())
    table = paper_table(1, metrics.iloc[:1])
    assert cells(table, "this run", "0.7")["Robust-DefReg", "Stage 1"].text == "18.00"


def test_levels_meet_across_float_precision(metrics):
    metrics["level"] = [np.float32(0.7), 0.7, 0.7000000001, 0.7, 0.7, 0.7] * 3
    data = tables.summary(metrics)
    assert data["level"].tolist() == [0.7] * 3


def test_summary_pools_levels(metrics):
    metrics.loc[metrics["pair"].str.startswith("b"), "level"] = 0.1
    assert len(tables.summary(metrics)) == 6
    pooled = tables.summary(metrics, pool_levels=True)
    assert pooled["n"].tolist() == [6, 6, 6]
    assert pooled["level"].isna().all()


def test_gains_are_paired_and_signed(metrics):
    metrics.loc[metrics["method"] == "pca", "cd"] = [11e-4, 5e-4] * 3
    # Pair c has no PCA result and must not count for any method.
    metrics = pd.concat(
        [metrics, pd.DataFrame([row("stage1", "c", 1.0), row("lambda0", "c", 1.0)])]
    )
    gain = only(tables.gains(metrics), method="pca")
    assert gain["n"] == 6
    assert gain["lambda0_gain_over_stage1"] == pytest.approx(25)
    assert gain["gain_over_stage1"] == pytest.approx(60)
    assert gain["gain_over_lambda0"] == pytest.approx(100 * 7 / 15)
    assert gain["pairs_better_than_lambda0"] == pytest.approx(50)
    # Of pairs that differ by +1 and −15.
    assert gain["low"] < 0 < gain["gain_over_lambda0"] < gain["high"]
    assert gain["verdict"] == "undecided"


def test_a_harmful_prior_has_a_negative_gain(metrics):
    metrics.loc[metrics["method"] == "pca", "cd"] = 30e-4
    table = tables.gain_table("deformedtissue", metrics)
    assert only(table.data, method="pca")["gain_over_lambda0_percent"] == pytest.approx(-100)
    *changes, interval, verdict, better = [cell.text for cell in table.rows[0]][-6:]
    assert changes == ["+25.0 %", "−50.0 %", "−100.0 %"]
    assert re.fullmatch(r"−1\d\d to −[4-9]\d %", interval)
    assert (verdict, better) == ("higher", "0 %")


def test_gains_without_control(metrics):
    gain = only(tables.gains(metrics[metrics["method"] != "lambda0"]), method="pca")
    assert gain["gain_over_stage1"] == pytest.approx(60)
    assert np.isnan(gain["gain_over_lambda0"])
    cells = tables.gain_table("deformedtissue", metrics[metrics["method"] != "lambda0"]).rows[0]
    assert [cell.text for cell in cells][-3:] == ["–", "–", "–"]
    assert tables.gains(metrics[metrics["method"] == "stage1"]).empty


# ----------------------------------------------------------------------------- paper tables


@pytest.mark.parametrize(
    ("number", "where", "mean", "std"),
    [
        (1, {"level": 0.7, "backbone": "robust_defreg", "method": "stage1"}, 39.49, 6.61),
        (1, {"level": 0.3, "backbone": "deftransnet", "method": "flow"}, 5.97, 4.55),
        (2, {"level": 0.8, "backbone": "deftransnet", "method": "pca"}, 3.72, 2.57),
        (3, {"corruption": 5.0, "backbone": "robust_defreg", "method": "stage1"}, 22, 10),
        (3, {"corruption": 45.0, "backbone": "deftransnet", "method": "pca"}, 11, 3),
        (3, {"corruption": 0.03, "backbone": "robust_defreg", "method": "pca"}, 6, 2),
    ],
)
def test_published_values_reach_their_place(metrics, number, where, mean, std):
    data = only(paper_table(number, metrics).data, **where)
    assert (data["published_mean_1e-4"], data["published_std_1e-4"]) == (mean, std)


def test_every_published_value_appears_once(metrics):
    counts = [paper_table(n, metrics).data["published_mean_1e-4"].count() for n in (1, 2, 3)]
    assert counts == [35, 40, 24]


def test_ours_stand_beside_the_published(metrics):
    table = paper_table(1, metrics)
    data = only(table.data, level=0.7, backbone="robust_defreg", method="stage1")
    assert data["mean_1e-4"] == pytest.approx(20)
    assert data["published_mean_1e-4"] == 39.49
    ours, paper = (cells(table, source, "0.7") for source in ("this run", "paper"))
    assert ours["Robust-DefReg", "Stage 1"] == Cell("20.00 ± 2.19")
    assert ours["Robust-DefReg", "DINE-PCA"] == Cell("8.00 ± 3.29", bold=True)
    assert paper["Robust-DefReg", "Stage 1"] == Cell("39.49 ± 6.61")
    assert ours["", "Unregistered"].text == "100.00 ± 0.00"
    assert ours["", "Pairs"].text == "6"
    # What one side lacks is a dash there, not a missing row or column.
    assert paper["Robust-DefReg", "Control (λ = 0)"].text == "–"
    assert paper["", "Unregistered"].text == "–"
    assert ours["DefTransNet", "DINE-Flow"].text == "–"
    assert cells(table, "this run", "0.1")["Robust-DefReg", "Stage 1"].text == "–"
    assert cells(table, "paper", "0.1")["Robust-DefReg", "Stage 1"].text == "5.18 ± 3.03"


def test_levels_outside_the_paper_appear(metrics):
    table = paper_table(1, metrics.assign(level=0.75))
    assert cells(table, "this run", "0.75")["Robust-DefReg", "Stage 1"].text == "20.00 ± 2.19"
    assert cells(table, "paper", "0.75")["Robust-DefReg", "Stage 1"].text == "–"
    assert [line[0].text for line in table.rows[::2]][-2:] == ["0.7", "0.75"]


def verdicts(data):
    rows = data.loc[data["verdict"] != "", ["backbone", "method", "verdict"]]
    return {tuple(row[:2]): row[2] for row in rows.itertuples(index=False)}


def test_bold_is_what_is_decided_to_be_lower_than_the_control_of_its_backbone(metrics):
    worse = metrics.assign(backbone="deftransnet", cd=metrics["cd"] / 10)
    worse.loc[worse["method"] == "pca", "cd"] = 50e-4
    lone = metrics[metrics["method"] == "pca"].assign(backbone="lonely")
    table = paper_table(1, pd.concat([metrics, worse, lone]))
    assert verdicts(table.data) == {
        ("robust_defreg", "stage1"): "higher",
        ("robust_defreg", "pca"): "lower",
        ("deftransnet", "stage1"): "higher",
        ("deftransnet", "pca"): "higher",
    }
    assert [cell.text for line in table.rows for cell in line if cell.bold] == ["8.00 ± 3.29"]


def test_what_chance_explains_is_not_bold(metrics):
    # −46.7 ± 13.3 % is decided, until trainings differ by 30 % (± 58.8 %).
    bold = [
        sum(cell.bold for line in paper_table(1, metrics, spread).rows for cell in line)
        for spread in (0.0, 0.3)
    ]
    assert bold == [1, 0]
    metrics.loc[metrics["method"] == "pca", "cd"] = [11e-4, 5e-4] * 3
    data = paper_table(1, metrics).data
    assert verdicts(data)["robust_defreg", "pca"] == "undecided"


def test_unseen_objects_are_shown_as_a_dataset_of_their_own(tmp_path, metrics):
    unseen = metrics.assign(pair="u" + metrics["pair"], objects="unseen", cluster="u")
    path = write(tmp_path / "m.csv", pd.concat([metrics, unseen]))
    loaded = load_metrics([path])
    kinds = loaded.groupby("dataset")["objects"].unique().map(list).to_dict()
    assert kinds == {"deformedtissue": ["known"], "deformedtissue_unseen": ["unseen"]}
    made = {table.name: table for table in tables.all_tables(loaded)}
    assert {"table1", "deformation_deformedtissue_unseen", "gains_deformedtissue_unseen"} < set(
        made
    )
    assert made["table1"].data["n"].max() == 6
    assert "DeformedTissue, unseen objects" in made["gains_deformedtissue_unseen"].title
    # Of one object nothing is decided.
    assert set(verdicts(made["deformation_deformedtissue_unseen"].data).values()) == {"undecided"}
    # Where there are no others, they are the dataset.
    alone = load_metrics([write(tmp_path / "u.csv", unseen)])
    assert set(alone["dataset"]) == {"deformedtissue"}
    assert "DeformedTissue, unseen objects;" in paper_table(1, alone).caption


def test_table_three_pools_levels_and_matches_percent_and_sigma(metrics):
    metrics.loc[metrics["pair"].str.startswith("b"), "level"] = 0.2
    corrupted = pd.concat(
        [
            metrics.assign(condition="outliers", corruption=25),
            metrics.assign(condition="noise", corruption=np.float32(0.03)),
        ]
    )
    table = paper_table(3, corrupted)
    for corruption, published in ((25.0, 26), (0.03, 33)):
        data = only(table.data, corruption=corruption, backbone="robust_defreg", method="stage1")
        assert (data["n"], data["published_mean_1e-4"]) == (6, published)
        assert data["mean_1e-4"] == pytest.approx(20)
    assert cells(table, "paper", "25 %")["Robust-DefReg", "Stage 1"].text == "26.0 ± 8.0"
    assert cells(table, "this run", "σ = 0.03")["Robust-DefReg", "DINE-PCA"].bold
    assert "pooled over deformation levels" in table.caption


def test_a_table_without_own_results_says_so(metrics):
    table = paper_table(2, metrics)
    assert table.caption.startswith("This run has no results on SynBench")
    assert {cell.text for line in table.rows[::2] for cell in line[2:]} == {"–"}
    assert cells(table, "paper", "0.8")["DefTransNet", "DINE-Flow"].text == "2.12 ± 2.04"


def test_other_methods_and_backbones_get_columns(metrics):
    other = metrics.assign(backbone="mynet")
    other.loc[other["method"] == "pca", "method"] = "pca_16"
    header = paper_table(1, pd.concat([metrics, other])).header
    assert header[-3:] == (("mynet", "Stage 1"), ("mynet", "Control (λ = 0)"), ("mynet", "pca_16"))


def test_other_datasets_have_no_published_columns(metrics):
    own = metrics.assign(dataset="liver", origin="path", level=np.nan)
    table = tables.mean_table("deformation", "liver", own)
    assert ("", "Values") not in table.header
    assert [cell.text for cell in table.rows[0]][:2] == ["not given", "6"]
    assert len(table.rows) == 1
    assert table.data["published_mean_1e-4"].isna().all()
    assert table.caption.startswith("DINE on liver (data supplied by the user), known objects.")
    assert "paper" not in table.caption


@pytest.mark.parametrize(
    ("origin", "start"),
    [
        (
            "synthetic",
            "DINE on synthetic data in the layout of DeformedTissue, known objects; published "
            "values are on the real DeformedTissue data and are not comparable in absolute terms.",
        ),
        ("bases", "DINE on real base meshes with synthetic deformations in the layout of "),
        ("doi", "DINE on DeformedTissue (published data), known objects."),
    ],
)
def test_captions_tell_the_origin(metrics, origin, start):
    metrics = metrics.assign(origin=origin)
    assert paper_table(1, metrics).caption.startswith(start)
    if origin == "synthetic":
        for table in tables.all_tables(metrics):
            assert "synthetic data" in table.caption


def test_supplementary_tables(metrics):
    noisy = metrics.assign(condition="noise", corruption=0.01)
    everything = pd.concat([metrics, noisy])
    names = [table.name for table in tables.all_tables(everything)]
    assert names == [
        *("table1", "table3", "gains_deformedtissue"),
        *("observed_deformedtissue", "correspondence_deformedtissue"),
    ]
    data = tables.mean_table("observed", "deformedtissue", everything).data
    assert only(data, method="stage1")["mean_1e-4"] == pytest.approx(40)
    data = tables.mean_table("correspondence", "deformedtissue", everything).data
    assert only(data, method="stage1", condition="noise")["mean"] == pytest.approx(20e-3)
    without = everything.assign(mce=np.nan)
    assert "correspondence_deformedtissue" not in [t.name for t in tables.all_tables(without)]


def test_correspondence_errors_count_only_pairs_that_have_them(metrics):
    metrics.loc[metrics["pair"].str.startswith("b"), "mce"] = np.nan
    data = tables.mean_table("correspondence", "deformedtissue", metrics).data
    assert only(data, method="stage1")["n"] == 3


# --------------------------------------------------------------------------------- writing


def test_write_table_writes_three_formats(tmp_path, metrics):
    table = paper_table(1, metrics)
    paths = write_table(table, tmp_path / "table1")
    assert [path.name for path in paths] == ["table1.csv", "table1.md", "table1.tex"]
    tidy = only(
        pd.read_csv(paths[0]), level=0.7, backbone="robust_defreg", method="pca", origin="synthetic"
    )
    assert tidy["mean_1e-4"] == pytest.approx(8)
    assert tidy["published_mean_1e-4"] == pytest.approx(13.03)
    assert tidy["verdict"] == "lower"
    markdown = paths[1].read_text(encoding="utf-8")
    lines = [line for line in markdown.splitlines() if line.startswith("|")]
    assert {line.count("|") for line in lines} == {len(table.header) + 1}
    assert "| **8.00 ± 3.29** |" in markdown
    assert "synthetic data in the layout of DeformedTissue" in markdown
    latex = paths[2].read_text(encoding="utf-8")
    assert r"\textbf{8.00 $\pm$ 3.29}" in latex
    assert r"\cmidrule(lr){5-7}\cmidrule(lr){8-10}" in latex
    body = latex[latex.index(r"\midrule") : latex.index(r"\bottomrule")]
    assert {line.count("&") for line in body.splitlines()[1:]} == {len(table.header) - 1}
    assert latex.isascii()


def test_special_characters_are_escaped():
    table = Table(
        name="Odd Näme_1",
        title="50 % of a_b & c",
        caption=r"#1 {x} $y \z ~ ^",
        header=(("", "L|vl"), ("g_1", "m*")),
        rows=((Cell("–"), Cell("σ = 5 %", bold=True)),),
        data=pd.DataFrame({"x": [1]}),
    )
    latex = to_latex(table)
    assert r"50 \% of a\_b \& c" in latex
    assert r"\#1 \{x\} \$y \textbackslash{}z \textasciitilde{} \textasciicircum{}" in latex
    assert r"-- & \textbf{$\sigma$ = 5 \%} \\" in latex
    assert r"\label{tab:odd-n-me-1}" in latex
    markdown = to_markdown(table)
    assert r"| L\|vl | g\_1: m\* |" in markdown
