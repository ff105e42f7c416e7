"""Files and folders with spaces, quotes, letters beyond ASCII, and a dash in front."""

import json

import numpy as np
import pandas as pd
import pytest
import trimesh
import yaml
from commands import dine as run
from test_workflow import ROOT, copy_workflow, planned, snakemake

from dine.data.pairs import read_pairs
from dine.geometry.surface import Surface
from dine.io.readers import read_surface
from dine.io.writers import write_surface

NAMES = ("-dash", 'Gewebe – äöü 組織, it\'s "quoted" $HOME `x` & more')


def dataset(folder):
    """Three objects with a pair of one level each, in the published layout."""
    for number in range(3):
        mesh = trimesh.creation.icosphere(subdivisions=2)
        source = mesh.vertices * [1, 0.8 - 0.1 * number, 0.6]
        for role, vertices in (("Source", source), ("Target", source + 0.1 * source**2)):
            path = folder / "Deformation_Level" / "0.3" / f"{role}_{number}_5_0.3.ply"
            write_surface(path, Surface(vertices, mesh.faces))
    return folder


@pytest.mark.parametrize("name", NAMES)
def test_commands_take_any_name(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    points = np.random.default_rng(0).normal(size=(60, 3))
    for ending, cloud in (("before", points), ("after", points + 0.02)):
        write_surface(f"{name} {ending}.ply", Surface(cloud))
    files = [f"{name} {ending}.ply" for ending in ("before", "after")]
    done = run("register", "-o", f"{name} out/{name}.ply", "--map", 1, "--view", "--", *files)
    assert done.exit_code == 0, done.output
    out = tmp_path / f"{name} out"
    endings = ("field.npz", "field.vtp", "html", "json", "ply", "result.npz")
    assert sorted(path.name for path in out.iterdir()) == [f"{name}.{end}" for end in endings]
    assert len(read_surface(out / f"{name}.ply").vertices) == 60
    assert json.loads((out / f"{name}.json").read_text())["target"]["name"] == f"{name} after.ply"
    dataset(tmp_path / name)
    done = run("inspect", "--", name)
    assert done.exit_code == 0, done.output
    assert "deformation" in done.output
    pd.DataFrame({"source": [f"{name} before.ply"], "target": [f"{name} after.ply"]}).to_csv(
        f"{name}.csv", index=False
    )
    done = run("register-many", "-o", f"{name} many", "--map", 1, "--", f"{name}.csv")
    assert done.exit_code == 0, done.output
    assert (tmp_path / f"{name} many" / "summary.csv").is_file()


@pytest.mark.parametrize("name", NAMES)
def test_the_workflow_takes_any_name(name, tmp_path):
    folder = copy_workflow(tmp_path)
    place = dataset(tmp_path / f"data {name}")
    changes = {
        "results": f"{name} results" if name.startswith("-") else f"results/{name}",
        "datasets": {
            "synbench": {
                "source": {"kind": "path", "folder": str(place)},
                "pairs": {
                    "points": 32,
                    "split": {"by": "object", "train": 0.4, "val": 0.3, "test": 0.3},
                },
                "unseen": None,
            }
        },
    }
    path = folder / "changes.yaml"
    path.write_text(yaml.safe_dump(changes, allow_unicode=True))
    arguments = ("--configfile", "config/tiny.yaml", path)
    assert planned(folder, "all", *arguments)["pairs"] == 2
    if name == "-dash":
        return  # one run, with everything else in a name, is enough
    made = folder / changes["results"] / "synbench" / "pairs.h5"
    snakemake(folder, made.relative_to(folder), *arguments)
    assert len(read_pairs(made)) == 3


def test_the_workflow_starts_from_any_folder(tmp_path):
    """Its own configuration is the base there, unless the folder has one of its own."""
    where = tmp_path / "elsewhere"
    where.mkdir()
    arguments = ["-s", ROOT / "Snakefile", "--configfile", ROOT / "config" / "tiny.yaml"]
    elsewhere = planned(where, *arguments)
    assert elsewhere == planned(copy_workflow(tmp_path), *arguments[2:])
    own = yaml.safe_load((ROOT / "config.yaml").read_text()) | {"results": "mine"}
    (where / "config.yaml").write_text(yaml.safe_dump(own))
    assert "mine/report.html" in snakemake(where, "-n", *arguments[:2]).stdout
