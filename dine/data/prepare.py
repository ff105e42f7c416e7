"""From raw files to pairs, and how well the index convention holds in them."""

from __future__ import annotations

import hashlib
import logging
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from dine.config import Pairs
from dine.data.layout import Inventory, PairFiles, check_pair
from dine.data.names import deformation_of
from dine.data.obtain import obtained
from dine.data.pairs import (
    PAIR_DATASETS,
    RESAMPLED,
    SPLITS,
    PairSet,
    Variant,
    at_levels,
    evaluated_pairs,
    keyed_rng,
    read_pairs,
    write_pairs,
    write_variant,
)
from dine.data.sampling import (
    SurfaceSamples,
    convention_order,
    neighbourhood_agreement,
    sample_surface,
)
from dine.errors import ConfigError, DataError
from dine.files import digest
from dine.geometry.frame import Frame
from dine.geometry.surface import Surface
from dine.io.readers import read_surface
from dine.progress import Progress

_log = logging.getLogger(__name__)


def prepare_pairs(
    raw: Path,
    settings: Pairs,
    *,
    seed: int,
    out: Path,
    test_only: bool = False,
    unseen: Path | None = None,
) -> None:
    """Make all pairs of a dataset and write them; broken pairs are reported and left out.

    With ``test_only`` all objects are for testing, whatever the settings' split. All pairs of the
    raw files ``unseen`` are for testing too; their objects must be others.

    Raises:
        DataError: no usable pair, too few base objects or deformations to split, or an object both
            in the dataset and among the unseen ones.
    """
    found = [obtained(path) for path in (raw, unseen) if path is not None]
    count = sum(len(inventory.clean) for inventory, _ in found)
    split = settings.split.model_dump(exclude={"by"})
    everything = dict.fromkeys(split, 0.0) | {"test": 1.0}
    sets = []
    with Progress("pairs", count, unit="pair") as bar:
        for number, (inventory, origin) in enumerate(found):
            pairs, _ = make_pairs(
                inventory,
                points=settings.points,
                convention=settings.convention,
                split=everything if test_only or number else split,
                by="object" if test_only or number else settings.split.by,
                seed=seed,
                origin=origin,
                progress=lambda done, total: bar.update(),
            )
            sets.append(pairs)
    both = set(sets[0].object.tolist()).intersection(*(x.object.tolist() for x in sets[1:]))
    if len(sets) > 1 and both:
        raise DataError(
            f"{unseen} has objects that are in {raw} too, such as {min(both)!r}; unseen objects "
            "must be others, so rename or remove them."
        )
    pairs = PairSet.concatenate(sets)
    pairs.attributes["checksum"] = pairs.checksum
    write_pairs(out, pairs)


def resample_targets(
    raws: Sequence[Path],
    pairs_path: Path,
    *,
    seed: int,
    out: Path,
    levels: Sequence[float] = (),
    most: int | None = None,
) -> None:
    """Write targets whose points were drawn anew: same surfaces, no point-to-point counterpart.

    Two scans of one object never share points. The result is a variant of condition
    ``resampled`` (level 1) of all pairs in the file, or of those of some deformation levels; or,
    with ``most``, of so many test pairs (:func:`dine.data.pairs.evaluated_pairs`). Draws are keyed
    by seed and object.

    Raises:
        DataError: the pairs were not made from these raw files.
    """
    pairs = read_pairs(pairs_path)
    checksum = pairs.checksum
    pairs = at_levels(pairs, levels) if most is None else evaluated_pairs(pairs, levels, most)
    files = files_of(raws, pairs, pairs_path)
    targets = np.empty_like(pairs.target)
    with Progress("resampled targets", len(pairs), unit="pair") as bar:
        for row, pair in enumerate(files):
            source, target = read_surface(pair.source), read_surface(pair.target)
            check_pair(source, target, pair.name)
            rng = keyed_rng(seed, "resampled", pair.object)
            drawn = sample_surface(source, targets.shape[1], rng).places(target.vertices)
            targets[row] = pairs.frame(row).normalise(drawn)
            bar.update()
    inlier = np.ones(targets.shape[:2], bool)
    write_variant(out, Variant(RESAMPLED, 1.0, targets, inlier, pairs.name), checksum)


def files_of(raws: Sequence[Path], pairs: PairSet, name: Path) -> list[PairFiles]:
    """The files that each pair of a set, read from the file ``name``, was made from.

    Raises:
        DataError: a pair was not made from these raw files.
    """
    files = {pair.id: pair for path in raws for pair in obtained(path)[0].clean}
    missing = [pair for pair in pairs.name.tolist() if pair not in files]
    if missing:
        raise DataError(
            f"{name} was not made from {' and '.join(map(str, raws))}, which lacks {missing[0]!r}."
        )
    return [files[pair] for pair in pairs.name.tolist()]


def measure_agreement(path: Path, *, seed: int) -> dict[str, object]:
    """Neighbourhood agreement of index i across the distinct sources of a pairs file."""
    pairs = read_pairs(path)
    _, first = np.unique(pairs.object, return_index=True)
    found = neighbourhood_agreement(pairs.source[np.sort(first)], rng=np.random.default_rng(seed))
    return {"convention": str(pairs.attributes["convention"]), **found}


def make_pairs(
    inventory: Inventory,
    *,
    points: int,
    convention: str,
    split: Mapping[str, float],
    by: str = "object",
    seed: int,
    origin: str = "files",
    progress: Callable[[int, int], None] | None = None,
) -> tuple[PairSet, list[tuple[str, str]]]:
    """Sample the pairs of condition ``deformation`` and split them.

    Points are drawn on the source and found again on the target. The draw is keyed by seed and
    object, and the convention is computed once for each distinct undeformed surface, so that all
    targets of an object share points and order.

    Without a published split, objects are shuffled by ``seed`` and shared out by fraction, at least
    one to each split whose fraction is not zero; or, ``by`` deformation, the pairs of each object
    are, as evenly over levels as can be. Pairs of one object and name stay together there, since
    they may be one deformation at several levels. A published split (``inventory.split``) is kept
    as it is: by pair id or name where it has that, otherwise by object; objects in two of its parts
    are logged and kept. Where it has no ``val``, some of its training objects become ``val``, or,
    where all of these (but one) are tested on as well, some of their deformations.

    Attributes of the result: ``seed``, ``convention``, ``points``, ``origin``, ``split_rule``
    (``objects``, ``deformations`` or ``published``), ``split_train``, ``split_val``,
    ``split_test`` (the fractions),
    ``split_leakage`` (objects in two parts of a published split, separated by commas),
    ``split_unknown`` (number of names in a published split that fit nothing), ``checksum``.

    Args:
        inventory: what ``dine.data.layout.scan`` found.
        points: N, points per cloud.
        convention: see ``dine.data.sampling.convention_order``.
        split: fractions for ``train``, ``val`` and ``test``; they sum to 1.
        by: what these are fractions of, ``object`` or ``deformation``.
        seed: >= 0.
        origin: where the data come from, such as ``"synthetic"``.
        progress: called with the numbers of pairs done and of all pairs.

    Returns:
        The pairs, grouped by split, and (id, reason) of every pair that was left out.

    Raises:
        ConfigError: unusable fractions, number of points or convention.
        DataError: no usable pair, or too few objects or deformations for the splits.
    """
    if points < 1:
        raise ConfigError(f"The number of points must be at least 1, found {points}.")
    fractions = _checked_fractions(split)
    rows, skipped = _sample_all(inventory, _Sampler(points, convention, seed), progress)
    if inventory.split is None:
        # Without any row, the reasons for that say more than the number of objects.
        parts = _share_out(rows, fractions, by, seed) if rows else []
        facts = {"split_rule": f"{by}s", "split_leakage": "", "split_unknown": 0}
    else:
        parts, facts = _published_split(rows, inventory.split, fractions, seed)
    kept = []
    for row, part in zip(rows, parts, strict=True):
        if part is None:
            reason = "the published split names neither the pair nor its object"
            skipped.append((row["name"], reason))
        else:
            kept.append(row | {"split": part})
    for name, reason in skipped:
        _log.warning("Left out pair %s: %s", name, reason)
    if not kept:
        first = f"; the first of {len(skipped)}: {skipped[0][1]}" if skipped else ""
        raise DataError(
            f"{inventory.folder} holds no usable pair of a source and its deformed target{first}"
        )
    # Reading one split is then reading one run of rows.
    kept.sort(key=lambda row: SPLITS.index(row["split"]))
    pairs = PairSet(
        **{column: np.array([row[column] for row in kept]) for column in PAIR_DATASETS},
        attributes={
            "seed": int(seed),
            "convention": convention,
            "points": int(points),
            "origin": origin,
            **facts,
            **{f"split_{part}": fraction for part, fraction in fractions.items()},
        },
    )
    pairs.attributes["checksum"] = pairs.checksum
    return pairs, skipped


# --- from files to points ---------------------------------------------------------------------


_Row = dict[str, Any]


def _sample_all(
    inventory: Inventory, sampler: _Sampler, progress: Callable[[int, int], None] | None
) -> tuple[list[_Row], list[tuple[str, str]]]:
    """All columns but the split, row by row, and the pairs that have none, with reasons."""
    every = inventory.clean
    rows, skipped, names = [], [], set()
    for done, files in enumerate(every, start=1):
        name = files.id
        try:
            if name in names:
                raise DataError(f"{files.target}: another pair is called {name} too; rename one.")
            names.add(name)
            row = sampler.pair(files)
        except DataError as error:
            skipped.append((name, str(error)))
        else:
            row |= {"name": name, "object": files.object, "level": files.level}
            for role in ("source", "target"):
                row[f"{role}_file"] = _relative(getattr(files, role), inventory.folder)
            rows.append(row)
        if progress is not None:
            progress(done, len(every))
    return rows, skipped


@dataclass(frozen=True)
class _Sampled:
    samples: SurfaceSamples
    source: np.ndarray
    frame: Frame


class _Sampler:
    """Samples pairs, and each distinct undeformed surface of an object only once."""

    def __init__(self, points: int, convention: str, seed: int):
        self.points, self.convention, self.seed = points, convention, seed
        self._known: dict[tuple[str, bytes], _Sampled] = {}

    def pair(self, files: PairFiles) -> _Row:
        """The columns of one pair that come from its surfaces."""
        if files.level is None:
            raise DataError(
                f"{files.target} has no deformation level; put it into a folder named after the "
                "level, such as Deformation_Level/0.3, or give a manifest the column 'level'."
            )
        source, target = read_surface(files.source), read_surface(files.target)
        check_pair(source, target, files.name)
        sampled = self._sampled(files.object, source)
        with np.errstate(over="ignore"):
            moved = sampled.frame.normalise(sampled.samples.places(target.vertices))
            moved = moved.astype(np.float32)
        if not np.isfinite(moved).all():
            raise DataError(
                f"{files.target} lies too far from its source to be given in its frame; check the "
                "units of both."
            )
        return {
            "source": sampled.source,
            "target": moved,
            "center": sampled.frame.center,
            "scale": sampled.frame.scale,
            "vertex_index": sampled.samples.faces_vertices.astype(np.int32),
            "vertex_weight": sampled.samples.weights,
        }

    def _sampled(self, name: str, surface: Surface) -> _Sampled:
        faces = b"" if surface.faces is None else surface.faces.tobytes()
        key = (name, hashlib.sha256(surface.vertices.tobytes() + faces).digest())
        if key not in self._known:
            self._known[key] = self._sample(name, surface)
        return self._known[key]

    def _sample(self, name: str, surface: Surface) -> _Sampled:
        # Not keyed by the coordinates, so that a change of units or position changes no draw.
        rng = keyed_rng(self.seed, name)
        samples = sample_surface(surface, self.points, rng)
        points = samples.places(surface.vertices)
        frame = Frame.of(points, surface.name)
        points = frame.normalise(points)
        order = convention_order(points, self.convention)
        return _Sampled(samples[order], points[order].astype(np.float32), frame)


def _relative(path: Path, folder: Path) -> str:
    path = Path(path)
    return path.relative_to(folder).as_posix() if path.is_relative_to(folder) else path.name


# --- splits -----------------------------------------------------------------------------------


def _checked_fractions(split: Mapping[str, float]) -> dict[str, float]:
    unknown = sorted(set(split) - set(SPLITS))
    fractions = {part: float(split.get(part, 0.0)) for part in SPLITS}
    values = np.array(list(fractions.values()))
    if unknown or not (values >= 0).all() or not np.isclose(values.sum(), 1.0):
        raise ConfigError(
            "The split needs fractions for train, val and test that are not negative and sum to "
            f"1, found {dict(split)}."
        )
    return fractions


def _share_out(rows: list[_Row], fractions: Mapping[str, float], by: str, seed: int) -> list[str]:
    """The part of each row."""
    if by == "deformation":
        return _split_deformations(rows, fractions, seed)
    by_object = _split_objects({row["object"] for row in rows}, fractions, seed)
    return [by_object[row["object"]] for row in rows]


def _split_deformations(rows: list[_Row], fractions: Mapping[str, float], seed: int) -> list[str]:
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
    rows: list[_Row],
    published: Mapping[str, str],
    fractions: Mapping[str, float],
    seed: int,
) -> tuple[list[str | None], dict[str, str | int]]:
    """Part of each row, None where the split does not name it, and attributes about the split."""
    # The level is part of an id, but a published split may name files without their folders.
    candidates = [(row["name"], deformation_of(row["name"]), row["object"]) for row in rows]
    parts = [
        next((published[name] for name in names if name in published), None) for names in candidates
    ]
    unknown = sorted(set(published).difference(*candidates))
    if unknown:
        _log.warning(
            "%d names in the published split fit no usable pair: %s%s",
            len(unknown),
            ", ".join(unknown[:5]),
            ", ..." if len(unknown) > 5 else "",
        )
    objects = [row["object"] for row in rows]
    homes: dict[str, set[str]] = {}
    for name, part in zip(objects, parts, strict=True):
        if part is not None:
            homes.setdefault(name, set()).add(part)
    leaking = sorted(name for name, where in homes.items() if len(where) > 1)
    if leaking:
        _log.warning(
            "The published split has pairs of the same object in several parts, so results on "
            "test pairs are not results on unseen objects; objects: %s",
            ", ".join(leaking),
        )
    training = {name for name, where in homes.items() if "train" in where}
    if training and fractions["val"] > 0 and "val" not in parts:
        # An object that is tested on as well would leak into the choice of λ.
        apart = training - set(leaking)
        total = fractions["train"] + fractions["val"]
        shares = {part: fractions[part] / total for part in ("train", "val")}
        if len(apart) < len(shares):
            apart = set()
        carved = [
            index
            for index, part in enumerate(parts)
            if part == "train" and objects[index] in (apart or training)
        ]
        by = "object"
        if not apart:
            # Where all (but one) are known, deformations of those that have several are not.
            names = {(objects[index], deformation_of(rows[index]["name"])) for index in carved}
            count = Counter(name for name, _ in names)
            several = [index for index in carved if count[objects[index]] >= len(shares)]
            by, carved = ("deformation", several) if several else (by, carved)
        found = _share_out([rows[index] for index in carved], shares, by, seed)
        for index, part in zip(carved, found, strict=True):
            parts[index] = part
    return parts, {
        "split_rule": "published",
        "split_leakage": ", ".join(leaking),
        "split_unknown": len(unknown),
    }
