"""What files announce about their own size, checked before memory is taken for it.

A few bytes of a header can announce terabytes, and a few of a compressed file can hold them. An
array that is stored as it is cannot be larger than its file; one that is compressed is taken to be
at most ``RATIO`` times larger, which coordinates never are.
"""

from __future__ import annotations

import contextlib
import io
import math
import mmap
import os
import pickletools
import struct
import zipfile
import zlib
from collections.abc import Iterator

import h5py
import numpy as np

from dine.errors import DataError

RATIO = 100
"""Largest factor by which compressed data may grow; that of meshes and points is below 20."""

SMALL = 1 << 20
"""Bytes that compressed data may always grow to."""

DAMAGE = (OSError, RuntimeError, KeyError, ValueError, TypeError, AttributeError, OverflowError)
"""What HDF5, or decoding what it read, raises; which one depends on where the damage is."""

# HDF5 filters that leave the size as it is: shuffle and the Fletcher-32 checksum.
_NO_COMPRESSION = (h5py.h5z.FILTER_SHUFFLE, h5py.h5z.FILTER_FLETCHER32)


def limit(stored: int) -> int:
    """Bytes that so many compressed ones may grow to."""
    return max(SMALL, RATIO * stored)


def check(path: str | os.PathLike, what: str, announced: int, allowed: int) -> None:
    """Refuse a size that a file cannot hold.

    Raises:
        DataError: naming both sizes.
    """
    if announced > allowed:
        raise DataError(
            f"{path} is damaged, cut short or not what it says: {what} announces {announced} "
            f"bytes, and {allowed} are possible; copy it again or make it again."
        )


# --- HDF5 -------------------------------------------------------------------------------------


_SIGNATURE = b"\x89HDF\r\n\x1a\n"
_HEAP = b"GCOL\x01\0\0\0"


@contextlib.contextmanager
def hdf5(path: str | os.PathLike) -> Iterator[h5py.File]:
    """An HDF5 file for reading, whose heaps of texts do not send the library round for ever.

    Raises:
        DataError: a heap, or an object in one, is larger than what it lies in, or smaller than its
            own header.
            Or the file is open in another program.
        OSError: no HDF5 file, or damaged in other ways.
    """
    if os.path.isfile(path) and os.path.getsize(path):
        with (
            open(path, "rb") as stream,
            mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) as content,
        ):
            _check_heaps(path, content)
    try:
        file = h5py.File(path, "r")
    except BlockingIOError as error:
        raise DataError(
            f"{path} is open in another program that writes to it; close it there, and try again."
        ) from error
    with file:
        yield file


def hdf5_start(content: bytes | mmap.mmap) -> int | None:
    """Where HDF5 begins in a file, behind what other programs put first; None in other files."""
    places = (0, *(512 << doublings for doublings in range(32)))
    return next((at for at in places if content[at : at + 8] == _SIGNATURE), None)


def _check_heaps(path: str | os.PathLike, content: mmap.mmap) -> None:
    """Walk through the global heaps as the library does (HDF5 file format 3.0, III.E)."""
    begin = hdf5_start(content)
    if begin is None or len(content) < begin + 16:
        return
    # Bytes of a length, after the version of the file's first block; other numbers are not written.
    if content[begin + (14 if content[begin + 8] < 2 else 10)] != 8:
        return
    start = content.find(_HEAP)
    while start >= 0:
        (size,) = struct.unpack_from("<Q", content[start + 8 : start + 16].ljust(8, b"\0"))
        check(path, "a heap", size, len(content) - start)
        at, end = start + 16, start + size
        while at + 16 <= end:
            number, length = struct.unpack_from("<H6xQ", content, at)
            # What is free says its own length, header included.
            step = 16 + -(-length // 8) * 8 if number else length
            check(path, "a text in a heap", step, end - at)
            if step < 16:
                raise DataError(
                    f"{path} is damaged: a heap of its texts does not end; make it again."
                )
            at += step
        start = content.find(_HEAP, start + 8)


def checked(group: h5py.Group, name: str) -> h5py.Dataset:
    """A dataset of an HDF5 file, not read yet: inside the file, and no larger than it can be.

    Raises:
        DataError: it is missing, no array, or lies in another file or behind a link.
    """
    path = group.file.filename
    link = group.get(name, getlink=True)
    data = group[name] if isinstance(link, h5py.HardLink) else None
    if not isinstance(data, h5py.Dataset) or data.shape is None:
        raise DataError(f"{path}: {name!r} is missing or no array; make the file again.")
    if data.is_virtual or data.external:
        raise DataError(
            f"{path}: the array {name!r} lies in another file, which is not read; copy it in."
        )
    settings = data.id.get_create_plist()
    filters = {settings.get_filter(i)[0] for i in range(settings.get_nfilters())}
    size = os.path.getsize(path)
    announced = math.prod(data.shape) * data.dtype.itemsize
    packed = not filters.issubset(_NO_COMPRESSION)
    check(path, f"the array {name!r}", announced, limit(size) if packed else size)
    if h5py.h5z.FILTER_FLETCHER32 in filters:
        _check_chunks(path, name, data)
    return data


def _check_chunks(path: str, name: str, data: h5py.Dataset) -> None:
    """Make sure that every stored chunk has room for its checksum: the library does not look."""

    def look(chunk: h5py.h5d.StoreInfo) -> None:
        if chunk.size < 4:
            short.append(chunk.size)

    short: list[int] = []
    data.id.chunk_iter(look)
    if short:
        raise DataError(
            f"{path} is damaged: a chunk of {name!r} has {short[0]} bytes; make it again."
        )


# --- NumPy ------------------------------------------------------------------------------------


def npy_array(path: str | os.PathLike, content: bytes) -> np.ndarray:
    """The array of a ``.npy`` file; pickled objects are refused.

    Raises:
        DataError: it announces more than it holds.
        ValueError: no such file, or one with objects.
    """
    stream = io.BytesIO(content)
    version = np.lib.format.read_magic(stream)
    if version == (1, 0):
        shape, _, dtype = np.lib.format.read_array_header_1_0(stream)
    elif version == (2, 0):
        shape, _, dtype = np.lib.format.read_array_header_2_0(stream)
    else:
        raise ValueError(f"version {version} of the format is not read")
    check(path, "its header", math.prod(shape) * dtype.itemsize, len(content) - stream.tell())
    stream.seek(0)
    return np.lib.format.read_array(stream, allow_pickle=False)


def member(path: str | os.PathLike, archive: zipfile.ZipFile, name: str, *, stored: int) -> bytes:
    """A member of a ZIP archive of so many bytes.

    Raises:
        DataError: it grows to more than compressed data can.
    """
    info = archive.getinfo(name)
    check(path, f"its member {name!r}", info.compress_size, stored)
    check(path, f"its member {name!r}", info.file_size, limit(info.compress_size))
    return archive.read(info)


def npz_arrays(path: str | os.PathLike) -> dict[str, np.ndarray]:
    """All arrays of a ``.npz`` file by name.

    Raises:
        DataError: a member grows to more than compressed data can, or announces more than it holds.
        ValueError: no such file, or one with objects; so are a few other exceptions of the parsers.
    """
    stored = os.path.getsize(path)
    with zipfile.ZipFile(path) as archive:
        return {
            name.removesuffix(".npy"): npy_array(path, member(path, archive, name, stored=stored))
            for name in archive.namelist()
        }


# --- MATLAB -----------------------------------------------------------------------------------

_MATRIX, _COMPRESSED = 14, 15
_NUMERIC = range(6, 16)  # classes of arrays: double, single and the integers
_BYTES = {1: 1, 2: 1, 3: 2, 4: 2, 5: 4, 6: 4, 7: 4, 9: 8, 12: 8, 13: 8}
_BYTES_4 = (8, 4, 4, 2, 2, 1)


def numeric_variables(path: str | os.PathLike, content: bytes) -> io.BytesIO:
    """A MATLAB file (version 4 or 5) with nothing but its whole numeric arrays, none compressed.

    SciPy takes memory as headers say, and can crash where there is not so much.

    Raises:
        DataError: an element announces more than the file holds.
        ValueError: not a MATLAB file.
    """
    if len(content) < 20:
        raise ValueError("it ends within its header")
    if 0 in content[:4]:
        _check_version_4(path, content)
        return io.BytesIO(content)
    order = {b"IM": "<", b"MI": ">"}.get(content[126:128])
    if order is None:
        raise ValueError("it has no mark of its byte order")
    kept = content[:128]
    start, grown = 128, 0
    while start + 8 <= len(content):
        kind, size = struct.unpack_from(f"{order}II", content, start)
        check(path, "an element", size, len(content) - start - 8)
        element = content[start + 8 : start + 8 + size]
        start += 8 + size
        if kind == _COMPRESSED:
            unpacker = zlib.decompressobj()
            header = unpacker.decompress(element, 8)
            if len(header) < 8:
                raise ValueError("a compressed element is cut short")
            kind, size = struct.unpack(f"{order}II", header)
            grown += size
            check(path, "its compressed content", grown, limit(len(content)))
            # No more than that, however much there is; of 0 bytes zlib would give all.
            element = unpacker.decompress(unpacker.unconsumed_tail, size) if size else b""
            check(path, "a compressed element", size, len(element))
        if kind == _MATRIX and _is_whole(element, order):
            kept += struct.pack(f"{order}II", kind, len(element)) + element
    return io.BytesIO(kept)


def _is_whole(matrix: bytes, order: str) -> bool:
    """Whether an element is a numeric array with as many numbers as its dimensions say."""
    parts, start = [], 0
    while start + 8 <= len(matrix):
        kind, size = struct.unpack_from(f"{order}II", matrix, start)
        if kind >> 16:  # up to four bytes are stored within the tag
            kind, size = kind & 0xFFFF, kind >> 16
            parts.append((kind, matrix[start + 4 : start + 4 + size], size))
            start += 8
        else:
            parts.append((kind, matrix[start + 8 : start + 8 + size], size))
            start += 8 + size + -size % 8
    if len(parts) < 4 or any(len(content) < size for _, content, size in parts):
        return False
    (_, flags, _), (kind, dimensions, _), _, *numbers = parts
    if kind != 5 or len(flags) != 8 or len(dimensions) % 4:
        return False
    flags = struct.unpack(f"{order}I", flags[:4])[0]
    lengths = struct.unpack(f"{order}{len(dimensions) // 4}i", dimensions)
    expected = math.prod(lengths) if min(lengths, default=-1) >= 0 else -1
    parts_expected = 2 if flags & 0x800 else 1  # complex numbers have two
    return (
        (flags & 0xFF) in _NUMERIC
        and len(numbers) == parts_expected
        and all(len(x) == expected * _BYTES.get(kind, -1) for kind, x, _ in numbers)
    )


def _check_version_4(path: str | os.PathLike, content: bytes) -> None:
    start = 0
    while start < len(content):
        for order in "<>":
            kind, *sizes = struct.unpack_from(f"{order}5i", content.ljust(start + 20, b"\0"), start)
            if 0 <= kind < 5000:
                break
        precision = kind // 10 % 10
        if min(sizes) < 0 or precision >= len(_BYTES_4) or kind % 10:
            raise ValueError("it holds something else than whole arrays of numbers")
        rows, columns, imaginary, name = sizes
        start += 20 + name
        size = rows * columns * _BYTES_4[precision] * (2 if imaginary else 1)
        check(path, "an array", size, max(0, len(content) - start))
        start += size


# --- PyTorch ----------------------------------------------------------------------------------


def check_pickled_sizes(path: str | os.PathLike, content: bytes) -> None:
    """Refuse a PyTorch file that speaks of a tensor with more numbers than the file has bytes.

    Its pickles are looked through, not executed.

    Raises:
        DataError: there is such a number.
        ValueError: the pickles are damaged.
    """
    if content[:2] == b"PK":
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            streams = [
                io.BytesIO(member(path, archive, name, stored=len(content)))
                for name in archive.namelist()
                if name.endswith("/data.pkl")
            ]
    else:
        stream = io.BytesIO(content)
        for _ in pickletools.genops(stream):  # a magic number, which is large
            pass
        # Protocol, machine, and what was saved.
        streams = [stream] * 3
    for stream in streams:
        for _, value, _ in pickletools.genops(stream):
            if isinstance(value, int):
                check(path, "a tensor", value, len(content))
