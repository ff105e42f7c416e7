"""What is drawn for simulated deformations: what holds an organ, how stiff it is, what pulls at it.

Everything is drawn at places of the surface and not of a grid, so that equal numbers say the same
at any resolution. All lengths are in radii of the organ.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_matrix

from dine.config import Simulation
from dine.data.sampling import sample_surface
from dine.errors import ConfigError
from dine.geometry.surface import Surface
from dine.geometry.voxels import Voxels, closed_mesh
from dine.simulation.elasticity import SoftBody

# How far stiffness is alike, and the number of places that say how it varies.
_ALIKE, _PLACES = 0.5, 8
# Share of its stiffness that a cube keeps which a cut goes through. With none its corners, where
# several such cubes meet, would be held by nothing.
SEVERED = 0.01


@dataclass(frozen=True)
class Organ:
    """A closed mesh of radius 1 around the origin, and the cubes that cover it.

    Attributes:
        surface: of V vertices.
        voxels: E cubes with n nodes.
        carrier: (V, n) values at the vertices from those at the nodes.
        pressed: (F, n) the same for the middles of the closed mesh's faces.
        middles: (F, 3) of these.
        areas: (F, 3) their outward normals, as long as they are large.
    """

    surface: Surface
    voxels: Voxels
    carrier: csr_matrix
    pressed: csr_matrix
    middles: np.ndarray
    areas: np.ndarray

    @classmethod
    def of(cls, surface: Surface, voxels: Voxels) -> Organ:
        """That of a closed mesh."""
        corners = closed_mesh(surface).triangles
        middles = corners.mean(axis=1)
        areas = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) / 2
        carriers = (voxels.carrier(places) for places in (surface.vertices, middles))
        return cls(surface, voxels, *carriers, middles, areas)

    def place(self, rng: np.random.Generator) -> np.ndarray:
        """(3,) anywhere on the surface."""
        return sample_surface(self.surface, 1, rng).places(self.surface.vertices)[0]

    def nodes_at(self, vertices: np.ndarray) -> np.ndarray:
        """Mask (n,) of the corners of all cubes that hold some vertices, a mask (V,)."""
        found = np.zeros(len(self.voxels.nodes), bool)
        found[self.voxels.carried(self.surface.vertices[vertices])[0].ravel()] = True
        return found


def drawn_patches(
    organ: Organ, settings: Simulation, rng: np.random.Generator, about: np.ndarray | None
) -> np.ndarray:
    """Mask (V,) of the vertices in some round patches of the surface; in one with its middle at
    one of the vertices ``about``, a mask (V,), where these are given.

    Raises:
        ConfigError: nothing would be left to move.
    """
    vertices = organ.surface.vertices
    fixed = np.zeros(len(vertices), bool)
    if about is None:
        middles = [organ.place(rng) for _ in range(rng.integers(settings.patches) + 1)]
    else:
        middles = [vertices[rng.choice(np.flatnonzero(about))]]
    for middle in middles:
        distance = np.linalg.norm(vertices - middle, axis=1)
        fixed |= distance <= max(rng.uniform(*settings.patch), distance.min())
    if fixed.all():
        raise ConfigError(
            f"Patches of a radius up to {settings.patch[1]} fix all of the surface; lower `patch`."
        )
    return fixed


def drawn_body(
    organ: Organ,
    settings: Simulation,
    rng: np.random.Generator,
    fixed: np.ndarray | None,
    inclusion: np.ndarray | None,
) -> SoftBody:
    """An organ as a body of drawn stiffness, held at ``fixed`` vertices (V,) or in drawn patches.

    ``inclusion`` (E,) is the share of each cube that lies in a stiffer part.
    """
    poisson = rng.uniform(*settings.poisson)
    places = np.stack([organ.place(rng) for _ in range(_PLACES)])
    signs = rng.normal(size=_PLACES)
    harder = _between(settings.inclusion, rng.random())
    if fixed is None or settings.fixed == "about":
        fixed = drawn_patches(organ, settings, rng, fixed)
    near = _bump(organ.voxels.middles[:, None], places, _ALIKE) @ signs
    stiffness = _between(settings.stiffness, 0.5 + 0.5 * np.tanh(near))
    if inclusion is not None:
        stiffness = stiffness * (1 + (harder - 1) * inclusion)
    if settings.cuts:
        stiffness = np.where(drawn_cuts(organ, settings, rng), SEVERED, 1.0) * stiffness
    return SoftBody(organ.voxels, stiffness, poisson, organ.nodes_at(fixed))


def drawn_cuts(organ: Organ, settings: Simulation, rng: np.random.Generator) -> np.ndarray:
    """Mask (E,) of the cubes that one cut or some go through.

    Each is the part of a ball about a place of the surface that lies in a plane through the normal
    there. Cubes that touch it are as wide a gap as the grid knows; they join its sides softly, so
    that the mesh and its cubes stay as they are.
    """
    voxels = organ.voxels
    severed = np.zeros(len(voxels.cubes), bool)
    for _ in range(rng.integers(settings.cuts) + 1):
        place, reach = organ.place(rng), rng.uniform(*settings.cut)
        inwards = organ.areas[((organ.middles - place) ** 2).sum(axis=1).argmin()]
        across = np.cross(inwards, rng.normal(size=3))
        across /= np.linalg.norm(across)
        offset = voxels.middles - place
        touched = np.abs(offset @ across) <= voxels.edge / 2 * np.abs(across).sum()
        severed |= touched & (np.linalg.norm(offset, axis=1) <= reach)
    return severed


def drawn_loads(
    organ: Organ, settings: Simulation, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Forces (n, 3, L) at the nodes and growth (E, L) of the cubes under L loads of any size."""
    kinds = [str(rng.choice(settings.loads)) for _ in range(rng.integers(settings.together) + 1)]
    voxels = organ.voxels
    forces = np.zeros((len(voxels.nodes), 3, len(kinds)))
    growth = np.zeros((len(voxels.cubes), len(kinds)))
    for load, kind in enumerate(kinds):
        place, width = organ.place(rng), rng.uniform(*settings.width)
        direction = rng.normal(size=3)
        sign = rng.choice([-1.0, 1.0])
        local = _bump(organ.middles, place, width)[:, None]
        if kind == "force":
            area = np.linalg.norm(organ.areas, axis=1, keepdims=True)
            forces[:, :, load] = organ.pressed.T @ (local * area * direction)
        elif kind == "pressure":
            forces[:, :, load] = organ.pressed.T @ (sign * local * organ.areas)
        elif kind == "gravity":
            weight = np.bincount(
                voxels.cubes.ravel(), np.repeat(voxels.inside, 8), len(voxels.nodes)
            )
            forces[:, :, load] = weight[:, None] * direction
        else:
            growth[:, load] = -_bump(voxels.middles, place, width)
    return forces, growth


def _bump(points: np.ndarray, place: np.ndarray, width: float) -> np.ndarray:
    return np.exp(((points - place) ** 2).sum(axis=-1) / (-2 * width**2))


def _between(range_: list[float], share: np.ndarray | float) -> np.ndarray | float:
    """From the lower end, at 0, to the upper one, at 1, by equal factors."""
    low, high = range_
    return low * (high / low) ** share
