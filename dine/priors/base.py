"""What every deformation prior can do."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, Self

import numpy as np
import torch
from torch import Tensor, nn

from dine.errors import CheckpointError, ConfigError, DataError
from dine.models.checkpoint import load_tensors, rebuilt, save_tensors
from dine.priors.gaussian import LinearGaussian
from dine.registry import Registry

if TYPE_CHECKING:
    from dine.config import Section

# A file of one prior needs the module of that one.
PRIORS: Registry[Prior] = Registry(
    "prior",
    {
        "flow": "dine.priors.flow",
        "gaussian_process": "dine.priors.gaussian_process",
        "latent_flow": "dine.priors.latent_flow",
        "pca": "dine.priors.pca",
        "pca_process": "dine.priors.pca_process",
        "pca_residual": "dine.priors.pca_residual",
        "smoothness": "dine.priors.smoothness",
    },
)
PRIOR_FORMAT = "dine-prior"

LARGEST_SIZE = 1_000_000
"""Of points, components and so on: far more than any prior has."""

LARGEST_DEPTH = 1000
"""Of layers, likewise."""


class Sample(NamedTuple):
    """What a prior is fitted to.

    Attributes:
        fields: (K, N, 3) displacement fields, float64.
        source: (K, N, 3) the points that move; None if they are not known.
        seed: of whatever the fit draws.
    """

    fields: np.ndarray
    source: np.ndarray | None
    seed: int


class Prior(nn.Module):
    """A density over displacement fields (B, N, 3) in the normalised frame, frozen once fitted.

    A subclass is registered in :data:`PRIORS` (or named by import path), builds itself from
    ``shape`` (whatever its tensors' sizes depend on), and implements :meth:`fit`,
    :meth:`penalty`, :meth:`log_prob` and :meth:`sample`. Its buffers and parameters are what is
    saved. A built-in one implements :meth:`_fit` in place of :meth:`fit`; its arguments and their
    defaults are a section of the configuration (``dine.config.PRIOR_ARGUMENTS``).

    Some priors are conditioned on the source, p(D | X). They set ``conditional`` and raise a
    ``ConfigError`` where the source is left out; the others ignore it. Some are fitted in many
    steps. They set ``resumable``, and their :meth:`fit` takes ``unfinished``, which says where its
    state is kept (:func:`dine.priors.likelihood.maximise_likelihood`).

    Attributes:
        shape: constructor arguments, stored beside the tensors.
        notes: facts about the fit that a reader should see, such as a reduced rank.
    """

    registered_name: str
    conditional: bool = False
    resumable: bool = False

    def __init__(self, **shape: Any):
        super().__init__()
        self.shape = shape
        self.notes: dict[str, Any] = {}

    @classmethod
    def fit(
        cls,
        fields: np.ndarray,
        *,
        seed: int = 0,
        source: np.ndarray | None = None,
        **arguments: Any,
    ) -> Self:
        """Estimate the prior from (K, N, 3) displacement fields of (K, N, 3) sources.

        Args:
            fields: at least two.
            seed: of whatever the fit draws.
            source: the points that move; only conditional priors need them.
            arguments: keys of the prior's section of the configuration, defaults where left out;
                of a ``resumable`` prior ``unfinished``, too.

        Raises:
            ConfigError: an unknown argument or one out of range, or sources are missing.
            DataError: fewer fields than the prior needs, a bad shape, values that are not finite,
                or fields that leave nothing to be fitted.
            Interrupted: SIGTERM or SIGINT came, and the state is saved.
        """
        # Using one takes no settings, whose checks take a while to import.
        from dine.config import PRIOR_ARGUMENTS, validate_section
        from dine.priors.sources import check_sources

        more = {"unfinished": arguments.pop("unfinished", None)} if cls.resumable else {}
        where = f"arguments of the {cls.registered_name} prior"
        given = validate_section(PRIOR_ARGUMENTS[cls.registered_name], arguments, where)
        fields = check_fields(fields)
        if source is not None or cls.conditional:
            source = check_sources(source, fields, cls.registered_name)
        return cls._fit(Sample(fields, source, seed), given, **more).freeze()

    @classmethod
    def _fit(cls, sample: Sample, given: Section) -> Self:
        """The fit itself, with checked fields and complete arguments."""
        raise NotImplementedError

    def penalty(
        self, displacement: Tensor, mask: Tensor | None = None, source: Tensor | None = None
    ) -> Tensor:
        """The differentiable term that Stage 2 adds, (B, N, 3) to (B,).

        −log p up to the constants that the paper drops; ``mask`` is True at valid points,
        ``source`` (B, N, 3) the points that move.
        """
        raise NotImplementedError

    def log_prob(self, displacement: Tensor, source: Tensor | None = None) -> Tensor:
        """Log density of the modelled quantity, (B, N, 3) to (B,), constants included."""
        raise NotImplementedError

    def sample(
        self,
        count: int,
        generator: torch.Generator | None = None,
        source: Tensor | None = None,
    ) -> Tensor:
        """Fields drawn from the prior, (count, N, 3); ``source`` (N, 3) is the one that moves."""
        raise NotImplementedError

    def gaussian(self, source: np.ndarray) -> LinearGaussian:
        """This prior as a linear Gaussian model of the fields of one source (N, 3).

        Raises:
            ConfigError: this prior is no Gaussian.
        """
        raise ConfigError(
            f"The prior {self.registered_name!r} is not Gaussian, so the most probable field has "
            "no closed form; choose a Gaussian prior, or refine by gradient."
        )

    def freeze(self) -> Self:
        """Fix all tensors; gradients still reach the displacement."""
        return self.eval().requires_grad_(False)

    def save(self, path: str | Path, **facts: Any) -> None:
        """Write the prior atomically as safetensors."""
        facts = {
            "format": PRIOR_FORMAT,
            "prior": self.registered_name,
            "shape": self.shape,
            "notes": self.notes,
            **facts,
        }
        save_tensors(path, self.state_dict(), facts)


def load_prior(path: str | Path) -> Prior:
    """A frozen prior from its file.

    Raises:
        CheckpointError: missing, damaged, or of another kind.
    """
    tensors, facts = load_tensors(path, PRIOR_FORMAT)
    prior = rebuilt(PRIORS, Prior, facts, ("prior", "shape"), tensors, path)
    notes = facts.get("notes")
    if not isinstance(notes, dict):
        raise CheckpointError(f"{path}: its notes are {notes!r}; make it again.")
    prior.notes = notes
    return prior.freeze()


def check_sizes(prior: str, largest: int = LARGEST_SIZE, **sizes: Any) -> None:
    """Make sure that constructor arguments, which may come from a file, are sensible counts.

    Raises:
        ConfigError: naming the first that is no whole number from 1 to ``largest``.
    """
    for name, value in sizes.items():
        if type(value) is not int or not 1 <= value <= largest:
            raise ConfigError(
                f"The {prior} prior's `{name}` is {value!r}; expected a whole number from 1 to "
                f"{largest}."
            )


def check_fields(fields: np.ndarray) -> np.ndarray:
    """Fields as (K, N, 3) float64.

    Raises:
        DataError: another shape, fewer than two fields, or values that are not finite.
    """
    fields = np.asarray(fields, dtype=np.float64)
    if fields.ndim != 3 or fields.shape[2] != 3:
        raise DataError(f"Expected displacement fields of shape (K, N, 3), found {fields.shape}.")
    if len(fields) < 2:
        raise DataError(f"A prior needs at least 2 displacement fields, found {len(fields)}.")
    if not np.isfinite(fields).all():
        raise DataError("The displacement fields hold NaN or infinite values.")
    return fields
