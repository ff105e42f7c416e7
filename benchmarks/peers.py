"""Other programs on the pairs of ``surfaces.py``, beside ``dine register``: one row a condition.

    python benchmarks/peers.py ../shared/meshes --half kept
    python benchmarks/peers.py ../shared/meshes --half tuned --settings   # what was tried of each

Every program gets the same two files, rigidly aligned by ``dine register`` and scaled to a radius
of one, and says where each vertex of the source belongs. Errors of all vertices in percent of the
object's radius, mean / median / largest over objects, and median CPU seconds. Programs are

- ``nricp``: Amberg, Romdhani and Vetter (2007), ``trimesh.registration.nricp_amberg``;
- ``meshmonk``: the wheel of that name, if it is installed (``pip install meshmonk``);
- ``bcpd``: Bayesian coherent point drift, Hirose (2021), our own implementation;
- ``cpd``: coherent point drift, Myronenko and Song (2010), by rustcpd.

The last two see 4,096 points of the source, of whose field the whole is made by their own kernel,
and 10,000 and 4,096 of the target. The first two need meshes, and ``nricp`` the package rtree.
Settings for small motions were chosen on two of the tuned objects (goat's head and malleus); those
for large motions and for sparse clouds have places of their own, and are guesses so far.
"""

from __future__ import annotations

import argparse
import importlib.util
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
import trimesh
from known_pairs import Pair, conditions, radius
from threadpoolctl import threadpool_limits

from dine.classical.bcpd import Parameters, bcpd
from dine.data.sampling import sample_surface
from dine.geometry.surface import Surface
from dine.priors.gaussian import covariance_root
from dine.registration.model import load_model
from dine.registration.register import register
from dine.registration.types import Model

SOURCE_POINTS, BCPD_POINTS, CPD_POINTS = 4096, 10_000, 4096
_SHOWN = 100  # radius that MeshMonk gets: its lengths are those of faces in millimetres


def nricp(source: Surface, target: Surface, **settings: Any) -> np.ndarray:
    meshes = (trimesh.Trimesh(s.vertices, s.faces, process=False) for s in (source, target))
    return trimesh.registration.nricp_amberg(*meshes, **settings)


def meshmonk(source: Surface, target: Surface, **settings: Any) -> np.ndarray:
    import meshmonk as library

    library.set_log_level("silent")
    faces = [surface.faces.astype(np.int32) for surface in (source, target)]
    features = [
        library.features_from_vertices(_SHOWN * surface.vertices, own)
        for surface, own in zip((source, target), faces, strict=True)
    ]
    found = library.pyramid_register(
        floating_features=features[0],
        target_features=features[1],
        floating_faces=faces[0],
        target_faces=faces[1],
        **settings,
    )
    return found.aligned_vertices.astype(float) / _SHOWN


def drawn(surface: Surface, count: int) -> np.ndarray:
    """So many points (n, 3) of a mesh by area, or as many of a cloud as there are."""
    count = count if surface.faces is not None else min(count, len(surface.vertices))
    return sample_surface(surface, count, np.random.default_rng(0)).places(surface.vertices)


def everywhere(
    points: np.ndarray, moved: np.ndarray, places: np.ndarray, width: float
) -> np.ndarray:
    """Where places (V, 3) belong if points (n, 3) belong to ``moved`` (n, 3), by the kernel that
    these were moved by and a linear part."""
    root = covariance_root(points, (width,), (1.0,), rank=400, tolerance=1e-6)

    def columns(x: np.ndarray, kernel: np.ndarray) -> np.ndarray:
        return np.column_stack([np.ones(len(x)), x, kernel])

    found = np.linalg.lstsq(columns(points, root.root), moved, rcond=1e-8)[0]
    return columns(places, root.at(places)) @ found


def bayesian(source: Surface, target: Surface, **settings: Any) -> np.ndarray:
    points = drawn(source, SOURCE_POINTS)
    moved = bcpd(points, drawn(target, BCPD_POINTS), Parameters(**settings)).moved
    deviation = float(np.sqrt(((points - points.mean(axis=0)) ** 2).mean()))
    return everywhere(points, moved, source.vertices, settings["beta"] * deviation)


def cpd(source: Surface, target: Surface, **settings: Any) -> np.ndarray:
    import rustcpd

    points = drawn(source, SOURCE_POINTS)
    found = rustcpd.register_deformable(
        drawn(target, CPD_POINTS),
        points,
        low_rank=400,
        low_rank_method="pivoted_cholesky",
        low_rank_tolerance=1e-6,
        outlier_weight=0.1,
        max_iterations=150,
        tolerance=1e-6,
        parallel=False,
        **settings,
    )
    return everywhere(points, found.points, source.vertices, settings["beta"])


def _steps(*smoothness: float) -> dict[str, Any]:
    """Of ``nricp``: weights of smoothness, normals at half weight, ten iterations of each."""
    return {"steps": [[weight, 0, 0.5, 10] for weight in smoothness]}


@dataclass(frozen=True)
class Peer:
    """A program and what was tried of it.

    Attributes:
        moved: from source, target and a setting, where the source's vertices (V, 3) belong.
        settings: those tried; the first is the program's own, or the published one.
        chosen: which of them, for each of :data:`KINDS`.
        needs: module that it needs, beside what every installation for development has.
        clouds: whether it takes points without faces.
    """

    moved: Callable[..., np.ndarray]
    settings: list[dict[str, Any]]
    chosen: tuple[int, ...]
    needs: str
    clouds: bool = False


def _drift(beta: float, lam: float, gamma: float) -> dict[str, Any]:
    """Of ``bcpd``: with the displacements' mean for their posterior."""
    return {"beta": beta, "lam": lam, "gamma": gamma, "uncertain": False}


KINDS = (["remeshed", "noise", "hole", "4096", "faces", "liver"], ["0.8", "bent"], ["1024"])
PEERS = {
    "nricp": Peer(
        nricp,
        [{}, _steps(0.1, 0.05, 0.02, 0.01), {"distance_threshold": 0.3}, {"use_faces": False}],
        (0, 0, 0),
        "rtree",
    ),
    "meshmonk": Peer(
        meshmonk,
        [
            {},
            {"num_iterations": 200},
            {"inlier_kappa": 4.0},
            {"transform_sigma": 2.0, "num_iterations": 200},
            {"transform_sigma": 6.0, "num_iterations": 200},
        ],
        (0, 0, 0),
        "meshmonk",
    ),
    "bcpd": Peer(
        bayesian,
        [
            _drift(2.0, 200, 0.1),
            _drift(2.0, 50, 1.0),
            _drift(2.0, 200, 1.0),
            _drift(1.4, 20, 1.0),
            _drift(1.0, 50, 0.3),
        ],
        (0, 0, 0),
        "dine",
        True,
    ),
    "cpd": Peer(
        cpd,
        [
            {"beta": 0.5, "alpha": 64.0},
            {"beta": 0.5, "alpha": 512.0},
            {"beta": 0.5, "alpha": 2048.0},
            {"beta": 0.7, "alpha": 1024.0},
            {"beta": 1.0, "alpha": 256.0},
        ],
        (2, 1, 2),
        "rustcpd",
        True,
    ),
}


class Case(NamedTuple):
    """A pair in the normalised frame of its rigid alignment.

    Attributes:
        name: of the pair.
        source: radius about 1.
        target: likewise.
        truth: (V, 3) where the source's vertices belong.
        unit: length of the frame in percent of the object's radius.
        ours: error and CPU seconds of ``dine register``.
    """

    name: str
    source: Surface
    target: Surface
    truth: np.ndarray
    unit: float
    ours: tuple[float, float]

    def error(self, moved: np.ndarray) -> float:
        """Mean distance of vertices (V, 3) from where they belong, in percent of the radius."""
        return float(np.linalg.norm(moved - self.truth, axis=1).mean()) * self.unit


def cases(pairs: Iterator[Pair], model: Model) -> Iterator[Case]:
    for name, source, target, truth in pairs:
        began = time.process_time()
        result = register(source, target, model=model)
        seconds = time.process_time() - began
        alignment, frame = result.alignment, result.alignment.frame
        case = Case(
            name,
            Surface(alignment.normalise(source.vertices), source.faces),
            Surface(frame.normalise(target.vertices), target.faces),
            frame.normalise(truth),
            100 * frame.scale / radius(source),
            (0.0, seconds),
        )
        found = case.error(frame.normalise(result.moved.vertices))
        yield case._replace(ours=(found, seconds))


def tried(peer: Peer, setting: dict[str, Any], case: Case) -> tuple[float, float]:
    """Error and CPU seconds; the rigid alignment's error if the program fails."""
    began = time.process_time()
    try:
        moved = peer.moved(case.source, case.target, **setting)
    except (ArithmeticError, ValueError, RuntimeError) as error:
        print(f"  {error}", flush=True)
        moved = case.source.vertices
    return case.error(moved), time.process_time() - began


def cell(found: np.ndarray, ours: np.ndarray) -> str:
    """Of errors and seconds (n, 2): mean / median / largest, how many better than ours, seconds."""
    error = found[:, 0]
    numbers = " / ".join(f"{x:.2f}" for x in (error.mean(), np.median(error), error.max()))
    better = "" if found is ours else f"; {(error < ours[:, 0]).sum()} better"
    return f"{numbers}{better}; {np.median(found[:, 1]):.1f} s"


def options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("meshes", type=Path)
    parser.add_argument("--half", choices=["tuned", "kept"], help="of the objects")
    parser.add_argument("--every", type=int, default=1, help="of so many pairs take one")
    parser.add_argument(
        "--only",
        nargs="+",
        default=[w for kind in KINDS for w in kind],
        help="words in the conditions",
    )
    parser.add_argument("--programs", nargs="+", default=list(PEERS), choices=list(PEERS))
    parser.add_argument(
        "--pairs", nargs="+", default=[""], help="words in the names of those wanted"
    )
    parser.add_argument("--each", action="store_true", help="a line for every pair, too")
    parser.add_argument("--settings", action="store_true", help="a row for each setting tried")
    return parser.parse_args()


def main() -> None:
    chosen = options()
    torch.set_num_threads(1)
    model = load_model()
    there = [name for name in chosen.programs if importlib.util.find_spec(PEERS[name].needs)]
    for name in set(chosen.programs) - set(there):
        print(f"{name} is left out, since {PEERS[name].needs} is not installed.")
    print("| targets | pairs | `dine register` | " + " | ".join(there) + " |")
    print("|---" * (3 + len(there)) + "|", flush=True)
    for condition, pairs in conditions(chosen.meshes, chosen.half).items():
        if not any(word in condition for word in chosen.only):
            continue
        kind = next(k for k, words in enumerate(KINDS) if any(word in condition for word in words))
        few = (pair for pair in pairs if any(word in pair[0] for word in chosen.pairs))
        few = islice(few, 0, None, chosen.every)
        rows: dict[tuple[str, int], list[tuple[float, float]]] = {}
        ours = []
        for case in cases(few, model):
            ours.append(case.ours)
            for name in there:
                peer = PEERS[name]
                if case.source.faces is None and not peer.clouds:
                    continue
                for number, setting in enumerate(peer.settings):
                    if chosen.settings or number == peer.chosen[kind]:
                        found = tried(peer, setting, case)
                        rows.setdefault((name, number), []).append(found)
                        if chosen.each:
                            numbers = [*case.ours, name, number, *found]
                            print(f"  {condition}, {case.name}:", *numbers, flush=True)
        show(condition, np.array(ours), {k: np.array(v) for k, v in rows.items()}, there)


def show(
    condition: str, ours: np.ndarray, rows: dict[tuple[str, int], np.ndarray], names: list[str]
) -> None:
    """A row of the table, or one for each setting that was tried."""
    most = max((sum(name == other for other, _ in rows) for name in names), default=1)
    for place in range(max(most, 1)):
        cells = [cell(ours, ours)]
        for name in names:
            own = [found for (other, _), found in rows.items() if other == name]
            cells.append(cell(own[place], ours) if place < len(own) else "–")
        print(f"| {condition} | {len(ours)} | " + " | ".join(cells) + " |", flush=True)


if __name__ == "__main__":
    with threadpool_limits(1):
        main()
