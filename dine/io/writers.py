"""Writing surfaces, with what is known at their vertices, and displacement fields.

Vertices keep their number and order in every format but STL, which stores each triangle on its own.
Coordinates are written as float64, or in text with 17 digits; only STL and GLB hold float32.
"""

from __future__ import annotations

import base64
import os
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from urllib.parse import quote
from xml.sax.saxutils import quoteattr

import h5py
import numpy as np

from dine.errors import DataError, StorageError
from dine.files import atomic_path, check_place
from dine.geometry.surface import Surface
from dine.io.meshes import FACET
from dine.io.text import format_suffix

_RESERVED = {"vertices", "points", "faces", "colors", "displacement", "x", "y", "z"}
_RESERVED |= {"red", "green", "blue", "alpha"}


@dataclass(frozen=True)
class _Content:
    surface: Surface
    colors: np.ndarray | None = None
    data: dict[str, np.ndarray] = field(default_factory=dict)
    text: bool = False

    @property
    def statement(self) -> str:
        """What tells 3D Slicer in which space the coordinates are; empty where that is unknown."""
        return f"SPACE={self.surface.space}" if self.surface.space else ""

    def arrays(self) -> dict[str, np.ndarray]:
        """Everything by name, as the array formats store it."""
        named = {"vertices": self.surface.vertices, "faces": self.surface.faces}
        named["colors"] = self.colors
        return {name: value for name, value in named.items() if value is not None} | self.data


def check_output(
    path: str | os.PathLike, suffixes: Iterable[str], *, overwrite: bool = False
) -> None:
    """Refuse a path that could not be written, so that nothing is computed in vain.

    Args:
        path: where something is to be written.
        suffixes: ``SURFACE_SUFFIXES`` or ``FIELD_SUFFIXES``.
        overwrite: whether a file that is there already may be replaced.

    Raises:
        DataError: the suffix is none of these.
        StorageError: there is a file already, or a folder of this name.
    """
    path = Path(path)
    if path.suffix.lower() not in suffixes:
        raise DataError(
            f"{path} has the suffix '{path.suffix}', which is not written; use one of "
            f"{' '.join(suffixes)}."
        )
    check_place(path)
    if path.is_dir():
        raise StorageError(f"{path} is a folder; name a file in it.")
    if path.exists() and not overwrite:
        raise StorageError(
            f"{path} exists already; choose another name, or replace it (--overwrite, in Python "
            "overwrite=True)."
        )


def check_holds(path: str | os.PathLike, surface: Surface) -> None:
    """Refuse a format that cannot hold a surface.

    Raises:
        DataError: a cloud is to be written as STL.
    """
    if Path(path).suffix.lower() == ".stl" and surface.faces is None:
        raise DataError(f"{path}: STL holds triangles only; write a cloud as .ply or .xyz.")


def written_suffix(path: Path, otherwise: str) -> str:
    """The suffix of a file that was read, if that format is written, too."""
    suffix = format_suffix(path)
    return suffix if suffix in SURFACE_SUFFIXES else otherwise


def write_surface(path: str | os.PathLike, surface: Surface) -> None:
    """Write a surface so that ``read_surface`` gives back exactly the same arrays.

    The same surface always gives the same bytes, and a file already at ``path`` is replaced only
    when the new one is complete. :func:`write_moved` writes more formats, and more into them.

    Args:
        path: ``.ply`` (binary, float64 vertices, faces if there are any) or, for a cloud, ``.xyz``
            (text, three columns).
        surface: what to write.

    Raises:
        DataError: another suffix, or a mesh to be written as ``.xyz``, which has no faces.
        StorageError: the disk is full or the folder cannot be written.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix not in (".ply", ".xyz"):
        raise DataError(f"{path}: surfaces are written as .ply or .xyz, not as '{path.suffix}'.")
    if suffix == ".xyz" and surface.faces is not None:
        raise DataError(f"{path}: .xyz holds no faces; write a mesh as .ply.")
    with atomic_path(path) as temporary:
        _WRITERS[suffix](temporary, _Content(surface))


def write_moved(
    path: str | os.PathLike,
    surface: Surface,
    *,
    colors: np.ndarray | None = None,
    scalars: Mapping[str, np.ndarray] | None = None,
    text: bool = False,
    overwrite: bool = False,
) -> tuple[str, ...]:
    """Write a mesh or cloud in the format that the suffix of ``path`` names.

    ``read_surface`` reads all of them back, with vertices and faces as given; from STL it gives
    three vertices a triangle, in the order of the triangles.

    Args:
        path: a file with one of ``SURFACE_SUFFIXES``; missing folders are made.
        surface: the moved mesh or cloud, in its own units.
        colors: (V, 3) or (V, 4) uint8 vertex colours, RGB or RGBA; by default the surface's own.
        scalars: (V,) numbers by name, a plain word. PLY, VTP, VTK, NPZ, HDF5 and MAT hold them,
            and the surface's own data. Of two with one name the surface's is called ``source_…``.
        text: write PLY as text instead of binary.
        overwrite: replace a file that is there already.

    Returns:
        What the format cannot hold and was left out, in words for a message: "faces", "colors",
        "shared vertices", the name of a scalar, or digits of large coordinates. Empty if nothing
        was.

    Raises:
        DataError: unknown suffix, a cloud as STL, or arrays that do not fit the vertices.
        StorageError: a file is there already, the disk is full or the folder cannot be written.
    """
    check_output(path, SURFACE_SUFFIXES, overwrite=overwrite)
    suffix = Path(path).suffix.lower()
    left_out: list[str] = []
    content = _content(surface, colors, scalars, left_out, words=suffix not in _ANY_NAME)
    check_holds(path, surface)
    with atomic_path(path) as temporary:
        _WRITERS[suffix](temporary, replace(content, text=text))
    return (*_left_out(suffix, content), *left_out)


def _content(
    surface: Surface,
    colors: np.ndarray | None,
    scalars: Mapping[str, np.ndarray] | None,
    left_out: list[str],
    *,
    words: bool,
) -> _Content:
    """The surface's own data beside what is given, which goes first where names are the same."""
    count = len(surface.vertices)
    data = _checked(scalars, count)
    for name, values in surface.data.items():
        if name == "colors" and _are_colors(values, count):
            colors = values if colors is None else colors
        elif values.dtype.kind in "fiub" and values.ndim in (1, 2):
            data[_free(re.sub(r"\W+", "_", name, flags=re.ASCII) if words else name, data)] = values
        else:
            left_out.append(name)
    return _Content(surface, _checked_colors(colors, surface), data)


def _free(name: str, taken: Iterable[str]) -> str:
    """A name that nothing else has."""
    while name in _RESERVED or name in taken or not re.match("[A-Za-z]", name):
        name = f"source_{name}"
    return name


def _left_out(suffix: str, content: _Content) -> list[str]:
    surface, left_out = content.surface, []
    if surface.faces is not None and suffix in _POINTS_ONLY:
        left_out.append("faces")
    if suffix == ".stl":
        left_out.append("shared vertices")
    if content.colors is not None and suffix not in {*_HOLD_DATA, ".obj", ".glb"}:
        left_out.append("colors")
    if suffix == ".obj" and content.colors is not None and (content.colors[:, 3:] < 255).any():
        left_out.append("transparency")
    if surface.texture is not None and suffix not in (".obj", ".ply"):
        left_out.append("texture coordinates")
    if content.statement and suffix not in (".ply", ".obj", ".stl", ".vtk"):
        left_out.append(f"that it is in {surface.space}")
    if suffix not in _HOLD_DATA:
        left_out += content.data
    if suffix in _SINGLE:
        loss = float(np.abs(surface.vertices - surface.vertices.astype(np.float32)).max())
        if loss > _MUCH_LOST * float(np.ptp(surface.vertices[surface.used], axis=0).max()):
            left_out.append(f"coordinates this large (it rounds them by up to {loss:.2g})")
    return left_out


def write_field(
    path: str | os.PathLike,
    points: np.ndarray,
    displacement: np.ndarray,
    *,
    faces: np.ndarray | None = None,
    scalars: Mapping[str, np.ndarray] | None = None,
    overwrite: bool = False,
) -> None:
    """Write a displacement field, and what is known at the same points.

    NPZ holds the arrays ``points``, ``displacement``, the scalars by name and, if given, ``faces``.
    VTP (VTK's XML PolyData) holds the same as point data of triangles or, without faces, of
    vertices; ParaView, 3D Slicer and PyVista open it.

    Args:
        path: a file with one of ``FIELD_SUFFIXES``; missing folders are made.
        points: (n, 3) unmoved points.
        displacement: (n, 3) how far each moves, in the units of ``points``.
        faces: (F, 3) triangles between the points.
        scalars: (n,) numbers by name, a plain word such as "error".
        overwrite: replace a file that is there already.

    Raises:
        DataError: unknown suffix, or arrays that do not fit the points.
        StorageError: a file is there already, the disk is full or the folder cannot be written.
    """
    check_output(path, FIELD_SUFFIXES, overwrite=overwrite)
    surface = Surface(points, faces, name="The field")
    displacement = np.asarray(displacement, dtype=np.float64)
    if displacement.shape != surface.vertices.shape:
        raise DataError(
            f"A displacement of shape {displacement.shape} does not fit points of shape "
            f"{surface.vertices.shape}; expected one row a point."
        )
    if not np.isfinite(displacement).all():
        raise DataError("The displacement holds NaN or infinite numbers, so it is not written.")
    data = {"displacement": displacement, **_checked(scalars, len(displacement))}
    with atomic_path(path) as temporary:
        if temporary.suffix.lower() == ".npz":
            named = {"points": surface.vertices, "faces": surface.faces, **data}
            _savez(temporary, {name: array for name, array in named.items() if array is not None})
        else:
            temporary.write_text(_vtp(surface, data), encoding="ascii")


def _checked(scalars: Mapping[str, np.ndarray] | None, count: int) -> dict[str, np.ndarray]:
    """Scalars as float64 arrays."""
    checked = {}
    for name, values in (scalars or {}).items():
        values = np.asarray(values)
        if (
            not (name.isascii() and name.isidentifier())
            or name.startswith("_")
            or name in _RESERVED
        ):
            raise DataError(f"{name!r} cannot name a scalar; use a plain word such as 'error'.")
        if values.shape != (count,) or values.dtype.kind not in "fiub":
            raise DataError(
                f"The scalar {name!r} is {values.dtype} of shape {values.shape}; expected one "
                f"number for each of {count} points."
            )
        checked[name] = np.ascontiguousarray(values, dtype=np.float64)
    return checked


def _are_colors(values: np.ndarray, count: int) -> bool:
    return values.dtype == np.uint8 and values.shape in ((count, 3), (count, 4))


def _checked_colors(colors: np.ndarray | None, surface: Surface) -> np.ndarray | None:
    if colors is None:
        return None
    colors = np.ascontiguousarray(colors)
    count = len(surface.vertices)
    if not _are_colors(colors, count):
        raise DataError(
            f"Vertex colors are {colors.dtype} of shape {colors.shape}; expected uint8 of shape "
            f"({count}, 3) or ({count}, 4)."
        )
    return colors


# --- formats ----------------------------------------------------------------------------------


_PLY_TYPES = {"i1": "char", "u1": "uchar", "i2": "short", "u2": "ushort", "i4": "int", "u4": "uint"}
_PLY_TYPES |= {"f4": "float", "f8": "double"}


def _write_ply(path: Path, content: _Content) -> None:
    """Written here because trimesh stores vertices as float32 in PLY."""
    surface = content.surface
    columns = dict(zip("xyz", surface.vertices.T, strict=True))
    if content.colors is not None:
        columns |= dict(zip(("red", "green", "blue", "alpha"), content.colors.T, strict=False))
    for name, values in content.data.items():
        columns |= _ply_columns(name, values)
    kinds = {name: column.dtype.str[1:] for name, column in columns.items()}
    table = np.empty(len(surface.vertices), [(name, f"<{k}") for name, k in kinds.items()])
    for name, column in columns.items():
        table[name] = column
    tables = [table]
    header = ["ply", f"format {'ascii' if content.text else 'binary_little_endian'} 1.0"]
    header += [f"comment {content.statement}"] * bool(content.statement)
    header += [f"element vertex {len(table)}"]
    header += [f"property {_PLY_TYPES[kind]} {name}" for name, kind in kinds.items()]
    if surface.faces is not None:
        header += [f"element face {len(surface.faces)}"]
        header += ["property list uchar int vertex_indices"]
        row = [("count", "u1"), ("index", "<i4", 3)]
        if surface.texture is not None:
            header += ["property list uchar double texcoord"]
            row += [("numbers", "u1"), ("texture", "<f8", 6)]
        rows = np.empty(len(surface.faces), row)
        rows["count"], rows["index"] = 3, surface.faces
        if surface.texture is not None:
            rows["numbers"], rows["texture"] = 6, surface.texture.reshape(-1, 6)
        tables.append(rows)
    head = "\n".join([*header, "end_header", ""]).encode()
    if content.text:
        lines = (" ".join(map(repr, _flat(row))) for table in tables for row in table.tolist())
        path.write_bytes(head + "".join(f"{line}\n" for line in lines).encode())
    else:
        path.write_bytes(head + b"".join(table.tobytes() for table in tables))


def _ply_columns(name: str, values: np.ndarray) -> dict[str, np.ndarray]:
    """Columns of types that PLY has."""
    if values.dtype.str[1:] not in _PLY_TYPES:  # bool, float16 and integers of 64 bits
        fits = values.dtype.kind in "iu" and abs(values).max(initial=0) < 2**31
        values = values.astype({"b": "u1"}.get(values.dtype.kind, "i4" if fits else "f8"))
    if values.ndim == 1:
        return {name: values}
    return {f"{name}_{i}": column for i, column in enumerate(values.T)}


def _flat(row: tuple) -> list:
    return [x for value in row for x in np.ravel(value).tolist()]


def _write_obj(path: Path, content: _Content) -> None:
    surface = content.surface
    columns = surface.vertices
    if content.colors is not None:  # the common extension of "v x y z r g b", from 0 to 1
        columns = np.hstack([columns, content.colors[:, :3] / 255])
    with open(path, "w", encoding="ascii") as stream:
        if content.statement:
            stream.write(f"# {content.statement}\n")
        np.savetxt(stream, columns, fmt="v" + " %.17g" * columns.shape[1])
        if surface.texture is not None:
            places, corner = np.unique(surface.texture.reshape(-1, 2), axis=0, return_inverse=True)
            np.savetxt(stream, places, fmt="vt %.17g %.17g")
            both = np.dstack([surface.faces, corner.reshape(-1, 3)]) + 1
            np.savetxt(stream, both.reshape(-1, 6), fmt="f %d/%d %d/%d %d/%d")
        elif surface.faces is not None:
            np.savetxt(stream, surface.faces + 1, fmt="f %d %d %d")


def _write_off(path: Path, content: _Content) -> None:
    faces = content.surface.faces
    with open(path, "w", encoding="ascii") as stream:
        stream.write(
            f"OFF\n{len(content.surface.vertices)} {0 if faces is None else len(faces)} 0\n"
        )
        np.savetxt(stream, content.surface.vertices, fmt="%.17g")
        if faces is not None:
            np.savetxt(stream, faces, fmt="3 %d %d %d")


def _write_stl(path: Path, content: _Content) -> None:
    """Binary; the header says nothing that begins like a text file."""
    corners = content.surface.vertices[content.surface.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    facets = np.zeros(len(corners), FACET)
    facets["normal"] = np.divide(normals, lengths, out=np.zeros_like(normals), where=lengths > 0)
    facets["corners"] = corners
    header = f"DINE {content.statement}".encode().ljust(80) + len(facets).to_bytes(4, "little")
    path.write_bytes(header + facets.tobytes())


def _write_glb(path: Path, content: _Content) -> None:
    import trimesh  # takes a while

    surface = content.surface
    if surface.faces is None:
        shape = trimesh.PointCloud(surface.vertices, colors=content.colors)
    else:
        shape = trimesh.Trimesh(
            surface.vertices, surface.faces, vertex_colors=content.colors, process=False
        )
    path.write_bytes(shape.export(file_type="glb"))


def _write_vtp(path: Path, content: _Content) -> None:
    colors = {} if content.colors is None else {"colors": content.colors}
    path.write_text(_vtp(content.surface, content.data | colors), encoding="utf-8")


def _write_vtk(path: Path, content: _Content) -> None:
    """A legacy file of version 3, binary, which every version of VTK reads."""
    surface, count = content.surface, len(content.surface.vertices)
    kind, cells = "VERTICES", np.arange(count)[:, None]
    if surface.faces is not None:
        kind, cells = "POLYGONS", surface.faces
    table = np.insert(cells, 0, cells.shape[1], axis=1)
    arrays = content.data if content.colors is None else content.data | {"colors": content.colors}
    pieces: list[str | np.ndarray] = [
        f"# vtk DataFile Version 3.0\nDINE {content.statement}\nBINARY\nDATASET POLYDATA\n",
        f"POINTS {count} double\n",
        surface.vertices.astype(">f8"),
        f"\n{kind} {len(table)} {table.size}\n",
        table.astype(">i4"),
    ]
    if arrays:
        pieces.append(f"\nPOINT_DATA {count}\nFIELD FieldData {len(arrays)}\n")
    for name, array in arrays.items():
        values = _vtk_values(array)
        words = f"{quote(name)} {values.size // count} {count} {_LEGACY[values.dtype.str[1:]]}\n"
        pieces += [words, values.astype(values.dtype.newbyteorder(">")), "\n"]
    path.write_bytes(b"".join(x.encode() if isinstance(x, str) else x.tobytes() for x in pieces))


def _vtk_values(array: np.ndarray) -> np.ndarray:
    """Numbers of a type that VTK has."""
    return array.astype({"b": np.uint8, "f": np.float64}.get(array.dtype.kind, array.dtype))


_LEGACY = {"f8": "double", "i1": "char", "u1": "unsigned_char", "i2": "short"}
_LEGACY |= {"u2": "unsigned_short", "i4": "int", "u4": "unsigned_int", "i8": "vtktypeint64"}
_LEGACY |= {"u8": "vtktypeuint64"}


def _vtp(surface: Surface, data: dict[str, np.ndarray]) -> str:
    """VTK's XML PolyData, with arrays as base64 in place.

    Written here because VTK itself unpacks to over 500 MB, and meshio has no PolyData and, where it
    is installed, makes trimesh read some thirty more formats, and with it ``read_surface``.
    """
    count = len(surface.vertices)
    cells = {"Verts": np.arange(count)[:, None], "Polys": np.empty((0, 3), dtype=np.int64)}
    if surface.faces is not None:
        cells = {"Verts": np.empty((0, 1), dtype=np.int64), "Polys": surface.faces}
    lines = [
        '<?xml version="1.0"?>',
        '<VTKFile type="PolyData" version="1.0" byte_order="LittleEndian" header_type="UInt64">',
        "<PolyData>",
        f'<Piece NumberOfPoints="{count}" NumberOfVerts="{len(cells["Verts"])}" NumberOfLines="0"'
        f' NumberOfStrips="0" NumberOfPolys="{len(cells["Polys"])}">',
        "<PointData>",
        *(_vtp_array(name, array) for name, array in data.items()),
        "</PointData>",
        "<Points>",
        _vtp_array("Points", surface.vertices),
        "</Points>",
    ]
    for kind, corners in cells.items():
        ends = np.arange(1, len(corners) + 1) * corners.shape[1]
        lines += [f"<{kind}>", _vtp_array("connectivity", corners.reshape(-1))]
        lines += [_vtp_array("offsets", ends), f"</{kind}>"]
    return "\n".join([*lines, "</Piece>", "</PolyData>", "</VTKFile>", ""])


def _vtp_array(name: str, array: np.ndarray) -> str:
    array = _vtk_values(array)
    kind = {"f": "Float", "i": "Int", "u": "UInt"}[array.dtype.kind] + str(8 * array.itemsize)
    body = np.ascontiguousarray(array, dtype=array.dtype.newbyteorder("<")).tobytes()
    text = base64.b64encode(np.array(len(body), dtype="<u8").tobytes() + body).decode("ascii")
    columns = array.shape[1] if array.ndim == 2 else 1
    return (
        f'<DataArray type="{kind}" Name={quoteattr(name)} NumberOfComponents="{columns}"'
        f' format="binary">{text}</DataArray>'
    )


def _savez(path: Path, arrays: dict[str, np.ndarray]) -> None:
    with open(path, "wb") as stream:
        np.savez_compressed(stream, **arrays)


def _write_h5(path: Path, content: _Content) -> None:
    with h5py.File(path, "w") as file:
        for name, array in content.arrays().items():
            file[name] = array


def _write_mat(path: Path, content: _Content) -> None:
    from scipy.io import savemat

    savemat(path, content.arrays(), do_compression=True, oned_as="column")


def _write_table(path: Path, content: _Content) -> None:
    delimiter = "," if path.suffix.lower() == ".csv" else " "
    np.savetxt(path, content.surface.vertices, fmt="%.17g", delimiter=delimiter)


_HOLD_DATA = (".ply", ".vtp", ".vtk", ".npz", ".h5", ".mat")
_ANY_NAME = (".vtp", ".vtk")
_SINGLE = (".stl", ".glb")
# Of the object's extent; an object near the origin loses a thousandth of that.
_MUCH_LOST = 1e-5
_POINTS_ONLY = (".xyz", ".txt", ".csv", ".npy")

_WRITERS: dict[str, Callable[[Path, _Content], None]] = {
    ".ply": _write_ply,
    ".obj": _write_obj,
    ".off": _write_off,
    ".stl": _write_stl,
    ".glb": _write_glb,
    ".vtp": _write_vtp,
    ".vtk": _write_vtk,
    ".npz": lambda path, content: _savez(path, content.arrays()),
    ".h5": _write_h5,
    ".mat": _write_mat,
    ".npy": lambda path, content: np.save(path, content.surface.vertices),
    ".xyz": _write_table,
    ".txt": _write_table,
    ".csv": _write_table,
}

#: Suffixes that ``write_moved`` writes, in lower case with the dot.
SURFACE_SUFFIXES: tuple[str, ...] = tuple(_WRITERS)
#: Suffixes that ``write_field`` writes.
FIELD_SUFFIXES: tuple[str, ...] = (".npz", ".vtp")
