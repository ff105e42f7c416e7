"""The one pair type and the HDF5 files that keep pairs.

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
listed at ``dine.data.prepare.make_pairs`` and the versions of the libraries. Every dataset has
``description`` and ``units``. Chunks hold one pair, and each has a Fletcher-32 checksum of its own,
so that reading some rows notices damage too. Equal content gives equal bytes.
"""

from __future__ import annotations

import hashlib
import os
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import scipy

from dine import __version__
from dine.data.names import deformation_of
from dine.data.sampling import SurfaceSamples
from dine.errors import ConfigError, DataError
from dine.files import atomic_path, digest
from dine.geometry.frame import Frame
from dine.io import announced

PAIRS_FORMAT = "dine-pairs"
VARIANT_FORMAT = "dine-variant"
FORMAT_VERSION = 1

SPLITS = ("train", "val", "test")

RESAMPLED = "resampled"
"""Condition of targets whose points were drawn independently of the source's."""

_TEXT = "text"
_NORMALISED = "of the normalised frame"
_FILE_UNITS = "of the source file"
# name: (type, shape of a row with N for the number of points, units, description)
PAIR_DATASETS = {
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
        _conform(self, PAIR_DATASETS, *np.shape(self.source)[:2])
        unknown = set(self.split.tolist()) - set(SPLITS)
        if unknown:
            raise DataError(f"Unknown split {min(unknown)!r}; expected one of {', '.join(SPLITS)}.")

    def __len__(self) -> int:
        return len(self.source)

    @property
    def known(self) -> np.ndarray:
        """(P,) bool: whether some pair of the same object is trained on."""
        return np.isin(self.object, self.object[self.split == "train"])

    @property
    def cluster(self) -> np.ndarray:
        """(P,) str: what intervals draw whole, since it is what pairs of one split share by chance.

        The deformation where the object is known (one may come at several levels), otherwise the
        object.
        """
        both = zip(self.object.tolist(), self.name.tolist(), strict=True)
        deformations = [f"{name}/{deformation_of(pair)}" for name, pair in both]
        return np.where(self.known, np.array(deformations, dtype=str), self.object)

    @property
    def displacement(self) -> np.ndarray:
        """(P, N, 3) float32 true displacements, normalised frame."""
        return self.target - self.source

    @property
    def checksum(self) -> str:
        """Identifies the pairs as written; rows selected from them keep it."""
        return str(self.attributes.get("checksum") or _checksum(_encoded(self, PAIR_DATASETS)))

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
        return replace(self, **{name: getattr(self, name)[rows] for name in PAIR_DATASETS})

    def to_original(self, points: np.ndarray, i: int) -> np.ndarray:
        """Points (..., 3) of pair i from the normalised frame to the units of its files."""
        return self.frame(i).restore(np.asarray(points, dtype=np.float64))

    def frame(self, i: int) -> Frame:
        """The normalised frame of pair i."""
        return Frame(self.center[i], self.scale[i])

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
        columns = {name: np.concatenate([getattr(s, name) for s in sets]) for name in PAIR_DATASETS}
        return cls(**columns, attributes=attributes)


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
    _write(path, PAIRS_FORMAT, PAIR_DATASETS, pairs, {**pairs.attributes, **versions})


def read_pairs(path: str | os.PathLike, split: str | None = None) -> PairSet:
    """Read a pair file, or the rows of one split of it (none, where the split is empty).

    The whole file is checked against its checksum; a split, chunk by chunk.

    Raises:
        ConfigError: unknown split.
        DataError: the file is missing, truncated, damaged, or something else.
    """
    with _opened(path, PAIRS_FORMAT, PAIR_DATASETS) as (file, attributes):
        if split is None:
            columns = _read_columns(file, PAIR_DATASETS)
            _verify(columns, attributes)
        else:
            parts = _read_columns(file, {"split": PAIR_DATASETS["split"]})["split"]
            rows = _rows_of(_decoded({"split": parts})["split"], split)
            columns = _read_columns(file, PAIR_DATASETS, rows)
        return PairSet(**_decoded(columns), attributes=attributes)


@dataclass(frozen=True, eq=False)
class Variant:
    """Corrupted targets of some pairs, row by row; the clean ones stay in the ``PairSet``.

    Attributes:
        condition: ``noise``, ``outliers`` or ``resampled``.
        level: standard deviation of the noise in the normalised frame, or percent of outliers.
        target: (P, M, 3) float32, normalised frame; row i < N is still point i of the clean target,
            except where they were ``resampled``.
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
    some, variant = _read_common(path, pairs)
    if len(some) < len(pairs):
        known = set(some.name.tolist())
        missing = [name for name in pairs.name.tolist() if name not in known]
        raise _other_pairs(path, f"it lacks {len(missing)} of them, such as {missing[0]!r}")
    return variant


def read_variant_subset(path: str | os.PathLike, pairs: PairSet) -> tuple[PairSet, Variant]:
    """The pairs that a variant has, in the order of ``pairs``, and its rows in the same order.

    Raises:
        DataError: the file is missing, truncated, damaged or something else, was made from other
            pairs, or has none of these.
    """
    some, variant = _read_common(path, pairs)
    if len(some) == 0:
        raise _other_pairs(path, "it has none of them")
    return some, variant


def _read_common(path: str | os.PathLike, pairs: PairSet) -> tuple[PairSet, Variant]:
    """The pairs that a variant made from them has, possibly none, and its rows of these."""
    with _opened(path, VARIANT_FORMAT, _VARIANT_DATASETS) as (file, attributes):
        columns = _read_columns(file, _VARIANT_DATASETS)
        _verify(columns, attributes)
        columns = _decoded(columns)
        condition, level = str(attributes["condition"]), float(attributes["level"])
        made_from = attributes["pairs"]
    if made_from != pairs.checksum:
        raise _other_pairs(path)
    position = {name: row for row, name in enumerate(columns["name"].tolist())}
    found = np.array([name in position for name in pairs.name.tolist()], dtype=bool)
    some = pairs if found.all() else pairs.select(index=found)
    rows = np.array([position[name] for name in some.name.tolist()], dtype=np.intp)
    return some, Variant(
        condition, level, **{name: values[rows] for name, values in columns.items()}
    )


def _other_pairs(path: str | os.PathLike, reason: str = "") -> DataError:
    return DataError(
        f"{path} was made from other pairs than those given{f' ({reason})' if reason else ''}; "
        "delete it and run the same command again."
    )


def read_seen(
    pairs_paths: Sequence[Path], targets_paths: Sequence[Path] | None, split: str
) -> tuple[PairSet, np.ndarray | None]:
    """The pairs of a split of some files, and the targets (P, M, 3) that networks see instead.

    Args:
        pairs_paths: pair files.
        targets_paths: variants of all pairs of each, or None for the pairs' own targets.
        split: ``train``, ``val`` or ``test``.

    Raises:
        ConfigError: not one file of targets for each of pairs.
        DataError: a file is missing, damaged, or made from other pairs.
    """
    if not targets_paths:
        return PairSet.concatenate([read_pairs(path, split=split) for path in pairs_paths]), None
    if len(targets_paths) != len(pairs_paths):
        raise ConfigError(
            f"There are {len(targets_paths)} files of targets for {len(pairs_paths)} of pairs; "
            "expected one for each."
        )
    sets, targets = [], []
    for pairs_path, targets_path in zip(pairs_paths, targets_paths, strict=True):
        pairs = read_pairs(pairs_path)
        rows = _rows_of(pairs.split, split)
        targets.append(read_variant(targets_path, pairs).target[rows])
        sets.append(pairs.select(index=rows))
    return PairSet.concatenate(sets), np.concatenate(targets)


def _rows_of(parts: np.ndarray, split: str) -> np.ndarray:
    if split not in SPLITS:
        raise ConfigError(f"Unknown split {split!r}; expected one of {', '.join(SPLITS)}.")
    return np.flatnonzero(parts == split)


def at_levels(pairs: PairSet, levels: Sequence[float]) -> PairSet:
    """The pairs of some deformation levels; all of them where none is given.

    Raises:
        DataError: there are no such pairs.
    """
    if not levels:
        return pairs
    rows = np.isclose(pairs.level[:, None], np.asarray(levels)[None]).any(axis=1)
    if not rows.any():
        found = ", ".join(f"{level:g}" for level in np.unique(pairs.level))
        asked = ", ".join(f"{level:g}" for level in levels)
        raise DataError(f"There are no pairs of the levels {asked}; there are {found}.")
    return pairs.select(index=rows)


def evaluated_pairs(
    pairs: PairSet, levels: Sequence[float] = (), most: int | None = None
) -> PairSet:
    """The test pairs of a whole file, of some levels where these are given, or ``most`` of them.

    These are evenly spread over the levels, and of known objects where there are any.

    Raises:
        DataError: there are no test pairs, or none of these levels.
    """
    some = at_levels(pairs.select(index=pairs.split == "test"), levels)
    if most is None or len(some) == 0:
        return some
    known = np.isin(some.name, pairs.name[pairs.known])
    if known.any():
        some = some.select(index=known)
    # Within a level, names in an order of chance, so that no object comes first.
    order = np.argsort([digest(["tested", name]) for name in some.name.tolist()], kind="stable")
    ranks = np.empty(len(some), int)
    for level in np.unique(some.level):
        here = order[some.level[order] == level]
        ranks[here] = np.arange(len(here))
    first = np.lexsort((some.level, ranks))[:most]
    return some.select(index=np.sort(first))


def keyed_rng(*key: Any) -> np.random.Generator:
    """A generator whose draws follow from the key alone (any JSON values)."""
    return np.random.default_rng(int(digest(list(key)), 16))


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
        with announced.hdf5(path) as file:
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
    except (*announced.DAMAGE, DataError) as error:
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
        data = announced.checked(file, name)
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
