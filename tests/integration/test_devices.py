"""Devices are held by one process at a time, without a GPU: their names are injected."""

import contextlib
import os
import platform
import subprocess
import sys
from types import SimpleNamespace

import pytest
import torch

from dine.errors import ConfigError, DineError
from dine.models import devices

CUDA = torch.device("cuda")

LEASING = """
import sys
import torch
from dine.models import devices
torch.cuda.device_count = lambda: 2
devices._names = lambda: ["GPU-0", "GPU-1"]
with devices.leased(torch.device("cuda"), 1) as [device]:
    print(device.index, flush=True)
    sys.stdin.read()
"""

# The same lock, in a process that need not load torch.
HOLDING = """
import contextlib, os, pathlib, sys
from dine.files import held
with contextlib.ExitStack() as stack:
    for name in sys.argv[1:]:
        print(stack.enter_context(held(pathlib.Path(os.environ["DINE_LEASES"]) / name)), flush=True)
    sys.stdin.read()
"""


class Waited(Exception):
    """Another process would be waited for."""


@pytest.fixture
def two(monkeypatch, tmp_path):
    """A machine with two GPUs, of which nobody holds any; who waits is stopped."""

    def sleep(seconds):
        raise Waited

    monkeypatch.setenv(devices.LEASES, str(tmp_path))
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    monkeypatch.setattr(devices, "_names", lambda: ["GPU-0", "GPU-1"])
    monkeypatch.setattr(devices, "time", SimpleNamespace(sleep=sleep))


@contextlib.contextmanager
def another_process(*names, code=HOLDING, expected="None"):
    """A process that holds devices until the block ends."""
    with subprocess.Popen(
        [sys.executable, "-c", code, *names],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    ) as process:
        try:
            for _ in names:
                assert process.stdout.readline().strip() == expected
            yield process
        finally:
            process.kill()


def test_two_processes_get_a_device_each_and_a_third_waits(two, monkeypatch, caplog):
    with another_process("any", code=LEASING, expected="0") as first:
        with devices.leased(CUDA) as [device]:
            assert device == torch.device("cuda", 1)
        # One is free, and two are wanted: none is kept while waiting.
        waits = []

        def sleep(seconds):
            waits.append(seconds)
            with devices.held(devices._folder() / "GPU-1") as who:
                assert who is None
            if len(waits) == 3:
                first.kill()  # without a chance to tidy up
                first.wait()
            assert len(waits) < 10

        monkeypatch.setattr(devices, "time", SimpleNamespace(sleep=sleep))
        with caplog.at_level("INFO"), devices.leased(CUDA, 2) as found:
            assert [device.index for device in found] == [0, 1]
        assert len(waits) == 3
        assert caplog.text.count("waiting for 2 of 2 CUDA devices") == 1
        assert f"0 is held by process {first.pid}" in caplog.text


def test_a_device_is_free_after_use_and_after_an_error(two):
    with pytest.raises(KeyError), devices.leased(CUDA, 2):
        raise KeyError
    with (
        another_process("GPU-0", "GPU-1"),
        pytest.raises(Waited),
        devices.leased(CUDA),
    ):
        pass


def test_a_process_does_not_wait_for_itself(two):
    with devices.leased(CUDA) as outer:
        with devices.leased(CUDA) as inner:
            assert inner == outer
        with devices.held(devices._folder() / "GPU-0") as who:
            assert who == f"process {os.getpid()} on {platform.node()}"
    with devices.held(devices._folder() / "GPU-0") as who:
        assert who is None


def test_devices_are_told_apart_by_name_not_by_index(two, monkeypatch):
    with another_process("GPU-0"):
        # As CUDA_VISIBLE_DEVICES=1 shows it: the second device is the only one, and is number 0.
        monkeypatch.setattr(torch.cuda, "device_count", lambda: 1)
        monkeypatch.setattr(devices, "_names", lambda: ["GPU-1"])
        with devices.leased(CUDA) as [device]:
            assert device.index == 0
        monkeypatch.setattr(devices, "_names", lambda: ["GPU-0"])
        with pytest.raises(Waited), devices.leased(CUDA):
            pass


def test_the_name_is_the_gpu_s_own(monkeypatch):
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    monkeypatch.setattr(
        torch.cuda, "get_device_properties", lambda i: SimpleNamespace(uuid=f"id-{7 - i}")
    )
    assert devices._names() == ["id-7", "id-6"]


def test_one_process_at_a_time_looks_around(two):
    """Otherwise two of them could each find half of what they need."""
    with another_process("turn"), pytest.raises(Waited), devices.leased(CUDA):
        pass
    with devices.leased(CUDA):
        pass


def test_leases_can_be_switched_off(two, monkeypatch, tmp_path):
    monkeypatch.setenv(devices.LEASES, "off")
    monkeypatch.setattr(devices, "_folder", lambda: pytest.fail("asked for a folder"))
    with devices.leased(CUDA, 2) as found:
        assert [device.index for device in found] == [0, 1]


def test_a_cpu_is_not_held(monkeypatch):
    monkeypatch.setattr(devices, "_folder", lambda: pytest.fail("asked for a folder"))
    with devices.leased(torch.device("cpu"), 3) as found:
        assert found == [torch.device("cpu")] * 3


def test_more_devices_than_there_are(two):
    with pytest.raises(ConfigError, match="number of CUDA devices here is 2"):
        devices.leased(CUDA, 3).__enter__()


def test_the_folder_is_the_users_own(monkeypatch):
    monkeypatch.delenv(devices.LEASES, raising=False)
    assert devices._folder().stat().st_uid == os.getuid()
    real = os.getuid()
    answers = iter([real, real + 1])
    monkeypatch.setattr(os, "getuid", lambda: next(answers))
    with pytest.raises(DineError, match="belongs to another user"):
        devices._folder()
