"""How well a prior describes fields it has not seen, in numbers that compare priors."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from dine.priors.base import Prior, check_fields
from dine.priors.flow import FlowPrior
from dine.priors.gaussian_process import GaussianProcessPrior
from dine.priors.pca import PCAPrior
from dine.priors.pca_process import PCAProcessPrior
from dine.priors.pca_residual import PCAResidualPrior
from dine.priors.smoothness import SmoothnessPrior
from dine.priors.sources import check_sources

SAMPLES = 50
"""Fields drawn for the specificity."""


@torch.no_grad()
def diagnose(
    prior: Prior,
    held_out: np.ndarray,
    sources: np.ndarray,
    train: np.ndarray,
    *,
    seed: int,
    train_sources: np.ndarray | None = None,
) -> dict[str, Any]:
    """Measures of a fitted prior on fields that were not used for the fit.

    What is found, with None where the prior does not have it:

    - `nll`: mean of −log_prob over the held-out fields, of whatever the prior models.
    - `nll_per_coordinate`: the same per coordinate, for priors that are densities of the whole
      field. Only these compare between priors. `flow` counts as one, with independent points.
    - `nll_per_component`: for `pca`, which models latent coordinates only: per coordinate of these.
    - `generalisation`: mean distance per point between a held-out field and the prior's closest
      one. That is its projection to the principal components, or for priors with a Gaussian
      process the posterior mean after observing the field with the fitted noise.
    - `specificity`: mean over 50 samples of the mean distance per point to the nearest training
      field.
    - `in_span`: mean squared Mahalanobis distance per principal component; about 1 on fields like
      those of the fit.
    - `residual`: mean square outside the principal components, in standard deviations of each
      coordinate.

    Generalisation and specificity are those of statistical shape models (Davies, 2002; Styner et
    al., 2003), with fields in place of shapes. They pull in opposite directions: what allows
    every field generalises perfectly and is not specific at all.

    Args:
        prior: fitted, in float32.
        held_out: (K, N, 3) fields, normalised frame.
        sources: (K, N, 3) their sources.
        train: (K', N, 3) fields of the fit.
        seed: of the samples.
        train_sources: (K', N, 3) sources of the fit, on which a conditional prior's samples are
            drawn; without them, those of the held-out fields are taken instead.

    Raises:
        ConfigError: no sources.
        DataError: fewer than two fields on either side, or bad shapes.
    """
    held_out, train = check_fields(held_out), check_fields(train)
    sources = check_sources(sources, held_out, prior.registered_name)
    if train_sources is not None:
        train_sources = check_sources(train_sources, train, prior.registered_name)
    fields = torch.from_numpy(held_out).float()
    points = torch.from_numpy(sources).float()
    nll = -prior.log_prob(fields, points).mean().item()
    drawn_on = sources if train_sources is None else train_sources
    return {
        "nll": nll,
        **_per_unit(prior, nll, held_out[0].size),
        "generalisation": _generalisation(prior, fields, points),
        "specificity": _specificity(prior, train, drawn_on, seed),
        **_components(prior, fields),
    }


def _per_unit(prior: Prior, nll: float, coordinates: int) -> dict[str, float | None]:
    """The negative log-likelihood per coordinate of a field or per principal component."""
    found = {"nll_per_coordinate": None, "nll_per_component": None}
    whole = PCAResidualPrior | PCAProcessPrior | GaussianProcessPrior | SmoothnessPrior
    if isinstance(prior, FlowPrior):
        found["nll_per_coordinate"] = nll / 3
    elif isinstance(prior, whole):
        found["nll_per_coordinate"] = nll / coordinates
    elif isinstance(prior, PCAPrior):
        found["nll_per_component"] = nll / prior.shape["components"]
    return found


def _generalisation(prior: Prior, fields: Tensor, points: Tensor) -> float | None:
    if isinstance(prior, PCAProcessPrior | GaussianProcessPrior):
        closest = prior.smoothed(fields, points)
    elif isinstance(prior, PCAPrior):
        closest = prior.projected(fields)
    else:
        return None
    return _distance(closest, fields).mean().item()


def _components(prior: Prior, fields: Tensor) -> dict[str, float | None]:
    """How far fields lie inside the span of the principal components, and outside."""
    if not isinstance(prior, PCAPrior):
        return {"in_span": None, "residual": None}
    return {
        "in_span": prior.mahalanobis(fields).mean().item() / prior.shape["components"],
        "residual": prior.residual(fields).mean().item() / fields[0].numel(),
    }


def _distance(a: Tensor, b: Tensor) -> Tensor:
    """Mean distance per point of fields (..., N, 3)."""
    return (a - b).norm(dim=-1).mean(-1)


def _specificity(prior: Prior, train: np.ndarray, sources: np.ndarray, seed: int) -> float | None:
    generator = torch.Generator().manual_seed(seed)
    try:
        if prior.conditional:
            rows = np.random.default_rng(seed).integers(len(sources), size=SAMPLES)
            clouds = torch.from_numpy(sources[rows]).float()
            samples = [prior.sample(1, generator, cloud)[0] for cloud in clouds]
        else:
            samples = prior.sample(SAMPLES, generator)
    except NotImplementedError:  # a prior of one's own need not be able to draw
        return None
    known = torch.from_numpy(train).float()
    return float(np.mean([_distance(sample, known).min().item() for sample in samples]))
