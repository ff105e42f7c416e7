"""Gaussian fields in few dimensions: what a most probable field in closed form needs of a prior."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.linalg import LinAlgError, cho_factor, cho_solve, lapack, solve_triangular
from scipy.spatial.distance import cdist

from dine.threads import available, share

# Covariances of so many places stay in cache.
_ROWS = 128
# Share of the points with an observation from which on the others are not worth leaving out.
_MOST_SEEN = 0.9
# Solutions of a system in single precision until its error is that of double precision.
_REFINEMENTS = 2
_RESIDUE = 1e-6


@dataclass(frozen=True)
class LinearGaussian:
    """Fields D = mean + Σ_k z_k modes_k + kernel · C, with all z and C independent N(0, 1).

    Attributes:
        mean: (N, 3).
        modes: (R, N, 3), whose amplitudes couple points and coordinates; R may be 0.
        kernel: (N, r) root of a covariance between points, which the three coordinates share
            without being correlated; r may be 0.
    """

    mean: np.ndarray
    modes: np.ndarray
    kernel: np.ndarray

    @classmethod
    def of_kernel(cls, kernel: np.ndarray) -> LinearGaussian:
        """Zero mean and no modes."""
        points = len(kernel)
        return cls(np.zeros((points, 3)), np.zeros((0, points, 3)), kernel)

    def times(self, factor: float) -> LinearGaussian:
        """With standard deviations so many times as large, around the same mean."""
        return LinearGaussian(self.mean, factor * self.modes, factor * self.kernel)


def squared_exponential(
    a: np.ndarray,
    b: np.ndarray,
    widths: Sequence[float],
    amplitudes: Sequence[float],
    affine: float = 0.0,
) -> np.ndarray:
    """(N, M) covariance of one coordinate between points a (N, 3) and b (M, 3).

    Σ_m amplitude_m² exp(−‖a − b‖² / 2 width_m²) + affine² (a·b + 1): smooth motions at some widths
    on top of a random affine one, all in the units of the points.
    """
    squared = cdist(a, b, "sqeuclidean")
    total = a @ b.T
    total += 1
    total *= affine**2
    for width, amplitude in zip(widths, amplitudes, strict=True):
        part = squared / (-2 * width**2)
        np.exp(part, out=part)
        part *= amplitude**2
        total += part
    return total


@dataclass(frozen=True)
class CovarianceRoot:
    """A root L of :func:`squared_exponential` at (N, 3) points, with L Lᵀ ≈ K, that goes on.

    Attributes:
        root: (N, r) at the points.
        pivots: (r, 3) points that the others are explained by.
        lower: (r, r) root at the pivots, lower triangular.
        kernel: widths, amplitudes and affine part of the covariance.
    """

    root: np.ndarray
    pivots: np.ndarray
    lower: np.ndarray
    kernel: tuple[Sequence[float], Sequence[float], float]

    def times(self, factor: float) -> CovarianceRoot:
        """That of a process whose standard deviations are so many times as large."""
        widths, amplitudes, affine = self.kernel
        kernel = (widths, [factor * amplitude for amplitude in amplitudes], factor * affine)
        return CovarianceRoot(factor * self.root, self.pivots, factor * self.lower, kernel)

    def at(self, places: np.ndarray) -> np.ndarray:
        """(M, r) rows for any places (M, 3): those of the points themselves at these.

        Fields root · C go on as their expectation given the pivots (Nyström); see Rasmussen and
        Williams (2006), Gaussian Processes for Machine Learning, section 8.1.
        """
        covariance = squared_exponential(places, self.pivots, *self.kernel)
        return solve_triangular(self.lower, covariance.T, lower=True, check_finite=False).T

    def field(self, places: np.ndarray, amplitudes: np.ndarray) -> np.ndarray:
        """``at(places) @ amplitudes`` (M, k) for amplitudes (r, k), in M · r operations."""
        at_pivots = solve_triangular(
            self.lower, amplitudes, lower=True, trans="T", check_finite=False
        )
        widths, heights, affine = self.kernel
        weights = [height**2 * at_pivots for height in heights]
        # The affine part is one of the places alone.
        slope = affine**2 * self.pivots.T @ at_pivots
        still = affine**2 * at_pivots.sum(axis=0)
        # One product gives ‖x‖² − 2 x·y + ‖y‖² for all pairs.
        right = np.vstack(
            [-2 * self.pivots.T, np.ones(len(self.pivots)), (self.pivots**2).sum(axis=1)]
        )
        found = np.empty((len(places), amplitudes.shape[1]))

        # Memory of every worker; fresh one would cost more than the arithmetic.
        left = np.ones((available(), _ROWS, 5))
        room = np.empty((available(), 2, _ROWS, len(self.pivots)))

        def fill(worker: int, first: int) -> None:
            here = places[first : first + _ROWS]
            left[worker, : len(here), :3] = here
            left[worker, : len(here), 3] = np.einsum("nc,nc->n", here, here)
            squared = np.matmul(left[worker, : len(here)], right, out=room[worker, 0, : len(here)])
            total, part = here @ slope + still, room[worker, 1, : len(here)]
            for width, weight in zip(widths, weights, strict=True):
                np.multiply(squared, -0.5 / width**2, out=part)
                total += np.exp(part, out=part) @ weight
            found[first : first + _ROWS] = total

        share(range(0, len(places), _ROWS), fill)
        return found


def covariance_root(
    points: np.ndarray,
    widths: Sequence[float],
    amplitudes: Sequence[float],
    affine: float = 0.0,
    *,
    rank: int = 128,
    tolerance: float = 1e-4,
) -> CovarianceRoot:
    """A root of :func:`squared_exponential` at points (N, 3).

    Pivoted Cholesky (Harbrecht, Peters and Schneider, 2012): each step takes the point that the
    earlier ones explain least, until the largest variance left is below ``tolerance`` times the
    largest at the start, or ``rank`` steps are done. N·r² operations, and r columns of K.
    """
    points = np.asarray(points, dtype=np.float64)
    left = affine**2 * ((points**2).sum(axis=1) + 1) + float(np.square(amplitudes).sum())
    enough = tolerance * left.max()
    root = np.zeros((len(points), min(rank, len(points))))
    pivots: list[int] = []
    for column in range(root.shape[1]):
        pivot = int(np.argmax(left))
        if left[pivot] <= enough:
            root = root[:, :column]
            break
        row = squared_exponential(points, points[pivot : pivot + 1], widths, amplitudes, affine)
        known = root[:, :column]
        root[:, column] = (row[:, 0] - known @ known[pivot]) / np.sqrt(left[pivot])
        left = np.maximum(left - root[:, column] ** 2, 0)
        pivots.append(pivot)
    return CovarianceRoot(root, points[pivots], root[pivots], (widths, amplitudes, affine))


def most_probable(prior: LinearGaussian, pulled: np.ndarray, precision: np.ndarray) -> np.ndarray:
    """The mean (N, 3) of :class:`Posterior` alone, in half the time, to some 1e-6 of its length.

    The system is summed up in single precision, and what its solution leaves over is solved for
    once more (iterative refinement; Higham, 2002, Accuracy and stability of numerical algorithms,
    chapter 12).
    """
    if len(prior.modes) or prior.mean.any():
        return Posterior(prior, pulled, precision).mean
    kernel = prior.kernel
    size = kernel.shape[1]
    single = kernel.astype(np.float32)
    # Columns lie one after the other, as the factorisation wants them.
    system = np.zeros((3 * size, 3 * size), np.float32, order="F")
    for a in range(3):
        for b in range(a + 1):
            block = _weighted_gram(single, precision[:, a, b])
            system[a * size : (a + 1) * size, b * size : (b + 1) * size] = block.T
    system[np.diag_indices(len(system))] += 1
    try:
        factor = cho_factor(system, lower=True, overwrite_a=True, check_finite=False)
    except LinAlgError:
        return Posterior(prior, pulled, precision).mean
    right = kernel.T @ pulled
    alone, left = np.zeros_like(right), right
    for _ in range(_REFINEMENTS):
        step = cho_solve(factor, left.T.ravel().astype(np.float32), check_finite=False)
        alone += step.reshape(3, size).T
        seen = np.einsum("nab,nb->na", precision, kernel @ alone)
        left = right - kernel.T @ seen - alone
    # Too near to singular for single precision.
    if not np.linalg.norm(left) <= _RESIDUE * np.linalg.norm(right):
        return Posterior(prior, pulled, precision).mean
    return kernel @ alone


def _weighted_gram(kernel: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """(r, r) Σ weight · row · rowᵀ over rows (N, r), whose weights may be negative."""
    # A product of a matrix with itself takes half the time of one with another.
    if not (weight < 0).any():
        rows = kernel * np.sqrt(weight).astype(kernel.dtype)[:, None]
        return rows.T @ rows
    order = np.argsort(weight < 0, kind="stable")
    rows = kernel[order]
    rows *= np.sqrt(np.abs(weight[order])).astype(kernel.dtype)[:, None]
    more, less = np.split(rows, [int((weight >= 0).sum())])
    total = more.T @ more
    if len(less):
        total -= less.T @ less
    return total


class Posterior:
    """A Gaussian field given noisy values at its points, each of an own precision in space.

    One solve of R + 3r unknowns: N·r² operations for the kernel's six blocks, and (R + 3r)³ / 3.

    Args:
        prior: of N points.
        pulled: (N, 3) sums of precision · value over what was observed at each point.
        precision: (N, 3, 3) sums of the precisions, symmetric.

    Attributes:
        mean: (N, 3), the most probable field.
        shared: (R,) amplitudes of the prior's modes.
        alone: (r, 3) amplitudes of its kernel.
        energy: half the squared length of both, −log of the prior's density up to a constant.
        complexity: half the log-determinant of the posterior precision relative to the prior's;
            −log evidence is misfit + energy + complexity (MacKay, 1992, Bayesian interpolation).
        evidence: log evidence of what was observed, up to a constant that priors of one mean share.
    """

    def __init__(self, prior: LinearGaussian, pulled: np.ndarray, precision: np.ndarray):
        self._observed = pulled, precision
        modes, kernel = prior.modes, prior.kernel
        first, rank = len(modes), kernel.shape[1]
        size = first + 3 * rank
        pulled = pulled - np.einsum("nab,nb->na", precision, prior.mean)
        seen = precision.any(axis=(1, 2))
        if seen.mean() < _MOST_SEEN:
            modes, kernel = modes[:, seen], kernel[seen]
            pulled, precision = pulled[seen], precision[seen]
        system, right = np.zeros((size, size)), np.empty(size)
        at = [slice(first + axis * rank, first + (axis + 1) * rank) for axis in range(3)]
        for a in range(3):
            right[at[a]] = kernel.T @ pulled[:, a]
            for b in range(a + 1):
                system[at[a], at[b]] = kernel.T @ (precision[:, a, b, None] * kernel)
        if first:
            # One matrix product for all is far quicker than sums over axes.
            flat = np.ascontiguousarray(modes.transpose(2, 0, 1))
            right[:first] = modes.reshape(first, -1) @ pulled.ravel()
            total = np.zeros((first, first))
            for a in range(3):
                heavy = sum(flat[b] * precision[:, a, b] for b in range(3))
                total += heavy @ flat[a].T
                system[at[a], :first] = kernel.T @ heavy.T
            system[:first, :first] = total
        system[np.diag_indices(size)] += 1
        # Only the lower triangle is read.
        self._factor = cho_factor(system, lower=True, overwrite_a=True, check_finite=False)
        found = cho_solve(self._factor, right, check_finite=False)
        self.shared, self.alone = found[:first], found[first:].reshape(3, rank).T
        self.mean = prior.mean + prior.kernel @ self.alone
        if first:
            self.mean += np.tensordot(self.shared, prior.modes, axes=1)
        self.energy = 0.5 * float((found**2).sum())
        self.complexity = float(np.log(np.diag(self._factor[0])).sum())
        self.evidence = 0.5 * float(right @ found) - self.complexity

    def under(self, prior: LinearGaussian) -> Posterior:
        """What the same observations say under another prior of the same points."""
        return Posterior(prior, *self._observed)

    @cached_property
    def determined(self) -> float:
        """How many amplitudes the data determine (MacKay, 1992, Bayesian interpolation, equation
        4.10)."""
        inverse, _ = lapack.dtrtri(self._factor[0], lower=1)
        return len(inverse) - float((np.tril(inverse) ** 2).sum())

    @cached_property
    def scale(self) -> float:
        """Standard deviation, in those of the prior, that amplitudes like these are most likely of.

        Squared, it is Σ amplitude² over the number of amplitudes that the data determine (MacKay,
        1992, Bayesian interpolation, equation 4.9).
        """
        return float(np.sqrt(2 * self.energy / max(self.determined, 1.0)))

    def saving(self, least: float) -> float:
        """What −log of the evidence falls by if the prior's scale is not known: that which is most
        likely of its field is taken, at least ``least`` and at most 1.

        Shrunk by s, the energy grows by 1 / s² and log(1 / s) is won for each amplitude that the
        data determine (MacKay, 1992, Bayesian interpolation, section 4.3).
        """
        scale = float(np.clip(self.scale, least, 1.0))
        return self.energy * (1 - scale**-2) - self.determined * float(np.log(scale))

    def covariance(self, kernel: np.ndarray, modes: np.ndarray | None = None) -> np.ndarray:
        """(M, 3, 3) of the field where the prior has these rows of its kernel (M, r), and modes
        (R, M, 3) if it has any."""
        solved = self._whitened(kernel, modes)
        return np.einsum("akm,bkm->mab", solved, solved, optimize=True)

    def variance(self, kernel: np.ndarray, modes: np.ndarray | None = None) -> np.ndarray:
        """Sum (M,) of the field's three variances, likewise."""
        solved = self._whitened(kernel, modes)
        return np.einsum("akm,akm->m", solved, solved)

    def _whitened(self, kernel: np.ndarray, modes: np.ndarray | None) -> np.ndarray:
        """(3, R + 3r, M), whose products over the second axis are the covariances."""
        first, rank = len(self.shared), len(self.alone)
        solved = np.empty((3, first + 3 * rank, len(kernel)))
        for axis in range(3):
            # Above the first row that is not zero nor is the solution.
            begin = 0 if first else axis * rank
            rows = np.zeros((first + 3 * rank - begin, len(kernel)))
            if first:
                rows[:first] = modes[:, :, axis]
            rows[first + axis * rank - begin : first + (axis + 1) * rank - begin] = kernel.T
            solved[axis, :begin] = 0
            solved[axis, begin:] = solve_triangular(
                self._factor[0][begin:, begin:], rows, lower=True, check_finite=False
            )
        return solved
