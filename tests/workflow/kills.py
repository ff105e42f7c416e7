"""Kill the workflow at random moments in every step, run the same command again, compare.

python tests/workflow/kills.py --kills 66 --seed 0 --record kills.csv

A run without disturbance comes first. Then one after another is started and killed: a job,
Snakemake alone (its jobs go on), or all processes at once; a third of them at any moment of a run
that begins anew, the others while a job of each step in turn is made to run. In the end the same
command runs to its end, and its files must be those of the first run, bit for bit, but for the
times named in ``workplace.py``.
"""

import argparse
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import pandas as pd
import psutil
from workplace import HERE, Job, Workplace, differences

SIGNALS = (signal.SIGKILL, signal.SIGTERM, signal.SIGINT)
VICTIMS = ("job", "snakemake", "group")
PATIENCE = 900.0
"""Seconds after which something hangs."""
STUCK = 300.0
"""Seconds after which Snakemake, asked to end, will not."""
ATTEMPTS = 3
"""A job may be over before it is seen."""

# Where the rule is called otherwise than the command.
RULES = {
    "fit-prior": "fit_prior",
    "search-lambda": "search_lambda",
    "stage2": "stage2_prior",
    "config": "resolved_config",
    "report": "html",
    "resample": "evidence_resample",
    "classical": "evidence_classical",
    "refine-predictions": "evidence_refine",
    "diagnose": "evidence_diagnose",
}


@dataclass
class Kill:
    """One kill."""

    step: str
    """In whose job; any where it is empty."""
    victim: str
    signal: int
    wait: float
    """Seconds after such a job was seen, at most until its end; or after Snakemake's start."""
    at_once: bool = False
    """Whether the next run starts while jobs of this one still go on."""
    forced: bool = False
    """Whether the step is made to run even if it is finished, and nothing after it."""
    seconds: float = float("nan")
    """What the wait came to."""
    running: str = ""
    """All steps at that moment."""
    left: str = ""
    """Steps of jobs that went on after Snakemake's end."""


def drawn(usual: dict[str, float], seconds: float, count: int, seed: int) -> list[Kill]:
    """``count`` kills: a third at any moment of a run that takes ``seconds``, then step by step."""
    rng = np.random.default_rng(seed)
    anywhere = count // 3
    steps = [""] * anywhere
    steps += [list(usual)[number % len(usual)] for number in range(count - anywhere)]
    return [
        Kill(
            step,
            # Where a job is killed, Snakemake goes on with all the rest that does not need it.
            str(rng.choice(VICTIMS if step else VICTIMS[1:])),
            int(rng.choice(SIGNALS, p=(0.5, 0.25, 0.25))),
            # Eight such runs would get through everything, were nothing lost.
            float(rng.uniform() * (usual[step] if step else seconds / 4)),
            at_once=bool(rng.uniform() < 0.5),
            forced=bool(step),
        )
        for step in steps
    ]


def watch(place: Workplace, process: subprocess.Popen) -> dict[str, float]:
    """Seconds that a job of each step takes, in the order in which they first appear."""
    seen: dict[int, tuple[str, float, float]] = {}
    while process.poll() is None:
        now = time.monotonic()
        for job in place.jobs():
            _, first, _ = seen.get(job.process.pid, (job.step, now, now))
            seen[job.process.pid] = (job.step, first, now)
        time.sleep(0.05)
    if process.returncode:
        raise AssertionError((place.folder / "said.txt").read_text()[-3000:])
    steps = dict.fromkeys(step for step, *_ in seen.values())
    spans = {step: [b - a for s, a, b in seen.values() if s == step] for step in steps}
    return {step: float(np.mean(span)) for step, span in spans.items()}


def end(process: subprocess.Popen) -> None:
    """Wait for Snakemake's end, as a user would: not for ever."""
    try:
        process.wait(STUCK)
    except subprocess.TimeoutExpired:
        # Its handler of SIGTERM takes a lock that the interrupted code may hold (9.27.1).
        process.kill()
        process.wait(PATIENCE)


def wait_for(place: Workplace, step: str, process: subprocess.Popen) -> Job | None:
    """A running job of a step, or of any; None when Snakemake ends without one."""
    while process.poll() is None:
        for job in place.jobs():
            if job.step == step or not step:
                return job
        time.sleep(0.01)
    return None


def settle(place: Workplace) -> None:
    """Wait until no job runs any more."""
    psutil.wait_procs([job.process for job in place.jobs()], timeout=PATIENCE)
    if place.jobs():
        raise AssertionError(f"still running: {place.jobs()}")


def perform(place: Workplace, kill: Kill, targets: list[str], cores: int) -> bool:
    """Start the workflow and kill it; whether there was anything to kill."""
    place.unlock()
    rule = RULES.get(kill.step, kill.step)
    force = ["-R", rule, "--until", rule] if kill.forced else []
    process = place.start(*targets, *force, cores=cores)
    began = time.monotonic()
    job = None
    if kill.step:
        job = wait_for(place, kill.step, process)
        began = time.monotonic()
    while time.monotonic() < began + kill.wait and (job is None or job.process.is_running()):
        time.sleep(0.01)
    if kill.victim == "job" and (job is None or not job.process.is_running()):
        job = wait_for(place, "", process)
    running = place.jobs()
    try:
        if process.poll() is not None or (kill.victim == "job" and job is None):
            return False
        if kill.victim == "job":
            job.process.send_signal(kill.signal)
        elif kill.victim == "snakemake":
            process.send_signal(kill.signal)
        else:
            os.killpg(process.pid, kill.signal)
    except (psutil.NoSuchProcess, ProcessLookupError):  # it has just ended by itself
        return False
    finally:
        kill.seconds = time.monotonic() - began
        kill.running = " ".join(sorted(job.step for job in running))
        end(process)
    kill.left = " ".join(sorted(job.step for job in place.jobs()))
    if not kill.at_once:
        settle(place)
    return True


def finish(place: Workplace, targets: list[str], cores: int) -> str:
    """The same command once more, to the end."""
    settle(place)
    place.unlock()
    return place.run(*targets, cores=cores)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--kills", type=int, default=66)
    parser.add_argument("--least", type=int, default=50, help="Some come too late, and count not.")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--cores", type=int, default=2)
    parser.add_argument("--record", type=Path, help="CSV with one row for each kill.")
    parser.add_argument("--keep", type=Path, help="Folder to work in, kept afterwards.")
    options = parser.parse_args()
    root = Path(options.keep or tempfile.mkdtemp(prefix="dine-kills-"))
    targets = ["all", "evidence", "pretrained"]
    (root / "run").mkdir(parents=True)
    place = Workplace(root / "run", HERE / "smallest.yaml", HERE / "kills.yaml")
    began = time.monotonic()
    usual = watch(place, place.start(*targets, cores=options.cores))
    seconds = time.monotonic() - began
    print(f"undisturbed: {seconds:.0f} s, {len(usual)} steps", flush=True)
    whole = place.copy(root / "undisturbed")
    place.empty()
    done: list[Kill] = []
    for kill in drawn(usual, seconds, options.kills, options.seed):
        for _ in range(ATTEMPTS):
            if perform(place, kill, targets, options.cores):
                done.append(kill)
                break
            if not kill.step:  # the run came to its end
                place.empty()
        name = signal.Signals(kill.signal).name
        print(
            f"{len(done):3} {kill.step or 'any':18} {kill.victim:9} {name} after "
            f"{kill.seconds:5.1f} s; running: {kill.running}; left: {kill.left}",
            flush=True,
        )
        if options.record:
            options.record.parent.mkdir(exist_ok=True)
            pd.DataFrame(map(asdict, done)).to_csv(options.record, index=False)
    finish(place, targets, options.cores)
    odd = differences(whole.results, place.results)
    said = (place.folder / "said.txt").read_text()
    resumed, refused = said.count("going on from step"), said.count("is in use by")
    print(f"{len(done)} kills in {time.monotonic() - began:.0f} s with seed {options.seed}:")
    print(f"  trainings that went on from a saved state: {resumed}, refused folders: {refused}")
    print(f"  files that differ from the undisturbed run: {', '.join(odd) or 'none'}")
    if odd:
        print(f"  both are kept in {root}")
    elif not options.keep:
        shutil.rmtree(root)
    return int(bool(odd) or len(done) < min(options.kills, options.least))


if __name__ == "__main__":
    sys.exit(main())
