"""Commands for a prior of one's own organ."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

import click

from dine import __version__, config
from dine.cli.console import tell
from dine.cli.options import (
    IN,
    OUT_FOLDER,
    gathered,
    out_option,
    own_out_option,
    seed_option,
    settings_option,
)
from dine.errors import ConfigError
from dine.files import digest, write_text
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


@click.command()
@click.argument("mesh", type=IN)
@out_option("Folder to write to.", OUT_FOLDER)
def organ_template(mesh, out):
    """Write MESH in radii, and the vertices that simulations of a trial are held at, or about.

    Example: dine organ-template liver.ply --out trial
    """
    from dine.geometry.frame import Frame
    from dine.geometry.surface import Surface
    from dine.geometry.voxels import closed_mesh
    from dine.io.readers import read_surface
    from dine.io.writers import write_surface
    from dine.results import TrialFiles
    from dine.trials.mechanics import held, patch

    found = read_surface(mesh)
    closed_mesh(found)  # nothing is written of another
    vertices = Frame.of(found.vertices, found.name).normalise(found.vertices)
    files = TrialFiles(out)
    write_surface(files.template, Surface(vertices, found.faces, found.name))
    for how, where in (("about", held), ("patch", patch)):
        numbers = where(Surface(vertices, found.faces)).nonzero()[0].tolist()
        write_text(files.held(how), "".join(f"{number}\n" for number in numbers))


@click.command()
@click.argument("template", type=IN)
@settings_option(config.OrganTrial)
@seed_option
@out_option("Deformations to write (HDF5).")
def organ_truth(template, settings, seed, out):
    """Deform TEMPLATE of `dine organ-template` by other mechanics than those of `dine simulate`.

    Example: dine organ-truth trial/template.ply --out trial/truth.h5
    """
    from dine.io.readers import read_surface
    from dine.simulation.fields import write_deformations
    from dine.trials.mechanics import true_deformations

    surface = read_surface(template)
    found = true_deformations(surface, settings.deformations, seed, edge=settings.edge)
    write_deformations(out, found, {"seed": seed, "version": __version__})


@click.command()
@gathered(
    "files",
    dict,
    click.option("--truth", type=IN, required=True, help="Of `dine organ-truth`."),
    click.option("--held", type=IN, required=True, help="Of `dine organ-template`, held_about."),
    click.option("--prior", type=IN, required=True, help="Of `dine learn`, of the mesh in radii."),
    click.option("--one-patch", type=IN, help="The same of simulations held at one patch."),
)
@click.option(
    "--about",
    type=click.Choice(config.OrganTrial.model_fields["questions"].default),
    default="methods",
    help="What is changed: nothing, what is seen, what simulations are wrong about, amplitude.",
)
@settings_option(config.OrganTrial)
@out_option("Errors to write (CSV).")
def organ_trial(files, about, settings, out):
    """Register partial scans of known deformations with a prior of the organ, and without.

    Example: dine organ-trial --truth trial/truth.h5 --held trial/held_about.txt --prior organ.prior
    --out trial/methods.csv
    """
    from dine.priors.organ import load_organ_prior
    from dine.reporting.table import write_numbers
    from dine.simulation.fields import read_deformations, read_vertex_numbers
    from dine.trials.organ import Methods, trial

    truth, prior = read_deformations(files["truth"]), load_organ_prior(files["prior"])
    prior.check(truth.template)
    methods = Methods(prior, files["one_patch"] and load_organ_prior(files["one_patch"]))
    held = read_vertex_numbers(files["held"], len(truth.template.vertices))
    write_numbers(trial(about, methods, truth, held, settings), out)


@click.command()
@click.option(
    "--measured",
    type=(str, IN),
    multiple=True,
    required=True,
    metavar="TEMPLATE CSV",
    help="Of `dine organ-trial`, and of which template; repeatable.",
)
@out_option("Folder for CSV, Markdown and LaTeX.", OUT_FOLDER)
def organ_tables(measured, out):
    """Write tables of what `dine organ-trial` measured.

    Example: dine organ-tables --measured liver trial/methods.csv --out trial/tables
    """
    from dine.reporting.organ import load_trials, trial_tables
    from dine.reporting.table import write_tables

    write_tables(trial_tables(load_trials(measured)), out)
