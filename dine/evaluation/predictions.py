"""Predictions on disk: displacement fields for every test pair and condition."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np

from dine.errors import DataError
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
    try:
        with h5py.File(path) as file:
            if file.attrs.get("format") != FORMAT:
                raise DataError(f"{path} holds no predictions; expected {FORMAT}.")
            found = [
                Prediction(
                    str(group.attrs["condition"]),
                    float(group.attrs["corruption"]),
                    group["pair"].asstr()[:].astype(str),
                    group["displacement"][:],
                )
                for group in file.values()
            ]
    except FileNotFoundError:
        raise DataError(f"{path} does not exist; run `dine predict` first.") from None
    except (OSError, KeyError) as error:
        raise DataError(f"{path} is damaged ({error}); delete it and run again.") from error
    order = {CLEAN: 0, "noise": 1, "outliers": 2}
    return sorted(found, key=lambda p: (order.get(p.condition, 3), p.corruption))
