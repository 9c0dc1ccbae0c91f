"""Integers held by switches: as good as constants where they are right, let go by themselves where they are wrong."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from ambiguity import partial
from factorgraph.assembly import integers, switches
from factorgraph.models.robust import weight
from factorgraph.problem import NavigationProblem
from factorgraph.registry import solve
from factorgraph.solution import Fix, Status
from tests.factorgraph.test_batch_simulation import assert_integers_are_true, pair_flight, relative, true_baseline


def switchable(problem: NavigationProblem) -> NavigationProblem:
    ambiguity = replace(problem.settings.ambiguity, hold="switchable")
    return replace(problem, settings=replace(problem.settings, ambiguity=ambiguity))


def test_switches_open_far_below_a_cycle_and_far_above_the_noise() -> None:
    off_cyc = np.array([0.0, 0.05, 0.1, 0.15, 0.25, 1.0])
    w = weight(switches.SWITCH, off_cyc / switches.SIGMA_CYC)
    assert np.all(w[:3] == 1) and w[3] < 0.5 and w[4] < 0.1 and w[5] < 1e-3


def test_right_integers_hold_as_constants_do() -> None:
    flight, constant = pair_flight(1.0, 12)
    solution = solve(switchable(flight.problem))
    assert solution.diagnostics.status is Status.CONVERGED
    assert_integers_are_true(flight, solution)
    pair, before = solution.pair("a", "b"), constant.pair("a", "b")
    assert np.all(pair.fix == Fix.FIXED.value) and "released" not in solution.ambiguities.state
    np.testing.assert_allclose(pair.baseline_enu, before.baseline_enu, atol=2e-3)
    trace = np.trace(pair.P[:, :3, :3], axis1=1, axis2=2) / np.trace(before.P[:, :3, :3], axis1=1, axis2=2)
    assert np.all((trace > 0.98) & (trace < 1.6))  # never surer than constants


@pytest.mark.parametrize("off", [1, -2])
def test_a_wrong_integer_is_let_go(monkeypatch: pytest.MonkeyPatch, off: int) -> None:
    """One integer of the first attempt is changed; all others stay where they are."""
    flight, _ = pair_flight(1.0, 12)
    fix, spoilt = partial.fix, []

    def spoil(*args: Any, **kwargs: Any) -> Any:
        result = fix(*args, **kwargs)
        if not spoilt and np.any(result.fixed):
            spoilt.append(int(np.flatnonzero(result.fixed)[2]))
            wrong = result.integers.copy()
            wrong[spoilt[0]] += off
            return replace(result, integers=wrong)
        return result

    monkeypatch.setattr(integers.partial, "fix", spoil)
    solution = solve(switchable(flight.problem))
    assert spoilt and solution.ambiguities.state.count("released") == 1
    assert_integers_are_true(flight, solution)
    pair = solution.pair("a", "b")
    assert np.abs(relative(solution, "a", "b")[0] - true_baseline(flight, pair)[0]).max() < 0.04
