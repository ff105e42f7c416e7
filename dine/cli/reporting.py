"""Commands that write tables, figures and reports."""

from __future__ import annotations

import click

from dine import config
from dine.cli.options import (
    FOLDER,
    IN,
    OUT_FOLDER,
    default_of,
    gathered,
    json_or_file,
    name_option,
    out_option,
    pairs_option,
    seed_option,
    settings_option,
    start_torch,
    variants_option,
)


@click.command()
@click.option("--prior", type=IN, required=True, help="Of `dine fit-prior` (safetensors).")
@click.option("--fields", type=IN, required=True, help="That it was fitted to (HDF5).")
@pairs_option
@gathered(
    "facts",
    dict,
    click.option("--dataset", default="", help="For the result."),
    click.option("--backbone", default="", help="For the result."),
    name_option,
)
@seed_option
@out_option("Result (JSON); samples beside it (PNG).")
def diagnose(prior, fields, pairs, facts, seed, out):
    """Measure a prior on the true displacements of validation pairs, and draw samples of it.

    Example: dine diagnose --prior pca.safetensors --fields dvf.h5 --pairs pairs.h5 --out pca.json
    """
    from dine.reporting.priors import diagnose_prior

    start_torch()
    facts["prior"] = facts.pop("name") or prior.stem
    diagnose_prior(prior, fields, pairs, out, seed=seed, facts=facts)


@click.command()
@click.argument("metrics", nargs=-1, required=True, type=IN)
@click.option(
    "--spread",
    type=click.FloatRange(0, 1),
    default=default_of(config.Evaluation, "training_spread"),
    help="How much differences vary with the training (`evaluation.training_spread`).",
)
@click.option(
    "--spread-outliers",
    type=click.FloatRange(0, 1),
    default=default_of(config.Evaluation, "training_spread_outliers"),
    help="The same on targets with outliers (`evaluation.training_spread_outliers`).",
)
@out_option("Folder for CSV, Markdown and LaTeX.", OUT_FOLDER)
def tables(metrics, spread, spread_outliers, out):
    """Aggregate metrics into the paper's tables and their companions.

    Example: dine tables a/metrics.csv b/metrics.csv --out tables
    """
    from dine.evaluation.statistics import spread_of
    from dine.reporting.loading import load_metrics
    from dine.reporting.table import write_tables
    from dine.reporting.tables import all_tables

    chance = config.Evaluation(training_spread=spread, training_spread_outliers=spread_outliers)
    made = all_tables(load_metrics(metrics), spread_of(chance))
    write_tables(made, out)


results_option = click.option(
    "--results", type=FOLDER, required=True, help="The workflow's results folder."
)


@click.command()
@results_option
@settings_option(config.Config)
@out_option("Folder for PNG and PDF.", OUT_FOLDER)
def figures(results, settings, out):
    """Draw all figures of a finished run.

    Example: dine figures --results results --settings @config.yaml --out results/figures
    """
    from dine.reporting.run import draw_figures

    draw_figures(results, settings, out)


@click.command()
@results_option
@settings_option(config.Config)
@out_option("Report to write (HTML).")
def report(results, settings, out):
    """Write one self-contained HTML page with tables, figures and findings.

    Example: dine report --results results --settings @config.yaml --out results/report.html
    """
    from dine.reporting.report import build_report

    build_report(results, settings, out)


methods_option = click.option(
    "--methods",
    callback=json_or_file,
    default="{}",
    show_default=False,
    metavar="JSON|FILE",
    help="Title, group and description of each method.",
)


@click.command()
@pairs_option
@variants_option
@click.option("--method", "names", multiple=True, required=True, help="One of each predictions.")
@click.option("--predictions", type=IN, multiple=True, required=True, help="Of `predict`.")
@methods_option
@click.option("--dataset", required=True, help="For the title.")
@out_option("Views to write (PNG; a PDF beside it).")
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


@click.command()
@click.argument("metrics", nargs=-1, required=True, type=IN)
@methods_option
@click.option("--reference", default=config.CONTROL, help="What methods are compared with.")
@gathered(
    "shown",
    dict,
    click.option("--search", "searches", type=IN, multiple=True, help="Of `search-lambda`."),
    click.option("--diagnostics", type=IN, multiple=True, help="JSON of a prior; repeatable."),
    click.option(
        "--example",
        "examples",
        type=(str, IN, str),
        multiple=True,
        metavar="DATASET PNG TEXT",
        help="A picture to show, and its caption; repeatable.",
    ),
)
@click.option(
    "--settings", callback=json_or_file, metavar="JSON|FILE", help="Configuration to show."
)
@out_option("Folder for report, tables and figures.", OUT_FOLDER)
def evidence(metrics, methods, reference, shown, settings, out):
    """Write the report on whether a prior helps: tests, tables, figures and findings.

    Example: dine evidence a/metrics.csv b/metrics.csv --methods '{"pca": {"title": "PCA prior",
    "group": "prior"}}' --search lambda.json --out evidence
    """
    from dine.reporting.evidence import ExamplePicture, Files, build_evidence

    examples = [ExamplePicture(*example) for example in shown["examples"]]
    files = Files(metrics, shown["searches"], shown["diagnostics"], examples)
    build_evidence(files, out, methods=methods, reference=reference, config=settings)
