"""The workflow beyond its own folder: as a module of another workflow, and with `--sdm conda`."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
import yaml
from test_workflow import ROOT, copy_workflow, planned, snakemake
from workplace import warm

from dine.data.pairs import read_pairs

TINY = ROOT / "config" / "tiny.yaml"
MODULE = """
configfile: "config.yaml"

module dine:
    snakefile:
        {snakefile!r}
    config:
        config["registration"]
{prefix}

use rule * from dine as dine_*

rule ours:
    input:
        rules.dine_pairs.output[0].format(dataset="synbench"),
    output:
        "ours.txt",
    shell:
        "cp {{input:q}} {{output:q}}"
"""


def outer_workflow(folder, prefix):
    """Another workflow, with a config.yaml of its own, that uses this one; below ``prefix``."""
    line = f"    prefix:\n        {prefix!r}" if prefix else ""
    snakefile = str(ROOT / "workflow" / "Snakefile")
    (folder / "Snakefile").write_text(MODULE.format(snakefile=snakefile, prefix=line))
    settings = yaml.safe_load(TINY.read_text()) | {"results": "registered"}
    (folder / "config.yaml").write_text(yaml.safe_dump({"ours": 1, "registration": settings}))


def test_another_workflow_uses_it_with_its_own_configuration_and_prefix(tmp_path):
    other, own = tmp_path / "other workflow", tmp_path / "own"
    for folder in (other, own):
        folder.mkdir()
    outer_workflow(other, "tissue")
    # The whole of it is planned as it is alone.
    alone = planned(copy_workflow(own), "all", "--configfile", TINY)
    assert planned(other, "dine_all") == {f"dine_{rule}": n for rule, n in alone.items()}
    snakemake(other, "ours")
    # Two objects, two levels, five pairs of each; and one of each level for two unseen ones.
    assert len(read_pairs(other / "ours.txt")) == 24
    made = sorted(p.relative_to(other).as_posix() for p in other.glob("*/registered/synbench/*"))
    assert "tissue/registered/synbench/pairs.h5" in made
    assert not (other / "registered").exists()
    assert planned(other, "ours") == {}


def test_a_module_without_a_prefix_or_configuration_is_the_default_run(tmp_path):
    outer_workflow(tmp_path, None)
    assert "registered/synbench/pairs.h5" in snakemake(tmp_path, "-n", "ours").stdout
    text = (tmp_path / "Snakefile").read_text()
    lines = text.replace('    config:\n        config["registration"]\n', "")
    (tmp_path / "Snakefile").write_text(lines)
    # The folder's config.yaml is that of the other workflow.
    assert "results/synbench/pairs.h5" in snakemake(tmp_path, "-n", "ours").stdout


def test_what_the_catalog_of_snakemake_deploys(tmp_path):
    """Its tool copies the folder of configurations and writes the rest."""
    facts = yaml.safe_load((ROOT / ".snakemake-workflow-catalog.yml").read_text())["usage"]
    assert facts["software-stack-deployment"]["conda"] is True
    assert facts["report"] is True
    assert (ROOT / "config" / "README.md").is_file()
    (tmp_path / "config").mkdir()
    for path in (ROOT / "config").iterdir():
        (tmp_path / "config" / path.name).write_bytes(path.read_bytes())
    (tmp_path / "workflow").mkdir()
    snakefile = str(ROOT / "workflow" / "Snakefile")
    (tmp_path / "workflow" / "Snakefile").write_text(
        f"configfile: 'config/config.yaml'\nmodule dine:\n    snakefile: {snakefile!r}\n"
        "    config: config\nuse rule * from dine\n"
    )
    own = tmp_path / "own"
    own.mkdir()
    copy_workflow(own)
    assert planned(tmp_path) == planned(own)
    tiny = ("--configfile", "config/tiny.yaml")
    assert planned(tmp_path, *tiny) == planned(own, *tiny) != planned(own)


STAND_IN = """#!{python}
import json, os, pathlib, sys
words = sys.argv[1:]
if words == ["info", "--json"]:
    print(json.dumps({{"conda_prefix": {folder!r}, "platform": "linux-64"}}))
elif words[0] == "clean":
    pass
elif words == ["--version"]:
    print("conda 24.9.2")
elif words[:2] == ["config", "--get"]:
    print(json.dumps({{"get": {{"channel_priority": "strict"}}}}))
elif words[:2] == ["env", "create"]:
    place = pathlib.Path(words[words.index("--prefix") + 1], "bin")
    place.mkdir(parents=True)
    for name in ("pip", "dine"):
        (place / name).write_text(
            f"#!/bin/sh\\nprintf '%s|%s|%s\\\\n' {{name}} \\"$PWD\\" \\"$*\\" >>{noted!r}\\n"
            + (f"exec {dine!r} \\"$@\\"\\n" if name == "dine" else "")
        )
        (place / name).chmod(0o755)
else:
    sys.exit(f"Not known to the stand-in: {{words}}")
"""


@pytest.fixture
def conda(tmp_path):
    """Variables with which a stand-in is found as `conda`, and where its environments take notes.

    Its environments hold a `pip` that only notes how it is called, and a `dine` that notes it, too,
    and then is the one at hand.
    """
    folder, noted = tmp_path / "conda", tmp_path / "noted.txt"
    (folder / "bin").mkdir(parents=True)
    text = STAND_IN.format(
        python=sys.executable,
        folder=str(folder),
        noted=str(noted),
        dine=str(Path(sys.executable).parent / "dine"),
    )
    (folder / "bin" / "conda").write_text(text)
    (folder / "bin" / "conda").chmod(0o755)
    (folder / "bin" / "activate").write_text('export CONDA_PREFIX="$1" PATH="$1/bin:$PATH"\n')
    path = os.pathsep.join([str(folder / "bin"), os.environ["PATH"]])
    return {"PATH": path}, noted


def test_with_conda_jobs_run_in_its_environment_from_any_folder(tmp_path, conda):
    variables, noted = conda
    where = tmp_path / "elsewhere"
    where.mkdir()
    command = [sys.executable, "-m", "snakemake", "-j1", "--sdm", "conda", "-s", ROOT / "Snakefile"]
    target = "results/tiny/config.yaml"
    done = subprocess.run(
        [*map(str, command), "--configfile", str(TINY), "--", target],
        cwd=where,
        env=os.environ | warm() | variables,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert (where / target).is_file()
    calls = [line.split("|") for line in noted.read_text().splitlines()]
    installs = [(folder, words) for name, folder, words in calls if name == "pip"]
    # From the locks and sources of this checkout, wherever it was started.
    assert [folder for folder, _ in installs] == [str(ROOT)] * 3
    assert all(words.startswith("install --quiet") for _, words in installs)
    assert "--require-hashes --no-deps --requirement requirements.lock" in installs[0][1]
    assert "--editable ." in installs[2][1]
    jobs = [(folder, words) for name, folder, words in calls if name == "dine"]
    assert len(jobs) == 1
    assert jobs[0][0] == str(where)
    assert "config" in jobs[0][1]
