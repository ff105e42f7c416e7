"""The command line: one command for each step, all of them usable without Snakemake."""

from __future__ import annotations

import functools
import json
import logging
import os
import sys
from pathlib import Path

import click

from dine import __version__, config
from dine.errors import ConfigError, DataError, DineError
from dine.files import check_place, storage_errors, write_json, write_text

# Heavy modules (torch, matplotlib) are imported by the command that needs them.

IN = click.Path(exists=False, dir_okay=False, path_type=Path)
FOLDER = click.Path(file_okay=False, path_type=Path)


class _Output(click.Path):
    """A path to write to: refused before anything is computed if that cannot be done."""

    def convert(self, value, param, ctx):
        path = super().convert(value, param, ctx)
        check_place(path)
        return path


OUT = _Output(path_type=Path)
OUT_FOLDER = _Output(file_okay=False, path_type=Path)

log = logging.getLogger("dine")


class Settings(click.ParamType):
    """A settings section: JSON text, or ``@file`` for a YAML or JSON file; checked on reading."""

    name = "JSON|@FILE"

    def __init__(self, model: type[config.Section]):
        self.model = model

    def convert(self, value, param, ctx):
        if isinstance(value, config.Section):
            return value
        if value.startswith("@"):
            return config.validate_section(self.model, config.read_yaml(value[1:]), value[1:])
        try:
            values = json.loads(value)
        except ValueError as error:
            raise ConfigError(f"--settings is neither JSON nor @FILE: {error}.") from None
        return config.validate_section(self.model, values, "--settings")


def _json_or_file(context, parameter, value):
    """JSON text, or a JSON or YAML file, with or without @ before its name."""
    if value is None or not value.lstrip().startswith("{"):
        return None if value is None else config.read_yaml(value.removeprefix("@"))
    try:
        return json.loads(value)
    except ValueError as error:
        raise ConfigError(f"{parameter.opts[0]} is neither JSON nor a file: {error}.") from None


def settings_option(model: type[config.Section]):
    return click.option(
        "--settings",
        type=Settings(model),
        default="{}",
        show_default=True,
        help=f"{model.__name__} settings; keys as in config.yaml, defaults where left out.",
    )


seed_option = click.option("--seed", type=click.IntRange(0), default=0, show_default=True)
name_option = click.option("--name", default="", help="Shown with the progress.")
batch_option = click.option(
    "--batch-size", type=click.IntRange(1), default=4, show_default=True, help="Pairs at a time."
)
variants_option = click.option(
    "--variant", "variants", type=IN, multiple=True, help="Corrupted targets; repeatable."
)
levels_option = click.option(
    "--at",
    "levels",
    type=float,
    multiple=True,
    help="Deformation level to draw for; repeatable. All of them by default.",
)
most_option = click.option(
    "--most",
    type=click.IntRange(1),
    help="At most so many test pairs, spread over levels; of known objects, where there are any.",
)
pairs_option = click.option("--pairs", type=IN, required=True, help="Pairs (HDF5).")
targets_option = click.option(
    "--targets", type=IN, multiple=True, help="Of `resample`, one for each file of pairs."
)
model_option = click.option("--model", type=IN, required=True, help="Weights (safetensors).")


def compute_options(*names: str):
    """Options for some of the keys of ``Compute``, given to the command as ``compute``."""
    kinds = {
        "device": click.Choice(["auto", "cpu", "cuda"]),
        "precision": click.Choice(["float32", "bf16"]),
        "processes": click.IntRange(1),
    }

    def decorate(command):
        @functools.wraps(command)
        def run(**values):
            compute = config.Compute(**{name: values.pop(name) for name in names})
            return command(**values, compute=compute)

        for name in reversed(names):
            field = config.Compute.model_fields[name]
            run = click.option(
                f"--{name}",
                type=kinds[name],
                default=field.default,
                show_default=True,
                help=field.description,
            )(run)
        return run

    return decorate


prediction_options = compute_options("device", "precision")
training_options = compute_options("device", "precision", "processes")


@click.group(context_settings={"help_option_names": ["-h", "--help"], "show_default": True})
@click.version_option(__version__, prog_name="dine")
@click.option("--log", "log_file", type=OUT, help="Also write the log to this file.")
@click.option("--threads", type=click.IntRange(1), help="Threads for all processes together.")
def cli(log_file: Path | None, threads: int | None):
    """Non-rigid registration of point clouds with learned deformation priors."""
    handlers: list[logging.Handler] = [logging.StreamHandler(sys.stderr)]
    if log_file is not None:
        with storage_errors(log_file.parent):
            log_file.parent.mkdir(parents=True, exist_ok=True)
            kept = {"encoding": "utf-8", "errors": "backslashreplace"}
            handlers.append(logging.FileHandler(log_file, **kept))
        logging.raiseExceptions = False  # a log that fills the disk is not what to read about
    logging.basicConfig(
        level=logging.INFO,
        format="%(asctime)s %(message)s",
        datefmt="%H:%M:%S",
        handlers=handlers,
        force=True,
    )
    if threads is not None:
        # Before torch and its libraries start their thread pools.
        os.environ["OMP_NUM_THREADS"] = str(threads)


def _start_torch() -> None:
    import torch

    threads = os.environ.get("OMP_NUM_THREADS")
    if threads:
        torch.set_num_threads(int(threads))


# --- configuration --------------------------------------------------------------------------------


@cli.group("config")
def config_group():
    """Check and show configurations."""


@config_group.command("check")
@click.argument("files", nargs=-1, required=True, type=IN)
def config_check(files: tuple[Path, ...]):
    """Check configuration files; later ones are laid over earlier ones.

    Example: dine config check config.yaml my.yaml
    """
    config.load(*files)
    click.echo("The configuration is valid.")


@config_group.command("show")
@click.argument("files", nargs=-1, required=True, type=IN)
def config_show(files: tuple[Path, ...]):
    """Print the complete configuration, defaults included, as YAML.

    Example: dine config show config.yaml my.yaml
    """
    import yaml

    click.echo(yaml.safe_dump(config.load(*files).model_dump(), sort_keys=False), nl=False)


@config_group.command("schema")
def config_schema():
    """Print the JSON schema of the configuration.

    Example: dine config schema
    """
    click.echo(json.dumps(config.Config.model_json_schema(), indent=2))


@config_group.command("write")
@click.argument("settings", type=Settings(config.Config))
@click.option("--out", type=OUT, required=True, help="YAML to write.")
def config_write(settings: config.Config, out: Path):
    """Write a complete configuration, given as JSON or @FILE, as YAML.

    Example: dine config write @my.yaml --out complete.yaml
    """
    import yaml

    write_text(out, yaml.safe_dump(settings.model_dump(mode="json"), sort_keys=False))


# --- data -----------------------------------------------------------------------------------------


@cli.command()
@click.argument("folder", type=click.Path(path_type=Path))
def inspect(folder: Path):
    """List what a folder of meshes holds, per condition and level, and what is left out and why.

    A manifest (CSV) of pairs will do as well.

    Example: dine inspect ~/scans/liver
    """
    from dine.data.layout import scan

    inventory = scan(folder)
    if inventory.has_pairs:
        click.echo(inventory.table().to_string(index=False))
    else:
        click.echo(f"{len(inventory.bases)} undeformed objects; targets would be made from them.")
    if inventory.split_file:
        click.echo(f"Split file: {inventory.split_file}")
    for path, reason in inventory.left_out:
        click.echo(f"left out: {path}: {reason}")


@cli.command()
@settings_option(config.Dataset)
@click.option("--first-object", type=click.IntRange(0), default=0, help="First synthetic number.")
@seed_option
@click.option("--out", type=OUT_FOLDER, required=True, help="The dataset's results folder.")
def raw(settings: config.Dataset, first_object: int, seed: int, out: Path):
    """Make, find or download raw meshes.

    Example: dine raw --settings '{"source": {"kind": "path", "folder": "scans"}}' --out mine
    """
    from dine.data.obtain import obtain

    obtain(settings, out, seed=seed, first_object=first_object)


@cli.command()
@click.option("--raw", "raw_file", type=IN, required=True, help="raw.json of `dine raw`.")
@settings_option(config.Pairs)
@seed_option
@click.option("--test-only", is_flag=True, help="All objects for testing, whatever the split.")
@click.option("--unseen", type=IN, help="raw.json of further objects, for testing only.")
@click.option("--out", type=OUT, required=True, help="Pairs to write (HDF5).")
def pairs(raw_file: Path, settings: config.Pairs, seed: int, test_only, unseen, out: Path):
    """Turn raw meshes into index-consistent source/target pairs.

    Example: dine pairs --raw mine/raw.json --out pairs.h5
    """
    from dine.data.prepare import prepare_pairs

    prepare_pairs(raw_file, settings, seed=seed, out=out, test_only=test_only, unseen=unseen)


@cli.command()
@pairs_option
@click.option("--condition", type=click.Choice(["noise", "outliers"]), required=True)
@click.option("--level", type=float, required=True, help="Noise sigma, or outliers in percent.")
@levels_option
@most_option
@seed_option
@click.option("--out", type=OUT, required=True, help="Variant to write (HDF5).")
def corrupt(pairs: Path, condition: str, level: float, levels, most, seed: int, out: Path):
    """Draw corrupted targets for the test split.

    Example: dine corrupt --pairs pairs.h5 --condition noise --level 0.03 --out noise.h5
    """
    from dine.data.corruption import make_variant
    from dine.data.pairs import evaluated_pairs, read_pairs, write_variant

    found = read_pairs(pairs)
    variant = make_variant(evaluated_pairs(found, levels, most), condition, level, seed)
    write_variant(out, variant, found.checksum)


@cli.command()
@click.option(
    "--raw",
    "raw_files",
    type=IN,
    required=True,
    multiple=True,
    help="raw.json of `dine raw`; repeatable.",
)
@pairs_option
@levels_option
@most_option
@seed_option
@click.option("--out", type=OUT, required=True, help="Targets to write (HDF5).")
def resample(raw_files, pairs: Path, levels, most, seed: int, out: Path):
    """Draw the points of all targets anew, as two scans of one object never share points.

    Example: dine resample --raw mine/raw.json --pairs pairs.h5 --out resampled.h5
    """
    from dine.data.prepare import resample_targets

    resample_targets(raw_files, pairs, seed=seed, out=out, levels=levels, most=most)


@cli.command()
@pairs_option
@click.option("--out", type=OUT, required=True, help="Result (JSON).")
@seed_option
def agreement(pairs: Path, seed: int, out: Path):
    """Measure how well the index convention holds across objects.

    Example: dine agreement --pairs pairs.h5 --out agreement.json
    """
    from dine.data.prepare import measure_agreement

    write_json(out, measure_agreement(pairs, seed=seed))


# --- training -------------------------------------------------------------------------------------


backbone_option = click.option(
    "--backbone",
    type=Settings(config.BackboneConfig),
    default='{"kind": "robust_defreg"}',
    show_default=True,
    help="Kind and arguments of the backbone.",
)


@cli.command()
@pairs_option
@backbone_option
@settings_option(config.Stage1)
@seed_option
@training_options
@name_option
@click.option("--out", type=OUT_FOLDER, required=True, help="Run folder.")
def stage1(pairs, backbone, settings, seed, compute, name, out):
    """Train a backbone on the Chamfer distance alone.

    Example: dine stage1 --pairs pairs.h5 --settings '{"steps": 1000}' --out runs/stage1
    """
    from dine.training import stages

    _start_torch()
    stages.stage1(
        pairs,
        backbone.kind,
        backbone.arguments,
        settings,
        seed=seed,
        out=out,
        name=name or f"stage 1 {backbone.kind}",
        compute=compute,
    )


@cli.command()
@click.option("--pairs", type=IN, required=True, multiple=True, help="Pairs (HDF5); repeatable.")
@targets_option
@backbone_option
@settings_option(config.Pretraining)
@seed_option
@training_options
@click.option("--out", type=OUT_FOLDER, required=True, help="Run folder.")
def pretrain(pairs, targets, backbone, settings, seed, compute, out):
    """Train weights to start Stage 1 from, on synthetic pairs with known displacement.

    Example: dine pretrain --pairs pairs.h5 --targets resampled.h5 --out runs/pretraining
    """
    from dine.training import stages

    _start_torch()
    stages.pretrain(
        list(pairs),
        backbone.kind,
        backbone.arguments,
        settings,
        seed=seed,
        out=out,
        targets=list(targets),
        compute=compute,
    )


@cli.command()
@model_option
@pairs_option
@click.option("--targets", type=IN, help="Of `resample`; seen instead of the pairs' own.")
@batch_option
@prediction_options
@name_option
@click.option("--out", type=OUT, required=True, help="Fields to write (HDF5).")
def fields(model, pairs, targets, batch_size, compute, name, out):
    """Write a model's displacement fields of the training split.

    Example: dine fields --model model.safetensors --pairs pairs.h5 --out dvf.h5
    """
    from dine.models.inference import dump_fields

    _start_torch()
    dump_fields(
        model,
        pairs,
        out,
        name=name or "fields",
        batch_size=batch_size,
        targets=targets,
        compute=compute,
    )


@cli.command("fit-prior")
@click.option(
    "--fields", type=IN, multiple=True, required=True, help="Of `dine fields` (HDF5); repeatable."
)
@settings_option(config.PriorConfig)
@seed_option
@click.option("--out", type=OUT, required=True, help="Prior to write (safetensors).")
def fit_prior(fields, settings, seed, out):
    """Fit a deformation prior to displacement fields and freeze it.

    The fit of a flow saves its state in training/ beside the output, and goes on from there.

    Example: dine fit-prior --fields dvf.h5 --settings '{"kind": "pca"}' --out pca.safetensors
    """
    from dine.priors.fitting import fit_prior as run

    _start_torch()
    run(list(fields), settings, seed=seed, out=out)


prior_files_option = click.option(
    "--prior", "priors", type=(str, IN), multiple=True, help="Name and file of a prior; repeatable."
)
stage2_option = click.option(
    "--stage2", "stage2_settings", type=Settings(config.Stage2), default="{}", help="Stage 2."
)


@cli.command("search-lambda")
@pairs_option
@model_option
@prior_files_option
@stage2_option
@settings_option(config.LambdaSearch)
@seed_option
@training_options
@click.option("--out", type=OUT, required=True, help="Result (JSON).")
def search_lambda(pairs, model, priors, stage2_settings, settings, seed, compute, out):
    """Choose λ on validation pairs.

    Example: dine search-lambda --pairs pairs.h5 --model model.safetensors --prior pca
    pca.safetensors --out lambda.json
    """
    from dine.training.stage2 import search_lambda as run

    _start_torch()
    run(pairs, model, dict(priors), stage2_settings, settings, seed=seed, out=out, compute=compute)


@cli.command()
@pairs_option
@model_option
@click.option("--variant", default=config.CONTROL, show_default=True, help="Prior's name.")
@click.option("--prior", type=IN, help="Prior's file; by default none.")
@click.option("--lambda", "weight", help="A number, or the file of `dine search-lambda`.")
@settings_option(config.Stage2)
@seed_option
@training_options
@name_option
@click.option("--out", type=OUT_FOLDER, required=True, help="Run folder.")
def stage2(pairs, model, variant, prior, weight, settings, seed, compute, name, out):
    """Refine a Stage-1 model with λ times a frozen prior; without a prior, the λ = 0 control.

    A variant of another name without a prior differs from the control in `data_term`.

    Example: dine stage2 --pairs pairs.h5 --model model.safetensors --variant pca --prior
    pca.safetensors --lambda lambda.json --out runs/pca
    """
    from dine.training.stage2 import selected_lambda
    from dine.training.stage2 import stage2 as run

    _start_torch()
    if prior is None:
        value = 0.0
    elif weight is None:
        raise ConfigError("--lambda is needed with a prior: a number or a file of search-lambda.")
    else:
        try:
            value = float(weight)
        except ValueError:
            value = selected_lambda(Path(weight), variant)
    run(
        pairs,
        model,
        settings,
        variant=variant,
        prior=prior,
        weight=value,
        seed=seed,
        out=out,
        name=name or f"stage 2 {variant}",
        compute=compute,
    )


# --- evaluation and reporting ---------------------------------------------------------------------


@cli.command()
@model_option
@pairs_option
@variants_option
@batch_option
@prediction_options
@name_option
@click.option("--out", type=OUT, required=True, help="Predictions to write (HDF5).")
def predict(model, pairs, variants, batch_size, compute, name, out):
    """Register the test split and its corrupted variants; write the displacement fields.

    Example: dine predict --model model.safetensors --pairs pairs.h5 --out predictions.h5
    """
    from dine.evaluation.predict import predict as run

    _start_torch()
    run(
        model,
        pairs,
        list(variants),
        out,
        name=name or "predict",
        batch_size=batch_size,
        compute=compute,
    )


@cli.command()
@click.option("--predictions", type=IN, required=True, multiple=True, help="One for each method.")
@pairs_option
@variants_option
@click.option("--dataset", required=True)
@click.option("--backbone", required=True)
@click.option("--method", "methods", required=True, multiple=True, help="Its name; repeatable.")
@seed_option
@click.option("--point-errors", type=OUT, help="Per-point errors to write as well (HDF5).")
@click.option("--out", type=OUT, required=True, help="Metrics (CSV).")
def evaluate(predictions, pairs, variants, dataset, backbone, methods, seed, point_errors, out):
    """Compute metrics from stored predictions.

    Example: dine evaluate --predictions predictions.h5 --pairs pairs.h5 --dataset mine
    --backbone robust_defreg --method stage1 --point-errors errors.h5 --out metrics.csv
    """
    from dine.evaluation.metrics import evaluate as run

    if len(set(methods)) != len(predictions):
        raise ConfigError(
            "Give one --method, each with a name of its own, for every --predictions."
        )
    run(
        dict(zip(methods, predictions, strict=True)),
        pairs,
        list(variants),
        out,
        point_errors,
        dataset=dataset,
        backbone=backbone,
        seed=seed,
    )


@cli.command("refine-predictions")
@click.option("--predictions", type=IN, required=True, help="Of `dine predict`.")
@pairs_option
@variants_option
@click.option("--settings", type=Settings(config.RefinedMethod), default='{"kind": "refined"}')
@click.option("--prior", type=IN, help="Prior's file; by default none.")
@name_option
@click.option("--out", type=OUT, required=True, help="Predictions to write (HDF5).")
def refine_predictions(predictions, pairs, variants, settings, prior, name, out):
    """Refine a network's stored fields at test time, pair by pair.

    Example: dine refine-predictions --predictions predictions.h5 --pairs pairs.h5 --out refined.h5
    """
    from dine.evaluation.refined import refine_predictions as run

    _start_torch()
    run(
        predictions,
        pairs,
        list(variants),
        out,
        settings=settings,
        prior=prior,
        name=name or "refine",
    )


@cli.command()
@pairs_option
@variants_option
@click.option("--algorithm", required=True, help="unregistered, icp, cpd, bcpd, smooth, or a path.")
@click.option(
    "--arguments",
    callback=_json_or_file,
    default="{}",
    show_default=False,
    metavar="JSON|FILE",
    help="Of the algorithm.",
)
@name_option
@click.option("--out", type=OUT, required=True, help="Predictions to write (HDF5).")
def classical(pairs, variants, algorithm, arguments, name, out):
    """Register the test split and its corrupted variants without a network.

    Example: dine classical --pairs pairs.h5 --algorithm cpd --out cpd.h5
    """
    from dine.classical.predictions import classical_predictions as run

    run(
        pairs, list(variants), out, algorithm=algorithm, arguments=arguments, name=name or algorithm
    )


@cli.command()
@click.option("--prior", type=IN, required=True, help="Of `dine fit-prior` (safetensors).")
@click.option("--fields", type=IN, required=True, help="That it was fitted to (HDF5).")
@pairs_option
@click.option("--dataset", default="", help="For the result.")
@click.option("--backbone", default="", help="For the result.")
@name_option
@seed_option
@click.option("--out", type=OUT, required=True, help="Result (JSON); samples beside it (PNG).")
def diagnose(prior, fields, pairs, dataset, backbone, name, seed, out):
    """Measure a prior on the true displacements of validation pairs, and draw samples of it.

    Example: dine diagnose --prior pca.safetensors --fields dvf.h5 --pairs pairs.h5 --out pca.json
    """
    from dine.reporting.priors import diagnose_prior

    _start_torch()
    facts = {"dataset": dataset, "backbone": backbone, "prior": name or prior.stem}
    diagnose_prior(prior, fields, pairs, out, seed=seed, facts=facts)


@cli.command()
@click.argument("metrics", nargs=-1, required=True, type=IN)
@click.option(
    "--spread",
    type=click.FloatRange(0),
    default=config.Evaluation().training_spread,
    help="How much differences vary with the training (`evaluation.training_spread`).",
)
@click.option("--out", type=OUT_FOLDER, required=True, help="Folder for CSV, Markdown and LaTeX.")
def tables(metrics, spread, out):
    """Aggregate metrics into the paper's tables and their companions.

    Example: dine tables a/metrics.csv b/metrics.csv --out tables
    """
    from dine.reporting.loading import load_metrics
    from dine.reporting.table import write_tables
    from dine.reporting.tables import all_tables

    made = all_tables(load_metrics(metrics), spread)
    write_tables(made, out)


@cli.command()
@click.option("--results", type=FOLDER, required=True, help="The workflow's results folder.")
@settings_option(config.Config)
@click.option("--out", type=OUT_FOLDER, required=True, help="Folder for PNG and PDF.")
def figures(results, settings, out):
    """Draw all figures of a finished run.

    Example: dine figures --results results --settings @config.yaml --out results/figures
    """
    from dine.reporting.build import draw_figures

    draw_figures(results, settings, out)


@cli.command()
@click.option("--results", type=FOLDER, required=True, help="The workflow's results folder.")
@settings_option(config.Config)
@click.option("--out", type=OUT, required=True, help="Report to write (HTML).")
def report(results, settings, out):
    """Write one self-contained HTML page with tables, figures and findings.

    Example: dine report --results results --settings @config.yaml --out results/report.html
    """
    from dine.reporting.report import build_report

    build_report(results, settings, out)


methods_option = click.option(
    "--methods",
    callback=_json_or_file,
    default="{}",
    show_default=False,
    metavar="JSON|FILE",
    help="Title, group and description of each method.",
)


@cli.command()
@pairs_option
@variants_option
@click.option("--method", "names", multiple=True, required=True, help="One of each predictions.")
@click.option("--predictions", type=IN, multiple=True, required=True, help="Of `predict`.")
@methods_option
@click.option("--dataset", required=True, help="For the title.")
@click.option("--out", type=OUT, required=True, help="Views to write (PNG; a PDF beside it).")
def examples(pairs, variants, names, predictions, methods, dataset, out):
    """Draw what some methods make of typical test pairs; the first one says which are typical.

    Example: dine examples --pairs pairs.h5 --method cpd --predictions cpd.h5 --dataset synbench
    --out examples.png
    """
    from dine.reporting.examples import draw_examples

    if len(names) != len(predictions):
        raise click.UsageError("Give as many --method as --predictions.")
    titles = {name: about.get("title") or name for name, about in methods.items()}
    named = dict(zip(names, predictions, strict=True))
    draw_examples(pairs, list(variants), named, out, titles=titles, dataset=dataset)


@cli.command()
@click.argument("metrics", nargs=-1, required=True, type=IN)
@methods_option
@click.option("--reference", default=config.CONTROL, help="What methods are compared with.")
@click.option("--search", "searches", type=IN, multiple=True, help="Of `search-lambda`.")
@click.option("--diagnostics", type=IN, multiple=True, help="JSON of a prior; repeatable.")
@click.option(
    "--example",
    "examples",
    type=(str, IN, str),
    multiple=True,
    metavar="DATASET PNG TEXT",
    help="A picture to show, and its caption; repeatable.",
)
@click.option(
    "--settings", callback=_json_or_file, metavar="JSON|FILE", help="Configuration to show."
)
@click.option(
    "--out", type=OUT_FOLDER, required=True, help="Folder for report, tables and figures."
)
def evidence(metrics, methods, reference, searches, diagnostics, examples, settings, out):
    """Write the report on whether a prior helps: tests, tables, figures and findings.

    Example: dine evidence a/metrics.csv b/metrics.csv --methods '{"pca": {"title": "PCA prior",
    "group": "prior"}}' --search lambda.json --out evidence
    """
    from dine.reporting.evidence import Example, Files, build_evidence

    shown = [Example(*example) for example in examples]
    files = Files(metrics, searches, diagnostics, shown)
    build_evidence(files, out, methods=methods, reference=reference, config=settings)


# --- own scans ------------------------------------------------------------------------------------


@cli.command()
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


def model_options(command):
    """Which weights to register with; given to the command as ``model``."""

    @functools.wraps(command)
    def run(backbone, weights, prior, calibration, device, precision, **values):
        from dine.registration.model import load_model

        def load():
            model = load_model(backbone, weights=weights, prior=prior, calibration=calibration)
            model.backbone.precision = precision
            return model

        return command(**values, load_model=load, device=device)

    for option in (
        click.option(
            "--calibration", type=IN, help="Of other weights than the shipped ones; `calibrate`."
        ),
        click.option("--prior", type=IN, help="A fitted prior, for the trust score."),
        click.option("--weights", type=IN, help="Weights of ours or of the backbones' authors."),
        click.option("--backbone", help="Shipped weights to use; by default robust_defreg."),
        click.option("--precision", type=click.Choice(["float32", "bf16"]), default="float32"),
        click.option("--device", type=click.Choice(["auto", "cpu", "cuda"]), default="auto"),
    ):
        run = option(run)
    return run


def registration_options(command):
    for option in (
        click.option("--view", is_flag=True, help="Also write a page to turn and overlay."),
        click.option("--seed", type=click.IntRange(0), default=0, help="Of the drawn points."),
        click.option(
            "--points", type=click.IntRange(16), default=1024, help="Points that are looked at."
        ),
        click.option("--partial", is_flag=True, help="The target shows a part of the source only."),
        click.option(
            "--surfaces",
            is_flag=True,
            help="Go on from the points to the surfaces; on trial, see docs/guide/register.md.",
        ),
        click.option(
            "--map",
            "rounds",
            type=click.IntRange(0),
            default=40,  # as dine.register; other numbers have no calibration
            show_default=True,
            help="Rounds of refinement at test time; 0 for the network's own field.",
        ),
        click.option(
            "--prealign",
            default="auto",
            help="Rigid alignment first: auto, off, or a text file of a 4×4 matrix.",
        ),
    ):
        command = option(command)
    return command


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


@cli.command(
    epilog="""
    Examples:

    \b
    dine register before.ply after.ply -o moved.ply --view
    dine register ct.stl us.obj -o moved.stl --apply tumour.stl --partial
    """
)
@click.argument("source", type=IN)
@click.argument("target", type=IN)
@click.option("-o", "--out", type=OUT, required=True, help="The moved source; suffix says how.")
@click.option("--apply", type=IN, multiple=True, help="Another shape to move along; repeatable.")
@click.option(
    "--landmarks", type=IN, nargs=2, help="Corresponding points of source and target, to measure."
)
@registration_options
@click.option("--overwrite", is_flag=True, help="Replace files that are there already.")
@model_options
def register(
    source,
    target,
    out,
    apply,
    landmarks,
    prealign,
    rounds,
    surfaces,
    partial,
    points,
    seed,
    view,
    overwrite,
    load_model,
    device,
):
    """Move SOURCE onto TARGET: any mesh or point file, any number of points, any units.

    Beside the moved source OUT go the displacement of every vertex (OUT.field.npz, OUT.field.vtp),
    a report (OUT.json) and, with --view, a page to look at (OUT.html).
    """
    from dine.io.readers import read_surface
    from dine.io.writers import check_holds
    from dine.registration.output import Outputs, save
    from dine.registration.register import register as run
    from dine.registration.shapes import shapes_by_name

    _start_torch()
    shapes = shapes_by_name(apply)
    outputs = Outputs(out)
    outputs.check(shapes, view=view, overwrite=overwrite)
    moving = read_surface(source)
    check_holds(out, moving)
    result = run(
        moving,
        target,
        model=load_model(),
        prealign=_alignment(prealign),
        apply=shapes,
        landmarks=landmarks or None,
        rounds=rounds,
        surfaces=surfaces,
        partial=partial,
        points=points,
        seed=seed,
        device=device,
    )
    said = save(result, outputs, applied=shapes, view=view, overwrite=overwrite)
    report = result.report
    click.echo(
        f"{out}: HD95 {report['before']['hd95']:.4g} -> {report['after']['hd95']:.4g}, "
        f"{result.trust.verdict}"
        + (
            f", expected error {result.trust.expected_error:.3g}"
            if result.trust.expected_error is not None
            else ""
        )
        + f" ({report['seconds']:.1f} s)"
    )
    for sentence in (*result.trust.reasons, *said):
        click.echo(f"  {sentence}")


@cli.command(
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
@model_options
def register_many(
    manifest,
    out,
    suffix,
    prealign,
    rounds,
    surfaces,
    partial,
    points,
    seed,
    view,
    load_model,
    device,
):
    """Register every pair of MANIFEST, a CSV file (source, target, name) or a folder.

    A pair that fails is reported and does not stop the others; run the same command again to go on
    after an interruption. OUT/summary.csv has one row a pair.
    """
    from dine.registration.many import read_jobs
    from dine.registration.many import register_many as run

    _start_torch()
    settings = {
        "prealign": _alignment(prealign),
        "rounds": rounds,
        "surfaces": surfaces,
        "partial": partial,
        "points": points,
        "seed": seed,
        "device": device,
    }
    summary = run(
        read_jobs(manifest), out, load_model(), suffix=suffix, view=view, settings=settings
    )
    failed = int((summary["state"] == "failed").sum())
    click.echo(f"{len(summary) - failed} of {len(summary)} registered; {out / 'summary.csv'}")
    if failed:
        sys.exit(1)


@cli.command()
@model_option
@click.option("--pairs", type=IN, multiple=True, required=True, help="Pairs (HDF5); repeatable.")
@targets_option
@click.option(
    "--raw",
    "raws",
    type=IN,
    multiple=True,
    help="Of `raw`: the datasets that the pairs were made from, to calibrate on their meshes.",
)
@click.option("--prior", type=IN, help="The prior that the trust score is to use.")
@click.option("--device", type=click.Choice(["auto", "cpu", "cuda"]), default="auto")
@click.option("--out", type=OUT, required=True, help="Calibration to write (JSON, and a plot).")
def calibrate(model, pairs, targets, raws, prior, device, out):
    """Learn from validation pairs what a model's uncertainty means; check it on test pairs.

    With --raw for `register --surfaces`, on the meshes that the pairs were drawn on.

    Example: dine calibrate --model model.safetensors --pairs pairs.h5 --targets resampled.h5
    --raw raw.json --prior pca.safetensors --out calibration.json
    """
    from dine.models.devices import chosen_device, leased
    from dine.registration.calibrate import calibrate as run

    _start_torch()
    with leased(chosen_device(device)) as [found]:
        run(
            model,
            list(pairs),
            out,
            targets=list(targets),
            raws=list(raws),
            prior=prior,
            device=found,
        )


def main() -> None:
    """Entry point: user errors become one line on standard error."""
    sys.stdout.reconfigure(errors="backslashreplace")  # file names may be no text
    try:
        cli(standalone_mode=False)
    except click.exceptions.Abort:
        sys.exit(130)
    except click.ClickException as error:
        error.show()
        sys.exit(error.exit_code)
    except DineError as error:
        # Also reaches the log file; before the command line is parsed there is none yet.
        if logging.getLogger().handlers:
            log.error("Error: %s", error)
        else:
            click.echo(f"Error: {error}", err=True)
        sys.exit(1)


if __name__ == "__main__":
    main()
