"""Lists of pairs of a source and a target, as CSV files."""

from __future__ import annotations

import io
import math
import os
import re
import warnings
from dataclasses import dataclass
from pathlib import Path

import pandas as pd

from dine.errors import DataError


@dataclass(frozen=True)
class ListedPair:
    """One row of a manifest.

    Attributes:
        name: plain, to name files by.
        object: the undeformed object; pairs of one object belong together.
        source: file of the source.
        target: file of the target.
        level: how strong the deformation is, or None where the manifest does not say it.
    """

    name: str
    object: str
    source: Path
    target: Path
    level: float | None


def read_manifest(path: Path) -> list[ListedPair]:
    """The pairs of a CSV file with the columns ``source`` and ``target``, paths relative to it.

    Perhaps also ``name`` (by default ``<source>_to_<target>``), ``object`` (by default the source's
    path) and ``level`` (a number from 0 on).

    Raises:
        DataError: unreadable, without a column that is needed, or a row that cannot be used.
    """
    try:
        text = path.read_text(encoding="utf-8-sig")
        if "\0" in text:  # at which some versions of pandas end the value
            raise ValueError("it holds a NUL character")
        with warnings.catch_warnings():
            # pandas would drop what a row has too much.
            warnings.simplefilter("error", pd.errors.ParserWarning)
            table = pd.read_csv(
                io.StringIO(text), dtype=str, keep_default_na=False, index_col=False
            )
    except (OSError, ValueError, pd.errors.ParserWarning) as error:
        reason = " ".join(str(error).split())
        raise DataError(f"{path} is not a readable CSV file ({reason}).") from None
    missing = [column for column in ("source", "target") if column not in table]
    if missing:
        raise DataError(f"{path} lacks the column {missing[0]!r}; expected source and target.")
    found = []
    for number, row in enumerate(table.to_dict("records"), start=1):
        row = {key: value for key, value in row.items() if isinstance(value, str)}
        source, target = (path.parent / row.get(key, "") for key in ("source", "target"))
        name = row.get("name") or f"{source.stem}_to_{target.stem}"
        if not row.get("source") or not row.get("target") or not _is_plain(name):
            raise DataError(
                f"{path}, row {number}: expected a source, a target and, if any, a plain name."
            )
        level = _level(row.get("level", ""), f"{path}, row {number}")
        found.append(ListedPair(name, row.get("object") or row["source"], source, target, level))
    return found


def _is_plain(name: str) -> bool:
    """Whether a folder of this name lies directly in the one that it is made in."""
    harmless = not re.search(r"[\x00-\x1f\x7f]", name) and len(os.fsencode(name)) <= 200
    return Path(name).name == name and name != ".." and harmless


def _level(text: str, where: str) -> float | None:
    if not text:
        return None
    try:
        level = float(text)
    except ValueError:
        level = math.nan
    if not 0 <= level < math.inf:
        raise DataError(f"{where}: the level is {text!r}; expected a number from 0 on, or nothing.")
    return level
