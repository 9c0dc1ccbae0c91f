"""Headings that nobody tells: flights converge to one optimum, whatever heading they start from."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from factorgraph.alignment import Alignment
from factorgraph.assembly import attitudes
from factorgraph.assembly.variables import VehicleVariables
from factorgraph.attitude import exp_so3, log_so3, matrix_from_quat
from factorgraph.graphs.engine import GtsamEngine
from factorgraph.grid import common_grid
from factorgraph.models.receivers import receivers
from factorgraph.problem import NavigationProblem
from factorgraph.registry import solve
from factorgraph.sampling import interpolate
from factorgraph.solution import Status
from factorgraph.types import Array
from scenarios.simulate import simulate
from scenarios.simulate.scenario import parse

SCENARIO = """
[scenario]
name = "hover"
t0 = 2024-06-05T09:00:00
origin = {{ lat_deg = 45.0, lon_deg = 10.0, h_m = 150.0 }}
duration_s = {duration}

[[vehicle]]
name = "uav"
trajectory = {{ kind = "hover", r_n = [0.0, 0.0, 30.0], heading_deg = {heading}, turn_deg = 10.0, sway_m = {sway} }}
gnss = {{ lever_b = [0.0, -0.1, 0.12], {gnss} }}

[vehicle.imu]
rate_hz = 100.0
noise = {{ gyro_dps_rthz = 0.008, accel_ug_rthz = 120.0, gyro_bias_dps = 0.3, accel_bias_mg = 10.0 }}

[[vehicle]]
name = "base"
is_base = true
trajectory = {{ kind = "static", r_n = [20.0, 30.0, 1.0] }}
gnss = {{ {gnss} }}

[[link]]
reference = "base"
rover = "uav"
"""
GNSS = 'signals = ["G1C", "E1C"], noise = { elevation_mask_deg = 10.0 }'


def hovering(seed: int, heading_deg: float, duration_s: float = 40.0, sway_m: float = 0.5) -> NavigationProblem:
    text = SCENARIO.format(duration=duration_s, heading=heading_deg, sway=sway_m, gnss=GNSS)
    return simulate(parse(text), seed).problem


def true_attitudes(problem: NavigationProblem, t_s: Array) -> Array:
    truth = problem.vehicle("uav").truth
    assert truth is not None and truth.q_nb is not None
    return matrix_from_quat(truth.q_nb[np.clip(np.searchsorted(truth.t_s, t_s - 1e-6), 0, len(truth.t_s) - 1)])


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_hovering_vehicle_finds_its_heading(seed: int) -> None:
    rng = np.random.default_rng(seed)
    problem = hovering(seed, float(rng.uniform(-180, 180)))
    solution = solve(problem)
    assert solution.diagnostics.status is Status.CONVERGED
    path = solution.vehicle("uav")
    error = log_so3(matrix_from_quat(path.q_nb) @ np.swapaxes(true_attitudes(problem, path.t_s), 1, 2))
    sigma = np.sqrt(np.diagonal(path.P[:, 6:9, 6:9], axis1=1, axis2=2))
    assert np.degrees(np.abs(error[:, 2]).max()) < 6.0
    assert np.sqrt(np.mean((error / sigma) ** 2)) < 3.0


def test_a_declared_heading_that_is_hardly_believed_changes_nothing() -> None:
    problem = hovering(4, 30.0)
    plain = solve(problem).vehicle("uav")
    uav = problem.vehicle("uav")
    for heading in (-2.0, 2.5):
        declared = replace(uav, heading_hint_rad=heading, heading_sigma_rad=3.0)
        path = solve(replace(problem, vehicles=(declared, problem.vehicle("base")))).vehicle("uav")
        apart = log_so3(matrix_from_quat(path.q_nb) @ np.swapaxes(matrix_from_quat(plain.q_nb), 1, 2))
        sigma = np.sqrt(plain.P[:, 8, 8])
        assert np.abs(apart[:, 2] / sigma).max() < 0.3


@pytest.mark.parametrize("off_rad", [-2.0, 1.0, 3.1])
def test_several_starts_find_what_alignment_leaves_open(off_rad: float) -> None:
    problem = hovering(5, -70.0, 25.0)
    grid = common_grid(problem)
    rx = receivers(problem)
    bodies = [VehicleVariables(i, v, grid, problem.frame) for i, v in enumerate(problem.bodies)]
    uav = bodies[0]
    truth = uav.vehicle.truth
    assert truth is not None and truth.v_n is not None
    uav.r, uav.v = interpolate(grid, truth.t_s, truth.r_n), interpolate(grid, truth.t_s, truth.v_n)
    rough = [VehicleVariables(v.index, v.vehicle, grid, problem.frame, use_imu=False) for v in bodies]
    rough[0].r, rough[0].v = uav.r.copy(), uav.v.copy()
    C = true_attitudes(problem, grid)
    open_heading = Alignment(
        exp_so3(np.array([0.0, 0.0, off_rad])) @ C, np.zeros((len(grid), 6)), "levelling", np.array([0.03, 0.03, 3.0]), None
    )
    found = attitudes._compared(problem, uav, rough, rx, GtsamEngine, open_heading)
    assert found.way == "starts compared"
    assert np.abs(log_so3(found.C_nb @ np.swapaxes(C, 1, 2))[:, 2]).max() < 0.5


def test_no_starts_are_compared_at_rest() -> None:
    problem = hovering(6, 10.0, 25.0, 1e-4)
    solution = solve(problem)
    assert any("nothing tells the heading" in note for note in solution.diagnostics.notes)
    sigma = np.sqrt(solution.vehicle("uav").P[:, 8, 8])
    assert np.degrees(sigma.min()) > 20.0  # and the solution does not pretend
