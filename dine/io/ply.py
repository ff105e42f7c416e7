"""Reading PLY: text and binary, triangles, polygons and strips, and what vertices hold beside."""

from __future__ import annotations

import re
import struct
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from dine.errors import DataError
from dine.geometry.surface import Surface
from dine.io import polygons, text
from dine.io.meshes import colors_of

_TYPES = {"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"}
_TYPES |= {"float": "f4", "double": "f8"}
_TYPES |= {f"{k}{8 * n}": f"{k[0]}{n}" for k in ("int", "uint") for n in (1, 2, 4, 8)}
_TYPES |= {"float32": "f4", "float64": "f8"}
_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_CORNERS = ("vertex_indices", "vertex_index")
_NORMALS = {"nx", "ny", "nz"}
_COLORS = [
    [f"{prefix}{n}" for n in ("red", "green", "blue", "alpha")] for prefix in ("", "diffuse_")
]
_COLORS.append(["r", "g", "b", "a"])


@dataclass(frozen=True)
class _List:
    """A property that has several values a row: all of them, and where each row ends."""

    values: np.ndarray
    ends: np.ndarray


@dataclass(frozen=True)
class _Element:
    """What a header says of one kind of rows; of a list property also the type of its length."""

    name: str
    count: int
    properties: dict[str, tuple[str, str | None]] = field(default_factory=dict)

    @property
    def has_lists(self) -> bool:
        return any(length for _, length in self.properties.values())


_Table = dict[str, np.ndarray | _List]


def read_ply(path: Path, data: bytes) -> Surface:
    """A mesh or cloud.

    Raises:
        DataError: cut short, without vertices, or its faces stand in elements that are not read.
        ValueError: damaged.
    """
    kind, elements, body = _header(data)
    rows = iter(_lines(elements, body)) if kind == "ascii" else None
    tables, start = {}, 0
    for element in elements:
        if rows is not None:
            tables[element.name] = _text_rows(element, rows)
        else:
            tables[element.name], start = _binary_rows(element, body, start, _ORDERS[kind])
    _check_end(list(rows) if rows is not None else body[start:])
    vertex = tables.pop("vertex", {})
    if "x" not in vertex:
        vertex = {name.lower(): column for name, column in vertex.items()}
    if not {"x", "y", "z"} <= vertex.keys() or len(vertex["x"]) == 0:
        raise DataError(
            f"{path} holds no mesh and no points, or is cut short; expected a .ply file with "
            "vertices, so export it again."
        )
    vertices = np.column_stack([vertex.pop(axis) for axis in "xyz"]).astype(np.float64)
    values, left_out = _values(vertex)
    faces, texture, others = _faces(path, tables)
    space = text.stated_space(data)
    return Surface(vertices, faces, str(path), values, texture, space, (*left_out, *others))


def _check_end(rest: list[bytes] | bytes) -> None:
    """Refuse further rows behind those that the header announces; blanks and text are harmless."""
    if isinstance(rest, list):
        text.refuse_more(rest, "the last element")
    elif b"\0" in (rest := rest.strip(b"\0 \t\r\n\x1a")) or not rest.isascii():
        raise ValueError("it holds more than its header announces")


def _header(data: bytes) -> tuple[str, list[_Element], bytes]:
    found = re.match(rb"ply[ \t]*(\r\n|\n|\r)", data)
    if found is None:
        raise ValueError("its first line is not 'ply'")
    newline = rb"\r" if found[1] == b"\r" else rb"\r?\n"
    end = re.search(rb"[\r\n]end_header[ \t]*" + newline, data)
    if end is None:
        raise ValueError("its header does not end")
    kind, elements = "", []
    for line in data[found.end() : end.start()].decode("utf-8", "replace").splitlines():
        words = line.split() or ["comment"]
        if words[0] == "format" and len(words) == 3 and words[1] in _ORDERS:
            kind = words[1]
        elif words[0] == "element" and len(words) == 3:
            elements.append(_Element(words[1], int(words[2])))
        elif words[0] == "property" and len(words) == 3 and elements:
            elements[-1].properties[words[2]] = (_type(words[1]), None)
        elif words[:2] == ["property", "list"] and len(words) == 5 and elements:
            elements[-1].properties[words[4]] = (_type(words[3]), _type(words[2]))
        elif words[0] not in ("comment", "obj_info"):
            raise ValueError(f"its header has the line {line!r}")
    if not kind or any(element.count < 0 for element in elements):
        raise ValueError("its header names no format, or a negative number of rows")
    return kind, elements, data[end.end() :]


def _type(name: str) -> str:
    if name not in _TYPES:
        raise ValueError(f"its header has the type {name!r}")
    return _TYPES[name]


# --- rows -------------------------------------------------------------------------------------


def _lines(elements: list[_Element], body: bytes) -> list[bytes]:
    """Rows of all elements, also of a file that has its line ends elsewhere."""
    lines = text.rows(body)
    announced = sum(element.count for element in elements if element.properties)
    if len(lines) == announced:
        return lines
    words, found, at = b" ".join(lines).split(), [], 0
    for element in elements:
        for _ in range(element.count if element.properties else 0):
            start = at
            for _, length in element.properties.values():
                if at >= len(words):
                    return lines
                at += 1 + _size(words[at]) if length else 1
            found.append(b" ".join(words[start:at]))
    return found if at == len(words) else lines


def _size(word: bytes) -> int:
    return int(word) if word.isdigit() else 0


def _text_rows(element: _Element, rows: Iterator[bytes]) -> _Table:
    names = list(element.properties)
    if not names:
        return {}
    lines = [line.split() for _, line in zip(range(element.count), rows, strict=False)]
    if len(lines) < element.count:
        raise ValueError(f"{len(lines)} rows of {element.name} where {element.count} are announced")
    if not element.has_lists:
        if any(len(line) != len(names) for line in lines):
            raise ValueError(f"a row of {element.name} has not {len(names)} numbers")
        table = np.array(lines, dtype=np.float64).reshape(-1, len(names))
        kinds = (kind for kind, _ in element.properties.values())
        return {n: _cast(c, k) for n, c, k in zip(names, table.T, kinds, strict=True)}
    values: dict[str, list] = {name: [] for name in names}
    ends: dict[str, list[int]] = {name: [] for name in names}
    for line in lines:
        at = 0
        for name, (_, length) in element.properties.items():
            size = 1
            if length:
                size, at = int(line[at]), at + 1
            values[name] += line[at : at + size]
            at += size
            ends[name].append(len(values[name]))
        if at != len(line):
            raise ValueError(f"a row of {element.name} holds {len(line)} numbers instead of {at}")
    return {
        name: _column(_cast(np.array(values[name], np.float64), kind), ends[name], length)
        for name, (kind, length) in element.properties.items()
    }


def _cast(values: np.ndarray, kind: str) -> np.ndarray:
    """Numbers as the type that the header says."""
    with np.errstate(over="ignore", invalid="ignore"):  # seen in what comes out
        found = values.astype(kind)
    if found.dtype.kind != "f" and (found != values).any():
        raise ValueError(f"it holds numbers that are no {found.dtype}")
    return found


def _column(values: np.ndarray, ends: list[int], length: str | None) -> np.ndarray | _List:
    return _List(values, np.array(ends, dtype=np.int64)) if length else values


def _binary_rows(element: _Element, body: bytes, start: int, order: str) -> tuple[_Table, int]:
    """Columns of an element that begins at ``start``, and where the next one does."""
    if not element.properties or not element.count:
        return {name: np.empty(0) for name in element.properties}, start
    same = _same_rows(element, body, start, order)
    if same is not None:
        return same
    readers = [
        (
            name,
            struct.Struct(order + _STRUCT[kind]),
            length and struct.Struct(order + _STRUCT[length]),
        )
        for name, (kind, length) in element.properties.items()
    ]
    pieces: dict[str, list[bytes]] = {name: [] for name in element.properties}
    ends: dict[str, list[int]] = {name: [] for name in element.properties}
    at = start
    for _ in range(element.count):
        for name, value, length in readers:
            size = 1
            if length:
                (size,) = length.unpack_from(body, at)
                at += length.size
            stop = at + size * value.size
            if stop > len(body) or size < 0:
                raise ValueError(f"it ends within the rows of {element.name}")
            pieces[name].append(body[at:stop])
            ends[name].append(size + (ends[name][-1] if ends[name] else 0))
            at = stop
    table = {
        name: _column(np.frombuffer(b"".join(pieces[name]), order + kind), ends[name], length)
        for name, (kind, length) in element.properties.items()
    }
    return table, at


_STRUCT = {"i1": "b", "u1": "B", "i2": "h", "u2": "H", "i4": "i", "u4": "I", "f4": "f", "f8": "d"}
_STRUCT |= {"i8": "q", "u8": "Q"}


def _same_rows(element: _Element, body: bytes, start: int, order: str) -> tuple[_Table, int] | None:
    """As :func:`_binary_rows`, at once where all lists are as long as those of the first row."""
    fields, at = [], start
    for name, (kind, length) in element.properties.items():
        if length:
            (size,) = np.frombuffer(body, order + length, 1, at).tolist()
            fields += [(f"{name} length", order + length), (name, order + kind, (int(size),))]
        else:
            fields.append((name, order + kind))
        at = start + np.dtype(fields).itemsize
    row = np.dtype(fields)
    stop = start + element.count * row.itemsize
    if stop > len(body):
        if element.has_lists:
            return None
        raise ValueError(f"it ends within the rows of {element.name}")
    rows = np.frombuffer(body, row, element.count, start)
    table: _Table = {}
    for name, (_, length) in element.properties.items():
        table[name] = rows[name]
        if length:
            sizes = rows[f"{name} length"]
            if (sizes != sizes[0]).any():
                return None
            ends = np.arange(1, element.count + 1) * int(sizes[0])
            table[name] = _List(rows[name].reshape(-1), ends)
    return table, stop


# --- what they mean ---------------------------------------------------------------------------


def _values(vertex: _Table) -> tuple[dict[str, np.ndarray], list[str]]:
    """What is known at vertices beside their places, and what is left out."""
    left_out = ["normals"] if vertex.keys() & _NORMALS else []
    values = {}
    for name, column in vertex.items():
        if isinstance(column, _List):
            left_out.append(name)
        elif name not in _NORMALS:
            values[name] = column.astype(column.dtype.newbyteorder("="))
    for names in _COLORS:
        shades = [name for name in names if name in values]
        if shades[:3] == names[:3] and len({values[name].dtype for name in shades}) == 1:
            colors = colors_of(np.column_stack([values[name] for name in shades]))
            if colors is not None:
                values = {name: x for name, x in values.items() if name not in shades}
                values["colors"] = colors
                break
    return values, left_out


def _faces(
    path: Path, tables: dict[str, _Table]
) -> tuple[np.ndarray | None, np.ndarray | None, list[str]]:
    """Triangles, their texture coordinates, and what is left out."""
    found, texture, left_out = [], None, []
    for name, cut in (("face", polygons.fans), ("tristrips", polygons.strips)):
        table = tables.pop(name, {})
        lists = [key for key, column in table.items() if isinstance(column, _List)]
        if not lists:
            left_out += [f"{key} of faces" for key in table if len(table[key])]
            continue
        corners = table.pop(next((key for key in _CORNERS if key in lists), lists[0]))
        if (corners.values != np.floor(corners.values)).any():
            raise ValueError("its faces are not whole numbers")
        cells, ends = corners.values.astype(np.int64), corners.ends
        if name == "tristrips":  # -1 ends a strip, too
            here = np.union1d(ends, np.flatnonzero(cells == -1))
            ends = np.cumsum(np.append(0, cells != -1))[here]
            cells = cells[cells != -1]
        if polygons.small(ends):
            left_out.append("edges")
        triangles = cut(ends)
        found.append(cells[triangles])
        coordinates = table.get("texcoord")
        if isinstance(coordinates, _List) and np.array_equal(coordinates.ends, 2 * ends):
            texture = table.pop("texcoord").values.reshape(-1, 2)[triangles].astype(np.float64)
        left_out += [f"{key} of faces" for key in table]
    for name, table in tables.items():
        if not found and any(isinstance(column, _List) for column in table.values()):
            raise DataError(
                f"{path} has no faces but elements '{name}', which are not read; export it as "
                "triangles."
            )
        left_out.append(f"elements '{name}'")
    if len(found) > 1 and texture is not None:
        texture, left_out = None, [*left_out, "texture coordinates"]
    return np.concatenate(found) if found else None, texture, left_out
