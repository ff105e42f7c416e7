"""Targets for training and tests by finite elements, in place of the published recipe."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from dine.config import Recipe, Simulation
from dine.files import digest
from dine.geometry.surface import Surface
from dine.simulation.fields import labelled_vertices
from dine.simulation.simulate import simulate

_SEEDS = 2**63


@dataclass(frozen=True)
class ElasticDeformations:
    """Deformations of a closed mesh, each at every level: the same body under larger loads.

    Attributes:
        levels: mean displacements of the surface by linear elasticity, radii.
        pairs_per_level: deformations of an object.
        settings: of :class:`~dine.config.Elasticity`.
        fixed_label: which vertices do not move, see
            :func:`~dine.simulation.fields.labelled_vertices`; None to draw patches.
        seed: of all that is drawn, with the object's name.
    """

    levels: Sequence[float]
    pairs_per_level: int
    settings: dict[str, Any]
    fixed_label: str | None
    seed: int

    explained = """\
Recipe: finite elements (docs/guide/organ.md). Loads, stiffness and what is fixed are drawn; loads
are as large as move the surface by the level, in object radii, by linear elasticity. a is the
number of the deformation, which has the same body and loads, larger ones, at every level; b is
0."""

    @classmethod
    def of(cls, recipe: Recipe, seed: int) -> ElasticDeformations:
        """Those of a recipe."""
        settings = recipe.elastic.model_dump()
        return cls(recipe.levels, recipe.pairs_per_level, settings, recipe.fixed_label, seed)

    def targets(self, surface: Surface, name: str) -> Iterator[tuple[tuple[str, str], Surface]]:
        """((level, <object>_<a>_<b>), deformed surface) of all pairs of one object.

        Raises:
            DataError: a mesh without an inside, without the label, or too thin for the cubes.
        """
        fixed = self.fixed_label and labelled_vertices(surface, self.fixed_label)
        seed = int(digest([self.seed, name]), 16) % _SEEDS
        for level in self.levels:
            settings = Simulation(
                **self.settings, fields=self.pairs_per_level, amplitude=[level, level], shared=1
            )
            fields = simulate(surface, settings, seed=seed, fixed=fixed).vertices
            for number, field in enumerate(fields):
                pair = f"{name}_{number}_0"
                moved = Surface(surface.vertices + field, surface.faces, name=f"target {pair}")
                yield (format(level, "g"), pair), moved
