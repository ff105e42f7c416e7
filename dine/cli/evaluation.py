"""Commands that predict, refine, register without a network, and measure."""

from __future__ import annotations

import click

from dine import config
from dine.cli.options import (
    IN,
    OUT,
    SectionType,
    gathered,
    inference_options,
    json_or_file,
    model_option,
    name_option,
    out_option,
    pairs_option,
    seed_option,
    start_torch,
    variants_option,
)
from dine.errors import ConfigError


@click.command()
@model_option
@pairs_option
@variants_option
@inference_options("predict")
@out_option("Predictions to write (HDF5).")
def predict(model, pairs, variants, inference, out):
    """Register the test split and its corrupted variants; write the displacement fields.

    Example: dine predict --model model.safetensors --pairs pairs.h5 --out predictions.h5
    """
    from dine.evaluation.predict import predict as run

    start_torch()
    run(model, pairs, list(variants), out, **inference)


@click.command()
@click.option("--predictions", type=IN, required=True, multiple=True, help="One for each method.")
@pairs_option
@variants_option
@click.option("--method", "methods", required=True, multiple=True, help="Its name; repeatable.")
@gathered(
    "labels",
    dict,
    click.option("--dataset", required=True),
    click.option("--backbone", required=True),
    seed_option,
)
@click.option("--point-errors", type=OUT, help="Per-point errors to write as well (HDF5).")
@out_option("Metrics (CSV).")
def evaluate(predictions, pairs, variants, methods, labels, point_errors, out):
    """Compute metrics from stored predictions.

    Example: dine evaluate --predictions predictions.h5 --pairs pairs.h5 --dataset mine
    --backbone robust_defreg --method stage1 --point-errors errors.h5 --out metrics.csv
    """
    from dine.evaluation.metrics import Labels
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
        labels=Labels(**labels),
    )


@click.command("refine-predictions")
@click.option("--predictions", type=IN, required=True, help="Of `dine predict`.")
@pairs_option
@variants_option
@click.option("--settings", type=SectionType(config.RefinedMethod), default='{"kind": "refined"}')
@click.option("--prior", type=IN, help="Prior's file; by default none.")
@name_option
@out_option("Predictions to write (HDF5).")
def refine_predictions(predictions, pairs, variants, settings, prior, name, out):
    """Refine a network's stored fields at test time, pair by pair.

    Example: dine refine-predictions --predictions predictions.h5 --pairs pairs.h5 --out refined.h5
    """
    from dine.evaluation.refined import refine_predictions as run

    start_torch()
    run(
        predictions,
        pairs,
        list(variants),
        out,
        settings=settings,
        prior=prior,
        name=name or "refine",
    )


@click.command()
@pairs_option
@variants_option
@click.option("--algorithm", required=True, help="unregistered, icp, cpd, bcpd, smooth, or a path.")
@click.option(
    "--arguments",
    callback=json_or_file,
    default="{}",
    show_default=False,
    metavar="JSON|FILE",
    help="Of the algorithm.",
)
@name_option
@out_option("Predictions to write (HDF5).")
def classical(pairs, variants, algorithm, arguments, name, out):
    """Register the test split and its corrupted variants without a network.

    Example: dine classical --pairs pairs.h5 --algorithm cpd --out cpd.h5
    """
    from dine.classical.predictions import classical_predictions as run

    run(
        pairs, list(variants), out, algorithm=algorithm, arguments=arguments, name=name or algorithm
    )
