"""Ids of pairs, ``<level>/<name>``: names repeat from level to level."""

from __future__ import annotations


def pair_id(level: float | None, name: str) -> str:
    """The id of a pair of some level, or the bare name where that is unknown."""
    return name if level is None else f"{level:g}/{name}"


def deformation_of(pair: str) -> str:
    """The part of a pair's id that pairs of one deformation at several levels share."""
    return pair.split("/", 1)[-1]
