"""Images of vectors, as ITK and 3D Slicer read them: NRRD and MetaImage."""

from __future__ import annotations

import gzip
import zlib
from pathlib import Path

import numpy as np

from dine.files import atomic_path
from dine.geometry.lattice import Lattice
from dine.io.writers import check_output

IMAGE_SUFFIXES = (".nrrd", ".mha")


def write_vectors(
    path: Path, lattice: Lattice, vectors: np.ndarray, *, overwrite: bool = False
) -> None:
    """Write an image of vectors in double precision; both formats say that it is in LPS.

    Args:
        path: ``.nrrd`` or ``.mha``.
        lattice: where the voxels are, in LPS.
        vectors: (nx, ny, nz, 3), in LPS.
        overwrite: whether a file that is there already may be replaced.

    Raises:
        DataError: another suffix.
        StorageError: a file is there already, or the folder cannot be written.
    """
    check_output(path, IMAGE_SUFFIXES, overwrite=overwrite)
    # Components next to each other, then x fastest.
    data = np.ascontiguousarray(vectors.transpose(2, 1, 0, 3), dtype="<f8").tobytes()
    if path.suffix.lower() == ".nrrd":
        header, data = _nrrd(lattice), gzip.compress(data, 6, mtime=0)
    else:
        data = zlib.compress(data, 6)
        header = _mha(lattice, len(data))
    with atomic_path(path) as temporary, open(temporary, "wb") as stream:
        stream.write(header.encode("ascii"))
        stream.write(data)


def _numbers(values: np.ndarray) -> list[str]:
    return [repr(float(x)) for x in values]


def _nrrd(lattice: Lattice) -> str:
    axes = (f"({','.join(_numbers(axis))})" for axis in lattice.spacing * np.eye(3))
    lines = [
        "NRRD0005",
        "type: double",
        "dimension: 4",
        "space: left-posterior-superior",
        f"sizes: 3 {' '.join(map(str, lattice.shape))}",
        f"space directions: none {' '.join(axes)}",
        "kinds: vector domain domain domain",
        "endian: little",
        "encoding: gzip",
        f"space origin: ({','.join(_numbers(lattice.origin))})",
    ]
    return "\n".join(lines) + "\n\n"


def _mha(lattice: Lattice, size: int) -> str:
    # RAI names where the axes come from, which is LPS.
    lines = [
        "ObjectType = Image",
        "NDims = 3",
        "BinaryData = True",
        "BinaryDataByteOrderMSB = False",
        "CompressedData = True",
        f"CompressedDataSize = {size}",
        "TransformMatrix = 1 0 0 0 1 0 0 0 1",
        f"Offset = {' '.join(_numbers(lattice.origin))}",
        "CenterOfRotation = 0 0 0",
        "AnatomicalOrientation = RAI",
        f"ElementSpacing = {' '.join(_numbers(np.full(3, lattice.spacing)))}",
        f"DimSize = {' '.join(map(str, lattice.shape))}",
        "ElementNumberOfChannels = 3",
        "ElementType = MET_DOUBLE",
        "ElementDataFile = LOCAL",
    ]
    return "\n".join(lines) + "\n"
