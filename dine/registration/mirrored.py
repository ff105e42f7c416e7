"""Whether a target is the mirror image of the source, such as the left organ for the right."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from dine.geometry.distance import distances
from dine.geometry.surface import Surface
from dine.registration.correspondence import aligned_pairs
from dine.registration.surfaces import CLOSE, improbabilities
from dine.registration.types import Correspondence, Overlap, Pair, Settings

# Mean displacement, in radii, below which the scans lie on each other as they are.
_NEAR = 0.03
# What the mirrored source lowers the improbability to, if the target is its mirror image.
_MUCH_BETTER = 0.7
# What it lowers the mean distance of rigidly aligned points to, if it is looked at more closely.
_BETTER = 0.9

SENTENCE = (
    "The target looks like a mirror image of the source, such as a left organ for a right one: "
    "mirrored, the source fits much better. If the two are the same side, one file is flipped; "
    "otherwise mirror one of them first (change the sign of one coordinate)."
)


def mirrored(surface: Surface) -> Surface:
    """The mirror image, in the plane across the first axis; normals of faces still point out."""
    faces = None if surface.faces is None else surface.faces[:, ::-1]
    return Surface(surface.vertices * [-1.0, 1.0, 1.0], faces, surface.name)


def looks_mirrored(pair: Pair, found: Correspondence, settings: Settings) -> bool:
    """Whether the mirror image of the source fits the target much better.

    Judged before anything but stiff fields bends them, which make a shape its mirror image less
    easily than the fields of a registration do. Symmetric objects fit as well either way.
    """
    near = np.linalg.norm(found.field, axis=1).mean() < _NEAR
    if near or found.improbability is None or settings.overlap is not Overlap.AUTO:
        return False
    otherwise = aligned_pairs(
        mirrored(pair.source), pair.target, replace(settings, prealign="auto"), "none"
    )
    if min(map(_apart, otherwise)) > _BETTER * _apart(pair):
        return False
    as_given = improbabilities([pair], settings, CLOSE)[0]
    return min(improbabilities(otherwise, settings, CLOSE)) < _MUCH_BETTER * as_given


def _apart(pair: Pair) -> float:
    """Mean distance between the points of both scans as they are aligned, both ways."""
    return float(distances(pair.start, pair.goal).mean() + distances(pair.goal, pair.start).mean())
