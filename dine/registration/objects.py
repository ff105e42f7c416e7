"""Scans as objects of other packages, told by what they have; none of these is imported."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from dine.errors import DataError
from dine.geometry.surface import Surface

_EXPECTED = (
    "expected a file, (V, 3) points, a pair of vertices and faces, or a mesh or cloud of trimesh, "
    "Open3D, PyVista or meshio"
)


def is_object(shape: Any) -> bool:
    """Whether something has vertices or points, rather than being an array of them."""
    return any(hasattr(shape, name) for name in ("vertices", "points", "to_legacy"))


def array_of(values: Any) -> np.ndarray:
    """An array, or a tensor of PyTorch on any device, as a NumPy array."""
    if hasattr(values, "detach"):
        values = values.detach().cpu()
        values = values.double() if values.is_floating_point() else values
    return np.asarray(values)


def surface_of(shape: Any, name: str) -> Surface:
    """A mesh or cloud of trimesh, Open3D, PyVista or meshio, or an array, as a surface.

    Raises:
        DataError: something else, or cells that are no triangles, polygons or strips.
    """
    if hasattr(shape, "to_legacy"):  # Open3D's tensor geometries
        shape = shape.to_legacy()
    try:
        if not is_object(shape):
            values = array_of(shape)
            if values.dtype.kind not in "fiub":
                raise TypeError("no array of numbers")
            return Surface(values, name=name)
        points = getattr(shape, "vertices", None)
        points = shape.points if points is None else points
        return Surface(array_of(points), _faces(shape, name), name=name)
    except (TypeError, ValueError) as error:
        kind = f"{type(shape).__module__}.{type(shape).__qualname__}"
        raise DataError(f"{name} is of the type {kind} ({error}); {_EXPECTED}.") from error


def _faces(shape: Any, name: str) -> np.ndarray | None:
    """Triangles (F, 3); None of a cloud."""
    from dine.io import polygons  # of objects alone

    found = []
    if isinstance(getattr(shape, "cells_dict", None), Mapping):  # meshio, PyVista's grids
        kinds = {str(kind): array_of(cells) for kind, cells in shape.cells_dict.items()}
        found = [_cut(kinds.pop(kind)) for kind in ("triangle", "5", "quad", "9") if kind in kinds]
        if not found and kinds.keys() - {"vertex", "1"}:
            raise DataError(
                f"{name} has cells of the kinds {', '.join(kinds)} and no triangles; extract its "
                "surface and triangulate it."
            )
        return np.concatenate(found) if found else None
    for attribute, cut in (
        ("triangles", polygons.fans),
        ("faces", polygons.fans),
        ("strips", polygons.strips),
    ):
        cells = array_of(getattr(shape, attribute, ()))
        # The triangles of trimesh are not indices, but places.
        if cells.dtype.kind in "iu" and cells.size:
            if cells.ndim == 1:  # as VTK lists them
                cells, ends = polygons.counted(cells)
                cells = cells[cut(ends)]
            found.append(cells)
    if not found and np.size(getattr(shape, "tetras", ())):
        raise DataError(f"{name} holds tetrahedra; extract its surface as triangles.")
    return np.concatenate(found) if found else None


def _cut(cells: np.ndarray) -> np.ndarray:
    """Triangles (F, 3) of cells (C, k), all of k corners."""
    from dine.io import polygons

    ends = cells.shape[1] * np.arange(1, len(cells) + 1)
    return cells.reshape(-1)[polygons.fans(ends)]
