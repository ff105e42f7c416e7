"""Draw register.png, the README's picture: python docs/images/register.py"""

from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
import trimesh
from matplotlib.colors import LightSource

import dine
from dine.data.deformation import rbf_displacement
from dine.geometry.surface import Surface

rng = np.random.default_rng(11)
# A synthetic organ: a sphere with lobes.
sphere = trimesh.creation.icosphere(subdivisions=5)
lobes = np.array([[1, 0.2, 0], [-0.6, 0.7, 0.4], [0, -1, 0.3], [0.3, 0.2, -0.9], [-0.5, -0.4, 0.8]])
lobes /= np.linalg.norm(lobes, axis=1, keepdims=True)
squared = ((sphere.vertices[:, None] - lobes) ** 2).sum(axis=2)
size = 1 + (np.exp(-squared / 0.12) * [0.9, 0.6, 0.8, 0.5, 0.7]).sum(axis=1)
source = Surface(sphere.vertices * size[:, None] * [1, 0.8, 0.7], sphere.faces, name="source")
moves = rbf_displacement(
    source, level=0.4, control_percent=5, width=0.4, amplitude=0.15, points=1024, rng=rng
)
target = Surface(source.vertices + moves, source.faces, name="target")
result = dine.register(source, target)
error = np.linalg.norm(result.moved.vertices - target.vertices, axis=1)
radius = np.linalg.norm(source.vertices - source.vertices.mean(axis=0), axis=1).max()

figure = plt.figure(figsize=(11, 4.2), layout="constrained")
everything = np.concatenate([source.vertices, target.vertices])
low, high = everything.min(axis=0), everything.max(axis=0)
before = np.linalg.norm(moves, axis=1).mean() / radius
panels = (
    ("source", source, None),
    ("target (synthetic deformation)", target, None),
    ("source moved by DINE", result.moved, error / radius),
)
for number, (title, surface, values) in enumerate(panels):
    axes = figure.add_subplot(1, 3, number + 1, projection="3d")
    x, y, z = surface.vertices.T
    drawn = axes.plot_trisurf(
        x,
        y,
        z,
        triangles=surface.faces,
        color=("#d08a3c", "#8794a3", None)[number],
        cmap=None if values is None else "viridis",
        linewidth=0,
        antialiased=False,
        lightsource=LightSource(315, 40),
        shade=values is None,
    )
    if values is not None:
        drawn.set_array(values[surface.faces].mean(axis=1))
        drawn.set_clim(0, before)
        figure.colorbar(drawn, ax=axes, shrink=0.7, label="distance from the true place (radii)")
        title += f", mean error {before:.3f} → {values.mean():.3f} radii"
    axes.set_title(title, fontsize=10)
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
    axes.set_box_aspect(high - low)
    axes.view_init(18, -60)
    axes.set_axis_off()
figure.savefig(Path(__file__).with_suffix(".png"), dpi=110)
