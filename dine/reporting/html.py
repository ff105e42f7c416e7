"""One self-contained HTML page: contents that stay in view; text, tables and figures."""

from __future__ import annotations

import base64
import io
import itertools
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import jinja2
import pandas as pd
import yaml
from PIL import Image

from dine.errors import DataError
from dine.files import write_text
from dine.reporting import names
from dine.reporting.table import Table, laid_out
from dine.results import trained_on

_PIXELS_PER_DOT = 96 / 150
# Figures have few colours; a palette takes half of the bytes.
_COLOURS = 64


@dataclass(frozen=True)
class Part:
    """A piece of a page that is neither text nor a table; see the functions that make one.

    ``kind``: ``heading``, ``code``, ``links`` (addresses relative to the page by label),
    ``picture`` (a saved PNG), ``beside`` or ``folded`` (items).
    """

    kind: str
    content: Any
    title: str = ""


Item = str | list | dict | Table | Part | None
"""A string is a paragraph, a list are its points, a dictionary explains its keys; None is left
out."""


@dataclass(frozen=True)
class PageSection:
    """A part of the page that its contents name, in ``short``; without items it is left out."""

    name: str
    title: str
    items: Sequence[Item]
    short: str = ""


def picture(caption: str, png: str | os.PathLike) -> Part:
    """A saved PNG; it is embedded in the page."""
    return Part("picture", png, caption)


def beside(*items: Item) -> Part:
    """Items next to each other where the window is wide enough."""
    return Part("beside", items)


def folded(title: str, *items: Item) -> Part:
    """What opens on a click."""
    return Part("folded", items, title)


def as_yaml(config: Mapping[str, Any]) -> Part:
    """A configuration as it is shown."""
    return Part("code", yaml.safe_dump(dict(config), sort_keys=False))


def grid(header: Sequence[str], rows: Iterable[Sequence[Any]]) -> Table | None:
    """A table for a page alone, without a title; None without rows."""
    cells = [[names.short(value) for value in row] for row in rows]
    columns = {("", name): [row[i] for row in cells] for i, name in enumerate(header)}
    return Table("", "", "", **laid_out(columns), data=pd.DataFrame()) if cells else None


def write_page(
    path: str | os.PathLike,
    title: str,
    intro: Sequence[str],
    banners: Sequence[Mapping[str, Any]],
    sections: Sequence[PageSection],
) -> None:
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
    shown = [vars(section) | {"parts": _shown(section.items)} for section in sections]
    page = environment.get_template("report.html").render(
        title=title, intro=intro, banners=banners, sections=[x for x in shown if x["parts"]]
    )
    write_text(path, page)


def banners(metrics: pd.DataFrame, *, published: bool) -> list[dict[str, Any]]:
    """Where data come from; ``published``: whether the page shows the paper's numbers."""
    # Unseen objects are of the same making as the known ones.
    origins = metrics.groupby(metrics["dataset"].map(trained_on), sort=False)["origin"].first()
    kinds: dict[tuple[str, bool], list[str]] = {}
    for dataset, origin in origins.items():
        kind = (origin, dataset in names.DATASETS)
        kinds.setdefault(kind, []).append(names.display_name(dataset))
    return [
        {
            "names": names.join(datasets),
            "origin": origin,
            "description": names.ORIGINS[origin],
            "in_paper": in_paper,
            "published": published,
        }
        for (origin, in_paper), datasets in kinds.items()
    ]


def _shown(items: Sequence[Item]) -> list[dict[str, Any]]:
    """What the macro ``item`` of the template needs, by item."""
    found = []
    for item in items:
        if not isinstance(item, Part):
            if item is not None and item != []:
                found.append({"kind": type(item).__name__.lower(), "content": item})
        elif item.kind == "folded":
            found.append({"kind": "folded", "title": item.title, "parts": _shown(item.content)})
        elif item.kind == "beside":
            # Tables one above the other, and pictures.
            runs = itertools.groupby(_shown(item.content), lambda x: x["kind"] == "picture")
            parts = [(drawn, list(some)) for drawn, some in runs]
            found.append({"kind": "beside", "parts": parts})
        elif item.kind == "picture":
            found.append({"kind": "picture", "caption": item.title, **_embedded(item.content)})
        else:
            _check_links(item)
            found.append(vars(item))
    return found


def _check_links(part: Part) -> None:
    for label, address in part.content.items() if part.kind == "links" else ():
        if "://" in address or address.startswith("/"):
            raise DataError(f"The report can link {label} only by a relative path, not {address}.")


def _embedded(png: str | os.PathLike) -> dict[str, Any]:
    """A picture in base64, in few colours, and its width in CSS pixels."""
    try:
        with Image.open(png, formats=["PNG"]) as image:
            small = image.convert("RGB").quantize(_COLOURS, dither=Image.Dither.NONE)
    except (FileNotFoundError, PermissionError) as error:
        raise DataError(f"The figure {png} cannot be read; draw it again.") from error
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        raise DataError(f"The figure {png} is not a PNG image; draw it again.") from error
    stream = io.BytesIO()
    small.convert("RGB").save(stream, "WEBP", lossless=True)
    width = round(small.width * _PIXELS_PER_DOT)
    return {"image": base64.b64encode(stream.getvalue()).decode(), "width": width}
