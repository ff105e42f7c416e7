"""Finite elements against what mechanics says, and deformations of an organ from them."""

import h5py
import numpy as np
import pytest
import trimesh
from click.testing import CliRunner
from scipy.spatial.transform import Rotation

from dine.cli import cli
from dine.config import Simulation
from dine.errors import ConfigError, DataError
from dine.geometry.surface import Surface
from dine.geometry.voxels import CORNERS, share_inside, voxelised
from dine.io.writers import write_moved, write_surface
from dine.simulation.elasticity import SoftBody, rotations, unit_stiffness
from dine.simulation.fields import (
    labelled_vertices,
    read_deformations,
    template_digest,
    write_deformations,
)
from dine.simulation.loads import SEVERED, Organ, drawn_cuts
from dine.simulation.simulate import simulate

pytestmark = pytest.mark.numerical

FEW = Simulation(fields=6, edge=0.25)


def ball(radius=1.0, at=(0, 0, 0), subdivisions=3):
    mesh = trimesh.creation.icosphere(subdivisions=subdivisions, radius=radius)
    return Surface(np.asarray(mesh.vertices) + at, np.asarray(mesh.faces), "ball.ply")


def bar(length=8.0):
    """Two edges wide, with corners on the grid."""
    mesh = trimesh.creation.box(extents=(length, 2, 2)).subdivide()
    return Surface(mesh.vertices + np.array([length / 2, 1, 1]), np.asarray(mesh.faces), "bar")


def together(*surfaces):
    offsets = np.cumsum([0, *(len(x.vertices) for x in surfaces)])
    faces = [x.faces + offset for x, offset in zip(surfaces, offsets, strict=False)]
    return Surface(np.concatenate([x.vertices for x in surfaces]), np.concatenate(faces), "both")


# --- voxels -----------------------------------------------------------------------------------


def test_cubes_hold_the_volume_and_all_of_the_surface():
    found = voxelised(ball(), 0.1)
    assert found.inside.sum() * 0.1**3 == pytest.approx(4 / 3 * np.pi, rel=0.02)
    index, weights = found.carried(ball().vertices)
    assert (weights > -1e-9).all()
    places = np.einsum("mk,mkc->mc", weights, found.nodes[index])
    assert np.allclose(places, ball().vertices)
    assert np.allclose(found.carrier(ball().vertices) @ found.nodes, ball().vertices)


def test_a_cavity_and_an_inclusion_are_seen():
    hollow = ball(0.6)
    hollow = together(ball(), Surface(hollow.vertices, hollow.faces[:, ::-1]))
    found = voxelised(hollow, 0.1)
    assert found.inside.sum() * 0.1**3 == pytest.approx(4 / 3 * np.pi * (1 - 0.6**3), rel=0.03)
    whole = voxelised(ball(), 0.1)
    share = share_inside(whole, ball(0.4, at=(0.2, 0, 0)))
    assert share.sum() * 0.1**3 == pytest.approx(4 / 3 * np.pi * 0.4**3, rel=0.05)
    with pytest.raises(DataError, match="does not lie within the organ"):
        share_inside(whole, ball(0.4, at=(5, 0, 0)))


def test_faces_that_look_inwards_make_no_difference():
    turned = Surface(ball().vertices, ball().faces[:, ::-1])
    assert np.array_equal(voxelised(turned, 0.2).inside, voxelised(ball(), 0.2).inside)


@pytest.mark.parametrize(
    ("surface", "message"),
    [
        (Surface(ball().vertices), "is a cloud of points; expected a closed mesh"),
        (Surface(ball().vertices, ball().faces[1:]), "is not closed and so has no inside: 3 of"),
        (together(ball(), ball(at=(0.7, 0.1, 0))), "crosses itself"),
        (together(ball(), ball(at=(5, 0, 0))), "is in 2 parts that no cube of edge 0.25 joins"),
    ],
    ids=["cloud", "open", "crossing", "parts"],
)
def test_meshes_without_one_clear_inside_are_refused(surface, message):
    with pytest.raises(DataError, match=message):
        voxelised(surface, 0.25)


# --- elasticity -------------------------------------------------------------------------------


def test_a_cube_resists_strain_and_no_rigid_motion():
    shear, volume = unit_stiffness()
    stretch = np.outer(CORNERS[:, 0], [1.0, 0, 0]).ravel()
    assert stretch @ shear @ stretch == pytest.approx(2)  # 2 μ ε²
    assert stretch @ volume @ stretch == pytest.approx(1)  # λ tr(ε)²
    turn = np.cross([0.3, -0.5, 0.2], CORNERS).ravel()
    assert np.allclose(shear @ turn, 0)
    assert np.allclose(volume @ turn, 0)


def test_rotations_are_those_nearest():
    turns = Rotation.random(20, random_state=0).as_matrix()
    stretch = np.random.default_rng(0).normal(size=(20, 3, 3))
    stretch = 0.1 * (stretch + stretch.swapaxes(1, 2)) + np.eye(3)
    found = rotations(np.moveaxis(turns @ stretch, 0, 2))
    assert np.allclose(np.moveaxis(found, 2, 0), turns, atol=1e-6)
    inside_out = rotations(np.diag([1.0, 1.0, -0.5])[:, :, None])
    assert np.linalg.det(inside_out[:, :, 0]) == pytest.approx(1)


@pytest.mark.parametrize("load", [0.02, 1.0])
def test_a_bar_bends_as_the_elastica_does(load):
    """A load P across the end of a bar of length L that is held at the other: P L² / E I = 1 lowers
    the end by 0.3017 L and draws it in by 0.0564 L (Bisshopp and Drucker, 1945); by linear
    elasticity 0.3333 L and 0. A small one lowers it by P L³ / 3 E I."""
    length, edge = 12.0, 0.5
    voxels = voxelised(bar(length), edge)
    body = SoftBody(voxels, np.ones(len(voxels.cubes)), 0.3, voxels.nodes[:, 0] <= edge / 2)
    across = np.mgrid[0.2:1.8:4j, 0.2:1.8:4j].reshape(2, -1)
    end = np.asarray(
        voxels.carrier(np.column_stack([np.full(16, length), *across])).mean(axis=0)
    ).ravel()
    force = load * (2 * 2**3 / 12) / length**2
    forces = np.zeros((len(voxels.nodes), 3, 1))
    forces[:, 2, 0] = end * force / edge**2
    moved, reached = body.equilibrium(forces, np.zeros((len(voxels.cubes), 1)))
    drawn, _, lowered = end @ moved[:, :, 0] * edge / length
    assert reached.all()
    assert body.inverted(moved) == 0
    if load == 1.0:
        assert lowered == pytest.approx(0.3017, rel=0.07)
        assert -drawn == pytest.approx(0.0564, rel=0.15)
    else:
        assert lowered == pytest.approx(load / 3, rel=0.08)


@pytest.mark.parametrize("poisson", [0.3, 0.45])
def test_a_stretched_bar_grows_longer_as_it_should(poisson):
    """Growth of all cubes is the only strain: no force, and every length grows alike."""
    voxels = voxelised(bar(4.0), 0.5)
    fixed = np.zeros(len(voxels.nodes), bool)
    fixed[voxels.cubes[0]] = True
    body = SoftBody(voxels, np.ones(len(voxels.cubes)), poisson, fixed)
    growth = np.full((len(voxels.cubes), 1), 0.02)
    moved, reached = body.equilibrium(np.zeros((*voxels.nodes.shape, 1)), growth)
    assert reached.all()
    far = voxels.nodes[:, 0] > 2
    extent = np.ptp(voxels.nodes[far], axis=0)
    assert np.ptp(voxels.nodes[far] + 0.5 * moved[far, :, 0], axis=0) == pytest.approx(
        1.02 * extent, rel=2e-3
    )


# --- an organ ---------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def fields():
    return simulate(ball(), FEW, seed=3)


def test_fields_do_not_depend_on_workers_or_on_how_many_there_are(fields):
    fewer = simulate(ball(), FEW.model_copy(update={"fields": 5}), seed=3, workers=2)
    assert np.array_equal(fewer.vertices, fields.vertices[:5])
    assert np.array_equal(fewer.nodes, fields.nodes[:5])
    other = simulate(ball(), FEW.model_copy(update={"fields": 2}), seed=4)
    assert not np.allclose(other.vertices, fields.vertices[:2])


def test_fields_move_the_surface_as_its_inside(fields):
    index, weights = fields.voxels.carried(ball().vertices)
    expected = np.einsum("mk,fmkc->fmc", weights, fields.nodes[:, index])
    assert np.allclose(fields.vertices, expected, atol=1e-5)
    mean = np.linalg.norm(fields.vertices, axis=2).mean(axis=1)
    assert ((mean > 0.001) & (mean < 0.4)).all()
    assert len(np.unique(mean.round(6))) == len(mean)


def test_units_and_place_make_no_difference(fields):
    moved = Surface(25.4 * ball().vertices + [100, -50, 3], ball().faces)
    found = simulate(moved, FEW.model_copy(update={"fields": 2}), seed=3)
    assert np.allclose(found.vertices / 25.4, fields.vertices[:2], atol=1e-3)


def test_vertices_that_no_face_uses_make_no_difference(fields):
    stray = Surface(np.vstack([ball().vertices, [[1e4, 0, 0]]]), ball().faces, "ball")
    found = simulate(stray, FEW.model_copy(update={"fields": 2}), seed=3)
    np.testing.assert_allclose(found.vertices[:, :-1], fields.vertices[:2], atol=1e-3)


def test_fixed_vertices_stay(fields):
    fixed = ball().vertices[:, 2] < -0.5
    found = simulate(ball(), FEW, seed=3, fixed=fixed)
    assert np.abs(found.vertices[:, fixed]).max() == 0
    assert np.abs(found.vertices).max() > 0.05


def test_what_is_fixed_about_some_vertices_lies_near_them():
    vertices = ball().vertices
    about = vertices[:, 2] > 0.95
    settings = FEW.model_copy(update={"fixed": "about", "shared": 1, "patch": [0.3, 0.5]})
    still = np.linalg.norm(simulate(ball(), settings, seed=3, fixed=about).vertices, axis=2) == 0
    assert still.any(axis=1).all()
    far = np.linalg.norm(vertices - [0, 0, 1], axis=1) > 0.32 + 0.5 + 0.1
    assert not still[:, far].any()
    assert len({row.tobytes() for row in still}) > 1


def test_a_stiff_inclusion_is_strained_less():
    settings = FEW.model_copy(update={"loads": ["force"], "inclusion": [100.0, 100.0]})
    inclusion = ball(0.4, at=(0.3, 0, 0))
    fixed = ball().vertices[:, 2] < -0.8
    strains = []
    for within in (None, inclusion):
        found = simulate(ball(), settings, seed=1, fixed=fixed, inclusion=within)
        places = inclusion.vertices * 0.9 + [0.03, 0, 0]
        index, weights = found.voxels.carried(places)
        moved = places + np.einsum("mk,fmkc->fmc", weights, found.nodes[:, index])
        spread = moved - moved.mean(axis=1, keepdims=True)
        singular = np.linalg.svd(spread, compute_uv=False)
        strains.append(np.std(singular / singular.mean(axis=1, keepdims=True)))
    assert strains[1] < 0.5 * strains[0]


CUT = FEW.model_copy(update={"cuts": 2, "cut": [0.4, 0.8]})


def test_the_sides_of_a_cut_part_under_load():
    organ = Organ.of(ball(), voxelised(ball(), 0.2))
    voxels = organ.voxels
    deep = FEW.model_copy(update={"cuts": 1, "cut": [0.9, 0.9]})
    severed = drawn_cuts(organ, deep, np.random.default_rng(0))
    # One disc from the surface inwards, a cube or two thick, and on both sides of it the ball.
    middle = voxels.middles[severed].mean(axis=0)
    _, extents, axes = np.linalg.svd(voxels.middles[severed] - middle)
    assert extents[2] / np.sqrt(severed.sum()) < voxels.edge
    assert np.linalg.norm(voxels.middles[severed], axis=1).max() > 0.8
    side = (voxels.nodes - middle) @ axes[2]
    near = np.linalg.norm(voxels.nodes - middle, axis=1) < 0.5
    sides = [near & (sign * side > 0.75 * voxels.edge) for sign in (1, -1)]
    forces = np.zeros((*voxels.nodes.shape, 1))
    for nodes, sign in zip(sides, (1, -1), strict=True):
        forces[nodes, :, 0] = sign * 1e-3 * axes[2]
    fixed = voxels.nodes @ middle < -0.3 * np.linalg.norm(middle)
    opened = []
    for kept in (1.0, SEVERED):
        body = SoftBody(voxels, np.where(severed, kept, 1.0), 0.45, fixed)
        across = body.linear(forces)[:, :, 0] @ axes[2]
        opened.append(across[sides[0]].mean() - across[sides[1]].mean())
    assert opened[1] > 3 * opened[0] > 0


def test_cut_bodies_are_drawn_like_others_and_no_cube_is_inside_out():
    found = simulate(ball(), CUT, seed=1)
    again = simulate(ball(), CUT.model_copy(update={"fields": 2}), seed=1, workers=2)
    assert np.array_equal(found.nodes[:2], again.nodes)
    whole = simulate(ball(), FEW, seed=1)
    # The same loads on other bodies.
    apart = np.linalg.norm(found.vertices - whole.vertices, axis=2).mean(axis=1)
    length = np.linalg.norm(whole.vertices, axis=2).mean(axis=1)
    assert ((apart > 0.02 * length) & (apart < 1.5 * length)).all()
    voxels = found.voxels
    body = SoftBody(voxels, np.ones(len(voxels.cubes)), 0.45, voxels.nodes[:, 0] < 0)
    for kind in (found, whole):
        moved = np.moveaxis(kind.nodes / voxels.edge, 0, 2).astype(float)
        assert not body.inverted(moved).any()


def test_finer_cubes_change_the_fields_little():
    """The same loads at other resolutions: differences shrink with the edge."""
    found = {
        edge: simulate(ball(), Simulation(fields=4, edge=edge, amplitude=[0.05, 0.1]), seed=2)
        for edge in (0.5, 0.3, 0.15)
    }
    size = np.abs(found[0.15].vertices).mean()
    apart = [
        np.abs(found[edge].vertices - found[0.15].vertices).mean() / size for edge in (0.5, 0.3)
    ]
    assert apart[1] < apart[0]
    assert apart[1] < 0.3


def test_parts_that_a_cube_joins_are_one_organ():
    """Two closed meshes, near to each other as the halves of an organ, go with each other."""
    both = together(ball(), ball(at=(2.05, 0, 0)))
    fixed = both.vertices[:, 0] < -0.9
    settings = Simulation(fields=2, edge=0.25, loads=["gravity"], amplitude=[0.05, 0.05])
    found = simulate(both, settings, seed=3, fixed=fixed).vertices
    assert np.isfinite(found).all()
    assert np.linalg.norm(found[:, 642:], axis=2).mean() > 0.05
    gap = [np.flatnonzero(np.abs(both.vertices[:, 0] - x) < 1e-9)[0] for x in (1.0, 1.05)]
    assert np.linalg.norm(found[:, gap[0]] - found[:, gap[1]], axis=1).max() < 0.03


def test_patches_that_fix_everything_are_refused():
    with pytest.raises(ConfigError, match="fix all of the surface; lower `patch`"):
        simulate(ball(), FEW.model_copy(update={"patch": [3.0, 3.0]}))


# --- files and the command --------------------------------------------------------------------


def run(*words):
    return CliRunner().invoke(cli, ["simulate", *map(str, words)])


def test_the_command_writes_what_is_read_back(tmp_path):
    template = tmp_path / "ball.ply"
    write_surface(template, ball())
    out = tmp_path / "fields.h5"
    settings = '{"edge": 0.3}'
    done = run(template, "-o", out, "--fields", 3, "--settings", settings, "--seed", 7)
    assert done.exit_code == 0, done.exception
    found = read_deformations(out)
    assert template_digest(found.template) == template_digest(ball())
    assert np.array_equal(found.template.faces, ball().faces)
    expected = simulate(ball(), Simulation(fields=3, edge=0.3), seed=7)
    assert np.array_equal(found.vertices, expected.vertices)
    assert np.array_equal(found.nodes, expected.nodes)
    assert np.array_equal(found.voxels.cubes, expected.voxels.cubes)
    assert found.voxels.edge == expected.voxels.edge


def test_an_interrupted_run_goes_on_where_it_stopped(tmp_path, monkeypatch):
    template, out = tmp_path / "ball.ply", tmp_path / "fields.h5"
    write_surface(template, ball())
    words = (template, "-o", out, "--fields", 6, "--workers", 1)
    words += ("--settings", '{"edge": 0.3, "shared": 2}')
    done = run(*words)
    assert done.exit_code == 0, done.exception
    expected = out.read_bytes()
    out.unlink()
    solved = SoftBody.equilibrium

    def interrupted(times):
        """Bodies that end the run once they were asked more often than so."""
        left = iter(range(times))

        def solve(*given):
            if next(left, None) is None:
                raise KeyboardInterrupt
            return solved(*given)

        return solve

    monkeypatch.setattr(SoftBody, "equilibrium", interrupted(1))
    assert run(*words).exit_code != 0
    assert not out.exists()
    folder = tmp_path / ".fields.h5.unfinished"
    (kept,) = folder.glob("*.npz")
    # What was kept is not solved for again, unless it is damaged or of other settings.
    monkeypatch.setattr(SoftBody, "equilibrium", interrupted(2))
    done = run(*words)
    assert done.exit_code == 0, done.exception
    assert out.read_bytes() == expected
    assert not folder.exists()
    monkeypatch.setattr(SoftBody, "equilibrium", interrupted(2))
    assert run(*words).exit_code != 0
    kept.write_bytes(kept.read_bytes()[:1000])
    monkeypatch.setattr(SoftBody, "equilibrium", interrupted(2))
    assert run(*words).exit_code == 0
    assert out.read_bytes() == expected
    monkeypatch.setattr(SoftBody, "equilibrium", interrupted(2))
    assert run(*words).exit_code != 0
    monkeypatch.setattr(SoftBody, "equilibrium", solved)
    assert run(*words, "--seed", 1).exit_code == 0
    assert out.read_bytes() != expected
    assert not folder.exists()


def test_a_label_of_the_mesh_says_what_is_fixed(tmp_path):
    fixed = ball().vertices[:, 2] < -0.5
    data = {"part": np.where(fixed, 3.0, 1.0).astype(np.float32), "colors": np.zeros((642, 3))}
    labelled = Surface(ball().vertices, ball().faces, "ball.ply", data)
    assert np.array_equal(labelled_vertices(labelled, "part=3"), fixed)
    for label, message in (
        ("none=1", "has no label 'none' of its vertices; it has: colors, part"),
        ("colors", "is not one number a vertex"),
        ("part=three", "ends in no number"),
        ("part=2", "fixes no vertex"),
        ("part", "fixes all 642 vertices"),
    ):
        with pytest.raises(DataError, match=message):
            labelled_vertices(labelled, label)
    write_moved(tmp_path / "ball.ply", ball(), scalars={"part": data["part"]})
    (tmp_path / "fixed.txt").write_text(" ".join(map(str, np.flatnonzero(fixed))))
    words = (tmp_path / "ball.ply", "-o", tmp_path / "fields.h5", "--fields", 2)
    words += ("--settings", '{"edge": 0.3}', "--fixed-label", "part=3")
    done = run(*words)
    assert done.exit_code == 0, done.exception
    found = read_deformations(tmp_path / "fields.h5")
    assert np.abs(found.vertices[:, fixed]).max() == 0
    done = run(*words, "--fixed", tmp_path / "fixed.txt")
    assert isinstance(done.exception, ConfigError)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "fixes no vertex"),
        ("0 1 2\nthree", "not a readable text file of vertex numbers"),
        ("0, 1, 642", "names vertices from 0 to 642, but the template has 642"),
        ("-1 3", "names vertices from -1 to 3"),
        (" ".join(map(str, range(642))), "fixes all 642 vertices"),
        (None, "not a readable text file"),
    ],
)
def test_unusable_files_of_fixed_vertices(tmp_path, text, message):
    write_surface(tmp_path / "ball.ply", ball())
    if text is not None:
        (tmp_path / "fixed.txt").write_text(text)
    out = tmp_path / "fields.h5"
    done = run(tmp_path / "ball.ply", "-o", out, "--fixed", tmp_path / "fixed.txt")
    assert isinstance(done.exception, DataError)
    assert message in str(done.exception)
    assert not out.exists()


def test_settings_that_go_down_are_refused(tmp_path):
    write_surface(tmp_path / "ball.ply", ball())
    settings = '{"poisson": [0.45, 0.3]}'
    done = run(tmp_path / "ball.ply", "-o", tmp_path / "f.h5", "--settings", settings)
    assert isinstance(done.exception, ConfigError)
    assert "`poisson` goes from 0.45 down to 0.3" in str(done.exception)


def test_files_of_fields_that_do_not_fit_their_mesh(tmp_path, fields):
    path = tmp_path / "fields.h5"
    write_deformations(path, fields, {})
    for change, message in (
        (lambda file: file["template/vertices"].write_direct(np.ones((642, 3))), "digest"),
        (lambda file: file["voxels/cubes"].write_direct(file["voxels/cubes"][()] + 10**6), "cubes"),
        (lambda file: file.pop("nodes"), "nodes"),
        (lambda file: file.attrs.pop("template"), "template"),
    ):
        write_deformations(path, fields, {})
        with h5py.File(path, "r+") as file:
            change(file)
        with pytest.raises(DataError, match=message):
            read_deformations(path)
