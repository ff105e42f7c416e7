"""The page: its sections in reading order, and the files beside it."""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd
from matplotlib.figure import Figure

from dine.config import CONTROL
from dine.errors import DataError
from dine.files import atomic_path, read_json, write_text
from dine.provenance import versions
from dine.reporting import html
from dine.reporting.evidence.comparisons import LARGE, Evidence, load_evidence
from dine.reporting.evidence.figures import (
    forest_figure,
    level_figure,
    plausibility_figure,
    search_figure,
)
from dine.reporting.evidence.findings import all_findings
from dine.reporting.evidence.tables import (
    answer_table,
    corruption_table,
    diagnosed,
    diagnostics_table,
    goal_table,
    level_table,
    seed_table,
)
from dine.reporting.evidence.wording import HIGHER, LOWER, PARTIAL, VALUES, slug
from dine.reporting.figures import save_figure
from dine.reporting.tables import Table, to_markdown

WORDS = {
    "Mean correspondence error (MCE)": "Distance between where a point was put and where it "
    "really went, averaged over the points. The source fits into a sphere of radius 1, so 0.05 is "
    "2.5 % of its diameter. This is what matters for finding a structure again.",
    "Chamfer distance (CD)": "How well the two surfaces lie on each other (squared, shown in units "
    "of 10⁻⁴). It does not see points that slid along the surface to a wrong place.",
    "Level": f"Strength of the deformation. From {LARGE:g} on it counts as large here.",
    "λ": "How much the prior counts in training. With λ = 0 it does not count at all: what is then "
    "gained is gained by longer training alone.",
    "Failure": "A pair whose points are off by more than 5 % of the diameter on average.",
    "Roughness, folding": "How much neighbouring points move apart, and the share of places that "
    "are turned inside out. Tissue does not tear or fold: a roughness near that of the true field "
    "is plausible, a larger one means noise or tears, a smaller one stiffness.",
    f"{LOWER} and {HIGHER}": "Significantly lower or higher than the reference on the same "
    "pairs: p < 0.05 in Wilcoxon's signed-rank test, corrected by Holm over the levels. "
    f"{LOWER} is better.",
    "Interval": "95 % interval of the mean difference, found by drawing whole objects anew.",
    "Effect, wins": "Rank-biserial correlation, −1 where the method is lower on every pair and 1 "
    "where it is higher; and the share of the pairs on which it is lower.",
    PARTIAL: "Evaluated on some of the pairs only; compared with the reference on these.",
}


# ---------------------------------------------------------------------------------------- sections


@dataclass(frozen=True)
class Picture:
    """A drawn PNG to show among the examples; the dataset says where its data come from."""

    dataset: str
    png: Path
    caption: str


@dataclass(frozen=True)
class Drawing:
    """A figure to be saved under a name."""

    name: str
    caption: str
    figure: Figure


@dataclass(frozen=True)
class Folded:
    """What opens on a click."""

    title: str
    parts: tuple[Table, ...]


Item = Table | Drawing | Folded | html.ReportFigure


@dataclass(frozen=True)
class Section:
    name: str
    title: str
    text: tuple[str, ...]
    items: tuple[Item | None, ...]


def sections(
    evidence: Evidence,
    searches: Sequence[Mapping[str, Any]] = (),
    diagnostics: Sequence[tuple[Mapping[str, Any], Path | None]] = (),
    examples: Sequence[Picture] = (),
) -> list[Section]:
    """Everything below the findings, in reading order; what there is nothing of is left out."""
    places = evidence.places
    found = [
        Section(
            "main",
            "Every method at every level",
            ("Rows are methods, columns are levels of deformation.",),
            tuple(level_table(evidence, p, v) for p in places for v in VALUES),
        ),
        Section("answer", "Better than the reference?", *_answer(evidence)),
        Section(
            "effects",
            "How much better?",
            ("Left of zero is better. An interval that crosses zero allows for no difference.",),
            (
                *(_forest(evidence, place) for place in places),
                *(_over_levels(evidence, dataset) for dataset in evidence.datasets),
            ),
        ),
        Section(
            "corrupted",
            "Noise, outliers and other points",
            (
                "Real scans are noisy and never have the same points twice. Targets were corrupted "
                "or sampled anew; errors are to the true places all the same.",
            ),
            tuple(corruption_table(evidence, p, v) for p in places for v in VALUES),
        ),
        Section(
            "plausibility",
            "Accuracy against plausibility",
            (
                "A prior is to make fields plausible without making them wrong. Roughness near "
                "that of the true fields and little folding are plausible.",
            ),
            (
                *(_plausibility(evidence, dataset) for dataset in evidence.datasets),
                *_searched(evidence, searches),
            ),
        ),
        Section("seeds", "Seeds", *_seeds(evidence)),
        Section(
            "priors",
            "The priors themselves",
            (),
            (
                diagnostics_table(evidence, [record for record, _ in diagnostics]),
                *(_samples(evidence, record, png) for record, png in diagnostics),
            ),
        ),
        Section(
            "examples",
            "Examples",
            (),
            tuple(
                html.ReportFigure("", f"{evidence.where(x.dataset)}: {x.caption}", x.png)
                for x in examples
            ),
        ),
    ]
    return [section for section in found if any(item is not None for item in section.items)]


def _answer(evidence: Evidence) -> tuple[tuple[str, ...], tuple[Item | None, ...]]:
    reference = evidence.title(evidence.reference)
    text = (
        f"Every method against {reference}, pair by pair. What counts as evidence is a difference "
        "that is significant, of a size that matters, and larger than what another training would "
        "change (see Seeds).",
    )
    folded = Folded(
        "Every level",
        tuple(
            table
            for place in evidence.places
            for value in VALUES
            if (table := answer_table(evidence, place, value, by_level=True)) is not None
        ),
    )
    goal = None if evidence.goal.empty else goal_table(evidence)
    pooled = [answer_table(evidence, p, value) for p in evidence.places for value in VALUES]
    return text, (goal, *pooled, folded)


def _forest(evidence: Evidence, place: tuple[str, str]) -> Drawing | None:
    return _drawing(
        f"effects_{slug(*place)}",
        f"{evidence.where(*place)}: difference of the mean to "
        f"{evidence.title(evidence.reference)} in percent, all levels from {LARGE:g} on.",
        forest_figure(evidence, place),
    )


def _over_levels(evidence: Evidence, dataset: str) -> Drawing | None:
    return _drawing(
        f"levels_{slug(dataset)}",
        f"{evidence.where(dataset)}: mean correspondence error over levels, of the main methods "
        "and the best of each kind.",
        level_figure(evidence, dataset),
    )


def _plausibility(evidence: Evidence, dataset: str) -> Drawing | None:
    return _drawing(
        f"plausibility_{slug(dataset)}",
        f"{evidence.where(dataset)}: mean correspondence error against roughness and folding of "
        "the fields, one mark per method.",
        plausibility_figure(evidence, dataset),
    )


def _drawing(name: str, caption: str, figure: Figure | None) -> Drawing | None:
    return None if figure is None else Drawing(name, caption, figure)


def _searched(evidence: Evidence, searches: Sequence[Mapping[str, Any]]) -> list[Drawing]:
    by_place: dict[tuple[str, str], list[Mapping[str, Any]]] = {}
    for search in searches:
        by_place.setdefault((search["dataset"], search["backbone"]), []).append(search)
    found = []
    for place, some in by_place.items():
        origin = evidence.origin(place[0])
        caption = (
            f"{evidence.where(*place)}: errors on validation pairs over the weight λ of each prior."
        )
        figure = search_figure(evidence, place, some, origin)
        found.append(Drawing(f"lambda_{slug(*place)}", caption, figure))
    return found


def _seeds(evidence: Evidence) -> tuple[tuple[str, ...], tuple[Item | None, ...]]:
    text = (
        "Training again from other random numbers gives another network. The tests above average "
        "over trainings and ask about pairs; this is how much the trainings differ.",
    )
    return text, (seed_table(evidence),)


def _samples(
    evidence: Evidence, record: Mapping[str, Any], png: Path | None
) -> html.ReportFigure | None:
    if png is None:
        return None
    prior = diagnosed(evidence, "prior", record["prior"])
    where = evidence.where(record["dataset"], record["backbone"])
    return html.ReportFigure("", f"{where}: samples of {prior}.", png)


# ----------------------------------------------------------------------------------------- writing


def build_evidence(
    metrics: Sequence[Path],
    out: Path,
    *,
    methods: Mapping[str, Mapping[str, Any]],
    reference: str = CONTROL,
    searches: Sequence[Path] = (),
    diagnostics: Sequence[Path] = (),
    examples: Sequence[Picture] = (),
    config: Mapping[str, Any] | None = None,
) -> None:
    """Write ``report.html``, ``tables/*.csv``, ``tables/all.md`` and ``figures/*`` (PNG, PDF).

    Args:
        metrics: ``metrics.csv`` files of ``dine evaluate``.
        out: folder to write into.
        methods: by name as in the metrics: ``title``, ``group`` (of ``GROUPS``) and
            ``description``, one sentence. Methods without an entry have their name as title.
        reference: what the methods are compared with.
        searches: results of λ searches: ``dataset``, ``backbone``, ``selected``, ``curve`` and,
            possibly, ``criterion``.
        diagnostics: what ``diagnose`` found, with ``dataset``, ``backbone`` and ``prior``; a PNG of
            the same name beside is shown as the prior's samples.
        examples: further pictures.
        config: the resolved configuration; the backbones and test sets under its ``evidence`` are
            set aside.

    Raises:
        DataError: a file cannot be used, see ``load_evidence``, or is of a dataset that the
            metrics do not have; or methods were evaluated on pairs that do not meet.
    """
    settings = (config or {}).get("evidence") or {}
    aside = [*(settings.get("backbones") or {}), *(settings.get("test_sets") or {})]
    evidence = Evidence(load_evidence(metrics), methods, reference, tuple(aside))
    known = set(evidence.datasets)
    found = [_read(path, ("dataset", "backbone", "curve"), known) for path in searches]
    diagnosed = []
    for path in map(Path, diagnostics):
        png = path.with_suffix(".png")
        record = _read(path, ("dataset", "backbone", "prior"), known)
        diagnosed.append((record, png if png.is_file() else None))
    for picture in examples:
        if picture.dataset not in known:
            raise DataError(
                f"{picture.png} is of {picture.dataset}, of which there are no metrics."
            )
    parts = sections(evidence, found, diagnosed, examples)
    write = functools.partial(_shown, out)
    shown = [
        {
            "name": section.name,
            "title": section.title,
            "text": section.text,
            "shown": [write(item) for item in section.items if item is not None],
        }
        for section in parts
    ]
    shown.append({"name": "methods", "title": "Methods", "text": [], "shown": []})
    listed = [x for s in parts for x in s.items if isinstance(x, Table)]
    write_text(out / "tables" / "all.md", "\n\n".join(to_markdown(x) for x in listed))
    _write_csv(evidence.comparisons, out / "tables" / "comparisons.csv")
    html.render(
        out / "report.html",
        "evidence.html",
        reference=evidence.title(reference),
        origins=html.origins(evidence.metrics),
        findings=all_findings(evidence),
        words=WORDS,
        sections=shown,
        methods=list(evidence.methods.values()),
        versions=versions(),
        config=html.as_yaml(config),
    )


def _read(path: Path, keys: Sequence[str], datasets: set[str]) -> dict[str, Any]:
    record = read_json(path)
    missing = [key for key in keys if not isinstance(record, dict) or key not in record]
    if missing:
        raise DataError(f"{path} lacks {', '.join(missing)}.")
    if record["dataset"] not in datasets:
        raise DataError(f"{path} is of {record['dataset']}, of which there are no metrics.")
    return record


def _write_csv(data: pd.DataFrame, path: Path) -> None:
    with atomic_path(path) as temporary:
        data.to_csv(temporary, index=False, float_format="%.10g")


def _shown(out: Path, item: Item) -> dict[str, Any]:
    """Write an item's files; what the template needs of it."""
    if isinstance(item, Folded):
        return {
            "kind": "folded",
            "title": item.title,
            "parts": [_shown(out, part) for part in item.parts],
        }
    if isinstance(item, Table):
        _write_csv(item.data, out / "tables" / f"{item.name}.csv")
        return {"kind": "table", **html.shown_table(item)}
    if isinstance(item, Drawing):
        png = save_figure(item.figure, out / "figures" / item.name)[0]
        item = html.ReportFigure("", item.caption, png)
    caption, image, width = html.embedded(item)
    return {"kind": "figure", "caption": caption, "image": image, "width": width}
