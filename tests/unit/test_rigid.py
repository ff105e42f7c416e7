"""Rigid motions between points."""

import numpy as np
import pytest
import trimesh.registration
from scipy.spatial.transform import Rotation

from dine.geometry.rigid import motion_between, rigid_alignment, transformed

pytestmark = pytest.mark.numerical


def cloud(count=300):
    return np.random.default_rng(0).normal(size=(count, 3)) * [3, 2, 1] + [5, -2, 8]


@pytest.mark.parametrize("weighted", [False, True])
def test_a_motion_is_that_of_least_squares(weighted):
    rng = np.random.default_rng(1)
    points = cloud()
    others = Rotation.from_rotvec([0.3, -1.2, 2.0]).apply(points) + rng.normal(size=(300, 3))
    weight = rng.random(300) if weighted else None
    middles = [np.average(x, axis=0, weights=weight) for x in (points, others)]
    turn, _ = Rotation.align_vectors(others - middles[1], points - middles[0], weights=weight)
    found = motion_between(points, others, weight)
    assert np.allclose(found[:3, :3], turn.as_matrix())
    assert np.allclose(transformed(middles[0], found), middles[1])


def test_a_mirror_image_is_turned_and_not_mirrored():
    found = motion_between(cloud(), cloud() * [1, 1, -1])
    assert np.linalg.det(found[:3, :3]) == pytest.approx(1)


def test_closest_points_end_where_those_of_trimesh_do():
    points = cloud()
    target = Rotation.from_rotvec([0.0, 0.1, 0.2]).apply(cloud(400)) + np.array([1.0, 0.5, 0])
    # What the tolerance means depends on the units: those of the alignment are of the object.
    centre = np.median(points, axis=0)
    size = np.median(np.linalg.norm(points - centre, axis=1))
    a, b = ((x - centre) / size for x in (points, target))
    start = np.eye(4)
    start[:3, 3] = b.mean(axis=0) - a.mean(axis=0)
    options = {"threshold": 1e-7, "max_iterations": 60, "reflection": False, "scale": False}
    motions = (np.eye(4), start)
    moved = [trimesh.registration.icp(a, b, initial=x, **options)[1] for x in motions]
    found = (transformed(points, rigid_alignment(points, target)) - centre) / size
    assert min(np.abs(found - one).max() for one in moved) < 1e-6
