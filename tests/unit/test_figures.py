from types import SimpleNamespace

import h5py
import matplotlib
import numpy as np
import pandas as pd
import pytest
from matplotlib.colors import to_hex
from PIL import Image
from samples import evaluation

from dine.errors import DataError
from dine.reporting import figures, views

METHODS = ("stage1", "lambda0", "pca")


@pytest.fixture
def metrics():
    """Random numbers for three pairs per level, two backbones and three methods."""
    rng = np.random.default_rng(5)
    rows = [
        evaluation(
            backbone=backbone,
            method=method,
            pair=f"{level}-{pair}",
            level=level,
            condition=condition,
            corruption=corruption,
            cd=rng.uniform(1e-4, 9e-4),
        )
        for backbone in ("robust_defreg", "deftransnet")
        for method in METHODS
        for level in (0.2, 0.7, 0.9)
        for pair in range(3)
        for condition, corruption in (("deformation", 0.0), ("noise", 0.01), ("noise", 0.04))
    ]
    return pd.DataFrame(rows)


def all_text(figure):
    return "\n".join(text.get_text() for text in figure.findobj(lambda a: hasattr(a, "get_text")))


def lines(axes):
    return {line.get_label(): line for line in axes.get_lines()}


def test_saved_files_are_reproducible(tmp_path):
    for folder in ("one", "two"):
        figure = figures.pca_spectrum_figure(
            np.array([2.0, 1.0]), np.array([0.6, 0.3]), "Prior", "synthetic"
        )
        paths = figures.save_figure(figure, tmp_path / folder / "spectrum")
        assert [path.name for path in paths] == ["spectrum.png", "spectrum.pdf"]
    for suffix, magic in (("png", b"\x89PNG"), ("pdf", b"%PDF")):
        one, two = ((tmp_path / f / f"spectrum.{suffix}").read_bytes() for f in ("one", "two"))
        assert one == two
        assert one.startswith(magic)
        assert b"CreationDate" not in one


def test_method_styles_are_fixed_and_distinct():
    styles = figures.method_styles(["zeta", "pca", "alpha", "stage1"])
    assert list(styles) == ["stage1", "pca", "alpha", "zeta"]
    assert styles["pca"] == figures.method_styles(["pca"])["pca"]
    assert len(set(styles.values())) == 4


def test_distance_figure_shows_ours_and_published(metrics):
    figure = figures.distance_figure("deformedtissue", metrics)
    left, right = figure.axes
    assert [left.get_title(), right.get_title()] == ["Robust-DefReg", "DefTransNet"]
    drawn = lines(left)
    rows = metrics[(metrics["backbone"] == "robust_defreg") & (metrics["method"] == "pca")]
    rows = rows[rows["condition"] == "deformation"]
    x, y = drawn["DINE-PCA"].get_data()
    assert list(x) == [0.2, 0.7, 0.9]
    np.testing.assert_allclose(y, 1e4 * rows.groupby("level")["cd"].mean())
    x, y = drawn["Stage 1, paper"].get_data()
    assert dict(zip(x, y, strict=True))[0.7] == 39.49
    assert drawn["Stage 1, paper"].get_linestyle() == "--"
    assert drawn["Stage 1, paper"].get_markerfacecolor() == "white"
    assert drawn["Stage 1, paper"].get_color() == drawn["Stage 1"].get_color()
    assert "Control (λ = 0), paper" not in drawn
    assert "synthetic data" in all_text(figure)
    # The band is one sample standard deviation wide to either side.
    band = left.collections[2].get_paths()[0].vertices
    std = rows[rows["level"] == 0.7]["cd"].std()
    mean = rows[rows["level"] == 0.7]["cd"].mean()
    at = band[np.isclose(band[:, 0], 0.7), 1]
    np.testing.assert_allclose(at.max(), 1e4 * (mean + std))


def test_distance_figure_of_noise_and_of_other_data(metrics):
    figure = figures.distance_figure("deformedtissue", metrics, "noise")
    assert list(lines(figure.axes[0])["Stage 1"].get_xdata()) == [0.01, 0.04]
    own = metrics.assign(dataset="liver", origin="path")
    figure = figures.distance_figure("liver", own)
    assert not [label for label in lines(figure.axes[0]) if "paper" in label]
    assert "synthetic" not in all_text(figure)
    with pytest.raises(DataError, match="no outliers rows of liver"):
        figures.distance_figure("liver", own, "outliers")


def test_histogram_counts_every_point_and_prints_the_tail():
    rng = np.random.default_rng(1)
    errors = {name: rng.exponential(1e-4, (4, 500)) for name in METHODS}
    errors["stage1"] = np.linspace(0, 4e-4, 2000).reshape(4, 500)
    errors["lambda0"][0, 0] = 1.0
    figure = figures.histogram_figure(errors, "Point errors", "synthetic")
    axes = figure.axes[0]
    assert axes.get_yscale() == "log"
    # Far strays land in the last bin instead of stretching the axis.
    assert axes.get_xlim()[1] < 1e4
    # Stage 1 is the yardstick: 1 % of its points lie above.
    text = all_text(figure)
    assert "Tail above 3.96 ×10⁻⁴" in text
    assert "Stage 1: 1.00 % above" in text
    share = 100 * np.mean(errors["pca"] > 3.96e-4)
    assert f"DINE-PCA: {share:.2f} % above" in text
    assert "synthetic data" in text
    outlines = [patch.get_xy()[:, 1] for patch in axes.patches]
    assert [sum(heights[1:-1:2]) for heights in outlines] == [2000] * 3
    del errors["stage1"]
    first = 100 * np.percentile(errors["lambda0"], 99)
    text = all_text(figures.histogram_figure(errors, "", "synthetic"))
    assert f"Tail above {100 * first:.4g}" in text


# ---------------------------------------------------------------------------- qualitative


@pytest.fixture
def stored(tmp_path):
    """Two pairs, in another order in the files than in the pair set."""
    rng = np.random.default_rng(3)
    pairs = SimpleNamespace(
        source=rng.normal(size=(2, 40, 3)), target=rng.normal(size=(2, 40, 3)), name=["a", "b"]
    )
    displacement = rng.normal(size=(2, 40, 3)).astype("f4")
    squared = rng.uniform(0, 1e-3, (2, 40)).astype("f4")
    predictions, errors = {}, {}
    for method in METHODS:
        predictions[method] = tmp_path / f"{method}_predictions.h5"
        errors[method] = tmp_path / f"{method}_point_errors.h5"
        for path, field, values in (
            (predictions[method], "displacement", displacement),
            (errors[method], "squared_distance", squared),
        ):
            with h5py.File(path, "w") as stream:
                stream["noise_0.04/pair"] = ["b", "a"]
                stream[f"noise_0.04/{field}"] = values
    return pairs, predictions, errors, displacement, squared


def test_examples_are_matched_by_pair_name(stored):
    pairs, predictions, errors, displacement, squared = stored
    (example,) = views.load_examples([("noise_0.04", "a", "Noise")], pairs, predictions, errors)
    np.testing.assert_allclose(example.registered["pca"], pairs.source[0] + displacement[1])
    np.testing.assert_array_equal(example.errors["pca"], 1e4 * squared[1])
    np.testing.assert_array_equal(example.target, pairs.target[0])
    with pytest.raises(DataError, match="Pair c is not in the pairs"):
        views.load_examples([("noise_0.04", "c", "")], pairs, predictions, errors)


def test_reading_groups_names_what_is_missing(stored, tmp_path):
    path = stored[1]["pca"]
    with pytest.raises(DataError, match=r"pca_predictions\.h5 holds no outliers_25/displacement"):
        views.read_group(path, "outliers_25", "displacement")
    with pytest.raises(DataError, match=r"none\.h5 does not exist"):
        views.read_group(tmp_path / "none.h5", "deformation", "displacement")
    (tmp_path / "text.h5").write_text("no HDF5")
    with pytest.raises(DataError, match=r"text\.h5 is not a readable HDF5 file"):
        views.read_group(tmp_path / "text.h5", "deformation", "displacement")


def test_qualitative_figure(stored, tmp_path):
    pairs, predictions, errors, _, squared = stored
    picks = [("noise_0.04", "a", "Noise"), ("noise_0.04", "b", "More noise")]
    examples = views.load_examples(picks, pairs, predictions, errors)
    figure = views.qualitative_figure(examples, "Views", "synthetic")
    panels, bar = figure.axes[:-1], figure.axes[-1]
    assert [axes.get_title() for axes in panels[:4]] == [
        *("Before", "Stage 1", "Control (λ = 0)", "DINE-PCA")
    ]
    assert len(panels) == 8
    # One scale for all: the coloured points of every panel share the limits of the bar.
    top = np.percentile(np.tile(1e4 * squared, 3), 98)
    coloured = [
        points for axes in panels for points in axes.collections if points.get_array() is not None
    ]
    assert len(coloured) == 6
    for points in coloured:
        np.testing.assert_allclose(points.get_clim(), (0, top), rtol=1e-5)
    np.testing.assert_allclose(bar.get_ylim(), (0, top), rtol=1e-5)
    blue, red = coloured[0].to_rgba([0, top])
    assert red[0] > red[2]
    assert blue[2] > blue[0]
    assert "synthetic data" in all_text(figure)
    figures.save_figure(figure, tmp_path / "views")


def test_a_single_row_of_views_covers_no_points_and_loses_no_words(tmp_path):
    rng = np.random.default_rng(0)
    cloud = rng.normal(size=(100, 3))
    methods = ("stage1", "lambda0", "pca", "pca_residual")
    errors = {name: np.linspace(0, 10, 100) for name in methods}
    example = views.ExamplePair("Clean", cloud, cloud, dict.fromkeys(methods, cloud), errors)
    figure = views.qualitative_figure([example], "Views", "synthetic")
    figures.save_figure(figure, tmp_path / "views")

    page = figure.bbox
    bar = figure.axes[-1].get_tightbbox()
    assert page.x0 <= bar.x0 < bar.x1 <= page.x1
    assert page.y0 <= bar.y0 < bar.y1 <= page.y1
    (legend,) = figure.legends
    for axes in figure.axes:
        assert not legend.get_window_extent().overlaps(axes.get_window_extent())


def test_picked_examples_are_the_median_hard_cases(metrics):
    picks = views.pick_examples("deformedtissue", "deftransnet", metrics)
    assert [key for key, _, _ in picks] == ["deformation", "noise_0.04"]
    assert picks[1][2] == "Noise σ = 0.04\nlevel 0.9"
    rows = metrics[
        (metrics["backbone"] == "deftransnet")
        & (metrics["method"] == "stage1")
        & (metrics["level"] == 0.9)
        & (metrics["corruption"] == 0.04)
    ]
    assert picks[1][1] == rows.sort_values("cd")["pair"].iloc[1]


def test_condition_keys():
    assert views.condition_key("deformation", 0) == "deformation"
    assert views.condition_key("noise", 0.03) == "noise_0.03"
    assert views.condition_key("outliers", 25.0) == "outliers_25"


# -------------------------------------------------------------------- training and priors


@pytest.fixture
def search():
    return {
        "dataset": "deformedtissue",
        "backbone": "deftransnet",
        "selected": {"pca": 1e-4},
        "curve": [
            {"prior": "pca", "lambda": value, "cd": cd, "mce": mce}
            for value, cd, mce in ((0, 9e-4, 0.2), (1e-4, 5e-4, 0.1), (1e-3, 7e-4, 0.3))
        ],
    }


def test_search_figure_marks_choice_and_control(search):
    figure = figures.search_figure([search], "SynBench", "synthetic")
    right, left = figure.axes
    assert left.get_xscale() == "log"
    # Priors are named beside the first panel.
    assert list(lines(right)["DINE-PCA"].get_xdata()) == [1e-4, 1e-3]
    (star,) = [line for line in left.get_lines() if line.get_marker() == "*"]
    assert (list(star.get_xdata()), list(star.get_ydata())) == ([1e-4], [pytest.approx(5)])
    (control,) = [line for line in left.get_lines() if line.get_linestyle() == "--"]
    assert control.get_ydata() == [pytest.approx(9)] * 2
    assert right.get_ylabel() == "Mean correspondence error"
    assert "Choice of λ: SynBench (synthetic data)" in all_text(figure)
    assert "lowest CD" in all_text(figure)


def test_search_figure_without_correspondences(search):
    for entry in search["curve"]:
        entry["mce"] = None
    assert len(figures.search_figure([search], "", "path").axes) == 1


def test_search_figure_shows_errors_against_roughness_where_it_is_known(search):
    for entry in search["curve"]:
        entry["roughness"] = 0.4 - entry["mce"]
    trade = figures.search_figure([search], "", "path", {"pca": "The <prior> $1"}).axes[2]
    assert trade.get_xlabel() == "Roughness of the field"
    curve, star = trade.get_lines()[1:]
    np.testing.assert_allclose(curve.get_xdata(), [0.2, 0.3, 0.1])
    np.testing.assert_allclose((star.get_xdata(), star.get_ydata()), ([0.3], [0.1]))
    assert lines(trade)["λ = 0"].get_ydata() == [pytest.approx(0.2)]


def test_training_figure_draws_what_there_is():
    step = np.arange(10)
    validation = np.where(step % 5 == 0, 1.0 + step, np.nan)
    histories = {
        "lambda0": pd.DataFrame({"step": step, "loss": 1.0 + step, "penalty": 0.0}),
        "pca": pd.DataFrame({"step": step, "loss": 2.0 + step, "validation_cd": validation}),
    }
    figure = figures.training_figure(histories, "Stage 2", "synthetic")
    shown = [axes for axes in figure.axes if axes.get_visible()]
    titles = [axes.get_title() for axes in shown]
    assert titles == ["Training loss", "Prior penalty", "validation_cd"]
    assert list(lines(shown[2])["DINE-PCA"].get_xdata()) == [0, 5]
    assert [axes.get_yscale() for axes in shown] == ["log", "linear", "log"]
    known = {"pca": pd.DataFrame({"step": [0, 1], "val_cd": [1.0, 2.0]})}
    once = figures.training_figure(known, "", "synthetic").axes
    assert [axes.get_title() for axes in once] == ["Validation Chamfer distance"]
    with pytest.raises(DataError, match="no values to plot"):
        figures.training_figure({"pca": pd.DataFrame({"step": step})}, "", "synthetic")


def test_pca_spectrum_counts_components():
    ratio = np.array([0.5, 0.3, 0.15])
    _, right = figures.pca_spectrum_figure(10 * ratio, ratio, "Prior", "synthetic").axes
    np.testing.assert_allclose(right.get_lines()[0].get_ydata(), [50, 80, 95])
    assert right.get_title() == "90 % with 3 of 3 components"
    _, right = figures.pca_spectrum_figure(ratio[:2], ratio[:2], "Prior", "synthetic").axes
    assert right.get_title() == "80.0 % with all 2 components"


def test_pca_modes_are_drawn_at_two_standard_deviations(tmp_path):
    rng = np.random.default_rng(2)
    source = rng.normal(size=(30, 3))
    modes = rng.normal(size=(2, 30, 3))
    figure = views.pca_modes_figure(
        np.full((30, 3), 0.1), modes, np.array([4.0, 0.25]), source, "Modes", "synthetic"
    )
    panels = figure.axes[:-1]
    assert [axes.get_title() for axes in panels] == [
        *("Mode 1, −2 sd", "Mode 2, −2 sd", "Mode 1, +2 sd", "Mode 2, +2 sd")
    ]
    low, high = (
        np.stack(axes.collections[0]._offsets3d, axis=1) for axes in (panels[0], panels[2])
    )
    # Rotation keeps lengths: the two ends lie twice 2 · sqrt(4) mode lengths apart.
    np.testing.assert_allclose(
        np.linalg.norm(high - low, axis=1), 8 * np.linalg.norm(modes[0], axis=1)
    )
    np.testing.assert_allclose(
        panels[3].collections[0].get_array(), np.linalg.norm(modes[1], axis=1)
    )
    assert "synthetic data" in all_text(figure)
    figures.save_figure(figure, tmp_path / "modes")


def test_methods_differ_in_colour_and_marker():
    styles = figures.method_styles(["stage1", "lambda0", "pca", "flow"])
    assert len({to_hex(colour) for colour, _ in styles.values()}) == 4
    assert len({marker for _, marker in styles.values()}) == 4


def test_figures_are_white_whatever_the_style(tmp_path):
    with matplotlib.rc_context({"figure.facecolor": "black", "savefig.facecolor": "black"}):
        png, _ = figures.save_figure(
            figures.new_figure(2, 2, "Title", "synthetic"), tmp_path / "figure"
        )
    with Image.open(png) as image:
        assert image.convert("RGB").getpixel((0, 0)) == (255, 255, 255)
