"""What a run costs per pair and per job, and from that what 10², 10⁴ and 10⁶ training pairs take.

    python benchmarks/scale.py                       # measures everything, some 15 minutes
    python benchmarks/scale.py --render FILE.json    # the tables of an earlier run

Seconds are of processor time on one core, so that other work on the machine matters little. What
each step costs to start is told apart from what it costs per pair by running it at two sizes.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np

ROOT = Path(__file__).resolve().parents[1]

from dine.data.fields import TrainingFields, write_training_fields  # noqa: E402
from dine.data.pairs import PairSet, write_pairs  # noqa: E402
from dine.files import read_json  # noqa: E402
from dine.provenance import versions  # noqa: E402

POINTS = 1024
OBJECTS = 6
# 8 levels; times one or nine deformations of each object and level.
TARGETS = (1, 9)
STEPS = (2, 12)
READ = (400, 4000)
FIELDS = (256, 1024, 4096)
SEEDS = (15, 165)
TRAINING_PAIRS = (10**2, 10**4, 10**6)
SPLIT = {"train": 0.6, "val": 0.2, "test": 0.2}


class Cost(NamedTuple):
    """Of a process: seconds of processor time, largest memory in bytes, and what it printed."""

    seconds: float
    memory: float
    output: str = ""


class Growth(NamedTuple):
    """A cost that grows in proportion: ``start`` + ``each`` × number."""

    start: float
    each: float

    def at(self, number: float) -> float:
        return self.start + self.each * number


def growth(numbers: tuple[float, float], values: tuple[float, float]) -> Growth:
    each = (values[1] - values[0]) / (numbers[1] - numbers[0])
    return Growth(max(0.0, values[0] - each * numbers[0]), max(0.0, each))


LAUNCH = """
import json, os, subprocess, sys
process = subprocess.Popen(sys.argv[2:], stdout=sys.stderr)
_, status, usage = os.wait4(process.pid, 0)
with open(sys.argv[1], "w") as stream:
    json.dump([usage.ru_utime + usage.ru_stime, usage.ru_maxrss * 1024], stream)
sys.exit(os.waitstatus_to_exitcode(status))
"""
"""A process begins with the memory of the one that starts it, which is therefore a small one."""


def run(*command: object) -> Cost:
    """Run a command of this Python and say what it took."""
    environment = os.environ | {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    environment["PYTHONPATH"] = os.pathsep.join([str(ROOT), environment.get("PYTHONPATH", "")])
    command = [str(part) for part in command]
    with tempfile.NamedTemporaryFile("r") as usage:
        done = subprocess.run(
            [sys.executable, "-c", LAUNCH, usage.name, sys.executable, "-m", *command],
            cwd=ROOT,
            env=environment,
            stderr=subprocess.PIPE,
            text=True,
        )
        if done.returncode:
            raise SystemExit(f"{' '.join(command)} failed:\n{done.stderr}")
        seconds, memory = json.load(usage)
    print(f"{' '.join(command)[:60]}: {seconds:.1f} s", file=sys.stderr, flush=True)
    return Cost(seconds, memory, done.stderr)


def size(path: Path) -> int:
    """Bytes of a file or of all files below a folder."""
    files = path.rglob("*") if path.is_dir() else [path]
    return sum(file.stat().st_size for file in files if file.is_file())


def along_the_workflow(folder: Path) -> dict:
    """Each step on few and on many pairs; per pair of what it works on."""
    found: dict[str, list[dict]] = {}

    def note(step: str, number: int, cost: Cost, path: Path) -> None:
        found.setdefault(step, []).append(
            {
                "number": number,
                "seconds": cost.seconds,
                "bytes": size(path),
            }
        )

    for targets in TARGETS:
        here = folder / str(targets)
        here.mkdir()
        count = OBJECTS * 8 * targets
        raw, pairs = here / "raw.json", here / "pairs.h5"
        recipe = {"objects": OBJECTS, "pairs_per_level": targets}
        settings = json.dumps({"recipe": recipe, "pairs": {"points": POINTS}})
        note("raw", count, run("dine", "raw", "--settings", settings, "--out", here), here / "raw")
        settings = json.dumps({"points": POINTS, "split": SPLIT})
        cost = run("dine", "pairs", "--raw", raw, "--settings", settings, "--out", pairs)
        note("pairs", count, cost, pairs)
        parts = {part: len(_split(pairs, part)) for part in SPLIT}
        model = here / "model"
        train(pairs, "robust_defreg", 1, model)
        model /= "model.safetensors"
        fields, predictions = here / "dvf.h5", here / "predictions.h5"
        cost = run("dine", "fields", "--model", model, "--pairs", pairs, "--out", fields)
        note("fields", parts["train"], cost, fields)
        given = ("--model", model, "--pairs", pairs, "--name", "scale", "--out", predictions)
        note("predict", parts["test"], run("dine", "predict", *given), predictions)
        given = ("--predictions", predictions, "--pairs", pairs, "--dataset", "synbench")
        given += ("--backbone", "robust_defreg", "--method", "stage1", "--out", here / "m.csv")
        given += ("--point-errors", here / "errors.h5")
        note("evaluate", parts["test"], run("dine", "evaluate", *given), here / "errors.h5")
    return found


def _split(pairs: Path, part: str) -> np.ndarray:
    from dine.data.pairs import read_pairs

    return read_pairs(pairs, split=part).level


def train(pairs: Path, backbone: str, steps: int, out: Path) -> Cost:
    settings = {"steps": steps, "validate_every": steps, "validation_pairs": 1}
    return run(
        *("dine", "--threads", 1, "stage1", "--pairs", pairs, "--device", "cpu"),
        *("--backbone", json.dumps({"kind": backbone}), "--settings", json.dumps(settings)),
        *("--name", "scale", "--out", out),
    )


def training_steps(folder: Path) -> dict:
    """Processor seconds of a step, by backbone."""
    pairs = folder / str(TARGETS[0]) / "pairs.h5"
    found = {}
    for backbone in ("robust_defreg", "deftransnet"):
        costs = [train(pairs, backbone, n, folder / f"{backbone}{n}").seconds for n in STEPS]
        found[backbone] = growth(STEPS, tuple(costs))._asdict()
    return found


def random_pairs(count: int) -> PairSet:
    """Pairs of random numbers, in the shape of real ones."""
    rng = np.random.default_rng(0)
    points = rng.normal(size=(count, POINTS, 3)).astype(np.float32)
    names = np.array([f"0.5/{i:07d}_10_0.4" for i in range(count)])
    return PairSet(
        source=points,
        target=points + np.float32(0.1),
        center=np.zeros((count, 3)),
        scale=np.ones(count),
        level=np.full(count, 0.5),
        name=names,
        object=names,
        split=np.array(["train"] * (count - 8) + ["val"] * 4 + ["test"] * 4),
        source_file=names,
        target_file=names,
        vertex_index=np.zeros((count, POINTS, 3), np.int32),
        vertex_weight=np.full((count, POINTS, 3), 1 / 3),
        attributes={"convention": "sphere"},
    )


def reading(folder: Path) -> list[dict]:
    """A training of one step on few and on many pairs: what it takes to hold them."""
    found = []
    for count in READ:
        path = folder / f"random{count}.h5"
        write_pairs(path, random_pairs(count))
        cost = train(path, "robust_defreg", 1, folder / f"read{count}")
        found.append({"number": count, "seconds": cost.seconds, "memory": cost.memory})
        path.unlink()
    return found


def prior_fits(folder: Path) -> list[dict]:
    """The PCA prior on ever more fields, which have 40 directions and noise."""
    found = []
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(40, 3 * POINTS))
    for count in FIELDS:
        values = rng.normal(size=(count, 40)) @ directions
        values += 0.1 * rng.normal(size=values.shape)
        values = values.reshape(count, POINTS, 3).astype(np.float32)
        path = folder / f"fields{count}.h5"
        names = np.array([str(i) for i in range(count)])
        write_training_fields(path, names, TrainingFields(values, values, values, "sphere"))
        cost = run(
            *("dine", "--threads", 1, "fit-prior", "--fields", path),
            *("--settings", json.dumps({"kind": "pca"}), "--out", folder / "prior.safetensors"),
        )
        found.append({"number": count, "seconds": cost.seconds, "memory": cost.memory})
        path.unlink()
    return found


def job_graphs(folder: Path) -> list[dict]:
    """A dry run of the evidence with more and more seeds."""
    found = []
    for seeds in SEEDS:
        path = folder / f"seeds{seeds}.yaml"
        path.write_text(f"evidence: {{seeds: {list(range(seeds))}}}\nresults: {folder / 'none'}\n")
        given = ("evidence", "--dry-run", "--quiet", "rules", "--configfile", path)
        cost = run("snakemake", *given)
        jobs = int(re.search(r"^total +(\d+)", cost.output, re.MULTILINE)[1])
        found.append({"number": jobs, "seconds": cost.seconds, "memory": cost.memory})
    return found


def extrapolated(result: dict) -> list[tuple[str, list[str]]]:
    """Rows of the table: what, and its value for each number of training pairs."""
    steps = result["steps"]

    def of(step: str, what: str) -> Growth:
        entries = steps[step]
        return growth(*zip(*[(e["number"], e[what]) for e in entries], strict=True))

    def both(entries: list[dict], what: str) -> Growth:
        return growth(*zip(*[(e["number"], e[what]) for e in entries], strict=True))

    rows: dict[str, list[str]] = {}
    for count in TRAINING_PAIRS:
        every = count / SPLIT["train"]
        test = every * SPLIT["test"]
        values = {}
        for step, number in (("raw", every), ("pairs", every)):
            values[f"{step}: storage"] = amount(of(step, "bytes").at(number))
            values[f"{step}: time"] = duration(of(step, "seconds").at(number))
        # All columns are held until they are written.
        values["pairs: memory, at least"] = amount(of("pairs", "bytes").at(every))
        values["training: memory"] = amount(both(result["reading"], "memory").at(count))
        values["training: time before the first step"] = duration(
            both(result["reading"], "seconds").at(count)
        )
        for backbone, cost in result["training"].items():
            values[f"training: one pass over all pairs, {backbone}"] = duration(
                Growth(**cost).each * count
            )
        values["fields (dvf.h5): storage"] = amount(of("fields", "bytes").at(count))
        values["fields: time"] = duration(of("fields", "seconds").at(count))
        for what, show, title in (("memory", amount, "memory"), ("seconds", duration, "time")):
            values[f"PCA prior: {title}"] = show(pca(result["priors"], what, count))
        values["predictions, one condition: storage"] = amount(of("predict", "bytes").at(test))
        values["predictions: time"] = duration(of("predict", "seconds").at(test))
        values["evaluation, one condition: time"] = duration(of("evaluate", "seconds").at(test))
        for what, value in values.items():
            rows.setdefault(what, []).append(value)
    return list(rows.items())


def pca(entries: list[dict], what: str, count: float) -> float:
    """Between measured numbers in proportion, beyond them along the last two."""
    numbers, values = ([e[key] for e in entries] for key in ("number", what))
    if count <= numbers[-1]:
        return float(np.interp(count, numbers, values))
    return growth(tuple(numbers[-2:]), tuple(values[-2:])).at(count)


def amount(value: float) -> str:
    for unit, size in (("TB", 1e12), ("GB", 1e9), ("MB", 1e6), ("kB", 1e3)):
        if value >= size:
            return f"{short(value / size)} {unit}"
    return f"{value:.0f} B"


def duration(seconds: float) -> str:
    for unit, size in (("days", 86400), ("h", 3600), ("min", 60)):
        if seconds >= 2 * size:
            return f"{short(seconds / size)} {unit}"
    return f"{short(1000 * seconds)} ms" if seconds < 0.1 else f"{short(seconds)} s"


def short(value: float) -> str:
    return f"{value:.2g}" if value < 99.5 else f"{value:.0f}"


def render(result: dict) -> str:
    """The tables of a result, as Markdown."""
    lines = [
        f"{result['processor']}, one core; {result['date']}; `python benchmarks/scale.py`",
        "",
        "| step | per | time | storage | memory |",
        "|---|---|---|---|---|",
    ]
    names = {
        "raw": ("raw meshes", "pair"),
        "pairs": ("pairs file", "pair"),
        "fields": ("fields, Robust-DefReg", "training pair"),
        "predict": ("predictions, Robust-DefReg", "test pair and condition"),
        "evaluate": ("evaluation", "test pair and condition"),
    }
    for step, (title, per) in names.items():
        first, last = result["steps"][step]
        cells = []
        for what, show in (("seconds", duration), ("bytes", amount)):
            cost = growth((first["number"], last["number"]), (first[what], last[what]))
            start = f" + {show(cost.start)}" if what != "bytes" else ""
            cells.append(show(cost.each) + start)
        lines.append(f"| {title} | {per} | {cells[0]} | {cells[1]} | – |")
    for backbone, cost in result["training"].items():
        start = duration(cost["start"])
        lines.append(
            f"| training, {backbone} | step of one pair | {duration(cost['each'])} + {start} | – "
            "| – |"
        )
    first, last = result["reading"]
    numbers = (first["number"], last["number"])
    cost = {what: growth(numbers, (first[what], last[what])) for what in ("seconds", "memory")}
    lines.append(
        f"| training, pairs held | training pair | {duration(cost['seconds'].each)} | – "
        f"| {amount(cost['memory'].each)} + {amount(cost['memory'].start)} |"
    )
    for entry in result["priors"]:
        lines.append(
            f"| PCA prior, 64 components | {entry['number']} fields | {duration(entry['seconds'])} "
            f"| – | {amount(entry['memory'])} |"
        )
    for entry in result["graphs"]:
        lines.append(
            f"| job graph (`snakemake evidence -n`) | {entry['number']} jobs "
            f"| {duration(entry['seconds'])} | – | {amount(entry['memory'])} |"
        )
    lines += [
        "",
        "What follows for one dataset and Robust-DefReg, where not said otherwise:",
        "",
        "| training pairs | " + " | ".join(f"{n:,}" for n in TRAINING_PAIRS) + " |",
        "|---" * (len(TRAINING_PAIRS) + 1) + "|",
    ]
    lines += [f"| {what} | " + " | ".join(values) + " |" for what, values in extrapolated(result)]
    return "\n".join(lines) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=ROOT / "benchmarks" / "results")
    parser.add_argument("--name", default=platform.node(), help="of the file of results")
    parser.add_argument("--render", type=Path, help="show the tables of this file and stop")
    parser.add_argument("--only-graphs", action="store_true", help="measure job graphs alone")
    arguments = parser.parse_args()
    if arguments.render:
        print(render(read_json(arguments.render)), end="")
        return
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        if arguments.only_graphs:
            print(json.dumps(job_graphs(folder)))
            return
        sys.path.insert(0, str(ROOT / "benchmarks"))
        from run import processor

        result = {
            "date": time.strftime("%Y-%m-%d"),
            "processor": processor(),
            "versions": versions(),
            "steps": along_the_workflow(folder),
            "training": training_steps(folder),
            "reading": reading(folder),
            "priors": prior_fits(folder),
            "graphs": job_graphs(folder),
        }
    arguments.out.mkdir(parents=True, exist_ok=True)
    path = arguments.out / f"scale-{arguments.name}.json"
    path.write_text(json.dumps(result, indent=1, ensure_ascii=False) + "\n")
    print(render(result), end="")


if __name__ == "__main__":
    main()
