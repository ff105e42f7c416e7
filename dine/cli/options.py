"""Options that commands share, and how their values reach them."""

from __future__ import annotations

import functools
import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import click

from dine import config
from dine.errors import ConfigError
from dine.files import check_place

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


class SectionType(click.ParamType):
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


def json_or_file(context, parameter, value):
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
        type=SectionType(model),
        default="{}",
        show_default=True,
        help=f"{model.__name__} settings; keys as in config.yaml, defaults where left out.",
    )


def default_of(section: type[config.Section], key: str) -> Any:
    """The default of a setting, without building what checks its whole section."""
    return section.model_fields[key].default


def out_option(help: str, type: click.ParamType = OUT):
    return click.option("--out", type=type, required=True, help=help)


def own_out_option(help: str, type: click.ParamType = OUT, required: bool = True):
    """Where a command on one's own scans writes to."""
    return click.option("-o", "--out", type=type, required=required, help=help)


json_option = click.option(
    "--json", "as_json", is_flag=True, help="Print the result as one JSON object."
)
seed_option = click.option("--seed", type=click.IntRange(0), default=0, show_default=True)
name_option = click.option("--name", default="", help="Shown with the progress.")
batch_option = click.option(
    "--batch-size",
    type=click.IntRange(1),
    default=default_of(config.Evaluation, "batch_size"),
    show_default=True,
    help="Pairs at a time.",
)
variants_option = click.option(
    "--variant", "variants", type=IN, multiple=True, help="Corrupted targets; repeatable."
)
pairs_option = click.option("--pairs", type=IN, required=True, help="Pairs (HDF5).")
several_pairs_option = click.option(
    "--pairs", type=IN, multiple=True, required=True, help="Pairs (HDF5); repeatable."
)
targets_option = click.option(
    "--targets", type=IN, multiple=True, help="Of `resample`, one for each file of pairs."
)
model_option = click.option("--model", type=IN, required=True, help="Weights (safetensors).")


def gathered(into: str, make: Callable[..., Any], *options: Callable) -> Callable:
    """Options whose values a command gets as one argument, ``into``: ``make(**values)``."""

    def decorate(command):
        @functools.wraps(command)
        def run(**values):
            own = {name: values.pop(name) for name in names}
            return command(**values, **{into: make(**own)})

        run.__click_params__ = []
        for option in reversed(options):
            option(run)
        names = [parameter.name for parameter in run.__click_params__]
        run.__click_params__ = [*getattr(command, "__click_params__", []), *run.__click_params__]
        return run

    return decorate


def compute_flags(*names: str) -> list[Callable]:
    """Options for some of the keys of ``Compute``."""
    kinds = {
        "device": click.Choice(["auto", "cpu", "cuda"]),
        "precision": click.Choice(["float32", "bf16"]),
        "processes": click.IntRange(1),
    }
    fields = config.Compute.model_fields
    return [
        click.option(
            f"--{name}",
            type=kinds[name],
            default=default_of(config.Compute, name),
            show_default=True,
            help=fields[name].description,
        )
        for name in names
    ]


def compute_options(*names: str) -> Callable:
    """The same, given to the command as ``compute``."""
    return gathered("compute", config.Compute, *compute_flags(*names))


def inference_options(called: str) -> Callable:
    """How to run a network over pairs, given as ``inference``; ``called`` where it has no name."""

    def make(batch_size: int, name: str, **compute: Any) -> dict[str, Any]:
        how = {"batch_size": batch_size, "compute": config.Compute(**compute)}
        return how | {"name": name or called}

    options = [batch_option, *compute_flags("device", "precision"), name_option]
    return gathered("inference", make, *options)


def start_torch() -> None:
    """Import torch, with the number of threads that was asked for."""
    import torch

    from dine.cli.compiling import say_when_compiling

    threads = os.environ.get("OMP_NUM_THREADS")
    if threads:
        torch.set_num_threads(int(threads))
    say_when_compiling()
