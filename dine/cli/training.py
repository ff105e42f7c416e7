"""Commands that train networks and fit priors."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import click

from dine import config
from dine.cli.options import (
    IN,
    OUT_FOLDER,
    SectionType,
    compute_flags,
    default_of,
    gathered,
    inference_options,
    model_option,
    name_option,
    out_option,
    pairs_option,
    seed_option,
    settings_option,
    several_pairs_option,
    start_torch,
    targets_option,
)
from dine.errors import ConfigError

backbone_option = click.option(
    "--backbone",
    type=SectionType(config.BackboneConfig),
    default="{}",
    help="Kind and arguments of the backbone; by default "
    f"{default_of(config.BackboneConfig, 'kind')}.",
)


def _order(seed: int, out: Path, name: str = "", **compute):
    """Who asks for a training and where its results go; the command says what it is called."""

    def named(otherwise: str):
        from dine.training.stages import Order

        return Order(seed, out, name or otherwise, config.Compute(**compute))

    return named


def order_options(*options: Callable) -> Callable:
    compute = compute_flags("device", "precision", "processes")
    return gathered("order", _order, seed_option, *compute, *options)


run_options = order_options(name_option, out_option("Run folder.", OUT_FOLDER))


@click.command()
@pairs_option
@backbone_option
@settings_option(config.Stage1)
@run_options
def stage1(pairs, backbone, settings, order):
    """Train a backbone on the Chamfer distance alone.

    Example: dine stage1 --pairs pairs.h5 --settings '{"steps": 1000}' --out runs/stage1
    """
    from dine.training import stages

    start_torch()
    stages.stage1(pairs, backbone, settings, order(f"stage 1 {backbone.kind}"))


@click.command()
@several_pairs_option
@targets_option
@backbone_option
@settings_option(config.Pretraining)
@order_options(out_option("Run folder.", OUT_FOLDER))
def pretrain(pairs, targets, backbone, settings, order):
    """Train weights to start Stage 1 from, on synthetic pairs with known displacement.

    Example: dine pretrain --pairs pairs.h5 --targets resampled.h5 --out runs/pretraining
    """
    from dine.training import stages

    start_torch()
    order = order(f"pretraining/{backbone.kind}")
    stages.pretrain(list(pairs), backbone, settings, order, list(targets))


@click.command()
@model_option
@pairs_option
@click.option("--targets", type=IN, help="Of `resample`; seen instead of the pairs' own.")
@inference_options("fields")
@out_option("Fields to write (HDF5).")
def fields(model, pairs, targets, inference, out):
    """Write a model's displacement fields of the training split.

    Example: dine fields --model model.safetensors --pairs pairs.h5 --out dvf.h5
    """
    from dine.models.inference import dump_fields

    start_torch()
    dump_fields(model, pairs, out, targets=targets, **inference)


@click.command("fit-prior")
@click.option(
    "--fields", type=IN, multiple=True, required=True, help="Of `dine fields` (HDF5); repeatable."
)
@settings_option(config.PriorConfig)
@seed_option
@out_option("Prior to write (safetensors).")
def fit_prior(fields, settings, seed, out):
    """Fit a deformation prior to displacement fields and freeze it.

    The fit of a flow saves its state in training/ beside the output, and goes on from there.

    Example: dine fit-prior --fields dvf.h5 --settings '{"kind": "pca"}' --out pca.safetensors
    """
    from dine.priors.fitting import fit_prior as run

    start_torch()
    run(list(fields), settings, seed=seed, out=out)


prior_files_option = click.option(
    "--prior", "priors", type=(str, IN), multiple=True, help="Name and file of a prior; repeatable."
)
stage2_option = click.option(
    "--stage2", "stage2_settings", type=SectionType(config.Stage2), default="{}", help="Stage 2."
)


@click.command("search-lambda")
@pairs_option
@model_option
@prior_files_option
@stage2_option
@settings_option(config.LambdaSearch)
@order_options(out_option("Result (JSON)."))
def search_lambda(pairs, model, priors, stage2_settings, settings, order):
    """Choose λ on validation pairs.

    Example: dine search-lambda --pairs pairs.h5 --model model.safetensors --prior pca
    pca.safetensors --out lambda.json
    """
    from dine.training.stage2 import search_lambda as run

    start_torch()
    run(pairs, model, dict(priors), stage2_settings, settings, order("search of λ"))


@click.command()
@pairs_option
@model_option
@click.option("--variant", default=config.CONTROL, show_default=True, help="Prior's name.")
@click.option("--prior", type=IN, help="Prior's file; by default none.")
@click.option("--lambda", "weight", help="A number, or the file of `dine search-lambda`.")
@settings_option(config.Stage2)
@run_options
def stage2(pairs, model, variant, prior, weight, settings, order):
    """Refine a Stage-1 model with λ times a frozen prior; without a prior, the λ = 0 control.

    A variant of another name without a prior differs from the control in `data_term`.

    Example: dine stage2 --pairs pairs.h5 --model model.safetensors --variant pca --prior
    pca.safetensors --lambda lambda.json --out runs/pca
    """
    from dine.training.stage2 import selected_lambda
    from dine.training.stage2 import stage2 as run

    start_torch()
    if prior is None:
        value = 0.0
    elif weight is None:
        raise ConfigError("--lambda is needed with a prior: a number or a file of search-lambda.")
    else:
        try:
            value = float(weight)
        except ValueError:
            value = selected_lambda(Path(weight), variant)
    order = order(f"stage 2 {variant}")
    run(pairs, model, settings, order, variant=variant, prior=prior, weight=value)
