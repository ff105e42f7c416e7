"""Draw register.png, the README's picture: python docs/images/register.py"""

from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.colors import LightSource

import dine
from dine.data.deformation import rbf_displacement
from dine.data.surface import Surface
from dine.data.synthetic import primitive

rng = np.random.default_rng(11)
source = primitive(7, seed=3)
moves = rbf_displacement(
    source, level=0.5, control_percent=5, width=0.5, amplitude=0.15, points=1024, rng=rng
)
target = Surface(source.vertices + moves, source.faces, name="target")
result = dine.register(source, target)
error = np.linalg.norm(result.moved.vertices - target.vertices, axis=1)
radius = np.linalg.norm(source.vertices - source.vertices.mean(axis=0), axis=1).max()

figure = plt.figure(figsize=(11, 3.6), layout="constrained")
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
        title += f"\nmean error {before:.3f} → {values.mean():.3f} radii"
    axes.set_title(title, fontsize=10)
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
    axes.set_box_aspect(high - low)
    axes.view_init(18, -60)
    axes.set_axis_off()
figure.savefig(Path(__file__).with_suffix(".png"), dpi=110)
