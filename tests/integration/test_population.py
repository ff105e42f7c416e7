"""A template registered to scans of a population, and the shape model of the results."""

import csv
import re
import shlex
from pathlib import Path

import numpy as np
import pytest
import trimesh
from commands import run

import dine
from dine.errors import ConfigError, DataError, StorageError
from dine.files import read_json
from dine.geometry.surface import Surface
from dine.io.readers import read_surface
from dine.io.writers import write_surface
from dine.priors.organ import load_organ_prior
from dine.registration.types import RegistrationResult, Trust

PAGE = Path(__file__).parents[2] / "docs" / "guide" / "population.md"
# Enough to go through every part of it.
QUICK = ("--points", "64", "--map", "2", "--no-surfaces", "--include-doubtful")


def organ(stretch=0.0, bend=0.0):
    ball = trimesh.creation.icosphere(subdivisions=2)
    x, y, z = (ball.vertices * [1, 0.7, 0.5]).T
    vertices = np.column_stack([(1 + stretch) * x, y, z + bend * x**2])
    return Surface(40 * vertices, ball.faces, name="organ")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """As the page begins: a template, scans of four patients, and one of another."""
    root = tmp_path_factory.mktemp("population")
    write_surface(root / "template.ply", organ())
    (root / "patients").mkdir()
    for name, ways in {"a": (0.2, 0), "b": (-0.1, 0.2), "c": (0, -0.2), "d": (0.1, 0.1)}.items():
        write_surface(root / "patients" / f"{name}.ply", organ(*ways))
    write_surface(root / "new.ply", organ(0.15, -0.1))
    return root


@pytest.fixture(scope="module")
def made(folder):
    """What the commands of the page make, as they stand there."""
    block = re.search(r"```sh\n(.*?)```", PAGE.read_text(), re.DOTALL)[1]
    said = []
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        for line in block.splitlines():
            program, *words = shlex.split(line, comments=True)
            assert program == "dine"
            words = [
                str(path)
                for word in words
                for path in (sorted(Path().glob(word)) if "*" in word else [word])
            ]
            done = run(*words, *(QUICK if words[0] == "register-many" else ()))
            assert done.exit_code == 0, done.exception
            said.append((words[0], done.output))
    assert [name for name, _ in said] == ["register-many", "register"]
    return folder / "population", said[0][1]


def test_the_commands_of_the_page(made):
    out, said = made
    report = read_json(out / "model.json")
    assert report["scans"]["used"] == ["a", "b", "c", "d"]
    assert f"{report['modes']} modes of 4 of 4 scans" in said
    assert np.array_equal(read_surface(out / "mean.ply").faces, organ().faces)
    assert "standard_deviation" in read_surface(out / "mean.ply").data
    prior = load_organ_prior(out / "model.prior")
    assert len(prior.modes) == report["prior"]["modes"]
    minus, plus = (
        read_surface(out / "modes" / f"mode1_{side}2sd.ply").vertices for side in ("minus", "plus")
    )
    assert np.allclose((minus + plus) / 2, read_surface(out / "mean.ply").vertices)
    assert not np.allclose(minus, plus)
    assert len(report["quality"]) == len(read_rows(out / "quality.csv")) >= 3
    assert (out / "quality.png").read_bytes().startswith(b"\x89PNG")
    assert (out.parent / "moved.ply").exists()


def read_rows(path):
    with open(path, newline="", encoding="utf-8") as stream:
        return list(csv.DictReader(stream))


def test_scores_have_a_row_for_each_scan(made):
    rows = read_rows(made[0] / "scores.csv")
    assert [row["name"] for row in rows] == ["a", "b", "c", "d"]
    for row in rows:
        scores = [float(value) for name, value in row.items() if name.startswith("mode")]
        assert float(row["mahalanobis"]) == pytest.approx(np.linalg.norm(scores), rel=1e-4)
        assert row["verdict"] == "doubtful"


def test_it_goes_on_where_it_stopped(made, folder):
    """With another scan only that is registered; what is doubtful counts only if asked for."""
    out = made[0]
    files = sorted((folder / "patients").glob("*.ply"))
    moved = out / "registrations" / "a" / "moved.ply"
    before = moved.stat().st_mtime_ns
    words = ("register-many", "--template", folder / "template.ply", *files, "-o", out)
    done = run(*words, *QUICK[:-1])
    assert isinstance(done.exception, DataError)
    assert "0 of 4 scans are usable, 4 are left out as doubtful" in str(done.exception)
    assert (out / "model.json").exists()
    done = run(*words, folder / "new.ply", *QUICK, "--modes", "1", "--scale")
    assert done.exit_code == 0, done.exception
    assert moved.stat().st_mtime_ns == before
    assert read_json(out / "model.json")["scans"]["given"] == 5
    assert read_json(out / "model.json")["frame"] == "rigid and size"
    assert not (out / "modes" / "mode2_plus2sd.ply").exists()


def test_a_scan_of_other_units_is_named_and_left_out(made, folder, tmp_path):
    write_surface(tmp_path / "metres.ply", Surface(organ(0.1).vertices / 1000, organ().faces))
    files = [*sorted((folder / "patients").glob("*.ply")), tmp_path / "metres.ply"]
    template = ("--template", folder / "template.ply")
    done = run("register-many", *template, *files, "-o", made[0], *QUICK)
    assert done.exit_code == 1
    assert "metres is left out, failed:" in done.output
    assert "metres and the other in millimetres" in done.output.replace("\n", " ")
    row = read_rows(made[0] / "scores.csv")[-1]
    assert (row["name"], row["used"], row["verdict"]) == ("metres", "False", "failed")
    assert row["mahalanobis"] == row["mode1"] == ""
    report = read_json(made[0] / "model.json")
    assert report["scans"]["used"] == ["a", "b", "c", "d"]
    assert list(report["scans"]["left_out"]) == ["metres"]


@pytest.mark.parametrize(
    ("words", "error", "said"),
    [
        (["a", "b"], DataError, "2 scans are too few for a shape model"),
        (["a", "b", "c", "../template"], DataError, "template.ply is the template itself"),
        (["a", "b", "other/a"], DataError, "1 names are those of several scans, such as 'a'"),
        (["a", "b", "same"], DataError, "are the same scan; leave one out"),
        (["a", "b", "missing"], DataError, "missing.ply cannot be read"),
    ],
)
def test_bad_populations_are_refused_before_anything_is_made(folder, tmp_path, words, error, said):
    patients = folder / "patients"
    (tmp_path / "other").mkdir()
    write_surface(tmp_path / "other" / "a.ply", organ(0.3))
    (tmp_path / "same.ply").write_bytes((patients / "b.ply").read_bytes())
    places = {"other/a": tmp_path / "other" / "a.ply", "same": tmp_path / "same.ply"}
    scans = [places.get(word, patients / f"{word}.ply") for word in words]
    out = tmp_path / "out"
    done = run("register-many", "--template", folder / "template.ply", *scans, "-o", out, *QUICK)
    assert isinstance(done.exception, error), done.output
    assert said in str(done.exception)
    assert not out.exists()


def test_files_of_others_are_kept(folder, tmp_path):
    (tmp_path / "mean.ply").write_text("mine")
    scans = sorted((folder / "patients").glob("*.ply"))
    words = ("register-many", "--template", folder / "template.ply", *scans, "-o", tmp_path)
    done = run(*words, *QUICK)
    assert isinstance(done.exception, StorageError)
    assert "mean.ply exists already and is of no earlier shape model" in str(done.exception)
    assert (tmp_path / "mean.ply").read_text() == "mine"


def test_what_belongs_to_a_shape_model_needs_a_template(folder, tmp_path):
    scans = sorted((folder / "patients").glob("*.ply"))
    done = run("register-many", scans[0], "-o", tmp_path / "out", "--include-doubtful")
    assert isinstance(done.exception, ConfigError)
    assert "--include-doubtful is about a shape model" in str(done.exception)
    done = run("register-many", *scans, "-o", tmp_path / "out")
    assert "4 files were given; expected one list or folder of pairs" in str(done.exception)
    write_surface(tmp_path / "cloud.ply", Surface(organ().vertices))
    done = run("register-many", "--template", tmp_path / "cloud.ply", *scans, "-o", tmp_path / "o")
    assert "cloud.ply is a cloud; the template of a shape model must be" in str(done.exception)


def result(verdict="plausible", source=None, **ways):
    """A registration as if it had found the truth."""
    source, moved = source or organ(), organ(**ways)
    return RegistrationResult(
        source,
        moved,
        moved,
        moved.vertices - source.vertices,
        *(None, {}, source.vertices, source.vertices, None, np.ones(len(source.vertices), bool)),
        Trust(verdict, (f"{verdict} for a reason",), {}, None),
        alignment=None,
        motion=None,
    )


RESULTS = {
    "a": {"stretch": 0.2},
    "b": {"stretch": -0.1, "bend": 0.2},
    "c": {"bend": -0.2},
    "d": {"stretch": 0.1, "bend": 0.1, "verdict": "doubtful"},
    "e": {"stretch": 0.3, "verdict": "implausible"},
}


@pytest.mark.parametrize("doubtful", [False, True])
def test_results_become_a_model(doubtful):
    results = {name: result(**ways) for name, ways in RESULTS.items()}
    model = dine.shape_model(organ(), results, include_doubtful=doubtful)
    used = [member.name for member in model.members if member.used]
    assert used == list("abcd" if doubtful else "abc")
    assert len(model.members) == 5
    assert f"{len(used)} shapes" in repr(model)
    assert np.isfinite(model.scores(results["e"].moved.vertices)).all()


def test_results_that_do_not_fit_are_refused():
    results = [result(stretch=size) for size in (0.1, 0.2, 0.3)]
    other = Surface(2 * organ().vertices, organ().faces)
    with pytest.raises(DataError, match="1 is a result of another template than organ"):
        dine.shape_model(organ(), [results[0], result(source=other, stretch=1.0), results[1]])
    with pytest.raises(DataError, match="2 scans are too few"):
        dine.shape_model(organ(), results[:2])
    with pytest.raises(DataError, match="2 is the template itself"):
        dine.shape_model(organ(), [*results[:2], organ()])
