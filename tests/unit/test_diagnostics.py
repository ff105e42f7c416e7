"""Diagnostics: every prior gets its numbers, and they tell good priors from bad ones."""

import numpy as np
import pytest
import torch

from dine.errors import ConfigError, DataError
from dine.priors import PRIORS
from dine.priors.base import Prior
from dine.priors.diagnostics import diagnose

pytestmark = pytest.mark.numerical
POINTS = 24
QUICK = {
    "pca": {"components": 6},
    "pca_residual": {"components": 6},
    "flow": {"steps": 5, "hidden": 8, "transforms": 2},
    "latent_flow": {"components": 6, "steps": 30, "hidden": 8, "transforms": 2},
    "gaussian_process": {"widths": [0.5, 1.0]},
    "pca_process": {"components": 6, "widths": [0.5, 1.0]},
}
FIELD = {"pca_residual", "pca_process", "latent_flow", "gaussian_process", "smoothness", "flow"}
SPAN = {"pca", "pca_residual", "pca_process", "latent_flow"}


@pytest.fixture(scope="module")
def data():
    """Noisy fields of a few modes on two sources, in the order train, held out."""
    rng = np.random.default_rng(0)
    clouds = rng.normal(size=(2, POINTS, 3))
    clouds /= np.linalg.norm(clouds, axis=2, keepdims=True)
    modes = rng.normal(size=(4, 3, 3))
    source = clouds[np.arange(60) % 2]
    fields = 0.1 * np.einsum("km,mcd,knc->knd", rng.normal(size=(60, 4)), modes, source)
    fields += 0.02 * rng.normal(size=fields.shape)
    return fields[:40], source[:40], fields[40:], source[40:]


def results(name, data):
    train, train_source, held, held_source = data
    prior = PRIORS.get(name).fit(train, source=train_source, **QUICK.get(name, {}))
    found = diagnose(prior, held, held_source, train, seed=1, train_sources=train_source)
    return prior, found


@pytest.mark.parametrize("name", PRIORS.names())
def test_every_prior_has_its_numbers(name, data):
    _, found = results(name, data)
    present = {key for key, value in found.items() if value is not None}
    expected = {"nll", "specificity"}
    expected |= {"nll_per_coordinate"} if name in FIELD else {"nll_per_component"}
    if name in SPAN:
        expected |= {"generalisation", "in_span", "residual"}
    if name == "gaussian_process":
        expected |= {"generalisation"}
    assert present == expected
    assert all(np.isfinite(found[key]) for key in present)
    assert found["specificity"] > 0


def test_numbers_are_the_naive_ones(data):
    prior, found = results("pca_residual", data)
    train, _, held, _ = data
    flat = held.reshape(len(held), -1)
    mean, scale, basis, covariance = (
        getattr(prior, key).double().numpy() for key in ("mean", "scale", "basis", "covariance")
    )
    unit = (flat - mean) / scale
    latent = unit @ basis.T
    closest = (mean + scale * (latent @ basis)).reshape(held.shape)
    distance = np.linalg.norm(closest - held, axis=2).mean()
    assert np.isclose(found["generalisation"], distance, rtol=1e-4)
    assert np.isclose(found["residual"], np.square(unit - latent @ basis).mean(), rtol=1e-4)
    energy = np.einsum("ki,ij,kj->k", latent, np.linalg.inv(covariance), latent).mean() / 6
    assert np.isclose(found["in_span"], energy, rtol=1e-3)
    samples = prior.sample(50, torch.Generator().manual_seed(1)).numpy()
    nearest = [np.linalg.norm(train - s, axis=2).mean(axis=1).min() for s in samples]
    assert np.isclose(found["specificity"], np.mean(nearest), rtol=1e-4)


def test_a_wrong_prior_is_told_from_a_right_one(data):
    train, _, held, held_source = data
    good = PRIORS.get("pca_residual").fit(train, components=6)
    scrambled = np.random.default_rng(1).permuted(train.reshape(40, -1), axis=0)
    bad = PRIORS.get("pca_residual").fit(scrambled.reshape(train.shape), components=6)
    found = [diagnose(p, held, held_source, train, seed=0) for p in (good, bad)]
    for key in ("nll_per_coordinate", "generalisation", "residual", "specificity"):
        assert found[0][key] < found[1][key]
    again = diagnose(good, held, held_source, train, seed=0)
    assert again == found[0]


def test_sources_of_the_fit_are_optional_but_must_fit(data):
    train, source, held, held_source = data
    prior = PRIORS.get("smoothness").fit(train, source=source)
    assert diagnose(prior, held, held_source, train, seed=0)["specificity"] > 0
    with pytest.raises(DataError, match="one source point per displacement"):
        diagnose(prior, held, held_source[:, 1:], train, seed=0)
    with pytest.raises(ConfigError, match="none were given"):
        diagnose(prior, held, None, train, seed=0)


class Plain(Prior):
    """A prior of one's own with nothing but a density."""

    registered_name = "plain"

    def log_prob(self, displacement, source=None):
        return -displacement.square().sum((1, 2))


def test_a_prior_of_ones_own_gets_what_it_allows(data):
    train, _, held, held_source = data
    found = diagnose(Plain(), held, held_source, train, seed=0)
    assert found.pop("nll") == pytest.approx(np.square(held).sum((1, 2)).mean(), rel=1e-5)
    assert all(value is None for value in found.values())
