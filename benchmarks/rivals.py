"""All methods on known deformations of real meshes and on real deformed pairs; print one table.

    python benchmarks/rivals.py ../shared/meshes

The pairs of ``registrations.py`` with known correspondence, partial ones apart. Every method sees
the same 1024 points of source and target, drawn independently, in the normalised frame, as they
are (no rigid alignment first). Mean correspondence errors in percent of the object's radius.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from known_pairs import deformed_copies, real_pairs

from dine.classical.methods import CLASSICAL
from dine.data.sampling import sample_surface
from dine.geometry.frame import Frame
from dine.models.checkpoint import load_backbone, shipped_weights
from dine.refinement.refine import ROUNDS, Options
from dine.registration.correspondence import predict_and_refine

POINTS = 1024


def methods() -> dict[str, Callable[[np.ndarray, np.ndarray], np.ndarray]]:
    """Displacement (N, 3) from source and target points, by the name of the method."""
    found = {name: CLASSICAL.get(name)() for name in CLASSICAL.names()}
    cpu = torch.device("cpu")
    for kind in ("robust_defreg", "deftransnet"):
        backbone, _ = load_backbone(shipped_weights(kind))
        for rounds, what in ((0, "network"), (ROUNDS, "refined")):
            found[f"{kind}, {what}"] = lambda s, t, b=backbone, r=rounds: predict_and_refine(
                b, s, t, cpu, Options(r)
            )[0]
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("meshes", type=Path)
    meshes = parser.parse_args().meshes
    torch.set_num_threads(1)
    tried = methods()
    print("| pair |", " | ".join(tried), "|")
    print("|---" * (len(tried) + 1) + "|")
    for title, group in (
        ("mean of the deformed copies", deformed_copies(meshes / "objects")),
        ("mean of the real pairs", real_pairs(meshes / "pairs")),
    ):
        rows = []
        for name, source, target, truth in group:
            if truth is None or "partial" in name:
                continue
            rng = np.random.default_rng(0)
            samples = sample_surface(source, POINTS, rng)
            frame = Frame.of(samples.places(source.vertices))
            start = frame.normalise(samples.places(source.vertices))
            goal = frame.normalise(sample_surface(target, POINTS, rng).places(target.vertices))
            places = frame.normalise(samples.places(truth))
            errors = [
                100 * np.linalg.norm(start + method(start, goal) - places, axis=1).mean()
                for method in tried.values()
            ]
            rows.append(errors)
            print(f"| {name} |", " | ".join(f"{error:.1f}" for error in errors), "|", flush=True)
        means = np.mean(rows, axis=0)
        print(f"| **{title}** |", " | ".join(f"**{mean:.1f}**" for mean in means), "|", flush=True)


if __name__ == "__main__":
    main()
