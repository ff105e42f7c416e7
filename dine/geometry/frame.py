"""The normalised frame: the source has its middle at the origin and unit radius."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dine.errors import DataError


@dataclass(frozen=True)
class Frame:
    """original = normalised · scale + center.

    Attributes:
        center: (3,) mean of the source's points, in their units.
        scale: largest distance of one from the center, same units.
    """

    center: np.ndarray
    scale: float

    @classmethod
    def of(cls, points: np.ndarray, name: str = "the source") -> Frame:
        """The frame of (N, 3) points; ``name`` is for the message.

        Raises:
            DataError: all points coincide.
        """
        center = points.mean(axis=0)
        scale = float(np.linalg.norm(points - center, axis=1).max())
        if not scale > 0:
            raise DataError(f"All points of {name} coincide; expected the surface of an object.")
        return cls(center, scale)

    def normalise(self, points: np.ndarray) -> np.ndarray:
        """(N, 3) points of the original units in the frame."""
        return (points - self.center) / self.scale

    def restore(self, points: np.ndarray) -> np.ndarray:
        """(N, 3) points of the frame in the original units."""
        return points * self.scale + self.center
