"""Figures of a finished run, from the files in its results folder."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from dine.config import Config
from dine.data.pairs import read_pairs
from dine.files import read_json
from dine.priors import PCAPrior, load_prior
from dine.reporting import figures as draw
from dine.reporting.loading import load_metrics, origin_of
from dine.reporting.names import display_name
from dine.results import CLEAN, Results, figure_names, own_searches, pca_priors, runs, strengths

HISTORY_WINDOW = 20
"""Steps over which training curves are averaged, since a step sees few pairs."""


class Run:
    """Reads a run's files and draws its figures by name."""

    def __init__(self, results: Path, config: Config):
        self.files = Results(results)
        self.config = config
        self.metrics = load_metrics(self.metric_files())

    def metric_files(self) -> list[Path]:
        return [self.files.run(*run, "metrics.csv") for run in runs(self.config)]

    def origin(self, dataset: str) -> str:
        return origin_of(dataset, self.metrics)

    def _per_method(self, dataset: str, backbone: str, file: str) -> dict[str, Path]:
        return {
            method: self.files.run(dataset, backbone, method, file)
            for method in self.config.methods(backbone)
        }

    def distance(self, dataset: str, condition: str) -> Figure:
        return draw.distance_figure(dataset, self.metrics, condition)

    def qualitative(self, dataset: str, backbone: str) -> Figure:
        pairs = read_pairs(self.files.dataset(dataset, "pairs.h5"), split="test")
        examples = draw.load_examples(
            draw.pick_examples(dataset, backbone, self.metrics),
            pairs,
            self._per_method(dataset, backbone, "predictions.h5"),
            self._per_method(dataset, backbone, "point_errors.h5"),
        )
        return draw.qualitative_figure(
            examples, self._title(dataset, backbone), self.origin(dataset)
        )

    def histogram(self, dataset: str, backbone: str) -> Figure:
        errors = {
            method: draw.read_group(path, CLEAN, "squared_distance")[1]
            for method, path in self._per_method(dataset, backbone, "point_errors.h5").items()
        }
        title = f"{self._title(dataset, backbone)}: per-point error, all levels"
        return draw.histogram_figure(errors, title, self.origin(dataset))

    def training(self, dataset: str, backbone: str) -> Figure:
        histories = {}
        for method, path in self._per_method(dataset, backbone, "history.csv").items():
            frame = pd.read_csv(path)
            noisy = ["loss", "data", "penalty", "grad_norm"]
            frame[noisy] = frame[noisy].rolling(HISTORY_WINDOW, min_periods=1).mean()
            if not frame["penalty"].any():
                frame["penalty"] = np.nan
            histories[method] = frame.drop(columns=["learning_rate", "seconds"])
        title = f"{self._title(dataset, backbone)}: training (mean over {HISTORY_WINDOW} steps)"
        return draw.training_figure(histories, title, self.origin(dataset))

    def spectrum(self, dataset: str, backbone: str, name: str) -> Figure:
        prior = self._pca(dataset, backbone, name)
        return draw.pca_spectrum_figure(
            np.array(prior.notes["explained_variance"]),
            np.array(prior.notes["explained_variance_ratio"]),
            f"{self._title(dataset, backbone)}: PCA prior ({prior.notes['samples']} fields)",
            self.origin(dataset),
        )

    def modes(self, dataset: str, backbone: str, name: str) -> Figure:
        prior = self._pca(dataset, backbone, name)
        source = read_pairs(self.files.dataset(dataset, "pairs.h5"), split="test").source[0]
        return draw.pca_modes_figure(
            prior.mean.numpy().reshape(-1, 3),
            prior.modes(),
            np.array(prior.notes["explained_variance"]),
            source,
            f"{self._title(dataset, backbone)}: first modes of the PCA prior",
            self.origin(dataset),
        )

    def searches(self) -> dict[str, Path]:
        """The files of all searches of λ, by the figures drawn of them."""
        own = {f"lambda_{name}": self.files.search_of(name) for name in own_searches(self.config)}
        return {"lambda": self.files.search, **own}

    def search(self, path: Path) -> Figure:
        search = read_json(path)
        where = self._title(search["dataset"], search["backbone"])
        return draw.search_figure([search], where, self.origin(search["dataset"]))

    def _pca(self, dataset: str, backbone: str, name: str) -> PCAPrior:
        return load_prior(self.files.prior(dataset, backbone, name))

    @staticmethod
    def _title(dataset: str, backbone: str) -> str:
        return f"{display_name(dataset)}, {display_name(backbone)}"

    def all_figures(self) -> dict[str, tuple[str, str, Callable[[], Figure]]]:
        """Section of the report, caption and drawing function of every figure, by file stem."""
        found: dict[str, tuple[str, str, Callable[[], Figure]]] = {}
        for dataset in self.config.datasets:
            shown = display_name(dataset)
            for kind in (CLEAN, *strengths(self.config, dataset)):
                found[f"distance_{dataset}_{kind}"] = (
                    f"Accuracy on {shown}",
                    f"Mean Chamfer distance on {shown}.",
                    lambda d=dataset, k=kind: self.distance(d, k),
                )
            for backbone in self.config.backbones_of(dataset):
                key = f"{dataset}_{backbone}"
                here = f"{shown}, {display_name(backbone)}"
                found[f"qualitative_{key}"] = (
                    "Before and after",
                    f"{here}: the median Stage-1 case at the largest level, coloured by error.",
                    lambda d=dataset, b=backbone: self.qualitative(d, b),
                )
                found[f"histogram_{key}"] = (
                    "Per-point errors",
                    f"{here}: distribution of per-point squared distances, clean targets.",
                    lambda d=dataset, b=backbone: self.histogram(d, b),
                )
                for prior in pca_priors(self.config, backbone):
                    found[f"spectrum_{key}_{prior}"] = (
                        "The PCA prior",
                        f"{here}: variance explained by the components.",
                        lambda d=dataset, b=backbone, p=prior: self.spectrum(d, b, p),
                    )
                    found[f"modes_{key}_{prior}"] = (
                        "The PCA prior",
                        f"{here}: the first modes.",
                        lambda d=dataset, b=backbone, p=prior: self.modes(d, b, p),
                    )
                found[f"training_{key}"] = (
                    "Training",
                    f"{here}: training curves.",
                    lambda d=dataset, b=backbone: self.training(d, b),
                )
        for name, path in self.searches().items():
            caption = f"Validation errors over λ, {display_name(read_json(path)['backbone'])}."
            found[name] = ("Choice of λ", caption, lambda p=path: self.search(p))
        return {name: found[name] for name in figure_names(self.config)}


def draw_figures(results: Path, config: Config, out: Path) -> None:
    """Draw every figure of a run as PNG and PDF into ``out``."""
    for name, (_, _, make) in Run(results, config).all_figures().items():
        draw.save_figure(make(), out / name)
