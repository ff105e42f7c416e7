"""Reading surfaces of the brain: GIfTI, and FreeSurfer's own format."""

from __future__ import annotations

import binascii
import zlib
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from dine.errors import DataError
from dine.geometry.surface import Surface
from dine.io import announced

_KINDS = {"2": "u1", "NIFTI_TYPE_UINT8": "u1", "8": "i4", "NIFTI_TYPE_INT32": "i4"}
_KINDS |= {"16": "f4", "NIFTI_TYPE_FLOAT32": "f4", "64": "f8", "NIFTI_TYPE_FLOAT64": "f8"}
_TRIANGULAR = b"\xff\xff\xfe"


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
    encoding = element.get("Encoding")
    if encoding == "ASCII":
        values = np.array(content.split(), dtype=np.float64).astype(kind)
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
    order = "F" if element.get("ArrayIndexingOrder") == "ColumnMajorOrder" else "C"
    return values.reshape(shape, order=order)


def read_freesurfer(path: Path, data: bytes) -> Surface:
    """A surface as FreeSurfer writes it (lh.pial, lh.white …), in its surface coordinates.

    Raises:
        DataError: of another kind, such as a curvature or the old format of quadrangles.
    """
    if not data.startswith(_TRIANGULAR):
        raise DataError(
            f"{path} is not a triangular surface of FreeSurfer; convert it with mris_convert."
        )
    start = data.index(b"\n\n") + 2
    points, triangles = np.frombuffer(data, ">i4", 2, start).tolist()
    size = 12 * (points + triangles)
    if min(points, triangles) < 0:
        raise ValueError("it announces a negative number of points")
    announced.check(path, "its header", size, len(data) - start - 8)
    vertices = np.frombuffer(data, ">f4", 3 * points, start + 8).reshape(-1, 3)
    faces = np.frombuffer(data, ">i4", 3 * triangles, start + 8 + 12 * points).reshape(-1, 3)
    return Surface(vertices, faces, name=str(path))
