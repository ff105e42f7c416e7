"""Random smooth deformations by Gaussian radial basis functions, as the two datasets describe them.

The published description fixes the ingredients (a percentage of the points as control points, a
random displacement each, a Gaussian of a given width) but not the formula, so it is a choice:

    u(x) = sum_i exp(-|x - c_i|^2 / w^2) d_i,      d_i ~ N(0, (amplitude * level)^2 I)

Of the usual candidates it comes closest to the only known figures, initial mean symmetric squared
Chamfer distances (x 1e-4; 1024 points on unit-radius primitives, 2, 5 or 10 % control points, width
0.3, 0.4 or 0.5, amplitude 0.25). Means of 600 fields on 150 shapes of ``synthetic.primitive``, and
of 240 fields on the unit sphere and on 60 shapes of ``synthetic.tissue_patch``:

    level                                    0.1  0.2  0.3  0.4  0.5   0.6   0.7   0.8
    known, on unspecified primitives          27   83  136  209  283   314   534   562
    sum of exp(-d^2/w^2), sphere              32   92  168  259  364   481   611   751
    sum of exp(-d^2/w^2), primitives          52  149  285  462  680   940  1247  1607
    sum of exp(-d^2/(2 w^2)), primitives      91  275  558  950 1456  2086  2847  3751
    weighted mean, exp(-d^2/w^2)               6   20   37   58   80   105   132   161
    weighted mean, exp(-d^2/(2 w^2))           3   12   23   37   51    68    85   104
    interpolation, exp(-d^2/(2 w^2))         333 1378 3385 6478  over 10,000  (150 fields)
    sum of exp(-d^2/w^2), tissue patches      72  238  489  824 1254  1787  2432  3200

A smaller surface in its unit ball (a cone, an open patch) has its control points closer together,
hence larger sums.
"""

from __future__ import annotations

import math

import numpy as np
from scipy.spatial.distance import cdist

from dine.data.sampling import sample_surface
from dine.errors import DataError
from dine.geometry.surface import Surface

# Kernel values held at once (8 MiB of float64), whatever the number of vertices.
_CHUNK = 1 << 20


def rbf_displacement(
    surface: Surface,
    *,
    level: float,
    control_percent: float,
    width: float,
    amplitude: float,
    points: int,
    rng: np.random.Generator,
) -> np.ndarray:
    """Draw one random smooth displacement field and evaluate it at every vertex.

    The field is drawn on the object scaled to unit radius, so that neither its units nor its
    position matter. Control points are uniform on the surface (area-weighted; for a cloud: among
    its vertices), so that the resolution of the mesh does not matter either. The draws depend
    neither on ``level`` nor on ``amplitude``: for an equal generator the field is proportional to
    both.

    Args:
        surface: V vertices in any unit; may be open, in several components, with duplicates.
        level: deformation level, >= 0 (0 moves nothing).
        control_percent: control points as a percentage of ``points``, in (0, 100]; rounded, and at
            least one.
        width: width w of the Gaussian in object radii, > 0.
        amplitude: standard deviation per coordinate of a control point's displacement at level 1,
            in object radii, >= 0.
        points: number of points that the percentage refers to (the points per cloud), >= 1.
        rng: source of all randomness.

    Returns:
        (V, 3) float64 displacement of every vertex, in the units of ``surface``.

    Raises:
        ValueError: a parameter outside its range.
        DataError: a surface without extent (all vertices at one position, or faces without area),
            or a cloud of fewer vertices than control points.
    """
    check_recipe(
        level=level,
        control_percent=control_percent,
        width=width,
        amplitude=amplitude,
        points=points,
    )
    count = max(1, round(control_percent / 100 * points))
    controls = sample_surface(surface, count, rng).places(surface.vertices)
    centre, radius = _frame(surface)
    controls = (controls - centre) / radius
    moves = rng.standard_normal((count, 3)) * (amplitude * level)
    vertices = (surface.vertices - centre) / radius
    field = np.empty_like(vertices)
    step = max(1, _CHUNK // count)
    for start in range(0, len(vertices), step):
        block = slice(start, start + step)
        squared = cdist(vertices[block], controls, "sqeuclidean")
        field[block] = np.exp(squared / -(width**2)) @ moves
    return _together(vertices, field) * radius


def _together(vertices: np.ndarray, field: np.ndarray) -> np.ndarray:
    """The field with one value for coincident vertices: where a product's last rows are rounded
    otherwise than the others, as on some CPUs, a mesh would tear at its seams."""
    _, first, place = np.unique(vertices, axis=0, return_index=True, return_inverse=True)
    return field if len(first) == len(vertices) else field[first[place.ravel()]]


def check_recipe(
    *, level: float, control_percent: float, width: float, amplitude: float, points: int
) -> None:
    """Raise ValueError, naming the parameter, if ``rbf_displacement`` could not use these."""
    for name, value, valid, expected in (
        ("level", level, level >= 0, "at least 0"),
        ("control_percent", control_percent, 0 < control_percent <= 100, "in (0, 100]"),
        ("width", width, width > 0, "above 0"),
        ("amplitude", amplitude, amplitude >= 0, "at least 0"),
        ("points", points, points >= 1, "at least 1"),
    ):
        if not (valid and math.isfinite(value)):
            raise ValueError(f"{name} must be finite and {expected}, not {value}.")


def _frame(surface: Surface) -> tuple[np.ndarray, float]:
    """Centre (3,) and radius of a surface that has an area, or of a cloud.

    The centre is the mean of the surface, not of the vertices of a mesh, which crowd where it is
    fine. Vertices that no face uses are no part of the surface: they count for neither.
    """
    if surface.faces is None:
        used = surface.vertices
        centre = used.mean(axis=0)
    else:
        used = surface.vertices[np.unique(surface.faces)]
        corners = surface.vertices[surface.faces]
        edges = corners[:, 1:] - corners[:, :1]
        areas = np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1)
        centre = np.average(corners.mean(axis=1), axis=0, weights=areas)
    radius = float(np.linalg.norm(used - centre, axis=1).max())
    if not radius > 0:
        raise DataError(
            f"{surface.name}: all its vertices lie at one position; repair or remove the file."
        )
    return centre, radius
