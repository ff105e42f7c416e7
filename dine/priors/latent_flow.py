"""Full-field prior whose latent coordinates need not be Gaussian."""

from __future__ import annotations

import math
from typing import Self

import numpy as np
import torch
from torch import Tensor

from dine.config import LatentFlowArguments
from dine.errors import DataError
from dine.extras import extras_needed
from dine.priors.base import LARGEST_DEPTH, PRIORS, Prior, Sample, check_sizes
from dine.priors.gaussian import LinearGaussian
from dine.priors.likelihood import Ascent, Best, Unfinished, maximise_likelihood
from dine.priors.pca_residual import PCAResidualPrior
from dine.priors.sources import held_out_folds, source_labels

CHECK_EVERY = 10
"""Optimiser steps between two looks at the held-out fields."""


@PRIORS.register("latent_flow")
class LatentFlowPrior(PCAResidualPrior):
    """RealNVP (Dinh et al., 2017) on the whitened latent coordinates of the PCA prior.

    y = L⁻¹z with Σ_reg = LLᵀ; p(D̃) = q(y) |L|⁻¹ · N(r; 0, σ²I), where q is the flow and the
    residual r as in :class:`PCAResidualPrior`. The penalty is −2 log q(y) − n_c log 2π + ‖r‖²/σ²,
    so that it equals that prior's where the flow is the identity, from which the fit starts.

    Buffers: those of :class:`PCAResidualPrior`. Parameters: those of the flow.
    """

    resumable = True

    def __init__(self, points: int, components: int, transforms: int, hidden: int):
        with extras_needed():
            import zuko  # slow to import, and other priors do not need it

        check_sizes("latent_flow", hidden=hidden)
        check_sizes("latent_flow", LARGEST_DEPTH, transforms=transforms)
        super().__init__(points, components, transforms=transforms, hidden=hidden)
        self.flow = zuko.flows.RealNVP(
            features=components, transforms=transforms, hidden_features=(hidden, hidden)
        )
        # Couplings whose last layer is zero neither scale nor shift.
        for coupling in self.flow.transform.transforms:
            torch.nn.init.zeros_(coupling.hyper[-1].weight)
            torch.nn.init.zeros_(coupling.hyper[-1].bias)

    @classmethod
    def _fit(
        cls, sample: Sample, given: LatentFlowArguments, *, unfinished: Unfinished | None = None
    ) -> Self:
        """Maximum likelihood on nine tenths of the fields, at least three; the best held-out wins.

        With as many components as a hundred fields allow, a flow soon knows them by heart. So a
        tenth of the fields, which span and residual do not see either, decides when to stop: the
        state with their highest likelihood is kept, the Gaussian at the start included. Where the
        sources are given, all fields of a source are held out or none.

        ``notes`` has negative log-likelihoods of y per component: of the fields of the fit, of the
        held-out ones, and of these under the Gaussian. ``unfinished`` is where the state of the
        flow's fit is kept.
        """
        fields, source, seed = sample
        labels = source_labels(source, len(fields))
        held = held_out_folds(labels, 10, seed)[0]
        if np.count_nonzero(~held) < 3:
            raise DataError(
                "The latent_flow prior needs at least 3 displacement fields besides those held "
                f"out; found {np.count_nonzero(~held)} of {len(fields)}."
            )
        sizes = {"transforms": given.transforms, "hidden": given.hidden}
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            prior = cls._of_span(fields[~held], given, **sizes)
        prior._fit_residual(fields[~held], labels[~held], given.folds, seed)
        seen, unseen = (
            prior.whitened(prior.latent(torch.from_numpy(part).to(prior.mean)))
            for part in (fields[~held], fields[held])
        )
        best = Best(
            prior.flow, lambda: prior._negative_log_likelihood(unseen), CHECK_EVERY, given.patience
        )
        gaussian = best.value

        def draw(generator: torch.Generator) -> Tensor:
            return seen[torch.randperm(len(seen), generator=generator)[: given.batch_size]]

        optimiser = torch.optim.AdamW(
            prior.flow.parameters(), lr=given.learning_rate, weight_decay=given.weight_decay
        )
        ascent = Ascent(prior.flow, prior._log_density, optimiser, best=best)
        maximise_likelihood(ascent, draw, steps=given.steps, seed=seed, unfinished=unfinished)
        prior.notes |= {
            "held_out": int(np.count_nonzero(held)),
            "steps": best.step,
            "nll_train": prior._negative_log_likelihood(seen),
            "nll_held_out": best.value,
            "nll_held_out_gaussian": gaussian,
        }
        return prior

    def _log_density(self, whitened: Tensor) -> Tensor:
        """log q of (B, n_c) whitened coordinates."""
        return self.flow().log_prob(whitened)

    @torch.no_grad()
    def _negative_log_likelihood(self, whitened: Tensor) -> float:
        return -self._log_density(whitened).mean().item() / whitened.shape[1]

    def _span_term(self, latent: Tensor) -> Tensor:
        constant = self.shape["components"] * math.log(2 * math.pi)
        return -2 * self._log_density(self.whitened(latent)) - constant

    @torch.no_grad()
    def _draw_latent(self, noise: Tensor) -> Tensor:
        return super()._draw_latent(self.flow().transform.inv(noise))

    def gaussian(self, source: np.ndarray) -> LinearGaussian:
        """None: this prior is not Gaussian.

        Raises:
            ConfigError: always.
        """
        return Prior.gaussian(self, source)
