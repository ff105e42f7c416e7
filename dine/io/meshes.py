"""Reading OBJ, OFF and STL."""

from __future__ import annotations

import itertools
import re
from pathlib import Path

import numpy as np

from dine.errors import DataError
from dine.geometry.surface import Surface
from dine.io import polygons, text


def nothing_in(path: Path) -> DataError:
    """The error for a file without vertices."""
    return DataError(
        f"{path} holds no mesh and no points, or is cut short; expected a "
        f"{text.format_suffix(path)} file with vertices, so export it again."
    )


def colors_of(values: np.ndarray) -> np.ndarray | None:
    """Vertex colours (V, 3) or (V, 4) as uint8, of numbers up to 1 or 255; None of others."""
    if values.ndim != 2 or values.shape[1] not in (3, 4) or not np.isfinite(values).all():
        return None
    if values.min(initial=0) < 0 or values.max(initial=0) > 255:
        return None
    scale = 255 if values.max(initial=0) <= 1 and values.dtype.kind == "f" else 1
    return np.rint(values * scale).astype(np.uint8)


# --- OBJ --------------------------------------------------------------------------------------

# Other lines of an OBJ file: what is said of them where they are left out, or None for nothing.
_OBJ_LINES = dict.fromkeys(("", "o", "g", "s", "mg", "vp", "deg", "bmat", "step", "cstype"))
_OBJ_LINES |= dict.fromkeys(("parm", "trim", "hole", "scrv", "sp", "end", "con", "bevel", "lod"))
_OBJ_LINES |= dict.fromkeys(("c_interp", "d_interp", "shadow_obj", "trace_obj", "ctech", "stech"))
_OBJ_LINES |= {"vn": "normals", "l": "lines", "p": "points of faces"}
_OBJ_LINES |= dict.fromkeys(("usemtl", "mtllib", "usemap", "maplib"), "materials")
_OBJ_LINES |= dict.fromkeys(("curv", "curv2", "surf"), "curved surfaces")


class _Obj:
    """Lines of an OBJ file, taken one by one."""

    def __init__(self):
        self.vertices: list[list[str]] = []
        self.coordinates: list[tuple[float, float]] = []
        self.faces: list[tuple[int, ...]] = []
        self.texture: list[tuple[int, ...]] = []
        self.left_out: dict[str, None] = {}

    def take(self, line: str) -> None:
        keyword, *values = line.partition("#")[0].split() or [""]
        keyword = keyword.lower()
        if keyword == "v":
            self.vertices.append(values)
        elif keyword in ("f", "fo"):
            self._face(values)
        elif keyword == "vt":
            self.coordinates.append((float(values[0]), float([*values, "0"][1])))
        elif keyword in _OBJ_LINES:
            if _OBJ_LINES[keyword]:
                self.left_out[_OBJ_LINES[keyword]] = None
        elif keyword.isascii() and keyword.isidentifier():
            self.left_out[f"lines '{keyword}'"] = None
        else:
            raise ValueError(f"a line begins with {keyword!r}")

    def _face(self, values: list[str]) -> None:
        if len(values) < 3:
            if len(values) < 2 or not all(value.lstrip("-").isdigit() for value in values):
                raise ValueError("a face has fewer than 3 corners")
            self.left_out["edges"] = None
            return
        parts = [value.split("/") for value in values]
        corners = [_from_one(part[0], len(self.vertices)) for part in parts]
        if min(corners) < 0 or "0" in (part[0] for part in parts):
            raise ValueError(f"the face '{' '.join(values)}' names no vertex: they count from 1")
        textured = all(len(part) > 1 and part[1] for part in parts)
        places = [_from_one(part[1], len(self.coordinates)) if textured else -1 for part in parts]
        for kept, (first, *others) in ((self.faces, corners), (self.texture, places)):
            kept += [(first, *edge) for edge in itertools.pairwise(others)]

    def data(self) -> tuple[np.ndarray, dict[str, np.ndarray]]:
        """Vertices (V, 3) and their colours, which follow the coordinates."""
        width = min(map(len, self.vertices))
        if width < 3:
            raise ValueError("a vertex has fewer than 3 coordinates")
        table = np.array([row[:7] if width > 5 else row[:3] for row in self.vertices], np.float64)
        colors = colors_of(table[:, 3:]) if width > 5 else None
        if colors is None and any(len(row) > 4 for row in self.vertices):
            self.left_out["colors"] = None
        return table[:, :3], {} if colors is None else {"colors": colors}

    def textured(self) -> np.ndarray | None:
        """Texture coordinates (F, 3, 2), if all faces have them."""
        places = np.array(self.texture, dtype=np.int64)
        if len(places) and places.min() >= 0 and places.max() < len(self.coordinates):
            return np.array(self.coordinates)[places]
        if self.coordinates:
            self.left_out["texture coordinates"] = None
        return None


def _from_one(index: str, count: int) -> int:
    """Positive indices count from 1, negative ones back from the latest."""
    number = int(index)
    return number - 1 if number > 0 else count + number


def read_obj(path: Path, data: bytes) -> Surface:
    """A mesh or cloud; trimesh would split vertices along textures and materials."""
    found = _Obj()
    for line in re.sub(r"\\\r?\n", " ", text.decoded(data)).splitlines():
        found.take(line)
    if not found.vertices:
        raise nothing_in(path)
    vertices, values = found.data()
    faces = np.array(found.faces) if found.faces else None
    if faces is None and "curved surfaces" in found.left_out:
        raise DataError(f"{path} holds curved surfaces only; export it as triangles.")
    texture, space = found.textured(), text.stated_space(data)
    return Surface(vertices, faces, str(path), values, texture, space, tuple(found.left_out))


# --- OFF --------------------------------------------------------------------------------------


def read_off(path: Path, data: bytes) -> Surface:
    """A mesh or cloud of Geomview's OFF, COFF, NOFF and STOFF, as text; the word may be missing."""
    rows = [row.split() for row in text.rows(data)]
    first = rows[0][0] if rows else b""
    kind = re.fullmatch(rb"(ST)?(C)?(N)?OFF", first.upper() if first.islower() else first)
    if kind is None and not first.isdigit():
        other = re.fullmatch(rb"(?:ST)?C?N?(?:4|4?n)OFF", first)
        raise ValueError(
            "its points are not of three dimensions"
            if other
            else "its first word is not OFF, COFF, NOFF or STOFF"
        )
    if kind is not None:
        rows[0] = rows[0][1:]
        if rows[0][:1] == [b"BINARY"]:
            raise DataError(f"{path} is binary OFF, which is not read; export it as text.")
    (st, c, n), rows = kind.groups() if kind else (None,) * 3, [row for row in rows if row]
    counts = rows.pop(0)
    vertices, faces = int(counts[0]), int(counts[1])
    if min(vertices, faces) < 0:
        raise ValueError("it announces a negative number of rows")
    if len(rows) < vertices + faces:
        width = 3 + (3 if n else 0) + (4 if c else 0) + (2 if st else 0)
        rows = _off_rows([*counts[3:], *itertools.chain(*rows)], vertices, faces, width)
    if rows is None:
        raise DataError(f"{path} is cut short: it has fewer rows than it announces; copy it again.")
    if vertices == 0:
        raise nothing_in(path)
    if len({len(row) for row in rows[:vertices]}) > 1:
        raise ValueError("its vertices have different numbers of columns")
    table = np.array(rows[:vertices], dtype=np.float64)
    values, left_out = {}, ["normals"] if n else []
    more = table[:, 6 if n else 3 :]
    if st:
        more, values["texture_coordinates"] = more[:, :-2], more[:, -2:]
    colors = colors_of(more)
    if colors is not None:
        values["colors"] = colors
    elif more.shape[1]:
        left_out.append("further columns of vertices")
    corners, ends, colored = [], [], False
    for row in rows[vertices : vertices + faces]:
        size = int(row[0])
        if size < 0 or len(row) < 1 + size:
            raise DataError(f"{path} is cut short: a face lacks corners; copy it again.")
        corners += row[1 : 1 + size]
        ends.append(len(corners))
        colored |= len(row) > 1 + size
    text.refuse_more(map(b" ".join, rows[vertices + faces :]), "faces")
    left_out += ["colors of faces"] * colored
    if polygons.small(np.array(ends, dtype=np.int64)):
        left_out.append("edges")
    triangles = polygons.fans(np.array(ends, dtype=np.int64))
    cells = np.array([int(corner) for corner in corners], dtype=np.int64)
    found = cells[triangles] if len(triangles) else None
    return Surface(table[:, :3], found, str(path), values, left_out=tuple(left_out))


def _off_rows(
    words: list[bytes], vertices: int, faces: int, width: int
) -> list[list[bytes]] | None:
    """Rows of a file that has its line ends elsewhere; None if its words do not make these."""
    if len(words) < width * vertices:
        return None
    rows = [words[width * i : width * (i + 1)] for i in range(vertices)]
    at = width * vertices
    for _ in range(faces):
        if at >= len(words):
            return None
        stop = at + 1 + max(int(words[at]), 0)
        rows.append(words[at:stop])
        at = stop
    return rows if at == len(words) else None


# --- STL --------------------------------------------------------------------------------------

#: One triangle of a binary file.
FACET = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
_HEADER = 84
# Where the solid begins, behind lines that say who made it.
_SOLID = re.compile(rb"(?:[ \t]*(?:[#;/][^\r\n]*)?[\r\n])*[ \t]*solid", re.IGNORECASE)
_STL_WORDS = re.compile(
    rb"\s+(?=(?:facet\s+normal|outer\s+loop|vertex|endloop|endfacet|endsolid|solid)\b)",
    re.IGNORECASE,
)
_SAME_LINE = re.compile(rb"vertex(?:[ \t]+[-+.\de]+){3}[ \t]+[a-z]", re.IGNORECASE)


def read_stl(path: Path, data: bytes) -> Surface:
    """A mesh of three vertices for each triangle, of all solids in the file, text or binary."""
    count = int.from_bytes(data[80:_HEADER], "little")
    rest = len(data) - _HEADER - count * FACET.itemsize
    plain = text.without_mark(data) if rest != 0 else b""
    # The header of a binary file may say "solid" as well; no text has zeros.
    if _SOLID.match(plain) and b"\0" not in plain[:_HEADER]:
        corners, left_out = _text_stl(path, plain), []
    else:
        if rest < 0:
            raise DataError(
                f"{path} is cut short: it holds less than its header announces; copy it again."
            )
        if rest >= FACET.itemsize and data[-rest:].strip(b"\0\r\n "):
            raise ValueError(f"it goes on after the {count} triangles that it announces")
        facets = np.frombuffer(data, FACET, count, _HEADER)
        corners = facets["corners"].reshape(-1, 3).astype(np.float64)
        left_out = ["attributes of faces"] if facets["attribute"].any() else []
    if len(corners) == 0:
        raise nothing_in(path)
    faces = np.arange(len(corners)).reshape(-1, 3)
    return Surface(corners, faces, str(path), {}, None, text.stated_space(data), tuple(left_out))


def _text_stl(path: Path, data: bytes) -> np.ndarray:
    """Corners (3 F, 3) of all solids; what stands between them is left out."""
    corners: list[list[bytes]] = []
    solid, facets = False, 0
    if _SAME_LINE.search(data[:1000]):  # it has its line ends elsewhere
        data = _STL_WORDS.sub(b"\n", data)
    for line in data.splitlines():
        word, *values = line.split() or [b""]
        word = word.lower()
        if word == b"vertex" and solid:
            corners.append(values[:3])
        elif word in (b"solid", b"endsolid"):
            solid = word == b"solid"
        elif word == b"endfacet":
            facets += 1
            if len(corners) != 3 * facets:
                raise ValueError("a facet has not 3 vertices")
        elif solid and word not in (b"", b"facet", b"outer", b"endloop", b"color"):
            raise ValueError(f"a line begins with {word.decode('utf-8', 'replace')!r}")
    if solid or len(corners) != 3 * facets:
        raise DataError(f"{path} is cut short: its last solid does not end; copy it again.")
    return np.array(corners, dtype=np.float64).reshape(-1, 3)
