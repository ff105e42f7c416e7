"""Commands on configurations."""

from __future__ import annotations

import json
from pathlib import Path

import click

from dine import config
from dine.cli.options import IN, SectionType, out_option
from dine.files import write_text


@click.group("config")
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
@click.argument("settings", type=SectionType(config.Config))
@out_option("YAML to write.")
def config_write(settings: config.Config, out: Path):
    """Write a complete configuration, given as JSON or @FILE, as YAML.

    Example: dine config write @my.yaml --out complete.yaml
    """
    import yaml

    write_text(out, yaml.safe_dump(settings.model_dump(mode="json"), sort_keys=False))
