"""Draw population.png, the picture of docs/guide/population.md: python docs/images/population.py

Twelve synthetic scans of one organ, which differ in two ways, and share no vertices. What is
printed are the numbers of the page: the shape model of registrations beside that of the true
places, and what its prior says of another organ that is seen in part.
"""

from importlib import resources
from pathlib import Path

import fast_simplification
import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

import dine
from dine.geometry.surface import Surface
from dine.io.readers import read_surface
from dine.priors.shape_model import Member, rms, shape_model_of
from dine.priors.shape_quality import shape_quality

template = read_surface(resources.files("dine") / "scans" / "before.ply")
x, y, z = (template.vertices - template.vertices.mean(axis=0)).T
radius = np.linalg.norm([x, y, z], axis=0).max()
ways = np.stack([0.1 * np.column_stack([x, 0 * x, 0 * x]), 0 * template.vertices])
ways[1][:, 2] = 0.2 * (x**2 / radius - np.mean(x**2 / radius))
amplitudes = np.random.default_rng(0).normal(size=(12, 2))
truth = template.vertices + np.tensordot(amplitudes, ways, axes=1)
scans = {}
for number, vertices in enumerate(truth):
    few = fast_simplification.simplify(
        vertices.astype(np.float32), template.faces.astype(np.int32), 0.45
    )
    scans[f"scan {number}"] = Surface(*few, name=f"scan {number}")

found = dine.shape_model(template, scans)
exact = shape_model_of(template, [Member(str(i), v) for i, v in enumerate(truth)])
used = template.used
for name, model in (("true places", exact), ("registered", found)):
    row = list(shape_quality(model).rows())[2]
    print(
        f"{name}: {len(model.shapes)} scans, {model.kept} modes kept, deviations "
        f"{np.round(100 * model.deviations[:4] / radius, 2)} % of the radius, "
        f"compactness {row['compactness']:.3f}, generalisation "
        f"{row['generalisation_percent']:.2f}, specificity {row['specificity_percent']:.2f} %"
    )
errors = [
    rms(found.placed(member.vertices) - found.placed(true), used)
    for member, true in zip(found.members, truth, strict=True)
]
print(f"error of the vertices: {100 * np.mean(errors) / radius:.2f} % of the radius")
print(f"error of the mean: {100 * rms(found.mean - exact.placed(exact.mean), used) / radius:.2f} %")
spans = [model.modes[:2].reshape(2, -1) for model in (exact, found)]
along = [np.linalg.svd(span, full_matrices=False)[2] for span in spans]
print("cosines between their first two modes:", np.linalg.svd(along[0] @ along[1].T)[1])

# Another organ of the kind, of which 40 % is seen.
place = template.vertices + np.tensordot([1.2, -0.8], ways, axes=1)
height = place[template.faces].mean(axis=1) @ [0.3, -0.5, 0.8]
faces = template.faces[height > np.quantile(height, 0.6)]
seen, index = np.unique(faces, return_inverse=True)
scan = Surface(place[seen], index.reshape(-1, 3), name="part")
hidden = np.setdiff1d(np.arange(len(place)), seen)
for name, prior in (("without the prior", None), ("with it", found.prior)):
    moved = dine.register(template, scan, prior=prior, partial=True).moved.vertices
    apart = 100 * np.linalg.norm(moved - place, axis=1) / radius
    print(f"a part, {name}: hidden {apart[hidden].mean():.2f}, seen {apart[seen].mean():.2f} %")
before = 100 * np.linalg.norm(template.vertices - place, axis=1) / radius
print(f"unregistered: hidden {before[hidden].mean():.2f}, seen {before[seen].mean():.2f} %")

figure = plt.figure(figsize=(11, 6), layout="constrained")
shown = np.stack([found.shape([0] * row + [x]).vertices for row in (0, 1) for x in (-2, 2)])
low, high = shown.min(axis=(0, 1)), shown.max(axis=(0, 1))
for row in range(2):
    for column, amplitude in enumerate((-2, 0, 2)):
        axes = figure.add_subplot(2, 4, 4 * row + column + 1, projection="3d")
        shape = found.shape([0] * row + [amplitude])
        axes.plot_trisurf(*shape.vertices.T, triangles=shape.faces, color="#3f7fc4")
        axes.set_title(f"mode {row + 1}, {amplitude:+d} sd" if amplitude else "mean", fontsize=10)
        axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
        axes.set_box_aspect(high - low, zoom=1.15)
        axes.view_init(10, -75)
        axes.set_axis_off()
quality = shape_quality(found)
percent = 100 / quality.radius
for row, name in enumerate(("generalisation", "specificity")):
    axes = figure.add_subplot(2, 4, 4 * row + 4)
    axes.plot(percent * getattr(quality, name), "o-", color="#d08a3c", markersize=3)
    axes.axvline(found.kept, color="grey", linestyle=":")
    axes.set(xlabel="modes", ylabel="% of the radius", ylim=(0, 1.05 * axes.get_ylim()[1]))
    axes.locator_params(axis="x", integer=True)
    axes.set_title(name, fontsize=10)
figure.savefig(Path(__file__).with_suffix(".png"), dpi=100)
