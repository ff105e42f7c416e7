import numpy as np
import pytest
import trimesh
from scipy.spatial import ConvexHull

from dine.data.synthetic import FAMILIES, primitive, tissue_patch
from dine.geometry.surface import Surface

pytestmark = pytest.mark.numerical
PRIMITIVES = range(2 * len(FAMILIES))
PATCHES = range(12)


def quality(surface: Surface) -> np.ndarray:
    """4 sqrt(3) area / sum of squared edges of every triangle: 1 equilateral, 0 degenerate."""
    corners = surface.vertices[surface.faces]
    edges = corners - np.roll(corners, 1, axis=1)
    double = np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1)
    return 2 * np.sqrt(3) * double / (edges**2).sum(axis=(1, 2))


def edge_counts(surface: Surface) -> tuple[np.ndarray, np.ndarray]:
    edges = np.sort(surface.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    return np.unique(edges, axis=0, return_counts=True)


@pytest.mark.parametrize("make", [primitive, tissue_patch])
def test_an_object_depends_on_seed_and_index_alone(make):
    first = make(5, 3)
    make(6, 3)
    again = make(5, 3)
    assert np.array_equal(first.vertices, again.vertices)
    assert np.array_equal(first.faces, again.faces)
    for other in (make(5 + 2 * len(FAMILIES), 3), make(5, 4)):
        assert first.vertices.shape != other.vertices.shape or not np.allclose(
            first.vertices, other.vertices
        )


@pytest.mark.parametrize("make", [primitive, tissue_patch])
def test_all_vertices_are_used_once_and_hang_together(make):
    for index in range(8):
        surface = make(index, 1)
        assert len(np.unique(surface.faces)) == len(surface.vertices)
        assert len(np.unique(surface.vertices, axis=0)) == len(surface.vertices)
        mesh = trimesh.Trimesh(surface.vertices, surface.faces, process=False)
        assert mesh.body_count == 1


@pytest.mark.parametrize("index", PRIMITIVES)
def test_primitives_are_closed_fine_and_sorted(index):
    surface = primitive(index, seed=2)
    mesh = trimesh.Trimesh(surface.vertices, surface.faces, process=False)
    assert mesh.is_watertight
    assert mesh.is_winding_consistent
    assert mesh.volume > 0  # outward
    assert mesh.euler_number == (0 if "torus" in surface.name or "tube" in surface.name else 2)
    assert 1500 <= len(surface.vertices) <= 4000
    assert np.array_equal(np.lexsort(surface.vertices.T[::-1]), np.arange(len(surface.vertices)))
    assert quality(surface).min() > 0.25
    length = mesh.edges_unique_length
    assert length.max() < 3 * np.median(length)
    assert length.min() > np.median(length) / 4
    assert 0.5 <= np.linalg.norm(surface.vertices, axis=1).max() <= 2


def test_primitives_take_turns_and_differ_within_a_family():
    names = [primitive(i, 0).name for i in PRIMITIVES]
    assert all(f"({family})" in name for name, family in zip(names, [*FAMILIES] * 2, strict=True))
    for index in range(len(FAMILIES)):
        one, other = (np.ptp(primitive(i, 0).vertices, axis=0) for i in (index, index + 15))
        assert not np.allclose(one / one.max(), other / other.max(), rtol=0.02)


def test_primitives_are_rotated_mildly():
    # The face normals of a box are its axes.
    box = list(FAMILIES).index("box")
    angles = []
    for turn in range(8):
        surface = primitive(box + turn * len(FAMILIES), 0)
        normals = trimesh.Trimesh(surface.vertices, surface.faces, process=False).face_normals
        angles.append(np.degrees(np.arccos(normals.max(axis=0))).max())
    assert 1 < max(angles) <= 15


@pytest.mark.parametrize("index", PATCHES)
def test_patches_are_open_height_fields(index):
    surface = tissue_patch(index, seed=2)
    points, faces = surface.vertices[:, :2], surface.faces
    assert 1500 <= len(points) <= 3500
    across = np.ptp(points, axis=0)
    assert (across > 40).all()
    assert (across < 90).all()
    assert len(np.unique(points, axis=0)) == len(points)
    a, b, c = (points[faces[:, i]] for i in range(3))
    doubled_area = np.linalg.det(np.stack([b - a, c - a], axis=1))
    assert (doubled_area > 0).all()  # upward, and no triangle folds over: z is a function of (x, y)
    edges, counts = edge_counts(surface)
    assert counts.max() == 2
    assert len(points) - len(edges) + len(faces) == 1  # a disc: no holes
    border = edges[counts == 1]
    assert (np.bincount(border.ravel())[np.unique(border)] == 2).all()  # no pinched border
    flat = Surface(surface.vertices * [1, 1, 0], faces)
    assert quality(flat).min() > 0.3
    assert quality(surface).min() > 0.15


def test_outlines_have_bays():
    fill = []
    for index in PATCHES:
        surface = tissue_patch(index, 2)
        flat = trimesh.Trimesh(surface.vertices * [1, 1, 0], surface.faces, process=False)
        fill.append(flat.area / ConvexHull(surface.vertices[:, :2]).volume)
    assert max(fill) < 1
    assert min(fill) < 0.98


def test_cavities_sink_and_cut_pieces_rise():
    for index in PATCHES:
        surface = tissue_patch(index, 2)
        x, y, z = surface.vertices.T
        edges, counts = edge_counts(surface)
        rim = z[np.unique(edges[counts == 1])]
        middle = z[np.hypot(x, y) < 4]
        if index % 2 == 0:
            assert "RC" in surface.name
            assert np.median(middle) < z.max() - 5
            # A steep wall: somewhere the surface is tilted by more than 50 degrees.
            mesh = trimesh.Trimesh(surface.vertices, surface.faces, process=False)
            assert mesh.face_normals[:, 2].min() < np.cos(np.radians(50))
        else:
            assert "CT" in surface.name
            assert np.median(middle) > np.median(rim) + 3
