"""Deformation priors, by name: ``pca`` (full field) and ``flow`` (single vectors)."""

from dine.priors.base import PRIORS, Prior, load_prior
from dine.priors.flow import FlowPrior
from dine.priors.pca import PCAPrior

__all__ = ["PRIORS", "FlowPrior", "PCAPrior", "Prior", "load_prior"]
