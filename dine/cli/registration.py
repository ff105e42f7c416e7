"""Commands for scans of one's own."""

from __future__ import annotations

import sys
from pathlib import Path

import click

from dine.cli.options import (
    FOLDER,
    IN,
    OUT,
    OUT_FOLDER,
    compute_flags,
    compute_options,
    gathered,
    model_option,
    out_option,
    several_pairs_option,
    start_torch,
    targets_option,
)
from dine.errors import ConfigError, DataError


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
    click.echo(f"{folder / 'before.ply'}, {folder / 'after.ply'}")


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
@click.option("-o", "--out", type=OUT, required=True, help="The moved source; suffix says how.")
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
@gathered(
    "writing",
    dict,
    view_option,
    click.option("--overwrite", is_flag=True, help="Replace files that are there already."),
)
@model_options
def register(source, target, out, further, settings, writing, load_model):
    """Move SOURCE onto TARGET: any mesh or point file, any number of points, any units.

    Beside the moved source OUT go the displacement of every vertex (OUT.field.npz, OUT.field.vtp),
    what `dine apply` needs (OUT.result.npz), a report (OUT.json) and, with --view, a page to look
    at (OUT.html).
    """
    from dine.io.readers import read_surface
    from dine.io.writers import check_holds
    from dine.registration.output import Outputs, save
    from dine.registration.register import register as run
    from dine.registration.shapes import shapes_by_name

    start_torch()
    shapes, landmarks = shapes_by_name(further["apply"]), further["landmarks"]
    outputs = Outputs(out)
    outputs.check(shapes, **writing)
    moving = read_surface(source)
    check_holds(out, moving)
    settings["guide"], settings["guide_error"] = further["guide"] or None, further["guide_error"]
    marks = landmarks or None
    result = run(moving, target, **load_model(), apply=shapes, landmarks=marks, **settings)
    said = save(result, outputs, applied=shapes, **writing)
    report = result.report
    expected = result.trust.expected_error
    click.echo(
        f"{out}: HD95 {report['before']['hd95']:.4g} -> {report['after']['hd95']:.4g}, "
        f"{result.trust.verdict}"
        + (f", expected error {expected:.3g}" if expected is not None else "")
        + f" ({report['seconds']:.1f} s)"
    )
    for sentence in (*result.trust.reasons, *said):
        click.echo(f"  {sentence}")


@click.command(
    epilog="""
    Examples:

    \b
    dine apply moved.ply tumour.stl vessels.vtp -o moved
    dine apply results/scans/first landmarks.fcsv -o moved
    """
)
@click.argument("result", type=click.Path(exists=False, path_type=Path))
@click.argument("files", nargs=-1, required=True, type=IN)
@click.option("-o", "--out", type=OUT_FOLDER, required=True, help="Folder of the moved files.")
@click.option("--suffix", default="", help="Format to write, such as .ply; by default their own.")
@click.option("--overwrite", is_flag=True, help="Replace files that are there already.")
def apply(result, files, out, suffix, overwrite):
    """Move FILES, which lie in the source's coordinates, as RESULT moved its source.

    RESULT is a file that `dine register` wrote (such as moved.ply), or its folder.
    """
    from dine.registration.output import move_files
    from dine.registration.saved import load_result

    start_torch()
    for line in move_files(load_result(result), files, out, suffix=suffix, overwrite=overwrite):
        click.echo(line)


@click.command(
    "register-many",
    epilog="""
    Examples:

    \b
    dine register-many pairs.csv -o results/scans
    dine register-many scans/ -o results/scans --view
    """,
)
@click.argument("manifest", type=click.Path(exists=False, path_type=Path))
@click.option("-o", "--out", type=OUT_FOLDER, required=True, help="Folder of all results.")
@click.option("--suffix", default="", help="Format of the moved sources, such as .ply.")
@registration_options
@view_option
@model_options
def register_many(manifest, out, suffix, settings, view, load_model):
    """Register every pair of MANIFEST, a CSV file (source, target, name) or a folder.

    A pair that fails is reported and does not stop the others; run the same command again to go on
    after an interruption. OUT/summary.csv has one row a pair.
    """
    from dine.registration.many import read_jobs
    from dine.registration.many import register_many as run

    start_torch()
    loaded = load_model()
    if "prior" in loaded:
        raise ConfigError(f"{loaded['prior']} is the prior of an organ; `dine register` takes it.")
    jobs = read_jobs(manifest)
    summary = run(jobs, out, loaded["model"], suffix=suffix, view=view, settings=settings)
    failed = int((summary["state"] == "failed").sum())
    click.echo(f"{len(summary) - failed} of {len(summary)} registered; {out / 'summary.csv'}")
    if failed:
        sys.exit(1)


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
