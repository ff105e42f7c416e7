"""What commands say: the log on stderr, results on stdout, and errors, all in one form."""

from __future__ import annotations

import json
import logging
import os
import sys
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, NoReturn

import click
from tqdm import tqdm

from dine import progress
from dine.files import storage_errors

log = logging.getLogger("dine")


class _Form(logging.Formatter):
    """Lines with the time, errors without."""

    def __init__(self):
        super().__init__("%(asctime)s %(message)s", "%H:%M:%S")

    def format(self, record: logging.LogRecord) -> str:
        if record.levelno < logging.ERROR:
            return super().format(record)
        return record.getMessage()


class _Console(logging.StreamHandler):
    """Lines on stderr, above a bar if there is one; not those that are seen in another way."""

    def __init__(self):
        super().__init__(sys.stderr)
        self.setFormatter(_Form())
        self.addFilter(lambda record: not getattr(record, "elsewhere", False))

    def emit(self, record: logging.LogRecord) -> None:
        if not self.stream.isatty():
            return super().emit(record)
        with tqdm.external_write_mode(self.stream):
            super().emit(record)


def start(log_file: Path | None = None) -> None:
    """Begin to log to stderr and, if there is to be one, to a file, which gets results as well."""
    handlers: list[logging.Handler] = [_Console()]
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
    log.setLevel(logging.NOTSET)
    progress.hide(False)


def be_quiet() -> None:
    """Show errors, warnings and what was asked for as JSON; a log file still gets everything."""
    progress.hide()
    for handler in logging.getLogger().handlers:
        if isinstance(handler, _Console):
            handler.setLevel(logging.WARNING)


def be_verbose() -> None:
    """Log details of ours; those of libraries would be many."""
    log.setLevel(logging.DEBUG)


def tell(
    lines: Iterable[str], facts: Mapping[str, Any] | None = None, as_json: bool = False
) -> None:
    """The result of a command: sentences or one JSON object on stdout, sentences in the log.

    Nothing is printed in quiet, unless it is JSON.
    """
    for line in lines:
        log.info(line.strip(), extra=progress.ELSEWHERE)
        if not (as_json or progress.hidden()):
            click.echo(line)
    if as_json:
        click.echo(json.dumps(facts, default=os.fspath, allow_nan=False))


def fail(message: str, code: int) -> NoReturn:
    """End with one line that says why; below the traceback where details were asked for."""
    log.debug("Where this comes from:", exc_info=True)
    log.error("Error: %s", message)
    sys.exit(code)
