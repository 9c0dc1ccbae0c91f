"""Inertial navigation on recordings: what is left of a trajectory where position and velocity fixes are withheld."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.interpolate import CubicHermiteSpline

from factorgraph.attitude import matrix_from_quat
from factorgraph.graphs.batch import Batch
from factorgraph.measurements import PositionStream
from factorgraph.problem import Constraints, NavigationProblem
from factorgraph.sampling import interpolate
from factorgraph.solution import Solution
from factorgraph.types import Array, BoolArray
from scenarios.flights import load
from tests.helpers import shared_data, wheel_file

EVERY_S, FIRST_S = 60.0, 30.0


def withheld(t_s: Array, gap_s: float) -> BoolArray:
    """Times (n,) inside the gaps: the first at FIRST_S, then one every EVERY_S."""
    return np.asarray((t_s >= FIRST_S) & ((t_s - FIRST_S) % EVERY_S < gap_s))


def with_gaps(problem: NavigationProblem, gap_s: float) -> NavigationProblem:
    """The problem of one vehicle without its fixes, positions and velocities, inside the gaps."""

    def cut(p: PositionStream) -> PositionStream:
        keep = ~withheld(p.t_s, gap_s)
        v_n, sigma = (None if x is None else x[keep] for x in (p.v_n, p.sigma_mps))
        return replace(p, t_s=p.t_s[keep], r_n=p.r_n[keep], sigma_m=p.sigma_m[keep], v_n=v_n, sigma_mps=sigma)

    (v,) = problem.vehicles
    return replace(problem, vehicles=(replace(v, positions=tuple(cut(p) for p in v.positions)),))


def errors_in_gaps(problem: NavigationProblem, solution: Solution, gap_s: float) -> tuple[Array, Array]:
    """Errors (n, 3) of the antenna at the withheld fixes, and their standard deviations (n, 3), the fixes' own included."""
    (v,), (s,) = problem.vehicles, solution.vehicles
    fixes = next(p for p in v.positions if np.isfinite(p.r_n).any())
    out = withheld(fixes.t_s, gap_s) & (fixes.t_s > s.t_s[0]) & (fixes.t_s < s.t_s[-1])
    t = fixes.t_s[out]
    antenna = s.r_n + matrix_from_quat(s.q_nb) @ np.array(fixes.lever_b)
    error = CubicHermiteSpline(s.t_s, antenna, s.v_n)(t) - fixes.r_n[out]
    variance = interpolate(t, s.t_s, np.diagonal(s.P, axis1=1, axis2=2)[:, :3])
    return error, np.sqrt(variance + fixes.sigma_m[out] ** 2)


def drive() -> NavigationProblem:
    shared_data("gnss_imu_rtklibexplorer/imu_1934.csv")
    return load("rtklibexplorer-drive", shared_data()).problem


def solve(problem: NavigationProblem) -> Solution:
    return Batch().solve(problem, lambda stage, fraction: None)


@pytest.mark.slow
@pytest.mark.parametrize(("gap_s", "median_m"), [(10.0, 0.3), (30.0, 2.5)])
def test_a_drive_with_fixes_withheld(gap_s: float, median_m: float) -> None:
    """Ten or thirty seconds of RTK withheld every minute; smoothed, the IMU alone carries the car across."""
    problem = drive()
    error, sigma = errors_in_gaps(problem, solve(with_gaps(problem, gap_s)), gap_s)
    assert len(error) > 4 * 0.9 * 9 * gap_s
    assert np.median(np.linalg.norm(error, axis=1)) <= median_m
    assert np.mean(np.all(np.abs(error) <= 3 * sigma, axis=1)) >= 0.99
    # nor are they all small beside their standard deviations
    assert np.mean((error / sigma) ** 2) > 0.1


@pytest.mark.slow
def test_a_drive_with_vehicle_constraints() -> None:
    """Sideways and upward velocity of the car known to decimetres per second: closer across 30 s, and still within 3 sigma."""
    problem = drive()
    (car,) = problem.vehicles
    told = Constraints(lateral_mps=0.3, vertical_mps=0.5, mounting_rad=np.deg2rad(2.0), zero_velocity_mps=0.05)
    constrained = replace(problem, vehicles=(replace(car, constraints=told),))
    free, _ = errors_in_gaps(problem, solve(with_gaps(problem, 30.0)), 30.0)
    error, sigma = errors_in_gaps(problem, solve(with_gaps(constrained, 30.0)), 30.0)
    assert np.sqrt(np.mean(error**2)) < 0.9 * np.sqrt(np.mean(free**2))
    assert np.mean(np.abs(error) <= 3 * sigma) >= 0.97


@pytest.mark.slow
def test_odometry_carries_the_mower_across_radio_silence() -> None:
    """Plaza 1: without odometry 1.4 m RMSE, 8 m where the radios are silent for up to 97 s."""
    wheel_file("gtsam", "Data/Plaza1_.mat")
    problem = load("plaza1-odometry").problem
    solution = solve(problem)
    (s,) = solution.vehicles
    assert s.truth is not None
    error = np.linalg.norm((s.r_n - interpolate(s.t_s, s.truth.t_s, s.truth.r_n))[:, :2], axis=1)
    heard = problem.ranges[0].stream.t_s
    after = np.clip(np.searchsorted(heard, s.t_s), 1, len(heard) - 1)
    silent = heard[after] - heard[after - 1] > 5.0
    assert silent.sum() > 100
    assert np.sqrt(np.mean(error**2)) < 0.4
    assert np.sqrt(np.mean(error[silent] ** 2)) < 0.8
