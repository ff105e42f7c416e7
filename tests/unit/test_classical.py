"""Classical methods: what they promise, on small spheres deformed by known fields."""

import sys

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dine.classical.bcpd import Parameters, bcpd
from dine.classical.methods import CLASSICAL
from dine.errors import ConfigError, DataError

pytestmark = pytest.mark.numerical
DEFORMABLE = ["bcpd", "cpd"]


def sphere(points=300):
    """Points spread evenly on a unit sphere (Fibonacci lattice)."""
    i = np.arange(points) + 0.5
    height = 1 - 2 * i / points
    around = np.pi * (1 + 5**0.5) * i
    radius = np.sqrt(1 - height**2)
    return np.stack([radius * np.cos(around), radius * np.sin(around), height], axis=1)


def bent(points):
    """Where a smooth field moves points of an egg: a bend and a bulge, about 0.13 long."""
    x, y, z = points.T
    field = np.stack([0.2 * z**2, 0.15 * np.sin(2 * x), 0.1 * np.exp(-4 * (y - 0.3) ** 2)], axis=1)
    return points + field


@pytest.fixture(scope="module")
def pair():
    source = sphere() * [1.0, 0.75, 0.55]
    return source, bent(source)


def mce(source, displacement, target):
    return np.linalg.norm(source + displacement - target, axis=1).mean()


@pytest.mark.parametrize("name", CLASSICAL.names())
class TestEveryMethod:
    def test_field_of_the_source(self, name, pair):
        source, target = pair
        before = source.copy()
        field = CLASSICAL.get(name)()(source.astype(np.float32), target[:250])
        assert field.shape == source.shape
        assert field.dtype == np.float64
        assert np.isfinite(field).all()
        np.testing.assert_array_equal(source, before)

    def test_deterministic(self, name, pair):
        method = CLASSICAL.get(name)()
        np.testing.assert_array_equal(method(*pair), method(*pair))

    def test_order_of_the_target_does_not_matter(self, name, pair):
        source, target = pair
        shuffled = np.random.default_rng(0).permutation(target)
        method = CLASSICAL.get(name)()
        np.testing.assert_allclose(method(source, shuffled), method(source, target), atol=1e-5)

    def test_what_is_no_cloud_is_refused(self, name, pair):
        method = CLASSICAL.get(name)()
        with pytest.raises(DataError, match="target of shape"):
            method(pair[0], pair[1][:, :2])
        with pytest.raises(DataError, match="source has coordinates"):
            method(np.full((5, 3), np.nan), pair[1])


def test_names():
    assert CLASSICAL.names() == ["bcpd", "cpd", "icp", "smooth", "unregistered"]


def test_unregistered_moves_nothing(pair):
    np.testing.assert_array_equal(CLASSICAL.get("unregistered")()(*pair), 0)


def test_icp_finds_a_small_rotation():
    rng = np.random.default_rng(0)
    # At random, since an even lattice looks the same after other turns too.
    source = rng.standard_normal((300, 3))
    source *= np.array([1.0, 0.75, 0.55]) / np.linalg.norm(source, axis=1, keepdims=True)
    turn = Rotation.from_euler("xyz", [4, -3, 5], degrees=True)
    target = turn.apply(source) + np.array([0.03, -0.02, 0.01])
    field = CLASSICAL.get("icp")()(source, rng.permutation(target))
    assert mce(source, field, target) < 1e-3


@pytest.mark.parametrize("name", DEFORMABLE)
class TestDeformable:
    def test_smooth_deformation(self, name, pair):
        source, target = pair
        field = CLASSICAL.get(name)()(source, np.random.default_rng(0).permutation(target))
        assert mce(source, field, target) < mce(source, 0, target) / 5

    def test_outliers(self, name, pair):
        source, target = pair
        rng = np.random.default_rng(0)
        noisy = np.concatenate([target, rng.uniform(-1, 1, (len(target) // 5, 3))])
        field = CLASSICAL.get(name)(outliers=0.2)(source, rng.permutation(noisy))
        assert mce(source, field, target) < mce(source, 0, target) / 2

    @pytest.mark.parametrize("wrong", [{"beta": 0}, {"lam": -1.0}, {"outliers": 1.0}])
    def test_wrong_arguments(self, name, wrong):
        with pytest.raises(ConfigError, match=next(iter(wrong))):
            CLASSICAL.get(name)(**wrong)


def test_missing_library(pair, monkeypatch):
    monkeypatch.setitem(sys.modules, "rustcpd", None)
    with pytest.raises(ConfigError, match=r'pip install "dine-registration\[classical\]"'):
        CLASSICAL.get("cpd")()(*pair)


def literal_bcpd(source, target, beta, lam, omega, rounds):
    """The paper's Fig. 2 as it stands, with full matrices and Kronecker products left out."""
    y, x = source, target
    n, m = len(y), len(x)
    kernel = np.exp(-((y[:, None] - y) ** 2).sum(2) / (2 * beta**2)) + 1e-9 * np.eye(n)
    inverse = np.linalg.inv(kernel)
    volume = np.prod(np.ptp(x, axis=0) * (m + 1) / m)
    s, R, t, v, covariance = 1.0, np.eye(3), np.zeros(3), np.zeros_like(y), np.zeros((n, n))
    moved = y
    variance = ((y[:, None] - x) ** 2).sum() / (3 * n * m)
    for _ in range(rounds):
        phi = np.exp(-((moved[:, None] - x) ** 2).sum(2) / (2 * variance))
        phi /= (2 * np.pi * variance) ** 1.5
        phi *= np.exp(-(s**2) * 3 * np.diag(covariance) / (2 * variance))[:, None]
        P = (1 - omega) / n * phi
        P = P / (omega / volume + P.sum(0))
        nu, nu_target = np.maximum(P.sum(1), 1e-20), P.sum(0)
        total = nu.sum()
        matches = P @ x / nu[:, None]
        covariance = np.linalg.inv(lam * inverse + s**2 / variance * np.diag(nu))
        back = (matches - t) @ R / s
        v = s**2 / variance * covariance @ np.diag(nu) @ (back - y)
        u = y + v
        center_x, center_u = nu @ matches / total, nu @ u / total
        spread = nu @ np.diag(covariance) / total
        S_xu = (nu[:, None] * (matches - center_x)).T @ (u - center_u) / total
        S_uu = (nu[:, None] * (u - center_u)).T @ (u - center_u) / total + spread * np.eye(3)
        left, _, right = np.linalg.svd(S_xu)
        R = left @ np.diag([1, 1, np.linalg.det(left @ right)]) @ right
        s = np.trace(R @ S_xu.T) / np.trace(S_uu)
        t = center_x - s * R @ center_u
        moved = s * u @ R.T + t
        variance = (nu_target * (x**2).sum(1)).sum() - 2 * ((P @ x) * moved).sum()
        variance = (variance + nu @ (moved**2).sum(1)) / (3 * total) + s**2 * spread
    return moved


def standardised(points):
    return (points - points.mean(0)) / np.sqrt(((points - points.mean(0)) ** 2).mean())


# After 40 rounds the mixture is narrow and only close points are compared. Of very many pairs, here
# of all, densities are in single precision until then.
@pytest.mark.parametrize("many", [False, True])
@pytest.mark.parametrize("rounds", [1, 12, 40])
def test_bcpd_does_what_the_paper_says(rounds, many, monkeypatch):
    if many:
        monkeypatch.setattr("dine.classical.bcpd._MANY", 0)
    source = standardised(sphere(120) * [1.0, 0.75, 0.55])
    target = bent(source) @ Rotation.from_euler("z", 5, degrees=True).as_matrix().T
    target = standardised(np.random.default_rng(0).permutation(target)[:110])
    expected = literal_bcpd(source, target, beta=1.5, lam=10.0, omega=0.1, rounds=rounds)
    options = Parameters(beta=1.5, lam=10.0, outliers=0.1, iterations=rounds, tolerance=1e-30)
    found = bcpd(source, target, options)
    assert found.iterations == rounds
    np.testing.assert_allclose(found.moved, expected, atol=1e-3)


def test_bcpd_finds_rotation_and_size(pair):
    source = pair[0]
    target = 1.4 * Rotation.from_euler("z", 20, degrees=True).apply(source) + [0.3, 0, -0.1]
    found = bcpd(source, target, Parameters(lam=1e6, uncertain=False))
    np.testing.assert_allclose(found.moved, target, atol=1e-2)
    assert found.sigma < 0.05


def test_bcpd_knows_points_without_a_match(pair):
    source, target = pair
    seen = target[:, 2] > -0.25
    options = Parameters(beta=1.0, lam=50.0, kappa=1.0, uncertain=False)
    found = bcpd(source, target[seen], options)
    assert found.matched[seen].mean() > 3 * found.matched[~seen].mean()


def test_bcpd_refuses_one_point():
    with pytest.raises(DataError, match="source coincide"):
        bcpd(np.ones((4, 3)), sphere(10))
