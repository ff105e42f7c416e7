"""Digests that decide what is made again."""

import os
from importlib import resources

import pytest

from dine import provenance
from dine.provenance import LAYERS, PACKAGE, code_digest, folder_signature, versions

# Their effect on results goes through settings, or they have none.
NEUTRAL = {
    "__init__.py",
    "__main__.py",
    "cli.py",
    "config.py",
    "errors.py",
    "files.py",
    "progress.py",
    "provenance.py",
    "registry.py",
    "results.py",
}


def test_every_module_belongs_to_a_layer():
    entries = {entry for layer in LAYERS.values() for entry in layer}
    for entry in entries:
        assert (PACKAGE / entry).exists(), entry
    for path in PACKAGE.rglob("*.py"):
        name = path.relative_to(PACKAGE).as_posix()
        covered = name in entries or name.split("/")[0] in entries
        assert covered or name in NEUTRAL or name.endswith("__init__.py"), name


def test_digest_follows_the_code(tmp_path, monkeypatch):
    package = tmp_path / "dine"
    for layer in LAYERS.values():
        for entry in layer:
            path = package / entry
            if path.suffix:
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_text(entry)
            else:
                path.mkdir(parents=True, exist_ok=True)
                (path / "module.py").write_text(entry)
    monkeypatch.setattr(provenance, "PACKAGE", package)

    def digests():
        code_digest.cache_clear()
        return {layer: code_digest(layer) for layer in LAYERS}

    before = digests()
    (package / "priors" / "module.py").write_text("changed")
    (package / "priors" / "notes.txt").write_text("not code")
    after = digests()
    code_digest.cache_clear()
    assert {layer for layer in LAYERS if before[layer] != after[layer]} == {"priors"}


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


@pytest.mark.parametrize("name", ["robust_defreg", "deftransnet"])
def test_shipped_weights_come_with_their_record(name):
    folder = resources.files("dine") / "weights"
    assert '"data": "synthetic"' in (folder / f"{name}.run.json").read_text()
    assert "val_mce" in (folder / f"{name}.history.csv").read_text().splitlines()[0]
