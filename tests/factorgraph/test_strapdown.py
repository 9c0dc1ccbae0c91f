"""Strapdown mechanization: closure with its inverse, gravity twin, agreement with an independent integration."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from factorgraph.attitude import exp_so3, log_so3, matrix_from_euler
from factorgraph.errors import InputError
from factorgraph.geodesy import LocalFrame
from factorgraph.models.strapdown import gravity_into, ideal_imu, propagate
from factorgraph.types import Array

FRAME = LocalFrame(np.deg2rad(55.0), np.deg2rad(37.0), 200.0)


def weaving(t: Array) -> tuple[Array, Array, Array]:
    """About 100 m/s with turns, climbs and attitude motion; velocity is the exact derivative."""
    a, w = np.array([400.0, 300.0, 60.0]), np.array([0.05, 0.071, 0.11])
    v0 = np.array([60.0, 75.0, 0.5])
    r = v0 * t[:, None] + a * np.sin(w * t[:, None])
    v = v0 + a * w * np.cos(w * t[:, None])
    C = matrix_from_euler(0.1 * np.sin(0.3 * t), 0.6 * np.sin(0.2 * t), 0.02 * t + 0.8 * np.sin(0.07 * t))
    return r, v, C


def test_twenty_minutes_at_200_hz_close() -> None:
    """Spec common.md, M2: noise-free 1200 s at 100 m/s within 1 cm and 1e-6 rad."""
    t = np.arange(240_001) * 0.005
    r, v, C = weaving(t)
    f, w = ideal_imu(FRAME, t, r, v, C)
    r2, v2, C2 = propagate(FRAME, t, f, w, r[0], v[0], C[0])
    assert np.max(np.abs(r2 - r)) < 5e-4
    assert np.max(np.abs(v2 - v)) < 1e-6
    assert np.max(np.abs(log_so3(np.swapaxes(C2, 1, 2) @ C))) < 1e-9


def test_gravity_twin_is_the_frames_gravity() -> None:
    r = np.random.default_rng(1).uniform(-1, 1, (20, 3)) * [3e4, 3e4, 5e3]
    out = np.zeros((20, 3))
    for i in range(20):
        gravity_into(FRAME.origin_ecef, FRAME.C_en, r[i], out[i])
    np.testing.assert_allclose(out, FRAME.gravity(r), rtol=0, atol=1e-14 * 9.8 * 10)


def test_rest_feels_gravity_and_earth_rate() -> None:
    t = np.arange(20) * 0.005
    r, C = np.tile([1000.0, -500.0, 50.0], (20, 1)), np.tile(matrix_from_euler(0.1, -0.2, 2.0), (20, 1, 1))
    f, w = ideal_imu(FRAME, t, r, np.zeros((20, 3)), C)
    np.testing.assert_allclose(f, -FRAME.gravity(r) @ C[0], atol=1e-10)
    np.testing.assert_allclose(w, np.tile(FRAME.w_ie_n @ C[0], (20, 1)), atol=1e-12)


def test_true_means_of_a_coning_motion_integrate_to_the_motion() -> None:
    """Against a Runge-Kutta solution of the differential equations, in free flight with fast rotation.

    Without the coning and sculling terms the errors are beyond the bounds.
    """
    rate, force = np.array([0.8, -0.5, 1.1]), np.array([3.0, -2.0, 11.0])

    def w_of(t: float) -> Array:
        return rate * np.array([np.sin(20 * t), np.cos(20 * t), 1.0])

    def f_of(t: float) -> Array:
        return force * np.array([np.cos(20 * t), np.sin(20 * t), 1.0])

    def derivative(t: float, y: Array) -> Array:
        C, v, r = y[:9].reshape(3, 3), y[9:12], y[12:15]
        w_b = w_of(t) - FRAME.w_ie_n @ C
        S = np.array([[0.0, -w_b[2], w_b[1]], [w_b[2], 0.0, -w_b[0]], [-w_b[1], w_b[0], 0.0]])
        dv = C @ f_of(t) + FRAME.gravity(r) - 2 * np.cross(FRAME.w_ie_n, v)
        return np.concatenate([(C @ S).ravel(), dv, v, w_of(t), f_of(t)])

    t = np.arange(401) * 0.005
    C0, v0 = exp_so3(np.array([0.3, -0.2, 0.5])), np.array([20.0, -5.0, 1.0])
    start = np.concatenate([C0.ravel(), v0, np.zeros(9)])
    y = solve_ivp(derivative, (0.0, t[-1]), start, t_eval=t, rtol=1e-12, atol=1e-12, max_step=0.01).y.T
    w, f = (np.vstack([np.zeros(3), np.diff(y[:, k : k + 3], axis=0) / 0.005]) for k in (15, 18))
    r, v, C = propagate(FRAME, t, f, w, np.zeros(3), v0, C0)
    assert np.max(np.abs(log_so3(np.swapaxes(y[:, :9].reshape(-1, 3, 3), 1, 2) @ C))) < 2e-6
    assert np.max(np.abs(v - y[:, 9:12])) < 2e-5
    assert np.max(np.abs(r - y[:, 12:15])) < 2e-4


def test_wrong_shapes_are_named() -> None:
    t = np.arange(3.0)
    with pytest.raises(InputError, match="f_b must have shape"):
        propagate(FRAME, t, np.zeros((2, 3)), np.zeros((3, 3)), np.zeros(3), np.zeros(3), np.eye(3))
    with pytest.raises(InputError, match="at least two"):
        ideal_imu(FRAME, t[:1], np.zeros((1, 3)), np.zeros((1, 3)), np.eye(3)[None])
