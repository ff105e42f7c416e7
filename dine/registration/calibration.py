"""What a model's uncertainty and a field's plausibility mean, as learned from validation pairs."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from dine.errors import DataError
from dine.files import read_json, write_json
from dine.geometry.distance import surface_distance
from dine.geometry.folding import folding
from dine.priors.base import Prior
from dine.priors.pca import PCAPrior

CALIBRATION_FORMAT = "dine-calibration"


@dataclass(frozen=True)
class Calibration:
    """Measured on validation pairs of known correspondence, in the normalised frame.

    Attributes:
        spread: (b,) increasing values of what tells errors apart, the ``indicator`` of a
            :class:`~dine.registration.types.Correspondence`.
        error: (b,) mean distance of a point of that spread from its true place.
        likely: (b,) 90th percentile of these distances.
        reference: sorted values over validation pairs by name: ``initial`` and ``final`` Chamfer
            distance, ``reach`` (largest displacement), ``folding``, and under the prior
            ``in_span`` and ``residual``; see :func:`plausibility`.
        facts: model, prior and pairs that it belongs to.
    """

    spread: list[float]
    error: list[float]
    likely: list[float]
    reference: dict[str, list[float]]
    facts: dict[str, Any] = field(default_factory=dict)

    def expected_error(self, spread: np.ndarray) -> np.ndarray:
        """Mean error at points of these spreads, in the same units."""
        return np.interp(spread, self.spread, self.error)

    def likely_error(self, spread: np.ndarray) -> np.ndarray:
        """What nine of ten errors stay below at points of these spreads."""
        return np.interp(spread, self.spread, self.likely)

    def percentile(self, name: str, value: float) -> float:
        """Share of the validation pairs, in percent, with a smaller value."""
        values = self.reference[name]
        return 100 * float(np.searchsorted(values, value)) / len(values)

    def save(self, path: Path) -> None:
        write_json(path, {"format": CALIBRATION_FORMAT, **asdict(self)})


def load_calibration(path: Path) -> Calibration:
    """Read a calibration.

    Raises:
        DataError: missing, damaged or something else.
    """
    content = read_json(path)
    try:
        if content.pop("format") != CALIBRATION_FORMAT:
            raise KeyError("format")
        loaded = Calibration(**content)
        _check(loaded)
        lists = {key: [*map(float, getattr(loaded, key))] for key in ("spread", "error", "likely")}
        lists["reference"] = {key: [*map(float, loaded.reference[key])] for key in loaded.reference}
        return replace(loaded, **lists)
    except (KeyError, TypeError, AttributeError, ValueError, OverflowError):
        raise DataError(
            f"{path} is not a calibration, or is damaged; make one with `dine calibrate`."
        ) from None


def _check(calibration: Calibration) -> None:
    """Raise a ``ValueError`` or ``TypeError`` where a part is not what ``Calibration`` says."""
    lists = {**calibration.reference, "error": calibration.error, "likely": calibration.likely}
    for name, values in {**lists, "spread": calibration.spread}.items():
        numbers = all(type(value) in (int, float) and math.isfinite(value) for value in values)
        if not isinstance(values, list) or not values or not numbers:
            raise ValueError(f"{name!r} is no list of numbers")
        if name not in ("error", "likely") and values != sorted(values):
            raise ValueError(f"{name!r} does not increase")
    if not len(calibration.spread) == len(calibration.error) == len(calibration.likely):
        raise ValueError("its lists have different lengths")
    if not isinstance(calibration.facts, dict):
        raise TypeError("its facts are no object")


def field_values(
    source: np.ndarray,
    field: np.ndarray,
    target: np.ndarray,
    prior: Prior | None,
    *,
    shown: tuple[float, float] = (1.0, 1.0),
) -> dict[str, float]:
    """Of a field (N, 3) between (N, 3) and (M, 3) points, what a calibration has references for.

    ``shown`` are the shares of the source and of the target whose distances count.
    """
    values = {
        "initial": surface_distance(source, target, shown=shown)["chamfer"],
        "final": surface_distance(source + field, target, shown=shown)["chamfer"],
        "reach": float(np.linalg.norm(field, axis=1).max()),
        "folding": folding(source, field),
    }
    return values | ((plausibility(prior, field, source) if prior else None) or {})


def plausibility(
    prior: Prior, displacement: np.ndarray, source: np.ndarray
) -> dict[str, float] | None:
    """How far a field (N, 3) of a source (N, 3) is from those that a prior was fitted to.

    Both are in the prior's index convention. ``in_span``: the prior's own penalty, or with
    principal components the squared Mahalanobis distance per component. ``residual``: mean square
    of what lies outside the components, in standard deviations of each coordinate. None where the
    prior does not fit the number of points.
    """
    tensor = torch.as_tensor(displacement, dtype=torch.float32)[None]
    points = prior.shape.get("points")
    if points is not None and points != len(displacement):
        return None
    with torch.no_grad():
        if not isinstance(prior, PCAPrior):
            where = torch.as_tensor(source, dtype=torch.float32)[None]
            return {"in_span": float(prior.penalty(tensor, source=where)[0])}
        return {
            "in_span": float(prior.mahalanobis(tensor)[0]) / prior.shape["components"],
            "residual": float(prior.residual(tensor)[0]) / tensor.numel(),
        }
