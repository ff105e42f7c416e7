"""From raw files to a pairs file, and how well the index convention holds in it."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from dine.config import Pairs
from dine.data.obtain import obtained
from dine.data.pairs import make_pairs, read_pairs, write_pairs
from dine.data.sampling import neighbourhood_agreement


def prepare_pairs(raw: Path, settings: Pairs, *, seed: int, out: Path) -> None:
    """Make all pairs of a dataset and write them; broken pairs are reported and left out.

    Raises:
        DataError: no usable pair, or too few base objects to split.
    """
    inventory, origin = obtained(raw)
    pairs, _ = make_pairs(
        inventory,
        points=settings.points,
        convention=settings.convention,
        split=settings.split.model_dump(),
        seed=seed,
        origin=origin,
    )
    write_pairs(out, pairs)


def measure_agreement(path: Path, *, seed: int) -> dict[str, object]:
    """Neighbourhood agreement of index i across the distinct sources of a pairs file."""
    pairs = read_pairs(path)
    _, first = np.unique(pairs.object, return_index=True)
    found = neighbourhood_agreement(pairs.source[np.sort(first)], rng=np.random.default_rng(seed))
    return {"convention": str(pairs.attributes["convention"]), **found}
