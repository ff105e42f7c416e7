"""Deformation priors, by name.

Full field: ``pca`` (the paper's), ``pca_residual`` (what leaves the span costs, too) and
``latent_flow`` (a flow in place of the Gaussian). Full field given its source:
``gaussian_process``, ``smoothness`` and ``pca_process`` (``pca`` and a process for what it misses).
Single vectors: ``flow``.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from dine.priors.base import PRIORS, Prior, load_prior

if TYPE_CHECKING:
    from dine.priors.flow import FlowPrior
    from dine.priors.gaussian_process import GaussianProcessPrior
    from dine.priors.latent_flow import LatentFlowPrior
    from dine.priors.pca import PCAPrior
    from dine.priors.pca_process import PCAProcessPrior
    from dine.priors.pca_residual import PCAResidualPrior
    from dine.priors.smoothness import SmoothnessPrior

__all__ = [
    "PRIORS",
    "FlowPrior",
    "GaussianProcessPrior",
    "LatentFlowPrior",
    "PCAPrior",
    "PCAProcessPrior",
    "PCAResidualPrior",
    "Prior",
    "SmoothnessPrior",
    "load_prior",
]


_MODULES = {
    "FlowPrior": "flow",
    "GaussianProcessPrior": "gaussian_process",
    "LatentFlowPrior": "latent_flow",
    "PCAPrior": "pca",
    "PCAProcessPrior": "pca_process",
    "PCAResidualPrior": "pca_residual",
    "SmoothnessPrior": "smoothness",
}


def __getattr__(name: str) -> Any:
    # A registration needs one of them, and some bring libraries along.
    if name in _MODULES:
        return getattr(importlib.import_module(f"dine.priors.{_MODULES[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
