"""Strapdown mechanization in the Earth-fixed local frame n, and its exact inverse.

Motion of the body origin, with the specific force f and the rate w_ib of the body and the Earth's rate w_ie:

    dC_nb/dt = C_nb [w_ib x] - [w_ie x] C_nb
    dv/dt    = C_nb f + g(r) - 2 w_ie x v,      dr/dt = v

g is attraction plus the centrifugal acceleration at r. Sample i holds the means over (t[i-1], t[i]]; with the
increments alpha = w dt and upsilon = f dt (primed: of the sample before) a step is

    phi  = alpha + alpha' x alpha / 12                                            (coning)
    u_b  = A(phi) upsilon + (alpha' x upsilon + upsilon' x alpha) / 12            (rotation and sculling)
    x    = Exp(-w_ie dt / 2) C_nb u_b + g(r + v dt / 2) dt
    v   <- v + x - 2 dt w_ie x (v + x / 2)
    r   <- r + dt (mean of both velocities)
    C_nb <- Exp(-w_ie dt) C_nb Exp(phi)

with A(phi) the left Jacobian of the rotation. Every line can be solved for alpha and upsilon, so samples derived from a
smooth trajectory give its velocity and attitude back to rounding; the position is off by dt^2 / 12 times the change of
acceleration since the start (1e-5 m at 200 Hz).

Source: Savage (1998), two-sample coning and sculling; Groves (2013), ch. 5.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from factorgraph import geodesy
from factorgraph.attitude import matrix_from_quat, quat_from_matrix
from factorgraph.errors import InputError
from factorgraph.geodesy import LocalFrame
from factorgraph.types import Array

_A2_M2, _MU, _J2, _W2 = geodesy.A_M**2, geodesy.MU_M3S2, geodesy.J2, geodesy.OMEGA_E_RPS**2


@njit(cache=True)
def _cross(a, b, out):  # type: ignore[no-untyped-def]
    x = a[1] * b[2] - a[2] * b[1]
    y = a[2] * b[0] - a[0] * b[2]
    out[2] = a[0] * b[1] - a[1] * b[0]
    out[0], out[1] = x, y


@njit(cache=True)
def gravity_into(origin, C_en, r, out):  # type: ignore[no-untyped-def]
    """Scalar twin of LocalFrame.gravity: r (3,) in n."""
    x = origin[0] + C_en[0, 0] * r[0] + C_en[1, 0] * r[1] + C_en[2, 0] * r[2]
    y = origin[1] + C_en[0, 1] * r[0] + C_en[1, 1] * r[1] + C_en[2, 1] * r[2]
    z = origin[2] + C_en[0, 2] * r[0] + C_en[1, 2] * r[1] + C_en[2, 2] * r[2]
    r2 = x * x + y * y + z * z
    s2 = z * z / r2
    k = 1.5 * _J2 * _A2_M2 / r2
    m = -_MU / (r2 * np.sqrt(r2))
    level = m * (1 + k * (1 - 5 * s2)) + _W2
    gx, gy, gz = level * x, level * y, m * (1 + k * (3 - 5 * s2)) * z
    for i in range(3):
        out[i] = C_en[i, 0] * gx + C_en[i, 1] * gy + C_en[i, 2] * gz


@njit(cache=True)
def quat_exp(phi, out):  # type: ignore[no-untyped-def]
    a2 = phi[0] * phi[0] + phi[1] * phi[1] + phi[2] * phi[2]
    if a2 < 1e-6:
        out[0] = 1 - a2 / 8 + a2 * a2 / 384
        s = 0.5 - a2 / 48 + a2 * a2 / 3840
    else:
        a = np.sqrt(a2)
        out[0] = np.cos(a / 2)
        s = np.sin(a / 2) / a
    out[1], out[2], out[3] = s * phi[0], s * phi[1], s * phi[2]


@njit(cache=True)
def _quat_log(q, out):  # type: ignore[no-untyped-def]
    n = np.sqrt(q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    sign = 1.0 if q[0] >= 0 else -1.0
    k = 2 * sign if n < 1e-12 else 2 * np.arctan2(n, sign * q[0]) / n * sign
    out[0], out[1], out[2] = k * q[1], k * q[2], k * q[3]


@njit(cache=True)
def quat_mul(p, q, out):  # type: ignore[no-untyped-def]
    w = p[0] * q[0] - p[1] * q[1] - p[2] * q[2] - p[3] * q[3]
    x = p[0] * q[1] + p[1] * q[0] + p[2] * q[3] - p[3] * q[2]
    y = p[0] * q[2] - p[1] * q[3] + p[2] * q[0] + p[3] * q[1]
    z = p[0] * q[3] + p[1] * q[2] - p[2] * q[1] + p[3] * q[0]
    out[0], out[1], out[2], out[3] = w, x, y, z


@njit(cache=True)
def _rotate(q, v, out):  # type: ignore[no-untyped-def]
    """out = C(q) v; out may be v."""
    tx = 2 * (q[2] * v[2] - q[3] * v[1])
    ty = 2 * (q[3] * v[0] - q[1] * v[2])
    tz = 2 * (q[1] * v[1] - q[2] * v[0])
    x = v[0] + q[0] * tx + q[2] * tz - q[3] * ty
    y = v[1] + q[0] * ty + q[3] * tx - q[1] * tz
    z = v[2] + q[0] * tz + q[1] * ty - q[2] * tx
    out[0], out[1], out[2] = x, y, z


@njit(cache=True)
def _left_jacobian(phi, J):  # type: ignore[no-untyped-def]
    """Mean of Exp(s phi) over s in [0, 1]."""
    a2 = phi[0] * phi[0] + phi[1] * phi[1] + phi[2] * phi[2]
    if a2 < 1e-4:
        c, d = 0.5 - a2 / 24 + a2 * a2 / 720, 1.0 / 6 - a2 / 120 + a2 * a2 / 5040
    else:
        a = np.sqrt(a2)
        c, d = (1 - np.cos(a)) / a2, (a - np.sin(a)) / (a2 * a)
    for i in range(3):
        for j in range(3):
            J[i, j] = d * phi[i] * phi[j]
        J[i, i] += 1 - d * a2
    J[0, 1] -= c * phi[2]
    J[0, 2] += c * phi[1]
    J[1, 0] += c * phi[2]
    J[1, 2] -= c * phi[0]
    J[2, 0] -= c * phi[1]
    J[2, 1] += c * phi[0]


@njit(cache=True)
def propagate_into(origin, C_en, w_ie, t, f, w, r, v, q):  # type: ignore[no-untyped-def]
    """Fill r, v, q from their first rows; increments of the step before row 1 are taken equal to its own.

    The compiled part of `propagate`: origin (3,) ECEF, C_en (3, 3), w_ie (3,), t (n,), the others (n, 3), q (n, 4).
    """
    alpha, upsilon, alpha0, upsilon0 = np.zeros((4, 3))
    phi, u, x, a, b, g, rm, half = np.zeros((8, 3))
    J, dq, earth = np.zeros((3, 3)), np.zeros(4), np.zeros(4)
    for i in range(1, len(t)):
        dt = t[i] - t[i - 1]
        for k in range(3):
            alpha[k], upsilon[k] = w[i, k] * dt, f[i, k] * dt
            if i == 1:
                alpha0[k], upsilon0[k] = alpha[k], upsilon[k]
        _cross(alpha0, alpha, a)
        for k in range(3):
            phi[k] = alpha[k] + a[k] / 12
        _left_jacobian(phi, J)
        _cross(alpha0, upsilon, a)
        _cross(upsilon0, alpha, b)
        for k in range(3):
            u[k] = J[k, 0] * upsilon[0] + J[k, 1] * upsilon[1] + J[k, 2] * upsilon[2] + (a[k] + b[k]) / 12
            half[k] = -w_ie[k] * dt / 2
            rm[k] = r[i - 1, k] + v[i - 1, k] * dt / 2
            alpha0[k], upsilon0[k] = alpha[k], upsilon[k]
        quat_exp(half, earth)
        _rotate(q[i - 1], u, x)
        _rotate(earth, x, x)
        gravity_into(origin, C_en, rm, g)
        for k in range(3):
            x[k] += g[k] * dt
            b[k] = v[i - 1, k] + x[k] / 2
        _cross(w_ie, b, a)
        for k in range(3):
            v[i, k] = v[i - 1, k] + x[k] - 2 * dt * a[k]
            r[i, k] = r[i - 1, k] + dt / 2 * (v[i - 1, k] + v[i, k])
        quat_mul(earth, earth, earth)
        quat_exp(phi, dq)
        quat_mul(earth, q[i - 1], q[i])
        quat_mul(q[i], dq, q[i])
        n = np.sqrt(q[i, 0] ** 2 + q[i, 1] ** 2 + q[i, 2] ** 2 + q[i, 3] ** 2)
        for k in range(4):
            q[i, k] /= n


@njit(cache=True)
def _invert(origin, C_en, w_ie, t, r, v, q, f, w):  # type: ignore[no-untyped-def]
    """Fill f and w from row 1; the inverse of `propagate_into`, line by line backwards."""
    alpha, upsilon, alpha0, upsilon0 = np.zeros((4, 3))
    x, a, b, g, rm, half, e, phi = np.zeros((8, 3))
    J, M, dq, back, earth = np.zeros((3, 3)), np.zeros((3, 3)), np.zeros(4), np.zeros(4), np.zeros(4)
    for i in range(1, len(t)):
        dt = t[i] - t[i - 1]
        for k in range(3):
            half[k] = w_ie[k] * dt / 2
            e[k] = w_ie[k] * dt
            rm[k] = r[i - 1, k] + v[i - 1, k] * dt / 2
        # rotation: Exp(phi) = (Exp(-w_ie dt) C_prev)^T C
        quat_exp(half, earth)
        back[0], back[1], back[2], back[3] = q[i - 1, 0], -q[i - 1, 1], -q[i - 1, 2], -q[i - 1, 3]
        quat_mul(earth, earth, dq)
        quat_mul(back, dq, dq)
        quat_mul(dq, q[i], dq)
        _quat_log(dq, phi)
        if i == 1:
            alpha[:] = phi
        else:
            _solve_one_plus_cross(alpha0 / 12, phi, alpha)
        # velocity: (I - dt [w_ie x]) x = dv + 2 dt w_ie x v
        _cross(w_ie, v[i - 1], a)
        for k in range(3):
            b[k] = v[i, k] - v[i - 1, k] + 2 * dt * a[k]
        _solve_one_plus_cross(-e, b, x)
        gravity_into(origin, C_en, rm, g)
        for k in range(3):
            x[k] -= g[k] * dt
        _rotate(earth, x, x)
        _rotate(back, x, x)
        # force: (J + [alpha' x] / 12) upsilon - [alpha x] upsilon' / 12 = u; the first step has upsilon' = upsilon
        _left_jacobian(phi, J)
        M[:] = J
        if i > 1:
            M[0, 1] -= alpha0[2] / 12
            M[0, 2] += alpha0[1] / 12
            M[1, 0] += alpha0[2] / 12
            M[1, 2] -= alpha0[0] / 12
            M[2, 0] -= alpha0[1] / 12
            M[2, 1] += alpha0[0] / 12
            _cross(alpha, upsilon0, a)
            for k in range(3):
                x[k] += a[k] / 12
        upsilon[:] = np.linalg.solve(M, x)
        for k in range(3):
            w[i, k], f[i, k] = alpha[k] / dt, upsilon[k] / dt
            alpha0[k], upsilon0[k] = alpha[k], upsilon[k]


@njit(cache=True)
def _solve_one_plus_cross(c, y, x):  # type: ignore[no-untyped-def]
    """x = (I + [c x])^-1 y = (y - c x y + c c.y) / (1 + c.c)."""
    d = c[0] * y[0] + c[1] * y[1] + c[2] * y[2]
    n = 1 + c[0] * c[0] + c[1] * c[1] + c[2] * c[2]
    z = np.zeros(3)
    _cross(c, y, z)
    for k in range(3):
        x[k] = (y[k] - z[k] + c[k] * d) / n


def _shaped(name: str, values: Array, shape: tuple[int, ...]) -> Array:
    out = np.ascontiguousarray(values, float)
    if out.shape != shape:
        raise InputError(f"{name} must have shape {shape}, got {out.shape}")
    return out


def propagate(
    frame: LocalFrame, t_s: Array, f_b: Array, w_b: Array, r0_n: Array, v0_n: Array, C_nb0: Array
) -> tuple[Array, Array, Array]:
    """Position (n, 3), velocity (n, 3) and C_nb (n, 3, 3) at every sample, from the state at t_s[0].

    f_b, w_b (n, 3): mean specific force and rate over (t_s[i-1], t_s[i]]; row 0 is not used.
    Raises InputError on shapes that do not match.
    """
    n = len(t_s)
    r, v, q = np.zeros((n, 3)), np.zeros((n, 3)), np.zeros((n, 4))
    r[0], v[0] = _shaped("r0_n", r0_n, (3,)), _shaped("v0_n", v0_n, (3,))
    q[0] = quat_from_matrix(_shaped("C_nb0", C_nb0, (3, 3)))
    f, w = _shaped("f_b", f_b, (n, 3)), _shaped("w_b", w_b, (n, 3))
    propagate_into(frame.origin_ecef, np.ascontiguousarray(frame.C_en), frame.w_ie_n, _shaped("t_s", t_s, (n,)), f, w, r, v, q)
    return r, v, matrix_from_quat(q)


def ideal_imu(frame: LocalFrame, t_s: Array, r_n: Array, v_n: Array, C_nb: Array) -> tuple[Array, Array]:
    """Mean specific force and rate (n, 3) over (t_s[i-1], t_s[i]] that `propagate` turns back into the trajectory.

    r_n, v_n (n, 3), C_nb (n, 3, 3): a smooth trajectory at t_s, n > 1. Row 0 repeats row 1.
    Raises InputError on shapes that do not match.
    """
    n = len(t_s)
    if n < 2:
        raise InputError(f"ideal_imu needs at least two samples, got {n}")
    r, v = _shaped("r_n", r_n, (n, 3)), _shaped("v_n", v_n, (n, 3))
    q = quat_from_matrix(_shaped("C_nb", C_nb, (n, 3, 3)))
    f, w = np.zeros((n, 3)), np.zeros((n, 3))
    _invert(frame.origin_ecef, np.ascontiguousarray(frame.C_en), frame.w_ie_n, _shaped("t_s", t_s, (n,)), r, v, q, f, w)
    f[0], w[0] = f[1], w[1]
    return f, w
