"""The whole chain, from generated meshes to metrics, through the commands a user would call."""

import json
import os
import platform
import re
import shutil
import signal
import subprocess
import sys
import time

import h5py
import numpy as np
import pandas as pd
import pytest
import torch
from commands import STAGE1, STAGE2, dine

from dine import cli, config
from dine.config import LambdaSearch, Stage2
from dine.data.batch import make_batch
from dine.data.fields import read_fields
from dine.data.obtain import obtain
from dine.data.pairs import read_pairs, read_seen, read_variant, write_pairs
from dine.data.synthetic import primitive
from dine.errors import CheckpointError, ConfigError, DataError, DineError
from dine.files import read_json, write_json
from dine.geometry.distance import chamfer
from dine.geometry.surface import Surface
from dine.io.writers import write_surface
from dine.models.inference import predict_fields
from dine.priors import FlowPrior, load_prior
from dine.state import one_writer
from dine.training import stages
from dine.training.data_terms import DATA_TERMS
from dine.training.loop import VALIDATION_COLUMNS
from dine.training.stage2 import best_lambda, beyond_the_edge, search_lambda, selected_lambda

numerical = pytest.mark.numerical


def test_stage1_writes_weights_history_and_record(chain):
    record = read_json(chain / "stage1" / "run.json")
    assert record["settings"]["steps"] == 3
    assert record["seed"] == 0
    assert record["train_pairs"] == 4
    assert record["device"] in ("cpu", "cuda")
    assert {"dine", "torch", "python"} <= set(record["versions"])
    history = pd.read_csv(chain / "stage1" / "history.csv")
    assert history["step"].tolist() == [1, 2, 3]
    assert history["val_cd"].notna().tolist() == [False, False, True]


@numerical
def test_fields_are_the_models_own_on_the_training_split(chain):
    stored = read_fields(chain / "dvf.h5")
    train = read_pairs(chain / "pairs.h5", split="train")
    backbone, _ = stages.load_backbone(chain / "stage1" / "model.safetensors")
    again = predict_fields(backbone, train, name="again", batch_size=1)
    assert stored.displacement.shape == train.source.shape
    # Batched or alone, and whatever the order of the target's points.
    assert np.abs(stored.displacement - again.displacement).max() < 1e-4
    assert (stored.source == train.source).all()
    assert (stored.true == train.displacement).all()
    assert (again.spread >= 0).all()
    assert (again.seconds > 0).all()


@numerical
def test_lambda_is_the_best_candidate_on_validation_pairs(chain):
    result = read_json(chain / "lambda.json")
    curve = pd.DataFrame(result["curve"])
    assert sorted(curve["lambda"]) == [0, 0.001, 0.1]
    tried = curve[curve["lambda"] > 0]
    assert result["selected"]["pca"] == tried.loc[tried["cd"].idxmin(), "lambda"]
    assert selected_lambda(chain / "lambda.json", "pca") == result["selected"]["pca"]
    # A prior without a search of its own takes the default's.
    assert selected_lambda(chain / "lambda.json", "flow") == result["selected"]["pca"]


def test_how_random_weights_start_is_no_matter_where_weights_are_given():
    given = stages.starting_backbone("robust_defreg", {}, "pretrained", 0)
    other = "default" if given.arguments["initialisation"] == "geometric" else "geometric"
    same = stages.starting_backbone("robust_defreg", {"initialisation": other}, "pretrained", 0)
    assert all(map(torch.equal, given.state_dict().values(), same.state_dict().values()))
    with pytest.raises(CheckpointError, match="the configuration asks for"):
        stages.starting_backbone("robust_defreg", {"candidates": 7}, "pretrained", 0)


@pytest.mark.parametrize(
    ("tried", "expected"),
    [
        ({1e-4: 3, 1e-3: 2, 1e-2: 1}, 0.1),
        ({1e-4: 1, 1e-3: 2, 1e-2: 3}, 1e-5),
        ({1e-2: 3, 1e-4: 2, 1e-3: 1}, None),
        ({1e-4: 3, 1e-3: 2, 5e-3: 1}, 0.025),
        ({1e-4: 1}, None),
    ],
)
def test_the_grid_goes_on_as_its_last_steps(tried, expected):
    assert beyond_the_edge(list(tried), best_lambda(tried, 0)) == expected


@pytest.mark.parametrize(("tolerance", "expected"), [(0, 1e-3), (0.09, 1e-3), (0.1, 1e-2)])
def test_what_chance_can_hide_is_left_to_the_stronger_prior(tolerance, expected):
    means = {1e-4: 12.0, 1e-2: 11.0, 1e-3: 10.0, 1e-1: 15.0}
    assert best_lambda(means, tolerance) == expected


@pytest.mark.parametrize(
    ("best", "extend", "tried", "selected"),
    [
        (1.0, 0, [1e-3, 1e-2], 1e-2),
        (1.0, 1, [1e-3, 1e-2, 1e-1], 1e-1),
        (0.1, 3, [1e-3, 1e-2, 1e-1, 1], 1e-1),
        (1e-5, 2, [1e-5, 1e-4, 1e-3, 1e-2], 1e-5),
    ],
)
def test_a_search_goes_on_until_the_best_lies_inside(
    tmp_path, monkeypatch, best, extend, tried, selected
):
    def stage2(pairs, model, settings, order, *, weight, **_):
        # How far λ is from the best, in steps; the control is beyond all.
        error = abs(np.log10(weight / best)) if weight else 99.0
        order.out.mkdir(parents=True)
        write_json(order.out / "run.json", {"final": dict.fromkeys(VALIDATION_COLUMNS, error)})

    monkeypatch.setattr("dine.training.stage2.stage2", stage2)
    search = LambdaSearch(candidates=[1e-2, 1e-3], extend=extend)
    out = tmp_path / "lambda.json"
    order = stages.Order(seed=0, out=out, name="search")
    search_lambda(out, out, {"pca": out}, Stage2(), search, order)
    result = read_json(out)
    assert [row["lambda"] for row in result["curve"]] == [0, *tried]
    assert result["selected"] == {"pca": selected}


def run_stage2(chain, out, *arguments):
    dine(
        *("stage2", "--pairs", chain / "pairs.h5", "--settings", STAGE2, "--out", out),
        *("--model", chain / "stage1" / "model.safetensors", *arguments),
    )
    return read_json(out / "run.json"), (out / "model.safetensors").read_bytes()


@numerical
def test_stage2_and_its_control(chain, tmp_path):
    prior = ("--prior", chain / "pca.safetensors", "--variant", "pca")
    control, control_weights = run_stage2(chain, tmp_path / "control")
    strong, strong_weights = run_stage2(chain, tmp_path / "pca", *prior, "--lambda", "0.5")
    assert control["lambda"] == 0
    assert strong["lambda"] == 0.5
    assert control_weights != strong_weights
    # Same start, same first batch: the first data terms agree, and the penalty comes on top.
    first = {
        name: pd.read_csv(tmp_path / name / "history.csv").iloc[0] for name in ("control", "pca")
    }
    assert first["control"]["data"] == first["pca"]["data"]
    assert first["control"]["penalty"] == 0
    expected = first["pca"]["data"] + 0.5 * first["pca"]["penalty"]
    assert first["pca"]["loss"] == pytest.approx(expected, rel=1e-5)
    # λ from the file of the search.
    found, _ = run_stage2(chain, tmp_path / "file", *prior, "--lambda", chain / "lambda.json")
    assert found["lambda"] == read_json(chain / "lambda.json")["selected"]["pca"]


@numerical
def test_equal_runs_give_equal_bytes(chain, tmp_path):
    dine("stage1", "--pairs", chain / "pairs.h5", "--settings", STAGE1, "--out", tmp_path)
    first = (chain / "stage1" / "model.safetensors").read_bytes()
    assert (tmp_path / "model.safetensors").read_bytes() == first


@numerical
def test_precision_is_recorded_and_part_of_the_identity(chain, tmp_path):
    train = ("stage1", "--pairs", chain / "pairs.h5", "--settings", STAGE1, "--out", tmp_path)
    dine(*train)
    dine(*train, "--precision", "bf16")
    exact, reduced = read_json(chain / "stage1" / "run.json"), read_json(tmp_path / "run.json")
    assert (exact["precision"], reduced["precision"]) == ("float32", "bf16")
    assert exact["final"]["val_cd"] != reduced["final"]["val_cd"]
    model = ("--model", chain / "stage1" / "model.safetensors", "--pairs", chain / "pairs.h5")
    dine("fields", *model, "--precision", "bf16", "--out", tmp_path / "dvf.h5")
    reduced, exact = (read_fields(x / "dvf.h5").displacement for x in (tmp_path, chain))
    assert 0 < np.abs(reduced - exact).max() < 0.5


PYTHON = (sys.executable, "-m", "dine")


def training_arguments(chain, out, steps=16, processes=1):
    settings = json.loads(STAGE1) | {"steps": steps, "batch_size": 2, "save_seconds": 0.001}
    settings["validate_every"] = settings["steps"]
    return [
        *("--threads", "1", "stage1", "--out", out),
        *("--pairs", chain / "pairs.h5", "--settings", json.dumps(settings)),
        *("--device", "cpu", "--processes", str(processes)),
    ]


@pytest.fixture
def one_thread(monkeypatch):
    """What ``--threads 1`` sets in this process is as before in the end."""
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    threads = torch.get_num_threads()
    yield
    torch.set_num_threads(threads)


def wait_for(path, there=True):
    give_up = time.monotonic() + 300
    while path.exists() != there and time.monotonic() < give_up:
        time.sleep(0.01)


def interrupted(command, out, kill):
    """A training that has come further than before, killed; its return code and what it said."""
    history = out / "training" / "history.csv"
    before = history.read_bytes() if history.exists() else None
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    give_up = time.monotonic() + 300
    while time.monotonic() < give_up:
        if history.exists() and history.read_bytes() != before:
            break
        time.sleep(0.01)
    kill(process)
    return process.communicate(timeout=300)[1], process.returncode


@pytest.mark.parametrize("processes", [1, 2])
@pytest.mark.usefixtures("one_thread")
def test_a_training_killed_again_and_again_is_resumed_bit_for_bit(chain, tmp_path, processes):
    out, whole = tmp_path / "killed", tmp_path / "whole"
    arguments = training_arguments(chain, out, processes=processes)
    command = [*PYTHON, *arguments]
    started = []

    def kill_first(process):
        number = int((out / "training" / "lock.holder").read_text().split()[1])
        assert number != process.pid
        os.kill(number, signal.SIGKILL)

    if processes > 1:
        said, code = interrupted(command, out, kill_first)
        assert code == 1
        assert "Process 1 of 2 died (SIGKILL); run the same command again" in said
        started.append(said)
    for number in (signal.SIGTERM, signal.SIGKILL):
        said, code = interrupted(command, out, lambda process, n=number: process.send_signal(n))
        assert code == (1 if number == signal.SIGTERM else -number)
        assert ("run the same command again" in said) == (number == signal.SIGTERM)
        started.append(said)
        assert not (out / "model.safetensors").exists()
    started.append(dine(*arguments).output)
    went_on = ["going on from step" in said for said in started]
    assert went_on == [False] + [True] * (len(started) - 1)
    dine(*training_arguments(chain, whole, processes=processes))
    expected = (whole / "model.safetensors").read_bytes()
    assert (out / "model.safetensors").read_bytes() == expected
    assert read_json(whole / "run.json")["processes"] == processes


@pytest.mark.usefixtures("one_thread")
def test_an_orphan_holds_its_folder_until_it_ends(chain, tmp_path):
    out = tmp_path / "run"
    arguments = training_arguments(chain, out, steps=10**6)
    command = [*PYTHON, *arguments]
    parent = [sys.executable, "-c", "import subprocess, sys; subprocess.run(sys.argv[1:])"]
    started = subprocess.Popen([*parent, *command], stderr=subprocess.DEVNULL)
    wait_for(out / "training" / "state.pt")
    started.kill()  # as Snakemake may be; its training does not notice
    started.wait()
    holder = out / "training" / "lock.holder"
    number = int(holder.read_text().split()[1])
    try:
        said = f"is in use by process {number} on {platform.node()}; wait for it"
        with pytest.raises(DineError, match=re.escape(said)):
            dine(*arguments)
    finally:
        os.kill(number, signal.SIGTERM)
    wait_for(holder, there=False)
    state = torch.load(out / "training" / "state.pt", weights_only=True)
    assert len(state["history"]) == state["step"]
    again = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    wait_for(holder)
    again.terminate()
    assert f"going on from step {state['step']}" in again.communicate(timeout=300)[1]


def test_results_that_are_no_longer_asked_for_are_not_written(chain, tmp_path, monkeypatch):
    command = ("stage1", "--pairs", chain / "pairs.h5", "--out", tmp_path, "--settings")
    train = stages.train

    def disturbed(*arguments, **keywords):
        history = train(*arguments, **keywords)
        monkeypatch.setattr(stages, "train", train)
        with one_writer(arguments[1].folder, {}), pytest.raises(DineError, match="is in use by"):
            dine(*command, json.dumps(json.loads(STAGE1) | {"steps": 4}))
        return history

    monkeypatch.setattr(stages, "train", disturbed)
    with pytest.raises(DineError, match="asked for with other settings while it ran; nothing is"):
        dine(*command, STAGE1)
    assert not (tmp_path / "model.safetensors").exists()
    dine(*command, STAGE1)
    same = (chain / "stage1" / "model.safetensors").read_bytes()
    assert (tmp_path / "model.safetensors").read_bytes() == same


FLOW = {"kind": "flow", "arguments": {"steps": 100000, "hidden": 8, "transforms": 2}}


@pytest.mark.usefixtures("one_thread")
def test_the_fit_of_a_flow_is_a_training(chain, tmp_path):
    out, folder = tmp_path / "flow.safetensors", tmp_path / "training" / "flow"
    arguments = ["--threads", "1", "fit-prior", "--out", out]
    arguments += ["--fields", chain / "dvf.h5", "--settings", json.dumps(FLOW)]
    command = [*PYTHON, *arguments]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    wait_for(folder / "lock.holder")
    said = re.escape(f"{folder} is in use by process {process.pid} on")
    with pytest.raises(DineError, match=said):
        dine(*arguments)
    process.terminate()
    assert "flow prior was stopped after step" in process.communicate(timeout=300)[1]
    step = torch.load(folder / "state.pt", weights_only=True)["step"]
    assert not out.exists()
    again = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    wait_for(folder / "lock.holder")
    again.terminate()
    assert f"flow prior: going on from step {step}" in again.communicate(timeout=300)[1]


def test_a_flow_that_is_no_longer_asked_for_is_not_written(chain, tmp_path, monkeypatch):
    command = ("fit-prior", "--fields", chain / "dvf.h5", "--out", tmp_path / "flow.safetensors")
    settings = json.dumps(FLOW | {"arguments": FLOW["arguments"] | {"steps": 3}})
    fit = FlowPrior.fit

    def disturbed(*arguments, unfinished, **keywords):
        monkeypatch.setattr(FlowPrior, "fit", fit)
        prior = fit(*arguments, unfinished=unfinished, **keywords)
        with one_writer(unfinished.folder, {}), pytest.raises(DineError, match="is in use by"):
            dine(*command, "--settings", json.dumps(FLOW))
        return prior

    monkeypatch.setattr(FlowPrior, "fit", disturbed)
    with pytest.raises(DineError, match="flow prior is finished, but was asked for with other"):
        dine(*command, "--settings", settings)
    assert not (tmp_path / "flow.safetensors").exists()
    dine(*command, "--settings", settings)
    assert load_prior(tmp_path / "flow.safetensors").notes["samples"] == len(
        read_fields(chain / "dvf.h5").source
    )


@numerical
def test_predictions_and_metrics(chain, tmp_path):
    model, pairs = chain / "stage1" / "model.safetensors", chain / "pairs.h5"
    variant = ("--variant", chain / "outliers_25.h5")
    dine("predict", "--model", model, "--pairs", pairs, *variant, "--out", tmp_path / "p.h5")
    dine(
        *("evaluate", "--predictions", tmp_path / "p.h5", "--pairs", pairs, *variant),
        *("--dataset", "d", "--backbone", "robust_defreg", "--method", "stage1"),
        *("--point-errors", tmp_path / "e.h5", "--out", tmp_path / "m.csv"),
    )
    metrics = pd.read_csv(tmp_path / "m.csv")
    test = read_pairs(pairs, split="test")
    assert metrics["condition"].tolist() == ["deformation"] * 2 + ["outliers"] * 2
    assert (metrics["origin"] == "synthetic").all()
    observed = read_variant(chain / "outliers_25.h5", test).target
    with h5py.File(tmp_path / "p.h5") as file, h5py.File(tmp_path / "e.h5") as errors:
        for row, (key, index) in enumerate([("deformation", 0), ("outliers_25", 1)]):
            line = metrics.iloc[3 * row]
            moved = test.source[index] + file[key]["displacement"][index]
            clean = test.target[index]
            assert line["cd"] == pytest.approx(chamfer(moved, clean), rel=1e-4)
            error = np.linalg.norm(moved - clean, axis=1).mean()
            assert line["mce"] == pytest.approx(error, rel=1e-4)
            nearest = errors[key]["squared_distance"][index].mean()
            assert nearest == pytest.approx(
                np.mean([np.min(np.sum((clean - p) ** 2, axis=1)) for p in moved]), rel=1e-3
            )
        assert metrics.iloc[3]["cd_observed"] == pytest.approx(
            chamfer(moved, observed[1]), rel=1e-4
        )
    assert metrics.iloc[0]["cd_observed"] == metrics.iloc[0]["cd"]
    unregistered = chamfer(test.source[0], test.target[0])
    assert metrics.iloc[0]["cd_unregistered"] == pytest.approx(unregistered, rel=1e-4)


@numerical
def test_metrics_agree_with_the_training_loss():
    a = np.random.default_rng(0).random((30, 3))
    b = np.random.default_rng(1).random((40, 3))
    batch = make_batch([a], [b], dtype=torch.float64)
    loss = DATA_TERMS.get("chamfer")()(batch, torch.zeros(1, 30, 3), None)
    assert chamfer(a, b) == pytest.approx(loss.item(), rel=1e-9)


def damaged(path, tmp_path):
    copy = tmp_path / path.name
    data = path.read_bytes()
    copy.write_bytes(data[: len(data) // 2])
    return copy


def test_truncated_inputs_are_named(chain, tmp_path):
    model, pairs = chain / "stage1" / "model.safetensors", chain / "pairs.h5"
    with pytest.raises(DataError, match=r"pairs\.h5"):
        dine("stage1", "--pairs", damaged(pairs, tmp_path), "--out", tmp_path / "x")
    with pytest.raises(CheckpointError, match=r"model\.safetensors"):
        dine(
            *("fields", "--model", damaged(model, tmp_path), "--pairs", pairs),
            *("--out", tmp_path / "x.h5"),
        )
    with pytest.raises(DataError, match=r"dvf\.h5"):
        dine("fit-prior", "--fields", damaged(chain / "dvf.h5", tmp_path), "--out", tmp_path / "x")
    with pytest.raises(CheckpointError, match=r"pca\.safetensors"):
        load_prior(damaged(chain / "pca.safetensors", tmp_path))
    with pytest.raises(DataError, match=r"lambda\.json"):
        selected_lambda(damaged(chain / "lambda.json", tmp_path), "pca")
    with pytest.raises(DataError, match=r"not the result of `dine search-lambda`"):
        selected_lambda(chain / "raw.json", "pca")
    assert not (tmp_path / "x").exists()
    assert not (tmp_path / "x.h5").exists()


def test_missing_inputs_are_named(chain, tmp_path):
    model, pairs = chain / "stage1" / "model.safetensors", chain / "pairs.h5"
    none = tmp_path / "none"
    for error, arguments in (
        (DataError, ("stage1", "--pairs", none, "--out", tmp_path / "x")),
        (DataError, ("fields", "--model", model, "--pairs", none, "--out", tmp_path / "x")),
        (CheckpointError, ("fields", "--model", none, "--pairs", pairs, "--out", tmp_path / "x")),
        (DataError, ("fit-prior", "--fields", none, "--out", tmp_path / "x")),
        (DataError, ("pairs", "--raw", none, "--out", tmp_path / "x")),
        (DataError, ("tables", none, "--out", tmp_path / "x")),
    ):
        with pytest.raises(error, match=r"none"):
            dine(*arguments)
    assert not (tmp_path / "x").exists()


def test_a_prior_needs_a_weight_and_the_control_takes_none(chain, tmp_path):
    start = ("stage2", "--pairs", chain / "pairs.h5", "--out", tmp_path)
    model = ("--model", chain / "stage1" / "model.safetensors")
    with pytest.raises(ConfigError, match="--lambda is needed"):
        dine(*start, *model, "--prior", chain / "pca.safetensors", "--variant", "pca")
    prior = ("--prior", chain / "pca.safetensors", "--lambda", "1")
    with pytest.raises(ConfigError, match="'lambda0' takes no prior"):
        dine(*start, *model, *prior)


@numerical
def test_a_variant_may_differ_in_its_data_term_alone(chain, tmp_path):
    record, weights = run_stage2(
        chain,
        tmp_path,
        *(
            "--variant",
            "landau",
            "--settings",
            json.dumps(json.loads(STAGE2) | {"data_term": "landau"}),
        ),
    )
    assert record["variant"] == "landau"
    assert record["lambda"] == 0
    _, control = run_stage2(chain, tmp_path / "control")
    assert weights != control


@numerical
@pytest.mark.parametrize(
    ("fields", "same"), [("predicted", True), ("exact", False), ("shuffled", False)]
)
def test_what_a_prior_is_fitted_to(chain, tmp_path, fields, same):
    settings = {"kind": "pca", "arguments": {"components": 2}, "fields": fields}
    command = ("fit-prior", "--fields", chain / "dvf.h5", "--settings", json.dumps(settings))
    dine(*command, "--out", tmp_path / "p.safetensors")
    stored = read_fields(chain / "dvf.h5")
    mean = load_prior(tmp_path / "p.safetensors").mean.numpy().reshape(-1, 3)
    assert np.allclose(mean, stored.displacement.mean(axis=0), atol=1e-6) == same
    if fields == "exact":
        assert np.allclose(mean, stored.true.mean(axis=0), atol=1e-6)
    if fields == "shuffled":
        # The points of a field, in another order: the mean over all of them stays.
        assert np.allclose(mean.mean(axis=0), stored.displacement.mean(axis=(0, 1)), atol=1e-6)


@numerical
def test_training_can_start_from_given_weights(chain, tmp_path):
    start = chain / "stage1" / "model.safetensors"
    settings = json.loads(STAGE1) | {"start": str(start), "steps": 1}
    dine(
        "stage1",
        "--pairs",
        chain / "pairs.h5",
        "--settings",
        json.dumps(settings),
        "--out",
        tmp_path,
    )
    first = pd.read_csv(tmp_path / "history.csv")["loss"][0]
    random = pd.read_csv(chain / "stage1" / "history.csv")["loss"][0]
    assert first != random
    with pytest.raises(CheckpointError, match="asks for deftransnet"):
        dine(
            *("stage1", "--pairs", chain / "pairs.h5", "--settings", json.dumps(settings)),
            *("--backbone", '{"kind": "deftransnet"}', "--out", tmp_path / "other"),
        )


@pytest.mark.parametrize("kind", ["robust_defreg", "deftransnet"])
def test_shipped_weights_load(kind):
    backbone = stages.starting_backbone(kind, {}, "pretrained", seed=0)
    assert backbone.registered_name == kind


def test_a_folder_of_undeformed_meshes_becomes_a_dataset(chain, tmp_path):
    meshes = tmp_path / "scans with spaces"
    shutil.copytree(chain / "raw" / "Data", meshes)
    (meshes / "broken.ply").write_bytes(b"ply\nformat ascii 1.0\nelement vertex 3\n")
    dataset = config.validate_section(
        config.Dataset,
        {
            "source": {"kind": "path", "folder": str(meshes)},
            "recipe": {"levels": [0.3]},
            "pairs": {"points": 64},
        },
        "test",
    )
    obtain(dataset, tmp_path / "out", seed=0)
    facts = read_json(tmp_path / "out" / "raw.json")
    assert facts["origin"] == "bases"
    inventory = pd.read_csv(tmp_path / "out" / "inventory.csv")
    assert inventory["pairs"].tolist() == [4]
    assert "broken" in (tmp_path / "out" / "raw" / "provenance.json").read_text()


def test_deformations_by_finite_elements_become_a_dataset(tmp_path):
    """Of closed meshes only; the same body and loads at every level stay in one split."""
    meshes = tmp_path / "scans"
    closed = primitive(0, 0)
    write_surface(meshes / "closed.ply", closed)
    write_surface(meshes / "open.ply", Surface(closed.vertices, closed.faces[1:]))
    recipe = {"kind": "elastic", "levels": [0.02, 0.1], "pairs_per_level": 3}
    settings = {
        "source": {"kind": "path", "folder": str(meshes)},
        "recipe": recipe | {"elastic": {"edge": 0.4}},
    }
    dine("raw", "--settings", json.dumps(settings), "--out", tmp_path / "out")
    made = read_json(tmp_path / "out" / "raw" / "provenance.json")
    assert made["objects"] == {"closed": "closed"}
    assert "is not closed and so has no inside" in made["left_out"]["open"]
    assert "finite elements" in (tmp_path / "out" / "raw" / "README.txt").read_text()
    shares = {"by": "deformation", "train": 0.4, "val": 0.3, "test": 0.3}
    dine(
        *("pairs", "--raw", tmp_path / "out" / "raw.json", "--out", tmp_path / "pairs.h5"),
        *("--settings", json.dumps({"points": 64, "split": shares})),
    )
    pairs = read_pairs(tmp_path / "pairs.h5")
    assert pairs.known.all()
    assert len(pairs) == 6
    fields = dict(zip(pairs.name.tolist(), pairs.displacement, strict=True))
    parts = dict(zip(pairs.name.tolist(), pairs.split.tolist(), strict=True))
    for number in range(3):
        small, large = (f"{level}/closed_{number}_0" for level in (0.02, 0.1))
        assert parts[small] == parts[large]
        size = [np.linalg.norm(fields[name], axis=1).mean() for name in (small, large)]
        assert size[0] == pytest.approx(0.02, rel=0.3)
        assert size[0] < size[1] < 0.15
        both = (fields[small] * fields[large]).sum()
        norms = np.linalg.norm(fields[small]) * np.linalg.norm(fields[large])
        assert both / norms > 0.8


def test_a_folder_in_the_published_layout_is_used_as_it_is(chain, tmp_path):
    dataset = config.Dataset(source={"kind": "path", "folder": str(chain / "raw")})
    obtain(dataset, tmp_path, seed=0)
    facts = read_json(tmp_path / "raw.json")
    assert (facts["folder"], facts["origin"]) == (str(chain / "raw"), "path")
    listed = dine("inspect", chain / "raw").output
    assert "deformation" in listed
    assert "0.5" in listed
    assert "left out" in listed


def test_pairs_are_of_the_files_that_were_found_and_of_no_others(chain, tmp_path):
    """What changed in a folder after its files were listed is not taken for what was listed."""
    scans = shutil.copytree(chain / "raw", tmp_path / "scans")
    source = json.dumps({"source": {"kind": "path", "folder": str(scans)}})
    dine("raw", "--settings", source, "--out", tmp_path)
    arguments = ("pairs", "--raw", tmp_path / "raw.json", "--out", tmp_path / "pairs.h5")
    target = next(scans.rglob("Target_*"))
    target.rename(tmp_path / "kept.ply")
    with pytest.raises(DataError, match=r"holds other files than .* run the step `raw` again"):
        dine(*arguments, "--settings", '{"points": 64}')
    assert not (tmp_path / "pairs.h5").exists()
    (tmp_path / "kept.ply").rename(target)
    dine(*arguments, "--settings", '{"points": 64}')


def test_main_prints_one_line_for_a_users_error(capsys, monkeypatch, tmp_path):
    monkeypatch.setattr("sys.argv", ["dine", "inspect", str(tmp_path / "none")])
    with pytest.raises(SystemExit) as exit_:
        cli.main()
    assert exit_.value.code == 1
    error = capsys.readouterr().err
    assert "Error:" in error
    assert "Traceback" not in error
    assert len(error.strip().splitlines()) == 1


def test_settings_from_a_file_and_bad_settings(chain, tmp_path):
    (tmp_path / "s.yaml").write_text("steps: 1\nvalidate_every: 1\nvalidation_pairs: 1\n")
    out = tmp_path / "run"
    dine("stage1", "--pairs", chain / "pairs.h5", "--settings", f"@{tmp_path}/s.yaml", "--out", out)
    assert read_json(out / "run.json")["settings"]["steps"] == 1
    with pytest.raises(ConfigError, match="`stps` is not a known key"):
        dine("stage1", "--pairs", chain / "pairs.h5", "--settings", '{"stps": 1}', "--out", out)
    with pytest.raises(ConfigError, match="neither JSON nor @FILE"):
        dine("stage1", "--pairs", chain / "pairs.h5", "--settings", "steps=1", "--out", out)


@pytest.fixture(scope="module")
def resampled(chain):
    out = chain / "resampled.h5"
    dine("resample", "--raw", chain / "raw.json", "--pairs", chain / "pairs.h5", "--out", out)
    return out


@numerical
def test_resampled_targets_lie_on_the_target_but_share_no_point(chain, resampled):
    pairs = read_pairs(chain / "pairs.h5")
    found = read_variant(resampled, pairs)
    assert found.condition == "resampled"
    for row in range(len(pairs)):
        table = np.linalg.norm(found.target[row][:, None] - pairs.target[row][None], axis=2)
        assert table.min() > 1e-6
        # Within the spacing of 64 points on the same surface.
        assert np.median(table.min(axis=1)) < 0.3
    again = chain / "again.h5"
    dine("resample", "--raw", chain / "raw.json", "--pairs", chain / "pairs.h5", "--out", again)
    assert again.read_bytes() == resampled.read_bytes()


@numerical
def test_pretraining_sees_both_kinds_of_targets(chain, resampled, tmp_path):
    settings = '{"steps": 3, "validate_every": 3, "validation_pairs": 1}'
    both = tmp_path / "both"
    pairs = ("--pairs", chain / "pairs.h5")
    arguments = ("pretrain", *pairs, "--settings", settings)
    dine(*arguments, "--targets", resampled, "--out", both)
    dine(*arguments, "--out", tmp_path / "own")
    record = read_json(both / "run.json")
    own = read_json(tmp_path / "own" / "run.json")
    assert record["train_pairs"] == 2 * own["train_pairs"]
    assert record["inputs"]["targets"]
    assert record["final"]["val_mce"] != own["final"]["val_mce"]
    with pytest.raises(ConfigError, match="one for each"):
        dine(*arguments, *pairs, "--targets", resampled, "--out", tmp_path / "x")


@numerical
def test_fields_of_resampled_targets_differ(chain, resampled, tmp_path):
    model = ("--model", chain / "stage1" / "model.safetensors", "--pairs", chain / "pairs.h5")
    dine("fields", *model, "--targets", resampled, "--out", tmp_path / "dvf.h5")
    other, own = (read_fields(x / "dvf.h5").displacement for x in (tmp_path, chain))
    assert (other != own).any()


@numerical
def test_a_prior_is_fitted_to_several_files_of_fields(chain, tmp_path):
    fields = ("--fields", chain / "dvf.h5") * 2
    settings = '{"kind": "pca", "arguments": {"components": 2}}'
    dine("fit-prior", *fields, "--settings", settings, "--out", tmp_path / "p.safetensors")
    one = load_prior(chain / "pca.safetensors")
    two = load_prior(tmp_path / "p.safetensors")
    assert two.notes["samples"] == 2 * one.notes["samples"]
    assert (one.mean - two.mean).abs().max() < 1e-6


def test_targets_of_other_pairs_are_refused(chain, resampled, tmp_path):
    other = tmp_path / "other.h5"
    pairs = read_pairs(chain / "pairs.h5").select("train")
    write_pairs(other, pairs)
    with pytest.raises(DataError, match="made from other pairs"):
        read_seen([other], [resampled], "train")


def test_calibration_on_the_meshes_that_pairs_were_drawn_on(chain, tmp_path):
    resampled = tmp_path / "resampled.h5"
    data = ("--pairs", chain / "pairs.h5")
    raw = ("--raw", chain / "raw.json")
    dine("resample", *raw, *data, "--out", resampled)
    model = ("--model", chain / "stage1" / "model.safetensors")
    command = ("calibrate", *model, *data, "--targets", resampled, *raw)
    dine(*command, "--out", tmp_path / "c.json")
    facts = read_json(tmp_path / "c.json")["facts"]
    assert facts["surfaces"]
    assert facts["test_mean_error"] < 0.05


def test_calibration_refuses_raw_files_that_fit_no_pairs(chain, tmp_path):
    model = ("--model", chain / "stage1" / "model.safetensors", "--out", tmp_path / "c.json")
    resampled = tmp_path / "resampled.h5"
    data = ("--pairs", chain / "pairs.h5")
    dine("resample", "--raw", chain / "raw.json", *data, "--out", resampled)
    raws = ("--raw", chain / "raw.json") * 3
    both = (*data, *data, "--targets", resampled, "--targets", resampled)
    with pytest.raises(ConfigError, match="3 raw datasets for 2 files of pairs"):
        dine("calibrate", *model, *both, *raws)
    with pytest.raises(DataError, match="hold the same points"):
        dine("calibrate", *model, *data)
    assert not (tmp_path / "c.json").exists()
