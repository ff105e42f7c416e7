"""Displacement fields on disk (HDF5): those of the training split, and predictions."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import h5py
import numpy as np

from dine.errors import DataError
from dine.files import atomic_path
from dine.io import announced

FIELDS_FORMAT = "dine-fields"
"""Fields of one model on the training split, at the top level of the file."""


_TRAINING = ("displacement", "source", "true")


@contextmanager
def opened(path: str | os.PathLike, expected: str) -> Iterator[h5py.File]:
    """An HDF5 file of ours for reading; ``expected`` is its attribute ``format``.

    Raises:
        DataError: missing, damaged, of another format, or lacking what the block reads.
    """
    try:
        with announced.hdf5(path) as file:
            if str(file.attrs.get("format")) != expected:
                raise DataError(f"{path} is of another kind than {expected}.")
            yield file
    except FileNotFoundError:
        raise DataError(f"{path} does not exist; run the step that makes it first.") from None
    except announced.DAMAGE as error:
        reason = " ".join(str(error).split())
        raise DataError(f"{path} is damaged ({reason}); delete it and run again.") from error


@dataclass(frozen=True)
class TrainingFields:
    """What priors are fitted to, (K, N, 3) float32 each, normalised frame.

    Attributes:
        displacement: predicted by a Stage-1 model.
        source: the points that move.
        true: their true displacements.
        convention: the order of the points.
    """

    displacement: np.ndarray
    source: np.ndarray
    true: np.ndarray
    convention: str = "none"


def put_fields(group: h5py.Group, pair: np.ndarray, displacement: np.ndarray) -> None:
    """Store (P, N, 3) fields in the normalised frame and the (P,) names of their pairs."""
    put_numbers(
        group, "displacement", displacement, "(P, N, 3) predicted displacements, normalised frame"
    )
    put_names(group, pair)


def put_numbers(
    group: h5py.Group, name: str, values: np.ndarray, description: str, *, by_row: bool = True
) -> None:
    """Store an array with a checksum for each of its rows, or for as much as HDF5 likes."""
    chunks = (1, *values.shape[1:]) if by_row else None
    data = group.create_dataset(name, data=values, chunks=chunks, fletcher32=True)
    data.attrs["description"] = description


def put_names(group: h5py.Group, pair: np.ndarray) -> None:
    """Store (P,) pair names."""
    group.create_dataset("pair", data=pair.astype(object), dtype=h5py.string_dtype())


def get_names(group: h5py.Group, count: int) -> np.ndarray:
    """The (P,) pair names of a group.

    Raises:
        ValueError: there are more or fewer than ``count``.
    """
    data = announced.checked(group, "pair")
    if data.shape != (count,):
        raise ValueError(f"{count} names of pairs are needed, and there is {data.shape}")
    return data.asstr()[:].astype(str)


def get_text(item: h5py.HLObject, name: str) -> str:
    """A text attribute.

    Raises:
        KeyError: it is missing.
        ValueError: it is something else.
    """
    value = item.attrs[name]
    if not isinstance(value, str):
        raise ValueError(f"its attribute {name!r} is no text")
    return value


def get_numbers(
    group: h5py.Group, name: str, shape: tuple[int | None, ...], dtype: str = "f4"
) -> np.ndarray:
    """A finite array of floats, such as fields (P, N, 3); None fits any number of rows.

    Raises:
        DataError: missing, or larger than the file.
        ValueError: of another type or shape, or with NaN or infinite values.
    """
    data = announced.checked(group, name)
    fits = len(data.shape) == len(shape) and all(
        want in (None, have) for want, have in zip(shape, data.shape, strict=True)
    )
    if data.dtype != dtype or not fits:
        raise ValueError(f"the array {name!r} has type {data.dtype} and shape {data.shape}")
    values = data[()]
    if not np.isfinite(values).all():
        raise ValueError(f"the array {name!r} holds NaN or infinite values")
    return values


def write_training_fields(
    path: str | os.PathLike, pair: np.ndarray, fields: TrainingFields, **facts: str
) -> None:
    """Write the fields of the training split atomically; ``pair`` (K,) names them."""
    with atomic_path(path) as temporary, h5py.File(temporary, "w") as file:
        file.attrs.update(format=FIELDS_FORMAT, convention=fields.convention, **facts)
        put_fields(file, pair, fields.displacement)
        for name, what in zip(_TRAINING[1:], ("source points", "true displacements"), strict=True):
            put_numbers(file, name, getattr(fields, name), f"(K, N, 3) {what}, normalised frame")


def read_fields(path: str | os.PathLike) -> TrainingFields:
    """The training fields that a prior is fitted to.

    Raises:
        DataError: missing, damaged, or another kind of file.
    """
    with opened(path, FIELDS_FORMAT) as file:
        values = [get_numbers(file, name, (None, None, 3)) for name in _TRAINING]
        if len({array.shape for array in values}) > 1:
            raise ValueError("its fields and sources are of different shapes")
        return TrainingFields(*values, convention=get_text(file, "convention"))
