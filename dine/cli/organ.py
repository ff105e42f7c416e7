"""Commands for a prior of one's own organ."""

from __future__ import annotations

import os
from pathlib import Path

import click

from dine import __version__, config
from dine.cli.console import tell
from dine.cli.options import IN, gathered, own_out_option, seed_option, settings_option


def _simulation(fields: int | None, settings: config.Simulation) -> config.Simulation:
    return settings if fields is None else settings.model_copy(update={"fields": fields})


@click.command()
@click.argument("template", type=IN)
@own_out_option("Fields to write (HDF5).")
@gathered(
    "known",
    dict,
    click.option(
        "--fixed", type=IN, help="Text file of vertices that do not move, numbered from 0."
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

    Example: dine simulate liver.ply -o fields.h5
    """
    from dine.io.readers import read_surface
    from dine.simulation.fields import read_vertex_numbers, write_deformations
    from dine.simulation.simulate import simulate as run

    surface = read_surface(template)
    fixed, inclusion = known["fixed"], known["inclusion"]
    found = run(
        surface,
        settings,
        seed=seed,
        fixed=fixed and read_vertex_numbers(fixed, len(surface.vertices)),
        inclusion=inclusion and read_surface(inclusion),
        workers=workers or os.cpu_count() or 1,
    )
    facts = {"seed": seed, "settings": settings.model_dump_json(), "version": __version__}
    write_deformations(out, found, facts)
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
