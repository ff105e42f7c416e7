"""Commands for a prior of one's own organ."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

import click

from dine import __version__, config
from dine.cli.console import tell
from dine.cli.options import IN, gathered, own_out_option, seed_option, settings_option
from dine.errors import ConfigError
from dine.files import digest
from dine.provenance import code_digest

if TYPE_CHECKING:
    import numpy as np

    from dine.geometry.surface import Surface


def _simulation(fields: int | None, settings: config.Simulation) -> config.Simulation:
    return settings if fields is None else settings.model_copy(update={"fields": fields})


def _fixed(surface: Surface, file: Path | None, label: str | None) -> np.ndarray | None:
    """Mask (V,) of the vertices that do not move; None to have patches drawn.

    Raises:
        ConfigError: said twice.
        DataError: as for the two.
    """
    from dine.simulation.fields import labelled_vertices, read_vertex_numbers

    if file and label:
        raise ConfigError("What is fixed is said by --fixed or by --fixed-label, not by both.")
    if label:
        return labelled_vertices(surface, label)
    return read_vertex_numbers(file, len(surface.vertices)) if file else None


def _simulation_key(
    surface: Surface,
    settings: config.Simulation,
    seed: int,
    fixed: np.ndarray | None,
    inclusion: Surface | None,
) -> str:
    """Digest of all that decides on a field."""
    from dine.simulation.fields import template_digest

    said = [
        template_digest(surface),
        inclusion and template_digest(inclusion),
        None if fixed is None else fixed.nonzero()[0].tolist(),
        settings.model_dump(exclude={"fields"}),
        seed,
        code_digest("simulate"),
    ]
    return digest(said)


@click.command()
@click.argument("template", type=IN)
@own_out_option("Fields to write (HDF5).")
@gathered(
    "known",
    dict,
    click.option(
        "--fixed", type=IN, help="Text file of vertices that do not move, numbered from 0."
    ),
    click.option(
        "--fixed-label",
        metavar="NAME[=VALUE]",
        help="The same by a label of TEMPLATE's vertices: those of a value, or of all but 0.",
    ),
    click.option("--inclusion", type=IN, help="A closed mesh within TEMPLATE that is stiffer."),
)
@gathered(
    "settings",
    _simulation,
    click.option("--fields", type=click.IntRange(2), help="How many; 200 by default."),
    settings_option(config.Simulation),
)
@seed_option
@click.option("--workers", type=click.IntRange(1), help="Threads; one for each CPU by default.")
def simulate(template, out, known, settings, seed, workers):
    """Deform TEMPLATE, a closed mesh of an organ, by finite elements under drawn loads.

    What an interrupted run finished is kept beside OUT; the same command goes on from there.

    Example: dine simulate liver.ply -o fields.h5
    """
    from dine.io.readers import read_surface
    from dine.simulation.fields import write_deformations
    from dine.simulation.simulate import simulate as run
    from dine.simulation.unfinished import Unfinished

    surface = read_surface(template)
    fixed = _fixed(surface, known["fixed"], known["fixed_label"])
    inclusion = known["inclusion"] and read_surface(known["inclusion"])
    kept = Unfinished(out, _simulation_key(surface, settings, seed, fixed, inclusion))
    found = run(
        surface,
        settings,
        seed=seed,
        fixed=fixed,
        inclusion=inclusion,
        workers=workers or os.cpu_count() or 1,
        kept=kept,
    )
    facts = {"seed": seed, "settings": settings.model_dump_json(), "version": __version__}
    write_deformations(out, found, facts)
    kept.remove()
    counts = f"{len(surface.vertices)} vertices and {len(found.nodes[0])} nodes"
    tell([f"{out}: {len(found.vertices)} fields of {counts}"])


@click.command()
@click.argument("template", type=IN)
@click.argument("fields", nargs=-1, required=True, type=click.Path(path_type=Path))
@own_out_option("Prior to write (HDF5).")
@settings_option(config.OrganLearning)
@seed_option
def learn(template, fields, out, settings, seed):
    """Learn a prior of TEMPLATE, a mesh of an organ, from FIELDS.

    FIELDS are files of `dine simulate`, and folders of meshes that are TEMPLATE deformed.

    Example: dine learn liver.ply fields.h5 -o organ.prior
    """
    from dine.io.readers import read_surface
    from dine.priors.organ_learning import learn as run
    from dine.simulation.fields import OrganDeformations, deformed_meshes, read_deformations

    surface = read_surface(template)
    sets: list[OrganDeformations] = [
        deformed_meshes(path, surface) if path.is_dir() else read_deformations(path)
        for path in fields
    ]
    prior = run(surface, sets, settings, seed=seed)
    prior.save(out)
    radii = ", ".join(f"{x:.3f}" for x in prior.amplitudes)
    found = f"{len(prior.modes)} components of {prior.facts['fields']} fields"
    tell([f"{out}: {found}, and a process of {radii} radii"])
