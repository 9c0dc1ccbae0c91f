"""The two-stage filter and the filter of its reference: signs, exact flights, adaptive gains, consistency, wrong input."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest

from factorgraph.attitude import matrix_from_quat
from factorgraph.errors import InputError
from factorgraph.filters import tightly_coupled, two_stage
from factorgraph.filters.float_ambiguity import FloatSettings, InsBaseline, Scheme
from factorgraph.filters.inertial import InertialStart
from factorgraph.filters.tightly_coupled import TightSettings, TightTrack
from factorgraph.filters.two_stage import Disturbance, Shared, TwoStageRun, TwoStageSettings
from factorgraph.models.receivers import receivers
from factorgraph.problem import Link
from factorgraph.types import Array
from scenarios.published import aar
from scenarios.published.aar import TANKER, UAV
from scenarios.simulate.flight import Exact, SimulatedFlight, exact, simulate
from scenarios.simulate.scenario import Scenario
from scenarios.simulate.streams import Streams
from tests.helpers import assert_consistent

DURATION_S = 60.0
MODELS = dict.fromkeys((TANKER, UAV), aar.imu_model())
FLOATS = FloatSettings(code_m=0.185, phase_m=0.005, ambiguity_walk=0.1)
TOLD = TwoStageSettings(FLOATS, doppler_mps=0.005)
SINE = 1 / np.sqrt(2)  # sigma^2 = (sigma / sqrt 2)^2 (1 + 1 / sin^2 el)


def scenario(scale: float, lever: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Scenario:
    """The refuelling's first minute, its turn included; noise by elevation as the filters believe."""
    base = aar.scenario()
    info = base.scenario.model_copy(update={"duration_s": DURATION_S, "noise_scale": scale})
    vehicles = []
    for v in base.vehicle:
        assert v.gnss is not None
        noise = v.gnss.noise.model_copy(update={"elevation": "sine"})
        vehicles.append(v.model_copy(update={"gnss": v.gnss.model_copy(update={"noise": noise, "lever_b": lever})}))
    return base.model_copy(update={"scenario": info, "vehicle": tuple(vehicles)})


@cache
def known(lever: tuple[float, float, float]) -> Exact:
    return exact(scenario(1.0, lever), 0)


def flown(seed: int, scale: float = 1.0, lever: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> SimulatedFlight:
    return simulate(scenario(scale, lever), seed, known(lever))


def true_start(flight: SimulatedFlight, name: str, off: Array | None = None) -> InertialStart:
    truth = flight.problem.vehicle(name).truth
    assert truth is not None and truth.v_n is not None and truth.q_nb is not None
    x = np.zeros(6) if off is None else off
    P = np.diag(np.repeat([2.0, 0.1, 0.002], 3) ** 2)
    return InertialStart(truth.r_n[0] + x[:3], truth.v_n[0] + x[3:], matrix_from_quat(truth.q_nb[0]), P)


def true_track(flight: SimulatedFlight, name: str = TANKER) -> TightTrack:
    """The reference without errors."""
    vehicle, path = flight.problem.vehicle(name), flight.record.trajectories[name]
    assert vehicle.gnss is not None
    t = vehicle.gnss.stream.t_s - flight.record.gnss[name].clock_s
    at = path.at(t)
    place, speed = at.point(vehicle.gnss.lever_b)
    n, zero = len(t), np.zeros((len(t), 6, 6))
    rest = (np.zeros(n), np.zeros(n), np.zeros((n, 9)), np.zeros((n, 2)), np.zeros((n, 20, 20)))
    return TightTrack(t, at.r_n, at.v_n, at.C_nb, np.zeros((n, 9, 9)), zero, place, speed, *rest)


def shared(flight: SimulatedFlight, start: dict[str, InertialStart] | None = None, **kwargs: Any) -> Shared:
    start = start or {name: true_start(flight, name) for name in (TANKER, UAV)}
    return two_stage.share(flight.problem, start, MODELS, **{"reference": true_track(flight), **kwargs})


def truth_of(flight: SimulatedFlight) -> tuple[Array, Array]:
    """True baseline and relative velocity (K, 3) of the body origins."""
    a, b = (flight.record.trajectories[name].at(true_track(flight, name).t_s) for name in (TANKER, UAV))
    return b.r_n - a.r_n, b.v_n - a.v_n


# signs


@pytest.mark.parametrize("axis", range(6))
def test_an_error_of_one_is_taken_back(axis: int) -> None:
    """Spec aar_two_stage.md, check 2: +1 m (or m/s) of the INS gives an update of -1 m, in the main filter."""
    flight = flown(1, scale=0.0)
    off = np.eye(6)[axis] * (1.0 if axis < 3 else 0.1)
    start = {TANKER: true_start(flight, TANKER), UAV: true_start(flight, UAV, off)}
    told = TwoStageSettings(replace(FLOATS, code_m=0.02), doppler_mps=0.001, is_adaptive=False)
    run = two_stage.run(shared(flight, start), Scheme.EKF, told, n_epochs=1)
    b, v = truth_of(flight)
    left = np.concatenate([run.main_baseline_n[0] - b[0], run.velocity_n[0] - v[0]])
    assert np.abs(left).max() < 0.02 * off[axis]


@pytest.mark.parametrize("axis", range(6))
def test_the_references_filter_takes_it_back_too(axis: int) -> None:
    flight = flown(1, scale=0.0)
    off = np.eye(6)[axis] * (1.0 if axis < 3 else 0.1)
    ready = receivers(flight.problem)[TANKER]
    told = TightSettings(code_m=0.001, doppler_mps=0.0001)
    track = tightly_coupled.run(ready, flight.problem.frame, true_start(flight, TANKER, off), MODELS[TANKER], told)
    true = true_track(flight)
    assert np.abs(track.r_n[0] - true.r_n[0]).max() < 0.01 and np.abs(track.v_n[0] - true.v_n[0]).max() < 1e-3
    assert np.abs(track.r_n[-1] - true.r_n[-1]).max() < 0.01 and np.abs(track.v_n[-1] - true.v_n[-1]).max() < 1e-3


# flights without errors


def clear(lever: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> tuple[SimulatedFlight, Shared]:
    """A flight whose only errors are those of the clocks and a start 0.5 m and 0.05 m/s off."""
    flight = flown(2, 0.0, lever)
    off = np.r_[0.5, -0.5, 0.3, 0.05, -0.03, 0.02]
    return flight, shared(flight, {TANKER: true_start(flight, TANKER), UAV: true_start(flight, UAV, off)})


@pytest.mark.parametrize("scheme", list(Scheme))
@pytest.mark.parametrize("is_adaptive", [False, True])
def test_a_flight_without_errors_is_followed(scheme: Scheme, is_adaptive: bool) -> None:
    flight, common = clear()
    run = two_stage.run(common, scheme, replace(TOLD, is_adaptive=is_adaptive))
    b, v = truth_of(flight)
    assert run.fixed.all()  # an errorless float solution has a huge ratio
    assert np.abs(run.baseline_n - b).max() < 1e-4
    assert np.abs(run.main_baseline_n[5:] - b[5:]).max() < 0.02
    assert np.abs(run.velocity_n[5:] - v[5:]).max() < 0.02
    assert np.all(run.alpha == 1) or is_adaptive
    assert np.all((run.alpha > 0) & (run.alpha <= 1)) and np.all(np.isfinite(run.nis))
    assert len(run.resolved) == len(run.floats) == len(run.t_s) == 61
    np.testing.assert_allclose(run.t_s, true_track(flight, UAV).t_s, atol=1e-8)


def test_lever_arms_are_part_of_the_model() -> None:
    """3 m to the antennas: body origins and antennas are told apart, attitude errors are seen through the arm."""
    lever = (1.0, 2.5, 1.5)
    flight, common = clear(lever)
    run = two_stage.run(common, Scheme.IEKF, TOLD)
    b, v = truth_of(flight)
    antennas = true_track(flight, UAV).antenna_n - true_track(flight).antenna_n
    assert np.abs(antennas - b).max() > 1.0
    assert np.abs(run.baseline_n - antennas).max() < 1e-4
    assert np.abs(run.main_baseline_n[10:] - b[10:]).max() < 0.05
    assert np.abs(run.velocity_n[10:] - v[10:]).max() < 0.05


def test_fewer_epochs_are_a_beginning() -> None:
    _, common = clear()
    whole, part = (two_stage.run(common, Scheme.IEKF, TOLD, n_epochs=n) for n in (None, 7))
    np.testing.assert_array_equal(part.baseline_n[:7], whole.baseline_n[:7])
    assert np.all(np.isnan(part.baseline_n[7:])) and len(part.resolved) == 7


def test_subfilters_alone_are_those_of_the_run() -> None:
    """WLS and EKF do not look at the INS: what was solved once serves every main filter."""
    common = shared(flown(3))
    for scheme in (Scheme.WLS, Scheme.EKF):
        solved = two_stage.float_solutions(common, scheme, FLOATS)
        given, own = two_stage.run(common, scheme, TOLD, floats=solved), two_stage.run(common, scheme, TOLD)
        np.testing.assert_array_equal(given.baseline_n, own.baseline_n)
        np.testing.assert_array_equal(given.velocity_n, own.velocity_n)
    with pytest.raises(ValueError, match="IEKF depends on the main filter"):
        two_stage.float_solutions(common, Scheme.IEKF, FLOATS)
    b, _ = truth_of(flown(3))
    imposed = [InsBaseline(x, 0.01 * np.eye(3)) for x in b]
    assert len(two_stage.float_solutions(common, Scheme.IEKF, FLOATS, ins=imposed)[0]) == len(b)


# robust and adaptive


def same(a: TwoStageRun, b: TwoStageRun) -> bool:
    fields = ("baseline_n", "baseline_P", "velocity_n", "main_baseline_n", "main_P", "fixed", "ratio", "adop_cyc", "alpha", "nis")
    return all(np.array_equal(getattr(a, name), getattr(b, name), equal_nan=True) for name in fields)


def test_no_statistic_beyond_its_threshold_is_the_aided_filter() -> None:
    """Spec aar_two_stage.md, check 7: bit for bit, subfilter and main filter; with usual thresholds they differ."""
    common = shared(flown(4))
    plain = two_stage.run(common, Scheme.IEKF, TOLD)
    beyond = replace(TOLD, floats=replace(FLOATS, c0=1e6, c1=2e6, c2=1e6))
    for scheme in (Scheme.IBRKF, Scheme.IBRCAF):
        assert same(two_stage.run(common, scheme, beyond), plain)
        assert not same(two_stage.run(common, scheme, TOLD), plain)
    never = replace(TOLD, k0=1e9)
    assert same(two_stage.run(common, Scheme.IEKF, never), two_stage.run(common, Scheme.IEKF, replace(TOLD, is_adaptive=False)))


def test_faults_of_the_velocity_reach_their_target() -> None:
    common = shared(flown(5))
    fault = np.zeros((61, 3))
    fault[30] = [3.0, 3.0, 3.0]
    usual = two_stage.run(common, Scheme.IEKF, TOLD)
    subfilter, ins = (two_stage.run(common, Scheme.IEKF, TOLD, Disturbance(fault, target)) for target in ("subfilter", "ins"))
    for run in (subfilter, ins):
        np.testing.assert_array_equal(run.baseline_n[:30], usual.baseline_n[:30])
    assert ins.alpha[30] < 0.5 * usual.alpha[30]
    a, b = subfilter.floats[31], usual.floats[31]
    assert a is not None and b is not None and np.abs(a.b_n - b.b_n).max() > 1e-4
    np.testing.assert_allclose(subfilter.velocity_n[30], usual.velocity_n[30], atol=0.01)
    # an adaptive main filter takes it back sooner than a standard one, though its literal statistic hardly sees Doppler (E7)
    plain = two_stage.run(common, Scheme.IEKF, replace(TOLD, is_adaptive=False), Disturbance(fault, "ins"))
    _, v = truth_of(flown(5))
    left = [np.linalg.norm(run.velocity_n[[30, 33]] - v[[30, 33]], axis=1) for run in (ins, plain)]
    assert np.all(left[0] < left[1]) and left[0][1] < 0.5 * left[1][1]


def test_uses_of_float_phases_differ_only_while_float() -> None:
    common = shared(flown(6))
    for threshold, all_fixed in ((1.0, True), (1e9, False)):
        told = replace(TOLD, ratio_threshold=threshold)
        runs = [two_stage.run(common, Scheme.EKF, replace(told, float_phase=use)) for use in ("omitted", "inflated", "known")]
        assert runs[0].fixed.all() == all_fixed and runs[0].fixed.any() == all_fixed
        assert same(runs[0], runs[1]) == all_fixed and same(runs[1], runs[2]) == all_fixed
        # who knows more is surer
        size = [np.nanmean(np.trace(run.main_P[:, :3, :3], axis1=1, axis2=2)) for run in runs]
        assert all_fixed or size[0] > size[1] > size[2]


def test_jumps_of_the_reference_can_be_counted() -> None:
    flight = flown(7)
    start = {name: true_start(flight, name) for name in (TANKER, UAV)}
    common = shared(flight, start, reference=None)
    assert np.all(np.linalg.eigvalsh(common.reference.jump) > -1e-9)
    usual, counted = (two_stage.run(common, Scheme.EKF, replace(TOLD, reference_jumps=on)) for on in (False, True))
    growth = np.trace(counted.main_P, axis1=1, axis2=2) - np.trace(usual.main_P, axis1=1, axis2=2)
    assert np.all(growth[1:] > 0)


# statistics


def test_main_filter_is_consistent_with_honest_noise() -> None:
    """30 flights, noise as told, reference without errors, integers of sure fixes only: NEES two-sided, NIS near one.

    The subfilter is not aided: then nothing is counted twice.
    """
    told = TwoStageSettings(
        replace(FLOATS, code_m=0.185 * SINE, phase_m=0.005 * SINE), 0.005 * SINE, ratio_threshold=6.0, is_adaptive=False
    )
    errors, covariances, nis = [], [], []
    for seed in range(30):
        flight = flown(seed)
        start = {v.name: aar.inertial_start(flight.problem, v, Streams(seed, f"/{v.name}")) for v in flight.problem.vehicles}
        run = two_stage.run(shared(flight, start), Scheme.EKF, told)
        b, v = truth_of(flight)
        errors.append(np.concatenate([run.main_baseline_n - b, run.velocity_n - v], axis=1))
        covariances.append(run.main_P[:, :6, :6])
        nis.append(run.nis)
    error, cov = np.array(errors), np.array(covariances)
    for k in (1, 20, 40, 60):
        assert_consistent(error[:, k], cov[:, k], 0.9999)
        assert_consistent(error[:, k, :3], cov[:, k, :3, :3], 0.9999)
    assert abs(np.mean(nis) - 1) < 0.03


def test_baselines_of_fixed_phases_have_their_covariance() -> None:
    told = TwoStageSettings(replace(FLOATS, code_m=0.185 * SINE, phase_m=0.005 * SINE), 0.005 * SINE, ratio_threshold=6.0)
    errors, covariances = [], []
    for seed in range(4):
        flight = flown(seed)
        run = two_stage.run(shared(flight), Scheme.IEKF, told)
        b, _ = truth_of(flight)
        assert run.fixed.sum() > 15
        errors.append((run.baseline_n - b)[run.fixed])
        covariances.append(run.baseline_P[run.fixed])
    assert_consistent(np.concatenate(errors), np.concatenate(covariances))


# wrong input


def test_problems_that_do_not_fit_are_one_line() -> None:
    flight = flown(8)
    problem, start = flight.problem, {name: true_start(flight, name) for name in (TANKER, UAV)}
    back = (Link(UAV, TANKER), *problem.links)
    blind = tuple(replace(v, imu=None) if v.name == TANKER else v for v in problem.vehicles)
    track = true_track(flight)
    short = TightTrack(*(getattr(track, name)[:50] for name in TightTrack.__slots__))
    cases = (
        (replace(problem, links=()), start, MODELS, None, "exactly one link, there are 0"),
        (replace(problem, links=back), start, MODELS, None, "exactly one link, there are 2"),
        (replace(problem, vehicles=blind), start, MODELS, None, "vehicle tanker: .* an IMU on both"),
        (problem, {TANKER: start[TANKER]}, MODELS, None, "vehicle uav: .* its start"),
        (problem, start, {UAV: MODELS[UAV]}, None, "vehicle tanker: .* error model"),
        (problem, start, MODELS, short, "vehicle tanker: its solution does not cover"),
    )
    for bad, starts, models, reference, message in cases:
        with pytest.raises(InputError, match=message) as told:
            two_stage.share(bad, starts, models, reference)
        assert "\n" not in str(told.value)
    with pytest.raises(InputError, match="needs an IMU"):
        ready = receivers(replace(problem, vehicles=blind))[TANKER]
        tightly_coupled.run(ready, problem.frame, start[TANKER], MODELS[TANKER])


def test_an_imu_that_ends_early_is_said() -> None:
    flight = flown(9)
    uav = flight.problem.vehicle(UAV)
    assert uav.imu is not None
    cut = uav.imu.t_s <= 30.0
    imu = replace(uav.imu, t_s=uav.imu.t_s[cut], f_b=uav.imu.f_b[cut], w_b=uav.imu.w_b[cut])
    vehicles = tuple(replace(v, imu=imu) if v.name == UAV else v for v in flight.problem.vehicles)
    common = shared(replace(flight, problem=replace(flight.problem, vehicles=vehicles)))
    with pytest.raises(InputError, match="the IMU ends at"):
        two_stage.run(common, Scheme.EKF, TOLD)
