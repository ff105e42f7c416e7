"""What a fitted prior is like: measures on held-out fields, and a picture of its samples."""

from __future__ import annotations

from pathlib import Path

import torch

from dine.data.fields import read_fields
from dine.data.pairs import read_pairs
from dine.errors import DataError
from dine.files import write_json
from dine.priors.base import load_prior
from dine.priors.diagnostics import diagnose
from dine.reporting.figures import save_figure
from dine.reporting.views import prior_samples_figure

_SAMPLES = 4


def diagnose_prior(
    prior_path: Path,
    fields_path: Path,
    pairs_path: Path,
    out: Path,
    *,
    seed: int,
    facts: dict[str, str],
) -> None:
    """Write :func:`~dine.priors.diagnostics.diagnose` as JSON, and samples as a picture beside it.

    Held-out fields are the true displacements of the validation pairs.

    Raises:
        DataError: a file is missing or damaged, or there are no validation pairs.
    """
    prior = load_prior(prior_path)
    train = read_fields(fields_path)
    pairs = read_pairs(pairs_path, split="val")
    if len(pairs) == 0:
        raise DataError(f"{pairs_path} has no validation pairs.")
    found = diagnose(
        prior,
        pairs.displacement,
        pairs.source,
        train.displacement,
        seed=seed,
        train_sources=train.source,
    )
    source = torch.from_numpy(pairs.source[0])
    with torch.no_grad():
        samples = prior.sample(_SAMPLES, torch.Generator().manual_seed(seed), source=source)
    figure = prior_samples_figure(
        pairs.source[0],
        samples.numpy(),
        f"{facts.get('prior', '')}: fields drawn from the prior",
        str(pairs.attributes.get("origin", "unknown")),
    )
    save_figure(figure, out.with_suffix(""))
    write_json(out, {**facts, **found, "notes": prior.notes})
