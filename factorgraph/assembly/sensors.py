"""Blocks of sensors that see the vehicle's attitude or velocity: odometers, attitude systems, magnetometers, cameras.

With C_bs = Exp(m) the sensor's rotation against the body (m: its estimated mounting), a the sensor's point and x_s = C_bs^T x_b:

    velocity of a fix    z = v_a                                    in n
    odometer             z = (1 + s) C_bs^T C_nb^T v_a              v_a = v + C_nb (w_nb x l)
    attitude             0 = Log(C_ns (C_nb C_bs)^T)                rotation error about east, north, up
    heading alone        z = atan2(f_E, f_N),  f = C_nb C_bs e_y    where nothing is told of roll and pitch
    magnetometer         z = C_bs^T C_nb^T m_n + b                  b: hard iron
    camera, radar        d = C_bs^T C_nb^T (r_target - r_a),  azimuth atan2(d_x, d_y), elevation atan2(d_z, |d_xy|), range |d|

Everything is observed at its own time, between states by preintegration. Perturbation R Exp(dtheta), as in variables.
Source: Groves (2013), ch. 6 and 16, for odometer, magnetometer and their errors.
"""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass, field

import numpy as np

from factorgraph.assembly.blocks import ATTITUDE, BEARING, MAGNETIC, VELOCITY, Block, Endpoint, EndsBlock, Rows, interval_of
from factorgraph.assembly.parameters import Parameter, Parameters
from factorgraph.assembly.rows import in_grid, plain_rows, sensor_end
from factorgraph.assembly.variables import VehicleVariables
from factorgraph.attitude import exp_so3, log_so3, matrix_from_quat, right_jacobian, right_jacobian_inverse, skew, wrapped
from factorgraph.errors import InputError
from factorgraph.measurements import (
    AttitudeStream,
    Calibration,
    MagneticStream,
    PositionStream,
    Tag,
    VelocityStream,
    VisionStream,
)
from factorgraph.models.differencing import CommonGroups
from factorgraph.problem import NavigationProblem
from factorgraph.types import Array, BoolArray, IntArray

AXES_B, AXES_N = ["right", "forward", "up"], ["E", "N", "U"]
Model = tuple[Array, list[Array], list[Array]]  # measured - predicted (m, c); Jacobians (m, c, w) by end, (m, c, d) by parameter


@dataclass(slots=True)
class Measured:
    """The measurements of a stream that a block takes."""

    stream_rows: IntArray  # (m,)
    ends: tuple[Endpoint, ...]
    has: BoolArray  # (m, c) which components were measured
    sigma: Array  # (m, c)
    t_s: Array  # (m,)

    def table(self, kind: int, source: str, labels: list[str]) -> Rows:
        """A row for every component that was measured."""
        of_row, component = np.nonzero(self.has)
        interval = interval_of(self.ends)[of_row]
        return plain_rows(kind, self.t_s[of_row], self.sigma[of_row, component], interval, source, labels, component)


@dataclass(slots=True)
class VectorBlock(EndsBlock):
    """A block whose measurements have several components, of which only those that were measured are rows."""

    measured: Measured
    estimated: tuple[Parameter, ...]
    of_row: IntArray = field(init=False)  # (n,) row -> measurement
    component: IntArray = field(init=False)  # (n,)

    def __post_init__(self) -> None:
        self.of_row, self.component = np.nonzero(self.measured.has)
        EndsBlock.__post_init__(self)

    @property
    def end(self) -> Endpoint:
        """The first end: the sensor."""
        return self.measured.ends[0]

    def ends(self) -> list[Endpoint]:
        return list(self.measured.ends)

    def parameters(self) -> list[Parameter]:
        return list(self.estimated)

    def entries(self) -> IntArray:
        return self.of_row[self.rows.factor.start]

    def regroup(self) -> None:
        self.rows.factor = CommonGroups.from_labels(interval_of(self.measured.ends)[self.of_row])

    @abstractmethod
    def model(self) -> Model:
        """Residuals of every component and their Jacobians, at the current variables."""

    def predict(self) -> None:
        at = (self.of_row, self.component)
        y, by_end, by_parameter = self.model()
        self.y = y[at]
        self.J = self.columns_of.join([J[at] for J in by_end], [J[at] for J in by_parameter])


@dataclass(frozen=True, slots=True)
class Frame:
    """Attitude of the body at an end's times, and how the end's columns turn it."""

    C_nb: Array  # (m, 3, 3)
    J: Array  # (m, 3, w): C_nb Exp(J dx)

    def in_body(self, x_n: Array) -> Array:
        """Components (m, 3) along the body axes of vectors (m, 3) or (3,) of n."""
        return np.asarray(np.einsum("mji,mj->mi", self.C_nb, np.broadcast_to(x_n, (len(self.C_nb), 3))))


def frame_of(end: Endpoint) -> Frame:
    """The body at an end's times; its lever arm does not turn it, its time offsets do by its rate."""
    q, v = end.query, end.vehicle
    C, J = v.frames(q)
    if not end.parameters:
        return Frame(C, J)
    rate = v.body_rate(v.t_s[q.k] + q.dt_s, q.k)
    late, columns = 0.0, [J]
    if end.lever is not None:
        columns.append(np.zeros((len(q.k), 3, 3)))
    for sign, ahead_s in end.ahead():
        late += ahead_s
        columns.append(sign * rate[:, :, None])
    turned = exp_so3(rate * late)
    columns[0] = np.swapaxes(turned, 1, 2) @ columns[0]
    if J.shape[2] == 15:
        columns[0][:, :, 12:] -= late * np.eye(3)  # the rate carries the bias
    return Frame(C @ turned, np.concatenate(columns, axis=2))


@dataclass(slots=True)
class Mounting:
    """A sensor's rotation against the body, C_bs = Exp(m), where it is estimated: which axes of m each parameter holds."""

    parameters: tuple[Parameter, ...] = ()
    axes: tuple[list[int], ...] = ()

    @classmethod
    def about_all_axes(cls, name: str, calibration: Calibration, parameters: Parameters) -> Mounting:
        m = parameters.vector(f"{name} mounting", "rad", calibration.mounting_rad)
        return cls() if m is None else cls((m,), ([0, 1, 2],))

    def _vector(self) -> Array:
        """m (3,)."""
        m = np.zeros(3)
        for p, axes in zip(self.parameters, self.axes, strict=True):
            m[axes] = p.value
        return m

    @property
    def C_bs(self) -> Array:
        """(3, 3)."""
        return exp_so3(self._vector())

    def columns(self, by_turn: Array) -> list[Array]:
        """Jacobians (m, c, d) to the parameters from that to a small turn of the sensor about its own axes (m, c, 3)."""
        J = by_turn @ right_jacobian(self._vector())
        return [J[:, :, axes] for axes in self.axes]

    def in_sensor(self, x_b: Array, J_b: Array) -> tuple[Array, Array, list[Array]]:
        """Vectors (m, 3) and their Jacobians (m, 3, w) along the sensor's axes, and the Jacobians to the mounting."""
        C = self.C_bs
        x_s = x_b @ C
        return x_s, C.T @ J_b, self.columns(skew(x_s))


@dataclass(slots=True)
class FixVelocityBlock(VectorBlock):
    """Velocities in n of a point whose position is measured too."""

    z_n: Array  # (m, 3)

    def model(self) -> Model:
        p = self.end.points()
        return self.z_n - p.v_n, [p.J_v], []


def body_velocity(end: Endpoint, mounting: Mounting) -> tuple[Array, Array, list[Array]]:
    """Velocity (m, 3) of an end's point along a sensor's axes, with Jacobians to the end and to the mounting."""
    p, frame = end.points(), frame_of(end)
    v_b = frame.in_body(p.v_n)
    J_b = np.swapaxes(frame.C_nb, 1, 2) @ p.J_v + skew(v_b) @ frame.J
    return mounting.in_sensor(v_b, J_b)


@dataclass(slots=True)
class VelocityBlock(VectorBlock):
    """Velocities along the axes of a sensor on the body, with a scale where one is estimated."""

    z_b: Array  # (m, 3)
    mounting: Mounting
    scale: Parameter | None

    def model(self) -> Model:
        v, J, by_mounting = body_velocity(self.end, self.mounting)
        if self.scale is None:
            return self.z_b - v, [J], by_mounting
        s = 1 + float(self.scale.value[0])
        return self.z_b - s * v, [s * J], [v[:, :, None], *(s * x for x in by_mounting)]


@dataclass(slots=True)
class AttitudeBlock(VectorBlock):
    """Attitudes of a reference system; rows are rotation errors about the axes of n."""

    C_ns: Array  # (m, 3, 3) measured
    mounting: Mounting

    def model(self) -> Model:
        frame, C_bs = frame_of(self.end), self.mounting.C_bs
        y = log_so3(self.C_ns @ np.swapaxes(frame.C_nb @ C_bs, 1, 2))
        by_turn = right_jacobian_inverse(y) @ frame.C_nb  # of the body, resolved along its own axes
        return y, [by_turn @ frame.J], self.mounting.columns(by_turn @ C_bs)


@dataclass(slots=True)
class HeadingBlock(VectorBlock):
    """Headings of a reference system that tells no more."""

    heading_rad: Array  # (m,)
    mounting: Mounting

    def model(self) -> Model:
        frame = frame_of(self.end)
        axis_b = self.mounting.C_bs[:, 1]
        f = frame.C_nb @ axis_b
        level = np.maximum(np.hypot(f[:, 0], f[:, 1]), 1e-6)
        across = np.column_stack([f[:, 1], -f[:, 0], np.zeros(len(f))]) / level[:, None] ** 2
        by_turn = -across[:, None, :] @ frame.C_nb @ skew(axis_b)
        y = wrapped(self.heading_rad - np.arctan2(f[:, 0], f[:, 1]))
        return y[:, None], [by_turn @ frame.J], self.mounting.columns(by_turn @ self.mounting.C_bs)


@dataclass(slots=True)
class MagneticBlock(VectorBlock):
    """Magnetic fields along the axes of a sensor on the body, with hard iron where it is estimated."""

    m_b: Array  # (m, 3)
    field_n: Array  # (3,)
    mounting: Mounting
    bias: Parameter | None

    def model(self) -> Model:
        frame = frame_of(self.end)
        m_b = frame.in_body(self.field_n)
        m_s, J, more = self.mounting.in_sensor(m_b, skew(m_b) @ frame.J)
        if self.bias is None:
            return self.m_b - m_s, [J], more
        return self.m_b - m_s - self.bias.value, [J], [np.broadcast_to(np.eye(3), (len(m_s), 3, 3)), *more]


@dataclass(slots=True)
class VisionBlock(VectorBlock):
    """Azimuth, elevation and range of a target from an observer on a vehicle; the target moves or is a landmark."""

    z: Array  # (m, 3) azimuth, elevation, range
    landmark_n: Array | None  # (3,) where the target is not on a vehicle
    mounting: Mounting

    def model(self) -> Model:
        observer, frame = self.end.points(velocity=False), frame_of(self.end)
        C_bn = np.swapaxes(frame.C_nb, 1, 2)
        if self.landmark_n is None:
            target = self.measured.ends[1].points(velocity=False)
            d_n, parts = target.r_n - observer.r_n, [C_bn @ target.J_r]
        else:
            d_n, parts = self.landmark_n - observer.r_n, []
        d_b = frame.in_body(d_n)
        own = skew(d_b) @ frame.J - C_bn @ observer.J_r
        d, J, more = self.mounting.in_sensor(d_b, own)
        by_d, predicted = directions(d)
        C_sb = self.mounting.C_bs.T
        y = self.z - predicted
        y[:, :2] = wrapped(y[:, :2])
        return y, [by_d @ J, *(by_d @ C_sb @ part for part in parts)], [by_d @ x for x in more]


def directions(d: Array) -> tuple[Array, Array]:
    """Azimuth, elevation and range (m, 3) of vectors (m, 3) in right, front, up, after their Jacobian (m, 3, 3)."""
    level2 = np.maximum(d[:, 0] ** 2 + d[:, 1] ** 2, 1e-12)
    level, rho = np.sqrt(level2), np.maximum(np.linalg.norm(d, axis=1), 1e-6)
    J = np.zeros((len(d), 3, 3))
    J[:, 0, 0], J[:, 0, 1] = d[:, 1] / level2, -d[:, 0] / level2
    J[:, 1, :2] = -(d[:, 2] / (rho**2 * level))[:, None] * d[:, :2]
    J[:, 1, 2] = level / rho**2
    J[:, 2] = d / rho[:, None]
    return J, np.column_stack([np.arctan2(d[:, 0], d[:, 1]), np.arctan2(d[:, 2], level), rho])


# from streams to blocks


def sensor_blocks(problem: NavigationProblem, ends: dict[str, VehicleVariables], parameters: Parameters) -> list[Block]:
    """Blocks of the velocities of fixes, odometers, attitude systems, magnetometers and cameras of a problem.

    What needs an attitude is left out for a vehicle whose IMU the graph does not use. Raises InputError where a vehicle has
    no IMU at all.
    """
    blocks: list[Block] = []
    for end in ends.values():
        vehicle = end.vehicle
        if end.mode != "fixed":
            blocks += [_fix_velocity_block(end, p, parameters) for p in vehicle.positions if p.v_n is not None]
        blocks += [_velocity_block(end, s, parameters) for s in vehicle.velocities if _has_attitude(end, s.name)]
        blocks += [_attitude_block(end, s, parameters, False) for s in vehicle.attitudes if _has_attitude(end, s.name)]
        blocks += [_attitude_block(end, s, parameters, True) for s in vehicle.attitudes if _has_attitude(end, s.name)]
        blocks += [_magnetic_block(end, s, parameters) for s in vehicle.magnetics if _has_attitude(end, s.name)]
    for vision in problem.visions:
        observer, target = ends[vision.observer.vehicle or ""], ends.get(vision.target.vehicle or "")
        if _has_attitude(observer, vision.name) and (target is None or target.mode != "motion" or target.vehicle.imu is None):
            blocks.append(_vision_block(observer, target, vision, parameters))
    return [block for block in blocks if block.n]


def _has_attitude(end: VehicleVariables, sensor: str) -> bool:
    """Whether the graph knows the vehicle's attitude. Raises InputError where it never can."""
    if end.vehicle.imu is None:
        raise InputError(
            f"vehicle {end.name}: {sensor} is measured in the vehicle's axes, so an attitude is needed; give the vehicle an IMU"
        )
    return end.mode == "imu"


def _usable(end: VehicleVariables, t_s: Array, time_sigma_s: float) -> BoolArray:
    return in_grid(t_s, end.t_s, time_sigma_s) & end.is_carried(t_s)


def _measured(
    end: VehicleVariables,
    t_s: Array,
    has: BoolArray,
    sigma: Array,
    lever_b: tuple[float, float, float],
    name: str,
    calibration: Calibration,
    parameters: Parameters,
) -> Measured:
    """The measurements of one vehicle's sensor that lie on the grid and have a component."""
    rows = np.flatnonzero(_usable(end, t_s, calibration.time_s) & has.any(axis=1))
    at = sensor_end(end, t_s[rows], lever_b, f"{end.name}/{name}", calibration, parameters)
    return Measured(rows, (at,), has[rows], sigma[rows], t_s[rows])


def known(*parameters: Parameter | None) -> tuple[Parameter, ...]:
    """Those that are estimated."""
    return tuple(p for p in parameters if p is not None)


def _fix_velocity_block(end: VehicleVariables, s: PositionStream, parameters: Parameters) -> Block:
    assert s.v_n is not None and s.sigma_mps is not None
    has = np.isfinite(s.v_n) & np.isfinite(s.sigma_mps)
    m = _measured(end, s.t_s, has, s.sigma_mps, s.lever_b, s.name, s.calibration, parameters)
    return FixVelocityBlock(m.table(VELOCITY, f"{end.name}/{s.name} velocity", AXES_N), m, (), z_n=s.v_n[m.stream_rows])


def _velocity_block(end: VehicleVariables, s: VelocityStream, parameters: Parameters) -> Block:
    source = f"{end.name}/{s.name}"
    has = np.isfinite(s.v_b) & np.isfinite(s.sigma_mps)
    m = _measured(end, s.t_s, has, s.sigma_mps, s.lever_b, s.name, s.calibration, parameters)
    scale = parameters.scalar(f"{source} scale", "1", s.calibration.scale)
    mounting = Mounting.about_all_axes(source, s.calibration, parameters)
    estimated = (*known(scale), *mounting.parameters)
    table = m.table(VELOCITY, source, AXES_B)
    return VelocityBlock(table, m, estimated, z_b=s.v_b[m.stream_rows], mounting=mounting, scale=scale)


def _attitude_block(end: VehicleVariables, s: AttitudeStream, parameters: Parameters, heading: bool) -> Block:
    """The rows of an attitude system that tell of more than the heading, or those that tell the heading alone."""
    source = f"{end.name}/{s.name}"
    finite = np.isfinite(s.sigma_rad) & np.all(np.isfinite(s.q_nb), axis=1)[:, None]
    alone = finite[:, 2] & ~finite[:, 0] & ~finite[:, 1]
    has, sigma = ((finite & alone[:, None])[:, 2:], s.sigma_rad[:, 2:]) if heading else (finite & ~alone[:, None], s.sigma_rad)
    m = _measured(end, s.t_s, has, sigma, (0.0, 0.0, 0.0), s.name, s.calibration, parameters)
    mounting = Mounting.about_all_axes(source, s.calibration, parameters)
    C = matrix_from_quat(s.q_nb[m.stream_rows])
    if heading:
        headings = np.arctan2(C[:, 0, 1], C[:, 1, 1])
        table = m.table(ATTITUDE, source, ["heading"])
        return HeadingBlock(table, m, mounting.parameters, heading_rad=headings, mounting=mounting)
    return AttitudeBlock(m.table(ATTITUDE, source, AXES_N), m, mounting.parameters, C_ns=C, mounting=mounting)


def _magnetic_block(end: VehicleVariables, s: MagneticStream, parameters: Parameters) -> Block:
    source = f"{end.name}/{s.name}"
    has = np.isfinite(s.m_b) & np.isfinite(s.sigma)
    m = _measured(end, s.t_s, has, s.sigma, (0.0, 0.0, 0.0), s.name, s.calibration, parameters)
    bias = parameters.vector(f"{source} hard iron", "field", s.calibration.bias)
    mounting = Mounting.about_all_axes(source, s.calibration, parameters)
    return MagneticBlock(
        m.table(MAGNETIC, source, AXES_B),
        m,
        (*known(bias), *mounting.parameters),
        m_b=s.m_b[m.stream_rows],
        field_n=np.asarray(s.field_n, float),
        mounting=mounting,
        bias=bias,
    )


def _vision_block(observer: VehicleVariables, target: VehicleVariables | None, s: VisionStream, parameters: Parameters) -> Block:
    z = np.column_stack([s.azimuth_rad, s.elevation_rad, s.range_m])
    sigma = np.column_stack([s.sigma_rad, s.sigma_rad, s.sigma_m])
    has = np.isfinite(z) & np.isfinite(sigma)
    both = [observer] if target is None else [observer, target]
    usable = np.all([_usable(end, s.t_s, s.calibration.time_s) for end in both], axis=0)
    rows = np.flatnonzero(usable & has.any(axis=1))
    at = [
        sensor_end(end, s.t_s[rows], tag.lever_b, s.name, s.calibration, parameters)
        for end, tag in zip(both, (s.observer, s.target), strict=False)
    ]
    m = Measured(rows, tuple(at), has[rows], sigma[rows], s.t_s[rows])
    mounting = Mounting.about_all_axes(s.name, s.calibration, parameters)
    return VisionBlock(
        m.table(BEARING, _vision_source(s.observer, s.target, s.name), ["azimuth", "elevation", "range"]),
        m,
        mounting.parameters,
        z=z[rows],
        landmark_n=None if s.target.position_n is None else np.asarray(s.target.position_n, float),
        mounting=mounting,
    )


def _vision_source(observer: Tag, target: Tag, name: str) -> str:
    return f"{name} {observer.vehicle}-{target.vehicle or target.name}"
