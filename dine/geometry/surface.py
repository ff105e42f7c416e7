"""The one in-memory form of anything scanned or simulated: a triangle mesh or a point cloud."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from dine.errors import DataError

# What so many faces take stays in cache.
_ROWS = 16384


@dataclass(frozen=True)
class Surface:
    """A triangle mesh, or a point cloud when ``faces`` is None.

    Attributes:
        vertices: (V, 3) float64, in the units of the file.
        faces: (F, 3) int64 vertex indices, or None for a cloud.
        name: where it came from, for messages.
        data: what else is known of every vertex, by name: arrays of V rows. Vertex colours are
            ``colors``, (V, 3) or (V, 4) uint8. Values are carried along as they are.
        texture: (F, 3, 2) texture coordinates of every corner of every face, or None.
        space: ``LPS`` or ``RAS`` where the file states its patient coordinates.
        left_out: what the file holds beside that and is not here, in words for a message.

    Raises:
        DataError: empty, wrong shape, not finite, faces that point outside the vertices, or data of
            another number of rows.
    """

    vertices: np.ndarray
    faces: np.ndarray | None = None
    name: str = "surface"
    data: Mapping[str, np.ndarray] = field(default_factory=dict)
    texture: np.ndarray | None = None
    space: str | None = None
    left_out: tuple[str, ...] = ()

    def __post_init__(self):
        vertices = self._numbers("vertices", np.float64)
        if vertices.ndim != 2 or vertices.shape[1] != 3:
            raise DataError(
                f"{self.name}: expected vertices of shape (V, 3), found {vertices.shape}."
            )
        if len(vertices) == 0:
            raise DataError(f"{self.name} holds no vertices; expected a mesh or a point cloud.")
        if not np.isfinite(vertices).all():
            bad = ~np.isfinite(vertices).all(axis=1)
            raise DataError(
                f"{self.name}: {bad.sum()} of {len(vertices)} vertices are NaN or infinite "
                f"(first at index {int(bad.argmax())}); repair or remove the file."
            )
        object.__setattr__(self, "vertices", vertices)
        for name, values in self.data.items():
            if len(values) != len(vertices):
                raise DataError(
                    f"{self.name}: {len(values)} values of {name!r} do not fit {len(vertices)} "
                    "vertices; expected one for each."
                )
        self._check_faces()

    def _check_faces(self):
        if self.faces is None:
            return
        vertices = self.vertices
        faces = self._numbers("faces", np.int64)
        if faces.size == 0:
            object.__setattr__(self, "faces", None)
            return
        if faces.ndim != 2 or faces.shape[1] != 3:
            raise DataError(f"{self.name}: expected faces of shape (F, 3), found {faces.shape}.")
        if faces.min() < 0 or faces.max() >= len(vertices):
            wrong = faces.min() if faces.min() < 0 else faces.max()
            raise DataError(
                f"{self.name}: a face names vertex {int(wrong)}, but there are only "
                f"{len(vertices)} vertices (indices start at 0)."
            )
        object.__setattr__(self, "faces", faces)

    def __repr__(self) -> str:
        faces = "" if self.faces is None else f", {len(self.faces)} faces"
        return f"<Surface {self.name}: {len(self.vertices)} vertices{faces}>"

    @cached_property
    def used(self) -> np.ndarray:
        """Mask (V,) of the vertices that the object consists of: of a mesh those of its faces."""
        if self.faces is None:
            return np.ones(len(self.vertices), dtype=bool)
        return np.bincount(self.faces.reshape(-1), minlength=len(self.vertices)) > 0

    @cached_property
    def area_reach(self) -> np.ndarray:
        """(F,) twice the area of the faces up to each, where the longest side of the object is 1.

        Found once: what is drawn by area is drawn several times.
        """
        used = self.vertices[self.used]
        low = used.min(axis=0)
        # Unit size keeps areas of objects in nanometres, or in light years, within float64.
        size = np.ptp(used, axis=0).max()
        # Whole columns: rows of three numbers take NumPy three times as long.
        columns = np.ascontiguousarray(((self.vertices - low) / (size or 1.0)).T)
        areas = np.empty(len(self.faces))
        for start in range(0, len(areas), _ROWS):
            some = slice(start, start + _ROWS)
            first, *others = (columns[:, corner] for corner in self.faces[some].T.copy())
            (a, b, c), (d, e, f) = (other - first for other in others)
            squared = (b * f - c * e) ** 2 + (c * d - a * f) ** 2 + (a * e - b * d) ** 2
            np.sqrt(squared, out=areas[some])
        return np.cumsum(areas, out=areas)

    @cached_property
    def rim(self) -> np.ndarray:
        """(B, 2) vertices of the edges where a mesh ends; no edges of a cloud."""
        if self.faces is None:
            return np.zeros((0, 2), np.int64)
        return rim_edges(self.faces, len(self.vertices))

    def similar(self, vertices: np.ndarray) -> Surface:
        """The same with its vertices (V, 3) moved by a similarity, which keeps ratios of areas."""
        other = replace(self, vertices=vertices)
        if self.faces is not None:
            # Frozen, but for what is found once.
            for name in ("used", "area_reach", "rim"):
                other.__dict__[name] = getattr(self, name)
        return other

    def _numbers(self, name: str, dtype: type) -> np.ndarray:
        try:
            return np.asarray(getattr(self, name), dtype=dtype)
        except (TypeError, ValueError, OverflowError) as error:
            raise DataError(f"{self.name}: the {name} are no array of numbers ({error}).") from None


def rim_edges(faces: np.ndarray, count: int) -> np.ndarray:
    """(B, 2) vertices, of ``count``, of the edges that only one of the faces (F, 3) has."""
    corners = faces.T.copy()
    ends = corners, np.roll(corners, -1, axis=0)
    key = (np.minimum(*ends) * count + np.maximum(*ends)).ravel()
    key.sort()
    # Edges of several faces follow each other.
    other = np.ones(len(key) + 1, bool)
    other[1:-1] = key[1:] != key[:-1]
    return np.column_stack(np.divmod(key[other[1:] & other[:-1]], count))
