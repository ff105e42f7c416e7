"""One set of checks for every registered data term, and the definition of each."""

import math

import numpy as np
import pytest
import torch

from dine.data.batch import make_batch
from dine.errors import ConfigError
from dine.training.data_terms import DATA_TERMS

pytestmark = pytest.mark.numerical
ROBUST = ("correntropy", "density_aware", "hyperbolic", "landau")
OF_CLOUDS = ("chamfer", *ROBUST, "refined")  # need no true displacement


def cloud(count, seed=0):
    return 0.3 * np.random.default_rng(seed).normal(size=(count, 3))


def batch_of(*pairs):
    return make_batch(*zip(*pairs, strict=True), dtype=torch.float64)


def field_of(batch, seed=9):
    generator = torch.Generator().manual_seed(seed)
    noise = torch.randn(batch.source.shape, generator=generator, dtype=torch.float64)
    return 0.05 * noise.requires_grad_()


def truth_of(batch):
    return torch.zeros_like(batch.source)


def value_of(name, moved, target, **arguments):
    """A term's value for one pair, whose source has moved already."""
    batch = batch_of((moved, target))
    return DATA_TERMS.get(name)(**arguments)(batch, truth_of(batch), truth_of(batch)).item()


def test_what_is_registered():
    assert DATA_TERMS.names() == sorted([*OF_CLOUDS, "l1"])


@pytest.mark.parametrize("name", DATA_TERMS.names())
def test_one_value_per_pair_and_gradients(name):
    batch = batch_of((cloud(8), cloud(11, 1)), (cloud(8, 2), cloud(11, 3)))
    field, term = field_of(batch), DATA_TERMS.get(name)()
    values = term(batch, field, truth_of(batch))
    assert values.shape == (2,)
    assert (values > 0).all()
    assert torch.autograd.gradcheck(lambda field: term(batch, field, truth_of(batch)), (field,))


@pytest.mark.parametrize("name", DATA_TERMS.names())
def test_padded_pairs_are_as_single_ones(name):
    pairs = [(cloud(9), cloud(12, 1)), (cloud(5, 2), cloud(20, 3))]
    batch = batch_of(*pairs)
    field, term = field_of(batch), DATA_TERMS.get(name)()
    values = term(batch, field, truth_of(batch))
    (gradient,) = torch.autograd.grad(values.sum(), field)
    for row, (source, target) in enumerate(pairs):
        alone = batch_of((source, target))
        part = field[row : row + 1, : len(source)].detach().requires_grad_()
        value = term(alone, part, truth_of(alone))
        assert value.item() == pytest.approx(values[row].item(), rel=1e-12)
        (expected,) = torch.autograd.grad(value.sum(), part)
        assert torch.allclose(gradient[row, : len(source)], expected[0], atol=1e-12)
        assert (gradient[row, len(source) :] == 0).all()


@pytest.mark.parametrize("name", DATA_TERMS.names())
def test_order_of_points_does_not_matter(name):
    source, target = cloud(9), cloud(12, 1)
    batch, term = batch_of((source, target)), DATA_TERMS.get(name)()
    field = field_of(batch).detach()
    order = np.random.default_rng(4).permutation(9)
    other = batch_of((source[order], np.random.default_rng(5).permutation(target)))
    found = term(other, field[:, order], truth_of(other))
    assert torch.allclose(found, term(batch, field, truth_of(batch)))


@pytest.mark.parametrize("name", DATA_TERMS.names())
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_coinciding_clouds_cost_nothing_and_pull_nowhere(name, dtype):
    source = np.concatenate([cloud(10), cloud(3, 1)])
    batch = make_batch([source, source[:7]], [source, source[:7]], dtype=dtype)
    field = torch.zeros_like(batch.source).requires_grad_()
    values = DATA_TERMS.get(name)()(batch, field, torch.zeros_like(field))
    (gradient,) = torch.autograd.grad(values.sum(), field)
    assert values.tolist() == [0, 0]
    assert (gradient == 0).all()


@pytest.mark.parametrize("name", DATA_TERMS.names())
def test_tiny_residuals_pull_with_finite_force(name):
    source = cloud(10)
    batch = make_batch([source], [source])
    # Down to squares that float32 cannot hold.
    size = torch.tensor([10.0**-k for k in (3, 7, 12, 18, 19, 20, 21, 22, 23, 30)])
    field = size[None, :, None].repeat(1, 1, 3).requires_grad_()
    value = DATA_TERMS.get(name)()(batch, field, torch.zeros_like(field)).sum()
    (gradient,) = torch.autograd.grad(value, field)
    assert gradient.isfinite().all()
    assert gradient.abs().max() < 1


def naive(moved, target, cost):
    """mean of cost(d) both ways, and for each point what is nearest."""
    distance = np.linalg.norm(moved[:, None] - target[None], axis=2)
    return np.mean(cost(distance.min(1))) + np.mean(cost(distance.min(0)))


COSTS = {
    ("chamfer", ()): np.square,
    ("hyperbolic", ()): lambda d: np.arccosh(1 + d**2),
    ("hyperbolic", (("alpha", 7.0),)): lambda d: np.arccosh(1 + 7 * d**2),
    ("landau", ()): lambda d: np.exp(-(d + np.exp(-d)) / 2) * (1 - np.exp(-d)),
    ("landau", (("scale", 0.2),)): lambda d: (
        np.exp(-(5 * d + np.exp(-5 * d)) / 2) * (1 - np.exp(-5 * d))
    ),
    ("correntropy", ()): lambda d: 1 - np.exp(-(d**2) / 0.02),
    ("correntropy", (("sigma", 0.5),)): lambda d: 1 - np.exp(-(d**2) / 0.5),
}


@pytest.mark.parametrize(("term", "cost"), COSTS.items(), ids=[str(term) for term in COSTS])
def test_costs_of_residuals_follow_their_definitions(term, cost):
    name, arguments = term
    moved, target = cloud(6), cloud(9, 1)
    found = value_of(name, moved, target, **dict(arguments))
    assert found == pytest.approx(naive(moved, target, cost), rel=1e-12)
    # By hand: both residuals are 0.3.
    found = value_of(name, np.zeros((1, 3)), np.array([[0, 0.3, 0]]), **dict(arguments))
    assert found == pytest.approx(2 * cost(np.array(0.3)), rel=1e-12)


def naive_density_aware(moved, target, alpha, n_lambda):
    total = 0.0
    for a, b in ((moved, target), (target, moved)):
        choice = [min(range(len(b)), key=lambda j, x=x: np.sum((x - b[j]) ** 2)) for x in a]
        for x, j in zip(a, choice, strict=True):
            weight = 1 / max(choice.count(j) * len(b) / len(a), 1) ** n_lambda
            total += (1 - weight * np.exp(-alpha * np.sum((x - b[j]) ** 2))) / len(a) / 2
    return total


@pytest.mark.parametrize("arguments", [{}, {"alpha": 5.0, "n_lambda": 1}, {"n_lambda": 0}])
@pytest.mark.parametrize("sizes", [(8, 8), (6, 13), (13, 6)])
def test_density_aware_follows_its_definition(arguments, sizes):
    moved, target = cloud(sizes[0]), cloud(sizes[1], 1)
    expected = naive_density_aware(moved, target, **{"alpha": 40, "n_lambda": 0.5, **arguments})
    found = value_of("density_aware", moved, target, **arguments)
    assert found == pytest.approx(expected, rel=1e-12)
    assert 0 < found < 1


def test_density_aware_sees_clumps_that_lie_on_the_target():
    """Two of three points at the same place: their weights and that of the one left over."""
    target = np.eye(3)
    moved = target[[0, 0, 1]]
    # Forth: weights 1/2, 1/2, 1. Back: two residuals of 0 with weight 1 or, where shared, 1/2.
    far = math.exp(-2 * 1.5)
    found = value_of("density_aware", moved, target, alpha=1.5, n_lambda=1)
    nearest = value_of("density_aware", moved, target, alpha=1.5, n_lambda=0)
    assert nearest == pytest.approx((1 - far) / 6)
    assert found == pytest.approx((1 / 2 + 1 / 2) / 6 + (1 / 2 + 1 - far / 2) / 6)


def pull(name, target):
    """Norm of the gradient that a cloud near its target feels."""
    source = cloud(40)
    batch = batch_of((source, target(source)))
    field = truth_of(batch).requires_grad_()
    value = DATA_TERMS.get(name)()(batch, field, None).sum()
    return torch.autograd.grad(value, field)[0].norm().item()


@pytest.mark.parametrize("name", ROBUST)
def test_far_outliers_pull_less_than_with_chamfer(name):
    far = np.array([[4.0, 4.0, 4.0]])

    def disturbed(name):
        clean = pull(name, lambda x: x + 0.02)
        return pull(name, lambda x: np.concatenate([x + 0.02, far])) / clean

    assert disturbed("chamfer") > 10
    assert disturbed(name) < 0.3 * disturbed("chamfer")


def test_terms_that_forget_outliers_altogether():
    far = np.full((1, 3), 4.0)
    for name in ("correntropy", "density_aware"):
        term = DATA_TERMS.get(name)()
        batch = batch_of((cloud(40), far))
        field = truth_of(batch).requires_grad_()
        (gradient,) = torch.autograd.grad(term(batch, field, None).sum(), field)
        assert gradient.abs().max() < 1e-12


@pytest.mark.parametrize(
    ("name", "argument"),
    [
        ("hyperbolic", "alpha"),
        ("landau", "scale"),
        ("correntropy", "sigma"),
        ("density_aware", "alpha"),
    ],
)
def test_parameters_must_be_positive(name, argument):
    with pytest.raises(ConfigError, match=f"{argument} must be positive, found 0"):
        DATA_TERMS.get(name)(**{argument: 0})
    with pytest.raises(ConfigError, match="n_lambda must not be negative"):
        DATA_TERMS.get("density_aware")(n_lambda=-1)
