"""What formats have in common: names of files, marks before text, lines that say nothing."""

from __future__ import annotations

import codecs
import re
from collections.abc import Iterable
from pathlib import Path

# Of two marks that begin alike the longer one comes first.
_MARKS = {
    codecs.BOM_UTF8: "utf-8",
    codecs.BOM_UTF32_LE: "utf-32",
    codecs.BOM_UTF32_BE: "utf-32",
    codecs.BOM_UTF16_LE: "utf-16",
    codecs.BOM_UTF16_BE: "utf-16",
}
# What text of ASCII letters begins with in a coding of several bytes a letter, without a mark.
_UNMARKED = {
    rb"(?:[\t-~]\0\0\0){2}": "utf-32-le",
    rb"(?:\0\0\0[\t-~]){2}": "utf-32-be",
    rb"(?:[\t-~]\0){2}": "utf-16-le",
    rb"(?:\0[\t-~]){2}": "utf-16-be",
}
_ENCODING = re.compile(rb"""(<\?xml[^>]*?)\s+encoding\s*=\s*(?:"[^"]*"|'[^']*')""")
# What some systems and copies leave behind the end of a text.
_BEHIND = b"\0\x1a"
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

    UTF-16 and UTF-32 are told by their mark, or by the zeros between the letters.

    Raises:
        ValueError: begins as UTF-16 or UTF-32 and is not that.
    """
    for mark, coding in _MARKS.items():
        if data.startswith(mark):
            if coding == "utf-8":
                return data[len(mark) :]
            return _ENCODING.sub(rb"\1", data.decode(coding).encode(), count=1)
    for begin, coding in _UNMARKED.items():
        if re.match(begin, data):
            return _ENCODING.sub(rb"\1", data.decode(coding).encode(), count=1)
    return data


def decoded(data: bytes) -> str:
    """Text in UTF-8 or, where it is none, as Windows writes it in western Europe."""
    data = data.rstrip(_BEHIND)
    try:
        return data.decode()
    except UnicodeDecodeError:
        return data.decode("cp1252", "replace")


def rows(data: bytes, comment: bytes = b"#") -> list[bytes]:
    """Lines that hold something, without comments."""
    lines = (line.partition(comment)[0].strip() for line in data.rstrip(_BEHIND).splitlines())
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
