"""Simulated cars and UAVs: what further sensors and constraints gain; states and sensor errors are consistent."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from factorgraph.attitude import log_so3, matrix_from_quat
from factorgraph.graphs.batch import Batch
from factorgraph.problem import Constraints, NavigationProblem, Vehicle
from factorgraph.sampling import interpolate
from factorgraph.solution import Solution, VehicleSolution
from factorgraph.types import Array
from scenarios.simulate import load_scenario, simulate
from scenarios.simulate.flight import SimulatedFlight, exact
from scenarios.simulate.scenario import Scenario, parse

SEEDS = range(300, 305)
BASE = """
[scenario]
name = "car"
origin = { lat_deg = 52.0, lon_deg = 5.0, h_m = 45.0 }
duration_s = 90.0

[[vehicle]]
name = "car"

[vehicle.trajectory]
kind = "manoeuvres"
attitude = "level"
heading_deg = 75.0
segments = [
    { duration_s = 8.0 },
    { duration_s = 8.0, accel_mps2 = 1.6 },
    { duration_s = 22.0, climb_mps = 0.2 },
    { duration_s = 9.0, turn_dps = -10.0 },
    { duration_s = 43.0, turn_dps = 2.0, climb_mps = -0.2 },
]

[vehicle.imu]
rate_hz = 50.0

[[vehicle.positions]]
rate_hz = 2.0
sigma_m = [0.05, 0.05, 0.08]
velocity_sigma_mps = [0.05, 0.05, 0.08]
lever_b = [0.2, 0.5, 1.4]
outages = [{ start_s = 30.0, end_s = 60.0 }]
"""
UAVS = """
[scenario]
name = "uavs"
origin = { lat_deg = 48.0, lon_deg = 11.0, h_m = 500.0 }
duration_s = 60.0

[[vehicle]]
name = "leader"
trajectory = { kind = "manoeuvres", speed_mps = 18.0, repeat = true, segments = [
    { duration_s = 10.0 }, { duration_s = 10.0, bank_deg = 25.0 }, { duration_s = 8.0, bank_deg = -20.0, climb_mps = 1.5 },
] }
imu = { rate_hz = 50.0 }
positions = [{ rate_hz = 2.0, lever_b = [0.0, 0.3, 0.1] }]

[[vehicle]]
name = "follower"
trajectory = { kind = "formation", leader = "leader", offset_m = [8.0, -25.0, 4.0], sway_m = 1.5 }
imu = { rate_hz = 50.0 }
positions = [{ rate_hz = 2.0 }]

[[vision]]
rate_hz = 4.0
observer = { name = "camera", vehicle = "follower", lever_b = [0.0, 0.4, 0.0] }
target = { name = "light", vehicle = "leader", lever_b = [0.0, -0.5, 0.2] }
ranges = true
sigma_deg = 0.3
sigma_m = 0.3
mounting_sigma_deg = 1.0
"""


def solve(problem: NavigationProblem) -> Solution:
    return Batch().solve(problem, lambda stage, fraction: None)


def flights(scenario: Scenario, seeds: range = SEEDS) -> list[SimulatedFlight]:
    known = exact(scenario, 0)
    return [simulate(scenario, seed, known) for seed in seeds]


def errors(v: VehicleSolution, at_s: float) -> tuple[Array, Array]:
    """Position, velocity and attitude errors (9,) at the state nearest to a time, and their covariance (9, 9)."""
    k = int(np.argmin(np.abs(v.t_s - at_s)))
    truth = v.truth
    assert truth is not None and truth.v_n is not None and truth.q_nb is not None
    t = v.t_s[k : k + 1]
    near = int(np.argmin(np.abs(truth.t_s - t[0])))
    turn = matrix_from_quat(v.q_nb[k]) @ matrix_from_quat(truth.q_nb[near]).T
    r, v_n = interpolate(t, truth.t_s, truth.r_n)[0], interpolate(t, truth.t_s, truth.v_n)[0]
    return np.concatenate([v.r_n[k] - r, v.v_n[k] - v_n, -log_so3(turn)]), v.P[k, :9, :9]


def assert_in_band(errs: list[tuple[Array, Array]], prob: float = 0.998) -> None:
    """The normalised errors of all trials at one time, summed, against chi-square, on both sides."""
    nees = sum(float(e @ np.linalg.solve(P, e)) for e, P in errs)
    low, high = chi2.interval(prob, sum(len(e) for e, _ in errs))
    assert low < nees < high, f"NEES sum {nees:.1f} outside [{low:.1f}, {high:.1f}]"


def estimates(solution: Solution, flight: SimulatedFlight) -> Array:
    """Errors of the estimated sensor constants over their standard deviations (m,)."""
    out = []
    for p in solution.diagnostics.parameters:
        sensor, what = p.name.split(" ", 1)
        if sensor in flight.record.sensors:
            record = flight.record.sensors[sensor]
            if what == "scale":
                true = record.scale
            else:
                true = float((record.bias if "iron" in what else record.mounting_rad)["xyz".index(what[-1])])
            out.append((p.value - true) / p.sigma)
    return np.array(out)


def without(v: Vehicle) -> Vehicle:
    return replace(v, velocities=(), attitudes=(), magnetics=(), heights=(), constraints=Constraints())


@pytest.mark.slow
def test_odometer_and_constraints_through_outages() -> None:
    """The built-in car: 30 s and 60 s without fixes, with and without odometer and constraints, the same seeds."""
    squares = []
    for flight in flights(load_scenario("car-outages"), range(300, 303)):
        (car,) = flight.problem.vehicles
        both = (flight.problem, replace(flight.problem, vehicles=(without(car),)))
        solutions = [solve(problem).vehicles[0] for problem in both]
        squares.append([[np.sum(errors(v, at)[0][:3] ** 2) for at in (65.0, 160.0)] for v in solutions])
    with_them, without_them = np.sqrt(np.mean(squares, axis=0))
    assert np.all(with_them < 0.7 * without_them) and np.all(with_them < 0.4)


@pytest.mark.slow
@pytest.mark.parametrize(
    "sensors",
    [
        "[[vehicle.velocities]]\nscale_sigma = 0.02\nsigma_mps = 0.05",
        '[[vehicle.velocities]]\naxes = "all"\nmounting_sigma_deg = 2.0\n[[vehicle.attitudes]]\nmounting_sigma_deg = 2.0',
        '[[vehicle.magnetometers]]\nbias_sigma = 10.0\n[[vehicle.attitudes]]\ntells = "heading"\n'
        '[[vehicle.heights]]\nname = "barometer"\nrate_hz = 2.0\nbias_sigma_m = 5.0\nbias_walk_m_rts = 0.05',
    ],
    ids=["odometer", "velocity and attitude", "magnetometer, compass, barometer"],
)
def test_states_and_constants_are_consistent(sensors: str) -> None:
    """NEES in its band inside the outage and outside, and errors of scales, mountings and hard iron within their sigma."""
    inside, outside, constants = [], [], []
    for flight in flights(parse(f"{BASE}\n{sensors}\n")):
        solution = solve(flight.problem)
        assert not solution.is_degraded
        inside.append(errors(solution.vehicles[0], 45.0))
        outside.append(errors(solution.vehicles[0], 75.0))
        constants.append(estimates(solution, flight))
    assert_in_band(inside)
    assert_in_band(outside)
    z = np.concatenate(constants)
    if len(z):
        low, high = chi2.interval(0.998, len(z))
        assert low < np.sum(z**2) < high
        assert np.abs(z).max() < 4.5


@pytest.mark.slow
def test_a_barometer_holds_the_height_through_an_outage() -> None:
    squares = []
    sensor = '[[vehicle.heights]]\nname = "barometer"\nrate_hz = 2.0\nsigma_m = 0.1\nbias_sigma_m = 5.0\nbias_walk_m_rts = 0.01'
    for flight in flights(parse(f"{BASE.replace('end_s = 60.0', 'end_s = 75.0')}\n{sensor}\n"), range(300, 303)):
        both = (flight.problem, replace(flight.problem, vehicles=(without(flight.problem.vehicles[0]),)))
        squares.append([errors(solve(p).vehicles[0], 52.0)[0][2] ** 2 for p in both])
    with_it, without_it = np.sqrt(np.mean(squares, axis=0))
    assert with_it < 0.5 * without_it


@pytest.mark.slow
def test_a_camera_between_two_uavs() -> None:
    """Two UAVs with single-point fixes: sight of each other makes their baseline, its own mounting is found, all consistent."""
    relative, absolute, constants, squares = [], [], [], []
    for flight in flights(parse(UAVS)):
        solution = solve(flight.problem)
        blind = solve(replace(flight.problem, visions=()))
        row = []
        for s in (solution, blind):
            pair = s.pair("leader", "follower")
            assert pair.truth_enu is not None
            k = int(np.argmin(np.abs(pair.t_s - 30.0)))
            error = pair.baseline_enu[k] - pair.truth_enu[k]
            row.append(float(error @ error))
            if s is solution:
                relative.append((error, pair.P[k, :3, :3]))
        squares.append(row)
        absolute.append(errors(solution.vehicles[1], 30.0))
        constants.append(estimates(solution, flight))
    seen, unseen = np.sqrt(np.mean(squares, axis=0))
    assert seen < 0.5 * unseen
    assert_in_band(relative)
    assert_in_band(absolute)
    assert np.abs(np.concatenate(constants)).max() < 4.5
