"""How far runs of one configuration differ that should say the same: other seeds, other CPUs.

    python benchmarks/spread.py results run-of-another-seed/results … > spread.md

Each argument is the results folder of a finished run. Printed as Markdown: how each run was made;
mean Chamfer distances over all runs, and what all of them say of each prior; for each prior,
dataset and backbone the difference of its mean Chamfer distance to the control's, run by run, with
the verdict; and the standard deviation over runs, which is what `evaluation.training_spread` stands
for. Ends with 1 if one run says lower and another higher.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pandas as pd

from dine import config as dine_config
from dine.files import read_json
from dine.reporting.comparisons import effects
from dine.reporting.loading import load_metrics
from dine.reporting.names import METHODS, OBJECTS, display_name
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
    summary(found)
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


def summary(found: list[tuple[dict[str, str], pd.DataFrame, pd.DataFrame]]) -> None:
    """Print mean Chamfer distances over the runs, and what every one of them says of the priors."""
    places = ["objects", "dataset", "backbone"]
    clean = [metrics[metrics["condition"] == CLEAN] for _, metrics, _ in found]
    means = [x.groupby([*places, "method"])["cd"].mean().unstack("method") * 1e4 for x in clean]
    every = pd.concat(means).groupby(level=places, sort=False)
    verdicts = pd.concat([table[table["condition"] == CLEAN] for _, _, table in found])
    said = verdicts.groupby([*places, "method"])["verdict"].agg(set)
    order = [name for name in METHODS if name in means[0]]
    print(f"| objects | dataset | backbone | {' | '.join(map(display_name, order))} |")
    print(f"|{'---|' * (3 + len(order))}")
    low, middle, high = every.min(), every.mean(), every.max()
    for place in means[0].index:
        cells = []
        for name in order:
            if np.isnan(middle.loc[place, name]):
                cells.append("–")
                continue
            ends = f"{low.loc[place, name]:.1f}–{high.loc[place, name]:.1f}"
            words = said.get((*place, name))
            agreed = "" if words is None else f", {words.pop() if len(words) == 1 else 'undecided'}"
            cells.append(f"{middle.loc[place, name]:.1f} ({ends}){agreed}")
        names = [
            OBJECTS[place[0]],
            display_name(trained_on(place[1])),
            display_name(place[2]),
        ]
        print(f"| {' | '.join([*names, *cells])} |")
    print(
        "\nMean Chamfer distance ×1e-4 over all levels and runs; in brackets those of single runs."
    )
    print("Against the control: lower or higher in every run, or else undecided.\n")


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
