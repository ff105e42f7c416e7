"""What several priors need of the sources: told apart, split into folds, prepared once each."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Hashable, Iterator
from typing import Generic, TypeVar

import numpy as np
from torch import Tensor

from dine.errors import ConfigError, DataError

T = TypeVar("T")


def check_sources(source: np.ndarray | None, fields: np.ndarray, name: str) -> np.ndarray:
    """The sources of (K, N, 3) fields as (K, N, 3) float64, for a prior called ``name``.

    Raises:
        ConfigError: there are none.
        DataError: another shape than the fields, or values that are not finite.
    """
    if source is None:
        raise ConfigError(
            f"The prior {name!r} depends on the points that move, and is fitted to fields together "
            "with their sources; none were given."
        )
    source = np.asarray(source, dtype=np.float64)
    if source.shape != fields.shape:
        raise DataError(
            f"The prior {name!r} needs one source point per displacement; found sources of shape "
            f"{source.shape} for fields of shape {fields.shape}."
        )
    if not np.isfinite(source).all():
        raise DataError("The source points hold NaN or infinite values.")
    return source


def members(
    displacement: Tensor, mask: Tensor | None, source: Tensor | None, name: str
) -> Iterator[tuple[Tensor, np.ndarray]]:
    """Each member of a batch (B, N, 3) without what ``mask`` leaves out: field and source (n, 3).

    Raises:
        ConfigError: no source, which the prior called ``name`` depends on.
        DataError: the source has another shape than the displacement.
    """
    if source is None:
        raise ConfigError(
            f"The prior {name!r} depends on the points that move; pass them as `source`."
        )
    if source.shape != displacement.shape:
        raise DataError(
            f"The prior {name!r} needs one source point per displacement; found a source of shape "
            f"{tuple(source.shape)} for a displacement of shape {tuple(displacement.shape)}."
        )
    points = source.detach().cpu().numpy()
    if mask is None:
        yield from zip(displacement, points, strict=True)
        return
    for field, cloud, valid in zip(displacement, points, mask, strict=True):
        yield field[valid], cloud[valid.cpu().numpy()]


def one_source(source: Tensor | np.ndarray | None, name: str) -> np.ndarray:
    """The points (N, 3) of the one source that fields are drawn for.

    Raises:
        ConfigError: none was given.
        DataError: another shape.
    """
    if source is None:
        raise ConfigError(
            f"The prior {name!r} depends on the points that move; pass them as `source`."
        )
    points = source.detach().cpu().numpy() if isinstance(source, Tensor) else np.asarray(source)
    if points.ndim != 2 or points.shape[1] != 3:
        raise DataError(f"Expected a source of shape (N, 3), found {points.shape}.")
    return points


def source_labels(source: np.ndarray | None, count: int) -> np.ndarray:
    """(K,) int: equal where fields have the same source; all different where it is not known."""
    if source is None:
        return np.arange(count)
    known: dict[bytes, int] = {}
    return np.array([known.setdefault(points.tobytes(), len(known)) for points in source])


def held_out_folds(labels: np.ndarray, folds: int, seed: int) -> list[np.ndarray]:
    """(K,) bool for each fold, True at the fields held out in it.

    Fields of one source are alike, so a source's fields stay together where there are at least two
    sources.
    """
    if len(np.unique(labels)) < 2:
        labels = np.arange(len(labels))
    order = np.random.default_rng(seed).permutation(np.unique(labels))
    return [np.isin(labels, part) for part in np.array_split(order, min(folds, len(order)))]


class SourceCache(Generic[T]):
    """What was last made for some sources, since a training sees the same ones again and again."""

    def __init__(self, size: int = 256):
        self.size = size
        self._entries: dict[Hashable, T] = {}

    def get(self, points: np.ndarray, key: Hashable, make: Callable[[], T]) -> T:
        """The entry of points (N, 3) and all else that it depends on; made where it is missing."""
        digest = hashlib.blake2b(np.ascontiguousarray(points), digest_size=16).digest()
        key = (digest, points.shape, points.dtype.str, key)
        entry = self._entries.pop(key, None)
        if entry is None:
            entry = make()
        self._entries[key] = entry  # the newest is last
        while len(self._entries) > self.size:
            self._entries.pop(next(iter(self._entries)))
        return entry
