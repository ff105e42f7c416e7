"""Mutations of valid files: of their bytes, of their numbers, and of what their headers announce.

Every function takes bytes and a random generator and returns bytes; equal draws, equal bytes.
"""

from __future__ import annotations

import copy
import io
import json
import re
import struct
import tarfile
import zipfile
import zlib
from collections.abc import Callable
from typing import Any

import h5py
import numpy as np

Mutation = Callable[[bytes, np.random.Generator], bytes]

INTEGERS = (0, 1, -1, 2, 3, 127, 255, 256, 65535, 10**6, 2**31 - 1, -(2**31), 2**32 - 1)
LARGE = (10**9, 2**31 - 1, 2**32, 10**10, 2**40, 2**62, 2**63 - 1)
FLOATS = (0.0, -0.0, -1.0, 1e-300, 1e38, 1e308, float("nan"), float("inf"), float("-inf"))
TEXTS = (
    *("0", "-1", "1", "2", "99", "65536", "1000000000", "4294967296", "9223372036854775808"),
    *("-9999999999", "1e400", "nan", "-inf", "1e308", "0x10", "1_0", "", "x", "1" * 5000),
)
VALUES: tuple[Any, ...] = (
    *(None, True, False, 0, -1, 1, 1.5, 2**31, 2**63, 10**30, 1e308, float("nan"), float("inf")),
    *("", "x", "..", "../x", "/etc/passwd", "\0", "\ud800", "os:getcwd", "é" * 300, "1" * 5000),
    *([], {}, [None], [[]], {"": None}, [1, 2, 3], {"a": {"b": {"c": []}}}),
)


def pick(rng: np.random.Generator, values):
    """One of the values, as it is."""
    return values[int(rng.integers(len(values)))]


def place(rng: np.random.Generator, size: int) -> int:
    """An offset, near the beginning as often as anywhere: that is where headers are."""
    return int(rng.integers(min(size, 256) if rng.random() < 0.5 else size))


# --- bytes ------------------------------------------------------------------------------------


def flip(data: bytes, rng: np.random.Generator) -> bytes:
    changed = bytearray(data)
    for _ in range(int(rng.integers(1, 9))):
        changed[place(rng, len(changed))] ^= 1 << int(rng.integers(8))
    return bytes(changed)


def truncate(data: bytes, rng: np.random.Generator) -> bytes:
    return data[: place(rng, len(data))]


def remove(data: bytes, rng: np.random.Generator) -> bytes:
    start = place(rng, len(data))
    return data[:start] + data[start + int(rng.integers(1, 65)) :]


def duplicate(data: bytes, rng: np.random.Generator) -> bytes:
    start = place(rng, len(data))
    block = data[start : start + int(rng.integers(1, 257))]
    return data[:start] + block * int(rng.integers(2, 5)) + data[start:]


def insert(data: bytes, rng: np.random.Generator) -> bytes:
    start = place(rng, len(data))
    block = rng.bytes(int(rng.integers(1, 65))) if rng.random() < 0.5 else bytes(32)
    return data[:start] + block + data[start:]


def number(data: bytes, rng: np.random.Generator) -> bytes:
    """A number of 1, 2, 4 or 8 bytes that is huge, negative, or none."""
    if rng.random() < 0.7:
        size = pick(rng, (1, 2, 4, 4, 8))
        value = pick(rng, INTEGERS + LARGE) % 2 ** (8 * size)
        packed = value.to_bytes(size, pick(rng, ("little", "big")))
    else:
        value = pick(rng, FLOATS)
        kind = pick(rng, ("<f", ">f", "<d", ">d"))
        if kind[1] == "f" and 1e38 < abs(value) < float("inf"):
            value = 1e38
        packed = struct.pack(kind, value)
    start = place(rng, len(data))
    return data[:start] + packed + data[start + len(packed) :]


BYTES: tuple[Mutation, ...] = (flip, truncate, remove, duplicate, insert, number, number)


# --- text -------------------------------------------------------------------------------------


def text_number(data: bytes, rng: np.random.Generator) -> bytes:
    """A number, or another word, replaced by one that nobody expects."""
    pattern = rb"-?\d+(\.\d+)?([eE][+-]?\d+)?" if rng.random() < 0.8 else rb"[A-Za-z_]+"
    found = list(re.finditer(pattern, data))
    if not found:
        return flip(data, rng)
    first = rng.random() < 0.5
    where = found[int(rng.integers(min(8, len(found)) if first else len(found)))]
    return data[: where.start()] + pick(rng, TEXTS).encode() + data[where.end() :]


def lines(data: bytes, rng: np.random.Generator) -> bytes:
    rows = data.split(b"\n")
    one, other = (int(rng.integers(len(rows))) for _ in range(2))
    what = int(rng.integers(4))
    if what == 0:
        rows[one], rows[other] = rows[other], rows[one]
    elif what == 1:
        del rows[one]
    elif what == 2:
        rows.insert(other, rows[one])
    else:
        rows[one] = rows[one] * int(rng.integers(2, 40))
    return b"\n".join(rows)


TEXT: tuple[Mutation, ...] = (*BYTES, text_number, text_number, text_number, lines)


# --- JSON -------------------------------------------------------------------------------------


def changed_json(value: Any, rng: np.random.Generator) -> Any:
    """A JSON value with one to three of its parts replaced, taken away, repeated or nested."""
    value = copy.deepcopy(value)
    for _ in range(int(rng.integers(1, 4))):
        spots: list[tuple[Any, Any]] = []
        waiting, seen = [value], set()
        while waiting:
            part = waiting.pop()
            if id(part) in seen:  # YAML may hold a part several times, or itself
                continue
            seen.add(id(part))
            keys = part if isinstance(part, dict) else range(len(part))
            for key in keys:
                spots.append((part, key))
                if isinstance(part[key], dict | list):
                    waiting.append(part[key])
        if not spots:
            return pick(rng, VALUES)
        holder, key = pick(rng, spots)
        what = int(rng.integers(10))
        if what < 6:
            holder[key] = copy.deepcopy(pick(rng, VALUES + LARGE))
        elif what == 6:
            del holder[key]
        elif what == 7 and isinstance(holder, list):
            holder.insert(0, copy.deepcopy(holder[key]))
        elif what == 8:
            holder[key] = copy.deepcopy(pick(rng, spots)[0])
        else:
            holder[key] = [holder[key]]
    return value


def json_values(data: bytes, rng: np.random.Generator) -> bytes:
    if rng.random() < 0.03:
        return b"[" * 100_000
    return json.dumps(changed_json(json.loads(data), rng)).encode()


JSON: tuple[Mutation, ...] = (flip, truncate, text_number, lines, *5 * (json_values,))


def glb_json(data: bytes, rng: np.random.Generator) -> bytes:
    """A binary glTF whose JSON part is changed and whose lengths are right again."""
    size = struct.unpack("<I", data[12:16])[0]
    text = json.dumps(changed_json(json.loads(data[20 : 20 + size]), rng)).encode()
    text += b" " * (-len(text) % 4)
    rest = data[20 + size :]
    head = struct.pack("<4sIIII", b"glTF", 2, 20 + len(text) + len(rest), len(text), 0x4E4F534A)
    return head + text + rest


def safetensors_header(data: bytes, rng: np.random.Generator) -> bytes:
    """Tensors' types, shapes and places, or the facts of ours in the metadata, changed."""
    size = struct.unpack("<Q", data[:8])[0]
    header = json.loads(data[8 : 8 + size])
    if rng.random() < 0.8:
        facts = json.loads(header["__metadata__"]["dine"])
        if rng.random() < 0.5:
            facts[pick(rng, sorted(facts))] = copy.deepcopy(pick(rng, VALUES))
        else:
            facts = changed_json(facts, rng)
        header["__metadata__"]["dine"] = json.dumps(facts)
    else:
        header = changed_json(header, rng)
    text = json.dumps(header).encode()
    return struct.pack("<Q", len(text)) + text + data[8 + size :]


# --- arrays and archives ----------------------------------------------------------------------


def npy_header(data: bytes, rng: np.random.Generator) -> bytes:
    """An array whose header announces another shape or type than it holds."""
    stream = io.BytesIO(data)
    np.lib.format.read_magic(stream)
    shape, order, dtype = np.lib.format.read_array_header_1_0(stream)
    shape = list(shape)
    if rng.random() < 0.8:
        shape[int(rng.integers(len(shape)))] = pick(rng, INTEGERS + LARGE)
    else:
        shape = pick(rng, ([], [3], [2, 3, 4], [2**31, 2**31], [0, 3], [1, 10**9]))
    kind = dtype.str if rng.random() < 0.7 else pick(rng, ("|O", "<U9", "<c16", "|V12", "<f2", "?"))
    head = io.BytesIO()
    header = {"descr": kind, "fortran_order": bool(order), "shape": tuple(shape)}
    np.lib.format.write_array_header_1_0(head, header)
    return head.getvalue() + data[stream.tell() :]


def zip_members(change: Mutation) -> Mutation:
    """An archive one of whose members is changed, forged in size, hostile in name, or a bomb."""

    def mutate(data: bytes, rng: np.random.Generator) -> bytes:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            members = {info.filename: archive.read(info) for info in archive.infolist()}
        name = pick(rng, sorted(members))
        what = int(rng.integers(6))
        if what == 0:
            members[name] += bytes(300_000_000)
        elif what == 1:
            hostile = ("../out", "/tmp/out", "a/../../out", "C:out", "..\\out", "\0", "é" * 300)
            members[pick(rng, hostile)] = members.pop(name)
        elif what < 5:
            members[name] = change(members[name], rng)
        packed = io.BytesIO()
        with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
            for member, content in members.items():
                info = zipfile.ZipInfo(member)
                info.compress_type = zipfile.ZIP_DEFLATED
                archive.writestr(info, content, compresslevel=1)
        changed = bytearray(packed.getvalue())
        if what == 5:  # sizes in the list of members
            start = changed.rfind(b"PK\1\2") + int(pick(rng, (20, 24)))
            changed[start : start + 4] = struct.pack("<I", pick(rng, INTEGERS) % 2**32)
        return bytes(changed)

    return mutate


def tar_members(data: bytes, rng: np.random.Generator) -> bytes:
    """A tar whose first member is a link, a device, hostile in name, or forged in size."""
    compressed = data[:2] == b"\x1f\x8b"
    plain = bytearray(zlib.decompress(data, 31) if compressed else data)
    info = tarfile.TarInfo.frombuf(bytes(plain[:512]), "utf-8", "surrogateescape")
    what = int(rng.integers(4))
    if what == 0:
        info.name = pick(rng, ("../out", "/tmp/out", "a/../../out", "C:out", "..\\out", "x" * 300))
    elif what == 1:
        info.type = pick(rng, (*b"123456xgLKS7",)).to_bytes()
        info.linkname = pick(rng, ("..", "/etc/passwd", "x"))
    elif what == 2:
        info.size = pick(rng, INTEGERS[:2] + LARGE)
    else:
        plain += bytes(300_000_000) if compressed else bytes(512)
        info.size = len(plain) - 1024
    plain[:512] = info.tobuf(tarfile.GNU_FORMAT)[-512:]
    if not compressed:
        return bytes(plain)
    packer = zlib.compressobj(1, wbits=31)
    return packer.compress(bytes(plain)) + packer.flush()


def mat_elements(data: bytes, rng: np.random.Generator) -> bytes:
    """A MATLAB file whose compressed variable is changed before it is compressed again."""
    kind, size = struct.unpack("<II", data[128:136])
    if kind != 15:
        return number(data, rng)
    inner = bytearray(zlib.decompress(data[136 : 136 + size]))
    what = int(rng.integers(4))
    if what == 0:
        inner += bytes(300_000_000)
        inner[4:8] = struct.pack("<I", len(inner) - 8)
    elif what == 1:  # the dimensions
        start = int(pick(rng, (32, 36)))
        inner[start : start + 4] = struct.pack("<I", pick(rng, INTEGERS) % 2**32)
    elif what == 2:  # class and flags
        inner[16:20] = struct.pack("<I", int(rng.integers(18)) | int(rng.integers(16)) << 8)
    else:
        inner = bytearray(number(bytes(inner), rng))
    packed = zlib.compress(bytes(inner), 1)
    return data[:128] + struct.pack("<II", 15, len(packed)) + packed + data[136 + size :]


# --- HDF5 -------------------------------------------------------------------------------------


def hdf5_objects(data: bytes, rng: np.random.Generator) -> bytes:
    """An HDF5 file one of whose datasets or attributes is of another shape, type or kind."""
    stream = io.BytesIO(data)
    with h5py.File(stream, "r+") as file:
        found: list[h5py.HLObject] = [file]
        file.visititems(lambda _, item: found.append(item))
        if rng.random() < 0.3:
            holder = pick(rng, [item for item in found if len(item.attrs)] or [None])
            if holder is not None:
                name = pick(rng, sorted(holder.attrs))
                del holder.attrs[name]
                value = pick(
                    rng, (*VALUES[3:10], "x", "dine-pairs", [1.0, 2.0], b"\xff", h5py.Empty("f"))
                )
                if rng.random() < 0.8:
                    holder.attrs[name] = value if not isinstance(value, int) else float(value)
        else:
            data_sets = [item for item in found if isinstance(item, h5py.Dataset)]
            _replace(pick(rng, data_sets), rng)
    return stream.getvalue()


def _replace(old: h5py.Dataset, rng: np.random.Generator) -> None:
    group, name, shape, dtype = old.parent, old.name.rsplit("/", 1)[1], old.shape, old.dtype
    if old.size is None or old.size > 1_000_000:
        raise ValueError("it is huge already")
    content = old[()]
    attributes = dict(old.attrs)
    del group[name]
    what = int(rng.integers(10))
    if what == 0:
        return
    if what == 1:
        group.create_group(name)
        return
    if what == 2:  # never written, so that it takes no room in the file
        huge = (int(pick(rng, LARGE[:4])), *shape[1:])
        new = group.create_dataset(name, huge, dtype, chunks=(1, *shape[1:]))
    elif what == 3:  # compressed zeros
        huge = (60_000_000 // max(1, int(np.prod(shape[1:]))), *shape[1:])
        chunks = (max(1, huge[0] // 4), *shape[1:])
        new = group.create_dataset(name, huge, "<f8", chunks=chunks, compression="gzip")
        new[: chunks[0]] = 0
    elif what == 4:
        kinds = ("<i2", ">f8", "<c16", "S3", "?", h5py.string_dtype(), h5py.ref_dtype)
        kind = pick(rng, (*kinds, np.dtype([("a", "<f4")])))
        new = group.create_dataset(name, shape, kind)
    elif what == 5:
        new = group.create_dataset(name, data=h5py.Empty(dtype))
    elif what == 6:
        group[name] = h5py.SoftLink(pick(rng, ("/", f"/{name}", "/nowhere", "..")))
        return
    elif what == 7:
        group[name] = h5py.ExternalLink(pick(rng, ("/etc/passwd", "other.h5", ".")), "/x")
        return
    elif what == 8 and dtype.kind == "f" and content.size:
        content = np.array(content)
        content.flat[int(rng.integers(content.size))] = pick(rng, FLOATS)
        new = group.create_dataset(name, data=content, dtype=dtype)
    else:
        axis = int(rng.integers(len(shape))) if shape else 0
        content = np.concatenate([content] * 2, axis) if shape else np.zeros(2)
        new = group.create_dataset(name, data=content, dtype=dtype if shape else None)
    for key, value in attributes.items():
        new.attrs[key] = value


def mutated(data: bytes, mutations: tuple[Mutation, ...], rng: np.random.Generator) -> bytes:
    """One or, at times, several of the mutations; where one does not apply, bytes are flipped."""
    for _ in range(1 if rng.random() < 0.6 else int(rng.integers(2, 5))):
        try:
            data = pick(rng, mutations)(data, rng)
        except Exception:  # what is mutated already need not be well-formed any more
            if data:
                data = flip(data, rng)
    return data
