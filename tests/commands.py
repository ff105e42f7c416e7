"""Calling the commands of ``dine`` from tests."""

import click
from click.testing import CliRunner

from dine import cli

RAW = '{"recipe": {"shape": "tissue", "objects": 4, "levels": [0.2, 0.5]}, "pairs": {"points": 64}}'
STAGE1 = '{"steps": 3, "validate_every": 3, "validation_pairs": 1}'
STAGE2 = '{"steps": 2, "validate_every": 2, "validation_pairs": 1}'


def run(*arguments):
    """Run a command in this process; errors of ours are in what comes back."""
    return CliRunner().invoke(cli.cli, list(map(str, arguments)))


def dine(*arguments):
    """Run a command in this process; errors of ours come through as exceptions."""
    return CliRunner().invoke(cli.cli, list(map(str, arguments)), catch_exceptions=False)


def leaves(group, path=()):
    """The names and commands below a group."""
    for name, command in group.commands.items():
        if isinstance(command, click.Group):
            yield from leaves(command, (*path, name))
        else:
            yield (*path, name), command
