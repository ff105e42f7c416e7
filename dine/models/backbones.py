"""The registration backbones: from a batch of pairs to displacement fields."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from torch import Tensor, nn

from dine.data.batch import Batch
from dine.errors import ConfigError
from dine.models.belief_propagation import (
    Candidates,
    marginal_variance,
    propagate,
    read_out,
    select_candidates,
)
from dine.models.features import FeatureNetwork
from dine.registry import Registry

BACKBONES: Registry[Backbone] = Registry("backbone")


@dataclass(frozen=True)
class Registration:
    """What a backbone returns for a batch.

    Attributes:
        displacement: (B, N, 3) in the normalised frame, zero at padded points.
        candidates: the candidate displacements that belief propagation chose among; None, as is
            the belief, where a backbone works otherwise.
        belief: (B, N, K) cost of every candidate; softmax(−temperature·belief) are the weights.
    """

    displacement: Tensor
    candidates: Candidates | None
    belief: Tensor | None


class Backbone(nn.Module):
    """Base of all backbones. ``arguments`` are stored with the weights and rebuild the module.

    Attributes:
        precision: of the feature network's large products, ``float32`` or ``bf16``; no property of
            the weights, so it can be set at any time.
    """

    registered_name: str
    precision: str = "float32"

    def __init__(self, **arguments: Any):
        super().__init__()
        self.arguments = arguments

    def forward(self, batch: Batch) -> Registration:
        raise NotImplementedError


def marginal_deviation(backbone: Backbone, found: Registration) -> Tensor | None:
    """Standard deviation (B, N) of each point's marginal, in the units of the displacement.

    None where the backbone has no marginals.
    """
    if found.belief is None or found.candidates is None:
        return None
    temperature = backbone.arguments.get("temperature", 50.0)
    variance = marginal_variance(found.candidates, found.belief, found.displacement, temperature)
    return variance.clamp_min(0).sqrt()


class BeliefPropagationBackbone(Backbone):
    """Point features, candidates nearest in feature space, sLBP, soft-argmin read-out.

    Args:
        candidates: target points that each source point may move to.
        source_neighbours: k of the source's feature graph.
        target_neighbours: k of the target's feature graph.
        smoothness: weight of squared displacement differences between neighbours.
        temperature: sharpness of the read-out.
        initialisation: random weights as ``geometric`` (see ``FeatureNetwork.start_geometric``) or
            ``default`` (PyTorch's own); without effect on weights that are loaded.
    """

    TRANSFORMER: bool

    def __init__(
        self,
        candidates: int = 128,
        source_neighbours: int = 10,
        target_neighbours: int = 30,
        smoothness: float = 10.0,
        temperature: float = 50.0,
        initialisation: str = "geometric",
    ):
        if initialisation not in ("geometric", "default"):
            raise ConfigError(
                f"The backbone's `initialisation` is {initialisation!r}; expected geometric or "
                "default."
            )
        counts = {
            "candidates": candidates,
            "source_neighbours": source_neighbours,
            "target_neighbours": target_neighbours,
        }
        for name, value in counts.items():
            if type(value) is not int or value < 1:
                raise ConfigError(
                    f"The backbone's `{name}` is {value!r}; expected a whole number from 1 on."
                )
        for name, value in {"smoothness": smoothness, "temperature": temperature}.items():
            if type(value) not in (int, float) or not 0 <= value < math.inf:
                raise ConfigError(
                    f"The backbone's `{name}` is {value!r}; expected a number from 0 on."
                )
        super().__init__(
            candidates=candidates,
            source_neighbours=source_neighbours,
            target_neighbours=target_neighbours,
            smoothness=smoothness,
            temperature=temperature,
            initialisation=initialisation,
        )
        network = FeatureNetwork(source_neighbours, target_neighbours, self.TRANSFORMER)
        if initialisation == "geometric":
            network.start_geometric()
        # The published state dicts have the feature network's entries at the top level.
        for name, module in network.named_children():
            self.add_module(name, module)
        object.__setattr__(self, "_network", network)

    def features(self, batch: Batch) -> tuple[Tensor, Tensor]:
        """(B, N, 64) source and (B, M, 64) target features."""
        return self._network(
            batch.source,
            batch.target,
            batch.source_mask,
            batch.target_mask,
            reduced=self.precision == "bf16",
        )

    def forward(self, batch: Batch) -> Registration:
        source_features, target_features = self.features(batch)
        candidates = select_candidates(
            batch.source,
            batch.target,
            source_features,
            target_features,
            self.arguments["candidates"],
            batch.target_mask,
        )
        belief = propagate(candidates, batch.graph, smoothness=self.arguments["smoothness"])
        displacement = read_out(candidates, belief, self.arguments["temperature"])
        if batch.source_mask is not None:
            displacement = displacement.masked_fill(~batch.source_mask.unsqueeze(-1), 0)
        return Registration(displacement, candidates, belief)


@BACKBONES.register("robust_defreg")
class RobustDefReg(BeliefPropagationBackbone):
    """Robust-DefReg (Monji-Azad et al., 2024): graph features and sLBP."""

    TRANSFORMER = False


@BACKBONES.register("deftransnet")
class DefTransNet(BeliefPropagationBackbone):
    """DefTransNet (Monji-Azad et al., 2025): the same with a transformer between the clouds."""

    TRANSFORMER = True
