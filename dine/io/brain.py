"""Reading surfaces of the brain: GIfTI, and FreeSurfer's own format."""

from __future__ import annotations

import binascii
import zlib
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from dine.errors import DataError
from dine.geometry.surface import Surface
from dine.io import announced, text

# Codes and names of NIfTI. GIfTI allows three of them, and programs write others, too.
_NIFTI = {2: ("UINT8", "u1"), 4: ("INT16", "i2"), 8: ("INT32", "i4"), 16: ("FLOAT32", "f4")}
_NIFTI |= {64: ("FLOAT64", "f8"), 256: ("INT8", "i1"), 512: ("UINT16", "u2")}
_NIFTI |= {768: ("UINT32", "u4"), 1024: ("INT64", "i8"), 1280: ("UINT64", "u8")}
_KINDS = {str(code): kind for code, (_, kind) in _NIFTI.items()}
_KINDS |= {f"NIFTI_TYPE_{name}": kind for name, kind in _NIFTI.values()}
_BY_COLUMN = "ColumnMajorOrder"
#: What a triangular surface of FreeSurfer begins with.
TRIANGULAR = b"\xff\xff\xfe"
#: What it begins with where mris_convert wrote it as text.
AS_TEXT = b"#!ascii"


def read_gifti(path: Path, data: bytes) -> Surface:
    """The points and triangles of a GIfTI file, and what it holds of every point.

    Raises:
        DataError: no points, several sets of them, or arrays in other files.
        ValueError: damaged.
    """
    root = ElementTree.fromstring(data)
    if root.tag != "GIFTI":
        raise ValueError(f"its root is <{root.tag}>, not <GIFTI>")
    found: dict[str, list[np.ndarray]] = {}
    for element in root.iter("DataArray"):
        intent = element.get("Intent", "").removeprefix("NIFTI_INTENT_").lower()
        found.setdefault(intent, []).append(_array(path, element))
    points, triangles = found.pop("pointset", []), found.pop("triangle", [])
    if len(points) != 1 or len(triangles) > 1:
        raise DataError(
            f"{path} holds {len(points)} sets of points and {len(triangles)} of triangles; "
            "expected one surface (.surf.gii)."
        )
    values, left_out = {}, []
    for intent, arrays in found.items():
        for number, array in enumerate(arrays):
            name = intent if len(arrays) == 1 else f"{intent}_{number + 1}"
            if len(array) == len(points[0]) and intent != "vector":
                values[name] = array
            else:
                left_out.append("normals" if intent == "vector" else name)
    faces = triangles[0] if triangles else None
    return Surface(points[0], faces, str(path), values, left_out=tuple(left_out))


def _array(path: Path, element: ElementTree.Element) -> np.ndarray:
    kind = _KINDS.get(element.get("DataType", ""))
    if kind is None:
        raise ValueError(f"it holds an array of the type {element.get('DataType')}")
    axes = range(int(element.get("Dimensionality", "")))
    shape = [int(element.get(f"Dim{axis}", "")) for axis in axes]
    content = (element.findtext("Data") or "").strip()
    encoding, in_rows = element.get("Encoding"), element.get("ArrayIndexingOrder") != _BY_COLUMN
    if encoding == "ASCII":
        values = np.array(content.split(), dtype=np.float64).astype(kind)
        # Text that is laid out as a table is one, as nibabel writes and reads it.
        widths = [len(line.split()) for line in content.splitlines()]
        in_rows |= len(widths) == shape[0] and set(widths) == set(shape[1:])
    elif encoding in ("Base64Binary", "GZipBase64Binary"):
        body = binascii.a2b_base64(content)
        if encoding.startswith("GZip"):
            unpacker = zlib.decompressobj()
            body = unpacker.decompress(body, announced.limit(len(body)))
            if unpacker.unconsumed_tail or not unpacker.eof:
                raise ValueError("a compressed array is damaged, or larger than it can be")
        order = "<" if element.get("Endian") == "LittleEndian" else ">"
        values = np.frombuffer(body, order + kind).astype(kind)
    else:
        raise DataError(f"{path} keeps its arrays in another file; save it as one file.")
    return values.reshape(shape, order="C" if in_rows else "F")


def read_freesurfer(path: Path, data: bytes) -> Surface:
    """A surface as FreeSurfer writes it (lh.pial, rh.sphere.reg …), in its surface coordinates.

    Raises:
        DataError: of another kind, such as a curvature or the old format of quadrangles.
    """
    if data.startswith(AS_TEXT):
        return _freesurfer_text(path, data)
    if not data.startswith(TRIANGULAR):
        raise DataError(
            f"{path} is not a triangular surface of FreeSurfer; convert it with mris_convert."
        )
    # Two lines of text come first, the second one of which is mostly empty.
    start = data.index(b"\n", data.index(b"\n") + 1) + 1
    points, triangles = np.frombuffer(data, ">i4", 2, start).tolist()
    size = 12 * (points + triangles)
    if min(points, triangles) < 0:
        raise ValueError("it announces a negative number of points")
    announced.check(path, "its header", size, len(data) - start - 8)
    vertices = np.frombuffer(data, ">f4", 3 * points, start + 8).reshape(-1, 3)
    faces = np.frombuffer(data, ">i4", 3 * triangles, start + 8 + 12 * points).reshape(-1, 3)
    return Surface(vertices, faces, name=str(path))


def _freesurfer_text(path: Path, data: bytes) -> Surface:
    """Places and triangles with a flag behind each."""
    rows = [row.split() for row in text.rows(data)]
    points, triangles = map(int, rows[0])
    if min(points, triangles) < 0 or len(rows) != 1 + points + triangles:
        raise ValueError(f"{len(rows) - 1} rows where {points + triangles} are announced")
    vertices = np.array(rows[1 : 1 + points], dtype=np.float64).reshape(-1, 4)
    faces = np.array([[int(x) for x in row] for row in rows[1 + points :]]).reshape(-1, 4)
    return Surface(vertices[:, :3], faces[:, :3], name=str(path))
