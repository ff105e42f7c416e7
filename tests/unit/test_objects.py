"""Scans as objects of other packages; where one is not installed, a stand-in has its attributes."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch
import trimesh

import dine
from dine.errors import DataError
from dine.registration.shapes import as_surface

BALL = trimesh.creation.icosphere(subdivisions=2)
V, F = np.asarray(BALL.vertices), np.asarray(BALL.faces)
FLAT = np.insert(F, 0, 3, axis=1).reshape(-1)


def assert_same(shape, faces=F):
    found = as_surface(shape, "source")
    np.testing.assert_array_equal(found.vertices, V)
    np.testing.assert_array_equal(found.faces, faces)


def test_trimesh():
    assert_same(BALL)
    assert_same(trimesh.PointCloud(V), None)
    with pytest.raises(DataError, match=r"type trimesh\.scene\.scene\.Scene .*; expected a file"):
        as_surface(trimesh.Scene(BALL), "source")


@pytest.mark.parametrize("grad", [False, True])
def test_tensors(grad):
    tensor = torch.tensor(V, requires_grad=grad)
    assert_same(tensor, None)
    assert_same((tensor, torch.tensor(F)))
    assert_same((tensor, None), None)
    half = as_surface(tensor.to(torch.bfloat16), "source").vertices
    np.testing.assert_allclose(half, V, atol=0.01)


def test_stand_ins():
    """As Open3D, PyVista and meshio hold meshes and clouds."""
    assert_same(SimpleNamespace(vertices=V, triangles=F))
    assert_same(SimpleNamespace(points=V), None)
    assert_same(SimpleNamespace(to_legacy=lambda: SimpleNamespace(vertices=V, triangles=F)))
    pyvista = {"points": V, "strips": np.empty(0, int), "lines": np.empty(0, int)}
    assert_same(SimpleNamespace(faces=FLAT, **pyvista))
    assert_same(SimpleNamespace(faces=np.empty(0, int), **pyvista), None)
    mixed = SimpleNamespace(points=V, faces=np.array([4, 0, 1, 2, 3, 3, 4, 5, 6]))
    assert_same(mixed, [[0, 1, 2], [0, 2, 3], [4, 5, 6]])
    strips = SimpleNamespace(points=V, faces=np.empty(0, int), strips=np.array([4, 0, 1, 2, 3]))
    assert_same(strips, [[0, 1, 2], [1, 3, 2]])
    assert_same(SimpleNamespace(points=V, cells_dict={"triangle": F, "line": F[:, :2]}))
    assert_same(SimpleNamespace(points=V, cells_dict={"vertex": F[:, :1]}), None)
    quads = {"triangle": F[:2], "quad": np.array([[0, 1, 2, 3]])}
    assert_same(SimpleNamespace(points=V, cells_dict=quads), [*F[:2], [0, 1, 2], [0, 2, 3]])


def test_the_packages_themselves():
    pyvista = pytest.importorskip("pyvista", reason="PyVista (with VTK, 140 MB) is not installed")
    assert_same(pyvista.PolyData(V, FLAT))
    open3d = pytest.importorskip("open3d", reason="Open3D is not installed")
    mesh = open3d.geometry.TriangleMesh(
        open3d.utility.Vector3dVector(V), open3d.utility.Vector3iVector(F)
    )
    assert_same(mesh)


@pytest.mark.parametrize(
    ("shape", "said"),
    [
        ({"a": 1}, "type builtins.dict .*expected a file, .V, 3. points"),
        (None, "type builtins.NoneType|no array of numbers"),
        ([[1, 2, 3], [4]], "expected a file, .V, 3. points|no array of numbers"),
        (np.zeros((1, 5, 3)), r"shape \(V, 3\), found \(1, 5, 3\)"),
        ((V, F, F), "expected a file"),
        (SimpleNamespace(points=V, cells_dict={"tetra": F}), "kinds tetra and no triangles"),
        (SimpleNamespace(vertices=V, tetras=np.zeros((1, 4))), "holds tetrahedra"),
        (SimpleNamespace(points=V, faces=FLAT[:-1]), "do not add up"),
    ],
)
def test_what_is_no_scan(shape, said):
    with pytest.raises(DataError, match=said):
        as_surface(shape, "source")


def test_they_are_registered_and_moved():
    target = trimesh.Trimesh(V * [1.2, 1, 0.9], F, process=False)
    result = dine.register(BALL, (torch.tensor(target.vertices), torch.tensor(F)), points=100)
    moved = result.transform(BALL)
    np.testing.assert_array_equal(moved.faces, F)
    np.testing.assert_array_equal(result.transform(torch.tensor(V)), moved.vertices)
    np.testing.assert_allclose(moved.vertices, result.moved.vertices, atol=1e-9)
