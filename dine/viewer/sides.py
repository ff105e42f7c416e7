"""From where a shape is looked at: names, directions and what is up there."""

from __future__ import annotations

from typing import Any

import numpy as np

from dine.geometry.surface import Surface

#: Patient directions of x, y and z, towards minus and plus.
_PATIENT = {
    "LPS": (("right", "left"), ("front", "back"), ("feet", "head")),
    "RAS": (("left", "right"), ("back", "front"), ("feet", "head")),
}
# Mean normal, as a share of what it is where all normals are alike; closed surfaces have 0.
_OPEN = 0.2


def axis_names(space: str | None) -> list[str]:
    """What to write at the ends of the axes: letters where the patient's directions are known."""
    return list(space) if space in _PATIENT else ["x", "y", "z"]


def first_side(shape: Surface, space: str | None) -> dict[str, list[float]]:
    """The side to look from first, straight along an axis.

    From the patient's front where the file states its directions; otherwise from the side to which
    an open surface faces, as a face does, or on which the shape is broadest. Up is z or, from the
    side of z, y; of an upright shape seen from the side of x the longer of both.

    Args:
        shape: with the vertices that its faces use, or all of a cloud.
        space: ``LPS``, ``RAS`` or None, where it is not known.

    Returns:
        ``direction``, a unit vector towards the viewer, and ``up``, one at a right angle to it.
    """
    if space in _PATIENT:
        return _side(1, 1 if space == "RAS" else -1, 2)
    spread = np.ptp(shape.vertices[shape.used], axis=0)
    facing = _facing(shape)
    if np.abs(facing).max() > _OPEN:
        axis = int(np.abs(facing).argmax())
        sign = int(np.sign(facing[axis]))
    else:
        axis = int(spread.argmin())
        sign = -1 if axis == 1 else 1  # the other two axes then point to the right and upwards
    if axis == 0:
        return _side(0, sign, 2 if spread[2] >= spread[1] else 1)
    return _side(axis, sign, 2 if axis == 1 else 1)


def sides(space: str | None) -> list[dict[str, Any]]:
    """All six: ``name`` for a button, ``label`` to be read out, ``direction`` and ``up``."""
    found = []
    for axis, letter in enumerate("xyz"):
        for end, sign in enumerate((-1, 1)):
            label = name = f"{'−+'[end]}{letter}"
            if space in _PATIENT:
                name = _PATIENT[space][axis][end]
                label = f"{name}, {label}"
            side = _side(axis, sign, 1 if axis == 2 else 2)
            if axis == 2 and space == "LPS":
                side["up"] = [0.0, -1.0, 0.0]  # the front, as in axial slices
            found.append({"name": name, "label": label, **side})
    return found


def _facing(shape: Surface) -> np.ndarray:
    """(3,) mean normal of all area."""
    if shape.faces is None or len(shape.faces) == 0:
        return np.zeros(3)
    a, b, c = (shape.vertices[shape.faces[:, corner]] for corner in range(3))
    normals = np.cross(b - a, c - a)
    area = np.linalg.norm(normals, axis=1).sum()
    return normals.sum(axis=0) / area if area > 0 else np.zeros(3)


def _side(axis: int, sign: int, up: int) -> dict[str, list[float]]:
    return {"direction": (sign * np.eye(3)[axis]).tolist(), "up": np.eye(3)[up].tolist()}
