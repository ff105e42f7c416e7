"""Predictions on disk: displacement fields for every test pair and condition."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np

from dine.data.fields import get_names, get_numbers, get_text, opened, put_fields, put_numbers
from dine.results import CLEAN

FORMAT = "dine-predictions"


@dataclass(frozen=True, eq=False)
class Prediction:
    """One condition's fields, of all test pairs or of some.

    Attributes:
        condition: ``deformation``, ``noise``, ``outliers`` or ``resampled``.
        corruption: noise standard deviation or percentage of outliers, 1 where resampled, 0 where
            clean.
        pair: (P,) pair names.
        displacement: (P, N, 3) float32, normalised frame.
        spread: (P, N) float32 standard deviation of the marginals of belief propagation, normalised
            frame; None from methods without marginals.
        seconds: (P,) float64 wall time of each pair; None where it was not measured.
    """

    condition: str
    corruption: float
    pair: np.ndarray
    displacement: np.ndarray
    spread: np.ndarray | None = None
    seconds: np.ndarray | None = None


def put_prediction(group: h5py.Group, prediction: Prediction) -> None:
    """Write one condition into its group of a predictions file."""
    group.attrs.update(condition=prediction.condition, corruption=prediction.corruption)
    put_fields(group, prediction.pair, prediction.displacement)
    if prediction.spread is not None:
        text = "(P, N) standard deviation of each source point's marginal, normalised frame"
        put_numbers(group, "spread", np.asarray(prediction.spread, np.float32), text)
    if prediction.seconds is not None:
        seconds = np.asarray(prediction.seconds, np.float64)
        text = "(P,) wall time of each pair in seconds"
        put_numbers(group, "seconds", seconds, text, by_row=False)


def read_predictions(path: Path) -> list[Prediction]:
    """All conditions of a predictions file, the clean one first.

    Raises:
        DataError: missing, damaged, or another kind of file.
    """
    with opened(path, FORMAT) as file:
        found = [_prediction(group) for group in file.values()]
    order = {CLEAN: 0, "noise": 1, "outliers": 2}
    return sorted(found, key=lambda p: (order.get(p.condition, 3), p.corruption))


def _prediction(group: h5py.Group) -> Prediction:
    field = get_numbers(group, "displacement", (None, None, 3))
    count, points, _ = field.shape
    optional = {"spread": ((count, points), "f4"), "seconds": ((count,), "f8")}
    corruption = float(group.attrs["corruption"])
    if not np.isfinite(corruption):
        raise ValueError(f"the corruption of its group {group.name!r} is {corruption}")
    return Prediction(
        get_text(group, "condition"),
        corruption,
        get_names(group, count),
        field,
        *(get_numbers(group, k, *v) if k in group else None for k, v in optional.items()),
    )
