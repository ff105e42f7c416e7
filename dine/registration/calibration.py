"""What a model's uncertainty and a field's plausibility mean, learned from validation pairs."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from dine.data.batch import make_batch
from dine.data.pairs import PairSet, read_seen
from dine.errors import DataError
from dine.files import file_digest, read_json, write_json
from dine.geometry.distance import surface_distance
from dine.geometry.folding import folding
from dine.models.backbones import Backbone, marginal_deviation
from dine.models.checkpoint import load_backbone
from dine.priors import PCAPrior, Prior, load_prior
from dine.progress import Progress
from dine.refinement.refine import ROUNDS, Observed, Options, refine

CALIBRATION_FORMAT = "dine-calibration"
_BINS = 20
_EXACT = 1e-9  # object radii
_LIKELY = 90


@dataclass(frozen=True)
class Calibration:
    """Measured on validation pairs of known correspondence, in the normalised frame.

    Attributes:
        spread: (b,) increasing values of what tells errors apart; see :func:`find_field`.
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
        found = Calibration(**content)
        _check(found)
        lists = {key: [*map(float, getattr(found, key))] for key in ("spread", "error", "likely")}
        lists["reference"] = {key: [*map(float, found.reference[key])] for key in found.reference}
        found = replace(found, **lists)
    except (KeyError, TypeError, AttributeError, ValueError, OverflowError):
        raise DataError(
            f"{path} is not a calibration, or is damaged; make one with `dine calibrate`."
        ) from None
    return found


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


@torch.no_grad()
def find_field(
    backbone: Backbone,
    source: np.ndarray,
    target: np.ndarray,
    device: torch.device,
    rounds: int = ROUNDS,
) -> tuple[np.ndarray, np.ndarray | None]:
    """Displacement (N, 3) and what tells its errors apart (N,), float64, normalised frame.

    The network's field, refined in some rounds (see :func:`~dine.refinement.refine.refine`); 0
    leaves it as it is. Errors of the network's own field grow with the standard deviation of its
    marginals (None from a backbone without). What is left after refinement has little to do with
    that, but grows with how far a point moved, and with how far the network would have moved it
    elsewhere: their sum is taken. How well it ranks errors is among the facts of a calibration.
    """
    batch = make_batch([source], [target]).to(device)
    result = backbone.to(device).eval()(batch)
    found = result.displacement[0].double().cpu().numpy()
    deviation = marginal_deviation(backbone, result)
    spread = None if deviation is None else deviation[0].double().cpu().numpy()
    if rounds == 0:
        return found, spread
    observed = Observed.of_network(found, spread)
    refined = refine(source, target, observed, options=Options(rounds)).mean
    elsewhere = np.linalg.norm(refined - found, axis=1)
    return refined, np.linalg.norm(refined, axis=1) + elsewhere


def _measure(
    backbone: Backbone,
    prior: Prior | None,
    pairs: PairSet,
    seen: np.ndarray | None,
    device: torch.device,
    name: str,
) -> tuple[np.ndarray, np.ndarray, dict[str, list[float]]]:
    spreads, errors = [], []
    reference: dict[str, list[float]] = {}
    with Progress(name, len(pairs), unit="pair") as progress:
        for i in range(len(pairs)):
            source, target = (x[i].astype(np.float64) for x in (pairs.source, pairs.target))
            goal = target if seen is None else seen[i].astype(np.float64)
            goal = goal[np.random.default_rng([3, i]).permutation(len(goal))]
            found, spread = find_field(backbone, source, goal, device)
            if spread is None:
                raise DataError("This backbone has no marginals; calibrate it with refinement.")
            moved = source + found
            spreads.append(spread)
            errors.append(np.linalg.norm(moved - target, axis=1))
            values = {
                "initial": surface_distance(source, goal)["chamfer"],
                "final": surface_distance(moved, goal)["chamfer"],
                "reach": float(np.linalg.norm(found, axis=1).max()),
                "folding": folding(source, found),
                **((plausibility(prior, found, source) if prior else None) or {}),
            }
            for key, value in values.items():
                reference.setdefault(key, []).append(value)
            progress.update()
    return np.concatenate(spreads), np.concatenate(errors), reference


def _in_bins(spread: np.ndarray, error: np.ndarray, edges: np.ndarray) -> list[np.ndarray]:
    place = np.clip(np.searchsorted(edges, spread, side="right") - 1, 0, len(edges) - 2)
    return [error[place == number] for number in range(len(edges) - 1)]


def calibrate(
    model: Path,
    pairs_paths: list[Path],
    out: Path,
    *,
    prior: Path | None,
    device: torch.device,
    targets: list[Path] | None = None,
) -> None:
    """Fit on the validation split, check on the test split; write JSON and, beside it, a plot.

    ``targets`` are variants of all pairs of each file, such as resampled ones, to register to.

    Raises:
        DataError: a split has no pairs, or source and target share their points: refinement then
            matches them exactly, which says nothing of two scans.
    """
    from scipy.stats import spearmanr
    from sklearn.isotonic import IsotonicRegression

    backbone, _ = load_backbone(model)
    fitted = load_prior(prior) if prior else None
    measured = {}
    for split in ("val", "test"):
        pairs, seen = read_seen(pairs_paths, targets, split)
        if len(pairs) == 0:
            raise DataError(f"There are no {split} pairs to calibrate with.")
        measured[split] = _measure(backbone, fitted, pairs, seen, device, f"calibration, {split}")
        if np.median(measured[split][1]) < _EXACT:
            raise DataError(
                "Sources and targets hold the same points, which are matched exactly, so there are "
                "no errors to learn from; give targets of other points (`dine resample`, "
                "`--targets`)."
            )
    spread, error, reference = measured["val"]
    edges = np.unique(np.quantile(spread, np.linspace(0, 1, _BINS + 1)))
    if len(edges) < 3:
        raise DataError("All points moved alike; there is nothing to learn errors from.")
    groups = _in_bins(spread, error, edges)
    middle = [float(np.median(group)) for group in _in_bins(spread, spread, edges)]
    weight = [len(group) for group in groups]

    def monotone(values: list[float]) -> list[float]:
        return IsotonicRegression().fit_transform(middle, values, sample_weight=weight).tolist()

    found = Calibration(
        spread=middle,
        error=monotone([float(group.mean()) for group in groups]),
        likely=monotone([float(np.percentile(group, _LIKELY)) for group in groups]),
        reference={name: sorted(values) for name, values in reference.items()},
    )
    spread, error, _ = measured["test"]
    inside = float((error <= found.likely_error(spread)).mean())
    found.facts.update(
        model=file_digest(model),
        prior=file_digest(prior) if prior else None,
        convention=str(pairs.attributes.get("convention", "none")),
        points=pairs.source.shape[1],
        origin=str(pairs.attributes.get("origin", "unknown")),
        resampled=bool(targets),
        rounds=ROUNDS,
        validation_pairs=len(measured["val"][2]["initial"]),
        test_pairs=len(measured["test"][2]["initial"]),
        test_inside_likely=inside,
        test_rank_correlation=float(spearmanr(spread, error).statistic),
        test_mean_error=float(error.mean()),
        test_mean_expected=float(found.expected_error(spread).mean()),
    )
    found.save(out)
    _plot(found, spread, error, out.with_suffix(".png"))


def _plot(calibration: Calibration, spread: np.ndarray, error: np.ndarray, path: Path) -> None:
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    from dine.files import atomic_path

    edges = np.unique(np.quantile(spread, np.linspace(0, 1, _BINS + 1)))
    groups = _in_bins(spread, error, edges)
    middle = [np.median(group) for group in _in_bins(spread, spread, edges)]
    figure, axes = plt.subplots(figsize=(5.2, 4), layout="constrained")
    axes.plot(calibration.spread, calibration.error, color="#3f7fc4", label="expected error")
    axes.plot(
        calibration.spread, calibration.likely, "--", color="#3f7fc4", label="90 % of errors below"
    )
    axes.plot(middle, [g.mean() for g in groups], "o", color="#d08a3c", label="test pairs: mean")
    axes.plot(
        middle,
        [np.percentile(g, _LIKELY) for g in groups],
        "^",
        color="#d08a3c",
        label="test pairs: 90th percentile",
    )
    axes.set(
        xlabel="displacement, plus its distance from the network's (object radii)",
        ylabel="distance from the true place (object radii)",
    )
    axes.legend(frameon=False)
    inside = calibration.facts["test_inside_likely"]
    axes.set_title(f"{100 * inside:.0f} % of test errors within the 90 % bound", fontsize=10)
    with atomic_path(path) as temporary:
        figure.savefig(temporary, dpi=150, format="png")
    plt.close(figure)
