"""Files that bend the rules of their format without losing anything: read, or refused with the
reason."""

import gzip
import json
import struct

import numpy as np
import pytest
from test_formats import (
    FCSV,
    OBJ,
    PLY,
    ROWS,
    F,
    V,
    assert_ball,
    freesurfer,
    gifti,
    mrk,
    read,
    solids,
)

from dine.errors import DataError
from dine.io.readers import read_surface

FACES = "".join("3 {} {} {}\n".format(*face) for face in F.tolist())
OFF = f"OFF\n{len(V)} {len(F)} 0\n{ROWS}{FACES}"
PLY_FACES = f"{PLY}element face {len(F)}\nproperty list uchar int vertex_indices\nend_header\n"


def assert_corners(surface):
    np.testing.assert_array_equal(surface.vertices, V[F].reshape(-1, 3))


# --- letters ----------------------------------------------------------------------------------


@pytest.mark.parametrize("coding", ["utf-16-le", "utf-16-be", "utf-32", "utf-32-le", "utf-32-be"])
@pytest.mark.parametrize("suffix", [".obj", ".off", ".ply", ".stl", ".xyz", ".gii"])
def test_codings_of_several_bytes_a_letter(tmp_path, coding, suffix):
    texts = {".obj": OBJ, ".off": OFF, ".stl": solids("a"), ".xyz": ROWS}
    texts[".ply"] = PLY_FACES + ROWS + FACES
    texts[".gii"] = gifti("ASCII").replace("<?xml ", f"<?xml encoding='{coding.upper()}' ")
    found = read(tmp_path / f"a{suffix}", texts[suffix].encode(coding))
    if suffix == ".stl":
        assert_corners(found)
    else:
        assert_ball(found, faces=None if suffix == ".xyz" else F, tolerance=1e-6)


def test_letters_as_windows_writes_them(tmp_path):
    rows = "".join(f"{row.replace(' ', ',')},1\n" for row in ROWS.splitlines())
    table = read(tmp_path / "a.csv", f"x,y,z,Größe\n{rows}".encode("cp1252"))
    assert table.left_out == ("column 'Größe'",)
    assert_ball(read(tmp_path / "a.obj", f"# Größe\n{OBJ}".encode("cp1252")))


@pytest.mark.parametrize("end", ["\x1a", "\0\0\0", "\n\x1a\0"])
def test_what_copies_leave_behind_the_end_of_text(tmp_path, end):
    assert_ball(read(tmp_path / "a.obj", OBJ + end))
    assert_ball(read(tmp_path / "a.off", OFF + end))
    assert_ball(read(tmp_path / "a.xyz", ROWS + end), faces=None)
    assert_corners(read(tmp_path / "a.stl", solids("a") + end))


def test_decimal_commas_are_called_so(tmp_path):
    for name, text in (("a.obj", OBJ), ("a.off", OFF), ("a.stl", solids("a"))):
        with pytest.raises(DataError, match=r"has decimal commas \(-?0,\d+\); export it again"):
            read(tmp_path / name, text.replace(".", ","))


# --- lines ------------------------------------------------------------------------------------


def test_files_whose_lines_end_elsewhere(tmp_path):
    assert_ball(read(tmp_path / "a.ply", PLY_FACES + " ".join(f"{ROWS}{FACES}".split())))
    assert_ball(read(tmp_path / "a.ply", PLY_FACES + "\n".join(f"{ROWS}{FACES}".split())))
    assert_ball(read(tmp_path / "a.off", " ".join(OFF.split())))
    for names in (["a"], ["left lobe", "right lobe"]):
        assert_corners(read(tmp_path / "a.stl", " ".join(solids(*names).split())))
    for name, text in (("a.ply", PLY_FACES + " ".join(ROWS.split())), ("a.off", OFF[:-7])):
        with pytest.raises(DataError, match="cut short"):
            read(tmp_path / name, text if name == "a.ply" else " ".join(text.split()))


def test_stl_with_lines_before_the_solid(tmp_path):
    text = "; written by a scanner\n# of ours\n\n" + solids("facet of vertex", "b c")
    assert_corners(read(tmp_path / "a.stl", text))


# --- OFF and OBJ ------------------------------------------------------------------------------


def test_kinds_of_off(tmp_path):
    assert_ball(read(tmp_path / "a.off", OFF.replace("OFF\n", "")))
    assert_ball(read(tmp_path / "a.off", OFF.replace("OFF", "off")))
    for word, more in (("COFF", " 255 0 0 255"), ("CNOFF", " 0 0 1 255 0 0 255")):
        text = OFF.replace("OFF", word).replace(ROWS, ROWS.replace("\n", f"{more}\n"))
        found = read(tmp_path / "a.off", text)
        assert_ball(found)
        assert (found.data["colors"] == [255, 0, 0, 255]).all()
    for word, said in (("4OFF", "three dimensions"), ("nOFF", "three dim"), ("HOFF", "first word")):
        with pytest.raises(DataError, match=said):
            read(tmp_path / "a.off", OFF.replace("OFF", word))
    with pytest.raises(DataError, match="is binary OFF, which is not read; export it as text"):
        read(tmp_path / "a.off", b"OFF BINARY\n" + struct.pack(">3i", 1, 0, 0))


def test_obj_indices_that_name_no_vertex(tmp_path):
    for index in ("0", str(-len(V) - 1)):
        with pytest.raises(DataError, match=f"the face '1 2 {index}' names no vertex: they count"):
            read(tmp_path / "a.obj", f"{OBJ}f 1 2 {index}\n")


# --- PLY --------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["int64", "uint64", "ushort", "float", "double"])
@pytest.mark.parametrize("form", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_ply_lists_of_other_types(tmp_path, kind, form):
    types = {"int64": "i8", "uint64": "u8", "ushort": "u2", "float": "f4", "double": "f8"}
    head = PLY.replace("ascii", form) + f"element face {len(F)}\n"
    head += f"property list {kind} {kind} vertex_indices\nend_header\n"
    order = "<" if "little" in form else ">"

    def body(faces):
        if form == "ascii":
            return (ROWS + "".join("3 {} {} {}\n".format(*f) for f in faces.tolist())).encode()
        table = np.insert(faces, 0, 3, axis=1).astype(order + types[kind])
        return V.astype(f"{order}f8").tobytes() + table.tobytes()

    assert_ball(read(tmp_path / "a.ply", head.encode() + body(F)))
    if kind in ("float", "double"):
        with pytest.raises(DataError, match="its faces are not whole numbers"):
            read(tmp_path / "a.ply", head.encode() + body(F + 0.5))
    with pytest.raises(DataError, match="its header has the type 'quad'"):
        read(tmp_path / "a.ply", head.replace("double x", "quad x").encode() + body(F))


@pytest.mark.parametrize("names", ["{0} {1} {2}", "diffuse_{0} diffuse_{1} diffuse_{2}", "r g b"])
@pytest.mark.parametrize(("kind", "values"), [("uchar", "255 0 51"), ("float", "1 0 0.2")])
def test_colours_of_ply(tmp_path, names, kind, values):
    columns = names.format("red", "green", "blue").split()
    head = PLY + "".join(f"property {kind} {name}\n" for name in columns) + "end_header\n"
    found = read(tmp_path / "a.ply", head + ROWS.replace("\n", f" {values}\n"))
    assert list(found.data) == ["colors"]
    assert (found.data["colors"] == [255, 0, 51]).all()


def test_ply_coordinates_in_capitals(tmp_path):
    text = PLY.replace(" x", " X").replace(" y", " Y").replace(" z", " Z")
    assert_ball(read(tmp_path / "a.ply", f"{text}end_header\n{ROWS}"), faces=None)


# --- VTK --------------------------------------------------------------------------------------


def test_edges_among_the_faces_of_vtk(tmp_path):
    head = f"# vtk DataFile Version 3.0\n\nASCII\nDATASET POLYDATA\nPOINTS {len(V)} double\n{ROWS}"
    cells = f"POLYGONS {len(F) + 1} {4 * len(F) + 3}\n{FACES}2 0 1\n"
    found = read(tmp_path / "a.vtk", head + cells)
    assert_ball(found)
    assert found.left_out == ("edges",)


# --- tables -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "left_out"),
    [
        (f"% of Matlab\n{ROWS}", ()),
        (f"! of Fortran\n{ROWS}", ()),
        (f"; of a CNC machine\n{ROWS}", ()),
        (f"% X Y Z\n{ROWS}", ()),
        ("sep=;\nx;y;z\n" + ROWS.replace(" ", ";"), ()),
        (ROWS.replace(" ", "|"), ()),
        (f"x (mm) y (mm) z (mm)\n{ROWS}", ()),
        (
            "Scan of 3 May\n\nx,y,z\n" + ROWS.replace(" ", ","),
            ("lines above the names of the columns",),
        ),
        ("".join("{:.6E} {:.6E} {:.6E}\n".format(*v) for v in V).replace("E", "D"), ()),
        (f"2\n{ROWS}", None),
    ],
)
def test_tables_of_other_programs(tmp_path, text, left_out):
    if left_out is None:
        with pytest.raises(DataError, match="its first line announces 2 rows, and 42 follow"):
            read(tmp_path / "a.txt", text)
        return
    found = read(tmp_path / "a.txt", text)
    assert_ball(found, faces=None, tolerance=1e-6)
    assert found.left_out == left_out


def test_several_scans_in_a_pts_file(tmp_path):
    rows = [f"{row} -1200 10 20 30\n" for row in ROWS.splitlines()]
    text = f"2\n{''.join(rows[:2])}{len(rows) - 2}\n{''.join(rows[2:])}"
    found = read(tmp_path / "a.pts", text)
    assert_ball(found, faces=None)
    assert found.left_out == ("columns 4 to 7",)


# --- PCD --------------------------------------------------------------------------------------


def test_pcd_before_it_counted_points_and_with_normals(tmp_path):
    head = "VERSION .6\nFIELDS x y z normal_x normal_y normal_z curvature\nSIZE 8 8 8 4 4 4 4\n"
    head += f"TYPE F F F F F F F\nWIDTH {len(V) // 2}\nHEIGHT 2\nDATA ascii\n"
    found = read(tmp_path / "a.pcd", head + ROWS.replace("\n", " 0 0 1 0.5\n"))
    assert_ball(found, faces=None)
    assert found.left_out == ("normals",)
    assert list(found.data) == ["curvature"]


# --- landmarks --------------------------------------------------------------------------------


def test_positions_of_slicer_in_other_forms(tmp_path):
    content = json.loads(mrk("LPS"))
    points = content["markups"][0]["controlPoints"]
    expected = read(tmp_path / "a.mrk.json", mrk("LPS")).vertices
    for join in (" ".join, ", ".join, list):
        for point, place in zip(points, expected.tolist(), strict=True):
            point["position"] = join(map(str, place))
        found = read(tmp_path / "a.mrk.json", json.dumps(content).replace('"LPS"', '"lps"'))
        np.testing.assert_array_equal(found.vertices, expected)
        assert found.space == "LPS"
    points[0]["position"] = "1 2"
    with pytest.raises(DataError, match="the position of 'F-0' is not of three numbers"):
        read(tmp_path / "a.mrk.json", json.dumps(content))
    for other in ("[]", "{}", '{"markups": 3}'):
        with pytest.raises(DataError, match="it has no list of markups"):
            read(tmp_path / "a.mrk.json", other)


def test_landmarks_that_a_spreadsheet_saved(tmp_path):
    lines = FCSV.format("LPS").splitlines()
    text = "".join(f"{line}{',' * 8 if line.startswith('#') else ''}\r\n" for line in lines)
    found = read(tmp_path / "a.fcsv", text)
    np.testing.assert_array_equal(
        found.vertices, read(tmp_path / "b.fcsv", "\n".join(lines)).vertices
    )
    assert found.space == "LPS"


def test_landmarks_of_slicer_3(tmp_path):
    rows = "".join("F,{},{},{},1,1\n".format(*row) for row in V.tolist())
    head = "# Fiducial List file /a.fcsv\n# version = 2\n# columns = label,x,y,z,sel,vis\n"
    found = read(tmp_path / "a.fcsv", head + rows)
    assert_ball(found, faces=None)
    assert found.space == "RAS"
    assert "RAS" not in FCSV  # what says it in later versions


# --- the brain --------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", [("INT64", "i8"), ("UINT32", "u4"), ("INT16", "i2")])
def test_gifti_of_other_types(tmp_path, kind):
    text = gifti("Base64Binary", triangles=kind)
    assert_ball(read(tmp_path / "a.gii", text), tolerance=1e-6)


def test_gifti_text_is_read_as_it_is_laid_out(tmp_path):
    """As nibabel writes it, whatever the order that it states."""
    text = gifti("ASCII", rows=True).replace("RowMajorOrder", "ColumnMajorOrder")
    assert_ball(read(tmp_path / "a.gii", text), tolerance=1e-6)


@pytest.mark.parametrize(
    "name", ["lh.sphere.reg", "rh.pial.T1", "lh.orig.nofix", "lh.midthickness"]
)
def test_freesurfer_by_any_of_its_names(tmp_path, name):
    assert_ball(read(tmp_path / name, freesurfer()), tolerance=1e-6)
    with pytest.raises(DataError, match="which is not read; convert it to one of"):
        read(tmp_path / name, b"\xff\xff\xff" + freesurfer()[3:])  # as curvatures begin


def test_freesurfer_as_text_and_with_a_second_line(tmp_path):
    flagged = "".join(f"{row} 0\n" for row in ROWS.splitlines())
    flagged += "".join("{} {} {} 0\n".format(*face) for face in F.tolist())
    text = f"#!ascii version of lh.pial\n{len(V)} {len(F)}\n{flagged}"
    assert_ball(read(tmp_path / "lh.pial.asc", text))
    assert_ball(read(tmp_path / "lh.pial", text))
    with pytest.raises(DataError, match=f"{len(V) + len(F) - 1} rows where"):
        read(tmp_path / "lh.pial.asc", text[:-9].rpartition("\n")[0])
    content = freesurfer().replace(b"someone\n\n", b"someone\non a machine\n")
    assert_ball(read(tmp_path / "lh.pial", content), tolerance=1e-6)


# --- packed -----------------------------------------------------------------------------------


def test_what_is_packed_is_told_by_its_content(tmp_path):
    packed = gzip.compress(OBJ.encode())
    assert_ball(read(tmp_path / "a.obj", packed))
    assert_ball(read(tmp_path / "a.obj.gz", OBJ))
    assert_ball(read(tmp_path / "a.obj.gz", packed + b"\0\0 written by something"))
    with pytest.raises(DataError, match="ends too early"):
        read(tmp_path / "a.obj.gz", packed[:-9])
    with pytest.raises(DataError, match="does not exist"):
        read_surface(tmp_path / "a.ply.gz")
