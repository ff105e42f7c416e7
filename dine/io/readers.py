"""Reading a surface from any usual mesh, cloud or array format.

Correspondence rests on the vertex order, so nothing here merges, drops or reorders vertices.
Nothing stored in a file is ever executed: pickled arrays are refused.
"""

from __future__ import annotations

import contextlib
import io
import os
import re
import zipfile
import zlib
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np

from dine.errors import DataError
from dine.geometry.surface import Surface
from dine.io import announced, text

_PACKED = b"\x1f\x8b"
_DECIMAL_COMMA = re.compile(r"could not convert string to float: b?'([-+]?\d+,\d+[^']*)'")


def read_surface(path: str | os.PathLike) -> Surface:
    """Read a triangle mesh or a point cloud; the format follows from the suffix.

    Vertices keep their number, order and units, and what a file holds of every vertex comes along;
    what does not is named in ``left_out``. Polygons are split into triangles, and the meshes of a
    scene are put one after another. STL stores no shared vertices, so it gives three per triangle.

    Args:
        path: a file with one of ``READABLE_SUFFIXES``, or with one of them and ``.gz``. A ``.xyz``
            file takes its faces from the ``.triangle`` file of the same stem, where there is one.

    Returns:
        The surface, named after ``path``; ``faces`` is None for a cloud.

    Raises:
        DataError: the file is missing, empty, cut short or not what its suffix says, or holds
            values that are not finite, faces outside the vertices, or pickled objects.
    """
    path = Path(path)
    suffix = text.format_suffix(path)
    try:
        read = _READERS.get(suffix) or _other_reader(path, suffix)
        data = path.read_bytes()
        if not data:
            raise DataError(f"{path} is empty; expected a mesh or a point cloud, so copy it again.")
        if data.startswith(_PACKED):  # whatever its name says: browsers pack and unpack, too
            data = _unpacked(path, data)
        binary = suffix in _BINARY or read is _read_freesurfer
        return read(path, data if binary else text.without_mark(data))
    except DataError:
        raise
    except FileNotFoundError as error:
        raise DataError(f"{path} does not exist; check the path.") from error
    except MemoryError as error:
        raise DataError(f"{path} needs more memory than there is; close other programs.") from error
    except Exception as error:  # on damaged files the parsers raise nearly every exception
        if isinstance(error, OSError) and error.errno is not None:  # no fault of the file's content
            raise DataError(f"{path} is not a readable file ({error.strerror}).") from error
        reason = " ".join(str(error).split()) or type(error).__name__
        if comma := _DECIMAL_COMMA.search(reason):
            raise DataError(
                f"{path} has decimal commas ({comma[1]}); export it again with decimal points."
            ) from error
        raise DataError(
            f"{path} is damaged, cut short or not a {suffix} file ({reason}); copy it again, or "
            "export it again as plain triangles or points."
        ) from error


def _other_reader(path: Path, suffix: str) -> Callable[[Path, bytes], Surface]:
    """How to read a file whose suffix says nothing.

    Names of FreeSurfer have no suffix but words (lh.pial.T1, rh.sphere.reg), and optional parts of
    trimesh bring more formats.

    Raises:
        DataError: it is neither.
    """
    from dine.io.brain import AS_TEXT, TRIANGULAR

    with contextlib.suppress(OSError), open(path, "rb") as stream:
        begin = stream.read(len(AS_TEXT))
        if begin.startswith(TRIANGULAR):
            return _read_freesurfer
    from dine.io import scenes

    if scenes.reads(suffix):
        return scenes.read_scene
    raise DataError(
        f"{path} has the suffix '{path.suffix}', which is not read; convert it to one of "
        f"{' '.join(READABLE_SUFFIXES)}."
    )


def _unpacked(path: Path, data: bytes) -> bytes:
    """What gzip packed, of one member or several; whatever else stands behind is nothing."""
    found, allowed = b"", announced.limit(len(data))
    while data.startswith(_PACKED):
        unpacker = zlib.decompressobj(wbits=zlib.MAX_WBITS | 16)
        found += unpacker.decompress(data, allowed + 1 - len(found))
        announced.check(path, "its content", len(found), allowed)
        if not unpacker.eof:
            raise ValueError("its compressed content ends too early")
        data = unpacker.unused_data
    return found


# --- modules of one format each, imported when a file of it is read ---------------------------


def _read_ply(path: Path, data: bytes) -> Surface:
    from dine.io.ply import read_ply

    return read_ply(path, data)


def _read_mesh(path: Path, data: bytes) -> Surface:
    from dine.io import meshes

    readers = {".obj": meshes.read_obj, ".off": meshes.read_off, ".stl": meshes.read_stl}
    return readers[text.format_suffix(path)](path, data)


def _read_table(path: Path, data: bytes) -> Surface:
    from dine.io.clouds import read_table

    return read_table(path, data)


def _read_pcd(path: Path, data: bytes) -> Surface:
    from dine.io.clouds import read_pcd

    return read_pcd(path, data)


def _read_freesurfer(path: Path, data: bytes) -> Surface:
    from dine.io.brain import read_freesurfer

    return read_freesurfer(path, data)


def _read_gifti(path: Path, data: bytes) -> Surface:
    from dine.io.brain import read_gifti

    return read_gifti(path, data)


def _read_slicer(path: Path, data: bytes) -> Surface:
    from dine.io.slicer import read_fcsv, read_mrk

    read = read_fcsv if text.format_suffix(path) == ".fcsv" else read_mrk
    return read(path, data)


def _read_vtk(path: Path, data: bytes) -> Surface:
    """VTK's data of either form; names of one are given to the other."""
    from dine.io.vtk import read_vtk, read_vtp

    return read_vtp(path, data) if data.lstrip()[:1] == b"<" else read_vtk(path, data)


def _read_scene(path: Path, data: bytes) -> Surface:
    from dine.io.scenes import read_scene  # trimesh takes a while to import

    return read_scene(path, data)


def _read_asc(path: Path, data: bytes) -> Surface:
    from dine.io.brain import AS_TEXT

    return (_read_freesurfer if data.startswith(AS_TEXT) else _read_table)(path, data)


# --- tables and arrays ------------------------------------------------------------------------


def _read_xyz(path: Path, data: bytes) -> Surface:
    from dine.io.clouds import read_indices, read_table

    cloud = read_table(path, data)
    companion = path.with_name(f"{text.format_stem(path)}.triangle")
    if not companion.is_file():
        return cloud
    faces = _face_indices(companion, read_indices(companion, companion.read_bytes()))
    return replace(cloud, faces=faces)


def _read_npy(path: Path, data: bytes) -> Surface:
    # numpy.load would also take a pickle or an archive under this name.
    return _of_arrays(path, {"vertices": announced.npy_array(path, data)})


def _read_npz(path: Path, data: bytes) -> Surface:
    if not zipfile.is_zipfile(io.BytesIO(data)):
        raise ValueError("not a zip archive")
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        members = {name.removesuffix(".npy"): name for name in archive.namelist()}

        def read(name: str) -> np.ndarray:
            member = announced.member(path, archive, members[name], stored=len(data))
            return announced.npy_array(path, member)

        return _named(path, members, read)


def _read_h5(path: Path, data: bytes) -> Surface:
    _refuse_packed(path)
    with announced.hdf5(path) as file:
        return _named(path, file, lambda name: announced.checked(file, name)[()])


def _read_mat(path: Path, data: bytes) -> Surface:
    if announced.hdf5_start(data) is not None:
        _refuse_packed(path)
        with announced.hdf5(path) as file:  # MATLAB 7.3, which stores arrays column by column
            arrays = {name: announced.checked(file, name)[()].T for name in _datasets(file)}
    else:
        from scipy.io import loadmat

        content = announced.numeric_variables(path, data)
        arrays = {
            name: value
            for name, value in loadmat(content).items()
            if isinstance(value, np.ndarray) and value.dtype.kind in "fiu"
        }
    if not {"vertices", "points"} & arrays.keys():
        clouds = [
            name
            for name, value in arrays.items()
            if name not in _FACES and value.ndim == 2 and value.shape[1] in (3, 6)
        ]
        if len(clouds) == 1:
            arrays["vertices"] = arrays.pop(clouds[0])
    return _named(path, arrays, arrays.__getitem__, from_one=True)


def _refuse_packed(path: Path) -> None:
    if path.suffix.lower() == ".gz":
        raise DataError(f"{path} is HDF5 within gzip, which is not read; unpack it with gunzip.")


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


_FACES = ("faces", "triangles", "cells", "tri")


def _named(
    path: Path,
    names: Iterable[str],
    read: Callable[[str], np.ndarray],
    *,
    from_one: bool = False,
) -> Surface:
    """The surface of a file of named arrays, of which those that do not fit are left out."""
    names = sorted(names)
    own = next((name for name in ("vertices", "points") if name in names), None)
    if own is None:
        raise DataError(
            f"{path} has no (V, 3) array named 'vertices' or 'points' (arrays found: "
            f"{', '.join(names) or 'none'}); rename the one with the coordinates."
        )
    arrays, left_out = {"vertices": read(own)}, []
    cells = next((name for name in _FACES if name in names), None)
    if cells is not None:
        arrays["faces"] = read(cells)
    count = len(arrays["vertices"]) if np.ndim(arrays["vertices"]) else 0
    for name in names:
        if name in (own, cells):
            continue
        try:
            values = np.asarray(read(name))
        except Exception:  # what is no array, or damaged: it is not what was asked for
            values = np.empty(())
        if values.ndim == 2 and 1 in values.shape:  # MATLAB has no arrays of one dimension
            values = values.reshape(-1)
        if values.dtype.kind in "fiub" and values.ndim in (1, 2) and len(values) == count:
            arrays[name] = values
        else:
            left_out.append(name)
    return _of_arrays(path, arrays, from_one=from_one, left_out=tuple(left_out))


def _of_arrays(
    path: Path,
    arrays: dict[str, np.ndarray],
    *,
    from_one: bool = False,
    left_out: tuple[str, ...] = (),
) -> Surface:
    """Vertices, faces and what else is known of every vertex.

    MATLAB counts ``from_one``. Indices that use both ends of 1..V can mean nothing else.
    """
    values = dict(arrays)
    vertices, faces = _points(path, values.pop("vertices")), values.pop("faces", None)
    if arrays["vertices"].shape[1] == 6:
        left_out = ("columns 4 to 6", *left_out)
    if faces is not None:
        faces = _face_indices(path, faces)
        if from_one and faces.size and faces.min() == 1 and faces.max() == len(vertices):
            faces = faces - 1
    return Surface(vertices, faces, str(path), values, left_out=left_out)


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


_READERS: dict[str, Callable[[Path, bytes], Surface]] = {
    ".glb": _read_scene,
    ".gltf": _read_scene,
    ".obj": _read_mesh,
    ".off": _read_mesh,
    ".ply": _read_ply,
    ".stl": _read_mesh,
    **dict.fromkeys((".vtp", ".vtk", ".vtu"), _read_vtk),
    ".gii": _read_gifti,
    **dict.fromkeys((".pial", ".white", ".orig", ".smoothwm", ".inflated"), _read_freesurfer),
    **dict.fromkeys((".txt", ".csv", ".tsv", ".pts", ".particles"), _read_table),
    ".asc": _read_asc,
    ".xyz": _read_xyz,
    ".pcd": _read_pcd,
    **dict.fromkeys((".fcsv", ".mrk.json"), _read_slicer),
    ".npy": _read_npy,
    ".npz": _read_npz,
    ".h5": _read_h5,
    ".mat": _read_mat,
}
# Of these no first bytes are taken for a mark of the coding of text.
_BINARY = {".stl", ".glb", ".npy", ".npz", ".h5", ".mat", ".pial", ".white", ".orig", ".smoothwm"}
_BINARY |= {".inflated"}

#: Suffixes that ``read_surface`` reads, in lower case with the dot. Optional parts of trimesh bring
#: more.
READABLE_SUFFIXES: tuple[str, ...] = tuple(_READERS)
