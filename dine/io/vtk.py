"""Reading VTK's PolyData: .vtp (XML) in the encodings of VTK and ParaView, and .vtk (legacy).

Read here because VTK itself unpacks to over 500 MB, and meshio and trimesh have no PolyData.
"""

from __future__ import annotations

import binascii
import itertools
import lzma
import re
import zlib
from collections.abc import Callable
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from dine.errors import DataError

_Arrays = tuple[np.ndarray, np.ndarray | None]

_TYPES = {f"{k}{8 * n}": f"{c}{n}" for k, c in (("Int", "i"), ("UInt", "u")) for n in (1, 2, 4, 8)}
_TYPES |= {"Float32": "f4", "Float64": "f8"}
_LEGACY_TYPES = {"float": "f4", "double": "f8", "vtktypeint64": "i8", "vtkidtype": "i4"}
_LEGACY_TYPES |= {"char": "i1", "short": "i2", "int": "i4", "long": "i8"}
_LEGACY_TYPES |= {f"unsigned_{name}": f"u{_LEGACY_TYPES[name][1]}" for name in ("char", "short")}
_LEGACY_TYPES |= {"unsigned_int": "u4", "unsigned_long": "u8"}
_UNPACK: dict[str, Callable[[bytes], bytes]] = {
    "vtkZLibDataCompressor": zlib.decompress,
    "vtkLZMADataCompressor": lzma.decompress,
}


def read_vtp(path: Path) -> _Arrays:
    """Vertices (V, 3) and triangles (F, 3) of XML PolyData; None for faces where there are none.

    Arrays may be text, base64 or appended, raw or compressed (zlib, LZMA), of either byte order.
    Pieces follow each other; polygons and strips become triangles, lines are left out.

    Raises:
        DataError: another kind of VTK data, or compressed with LZ4.
        ValueError: the file is damaged; so are a few other exceptions of the parsers.
    """
    head, mark, appended = path.read_bytes().partition(b"<AppendedData")
    # Raw appended data is no XML, so only what stands before it is parsed.
    root = ElementTree.fromstring(head + b"</VTKFile>" if mark else head)
    if root.tag != "VTKFile":
        raise ValueError(f"its root is <{root.tag}>, not <VTKFile>")
    if root.get("type") != "PolyData":
        raise _other_data(path, str(root.get("type")))
    compressor = root.get("compressor")
    if compressor and compressor not in _UNPACK:
        raise DataError(
            f"{path} is compressed with {compressor}, which is not read; save it again with the "
            "compressor ZLib or None."
        )
    decode = _Decoder(root, appended)
    vertices, faces, count = [], [], 0
    for piece in root.iterfind("PolyData/Piece"):
        announced = int(piece.get("NumberOfPoints", 0))
        if announced == 0:
            continue
        points = decode(_array(piece, "Points")).reshape(-1, 3)
        if len(points) != announced:
            raise ValueError(f"{len(points)} points where {announced} are announced")
        for kind, triangles in (("Polys", _fans), ("Strips", _strips)):
            if int(piece.get(f"NumberOf{kind}", 0)):
                ends = decode(_array(piece, kind, "offsets"))
                corners = decode(_array(piece, kind, "connectivity"))
                faces.append(triangles(corners.astype(np.int64), ends.astype(np.int64)) + count)
        vertices.append(points.astype(np.float64))
        count += len(points)
    if not vertices:
        raise DataError(f"{path} holds no points; expected PolyData, so export it again.")
    return np.concatenate(vertices), np.concatenate(faces) if faces else None


def _other_data(path: Path, kind: str) -> DataError:
    return DataError(
        f"{path} holds VTK data of the kind {kind}; expected PolyData, so extract its surface (in "
        "ParaView the filter Extract Surface) and save that."
    )


def _array(piece: ElementTree.Element, part: str, name: str | None = None) -> ElementTree.Element:
    for array in piece.iterfind(f"{part}/DataArray"):
        if name in (None, array.get("Name")):
            return array
    raise ValueError(f"{part} has no array {name or 'of points'}")


class _Decoder:
    """Data arrays of one file, from its <VTKFile> element and what follows ``<AppendedData``."""

    def __init__(self, root: ElementTree.Element, appended: bytes):
        self.order = ">" if root.get("byte_order") == "BigEndian" else "<"
        self.length = np.dtype(self.order + _TYPES[root.get("header_type", "UInt32")])
        self.unpack = _UNPACK.get(root.get("compressor", ""))
        tag, _, rest = appended.partition(b">")
        self.raw = b"raw" in tag
        self.appended = rest.partition(b"_")[2]
        # In base64 an array ends where the next one begins.
        starts = [int(a.get("offset", 0)) for a in root.iter("DataArray") if a.get("offset")]
        limit = len(self.appended) if self.raw else self.appended.find(b"<")
        self.ends = dict(itertools.pairwise([*sorted(set(starts)), limit]))

    def __call__(self, array: ElementTree.Element) -> np.ndarray:
        kind = np.dtype(self.order + _TYPES[array.get("type", "")])
        how = array.get("format", "ascii")
        if how == "appended":
            start = int(array.get("offset", ""))
            data = self.appended[start : len(self.appended) if self.raw else self.ends[start]]
            body = self._body(data if self.raw else _from_base64(data))
            return np.frombuffer(body, kind)
        text = "".join([array.text or "", *(child.tail or "" for child in array)])
        if how == "ascii":
            return np.array(text.split(), dtype=kind)
        return np.frombuffer(self._body(_from_base64(text.encode("ascii"))), kind)

    def _body(self, data: bytes) -> bytes:
        """What a block of lengths, and of compressed pieces, holds."""
        width = self.length.itemsize
        if self.unpack is None:
            size = int(np.frombuffer(data, self.length, 1)[0])
            body = data[width : width + size]
        else:
            pieces = int(np.frombuffer(data, self.length, 1)[0])
            if pieces == 0:
                return b""
            header = np.frombuffer(data, self.length, 3 + pieces).astype(np.int64)
            _, full, partial, *packed = header.tolist()
            bounds = np.cumsum([width * len(header), *packed]).tolist()
            body = b"".join(self.unpack(data[a:b]) for a, b in itertools.pairwise(bounds))
            size = full * (pieces - bool(partial)) + partial
        if len(body) != size:
            raise ValueError(f"an array of {size} bytes holds {len(body)}")
        return body


def _from_base64(text: bytes) -> bytes:
    """Headers are encoded on their own, so padding may stand in the middle."""
    return b"".join(map(binascii.a2b_base64, re.findall(rb"[^=]+={0,2}", text)))


def _fans(corners: np.ndarray, ends: np.ndarray) -> np.ndarray:
    """Triangles (F, 3) of polygons: corners one after another, and where each polygon ends."""
    first, step = _triangles(corners, ends)
    return corners[np.column_stack([first, first + step + 1, first + step + 2])]


def _strips(corners: np.ndarray, ends: np.ndarray) -> np.ndarray:
    """Triangles (F, 3) of strips, every second one turned round."""
    first, step = _triangles(corners, ends)
    start, odd = first + step, step % 2
    return corners[np.column_stack([start, start + 1 + odd, start + 2 - odd])]


def _triangles(corners: np.ndarray, ends: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Of each triangle, where its cell begins and its number in the cell."""
    starts = np.concatenate([[0], ends[:-1]])
    counts = ends - starts - 2
    if (counts < 1).any():
        raise ValueError("a face has fewer than 3 corners")
    if ends[-1] != len(corners):
        raise ValueError(f"faces of {ends[-1]} corners where there are {len(corners)}")
    step = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)
    return np.repeat(starts, counts), step


# --- legacy files -----------------------------------------------------------------------------


def read_vtk(path: Path) -> _Arrays:
    """Vertices (V, 3) and triangles (F, 3) of a legacy PolyData file, text or binary.

    Raises:
        DataError: another kind of VTK data.
        ValueError: the file is damaged; so are a few other exceptions of the parsers.
    """
    data = path.read_bytes()
    if not data.startswith(b"# vtk DataFile"):
        raise ValueError("its first line is not that of a VTK file")
    _, _, coding, *rest = data.split(b"\n", 3)
    file = _Legacy(rest[0], binary=coding.strip().upper() == b"BINARY")
    kind = file.line(rb"DATASET\s+(\w+)")
    if kind is None:
        raise ValueError("it names no data set")
    if kind[0].upper() != b"POLYDATA":
        raise _other_data(path, kind[0].decode("ascii").upper())
    header = file.line(rb"POINTS\s+(\d+)\s+(\w+)")
    if header is None or int(header[0]) == 0:
        raise DataError(f"{path} holds no points; expected PolyData, so export it again.")
    points = file.numbers(3 * int(header[0]), header[1]).reshape(-1, 3).astype(np.float64)
    after_points, faces = file.place, []
    for name, triangles in ((b"POLYGONS", _fans), (b"TRIANGLE_STRIPS", _strips)):
        file.place = after_points
        header = file.line(name + rb"\s+(\d+)\s+(\d+)")
        if header is not None and int(header[1]):
            faces.append(triangles(*file.cells(*map(int, header))))
    return points, np.concatenate(faces) if faces else None


class _Legacy:
    """The content after the first three lines, read from a place that moves on."""

    def __init__(self, data: bytes, *, binary: bool):
        self.data, self.binary, self.place = data, binary, 0

    def line(self, pattern: bytes) -> tuple[bytes, ...] | None:
        """Groups of the next line of this form, and the place behind it; None without one."""
        form = re.compile(rb"^" + pattern + rb"[ \t\r]*\n", re.MULTILINE | re.IGNORECASE)
        found = form.search(self.data, self.place)
        if found is None:
            return None
        self.place = found.end()
        return found.groups()

    def numbers(self, count: int, kind: bytes) -> np.ndarray:
        name = _LEGACY_TYPES[kind.decode("ascii").lower()]
        if self.binary:
            found = np.frombuffer(self.data, f">{name}", count, self.place)
            self.place += found.nbytes
            return found
        words = self.data[self.place :].split(None, count)[:count]
        if len(words) < count:
            raise ValueError(f"{len(words)} numbers where {count} are announced")
        return np.array(words).astype(name)

    def cells(self, first: int, second: int) -> tuple[np.ndarray, np.ndarray]:
        """Corners one after another, and where each cell ends."""
        here = self.place
        offsets = self.line(rb"OFFSETS\s+(\w+)")
        if offsets is not None and not self.data[here : self.place].count(b"\n") > 1:
            ends = self.numbers(first, offsets[0]).astype(np.int64)[1:]
            kind = self.line(rb"CONNECTIVITY\s+(\w+)")
            if kind is None:
                raise ValueError("cells without connectivity")
            return self.numbers(second, kind[0]).astype(np.int64), ends
        # Before version 5: each cell's number of corners, then these.
        self.place = here
        table = self.numbers(second, b"int").astype(np.int64)
        starts = np.empty(first, dtype=np.int64)
        place = 0
        for cell in range(first):
            starts[cell] = place
            place += 1 + table[place]
        if place != len(table):
            raise ValueError("the lengths of its cells do not add up")
        return np.delete(table, starts), np.append(starts[1:], place) - np.arange(1, first + 1)
