"""Reading a surface from any usual mesh, cloud or array format.

Correspondence rests on the vertex order, so nothing here merges, drops or reorders vertices.
Nothing stored in a file is ever executed: pickled arrays are refused.
"""

from __future__ import annotations

import io
import itertools
import json
import os
import re
import warnings
import zipfile
from collections.abc import Callable, Iterable
from pathlib import Path

import h5py
import numpy as np
import scipy.io
import trimesh

from dine.errors import DataError
from dine.geometry.surface import Surface
from dine.io import announced
from dine.io.vtk import read_vtk, read_vtp

_Arrays = tuple[np.ndarray, np.ndarray | None]

# Names that trimesh lists as mesh formats but that are serialisations or read here instead.
_NOT_MESH_FILES = {".stl_ascii", ".xyz", ".json", ".dict", ".dict64", ".msgpack"}


def read_surface(path: str | os.PathLike) -> Surface:
    """Read a triangle mesh or a point cloud; the format follows from the suffix.

    Vertices keep their number, order and units. Polygons are split into triangles, the meshes of
    a scene are put one after another, and normals, colours and textures are ignored. STL stores
    no shared vertices, so it gives three per triangle.

    Args:
        path: a file with one of ``READABLE_SUFFIXES``. A ``.xyz`` file takes its faces from the
            ``.triangle`` file of the same stem, where there is one.

    Returns:
        The surface, named after ``path``; ``faces`` is None for a cloud.

    Raises:
        DataError: the file is missing, empty, cut short or not what its suffix says, or holds
            values that are not finite, faces outside the vertices, or pickled objects.
    """
    path = Path(path)
    read = _READERS.get(path.suffix.lower())
    if read is None:
        raise DataError(
            f"{path} has the suffix '{path.suffix}', which is not read; convert it to one of "
            f"{' '.join(READABLE_SUFFIXES)}."
        )
    try:
        if path.stat().st_size == 0:
            raise DataError(f"{path} is empty; expected a mesh or a point cloud, so copy it again.")
        vertices, faces = read(path)
    except DataError:
        raise
    except FileNotFoundError as error:
        raise DataError(f"{path} does not exist; check the path.") from error
    except (IsADirectoryError, PermissionError) as error:
        raise DataError(f"{path} is not a readable file ({error.strerror}).") from error
    except Exception as error:  # on damaged files the parsers raise nearly every exception
        reason = " ".join(str(error).split()) or type(error).__name__
        raise DataError(
            f"{path} is damaged, cut short or not a {path.suffix.lower()} file ({reason}); copy "
            "it again, or export it again as plain triangles or points."
        ) from error
    return Surface(vertices, faces, name=str(path))


# --- meshes -----------------------------------------------------------------------------------


def _read_mesh(path: Path) -> _Arrays:
    suffix = path.suffix.lower()
    data = path.read_bytes()
    if _cut_short(suffix, data):
        raise DataError(
            f"{path} is cut short: it holds less than its header announces; copy it again."
        )
    if suffix in (".gltf", ".glb"):
        _check_gltf(path, data)
    loaded = trimesh.load(
        io.BytesIO(data),
        file_type=suffix[1:],
        resolver=_Beside(path),
        process=False,
        maintain_order=True,
        skip_materials=True,
        fix_texture=False,  # would split vertices along texture seams
    )
    vertices, faces, count = [], [], 0
    for part in _parts(path, loaded):
        vertices.append(np.asarray(part.vertices, dtype=np.float64))
        if len(getattr(part, "faces", ())):
            faces.append(np.asarray(part.faces, dtype=np.int64) + count)
        count += len(part.vertices)
    if count == 0:
        raise _nothing_in(path)
    return np.concatenate(vertices), np.concatenate(faces) if faces else None


class _Beside(trimesh.resolvers.Resolver):
    """Files that a mesh file names, such as the buffers of a glTF, from its own folder only."""

    def __init__(self, path: Path):
        self.path = path

    def get(self, name: str) -> bytes:
        folder = self.path.parent.resolve()
        found = (folder / name).resolve()
        if not found.is_relative_to(folder) or not found.is_file():
            raise DataError(
                f"{self.path} names the file {name!r}, which is not in its folder; export the mesh "
                "as a single file."
            )
        return found.read_bytes()

    def write(self, name: str, data: str | bytes) -> None:
        raise NotImplementedError("reading writes nothing")

    def keys(self) -> list[str]:
        return [entry.name for entry in self.path.parent.iterdir()]

    def namespaced(self, namespace: str) -> _Beside:
        return _Beside(self.path.parent / namespace / self.path.name)


def _check_gltf(path: Path, data: bytes) -> None:
    """Refuse arrays that are not stored plainly, in whose place trimesh would put zeros."""
    if path.suffix.lower() == ".glb":
        data = data[20 : 20 + int.from_bytes(data[12:16], "little")]
    for accessor in json.loads(data).get("accessors", ()):
        if "bufferView" not in accessor or "sparse" in accessor:
            raise DataError(
                f"{path} holds compressed or sparse arrays, which are not read; export it without "
                "compression."
            )


def _parts(path: Path, loaded: trimesh.parent.Geometry) -> list[trimesh.parent.Geometry]:
    """The meshes and clouds of a file, placed as its scene says, in the order of the file."""
    if not isinstance(loaded, trimesh.Scene):
        found = [loaded]
    else:
        # The scene graph lists its nodes in an order of its own; geometries keep the file's.
        order = {name: rank for rank, name in enumerate(loaded.geometry)}
        placed = [(loaded.graph[node], node) for node in loaded.graph.nodes_geometry]
        placed.sort(key=lambda item: (order[item[0][1]], str(item[1])))
        # A mesh that is placed many times is copied as often.
        size = sum(loaded.geometry[name].vertices.nbytes for (_, name), _ in placed)
        announced.check(path, "its scene", size, announced.limit(path.stat().st_size))
        found = [loaded.geometry[name].copy() for (_, name), _ in placed]
        for part, ((transform, _), _) in zip(found, placed, strict=True):
            part.apply_transform(transform)
    return [part for part in found if isinstance(part, trimesh.Trimesh | trimesh.PointCloud)]


def _read_obj(path: Path) -> _Arrays:
    """Positions and faces; trimesh would split vertices along textures and materials."""
    vertices, faces = [], []
    text = path.read_text(encoding="utf-8", errors="replace")
    for line in text.replace("\\\n", " ").splitlines():
        keyword, *values = line.split() or [""]
        if keyword == "v":
            x, y, z = values[:3]
            vertices.append((float(x), float(y), float(z)))
        elif keyword == "f":
            corners = [int(value.partition("/")[0]) for value in values]
            # Positive indices count from 1, negative ones back from the latest vertex.
            corners = [i - 1 if i > 0 else len(vertices) + i for i in corners]
            first, *others = corners
            if len(others) < 2:
                raise ValueError("a face has fewer than 3 corners")
            faces += [(first, *edge) for edge in itertools.pairwise(others)]
    if not vertices:
        raise _nothing_in(path)
    return np.array(vertices), np.array(faces) if faces else None


def _nothing_in(path: Path) -> DataError:
    return DataError(
        f"{path} holds no mesh and no points, or is cut short; expected a {path.suffix.lower()} "
        "file with vertices, so export it again."
    )


def _cut_short(suffix: str, data: bytes) -> bool:
    """Whether a text PLY, OFF or STL ends early; trimesh then leaves the rest out silently."""
    if suffix == ".stl":
        triangles = int.from_bytes(data[80:84], "little")
        binary = len(data) == 84 + 50 * triangles or not data.lstrip().lower().startswith(b"solid")
        return not binary and b"endsolid" not in data.rstrip().rsplit(b"\n", 1)[-1].lower()
    if suffix == ".ply" and re.search(rb"^format ascii", data[:1000], re.MULTILINE):
        head, _, body = data.partition(b"end_header")
        elements = re.split(rb"^element\s+", head, flags=re.MULTILINE)[1:]
        counts = [int(element.split()[1]) for element in elements]
        properties = [re.findall(rb"^property\s+(\S+)", e, re.MULTILINE) for e in elements]
        # A row that starts with a list announces its own length.
        widths = [None if names[:1] == [b"list"] else len(names) for names in properties]
    elif suffix == ".off":
        text = re.sub(rb"#[^\n]*", b"", data)
        match = re.search(rb"OFF\s+(\d+)\s+(\d+)[^\n]*", text)
        if match is None:
            return False  # not an OFF file: trimesh says so
        counts, widths = [int(match[1]), int(match[2])], [3, None]
        body = text[match.end() :]
    else:
        return False
    rows = [row for row in map(bytes.split, body.splitlines()) if row]
    if len(rows) < sum(counts):
        return True
    start = 0
    for count, width in zip(counts, widths, strict=True):
        for row in rows[start : start + count]:
            if len(row) < (1 + int(row[0]) if width is None else width):
                return True
        start += count
    return False


# --- tables and arrays ------------------------------------------------------------------------


def _read_text(path: Path) -> _Arrays:
    faces = None
    companion = path.with_suffix(".triangle")
    if path.suffix.lower() == ".xyz" and companion.is_file():
        faces = _face_indices(companion, _table(companion, (3,)))
    return _table(path, (3, 6))[:, :3], faces


def _table(path: Path, columns: tuple[int, ...]) -> np.ndarray:
    """Numbers separated by commas or white space, as (rows, columns) float64."""
    expected = f"{' or '.join(map(str, columns))} columns of numbers without a header"
    try:
        text = path.read_text(encoding="utf-8-sig")
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of no rows at all, which is refused below
            table = np.loadtxt(io.StringIO(text), ndmin=2, delimiter="," if "," in text else None)
    except ValueError as error:  # includes UnicodeDecodeError
        reason = str(error).split(";")[0].rstrip(".")
        raise DataError(
            f"{path} is not a table of {expected} ({reason}); repair or convert it."
        ) from error
    if table.size == 0:
        raise DataError(f"{path} holds no rows; expected {expected}.")
    if table.shape[1] not in columns:
        raise DataError(f"{path} has {table.shape[1]} columns; expected {expected}.")
    return table


def _read_npy(path: Path) -> _Arrays:
    # numpy.load would also take a pickle or an archive under this name.
    return _points(path, announced.npy_array(path, path.read_bytes())), None


def _read_npz(path: Path) -> _Arrays:
    if not zipfile.is_zipfile(path):
        raise ValueError("not a zip archive")
    with zipfile.ZipFile(path) as archive:
        members = {name.removesuffix(".npy"): name for name in archive.namelist()}
        return _named(
            path,
            members,
            lambda name: announced.npy_array(path, announced.member(path, archive, members[name])),
        )


def _read_h5(path: Path) -> _Arrays:
    with announced.hdf5(path) as file:
        return _named(path, file, lambda name: announced.checked(file, name)[()])


def _read_mat(path: Path) -> _Arrays:
    if h5py.is_hdf5(path):  # MATLAB 7.3, which stores arrays column by column
        with announced.hdf5(path) as file:
            arrays = {name: announced.checked(file, name)[()].T for name in _datasets(file)}
    else:
        content = announced.numeric_variables(path, path.read_bytes())
        arrays = {
            name: value
            for name, value in scipy.io.loadmat(content).items()
            if isinstance(value, np.ndarray) and value.dtype.kind in "fiu"
        }
    if not {"vertices", "points"} & arrays.keys():
        clouds = [
            name
            for name, value in arrays.items()
            if name != "faces" and value.ndim == 2 and value.shape[1] in (3, 6)
        ]
        if len(clouds) == 1:
            arrays["vertices"] = arrays.pop(clouds[0])
    vertices, faces = _named(path, arrays, arrays.__getitem__)
    # MATLAB counts from 1. Indices that use both ends of 1..V can mean nothing else.
    if faces is not None and faces.size and faces.min() == 1 and faces.max() == len(vertices):
        faces = faces - 1
    return vertices, faces


def _datasets(file: h5py.File) -> list[str]:
    """Names of the arrays of numbers; MATLAB's texts and cells are something else."""
    links = {name: file.get(name, getlink=True) for name in file}
    here = [name for name, link in links.items() if isinstance(link, h5py.HardLink)]
    items = ((name, file[name]) for name in here)
    return [
        name
        for name, x in items
        if isinstance(x, h5py.Dataset) and x.shape and x.dtype.kind in "fiu"
    ]


def _named(path: Path, names: Iterable[str], read: Callable[[str], np.ndarray]) -> _Arrays:
    names = set(names)
    name = next((name for name in ("vertices", "points") if name in names), None)
    if name is None:
        found = ", ".join(sorted(names)) or "none"
        raise DataError(
            f"{path} has no (V, 3) array named 'vertices' or 'points' (arrays found: {found}); "
            "rename the one with the coordinates."
        )
    faces = _face_indices(path, read("faces")) if "faces" in names else None
    return _points(path, read(name)), faces


def _points(path: Path, array: np.ndarray) -> np.ndarray:
    """Coordinates, without the normals that columns 4 to 6 hold."""
    if array.dtype.kind not in "fiu" or array.ndim != 2 or array.shape[1] not in (3, 6):
        raise DataError(
            f"{path} holds an array of {array.dtype} with shape {array.shape}; expected numbers "
            "of shape (V, 3), or (V, 6) with normals."
        )
    return array[:, :3]


def _face_indices(path: Path, array: np.ndarray) -> np.ndarray:
    """Vertex indices as int64; formats without integers may hold them as floats."""
    if array.dtype.kind not in "fiu":
        raise DataError(f"{path} holds faces of type {array.dtype}; expected vertex indices.")
    whole = (array == np.floor(array)) & (np.abs(array) < 2**53)  # false for NaN and infinity
    if not whole.all():
        raise DataError(
            f"{path} holds faces that are not whole numbers (such as {array[~whole][0]}); "
            "expected vertex indices that start at 0."
        )
    return array.astype(np.int64)


_READERS: dict[str, Callable[[Path], _Arrays]] = {
    f".{name}": _read_mesh
    for name in sorted(trimesh.exchange.load.mesh_formats())
    if f".{name}" not in _NOT_MESH_FILES
} | {
    ".obj": _read_obj,
    ".vtp": read_vtp,
    ".vtk": read_vtk,
    ".xyz": _read_text,
    ".txt": _read_text,
    ".csv": _read_text,
    ".npy": _read_npy,
    ".npz": _read_npz,
    ".h5": _read_h5,
    ".mat": _read_mat,
}

#: Suffixes that ``read_surface`` reads, in lower case with the dot. Which mesh formats are among
#: them depends on the optional parts of trimesh that are installed.
READABLE_SUFFIXES: tuple[str, ...] = tuple(_READERS)
