"""Results that are kept: moved with later, written, read back and applied to further files."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh
from commands import run

import dine
from dine.errors import DataError, DineError, StorageError
from dine.geometry.surface import Surface
from dine.io.readers import read_surface
from dine.io.writers import write_moved

RNG = np.random.default_rng(3)


def scan(bend):
    mesh = trimesh.creation.icosphere(subdivisions=2)
    vertices = np.asarray(mesh.vertices) * [30, 20, 15]
    vertices = vertices + bend * np.column_stack([vertices[:, 1] ** 2, 0 * vertices[:, :2]]) / 20
    data = {"label": np.arange(len(vertices)) % 5}
    return Surface(vertices, mesh.faces, name=f"bent by {bend}", data=data)


@pytest.fixture(scope="module", params=["points", "surfaces"])
def result(request):
    further = {"a.b": scan(0.1), "cloud": RNG.normal(size=(20, 3))}
    options = {"points": 200, "surfaces": request.param == "surfaces", "apply": further}
    return dine.register(scan(0.0), scan(0.4), **options)


def assert_same_result(found, expected, shapes):
    for name in ("points", "point_displacement", "supported", "uncertainty", "point_uncertainty"):
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name))
    for name in ("source", "target", "moved"):
        one, other = getattr(found, name), getattr(expected, name)
        np.testing.assert_array_equal(one.vertices, other.vertices)
        np.testing.assert_array_equal(one.faces, other.faces)
        np.testing.assert_array_equal(one.data["label"], other.data["label"])
        assert one.name == other.name
    np.testing.assert_array_equal(found.displacement, expected.displacement)
    np.testing.assert_array_equal(found.distance_to_target, expected.distance_to_target)
    assert found.trust == expected.trust
    assert found.report == expected.report
    assert found.applied.keys() == expected.applied.keys() == found.applied_from.keys()
    for name, vertices in expected.applied_from.items():
        np.testing.assert_array_equal(found.applied_from[name], vertices)
        moved = expected.transform(vertices)
        np.testing.assert_allclose(found.applied[name].vertices, moved, rtol=0, atol=1e-9)
    for points in shapes:
        np.testing.assert_array_equal(found.transform(points), expected.transform(points))


def test_transform_moves_anything(result, tmp_path):
    source = result.source
    np.testing.assert_allclose(
        result.transform(source.vertices), result.moved.vertices, rtol=0, atol=1e-9
    )
    some = source.vertices[5:9]
    np.testing.assert_allclose(result.transform(some.tolist()), result.moved.vertices[5:9])
    assert result.transform(np.empty((0, 3))).shape == (0, 3)
    moved = result.transform(source)
    assert (moved.faces == source.faces).all()
    np.testing.assert_array_equal(moved.data["label"], source.data["label"])
    write_moved(tmp_path / "a.vtk", source)
    np.testing.assert_allclose(
        result.transform(tmp_path / "a.vtk").vertices, result.moved.vertices, atol=1e-9
    )
    for bad in ([1, 2, 3], [[1, 2]], [["a", 1, 2]], [[np.nan, 0, 0]], [[1, 2, 3], [4]]):
        with pytest.raises(DataError, match="The points"):
            result.transform(bad)


def test_results_come_back(result, tmp_path):
    said = result.save(tmp_path / "new", view=True)
    assert said == []
    names = {path.name.removeprefix("moved.") for path in (tmp_path / "new").iterdir()}
    endings = {"ply", "field.npz", "field.vtp", "json", "html", "result.npz"}
    assert names == endings | {"a.b.ply", "cloud.ply"}
    shapes = (result.source.vertices, 40 * RNG.normal(size=(50, 3)))
    for path in (
        tmp_path / "new",
        tmp_path / "new" / "moved.ply",
        tmp_path / "new" / "moved.field.vtp",
        str(tmp_path / "new" / "moved.result.npz"),
    ):
        assert_same_result(dine.load_result(path), result, shapes)
    with pytest.raises(StorageError, match="exists already"):
        result.save(tmp_path / "new")
    assert result.save(tmp_path / "new", suffix=".obj", overwrite=True)
    again = dine.load_result(tmp_path / "new")
    again.save(tmp_path / "again")
    assert_same_result(dine.load_result(tmp_path / "again"), result, shapes)


def test_results_that_cannot_be_loaded(result, tmp_path):
    with pytest.raises(DataError, match="holds no results of a registration; expected the file"):
        dine.load_result(tmp_path)
    with pytest.raises(DataError, match="holds no results"):
        dine.load_result(tmp_path / "moved.ply")
    result.save(tmp_path)
    file = tmp_path / "moved.result.npz"
    whole = file.read_bytes()
    with np.load(file) as stored:
        arrays = dict(stored)
    widths = arrays.get("field.widths")  # of a process alone
    wrong = [] if widths is None else [widths[1:], 0 * widths, widths[None]]
    process = [({"field.widths": x}, "other widths than deviations") for x in wrong]
    for content, said in (
        (whole[:-30], "damaged, cut short or no result"),
        (b"", "damaged, cut short or no result"),
        ({"about": None}, "about"),
        ({"points": arrays["points"][1:]}, "no finite array 'point_displacement'"),
        ({"moved": arrays["moved"][1:]}, "damaged"),
        ({"moved": arrays["moved"] * np.nan}, "NaN or infinite"),
        ({"scale": np.array(0.0)}, "its frame is damaged"),
        ({"alignment": 2 * np.eye(4)}, "not a rotation and a translation"),
        *process,
    ):
        if isinstance(content, bytes):
            file.write_bytes(content)
        else:
            changed = {k: v for k, v in (arrays | content).items() if v is not None}
            np.savez(file, **changed)
        with pytest.raises(DataError, match=said):
            dine.load_result(file)


def test_one_line_says_what_a_result_is(result):
    shown = repr(result)
    assert shown.startswith("<RegistrationResult bent by 0.0 → bent by 0.4: HD95 ")
    assert result.trust.verdict in shown
    assert "\n" not in shown
    assert repr(result.source) == "<Surface bent by 0.0: 162 vertices, 320 faces>"


def test_the_package_shows_what_it_has():
    """Without importing what takes long before it is asked for."""
    program = (
        "import sys, dine; names = dir(dine); assert 'torch' not in sys.modules; print(*names)"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    names = done.stdout.split()
    assert names == sorted(names)
    assert {"register", "load_result", "read_surface", "DataError", "RegistrationResult"} <= set(
        names
    )
    for name in names:
        assert getattr(dine, name) is not None
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        dine.nothing  # noqa: B018


# --- dine apply -------------------------------------------------------------------------------


def test_apply_moves_files_later(result, tmp_path):
    result.save(tmp_path / "run")
    write_moved(tmp_path / "tumour.vtk", result.source)
    (tmp_path / "marks.pts").write_text("1 2 3\n4 5 6\n900 0 0\n")
    files = (tmp_path / "tumour.vtk", tmp_path / "marks.pts")
    done = run("apply", tmp_path / "run", *files, "-o", tmp_path / "out")
    assert done.exit_code == 0, done.output
    moved = read_surface(tmp_path / "out" / "tumour.vtk")
    np.testing.assert_allclose(moved.vertices, result.moved.vertices, rtol=0, atol=1e-9)
    np.testing.assert_array_equal(moved.data["label"], result.source.data["label"])
    marks = read_surface(tmp_path / "out" / "marks.ply").vertices
    expected = result.transform([[1, 2, 3], [4, 5, 6], [900, 0, 0]])
    np.testing.assert_allclose(marks, expected, rtol=0, atol=1e-9)
    assert "33 % of its points lie farther than two radii from the source" in done.output
    done = run("apply", tmp_path / "run", *files, "-o", tmp_path / "out")
    assert isinstance(done.exception, StorageError)
    more = ("-o", tmp_path / "out", "--suffix", ".vtp", "--overwrite")
    done = run("apply", tmp_path / "run" / "moved.json", *files, *more, "--json")
    told = json.loads(done.stdout)["files"]
    assert [Path(one["source"]) for one in told] == list(files)
    assert Path(told[1]["moved"]) == tmp_path / "out" / "marks.vtp"
    assert "33 % of its points" in told[1]["notes"][0]
    assert len(read_surface(tmp_path / "out" / "marks.vtp").vertices) == 3


def test_apply_writes_nothing_where_a_file_cannot_be_moved(result, tmp_path):
    result.save(tmp_path / "run")
    write_moved(tmp_path / "a.ply", result.source)
    (tmp_path / "other").mkdir()
    write_moved(tmp_path / "other" / "a.ply", result.source)
    (tmp_path / "bad.ply").write_text("ply\n")
    (tmp_path / "cloud.xyz").write_text("1 2 3\n")
    for files, more, said in (
        (("a.ply", "bad.ply"), (), "bad.ply is damaged"),
        (("a.ply", "none.ply"), (), "none.ply does not exist"),
        (("a.ply", "other/a.ply"), (), "the same name"),
        (("a.ply",), ("--suffix", ".blend"), "is not written"),
        (("a.ply", "cloud.xyz"), ("--suffix", ".stl"), "STL holds triangles only"),
    ):
        paths = [tmp_path / file for file in files]
        done = run("apply", tmp_path / "run", *paths, "-o", tmp_path / "out", *more)
        assert isinstance(done.exception, DineError), done.output
        assert said in str(done.exception)
        assert not (tmp_path / "out").exists()
