"""The command line: one command for each step, all of them usable without Snakemake.

Heavy modules (torch, matplotlib) are imported by the command that needs them.
"""

from __future__ import annotations

import functools
import importlib
import os
import sys
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

import click

from dine import __version__
from dine.cli import console
from dine.cli.options import OUT
from dine.errors import DineError
from dine.extras import extras_needed

# In the order of the help: the module that its commands are in, and their names.
GROUPS = {
    "Register scans": ("registration", "register apply register-many scans calibrate"),
    "A prior of one organ": (
        "organ",
        "simulate learn organ-template organ-truth organ-trial organ-tables",
    ),
    "Pairs to train and test on": ("data", "inspect raw pairs corrupt resample agreement"),
    "Networks and priors": ("training", "stage1 pretrain fields fit-prior search-lambda stage2"),
    "Predictions and metrics": ("evaluation", "predict evaluate refine-predictions classical"),
    "Results": ("reporting", "diagnose tables figures report examples evidence"),
    "Configurations": ("configuration", "config"),
}
_MODULES = {name: module for module, names in GROUPS.values() for name in names.split()}


# Of `dine` itself, and of each command: they are looked for behind its name, too.
SPEECH = {
    ("-q", "--quiet"): ("Say only what goes wrong.", console.be_quiet),
    ("-v", "--verbose"): ("Say more: times of stages, where errors come from.", console.be_verbose),
}


class _Commands(Mapping[str, click.Command]):
    """All commands, each imported where it is asked for."""

    def __getitem__(self, name: str) -> click.Command:
        return _imported(name)

    def __iter__(self) -> Iterator[str]:
        return iter(_MODULES)

    def __len__(self) -> int:
        return len(_MODULES)


class _Groups(click.Group):
    """Commands that are listed in groups."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(self.commands)

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        widest = max(map(len, _MODULES))
        for title, (_, names) in GROUPS.items():
            with formatter.section(title):
                shown = formatter.width - widest - 6
                helps = {
                    name: self.commands[name].get_short_help_str(shown) for name in names.split()
                }
                formatter.write_dl([(name.ljust(widest), help) for name, help in helps.items()])


@functools.cache
def _imported(name: str) -> click.Command:
    module = importlib.import_module(f"dine.cli.{_MODULES[name]}")
    found = [x for x in vars(module).values() if isinstance(x, click.Command)]
    command = next(x for x in found if x.name == name)
    _speaking(command)
    return command


@click.group(
    cls=_Groups,
    commands=_Commands(),
    context_settings={"help_option_names": ["-h", "--help"], "show_default": True},
)
@click.version_option(__version__, prog_name="dine")
@click.option("--log", "log_file", type=OUT, help="Also write the log and results to this file.")
@click.option("--threads", type=click.IntRange(1), help="Threads for all processes together.")
def cli(log_file: Path | None, threads: int | None, **speech: bool):
    """Non-rigid registration of point clouds with learned deformation priors."""
    console.start(log_file)
    for (_, name), (_, begin) in SPEECH.items():
        if speech.get(name.removeprefix("--")):
            begin()
    if threads is not None:
        # Before torch and its libraries start their thread pools.
        os.environ["OMP_NUM_THREADS"] = str(threads)


def _speaking(command: click.Command) -> None:
    """Give a command, or all those below it, the options on what is said."""
    if isinstance(command, click.Group):
        for other in command.commands.values():
            _speaking(other)
        return
    for names, (help, begin) in SPEECH.items():
        option = click.Option(
            names, is_flag=True, help=help, expose_value=False, callback=_call(begin)
        )
        command.params.append(option)


def _call(begin: Callable[[], None]) -> Callable[..., None]:
    return lambda ctx, option, chosen: begin() if chosen else None


for _names, (_help, _) in SPEECH.items():
    cli.params.append(click.Option(_names, is_flag=True, help=_help))


def main() -> None:
    """Entry point: errors of users become one line on standard error."""
    sys.stdout.reconfigure(errors="backslashreplace")  # file names may be no text
    console.start()  # the command line itself may be wrong
    try:
        with extras_needed():
            cli(standalone_mode=False)
    except click.exceptions.Abort:
        sys.exit(130)
    except click.exceptions.NoArgsIsHelpError as error:
        error.show()
        sys.exit(error.exit_code)
    except click.ClickException as error:
        console.fail(_sentence(error), error.exit_code)
    except DineError as error:
        console.fail(str(error), 1)


def _sentence(error: click.ClickException) -> str:
    """What is wrong with a command line, and where the right one is described."""
    context = getattr(error, "ctx", None)
    message = error.format_message()
    if isinstance(error, click.NoSuchOption):
        for option in cli.params:
            if error.option_name in option.opts:  # of `dine` itself
                message = f"{error.option_name} stands before the command: dine {option.opts[0]} … "
                message += f"{context.info_name}."
    end = "" if message.endswith((".", "?", ")")) else "."
    return f"{message}{end} See `{context.command_path if context else 'dine'} --help`."
