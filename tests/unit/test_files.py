"""Nothing half-written is ever taken for finished."""

import errno
import os
import platform
import re
import subprocess
import sys

import h5py
import numpy as np
import pytest
import torch
from disks import mounted

from dine.errors import DataError, StorageError
from dine.files import atomic_path, digest, read_json, write_json, write_text
from dine.models.checkpoint import save_tensors


def test_a_failed_write_keeps_the_old_file_and_leaves_nothing(tmp_path):
    path = tmp_path / "result.txt"
    write_text(path, "finished work")

    def fail():
        with atomic_path(path) as temporary:
            temporary.write_text("half of")
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fail()
    assert path.read_text() == "finished work"
    assert os.listdir(tmp_path) == ["result.txt"]


def test_the_temporary_file_keeps_the_suffix_and_parents_are_made(tmp_path):
    with atomic_path(tmp_path / "new" / "mesh.ply") as temporary:
        assert temporary.suffix == ".ply"
        temporary.write_text("x")
    assert (tmp_path / "new" / "mesh.ply").read_text() == "x"


def test_what_a_killed_process_left_goes_with_the_next_write(tmp_path):
    code = """if True:
        import os, signal, sys
        from dine.files import atomic_path
        with atomic_path(sys.argv[1]) as temporary:
            temporary.write_text("half of")
            os.kill(os.getpid(), signal.SIGKILL)
    """
    path = tmp_path / "result.ply"
    subprocess.run([sys.executable, "-c", code, str(path)])
    (left,) = os.listdir(tmp_path)
    # What a living process writes stays, and so does what another machine may be writing.
    number = re.search(r"(\d+)@", left)[1]
    others = {
        left.replace(f"{number}@", f"{os.getpid()}@"),
        left.replace("@", "@other-"),
        ".result.part.ply",
    }
    for name in others:
        (tmp_path / name).touch()
    write_text(path, "whole")
    assert set(os.listdir(tmp_path)) == {"result.ply", *others}


def test_no_process_is_asked_where_that_would_interrupt_it(tmp_path, monkeypatch):
    monkeypatch.setattr("dine.files._WINDOWS", True)
    monkeypatch.setattr(os, "kill", lambda *_: pytest.fail("a process was sent a signal"))
    left = f".result.1@{platform.node()[:32]}.abc.part.ply"
    (tmp_path / left).touch()
    write_text(tmp_path / "result.ply", "whole")
    assert set(os.listdir(tmp_path)) == {"result.ply", left}


@pytest.mark.parametrize("code", [errno.ENOSPC, errno.EROFS, errno.EDQUOT])
def test_storage_errors_name_file_and_cause(tmp_path, code):
    path = tmp_path / "result.txt"
    write_text(path, "finished work")
    with pytest.raises(StorageError, match=r"result\.txt: the .*free space"), atomic_path(path):
        raise OSError(code, "injected")
    assert path.read_text() == "finished work"


def test_other_errors_pass_through(tmp_path):
    with pytest.raises(IsADirectoryError), atomic_path(tmp_path / "x"):
        raise IsADirectoryError(errno.EISDIR, "not storage")


@pytest.fixture
def small_disk(tmp_path):
    """A real file system of 64 KiB."""
    with mounted(tmp_path / "disk", "64k") as place:
        yield place


def write_h5(path):
    with atomic_path(path) as temporary, h5py.File(temporary, "w") as file:
        file["x"] = np.random.default_rng(0).random(100_000)


def write_torch(path):
    with atomic_path(path) as temporary:
        torch.save({"x": torch.rand(100_000)}, temporary)


def write_weights(path):
    save_tensors(path, {"x": torch.rand(100_000)}, {"format": "test"})


@pytest.mark.parametrize(
    "write", [write_h5, write_torch, write_weights, lambda p: write_text(p, "x" * 10**6)]
)
def test_a_full_disk_gives_one_clear_error(small_disk, write):
    (small_disk / "result").write_text("finished work")
    with pytest.raises(StorageError, match="the disk is full"):
        write(small_disk / "result")
    assert (small_disk / "result").read_text() == "finished work"
    assert os.listdir(small_disk) == ["result"]


def test_json_round_trip_and_errors(tmp_path):
    write_json(tmp_path / "a.json", {"b": 1.5, "a": [1, 2]})
    assert read_json(tmp_path / "a.json") == {"a": [1, 2], "b": 1.5}
    with pytest.raises(DataError, match=r"nothing\.json does not exist"):
        read_json(tmp_path / "nothing.json")
    (tmp_path / "cut.json").write_text('{"a": ')
    with pytest.raises(DataError, match=r"cut\.json is not readable JSON"):
        read_json(tmp_path / "cut.json")


def test_digest_ignores_key_order_but_not_values():
    assert digest({"a": 1, "b": 2}) == digest({"b": 2, "a": 1})
    assert digest({"a": 1}) != digest({"a": 2})


def test_a_file_is_on_the_disk_before_it_has_its_name(tmp_path, monkeypatch):
    done = []
    fsync, replace = os.fsync, os.replace
    monkeypatch.setattr(os, "fsync", lambda handle: (done.append("written"), fsync(handle)))
    monkeypatch.setattr(os, "replace", lambda *names: (done.append("named"), replace(*names)))
    write_text(tmp_path / "a.txt", "a")
    assert done == ["written", "named"]
    assert (tmp_path / "a.txt").read_text() == "a"
