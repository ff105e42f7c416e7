"""The report of a finished run: its figures and its sections, from the files in its folder."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from dine.config import STAGE1, Config
from dine.data.pairs import read_pairs
from dine.files import read_json
from dine.priors.base import load_prior
from dine.priors.pca import PCAPrior
from dine.provenance import versions
from dine.reporting import figures as draw
from dine.reporting import views
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
from dine.reporting.loading import load_metrics, origin_of
from dine.reporting.names import CD_SCALE, display_name, slug
from dine.reporting.tables import all_tables, findings
from dine.results import (
    CLEAN,
    Results,
    figure_names,
    own_searches,
    pca_priors,
    runs,
    strengths,
    table_name,
)

HISTORY_WINDOW = 20
"""Steps over which training curves are averaged, since a step sees few pairs."""
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
_LAMBDA_TITLE = "Choice of λ"
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


class Run:
    """Reads a run's files and draws its figures by name."""

    def __init__(self, results: Path, config: Config):
        self.files = Results(results)
        self.config = config
        self.metrics = load_metrics(self.files.run(*run).metrics for run in runs(config))

    def origin(self, dataset: str) -> str:
        return origin_of(dataset, self.metrics)

    def _per_method(self, dataset: str, backbone: str, file: str) -> dict[str, Path]:
        return {
            method: getattr(self.files.run(dataset, backbone, method), file)
            for method in self.config.methods(backbone)
        }

    def qualitative(self, dataset: str, backbone: str) -> Figure:
        examples = views.load_examples(
            views.pick_examples(dataset, backbone, self.metrics),
            read_pairs(self.files.data(dataset).pairs, split="test"),
            self._per_method(dataset, backbone, "predictions"),
            self._per_method(dataset, backbone, "point_errors"),
        )
        return views.qualitative_figure(examples, _title(dataset, backbone), self.origin(dataset))

    def histogram(self, dataset: str, backbone: str) -> Figure:
        errors = {
            method: views.read_group(path, CLEAN, "squared_distance")[1]
            for method, path in self._per_method(dataset, backbone, "point_errors").items()
        }
        title = f"{_title(dataset, backbone)}: per-point error, all levels"
        return draw.histogram_figure(errors, title, self.origin(dataset))

    def training(self, dataset: str, backbone: str) -> Figure:
        histories = {}
        for method, path in self._per_method(dataset, backbone, "history").items():
            frame = pd.read_csv(path)
            noisy = ["loss", "data", "penalty", "grad_norm"]
            frame[noisy] = frame[noisy].rolling(HISTORY_WINDOW, min_periods=1).mean()
            if not frame["penalty"].any():
                frame["penalty"] = np.nan
            histories[method] = frame.drop(columns=["learning_rate", "seconds"])
        title = f"{_title(dataset, backbone)}: training (mean over {HISTORY_WINDOW} steps)"
        return draw.training_figure(histories, title, self.origin(dataset))

    def spectrum(self, dataset: str, backbone: str, name: str) -> Figure:
        notes = self._pca(dataset, backbone, name).notes
        title = f"{_title(dataset, backbone)}: PCA prior ({notes['samples']} fields)"
        variance = (np.array(notes[f"explained_variance{x}"]) for x in ("", "_ratio"))
        return draw.pca_spectrum_figure(*variance, title, self.origin(dataset))

    def modes(self, dataset: str, backbone: str, name: str) -> Figure:
        prior = self._pca(dataset, backbone, name)
        source = read_pairs(self.files.data(dataset).pairs, split="test").source[0]
        return views.pca_modes_figure(
            prior.mean.numpy().reshape(-1, 3),
            prior.modes(),
            np.array(prior.notes["explained_variance"]),
            source,
            f"{_title(dataset, backbone)}: first modes of the PCA prior",
            self.origin(dataset),
        )

    def _pca(self, dataset: str, backbone: str, name: str) -> PCAPrior:
        return load_prior(self.files.prior(dataset, backbone, name))

    def searches(self) -> dict[str, Path]:
        """The files of all searches of λ, by the figures drawn of them."""
        own = {f"lambda_{name}": self.files.search_of(name) for name in own_searches(self.config)}
        return {"lambda": self.files.search, **own}

    def search(self, path: Path) -> Figure:
        search = read_json(path)
        where = _title(search["dataset"], search["backbone"])
        return draw.search_figure([search], where, self.origin(search["dataset"]))

    def figures(self) -> dict[str, tuple[str, str, Callable[[], Figure]]]:
        """Section of the report, caption and drawing function of every figure, by file stem."""
        found: dict[str, tuple[str, str, Callable[[], Figure]]] = {}
        for dataset in self.config.datasets:
            for kind in (CLEAN, *strengths(self.config, dataset)):
                make = partial(draw.distance_figure, dataset, self.metrics, kind)
                caption = f"Mean Chamfer distance on {display_name(dataset)}."
                found[f"distance_{dataset}_{kind}"] = ("Tables", caption, make)
            for backbone in self.config.backbones_of(dataset):
                place = (dataset, backbone)
                kinds = [((name,), *about) for name, about in _OF_PLACES.items()]
                for prior in pca_priors(self.config, backbone):
                    kinds += [((name, prior), *about) for name, about in _OF_PRIORS.items()]
                for (name, *prior), section, text in kinds:
                    make = partial(getattr(self, name), *place, *prior)
                    stem = "_".join([name, *place, *prior])
                    found[stem] = (section, f"{_title(*place)}: {text}.", make)
        for name, path in self.searches().items():
            caption = f"Validation errors over λ, {display_name(read_json(path)['backbone'])}."
            found[name] = (_LAMBDA_TITLE, caption, partial(self.search, path))
        return {name: found[name] for name in figure_names(self.config)}


_OF_PLACES = {
    "qualitative": (
        "Before and after",
        "the median Stage-1 case at the largest level, coloured by error",
    ),
    "histogram": (
        "Per-point errors",
        "distribution of per-point squared distances, clean targets",
    ),
    "training": ("Training", "training curves"),
}
"""Section and caption of the figures of a dataset with a backbone, by the method that draws."""
_OF_PRIORS = {
    "spectrum": ("The PCA prior", "variance explained by the components"),
    "modes": ("The PCA prior", "the first modes"),
}


def _title(dataset: str, backbone: str) -> str:
    return f"{display_name(dataset)}, {display_name(backbone)}"


def draw_figures(results: Path, config: Config, out: Path) -> None:
    """Draw every figure of a run as PNG and PDF into ``out``."""
    for name, (_, _, make) in Run(results, config).figures().items():
        draw.save_figure(make(), out / name)


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
    chosen = list(pictures.pop(_LAMBDA_TITLE, {}).values())
    sections = [
        *result_sections(run.metrics, pictures, config.evaluation.training_spread),
        lambda_section(searches, chosen),
        agreement_section(agreement),
        PageSection("how", "How it was made", _made(run, config)),
    ]
    write_page(out, "DINE report", INTRO, banners(run.metrics, published=True), sections)


def result_sections(
    metrics: pd.DataFrame,
    pictures: Mapping[str, Mapping[str, Part]] | None = None,
    spread: float = 0.0,
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
        apart = []
        for name, shown in some.items():
            table = _table_of(name)
            (at_tables.setdefault(table, []) if table else apart).append(shown)
        if apart:
            figures.append(PageSection(slug(heading).lower(), heading, [beside(*apart)]))
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
    return PageSection("lambda", _LAMBDA_TITLE, items)


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
