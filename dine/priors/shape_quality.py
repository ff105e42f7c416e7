"""How good a shape model is: compactness, generalisation and specificity by the number of modes.

As defined by Davies (2002) and Styner et al. (2003), with root mean square distances of
corresponding vertices; formulas in docs/reference/metrics.md. All three follow from coordinates
along the modes, so nothing is approximated but the draws of specificity.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from dine.geometry.procrustes import laid_onto
from dine.priors.organ_learning import components
from dine.priors.shape_model import ShapeModel

DRAWS = 1000


@dataclass(frozen=True)
class ShapeQuality:
    """Quality of a model with 0 to R modes. Lengths are in the units of the template.

    Attributes:
        compactness: (R + 1,) share of the variance that the first modes explain.
        generalisation: (R + 1,) distance of shapes that were left out from the nearest shape of
            the modes of the others, mean over shapes; NaN for more modes than the others have.
        generalisation_error: (R + 1,) its standard error.
        specificity: (R + 1,) distance of random shapes of the model from the nearest of those that
            it was made of, mean over draws.
        specificity_error: (R + 1,) its standard error.
        draws: number of random shapes.
        seed: of these.
        radius: of the template.
    """

    compactness: np.ndarray
    generalisation: np.ndarray
    generalisation_error: np.ndarray
    specificity: np.ndarray
    specificity_error: np.ndarray
    draws: int
    seed: int
    radius: float

    def rows(self) -> Iterator[dict[str, float]]:
        """A row for each number of modes; ``…_percent`` is of the radius."""
        for number in range(len(self.compactness)):
            row = {"modes": number, "compactness": float(self.compactness[number])}
            for name in ("generalisation", "specificity"):
                value = float(getattr(self, name)[number])
                row[name] = value
                row[f"{name}_percent"] = 100 * value / self.radius
                row[f"{name}_error"] = float(getattr(self, f"{name}_error")[number])
            yield row


def shape_quality(model: ShapeModel, *, draws: int = DRAWS, seed: int = 0) -> ShapeQuality:
    """Compactness, generalisation and specificity of a model, for every number of its modes."""
    variances = model.deviations**2
    compactness = np.concatenate([[0.0], np.cumsum(variances) / variances.sum()])
    left_out = _left_out(model)
    drawn = _drawn(model, draws, seed)
    return ShapeQuality(
        compactness,
        *_mean_and_error(left_out),
        *_mean_and_error(drawn),
        draws,
        seed,
        model.radius,
    )


def _mean_and_error(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Of columns."""
    return values.mean(axis=0), values.std(axis=0, ddof=1) / np.sqrt(len(values))


def _left_out(model: ShapeModel) -> np.ndarray:
    """(K, R + 1) distance of each shape from the model of the others, by the number of its modes.

    The shape is laid onto their mean anew; they stay in the common frame.
    """
    used, count = model.template.used, len(model.shapes)
    found = np.full((count, len(model.modes) + 1), np.nan)
    for row, shape in enumerate(model.shapes):
        mean, modes = components(np.delete(model.shapes, row, axis=0), count)
        missed = np.where(used[:, None], laid_onto(shape, mean, used) - mean, 0.0)
        flat = modes.reshape(len(modes), -1)
        along = flat @ missed.ravel() / np.linalg.norm(flat, axis=1)
        gone = np.concatenate([[0.0], np.cumsum(along**2)])
        rest = np.maximum((missed**2).sum() - gone, 0)
        # Where the others span less than they could, more modes do not help.
        rest = np.pad(rest, (0, max(count - 1 - len(rest), 0)), mode="edge")
        found[row, : len(rest)] = np.sqrt(rest / used.sum())[: found.shape[1]]
    return found


def _drawn(model: ShapeModel, draws: int, seed: int) -> np.ndarray:
    """(draws, R + 1) distance of random shapes from the nearest of the model's own, by the number
    of modes."""
    own = model.amplitudes(model.shapes) * model.deviations
    new = np.random.default_rng(seed).standard_normal((draws, len(model.modes)))
    new *= model.deviations
    squares = np.broadcast_to((own**2).sum(axis=1), (draws, len(own))).copy()
    found = [np.sqrt(squares.min(axis=1))]
    for mode in range(len(model.modes)):
        squares += (new[:, [mode]] - own[:, mode]) ** 2 - own[:, mode] ** 2
        found.append(np.sqrt(np.maximum(squares.min(axis=1), 0)))
    return np.stack(found, axis=1)
