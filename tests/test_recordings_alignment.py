"""Attitude on real recordings: no heading is given anywhere; two antennas of a car."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np

from factorgraph.attitude import euler_from_matrix, log_so3, matrix_from_quat
from factorgraph.measurements import ImuStream, PositionStream
from factorgraph.problem import NavigationProblem, Vehicle
from factorgraph.registry import solve
from factorgraph.solution import Solution, Status
from factorgraph.types import Array, BoolArray
from scenarios.flights import load
from tests.helpers import shared_data

LENGTH_M = 1.036  # between the antennas of the car in Tokyo


@cache
def problem_of(name: str, folder: str) -> NavigationProblem:
    return load(name, shared_data(folder).parent).problem


def part_of_fixes(s: PositionStream, keep: BoolArray) -> PositionStream:
    v_n, sigma = (None if x is None else x[keep] for x in (s.v_n, s.sigma_mps))
    return replace(s, t_s=s.t_s[keep], r_n=s.r_n[keep], sigma_m=s.sigma_m[keep], v_n=v_n, sigma_mps=sigma)


def part(problem: NavigationProblem, start_s: float, end_s: float) -> NavigationProblem:
    """Of a flight of vehicles with position fixes, some IMU samples more on either side."""

    def cut(v: Vehicle) -> Vehicle:
        positions = tuple(part_of_fixes(s, (s.t_s >= start_s) & (s.t_s <= end_s)) for s in v.positions)
        if v.imu is None:
            return replace(v, positions=positions)
        i = slice(*np.searchsorted(v.imu.t_s, [start_s - 1.0, end_s + 1.0]))
        return replace(v, positions=positions, imu=ImuStream(v.imu.t_s[i], v.imu.f_b[i], v.imu.w_b[i], v.imu.is_mean))

    return replace(problem, vehicles=tuple(cut(v) for v in problem.vehicles))


def attitude_at(solution: Solution, t_s: float) -> Array:
    (path,) = solution.vehicles
    k = int(np.argmin(np.abs(path.t_s - t_s)))
    assert abs(path.t_s[k] - t_s) < 0.02
    return matrix_from_quat(path.q_nb[k])


def test_a_pedestrians_attitude_converges_without_a_heading() -> None:
    """Two halves that share nothing but a fix agree on the attitude where they meet."""
    problem = problem_of("rtklibexplorer-walk", "gnss_imu_rtklibexplorer")
    whole = solve(problem)
    assert whole.diagnostics.status is Status.CONVERGED
    assert any("start heading by velocity changes" in note for note in whole.diagnostics.notes)
    (path,) = whole.vehicles
    sigma = np.degrees(np.sqrt(path.P[:, 8, 8]))
    assert sigma.max() < 1.0
    t_s = problem.vehicles[0].positions[0].t_s
    for middle in (40.0, 62.0, 92.0):
        at = float(t_s[np.argmin(np.abs(t_s - middle))])
        before, after = (solve(part(problem, *span)) for span in ((at - 30.0, at + 0.3), (at, at + 30.0)))
        apart = np.degrees(np.abs(log_so3(attitude_at(before, at) @ attitude_at(after, at).T)))
        assert apart[:2].max() < 1.0 and apart[2] < 5.0


@cache
def antennas() -> NavigationProblem:
    return part(problem_of("ixr-tokyo-antennas", "ixr_tokyo_car"), 0.0, 300.0)


def both_fixed(problem: NavigationProblem) -> Array:
    front, back = (problem.vehicle(name).positions[0].t_s for name in ("front", "back"))
    return np.intersect1d(np.round(front, 2), np.round(back, 2))


def at_times(t_s: Array, wanted_s: Array) -> Array:
    k = np.clip(np.searchsorted(t_s, wanted_s - 0.02), 0, len(t_s) - 1)
    return k[np.abs(t_s[k] - wanted_s) < 0.02]


def test_two_antennas_keep_their_distance() -> None:
    problem = antennas()
    solution = solve(problem)
    assert solution.diagnostics.status is Status.CONVERGED
    (pair,) = solution.pairs
    k = at_times(pair.t_s, both_fixed(problem))
    length = np.linalg.norm(pair.baseline_enu[k], axis=1)
    assert len(k) > 500
    assert np.sqrt(np.mean((length - LENGTH_M) ** 2)) <= 5e-3
    assert abs(np.mean(length) - LENGTH_M) < 3e-3


def test_two_antennas_on_one_car_give_its_heading() -> None:
    """Against the course while it drives, and against the line between two cars of one antenna each."""
    problem = antennas()
    back, front = (problem.vehicle(name).positions[0] for name in ("back", "front"))
    positions = (replace(back, name="back", lever_b=(0.0, -0.518, 0.0)), replace(front, name="front", lever_b=(0.0, 0.518, 0.0)))
    car = replace(problem.vehicle("front"), name="car", positions=positions)
    solution = solve(replace(problem, vehicles=(car,), pairs=()))
    assert solution.diagnostics.status is Status.CONVERGED
    path = solution.vehicle("car")
    heading = euler_from_matrix(matrix_from_quat(path.q_nb))[2]
    fast = np.linalg.norm(path.v_n[:, :2], axis=1) > 5.0
    off = np.degrees(wrapped(heading - np.arctan2(path.v_n[:, 0], path.v_n[:, 1])))[fast]
    assert len(off) > 50 and abs(np.median(off)) < 1.0 and np.median(np.abs(off)) < 1.0
    k = at_times(path.t_s, both_fixed(problem))
    assert np.degrees(np.median(np.sqrt(path.P[k, 8, 8]))) < 1.0
    pair = solve(problem).pairs[0]
    line = np.arctan2(pair.baseline_enu[:, 0], pair.baseline_enu[:, 1])[at_times(pair.t_s, path.t_s[k])]
    assert np.degrees(np.sqrt(np.mean(wrapped(heading[k] - line) ** 2))) < 0.5


def wrapped(angle: Array) -> Array:
    return np.asarray(np.mod(angle + np.pi, 2 * np.pi) - np.pi)
