"""Learning the prior of an organ from deformations of its template, simulated or real.

The number of components is the one under which deformations that were left out are most probable,
each measured by a size of its own: deformations differ much in size, and a few large ones would
decide alone.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from scipy.linalg import cho_solve, cholesky

from dine.config import OrganLearning
from dine.errors import ConfigError, DataError
from dine.geometry.frame import Frame
from dine.geometry.oriented import evenly
from dine.geometry.surface import Surface
from dine.geometry.voxels import Voxels, voxelised
from dine.priors.gaussian import squared_exponential
from dine.priors.gaussian_process import GaussianProcessPrior
from dine.priors.organ import OrganPrior
from dine.simulation.elasticity import filled
from dine.simulation.fields import OrganDeformations, template_digest

log = logging.getLogger(__name__)

ROUNDING = 1e-6
"""Spread of fields, as a share of their size, below which they are equal: files hold float32."""


def learn(
    template: Surface, sets: Sequence[OrganDeformations], settings: OrganLearning, *, seed: int = 0
) -> OrganPrior:
    """The prior of a template from its deformations.

    Where these come without an inside, it is the one of least elastic energy.

    Raises:
        DataError: of different templates, fewer fields than components, or fields that are equal.
        ConfigError: more components than the fields allow.
    """
    voxels, fields = _joined(template, sets, settings.edge)
    frame = Frame.of(template.vertices[template.used], template.name)
    fields = fields / frame.scale
    count = len(fields)
    if count < settings.folds:
        raise DataError(
            f"{count} deformations are too few to learn from; expected at least {settings.folds}, "
            "and some 200 for a useful prior."
        )
    if settings.components is not None and settings.components >= count:
        raise ConfigError(
            f"`components` is {settings.components}, but {count} fields allow {count - 1} at most; "
            "give more fields, or ask for fewer components."
        )
    places = frame.normalise(template.vertices)
    chosen = np.sort(evenly(places, settings.points))
    tried = list(_tried(fields, places[chosen], chosen, settings, seed))
    best = max(tried, key=lambda fit: fit["log_likelihood"])
    mean, modes = components(fields, best["components"])
    amplitudes = np.hypot(best["amplitudes"], settings.mismatch).tolist()
    log.info("%d principal components of %d fields", len(modes), count)
    facts = {
        "fields": count,
        "template_name": os.path.basename(template.name),
        "tried": tried,
        "settings": settings.model_dump(),
    }
    return OrganPrior(template, voxels, mean, modes, settings.widths, amplitudes, facts)


def components(fields: np.ndarray, number: int) -> tuple[np.ndarray, np.ndarray]:
    """Mean (S, 3) of fields (K, S, 3), and principal components (R, S, 3) of one standard deviation
    each; R is at most ``number``.

    By the eigenvectors of the products between fields, of which there are fewer than coordinates.

    Raises:
        DataError: all fields are equal.
    """
    count, sites, _ = fields.shape
    mean = fields.mean(axis=0)
    flat = (fields - mean).reshape(count, -1)
    variances, vectors = np.linalg.eigh(flat @ flat.T / (count - 1))
    # What rounding leaves of equal fields is no way to deform.
    if variances.max() <= ROUNDING**2 * np.square(fields).sum() / count:
        raise DataError("All deformations are equal; a prior cannot be learned of them.")
    order = np.argsort(-variances)[: min(number, count - 1)]
    order = order[variances[order] > 1e-12 * variances.max()]
    return mean, (vectors[:, order].T @ flat / np.sqrt(count - 1)).reshape(-1, sites, 3)


def _joined(
    template: Surface, sets: Sequence[OrganDeformations], edge: float
) -> tuple[Voxels | None, np.ndarray]:
    """Cubes in the template, and all fields (K, V + n, 3) in its units.

    Raises:
        DataError: fields of another template.
    """
    for one in sets:
        if template_digest(one.template) != template_digest(template):
            raise DataError(
                f"{one.template.name} holds deformations of another mesh than {template.name}; a "
                "prior is of one template."
            )
    voxels = next((one.voxels for one in sets if one.voxels is not None), None)
    if voxels is None:
        try:
            voxels = voxelised(template, edge * Frame.of(template.vertices[template.used]).scale)
        except DataError as error:
            log.info("Nothing is known of the inside: %s", error)
    return voxels, np.concatenate([_with_inside(one, voxels) for one in sets])


def _with_inside(fields: OrganDeformations, voxels: Voxels | None) -> np.ndarray:
    """(K, V + n, 3); where nothing is known at these nodes, those of least elastic energy."""
    vertices = fields.vertices.astype(np.float64)
    if voxels is None:
        return vertices
    own = fields.voxels is not None and np.array_equal(fields.voxels.nodes, voxels.nodes)
    if own:
        nodes = fields.nodes
    else:
        carrier = voxels.carrier(fields.template.vertices)
        nodes = np.moveaxis(filled(voxels, carrier, np.moveaxis(vertices, 0, 2)), 2, 0)
    return np.concatenate([vertices, nodes], axis=1)


def _tried(
    fields: np.ndarray, places: np.ndarray, chosen: np.ndarray, settings: OrganLearning, seed: int
) -> Iterator[dict[str, Any]]:
    """For each number of components the process for what they miss of fields left out, and how
    probable these are with both; at ``chosen`` vertices, whose ``places`` are (P, 3)."""
    count = len(fields)
    # Fields that share what holds the organ follow each other.
    parts = np.array_split(np.arange(count), settings.folds)
    spans = []
    for part in parts:
        kept = np.delete(np.arange(count), part)
        mean, modes = components(fields[kept], len(kept))
        spans.append((fields[part] - mean, modes))
    numbers = settings.candidates if settings.components is None else [settings.components]
    most = min(len(modes) for _, modes in spans)
    for number in sorted({min(number, most) for number in numbers}):
        missed = np.concatenate([_missed(left, modes[:number])[:, chosen] for left, modes in spans])
        process = GaussianProcessPrior.fit(
            missed,
            source=np.broadcast_to(places, missed.shape).copy(),
            seed=seed,
            widths=settings.widths,
            points=settings.points,
        )
        amplitudes, affine, noise = process.scales()
        rest = squared_exponential(places, places, settings.widths, amplitudes, affine)
        rest += noise**2 * np.eye(len(places))
        total = sum(
            _log_density(left[:, chosen], modes[:number, chosen], rest) for left, modes in spans
        )
        yield {
            "components": number,
            "log_likelihood": total / (count * 3 * len(places)),
            "missed": float(np.sqrt((missed**2).sum(axis=2).mean())),
            "amplitudes": list(amplitudes),
            "noise": noise,
        }


def _missed(fields: np.ndarray, modes: np.ndarray) -> np.ndarray:
    """What is outside the span of the modes (R, S, 3) of fields (K, S, 3)."""
    flat = modes.reshape(len(modes), -1)
    along = flat / np.linalg.norm(flat, axis=1, keepdims=True)
    left = fields.reshape(len(fields), -1)
    return (left - (left @ along.T) @ along).reshape(fields.shape)


def _log_density(fields: np.ndarray, modes: np.ndarray, rest: np.ndarray) -> float:
    """Sum over fields (K, P, 3) about their mean of the log density of each, once the covariance is
    scaled to its size: of modes (R, P, 3), and of ``rest`` (P, P) in each coordinate."""
    flat = np.moveaxis(modes, 2, 1).reshape(len(modes), -1)
    covariance = flat.T @ flat + np.kron(np.eye(3), rest)
    lower = cholesky(covariance, lower=True)
    values = np.moveaxis(fields, 2, 1).reshape(len(fields), -1).T
    squares = (values * cho_solve((lower, True), values)).sum(axis=0) / len(lower)
    log_det = 2 * float(np.log(np.diag(lower)).sum()) / len(lower)
    return -0.5 * len(lower) * float((np.log(2 * np.pi * squares) + 1 + log_det).sum())
