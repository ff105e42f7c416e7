"""A table to read and the numbers behind it, as CSV, Markdown, LaTeX and on pages."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd

from dine.files import atomic_path, write_text


@dataclass(frozen=True)
class Cell:
    """One entry of a displayed table, as plain text; pages colour what is lower or higher."""

    text: str
    bold: bool = False
    verdict: str = ""

    @property
    def lines(self) -> tuple[str, str]:
        """A number and, beneath it on pages, its deviation or interval."""
        first, *rest = re.split(r" (?=[±(\[])", self.text, maxsplit=1)
        return first, "".join(rest)


Columns = dict[tuple[str, str], Iterable[Any]]
"""What the rows show in each column, by (group, label): text, numbers or cells.

Adjacent columns of one group share a heading; the group of a row-label column is empty.
"""


@dataclass(frozen=True)
class Table:
    """A table to read (``header``, ``rows``) and the tidy numbers behind it (``data``).

    ``header`` holds (group, label) per column, as in ``Columns``.
    """

    name: str
    title: str
    caption: str
    header: tuple[tuple[str, str], ...]
    rows: tuple[tuple[Cell, ...], ...]
    data: pd.DataFrame

    @property
    def groups(self) -> list[tuple[str, int]]:
        """Runs of columns under one heading, as (group, number of columns)."""
        found: list[tuple[str, int]] = []
        for group, _ in self.header:
            if found and found[-1][0] == group:
                found[-1] = (group, found[-1][1] + 1)
            else:
                found.append((group, 1))
        return found

    @property
    def labels(self) -> int:
        """Number of columns on the left that say what a row is of."""
        named = [i for i, (group, _) in enumerate(self.header) if group]
        return named[0] if named else 1

    def once(self) -> list[tuple[Cell, ...]]:
        """The rows, with labels that repeat those of the row above left blank, but the last one."""
        found = []
        for above, row in zip((None, *self.rows), self.rows, strict=False):
            same = 0
            while above and same < self.labels - 1 and above[same] == row[same]:
                same += 1
            found.append((Cell(""),) * same + row[same:])
        return found


def laid_out(columns: Columns) -> dict[str, tuple]:
    """``header`` and ``rows`` of a table."""
    cells = [[x if isinstance(x, Cell) else Cell(str(x)) for x in c] for c in columns.values()]
    return {"header": tuple(columns), "rows": tuple(zip(*cells, strict=True))}


def write_tables(tables: Sequence[Table], folder: Path) -> None:
    """Write every table in three formats, and all of them together as ``all.md``."""
    for table in tables:
        write_table(table, folder / table.name)
    write_text(folder / "all.md", "\n\n".join(to_markdown(table) for table in tables))


def write_table(table: Table, path_stem: str | os.PathLike) -> list[Path]:
    """Write ``<stem>.csv`` (tidy numbers), ``<stem>.md`` and ``<stem>.tex``; return the paths."""
    paths = [Path(f"{path_stem}.{suffix}") for suffix in ("csv", "md", "tex")]
    write_numbers(table.data, paths[0])
    write_text(paths[1], to_markdown(table))
    write_text(paths[2], to_latex(table))
    return paths


def write_numbers(data: pd.DataFrame, path: Path) -> None:
    with atomic_path(path) as temporary:
        data.to_csv(temporary, index=False, float_format="%.10g")


def to_markdown(table: Table) -> str:
    """A GitHub-style table under its title, with the caption beneath."""
    lines = [f"### {_markdown(table.title)}", ""]
    names = [_markdown(f"{group}: {label}" if group else label) for group, label in table.header]
    lines += [f"| {' | '.join(names)} |", f"|{' --- |' * len(names)}"]
    for row in table.rows:
        cells = [f"**{_markdown(c.text)}**" if c.bold else _markdown(c.text) for c in row]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join([*lines, "", _markdown(table.caption), ""])


def _markdown(text: str) -> str:
    return re.sub(r"([\\`*_|<\[\]])", r"\\\1", text)


def to_latex(table: Table) -> str:
    """A booktabs table to ``\\input``; needs the packages booktabs and graphicx."""
    columns = "".join("c" if group else "l" for group, _ in table.header)
    # Shrinks a wide table to the text width as the paper does, but never enlarges a narrow one.
    width = r"\ifdim\width>\textwidth\textwidth\else\width\fi"
    lines = [
        r"% Needs \usepackage{booktabs} and \usepackage{graphicx}.",
        r"\begin{table}[t]",
        r"\centering",
        rf"\caption{{{_latex(table.title)}. {_latex(table.caption)}}}",
        rf"\label{{tab:{re.sub('[^a-z0-9]+', '-', table.name.lower())}}}",
        rf"\resizebox{{{width}}}{{!}}{{%",
        rf"\begin{{tabular}}{{{columns}}}",
        r"\toprule",
        *_latex_groups(table.groups),
        " & ".join(_latex(label) for _, label in table.header) + r" \\",
        r"\midrule",
    ]
    for row in table.rows:
        cells = [rf"\textbf{{{_latex(c.text)}}}" if c.bold else _latex(c.text) for c in row]
        lines.append(" & ".join(cells) + r" \\")
    return "\n".join([*lines, r"\bottomrule", r"\end{tabular}%", "}", r"\end{table}", ""])


def _latex_groups(groups: list[tuple[str, int]]) -> list[str]:
    cells, rules, start = [], [], 1
    for group, width in groups:
        cells.append(rf"\multicolumn{{{width}}}{{c}}{{{_latex(group)}}}")
        if group:
            rules.append(rf"\cmidrule(lr){{{start}-{start + width - 1}}}")
        start += width
    return [" & ".join(cells) + r" \\", "".join(rules)] if rules else []


_LATEX = {
    "\\": r"\textbackslash{}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    **{character: f"\\{character}" for character in "&%$#_{}"},
    "±": r"$\pm$",
    "10⁻⁴": r"$10^{-4}$",
    "×": r"$\times$",
    "≥": r"$\ge$",
    "λ": r"$\lambda$",
    "σ": r"$\sigma$",
    "▼": r"$\downarrow$",
    "▲": r"$\uparrow$",
    "†": r"$\dagger$",
    "−": "$-$",
    "–": "--",
}
_LATEX_PATTERN = re.compile("|".join(re.escape(text) for text in _LATEX))


def _latex(text: str) -> str:
    return _LATEX_PATTERN.sub(lambda match: _LATEX[match[0]], text)
