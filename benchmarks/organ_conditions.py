"""Deformations that differ from the simulations of a prior in one thing alone.

By ``dine simulate`` itself with another seed, so that nothing else differs; :mod:`organ_truth` has
those by other mechanics.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from organ_truth import inside_points

from dine.config import Simulation
from dine.geometry.surface import Surface
from dine.priors.gaussian import covariance_root
from dine.simulation.simulate import simulate

Fields = list[tuple[np.ndarray, np.ndarray]]

AMPLITUDE = [0.08, 0.2]
WRONG = {
    "as simulated": {},
    "held in larger patches (0.5 to 0.8)": {"patch": [0.5, 0.8]},
    "stiffness varies by a factor of 25, Poisson ratio 0.3 to 0.38": {
        "stiffness": [0.2, 5.0],
        "poisson": [0.3, 0.38],
    },
    "narrower loads (0.15 to 0.3), five at once": {"width": [0.15, 0.3], "together": 5},
    "forces and pressure alone": {"loads": ["force", "pressure"]},
}
SIZES = (0.05, 0.1, 0.2, 0.3)
# Deformations so small that elasticity is linear, and how wide the bumps are that a template is
# off by.
_SMALL, _BUMPS, _OFF = 20, 0.3, 0.02


def conditions(template: Surface, held: np.ndarray, count: int) -> Iterator[tuple[str, Fields]]:
    """Label and fields of each, as :func:`organ_truth.true_field` gives them."""
    for label, changes in WRONG.items():
        yield label, _simulated(template, held, count, amplitude=AMPLITUDE, **changes)
    small = [size / _SMALL for size in AMPLITUDE]
    linear = _simulated(template, held, count, amplitude=small, farthest=0.6 / _SMALL)
    yield "linear elasticity", [(_SMALL * field, _SMALL * deep) for field, deep in linear]
    fields = _simulated(template, held, count, amplitude=AMPLITUDE)
    yield "template off by 2 % of the radius", [_off(template, *x, i) for i, x in enumerate(fields)]
    for size in SIZES:
        label = f"loads that move the surface by {size:.0%}"
        yield label, _simulated(template, held, count, amplitude=[size, size])


def _simulated(template: Surface, held: np.ndarray, count: int, **changes: object) -> Fields:
    settings = Simulation(fixed="about", shared=1, fields=count, **changes)
    found = simulate(template, settings, seed=2, fixed=held)
    inside = found.voxels.carrier(inside_points(template))
    return [(x.astype(float), inside @ y) for x, y in zip(found.vertices, found.nodes, strict=True)]


def _off(template: Surface, field: np.ndarray, deep: np.ndarray, number: int):
    """The same where the organ is not shaped as its template is, by smooth bumps."""
    places = np.vstack([template.vertices, inside_points(template)])
    root = covariance_root(places, (_BUMPS,), (1.0,), rank=300, tolerance=1e-4).root
    bumps = root @ np.random.default_rng([5, number]).normal(size=(root.shape[1], 3))
    count = len(field)
    bumps *= _OFF / np.linalg.norm(bumps[:count], axis=1).mean()
    return field + bumps[:count], deep + bumps[count:]
