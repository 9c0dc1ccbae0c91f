"""Points observed from vehicles, at the times of measurements: r, v and attitude as functions of a vehicle's state.

From state k, at t_k, to the point at t_k + dt, by increments dR, dv, dp that were preintegrated at the bias b_0:

    R_t = Exp(-w_ie dt) R_k dR Exp(dR_g (b_g - b_0g)),        f = dv + dv_g (b_g - b_0g) + dv_a (b_a - b_0a),  p likewise
    v_t = v_k + (g - 2 w_ie x v_k) dt + R_k f,                v_a = v_t + R_t (w_nb x l)
    r_t = r_k + v_k dt + (g - 2 w_ie x v_k) dt^2 / 2 + R_k p, r_a = r_t + R_t l
    w_nb = w_ib - b_g - R_k^T w_ie,                           g = gravity(r_k), to first order about the state

A sensor whose clock runs differently sees the point a little later, by `late` seconds in all:

    r_a + v_a late + a late^2 / 2,   v_a + a late,   C_nb Exp(w_nb late),   a = R_t (f_ib - b_a) + g - 2 w_ie x v_k

Local columns of an end: rotation dtheta, position drho (R Exp(dtheta), r + R drho), velocity, accelerometer bias, gyroscope
bias, each 3, then the lever arm (3) and each time offset (1) where they are estimated. A vehicle without IMU has position and
velocity, a fixed one no columns of its own.

Source: Forster et al. (2017), sec. V, for preintegration; Groves (2013), sec. 2.4, for gravity and its J2 term.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import casadi as ca

from factorgraph.geodesy import A_M, J2, MU_M3S2
from factorgraph.models.symbolic.rotations import Turn, exp_small
from factorgraph.models.symbolic.symbols import Symbols, flat, matrix, split

BODY = (9, 3, 3, 6, 6, 3, 9)  # R, r, v, bias, bias preintegrated at, gravity, its gradient
INCREMENTS = (9, 3, 3, 9, 9, 9, 9, 9)  # dR, dv, dp, dR_g, dv_g, dv_a, dp_g, dp_a


@dataclass(frozen=True, slots=True)
class EndShape:
    """What kind of point an end is, and what is estimated of its sensor.

    mode: "carried" by increments; "near" a state of a vehicle with IMU, carried by velocity and rate; "motion", of a vehicle
    without IMU; "fixed".
    """

    mode: Literal["carried", "near", "motion", "fixed"]
    has_lever: bool = False
    offsets: int = 0

    @property
    def state_columns(self) -> int:
        return {"carried": 15, "near": 9, "motion": 6, "fixed": 0}[self.mode]

    @property
    def columns(self) -> int:
        return self.state_columns + 3 * self.has_lever + self.offsets


@dataclass(frozen=True, slots=True)
class End:
    """The observed point and the body that it is on."""

    r_n: ca.SX  # (3,)
    v_n: ca.SX  # (3,)
    C_nb: Turn


def gravity(s: Symbols) -> dict[str, ca.SX]:
    """Model of attraction with J2 plus centrifugal acceleration: output g (3,) [m/s^2]; its columns `r` are the gradient in n.

    Inputs: r (3,) in n; centre (3,) from the Earth's centre to the origin of n, in n; w_ie (3,) rate of n.
    """
    r, centre, w_ie = s.variable("r", 3), s.vector("centre", 3), s.vector("w_ie", 3)
    x, axis = centre + r, w_ie / ca.norm_2(w_ie)
    r2, z = ca.dot(x, x), ca.dot(axis, x)
    k = 1.5 * J2 * A_M**2 / r2
    attraction = -MU_M3S2 / (r2 * ca.sqrt(r2)) * ((1 + k * (1 - 5 * z**2 / r2)) * x + 2 * k * z * axis)
    return {"g": attraction - ca.cross(w_ie, ca.cross(w_ie, x))}


def end_of(s: Symbols, name: str, shape: EndShape) -> End:
    """The end `name` of a model, with its inputs and local columns.

    Inputs: `name`_state, of a body (39,) R row by row, r, v, bias, bias preintegrated at, gyroscope first in both, gravity and
    its gradient row by row; of a vehicle without IMU (6,) r, v; fixed (3,) r. `name`_sample (10,) dt, lever arm, w_ib, f_ib; dt
    alone without IMU. `name`_earth (3,) w_ie. `name`_increments (60,), the matrices row by row. `name`_lever (3,). `name`_ahead
    (offsets,) how late each offset makes the point [s], `name`_sign (offsets,) d late / d offset.
    """
    d = s.local(name, shape.columns)
    d_state, d_lever, d_late = split(d, shape.state_columns, 3 * shape.has_lever, shape.offsets)
    late = ca.SX(0)
    if shape.offsets:
        late = ca.sum1(s.vector(f"{name}_ahead", shape.offsets) + s.vector(f"{name}_sign", shape.offsets) * d_late)
    if shape.mode == "fixed":
        return End(s.vector(f"{name}_state", 3), ca.SX.zeros(3), Turn())
    if shape.mode == "motion":
        r, v = split(s.vector(f"{name}_state", 6) + d_state, 3, 3)
        return End(r + v * (s.scalar(f"{name}_sample") + late), v, Turn())
    return _on_body(s, name, shape, d_state, d_lever, late)


def _on_body(s: Symbols, name: str, shape: EndShape, d: ca.SX, d_lever: ca.SX, late: ca.SX) -> End:
    """The end of a vehicle with IMU, where its local columns d and the offsets of its sensor put it."""
    R0, r0, v0, bias, bias_0, g, G = split(s.vector(f"{name}_state", sum(BODY)), *BODY)
    dt, lever, w_ib, f_ib = split(s.vector(f"{name}_sample", 10), 1, 3, 3, 3)
    w_ie = s.vector(f"{name}_earth", 3)
    if shape.has_lever:
        lever = lever + s.vector(f"{name}_lever", 3) + d_lever
    C_0 = matrix(R0, 3, 3)
    d_r = C_0 @ d[3:6]
    R, r, v = Turn.matrix(C_0) * Turn.by(d[:3], small=True), r0 + d_r, v0 + d[6:9]
    b_g, b_a = bias[:3], bias[3:]
    if shape.mode == "carried":
        b_g, b_a = b_g + d[12:15], b_a + d[9:12]
    rate = w_ib - b_g - R.back(w_ie)
    pull = g + matrix(G, 3, 3) @ d_r - 2 * ca.cross(w_ie, v)
    if shape.mode == "carried":
        change = ca.vertcat(b_g, b_a) - bias_0
        increments = split(s.vector(f"{name}_increments", 60), *INCREMENTS)
        R_t, v_t, r_t = _carried(R, r, v, dt, rate, pull, w_ie, change, increments)
        C_nb, r_a, v_a = R_t, r_t + R_t.apply(lever), v_t + R_t.apply(ca.cross(rate, lever))
    else:
        R_t, turning = R, ca.cross(rate, lever)
        C_nb, r_a, v_a = R * Turn.by(rate * dt), r + v * dt + R.apply(lever + turning * dt), v + R.apply(turning)
    if not shape.offsets:
        return End(r_a, v_a, C_nb)
    a = R_t.apply(f_ib - b_a) + pull
    return End(r_a + v_a * late + a * late**2 / 2, v_a + a * late, C_nb * Turn.by(rate * late))


def _carried(
    R: Turn, r: ca.SX, v: ca.SX, dt: ca.SX, rate: ca.SX, pull: ca.SX, w_ie: ca.SX, change: ca.SX, increments: list[ca.SX]
) -> tuple[Turn, ca.SX, ca.SX]:
    """Attitude, velocity and position of the body dt after its state; `change` (6,) of the bias, gyroscope first.

    Up to a few milliseconds before the state the increments are nothing: constant velocity and rate take their place.
    """
    dv, dp = increments[1:3]
    dR, dR_g, dv_g, dv_a, dp_g, dp_a = (matrix(increments[i], 3, 3) for i in (0, 3, 4, 5, 6, 7))
    ahead, behind = ca.fmax(dt, 0), ca.fmin(dt, 0)
    gyro, accel = change[:3], change[3:]
    earth, correction = Turn.matrix(exp_small(-w_ie * ahead)), Turn.by(dR_g @ gyro + rate * behind, small=True)
    R_t = earth * R * Turn.matrix(dR) * correction
    v_t = v + pull * ahead + R.apply(dv + dv_g @ gyro + dv_a @ accel)
    r_t = r + v * dt + pull * ahead**2 / 2 + R.apply(dp + dp_g @ gyro + dp_a @ accel)
    return R_t, v_t, r_t


def point(s: Symbols, shape: EndShape) -> dict[str, ca.SX]:
    """Model of an observed point alone: outputs r, v (3,) and C_nb (9,) row by row."""
    end = end_of(s, "a", shape)
    return {"r": end.r_n, "v": end.v_n, "C_nb": flat(end.C_nb.whole())}
