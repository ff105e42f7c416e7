"""Predictions on disk: displacement fields for every test pair and condition."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dine.data.fields import get_names, opened
from dine.results import CLEAN

FORMAT = "dine-predictions"


@dataclass(frozen=True)
class Prediction:
    """One condition's fields.

    Attributes:
        condition: ``deformation``, ``noise`` or ``outliers``.
        corruption: noise standard deviation or percentage of outliers; 0 where clean.
        pair: (P,) pair names.
        displacement: (P, N, 3) float32, normalised frame.
    """

    condition: str
    corruption: float
    pair: np.ndarray
    displacement: np.ndarray


def read_predictions(path: Path) -> list[Prediction]:
    """All conditions of a predictions file, the clean one first.

    Raises:
        DataError: missing, damaged, or another kind of file.
    """
    with opened(path, FORMAT) as file:
        found = [
            Prediction(
                str(group.attrs["condition"]),
                float(group.attrs["corruption"]),
                get_names(group),
                group["displacement"][:],
            )
            for group in file.values()
        ]
    order = {CLEAN: 0, "noise": 1, "outliers": 2}
    return sorted(found, key=lambda p: (order.get(p.condition, 3), p.corruption))
