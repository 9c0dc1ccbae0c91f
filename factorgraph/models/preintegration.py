"""Preintegrated inertial measurements between any two times.

Over a short step with constant body rate w and specific force f the increments are exact:

    dR = Exp(w dt),  dv = (I dt + [w x] dt^2 / 2 + [w x]^2 dt^3 / 6) f,  dp = (I dt^2 / 2 + [w x] dt^3 / 6 + [w x]^2 dt^4 / 24) f

and chain as R <- R dR, p <- p + v dt + R dp, v <- v + R dv. Jacobians to the biases follow the same recursion
(right Jacobian for the rotation). From increments at a few times per interval, `grouped_inputs` derives rates and forces
that make Euler steps in the tangent space (`imu_interval`, and GTSAM's) reproduce rotation, velocity and position exactly at
the end of every pair of steps, so covariances and Jacobians of 200 Hz samples need 20 steps a second.

Source: Forster et al. (2017), sec. VI; Groves (2013), ch. 5, for the constant-rate increments.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numba import njit

from factorgraph.measurements import ImuStream
from factorgraph.models.small import mul, polynomial, rotation_coefficients
from factorgraph.types import Array, BoolArray, IntArray

PAIR_S = 0.1  # two GTSAM steps
GAP_S, GAP_SAMPLES = 0.1, 10.0  # longer than both, in nominal intervals, is a gap and not a late sample
AROUND_GAP = 10  # samples on either side that stand for the missing ones


@dataclass(frozen=True, slots=True)
class Increments:
    """Motion relative to the start of an interval, free of gravity, and its Jacobians to the biases at `bias`."""

    dt_s: Array  # (n,)
    dR: Array  # (n, 3, 3)
    dv: Array  # (n, 3)
    dp: Array  # (n, 3)
    dR_dbg: Array  # (n, 3, 3) right-trivialised: dR(bg) = dR Exp(dR_dbg dbg)
    dv_dbg: Array  # (n, 3, 3)
    dv_dba: Array
    dp_dbg: Array
    dp_dba: Array
    w_b: Array  # (n, 3) angular rate at the end, bias not removed


@njit(cache=True)
def _add(C, A, a, M, B, b):  # type: ignore[no-untyped-def]
    """C += a A - M + b B, all 3 x 3."""
    for i in range(3):
        for j in range(3):
            C[i, j] += a * A[i, j] - M[i, j] + b * B[i, j]


@njit(cache=True)
def _integrate(edges, f, w, start, stop, bias, dt_out, dR_out, dv_out, dp_out, J_out, w_out):  # type: ignore[no-untyped-def]
    """Increments over (start[i], stop[i]] for samples holding f[k], w[k] on (edges[k], edges[k + 1]].

    Intervals with equal start and non-decreasing stop continue each other. Without Jacobians where J_out is empty.
    """
    jacobians = len(J_out) == len(start)
    n_samples = len(f)
    dR, dv, dp, J = np.eye(3), np.zeros(3), np.zeros(3), np.zeros((5, 3, 3))
    E, Jr, A1, A2, F = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    M, N, T = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    wk, fk, phi, av, ap = np.empty(3), np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    t = 0.0
    k = 0
    for i in range(len(start)):
        if i == 0 or start[i] != start[i - 1] or stop[i] < stop[i - 1]:
            dR[:], dv[:], dp[:], J[:] = np.eye(3), 0.0, 0.0, 0.0
            t = start[i]
            k = min(max(np.searchsorted(edges, t, side="right") - 1, 0), n_samples - 1)
        while t < stop[i]:
            end = stop[i]
            if k < n_samples - 1 and edges[k + 1] < end:
                end = edges[k + 1]
            h = end - t
            if h > 0:
                a2 = 0.0
                for c in range(3):
                    wk[c], fk[c] = w[k, c] - bias[i, c], f[k, c] - bias[i, 3 + c]
                    phi[c] = wk[c] * h
                    a2 += phi[c] * phi[c]
                s1, s2, s3 = rotation_coefficients(a2)
                polynomial(phi, 1.0, s1, s2, E)
                polynomial(wk, h, h * h / 2, h**3 / 6, A1)
                polynomial(wk, h * h / 2, h**3 / 6, h**4 / 24, A2)
                for c in range(3):
                    av[c] = A1[c, 0] * fk[0] + A1[c, 1] * fk[1] + A1[c, 2] * fk[2]
                    ap[c] = A2[c, 0] * fk[0] + A2[c, 1] * fk[1] + A2[c, 2] * fk[2]
                if jacobians:
                    # positions before velocities, both before the rotation; d(A f)/dw f to leading order is enough here
                    polynomial(phi, 1.0, -s2, s3, Jr)
                    polynomial(fk, 0.0, 1.0, 0.0, F)
                    mul(dR, F, T)
                    polynomial(ap, 0.0, 1.0, 0.0, M)
                    mul(dR, M, N)
                    mul(N, J[0], M)
                    _add(J[3], J[1], h, M, T, h**3 / 6)
                    mul(dR, A2, M)
                    _add(J[4], J[2], h, M, T, 0.0)
                    polynomial(av, 0.0, 1.0, 0.0, M)
                    mul(dR, M, N)
                    mul(N, J[0], M)
                    _add(J[1], T, h * h / 2, M, T, 0.0)
                    mul(dR, A1, M)
                    _add(J[2], T, 0.0, M, T, 0.0)
                    mul(E.T, J[0], M)
                    for c in range(3):
                        for d in range(3):
                            J[0, c, d] = M[c, d] - Jr[c, d] * h
                for c in range(3):
                    dp[c] += dv[c] * h + dR[c, 0] * ap[0] + dR[c, 1] * ap[1] + dR[c, 2] * ap[2]
                for c in range(3):
                    dv[c] += dR[c, 0] * av[0] + dR[c, 1] * av[1] + dR[c, 2] * av[2]
                mul(dR, E, M)
                dR[:] = M
            t = end
            if k < n_samples - 1 and t >= edges[k + 1]:
                k += 1
        dt_out[i] = stop[i] - start[i]
        dR_out[i], dv_out[i], dp_out[i], w_out[i] = dR, dv, dp, w[k]
        if jacobians:
            J_out[i] = J


def gap_rows(t_s: Array) -> IntArray:
    """Rows of sample times (n,) after which samples are missing."""
    step = np.diff(t_s)
    if len(step) < 2:
        return np.zeros(0, np.int64)
    return np.flatnonzero((step > GAP_S) & (step > GAP_SAMPLES * np.median(step)))


def gaps(imu: ImuStream) -> Array:
    """Start and end (m, 2) of the stretches without samples."""
    i = gap_rows(imu.t_s)
    return np.column_stack([imu.t_s[i], imu.t_s[i + 1]])


def crossing(gaps_s: Array, start_s: Array, stop_s: Array) -> BoolArray:
    """Which intervals (start, stop] (n,) reach into one of the gaps (m, 2), by more than rounding."""
    if not len(gaps_s):
        return np.zeros(len(start_s), bool)
    next_gap = np.minimum(np.searchsorted(gaps_s[:, 1], start_s + 1e-6, side="right"), len(gaps_s) - 1)
    return np.asarray((gaps_s[next_gap, 0] < stop_s - 1e-6) & (gaps_s[next_gap, 1] > start_s + 1e-6))


def sample_means(imu: ImuStream) -> tuple[Array, Array, Array]:
    """Edges (n + 1,) and the mean force and rate (n, 3) between them.

    Instantaneous samples become trapezoidal means; the first sample also covers one interval before itself. A gap gets
    the mean of the samples around it.
    """
    edges, f, w = _means(imu)
    missing = gap_rows(imu.t_s)
    if imu.is_mean and len(missing):
        f, w = f.copy(), w.copy()
    for i in missing:
        around = slice(max(i + 1 - AROUND_GAP, 0), i + 1 + AROUND_GAP)
        f[i + 1], w[i + 1] = imu.f_b[around].mean(axis=0), imu.w_b[around].mean(axis=0)
    return edges, f, w


def _means(imu: ImuStream) -> tuple[Array, Array, Array]:
    t = imu.t_s
    first = t[0] - (t[1] - t[0]) if len(t) > 1 else t[0] - 1e-2
    edges = np.concatenate([[first], t])
    if imu.is_mean:
        return edges, imu.f_b, imu.w_b

    def trapezoid(x: Array) -> Array:
        return np.concatenate([x[:1], 0.5 * (x[1:] + x[:-1])])

    return edges, trapezoid(imu.f_b), trapezoid(imu.w_b)


def _around(imu: ImuStream, start_s: Array, stop_s: Array) -> ImuStream:
    """The samples that intervals need, with as many around them as stand for a gap."""
    if not len(start_s):
        return imu
    a = max(int(np.searchsorted(imu.t_s, start_s.min())) - AROUND_GAP - 2, 0)
    b = int(np.searchsorted(imu.t_s, stop_s.max())) + AROUND_GAP + 2
    if a == 0 and b >= len(imu.t_s):
        return imu
    return replace(imu, t_s=imu.t_s[a:b], f_b=imu.f_b[a:b], w_b=imu.w_b[a:b])


def integrate(imu: ImuStream, start_s: Array, stop_s: Array, bias: Array, jacobians: bool = True) -> Increments:
    """Increments over (start, stop] for each interval, with Jacobians to the biases unless told otherwise (then empty).

    start_s, stop_s (n,); bias (n, 6) gyroscope then accelerometer. Beyond the recording the outermost sample holds.
    Consecutive intervals with one start and increasing stops cost no more than the longest.
    """
    n = len(start_s)
    start, stop = np.asarray(start_s, float), np.asarray(stop_s, float)
    edges, f, w = sample_means(_around(imu, start, stop))
    dt, dR, dv, dp, J, rate = (
        np.zeros(n),
        np.zeros((n, 3, 3)),
        np.zeros((n, 3)),
        np.zeros((n, 3)),
        np.zeros((n if jacobians else 0, 5, 3, 3)),
        np.zeros((n, 3)),
    )
    _integrate(edges, f, w, start, stop, np.asarray(bias, float), dt, dR, dv, dp, J, rate)
    return Increments(dt, dR, dv, dp, J[:, 0], J[:, 1], J[:, 2], J[:, 3], J[:, 4], rate)


@njit(cache=True)
def _log(R):  # type: ignore[no-untyped-def]
    tr = R[0, 0] + R[1, 1] + R[2, 2]
    v = np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]]) * 0.5
    s = np.sqrt(v[0] ** 2 + v[1] ** 2 + v[2] ** 2)
    if s < 1e-9:
        return v
    return v * (np.arctan2(s, 0.5 * (tr - 1)) / s)


@njit(cache=True)
def _tangent_inputs(first, dt_s, dR, dv, dp, w_eff, a_eff, dt):  # type: ignore[no-untyped-def]
    """Rows come in pairs; `first` marks a pair at the start of an interval, where the increments begin at zero."""
    Jr = np.empty((3, 3))
    for i in range(0, len(dt_s), 2):
        R0, v0, p0, th0, t0 = np.eye(3), np.zeros(3), np.zeros(3), np.zeros(3), 0.0
        if not first[i]:
            R0, v0, p0, th0, t0 = dR[i - 1], dv[i - 1], dp[i - 1], _log(dR[i - 1]), dt_s[i - 1]
        h = 0.5 * (dt_s[i + 1] - t0)
        S = (dv[i + 1] - v0) / h
        Q = (dp[i + 1] - p0 - v0 * (2 * h)) / (h * h)
        a_eff[i], a_eff[i + 1] = R0.T @ (Q - 0.5 * S), dR[i].T @ (1.5 * S - Q)
        for k in range(2):
            th1 = _log(dR[i + k])
            _, s2, s3 = rotation_coefficients(th0[0] ** 2 + th0[1] ** 2 + th0[2] ** 2)
            polynomial(th0, 1.0, -s2, s3, Jr)
            dt[i + k] = h
            w_eff[i + k] = Jr @ (th1 - th0) / h
            th0 = th1


@dataclass(frozen=True, slots=True)
class GroupedInputs:
    """Inputs of GTSAM's `integrateMeasurement`: interval i uses rows first[i] : first[i + 1]; bias still in them."""

    first: IntArray  # (n + 1,)
    f_b: Array  # (m, 3)
    w_b: Array  # (m, 3)
    dt_s: Array  # (m,)


def grouped_inputs(imu: ImuStream, start_s: Array, stop_s: Array, bias: Array) -> GroupedInputs:
    """Mean inputs for the intervals (start, stop], exact at the end of every second step for the given bias (n, 6).

    With steps of length h and A_i = Exp(theta_i) a_i, GTSAM integrates theta <- theta + Jr(theta)^-1 w h,
    p <- p + v h + A h^2 / 2, v <- v + A h; two steps reach dv and dp with

        A_1 = dp' / h^2 - dv / (2 h),   A_2 = 3 dv / (2 h) - dp' / h^2,   dp' = dp - 2 h v_0.
    """
    count = 2 * np.maximum(1, np.ceil((stop_s - start_s) / PAIR_S - 1e-6)).astype(np.int64)
    first = np.concatenate([[0], np.cumsum(count)])
    interval = np.repeat(np.arange(len(count)), count)
    step = (np.arange(first[-1]) - first[interval] + 1) / count[interval]
    stops = start_s[interval] + (stop_s - start_s)[interval] * step
    stops[first[1:] - 1] = stop_s
    inc = integrate(imu, start_s[interval], stops, bias[interval], jacobians=False)
    m = len(interval)
    w_eff, a_eff, dt = np.zeros((m, 3)), np.zeros((m, 3)), np.zeros(m)
    is_first = np.zeros(m, bool)
    is_first[first[:-1]] = True
    _tangent_inputs(is_first, inc.dt_s, inc.dR, inc.dv, inc.dp, w_eff, a_eff, dt)
    return GroupedInputs(first, a_eff + bias[interval, 3:], w_eff + bias[interval, :3], dt)
