"""What several runs of one configuration say together: other seeds, other CPUs."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas as pd
from scipy import stats


def joined(
    tables: Sequence[pd.DataFrame], keys: Sequence[str], *, seeds: int, spread: float
) -> pd.DataFrame:
    """The mean over runs of a difference, with an interval that holds all their chance.

    The 95 % interval is the wider of two about the mean of ``relative``:

    - of what the runs' own intervals hold, as independent: the chance of the pairs, whose mean
      variance shrinks with the number of ``seeds``, as runs of one seed share their pairs; and
      that of the training, ± 1.96 ``spread`` / √(number of runs);
    - of the runs' differences alone (Student's t).

    Args:
        tables: of each run, rows of :func:`dine.evaluation.statistics.comparisons` or of a part of
            them, made with the same ``spread``.
        keys: columns that tell a table's rows apart.
        seeds: how many seeds, and so sets of data, the runs have.
        spread: standard deviation over trainings, as a share of the reference's mean.

    Returns:
        ``mean``, ``low`` and ``high``, in percent of the reference's mean, by ``keys``. One run
        leaves its own interval; where a run has none, neither has the whole.
    """
    rows = pd.concat(tables)
    chance = (100 * spread) ** 2
    variance = ((rows["high"] - rows["low"]) / (2 * 1.96)) ** 2
    groups = rows.assign(pairs=(variance - chance).clip(lower=0)).groupby(list(keys), sort=False)
    count = groups.size()
    of_pairs = groups["pairs"].agg(lambda x: x.mean(skipna=False)) / seeds
    own = 1.96 * np.sqrt(of_pairs + chance / count)
    freedom = (count - 1).where(count > 1)
    between = stats.t.ppf(0.975, freedom) * groups["relative"].std(ddof=1) / np.sqrt(count)
    half = np.where(own.isna(), np.nan, np.fmax(own, between))
    mean = groups["relative"].mean()
    return pd.DataFrame({"mean": mean, "low": mean - half, "high": mean + half})
