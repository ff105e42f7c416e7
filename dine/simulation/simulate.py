"""Deformations of an organ by finite elements: a mesh in, displacement fields out."""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from threadpoolctl import threadpool_limits

from dine.config import Simulation
from dine.errors import DataError
from dine.geometry.frame import Frame
from dine.geometry.surface import Surface
from dine.geometry.voxels import Voxels, share_inside, voxelised
from dine.progress import Progress
from dine.simulation.elasticity import SoftBody
from dine.simulation.fields import OrganDeformations
from dine.simulation.loads import Organ, drawn_body, drawn_loads
from dine.simulation.unfinished import Unfinished

# What random numbers are drawn for, beside the seed and a number.
_BODY, _LOADS = 8, 9
# Loads that no cube can bear are lessened by a factor, so many times at most.
_LESS, _TRIES = 0.6, 9
# Shrinkage of an edge at most.
_SHRUNK = 0.3


def simulate(
    surface: Surface,
    settings: Simulation,
    *,
    seed: int = 0,
    fixed: np.ndarray | None = None,
    inclusion: Surface | None = None,
    workers: int = 1,
    kept: Unfinished | None = None,
) -> OrganDeformations:
    """Deform a closed mesh by drawn loads, with drawn stiffness and held at drawn places.

    Field i depends on the seed, the settings and i alone: neither on the workers nor on how many
    fields there are.

    Args:
        surface: a closed mesh of V vertices; in one part.
        settings: how many fields, and of what.
        seed: of all that is drawn.
        fixed: (V,) bool, vertices that do not move; None to draw patches.
        inclusion: a closed mesh within it that is stiffer.
        workers: threads.
        kept: where to keep what is done, and to find what was.

    Raises:
        DataError: a mesh without a clear inside or in several parts, or an inclusion elsewhere.
        ConfigError: patches that fix everything.
    """
    frame = Frame.of(surface.vertices[surface.used], surface.name)
    source = _normalised(surface, frame)
    organ = Organ.of(source, voxelised(source, settings.edge))
    soft = inclusion and share_inside(organ.voxels, _normalised(inclusion, frame))
    count = settings.fields
    if kept is not None:
        kept.begin()
    nodes = np.empty((count, len(organ.voxels.nodes), 3), np.float32)
    vertices = np.empty((count, len(surface.vertices), 3), np.float32)

    def solve(first: int) -> slice:
        rows = slice(first, min(first + settings.shared, count))
        found = kept and kept.get(rows)
        if found is None:
            rng = np.random.default_rng([_BODY, seed, first // settings.shared])
            body = drawn_body(organ, settings, rng, fixed, soft)
            moved = _deformed(organ, settings, body, seed, range(rows.start, rows.stop))
            carried = np.stack([organ.carrier @ field for field in moved])
            found = tuple((frame.scale * x).astype(np.float32) for x in (moved, carried))
            if kept is not None:
                kept.put(rows, *found)
        nodes[rows], vertices[rows] = found
        return rows

    with (
        threadpool_limits(1, user_api="blas"),
        ThreadPoolExecutor(workers) as pool,
        Progress(f"simulate {os.path.basename(surface.name)}", count, unit="field") as progress,
    ):
        for rows in pool.map(solve, range(0, count, settings.shared)):
            progress.update(rows.stop - rows.start)
    return OrganDeformations(surface, vertices, _restored(organ.voxels, frame), nodes)


def _normalised(mesh: Surface, frame: Frame) -> Surface:
    return Surface(frame.normalise(mesh.vertices), mesh.faces, mesh.name)


def _restored(voxels: Voxels, frame: Frame) -> Voxels:
    edge = voxels.edge * frame.scale
    return Voxels(frame.restore(voxels.nodes), voxels.cubes, voxels.inside, edge)


def _deformed(
    organ: Organ, settings: Simulation, body: SoftBody, seed: int, rows: range
) -> np.ndarray:
    """Displacements (B, n, 3) of a body under the loads of some fields, in radii.

    Raises:
        DataError: no size of the loads is small enough.
    """
    generators = [np.random.default_rng([_LOADS, seed, row]) for row in rows]
    drawn = [_mixed(organ, settings, body, rng) for rng in generators]
    forces, growth = (np.stack(parts, axis=-1) for parts in zip(*drawn, strict=True))
    found = np.zeros_like(forces)
    left = np.arange(len(rows))
    for attempt in range(_TRIES):
        pull, grow = (_LESS**attempt * x[..., left] for x in (forces, growth))
        moved, reached = body.equilibrium(pull, grow)
        if attempt == _TRIES - 1:  # so small that rotations do not matter
            moved, reached = body.linear(pull + body.of_growth(grow)), np.ones(len(left), bool)
        good = reached & (body.inverted(moved) == 0)
        found[:, :, left[good]] = moved[:, :, good]
        left = left[~good]
        if not len(left):
            return organ.voxels.edge * np.moveaxis(found, 2, 0)
    raise DataError(
        f"{organ.surface.name} cannot bear the loads of field {rows[left[0]]} at any size; choose "
        "a smaller `edge`, so that thin parts are more than one cube wide, or fix more."
    )


def _mixed(
    organ: Organ, settings: Simulation, body: SoftBody, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Forces (n, 3) and growth (E,) of some loads together.

    By linear elasticity each moves the surface by a drawn share of a drawn amplitude.
    """
    forces, growth = drawn_loads(organ, settings, rng)
    forces += body.of_growth(growth)
    shares = rng.uniform(0.2, 1, forces.shape[2])
    amplitude = rng.uniform(*settings.amplitude) / organ.voxels.edge
    moved = body.linear(forces)
    shares /= _mean_length(organ, moved)
    total = _mean_length(organ, (moved @ shares)[:, :, None])[0]
    shares *= amplitude / total
    farthest = np.linalg.norm(moved @ shares, axis=1).max() * organ.voxels.edge
    shares *= min(1.0, settings.farthest / farthest)
    shares *= min(1.0, _SHRUNK / max(np.abs(growth @ shares).max(), _SHRUNK))
    return (forces - body.of_growth(growth)) @ shares, growth @ shares


def _mean_length(organ: Organ, displacement: np.ndarray) -> np.ndarray:
    """(B,) mean over the vertices of the length of displacements (n, 3, B) of the nodes."""
    at = organ.carrier @ displacement.reshape(len(displacement), -1)
    return np.linalg.norm(at.reshape(-1, *displacement.shape[1:]), axis=1).mean(axis=0)
