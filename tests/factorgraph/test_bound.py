"""The posterior Cramer-Rao bound: what the smoother's own covariance says, taken at the truth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from factorgraph.bound import posterior_bound
from factorgraph.errors import InputError
from tests.factorgraph.test_batch_simulation import pair_flight, true_baseline


def test_the_bound_is_the_smoothers_covariance_at_the_truth() -> None:
    flight, solution = pair_flight(1.0, 10)
    bound = posterior_bound(flight.problem)
    pair = solution.pair("a", "b")
    np.testing.assert_array_equal(bound.t_s, pair.t_s)
    P, Q = bound.pairs["a", "b"], pair.P
    ratio = np.sqrt(np.diagonal(Q, axis1=1, axis2=2) / np.diagonal(P, axis1=1, axis2=2))
    assert 0.98 < np.median(ratio) < 1.1  # robust weights take a little of what the bound counts
    error = np.linalg.norm(pair.baseline_enu - true_baseline(flight, pair)[0], axis=1)
    assert np.sqrt(np.mean(error**2)) < 1.5 * np.sqrt(np.mean(np.trace(P[:, :3, :3], axis1=1, axis2=2)))
    assert set(bound.vehicles) == {"a", "b"}
    sigma = np.sqrt(np.diagonal(bound.vehicles["a"], axis1=1, axis2=2))
    assert np.isfinite(sigma).all() and (sigma[:, 6:8] < 0.02).all()  # level to a degree


def test_float_ambiguities_cost() -> None:
    flight, _ = pair_flight(1.0, 10)
    fixed, free = posterior_bound(flight.problem), posterior_bound(flight.problem, integers_known=False)
    trace = [np.trace(b.pairs["a", "b"][:, :3, :3], axis1=1, axis2=2) for b in (fixed, free)]
    assert (trace[1] > 2 * trace[0]).all()


def test_no_bound_without_truth() -> None:
    flight, _ = pair_flight(1.0, 10)
    a, *others = flight.problem.vehicles
    with pytest.raises(InputError, match="true position, velocity and attitude of a"):
        posterior_bound(replace(flight.problem, vehicles=(replace(a, truth=None), *others)))
