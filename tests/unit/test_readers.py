import io
import pickle
import struct
from pathlib import Path

import h5py
import numpy as np
import pytest
import scipy.io
import trimesh

from dine.errors import DataError
from dine.geometry.surface import Surface
from dine.io.readers import READABLE_SUFFIXES, read_surface
from dine.io.writers import write_surface

# Not in any order, with a repeated and an unused vertex: merging or sorting would show.
VERTICES = np.array(
    [[3, 0, 0], [0, 0, 1], [0, 2, 0], [0, 0, 0.1], [0, 0, 1], [-9, 9, 9]], dtype=np.float64
)
FACES = np.array([[3, 2, 0], [4, 0, 1], [0, 3, 1]])
ROWS = "\n".join(" ".join(map(str, row)) for row in VERTICES)
SCALARS = "".join(f"property float {axis}\n" for axis in "xyz")


def assert_same(surface, vertices=VERTICES, faces=FACES, tolerance=1e-7):
    np.testing.assert_allclose(surface.vertices, vertices, rtol=0, atol=tolerance)
    assert surface.vertices.dtype == np.float64
    if faces is None:
        assert surface.faces is None
    else:
        np.testing.assert_array_equal(surface.faces, faces)
        assert surface.faces.dtype == np.int64


def obj_text(faces=FACES, corner="{}"):
    lines = [f"v {x} {y} {z}" for x, y, z in VERTICES]
    lines += ["f " + " ".join(corner.format(i + 1) for i in face) for face in faces]
    return "\n".join(lines) + "\n"


def off_text():
    faces = "\n".join("3 " + " ".join(map(str, face)) for face in FACES)
    return f"OFF\n6 3 0\n{ROWS}\n{faces}\n"


def ply_text(faces=FACES):
    rows = "\n".join(f"{len(face)} " + " ".join(map(str, face)) for face in faces)
    return (
        f"ply\nformat ascii 1.0\nelement vertex 6\n{SCALARS}element face {len(faces)}\n"
        f"property list uchar int vertex_indices\nend_header\n{ROWS}\n{rows}\n"
    )


def test_every_suffix_is_covered_here():
    meshes = {".ply", ".obj", ".off", ".stl", ".glb", ".gltf", ".vtp", ".vtk", ".vtu"}
    arrays = {".xyz", ".txt", ".csv", ".npy", ".npz", ".h5", ".mat"}
    assert meshes | arrays <= set(READABLE_SUFFIXES)
    assert all(suffix == suffix.lower() and suffix[0] == "." for suffix in READABLE_SUFFIXES)


# --- writing and reading back -----------------------------------------------------------------


@pytest.mark.parametrize("faces", [FACES, None], ids=["mesh", "cloud"])
def test_ply_gives_back_the_same_arrays(tmp_path, faces):
    vertices = VERTICES + np.pi * 1e-13
    path = tmp_path / "new" / "a.ply"
    write_surface(path, Surface(vertices, faces))
    first = path.read_bytes()
    surface = read_surface(path)
    assert_same(surface, vertices, faces, tolerance=0)
    assert surface.name == str(path)
    write_surface(path, surface)
    assert path.read_bytes() == first
    assert [p.name for p in path.parent.iterdir()] == ["a.ply"]


def test_other_programs_read_the_ply(tmp_path):
    write_surface(tmp_path / "a.ply", Surface(VERTICES, FACES))
    mesh = trimesh.load(tmp_path / "a.ply", process=False)
    np.testing.assert_array_equal(mesh.vertices, VERTICES)
    np.testing.assert_array_equal(mesh.faces, FACES)


def test_xyz_gives_back_the_same_cloud(tmp_path):
    vertices = VERTICES / 3
    write_surface(tmp_path / "a.xyz", Surface(vertices))
    assert_same(read_surface(tmp_path / "a.xyz"), vertices, None, tolerance=0)


def test_what_cannot_be_written(tmp_path):
    with pytest.raises(DataError, match=r"a\.obj: surfaces are written as \.ply or \.xyz"):
        write_surface(tmp_path / "a.obj", Surface(VERTICES))
    with pytest.raises(DataError, match=r"a\.xyz: \.xyz holds no faces"):
        write_surface(tmp_path / "a.xyz", Surface(VERTICES, FACES))
    assert list(tmp_path.iterdir()) == []


# --- meshes -----------------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", [".ply", ".obj", ".off", ".glb", ".gltf", ".PLY"])
def test_formats_that_trimesh_writes(tmp_path, suffix):
    mesh = trimesh.Trimesh(VERTICES, FACES, process=False)
    path = tmp_path / f"a{suffix}"
    if suffix == ".gltf":
        for name, content in trimesh.exchange.gltf.export_gltf(trimesh.Scene(mesh)).items():
            (tmp_path / name.replace("model.gltf", "a.gltf")).write_bytes(content)
    else:
        mesh.export(path, file_type=suffix[1:].lower())
    assert_same(read_surface(path))


@pytest.mark.parametrize("kind", ["stl", "stl_ascii"])
def test_stl_keeps_its_triangles_apart(tmp_path, kind):
    mesh = trimesh.Trimesh(VERTICES, FACES, process=False)
    mesh.export(tmp_path / "a.stl", file_type=kind)
    expected = VERTICES[FACES].reshape(-1, 3)
    assert_same(read_surface(tmp_path / "a.stl"), expected, np.arange(9).reshape(3, 3))


@pytest.mark.parametrize(
    "text",
    [
        obj_text(),
        obj_text(corner="{0}/1/2"),
        obj_text(corner="{0}//7"),
        "mtllib no.mtl\nvt 0 0\nvn 0 0 1\no one\n" + obj_text(corner="{0}/1/1"),
        obj_text().replace("f 5", "usemtl other\no two\nf 5"),
        obj_text(FACES - 7),  # counted back from the last vertex
        obj_text().replace("f ", "# f 1 2 3\nf \\\n").replace("\n", "\r\n"),
    ],
    ids=["plain", "texture", "normal", "headers", "materials", "negative", "continued"],
)
def test_obj_keeps_every_vertex(tmp_path, text):
    (tmp_path / "a.obj").write_bytes(text.encode())
    assert_same(read_surface(tmp_path / "a.obj"))


def test_obj_negative_indices_count_from_where_they_stand(tmp_path):
    triangle = "v 0 0 {0}\nv 1 0 {0}\nv 0 1 {0}\nf -3 -2 -1\n"
    (tmp_path / "a.obj").write_text(triangle.format(0) + triangle.format(1))
    np.testing.assert_array_equal(read_surface(tmp_path / "a.obj").faces, [[0, 1, 2], [3, 4, 5]])


def test_polygons_become_triangles(tmp_path):
    (tmp_path / "a.obj").write_text(obj_text([[0, 1, 2, 3, 4]]))
    assert_same(read_surface(tmp_path / "a.obj"), faces=[[0, 1, 2], [0, 2, 3], [0, 3, 4]])
    (tmp_path / "a.ply").write_text(ply_text([[0, 1, 2, 3], [3, 4, 5]]))
    assert len(read_surface(tmp_path / "a.ply").faces) == 3


def test_ply_with_texture_seams_keeps_its_vertices(tmp_path):
    text = ply_text([[0, 1, 2], [0, 1, 3]]).replace(
        "end_header", "property list uchar float texcoord\nend_header"
    )
    text = text.replace("3 0 1 2\n", "3 0 1 2 6 0 0 1 0 1 1\n")
    text = text.replace("3 0 1 3\n", "3 0 1 3 6 0 0 0 1 1 1\n")
    (tmp_path / "a.ply").write_text(text)
    assert_same(read_surface(tmp_path / "a.ply"), faces=[[0, 1, 2], [0, 1, 3]])


def test_the_meshes_of_a_scene_follow_each_other(tmp_path):
    scene = trimesh.Scene()
    for shift in range(5):
        matrix = trimesh.transformations.translation_matrix([shift, 0, 0])
        mesh = trimesh.Trimesh(VERTICES, FACES, process=False)
        scene.add_geometry(mesh, geom_name=f"part{shift}", transform=matrix)
    scene.export(tmp_path / "a.glb")
    surface = read_surface(tmp_path / "a.glb")
    expected = [np.add(VERTICES, [shift, 0, 0]) for shift in range(5)]
    assert_same(
        surface,
        np.concatenate(expected),
        np.concatenate([FACES + 6 * shift for shift in range(5)]),
        tolerance=1e-6,
    )


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("a.ply", ply_text([])),
        ("a.obj", obj_text([])),
        ("a.off", f"OFF\n6 0 0\n{ROWS}\n"),
        ("a.off", f"OFF 6 0 0 # counts\n\n# points\n{ROWS}\n"),
    ],
)
def test_meshes_without_faces_are_clouds(tmp_path, name, text):
    (tmp_path / name).write_text(text)
    assert_same(read_surface(tmp_path / name), faces=None)


# --- VTK --------------------------------------------------------------------------------------

SAMPLES = Path(__file__).parents[1] / "data" / "vtk"
"""Written by VTK; see ``write.py`` there."""
GRID = [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [2, 0, 0.5], [3, 0, 1], [3, 1, 1], [2, 2, 0.5]]
GRID += [[9, 9, 9]]
FANS = [[0, 1, 2], [4, 5, 6], [4, 6, 7], [0, 1, 6], [0, 6, 7], [0, 7, 3]]
# Every second triangle of a strip is turned round, so that all face the same side.
STRIP = [[0, 1, 3], [1, 2, 3], [3, 2, 7]]


@pytest.mark.parametrize("name", sorted(p.name for p in SAMPLES.glob("*.vt*")))
def test_vtk_samples(name):
    if name == "raw_lz4.vtp":
        with pytest.raises(DataError, match=r"vtkLZ4DataCompressor.*ZLib or None"):
            read_surface(SAMPLES / name)
        return
    faces = {"strips": STRIP, "cloud": None}.get(name.partition(".")[0], FANS)
    found = read_surface(SAMPLES / name)
    assert_same(found, GRID, faces)
    assert ("lines" in found.left_out) == name.startswith("grid")


def test_grids_of_volumes_are_refused(tmp_path):
    content = (SAMPLES / "grid_4.vtk").read_bytes()
    kinds = struct.pack(">4i", 5, 9, 7, 3)
    for said, new in (("with volumes or curved cells; .*Extract Surface", (10, 9, 7, 3)), ("", ())):
        changed = content.replace(kinds, struct.pack(f">{len(new)}i", *new))
        assert changed != content
        (tmp_path / "a.vtk").write_bytes(changed)
        with pytest.raises(DataError, match=said or "damaged, cut short"):
            read_surface(tmp_path / "a.vtk")
    for name in ("a.vtp", "a.vtk"):  # whatever it is called
        (tmp_path / name).write_bytes((SAMPLES / "grid.vtu").read_bytes())
        assert_same(read_surface(tmp_path / name), GRID, FANS)


def test_pieces_of_a_vtp_follow_each_other(tmp_path):
    text = (SAMPLES / "text.vtp").read_text()
    piece = text[text.index("<Piece") : text.index("</Piece>") + len("</Piece>")]
    (tmp_path / "a.vtp").write_text(text.replace(piece, piece + piece))
    faces = np.concatenate([FANS, np.array(FANS) + len(GRID)])
    assert_same(read_surface(tmp_path / "a.vtp"), GRID + GRID, faces)


@pytest.mark.parametrize(
    ("name", "old", "new", "said"),
    [
        ("raw.vtp", -300, b"", "damaged, cut short"),
        ("raw_zlib.vtp", -300, b"", "damaged, cut short"),
        ("appended_zlib.vtp", -300, b"", "damaged, cut short"),
        ("inline.vtp", -300, b"", "damaged, cut short"),
        ("binary_4.vtk", -500, b"", "damaged, cut short"),
        ("text_4.vtk", 120, b"", "numbers where 27 are announced"),
        ("text.vtp", b'NumberOfPoints="9"', b'NumberOfPoints="8"', "9 points where 8"),
        ("text.vtp", b"<Points>", b"<Pts>", "damaged"),
        ("text.vtp", b"VTKFile type", b"VTKFile kind", "of the kind None"),
        ("text_4.vtk", b"0 0 0", b"0 0 nan", "NaN or infinite"),
        ("text_4.vtk", b"3 0 1 2", b"2 0 1 2", "do not add up|fewer than 3 corners"),
        ("text.vtp", b"3 7 12", b"3 7 11", "faces of 11 corners where there are 12"),
        ("text_4.vtk", b"3 0 1 2", b"3 0 1 99", "names vertex 99"),
        ("text_4.vtk", b"DATASET", b"NOTHING", "names no data set"),
        ("text_4.vtk", b"POINTS 9", b"POINTS 0", "holds no points"),
    ],
)
def test_damaged_vtk(tmp_path, name, old, new, said):
    content = (SAMPLES / name).read_bytes()
    changed = content[:old] if isinstance(old, int) else content.replace(old, new, 1)
    assert changed != content
    (tmp_path / name).write_bytes(changed)
    with pytest.raises(DataError, match=said) as caught:
        read_surface(tmp_path / name)
    assert "\n" not in str(caught.value)


# --- tables and arrays ------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", [".xyz", ".txt", ".csv"])
@pytest.mark.parametrize("delimiter", [" ", ",", "\t", ", "])
@pytest.mark.parametrize("normals", [False, True])
def test_tables(tmp_path, suffix, delimiter, normals):
    table = np.hstack([VERTICES, VERTICES + 5]) if normals else VERTICES
    np.savetxt(tmp_path / f"a{suffix}", table, delimiter=delimiter)
    assert_same(read_surface(tmp_path / f"a{suffix}"), faces=None)


def test_a_single_row_with_a_byte_order_mark(tmp_path):
    (tmp_path / "a.csv").write_text("\ufeff1,2,3\n", encoding="utf-8")
    assert_same(read_surface(tmp_path / "a.csv"), [[1, 2, 3]], None)


@pytest.mark.parametrize("form", ["%d", "%.6f", "%d,"])
def test_simtool_pair(tmp_path, form):
    np.savetxt(tmp_path / "Source_1_5_0.3.xyz", VERTICES)
    rows = [" ".join(form % i for i in face).rstrip(",") for face in FACES]
    (tmp_path / "Source_1_5_0.3.triangle").write_text("\n".join(rows))
    assert_same(read_surface(tmp_path / "Source_1_5_0.3.xyz"))


@pytest.mark.parametrize("dtype", [np.float64, np.float32, np.int16, ">f4"])
def test_npy(tmp_path, dtype):
    np.save(tmp_path / "a.npy", np.hstack([VERTICES, VERTICES]).astype(dtype))
    assert_same(read_surface(tmp_path / "a.npy"), VERTICES.astype(dtype), None)


@pytest.mark.parametrize("name", ["vertices", "points"])
@pytest.mark.parametrize("faces", [None, FACES, FACES.astype(np.uint8), FACES.astype(float)])
def test_npz_h5_and_mat(tmp_path, name, faces):
    arrays = {name: VERTICES, "other": np.zeros((2, 2, 2))}
    if faces is not None:
        arrays["faces"] = faces
    np.savez_compressed(tmp_path / "a.npz", **arrays)
    scipy.io.savemat(tmp_path / "a.mat", arrays)
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file.create_group("group")
        for key, value in arrays.items():
            file[key] = value
    for suffix in ("npz", "mat", "h5"):
        assert_same(read_surface(tmp_path / f"a.{suffix}"), faces=faces)


@pytest.mark.parametrize("version", ["5", "7.3"])
def test_mat_counts_from_one_only_when_it_must(tmp_path, version):
    def save(**arrays):
        if version == "5":
            scipy.io.savemat(tmp_path / "a.mat", arrays)
        else:
            with h5py.File(tmp_path / "a.mat", "w", userblock_size=512) as file:
                for key, value in arrays.items():
                    file[key] = np.asarray(value, dtype=float).T
        return read_surface(tmp_path / "a.mat")

    used = VERTICES[:5]
    assert_same(save(vertices=used, faces=FACES + 1), used)
    assert_same(save(vertices=used, faces=FACES), used)
    # All of 1..4 of 5: an unused first vertex is as likely as an unused last one.
    assert_same(save(vertices=used, faces=FACES[:1] + 1), used, FACES[:1] + 1)
    assert_same(save(cloud=used, label=np.zeros((1, 1))), used, None)
    with pytest.raises(DataError, match=r"named 'vertices' or 'points' \(arrays found: a, b\)"):
        save(a=used, b=used)


def test_faces_elsewhere_are_never_shifted(tmp_path):
    np.savez(tmp_path / "a.npz", vertices=VERTICES[:5], faces=FACES + 1)
    with pytest.raises(DataError, match=r"a\.npz: a face names vertex 5"):
        read_surface(tmp_path / "a.npz")


def test_every_reference_mesh(shared):
    paths = sorted((shared / "meshes" / "objects").glob("*.ply"))
    assert len(paths) >= 20
    for path in paths:
        surface = read_surface(path)
        header = path.read_bytes()[:2000].decode("latin-1")
        counts = [
            int(header.split(f"element {what} ")[1].split()[0]) for what in ("vertex", "face")
        ]
        assert [len(surface.vertices), len(surface.faces)] == counts


# --- what is refused --------------------------------------------------------------------------


class Trap:
    """Creates a file when it is unpickled."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return open, (str(self.path), "w")


def binary(kind):
    data = io.BytesIO()
    trimesh.Trimesh(VERTICES, FACES, process=False).export(data, file_type=kind)
    return data.getvalue()


def npy(array):
    data = io.BytesIO()
    np.save(data, np.asarray(array))
    return data.getvalue()


def npz(**arrays):
    data = io.BytesIO()
    np.savez(data, **arrays)
    return data.getvalue()


GARBAGE = b"\x80\x04\xff not a mesh \x00" * 20
NAN = np.where(VERTICES == 9, np.nan, VERTICES)


@pytest.mark.parametrize("suffix", READABLE_SUFFIXES)
@pytest.mark.parametrize(("content", "message"), [(b"", "is empty; expected"), (GARBAGE, "")])
def test_empty_files_and_garbage(tmp_path, suffix, content, message):
    path = tmp_path / f"bad{suffix}"
    path.write_bytes(content)
    with pytest.raises(DataError, match=rf"bad\{suffix}.*{message}") as caught:
        read_surface(path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.ply", binary("ply")[:-5], "damaged, cut short"),
        ("a.ply", ply_text().encode()[:-8], "cut short"),
        ("a.ply", ply_text().encode()[:-3], "cut short"),
        ("a.ply", ply_text([]).encode()[:-8], "cut short"),
        ("a.ply", b"ply\nformat ascii 1.0\n", ""),
        ("a.ply", ply_text().replace("3 4 0 1", "3 4 0 6").encode(), "names vertex 6"),
        ("a.ply", ply_text().replace("-9.0", "nan").encode(), "1 of 6 vertices are NaN"),
        ("a.off", off_text().encode()[:-8], "cut short"),
        ("a.off", off_text().encode()[:-3], "cut short"),
        ("a.off", b"OFF\n", "damaged"),
        ("a.stl", binary("stl")[:-5], "cut short"),
        ("a.stl", binary("stl_ascii")[:-20], "cut short"),
        ("a.glb", binary("glb")[:-50], "damaged, cut short"),
        ("a.obj", obj_text().encode()[:-5], "fewer than 3 corners"),
        ("a.obj", b"v 0 0\n", "damaged"),
        ("a.obj", b"# nothing\n", "holds no mesh and no points"),
        ("a.obj", obj_text(FACES + 6).encode(), "names vertex 10"),
        ("a.obj", b"v 0 0 inf\n", "NaN or infinite"),
        ("a.xyz", b"1 2 3\n4 5\n", "number of columns changed"),
        ("a.xyz", b"6\ncomment\n1 2 3\n", "announces 6 rows, and 2 follow"),
        ("a.txt", b"1 2\n3 4\n", "has 2 columns; expected x, y and z first"),
        ("a.txt", b"1 " * 16, "has 16 columns; expected x, y and z first"),
        ("a.txt", b"# only a comment\n", "holds no rows"),
        ("a.csv", b"a,b,c\n1,2,3\n", "names its columns a, b, c; expected .* x, y and z"),
        ("a.csv", b"x,y,z\n", "holds no rows"),
        ("a.csv", b"1,,3\n", "not a table"),
        ("a.csv", b"1,5 2,5 3;5\n", "2 columns"),
        ("a.csv", b"1,2,nan\n", "NaN or infinite"),
        ("a.npy", npy(VERTICES)[:-9], "damaged, cut short"),
        ("a.npy", npy(VERTICES[:, :2]), r"shape \(6, 2\); expected numbers"),
        ("a.npy", npy(VERTICES + 1j), "array of complex128"),
        ("a.npy", npy(NAN), "NaN or infinite"),
        ("a.npy", npz(vertices=VERTICES), "damaged"),
        ("a.npz", npz(vertices=VERTICES)[:-30], "not a zip archive"),
        ("a.npz", npy(VERTICES), "not a zip archive"),
        ("a.npz", npz(xyz=VERTICES), r"named 'vertices' or 'points' \(arrays found: xyz\)"),
        ("a.npz", npz(vertices=VERTICES[:0]), "holds no vertices"),
        ("a.npz", npz(vertices=VERTICES, faces=FACES + 0.5), r"not whole numbers .*3\.5"),
        ("a.npz", npz(vertices=VERTICES, faces=FACES * np.nan), "not whole numbers .*nan"),
        ("a.npz", npz(vertices=VERTICES, faces=FACES + 1e300), "not whole numbers"),
        ("a.npz", npz(vertices=VERTICES, faces=FACES - 1), "a face names vertex -1, but"),
        ("a.npz", npz(vertices=VERTICES, faces=FACES[:, :2]), r"faces of shape \(F, 3\)"),
        ("a.npz", npz(vertices=VERTICES, faces=FACES.astype(str)), "faces of type <U"),
        ("a.blend", b"x", r"suffix '\.blend', which is not read; convert it"),
        ("a.triangle", b"0 1 2", r"suffix '\.triangle'"),
    ],
)
def test_bad_files(tmp_path, name, content, message):
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(DataError, match=rf"{name}.*{message}") as caught:
        read_surface(path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("0 1 2.5\n", "not whole numbers"),
        ("0 1 2 3\n", r"a\.triangle has 4 columns; expected 3"),
        ("0 1 9\n", "a face names vertex 9"),
        ("", r"a\.triangle holds no rows"),
        ("0 1 2\n0 1\n", r"a\.triangle is not a table"),
    ],
)
def test_bad_triangle_files(tmp_path, text, message):
    np.savetxt(tmp_path / "a.xyz", VERTICES)
    (tmp_path / "a.triangle").write_text(text)
    with pytest.raises(DataError, match=message):
        read_surface(tmp_path / "a.xyz")


def test_pickles_are_never_loaded(tmp_path):
    touched = tmp_path / "touched"
    trap = np.array([[Trap(touched)] * 3], dtype=object)
    np.save(tmp_path / "a.npy", trap, allow_pickle=True)
    np.savez(tmp_path / "a.npz", vertices=trap)
    for suffix in (".npy", ".npz"):
        (tmp_path / f"bare{suffix}").write_bytes(pickle.dumps(Trap(touched)))
    for name in ("a.npy", "a.npz", "bare.npy", "bare.npz"):
        with pytest.raises(DataError, match=rf"{name} is damaged"):
            read_surface(tmp_path / name)
    assert not touched.exists()


def test_hdf5_and_mat_that_are_damaged_or_hold_something_else(tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["vertices"] = ["a", "b"]
    with pytest.raises(DataError, match=r"a\.h5 holds an array of object"):
        read_surface(tmp_path / "a.h5")
    (tmp_path / "cut.h5").write_bytes((tmp_path / "a.h5").read_bytes()[:-100])
    with pytest.raises(DataError, match=r"cut\.h5 is damaged, cut short"):
        read_surface(tmp_path / "cut.h5")
    scipy.io.savemat(tmp_path / "a.mat", {"vertices": "text", "cell": np.array([[1], "a"], object)})
    with pytest.raises(DataError, match=r"a\.mat has no .*arrays found: none"):
        read_surface(tmp_path / "a.mat")
    scipy.io.savemat(tmp_path / "b.mat", {"vertices": VERTICES})
    (tmp_path / "cut.mat").write_bytes((tmp_path / "b.mat").read_bytes()[:-40])
    with pytest.raises(DataError, match=r"cut\.mat is damaged, cut short"):
        read_surface(tmp_path / "cut.mat")


def test_files_that_are_not_there(tmp_path):
    with pytest.raises(DataError, match=r"none\.ply does not exist; check the path"):
        read_surface(tmp_path / "none.ply")
    (tmp_path / "folder.ply").mkdir()
    with pytest.raises(DataError, match=r"folder\.ply is not a readable file"):
        read_surface(tmp_path / "folder.ply")
