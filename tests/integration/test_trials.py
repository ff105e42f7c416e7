"""What a prior of one organ is worth: deformations by other mechanics, partial scans, tables."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
import trimesh
from click.testing import CliRunner

from dine.cli import cli
from dine.config import OrganLearning, OrganTrial, Simulation
from dine.errors import DataError
from dine.geometry.surface import Surface
from dine.geometry.voxels import voxelised
from dine.io.writers import write_surface
from dine.priors.organ_learning import learn
from dine.reporting.organ import load_trials, trial_tables
from dine.results import TrialFiles
from dine.simulation.elasticity import SoftBody
from dine.simulation.simulate import simulate
from dine.trials import mechanics
from dine.trials.conditions import of_mechanics
from dine.trials.mechanics import NeoHookean, attachment, held, patch, true_deformations
from dine.trials.organ import ERRORS, Methods, asked, seen_of, trial

pytestmark = pytest.mark.numerical

# Of the cubes of true deformations, and of some simulations.
EDGE = 0.25
FEW = Simulation(fields=3, edge=0.3)


def egg(radius=1.0):
    """A closed mesh with its middle at the origin."""
    ball = trimesh.creation.icosphere(subdivisions=3)
    return Surface(radius * ball.vertices * [1, 0.75, 0.6], np.asarray(ball.faces), "egg.ply")


@pytest.fixture(scope="module")
def truth():
    return true_deformations(egg(), 2, seed=3, edge=EDGE)


@pytest.fixture(scope="module")
def methods():
    settings = Simulation(fields=24, edge=0.25, fixed="about")
    fields = simulate(egg(), settings, seed=1, fixed=held(egg()))
    return Methods(learn(egg(), [fields], OrganLearning(candidates=[8, 16], points=60)))


# --- mechanics --------------------------------------------------------------------------------


def body(poisson=0.3):
    voxels = voxelised(egg(), 0.3)
    fixed = voxels.nodes[:, 0] < -0.5
    return voxels, fixed, NeoHookean(voxels, np.ones(len(voxels.cubes)), poisson, fixed)


def test_the_tangent_is_the_change_of_the_forces():
    voxels, _, soft = body()
    rng = np.random.default_rng(0)
    at, way = (0.05 * rng.normal(size=(len(voxels.nodes), 3)) for _ in range(2))
    step = 1e-4
    ahead, back = (soft.assembled(at + sign * step * way)[0] for sign in (1, -1))
    change = (ahead - back).ravel() / (2 * step)
    expected = soft.assembled(at)[1] @ way.ravel()
    assert np.linalg.norm(change - expected) < 1e-5 * np.linalg.norm(expected)


def test_small_deformations_are_those_of_linear_elasticity():
    """That other code solves it is the point: nothing of it is shared but the cubes."""
    voxels, fixed, soft = body(poisson=0.2)
    weight = np.bincount(voxels.cubes.ravel(), np.repeat(voxels.inside, 8), len(voxels.nodes))
    forces = 1e-5 * weight[:, None] * [0.2, 1.0, -0.5]
    found = soft.step(np.zeros_like(forces), forces)
    other = SoftBody(voxels, np.ones(len(voxels.cubes)), 0.2, fixed).linear(forces[:, :, None])
    # Cubes at the surface and the change of volume are integrated otherwise.
    assert np.linalg.norm(found - other[:, :, 0]) < 0.15 * np.linalg.norm(found)
    assert not found[fixed].any()


def test_true_deformations_are_as_large_as_drawn_and_hang_together(truth):
    again = true_deformations(egg(), 1, seed=3, edge=EDGE)
    assert np.array_equal(again.vertices[0], truth.vertices[0])
    assert not np.array_equal(
        true_deformations(egg(), 1, seed=4, edge=EDGE).vertices[0], truth.vertices[0]
    )
    length = np.linalg.norm(truth.vertices, axis=2).mean(axis=1)
    # They are taken at the first step of the loads that is large enough.
    assert (length >= mechanics.AMPLITUDE[0]).all()
    assert (length < 2 * mechanics.AMPLITUDE[1]).all()
    carried = truth.voxels.carrier(egg().vertices) @ truth.nodes[0]
    assert np.allclose(carried, truth.vertices[0], atol=1e-6)
    near = np.linalg.norm(egg().vertices - attachment(egg()), axis=1)
    still = np.linalg.norm(truth.vertices, axis=2) < 1e-3
    assert still.any(axis=1).all()
    assert near[still[0]].max() <= mechanics.SHIFTED + mechanics.HELD[1] + 2 * EDGE


def test_a_body_that_bears_nothing_is_refused(monkeypatch):
    monkeypatch.setattr(mechanics, "_drawn", lambda *_: None)
    with pytest.raises(DataError, match=r"egg.ply bears no loads"):
        true_deformations(egg(), 1, seed=0)


# --- what is seen, and what is made of it -----------------------------------------------------


@pytest.mark.parametrize("share", [0.2, 0.8])
def test_a_scan_shows_a_share_of_the_surface(truth, share):
    for case, field in zip(seen_of(truth, share, noise=0.0), truth.vertices, strict=True):
        assert np.array_equal(case.truth, egg().vertices + field)
        area = trimesh.Trimesh(case.truth, egg().faces, process=False).area
        shown = trimesh.Trimesh(case.scan.vertices, case.scan.faces, process=False).area
        assert shown == pytest.approx(share * area, abs=0.02 * area)
        assert np.array_equal(case.scan.vertices, case.truth[case.seen])


def test_conditions_differ_from_simulations_in_what_they_say():
    found = dict(of_mechanics(egg(), held(egg()), FEW))
    usual = found["as simulated"]
    off = found["template off by 2 % of the radius"]
    bumps = np.linalg.norm(off.vertices - usual.vertices, axis=2).mean(axis=1)
    assert np.allclose(bumps, 0.02, rtol=1e-4)
    # The inside goes with the surface, but for bumps, which are finer than the cubes.
    for fields in (x for x in found.values() if x is not off):
        carried = fields.voxels.carrier(egg().vertices)
        moved = np.stack([carried @ field for field in fields.nodes])
        assert np.allclose(moved, fields.vertices, atol=0.015)
    length = {name: np.linalg.norm(x.vertices, axis=2).mean() for name, x in found.items()}
    assert length["linear elasticity"] == pytest.approx(length["as simulated"], rel=0.5)


def test_errors_of_methods_without_a_prior(truth, methods):
    case = seen_of(truth)[0]
    still = methods.by_name["unregistered"](case)
    moved = np.linalg.norm(truth.vertices[0], axis=1)
    assert still["hidden"] == pytest.approx(moved[~case.seen].mean(), rel=1e-6)
    assert still["seen"] == pytest.approx(moved[case.seen].mean(), rel=1e-6)
    # Rigid motions are found, and none of them is this deformation.
    turned = case.turned(0)
    rigid = methods.by_name["rigid"](turned)
    assert 0 < rigid["seen"] < still["seen"]


def test_what_was_learned_says_more_of_the_hidden_part_than_smoothness(truth, methods):
    """The claim itself, at a size that leaves room: by two thirds here."""
    names = ("smooth", "pca_process", "places_given")
    errors = {name: [] for name in names}
    for case in seen_of(truth):
        for name in names:
            errors[name].append(methods.by_name[name](case))
    hidden = {name: np.mean([x["hidden"] for x in found]) for name, found in errors.items()}
    assert hidden["pca_process"] < 0.7 * hidden["smooth"]
    seen = {name: np.mean([x["seen"] for x in found]) for name, found in errors.items()}
    assert seen["places_given"] < 0.5 * seen["pca_process"]
    assert all(0 <= x["within"] <= 1 for found in errors.values() for x in found)


def test_rivals_leave_out_what_their_names_do(truth, methods):
    """Or the comparison would be with something else."""
    case, prior = seen_of(truth)[0], methods.prior
    other = Methods(replace(prior, mean=2 * prior.mean, modes=2 * prior.modes[::-1]))
    wider = Methods(replace(prior, amplitudes=[0.1 + x for x in prior.amplitudes]))
    for name, changed in (("smooth", other), ("pca", wider)):
        expected = methods.by_name[name](case)
        assert changed.by_name[name](case) == pytest.approx(expected, rel=1e-6)


def test_a_pose_that_is_not_told_is_found(truth, methods):
    case = seen_of(truth)[1]
    turned = case.turned(1)
    known = turned.errors(*(turned.motion.apply(x) for x in (case.truth, case.deep)))
    assert max(known.values()) < 1e-12
    found, still = (methods.by_name[name](turned) for name in ("pca_process", "unregistered"))
    assert found["seen"] < 0.6 * still["seen"]


def test_places_given_are_a_floor_of_turned_scans_too(truth, methods):
    """Who is told where seen vertices went finds the pose, and finds the same however it lies."""
    floor = methods.by_name["places_given"]
    for number, case in enumerate(seen_of(truth)):
        lying, found, again = (floor(x) for x in (case, case.turned(number), case.turned(9)))
        assert found["seen"] < 0.005
        assert found["hidden"] < 2.5 * lying["hidden"]
        assert found == pytest.approx(again, abs=1e-3)


def test_questions_have_the_conditions_that_they_say(truth):
    seen = dict(asked("seen", truth, held(egg()), FEW))
    assert len(seen) == 9
    for label, cases in seen.items():
        assert [case.motion is not None for case in cases] == 2 * [label.startswith("turned")]
    shown = [seen[f"{share} % seen"][0].seen.mean() for share in (20, 40, 60, 80, 99)]
    assert np.allclose(shown, [0.2, 0.4, 0.6, 0.8, 0.99], atol=0.1)
    for noise in (0, 1, 2):
        case = seen[f"noise of {noise} %"][0]
        off = case.scan.vertices - case.truth[case.seen]
        assert off.std() == pytest.approx(noise / 100, rel=0.1)
    (label, cases), *others = asked("methods", truth, held(egg()), FEW)
    assert label == "40 % seen"
    assert len(cases) == 2
    assert not others


# --- commands and tables ----------------------------------------------------------------------


def run(*words):
    done = CliRunner().invoke(cli, [str(word) for word in words], catch_exceptions=False)
    assert done.exit_code == 0, done.output
    return done.output


def test_from_a_mesh_to_tables(tmp_path):
    """Each command as the workflow calls it, in millimetres."""
    mesh = tmp_path / "egg.ply"
    write_surface(mesh, replace(egg(40.0), vertices=egg(40.0).vertices + 7))
    files = TrialFiles(tmp_path / "trial")
    run("organ-template", mesh, "--out", files.folder)
    few = '{"deformations": 2, "edge": 0.25}'
    run("organ-truth", files.template, "--settings", few, "--out", files.truth)
    numbers = np.loadtxt(files.held("patch"), dtype=int)
    assert np.array_equal(np.flatnonzero(patch(egg())), numbers)
    settings = '{"fields": 12, "edge": 0.3, "fixed": "about"}'
    held_at = ("--fixed", files.held("about"), "--settings", settings)
    run("simulate", files.template, "-o", files.fields("about"), *held_at)
    learned = ("-o", files.prior("about"), "--settings", '{"points": 40}')
    run("learn", files.template, files.fields("about"), *learned)
    given = ("--truth", files.truth, "--held", files.held("about"), "--prior")
    run("organ-trial", *given, files.prior("about"), "--out", files.measured("methods"))
    rows = pd.read_csv(files.measured("methods"))
    assert len(rows) == 2 * 7  # nothing is said of simulations held at one patch
    # In radii, wherever the mesh lies and in whatever unit.
    still = rows[rows["method"] == "unregistered"]
    assert still["hidden"].between(0.02, 0.6).all()
    run(
        "organ-tables", "--measured", "egg", files.measured("methods"), "--out", tmp_path / "tables"
    )
    assert "PCA + process" in (tmp_path / "tables" / "all.md").read_text()


def made_up(rng, method, hidden):
    values = {name: hidden + 0.001 * rng.normal(size=8) for name in ERRORS}
    labels = {"about": "methods", "condition": "40 % seen", "method": method}
    return pd.DataFrame({**labels, "deformation": range(8), **values, "within": 0.9})


def test_tables_say_what_was_measured(tmp_path):
    rng = np.random.default_rng(0)
    found = [made_up(rng, name, error) for name, error in (("smooth", 0.1), ("pca_process", 0.02))]
    columns = ["about", "condition", "method", "deformation", *ERRORS, "within"]
    pd.concat(found)[columns].to_csv(tmp_path / "methods.csv", index=False)
    (table,) = trial_tables(load_trials([("liver", tmp_path / "methods.csv")]))
    smooth, learned = table.data.itertuples()
    assert smooth.hidden == pytest.approx(10, abs=0.2)
    assert smooth.hidden_low < smooth.hidden < smooth.hidden_high
    assert smooth.difference_low < 8 < smooth.difference_high
    assert learned.difference == 0
    assert "90 %" in {cell.text for cell in table.rows[0]}


def test_other_tables_are_refused(tmp_path):
    (tmp_path / "other.csv").write_text("a,b\n1,2\n")
    with pytest.raises(DataError, match=r"other.csv is not a table of `dine organ-trial`"):
        load_trials([("liver", tmp_path / "other.csv")])


def test_a_trial_has_a_row_for_each_condition_method_and_deformation(truth, methods):
    settings = OrganTrial(simulation=FEW, compared=["unregistered", "rigid"])
    rows = trial("size", methods, truth, held(egg()), settings)
    assert len(rows) == 4 * 2 * 2
    assert rows["within"].isna().all()
    still = rows[rows["method"] == "unregistered"].groupby("condition", sort=False)["hidden"].mean()
    assert (np.diff(still) > 0).all()  # larger loads move more
