"""The constraint of preintegrated inertial measurements between two states: increments, covariance, residual, Jacobians.

Increments zeta = (theta, p, v) of an interval, free of gravity, follow from steps of length h with corrected rate w and force a
(`preintegration.grouped_inputs` says which) in the tangent space,

    theta <- theta + Jr(theta)^-1 w h,   p <- p + v h + Exp(theta) a h^2 / 2,   v <- v + Exp(theta) a h,

their covariance, joint with the random walk of both biases, by first order, Jacobians to biases and scale factors likewise.
With gravitation g constant in n (the centrifugal acceleration of the frame's origin in it), Earth rate W = [w x] and zeta
corrected to the bias of state i, the predicted state is free motion in inertial axes that are those of n at state i,

    R' = Exp(-w dt) R_i Exp(theta)
    r' = Exp(-w dt) (r_i + (v_i + W r_i) dt + (I / 2 + W dt / 6 + W^2 dt^2 / 24) g dt^2 + R_i p)
    v' = Exp(-w dt) (v_i + W r_i + (I + W dt / 2 + W^2 dt^2 / 6) g dt + R_i v) - W r'

and the residual is the logarithm of (R_j^T R', R_j^T (r' - r_j), R_j^T (v' - v_j)) in the group of extended poses, then
b_i - b_j. Both are those of GTSAM 4.3's CombinedImuFactor, for all intervals of a flight at once and with columns for scale
factors. Its covariance also lets the Earth rate turn position noise into velocity noise (5e-5 of it), which is left out here.

Columns: of states i and j rotation, position (body frame), velocity, accelerometer bias, gyroscope bias, each 3; then, where
asked for, scale factors of accelerometer and gyroscope. Rows: rotation, position, velocity, the two biases.

Source: Forster et al. (2017), sec. V and VI, for the factor; Barrau and Bonnabel (2017) for the logarithm of extended poses.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from factorgraph.attitude import exp_so3, log_so3, right_jacobian, right_jacobian_inverse, skew
from factorgraph.models.preintegration import GroupedInputs
from factorgraph.models.small import apply, inverse_coefficients, jr_coefficients, mul, polynomial
from factorgraph.types import Array

STATE = 15  # columns of one state
CHUNK = 1000  # intervals evaluated at once: temporaries stay in the cache


@dataclass(frozen=True, slots=True)
class WhiteNoise:
    """What drives the covariance of intervals: densities of gyroscope and accelerometer (n,), walks, integration error."""

    gyro_rps_rthz: Array
    accel_mps2_rthz: Array
    gyro_walk_rps_rts: float
    accel_walk_mps2_rts: float
    integration_m_rts: float


@dataclass(frozen=True, slots=True)
class Intervals:
    """Preintegrated intervals; accelerometer columns before those of the gyroscope."""

    dt_s: Array  # (n,)
    zeta: Array  # (n, 9) rotation vector, position, velocity
    by_bias: Array  # (n, 9, 6)
    by_scale: Array  # (n, 9, 6)
    whitening: Array  # (n, 15, 15) lower triangular

    def between(self, a: int, b: int) -> Intervals:
        """Intervals a to b - 1."""
        return Intervals(*(getattr(self, name)[a:b] for name in Intervals.__dataclass_fields__))


@njit(cache=True)
def _squared_by(x, y, b, c, db, dc, out):  # type: ignore[no-untyped-def]
    """out = d(b(|x|) x x y + c(|x|) x x (x x y)) / dx with y constant; db, dc derivatives by |x|, over |x|."""
    z0, z1, z2 = x[1] * y[2] - x[2] * y[1], x[2] * y[0] - x[0] * y[2], x[0] * y[1] - x[1] * y[0]
    q0, q1, q2 = x[1] * z2 - x[2] * z1, x[2] * z0 - x[0] * z2, x[0] * z1 - x[1] * z0
    xy = x[0] * y[0] + x[1] * y[1] + x[2] * y[2]
    polynomial(y, c * xy, -b, 0.0, out)
    for j in range(3):
        out[0, j] += c * (x[0] * y[j] - 2 * y[0] * x[j]) + (db * z0 + dc * q0) * x[j]
        out[1, j] += c * (x[1] * y[j] - 2 * y[1] * x[j]) + (db * z1 + dc * q1) * x[j]
        out[2, j] += c * (x[2] * y[j] - 2 * y[2] * x[j]) + (db * z2 + dc * q2) * x[j]


@njit(cache=True)
def _propagate_rows(M, At, Ap, Av, Cw, Bp, Bv, h):  # type: ignore[no-untyped-def]
    """M <- F M for the step's (15, 15) transition F."""
    for c in range(M.shape[1]):
        t0, t1, t2 = M[0, c], M[1, c], M[2, c]
        a0, a1, a2 = M[9, c], M[10, c], M[11, c]
        g0, g1, g2 = M[12, c], M[13, c], M[14, c]
        for i in range(3):
            M[3 + i, c] += h * M[6 + i, c] + Ap[i, 0] * t0 + Ap[i, 1] * t1 + Ap[i, 2] * t2
            M[3 + i, c] += Bp[i, 0] * a0 + Bp[i, 1] * a1 + Bp[i, 2] * a2
        for i in range(3):
            M[6 + i, c] += Av[i, 0] * t0 + Av[i, 1] * t1 + Av[i, 2] * t2 + Bv[i, 0] * a0 + Bv[i, 1] * a1 + Bv[i, 2] * a2
            M[i, c] = At[i, 0] * t0 + At[i, 1] * t1 + At[i, 2] * t2 + Cw[i, 0] * g0 + Cw[i, 1] * g1 + Cw[i, 2] * g2


@njit(cache=True)
def _preintegrate(first, f, w, h_s, bias, gyro, accel, walks, integration, factor, zeta, by_bias, by_scale, P):  # type: ignore[no-untyped-def]
    """Fill zeta (n, 9), by_bias, by_scale (n, 9, 6) and P (n, 15, 15); `factor` (6,) are 1 + scale, accelerometer first."""
    D, inv, R, At, Ap, Av = np.empty((6, 3, 3))
    Cw, Bp, Bv, M, N = np.empty((5, 3, 3))
    a, wc, wt, av, theta = np.empty((5, 3))
    H = np.empty((15, 12))  # columns: bias, scale; the last six rows drive the first nine
    for n in range(len(first) - 1):
        z, C = zeta[n], P[n]
        z[:] = 0.0
        C[:] = 0.0
        H[:] = 0.0
        for k in range(first[n], first[n + 1]):
            h = h_s[k]
            for i in range(3):
                a[i], wc[i] = f[k, i] - bias[n, 3 + i], w[k, i] - bias[n, i]
                theta[i] = z[i]
            t2 = theta[0] ** 2 + theta[1] ** 2 + theta[2] ** 2
            b, c, db, dc = jr_coefficients(t2)
            ci, _ = inverse_coefficients(t2)
            polynomial(theta, 1.0, -b, c, D)
            polynomial(theta, 1.0, 0.5, ci, inv)
            polynomial(theta, 1.0, 1 - c * t2, b, R)
            apply(inv, wc, wt)
            apply(R, a, av)
            # d(Jr^-1 w) / d theta = -Jr^-1 d(Jr wt) / d theta
            _squared_by(theta, wt, -b, c, -db, dc, M)
            mul(inv, M, N)
            polynomial(a, 0.0, -1.0, 0.0, M)
            mul(R, M, At)
            mul(At, D, M)
            for i in range(3):
                for j in range(3):
                    At[i, j] = (1.0 if i == j else 0.0) - h * N[i, j]
                    Ap[i, j], Av[i, j] = 0.5 * h * h * M[i, j], h * M[i, j]
                    Cw[i, j], Bp[i, j], Bv[i, j] = h * inv[i, j], 0.5 * h * h * R[i, j], h * R[i, j]
            # inputs change by minus the bias, and by minus what the sensor shows over its scale factor
            for i in range(3):
                H[9 + i, i] = H[12 + i, 3 + i] = -1.0
                H[9 + i, 6 + i], H[12 + i, 9 + i] = -f[k, i] / factor[i], -w[k, i] / factor[3 + i]
            _propagate_rows(H, At, Ap, Av, Cw, Bp, Bv, h)
            _propagate_rows(C, At, Ap, Av, Cw, Bp, Bv, h)
            _propagate_rows(C.T, At, Ap, Av, Cw, Bp, Bv, h)
            qg, qa = gyro[n] ** 2 / h, accel[n] ** 2 / h
            for i in range(3):
                for j in range(3):
                    g = rr = 0.0
                    for m in range(3):
                        g += Cw[i, m] * Cw[j, m]
                        rr += R[i, m] * R[j, m]
                    C[i, j] += qg * g
                    C[3 + i, 3 + j] += qa * 0.25 * h**4 * rr
                    C[6 + i, 6 + j] += qa * h**2 * rr
                    C[3 + i, 6 + j] += qa * 0.5 * h**3 * rr
                    C[6 + i, 3 + j] += qa * 0.5 * h**3 * rr
                C[3 + i, 3 + i] += h * integration**2
                C[9 + i, 9 + i] += h * walks[1] ** 2
                C[12 + i, 12 + i] += h * walks[0] ** 2
            for i in range(3):
                z[3 + i] += z[6 + i] * h + 0.5 * h * h * av[i]
            for i in range(3):
                z[6 + i] += h * av[i]
                z[i] += h * wt[i]
        by_bias[n], by_scale[n] = H[:9, :6], H[:9, 6:]


def preintegrate(inputs: GroupedInputs, bias: Array, noise: WhiteNoise, scale: Array) -> Intervals:
    """Preintegrated intervals at biases (n, 6), gyroscope first; scale (6,) already taken out of the inputs, gyroscope first."""
    n = len(bias)
    zeta, by_bias, by_scale, P = np.zeros((n, 9)), np.zeros((n, 9, 6)), np.zeros((n, 9, 6)), np.zeros((n, 15, 15))
    walks = np.array([noise.gyro_walk_rps_rts, noise.accel_walk_mps2_rts])
    factor = 1 + np.concatenate([scale[3:], scale[:3]])
    _preintegrate(
        inputs.first,
        inputs.f_b,
        inputs.w_b,
        inputs.dt_s,
        np.ascontiguousarray(bias),
        noise.gyro_rps_rthz,
        noise.accel_mps2_rthz,
        walks,
        noise.integration_m_rts,
        factor,
        zeta,
        by_bias,
        by_scale,
        P,
    )
    # errors of zeta as the residual shows them: in the predicted body frame; the rows of the biases are i - j
    T = np.zeros((n, 15, 15))
    T[:, :3, :3] = right_jacobian(zeta[:, :3])
    T[:, 3:6, 3:6] = T[:, 6:9, 6:9] = np.swapaxes(exp_so3(zeta[:, :3]), 1, 2)
    T[:, 9:, 9:] = -np.eye(6)
    P = T @ P @ np.swapaxes(T, 1, 2)
    dt = np.add.reduceat(inputs.dt_s, inputs.first[:-1]) if n else np.zeros(0)
    return Intervals(dt, zeta, by_bias, by_scale, np.linalg.inv(np.linalg.cholesky(P)))


def _coupling(w: Array, d: Array) -> Array:
    """Derivative (n, 3, 3) of Jl(w)^-1 d by the rotation vector w (n, 3), d (n, 3) constant."""
    a2 = np.sum(w * w, axis=1)[:, None, None]
    small = a2 < 1e-3
    a = np.sqrt(np.where(small, 1.0, a2))
    cot, sin = 1 / np.tan(a / 2), np.sin(a / 2)
    c = np.where(small, 1 / 12 + a2 / 720 + a2**2 / 30240, 1 / a**2 - cot / (2 * a))
    dc = np.where(small, 1 / 360 + a2 / 7560 + a2**2 / 201600, (-2 / a**2 + cot / (2 * a) + 0.25 / sin**2) / a**2)
    wd = np.sum(w * d, axis=1)[:, None, None]
    row, w_, d_ = w[:, None, :], w[:, :, None], d[:, :, None]
    squared = w_ * wd - d_ * a2  # w x (w x d)
    return np.asarray(0.5 * skew(d) + c * (wd * np.eye(3) + w_ * d[:, None, :] - 2 * d_ * row) + dc * squared * row)


@dataclass(frozen=True, slots=True)
class States:
    """States i and j = i + 1 of n intervals: attitudes (n + 1, 3, 3), positions and velocities (n + 1, 3)."""

    R: Array
    r_n: Array
    v_n: Array


def _times(A: Array, x: Array) -> Array:
    return np.asarray((A @ x[..., None])[..., 0])


def _freely(R: Array, r_n: Array, v_n: Array, p: Array, v: Array, dt: Array, g: Array, W: Array) -> tuple[Array, Array]:
    """Positions and velocities (n, 3) at the intervals' ends, in the axes at their starts; p, v: corrected increments."""
    h = dt[:, None]
    r_next = r_n + (v_n + r_n @ W.T) * h + _times(R, p)
    r_next += h**2 * (g / 2 + h * (g @ W.T) / 6 + h**2 * (g @ W.T @ W.T) / 24)
    v_next = v_n + r_n @ W.T + _times(R, v) - r_next @ W.T
    v_next += h * (g + h * (g @ W.T) / 2 + h**2 * (g @ W.T @ W.T) / 6)
    return r_next, v_next


def _corrected(part: Intervals, bias: Array, at_bias: Array, scale: Array | None) -> Array:
    """Increments (n, 9) at biases (n, 6; gyroscope first) and scale factors of the states."""
    order = np.r_[3:6, 0:3]  # biases with the accelerometer first
    zeta = part.zeta + _times(part.by_bias, (bias - at_bias)[:, order])
    return zeta if scale is None else zeta + part.by_scale @ scale[order]


def carry(
    part: Intervals,
    R: Array,
    r_n: Array,
    v_n: Array,
    bias: Array,
    at_bias: Array,
    gravitation_n: Array,
    w_ie_n: Array,
    scale: Array | None = None,
) -> tuple[Array, Array, Array]:
    """Attitudes (n, 3, 3), positions and velocities (n, 3) at the ends of intervals from those at their starts.

    bias (n, 6; gyroscope first) of the starts; everything else as in `evaluate`.
    """
    zeta = _corrected(part, bias, at_bias, scale)
    r_next, v_next = _freely(R, r_n, v_n, zeta[:, 3:6], zeta[:, 6:], part.dt_s, gravitation_n, skew(w_ie_n))
    turn = exp_so3(-w_ie_n * part.dt_s[:, None])
    return turn @ R @ exp_so3(zeta[:, :3]), _times(turn, r_next), _times(turn, v_next)


@njit(cache=True)
def carry_intervals(dt, zeta, g, w, R, r, v):  # type: ignore[no-untyped-def]
    """Fill states 1 to n of R (n + 1, 3, 3), r, v (n + 1, 3) from state 0, one interval after the other."""
    E, T, A, W = np.empty((4, 3, 3))
    polynomial(w, 0.0, 1.0, 0.0, W)
    turn, Wr, Wg, WWg, a, b = np.empty((6, 3))
    for k in range(len(dt)):
        h = dt[k]
        theta = zeta[k, :3]
        t2 = theta[0] ** 2 + theta[1] ** 2 + theta[2] ** 2
        jb, jc, _, _ = jr_coefficients(t2)
        polynomial(theta, 1.0, 1 - jc * t2, jb, E)
        for i in range(3):
            turn[i] = -h * w[i]
        t2 = turn[0] ** 2 + turn[1] ** 2 + turn[2] ** 2
        jb, jc, _, _ = jr_coefficients(t2)
        polynomial(turn, 1.0, 1 - jc * t2, jb, T)
        apply(W, r[k], Wr)
        apply(W, g[k], Wg)
        apply(W, Wg, WWg)
        for i in range(3):
            p = q = 0.0
            for j in range(3):
                p += R[k, i, j] * zeta[k, 3 + j]
                q += R[k, i, j] * zeta[k, 6 + j]
            a[i] = r[k, i] + (v[k, i] + Wr[i]) * h + p + h * h * (g[k, i] / 2 + h * Wg[i] / 6 + h * h * WWg[i] / 24)
            b[i] = v[k, i] + Wr[i] + q + h * (g[k, i] + h * Wg[i] / 2 + h * h * WWg[i] / 6)
        apply(W, a, Wr)
        for i in range(3):
            b[i] -= Wr[i]
        mul(R[k], E, A)
        mul(T, A, R[k + 1])
        apply(T, a, r[k + 1])
        apply(T, b, v[k + 1])


def carry_along(
    part: Intervals,
    states: States,
    bias: Array,
    at_bias: Array,
    gravitation_n: Array,
    w_ie_n: Array,
    scale: Array | None = None,
) -> None:
    """States 1 to n from state 0, in place, through n intervals one after the other; bias (6; gyroscope first) of all.

    Everything else as in `evaluate`; each step is that of `carry`.
    """
    zeta = _corrected(part, np.broadcast_to(bias, at_bias.shape), at_bias, scale)
    carry_intervals(part.dt_s, zeta, gravitation_n, w_ie_n, states.R, states.r_n, states.v_n)


def _residuals(states: States, zeta: Array, dt: Array, g: Array, w_ie: Array) -> tuple[Array, Array, Array]:
    """First nine rows, not whitened: residuals (n, 9), Jacobians (n, 9, 30) without biases and (n, 9, 9) to zeta."""
    n = len(dt)
    W, h = skew(w_ie), dt[:, None]
    Ri, RjT = states.R[:-1], np.swapaxes(states.R[1:], 1, 2)
    theta, p, v = zeta[:, :3], zeta[:, 3:6], zeta[:, 6:]
    turn = exp_so3(-w_ie * h)
    r_next, v_next = _freely(Ri, states.r_n[:-1], states.v_n[:-1], p, v, dt, g, W)
    dp, dv = _times(RjT, _times(turn, r_next) - states.r_n[1:]), _times(RjT, _times(turn, v_next) - states.v_n[1:])
    B = RjT @ turn  # n -> body of j
    E = exp_so3(theta)
    U = B @ Ri @ E
    omega = log_so3(U)
    inv, left = right_jacobian_inverse(omega), right_jacobian_inverse(-omega)
    J, K = np.zeros((n, 9, 2 * STATE)), np.zeros((n, 9, 9))
    # rotation, perturbed on the right of U
    J[:, :3, :3], J[:, :3, STATE : STATE + 3] = inv @ np.swapaxes(E, 1, 2), -inv @ np.swapaxes(U, 1, 2)
    K[:, :3, :3] = inv @ right_jacobian(theta)
    # position and velocity: their own columns, and what the logarithm couples to the rotation
    back = left @ B
    lin, cross = back @ Ri, back @ W @ Ri  # velocity follows the predicted position by -W
    K[:, 3:6, 3:6] = K[:, 6:, 6:] = lin
    K[:, 6:, 3:6] = -cross
    h3 = h[..., None]
    J[:, 3:6, 3:6], J[:, 3:6, 6:9] = lin + h3 * cross, h3 * back
    J[:, 6:, 3:6], J[:, 6:, 6:9] = -h3 * (back @ W @ W @ Ri), back - h3 * (back @ W)
    J[:, 3:6, STATE + 3 : STATE + 6], J[:, 6:, STATE + 6 : STATE + 9] = -left, -left @ RjT
    for rows, d, x in ((slice(3, 6), dp, p), (slice(6, 9), dv, v)):
        by_rotation = _coupling(omega, d)
        for columns in (slice(0, 3), slice(STATE, STATE + 3)):
            J[:, rows, columns] = by_rotation @ J[:, :3, columns]
        K[:, rows, :3] = by_rotation @ K[:, :3, :3]
        J[:, rows, STATE : STATE + 3] += left @ skew(d)
        J[:, rows, :3] -= lin @ skew(x)
    J[:, 6:, :3] += cross @ skew(p)
    return np.hstack([omega, _times(left, dp), _times(left, dv)]), J, K


def _evaluate(
    part: Intervals, states: States, bias: Array, at_bias: Array, g: Array, w_ie: Array, scale: Array | None
) -> tuple[Array, Array]:
    n = len(part.dt_s)
    b = bias[:, np.r_[3:6, 0:3]]
    zeta = _corrected(part, bias[:-1], at_bias, scale)
    e9, J9, K = _residuals(states, zeta, part.dt_s, g, w_ie)
    J = np.zeros((n, 15, 2 * STATE + (6 if scale is not None else 0)))
    J[:, :9, : 2 * STATE] = J9
    J[:, :9, 9:15] = K @ part.by_bias
    if scale is not None:
        J[:, :9, 2 * STATE :] = K @ part.by_scale
    J[:, 9:, 9:15], J[:, 9:, STATE + 9 : 2 * STATE] = np.eye(6), -np.eye(6)
    e = np.hstack([e9, b[:-1] - b[1:]])
    return _times(part.whitening, e), part.whitening @ J


def evaluate(
    intervals: Intervals,
    states: States,
    bias: Array,
    at_bias: Array,
    gravitation_n: Array,
    w_ie_n: Array,
    scale: Array | None = None,
) -> tuple[Array, Array]:
    """Whitened residuals (n, 15) and Jacobians (n, 15, 30), with `scale` (n, 15, 36).

    bias (n + 1, 6; gyroscope first): of the states; at_bias (n, 6): preintegrated at; gravitation_n (n, 3) with the centrifugal
    acceleration of the frame's origin; scale (6,), gyroscope first: change of the scale factors since the preintegration.
    """
    n = len(intervals.dt_s)
    e, J = np.empty((n, 15)), np.empty((n, 15, 2 * STATE + (6 if scale is not None else 0)))
    for a in range(0, n, CHUNK):
        own, both = slice(a, a + CHUNK), slice(a, a + CHUNK + 1)
        part = Intervals(*(getattr(intervals, name)[own] for name in Intervals.__dataclass_fields__))
        of_part = States(states.R[both], states.r_n[both], states.v_n[both])
        e[own], J[own] = _evaluate(part, of_part, bias[both], at_bias[own], gravitation_n[own], w_ie_n, scale)
    return e, J
