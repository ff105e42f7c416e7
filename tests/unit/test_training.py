"""Training resumes bit for bit, and never from a state that is not its own."""

import dataclasses
import math
import os
import signal
import threading

import numpy as np
import pytest
import torch

from dine.config import Stage1, Training
from dine.data.loading import Batches
from dine.data.pairs import PairSet
from dine.errors import ConfigError, DataError, DineError
from dine.models.backbones import Backbone, Registration
from dine.models.devices import chosen_device
from dine.priors import PRIORS
from dine.state import Interrupted, one_writer
from dine.training import loop
from dine.training.data_terms import DATA_TERMS
from dine.training.objective import Objective
from dine.training.stages import new_backbone

pytestmark = pytest.mark.numerical
IDENTITY = {"settings": "a", "inputs": "b", "code": "c"}
SETTINGS = Training(steps=6, validate_every=3, validation_pairs=2, save_seconds=1e-9)


def toy_pairs(count=5, points=40, seed=0):
    rng = np.random.default_rng(seed)
    source = rng.normal(size=(count, points, 3)).astype(np.float32)
    source /= np.linalg.norm(source, axis=2, keepdims=True)
    target = source * np.array([1.1, 0.9, 1.0], np.float32)
    columns = {
        "center": np.zeros((count, 3)),
        "scale": np.ones(count),
        "level": np.full(count, 0.1),
        "name": np.array([f"p{i}" for i in range(count)]),
        "object": np.array([f"o{i}" for i in range(count)]),
        "split": np.full(count, "train"),
        "source_file": np.full(count, "s"),
        "target_file": np.full(count, "t"),
        "vertex_index": np.zeros((count, points, 3), np.int32),
        "vertex_weight": np.full((count, points, 3), 1 / 3),
    }
    return PairSet(source=source, target=target, **columns, attributes={})


def job(folder, objective=None, settings=SETTINGS, seed=0, identity=IDENTITY):
    objective = objective or Objective(DATA_TERMS.get("chamfer")())
    return loop.TrainingJob(objective, settings, seed, folder, identity, "toy")


def run(folder, *, steps=6, identity=IDENTITY, on_step=None, objective=None, settings=SETTINGS):
    # PyTorch's own initial weights leave something to learn even on toy pairs.
    arguments = {"candidates": 16, "initialisation": "default"}
    backbone = new_backbone("robust_defreg", arguments, seed=0)
    history = loop.train(
        backbone,
        job(folder, objective, settings.model_copy(update={"steps": steps}), 7, identity),
        loop.Seen(toy_pairs()),
        loop.Seen(toy_pairs(3, seed=1)),
        device="cpu",
        on_step=on_step,
    )
    return backbone.state_dict(), history


def same(first, second):
    return all(torch.equal(first[key], second[key]) for key in first)


def without_time(history):
    return [{k: v for k, v in row.items() if k != "seconds"} for row in history]


class Shift(Backbone):
    """Moves every point alike: what it should learn is plain."""

    def __init__(self):
        super().__init__()
        self.shift = torch.nn.Parameter(torch.zeros(3))

    def forward(self, batch):
        return Registration(self.shift.expand_as(batch.source), None, None)


class Noisy(Shift):
    """Draws from torch's own generator, as dropout does."""

    def forward(self, batch):
        return Registration(self.shift + 0.1 * torch.randn(batch.source.shape), None, None)


class Killed(BaseException):
    pass


@pytest.mark.parametrize("at", [0, 2, 5])
def test_a_killed_run_ends_where_an_undisturbed_one_does(tmp_path, at):
    expected, history = run(tmp_path / "whole")

    def kill(step):
        if step == at:
            raise Killed

    with pytest.raises(Killed):
        run(tmp_path / "killed", on_step=kill)
    steps = []
    weights, resumed = run(tmp_path / "killed", on_step=steps.append)
    assert same(weights, expected)
    assert without_time(resumed) == without_time(history)
    # Work done before the last save is not done again.
    assert len(steps) == 6 - at


def test_a_backbone_that_draws_random_numbers_is_resumed_bit_for_bit(tmp_path):
    def shift(folder, at=None):
        def kill(step):
            if step == at:
                raise Killed

        before = torch.random.get_rng_state()
        backbone = Noisy()
        loop.train(
            backbone,
            job(folder),
            loop.Seen(toy_pairs()),
            loop.Seen(toy_pairs(1)),
            device="cpu",
            on_step=kill,
        )
        assert torch.equal(torch.random.get_rng_state(), before)
        return backbone.shift.tolist()

    expected = shift(tmp_path / "whole")
    with pytest.raises(Killed):
        shift(tmp_path / "killed", at=2)
    torch.rand(5)
    assert shift(tmp_path / "killed") == expected


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_signals_save_and_stop(tmp_path, number):
    expected, _ = run(tmp_path / "whole")
    lazy = SETTINGS.model_copy(update={"save_seconds": 1e9})
    with pytest.raises(Interrupted, match=r"stopped after step 3 of 6; run the same command again"):
        run(
            tmp_path / "stopped",
            on_step=lambda step: os.kill(os.getpid(), number) if step == 2 else None,
            settings=lazy,
        )
    steps = []
    weights, _ = run(tmp_path / "stopped", on_step=steps.append, settings=lazy)
    assert steps == [3, 4, 5]
    assert same(weights, expected)


def test_a_finished_run_is_not_trained_again(tmp_path):
    expected, _ = run(tmp_path)
    steps = []
    weights, _ = run(tmp_path, on_step=steps.append)
    assert steps == []
    assert same(weights, expected)


def scripted(monkeypatch, errors):
    """Validations that find these errors, one after the other."""
    found = iter(errors)
    monkeypatch.setattr(loop, "validation_errors", lambda *_: {"val_cd": next(found)})


BEST = SETTINGS.model_copy(update={"validate_every": 2, "schedule": "constant", "keep": "best"})


@pytest.mark.parametrize(
    ("errors", "kept"),
    [
        *(([3, 2, 1, 1], 4), ([3, 1, 2, 2], 2), ([1, 2, 3, 2], 0), ([3, 2, 2, 1], 6)),
        ([3, 1, math.nan, 2], 2),
    ],
)
def test_the_best_weights_are_kept_those_of_the_start_among_them(
    tmp_path, monkeypatch, errors, kept
):
    scripted(monkeypatch, errors)
    found, history = run(tmp_path / "best", settings=BEST)
    assert history[-1]["kept_step"] == kept
    assert [row["val_cd"] for row in history if "val_cd" in row] == pytest.approx(
        errors[1:], nan_ok=True
    )
    if kept:
        monkeypatch.undo()
        expected, shorter = run(
            tmp_path / "shorter", steps=kept, settings=BEST.model_copy(update={"keep": "last"})
        )
        assert "kept_step" not in shorter[-1]
    else:
        arguments = {"candidates": 16, "initialisation": "default"}
        expected = new_backbone("robust_defreg", arguments, seed=0).state_dict()
    assert same(found, expected)
    # Found finished, it is what it was.
    again, _ = run(tmp_path / "best", settings=BEST)
    assert same(again, expected)


@pytest.mark.parametrize("at", [0, 1, 4])
def test_the_best_weights_survive_a_kill(tmp_path, monkeypatch, at):
    def kill(step):
        if step == at:
            raise Killed

    scripted(monkeypatch, [3, 1, 2, 2])
    expected, _ = run(tmp_path / "whole", settings=BEST)
    errors = {0: 3, 2: 1, 4: 2, 6: 2}
    done = [step for step in errors if step <= at] if at else []  # at 0 nothing is saved yet
    scripted(monkeypatch, errors.values())
    with pytest.raises(Killed):
        run(tmp_path / "killed", on_step=kill, settings=BEST)
    scripted(monkeypatch, [error for step, error in errors.items() if step not in done])
    found, history = run(tmp_path / "killed", settings=BEST)
    assert history[-1]["kept_step"] == 2
    assert same(found, expected)


@pytest.mark.parametrize("key", IDENTITY)
def test_a_state_of_another_run_is_not_used(tmp_path, key, caplog):
    run(tmp_path, steps=3)
    steps = []
    with caplog.at_level("INFO"):
        run(tmp_path, identity={**IDENTITY, key: "other"}, on_step=steps.append)
    assert steps[0] == 0
    assert f"made with other {key}" in caplog.text


def test_a_damaged_state_is_not_used(tmp_path, caplog):
    run(tmp_path, steps=3)
    state = tmp_path / "state.pt"
    state.write_bytes(state.read_bytes()[:1000])
    steps = []
    with caplog.at_level("INFO"):
        run(tmp_path, on_step=steps.append)
    assert steps[0] == 0
    assert "damaged" in caplog.text


def test_a_second_writer_is_refused(tmp_path):
    release, held = threading.Event(), threading.Event()

    def hold():
        with one_writer(tmp_path, IDENTITY):
            held.set()
            release.wait(10)

    thread = threading.Thread(target=hold)
    thread.start()
    held.wait(10)
    try:
        with pytest.raises(DineError, match=f"in use by process {os.getpid()}"):
            run(tmp_path)
    finally:
        release.set()
        thread.join()
    run(tmp_path, steps=1)


def test_training_lowers_the_loss(tmp_path):
    pairs = toy_pairs()
    changes = {"steps": 60, "learning_rate": 1e-2}
    history = loop.train(
        Shift(),
        job(tmp_path, Objective(DATA_TERMS.get("l1")()), SETTINGS.model_copy(update=changes)),
        loop.Seen(dataclasses.replace(pairs, target=pairs.source + np.float32([0.2, -0.1, 0.3]))),
        loop.Seen(toy_pairs(1)),
        device="cpu",
    )
    assert history[-1]["loss"] < 0.1 * history[0]["loss"]


def test_history_has_every_step_and_the_validations(tmp_path):
    _, history = run(tmp_path)
    assert [row["step"] for row in history] == [1, 2, 3, 4, 5, 6]
    assert [row["step"] for row in history if "val_cd" in row] == [3, 6]
    text = (tmp_path / "history.csv").read_text().splitlines()
    assert text[0].split(",")[:3] == ["step", "loss", "data"]
    assert len(text) == 7


class Exploding:
    def __call__(self, batch, displacement, truth):
        return displacement.sum(dim=(1, 2)) * torch.nan


def test_divergence_is_an_error_and_keeps_the_last_good_state(tmp_path):
    run(tmp_path, steps=3)
    with pytest.raises(DineError, match="diverged at step 3"):
        run(tmp_path, objective=Objective(Exploding()))
    assert torch.load(tmp_path / "state.pt", weights_only=True)["step"] == 3


def test_empty_splits_are_refused(tmp_path):
    empty = toy_pairs().select(split="val")
    with pytest.raises(DataError, match="no validation pairs"):
        loop.train(
            new_backbone("robust_defreg", {}, seed=0),
            job(tmp_path),
            loop.Seen(toy_pairs()),
            loop.Seen(empty),
        )


def test_every_epoch_visits_every_pair_once_in_another_order():
    seen = np.concatenate([loop.order_of(step, 3, 7, seed=1) for step in range(14)])
    epochs = seen.reshape(6, 7)
    assert (np.sort(epochs, axis=1) == np.arange(7)).all()
    assert len({tuple(epoch) for epoch in epochs}) == 6


def test_cosine_schedule_falls_to_a_hundredth():
    settings = Stage1(steps=100, learning_rate=1.0, schedule="cosine")
    assert loop.learning_rate(settings, 0) == 1
    assert loop.learning_rate(settings, 99) == pytest.approx(0.01, abs=1e-3)


def test_validation_pairs_are_spread():
    assert loop.spread(10, 4).tolist() == [0, 3, 6, 9]
    assert loop.spread(3, 10).tolist() == [0, 1, 2]


def test_objective_adds_lambda_times_the_penalty():
    pairs = toy_pairs()
    batch, truth = Batches(pairs, torch.device("cpu")).get(np.arange(2))
    prior = PRIORS.get("pca").fit(pairs.displacement, components=2)
    term = DATA_TERMS.get("chamfer")()
    field = 1.5 * truth
    plain, *_ = Objective(term)(batch, field, truth)
    loss, *parts = Objective(term, prior, 0.01)(batch, field, truth)
    penalty = prior.penalty(field).mean()
    assert loss.item() == pytest.approx((plain + 0.01 * penalty).item(), rel=1e-6)
    assert parts == [plain, penalty]
    # λ = 0 is exactly the data term, whatever the prior says.
    assert Objective(term, prior, 0.0)(batch, field, truth)[0].item() == plain.item()


def test_l1_needs_the_truth():
    pairs = toy_pairs()
    batch, truth = Batches(pairs, torch.device("cpu")).get(np.arange(2))
    term = DATA_TERMS.get("l1")()
    assert term(batch, truth + 0.5, truth) == pytest.approx([0.5, 0.5])
    with pytest.raises(ConfigError, match="true displacement"):
        term(batch, truth, None)


def test_cuda_where_there_is_none():
    if torch.cuda.is_available():
        pytest.skip("this machine has a CUDA device")
    with pytest.raises(DineError, match="no CUDA device"):
        chosen_device("cuda")


def test_the_learning_rate_rises_at_first():
    settings = SETTINGS.model_copy(update={"steps": 100, "warmup": 9})
    rates = [loop.learning_rate(settings, step) for step in range(100)]
    plain = [loop.learning_rate(SETTINGS.model_copy(update={"steps": 100}), n) for n in range(100)]
    assert rates[0] == pytest.approx(plain[0] / 10)
    assert rates[:9] == sorted(rates[:9])
    assert rates[9:] == plain[9:]
    assert rates[9:] == sorted(rates[9:], reverse=True)
