"""Reading VTK's surfaces: .vtp and .vtu (XML) in the encodings of VTK and ParaView, .vtk (legacy).

Read here because VTK itself unpacks to over 500 MB, and meshio and trimesh have no PolyData.
"""

from __future__ import annotations

import binascii
import itertools
import lzma
import re
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from urllib.parse import unquote
from xml.etree import ElementTree

import numpy as np

from dine.errors import DataError
from dine.geometry.surface import Surface
from dine.io import polygons, text

_TYPES = {f"{k}{8 * n}": f"{c}{n}" for k, c in (("Int", "i"), ("UInt", "u")) for n in (1, 2, 4, 8)}
_TYPES |= {"Float32": "f4", "Float64": "f8"}
_LEGACY_TYPES = {"float": "f4", "double": "f8", "vtktypeint64": "i8", "vtkidtype": "i4"}
_LEGACY_TYPES |= {"char": "i1", "short": "i2", "int": "i4", "long": "i8"}
_LEGACY_TYPES |= {f"unsigned_{name}": f"u{_LEGACY_TYPES[name][1]}" for name in ("char", "short")}
_LEGACY_TYPES |= {"unsigned_int": "u4", "unsigned_long": "u8"}
_LEGACY_CELLS = ((b"POLYGONS", polygons.fans), (b"TRIANGLE_STRIPS", polygons.strips))
# Kinds of cells of a grid: (poly)vertices, (poly)lines; triangles, polygons, quads; strips.
_POINTS, _LINES, _POLYGONS, _STRIPS = (1, 2), (3, 4), (5, 7, 9), (6,)
_UNPACK: dict[str, Callable[[bytes], bytes]] = {
    "vtkZLibDataCompressor": zlib.decompress,
    "vtkLZMADataCompressor": lzma.decompress,
}


def read_vtp(path: Path, data: bytes) -> Surface:
    """A mesh or cloud of XML PolyData, or of an UnstructuredGrid of faces, with its point data.

    Arrays may be text, base64 or appended, raw or compressed (zlib, LZMA), of either byte order.
    Pieces follow each other; polygons and strips become triangles, lines are left out.

    Raises:
        DataError: another kind of VTK data, or compressed with LZ4.
        ValueError: the file is damaged; so are a few other exceptions of the parsers.
    """
    head, mark, appended = data.partition(b"<AppendedData")
    # Raw appended data is no XML, so only what stands before it is parsed.
    root = ElementTree.fromstring(head + b"</VTKFile>" if mark else head)
    if root.tag != "VTKFile":
        raise ValueError(f"its root is <{root.tag}>, not <VTKFile>")
    kind = str(root.get("type"))
    if kind not in ("PolyData", "UnstructuredGrid"):
        raise _other_data(path, kind)
    compressor = root.get("compressor")
    if compressor and compressor not in _UNPACK:
        raise DataError(
            f"{path} is compressed with {compressor}, which is not read; save it again with the "
            "compressor ZLib or None."
        )
    decode = _Decoder(root, appended)
    vertices, faces, count = [], [], 0
    values: dict[str, list[np.ndarray]] = {}
    left_out = dict.fromkeys(_named_arrays(root, f"{kind}/Piece/CellData", " of cells"))
    for piece in root.iterfind(f"{kind}/Piece"):
        announced = int(piece.get("NumberOfPoints", 0))
        if announced == 0:
            continue
        points = decode(_array(piece, "Points")).reshape(-1, 3)
        if len(points) != announced:
            raise ValueError(f"{len(points)} points where {announced} are announced")
        for part, triangles in (("Polys", polygons.fans), ("Strips", polygons.strips)):
            if int(piece.get(f"NumberOf{part}", 0)):
                faces.append(_faces(*_cells(piece, part, decode), triangles, left_out) + count)
        if int(piece.get("NumberOfCells", 0)):  # of a grid
            kinds = decode(_array(piece, "Cells", "types"))
            cells = _cells(piece, "Cells", decode)
            faces += [x + count for x in _grid_faces(path, *cells, kinds, left_out)]
        left_out |= dict.fromkeys(["lines"] * bool(int(piece.get("NumberOfLines", 0))))
        for name, array in _point_data(piece, decode, announced, left_out):
            values.setdefault(name, []).append(array)
        vertices.append(points.astype(np.float64))
        count += len(points)
    if not vertices:
        raise DataError(f"{path} holds no points; expected PolyData, so export it again.")
    whole = {name: np.concatenate(parts) for name, parts in values.items() if _fit(parts)}
    for name in [name for name, array in whole.items() if len(array) != count]:
        del whole[name]
    left_out |= dict.fromkeys(name for name in values if name not in whole)
    triangles = np.concatenate(faces) if faces else None
    return Surface(
        np.concatenate(vertices), triangles, str(path), _colored(whole), left_out=tuple(left_out)
    )


def _fit(parts: list[np.ndarray]) -> bool:
    return len({part.shape[1:] for part in parts}) == 1


def _faces(
    corners: np.ndarray,
    ends: np.ndarray,
    triangles: Callable[[np.ndarray], np.ndarray],
    left_out: dict[str, None],
) -> np.ndarray:
    """Triangles (F, 3) of cells given by their corners, and where each ends."""
    if len(ends) and np.diff(ends, prepend=0).min() < 0:
        raise ValueError("a face ends before it begins")
    if polygons.small(ends):
        left_out["edges"] = None
    if ends[-1] != len(corners):
        raise ValueError(f"faces of {ends[-1]} corners where there are {len(corners)}")
    return corners[triangles(ends)]


def _cells(
    piece: ElementTree.Element, part: str, decode: _Decoder
) -> tuple[np.ndarray, np.ndarray]:
    """Corners one after another, and where each cell ends."""
    arrays = (decode(_array(piece, part, name)) for name in ("connectivity", "offsets"))
    corners, ends = (array.astype(np.int64) for array in arrays)
    return corners, ends


def _grid_faces(
    path: Path,
    corners: np.ndarray,
    ends: np.ndarray,
    kinds: np.ndarray,
    left_out: dict[str, None],
) -> list[np.ndarray]:
    """Triangles of a grid whose cells are faces, as programs save surfaces that know no other.

    Raises:
        DataError: some are volumes or curved.
        ValueError: there are more or fewer kinds than cells.
    """
    if len(kinds) != len(ends):
        raise ValueError(f"{len(kinds)} kinds of cells where there are {len(ends)}")
    if not np.isin(kinds, (*_POINTS, *_LINES, *_POLYGONS, *_STRIPS)).all():
        raise _other_data(path, "UnstructuredGrid with volumes or curved cells")
    if np.isin(kinds, _LINES).any():
        left_out["lines"] = None
    sizes, faces = np.diff(ends, prepend=0), []
    if len(sizes) and (sizes.min() < 0 or ends[-1] != len(corners)):
        raise ValueError("the lengths of its cells do not add up")
    for some, triangles in ((_POLYGONS, polygons.fans), (_STRIPS, polygons.strips)):
        chosen = np.isin(kinds, some)
        if chosen.any():
            own = corners[np.repeat(chosen, sizes)]
            faces.append(_faces(own, np.cumsum(sizes[chosen]), triangles, left_out))
    return faces


def _colored(values: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The first array of 3 or 4 bytes a point is its colour, whatever its name."""
    for name, array in values.items():
        if array.dtype == np.uint8 and array.ndim == 2 and array.shape[1] in (3, 4):
            return {"colors" if key == name else key: values[key] for key in values}
    return values


def _named_arrays(root: ElementTree.Element, part: str, what: str) -> list[str]:
    return [f"{a.get('Name')}{what}" for a in root.iterfind(f"{part}/DataArray")]


def _point_data(
    piece: ElementTree.Element, decode: _Decoder, count: int, left_out: dict[str, None]
) -> Iterator[tuple[str, np.ndarray]]:
    """Arrays that are known of every point, by name; normals and texts are left out."""
    for group in piece.iterfind("PointData"):
        normals = group.get("Normals")
        for array in group:
            name, kind = array.get("Name", "values"), array.get("type", "")
            if name == normals or name.lower() == "normals":
                left_out["normals"] = None
            elif array.tag != "DataArray" or kind not in _TYPES:
                left_out[name] = None
            else:
                found = decode(array)
                if len(found) % count:
                    raise ValueError(f"{len(found)} numbers of {name} for {count} points")
                yield name, _columns(found, len(found) // count)


def _columns(values: np.ndarray, width: int) -> np.ndarray:
    """Numbers of the machine's own byte order, a row a point."""
    values = values.astype(values.dtype.newbyteorder("="))
    return values if width == 1 else values.reshape(-1, width)


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


# --- legacy files -----------------------------------------------------------------------------


def read_vtk(path: Path, data: bytes) -> Surface:
    """A mesh or cloud of a legacy file, text or binary, with its point data.

    Raises:
        DataError: another kind of VTK data.
        ValueError: the file is damaged; so are a few other exceptions of the parsers.
    """
    if not data.startswith(b"# vtk DataFile"):
        raise ValueError("its first line is not that of a VTK file")
    _, _, coding, *rest = data.split(b"\n", 3)
    file = _Legacy(rest[0], binary=coding.strip().upper() == b"BINARY")
    kind = file.line(rb"DATASET\s+(\w+)")
    if kind is None:
        raise ValueError("it names no data set")
    grid = kind[0].upper() == b"UNSTRUCTURED_GRID"
    if kind[0].upper() != b"POLYDATA" and not grid:
        raise _other_data(path, kind[0].decode("ascii").upper())
    header = file.line(rb"POINTS\s+(\d+)\s+(\w+)")
    if header is None or int(header[0]) == 0:
        raise DataError(f"{path} holds no points; expected PolyData, so export it again.")
    points = file.numbers(3 * int(header[0]), header[1]).reshape(-1, 3).astype(np.float64)
    after_points, left_out = file.place, {}
    faces = file.grid_faces(path, left_out) if grid else []
    for name, triangles in _LEGACY_CELLS:
        file.place = after_points
        header = file.line(name + rb"\s+(\d+)\s+(\d+)")
        if header is not None and int(header[1]):
            faces.append(_faces(*file.cells(*map(int, header)), triangles, left_out))
    file.place = after_points
    if file.line(rb"LINES\s+[1-9]\d*\s+(\d+)"):
        left_out["lines"] = None
    file.place = after_points
    if file.line(rb"CELL_DATA\s+(\d+)") is not None:
        left_out["data of cells"] = None
    file.place = after_points
    values = {}
    if file.line(rb"POINT_DATA\s+" + str(len(points)).encode()) is not None:
        values = _colored(dict(file.data_of(len(points), left_out)))
    triangles = np.concatenate(faces) if faces else None
    space = text.stated_space(data)
    return Surface(points, triangles, str(path), values, None, space, tuple(left_out))


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
        if count == 0:
            return np.empty(0, name)
        words = self.data[self.place :].split(None, count)
        if len(words) < count:
            raise ValueError(f"{len(words)} numbers where {count} are announced")
        self.place = len(self.data) - (len(words[count]) if len(words) > count else 0)
        return np.array(words[:count]).astype(name)

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
        corners, ends = polygons.counted(self.numbers(second, b"int").astype(np.int64))
        if len(ends) != first:
            raise ValueError("the lengths of its cells do not add up")
        return corners, ends

    def grid_faces(self, path: Path, left_out: dict[str, None]) -> list[np.ndarray]:
        """Triangles of the cells of a grid, all of which must be faces."""
        header = self.line(rb"CELLS\s+(\d+)\s+(\d+)")
        if header is None:
            return []
        corners, ends = self.cells(*map(int, header))
        kinds = self.line(rb"CELL_TYPES\s+(\d+)")
        if kinds is None:
            raise ValueError("cells without their kinds")
        return _grid_faces(path, corners, ends, self.numbers(int(kinds[0]), b"int"), left_out)

    def data_of(self, count: int, left_out: dict[str, None]) -> Iterator[tuple[str, np.ndarray]]:
        """Arrays of so many points by name, from here on; what is none goes to ``left_out``."""
        while (header := self.line(_ATTRIBUTE + rb"[ \t]+(\S[^\n]*?)")) is not None:
            keyword, words = header[0].upper(), header[1].split()
            if keyword == b"CELL_DATA":
                return
            if keyword == b"FIELD":
                yield from self._fields(int(words[1]), count, left_out)
                continue
            name, width, kind = unquote(words[0].decode()), _WIDTHS.get(keyword, 1), words[-1]
            if keyword in (b"COLOR_SCALARS", b"LOOKUP_TABLE"):
                kind = b"unsigned_char" if self.binary else b"float"
                width = int(words[1]) if keyword == b"COLOR_SCALARS" else 4
            elif keyword == b"SCALARS":
                kind, width = words[1], int(words[2]) if len(words) > 2 else 1
                table = re.compile(rb"\s*LOOKUP_TABLE[^\n]*\n").match(self.data, self.place)
                self.place = table.end() if table else self.place
            elif keyword == b"TEXTURE_COORDINATES":
                width = int(words[1])
            rows = int(words[1]) if keyword == b"LOOKUP_TABLE" else count
            found = _columns(self.numbers(rows * width, kind), width)
            if keyword == b"COLOR_SCALARS" and not self.binary:
                found = np.rint(255 * found.clip(0, 1)).astype(np.uint8)
            if keyword == b"NORMALS":
                left_out["normals"] = None
            elif keyword != b"LOOKUP_TABLE":
                yield name, found

    def _fields(
        self, arrays: int, count: int, left_out: dict[str, None]
    ) -> Iterator[tuple[str, np.ndarray]]:
        for _ in range(arrays):
            header = self.line(rb"(\S+)[ \t]+(\d+)[ \t]+(\d+)[ \t]+([A-Za-z]\w*)")
            if header is None:
                raise ValueError("a field has fewer arrays than it announces")
            name, width, rows = unquote(header[0].decode()), int(header[1]), int(header[2])
            if header[3].lower() not in map(str.encode, _LEGACY_TYPES):
                left_out[name] = None  # texts; what follows is found by its header
                continue
            found = self.numbers(rows * width, header[3])
            if rows == count and width:
                yield name, _columns(found, width)
            else:
                left_out[name] = None


_ATTRIBUTE = rb"(SCALARS|COLOR_SCALARS|VECTORS|NORMALS|TEXTURE_COORDINATES|TENSORS6?|LOOKUP_TABLE"
_ATTRIBUTE += rb"|GLOBAL_IDS|PEDIGREE_IDS|FIELD|CELL_DATA)"
_WIDTHS = {b"VECTORS": 3, b"NORMALS": 3, b"TENSORS": 9, b"TENSORS6": 6}
