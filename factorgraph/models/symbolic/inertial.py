"""The constraint of preintegrated inertial measurements between states i and j, as `models.imu_interval` states it.

    zeta = zeta_0 + by_bias (b_i - b_0) + by_scale ds = (theta, p, v)
    R' = E R_i Exp(theta),   r' = E q,   v' = E u,    E = Exp(-w dt),  W = [w x]
    q = r_i + (v_i + W r_i) dt + (I / 2 + W dt / 6 + W^2 dt^2 / 24) g dt^2 + R_i p
    u = v_i + W r_i + (I + W dt / 2 + W^2 dt^2 / 6) g dt + R_i v - W q
    e = (Log(R_j^T R'), Jl^-1 R_j^T (r' - r_j), Jl^-1 R_j^T (v' - v_j), b_i - b_j)

with Jl the left Jacobian of the first three: the logarithm of extended poses. Not whitened.

Source: Forster et al. (2017), sec. V and VI; Barrau and Bonnabel (2017).
"""

from __future__ import annotations

import casadi as ca

from factorgraph.models.symbolic.rotations import exp_small, exp_so3, left_jacobian_inverse, log_so3
from factorgraph.models.symbolic.symbols import Symbols, matrix, split

STATE = (9, 3, 3, 6)  # R row by row, r, v, bias (gyroscope first)


def imu_interval(s: Symbols, has_scale: bool) -> dict[str, ca.SX]:
    """Residual e (15,) of an interval: rotation, position, velocity, accelerometer and gyroscope bias.

    Inputs: from, to (21,) states; bias_0 (6,) preintegrated at, gyroscope first; zeta (9,); by_bias, by_scale (54,) row by row,
    accelerometer first; dt (1,); g (3,) gravitation with the centrifugal acceleration of n's origin; w_ie (3,); scale (6,) change
    of the scale factors, accelerometer first. Columns: `from`, `to` (15,) each, `scale` (6,).
    """
    R_i, r_i, v_i, b_i = _state(s, "from")
    R_j, r_j, v_j, b_j = _state(s, "to")
    zeta = s.vector("zeta", 9) + _increments_by(s.vector("by_bias", 54)) @ (b_i - _accelerometer_first(s.vector("bias_0", 6)))
    if has_scale:
        zeta += _increments_by(s.vector("by_scale", 54)) @ s.variable("scale", 6)
    dt, g, w = s.scalar("dt"), s.vector("g", 3), s.vector("w_ie", 3)
    theta, p, v = split(zeta, 3, 3, 3)
    Wg = ca.cross(w, g)
    WWg = ca.cross(w, Wg)
    moving = v_i + ca.cross(w, r_i)
    q = r_i + moving * dt + (g / 2 + Wg * dt / 6 + WWg * dt**2 / 24) * dt**2 + R_i @ p
    u = moving + (g + Wg * dt / 2 + WWg * dt**2 / 6) * dt + R_i @ v - ca.cross(w, q)
    turn = exp_small(-w * dt)
    omega = s.stage(log_so3(s.stage(R_j.T @ turn @ R_i @ exp_so3(theta))))
    left = left_jacobian_inverse(omega)
    to_j = (R_j.T @ (turn @ q - r_j), R_j.T @ (turn @ u - v_j))
    return {"e": ca.vertcat(omega, *(left @ x for x in to_j), b_i - b_j)}


def _state(s: Symbols, name: str) -> tuple[ca.SX, ca.SX, ca.SX, ca.SX]:
    """Attitude, position, velocity and bias (accelerometer first) of a state, perturbed by its 15 columns."""
    R, r, v, b = split(s.vector(name, sum(STATE)), *STATE)
    d = s.local(name, 15)
    R = matrix(R, 3, 3)
    return R @ exp_so3(d[:3]), r + R @ d[3:6], v + d[6:9], _accelerometer_first(b) + d[9:]


def _accelerometer_first(b: ca.SX) -> ca.SX:
    return ca.vertcat(b[3:], b[:3])


def _increments_by(entries: ca.SX) -> ca.SX:
    """The Jacobian (9, 6) of increments, accelerometer first, whose rotations forces do not change."""
    J = matrix(entries, 9, 6)
    J[:3, :3] = 0
    return ca.sparsify(J)
