"""Views of test pairs: what some methods make of the same typical ones."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from dine.errors import DataError
from dine.evaluation.conditions import Condition, evaluation_conditions
from dine.evaluation.predictions import Prediction, read_predictions
from dine.reporting.figures import save_figure
from dine.reporting.names import display_name, setting_name
from dine.reporting.views import ExamplePair, qualitative_figure
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
    named = {name: titles.get(name, name) for name in predictions}
    figure = qualitative_figure(
        examples,
        f"{display_name(dataset)}: typical pairs",
        str(condition.pairs.attributes.get("origin", "synthetic")),
        titles=named,
        error="Distance from the true place (object radii)",
        note=f"Grey: target. The median case of {next(iter(named.values()))} in each row.",
    )
    save_figure(figure, out.with_suffix(""))


def typical(condition: Condition, fields: Mapping[str, Prediction]) -> ExamplePair:
    """The pair with the median error of the first method, with what all of them made of it."""
    pairs = condition.pairs
    truth = pairs.target - pairs.source
    errors = {n: np.linalg.norm(p.displacement - truth, axis=2) for n, p in fields.items()}
    rows = np.arange(len(pairs))
    if condition.name == CLEAN:
        rows = np.flatnonzero(pairs.level == pairs.level.max())
    mean = errors[next(iter(fields))].mean(axis=1)
    row = rows[np.argsort(mean[rows], kind="stable")[(len(rows) - 1) // 2]]
    label = f"{setting_name(condition.name, condition.corruption)}\nlevel {pairs.level[row]:g}"
    return ExamplePair(
        label,
        pairs.source[row],
        pairs.target[row],
        {name: pairs.source[row] + p.displacement[row] for name, p in fields.items()},
        {name: values[row] for name, values in errors.items()},
        None if condition.name == CLEAN else condition.targets[row],
    )
