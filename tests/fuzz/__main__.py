"""The nightly run: many inputs, a summary, and a status that says whether any failed."""

import argparse
import sys
import time
from pathlib import Path

from fuzz.runner import jobs, run
from fuzz.targets import TARGETS


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m fuzz", description=__doc__)
    parser.add_argument("--inputs", type=int, default=12_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--target", action="append", choices=TARGETS, help="repeatable")
    parser.add_argument("--only", type=int, help="one input, by its number")
    parser.add_argument("--out", type=Path, default=Path("fuzz-failures"), help="failing inputs")
    options = parser.parse_args()
    work = jobs(options.inputs, options.target)
    if options.only is not None:
        work = [(name, options.only) for name in options.target or TARGETS]
    began = time.monotonic()
    failures = []
    for failure in run(work, options.seed, options.out):
        failures.append(failure)
        print(failure, flush=True)
    kinds = len({name for name, _ in work})
    print(
        f"{len(work)} inputs of {kinds} kinds, seed {options.seed}: {len(failures)} failed "
        f"({time.monotonic() - began:.0f} s)"
    )
    return bool(failures)


if __name__ == "__main__":
    sys.exit(main())
