"""A shape model of registrations beside that of true correspondences, and its prior on scans left
out: python benchmarks/population.py TEMPLATE SCAN...

The scans are the template deformed (same vertices), so that the true place of each vertex is known;
registered are simplified copies, which share no vertices with it. Errors in percent of the radius.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import fast_simplification
import numpy as np

import dine
from dine.geometry.surface import Surface
from dine.priors.shape_model import Member, ShapeModel, rms, shape_model_of
from dine.priors.shape_quality import shape_quality

KEPT_FACES = 0.55


def simplified(surface: Surface) -> Surface:
    """A scan of the same, with vertices of its own."""
    vertices, faces = fast_simplification.simplify(
        surface.vertices.astype(np.float32), surface.faces.astype(np.int32), 1 - KEPT_FACES
    )
    return Surface(vertices, faces, name=surface.name)


def described(name: str, model: ShapeModel) -> str:
    row = list(shape_quality(model).rows())[model.kept]
    deviations = ", ".join(f"{100 * x / model.radius:.2f}" for x in model.deviations)
    return (
        f"| {name} | {deviations} | {model.kept} | {100 * row['compactness']:.0f} % | "
        f"{row['generalisation_percent']:.2f} | {row['specificity_percent']:.2f} |"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("template", type=Path)
    parser.add_argument("scans", type=Path, nargs="+")
    given = parser.parse_args()
    template = dine.read_surface(given.template)
    truth = {path.stem: dine.read_surface(path) for path in given.scans}
    scans = {name: simplified(surface) for name, surface in truth.items()}
    results = {name: dine.register(template, scan) for name, scan in scans.items()}
    members = [Member(name, surface.vertices) for name, surface in truth.items()]
    exact = shape_model_of(template, members)
    found = dine.shape_model(template, results, include_doubtful=True)
    print("| model | standard deviations of its modes | kept | variance | gen. | spec. |")
    print(described("true places", exact))
    print(described("registered", found))
    used, percent = template.used, 100 / found.radius
    print(f"mean shapes apart: {percent * rms(found.mean - exact.placed(exact.mean), used):.2f}")
    print("| scan | verdict | unregistered | registered | by the prior of the others |")
    for name, surface in truth.items():
        others = {other: result for other, result in results.items() if other != name}
        prior = dine.shape_model(template, others, include_doubtful=True).prior
        moved = dine.register(template, scans[name], prior=prior).moved
        errors = [
            percent * np.linalg.norm(place - surface.vertices, axis=1)[used].mean()
            for place in (template.vertices, results[name].moved.vertices, moved.vertices)
        ]
        verdict = results[name].trust.verdict
        print(f"| {name} | {verdict} | " + " | ".join(f"{x:.2f}" for x in errors) + " |")


if __name__ == "__main__":
    main()
