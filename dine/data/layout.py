"""Finding out what a folder holds: undeformed objects, pairs by condition and level, the split.

Only names are looked at, so a hundred thousand files take a few seconds.
"""

from __future__ import annotations

import csv
import functools
import itertools
import os
import re
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from dine.data.manifest import read_manifest
from dine.data.names import pair_id
from dine.errors import DataError
from dine.files import read_json
from dine.geometry.surface import Surface
from dine.io.readers import READABLE_SUFFIXES

CONDITIONS = ("deformation", "noise", "outliers", "incompleteness")


@dataclass(frozen=True)
class PairFiles:
    """The files of one source and its deformed target.

    Attributes:
        object: key of the undeformed object in ``Inventory.bases``, or the first part of ``name``.
        name: file stem without its first word, such as ``12_5_0.3``.
        condition: one of ``CONDITIONS``.
        level: deformation level, or None where the path does not say it.
        corruption: noise level, or percentage of outliers or of missing points; None for
            ``deformation``.
        control_percent: percentage of control points, from the name.
        width: width of the Gaussian radial basis function, from the name.
        source: file of the undeformed surface.
        target: file of the deformed surface.
        outliers: file with the coordinates of the outliers, where there is one.
    """

    object: str
    name: str
    condition: str
    level: float | None
    corruption: float | None
    control_percent: float | None
    width: float | None
    source: Path
    target: Path
    outliers: Path | None = None

    @property
    def id(self) -> str:
        """The name with its level, ``<level>/<name>``: names repeat from level to level."""
        return pair_id(self.level, self.name)


@dataclass
class Inventory:
    """What ``scan`` found.

    Attributes:
        folder: the folder that was scanned.
        bases: undeformed objects by key: the stem where that is unique, otherwise the path below
            ``folder`` without suffix and with ``__`` for ``/``.
        pairs: sorted by condition, corruption, level, object and name.
        left_out: every file or folder that is not used, with the reason, sorted by path.
        split: train, val or test by object key, pair name or ``PairFiles.id``; None without a split
            file.
        split_file: where ``split`` was read (the first file, where there is one per part).
    """

    folder: Path
    bases: dict[str, Path] = field(default_factory=dict)
    pairs: list[PairFiles] = field(default_factory=list)
    left_out: list[tuple[Path, str]] = field(default_factory=list)
    split: dict[str, str] | None = None
    split_file: Path | None = None

    @property
    def clean(self) -> list[PairFiles]:
        """The pairs whose targets are not corrupted."""
        return [pair for pair in self.pairs if pair.condition == "deformation"]

    @property
    def has_pairs(self) -> bool:
        """Whether there are ready-made pairs; otherwise there are only undeformed objects."""
        return bool(self.pairs)

    def table(self) -> pd.DataFrame:
        """Numbers of pairs and objects by condition, corruption and level, one row each."""
        keys = ["condition", "corruption", "level"]
        rows = pd.DataFrame(
            [(p.condition, p.corruption, p.level, p.object) for p in self.pairs],
            columns=[*keys, "object"],
        ).astype({"corruption": float, "level": float})
        groups = rows.groupby(keys, dropna=False, sort=False)["object"]
        return groups.agg(pairs="size", objects="nunique").reset_index()


def scan(folder: str | os.PathLike) -> Inventory:
    """List the undeformed objects, the pairs and the split below a folder.

    Files named ``Source_<name>`` and ``Target_<name>`` are a pair when the folders around them
    say the same condition and level; a corrupted target without a source of its own takes the
    source of the same name and level from the deformation folder. Files in a ``Data`` folder are
    undeformed objects. Without any ``Source_`` or ``Target_`` file, every readable file is one.

    The condition is read from folder names such as ``Deformation_Level``, ``Noisy_Data``,
    ``Outlier_Data`` and ``Incompleteness_Data``; pairs outside of all of them count as
    ``deformation``. The level is read from numeric names (``0.3``, ``Level_0.3``, ``5%``,
    ``noise0.01``) of the folders inside:

    * A name that says what it counts (``deformation_0.3``, ``noise0.01``, ``5%``) is that.
    * Otherwise the number nearest to a noise, outlier or incompleteness folder is the amount of
      corruption and the next one the deformation level. The two change places for a whole
      condition when every outer number, and not every inner one, is a level of the deformation
      folder.
    * A single number is the amount of corruption, except under incompleteness when all such
      numbers are levels of the deformation folder.

    Names that begin with a dot are skipped. Links to folders are followed, each folder once.

    A manifest (:func:`dine.data.manifest.read_manifest`) is a list of pairs without such names.

    Args:
        folder: the dataset, or any folder below it such as ``Deformation_Level/0.3``; or the CSV
            file of a manifest.

    Raises:
        DataError: the folder is missing or holds nothing usable, or its split file or the manifest
            is malformed.
    """
    folder = Path(folder)
    if folder.suffix.lower() == ".csv" and folder.is_file():
        return _listed(folder)
    if not os.path.isdir(folder):  # also where the name cannot be that of a folder
        raise DataError(
            f"{folder} is not a folder; expected a dataset with Source_ and Target_ files, a "
            "folder of meshes, or the CSV file of a list of pairs."
        )
    inventory = Inventory(folder)
    files, split_files = [], []
    for path in _walk(folder, inventory.left_out):
        (split_files if _split_part(path, folder) else files).append(path)
    by_role = _sort_by_role(files, inventory.left_out)
    paired = bool(by_role["source"] or by_role["target"])
    inventory.bases = _bases(folder, by_role.pop("base"), paired, inventory.left_out)
    inventory.pairs = _pairs(by_role, inventory)
    if not inventory.bases and not inventory.pairs:
        reasons = Counter(reason for _, reason in inventory.left_out).most_common(3)
        found = "; ".join(f"{count} x {reason}" for reason, count in reasons) or "it is empty"
        raise DataError(
            f"{folder} holds nothing usable ({found}); expected Source_<name> and Target_<name> "
            f"files, or meshes, as {' '.join(READABLE_SUFFIXES)}."
        )
    _attach_split(inventory, split_files)
    inventory.left_out.sort()
    return inventory


def _listed(manifest: Path) -> Inventory:
    """What a manifest lists; a file that is not there is an error, since it was asked for."""
    pairs = read_manifest(manifest)
    if not pairs:
        raise DataError(f"{manifest} lists no pairs.")
    for path in (path for pair in pairs for path in (pair.source, pair.target)):
        if not path.is_file():
            raise DataError(f"{manifest} lists {path}, which is not there.")
    found = [
        PairFiles(
            *(pair.object, pair.name, "deformation", pair.level, None, None, None),
            *(pair.source, pair.target),
        )
        for pair in pairs
    ]
    return Inventory(manifest.parent, pairs=found)


def check_pair(source: Surface, target: Surface, name: str) -> None:
    """Make sure that vertex i of the source is vertex i of the target, as far as can be told.

    Faces are compared only where both surfaces have them.

    Raises:
        DataError: the numbers of vertices or the faces differ.
    """
    if len(source.vertices) != len(target.vertices):
        raise DataError(
            f"{name}: the source has {len(source.vertices)} vertices and the target "
            f"{len(target.vertices)}; expected the same vertices in the same order, so leave this "
            "pair out or repair it."
        )
    both = source.faces is not None and target.faces is not None
    if both and not np.array_equal(source.faces, target.faces):
        raise DataError(
            f"{name}: source and target have different faces, so their vertices are not in the "
            "same order; leave this pair out or repair it."
        )


# --- files and their roles --------------------------------------------------------------------

_ARCHIVES = (".zip", ".tar", ".gz", ".tgz", ".bz2", ".xz", ".7z", ".rar")
# Where a name comes in several formats, the one that surely holds a mesh is read.
_MESH_SUFFIXES = tuple(
    suffix
    for suffix in (".ply", ".obj", ".off", ".stl", *READABLE_SUFFIXES)
    if suffix in READABLE_SUFFIXES and suffix not in (".txt", ".csv", ".npy", ".npz", ".h5", ".mat")
)
_RANK = {
    suffix: rank for rank, suffix in reversed([*enumerate(_MESH_SUFFIXES + READABLE_SUFFIXES)])
}
_ROLE = re.compile(r"^(source|target|outliers?)[\s_-]+(?=.)", re.IGNORECASE)
_DOCUMENT = re.compile(r"(readme|licen[cs]e|copying|notice|citation|changelog)", re.IGNORECASE)

_LeftOut = list[tuple[Path, str]]


def _walk(folder: Path, left_out: _LeftOut) -> Iterator[Path]:
    """Every file below the folder in sorted order, without hidden ones."""
    seen = set()
    waiting = [folder]
    while waiting:
        current = waiting.pop()
        try:
            real = os.path.realpath(current)
            if real in seen:
                left_out.append((current, "a link to a folder that is scanned already"))
                continue
            seen.add(real)
            entries = sorted(os.scandir(current), key=lambda entry: entry.name)
        except OSError as error:
            left_out.append((current, f"the folder cannot be listed ({error.strerror})"))
            continue
        folders = []
        for entry in entries:
            if entry.name.startswith(".") or entry.name == "__MACOSX":
                left_out.append((Path(entry.path), "hidden"))
            elif entry.is_dir():
                folders.append(Path(entry.path))
            else:
                yield Path(entry.path)
        waiting += reversed(folders)


def _sort_by_role(files: list[Path], left_out: _LeftOut) -> dict[str, list[Path]]:
    by_role = {"source": [], "target": [], "outliers": [], "base": []}
    stems = {path.with_suffix("") for path in files if path.suffix.lower() == ".xyz"}
    for path in files:
        suffix = path.suffix.lower()
        if re.search("[\ud800-\udfff]", str(path)):
            left_out.append((path, "its name holds what is no text; rename it"))
        elif suffix == ".triangle":
            if path.with_suffix("") not in stems:
                left_out.append((path, "triangles without an .xyz file of the same name"))
        elif suffix in _ARCHIVES:
            left_out.append((path, "an archive; only its unpacked contents are read"))
        elif suffix not in READABLE_SUFFIXES:
            left_out.append((path, f"suffix '{path.suffix}' is not a format that is read"))
        else:
            role = _ROLE.match(path.stem)
            word = role[1].lower() if role else "base"
            by_role["outliers" if word.startswith("outlier") else word].append(path)
    return by_role


def _bases(folder: Path, files: list[Path], paired: bool, left_out: _LeftOut) -> dict[str, Path]:
    candidates = []
    own_name = folder.resolve().name
    for path in files:
        parts = path.relative_to(folder).parts[:-1]
        if _DOCUMENT.match(path.stem):
            left_out.append((path, "documentation"))
        elif paired and "data" not in map(str.lower, (own_name, *parts)):
            left_out.append((path, "neither in a Data folder nor named Source_ or Target_"))
        elif paired and any(_read_name(part).condition for part in parts):
            left_out.append((path, "in a folder of pairs, but not named Source_ or Target_"))
        else:
            candidates.append(path)
    if any(path.suffix.lower() in _MESH_SUFFIXES for path in candidates):
        # Tables and arrays beside meshes are notes and results far more often than surfaces.
        reason = "a table or array file beside mesh files; save it as .xyz to use it"
        left_out += [
            (path, reason) for path in candidates if path.suffix.lower() not in _MESH_SUFFIXES
        ]
        candidates = [path for path in candidates if path.suffix.lower() in _MESH_SUFFIXES]
    kept = {}
    for path in sorted(candidates, key=lambda path: (path.with_suffix(""), _preference(path))):
        first = kept.setdefault(path.with_suffix(""), path)
        if first != path:
            left_out.append((path, f"the same object as {first.name} in another format"))
    stems = Counter(path.name for path in kept)
    bases = {}
    for stem, path in kept.items():
        key = stem.name if stems[stem.name] == 1 else "__".join(stem.relative_to(folder).parts)
        if bases.setdefault(key, path) != path:
            left_out.append((path, f"its key {key} is already that of {bases[key]}"))
    return bases


def _preference(path: Path) -> tuple[int, str]:
    return _RANK[path.suffix.lower()], path.name


# --- condition and level ----------------------------------------------------------------------

_NUMBER = r"\d+(?:[.,]\d+)?|\.\d+"
_NUMBERED = re.compile(rf"(?P<word>\D*?)(?P<number>{_NUMBER})\s*(?P<percent>%|percent|pct)?", re.I)
_CONDITION_WORDS = {
    "deformation": re.compile(r"deform(ed|ations?)?(data|levels?)?"),
    "noise": re.compile(r"nois[ey](data|levels?)?"),
    "outliers": re.compile(r"outliers?(data|levels?|percent(age)?)?"),
    "incompleteness": re.compile(r"incomplete(ness)?(data|levels?|percent(age)?)?"),
}
_LEVEL_WORDS = ("level", "levels", "lvl")
_NUMBER_WORDS = ("", *_LEVEL_WORDS, "percent", "percentage", "sigma", "std")
_ROLE_FOLDERS = ("source", "sources", "target", "targets")


@dataclass(frozen=True)
class _FolderName:
    condition: str | None
    word: str
    number: float | None
    percent: bool


@functools.lru_cache(maxsize=4096)
def _read_name(text: str) -> _FolderName:
    numbered = _NUMBERED.fullmatch(text.strip())
    word = re.sub(r"[\W_]+", "", (numbered["word"] if numbered else text).lower())
    condition = next((c for c, words in _CONDITION_WORDS.items() if words.fullmatch(word)), None)
    # In names such as patient12 or SynBench2 the number is no level.
    if numbered is None or not (condition or word in _NUMBER_WORDS):
        return _FolderName(condition, word, None, False)
    percent = bool(numbered["percent"]) or word.startswith("percent")
    return _FolderName(condition, word, _to_float(numbered["number"]), percent)


def _to_float(text: str) -> float:
    return float(text.replace(",", "."))


@dataclass(frozen=True)
class _Place:
    """What the folders around a file say.

    Attributes:
        condition: one of ``CONDITIONS``.
        levels: numbers that are a deformation level.
        amounts: numbers that are an amount of corruption.
        unnamed: numbers that may be either, outermost first.
        group: the names that say nothing; files pair up only within the same ones.
        problem: why files here cannot be used, or an empty string.
    """

    condition: str
    levels: tuple[float, ...]
    amounts: tuple[float, ...]
    unnamed: tuple[float, ...]
    group: tuple[str, ...]
    problem: str = ""


def _place(parts: tuple[str, ...]) -> _Place:
    conditions, levels, amounts, unnamed, bare, group = [], [], [], [], [], []
    inside = None  # the condition folder that unnamed numbers belong to
    for part in parts:
        name = _read_name(part)
        if name.condition:
            conditions.append(name.condition)
            inside = name.condition if name.number is None else inside or name.condition
        if name.number is None:
            if not name.condition and name.word not in (*_ROLE_FOLDERS, "data"):
                group.append(part)
        elif name.condition:
            (levels if name.condition == "deformation" else amounts).append(name.number)
        elif inside == "deformation" or (inside is None and name.word in _LEVEL_WORDS):
            levels.append(name.number)
        elif inside is None:
            group.append(part)
            if not name.word:
                bare.append(name.number)
        else:
            (amounts if name.percent else unnamed).append(name.number)
    corruptions = sorted({c for c in conditions if c != "deformation"})
    condition = corruptions[0] if corruptions else "deformation"
    if not conditions and not levels:
        levels = bare[-1:]
    problem = ""
    if len(corruptions) > 1:
        problem = f"its folders name two conditions ({' and '.join(corruptions)})"
    elif len(set(levels)) > 1 or len(set(amounts)) > 1 or len(unnamed) > 2:
        problem = "its folders name more numbers than a level and an amount of corruption"
    elif conditions and condition != "incompleteness" and not (levels or amounts or unnamed):
        problem = f"its folder '{parts[-1]}' is not a number, so its level is unknown"
    return _Place(
        condition, tuple(levels[:1]), tuple(amounts[:1]), tuple(unnamed), tuple(group), problem
    )


class _Places:
    """Condition, corruption and level of every folder, decided for the dataset as a whole."""

    def __init__(self, folder: Path, parents: Iterable[Path]):
        around = []
        for part in reversed(folder.resolve().parts):
            name = _read_name(part)
            if not name.condition and name.number is None:
                break
            around.insert(0, part)
        while around and not _read_name(around[0]).condition:
            around.pop(0)
        self._places = {
            parent: _place((*around, *parent.relative_to(folder).parts)) for parent in set(parents)
        }
        known = {
            level
            for place in self._places.values()
            if place.condition == "deformation" and not place.problem
            for level in place.levels
        }
        unnamed = defaultdict(set)
        for place in self._places.values():
            if not place.levels and not place.amounts:
                unnamed[place.condition, len(place.unnamed)].add(place.unnamed)
        self._level_first = {
            condition
            for condition in CONDITIONS
            if (two := unnamed[condition, 2])
            and {outer for outer, _ in two} <= known
            and not {inner for _, inner in two} <= known
        }
        one = unnamed["incompleteness", 1]
        self._only_levels = bool(one) and {number for (number,) in one} <= known

    def __getitem__(self, parent: Path) -> _Place:
        return self._places[parent]

    def numbers(self, place: _Place) -> tuple[float | None, float | None] | None:
        """Corruption and level, each None where unknown; None when the numbers do not fit."""
        corruption, level = (*place.amounts, None)[0], (*place.levels, None)[0]
        unnamed = list(place.unnamed)
        if place.condition in self._level_first and len(unnamed) == 2:
            unnamed.reverse()
        if unnamed and corruption is None:
            single = place.condition == "incompleteness" and len(unnamed) == 1
            if not (single and level is None and self._only_levels):
                corruption = unnamed.pop(0)
        if unnamed and level is None:
            level = unnamed.pop(0)
        missing = corruption is None and place.condition in ("noise", "outliers")
        return None if unnamed or missing else (corruption, level)


# --- pairs ------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Key:
    condition: str
    corruption: float | None
    level: float | None
    name: str
    group: tuple[str, ...]


def _pairs(by_role: dict[str, list[Path]], inventory: Inventory) -> list[PairFiles]:
    left_out = inventory.left_out
    places = _Places(
        inventory.folder, (path.parent for paths in by_role.values() for path in paths)
    )
    found: dict[_Key, dict[str, list[Path]]] = defaultdict(lambda: defaultdict(list))
    for role, paths in by_role.items():
        for path in paths:
            place = places[path.parent]
            numbers = None if place.problem else places.numbers(place)
            if numbers is None:
                reason = place.problem or (
                    "the numbers of its folders do not tell the amount of corruption and the level"
                )
                left_out.append((path, reason))
                continue
            name = path.stem[_ROLE.match(path.stem).end() :]
            if role == "outliers":
                name = _ROLE.sub("", name, count=1)
            found[_Key(place.condition, *numbers, name, place.group)][role].append(path)

    undeformed = defaultdict(list)
    for key, files in found.items():
        if key.condition == "deformation" and files["source"]:
            undeformed[key.name].append((key, files["source"]))
    objects = _ObjectNames(inventory)
    pairs, used = [], set()
    for key, files in found.items():
        if not files["target"]:
            continue
        sources = files["source"] or _borrowed_sources(key, undeformed[key.name])
        if not sources:
            reason = "no Source_ file of the same name and level, or several"
            left_out += [(path, reason) for path in files["target"]]
            continue
        source, target = min(
            itertools.product(sources, files["target"]), key=lambda both: _closeness(*both)
        )
        companions = itertools.product(files["outliers"], [target])
        outliers, _ = min(companions, key=lambda both: _closeness(*both), default=(None, None))
        used |= {source, target, outliers}
        reason = f"the same as {target.name}, which is used"
        left_out += [(path, reason) for path in files["target"] if path != target]
        pairs.append(objects.pair(key, source, target, outliers))
    for files in found.values():
        for paths in (files["source"], files["outliers"]):
            kept = next((path.name for path in paths if path in used), None)
            reason = "no Target_ file of the same name, condition and level goes with it"
            if kept is not None:
                reason = f"the same as {kept}, which is used"
            left_out += [(path, reason) for path in paths if path not in used]
    return sorted(pairs, key=_order)


def _closeness(path: Path, target: Path) -> tuple:
    """Sorts first the files that were surely written together, then the plainest format."""
    return (
        path.parent != target.parent,
        path.suffix != target.suffix,
        _preference(target),
        _preference(path),
        path,
        target,
    )


def _borrowed_sources(key: _Key, undeformed: list[tuple[_Key, list[Path]]]) -> list[Path]:
    """The deformation folder's source of a corrupted target, if there is exactly one."""
    if key.condition == "deformation":
        return []
    fitting = [
        (other.group, files)
        for other, files in undeformed
        if key.level is None or other.level == key.level
    ]
    near = [item for item in fitting if item[0] == key.group] or fitting
    return near[0][1] if len(near) == 1 else []


def _order(pair: PairFiles) -> tuple:
    numbers = [-1.0 if number is None else number for number in (pair.corruption, pair.level)]
    return CONDITIONS.index(pair.condition), *numbers, pair.object, pair.name, pair.source


class _ObjectNames:
    """Reads ``<object>_<control percent>_<width>`` and finds the object among the bases."""

    def __init__(self, inventory: Inventory):
        self._keys = defaultdict(list)
        for key, path in inventory.bases.items():
            group = _place(path.parent.relative_to(inventory.folder).parts).group
            self._keys[path.stem].append((group, key))

    def pair(self, key: _Key, source: Path, target: Path, outliers: Path | None) -> PairFiles:
        parts = key.name.split("_")
        control = width = None
        if len(parts) > 2:
            numbers = [re.fullmatch(_NUMBER, part.rstrip("%")) for part in parts[-2:]]
            if all(numbers):
                control, width = (_to_float(number[0]) for number in numbers)
        stem = key.name if width is None else "_".join(parts[:-2])
        if stem not in self._keys:
            heads = ("_".join(parts[:count]) for count in range(len(parts), 0, -1))
            stem = next((head for head in heads if head in self._keys), stem)
        candidates = self._keys.get(stem, [])
        near = [item for item in candidates if item[0] == key.group] or candidates
        return PairFiles(
            object=near[0][1] if len(near) == 1 else stem,
            name=key.name,
            condition=key.condition,
            level=key.level,
            corruption=key.corruption,
            control_percent=control,
            width=width,
            source=source,
            target=target,
            outliers=outliers,
        )


# --- the published split ----------------------------------------------------------------------

_PARTS = {
    "train": "train",
    "training": "train",
    "val": "val",
    "valid": "val",
    "validation": "val",
    "test": "test",
    "testing": "test",
}
_SPLIT_SUFFIXES = (".json", ".csv", ".txt")


def _split_part(path: Path, folder: Path) -> str | None:
    """The part that a split file lists, ``all`` for one that lists every part, else None."""
    suffix, stem = path.suffix.lower(), path.stem.lower()
    if suffix not in _SPLIT_SUFFIXES or len(path.relative_to(folder).parts) > 2:
        return None
    if suffix != ".txt":
        return "all" if "split" in stem else None
    words = set(re.split(r"[\s_-]+", stem)) - {"files", "file", "list", "names", "split"}
    return _PARTS.get(words.pop()) if len(words) == 1 else None


def _attach_split(inventory: Inventory, files: list[Path]) -> None:
    if not files:
        return
    first = min(
        files,
        key=lambda path: (len(path.parts), _SPLIT_SUFFIXES.index(path.suffix.lower()), path),
    )
    used = [first]
    if first.suffix.lower() == ".txt":
        used = [
            path for path in files if (path.parent, path.suffix) == (first.parent, first.suffix)
        ]
    inventory.left_out += [
        (path, f"another split file, {first.name}, is used") for path in files if path not in used
    ]
    split = {}
    files = _files_by_id(inventory)
    for path in used:
        for entry, part in _split_entries(path, inventory.folder):
            name = _entry_name(entry, inventory.bases, files)
            if split.setdefault(name, part) != part:
                raise _bad_split(
                    path,
                    f"{name} is in {split[name]} and in {part} (name pairs of the same name by "
                    "their level too, as in 0.3/<name> or by a path)",
                )
    known = {
        *inventory.bases,
        *(p.object for p in inventory.pairs),
        *(p.name for p in inventory.pairs),
        *(p.id for p in inventory.pairs),
    }
    if known.isdisjoint(split):
        raise _bad_split(first, "it names none of the objects and pairs found")
    inventory.split, inventory.split_file = split, first


def _split_entries(path: Path, folder: Path) -> Iterator[tuple[str, str]]:
    """Yield every entry of a split file with its part: train, val or test."""
    suffix = path.suffix.lower()
    if suffix == ".json":
        items = _json_items(path)
    else:
        try:
            text = path.read_text(encoding="utf-8-sig")
        except (OSError, UnicodeDecodeError) as error:
            raise _bad_split(path, f"it cannot be read as text ({error})") from error
        if suffix == ".csv":
            items = _csv_items(path, text)
        else:
            lines = (line.strip() for line in text.splitlines())
            part = _split_part(path, folder)
            items = [(line, part) for line in lines if line and not line.startswith("#")]
    if not items:
        raise _bad_split(path, "it holds no names")
    for entry, part in items:
        is_name = isinstance(entry, str | int) and not isinstance(entry, bool)
        if not is_name or not str(entry).strip(" /\\."):
            raise _bad_split(path, f"{entry!r} is not a name")
        word = part.strip().lower() if isinstance(part, str) else None
        if word not in _PARTS:
            raise _bad_split(path, f"{part!r} is none of train, val and test")
        yield str(entry), _PARTS[word]


def _json_items(path: Path) -> list[tuple[Any, Any]]:
    content = read_json(path)
    if not isinstance(content, dict):
        raise _bad_split(path, "it is not a JSON object")
    if any(isinstance(value, list) for value in content.values()):
        if not all(isinstance(value, list) for value in content.values()):
            raise _bad_split(path, "it mixes lists with single values")
        return [(entry, part) for part, entries in content.items() for entry in entries]
    return list(content.items())


def _csv_items(path: Path, text: str) -> list[tuple[Any, Any]]:
    try:
        rows = list(csv.DictReader(text.splitlines(), skipinitialspace=True))
    except csv.Error as error:
        raise _bad_split(path, f"it is no CSV file ({error})") from error
    columns = {name.strip().lower(): name for name in (rows[0] if rows else {}) if name}
    names = next((columns[name] for name in ("name", "object") if name in columns), None)
    if names is None or "split" not in columns:
        raise _bad_split(path, "it has no rows, or no columns 'name' (or 'object') and 'split'")
    level = columns.get("level")
    return [
        (
            f"{row[level]}/{row[names]}" if level and row[level] and row[names] else row[names],
            row[columns["split"]],
        )
        for row in rows
    ]


def _files_by_id(inventory: Inventory) -> dict[tuple[str, ...], str]:
    """Ids of pairs by the parts of their files' paths, without suffix."""
    return {
        path.relative_to(inventory.folder).with_suffix("").parts: pair.id
        for pair in inventory.pairs
        for path in (pair.source, pair.target)
        if path.is_relative_to(inventory.folder)
    }


def _entry_name(entry: str, bases: dict[str, Path], files: dict[tuple[str, ...], str]) -> str:
    """Object key, pair name or pair id that an id, a name, a file name or a path stands for."""
    *folders, last = [part for part in re.split(r"[/\\]", entry.strip()) if part not in ("", ".")]
    stem, suffix = os.path.splitext(last)
    if suffix.lower() in (*READABLE_SUFFIXES, ".triangle"):
        last = stem
    path_key = "__".join([*folders, last])
    if path_key in bases:
        return path_key
    name = _ROLE.sub("", last, count=1)
    if not folders or name in bases:
        return name
    # The folder of the dataset itself, and those above it, may stand before the path.
    tails = [(*folders[start:], last) for start in range(len(folders))]
    found = next((files[tail] for tail in tails if tail in files), None)
    if found is not None:
        return found
    place = _place(tuple(folders))
    clean = place.condition == "deformation" and not place.problem
    return pair_id(next(iter(place.levels), None) if clean else None, name)


def _bad_split(path: Path, reason: str) -> DataError:
    return DataError(
        f"{path} is not a usable split file: {reason}; repair it, or rename it if it is not one."
    )
