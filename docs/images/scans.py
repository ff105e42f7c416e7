"""Make the two scans that come with the package: python docs/images/scans.py"""

from pathlib import Path

import fast_simplification
import numpy as np
import trimesh

import dine
from dine.data.deformation import rbf_displacement
from dine.geometry.surface import Surface
from dine.io.writers import write_surface

FOLDER = Path(dine.__file__).parent / "scans"
rng = np.random.default_rng(11)
# A synthetic organ of some 8 cm, in millimetres: a sphere with lobes.
sphere = trimesh.creation.icosphere(subdivisions=4)
lobes = np.array([[1, 0.2, 0], [-0.6, 0.7, 0.4], [0, -1, 0.3], [0.3, 0.2, -0.9], [-0.5, -0.4, 0.8]])
lobes /= np.linalg.norm(lobes, axis=1, keepdims=True)
squared = ((sphere.vertices[:, None] - lobes) ** 2).sum(axis=2)
size = 1 + (np.exp(-squared / 0.12) * [0.9, 0.6, 0.8, 0.5, 0.7]).sum(axis=1)
before = Surface(30 * sphere.vertices * size[:, None] * [1, 0.8, 0.7], sphere.faces)
moves = rbf_displacement(
    before, level=0.4, control_percent=5, width=0.4, amplitude=0.15, points=1024, rng=rng
)
# Another scan has points of its own.
vertices, faces = fast_simplification.simplify(
    (before.vertices + moves).astype(np.float32), before.faces.astype(np.int32), 0.3
)
write_surface(FOLDER / "before.ply", before)
write_surface(FOLDER / "after.ply", Surface(vertices, faces))
