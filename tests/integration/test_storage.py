"""Each step where storage gives out: a clear error, earlier results kept, then it goes on."""

import json
import re
import shutil
import subprocess
import sys

import pytest
from commands import RAW, STAGE1, STAGE2, dine
from disks import full, mounted, read_only

from dine.errors import DataError, StorageError
from dine.files import read_json


@pytest.fixture(scope="module")
def disk(tmp_path_factory):
    with mounted(tmp_path_factory.mktemp("storage") / "disk", "64m") as place:
        yield place


@pytest.fixture(scope="module")
def evaluated(chain):
    """The chain with predictions and metrics."""
    model, pairs = chain / "stage1" / "model.safetensors", chain / "pairs.h5"
    dine("predict", "--model", model, "--pairs", pairs, "--out", chain / "predictions.h5")
    dine(*EVALUATE, *step_inputs(chain, "evaluate"), "--out", chain / "metrics.csv")
    return chain


EVALUATE = ("evaluate", "--dataset", "d", "--backbone", "b", "--method", "stage1")
COMMANDS = {
    "raw": ("raw", "--settings", RAW, "--seed", 1),
    "pairs": ("pairs", "--settings", '{"points": 64}'),
    "agreement": ("agreement",),
    "corrupt": ("corrupt", "--condition", "noise", "--level", 0.1),
    "resample": ("resample",),
    "stage1": ("stage1", "--settings", STAGE1),
    "fields": ("fields",),
    "fit-prior": ("fit-prior", "--settings", '{"kind": "pca"}'),
    "search-lambda": (
        *("search-lambda", "--stage2", STAGE2),
        *("--settings", '{"candidates": [0.001], "extend": 0, "steps": 2, "validation_pairs": 1}'),
    ),
    "stage2": ("stage2", "--variant", "pca", "--lambda", 0.1, "--settings", STAGE2),
    "predict": ("predict",),
    "evaluate": EVALUATE,
    "tables": ("tables",),
}
INPUTS = {
    "pairs": {"--raw": "raw.json"},
    "agreement": {"--pairs": "pairs.h5"},
    "corrupt": {"--pairs": "pairs.h5"},
    "resample": {"--raw": "raw.json", "--pairs": "pairs.h5"},
    "stage1": {"--pairs": "pairs.h5"},
    "fields": {"--pairs": "pairs.h5", "--model": "stage1/model.safetensors"},
    "fit-prior": {"--fields": "dvf.h5"},
    "search-lambda": {
        "--pairs": "pairs.h5",
        "--model": "stage1/model.safetensors",
        "--prior pca": "pca.safetensors",
    },
    "stage2": {
        "--pairs": "pairs.h5",
        "--model": "stage1/model.safetensors",
        "--prior": "pca.safetensors",
    },
    "predict": {"--pairs": "pairs.h5", "--model": "stage1/model.safetensors"},
    "evaluate": {"--pairs": "pairs.h5", "--predictions": "predictions.h5"},
    "tables": {"": "metrics.csv"},
}
# What is written where ``--out`` names a folder.
RESULT = {
    "raw": "raw.json",
    "stage1": "model.safetensors",
    "stage2": "model.safetensors",
    "tables": "all.md",
}


def step_inputs(chain, step):
    return [
        part
        for option, name in INPUTS.get(step, {}).items()
        for part in (*option.split(), chain / name)
    ]


def command(chain, step, out):
    return (*COMMANDS[step], *step_inputs(chain, step), "--out", out)


@pytest.mark.parametrize("step", COMMANDS)
@pytest.mark.parametrize(
    ("trouble", "message"), [(full, "the disk is full"), (read_only, "(?i)read-only")]
)
def test_a_step_says_what_is_wrong_and_goes_on_afterwards(evaluated, disk, step, trouble, message):
    place = disk / step
    place.mkdir()
    out = place / "out" if step in RESULT else place / "out.part"
    result = out / RESULT[step] if step in RESULT else out
    result.parent.mkdir(exist_ok=True)
    result.write_bytes(b"finished work")
    with trouble(disk), pytest.raises(StorageError, match=message):
        dine(*command(evaluated, step, out))
    assert result.read_bytes() == b"finished work"
    assert not [path for path in place.rglob(".*") if path.is_file() and path.suffix != ".lock"]
    dine(*command(evaluated, step, out))
    assert result.read_bytes() != b"finished work"
    shutil.rmtree(place)


def test_a_training_that_ran_out_of_space_goes_on_from_its_last_state(evaluated, disk):
    out = disk / "training"
    settings = json.loads(STAGE1) | {"steps": 5, "save_seconds": 1e-9}
    train = ("stage1", "--pairs", evaluated / "pairs.h5", "--out", out, "--settings")
    dine(*train, json.dumps(settings))
    (out / "model.safetensors").unlink()
    state = out / "training" / "state.pt"
    before = state.read_bytes()
    for steps in (5, 6):
        with full(disk), pytest.raises(StorageError, match="the disk is full"):
            dine(*train, json.dumps(settings | {"steps": steps}))
    assert state.read_bytes() == before
    dine(*train, json.dumps(settings))
    assert read_json(out / "run.json")["settings"]["steps"] == 5
    shutil.rmtree(out)


@pytest.mark.parametrize(
    ("trouble", "message"), [(full, "the disk is full"), (read_only, "(?i)read-only")]
)
def test_a_log_that_cannot_be_written_gives_no_traceback(evaluated, disk, trouble, message):
    arguments = (
        *("--log", disk / "logs" / "agreement.log"),
        *command(evaluated, "agreement", disk / "agreement.json"),
    )
    (disk / "logs").mkdir(exist_ok=True)
    with trouble(disk):
        done = subprocess.run(
            [sys.executable, "-m", "dine", *map(str, arguments)], capture_output=True, text=True
        )
    assert done.returncode == 1
    assert "Traceback" not in done.stderr
    assert re.search(message, done.stderr.splitlines()[-1])


def test_meshes_that_have_vanished(evaluated, tmp_path):
    meshes = evaluated / "raw"
    away = meshes.rename(tmp_path / "away")
    with pytest.raises(DataError, match="raw is not a folder"):
        dine(*command(evaluated, "pairs", tmp_path / "pairs.h5"))
    assert not (tmp_path / "pairs.h5").exists()
    away.rename(meshes)
    dine(*command(evaluated, "pairs", tmp_path / "pairs.h5"))
    assert (tmp_path / "pairs.h5").stat().st_size > 0
