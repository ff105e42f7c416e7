"""Lists of pairs of a source and a target, as CSV files."""

from __future__ import annotations

import math
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
        table = pd.read_csv(path, dtype=str, keep_default_na=False)
    except (OSError, ValueError) as error:
        raise DataError(f"{path} is not a readable CSV file ({error}).") from None
    missing = [column for column in ("source", "target") if column not in table]
    if missing:
        raise DataError(f"{path} lacks the column {missing[0]!r}; expected source and target.")
    found = []
    for number, row in enumerate(table.to_dict("records"), start=1):
        source, target = (path.parent / row[key] for key in ("source", "target"))
        name = row.get("name") or f"{source.stem}_to_{target.stem}"
        if not row["source"] or not row["target"] or Path(name).name != name:
            raise DataError(
                f"{path}, row {number}: expected a source, a target and, if any, a plain name."
            )
        level = _level(row.get("level", ""), f"{path}, row {number}")
        found.append(ListedPair(name, row.get("object") or row["source"], source, target, level))
    return found


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
