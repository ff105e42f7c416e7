"""The command line: one command for each step, all of them usable without Snakemake.

Heavy modules (torch, matplotlib) are imported by the command that needs them.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import click

from dine import __version__
from dine.cli import (
    configuration,
    console,
    data,
    evaluation,
    organ,
    registration,
    reporting,
    training,
)
from dine.cli.options import OUT
from dine.errors import DineError
from dine.extras import extras_needed

# In the order of the help: what a command belongs to is the module that it is in.
GROUPS = {
    "Register scans": registration,
    "A prior of one organ": organ,
    "Pairs to train and test on": data,
    "Networks and priors": training,
    "Predictions and metrics": evaluation,
    "Results": reporting,
    "Configurations": configuration,
}


# Of `dine` itself, and of each command: they are looked for behind its name, too.
SPEECH = {
    ("-q", "--quiet"): ("Say only what goes wrong.", console.be_quiet),
    ("-v", "--verbose"): ("Say more: times of stages, where errors come from.", console.be_verbose),
}


class _Commands(click.Group):
    """Commands that are listed in groups."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(self.commands)

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        widest = max(map(len, self.commands))
        for title, module in GROUPS.items():
            with formatter.section(title):
                formatter.write_dl(
                    [
                        (
                            command.name.ljust(widest),
                            command.get_short_help_str(formatter.width - widest - 6),
                        )
                        for command in _commands(module)
                    ]
                )


def _commands(module: ModuleType) -> list[click.Command]:
    """The commands of a module, without those that stand below another one."""
    found = [x for x in vars(module).values() if isinstance(x, click.Command)]
    below = [x for one in found if isinstance(one, click.Group) for x in one.commands.values()]
    return [command for command in found if command not in below]


@click.group(
    cls=_Commands, context_settings={"help_option_names": ["-h", "--help"], "show_default": True}
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
for _module in GROUPS.values():
    for _command in _commands(_module):
        cli.add_command(_command)
        _speaking(_command)


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
    end = "" if message.endswith((".", "?", ")")) else "."
    return f"{message}{end} See `{context.command_path if context else 'dine'} --help`."
