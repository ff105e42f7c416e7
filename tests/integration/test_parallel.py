"""Several processes train as one does, and stop together."""

import contextlib
import multiprocessing
import os
import subprocess
import sys
import time

import numpy as np
import pytest
import torch
from test_training import IDENTITY, SETTINGS, Exploding, job, toy_pairs

from dine.errors import ConfigError, DineError
from dine.models.backbones import Backbone, Registration
from dine.state import Interrupted, load_state, one_writer
from dine.training import loop, parallel
from dine.training.objective import Objective

pytestmark = pytest.mark.numerical
ROUNDING = 1e-5
"""Of what was learned: float32 gradients agree to some 1e-7, and Adam's steps are their ratios."""


@pytest.fixture(autouse=True, scope="module")
def forks():
    """Processes start as forks of one that has imported all that they need, which takes most of the
    time else. Those of a command, in test_stages.py, start as they do for users."""
    kernels = [f"dine.models.compiled.{name}" for name in ("convolution", "messages", "selection")]
    preloaded = ["dine.training.stages", "lightning_fabric", "pytest", "torch._dynamo", "zuko"]
    multiprocessing.get_context("forkserver").set_forkserver_preload([*preloaded, *kernels])
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(parallel, "START", "forkserver")
        yield


class Mover(Backbone):
    """Small and smooth, so that rounding stays rounding: no choice of candidates can flip."""

    def __init__(self):
        super().__init__()
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(0)
            self.layers = torch.nn.Sequential(
                torch.nn.Linear(3, 8), torch.nn.Tanh(), torch.nn.Linear(8, 3)
            )

    def forward(self, batch):
        return Registration(self.layers(batch.source), None, None)


def run(folder, processes, *, steps=8, objective=None, on_step=None, batch_size=4):
    changes = {"steps": steps, "batch_size": batch_size, "learning_rate": 1e-2}
    backbone = Mover()
    history = loop.train(
        backbone,
        job(folder, objective, SETTINGS.model_copy(update=changes), 7),
        loop.Seen(toy_pairs()),
        loop.Seen(toy_pairs(3, seed=1)),
        device="cpu",
        processes=processes,
        on_step=on_step,
    )
    return backbone.state_dict(), history


def difference(first, second):
    return max((first[key] - second[key]).abs().max().item() for key in first)


@pytest.fixture(scope="module")
def alone(tmp_path_factory):
    return run(tmp_path_factory.mktemp("alone"), 1)


def stop_at_four(step):
    if step == 3:
        raise Interrupted("enough")


def test_two_processes_train_as_one_does(alone, tmp_path, caplog):
    with caplog.at_level("INFO"):
        weights, history = run(tmp_path, 2)
    assert difference(weights, alone[0]) < ROUNDING * difference(Mover().state_dict(), alone[0])
    for ours, theirs in zip(history, alone[1], strict=True):
        assert ours.keys() == theirs.keys()
        for key in ours.keys() - {"seconds"}:
            assert ours[key] == pytest.approx(theirs[key], rel=1e-4), key
    # What the leader logs comes out here, once.
    assert caplog.text.count("starting from the beginning") == 1


@pytest.mark.parametrize(("before", "after"), [(2, 1), (1, 2)])
def test_another_number_of_processes_goes_on_from_the_state(alone, tmp_path, before, after):
    with pytest.raises(DineError, match="enough"):
        run(tmp_path, before, on_step=stop_at_four)
    weights, history = run(tmp_path, after)
    assert difference(weights, alone[0]) < ROUNDING * difference(Mover().state_dict(), alone[0])
    assert [row["step"] for row in history] == list(range(1, 9))


ON_A_NODE = """
import pathlib, sys, test_parallel
test_parallel.run(pathlib.Path(sys.argv[1]), 2, steps=int(sys.argv[2]))
"""


def slurm(monkeypatch, **facts):
    """The variables of a step that `srun` has started."""
    found = {"STEP_NUM_NODES": 2, "STEP_NUM_TASKS": 2, "STEP_NODELIST": "gpu[07-09],x", "NODEID": 0}
    for name, value in (found | {"JOB_ID": 8001} | facts).items():
        monkeypatch.setenv(f"SLURM_{name}", str(value))


@contextlib.contextmanager
def two_nodes(folder, monkeypatch, steps):
    """A training on two nodes, which are both this machine."""
    monkeypatch.setenv("MASTER_ADDR", "127.0.0.1")
    monkeypatch.setenv("MASTER_PORT", str(parallel._free_port()))
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([os.path.dirname(__file__), *sys.path]))
    command = [sys.executable, "-c", ON_A_NODE, str(folder), str(steps)]
    nodes = []
    for number in range(2):
        slurm(monkeypatch, NODEID=number)
        nodes.append(subprocess.Popen(command, stderr=subprocess.PIPE, text=True))
    try:
        yield nodes
    finally:
        for node in nodes:
            node.kill()
            node.wait()


def test_two_nodes_train_as_one_process_does(alone, tmp_path, monkeypatch):
    with two_nodes(tmp_path, monkeypatch, steps=8) as nodes:
        said = [node.communicate(timeout=300)[1] for node in nodes]
    assert [node.returncode for node in nodes] == [0, 0], said
    state, _ = load_state(tmp_path / loop.STATE, IDENTITY)
    scale = difference(Mover().state_dict(), alone[0])
    assert difference(state["model"], alone[0]) < ROUNDING * scale
    assert [row["step"] for row in state["history"]] == list(range(1, 9))


def test_a_node_that_is_asked_to_stop_stops_all(tmp_path, monkeypatch):
    with two_nodes(tmp_path, monkeypatch, steps=10**6) as nodes:
        give_up = time.monotonic() + 300
        while not (tmp_path / "lock.holder").exists() and time.monotonic() < give_up:
            time.sleep(0.05)
        nodes[1].terminate()  # not that of the leader
        said = [node.communicate(timeout=300)[1] for node in nodes]
    assert [node.returncode for node in nodes] == [1, 1]
    assert "run the same command again to go on from there" in said[0]
    state, _ = load_state(tmp_path / loop.STATE, IDENTITY)
    assert [row["step"] for row in state["history"]] == list(range(1, state["step"] + 1))


def test_nodes_as_slurm_tells_them(monkeypatch):
    for name in ("MASTER_ADDR", "MASTER_PORT", "SLURM_STEP_NUM_NODES"):
        monkeypatch.delenv(name, raising=False)
    assert parallel.nodes_here() == (1, 0, "127.0.0.1", None)
    slurm(monkeypatch, NODEID=1)
    first, second = parallel.nodes_here(), parallel.nodes_here()
    assert first[:3] == (2, 1, "gpu07")
    # The next training of the same command does not meet the last one's processes.
    assert second.port == first.port + 1
    slurm(monkeypatch, STEP_NUM_NODES=1)
    assert parallel.nodes_here().count == 1


@pytest.mark.parametrize(
    ("nodes", "first"),
    [("gpu[07-09,12]", "gpu07"), ("a1,b2", "a1"), ("n[3,5]", "n3"), ("alone", "alone")],
)
def test_the_first_host_of_a_list(nodes, first):
    assert parallel.first_host(nodes) == first


def test_nodes_that_cannot_share(monkeypatch):
    slurm(monkeypatch, STEP_NUM_TASKS=8)
    with pytest.raises(ConfigError, match="started 8 tasks on 2 nodes"):
        parallel.run_together(2, torch.device("cpu"), print)
    slurm(monkeypatch)
    with pytest.raises(ConfigError, match="`processes` is 3, which 2 nodes cannot share"):
        parallel.run_together(3, torch.device("cpu"), print)


def test_errors_of_the_processes_are_the_users(tmp_path):
    with pytest.raises(DineError, match="diverged at step 0"):
        run(tmp_path, 2, objective=Objective(Exploding()))
    ours = f"in use by process {os.getpid()}"
    with one_writer(tmp_path, IDENTITY), pytest.raises(DineError, match=ours):
        run(tmp_path, 2)


def test_a_batch_is_shared_equally(tmp_path):
    with pytest.raises(ConfigError, match=r"`batch_size` is 3, which 2 processes cannot share"):
        run(tmp_path, 2, batch_size=3)


@pytest.mark.parametrize("size", [1, 2, 3])
def test_shares_make_up_the_batch(size):
    class Team:
        pass

    parts = []
    for rank in range(size):
        team = Team()
        team.rank, team.size = rank, size
        parts.append(loop.share_of(team, step=5, batch_size=6, count=7, seed=3))
    indices = np.concatenate([indices for indices, _ in parts])
    assert indices.tolist() == loop.order_of(5, 6, 7, 3).tolist()
    assert [key for _, keys in parts for key in keys] == [(3, 1, 5, p) for p in range(6)]


def test_more_processes_than_devices(monkeypatch):
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 1)
    with pytest.raises(ConfigError, match="number of CUDA devices here is 1"):
        parallel.run_together(2, torch.device("cuda"), print)


def test_fabric_is_asked_for_by_name(monkeypatch):
    monkeypatch.setattr(parallel.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(ConfigError, match=r'pip install "dine-registration\[parallel\]"'):
        parallel.run_together(2, torch.device("cpu"), print)


def test_one_process_needs_none_of_it():
    code = "import sys, dine.training.stages; sys.exit('lightning_fabric' in sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True)
