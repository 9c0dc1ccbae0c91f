"""Kernels of `filters.passes`: the recursion over the stages of a flight whose rows are given.

One interval of an IMU, at the predicted state, where the residual of `models.imu_interval` is zero (E = Exp(theta),
C = Exp(-w dt), W = [w x]; rotation, position, velocity, biases):

    F = [ E'               0                      0           Jr(theta) B_theta       ]
        [ -E' [p x]        E' (I + dt R' W R)     dt E' R'    E' B_p                  ]
        [ C (W R [p x]     -dt C W W R            C (I -dt W) C (R B_v - W R B_p)     ]
        [    - R [v x])                                                               ]
        [ 0                0                      0           I                       ]

with B the increments' Jacobians to biases, and to scale factors likewise; Q is the residual's covariance with the rows of the
velocity turned from the predicted body frame.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from factorgraph.filters.kalman import predict, scalar_updates
from factorgraph.models.imu_interval import carry_intervals
from factorgraph.models.small import apply, inverse_coefficients, jr_coefficients, mul, polynomial
from factorgraph.types import Array, BoolArray, IntArray

LARGE = 1e5  # innovation variance of a whitened row


class Motion(NamedTuple):
    """Intervals of V vehicles, M = K - 1 each; accelerometer before gyroscope but in biases."""

    has_imu: BoolArray  # (V,)
    offset: IntArray  # (V,) first column
    F: Array  # (V, M, 6, 6) of vehicles without IMU
    Q: Array  # (V, M, 15, 15) of a residual; without IMU (6, 6) of it, of the transition
    dt_s: Array  # (V, M)
    zeta: Array  # (V, M, 9)
    by_bias: Array  # (V, M, 9, 6)
    by_scale: Array  # (V, M, 9, 6)
    at_bias: Array  # (V, M, 6) gyroscope first
    gravitation_n: Array  # (V, M, 3)
    w_ie_n: Array  # (V, 3)
    scale: Array  # (V, 6) scale factors not taken out of the increments, at the parameters' values
    number: IntArray  # (V, 6) of these parameters' components, -1 without
    column: IntArray  # (V, 12) of biases and scale factors, -1 without


class Layout(NamedTuple):
    """Columns and rows of the stages; flat arrays by `first_...` (K + 1,)."""

    n_states: int
    n_fixed: int
    first_live: IntArray
    before: IntArray  # (live,) column at the stage before, -1 of new scalars
    sigma: Array  # (live,)
    first_row: IntArray
    judged: IntArray  # (K,) rows of the stage that are judged, the first ones
    first_entry: IntArray  # (rows + 1,) of the rows
    column: IntArray  # (entries,)
    first_column: IntArray
    first_square: IntArray  # of P, its prior and Q
    first_step: IntArray  # of F


class Points(NamedTuple):
    """States of V vehicles at K stages."""

    R: Array  # (V, K, 3, 3)
    r: Array  # (V, K, 3)
    v: Array  # (V, K, 3)
    bias: Array  # (V, K, 6) gyroscope first


class Found(NamedTuple):
    """What a pass leaves, flat as `Layout` says."""

    predicted: Points
    filtered: Points
    dx: Array
    P: Array
    prior: Array
    Q: Array
    F: Array
    T: Array  # (V, K, 2, 3, 3) of rotation and position, as in `Stages.transport`
    nis: Array  # (K,) of judged rows
    drift: Array  # (K,) of predictions from where rows were evaluated, largest component in standard deviations
    innovation: Array  # (rows,) whitened
    variance: Array  # (rows,) of it
    left: Array  # (rows,) what the update leaves
    z: Array  # deviations of parameters and scalars after the update; zeros of states


@njit(cache=True)
def _exp(x, sign, out):  # type: ignore[no-untyped-def]
    """out = Exp(sign x)."""
    t2 = x[0] ** 2 + x[1] ** 2 + x[2] ** 2
    b, c, _, _ = jr_coefficients(t2)
    polynomial(x, 1.0, sign * (1 - c * t2), b, out)


@njit(cache=True)
def _right(x, out):  # type: ignore[no-untyped-def]
    """out = Jr(x)."""
    b, c, _, _ = jr_coefficients(x[0] ** 2 + x[1] ** 2 + x[2] ** 2)
    polynomial(x, 1.0, -b, c, out)


@njit(cache=True)
def _log(A, out):  # type: ignore[no-untyped-def]
    """out = Log(A) of a rotation by less than half a turn."""
    out[0], out[1], out[2] = 0.5 * (A[2, 1] - A[1, 2]), 0.5 * (A[0, 2] - A[2, 0]), 0.5 * (A[1, 0] - A[0, 1])
    s = np.sqrt(out[0] ** 2 + out[1] ** 2 + out[2] ** 2)
    if s > 1e-9:
        factor = np.arctan2(s, 0.5 * (A[0, 0] + A[1, 1] + A[2, 2] - 1)) / s
        for i in range(3):
            out[i] *= factor


@njit(cache=True)
def _put(A, factor, i0, j0, out):  # type: ignore[no-untyped-def]
    """out[i0 : i0 + 3, j0 : j0 + 3] += factor A."""
    for i in range(3):
        for j in range(3):
            out[i0 + i, j0 + j] += factor * A[i, j]


@njit(cache=True)
def _copy(a, out):  # type: ignore[no-untyped-def]
    for i in range(len(a)):
        out[i] = a[i]


@njit(cache=True)
def _sensors(by, change, zeta):  # type: ignore[no-untyped-def]
    """zeta (9,) += by (9, 6) change (6,)."""
    for i in range(9):
        for j in range(6):
            zeta[i] += by[i, j] * change[j]


@njit(cache=True)
def _turned(A, by, i0, row, columns, out):  # type: ignore[no-untyped-def]
    """out[i0 : i0 + 3, columns] += A by[row : row + 3] for columns that are not negative."""
    for c in range(6):
        if columns[c] >= 0:
            for i in range(3):
                out[i0 + i, columns[c]] += A[i, 0] * by[row, c] + A[i, 1] * by[row + 1, c] + A[i, 2] * by[row + 2, c]


@njit(cache=True)
def _inertial(h, w, zeta, R, R_next, S, at, F, Q, work):  # type: ignore[no-untyped-def]
    """F (n, n), which is unity before, but for sensors' columns, and Q (n, n) of an interval whose state is at column `at`.

    Leaves Jr(theta), E', C R and -C W R in work[:4] (9, 3, 3).
    """
    Jr, Et, CR, CWR, C, W, X, Y, A = work[0], work[1], work[2], work[3], work[4], work[5], work[6], work[7], work[8]
    theta, p, v, turn = zeta[:3], zeta[3:6], zeta[6:9], np.empty(3)
    for i in range(3):
        turn[i] = -h * w[i]
    _right(theta, Jr)
    _exp(theta, -1.0, Et)
    _exp(turn, 1.0, C)
    polynomial(w, 0.0, 1.0, 0.0, W)
    for i in range(9):
        F[at + i, at + i] = 0.0
    _put(Et, 1.0, at, at, F)
    _put(Et, 1.0, at + 3, at + 3, F)
    _put(C, 1.0, at + 6, at + 6, F)
    mul(C, W, X)
    _put(X, -h, at + 6, at + 6, F)
    mul(W, R, Y)
    mul(X, Y, A)  # C W W R
    _put(A, -h, at + 6, at + 3, F)
    mul(C, R, CR)
    mul(C, Y, CWR)
    mul(Et, R.T, X)
    _put(X, h, at + 3, at + 6, F)
    mul(X, Y, A)  # E' R' W R
    _put(A, h, at + 3, at + 3, F)
    polynomial(p, 0.0, 1.0, 0.0, X)
    mul(Et, X, A)
    _put(A, -1.0, at + 3, at, F)
    mul(CWR, X, A)
    _put(A, 1.0, at + 6, at, F)
    polynomial(v, 0.0, 1.0, 0.0, X)
    mul(CR, X, A)
    _put(A, -1.0, at + 6, at, F)
    for i in range(3):
        for j in range(3):
            CWR[i, j] = -CWR[i, j]
    for i in range(15):
        for j in range(15):
            Q[at + i, at + j] = S[i, j]
    for j in range(15):
        apply(R_next, S[6:9, j], Q[at + 6 : at + 9, at + j])
    for i in range(15):
        for j in range(3):
            turn[j] = Q[at + i, at + 6 + j]
        apply(R_next, turn, Q[at + i, at + 6 : at + 9])


@njit(cache=True)
def _by_sensors(by, columns, at, F, work):  # type: ignore[no-untyped-def]
    """Columns of biases or scale factors in F; work: what `_inertial` left."""
    _turned(work[0], by, at, 0, columns, F)
    _turned(work[1], by, at + 3, 3, columns, F)
    _turned(work[2], by, at + 6, 6, columns, F)
    _turned(work[3], by, at + 6, 3, columns, F)


@njit(cache=True)
def _carry(m, u, k, z, x, to, F, Q):  # type: ignore[no-untyped-def]
    """State k + 1 of `to` from state k of x, and F and Q of the interval; z: deviations of the parameters."""
    at, h = m.offset[u], m.dt_s[u, k]
    R, r, v, bias = np.empty((2, 3, 3)), np.empty((2, 3)), np.empty((2, 3)), x.bias[u, k]
    _copy(bias, to.bias[u, k + 1])
    _copy(x.r[u, k], r[0])
    _copy(x.v[u, k], v[0])
    for i in range(3):
        _copy(x.R[u, k, i], R[0, i])
    if m.has_imu[u]:
        zeta, work, change = np.empty((1, 9)), np.empty((9, 3, 3)), np.empty(6)
        _copy(m.zeta[u, k], zeta[0])
        columns = m.column[u]
        for j in range(6):
            change[j] = bias[(j + 3) % 6] - m.at_bias[u, k, (j + 3) % 6]
        _sensors(m.by_bias[u, k], change, zeta[0])
        for j in range(6):
            change[j] = m.scale[u, j] + (z[m.number[u, j]] if m.number[u, j] >= 0 else 0.0)
        _sensors(m.by_scale[u, k], change, zeta[0])
        carry_intervals(m.dt_s[u, k : k + 1], zeta, m.gravitation_n[u, k : k + 1], m.w_ie_n[u], R, r, v)
        _inertial(h, m.w_ie_n[u], zeta[0], R[0], R[1], m.Q[u, k], at, F, Q, work)
        _by_sensors(m.by_bias[u, k], columns[:6], at, F, work)
        _by_sensors(m.by_scale[u, k], columns[6:], at, F, work)
    else:
        for i in range(3):
            r[1, i], v[1, i] = r[0, i] + h * v[0, i], v[0, i]
            _copy(R[0, i], R[1, i])
        for i in range(6):
            for j in range(6):
                F[at + i, at + j], Q[at + i, at + j] = m.F[u, k, i, j], m.Q[u, k, i, j]
    _copy(r[1], to.r[u, k + 1])
    _copy(v[1], to.v[u, k + 1])
    for i in range(3):
        _copy(R[1, i], to.R[u, k + 1, i])


@njit(cache=True)
def _times(X, at, A):  # type: ignore[no-untyped-def]
    """X[:, at : at + 3] <- X[:, at : at + 3] A, zeros skipped."""
    for i in range(len(X)):
        a, b, c = X[i, at], X[i, at + 1], X[i, at + 2]
        if a != 0.0 or b != 0.0 or c != 0.0:
            for j in range(3):
                X[i, at + j] = a * A[0, j] + b * A[1, j] + c * A[2, j]


@njit(cache=True)
def _deviation(at, R, r, v, bias, R_at, r_at, v_at, bias_at, has_imu, d):  # type: ignore[no-untyped-def]
    """Deviation of a state from another, in columns `at` of d."""
    A, x = np.empty((3, 3)), np.empty(3)
    for i in range(3):
        x[i] = r[i] - r_at[i]
    if not has_imu:
        for i in range(3):
            d[at + i], d[at + 3 + i] = x[i], v[i] - v_at[i]
        return
    mul(R_at.T, R, A)
    _log(A, d[at : at + 3])
    apply(R_at.T, x, d[at + 3 : at + 6])
    for i in range(3):
        d[at + 6 + i] = v[i] - v_at[i]
        d[at + 9 + i], d[at + 12 + i] = bias[3 + i] - bias_at[3 + i], bias[i] - bias_at[i]


@njit(cache=True)
def _to_predicted(at, x, H):  # type: ignore[no-untyped-def]
    """Columns by errors about where rows were evaluated become those by errors about a state turned by x from there."""
    A = np.empty((3, 3))
    c, _ = inverse_coefficients(x[0] ** 2 + x[1] ** 2 + x[2] ** 2)
    polynomial(x, 1.0, 0.5, c, A)
    _times(H, at, A)
    _exp(x, 1.0, A)
    _times(H, at + 3, A)


@njit(cache=True)
def _feed_back(dx, R, r, v, bias, R_to, r_to, v_to, bias_to, T, has_imu):  # type: ignore[no-untyped-def]
    """A state moved by dx, and what takes errors there."""
    E = np.empty((3, 3))
    if not has_imu:
        for i in range(3):
            r_to[i], v_to[i] = r[i] + dx[i], v[i] + dx[3 + i]
            _copy(R[i], R_to[i])
        return
    turn = dx[:3]
    _exp(turn, 1.0, E)
    mul(R, E, R_to)
    apply(R, dx[3:6], r_to)
    for i in range(3):
        r_to[i], v_to[i] = r_to[i] + r[i], v[i] + dx[6 + i]
        bias_to[3 + i], bias_to[i] = bias[3 + i] + dx[9 + i], bias[i] + dx[12 + i]
    _right(turn, T[0])
    _exp(turn, -1.0, T[1])


@njit(cache=True, error_model="numpy")
def _rows(e, value, first_entry, column, first, d, H, y):  # type: ignore[no-untyped-def]
    """Innovations y and H of a stage, whose rows begin at `first`."""
    for i in range(len(y)):
        y[i] = e[first + i]
        for at in range(first_entry[first + i], first_entry[first + i + 1]):
            H[i, column[at]] += value[at]
            y[i] -= value[at] * d[column[at]]


@njit(cache=True, error_model="numpy")
def _variances(P, H, out):  # type: ignore[no-untyped-def]
    """1 + diag(H P H')."""
    n = len(P)
    for i in range(len(H)):
        total = 1.0
        for a in range(n):
            if H[i, a] != 0.0:
                part = 0.0
                for b in range(n):
                    part += P[a, b] * H[i, b]
                total += H[i, a] * part
        out[i] = total


@njit(cache=True, error_model="numpy")
def _update(P, y, H, dx):  # type: ignore[no-untyped-def]
    """Process whitened rows one at a time: P becomes the posterior and dx grows, in place. Returns y' inv(S) y.

    P - g g' with g = P h / sqrt(s) loses as many digits as s = 1 + h' P h has: rows with large ones take the form of Joseph.
    """
    n, nis = len(P), 0.0
    g, one, seen = np.empty(n), np.empty(1), np.empty(n, np.int64)
    for i in range(len(y)):
        nu, s, count = y[i], 1.0, 0
        for k in range(n):
            g[k] = 0.0
        for j in range(n):
            c = H[i, j]
            if c != 0.0:
                seen[count] = j
                count += 1
                nu -= c * dx[j]
                for k in range(n):
                    g[k] += c * P[j, k]
        for e in range(count):
            s += H[i, seen[e]] * g[seen[e]]
        if s > LARGE:
            one[0] = nu
            more, share = scalar_updates(P, one, H[i : i + 1])
            for k in range(n):
                dx[k] += more[k]
            nis += share
            continue
        nis += nu * nu / s
        root = 1.0 / np.sqrt(s)
        for k in range(n):
            g[k] *= root
        for j in range(n):
            c = g[j]
            dx[j] += c * nu * root
            for k in range(n):
                P[j, k] -= c * g[k]
    return nis


@njit(cache=True, error_model="numpy")
def scan(m: Motion, s: Layout, e: Array, value: Array, at: Points, P0: Array, weighed: bool, out: Found) -> None:
    """Filter a flight with rows e (rows,), value (entries,) evaluated at the states `at`, from those at stage 0, covariance P0.

    out.predicted holds the first state; `weighed` says whether innovation variances are wanted.
    """
    K, fixed, n_states = len(s.first_live) - 1, s.n_fixed, s.n_states
    P, z, V = P0, np.zeros(fixed - n_states), len(m.offset)
    to, x = out.predicted, out.filtered
    for k in range(K):
        live, n = s.first_live[k], fixed + s.first_live[k + 1] - s.first_live[k]
        F, Q, before = np.zeros((n, n)), np.zeros((n, n)), np.zeros((n, n))
        d, origin = np.zeros(n), np.empty(n, np.int64)  # column at the stage before
        for i in range(n):
            origin[i] = i if i < fixed else s.before[live + i - fixed]
        for i in range(n):
            a = origin[i]
            F[i, i] = 1.0
            if a < 0:
                before[i, i] = s.sigma[live + i - fixed] ** 2
                continue
            if i >= n_states:
                d[i] = z[a - n_states]
            for j in range(n):
                if origin[j] >= 0:
                    before[i, j] = P[a, origin[j]]
        if k:
            for u in range(V):
                _carry(m, u, k - 1, z, x, to, F, Q)
                if m.has_imu[u]:
                    _times(F, m.offset[u], out.T[u, k - 1, 0])
                    _times(F, m.offset[u] + 3, out.T[u, k - 1, 1])
        prior = predict(before, F, Q)
        r0, r1 = s.first_row[k], s.first_row[k + 1]
        H, y = np.zeros((r1 - r0, n)), np.empty(r1 - r0)
        for u in range(V):
            R, r, v, b, o = to.R[u, k], to.r[u, k], to.v[u, k], to.bias[u, k], m.offset[u]
            _deviation(o, R, r, v, b, at.R[u, k], at.r[u, k], at.v[u, k], at.bias[u, k], m.has_imu[u], d)
        _rows(e, value, s.first_entry, s.column, r0, d, H, y)
        for u in range(V):
            if m.has_imu[u]:
                _to_predicted(m.offset[u], d[m.offset[u] : m.offset[u] + 3], H)
        out.drift[k] = 0.0
        for i in range(n_states):
            out.drift[k] = max(out.drift[k], abs(d[i]) / np.sqrt(prior[i, i]))
        if weighed:
            _copy(y, out.innovation[r0:r1])
            _variances(prior, H, out.variance[r0:r1])

        P, split, dx = prior.copy(), s.judged[k], np.zeros(n)
        out.nis[k] = _update(P, y[:split], H[:split], dx)
        _update(P, y[split:], H[split:], dx)
        for u in range(V):
            R, r, v, b, o = to.R[u, k], to.r[u, k], to.v[u, k], to.bias[u, k], m.offset[u]
            _feed_back(dx[o:], R, r, v, b, x.R[u, k], x.r[u, k], x.v[u, k], x.bias[u, k], out.T[u, k], m.has_imu[u])
        z = np.empty(n - n_states)
        for i in range(n_states, n):
            z[i - n_states] = d[i] + dx[i]
        for i in range(r1 - r0):
            left = y[i]
            for j in range(n):
                left -= H[i, j] * dx[j]
            out.left[r0 + i] = left

        square, step, wide = s.first_square[k], s.first_step[k], (s.first_step[k + 1] - s.first_step[k]) // n
        for i in range(n):
            out.dx[s.first_column[k] + i] = dx[i]
            out.z[s.first_column[k] + i] = z[i - n_states] if i >= n_states else 0.0
            for j in range(n):
                index = square + i * n + j
                out.P[index], out.prior[index], out.Q[index] = P[i, j], prior[i, j], Q[i, j]
                if origin[i] >= 0 and origin[j] >= 0:
                    out.F[step + i * wide + origin[j]] = F[i, j]
            if origin[i] < 0:
                out.Q[square + i * n + i] = before[i, i]
