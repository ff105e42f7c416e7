"""The report of a finished run, from the files in its results folder."""

from __future__ import annotations

from pathlib import Path

import pandas as pd

from dine.config import STAGE1, Config
from dine.files import read_json
from dine.provenance import versions
from dine.reporting.build import Run
from dine.reporting.html import ReportFigure, write_report
from dine.reporting.tables import all_tables, display_name
from dine.results import runs


def build_report(results: Path, config: Config, out: Path) -> None:
    """Write the HTML report of a run whose figures are drawn."""
    run = Run(results, config)
    agreement = pd.DataFrame(
        {"dataset": display_name(dataset)} | read_json(run.files.data(dataset).agreement)
        for dataset in config.datasets
    )
    seconds, made = {}, {}
    for dataset, backbone, method in runs(config):
        record = read_json(run.files.run(dataset, backbone, method).record)
        made = record.get("made", made)
        stage = "Stage 1" if method == STAGE1 else "Stage 2"
        label = (
            f"{stage}, {display_name(dataset)}, {display_name(backbone)}, {display_name(method)}"
        )
        seconds[label] = record["training_seconds"]
    links = {"All tables (Markdown)": "tables/all.md", "Resolved configuration": "config.yaml"}
    for dataset in config.datasets:
        links[f"{display_name(dataset)}: files found"] = f"{dataset}/inventory.csv"
        links[f"{display_name(dataset)}: files left out"] = f"{dataset}/left_out.csv"
        links[f"{display_name(dataset)}: pairs"] = f"{dataset}/pairs.h5"
    write_report(
        out,
        run.metrics,
        all_tables(run.metrics, config.evaluation.training_spread),
        [
            ReportFigure(section, caption, results / "figures" / f"{name}.png")
            for name, (section, caption, _) in run.all_figures().items()
        ],
        index_agreement=agreement,
        lambda_searches=[read_json(path) for path in run.searches().values()],
        config=config.model_dump(mode="json"),
        versions=versions(),
        step_seconds=seconds,
        files=links,
        made=made,
        spread=config.evaluation.training_spread,
    )
