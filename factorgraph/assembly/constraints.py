"""Blocks of what is known of a vehicle's motion without measuring it (problem.Constraints).

    non-holonomic    0 = x and z of C_bc^T C_nb^T (v + C_nb (w_nb x a))   a: the axle point; C_bc = Exp([pitch, 0, yaw])
    zero velocity    0 = v                                                while the vehicle is at rest
    zero rotation    0 = Log(C_nb(t_0)^T C_nb(t_1)) / (t_1 - t_0)         between states at rest
    height hold      0 = v_U

Zero rotation ties two attitudes. With the IMU between them it says that the mean rate less bias less Earth rate is zero,
and the noise of the gyroscope counts once.
Rest is where the IMU shows it (rest), or where an odometer reads zero.
Source: Groves (2013), sec. 15.3 and 15.4.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from factorgraph.assembly.blocks import CONSTRAINT, Block, Endpoint
from factorgraph.assembly.parameters import Parameters
from factorgraph.assembly.rows import plain_rows
from factorgraph.assembly.sensors import AXES_B, AXES_N, Measured, Model, Mounting, VectorBlock, body_velocity, known
from factorgraph.assembly.variables import VehicleVariables
from factorgraph.attitude import log_so3, right_jacobian_inverse
from factorgraph.errors import InputError
from factorgraph.grid import subdivided
from factorgraph.problem import NavigationProblem, Vehicle
from factorgraph.rest import inside, rest_spans, union, zero_spans
from factorgraph.types import Array, BoolArray, IntArray

SUPPORT_S = 1.0  # a start velocity counts as known this close to a measurement of it
ODOMETER_ZERO_SIGMA, ODOMETER_ZERO_MPS = 3.0, 0.1  # an odometer that reads less than both is at rest


@dataclass(slots=True)
class NonHolonomicBlock(VectorBlock):
    """Velocities across the direction of travel."""

    mounting: Mounting

    def model(self) -> Model:
        v, J, more = body_velocity(self.end, self.mounting)
        return -v, [J], more


@dataclass(slots=True)
class StillBlock(VectorBlock):
    """Velocities of the body in n that are zero."""

    def model(self) -> Model:
        p = self.end.points()
        return -p.v_n, [p.J_v], []


@dataclass(slots=True)
class ZeroRotationBlock(Block):
    """Attitudes that are the same at two states."""

    vehicle: VehicleVariables
    first: IntArray  # (m,) states
    second: IntArray

    def keys(self, f: int) -> list[int]:
        return [self.vehicle.keys(int(k))[0] for k in (self.first[f], self.second[f])]

    def widths(self) -> tuple[int, ...]:
        return (6, 6)

    def predict(self) -> None:
        v = self.vehicle
        before, after = v.R[self.first], v.R[self.second]
        dt = (v.t_s[self.second] - v.t_s[self.first])[:, None]
        turn = np.swapaxes(before, 1, 2) @ after
        phi = log_so3(turn)
        inverse = right_jacobian_inverse(phi) / dt[..., None]
        self.y = -(phi / dt).ravel()
        J = np.zeros((len(phi), 3, 12))
        J[:, :, :3], J[:, :, 6:9] = -inverse @ np.swapaxes(turn, 1, 2), inverse
        self.J = J.reshape(self.n, 12)


def constraint_blocks(problem: NavigationProblem, ends: dict[str, VehicleVariables], parameters: Parameters) -> list[Block]:
    """Blocks of the constraints that the vehicles of a problem ask for.

    Variables hold start values: their velocities help to tell rest from a smooth ride. Raises InputError where a constraint
    needs the attitude of a vehicle without IMU.
    """
    blocks: list[Block] = []
    for end in ends.values():
        c = end.vehicle.constraints
        if end.mode == "fixed":
            continue
        _check(end.vehicle)
        if c.height_mps > 0:
            blocks.append(_still_block(end, _times(end), np.array([np.inf, np.inf, c.height_mps]), "height hold"))
        if end.mode != "imu":
            continue
        if c.lateral_mps > 0 or c.vertical_mps > 0:
            blocks.append(_non_holonomic_block(end, parameters))
        if c.zero_velocity_mps > 0 or c.zero_rotation_rps > 0:
            blocks += _rest_blocks(end)
    return [block for block in blocks if block.n]


def _check(vehicle: Vehicle) -> None:
    c = vehicle.constraints
    if vehicle.imu is None and max(c.lateral_mps, c.vertical_mps, c.zero_velocity_mps, c.zero_rotation_rps) > 0:
        raise InputError(
            f"vehicle {vehicle.name}: of the constraints only height_mps can be used without an IMU; lateral_mps, vertical_mps, "
            "zero_velocity_mps and zero_rotation_rps need the attitude and the rest that an IMU shows"
        )


def _times(end: VehicleVariables) -> Array:
    """State times that are `interval_s` apart or more, and times between states that are farther apart."""
    interval = end.vehicle.constraints.interval_s
    t = end.t_s[_thinned(end.t_s, interval)]
    if end.mode != "imu":
        return t
    times = subdivided(t, interval)
    return times[end.is_carried(times)]


def _thinned(t: Array, interval: float) -> IntArray:
    """States from the first on, each the first that is `interval` after the one before."""
    kept = [0]
    while (k := int(np.searchsorted(t, t[kept[-1]] + interval - 1e-3))) < len(t):
        kept.append(max(k, kept[-1] + 1))
    return np.array(kept)


def _component_block_parts(end: VehicleVariables, t: Array, sigma: Array, lever: tuple[float, float, float]) -> Measured:
    at = Endpoint(end, end.query(t, lever))
    has = np.broadcast_to(np.isfinite(sigma), (len(t), 3))
    return Measured(np.arange(len(t)), (at,), has, np.broadcast_to(sigma, (len(t), 3)), t)


def _still_block(end: VehicleVariables, t: Array, sigma: Array, what: str) -> Block:
    m = _component_block_parts(end, t, sigma, (0.0, 0.0, 0.0))
    return StillBlock(m.table(CONSTRAINT, f"{end.name}/{what}", AXES_N), m, ())


def _non_holonomic_block(end: VehicleVariables, parameters: Parameters) -> Block:
    c = end.vehicle.constraints
    sigma = np.array([c.lateral_mps or np.inf, np.inf, c.vertical_mps or np.inf])
    angles = [parameters.scalar(f"{end.name}/direction of travel {of}", "rad", c.mounting_rad) for of in ("pitch", "yaw")]
    mounting = Mounting(known(*angles), ([0], [2])) if c.mounting_rad > 0 else Mounting()
    m = _component_block_parts(end, _times(end), sigma, c.axle_b)
    return NonHolonomicBlock(m.table(CONSTRAINT, f"{end.name}/non-holonomic", AXES_B), m, mounting.parameters, mounting)


def _rest_blocks(end: VehicleVariables) -> list[Block]:
    c = end.vehicle.constraints
    spans = vehicle_rest(end)
    t = _times(end)
    blocks: list[Block] = []
    still = t[inside(spans, t, t)]
    if c.zero_velocity_mps > 0 and len(still):
        blocks.append(_still_block(end, still, np.full(3, c.zero_velocity_mps), "zero velocity"))
    if c.zero_rotation_rps > 0:
        first, second = _resting_pairs(end, spans)
        n = len(first)
        if n:
            rows = plain_rows(
                CONSTRAINT,
                np.repeat(end.t_s[second], 3),
                np.full(3 * n, c.zero_rotation_rps),
                np.repeat(np.arange(n), 3),
                f"{end.name}/zero rotation",
                AXES_B,
                np.tile(np.arange(3), n),
            )
            blocks.append(ZeroRotationBlock(rows, vehicle=end, first=first, second=second))
    return blocks


def _resting_pairs(end: VehicleVariables, spans: Array) -> tuple[IntArray, IntArray]:
    """States `interval_s` apart or more that follow each other, between which the vehicle rests."""
    k = _thinned(end.t_s, end.vehicle.constraints.interval_s)
    rests = inside(spans, end.t_s[k[:-1]], end.t_s[k[1:]])
    return k[:-1][rests], k[1:][rests]


def vehicle_rest(end: VehicleVariables) -> Array:
    """Start and end (m, 2) of the stretches where a vehicle with an IMU rests."""
    v = end.vehicle
    known_t = [v.gnss.stream.t_s] if v.gnss is not None else []
    known_t += [p.t_s for p in v.positions]
    supported = _near(end.t_s, np.sort(np.concatenate([np.zeros(0), *known_t])))
    t, speed = end.t_s[supported], np.linalg.norm(end.v[supported], axis=1)
    zero = [np.zeros((0, 2))]
    for odometer in v.velocities:
        read = np.isfinite(odometer.v_b[:, 1])
        forward, below = odometer.v_b[read, 1], np.minimum(ODOMETER_ZERO_SIGMA * odometer.sigma_mps[read, 1], ODOMETER_ZERO_MPS)
        zero.append(zero_spans(odometer.t_s[read], forward, below))
        t, speed = np.append(t, odometer.t_s[read]), np.append(speed, np.abs(forward))
    order = np.argsort(t, kind="stable")
    spans = np.concatenate([rest_spans(end.imu, t[order], speed[order]), *zero])
    return union(spans[:, 0], spans[:, 1])


def _near(t: Array, known: Array) -> BoolArray:
    """Which times (n,) have one of `known` (m,), sorted, within SUPPORT_S."""
    if not len(known):
        return np.zeros(len(t), bool)
    after = np.clip(np.searchsorted(known, t), 0, len(known) - 1)
    before = np.maximum(after - 1, 0)
    return np.asarray(np.minimum(np.abs(known[after] - t), np.abs(known[before] - t)) <= SUPPORT_S)
