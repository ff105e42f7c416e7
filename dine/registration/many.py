"""Many registrations: a manifest in, one folder and one table out."""

from __future__ import annotations

import logging
import os
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import pandas as pd

from dine.data.layout import scan
from dine.data.manifest import read_manifest
from dine.errors import DataError, DineError
from dine.files import atomic_path, digest, file_digest, read_json, write_json
from dine.io.writers import written_suffix
from dine.progress import Progress
from dine.provenance import code_digest
from dine.registration.output import Outputs, save
from dine.registration.register import register
from dine.registration.types import Model, RegistrationResult

log = logging.getLogger(__name__)

_DONE = "done.json"


@dataclass(frozen=True)
class RegistrationJob:
    """One registration of many: a name for its files, and the two shapes."""

    name: str
    source: Path
    target: Path


def read_jobs(path: Path) -> list[RegistrationJob]:
    """The pairs of a manifest, or those found in a folder.

    A manifest is a CSV file with the columns ``source`` and ``target``, paths relative to it, and
    perhaps ``name``. A folder is read as the pairs step reads one (docs/guide/data-sources.md).

    Raises:
        DataError: missing, unreadable, without pairs, or names that are not unique.
    """
    if path.is_dir():
        inventory = scan(path)
        jobs = [
            RegistrationJob(f"{pair.level}_{pair.name}", pair.source, pair.target)
            for pair in inventory.pairs
            if pair.condition == "deformation"
        ]
    else:
        jobs = [
            RegistrationJob(pair.name, pair.source, pair.target) for pair in read_manifest(path)
        ]
    if not jobs:
        raise DataError(f"{path} names no pairs of a source and a target.")
    repeated = [name for name, count in Counter(job.name for job in jobs).items() if count > 1]
    if repeated:
        raise DataError(
            f"{path}: {len(repeated)} names are used by several pairs, such as {repeated[0]!r}; "
            "give every row a name of its own."
        )
    return jobs


def register_many(
    jobs: list[RegistrationJob],
    out: Path,
    model: Model,
    *,
    suffix: str = "",
    view: bool = False,
    settings: dict | None = None,
    load: Callable[[RegistrationJob], dict] | None = None,
) -> pd.DataFrame:
    """Register every pair into a folder of its own; what is done already is not done again.

    A pair that cannot be registered is reported and does not stop the rest.

    Args:
        jobs: from :func:`read_jobs`.
        out: folder of all results; ``summary.csv`` in it has one row a pair.
        model: from ``load_model``.
        suffix: format of the moved sources, such as ``.ply``; by default that of each source.
        view: write the pages to look at, too.
        settings: further arguments of ``register``.
        load: further arguments of ``register`` for one pair.

    Returns:
        The summary.
    """
    settings = settings or {}
    rows = []
    with Progress("registrations", len(jobs), unit="pair") as progress:
        for job in jobs:
            folder = out / job.name
            try:
                rows.append(
                    {"name": job.name, **_one(job, folder, model, suffix, view, settings, load)}
                )
            except DineError as error:
                log.warning("%s: %s", job.name, error)
                rows.append({"name": job.name, "state": "failed", "message": str(error)})
            progress.update()
    summary = pd.DataFrame(rows)
    with atomic_path(out / "summary.csv") as temporary:
        form = {"float_format": "%.6g", "errors": "backslashreplace"}
        summary.to_csv(temporary, index=False, **form)
    return summary


def _one(
    job: RegistrationJob,
    folder: Path,
    model: Model,
    suffix: str,
    view: bool,
    settings: dict,
    load: Callable[[RegistrationJob], dict] | None,
) -> dict:
    for path in (job.source, job.target):
        if not os.path.isfile(path):
            raise DataError(f"{path} does not exist.")
    identity = digest(
        {
            "source": file_digest(job.source),
            "target": file_digest(job.target),
            "weights": file_digest(model.weights),
            "prior": model.prior_path and file_digest(model.prior_path),
            "code": code_digest("register-many", *_classes(model)),
            "settings": {k: str(v) for k, v in settings.items()},
            "suffix": suffix,
            "view": view,
        }
    )
    outputs = Outputs(folder / f"moved{suffix or written_suffix(job.source, '.ply')}")
    mark = folder / _DONE
    if mark.is_file() and outputs.report.is_file():
        done = read_json(mark)
        if done.get("identity") == identity:
            return done["row"]
    outputs.check({}, view=view, overwrite=True)
    result = register(
        job.source, job.target, model=model, **settings, **(load(job) if load else {})
    )
    save(result, outputs, view=view, overwrite=True)
    row = _row(result)
    write_json(mark, {"identity": identity, "row": row})
    return row


def _classes(model: Model) -> list[str]:
    return [part.registered_name for part in (model.backbone, model.prior) if part is not None]


def _row(result: RegistrationResult) -> dict:
    report = result.report
    return {
        "state": "done",
        "message": " ".join(result.trust.reasons),
        "verdict": result.trust.verdict,
        "expected_error": result.trust.expected_error,
        "chamfer_before": report["before"]["chamfer"],
        "chamfer_after": report["after"]["chamfer"],
        "hd95_before": report["before"]["hd95"],
        "hd95_after": report["after"]["hd95"],
        "folding": report["folding"],
        "displacement_max": report["displacement"]["max"],
        "seconds": report["seconds"],
    }
