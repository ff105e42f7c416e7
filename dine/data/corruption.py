"""Noise and outliers as in the published benchmarks, added to targets in the normalised frame."""

from __future__ import annotations

import math

import numpy as np

from dine.data.pairs import PairSet, Variant, keyed_rng
from dine.errors import ConfigError, DataError


def gaussian_noise(target: np.ndarray, sigma: float, rng: np.random.Generator) -> np.ndarray:
    """Move every point by independent normal noise in each coordinate.

    Args:
        target: (N, 3) points in the normalised frame.
        sigma: standard deviation in the same units, >= 0.
        rng: draws the noise.

    Returns:
        (N, 3) float32.

    Raises:
        DataError: ``target`` is not (N, 3) or not finite.
        ConfigError: ``sigma`` is negative or not a finite number.
    """
    target = _checked(target)
    sigma = _amount(sigma, "sigma of the noise")
    return (target + sigma * rng.standard_normal(target.shape)).astype(np.float32)


def add_outliers(
    target: np.ndarray, percent: float, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Append points drawn uniformly from the cube [-1, 1]³, which holds every source.

    Args:
        target: (N, 3) points in the normalised frame.
        percent: outliers in percent of N, >= 0; rounded down to whole points.
        rng: draws the outliers.

    Returns:
        The (M, 3) float32 points, targets first, and (M,) bool, True at the targets; M = N +
        floor(N · percent / 100).

    Raises:
        DataError: ``target`` is not (N, 3) or not finite.
        ConfigError: ``percent`` is negative or not a finite number.
    """
    target = _checked(target)
    percent = _amount(percent, "percentage of outliers")
    outliers = rng.uniform(-1.0, 1.0, (math.floor(len(target) * percent / 100), 3))
    points = np.concatenate([target, outliers]).astype(np.float32)
    return points, np.arange(len(points)) < len(target)


def make_variant(pairs: PairSet, condition: str, level: float, seed: int) -> Variant:
    """Corrupt the targets of pairs.

    The draw of a pair is keyed by seed, its name, condition and level, so it is the same whichever
    other pairs there are.

    Args:
        pairs: at least one pair.
        condition: ``noise`` or ``outliers``.
        level: standard deviation in the normalised frame, or percent of outliers; > 0.
        seed: >= 0.

    Raises:
        ConfigError: unknown condition, or an unusable level.
        DataError: no pairs.
    """
    if condition not in ("noise", "outliers"):
        raise ConfigError(f"Unknown condition {condition!r}; expected noise or outliers.")
    if level is None or not level > 0:
        raise ConfigError(f"The level of {condition} must be above 0, found {level!r}.")
    if len(pairs) == 0:
        raise DataError(f"There are no pairs to add {condition} to.")
    targets, inliers = [], []
    for name, target in zip(pairs.name, pairs.target, strict=True):
        rng = keyed_rng(seed, str(name), condition, float(level))
        if condition == "noise":
            targets.append(gaussian_noise(target, level, rng))
            inliers.append(np.ones(len(target), dtype=bool))
        else:
            corrupted, inlier = add_outliers(target, level, rng)
            targets.append(corrupted)
            inliers.append(inlier)
    return Variant(condition, float(level), np.stack(targets), np.stack(inliers), pairs.name)


def _checked(target: np.ndarray) -> np.ndarray:
    target = np.asarray(target)
    if target.ndim != 2 or target.shape[1] != 3 or len(target) == 0:
        raise DataError(f"Expected a target of shape (N, 3), found {target.shape}.")
    if not np.isfinite(target).all():
        raise DataError("The target holds NaN or infinite coordinates.")
    return target


def _amount(value: float, what: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float | np.number):
        raise ConfigError(f"The {what} must be a number, found {value!r}.")
    if not (math.isfinite(value) and value >= 0):
        raise ConfigError(f"The {what} must be finite and not negative, found {value!r}.")
    return float(value)
