"""Two antennas on one vehicle: position fixes of both, or raw observations with integers, with an IMU and without."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from factorgraph.assembly.build import build
from factorgraph.assembly.variables import VehicleVariables
from factorgraph.attitude import euler_from_matrix, exp_so3, log_so3, matrix_from_quat
from factorgraph.errors import InputError
from factorgraph.graphs.engine import GtsamEngine
from factorgraph.grid import common_grid
from factorgraph.interpolation import resample
from factorgraph.measurements import PositionStream
from factorgraph.models.compass import antenna_line
from factorgraph.models.receivers import receivers
from factorgraph.motion_imu import with_attitudes
from factorgraph.problem import Link, MotionPrior, NavigationProblem, Vehicle
from factorgraph.registry import solve
from factorgraph.solution import Fix, Solution, Status
from factorgraph.types import Array
from scenarios.flights import load
from scenarios.simulate import SimulatedFlight, simulate
from scenarios.simulate.scenario import parse
from scenarios.simulate.write import write_flight

LENGTH_M = 1.2
FRONT, BACK = (0.1, 0.7, 0.5), (0.1, -0.5, 0.5)
TRAJECTORY = {
    "rest": 'kind = "static", heading_deg = 75.0',
    "drive": 'kind = "manoeuvres", speed_mps = 10.0, heading_deg = 75.0, attitude = "level", '
    "segments = [{ duration_s = 10.0 }, { duration_s = 15.0, turn_dps = 5.0 }, { duration_s = 100.0 }]",
    "hover": 'kind = "hover", heading_deg = -120.0, turn_deg = 10.0',
}
IMU = (
    "imu = { rate_hz = 100.0, noise = { gyro_dps_rthz = 0.008, accel_ug_rthz = 120.0, gyro_bias_dps = 0.3, "
    "accel_bias_mg = 10.0, gyro_bias_walk_deg_h_rts = 2.0, accel_bias_walk_ug_rts = 10.0 } }"
)
SCENARIO = """
[scenario]
name = "antennas"
t0 = 2024-06-05T09:00:00
origin = {{ lat_deg = 45.0, lon_deg = 10.0, h_m = 150.0 }}
duration_s = 40.0

[[vehicle]]
name = "car"
trajectory = {{ {trajectory} }}
{imu}
gnss = {{ lever_b = {front}, {gnss} }}

[[vehicle]]
name = "back"
trajectory = {{ kind = "carried", carrier = "car" }}
gnss = {{ lever_b = {back}, {gnss} }}

[[vehicle]]
name = "base"
is_base = true
trajectory = {{ kind = "static", r_n = [30.0, -20.0, 2.0] }}
gnss = {{ {gnss} }}

[[link]]
reference = "car"
rover = "back"
"""
GNSS = 'signals = ["G1C", "E1C"], noise = { elevation_mask_deg = 10.0 }'


def flight(motion: str, imu: bool, seed: int, more: str = "") -> SimulatedFlight:
    text = SCENARIO.format(trajectory=TRAJECTORY[motion], imu=IMU if imu else "", front=list(FRONT), back=list(BACK), gnss=GNSS)
    return simulate(parse(text + more), seed)


@cache
def solved(motion: str, imu: bool) -> tuple[NavigationProblem, Solution]:
    problem = flight(motion, imu, 1).problem
    return problem, solve(problem)


def attitude_error(problem: NavigationProblem, solution: Solution) -> tuple[Array, Array]:
    """Rotation errors (K, 3) about east, north, up and their standard deviations."""
    path, truth = solution.vehicle("car"), problem.vehicle("car").truth
    assert truth is not None and truth.q_nb is not None
    at = np.clip(np.searchsorted(truth.t_s, path.t_s - 1e-6), 0, len(truth.t_s) - 1)
    error = log_so3(matrix_from_quat(path.q_nb) @ np.swapaxes(matrix_from_quat(truth.q_nb[at]), 1, 2))
    return error, np.sqrt(np.diagonal(path.P[:, 6:9, 6:9], axis1=1, axis2=2))


# -- raw observations ------------------------------------------------------------------------------


@pytest.mark.parametrize(("motion", "imu"), [("rest", True), ("drive", True), ("drive", False)])
def test_carrier_phase_between_two_antennas_gives_the_heading(motion: str, imu: bool) -> None:
    problem, solution = solved(motion, imu)
    assert solution.diagnostics.status is Status.CONVERGED
    assert [v.name for v in solution.vehicles] == ["car", "base"]
    (pair,) = solution.pairs
    assert np.mean(pair.fix == Fix.FIXED.value) > 0.95
    length = np.linalg.norm(pair.baseline_enu, axis=1)
    np.testing.assert_allclose(length, LENGTH_M, atol=1e-6)  # constant in the body
    assert pair.truth_enu is not None
    error = pair.baseline_enu - pair.truth_enu
    assert np.sqrt(np.mean(error**2, axis=0)).max() < 0.01
    angle, sigma = attitude_error(problem, solution)
    assert np.sqrt(np.mean(angle[:, 2] ** 2)) < np.deg2rad(0.5)
    assert np.sqrt(np.mean((angle[:, 2] / sigma[:, 2]) ** 2)) < 3.0


def test_the_start_heading_comes_from_the_antennas() -> None:
    assert any("by antennas" in note for note in solved("rest", True)[1].diagnostics.notes)


def test_a_pair_at_other_times_keeps_its_length() -> None:
    problem, solution = solved("drive", True)
    (pair,) = resample(solution, problem, 10.0).pairs
    np.testing.assert_allclose(np.linalg.norm(pair.baseline_enu, axis=1), LENGTH_M, atol=1e-4)
    turning = np.linalg.norm(pair.velocity_enu, axis=1)
    slope = np.linalg.norm(np.gradient(pair.baseline_enu, pair.t_s, axis=0), axis=1)
    assert np.abs(turning - slope)[2:-2].max() < 0.02


def test_a_base_and_both_antennas() -> None:
    """Links of either antenna to a base tie the same body; a pair may name any of the three."""
    more = '\n[[link]]\nreference = "base"\nrover = "car"\n[[pair]]\nreference = "base"\nrover = "back"\n'
    problem = flight("hover", True, 2, more).problem
    solution = solve(problem)
    (pair,) = solution.pairs
    assert pair.truth_enu is not None
    error = np.sqrt(np.mean((pair.baseline_enu - pair.truth_enu) ** 2, axis=0))
    assert error.max() < 0.02
    sigma = np.sqrt(np.diagonal(pair.P[:, :3, :3], axis1=1, axis2=2))
    assert sigma.max() < 0.05 and error.max() < 4 * sigma.max()


def test_an_epoch_tells_the_line_between_antennas() -> None:
    problem = flight("rest", True, 3).problem
    rx = receivers(problem)
    grid = common_grid(problem)
    line = antenna_line(rx["car"], rx["back"], problem.frame, "1", grid, np.zeros((len(grid), 3)))
    assert line is not None and len(line.t_s) > 30
    np.testing.assert_allclose(line.u_b, np.tile([0.0, -1.0, 0.0], (len(line.t_s), 1)), atol=1e-12)
    truth = problem.vehicle("car").truth
    assert truth is not None and truth.q_nb is not None
    angle = np.arccos(np.clip(line.u_n @ (matrix_from_quat(truth.q_nb[0]) @ [0.0, -1.0, 0.0]), -1, 1))
    assert np.degrees(np.median(angle)) < 0.7 and np.mean(np.degrees(angle) > 5) < 0.03
    assert line.sigma_rad.max() < 0.02


def test_an_antenna_line_of_the_wrong_length_is_hardly_believed() -> None:
    problem = flight("rest", True, 3).problem
    rx = receivers(problem)
    grid = common_grid(problem)
    back = replace(rx["back"], vehicle=replace(rx["back"].vehicle, gnss=replace(rx["back"].antenna, lever_b=(0.1, -1.2, 0.5))))
    line = antenna_line(rx["car"], back, problem.frame, "1", grid, np.zeros((len(grid), 3)))
    assert line is None or len(line.t_s) < 5


def test_jacobians_of_two_points_of_one_body() -> None:
    """Columns of the shared state are the sums of both ends', also where the receivers' epochs straddle a state."""
    problem = flight("hover", True, 4).problem
    grid = common_grid(problem)
    bodies = [VehicleVariables(i, v, grid, problem.frame) for i, v in enumerate(problem.bodies)]
    rng = np.random.default_rng(0)
    body = bodies[0]
    body.v[:] = rng.normal(0, 1.0, body.v.shape)
    body.R[:] = exp_so3(rng.normal(0, 1.0, (len(grid), 3)))
    block = build(problem, bodies, receivers(problem), use_phase=False, engine=GtsamEngine()).graph.gnss[0]
    assert block.reference is not None and block.rover.vehicle is block.reference.vehicle
    np.testing.assert_array_equal(block.rover.query.k, block.reference.query.k)
    for f in range(0, len(block.rows.factor.start), 7):
        assert len(set(block.keys(f))) == len(block.keys(f))
    block.predict()
    J, R, r, v = block.J.copy(), body.R.copy(), body.r.copy(), body.v.copy()
    assert J.shape[1] == 9 and np.abs(J[:, :3]).max() > 0.5
    h = 1e-3
    for column in range(9):
        y = []
        for sign in (-h, h):
            step = sign * np.eye(9)[column]
            body.R, body.r, body.v = R @ exp_so3(step[:3]), r + R @ step[3:6], v + step[6:]
            block.predict()
            y.append(block.y)
        np.testing.assert_allclose((y[0] - y[1]) / (2 * h), J[:, column], atol=1e-4)  # the Earth rate in a turned body: 7e-5


# -- position fixes --------------------------------------------------------------------------------


def test_fixes_of_two_antennas_without_an_imu() -> None:
    """A car in a figure of eight: fixes of 1 cm front and back give the heading to a degree."""
    t = np.arange(0.0, 60.0, 0.2)
    r = 30 * np.column_stack([np.sin(0.2 * t), np.sin(0.1 * t), np.zeros_like(t)])
    v = np.gradient(r, t, axis=0)
    heading = np.arctan2(v[:, 0], v[:, 1])
    ahead = np.column_stack([np.sin(heading), np.cos(heading), np.zeros_like(t)])
    rng = np.random.default_rng(1)

    def fixes(name: str, y: float) -> PositionStream:
        return PositionStream(t, r + y * ahead + rng.normal(0, 0.01, r.shape), np.full((len(t), 3), 0.01), (0.0, y, 0.0), name)

    car = Vehicle("car", positions=(fixes("front", 0.6), fixes("back", -0.436)), motion=MotionPrior((2.0, 2.0, 0.5)))
    problem = flight("rest", True, 1).problem
    solution = solve(replace(problem, vehicles=(car,), links=(), pairs=()))
    assert solution.diagnostics.status is Status.CONVERGED
    path = solution.vehicle("car")
    found = euler_from_matrix(matrix_from_quat(path.q_nb))[2]
    error = np.mod(found - np.interp(path.t_s, t, np.unwrap(heading)) + np.pi, 2 * np.pi) - np.pi
    sigma = np.sqrt(path.P[:, 8, 8])
    assert np.degrees(np.sqrt(np.mean(error**2))) < 0.95 and np.degrees(np.median(sigma)) < 0.95
    assert 0.5 < np.sqrt(np.mean((error / sigma)[5:-5] ** 2)) < 1.6
    assert np.sqrt(np.mean((path.r_n - np.column_stack([np.interp(path.t_s, t, axis) for axis in r.T])) ** 2)) < 0.01


def test_only_vehicles_with_two_antennas_get_an_attitude() -> None:
    problem = flight("drive", False, 1).problem
    changed = with_attitudes(problem)
    assert changed.vehicle("car").imu is not None and changed.vehicle("base").imu is None
    before, after = (p.vehicle("back").gnss for p in (problem, changed))
    assert before is not None and after is not None and after.noise.doppler_mps > before.noise.doppler_mps
    alone = replace(problem, vehicles=tuple(v for v in problem.vehicles if v.name != "back"), links=())
    assert with_attitudes(alone) is alone


# -- descriptions ----------------------------------------------------------------------------------


def test_a_written_flight_reads_back_with_its_carried_antenna(tmp_path: Path) -> None:
    written = flight("drive", True, 1)
    problem = load(write_flight(written, tmp_path / "flight")).problem
    back, car = problem.vehicle("back"), problem.vehicle("car")
    assert back.carrier == "car" and back.truth is None and back.gnss is not None and car.gnss is not None
    assert back.gnss.lever_b == BACK and car.gnss.lever_b == FRONT
    assert problem.links == (Link("car", "back"),)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"carrier": "van"}, "carrier van is no vehicle with states"),
        ({"carrier": "back"}, "carrier back is no vehicle with states"),
        ({"fixed_n": (0.0, 0.0, 0.0)}, "carries has gnss and no other sensor"),
        ({"gnss": None}, "carries has gnss and no other sensor"),
    ],
)
def test_antennas_that_cannot_be(change: dict[str, object], message: str) -> None:
    problem = flight("rest", True, 1).problem
    back = replace(problem.vehicle("back"), **change)  # type: ignore[arg-type]
    with pytest.raises(InputError, match=message):
        replace(problem, vehicles=tuple(back if v.name == "back" else v for v in problem.vehicles))
