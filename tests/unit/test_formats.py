"""Files as other programs write them, and as people leave them: read with the right values, or
refused with the reason."""

import base64
import codecs
import gzip
import json
import struct
import subprocess
import sys
import zlib

import h5py
import numpy as np
import pytest
import trimesh

from dine.errors import DataError
from dine.geometry.surface import Surface
from dine.io.readers import read_surface
from dine.io.slicer import in_space
from dine.io.text import format_stem, format_suffix
from dine.io.writers import write_moved, write_surface

BALL = trimesh.creation.icosphere(subdivisions=1)
V, F = np.asarray(BALL.vertices).round(6), np.asarray(BALL.faces)
ROWS = "".join("{} {} {}\n".format(*row) for row in V.tolist())
OBJ = "".join(f"v {row}\n" for row in ROWS.splitlines())
OBJ += "".join("f {} {} {}\n".format(*face) for face in (F + 1).tolist())
PLY = f"ply\nformat ascii 1.0\nelement vertex {len(V)}\n"
PLY += "".join(f"property double {axis}\n" for axis in "xyz")


def read(path, content):
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return read_surface(path)


def assert_ball(surface, faces=F, tolerance=0.0):
    np.testing.assert_allclose(surface.vertices, V, rtol=0, atol=tolerance)
    np.testing.assert_array_equal(surface.faces, faces)


# --- marks before text ------------------------------------------------------------------------


def solids(*names, tail=""):
    """The ball as text STL, its triangles shared out among some solids."""
    parts = []
    for name, faces in zip(names, np.array_split(F, len(names)), strict=True):
        parts.append(f"solid {name}\n")
        for face in V[faces].tolist():
            parts.append("facet normal 0 0 1\n outer loop\n")
            parts += ["  vertex {} {} {}\n".format(*corner) for corner in face]
            parts.append(" endloop\nendfacet\n")
        parts.append(f"endsolid {name}\n")
    return "".join(parts) + tail


@pytest.mark.parametrize(
    "mark", [codecs.BOM_UTF8, "utf-16-le", "utf-16-be"], ids=["utf-8", "utf-16-le", "utf-16-be"]
)
@pytest.mark.parametrize("suffix", [".obj", ".off", ".ply", ".stl", ".xyz", ".vtk", ".gltf"])
def test_byte_order_marks(tmp_path, mark, suffix):
    plain = tmp_path / f"plain{suffix}"
    if suffix == ".stl":
        plain.write_text(solids("a"))
    elif suffix == ".gltf":
        files = trimesh.Scene(BALL).export(file_type="gltf", merge_buffers=True, embed_buffers=True)
        plain.write_bytes(files["model.gltf"])
    elif suffix == ".vtk":
        rows = "".join("3 {} {} {}\n".format(*face) for face in F.tolist())
        text = f"# vtk DataFile Version 3.0\n\nASCII\nDATASET POLYDATA\nPOINTS {len(V)} double\n"
        plain.write_text(f"{text}{ROWS}POLYGONS {len(F)} {4 * len(F)}\n{rows}")
    elif suffix == ".ply":
        write_moved(plain, Surface(V, F), text=True)
    else:
        write_moved(plain, Surface(V, None if suffix == ".xyz" else F))
    content, expected = plain.read_bytes(), read_surface(plain)
    if mark == codecs.BOM_UTF8:
        marked = mark + content
    else:
        marked = "\ufeff".encode(mark) + content.decode().encode(mark)
    found = read(tmp_path / f"marked{suffix}", marked)
    np.testing.assert_array_equal(found.vertices, expected.vertices)
    np.testing.assert_array_equal(found.faces, expected.faces)
    assert len(expected.vertices) in (len(V), 3 * len(F))


@pytest.mark.parametrize("first", ["\u200bv", "1", "<html>", "v;", "-"])
def test_an_obj_line_that_is_no_obj_is_not_skipped(tmp_path, first):
    with pytest.raises(DataError, match="a line begins with"):
        read(tmp_path / "a.obj", f"{first} 0 0 0\n{OBJ}")


def test_obj_lines_of_other_programs_are_named(tmp_path):
    text = f"mtllib a.mtl\n{OBJ}vn 0 0 1\nl 1 2\np 1\nusemtl x\nVendor_note 1\nf 1 2"
    surface = read(tmp_path / "a.obj", text)
    assert_ball(surface)
    said = ("materials", "normals", "lines", "points of faces", "lines 'vendor_note'", "edges")
    assert surface.left_out == said
    with pytest.raises(DataError, match="curved surfaces only"):
        read(tmp_path / "a.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nsurf 0 1 0 1 1 2 3\n")


# --- topology ---------------------------------------------------------------------------------


def tristrips(strips):
    flat = [corner for strip in strips for corner in (*strip, -1)]
    return f"{len(flat)} {' '.join(map(str, flat))}\n"


def test_ply_strips(tmp_path):
    head = f"{PLY}element tristrips 1\nproperty list int int vertex_indices\nend_header\n{ROWS}"
    assert_ball(read(tmp_path / "a.ply", head + tristrips(F.tolist())))
    found = read(tmp_path / "b.ply", head + tristrips([[0, 1, 2, 3, 4], [7, 8, 9]]))
    # Every second triangle of a strip is turned round, so that all face the same side.
    np.testing.assert_array_equal(found.faces, [[0, 1, 2], [1, 3, 2], [2, 3, 4], [7, 8, 9]])


def test_ply_elements_with_topology_that_is_not_read(tmp_path):
    head = f"{PLY}element range_grid 1\nproperty list uchar int vertex_indices\nend_header\n"
    with pytest.raises(DataError, match="no faces but elements 'range_grid', which are not read"):
        read(tmp_path / "a.ply", f"{head}{ROWS}3 0 1 2\n")
    both = head.replace(
        "element range_grid",
        "element face 1\nproperty list uchar int vertex_index\nelement range_grid",
    )
    surface = read(tmp_path / "b.ply", f"{both}{ROWS}3 0 1 2\n3 0 1 2\n")
    assert surface.left_out == ("elements 'range_grid'",)
    assert surface.faces.tolist() == [[0, 1, 2]]


@pytest.mark.parametrize("order", "<>")
@pytest.mark.parametrize("extra", [b"", b"\n", b"\0\0\0"])
def test_binary_ply_of_triangles_and_quads(tmp_path, order, extra):
    """As Blender writes it, with edges, a property of faces and something behind the end."""
    kind = {"<": "binary_little_endian", ">": "binary_big_endian"}[order]
    head = f"ply\r\nformat {kind} 1.0\r\nelement vertex {len(V)}\r\n"
    head += "".join(f"property float {axis}\r\n" for axis in "xyz")
    head += "element face 4\r\nproperty list uchar uint vertex_indices\r\nproperty uchar flag\r\n"
    head += "element edge 1\r\nproperty int vertex1\r\nproperty int vertex2\r\nend_header\r\n"
    body = V.astype(f"{order}f4").tobytes()
    for cell in ([0, 1, 2], [3, 4, 5, 6], [1, 2], [7, 8, 9, 10, 11]):
        body += struct.pack(f"{order}B{len(cell)}IB", len(cell), *cell, 1)
    surface = read(
        tmp_path / "a.ply", head.encode() + body + struct.pack(f"{order}2i", 0, 1) + extra
    )
    fans = [[0, 1, 2], [3, 4, 5], [3, 5, 6], [7, 8, 9], [7, 9, 10], [7, 10, 11]]
    assert_ball(surface, fans, 1e-6)
    assert surface.left_out == ("edges", "flag of faces", "elements 'edge'")
    with pytest.raises(DataError, match="ends within the rows of face"):
        read(tmp_path / "b.ply", head.encode() + body[:-3])


def test_text_ply_of_triangles_and_quads(tmp_path):
    head = f"{PLY}element face 2\nproperty uchar flag\nproperty list uchar int vertex_indices\n"
    surface = read(tmp_path / "a.ply", f"{head}end_header\n{ROWS}9 4 0 1 2 3\n9 3 4 5 6 # last\n")
    assert_ball(surface, [[0, 1, 2], [0, 2, 3], [4, 5, 6]])
    with pytest.raises(DataError, match="holds 6 numbers instead of 5"):
        read(tmp_path / "b.ply", f"{head}end_header\n{ROWS}9 3 0 1 2 3\n9 3 4 5 6\n")


def test_text_stl_of_several_solids(tmp_path):
    for names in (["a"], ["a", "b"], ["one", "two", "three"]):
        surface = read(tmp_path / "a.stl", solids(*names))
        np.testing.assert_array_equal(surface.vertices, V[F].reshape(-1, 3))
        np.testing.assert_array_equal(surface.faces, np.arange(3 * len(F)).reshape(-1, 3))
    with pytest.raises(DataError, match="cut short: its last solid does not end"):
        read(tmp_path / "a.stl", solids("a", "b").rpartition("endsolid")[0])
    with pytest.raises(DataError, match="a facet has not 3 vertices"):
        read(tmp_path / "a.stl", solids("a").replace("  vertex", "color", 1))


@pytest.mark.parametrize("name", ["faces", "triangles", "cells", "tri"])
def test_faces_of_arrays_go_by_several_names(tmp_path, name):
    np.savez(tmp_path / "a.npz", points=V, **{name: F}, label=np.arange(len(V)), other=np.ones(3))
    surface = read_surface(tmp_path / "a.npz")
    assert_ball(surface)
    np.testing.assert_array_equal(surface.data["label"], np.arange(len(V)))
    assert surface.left_out == ("other",)


# --- harmless extras --------------------------------------------------------------------------


def binary_stl(header=b""):
    facets = np.zeros(len(F), [("n", "<f4", 3), ("v", "<f4", (3, 3)), ("a", "<u2")])
    facets["v"] = V[F]
    return header.ljust(80, b"\0") + struct.pack("<I", len(F)) + facets.tobytes()


def test_complete_files_with_harmless_extras(tmp_path):
    write_surface(tmp_path / "a.ply", Surface(V, F))
    whole = (tmp_path / "a.ply").read_bytes()
    for extra in (b"\n", b"\0\0\0", b"\r\n\x1a", b"some words"):
        assert_ball(read(tmp_path / "a.ply", whole + extra))
    for header in (b"", b"solid of a scanner"):
        for extra in (b"", b"\0\0", b"\n", b"\0" * 500):
            surface = read(tmp_path / "a.stl", binary_stl(header) + extra)
            np.testing.assert_allclose(surface.vertices, V[F].reshape(-1, 3), atol=1e-6)
    for text in (f"{OBJ[:-1]} # last", f"{OBJ}f 1 2", f"{OBJ}f 1 2 # an edge\n", f"{OBJ}\n\n#\n"):
        assert_ball(read(tmp_path / "a.obj", text))
    for tail in ("; written by a scanner\n", "\n\n", "\nSaved 2026-11-30\n"):
        surface = read(tmp_path / "a.stl", solids("a", tail=tail))
        assert len(surface.faces) == len(F)
    faces = "".join("3 {} {} {} 255 0 0\n".format(*face) for face in F.tolist())
    surface = read(tmp_path / "a.off", f"OFF # a ball\n\n{len(V)} {len(F)} 0\n{ROWS}{faces}\nend\n")
    assert_ball(surface)
    assert surface.left_out == ("colors of faces",)


def test_a_binary_stl_of_more_triangles_than_announced_is_refused(tmp_path):
    with pytest.raises(DataError, match="goes on after the 80 triangles"):
        read(tmp_path / "a.stl", binary_stl() + binary_stl())


@pytest.mark.parametrize("name", ["text.ply", "binary.ply", "a.off", "a.pcd"])
def test_more_rows_than_announced_are_refused(tmp_path, name):
    path = tmp_path / name
    if path.suffix == ".pcd":
        path.write_text(pcd("ascii") + ROWS)
        more = b"0 0 0\n"
    else:
        write_moved(path, Surface(V, F), text=name == "text.ply")
        more = b"3 0 1 2\n" if name != "binary.ply" else struct.pack("<B3i", 3, 0, 1, 2)
    whole = path.read_bytes()
    np.testing.assert_array_equal(read(path, whole + b"\nwritten by someone\n").vertices, V)
    with pytest.raises(DataError, match=r"more .*than its header announces"):
        read(path, whole + more)


@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
def test_line_ends_of_all_systems(tmp_path, end):
    write_moved(tmp_path / "a.ply", Surface(V, F), text=True)
    text = (tmp_path / "a.ply").read_text()
    assert_ball(read(tmp_path / "a.ply", text.replace("\n", end)))
    assert_ball(read(tmp_path / "a.obj", OBJ.replace("\n", end)))
    surface = read(tmp_path / "a.stl", solids("a").replace("\n", end))
    assert len(surface.faces) == len(F)
    np.testing.assert_array_equal(read(tmp_path / "a.xyz", ROWS.replace("\n", end)).vertices, V)


# --- tables -----------------------------------------------------------------------------------


def table(columns, delimiter=" ", form="{}"):
    return "".join(f"{delimiter.join(form.format(x) for x in row)}\n" for row in columns.tolist())


MORE = np.hstack([V, np.arange(len(V))[:, None], np.full((len(V), 3), 7.0)])


@pytest.mark.parametrize("suffix", [".xyz", ".csv", ".tsv", ".asc", ".pts", ".particles"])
@pytest.mark.parametrize(
    ("text", "left_out"),
    [
        (table(MORE[:, :4]), ("column 4",)),
        (table(MORE, ","), ("columns 4 to 7",)),
        (table(V, ";"), ()),
        (table(V, "; ").replace(".", ","), ()),
        (table(V, ", ").replace("\n", ",\n"), ()),
        (table(V, "\t").replace(".", ","), ()),
        (table(V).replace(".", ","), ()),
        (f"{len(V)}\n{table(MORE)}", ("columns 4 to 7",)),
        (f"X Y Z\n{ROWS}", ()),
        (f'"Points:0","Points:1","Points:2"\n{table(V, ",")}', ()),
        (f"x [mm];y [mm];z [mm]\n{table(V, ';')}", ()),
        (f"//X Y Z Intensity\n{len(V)}\n{table(MORE[:, :4])}", ("column 'Intensity'",)),
        (f"# made by hand\n// x,y,z,i\n{table(MORE[:, :4], ',')}", ("column 'i'",)),
        (f"label,z,y,x\n{table(MORE[:, [3, 2, 1, 0]], ',')}", ("column 'label'",)),
        ("".join(f"{row} tumour\n" for row in ROWS.splitlines()), ("column 4",)),
    ],
)
def test_tables_with_more_than_three_columns(tmp_path, suffix, text, left_out):
    surface = read(tmp_path / f"a{suffix}", text)
    np.testing.assert_array_equal(surface.vertices, V)
    assert surface.faces is None
    assert surface.left_out == left_out


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (table(MORE[:, [3, 0, 1, 2]]), "counts its rows in its first column"),
        (f"7\n{ROWS}", r"announces 7 rows, and 42 follow"),
        (f"nx ny nz\n{ROWS}", "names its columns nx, ny, nz; expected"),
        (f"0 1 2\nx y z\n{ROWS}", "not a table"),
        (f"{ROWS}1 2\n", "number of columns changed from 3 to 2"),
        (f"{ROWS}x y z\n", "not a table of numbers"),
        ("1,5 2,5 3,5,\n", "not a table"),
    ],
)
def test_tables_that_say_something_else(tmp_path, text, said):
    with pytest.raises(DataError, match=said):
        read(tmp_path / "a.txt", text)


# --- point clouds of other programs -----------------------------------------------------------


def pcd(data, count=42, fields="x y z", size="8 8 8", kind="F F F"):
    ones = " ".join("1" for _ in fields.split())
    return (
        f"# .PCD v0.7\nVERSION 0.7\nFIELDS {fields}\nSIZE {size}\nTYPE {kind}\nCOUNT {ones}\n"
        f"WIDTH {count}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {count}\nDATA {data}\n"
    )


def lzf(content):
    """LZF that holds runs, and one reference back where the content repeats its last 8 bytes."""
    found = bytearray()
    for start in range(0, len(content), 32):
        piece = content[start : start + 32]
        found += bytes([len(piece) - 1]) + piece
    return bytes(found)


def test_pcd(tmp_path):
    text = pcd("ascii") + ROWS
    np.testing.assert_array_equal(read(tmp_path / "a.pcd", text).vertices, V)
    binary = pcd("binary").encode() + V.tobytes()
    np.testing.assert_array_equal(read(tmp_path / "a.pcd", binary).vertices, V)
    content = V.T.tobytes()  # one field after another
    packed = lzf(content)
    head = pcd("binary_compressed").encode() + struct.pack("<2I", len(packed), len(content))
    np.testing.assert_array_equal(read(tmp_path / "a.pcd", head + packed).vertices, V)
    with pytest.raises(DataError, match="damaged"):
        read(tmp_path / "a.pcd", head + packed[:-9])
    with pytest.raises(DataError, match="its header announces"):
        read(tmp_path / "a.pcd", binary[:-9])


def test_pcd_back_references(tmp_path):
    """Points 0 0 0, 0 0 0: 48 zeros, which LZF writes as one and a reference over itself."""
    packed = bytes([0, 0]) + bytes([7 << 5, 38, 0])
    head = pcd("binary_compressed", 2).encode() + struct.pack("<2I", len(packed), 48)
    np.testing.assert_array_equal(
        read(tmp_path / "a.pcd", head + packed).vertices, np.zeros((2, 3))
    )


def test_pcd_of_a_camera(tmp_path):
    """Colours in the bits of a float, padding, and pixels without a measurement."""
    rows = np.zeros(3, [("p", "<f4", 3), ("pad", "<u4"), ("rgb", "<u4"), ("label", "<u2")])
    rows["p"] = [[1, 2, 3], [np.nan] * 3, [4, 5, 6]]
    rows["rgb"], rows["label"] = [0x010203, 0, 0xFF8000], [7, 8, 9]
    head = pcd("binary", 3, "x y z _ rgb label", "4 4 4 4 4 2", "F F F U F U")
    surface = read(tmp_path / "a.pcd", head.encode() + rows.tobytes())
    np.testing.assert_array_equal(surface.vertices, [[1, 2, 3], [4, 5, 6]])
    np.testing.assert_array_equal(surface.data["colors"], [[1, 2, 3], [255, 128, 0]])
    np.testing.assert_array_equal(surface.data["label"], [7, 9])
    assert surface.left_out == ("points without a measurement",)


# --- 3D Slicer --------------------------------------------------------------------------------

FCSV = "# Markups fiducial file version = 4.11\n# CoordinateSystem = {}\n"
FCSV += "# columns = id,x,y,z,ow,ox,oy,oz,vis,sel,lock,label,desc,associatedNodeID\n"
FCSV += '1,1.5,2.5,3.5,0,0,0,1,1,1,0,F-1,,\n2,-1,0,4,0,0,0,1,1,1,0,"F, 2",,\n'
POINTS = np.array([[1.5, 2.5, 3.5], [-1, 0, 4]])


def mrk(space="LPS", status="defined"):
    points = [
        {"label": f"F-{i}", "position": row, "positionStatus": status}
        for i, row in enumerate(POINTS.tolist())
    ]
    return json.dumps({"markups": [{"coordinateSystem": space, "controlPoints": points}]})


@pytest.mark.parametrize(("said", "space"), [("LPS", "LPS"), ("RAS", "RAS"), ("0", "RAS")])
def test_landmarks_of_slicer(tmp_path, said, space):
    for name, content in (("a.fcsv", FCSV.format(said)), ("a.mrk.json", mrk(said))):
        surface = read(tmp_path / name, content)
        np.testing.assert_array_equal(surface.vertices, POINTS)
        assert surface.space == space
        turned = in_space(surface, "LPS")
        expected = POINTS if space == "LPS" else POINTS * [-1, -1, 1]
        np.testing.assert_array_equal(turned, expected)


def test_landmarks_that_cannot_be_used(tmp_path):
    with pytest.raises(DataError, match="does not say whether it is in LPS or RAS"):
        read(tmp_path / "a.fcsv", FCSV.replace("# CoordinateSystem = {}\n", ""))
    with pytest.raises(DataError, match="does not say whether it is in LPS or RAS"):
        read(tmp_path / "a.mrk.json", mrk("IJK"))
    with pytest.raises(DataError, match="'F-0' has no position; place or delete it"):
        read(tmp_path / "a.mrk.json", mrk(status="undefined"))
    with pytest.raises(DataError, match="holds no points"):
        read(tmp_path / "a.mrk.json", json.dumps({"markups": [{"coordinateSystem": "LPS"}]}))


@pytest.mark.parametrize("suffix", [".ply", ".obj", ".stl", ".vtk"])
def test_the_space_of_slicer_comes_through(tmp_path, suffix):
    for space in (None, "LPS", "RAS"):
        path = tmp_path / f"a{suffix}"
        write_moved(path, Surface(V, F, space=space), overwrite=True)
        assert read_surface(path).space == space
    left_out = write_moved(tmp_path / "a.off", Surface(V, F, space="RAS"))
    assert left_out == ("that it is in RAS",)


# --- the brain --------------------------------------------------------------------------------


def gifti(encoding, order="RowMajorOrder", values=None, *, triangles=("INT32", "i4"), rows=False):
    def array(intent, kind, values):
        stored = values if order == "RowMajorOrder" else values.T
        body = stored.tobytes()
        if encoding == "ASCII":
            lines = stored if rows else stored.reshape(1, -1)
            text = "\n".join(" ".join(map(str, line)) for line in lines.tolist())
        else:
            packed = zlib.compress(body) if encoding.startswith("GZip") else body
            text = base64.b64encode(packed).decode()
        shape = " ".join(f'Dim{i}="{n}"' for i, n in enumerate(values.shape))
        return (
            f'<DataArray Intent="NIFTI_INTENT_{intent}" DataType="NIFTI_TYPE_{kind}" '
            f'ArrayIndexingOrder="{order}" Dimensionality="{values.ndim}" {shape} '
            f'Encoding="{encoding}" Endian="LittleEndian"><Data>{text}</Data></DataArray>'
        )

    parts = [
        array("POINTSET", "FLOAT32", V.astype("<f4")),
        array("TRIANGLE", triangles[0], F.astype(f"<{triangles[1]}")),
    ]
    if values is not None:
        parts.append(array("SHAPE", "FLOAT32", values.astype("<f4")))
    return f'<?xml version="1.0"?><GIFTI Version="1.0">{"".join(parts)}</GIFTI>'


@pytest.mark.parametrize("encoding", ["ASCII", "Base64Binary", "GZipBase64Binary"])
@pytest.mark.parametrize("order", ["RowMajorOrder", "ColumnMajorOrder"])
def test_gifti(tmp_path, encoding, order):
    surface = read(tmp_path / "a.surf.gii", gifti(encoding, order, np.arange(len(V))))
    assert_ball(surface, tolerance=1e-6)
    np.testing.assert_array_equal(surface.data["shape"], np.arange(len(V)))
    with pytest.raises(DataError, match="arrays in another file"):
        read(tmp_path / "a.gii", gifti(encoding).replace(encoding, "ExternalFileBinary"))


def test_other_programs_write_the_same_gifti_and_freesurfer(tmp_path):
    nibabel = pytest.importorskip("nibabel", reason="nibabel is not installed")
    nibabel.freesurfer.write_geometry(tmp_path / "lh.pial", V, F)
    assert_ball(read_surface(tmp_path / "lh.pial"), tolerance=1e-6)
    arrays = [
        nibabel.gifti.GiftiDataArray(V.astype("f4"), "NIFTI_INTENT_POINTSET"),
        nibabel.gifti.GiftiDataArray(F.astype("i4"), "NIFTI_INTENT_TRIANGLE"),
    ]
    nibabel.save(nibabel.GiftiImage(darrays=arrays), tmp_path / "a.gii")
    assert_ball(read_surface(tmp_path / "a.gii"), tolerance=1e-6)


def freesurfer():
    head = b"\xff\xff\xfecreated by someone\n\n" + struct.pack(">2i", len(V), len(F))
    return head + V.astype(">f4").tobytes() + F.astype(">i4").tobytes()


def test_freesurfer(tmp_path):
    assert_ball(read(tmp_path / "lh.white", freesurfer()), tolerance=1e-6)
    assert_ball(read(tmp_path / "lh.pial", freesurfer() + b"volume geometry"), tolerance=1e-6)
    with pytest.raises(DataError, match="its header announces"):
        read(tmp_path / "lh.pial", freesurfer()[:-5])
    with pytest.raises(DataError, match="mris_convert"):
        read(tmp_path / "lh.pial", b"\xff\xff\xff" + freesurfer()[3:])


# --- packed -----------------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", [".ply", ".obj", ".off", ".glb", ".vtp", ".vtk", ".npz", ".mat"])
def test_gzip_of_any_mesh(tmp_path, suffix):
    write_moved(tmp_path / f"a{suffix}", Surface(V, F))
    content = (tmp_path / f"a{suffix}").read_bytes()
    surface = read(
        tmp_path / f"a{suffix}.gz", gzip.compress(content[:90]) + gzip.compress(content[90:])
    )
    assert_ball(surface, tolerance=1e-6 if suffix == ".glb" else 0)
    with pytest.raises(DataError, match="damaged"):
        read(tmp_path / f"a{suffix}.GZ", gzip.compress(content)[:-9])


def test_gzip_of_the_rest(tmp_path):
    (tmp_path / "a.triangle").write_text(table(F))
    assert_ball(read(tmp_path / "a.xyz.gz", gzip.compress(ROWS.encode())))
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["vertices"] = V
    packed = gzip.compress((tmp_path / "a.h5").read_bytes())
    with pytest.raises(DataError, match="HDF5 within gzip, which is not read; unpack it"):
        read(tmp_path / "a.h5.gz", packed)
    with pytest.raises(DataError, match=r"a\.gz has the suffix '\.gz', which is not read"):
        read(tmp_path / "a.gz", packed)
    with pytest.raises(DataError, match="its content announces"):
        read(tmp_path / "bomb.txt.gz", gzip.compress(b"0 0 0\n" * 2_000_000))


def test_names_of_formats(tmp_path):
    for name, suffix, stem in (
        ("a.b.PLY", ".ply", "a.b"),
        ("a.ply.GZ", ".ply", "a"),
        ("a.mrk.json", ".mrk.json", "a"),
        ("a.json", ".json", "a"),
    ):
        assert (format_suffix(tmp_path / name), format_stem(tmp_path / name)) == (suffix, stem)


# --- what the machine refuses -----------------------------------------------------------------


def test_a_file_that_another_program_writes_is_not_called_damaged(tmp_path):
    path = tmp_path / "a.h5"
    program = f"from dine.io.readers import read_surface; read_surface({str(path)!r})"
    with h5py.File(path, "w") as file:
        file["vertices"] = V
        file.flush()
        found = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert "is open in another program that writes to it; close it there" in found.stderr
    assert "damaged" not in found.stderr.splitlines()[-1]


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (OSError(24, "Too many open files"), "not a readable file .Too many open files"),
        (OSError(5, "Input/output error"), "not a readable file .Input/output error"),
        (MemoryError(), "needs more memory than there is"),
    ],
)
def test_faults_of_the_machine_are_not_called_damage(tmp_path, monkeypatch, error, said):
    path = tmp_path / "a.ply"
    write_surface(path, Surface(V, F))

    def fail(*args):
        raise error

    monkeypatch.setattr(type(path), "read_bytes", fail)
    with pytest.raises(DataError, match=said) as caught:
        read_surface(path)
    assert "damaged" not in str(caught.value)
