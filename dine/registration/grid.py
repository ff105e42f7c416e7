"""The displacement of a registration on a grid, which 3D Slicer and ITK apply.

A displacement field of ITK gives, at each of its places, where to go on from there. The one from
source to target moves points and meshes of the source. To bring an *image* of the source onto the
target, ITK asks for every voxel of the output where it comes from: that is the inverse, from target
to source. Files are in LPS (x to the left, y to the back, z to the head), as ITK and Slicer expect.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from dine.errors import ConfigError
from dine.geometry.lattice import Lattice
from dine.geometry.surface import Surface
from dine.io.images import IMAGE_SUFFIXES, write_vectors
from dine.io.writers import check_output
from dine.progress import stage

if TYPE_CHECKING:
    from dine.registration.types import Motion, RegistrationResult

# Where the search for the inverse ends: how far off it is, in radii of the source, and how often
# it is improved.
_NEAR_ENOUGH = 1e-4
_ROUNDS = 60
# Places at a time.
_ROWS = 100_000
_FROM_RAS = np.array([-1.0, -1.0, 1.0])


@dataclass(frozen=True)
class DisplacementGrid:
    """A displacement on a lattice; all in LPS and in the units of the source.

    Attributes:
        lattice: where the voxels are.
        displacement: (nx, ny, nz, 3) from there to where the registration moves the place to, or
            came from.
        unknown: share of the voxels of an inverse that nothing was found to be moved to, as where
            the field folds; they hold what comes nearest.
    """

    lattice: Lattice
    displacement: np.ndarray
    unknown: float = 0.0

    def write(self, path: str | Path, *, overwrite: bool = False) -> None:
        """Write it as an image of vectors (``.nrrd`` or ``.mha``).

        Raises:
            DataError: another suffix.
            StorageError: a file is there already, or the folder cannot be written.
        """
        write_vectors(Path(path), self.lattice, self.displacement, overwrite=overwrite)


def displacement_grid(
    result: RegistrationResult,
    spacing: float | None = None,
    *,
    margin: float | None = None,
    inverse: bool = False,
    space: str | None = None,
) -> DisplacementGrid:
    """What ``result.transform`` does, on a grid; see
    :meth:`~dine.registration.types.RegistrationResult.displacement_grid`."""
    flip = _flip(result.source, space)
    shape = result.moved if inverse else result.source
    lattice = _around(shape, flip, spacing, margin)
    places = lattice.places() * flip
    moved, unknown = np.empty_like(places), 0
    for rows in _chunks(len(places)):
        if inverse:
            moved[rows], known = came_from(result.motion, places[rows])
            unknown += int((~known).sum())
        else:
            moved[rows] = result.motion(places[rows])
    displacement = ((moved - places) * flip).reshape(*lattice.shape, 3)
    return DisplacementGrid(lattice, displacement, unknown / len(places))


def came_from(motion: Motion, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where points (M, 3) of the target's coordinates were before a motion: the inverse.

    What is still missing of the way is added to the place, less of it where that overshoots. Where
    neighbourhoods are turned inside out there may be several places, of which one is found, or
    none.

    Returns:
        (M, 3) places in the source's coordinates, and a mask (M,) of those that the motion moves to
        the points, within 1e-4 of the source's radius.
    """
    goal = motion.alignment.frame.normalise(points)
    found = goal - motion.field(goal)
    missing = goal - found - motion.field(found)
    far = np.linalg.norm(missing, axis=1)
    share = np.ones(len(goal))
    for _ in range(_ROUNDS):
        rows = np.flatnonzero(far > _NEAR_ENOUGH)
        if len(rows) == 0:
            break
        tried = found[rows] + share[rows, None] * missing[rows]
        left = goal[rows] - tried - motion.field(tried)
        distance = np.linalg.norm(left, axis=1)
        better = distance < far[rows]
        share[rows[~better]] /= 2
        rows = rows[better]
        found[rows], missing[rows], far[rows] = tried[better], left[better], distance[better]
    places = motion.alignment.unalign(motion.alignment.frame.restore(found))
    return places, far <= _NEAR_ENOUGH


@dataclass(frozen=True)
class GridFiles:
    """Grids that are to be written, and how.

    Attributes:
        forward: file of the one from source to target, or None.
        inverse: file of the one from target to source, or None.
        spacing: as for :meth:`~dine.registration.types.RegistrationResult.displacement_grid`.
        margin: likewise.
        space: likewise.
    """

    forward: Path | None = None
    inverse: Path | None = None
    spacing: float | None = None
    margin: float | None = None
    space: str | None = None

    @property
    def files(self) -> dict[str, Path]:
        """By what they hold."""
        named = {"grid": self.forward, "grid_inverse": self.inverse}
        return {name: path for name, path in named.items() if path is not None}

    def check(self, source: Surface, *, overwrite: bool) -> None:
        """Refuse what could not be made of a source, before anything is computed.

        Raises:
            ConfigError: settings of no grid, of too many voxels, or another space than the source
                states.
            DataError: a suffix that is not written.
            StorageError: a file is there already.
        """
        if not self.files:
            if (self.spacing, self.margin, self.space) != (None, None, None):
                raise ConfigError(
                    "Spacing, margin and space are those of a grid, which is not asked for; name "
                    "its file (--grid)."
                )
            return
        if self.forward == self.inverse:
            raise ConfigError(f"Both grids would be written to {self.forward}; name another file.")
        for path in self.files.values():
            check_output(path, IMAGE_SUFFIXES, overwrite=overwrite)
        _around(source, _flip(source, self.space), self.spacing, self.margin)

    def write(self, result: RegistrationResult, *, overwrite: bool) -> list[str]:
        """Make and write them; sentences on what there is to say."""
        said = []
        for name, path in self.files.items():
            stage("grid")
            grid = displacement_grid(
                result,
                self.spacing,
                margin=self.margin,
                inverse=name == "grid_inverse",
                space=self.space,
            )
            grid.write(path, overwrite=overwrite)
            if grid.unknown:
                said.append(
                    f"{path.name}: nothing is moved to {100 * grid.unknown:.2g} % of the voxels, "
                    "as where the field folds; they hold what comes nearest."
                )
        return said


def _around(
    surface: Surface, flip: np.ndarray, spacing: float | None, margin: float | None
) -> Lattice:
    return Lattice.around(surface.vertices[surface.used] * flip, spacing, margin)


def _flip(source: Surface, space: str | None) -> np.ndarray:
    """(3,) factors from the coordinates of the files to LPS.

    Raises:
        ConfigError: no such space, or another one than the source states.
    """
    named = None if space is None else space.upper()
    if named not in (None, "LPS", "RAS"):
        raise ConfigError(f"The space is {space!r}; expected lps or ras.")
    if None not in (named, source.space) and named != source.space:
        raise ConfigError(
            f"{source.name} states that it is in {source.space}, not in {named}; leave out the "
            "space."
        )
    return _FROM_RAS if (named or source.space) == "RAS" else np.ones(3)


def _chunks(count: int) -> Iterator[slice]:
    return (slice(first, first + _ROWS) for first in range(0, count, _ROWS))
