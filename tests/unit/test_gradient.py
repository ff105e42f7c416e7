"""Refinement by gradient: downwards with every prior and data term, nothing worse than the start.

The fields are so small and the priors so quickly fitted that only the mechanics are looked at.
"""

import numpy as np
import pytest
import torch
from samples import sphere
from test_priors import QUICK

from dine.data.batch import make_batch
from dine.errors import ConfigError, DataError
from dine.priors import PRIORS
from dine.refinement import gradient
from dine.refinement.gradient import refine_by_gradient
from dine.training.data_terms import DATA_TERMS
from dine.training.objective import Objective

pytestmark = pytest.mark.numerical
POINTS = 20
OF_CLOUDS = [name for name in DATA_TERMS.names() if name != "l1"]


SOURCE = sphere(POINTS)


def smooth_fields(count, seed=0, source=SOURCE):
    """Random affine motions of a source, with a little noise."""
    rng = np.random.default_rng(seed)
    motion = 0.1 * rng.normal(size=(count, 3, 3))
    return (
        source @ motion
        + 0.02 * rng.normal(size=(count, 1, 3))
        + 0.005 * rng.normal(size=(count, *source.shape))
    )


def fitted(name):
    sources = np.broadcast_to(SOURCE, (40, POINTS, 3))
    arguments = QUICK.get(name, {})
    return PRIORS.get(name).fit(smooth_fields(40), seed=3, source=sources, **arguments)


def pair(source=SOURCE):
    """Source, target with points of its own, and a field that misses it."""
    target = source @ np.diag([1.2, 0.9, 1.0])
    target = np.random.default_rng(1).permutation(target)[: len(source) - 2]
    return source, target, smooth_fields(1, seed=5, source=source)[0]


def descend(source, target, displacement, *, data_term, prior, weight, **steps):
    objective = Objective(data_term, prior, weight)
    return refine_by_gradient(source, target, displacement, objective, **steps)


def objective(source, target, field, term, prior=None, weight=0.0):
    batch = make_batch([source], [target])
    field = torch.from_numpy(field).float()[None]
    return Objective(DATA_TERMS.get(term)(), prior, weight)(batch, field, None)[0].item()


@pytest.mark.parametrize("term", OF_CLOUDS)
def test_every_data_term_goes_down(term):
    source, target, start = pair(sphere(200))
    found = descend(source, target, start, data_term=DATA_TERMS.get(term)(), prior=None, weight=0.0)
    assert found.shape == start.shape
    assert found.dtype == start.dtype
    before, after = (objective(source, target, field, term) for field in (start, found))
    assert after < 0.7 * before


@pytest.mark.parametrize("name", PRIORS.names())
def test_every_prior_goes_down(name):
    source, target, start = pair()
    prior = fitted(name)
    state = {key: value.clone() for key, value in prior.state_dict().items()}
    found = descend(
        source, target, start, data_term=DATA_TERMS.get("chamfer")(), prior=prior, weight=1e-3
    )
    arguments = (source, target)
    before, after = (
        objective(*arguments, field, "chamfer", prior, 1e-3) for field in (start, found)
    )
    assert np.isfinite(found).all()
    assert after < before
    assert all(torch.equal(value, state[key]) for key, value in prior.state_dict().items())


def test_result_follows_from_the_arguments():
    source, target, start = pair()
    term, prior = DATA_TERMS.get("chamfer")(), fitted("pca")
    copy = start.copy()
    first = descend(source, target, start, data_term=term, prior=prior, weight=1e-3)
    with torch.no_grad():
        again = descend(source, target, start, data_term=term, prior=prior, weight=1e-3)
    assert np.array_equal(first, again)
    assert np.array_equal(start, copy)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_no_steps_return_the_start(dtype):
    source, target, start = pair()
    start = start.astype(dtype)
    found = descend(
        source,
        target,
        start,
        data_term=DATA_TERMS.get("chamfer")(),
        prior=fitted("pca"),
        weight=1.0,
        steps=0,
    )
    assert found.dtype == dtype
    assert np.array_equal(found, start)
    assert found is not start


def test_a_large_weight_leads_to_the_prior_mean():
    source, target, start = pair()
    prior = fitted("pca").double()
    found = descend(
        source,
        target,
        start,
        data_term=DATA_TERMS.get("chamfer")(),
        prior=prior,
        weight=1e3,
        steps=100,
    )
    # The mean is at z = 0; what leaves the span of the components costs nothing and may stay.
    before, after = (prior.latent(torch.from_numpy(x)[None]).norm() for x in (start, found))
    assert after < 0.01 * before


def test_the_penalty_counts():
    source, target, start = pair()
    prior, term = fitted("pca"), DATA_TERMS.get("chamfer")()

    def found(weight):
        field = descend(source, target, start, data_term=term, prior=prior, weight=weight)
        return prior.penalty(torch.from_numpy(field).float()[None]).item()

    assert found(1.0) < found(1e-3) < found(0.0)


@pytest.mark.parametrize("term", OF_CLOUDS)
def test_points_that_coincide(term):
    source = np.repeat(SOURCE, 3, axis=0)
    nothing = np.zeros_like(source)
    run = {"data_term": DATA_TERMS.get(term)(), "prior": None, "weight": 0.0}
    # Nothing pulls, and nothing is moved.
    assert np.array_equal(descend(source, SOURCE, nothing, **run), nothing)
    assert np.array_equal(descend(source, source, nothing, **run), nothing)
    # All points of the source in one place.
    assert np.isfinite(descend(0 * source, SOURCE, nothing, **run)).all()
    assert np.isfinite(descend(SOURCE[:1], SOURCE, nothing[:1], **run)).all()


@pytest.mark.parametrize(("steps", "share"), [(5, 0.8), (gradient.STEPS, 0.95)])
def test_neighbours_move_together(monkeypatch, steps, share):
    """A ragged field would fit as well: the data term cannot tell."""
    source = sphere(400)
    target = sphere(400, seed=1) @ np.diag([1.2, 0.9, 1.0])
    distance = np.linalg.norm(source[:, None] - source, axis=2)
    near = np.argsort(distance, axis=1)[:, 1:7]

    def raggedness():
        start, term = np.zeros_like(source), DATA_TERMS.get("chamfer")()
        found = descend(source, target, start, data_term=term, prior=None, weight=0.0, steps=steps)
        differences = np.linalg.norm(found[:, None] - found[near], axis=2).mean()
        return differences / np.linalg.norm(found, axis=1).mean()

    smooth = raggedness()
    monkeypatch.setattr(gradient, "_smoothing", lambda *arguments: lambda slope: slope)
    assert smooth < share * raggedness()


def test_truth_is_not_known():
    source, target, start = pair()
    with pytest.raises(ConfigError, match="true displacement"):
        descend(
            source, target, start, data_term=DATA_TERMS.get("l1")(), prior=None, weight=0, steps=0
        )


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"displacement": np.zeros((POINTS - 1, 3))}, r"found shape \(19, 3\)"),
        ({"displacement": np.full((POINTS, 3), np.nan)}, "one finite displacement"),
        ({"target": np.zeros((0, 3))}, "target 0 has shape"),
        ({"target": np.full((4, 3), np.inf)}, "target 0 holds NaN"),
    ],
)
def test_bad_arrays_are_refused(change, match):
    source, target, start = pair()
    arrays = {"source": source, "target": target, "displacement": start} | change
    with pytest.raises(DataError, match=match):
        descend(**arrays, data_term=DATA_TERMS.get("chamfer")(), prior=None, weight=0.0)


def test_a_prior_of_other_points_is_refused():
    source, target, start = pair(sphere(POINTS + 1))
    with pytest.raises(DataError, match="20 points"):
        descend(
            source,
            target,
            start,
            data_term=DATA_TERMS.get("chamfer")(),
            prior=fitted("pca"),
            weight=1.0,
        )
