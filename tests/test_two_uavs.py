"""The figure that sums up the toolkit: twenty simulated flights of two UAVs against truth and the Cramer-Rao bound.

200 s each by least squares, to be quick: the graph's optimum to 3e-8 m. The README has the graph's figures of ten minutes.
"""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import chi2

from scenarios import studies

SEEDS = range(1, 21)


@pytest.fixture(scope="module")
def trials() -> studies.Trials:
    return studies.run("two-uav", SEEDS, "least-squares", workers=2, duration_s=200.0)


@pytest.mark.slow
@pytest.mark.timeout(1200)
def test_errors_reach_the_bound(trials: studies.Trials) -> None:
    assert all(t.status == "converged" for t in trials.trials)
    assert trials.rmse_over_bound <= 1.1


@pytest.mark.slow
@pytest.mark.timeout(1200)
def test_integers_are_fixed_and_right(trials: studies.Trials) -> None:
    assert trials.fixed_share >= 0.99
    assert trials.wrong_share < 0.001


@pytest.mark.slow
@pytest.mark.timeout(1200)
def test_covariances_are_honest(trials: studies.Trials) -> None:
    """Across trials at one epoch, two-sided; of many epochs some 5 % may fall outside their own 95 % band."""
    sums = trials.nees_at(np.linspace(0.02, 0.98, 24))
    lo, hi = chi2.interval(0.95, 3 * len(trials.trials))
    assert np.mean((sums > lo) & (sums < hi)) >= 0.8
    # and all epochs together: their mean may not drift away to either side
    assert 0.8 < sums.mean() / (3 * len(trials.trials)) < 1.2
