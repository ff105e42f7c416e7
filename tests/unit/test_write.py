import base64
import re
from xml.etree import ElementTree

import h5py
import numpy as np
import pytest
import scipy.io
import trimesh

from dine.errors import DataError, StorageError
from dine.geometry.surface import Surface
from dine.io.readers import READABLE_SUFFIXES, read_surface
from dine.io.writers import (
    FIELD_SUFFIXES,
    SURFACE_SUFFIXES,
    check_output,
    write_field,
    write_moved,
)

# Not in any order, with a repeated and an unused vertex: merging or sorting would show. The third
# coordinate is tiny beside the first, which a fixed number of decimals would lose.
VERTICES = np.array(
    [[3e5, 0, 0], [0, 0, 1], [0, 2, 0], [0, 0, 1e-9], [0, 0, 1], [-9, 9 / 7, 9]], dtype=np.float64
)
FACES = np.array([[3, 2, 0], [4, 0, 1], [0, 3, 1]])
MESH, CLOUD = Surface(VERTICES, FACES), Surface(VERTICES)
COLORS = np.arange(24, dtype=np.uint8).reshape(6, 4) * 10
SCALARS = {"error": np.linspace(0, 1, 6) / 3, "seen": np.array([True, False, True] * 2)}
TABLES = {".xyz", ".txt", ".csv"}
SINGLE = {".stl", ".glb"}
READABLE = [suffix for suffix in SURFACE_SUFFIXES if suffix in READABLE_SUFFIXES]


def assert_same(surface, expected, suffix=".ply"):
    vertices = expected.vertices.astype(np.float32 if suffix in SINGLE else np.float64)
    np.testing.assert_array_equal(surface.vertices, vertices)
    if expected.faces is None:
        assert surface.faces is None
    else:
        np.testing.assert_array_equal(surface.faces, expected.faces)


def test_what_is_written_can_be_read():
    everywhere = {
        ".ply",
        ".obj",
        ".off",
        ".stl",
        ".glb",
        ".vtp",
        ".vtk",
        ".npz",
        ".npy",
        ".h5",
        ".mat",
    }
    everywhere |= TABLES
    assert set(SURFACE_SUFFIXES) == everywhere
    assert everywhere <= set(READABLE_SUFFIXES)


# --- moved surfaces ---------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", READABLE)
@pytest.mark.parametrize("surface", [MESH, CLOUD], ids=["mesh", "cloud"])
@pytest.mark.parametrize(
    "extras", [{}, {"colors": COLORS, "scalars": SCALARS}], ids=["bare", "all"]
)
def test_surfaces_come_back(tmp_path, capfd, suffix, surface, extras):
    path = tmp_path / "new" / f"a{suffix}"
    if suffix == ".stl" and surface is CLOUD:
        with pytest.raises(DataError, match=r"a\.stl: STL holds triangles only"):
            write_moved(path, surface, **extras)
        assert not path.parent.exists()
        return
    left_out = write_moved(path, surface, **extras)
    back = read_surface(path)
    if suffix == ".stl":
        apart = Surface(VERTICES[FACES].reshape(-1, 3), np.arange(9).reshape(3, 3))
        assert_same(back, apart, suffix)
        assert left_out[0] == "shared vertices"
    elif "faces" in left_out:
        assert surface is MESH
        assert_same(back, CLOUD, suffix)
    else:
        assert_same(back, surface, suffix)
    assert ("colors" in left_out) == (bool(extras) and suffix in {".stl", ".off", ".npy"} | TABLES)
    assert set(SCALARS) & set(left_out) in (set(), set(SCALARS) if extras else set())
    assert [entry.name for entry in path.parent.iterdir()] == [path.name]
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("surface", [MESH, CLOUD], ids=["mesh", "cloud"])
@pytest.mark.parametrize("colors", [None, COLORS[:, :3], COLORS], ids=["none", "rgb", "rgba"])
@pytest.mark.parametrize("text", [False, True], ids=["binary", "text"])
def test_ply_holds_everything(tmp_path, surface, colors, text):
    path = tmp_path / "a.ply"
    assert write_moved(path, surface, colors=colors, scalars=SCALARS, text=text) == ()
    first = path.read_bytes()
    assert (b"format ascii 1.0" in first) == text
    assert_same(read_surface(path), surface)
    raw = trimesh.load(path, process=False).metadata["_ply_raw"]["vertex"]["data"]
    for name, values in SCALARS.items():
        np.testing.assert_array_equal(np.ravel(raw[name]), values)
    found = read_surface(path).data.get("colors")
    if colors is None:
        assert found is None
    else:
        np.testing.assert_array_equal(found[:, : colors.shape[1]], colors)
    write_moved(path, surface, colors=colors, scalars=SCALARS, text=text, overwrite=True)
    assert path.read_bytes() == first


@pytest.mark.parametrize("suffix", [".ply", ".obj", ".glb"])
@pytest.mark.parametrize("surface", [MESH, CLOUD], ids=["mesh", "cloud"])
def test_colors_come_back(tmp_path, suffix, surface):
    path = tmp_path / f"a{suffix}"
    assert write_moved(path, surface, colors=COLORS[:, :3]) == ()
    found = read_surface(path).data["colors"]
    np.testing.assert_array_equal(found[:, :3], COLORS[:, :3])
    assert found.shape == (6, 3) or (found[:, 3] == 255).all()
    clear = np.insert(COLORS[:, :3], 3, [255, 255, 255, 255, 255, 7], axis=1)
    left_out = write_moved(path, surface, colors=clear, overwrite=True)
    assert left_out == (("transparency",) if suffix == ".obj" else ())


KEPT = {
    "quality": np.linspace(0, 1, 6, dtype=np.float32),
    "label": np.array([1, 2, 3, 1, 2, 300], dtype=np.int32),
    "pair": np.arange(12, dtype=np.float64).reshape(6, 2),
    "flag": np.array([1, 0, 1, 0, 1, 0], dtype=np.uint8),
}


@pytest.mark.parametrize("suffix", [".ply", ".vtp", ".vtk", ".npz", ".h5", ".mat"])
@pytest.mark.parametrize("faces", [None, FACES], ids=["cloud", "mesh"])
def test_what_a_file_holds_of_its_vertices_comes_through(tmp_path, suffix, faces):
    source = Surface(VERTICES, faces, data=KEPT | {"colors": COLORS})
    assert write_moved(tmp_path / f"a{suffix}", source, scalars=SCALARS) == ()
    found = read_surface(tmp_path / f"a{suffix}")
    kept = dict(found.data)
    if suffix == ".ply":
        kept["pair"] = np.column_stack([kept.pop("pair_0"), kept.pop("pair_1")])
    assert kept.keys() == {*KEPT, "colors", *SCALARS}
    for name, values in (KEPT | {"colors": COLORS} | SCALARS).items():
        np.testing.assert_array_equal(kept[name], values)
    # And once more, through what was read.
    assert write_moved(tmp_path / f"b{suffix}", found) == ()
    again = read_surface(tmp_path / f"b{suffix}")
    assert again.data.keys() == found.data.keys()
    assert_same(again, source)


def test_names_of_a_files_own_data(tmp_path):
    own = {"error": np.arange(6.0), "x": np.ones(6), "Gaussian curvature": np.zeros(6)}
    own |= {"9": np.full(6, 9.0), "words": np.array(list("abcdef"))}
    source = Surface(VERTICES, data=own)
    assert write_moved(tmp_path / "a.ply", source, scalars=SCALARS) == ("words",)
    found = read_surface(tmp_path / "a.ply").data
    assert found.keys() == {
        "error",
        "seen",
        "source_error",
        "source_x",
        "Gaussian_curvature",
        "source_9",
    }
    np.testing.assert_array_equal(found["error"], SCALARS["error"])
    np.testing.assert_array_equal(found["source_error"], own["error"])
    for suffix in (".vtp", ".vtk"):
        assert write_moved(tmp_path / f"a{suffix}", source) == ("words",)
        np.testing.assert_array_equal(
            read_surface(tmp_path / f"a{suffix}").data["Gaussian curvature"], np.zeros(6)
        )
    said = write_moved(tmp_path / "a.obj", source)
    assert said == ("error", "source_x", "Gaussian_curvature", "source_9", "words")


@pytest.mark.parametrize("suffix", [".obj", ".ply"])
def test_texture_coordinates_come_through(tmp_path, suffix):
    texture = np.arange(18.0).reshape(3, 3, 2) / 18
    texture[0, 0] = texture[2, 2]
    source = Surface(VERTICES, FACES, texture=texture)
    assert write_moved(tmp_path / f"a{suffix}", source) == ()
    found = read_surface(tmp_path / f"a{suffix}")
    assert_same(found, source)
    np.testing.assert_array_equal(found.texture, texture)
    assert write_moved(tmp_path / "a.off", source) == ("texture coordinates",)


def test_textures_of_obj_files(tmp_path):
    """Vertices with several texture coordinates, quads, and faces that lack them."""
    text = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nv 0 0 1\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\nvt .5 .5\n"
    faces = "f 1/1 2/2 3/3 4/-2\nf 1/5/1 2/2/1 5/1/1\n"
    (tmp_path / "a.obj").write_text(text + faces)
    found = read_surface(tmp_path / "a.obj")
    assert found.faces.tolist() == [[0, 1, 2], [0, 2, 3], [0, 1, 4]]
    expected = [[[0, 0], [1, 0], [1, 1]], [[0, 0], [1, 1], [0, 1]], [[0.5, 0.5], [1, 0], [0, 0]]]
    np.testing.assert_array_equal(found.texture, expected)
    (tmp_path / "a.obj").write_text(f"{text}{faces}f 3 4 5\n")
    found = read_surface(tmp_path / "a.obj")
    assert found.texture is None
    assert found.left_out == ("texture coordinates",)


@pytest.mark.parametrize("suffix", [".stl", ".glb"])
def test_digits_of_large_coordinates(tmp_path, suffix):
    """A small object at coordinates of a map; what is lost is at most half a float32 step."""
    away = VERTICES[[3, 1, 2, 0, 4, 5]] * 1e-3 + [500_000, 4_000_000, 100]
    away[3] = away[0] + 1e-3
    (said,) = write_moved(tmp_path / f"a{suffix}", Surface(away, FACES))[-1:]
    assert re.search(r"coordinates this large \(it rounds them by up to 0\.\d", said)
    lost = np.abs(read_surface(tmp_path / f"a{suffix}").vertices.max(axis=0) - away.max(axis=0))
    assert 1e-4 < lost.max() <= 0.25
    near = write_moved(tmp_path / f"b{suffix}", Surface(away - away.mean(axis=0), FACES))
    assert not any("coordinates" in said for said in near)


def test_array_files_hold_everything(tmp_path):
    for suffix in (".npz", ".h5", ".mat"):
        path = tmp_path / f"a{suffix}"
        assert write_moved(path, MESH, colors=COLORS, scalars=SCALARS) == ()
        if suffix == ".h5":
            with h5py.File(path) as file:
                arrays = {name: item[:] for name, item in file.items()}
        else:
            arrays = scipy.io.loadmat(path) if suffix == ".mat" else dict(np.load(path))
        np.testing.assert_array_equal(arrays["colors"], COLORS)
        np.testing.assert_array_equal(np.ravel(arrays["error"]), SCALARS["error"])


def read_vtp(path):
    """Arrays of an XML PolyData file by element and name, read by the format's description."""
    root = ElementTree.parse(path).getroot()
    assert (root.get("byte_order"), root.get("header_type")) == ("LittleEndian", "UInt64")
    (piece,) = root.iter("Piece")
    arrays = {}
    for group in piece:
        for item in group:
            body = base64.b64decode(item.text)
            assert int.from_bytes(body[:8], "little") == len(body) - 8
            kind = {"Float64": "<f8", "Int64": "<i8", "UInt8": "u1"}[item.get("type")]
            array = np.frombuffer(body[8:], kind)
            if (columns := int(item.get("NumberOfComponents"))) > 1:
                array = array.reshape(-1, columns)
            arrays[group.tag, item.get("Name")] = array
    assert int(piece.get("NumberOfPoints")) == len(arrays["Points", "Points"])
    for kind in ("Verts", "Polys"):
        assert int(piece.get(f"NumberOf{kind}")) == len(arrays[kind, "offsets"])
    return arrays


@pytest.mark.parametrize("surface", [MESH, CLOUD], ids=["mesh", "cloud"])
def test_vtp(tmp_path, surface):
    assert write_moved(tmp_path / "a.vtp", surface, colors=COLORS, scalars=SCALARS) == ()
    arrays = read_vtp(tmp_path / "a.vtp")
    np.testing.assert_array_equal(arrays["Points", "Points"], VERTICES)
    np.testing.assert_array_equal(arrays["PointData", "colors"], COLORS)
    np.testing.assert_array_equal(arrays["PointData", "error"], SCALARS["error"])
    verts, polys = arrays["Verts", "connectivity"], arrays["Polys", "connectivity"]
    if surface is MESH:
        assert polys.tolist() == FACES.ravel().tolist()
        assert arrays["Polys", "offsets"].tolist() == [3, 6, 9]
        assert len(verts) == 0
    else:
        assert verts.tolist() == list(range(6))
        assert arrays["Verts", "offsets"].tolist() == list(range(1, 7))
        assert len(polys) == 0


def test_other_programs_read_the_mesh(tmp_path):
    for suffix in (".ply", ".obj", ".off"):
        write_moved(tmp_path / f"a{suffix}", MESH, colors=COLORS, scalars=SCALARS)
        mesh = trimesh.load(tmp_path / f"a{suffix}", process=False, maintain_order=True)
        np.testing.assert_array_equal(mesh.vertices, VERTICES)
        np.testing.assert_array_equal(mesh.faces, FACES)


def test_every_reference_mesh(tmp_path, shared):
    for path in sorted((shared / "meshes" / "objects").glob("*.ply"))[::4]:
        surface = read_surface(path)
        for suffix in (".ply", ".obj", ".off", ".glb", ".mat"):
            write_moved(tmp_path / f"a{suffix}", surface, overwrite=True)
            assert_same(read_surface(tmp_path / f"a{suffix}"), surface, suffix)


# --- fields -----------------------------------------------------------------------------------


@pytest.mark.parametrize("faces", [None, FACES])
def test_field_as_npz(tmp_path, faces):
    write_field(tmp_path / "a.npz", VERTICES, VERTICES / 7, faces=faces, scalars=SCALARS)
    arrays = dict(np.load(tmp_path / "a.npz"))
    expected = {"points": VERTICES, "displacement": VERTICES / 7, **SCALARS}
    if faces is not None:
        expected["faces"] = faces
    assert arrays.keys() == expected.keys()
    for name, array in expected.items():
        np.testing.assert_array_equal(arrays[name], array)
    assert_same(read_surface(tmp_path / "a.npz"), Surface(VERTICES, faces))


@pytest.mark.parametrize("faces", [None, FACES])
def test_field_as_vtp(tmp_path, faces):
    write_field(tmp_path / "a.vtp", VERTICES, VERTICES / 7, faces=faces, scalars=SCALARS)
    arrays = read_vtp(tmp_path / "a.vtp")
    np.testing.assert_array_equal(arrays["Points", "Points"], VERTICES)
    np.testing.assert_array_equal(arrays["PointData", "displacement"], VERTICES / 7)
    np.testing.assert_array_equal(arrays["PointData", "error"], SCALARS["error"])
    assert len(arrays["Polys", "offsets"]) == (0 if faces is None else 3)


@pytest.mark.parametrize("faces", [None, FACES])
def test_vtk_reads_the_field(tmp_path, faces):
    pyvista = pytest.importorskip("pyvista", reason="PyVista (with VTK, 140 MB) is not installed")
    write_field(tmp_path / "a.vtp", VERTICES, VERTICES / 7, faces=faces, scalars=SCALARS)
    data = pyvista.read(tmp_path / "a.vtp")
    np.testing.assert_array_equal(data.points, VERTICES)
    np.testing.assert_array_equal(data.point_data["displacement"], VERTICES / 7)
    np.testing.assert_array_equal(data.point_data["error"], SCALARS["error"])
    assert data.n_cells == (6 if faces is None else 3)


# --- what is refused --------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("write", "suffixes"),
    [
        (lambda path, **more: write_moved(path, MESH, **more), SURFACE_SUFFIXES),
        (lambda path, **more: write_field(path, VERTICES, VERTICES, **more), FIELD_SUFFIXES),
    ],
    ids=["surface", "field"],
)
def test_existing_files_stay(tmp_path, write, suffixes):
    for suffix in suffixes:
        path = tmp_path / f"a{suffix}"
        path.write_text("precious")
        with pytest.raises(StorageError, match=rf"a\{suffix} exists already; choose another name"):
            write(path)
        assert path.read_text() == "precious"
        write(path, overwrite=True)
        assert path.stat().st_size > len("precious")
    (tmp_path / "folder.npz").mkdir()
    with pytest.raises(StorageError, match=r"folder\.npz is a folder"):
        write(tmp_path / "folder.npz", overwrite=True)
    for name in ("a.blend", "a", "a.vtu"):
        with pytest.raises(DataError, match=r"which is not written; use one of .*\.npz"):
            write(tmp_path / name)
    assert not list(tmp_path.glob(".*"))


def test_a_failed_write_leaves_the_old_file(tmp_path, monkeypatch):
    path = tmp_path / "a.glb"
    write_moved(path, MESH)
    before = path.read_bytes()

    def fail(*args, **more):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(trimesh.Trimesh, "export", fail)
    with pytest.raises(StorageError, match="the disk is full"):
        write_moved(path, MESH, overwrite=True)
    assert path.read_bytes() == before
    assert [entry.name for entry in tmp_path.iterdir()] == ["a.glb"]


def test_check_output_in_advance(tmp_path):
    check_output(tmp_path / "new" / "a.PLY", SURFACE_SUFFIXES)
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ({"colors": COLORS[:5]}, r"colors are uint8 of shape \(5, 4\)"),
        ({"colors": COLORS / 255}, "colors are float64"),
        ({"scalars": {"error": np.zeros(5)}}, r"'error' is float64 of shape \(5,\)"),
        ({"scalars": {"error": np.array(["a"] * 6)}}, "'error' is <U1"),
        ({"scalars": {"vertices": np.zeros(6)}}, "'vertices' cannot name a scalar"),
        ({"scalars": {"two words": np.zeros(6)}}, "'two words' cannot name a scalar"),
        ({"scalars": {"_hidden": np.zeros(6)}}, "'_hidden' cannot name"),
    ],
)
def test_arrays_that_do_not_fit(tmp_path, more, message):
    with pytest.raises(DataError, match=message):
        write_moved(tmp_path / "a.ply", MESH, **more)
    assert list(tmp_path.iterdir()) == []


def test_fields_that_do_not_fit(tmp_path):
    with pytest.raises(DataError, match=r"shape \(5, 3\) does not fit points of shape \(6, 3\)"):
        write_field(tmp_path / "a.npz", VERTICES, VERTICES[:5])
    with pytest.raises(DataError, match="NaN or infinite"):
        write_field(tmp_path / "a.npz", VERTICES, VERTICES * np.nan)
    with pytest.raises(DataError, match="names vertex 9"):
        write_field(tmp_path / "a.npz", VERTICES, VERTICES, faces=FACES + 5)
    with pytest.raises(DataError, match="'displacement' cannot name"):
        write_field(tmp_path / "a.npz", VERTICES, VERTICES, scalars={"displacement": np.ones(6)})
