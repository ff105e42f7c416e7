"""One set of checks for every registered prior, and closed forms for each."""

import math

import numpy as np
import pytest
import torch
from sklearn.covariance import shrunk_covariance

from dine.errors import CheckpointError, ConfigError, DataError
from dine.priors import PRIORS, load_prior

POINTS = 20
QUICK = {"pca": {"components": 6}, "flow": {"steps": 60, "hidden": 16, "transforms": 3}}


def smooth_fields(count, seed=0):
    """Fields with a few global modes, so that every prior has something to learn."""
    rng = np.random.default_rng(seed)
    modes = np.random.default_rng(42).normal(size=(4, POINTS, 3))
    return 0.1 * np.einsum("km,mnd->knd", rng.normal(size=(count, 4)), modes) + 0.02


def fitted(name, count=40):
    return PRIORS.get(name).fit(smooth_fields(count), seed=3, **QUICK.get(name, {}))


@pytest.mark.parametrize("name", PRIORS.names())
def test_shapes_gradients_and_freezing(name):
    prior = fitted(name).double()
    fields = torch.from_numpy(smooth_fields(3, seed=5)).requires_grad_()
    penalty = prior.penalty(fields)
    assert penalty.shape == (3,)
    assert prior.log_prob(fields).shape == (3,)
    assert prior.sample(4, torch.Generator().manual_seed(0)).shape == (4, POINTS, 3)
    assert not any(p.requires_grad for p in prior.parameters())
    assert torch.autograd.gradcheck(prior.penalty, (fields,), atol=1e-6)
    # One field's penalty does not depend on its neighbours in the batch.
    assert torch.allclose(penalty[1:2], prior.penalty(fields[1:2]))


@pytest.mark.parametrize("name", PRIORS.names())
def test_penalty_is_minus_log_probability_up_to_scale_and_constant(name):
    prior = fitted(name).double()
    fields = torch.from_numpy(smooth_fields(5, seed=6))
    penalty, log_prob = prior.penalty(fields), prior.log_prob(fields)
    slope = (penalty[1:] - penalty[0]) / (log_prob[1:] - log_prob[0])
    assert torch.allclose(slope, slope[0].expand_as(slope))
    assert slope[0] < 0


@pytest.mark.parametrize("name", PRIORS.names())
def test_likely_fields_cost_less_than_unlikely_ones(name):
    prior = fitted(name)
    likely = torch.from_numpy(smooth_fields(8, seed=7)).float()
    assert (prior.penalty(likely) < prior.penalty(10 * likely)).all()


@pytest.mark.parametrize("name", PRIORS.names())
def test_save_and_load(name, tmp_path):
    prior = fitted(name)
    prior.save(tmp_path / "prior.safetensors", seed=3)
    again = load_prior(tmp_path / "prior.safetensors")
    fields = torch.from_numpy(smooth_fields(3, seed=8)).float()
    assert torch.equal(prior.penalty(fields), again.penalty(fields))
    assert again.notes == prior.notes
    fitted(name).save(tmp_path / "twice.safetensors", seed=3)
    assert (tmp_path / "twice.safetensors").read_bytes() == (
        tmp_path / "prior.safetensors"
    ).read_bytes()


@pytest.mark.parametrize("name", PRIORS.names())
def test_bad_fields(name):
    cls = PRIORS.get(name)
    with pytest.raises(DataError, match="at least 2"):
        cls.fit(np.zeros((1, POINTS, 3)))
    with pytest.raises(DataError, match=r"\(K, N, 3\)"):
        cls.fit(np.zeros((5, POINTS)))
    with pytest.raises(DataError, match="NaN"):
        cls.fit(np.full((5, POINTS, 3), np.nan))


def test_pca_penalty_follows_the_papers_equations():
    fields = smooth_fields(30) + 0.01 * np.random.default_rng(1).normal(size=(30, POINTS, 3))
    prior = PRIORS.get("pca").fit(fields, components=5).double()
    flat = fields.reshape(30, -1)
    mu, sigma = flat.mean(0), flat.std(0)
    normalised = (flat - mu) / (sigma + 1e-6)
    _, _, rows = np.linalg.svd(normalised, full_matrices=False)
    z = normalised @ rows[:5].T
    covariance = np.cov(z.T, bias=True)
    regular = 0.95 * covariance + 0.05 * np.trace(covariance) / 5 * np.eye(5) + 1e-3 * np.eye(5)
    assert np.allclose(shrunk_covariance(covariance, 0.05) + 1e-3 * np.eye(5), regular)
    new = smooth_fields(4, seed=9)
    z_new = ((new.reshape(4, -1) - mu) / (sigma + 1e-6)) @ rows[:5].T
    expected = np.einsum("bi,ij,bj->b", z_new, np.linalg.inv(regular), z_new)
    found = prior.penalty(torch.from_numpy(new)).numpy()
    assert np.allclose(found, expected, rtol=1e-4)


def test_pca_samples_have_the_fitted_covariance():
    prior = fitted("pca").double()
    samples = prior.sample(20000, torch.Generator().manual_seed(1))
    z = prior.latent(samples)
    assert torch.allclose(z.T.cov(), prior.covariance, atol=0.05 * prior.covariance.max())
    assert math.isclose(prior.penalty(samples).mean(), z.shape[1], rel_tol=0.05)


def test_pca_with_few_samples_reduces_and_records_it(caplog):
    prior = PRIORS.get("pca").fit(smooth_fields(5), components=64)
    assert prior.shape["components"] == 4
    assert prior.notes["components_requested"] == 64
    assert "4 principal components" in caplog.text


def test_pca_refuses_another_number_of_points_and_equal_fields():
    with pytest.raises(DataError, match="20 points"):
        fitted("pca").penalty(torch.zeros(1, POINTS + 1, 3))
    with pytest.raises(DataError, match="equal"):
        PRIORS.get("pca").fit(np.ones((5, POINTS, 3)))


def test_flow_density_integrates_to_one():
    prior = fitted("flow").double()
    scale = prior.scale.max().item()
    axis = torch.linspace(-8 * scale, 8 * scale, 61, dtype=torch.float64)
    grid = torch.cartesian_prod(axis, axis, axis) + prior.mean
    mass = prior._log_density(grid).exp().sum() * (axis[1] - axis[0]) ** 3
    assert math.isclose(mass, 1, abs_tol=0.02)


def test_flow_penalty_skips_masked_points():
    prior = fitted("flow")
    fields = torch.from_numpy(smooth_fields(2, seed=4)).float()
    mask = torch.ones(2, POINTS, dtype=torch.bool)
    mask[:, 12:] = False
    expected = prior.penalty(fields[:, :12])
    fields[:, 12:] = 100
    assert torch.allclose(prior.penalty(fields, mask), expected, atol=1e-5)


def test_flow_learns_the_data_better_than_an_unfitted_flow():
    fields = smooth_fields(60)
    quick = PRIORS.get("flow").fit(fields, steps=1, hidden=32, transforms=3)
    longer = PRIORS.get("flow").fit(fields, steps=150, hidden=32, transforms=3)
    assert longer.notes["nll_held_out"] < quick.notes["nll_held_out"] - 0.1


def test_damaged_and_foreign_files(tmp_path):
    path = tmp_path / "prior.safetensors"
    fitted("pca").save(path)
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(CheckpointError, match="truncated"):
        load_prior(path)
    with pytest.raises(CheckpointError, match="does not exist"):
        load_prior(tmp_path / "nothing")


def test_unknown_prior():
    with pytest.raises(ConfigError, match="expected one of flow, pca"):
        PRIORS.get("pcaa")
    with pytest.raises(ConfigError, match="could not be imported"):
        PRIORS.get("no_such_module:Prior")
