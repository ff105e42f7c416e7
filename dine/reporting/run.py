"""Figures of a finished run, from the files in its results folder."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from dine.config import Config
from dine.data.pairs import read_pairs
from dine.files import read_json
from dine.priors.base import load_prior
from dine.priors.pca import PCAPrior
from dine.reporting import figures as draw
from dine.reporting import views
from dine.reporting.loading import load_metrics, origin_of
from dine.reporting.names import display_name
from dine.results import CLEAN, Results, figure_names, own_searches, pca_priors, runs, strengths

HISTORY_WINDOW = 20
"""Steps over which training curves are averaged, since a step sees few pairs."""
LAMBDA_TITLE = "Choice of λ"


class Run:
    """Reads a run's files and draws its figures by name."""

    def __init__(self, results: Path, config: Config):
        self.files = Results(results)
        self.config = config
        self.metrics = load_metrics(self.files.run(*run).metrics for run in runs(config))

    def origin(self, dataset: str) -> str:
        return origin_of(dataset, self.metrics)

    def _per_method(self, dataset: str, backbone: str, file: str) -> dict[str, Path]:
        return {
            method: getattr(self.files.run(dataset, backbone, method), file)
            for method in self.config.methods(backbone)
        }

    def qualitative(self, dataset: str, backbone: str) -> Figure:
        examples = views.load_examples(
            views.pick_examples(dataset, backbone, self.metrics),
            read_pairs(self.files.data(dataset).pairs, split="test"),
            self._per_method(dataset, backbone, "predictions"),
            self._per_method(dataset, backbone, "point_errors"),
        )
        return views.qualitative_figure(examples, _title(dataset, backbone), self.origin(dataset))

    def histogram(self, dataset: str, backbone: str) -> Figure:
        errors = {
            method: views.read_group(path, CLEAN, "squared_distance")[1]
            for method, path in self._per_method(dataset, backbone, "point_errors").items()
        }
        title = f"{_title(dataset, backbone)}: per-point error, all levels"
        return draw.histogram_figure(errors, title, self.origin(dataset))

    def training(self, dataset: str, backbone: str) -> Figure:
        histories = {}
        for method, path in self._per_method(dataset, backbone, "history").items():
            frame = pd.read_csv(path)
            noisy = ["loss", "data", "penalty", "grad_norm"]
            frame[noisy] = frame[noisy].rolling(HISTORY_WINDOW, min_periods=1).mean()
            if not frame["penalty"].any():
                frame["penalty"] = np.nan
            histories[method] = frame.drop(columns=["learning_rate", "seconds"])
        title = f"{_title(dataset, backbone)}: training (mean over {HISTORY_WINDOW} steps)"
        return draw.training_figure(histories, title, self.origin(dataset))

    def spectrum(self, dataset: str, backbone: str, name: str) -> Figure:
        notes = self._pca(dataset, backbone, name).notes
        title = f"{_title(dataset, backbone)}: PCA prior ({notes['samples']} fields)"
        variance = (np.array(notes[f"explained_variance{x}"]) for x in ("", "_ratio"))
        return draw.pca_spectrum_figure(*variance, title, self.origin(dataset))

    def modes(self, dataset: str, backbone: str, name: str) -> Figure:
        prior = self._pca(dataset, backbone, name)
        source = read_pairs(self.files.data(dataset).pairs, split="test").source[0]
        return views.pca_modes_figure(
            prior.mean.numpy().reshape(-1, 3),
            prior.modes(),
            np.array(prior.notes["explained_variance"]),
            source,
            f"{_title(dataset, backbone)}: first modes of the PCA prior",
            self.origin(dataset),
        )

    def _pca(self, dataset: str, backbone: str, name: str) -> PCAPrior:
        return load_prior(self.files.prior(dataset, backbone, name))

    def searches(self) -> dict[str, Path]:
        """The files of all searches of λ, by the figures drawn of them."""
        own = {f"lambda_{name}": self.files.search_of(name) for name in own_searches(self.config)}
        return {"lambda": self.files.search, **own}

    def search(self, path: Path) -> Figure:
        search = read_json(path)
        where = _title(search["dataset"], search["backbone"])
        return draw.search_figure([search], where, self.origin(search["dataset"]))

    def figures(self) -> dict[str, tuple[str, str, Callable[[], Figure]]]:
        """Section of the report, caption and drawing function of every figure, by file stem."""
        found: dict[str, tuple[str, str, Callable[[], Figure]]] = {}
        for dataset in self.config.datasets:
            for kind in (CLEAN, *strengths(self.config, dataset)):
                make = partial(draw.distance_figure, dataset, self.metrics, kind)
                caption = f"Mean Chamfer distance on {display_name(dataset)}."
                found[f"distance_{dataset}_{kind}"] = ("Tables", caption, make)
            for backbone in self.config.backbones_of(dataset):
                place = (dataset, backbone)
                kinds = [((name,), *about) for name, about in _OF_PLACES.items()]
                for prior in pca_priors(self.config, backbone):
                    kinds += [((name, prior), *about) for name, about in _OF_PRIORS.items()]
                for (name, *prior), section, text in kinds:
                    make = partial(getattr(self, name), *place, *prior)
                    stem = "_".join([name, *place, *prior])
                    found[stem] = (section, f"{_title(*place)}: {text}.", make)
        for name, path in self.searches().items():
            caption = f"Validation errors over λ, {display_name(read_json(path)['backbone'])}."
            found[name] = (LAMBDA_TITLE, caption, partial(self.search, path))
        return {name: found[name] for name in figure_names(self.config)}


_OF_PLACES = {
    "qualitative": (
        "Before and after",
        "the median Stage-1 case at the largest level, coloured by error",
    ),
    "histogram": (
        "Per-point errors",
        "distribution of per-point squared distances, clean targets",
    ),
    "training": ("Training", "training curves"),
}
"""Section and caption of the figures of a dataset with a backbone, by the method that draws."""
_OF_PRIORS = {
    "spectrum": ("The PCA prior", "variance explained by the components"),
    "modes": ("The PCA prior", "the first modes"),
}


def _title(dataset: str, backbone: str) -> str:
    return f"{display_name(dataset)}, {display_name(backbone)}"


def draw_figures(results: Path, config: Config, out: Path) -> None:
    """Draw every figure of a run as PNG and PDF into ``out``."""
    for name, (_, _, make) in Run(results, config).figures().items():
        draw.save_figure(make(), out / name)
