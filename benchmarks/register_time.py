"""Seconds of one registration after the first of a process, by the number of vertices.

    python benchmarks/register_time.py --threads 2

The two synthetic scans of ``dine scans``, whose faces are divided into four some times: everything
that depends on the number of vertices grows, the shapes stay. Least of some rounds: CPU seconds on
one thread and, where ``--threads`` asks for more, seconds of the clock on so many, which mean
something on an idle machine only. The first of a process is measured by ``installed.py``.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from functools import partial
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


def least(work: Callable[[], object], clock: Callable[[], float], rounds: int) -> float:
    """Seconds of the fastest of some rounds."""
    taken = []
    for _ in range(rounds):
        began = clock()
        work()
        taken.append(clock() - began)
    return min(taken)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--divided", nargs="+", type=int, default=[1, 4], help="times, of faces")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--threads", type=int, default=1, help="also the clock, on so many")
    arguments = parser.parse_args()
    model = load_model()
    scans = [read_surface(SCANS / f"{name}.ply") for name in ("before", "after")]
    clocks = {1: ("CPU seconds on one thread", time.process_time)}
    if arguments.threads > 1:
        clocks[arguments.threads] = f"seconds on {arguments.threads}", time.perf_counter
    names = [name for name, _ in clocks.values()]
    print(f"| vertices of source, target | {' | '.join(names)} |")
    print("|---" * (1 + len(names)) + "|")
    register(*scans, model=model)
    for times in arguments.divided:
        source, target = (divided(scan, times) for scan in scans)
        row = [f"{len(source.vertices):,}, {len(target.vertices):,}"]
        for threads, (_, clock) in clocks.items():
            torch.set_num_threads(threads)
            with threadpool_limits(threads):
                work = partial(register, source, target, model=model)
                row.append(f"{least(work, clock, arguments.rounds):.2f}")
        print(f"| {' | '.join(row)} |", flush=True)


if __name__ == "__main__":
    main()
