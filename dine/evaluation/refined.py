"""Test pairs refined from a network's stored predictions."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from dine.config import RefinedMethod
from dine.errors import ConfigError, DataError
from dine.evaluation.conditions import (
    Condition,
    each_pair,
    evaluation_conditions,
    write_predictions,
)
from dine.evaluation.predictions import Prediction, read_predictions
from dine.files import file_digest
from dine.priors import Prior, load_prior
from dine.refinement.gradient import refine_by_gradient
from dine.refinement.refine import Observed, Options, refine
from dine.training.data_terms import DATA_TERMS
from dine.training.objective import Objective


def refine_predictions(
    predictions: Path,
    pairs_path: Path,
    variants: list[Path],
    out: Path,
    *,
    settings: RefinedMethod,
    prior: Path | None,
    name: str,
) -> None:
    """Refine a network's stored fields at test time, pair by pair, and write the refined ones.

    ``seconds`` of a pair contain the network's own.

    Raises:
        ConfigError: unknown arguments, or a prior that the algorithm cannot use.
        DataError: the predictions lack a pair or a condition.
    """
    fitted = load_prior(prior) if prior else None
    given = {(p.condition, p.corruption): p for p in read_predictions(predictions)}

    def fields(condition: Condition) -> Prediction:
        start = given.get((condition.name, condition.corruption))
        if start is None or start.pair.tolist() != condition.pairs.name.tolist():
            raise DataError(
                f"{predictions} lacks pairs of the condition {condition.key}; predict them first."
            )

        def register(row: int, source: np.ndarray, target: np.ndarray) -> np.ndarray:
            deviation = None if start.spread is None else start.spread[row].astype(float)
            return _refined(
                settings, fitted, source, target, start.displacement[row].astype(float), deviation
            )

        refined = each_pair(condition, name, register)
        if start.seconds is None:
            return refined
        return replace(refined, seconds=refined.seconds + start.seconds)

    facts = {"predictions": file_digest(predictions), "pairs": file_digest(pairs_path)}
    conditions = evaluation_conditions(pairs_path, variants)
    try:
        write_predictions(out, conditions, fields, name=name, **facts)
    except TypeError as error:
        raise ConfigError(
            f"{settings.algorithm} does not take the arguments {settings.arguments}: {error}."
        ) from None


def _refined(
    settings: RefinedMethod,
    prior: Prior | None,
    source: np.ndarray,
    target: np.ndarray,
    displacement: np.ndarray,
    deviation: np.ndarray | None,
) -> np.ndarray:
    if settings.algorithm == "gradient":
        objective = Objective(DATA_TERMS.get(settings.data_term)(), prior, settings.weight)
        return refine_by_gradient(source, target, displacement, objective, **settings.arguments)
    observed = Observed.of_network(displacement, deviation)
    gaussian = prior and prior.gaussian(source)
    options = Options(**settings.arguments)
    return refine(source, target, observed, prior=gaussian, options=options).mean
