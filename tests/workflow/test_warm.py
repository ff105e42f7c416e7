"""A warm start of ``dine`` is a start: what the process gets, says and gives back."""

import json
import os
import signal
import subprocess
import sys

import pytest
from workplace import WARM, warm, with_default_signals

SCRIPT = """
import atexit, json, os, signal, sys, threading, time
import of_the_path
print(json.dumps({
    "arguments": sys.argv,
    "command": sys.orig_argv[1:],
    "folder": os.getcwd(),
    "environment": {k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "DINE_WARM")},
    "path": [path for path in sys.path if not path.endswith("warm")],
    "main": [__name__, __file__],
    "given": sys.stdin.read(),
    "signals": [str(signal.getsignal(number)) for number in signal.valid_signals()],
    "threads": threading.active_count(),
    "warm": "torch" in sys.modules,
}))
print("said", file=sys.stderr)
atexit.register(print, "in the end")
threading.Thread(target=lambda: (time.sleep(0.1), print("by another thread"))).start()
"""


@pytest.fixture
def start(tmp_path):
    """Starts a script called ``dine``, cold or warm."""

    def run(text, is_warm, *arguments):
        for name in ("bin", "path", "folder ü"):
            (tmp_path / name).mkdir(exist_ok=True)
        (tmp_path / "bin" / "dine").write_text(text)
        (tmp_path / "path" / "of_the_path.py").touch()
        extra = {"OF_TEST": "ü\udcff", "PYTHONPATH": str(tmp_path / "path")}
        if is_warm:
            extra |= warm() | {"PYTHONPATH": f"{extra['PYTHONPATH']}{os.pathsep}{WARM}"}
        return subprocess.Popen(
            [sys.executable, tmp_path / "bin" / "dine", *arguments],
            cwd=tmp_path / "folder ü",
            env=os.environ | extra,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            preexec_fn=with_default_signals,
        )

    return run


@pytest.mark.parametrize(
    "end", ["", "sys.exit(3)", "sys.exit('wrong')", "1 / 0", "os.kill(os.getpid(), 9)"]
)
def test_it_is_as_a_cold_one(start, end):
    ended = []
    for is_warm in (False, True):
        process = start(SCRIPT + end, is_warm, "--option", "a b", "ü\udcff")
        said, errors = process.communicate("given")
        first, *others = said.splitlines() or ["{}"]
        facts = json.loads(first)
        assert facts.pop("warm", is_warm) == is_warm
        lines = errors.splitlines()  # a traceback is that of another start
        ended.append((facts, others, lines[0], lines[-1], process.returncode))
    assert ended[0] == ended[1]


WAITS = """
import signal, sys, time
signal.signal(signal.SIGTERM, lambda *_: sys.exit(7))
print("ready", flush=True)
for _ in range(600):  # a signal just before a sleep does not end it
    time.sleep(0.1)
"""


@pytest.mark.parametrize(
    ("number", "code"),
    [(signal.SIGTERM, 7), (signal.SIGINT, -signal.SIGINT), (signal.SIGHUP, -signal.SIGHUP)],
)
def test_signals_are_passed_on(start, number, code):
    with start(WAITS, True) as process:
        assert process.stdout.readline() == "ready\n"
        process.send_signal(number)
        assert process.wait(60) == code
