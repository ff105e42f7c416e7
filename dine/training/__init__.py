"""Objective, training loop, and the steps of both stages.

What the data terms are registered by is imported here, so that every one is known by name.
"""

from dine.training.data_terms import DATA_TERMS, DataTerm
from dine.training.unrolled import RefinedTerm

__all__ = ["DATA_TERMS", "DataTerm", "RefinedTerm"]
