"""Test pairs refined from a network's stored predictions."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from dine.config import RefinedMethod
from dine.errors import ConfigError, DataError
from dine.evaluation.conditions import (
    Condition,
    each_pair,
    evaluation_conditions,
    prediction,
    write_predictions,
)
from dine.evaluation.predictions import Prediction, read_predictions
from dine.files import file_digest
from dine.priors import Prior, load_prior
from dine.registration.descent import descend
from dine.registration.refine import expected_error, refine
from dine.training.data_terms import DATA_TERMS


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
            spread = None if start.spread is None else start.spread[row].astype(float)
            return _refined(
                settings, fitted, source, target, start.displacement[row].astype(float), spread
            )

        found, seconds = each_pair(condition, name, register)
        if start.seconds is not None:
            seconds = seconds + start.seconds
        return prediction(condition, found, seconds)

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
    spread: np.ndarray | None,
) -> np.ndarray:
    if settings.algorithm == "gradient":
        return descend(
            source,
            target,
            displacement,
            data_term=DATA_TERMS.get(settings.data_term)(),
            prior=prior,
            weight=settings.weight,
            **settings.arguments,
        )
    return refine(
        source,
        target,
        displacement,
        expected_error(spread, len(source)),
        prior=prior and prior.gaussian(source),
        **settings.arguments,
    )
