"""The command line: one command for each step, all of them usable without Snakemake.

Heavy modules (torch, matplotlib) are imported by the command that needs them.
"""

from __future__ import annotations

import logging
import os
import sys
from pathlib import Path

import click

from dine import __version__
from dine.cli import configuration, data, evaluation, organ, registration, reporting, training
from dine.cli.options import OUT
from dine.errors import DineError
from dine.extras import extras_needed
from dine.files import storage_errors

log = logging.getLogger("dine")


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


cli.add_command(configuration.config_group)
for _module in (data, training, evaluation, reporting, registration, organ):
    for _command in vars(_module).values():
        if isinstance(_command, click.Command):
            cli.add_command(_command)


def main() -> None:
    """Entry point: user errors become one line on standard error."""
    sys.stdout.reconfigure(errors="backslashreplace")  # file names may be no text
    try:
        with extras_needed():
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
