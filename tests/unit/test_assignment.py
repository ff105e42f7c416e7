import numpy as np
import pytest
from scipy.optimize import linear_sum_assignment
from scipy.spatial.distance import cdist

from dine.data import assignment
from dine.data.assignment import cheapest_assignment
from dine.data.sampling import convention_order, fibonacci_sphere, sample_surface, sunflower_disc
from dine.data.synthetic import primitive, tissue_patch

pytestmark = pytest.mark.numerical
TEMPLATES = {"sphere": fibonacci_sphere, "disc": sunflower_disc}


def rng(seed=0):
    return np.random.default_rng(seed)


def costs(points, template):
    """Squared distances in the frame of the template, as scipy's solver wants them."""
    points = points - points.mean(axis=0)
    size = np.sqrt((points**2).sum() / (template**2).sum())
    return cdist(template, points / (size or 1.0), "sqeuclidean")


def solve(points, template):
    points = points[:, : template(1).shape[1]]
    count = len(points)
    order = cheapest_assignment(points, template(count), template(count // 8 or 1))
    cost = costs(points, template(count))
    rows, expected = linear_sum_assignment(cost)
    assert sorted(order) == list(range(count))
    assert cost[rows, order].sum() == pytest.approx(cost[rows, expected].sum(), rel=1e-13, abs=0)
    return order, expected


def blob(count):
    """Nearly all points in one spot, which the blurred problem cannot tell apart."""
    points = rng(3).standard_normal((count, 3))
    points[: count * 9 // 10] *= 1e-3
    return points


GENERIC = {
    "normal": lambda n: rng(1).standard_normal((n, 3)),
    "stretched": lambda n: rng(2).random((n, 3)) * [9, 1, 0.1] + [5, -6, 7],
    "blob": blob,
    "heavy tails": lambda n: rng(4).standard_cauchy((n, 3)),
    "clusters": lambda n: rng(5).standard_normal((n, 3)) * 0.02 + rng(6).integers(3, size=(n, 3)),
    "one far off": lambda n: np.vstack([rng(7).standard_normal((n - 1, 3)) * 1e-3, [1.0, 2, 3]]),
}


@pytest.mark.parametrize("template", TEMPLATES.values(), ids=TEMPLATES)
@pytest.mark.parametrize("count", [1, 2, 3, 31, 33, 300])
@pytest.mark.parametrize("make", GENERIC.values(), ids=GENERIC)
def test_generic_points_get_the_only_cheapest_assignment(make, count, template):
    order, expected = solve(make(count), template)
    np.testing.assert_array_equal(order, expected)


TIED = {
    "coincident": lambda n: np.ones((n, 3)),
    "duplicates": lambda n: rng(1).standard_normal((n, 3))[np.arange(n) // 7],
    "two spots": lambda n: np.arange(n)[:, None] % 2 * np.ones(3),
    "line": lambda n: np.arange(n)[:, None] * [1.0, 0.3, -0.2],
    "axis": lambda n: np.arange(n)[:, None] * [0, 0, 1.0],
    "grid": lambda n: np.stack(np.unravel_index(np.arange(n), (7, 7, 7)), axis=1) * 1.0,
    "template": fibonacci_sphere,
    "turned template": lambda n: -fibonacci_sphere(n)[::-1],
}


@pytest.mark.parametrize("template", TEMPLATES.values(), ids=TEMPLATES)
@pytest.mark.parametrize("count", [2, 3, 300])
@pytest.mark.parametrize("make", TIED.values(), ids=TIED)
def test_tied_points_get_a_cheapest_assignment_and_always_the_same(make, count, template):
    first, _ = solve(make(count), template)
    again, _ = solve(make(count), template)
    np.testing.assert_array_equal(first, again)


@pytest.mark.parametrize(("convention", "make"), [("sphere", primitive), ("disc", tissue_patch)])
@pytest.mark.parametrize("index", range(3))
def test_conventions_are_the_exact_assignment_on_surfaces(convention, make, index):
    surface = make(index, seed=0)
    points = sample_surface(surface, 500, rng(index)).places(surface.vertices)
    _, expected = solve(points, TEMPLATES[convention])
    np.testing.assert_array_equal(convention_order(points, convention), expected)


@pytest.mark.parametrize("count", [1, 2, 5])
def test_few_candidates_cost_time_and_no_exactness(monkeypatch, count):
    rounds = []
    look_up = assignment._cheapest_points
    monkeypatch.setattr(assignment, "_CANDIDATES", count)
    monkeypatch.setattr(
        assignment, "_cheapest_points", lambda *args: rounds.append(1) or look_up(*args)
    )
    for make in (GENERIC["normal"], GENERIC["blob"]):
        order, expected = solve(make(200), fibonacci_sphere)
        np.testing.assert_array_equal(order, expected)
    assert len(rounds) > 2  # candidates were looked up anew


@pytest.mark.parametrize(
    "coarse", [np.zeros((1, 3)), np.full((4, 3), 1e3), rng().standard_normal((500, 3))]
)
def test_the_coarse_template_has_no_effect_on_the_result(coarse):
    points, template = rng(1).standard_normal((200, 3)), fibonacci_sphere(200)
    expected = linear_sum_assignment(costs(points, template))[1]
    np.testing.assert_array_equal(cheapest_assignment(points, template, coarse), expected)


def test_the_arguments_are_left_alone():
    points, template, coarse = rng(1).standard_normal((50, 3)), fibonacci_sphere(50), np.eye(3)
    for array in (points, template, coarse):
        array.setflags(write=False)
    order = cheapest_assignment(points, template, coarse)
    strided = np.asfortranarray(points)
    np.testing.assert_array_equal(cheapest_assignment(strided, template, coarse), order)
