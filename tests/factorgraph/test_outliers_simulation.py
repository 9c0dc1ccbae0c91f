"""A tenth of all codes 5 to 40 m off: found, harmless to the baseline, and losses differ little in it."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from factorgraph.problem import Kernel, Robust
from factorgraph.registry import solve
from factorgraph.solution import Fix, Solution, Status
from factorgraph.types import Array, BoolArray
from scenarios.simulate import SimulatedFlight
from tests.factorgraph.test_batch_simulation import PAIR, flight_of, pair_flight, relative, true_baseline

SEEDS = range(30, 34)


@cache
def faulty(seed: int) -> tuple[SimulatedFlight, Solution]:
    """The flight of `pair_flight` of the same seed with outliers on top."""
    flight = flight_of(PAIR, 1.0, seed, gnss=", outlier_probability = 0.1, outlier_m = [5.0, 40.0]")
    return flight, solve(flight.problem)


def error(flight: SimulatedFlight, solution: Solution) -> Array:
    return relative(solution, "a", "b")[0] - true_baseline(flight, solution.pair("a", "b"))[0]


def differenced_codes(flight: SimulatedFlight, solution: Solution) -> tuple[BoolArray, BoolArray]:
    """Of every differenced code: whether either receiver's was off, and whether the solution noticed."""
    table = solution.residuals
    source = np.array([s.startswith("a-b") for s in table.source])[table.source_index]
    rows = np.flatnonzero(source & (table.kind_index == table.kind.index("code")))
    off = {}
    for name in "ab":
        antenna = flight.problem.vehicle(name).gnss
        assert antenna is not None
        s = antenna.stream
        size = flight.record.gnss[name].outlier_m
        for k in np.flatnonzero(size):
            off[s.satellites[s.sat[k]], round(float(s.t_s[s.epoch[k]]))] = True
    bad = np.array([(table.label[table.label_index[i]], round(float(table.t_s[i]))) in off for i in rows])
    return bad, np.array(table.outlier[rows] | (table.weight[rows] < 0.5))


def test_outliers_are_found() -> None:
    pairs = [differenced_codes(*faulty(seed)) for seed in SEEDS]
    bad, noticed = (np.concatenate(column) for column in zip(*pairs, strict=True))
    assert bad.sum() > 400
    assert np.mean(noticed[bad]) >= 0.98 and np.mean(noticed[~bad]) <= 0.03


def test_outliers_harm_the_baseline_little() -> None:
    with_outliers = np.concatenate([error(*faulty(seed)) for seed in SEEDS])
    without = np.concatenate([error(*pair_flight(1.0, seed)) for seed in SEEDS])
    assert np.sqrt(np.mean(with_outliers**2) / np.mean(without**2)) <= 1.1
    for seed in SEEDS:
        solution = faulty(seed)[1]
        assert solution.diagnostics.status is Status.CONVERGED
        assert np.all(solution.pair("a", "b").fix == Fix.FIXED.value)


@pytest.mark.parametrize("kernel", ["geman-mcclure", "tukey", "tls", "self-tuned"])
def test_other_losses_reach_the_same_baseline(kernel: Kernel) -> None:
    flight, default = faulty(SEEDS[0])
    settings = flight.problem.settings
    robust = {**settings.robust, "code": Robust(kernel, 5.0 if kernel == "tukey" else 3.0)}
    graduated = kernel == "tls"
    solution = solve(replace(flight.problem, settings=replace(settings, robust=robust, graduated=graduated)))
    assert solution.diagnostics.status is Status.CONVERGED
    np.testing.assert_allclose(solution.pair("a", "b").baseline_enu, default.pair("a", "b").baseline_enu, atol=3e-3)
    bad, noticed = differenced_codes(flight, solution)
    assert np.mean(noticed[bad]) >= 0.96 and np.mean(noticed[~bad]) <= 0.05
