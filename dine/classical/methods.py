"""Classical registration, to compare with: nothing learned, one pair at a time.

Every method is a class in :data:`CLASSICAL`; its arguments are those of the method, its call turns
(N, 3) source and (M, 3) target points of the normalised frame into a displacement field. The
defaults are the best settings found on validation pairs; docs/reference/classical.md has the whole
sweep.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, fields
from typing import ClassVar

import numpy as np
import trimesh.registration
from threadpoolctl import threadpool_limits

from dine.classical import bcpd
from dine.errors import ConfigError, DataError
from dine.extras import extras_needed
from dine.geometry.rigid import transformed
from dine.refinement.refine import ROUNDS, Options, refine
from dine.registry import Registry

# Defaults of "cpd" and "bcpd": of 53 and 21 settings, those with the lowest mean correspondence
# error among the ones that allow for outliers, on 30 synthetic validation pairs (16 in the manner
# of SynBench, 14 of DeformedTissue): 0.016 and 0.026; unregistered 0.165. Targets held the same
# points as the sources, shuffled. With points of their own (60 pairs) it is 0.081 and 0.080;
# unregistered 0.161. docs/reference/classical.md has the sweep.


@dataclass(kw_only=True)
class Classical(ABC):
    """Base of the classical methods; all are deterministic and run on one thread.

    Arguments are fields: numbers are positive, but ``outliers``, a share.

    Raises:
        ConfigError: an argument outside its range.
    """

    registered_name: ClassVar[str]

    def __post_init__(self):
        for field in fields(self):
            value, read = getattr(self, field.name), {"int": int, "bool": bool}.get(field.type)
            if field.name == "outliers":
                value = _share(field.name, value)
            elif read is not bool:
                value = _positive(field.name, value)
            setattr(self, field.name, read(value) if read else value)

    def __call__(self, source: np.ndarray, target: np.ndarray) -> np.ndarray:
        """The displacement (N, 3), float64, of each source point.

        Args:
            source: (N, 3) points of the normalised frame.
            target: (M, 3) points of the same frame, in any order.

        Raises:
            DataError: clouds of another shape, without points, or with values that are not finite.
            ConfigError: the method's library is not installed.
        """
        source, target = _points(source, "source"), _points(target, "target")
        # Small systems, for which many threads only wait for each other.
        with threadpool_limits(1, user_api="blas"):
            return np.asarray(self.moved(source, target), dtype=np.float64) - source

    @abstractmethod
    def moved(self, source: np.ndarray, target: np.ndarray) -> np.ndarray:
        """Where the (N, 3) source points belong; both clouds are checked and float64."""


CLASSICAL: Registry[Classical] = Registry("classical method")
"""The methods by name."""


@CLASSICAL.register("unregistered")
class Unregistered(Classical):
    """Moves nothing: how far apart the clouds are to begin with."""

    def moved(self, source: np.ndarray, target: np.ndarray) -> np.ndarray:
        return source


@CLASSICAL.register("icp")
@dataclass(kw_only=True)
class RigidICP(Classical):
    """Rotation and translation by iterative closest points (trimesh), from where the clouds are.

    Unlike :func:`dine.geometry.rigid.rigid_alignment`, whatever it ends at is taken.

    Args:
        iterations: at most.
        tolerance: stop once the mean squared distance changes less than this.
    """

    iterations: int = 200
    tolerance: float = 1e-9

    def moved(self, source: np.ndarray, target: np.ndarray) -> np.ndarray:
        matrix, _, _ = trimesh.registration.icp(
            source,
            target,
            max_iterations=self.iterations,
            threshold=self.tolerance,
            scale=False,
            reflection=False,
        )
        return transformed(source, matrix)


@CLASSICAL.register("cpd")
@dataclass(kw_only=True)
class CPD(Classical):
    """Deformable coherent point drift (Myronenko and Song, IEEE TPAMI 2010), by rustcpd.

    Args:
        beta: width of the Gaussian kernel, in units of the frame.
        lam: λ, the weight of smoothness; some libraries call it alpha.
        outliers: w in [0, 1), the share of target points that belong to no source point.
        rank: most columns of the pivoted Cholesky root of the kernel matrix.
        iterations: at most.
        tolerance: stop once the variance of the mixture changes less than this.
    """

    beta: float = 0.5
    lam: float = 64.0
    outliers: float = 0.1
    rank: int = 400
    iterations: int = 300
    tolerance: float = 1e-7

    def moved(self, source: np.ndarray, target: np.ndarray) -> np.ndarray:
        with extras_needed():
            import rustcpd
        return rustcpd.register_deformable(
            target,
            source,
            alpha=self.lam,
            beta=self.beta,
            low_rank=self.rank,
            # The Cholesky root stops by itself where the kernel is explained.
            low_rank_method="pivoted_cholesky",
            low_rank_tolerance=1e-6,
            normalize=False,
            outlier_weight=self.outliers,
            max_iterations=self.iterations,
            tolerance=self.tolerance,
            parallel=False,
        ).points


@CLASSICAL.register("bcpd")
@dataclass(kw_only=True)
class BCPD(Classical):
    """Bayesian coherent point drift (Hirose, IEEE TPAMI 2021): :func:`dine.classical.bcpd.bcpd`.

    Args:
        beta: width of the Gaussian kernel, in standard deviations of the source.
        lam: λ; displacements have an expected length of √(3 / λ) of these.
        outliers: ω in [0, 1), the share of target points that belong to no source point.
        gamma: factor on the standard deviation that the mixture starts with.
        uncertain: let the posterior variance of the displacements count.
        rank: most columns of the root of the kernel matrix.
        iterations: at most.
        tolerance: stop once the standard deviation of the mixture changes less than this.
    """

    beta: float = 1.4
    lam: float = 20.0
    outliers: float = 0.1
    gamma: float = 1.0
    uncertain: bool = False
    rank: int = 300
    iterations: int = 500
    tolerance: float = 1e-4

    def moved(self, source: np.ndarray, target: np.ndarray) -> np.ndarray:
        return bcpd.bcpd(source, target, bcpd.Parameters(**vars(self))).moved


@CLASSICAL.register("smooth")
@dataclass(kw_only=True)
class SmoothFields(Classical):
    """The most probable smooth field: :func:`dine.refinement.refine.refine` without a network.

    What refinement at test time achieves on its own; our method, not one from the literature.

    Args:
        rounds: of expectation and maximisation.
    """

    rounds: int = ROUNDS

    def moved(self, source: np.ndarray, target: np.ndarray) -> np.ndarray:
        return source + refine(source, target, options=Options(self.rounds)).mean


def _points(points: np.ndarray, what: str) -> np.ndarray:
    points = np.asarray(points, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 3 or len(points) == 0:
        raise DataError(f"Expected a {what} of shape (N, 3), found {points.shape}.")
    if not np.isfinite(points).all():
        raise DataError(f"The {what} has coordinates that are not finite.")
    return np.ascontiguousarray(points)


def _positive(name: str, value: float) -> float:
    if not 0 < value < np.inf:
        raise ConfigError(f"{name} of a classical method is {value}; expected a positive number.")
    return float(value)


def _share(name: str, value: float) -> float:
    if not 0 <= value < 1:
        raise ConfigError(f"{name} of a classical method is {value}; expected 0 <= {name} < 1.")
    return float(value)
