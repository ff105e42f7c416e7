"""Corotated linear elasticity of cubes: what a soft body does under loads, at large rotations.

Each cube resists strain as in linear elasticity, in a frame that turns along with it: with the
rotation R of its deformation gradient, the forces at its corners x are R K (Rᵀ x − X), where X are
the corners at rest (Müller and Gross, 2004, Interactive virtual materials). Element integrals are
scikit-fem's. Volume change is integrated with one point a cube, or nearly incompressible tissue
would lock (Malkus and Hughes, 1978, Mixed finite element methods). A cube at the surface counts by
its share of the inside (finite cell method: Parvizian, Düster and Rank, 2007).

Equilibrium is found with the factor of the stiffness at rest alone, turned along with the nodes
(Courtecuisse et al., 2010, Asynchronous preconditioners), for many loads at once; the last steps
are mixed (Walker and Ni, 2011, Anderson acceleration). Lengths are in edges of a cube, forces in
Young's modulus 1 times a squared edge.
"""

from __future__ import annotations

import logging
from functools import cache

import numba
import numpy as np
from scipy.sparse import csc_matrix, csr_matrix, eye_array, kron
from scipy.sparse.linalg import SuperLU, splu
from skfem import Basis, BilinearForm, ElementHex1, ElementVector, MeshHex
from skfem.helpers import ddot, div, sym_grad

from dine.geometry.voxels import CORNERS, Voxels

logging.getLogger("skfem").setLevel(logging.WARNING)

# A cube that is hardly inside is as stiff as if so much of it were.
_LEAST_SHARE = 0.01
# How much stiffer places are tied to given displacements than a cube of an edge is.
_TIED = 1e3
# Loads rise over the first steps; the last ones are mixed. It is over when a step is so short,
# as a share of the displacement, and lost when it is still so long.
_RISE, _STEPS, _MIXED = 5, 30, 5
_ENOUGH, _LOST = 1e-3, 3.0
# Steps of Newton's iteration for rotations, which converges quadratically.
_TURNS = 12
_FLAT = 1e-6
_TINY = np.finfo(float).tiny
_jit = numba.njit(cache=True, nogil=True, error_model="numpy")


@cache
def unit_stiffness() -> tuple[np.ndarray, np.ndarray]:
    """Stiffness (24, 24) of a unit cube by Lamé's second parameter μ, and by the first, λ.

    Rows are corners in the order of ``CORNERS``, three axes each.
    """
    mesh, element = MeshHex(), ElementVector(ElementHex1())
    basis, once = Basis(mesh, element), Basis(mesh, element, intorder=1)
    shear = BilinearForm(lambda u, v, w: 2 * ddot(sym_grad(u), sym_grad(v))).assemble(basis)
    volume = BilinearForm(lambda u, v, w: div(u) * div(v)).assemble(once)
    corner = [int(np.flatnonzero((place == mesh.p.T).all(axis=1))[0]) for place in CORNERS]
    rows = basis.nodal_dofs[:, corner].T.ravel()
    return shear.toarray()[np.ix_(rows, rows)], volume.toarray()[np.ix_(rows, rows)]


def shape_gradients(places: np.ndarray) -> np.ndarray:
    """(P, 8, 3) gradients of the corners' trilinear functions at places (P, 3) of a unit cube."""
    at = places[:, None]
    values = np.where(CORNERS == 1, at, 1 - at)
    gradients = np.empty((len(places), 8, 3))
    for axis in range(3):
        others = np.delete(values, axis, axis=2)
        gradients[:, :, axis] = others.prod(axis=2) * np.where(CORNERS[:, axis] == 1, 1, -1)
    return gradients


_MIDDLE = shape_gradients(np.full((1, 3), 0.5))[0]
_GAUSS = shape_gradients(0.5 + (CORNERS - 0.5) / np.sqrt(3))
_REST = (CORNERS - 0.5)[None, :, :, None]


class SoftBody:
    """Cubes with stiffness and Poisson ratio, held at some of n nodes.

    Args:
        voxels: E cubes.
        stiffness: (E,) Young's modulus of each.
        poisson: Poisson ratio, below 0.5.
        fixed: (n,) bool, nodes that do not move: enough of them that nothing can turn.
    """

    def __init__(self, voxels: Voxels, stiffness: np.ndarray, poisson: float, fixed: np.ndarray):
        self._matrix = _cube_stiffness(poisson)
        self._stiffness = stiffness * np.maximum(voxels.inside, _LEAST_SHARE)
        self._cubes, self._free = voxels.cubes, ~fixed
        count, cubes = len(voxels.nodes), len(voxels.cubes)
        moving = np.repeat(self._free, 3)
        whole = _assembled(voxels, self._stiffness[:, None, None] * self._matrix)
        self._factor = _factorised(whole[moving][:, moving])
        corner = np.arange(8 * cubes)
        self._sum = csr_matrix(
            (np.ones(8 * cubes), (voxels.cubes.ravel(), corner)), shape=(count, 8 * cubes)
        )

    def linear(self, forces: np.ndarray) -> np.ndarray:
        """Displacement (n, 3, B) by linear elasticity under forces (n, 3, B)."""
        found = np.zeros_like(forces)
        found[self._free] = self._solved(forces[self._free])
        return found

    def of_growth(self, growth: np.ndarray) -> np.ndarray:
        """Forces (n, 3, B) that cubes at rest do when their edges want to be (E, B) longer."""
        still = np.zeros((len(self._free), 3, growth.shape[1]))
        return -self._resistance(still, growth)[0]

    def equilibrium(self, forces: np.ndarray, growth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Displacement (n, 3, B) under forces (n, 3, B) and growth (E, B), and whether each of
        the B was found (B,).
        """
        found, reached = np.zeros_like(forces), np.zeros(forces.shape[2], bool)
        going = np.arange(forces.shape[2])
        history = _Mixing()
        for step in range(_STEPS):
            share = min(1.0, (step + 1) / _RISE)
            at = found[:, :, going]
            resisting, turn = self._resistance(at, share * growth[:, going])
            change = self._step(share * forces[:, :, going] - resisting, turn)
            size = np.linalg.norm(change, axis=(0, 1))
            length = np.linalg.norm(at, axis=(0, 1))
            goes_on = (size < _LOST * length) if step else np.ones(len(going), bool)
            if step >= _RISE:
                reached[going[size <= _ENOUGH * length]] = True
                goes_on &= size > _ENOUGH * length
            if not goes_on.all():
                going, at, change = going[goes_on], at[:, :, goes_on], change[:, :, goes_on]
                history.keep(goes_on)
            if not len(going):
                break
            free = at[self._free]
            at[self._free] = history.next(free, change) if step >= _RISE else free + change
            found[:, :, going] = at
        return found, reached

    def inverted(self, displacement: np.ndarray) -> np.ndarray:
        """Share (B,) of the cubes that a displacement (n, 3, B) turns inside out at one of the
        eight points of Gauss's rule."""
        gradient = np.einsum("eiab,gij->ebgaj", displacement[self._cubes], _GAUSS)
        return (np.linalg.det(gradient + np.eye(3)) <= 0).any(axis=2).mean(axis=0)

    def _solved(self, forces: np.ndarray) -> np.ndarray:
        """Of the free nodes (f, 3, B), by the stiffness at rest."""
        return self._factor.solve(forces.reshape(-1, forces.shape[2])).reshape(forces.shape)

    def _step(self, forces: np.ndarray, turn: np.ndarray) -> np.ndarray:
        """Change (f, 3, B) of the free nodes that forces (n, 3, B) ask for, with the rotations
        (3, 3, E, B) of the cubes."""
        node = self._around(turn)[:, :, self._free]
        asked = _turned_back(node, forces[self._free][:, None])[:, 0]
        return _turned(node, self._solved(asked)[:, None])[:, 0]

    def _resistance(
        self, displacement: np.ndarray, growth: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Forces (n, 3, B) that hold a displacement (n, 3, B), and rotations (3, 3, E, B) of the
        cubes."""
        corner = displacement[self._cubes]
        gradient = np.tensordot(corner, _MIDDLE, axes=(1, 0)).transpose(1, 3, 0, 2)
        turn = rotations(gradient + np.eye(3)[:, :, None, None])
        strain = _turned_back(turn, corner + _REST)
        strain -= _REST * (1 + growth[:, None, None])
        return self._forces(strain, turn), turn

    def _forces(self, strain: np.ndarray, turn: np.ndarray) -> np.ndarray:
        """(n, 3, B) of the corners' displacements (E, 8, 3, B) in the frames of the cubes."""
        cubes, _, _, batch = strain.shape
        force = np.matmul(self._matrix, strain.reshape(cubes, 24, batch)).reshape(strain.shape)
        force *= self._stiffness[:, None, None, None]
        total = self._sum @ _turned(turn, force).reshape(8 * cubes, -1)
        return total.reshape(-1, 3, batch)

    def _around(self, turn: np.ndarray) -> np.ndarray:
        """Rotations (3, 3, n, B) of the nodes: the mean of those (3, 3, E, B) around each."""
        cubes, batch = turn.shape[2:]
        corner = np.repeat(turn.transpose(2, 0, 1, 3).reshape(cubes, -1), 8, axis=0)
        total = (self._sum @ corner).reshape(-1, 3, 3, batch).transpose(1, 2, 0, 3)
        return rotations(total / np.asarray(self._sum.sum(axis=1)))


class _Mixing:
    """Anderson acceleration of fixed-point steps of some columns, each on its own."""

    def __init__(self):
        self._places: list[np.ndarray] = []
        self._changes: list[np.ndarray] = []

    def keep(self, columns: np.ndarray) -> None:
        """Forget all but some columns, a mask (B,)."""
        self._places = [x[:, :, columns] for x in self._places]
        self._changes = [x[:, :, columns] for x in self._changes]

    def next(self, place: np.ndarray, change: np.ndarray) -> np.ndarray:
        """Where to go from a place (f, 3, B), at which the plain step is ``change``."""
        self._places = [*self._places[-_MIXED:], place]
        self._changes = [*self._changes[-_MIXED:], change]
        if len(self._places) == 1:
            return place + change
        moved, differing = (np.diff(x, axis=0) for x in (self._places, self._changes))
        gram = np.einsum("pfab,qfab->bpq", differing, differing, optimize=True)
        size = np.trace(gram, axis1=1, axis2=2)[:, None, None]
        gram += (1e-8 * size + _TINY) * np.eye(len(moved))
        right = np.einsum("pfab,fab->bp", differing, change, optimize=True)
        shares = np.linalg.solve(gram, right[:, :, None])[:, :, 0]
        return place + change - np.einsum("bp,pfab->fab", shares, moved + differing, optimize=True)


def filled(
    voxels: Voxels, carrier: csr_matrix, displacement: np.ndarray, poisson: float = 0.45
) -> np.ndarray:
    """Displacements (n, 3, B) of all nodes that go with those (V, 3, B) of some places, which
    ``carrier`` (V, n) carries values to: those of least elastic energy."""
    shares = np.maximum(voxels.inside, _LEAST_SHARE)[:, None, None]
    tied = kron(_TIED * (carrier.T @ carrier), eye_array(3))
    factor = _factorised(_assembled(voxels, shares * _cube_stiffness(poisson)) + tied)
    pulled = _TIED * (carrier.T @ displacement.reshape(len(displacement), -1))
    found = factor.solve(pulled.reshape(3 * len(voxels.nodes), -1))
    return found.reshape(-1, *displacement.shape[1:])


def _cube_stiffness(poisson: float) -> np.ndarray:
    """(24, 24) of a unit cube of Young's modulus 1."""
    shear, volume = unit_stiffness()
    first = poisson / ((1 + poisson) * (1 - 2 * poisson))
    return shear / (2 * (1 + poisson)) + first * volume


def _assembled(voxels: Voxels, matrices: np.ndarray) -> csc_matrix:
    """(3n, 3n) of all nodes from those of the cubes (E, 24, 24)."""
    rows = (3 * voxels.cubes[:, :, None] + np.arange(3)).reshape(len(voxels.cubes), 24)
    places = np.repeat(rows, 24, axis=1).ravel(), np.tile(rows, (1, 24)).ravel()
    return csc_matrix((matrices.ravel(), places), shape=(3 * len(voxels.nodes),) * 2)


def _factorised(matrix: csc_matrix) -> SuperLU:
    """Of a symmetric positive definite matrix."""
    options = {"SymmetricMode": True}
    matrix = csc_matrix(matrix)
    return splu(matrix, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0, options=options)


@_jit
def _turned(turn: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """By rotations (3, 3, E, B) the vectors (E, K, 3, B)."""
    found = np.empty_like(vectors)
    cubes, corners, _, batch = vectors.shape
    for e in range(cubes):
        for k in range(corners):
            for i in range(3):
                for b in range(batch):
                    found[e, k, i, b] = (
                        turn[i, 0, e, b] * vectors[e, k, 0, b]
                        + turn[i, 1, e, b] * vectors[e, k, 1, b]
                        + turn[i, 2, e, b] * vectors[e, k, 2, b]
                    )
    return found


@_jit
def _turned_back(turn: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """By the inverses of rotations (3, 3, E, B) the vectors (E, K, 3, B)."""
    found = np.empty_like(vectors)
    cubes, corners, _, batch = vectors.shape
    for e in range(cubes):
        for k in range(corners):
            for i in range(3):
                for b in range(batch):
                    found[e, k, i, b] = (
                        turn[0, i, e, b] * vectors[e, k, 0, b]
                        + turn[1, i, e, b] * vectors[e, k, 1, b]
                        + turn[2, i, e, b] * vectors[e, k, 2, b]
                    )
    return found


def _cofactors(matrix: np.ndarray) -> np.ndarray:
    """Of matrices (3, 3, ...)."""
    found = np.empty_like(matrix)
    for i in range(3):
        a, b = matrix[(i + 1) % 3], matrix[(i + 2) % 3]
        for j in range(3):
            k, l = (j + 1) % 3, (j + 2) % 3
            found[i, j] = a[k] * b[l] - a[l] * b[k]
    return found


def rotations(matrices: np.ndarray) -> np.ndarray:
    """The rotations (3, 3, ...) that are nearest to matrices (3, 3, ...).

    The orthogonal factor of the polar decomposition by Newton's iteration (Higham, 1986, Computing
    the polar decomposition); of what is turned inside out, or flat, by singular values.
    """
    turn = np.array(matrices)
    inverted = (turn[0] * _cofactors(turn)[0]).sum(axis=0) < _FLAT
    if inverted.any():
        left, _, right = np.linalg.svd(np.moveaxis(turn[:, :, inverted], 2, 0))
        left[np.linalg.det(left @ right) < 0, :, 2] *= -1
        turn[:, :, inverted] = np.moveaxis(left @ right, 0, 2)
    flat = np.ascontiguousarray(turn).reshape(9, -1)
    _orthogonalise(flat)
    return flat.reshape(turn.shape)


@_jit
def _orthogonalise(matrices: np.ndarray) -> None:
    """Newton's iteration for the orthogonal factors of matrices (9, n), in place."""
    for i in range(matrices.shape[1]):
        a, b, c = matrices[0, i], matrices[1, i], matrices[2, i]
        d, e, f = matrices[3, i], matrices[4, i], matrices[5, i]
        g, h, k = matrices[6, i], matrices[7, i], matrices[8, i]
        for _ in range(_TURNS):
            # The inverse's transpose: cofactors over the determinant.
            p, q, r = e * k - f * h, f * g - d * k, d * h - e * g
            half = 0.5 / (a * p + b * q + c * r)
            s, t, u = c * h - b * k, a * k - c * g, b * g - a * h
            v, w, x = b * f - c * e, c * d - a * f, a * e - b * d
            change = abs(half * p - 0.5 * a) + abs(half * t - 0.5 * e) + abs(half * x - 0.5 * k)
            change += abs(half * q - 0.5 * b) + abs(half * r - 0.5 * c) + abs(half * s - 0.5 * d)
            change += abs(half * u - 0.5 * f) + abs(half * v - 0.5 * g) + abs(half * w - 0.5 * h)
            a, b, c = 0.5 * a + half * p, 0.5 * b + half * q, 0.5 * c + half * r
            d, e, f = 0.5 * d + half * s, 0.5 * e + half * t, 0.5 * f + half * u
            g, h, k = 0.5 * g + half * v, 0.5 * h + half * w, 0.5 * k + half * x
            if change < _FLAT:
                break
        matrices[0, i], matrices[1, i], matrices[2, i] = a, b, c
        matrices[3, i], matrices[4, i], matrices[5, i] = d, e, f
        matrices[6, i], matrices[7, i], matrices[8, i] = g, h, k
