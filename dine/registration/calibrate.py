"""Learning a calibration: fitted on validation pairs of known correspondence, and checked."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from itertools import chain, repeat
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from dine.data.pairs import PairSet, read_pairs, read_seen
from dine.data.prepare import files_of
from dine.errors import ConfigError, DataError
from dine.files import atomic_path, file_digest
from dine.geometry.frame import Frame
from dine.geometry.rigid import Alignment
from dine.geometry.surface import Surface
from dine.io.readers import read_surface
from dine.models.checkpoint import load_backbone
from dine.priors.base import load_prior
from dine.progress import Progress
from dine.refinement.refine import ROUNDS
from dine.registration.calibration import Calibration, field_values
from dine.registration.correspondence import correspond, one_way
from dine.registration.types import Model, Overlap, Pair, Settings

_BINS = 20
_LIKELY = 90
_INDICATOR = {
    False: "displacement, plus its distance from the network's (object radii)",
    True: "posterior standard deviation (object radii)",
}


class _Measured(NamedTuple):
    """Of all points (n,) of a split what tells their errors apart, and these; of its pairs the
    values that a calibration has references for."""

    spread: np.ndarray
    error: np.ndarray
    reference: dict[str, list[float]]


def calibrate(
    model: Path,
    pairs_paths: list[Path],
    out: Path,
    *,
    prior: Path | None,
    device: torch.device,
    targets: list[Path] | None = None,
    raws: list[Path] | None = None,
) -> None:
    """Fit on the validation split, check on the test split; write JSON and, beside it, a plot.

    ``targets`` are variants of all pairs of each file, such as resampled ones, to register to.
    ``raws`` are the raw datasets that they were made from (of several files of pairs, one for
    each): pairs are then registered on their meshes, as with ``surfaces`` of
    :func:`~dine.registration.register.register`.

    Raises:
        ConfigError: not one raw dataset for each of several files of pairs.
        DataError: a split has no pairs, pairs were not made from the raw datasets, or no targets
            are given: sources and targets then share their points, which refinement matches
            exactly, and which says nothing of two scans.
    """
    if not targets:
        raise DataError(
            "Sources and targets hold the same points, which are matched exactly, so there are "
            "no errors to learn from; give targets of other points (`dine resample`, `--targets`)."
        )
    backbone, facts = load_backbone(model)
    fitted = load_prior(prior) if prior else None
    loaded = Model(backbone, model, facts, fitted)
    measured = {}
    for split in ("val", "test"):
        pairs, seen = read_seen(pairs_paths, targets, split)
        if len(pairs) == 0:
            raise DataError(f"There are no {split} pairs to calibrate with.")
        meshes = None
        if raws:
            shared = _shared_out(raws, pairs_paths)
            meshes = chain(*(_meshes(some, path, split) for path, some in shared))
        name = f"calibration, {split}"
        measured[split] = _measure(loaded, pairs, seen, meshes, device, name)
    learned = _learned(measured["val"])
    learned.facts.update(
        model=file_digest(model),
        prior=file_digest(prior) if prior else None,
        convention=str(pairs.attributes.get("convention", "none")),
        points=pairs.source.shape[1],
        origin=str(pairs.attributes.get("origin", "unknown")),
        resampled=True,
        rounds=ROUNDS,
        surfaces=bool(raws),
        validation_pairs=len(measured["val"].reference["initial"]),
        test_pairs=len(measured["test"].reference["initial"]),
        **_checked(learned, measured["test"]),
    )
    learned.save(out)
    _plot(learned, measured["test"], out.with_suffix(".png"))


def _measure(
    model: Model,
    pairs: PairSet,
    seen: np.ndarray,
    meshes: Iterable[tuple[Surface, Surface]] | None,
    device: torch.device,
    name: str,
) -> _Measured:
    spreads, errors = [], []
    reference: dict[str, list[float]] = {}
    here = Alignment(np.eye(4), Frame(np.zeros(3), 1.0))
    settings = Settings(
        "off", ROUNDS, Overlap.AUTO, pairs.source.shape[1], 0, device, surfaces=True
    )
    with Progress(name, len(pairs), unit="pair") as progress:
        for i, surfaces in zip(range(len(pairs)), meshes or repeat(None), strict=False):
            start, truth, goal = (
                x[i].astype(np.float64) for x in (pairs.source, pairs.target, seen)
            )
            goal = goal[np.random.default_rng([3, i]).permutation(len(goal))]
            if surfaces is None:
                found = one_way(model.backbone, start, goal, settings)
            else:
                found = correspond(Pair(*surfaces, here, start, start, goal), model, settings)
            if found.indicator is None:
                raise DataError("This backbone has no marginals; calibrate it with refinement.")
            spreads.append(found.indicator)
            errors.append(np.linalg.norm(found.moved - truth, axis=1))
            for key, value in field_values(start, found.field, goal, model.prior).items():
                reference.setdefault(key, []).append(value)
            progress.update()
    return _Measured(np.concatenate(spreads), np.concatenate(errors), reference)


def _shared_out(raws: list[Path], pairs: list[Path]) -> list[tuple[Path, list[Path]]]:
    """Each file of pairs with its raw datasets: all for a single one, otherwise one for each."""
    if len(pairs) == 1:
        return [(pairs[0], raws)]
    if len(raws) != len(pairs):
        raise ConfigError(
            f"There are {len(raws)} raw datasets for {len(pairs)} files of pairs; expected one for "
            "each."
        )
    return [(path, [raw]) for path, raw in zip(pairs, raws, strict=True)]


def _meshes(raws: list[Path], path: Path, split: str) -> Iterator[tuple[Surface, Surface]]:
    """The meshes that the pairs of one file were drawn on, in their normalised frames."""
    pairs = read_pairs(path, split)
    for i, files in enumerate(files_of(raws, pairs, path)):
        frame = pairs.frame(i)
        source, target = read_surface(files.source), read_surface(files.target)
        yield tuple(replace(x, vertices=frame.normalise(x.vertices)) for x in (source, target))


def _learned(measured: _Measured) -> Calibration:
    """Mean errors and bounds in bins of equally many points, made to grow."""
    from sklearn.isotonic import IsotonicRegression

    edges = _edges(measured.spread)
    if len(edges) < 3:
        raise DataError("All points moved alike; there is nothing to learn errors from.")
    groups = _in_bins(measured.spread, measured.error, edges)
    middle = [
        float(np.median(group)) for group in _in_bins(measured.spread, measured.spread, edges)
    ]
    weight = [len(group) for group in groups]

    def monotone(values: list[float]) -> list[float]:
        return IsotonicRegression().fit_transform(middle, values, sample_weight=weight).tolist()

    return Calibration(
        spread=middle,
        error=monotone([float(group.mean()) for group in groups]),
        likely=monotone([float(np.percentile(group, _LIKELY)) for group in groups]),
        reference={name: sorted(values) for name, values in measured.reference.items()},
    )


def _checked(calibration: Calibration, measured: _Measured) -> dict[str, Any]:
    """How well it holds elsewhere."""
    from scipy.stats import spearmanr

    spread, error, _ = measured
    return {
        "test_inside_likely": float((error <= calibration.likely_error(spread)).mean()),
        "test_rank_correlation": float(spearmanr(spread, error).statistic),
        "test_mean_error": float(error.mean()),
        "test_mean_expected": float(calibration.expected_error(spread).mean()),
    }


def _edges(spread: np.ndarray) -> np.ndarray:
    return np.unique(np.quantile(spread, np.linspace(0, 1, _BINS + 1)))


def _in_bins(spread: np.ndarray, error: np.ndarray, edges: np.ndarray) -> list[np.ndarray]:
    place = np.clip(np.searchsorted(edges, spread, side="right") - 1, 0, len(edges) - 2)
    return [error[place == number] for number in range(len(edges) - 1)]


def _plot(calibration: Calibration, measured: _Measured, path: Path) -> None:
    from matplotlib.figure import Figure

    spread, error, _ = measured
    edges = _edges(spread)
    groups = _in_bins(spread, error, edges)
    middle = [np.median(group) for group in _in_bins(spread, spread, edges)]
    figure = Figure(figsize=(5.2, 4), layout="constrained")
    axes = figure.subplots()
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
        xlabel=_INDICATOR[calibration.facts["surfaces"]],
        ylabel="distance from the true place (object radii)",
    )
    axes.legend(frameon=False)
    inside = calibration.facts["test_inside_likely"]
    axes.set_title(f"{100 * inside:.0f} % of test errors within the 90 % bound", fontsize=10)
    with atomic_path(path) as temporary:
        figure.savefig(temporary, dpi=150, format="png")
