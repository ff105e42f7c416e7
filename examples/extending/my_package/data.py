"""Two datasets: bars before and after bending, and undeformed eggs.

python -m my_package.data FOLDER
"""

import sys
from pathlib import Path

import numpy as np
import trimesh

from dine.geometry.surface import Surface
from dine.io.writers import write_surface


def bent(vertices: np.ndarray, angle: float) -> np.ndarray:
    """Vertices of a bar along x, bent about y so that its ends differ by ``angle``."""
    length = np.ptp(vertices[:, 0])
    radius = length / angle
    turn = vertices[:, 0] / radius
    x = (radius + vertices[:, 2]) * np.sin(turn)
    z = (radius + vertices[:, 2]) * np.cos(turn) - radius
    return np.column_stack([x, vertices[:, 1], z])


def write_bars(folder: Path, objects: int = 6, levels: tuple[float, ...] = (0.3, 0.6)) -> None:
    """Pairs: same vertices, same faces, same order. The level is the name of their folder."""
    rng = np.random.default_rng(0)
    for number in range(objects):
        size = [60, *rng.uniform(8, 16, size=2)]
        bar = trimesh.creation.box(size).subdivide().subdivide().subdivide()
        for level in levels:
            place = folder / "Deformation_Level" / f"{level:g}"
            moved = bent(bar.vertices, angle=2 * level)
            write_surface(place / f"Source_bar{number}.ply", Surface(bar.vertices, bar.faces))
            write_surface(place / f"Target_bar{number}.ply", Surface(moved, bar.faces))


def write_eggs(folder: Path, objects: int = 6) -> None:
    """Undeformed meshes, under any names; deformed targets are made from them."""
    rng = np.random.default_rng(1)
    for number in range(objects):
        egg = trimesh.creation.icosphere(subdivisions=3)
        vertices = egg.vertices * rng.uniform(20, 40, size=3)
        write_surface(folder / f"egg{number}.ply", Surface(vertices, egg.faces))


if __name__ == "__main__":
    root = Path(sys.argv[1])
    write_bars(root / "bars")
    write_eggs(root / "eggs")
