"""Refinement at test time: the linear solve, the rounds, and when the loose field is kept."""

import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial.distance import cdist

from dine.models.checkpoint import load_backbone, shipped_weights
from dine.priors.gaussian import LinearGaussian, squared_exponential
from dine.refinement.em import Matches, Mixture
from dine.refinement.process import LOOSE, STIFF
from dine.refinement.refine import Observed, Options, refine
from dine.refinement.shared_points import SharedPoints
from dine.registration.correspondence import predict_and_refine

pytestmark = pytest.mark.numerical


def organ(count, seed):
    """Points (count, 3) of an ellipsoid's surface, drawn evenly enough."""
    mesh = trimesh.creation.icosphere(subdivisions=4)
    rng = np.random.default_rng(seed)
    points = mesh.vertices[rng.choice(len(mesh.vertices), count, replace=False)]
    return points * [1.0, 0.7, 0.5]


def bent(points):
    """A smooth, large deformation (N, 3) of points."""
    x, y, z = points.T
    return np.column_stack([0.15 * y**2, 0.2 * np.sin(1.5 * x), 0.2 * x * y - 0.1 * z])


def error(field, truth):
    return np.linalg.norm(field - truth, axis=1).mean()


@pytest.fixture(scope="module")
def pair():
    source = organ(400, 1)
    truth = bent(source)
    order = np.random.default_rng(2).permutation(len(source))
    return source, (source + truth)[order], truth


# --- the solve ------------------------------------------------------------------------------------


def dense(prior, value, precision):
    """The posterior mean by the formula, with the covariance of all 3N coordinates."""
    points = len(prior.mean)
    covariance = np.kron(prior.kernel @ prior.kernel.T, np.eye(3))
    flat = prior.modes.reshape(len(prior.modes), 3 * points)
    covariance += flat.T @ flat
    noise = np.diag(np.repeat(1 / precision, 3))
    deviation = (value - prior.mean).ravel()
    mean = covariance @ np.linalg.solve(covariance + noise, deviation)
    return prior.mean + mean.reshape(points, 3)


@pytest.mark.parametrize(("modes", "rank"), [(0, 5), (4, 0), (4, 5)])
def test_the_solve_is_the_posterior_mean(modes, rank):
    rng = np.random.default_rng(modes + rank)
    prior = LinearGaussian(
        rng.normal(size=(12, 3)), rng.normal(size=(modes, 12, 3)), rng.normal(size=(12, rank))
    )
    value, precision = rng.normal(size=(12, 3)), rng.uniform(0.1, 5, size=12)
    model = Mixture(rng.normal(size=(12, 3)), rng.normal(size=(7, 3)), prior, 0.01, 0)
    field, energy = model.most_probable(value, precision)
    np.testing.assert_allclose(field, dense(prior, value, precision), atol=1e-9)
    # Half the squared Mahalanobis length of what the field is made of.
    flat = np.concatenate(
        [prior.modes.reshape(modes, 36), np.kron(prior.kernel.T, np.eye(3)).reshape(3 * rank, 36)]
    )
    deviation = (field - prior.mean).ravel()
    least = np.linalg.lstsq(flat.T, deviation, rcond=None)[0]
    assert energy == pytest.approx(0.5 * float(least @ least), rel=1e-6)


def test_without_rounds_it_is_the_mean_of_the_stiff_process():
    rng = np.random.default_rng(10)
    points, value = rng.normal(size=(2, 30, 3))
    deviation = rng.uniform(0.1, 0.3, size=30)
    prior = squared_exponential(points, points, STIFF.widths, STIFF.amplitudes, STIFF.affine)
    expected = prior @ np.linalg.solve(prior + np.diag((2 * deviation) ** 2), value)
    found = refine(points, points, Observed(value, deviation), options=Options(rounds=0)).mean
    # The root of the covariance leaves out a ten-thousandth of the variance.
    assert np.abs(found - expected).max() < 5e-3


# --- the rounds -----------------------------------------------------------------------------------


def test_one_round_follows_the_formula(pair):
    source, target, _ = pair
    prior = STIFF.at(source)
    model = Mixture(source, target, prior, STIFF.least, 0)
    found = model.rounds(np.zeros_like(source), 1, variance=0.02)[1].field
    squared = ((source[:, None] - target[None]) ** 2).sum(axis=2)
    density = (1 - 0.1) / len(source) * np.exp(-squared / 0.04) / (2 * np.pi * 0.02) ** 1.5
    share = density / (density.sum(axis=0) + 0.1 / 8)
    mass = share.sum(axis=1)
    value = share @ target / mass[:, None] - source
    np.testing.assert_allclose(found, dense(prior, value, mass / 0.02), atol=2e-4)


def test_every_field_becomes_more_probable(pair):
    source, target, _ = pair
    model = Mixture(source, target, STIFF.at(source), STIFF.least, 0)
    found = [
        model.rounds(np.zeros_like(source), rounds)[1].improbability for rounds in (1, 2, 4, 6, 40)
    ]
    # Where it has come to rest, rounding may raise it.
    rise = np.diff(found)
    assert (rise[:3] < -1).all()
    assert rise[3] < 1e-6 * abs(found[-1])


def test_the_network_is_improved_on(pair):
    source, target, truth = pair
    noisy = truth + 0.08 * np.random.default_rng(4).normal(size=truth.shape)
    observed = Observed(noisy, np.full(len(truth), 0.08))
    smoothed = refine(source, target, observed, options=Options(rounds=0)).mean
    assert error(smoothed, truth) < 0.6 * error(noisy, truth)
    assert error(refine(source, target, observed).mean, truth) < 0.01 * error(noisy, truth)


def test_a_network_that_is_wrong_as_a_whole_does_no_harm(pair):
    source, target, truth = pair
    wrong = np.full_like(truth, 1.5)
    sure = np.full(len(truth), 1e-3)
    alone = refine(source, target).mean
    assert (
        error(refine(source, target, Observed(wrong, sure)).mean, truth)
        <= error(alone, truth) + 1e-6
    )


def test_what_is_matched_is_held_and_its_targets_are_taken(pair):
    """Half of the points matched: the others find theirs, but not where these have settled."""
    source, target, truth = pair
    nearest = cdist(source + truth, target).argmin(axis=1)
    known = source[:, 0] > 0
    model = Mixture(source, target, LOOSE.at(source), 0.002, 0, Matches(known, nearest))
    assert model.free == np.count_nonzero(~known)
    start = model.from_matches()
    assert error(start[known], truth[known]) < 1e-3
    assert error(start[~known], truth[~known]) < error(np.zeros_like(truth[~known]), truth[~known])
    found = model.rounds(start, 30)[1].field
    assert error(found[known], truth[known]) < 1e-3
    assert error(found[~known], truth[~known]) < 0.3 * error(start[~known], truth[~known])
    # With everything that is free held to be matched as well, nothing is left to look for.
    assert (
        Mixture(source, target, LOOSE.at(source), 0.002, 0, Matches(known | True, nearest)).free
        == 0
    )


# --- points that both clouds hold -----------------------------------------------------------------


def test_shared_points_are_met_exactly(pair):
    source, target, truth = pair
    assert np.abs(refine(source, target).mean - truth).max() < 1e-12


def test_matching_goes_on_from_what_is_right_somewhere(pair):
    """A field that is right at a third of the points only."""
    source, target, truth = pair
    wrong = truth + np.where(source[:, :1] > 0.3, 0.0, 0.3)
    shared = SharedPoints(source, target)
    known = shared.matches(wrong).known
    assert 0.1 < known.mean() < 0.5
    assert error(wrong[known], truth[known]) < 1e-12
    found, share = shared.grow(wrong, LOOSE.at(source))
    assert share > 0.99
    assert error(found, truth) < 1e-3


def test_far_from_all_matches_the_first_field_counts():
    """An organ with a long stick, whose motion does not follow from that of the rest."""
    rng = np.random.default_rng(0)
    along = np.linspace(1.05, 2.6, 80)
    stick = np.column_stack([along, *0.02 * rng.normal(size=(2, 80))])
    source = np.concatenate([organ(400, 1), stick])
    out = np.clip(source[:, 0] - 1, 0, None)
    truth = 0.1 * np.column_stack([0 * out, np.sin(4 * out) * out, 1 - np.cos(5 * out)])
    far = out > 0.2
    start = truth + 0.03 * far[:, None] * [1.0, 0.3, 0.5]
    order = np.random.default_rng(2).permutation(len(source))
    shared = SharedPoints(source, (source + truth)[order])
    assert shared.matches(start).known[far].mean() < 0.1
    found, _ = shared.grow(start, LOOSE.at(source))
    assert error(found[far], truth[far]) < 0.1 * error(start[far], truth[far])


def test_matches_are_mutual_close_and_like_their_neighbours():
    source = organ(200, 7)
    far = np.zeros_like(source)
    far[0] = 5.0  # one stray target: its source point has no match, whoever is nearest
    shared = SharedPoints(source, source + far)
    found = shared.matches(np.zeros_like(source))
    assert found.known.tolist() == [False] + [True] * 199
    assert found.target[1:].tolist() == list(range(1, 200))
    # A single point that happens to lie right, among others that do not.
    alone = np.full_like(source, 0.02)
    alone[5] = 0.0
    assert not shared.matches(alone).known[5]
    # Two source points on one target.
    twice = np.zeros_like(source)
    twice[10] = source[11] - source[10]
    assert shared.matches(twice).known[[10, 11]].sum() <= 1


def test_independent_samples_are_not_matched(pair):
    source, _, truth = pair
    other = organ(420, 9)
    shared = SharedPoints(source, other + bent(other))
    found, share = shared.grow(truth, LOOSE.at(source))
    assert share == 0
    np.testing.assert_array_equal(found, truth)


def test_points_of_their_own_are_not_followed(pair):
    source, _, truth = pair
    other = organ(420, 9)
    target = other + bent(other)
    found = refine(source, target).mean
    loose = refine(source, target, prior=LOOSE.at(source)).mean
    assert error(found, truth) < error(loose, truth)
    # An ellipsoid hardly shows where along it a point went.
    assert error(found, truth) < 0.8 * np.linalg.norm(truth, axis=1).mean()


def test_outliers_are_ignored(pair):
    source, target, truth = pair
    strange = np.random.default_rng(3).uniform(-1, 1, size=(100, 3))
    found = refine(source, np.concatenate([target, strange])).mean
    assert error(found, truth) < 1e-3


def test_the_order_of_the_target_does_not_matter_and_nothing_is_random(pair):
    source, target, truth = pair
    observed = Observed(0.8 * truth, np.full(len(truth), 0.05))
    found = refine(source, target, observed).mean
    np.testing.assert_array_equal(refine(source, target, observed).mean, found)
    np.testing.assert_allclose(refine(source, target[::-1], observed).mean, found, atol=1e-4)


def test_a_given_prior_finishes(pair):
    source, target, truth = pair
    only_shift = LinearGaussian(
        np.zeros_like(source), np.eye(3)[:, None, :].repeat(len(source), axis=1), np.zeros((400, 0))
    )
    observed = Observed(truth, np.full(len(truth), 0.05))
    found = refine(source, target, observed, prior=only_shift).mean
    assert np.ptp(found, axis=0).max() < 1e-6


def test_a_part_looks_for_the_whole(pair):
    source, target, truth = pair
    shown = source[:, 0] > 0
    found = refine(source[shown], target, options=Options(part=True)).mean
    assert error(found, truth[shown]) < 0.5 * np.linalg.norm(truth[shown], axis=1).mean()


def test_points_that_cannot_be_shared_are_not_looked_for(pair, monkeypatch):
    source = pair[0]
    others = organ(len(source), 11) + 0.1
    expected = refine(source, others).mean
    monkeypatch.setattr("dine.refinement.shared_points.SharedPoints", None)
    found = refine(source, others, options=Options(shared=False)).mean
    np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize(("points", "targets"), [(3, 1), (1, 3), (1, 1), (8, 8), (9, 9)])
def test_few_points(points, targets):
    source = organ(points, 5)
    assert np.isfinite(refine(source, organ(targets, 6) + 0.1).mean).all()


def test_the_error_to_expect_of_a_network():
    field = np.zeros((4, 3))
    assert Observed.of_network(field, None).error.tolist() == [0.05] * 4
    assert Observed.of_network(field[:2], np.array([0.0, 0.2])).error.tolist() == [0.03, 0.2]


def test_the_loose_process_has_more_freedom_than_the_stiff_one():
    points = organ(300, 6)
    assert LOOSE.at(points).kernel.shape[1] > STIFF.at(points).kernel.shape[1]


@pytest.mark.parametrize("kind", ["robust_defreg", "deftransnet"])
def test_the_authors_checkpoint_is_beaten_on_its_own_demo_pairs(shared, kind):
    path = shared / "published" / "robust_defreg_modelnet10_predictions.npz"
    with np.load(path) as data:
        stored = dict(data)
    backbone, _ = load_backbone(shipped_weights(kind))
    for name in {key.split("/")[0] for key in stored}:
        source, target = (stored[f"{name}/{x}"].astype(float) for x in ("source", "target"))
        truth = target[stored[f"{name}/target_index_of_source"]] - source
        found, _ = predict_and_refine(backbone, source, target, torch.device("cpu"))
        assert error(found, truth) < 0.5 * error(stored[f"{name}/displacement"], truth)
