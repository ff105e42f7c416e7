"""Raw folders in the layout of the published datasets, made from undeformed objects.

    <folder>/README.txt                                   what this is, in plain words
    <folder>/provenance.json                              parameters, objects, what was left out
    <folder>/Data/<object>.ply                            undeformed objects
    <folder>/Deformation_Level/<level>/Source_<object>_<a>_<b>.ply
    <folder>/Deformation_Level/<level>/Target_<object>_<a>_<b>.ply

<a> and <b> are two numbers that say which deformation it is, by the published recipe the percentage
of control points and the width of the Gaussian. Only the target is deformed: same vertices and
faces, same order, moved.
"""

from __future__ import annotations

import itertools
import json
import logging
import os
import re
import shutil
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any, ClassVar, Literal, Protocol

import numpy as np
from filelock import FileLock

from dine import __version__
from dine.config import most_pairs_per_level
from dine.data.deformation import check_recipe, rbf_displacement
from dine.data.layout import Inventory
from dine.data.synthetic import primitive, tissue_patch
from dine.errors import ConfigError, DataError, StorageError
from dine.files import atomic_path, digest, file_digest, read_json, write_json, write_text
from dine.geometry.surface import Surface
from dine.io.readers import read_surface
from dine.io.writers import write_surface
from dine.provenance import code_digest

logger = logging.getLogger(__name__)

SYNTHETIC = "synthetic"
"""``origin`` of folders whose undeformed objects are synthetic too."""

_MAKER = "dine.data.raw"
_GENERATORS = {"primitives": primitive, "tissue": tissue_patch}
_VAIN_DRAWS = 1000


class Targets(Protocol):
    """How every object is deformed: a dataclass whose fields decide on all of it."""

    seed: int
    explained: ClassVar[str]
    """For the folder's README: the recipe, and what <a> and <b> in file names are."""

    def targets(self, surface: Surface, name: str) -> Iterator[tuple[tuple[str, str], Surface]]:
        """((level, <object>_<a>_<b>), deformed surface) of all pairs of one object.

        Raises:
            DataError: it cannot be deformed.
        """


@dataclass(frozen=True)
class Deformations:
    """The published recipe.

    Every object gets ``pairs_per_level`` targets per level, each with its own (a, b): first those
    of ``control_percents`` x ``widths`` in random order, then numbers drawn evenly from the ranges
    that the two lists span. The random numbers of a pair follow from (seed, object, level, number
    of the pair) alone: adding objects, levels or pairs changes no other file.

    Attributes:
        levels: deformation levels, > 0.
        control_percents: percentages of control points, in (0, 100].
        widths: widths of the Gaussian in object radii, > 0.
        amplitude: see ``rbf_displacement``.
        points: points per cloud, which the percentages refer to.
        pairs_per_level: targets per object and level.
        seed: seed of the dataset.

    Raises:
        ValueError: a parameter outside its range, or repeated.
    """

    levels: Sequence[float]
    control_percents: Sequence[float]
    widths: Sequence[float]
    amplitude: float
    points: int
    pairs_per_level: int
    seed: int

    explained = """\
Recipe: round(a / 100 * points) control points, uniform on the surface, each with a normal random
displacement of standard deviation amplitude * level per coordinate, in object radii; spread with
exp(-(distance / b)^2), distances in object radii, and summed. a is the percentage of control
points, b the width of the Gaussian."""

    def __post_init__(self):
        for name in ("levels", "control_percents", "widths"):
            object.__setattr__(self, name, _distinct(name, getattr(self, name)))
        object.__setattr__(self, "amplitude", float(self.amplitude))
        for level, percent, width in itertools.product(
            self.levels, self.control_percents, self.widths
        ):
            check_recipe(
                level=level,
                control_percent=percent,
                width=width,
                amplitude=self.amplitude,
                points=self.points,
            )
        if min(self.levels) == 0:
            raise ValueError("levels must be above 0: a target at level 0 is its source.")
        most = most_pairs_per_level(self.control_percents, self.widths)
        if not 1 <= self.pairs_per_level <= most:
            raise ValueError(
                f"pairs_per_level must be 1 to {most:g}, the number of different deformations that "
                f"control_percents and widths give, not {self.pairs_per_level}."
            )

    def targets(self, surface: Surface, name: str) -> Iterator[tuple[tuple[str, str], Surface]]:
        """((level, <object>_<a>_<b>), deformed surface) of all pairs of one object."""
        for level in self.levels:
            for k, (percent, width) in enumerate(self.kernels(name, _text(level))):
                field = rbf_displacement(
                    surface,
                    level=level,
                    control_percent=percent,
                    width=width,
                    amplitude=self.amplitude,
                    points=self.points,
                    rng=_rng(self.seed, name, _text(level), k),
                )
                pair = f"{name}_{_text(percent)}_{_text(width)}"
                moved = Surface(surface.vertices + field, surface.faces, name=f"target {pair}")
                yield (_text(level), pair), moved

    def kernels(self, name: str, level: str) -> list[tuple[float, float]]:
        """(a, b) of all pairs of one object and level: no two would be written alike.

        Raises:
            ConfigError: percentages and widths too close together for so many pairs.
        """
        lists = (self.control_percents, self.widths)
        grid = list(itertools.product(*lists))
        rng = _rng(self.seed, name, level)
        kernels = [grid[choice] for choice in rng.permutation(len(grid))]
        written, vain = set(kernels), 0
        while len(kernels) < self.pairs_per_level:
            drawn = tuple(_rounded(rng.uniform(min(some), max(some))) for some in lists)
            vain = vain + 1 if drawn in written else 0
            if vain > _VAIN_DRAWS:
                raise ConfigError(
                    f"`pairs_per_level` is {self.pairs_per_level}, but `control_percents` and "
                    f"`widths` lie so close together that only {len(kernels)} different "
                    "deformations were found; widen one of the two."
                )
            if not vain:
                written.add(drawn)
                kernels.append(drawn)
        return kernels[: self.pairs_per_level]


def write_dataset(
    folder: str | os.PathLike,
    sources: Sequence[tuple[str, Callable[[], Surface]]],
    deformations: Targets,
    origin: str,
    identity: Any,
) -> None:
    """Deform every object at every level and write the folder described at the top.

    The folder appears under its name only when it is complete. One that is there already is kept
    as it is if it was made from equal input, and otherwise replaced once the new one is complete.

    Args:
        folder: where to write.
        sources: the name of each object and what makes or reads its undeformed surface, in any
            unit. Characters in a name that are unsafe in file names are replaced by '-'.
        deformations: of every object.
        origin: ``SYNTHETIC``, or the path that real base objects come from.
        identity: stands for the content of all sources, so that it need not be made to find out
            whether the folder is there already.

    Raises:
        ConfigError: percentages and widths too close together for so many pairs.
        DataError: no object is usable (a single unusable one is left out, with a warning and its
            reason in provenance.json), or ``folder`` holds something that DINE did not make.
        StorageError: the folder cannot be written.
    """
    key = _key(deformations, origin, identity)
    folder = Path(folder).resolve()
    part = folder.with_name(f".{folder.name}.part")
    old = folder.with_name(f".{folder.name}.old")
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        with FileLock(folder.with_name(f".{folder.name}.lock")):
            if _is_made(folder, key):
                logger.info("%s is there already, made from equal input: kept.", folder)
                return
            # Left behind by a run that was killed.
            _remove(part)
            _remove(old)
            try:
                _fill(part, sources, deformations, key)
                if folder.exists():
                    os.replace(folder, old)
                os.replace(part, folder)
            finally:
                _remove(part)
            _remove(old)
    except OSError as error:
        raise StorageError(
            f"Could not write {folder}: {error.strerror or error}; free space or choose another "
            "folder, then run the same command again."
        ) from error


def _key(deformations: Targets, origin: str, identity: Any) -> dict[str, Any]:
    """What a folder was made from."""
    return {
        "made_by": _MAKER,
        "dine_version": __version__,
        "code": code_digest("raw"),
        "origin": origin,
        "parameters": asdict(deformations),
        "recipe": deformations.explained,
        "bases": identity,
    }


def synthesise(
    folder: str | os.PathLike,
    deformations: Targets,
    kind: Literal["primitives", "tissue"],
    objects: int,
    first: int = 0,
) -> None:
    """Write a fully synthetic dataset: ``objects`` objects, numbered from ``first``.

    Args:
        folder: where to write.
        deformations: of every object.
        kind: "primitives" (like SynBench) or "tissue" (like DeformedTissue).
        objects: number of objects, >= 1.
        first: number of the first one; object i is the same in every dataset of equal seed.

    Raises:
        As ``write_dataset``; ValueError for another kind, or numbers out of range.
    """
    if kind not in _GENERATORS:
        raise ValueError(f"kind must be one of {', '.join(_GENERATORS)}, not {kind!r}.")
    if objects < 1 or first < 0:
        raise ValueError(f"objects must be at least 1 and first 0, not {objects} and {first}.")
    generate = _GENERATORS[kind]
    numbers = range(first, first + objects)
    sources = [(f"{i:03d}", partial(generate, i, deformations.seed)) for i in numbers]
    identity = {"kind": kind, "objects": objects, "first": first}
    write_dataset(folder, sources, deformations, SYNTHETIC, identity)


def deform_bases(folder: str | os.PathLike, deformations: Targets, inventory: Inventory) -> None:
    """Write a dataset of synthetic deformations of a user's own undeformed meshes or clouds.

    Args:
        folder: where to write.
        deformations: of every object.
        inventory: what ``layout.scan`` found; its ``bases`` are deformed. They may differ in units,
            be open, in several components or hold duplicate vertices.

    Raises:
        As ``write_dataset``.
    """
    sources = [(name, partial(read_surface, path)) for name, path in inventory.bases.items()]
    identity = {name: _file_identity(path) for name, path in inventory.bases.items()}
    write_dataset(folder, sources, deformations, str(inventory.folder.resolve()), identity)


def _file_identity(path: Path) -> list[str]:
    """Digests of the file and, for a SimTool ``.xyz``, of the file that holds its faces."""
    parts = (path, path.with_suffix(".triangle"))
    return [file_digest(part) for part in parts if os.access(part, os.R_OK) and part.is_file()]


def _distinct(name: str, values: Sequence[float]) -> list[float]:
    """The values as floats, refused if empty or if two would give the same file name."""
    values = [float(value) for value in values]
    if not values or len({_text(value) for value in values}) < len(values):
        raise ValueError(f"{name} must hold at least one value and none twice, not {values}.")
    return values


def _text(number: float) -> str:
    return format(number, "g")


def _is_made(folder: Path, key: dict[str, Any]) -> bool:
    """Whether the folder is complete and made from equal input; refuses what DINE did not make."""
    if not folder.exists():
        return False
    if folder.is_dir() and not any(folder.iterdir()):
        return False
    provenance = folder / "provenance.json"
    stored = read_json(provenance) if provenance.is_file() else {}
    if not isinstance(stored, dict) or stored.get("made_by") != _MAKER:
        raise DataError(
            f"{folder} exists and holds something that was not made here; choose another folder, "
            "or move it away."
        )
    return all(stored.get(name) == value for name, value in key.items())


def _remove(folder: Path) -> None:
    if folder.exists():
        shutil.rmtree(folder)


def _fill(
    folder: Path,
    sources: Sequence[tuple[str, Callable[[], Surface]]],
    deformations: Targets,
    key: dict[str, Any],
) -> None:
    """Write everything; provenance.json, by which a folder counts as made, comes last."""
    written: dict[str, str] = {}
    left_out: dict[str, str] = {}
    for name, load in sources:
        safe = _safe(name)
        try:
            if safe in written:
                raise DataError(
                    f"its files would have the names of those of {written[safe]}; rename one."
                )
            surface = load()
            targets = dict(deformations.targets(surface, safe))
        except DataError as error:
            left_out[name] = str(error)
            logger.warning("%s is left out: %s", name, error)
            continue
        written[safe] = name
        base = folder / "Data" / f"{safe}.ply"
        write_surface(base, surface)
        for (level, pair), target in targets.items():
            below = folder / "Deformation_Level" / level
            with atomic_path(below / f"Source_{pair}.ply") as path:
                shutil.copyfile(base, path)
            write_surface(below / f"Target_{pair}.ply", target)
    if not written:
        first = list(left_out.items())[:3]
        reasons = "; ".join(f"{name}: {reason.rstrip('.')}" for name, reason in first)
        raise DataError(f"No object of {key['origin']} can be used ({reasons or 'there is none'}).")
    provenance = {**key, "objects": written, "left_out": left_out}
    write_text(folder / "README.txt", _readme(provenance))
    write_json(folder / "provenance.json", provenance)


def _safe(name: str) -> str:
    """The name with only letters, digits, '_', '-' and '.' (not in front, which would hide it)."""
    return re.sub(r"[^A-Za-z0-9_.-]+", "-", name).lstrip(".") or "-"


def _rounded(number: float) -> float:
    """As file names give it, so that a name says exactly what was done."""
    return float(f"{number:.4g}")


def _rng(*key: int | str) -> np.random.Generator:
    return np.random.default_rng(int(digest(list(key)), 16))


def _readme(provenance: dict[str, Any]) -> str:
    if provenance["origin"] == SYNTHETIC:
        head = (
            "SYNTHETIC DATA. The objects and their deformations are computer-generated. They\n"
            "stand in for a published dataset, follow the layout and the deformation recipe that\n"
            "it describes, and hold none of its data. Results on them are no results on it."
        )
    else:
        head = (
            "REAL BASE OBJECTS, SYNTHETIC DEFORMATIONS. The undeformed objects come from\n"
            f"{provenance['origin']}\n"
            "Their deformations are computer-generated, not observed."
        )
    parameters = provenance["parameters"]
    lines = "\n".join(f"  {name}: {json.dumps(value)}" for name, value in parameters.items())
    return f"""{head}

{provenance["recipe"]}

{lines}

Files: Data/<object>.ply holds the undeformed objects, Deformation_Level/<level>/ the pairs
Source_<object>_<a>_<b>.ply and Target_<object>_<a>_<b>.ply. Only the target is deformed: same
vertices, same order, moved.

{len(provenance["objects"])} objects, {len(provenance["left_out"])} left out (reasons in \
provenance.json). Made by DINE {provenance["dine_version"]}.
"""
