"""Fitting a prior, from files to a file."""

from __future__ import annotations

import logging
import time
from pathlib import Path
from typing import Any

import numpy as np

from dine.config import PriorConfig, check_arguments
from dine.data.fields import read_fields
from dine.errors import DataError
from dine.files import digest, file_digest
from dine.priors import PRIORS
from dine.priors.likelihood import Unfinished
from dine.provenance import code_digest
from dine.state import check_still_wanted

log = logging.getLogger(__name__)


def fit_prior(fields: list[Path], prior: PriorConfig, *, seed: int, out: Path) -> None:
    """Fit a prior to dumped fields, of one or more files, and write it, frozen.

    One that is fitted in many steps keeps its state in ``training/<name>/`` beside ``out``, goes on
    from there, and is not written where it was asked for with something else while it was fitted.
    """
    arguments = check_arguments(prior)
    began = time.monotonic()
    parts = [read_fields(path) for path in fields]
    if len({(part.source.shape[1], part.convention) for part in parts}) > 1:
        raise DataError(
            "The files of fields hold different numbers of points or orders of them; fit one at a "
            "time."
        )
    source = np.concatenate([part.source for part in parts])
    chosen = [part.true if prior.fields == "exact" else part.displacement for part in parts]
    displacement = np.concatenate(chosen)
    if prior.fields == "shuffled":
        order = np.tile(np.arange(displacement.shape[1]), (len(displacement), 1))
        order = np.random.default_rng([6, seed]).permuted(order, axis=1)
        displacement = np.take_along_axis(displacement, order[..., None], axis=1)
    cls = PRIORS.get(prior.kind)
    digests = [file_digest(path) for path in fields]
    resume: dict[str, Any] = {}
    if cls.resumable:
        identity = {
            "settings": digest(prior.model_dump()),
            "seed": str(seed),
            "inputs": digest(digests),
            "code": code_digest("fit-prior", prior.kind),
        }
        folder = out.parent / "training" / out.stem
        resume = {"unfinished": Unfinished(folder, identity, f"{out.stem} prior")}
    fitted = cls.fit(displacement, seed=seed, source=source, **arguments, **resume)
    # Where a prior is used on other points, these must be brought into its order.
    fitted.notes["convention"] = parts[0].convention if prior.fields != "shuffled" else "none"
    if resume:
        check_still_wanted(folder, identity, f"{out.stem} prior")
    fitted.save(out, arguments=arguments, fields=digests, fitted_to=prior.fields, seed=seed)
    log.info("fitted the %s prior in %.1f s", prior.kind, time.monotonic() - began)
