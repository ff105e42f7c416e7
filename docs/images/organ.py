"""Draw organ.png, the picture of docs/guide/organ.md: python docs/images/organ.py"""

from importlib import resources
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
import trimesh

import dine
from dine.config import OrganLearning, Simulation
from dine.geometry.surface import Surface
from dine.io.readers import read_surface
from dine.priors.organ_learning import learn
from dine.simulation.simulate import simulate

template = read_surface(resources.files("dine") / "scans" / "before.ply")
fields = simulate(template, Simulation(), seed=0, workers=2)
prior = learn(template, [fields], OrganLearning())
# A deformation that was not learned from.
truth = template.vertices + simulate(template, Simulation(fields=12), seed=7).vertices[9]
direction = np.array([0.3, -0.5, 0.8])
height = truth[template.faces].mean(axis=1) @ direction
seen = template.faces[height > np.quantile(height, 0.6)]
used, index = np.unique(seen, return_inverse=True)
scan = Surface(truth[used], index.reshape(-1, 3), name="scan")
ball = trimesh.creation.icosphere(subdivisions=2, radius=0.12 * prior.frame.scale)
tumour = Surface(np.asarray(ball.vertices) + prior.frame.center, np.asarray(ball.faces))
result = dine.register(
    template, scan, prior=prior, partial=True, prealign="off", apply={"tumour": tumour}
)
radius = prior.frame.scale
error = np.linalg.norm(result.moved.vertices - truth, axis=1) / radius
before = np.linalg.norm(template.vertices - truth, axis=1) / radius

figure = plt.figure(figsize=(11, 4.2), layout="constrained")
low, high = truth.min(axis=0), truth.max(axis=0)
panels = (
    (f"template, mean error {before.mean():.3f} radii", template, before),
    (f"moved, mean error {error.mean():.3f} radii", result.moved, error),
    ("moved, 90 % bound in radii", result.moved, result.bound / radius),
)
for number, (title, surface, values) in enumerate(panels):
    axes = figure.add_subplot(1, 3, number + 1, projection="3d")
    x, y, z = surface.vertices.T
    drawn = axes.plot_trisurf(x, y, z, triangles=surface.faces, cmap="viridis", alpha=0.55)
    drawn.set_array(values[surface.faces].mean(axis=1))
    drawn.set_clim(0, before.max() if number < 2 else values.max())
    axes.scatter(*scan.vertices.T, s=1, color="black")
    inside = tumour if number == 0 else result.applied["tumour"]
    axes.plot_trisurf(*inside.vertices.T, triangles=inside.faces, color="crimson")
    figure.colorbar(drawn, ax=axes, shrink=0.6)
    axes.set_title(title, fontsize=10)
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
    axes.set_box_aspect(high - low)
    axes.view_init(20, -60)
    axes.set_axis_off()
figure.savefig(Path(__file__).with_suffix(".png"), dpi=100)
