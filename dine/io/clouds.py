"""Reading points from text tables, PTS and PCD."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from dine.errors import DataError
from dine.geometry.surface import Surface
from dine.io import announced, text
from dine.io.meshes import nothing_in

# Without names for its columns a wider table is something else than points.
_MOST_COLUMNS = 12
_COMMENT = re.compile(r"^\s*(?:#|//|%|!|;\s|sep=.$)")
_DOUBLE = re.compile(r"([-+]?[\d.]+)[dD]([-+]?\d+)")
# At least one comma within a number, and none between them.
_DECIMAL_COMMAS = re.compile(r"(?=.*,)[-+\d.e]+(?:,[\de+-]+)?(?:\s+[-+\d.e]+(?:,[\de+-]+)?){2,}")
# "x", "X [mm]", "Points:0", "pos_y": an axis, perhaps after a word for points and before a unit.
_AXIS = re.compile(
    r"(?P<word>points?|pos|position|coords?|coordinates?)?[\s_:.]*(?P<axis>[xyz]|(?<=[\s_:.])[012])"
    r"[\s_]*(?:[\[(].*[\])]|mm|cm|m)?"
)


def read_table(path: Path, data: bytes) -> Surface:
    """Points of a text table: three columns first, or named x, y and z by a line above.

    Columns are parted by commas, semicolons or white space; a line that counts the rows may stand
    first.
    """
    lines, names, titled = _lines(path, text.decoded(data))
    width = len(lines[0])
    axes = [0, 1, 2] if names is None else _axes(path, names)
    if names is None and not 3 <= width <= _MOST_COLUMNS:
        raise DataError(
            f"{path} has {width} columns; expected x, y and z first, or a line above that names "
            "them."
        )
    table = numbers(path, [[line[axis] for axis in axes] for line in lines])
    if names is None and width > 3 and len(table) > 1:
        first = table[:, 0] - table[0, 0]
        if table[0, 0] in (0, 1) and np.array_equal(first, np.arange(len(table))):
            raise DataError(
                f"{path} counts its rows in its first column; remove it, or write a line above "
                "that names the columns (x, y, z)."
            )
    left_out = ("lines above the names of the columns",) * titled
    return Surface(table, name=str(path), left_out=_others(width, axes, names) + left_out)


def read_indices(path: Path, data: bytes) -> np.ndarray:
    """(F, 3) numbers of a ``.triangle`` file."""
    lines, _, _ = _lines(path, text.decoded(data))
    if len(lines[0]) != 3:
        raise DataError(f"{path} has {len(lines[0])} columns; expected 3 vertex indices a row.")
    return numbers(path, lines)


def _lines(path: Path, content: str) -> tuple[list[list[str]], list[str] | None, bool]:
    """Fields of every row, the names of the columns, if any, and whether titles stand above."""
    rows, above = [], ""
    for line in filter(None, map(str.strip, content.splitlines())):
        if not _COMMENT.match(line):
            rows.append(line.partition("#")[0].strip())
        elif not rows:
            above = line
    if not rows:
        raise DataError(f"{path} holds no rows; expected columns of x, y and z.")
    if ";" in rows[-1] or _DECIMAL_COMMAS.fullmatch(rows[-1]):
        rows = [row.replace(",", ".") for row in rows]
    delimiter = next((mark for mark in ";,|" if mark in rows[-1]), None)
    fields = [_fields(row, delimiter) for row in rows]
    if any(map(_DOUBLE.fullmatch, fields[-1])):
        fields = [[_DOUBLE.sub(r"\1e\2", field) for field in row] for row in fields]
    if _is_count(fields[0]) and len(fields) > 1:
        fields = _uncounted(path, fields)
    names, titles = None, _titles(fields)
    fields = fields[titles:]
    if not any(map(_is_number, fields[0])):
        names, fields = fields[0], fields[1:]
    else:  # perhaps a comment names them
        said = _fields(above.lstrip("#/%!; "), delimiter)
        names = said if len(said) == len(fields[0]) and len(_found_axes(said)) == 3 else None
    if not fields:
        raise DataError(f"{path} holds no rows; expected columns of x, y and z.")
    width = len(fields[0] if names is None else names)
    odd = next((row for row in fields if len(row) != width), None)
    if odd is not None:
        raise DataError(
            f"{path} is not a table: the number of columns changed from {width} to {len(odd)} at "
            f"{' '.join(odd)[:40]!r}; repair or convert it."
        )
    return fields, names, titles > 0


def _is_count(row: list[str]) -> bool:
    return len(row) == 1 and row[0].isdigit()


def _uncounted(path: Path, fields: list[list[str]]) -> list[list[str]]:
    """Rows of a table, or of several, each below a line with its number of rows."""
    found, at = [], 0
    while at < len(fields):
        count = int(fields[at][0]) if _is_count(fields[at]) else 0
        rows = fields[at + 1 : at + 1 + count]
        if len(rows) != count or not rows or len(rows[0]) == 1:
            raise DataError(
                f"{path} is not a table of points: its first line announces {fields[0][0]} rows, "
                f"and {len(fields) - 1} follow; repair or convert it."
            )
        found += rows
        at += 1 + count
    return found


def _titles(fields: list[list[str]]) -> int:
    """How many lines stand above the one that names the columns, before any row of numbers."""
    for place, row in enumerate(fields):
        if len(_found_axes(row)) == 3:
            return place
        if all(map(_is_number, row)):
            break
    return 0


def _fields(row: str, delimiter: str | None) -> list[str]:
    if delimiter is None:
        row = re.sub(r"\s+(?=[\[(])", "", row)  # units: x (mm) y (mm) z (mm)
    fields = [field.strip().strip("\"'") for field in row.split(delimiter)]
    return fields[:-1] if len(fields) > 1 and not fields[-1] else fields


def _is_number(field: str) -> bool:
    try:
        float(field)
    except ValueError:
        return False
    return True


def _found_axes(names: Sequence[str]) -> dict[str, int]:
    """Columns by axis; the first ones of several."""
    found: dict[str, int] = {}
    for column, name in enumerate(names):
        match = _AXIS.fullmatch(name.lower())
        if match and (match["axis"] in "xyz" or match["word"]):
            axis = match["axis"]
            found.setdefault(axis if axis in "xyz" else "xyz"[int(axis)], column)
    return found


def _axes(path: Path, names: list[str]) -> list[int]:
    found = _found_axes(names)
    if len(found) < 3:
        raise DataError(
            f"{path} names its columns {', '.join(names)[:80]}; expected three of them to be "
            "called x, y and z."
        )
    return [found[axis] for axis in "xyz"]


def _others(width: int, axes: list[int], names: list[str] | None) -> tuple[str, ...]:
    others = [column for column in range(width) if column not in axes]
    if not others:
        return ()
    if names is not None:
        return tuple(f"column {names[column]!r}" for column in others)
    return ("column 4" if width == 4 else f"columns 4 to {width}",)


def numbers(path: Path, lines: list[list[str]]) -> np.ndarray:
    """Rows of fields as float64.

    Raises:
        DataError: a field is no number.
    """
    try:
        return np.array(lines, dtype=np.float64)
    except ValueError as error:
        raise DataError(
            f"{path} is not a table of numbers ({str(error).rstrip('.')}); repair or convert it."
        ) from error


# --- PCD --------------------------------------------------------------------------------------

_PCD_KINDS = {"F": "f", "I": "i", "U": "u"}


def read_pcd(path: Path, data: bytes) -> Surface:
    """Points of the Point Cloud Library, as text, binary or compressed.

    Points without a measurement, which organised clouds hold as NaN, are left out.
    """
    header, body = _pcd_header(data)
    count, columns = int(header["POINTS"][0]), _pcd_columns(header)
    row = np.dtype([(name, kind, shape) for name, kind, shape in columns])
    how = header["DATA"][0].lower()
    if how == "ascii":
        table = _pcd_text(body, columns, count)
    else:
        if how == "binary_compressed":
            packed, size = np.frombuffer(body, "<u4", 2).tolist()
            announced.check(path, "its content", packed, len(body) - 8)
            announced.check(path, "its content", size, announced.limit(packed))
            body = _lzf(body[8 : 8 + packed], size)
        announced.check(path, "its header", count * row.itemsize, len(body))
        if how == "binary_compressed":  # one field after another
            table, start = {}, 0
            for name, kind, shape in columns:
                field = np.dtype((kind, shape))
                table[name] = np.frombuffer(body, field, count, start)
                start += count * field.itemsize
        else:
            rows = np.frombuffer(body, row, count)
            table = {name: rows[name] for name, _, _ in columns}
    if count == 0 or not {"x", "y", "z"} <= table.keys():
        raise nothing_in(path)
    points = np.column_stack([table.pop(axis) for axis in "xyz"]).astype(np.float64)
    measured = ~np.isnan(points).any(axis=1)
    left_out = ["points without a measurement"] if not measured.all() else []
    values = {name: x[measured] for name, x in table.items() if not name.startswith("_")}
    for name in ("rgb", "rgba"):
        if name in values and values[name].dtype.itemsize == 4:
            packed = np.ascontiguousarray(values.pop(name)).view("<u4").reshape(-1)
            shifts = (16, 8, 0, 24) if name == "rgba" else (16, 8, 0)
            values["colors"] = np.column_stack([packed >> s & 255 for s in shifts]).astype(np.uint8)
    normals = [values.pop(f"normal_{axis}", None) for axis in "xyz"]
    left_out += ["normals"] * any(normal is not None for normal in normals)
    return Surface(points[measured], None, str(path), values, left_out=tuple(left_out))


def _pcd_header(data: bytes) -> tuple[dict[str, list[str]], bytes]:
    found = re.search(rb"^DATA[ \t]+(\w+)[ \t]*\r?\n", data, re.MULTILINE)
    if found is None:
        raise ValueError("its header does not end with a line DATA")
    lines = text.rows(data[: found.end()])
    header = {line.split()[0].decode(): line.decode("ascii").split()[1:] for line in lines}
    if {"WIDTH", "HEIGHT"} <= header.keys():  # before version 0.7 the only ones
        header.setdefault("POINTS", [str(int(header["WIDTH"][0]) * int(header["HEIGHT"][0]))])
    missing = {"FIELDS", "SIZE", "TYPE", "POINTS"} - header.keys()
    if missing:
        raise ValueError(f"its header lacks {', '.join(sorted(missing))}")
    return header, data[found.end() :]


def _pcd_columns(header: dict[str, list[str]]) -> list[tuple[str, str, tuple[int, ...]]]:
    """Name, type and shape of every field; padding gets a name of its own."""
    names = [n if n != "_" else f"_{i}" for i, n in enumerate(header["FIELDS"])]
    counts = header.get("COUNT", ["1"] * len(names))
    given = zip(names, header["TYPE"], header["SIZE"], counts, strict=True)
    return [
        (name, f"<{_PCD_KINDS[kind]}{int(size)}", () if int(count) == 1 else (int(count),))
        for name, kind, size, count in given
    ]


def _pcd_text(
    body: bytes, columns: list[tuple[str, str, tuple[int, ...]]], count: int
) -> dict[str, np.ndarray]:
    lines = [line.split() for line in text.rows(body)]
    if len(lines) < count:
        raise ValueError(f"{len(lines)} points where {count} are announced")
    text.refuse_more(map(b" ".join, lines[count:]), "points")
    rows = np.array(lines[:count], dtype=np.float64)
    table, start = {}, 0
    for name, kind, shape in columns:
        width = shape[0] if shape else 1
        column = rows[:, start : start + width]
        start += width
        # A packed colour is written as the integer that its bits are, or as such a float.
        packed = name in ("rgb", "rgba") and (column == np.floor(column)).all()
        values = column.astype("<u4" if packed else kind)
        table[name] = values if shape else values[:, 0]
    if rows.shape[1:] != (start,):
        raise ValueError(f"a point has {rows.shape[1:]} numbers instead of {start}")
    return table


def _lzf(packed: bytes, size: int) -> bytes:
    """What LZF packed: runs of bytes, and references to what came before."""
    found, at = bytearray(), 0
    while at < len(packed) and len(found) <= size:
        control = packed[at]
        at += 1
        if control < 32:
            found += packed[at : at + control + 1]
            at += control + 1
            continue
        length = control >> 5
        if length == 7:
            length += packed[at]
            at += 1
        back = ((control & 31) << 8 | packed[at]) + 1
        at += 1
        start = len(found) - back
        if start < 0:
            raise ValueError("its compressed content is damaged")
        for place in range(start, start + length + 2):
            found.append(found[place])
    if len(found) != size:
        raise ValueError(f"its compressed content has {len(found)} bytes instead of {size}")
    return bytes(found)
