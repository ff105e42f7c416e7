import numpy as np
import pytest
from scipy.interpolate import RBFInterpolator
from scipy.spatial.transform import Rotation

from dine.data.deformation import rbf_displacement
from dine.data.sampling import sample_surface
from dine.data.synthetic import primitive, tissue_patch
from dine.errors import DataError
from dine.geometry import interpolation as module
from dine.geometry.interpolation import FittedDisplacement, FittedValues
from dine.geometry.surface import Surface

pytestmark = pytest.mark.numerical
RNG = np.random.default_rng(0)
SHAPES = {
    "ball": RNG.normal(size=(60, 3)),
    "one": RNG.normal(size=(1, 3)),
    "two": RNG.normal(size=(2, 3)),
    "three": RNG.normal(size=(3, 3)),
    "line": np.outer(np.linspace(0, 1, 20), [1, 2, 3]),
    "plane": RNG.normal(size=(40, 3)) * [1, 1, 0],
    "nearly a plane": RNG.normal(size=(40, 3)) * [1, 1, 1e-9],
    "repeated": np.repeat(RNG.normal(size=(10, 3)), 7, axis=0),
    "all in one place": np.full((9, 3), 3.0),
    "close pairs": np.concatenate([RNG.normal(size=(30, 3))] * 2)
    + np.repeat([[0], [1e-13]], 30, 0),
}
SHAPES = {name: points * 40 + [1e3, -2e3, 5e2] for name, points in SHAPES.items()}
QUERIES = RNG.normal(size=(50, 3)) * 30 + [1e3, -2e3, 5e2]
TETRAHEDRON = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]) * 200 + [1e3, -2e3, 5e2]
TURN = Rotation.from_rotvec([0.3, -0.8, 0.5])


def interpolated(points, field, queries):
    """Three columns as a displacement, any other number as values."""
    kind = FittedDisplacement if np.shape(field)[1:] == (3,) else FittedValues
    return kind(points, field)(queries)


@pytest.mark.parametrize("points", SHAPES.values(), ids=SHAPES)
def test_constant_fields_are_exact_everywhere(points):
    queries = np.concatenate([QUERIES, QUERIES * 100])
    for value in ([1.0, -2.0, 3.0], [0.7]):
        found = interpolated(points, np.tile(value, (len(points), 1)), queries)
        assert found.dtype == np.float64
        np.testing.assert_allclose(found, np.tile(value, (100, 1)), rtol=1e-5)


@pytest.mark.parametrize("name", ["ball", "plane", "nearly a plane", "repeated", "three"])
def test_rigid_motions_are_exact_everywhere(name):
    def motion(x):
        return TURN.apply(x) - x + [5, 6, 7]

    for queries, tolerance in ((QUERIES, 1e-4), (QUERIES * 1e3, 1.0)):
        found = interpolated(SHAPES[name], motion(SHAPES[name]), queries)
        np.testing.assert_allclose(found, motion(queries), rtol=0, atol=tolerance)


@pytest.mark.parametrize("points", [SHAPES["ball"], SHAPES["repeated"], TETRAHEDRON])
def test_affine_fields_are_exact_within_reach(points):
    slope = np.array([[0.2, 0.1, 0], [-0.1, -0.3, 0.2], [0.05, 0, 0.4]])
    found = interpolated(points, points @ slope + 3, QUERIES)
    np.testing.assert_allclose(found, QUERIES @ slope + 3, rtol=0, atol=1e-8)


@pytest.mark.parametrize("columns", [1, 2, 3, 5])
def test_samples_get_their_own_values_back(columns):
    points = SHAPES["ball"]
    field = RNG.normal(size=(len(points), columns))
    np.testing.assert_allclose(interpolated(points, field, points), field, rtol=0, atol=1e-5)


def test_coincident_samples_share_their_mean():
    field = RNG.normal(size=(70, 3))
    found = interpolated(SHAPES["repeated"], field, SHAPES["repeated"][::7])
    means = field.reshape(10, 7, 3).mean(axis=1)
    np.testing.assert_allclose(found, means, rtol=0, atol=1e-5)
    single = interpolated(SHAPES["all in one place"], field[:9], QUERIES)
    np.testing.assert_allclose(single, np.tile(field[:9].mean(axis=0), (50, 1)), atol=1e-12)


@pytest.mark.parametrize("points", SHAPES.values(), ids=SHAPES)
@pytest.mark.parametrize("columns", [1, 3])
def test_anything_is_finite_and_bounded(points, columns):
    field = RNG.normal(size=(len(points), columns))
    centre = points.mean(axis=0)
    radius = np.linalg.norm(points - centre, axis=1).max() or 1.0
    directions = RNG.normal(size=(300, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    for distance in (0.3, 1, 2, 10, 1e6):
        found = interpolated(points, field, centre + directions * distance * radius)
        assert np.isfinite(found).all()
        if columns == 1:
            assert found.min() >= field.min()
            assert found.max() <= field.max()
    # Far away only a turn remains, by which a sample at one radius moves no more than it does.
    assert np.abs(found).max() <= 3e6 * np.abs(field).max()


def test_error_on_smooth_fields_with_noise():
    """The documented errors, in object radii."""
    for shape, limits in (
        (primitive(1, 0), (0.033, 0.03, 0.06)),
        (tissue_patch(0, 0), (0.033, 0.05)),
    ):
        rng = np.random.default_rng(0)
        samples = sample_surface(shape, 1024, rng)
        points = samples.places(shape.vertices)
        centre = points.mean(axis=0)
        radius = np.linalg.norm(points - centre, axis=1).max()
        vertices, points = (shape.vertices - centre) / radius, (points - centre) / radius
        if len(limits) == 3:
            queries = [vertices, vertices / 2, vertices * 1.3]
        else:
            queries = [vertices, vertices - [0, 0, 0.2]]
        every = Surface(np.concatenate([vertices, points, *queries]), shape.faces)
        field = rbf_displacement(
            every, level=0.5, control_percent=5, width=0.4, amplitude=0.1, points=1024, rng=rng
        )
        truth = field[len(vertices) + 1024 :].reshape(len(queries), -1, 3)
        given = field[len(vertices) :][:1024] + rng.normal(size=points.shape) * 0.03
        for query, true, limit in zip(queries, truth, limits, strict=True):
            error = np.linalg.norm(interpolated(points, given, query) - true, axis=1).mean()
            assert error < limit


def test_many_samples_are_averaged_in_place(monkeypatch):
    monkeypatch.setattr(module, "_MOST_SITES", 100)
    points = RNG.normal(size=(1050, 3))
    slope = RNG.normal(size=(3, 3)) * 0.3
    np.testing.assert_allclose(
        interpolated(points, points @ slope, points), points @ slope, atol=1e-8
    )
    smooth = np.sin(points)
    assert np.abs(interpolated(points, smooth, points) - smooth).mean() < 0.2


def test_many_queries_and_none():
    points = SHAPES["ball"]
    field = RNG.normal(size=(len(points), 3))
    queries = RNG.normal(size=(120_000, 3)) * 30 + [1e3, -2e3, 5e2]
    found = interpolated(points, field, queries)
    np.testing.assert_allclose(found[-20:], interpolated(points, field, queries[-20:]), atol=1e-9)
    assert interpolated(points, field, np.empty((0, 3))).shape == (0, 3)
    assert interpolated(points, field[:, :1], np.empty((0, 3))).shape == (0, 1)


def test_units_and_position_do_not_matter():
    points, field = RNG.normal(size=(50, 3)), RNG.normal(size=(50, 3)) * 0.1
    expected = interpolated(points, field, QUERIES[:5] - QUERIES[:5].mean(axis=0))
    for scale in (1e-9, 1e9):
        queries = (QUERIES[:5] - QUERIES[:5].mean(axis=0)) * scale + scale
        found = interpolated(points * scale + scale, field * scale, queries)
        np.testing.assert_allclose(found / scale, expected, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize(
    ("points", "field", "queries", "message"),
    [
        (np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((1, 3)), "0 rows at 0 points"),
        (np.zeros((2, 3)), np.zeros((3, 3)), np.zeros((1, 3)), "3 rows at 2 points"),
        (np.zeros((2, 2)), np.zeros((2, 3)), np.zeros((1, 3)), r"points .* shape \(2, 2\)"),
        (np.zeros((2, 3)), np.zeros(2), np.zeros((1, 3)), r"field .* shape \(2,\)"),
        (np.zeros((2, 3)), np.zeros((2, 0)), np.zeros((1, 3)), r"field .* shape \(2, 0\)"),
        (np.zeros((2, 3)), np.zeros((2, 3)), np.zeros(3), r"queries .* shape \(3,\)"),
        (np.full((2, 3), np.nan), np.zeros((2, 3)), np.zeros((1, 3)), "points .* NaN"),
        (np.zeros((2, 3)), np.full((2, 1), np.inf), np.zeros((1, 3)), "field .* NaN or inf"),
        (np.zeros((2, 3)), np.zeros((2, 1)), np.full((1, 3), np.inf), "queries .* NaN"),
    ],
)
def test_what_cannot_be_interpolated(points, field, queries, message):
    with pytest.raises(DataError, match=message):
        interpolated(points, field, queries)


@pytest.mark.parametrize("count", [1, 2, 60])
def test_values_follow_the_biharmonic_spline(count):
    points, values = SHAPES["ball"][:count], RNG.normal(size=(count, 2))
    spline = RBFInterpolator(points, values, kernel="linear", degree=0)
    expected = np.clip(spline(QUERIES), values.min(axis=0), values.max(axis=0))
    near = np.linalg.norm(QUERIES - points.mean(axis=0), axis=1) < 2 * np.linalg.norm(
        points - points.mean(axis=0), axis=1
    ).max(initial=1e-9)
    found = FittedValues(points, values)(QUERIES)
    np.testing.assert_allclose(found[near], expected[near], atol=1e-6)


def test_a_field_is_fitted_once(monkeypatch):
    points, queries = SHAPES["ball"], [QUERIES, QUERIES[:7], SHAPES["ball"]]
    displacement, values = RNG.normal(size=(60, 3)), RNG.normal(size=(60, 1))
    expected = [interpolated(points, f, q) for f in (displacement, values) for q in queries]
    fitted = FittedDisplacement(points, displacement), FittedValues(points, values)
    monkeypatch.setattr(module, "solve", None)
    found = [f(q) for f in fitted for q in queries]
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_array_equal(one, other)


def test_a_displacement_has_three_columns():
    with pytest.raises(DataError, match=r"field .* shape \(4, 2\)"):
        FittedDisplacement(TETRAHEDRON, np.zeros((4, 2)))
    # Three values of units of their own stay within their samples, as a displacement need not.
    values = FittedValues(TETRAHEDRON, np.eye(4)[:, :3])(QUERIES * 10)
    assert 0 <= values.min() <= values.max() <= 1
