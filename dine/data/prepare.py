"""From raw files to pairs, and how well the index convention holds in them."""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dine.config import Pairs
from dine.data.layout import Inventory, PairFiles, check_pair
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
from dine.data.splits import Row, Shares, split
from dine.errors import ConfigError, DataError
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
    shares = Shares(settings.split.model_dump(exclude={"by"}), settings.split.by)
    everything = Shares({"test": 1.0})
    sets = []
    with Progress("pairs", count, unit="pair") as bar:
        for number, (inventory, origin) in enumerate(found):
            pairs, _ = make_pairs(
                inventory,
                points=settings.points,
                convention=settings.convention,
                shares=everything if test_only or number else shares,
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
    shares: Shares,
    seed: int,
    origin: str = "files",
    progress: Callable[[int, int], None] | None = None,
) -> tuple[PairSet, list[tuple[str, str]]]:
    """Sample the pairs of condition ``deformation`` and split them.

    Points are drawn on the source and found again on the target. The draw is keyed by seed and
    object, and the convention is computed once for each distinct undeformed surface, so that all
    targets of an object share points and order. Pairs are split as :func:`dine.data.splits.split`
    says.

    Attributes of the result: ``seed``, ``convention``, ``points``, ``origin``, ``split_rule``
    (``objects``, ``deformations`` or ``published``), ``split_train``, ``split_val``,
    ``split_test`` (the fractions),
    ``split_leakage`` (objects in two parts of a published split, separated by commas),
    ``split_unknown`` (number of names in a published split that fit nothing), ``checksum``.

    Args:
        inventory: what ``dine.data.layout.scan`` found.
        points: N, points per cloud.
        convention: see ``dine.data.sampling.convention_order``.
        shares: of ``train``, ``val`` and ``test``.
        seed: >= 0.
        origin: where the data come from, such as ``"synthetic"``.
        progress: called with the numbers of pairs done and of all pairs.

    Returns:
        The pairs, grouped by split, and (id, reason) of every pair that was left out.

    Raises:
        ConfigError: unusable number of points or convention.
        DataError: no usable pair, or too few objects or deformations for the splits.
    """
    if points < 1:
        raise ConfigError(f"The number of points must be at least 1, found {points}.")
    rows, skipped = _sample_all(inventory, _Sampler(points, convention, seed), progress)
    parts, facts = split(rows, shares, seed, inventory.split)
    kept, unnamed = _in_parts(rows, parts)
    skipped += unnamed
    _report(inventory, kept, skipped)
    pairs = PairSet(
        **{column: np.array([row[column] for row in kept]) for column in PAIR_DATASETS},
        attributes={
            "seed": int(seed),
            "convention": convention,
            "points": int(points),
            "origin": origin,
            **facts,
            **{f"split_{part}": fraction for part, fraction in shares.fractions.items()},
        },
    )
    pairs.attributes["checksum"] = pairs.checksum
    return pairs, skipped


def _report(inventory: Inventory, kept: list[Row], skipped: list[tuple[str, str]]) -> None:
    """Log what was left out; raise where nothing is left."""
    for name, reason in skipped:
        _log.warning("Left out pair %s: %s", name, reason)
    if not kept:
        first = f"; the first of {len(skipped)}: {skipped[0][1]}" if skipped else ""
        raise DataError(
            f"{inventory.folder} holds no usable pair of a source and its deformed target{first}"
        )


def _in_parts(rows: list[Row], parts: list[str | None]) -> tuple[list[Row], list[tuple[str, str]]]:
    """The rows that have a part, grouped by it; the names of the others, with the reason."""
    kept, unnamed = [], []
    for row, part in zip(rows, parts, strict=True):
        if part is None:
            reason = "the published split names neither the pair nor its object"
            unnamed.append((row["name"], reason))
        else:
            kept.append(row | {"split": part})
    # Reading one split is then reading one run of rows.
    return sorted(kept, key=lambda row: SPLITS.index(row["split"])), unnamed


# --- from files to points ---------------------------------------------------------------------


def _sample_all(
    inventory: Inventory, sampler: _Sampler, progress: Callable[[int, int], None] | None
) -> tuple[list[Row], list[tuple[str, str]]]:
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

    def pair(self, files: PairFiles) -> Row:
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
