"""Does an IMU feel the motion that another sensor of its vehicle sees, and with which offset of its times?

Steps of velocity from fixes are compared with what the IMU integrates over the same times. With the cumulated specific force
s(t) = int C f dt and its integral p(t), both in a frame that the gyroscope carries along, and for fixes at t_0, t_1 (, t_2)

    velocities:  y = v(t_1) - v(t_0) - g (t_1 - t_0)                    x(tau) = s(t_1 + tau) - s(t_0 + tau)
    positions:   y = slope of r over (t_1, t_2) less that over (t_0, t_1), less g (t_2 - t_0) / 2;   x(tau) likewise of p

Within a window of some ten seconds both differ by one unknown rotation only. What the best one leaves,

    J(tau) = sum |y|^2 + sum |x|^2 - 2 (s_1 + s_2 +- s_3),   s_i: singular values of sum y x^T, sign that of its determinant,

is least at the offset tau of the IMU's times: a fix at t belongs to the IMU's sample at t + tau. Windows are combined as
sum n log J, which lets each have its own noise. The other sign of s_3 is the best mirror image: left-handed axes.

Source: Markley and Crassidis (2014), sec. 5.3, for the rotation; Efron and Tibshirani (1993), ch. 11, for the jackknife.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit

from factorgraph.attitude import matrix_from_quat, skew
from factorgraph.measurements import ImuStream
from factorgraph.models.strapdown import quat_exp, quat_mul
from factorgraph.problem import Vec3
from factorgraph.types import Array, BoolArray, IntArray

IMU_HZ = 50.0  # enough for what fixes see
GRID_S = 0.02  # of the cumulated IMU
TURN_POINTS = 5  # grid points between those that turns are cumulated at
IMU_GAP_S = 0.3
MAX_PATH_GAP_S = 2.5
WINDOW_S, WINDOW_STEPS = 10.0, 8  # the longer of the two
MAX_WINDOWS = 45  # spread over a long flight
VELOCITY_STEP_S, POSITION_STEP_S, MAX_POSITION_STEP_S = 0.5, 1.0, 8.0
POSITION_NOISE_MPS2 = 0.25  # steps between positions are long enough for this noise of the acceleration
MAX_OFFSET_S = 22.0  # looked for: leap seconds and whatever is less
COARSE_S, FINE_S, FINE_SPAN_S = 0.25, 0.025, 0.5
BLOCKS = 20  # of windows, at most, that count as independent
MIN_WINDOWS = 4
GYRO_BIAS_RPS = 0.02  # usual size
MIN_SIGMA_S = 2e-3  # of an offset
FLOOR_MPS = 0.01  # residuals of a step below are rounding


@dataclass(frozen=True, slots=True)
class Fixes:
    """Positions (order 2) or velocities (order 1) of a point of the vehicle; rows with NaN are passed over."""

    name: str
    order: int
    t_s: Array  # (n,)
    z_n: Array  # (n, 3)
    sigma: float  # typical, per axis
    lever_b: Vec3 = (0.0, 0.0, 0.0)


@dataclass(frozen=True, slots=True)
class Steps:
    """Steps of velocity, sum_j weight_j z(t_j) less gravity, in windows."""

    order: int
    t_s: Array  # (k, m)
    weight: Array  # (k, m)
    y: Array  # (k, 3)
    v_n: Array  # (k, 3) mean velocity
    start: IntArray  # (w + 1,) first step of each window, and the end

    @property
    def window(self) -> IntArray:
        """Window of each step (k,)."""
        return np.repeat(np.arange(len(self.start) - 1), np.diff(self.start))


@dataclass(frozen=True, slots=True)
class Carried:
    """Specific force of an IMU, cumulated once and twice, on a grid of times from the IMU's first."""

    t0_s: float
    s: Array  # (g, 3) [m/s]
    p: Array  # (g, 3) [m]
    q: Array  # (g, 4) body to the carried frame
    n_bad: IntArray  # (g,) grid points up to each that lie in gaps of the IMU

    @property
    def end_s(self) -> float:
        return self.t0_s + GRID_S * (len(self.s) - 1)


@dataclass(frozen=True, slots=True)
class Offset:
    """Time offset of an IMU against fixes."""

    offset_s: float
    sigma_s: float
    evidence: float  # for the offset against none: mean gain of the blocks of windows over its standard deviation
    contrast: float  # 1 - misfit at the best time / mean misfit at any time (squares, geometric means)
    misfit_mps2: float  # at the best time, geometric mean over windows of the rms


def steps_of(fixes: Fixes, gravity_n: Array) -> Steps:
    """Steps of velocity between fixes some time apart, at most MAX_WINDOWS windows of them."""
    ok = np.isfinite(fixes.z_n).all(axis=1)
    t, z, m = fixes.t_s[ok], fixes.z_n[ok], fixes.order + 1
    interval_s = VELOCITY_STEP_S
    if fixes.order == 2:
        interval_s = min(max(POSITION_STEP_S, (6**0.5 * fixes.sigma / POSITION_NOISE_MPS2) ** 0.5), MAX_POSITION_STEP_S)
    rows = _spaced(t, interval_s)
    if len(rows) < m + WINDOW_STEPS:
        return Steps(fixes.order, np.zeros((0, m)), np.zeros((0, m)), np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(1, np.int64))
    nodes = np.lib.stride_tricks.sliding_window_view(rows, m)
    dt = np.diff(t[nodes], axis=1)
    rate = 1 / dt
    weight = np.tile([-1.0, 1.0], (len(dt), 1)) if m == 2 else np.column_stack([rate[:, 0], -rate.sum(axis=1), rate[:, 1]])
    y = np.einsum("kj,kji->ki", weight, z[nodes])
    y -= dt.mean(axis=1)[:, None] * gravity_n
    v_n = z[nodes].mean(axis=1) if m == 2 else (z[nodes[:, -1]] - z[nodes[:, 0]]) / dt.sum(axis=1)[:, None]
    first, length = _windows(t[nodes], dt.max(axis=1) < 2.5 * np.median(dt))
    chosen = np.unique(np.linspace(0, len(first) - 1, min(len(first), MAX_WINDOWS)).astype(np.int64)) if len(first) else first
    keep = np.concatenate([np.arange(first[i], first[i] + length[i]) for i in chosen]) if len(chosen) else np.zeros(0, np.int64)
    start = np.concatenate([[0], np.cumsum(length[chosen])])
    return Steps(fixes.order, t[nodes][keep], weight[keep], y[keep], v_n[keep], start)


def _spaced(t_s: Array, interval_s: float) -> IntArray:
    """Rows some time apart: the first of every interval."""
    if not t_s.size:
        return np.zeros(0, np.int64)
    usual = float(np.median(np.diff(t_s))) if len(t_s) > 1 else interval_s
    return np.arange(0, len(t_s), max(1, round(interval_s / usual)))


def _windows(t_s: Array, usable: BoolArray) -> tuple[IntArray, IntArray]:
    """First step and number of steps of windows of usable steps, in order and apart."""
    first, length = [], []
    begin = 0
    for k in range(len(t_s)):
        if not usable[k]:
            begin = k + 1
        elif k - begin + 1 >= WINDOW_STEPS and t_s[k, -1] - t_s[begin, 0] >= WINDOW_S:
            first.append(begin)
            length.append(k - begin + 1)
            begin = k + 1
    return np.array(first, np.int64), np.array(length, np.int64)


def slowed(imu: ImuStream) -> ImuStream:
    """The IMU as means at about IMU_HZ, where it is faster; samples are instants at their times, or means before them."""
    dt = max(float(np.median(np.diff(imu.t_s))), 1e-4)
    k = round(1 / (IMU_HZ * dt))
    if k < 2 or len(imu.t_s) < 2 * k:
        return imu
    n = len(imu.t_s) // k
    f_b, w_b = (x[: n * k].reshape(n, k, 3).mean(axis=1) for x in (imu.f_b, imu.w_b))
    return ImuStream(imu.t_s[k - 1 : n * k : k] + (0.0 if imu.is_mean else 0.5 * dt), f_b, w_b, is_mean=True)


def carry(imu: ImuStream, bias_rps: Array, lever_b: Vec3 = (0.0, 0.0, 0.0)) -> Carried:
    """Cumulate the specific force of a point of the vehicle in a frame that the gyroscope carries along."""
    n = int((imu.t_s[-1] - imu.t_s[0]) / GRID_S) + 1
    out, q, bad = np.zeros((n, 6)), np.zeros((n, 4)), np.zeros(n, np.int64)
    _carry(imu.t_s, imu.f_b, imu.w_b, bias_rps, imu.is_mean, np.array(lever_b), GRID_S, IMU_GAP_S, out, q, bad)
    return Carried(float(imu.t_s[0]), out[:, :3], out[:, 3:], q, np.cumsum(bad))


def carried_along(t_s: Array, r_n: Array, gravity_n: Array) -> Carried:
    """What an IMU without turns would cumulate along a path of positions (n, 3)."""
    t = np.arange(t_s[0], t_s[-1], GRID_S)
    tau = (t - t[0])[:, None]
    p = np.column_stack([np.interp(t, t_s, r_n[:, k]) for k in range(3)]) - 0.5 * gravity_n * tau**2
    gap = np.diff(t_s)[np.clip(np.searchsorted(t_s, t) - 1, 0, len(t_s) - 2)] > MAX_PATH_GAP_S
    return Carried(float(t[0]), np.gradient(p, GRID_S, axis=0), p, np.tile([1.0, 0.0, 0.0, 0.0], (len(t), 1)), np.cumsum(gap))


@njit(cache=True)
def _carry(t, f, w, bias, is_mean, lever, grid_s, gap_s, out, attitude, bad):  # type: ignore[no-untyped-def]
    """Fill s and p (g, 6) at t[0] + g grid_s, linear between samples, and where the samples are too far apart."""
    q, dq, phi, fm, wi, C = np.zeros(4), np.zeros(4), np.zeros(3), np.zeros(3), np.zeros(3), np.eye(3)
    sp, at, before = np.zeros(6), np.zeros(6), np.zeros(6)
    q[0] = 1.0
    g = 0
    for i in range(len(t)):
        dt = t[i] - t[i - 1] if i else 0.0
        for k in range(3):
            wi[k] = w[i, k] - bias[k]
            phi[k] = wi[k] * dt if is_mean or i == 0 else (0.5 * (w[i, k] + w[i - 1, k]) - bias[k]) * dt
            fm[k] = f[i, k] if is_mean or i == 0 else 0.5 * (f[i, k] + f[i - 1, k])
        x = (fm[0] + 0.5 * (phi[1] * fm[2] - phi[2] * fm[1])) * dt
        y = (fm[1] + 0.5 * (phi[2] * fm[0] - phi[0] * fm[2])) * dt
        z = (fm[2] + 0.5 * (phi[0] * fm[1] - phi[1] * fm[0])) * dt
        for k in range(3):
            dv = C[k, 0] * x + C[k, 1] * y + C[k, 2] * z
            sp[3 + k] += (sp[k] + 0.5 * dv) * dt
            sp[k] += dv
        quat_exp(phi, dq)
        quat_mul(q, dq, q)
        _matrix_into(q, C)
        x = wi[1] * lever[2] - wi[2] * lever[1]
        y = wi[2] * lever[0] - wi[0] * lever[2]
        z = wi[0] * lever[1] - wi[1] * lever[0]
        for k in range(3):
            at[k] = sp[k] + C[k, 0] * x + C[k, 1] * y + C[k, 2] * z
            at[3 + k] = sp[3 + k] + C[k, 0] * lever[0] + C[k, 1] * lever[1] + C[k, 2] * lever[2]
        while g < len(out) and t[0] + g * grid_s <= t[i] + 1e-9:
            u = (t[0] + g * grid_s - t[i - 1]) / dt if i else 1.0
            for k in range(6):
                out[g, k] = before[k] + u * (at[k] - before[k])
            attitude[g] = q
            bad[g] = dt > gap_s
            g += 1
        before[:] = at


@njit(cache=True)
def _matrix_into(q, C):  # type: ignore[no-untyped-def]
    n = q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]
    for i in range(3):
        for j in range(3):
            C[i, j] = 2 * q[1 + i] * q[1 + j] / n
        C[i, i] += 2 * q[0] * q[0] / n - 1
    a, b, c = 2 * q[0] * q[1] / n, 2 * q[0] * q[2] / n, 2 * q[0] * q[3] / n
    C[0, 1] -= c
    C[1, 0] += c
    C[0, 2] += b
    C[2, 0] -= b
    C[1, 2] -= a
    C[2, 1] += a


def misfits(steps: Steps, imu: Carried, offsets_s: Array) -> Array:
    """J (windows, offsets) per degree of freedom [(m/s)^2]; NaN where the IMU does not reach or has a gap."""
    return mirror_misfits(steps, imu, offsets_s)[0]


def mirror_misfits(steps: Steps, imu: Carried, offsets_s: Array) -> tuple[Array, Array]:
    """J (windows, offsets) of the best rotation, as `misfits`, and of the best mirror image."""
    x, inside = _felt(steps, imu, offsets_s)
    begin, n = steps.start[:-1], np.diff(steps.start)
    B = np.add.reduceat(steps.y[:, None, :, None] * x[:, :, None, :], begin, axis=0)
    square = np.add.reduceat(np.sum(steps.y**2, axis=1)[:, None] + np.sum(x**2, axis=2), begin, axis=0)
    valid = np.logical_and.reduceat(inside, begin, axis=0)
    gain = np.linalg.svd(B, compute_uv=False)
    third = np.sign(np.linalg.det(B)) * gain[..., 2]
    J = (square - 2 * (gain[..., 0] + gain[..., 1] + sign * third) for sign in (1.0, -1.0))
    proper, mirrored = (np.where(valid, np.maximum(j, 0.0) / (3 * n[:, None] - 3) + FLOOR_MPS**2, np.nan) for j in J)
    return proper, mirrored


def _felt(steps: Steps, imu: Carried, offsets_s: Array) -> tuple[Array, BoolArray]:
    """What the IMU makes of each step at each offset (k, l, 3), and where it knows."""
    z = imu.s if steps.order == 1 else imu.p
    place = (steps.t_s[:, None, :] + offsets_s[None, :, None] - imu.t0_s) / GRID_S  # (k, l, m)
    index = np.floor(place).astype(np.int64)
    inside = (index[..., 0] >= 0) & (index[..., -1] < len(z) - 1)
    index = np.clip(index, 0, len(z) - 2)
    inside &= imu.n_bad[index[..., -1] + 1] == imu.n_bad[index[..., 0]]
    u = (place - index)[..., None]
    return np.einsum("km,klmi->kli", steps.weight, z[index] + u * (z[index + 1] - z[index])), inside


def rotations(steps: Steps, imu: Carried, offset_s: float) -> tuple[Array, Array]:
    """The best rotation (w, 3, 3) of each window from the carried frame to n, and how well it is told (w,) [(m/s)^2].

    Windows that the IMU does not cover have NaN.
    """
    x, inside = _felt(steps, imu, np.array([offset_s]))
    begin = steps.start[:-1]
    U, gain, Vt = np.linalg.svd(np.add.reduceat(steps.y[:, :, None] * x[:, 0, None, :], begin, axis=0))
    sign = np.sign(np.linalg.det(U) * np.linalg.det(Vt))
    U[:, :, 2] *= sign[:, None]
    known = np.logical_and.reduceat(inside[:, 0], begin)
    return np.where(known[:, None, None], U @ Vt, np.nan), np.where(known, gain[:, 1] + sign * gain[:, 2], np.nan)


def gyro_bias(steps: Steps, imu: Carried, offset_s: float = 0.0) -> Array:
    """What is left of the gyroscope's bias (3,) [rad/s], as the turn of the force against the steps within windows shows it.

    To first order R' y - x = x cross (G b - psi) with the window's rotation R, its error psi, and G(t) = int C dt.
    """
    R, _ = rotations(steps, imu, offset_s)
    window = steps.window
    x = _felt(steps, imu, np.array([offset_s]))[0][:, 0]
    turned = np.cumsum(matrix_from_quat(imu.q[::TURN_POINTS]), axis=0) * GRID_S * TURN_POINTS
    at, begin = (rows_at(imu, t + offset_s) // TURN_POINTS for t in (steps.t_s.mean(axis=1), steps.t_s[steps.start[:-1], 0]))
    G = turned[at] - turned[begin][window]
    e = np.einsum("kji,kj->ki", R[window], steps.y) - x
    cross = skew(x)
    H = np.concatenate([cross @ G, -cross], axis=2)
    known = np.isfinite(e).all(axis=1)
    weight = known / (np.add.reduceat(np.where(known, np.sum(e**2, axis=1), 0.0), steps.start[:-1]) + FLOOR_MPS**2)[window]
    H, e = np.where(known[:, None, None], H, 0.0), np.where(known[:, None], e, 0.0)
    N = np.add.reduceat(weight[:, None, None] * np.swapaxes(H, 1, 2) @ H, steps.start[:-1], axis=0)
    h = np.add.reduceat(weight[:, None] * np.einsum("kij,ki->kj", H, e), steps.start[:-1], axis=0)
    own = N[:, 3:, 3:] + 1e-9 * np.eye(3)
    reduced = N[:, :3, :3] - N[:, :3, 3:] @ np.linalg.solve(own, N[:, 3:, :3])
    right = h[:, :3] - (N[:, :3, 3:] @ np.linalg.solve(own, h[:, 3:, None]))[..., 0]
    return np.asarray(np.linalg.solve(reduced.sum(axis=0) + np.eye(3) / GYRO_BIAS_RPS**2, right.sum(axis=0)))


def rows_at(imu: Carried, t_s: Array) -> IntArray:
    """The nearest grid points to times."""
    return np.clip(np.round((t_s - imu.t0_s) / GRID_S).astype(np.int64), 0, len(imu.s) - 1)


def time_offset(steps: Steps, imu: Carried, centres_s: Sequence[float] = (0.0,)) -> Offset | None:
    """The offset of the IMU's times at which it fits the steps best, near one of the centres; None with too little in common.

    Looked for within MAX_OFFSET_S of the first centre; of others, within COARSE_S of a whole second.
    """
    coarse = centres_s[0] + np.arange(-round(MAX_OFFSET_S / COARSE_S), round(MAX_OFFSET_S / COARSE_S) + 1) * COARSE_S
    others = [c + np.arange(-3, 4) * COARSE_S for c in centres_s[1:]]
    tau = np.concatenate([coarse, *others])
    J = misfits(steps, imu, tau)
    usual = np.exp(_mean(np.log(J), axis=1))
    rows = np.isfinite(usual)
    if rows.sum() < MIN_WINDOWS:
        return None
    steps = part(steps, rows)
    n = np.diff(steps.start).astype(float)
    gain = _gains(J[rows], usual[rows], n)
    enough = np.isfinite(J[rows]).sum(axis=0) >= MIN_WINDOWS
    best = tau[int(np.argmin(np.where(enough, gain.sum(axis=0), np.inf)))]
    return _refined(steps, imu, best, usual[rows])


def _refined(steps: Steps, imu: Carried, near_s: float, usual: Array) -> Offset | None:
    """The best offset near one; windows that the IMU covers at all of the offsets in question count."""
    fine: Array = near_s + np.linspace(-FINE_SPAN_S, FINE_SPAN_S, 2 * round(FINE_SPAN_S / FINE_S) + 1)
    J = misfits(steps, imu, np.append(fine, 0.0))
    use = np.isfinite(J[:, :-1]).all(axis=1)
    if use.sum() < MIN_WINDOWS:
        return None
    J, n = J[use], np.diff(steps.start)[use].astype(float)
    blocks = _blocks(len(n))
    gain = np.add.reduceat(_gains(J[:, :-1], usual[use], n), blocks, axis=0)
    offset = _least(fine, gain.sum(axis=0))
    without = np.array([_least(fine, row) for row in gain.sum(axis=0) - gain])
    sigma = float(np.sqrt((len(without) - 1) * np.mean((without - without.mean()) ** 2)))
    k = int(np.argmin(np.abs(fine - offset)))
    advantage = np.add.reduceat(np.nan_to_num(n * (np.log(J[:, -1]) - np.log(J[:, k]))), blocks)
    misfit = float(np.exp(0.5 * np.mean(np.log(J[:, k])))) / _step_s(steps)
    contrast = 1 - float(np.exp(gain[:, k].sum() / n.sum()))
    return Offset(offset, max(sigma, MIN_SIGMA_S), evidence(advantage), contrast, misfit)


def evidence(advantage: Array) -> float:
    """Mean of what independent blocks gain, in standard deviations of that mean."""
    return float(advantage.mean() / max(advantage.std(ddof=1) / np.sqrt(len(advantage)), 1e-9))


def part(steps: Steps, windows: BoolArray) -> Steps:
    """Some of the windows."""
    length = np.diff(steps.start)
    rows = windows[steps.window]
    start = np.concatenate([[0], np.cumsum(length[windows])])
    return Steps(steps.order, steps.t_s[rows], steps.weight[rows], steps.y[rows], steps.v_n[rows], start)


def _step_s(steps: Steps) -> float:
    """The time over which a step is a change of velocity."""
    return float(np.median(steps.t_s[:, -1] - steps.t_s[:, 0])) / steps.order


def _blocks(n: int) -> IntArray:
    """First of every block, of n windows in at most BLOCKS blocks."""
    return np.unique(np.linspace(0, n, min(n, BLOCKS), endpoint=False).astype(np.int64))


def _gains(J: Array, usual: Array, n: Array) -> Array:
    """n log(J / usual) (windows, offsets), 0 where J is not known."""
    return np.asarray(np.nan_to_num(n[:, None] * (np.log(J) - np.log(usual)[:, None])))


def _mean(x: Array, axis: int) -> Array:
    """Means of what is finite; NaN with less than a third."""
    known = np.isfinite(x)
    count = known.sum(axis=axis)
    return np.where(3 * count >= x.shape[axis], np.where(known, x, 0.0).sum(axis=axis) / np.maximum(count, 1), np.nan)


def _least(x: Array, y: Array) -> float:
    """Where the parabola through the least of y (n,) and its neighbours is least; x (n,) is regular."""
    k = int(np.clip(np.argmin(y), 1, len(x) - 2))
    slope, bend = 0.5 * (y[k + 1] - y[k - 1]), y[k + 1] - 2 * y[k] + y[k - 1]
    return float(x[k] - (x[1] - x[0]) * np.clip(slope / bend, -1, 1)) if bend > 0 else float(x[np.argmin(y)])
