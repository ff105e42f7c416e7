"""Per-vector normalising-flow prior: a density over single displacement vectors (the ablation)."""

from __future__ import annotations

from typing import Self

import numpy as np
import torch
from torch import Tensor

from dine.config import FlowArguments
from dine.extras import extras_needed
from dine.optimiser import AdamW
from dine.priors.base import LARGEST_DEPTH, PRIORS, Prior, Sample, check_sizes
from dine.priors.likelihood import Ascent, Unfinished, maximise_likelihood


@PRIORS.register("flow")
class FlowPrior(Prior):
    """RealNVP on ℝ³ (Dinh et al., 2017); points of a field count as independent draws.

    Penalty and log probability are means over the valid points, as in the paper: with N points the
    joint log density under independence is N times :meth:`log_prob`.
    """

    resumable = True

    def __init__(self, points: int, transforms: int, hidden: int):
        with extras_needed():
            import zuko  # slow to import, and other priors do not need it

        check_sizes("flow", points=points, hidden=hidden)
        check_sizes("flow", LARGEST_DEPTH, transforms=transforms)
        super().__init__(points=points, transforms=transforms, hidden=hidden)
        self.register_buffer("mean", torch.zeros(3))
        self.register_buffer("scale", torch.ones(3))
        self.flow = zuko.flows.RealNVP(
            features=3, transforms=transforms, hidden_features=(hidden, hidden)
        )

    @classmethod
    def _fit(
        cls, sample: Sample, given: FlowArguments, *, unfinished: Unfinished | None = None
    ) -> Self:
        """Maximum likelihood on the pooled vectors of the fields, whatever their sources.

        A tenth of the fields is held out; ``notes`` keeps both negative log-likelihoods.
        ``unfinished`` is where the fit's state is kept.
        """
        fields, seed = sample.fields, sample.seed
        order = np.random.default_rng(seed).permutation(len(fields))
        held = max(1, len(fields) // 10)
        pool = torch.from_numpy(fields[order[held:]].reshape(-1, 3)).float()
        held_out = torch.from_numpy(fields[order[:held]].reshape(-1, 3)).float()
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            prior = cls(fields.shape[1], given.transforms, given.hidden)
        prior.mean.copy_(pool.mean(0))
        prior.scale.copy_(pool.std(0).clamp_min(1e-6))

        def draw(generator: torch.Generator) -> Tensor:
            return pool[torch.randint(len(pool), (count,), generator=generator)]

        count = min(given.batch_size, len(pool))
        optimiser = AdamW(prior.flow.parameters(), lr=given.learning_rate)
        schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, given.steps)
        ascent = Ascent(prior.flow, prior._log_density, optimiser, schedule)
        maximise_likelihood(ascent, draw, steps=given.steps, seed=seed, unfinished=unfinished)
        prior.notes = {
            "samples": len(fields),
            "nll_train": -prior._log_density(pool[: 2**17]).mean().item(),
            "nll_held_out": -prior._log_density(held_out[: 2**17]).mean().item(),
        }
        return prior

    def _log_density(self, vectors: Tensor) -> Tensor:
        """log Q of (..., 3) vectors."""
        standard = (vectors - self.mean) / self.scale
        return self.flow().log_prob(standard) - self.scale.log().sum()

    def penalty(
        self, displacement: Tensor, mask: Tensor | None = None, source: Tensor | None = None
    ) -> Tensor:
        values = -self._log_density(displacement)
        if mask is None:
            return values.mean(1)
        return values.masked_fill(~mask, 0).sum(1) / mask.sum(1)

    def log_prob(self, displacement: Tensor, source: Tensor | None = None) -> Tensor:
        """Mean log density of the field's vectors."""
        return -self.penalty(displacement)

    def sample(
        self,
        count: int,
        generator: torch.Generator | None = None,
        source: Tensor | None = None,
    ) -> Tensor:
        points = self.shape["points"]
        base = torch.randn(count, points, 3, generator=generator, dtype=self.mean.dtype)
        with torch.no_grad():
            standard = self.flow().transform.inv(base.to(self.mean.device))
        return standard * self.scale + self.mean
