"""Views of test pairs: what some methods make of the same typical ones."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from dine.errors import DataError
from dine.evaluation.conditions import Condition, evaluation_conditions
from dine.evaluation.predictions import Prediction, read_predictions
from dine.reporting.figures import Example, qualitative_figure, save_figure
from dine.reporting.tables import display_name, setting_text
from dine.results import CLEAN


def draw_examples(
    pairs: Path,
    variants: list[Path],
    predictions: Mapping[str, Path],
    out: Path,
    *,
    titles: Mapping[str, str],
    dataset: str,
) -> None:
    """Write views of typical pairs under each condition, as ``out`` (PNG) and a PDF beside.

    Typical is the pair with the median mean correspondence error of the first method: of all clean
    pairs at the largest deformation level, and of those of each variant.

    Args:
        pairs: the test pairs.
        variants: of their targets.
        predictions: file by method; the first one decides what is shown.
        out: with the suffix ``.png``.
        titles: of the methods; others have their own name.
        dataset: for the title.

    Raises:
        DataError: predictions of other pairs, or without a condition.
    """
    found = {name: read_predictions(path) for name, path in predictions.items()}
    examples = []
    for condition in evaluation_conditions(pairs, variants):
        fields = {}
        for name, stored in found.items():
            mine = [p for p in stored if (p.condition, p.corruption) == condition[:2]]
            if not mine or mine[0].pair.tolist() != condition.pairs.name.tolist():
                raise DataError(
                    f"{predictions[name]} has not predicted these pairs under {condition.key}; "
                    "predict them again."
                )
            fields[name] = mine[0]
        examples.append(typical(condition, fields))
    origin = str(condition.pairs.attributes.get("origin", "synthetic"))
    named = {name: titles.get(name, name) for name in predictions}
    save_figure(_figure(examples, named, dataset, origin), out.with_suffix(""))


def typical(condition: Condition, fields: Mapping[str, Prediction]) -> Example:
    """The pair with the median error of the first method, with what all of them made of it."""
    pairs = condition.pairs
    first = next(iter(fields.values()))
    truth = pairs.target - pairs.source
    errors = np.linalg.norm(first.displacement - truth, axis=2).mean(axis=1)
    rows = np.arange(len(pairs))
    if condition.name == CLEAN:
        rows = np.flatnonzero(pairs.level == pairs.level.max())
    row = rows[np.argsort(errors[rows], kind="stable")[(len(rows) - 1) // 2]]
    label = f"{setting_text(condition.name, condition.corruption)}\nlevel {pairs.level[row]:g}"
    return Example(
        label,
        pairs.source[row],
        pairs.target[row],
        {name: pairs.source[row] + p.displacement[row] for name, p in fields.items()},
        {
            name: np.linalg.norm(p.displacement[row] - truth[row], axis=1)
            for name, p in fields.items()
        },
        None if condition.name == CLEAN else condition.targets[row],
    )


def _figure(
    examples: list[Example], titles: Mapping[str, str], dataset: str, origin: str
) -> Figure:
    return qualitative_figure(
        examples,
        f"{display_name(dataset)}: typical pairs",
        origin,
        titles=titles,
        error="Distance from the true place (object radii)",
        note=f"Grey: target. The median case of {next(iter(titles.values()))} in each row.",
    )
