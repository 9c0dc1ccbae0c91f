"""The whole estimator on short simulated flights: exact without noise, consistent with it, whatever the vehicles are."""

from __future__ import annotations

import gc
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from factorgraph.assembly.blocks import Block
from factorgraph.attitude import log_so3, matrix_from_quat
from factorgraph.problem import Link, NavigationProblem
from factorgraph.registry import solve
from factorgraph.solution import POS, Fix, PairSolution, Solution, Status
from factorgraph.types import Array
from scenarios.simulate import SimulatedFlight, load_scenario, simulate
from scenarios.simulate.scenario import parse
from scenarios.studies import replace_duration
from tests.helpers import assert_consistent

INFO = """
[scenario]
name = "pair"
t0 = 2024-06-05T09:00:00
origin = {{ lat_deg = 45.0, lon_deg = 10.0, h_m = 150.0 }}
duration_s = 65.0
noise_scale = {noise}
"""
LEADER = """
[[vehicle]]
name = "a"
gnss = {{ lever_b = [0.02, -0.25, 0.12], signals = ["G1C", "E1C"]{gnss} }}
{imu}
[vehicle.trajectory]
kind = "manoeuvres"
start_n = [-400.0, -600.0, 120.0]
speed_mps = 22.0
heading_deg = 20.0
repeat = true
segments = [
    {{ duration_s = 12.0, turn_dps = 6.0 }},
    {{ duration_s = 10.0, climb_mps = 0.8, accel_mps2 = 0.2 }},
    {{ duration_s = 14.0, turn_dps = -7.0, accel_mps2 = -0.2 }},
]
"""
FOLLOWER = """
[[vehicle]]
name = "b"
gnss = {{ lever_b = [-0.03, -0.22, 0.10], signals = ["G1C", "E1C"]{gnss} }}
{imu}
[vehicle.trajectory]
kind = "formation"
leader = "a"
offsets = [{{ t_s = 10.0, offset_m = [25.0, -30.0, 5.0] }}, {{ t_s = 55.0, offset_m = [-10.0, -25.0, 8.0] }}]
"""
BASE = """
[[vehicle]]
name = "base"
is_base = true
trajectory = {{ kind = "static", r_n = [300.0, -900.0, 2.0] }}
gnss = {{ lever_b = [0.0, 0.0, 1.5], signals = ["G1C", "E1C"]{gnss} }}
"""
RANGES = """
[[range]]
rate_hz = 5.0
offset_s = 0.03
tags = [
    {{ name = "ta", vehicle = "a", lever_b = [0.0, -0.4, -0.05] }},
    {{ name = "tb", vehicle = "b", lever_b = [0.0, 0.35, -0.05] }},
]
"""
IMU = "imu = { rate_hz = 100.0 }"
PAIR = LEADER + FOLLOWER + RANGES + '[[link]]\nreference = "a"\nrover = "b"\n'
WITH_BASE = BASE + LEADER + '[[link]]\nreference = "base"\nrover = "a"\n'


def flight_of(text: str, noise: float, seed: int, imu: str = IMU, gnss: str = "") -> SimulatedFlight:
    return simulate(parse((INFO + text).format(noise=noise, imu=imu, gnss=gnss)), seed)


@cache
def pair_flight(noise: float, seed: int) -> tuple[SimulatedFlight, Solution]:
    flight = flight_of(PAIR, noise, seed)
    return flight, solve(flight.problem)


def true_baseline(flight: SimulatedFlight, pair: PairSolution) -> tuple[Array, Array]:
    """Baseline and relative velocity in n; over these distances east-north-up at the reference differs by 1e-4 rad."""
    a, b = (flight.record.trajectories[name].at(pair.t_s) for name in (pair.reference, pair.rover))
    return b.r_n - a.r_n, b.v_n - a.v_n


def relative(solution: Solution, a: str, b: str) -> tuple[Array, Array]:
    x, y = solution.vehicle(a), solution.vehicle(b)
    return y.r_n - x.r_n, y.v_n - x.v_n


def assert_integers_are_true(flight: SimulatedFlight, solution: Solution) -> None:
    """Every fixed arc's first integer against that of the datum arc of its group, from the record's own integers."""
    table = solution.ambiguities
    found: dict[tuple[str, str], list[tuple[float, float]]] = {}
    for i, state in enumerate(table.state):
        if state not in ("fixed", "datum"):
            continue
        link, signal = table.link[i], table.signal[i]
        true = 0
        for name, sign, own in zip(link.split("-"), (-1, 1), signal.split("/"), strict=True):
            antenna = flight.problem.vehicle(name).gnss
            assert antenna is not None
            s = antenna.stream
            mine = np.flatnonzero((s.sat == s.satellites.index(table.satellite[i])) & (s.signal == s.signals.index(own)))
            at = mine[np.argmin(np.abs(s.t_s[s.epoch[mine]] - table.t_start_s[i]))]
            true += sign * int(flight.record.gnss[name].integer[at])
        found.setdefault((link, signal), []).append((table.integer[i], true))
    assert found
    for group in found.values():
        difference = np.array([estimate - true for estimate, true in group])
        np.testing.assert_array_equal(difference, difference[0])


# -- without noise ---------------------------------------------------------------------------------


def test_without_noise_two_vehicles_are_where_they_are() -> None:
    """Clocks, integers, atmosphere and satellites are there all the same."""
    flight, solution = pair_flight(0.0, 3)
    pair = solution.pair("a", "b")
    assert solution.diagnostics.status is Status.CONVERGED and not solution.diagnostics.warnings
    assert np.all(pair.fix == Fix.FIXED.value) and len(pair.t_s) >= 60
    baseline, velocity = true_baseline(flight, pair)
    r, v = relative(solution, "a", "b")
    np.testing.assert_allclose(r, baseline, atol=1e-4)
    np.testing.assert_allclose(v, velocity, atol=1e-4)
    assert pair.truth_enu is not None
    np.testing.assert_allclose(pair.baseline_enu, pair.truth_enu, atol=1e-4)
    assert_integers_are_true(flight, solution)
    for name in "ab":
        vehicle, truth = solution.vehicle(name), flight.record.trajectories[name].at(pair.t_s)
        # undifferenced Doppler leaves out second-order terms: 2 mm/s, a decimetre over the flight
        np.testing.assert_allclose(vehicle.r_n, truth.r_n, atol=0.2)
        assert np.abs(log_so3(np.swapaxes(truth.C_nb, 1, 2) @ matrix_from_quat(vehicle.q_nb))).max() < 2e-3
        assert np.abs(vehicle.bias_gyro).max() < 1e-5 and np.abs(vehicle.bias_accel).max() < 0.02


def test_residuals_vanish_without_noise() -> None:
    _, solution = pair_flight(0.0, 3)
    table = solution.residuals
    assert set(table.kind[i] for i in np.unique(table.kind_index)) >= {"code", "phase", "doppler", "range"}
    assert np.abs(table.residual / table.sigma).max() < 0.2 and not np.any(table.outlier)
    assert table.weight.min() > 0.98


def test_a_static_base_is_a_reference_as_any_other() -> None:
    flight = flight_of(WITH_BASE, 0.0, 4)
    solution = solve(flight.problem)
    base, a = solution.vehicle("base"), solution.vehicle("a")
    pair = solution.pair("base", "a")
    truth = flight.record.trajectories["a"].at(pair.t_s)
    assert np.all(pair.fix == Fix.FIXED.value)
    np.testing.assert_allclose(a.r_n, truth.r_n, atol=2e-4)
    np.testing.assert_array_equal(base.r_n, np.tile(flight.problem.vehicle("base").fixed_n or (), (len(pair.t_s), 1)))
    assert not np.any(base.P[:, :6, :6])
    np.testing.assert_allclose(pair.P[:, 0, 0] + pair.P[:, 1, 1], a.P[:, 0, 0] + a.P[:, 1, 1], rtol=1e-3)


@pytest.mark.parametrize("without", ["b", "ab"])
def test_vehicles_without_imu_move_by_their_prior(without: str) -> None:
    """Their solution is the antenna; phases hold it at every epoch."""
    flight = flight_of(PAIR, 0.0, 5)
    problem = _without_imu(flight.problem, without)
    solution = solve(problem)
    pair = solution.pair("a", "b")
    assert np.all(pair.fix == Fix.FIXED.value)
    true = []
    for name in "ab":
        antenna = problem.vehicle(name).gnss
        assert antenna is not None
        motion = flight.record.trajectories[name].at(pair.t_s)
        true.append(motion.point(antenna.lever_b)[0] if name in without else motion.r_n)
    r, _ = relative(solution, "a", "b")
    np.testing.assert_allclose(r, true[1] - true[0], atol=5e-3)
    for name in without:
        assert np.all(np.isnan(solution.vehicle(name).q_nb)) and np.all(np.isfinite(solution.vehicle(name).P[:, POS, POS]))


def _without_imu(problem: NavigationProblem, names: str) -> NavigationProblem:
    """Ranges go as well: a vehicle without attitude cannot place its tags."""
    vehicles = tuple(replace(v, imu=None) if v.name in names else v for v in problem.vehicles)
    return replace(problem, vehicles=vehicles, ranges=())


# -- with noise ------------------------------------------------------------------------------------

SEEDS = range(10, 18)


def test_noisy_flights_are_fixed_right_and_consistent() -> None:
    """Errors of baseline and relative velocity across trials against their covariance, at three epochs."""
    errors, covariances = [], []
    for seed in SEEDS:
        flight, solution = pair_flight(1.0, seed)
        pair = solution.pair("a", "b")
        assert solution.diagnostics.status is Status.CONVERGED
        assert np.all(pair.fix == Fix.FIXED.value), seed
        assert_integers_are_true(flight, solution)
        error = np.hstack([x - y for x, y in zip(relative(solution, "a", "b"), true_baseline(flight, pair), strict=True)])
        assert np.abs(error[:, :3]).max() < 0.04
        errors.append(error)
        covariances.append(pair.P)
    for k in (3, 32, 60):
        assert_consistent(np.array([e[k] for e in errors]), np.array([P[k] for P in covariances]))
    sigma = np.sqrt(np.array([P[32, 0, 0] for P in covariances]))
    assert np.all((sigma > 5e-4) & (sigma < 0.01))  # centimetre receivers, smoothed


def test_measurements_of_noisy_flights_fit() -> None:
    """Whole-flight NIS against its degrees of freedom, pooled over the trials."""
    total = sum(float(np.sum(pair_flight(1.0, s)[1].diagnostics.nis)) for s in SEEDS)
    dof = sum(float(np.sum(pair_flight(1.0, s)[1].diagnostics.nis_dof)) for s in SEEDS)
    # robust weights take a little from the tails; chi-square's own spread is below one percent
    assert 0.9 < total / dof < 1.05
    outliers = np.mean([np.mean(pair_flight(1.0, s)[1].residuals.outlier) for s in SEEDS])
    assert outliers < 1e-3


def swapped(problem: NavigationProblem) -> NavigationProblem:
    return replace(problem, links=tuple(Link(k.rover, k.reference) for k in problem.links))


@pytest.mark.parametrize("seed", [10, 11])
def test_roles_may_be_swapped(seed: int) -> None:
    """Differences know no direction: the same baseline, well within its noise, without undifferenced rows of the reference."""
    flight, _ = pair_flight(1.0, seed)
    problem = replace(flight.problem, settings=replace(flight.problem.settings, use_absolute=False))
    one, other = solve(problem), solve(swapped(problem))
    ab, ba = one.pair("a", "b"), other.pair("b", "a")
    np.testing.assert_array_equal(ab.t_s, ba.t_s)
    r, v = relative(one, "a", "b")
    r2, v2 = relative(other, "a", "b")
    # nothing absolute is measured: what tilts and places the reference comes from its start, which the roles change
    sigma = np.sqrt(np.diagonal(ab.P, axis1=1, axis2=2))
    change = np.abs(np.hstack([r2 - r, v2 - v])) / sigma
    assert change.max() < 0.3
    assert np.sqrt(np.mean(change**2)) < 0.1
    np.testing.assert_allclose(np.diagonal(ba.P, axis1=1, axis2=2), np.diagonal(ab.P, axis1=1, axis2=2), rtol=0.35)
    np.testing.assert_array_equal(ab.fix, ba.fix)
    # nothing absolute in the solution is no worse baseline: the start needs it all the same
    assert np.abs(r - true_baseline(flight, ab)[0]).max() < 0.04


def test_roles_with_undifferenced_rows_differ_within_noise() -> None:
    """The reference's code and Doppler are used, not the rover's: velocities and with them attitudes differ a little."""
    flight, solution = pair_flight(1.0, 10)
    other = solve(swapped(flight.problem))
    ab, ba = solution.pair("a", "b"), other.pair("b", "a")
    sigma = np.sqrt(np.diagonal(ab.P, axis1=1, axis2=2))
    change = np.hstack([x - y for x, y in zip(relative(other, "a", "b"), relative(solution, "a", "b"), strict=True)]) / sigma
    assert np.sqrt(np.mean(change**2)) < 0.3
    np.testing.assert_allclose(ba.baseline_enu, -ab.baseline_enu, atol=5e-3)
    np.testing.assert_allclose(np.diagonal(ba.P, axis1=1, axis2=2), np.diagonal(ab.P, axis1=1, axis2=2), rtol=0.05)


def test_slips_flagged_or_not_leave_the_baseline() -> None:
    """About one slip of every satellite, half of them unannounced."""
    flight = flight_of(PAIR, 1.0, 21, gnss=", slips_per_hour = 60.0, lli_probability = 0.5")
    slips = [s for record in flight.record.gnss.values() for s in record.slips]
    assert len(slips) >= 5 and {s.flagged for s in slips} == {True, False}
    solution = solve(flight.problem)
    pair = solution.pair("a", "b")
    assert np.mean(pair.fix == Fix.FIXED.value) > 0.9
    assert_integers_are_true(flight, solution)
    assert np.abs(relative(solution, "a", "b")[0] - true_baseline(flight, pair)[0]).max() < 0.05


def test_gross_code_errors_are_found_and_harmless() -> None:
    flight = flight_of(PAIR, 1.0, 22, gnss=", outlier_probability = 0.02")
    solution = solve(flight.problem)
    pair = solution.pair("a", "b")
    assert np.all(pair.fix == Fix.FIXED.value)
    assert np.abs(relative(solution, "a", "b")[0] - true_baseline(flight, pair)[0]).max() < 0.05
    put_in = sum(int(np.sum(np.abs(record.outlier_m) > 0)) for record in flight.record.gnss.values())
    found = int(np.sum(solution.residuals.outlier & (solution.residuals.kind_index == solution.residuals.kind.index("code"))))
    assert put_in > 10 and 0.7 * put_in < found < 1.5 * put_in


def test_the_same_problem_gives_the_same_solution() -> None:
    flight, solution = pair_flight(1.0, 11)
    again = solve(flight.problem)
    np.testing.assert_allclose(again.pair("a", "b").baseline_enu, solution.pair("a", "b").baseline_enu, atol=1e-9)


def test_a_solved_graph_is_freed() -> None:
    """Factors made in Python refer to nothing that refers to them: memory of many solutions does not add up."""

    def living_blocks() -> int:
        gc.collect()
        return sum(isinstance(o, Block) for o in gc.get_objects())

    problem = simulate(replace_duration(load_scenario("two-uav"), 10.0), 1).problem
    before = living_blocks()
    solve(problem, "graph")
    assert living_blocks() == before
