"""Speed of pair making: mesh files to a pair file, index convention included, on one core."""

from __future__ import annotations

import tempfile
import time
from pathlib import Path

from dine.config import Pairs
from dine.data.obtain import SYNTHETIC
from dine.data.prepare import prepare_pairs
from dine.data.raw import Deformations, synthesise
from dine.files import file_digest, write_json

TARGET = 20.0
POINTS = 1024
PAIRS = 48
ROUNDS = 3


def pair_making() -> list[dict]:
    """Pairs per second at one and at eight targets a source, best of some rounds.

    Pair making runs in one thread by itself, so that nothing needs to be limited here.
    """
    results = []
    with tempfile.TemporaryDirectory() as folder:
        for shape, convention in (("primitives", "sphere"), ("tissue", "disc")):
            for targets in (1, 8):
                raw = _raw(Path(folder, f"{shape}{targets}"), shape, targets)
                settings = Pairs(points=POINTS, convention=convention)
                # The first round also loads, or compiles, the assignment.
                seconds, busy = min(_seconds(raw, settings) for _ in range(ROUNDS))
                results.append(
                    {
                        "what": f"pair making, {shape}, {targets} target(s) a source",
                        "value": PAIRS / seconds,
                        "unit": "pairs/s",
                        "target": TARGET,
                        "note": f"{PAIRS} pairs of {POINTS} points in convention {convention}, "
                        f"PLY to HDF5; best of {ROUNDS} rounds; {PAIRS / busy:.1f} pairs per "
                        "second of CPU time",
                    }
                )
    return results


def _raw(folder: Path, shape: str, targets: int) -> Path:
    """Mesh files of ``PAIRS`` pairs and the raw.json that names them."""
    deformations = Deformations(
        levels=[0.3],
        control_percents=[2.0, 5.0, 10.0],
        widths=[0.3, 0.4, 0.5],
        amplitude=0.25,
        points=POINTS,
        pairs_per_level=targets,
        seed=0,
    )
    synthesise(folder / "raw", deformations, shape, PAIRS // targets)
    content = file_digest(folder / "raw" / "provenance.json")
    facts = {"folder": str(folder / "raw"), "origin": SYNTHETIC, "content": content}
    write_json(folder / "raw.json", facts)
    return folder / "raw.json"


def _seconds(raw: Path, settings: Pairs) -> tuple[float, float]:
    wall, busy = time.perf_counter(), time.process_time()
    prepare_pairs(raw, settings, seed=0, out=raw.with_name("pairs.h5"))
    return time.perf_counter() - wall, time.process_time() - busy


if __name__ == "__main__":
    for row in pair_making():
        print(f"{row['what']}: {row['value']:.1f} {row['unit']} ({row['note']})")
