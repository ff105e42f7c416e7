"""Every metric against a closed form or a naive computation."""

import h5py
import numpy as np
import pandas as pd
import pytest
from samples import POINTS, ball, make_pairs, write_predictions

from dine.data.corruption import make_variant
from dine.data.pairs import (
    Variant,
    read_pairs,
    read_variant_subset,
    write_pairs,
    write_variant,
)
from dine.errors import DataError
from dine.evaluation.metrics import Labels, evaluate
from dine.evaluation.predictions import Prediction, read_predictions
from dine.evaluation.quality import correspondence
from dine.geometry.distance import chamfer, distance_measures, distances, surface_distance
from dine.geometry.folding import folding, neighbourhoods, roughness
from dine.reporting.loading import load_metrics
from dine.reporting.table import to_latex, to_markdown
from dine.reporting.tables import all_tables

pytestmark = pytest.mark.numerical
# ------------------------------------------------------------------------------------ measures


def test_distances_to_hand_made_clouds():
    a = np.array([[0.0, 0, 0], [1, 0, 0]])
    b = np.array([[0.0, 3, 4], [0, 0, 0], [1, 0, 2]])
    assert distances(a, b).tolist() == [0, 1]
    assert distances(b, a).tolist() == [5, 0, 2]
    found = surface_distance(a, b)
    assert found["hausdorff"] == 5
    assert found["chamfer"] == chamfer(a, b) == pytest.approx(1 / 2 + 29 / 3)
    assert found["chamfer_unsquared"] == pytest.approx(1 / 2 + 7 / 3)
    # Of 0, 2 and 5 with linear interpolation; the other direction's is smaller.
    assert found["hd95"] == pytest.approx(2 + 0.9 * 3)
    assert surface_distance(a, b, shown=(0, 1))["chamfer"] == pytest.approx(29 / 3)
    # The farthest of three target points is not held against the others.
    assert surface_distance(a, b, shown=(1, 2 / 3))["chamfer"] == pytest.approx(1 / 2 + 4 / 2)


def test_hd95_forgives_what_hausdorff_does_not():
    line = np.zeros((100, 3))
    line[:, 0] = np.arange(100)
    away = line.copy()
    away[-1, 1] = 50
    found = surface_distance(line, away)
    assert found["hausdorff"] == 50
    assert found["hd95"] == 0
    assert distance_measures(np.zeros(3), np.full(3, 2.0))["hd95"] == 2


def test_correspondence_errors_are_counted_by_thresholds():
    target = np.zeros((4, 3))
    moved = np.array([[0.05, 0, 0], [0, 0.06, 0], [0, 0, 0.1], [0.3, 0, 0.4]])
    found = correspondence(moved, target)
    assert found["mce"] == pytest.approx((0.05 + 0.06 + 0.1 + 0.5) / 4)
    assert found["mce_median"] == pytest.approx(0.08)
    assert found["mce_p95"] == pytest.approx(np.percentile([0.05, 0.06, 0.1, 0.5], 95))
    assert found["accuracy_2_5"] == 0.25
    assert found["accuracy_5"] == 0.75
    assert found["far_points"] == 0.25


def test_a_translation_neither_folds_nor_strains():
    points = ball(np.random.default_rng(0), POINTS)
    shift = np.array([0.1, 0.2, -0.2])
    found = correspondence(points + shift, points)
    for name in ("mce", "mce_median", "mce_p95"):
        assert found[name] == pytest.approx(0.3)
    field = np.broadcast_to(shift, points.shape)
    assert folding(points, field) == 0
    assert roughness(points, field) == pytest.approx(0, abs=1e-12)


def test_a_reflection_folds_everywhere():
    points = ball(np.random.default_rng(0), POINTS)
    assert folding(points, points * [-1, 1, 1] - points) == 1
    assert folding(points, -2 * points) == 1


def test_roughness_is_the_strain():
    points = ball(np.random.default_rng(0), POINTS)
    # ‖d_i − d_j‖ = s ‖x_i − x_j‖ for a stretch, 2 sin(φ/2) ‖x_i − x_j‖ in the plane of a turn.
    assert roughness(points, 0.3 * points) == pytest.approx(0.3)
    flat = points * [1, 1, 0]
    c, s = np.cos(0.2), np.sin(0.2)
    turned = flat @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    assert roughness(flat, turned - flat) == pytest.approx(2 * np.sin(0.1))


def test_roughness_and_neighbours_against_loops():
    rng = np.random.default_rng(0)
    points, field = ball(rng, 40), rng.normal(size=(40, 3))
    neighbours = neighbourhoods(points)
    ratios = []
    for i in range(40):
        away = np.linalg.norm(points - points[i], axis=1)
        nearest = np.argsort(away)[1:13]
        assert set(neighbours[i]) == set(nearest)
        ratios += [((field[i] - field[j]) ** 2).sum() / away[j] ** 2 for j in nearest]
    assert roughness(points, field) == pytest.approx(np.sqrt(np.mean(ratios)))
    assert roughness(points, field, neighbours) == roughness(points, field)
    assert folding(points, field, neighbours) == folding(points, field)


def test_few_or_coinciding_points_have_no_strain():
    assert roughness(np.zeros((1, 3)), np.ones((1, 3))) == 0
    assert folding(np.zeros((1, 3)), np.ones((1, 3))) == 0
    assert roughness(np.zeros((5, 3)), np.eye(5)[:, :3]) == 0
    twice = np.repeat(ball(np.random.default_rng(0), 20), 2, axis=0)
    assert roughness(twice, 0.5 * twice) == pytest.approx(0.5)


# ----------------------------------------------------------------------------------- evaluation


@pytest.fixture
def stored(tmp_path):
    path = tmp_path / "pairs.h5"
    write_pairs(path, make_pairs())
    return read_pairs(path)


def run(tmp_path, predictions, variants=(), **arguments):
    write_predictions(tmp_path / "p.h5", predictions)
    method = arguments.pop("method", "m")
    evaluate(
        *({method: tmp_path / "p.h5"}, tmp_path / "pairs.h5", list(variants)),
        *(tmp_path / "m.csv", tmp_path / "e.h5"),
        labels=Labels(**{"dataset": "d", "backbone": "b"} | arguments),
    )
    return pd.read_csv(tmp_path / "m.csv")


def test_predictions_go_there_and_back(tmp_path, stored):
    rng = np.random.default_rng(0)
    field = rng.random((3, POINTS, 3), np.float32)
    spread = rng.random((3, POINTS), np.float32)
    seconds = np.array([0.1, 0.2, 0.3])
    whole = Prediction("deformation", 0.0, stored.name, field, spread, seconds)
    some = Prediction("noise", 0.01, stored.name[:1], field[:1])
    write_predictions(tmp_path / "p.h5", [some, whole])
    found = read_predictions(tmp_path / "p.h5")
    assert [p.condition for p in found] == ["deformation", "noise"]
    np.testing.assert_array_equal(found[0].displacement, field)
    np.testing.assert_array_equal(found[0].spread, spread)
    np.testing.assert_array_equal(found[0].seconds, seconds)
    assert found[0].spread.dtype == np.float32
    assert found[1].pair.tolist() == [stored.name[0]]
    assert found[1].spread is found[1].seconds is None
    with h5py.File(tmp_path / "p.h5") as file:
        for name in ("displacement", "spread", "seconds"):
            assert file["1"][name].fletcher32
            assert file["1"][name].attrs["description"]


def test_a_perfect_field_has_no_error(tmp_path, stored):
    found = run(tmp_path, [Prediction("deformation", 0.0, stored.name, stored.displacement)])
    zero = ["cd", "cd_observed", "mce", "cd_unsquared", "hd95", "hausdorff", "mce_median"]
    zero += ["mce_p95", "far_points", "folding", "mce_original"]
    assert found[zero].max(axis=None) == pytest.approx(0, abs=1e-5)
    assert (found[["accuracy_2_5", "accuracy_5"]] == 1).all(axis=None)
    assert found["roughness"].tolist() == pytest.approx(found["roughness_true"].tolist(), rel=1e-5)
    assert (found["roughness_true"] > 0.1).all()


def test_columns_keep_their_names_and_order(tmp_path, stored):
    prediction = Prediction("deformation", 0.0, stored.name, stored.displacement)
    found = run(tmp_path, [prediction], seed=3)
    assert found["seed"].tolist() == [3] * 3
    assert found.columns.tolist() == [
        *("dataset", "backbone", "method", "seed", "origin", "pair", "object", "objects"),
        *("cluster", "level", "condition", "corruption", "cd", "cd_observed", "cd_unregistered"),
        *("mce", "cd_unsquared", "hd95", "hausdorff", "mce_median", "mce_p95", "accuracy_2_5"),
        *("accuracy_5", "far_points", "folding", "roughness", "roughness_true", "mce_original"),
        "seconds",
    ]


def test_rows_say_whether_their_object_is_known_and_what_is_drawn_together(tmp_path, stored):
    fields = np.zeros((3, POINTS, 3), np.float32)
    found = run(tmp_path, [Prediction("deformation", 0.0, stored.name, fields)])
    assert found["objects"].tolist() == ["unseen"] * 3
    assert found["cluster"].astype(str).tolist() == ["0", "1", "2"]


def test_every_column_of_a_row_against_naive_computations(tmp_path, stored):
    rng = np.random.default_rng(1)
    field = (stored.displacement + 0.05 * rng.normal(size=(3, POINTS, 3))).astype(np.float32)
    seconds = np.array([1.0, 2.0, 4.0])
    found = run(
        tmp_path, [Prediction("deformation", 0.0, stored.name, field, None, seconds)], seed=7
    )
    for i, row in enumerate(found.itertuples()):
        source, target = stored.source[i].astype(float), stored.target[i].astype(float)
        moved = source + field[i]
        table = np.linalg.norm(moved[:, None] - target[None], axis=2)
        there, back = table.min(axis=1), table.min(axis=0)
        errors = np.linalg.norm(moved - target, axis=1)
        expected = {
            "cd": (there**2).mean() + (back**2).mean(),
            "cd_unsquared": there.mean() + back.mean(),
            "hd95": max(np.percentile(there, 95), np.percentile(back, 95)),
            "hausdorff": max(there.max(), back.max()),
            "mce": errors.mean(),
            "mce_median": np.median(errors),
            "mce_p95": np.percentile(errors, 95),
            "accuracy_2_5": (errors <= 0.05).mean(),
            "accuracy_5": (errors <= 0.1).mean(),
            "far_points": (errors > 0.1).mean(),
            "folding": folding(source, field[i].astype(float)),
            "roughness": roughness(source, field[i].astype(float)),
            "roughness_true": roughness(source, target - source),
            "mce_original": errors.mean() * stored.scale[i],
            "seconds": seconds[i],
        }
        for name, value in expected.items():
            assert getattr(row, name) == pytest.approx(value, rel=1e-6), name
        # In the units of the files it is the error there, too.
        original = stored.to_original(moved, i) - stored.to_original(target, i)
        assert row.mce_original == pytest.approx(np.linalg.norm(original, axis=1).mean())
        assert row.accuracy_5 + row.far_points == pytest.approx(1)
        assert row.roughness > row.roughness_true
        assert row.cd_observed == row.cd
    with h5py.File(tmp_path / "e.h5") as file:
        assert file["deformation/squared_distance"][2].mean() == pytest.approx((there**2).mean())


def test_predictions_and_variants_may_be_of_some_pairs(tmp_path, stored):
    names = stored.name[[2, 0]]
    noise = make_variant(stored.select(index=[0, 2]), "noise", 0.02, seed=0)
    rng = np.random.default_rng(2)
    other = np.stack([ball(rng, 50) for _ in range(2)])
    resampled = Variant("resampled", 1.0, other, np.ones((2, 50), bool), stored.name[[2, 1]])
    for name, variant in (("noise", noise), ("resampled", resampled)):
        write_variant(tmp_path / f"{name}.h5", variant, stored.checksum)
    files = [tmp_path / "noise.h5", tmp_path / "resampled.h5"]
    fields = np.zeros((3, POINTS, 3), np.float32)
    found = run(
        tmp_path,
        [
            Prediction("deformation", 0.0, stored.name, fields),
            Prediction("noise", 0.02, names, fields[:2]),
            Prediction("resampled", 1.0, stored.name[1:2], fields[:1]),
        ],
        files,
    )
    assert found["condition"].tolist() == ["deformation"] * 3 + ["noise"] * 2 + ["resampled"]
    assert found["pair"].tolist() == [*stored.name, *names, stored.name[1]]
    assert found["seconds"].isna().all()
    for row in found.itertuples():
        index = stored.name.tolist().index(row.pair)
        seen = {
            "deformation": stored.target[index],
            "noise": noise.target[index // 2],
            "resampled": other[1],
        }[row.condition]
        assert row.cd_observed == pytest.approx(chamfer(stored.source[index], seen), rel=1e-5)
        assert row.cd == pytest.approx(row.cd_unregistered)
    with h5py.File(tmp_path / "e.h5") as file:
        assert set(file) == {"deformation", "noise_0.02", "resampled_1"}
        assert file["noise_0.02/pair"].asstr()[:].tolist() == names.tolist()


def test_predictions_that_do_not_fit_are_refused(tmp_path, stored):
    fields = np.zeros((3, POINTS, 3), np.float32)
    some = make_variant(stored.select(index=[0, 2]), "noise", 0.02, seed=0)
    write_variant(tmp_path / "v.h5", some, stored.checksum)
    noisy = Prediction("noise", 0.02, stored.name, fields)
    with pytest.raises(DataError, match="no variant file was given"):
        run(tmp_path, [noisy])
    with pytest.raises(DataError, match=r"unknown to the variant file of noise_0\.02"):
        run(tmp_path, [noisy], [tmp_path / "v.h5"])
    with pytest.raises(DataError, match=r"the pair 'x', unknown to .*pairs\.h5"):
        run(tmp_path, [Prediction("deformation", 0.0, np.array(["x"]), fields[:1])])
    with pytest.raises(DataError, match=r"fields of 150 points, but .* has 200"):
        run(tmp_path, [Prediction("deformation", 0.0, stored.name, fields[:, :150])])


def test_subsets_of_variants(tmp_path, stored):
    path = tmp_path / "v.h5"
    noise = make_variant(stored.select(index=[2, 0]), "noise", 0.02, seed=0)
    write_variant(path, noise, stored.checksum)
    some, variant = read_variant_subset(path, stored)
    assert some.name.tolist() == variant.name.tolist() == stored.name[[0, 2]].tolist()
    np.testing.assert_array_equal(variant.target, noise.target[::-1])
    np.testing.assert_array_equal(some.source, stored.source[[0, 2]])
    some, variant = read_variant_subset(path, stored.select(index=[2]))
    assert some.name.tolist() == variant.name.tolist() == stored.name[[2]].tolist()
    with pytest.raises(DataError, match="none of them"):
        read_variant_subset(path, stored.select(index=[1]))
    write_variant(path, noise, "of others")
    with pytest.raises(DataError, match=r"v\.h5 was made from other pairs"):
        read_variant_subset(path, stored)


def test_resampled_rows_break_no_table(tmp_path, stored):
    other = np.stack([ball(np.random.default_rng(2), 50)] * 3)
    resampled = Variant("resampled", 1.0, other, np.ones((3, 50), bool), stored.name)
    write_variant(tmp_path / "v.h5", resampled, stored.checksum)
    fields = np.zeros((3, POINTS, 3), np.float32)
    files = []
    for method in ("stage1", "lambda0", "pca"):
        run(
            tmp_path,
            [
                Prediction("deformation", 0.0, stored.name, fields),
                Prediction("resampled", 1.0, stored.name, fields),
            ],
            [tmp_path / "v.h5"],
            **{"dataset": "synbench", "backbone": "robust_defreg", "method": method},
        )
        files.append((tmp_path / "m.csv").rename(tmp_path / f"{method}.csv"))
    metrics = load_metrics(files)
    made = {table.name: table for table in all_tables(metrics)}
    more = ["corruption_synbench", "gains_synbench", "observed_synbench"]
    more += ["correspondence_synbench"]
    assert set(made) == {"table2", *more}
    paper = made["table2"].data
    assert set(paper["condition"]) == {"deformation"}
    for name in more:
        labels = [[cell.text for cell in row] for row in made[name].rows]
        assert any("Other points" in row for row in labels)
    alone = metrics[metrics["condition"] == "resampled"]
    names = [table.name for table in all_tables(alone)]
    assert names == more
    for table in made.values():
        assert to_markdown(table)
        assert to_latex(table)
