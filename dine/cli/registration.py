"""Commands for scans of one's own."""

from __future__ import annotations

import json
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from dine.cli.console import tell
from dine.cli.options import (
    FOLDER,
    IN,
    OUT,
    OUT_FOLDER,
    compute_flags,
    compute_options,
    gathered,
    json_option,
    model_option,
    out_option,
    own_out_option,
    several_pairs_option,
    start_torch,
    targets_option,
)
from dine.errors import ConfigError, DataError
from dine.progress import Stages

if TYPE_CHECKING:
    from dine.registration.types import RegistrationResult


def _loader(backbone, weights, prior, calibration, precision):
    """Loads what to register with, when it is called: ``model`` or the ``prior`` of an organ."""

    def load():
        from h5py import is_hdf5

        from dine.registration.model import load_model

        if prior is not None and is_hdf5(prior):
            if any((backbone, weights, calibration)):
                raise ConfigError(
                    f"{prior} is the prior of an organ, with which no network registers; leave out "
                    "--backbone, --weights and --calibration."
                )
            return {"prior": prior}
        model = load_model(backbone, weights=weights, prior=prior, calibration=calibration)
        model.backbone.precision = precision
        return {"model": model}

    return load


model_options = gathered(
    "load_model",
    _loader,
    click.option("--backbone", help="Shipped weights to use; by default robust_defreg."),
    click.option("--weights", type=IN, help="Weights of ours or of the backbones' authors."),
    click.option(
        "--prior",
        type=IN,
        help="Of `learn`, to register its template by; or of `fit-prior`, for the trust score.",
    ),
    click.option(
        "--calibration", type=IN, help="Of other weights than the shipped ones; `calibrate`."
    ),
    *compute_flags("precision"),
)


def _settings(prealign: str, **given) -> dict:
    """Arguments of ``dine.register``, whose own defaults stand for what was not given."""
    chosen = {name: value for name, value in given.items() if value is not None}
    return {"prealign": _alignment(prealign), **chosen}


def _alignment(prealign: str):
    if prealign in ("auto", "off"):
        return prealign
    import numpy as np

    from dine.geometry.rigid import check_rigid

    try:
        return check_rigid(np.loadtxt(prealign, encoding="utf-8-sig"), prealign)
    except (OSError, ValueError) as error:
        raise DataError(
            f"--prealign {prealign} is neither auto nor off nor a readable text file of a 4×4 "
            f"matrix ({error})."
        ) from None


registration_options = gathered(
    "settings",
    _settings,
    click.option(
        "--prealign",
        default="auto",
        help="Rigid alignment first: auto, off, or a text file of a 4×4 matrix.",
    ),
    click.option(
        "--map",
        "rounds",
        type=click.IntRange(0),
        help="Rounds of refinement at test time; 0 for the network's own field. By default as many "
        "as the calibration was made with.",
    ),
    click.option(
        "--surfaces/--no-surfaces",
        default=True,
        help="Go on from the points to the surfaces that they were drawn on; by default.",
    ),
    click.option(
        "--overlap",
        type=click.Choice(["auto", "both", "source-in-target", "target-in-source"]),
        default="auto",
        help="Which part each scan shows: the same (parts that overlap, if that fails), each what "
        "the other does not, or one a part of the other.",
    ),
    click.option("--partial", is_flag=True, help="The same as --overlap target-in-source."),
    click.option(
        "--points",
        type=click.IntRange(16),
        help="Points that are looked at; by default as many as in training.",
    ),
    click.option("--seed", type=click.IntRange(0), default=0, help="Of the drawn points."),
    *compute_flags("device"),
)
view_option = click.option("--view", is_flag=True, help="Also write a page to turn and overlay.")
overwrite_option = click.option(
    "--overwrite", is_flag=True, help="Replace files that are there already."
)


def _grids(**given):
    """The grids to write, when it is called, or None where there is nothing of them: what they are
    made with is not imported before."""

    def make():
        if all(value is None for value in given.values()):
            return None
        from dine.registration.grid import GridFiles

        return GridFiles(**given)

    return make


grid_options = gathered(
    "grids",
    _grids,
    click.option(
        "--grid",
        "forward",
        type=OUT,
        help="Also write the displacement, source to target, on a grid: .nrrd or .mha (LPS).",
    ),
    click.option(
        "--grid-inverse",
        "inverse",
        type=OUT,
        help="The same back, target to source: what images of the source are resampled by.",
    ),
    click.option("--grid-spacing", "spacing", type=float, help="By default a 64th of the size."),
    click.option(
        "--grid-margin",
        "margin",
        type=float,
        help="Beyond the source's box; by default a tenth of its size.",
    ),
    click.option(
        "--space",
        type=click.Choice(["lps", "ras"], case_sensitive=False),
        help="Coordinates of the scans, for the grid; by default as their files state, or lps.",
    ),
)


# Of most registrations.
_STAGES = ("reading", "alignment", "network", "points", "surfaces", "measures", "writing")


@dataclass(frozen=True)
class _Writing:
    """What `dine register` is to write, and how it is to tell of that."""

    out: Path
    view: bool
    overwrite: bool
    as_json: bool


@click.command(
    epilog="""
    Examples:

    \b
    dine register before.ply after.ply -o moved.ply --view
    dine register ct.stl us.obj -o moved.stl --apply tumour.stl --overlap target-in-source
    dine register ct.stl us.obj -o moved.stl --guide ct.fcsv us.fcsv --guide-error 2
    dine register liver.ply scan.ply -o moved.ply --prior organ.prior --partial
    """
)
@click.argument("source", type=IN)
@click.argument("target", type=IN)
@gathered(
    "writing",
    _Writing,
    own_out_option("The moved source; suffix says how."),
    view_option,
    overwrite_option,
    json_option,
)
@gathered(
    "further",
    dict,
    click.option(
        "--apply", type=IN, multiple=True, help="Another shape to move along; repeatable."
    ),
    click.option(
        "--landmarks",
        type=IN,
        nargs=2,
        help="Corresponding points of source and target, to measure.",
    ),
    click.option(
        "--guide",
        type=IN,
        nargs=2,
        help="Corresponding points of source and target, to keep to.",
    ),
    click.option(
        "--guide-error",
        type=click.FloatRange(0, min_open=True),
        help="Standard deviation of their coordinates; by default 1 % of the source's radius.",
    ),
)
@registration_options
@model_options
@grid_options
def register(source, target, further, settings, writing, load_model, grids):
    """Move SOURCE onto TARGET: any mesh or point file, any number of points, any units.

    Beside the moved source OUT go the displacement of every vertex (OUT.field.npz, OUT.field.vtp),
    what `dine apply` needs (OUT.result.npz), a report (OUT.json) and, with --view, a page to look
    at (OUT.html).
    """
    with Stages(_STAGES) as stages:
        stages.begin("reading")
        start_torch()
        from dine.io.readers import read_surface
        from dine.io.writers import check_holds
        from dine.registration.output import Outputs, save
        from dine.registration.register import register as run
        from dine.registration.shapes import shapes_by_name

        shapes, landmarks = shapes_by_name(further["apply"]), further["landmarks"]
        outputs = Outputs(writing.out)
        outputs.check(shapes, view=writing.view, overwrite=writing.overwrite)
        moving, grids = read_surface(source), grids()
        check_holds(writing.out, moving)
        if grids is not None:
            grids.check(moving, overwrite=writing.overwrite)
        settings["guide"] = further["guide"] or None
        settings["guide_error"] = further["guide_error"]
        marks = landmarks or None
        result = run(moving, target, **load_model(), apply=shapes, landmarks=marks, **settings)
        stages.begin("writing")
        said = save(result, outputs, applied=shapes, view=writing.view, overwrite=writing.overwrite)
        said += grids.write(result, overwrite=writing.overwrite) if grids else []
    files = outputs.files(view=writing.view) | (grids.files if grids else {})
    files |= {"applied": {name: outputs.applied(name, path) for name, path in shapes.items()}}
    lines = [_line(writing.out, result), *(f"  {x}" for x in (*result.trust.reasons, *said))]
    tell(lines, _facts(result, said) | {"files": files}, writing.as_json)


def _line(out: Path, result: RegistrationResult) -> str:
    """What came of a registration, in one line."""
    report, expected = result.report, result.trust.expected_error
    return (
        f"{out}: HD95 {report['before']['hd95']:.4g} -> {report['after']['hd95']:.4g}, "
        f"{result.trust.verdict}"
        + (f", expected error {expected:.3g}" if expected is not None else "")
        + f" ({report['seconds']:.1f} s)"
    )


# Of the report; the file holds the rest.
_TOLD = ("before", "aligned", "after", "displacement", "folding", "landmarks", "seconds")


def _facts(result: RegistrationResult, said: list[str]) -> dict[str, Any]:
    """What came of a registration, for programs; names as in the report."""
    trust = result.trust
    facts = {"verdict": trust.verdict, "reasons": trust.reasons, "notes": said}
    facts |= {"expected_error": trust.expected_error}
    return facts | {name: result.report[name] for name in _TOLD if name in result.report}


@click.command(
    epilog="""
    Examples:

    \b
    dine apply moved.ply tumour.stl vessels.vtp -o moved
    dine apply results/scans/first landmarks.fcsv -o moved
    dine apply moved.ply --grid field.nrrd
    """
)
@click.argument("result", type=click.Path(exists=False, path_type=Path))
@click.argument("files", nargs=-1, type=IN)
@own_out_option("Folder of the moved files.", OUT_FOLDER, required=False)
@click.option("--suffix", default="", help="Format to write, such as .ply; by default their own.")
@overwrite_option
@json_option
@grid_options
def apply(result, files, out, suffix, overwrite, as_json, grids):
    """Move FILES, which lie in the source's coordinates, as RESULT moved its source.

    RESULT is a file that `dine register` wrote (such as moved.ply), or its folder. With --grid
    FILES may be left out.
    """
    grids = grids()
    if files and out is None:
        raise click.UsageError("Missing option '-o' / '--out', the folder of the moved files.")
    if not (files or (grids and grids.files)):
        raise click.UsageError("Name FILES to move, or a file for --grid.")
    with Stages() as stages:
        stages.begin("reading")
        start_torch()
        from dine.registration.output import move_files
        from dine.registration.saved import load_result

        found = load_result(result)
        if grids is not None:
            grids.check(found.source, overwrite=overwrite)
        stages.begin("moving")
        moved = list(move_files(found, files, out, suffix=suffix, overwrite=overwrite))
        notes = grids.write(found, overwrite=overwrite) if grids else []
    further = grids.files if grids else {}
    lines = [line for path, said in moved for line in (str(path), *(f"  {x}" for x in said))]
    lines += [*map(str, further.values()), *(f"  {x}" for x in notes)]
    facts = [
        {"source": file, "moved": path, "notes": said}
        for file, (path, said) in zip(files, moved, strict=True)
    ]
    tell(lines, {"files": facts, **further, "notes": notes}, as_json)


def _population(template: Path | None, **options):
    """What makes the shape model, or None where there is no template."""
    if template is not None:
        return {"template": template, "options": options}
    chosen = [name for name, value in options.items() if value]
    if chosen:
        raise ConfigError(
            f"--{chosen[0].replace('_', '-')} is about a shape model; name its template "
            "(--template), or leave it out."
        )
    return None


@click.command(
    "register-many",
    epilog="""
    Examples:

    \b
    dine register-many pairs.csv -o results/scans
    dine register-many scans/ -o results/scans --view
    dine register-many --template liver.ply patients/*.ply -o livers
    """,
)
@click.argument("inputs", nargs=-1, required=True, type=click.Path(exists=False, path_type=Path))
@own_out_option("Folder of all results.", OUT_FOLDER)
@click.option("--suffix", default="", help="Format of the moved sources, such as .ply.")
@gathered(
    "population",
    _population,
    click.option(
        "--template", type=IN, help="A mesh to register to all INPUTS, for a shape model of them."
    ),
    click.option("--scale", is_flag=True, help="Shape model without size: all scaled to one."),
    click.option(
        "--include-doubtful", is_flag=True, help="Doubtful registrations count in the shape model."
    ),
    click.option(
        "--modes",
        type=click.IntRange(1),
        help="Of the shape model to keep; by default those of 95 % of the variance.",
    ),
)
@registration_options
@gathered("shown", dict, view_option, json_option)
@model_options
def register_many(inputs, out, suffix, population, settings, shown, load_model):
    """Register every pair of INPUTS, a CSV file (source, target, name) or a folder.

    A pair that fails is reported and does not stop the others; run the same command again to go on
    after an interruption. OUT/summary.csv has one row a pair.

    With --template, INPUTS are scans of a population. OUT gets their mean shape, modes, a prior to
    register further scans with, scores and quality of this shape model.
    """
    from dine.registration.many import read_jobs
    from dine.registration.many import register_many as run

    start_torch()
    loaded = load_model()
    if "prior" in loaded:
        raise ConfigError(f"{loaded['prior']} is the prior of an organ; `dine register` takes it.")
    common = {"suffix": suffix, "view": shown["view"], "settings": settings}
    if population is not None:
        failed, lines, facts = _shape_model(inputs, out, loaded["model"], population, common)
    else:
        if len(inputs) > 1:
            raise ConfigError(
                f"{len(inputs)} files were given; expected one list or folder of pairs, or "
                "--template and scans."
            )
        summary = run(read_jobs(inputs[0]), out, loaded["model"], **common)
        failed, table = int((summary["state"] == "failed").sum()), out / "summary.csv"
        done = len(summary) - failed
        # Through text, in which what is missing has no number.
        pairs = json.loads(summary.to_json(orient="records", double_precision=15))
        facts = {"registered": done, "failed": failed, "summary": table, "pairs": pairs}
        lines = [f"{done} of {len(summary)} registered; {table}"]
    tell(lines, facts, shown["as_json"])
    if failed:
        sys.exit(1)


def _shape_model(inputs, out, model, population, common) -> tuple[int, list[str], dict]:
    """Make a shape model: how many scans could not be registered, and what to say of it."""
    from dine.registration.population import (
        PopulationFiles,
        PopulationOptions,
        population_jobs,
        population_model,
    )

    jobs = population_jobs(population["template"], inputs, out)
    options = PopulationOptions(**population["options"])
    found, quality = population_model(jobs, out, model, options, **common)
    row, prior = list(quality.rows())[found.kept], PopulationFiles(out).prior
    lines = [
        f"{prior}: {found.kept} modes of {len(found.shapes)} of {len(jobs)} "
        f"scans, {100 * row['compactness']:.0f} % of the variance, generalisation "
        f"{row['generalisation']:.3g} ({row['generalisation_percent']:.1f} % of the radius), "
        f"specificity {row['specificity']:.3g} ({row['specificity_percent']:.1f} %)"
    ]
    left_out = {member.name: member.facts for member in found.members if not member.used}
    lines += [
        f"  {name} is left out, {facts['verdict']}: {facts['message']}"
        for name, facts in left_out.items()
    ]
    facts = {"prior": prior, "modes": found.kept, "quality": row, "left_out": left_out}
    return sum(member.vertices is None for member in found.members), lines, facts


@click.command()
@click.argument("folder", type=FOLDER, default=".")
def scans(folder: Path):
    """Write before.ply and after.ply, two small synthetic scans of one organ, to try things with.

    Example: dine scans trial
    """
    from importlib import resources

    from dine.files import atomic_path

    for name in ("before.ply", "after.ply"):
        if (folder / name).exists():
            raise DataError(f"{folder / name} is there already; name another folder.")
    for name in ("before.ply", "after.ply"):
        with atomic_path(folder / name) as temporary:
            temporary.write_bytes((resources.files("dine") / "scans" / name).read_bytes())
    tell([f"{folder / 'before.ply'}, {folder / 'after.ply'}"])


@click.command()
@model_option
@several_pairs_option
@targets_option
@click.option(
    "--raw",
    "raws",
    type=IN,
    multiple=True,
    help="Of `raw`: the datasets that the pairs were made from, to calibrate on their meshes.",
)
@click.option("--prior", type=IN, help="The prior that the trust score is to use.")
@compute_options("device")
@out_option("Calibration to write (JSON, and a plot).")
def calibrate(model, pairs, targets, raws, prior, compute, out):
    """Learn from validation pairs what a model's uncertainty means; check it on test pairs.

    With --raw on the meshes that the pairs were drawn on, as `register` goes; otherwise for
    `register --no-surfaces`.

    Example: dine calibrate --model model.safetensors --pairs pairs.h5 --targets resampled.h5
    --raw raw.json --prior pca.safetensors --out calibration.json
    """
    from dine.models.devices import chosen_device, leased
    from dine.registration.calibrate import calibrate as run

    start_torch()
    with leased(chosen_device(compute.device)) as [found]:
        run(
            model,
            list(pairs),
            out,
            targets=list(targets),
            raws=list(raws),
            prior=prior,
            device=found,
        )
