"""The error states of an inertial navigator against the navigator itself, its time steps, its feedback, its statistics."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from factorgraph.attitude import exp_so3, log_so3, matrix_from_euler
from factorgraph.errors import InputError
from factorgraph.filters import kalman
from factorgraph.filters.inertial import ACCEL, ATT, GYRO, GYRO_GM, INERTIAL, POS, VEL, ImuModel, InertialStart, Navigator
from factorgraph.geodesy import LocalFrame
from factorgraph.measurements import ImuStream
from factorgraph.models.strapdown import ideal_imu, propagate
from factorgraph.types import Array
from tests.helpers import assert_consistent, numerical_jacobian

FRAME = LocalFrame(np.deg2rad(48.0), np.deg2rad(11.0), 500.0)
SLOW = 1e6  # correlation time without decay
MODEL = ImuModel(
    gyro_rps_rthz=1e-5,
    accel_mps2_rthz=1e-4,
    gyro_constant_rps=1e-5,
    gyro_markov_rps=1e-6,
    gyro_markov_s=SLOW,
    accel_markov_mps2=3e-3,
    accel_markov_s=SLOW,
)
BLOCKS = (POS, VEL, ATT, GYRO, GYRO_GM, ACCEL)


def straight(t: Array) -> tuple[Array, Array, Array]:
    """Level flight at 100 m/s, not along an axis, far from the origin."""
    v = np.array([80.0, -60.0, 2.0])
    C = np.broadcast_to(matrix_from_euler(0.1, -0.2, 2.0), (len(t), 3, 3))
    return np.array([3000.0, -2000.0, 700.0]) + v * t[:, None], np.broadcast_to(v, (len(t), 3)), C


def turning(t: Array) -> tuple[Array, Array, Array]:
    """2 deg/s at 100 m/s with a bank of 5 deg that does not fit, as in the refuelling."""
    w = np.deg2rad(-2.0)
    v = 100.0 * np.column_stack([np.cos(w * t), np.sin(w * t), np.zeros(len(t))])
    r = 100.0 / w * np.column_stack([np.sin(w * t), 1 - np.cos(w * t), np.zeros(len(t))])
    return r, v, matrix_from_euler(np.zeros(len(t)), np.full(len(t), -0.09), np.pi / 2 - w * t)


def weaving(t: Array) -> tuple[Array, Array, Array]:
    """About 100 m/s with turns, climbs and attitude motion; velocity is the exact derivative."""
    a, w = np.array([400.0, 300.0, 60.0]), np.array([0.05, 0.071, 0.11])
    v0 = np.array([60.0, 75.0, 0.5])
    r = v0 * t[:, None] + a * np.sin(w * t[:, None])
    v = v0 + a * w * np.cos(w * t[:, None])
    return r, v, matrix_from_euler(0.1 * np.sin(0.3 * t), 0.6 * np.sin(0.2 * t), 0.02 * t + 0.8 * np.sin(0.07 * t))


def sensed(motion: object, duration_s: float, rate_hz: float = 200.0) -> tuple[ImuStream, tuple[Array, Array, Array]]:
    """Errorless IMU of a motion and the motion at its samples."""
    t = np.arange(round(duration_s * rate_hz) + 1) / rate_hz
    r, v, C = motion(t)  # type: ignore[operator]
    return ImuStream(t, *ideal_imu(FRAME, t, r, v, C), is_mean=True), (r, v, C)


def navigator(imu: ImuStream, r: Array, v: Array, C: Array, model: ImuModel = MODEL, t_s: float = 0.0) -> Navigator:
    return Navigator(imu, FRAME, InertialStart(r, v, C, np.eye(9)), model, t_s)


def wrong_by(x: Array, imu: ImuStream, true: tuple[Array, Array, Array], model: ImuModel = MODEL) -> Navigator:
    """A navigator whose error states are x at the start; errors of sensors are what compensation leaves."""
    r, v, C = (a[0] for a in true)
    nav = navigator(imu, r + x[POS], v + x[VEL], exp_so3(-x[ATT]) @ C, model)
    nav.gyro_constant, nav.gyro_markov, nav.accel = -x[GYRO], -x[GYRO_GM], -x[ACCEL]
    return nav


def errors(nav: Navigator, r: Array, v: Array, C: Array) -> Array:
    """Error states of a navigator of errorless sensors."""
    return np.concatenate([
        nav.r - r, nav.v - v, -log_so3(nav.C @ C.T), -nav.gyro_constant, -nav.gyro_markov, -nav.accel,
    ])  # fmt: skip


STEPS = np.repeat([100.0, 10.0, 1e-3, 1e-4, 1e-4, 1e-2], 3)


def closed_chain(imu: ImuStream, true: tuple[Array, Array, Array], dt: float, model: ImuModel = MODEL) -> tuple[Array, Array]:
    """Transition of the error states from the filter and by differences of the navigator itself."""
    last = np.searchsorted(imu.t_s, dt + 1e-9) - 1
    end = [a[last] for a in true]

    def propagated(unit: Array) -> Array:
        nav = wrong_by(unit * STEPS, imu, true, model)
        nav.advance(dt)
        return errors(nav, *end)

    nav = wrong_by(np.zeros(18), imu, true, model)
    f_n, middle = nav.advance(dt)
    Phi, _ = nav.transition(f_n, middle, model.density, dt)
    return Phi, numerical_jacobian(propagated, 18, 1.0) / STEPS


@pytest.mark.parametrize(
    ("motion", "dt", "tolerance"),
    [(straight, 1.0, 1e-4), (straight, 0.25, 3e-4), (turning, 0.25, 2e-3), (weaving, 0.25, 8e-3)],
)
def test_transition_is_the_navigators(motion: object, dt: float, tolerance: float) -> None:
    """Spec aar_two_stage.md, check 2: every block against central differences of strapdown and feedback.

    What depends on position is a sphere's gravity, good to a few parts in a thousand. In a turn the filter takes attitude
    and force from half way: second-order blocks are then off by a sixth of the angle turned, which sets the tolerances.
    """
    imu, true = sensed(motion, 1.0)
    Phi, numerical = closed_chain(imu, true, dt)
    for row in BLOCKS:
        for column in BLOCKS:
            found, expected = (M[row, column] - np.eye(18)[row, column] for M in (Phi, numerical))
            size = np.abs(expected).max()
            floor = 1e-9 * STEPS[row].max() / STEPS[column].max()  # rounding of the differences
            allowed = (1e-2 if column == POS else tolerance) * size + floor
            assert np.abs(found - expected).max() <= allowed, (row, column, found, expected)


def test_first_order_of_a_turn_is_the_dynamics_matrix() -> None:
    imu, true = sensed(turning, 1.0)
    Phi, numerical = closed_chain(imu, true, 0.05)
    for row, column in ((POS, VEL), (VEL, VEL), (VEL, ATT), (VEL, ACCEL), (ATT, ATT), (ATT, GYRO), (ATT, GYRO_GM)):
        found, expected = (M[row, column] - np.eye(18)[row, column] for M in (Phi, numerical))
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-4 * np.abs(expected).max())


def test_markov_errors_decay_in_both() -> None:
    model = replace(MODEL, gyro_markov_s=20.0, accel_markov_s=50.0)
    imu, true = sensed(straight, 2.0)
    Phi, numerical = closed_chain(imu, true, 1.0, model)
    for part, tau in ((GYRO_GM, 20.0), (ACCEL, 50.0)):
        for M in (Phi, numerical):
            np.testing.assert_allclose(M[part, part], np.exp(-1.0 / tau) * np.eye(3), atol=1e-9)
    np.testing.assert_allclose(Phi[GYRO, GYRO], np.eye(3), atol=1e-15)
    r, v, C = (a[0] for a in true)
    two = navigator(imu, r, v, C, model)
    two.gyro_markov = np.ones(3) * 1e-6
    two.advance(0.7)
    two.advance(1.7)
    np.testing.assert_allclose(two.gyro_markov, 1e-6 * np.exp(-1.7 / 20.0), rtol=1e-12)


def test_feedback_takes_errors_away() -> None:
    """Small errors of every state, fed back, leave the truth; attitude to second order."""
    imu, true = sensed(weaving, 5.0)
    x = STEPS * np.random.default_rng(1).uniform(-1, 1, 18)
    nav = wrong_by(x, imu, true)
    np.testing.assert_allclose(errors(nav, *(a[0] for a in true)), x, atol=1e-12)
    nav.correct(x)
    np.testing.assert_allclose(errors(nav, *(a[0] for a in true)), 0.0, atol=1e-12)
    nav.advance(5.0)
    np.testing.assert_allclose(nav.r, true[0][-1], atol=1e-6)


def test_estimated_sensor_errors_are_taken_off_the_samples() -> None:
    imu, true = sensed(weaving, 20.0)
    gyro, markov, accel = np.array([1e-4, -2e-4, 3e-4]), np.array([-3e-5, 1e-5, 0.0]), np.array([0.02, -0.03, 0.01])
    spoilt = replace(imu, f_b=imu.f_b + accel, w_b=imu.w_b + gyro + markov)
    nav = navigator(spoilt, *(a[0] for a in true))
    x = np.zeros(18)
    x[GYRO], x[GYRO_GM], x[ACCEL] = gyro, markov, accel
    nav.correct(x)
    nav.advance(20.0)
    np.testing.assert_allclose(nav.r, true[0][-1], atol=1e-3)
    np.testing.assert_allclose(nav.w, imu.w_b[-1], atol=1e-8)


# time


@pytest.mark.parametrize("epochs_s", [np.arange(1.0, 1200.5), np.append(np.arange(0.3337, 1200.0, 7.1234), 1200.0)])
def test_twenty_minutes_are_those_of_the_strapdown(epochs_s: Array) -> None:
    """In steps of seconds, or in steps that end between samples, the navigator is one propagation without an end.

    Coning at the start of a step takes the increment before as equal to its own.
    """
    imu, (r, v, C) = sensed(weaving, 1200.0)
    whole = propagate(FRAME, imu.t_s, imu.f_b, imu.w_b, r[0], v[0], C[0])
    nav = navigator(imu, r[0], v[0], C[0])
    for t in epochs_s:
        nav.advance(float(t))
    assert nav.t_s == imu.t_s[-1]
    np.testing.assert_allclose(nav.r, whole[0][-1], atol=0.01)
    np.testing.assert_allclose(nav.v, whole[1][-1], atol=1e-4)
    assert np.abs(log_so3(nav.C @ whole[2][-1].T)).max() < 1e-6
    np.testing.assert_allclose(nav.r, r[-1], atol=0.01)  # spec common.md, M2


def test_steps_may_end_between_samples() -> None:
    """The sample under way holds the mean of its interval, so a part of it is a part of its increment."""
    imu, (r, v, C) = sensed(straight, 1.0, rate_hz=10.0)
    for times in ([0.25, 0.31, 0.99, 1.0], [0.1, 0.15, 0.2, 1.0], [1e-3, 1.0]):
        nav = navigator(imu, r[0], v[0], C[0])
        for t in times:
            nav.advance(t)
            assert nav.t_s == pytest.approx(t, abs=1e-12)
            np.testing.assert_allclose(nav.r, r[0] + v[0] * t, atol=1e-5)
            np.testing.assert_allclose(nav.v, v[0], atol=1e-5)


def test_gaps_are_crossed_with_the_samples_around() -> None:
    imu, (r, v, C) = sensed(straight, 3.0)
    keep = (imu.t_s <= 1.0) | (imu.t_s > 1.6)
    holed = ImuStream(imu.t_s[keep], imu.f_b[keep], imu.w_b[keep], is_mean=True)
    for times in ([1.0, 2.0, 3.0], [1.3, 1.4, 3.0]):
        nav = navigator(holed, r[0], v[0], C[0])
        for t in times:
            f_n, middle = nav.advance(t)
            np.testing.assert_allclose(f_n, C[0] @ imu.f_b[1], atol=1e-3)
            np.testing.assert_allclose(middle, C[0], atol=1e-3)
        np.testing.assert_allclose(nav.r, r[-1], atol=1e-3)


def test_a_start_before_the_first_sample_takes_that_sample() -> None:
    imu, (r, v, C) = sensed(straight, 1.0)
    late = ImuStream(imu.t_s[40:], imu.f_b[40:], imu.w_b[40:], is_mean=True)
    for times in ([1.0], [0.05, 0.1, 1.0]):
        nav = navigator(late, r[0], v[0], C[0])
        for t in times:
            nav.advance(t)
        np.testing.assert_allclose(nav.r, r[-1], atol=1e-4)


def test_after_the_last_sample_it_is_said() -> None:
    imu, (r, v, C) = sensed(straight, 1.0)
    nav = navigator(imu, r[0], v[0], C[0])
    with pytest.raises(InputError, match=r"the IMU ends at 1\.000 s, before the epoch at 1\.500 s") as told:
        nav.advance(1.5)
    assert "\n" not in str(told.value)


def test_a_long_gap_is_refused() -> None:
    imu, (r, v, C) = sensed(straight, 4.0)
    kept = (imu.t_s < 1.0) | (imu.t_s > 2.5)
    holed = replace(imu, t_s=imu.t_s[kept], f_b=imu.f_b[kept], w_b=imu.w_b[kept])
    with pytest.raises(InputError, match=r"no samples from .* filters bridge 1 s"):
        navigator(holed, r[0], v[0], C[0])


def test_instantaneous_samples_are_not_taken_for_means() -> None:
    """A force that grows by 5 m/s^3, sampled at 10 Hz: read as means it would be late by half a sample, 0.25 m/s in 1 s."""
    t = np.linspace(0.0, 1.0, 11)
    C: Array = np.broadcast_to(np.eye(3), (11, 3, 3))
    r, v = np.zeros((2, 11, 3))
    f, w = ideal_imu(FRAME, t, r, v, C)
    f = f + 5.0 * t[:, None] * [1.0, 0.0, 0.0]
    nav = navigator(ImuStream(t, f, w, is_mean=False), r[0], v[0], C[0])
    nav.advance(1.0)
    np.testing.assert_allclose(nav.v[0], 2.5, atol=1e-3)
    np.testing.assert_allclose(nav.r[0], 5.0 / 6, atol=5e-3)


def test_points_of_the_body_move_as_they_do() -> None:
    """Position and velocity of a lever arm against differences of the true motion, also after estimated gyro errors."""
    lever, h = np.array([3.0, -8.0, 2.0]), 0.005
    imu, (r, v, C) = sensed(weaving, 10.0)
    gyro = np.array([2e-3, -1e-3, 5e-4])
    nav = navigator(replace(imu, w_b=imu.w_b + gyro), r[0], v[0], C[0])
    nav.gyro_constant = gyro
    nav.advance(7.0)
    k = 1400
    place, speed = nav.point(lever)
    path = r + C @ lever
    np.testing.assert_allclose(place, path[k], atol=1e-5)
    np.testing.assert_allclose(speed, (path[k + 1] - path[k - 1]) / (2 * h), atol=0.01)  # the rate is that of the last sample
    mean_rate = (path[k] - path[k - 1]) / h - (r[k] - r[k - 1]) / h
    np.testing.assert_allclose(speed - nav.v, mean_rate, atol=1e-3)
    assert np.linalg.norm(mean_rate) > 0.3


# in a filter


def noisy(imu: ImuStream, model: ImuModel, rng: np.random.Generator) -> tuple[ImuStream, Array, Array, Array]:
    """An IMU that errs as its model says: samples, the constants, the Gauss-Markov parts at the samples."""
    n, dt = len(imu.t_s), float(imu.t_s[1])

    def markov(sigma: float, tau: float) -> Array:
        out = np.empty((n, 3))
        out[0] = sigma * rng.normal(size=3)
        keep = np.exp(-dt / tau)
        for i in range(1, n):
            out[i] = keep * out[i - 1] + sigma * np.sqrt(1 - keep**2) * rng.normal(size=3)
        return out

    constant = model.gyro_constant_rps * rng.normal(size=3)
    gyro, accel = markov(model.gyro_markov_rps, model.gyro_markov_s), markov(model.accel_markov_mps2, model.accel_markov_s)
    white = rng.normal(size=(2, n, 3)) / np.sqrt(dt)
    w = imu.w_b + constant + gyro + model.gyro_rps_rthz * white[0]
    f = imu.f_b + accel + model.accel_mps2_rthz * white[1]
    return replace(imu, f_b=f, w_b=w), constant, gyro, accel


def test_position_fixes_make_all_eighteen_states_consistent() -> None:
    """A closed loop over 40 s with 0.1 m fixes: error and covariance agree, two-sided, in total and by block."""
    model = replace(
        MODEL, gyro_rps_rthz=2e-4, accel_mps2_rthz=2e-3, gyro_constant_rps=1e-3, gyro_markov_rps=5e-4, gyro_markov_s=30.0,
        accel_markov_mps2=0.02, accel_markov_s=60.0,
    )  # fmt: skip
    imu, true = sensed(weaving, 40.0, rate_hz=50.0)
    sigma = np.repeat([1.0, 0.3, 0.01], 3)
    H, R = np.zeros((3, 18)), 0.01 * np.eye(3)
    H[:, POS] = -np.eye(3)  # measured - predicted = -(estimate - truth)
    rng = np.random.default_rng(12)
    trials, final, covariances = 40, [], []
    for _ in range(trials):
        measured, constant, gyro, accel = noisy(imu, model, rng)
        x = np.zeros(18)
        x[:9] = sigma * rng.normal(size=9)
        nav = wrong_by(x, measured, true, model)
        P = np.zeros((INERTIAL.size, INERTIAL.size))
        P[:9, :9], P[9:, 9:] = np.diag(sigma**2), model.P
        for t in range(1, 41):
            f_n, middle = nav.advance(float(t))
            P = kalman.predict(P, *nav.transition(f_n, middle, model.density, 1.0))
            fix = true[0][50 * t] + 0.1 * rng.normal(size=3)
            dx, P, _ = kalman.update_sequential(P, fix - nav.r, H, R)
            nav.correct(dx)
        found = errors(nav, *(a[-1] for a in true))
        found[GYRO] += constant
        found[GYRO_GM] += gyro[-1]
        found[ACCEL] += accel[-1]
        final.append(found)
        covariances.append(P)
    error, cov = np.array(final), np.array(covariances)
    assert_consistent(error, cov)
    for part in BLOCKS:
        assert_consistent(error[:, part], cov[:, part, part], 0.9995)
    assert np.mean(np.sqrt(cov[:, ACCEL.start, ACCEL.start])) < 0.7 * model.accel_markov_mps2  # something was learned


def test_density_is_the_models() -> None:
    q = MODEL.density
    np.testing.assert_array_equal(q[POS], 0.0)
    np.testing.assert_allclose(q[VEL], 1e-8)
    np.testing.assert_allclose(q[ATT], 1e-10)
    np.testing.assert_array_equal(q[GYRO], 0.0)
    np.testing.assert_allclose(q[GYRO_GM], 2 * 1e-12 / SLOW)
    np.testing.assert_allclose(q[ACCEL], 2 * 9e-6 / SLOW)
    np.testing.assert_allclose(np.diag(MODEL.P), np.repeat([1e-10, 1e-12, 9e-6], 3))
