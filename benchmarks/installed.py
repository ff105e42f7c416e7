"""What an installation of the package brings, and how long `dine` takes to start.

    python benchmarks/installed.py

Sizes are those of the files of the installed packages, without compiled bytecode and without
PyTorch and what that brings. Times are CPU seconds, the best of several processes, of which the
first has compiled what is compiled once.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from importlib import metadata
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

PACKAGE, BASE = "dine-registration", "torch"
EXTRAS = ("", "simulation", "classical", "commands", "workflow")
ROUNDS = 5
DINE = "from dine.cli import main; main()"
FIRST = "import dine; dine.register('before.ply', 'after.ply')"
STARTS = {
    "`import torch`": ["-c", "import torch"],
    "`import dine; dine.register`": ["-c", "import dine; dine.register"],
    "`dine --help`": ["-c", DINE, "--help"],
    "`dine register --help`": ["-c", DINE, "register", "--help"],
    "first registration of a process, imports included": ["-c", FIRST],
}


def brought(requirement: Requirement, found: dict[str, set[str]]) -> dict[str, set[str]]:
    """Add the packages that a requirement brings here, each with the extras that are asked for."""
    name = canonicalize_name(requirement.name)
    extras = found.get(name, set()) | set(requirement.extras)
    if name in found and extras == found[name]:
        return found
    found[name] = extras
    for further in map(Requirement, metadata.requires(name) or ()):
        environments = [{"extra": extra} for extra in ("", *extras)]
        if further.marker is None or any(map(further.marker.evaluate, environments)):
            brought(further, found)
    return found


def size(name: str) -> int:
    """Bytes of a package's files."""
    files = (path.locate() for path in metadata.files(name) or () if path.suffix != ".pyc")
    return sum(os.path.getsize(path) for path in files if os.path.exists(path))


def sizes() -> None:
    base = set(brought(Requirement(BASE), {}))
    print("| what is installed | MB beside PyTorch | largest |\n|---|---|---|")
    for extra in EXTRAS:
        wanted = f"{PACKAGE}[{extra}]" if extra else PACKAGE
        names = set(brought(Requirement(wanted), {})) - base - {PACKAGE}
        megabytes = {name: size(name) / 1e6 for name in names}
        largest = sorted(names, key=megabytes.get, reverse=True)[:6]
        shown = ", ".join(f"{name} {megabytes[name]:.0f}" for name in largest)
        print(f"| `{wanted}` | {sum(megabytes.values()):.0f} | {shown} |")


def seconds(arguments: list[str], folder: str) -> float:
    """CPU seconds of a process, its own and the system's."""
    # Bytecode is kept, as it is by default, but not among the files that were installed.
    environment = {**os.environ, "PYTHONPYCACHEPREFIX": f"{folder}/bytecode"}
    environment.pop("PYTHONDONTWRITEBYTECODE", None)
    command = [sys.executable, *arguments]
    before = os.times()
    subprocess.run(command, cwd=folder, env=environment, check=True, capture_output=True)
    after = os.times()
    return sum(after[2:4]) - sum(before[2:4])


def times() -> None:
    print("\n| start | CPU seconds |\n|---|---|")
    with tempfile.TemporaryDirectory() as folder:
        seconds(["-c", DINE, "scans", "."], folder)
        for name, arguments in STARTS.items():
            taken = [seconds(arguments, folder) for _ in range(ROUNDS + 1)]
            print(f"| {name} | {min(taken[1:]):.2f} |", flush=True)


if __name__ == "__main__":
    print(f"{Path(sys.executable).name} {sys.version.split()[0]}, torch {metadata.version(BASE)}\n")
    sizes()
    times()
