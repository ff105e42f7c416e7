"""How far simulated deformations are from those at the finest element size.

    python benchmarks/organ_edges.py ../shared/meshes/objects/organ_liver_smooth.ply

Twelve deformations at each edge of the cubes, of equal loads, held alike. One row an edge:
nodes, the median over deformations of the mean difference at the vertices as a share of the mean
displacement, and CPU seconds.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np

from dine.config import Simulation
from dine.io.readers import read_surface
from dine.simulation.simulate import simulate

EDGES = (0.2, 0.14, 0.1, 0.07, 0.05)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("mesh", type=Path)
    template = read_surface(parser.parse_args().mesh)
    found = {}
    for edge in EDGES:
        began = time.process_time()
        settings = Simulation(fields=12, edge=edge, amplitude=[0.05, 0.1])
        fields = simulate(template, settings, seed=5)
        found[edge] = fields.vertices, len(fields.nodes[0]), time.process_time() - began
    finest = found[EDGES[-1]][0]
    length = np.linalg.norm(finest, axis=2).mean(axis=1)
    print("| edge | nodes | difference | CPU seconds |\n|---|---|---|---|")
    for edge, (vertices, nodes, seconds) in found.items():
        apart = np.linalg.norm(vertices - finest, axis=2).mean(axis=1) / length
        print(f"| {edge} | {nodes} | {100 * np.median(apart):.1f} % | {seconds:.1f} |")


if __name__ == "__main__":
    main()
