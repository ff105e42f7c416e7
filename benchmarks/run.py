"""Measure the registration core and the workflow; print one table and keep it with the machine.

    python benchmarks/run.py                       # the core, some 3 minutes
    python benchmarks/run.py --workflow            # the default run too, some 15 minutes more
    python benchmarks/run.py --render FILE.json    # the table of an earlier run

All data are synthetic. Times are medians of one run on a machine that does nothing else; the
ratio is to the plain formulas of ``tests/reference.py`` on the same machine.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT / "tests"), str(ROOT / "benchmarks")]

import floor  # noqa: E402
import reference  # noqa: E402
import sklearn.decomposition  # noqa: E402, F401 (an import that the measured memory leaves out)

from dine.data.batch import make_batch  # noqa: E402
from dine.geometry.chamfer import chamfer_distance  # noqa: E402
from dine.geometry.graph import neighbour_graph  # noqa: E402
from dine.models.backbones import BACKBONES, Backbone  # noqa: E402
from dine.models.belief_propagation import (  # noqa: E402
    propagate,
    read_out,
    select_candidates,
)
from dine.models.compiled.messages import BeliefPropagation  # noqa: E402
from dine.priors.pca import PCAPrior  # noqa: E402
from dine.provenance import versions  # noqa: E402

NAMES = ("robust_defreg", "deftransnet")
POINTS = 1024
PUBLISHED = {"register": (8.5, 9.5), "step": (8.7, 10.9)}
TARGETS = {"register": (0.15, 0.20), "step": (0.30, 0.40)}


def row(what: str, value: float, unit: str, target: str = "", note: str = "") -> dict:
    print(f"{what}: {value:.4g} {unit}", file=sys.stderr, flush=True)
    return {"what": what, "value": value, "unit": unit, "target": target, "note": note}


def median(call: Callable[[], object], repeats: int = 15, warm: int = 3) -> float:
    for _ in range(warm):
        call()
    times = []
    for _ in range(repeats):
        began = time.perf_counter()
        call()
        times.append(time.perf_counter() - began)
    return float(np.median(times))


def synchronised(device: str, call: Callable[[], object]) -> Callable[[], object]:
    if device == "cpu":
        return call

    def run():
        call()
        torch.cuda.synchronize()

    return run


def pair(points: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """A synthetic bumpy sphere and its smooth deformation, in another order."""
    rng = np.random.default_rng(seed)
    source = rng.normal(size=(points, 3))
    source /= np.linalg.norm(source, axis=1, keepdims=True)
    source *= 1 + 0.2 * np.sin(3 * source[:, :1]) * np.cos(2 * source[:, 1:2])
    target = source + 0.1 * np.sin(3 * source[:, [1, 2, 0]])
    return source, target[rng.permutation(points)]


def backbone_of(name: str, device: str = "cpu", precision: str = "float32") -> Backbone:
    torch.manual_seed(0)
    backbone = BACKBONES.get(name)().to(device)
    backbone.precision = precision
    return backbone


def batch_of(sizes: list[int], device: str = "cpu"):
    sources, targets = zip(*(pair(n, seed) for seed, n in enumerate(sizes)), strict=True)
    return make_batch(sources, targets).to(device)


def registration(backbone: Backbone, batch) -> Callable[[], object]:
    @torch.no_grad()
    def call():
        return backbone(batch).displacement

    return call


def training(backbone: Backbone, batch) -> Callable[[], object]:
    points = batch.source.shape[1]
    fields = 0.1 * np.random.default_rng(0).normal(size=(80, points, 3)).astype(np.float32)
    prior = PCAPrior.fit(fields, seed=0, components=64).to(batch.source.device)
    optimiser = torch.optim.AdamW(backbone.parameters(), fused=True)

    def call():
        displacement = backbone(batch).displacement
        loss = chamfer_distance(
            batch.source + displacement, batch.target, batch.source_mask, batch.target_mask
        ).mean()
        loss = loss + 1e-4 * prior.penalty(displacement, batch.source_mask).mean()
        optimiser.zero_grad(set_to_none=True)
        loss.backward()
        optimiser.step()

    return call


def matrix_rate(size: int = 2048) -> float:
    """Operations per second of a library's single-precision matrix product, at its best."""
    a, b = torch.randn(2, size, size)
    return 2 * size**3 / min(median(lambda: a @ b, repeats=1, warm=1) for _ in range(15))


def core(rate: float) -> list[dict]:
    rows = []
    for index, name in enumerate(NAMES):
        backbone, batch = backbone_of(name), batch_of([POINTS])
        state = {key: value.detach() for key, value in backbone.state_dict().items()}
        source, target = batch.source[0], batch.target[0]
        with torch.no_grad():
            plain = median(lambda: reference.register(state, source, target), 1, 0)  # noqa: B023
        seconds = median(registration(backbone, batch))
        least = floor.registration(name) / rate
        rows.append(
            row(
                f"register one pair, {name}",
                seconds,
                "s",
                f"≤ {TARGETS['register'][index]}",
                f"{plain / seconds:.0f}× faster than the plain formulas ({plain:.1f} s), "
                f"{PUBLISHED['register'][index] / seconds:.0f}× than the published time; "
                f"arithmetic at the matrix rate {least:.3f} s",
            )
        )
        seconds = median(training(backbone, batch))
        least = floor.training_step(name) / rate
        rows.append(
            row(
                f"training step of one pair, {name}",
                seconds,
                "s",
                f"≤ {TARGETS['step'][index]}",
                f"{small_step_ratio(name):.0f}× faster than the plain formulas at 200 points, "
                f"{PUBLISHED['step'][index] / seconds:.0f}× than the published time; arithmetic at "
                f"the matrix rate {least:.3f} s",
            )
        )
    return rows


def small_step_ratio(name: str) -> float:
    """Plain over ours, for forward and backward; at 1024 points the plain tables need 10 GB."""
    backbone, batch = backbone_of(name), batch_of([200])
    state = {key: value.detach().requires_grad_() for key, value in backbone.state_dict().items()}

    def plain():
        found = reference.register(state, batch.source[0], batch.target[0])
        reference.chamfer_distance(batch.source[0] + found, batch.target[0]).backward()

    def ours():
        found = backbone(batch).displacement
        chamfer_distance(batch.source + found, batch.target).sum().backward()

    return median(plain, 1, 0) / median(ours, 9)


def messages(rate: float) -> list[dict]:
    rows = []
    rng = np.random.default_rng(0)
    graph = neighbour_graph(pair(POINTS)[0], 10)
    displacement = torch.from_numpy(rng.normal(size=(POINTS, 128, 3))).float()
    cost = torch.from_numpy(rng.random((POINTS, 128))).float()
    work = 8.0 * len(graph.tail) * 128**2
    for gradient in (False, True):
        leaf = cost.clone().requires_grad_(gradient)

        def call(leaf=leaf):
            return BeliefPropagation.apply(leaf, displacement, graph, 10.0, 2)

        share = 100 * work / (median(call) / 2) / rate
        rows.append(
            row(
                "one message update" + (", winners kept for a gradient" if gradient else ""),
                share,
                "% of the matrix rate",
                "" if gradient else "≥ 30",
                f"{work / 1e9:.2f} Gflop counted as 8 per pair of candidates; "
                f"matrix rate {rate / 1e9:.0f} Gflop/s",
            )
        )
    return rows


def parts() -> list[dict]:
    """Where the time of one registration goes, and how it grows with K."""
    rows = []
    for name in NAMES:
        backbone, batch = backbone_of(name), batch_of([POINTS])
        with torch.no_grad():
            features = backbone.features(batch)
            clouds = (batch.source, batch.target, *features)
            candidates = select_candidates(*clouds, 128)
            belief = propagate(candidates, batch.graph)
            shares = {
                "features": median(lambda: backbone.features(batch)),  # noqa: B023
                "candidates": median(lambda: select_candidates(*clouds, 128)),  # noqa: B023
                "messages": median(lambda: propagate(candidates, batch.graph)),  # noqa: B023
                "read-out": median(lambda: read_out(candidates, belief)),  # noqa: B023
            }
        whole = sum(shares.values())
        note = ", ".join(f"{part} {1000 * t:.1f} ms" for part, t in shares.items())
        share = 100 * shares["messages"] / whole
        rows.append(row(f"share of the messages in one registration, {name}", share, "%", "", note))
    counts = (32, 64, 128, 256)
    times = []
    for count in counts:
        backbone = BACKBONES.get(NAMES[0])(candidates=count)
        times.append(median(registration(backbone, batch_of([POINTS])), 9))
    note = f"at K = {', '.join(map(str, counts))}: {', '.join(f'{t:.3f}' for t in times)} s"
    rows.append(row(f"K = 256 instead of 128, {NAMES[0]}", times[3] / times[2], "× time", "", note))
    return rows


def batches() -> list[dict]:
    rows = []
    for name in NAMES:
        backbone = backbone_of(name)
        one = median(registration(backbone, batch_of([POINTS])), 9)
        eight = median(registration(backbone, batch_of([POINTS] * 8)), 5, 1) / 8
        sizes = [1024, 900, 1000, 700, 850, 1024, 960, 640]
        unequal = batch_of(sizes)
        mixed = median(registration(backbone, unequal), 5, 1)
        alone = sum(median(registration(backbone, batch_of([n])), 3, 1) for n in sizes)
        rows.append(
            row(f"batch of 8 against 8 alone, {name}", eight / one, "× the time", "", "per pair")
        )
        rows.append(
            row(
                f"batch of 8 unequal pairs against each alone, {name}",
                mixed / alone,
                "× the time",
                "",
                "640 to 1024 points, padded to 1024",
            )
        )
    return rows


def peak_megabytes() -> float:
    """Largest resident size of this process so far, MB."""
    status = Path("/proc/self/status")
    if status.exists():  # what getrusage says includes the parent's size at the start
        lines = dict(line.split(":", 1) for line in status.read_text().splitlines())
        return int(lines["VmHWM"].split()[0]) / 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def child(what: str, name: str, points: int) -> dict:
    """Runs in a process of its own: the peak of memory above what the imports take."""
    before = peak_megabytes()
    backbone, batch = backbone_of(name), batch_of([points])
    call = (training if what == "train" else registration)(backbone, batch)
    seconds = median(call, 3, 1)
    return {"seconds": seconds, "megabytes": peak_megabytes() - before}


def in_child(what: str, name: str, points: int, threads: int) -> dict:
    command = [sys.executable, __file__, "--threads", str(threads)]
    command += ["--child", what, name, str(points)]
    return json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)


def memory_and_growth(threads: int) -> list[dict]:
    rows = []
    for name in NAMES:
        result = in_child("train", name, POINTS, threads)
        note = "above the imported libraries"
        megabytes = result["megabytes"]
        rows.append(row(f"memory to train one pair, {name}", megabytes, "MB", "≤ 300", note))
    for name in NAMES:
        sizes = (1024, 2048, 4096, 8192)
        results = [in_child("register", name, points, threads) for points in sizes]
        seconds = [result["seconds"] for result in results]
        power = np.polyfit(np.log(sizes), np.log(seconds), 1)[0]
        times = ", ".join(f"{s:.2f}" for s in seconds)
        rows.append(
            row(
                f"register N = M = 8192, {name}",
                seconds[-1],
                "s",
                "about linear in N",
                f"at 1024, 2048, 4096, 8192: {times} s, as N^{power:.2f}",
            )
        )
        megabytes = results[-1]["megabytes"]
        rows.append(row(f"… its memory, {name}", megabytes, "MB", "< 4000", "above the imports"))
    return rows


def precision() -> list[dict]:
    """What bf16 does to the displacement of trained weights."""
    from dine.models.checkpoint import load_backbone, shipped_weights

    rows = []
    for name in NAMES:
        backbone, _ = load_backbone(shipped_weights(name))
        errors = {}
        for kind in ("float32", "bf16"):
            backbone.precision = kind
            errors[kind] = []
            for seed in range(8):
                source, target = pair(POINTS, seed)
                order = np.random.default_rng(seed)
                order.normal(size=(POINTS, 3))
                order = order.permutation(POINTS)
                with torch.no_grad():
                    found = backbone(make_batch([source], [target])).displacement[0].numpy()
                truth = np.empty_like(target)
                truth[order] = target
                errors[kind].append(np.linalg.norm(source + found - truth, axis=1).mean())
        exact, reduced = (float(np.mean(errors[kind])) for kind in ("float32", "bf16"))
        rows.append(
            row(
                f"bf16 instead of float32, shipped {name}",
                100 * (reduced / exact - 1),
                "% mean correspondence error",
                "",
                f"from {exact:.5f} to {reduced:.5f} on 8 synthetic pairs",
            )
        )
    return rows


def gpu() -> list[dict]:
    rows = []
    for name in NAMES:
        for kind in ("float32", "bf16"):
            for size in (1, 32, 64):
                backbone, batch = backbone_of(name, "cuda", kind), batch_of([POINTS] * size, "cuda")
                call = synchronised("cuda", registration(backbone, batch))
                rows.append(
                    row(
                        f"registrations, {name}, {kind}, batch {size}",
                        size / median(call),
                        "per second",
                        "≥ 1500" if size >= 32 else "",
                        torch.cuda.get_device_name(),
                    )
                )
                call = synchronised("cuda", training(backbone, batch))
                rows.append(
                    row(
                        f"training, {name}, {kind}, batch {size}",
                        size / median(call),
                        "pairs per second",
                        "≥ 300" if size >= 32 else "",
                        torch.cuda.get_device_name(),
                    )
                )
    return rows


def workflow(jobs: int) -> list[dict]:
    """The default run and an idle one, in a copy of the committed project."""
    folder = Path(tempfile.mkdtemp())
    try:
        copy = folder / "dine"
        subprocess.run(["git", "clone", "-q", ROOT, copy], check=True)
        snakemake = Path(sys.executable).with_name("snakemake")
        command = [snakemake, f"-j{jobs}", "all"]
        # The installed package may lie elsewhere; the rules must run the copy.
        environment = {**os.environ, "PYTHONPATH": str(copy)}
        times = []
        for _ in range(2):
            began = time.perf_counter()
            subprocess.run(command, cwd=copy, check=True, capture_output=True, env=environment)
            times.append(time.perf_counter() - began)
    finally:
        shutil.rmtree(folder)
    return [
        row("whole default run", times[0] / 60, "min", "≤ 12", f"snakemake -j{jobs} all"),
        row("second run with nothing to do", times[1], "s", "≤ 6", f"snakemake -j{jobs} all"),
    ]


def processor() -> str:
    for line in Path("/proc/cpuinfo").read_text().splitlines() if os.name == "posix" else []:
        if line.startswith("model name"):
            return line.split(":")[1].strip()
    return platform.processor()


def render(result: dict) -> str:
    """The Markdown table of a result."""
    machine = result["machine"]
    lines = [
        f"{machine['processor']}, {machine['threads']} threads of {machine['cores']} cores, "
        f"{machine['device']}; torch {result['versions']['torch']}, {result['date']}; "
        f"`{result['command']}`",
        "",
        "| what | measured | target | |",
        "|---|---|---|---|",
    ]
    for entry in result["rows"]:
        value = f"{entry['value']:.3g}" if abs(entry["value"]) < 1000 else f"{entry['value']:.0f}"
        lines.append(
            f"| {entry['what']} | {value} {entry['unit']} | {entry['target'] or '–'} "
            f"| {entry['note']} |"
        )
    return "\n".join(lines) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--threads", type=int, default=min(2, os.cpu_count() or 1))
    parser.add_argument("--workflow", action="store_true", help="time the default run too")
    parser.add_argument("--out", type=Path, default=ROOT / "benchmarks" / "results")
    parser.add_argument("--name", default=platform.node(), help="of the file of results")
    parser.add_argument("--render", type=Path, help="show the table of this file and stop")
    parser.add_argument("--child", nargs=3, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.render:
        print(render(json.loads(arguments.render.read_text())), end="")
        return
    torch.set_num_threads(arguments.threads)
    if arguments.child:
        what, name, points = arguments.child
        print(json.dumps(child(what, name, int(points))))
        return
    from pair_making import pair_making

    cuda = torch.cuda.is_available()
    # Twice, as whatever else a machine does lowers it and flatters what is compared with it.
    rate = matrix_rate()
    rate = max(rate, matrix_rate())
    rows = [*core(rate), *messages(rate), *parts(), *batches()]
    rows += memory_and_growth(arguments.threads)
    rows += [*precision()]
    rows += [
        {**entry, "target": f"≥ {entry['target']:g}" if entry["target"] else ""}
        for entry in pair_making()
    ]
    if cuda:
        rows += gpu()
    if arguments.workflow:
        rows += workflow(2)
    result = {
        "command": "python benchmarks/run.py" + (" --workflow" if arguments.workflow else ""),
        "date": time.strftime("%Y-%m-%d"),
        "machine": {
            "processor": processor(),
            "cores": os.cpu_count(),
            "threads": arguments.threads,
            "device": torch.cuda.get_device_name() if cuda else "no GPU",
            "matrix_rate": rate,
        },
        "versions": versions(),
        "rows": rows,
    }
    arguments.out.mkdir(parents=True, exist_ok=True)
    path = arguments.out / f"{arguments.name}.json"
    path.write_text(json.dumps(result, indent=1, ensure_ascii=False) + "\n")
    print(render(result), end="")


if __name__ == "__main__":
    main()
