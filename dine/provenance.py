"""Who made a result: code, versions, inputs. Cheap to import, since every DAG asks for it."""

from __future__ import annotations

import functools
import hashlib
import os
import platform
from importlib import metadata
from pathlib import Path
from typing import Any

from dine import __version__

PACKAGE = Path(__file__).parent

_READING = ("data/surface.py", "data/readers.py", "data/vtk.py", "data/layout.py")

LAYERS: dict[str, tuple[str, ...]] = {
    # What a step's result depends on, as paths below the package.
    "raw": (
        *_READING,
        "data/obtain.py",
        "data/raw.py",
        "data/synthetic.py",
        "data/deformation.py",
        "data/sampling.py",
        "data/dataverse.py",
    ),
    "pairs": (
        *_READING,
        "data/prepare.py",
        "data/pairs.py",
        "data/sampling.py",
        "data/assignment.py",
    ),
    "corrupt": ("data/corruption.py", "data/pairs.py"),
    "model": (
        "data/batch.py",
        "data/loading.py",
        "data/pairs.py",
        "data/fields.py",
        "geometry",
        "models",
    ),
    "priors": ("priors",),
    "training": ("training",),
    "evaluation": ("evaluation",),
    "reporting": ("reporting",),
    "calibration": (
        "evaluation/quality.py",
        "registration/calibration.py",
        "registration/refine.py",
    ),
    "registration": ("registration", "evaluation/quality.py"),
}


@functools.cache
def code_digest(*layers: str) -> str:
    """Digest of the source files behind some layers: changes when their code does."""
    digest = hashlib.sha256()
    for entry in sorted({entry for layer in layers for entry in LAYERS[layer]}):
        path = PACKAGE / entry
        files = [path] if path.is_file() else sorted(p for p in path.rglob("*") if p.is_file())
        for file in files:
            if file.suffix in {".py", ".html", ".csv"}:
                digest.update(str(file.relative_to(PACKAGE)).encode())
                digest.update(hashlib.sha256(file.read_bytes()).digest())
    return digest.hexdigest()[:16]


def versions() -> dict[str, str]:
    """Versions of this package, Python and the libraries that results depend on."""
    names = ("numpy", "scipy", "torch", "scikit-learn", "h5py", "trimesh", "pandas", "zuko")
    found = {name: metadata.version(name) for name in (*names, "numba")}
    return {"dine": __version__, "python": platform.python_version(), **found}


def folder_signature(folder: str | os.PathLike) -> str:
    """Digest of the names, sizes and times of all files below a folder; contents are not read."""
    digest = hashlib.sha256()
    for root, folders, files in os.walk(folder):
        folders.sort()
        for name in sorted(files):
            path = os.path.join(root, name)
            try:
                stat = os.stat(path)
            except OSError:
                continue
            digest.update(f"{path}\0{stat.st_size}\0{stat.st_mtime_ns}\n".encode())
    return digest.hexdigest()[:16]


def run_record(settings: dict[str, Any], seed: int, **facts: Any) -> dict[str, Any]:
    """What every run writes beside its result."""
    return {"settings": settings, "seed": seed, "versions": versions(), **facts}
