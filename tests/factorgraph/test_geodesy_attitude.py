"""Earth, local frame, attitude and GPS time: round trips, group laws, independent forms of the same thing."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from factorgraph import geodesy
from factorgraph.attitude import (
    ENU_NED,
    euler_from_matrix,
    exp_so3,
    log_so3,
    matrix_from_euler,
    matrix_from_quat,
    quat_from_matrix,
    skew,
)
from factorgraph.geodesy import C_en, LocalFrame, ecef_from_geodetic, geodetic_from_ecef, gravitation_ecef
from factorgraph.gpstime import WEEK_S, GpsTime, leap_seconds
from factorgraph.types import Array

LATITUDES = st.floats(-np.pi / 2, np.pi / 2)
LONGITUDES = st.floats(-np.pi, np.pi)
HEIGHTS = st.floats(-500.0, 30_000.0)
UNIT = st.floats(-1.0, 1.0)


def rotation_vectors(largest: float) -> st.SearchStrategy[Array]:
    """Rotation vectors of any length up to `largest`, tiny ones included."""
    direction = st.tuples(UNIT, UNIT, UNIT).filter(lambda v: np.linalg.norm(v) > 1e-3)
    size = st.one_of(st.floats(0.0, largest), st.floats(-12.0, 0.0).map(lambda p: 10.0**p))
    return st.builds(lambda v, s: np.asarray(v) / np.linalg.norm(v) * s, direction, size)


# -- Earth -----------------------------------------------------------------------------------------


@given(LATITUDES, LONGITUDES, HEIGHTS)
@settings(deadline=None)
def test_geodetic_round_trip(lat: float, lon: float, h: float) -> None:
    """Within some roundings of an Earth radius (1e-9 m each), of which there are several on the way."""
    r = ecef_from_geodetic(lat, lon, h)
    np.testing.assert_allclose(ecef_from_geodetic(*geodetic_from_ecef(r)), r, rtol=0, atol=8e-9)
    lat2, _, h2 = geodetic_from_ecef(r)
    assert abs(float(lat2) - lat) * geodesy.A_M < 8e-9 and abs(float(h2) - h) < 8e-9


def test_geodetic_coordinates_of_known_points() -> None:
    """Equator and pole by definition; the pole's axis is b = 6356752.3142 m (WGS-84, NIMA TR8350.2)."""
    np.testing.assert_allclose(ecef_from_geodetic(0.0, np.pi / 2, 100.0), [0.0, geodesy.A_M + 100.0, 0.0], atol=1e-8)
    np.testing.assert_allclose(ecef_from_geodetic(np.pi / 2, 0.0, 0.0), [0.0, 0.0, 6_356_752.3142], atol=1e-4)


@given(st.floats(-1.5, 1.5), LONGITUDES)
@settings(deadline=None)
def test_C_en_rows_are_the_directions_of_growing_coordinates(lat: float, lon: float) -> None:
    step = 1e-6
    f = ecef_from_geodetic
    east = f(lat, lon + step, 0.0) - f(lat, lon - step, 0.0)
    north = f(lat + step, lon, 0.0) - f(lat - step, lon, 0.0)
    up = f(lat, lon, 10.0) - f(lat, lon, -10.0)
    for row, d in zip(C_en(lat, lon), (east, north, up), strict=True):
        np.testing.assert_allclose(row, d / np.linalg.norm(d), atol=2e-8)


@given(LATITUDES, LONGITUDES, HEIGHTS, st.tuples(UNIT, UNIT, UNIT))
@settings(deadline=None)
def test_local_frame_round_trip(lat: float, lon: float, h: float, point: tuple[float, float, float]) -> None:
    frame = LocalFrame(lat, lon, h)
    r_n = 20_000.0 * np.array(point)
    np.testing.assert_allclose(frame.from_ecef(frame.to_ecef(r_n)), r_n, rtol=0, atol=5e-9)
    np.testing.assert_allclose(frame.rotate_from_ecef(frame.rotate_to_ecef(r_n)), r_n, rtol=0, atol=1e-10)
    np.testing.assert_allclose(frame.C_en @ frame.C_en.T, np.eye(3), atol=1e-15)


def test_earth_rate_is_the_rotated_ecef_rate() -> None:
    frame = LocalFrame(-0.6, 2.0, 0.0)
    np.testing.assert_allclose(frame.w_ie_n, frame.rotate_from_ecef(np.array([0.0, 0.0, geodesy.OMEGA_E_RPS])), atol=1e-19)


@pytest.mark.parametrize(
    ("lat_deg", "gravity"),
    [
        (0.0, 9.780_325_335_9),  # normal gravity at the equator, the pole and 45 degrees: WGS-84, NIMA TR8350.2, table 3.4
        (90.0, 9.832_184_937_8),
        (45.0, 9.806_197_77),
    ],
)
def test_gravity_of_the_ellipsoid(lat_deg: float, gravity: float) -> None:
    """The library's attraction ends with J2: it must be off by J4's, 5 J4 P4 mu / r^2, up to 1.2e-4 m/s^2 (J6: 2e-6)."""
    frame = LocalFrame(np.deg2rad(lat_deg), 0.4, 0.0)
    g = frame.gravity(np.zeros(3))
    r = np.linalg.norm(frame.origin_ecef)
    s2 = (frame.origin_ecef[2] / r) ** 2
    j4 = 5 * -2.370_912e-6 * (35 * s2**2 - 30 * s2 + 3) / 8 * geodesy.MU_M3S2 * geodesy.A_M**4 / r**6
    assert abs(np.linalg.norm(g) - j4 - gravity) < 3e-6
    assert np.hypot(g[0], g[1]) < 3e-5 and g[2] < 0  # the plumb line is along the normal but for J4


def test_gravity_falls_with_height() -> None:
    """The normal gradient of free air is about 3.086e-6 per second squared."""
    frame = LocalFrame(np.deg2rad(45.0), 0.0, 0.0)
    g = np.linalg.norm(frame.gravity(np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 1000.0]])), axis=1)
    assert abs((g[0] - g[1]) / 1000 - 3.086e-6) < 5e-9


def test_gravitation_is_the_gradient_of_its_potential() -> None:
    def potential(r: Array) -> float:
        d = np.linalg.norm(r)
        return float(geodesy.MU_M3S2 / d * (1 - geodesy.J2 * (geodesy.A_M / d) ** 2 * (1.5 * (r[2] / d) ** 2 - 0.5)))

    r = ecef_from_geodetic(0.7, -1.2, 3000.0)
    step = 100.0
    gradient = [(potential(r + step * e) - potential(r - step * e)) / (2 * step) for e in np.eye(3)]
    np.testing.assert_allclose(gravitation_ecef(r), gradient, atol=2e-9)


# -- attitude --------------------------------------------------------------------------------------


@given(rotation_vectors(np.pi))
@settings(deadline=None)
def test_log_inverts_exp(phi: Array) -> None:
    back = log_so3(exp_so3(phi))
    # half a turn: both signs of the axis are the same rotation, and the error of the angle grows like sqrt of rounding
    if np.linalg.norm(phi) > np.pi - 1e-6:
        back = back * np.sign(back @ phi)
    np.testing.assert_allclose(back, phi, rtol=1e-9, atol=1e-15)


@given(rotation_vectors(10.0), rotation_vectors(10.0))
@settings(deadline=None)
def test_rotations_form_a_group(a: Array, b: Array) -> None:
    A, B = exp_so3(a), exp_so3(b)
    np.testing.assert_allclose(A @ A.T, np.eye(3), atol=2e-14)
    assert np.linalg.det(A) > 0
    np.testing.assert_allclose(exp_so3(-a), A.T, atol=1e-15)
    np.testing.assert_allclose(exp_so3(0.3 * a) @ exp_so3(0.7 * a), A, atol=2e-14)
    np.testing.assert_allclose(A @ exp_so3(b) @ A.T, exp_so3(A @ b), atol=5e-14)  # adjoint
    np.testing.assert_allclose(A @ skew(b) @ A.T, skew(A @ b), atol=2e-14 * max(1.0, float(np.linalg.norm(b))))
    np.testing.assert_allclose(matrix_from_quat(quat_from_matrix(A @ B)), A @ B, atol=2e-14)


@given(rotation_vectors(np.pi), rotation_vectors(np.pi))
@settings(deadline=None)
def test_quaternions_multiply_as_hamiltons(a: Array, b: Array) -> None:
    """q(A B) = q(A) q(B) up to sign, with i j = k; both sides are built apart from the library's own product."""
    p, q = quat_from_matrix(exp_so3(a)), quat_from_matrix(exp_so3(b))
    product = np.concatenate([[p[0] * q[0] - p[1:] @ q[1:]], p[0] * q[1:] + q[0] * p[1:] + np.cross(p[1:], q[1:])])
    whole = quat_from_matrix(exp_so3(a) @ exp_so3(b))
    assert min(np.abs(product - whole).max(), np.abs(product + whole).max()) < 1e-13
    assert whole[0] >= 0 and abs(np.linalg.norm(whole) - 1) < 1e-15 * 4


def test_exp_agrees_with_its_series_across_the_switch() -> None:
    for size in (0.0, 1e-9, 9.9e-5, 1.01e-4, 1e-3, 0.1):
        phi = size * np.array([0.6, -0.48, 0.64])
        S, term, total = skew(phi), np.eye(3), np.eye(3)
        for k in range(1, 12):
            term = term @ S / k
            total = total + term
        np.testing.assert_allclose(exp_so3(phi), total, rtol=0, atol=2e-16 * 3)


def test_exp_turns_counter_clockwise_about_its_axis() -> None:
    np.testing.assert_allclose(exp_so3(np.array([0.0, 0.0, np.pi / 2])) @ [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], atol=1e-15)


@given(st.floats(-1.5, 1.5), st.floats(-3.14, 3.14), st.floats(-3.14, 3.14))
@settings(deadline=None)
def test_euler_matrix_is_the_aerospace_sequence_between_ned_and_frd(pitch: float, roll: float, heading: float) -> None:
    """C_frd^ned = C_3(heading) C_2(pitch) C_1(roll), carried to ENU and RFU. Source: spec common.md, sections 1 and 2."""
    axes = np.eye(3)
    ned = exp_so3(heading * axes[2]) @ exp_so3(pitch * axes[1]) @ exp_so3(roll * axes[0])
    C = matrix_from_euler(pitch, roll, heading)
    np.testing.assert_allclose(C, ENU_NED @ ned @ ENU_NED, atol=5e-16)
    np.testing.assert_allclose(euler_from_matrix(C), (pitch, roll, heading), atol=1e-13)


@pytest.mark.parametrize(
    ("euler_deg", "body", "expected"),
    [
        ((0, 0, 90), (0, 1, 0), (1, 0, 0)),  # heading east: the nose points east
        ((30, 0, 0), (0, 1, 0), (0, np.cos(np.pi / 6), 0.5)),  # pitch up: the nose rises
        ((0, 30, 0), (1, 0, 0), (np.cos(np.pi / 6), 0, -0.5)),  # roll: the right wing falls
    ],
)
def test_signs_of_the_euler_angles(euler_deg: tuple[int, ...], body: tuple[int, ...], expected: tuple[float, ...]) -> None:
    np.testing.assert_allclose(matrix_from_euler(*np.deg2rad(euler_deg)) @ body, expected, atol=1e-15)


def test_functions_of_many_are_those_of_each() -> None:
    rng = np.random.default_rng(4)
    phi = rng.normal(0.0, 2.0, (50, 3))
    many = exp_so3(phi)
    for function, x in (
        (exp_so3, phi),
        (skew, phi),
        (quat_from_matrix, many),
        (log_so3, many),
        (matrix_from_quat, quat_from_matrix(many)),
    ):
        np.testing.assert_array_equal(function(x), np.array([function(one) for one in x]))


# -- GPS time --------------------------------------------------------------------------------------


def test_weeks_carry_both_ways() -> None:
    t = GpsTime(2300, WEEK_S - 0.25)
    assert t + 0.5 == GpsTime(2301, 0.25)
    assert GpsTime(2300, -0.25) == GpsTime(2299, WEEK_S - 0.25)
    assert GpsTime(2300, 3 * WEEK_S) == GpsTime(2303, 0.0)
    assert GpsTime(2301, 0.25) - t == 0.5
    assert GpsTime(2299, WEEK_S - 1) < GpsTime(2300, 0.0)


def test_seconds_of_week_must_be_a_number() -> None:
    with pytest.raises(ValueError, match="sow"):
        GpsTime(2300, float("nan"))


def test_calendar_of_a_known_instant() -> None:
    """1 January 2017 00:00:18 GPST is the leap second's end: week 1930, second 18."""
    assert GpsTime.from_calendar(2017, 1, 1, 0, 0, 18.0) == GpsTime(1930, 18.0)
    assert GpsTime.from_calendar(1980, 1, 6) == GpsTime(0, 0.0)
    assert GpsTime.from_calendar(2024, 2, 29, 23, 59, 60.0) == GpsTime.from_calendar(2024, 3, 1)


@pytest.mark.parametrize(
    ("year", "month", "seconds"), [(2003, 5, 13), (2008, 12, 14), (2012, 6, 15), (2012, 7, 16), (2016, 12, 17), (2024, 6, 18)]
)
def test_leap_seconds(year: int, month: int, seconds: int) -> None:
    utc = datetime(year, month, 20, 12, tzinfo=UTC)
    assert leap_seconds(utc) == seconds
    assert GpsTime.from_utc(utc) - GpsTime.from_calendar(year, month, 20, 12) == seconds


@given(st.datetimes(datetime(2000, 1, 1), datetime(2040, 1, 1)))
def test_utc_round_trip(naive: datetime) -> None:
    """To the microsecond that datetime holds."""
    utc = naive.replace(tzinfo=UTC)
    assert abs(GpsTime.from_utc(utc).utc() - utc) <= timedelta(microseconds=1)


def test_utc_steps_at_the_leap_second() -> None:
    before, after = datetime(2016, 12, 31, 23, 59, 59, tzinfo=UTC), datetime(2017, 1, 1, tzinfo=UTC)
    assert GpsTime.from_utc(after) - GpsTime.from_utc(before) == 2.0
    assert GpsTime.from_utc(before).utc() == before and GpsTime.from_utc(after).utc() == after
