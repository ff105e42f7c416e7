"""The inside of a closed mesh as cubes of a grid, and values at their corners at any place."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.sparse import csr_matrix
from scipy.spatial import cKDTree

from dine.errors import DataError
from dine.geometry.surface import Surface

if TYPE_CHECKING:
    import trimesh

# Cells of the finer grid along the edge of a cube, which its share of the inside is counted on.
_FINER = 4
# Share of the inside that lies within another part, from which a mesh crosses itself; and of the
# inside that must hang together.
_CROSSED = 0.02
_WHOLE = 0.99
# Grid lines pass by vertices at round numbers, which many meshes have.
_ASIDE = (0.3713, 0.2339, 0.4177)
# Cubes of a finer grid than this would not fit into memory.
_MOST_CELLS = 50_000_000
# The corners of a cube, in the order of their numbers.
CORNERS = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)])


@dataclass(frozen=True)
class Voxels:
    """Cubes that cover the inside and the surface of a closed mesh.

    Attributes:
        nodes: (n, 3) corners of the cubes.
        cubes: (E, 8) their numbers, in the order of ``CORNERS``.
        inside: (E,) share of each cube that lies inside, 0 to 1.
        edge: length of their edges, in the units of the nodes.
    """

    nodes: np.ndarray
    cubes: np.ndarray
    inside: np.ndarray
    edge: float

    def __post_init__(self):
        """Refuse what a damaged file may hold.

        Raises:
            ValueError: corners that are no grid, or one too large.
        """
        extent = np.ptp(self.nodes, axis=0) / self.edge
        if not (extent + 1).prod() <= _MOST_CELLS:
            raise ValueError(f"cubes of edge {self.edge} lie {extent.max()} edges apart")
        cells, _, shape = self.grid
        if not (cells < shape).all():
            raise ValueError("cubes lie outside the grid of their corners")

    @property
    def middles(self) -> np.ndarray:
        """(E, 3) middles of the cubes."""
        return self.nodes[self.cubes[:, 0]] + self.edge / 2

    @property
    def grid(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Cells (E, 3) of a grid that the cubes are, where it begins (3,) and its shape (3,)."""
        low = self.nodes.min(axis=0)
        first = self.nodes[self.cubes[:, 0]]
        shape = np.rint((self.nodes.max(axis=0) - low) / self.edge).astype(int)
        return np.rint((first - low) / self.edge).astype(int), low, shape

    def carried(self, places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Corners (M, 8) and their trilinear weights (M, 8) of places (M, 3).

        A place outside all cubes takes the nearest of the cube with the nearest middle.
        """
        cells, low, across = self.grid
        number = np.full(across, -1)
        number[tuple(cells.T)] = np.arange(len(cells))
        cell = np.clip(np.floor((places - low) / self.edge).astype(int), 0, across - 1)
        cube = number[tuple(cell.T)]
        outside = cube < 0
        if outside.any():
            cube[outside] = cKDTree(self.middles).query(places[outside])[1]
        local = np.clip((places - self.nodes[self.cubes[cube, 0]]) / self.edge, 0, 1)
        weights = np.ones((len(places), 8))
        for axis in range(3):
            share = local[:, axis, None]
            weights *= np.where(CORNERS[:, axis], share, 1 - share)
        return self.cubes[cube], weights

    def carrier(self, places: np.ndarray) -> csr_matrix:
        """(M, n) by which values at the nodes give those at places (M, 3), see :meth:`carried`."""
        index, weights = self.carried(places)
        rows = np.repeat(np.arange(len(index)), 8)
        shape = (len(index), len(self.nodes))
        return csr_matrix((weights.ravel(), (rows, index.ravel())), shape=shape)


@dataclass(frozen=True)
class NodeField:
    """A displacement known at the nodes of cubes, and between them.

    Outside the cubes it is that of the nearest place of one.

    Attributes:
        voxels: n nodes, as they were before a rotation about the origin.
        displacement: (n, 3) after it.
        rotation: (3, 3).
    """

    voxels: Voxels
    displacement: np.ndarray
    rotation: np.ndarray

    def __call__(self, places: np.ndarray) -> np.ndarray:
        """The displacement (M, 3) at places (M, 3), both after the rotation."""
        return self.voxels.carrier(places @ self.rotation) @ self.displacement


def closed_mesh(surface: Surface) -> trimesh.Trimesh:
    """A surface as a closed mesh whose faces look outwards; vertices at one place are merged.

    Raises:
        DataError: it has no inside.
    """
    import trimesh  # takes a while, and moving points by voxels needs none of it

    if surface.faces is None:
        raise DataError(f"{surface.name} is a cloud of points; expected a closed mesh.")
    mesh = trimesh.Trimesh(surface.vertices, surface.faces, process=True)
    if not mesh.is_watertight:
        edges = np.sort(mesh.edges, axis=1)
        times = np.unique(edges, axis=0, return_counts=True)[1]
        raise DataError(
            f"{surface.name} is not closed and so has no inside: {(times != 2).sum()} of its "
            f"{len(times)} edges do not have two faces; close its holes first."
        )
    trimesh.repair.fix_normals(mesh, multibody=False)
    return mesh


def voxelised(surface: Surface, edge: float) -> Voxels:
    """Cubes of this edge that cover a closed mesh and hang together by their faces.

    How much of a cube lies inside is counted on a grid four times as fine, whose cells are inside
    where the faces below them say so (winding numbers along lines).

    Raises:
        DataError: the mesh has no inside, crosses itself, or is in several parts that no cube
            joins.
        ValueError: an edge that is not positive.
    """
    import trimesh
    from scipy.ndimage import label

    if not edge > 0:
        raise ValueError(f"the edge of cubes is {edge}; expected a positive length")
    mesh = closed_mesh(surface)
    shape = np.ceil(np.ptp(mesh.vertices, axis=0) / edge).astype(int) + 2
    if np.prod(shape * _FINER, dtype=float) > _MOST_CELLS:
        raise DataError(
            f"{surface.name} would take {' × '.join(map(str, shape))} cubes; expected a larger "
            "edge."
        )
    low = np.asarray(mesh.bounds[0]) - edge + edge / _FINER * np.array(_ASIDE)
    share = _shares(mesh, low, edge, shape, surface.name)
    touched = np.zeros(shape, bool)
    dense, _ = trimesh.remesh.subdivide_to_size(mesh.vertices, mesh.faces, edge / 3, max_iter=30)
    touched[tuple(np.floor((dense - low) / edge).astype(int).T)] = True
    parts, count = label((share > 0) | touched)
    volume = np.bincount(parts.ravel(), share.ravel(), count + 1)
    volume[0] = 0
    largest = int(volume.argmax())
    if volume[largest] < _WHOLE * share.sum():
        raise DataError(
            f"{surface.name} is in {(volume > 0).sum()} parts that no cube of edge {edge:.3g} "
            "joins; expected one organ a file."
        )
    kept = parts == largest
    corners = (np.argwhere(kept)[:, None] + CORNERS).reshape(-1, 3)
    places, number = np.unique(corners, axis=0, return_inverse=True)
    return Voxels(low + edge * places, number.reshape(-1, 8), share[kept], edge)


def share_inside(voxels: Voxels, surface: Surface) -> np.ndarray:
    """Share (E,) of each cube that lies inside a closed mesh, such as one within the organ.

    Raises:
        DataError: as for :func:`voxelised`.
    """
    cell, low, shape = voxels.grid
    within = closed_mesh(surface)
    inside = ((within.vertices > low) & (within.vertices < low + voxels.edge * shape)).all()
    if not inside:
        raise DataError(f"{surface.name} does not lie within the organ; check its units and frame.")
    return _shares(within, low, voxels.edge, shape, surface.name)[tuple(cell.T)]


def _shares(
    mesh: trimesh.Trimesh, low: np.ndarray, edge: float, shape: np.ndarray, name: str
) -> np.ndarray:
    """Share of each cell of a grid that begins at ``low`` which lies inside a closed mesh."""
    finer = shape * _FINER
    winding = _winding(mesh.triangles - low, edge / _FINER, tuple(finer))
    filled = winding != 0
    if (np.abs(winding) > 1).sum() > _CROSSED * filled.sum() or not filled.any():
        raise DataError(
            f"{name} crosses itself, has one part within another, or is thinner than the grid, so "
            "that it is not clear what is inside; repair it first."
        )
    blocks = filled.reshape(np.stack([shape, np.full(3, _FINER)], axis=1).ravel())
    return blocks.mean(axis=(1, 3, 5))


def _winding(triangles: np.ndarray, step: float, shape: tuple[int, ...]) -> np.ndarray:
    """Winding numbers at the middles of the cells of a grid that begins at the origin.

    Every line of cells along z crosses some of the triangles (F, 3, 3); above each crossing the
    number changes by one, by the side from which the face is crossed.
    """
    xy = triangles[:, :, :2] / step - 0.5
    first = np.ceil(xy.min(axis=1)).astype(int)
    count = np.maximum(np.floor(xy.max(axis=1)).astype(int) - first + 1, 0)
    times = count.prod(axis=1)
    face = np.repeat(np.arange(len(triangles)), times)
    within = np.arange(times.sum()) - np.repeat(np.cumsum(times) - times, times)
    line = first[face] + np.column_stack(np.divmod(within, np.maximum(count[face, 1], 1)))
    a, b, c = (xy[face, corner] for corner in range(3))
    area = _cross(b - a, c - a)
    flat = area == 0
    area = np.where(flat, 1.0, area)
    shares = (
        np.column_stack([_cross(b - line, c - line), _cross(c - line, a - line)]) / area[:, None]
    )
    shares = np.column_stack([shares, 1 - shares.sum(axis=1)])
    hit = (shares > 0).all(axis=1) & ~flat
    height = np.einsum("nk,nk->n", shares[hit], triangles[face[hit], :, 2]) / step - 0.5
    above = np.clip(np.ceil(height).astype(int), 0, shape[2] - 1)
    change = np.zeros(shape, np.int32)
    # A face seen from above is that of something below it.
    np.add.at(change, (*line[hit].T, above), -np.sign(area[hit]).astype(np.int32))
    return change.cumsum(axis=2)


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
