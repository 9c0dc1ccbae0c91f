"""Constants estimated beside the states: recovered where the flight tells them, named where it does not."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from factorgraph.errors import InputError
from factorgraph.measurements import Calibration, HeightStream
from factorgraph.problem import ImuCalibration, NavigationProblem, Vehicle
from factorgraph.registry import solve
from factorgraph.solution import ParameterEstimate, Solution, Status
from scenarios.simulate import load_scenario, simulate
from scenarios.studies.trials import replace_duration

Change = Callable[[Vehicle], Vehicle]


def flown(scenario: str, seed: int, duration_s: float) -> NavigationProblem:
    return simulate(replace_duration(load_scenario(scenario), duration_s), seed).problem


def changed(problem: NavigationProblem, name: str, change: Change) -> NavigationProblem:
    return replace(problem, vehicles=tuple(change(v) if v.name == name else v for v in problem.vehicles))


def errors(solution: Solution, truth: list[float]) -> tuple[np.ndarray, np.ndarray]:
    """Error of every parameter, absolute and over its standard deviation."""
    assert solution.diagnostics.status is Status.CONVERGED
    found = solution.diagnostics.parameters
    error = np.array([p.value for p in found]) - truth
    return error, error / np.array([p.sigma for p in found])


@pytest.mark.parametrize("seed", [1, 2])
def test_a_wrong_lever_arm_is_found(seed: int) -> None:
    """0.3 m off in a direction of the seed: turns and climbs tell it."""
    off = np.random.default_rng(seed).normal(size=3)
    off *= 0.3 / np.linalg.norm(off)

    def change(v: Vehicle) -> Vehicle:
        assert v.gnss is not None
        x, y, z = (np.array(v.gnss.lever_b) + off).tolist()
        return replace(v, gnss=replace(v.gnss, lever_b=(x, y, z), calibration=Calibration(lever_m=0.3)))

    solution = solve(changed(flown("two-uav", seed, 100.0), "follower", change))
    error, scaled = errors(solution, (-off).tolist())
    assert np.abs(scaled).max() < 4 and np.abs(error).max() < 0.05
    assert all(p.is_told for p in solution.diagnostics.parameters)


@pytest.mark.parametrize("offset_s", [0.05, -0.05])
def test_late_tags_of_an_imu_are_found(offset_s: float) -> None:
    def change(v: Vehicle) -> Vehicle:
        assert v.imu is not None
        return replace(v, imu=replace(v.imu, t_s=v.imu.t_s + offset_s), imu_calibration=ImuCalibration(time_s=0.1))

    problem = flown("two-uav", 3, 100.0)
    solution = solve(changed(problem, "follower", change))
    error, scaled = errors(solution, [offset_s])
    assert np.abs(scaled).max() < 4 and np.abs(error).max() < 5e-3
    pair = solution.pairs[0]
    assert pair.truth_enu is not None
    inside = (pair.t_s > pair.t_s[0] + 1) & (pair.t_s < pair.t_s[-1] - 1)
    # states are at the times of the others' clock, not of the late IMU's: 50 ms at 22 m/s would be a metre
    assert np.abs(pair.baseline_enu - pair.truth_enu)[inside].max() < 0.05


def test_ranges_of_late_clocks_and_biased_pairs() -> None:
    """One time offset for the set, a bias for the pair of tags."""
    problem = flown("two-uav", 4, 100.0)
    model = problem.ranges[0]
    stream = replace(model.stream, t_s=model.stream.t_s + 0.05, range_m=model.stream.range_m + 0.25)
    late = replace(model, stream=stream, time_sigma_s=0.1, bias_sigma_m=0.5, per_pair=True)
    solution = solve(replace(problem, ranges=(late,)))
    by_name = {p.name: p for p in solution.diagnostics.parameters}
    assert set(by_name) == {"uwb time offset", "uwb leader-tag-follower-tag bias"}
    for name, truth in (("uwb time offset", 0.05), ("uwb leader-tag-follower-tag bias", 0.25)):
        assert abs(by_name[name].value - truth) < 4 * by_name[name].sigma < 0.1


def test_a_barometers_bias_is_told_by_gnss() -> None:
    problem = flown("two-uav", 5, 60.0)
    truth = problem.vehicle("follower").truth
    assert truth is not None
    rng = np.random.default_rng(0)
    t = np.arange(1.0, 59.0, 0.5)
    up = np.interp(t, truth.t_s, truth.r_n[:, 2]) + 12.0 + rng.normal(0, 0.3, len(t))
    baro = HeightStream(t, up, np.full(len(t), 0.3), name="baro", calibration=Calibration(bias=30.0))
    solution = solve(changed(problem, "follower", lambda v: replace(v, heights=(baro,))))
    (bias,) = solution.diagnostics.parameters
    assert bias.name == "follower/baro bias" and bias.sigma < 10 and abs(bias.value - 12.0) < 4 * bias.sigma


def test_what_the_data_do_not_tell_is_named() -> None:
    """Without turns and phases, decimetres of a lever arm stay what the prior says, and the solution says so."""
    straight = load_scenario("refuelling")
    problem = simulate(replace_duration(straight, 40.0), 1).problem
    name = problem.vehicles[-1].name

    def change(v: Vehicle) -> Vehicle:
        assert v.gnss is not None
        return replace(v, gnss=replace(v.gnss, calibration=Calibration(lever_m=0.01)))

    solution = solve(changed(problem, name, change))
    assert not any(p.is_told for p in solution.diagnostics.parameters)
    notes = [note for note in solution.diagnostics.notes if "hardly tell" in note]
    assert len(notes) == 3 and all("gnss lever arm" in note for note in notes)


def test_observed_means_twice_better_than_the_prior() -> None:
    assert ParameterEstimate("b", "m", 0.1, 0.049, 0.0, 0.1).is_told
    assert not ParameterEstimate("b", "m", 0.1, 0.051, 0.0, 0.1).is_told


def test_a_sensor_refuses_calibrations_it_does_not_know() -> None:
    with pytest.raises(InputError, match=r"baro: calibration\.scale cannot be estimated; it knows bias"):
        HeightStream(np.arange(2.0), np.zeros(2), np.ones(2), name="baro", calibration=Calibration(scale=0.1))
    with pytest.raises(InputError, match=r"Calibration\.lever_m must not be negative"):
        Calibration(lever_m=-1.0)
