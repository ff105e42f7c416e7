"""Digests that decide what is made again."""

import os
import re
import shutil
import subprocess
import sys
from datetime import datetime, timedelta
from importlib import resources

import pytest
from commands import leaves

from dine import cli, priors, provenance
from dine.errors import ConfigError
from dine.priors import PRIORS
from dine.provenance import code_digest, code_files, folder_signature, versions


def code_of(*step):
    return {name.removeprefix("dine.") for name in code_files(*step)}


def test_every_command_has_its_code():
    for path, _ in leaves(cli.cli):
        assert len(path) > 1 or code_files(*path), path


def test_code_is_found_through_imports():
    raw, corrupt, train = code_of("raw"), code_of("corrupt"), code_of("stage1")
    assert {"data.obtain", "data.synthetic", "data.deformation"} <= raw
    assert corrupt & {"data.corruption", "training.loop"} == {"data.corruption"}
    assert {"training.loop", "geometry.graph", "models.compiled.messages"} <= train
    # Templates and tables are code, too.
    assert "reporting/published_results.csv" in code_of("tables")
    assert "reporting/report.html" in code_of("report") & code_of("evidence")
    assert not {"cli", "config"} & (raw | corrupt | train)
    assert "files" in raw & corrupt & train


def test_only_the_classes_that_are_picked_count():
    assert not any(name.startswith("priors") for name in code_of("stage1"))
    fit = code_of("fit-prior", "pca_residual")
    assert {"priors.pca_residual", "priors.pca", "priors.fitting", "priors.sources"} <= fit
    assert "priors.flow" not in fit
    assert "classical.bcpd" in code_of("classical", "bcpd")


def test_priors_are_known_before_they_are_imported():
    """By the name under which each module registers its class, and the class by its own."""
    modules = {name: of for name, of in provenance._registered().items() if "priors" in of[0]}
    assert sorted(modules) == PRIORS.names()
    for name, (module,) in modules.items():
        assert PRIORS.get(name).__module__ == module
        exported = PRIORS.get(name).__name__
        assert getattr(priors, exported) is PRIORS.get(name)
        assert exported in priors.__all__
        assert provenance._defining("dine.priors", exported) == module


def test_a_registration_is_not_made_again_for_the_training_loop():
    for step in ("register", "register-many", "calibrate"):
        assert not any(name.startswith("training") for name in code_of(step, "robust_defreg"))


def test_what_rivals_run_does_not_depend_on_the_networks():
    assert not any(name.startswith(("models", "training")) for name in code_of("classical", "cpd"))


PACKAGE = {
    "own/__init__.py": "from own.priors import Mine",
    "own/priors.py": "from .helpers import scale\nfrom dine.geometry import chamfer\nimport beside",
    "own/helpers.py": "if TYPE_CHECKING:\n    import own.types\n\ndef scale():\n    import numpy",
    "own/types.py": "",
    "own/other.py": "from own.helpers import scale",
    "beside.py": "",
}


@pytest.fixture
def own(tmp_path, monkeypatch, fresh):
    """A user's package on the Python path."""
    for name, text in PACKAGE.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text)
    monkeypatch.syspath_prepend(tmp_path)
    return tmp_path


@pytest.mark.parametrize("name", ["own.priors:Mine", "own:Mine"])
@pytest.mark.parametrize(
    ("edited", "counts"),
    [
        ("own/priors.py", True),
        ("own/helpers.py", True),
        ("beside.py", True),
        ("own/types.py", False),
        ("own/other.py", False),
    ],
)
def test_a_users_own_code_counts_with_what_it_imports(own, fresh, name, edited, counts):
    before = code_digest("fit-prior", name)
    assert before != code_digest("fit-prior")
    assert "dine.geometry.chamfer" in code_files("fit-prior", name)
    assert not any(module.startswith("numpy") for module in code_files("fit-prior", name))
    (own / edited).write_text(PACKAGE[edited] + "\n# A remark.\n")
    fresh()
    assert code_digest("fit-prior", name) == before
    (own / edited).write_text(PACKAGE[edited] + "\nADDED = 1\n")
    fresh()
    assert (code_digest("fit-prior", name) != before) == counts
    # Nothing of it was run to find that out.
    assert "own" not in sys.modules


@pytest.mark.parametrize("name", ["no_such_module_here:Mine", "own.nothing:Mine", "flwo"])
def test_classes_that_are_not_there_are_named(own, name):
    with pytest.raises(ConfigError, match=re.escape(repr(name))):
        code_digest("fit-prior", name)


def test_a_module_with_a_mistake_is_named(own):
    (own / "own" / "helpers.py").write_text("def scale(:")
    with pytest.raises(ConfigError, match=r"helpers\.py cannot be read as Python: invalid syntax"):
        code_digest("fit-prior", "own:Mine")


def test_the_digest_follows_the_code_of_the_package(tmp_path, monkeypatch, fresh):
    steps = [("stage1", "chamfer"), ("fit-prior", "pca"), ("fit-prior", "flow"), ("tables",)]
    package = tmp_path / "dine"
    shutil.copytree(
        provenance.PACKAGE, package, ignore=shutil.ignore_patterns("__pycache__", "weights")
    )
    monkeypatch.setattr(provenance, "PACKAGE", package)

    def digests():
        fresh()
        return [code_digest(*step) for step in steps]

    known = [digests()]

    def changed_by(name, text):
        path = package / name
        path.write_text(text(path.read_text()))
        known.append(digests())
        return [step for step, old, new in zip(steps, *known[-2:], strict=True) if old != new]

    def longer(text):
        return text + "\nADDED = 1\n"

    def reworded(text):
        return text.replace('"""', '"""In other words: ', 1) + "\n\n# A remark.\n"

    assert changed_by("priors/flow.py", longer) == [("fit-prior", "flow")]
    assert changed_by("training/loop.py", longer) == [("stage1", "chamfer")]
    assert changed_by("training/loop.py", reworded) == []
    assert changed_by("training/loop.py", lambda text: text.replace("0.01 +", "0.02 +")) == [
        ("stage1", "chamfer")
    ]
    assert changed_by("reporting/published_results.csv", longer) == [("tables",)]
    assert changed_by("files.py", longer) == steps
    assert changed_by("files.py", reworded) == []
    # Of the command line, each step has its own command, without the help.
    assert (
        changed_by("cli/reporting.py", lambda text: text.replace("Aggregate metrics", "Sum up"))
        == []
    )
    assert changed_by(
        "cli/reporting.py",
        lambda text: text.replace("write_tables(made, out)", "write_tables(list(made), out)"),
    ) == [("tables",)]


def test_folder_signature_sees_files_come_go_and_change(tmp_path):
    (tmp_path / "a").mkdir()
    mesh = tmp_path / "a" / "mesh.ply"
    mesh.write_text("one")
    seen = [folder_signature(tmp_path)]
    mesh.write_text("other")
    seen.append(folder_signature(tmp_path))
    (tmp_path / "b.ply").write_text("")
    seen.append(folder_signature(tmp_path))
    os.utime(mesh, ns=(1, 1))
    seen.append(folder_signature(tmp_path))
    assert len(set(seen)) == 4
    assert folder_signature(tmp_path) == seen[-1]


def test_signature_of_a_manifest_sees_the_files_that_it_lists(tmp_path):
    (tmp_path / "lists").mkdir()
    manifest = tmp_path / "lists" / "pairs.csv"
    manifest.write_text("source,target\n../a.ply,../b.ply\n")
    seen = [folder_signature(manifest)]
    for name in ("a.ply", "b.ply"):
        (tmp_path / name).write_text(name)
        seen.append(folder_signature(manifest))
    (tmp_path / "c.ply").write_text("not listed")
    assert folder_signature(manifest) == seen[-1]
    manifest.write_text("source,target\n../a.ply,../c.ply\n")
    seen.append(folder_signature(manifest))
    assert len(set(seen)) == 4
    manifest.write_bytes(b"nothing\xff\n1,2,3\n")
    assert folder_signature(manifest)


def test_versions_name_what_results_depend_on():
    assert {"dine", "python", "torch", "numpy", "numba"} <= set(versions())


def test_records_say_on_what_of_which_commit_when_and_how(monkeypatch):
    for name in (*provenance.CPU_SETTINGS, provenance.COMMAND):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(sys, "argv", ["/somewhere/bin/dine", "stage1", "--out", "a folder"])
    found = provenance.made()
    assert found["CPU"].endswith(f", {os.cpu_count()} threads")
    assert found["command"] == "dine stage1 --out 'a folder'"
    assert datetime.fromisoformat(found["date"]).utcoffset() == timedelta(0)
    assert "CPU settings" not in found
    monkeypatch.setenv("OMP_NUM_THREADS", "3")
    monkeypatch.setenv("ATEN_CPU_CAPABILITY", "avx2")
    monkeypatch.setenv(provenance.COMMAND, "snakemake -j2 all")
    record = provenance.run_record({"steps": 1}, 5)
    assert record["made"]["command"] == "snakemake -j2 all"
    assert record["made"]["CPU settings"] == "ATEN_CPU_CAPABILITY=avx2 OMP_NUM_THREADS=3"


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ("none", r"[0-9a-f]{40}"),
        ("some", r"[0-9a-f]{40} with changes"),
        ("damage", r"unknown \(git cannot be asked\)"),
        ("package", r"none \(installed package, version .*\)"),
    ],
)
def test_the_commit_is_that_of_the_checkout(tmp_path, monkeypatch, changes, expected):
    def git(*arguments):
        who = ("-c", "user.name=a", "-c", "user.email=a@b")
        subprocess.run(["git", "-C", tmp_path, *who, *arguments], check=True)

    (tmp_path / "file").write_text("1")
    if changes == "damage":
        (tmp_path / ".git").write_text("gitdir: /nowhere")
    elif changes != "package":
        git("init", "--quiet")
        git("add", "file")
        git("commit", "--quiet", "--message", "first")
    if changes == "some":
        (tmp_path / "file").write_text("2")
    monkeypatch.setattr(provenance, "PACKAGE", tmp_path / "dine")
    assert re.fullmatch(expected, provenance._commit.__wrapped__())


@pytest.mark.parametrize("name", ["robust_defreg", "deftransnet"])
def test_shipped_weights_come_with_their_record(name):
    folder = resources.files("dine") / "weights"
    assert '"data": "synthetic"' in (folder / f"{name}.run.json").read_text()
    assert "val_mce" in (folder / f"{name}.history.csv").read_text().splitlines()[0]
