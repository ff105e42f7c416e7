"""Raw meshes of a dataset, from whichever source the configuration names."""

from __future__ import annotations

import logging
import time
from pathlib import Path

import pandas as pd

from dine.config import Dataset
from dine.data.layout import Inventory, scan
from dine.data.raw import Deformations, Targets, deform_bases, synthesise
from dine.errors import DataError
from dine.files import atomic_path, digest, file_digest, read_json, write_json
from dine.progress import LOG_SECONDS
from dine.provenance import folder_signature
from dine.results import Data

log = logging.getLogger(__name__)

# How data came about, as tables and figures name it.
SYNTHETIC, BASES, PATH, DOI = "synthetic", "bases", "path", "doi"


def obtain(
    dataset: Dataset,
    folder: Path,
    *,
    seed: int,
    first_object: int = 0,
    deformations: Targets | None = None,
) -> None:
    """Make or find a dataset's raw files.

    Writes into ``folder``: ``raw.json`` (where the files are, how they came about and a digest),
    ``inventory.csv`` (pairs and objects per condition and level), ``left_out.csv`` (every file that
    is not used, and why), and, where files are made or downloaded, ``raw/`` with them.

    Args:
        dataset: source and recipe.
        folder: the dataset's results folder.
        seed: of generated objects and deformations.
        first_object: number of the first synthetic object, to keep datasets apart.
        deformations: of undeformed objects; by default those of the published recipe.

    Raises:
        ValueError: a recipe of another kind, without its deformations.
        DataError: nothing usable was found.
        DownloadError: the download failed.
    """
    source = dataset.source
    made = folder / "raw"
    if deformations is None:
        deformations = _published(dataset, seed)
    if source.kind == "synthetic":
        shape, objects = dataset.recipe.shape, dataset.recipe.objects
        synthesise(made, deformations, shape, objects, first_object)
        place, origin = made, SYNTHETIC
    elif source.kind == "path":
        place, origin = Path(source.folder).expanduser(), PATH
        inventory = scan(place)
        if not inventory.has_pairs:
            log.info("%s holds undeformed objects only; making deformed targets", place)
            deform_bases(made, deformations, inventory)
            place, origin = made, BASES
    else:
        # Imported here, since only this source needs the network.
        from dine.data.dataverse import download

        download(source.doi, made, source.server, source.version, progress=_Download())
        place, origin = made, DOI
    inventory = scan(place)
    if not inventory.has_pairs:
        raise DataError(
            f"{place} holds no Source_/Target_ pairs; expected the published layout "
            "(Deformation_Level/<level>/Source_… and Target_…), or a manifest (CSV)."
        )
    write_inventory(inventory, folder)
    # Other meshes give another file, so that what was made of the old ones is made again even where
    # the run was killed right after this.
    content = digest(source.model_dump()) if origin == DOI else _content(place, origin)
    write_json(Data(folder).raw, {"folder": str(place), "origin": origin, "content": content})


def _content(place: Path, origin: str) -> str:
    """What tells files that were found, or made, from others."""
    if origin == PATH:
        return folder_signature(place)
    record = place / "provenance.json"
    return file_digest(record) if record.is_file() else ""


def _published(dataset: Dataset, seed: int) -> Deformations:
    recipe = dataset.recipe
    if recipe.kind != "kernels":
        raise ValueError(f"the deformations of the recipe {recipe.kind!r} are missing")
    own = ("levels", "control_percents", "widths", "amplitude", "pairs_per_level")
    return Deformations(**recipe.model_dump(include={*own}), points=dataset.pairs.points, seed=seed)


class _Download:
    """Logs each file when it is complete, and a long one every ten seconds."""

    def __init__(self):
        self._shown = time.monotonic()

    def __call__(self, path: str, done: int, total: int | None) -> None:
        if done == total or time.monotonic() - self._shown >= LOG_SECONDS:
            self._shown = time.monotonic()
            size = "?" if total is None else f"{total / 1e6:.1f}"
            log.info("downloading %s: %.1f of %s MB", path, done / 1e6, size)


def write_inventory(inventory: Inventory, folder: Path) -> None:
    """Write what was found and what was left out as CSV."""
    files = Data(folder)
    with atomic_path(files.inventory) as temporary:
        inventory.table().to_csv(temporary, index=False, errors="backslashreplace")
    left_out = pd.DataFrame(
        [(str(path), reason) for path, reason in inventory.left_out], columns=["file", "reason"]
    )
    with atomic_path(files.left_out) as temporary:
        left_out.to_csv(temporary, index=False, errors="backslashreplace")
    log.info(
        "%d pairs found, %d files left out (listed in %s)",
        len(inventory.pairs),
        len(inventory.left_out),
        files.left_out,
    )


def obtained(raw: Path) -> tuple[Inventory, str]:
    """The files behind a ``raw.json`` and their origin.

    Raises:
        DataError: damaged, or the files are not those that it was written for.
    """
    facts = read_json(raw)
    keys = ("folder", "origin", "content")
    found = [facts.get(key) for key in keys] if isinstance(facts, dict) else [None]
    if not all(isinstance(value, str) and "\0" not in value for value in found):
        raise DataError(f"{raw} does not say where the files are; run the step `raw` again.")
    folder, origin, content = found
    inventory = scan(folder)
    # What was downloaded has no record of its own, and nothing else is looked for there.
    if origin != DOI and _content(Path(folder), origin) != content:
        raise DataError(
            f"{folder} holds other files than {raw} was written for; run the step `raw` again."
        )
    return inventory, origin
