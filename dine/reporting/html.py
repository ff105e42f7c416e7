"""One self-contained HTML page about a run: plain findings, tables, figures and how it was made."""

from __future__ import annotations

import base64
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jinja2
import numpy as np
import pandas as pd
import yaml

from dine.errors import DataError
from dine.files import write_text
from dine.reporting import tables
from dine.reporting.effects import headlines, overview
from dine.reporting.tables import Table, display_name
from dine.results import trained_on

_PIXELS_PER_DOT = 96 / 150


@dataclass(frozen=True)
class ReportFigure:
    """A saved figure: the PNG is embedded, ``section`` groups figures under one heading."""

    section: str
    caption: str
    png: str | os.PathLike


def write_report(
    path: str | os.PathLike,
    metrics: pd.DataFrame,
    report_tables: Sequence[Table],
    figures: Sequence[ReportFigure] = (),
    *,
    index_agreement: Mapping[str, Any] | pd.DataFrame | None = None,
    lambda_searches: Sequence[Mapping[str, Any]] = (),
    config: Mapping[str, Any] | None = None,
    versions: Mapping[str, str] | None = None,
    step_seconds: Mapping[str, float] | None = None,
    files: Mapping[str, str] | None = None,
    made: Mapping[str, str] | None = None,
    spread: float = 0.0,
) -> Path:
    """Write the report of a run.

    Args:
        path: the HTML file to write.
        metrics: as ``load_metrics`` returns them; the findings are computed from these.
        report_tables: usually ``all_tables(metrics)``.
        figures: saved figures in reading order.
        index_agreement: how well point i means the same place across pairs: a value by name, or a
            frame whose columns are shown as they are.
        lambda_searches: the results of the λ search, one per dataset and backbone.
        config: the resolved configuration.
        versions: version by package.
        step_seconds: wall-clock seconds by step.
        files: address relative to the report by label.
        made: where, when and how the run was made, by label.
        spread: how much differences vary with the training; see ``statistics.verdicts``.

    Raises:
        DataError: a figure is missing, or a file address is not relative.
    """
    for label, address in (files or {}).items():
        if "://" in address or address.startswith("/"):
            raise DataError(f"The report can link {label} only by a relative path, not {address}.")
    if isinstance(index_agreement, Mapping):
        index_agreement = pd.DataFrame(
            {"Quantity": list(index_agreement), "Value": list(index_agreement.values())}
        )
    return render(
        path,
        "report.html",
        origins=origins(metrics),
        headlines=headlines(metrics, spread=spread),
        overview=overview(metrics, spread=spread),
        spread=f"{100 * spread:g}" if spread else "",
        made=made or {},
        tables=[shown_table(table) for table in report_tables],
        sections=_sections(figures),
        agreement=None if index_agreement is None else _text_frame(index_agreement),
        lambdas=_chosen_lambdas(lambda_searches),
        config=as_yaml(config),
        versions=versions or {},
        seconds={name: _duration(value) for name, value in (step_seconds or {}).items()},
        files=files or {},
    )


# ------------------------------------------------------------------------------ rendering


def render(path: str | os.PathLike, template: str, **values: Any) -> Path:
    """Write a page from a template of this folder; all values are escaped."""
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("dine.reporting", ""),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    write_text(path, environment.get_template(template).render(**values))
    return Path(path)


def origins(metrics: pd.DataFrame) -> list[tuple[str, str, str, bool]]:
    """For the macro ``banners``: each dataset, its origin, and whether the paper has it."""
    # Unseen objects are of the same making as the known ones.
    names = metrics["dataset"].map(trained_on)
    first = metrics.assign(dataset=names).drop_duplicates("dataset")
    return [
        (
            display_name(dataset),
            origin,
            tables.ORIGIN_NAMES[origin],
            dataset in tables.DATASET_NAMES,
        )
        for dataset, origin in zip(first["dataset"], first["origin"], strict=True)
    ]


def as_yaml(config: Mapping[str, Any] | None) -> str | None:
    """The configuration as it is shown, None where there is none."""
    return None if config is None else yaml.safe_dump(dict(config), sort_keys=False)


def shown_table(table: Table) -> dict[str, Any]:
    """What the macro ``table`` of parts.html shows."""
    groups = tables.header_groups(table.header)
    return {
        "name": table.name,
        "title": table.title,
        "caption": table.caption,
        "groups": groups if any(group for group, _ in groups) else [],
        "header": table.header,
        "rows": table.rows,
    }


def embedded(figure: ReportFigure) -> tuple[str, str, int]:
    """Caption, PNG in base64 and width in CSS pixels, for the macro ``figure``.

    Raises:
        DataError: the file is missing or no PNG.
    """
    try:
        data = Path(figure.png).read_bytes()
    except OSError as error:
        raise DataError(f"The figure {figure.png} cannot be read; draw it again.") from error
    # A PNG starts with a signature and its header chunk; bytes 16 to 19 hold the width.
    if data[:8] != b"\x89PNG\r\n\x1a\n":
        raise DataError(f"The figure {figure.png} is not a PNG image; draw it again.")
    width = round(int.from_bytes(data[16:20], "big") * _PIXELS_PER_DOT)
    return figure.caption, base64.b64encode(data).decode(), width


def _sections(figures: Sequence[ReportFigure]) -> dict[str, list[tuple[str, str, int]]]:
    sections: dict[str, list[tuple[str, str, int]]] = {}
    for figure in figures:
        sections.setdefault(figure.section, []).append(embedded(figure))
    return sections


def _text_frame(frame: pd.DataFrame) -> dict[str, list]:
    rows = [[_text(value) for value in row] for row in frame.itertuples(index=False)]
    return {"header": [str(name) for name in frame.columns], "rows": rows}


def _text(value: Any) -> str:
    if isinstance(value, float | np.floating):
        return "–" if np.isnan(value) else f"{value:.4g}"
    return str(value)


def _chosen_lambdas(searches: Sequence[Mapping[str, Any]]) -> list[list[str]]:
    """Per prior: the choice, its validation errors and those of the λ = 0 control."""
    rows = []
    for search in searches:
        curve = pd.DataFrame(search["curve"]).astype({"lambda": float, "cd": float, "mce": float})
        for prior, chosen in search["selected"].items():
            line = curve[curve["prior"] == prior]
            cells = [f"{float(chosen):g}"]
            for value in (float(chosen), 0.0):
                row = line[np.isclose(line["lambda"], value, rtol=1e-6, atol=0)]
                cd, mce = (row[name].mean() for name in ("cd", "mce"))
                cells.append(_text(cd * tables.CD_SCALE))
                cells.append(_text(mce))
            names = [display_name(search[key]) for key in ("dataset", "backbone")]
            rows.append([*names, display_name(prior), *cells])
    return rows


def _duration(seconds: float) -> str:
    if seconds < 60:
        return f"{seconds:.1f} s"
    minutes, seconds = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours} h {minutes:02d} min" if hours else f"{minutes} min {seconds:02d} s"
