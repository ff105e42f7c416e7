"""What Stage 1 and Stage 2 minimise: a data term plus λ times a prior's penalty."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor, nn

from dine.data.batch import Batch
from dine.models.backbones import Backbone
from dine.training.data_terms import DataTerm

if TYPE_CHECKING:  # Stage 1 has no prior, and is not made again when one changes
    from dine.priors.base import Prior


@dataclass(frozen=True)
class Objective:
    """data term + weight · prior penalty, averaged over the batch.

    Attributes:
        data_term: how well the moved source fits the target.
        prior: frozen prior, or None for the data term alone.
        weight: λ; with 0 the prior is not evaluated at all.
    """

    data_term: DataTerm
    prior: Prior | None = None
    weight: float = 0.0

    def __call__(
        self, batch: Batch, displacement: Tensor, truth: Tensor | None
    ) -> tuple[Tensor, Tensor, Tensor]:
        """The loss, and without gradient what it consists of: data term and penalty; scalars."""
        data = self.data_term(batch, displacement, truth).mean()
        if self.prior is None or self.weight == 0:
            return data, data.detach(), torch.zeros_like(data)
        penalty = self.prior.penalty(displacement, batch.source_mask, source=batch.source).mean()
        return data + self.weight * penalty, data.detach(), penalty.detach()


class Loss(nn.Module):
    """From a batch to an objective's values: one module, as data-parallel training needs it."""

    def __init__(self, backbone: Backbone, objective: Objective):
        super().__init__()
        self.backbone = backbone
        self.objective = objective

    def forward(self, batch: Batch, truth: Tensor | None) -> tuple[Tensor, Tensor, Tensor]:
        return self.objective(batch, self.backbone(batch).displacement, truth)
