"""Which pairs are for training, which for validation and which for tests."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from dine.data.names import deformation_of
from dine.data.pairs import SPLITS
from dine.errors import ConfigError, DataError
from dine.files import digest

_log = logging.getLogger(__name__)

Row = dict[str, Any]
"""The columns of one pair; a split looks at its ``name``, ``object`` and ``level``."""


@dataclass(frozen=True)
class Shares:
    """How pairs are shared out where no split is published.

    Attributes:
        fractions: of ``train``, ``val`` and ``test``; 0 for those left out.
        by: what these are fractions of, ``object`` or ``deformation``.

    Raises:
        ConfigError: other names, or fractions that are negative or do not sum to 1.
    """

    fractions: Mapping[str, float]
    by: str = "object"

    def __post_init__(self):
        fractions = {part: float(self.fractions.get(part, 0.0)) for part in SPLITS}
        values = np.array(list(fractions.values()))
        unknown = set(self.fractions) - set(SPLITS)
        if unknown or not (values >= 0).all() or not np.isclose(values.sum(), 1.0):
            raise ConfigError(
                "The split needs fractions for train, val and test that are not negative and sum "
                f"to 1, found {dict(self.fractions)}."
            )
        object.__setattr__(self, "fractions", fractions)


def split(
    rows: list[Row], shares: Shares, seed: int, published: Mapping[str, str] | None = None
) -> tuple[list[str | None], dict[str, str | int]]:
    """Part of each row and what the pairs' attributes say about the split.

    Without a published split, objects are shuffled by ``seed`` and shared out by fraction, at least
    one to each split whose fraction is not zero; or, ``by`` deformation, the pairs of each object
    are, as evenly over levels as can be. Pairs of one object and name stay together there, since
    they may be one deformation at several levels.

    A published split is kept as it is: by pair id or name where it has that, otherwise by object,
    and None for rows that it does not name; objects in two of its parts are logged and kept. Where
    it has no ``val``, some of its training objects become ``val``, or, where all of these (but one)
    are tested on as well, some of their deformations.

    Raises:
        DataError: too few objects, or deformations of one, for the parts that are not to be empty.
    """
    if published is not None:
        return _published_split(rows, published, shares.fractions, seed)
    # Without any row, the reasons for that say more than the number of objects.
    parts = _share_out(rows, shares, seed) if rows else []
    return parts, {"split_rule": f"{shares.by}s", "split_leakage": "", "split_unknown": 0}


def _share_out(rows: list[Row], shares: Shares, seed: int) -> list[str]:
    """The part of each row."""
    if shares.by == "deformation":
        return _split_deformations(rows, shares.fractions, seed)
    by_object = _split_objects({row["object"] for row in rows}, shares.fractions, seed)
    return [by_object[row["object"]] for row in rows]


def _split_deformations(rows: list[Row], fractions: Mapping[str, float], seed: int) -> list[str]:
    """The part of each row, so that every object is in every part that is not to be empty.

    Rows of one object and name go together.
    """
    wanted = {part: fraction for part, fraction in fractions.items() if fraction > 0}
    objects: dict[str, dict[str, list[int]]] = {}
    for index, row in enumerate(rows):
        deformations = objects.setdefault(row["object"], {})
        deformations.setdefault(deformation_of(row["name"]), []).append(index)
    parts = [""] * len(rows)
    for name, deformations in objects.items():
        if len(deformations) < len(wanted):
            raise DataError(
                f"Splitting by deformation into {', '.join(wanted)} needs at least {len(wanted)} "
                f"deformations of every object, found {len(deformations)} of {name!r}; provide "
                "more, leave the object out, or split by object."
            )
        order = sorted(deformations, key=lambda group: digest([seed, "split", group]))
        levels = [[rows[index]["level"] for index in deformations[group]] for group in order]
        for group, part in zip(order, _share_levels(levels, wanted), strict=True):
            for index in deformations[group]:
                parts[index] = part
    return parts


def _share_levels(groups: list[list[float]], wanted: Mapping[str, float]) -> list[str]:
    """The part of each group of one object's pairs, whose levels are given, in their order.

    A group goes to the part that is farthest below its share of the pairs of these levels, and of
    those of the object; the last ones go where nothing is yet.
    """
    total = Counter(level for levels in groups for level in levels)
    counts: dict[str, Counter[float]] = {part: Counter() for part in wanted}
    parts = []
    for number, levels in enumerate(groups):
        empty = [part for part in wanted if not counts[part]]
        open_parts = empty if len(groups) - number <= len(empty) else list(wanted)
        lacking = {
            part: (
                sum(wanted[part] * total[level] - counts[part][level] for level in levels),
                wanted[part] * total.total() - counts[part].total(),
            )
            for part in open_parts
        }
        part = max(open_parts, key=lacking.__getitem__)
        counts[part].update(levels)
        parts.append(part)
    return parts


def _split_objects(objects: set[str], fractions: Mapping[str, float], seed: int) -> dict[str, str]:
    """Share objects out by fraction, with at least one to each part that is not to be empty."""
    wanted = {part: fraction for part, fraction in fractions.items() if fraction > 0}
    if len(objects) < len(wanted):
        raise DataError(
            f"Splitting by object into {', '.join(wanted)} needs at least {len(wanted)} objects "
            f"with usable pairs, found {len(objects)}; provide more objects, or set the share of a "
            "split to 0."
        )
    counts = dict.fromkeys(wanted, 1)
    for _ in range(len(objects) - len(wanted)):
        # The next object goes to the part that is farthest below its share.
        part = max(wanted, key=lambda part: wanted[part] * len(objects) - counts[part])
        counts[part] += 1
    shuffled = sorted(objects, key=lambda name: digest([seed, "split", name]))
    parts = [part for part, count in counts.items() for _ in range(count)]
    return dict(zip(shuffled, parts, strict=True))


def _published_split(
    rows: list[Row],
    published: Mapping[str, str],
    fractions: Mapping[str, float],
    seed: int,
) -> tuple[list[str | None], dict[str, str | int]]:
    # The level is part of an id, but a published split may name files without their folders.
    candidates = [(row["name"], deformation_of(row["name"]), row["object"]) for row in rows]
    parts = [
        next((published[name] for name in names if name in published), None) for names in candidates
    ]
    unknown = sorted(set(published).difference(*candidates))
    if unknown:
        _log.warning(
            "Names in the published split that fit no usable pair: %d (%s%s).",
            len(unknown),
            ", ".join(unknown[:5]),
            ", ..." if len(unknown) > 5 else "",
        )
    homes: dict[str, set[str]] = {}
    for row, part in zip(rows, parts, strict=True):
        if part is not None:
            homes.setdefault(row["object"], set()).add(part)
    leaking = sorted(name for name, where in homes.items() if len(where) > 1)
    if leaking:
        _log.warning(
            "The published split has pairs of the same object in several parts, so results on "
            "test pairs are not results on unseen objects; objects: %s",
            ", ".join(leaking),
        )
    training = {name for name, where in homes.items() if "train" in where}
    if training and fractions["val"] > 0 and "val" not in parts:
        total = fractions["train"] + fractions["val"]
        shares = {part: fractions[part] / total for part in ("train", "val")}
        # An object that is tested on as well would leak into the choice of λ.
        _carve_validation(rows, parts, training - set(leaking), shares, seed)
    return parts, {
        "split_rule": "published",
        "split_leakage": ", ".join(leaking),
        "split_unknown": len(unknown),
    }


def _carve_validation(
    rows: list[Row],
    parts: list[str | None],
    apart: set[str],
    shares: Mapping[str, float],
    seed: int,
) -> None:
    """Make some of the training rows validation rows, in place.

    Whole objects of those ``apart``, which are in no other part; where these are too few, some
    deformations of objects that have several.
    """
    carved = [index for index, part in enumerate(parts) if part == "train"]
    by = "object"
    if len(apart) >= len(shares):
        carved = [index for index in carved if rows[index]["object"] in apart]
    else:
        names = {(rows[i]["object"], deformation_of(rows[i]["name"])) for i in carved}
        count = Counter(name for name, _ in names)
        several = [index for index in carved if count[rows[index]["object"]] >= len(shares)]
        by, carved = ("deformation", several) if several else (by, carved)
    found = _share_out([rows[index] for index in carved], Shares(shares, by), seed)
    for index, part in zip(carved, found, strict=True):
        parts[index] = part
