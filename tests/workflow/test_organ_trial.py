"""The target `organ`: what it makes, and what each change of its settings makes again."""

import json
import os
import re
import shutil
import subprocess
import sys
from importlib import resources
from pathlib import Path

import pandas as pd
import pytest
import yaml
from workplace import ROOT, warm

from dine import config
from dine.plan import EvidencePlan
from dine.results import Results

TINY = "config/tiny.yaml"
CHANGES = {
    "nothing": ({}, {}),
    "how priors are learned": (
        {"learning": {"candidates": [5]}},
        {"organ_prior": 2, "organ_trial": 1},
    ),
    "how deformations are simulated": (
        {"simulation": {"poisson": [0.3, 0.48]}},
        {"organ_fields": 2, "organ_prior": 2, "organ_trial": 1},
    ),
    "the true deformations": ({"deformations": 3}, {"organ_truth": 1, "organ_trial": 1}),
    "another question": ({"questions": ["methods", "size"]}, {"organ_trial": 1}),
    # Where nothing is changed all methods are shown.
    "methods under other conditions": ({"compared": ["rigid"]}, {}),
}


def snakemake(folder, *arguments):
    done = subprocess.run(
        [sys.executable, "-m", "snakemake", "-j2", "organ", *map(str, arguments)],
        cwd=folder,
        env=os.environ | warm(),
        capture_output=True,
        text=True,
    )
    assert not done.returncode, done.stdout[-3000:] + done.stderr[-3000:]
    return done.stdout


def planned(folder, *configs):
    table = snakemake(folder, "-n", "--configfile", TINY, *configs)
    table = table.partition("Job stats:")[2].partition("\n\n")[0]
    jobs = dict(re.findall(r"^(\w+)\s+(\d+)$", table, re.MULTILINE))
    return {rule: int(count) for rule, count in jobs.items() if rule not in ("organ", "total")}


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    folder = tmp_path_factory.mktemp("organ")
    for name in ("Snakefile", "config.yaml"):
        shutil.copy(ROOT / name, folder)
    for name in ("workflow", "config", "profiles"):
        shutil.copytree(ROOT / name, folder / name)
    snakemake(folder, "--configfile", TINY)
    return folder


def test_tables_of_the_shipped_scan_are_there(finished):
    files = Results(finished / "results" / "tiny")
    rows = pd.read_csv(files.trial("scan").measured("methods"))
    assert len(rows) == 2 * rows["method"].nunique() == 2 * 8
    assert rows[["hidden", "seen", "target"]].notna().all(axis=None)
    tables = files.trial_tables.parent
    assert {path.name for path in tables.iterdir()} == {
        *("all.md", "organ_methods.csv", "organ_methods.md", "organ_methods.tex"),
    }


@pytest.mark.parametrize("change", CHANGES)
def test_a_change_makes_again_what_depends_on_it(finished, change):
    settings, expected = CHANGES[change]
    (finished / "change.yaml").write_text(yaml.safe_dump({"organ": settings}))
    assert planned(finished, "change.yaml") == expected


def of_plan(**changes):
    organ = config.OrganTrial(**changes)
    return EvidencePlan(config.load("config.yaml", TINY).model_copy(update={"organ": organ}))


def test_jobs_are_told_what_they_depend_on_and_no_more(tmp_path, monkeypatch):
    monkeypatch.chdir(ROOT)
    usual, fewer = of_plan(), of_plan(compared=["rigid"])
    other = of_plan(simulation=config.Simulation(edge=0.2))
    for about in ("seen", "mechanics", "size"):
        assert json.loads(fewer.organ_trial(about))["compared"] == ["rigid"]
        assert usual.organ_trial(about) != other.organ_trial(about)
    assert usual.organ_trial("methods") == fewer.organ_trial("methods")
    assert usual.organ_truth == other.organ_truth != of_plan(edge=0.2).organ_truth
    held = {how: json.loads(usual.organ_simulation(how))["fixed"] for how in ("about", "patch")}
    assert held == {"about": "about", "patch": "exactly"}
    mesh = tmp_path / "mine.ply"
    mesh.write_bytes(b"ply")
    mine = of_plan(templates={"mine": str(mesh)})
    before = mine.organ_signature("mine")
    mesh.write_bytes(b"another")
    assert mine.organ_signature("mine") != before
    assert usual.organ_signature("scan") == ""


def test_meshes_of_ones_own_by_name(finished, tmp_path):
    shipped = resources.files("dine") / "scans" / "before.ply"
    mesh = Path(shutil.copy(shipped, tmp_path / "mine.ply"))
    templates = {"organ": {"templates": {"liver": str(mesh), "other": str(mesh)}}}
    (finished / "mine.yaml").write_text(yaml.safe_dump(templates))
    assert planned(finished, "mine.yaml") == {
        "organ_template": 2,
        "organ_truth": 2,
        "organ_fields": 4,
        "organ_prior": 4,
        "organ_trial": 2,
    }
