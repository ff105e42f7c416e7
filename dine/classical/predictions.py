"""Test pairs registered without a network."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from dine.classical.methods import CLASSICAL
from dine.errors import ConfigError
from dine.evaluation.conditions import each_pair, evaluation_conditions, write_predictions
from dine.files import file_digest


def classical_predictions(
    pairs_path: Path,
    variants: list[Path],
    out: Path,
    *,
    algorithm: str,
    arguments: dict[str, Any],
    name: str,
) -> None:
    """Register the test split and its variants with a classical method, and write all fields.

    Raises:
        ConfigError: unknown method or arguments.
    """
    try:
        method = CLASSICAL.get(algorithm)(**arguments)
    except TypeError as error:
        raise ConfigError(
            f"The method {algorithm!r} does not take these arguments: {error}."
        ) from None
    write_predictions(
        out,
        evaluation_conditions(pairs_path, variants),
        lambda condition: each_pair(condition, name, lambda _, *clouds: method(*clouds)),
        pairs=file_digest(pairs_path),
        name=name,
    )
