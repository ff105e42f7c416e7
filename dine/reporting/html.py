"""One self-contained HTML page: contents, sections of text, tables and figures."""

from __future__ import annotations

import base64
import io
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jinja2
import pandas as pd
import yaml
from PIL import Image

from dine.errors import DataError
from dine.files import write_text
from dine.reporting import names
from dine.reporting.table import Cell, Table
from dine.results import trained_on

_PIXELS_PER_DOT = 96 / 150
# Figures have few colours; a palette takes a quarter of the bytes.
_COLOURS = 64


@dataclass(frozen=True)
class Picture:
    """A saved PNG; it is embedded in the page."""

    caption: str
    png: str | os.PathLike


@dataclass(frozen=True)
class Part:
    """A ``heading``, ``code``, or ``links``: addresses relative to the page by label."""

    kind: str
    content: Any


@dataclass(frozen=True)
class Beside:
    """Items next to each other where the window is wide enough."""

    items: Sequence[Item | None]


@dataclass(frozen=True)
class Folded:
    """What opens on a click."""

    title: str
    items: Sequence[Item | None]


Item = str | list | dict | Table | Picture | Part | Beside | Folded
"""A string is a paragraph, a list are its points, and a dictionary explains its keys."""


@dataclass(frozen=True)
class PageSection:
    """A part of the page that its contents name, in ``short``; without items it is left out."""

    name: str
    title: str
    items: Sequence[Item | None]
    short: str = ""


def write_page(
    path: str | os.PathLike,
    title: str,
    intro: Sequence[str],
    banners: Sequence[Mapping[str, Any]],
    sections: Sequence[PageSection],
) -> Path:
    """Write a page; all text is escaped.

    Args:
        path: the HTML file to write.
        title: of the page.
        intro: paragraphs above everything.
        banners: of ``banners``.
        sections: in reading order.

    Raises:
        DataError: a figure is missing or no PNG, or an address is not relative.
    """
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("dine.reporting", ""),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    shown = [vars(section) | {"parts": _all_shown(section.items)} for section in sections]
    page = environment.get_template("report.html").render(
        title=title, intro=intro, banners=banners, sections=[x for x in shown if x["parts"]]
    )
    write_text(path, page)
    return Path(path)


def banners(metrics: pd.DataFrame, *, published: bool) -> list[dict[str, Any]]:
    """Where the data of each dataset come from; ``published``: if the page shows the paper's."""
    # Unseen objects are of the same making as the known ones.
    first = metrics.assign(dataset=metrics["dataset"].map(trained_on)).drop_duplicates("dataset")
    return [
        {
            "name": names.display_name(dataset),
            "origin": origin,
            "description": names.ORIGINS[origin],
            "in_paper": dataset in names.DATASETS,
            "published": published,
        }
        for dataset, origin in zip(first["dataset"], first["origin"], strict=True)
    ]


def grid(header: Sequence[str], rows: Iterable[Sequence[Any]]) -> Table | None:
    """A table for a page alone, without a title; None without rows."""
    cells = tuple(tuple(Cell(names.short(value)) for value in row) for row in rows)
    columns = tuple(("", name) for name in header)
    return Table("", "", "", columns, cells, pd.DataFrame()) if cells else None


def as_yaml(config: Mapping[str, Any]) -> Part:
    """The configuration as it is shown."""
    return Part("code", yaml.safe_dump(dict(config), sort_keys=False))


def _all_shown(items: Sequence[Item | None]) -> list[dict[str, Any]]:
    return [_shown(item) for item in items if item is not None and item != []]


def _shown(item: Item) -> dict[str, Any]:
    """What the macro ``item`` of the template needs."""
    kind = type(item).__name__.lower()
    if isinstance(item, Beside | Folded):
        title = getattr(item, "title", "")
        return {"kind": kind, "title": title, "parts": _all_shown(item.items)}
    if isinstance(item, Picture):
        return {"kind": kind, "caption": item.caption, **_embedded(Path(item.png))}
    if isinstance(item, Part):
        return _checked(item)
    return {"kind": kind, "content": item}


def _checked(part: Part) -> dict[str, Any]:
    for label, address in part.content.items() if part.kind == "links" else ():
        if "://" in address or address.startswith("/"):
            raise DataError(f"The report can link {label} only by a relative path, not {address}.")
    return vars(part)


def _embedded(png: Path) -> dict[str, Any]:
    """The picture in base64, in few colours, and its width in CSS pixels."""
    try:
        with Image.open(png, formats=["PNG"]) as image:
            small = image.convert("RGB").quantize(_COLOURS, dither=Image.Dither.NONE)
    except (FileNotFoundError, PermissionError) as error:
        raise DataError(f"The figure {png} cannot be read; draw it again.") from error
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        raise DataError(f"The figure {png} is not a PNG image; draw it again.") from error
    stream = io.BytesIO()
    small.save(stream, "PNG", optimize=True)
    width = round(small.width * _PIXELS_PER_DOT)
    return {"image": base64.b64encode(stream.getvalue()).decode(), "width": width}
