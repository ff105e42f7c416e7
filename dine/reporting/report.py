"""The report of a finished run: its sections, from the files in its folder."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from dine.config import STAGE1, Config
from dine.evaluation.statistics import Spread, spread_of
from dine.files import read_json
from dine.provenance import versions
from dine.reporting.html import (
    Item,
    PageSection,
    Part,
    as_yaml,
    banners,
    beside,
    folded,
    grid,
    picture,
    write_page,
)
from dine.reporting.names import CD_SCALE, display_name, slug
from dine.reporting.run import LAMBDA_TITLE, Run
from dine.reporting.tables import all_tables, findings
from dine.results import (
    CLEAN,
    runs,
    table_name,
)

INTRO = (
    "Registering two point clouds of soft tissue means finding a displacement for every point of "
    "the source that brings it onto the target. DINE trains a registration network in two stages. "
    "Stage 1 only minimises the distance between the registered source and the target. Stage 2 "
    "continues from there and also penalises displacement fields that are unlikely under a prior "
    "learned from Stage 1's own fields: DINE-PCA models the whole field, DINE-Flow each "
    "displacement on its own. A control gets the same extra training with the prior switched off "
    "(λ = 0), so that what the prior adds can be told from what longer training adds.",
    "Errors are squared symmetric Chamfer distances (CD) between the registered source and the "
    "clean target in units of 10⁻⁴ of the normalised frame; lower is better.",
)
_NO_PRIOR = "No prior was evaluated in this run, so there is nothing to compare."
_LAMBDA = (
    "λ weighs the prior against the distance term. It was chosen on validation pairs; test pairs "
    "played no part."
)
_INDICES = (
    "A prior over whole displacement fields compares the displacement of point i across pairs. "
    "That makes sense only if point i lies at a similar place on every source. These numbers say "
    "how well that holds."
)


def build_report(results: Path, config: Config, out: Path) -> None:
    """Write the HTML report of a run whose figures are drawn.

    Raises:
        DataError: a file of the run is missing or damaged.
    """
    run = Run(results, config)
    agreement = [
        {"dataset": display_name(dataset)} | read_json(run.files.data(dataset).agreement)
        for dataset in config.datasets
    ]
    pictures: dict[str, dict[str, Part]] = {}
    for name, (section, caption, _) in run.figures().items():
        pictures.setdefault(section, {})[name] = picture(caption, run.files.figure(name, "png"))
    searches = [read_json(path) for path in run.searches().values()]
    chosen = list(pictures.pop(LAMBDA_TITLE, {}).values())
    sections = [
        *result_sections(run.metrics, pictures, spread_of(config.evaluation)),
        lambda_section(searches, chosen),
        agreement_section(agreement),
        PageSection("how", "How it was made", _made(run, config)),
    ]
    write_page(out, "DINE report", INTRO, banners(run.metrics, published=True), sections)


def result_sections(
    metrics: pd.DataFrame,
    pictures: Mapping[str, Mapping[str, Part]] | None = None,
    spread: Spread = 0.0,
) -> list[PageSection]:
    """Findings, tables and figures; a figure whose numbers a table holds stands beside it.

    Args:
        metrics: as ``load_metrics`` returns them.
        pictures: by heading and name, in reading order.
        spread: how much differences vary with the training; see ``statistics.comparisons``.
    """
    at_tables: dict[str, list[Part]] = {}
    figures = []
    for heading, some in (pictures or {}).items():
        apart: dict[str, list[Part]] = {}
        for name, shown in some.items():
            table, (_, _, of) = _table_of(name), name.partition("_")
            (at_tables if table else apart).setdefault(table or of, []).append(shown)
        # Figures of one thing are beside each other; where each thing has one, all of them are.
        rows = list(apart.values())
        if all(len(row) == 1 for row in rows):
            rows = [[shown for row in rows for shown in row]] if rows else []
        shown_rows = [beside(*row) for row in rows]
        figures.append(PageSection(slug(heading).lower(), heading, shown_rows))
    tables = {
        table.name: beside(table, *at_tables.get(table.name, []))
        for table in all_tables(metrics, spread)
    }
    gains = [tables.pop(name) for name in list(tables) if name.startswith("gains")]
    return [
        PageSection("findings", "Findings", findings(metrics, spread=spread) or [_NO_PRIOR]),
        PageSection("tables", "Tables", list(tables.values())),
        PageSection("gains", "What a prior adds", gains),
        *figures,
    ]


def _table_of(figure: str) -> str | None:
    """The table whose numbers a figure shows, by the names of both."""
    kind, _, rest = figure.partition("_")
    dataset, _, condition = rest.rpartition("_")
    return table_name(dataset, condition != CLEAN) if kind == "distance" else None


def lambda_section(
    searches: Sequence[Mapping[str, Any]], pictures: Sequence[Part] = ()
) -> PageSection:
    """Per prior: the choice, its validation errors and those of the λ = 0 control."""
    rows = []
    for search in searches:
        curve = pd.DataFrame(search["curve"]).astype({"lambda": float, "cd": float, "mce": float})
        for prior, chosen in search["selected"].items():
            line = curve[curve["prior"] == prior]
            cells: list[Any] = [f"{float(chosen):g}"]
            for value in (float(chosen), 0.0):
                row = line[np.isclose(line["lambda"], value, rtol=1e-6, atol=0)]
                cells += [CD_SCALE * float(row["cd"].mean()), float(row["mce"].mean())]
            rows.append([search["dataset"], search["backbone"], prior, *cells])
    header = ["Dataset", "Backbone", "Prior", "Chosen λ", "CD ×10⁻⁴", "Correspondence error"]
    header += ["CD ×10⁻⁴ at λ = 0", "Correspondence error at λ = 0"]
    items = [_LAMBDA, beside(grid(header, rows), *pictures)] if rows else []
    return PageSection("lambda", LAMBDA_TITLE, items)


def agreement_section(agreement: Sequence[Mapping[str, Any]]) -> PageSection:
    """How well point i means the same place across pairs; a row for each dataset."""
    frame = pd.DataFrame(agreement)
    table = grid([str(name) for name in frame], frame.itertuples(index=False))
    title = "Do point indices agree across pairs?"
    return PageSection("indices", title, [_INDICES, table], short="Point indices")


def _made(run: Run, config: Config) -> list[Item]:
    seconds, made = {}, {}
    for dataset, backbone, method in runs(config):
        record = read_json(run.files.run(dataset, backbone, method).record)
        made = record.get("made", made)
        stage = "Stage 1" if method == STAGE1 else "Stage 2"
        label = ", ".join([stage, *map(display_name, (dataset, backbone, method))])
        seconds[label] = duration(record["training_seconds"])
    links = {"All tables (Markdown)": "tables/all.md", "Resolved configuration": "config.yaml"}
    for dataset in config.datasets:
        links[f"{display_name(dataset)}: files found"] = f"{dataset}/inventory.csv"
        links[f"{display_name(dataset)}: files left out"] = f"{dataset}/left_out.csv"
        links[f"{display_name(dataset)}: pairs"] = f"{dataset}/pairs.h5"
    return [
        grid(["What", "Value"], made.items()),
        Part("heading", "Time per step"),
        grid(["Step", "Time"], seconds.items()),
        Part("heading", "Versions"),
        grid(["Package", "Version"], versions().items()),
        folded("Configuration", as_yaml(config.model_dump(mode="json"))),
        Part("heading", "Files"),
        Part("links", links),
    ]


def duration(seconds: float) -> str:
    if seconds < 60:
        return f"{seconds:.1f} s"
    minutes, seconds = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours} h {minutes:02d} min" if hours else f"{minutes} min {seconds:02d} s"
