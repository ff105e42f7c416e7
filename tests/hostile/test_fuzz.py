"""Damaged and hostile files: a few hundred of every kind's; ``make fuzz`` tries thousands."""

import os
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("resource", reason="limits of memory need a Unix")
from fuzz.mutations import BYTES, mutated
from fuzz.runner import jobs, run
from fuzz.targets import TARGETS

INPUTS = int(os.environ.get("DINE_FUZZ_INPUTS", "450"))
SEED = int(os.environ.get("DINE_FUZZ_SEED", "1"))


@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="needs /proc")
def test_no_reader_is_fooled(tmp_path):
    failures = list(run(jobs(INPUTS), SEED, tmp_path))
    assert not failures, "\n".join(map(str, failures))


def test_equal_seeds_give_equal_inputs():
    ply = TARGETS["ply"]
    first, again, other = (ply.input(seed, 40) for seed in (1, 1, 2))
    assert first == again != other
    assert ply.input(1, 0) == ply.valid[0]
    rng = np.random.default_rng(0)
    assert len({mutated(ply.valid[0], BYTES, rng) for _ in range(20)}) > 15


def test_the_runner_notices_everything(tmp_path, monkeypatch):
    """Readers with every fault there is."""
    (tmp_path / "faulty.py").write_text(FAULTY)
    monkeypatch.syspath_prepend(tmp_path)
    faults = {
        "none": None,
        "refuses": None,
        "error": "KeyError: 'x' (faulty.py",
        "wrong": "AssertionError",
        "memory": "takes more than 256 MB",
        "crash": "died (3)",
        "hang": "no answer within 2 s",
        "strict": "a valid file is refused",
        "none again": None,
    }
    work = [(name, 0 if name == "strict" else 1) for name in faults]
    found = {f.target: f for f in run(work, 0, tmp_path / "saved", module="faulty", seconds=2)}
    assert set(found) == {name for name, problem in faults.items() if problem}
    for name, failure in found.items():
        assert failure.problem.startswith(faults[name])
        assert failure.saved.read_bytes() == (b"valid" if name == "strict" else b"mutated")


FAULTY = """
import os
import numpy as np
from dine.errors import DataError
from fuzz.target import Target

def refuses(*causes):
    raise DataError("it is damaged") from (causes[0] if causes else None)

def memory():
    try:
        np.ones(1 << 30)
    except MemoryError as error:
        refuses(error)

def wrong():
    assert False

def hang():
    while True:
        pass

FAULTS = {
    "none": lambda: None,
    "refuses": refuses,
    "error": lambda: {}["x"],
    "wrong": wrong,
    "memory": memory,
    "crash": lambda: os._exit(3),
    "hang": hang,
    "strict": lambda: None,
    "none again": lambda: None,
}

def target(name):
    def read(path):
        data = path.read_bytes()
        if name == "strict":
            refuses()
        if data == b"mutated":
            FAULTS[name]()
    return Target("x", lambda: [b"valid"], (lambda data, rng: b"mutated",), read)

TARGETS = {name: target(name) for name in FAULTS}
"""
