"""Kernels and their roots against naive formulae."""

import math

import numpy as np
import pytest

from dine.priors.gaussian import LinearGaussian, covariance_root, squared_exponential

pytestmark = pytest.mark.numerical
WIDTHS, AMPLITUDES, AFFINE = (0.9, 1.5), (0.2, 0.5), 0.4


def cloud(count, seed=0):
    return np.random.default_rng(seed).uniform(-1, 1, size=(count, 3))


def test_kernel_is_the_naive_formula():
    a, b = cloud(5), cloud(4, seed=1)
    found = squared_exponential(a, b, WIDTHS, AMPLITUDES, AFFINE)
    for i in range(5):
        for j in range(4):
            squared = sum((a[i, c] - b[j, c]) ** 2 for c in range(3))
            expected = AFFINE**2 * (sum(a[i, c] * b[j, c] for c in range(3)) + 1)
            for width, amplitude in zip(WIDTHS, AMPLITUDES, strict=True):
                expected += amplitude**2 * math.exp(-squared / (2 * width**2))
            assert math.isclose(found[i, j], expected, rel_tol=1e-12)


def test_root_reconstructs_the_kernel():
    points = cloud(60)
    full = squared_exponential(points, points, WIDTHS, AMPLITUDES, AFFINE)
    exact = covariance_root(points, WIDTHS, AMPLITUDES, AFFINE, tolerance=0)
    assert exact.shape == (60, 60)
    assert np.allclose(exact @ exact.T, full, atol=1e-12)
    for tolerance in (1e-2, 1e-4):
        root = covariance_root(points, WIDTHS, AMPLITUDES, AFFINE, tolerance=tolerance)
        left = np.diag(full - root @ root.T)
        assert root.shape[1] < 60
        # What is left of the diagonal bounds every other entry that is left.
        assert left.max() <= tolerance * np.diag(full).max()
        assert left.min() > -1e-12


def test_root_keeps_to_its_rank_and_to_coinciding_points():
    points = np.repeat(cloud(10), 3, axis=0)
    assert covariance_root(points, WIDTHS, AMPLITUDES, rank=7).shape == (30, 7)
    root = covariance_root(points, WIDTHS, AMPLITUDES, rank=30, tolerance=1e-10)
    assert root.shape[1] == 10
    full = squared_exponential(points, points, WIDTHS, AMPLITUDES)
    assert np.allclose(root @ root.T, full, atol=1e-9)


def test_an_affine_kernel_has_four_directions():
    root = covariance_root(cloud(50), (), (), 0.7, tolerance=1e-9)
    assert root.shape == (50, 4)


def test_a_kernel_alone_is_a_model_without_modes():
    model = LinearGaussian.of_kernel(np.ones((6, 2)))
    assert model.mean.shape == (6, 3)
    assert not model.mean.any()
    assert model.modes.shape == (0, 6, 3)
