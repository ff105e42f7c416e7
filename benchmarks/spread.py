"""How far runs of one configuration differ that should say the same: other seeds, other CPUs.

    python benchmarks/spread.py results run-of-another-seed/results … > spread.md

Each argument is the results folder of a finished run. Printed as Markdown: how each run was made;
for each prior, dataset and backbone the difference of its mean Chamfer distance to the control's,
run by run, with the verdict; and the standard deviation over runs, which is what
`evaluation.training_spread` stands for. Ends with 1 if one run says lower and another higher.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pandas as pd

from dine import config as dine_config
from dine.files import read_json
from dine.reporting.effects import effects
from dine.reporting.loading import load_metrics
from dine.reporting.names import OBJECTS, display_name
from dine.results import CLEAN, Results, runs, trained_on

KEYS = ["objects", "dataset", "backbone", "method"]
MARKS = {"lower": "", "higher": " (higher)", "undecided": " (undecided)"}


def read(folder: Path) -> tuple[dict[str, str], pd.DataFrame, pd.DataFrame]:
    """How a run was made, its metrics and its effects on clean targets."""
    settings = dine_config.load(folder / "config.yaml")
    files = Results(folder)
    every = runs(settings)
    metrics = load_metrics([files.run(*run).metrics for run in every])
    record = read_json(files.run(*every[0]).record)
    made = {"seed": str(settings.seed), **record["made"]}
    made["λ"] = ", ".join(
        f"{name} {value:g}" for name, value in read_json(files.search)["selected"].items()
    )
    return made, metrics, effects(metrics, spread=settings.evaluation.training_spread)


def main(folders: list[Path]) -> int:
    if len(folders) < 2:
        sys.exit("Give the results folders of at least two runs.")
    found = [read(folder) for folder in folders]
    print("| run | seed | CPU | CPU settings | commit | date | λ |\n|---|---|---|---|---|---|---|")
    for number, (made, _, _) in enumerate(found, start=1):
        cells = [
            made.get(key, "–") for key in ("seed", "CPU", "CPU settings", "commit", "date", "λ")
        ]
        print(f"| {number} | {' | '.join(cells)} |")
    print()
    numbers = range(1, len(found) + 1)
    for condition in (CLEAN, "outliers", "noise", "resampled"):
        tables = [table[table["condition"] == condition].set_index(KEYS) for _, _, table in found]
        places = tables[0].index
        if not len(places):
            continue
        print(f"Condition: {condition}\n")
        print(f"| objects | dataset | backbone | prior | {' | '.join(map(str, numbers))} | sd |")
        print(f"|{'---|' * (5 + len(found))}")
        spreads = []
        for place in places:
            rows = [table.loc[place] for table in tables if place in table.index]
            spreads.append(np.std([row["relative"] for row in rows], ddof=1))
            cells = [
                OBJECTS[place[0]],
                display_name(trained_on(place[1])),
                *map(display_name, place[2:]),
                *(f"{signed(row['relative'])} %{MARKS[row['verdict']]}" for row in rows),
                f"{spreads[-1]:.0f}",
            ]
            print(f"| {' | '.join(cells)} |")
        print(f"\nStandard deviation over runs, root mean square: {rms(spreads):.0f} %\n")
    return contradictions([table for _, _, table in found])


def signed(percent: float) -> str:
    return f"{percent:+.0f}".replace("-", "−")


def rms(values: list[float]) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def contradictions(tables: list[pd.DataFrame]) -> int:
    """Print where one run says lower and another higher; 1 if there is such a place."""
    rows = pd.concat(tables)
    said = rows.groupby([*KEYS, "condition"])["verdict"].agg(set)
    against = said[said.map(lambda words: {"lower", "higher"} <= words)]
    for place in against.index:
        print(f"Runs contradict each other: {', '.join(place)}")
    return int(len(against) > 0)


if __name__ == "__main__":
    sys.exit(main([Path(argument) for argument in sys.argv[1:]]))
