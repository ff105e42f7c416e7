"""Two scans in, one registration out."""

import dataclasses
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch
import trimesh
from commands import run

import dine
from dine.data.pairs import PAIR_DATASETS, PairSet, Variant, read_pairs, write_pairs, write_variant
from dine.errors import CheckpointError, ConfigError, DataError, DineError
from dine.geometry.distance import landmark_errors, surface_distance
from dine.geometry.folding import folding
from dine.geometry.frame import Frame
from dine.geometry.rigid import Alignment, check_rigid, rigid_alignment, transformed
from dine.geometry.surface import Surface
from dine.io.readers import read_surface
from dine.io.writers import write_moved, write_surface
from dine.models.backbones import BACKBONES
from dine.models.checkpoint import save_backbone
from dine.priors import GaussianProcessPrior, PCAPrior
from dine.refinement.refine import ROUNDS
from dine.registration import register as register_module
from dine.registration.assessment import DOUBTFUL, GOOD, IMPLAUSIBLE, assess
from dine.registration.calibration import Calibration, load_calibration, plausibility
from dine.registration.model import load_model
from dine.registration.shapes import checked_landmarks, near_points

pytestmark = pytest.mark.numerical
POINTS = 1024


def bump(vertices):
    """A smooth synthetic deformation: stretched and bent."""
    x, _, z = vertices.T
    return vertices + np.column_stack([0.1 * x, 0.15 * z**2, 0.2 * x**2])


KNOBS = np.array([[1, 0.2, 0], [-0.6, 0.7, 0.4], [0, -1, 0.3], [0.3, 0.2, -0.9], [-0.5, -0.4, 0.8]])


def organ(subdivisions=3):
    """A closed mesh with knobs, without symmetry."""
    mesh = trimesh.creation.icosphere(subdivisions=subdivisions)
    knobs = KNOBS / np.linalg.norm(KNOBS, axis=1, keepdims=True)
    squared = ((mesh.vertices[:, None] - knobs) ** 2).sum(axis=2)
    radius = 1 + (np.exp(-squared / 0.12) * [0.9, 0.6, 0.8, 0.5, 0.7]).sum(axis=1)
    return Surface(mesh.vertices * radius[:, None] * [1, 0.8, 0.7], mesh.faces, name="organ")


@pytest.fixture(scope="module")
def pair():
    source = organ()
    return source, Surface(bump(source.vertices), source.faces, name="deformed organ")


@pytest.fixture(scope="module")
def result(pair):
    return dine.register(*pair, points=POINTS)


@pytest.fixture(scope="module")
def coarse(pair):
    """Of the points alone, which takes a third of the time."""
    return dine.register(*pair, points=POINTS, surfaces=False)


def turned(degrees=40.0):
    matrix = trimesh.transformations.rotation_matrix(np.radians(degrees), [0.3, 1, 0.2])
    matrix[:3, 3] = [0.5, -0.2, 0.3]
    return matrix


# --- parts ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("degrees", [0, 20, 160])
def test_alignment_finds_a_rigid_motion(degrees):
    points = organ().vertices
    matrix = turned(degrees)
    rng = np.random.default_rng(0)
    target = transformed(points, matrix)[rng.permutation(len(points))]
    found = rigid_alignment(points, target)
    assert np.abs(transformed(points, found) - transformed(points, matrix)).max() < 0.02


def test_alignment_leaves_what_fits_already():
    points = organ().vertices
    assert np.abs(rigid_alignment(points, points) - np.eye(4)).max() < 1e-6


@pytest.mark.parametrize("size", [1e4, 1e-4])
def test_alignment_does_not_depend_on_units(size):
    points = organ().vertices
    target = transformed(bump(points), turned(25))
    known, found = (rigid_alignment(s * points[::3], s * target[1::3]) for s in (1, size))
    assert np.allclose(found[:3, :3], known[:3, :3], atol=1e-6)
    assert np.allclose(found[:3, 3], size * known[:3, 3], atol=1e-6 * size)


def test_points_apart_from_all_others_are_told_from_an_object():
    rng = np.random.default_rng(0)
    cloud = organ().vertices
    stray = np.array([[5.0, 1, 1], [5.1, 1, 1], [-90, 0, 0]])
    assert near_points(np.concatenate([cloud, stray])).tolist() == [True] * len(cloud) + [False] * 3
    # Whatever its density, and however few points it has.
    dense = np.concatenate([cloud, 0.02 * rng.normal(size=(5000, 3)) + cloud[0]])
    assert near_points(dense).all()
    assert near_points(rng.normal(size=(16, 3))).all()
    assert near_points(np.zeros((3, 3))).all()


def test_a_single_far_point_changes_nothing(pair):
    source, target = (surface.vertices for surface in pair)
    far = np.array([[100.0, 20, -30]])
    known = dine.register(source, target, points=POINTS)
    for clouds in (
        (np.concatenate([source, far]), target),
        (source, np.concatenate([target, far])),
    ):
        found = dine.register(*clouds, points=POINTS)
        assert np.allclose(found.moved.vertices[: len(source)], known.moved.vertices)


@pytest.mark.parametrize(
    "matrix", [np.eye(3), 2 * np.eye(4), np.diag([-1.0, 1, 1, 1]), np.full((4, 4), np.nan)]
)
def test_only_rigid_matrices_are_taken(matrix):
    with pytest.raises(DataError, match=r"4×4|scales, shears or mirrors"):
        check_rigid(matrix)


def test_frame_goes_there_and_back():
    points = 1000 * np.random.default_rng(1).normal(size=(50, 3)) + 7
    frame = Frame.of(points)
    inside = frame.normalise(points)
    assert np.linalg.norm(inside, axis=1).max() == pytest.approx(1)
    assert np.allclose(frame.restore(inside), points)


def test_an_alignment_goes_there_and_back():
    points = 100 * np.random.default_rng(1).normal(size=(50, 3)) + 7
    alignment = Alignment.of(points, turned())
    assert np.allclose(alignment.align(points), transformed(points, turned()))
    assert np.allclose(alignment.unalign(alignment.align(points)), points)
    inside = alignment.normalise(points)
    assert np.linalg.norm(inside, axis=1).max() == pytest.approx(1)
    assert np.allclose(alignment.restore(inside), alignment.align(points))


def test_surface_distance_is_what_its_names_say():
    rng = np.random.default_rng(2)
    a, b = rng.normal(size=(2, 40, 3))
    table = np.linalg.norm(a[:, None] - b[None], axis=2)
    there, back = table.min(axis=1), table.min(axis=0)
    found = surface_distance(a, b)
    assert found["chamfer"] == pytest.approx((there**2).mean() + (back**2).mean())
    assert found["chamfer_unsquared"] == pytest.approx(there.mean() + back.mean())
    assert found["hausdorff"] == pytest.approx(max(there.max(), back.max()))
    expected = max(np.percentile(there, 95), np.percentile(back, 95))
    assert found["hd95"] == pytest.approx(expected)
    assert surface_distance(a, b, shown=(0, 1))["chamfer"] == pytest.approx((back**2).mean())


def test_folding_is_the_share_turned_inside_out():
    points = organ().vertices
    assert folding(points, np.zeros_like(points)) == 0
    assert folding(points, bump(points) - points) == 0
    assert folding(points, 0.3 * points + 1) == 0
    mirrored = points * [-1, 1, 1]
    assert folding(points, mirrored - points) > 0.5
    half = np.where(points[:, :1] > 0, mirrored, points)
    assert 0.1 < folding(points, half - points) < 0.9
    assert folding(points[:3], points[:3]) == 0


def test_landmark_errors_are_distances():
    a = np.zeros((2, 3))
    assert landmark_errors(a, np.array([[3.0, 4, 0], [0, 0, 1]])) == {"mean": 3.0, "max": 5.0}


def calibration(**facts):
    reference = {"initial": [1, 2, 3], "final": [0.1, 0.2], "folding": [0.0, 0.001]}
    reference |= {"in_span": [1, 2], "residual": [1, 2], "reach": [0.5, 1.0]}
    return Calibration([0.1, 0.2], [0.01, 0.05], [0.02, 0.1], reference, facts)


def test_calibration_interpolates_and_ranks(tmp_path):
    made = calibration(points=3)
    assert made.expected_error(np.array([0.0, 0.15, 9.0])).tolist() == pytest.approx(
        [0.01, 0.03, 0.05]
    )
    assert made.percentile("initial", 2.5) == pytest.approx(200 / 3)
    made.save(tmp_path / "c.json")
    assert load_calibration(tmp_path / "c.json") == made
    (tmp_path / "d.json").write_text('{"format": "something"}')
    with pytest.raises(DataError, match="dine calibrate"):
        load_calibration(tmp_path / "d.json")


@pytest.mark.parametrize(
    ("values", "verdict", "said"),
    [
        ({"initial": 2.0, "final": 0.1, "folding": 0.0, "in_span": 1.5}, GOOD, None),
        ({"initial": 9.0}, DOUBTFUL, "before registration"),
        ({"final": 0.3}, DOUBTFUL, "fits the target worse"),
        ({"in_span": 90.0}, IMPLAUSIBLE, "less likely"),
        ({"in_span": 2.5, "residual": 2.5}, IMPLAUSIBLE, "principal components"),
        ({"folding": 0.3}, IMPLAUSIBLE, "inside out"),
        ({"folding": 0.07}, DOUBTFUL, "inside out"),
    ],
)
def test_verdicts(values, verdict, said):
    trust = assess(calibration(), values, 0.1)
    assert trust.verdict == verdict
    assert trust.reasons == () if said is None else said in " ".join(trust.reasons)


@pytest.mark.parametrize(
    ("checks", "said"),
    [
        ({"remaining": 0.4, "uncertain": 0.9, "inconsistency": 0.09}, None),
        ({"remaining": 0.6}, "60 % of the Chamfer distance before is left"),
        ({"uncertain": 1.1}, "expected error is larger than the displacement"),
        ({"inconsistency": 0.12}, "and back, points end up 12 % of"),
        ({"unmet": 0.14, "unsure": 0.05}, None),
        ({"unmet": 0.2}, "20 % of the surface does not come to lie on the other scan"),
        ({"unsure": 0.08}, "expected error is 8 % of the object's radius"),
    ],
)
def test_checks_make_a_result_doubtful(checks, said):
    trust = assess(calibration(), {"final": 0.1}, 0.1, checks=checks)
    assert trust.verdict == (GOOD if said is None else DOUBTFUL)
    assert trust.reasons == () if said is None else said in trust.reasons[0]


def test_without_calibration_nothing_is_called_plausible():
    trust = assess(None, {"folding": 0.0}, None)
    assert trust.verdict == DOUBTFUL
    assert "no calibration" in trust.reasons[0]


def test_plausibility_separates_inside_from_outside():
    rng = np.random.default_rng(3)
    modes = rng.normal(size=(4, 20, 3))
    fields = np.einsum("km,mnd->knd", rng.normal(size=(60, 4)), modes)
    prior = PCAPrior.fit(fields, components=4)
    source = rng.normal(size=(20, 3))
    inside = plausibility(prior, fields[0], source)
    outside = plausibility(prior, fields[0] + rng.normal(size=(20, 3)), source)
    assert inside["residual"] < 1e-6 < 0.01 < outside["residual"]
    assert plausibility(prior, 10 * fields[0], source)["in_span"] > 50 * inside["in_span"]
    assert plausibility(prior, fields[0][:10], source[:10]) is None
    on_sources = GaussianProcessPrior.fit(fields, source=np.stack([source] * 60), points=20)
    assert set(plausibility(on_sources, fields[0], source)) == {"in_span"}


# --- whole registrations --------------------------------------------------------------------------


def error(moved, target):
    return np.linalg.norm(moved.vertices - target.vertices, axis=1).mean()


def test_registration_brings_the_source_to_its_target(pair, result):
    source, target = pair
    assert error(result.moved, target) < 0.75 * error(source, target)
    assert result.report["after"]["hd95"] < result.report["before"]["hd95"]
    assert (result.moved.faces == source.faces).all()
    assert np.allclose(result.moved.vertices, source.vertices + result.displacement)
    assert result.supported.all()
    assert result.alignment.matrix.tolist() == result.report["alignment"]
    assert result.alignment.frame.scale == result.report["normalisation"]["scale"]
    json.dumps(result.report, allow_nan=False)


def test_units_and_place_do_not_matter(pair, result):
    moved = [Surface(1000 * s.vertices + 300, s.faces, name=s.name) for s in pair]
    found = dine.register(*moved, points=POINTS)
    assert np.allclose(found.moved.vertices, 1000 * result.moved.vertices + 300, atol=2)
    assert found.report["normalised"] == pytest.approx(result.report["normalised"], rel=0.05)


def test_the_same_seed_gives_the_same_result(pair, result, coarse):
    again = dine.register(*pair, points=POINTS)
    assert (again.moved.vertices == result.moved.vertices).all()
    other = dine.register(*pair, points=POINTS, seed=1, surfaces=False)
    assert (other.moved.vertices != coarse.moved.vertices).any()


def test_the_number_of_threads_does_not_matter(pair, result):
    before = torch.get_num_threads()
    torch.set_num_threads(3 if before == 1 else 1)
    try:
        other = dine.register(*pair, points=POINTS)
    finally:
        torch.set_num_threads(before)
    # Libraries may round otherwise.
    apart = np.abs(other.moved.vertices - result.moved.vertices).max()
    assert apart < 1e-4 * result.alignment.frame.scale
    np.testing.assert_allclose(other.uncertainty, result.uncertainty, rtol=1e-2)
    assert other.trust.verdict == result.trust.verdict


def test_a_turned_source_is_aligned_first(pair):
    source, target = pair
    away = Surface(transformed(source.vertices, turned()), source.faces)
    given = dine.register(away, target, points=POINTS, prealign=np.linalg.inv(turned()))
    assert error(given.moved, target) < 0.75 * error(source, target)
    found = dine.register(away, target, points=POINTS)
    # A bent object can be turned a little and still fit.
    assert error(found.moved, target) < 0.3 * error(away, target)
    off = dine.register(away, target, points=64, prealign="off", surfaces=False)
    assert off.report["alignment"] == np.eye(4).tolist()


def test_further_shapes_and_landmarks_move_along(pair):
    source, target = pair
    inside = Surface(0.9 * source.vertices[:40], name="tumour")
    marks = source.vertices[::50], target.vertices[::50]
    further = {"tumour": inside, "copy": source.vertices[:40]}
    found = dine.register(source, target, points=POINTS, apply=further, landmarks=marks)
    truth = bump(inside.vertices)
    after = np.linalg.norm(found.applied["tumour"].vertices - truth, axis=1).mean()
    assert after < np.linalg.norm(inside.vertices - truth, axis=1).mean()
    np.testing.assert_allclose(found.applied["copy"].vertices, found.moved.vertices[:40])
    assert found.report["landmarks"]["after"]["mean"] < found.report["landmarks"]["before"]["mean"]
    assert found.report["landmarks"]["count"] == len(marks[0])


def test_clouds_of_few_points_are_taken_whole(pair):
    source, target = (Surface(s.vertices[::4]) for s in pair)
    found = dine.register(source.vertices, target.vertices)
    assert len(found.points) == len(source.vertices) < 1024
    assert error(found.moved, target) < error(source, target)


def test_a_partial_target_pulls_only_what_it_shows(pair):
    source, target = pair
    shown = target.vertices[target.vertices[:, 0] > -0.1]
    pulled = dine.register(source, shown, points=POINTS, prealign="off")
    found = dine.register(source, shown, points=POINTS, prealign="off", partial=True)
    assert 0.3 < found.report["supported"] < 0.95
    assert "no counterpart" in " ".join(found.trust.reasons)
    assert error(found.moved, target) < 0.9 * error(pulled.moved, target)


def test_rounds_of_refinement_can_be_chosen(pair, result):
    plain = dine.register(*pair, points=POINTS, rounds=0)
    assert error(result.moved, pair[1]) < error(plain.moved, pair[1])
    assert plain.report["settings"]["rounds"] == 0


# --- bad input ------------------------------------------------------------------------------------

LINE = np.outer(np.linspace(0, 1, 100), [1, 2, 3])


@pytest.mark.parametrize(
    ("source", "said"),
    [
        (np.zeros((1, 3)), "the source, coincide"),
        (np.ones((50, 3)) / 3, "coincide"),
        (np.random.default_rng(5).normal(size=(8, 3)), "distinct points"),
        (LINE, "on one line"),
        (np.full((50, 3), np.nan), "NaN"),
        (np.zeros((50, 2)), "shape"),
        (np.zeros((0, 3)), "no vertices"),
        (1000 * np.random.default_rng(6).normal(size=(200, 3)), "metres and the other in milli"),
        (25.4 * np.random.default_rng(6).normal(size=(200, 3)), "inches"),
    ],
)
def test_bad_shapes_are_refused(source, said):
    with pytest.raises(DataError, match=said):
        dine.register(source, np.random.default_rng(7).normal(size=(200, 3)))


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"prealign": "perhaps"}, "auto, off"),
        ({"points": 3}, "at least"),
        ({"rounds": -1}, "rounds"),
        ({"landmarks": (np.zeros((2, 3)), np.zeros((3, 3)))}, "landmarks"),
    ],
)
def test_bad_settings_are_refused(pair, settings, said):
    with pytest.raises(DineError, match=said):
        dine.register(*pair, **{"points": POINTS, **settings})


def test_objects_without_anything_in_common_are_not_called_plausible(pair, coarse):
    source = pair[0]
    plate = np.random.default_rng(8).uniform(-1, 1, size=(2000, 3)) * [1.5, 1.5, 0.01]
    for surfaces in (True, False):
        found = dine.register(source, plate, points=POINTS, surfaces=surfaces)
        assert found.trust.verdict != GOOD
    assert "and back" in " ".join(found.trust.reasons)
    inconsistency = [x.report["trust"]["checks"]["inconsistency"] for x in (coarse, found)]
    assert inconsistency[0] < 0.1 < inconsistency[1]


def test_a_target_beside_the_source_is_not_called_plausible():
    points = np.random.default_rng(12).normal(size=(200, 3))
    found = dine.register(points, points + 100, prealign="off")
    assert found.trust.verdict == IMPLAUSIBLE
    assert "of the Chamfer distance before is left" in " ".join(found.trust.reasons)


def test_inches_and_centimetres_are_told_apart():
    points = np.random.default_rng(13).normal(size=(200, 3)) * [1, 0.8, 0.6]
    found = dine.register(points, points * 2.54)
    assert found.trust.verdict != GOOD
    assert "2.5 times larger" in found.trust.reasons[0]
    assert "in inches and the other in centimetres" in found.trust.reasons[0]


def test_points_alone_cannot_say_that_nothing_moves(pair):
    source = pair[0]
    target = Surface(source.vertices + 1e-3, source.faces)
    found = dine.register(source, target, points=POINTS)
    assert np.linalg.norm(found.moved.vertices - target.vertices, axis=1).mean() < 4e-3
    found = dine.register(source, target, points=POINTS, surfaces=False)
    assert found.report["trust"]["checks"]["remaining"] > 0.5
    assert found.trust.verdict == DOUBTFUL
    assert "may be noise" in " ".join(found.trust.reasons)


def test_weights_must_fit(tmp_path):
    other = tmp_path / "w.safetensors"
    save_backbone(other, BACKBONES.get("deftransnet")())
    with pytest.raises(ConfigError, match="holds weights of deftransnet"):
        load_model("robust_defreg", weights=other)
    assert load_model(weights=other).backbone.registered_name == "deftransnet"
    other.write_bytes(b"nothing")
    with pytest.raises(CheckpointError):
        load_model(weights=other)
    with pytest.raises(ConfigError, match="'unheard_of', only for deftransnet and robust_defreg"):
        load_model("unheard_of")


def test_a_calibration_of_other_weights_is_refused(tmp_path):
    calibration(model="another").save(tmp_path / "c.json")
    with pytest.raises(DataError, match="another model"):
        load_model(calibration=tmp_path / "c.json")


def test_a_calibration_with_another_prior_is_refused(tmp_path):
    other = tmp_path / "prior.safetensors"
    PCAPrior.fit(np.random.default_rng(11).normal(size=(4, 1024, 3))).save(other)
    with pytest.raises(DataError, match="another prior"):
        load_model(prior=other)


def test_a_calibration_counts_only_where_it_applies(pair, result, coarse):
    assert result.trust.expected_error > 0
    assert "in_span" in result.trust.percentiles
    others = ({"rounds": 3}, {"partial": True})
    for found in (coarse, *(dine.register(*pair, points=POINTS, **other) for other in others)):
        assert found.trust.expected_error is None
        assert found.uncertainty is None
        assert not found.trust.percentiles
        assert "no calibration" in " ".join(found.trust.reasons)
    # Without one the prior still measures the field, but there is nothing to compare that with.
    alone = dataclasses.replace(load_model(), calibration=None)
    other = dine.register(*pair, points=POINTS, model=alone, surfaces=False)
    assert "in_span" in other.report["normalised"]
    assert not other.trust.percentiles


@pytest.mark.parametrize("kind", ["one far away", "an uncompacted crop", "a line"])
def test_vertices_without_faces_take_no_part(pair, result, kind):
    source, _ = pair
    strays = {
        "one far away": np.full((1, 3), 1e6),
        "an uncompacted crop": source.vertices + np.array([5, 0, 0]),
        "a line": np.linspace(0, 1e3, 5000)[:, None] * [1, 0, 0],
    }[kind]
    more = [Surface(np.vstack([x.vertices, strays]), x.faces, name=x.name) for x in pair]
    found = dine.register(*more, points=POINTS)
    count = len(source.vertices)
    assert len(found.moved.vertices) == count + len(strays)
    np.testing.assert_allclose(found.moved.vertices[:count], result.moved.vertices, atol=1e-6)
    assert found.trust.verdict == result.trust.verdict
    assert found.trust.reasons == result.trust.reasons
    largest = result.report["displacement"]["max"]
    assert found.report["displacement"]["max"] == pytest.approx(largest, rel=1e-6)


def test_landmarks_are_checked_before_anything_is_computed(pair, monkeypatch):
    monkeypatch.setattr(register_module, "correspondence_of", lambda *args: pytest.fail("computed"))
    points = pair[0].vertices[:5]
    for marks in ((points, points[:4]), (points[:, :2], points[:, :2])):
        with pytest.raises(DataError, match="expected as many rows of three coordinates"):
            dine.register(*pair, landmarks=marks)


def test_landmarks_of_slicer_come_into_the_space_of_their_scan(pair, tmp_path):
    source, target = pair
    head = "# Markups fiducial file version = 4.11\n# CoordinateSystem = {}\n# columns = id,x,y,z\n"
    for name, surface in zip(("a.fcsv", "b.fcsv"), pair, strict=True):
        rows = surface.vertices[:5] * [-1, -1, 1]
        lines = "".join("p,{},{},{}\n".format(*row) for row in rows.tolist())
        (tmp_path / name).write_text(head.format("RAS") + lines)
    files = tmp_path / "a.fcsv", tmp_path / "b.fcsv"
    for space in (None, "LPS"):  # 3D Slicer takes what is not stated for LPS
        scans = [dataclasses.replace(surface, space=space) for surface in pair]
        here, there = checked_landmarks(files, *scans)
        np.testing.assert_array_equal(here, source.vertices[:5])
        np.testing.assert_array_equal(there, target.vertices[:5])
    scans = [dataclasses.replace(surface, space="RAS") for surface in pair]
    here, _ = checked_landmarks(files, *scans)
    np.testing.assert_array_equal(here, source.vertices[:5] * [-1, -1, 1])


def test_scans_of_different_spaces_are_refused(pair):
    lps, ras = (dataclasses.replace(x, space=s) for x, s in zip(pair, ("LPS", "RAS"), strict=True))
    with pytest.raises(DataError, match="organ is in LPS and deformed organ in RAS; export both"):
        dine.register(lps, ras)
    with pytest.raises(DataError, match="is in LPS and deformed organ in RAS"):
        dine.register(lps, pair[1], apply={"other": ras})


# --- commands -------------------------------------------------------------------------------------


# For what does not depend on how well it is registered.
QUICK = ("--points", 64, "--no-surfaces")


@pytest.fixture
def files(tmp_path, pair):
    paths = tmp_path / "before.ply", tmp_path / "after scan.ply"
    for path, surface in zip(paths, pair, strict=True):
        write_surface(path, surface)
    return paths


def test_command_writes_everything(files, tmp_path, pair):
    out = tmp_path / "out" / "moved.obj"
    done = run("register", *files, "-o", out, "--points", POINTS, "--view", "--apply", files[0])
    assert done.exit_code == 0, done.output
    assert "HD95" in done.output
    endings = {"obj", "field.npz", "field.vtp", "result.npz", "json", "html", "before.ply"}
    assert {p.name.removeprefix("moved.") for p in out.parent.iterdir()} == endings
    # The page shows what moved along.
    assert 'id="show-further-0"' in out.with_suffix(".html").read_text(encoding="utf-8")
    moved = read_surface(out)
    assert (moved.faces == pair[0].faces).all()
    report = json.loads(out.with_suffix(".json").read_text())
    with np.load(out.with_suffix(".field.npz")) as field:
        assert np.allclose(field["points"] + field["displacement"], moved.vertices)
    assert np.allclose(read_surface(out.with_suffix(".before.ply")).vertices, moved.vertices)
    assert report["weights"]["sha256"]
    # The same settings as from Python, for which the shipped weights are calibrated.
    assert report["settings"]["rounds"] == ROUNDS
    assert report["trust"]["expected_error"] > 0


def test_command_tells_programs_and_the_log(files, tmp_path):
    """One JSON object on stdout and nothing else; what is printed otherwise is in the log."""
    out, log = tmp_path / "moved.ply", tmp_path / "log"
    options = ("--points", 64, "--json", "-q", "--apply", files[0])
    options += ("--grid", tmp_path / "moved.nrrd", "--grid-inverse", tmp_path / "moved.back.mha")
    options += ("--grid-spacing", 0.4)
    done = run("--log", log, "register", *files, "-o", out, *options)
    assert done.exit_code == 0, done.output
    told = json.loads(done.stdout)
    report = json.loads(out.with_suffix(".json").read_text())
    assert told["verdict"] == report["trust"]["verdict"]
    assert told["reasons"] == report["trust"]["reasons"]
    for name in ("before", "after", "displacement", "folding", "seconds"):
        assert told[name] == report[name]
    places = [place for place in told["files"].values() if isinstance(place, str)]
    written = {Path(place) for place in (*places, *told["files"]["applied"].values())}
    assert written == set(tmp_path.glob("moved.*"))
    assert {tmp_path / "moved.nrrd", tmp_path / "moved.back.mha"} <= written
    lines = log.read_text().splitlines()
    stages = ["reading", "alignment", "network", "points", "surfaces", "measures", "writing"]
    said = [line.split(" ", 1)[1] for line in lines]
    assert [name for name in dict.fromkeys(said) if name in stages] == stages
    assert any(line.startswith(f"{out}: HD95 ") for line in said)


def test_command_writes_further_shapes_as_they_can_be(files, tmp_path, pair):
    """Formats that are read but not written are written as the moved source is."""
    cloud = tmp_path / "marks.pts"
    cloud.write_text("20\n" + 20 * "0.1 0.2 0.3 9\n")
    vtk = tmp_path / "tumour.vtk"
    write_moved(vtk, pair[0])
    for suffix, expected in ((".ply", ".ply"), (".vtp", ".vtp"), (".stl", ".ply")):
        out = tmp_path / suffix[1:] / f"moved{suffix}"
        done = run("register", *files, "-o", out, *QUICK, "--apply", cloud, "--apply", vtk)
        assert done.exit_code == 0, done.output
        assert len(read_surface(out.with_suffix(f".marks{expected}")).vertices) == 20
        assert (read_surface(out.with_suffix(".tumour.vtk")).faces == pair[0].faces).all()
        assert "Not kept of marks.pts: column 4." in done.output


def test_command_keeps_what_is_known_of_vertices(files, tmp_path, pair):
    label = np.arange(len(pair[0].vertices)) % 7
    colors = np.full((len(label), 3), [1, 2, 3], dtype=np.uint8)
    data = {"label": label, "colors": colors}
    write_moved(files[0], dataclasses.replace(pair[0], data=data), overwrite=True)
    out = tmp_path / "moved.vtp"
    assert run("register", *files, "-o", out, *QUICK).exit_code == 0
    found = read_surface(out).data
    np.testing.assert_array_equal(found["label"], label)
    np.testing.assert_array_equal(found["colors"], colors)
    assert "distance_to_target" in found
    out = tmp_path / "other.obj"
    done = run("register", *files, "-o", out, *QUICK)
    assert "other.obj cannot hold: " in done.output
    assert "label" in done.output


def test_command_probes_its_output_first(files, tmp_path, monkeypatch):
    monkeypatch.setattr(register_module, "correspondence_of", lambda *args: pytest.fail("computed"))
    (tmp_path / "afile").write_text("precious")
    np.savetxt(tmp_path / "cloud.xyz", organ().vertices)
    for source, out, said in (
        (files[0], tmp_path / "afile" / "m.ply", "a part of the path is a file, not a folder"),
        (files[0], tmp_path / "afile" / "new" / "m.ply", "a part of the path is a file"),
        (files[0], tmp_path / f"{'n' * 300}.ply", "the name is too long"),
        (files[0], tmp_path / "new" / f"{'n' * 245}.ply", "the name is too long"),
        (tmp_path / "cloud.xyz", tmp_path / "m.stl", "STL holds triangles only"),
    ):
        done = run("register", source, files[1], "-o", out)
        assert isinstance(done.exception, DineError), done.output
        assert said in str(done.exception)
    if Path("/proc/self").exists():
        done = run("register", *files, "-o", "/proc/m.ply")
        assert isinstance(done.exception, DineError), done.output
        assert "no file can be made in /proc" in str(done.exception)
    for arguments in (
        ("fields", "--model", "m", "--pairs", "p", "--out", tmp_path / "afile" / "dvf.h5"),
        ("register-many", "pairs.csv", "-o", tmp_path / "afile" / "out"),
    ):
        done = run(*arguments)
        assert isinstance(done.exception, DineError)
        assert "a part of the path is a file" in str(done.exception)
    assert (tmp_path / "afile").read_text() == "precious"
    assert not (tmp_path / "new").exists()


def test_names_that_are_no_text(files, tmp_path):
    """Linux lets names be any bytes; they come out escaped wherever text is written."""
    odd = Path(os.fsdecode(os.fsencode(tmp_path) + b"/sc\xffan.ply"))
    try:
        files[0].rename(odd)
    except OSError:
        pytest.skip("this file system takes text only")
    out = odd.with_name(f"moved {odd.name}")
    command = [sys.executable, "-m", "dine", "--log", tmp_path / "log", "register", odd, files[1]]
    command += ["-o", out, "--view", *map(str, QUICK)]
    utf8 = os.environ | {"PYTHONIOENCODING": "utf-8:strict"}
    done = subprocess.run(command, capture_output=True, env=utf8)
    assert done.returncode == 0, done.stderr
    assert rb"moved sc\udcffan.ply: HD95" in done.stdout
    assert rb"sc\udcffan.ply" in out.with_suffix(".html").read_bytes()
    assert json.loads(out.with_suffix(".json").read_text())["source"]["name"] == str(odd)


def test_command_keeps_what_exists(files, tmp_path):
    out = tmp_path / "moved.ply"
    out.with_suffix(".json").write_text("precious")
    done = run("register", *files, "-o", out)
    assert isinstance(done.exception, DineError)
    assert "exists already; choose another name, or replace it (--overwrite" in str(done.exception)
    assert out.with_suffix(".json").read_text() == "precious"
    assert not out.exists()
    assert run("register", *files, "-o", out, *QUICK, "--overwrite").exit_code == 0


def test_command_refuses_unreadable_alignments_and_files(files, tmp_path):
    bad = tmp_path / "bad.txt"
    bad.write_text("1 2 3")
    for arguments in (
        (*files, "--prealign", bad),
        (*files, "--prealign", tmp_path / "none.txt"),
        (files[0], tmp_path / "none.ply"),
        (files[0], bad),
    ):
        done = run("register", *arguments, "-o", tmp_path / "m.ply", *QUICK)
        assert isinstance(done.exception, DineError), done.output
        assert not (tmp_path / "m.ply").exists()


def test_many_pairs_go_on_where_they_stopped(files, tmp_path):
    manifest = tmp_path / "pairs.csv"
    rows = [
        {"source": files[0].name, "target": files[1].name, "name": "first"},
        {"source": "missing.ply", "target": files[1].name, "name": "second"},
    ]
    pd.DataFrame(rows).to_csv(manifest, index=False)
    out = tmp_path / "many"
    arguments = ("register-many", manifest, "-o", out, *QUICK)
    assert run(*arguments).exit_code == 1
    summary = pd.read_csv(out / "summary.csv").set_index("name")
    assert summary["state"].to_dict() == {"first": "done", "second": "failed"}
    assert "missing.ply" in summary.loc["second", "message"]
    moved = out / "first" / "moved.ply"
    before = moved.stat().st_mtime_ns
    (tmp_path / "missing.ply").write_bytes(files[0].read_bytes())
    done = run("-q", *arguments, "--json")
    assert done.exit_code == 0
    told = json.loads(done.stdout)
    assert (told["registered"], told["failed"]) == (2, 0)
    assert told["pairs"][0]["verdict"] == summary.loc["first", "verdict"]
    assert told["pairs"][0]["hd95_after"] == pytest.approx(summary.loc["first", "hd95_after"])
    assert moved.stat().st_mtime_ns == before
    assert (pd.read_csv(out / "summary.csv")["state"] == "done").all()
    write_surface(files[0], Surface(organ().vertices * 1.1, organ().faces))
    assert run(*arguments).exit_code == 0
    assert moved.stat().st_mtime_ns > before


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ("source\na.ply\n", "column 'target'"),
        ("source,target\n,b.ply\n", "row 1"),
        ("source,target,name\na.ply,b.ply,../x\n", "row 1"),
        ("source,target,name\na.ply,b.ply,x\na.ply,b.ply,x\n", "name of its own"),
        ("source,target\n", "no pairs"),
    ],
)
def test_bad_manifests_are_refused(tmp_path, content, said):
    path = tmp_path / "pairs.csv"
    path.write_text(content)
    done = run("register-many", path, "-o", tmp_path / "out")
    assert isinstance(done.exception, DineError)
    assert said in str(done.exception)


def test_calibration_of_own_weights(tmp_path):
    rng = np.random.default_rng(9)
    faces, base = organ(2).faces, organ(2).vertices
    base = base / np.linalg.norm(base, axis=1).max()
    count, points = 12, len(base)
    scale = rng.uniform(0.3, 1.2, size=(count, 1, 1))
    source = np.repeat(base[None], count, axis=0)
    target = source + scale * (bump(base) - base)
    columns = {
        "source": source,
        "target": target,
        "center": np.zeros((count, 3)),
        "scale": np.ones(count),
        "level": np.full(count, 0.3),
        "name": np.array([f"p{i}" for i in range(count)]),
        "object": np.array([f"o{i}" for i in range(count)]),
        "split": np.array(["train"] * 4 + ["val"] * 4 + ["test"] * 4),
        "source_file": np.array(["a"] * count),
        "target_file": np.array(["b"] * count),
        "vertex_index": np.zeros((count, points, 3), int),
        "vertex_weight": np.tile([1.0, 0, 0], (count, points, 1)),
    }
    assert set(columns) == set(PAIR_DATASETS)
    pairs = tmp_path / "pairs.h5"
    write_pairs(pairs, PairSet(**columns, attributes={"convention": "none", "origin": "synthetic"}))
    weights = load_model().weights
    prior = tmp_path / "prior.safetensors"
    PCAPrior.fit(target[:4] - source[:4]).save(prior)
    out = tmp_path / "calibration.json"
    command = ("calibrate", "--model", weights, "--pairs", pairs, "--prior", prior, "--out", out)
    # Points that both clouds hold are matched exactly: nothing to learn errors from.
    assert "same points" in str(run(*command).exception)
    assert not out.exists()
    middles = target[:, faces[rng.choice(len(faces), points, replace=False)]].mean(axis=2)
    targets = tmp_path / "resampled.h5"
    known = np.ones(middles.shape[:2], bool)
    names = columns["name"]
    write_variant(
        targets, Variant("resampled", 1.0, middles, known, names), read_pairs(pairs).checksum
    )
    done = run(*command, "--targets", targets)
    assert done.exit_code == 0, done.exception
    found = load_calibration(out)
    assert (np.diff(found.error) >= 0).all()
    assert (np.diff(found.likely) >= 0).all()
    assert found.facts["convention"] == "none"
    assert 0.5 < found.facts["test_inside_likely"] <= 1
    assert {"initial", "final", "in_span", "residual"} <= set(found.reference)
    assert out.with_suffix(".png").stat().st_size > 5000
    model = load_model(weights=weights, prior=prior, calibration=out)
    result = dine.register(source[0], target[0], model=model, surfaces=False)
    assert result.uncertainty.shape == (points,)
    assert (result.uncertainty >= 0).all()
    assert result.trust.expected_error > 0
