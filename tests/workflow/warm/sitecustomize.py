"""A start of ``dine`` and Snakemake that imports nothing: a fork of a server that has done so.

Imports take most of the time of the many small jobs in the tests of the workflow. Python runs this
file by itself where its folder is in PYTHONPATH, and where DINE_WARM names the socket of a server,
the process hands over all that makes it one of its own, passes on signals, and ends as the fork
does. As a script, this is the server. Never used where processes are killed.
"""

import atexit
import contextlib
import gc
import importlib
import importlib.machinery
import io
import json
import os
import pkgutil
import runpy
import select
import signal
import socket
import sys
import threading
import traceback
from pathlib import Path

# What `dine` and Snakemake import when they run.
LIBRARIES = (
    "docutils.core",
    "sklearn.decomposition",
    "sklearn.isotonic",
    "smart_open",
    "snakemake.cli",
    "snakemake.report.html_reporter",
    "torch._dynamo",
    "yte",
    "zuko",
)
TRACED = Path(__file__).parents[1] / "traced.py"
PASSED_ON = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
SNAKEMAKE = ["-m", "snakemake"]


def hand_over(address):
    """In a process that was just started: what the fork gives, by which this process ends."""
    started = {"arguments": sys.orig_argv[1:], "path": sys.path, "folder": os.getcwd()}
    with socket.socket(socket.AF_UNIX) as connection:
        connection.connect(address)
        socket.send_fds(connection, [b"."], [0, 1, 2])
        with connection.makefile("rw", encoding="ascii") as stream:
            print(json.dumps(started | {"environment": dict(os.environ)}), file=stream, flush=True)
            fork = int(stream.readline())
            for number in PASSED_ON:
                signal.signal(number, lambda number, _: os.kill(fork, number))
            return os.waitstatus_to_exitcode(int(stream.readline()))


def end(code):
    """End this process with an exit code, or by a signal."""
    try:
        if code < 0:
            if -code != signal.SIGKILL:
                signal.signal(-code, signal.SIG_DFL)
            os.kill(os.getpid(), -code)
    finally:
        os._exit(code % 256)


def serve(address):
    """Fork for each that connects, until standard input is closed; returns in forks only."""
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(f"{address}.new")
        listener.listen(64)
        os.rename(f"{address}.new", address)
        signal.signal(signal.SIGCHLD, signal.SIG_IGN)  # no zombies
        while sys.stdin not in select.select([listener, sys.stdin], [], [])[0]:
            connection = listener.accept()[0]
            if os.fork() == 0:
                return connection
            connection.close()
    os._exit(0)


def answer(connection):
    """In a fork: fork again, and wait for that; returns in it only, with what it is to be."""
    signal.signal(signal.SIGCHLD, signal.SIG_DFL)
    with connection:
        files = socket.recv_fds(connection, 1, 3)[1]
        with connection.makefile("rw", encoding="ascii") as stream:
            started = json.loads(stream.readline())
            fork = os.fork()
            if fork:
                try:
                    print(fork, file=stream, flush=True)
                    print(os.waitpid(fork, 0)[1], file=stream, flush=True)
                finally:
                    os._exit(0)
    for number, file in enumerate(files):
        os.dup2(file, number)
        os.close(file)
    # What they are now may be pipes, where they were files.
    through = sys.stdout.write_through  # so it is without buffers
    sys.stdout, sys.stderr = (
        io.TextIOWrapper(
            os.fdopen(number, "wb", 0 if through else -1, closefd=False),
            errors=errors,
            line_buffering=number == 2,
            write_through=through,
        )
        for number, errors in ((1, "strict"), (2, "backslashreplace"))
    )
    return started


def become(started):
    """Run what a process was started for; its exit code."""
    os.chdir(started["folder"])
    os.environ.clear()
    os.environ.update(started["environment"])
    arguments = started["arguments"]
    sys.orig_argv[1:] = arguments
    sys.path[:] = started["path"]
    importlib.invalidate_caches()
    try:
        if arguments[:2] == SNAKEMAKE:
            forget_another_package()
            sys.path.insert(0, started["folder"])
            sys.argv = arguments[1:]
            runpy.run_module(arguments[1], run_name="__main__", alter_sys=True)
        else:
            sys.path.insert(0, os.path.dirname(arguments[0]))
            sys.argv = arguments
            if "DINE_TRACE" in os.environ:
                runpy.run_path(str(TRACED))
            runpy.run_path(arguments[0], run_name="__main__")
    except SystemExit as error:
        if error.code is not None and not isinstance(error.code, int):
            print(error.code, file=sys.stderr)
            return 1
        return error.code or 0
    except BaseException as error:
        traceback.print_exc()
        return -signal.SIGINT if isinstance(error, KeyboardInterrupt) else 1
    return 0


def forget_another_package():
    """Plans are made with the `dine` of the path, which may be another one than the server's."""
    found = importlib.machinery.PathFinder.find_spec("dine", sys.path)
    if found is None or os.path.samefile(found.origin, sys.modules["dine"].__file__):
        return
    for name in [name for name in sys.modules if name.partition(".")[0] == "dine"]:
        del sys.modules[name]


def leave(code):
    """What Python does in the end, but for freeing all that was imported, which takes a second."""
    threading._shutdown()
    atexit._run_exitfuncs()
    sys.stdout.flush()
    sys.stderr.flush()
    end(code)


def read_code():
    """Digests of all commands, and of what they may be given, are kept in this process."""
    from dine.classical.methods import CLASSICAL
    from dine.cli import cli
    from dine.models.backbones import BACKBONES
    from dine.priors import PRIORS
    from dine.provenance import code_digest
    from dine.training.data_terms import DATA_TERMS

    for command in cli.commands:
        with contextlib.suppress(KeyError):  # a group of commands
            code_digest(command)
    for registry in (BACKBONES, CLASSICAL, DATA_TERMS, PRIORS):
        code_digest("stage2", *registry.names())


def warm():
    """Import what jobs and Snakemake do, and read the code that both follow; start no thread."""
    import numba

    import dine

    found = [module.name for module in pkgutil.walk_packages(dine.__path__, "dine.")]
    for name in [*found, *LIBRARIES]:
        if not name.endswith("__main__"):
            importlib.import_module(name)
    numba.njit(lambda: None)()  # the rest of its modules
    read_code()
    gc.freeze()  # memory that nothing writes to is shared


if __name__ == "__main__":
    warm()
    leave(become(answer(serve(sys.argv[1]))))
elif "DINE_WARM" in os.environ:
    arguments = sys.orig_argv[1:]
    if arguments[:2] == SNAKEMAKE or (arguments and Path(arguments[0]).name == "dine"):
        code = 1
        try:
            code = hand_over(os.environ["DINE_WARM"])
        finally:  # never to be run a second time
            end(code)
