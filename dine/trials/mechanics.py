"""Deformations that a prior of simulations was not learned from: other mechanics, fixation, loads.

Compressible neo-Hookean bodies at finite strain, total Lagrangian, by Newton's method with a direct
solver and rising loads; nothing of :mod:`dine.simulation` but the cubes. What holds the organ is a
patch near one of its ends, what moves it traction on round or long patches, which turns with
nothing, and its weight; Poisson ratios are lower and the grid is another one. Meshes have radius 1.
"""

from __future__ import annotations

import numpy as np
from scipy.sparse import csc_matrix, csr_matrix
from scipy.sparse.linalg import splu
from scipy.spatial import cKDTree

from dine.errors import DataError
from dine.geometry.surface import Surface
from dine.geometry.voxels import CORNERS, Voxels, voxelised
from dine.simulation.fields import OrganDeformations

POISSON = (0.3, 0.38)
AMPLITUDE = (0.08, 0.2)
EDGE = 0.125
# How far from a given vertex the middle of what is held may be, and how large that is.
SHIFTED, HELD = 0.25, (0.2, 0.5)
WIDTHS = (0.6, 1.2)
_GAUSS = 0.5 + (CORNERS - 0.5) / np.sqrt(3)
_STEP, _ITERATIONS, _TOLERANCE, _MOST_STEPS, _DRAWS = 0.15, 12, 1e-6, 60, 20


def gradients() -> np.ndarray:
    """(8, 8, 3) of the corners' trilinear functions in a unit cube at Gauss's points."""
    found = np.empty((8, 8, 3))
    for point, place in enumerate(_GAUSS):
        for corner, at in enumerate(CORNERS):
            factors = np.where(at == 1, place, 1 - place)
            for axis in range(3):
                others = np.prod(np.delete(factors, axis))
                found[point, corner, axis] = others * (1 if at[axis] else -1)
    return found


class NeoHookean:
    """Cubes of W = μ/2 (tr FᵀF − 3 − 2 ln J) + λ/2 (ln J)², lengths in edges, Young's modulus 1."""

    def __init__(self, voxels: Voxels, stiffness: np.ndarray, poisson: float, fixed: np.ndarray):
        self.weight = stiffness * np.maximum(voxels.inside, 0.02) / 8
        self.mu = 1 / (2 * (1 + poisson))
        self.lam = poisson / ((1 + poisson) * (1 - 2 * poisson))
        self.cubes, self.count = voxels.cubes, len(voxels.nodes)
        self.rows = (3 * voxels.cubes[:, :, None] + np.arange(3)).reshape(-1, 24)
        self.free = np.repeat(~fixed, 3)
        self.gradients = gradients()

    def assembled(self, places: np.ndarray) -> tuple[np.ndarray, csc_matrix] | None:
        """Forces (n, 3) that hold a displacement (n, 3), and the tangent; None where a cube is
        inside out."""
        shape = np.einsum("eia,gij->egaj", places[self.cubes], self.gradients) + np.eye(3)
        volume = np.linalg.det(shape)
        if volume.min() <= 0:
            return None
        inverse = np.linalg.inv(shape).swapaxes(2, 3)
        pressure = (self.lam * np.log(volume) - self.mu)[..., None, None]
        stress = self.mu * shape + pressure * inverse
        stress *= self.weight[:, None, None, None]
        force = np.einsum("egaj,gij->eia", stress, self.gradients)
        total = np.zeros((self.count, 3))
        np.add.at(total, self.cubes, force)
        spatial = np.einsum("egaj,gij->egia", inverse, self.gradients)
        flat = spatial.reshape(len(spatial), 8, 24)
        heavy = self.weight[:, None, None]
        stiff = (self.lam * heavy * flat).swapaxes(1, 2) @ flat
        crossed = np.einsum(
            "eg,egib,egja->eiajb",
            -self.weight[:, None] * pressure[..., 0, 0],
            spatial,
            spatial,
            optimize=True,
        )
        stiff += crossed.reshape(len(stiff), 24, 24)
        plain = np.einsum("gia,gja->ij", self.gradients, self.gradients)
        plain = np.einsum("ij,ab->iajb", plain, np.eye(3)).reshape(24, 24)
        stiff += self.mu * heavy * plain
        places = np.repeat(self.rows, 24, axis=1).ravel(), np.tile(self.rows, (1, 24)).ravel()
        return total, csc_matrix((stiff.ravel(), places), shape=(3 * self.count,) * 2)

    def step(self, places: np.ndarray, forces: np.ndarray) -> np.ndarray | None:
        """Newton's method from a displacement (n, 3) to equilibrium; None where it fails."""
        places = places.copy()
        for _ in range(_ITERATIONS):
            found = self.assembled(places)
            if found is None:
                return None
            residual = (forces - found[0]).ravel()[self.free]
            tangent = found[1][self.free][:, self.free].tocsc()
            change = splu(tangent, permc_spec="MMD_AT_PLUS_A").solve(residual)
            flat = places.reshape(-1)
            flat[self.free] += change
            if np.linalg.norm(change) <= _TOLERANCE * np.linalg.norm(flat):
                return places
        return None


def true_deformations(
    source: Surface, count: int, seed: int, *, edge: float = EDGE
) -> OrganDeformations:
    """Of a closed mesh of radius 1; each depends on the seed and its number alone.

    Raises:
        DataError: no mesh with an inside, or parts too thin for cubes with this edge.
    """
    voxels = voxelised(source, edge)
    carrier = voxels.carrier(source.vertices)
    nodes = np.stack([_first(source, voxels, carrier, seed, number) for number in range(count)])
    vertices = np.stack([carrier @ field for field in nodes])
    return OrganDeformations(source, vertices.astype(np.float32), voxels, nodes.astype(np.float32))


def attachment(source: Surface) -> np.ndarray:
    """(3,) the vertex of a mesh that lies farthest along its second principal axis."""
    middle = source.vertices - source.vertices.mean(axis=0)
    return source.vertices[(middle @ np.linalg.svd(middle, full_matrices=False)[2][1]).argmax()]


def held(source: Surface) -> np.ndarray:
    """Mask (V,) of the vertices that the middle of what is held may be at."""
    return np.linalg.norm(source.vertices - attachment(source), axis=1) <= SHIFTED


def patch(source: Surface) -> np.ndarray:
    """Mask (V,) of the vertices of one patch of middling size that may be held."""
    return np.linalg.norm(source.vertices - attachment(source), axis=1) <= sum(HELD) / 2


def inside_points(source: Surface) -> np.ndarray:
    """(50, 3) points of a ball of radius 0.05 in the thickest part of a mesh of radius 1."""
    voxels = voxelised(source, EDGE)
    deep = cKDTree(source.vertices).query(voxels.middles)[0] * (voxels.inside >= 1)
    rng = np.random.default_rng(13)
    ball = rng.normal(size=(50, 3))
    ball *= 0.05 * rng.random((50, 1)) ** (1 / 3) / np.linalg.norm(ball, axis=1, keepdims=True)
    return voxels.middles[deep.argmax()] + ball


def _first(
    source: Surface, voxels: Voxels, carrier: csr_matrix, seed: int, number: int
) -> np.ndarray:
    """Displacement (n, 3) of the nodes under the first loads drawn that an equilibrium is found
    for."""
    rng = np.random.default_rng([12, seed, number])
    tries = (_drawn(source, voxels, carrier, rng) for _ in range(_DRAWS))
    found = next((x for x in tries if x is not None), None)
    if found is None:
        raise DataError(
            f"{source.name} bears no loads that were drawn; its parts are too thin for cubes with "
            f"an edge of {voxels.edge:g} of the radius."
        )
    return found


def _drawn(
    source: Surface, voxels: Voxels, carrier: csr_matrix, rng: np.random.Generator
) -> np.ndarray | None:
    """Displacement (n, 3) of the nodes under drawn loads; None where no equilibrium is found."""
    vertices = source.vertices
    near = np.linalg.norm(vertices - attachment(source), axis=1)
    middle = vertices[rng.choice(np.flatnonzero(near <= SHIFTED))]
    kept = np.linalg.norm(vertices - middle, axis=1) <= rng.uniform(*HELD)
    fixed = np.zeros(len(voxels.nodes), bool)
    fixed[voxels.carried(vertices[kept])[0].ravel()] = True
    softer = np.exp(rng.normal(scale=0.3, size=len(voxels.cubes)))
    body = NeoHookean(voxels, softer, rng.uniform(*POISSON), fixed)
    forces = np.zeros((len(voxels.nodes), 3))
    for _ in range(rng.integers(1, 4)):
        middle = vertices[rng.integers(len(vertices))]
        widths = rng.uniform(*WIDTHS, 3)
        near = np.exp(-0.5 * (((vertices - middle) / widths) ** 2).sum(axis=1))
        forces += carrier.T @ (near[:, None] * rng.normal(size=3) / near.sum())
    weight = np.bincount(voxels.cubes.ravel(), np.repeat(voxels.inside, 8), len(voxels.nodes))
    forces += rng.uniform(0, 2) * weight[:, None] / weight.sum() * rng.normal(size=3)
    return _raised(body, forces, carrier, rng.uniform(*AMPLITUDE) / voxels.edge, voxels.edge)


def _raised(
    body: NeoHookean, forces: np.ndarray, carrier: csr_matrix, wanted: float, edge: float
) -> np.ndarray | None:
    """The displacement (n, 3) under rising forces once its mean at the vertices is as wanted."""
    still = np.zeros((body.count, 3))
    _, tangent = body.assembled(still)
    first = np.zeros(3 * body.count)
    first[body.free] = splu(tangent[body.free][:, body.free].tocsc()).solve(
        forces.ravel()[body.free]
    )
    mean = np.linalg.norm(carrier @ first.reshape(-1, 3), axis=1).mean()
    forces = forces * wanted / mean
    places, share, step = still, 0.0, _STEP
    for _ in range(_MOST_STEPS):
        found = body.step(places, (share + step) * forces)
        if found is None:
            step /= 2
            if step < 0.01:
                return None
            continue
        places, share = found, share + step
        if np.linalg.norm(carrier @ places, axis=1).mean() >= wanted:
            return edge * places
    return None
