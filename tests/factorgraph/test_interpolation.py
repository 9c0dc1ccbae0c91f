"""Solutions between states: against the strapdown equations and the motion prior, exact and continuous at the states."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.interpolate import CubicHermiteSpline
from scipy.spatial.transform import Rotation, Slerp

from factorgraph import interpolation
from factorgraph.attitude import exp_so3, log_so3, matrix_from_quat, quat_from_matrix
from factorgraph.errors import InputError
from factorgraph.geodesy import C_en, geodetic_from_ecef
from factorgraph.gpstime import GpsTime
from factorgraph.interpolation import Trajectory, interpolate, interpolate_pair, resample
from factorgraph.measurements import ImuStream
from factorgraph.models.strapdown import propagate
from factorgraph.solution import (
    AmbiguityTable,
    Diagnostics,
    Fix,
    PairSolution,
    ResidualTable,
    Solution,
    Status,
    VehicleSolution,
)
from factorgraph.types import Array
from scenarios.simulate import SimulatedFlight, simulate
from scenarios.simulate.scenario import parse

SCENARIO = """
[scenario]
name = "turns"
duration_s = 30.0
noise_scale = {noise}
origin = {{ lat_deg = 45.0, lon_deg = 10.0 }}

[[vehicle]]
name = "a"
imu = {{ rate_hz = 200.0, gyro_bias_rps = [0.01, -0.02, 0.005], accel_bias_mps2 = [0.2, 0.1, -0.3] }}
[vehicle.trajectory]
kind = "manoeuvres"
start_n = [20000.0, -30000.0, 500.0]
speed_mps = 20.0
segments = [{{ duration_s = 12, turn_dps = 20, climb_mps = 2 }}, {{ duration_s = 18, turn_dps = -25, accel_mps2 = 0.5 }}]

[[vehicle]]
name = "b"
trajectory = {{ kind = "formation", leader = "a", offset_m = [5.0, -12.0, 2.0], sway_m = 2.0, sway_s = 8.0 }}

[[vehicle]]
name = "base"
trajectory = {{ kind = "static", r_n = [100.0, 0.0, 0.0] }}
"""


@pytest.fixture(scope="module")
def quiet() -> SimulatedFlight:
    return simulate(parse(SCENARIO.format(noise=0.0)), 1)


@pytest.fixture(scope="module")
def noisy() -> SimulatedFlight:
    return simulate(parse(SCENARIO.format(noise=1.0)), 1)


def imu_of(flight: SimulatedFlight) -> ImuStream:
    imu = flight.problem.vehicle("a").imu
    assert imu is not None
    return imu


def states(flight: SimulatedFlight, name: str, t_s: Array, with_imu: bool = False) -> VehicleSolution:
    """The true motion of a vehicle as a solution; attitude and the true biases only with an IMU."""
    motion = flight.record.trajectories[name].at(t_s)
    n = len(t_s)
    P = np.arange(n)[:, None, None] * np.ones((15, 15))
    nothing = np.full((n, 4), np.nan)
    q, bias_gyro, bias_accel = nothing, nothing[:, :3], nothing[:, :3]
    if with_imu:
        record, i = flight.record.imu[name], np.searchsorted(imu_of(flight).t_s, t_s - 1e-6)
        q, bias_gyro, bias_accel = quat_from_matrix(motion.C_nb), record.gyro_bias_rps[i], record.accel_bias_mps2[i]
    return VehicleSolution(name, t_s, motion.r_n, motion.v_n, q, bias_gyro, bias_accel, P)


def disturbed(vehicle: VehicleSolution, seed: int) -> VehicleSolution:
    """States that miss each other by centimetres and milliradians, as estimates do."""
    rng, n = np.random.default_rng(seed), len(vehicle.t_s)
    R = matrix_from_quat(vehicle.q_nb) @ exp_so3(rng.normal(0, 2e-3, (n, 3)))
    r_n, v_n = (x + rng.normal(0, sigma, (n, 3)) for x, sigma in ((vehicle.r_n, 0.03), (vehicle.v_n, 0.02)))
    return replace(vehicle, r_n=r_n, v_n=v_n, q_nb=quat_from_matrix(R))


def largest_errors(found: Trajectory, r_n: Array, v_n: Array, C_nb: Array) -> tuple[float, float, float]:
    phi = log_so3(matrix_from_quat(found.q_nb) @ np.swapaxes(C_nb, 1, 2))
    dr, dv, turn = (float(np.max(np.linalg.norm(x, axis=1))) for x in (found.r_n - r_n, found.v_n - v_n, phi))
    return dr, dv, turn


def test_exact_measurements_give_the_true_motion_at_imu_rate(quiet: SimulatedFlight) -> None:
    imu, frame = imu_of(quiet), quiet.problem.frame
    vehicle = states(quiet, "a", np.arange(31.0), with_imu=True)
    found = interpolate(vehicle, imu, frame, imu.t_s)
    true = quiet.record.trajectories["a"].at(imu.t_s)
    assert np.all(np.array(largest_errors(found, true.r_n, true.v_n, true.C_nb)) < [2e-5, 5e-5, 2e-6])
    hermite = interpolate(vehicle, None, frame, imu.t_s)
    assert np.all(np.array(largest_errors(hermite, true.r_n, true.v_n, true.C_nb)) > [1e-3, 1e-2, 1e-2])


def test_noisy_measurements_give_the_strapdown_solution_between_its_own_states(noisy: SimulatedFlight) -> None:
    imu, frame = imu_of(noisy), noisy.problem.frame
    start = noisy.record.trajectories["a"].at(imu.t_s[:1])
    r, v, C = propagate(frame, imu.t_s, imu.f_b, imu.w_b, start.r_n[0], start.v_n[0], start.C_nb[0])
    rows = np.arange(0, len(imu.t_s), 200)
    n = len(rows)
    vehicle = VehicleSolution(
        "a", imu.t_s[rows], r[rows], v[rows], quat_from_matrix(C[rows]), np.zeros((n, 3)), np.zeros((n, 3)), np.zeros((n, 15, 15))
    )
    found = interpolate(vehicle, imu, frame, imu.t_s[: rows[-1] + 1])
    inside = slice(0, rows[-1] + 1)
    assert np.all(np.array(largest_errors(found, r[inside], v[inside], C[inside])) < [1e-4, 3e-4, 1e-5])


def test_constant_errors_of_the_sensors_are_taken_out(quiet: SimulatedFlight) -> None:
    """Biases wrong by 0.1 m/s^2 and 1 mrad/s move a propagation by 5 cm, 0.1 m/s and 1 mrad within a second."""
    imu, frame = imu_of(quiet), quiet.problem.frame
    vehicle = states(quiet, "a", np.arange(31.0), with_imu=True)
    sign = np.array([1.0, -1.0, 1.0])
    wrong = replace(vehicle, bias_accel=vehicle.bias_accel + 0.1 * sign, bias_gyro=vehicle.bias_gyro + 1e-3 * sign)
    found = interpolate(wrong, imu, frame, imu.t_s)
    true = quiet.record.trajectories["a"].at(imu.t_s)
    assert np.all(np.array(largest_errors(found, true.r_n, true.v_n, true.C_nb)) < [4e-3, 2e-2, 3e-4])


@pytest.mark.parametrize("with_imu", [True, False])
def test_states_are_met_exactly_and_from_both_sides(noisy: SimulatedFlight, with_imu: bool) -> None:
    imu = imu_of(noisy) if with_imu else None
    t_s = np.sort(np.random.default_rng(2).uniform(0, 30, 40))
    vehicle = disturbed(states(noisy, "a", t_s, with_imu=True), 3)
    at = interpolate(vehicle, imu, noisy.problem.frame, t_s)
    np.testing.assert_allclose(at.r_n, vehicle.r_n, rtol=0, atol=1e-9)
    np.testing.assert_allclose(at.v_n, vehicle.v_n, rtol=0, atol=1e-12)
    np.testing.assert_allclose(at.q_nb, vehicle.q_nb, rtol=0, atol=1e-12)
    aside = 1e-7
    left = interpolate(vehicle, imu, noisy.problem.frame, t_s[1:] - aside)
    right = interpolate(vehicle, imu, noisy.problem.frame, t_s[:-1] + aside)
    for side, rows in ((left, slice(1, None)), (right, slice(None, -1))):
        C = matrix_from_quat(vehicle.q_nb[rows])
        assert np.all(np.array(largest_errors(side, vehicle.r_n[rows], vehicle.v_n[rows], C)) < [1e-5, 1e-4, 1e-6])


@pytest.mark.parametrize("with_imu", [True, False])
def test_velocity_is_the_derivative_of_position(noisy: SimulatedFlight, with_imu: bool) -> None:
    imu, h = imu_of(noisy) if with_imu else None, 1e-4
    vehicle = disturbed(states(noisy, "a", np.arange(31.0), with_imu=True), 4)
    t_s = np.arange(0.0025, 29.9, 0.105)  # within samples, away from their edges
    after, before = (interpolate(vehicle, imu, noisy.problem.frame, t_s + s).r_n for s in (h, -h))
    found = interpolate(vehicle, imu, noisy.problem.frame, t_s).v_n
    np.testing.assert_allclose((after - before) / (2 * h), found, atol=2e-6)


def test_without_imu_it_is_the_mean_of_the_motion_prior_and_the_shortest_rotation(noisy: SimulatedFlight) -> None:
    t_s = np.array([0.0, 1.0, 2.5, 6.0])
    vehicle = disturbed(states(noisy, "a", t_s, with_imu=True), 5)
    at = np.linspace(0, 6, 61)
    found = interpolate(vehicle, None, noisy.problem.frame, at)
    spline = CubicHermiteSpline(t_s, vehicle.r_n, vehicle.v_n)
    np.testing.assert_allclose(found.r_n, spline(at), atol=1e-8)
    np.testing.assert_allclose(found.v_n, spline.derivative()(at), atol=1e-8)
    turned = Slerp(t_s, Rotation.from_quat(vehicle.q_nb[:, [1, 2, 3, 0]]))(at).as_matrix()
    np.testing.assert_allclose(matrix_from_quat(found.q_nb), turned, atol=1e-9)
    # conditional mean of white noise on acceleration, one axis of the last interval: Barfoot (2017), sec. 3.4
    T, tau = 3.5, 1.3

    def Phi(t: float) -> Array:
        return np.array([[1, t], [0, 1]])

    def Q(t: float) -> Array:
        return np.array([[t**3 / 3, t**2 / 2], [t**2 / 2, t]])

    x0, x1 = (np.stack([vehicle.r_n[k], vehicle.v_n[k]]) for k in (2, 3))
    gain = Q(tau) @ Phi(T - tau).T @ np.linalg.inv(Q(T))
    mean = Phi(tau) @ x0 + gain @ (x1 - Phi(T) @ x0)
    one = interpolate(vehicle, None, noisy.problem.frame, np.array([2.5 + tau]))
    np.testing.assert_allclose(np.vstack([one.r_n, one.v_n]), mean, atol=1e-8)


def test_a_vehicle_without_attitude_does_without_its_imu(noisy: SimulatedFlight) -> None:
    vehicle, at = states(noisy, "a", np.arange(31.0)), np.linspace(0, 30, 200)
    found = interpolate(vehicle, imu_of(noisy), noisy.problem.frame, at)
    np.testing.assert_array_equal(found.r_n, interpolate(vehicle, None, noisy.problem.frame, at).r_n)
    assert np.isnan(found.q_nb).all()


def test_intervals_that_samples_are_missing_from_do_without_the_imu(noisy: SimulatedFlight) -> None:
    imu, frame = imu_of(noisy), noisy.problem.frame
    kept = (imu.t_s >= 2.3) & ((imu.t_s <= 12.5) | (imu.t_s > 14.2)) & (imu.t_s < 25.5)
    gappy = ImuStream(imu.t_s[kept], imu.f_b[kept], imu.w_b[kept], imu.is_mean)
    vehicle = disturbed(states(noisy, "a", np.arange(31.0), with_imu=True), 6)
    at = np.arange(0.03, 30, 0.1)
    found, whole, without = (interpolate(vehicle, stream, frame, at) for stream in (gappy, imu, None))
    missing = np.isin(np.floor(at), [0, 1, 2, 12, 13, 14, 25, 26, 27, 28, 29])
    for name in ("r_n", "v_n", "q_nb"):
        a, b, c = (getattr(x, name) for x in (found, whole, without))
        np.testing.assert_allclose(a[missing], c[missing], atol=1e-9)
        np.testing.assert_allclose(a[~missing], b[~missing], atol=1e-9)
        assert np.max(np.abs(b - c)) > 1e-3


def test_times_in_any_order_and_any_number_of_pieces_give_the_same(
    noisy: SimulatedFlight, monkeypatch: pytest.MonkeyPatch
) -> None:
    imu, frame = imu_of(noisy), noisy.problem.frame
    vehicle = disturbed(states(noisy, "a", np.arange(31.0), with_imu=True), 7)
    t_s = np.repeat(np.linspace(0, 30, 300), 2)
    order = np.random.default_rng(8).permutation(len(t_s))
    straight = interpolate(vehicle, imu, frame, t_s)
    monkeypatch.setattr(interpolation, "CHUNK", 64)
    shuffled = interpolate(vehicle, imu, frame, t_s[order])
    np.testing.assert_array_equal(shuffled.t_s, t_s[order])
    for name in ("r_n", "v_n", "q_nb"):
        np.testing.assert_allclose(getattr(shuffled, name), getattr(straight, name)[order], atol=1e-9)


@pytest.mark.parametrize("t", [-0.001, 30.001, np.nan])
def test_times_outside_the_solution_are_refused(noisy: SimulatedFlight, t: float) -> None:
    vehicle = states(noisy, "a", np.arange(31.0), with_imu=True)
    with pytest.raises(ValueError, match=r"a: times from .* not within the solution, 0 s to 30 s"):
        interpolate(vehicle, None, noisy.problem.frame, np.array([1.0, t]))


def test_one_state_and_no_times_are_enough(noisy: SimulatedFlight) -> None:
    one = states(noisy, "a", np.array([3.0]), with_imu=True)
    found = interpolate(one, imu_of(noisy), noisy.problem.frame, np.array([3.0]))
    np.testing.assert_allclose(found.r_n, one.r_n)
    none = states(noisy, "a", np.zeros(0), with_imu=True)
    assert interpolate(none, None, noisy.problem.frame, np.zeros(0)).q_nb.shape == (0, 4)
    with pytest.raises(InputError, match="no states"):
        interpolate(none, None, noisy.problem.frame, np.array([1.0]))


def true_pair(flight: SimulatedFlight, t_s: Array) -> tuple[Array, Array]:
    """Baseline and relative velocity (n, 3) of b from a, east-north-up at a, point by point."""
    a, b = (flight.record.trajectories[name].at(t_s) for name in ("a", "b"))
    frame = flight.problem.frame
    rows = []
    for i in range(len(t_s)):
        lat, lon, _ = geodetic_from_ecef(frame.to_ecef(a.r_n[i]))
        C = C_en(lat, lon)
        rows.append(np.stack([C @ frame.rotate_to_ecef(x[i]) for x in (b.r_n - a.r_n, b.v_n - a.v_n)]))
    both = np.array(rows)
    return both[:, 0], both[:, 1]


def test_a_pair_is_resolved_at_its_reference_36_km_from_the_origin(quiet: SimulatedFlight) -> None:
    t_s, frame = np.arange(0, 30, 0.31), quiet.problem.frame
    a = states(quiet, "a", np.arange(31.0), with_imu=True)
    b = states(quiet, "b", np.arange(0, 30.5, 0.25))  # no IMU, other states
    found = interpolate_pair(a, b, imu_of(quiet), None, frame, t_s)
    baseline, velocity = true_pair(quiet, t_s)
    np.testing.assert_allclose(found.baseline_enu, baseline, atol=2e-3)
    np.testing.assert_allclose(found.velocity_enu, velocity, atol=3e-2)
    unturned = frame.from_ecef(frame.to_ecef(np.zeros(3))) + b.r_n[0] - a.r_n[0]
    assert np.max(np.abs(found.baseline_enu[0] - unturned)) > 0.02
    with pytest.raises(InputError, match="b: times"):
        interpolate_pair(a, states(quiet, "b", np.arange(5.0)), None, None, frame, t_s)


def solution_of(flight: SimulatedFlight) -> Solution:
    """Vehicles and a pair at whole seconds from 2 s."""
    t_s = np.arange(2.0, 31.0)
    a, b, base = states(flight, "a", t_s, with_imu=True), states(flight, "b", t_s), states(flight, "base", t_s)
    baseline, velocity = true_pair(flight, t_s)
    n = len(t_s)
    fix = np.where(np.arange(n) % 2, Fix.FIXED.value, Fix.FLOAT.value)
    P = np.arange(n)[:, None, None] * np.ones((6, 6))
    pair = PairSolution("a", "b", t_s, baseline, velocity, P, fix, np.linspace(3.0, 9.0, n), np.arange(n), baseline, velocity)
    return Solution(
        name="turns",
        method="made up",
        t0=GpsTime(2317, 0.0),
        frame=flight.problem.frame,
        vehicles=(a, b, replace(base, is_fixed=True)),
        pairs=(pair,),
        ambiguities=AmbiguityTable(),
        residuals=ResidualTable(),
        diagnostics=Diagnostics(Status.CONVERGED, 1, np.zeros(2)),
    )


def test_resampled_solutions_keep_status_and_covariance_of_the_state_before(quiet: SimulatedFlight) -> None:
    solution = solution_of(quiet)
    found = resample(solution, quiet.problem, 10.0)
    a, pair = found.vehicle("a"), found.pair("a", "b")
    np.testing.assert_allclose(a.t_s, np.arange(20, 301) / 10)
    before = np.arange(len(a.t_s)) // 10
    np.testing.assert_array_equal(a.P, solution.vehicle("a").P[before])
    np.testing.assert_array_equal(a.bias_gyro, solution.vehicle("a").bias_gyro[before])
    for name in ("P", "fix", "ratio", "n_sat"):
        np.testing.assert_array_equal(getattr(pair, name), getattr(solution.pairs[0], name)[before])
    np.testing.assert_allclose(pair.baseline_enu[::10], solution.pairs[0].baseline_enu, atol=1e-6)
    np.testing.assert_allclose(pair.baseline_enu, true_pair(quiet, pair.t_s)[0], atol=0.05)
    assert pair.truth_enu is None and pair.truth_velocity_enu is None
    base = found.vehicle("base")
    np.testing.assert_allclose(base.r_n, np.tile([100.0, 0, 0], (len(base.t_s), 1)), atol=1e-9)


def test_resampling_to_the_imu_takes_its_times_and_leaves_others_at_their_states(quiet: SimulatedFlight) -> None:
    solution, imu = solution_of(quiet), imu_of(quiet)
    found = resample(solution, quiet.problem)
    inside = imu.t_s[(imu.t_s >= 2) & (imu.t_s <= 30)]
    np.testing.assert_array_equal(found.vehicle("a").t_s, inside)
    np.testing.assert_array_equal(found.pair("a", "b").t_s, inside)
    np.testing.assert_array_equal(found.vehicle("b").t_s, solution.vehicle("b").t_s)
    np.testing.assert_allclose(found.vehicle("b").r_n, solution.vehicle("b").r_n, atol=1e-9)


def test_rates_meet_rounded_state_times_and_must_be_positive(quiet: SimulatedFlight) -> None:
    solution = solution_of(quiet)
    b = solution.vehicle("b")
    early = replace(solution, vehicles=(replace(b, t_s=b.t_s + 1e-9),), pairs=())
    t_s = resample(early, quiet.problem, 2.0).vehicles[0].t_s
    assert len(t_s) == 57
    assert t_s[0] >= early.vehicles[0].t_s[0]
    for rate in (0.0, -1.0, np.inf, np.nan):
        with pytest.raises(InputError, match="rate of trajectories"):
            resample(solution, quiet.problem, rate)
