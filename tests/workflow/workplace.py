"""A folder to run the workflow in, and what two runs must have in common."""

import atexit
import functools
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

import h5py
import pandas as pd
import psutil

from dine.files import read_json

ROOT = Path(__file__).parents[2]
HERE = Path(__file__).parent
WARM = HERE / "warm"
EXAMPLES = ROOT / "examples" / "extending"


class Job(NamedTuple):
    step: str
    process: psutil.Process


def with_default_signals() -> None:
    """In a child: it would ignore what its parent does, as one in the background ignores Ctrl-C."""
    for number in (signal.SIGINT, signal.SIGQUIT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_DFL)


@functools.cache
def warm() -> dict[str, str]:
    """Variables with which ``dine`` and Snakemake start as forks of a server; it ends with us."""
    folder = Path(tempfile.mkdtemp(prefix="dine-warm-"))  # addresses of sockets must be short
    atexit.register(shutil.rmtree, folder)
    server = subprocess.Popen(
        [sys.executable, str(WARM / "sitecustomize.py"), str(folder / "socket")],
        stdin=subprocess.PIPE,
        env=os.environ | {"OMP_NUM_THREADS": "1"},
        start_new_session=True,
        preexec_fn=with_default_signals,
    )
    atexit.register(server.communicate)
    while not (folder / "socket").exists():
        if server.poll() is not None:
            raise AssertionError(f"The server ended with {server.returncode}.")
        time.sleep(0.02)
    path = filter(None, [str(WARM), os.environ.get("PYTHONPATH")])
    return {"DINE_WARM": str(folder / "socket"), "PYTHONPATH": os.pathsep.join(path)}


class Workplace:
    """A copy of the workflow with a user's own meshes, and their own package in ``code/``."""

    def __init__(self, folder: Path, *configs: Path, package: Path = ROOT):
        self.folder = folder
        self.package = package
        self.warm = False
        self.trace: Path | None = None
        """Where warm jobs note what they have run."""
        self.configs = [Path(path.name) for path in configs]
        for name in ("Snakefile", "config.yaml"):
            shutil.copy(ROOT / name, folder)
        for name in ("workflow", "config", "profiles"):
            shutil.copytree(ROOT / name, folder / name)
        for path in configs:
            shutil.copy(path, folder)
        shutil.copytree(
            EXAMPLES, folder / "code", ignore=shutil.ignore_patterns("__pycache__", "*.yaml")
        )
        code = "import sys; from my_package import data; data.write_eggs(data.Path('meshes'), 3)"
        self.call(sys.executable, "-c", code)

    @property
    def results(self) -> Path:
        return next(iter(sorted((self.folder / "results").glob("*"))))

    def copy(self, folder: Path) -> "Workplace":
        """The same with all results and Snakemake's records, to be changed."""
        shutil.copytree(self.folder, folder, dirs_exist_ok=True)
        other = object.__new__(Workplace)
        vars(other).update(vars(self), folder=folder)
        return other

    def empty(self) -> None:
        """Forget all results and Snakemake's records."""
        for name in ("results", ".snakemake"):
            shutil.rmtree(self.folder / name, ignore_errors=True)

    def command(self, *arguments, cores: int = 2) -> list[str]:
        known = [sys.executable, "-m", "snakemake", f"-j{cores}", *map(str, arguments)]
        return [*known, "--configfile", *map(str, self.configs)]

    @property
    def environment(self) -> dict[str, str]:
        path = [str(self.package), str(self.folder / "code")]
        extra = {}
        if self.warm:
            path.append(str(WARM))
            extra["DINE_WARM"] = warm()["DINE_WARM"]
            if self.trace:
                extra["DINE_TRACE"] = str(self.trace)
        return os.environ | extra | {"PYTHONPATH": os.pathsep.join(path)}

    def call(self, *command: str) -> subprocess.CompletedProcess:
        return subprocess.run(
            command, cwd=self.folder, env=self.environment, capture_output=True, text=True
        )

    def run(self, *arguments, cores: int = 2, check: bool = True) -> str:
        """Snakemake to its end; what it said."""
        done = self.call(*self.command(*arguments, cores=cores))
        if check and done.returncode:
            raise AssertionError(done.stdout[-3000:] + done.stderr[-3000:])
        return done.stdout + done.stderr

    def start(self, *arguments, cores: int = 2) -> subprocess.Popen:
        """Snakemake in a process group of its own; what it says goes to ``said.txt``."""
        # What was started in the background ignores Ctrl-C, and so would its children.
        if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
            signal.signal(signal.SIGINT, signal.default_int_handler)
        with open(self.folder / "said.txt", "a") as said:
            return subprocess.Popen(
                self.command(*arguments, cores=cores),
                cwd=self.folder,
                env=self.environment,
                stdout=said,
                stderr=said,
                start_new_session=True,
            )

    def unlock(self) -> bool:
        """What the documentation asks for after Snakemake itself was killed."""
        locks = self.folder / ".snakemake" / "locks"
        if not locks.is_dir() or not any(locks.iterdir()):
            return False
        # Nobody kills this.
        cold, self.warm = not self.warm, True
        self.run("--unlock")
        self.warm = not cold
        return True

    def jobs(self) -> list[Job]:
        """The commands of ``dine`` that run here, whoever has started them."""
        found = []
        for process in psutil.process_iter():
            try:
                line = process.cmdline()
                if (
                    len(line) > 2
                    and line[1].endswith("/dine")
                    and process.cwd() == str(self.folder)
                ):
                    found.append(Job(command_of(line[2:]), process))
            except psutil.Error:  # ended meanwhile
                continue
        return found


def command_of(arguments: list[str]) -> str:
    """The command among the arguments of ``dine``."""
    position = 0
    while arguments[position].startswith("-"):
        position += 2
    return arguments[position]


# What differs between equal runs: wall times. Everything else must be equal.

TIMED_FOLDERS = ("logs", "benchmarks", "training")
"""Logs and Snakemake's benchmarks; ``training/`` is the state, whose history has seconds."""
TIMED_KEYS = ("training_seconds", "wall_seconds", "seconds", "made")
"""Of ``run.json`` and other JSON files."""
TIMED_COLUMNS = ("seconds", "seconds_mean", "seconds_sd", "seconds_seed_sd")
"""Of ``history.csv`` and ``metrics.csv``, and of the evidence's tables of means."""
TIMED_ATTRIBUTES = ("predictions",)
"""Of a refined ``predictions.h5``: the digest of the network's own, which holds seconds."""
TIMED_DATASETS = ("seconds",)
"""Of ``predictions.h5``."""
TIMED_FILES = ("report.html", "evidence/report.html", "evidence/tables/all.md")
"""They show how long trainings and pairs took; the tables of the latter are compared as CSV."""


def content(path: Path):
    """What a file says, wall times left out."""
    if path.suffix == ".json":
        return _without_times(read_json(path))
    if path.suffix == ".csv":
        table = pd.read_csv(path, dtype=str, keep_default_na=False)
        return table.drop(columns=[c for c in TIMED_COLUMNS if c in table]).to_csv()
    if path.name == "predictions.h5":
        return _untimed_datasets(path)
    return path.read_bytes()


def _without_times(value):
    if isinstance(value, dict):
        return {k: _without_times(v) for k, v in value.items() if k not in TIMED_KEYS}
    return value


def _untimed_datasets(path: Path) -> dict[str, str]:
    found = {}
    with h5py.File(path) as file:
        names: list[str] = []
        file.visit(names.append)
        for name in ["/", *names]:
            item = file[name]
            if name.split("/")[-1] not in TIMED_DATASETS:
                value = item[()].tolist() if isinstance(item, h5py.Dataset) else None
                kept = {k: v for k, v in item.attrs.items() if k not in TIMED_ATTRIBUTES}
                found[name] = repr((value, sorted(map(repr, kept.items()))))
    return found


def files(results: Path) -> dict[str, Path]:
    """Every file that a run must make again bit for bit, by its name below the results folder."""
    found = {}
    for path in sorted(results.rglob("*")):
        name = path.relative_to(results)
        if any(part in TIMED_FOLDERS for part in name.parts) or path.suffix == ".lock":
            continue
        if path.is_file() and name.as_posix() not in TIMED_FILES:
            found[str(name)] = path
    return found


def differences(first: Path, second: Path) -> list[str]:
    """Names of files that only one results folder has, or that say something else in the other."""
    ours, theirs = files(first), files(second)
    odd = sorted(ours.keys() ^ theirs.keys())
    for name in ours.keys() & theirs.keys():
        if content(ours[name]) != content(theirs[name]):
            odd.append(name)
    return sorted(odd)
