"""The locks: complete, hashed, without hosts, and within what pyproject.toml allows."""

import hashlib
import os
import re
import tomllib
from pathlib import Path

import pytest
import yaml
from packaging.markers import default_environment
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).parents[2]
LOCKS = ("requirements.lock", "requirements-torch.lock", "requirements-tools.lock")


def locked(name):
    """Requirements of a lock, each with its hashes."""
    text = re.sub(r"#.*|\\\n", "", (ROOT / name).read_text())
    found = {}
    for line in filter(str.strip, text.splitlines()):
        requirement, *hashes = line.split("--hash=")
        found.setdefault(Requirement(requirement.strip()), [x.strip() for x in hashes])
    return found


def versions(name):
    """The version of every package that is installed here."""
    here = default_environment()
    return {
        canonicalize_name(requirement.name): str(requirement.specifier).removeprefix("==")
        for requirement in locked(name)
        if requirement.marker is None or requirement.marker.evaluate(here)
    }


def wanted():
    """What pyproject.toml asks for directly."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    groups = [project["dependencies"], *project["optional-dependencies"].values()]
    found = (Requirement(text) for group in groups for text in group)
    return [requirement for requirement in found if requirement.name != project["name"]]


@pytest.mark.parametrize("name", LOCKS)
def test_locks_pin_everything_and_name_no_host(name):
    for requirement, hashes in locked(name).items():
        assert re.fullmatch(r"==[\w.!]+", str(requirement.specifier)), requirement
        assert all(re.fullmatch(r"sha256:[0-9a-f]{64}", x) for x in hashes), requirement
        # PyTorch's builds share a version, so none of its hashes would fit all machines.
        assert bool(hashes) == (requirement.name != "torch"), requirement
    assert not re.search(r"://|--index|--extra|--find|@ ", (ROOT / name).read_text())


def test_the_locks_are_what_the_project_asks_for():
    found = versions("requirements.lock") | versions("requirements-torch.lock")
    for requirement in wanted():
        version = found.get(canonicalize_name(requirement.name))
        assert version is not None, f"{requirement} is not locked; run `make lock`"
        assert requirement.specifier.contains(version), f"{requirement}: {version} is locked"


def test_every_dependency_has_a_lowest_version():
    for requirement in wanted():
        assert any(clause.operator == ">=" for clause in requirement.specifier), requirement


def test_other_locks_give_another_conda_environment():
    locks = b"".join((ROOT / name).read_bytes() for name in LOCKS if "tools" not in name)
    environment = (ROOT / "workflow" / "envs" / "dine.yaml").read_text()
    assert hashlib.sha256(locks).hexdigest()[:16] in environment, "run `make lock`"
    assert "`make lock`: " in environment
    python = next(x for x in yaml.safe_load(environment)["dependencies"] if x.startswith("python="))
    jobs = yaml.safe_load((ROOT / ".github/workflows/ci.yml").read_text())["jobs"]
    assert python == f"python={jobs['ci']['steps'][1]['with']['python-version']}"


def test_what_hosts_and_hooks_call_exists():
    jobs = yaml.safe_load((ROOT / ".github/workflows/ci.yml").read_text())["jobs"]
    called = [step["run"] for job in jobs.values() for step in job["steps"] if "run" in step]
    assert called == [".ci/run"]
    assert os.access(ROOT / called[0], os.X_OK)
    hooks = yaml.safe_load((ROOT / ".pre-commit-config.yaml").read_text())["repos"][0]["hooks"]
    rules = (ROOT / "Makefile").read_text().splitlines()
    for hook in hooks:
        make, target = hook["entry"].split()
        assert make == "make"
        assert any(line.startswith(f"{target}:") for line in rules)
