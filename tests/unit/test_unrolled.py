"""The rounds of refinement that training goes through: those of test time, and their gradient."""

import numpy as np
import pytest
import torch
from samples import sphere

from dine.data.batch import make_batch
from dine.errors import ConfigError
from dine.refinement.em import Mixture
from dine.refinement.process import STIFF, Smoothness
from dine.refinement.refine import Observed, Options, refine
from dine.training.unrolled import RefinedTerm

pytestmark = pytest.mark.numerical


def bent(points):
    """A smooth deformation (N, 3) of points."""
    x, y, z = points.T
    return np.column_stack([0.1 * y**2, 0.1 * np.sin(1.5 * x), 0.1 * x * y - 0.1 * z])


def scans(sizes, seed=0):
    """Source, target with points of its own and some outliers, and a field that errs."""
    rng = np.random.default_rng(seed)
    source, other = sphere(sizes[0], seed), sphere(sizes[1], seed + 100)
    target = np.concatenate([other + bent(other), rng.uniform(-1, 1, size=(sizes[1] // 10, 3))])
    return source, target, bent(source) + 0.05 * rng.normal(size=source.shape)


def batch_of(found, dtype=torch.float64):
    """Batch and displacement of some pairs, padded with numbers that must not count."""
    sources, targets, fields = zip(*found, strict=True)
    batch = make_batch(sources, targets, dtype=dtype)
    field = torch.full_like(batch.source, 7.0)
    for row, values in zip(field, fields, strict=True):
        row[: len(values)] = torch.from_numpy(values)
    return batch, field


@pytest.mark.parametrize("rounds", [1, 2, 4])
def test_rounds_are_those_of_the_refinement(rounds):
    found = [scans((120, 150)), scans((90, 170), seed=1)]
    refined = RefinedTerm(rounds=rounds).refined(*batch_of(found))
    for (source, target, field), result in zip(found, refined.numpy(), strict=True):
        model = Mixture(source, target, STIFF.at(source), STIFF.least, 0)
        expected, _ = model.most_probable(field, np.full(len(source), 1 / 0.1**2))
        variance = None
        for _ in range(rounds):  # one at a time, since momentum begins with the second
            before = expected
            _, (expected, variance, _) = model.rounds(before, 1, variance)
        # Distances are in single precision at test time.
        np.testing.assert_allclose(result[: len(source)], expected, atol=1e-5)
        assert np.abs(expected - before).max() > 1e-3
        assert (result[len(source) :] == 0).all()


def test_a_network_without_marginals_is_smoothed_alike():
    source, target, field = scans((80, 80))
    observed = Observed.of_network(field, None)
    expected = refine(source, target, observed, options=Options(rounds=0)).mean
    batch, displacement = batch_of([(source, target, field)])
    found = RefinedTerm(rounds=0).refined(batch, displacement)[0]
    np.testing.assert_allclose(found.numpy(), expected, atol=1e-9)


def test_gradient_follows_finite_differences():
    """Through assignment, variance and solve, beside padding and outliers."""
    batch, field = batch_of([scans((9, 20)), scans((6, 30), seed=1)])
    term = RefinedTerm(rounds=2)
    assert torch.autograd.gradcheck(
        lambda field: term(batch, field, None), field.requires_grad_(), atol=1e-8, rtol=1e-5
    )
    (gradient,) = torch.autograd.grad(term(batch, field, None).sum(), field)
    # Far above what the check forgives.
    assert gradient[0].abs().max() > 1e-3
    assert (gradient[1, 6:] == 0).all()


def test_every_round_reaches_the_gradient():
    """Cut off from the network's field, each round would leave less of it."""
    batch, field = batch_of([scans((60, 60))])
    field.requires_grad_()
    norms = [
        torch.autograd.grad(RefinedTerm(rounds=rounds)(batch, field, None).sum(), field)[0].norm()
        for rounds in range(4)
    ]
    assert all(norm > 1e-6 for norm in norms)


def test_single_precision_suffices():
    found = [scans((200, 220))]
    term = RefinedTerm()
    values, gradients = [], []
    for dtype in (torch.float32, torch.float64):
        batch, field = batch_of(found, dtype)
        value = term(batch, field.requires_grad_(), None).sum()
        values.append(value.item())
        gradients.append(torch.autograd.grad(value, field)[0].double())
        assert value.dtype == dtype
    assert values[0] == pytest.approx(values[1], rel=1e-4)
    assert (gradients[0] - gradients[1]).norm() < 0.05 * gradients[1].norm()


def test_what_refinement_mends_costs_little():
    """Noise from point to point is smoothed away; a field that leads astray is not."""
    source = sphere(150)
    target = source + bent(source)
    noisy = bent(source) + 0.05 * np.random.default_rng(3).normal(size=source.shape)
    wrong = source @ np.diag([-2.0, -2.0, 0.0])  # half a turn

    def cost(field):
        return RefinedTerm()(*batch_of([(source, target, field)]), None).item()

    assert cost(noisy) < 0.01 * cost(wrong)


def test_a_source_is_prepared_once(monkeypatch):
    prepared = []
    at = Smoothness.at
    monkeypatch.setattr(
        Smoothness, "at", lambda self, points: prepared.append(len(points)) or at(self, points)
    )
    term = RefinedTerm()
    first, second = batch_of([scans((30, 30))]), batch_of([scans((40, 30), seed=1)])
    for batch, field in (first, second, first, second):
        term(batch, field, None)
    assert prepared == [30, 40]
    # As long, but elsewhere.
    term(*batch_of([scans((30, 30), seed=2)]), None)
    assert prepared == [30, 40, 30]


def test_arguments_are_checked():
    with pytest.raises(ConfigError, match="rounds must not be negative, found -1"):
        RefinedTerm(rounds=-1)
    with pytest.raises(ConfigError, match="deviation must be positive, found 0"):
        RefinedTerm(deviation=0)
