"""What a prior of one organ says of what a scan does not show: one row a template and method.

    python benchmarks/organ.py ../shared/meshes/objects [--deformations 12] [--only liver]
    python benchmarks/organ.py ../shared/meshes/objects --vary     # one thing at a time changed
    python benchmarks/organ.py ../shared/meshes/objects --edges    # convergence in the element size

Of every template 200 deformations are simulated (``dine simulate``), held about the end of the
second principal axis (patches of radius 0.2 to 0.5 with their middle within 0.25 of it), and a
prior is learned of them (``dine learn``). Test deformations are from other mechanics, under other
loads, in another grid, and held in a patch drawn alike: ``organ_truth.py``. A scan shows a share of
the surface from one side, with noise. Errors are mean distances of vertices from their true places
in percent of the radius: hidden and seen ones, and of a ball of radius 0.05 in the middle of the
thickest part; with half the width of their 95 % interval over deformations. ``within bound`` is
the share of hidden vertices within their 90 % bound. All deformations are synthetic, the shapes
real.

Methods share alignment, matching and schedule, and differ in the prior: a smooth process (that of
``dine register --surfaces``), principal components alone, and these with a process for the rest;
``one patch`` is the last from as many simulations that are all held at one patch of radius 0.35.
``unregistered`` is the template where it lies, ``rigid`` aligned by closest points; ``Bayesian
CPD`` is :mod:`dine.classical.bcpd` at the settings of the evidence.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from organ_conditions import conditions
from organ_truth import HELD, SHIFTED, attachment, inside_points, true_field
from scipy.spatial.transform import Rotation

from dine.classical.methods import CLASSICAL
from dine.config import OrganLearning, Simulation
from dine.geometry.frame import Frame
from dine.geometry.interpolation import FittedDisplacement
from dine.geometry.oriented import evenly
from dine.geometry.rigid import rigid_alignment, rigid_alignments, transformed
from dine.geometry.surface import Surface
from dine.io.readers import read_surface
from dine.priors.organ import OrganPrior
from dine.priors.organ_learning import learn
from dine.refinement.process import SURFACE
from dine.registration.organ import OrganField, deviation_and_bound, organ_field
from dine.registration.shapes import dense_points
from dine.simulation.simulate import simulate

TEMPLATES = {
    "liver": "organ_liver_smooth.ply",
    "tongue": "organ_tongue.ply",
    "heart": "organ_heart_biventricle.ply",
}
SEEN, NOISE = 0.4, 0.005
# Points that Bayesian CPD moves.
FEW = 1000


@dataclass(frozen=True)
class Case:
    """One deformation and what is seen of it, in radii.

    Attributes:
        truth: (V, 3) true places of the vertices.
        deep: (M, 3) true places of the points inside.
        scan: what is seen.
        seen: (V,) bool, vertices of it.
    """

    truth: np.ndarray
    deep: np.ndarray
    scan: Surface
    seen: np.ndarray


def scanned(
    template: Surface, field: np.ndarray, deep: np.ndarray, number: int, share: float, noise: float
) -> Case:
    """The faces that lie farthest in a drawn direction, up to a share of the area, with noise."""
    rng = np.random.default_rng([3, number])
    truth = template.vertices + field
    corners = truth[template.faces]
    area = np.linalg.norm(
        np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1
    )
    order = np.argsort(-corners.mean(axis=1) @ rng.normal(size=3))
    kept = order[np.cumsum(area[order]) <= share * area.sum()]
    used, index = np.unique(template.faces[kept], return_inverse=True)
    seen = np.zeros(len(truth), bool)
    seen[used] = True
    places = truth[used] + noise * rng.normal(size=(len(used), 3))
    return Case(truth, inside_points(template) + deep, Surface(places, index.reshape(-1, 3)), seen)


def variants(prior: OrganPrior) -> dict[str, OrganPrior]:
    """Priors to compare, by name."""
    smooth = replace(
        prior,
        mean=np.zeros_like(prior.mean),
        modes=prior.modes[:0],
        widths=SURFACE.widths,
        amplitudes=SURFACE.amplitudes,
    )
    alone = replace(prior, amplitudes=[1e-4] * len(prior.widths))
    return {"smooth process": smooth, "PCA": alone, "PCA and process": prior}


def measured(
    case: Case, field: OrganField, motion: Rotation | None, template: Surface
) -> list[float]:
    """Hidden, seen and deep errors, and the share of hidden vertices within their bound."""
    prior, alignment = field.placed.prior, field.placed.alignment
    places = alignment.normalise(template.vertices)
    moved = alignment.restore(places + field.at(prior.at_vertices(), places))
    deep = alignment.normalise(inside_points(template))
    moved_deep = alignment.restore(deep + field.anywhere()(deep))
    if motion is not None:
        moved, moved_deep = (motion.inv().apply(x) for x in (moved, moved_deep))
    error = np.linalg.norm(moved - case.truth, axis=1)
    hidden = np.flatnonzero(~case.seen)
    few = hidden[:: max(1, len(hidden) // 500)]
    carrier = prior.at_vertices()[few]
    _, bound = deviation_and_bound(field.covariance(carrier, places[few]))
    target = np.linalg.norm(moved_deep - case.deep, axis=1).mean()
    seen = error[case.seen].mean()
    return [error[hidden].mean(), seen, target, (error[few] <= bound).mean()]


def held(template: Surface) -> np.ndarray:
    """Mask (V,) of the vertices that the middle of what is held may be at."""
    return np.linalg.norm(template.vertices - attachment(template), axis=1) <= SHIFTED


def patch(template: Surface) -> np.ndarray:
    """Mask (V,) of the vertices of one patch of middling size that may be held."""
    apart = np.linalg.norm(template.vertices - attachment(template), axis=1)
    return apart <= sum(HELD) / 2


def learned(path: Path, fixed: str = "about") -> tuple[Surface, OrganPrior]:
    """A template in radii, and its prior, of simulations held as a setting says; the time that took
    is printed."""
    surface = read_surface(path)
    template = Surface(
        Frame.of(surface.vertices).normalise(surface.vertices), surface.faces, path.name
    )
    began = time.process_time()
    where = held(template) if fixed == "about" else patch(template)
    fields = simulate(template, Simulation(fixed=fixed), seed=1, fixed=where)
    simulated = time.process_time()
    prior = learn(template, [fields], OrganLearning())
    print(
        f"  {path.stem}: {len(template.vertices)} vertices, {len(fields.nodes[0])} nodes; "
        f"{simulated - began:.0f} CPU seconds to simulate {len(fields.vertices)}, "
        f"{time.process_time() - simulated:.0f} to learn; {len(prior.modes)} components, process "
        f"{np.round(prior.amplitudes, 3)}",
        flush=True,
    )
    return template, prior


def results(
    template: Surface,
    prior: OrganPrior,
    cases: list[Case],
    *,
    loose: bool = False,
) -> Iterator[tuple[float, ...]]:
    """For each case the errors and CPU seconds; ``loose`` turns and shifts the scans first."""
    for number, case in enumerate(cases):
        rng = np.random.default_rng([4, number])
        motion, matrices, scan = None, [np.eye(4)], case.scan
        if loose:
            motion = Rotation.from_rotvec(np.radians(15) * rng.normal(size=3) / np.sqrt(3))
            scan = replace(scan, vertices=motion.apply(scan.vertices))
        began = time.process_time()
        if loose:
            ours, theirs = dense_points(template), dense_points(scan)
            matrices = rigid_alignments(ours, theirs, partial=True)
        field, _ = organ_field(prior, scan, matrices, loose=loose, partial=True, seed=0)
        seconds = time.process_time() - began
        yield (*measured(case, field, motion, template), seconds)


def without_prior(template: Surface, cases: list[Case]) -> dict[str, np.ndarray]:
    """Errors (C, 3) of the template where it is, rigidly aligned to the scan, and by Bayesian
    CPD, the last with CPU seconds."""
    rows: dict[str, list] = {"unregistered": [], "rigid": [], "Bayesian CPD": []}
    deep = inside_points(template)
    few = template.vertices[evenly(template.vertices, FEW)]
    for case in cases:
        ours, theirs = dense_points(template), dense_points(case.scan)
        began = time.process_time()
        field = FittedDisplacement(few, CLASSICAL.get("bcpd")()(few, case.scan.vertices))
        seconds = time.process_time() - began
        matrix = rigid_alignment(ours, theirs, partial=True)
        for name, moved in (
            ("unregistered", lambda x: x),
            ("rigid", lambda x, matrix=matrix: transformed(x, matrix)),
            ("Bayesian CPD", lambda x, field=field: x + field(x)),
        ):
            error = np.linalg.norm(moved(template.vertices) - case.truth, axis=1)
            target = np.linalg.norm(moved(deep) - case.deep, axis=1).mean()
            rows[name].append([error[~case.seen].mean(), error[case.seen].mean(), target])
        rows["Bayesian CPD"][-1] += [np.nan, seconds]
    return {name: np.array(found) for name, found in rows.items()}


def row(label: str, found: np.ndarray) -> None:
    """Print means; of the errors with half their 95 % intervals."""
    percent = 100 * found[:, :3]
    half = 1.96 * percent.std(axis=0, ddof=1) / np.sqrt(len(found))
    numbers = [f"{m:.1f} ± {h:.1f}" for m, h in zip(percent.mean(axis=0), half, strict=True)]
    numbers[0] += f" ({np.median(percent[:, 0]):.1f})"
    if found.shape[1] > 3:
        within = found[:, 3].mean()
        numbers += ["" if np.isnan(within) else f"{100 * within:.0f} %"]
        numbers += [f"{np.median(found[:, 4]):.1f}"]
    else:
        numbers += ["", ""]
    print(f"| {label} | " + " | ".join(numbers) + " |", flush=True)


def drawn_cases(template: Surface, count: int) -> list[Case]:
    found = [true_field(template, 0, number) for number in range(count)]
    return [scanned(template, *fields, i, SEEN, NOISE) for i, fields in enumerate(found)]


def header(*first: str) -> None:
    columns = [*first, "hidden (median)", "seen", "target", "within bound", "CPU seconds"]
    print("| " + " | ".join(columns) + " |\n" + "|---" * len(columns) + "|")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("meshes", type=Path)
    parser.add_argument("--deformations", type=int, default=12)
    parser.add_argument("--only", nargs="+", default=list(TEMPLATES), help="or other files")
    parser.add_argument("--vary", action="store_true", help="one thing at a time changed")
    parser.add_argument("--edges", action="store_true", help="convergence in the element size")
    arguments = parser.parse_args()
    if arguments.edges:
        edges(arguments.meshes / TEMPLATES.get(arguments.only[0], arguments.only[0]))
        return
    for name in arguments.only:
        template, prior = learned(arguments.meshes / TEMPLATES.get(name, name))
        if arguments.vary:
            vary(name, template, prior, arguments.deformations)
            continue
        cases = drawn_cases(template, arguments.deformations)
        header("template", "prior")
        for label, found in without_prior(template, cases).items():
            row(f"{name} | {label}", found)
        _, one = learned(arguments.meshes / TEMPLATES.get(name, name), "exactly")
        compared = variants(prior) | {"PCA and process, one patch": one}
        for label, other in compared.items():
            row(f"{name} | {label}", np.array(list(results(template, other, cases))))


def vary(name: str, template: Surface, prior: OrganPrior, count: int) -> None:
    """One thing at a time changed, with the learned prior."""
    header("template", "condition")

    def shown(label: str, cases: list[Case], loose: bool = False) -> None:
        found = results(template, prior, cases, loose=loose)
        row(f"{name} | {label}", np.array(list(found)))

    fields = [true_field(template, 0, number) for number in range(count)]
    changed = {f"{share:.0%} seen": (share, NOISE) for share in (0.2, 0.4, 0.6, 0.8, 0.99)}
    changed |= {f"noise {noise:.1%}": (SEEN, noise) for noise in (0.0, 0.01, 0.02)}
    for label, (share, noise) in changed.items():
        shown(label, [scanned(template, *x, i, share, noise) for i, x in enumerate(fields)])
    cases = [scanned(template, *x, i, SEEN, NOISE) for i, x in enumerate(fields)]
    shown("turned by some 15 degrees, pose found", cases, loose=True)
    for label, fields in conditions(template, held(template), count):
        shown(label, [scanned(template, *x, i, SEEN, NOISE) for i, x in enumerate(fields)])


def edges(path: Path) -> None:
    """How far fields at an element size are from those at the finest one."""
    surface = read_surface(path)
    template = Surface(Frame.of(surface.vertices).normalise(surface.vertices), surface.faces)
    sizes = (0.2, 0.14, 0.1, 0.07, 0.05)
    found = {}
    for edge in sizes:
        began = time.process_time()
        settings = Simulation(fields=12, edge=edge, amplitude=[0.05, 0.1])
        fields = simulate(template, settings, seed=5)
        found[edge] = fields.vertices, len(fields.nodes[0]), time.process_time() - began
    finest = found[sizes[-1]][0]
    length = np.linalg.norm(finest, axis=2).mean(axis=1)
    print("| edge | nodes | difference | CPU seconds |\n|---|---|---|---|")
    for edge, (vertices, nodes, seconds) in found.items():
        apart = np.linalg.norm(vertices - finest, axis=2).mean(axis=1) / length
        print(f"| {edge} | {nodes} | {100 * np.median(apart):.1f} % | {seconds:.1f} |")


if __name__ == "__main__":
    main()
