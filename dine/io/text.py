"""What formats have in common: names of files, marks before text, lines that say nothing."""

from __future__ import annotations

import codecs
import re
from collections.abc import Iterable
from pathlib import Path

_SPACE = re.compile(rb"SPACE\s*=\s*(LPS|RAS)\b", re.IGNORECASE)


def format_suffix(path: Path) -> str:
    """The suffix that says the format: lower case, not ``.gz``, of two parts where needed."""
    name = path.name.lower().removesuffix(".gz")
    return ".mrk.json" if name.endswith(".mrk.json") else Path(name).suffix


def format_stem(path: Path) -> str:
    """The name without what :func:`format_suffix` gives, and without ``.gz``."""
    name = path.name[: -len(".gz")] if path.suffix.lower() == ".gz" else path.name
    return name[: len(name) - len(format_suffix(path))]


def without_mark(data: bytes) -> bytes:
    """Content as UTF-8 without a byte order mark, which editors on Windows put before text.

    Raises:
        ValueError: marked as UTF-16 and not that.
    """
    if data.startswith(codecs.BOM_UTF8):
        return data[len(codecs.BOM_UTF8) :]
    if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return data.decode("utf-16").encode()
    return data


def rows(data: bytes, comment: bytes = b"#") -> list[bytes]:
    """Lines that hold something, without comments."""
    lines = (line.partition(comment)[0].strip() for line in data.splitlines())
    return [line for line in lines if line]


def stated_space(data: bytes) -> str | None:
    """``LPS`` or ``RAS``, as 3D Slicer states it near the beginning of meshes that it writes."""
    found = _SPACE.search(data[:1000])
    return found[1].decode().upper() if found else None


def refuse_more(rows: Iterable[bytes], what: str) -> None:
    """Refuse further rows of numbers behind those that a header announces; other text is harmless.

    Raises:
        ValueError: there are such rows.
    """
    if any(re.match(rb"[-+.\d]+(?:\s+[-+.\d]|$)", row) for row in rows):
        raise ValueError(f"it holds more rows of {what} than its header announces")
