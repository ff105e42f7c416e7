"""Places at even distances around an object: the voxels of an image."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dine.errors import ConfigError, DataError

MOST_VOXELS = 5_000_000
# Of the longest side: what is added all around, and into how many voxels it is divided, where
# nothing else is asked for.
_MARGIN = 0.1
_ACROSS = 64


@dataclass(frozen=True)
class Lattice:
    """A box of voxels along the axes.

    Attributes:
        origin: (3,) the middle of the first voxel.
        spacing: distance of neighbours, the same along all axes.
        shape: numbers of voxels (nx, ny, nz).
    """

    origin: np.ndarray
    spacing: float
    shape: tuple[int, int, int]

    @classmethod
    def around(
        cls, points: np.ndarray, spacing: float | None = None, margin: float | None = None
    ) -> Lattice:
        """Around (N, 3) points, and ``margin`` farther on all sides.

        Args:
            points: of the object.
            spacing: by default a 64th of the longest side.
            margin: by default a tenth of the longest side of the points' box.

        Raises:
            DataError: all points coincide.
            ConfigError: a spacing or margin that is no such length, or too many voxels.
        """
        low, high = points.min(axis=0), points.max(axis=0)
        longest = float((high - low).max())
        if not longest > 0:
            raise DataError("All points coincide; expected an object that a grid can lie around.")
        margin = _MARGIN * longest if margin is None else margin
        if not 0 <= margin < np.inf:
            raise ConfigError(f"The margin of the grid is {margin}; expected a length, or 0.")
        size = high - low + 2 * margin
        spacing = float(size.max()) / _ACROSS if spacing is None else spacing
        if not 0 < spacing < np.inf:
            raise ConfigError(f"The spacing of the grid is {spacing}; expected a positive length.")
        counts = _counts(size, spacing)
        if counts.prod() > MOST_VOXELS:
            raise ConfigError(
                f"A spacing of {spacing:.4g} takes {' × '.join(f'{x:.0f}' for x in counts)} voxels "
                f"for a box of {' × '.join(f'{x:.4g}' for x in size)}, more than {MOST_VOXELS:,}; "
                f"choose a spacing of at least {_least(size):.3g}, or a smaller margin."
            )
        origin = (low + high) / 2 - (counts - 1) / 2 * spacing
        return cls(origin, spacing, tuple(int(x) for x in counts))

    def places(self) -> np.ndarray:
        """(nx · ny · nz, 3), the last axis fastest."""
        axes = [
            x + self.spacing * np.arange(n) for x, n in zip(self.origin, self.shape, strict=True)
        ]
        return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


def _counts(size: np.ndarray, spacing: float) -> np.ndarray:
    """(3,) voxels from end to end, as floats, since there may be far too many."""
    return np.maximum(np.ceil(size / spacing - 1e-9), 1) + 1


def _least(size: np.ndarray) -> float:
    """A spacing, not much larger than it must be, whose voxels are not too many."""
    spacing = float(np.cbrt(size.prod() / MOST_VOXELS)) or float(size.max()) / MOST_VOXELS
    while _counts(size, spacing).prod() > MOST_VOXELS:
        spacing *= 1.01
    return 1.005 * spacing  # room to be rounded
