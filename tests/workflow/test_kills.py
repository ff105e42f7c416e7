"""A small version of ``make kill-test``: some kills, then the files of an undisturbed run."""

import signal

import pytest
from kills import Kill, finish, perform
from workplace import differences

# With the other file that needs the undisturbed run, which takes a minute.
pytestmark = pytest.mark.xdist_group("undisturbed")

# Each at another stage of a job: Python starting, computing, writing.
KILLS = [
    Kill("raw", "group", signal.SIGKILL, 1.0),
    Kill("stage1", "job", signal.SIGKILL, 2.2),
    Kill("stage1", "group", signal.SIGTERM, 2.5),
    Kill("stage2", "snakemake", signal.SIGKILL, 1.5, at_once=True),
    Kill("predict", "group", signal.SIGINT, 0.5),
]


@pytest.fixture(scope="module")
def killed(undisturbed):
    """The run of ``undisturbed`` again, one job at a time, with kills; the command's last words."""
    for kill in KILLS:
        assert perform(undisturbed.place, kill, ["all"], cores=1), kill
    undisturbed.place.warm = True  # nothing is killed any more
    return finish(undisturbed.place, ["all"], cores=1)


def test_a_killed_run_gives_the_files_of_an_undisturbed_one(undisturbed, killed):
    assert differences(undisturbed.finished.results, undisturbed.place.results) == []


def test_nothing_is_left_to_do(undisturbed, killed):
    assert "Nothing to be done" in undisturbed.place.run("all")
