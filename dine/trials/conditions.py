"""Deformations that differ from the simulations of a prior in one thing alone.

By ``dine simulate`` itself with another seed, so that nothing else differs;
:mod:`dine.trials.mechanics` has those by other mechanics.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from dine.config import Simulation
from dine.geometry.surface import Surface
from dine.priors.gaussian import covariance_root
from dine.simulation.fields import OrganDeformations
from dine.simulation.simulate import simulate

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
# off by, and how high.
_SMALL, _BUMPS, _OFF = 20, 0.3, 0.02
_SEED = 2


def of_mechanics(
    template: Surface, held: np.ndarray, settings: Simulation
) -> Iterator[tuple[str, OrganDeformations]]:
    """What simulations may be wrong about.

    Args:
        template: a closed mesh of radius 1.
        held: (V,) bool, vertices that the middle of what is held may be at.
        settings: of the simulations, and how many deformations of each.
    """
    usual = _simulated(template, held, settings, amplitude=AMPLITUDE)
    for label, changes in WRONG.items():
        changed = _simulated(template, held, settings, amplitude=AMPLITUDE, **changes)
        yield label, changed if changes else usual
    small = [size / _SMALL for size in AMPLITUDE]
    linear = _simulated(template, held, settings, amplitude=small, farthest=0.6 / _SMALL)
    yield (
        "linear elasticity",
        replace(linear, vertices=_SMALL * linear.vertices, nodes=_SMALL * linear.nodes),
    )
    yield "template off by 2 % of the radius", _off(usual)


def of_size(
    template: Surface, held: np.ndarray, settings: Simulation
) -> Iterator[tuple[str, OrganDeformations]]:
    """The same, of loads of several sizes."""
    for size in SIZES:
        label = f"loads that move the surface by {100 * size:g} %"
        yield label, _simulated(template, held, settings, amplitude=[size, size])


def _simulated(
    template: Surface, held: np.ndarray, settings: Simulation, **changes: object
) -> OrganDeformations:
    settings = settings.model_copy(update={"fixed": "about", "shared": 1, **changes})
    return simulate(template, settings, seed=_SEED, fixed=held)


def _off(fields: OrganDeformations) -> OrganDeformations:
    """The same where the organ is not shaped as its template is, by smooth bumps."""
    count = len(fields.template.vertices)
    places = np.vstack([fields.template.vertices, fields.voxels.nodes])
    root = covariance_root(places, (_BUMPS,), (1.0,), rank=300, tolerance=1e-4).root
    moved = [np.concatenate(x) for x in zip(fields.vertices, fields.nodes, strict=True)]
    for number, field in enumerate(moved):
        bumps = root @ np.random.default_rng([5, number]).normal(size=(root.shape[1], 3))
        field += (_OFF / np.linalg.norm(bumps[:count], axis=1).mean() * bumps).astype(field.dtype)
    vertices, nodes = np.split(np.stack(moved), [count], axis=1)
    return replace(fields, vertices=vertices, nodes=nodes)
