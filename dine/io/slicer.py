"""Points that were placed in 3D Slicer: .fcsv of versions 3 to 5 and .mrk.json of version 5."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

import numpy as np

from dine.errors import DataError
from dine.geometry.surface import Surface
from dine.io import text
from dine.io.clouds import numbers

# Up to version 4.5 of Slicer spaces had numbers.
_SPACES = {"LPS": "LPS", "RAS": "RAS", "0": "RAS", "1": "LPS"}


def in_space(surface: Surface, space: str | None) -> np.ndarray:
    """Vertices (V, 3) in another patient space; as they are where either is not stated."""
    if space is None or surface.space in (None, space):
        return surface.vertices
    return surface.vertices * [-1.0, -1.0, 1.0]


def read_fcsv(path: Path, data: bytes) -> Surface:
    """Points in the order of the file, in the space that it states."""
    space, names, rows = None, ["id", "x", "y", "z"], []
    for line in text.decoded(data).splitlines():
        key, equals, value = line.lstrip("# ").partition("=")
        if not line.startswith("#"):
            rows.append(line)
        elif key.startswith("Fiducial List file"):  # of version 3, which knows RAS alone
            space = "RAS"
        elif equals and key.strip() == "CoordinateSystem":
            space = _SPACES.get(value.strip(' ,\t"').upper())  # spreadsheets add commas
        elif equals and key.strip() == "columns":
            names = [name.strip() for name in value.split(",")]
    fields = [row for row in csv.reader(rows) if any(row)]
    if not fields:
        raise DataError(f"{path} holds no points; expected a list of landmarks.")
    if not {"x", "y", "z"} <= set(names) or any(len(row) < len(names[:4]) for row in fields):
        raise ValueError("its rows have not the columns x, y and z")
    axes = [names.index(axis) for axis in "xyz"]
    points = numbers(path, [[row[axis] for axis in axes] for row in fields])
    return Surface(points, name=str(path), space=_stated(path, space))


def read_mrk(path: Path, data: bytes) -> Surface:
    """Points of all lists in the file, in the space that it states.

    Raises:
        DataError: a point has no position yet, or lists are of different spaces.
    """
    content = json.loads(data)
    lists = content.get("markups") if isinstance(content, dict) else None
    if not isinstance(lists, list):
        raise ValueError("it has no list of markups")
    spaces = {_SPACES.get(str(markups.get("coordinateSystem")).upper()) for markups in lists}
    if len(spaces) > 1:
        raise DataError(f"{path} holds lists of different coordinate systems; save one at a time.")
    points = [_position(path, point) for part in lists for point in part.get("controlPoints", ())]
    if not points:
        raise DataError(f"{path} holds no points; expected a list of landmarks.")
    return Surface(np.array(points), name=str(path), space=_stated(path, *spaces))


def _position(path: Path, point: dict[str, Any]) -> list[float]:
    position = point.get("position")
    if point.get("positionStatus", "defined") != "defined" or not position:
        raise DataError(
            f"{path}: the point {point.get('label', '')!r} has no position; place or delete it."
        )
    if isinstance(position, str):
        position = position.replace(",", " ").split()
    if not isinstance(position, list) or len(position) != 3:
        raise ValueError(f"the position of {point.get('label', '')!r} is not of three numbers")
    return [float(x) for x in position]


def _stated(path: Path, space: str | None) -> str:
    if space is None:
        raise DataError(
            f"{path} does not say whether it is in LPS or RAS; save it again in Slicer."
        )
    return space
