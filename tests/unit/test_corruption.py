import numpy as np
import pytest

from dine.data.corruption import add_outliers, gaussian_noise
from dine.errors import ConfigError, DataError

pytestmark = pytest.mark.numerical


@pytest.fixture
def target():
    return np.random.default_rng(0).uniform(-0.5, 0.5, (2000, 3)).astype(np.float32)


def rng(seed=1):
    return np.random.default_rng(seed)


def test_noise_has_the_asked_spread_in_every_coordinate(target):
    noise = gaussian_noise(target, 0.04, rng()) - target
    np.testing.assert_allclose(noise.std(axis=0), 0.04, rtol=0.06)
    np.testing.assert_allclose(noise.mean(axis=0), 0, atol=0.004)
    assert abs(np.corrcoef(noise.T)[np.triu_indices(3, 1)]).max() < 0.08
    assert np.abs(noise).max() > 0.12  # normal, not bounded at a few sigma


def test_noise_is_reproducible_float32_and_leaves_the_target_alone(target):
    before = target.copy()
    noisy = gaussian_noise(target, 0.03, rng())
    assert noisy.dtype == np.float32
    np.testing.assert_array_equal(noisy, gaussian_noise(target, 0.03, rng()))
    assert not np.array_equal(noisy, gaussian_noise(target, 0.03, rng(2)))
    np.testing.assert_array_equal(target, before)
    np.testing.assert_array_equal(gaussian_noise(target, 0, rng()), target)


@pytest.mark.parametrize(("count", "percent", "added"), [(1024, 5, 51), (100, 45, 45), (10, 9, 0)])
def test_outliers_are_appended_and_counted_downwards(target, count, percent, added):
    points, inlier = add_outliers(target[:count], percent, rng())
    assert points.shape == (count + added, 3)
    assert points.dtype == np.float32
    assert inlier.dtype == bool
    np.testing.assert_array_equal(points[:count], target[:count])
    assert inlier[:count].all()
    assert not inlier[count:].any()


def test_outliers_fill_the_cube_evenly(target):
    points, inlier = add_outliers(target, 300, rng())
    outliers = points[~inlier]
    assert np.abs(outliers).max() <= 1
    octant = (outliers > 0) @ [1, 2, 4]
    np.testing.assert_allclose(np.bincount(octant, minlength=8) / len(outliers), 1 / 8, atol=0.02)
    np.testing.assert_allclose(outliers.std(axis=0), 1 / np.sqrt(3), rtol=0.03)


@pytest.mark.parametrize("corrupt", [gaussian_noise, add_outliers])
def test_unusable_arguments_are_refused(target, corrupt):
    for amount in (-0.1, np.nan, np.inf):
        with pytest.raises(ConfigError, match="finite and not negative"):
            corrupt(target, amount, rng())
    for amount in (None, "5", True):
        with pytest.raises(ConfigError, match="must be a number"):
            corrupt(target, amount, rng())
    for shape in ((0, 3), (5, 2), (5,), (1, 5, 3)):
        with pytest.raises(DataError, match="shape"):
            corrupt(np.zeros(shape), 1, rng())
    broken = target.copy()
    broken[3, 1] = np.nan
    with pytest.raises(DataError, match="NaN"):
        corrupt(broken, 1, rng())
