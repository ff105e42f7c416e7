"""Writing surfaces, with what is known at their vertices, and displacement fields.

Vertices keep their number and order in every format but STL, which stores each triangle on its own.
Coordinates are written as float64, or in text with 17 digits; only STL and GLB hold float32.
"""

from __future__ import annotations

import base64
import os
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from xml.sax.saxutils import quoteattr

import h5py
import numpy as np
import scipy.io
import trimesh

from dine.errors import DataError, StorageError
from dine.files import atomic_path
from dine.geometry.surface import Surface

_RESERVED = {"vertices", "points", "faces", "colors", "displacement", "x", "y", "z"}
_RESERVED |= {"red", "green", "blue", "alpha"}


@dataclass(frozen=True)
class _Content:
    surface: Surface
    colors: np.ndarray | None = None
    scalars: dict[str, np.ndarray] = field(default_factory=dict)
    text: bool = False

    def arrays(self) -> dict[str, np.ndarray]:
        """Everything by name, as the array formats store it."""
        named = {"vertices": self.surface.vertices, "faces": self.surface.faces}
        named["colors"] = self.colors
        return {name: value for name, value in named.items() if value is not None} | self.scalars


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
    if path.is_dir():
        raise StorageError(f"{path} is a folder; name a file in it.")
    if path.exists() and not overwrite:
        raise StorageError(f"{path} exists already; choose another name, or allow overwriting it.")


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
        colors: (V, 3) or (V, 4) uint8 vertex colours, RGB or RGBA; see ``read_colors``.
        scalars: (V,) numbers by name, a plain word. PLY, VTP, NPZ, HDF5 and MAT hold them.
        text: write PLY as text instead of binary.
        overwrite: replace a file that is there already.

    Returns:
        What the format cannot hold and was left out, in words for a message: "faces", "colors",
        "shared vertices" or the name of a scalar. Empty if nothing was.

    Raises:
        DataError: unknown suffix, a cloud as STL, or arrays that do not fit the vertices.
        StorageError: a file is there already, the disk is full or the folder cannot be written.
    """
    check_output(path, SURFACE_SUFFIXES, overwrite=overwrite)
    suffix = Path(path).suffix.lower()
    content = _Content(
        surface, _checked_colors(colors, surface), _checked(scalars, len(surface.vertices)), text
    )
    if suffix == ".stl" and surface.faces is None:
        raise DataError(f"{path}: STL holds triangles only; write a cloud as .ply or .xyz.")
    with atomic_path(path) as temporary:
        _WRITERS[suffix](temporary, content)
    return tuple(_left_out(suffix, content))


def _left_out(suffix: str, content: _Content) -> list[str]:
    left_out = []
    if content.surface.faces is not None and suffix in _POINTS_ONLY:
        left_out.append("faces")
    if suffix == ".stl":
        left_out.append("shared vertices")
    if content.colors is not None and suffix not in {*_HOLD_SCALARS, ".obj", ".glb"}:
        left_out.append("colors")
    if suffix not in _HOLD_SCALARS:
        left_out += content.scalars
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


def read_colors(path: str | os.PathLike, surface: Surface) -> np.ndarray | None:
    """The vertex colours of the file that a surface was read from.

    Colours are decoration: anything that does not give one for each vertex of ``surface``, in its
    order, gives None.

    Returns:
        (V, 4) uint8 RGBA, or None.
    """
    try:
        loaded = trimesh.load(path, process=False, maintain_order=True, fix_texture=False)
        if isinstance(loaded, trimesh.Scene) and len(loaded.geometry) == 1:
            (loaded,) = loaded.dump()
        if isinstance(loaded, trimesh.PointCloud):
            colors = loaded.colors
        else:
            colors = loaded.visual.vertex_colors if loaded.visual.kind == "vertex" else None
        same = np.array_equal(loaded.vertices, surface.vertices)
    except Exception:  # the parsers raise nearly every exception; the surface itself was readable
        return None
    if colors is None or not same or np.shape(colors) != (len(surface.vertices), 4):
        return None
    return np.asarray(colors, dtype=np.uint8)


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


def _checked_colors(colors: np.ndarray | None, surface: Surface) -> np.ndarray | None:
    if colors is None:
        return None
    colors = np.ascontiguousarray(colors)
    count = len(surface.vertices)
    if colors.dtype != np.uint8 or colors.shape not in ((count, 3), (count, 4)):
        raise DataError(
            f"Vertex colors are {colors.dtype} of shape {colors.shape}; expected uint8 of shape "
            f"({count}, 3) or ({count}, 4)."
        )
    return colors


# --- formats ----------------------------------------------------------------------------------


def _write_ply(path: Path, content: _Content) -> None:
    """Written here because trimesh stores vertices as float32 in PLY."""
    columns = dict(zip("xyz", content.surface.vertices.T, strict=True))
    if content.colors is not None:
        columns |= dict(zip(("red", "green", "blue", "alpha"), content.colors.T, strict=False))
    columns |= content.scalars
    names = {"f8": "double", "u1": "uchar"}
    kinds = {name: column.dtype.str[1:] for name, column in columns.items()}
    table = np.empty(len(content.surface.vertices), [(name, f"<{k}") for name, k in kinds.items()])
    for name, column in columns.items():
        table[name] = column
    tables = [table]
    header = ["ply", f"format {'ascii' if content.text else 'binary_little_endian'} 1.0"]
    header += [f"element vertex {len(table)}"]
    header += [f"property {names[kind]} {name}" for name, kind in kinds.items()]
    if content.surface.faces is not None:
        header += [f"element face {len(content.surface.faces)}"]
        header += ["property list uchar int vertex_indices"]
        rows = np.empty(len(content.surface.faces), [("count", "u1"), ("index", "<i4", 3)])
        rows["count"], rows["index"] = 3, content.surface.faces
        tables.append(rows)
    head = "\n".join([*header, "end_header", ""]).encode()
    if not content.text:
        path.write_bytes(head + b"".join(table.tobytes() for table in tables))
        return
    body = "".join(" ".join(map(repr, row)) + "\n" for row in table.tolist())
    if content.surface.faces is not None:
        body += "".join(f"3 {a} {b} {c}\n" for a, b, c in content.surface.faces.tolist())
    path.write_bytes(head + body.encode())


def _write_obj(path: Path, content: _Content) -> None:
    columns = content.surface.vertices
    if content.colors is not None:  # the common extension of "v x y z r g b", from 0 to 1
        columns = np.hstack([columns, content.colors[:, :3] / 255])
    with open(path, "w", encoding="ascii") as stream:
        np.savetxt(stream, columns, fmt="v" + " %.17g" * columns.shape[1])
        if content.surface.faces is not None:
            np.savetxt(stream, content.surface.faces + 1, fmt="f %d %d %d")


def _write_off(path: Path, content: _Content) -> None:
    faces = content.surface.faces
    with open(path, "w", encoding="ascii") as stream:
        stream.write(
            f"OFF\n{len(content.surface.vertices)} {0 if faces is None else len(faces)} 0\n"
        )
        np.savetxt(stream, content.surface.vertices, fmt="%.17g")
        if faces is not None:
            np.savetxt(stream, faces, fmt="3 %d %d %d")


def _write_trimesh(path: Path, content: _Content) -> None:
    surface = content.surface
    if surface.faces is None:
        shape = trimesh.PointCloud(surface.vertices, colors=content.colors)
    else:
        shape = trimesh.Trimesh(
            surface.vertices, surface.faces, vertex_colors=content.colors, process=False
        )
    path.write_bytes(shape.export(file_type=path.suffix.lower()[1:]))


def _write_vtp(path: Path, content: _Content) -> None:
    colors = {} if content.colors is None else {"colors": content.colors}
    path.write_text(_vtp(content.surface, content.scalars | colors), encoding="ascii")


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
    kind = {"f8": "Float64", "i8": "Int64", "u1": "UInt8"}[array.dtype.str[1:]]
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
    scipy.io.savemat(path, content.arrays(), do_compression=True, oned_as="column")


def _write_table(path: Path, content: _Content) -> None:
    delimiter = "," if path.suffix.lower() == ".csv" else " "
    np.savetxt(path, content.surface.vertices, fmt="%.17g", delimiter=delimiter)


_HOLD_SCALARS = (".ply", ".vtp", ".npz", ".h5", ".mat")
_POINTS_ONLY = (".xyz", ".txt", ".csv", ".npy")

_WRITERS: dict[str, Callable[[Path, _Content], None]] = {
    ".ply": _write_ply,
    ".obj": _write_obj,
    ".off": _write_off,
    ".stl": _write_trimesh,
    ".glb": _write_trimesh,
    ".vtp": _write_vtp,
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
