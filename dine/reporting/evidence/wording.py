"""How the report says things: marks, numbers and lists as text."""

from __future__ import annotations

import re
from collections.abc import Sequence

import pandas as pd

from dine.reporting.tables import CD_SCALE

DASH = "–"
LOWER, HIGHER, PARTIAL = "▼", "▲", "†"
MARKS = {"lower": f" {LOWER}", "higher": f" {HIGHER}", "none": ""}
VALUES = {
    "mce": ("mean correspondence error", "MCE", 1.0, 4),
    "cd": ("Chamfer distance", "CD", CD_SCALE, 2),
}
"""Compared values by column: long name, short name, factor and decimals shown."""


def join(names: Sequence[str]) -> str:
    """``a, b and c``."""
    return " and ".join([", ".join(names[:-1]), names[-1]] if len(names) > 1 else names)


def capital(text: str) -> str:
    return text[0].upper() + text[1:]


def count_of(count: int, noun: str) -> str:
    return f"{count} {noun}{'' if count == 1 else 's'}"


def are(count: int) -> str:
    return "is" if count == 1 else "are"


def minus(text: str) -> str:
    return text.replace("-", "−")


def number(value: float, decimals: int, scale: float = 1.0) -> str:
    # Adding 0 makes −0 a 0.
    return DASH if pd.isna(value) else minus(f"{round(scale * value, decimals) + 0:.{decimals}f}")


def signed(value: float, decimals: int) -> str:
    return DASH if pd.isna(value) else minus(f"{round(value, decimals) + 0:+.{decimals}f}")


def percent(share: float) -> str:
    return number(share, 1, 100)


def p_value(value: float) -> str:
    if pd.isna(value):
        return DASH
    return "< 0.001" if value < 0.001 else f"{value:.3f}"


def slug(*names: str) -> str:
    """A name for a file from names that may hold anything."""
    return "_".join(re.sub(r"[^A-Za-z0-9_.-]+", "-", name).strip("-.") or "x" for name in names)
