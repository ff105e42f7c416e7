"""The one pair type, how pairs are made from files, and the HDF5 files that keep them.

Layout of a pair file (format ``dine-pairs``, version 1), P pairs of N points, pairs grouped by
split in the order train, val, test:

==================  ===========  ========  =========================================================
dataset             shape        type      content
==================  ===========  ========  =========================================================
``source``          (P, N, 3)    float32   source points, normalised frame, in the index convention
``target``          (P, N, 3)    float32   where the same points are on the target, same frame
``center``          (P, 3)       float64   mean of the sampled source points, units of the file
``scale``           (P,)         float64   largest distance of one from the center, same units
``level``           (P,)         float64   deformation level
``name``            (P,)         UTF-8     unique id, ``<level>/<object>_<a>_<b>``
``object``          (P,)         UTF-8     undeformed object that the pair was made of
``split``           (P,)         UTF-8     ``train``, ``val`` or ``test``
``source_file``     (P,)         UTF-8     source mesh or cloud, relative to the scanned folder
``target_file``     (P,)         UTF-8     target mesh or cloud, likewise
``vertex_index``    (P, N, 3)    int32     source vertices that each point lies between
``vertex_weight``   (P, N, 3)    float64   barycentric weights of these vertices
==================  ===========  ========  =========================================================

``original = normalised * scale + center`` gives back the units of the file; the target's own extent
is never looked at, so nothing about the deformation leaks into the normalisation.

Layout of a variant file (format ``dine-variant``, version 1): ``target`` (P, M, 3) float32, the
corrupted target; ``inlier`` (P, M) uint8, 1 at points that are not outliers; ``name`` (P,) UTF-8;
the attributes ``condition``, ``level`` and ``pairs``, the checksum of the pairs it was made from.

Both carry the attributes ``format``, ``format_version`` and ``checksum`` (SHA-256 of name, type,
shape and little-endian bytes of each dataset in the order of their names). Pair files add those
listed at ``make_pairs`` and the versions of the libraries. Every dataset has ``description`` and
``units``. Chunks hold one pair, and each has a Fletcher-32 checksum of its own, so that reading
some rows notices damage too. Equal content gives equal bytes.
"""

from __future__ import annotations

import hashlib
import logging
import os
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import scipy

from dine import __version__
from dine.data.corruption import add_outliers, gaussian_noise
from dine.data.layout import Inventory, PairFiles, check_pair
from dine.data.readers import read_surface
from dine.data.sampling import SurfaceSamples, convention_order, sample_surface
from dine.data.surface import Surface
from dine.errors import ConfigError, DataError
from dine.files import atomic_path, digest

_log = logging.getLogger(__name__)

PAIRS_FORMAT = "dine-pairs"
VARIANT_FORMAT = "dine-variant"
FORMAT_VERSION = 1

SPLITS = ("train", "val", "test")

_TEXT = "text"
_NORMALISED = "of the normalised frame"
_FILE_UNITS = "of the source file"
# name: (type, shape of a row with N for the number of points, units, description)
_PAIR_DATASETS = {
    "source": ("<f4", "N3", _NORMALISED, "source points in the index convention"),
    "target": ("<f4", "N3", _NORMALISED, "where the same points are on the target"),
    "center": ("<f8", "3", _FILE_UNITS, "mean of the sampled source points"),
    "scale": ("<f8", "", _FILE_UNITS, "largest distance of a sampled source point from center"),
    "level": ("<f8", "", "none", "deformation level"),
    "name": (_TEXT, "", "none", "unique id of the pair, <level>/<object>_<a>_<b>"),
    "object": (_TEXT, "", "none", "undeformed object that the pair was made of"),
    "split": (_TEXT, "", "none", "train, val or test"),
    "source_file": (_TEXT, "", "none", "source, relative to the scanned folder"),
    "target_file": (_TEXT, "", "none", "target, relative to the scanned folder"),
    "vertex_index": ("<i4", "N3", "none", "source vertices that each point lies between"),
    "vertex_weight": ("<f8", "N3", "none", "barycentric weights of these vertices"),
}
_VARIANT_DATASETS = {
    "target": ("<f4", "N3", _NORMALISED, "corrupted target points"),
    "inlier": ("|u1", "N", "none", "1 at points that are not outliers"),
    "name": (_TEXT, "", "none", "unique id of the pair"),
}
_Schema = dict[str, tuple[str, str, str, str]]


@dataclass(frozen=True, eq=False)
class PairSet:
    """P pairs of N corresponding points; row i of a target is where row i of its source went.

    Attributes:
        source: (P, N, 3) float32, normalised frame, in the index convention.
        target: (P, N, 3) float32, same frame.
        center: (P, 3) float64, units of the files.
        scale: (P,) float64, units of the files; original = normalised * scale + center.
        level: (P,) float64 deformation levels.
        name: (P,) str, unique ids such as ``"0.3/12_5_0.4"``.
        object: (P,) str, the undeformed objects.
        split: (P,) str, ``train``, ``val`` or ``test``.
        source_file: (P,) str, relative to the scanned folder.
        target_file: (P,) str, relative to the scanned folder.
        vertex_index: (P, N, 3) int32, see ``samples``.
        vertex_weight: (P, N, 3) float64, see ``samples``.
        attributes: text and numbers by name: seed, convention, origin and so on.

    Raises:
        DataError: shapes that do not go together, values that are not finite, or a split other
            than the three.
    """

    source: np.ndarray
    target: np.ndarray
    center: np.ndarray
    scale: np.ndarray
    level: np.ndarray
    name: np.ndarray
    object: np.ndarray
    split: np.ndarray
    source_file: np.ndarray
    target_file: np.ndarray
    vertex_index: np.ndarray
    vertex_weight: np.ndarray
    attributes: dict[str, str | int | float] = field(default_factory=dict)

    def __post_init__(self):
        if np.ndim(self.source) != 3:
            raise DataError(f"Expected sources (P, N, 3), found shape {np.shape(self.source)}.")
        _conform(self, _PAIR_DATASETS, *np.shape(self.source)[:2])
        unknown = set(self.split.tolist()) - set(SPLITS)
        if unknown:
            raise DataError(f"Unknown split {min(unknown)!r}; expected one of {', '.join(SPLITS)}.")

    def __len__(self) -> int:
        return len(self.source)

    @property
    def displacement(self) -> np.ndarray:
        """(P, N, 3) float32 true displacements, normalised frame."""
        return self.target - self.source

    @property
    def checksum(self) -> str:
        """Identifies the pairs as written; rows selected from them keep it."""
        return str(self.attributes.get("checksum") or _checksum(_encoded(self, _PAIR_DATASETS)))

    def select(
        self, split: str | None = None, index: Sequence[int] | np.ndarray | slice | None = None
    ) -> PairSet:
        """The pairs of a split, and of these the rows that ``index`` picks (numbers or booleans).

        Raises:
            ConfigError: unknown split.
        """
        rows = np.arange(len(self)) if split is None else _rows_of(self.split, split)
        if index is not None:
            rows = rows[index if isinstance(index, slice | np.ndarray) else list(index)]
        return replace(self, **{name: getattr(self, name)[rows] for name in _PAIR_DATASETS})

    def to_original(self, points: np.ndarray, i: int) -> np.ndarray:
        """Points (..., 3) of pair i from the normalised frame to the units of its files."""
        return np.asarray(points, dtype=np.float64) * self.scale[i] + self.center[i]

    def samples(self, i: int) -> SurfaceSamples:
        """Where the points of pair i lie on the mesh of its source, in the same order."""
        return SurfaceSamples(self.vertex_index[i].astype(np.int64), self.vertex_weight[i])

    @classmethod
    def concatenate(cls, sets: Sequence[PairSet]) -> PairSet:
        """All pairs one after another, with the attributes of the first set but the checksum.

        Names stay as they are, so they are unique only within each set.

        Raises:
            DataError: no sets, or sets of different numbers of points or conventions.
        """
        if not sets:
            raise DataError("There are no pair sets to concatenate.")
        if len(sets) == 1:
            return sets[0]
        kinds = {(s.source.shape[1], s.attributes.get("convention")) for s in sets}
        if len(kinds) > 1:
            found = "; ".join(sorted(f"{points} points in {name}" for points, name in kinds))
            raise DataError(
                f"Pairs of different numbers of points or conventions cannot be mixed ({found}); "
                "make them with the same settings."
            )
        attributes = {k: v for k, v in sets[0].attributes.items() if k != "checksum"}
        columns = {
            name: np.concatenate([getattr(s, name) for s in sets]) for name in _PAIR_DATASETS
        }
        return cls(**columns, attributes=attributes)


def make_pairs(
    inventory: Inventory,
    *,
    points: int,
    convention: str,
    split: Mapping[str, float],
    seed: int,
    origin: str = "files",
    progress: Callable[[int, int], None] | None = None,
) -> tuple[PairSet, list[tuple[str, str]]]:
    """Sample the pairs of condition ``deformation`` and split them by base object.

    Points are drawn on the source and carried to the target. The draw is keyed by seed and object,
    and the convention is computed once for each distinct undeformed surface, so that all targets of
    an object share points and order.

    Without a published split, objects are shuffled by ``seed`` and shared out by fraction, at least
    one to each split whose fraction is not zero. A published split (``inventory.split``) is kept as
    it is: by pair name where it has that, otherwise by object; objects in two of its parts are
    logged and kept. Where it has no ``val``, some of its training objects become ``val``.

    Attributes of the result: ``seed``, ``convention``, ``points``, ``origin``, ``split_rule``
    (``objects`` or ``published``), ``split_train``, ``split_val``, ``split_test`` (the fractions),
    ``split_leakage`` (objects in two parts of a published split, separated by commas),
    ``split_unknown`` (number of names in a published split that fit nothing), ``checksum``.

    Args:
        inventory: what ``dine.data.layout.scan`` found.
        points: N, points per cloud.
        convention: see ``dine.data.sampling.convention_order``.
        split: fractions of objects for ``train``, ``val`` and ``test``; they sum to 1.
        seed: >= 0.
        origin: where the data come from, such as ``"synthetic"``.
        progress: called with the numbers of pairs done and of all pairs.

    Returns:
        The pairs, grouped by split, and (id, reason) of every pair that was left out.

    Raises:
        ConfigError: unusable fractions, number of points or convention.
        DataError: no usable pair, or too few objects for the splits.
    """
    if points < 1:
        raise ConfigError(f"The number of points must be at least 1, found {points}.")
    fractions = _checked_fractions(split)
    rows, skipped = _sample_all(inventory, _Sampler(points, convention, seed), progress)
    if inventory.split is None:
        objects = {row["object"] for row in rows}
        # Without any row, the reasons for that say more than the number of objects.
        by_object = _split_objects(objects, fractions, seed) if rows else {}
        parts = [by_object[row["object"]] for row in rows]
        facts = {"split_rule": "objects", "split_leakage": "", "split_unknown": 0}
    else:
        parts, facts = _published_split(rows, inventory.split, fractions, seed)
    kept = []
    for row, part in zip(rows, parts, strict=True):
        if part is None:
            reason = "the published split names neither the pair nor its object"
            skipped.append((row["name"], reason))
        else:
            kept.append(row | {"split": part})
    for name, reason in skipped:
        _log.warning("Left out pair %s: %s", name, reason)
    if not kept:
        first = f"; the first of {len(skipped)}: {skipped[0][1]}" if skipped else ""
        raise DataError(
            f"{inventory.folder} holds no usable pair of a source and its deformed target{first}"
        )
    # Reading one split is then reading one run of rows.
    kept.sort(key=lambda row: SPLITS.index(row["split"]))
    pairs = PairSet(
        **{column: np.array([row[column] for row in kept]) for column in _PAIR_DATASETS},
        attributes={
            "seed": int(seed),
            "convention": convention,
            "points": int(points),
            "origin": origin,
            **facts,
            **{f"split_{part}": fraction for part, fraction in fractions.items()},
        },
    )
    pairs.attributes["checksum"] = pairs.checksum
    return pairs, skipped


def write_pairs(path: str | os.PathLike, pairs: PairSet) -> None:
    """Write a pair file atomically; equal pairs give equal bytes.

    Raises:
        DataError: no pairs, or two pairs of the same name.
        StorageError: the disk is full or the folder cannot be written.
    """
    if len(pairs) == 0:
        raise DataError(f"{path} was not written: there are no pairs to write.")
    repeated = [name for name, count in Counter(pairs.name.tolist()).items() if count > 1]
    if repeated:
        raise DataError(
            f"{path} was not written: {len(repeated)} names are used by several pairs, such as "
            f"{repeated[0]!r}."
        )
    libraries = {"dine": __version__, "h5py": h5py.__version__, "hdf5": h5py.version.hdf5_version}
    libraries |= {"numpy": np.__version__, "scipy": scipy.__version__}
    versions = {f"version_{library}": version for library, version in libraries.items()}
    _write(path, PAIRS_FORMAT, _PAIR_DATASETS, pairs, {**pairs.attributes, **versions})


def read_pairs(path: str | os.PathLike, split: str | None = None) -> PairSet:
    """Read a pair file, or the rows of one split of it (none, where the split is empty).

    The whole file is checked against its checksum; a split, chunk by chunk.

    Raises:
        ConfigError: unknown split.
        DataError: the file is missing, truncated, damaged, or something else.
    """
    with _opened(path, PAIRS_FORMAT, _PAIR_DATASETS) as (file, attributes):
        if split is None:
            columns = _read_columns(file, _PAIR_DATASETS)
            _verify(columns, attributes)
        else:
            parts = _read_columns(file, {"split": _PAIR_DATASETS["split"]})["split"]
            rows = _rows_of(_decoded({"split": parts})["split"], split)
            columns = _read_columns(file, _PAIR_DATASETS, rows)
        return PairSet(**_decoded(columns), attributes=attributes)


@dataclass(frozen=True, eq=False)
class Variant:
    """Corrupted targets of some pairs, row by row; the clean ones stay in the ``PairSet``.

    Attributes:
        condition: ``noise`` or ``outliers``.
        level: standard deviation of the noise in the normalised frame, or percent of outliers.
        target: (P, M, 3) float32, normalised frame; row i < N is still point i of the clean target.
        inlier: (P, M) bool, False at outliers.
        name: (P,) str, ids of the pairs.

    Raises:
        DataError: shapes that do not go together, or values that are not finite.
    """

    condition: str
    level: float
    target: np.ndarray
    inlier: np.ndarray
    name: np.ndarray

    def __post_init__(self):
        if np.ndim(self.target) != 3:
            raise DataError(f"Expected targets (P, M, 3), found shape {np.shape(self.target)}.")
        _conform(self, _VARIANT_DATASETS, *np.shape(self.target)[:2])
        object.__setattr__(self, "inlier", self.inlier.astype(bool))

    def __len__(self) -> int:
        return len(self.target)


def make_variant(pairs: PairSet, condition: str, level: float, seed: int) -> Variant:
    """Corrupt the targets of pairs.

    The draw of a pair is keyed by seed, its name, condition and level, so it is the same whichever
    other pairs there are.

    Args:
        pairs: at least one pair.
        condition: ``noise`` or ``outliers``.
        level: standard deviation in the normalised frame, or percent of outliers; > 0.
        seed: >= 0.

    Raises:
        ConfigError: unknown condition, or an unusable level.
        DataError: no pairs.
    """
    if condition not in ("noise", "outliers"):
        raise ConfigError(f"Unknown condition {condition!r}; expected noise or outliers.")
    if level is None or not level > 0:
        raise ConfigError(f"The level of {condition} must be above 0, found {level!r}.")
    if len(pairs) == 0:
        raise DataError(f"There are no pairs to add {condition} to.")
    targets, inliers = [], []
    for name, target in zip(pairs.name, pairs.target, strict=True):
        rng = _keyed_rng(seed, str(name), condition, float(level))
        if condition == "noise":
            targets.append(gaussian_noise(target, level, rng))
            inliers.append(np.ones(len(target), dtype=bool))
        else:
            corrupted, inlier = add_outliers(target, level, rng)
            targets.append(corrupted)
            inliers.append(inlier)
    return Variant(condition, float(level), np.stack(targets), np.stack(inliers), pairs.name)


def write_variant(path: str | os.PathLike, variant: Variant, pairs_digest: str) -> None:
    """Write a variant file atomically; ``pairs_digest`` is ``PairSet.checksum``.

    Raises:
        StorageError: the disk is full or the folder cannot be written.
    """
    attributes = {"condition": variant.condition, "level": variant.level, "pairs": pairs_digest}
    _write(path, VARIANT_FORMAT, _VARIANT_DATASETS, variant, attributes)


def read_variant(path: str | os.PathLike, pairs: PairSet) -> Variant:
    """Read the rows of a variant that belong to ``pairs``, in the order of ``pairs``.

    Raises:
        DataError: the file is missing, truncated, damaged or something else, was made from other
            pairs, or lacks some of them.
    """
    with _opened(path, VARIANT_FORMAT, _VARIANT_DATASETS) as (file, attributes):
        columns = _read_columns(file, _VARIANT_DATASETS)
        _verify(columns, attributes)
        columns = _decoded(columns)
        condition, level = str(attributes["condition"]), float(attributes["level"])
        made_from = attributes["pairs"]
    position = {name: row for row, name in enumerate(columns["name"].tolist())}
    missing = [name for name in pairs.name.tolist() if name not in position]
    if made_from != pairs.checksum or missing:
        lacking = f"it lacks {len(missing)} of them, such as {missing[0]!r}" if missing else ""
        raise DataError(
            f"{path} was made from other pairs than those given"
            f"{f' ({lacking})' if lacking else ''}; delete it and run the same command again."
        )
    rows = [position[name] for name in pairs.name.tolist()]
    return Variant(condition, level, **{name: values[rows] for name, values in columns.items()})


# --- from files to points ---------------------------------------------------------------------


_Row = dict[str, Any]


def _sample_all(
    inventory: Inventory, sampler: _Sampler, progress: Callable[[int, int], None] | None
) -> tuple[list[_Row], list[tuple[str, str]]]:
    """All columns but the split, row by row, and the pairs that have none, with reasons."""
    every = [files for files in inventory.pairs if files.condition == "deformation"]
    rows, skipped, names = [], [], set()
    for done, files in enumerate(every, start=1):
        name = files.name if files.level is None else f"{files.level:g}/{files.name}"
        try:
            if name in names:
                raise DataError(f"{files.target}: another pair is called {name} too; rename one.")
            names.add(name)
            row = sampler.pair(files)
        except DataError as error:
            skipped.append((name, str(error)))
        else:
            row |= {"name": name, "object": files.object, "level": files.level}
            for role in ("source", "target"):
                row[f"{role}_file"] = _relative(getattr(files, role), inventory.folder)
            rows.append(row)
        if progress is not None:
            progress(done, len(every))
    return rows, skipped


@dataclass(frozen=True)
class _Sampled:
    samples: SurfaceSamples
    source: np.ndarray
    center: np.ndarray
    scale: float


class _Sampler:
    """Samples pairs, and each distinct undeformed surface of an object only once."""

    def __init__(self, points: int, convention: str, seed: int):
        self.points, self.convention, self.seed = points, convention, seed
        self._known: dict[tuple[str, bytes], _Sampled] = {}

    def pair(self, files: PairFiles) -> _Row:
        """The columns of one pair that come from its surfaces."""
        if files.level is None:
            raise DataError(
                f"{files.target} has no deformation level in its path; put it into a folder named "
                "after the level, such as Deformation_Level/0.3."
            )
        source, target = read_surface(files.source), read_surface(files.target)
        check_pair(source, target, files.name)
        sampled = self._sampled(files.object, source)
        with np.errstate(over="ignore"):
            moved = (sampled.samples.carry(target.vertices) - sampled.center) / sampled.scale
            moved = moved.astype(np.float32)
        if not np.isfinite(moved).all():
            raise DataError(
                f"{files.target} lies too far from its source to be given in its frame; check the "
                "units of both."
            )
        return {
            "source": sampled.source,
            "target": moved,
            "center": sampled.center,
            "scale": sampled.scale,
            "vertex_index": sampled.samples.faces_vertices.astype(np.int32),
            "vertex_weight": sampled.samples.weights,
        }

    def _sampled(self, name: str, surface: Surface) -> _Sampled:
        faces = b"" if surface.faces is None else surface.faces.tobytes()
        key = (name, hashlib.sha256(surface.vertices.tobytes() + faces).digest())
        if key not in self._known:
            self._known[key] = self._sample(name, surface)
        return self._known[key]

    def _sample(self, name: str, surface: Surface) -> _Sampled:
        # Not keyed by the coordinates, so that a change of units or position changes no draw.
        rng = _keyed_rng(self.seed, name)
        samples = sample_surface(surface, self.points, rng)
        points = samples.carry(surface.vertices)
        center = points.mean(axis=0)
        scale = float(np.linalg.norm(points - center, axis=1).max())
        if not scale > 0:
            raise DataError(f"{surface.name}: all sampled points coincide; repair or remove it.")
        points = (points - center) / scale
        order = convention_order(points, self.convention)
        return _Sampled(samples[order], points[order].astype(np.float32), center, scale)


def _keyed_rng(*key: Any) -> np.random.Generator:
    return np.random.default_rng(int(digest(list(key)), 16))


def _relative(path: Path, folder: Path) -> str:
    path = Path(path)
    return path.relative_to(folder).as_posix() if path.is_relative_to(folder) else path.name


# --- splits -----------------------------------------------------------------------------------


def _checked_fractions(split: Mapping[str, float]) -> dict[str, float]:
    unknown = sorted(set(split) - set(SPLITS))
    fractions = {part: float(split.get(part, 0.0)) for part in SPLITS}
    values = np.array(list(fractions.values()))
    if unknown or not (values >= 0).all() or not np.isclose(values.sum(), 1.0):
        raise ConfigError(
            "The split needs fractions for train, val and test that are not negative and sum to "
            f"1, found {dict(split)}."
        )
    return fractions


def _split_objects(objects: set[str], fractions: Mapping[str, float], seed: int) -> dict[str, str]:
    """Share objects out by fraction, with at least one to each part that is not to be empty."""
    wanted = {part: fraction for part, fraction in fractions.items() if fraction > 0}
    if len(objects) < len(wanted):
        raise DataError(
            f"Splitting by object into {', '.join(wanted)} needs at least {len(wanted)} objects "
            f"with usable pairs, found {len(objects)}; provide more objects, or set the share of a "
            "split to 0."
        )
    counts = dict.fromkeys(wanted, 1)
    for _ in range(len(objects) - len(wanted)):
        # The next object goes to the part that is farthest below its share.
        part = max(wanted, key=lambda part: wanted[part] * len(objects) - counts[part])
        counts[part] += 1
    shuffled = sorted(objects, key=lambda name: digest([seed, "split", name]))
    parts = [part for part, count in counts.items() for _ in range(count)]
    return dict(zip(shuffled, parts, strict=True))


def _published_split(
    rows: list[_Row],
    published: Mapping[str, str],
    fractions: Mapping[str, float],
    seed: int,
) -> tuple[list[str | None], dict[str, str | int]]:
    """Part of each row, None where the split does not name it, and attributes about the split."""
    # The level is part of an id, but a published split may name files without their folders.
    candidates = [(row["name"], row["name"].split("/", 1)[1], row["object"]) for row in rows]
    parts = [
        next((published[name] for name in names if name in published), None) for names in candidates
    ]
    unknown = sorted(set(published).difference(*candidates))
    if unknown:
        _log.warning(
            "%d names in the published split fit no usable pair: %s%s",
            len(unknown),
            ", ".join(unknown[:5]),
            ", ..." if len(unknown) > 5 else "",
        )
    objects = [row["object"] for row in rows]
    homes: dict[str, set[str]] = {}
    for name, part in zip(objects, parts, strict=True):
        if part is not None:
            homes.setdefault(name, set()).add(part)
    leaking = sorted(name for name, where in homes.items() if len(where) > 1)
    if leaking:
        _log.warning(
            "The published split has pairs of the same object in several parts, so results on "
            "test pairs are not results on unseen objects; objects: %s",
            ", ".join(leaking),
        )
    training = {name for name, where in homes.items() if "train" in where}
    if training and fractions["val"] > 0 and "val" not in parts:
        # An object that is tested on as well would leak into the choice of λ.
        training = training - set(leaking) or training
        shares = {part: fractions[part] for part in ("train", "val")}
        total = sum(shares.values())
        carved = _split_objects(
            training, {part: share / total for part, share in shares.items()}, seed
        )
        parts = [
            carved.get(name, part) if part == "train" else part
            for name, part in zip(objects, parts, strict=True)
        ]
    return parts, {
        "split_rule": "published",
        "split_leakage": ", ".join(leaking),
        "split_unknown": len(unknown),
    }


def _rows_of(parts: np.ndarray, split: str) -> np.ndarray:
    if split not in SPLITS:
        raise ConfigError(f"Unknown split {split!r}; expected one of {', '.join(SPLITS)}.")
    return np.flatnonzero(parts == split)


# --- HDF5 -------------------------------------------------------------------------------------

# Version 1.10 of the file format protects headers and indices by checksums too, and every HDF5
# library since 2016 reads it.
_LIBVER = ("v110", "v110")


def _conform(record: Any, schema: _Schema, rows: int, points: int) -> None:
    """Give every column of a frozen dataclass its type, or say which one cannot have it."""
    for name, (kind, shape, _, _) in schema.items():
        values = np.asarray(getattr(record, name))
        expected = (rows, *(points if axis == "N" else int(axis) for axis in shape))
        if values.shape != expected:
            raise DataError(f"Expected {name} of shape {expected}, found {values.shape}.")
        values = values.astype(str) if kind == _TEXT else values.astype(kind, copy=False)
        if values.dtype.kind == "f" and not np.isfinite(values).all():
            raise DataError(f"The column {name} holds NaN or infinite values.")
        object.__setattr__(record, name, values)


def _encoded(record: Any, schema: _Schema) -> dict[str, np.ndarray]:
    """Columns as they are stored: text as UTF-8 of fixed length, which HDF5 can checksum."""
    columns = {}
    for name, (kind, *_) in schema.items():
        values = getattr(record, name)
        if kind == _TEXT:
            encoded = [text.encode(errors="replace") for text in values.tolist()]
            columns[name] = np.array(encoded, dtype=np.bytes_)
        else:
            columns[name] = np.ascontiguousarray(values, dtype=kind)
    return columns


def _decoded(columns: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    return {
        name: np.array([text.decode() for text in values.tolist()], dtype=str)
        if values.dtype.kind == "S"
        else values
        for name, values in columns.items()
    }


def _checksum(columns: Mapping[str, np.ndarray]) -> str:
    total = hashlib.sha256()
    for name, values in sorted(columns.items()):
        total.update(f"{name} {values.dtype.str} {values.shape}\n".encode())
        total.update(values.data)
    return total.hexdigest()


def _verify(columns: Mapping[str, np.ndarray], attributes: Mapping[str, Any]) -> None:
    if _checksum(columns) != attributes["checksum"]:
        raise ValueError("its content does not fit its checksum")


def _write(
    path: str | os.PathLike,
    form: str,
    schema: _Schema,
    record: Any,
    attributes: Mapping[str, str | int | float],
) -> None:
    columns = _encoded(record, schema)
    attributes = {
        **attributes,
        "format": form,
        "format_version": FORMAT_VERSION,
        "checksum": _checksum(columns),
    }
    with atomic_path(path) as temporary, h5py.File(temporary, "w", libver=_LIBVER) as file:
        for name, values in columns.items():
            kind, shape, units, description = schema[name]
            if kind == _TEXT:
                values = values.astype(h5py.string_dtype("utf-8", values.dtype.itemsize))
            data = file.create_dataset(
                name,
                data=values,
                chunks=(1, *values.shape[1:]) if "N" in shape else values.shape,
                fletcher32=True,
            )
            _set_attributes(data, {"description": description, "units": units})
        _set_attributes(file, attributes)


def _set_attributes(item: h5py.HLObject, attributes: Mapping[str, str | int | float]) -> None:
    for name, value in sorted(attributes.items()):
        if isinstance(value, str):
            # Fixed length keeps the text in the header, which has a checksum.
            text = value.encode()
            dtype = h5py.string_dtype("utf-8", max(1, len(text)))
            item.attrs.create(name, np.array(text, dtype=dtype))
        else:
            item.attrs[name] = value


@contextmanager
def _opened(
    path: str | os.PathLike, form: str, schema: _Schema
) -> Iterator[tuple[h5py.File, dict[str, str | int | float]]]:
    """An HDF5 file of the right format and its attributes; all that goes wrong is a DataError."""
    path = Path(path)
    if not path.is_file():
        raise DataError(f"{path} does not exist.")
    try:
        with h5py.File(path, "r") as file:
            attributes = {
                name: value.decode() if isinstance(value, bytes) else value.item()
                for name, value in file.attrs.items()
            }
            found = attributes.pop("format", "no"), attributes.pop("format_version", 0)
            if found != (form, FORMAT_VERSION):
                raise ValueError(
                    f"it has format {found[0]} version {found[1]} instead of {form} version "
                    f"{FORMAT_VERSION}"
                )
            missing = sorted(set(schema) - set(file))
            if missing:
                raise ValueError(f"it lacks the dataset {missing[0]}")
            yield file, attributes
    # What HDF5, or decoding what it read, raises depends on where the damage is.
    except (
        *(OSError, RuntimeError, KeyError, ValueError, TypeError, AttributeError),
        *(MemoryError, OverflowError, DataError),
    ) as error:
        reason = " ".join(str(error).split()).rstrip(".")
        raise DataError(
            f"{path} is damaged or not a {form} file ({reason}); delete it and run the same "
            "command again."
        ) from error


def _read_columns(
    file: h5py.File, schema: _Schema, rows: np.ndarray | None = None
) -> dict[str, np.ndarray]:
    """Columns as stored, whole or at increasing rows."""
    columns = {}
    for name, (kind, *_) in schema.items():
        data = file[name]
        stored = data.dtype
        if stored.kind != "S" if kind == _TEXT else stored != np.dtype(kind):
            raise ValueError(f"the dataset {name} has type {stored}")
        if rows is None:
            columns[name] = data[()]
        elif len(rows) == 0:
            columns[name] = data[:0]
        else:
            runs = np.split(rows, np.flatnonzero(np.diff(rows) > 1) + 1)
            columns[name] = np.concatenate([data[run[0] : run[-1] + 1] for run in runs])
    return columns
