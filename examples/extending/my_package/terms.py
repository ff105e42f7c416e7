"""A data term: for targets that show only a part of the object."""

from torch import Tensor

from dine.data.batch import Batch
from dine.geometry.chamfer import masked_mean, nearest_squared
from dine.training.data_terms import DataTerm


class PartialTarget(DataTerm):
    """Mean squared distance from each target point to the moved source.

    Half of the Chamfer distance: source points without a counterpart cost nothing.
    """

    def __call__(self, batch: Batch, displacement: Tensor, truth: Tensor | None) -> Tensor:
        moved = batch.source + displacement
        _, from_target = nearest_squared(moved, batch.target, batch.source_mask, batch.target_mask)
        return masked_mean(from_target, batch.target_mask)
