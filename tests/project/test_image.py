"""The image of the Dockerfile, held against the repository; nothing is built."""

import re
import shlex
import shutil
import subprocess
import tomllib
from pathlib import Path, PurePosixPath

import pytest
import yaml
from packaging.specifiers import SpecifierSet

from dine import __version__

ROOT = Path(__file__).parents[2]
PROFILE = ROOT / "workflow" / "profiles" / "kubernetes" / "config.yaml"
# What `pip install` and a run need, as in a checkout.
NEEDED = ("requirements.lock", "requirements-torch.lock", "pyproject.toml", "README.md", "LICENSE")
NEEDED += ("Snakefile", "config.yaml", "setup.py")
FOLDERS = ("dine", "config", "profiles", "workflow")


def instructions():
    """Instructions of the Dockerfile, each with what stands behind it."""
    lines = (ROOT / "Dockerfile").read_text().splitlines()
    text = "\n".join(line for line in lines if not line.startswith("#")).replace("\\\n", " ")
    return [tuple(line.split(maxsplit=1)) for line in text.splitlines() if line.strip()]


def behind(name):
    return [value for instruction, value in instructions() if instruction == name]


def ignored(path, patterns):
    """Whether a path below the root takes no part: the last pattern that fits it or a parent."""
    found = False
    whole = [PurePosixPath(path), *PurePosixPath(path).parents][:-1]
    for pattern in patterns:
        bare = pattern.removeprefix("!").strip("/")
        regex = re.escape(bare).replace(r"\*\*/", "(.*/)?").replace(r"\*", "[^/]*")
        if any(re.fullmatch(regex, str(part)) for part in whole):
            found = not pattern.startswith("!")
    return found


def patterns():
    lines = (ROOT / ".dockerignore").read_text().splitlines()
    return [line for line in lines if line and not line.startswith("#")]


def copied():
    return [source for value in behind("COPY") for source in shlex.split(value)[:-1]]


def test_what_is_copied_is_there_and_not_ignored():
    assert sorted(copied()) == sorted([*NEEDED, *FOLDERS])
    files = [ROOT / name for name in NEEDED]
    for folder in FOLDERS:
        found = [path for path in (ROOT / folder).rglob("*") if path.is_file()]
        files += [path for path in found if "__pycache__" not in path.parts]
    for path in files:
        assert path.is_file()
        assert not ignored(path.relative_to(ROOT).as_posix(), patterns()), path


@pytest.mark.parametrize(
    "name", [".git/config", ".venv/bin/python", "results/a.h5", "dine/__pycache__/a.pyc", "tests/a"]
)
def test_nothing_else_takes_part(name):
    assert ignored(name, patterns())


def test_its_python_is_the_one_that_is_tested():
    (image,) = behind("FROM")
    version = re.fullmatch(r"python:(\d\.\d+)-slim-\w+", image)[1]
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert version in SpecifierSet(project["requires-python"])
    jobs = yaml.safe_load((ROOT / ".github/workflows/ci.yml").read_text())["jobs"]
    assert jobs["ci"]["steps"][1]["with"]["python-version"] == version


def test_jobs_run_as_a_user_with_both_commands():
    users = behind("USER")
    assert users
    assert users[-1] not in ("root", "0")
    commands = " ".join(behind("RUN"))
    assert f"useradd --create-home --uid 1000 {users[-1]}" in commands
    # The build fails where they do not start.
    assert re.search(r"&& dine register .*&& snakemake --version", commands)


def test_versions_come_from_the_locks():
    commands = " ".join(behind("RUN"))
    assert "--require-hashes --no-deps --requirement requirements.lock" in commands
    assert "--requirement requirements-torch.lock" in commands
    # What is no part of the lock.
    for argument in behind("ARG"):
        value = shlex.split(argument)[0].partition("=")[2]
        assert not value or re.fullmatch(r"[\w-]+==[\d.]+", value), argument


def test_the_profile_of_kubernetes_names_it():
    profile = yaml.safe_load(PROFILE.read_text())
    assert profile["container-image"] == f"dine:{__version__}"
    plugin = f"snakemake-storage-plugin-{profile['default-storage-provider']}"
    assert any(f'STORAGE_PLUGIN="{plugin}==' in argument for argument in behind("ARG"))
    page = (ROOT / "docs" / "guide" / "cluster.md").read_text()
    tags = set(re.findall(r"\bdine:(\d[\w.]*)", page + PROFILE.read_text()))
    assert tags == {__version__}
    assert f"docker build --tag dine:{__version__} " in page


def test_the_linter_finds_nothing():
    linter = shutil.which("hadolint")
    if linter is None:
        pytest.skip("hadolint is not installed")
    done = subprocess.run([linter, ROOT / "Dockerfile"], capture_output=True, text=True)
    assert done.returncode == 0, done.stdout
