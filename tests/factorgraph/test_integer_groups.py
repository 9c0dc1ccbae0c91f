"""Integers of long flights: fixed in groups of neighbours in time, and the same as fixed all at once."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from factorgraph.assembly import integers
from factorgraph.assembly.integers import groups_in_time
from factorgraph.graphs import engine
from factorgraph.registry import solve
from factorgraph.solution import Solution
from scenarios.simulate import load_scenario, simulate
from scenarios.studies import replace_duration


def test_groups_hold_every_arc_once_and_neighbours_together() -> None:
    rng = np.random.default_rng(0)
    start = rng.uniform(0, 10_000, 700)
    end = start + rng.uniform(30, 600, 700)
    groups = groups_in_time(start, end)
    assert sorted(np.concatenate(groups).tolist()) == list(range(700))
    assert max(map(len, groups)) <= integers.GROUP and len(groups) == 5
    middle = 0.5 * (start + end)
    for before, after in pairwise(groups):
        assert middle[before].max() <= middle[after].min()


@pytest.mark.parametrize("n", [1, integers.GROUP])
def test_few_arcs_are_one_group(n: int) -> None:
    (group,) = groups_in_time(np.arange(float(n)), np.arange(float(n)) + 100.0)
    assert group.tolist() == list(range(n))


def slipping(seed: int) -> Solution:
    scenario = replace_duration(load_scenario("two-uav"), 150.0)
    vehicles = []
    for v in scenario.vehicle:
        assert v.gnss is not None
        vehicles.append(v.model_copy(update={"gnss": v.gnss.model_copy(update={"slips_per_hour": 120.0})}))
    problem = simulate(scenario.model_copy(update={"vehicle": tuple(vehicles)}), seed).problem
    return solve(problem)


def test_small_groups_and_nested_orders_find_the_same_integers(monkeypatch: pytest.MonkeyPatch) -> None:
    whole = slipping(1)
    monkeypatch.setattr(integers, "GROUP", 6)
    monkeypatch.setattr(engine, "MANY_AMBIGUITIES", 5)
    parts = slipping(1)
    assert len(whole.ambiguities.state) > 20 and whole.ambiguities.state.count("fixed") > 15
    np.testing.assert_array_equal(parts.ambiguities.integer, whole.ambiguities.integer)
    np.testing.assert_allclose(parts.pairs[0].baseline_enu, whole.pairs[0].baseline_enu, atol=1e-4)
    np.testing.assert_allclose(parts.pairs[0].P, whole.pairs[0].P, rtol=1e-3, atol=1e-9)
