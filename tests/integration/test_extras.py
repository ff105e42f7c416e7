"""What a plain installation can do, and what it says where an extra is needed."""

import importlib
import json
import subprocess
import sys
import tomllib
from importlib import metadata
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from dine import extras
from dine.errors import ConfigError

PROJECT = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text())["project"]

# As many as on the day of this bound, ten packages and four of the command line among them.
MOST_MODULES = 69

# One process without what only extras bring: it registers, then tries what needs them.
PROGRAM = """if True:
    import contextlib, io, json, sys
    from pathlib import Path

    hidden, folder = json.loads(sys.argv[1]), Path(sys.argv[2])

    class Hide:
        def find_spec(self, name, path=None, target=None):
            if name.partition(".")[0] in hidden:
                raise ModuleNotFoundError(f"No module named {name!r}", name=name)

    sys.meta_path.insert(0, Hide())
    from dine.cli import main

    def run(*arguments):
        sys.argv, said = ["dine", *map(str, arguments)], io.StringIO()
        with contextlib.redirect_stderr(said):
            try:
                main()
            except SystemExit as end:
                return [end.code, said.getvalue()]
        return [0, said.getvalue()]

    before, after, out = (folder / name for name in ("before.ply", "after.ply", "moved.ply"))
    done = {
        "scans": run("scans", folder),
        "register": run("register", before, after, "-o", out, "--seed", 1),
    }
    modules = sorted(sys.modules)  # of a mesh registered to a mesh, both PLY
    quick = ["--no-surfaces", "--map", 0, "--points", 64, "--overwrite"]
    done |= {
        "view": run("register", before, after, "-o", out, "--view", *quick),
        "inspect": run("inspect", folder),
        "simulate": run("simulate", before, "-o", folder / "fields.h5"),
        "evaluate": run("evaluate", "--predictions", out, "--pairs", out, "--method", "x",
                        "--dataset", "x", "--backbone", "x", "--out", folder / "metrics.csv"),
        "tables": run("tables", out, "--out", folder / "tables"),
    }
    print(json.dumps({"done": done, "modules": modules}))
"""


@pytest.fixture(scope="module")
def plain(tmp_path_factory):
    """What a process did in which nothing can be imported that only an extra brings."""
    folder = tmp_path_factory.mktemp("plain")
    hidden = [*extras.EXTRA_OF, "snakemake", "PIL"]
    command = [sys.executable, "-W", "error", "-c", PROGRAM, json.dumps(hidden), str(folder)]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout.splitlines()[-1])
    return found["done"], found["modules"], sorted(path.name for path in folder.iterdir())


def test_registers_without_any_extra(plain):
    done, _, files = plain
    assert done["scans"][0] == done["register"][0] == done["view"][0] == 0, done
    assert {"moved.ply", "moved.html", "moved.json"} <= set(files)


def test_registering_imports_nothing_of_other_tasks(plain):
    _, modules, _ = plain
    ours = [name for name in modules if name.partition(".")[0] == "dine"]
    others = ("training", "reporting", "evaluation", "simulation", "classical", "viewer")
    assert not [name for name in ours if name.partition(".")[2].startswith(others)]
    assert "dine.registration.register" in ours
    assert len(ours) <= MOST_MODULES, ours
    assert not {"networkx", "scipy.io", "trimesh"} & set(modules)


def test_what_takes_a_while_is_imported_when_it_is_needed():
    program = "import sys, dine; dine.register, dine.read_surface; print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert "torch" in done.stdout.split(), done.stderr
    assert not {"numba", "scipy.io", "trimesh"} & set(done.stdout.split())


@pytest.mark.parametrize(
    ("command", "module", "extra"),
    [
        ("inspect", "pandas", "workflow"),
        ("simulate", "skfem", "simulation"),
        ("evaluate", "pandas", "workflow"),
        ("tables", "pandas", "workflow"),
    ],
)
def test_names_the_extra_that_is_missing(plain, command, module, extra):
    code, said = plain[0][command]
    assert code == 1
    assert said.endswith(
        f"This needs the package {module}, which is not installed: "
        f'pip install "dine-registration[{extra}]".\n'
    )
    assert said.count("\n") == 1


def test_other_missing_modules_are_no_matter_of_extras():
    with pytest.raises(ModuleNotFoundError, match="no_such"), extras.extras_needed():
        importlib.import_module("numpy.no_such")


@pytest.mark.parametrize("kind", ["flow", "latent_flow"])
def test_a_prior_asks_for_its_library(kind, monkeypatch):
    from dine.priors import PRIORS

    monkeypatch.setitem(sys.modules, "zuko", None)
    sizes = {"components": 4} if kind == "latent_flow" else {}
    with pytest.raises(ConfigError, match=r"zuko.*dine-registration\[workflow\]"):
        PRIORS.get(kind)(points=8, transforms=1, hidden=4, **sizes)


def test_every_extra_brings_what_it_is_named_for():
    distributions = metadata.packages_distributions()
    plainly = {canonicalize_name(Requirement(text).name) for text in PROJECT["dependencies"]}
    for module, extra in extras.EXTRA_OF.items():
        brought = {canonicalize_name(name) for name in closure(extra)}
        (owner,) = map(canonicalize_name, set(distributions[module]))
        assert owner in brought, module
        assert owner not in plainly, module


def closure(extra):
    """Names of the packages that an extra asks for, by other extras too."""
    for requirement in map(Requirement, PROJECT["optional-dependencies"][extra]):
        if requirement.name == PROJECT["name"]:
            for other in requirement.extras:
                yield from closure(other)
        else:
            yield requirement.name
