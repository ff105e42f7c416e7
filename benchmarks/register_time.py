"""CPU seconds of one registration after the first of a process, by the number of vertices.

    python benchmarks/register_time.py

The two synthetic scans of ``dine scans``, whose faces are divided into four some times: everything
that depends on the number of vertices grows, the shapes stay. Least of some rounds, on one thread;
the first of a process is measured by ``installed.py``.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import torch
import trimesh
from threadpoolctl import threadpool_limits

import dine
from dine.geometry.surface import Surface
from dine.io.readers import read_surface
from dine.registration.model import load_model
from dine.registration.register import register

SCANS = Path(dine.__file__).parent / "scans"


def divided(surface: Surface, times: int) -> Surface:
    """Every face divided into four, so many times."""
    vertices, faces = surface.vertices, surface.faces
    for _ in range(times):
        vertices, faces = trimesh.remesh.subdivide(vertices, faces)
    return Surface(vertices, faces, surface.name)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--divided", nargs="+", type=int, default=[1, 4], help="times, of faces")
    parser.add_argument("--rounds", type=int, default=5)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    model = load_model()
    scans = [read_surface(SCANS / f"{name}.ply") for name in ("before", "after")]
    register(*scans, model=model)
    print("| vertices of source, target | CPU seconds |\n|---|---|")
    for times in arguments.divided:
        source, target = (divided(scan, times) for scan in scans)
        taken = []
        for _ in range(arguments.rounds):
            began = time.process_time()
            register(source, target, model=model)
            taken.append(time.process_time() - began)
        counts = f"{len(source.vertices):,}, {len(target.vertices):,}"
        print(f"| {counts} | {min(taken):.2f} |", flush=True)


if __name__ == "__main__":
    with threadpool_limits(1):
        main()
