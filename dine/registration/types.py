"""What travels together through a registration, and what it gives."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import KW_ONLY, dataclass, field, replace
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from dine.errors import ConfigError, DataError
from dine.geometry.distance import distances
from dine.geometry.interpolation import FittedDisplacement
from dine.geometry.rigid import Alignment
from dine.geometry.surface import Surface
from dine.refinement.surface import Guides
from dine.registration.calibration import Calibration
from dine.registration.objects import is_object
from dine.registration.shapes import Shape, as_surface, checked_points, dense_points

if TYPE_CHECKING:
    from dine.registration.grid import DisplacementGrid

# Share of the largest extent of landmarks that the second has at least, to align by them.
_CLEARLY = 0.1


class Overlap(StrEnum):
    """Which part of the object each scan shows."""

    AUTO = "auto"
    """Both the same; or, where that leaves much without counterpart, parts that overlap."""
    BOTH = "both"
    """Parts that overlap: each scan shows what the other does not."""
    SOURCE_IN_TARGET = "source-in-target"
    TARGET_IN_SOURCE = "target-in-source"

    @classmethod
    def of(cls, name: str) -> Overlap:
        """By name.

        Raises:
            ConfigError: another name.
        """
        try:
            return cls(name)
        except ValueError:
            raise ConfigError(
                f"The overlap is {name!r}; expected one of {', '.join(cls)}."
            ) from None


@dataclass(frozen=True)
class Model:
    """Weights with what belongs to them; see :func:`~dine.registration.model.load_model`."""

    backbone: Any
    weights: Path
    facts: dict[str, Any]
    prior: Any = None
    prior_path: Path | None = None
    calibration: Calibration | None = None

    @property
    def convention(self) -> str:
        """The order of points that the prior was fitted in; ``none`` where it does not say."""
        return str(self.prior.notes.get("convention", "none")) if self.prior else "none"

    def calibration_for(
        self, settings: Settings, found: Overlap = Overlap.AUTO
    ) -> Calibration | None:
        """The calibration where it applies: to what is registered as it was made with.

        ``found`` is the overlap that ``auto`` came to. Of parts that overlap, the posterior was
        found to say as much of errors as of wholes; of a part within a whole it is another.
        """
        if self.calibration is None or found not in (Overlap.AUTO, Overlap.BOTH):
            return None
        made = (self.calibration.facts.get("rounds"), self.calibration.facts.get("surfaces", False))
        return self.calibration if made == (settings.rounds, settings.surfaces) else None


@dataclass(frozen=True)
class Guide:
    """Corresponding places that a registration is to keep to.

    Attributes:
        here: (L, 3) in the source's coordinates.
        there: (L, 3) in the target's.
        error: standard deviation of each coordinate, in the units of the source; None for a
            hundredth of its radius.
    """

    here: np.ndarray
    there: np.ndarray
    error: float | None = None

    def __post_init__(self) -> None:
        if len(self.here) == 0:
            raise DataError("There are no landmarks to keep to; leave them out, or give some.")
        if self.error is not None and not 0 < self.error < float("inf"):
            raise ConfigError(f"The error of the guiding landmarks is {self.error}; expected > 0.")

    @property
    def tells_rotation(self) -> bool:
        """Whether the places are enough, and far enough from a line, to align by."""
        return min(_widths(self.here), _widths(self.there)) > _CLEARLY

    def within(self, alignment: Alignment) -> Guides:
        """In the normalised frame."""
        places = alignment.normalise(self.here)
        error = 0.01 if self.error is None else self.error / alignment.frame.scale
        return Guides(places, alignment.frame.normalise(self.there) - places, error)


def _widths(points: np.ndarray) -> float:
    """Second largest extent of (L, 3) points as a share of the largest."""
    widths = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return float(widths[1] / widths[0]) if len(widths) > 1 and widths[0] > 0 else 0.0


@dataclass(frozen=True)
class Settings:
    """How to register; as for :func:`~dine.registration.register.register`."""

    prealign: str | np.ndarray
    rounds: int
    overlap: Overlap
    points: int
    seed: int
    device: torch.device
    surfaces: bool = True
    guide: Guide | None = None

    def described(self, points: int) -> dict[str, Any]:
        """For the report; ``points`` were drawn."""
        return {
            "rounds": self.rounds,
            "surfaces": self.surfaces,
            "overlap": str(self.overlap),
            "partial": self.overlap is Overlap.TARGET_IN_SOURCE,
            "points": points,
            "seed": self.seed,
            "prealign": self.prealign if isinstance(self.prealign, str) else "given",
            "device": str(self.device),
            "guides": 0 if self.guide is None else len(self.guide.here),
        }


@dataclass(frozen=True)
class Pair:
    """Points of both scans, in the normalised frame of the aligned source.

    Attributes:
        source: as given.
        target: as given.
        alignment: between the source's coordinates, the target's and the frame.
        places: (N, 3) points drawn on the source, in its coordinates.
        start: (N, 3) the same in the frame.
        goal: (M, 3) points drawn on the target, in the frame.
    """

    source: Surface
    target: Surface
    alignment: Alignment
    places: np.ndarray
    start: np.ndarray
    goal: np.ndarray


@dataclass(frozen=True)
class Correspondence:
    """Where points of the source belong, in the normalised frame.

    Attributes:
        start: (N, 3) points of the source.
        goal: (M, 3) points of the target.
        field: (N, 3) displacement from ``start``.
        indicator: (N,) what tells its errors apart, which a calibration translates; None where
            nothing does.
        supported: (N,) bool, points that the target shows.
        inconsistency: mean distance from ``start`` of points registered to the target and back;
            None where that was not tried.
        anywhere: the field as a function of (M, 3) places, normalised frame; None where it is
            known at ``start`` only.
        improbability: −log of the evidence of the surfaces, up to a constant of the two scans; None
            where only points were looked at.
        unmet: share of the surface, of the scan that lacks less, that lies on none of the other,
            although this goes on there; None where only points were looked at.
        shown: shares of the source and of the target that the other shows; 0 where it is not known
            to.
        overlap: as which the scans were registered, ``both`` where ``auto`` found that parts are
            missing.
        rival: whether another way to lay parts on each other is about as probable.
        at_a_look: the least −log of the evidence that quick looks at the scans as parts found; None
            where none were needed.
    """

    start: np.ndarray
    goal: np.ndarray
    field: np.ndarray
    indicator: np.ndarray | None
    supported: np.ndarray
    inconsistency: float | None = None
    anywhere: Callable[[np.ndarray], np.ndarray] | None = None
    improbability: float | None = None
    unmet: float | None = None
    shown: tuple[float, float] = (1.0, 1.0)
    overlap: Overlap = Overlap.AUTO
    rival: bool = False
    at_a_look: float | None = None

    def interpolated(self) -> Callable[[np.ndarray], np.ndarray]:
        """The field as a function of (M, 3) places, normalised frame."""
        return self.anywhere or FittedDisplacement(self.start, self.field)

    @property
    def moved(self) -> np.ndarray:
        """(N, 3) where the points belong."""
        return self.start + self.field


@dataclass(frozen=True)
class Motion:
    """Moves any points of the source's coordinates to where they belong, in the target's."""

    alignment: Alignment
    field: Callable[[np.ndarray], np.ndarray]

    def __call__(self, points: np.ndarray) -> np.ndarray:
        """(V, 3) points, moved."""
        places = self.alignment.normalise(points)
        return self.alignment.restore(places + self.field(places))

    def surface(self, surface: Surface) -> Surface:
        """A surface with its vertices moved."""
        return replace(surface, vertices=self(surface.vertices))


@dataclass(frozen=True)
class ExpectedError:
    """Expected distance from the true place, in the units of the source.

    Attributes:
        vertices: (V,) of all vertices.
        points: (N,) of the drawn points.
    """

    vertices: np.ndarray
    points: np.ndarray

    @property
    def mean(self) -> float:
        """Over the surface."""
        return float(self.points.mean())


@dataclass(frozen=True)
class Trust:
    """What the report says about a result.

    Attributes:
        verdict: ``plausible``, ``doubtful`` (unlike the validation pairs in some way, or a
            result that a check speaks against) or ``implausible`` (folded, or far outside what the
            training fields look like).
        reasons: plain sentences, empty where there is nothing to say.
        percentiles: of this result among the validation pairs, by name, 0 to 100.
        expected_error: mean over the surface, in the units of the source; None without calibration.
    """

    verdict: str
    reasons: tuple[str, ...]
    percentiles: dict[str, float]
    expected_error: float | None


@dataclass(frozen=True)
class RegistrationResult:
    """A source moved onto a target. All lengths are in the units of the source.

    Attributes:
        source: as given.
        target: as given.
        moved: the source with its vertices moved, same order and faces.
        displacement: (V, 3) moved minus source vertices; includes the rigid alignment.
        uncertainty: (V,) expected distance from the true place, or None without calibration; with a
            prior of the organ, the posterior standard deviation.
        applied: moved further points or surfaces, by name.
        points: (n, 3) sampled source points that the network saw, where they are in the source.
        point_displacement: (n, 3) of these.
        point_uncertainty: (n,) of these, or None.
        supported: (n,) bool, points that the target shows.
        trust: how far to trust the result.
        report: everything that the JSON report says.
        alignment: of the source to the target, and the normalised frame there.
        motion: the field itself, which moves any points.
        bound: (V,) distance from the true place that 90 % are to stay below; None without a prior
            of the organ.
        applied_from: (M, 3) where the vertices of each of ``applied`` were, by name.
    """

    source: Surface
    target: Surface
    moved: Surface
    displacement: np.ndarray
    uncertainty: np.ndarray | None
    applied: dict[str, Surface]
    points: np.ndarray
    point_displacement: np.ndarray
    point_uncertainty: np.ndarray | None
    supported: np.ndarray
    trust: Trust
    report: dict[str, Any] = field(default_factory=dict)
    _: KW_ONLY
    alignment: Alignment
    motion: Motion
    bound: np.ndarray | None = None
    applied_from: dict[str, np.ndarray] = field(default_factory=dict)

    def __repr__(self) -> str:
        error = self.trust.expected_error
        measures = (f"{self.report[when]['hd95']:.3g}" for when in ("before", "after"))
        return (
            f"<RegistrationResult {self.source.name} → {self.target.name}: "
            f"HD95 {' → '.join(measures)}, {self.trust.verdict}"
            + (f", expected error {error:.3g}>" if error is not None else ">")
        )

    def transform(self, shape: Shape) -> Any:
        """Move anything that lies in the source's coordinates.

        Farther than two radii from the object, points follow its rigid motion.

        Args:
            shape: (M, 3) points, or whatever ``register`` takes as a scan.

        Returns:
            The moved points as an array (M, 3), or the moved surface of anything else.

        Raises:
            DataError: unreadable, other shapes, or numbers that are not finite.
        """
        if isinstance(shape, Surface | str | Path | tuple) or is_object(shape):
            return self.motion.surface(as_surface(shape, "shape"))
        return self.motion(checked_points(shape))

    def displacement_grid(
        self,
        spacing: float | None = None,
        *,
        margin: float | None = None,
        inverse: bool = False,
        space: str | None = None,
    ) -> DisplacementGrid:
        """What :meth:`transform` does, on a grid that 3D Slicer and ITK apply (LPS).

        Args:
            spacing: of the voxels, in the units of the source; by default a 64th of the longest
                side.
            margin: how far beyond the source's box the grid goes; by default a tenth of the box's
                longest side.
            inverse: from the target back to the source, around the moved source: what ITK resamples
                an image of the source by.
            space: ``lps`` or ``ras``, the coordinates of the scans; by default what the source's
                file states, or LPS, as 3D Slicer takes it.

        Returns:
            The grid, whose ``write`` makes a file of it.

        Raises:
            ConfigError: a spacing or margin that is no length, more than 5 million voxels, or
                another space than the source states.
        """
        from dine.registration.grid import displacement_grid

        return displacement_grid(self, spacing, margin=margin, inverse=inverse, space=space)

    def save(
        self, folder: str | Path, *, suffix: str = ".ply", view: bool = False, overwrite=False
    ) -> list[str]:
        """Write all that ``dine register`` writes, named ``moved…``, into a folder.

        Args:
            folder: made where it is missing; :func:`~dine.registration.saved.load_result` reads it.
            suffix: format of the moved source.
            view: also write the page to look at.
            overwrite: replace files that are there already.

        Returns:
            Sentences on what the format cannot hold.

        Raises:
            DataError: a suffix that is not written.
            StorageError: a file is there already, or the folder cannot be written.
        """
        from dine.registration.output import Outputs, save

        outputs = Outputs(Path(folder) / f"moved{suffix}")
        names = dict.fromkeys(self.applied, Path(f"further{suffix}"))
        outputs.check(names, view=view, overwrite=overwrite)
        return save(self, outputs, applied=names, view=view, overwrite=overwrite)

    @property
    def distance_to_target(self) -> np.ndarray:
        """(V,) distance of every moved vertex to the nearest sampled place of the target."""
        return distances(self.moved.vertices, dense_points(self.target))
