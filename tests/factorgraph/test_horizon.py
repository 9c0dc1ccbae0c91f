"""The moving horizon: what leaves the window is not lost, bounds hold, integers condition what is put out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from factorgraph.assembly.flight import WholeFlight
from factorgraph.errors import InputError
from factorgraph.gpstime import GpsTime
from factorgraph.least_squares.engine import StageEngine
from factorgraph.least_squares.horizon import Bounds, Horizon, HorizonSettings, MovingHorizon
from factorgraph.measurements import Calibration, HeightStream
from factorgraph.problem import NavigationProblem, Vehicle
from factorgraph.registry import solve
from factorgraph.solution import Fix, Solution, Status
from tests.factorgraph.synthetic import FRAME
from tests.factorgraph.test_agreement import linear_problem
from tests.factorgraph.test_batch_simulation import pair_flight, relative, true_baseline
from tests.helpers import assert_consistent


def run(problem: NavigationProblem, settings: HorizonSettings | None = None) -> Solution:
    return Horizon(settings).solve(problem, lambda stage, fraction: None)


def window_of(problem: NavigationProblem, settings: HorizonSettings) -> MovingHorizon:
    built, _, _ = WholeFlight("moving-horizon", StageEngine).started(problem, lambda stage, fraction: None)
    return MovingHorizon(built.graph, settings, problem.settings.robust, problem.settings.ambiguity)


@pytest.mark.parametrize("window_s", [3.0, 12.0])
def test_on_linear_problems_the_newest_state_knows_the_whole_past(window_s: float) -> None:
    """The arrival cost is exact: the last state and its covariance are those of the whole flight."""
    problem = linear_problem(3)
    batch, windowed = solve(problem), run(problem, HorizonSettings(window_s))
    for x, y in zip(batch.vehicles, windowed.vehicles, strict=True):
        np.testing.assert_allclose(y.r_n[-1], x.r_n[-1], rtol=0, atol=1e-7)
        np.testing.assert_allclose(y.v_n[-1], x.v_n[-1], rtol=0, atol=1e-7)
        np.testing.assert_allclose(y.P[-1, :6, :6], x.P[-1, :6, :6], rtol=0, atol=1e-7)
        assert np.abs(y.r_n[5] - x.r_n[5]).max() > 0.01  # the past did not know the future


def with_barometer() -> NavigationProblem:
    """Heights of one vehicle with a bias that walks."""
    problem = linear_problem(4)
    t = np.arange(0.0, 39.5, 0.5)
    rng = np.random.default_rng(4)
    up = np.interp(t, problem.vehicles[0].positions[0].t_s, problem.vehicles[0].positions[0].r_n[:, 2])
    z, calibration = up + 3.0 + rng.normal(0, 0.3, len(t)), Calibration(bias=5.0, bias_walk=0.3)
    heights = HeightStream(t, z, np.full(len(t), 0.3), calibration=calibration)
    return replace(problem, vehicles=(replace(problem.vehicles[0], heights=(heights,)), problem.vehicles[1]))


def test_a_bias_that_walks_keeps_what_it_knew_when_nodes_leave() -> None:
    """Nodes enter and leave with the window."""
    problem = with_barometer()
    batch, windowed = solve(problem), run(problem, HorizonSettings(8.0))
    np.testing.assert_allclose(windowed.vehicles[0].r_n[-1], batch.vehicles[0].r_n[-1], rtol=0, atol=1e-5)
    np.testing.assert_allclose(windowed.vehicles[0].P[-1, :6, :6], batch.vehicles[0].P[-1, :6, :6], rtol=1e-4, atol=1e-6)


def test_a_flight_is_followed_to_the_centimetre() -> None:
    """From a few seconds on all integers are fixed; errors fit their covariance; the end is where the smoother is."""
    flight, batch = pair_flight(1.0, 10)
    windowed = run(flight.problem)
    pair = windowed.pair("a", "b")
    error = relative(windowed, "a", "b")[0] - true_baseline(flight, pair)[0]
    late = pair.t_s > 15.0
    assert np.all(pair.fix[late] == Fix.FIXED.value)
    assert np.abs(error[late]).max() < 0.04
    chosen = np.flatnonzero(late)[::5]  # apart in time
    assert_consistent(error[chosen], pair.P[chosen, :3, :3])
    sigma = np.sqrt(np.diagonal(pair.P[-1])[:3])
    assert np.all(np.abs(pair.baseline_enu[-1] - batch.pair("a", "b").baseline_enu[-1]) < sigma)
    assert np.allclose(sigma, np.sqrt(np.diagonal(batch.pair("a", "b").P[-1])[:3]), rtol=0.15)
    assert any("steps of the window" in note for note in windowed.diagnostics.notes)


def test_short_windows_forget_nothing() -> None:
    """The covariance of the absolute position, which body axes that turn would eat away, is that of a window over everything."""
    flight, _ = pair_flight(1.0, 10)
    short, long = run(flight.problem, HorizonSettings(6.0)), run(flight.problem, HorizonSettings(100.0))
    sigma = [np.sqrt(np.diagonal(s.vehicle("a").P, axis1=1, axis2=2)[:, :9]) for s in (short, long)]
    np.testing.assert_allclose(sigma[0][20:], sigma[1][20:], rtol=0.05)
    off = (short.vehicle("a").r_n - long.vehicle("a").r_n)[20:]
    assert np.sqrt(np.mean((off / sigma[1][20:, :3]) ** 2)) < 0.1


def test_bounds_hold_and_let_go() -> None:
    """Accelerometer biases kept within less than they are; wide bounds change nothing."""
    flight, _ = pair_flight(1.0, 10)
    free = run(flight.problem)
    largest = max(float(np.abs(v.bias_accel).max()) for v in free.vehicles)
    limit = 0.4 * largest
    held = run(flight.problem, HorizonSettings(iterations=2, bounds=Bounds(accel_bias_mps2=limit)))
    late = held.vehicles[0].t_s > 20.0
    assert max(float(np.abs(v.bias_accel[late]).max()) for v in held.vehicles) < limit + 2e-3
    assert np.any([np.isclose(np.abs(v.bias_accel[late]), limit, atol=2e-3).any() for v in held.vehicles])
    wide = run(flight.problem, HorizonSettings(bounds=Bounds(accel_bias_mps2=100.0, gyro_bias_rps=10.0, height_m=(-1e4, 1e4))))
    np.testing.assert_array_equal(wide.vehicles[0].r_n, free.vehicles[0].r_n)


def test_heights_stay_inside_their_bounds() -> None:
    problem = linear_problem(5)
    free = max(float(v.r_n[:, 2].max()) for v in run(problem, HorizonSettings(10.0)).vehicles)
    bounds = Bounds(height_m=(-np.inf, free - 0.5))
    held = run(problem, HorizonSettings(10.0, iterations=3, bounds=bounds))
    assert free - 0.6 < max(float(v.r_n[:, 2].max()) for v in held.vehicles) < free - 0.5 + 1e-3


def test_what_nothing_determines_is_named() -> None:
    t = np.arange(0.0, 20.0)
    vehicle = Vehicle("a", heights=(HeightStream(t, np.sin(t), np.full(20, 0.3)),))
    problem = NavigationProblem("heights", GpsTime(2300, 0.0), FRAME, (vehicle,))
    window = window_of(problem, HorizonSettings(5.0))
    window.arrival.clear()  # without the weak prior of the first state
    with pytest.raises(InputError, match=r"of a at 0\.00 s"):
        window.step()


def test_a_window_that_leaves_its_measurements_says_so() -> None:
    """Fixes that jump by a kilometre: no motion follows them."""
    problem = linear_problem(7)
    a, b = problem.vehicles
    wild = a.positions[0].r_n + np.random.default_rng(7).normal(0.0, 1000.0, a.positions[0].r_n.shape)
    problem = replace(problem, vehicles=(replace(a, positions=(replace(a.positions[0], r_n=wild),)), b))
    solution = run(problem)
    assert solution.diagnostics.status is Status.DIVERGED
    assert any("sigma" in warning and "a/" in warning for warning in solution.diagnostics.warnings)
    assert any("left its measurements" in note for note in solution.diagnostics.notes)


def test_the_end_of_the_flight_is_told() -> None:
    window = window_of(linear_problem(6), HorizonSettings(5.0))
    for _ in window.t_s:
        window.step()
    with pytest.raises(InputError, match="the flight ends"):
        window.step()
