"""Several runs taken together: against computations by hand, and by how often it is right."""

import numpy as np
import pandas as pd
import pytest
from scipy import stats

from dine.evaluation.repeats import joined

pytestmark = pytest.mark.numerical


def run(*relative, half=20.0):
    """Differences of a run, in percent, each with ± ``half``."""
    relative = np.array(relative, float)
    return pd.DataFrame(
        {
            "method": [f"m{i}" for i in range(len(relative))],
            "relative": relative,
            "low": relative - half,
            "high": relative + half,
        }
    )


def test_joined_by_hand():
    runs = [run(-30, -30), run(-32, 10), run(-28, -40)]
    found = joined(runs, ["method"], seeds=3, spread=0.05)
    np.testing.assert_allclose(found["mean"], [-30, -20])
    # Runs that agree: each interval holds the chance of pairs and of training, over three each.
    alike = 20 / np.sqrt(3)
    # Runs that do not: their own scatter is the larger.
    apart = stats.t.ppf(0.975, 2) * np.std([-30, 10, -40], ddof=1) / np.sqrt(3)
    np.testing.assert_allclose(found["high"] - found["mean"], [alike, apart])
    np.testing.assert_allclose(found["mean"] - found["low"], [alike, apart])


def test_runs_of_one_seed_share_their_pairs():
    runs = [run(-30), run(-30), run(-30), run(-30)]
    wide, narrow = (joined(runs, ["method"], seeds=seeds, spread=0.05).iloc[0] for seeds in (1, 4))
    training = 1.96 * 5
    pairs = np.sqrt(20**2 - training**2)
    np.testing.assert_allclose(wide["high"] + 30, np.hypot(pairs, training / 2))
    np.testing.assert_allclose(narrow["high"] + 30, 20 / 2)


def test_one_run_keeps_its_interval_and_a_missing_one_stays_missing():
    (alone,) = joined([run(-30)], ["method"], seeds=1, spread=0.05).itertuples(index=False)
    np.testing.assert_allclose(alone, (-30, -50, -10))
    blank = run(-30).assign(low=np.nan, high=np.nan)
    lone = joined([run(-30), blank], ["method"], seeds=2, spread=0.05).iloc[0]
    assert lone["mean"] == -30
    assert np.isnan(lone[["low", "high"]]).all()


@pytest.mark.parametrize(("pairs", "training"), [(10.0, 5.0), (1.0, 12.0), (10.0, 0.0)])
@pytest.mark.parametrize(("seeds", "each"), [(3, 1), (3, 2), (2, 3)])
def test_the_joint_interval_holds_the_truth_as_often_as_it_says(pairs, training, seeds, each):
    rng = np.random.default_rng(0)
    trials = 2000
    half = 1.96 * np.hypot(pairs, training)
    of_seed = np.repeat(rng.normal(0, pairs, (seeds, trials)), each, axis=0)
    relative = of_seed + rng.normal(0, training, (seeds * each, trials))
    found = joined(
        [run(*x, half=half) for x in relative], ["method"], seeds=seeds, spread=training / 100
    )
    held = ((found["low"] <= 0) & (found["high"] >= 0)).mean()
    # Two per cent are four standard deviations of that share; wider than said is no fault.
    assert held > 0.95 - 0.02
