"""The one in-memory form of anything scanned or simulated: a triangle mesh or a point cloud."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dine.errors import DataError


@dataclass(frozen=True)
class Surface:
    """A triangle mesh, or a point cloud when ``faces`` is None.

    Attributes:
        vertices: (V, 3) float64, in the units of the file.
        faces: (F, 3) int64 vertex indices, or None for a cloud.
        name: where it came from, for messages.

    Raises:
        DataError: empty, wrong shape, not finite, or faces that point outside the vertices.
    """

    vertices: np.ndarray
    faces: np.ndarray | None = None
    name: str = "surface"

    def __post_init__(self):
        vertices = self._numbers("vertices", np.float64)
        if vertices.ndim != 2 or vertices.shape[1] != 3:
            raise DataError(
                f"{self.name}: expected vertices of shape (V, 3), found {vertices.shape}."
            )
        if len(vertices) == 0:
            raise DataError(f"{self.name} holds no vertices; expected a mesh or a point cloud.")
        bad = ~np.isfinite(vertices).all(axis=1)
        if bad.any():
            raise DataError(
                f"{self.name}: {bad.sum()} of {len(vertices)} vertices are NaN or infinite "
                f"(first at index {int(bad.argmax())}); repair or remove the file."
            )
        object.__setattr__(self, "vertices", vertices)
        if self.faces is None:
            return
        faces = self._numbers("faces", np.int64)
        if faces.size == 0:
            object.__setattr__(self, "faces", None)
            return
        if faces.ndim != 2 or faces.shape[1] != 3:
            raise DataError(f"{self.name}: expected faces of shape (F, 3), found {faces.shape}.")
        if faces.min() < 0 or faces.max() >= len(vertices):
            raise DataError(
                f"{self.name}: a face names vertex {int(faces.max())}, but there are only "
                f"{len(vertices)} vertices (indices start at 0)."
            )
        object.__setattr__(self, "faces", faces)

    def _numbers(self, name: str, dtype: type) -> np.ndarray:
        try:
            return np.asarray(getattr(self, name), dtype=dtype)
        except (TypeError, ValueError, OverflowError) as error:
            raise DataError(f"{self.name}: the {name} are no array of numbers ({error}).") from None
