"""One HTML file that shows a registration in three dimensions, in any browser, without a network.

It holds its data as base64 and three.js as text (``three.min.js``; see ``three.entry.js`` for how
that was made). A content security policy in the page forbids it to load anything.
"""

from __future__ import annotations

import base64
import json
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from importlib import resources
from typing import Any

import jinja2
import numpy as np
from markupsafe import Markup
from scipy.spatial import cKDTree

from dine.errors import DataError
from dine.files import write_text
from dine.geometry.surface import Surface
from dine.io.writers import check_output
from dine.viewer.sides import axis_names, first_side, sides

#: Suffixes that ``write_view`` writes.
VIEW_SUFFIXES: tuple[str, ...] = (".html", ".htm")

# matplotlib's viridis in 64 steps, for which nobody has to install it.
_COLORS = """
    440154 46075a 470d60 471365 48186a 481d6f 482374 482878 472d7b 46327e 453781 443b84
    424086 404588 3e4989 3d4e8a 3a538b 38588c 365c8d 34608d 32648e 31688e 2f6c8e 2d708e
    2c738e 2a778e 297b8e 277f8e 26828e 24868e 238a8d 218e8d 20928c 1f968b 1f9a8a 1f9e89
    1fa187 21a585 23a983 26ad81 2ab07f 2fb47c 35b779 3bbb75 42be71 4ac16d 52c569 5ac864
    65cb5e 6ece58 77d153 81d34d 8bd646 95d840 a0da39 aadc32 b5de2b c0df25 cae11f d5e21a
    dfe318 eae51a f4e61e fde725
"""
# Values above this share of all are drawn in the last colour if they would stretch the scale.
_SHOWN = 0.99
_STRETCH = 1.5
# Of each shape: more make files that browsers open slowly, and nothing that a screen shows.
_MOST = 100_000
# Faces of a target whose mesh is shown at first: of more, its lines would hide what is behind.
_SPARSE = 8_000
# Of further shapes, in turn; and how opaque the moved source is at first where they may lie in it.
_FURTHER_COLORS = ("#b3261e", "#2e7d32", "#7b3fa0", "#8a6d00", "#00727f")
_GLASS = 45


@dataclass(frozen=True)
class View:
    """What a page shows.

    Attributes:
        source: the unmoved source, V vertices.
        target: what it was registered to, in the same frame and units.
        result: (V, 3) moved source vertices, in their order.
        title: heading of the page, in plain text.
        scalars: (V,) numbers on the source vertices by displayed name, such as "distance to
            target"; NaN where there is none. The first one is shown at first.
        units: displayed unit by name of a scalar.
        facts: displayed values by name, in plain text.
        unit: displayed unit of coordinates, such as "mm"; empty where there is none to name.
        verdict: one word on how far to trust the result; empty where nothing is said.
        reasons: sentences for it.
        explained: a sentence on what a scalar, a fact or the verdict means, by its name.
        further: shapes that moved with the source, such as a tumour, by displayed name: each
            unmoved, of M vertices, and its (M, 3) moved vertices.
    """

    source: Surface
    target: Surface
    result: np.ndarray
    title: str
    scalars: Mapping[str, np.ndarray] = field(default_factory=dict)
    units: Mapping[str, str] = field(default_factory=dict)
    facts: Mapping[str, Any] = field(default_factory=dict)
    unit: str = ""
    verdict: str = ""
    reasons: Sequence[str] = ()
    explained: Mapping[str, str] = field(default_factory=dict)
    further: Mapping[str, tuple[Surface, np.ndarray]] = field(default_factory=dict)


def write_view(path: str | os.PathLike, view: View, *, overwrite: bool = False) -> None:
    """Write a page to turn, overlay, colour and animate source, target and moved source.

    Shapes with faces are drawn as surfaces, clouds as points. Coordinates keep float32 precision
    about the middle of all shapes. Two meshes of 20,000 vertices and three scalars take 2.5 MB;
    0.6 MB of it is the viewer, the rest grows with their number, up to 13 MB: of larger shapes
    about 100,000 vertices are drawn, meshes simplified (fast-simplification) and clouds thinned
    out, and the page says so. Drawn vertices keep their places and numbers.

    Args:
        path: the .html file.
        view: what it shows.
        overwrite: replace a file that is there already.

    Raises:
        DataError: another suffix, or arrays that do not fit the source.
        StorageError: a file is there already, the disk is full or the folder cannot be written.
    """
    check_output(path, VIEW_SUFFIXES, overwrite=overwrite)
    result = Surface(view.result, name="The result").vertices
    if result.shape != view.source.vertices.shape:
        raise DataError(
            f"A result of {len(result)} points does not fit a source of "
            f"{len(view.source.vertices)}; expected one row a vertex, in the same order."
        )
    data = _data(view, result)
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("dine.viewer", ""),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    page = environment.get_template("view.html").render(
        view=view,
        layers=data["layers"],
        sides=data["sides"],
        data=_embedded(data),
        licence=Markup(_resource("three.LICENSE.txt")),
        library=Markup(_resource("three.min.js")),
        program=Markup(_resource("view.js")),
    )
    write_text(path, page)


def _data(view: View, result: np.ndarray) -> dict[str, Any]:
    """What the page's program reads."""
    source, target = view.source, view.target
    small, rows = _light(source)
    small_target, target_rows = _light(target)
    # Surfaces that cross each other look like a fault: the target's starts as lines, or hidden.
    sparse = small_target.faces is None or len(small_target.faces) <= _SPARSE
    layers = [
        _layer("moved", "Moved source", source, rows, "#3f7fc4", opacity=100, shown=True),
        _layer("target", "Target", target, target_rows, "#4a5562", opacity=50, shown=sparse),
        _layer("source", "Source", source, rows, "#d08a3c", opacity=60, shown=False),
    ]
    if view.further:
        layers[0]["opacity"] = _GLASS
    for layer in layers:
        drawn = small_target if layer["id"] == "target" else small
        layer["mesh"] = drawn.faces is not None
        layer["lines"] = layer["mesh"] and layer["id"] != "moved"
    shown = [
        _scalar(name, values, source, rows, view.units.get(name, ""))
        | {"explained": view.explained.get(name, "")}
        for name, values in view.scalars.items()
    ]
    # Vertices that no face uses are not drawn, wherever they lie.
    every = np.concatenate(
        [source.vertices[source.used], target.vertices[target.used], result[source.used]]
    )
    centre = (every.min(axis=0) + every.max(axis=0)) / 2
    radius = float(np.linalg.norm(every - centre, axis=1).max()) or 1.0

    def normalised(vertices: np.ndarray) -> np.ndarray:
        return (vertices - centre) / radius

    further = [_further(i, *x, normalised) for i, x in enumerate(view.further.items())]
    return {
        "centre": centre.tolist(),
        "radius": radius,
        "source": _shape(small, normalised)
        | {"rows": None if len(small.vertices) == len(result) else _array(rows, "uint32")},
        "target": _shape(small_target, normalised),
        "result": _array(normalised(result[rows]), "float32"),
        "scalars": shown,
        "layers": layers + [layer for layer, _ in further],
        "further": {layer["id"]: shape for layer, shape in further},
        "colormap": _colors(),
        "unit": view.unit,
        "axes": axis_names(target.space),
        "sides": sides(target.space),
        "view": first_side(Surface(result, source.faces), target.space),
    }


def _light(surface: Surface) -> tuple[Surface, np.ndarray]:
    """A surface of few enough vertices to draw, and which of the original ones (n,) these are."""
    count = len(surface.vertices)
    if count <= _MOST:
        return surface, np.arange(count)
    if surface.faces is not None:
        simplified = _simplified(surface)
        if simplified is not None:
            return simplified
    rows = np.sort(np.random.default_rng(0).permutation(count)[:_MOST])
    return Surface(surface.vertices[rows], name=surface.name), rows


def _simplified(surface: Surface) -> tuple[Surface, np.ndarray] | None:
    """None where the mesh falls into so many parts that it cannot be simplified."""
    import fast_simplification

    # Vertices of one place, as in STL files, would keep triangles apart.
    places, corners = np.unique(surface.vertices, axis=0, return_inverse=True)
    faces = np.ascontiguousarray(corners.reshape(-1)[surface.faces])
    fewer, faces = fast_simplification.simplify(places, faces, target_count=2 * _MOST)
    # Nearest original vertices, whose values are known, in place of those that were made.
    _, rows = cKDTree(surface.vertices).query(fewer)
    rows, faces = np.unique(rows[faces], return_inverse=True)
    faces = faces.reshape(-1, 3)
    faces = faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]
    if len(faces) == 0 or len(rows) > 1.5 * _MOST:
        return None
    return Surface(surface.vertices[rows], faces, name=surface.name), rows


def _layer(
    key: str,
    name: str,
    surface: Surface,
    rows: np.ndarray,
    color: str,
    *,
    opacity: int,
    shown: bool,
) -> dict[str, Any]:
    size = f"{len(surface.vertices):,} {'points' if surface.faces is None else 'vertices'}"
    if len(rows) < len(surface.vertices):
        size += f", {len(rows):,} of them drawn"
    return {
        "id": key,
        "name": name,
        "size": size,
        "color": color,
        "opacity": opacity,
        "shown": shown,
    }


def _further(
    number: int,
    name: str,
    shape: tuple[Surface, np.ndarray],
    normalised: Callable[[np.ndarray], np.ndarray],
) -> tuple[dict[str, Any], dict[str, Any]]:
    """The layer of a further shape, and its geometry before and after."""
    surface, moved = shape
    if moved.shape != surface.vertices.shape:
        raise DataError(
            f"{name!r} has {len(surface.vertices)} vertices but {len(moved)} moved ones; expected "
            "one row a vertex, in the same order."
        )
    small, rows = _light(surface)
    color = _FURTHER_COLORS[number % len(_FURTHER_COLORS)]
    layer = _layer(f"further-{number}", name, surface, rows, color, opacity=100, shown=True)
    layer |= {"mesh": small.faces is not None, "lines": False}
    return layer, _shape(small, normalised) | {
        "result": _array(normalised(moved[rows]), "float32"),
    }


def _scalar(
    name: str, values: np.ndarray, source: Surface, rows: np.ndarray, unit: str
) -> dict[str, Any]:
    """A scalar with its colours' range, how many values that leaves out, mean and largest."""
    values, count = np.asarray(values, dtype=np.float64), len(source.vertices)
    if values.shape != (count,):
        raise DataError(
            f"The scalar {name!r} has the shape {values.shape}; expected one number for each of "
            f"{count} source vertices."
        )
    drawn = values[source.used]
    known = drawn[np.isfinite(drawn)]
    low, high, over = 0.0, 1.0, 0
    mean = largest = None
    if known.size:
        low, high = float(known.min()), float(known.max())
        mean, largest = float(known.mean()), high
        usual = float(np.quantile(known, _SHOWN))
        if high - low > _STRETCH * (usual - low) > 0:
            high, over = usual, int((known > usual).sum())
        if 0 < low < high / 2 or low == high > 0:  # lengths and errors read best from zero
            low = 0.0
        if low == high:
            high = low + 1.0
    return {
        "name": name,
        "unit": unit,
        "low": low,
        "high": high,
        "over": over,
        "mean": mean,
        "largest": largest,
        "missing": int(drawn.size - known.size),
        "values": _array(np.where(np.isfinite(values), values, np.nan)[rows], "float32"),
    }


def _shape(surface: Surface, normalised: Callable[[np.ndarray], np.ndarray]) -> dict[str, Any]:
    faces = surface.faces
    small = len(surface.vertices) <= 1 << 16
    return {
        "positions": _array(normalised(surface.vertices), "float32"),
        "faces": None if faces is None else _array(faces, "uint16" if small else "uint32"),
        "pointSize": float(np.clip(0.9 / np.sqrt(len(surface.vertices)), 0.004, 0.03)),
    }


def _array(array: np.ndarray, kind: str) -> dict[str, str]:
    stored = np.ascontiguousarray(array).astype(np.dtype(kind).newbyteorder("<"))
    return {"type": kind, "base64": base64.b64encode(stored.tobytes()).decode("ascii")}


def _colors() -> list[str]:
    return [f"#{color}" for color in _COLORS.split()]


def _embedded(data: dict[str, Any]) -> Markup:
    """JSON that cannot end the script element that holds it."""
    return Markup(json.dumps(data, allow_nan=False).replace("<", "\\u003c"))


def _resource(name: str) -> str:
    return (resources.files("dine.viewer") / name).read_text(encoding="utf-8")
