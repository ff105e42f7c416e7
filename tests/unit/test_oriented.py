"""Points with normals."""

import numpy as np
import pytest
import trimesh

from dine.geometry.oriented import (
    MovingNormals,
    OrientedPoints,
    evenly,
    fitted_planes,
    fitted_quadrics,
    rim_curve,
    unit,
)
from dine.geometry.surface import rim_edges


@pytest.fixture
def sphere():
    points = unit(np.random.default_rng(0).normal(size=(3000, 3)))
    return OrientedPoints(points, points.copy(), np.zeros(len(points), bool))


def turned_by(a, b):
    """Degrees between unit vectors (N, 3), whatever their signs."""
    return np.degrees(np.arccos(np.clip(np.abs((a * b).sum(axis=1)), 0, 1)))


def test_normals_of_a_cloud_are_those_of_its_surface(sphere):
    assert turned_by(fitted_planes(sphere.points)[0], sphere.normals).mean() < 4
    # Of fewer points than neighbours too.
    flat = np.random.default_rng(1).normal(size=(5, 3)) * [1, 1, 0]
    assert np.allclose(np.abs(fitted_planes(flat)[0]), [0, 0, 1])


def few_of_a_bent_surface():
    """Few points of an ellipsoid, unevenly drawn as chance has it, and its normals."""
    points = unit(np.random.default_rng(3).normal(size=(300, 3)))
    axes = np.array([1.0, 0.7, 0.5])
    return OrientedPoints(points * axes, unit(points / axes), np.zeros(300, bool))


def test_quadrics_bend_with_the_surface():
    bent = few_of_a_bent_surface()
    off = turned_by(fitted_quadrics(bent.points), bent.normals)
    assert off.mean() < 0.7 * turned_by(fitted_planes(bent.points)[0], bent.normals).mean()
    # A flat surface stays flat, and of few points too.
    for count in (5, 100):
        flat = np.random.default_rng(1).normal(size=(count, 3)) * [1, 1, 0]
        assert np.allclose(np.abs(fitted_quadrics(flat)), [0, 0, 1], atol=1e-6)


def test_moving_normals_of_few_points_bend_with_the_surface():
    bent = few_of_a_bent_surface()
    matrix = np.array([[0.2, -1.5, 0.1], [0.9, 0.3, 0.0], [0.1, 0.2, 0.7]])
    expected = unit(bent.normals @ np.linalg.inv(matrix))
    flat, curved = (
        turned_by(MovingNormals(bent, curved=curved)(bent.points @ matrix.T), expected).mean()
        for curved in (False, True)
    )
    assert curved < 0.7 * flat


@pytest.mark.parametrize("count", [100, 500])
def test_what_is_kept_lies_evenly_however_dense_the_cloud_is(sphere, count):
    # Nine of ten points lie on a tenth of the sphere.
    rng = np.random.default_rng(2)
    dense = unit(np.array([0.0, 0, 1]) + 0.3 * rng.normal(size=(27_000, 3)))
    points = np.concatenate([dense, sphere.points])
    kept = evenly(points, count)
    assert count / 2 < len(kept) <= count
    upper = points[kept][:, 2] > 0
    assert 0.4 < upper.mean() < 0.65
    assert np.array_equal(kept, evenly(points, count))
    # In other units the same points.
    assert np.array_equal(kept, evenly(points * 1024, count))


def test_few_points_are_all_kept_and_equal_ones_once():
    points = np.random.default_rng(0).normal(size=(20, 3))
    assert np.array_equal(evenly(points, 20), np.arange(20))
    assert len(evenly(np.repeat(points[:1], 30, axis=0), 20)) == 1


def test_moving_normals_follow_any_smooth_motion(sphere):
    normals = MovingNormals(sphere)
    assert turned_by(normals(sphere.points), sphere.normals).mean() < 1.5
    assert ((normals(sphere.points) * sphere.normals).sum(axis=1) > 0).all()
    # An affine motion takes tangents along: a sphere becomes an ellipsoid.
    matrix = np.array([[0.2, -1.5, 0.1], [0.9, 0.3, 0.0], [0.1, 0.2, 0.7]])
    expected = unit(sphere.normals @ np.linalg.inv(matrix))
    found = normals(sphere.points @ matrix.T)
    assert turned_by(found, expected).mean() < 2
    assert ((found * expected).sum(axis=1) > 0).mean() > 0.999


def test_a_thin_wall_has_two_sides():
    rng = np.random.default_rng(0)
    plane = np.concatenate([rng.uniform(-1, 1, (400, 2)), np.zeros((400, 1))], axis=1)
    points = np.concatenate([plane, plane + np.array([0.003, 0.002, 0.01])])
    up = np.tile([0.0, 0, 1], (400, 1))
    given = np.concatenate([-up, up])
    found = MovingNormals(OrientedPoints(points, given, np.zeros(800, bool)))(points)
    assert np.allclose(found, given, atol=1e-6)


def test_the_rim_is_where_faces_end():
    # A square of two triangles beside a third one that shares an edge with it.
    faces = np.array([[0, 1, 2], [0, 2, 3], [2, 1, 4]])
    edges = rim_edges(faces, 6).tolist()
    assert edges == [[0, 1], [0, 3], [1, 4], [2, 3], [2, 4]]
    closed = np.array([[0, 1, 2], [0, 3, 1], [1, 3, 2], [2, 3, 0]])
    assert not len(rim_edges(closed, 4))
    # Only the edges around a missing face of a larger mesh are its rim.
    ball = trimesh.creation.icosphere(subdivisions=2)
    rim = rim_edges(np.asarray(ball.faces)[1:], len(ball.vertices))
    assert sorted(set(rim.ravel())) == sorted(ball.faces[0])


def test_points_of_a_rim_lie_on_it_at_equal_distances():
    corners = np.array([[0.0, 0, 0], [1, 0, 0], [1, 2, 0], [0, 2, 0]])
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    rim = rim_curve(corners, rim_edges(faces, 4), 0.1)
    assert len(rim.points) == 60
    outside = np.abs(rim.points[:, :2] - [0.5, 1]) - [0.5, 1]
    assert np.allclose(outside.max(axis=1), 0)
    assert np.allclose(np.abs(rim.tangents).max(axis=1), 1)
    # Nothing of what is closed.
    closed = rim_curve(corners, rim_edges(faces[:0], 4), 0.1)
    assert closed.points.shape == closed.tangents.shape == (0, 3)


def test_planes_say_how_rough_a_cloud_is(sphere):
    rng = np.random.default_rng(0)
    flat = np.concatenate([rng.uniform(-1, 1, (4000, 2)), np.zeros((4000, 1))], axis=1)
    assert fitted_planes(flat)[1].max() < 1e-9
    some = np.array([7, 4, 3999])
    for whole, part in zip(fitted_planes(flat), fitted_planes(flat, at=some), strict=True):
        assert np.array_equal(whole[some], part)
    noisy = flat + 0.02 * rng.normal(size=flat.shape) * [0, 0, 1]
    assert np.median(fitted_planes(noisy)[1]) == pytest.approx(0.015, rel=0.2)
