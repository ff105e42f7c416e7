"""The script that runs a command as on another CPU."""

import importlib.util
import json
import sys
from pathlib import Path

import pytest

PATH = Path(__file__).parents[2] / ".ci" / "cpus.py"
SHOW = [sys.executable, "-c", "import json, os; print(json.dumps(dict(os.environ)))"]


@pytest.fixture
def cpus(monkeypatch):
    spec = importlib.util.spec_from_file_location("cpus", PATH)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    monkeypatch.setattr(module.platform, "machine", lambda: "x86_64")
    every = {flag for needed, _ in module.CPUS.values() for flag in needed.split()}
    monkeypatch.setattr(module, "here", lambda: every)
    return module


def test_a_command_gets_the_variables_of_a_cpu(cpus, capfd):
    caches = set()
    for name, (_, variables) in cpus.CPUS.items():
        assert cpus.main(["run", name, "--", *SHOW]) == 0
        found = json.loads(capfd.readouterr().out)
        assert variables.items() <= found.items()
        # Features of the CPU at hand would be used if none were said.
        assert "NUMBA_CPU_FEATURES" in found
        caches.add(found["NUMBA_CACHE_DIR"])
    assert len(caches) == len(cpus.CPUS) >= 4


def test_what_this_cpu_cannot_do_is_skipped_in_one_sentence(cpus, monkeypatch, capfd):
    monkeypatch.setattr(cpus, "here", lambda: {"sse4_2", "avx"})
    assert cpus.main(["run", "zen", "--", *SHOW]) == 77
    said = capfd.readouterr()
    assert said.out == ""
    assert said.err == "zen: skipped, since this CPU lacks avx2, fma, bmi2.\n"
    assert cpus.main(["all", "--", *SHOW]) == 0
    assert len(capfd.readouterr().out.splitlines()) == 2
    assert cpus.main(["list"]) == 0
    assert capfd.readouterr().out.count("skipped") == len(cpus.CPUS) - 2
    monkeypatch.setattr(cpus.platform, "machine", lambda: "arm64")
    assert cpus.main(["all", "--", *SHOW]) == 0
    assert capfd.readouterr().out == ""


def test_failures_are_passed_on(cpus, capfd):
    fail = [sys.executable, "-c", "raise SystemExit(3)"]
    assert cpus.main(["run", "nehalem", "--", *fail]) == 3
    assert cpus.main(["all", "--", *fail]) == 1
    assert "nehalem: failed (3)" in capfd.readouterr().err
    for wrong in ([], ["run", "nehalem"], ["all"], ["list", "x"]):
        assert cpus.main(wrong) == 2
    capfd.readouterr()
    assert cpus.main(["run", "pdp11", "--", "ls"]) == 2
    (said,) = capfd.readouterr().err.splitlines()
    assert said.startswith("pdp11 is no CPU known here; those are nehalem, ")
    assert cpus.main(["run", "nehalem", "--", "no-such-command"]) == 127
