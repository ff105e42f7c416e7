"""One set of checks for every registered prior, and closed forms for each."""

import dataclasses
import math
import os
import signal

import numpy as np
import pytest
import torch
from scipy.stats import multivariate_normal
from sklearn.covariance import shrunk_covariance

from dine.config import PriorConfig, check_arguments
from dine.errors import CheckpointError, ConfigError, DataError
from dine.geometry.graph import neighbour_graph
from dine.priors import PRIORS, LatentFlowPrior, likelihood, load_prior
from dine.priors.gaussian import squared_exponential
from dine.priors.likelihood import Unfinished
from dine.priors.sources import SourceCache, held_out_folds, source_labels
from dine.state import Interrupted, load_state

pytestmark = pytest.mark.numerical
POINTS = 20
QUICK = {
    "pca": {"components": 6},
    "pca_residual": {"components": 6},
    "flow": {"steps": 60, "hidden": 16, "transforms": 3},
    "latent_flow": {"components": 6, "steps": 30, "hidden": 8, "transforms": 2},
    "gaussian_process": {"widths": [0.5, 1.0]},
    "pca_process": {"components": 6, "widths": [0.5, 1.0]},
}
CONDITIONAL = [name for name in PRIORS.names() if PRIORS.get(name).conditional]
ANY_POINTS = [name for name in CONDITIONAL if name != "pca_process"]
GAUSSIAN = ["gaussian_process", "pca", "pca_process", "pca_residual", "smoothness"]


def cloud(points=POINTS, seed=42):
    """Points on the unit sphere."""
    points = np.random.default_rng(seed).normal(size=(points, 3))
    return points / np.linalg.norm(points, axis=1, keepdims=True)


def sources(count):
    """The same source for all fields, as an array (count, N, 3)."""
    return np.repeat(cloud()[None], count, axis=0)


def batch(count, dtype=torch.float64):
    return torch.from_numpy(sources(count)).to(dtype)


def smooth_fields(count, seed=0):
    """Fields with a few global modes, so that every prior has something to learn."""
    rng = np.random.default_rng(seed)
    modes = np.random.default_rng(42).normal(size=(4, POINTS, 3))
    return 0.1 * np.einsum("km,mnd->knd", rng.normal(size=(count, 4)), modes) + 0.02


def fitted(name, count=40):
    arguments = QUICK.get(name, {})
    return PRIORS.get(name).fit(smooth_fields(count), seed=3, source=sources(count), **arguments)


@pytest.mark.parametrize("name", PRIORS.names())
def test_shapes_gradients_and_freezing(name):
    prior = fitted(name).double()
    fields = torch.from_numpy(smooth_fields(3, seed=5)).requires_grad_()
    source = batch(3)
    penalty = prior.penalty(fields, None, source)
    assert penalty.shape == (3,)
    assert prior.log_prob(fields, source).shape == (3,)
    samples = prior.sample(4, torch.Generator().manual_seed(0), source[0])
    assert samples.shape == (4, POINTS, 3)
    assert samples.dtype == torch.float64
    assert torch.equal(samples, prior.sample(4, torch.Generator().manual_seed(0), source[0]))
    assert not any(p.requires_grad for p in prior.parameters())
    assert torch.autograd.gradcheck(
        lambda field: prior.penalty(field, None, source), (fields,), atol=1e-6
    )
    # One field's penalty does not depend on its neighbours in the batch.
    assert torch.allclose(penalty[1:2], prior.penalty(fields[1:2], None, source[1:2]))


@pytest.mark.parametrize("name", PRIORS.names())
def test_penalty_is_minus_log_probability_up_to_scale_and_constant(name):
    prior = fitted(name).double()
    fields = torch.from_numpy(smooth_fields(5, seed=6))
    penalty, log_prob = prior.penalty(fields, None, batch(5)), prior.log_prob(fields, batch(5))
    slope = (penalty[1:] - penalty[0]) / (log_prob[1:] - log_prob[0])
    assert torch.allclose(slope, slope[0].expand_as(slope))
    assert slope[0] < 0


@pytest.mark.parametrize("name", PRIORS.names())
def test_likely_fields_cost_less_than_unlikely_ones(name):
    prior = fitted(name)
    likely = torch.from_numpy(smooth_fields(8, seed=7)).float()
    source = batch(8, torch.float32)
    assert (prior.penalty(likely, None, source) < prior.penalty(10 * likely, None, source)).all()


@pytest.mark.parametrize("name", PRIORS.names())
def test_samples_are_likely(name):
    prior = fitted(name)
    source = batch(200, torch.float32)
    samples = prior.sample(200, torch.Generator().manual_seed(2), source[0])
    own = prior.penalty(samples, None, source).mean()
    assert own < prior.penalty(3 * samples, None, source).mean()


@pytest.mark.parametrize("name", PRIORS.names())
def test_save_and_load(name, tmp_path):
    prior = fitted(name)
    prior.save(tmp_path / "prior.safetensors", seed=3)
    again = load_prior(tmp_path / "prior.safetensors")
    fields = torch.from_numpy(smooth_fields(3, seed=8)).float()
    source = batch(3, torch.float32)
    assert torch.equal(prior.penalty(fields, None, source), again.penalty(fields, None, source))
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


@pytest.mark.parametrize("name", [n for n in PRIORS.names() if n != "flow"])
def test_fields_that_say_nothing(name):
    with pytest.raises(DataError, match=r"equal|zero|bends"):
        PRIORS.get(name).fit(np.zeros((20, POINTS, 3)), source=sources(20))


@pytest.mark.parametrize("name", PRIORS.names())
def test_arguments_and_their_defaults_are_the_configurations(name):
    arguments = check_arguments(PriorConfig(kind=name))
    some = next(iter(arguments))
    with pytest.raises(ConfigError, match=f"arguments of the {name} prior: `sharpness` is not a"):
        PRIORS.get(name).fit(smooth_fields(4), source=sources(4), sharpness=1)
    with pytest.raises(ConfigError, match=f"arguments of the {name} prior: `{some}`"):
        PRIORS.get(name).fit(smooth_fields(4), source=sources(4), **{some: -1})


@pytest.mark.parametrize("name", CONDITIONAL)
def test_conditional_priors_ask_for_the_source(name):
    cls = PRIORS.get(name)
    fields = smooth_fields(5)
    with pytest.raises(ConfigError, match="none were given"):
        cls.fit(fields)
    with pytest.raises(DataError, match="one source point per displacement"):
        cls.fit(fields, source=sources(4))
    with pytest.raises(DataError, match="source points hold NaN"):
        cls.fit(fields, source=np.full_like(fields, np.nan))
    prior = fitted(name)
    tensor = torch.from_numpy(fields).float()
    for call in (
        lambda: prior.penalty(tensor),
        lambda: prior.log_prob(tensor),
        lambda: prior.sample(2),
    ):
        with pytest.raises(ConfigError, match="pass them as `source`"):
            call()
    with pytest.raises(DataError, match="one source point per displacement"):
        prior.penalty(tensor, None, batch(5)[:, 1:])
    with pytest.raises(DataError, match=r"\(N, 3\)"):
        prior.sample(2, source=batch(1))


@pytest.mark.parametrize("name", ANY_POINTS)
def test_conditional_priors_take_any_points_in_any_order(name):
    prior = fitted(name).double()
    rng = np.random.default_rng(0)
    source = torch.from_numpy(cloud(33, seed=1))[None]
    field = torch.from_numpy(rng.normal(size=(1, 33, 3)))
    order = torch.from_numpy(rng.permutation(33))
    penalty = prior.penalty(field, None, source)
    assert torch.allclose(penalty, prior.penalty(field[:, order], None, source[:, order]))
    # Twice the same, with and without the kept factors, and whatever the padding holds.
    assert torch.equal(penalty, prior.penalty(field, None, source))
    mask = torch.ones(1, 40, dtype=torch.bool)
    mask[:, 33:] = False
    padding = torch.full((1, 7, 3), 100.0, dtype=torch.float64)
    padded = torch.cat([field, padding], 1).requires_grad_()
    found = prior.penalty(padded, mask, torch.cat([source, padding], 1))
    assert torch.allclose(found, penalty)
    found.sum().backward()
    assert not padded.grad[:, 33:].any()


@pytest.mark.parametrize("name", [n for n in PRIORS.names() if n not in CONDITIONAL])
def test_the_other_priors_ignore_the_source(name):
    prior = PRIORS.get(name).fit(smooth_fields(40), seed=3, **QUICK[name])
    field = torch.from_numpy(smooth_fields(2, seed=1)).float()
    assert torch.equal(prior.penalty(field), prior.penalty(field, None, batch(2)))
    assert torch.equal(prior.log_prob(field), prior.log_prob(field, batch(2)))


@pytest.mark.parametrize("name", PRIORS.names())
def test_linear_gaussian_models_have_the_covariance_of_the_samples(name):
    prior = fitted(name).double()
    if name not in GAUSSIAN:
        with pytest.raises(ConfigError, match="not Gaussian"):
            prior.gaussian(cloud())
        return
    model = prior.gaussian(cloud())
    modes = model.modes.reshape(-1, 3 * POINTS)
    kernel = np.kron(model.kernel @ model.kernel.T, np.eye(3))
    covariance = modes.T @ modes + kernel
    if "process" in name:  # its smooth part, without the noise of the samples
        noise = getattr(prior, "process", prior).noise.item()
        covariance += noise**2 * np.eye(3 * POINTS)
    samples = prior.sample(20000, torch.Generator().manual_seed(1), batch(1)[0]).flatten(1).numpy()
    if name == "pca_residual":  # its span
        outside = prior.normalised(torch.from_numpy(samples).view(-1, POINTS, 3)).numpy()
        outside -= outside @ prior.basis.T.numpy() @ prior.basis.numpy()
        samples = samples - prior.scale.numpy() * outside
    assert np.abs(np.cov(samples.T) - covariance).max() < 0.05 * covariance.max()
    assert np.abs(samples.mean(0) - model.mean.ravel()).max() < 0.05 * np.sqrt(covariance.max())


@pytest.mark.parametrize("count", [30, 90])  # fewer and more than coordinates
def test_pca_penalty_follows_the_papers_equations(count):
    noise = 0.01 * np.random.default_rng(1).normal(size=(count, POINTS, 3))
    fields = smooth_fields(count) + noise
    prior = PRIORS.get("pca").fit(fields, components=5).double()
    flat = fields.reshape(count, -1)
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


def residual_fields(count, noise, seed=0):
    """Draws of probabilistic PCA: three modes and white noise, on coordinates of unit variance."""
    rng = np.random.default_rng(seed)
    modes = np.linalg.qr(np.random.default_rng(7).normal(size=(3 * POINTS, 3)))[0]
    fields = rng.normal(size=(count, 3)) @ modes.T * math.sqrt(POINTS * (1 - noise**2))
    return (fields + noise * rng.normal(size=fields.shape)).reshape(count, POINTS, 3)


def test_pca_residual_is_the_dense_gaussian():
    fields = residual_fields(50, 0.3)
    prior = PRIORS.get("pca_residual").fit(fields, components=3).double()
    scale, basis = prior.scale.numpy(), prior.basis.numpy()
    left = np.eye(3 * POINTS) - basis.T @ basis
    unit = basis.T @ prior.covariance.numpy() @ basis + prior.variance.item() * left
    dense = multivariate_normal(prior.mean.numpy(), scale[:, None] * unit * scale)
    new = residual_fields(6, 0.4, seed=1)
    log_prob = prior.log_prob(torch.from_numpy(new)).numpy()
    assert np.allclose(log_prob, dense.logpdf(new.reshape(6, -1)), rtol=1e-5)
    samples = prior.sample(20000, torch.Generator().manual_seed(0)).flatten(1).numpy()
    assert np.abs(np.cov(samples.T) - dense.cov).max() < 0.05 * np.abs(dense.cov).max()
    # Twice the negative log density of a field of its own is 3N on average.
    assert math.isclose(
        prior.penalty(torch.from_numpy(samples).view(-1, POINTS, 3)).mean(), 60, rel_tol=0.02
    )


def test_pca_residual_costs_what_pca_does_not_see():
    fields = residual_fields(50, 0.3)
    pca, residual = (PRIORS.get(n).fit(fields, components=3) for n in ("pca", "pca_residual"))
    inside = pca.sample(1, torch.Generator().manual_seed(0))
    unit = torch.randn(3 * POINTS, generator=torch.Generator().manual_seed(1))
    off = (pca.scale * (unit - pca.basis.T @ (pca.basis @ unit))).view(1, POINTS, 3)
    assert torch.allclose(pca.penalty(inside), pca.penalty(inside + off), rtol=1e-4)
    assert torch.allclose(pca.penalty(inside), residual.penalty(inside), rtol=1e-4)
    assert residual.penalty(inside + off) > residual.penalty(inside) + 50


def test_pca_residual_variance_is_that_of_fields_held_out():
    fields = residual_fields(400, 0.3)
    many = PRIORS.get("pca_residual").fit(fields, components=3)
    noise = np.mean(0.3**2 / fields.var(axis=0))
    assert math.isclose(many.notes["residual_variance"], noise, rel_tol=0.1)
    # As many components as the fields allow leave nothing of the fields themselves.
    few = PRIORS.get("pca_residual").fit(residual_fields(20, 0.3), components=19)
    assert few.notes["residual_variance_in_sample"] < 1e-6
    assert 0.1 < few.notes["residual_variance"] < 0.6
    assert few.variance.item() == pytest.approx(few.notes["residual_variance"])
    floor = fitted("pca_residual")
    assert floor.notes["residual_variance"] < 1e-6
    assert floor.variance.item() == pytest.approx(1e-4)
    assert PRIORS.get("pca_residual").fit(smooth_fields(2)).variance == 1


def test_fields_of_a_source_are_held_out_together():
    labels = source_labels(np.repeat(np.random.default_rng(0).normal(size=(6, 4, 3)), 5, 0), 30)
    assert labels.tolist() == np.repeat(np.arange(6), 5).tolist()
    folds = held_out_folds(labels, 4, seed=1)
    assert np.array_equal(np.sum(folds, axis=0), np.ones(30))
    for held in folds:
        assert not set(labels[held]) & set(labels[~held])
    # Fields that resemble others of their source seem predictable where those are not left out.
    kinds = np.random.default_rng(1).normal(size=(10, POINTS, 3))
    fields = np.repeat(kinds, 6, axis=0)
    fields += 0.05 * np.random.default_rng(2).normal(size=fields.shape)
    source = np.repeat(np.random.default_rng(3).normal(size=(10, POINTS, 3)), 6, axis=0)
    fit = PRIORS.get("pca_residual").fit
    apart = fit(fields, components=10).notes["residual_variance"]
    together = fit(fields, components=10, source=source).notes["residual_variance"]
    assert together > 10 * apart


def gaussian_process(amplitudes=(0.1, 0.3), affine=0.2, noise=0.05, rank=128):
    prior = PRIORS.get("gaussian_process")(widths=[0.4, 1.0], rank=rank).double()
    prior.amplitudes.copy_(torch.tensor(amplitudes))
    prior.affine.fill_(affine)
    prior.noise.fill_(noise)
    return prior.freeze()


def dense_kernel(prior, points):
    scales = prior.amplitudes.tolist(), prior.affine.item()
    return squared_exponential(points, points, prior.shape["widths"], *scales)


def test_gaussian_process_is_the_dense_gaussian():
    prior = gaussian_process()
    points = cloud(12)
    dense = multivariate_normal(
        cov=dense_kernel(prior, points) + prior.noise.item() ** 2 * np.eye(12)
    )
    fields = np.random.default_rng(0).normal(size=(4, 12, 3))
    expected = dense.logpdf(fields.transpose(0, 2, 1)).sum(1)
    tensor = torch.from_numpy(fields)
    source = torch.from_numpy(points)[None].expand(4, -1, -1)
    assert np.allclose(prior.log_prob(tensor, source), expected, rtol=1e-5)
    energy = np.einsum("kic,ij,kjc->k", fields, np.linalg.inv(dense.cov), fields)
    assert np.allclose(prior.penalty(tensor, None, source), energy, rtol=1e-4)
    kept = dense.cov - prior.noise.item() ** 2 * np.eye(12)
    smooth = np.einsum("ij,kjc->kic", kept @ np.linalg.inv(dense.cov), fields)
    assert np.allclose(prior.smoothed(tensor, source), smooth, atol=1e-4)
    # Points left out are integrated over, which for a Gaussian drops their rows.
    mask = torch.arange(12).expand(4, -1) % 3 > 0
    rows = np.flatnonzero(mask[0])
    part = np.linalg.inv(dense.cov[np.ix_(rows, rows)])
    energy = np.einsum("kic,ij,kjc->k", fields[:, rows], part, fields[:, rows])
    assert np.allclose(prior.penalty(tensor, mask, source), energy, rtol=1e-4)


def test_gaussian_process_of_low_rank_keeps_every_points_variance():
    prior = gaussian_process(rank=8)
    points = cloud(40)
    full = dense_kernel(prior, points)
    root = prior.gaussian(points).kernel
    assert root.shape == (40, 8)
    low = root @ root.T
    low[np.diag_indices(40)] = full.diagonal()
    low += prior.noise.item() ** 2 * np.eye(40)
    field = torch.from_numpy(np.random.default_rng(0).normal(size=(1, 40, 3)))
    expected = multivariate_normal(cov=low).logpdf(field[0].T.numpy()).sum()
    assert math.isclose(prior.log_prob(field, torch.from_numpy(points)[None]), expected)


def test_gaussian_process_recovers_its_amplitudes():
    truth = gaussian_process()
    rng = np.random.default_rng(0)
    source = rng.uniform(-1, 1, size=(60, 40, 3))
    generator = torch.Generator().manual_seed(0)
    fields = np.stack([truth.sample(1, generator, torch.from_numpy(x))[0] for x in source])
    prior = PRIORS.get("gaussian_process").fit(fields, source=source, widths=[0.4, 1.0])
    assert np.allclose(prior.amplitudes, truth.amplitudes, rtol=0.3)
    assert math.isclose(prior.affine, truth.affine, rel_tol=0.3)
    assert math.isclose(prior.noise, truth.noise, rel_tol=0.15)
    held = np.stack([truth.sample(1, generator, torch.from_numpy(x))[0] for x in source])
    nll = -prior.log_prob(torch.from_numpy(held).float(), torch.from_numpy(source)).mean() / 120
    assert math.isclose(nll, prior.notes["nll_per_coordinate"], abs_tol=0.05)
    few = PRIORS.get("gaussian_process").fit(fields, source=source, points=20, sources=30)
    assert (few.notes["points_used"], few.notes["sources_used"]) == (20, 30)


def test_the_least_noise_is_kept_to():
    fields = cloud()[None] * np.linspace(-0.1, 0.1, 10)[:, None, None]
    fit = PRIORS.get("gaussian_process").fit
    assert fit(fields, source=sources(10)).noise.item() == pytest.approx(1e-3)
    assert fit(fields, source=sources(10), least_noise=0.02).noise.item() == pytest.approx(0.02)


def rough_fields(count, seed=0):
    """Three modes, equally strong at all coordinates, and a smooth process with noise."""
    process = gaussian_process((0.02, 0.0), affine=0.0, noise=0.005)
    strength = np.random.default_rng(seed).normal(size=(count, 3))
    modes = np.random.default_rng(42).choice([-1, 1], size=(3, POINTS, 3))
    generator = torch.Generator().manual_seed(seed)
    rough = process.sample(count, generator, torch.from_numpy(cloud())).numpy()
    return 0.1 * np.einsum("km,mnd->knd", strength, modes) + rough


def pca_process(count=60, **arguments):
    arguments = {"components": 3, "widths": [0.4, 1.0], "least_noise": 5e-3, **arguments}
    fit = PRIORS.get("pca_process").fit
    return fit(rough_fields(count), source=sources(count), **arguments).double()


def dense_sum(prior, points, noise=True):
    """Covariance of all 3N coordinates by the formula, with the coordinates of a point adjacent."""
    scale, basis = prior.scale.numpy(), prior.basis.numpy()
    span = scale[:, None] * (basis.T @ prior.covariance.numpy() @ basis) * scale
    kernel = dense_kernel(prior.process, points)
    if noise:
        kernel = kernel + prior.process.noise.item() ** 2 * np.eye(len(points))
    return span + np.kron(kernel, np.eye(3))


def test_pca_process_is_the_dense_gaussian():
    prior = pca_process()
    new, points = rough_fields(6, seed=1), cloud()
    mean, covariance = prior.mean.numpy(), dense_sum(prior, points)
    tensor, source = torch.from_numpy(new), batch(6)
    expected = multivariate_normal(mean, covariance).logpdf(new.reshape(6, -1))
    assert np.allclose(prior.log_prob(tensor, source), expected, rtol=1e-5)
    deviation = new.reshape(6, -1) - mean
    energy = np.einsum("ki,ij,kj->k", deviation, np.linalg.inv(covariance), deviation)
    assert np.allclose(prior.penalty(tensor, None, source), energy, rtol=1e-4)
    smooth = dense_sum(prior, points, noise=False) @ np.linalg.solve(covariance, deviation.T)
    found = prior.smoothed(tensor, source).flatten(1).numpy()
    assert np.allclose(found, mean + smooth.T, atol=1e-4)
    # In float32, too, although the components are far stronger than the noise.
    single = prior.float().penalty(tensor.float(), None, source.float())
    assert np.allclose(single, energy, rtol=1e-3)


def test_pca_process_integrates_masked_points_out():
    prior = pca_process()
    points = cloud()
    points[1] = points[0]
    new, mean, covariance = rough_fields(3, seed=1), prior.mean.numpy(), dense_sum(prior, points)
    mask = torch.ones(3, POINTS, dtype=torch.bool)
    mask[0, ::3] = False
    # The same points are left, but not the same components of them.
    mask[1, 0] = False
    mask[2, 1] = False
    tensor = torch.from_numpy(new)
    tensor[~mask] = 100.0
    source = torch.from_numpy(points)[None].expand(3, -1, -1)
    for _ in range(2):
        found = prior.penalty(tensor, mask, source)
        for field, valid, value in zip(new, mask.numpy(), found, strict=True):
            rows = np.repeat(valid, 3)
            deviation = field.ravel()[rows] - mean[rows]
            part = covariance[np.ix_(rows, rows)]
            assert math.isclose(value, deviation @ np.linalg.solve(part, deviation), rel_tol=1e-4)


def test_pca_process_as_modes_and_kernel_has_the_same_covariance():
    prior = pca_process()
    model = prior.gaussian(cloud())
    modes = model.modes.reshape(3, -1)
    found = modes.T @ modes + np.kron(model.kernel @ model.kernel.T, np.eye(3))
    expected = dense_sum(prior, cloud(), noise=False)
    assert np.allclose(found, expected, atol=1e-3 * expected.max())
    assert np.allclose(model.mean.ravel(), prior.mean.numpy())
    with pytest.raises(DataError, match="source of 21"):
        prior.gaussian(cloud(POINTS + 1))


def test_pca_process_without_components_is_the_process():
    prior = pca_process()
    prior.mean.zero_()
    prior.scale.zero_()
    fields, source = torch.from_numpy(rough_fields(3, seed=2)), batch(3)
    process = prior.process
    assert torch.allclose(
        prior.penalty(fields, None, source), process.penalty(fields, None, source)
    )
    assert torch.allclose(prior.log_prob(fields, source), process.log_prob(fields, source))
    assert torch.allclose(prior.smoothed(fields, source), process.smoothed(fields, source))
    drawn = prior.sample(3, torch.Generator().manual_seed(0), source[0])
    assert np.abs(drawn).max() > 0


def test_pca_process_learns_what_components_miss():
    many = pca_process(count=200)
    notes = many.notes["process"]
    assert np.hypot(*notes["amplitudes"]) == pytest.approx(0.02, rel=0.1)
    # The three rough modes take their share of 60 directions from the smooth part: that is noise.
    assert notes["noise"] == pytest.approx(math.hypot(5e-3, 0.02 * math.sqrt(3 / 60)), rel=0.1)
    # As many components as the fields allow leave nothing of the fields of the fit.
    few = pca_process(count=16, components=15).notes["process"]
    assert np.hypot(*few["amplitudes"]) > 0.01
    # Better than either part on fields that neither has seen.
    held = torch.from_numpy(rough_fields(40, seed=3))
    train = rough_fields(60)
    residual = PRIORS.get("pca_residual").fit(train, components=3).double()
    process = PRIORS.get("gaussian_process").fit(train, source=sources(60)).double()
    own = pca_process().log_prob(held, batch(40)).mean()
    assert own > residual.log_prob(held).mean() + 5
    assert own > process.log_prob(held, batch(40)).mean() + 5


def test_pca_process_holds_the_fields_of_a_source_out_together():
    kinds = rough_fields(10)
    fields = np.repeat(kinds, 6, axis=0)
    fields += 0.002 * np.random.default_rng(2).normal(size=fields.shape)
    source = np.repeat(np.random.default_rng(3).normal(size=(10, POINTS, 3)), 6, axis=0)
    fit = PRIORS.get("pca_process").fit
    together = fit(fields, source=source, components=10).notes["process"]
    assert np.linalg.norm([*together["amplitudes"], together["affine"], together["noise"]]) > 0.01
    assert together["sources"] == 10
    apart = fit(fields, source=sources(60), components=10).notes["process"]
    assert np.linalg.norm([*apart["amplitudes"], apart["affine"], apart["noise"]]) < 0.005


@pytest.mark.parametrize("count", [2, 3])
def test_pca_process_of_very_few_fields(count):
    fields = rough_fields(count)
    prior = PRIORS.get("pca_process").fit(fields, source=sources(count))
    assert prior.shape["components"] == count - 1
    assert prior.notes["process"]["samples"] == count
    found = prior.log_prob(torch.from_numpy(fields).float(), batch(count, torch.float32))
    assert found.isfinite().all()


def test_pca_process_of_fields_that_components_hold_entirely():
    mode = np.zeros((POINTS, 3))
    mode[0, 0] = 1.0
    fields = np.array([1.0, -1.0, 1.0, -1.0])[:, None, None] * mode
    prior = PRIORS.get("pca_process").fit(fields, source=sources(4), folds=2)
    assert prior.process.scales()[1:] == pytest.approx((0.0, 1e-3))
    assert prior.gaussian(cloud()).kernel.shape == (POINTS, 0)
    assert prior.penalty(torch.from_numpy(fields).float(), None, batch(4)).isfinite().all()


def test_pca_process_prepares_a_source_once(monkeypatch):
    prior = pca_process()
    made = []
    original = prior._factorised
    monkeypatch.setattr(prior, "_factorised", lambda *a: made.append(len(a[0])) or original(*a))
    fields = torch.from_numpy(rough_fields(3, seed=1))
    assert torch.equal(prior.penalty(fields, None, batch(3)), prior.penalty(fields, None, batch(3)))
    assert made == [POINTS]
    assert torch.equal(
        prior.penalty(fields, torch.ones(3, POINTS, dtype=torch.bool), batch(3)),
        prior.penalty(fields, None, batch(3)),
    )
    assert made == [POINTS]


def test_smoothness_is_the_naive_double_loop():
    fields = smooth_fields(12)
    prior = PRIORS.get("smoothness").fit(fields, source=sources(12), neighbours=4, anchor=0.1)
    points = cloud()
    near = np.linalg.norm(points[:, None] - points, axis=2).argsort(axis=1)[:, 1:5]

    def terms(field):
        stretch = []
        for i in range(POINTS):
            for j in range(i):
                if i in near[j] or j in near[i]:
                    moved = np.sum((field[i] - field[j]) ** 2)
                    stretch.append(moved / np.sum((points[i] - points[j]) ** 2))
        return np.mean(stretch), np.mean(np.sum(field**2, axis=1))

    rough, far = np.array([terms(field) for field in fields]).T
    expected = 64 * (0.9 * rough / rough.mean() + 0.1 * far / far.mean())
    prior = prior.double()
    found = prior.penalty(torch.from_numpy(fields), None, batch(12)).numpy()
    assert np.allclose(found, expected, rtol=1e-5)
    assert math.isclose(found.mean(), 64, rel_tol=1e-5)
    # A translation costs what its magnitude does.
    shift = torch.full((1, POINTS, 3), 0.3, dtype=torch.float64)
    anchor = 64 * 0.1 * 0.27 / far.mean()
    assert math.isclose(prior.penalty(shift, None, batch(1)), anchor, rel_tol=1e-5)


def test_smoothness_is_a_proper_gaussian():
    prior = fitted("smoothness").double()
    covariance = np.linalg.inv(prior.precision(cloud()))
    fields = smooth_fields(4, seed=1)
    expected = multivariate_normal(cov=covariance).logpdf(fields.transpose(0, 2, 1)).sum(1)
    assert np.allclose(prior.log_prob(torch.from_numpy(fields), batch(4)), expected)


def test_smoothness_bears_coinciding_and_single_points():
    points = cloud()
    points[1] = points[0]
    assert len(neighbour_graph(points, 10).head)
    source = np.repeat(points[None], 12, axis=0)
    prior = PRIORS.get("smoothness").fit(smooth_fields(12), source=source)
    field = torch.from_numpy(smooth_fields(1)).float()
    assert prior.penalty(field, None, torch.from_numpy(points)[None]).isfinite().all()
    mask = torch.zeros(1, POINTS, dtype=torch.bool)
    mask[0, 3] = True
    assert prior.penalty(field, mask, torch.from_numpy(points)[None]).isfinite().all()


def test_latent_flow_starts_as_probabilistic_pca():
    pca = fitted("pca_residual")
    prior = LatentFlowPrior(points=POINTS, components=6, transforms=3, hidden=8)
    prior.load_state_dict(pca.state_dict(), strict=False)
    fields = torch.from_numpy(smooth_fields(4, seed=1)).float()
    assert torch.allclose(prior.penalty(fields), pca.penalty(fields), rtol=1e-4)
    assert torch.allclose(prior.log_prob(fields), pca.log_prob(fields), rtol=1e-4)


def bent_fields(count, seed=0):
    """Two components, one of which is nearly a function of the other."""
    rng = np.random.default_rng(seed)
    first = rng.normal(size=count)
    latent = np.column_stack([first, first**2 - 1 + 0.2 * rng.normal(size=count)])
    modes = np.random.default_rng(8).normal(size=(2, POINTS, 3))
    return np.einsum("km,mnd->knd", latent, modes) + 0.1 * rng.normal(size=(count, POINTS, 3))


def test_latent_flow_learns_what_no_gaussian_can():
    arguments = {"components": 2, "steps": 200, "hidden": 16, "learning_rate": 5e-3}
    prior = PRIORS.get("latent_flow").fit(bent_fields(300), **arguments)
    notes = prior.notes
    assert notes["nll_held_out"] < notes["nll_held_out_gaussian"] - 0.2
    assert notes["steps"] > 0
    assert notes["held_out"] == 30
    # The density integrates to one, far out as well, and samples are as likely as it says.
    axis = torch.linspace(-20, 20, 801)
    log_density = prior._log_density(torch.cartesian_prod(axis, axis))
    mass = log_density.exp() * (axis[1] - axis[0]) ** 2
    assert math.isclose(mass.sum(), 1, abs_tol=0.02)
    noise = torch.randn(20000, 2, generator=torch.Generator().manual_seed(0))
    drawn = prior._log_density(prior.whitened(prior._draw_latent(noise)))
    error = drawn.std() / math.sqrt(len(drawn))
    assert math.isclose(drawn.mean(), (mass * log_density).sum(), abs_tol=6 * error)


def test_latent_flow_is_never_worse_than_the_gaussian():
    # Noise alone, which invites learning by heart.
    fields = np.random.default_rng(0).normal(size=(30, POINTS, 3))
    prior = PRIORS.get("latent_flow").fit(
        fields, components=20, steps=60, patience=30, learning_rate=1e-2
    )
    assert prior.notes["nll_held_out"] <= prior.notes["nll_held_out_gaussian"]
    with pytest.raises(DataError, match="at least 3 displacement fields"):
        PRIORS.get("latent_flow").fit(fields[:3])


def test_pca_models_refuse_masks_and_sources_of_another_size():
    mask = torch.ones(1, POINTS, dtype=torch.bool)
    mask[0, 3] = False
    for name in ("pca", "pca_residual", "latent_flow"):
        with pytest.raises(DataError, match="complete fields"):
            fitted(name).penalty(torch.zeros(1, POINTS, 3), mask)
    with pytest.raises(DataError, match="source of 21"):
        fitted("pca").gaussian(cloud(POINTS + 1))


def test_source_cache_keeps_the_newest():
    cache = SourceCache(size=2)
    made = []

    def get(value, key=0):
        points = np.full((4, 3), value)
        return cache.get(points, key, lambda: made.append(value) or value)

    assert [get(v) for v in (1.0, 2.0, 1.0, 3.0, 1.0, 2.0)] == [1, 2, 1, 3, 1, 2]
    assert made == [1, 2, 3, 2]
    get(2.0, key=1)
    assert made == [1, 2, 3, 2, 2]


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


IN_STEPS = {
    "flow": {"steps": 80, "hidden": 16, "transforms": 3},
    "latent_flow": {"components": 6, "steps": 90, "patience": 20, "learning_rate": 3e-2},
}


@pytest.fixture
def best_at_50(monkeypatch):
    """Held-out fields are likeliest after step 50, whatever this machine's rounding makes of it."""
    look = likelihood.Best.look

    def scripted(best, flow, step):
        best.measure = lambda: abs(step - 50) - 100.0
        return look(best, flow, step)

    monkeypatch.setattr(likelihood.Best, "look", scripted)


@pytest.mark.usefixtures("best_at_50")
@pytest.mark.parametrize("at", [(5,), (10, 63)])
@pytest.mark.parametrize("name", IN_STEPS)
def test_a_fit_that_was_stopped_goes_on_bit_for_bit(tmp_path, monkeypatch, caplog, name, at):
    caplog.set_level("INFO", "dine")
    fields = np.random.default_rng(0).normal(size=(40, POINTS, 3))
    whole = PRIORS.get(name).fit(fields, seed=3, **IN_STEPS[name])
    unfinished = Unfinished(tmp_path, {"seed": "3"}, "mine", save_seconds=1e9)
    keywords = IN_STEPS[name] | {"unfinished": unfinished}
    look = likelihood.Progress.update

    reached = []

    def stop(progress, *arguments, **values):
        look(progress, *arguments, **values)
        reached.append(progress.done)
        if progress.done == at[0]:
            os.kill(os.getpid(), signal.SIGTERM)

    for step in at:
        at = (step,)
        monkeypatch.setattr(likelihood.Progress, "update", stop)
        with pytest.raises(Interrupted, match=f"mine was stopped after step {step} of"):
            PRIORS.get(name).fit(fields, seed=3, **keywords)
    at = (None,)
    again = PRIORS.get(name).fit(fields, seed=3, **keywords)
    monkeypatch.setattr(likelihood.Progress, "update", look)
    assert f"mine: going on from step {step}" in caplog.text
    # Patience ends the second 20 steps after its best; the first has none.
    assert reached == list(range(1, 71 if name == "latent_flow" else 81))
    assert again.notes == whole.notes
    assert again.notes.get("steps", 50) == 50
    for key, value in whole.state_dict().items():
        assert torch.equal(again.state_dict()[key], value), key
    # What another fit left is not gone on with.
    other = dataclasses.replace(unfinished, identity={"seed": "4"})
    PRIORS.get(name).fit(fields, seed=4, **(keywords | {"unfinished": other}))
    assert "made with other seed and is not used" in caplog.text


@pytest.mark.parametrize("name", IN_STEPS)
def test_a_fit_saves_its_state_now_and_then(tmp_path, monkeypatch, name):
    steps = []
    save = likelihood.save_state

    def saved(path, state):
        save(path, state)
        steps.append(load_state(path, state["identity"])[0]["step"])

    monkeypatch.setattr(likelihood, "save_state", saved)
    unfinished = Unfinished(tmp_path, {}, "mine", save_seconds=0)
    fields = smooth_fields(20)
    PRIORS.get(name).fit(fields, unfinished=unfinished, **(IN_STEPS[name] | {"steps": 4}))
    assert steps == [1, 2, 3]


def test_damaged_and_foreign_files(tmp_path):
    path = tmp_path / "prior.safetensors"
    fitted("pca").save(path)
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(CheckpointError, match="truncated"):
        load_prior(path)
    with pytest.raises(CheckpointError, match="does not exist"):
        load_prior(tmp_path / "nothing")


def test_unknown_prior():
    with pytest.raises(ConfigError, match="expected one of flow, gaussian_process"):
        PRIORS.get("pcaa")
    with pytest.raises(ConfigError, match="could not be imported"):
        PRIORS.get("no_such_module:Prior")
