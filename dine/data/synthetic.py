"""Undeformed synthetic objects that stand in for the two datasets, which cannot be shipped.

``primitive`` stands in for SynBench (closed primitive shapes), ``tissue_patch`` for DeformedTissue
(open 2.5D scans of resection cavities and of cut tissue). Every object is a function of
(seed, index) alone: asking for more objects changes none of the earlier ones.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.spatial import Delaunay, cKDTree
from scipy.spatial.transform import Rotation

from dine.geometry.surface import Surface

# First word of each generator's key, so that a primitive and a patch share no random numbers.
_PRIMITIVE, _TISSUE = 1, 2


def primitive(index: int, seed: int) -> Surface:
    """Closed mesh of a randomly stretched, mildly rotated primitive shape.

    The shape families take turns with the index (``len(FAMILIES)`` of them).

    Args:
        index: number of the object, >= 0.
        seed: seed of the collection, >= 0.

    Returns:
        Watertight, outward-oriented mesh of one component with 1,500 to 4,000 roughly evenly
        spread vertices in lexicographic order (as SimTool writes them). The vertex farthest from
        the middle of the bounding box is 0.5 to 2 units away; the axes of the shape are within 15
        degrees of the coordinate axes.
    """
    rng = np.random.default_rng([_PRIMITIVE, seed, index])
    family = list(FAMILIES)[index % len(FAMILIES)]
    section, profile = FAMILIES[family](rng)
    stretch = rng.uniform(0.75, 1.35, size=2)
    section = [side * stretch for side in section]
    vertices, faces = _sweep(section, profile, target=rng.integers(1900, 3300))
    axis = rng.standard_normal(3)
    axis *= np.deg2rad(rng.uniform(0, 15)) / np.linalg.norm(axis)
    vertices = Rotation.from_rotvec(axis).apply(vertices)
    vertices -= (vertices.min(axis=0) + vertices.max(axis=0)) / 2
    vertices *= rng.uniform(0.5, 2.0) / np.linalg.norm(vertices, axis=1).max()
    order = np.lexsort(vertices.T[::-1])
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order))
    return Surface(vertices[order], rank[faces], name=f"primitive {index} ({family})")


# A cross-section is a closed chain of sides, counter-clockwise around the origin; a profile is a
# chain of sides whose points are (scale of the cross-section, height). A side is a dense polyline
# (n, 2). Vertices are put on the ends of sides, which keeps edges sharp, and evenly in between.
Sides = list[np.ndarray]


def _lines(*corners: tuple[float, float]) -> Sides:
    points = np.array(corners, dtype=np.float64)
    return [points[i : i + 2] for i in range(len(points) - 1)]


def _arc(start: float, stop: float, power: float = 2.0) -> np.ndarray:
    """Arc of |x|^p + |y|^p = 1 between two angles in quarter turns; power 2 is the circle."""
    angle = np.linspace(start, stop, 721) * (np.pi / 2)
    points = np.column_stack([np.cos(angle), np.sin(angle)])
    points[np.abs(points) < 1e-12] = 0.0  # quarter turns lie exactly on the axes
    return points / (np.abs(points) ** power).sum(axis=1, keepdims=True) ** (1 / power)


def _polygon(count: int) -> Sides:
    angle = 2 * np.pi * (np.arange(count + 1) + 0.5) / count
    return _lines(*zip(np.cos(angle), np.sin(angle), strict=True))


def _clover(leaves: int, depth: float) -> Sides:
    angle = np.linspace(0, 2 * np.pi, 721)
    radius = 1 + depth * np.cos(leaves * angle)
    return [np.column_stack([radius * np.cos(angle), radius * np.sin(angle)])]


def _extrusion(height: float, top: float = 1.0) -> Sides:
    """Profile of a body with a flat bottom and a flat top scaled by ``top`` (0: a tip)."""
    lid = [(0, height)] if top > 0 else []
    return _lines((0, -height), (1, -height), (top, height), *lid)


def _capsule(half_length: float) -> Sides:
    low, high = (0, -half_length), (0, half_length)
    return [_arc(-1, 0) + low, *_lines((1, -half_length), (1, half_length)), _arc(0, 1) + high]


def _hourglass(height: float, waist: float) -> Sides:
    z = np.linspace(-height, height, 361)
    wall = np.column_stack([1 - (1 - waist) * np.cos(z / height * np.pi / 2) ** 2, z])
    return [*_lines((0, -height), (1, -height)), wall, *_lines((1, height), (0, height))]


def _tube(height: float, hole: float) -> Sides:
    return _lines((hole, -height), (1, -height), (1, height), (hole, height), (hole, -height))


Builder = Callable[[np.random.Generator], tuple[Sides, Sides]]
FAMILIES: dict[str, Builder] = {
    "ellipsoid": lambda r: ([_arc(0, 4)], [_arc(-1, 1) * (1, r.uniform(0.6, 1.5))]),
    "box": lambda r: (_polygon(4), _extrusion(r.uniform(0.4, 1.2))),
    "cylinder": lambda r: ([_arc(0, 4)], _extrusion(r.uniform(0.5, 1.6))),
    "cone": lambda r: ([_arc(0, 4)], _extrusion(r.uniform(0.7, 1.3), top=0)),
    "capsule": lambda r: ([_arc(0, 4)], _capsule(r.uniform(0.4, 1.3))),
    "torus": lambda r: ([_arc(0, 4)], [_arc(0, 4) * r.uniform(0.25, 0.45) + (1, 0)]),
    "frustum": lambda r: (
        [_arc(0, 4)],
        _extrusion(r.uniform(0.5, 1.2), top=r.uniform(0.35, 0.7)),
    ),
    "prism": lambda r: (_polygon(r.choice([3, 5, 6])), _extrusion(r.uniform(0.5, 1.3))),
    "superellipsoid": lambda r: (
        [_arc(0, 4, power=r.uniform(3, 6))],
        [_arc(-1, 1, power=r.uniform(3, 6)) * (1, r.uniform(0.5, 1.2))],
    ),
    "pyramid": lambda r: (_polygon(r.choice([3, 4])), _extrusion(r.uniform(0.7, 1.2), top=0)),
    "dome": lambda r: (
        [_arc(0, 4)],
        [*_lines((0, 0), (1, 0)), _arc(0, 1) * (1, r.uniform(0.6, 1.3))],
    ),
    "tube": lambda r: ([_arc(0, 4)], _tube(r.uniform(0.3, 1.0), hole=r.uniform(0.45, 0.7))),
    "bipyramid": lambda r: (
        _polygon(r.choice([4, 6])),
        _lines((0, -(low := r.uniform(0.6, 1.2))), (1, 0), (0, 2 * low - r.uniform(0.6, 1.0))),
    ),
    "hourglass": lambda r: ([_arc(0, 4)], _hourglass(r.uniform(0.8, 1.5), r.uniform(0.35, 0.65))),
    "clover prism": lambda r: (
        _clover(r.choice([3, 4]), r.uniform(0.12, 0.25)),
        _extrusion(r.uniform(0.4, 1.0)),
    ),
}


def _sweep(section: Sides, profile: Sides, target: int) -> tuple[np.ndarray, np.ndarray]:
    """Closed mesh of about ``target`` vertices: a cross-section scaled and lifted along a profile.

    The profile runs upwards from pole to pole, or counter-clockwise back to its start (a torus),
    which makes the faces point outwards. Every ring gets as many vertices as its own length asks
    for, so that tips are no finer than the rest.
    """
    spacing = 0.08
    for _ in range(3):  # the number of vertices goes with 1 / spacing^2 up to rounding
        vertices, faces = _rings(section, profile, spacing)
        spacing *= np.sqrt(len(vertices) / target)
    return vertices, faces


def _rings(section: Sides, profile: Sides, spacing: float) -> tuple[np.ndarray, np.ndarray]:
    _, stations = _resample(profile, spacing)
    closed = np.allclose(profile[0][0], profile[-1][-1])
    if not closed:
        stations = np.vstack([stations, profile[-1][-1]])
    vertices, rings, total = [], [], 0
    for scale, height in stations:
        if scale == 0:
            parameter, outline = np.zeros(1), np.zeros((1, 2))
        else:
            parameter, outline = _resample(section, spacing / scale)
            outline = outline * scale
        vertices.append(np.column_stack([outline, np.full(len(outline), height)]))
        rings.append((parameter, total + np.arange(len(parameter))))
        total += len(parameter)
    following = rings[1:] + rings[:1] if closed else rings[1:]
    faces = [_stitch(*low, *high) for low, high in zip(rings, following, strict=False)]
    return np.vstack(vertices), np.vstack(faces)


def _resample(sides: Sides, spacing: float) -> tuple[np.ndarray, np.ndarray]:
    """Parameters in [0, 1) and points (n, 2), about ``spacing`` apart, without the very last end.

    A chain of one side may be a closed curve, which needs three points to enclose anything.
    """
    least = 3 if len(sides) == 1 else 1
    parameters, points = [], []
    for number, side in enumerate(sides):
        length = np.append(0, np.cumsum(np.linalg.norm(np.diff(side, axis=0), axis=1)))
        count = max(least, round(length[-1] / spacing))
        fraction = np.arange(count) / count
        at = fraction * length[-1]
        points.append(np.column_stack([np.interp(at, length, side[:, i]) for i in (0, 1)]))
        parameters.append((number + fraction) / len(sides))
    return np.concatenate(parameters), np.vstack(points)


def _stitch(
    low_at: np.ndarray, low: np.ndarray, high_at: np.ndarray, high: np.ndarray
) -> np.ndarray:
    """Triangles (F, 3) between two rings, given the parameters and the indices of their vertices.

    Walks around both rings at once and always steps along the edge whose middle comes first.
    """
    middles = [(at + np.append(at[1:], 1)) / 2 for at in (low_at, high_at)]
    order = np.argsort(np.concatenate(middles), kind="stable")
    on_low = order < len(low)
    i = np.cumsum(on_low) - on_low
    j = np.cumsum(~on_low) - ~on_low
    here, there = low[i % len(low)], high[j % len(high)]
    onward = np.where(on_low, low[(i + 1) % len(low)], high[(j + 1) % len(high)])
    faces = np.column_stack([here, onward, there])
    # A pole is a ring of one vertex: a step along it makes no triangle.
    return faces[(here != onward) & (onward != there)]


def tissue_patch(index: int, seed: int) -> Surface:
    """Open 2.5D patch like a scan from above: resection cavity ("RC") or cut tissue ("CT").

    Even indices are cavities: a gently curved piece of surface with a steep-walled hole. Odd
    indices are cut pieces: flat-topped, with rounded edges. Both have a star-shaped outline and a
    smooth low-frequency relief.

    Args:
        index: number of the object, >= 0.
        seed: seed of the collection, >= 0.

    Returns:
        Mesh of one component with 1,500 to 3,500 vertices in millimetres, 40 to 90 across, with
        upward faces. z is a function of (x, y), no two vertices share their (x, y).
    """
    rng = np.random.default_rng([_TISSUE, seed, index])
    outline = _Outline.draw(rng, radius=rng.uniform(23, 36), roughness=0.16)
    points, faces = _triangulate(outline, target=rng.integers(1800, 3000), rng=rng)
    if index % 2 == 0:
        kind, height = "RC", _cavity(points, outline, rng)
    else:
        kind, height = "CT", _cut_piece(points, outline, rng)
    vertices = np.column_stack([points, height])
    return Surface(vertices, faces, name=f"tissue patch {index} ({kind})")


@dataclass(frozen=True)
class _Outline:
    """Smooth star-shaped closed curve around ``centre``."""

    radius: float
    amplitudes: np.ndarray
    phases: np.ndarray
    centre: np.ndarray

    @classmethod
    def draw(
        cls, rng: np.random.Generator, radius: float, roughness: float, centre=(0.0, 0.0)
    ) -> _Outline:
        order = np.arange(2, 7)
        amplitudes = roughness * rng.uniform(0.4, 1.0, len(order)) / (order - 1) ** 0.8
        return cls(radius, amplitudes, rng.uniform(0, 2 * np.pi, len(order)), np.array(centre))

    def at(self, angle: np.ndarray) -> np.ndarray:
        """Distance of the curve from the centre at angles of any shape."""
        order = np.arange(2, 2 + len(self.amplitudes))
        waves = np.cos(angle[..., None] * order + self.phases) @ self.amplitudes
        return self.radius * (1 + waves)

    def relative(self, points: np.ndarray) -> np.ndarray:
        """Distance of points (n, 2) from the centre, 1 on the curve."""
        x, y = (points - self.centre).T
        return np.hypot(x, y) / self.at(np.arctan2(y, x))


def _triangulate(
    outline: _Outline, target: int, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Jittered hexagonal grid inside an outline, points along it, and their triangulation."""
    angle = np.linspace(0, 2 * np.pi, 2881)
    radius = outline.at(angle)
    spacing = np.sqrt(np.pi * np.mean(radius**2) / target * 2 / np.sqrt(3))
    _, border = _resample(
        [np.column_stack([np.cos(angle), np.sin(angle)]) * radius[:, None]], spacing
    )
    reach = radius.max()
    x, y = np.meshgrid(
        np.arange(-reach, reach, spacing), np.arange(-reach, reach, spacing * np.sqrt(3) / 2)
    )
    x[1::2] += spacing / 2
    inside = np.column_stack([x.ravel(), y.ravel()])
    inside += rng.uniform(-0.18, 0.18, inside.shape) * spacing
    inside = inside[outline.relative(inside) < 1]
    inside = inside[cKDTree(border).query(inside)[0] > 0.6 * spacing]
    points = np.vstack([border, inside])
    faces = Delaunay(points).simplices.astype(np.int64)
    # Delaunay fills the convex hull: drop what bridges the bays of the outline.
    return points, faces[outline.relative(points[faces].mean(axis=1)) < 1]


def _cavity(points: np.ndarray, outline: _Outline, rng: np.random.Generator) -> np.ndarray:
    """Heights (n,) of a curved surface with a steep-walled hole and a bowl as its floor."""
    offset = rng.uniform(-0.1, 0.1, size=2) * outline.radius
    hole = _Outline.draw(
        rng, outline.radius * rng.uniform(0.36, 0.48), roughness=0.13, centre=offset
    )
    depth = hole.radius * rng.uniform(0.5, 0.85)
    wall = rng.uniform(0.4, 0.6)
    relative = hole.relative(points)
    across = np.clip((1 + wall / 2 - relative) / wall, 0, 1)
    sunk = across**2 * (3 - 2 * across)
    bowl = rng.uniform(0.1, 0.3) * np.clip(1 - relative**2, 0, 1) ** 2
    curvature = rng.uniform(1 / 250, 1 / 90)
    ground = -curvature / 2 * (points**2).sum(axis=1)
    return ground + _relief(points, outline, rng) - depth * (sunk + bowl)


def _cut_piece(points: np.ndarray, outline: _Outline, rng: np.random.Generator) -> np.ndarray:
    """Heights (n,) of a thick piece that falls off towards its outline, steepest at the edge."""
    thickness = outline.radius * rng.uniform(0.25, 0.45)
    # At 0.97 the fall is steep but finite: the scanner sees nothing of a vertical edge.
    dome = np.sqrt(1 - (0.97 * outline.relative(points)) ** rng.uniform(2.5, 5))
    return thickness * dome + _relief(points, outline, rng)


def _relief(points: np.ndarray, outline: _Outline, rng: np.random.Generator) -> np.ndarray:
    """Sum (n,) of plane waves in random directions, none shorter than 0.8 radii."""
    count = 6
    angle, phase = rng.uniform(0, 2 * np.pi, size=(2, count))
    frequency = 2 * np.pi / (outline.radius * rng.uniform(0.8, 2.2, count))
    amplitude = outline.radius * rng.uniform(0.008, 0.02, count)
    waves = points @ np.stack([np.cos(angle), np.sin(angle)]) * frequency
    return np.sin(waves + phase) @ amplitude
