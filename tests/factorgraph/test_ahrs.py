"""Attitude filter: linearisation, truth without noise, consistency, gyro bias, declination, gate, speed, wrong input."""

from __future__ import annotations

import time
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from factorgraph.attitude import euler_from_matrix, exp_so3, log_so3, matrix_from_euler, matrix_from_quat
from factorgraph.errors import InputError
from factorgraph.filters import ahrs
from factorgraph.filters.ahrs import AhrsSettings, AhrsTrack, Aiding
from factorgraph.geodesy import LocalFrame
from factorgraph.gpstime import GpsTime
from factorgraph.measurements import Calibration, ImuStream, MagneticStream
from factorgraph.models import magnetic_field
from factorgraph.models.strapdown import ideal_imu
from factorgraph.problem import ImuNoise
from factorgraph.types import Array
from tests.helpers import assert_consistent, numerical_jacobian

FRAME = LocalFrame(np.deg2rad(32.0), np.deg2rad(118.8), 0.0)
FIELD = (-3.62, 32.80, -37.83)  # microtesla at FRAME in 2024, 6.3 deg west of north
TOLD = ImuNoise(
    gyro_rps_rthz=1e-4, accel_mps2_rthz=1e-3, gyro_bias_rps=5e-3, accel_bias_mps2=0.02, gyro_bias_walk_rps_rts=1e-7,
    accel_bias_walk_mps2_rts=1e-7,
)  # fmt: skip
C_TRUE = matrix_from_euler(np.deg2rad(4.0), np.deg2rad(-3.0), np.deg2rad(60.0))


def exact(duration_s: float, rate_hz: float = 100.0, v_n: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> ImuStream:
    """Errorless samples of a vehicle that keeps its attitude against n."""
    t = np.arange(-1, round(duration_s * rate_hz) + 1) / rate_hz
    v = np.tile(v_n, (len(t), 1))
    f, w = ideal_imu(FRAME, t, t[:, None] * v, v, np.tile(C_TRUE, (len(t), 1, 1)))
    return ImuStream(t[1:], f[1:], w[1:], is_mean=True)


def compass(duration_s: float, rate_hz: float = 10.0, bias: float = 0.0) -> MagneticStream:
    t = np.arange(round(duration_s * rate_hz) + 1) / rate_hz
    m = np.tile(C_TRUE.T @ FIELD, (len(t), 1))
    return MagneticStream(t, m, np.full(m.shape, 0.3), FIELD, calibration=Calibration(bias=bias))


def phi(track: AhrsTrack, k: int = -1) -> Array:
    return -log_so3(matrix_from_quat(track.q_nb[k]) @ C_TRUE.T)


def drawn(seed: int, imu: ImuStream, field: MagneticStream) -> tuple[ImuStream, MagneticStream, Array]:
    """Errors as TOLD, and 0.05 m/s^2 of acceleration that lasts as long as a gravity row."""
    rng, n = np.random.default_rng(seed), len(imu.t_s)
    gyro, accel = rng.normal(0, TOLD.gyro_bias_rps, 3), rng.normal(0, TOLD.accel_bias_mps2, 3)
    iron = rng.normal(0, 1.0, 3) * field.calibration.bias
    rate = np.sqrt(1 / np.median(np.diff(imu.t_s)))
    pushed = np.repeat(rng.normal(0, 0.05, (n // 10 + 1, 3)), 10, axis=0)[:n]
    f = imu.f_b + accel + pushed + rng.normal(0, TOLD.accel_mps2_rthz * rate, (n, 3))
    w = imu.w_b + gyro + rng.normal(0, TOLD.gyro_rps_rthz * rate, (n, 3))
    m = field.m_b + iron + rng.normal(0, 0.3, field.m_b.shape)
    return replace(imu, f_b=f, w_b=w), replace(field, m_b=m), gyro


def test_rows_are_the_derivatives_of_their_innovations() -> None:
    """phi in C_est = Exp(-phi) C_true and both considered errors, against central differences."""
    s_n, field = np.array([0.3, -0.2, 9.8]), np.array(FIELD)
    e = np.cross(s_n, [1.0, 2.0, 0.5])
    e /= np.linalg.norm(e)

    def called(kind: str, error: Array) -> tuple[float, Array]:
        """Innovation and row; a unit covariance of phi and bias gives the innovation back from the gain."""
        C = exp_so3(-error[:3]) @ C_TRUE
        P, dx, h = np.diag(np.r_[np.ones(6), np.zeros(6)]), np.zeros(12), np.zeros(12)
        if kind == "gravity":
            mean, size = C @ (C_TRUE.T @ s_n + error[6:9]), float(np.linalg.norm(s_n))
            ahrs._gravity_row(P, dx, h, C, e, s_n / size, mean, size, 1.0)
            r = 1 / size**2
        else:
            ahrs._heading(P, dx, h, C, C_TRUE.T @ field + error[9:], field, 1.0)
            r = 1.0
        return float(dx @ h * (h[:6] @ h[:6] + r) / (h[:6] @ h[:6])), h

    def innovation(kind: str, error: Array) -> Array:
        return np.array([called(kind, error)[0]])

    for kind in ("gravity", "heading"):
        J = numerical_jacobian(partial(innovation, kind), 12, 1e-5)[0]
        np.testing.assert_allclose(called(kind, np.zeros(12))[1], J, atol=1e-7)


def test_without_errors_the_attitude_is_exact() -> None:
    """At rest, and moving when velocities tell of the Coriolis acceleration; Earth rate but in the start's 0.1 s included."""
    start = AhrsSettings(start_s=0.1)
    still = ahrs.run(exact(20.0), TOLD, FRAME, compass(20.0), settings=start)
    t = np.arange(21.0)
    v = np.tile([50.0, 20.0, 0.0], (21, 1))
    moving = ahrs.run(exact(20.0, v_n=(50.0, 20.0, 0.0)), TOLD, FRAME, compass(20.0), Aiding(t, t[:, None] * v, v, 0.03), start)
    for track, samples, limit in ((still, (0, 500, -1), 7e-6), (moving, (-1,), 3e-5)):
        assert max(np.max(np.abs(phi(track, k))) for k in samples) < limit
    assert np.all(still.gravity_used) and len(moving.gravity_s) == 19
    np.testing.assert_allclose(still.gyro_bias[-1], 0.0, atol=1e-8)


def test_errors_are_as_large_as_told() -> None:
    """NEES of the attitude at the start and later over 40 flights, accelerometer bias and hard iron among the errors."""
    imu, field = exact(20.0), compass(20.0, bias=0.3)
    at = (60, 400, 1999)
    errors, P, gyro = np.zeros((3, 40, 3)), np.zeros((3, 40, 3, 3)), np.zeros((40, 3))
    for seed in range(40):
        noisy, magnetic, bias = drawn(seed, imu, field)
        track = ahrs.run(noisy, TOLD, FRAME, magnetic)
        for i, k in enumerate(at):
            errors[i, seed], P[i, seed] = phi(track, k), track.P[k]
        gyro[seed] = track.gyro_bias[-1] - bias
    for error, covariance in zip(errors, P, strict=True):
        assert_consistent(error, covariance)
    assert np.sqrt(np.mean(gyro**2)) < 0.1 * TOLD.gyro_bias_rps  # 5e-3 rad/s before
    # considered errors are a floor: b_a / g of the level
    floor = TOLD.accel_bias_mps2 / 9.8
    assert np.all(np.sqrt(P[2, :, 0, 0]) > 0.99 * floor)


def test_heading_is_from_true_north() -> None:
    """The field of the model turns the heading by its declination; a field along north leaves that out."""
    field = magnetic_field.field_n(FRAME, GpsTime.from_calendar(2024, 6, 5))
    np.testing.assert_allclose(field, FIELD, atol=0.01)
    declination = magnetic_field.declination_rad(field)
    assert np.rad2deg(declination) == pytest.approx(-6.30, abs=0.02)
    level = float(np.hypot(field[0], field[1]))
    m_b = np.tile(C_TRUE.T @ field, (51, 1))
    for north, off in ((field, 0.0), (np.array([0.0, level, field[2]]), -declination)):
        east, ahead, up = north.tolist()
        stream = replace(compass(5.0), m_b=m_b, field_n=(east, ahead, up))
        track = ahrs.run(exact(5.0), TOLD, FRAME, stream)
        _, _, heading = euler_from_matrix(matrix_from_quat(track.q_nb[-1]))
        assert float(heading) == pytest.approx(np.deg2rad(60.0) + off, abs=1e-5)


def test_the_model_knows_place_and_date() -> None:
    """Values of the World Magnetic Model 2025, test values of its report (0 deg N, 120 deg E, 0 km, 2025.0), and its limits."""
    frame = LocalFrame(0.0, np.deg2rad(120.0), 0.0)
    east, north, up = magnetic_field.field_n(frame, GpsTime.from_calendar(2025, 1, 1))
    np.testing.assert_allclose((north, east, -up), (39.6777, -0.1099, -10.5805), atol=1e-3)
    there = magnetic_field.field_n(FRAME, GpsTime.from_calendar(2024, 6, 5), np.array([3e4, 0.0, 1e3]))
    assert 0.01 < np.linalg.norm(there - FIELD) < 0.5
    with pytest.raises(InputError, match=r"no magnetic model for the year 2005\.4"):
        magnetic_field.field_n(FRAME, GpsTime.from_calendar(2005, 6, 5))


def test_accelerations_outside_the_gate_are_left_out() -> None:
    """Two seconds of 0.2 g upwards, then one of 0.05 g to the front, which passes."""
    imu = exact(20.0)
    f = imu.f_b.copy()
    f[500:700] += C_TRUE.T @ [0.0, 0.0, 2.0]
    f[1000:1100] += [0.0, 0.5, 0.0]
    track = ahrs.run(replace(imu, f_b=f), TOLD, FRAME, compass(20.0))
    out = track.gravity_s[~track.gravity_used]
    assert 5.0 < out.min() and out.max() <= 7.01 and len(out) == 20
    assert np.max(np.abs(phi(track, 999))) < 1e-5 < np.max(np.abs(phi(track, 1100)))


def test_without_a_magnetometer_the_heading_is_as_given_or_open() -> None:
    imu = exact(10.0)
    given = ahrs.run(imu, TOLD, FRAME, heading=(np.deg2rad(61.0), np.deg2rad(2.0)))
    assert phi(given)[2] == pytest.approx(np.deg2rad(1.0), abs=1e-3)  # C_est = (I - [phi x]) C_true, phi up: to the right
    assert np.max(np.abs(phi(given)[:2])) < 1e-3 and np.sqrt(given.P[-1, 2, 2]) > np.deg2rad(2.0)
    assert np.sqrt(ahrs.run(imu, TOLD, FRAME).P[-1, 2, 2]) > 1.8


def test_the_compiled_loop_is_the_written_one(monkeypatch: pytest.MonkeyPatch) -> None:
    noisy, field, _ = drawn(1, exact(1.5), compass(1.5))
    compiled = ahrs.run(noisy, TOLD, FRAME, field)
    for name in ("_run", "_carry", "_propagate", "_gravity", "_gravity_row", "_heading", "_update", "_feed_back"):
        monkeypatch.setattr(ahrs, name, getattr(ahrs, name).py_func)
    written = ahrs.run(noisy, TOLD, FRAME, field)
    for one, other in ((compiled.q_nb, written.q_nb), (compiled.P, written.P), (compiled.gyro_bias, written.gyro_bias)):
        np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-14)


def test_ten_minutes_take_less_than_a_second() -> None:
    imu, field = exact(600.0), compass(600.0)
    ahrs.run(exact(2.0), TOLD, FRAME, field)
    began = time.process_time()
    track = ahrs.run(imu, TOLD, FRAME, field)
    assert time.process_time() - began < 1.0 and len(track.t_s) == 60_001


def test_attitudes_as_a_measurement_count_once_within_their_correlation() -> None:
    track = ahrs.run(exact(2.0), TOLD, FRAME, compass(2.0))
    stream = track.stream(5.0)
    np.testing.assert_allclose(stream.sigma_rad**2, 1000 * np.diagonal(track.P, axis1=1, axis2=2))
    np.testing.assert_array_equal(stream.q_nb, track.q_nb)


def test_wrong_input_is_one_line() -> None:
    imu, field, t = exact(2.0), compass(2.0), np.arange(3.0)
    cases = (
        (lambda: ahrs.run(exact(0.3), TOLD, FRAME), r"0\.31 s of samples, an attitude starts from 0\.5 s"),
        (lambda: ahrs.run(imu, TOLD, FRAME, replace(field, t_s=field.t_s + 1.0)), "measures nothing between"),
        (lambda: ahrs.run(imu, TOLD, FRAME, field, Aiding(t + 9, np.zeros((3, 3)), np.zeros((3, 3)), 0.1)), "no two velocities"),
        (lambda: Aiding(t, np.zeros((2, 3)), np.zeros((3, 3)), 0.1), r"Aiding\.r_n must be \(3, 3\), got \(2, 3\)"),
        (lambda: AhrsSettings(gate_g=0.0), "gate_g must be positive"),
        (lambda: AhrsSettings(turn_mps=-1.0), "turn_mps must not be negative"),
    )
    for call, message in cases:
        with pytest.raises(InputError, match=message) as told:
            call()
        assert "\n" not in str(told.value)
