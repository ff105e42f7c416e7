"""A backbone: one affine map per pair, predicted from both clouds."""

import torch
from torch import Tensor, nn

from dine.data.batch import Batch
from dine.models.backbones import Backbone, Registration


class AffineNet(Backbone):
    """Displaces every point x by x·A + t; A and t come from features pooled over each cloud.

    Args:
        width: features per point.
    """

    def __init__(self, width: int = 32):
        super().__init__(width=width)  # stored with the weights, to build the module again
        self.features = nn.Sequential(nn.Linear(3, width), nn.ReLU(), nn.Linear(width, width))
        self.read_out = nn.Linear(2 * width, 12)
        nn.init.zeros_(self.read_out.weight)  # nothing moves at first
        nn.init.zeros_(self.read_out.bias)

    def pooled(self, cloud: Tensor, mask: Tensor | None) -> Tensor:
        """(B, N, 3) points to (B, width), whatever their order and padding."""
        features = self.features(cloud)
        if mask is not None:
            features = features.masked_fill(~mask.unsqueeze(-1), -torch.inf)
        return features.amax(dim=1)

    def forward(self, batch: Batch) -> Registration:
        both = [
            self.pooled(batch.source, batch.source_mask),
            self.pooled(batch.target, batch.target_mask),
        ]
        affine = self.read_out(torch.cat(both, dim=1)).view(-1, 4, 3)
        displacement = batch.source @ affine[:, :3] + affine[:, 3:]
        if batch.source_mask is not None:
            displacement = displacement.masked_fill(~batch.source_mask.unsqueeze(-1), 0)
        return Registration(displacement, None, None)  # no candidates, no belief
