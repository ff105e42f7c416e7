"""How far runs of one configuration differ that should say the same: other seeds, other CPUs.

    python benchmarks/spread.py results run-of-another-seed/results … > spread.md

Each argument is the results folder of a finished run. Printed as Markdown: how each run was made;
mean Chamfer distances over all runs, and what all of them say of each prior, also by level and
taken together; for each prior, dataset and backbone the difference of its mean Chamfer distance to
the control's, run by run, with the verdict; and the standard deviation over runs, which is what
`evaluation.training_spread` and `evaluation.training_spread_outliers` stand for. Ends with 1 if one
run says lower and another higher.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd

from dine import config as dine_config
from dine.config import CONTROL, STAGE1
from dine.evaluation.repeats import joined
from dine.evaluation.statistics import Spread, spread_of, spread_under
from dine.files import read_json
from dine.reporting.comparisons import effects
from dine.reporting.loading import load_metrics
from dine.reporting.names import METHODS, OBJECTS, display_name
from dine.results import CLEAN, Results, runs, trained_on

PLACE = ["objects", "dataset", "backbone"]
KEYS = [*PLACE, "method"]
MARKS = {"lower": "", "higher": " (higher)", "undecided": " (undecided)"}


@dataclass(frozen=True)
class Finished:
    """A run: how it was made, its metrics, and the effects of its priors against the control,
    against Stage 1, and against the better of the two: a control may be worse than its start."""

    made: dict[str, str]
    metrics: pd.DataFrame
    control: pd.DataFrame
    first: pd.DataFrame
    spread: Spread

    @property
    def both(self) -> pd.DataFrame:
        return against_both(self.control, self.first)


def read(folder: Path) -> Finished:
    settings = dine_config.load(folder / "config.yaml")
    files = Results(folder)
    every = runs(settings)
    metrics = load_metrics([files.run(*run).metrics for run in every])
    record = read_json(files.run(*every[0]).record)
    made = {"seed": str(settings.seed), **record["made"]}
    made["λ"] = ", ".join(
        f"{name} {value:g}" for name, value in read_json(files.search)["selected"].items()
    )
    spread = spread_of(settings.evaluation)
    control, first = (effects(metrics, reference, spread=spread) for reference in (CONTROL, STAGE1))
    return Finished(made, metrics, control, first, spread)


def against_both(control: pd.DataFrame, first: pd.DataFrame) -> pd.DataFrame:
    """The smaller of the gains over two references, decided where both are."""
    keys = [*KEYS, "condition"]
    pair = control.merge(first, on=keys, suffixes=("", "_first"))
    same = pair["verdict"] == pair["verdict_first"]
    return pair[keys].assign(
        relative=pair[["relative", "relative_first"]].max(axis=1),
        verdict=pair["verdict"].where(same, "undecided"),
    )


def main(folders: list[Path]) -> int:
    if len(folders) < 2:
        sys.exit("Give the results folders of at least two runs.")
    found = [read(folder) for folder in folders]
    print("| run | seed | CPU | CPU settings | commit | date | λ |\n|---|---|---|---|---|---|---|")
    for number, run in enumerate(found, start=1):
        cells = [
            run.made.get(key, "–") for key in ("seed", "CPU", "CPU settings", "commit", "date", "λ")
        ]
        print(f"| {number} | {' | '.join(cells)} |")
    print()
    summary([run.metrics for run in found], [run.both for run in found])
    together(found)
    each_level(found)
    controls = [run.control for run in found]
    numbers = range(1, len(found) + 1)
    for condition in (CLEAN, "outliers", "noise", "resampled"):
        tables = [table[table["condition"] == condition].set_index(KEYS) for table in controls]
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
                *place_names(place[:3]),
                display_name(place[3]),
                *(f"{signed(row['relative'])} %{MARKS[row['verdict']]}" for row in rows),
                f"{spreads[-1]:.0f}",
            ]
            print(f"| {' | '.join(cells)} |")
        print(f"\nStandard deviation over runs, root mean square: {rms(spreads):.0f} %\n")
    return contradictions(controls)


def summary(metrics: list[pd.DataFrame], both: list[pd.DataFrame]) -> None:
    """Print mean Chamfer distances over the runs, and what every one of them says of the priors."""
    clean = [x[x["condition"] == CLEAN] for x in metrics]
    means = [x.groupby([*PLACE, "method"])["cd"].mean().unstack("method") * 1e4 for x in clean]
    middle = pd.concat(means).groupby(level=PLACE, sort=False).mean()
    verdicts = pd.concat([table[table["condition"] == CLEAN] for table in both])
    said = verdicts.groupby([*PLACE, "method"])[["relative", "verdict"]].agg(list)
    order = [name for name in METHODS if name in middle]
    heading("| objects | dataset | backbone |", map(display_name, order))
    for place in means[0].index:
        cells = []
        for name in order:
            mean = middle.loc[place, name]
            if np.isnan(mean):
                cells.append("–")
            elif (*place, name) not in said.index:
                cells.append(f"{mean:.1f}")
            else:
                percent, words = said.loc[(*place, name)]
                agreed = "" if len(set(words)) == 1 else ", undecided"
                agreed = ", undecided" if set(words) == {"undecided"} else agreed
                cells.append(f"{mean:.1f} ({ends(percent)} %{agreed})")
        print(f"| {' | '.join([*place_names(place), *cells])} |")
    print(
        "\nMean Chamfer distance ×1e-4 over all levels and runs; in brackets the difference to the "
        "better of Stage 1 and control\nfrom run to run, undecided unless it is lower than both in "
        "every run, or higher.\n"
    )
    levels(clean, order)


def levels(clean: list[pd.DataFrame], order: list[str]) -> None:
    """Print at how many levels the mean of each prior lies below that of Stage 1 and of the control
    in each run, and by how much their mean over runs lies below Stage 1's."""
    every = [x.groupby([*PLACE, "method", "level"])["cd"].mean().unstack("method") for x in clean]
    priors = [name for name in order if name not in (STAGE1, CONTROL)]
    heading("| objects | dataset | backbone |", map(display_name, priors))
    for place in dict.fromkeys(x[:3] for x in every[0].index):
        cells = []
        for name in priors:
            rows = [x.loc[place] for x in every]
            if name not in rows[0] or rows[0][name].isna().all():
                cells.append("–")
                continue
            better = [x[[STAGE1, CONTROL]].min(axis=1) for x in rows]
            below = [int((x[name] < y).sum()) for x, y in zip(rows, better, strict=True)]
            whole = [x.loc[place].mean() for x in every]
            gain = np.mean([x[name] for x in whole]) / np.mean([x[STAGE1] for x in whole]) - 1
            counts = ", ".join(map(str, below))
            cells.append(f"{counts} of {len(rows[0])}; {signed(100 * gain)} %")
        print(f"| {' | '.join([*place_names(place), *cells])} |")
    print(
        "\nLevels at which the mean lies below both others, run by run; and the difference of\n"
        "the mean over levels and runs to that of Stage 1.\n"
    )


def together(found: list[Finished]) -> None:
    """Print what all runs say as one sample, on clean targets.

    Of the two references the one is shown that a prior gains less over.
    """
    joint = of_both([(run.control, run.first) for run in found], found)
    priors = [name for name in METHODS if name in set(joint[0].index.get_level_values("method"))]
    heading("| objects | dataset | backbone |", map(display_name, priors))
    for place in dict.fromkeys(index[:3] for index in joint[0].index):
        cells = []
        for name in priors:
            if (*place, name) not in joint[0].index:
                cells.append("–")
                continue
            mean, low, high = max(tuple(table.loc[(*place, name)]) for table in joint)
            mark = "**" if lower(joint, (*place, name)) else ""
            said = f"{signed(mean)} %"
            cells.append(f"{mark}{said}{mark} ({signed(low)} to {signed(high)})")
        print(f"| {' | '.join([*place_names(place), *cells])} |")
    print(
        "\nDifference to the better of Stage 1 and control over all runs together, with its 95 % "
        "interval.\nBold: below both, and neither interval holds zero.\n"
    )


def each_level(found: list[Finished]) -> None:
    """Print at how many levels all runs together decide that a prior is below both, or control."""
    every = sorted(set.union(*({*run.metrics["level"].dropna()} for run in found)))
    counts: dict[tuple, list[int]] = {}
    for level in every:
        tables = []
        for run in found:
            some = run.metrics[
                (run.metrics["condition"] == CLEAN) & (run.metrics["level"] == level)
            ]
            tables.append([effects(some, name, spread=run.spread) for name in (CONTROL, STAGE1)])
        joint = of_both(tables, found)
        for key in joint[0].index:
            count = counts.setdefault(key, [0, 0, 0])
            for place, said in enumerate([lower(joint, key), lower(joint[:1], key), True]):
                count[place] += said
    priors = [name for name in METHODS if name in {key[3] for key in counts}]
    heading("| objects | dataset | backbone |", map(display_name, priors))
    for place in dict.fromkeys(key[:3] for key in counts):
        cells = []
        for name in priors:
            both, control, of = counts.get((*place, name), (0, 0, 0))
            cells.append(f"{both}, {control} of {of}" if of else "–")
        print(f"| {' | '.join([*place_names(place), *cells])} |")
    print(
        "\nLevels at which all runs together decide that the prior is below Stage 1 and control, "
        "and below the\ncontrol: the 95 % interval of that level alone holds no zero.\n"
    )


def of_both(tables: Iterable[Iterable[pd.DataFrame]], found: list[Finished]) -> list[pd.DataFrame]:
    """The effects of all runs joined, to each reference that ``tables`` hold of a run."""
    seeds = len({run.made["seed"] for run in found})
    spread = max(spread_under(run.spread, CLEAN) for run in found)
    clean = [[table[table["condition"] == CLEAN] for table in each] for each in tables]
    return [joined(each, KEYS, seeds=seeds, spread=spread) for each in zip(*clean, strict=True)]


def lower(joint: list[pd.DataFrame], key: tuple) -> bool:
    return all(table.loc[key, "high"] < 0 for table in joint)


def heading(first: str, others: Iterable[str]) -> None:
    cells = list(others)
    print(f"{first} {' | '.join(cells)} |")
    print(f"|{'---|' * (3 + len(cells))}")


def place_names(place: tuple[str, str, str]) -> list[str]:
    return [OBJECTS[place[0]], display_name(trained_on(place[1])), display_name(place[2])]


def ends(percent: list[float]) -> str:
    """The least and the most of differences, in the order of their size."""
    low, high = min(percent), max(percent)
    first, last = (low, high) if low >= 0 else (high, low)
    return f"{signed(first)} to {signed(last)}"


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
