"""What is said while something runs, on a terminal and elsewhere."""

import io
import logging

import pytest

from dine import progress
from dine.cli import console
from dine.progress import Progress, Stages, remark, stage


class Terminal(io.StringIO):
    def isatty(self):
        return True


@pytest.fixture(autouse=True)
def as_before():
    root = logging.getLogger()
    handlers, levels = root.handlers[:], (root.level, logging.getLogger("dine").level)
    yield
    for handler in root.handlers:
        handler.close()
    root.handlers[:] = handlers
    for logger, level in zip((root, logging.getLogger("dine")), levels, strict=True):
        logger.setLevel(level)
    progress.hide(False)


def some_stages():
    with Stages():
        stage("reading")
        stage("reading")
        stage("network")
        remark("compiling once")
        logging.getLogger("dine.elsewhere").warning("something is odd")


def started(stream, monkeypatch, log=None):
    monkeypatch.setattr("sys.stderr", stream)
    console.start(log)
    return stream


def test_stages_are_lines_where_nobody_watches(monkeypatch):
    stream = started(io.StringIO(), monkeypatch)
    some_stages()
    said = [line.split(" ", 1)[1] for line in stream.getvalue().splitlines()]
    assert said == ["reading", "network", "network: compiling once", "something is odd"]


def test_stages_are_one_line_that_changes_on_a_terminal(monkeypatch, tmp_path):
    stream = started(Terminal(), monkeypatch, tmp_path / "log")
    some_stages()
    shown = stream.getvalue()
    lines = shown.split("\n")
    # One line stays: the warning, on a line that was cleared first.
    assert len(lines) == 2
    assert lines[0].rpartition("\r")[2].endswith(" something is odd")
    for text in ("reading …", "network …", "network: compiling once …"):
        assert text in shown
    assert lines[1].rpartition("\r")[2].strip() == ""
    assert len((tmp_path / "log").read_text().splitlines()) == 4


def test_a_bar_beside_the_line_says_how_far_it_is(monkeypatch):
    stream = started(Terminal(), monkeypatch)
    with Stages(("reading", "network", "writing")) as stages:
        for name, filled in (("reading", 0), ("network", 6), ("reading", 6), ("writing", 13)):
            stages.begin(name)
            shown = stream.getvalue().rpartition("\r")[2]
            assert f" {name} …" in shown
            assert max(shown.count("█"), shown.count("#")) == filled
    assert stream.getvalue().rpartition("\r")[2].strip() == ""


def test_quiet_leaves_warnings_and_a_whole_log(monkeypatch, tmp_path):
    stream = started(Terminal(), monkeypatch, tmp_path / "log")
    console.be_quiet()
    some_stages()
    with Progress("pairs", 2) as bar:
        bar.update(2)
    assert stream.getvalue().splitlines()[0].endswith("something is odd")
    assert len(stream.getvalue().splitlines()) == 1
    assert len((tmp_path / "log").read_text().splitlines()) == 5


def test_details_are_the_times_of_stages(monkeypatch):
    stream = started(io.StringIO(), monkeypatch)
    console.be_verbose()
    some_stages()
    assert "reading took 0." in stream.getvalue()
    assert "network took 0." in stream.getvalue()


def test_nothing_is_said_of_stages_that_nobody_asked_for(monkeypatch):
    stream = started(Terminal(), monkeypatch)
    stage("network")
    assert stream.getvalue() == ""


def test_compiling_is_said_once_and_only_of_ours(monkeypatch):
    import numba

    from dine.cli import compiling

    stream = started(io.StringIO(), monkeypatch)
    compiling.say_when_compiling()
    compiling._say.cache_clear()
    for modules in (["their.module"], ["dine.mine", "dine.other"]):
        for module in modules:

            def kernel(x):
                return x + 1

            kernel.__module__ = module
            assert numba.njit(kernel)(1) == 2
        expected = 0 if modules[0].startswith("their") else 1
        assert stream.getvalue().count("compiling once") == expected
