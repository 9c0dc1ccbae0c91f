"""Start values found from the data: positions and velocities on a grid, and attitude by vector matching.

Attitude: over a window around each state the gyroscope carries body vectors to one instant, and the window's rotation is
the best fit (Wahba's problem, by singular values) of

  - velocity increments: integral of specific force in the body <-> change of velocity less gravity in n;
  - the body's forward axis <-> the direction of travel, weighted low, where the vehicle moves;

so levelling, in-motion alignment and course are one estimate. A declared heading replaces what motion cannot tell.
Windows end where IMU samples are missing.
Source: Markley and Crassidis (2014), sec. 5.3; Wu and Pan (2013) for velocity-increment matching.
"""

from __future__ import annotations

import numpy as np

from factorgraph.attitude import euler_from_matrix, matrix_from_euler
from factorgraph.geodesy import LocalFrame
from factorgraph.measurements import ImuStream
from factorgraph.models import preintegration
from factorgraph.types import Array, BoolArray, IntArray

WINDOW_S = 10.0
MOVING_MPS = 2.0
STATIC_RATE_RPS = 0.02  # rate scatter of a vehicle at rest
STATIC_FORCE_MPS2 = 0.15


def interpolate(t_s: Array, t_data: Array, x: Array) -> Array:
    """Columns of x (n, m) at t_s, linear, constant beyond the ends; rows with NaN are passed over."""
    ok = np.all(np.isfinite(x), axis=1)
    return np.column_stack([np.interp(t_s, t_data[ok], x[ok, j]) for j in range(x.shape[1])])


def rest_bias(imu: ImuStream, seconds: float = 2.0) -> Array:
    """Mean rate (3,) over the first stretch of `seconds` that looks like rest; zeros when there is none."""
    n = max(int(seconds / max(float(np.median(np.diff(imu.t_s))), 1e-4)), 10)
    for i in range(0, len(imu.t_s) - n, n):
        w, f = imu.w_b[i : i + n], imu.f_b[i : i + n]
        if (
            np.all(w.std(axis=0) < STATIC_RATE_RPS)
            and np.all(f.std(axis=0) < STATIC_FORCE_MPS2)
            and np.linalg.norm(w.mean(axis=0)) < 0.05
        ):
            return np.asarray(w.mean(axis=0))
    return np.zeros(3)


def align(
    imu: ImuStream, grid_s: Array, r_n: Array, v_n: Array, frame: LocalFrame, heading_rad: float | None
) -> tuple[Array, Array]:
    """Attitude C_nb (K, 3, 3) at grid times and the gyroscope bias (3,) used.

    r_n, v_n (K, 3): positions and velocities good to metres and decimetres per second. `heading_rad`: heading at the
    first state, trusted where the motion does not tell it.
    """
    K = len(grid_s)
    bias = np.zeros((K - 1, 6))
    bias[:, :3] = rest_bias(imu)
    inc = preintegration.integrate(imu, grid_s[:-1], grid_s[1:], bias)
    turn = np.empty((K, 3, 3))  # body at grid time k -> body at grid time 0
    turn[0] = np.eye(3)
    for k in range(K - 1):
        turn[k + 1] = turn[k] @ inc.dR[k]
    dt = np.diff(grid_s)[:, None]
    w_ie = frame.w_ie_n
    gravity = frame.gravity(r_n)
    coriolis = 2 * np.cross(w_ie, v_n)
    dv_n = np.diff(v_n, axis=0) - dt * 0.5 * ((gravity - coriolis)[1:] + (gravity - coriolis)[:-1])
    dv_b0 = np.einsum("kij,kj->ki", turn[:-1], inc.dv)
    middle = 0.5 * (grid_s[1:] + grid_s[:-1])
    unknown = preintegration.crossing(preintegration.gaps(imu), grid_s[:-1], grid_s[1:])
    stretch = np.concatenate([[0], np.cumsum(unknown)])
    speed = np.linalg.norm(v_n[:, :2], axis=1)
    forward_b0 = turn[:, :, 1]  # y is forward in RFU
    course_n = np.column_stack([v_n[:, 0], v_n[:, 1], np.zeros(K)]) / np.maximum(speed, 1e-6)[:, None]
    R = np.empty((K, 3, 3))
    told = np.zeros(K, bool)
    for k in range(K):
        near = (np.abs(middle - grid_s[k]) <= WINDOW_S) & (stretch[:-1] == stretch[k]) & ~unknown
        if k and unknown[k - 1] and not np.any(near):
            R[k] = R[k - 1] @ inc.dR[k - 1]
            continue
        if not np.any(near):
            near = np.abs(middle - grid_s[k]) <= np.min(np.abs(middle - grid_s[k])) + 1e-9
        B = dv_n[near].T @ dv_b0[near]
        moving = (np.abs(grid_s - grid_s[k]) <= WINDOW_S) & (speed > MOVING_MPS) & (stretch == stretch[k])
        # one course direction weighs like half a metre per second of velocity change
        B += 0.25 * course_n[moving].T @ forward_b0[moving]
        horizontal = dv_n[near][:, :2]
        told[k] = bool(np.any(moving)) or float(np.linalg.norm(horizontal)) > 3.0
        U, _, Vt = np.linalg.svd(B)
        R[k] = U @ np.diag([1.0, 1.0, np.linalg.det(U) * np.linalg.det(Vt)]) @ Vt @ turn[k]
    return _with_headings(R, turn, told, stretch, heading_rad), bias[0, :3]


def _with_headings(R: Array, turn: Array, told: BoolArray, stretch: IntArray, heading_rad: float | None) -> Array:
    """States whose heading nothing tells take one that the gyroscope carried to them.

    From the declared heading of state 0; without one, from the nearest state of their stretch whose motion tells it, or from
    the stretch's first state, so that at least they agree with each other.
    """
    pitch, roll, _ = euler_from_matrix(R)
    source, base = np.zeros(len(R), np.int64), R.copy()
    if heading_rad is not None:
        base[0] = matrix_from_euler(float(pitch[0]), float(roll[0]), heading_rad)
    else:
        for k in np.flatnonzero(~told):
            known = np.flatnonzero(told & (stretch == stretch[k]))
            source[k] = known[np.argmin(np.abs(known - k))] if len(known) else np.argmax(stretch == stretch[k])
    carried = base[source] @ np.swapaxes(turn[source], 1, 2) @ turn
    _, _, heading = euler_from_matrix(carried)
    return np.where(told[:, None, None], R, matrix_from_euler(pitch, roll, heading))
