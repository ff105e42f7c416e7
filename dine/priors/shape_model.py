"""A statistical shape model: mean and modes of a population, from one template moved onto every
scan of it.

The moved templates are brought into one frame (generalised Procrustes analysis), and the principal
components of all their coordinates are the modes. The prior that registers further scans has as
many of them as make shapes that were left out most probable (:mod:`dine.priors.organ_learning`).
How good the model is: :mod:`dine.priors.shape_quality`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from dine.config import OrganLearning
from dine.errors import ConfigError, DataError
from dine.geometry.frame import Frame
from dine.geometry.procrustes import centroid_size, generalised_procrustes, laid_onto
from dine.geometry.surface import Surface
from dine.priors.organ import OrganPrior
from dine.priors.organ_learning import components, learn
from dine.simulation.fields import OrganDeformations

FEWEST = 3
_SHARE = 0.95
# Up to so many shapes each is left out alone, of more as many parts.
_FOLDS = 20
# Parts of the radius; what differs less differs by rounding.
_EQUAL = 1e-6
_CANDIDATES = (1, 2, 3, 4, 5, 7, 10, 15, 20, 30, 40, 60, 80, 120)


@dataclass(frozen=True)
class Member:
    """One scan of a population.

    Attributes:
        name: of the scan.
        vertices: (V, 3) of the template moved onto it, in the units of the template; None where
            that failed.
        used: whether it is part of the model.
        facts: what else is known of its registration.
    """

    name: str
    vertices: np.ndarray | None
    used: bool = True
    facts: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class ShapeModel:
    """Mean and modes of K shapes of a template with V vertices, in its units and where it lies.

    Attributes:
        template: the mesh that was moved onto all scans.
        members: all scans, also those that are not part of the model.
        shapes: (K, V, 3) those that are, in the common frame.
        mean: (V, 3) their mean.
        modes: (R, V, 3) all principal components, one standard deviation each; R is at most K − 1.
            Those that are kept come first.
        kept: how many are: for scores, draws and what is shown.
        size: centroid size that all shapes were scaled to; None where they were not.
        prior: of the template, for ``dine.register(prior=...)``.
    """

    template: Surface
    members: tuple[Member, ...]
    shapes: np.ndarray
    mean: np.ndarray
    modes: np.ndarray
    kept: int
    size: float | None
    prior: OrganPrior

    def __repr__(self) -> str:
        return (
            f"<ShapeModel of {self.template.name}: {len(self.shapes)} shapes, {self.kept} of "
            f"{len(self.modes)} modes kept>"
        )

    @cached_property
    def radius(self) -> float:
        """Of the template, in its units."""
        return Frame.of(self.template.vertices[self.template.used]).scale

    @cached_property
    def deviations(self) -> np.ndarray:
        """(R,) root mean square displacement of the vertices by one standard deviation of each
        mode."""
        return rms(self.modes, self.template.used)

    def shape(self, amplitudes: Sequence[float] | np.ndarray = ()) -> Surface:
        """The shape of these amplitudes of the first modes, in standard deviations; by default
        the mean.

        Raises:
            DataError: more amplitudes than modes, or some that are not finite.
        """
        given = np.asarray(amplitudes, dtype=np.float64)
        if given.ndim != 1 or len(given) > len(self.modes) or not np.isfinite(given).all():
            raise DataError(
                f"The amplitudes have shape {given.shape}; expected up to {len(self.modes)} finite "
                "numbers, one for each mode."
            )
        moved = np.tensordot(given, self.modes[: len(given)], axes=1)
        return replace(self.template, vertices=self.mean + moved)

    def draw(self, count: int, *, seed: int = 0) -> np.ndarray:
        """Random shapes (count, V, 3) of the modes that are kept."""
        amplitudes = np.random.default_rng(seed).standard_normal((count, self.kept))
        return self.mean + np.tensordot(amplitudes, self.modes[: self.kept], axes=1)

    def placed(self, vertices: np.ndarray) -> np.ndarray:
        """The template moved onto a scan (V, 3), brought into the common frame.

        Raises:
            DataError: other numbers of vertices.
        """
        if vertices.shape != self.mean.shape:
            raise DataError(
                f"A shape has vertices of shape {vertices.shape}; expected {self.mean.shape}, "
                "those of the template."
            )
        used = self.template.used
        scaled = vertices if self.size is None else _scaled(vertices, self.size, used)
        return _without_unused(laid_onto(scaled, self.mean, used), self.template)

    def amplitudes(self, shapes: np.ndarray) -> np.ndarray:
        """(K, R) of shapes (K, V, 3) in the common frame, in standard deviations."""
        flat = self.modes.reshape(len(self.modes), -1)
        return (shapes - self.mean).reshape(len(shapes), -1) @ (flat.T / (flat**2).sum(axis=1))

    def scores(self, vertices: np.ndarray) -> np.ndarray:
        """Amplitudes (R,) of the template moved onto a scan (V, 3), in standard deviations."""
        return self.amplitudes(self.placed(vertices)[None])[0]

    def residual(self, vertices: np.ndarray) -> float:
        """Root mean square distance of the vertices of a moved template (V, 3) from the nearest
        shape of the modes that are kept, whatever its size."""
        found = self.shape(self.scores(vertices)[: self.kept]).vertices
        return float(rms(self.placed(vertices) - found, self.template.used))


def rms(fields: np.ndarray, used: np.ndarray) -> np.ndarray:
    """Root mean square length (...) of vectors (..., V, 3), over a mask (V,)."""
    return np.sqrt((fields[..., used, :] ** 2).sum(axis=-1).mean(axis=-1))


def shape_model_of(
    template: Surface,
    members: Sequence[Member],
    *,
    scale: bool = False,
    modes: int | None = None,
    seed: int = 0,
) -> ShapeModel:
    """The model of all members that are used.

    Args:
        template: a mesh; its unused vertices take no part and stay where they are.
        members: the scans, with the template moved onto each.
        scale: bring all to the mean of their centroid sizes first, so that size is no part of
            the model.
        modes: how many to keep; by default the fewest that explain 95 % of the variance.
        seed: of the fit of the prior.

    Raises:
        DataError: fewer than three shapes, a cloud as a template, or shapes that are all equal.
        ConfigError: more modes than the shapes allow.
    """
    check_template(template)
    found = [member.vertices for member in members if member.used and member.vertices is not None]
    if len(found) < FEWEST:
        raise DataError(_too_few(members, len(found)))
    shapes, mask, size = np.stack(found), template.used, None
    if scale:
        size = float(np.mean([centroid_size(shape[mask]) for shape in shapes]))
        shapes = np.stack([_scaled(shape, size, mask) for shape in shapes])
    shapes = generalised_procrustes(shapes, template.vertices, mask)
    shapes = np.stack([_without_unused(shape, template) for shape in shapes])
    radius = Frame.of(template.vertices[mask]).scale
    if rms(shapes - shapes.mean(axis=0), mask).max() < _EQUAL * radius:
        raise DataError(
            f"All {len(shapes)} shapes are equal but for their pose{' and size' * scale}; a shape "
            "model needs scans that differ."
        )
    mean, all_modes = components(shapes, len(shapes))
    kept = _kept(rms(all_modes, mask) ** 2, len(shapes), modes)
    fields = OrganDeformations(template, shapes - template.vertices)
    prior = learn(template, [fields], _learning(len(shapes)), seed=seed)
    return ShapeModel(template, tuple(members), shapes, mean, all_modes, kept, size, prior)


def check_template(template: Surface) -> None:
    """Refuse what no shape model can be made of.

    Raises:
        DataError: it is a cloud.
    """
    if template.faces is None:
        raise DataError(
            f"{template.name} is a cloud; the template of a shape model must be a mesh, whose "
            "vertices the model is of."
        )


def _too_few(members: Sequence[Member], usable: int) -> str:
    others = [member for member in members if not (member.used and member.vertices is not None)]
    doubtful = sum(member.vertices is not None for member in others)
    why = f", {doubtful} are left out as doubtful" if doubtful else ""
    why += f", {len(others) - doubtful} failed" if len(others) > doubtful else ""
    return (
        f"{usable} of {len(members)} scans are usable{why}; a shape model needs {FEWEST} at least, "
        "and some 20 to say much."
    )


def _kept(variances: np.ndarray, shapes: int, asked: int | None) -> int:
    """The number of modes that are asked for, or that explain most of the variance."""
    if asked is None:
        share = np.cumsum(variances) / variances.sum()
        return int(np.searchsorted(share, _SHARE)) + 1
    if not 1 <= asked <= len(variances):
        raise ConfigError(
            f"{asked} modes were asked for, but {shapes} shapes differ in {len(variances)} ways; "
            "ask for fewer, or give more scans."
        )
    return asked


def _learning(count: int) -> OrganLearning:
    folds = min(count, _FOLDS)
    most = count - -(-count // folds) - 1
    return OrganLearning(candidates=[n for n in _CANDIDATES if n <= most], folds=folds)


def _scaled(vertices: np.ndarray, size: float, used: np.ndarray) -> np.ndarray:
    return vertices * (size / centroid_size(vertices[used]))


def _without_unused(vertices: np.ndarray, template: Surface) -> np.ndarray:
    """(V, 3) with the vertices that the template's faces do not use left where they are."""
    return np.where(template.used[:, None], vertices, template.vertices)
