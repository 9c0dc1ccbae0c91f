"""Compiled parts of observed points and of GNSS predictions: one pass over the rows instead of a temporary per term."""

from __future__ import annotations

import numpy as np
from numba import njit

from factorgraph.models.small import apply, exp, mul


@njit(cache=True)
def _minus_cross(A, x, out):  # type: ignore[no-untyped-def]
    """out = -A [x x]."""
    for i in range(3):
        out[i, 0] = A[i, 2] * x[1] - A[i, 1] * x[2]
        out[i, 1] = A[i, 0] * x[2] - A[i, 2] * x[0]
        out[i, 2] = A[i, 1] * x[0] - A[i, 0] * x[1]


@njit(cache=True)
def carried_points(k, dt_s, lever, R, r, v, g, rate, db, w_ie, dR, dv, dp, dR_g, dv_g, dv_a, dp_g, dp_a, velocity, out):  # type: ignore[no-untyped-def]
    """Points carried forward by increments: `variables` has the equations, `out` is r, v (n, 3), J_r, J_v (n, 3, 15), R_t.

    R, r, v per state; k, dt_s, lever, g, rate, db (gyroscope, accelerometer) and the increments per point.
    """
    r_out, v_out, J_r, J_v, R_out = out
    turned, E, T, M, Rt = np.empty((5, 3, 3))
    phi, p, u, at, wl, x = np.empty((6, 3))
    for n in range(len(k)):
        Rk, dt, lb = R[k[n]], dt_s[n], lever[n]
        # up to NEAR_S before its state no increments carry a point, so gravity alone must not: constant velocity and rate
        ahead, behind = max(dt, 0.0), min(dt, 0.0)
        for i in range(3):
            phi[i] = rate[n, i] * behind
            p[i], u[i] = dp[n, i], dv[n, i]
            for j in range(3):
                phi[i] += dR_g[n, i, j] * db[n, j]
                p[i] += dp_g[n, i, j] * db[n, j] + dp_a[n, i, j] * db[n, 3 + j]
                u[i] += dv_g[n, i, j] * db[n, j] + dv_a[n, i, j] * db[n, 3 + j]
        exp(phi, E)
        mul(dR[n], E, turned)
        for i in range(3):
            x[i] = -w_ie[i] * ahead
        exp(x, E)
        mul(E, Rk, T)
        mul(T, turned, Rt)
        R_out[n] = Rt
        apply(turned, lb, at)  # lever arm, in the body frame of the state
        apply(Rt, lb, x)
        for i in range(3):
            total = 0.0
            for j in range(3):
                total += Rk[i, j] * p[j]
                phi[j] = p[j] + at[j]
                J_r[n, i, 3 + j] = Rk[i, j]
            r_out[n, i] = r[k[n], i] + v[k[n], i] * dt + 0.5 * g[n, i] * ahead * ahead + total + x[i]
            J_r[n, i, 6 + i] = dt
        _minus_cross(Rk, phi, J_r[n, :, 0:3])
        mul(Rk, dp_a[n], J_r[n, :, 9:12])
        _minus_cross(Rt, lb, T)
        mul(T, dR_g[n], M)
        mul(Rk, dp_g[n], E)
        for i in range(3):
            for j in range(3):
                J_r[n, i, 12 + j] = E[i, j] + M[i, j]
        if not velocity:
            continue
        wl[0] = rate[n, 1] * lb[2] - rate[n, 2] * lb[1]
        wl[1] = rate[n, 2] * lb[0] - rate[n, 0] * lb[2]
        wl[2] = rate[n, 0] * lb[1] - rate[n, 1] * lb[0]
        apply(turned, wl, at)
        apply(Rt, wl, x)
        for i in range(3):
            total = 0.0
            for j in range(3):
                total += Rk[i, j] * u[j]
                phi[j] = u[j] + at[j]
            v_out[n, i] = v[k[n], i] + g[n, i] * ahead + total + x[i]
            J_v[n, i, 6 + i] = 1.0
        _minus_cross(Rk, phi, J_v[n, :, 0:3])
        mul(Rk, dv_a[n], J_v[n, :, 9:12])
        mul(Rk, dv_g[n], E)
        _minus_cross(Rt, wl, M)
        mul(M, dR_g[n], turned)
        for i in range(3):
            for j in range(3):
                J_v[n, i, 12 + j] = E[i, j] + turned[i, j] - T[i, j]


@njit(cache=True)
def one_way(at, is_rate, r, v, sat, vel):  # type: ignore[no-untyped-def]
    """Range or range rate (n,) of every row to its point r, v (m, 3), its gradient by r (n, 3), and the direction (n, 3)."""
    n = len(at)
    y, by_r, e = np.empty(n), np.empty((n, 3)), np.empty((n, 3))
    for i in range(n):
        p = at[i]
        dx, dy, dz = sat[i, 0] - r[p, 0], sat[i, 1] - r[p, 1], sat[i, 2] - r[p, 2]
        rho = np.sqrt(dx * dx + dy * dy + dz * dz)
        e[i, 0], e[i, 1], e[i, 2] = dx / rho, dy / rho, dz / rho
        if not is_rate[i]:
            y[i] = rho
            for c in range(3):
                by_r[i, c] = -e[i, c]
            continue
        rate = 0.0
        for c in range(3):
            rate += e[i, c] * (vel[i, c] - v[p, c])
        y[i] = rate
        for c in range(3):  # d rate / d r = -(rel - e (e . rel)) / rho
            by_r[i, c] = -(vel[i, c] - v[p, c] - e[i, c] * rate) / rho
    return y, by_r, e
