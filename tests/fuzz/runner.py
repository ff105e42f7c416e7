"""Runs inputs in a child process with limits; survives whatever they do to it.

The child reports after every input. If it dies or stays silent, the input that it was at has
failed, and a new child goes on behind it.
"""

from __future__ import annotations

import importlib
import json
import os
import resource
import selectors
import shutil
import subprocess
import sys
import tempfile
import time
import traceback
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from fuzz.target import Target

TESTS = Path(__file__).parents[1]
MEMORY = 256 << 20
"""Address space in bytes that one input may take on top of what the child has."""

SECONDS = 20
"""Processor time after which an input hangs; mutated files are small."""

IDLE = 30
"""Times as long on the wall clock, for a child that only waits, or waits for the processor."""

NO_MEMORY = ("unable to allocate", "can't allocate memory", "cannot allocate memory")
"""What libraries say in place of a ``MemoryError``."""

OURS = "fuzz.targets"
_ALIVE = "alive"


@dataclass(frozen=True)
class Failure:
    """An input that a reader could not deal with.

    Attributes:
        target: its kind.
        seed: of the run.
        index: its number.
        problem: what happened.
        saved: the file, to try again with.
    """

    target: str
    seed: int
    index: int
    problem: str
    saved: Path

    def __str__(self) -> str:
        again = f"python -m fuzz --target {self.target} --seed {self.seed} --only {self.index}"
        return f"{self.saved}: {self.problem}\n  again: {again}"


Job = tuple[str, int]


def targets_of(module: str) -> dict[str, Target]:
    """The targets that a module defines."""
    return importlib.import_module(module).TARGETS


def jobs(inputs: int, names: list[str] | None = None, module: str = OURS) -> list[Job]:
    """Targets and numbers of inputs, as many as asked for or a few more, shared out by weight."""
    targets = targets_of(module)
    chosen = {name: targets[name] for name in names or targets}
    total = sum(target.weight for target in chosen.values())
    return [
        (name, index)
        for name, target in chosen.items()
        for index in range(max(len(target.valid), -int(-inputs * target.weight // total)))
    ]


def run(
    work: list[Job], seed: int, out: Path, *, module: str = OURS, seconds: float = SECONDS
) -> Iterator[Failure]:
    """Try the inputs one after another; yield failures, whose files are saved below ``out``."""
    targets = targets_of(module)
    position = 0
    while position < len(work):
        for event in _child(work[position:], seed, module, seconds):
            name, index = work[position]
            if event is not None:
                data = targets[name].input(seed, index)
                saved = out / f"{name}-{seed}-{index}-{targets[name].file}"
                saved.parent.mkdir(parents=True, exist_ok=True)
                saved.write_bytes(data)
                yield Failure(name, seed, index, event, saved)
            position += 1


def _child(work: list[Job], seed: int, module: str, seconds: float) -> Iterator[str | None]:
    """What became of the inputs: None or a problem; ends early, after a problem, with the child."""
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    environment["PYTHONPATH"] = os.pathsep.join([str(TESTS), *sys.path])
    with (
        tempfile.TemporaryFile() as said,
        subprocess.Popen(
            [sys.executable, "-m", "fuzz.runner", module, str(seed)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=said,
            env=environment,
            bufsize=0,  # or lines could wait in the buffer while the pipe is empty
        ) as child,
        selectors.DefaultSelector() as selector,
    ):
        child.stdin.write(json.dumps(work).encode())
        child.stdin.close()
        selector.register(child.stdout, selectors.EVENT_READ)
        done = 0
        while done < len(work):
            line = _line(child, selector, seconds)
            if line:
                event = json.loads(line)
                if event != _ALIVE:
                    done += 1
                    yield event
                continue
            child.kill()
            code = child.wait()
            said.seek(0)
            last = said.read().decode(errors="replace").strip()[-300:]
            yield f"no answer within {seconds} s" if line is None else f"died ({code}): {last}"
            return


def _line(
    child: subprocess.Popen, selector: selectors.BaseSelector, seconds: float
) -> bytes | None:
    """The child's next line, empty at its end; None where it does not come."""
    began, used = time.monotonic(), _processor_seconds(child.pid)
    while not selector.select(0.5):
        late = time.monotonic() - began > IDLE * seconds
        if late or _processor_seconds(child.pid) - used > seconds:
            return None
    return child.stdout.readline()


def _processor_seconds(pid: int) -> float:
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def main() -> None:
    """The child: read the list of inputs, try each, print null or what was wrong."""
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # whatever prints must not look like an answer
    warnings.simplefilter("ignore")
    targets, seed = targets_of(sys.argv[1]), int(sys.argv[2])
    place = Path(tempfile.mkdtemp(prefix="fuzz-"))
    known: set[str] = set()
    try:
        for name, index in json.load(sys.stdin):
            target = targets[name]
            if name not in known:  # whatever is imported late must not count
                known.add(name)
                for data in target.valid:
                    attempt(target, data, place / "valid", limit=False)
                    print(json.dumps(_ALIVE), file=answers, flush=True)
            problem = attempt(target, target.input(seed, index), place / "input")
            if problem is None and index < len(target.valid):
                problem = attempt(target, target.valid[index], place / "input", valid=True)
            print(json.dumps(problem), file=answers, flush=True)
    finally:
        shutil.rmtree(place, ignore_errors=True)


def attempt(
    target: Target, data: bytes, folder: Path, *, limit: bool = True, valid: bool = False
) -> str | None:
    """None where a file is read or refused as it should be, otherwise what happened."""
    from dine.errors import DineError

    folder.mkdir()
    path = folder / target.file
    path.write_bytes(data)
    if limit:
        pages = int(Path("/proc/self/statm").read_text().split()[0])
        allowed = pages * resource.getpagesize() + MEMORY + 8 * len(data)
        resource.setrlimit(resource.RLIMIT_AS, (allowed, resource.RLIM_INFINITY))
    try:
        target.read(path)
    except DineError as error:
        if valid:
            return f"a valid file is refused: {error}"
        cause: BaseException | None = error
        while cause is not None:
            said = str(cause).lower()
            if isinstance(cause, MemoryError) or any(words in said for words in NO_MEMORY):
                return f"takes more than {MEMORY >> 20} MB: {error}"
            cause = cause.__cause__ or cause.__context__
        if "\n" in str(error):
            return f"an error of more than one line: {error}"
        if len(str(error)) > 20_000:
            return f"an error of {len(str(error))} characters: {str(error)[:200]}"
    except BaseException as error:
        frames = traceback.extract_tb(error.__traceback__)[-3:]
        where = " < ".join(f"{Path(f.filename).name}:{f.lineno}" for f in reversed(frames))
        return f"{type(error).__name__}: {str(error)[:300]} ({where})"
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
        shutil.rmtree(folder, ignore_errors=True)
    return None


if __name__ == "__main__":
    main()
