"""Where the error of hidden vertices comes from: the prior, or how a scan is matched.

    snakemake -j2 organ --configfile my.yaml
    python benchmarks/organ_floors.py results/organ_trial/liver [--own 60]

On the true deformations of a finished trial, mean and median over them of the error of hidden
vertices in percent of the radius, where seen vertices are given: by their distance across the
surface alone, with two standard deviations, and by their places; under the trial's simulations,
under others of wide forces and weight alone, as in the truth, and with ``--own`` under so many
deformations made by the truth's own mechanics, with and without the simulations. The most probable
field is that of 120 components and a process of 0.005 of the radius at a width of 0.3.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path

import numpy as np
import trimesh

from dine.config import Simulation
from dine.priors.gaussian import squared_exponential
from dine.priors.organ_learning import components
from dine.results import TrialFiles
from dine.simulation.fields import read_deformations, read_vertex_numbers
from dine.simulation.simulate import simulate
from dine.trials.mechanics import true_deformations
from dine.trials.organ import NOISE, Case, seen_of

WIDE = {"loads": ["force", "force", "gravity"], "width": [0.5, 1.2], "poisson": [0.3, 0.48]}
COMPONENTS, WIDTH, AMPLITUDE = 120, 0.3, 0.005
GIVEN = 700


def across(case: Case, given: np.ndarray) -> np.ndarray:
    """(N, 1, 3) normals of the true surface at given vertices: what its distance says."""
    faces = case.template.faces
    mesh = trimesh.Trimesh(case.truth, faces, process=False)
    return np.asarray(mesh.vertex_normals)[given][:, None]


def places(case: Case, given: np.ndarray) -> np.ndarray:
    """(N, 3, 3), all three axes: what a place says."""
    return np.tile(np.eye(3), (len(given), 1, 1))


def hidden_error(
    case: Case,
    fields: np.ndarray,
    said: Callable[[Case, np.ndarray], np.ndarray],
    deviation: float,
) -> float:
    """Of the most probable field under components of fields (K, V, 3), in percent."""
    vertices = case.template.vertices
    given = np.random.default_rng(0).permutation(np.flatnonzero(case.seen))[:GIVEN]
    axes = said(case, given)
    mean, modes = components(fields, COMPONENTS)
    rows = np.einsum("rna,nka->nkr", modes[:, given], axes).reshape(-1, len(modes))
    values = np.einsum("na,nka->nk", (case.truth - vertices - mean)[given], axes).ravel()
    process = squared_exponential(vertices, vertices[given], (WIDTH,), (AMPLITUDE,))
    covariance = np.einsum("nka,mla,nm->nkml", axes, axes, process[given])
    covariance = covariance.reshape(len(rows), -1) + rows @ rows.T
    covariance[np.diag_indices(len(rows))] += deviation**2
    weights = np.linalg.solve(covariance, values)
    moved = mean + np.tensordot(weights @ rows, modes, axes=1)
    moved += process @ np.einsum("nk,nka->na", weights.reshape(axes.shape[:2]), axes)
    error = np.linalg.norm(vertices + moved - case.truth, axis=1)
    return 100 * float(error[~case.seen].mean())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("trial", type=Path)
    parser.add_argument("--own", type=int, default=0, help="deformations by the truth's mechanics")
    arguments = parser.parse_args()
    files = TrialFiles(arguments.trial)
    truth = read_deformations(files.truth)
    template, cases = truth.template, seen_of(truth)
    usual = read_deformations(files.fields("about")).vertices.astype(float)
    held = read_vertex_numbers(files.held("about"), len(template.vertices))
    wide = simulate(template, Simulation(fixed="about", **WIDE), seed=1, fixed=held)
    tried = [
        ("distances across the surface, 0.02", usual, across, 0.02),
        (f"distances across the surface, {NOISE}", usual, across, NOISE),
        ("places", usual, places, NOISE),
        ("places, wide forces and weight", wide.vertices.astype(float), places, NOISE),
    ]
    if arguments.own:
        own = true_deformations(template, arguments.own, seed=7).vertices.astype(float)
        tried.append((f"places, {len(own)} made as the truth", own, places, NOISE))
        both = np.concatenate([own, usual])
        tried.append(("places, these and the simulations", both, places, NOISE))
    print("| given | hidden (median) |\n|---|---|")
    for label, fields, said, deviation in tried:
        found = np.array([hidden_error(case, fields, said, deviation) for case in cases])
        print(f"| {label} | {found.mean():.2f} ({np.median(found):.2f}) |", flush=True)


if __name__ == "__main__":
    main()
