"""What it takes to find out how an organ lies: registrations with a prior, pose told and not.

    snakemake -j2 organ --configfile my.yaml
    python benchmarks/organ_pose.py results/organ_trial/* [--turns 2] [--out now.csv]
    python benchmarks/organ_pose.py results/organ_trial/* --before now.csv

On the true deformations of finished trials, whose scans are shown as they lie and turned by some
angle, as often as ``--turns`` says: mean and median distance of hidden and seen vertices from their
true places in percent of the radius, and CPU seconds of a whole registration, its report included.
With the rows of another version, ``--before``, what changed by case.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np
import pandas as pd

from dine.priors.organ import OrganPrior, load_organ_prior
from dine.registration.register import register
from dine.results import TrialFiles
from dine.simulation.fields import read_deformations
from dine.trials.organ import Case, seen_of

# From here on, in radii, a case counts as another one than before.
_OTHERWISE = 0.003


def measured(case: Case, prior: OrganPrior) -> dict[str, float]:
    """Errors in radii and CPU seconds of one registration."""
    began = time.process_time()
    how = "off" if case.motion is None else "auto"
    moved = register(case.template, case.scan, prior=prior, partial=True, prealign=how).moved
    seconds = time.process_time() - began
    error = np.linalg.norm(case.as_it_lay(moved.vertices) - case.truth, axis=1)
    return {
        "hidden": error[~case.seen].mean(),
        "seen": error[case.seen].mean(),
        "seconds": seconds,
    }


def rows_of(folder: Path, turns: int) -> pd.DataFrame:
    """A row for each deformation of a trial and each way its scan lies."""
    files = TrialFiles(folder)
    prior = load_organ_prior(files.prior("about"))
    rows = []
    for number, case in enumerate(seen_of(read_deformations(files.truth))):
        shown = {"told": case}
        for turn in range(turns):
            shown[f"found, {turn}"] = case.turned(100 * turn + number)
        for pose, turned in shown.items():
            labels = {"template": folder.name, "pose": pose, "deformation": number}
            rows.append(labels | measured(turned, prior))
    return pd.DataFrame(rows)


def table(rows: pd.DataFrame) -> str:
    """Means, medians in brackets."""
    lines = ["| template | pose | hidden | seen | CPU seconds |", "|---|---|---|---|---|"]
    pose = rows["pose"].str.partition(",")[0]
    for (template, how), part in rows.groupby(["template", pose], sort=False):
        errors = (100 * part[["hidden", "seen"]]).agg(["mean", "median"])
        cells = [f"{errors[x]['mean']:.2f} ({errors[x]['median']:.2f})" for x in errors]
        lines.append(f"| {template} | {how} | {' | '.join(cells)} | {part['seconds'].mean():.2f} |")
    return "\n".join(lines)


def changes(rows: pd.DataFrame, before: pd.DataFrame) -> str:
    """What is otherwise than before, by case."""
    by = ["template", "pose", "deformation"]
    both = before.merge(rows, on=by, suffixes=("_before", ""))
    lines = []
    for how, part in both.groupby(both["pose"].str.partition(",")[0], sort=False):
        change = part["hidden"] - part["hidden_before"]
        error = 1.96 * change.std() / np.sqrt(len(change))
        lines.append(
            f"{how}: hidden {100 * change.mean():+.2f} ± {100 * error:.2f} % of the radius; of "
            f"{len(change)} cases {(change > _OTHERWISE).sum()} are worse by more than "
            f"{100 * _OTHERWISE:g} %, {(change < -_OTHERWISE).sum()} better; CPU seconds "
            f"{part['seconds_before'].mean():.2f} before, {part['seconds'].mean():.2f} now"
        )
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("trials", type=Path, nargs="+")
    parser.add_argument("--turns", type=int, default=1)
    parser.add_argument("--out", type=Path)
    parser.add_argument("--before", type=Path)
    arguments = parser.parse_args()
    rows = pd.concat([rows_of(folder, arguments.turns) for folder in arguments.trials])
    if arguments.out:
        rows.to_csv(arguments.out, index=False)
    print(table(rows))
    if arguments.before:
        print(changes(rows, pd.read_csv(arguments.before)))


if __name__ == "__main__":
    main()
