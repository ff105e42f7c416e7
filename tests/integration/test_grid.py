"""Displacement on a grid: what ITK makes of the files, and the way back."""

import json

import numpy as np
import pytest
import trimesh
from click.testing import CliRunner
from scipy.spatial.transform import Rotation

import dine
from dine.cli import cli
from dine.errors import ConfigError, DataError, StorageError
from dine.geometry.frame import Frame
from dine.geometry.lattice import MOST_VOXELS, Lattice
from dine.geometry.rigid import Alignment
from dine.geometry.surface import Surface
from dine.registration.grid import came_from
from dine.registration.types import Motion

RAS = np.array([-1.0, -1.0, 1.0])
# Mean error between voxels of a spacing of 4 that is still one of interpolation: the object is 60
# long, is moved by some 90, and its field has a kink at each of 200 samples.
BETWEEN = 0.2


@pytest.fixture(scope="module")
def result():
    """An object of three different widths, far from the origin, turned and bent."""
    mesh = trimesh.creation.icosphere(subdivisions=2)
    vertices = np.asarray(mesh.vertices) * [30, 20, 15]
    bent = vertices + 0.2 * np.column_stack([vertices[:, 1] ** 2, 0 * vertices[:, :2]]) / 20
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_euler("xyz", [20, 30, 40], degrees=True).as_matrix()
    matrix[:3, 3] = 5, -8, 11
    place = np.array([100.0, -50.0, 20.0])
    target = (bent + place) @ matrix[:3, :3].T + matrix[:3, 3]
    options = {"points": 200, "surfaces": False, "prealign": matrix}
    return dine.register((vertices + place, mesh.faces), (target, mesh.faces), **options)


@pytest.fixture(scope="module")
def sitk():
    return pytest.importorskip("SimpleITK", reason="SimpleITK, which reads the files, is missing")


def applied(sitk, path, points):
    """Points (N, 3) as ITK moves them by the displacement field in a file."""
    field = sitk.ReadImage(str(path), sitk.sitkVectorFloat64)
    transform = sitk.DisplacementFieldTransform(field)
    return np.array([transform.TransformPoint(point) for point in points.tolist()])


@pytest.mark.parametrize("suffix", [".nrrd", ".mha"])
def test_itk_moves_points_as_the_result_does(result, sitk, tmp_path, suffix):
    inside = result.source.vertices * 0.7 + 0.3 * result.source.vertices.mean(axis=0)
    points = np.concatenate([result.source.vertices, inside])
    expected = result.transform(points)
    off = []
    for spacing in (8.0, 4.0):
        grid = result.displacement_grid(spacing)
        path = tmp_path / f"{spacing}{suffix}"
        grid.write(path)
        image = sitk.ReadImage(str(path))
        assert image.GetSize() == grid.lattice.shape
        assert image.GetSpacing() == pytest.approx(3 * [spacing])
        assert image.GetDirection() == tuple(np.eye(3).ravel())
        np.testing.assert_allclose(image.GetOrigin(), grid.lattice.origin)
        off.append(np.linalg.norm(applied(sitk, path, points) - expected, axis=1).mean())
        # Between voxels ITK interpolates; there it need not.
        places = grid.lattice.places()[::97]
        inner = np.all((places > places.min(axis=0)) & (places < places.max(axis=0)), axis=1)
        voxels = places[inner]
        np.testing.assert_allclose(applied(sitk, path, voxels), result.transform(voxels), atol=1e-6)
    assert off[1] < BETWEEN
    assert off[1] < 0.8 * off[0]


def test_coordinates_of_ras_are_turned_into_lps(result, sitk, tmp_path):
    result.displacement_grid(4.0, space="ras").write(tmp_path / "field.nrrd")
    points = result.source.vertices
    found = applied(sitk, tmp_path / "field.nrrd", points * RAS) * RAS
    assert np.linalg.norm(found - result.transform(points), axis=1).mean() < BETWEEN


def test_the_inverse_leads_back(result, sitk, tmp_path):
    grid = result.displacement_grid(4.0, inverse=True)
    assert grid.unknown == 0
    grid.write(tmp_path / "back.nrrd")
    points = result.source.vertices
    found = applied(sitk, tmp_path / "back.nrrd", result.transform(points))
    assert np.linalg.norm(found - points, axis=1).mean() < BETWEEN


def test_where_a_place_came_from(result):
    rng = np.random.default_rng(3)
    goals = result.moved.vertices.mean(axis=0) + rng.normal(size=(200, 3)) * 20
    places, known = came_from(result.motion, goals)
    assert known.all()
    radius = result.alignment.frame.scale
    assert np.linalg.norm(result.transform(places) - goals, axis=1).max() < 2e-4 * radius
    # A motion that puts everything onto a sphere: nothing comes to lie anywhere else.
    alignment = Alignment(np.eye(4), Frame(np.zeros(3), 1.0))
    onto = Motion(alignment, lambda x: x / np.linalg.norm(x, axis=1, keepdims=True) - x)
    sphere = goals / np.linalg.norm(goals, axis=1, keepdims=True)
    assert came_from(onto, sphere)[1].all()
    assert not came_from(onto, 2 * sphere)[1].any()


def test_a_grid_covers_what_it_is_laid_around():
    points = np.array([[0.0, 0, 0], [10, 4, 0]])
    for settings in ({}, {"spacing": 0.7}, {"margin": 0.0}, {"spacing": 3.0, "margin": 2.5}):
        lattice = Lattice.around(points, **settings)
        places = lattice.places()
        assert len(places) == np.prod(lattice.shape)
        margin = settings.get("margin", 1.0)
        assert (places.min(axis=0) <= points.min(axis=0) - margin + 1e-9).all()
        assert (places.max(axis=0) >= points.max(axis=0) + margin - 1e-9).all()
        steps = places.reshape(*lattice.shape, 3)
        np.testing.assert_allclose(steps[1, 0, 0] - steps[0, 0, 0], [lattice.spacing, 0, 0])
        np.testing.assert_allclose(steps[0, 0, 1] - steps[0, 0, 0], [0, 0, lattice.spacing])


def test_grids_that_cannot_be_made(result, tmp_path):
    for settings, said in (
        ({"spacing": 0.0}, "spacing of the grid is 0.0; expected a positive"),
        ({"spacing": np.nan}, "spacing of the grid is nan"),
        ({"margin": -1.0}, "margin of the grid is -1.0"),
        ({"space": "scanner"}, "expected lps or ras"),
        ({"spacing": 1e-9}, "choose a spacing of at least"),
    ):
        with pytest.raises(ConfigError, match=said):
            result.displacement_grid(**settings)
    points = result.source.vertices
    with pytest.raises(ConfigError) as refused:
        Lattice.around(points, 0.01)
    least = float(str(refused.value).partition("at least ")[2].partition(",")[0])
    assert 0.5 * MOST_VOXELS < np.prod(Lattice.around(points, least).shape) <= MOST_VOXELS
    with pytest.raises(DataError, match="All points coincide"):
        Lattice.around(np.ones((5, 3)))
    with pytest.raises(DataError, match=r"is not written; use one of \.nrrd \.mha"):
        result.displacement_grid(20.0).write(tmp_path / "field.nii")


def test_commands_write_grids(result, tmp_path):
    """The same bytes as from Python; nothing is written over unless that is asked for."""
    result.save(tmp_path / "run")
    field, back, expected = (tmp_path / f"{name}.nrrd" for name in ("field", "back", "expected"))
    command = ["apply", tmp_path / "run", "--grid", field, "--grid-inverse", back]
    command = list(map(str, [*command, "--grid-spacing", 10, "--grid-margin", 5]))
    done = CliRunner().invoke(cli, [*command, "--json"])
    assert done.exit_code == 0, done.output
    told = {"files": [], "grid": str(field), "grid_inverse": str(back), "notes": []}
    assert json.loads(done.stdout) == told
    result.displacement_grid(10, margin=5).write(expected)
    assert field.read_bytes() == expected.read_bytes()
    result.displacement_grid(10, margin=5, inverse=True).write(expected, overwrite=True)
    assert back.read_bytes() == expected.read_bytes()
    assert isinstance(CliRunner().invoke(cli, command).exception, StorageError)
    assert CliRunner().invoke(cli, [*command, "--overwrite"]).exit_code == 0
    for more, said in (
        ([], "Name FILES to move"),
        (["--grid-spacing", "3"], "Name FILES to move"),
        (["a.ply"], "Missing option '-o'"),
        (["--grid", str(field), "--grid-inverse", str(field)], "Both grids would be written to"),
        (["--grid", str(tmp_path / "a.ply")], "is not written; use one of .nrrd .mha"),
    ):
        done = CliRunner().invoke(cli, ["apply", str(tmp_path / "run"), *more])
        assert said in str(done.exception or "") + done.output


def test_register_refuses_grids_before_it_computes(result, tmp_path, monkeypatch):
    monkeypatch.setattr(
        "dine.registration.register.register", lambda *args, **more: pytest.fail("computed")
    )
    surface = Surface(result.source.vertices, result.source.faces, space="RAS")
    dine.write_moved(tmp_path / "a.ply", surface)
    scans = [str(tmp_path / "a.ply")] * 2
    grid = ["--grid", str(tmp_path / "field.nrrd")]
    for more, said in (
        ([*grid, "--grid-spacing", "0.001"], "choose a spacing of at least"),
        ([*grid, "--space", "lps"], "states that it is in RAS, not in LPS"),
        (["--grid-spacing", "1"], "which is not asked for"),
    ):
        command = ["register", *scans, "-o", str(tmp_path / "m.ply"), *more]
        done = CliRunner().invoke(cli, command)
        assert isinstance(done.exception, ConfigError), done.output
        assert said in str(done.exception)
