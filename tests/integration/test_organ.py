"""A prior of one organ: learned from its deformations, kept in a file, and registered with."""

import re
import shlex
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
import trimesh
from click.testing import CliRunner

import dine
from dine.cli import cli
from dine.config import OrganLearning, Simulation
from dine.errors import ConfigError, DataError
from dine.files import read_json
from dine.geometry.surface import Surface
from dine.io.readers import read_surface
from dine.io.writers import write_surface
from dine.priors.gaussian import LinearGaussian, Posterior
from dine.priors.organ import load_organ_prior
from dine.priors.organ_learning import components, learn
from dine.registration import organ as organ_registration
from dine.registration.organ import deviation_and_bound, organ_field
from dine.simulation.fields import OrganDeformations, write_deformations
from dine.simulation.simulate import simulate

pytestmark = pytest.mark.numerical

SETTINGS = OrganLearning(candidates=[2, 4, 8], points=60)
TURN = trimesh.transformations.rotation_matrix(0.15, [1, 2, 3])
TURN[:3, 3] = [3.0, -2.0, 1.0]


def organ():
    """A lopsided closed mesh, in millimetres."""
    ball = trimesh.creation.icosphere(subdivisions=3)
    vertices = np.asarray(ball.vertices)
    along = vertices @ (np.array([1, 0.3, 0.2]) / np.linalg.norm([1, 0.3, 0.2]))
    reach = 1 + 0.8 * np.exp(-(1 - along) / 0.12)
    return Surface(40 * vertices * reach[:, None] * [1, 0.7, 0.5], np.asarray(ball.faces), "organ")


def family(count, seed, amplitude=6.0):
    """OrganDeformations (K, V, 3) in three ways, of random sizes, and those of its inside."""
    rng = np.random.default_rng(seed)
    size = amplitude * rng.normal(size=(count, 3))
    return np.stack([ways(organ().vertices, row) for row in size])


def ways(points, size):
    x, y, z = points.T / 40
    bent = np.column_stack([0 * x, 0 * x, x**2 - 0.4])
    sheared = np.column_stack([np.sin(y), 0 * x, 0 * x])
    twisted = np.column_stack([0 * x, -x * z, x * y])
    return size[0] * bent + size[1] * sheared + size[2] * twisted


@pytest.fixture(scope="module")
def prior():
    fields = family(30, 0).astype(np.float32)
    return learn(organ(), [OrganDeformations(organ(), fields)], SETTINGS)


def half(vertices):
    """What is seen of the organ from above, as a mesh of its own."""
    faces = organ().faces
    seen = faces[vertices[faces].mean(axis=1)[:, 2] > vertices[:, 2].mean()]
    used, index = np.unique(seen, return_inverse=True)
    return Surface(vertices[used], index.reshape(-1, 3), "scan"), used


# --- learning ---------------------------------------------------------------------------------


def test_components_are_those_of_the_fields():
    fields = family(30, 0)
    mean, modes = components(fields, 8)
    assert len(modes) == 3  # no more ways than there are
    assert np.allclose(mean, fields.mean(axis=0))
    flat = modes.reshape(3, -1)
    centred = (fields - mean).reshape(30, -1)
    assert np.allclose(flat.T @ flat, centred.T @ centred / 29)


def test_as_many_components_as_there_are_ways(prior):
    assert len(prior.modes) == 3
    tried = {fit["components"]: fit["log_likelihood"] for fit in prior.facts["tried"]}
    assert tried[2] < max(tried.values())


def test_the_inside_goes_with_the_surface(prior):
    """Least elastic energy is not how the family moves its inside, but near to it."""
    assert prior.voxels is not None
    inside = organ().vertices * 0.5
    carrier = prior.inside(inside)
    mean, modes = prior.at(carrier)
    size = prior.frame.scale
    truth = ways(organ().vertices, [6.0, 0, 0]) / size
    flat = prior.modes[:, : len(truth)].reshape(len(modes), -1)
    amplitudes = np.linalg.lstsq(flat.T, (truth - prior.mean[: len(truth)]).ravel(), rcond=None)[0]
    found = mean + np.tensordot(amplitudes, modes, axes=1)
    expected = ways(inside, [6.0, 0, 0]) / size
    assert np.linalg.norm(found - expected, axis=1).mean() < 0.35 * np.abs(expected).max()


def test_simulated_and_real_deformations_go_together():
    simulated = simulate(organ(), Simulation(fields=6, edge=0.3))
    real = OrganDeformations(organ(), family(6, 1).astype(np.float32))
    found = learn(organ(), [real, simulated], SETTINGS)
    assert found.facts["fields"] == 12
    assert len(found.mean) == len(organ().vertices) + len(simulated.voxels.nodes)


# Equal, but for the last bit of some of their numbers.
ROUNDED = np.nextafter(np.float32(1), np.where(np.arange(6 * 642 * 3) % 7, 1, 2), dtype=np.float32)
ROUNDED = ROUNDED.reshape(6, 642, 3)


@pytest.mark.parametrize(
    ("fields", "settings", "error", "message"),
    [
        (family(4, 0), {}, DataError, "4 deformations are too few"),
        (np.ones((6, 642, 3)), {}, DataError, "All deformations are equal"),
        (ROUNDED, {}, DataError, "All deformations are equal"),
        (family(6, 0), {"components": 6}, ConfigError, "6 fields allow 5 at most"),
    ],
)
def test_what_cannot_be_learned_from(fields, settings, error, message):
    settings = SETTINGS.model_copy(update=settings)
    with pytest.raises(error, match=message):
        learn(organ(), [OrganDeformations(organ(), fields.astype(np.float32))], settings)


def test_deformations_of_another_mesh_are_refused():
    other = Surface(organ().vertices * 1.01, organ().faces, "other")
    fields = OrganDeformations(other, family(6, 0).astype(np.float32))
    with pytest.raises(DataError, match="other holds deformations of another mesh than organ"):
        learn(organ(), [fields], SETTINGS)


# --- files ------------------------------------------------------------------------------------


def test_a_prior_is_what_was_saved(prior, tmp_path):
    path = tmp_path / "organ.prior"
    prior.save(path)
    found = load_organ_prior(path)
    for name in ("mean", "modes", "widths", "amplitudes"):
        assert np.array_equal(getattr(found, name), getattr(prior, name))
    assert found.facts == prior.facts
    found.check(organ())
    with pytest.raises(DataError, match="is not the template that the prior was learned of"):
        found.check(Surface(organ().vertices[::-1], organ().faces))


@pytest.mark.parametrize("name", ["mean", "modes", "amplitudes", "template/faces", "voxels/cubes"])
def test_damaged_priors_are_refused(prior, tmp_path, name):
    path = tmp_path / "organ.prior"
    prior.save(path)
    with h5py.File(path, "r+") as file:
        values = file[name][()]
        del file[name]
        file[name] = values[..., :-1] if name != "voxels/cubes" else values + 10**7
    with pytest.raises(DataError, match=r"organ\.prior"):
        load_organ_prior(path)
    (tmp_path / "text").write_text("no prior")
    with pytest.raises(DataError):
        load_organ_prior(tmp_path / "text")


# --- bounds -----------------------------------------------------------------------------------


def test_bounds_hold_as_often_as_they_say():
    rng = np.random.default_rng(0)
    roots = np.stack([np.eye(3), np.diag([1, 0.1, 0.01]), np.diag([1, 1, 0.0])])
    deviation, bound = deviation_and_bound(roots @ roots.swapaxes(1, 2))
    drawn = np.einsum("mab,kb->kma", roots, rng.normal(size=(20_000, 3)))
    lengths = np.linalg.norm(drawn, axis=2)
    assert np.allclose(np.sqrt((lengths**2).mean(axis=0)), deviation, rtol=0.03)
    assert np.allclose((lengths <= bound).mean(axis=0), 0.9, atol=0.02)


def test_covariances_are_those_of_the_joint_gaussian():
    """Against the formula with all 27 coordinates at once."""
    rng = np.random.default_rng(0)
    modes, kernel = rng.normal(size=(4, 9, 3)), rng.normal(size=(9, 2))
    half = rng.normal(size=(9, 3, 3))
    precision = half @ half.swapaxes(1, 2)
    posterior = Posterior(LinearGaussian(np.zeros((9, 3)), modes, kernel), half[:, 0], precision)
    before = modes.reshape(4, -1).T @ modes.reshape(4, -1) + np.kron(kernel @ kernel.T, np.eye(3))
    seen = np.zeros((27, 27))
    for point in range(9):
        rows = slice(3 * point, 3 * point + 3)
        seen[rows, rows] = precision[point]
    after = np.linalg.inv(np.linalg.inv(before + 1e-9 * np.eye(27)) + seen)
    expected = np.stack([after[3 * i : 3 * i + 3, 3 * i : 3 * i + 3] for i in range(9)])
    assert np.allclose(posterior.covariance(kernel, modes), expected, atol=1e-5)


# --- registering ------------------------------------------------------------------------------


def placed(vertices):
    return vertices @ TURN[:3, :3].T + TURN[:3, 3]


@pytest.mark.parametrize("known", [True, False], ids=["pose known", "pose found"])
def test_hidden_places_follow_what_is_seen(prior, known):
    truth = organ().vertices + ways(organ().vertices, [8.0, -5.0, 4.0])
    scan, used = half(truth)
    if not known:
        scan = Surface(placed(scan.vertices), scan.faces, "scan")
        truth = placed(truth)
    deep = Surface(organ().vertices * 0.3, organ().faces, "tumour")
    result = dine.register(
        organ(),
        scan,
        prior=prior,
        partial=True,
        prealign="off" if known else "auto",
        apply={"tumour": deep},
    )
    error = np.linalg.norm(result.moved.vertices - truth, axis=1)
    hidden = np.setdiff1d(np.arange(len(truth)), used)
    before = np.linalg.norm(
        (truth - (organ().vertices if known else placed(organ().vertices))), axis=1
    )
    assert error[hidden].mean() < 0.35 * before[hidden].mean()
    assert error[used].mean() < 0.25 * before[used].mean()
    assert (result.bound >= result.uncertainty).all()
    assert result.uncertainty[hidden].mean() > result.uncertainty[used].mean()
    assert result.applied["tumour"].vertices.shape == deep.vertices.shape
    assert (result.applied["tumour"].data["bound_90"] > 0).all()
    expected = deep.vertices + ways(deep.vertices, [8.0, -5.0, 4.0])
    expected = expected if known else placed(expected)
    moved = np.linalg.norm(result.applied["tumour"].vertices - expected, axis=1)
    assert moved.mean() < 0.1 * 60


@pytest.mark.parametrize("inside", [True, False])
def test_landmarks_on_the_hidden_side_are_kept_to(prior, inside):
    """Whether something is known inside the organ or at its vertices alone."""
    if not inside:
        prior = replace(prior, voxels=None, mean=prior.mean[:642], modes=prior.modes[:, :642])
    # Of no kind that the prior knows, so that what is seen does not tell it.
    x, y, z = organ().vertices.T / 40
    truth = organ().vertices + ways(organ().vertices, [8.0, -5.0, 4.0])
    truth = truth + np.outer(6 * np.exp(-((z + 0.5) ** 2 + x**2) / 0.1), [0, 0, -1])
    scan, used = half(truth)
    hidden = np.setdiff1d(np.arange(len(truth)), used)
    near = hidden[np.argsort(x[hidden] ** 2 + y[hidden] ** 2)]
    marks, close = near[:3], near[3:20]
    settings = {"prior": prior, "partial": True, "prealign": "off"}
    errors, bounds = [], []
    for guide in (None, (organ().vertices[marks], truth[marks])):
        more = {} if guide is None else {"guide": guide, "guide_error": 0.1}
        result = dine.register(organ(), scan, **settings, **more)
        errors.append(np.linalg.norm(result.moved.vertices - truth, axis=1))
        bounds.append(result.bound)
    without, kept = errors
    assert kept[marks].max() < 0.5 < without[marks].mean()
    assert kept[close].mean() < 0.6 * without[close].mean()
    assert kept[used].mean() < 0.02 * 60
    assert (bounds[1][marks] < bounds[0][marks]).all()
    assert result.report["settings"]["guides"] == 3


def test_three_landmarks_align_the_template(prior):
    """Turned so far that the nearest points would lead astray."""
    turn = trimesh.transformations.rotation_matrix(2.5, [3, 1, 2])[:3, :3]
    truth = (organ().vertices + ways(organ().vertices, [4.0, -3.0, 2.0])) @ turn.T + 100
    marks = [0, 100, 300]
    scan = Surface(truth, organ().faces, "scan")
    guide = (organ().vertices[marks], truth[marks])
    result = dine.register(organ(), scan, prior=prior, guide=guide)
    error = np.linalg.norm(result.moved.vertices - truth, axis=1)
    assert error.mean() < 1.0


def test_vertices_that_no_face_uses_make_no_difference(prior):
    """As crops leave them, far away; of a prior, too."""
    scan, _ = half(organ().vertices + ways(organ().vertices, [8.0, -5.0, 4.0]))
    expected = dine.register(organ(), scan, prior=prior, partial=True, prealign="off")
    stray = Surface(np.vstack([organ().vertices, [[1e6, 0, 0]]]), organ().faces, "organ")
    fields = np.pad(family(30, 0).astype(np.float32), ((0, 0), (0, 1), (0, 0)))
    other = learn(stray, [OrganDeformations(stray, fields)], SETTINGS)
    found = dine.register(stray, scan, prior=other, partial=True, prealign="off")
    places = expected.moved.vertices
    np.testing.assert_allclose(found.moved.vertices[:-1], places, atol=0.01 * 60)
    np.testing.assert_allclose(found.bound[:-1], expected.bound, rtol=0.1)
    for name in ("displacement", "uncertainty", "bound_90"):
        ours, theirs = found.report[name]["max"], expected.report[name]["max"]
        assert ours == pytest.approx(theirs, rel=0.1)


def test_what_hardly_moved_narrows_no_bounds(prior):
    """A scan of the side that is held says little of how far the rest went."""
    scan, _ = half(organ().vertices)
    field, _ = organ_field(prior, scan, [np.eye(4)], loose=False, partial=True, seed=0)
    assert field.posterior.scale < 0.5
    little = field.bounds(organ().vertices)[1]
    for scale, wider in ((1.0, 1.0), (3.0, 3.0)):
        field.posterior.__dict__["scale"] = scale
        assert np.allclose(field.bounds(organ().vertices)[1], wider * little)


def test_an_open_mesh_has_no_inside_but_what_moves_along_goes_with_its_surface(tmp_path):
    """`simulate` refuses it; learned of deformed meshes its prior registers all the same."""
    closed = organ()
    top = closed.vertices[closed.faces].mean(axis=1)[:, 2] < 0.8 * closed.vertices[:, 2].max()
    used, index = np.unique(closed.faces[top], return_inverse=True)
    sheet = Surface(closed.vertices[used], index.reshape(-1, 3), "open.ply")
    write_surface(tmp_path / "open.ply", sheet)
    done = run("simulate", tmp_path / "open.ply", "-o", tmp_path / "fields.h5")
    assert "is not closed and so has no inside" in str(done.exception)
    assert not (tmp_path / "fields.h5").exists()
    fields = family(30, 0)[:, used].astype(np.float32)
    found = learn(sheet, [OrganDeformations(sheet, fields)], SETTINGS)
    assert found.voxels is None
    size = [8.0, -5.0, 4.0]
    truth = sheet.vertices + ways(sheet.vertices, size)
    near = Surface(0.95 * sheet.vertices[::40], None, "near")
    result = dine.register(
        sheet, Surface(truth, sheet.faces), prior=found, prealign="off", apply={"near": near}
    )
    assert np.linalg.norm(result.moved.vertices - truth, axis=1).mean() < 0.5
    expected = near.vertices + ways(near.vertices, size)
    moved = result.applied["near"]
    apart = np.linalg.norm(moved.vertices - expected, axis=1)
    assert apart.mean() < 0.2 * np.linalg.norm(expected - near.vertices, axis=1).mean()
    assert (moved.data["bound_90"] > 0).all()


def test_a_whole_scan_is_no_special_case(prior):
    truth = organ().vertices + ways(organ().vertices, [8.0, -5.0, 4.0])
    scan = Surface(truth, organ().faces)
    result = dine.register(organ(), scan, prior=prior, prealign="off")
    error = np.linalg.norm(result.moved.vertices - truth, axis=1)
    assert error.mean() < 0.01 * prior.frame.scale
    assert result.report["supported"] > 0.95


def test_a_field_is_the_sum_of_its_parts(prior):
    """However it is computed: rigid motions, components and the process."""
    scan, _ = half(placed(organ().vertices + ways(organ().vertices, [8.0, -5.0, 4.0])))
    field, _ = organ_field(prior, scan, [TURN], loose=True, partial=True, seed=0)
    carrier = prior.at_vertices()
    places = field.placed.alignment.normalise(organ().vertices)
    mean, modes = field.placed.at(carrier, places)
    assert len(modes) == 6 + 3
    found = field.posterior
    expected = (
        mean + np.tensordot(found.shared, modes, axes=1) + field.root.at(places) @ found.alone
    )
    assert np.abs(found.shared).min() > 0
    assert np.allclose(field.at(carrier, places), expected, atol=1e-6)


def test_all_components_count_though_few_are_tried(prior, monkeypatch):
    few = replace(prior, modes=prior.modes / 100)
    assert organ_registration._enough(few) == (30, 30)
    expected = np.linalg.norm(prior.modes[1:, :642], axis=2) ** 2
    assert prior.left_after[1] == pytest.approx(np.sqrt(expected.sum(axis=0).mean()))
    # Large processes, which do what components do elsewhere, are kept.
    assert organ_registration._enough(replace(prior, amplitudes=[0.1, 0, 0]))[1] > 100
    monkeypatch.setattr(organ_registration, "_enough", lambda _: (1, 3))
    truth = organ().vertices + ways(organ().vertices, [4.0, -5.0, 4.0])
    result = dine.register(organ(), Surface(truth, organ().faces), prior=prior, prealign="off")
    error = np.linalg.norm(result.moved.vertices - truth, axis=1)
    assert error.mean() < 0.01 * prior.frame.scale


def test_equal_inputs_give_equal_results(prior):
    scan, _ = half(organ().vertices + ways(organ().vertices, [8.0, 0.0, 0.0]))
    found = [dine.register(organ(), scan, prior=prior, partial=True) for _ in range(2)]
    assert np.array_equal(found[0].moved.vertices, found[1].moved.vertices)


def test_what_a_prior_of_an_organ_cannot_register(prior):
    scan, _ = half(organ().vertices)
    other = Surface(organ().vertices[::-1], organ().faces, "other")
    with pytest.raises(DataError, match="other is not the template"):
        dine.register(other, scan, prior=prior)
    far = Surface(scan.vertices + 500, scan.faces, "far")
    with pytest.raises(DataError, match="far shows hardly anything of organ"):
        dine.register(organ(), far, prior=prior, partial=True, prealign="off")
    with pytest.raises(ConfigError, match="no network to choose surfaces of"):
        dine.register(organ(), scan, prior=prior, surfaces=False)


# --- commands ---------------------------------------------------------------------------------


def run(*words):
    return CliRunner().invoke(cli, [*map(str, words)])


def test_from_meshes_to_a_moved_tumour(tmp_path):
    """learn and register, from a folder of deformed meshes."""
    template = tmp_path / "organ.ply"
    write_surface(template, organ())
    folder = tmp_path / "deformed"
    for row, field in enumerate(family(12, 0)):
        folder.mkdir(exist_ok=True)
        moved = Surface(organ().vertices + field, organ().faces)
        write_surface(folder / f"{row}.ply", moved)
    file = tmp_path / "organ.prior"
    settings = SETTINGS.model_dump_json()
    done = run("learn", template, folder, "-o", file, "--settings", settings)
    assert done.exit_code == 0, done.exception
    scan, _ = half(organ().vertices + ways(organ().vertices, [6.0, 2.0, 0]))
    write_surface(tmp_path / "scan.ply", scan)
    write_surface(tmp_path / "tumour.ply", Surface(organ().vertices * 0.2, organ().faces))
    out = tmp_path / "moved.ply"
    words = ("register", template, tmp_path / "scan.ply", "-o", out, "--prior", file)
    words += ("--partial", "--view", "--apply", tmp_path / "tumour.ply")
    done = run(*words)
    assert done.exit_code == 0, done.exception
    report = read_json(out.with_suffix(".json"))
    assert report["organ_prior"]["fields"] == 12
    assert report["applied"]["tumour"]["bound_90"]["max"] > 0
    assert len(read_surface(out).vertices) == len(organ().vertices)
    assert b"bound_90" in (tmp_path / "moved.tumour.ply").read_bytes()[:1000]
    assert b"bound_90" in out.read_bytes()[:1000]
    for more in (("--backbone", "deftransnet"), ("--weights", "w.safetensors")):
        done = run(*words, "--overwrite", *more)
        assert isinstance(done.exception, ConfigError)
        assert "leave out --backbone" in str(done.exception)
    done = run("register-many", tmp_path, "-o", tmp_path / "many", "--prior", file)
    assert isinstance(done.exception, ConfigError)


def test_the_commands_of_the_page(tmp_path, monkeypatch):
    """As they stand there, but for fewer and coarser fields."""
    page = Path(__file__).parents[2] / "docs" / "guide" / "organ.md"
    block = re.search(r"```sh\n(.*?)```", page.read_text(), re.DOTALL)[1]
    less = {
        "simulate": ["--fields", "6", "--settings", '{"edge": 0.3}'],
        "learn": ["--settings", SETTINGS.model_dump_json()],
    }
    monkeypatch.chdir(tmp_path)
    ball = trimesh.creation.icosphere(subdivisions=1, radius=0.05)
    write_surface(Path("tumour.ply"), Surface(np.asarray(ball.vertices), np.asarray(ball.faces)))
    commands = [shlex.split(line, comments=True)[1:] for line in block.splitlines()]
    assert [words[0] for words in commands] == ["scans", "simulate", "learn", "register"]
    for words in commands:
        done = run(*words, *less.get(words[0], []))
        assert done.exit_code == 0, done.exception
    assert "bound_90" in read_surface("moved.tumour.ply").data
    assert Path("moved.html").exists()


def test_a_folder_of_other_meshes_is_refused(tmp_path):
    template = tmp_path / "organ.ply"
    write_surface(template, organ())
    folder = tmp_path / "deformed"
    folder.mkdir()
    done = run("learn", template, folder, "-o", tmp_path / "organ.prior")
    assert "holds no meshes" in str(done.exception)
    write_surface(folder / "a.ply", Surface(organ().vertices[:600], None))
    done = run("learn", template, folder, "-o", tmp_path / "organ.prior")
    assert "has other vertices or faces than" in str(done.exception)
    assert not (tmp_path / "organ.prior").exists()


def test_the_file_of_fields_is_no_prior(tmp_path):
    path = tmp_path / "fields.h5"
    write_deformations(path, OrganDeformations(organ(), family(3, 0).astype(np.float32)), {})
    with pytest.raises(DataError, match="is of another kind than dine-organ-prior"):
        load_organ_prior(path)
