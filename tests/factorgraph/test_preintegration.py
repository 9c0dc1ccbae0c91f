"""Preintegration against a differential-equation solver, finite differences, itself and the exact strapdown."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from factorgraph.assembly.variables import VehicleVariables
from factorgraph.attitude import log_so3, matrix_from_euler, skew
from factorgraph.geodesy import LocalFrame
from factorgraph.measurements import ImuStream
from factorgraph.models.preintegration import PAIR_S, Increments, crossing, gaps, grouped_inputs, integrate, sample_means
from factorgraph.models.strapdown import ideal_imu
from factorgraph.problem import Vehicle
from factorgraph.types import Array
from tests.factorgraph.native_imu import add_imu_factors, insert_states

BIAS = np.array([0.01, -0.02, 0.03, 0.1, -0.2, 0.3])


def rough_imu(seed: int, n: int = 240, rate_hz: float = 200.0, is_mean: bool = True) -> ImuStream:
    """A second of hard manoeuvring, nothing smooth about it."""
    rng = np.random.default_rng(seed)
    return ImuStream(np.arange(n) / rate_hz, rng.normal(0, 5, (n, 3)) + [0, 0, 9.8], rng.normal(0.4, 1, (n, 3)), is_mean)


def over(imu: ImuStream, start: float, stop: float, bias: Array = BIAS) -> Increments:
    return integrate(imu, np.array([start]), np.array([stop]), bias[None])


def test_increments_solve_the_differential_equations() -> None:
    """Rates and forces constant over each of five samples, integrated by Runge-Kutta apart from the library."""
    imu = rough_imu(1, n=6, rate_hz=20.0)

    def derivative(_: float, x: Array, f: Array, w: Array) -> Array:
        C = x[:9].reshape(3, 3)
        return np.concatenate([(C @ skew(w)).ravel(), C @ f, x[9:12]])

    x = np.concatenate([np.eye(3).ravel(), np.zeros(6)])
    for i in range(1, 6):
        args = (imu.f_b[i] - BIAS[3:], imu.w_b[i] - BIAS[:3])
        x = solve_ivp(derivative, (0.0, 0.05), x, args=args, rtol=1e-12, atol=1e-14).y[:, -1]
    inc = over(imu, 0.0, 0.25)
    np.testing.assert_allclose(inc.dR[0], x[:9].reshape(3, 3), atol=1e-10)
    # the series of dv and dp ends at (w dt)^2: 1e-4 of the force over a twentieth of a second at 1 rad/s
    np.testing.assert_allclose(inc.dv[0], x[9:12], atol=3e-4)
    np.testing.assert_allclose(inc.dp[0], x[12:], atol=3e-5)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(("start", "stop"), [(0.1, 0.8), (0.1023, 0.8111), (0.4, 0.4017)])
def test_bias_jacobians(seed: int, start: float, stop: float) -> None:
    imu = rough_imu(seed)
    inc = over(imu, start, stop)
    step = 1e-3

    def change(column: int) -> tuple[Array, Array, Array]:
        d = step * np.eye(6)[column]
        plus, minus = over(imu, start, stop, BIAS + d), over(imu, start, stop, BIAS - d)
        turn = log_so3(minus.dR[0].T @ plus.dR[0])
        return turn / (2 * step), (plus.dv - minus.dv)[0] / (2 * step), (plus.dp - minus.dp)[0] / (2 * step)

    for j in range(3):
        turn, dv, dp = change(j)
        np.testing.assert_allclose(inc.dR_dbg[0][:, j], turn, atol=1e-7)
        # d(A f)/dw is to leading order in w dt: 1e-2 of a term that is itself of the size f dt^2
        np.testing.assert_allclose(inc.dv_dbg[0][:, j], dv, atol=1e-4)
        np.testing.assert_allclose(inc.dp_dbg[0][:, j], dp, atol=5e-5)
        turn, dv, dp = change(3 + j)
        np.testing.assert_allclose(turn, 0.0, atol=1e-12)
        np.testing.assert_allclose(inc.dv_dba[0][:, j], dv, atol=1e-9)
        np.testing.assert_allclose(inc.dp_dba[0][:, j], dp, atol=1e-9)


@pytest.mark.parametrize("middle", [0.4, 0.4013, 0.4050])
def test_intervals_add_up(middle: float) -> None:
    """Increments over (a, c] are those over (a, b] followed by (b, c], wherever b is, Jacobians included."""
    imu = rough_imu(5)
    a, b, whole = over(imu, 0.1023, middle), over(imu, middle, 0.8111), over(imu, 0.1023, 0.8111)
    h = b.dt_s[:, None]
    Ra = a.dR[0]
    np.testing.assert_allclose(whole.dR[0], Ra @ b.dR[0], atol=1e-13)
    np.testing.assert_allclose(whole.dv, a.dv + b.dv @ Ra.T, atol=1e-6)  # a cut sample ends its series twice
    np.testing.assert_allclose(whole.dp, a.dp + a.dv * h + b.dp @ Ra.T, atol=1e-6)
    np.testing.assert_allclose(whole.dR_dbg[0], b.dR[0].T @ a.dR_dbg[0] + b.dR_dbg[0], atol=1e-12)
    np.testing.assert_allclose(whole.dv_dba[0], a.dv_dba[0] + Ra @ b.dv_dba[0], atol=1e-6)
    coupling = a.dv_dbg[0] - Ra @ skew(b.dv[0]) @ a.dR_dbg[0] + Ra @ b.dv_dbg[0]
    np.testing.assert_allclose(whole.dv_dbg[0], coupling, atol=1e-4)
    assert abs(a.dt_s[0] + b.dt_s[0] - whole.dt_s[0]) < 1e-15


def test_intervals_of_one_call_are_those_of_single_calls() -> None:
    """Starts in common and increasing stops continue each other; other orders start anew. All at their own bias.

    Not to rounding: a sample cut at a stop in between ends its series twice.
    """
    imu = rough_imu(6)
    start = np.array([0.1, 0.1, 0.1, 0.3031, 0.3031, 0.05, 0.05])
    stop = np.array([0.1, 0.2503, 0.9, 0.3031, 0.7, 0.9, 0.4])
    bias = BIAS * np.array([1, 1, 1, 2, 2, 3, 3])[:, None]
    many = integrate(imu, start, stop, bias)
    for i in range(len(start)):
        one = over(imu, start[i], stop[i], bias[i])
        for name in Increments.__dataclass_fields__:
            np.testing.assert_allclose(
                getattr(many, name)[i], getattr(one, name)[0], rtol=0, atol=1e-5 if "_db" in name else 1e-8, err_msg=name
            )


def test_without_jacobians_the_increments_are_the_same() -> None:
    imu = rough_imu(6)
    start, stop = np.array([0.1, 0.1, 0.3031]), np.array([0.2503, 0.9, 0.7])
    bias = np.tile(BIAS, (3, 1))
    full, bare = integrate(imu, start, stop, bias), integrate(imu, start, stop, bias, jacobians=False)
    for name in ("dt_s", "dR", "dv", "dp", "w_b"):
        np.testing.assert_array_equal(getattr(full, name), getattr(bare, name))
    assert not len(bare.dR_dbg)


def test_samples_far_from_an_interval_do_not_matter() -> None:
    """Nor do they where a gap near it is filled from what is around."""
    imu = rough_imu(10, n=2000)
    keep = np.ones(2000, bool)
    keep[1000:1050] = False
    whole = ImuStream(imu.t_s[keep], imu.f_b[keep], imu.w_b[keep], True)
    near = slice(900, 1200)
    part = ImuStream(whole.t_s[near], whole.f_b[near], whole.w_b[near], True)
    for start, stop in ((4.9, 5.3), (5.0, 5.1), (5.26, 5.9)):
        a, b = over(whole, start, stop), over(part, start, stop)
        for name in Increments.__dataclass_fields__:
            np.testing.assert_array_equal(getattr(a, name), getattr(b, name), err_msg=name)


def test_an_empty_interval_is_no_motion() -> None:
    inc = over(rough_imu(7), 0.3031, 0.3031)
    np.testing.assert_array_equal(inc.dR[0], np.eye(3))
    assert not np.any(inc.dv) and not np.any(inc.dp) and not np.any(inc.dR_dbg)


def test_point_samples_become_trapezoids() -> None:
    """A quadratic force and rate about one axis: point samples integrate with the trapezoid's error, means exactly."""
    t = np.arange(101.0) / 100.0
    f, w = np.zeros((101, 3)), np.zeros((101, 3))
    f[:, 2], w[:, 2] = 1 + 3 * t**2, 0.5 + t**2
    mean_f, mean_w = np.zeros((101, 3)), np.zeros((101, 3))
    before = t - 0.01
    mean_f[:, 2] = 1 + (t**3 - before**3) / 0.01
    mean_w[:, 2] = 0.5 + (t**3 - before**3) / 0.03
    none = np.zeros(6)
    exact_v, exact_turn = 1.0 + 1.0, 0.5 + 1 / 3
    point = over(ImuStream(t, f, w, is_mean=False), 0.0, 1.0, none)
    mean = over(ImuStream(t, mean_f, mean_w, is_mean=True), 0.0, 1.0, none)
    np.testing.assert_allclose(mean.dv[0], [0, 0, exact_v], atol=1e-12)
    np.testing.assert_allclose(log_so3(mean.dR[0]), [0, 0, exact_turn], atol=1e-12)
    np.testing.assert_allclose(point.dv[0, 2] - exact_v, 6 * 0.01**2 / 12, rtol=1e-6)  # f'' h^2 / 12
    np.testing.assert_allclose(log_so3(point.dR[0])[2] - exact_turn, 2 * 0.01**2 / 12, rtol=1e-6)
    shifted = over(ImuStream(t, f, w, is_mean=True), 0.0, 1.0, none)
    assert abs(shifted.dv[0, 2] - exact_v) > 0.01  # taking points for means is half a sample late: the flag matters


def test_sample_means_cover_one_interval_before_the_first() -> None:
    imu = rough_imu(8, n=4, rate_hz=100.0, is_mean=False)
    edges, f, w = sample_means(imu)
    np.testing.assert_allclose(edges, [-0.01, 0.0, 0.01, 0.02, 0.03], atol=1e-15)
    np.testing.assert_allclose(f[1:], 0.5 * (imu.f_b[1:] + imu.f_b[:-1]))
    np.testing.assert_array_equal(w[0], imu.w_b[0])


def test_the_last_sample_holds_beyond_the_recording() -> None:
    imu = ImuStream(np.array([0.0, 0.01]), np.tile([1.0, 0.0, 0.0], (2, 1)), np.zeros((2, 3)), True)
    np.testing.assert_allclose(over(imu, -0.5, 1.5, np.zeros(6)).dv[0], [2.0, 0.0, 0.0], atol=1e-12)


def test_uneven_samples_weigh_by_time() -> None:
    force = np.array([[1.0, 0, 0], [1, 0, 0], [3, 0, 0], [5, 0, 0]])
    imu = ImuStream(np.array([0.0, 0.01, 0.06, 0.07]), force, np.zeros((4, 3)), True)
    np.testing.assert_allclose(over(imu, 0.0, 0.07, np.zeros(6)).dv[0, 0], 0.01 + 3 * 0.05 + 0.05, atol=1e-12)
    assert not len(gaps(imu))


def test_a_gap_is_known_and_filled_with_what_is_around_it() -> None:
    """The late sample after it does not stand for the whole gap."""
    t = np.concatenate([np.arange(100) * 0.01, 2.0 + np.arange(100) * 0.01])
    f = np.tile([1.0, 0.0, 0.0], (200, 1))
    f[100] = [500.0, 0.0, 0.0]  # alone in the mean of twenty
    imu = ImuStream(t, f, np.zeros((200, 3)), True)
    np.testing.assert_allclose(gaps(imu), [[0.99, 2.0]], atol=1e-12)
    dv = over(imu, 0.99, 2.0, np.zeros(6)).dv[0, 0]
    assert 1.0 < dv < 50.0
    inside = crossing(gaps(imu), np.array([0.0, 0.5, 1.2, 1.9, 2.1]), np.array([0.9, 1.5, 1.4, 2.5, 2.5]))
    assert inside.tolist() == [False, True, True, True, False]


# -- through GTSAM ---------------------------------------------------------------------------------


@pytest.mark.parametrize(("start", "stop"), [(0.1, 1.1), (0.1023, 0.1231), (0.2017, 0.9)])
def test_gtsam_reproduces_the_increments_at_the_edges(start: float, stop: float) -> None:
    """Rotation, velocity and position to rounding, from steps of tens of milliseconds."""
    imu = rough_imu(9)
    groups = grouped_inputs(imu, np.array([start]), np.array([stop]), BIAS[None])
    assert np.all(groups.dt_s <= PAIR_S / 2 + 1e-9) and abs(groups.dt_s.sum() - (stop - start)) < 1e-12
    params = gtsam.PreintegrationCombinedParams(np.array([0.0, 0.0, -9.8]))
    params.setGyroscopeCovariance(1e-6 * np.eye(3))
    params.setAccelerometerCovariance(1e-6 * np.eye(3))
    params.setIntegrationCovariance(1e-9 * np.eye(3))
    pim = gtsam.PreintegratedCombinedMeasurements(params, gtsam.imuBias.ConstantBias(BIAS[3:], BIAS[:3]))
    for f, w, dt in zip(groups.f_b, groups.w_b, groups.dt_s, strict=True):
        pim.integrateMeasurement(f, w, dt)
    inc = over(imu, start, stop)
    np.testing.assert_allclose(pim.deltaRij().matrix(), inc.dR[0], atol=1e-12)
    np.testing.assert_allclose(pim.deltaVij(), inc.dv[0], atol=1e-12)
    np.testing.assert_allclose(pim.deltaPij(), inc.dp[0], atol=1e-12)


def turning_climb(t: Array) -> tuple[Array, Array, Array]:
    """About 100 m/s with turns and climbs; velocity is the exact derivative."""
    a, w = np.array([150.0, 150.0, 60.0]), np.array([0.15, 0.171, 0.21])
    v0 = np.array([60.0, 75.0, 0.5])
    r = v0 * t[:, None] + a * np.sin(w * t[:, None]) + np.array([8000.0, -5000.0, 1500.0])
    v = v0 + a * w * np.cos(w * t[:, None])
    C = matrix_from_euler(0.15 * np.sin(0.5 * t), 0.6 * np.sin(0.4 * t), 0.05 * t + 0.8 * np.sin(0.17 * t))
    return r, v, C


def moving_vehicle(grid_s: Array, rate_hz: float = 200.0, bias: Array | None = None) -> VehicleVariables:
    """A vehicle on the turning climb with exact mean samples, its variables at the truth."""
    frame = LocalFrame(np.deg2rad(55.0), np.deg2rad(37.0), 200.0)
    t = np.arange(-1, int(np.ceil(grid_s[-1] * rate_hz)) + 1) / rate_hz
    f, w = (x[1:] for x in ideal_imu(frame, t, *turning_climb(t)))
    bias = np.zeros(6) if bias is None else bias
    v = VehicleVariables(0, Vehicle("a", imu=ImuStream(t[1:], f + bias[3:], w + bias[:3], True)), grid_s, frame)
    v.r, v.v, v.R = turning_climb(grid_s)
    v.bias[:] = bias
    return v


def chained(v: VehicleVariables) -> gtsam.NavState:
    """The state at the end of the grid, predicted from the first one interval after another with the native factors."""
    graph = gtsam.NonlinearFactorGraph()
    add_imu_factors(graph, v)
    state = gtsam.NavState(gtsam.Rot3(v.R[0]), v.r[0], v.v[0])
    bias = gtsam.imuBias.ConstantBias(v.bias[0, 3:], v.bias[0, :3])
    for k in range(graph.size()):
        state = graph.at(k).preintegratedMeasurements().predict(state, bias)  # type: ignore[attr-defined]
    return state


@pytest.mark.parametrize("step_s", [1.0, 0.2, 0.0731])
def test_sixty_seconds_of_native_factors_are_the_flight(step_s: float) -> None:
    """Noise-free at 100 m/s, turning and climbing far from the origin: within 1 cm. Grid times off the samples too."""
    v = moving_vehicle(np.append(np.arange(0.0, 60.0 - 1e-9, step_s), 60.0), bias=BIAS)
    speed = np.linalg.norm(v.v, axis=1)
    assert 50 < speed.min() and speed.max() < 150
    end = chained(v)
    assert np.linalg.norm(end.position() - v.r[-1]) < 0.01
    assert np.linalg.norm(end.velocity() - v.v[-1]) < 5e-4
    assert np.linalg.norm(log_so3(end.attitude().matrix().T @ v.R[-1])) < 1e-6


def test_native_factors_vanish_at_the_truth() -> None:
    v = moving_vehicle(np.arange(21.0), bias=BIAS)
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    add_imu_factors(graph, v)
    insert_states(values, v)
    for k in range(graph.size()):
        e = graph.at(k).unwhitenedError(values)  # type: ignore[attr-defined]  # rotation, position, velocity, biases
        assert np.abs(e[:3]).max() < 1e-7 and np.abs(e[3:6]).max() < 5e-4 and np.abs(e[6:9]).max() < 5e-5
        np.testing.assert_array_equal(e[9:], 0.0)
    v.r[5] += [0.0, 0.05, 0.0]
    moved = gtsam.Values()
    insert_states(moved, v)
    assert graph.error(values) < 0.1 < 10 < graph.error(moved)


def test_points_between_states_follow_the_flight() -> None:
    """A point with a lever arm, carried up to a second past its state, against the trajectory itself."""
    v = moving_vehicle(np.arange(11.0), bias=BIAS)
    v.preintegrated_bias = v.bias + np.array([1e-4, -2e-4, 1e-4, 5e-3, -3e-3, 2e-3])  # first-order bias correction in use
    lever = np.array([0.4, -1.5, 0.8])
    t = np.sort(np.random.default_rng(0).uniform(0.0, 0.99, 60) + np.arange(60) % 10)
    p = v.points(v.query(t, lever))
    r, _, C = turning_climb(t)
    np.testing.assert_allclose(p.r_n, r + C @ lever, atol=2e-3)
    np.testing.assert_allclose(p.v_n, point_velocity(t, lever), atol=5e-3)


def point_velocity(t: Array, lever_b: Array, h: float = 1e-3) -> Array:
    (r1, _, C1), (r0, _, C0) = turning_climb(t + h), turning_climb(t - h)
    return np.asarray((r1 + C1 @ lever_b - r0 - C0 @ lever_b) / (2 * h))


@pytest.mark.parametrize("with_others", [False, True])
def test_points_just_before_a_state_move_at_constant_velocity(with_others: bool) -> None:
    """Receiver clocks put epochs milliseconds before a state; others of the query, far off the grid, change nothing."""
    v = moving_vehicle(np.arange(11.0))
    lever = np.array([0.4, -1.5, 0.8])
    near = np.array([2.9999, 4.997, 5.9953])
    t = np.concatenate([near, [7.3, 8.5]]) if with_others else near
    p = v.points(v.query(t, lever))
    r, _, C = turning_climb(near)
    np.testing.assert_allclose(p.r_n[:3], r + C @ lever, atol=3e-4)
    # what constant velocity and rate leave: 5 m/s^2 of acceleration, of which gravity is no part
    off = np.linalg.norm(p.v_n[:3] - point_velocity(near, lever), axis=1)
    assert np.all(off < 5.0 * np.abs(near - np.round(near)) + 1e-3)
