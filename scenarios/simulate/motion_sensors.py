"""Odometers, attitude systems, magnetometers and cameras with white noise, and with the errors that estimators are told of.

A scale, a mounting or a hard iron that the estimator is to find is drawn from the prior it is told: z = (1 + s) C_bs^T x_b + b,
C_bs = Exp(m), as in factorgraph.assembly.sensors.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from pydantic import Field, PositiveFloat, model_validator

from factorgraph.assembly.sensors import directions
from factorgraph.attitude import exp_so3, quat_from_matrix
from factorgraph.errors import InputError
from factorgraph.measurements import AttitudeStream, Calibration, MagneticStream, Tag, VelocityStream, VisionStream
from factorgraph.problem import Vec3
from factorgraph.types import Array
from scenarios.flights.schema import NonNegative, Table, TagTable
from scenarios.simulate.fixes import epochs
from scenarios.simulate.streams import Name, Streams, gauss_markov
from scenarios.simulate.trajectory import Trajectory


class VelocityTable(Table):
    """An odometer, or a sensor of all three components of the velocity along the body axes."""

    name: Name = "odometer"
    rate_hz: PositiveFloat = 10.0
    offset_s: NonNegative = 0.0
    axes: Literal["forward", "all"] = "forward"
    sigma_mps: PositiveFloat = 0.1
    lever_b: Vec3 = (0.0, 0.0, 0.0)
    scale_sigma: NonNegative = 0.0
    mounting_sigma_deg: NonNegative = 0.0

    @property
    def calibration(self) -> Calibration:
        return Calibration(scale=self.scale_sigma, mounting_rad=np.deg2rad(self.mounting_sigma_deg))


class AttitudeTable(Table):
    """An attitude reference system; white and Gauss-Markov rotation errors about east, north and up.

    Samples of the latter within its correlation time say the same thing: estimators are told white noise that counts
    them once, see `told_deg`.
    """

    name: Name = "attitude"
    rate_hz: PositiveFloat = 10.0
    offset_s: NonNegative = 0.0
    sigma_deg: tuple[PositiveFloat, PositiveFloat, PositiveFloat] = (0.5, 0.5, 1.0)  # white
    gm_deg: tuple[NonNegative, NonNegative, NonNegative] = (0.0, 0.0, 0.0)  # steady standard deviations
    gm_s: PositiveFloat = 5.0  # correlation time
    tells: Literal["all", "tilt", "heading"] = "all"
    mounting_sigma_deg: NonNegative = 0.0

    @property
    def calibration(self) -> Calibration:
        return Calibration(mounting_rad=np.deg2rad(self.mounting_sigma_deg))

    @property
    def told_deg(self) -> tuple[float, float, float]:
        """White noise that averages as the errors do: 2 tau rate samples of the Gauss-Markov part count once."""
        once = np.sqrt(max(1.0, 2 * self.gm_s * self.rate_hz))
        east, north, up = np.hypot(self.sigma_deg, once * np.array(self.gm_deg)).tolist()
        return east, north, up


class MagnetometerTable(Table):
    """A magnetometer with hard iron."""

    name: Name = "magnetometer"
    rate_hz: PositiveFloat = 10.0
    offset_s: NonNegative = 0.0
    field_n: Vec3 | Literal["model"] = (0.9, 19.1, -45.3)  # microtesla, east-north-up; "model": of the place and date
    sigma: PositiveFloat = 0.5
    bias_sigma: NonNegative = 0.0
    mounting_sigma_deg: NonNegative = 0.0

    @property
    def calibration(self) -> Calibration:
        return Calibration(bias=self.bias_sigma, mounting_rad=np.deg2rad(self.mounting_sigma_deg))


class VisionTable(Table):
    """A camera or radar on a vehicle that follows a point of another or a landmark."""

    name: Name = "vision"
    rate_hz: PositiveFloat = 5.0
    offset_s: NonNegative = 0.0
    observer: TagTable
    target: TagTable
    angles: bool = True
    ranges: bool = False
    sigma_deg: PositiveFloat = 0.3
    sigma_m: PositiveFloat = 0.5
    max_range_m: PositiveFloat = 1e3
    detection: float = Field(default=1.0, gt=0, le=1)  # probability that a frame shows the target
    mounting_sigma_deg: NonNegative = 0.0

    @model_validator(mode="after")
    def _something(self) -> VisionTable:
        if not (self.angles or self.ranges):
            raise InputError(f"vision {self.name}: measure angles, ranges or both")
        if self.observer.vehicle is None:
            raise InputError(f"vision {self.name}: the observer {self.observer.name} must be on a vehicle")
        return self

    @property
    def calibration(self) -> Calibration:
        return Calibration(mounting_rad=np.deg2rad(self.mounting_sigma_deg))


@dataclass(frozen=True, slots=True)
class SensorRecord:
    """The errors put into a sensor: constant ones, and those of attitudes."""

    scale: float = 0.0
    mounting_rad: Array = field(default_factory=lambda: np.zeros(3))
    bias: Array = field(default_factory=lambda: np.zeros(3))
    rotation_n: Array = field(default_factory=lambda: np.zeros((0, 3)))  # (n, 3) of attitudes, sample by sample [rad]

    @property
    def C_bs(self) -> Array:
        return exp_so3(self.mounting_rad)


def _drawn(calibration: Calibration, streams: Streams, noise_scale: float) -> SensorRecord:
    return SensorRecord(
        noise_scale * float(streams("scale").normal(0.0, 1.0)) * calibration.scale,
        noise_scale * streams("mounting").normal(0.0, 1.0, 3) * calibration.mounting_rad,
        noise_scale * streams("bias").normal(0.0, 1.0, 3) * calibration.bias,
    )


def velocities(
    table: VelocityTable, trajectory: Trajectory, duration_s: float, streams: Streams, noise_scale: float
) -> tuple[VelocityStream, SensorRecord]:
    """Velocities of the whole flight."""
    record = _drawn(table.calibration, streams, noise_scale)
    t = epochs(table.rate_hz, table.offset_s, duration_s)
    motion = trajectory.at(t)
    v_b = np.einsum("nji,nj->ni", motion.C_nb, motion.point(table.lever_b)[1])
    z = (1 + record.scale) * v_b @ record.C_bs + streams("noise").normal(0.0, table.sigma_mps, v_b.shape) * noise_scale
    if table.axes == "forward":
        z[:, [0, 2]] = np.nan
    sigma = np.full(z.shape, table.sigma_mps)
    return VelocityStream(t, z, sigma, table.lever_b, table.name, table.calibration), record


def attitudes(
    table: AttitudeTable, trajectory: Trajectory, duration_s: float, streams: Streams, noise_scale: float
) -> tuple[AttitudeStream, SensorRecord]:
    """Attitudes of the whole flight."""
    record = _drawn(table.calibration, streams, noise_scale)
    t = epochs(table.rate_hz, table.offset_s, duration_s)
    rotation = streams("noise").normal(0.0, 1.0, (len(t), 3)) * np.deg2rad(table.sigma_deg)
    if max(table.gm_deg) > 0:
        drift = gauss_markov(streams("gauss-markov").normal(0.0, 1.0, (len(t), 3)), 1 / (table.rate_hz * table.gm_s))
        rotation += drift * np.deg2rad(table.gm_deg)
    rotation *= noise_scale
    q = quat_from_matrix(exp_so3(rotation) @ trajectory.at(t).C_nb @ record.C_bs)
    sigma = np.deg2rad(table.told_deg)
    told = np.where({"all": [0, 0, 0], "tilt": [0, 0, 1], "heading": [1, 1, 0]}[table.tells], np.inf, sigma)
    stream = AttitudeStream(t, q, np.tile(told, (len(t), 1)), table.name, table.calibration)
    return stream, replace(record, rotation_n=rotation)


def magnetics(
    table: MagnetometerTable,
    trajectory: Trajectory,
    duration_s: float,
    streams: Streams,
    noise_scale: float,
    model_n: Callable[[], Array],
) -> tuple[MagneticStream, SensorRecord]:
    """Fields of the whole flight; model_n gives the field (3,) of the place and date to tables that ask for it."""
    record = _drawn(table.calibration, streams, noise_scale)
    t = epochs(table.rate_hz, table.offset_s, duration_s)
    east, north, up = model_n().tolist() if table.field_n == "model" else table.field_n
    m_b = np.einsum("nji,j->ni", trajectory.at(t).C_nb, np.array([east, north, up]))
    z = m_b @ record.C_bs + record.bias + streams("noise").normal(0.0, table.sigma, m_b.shape) * noise_scale
    return MagneticStream(t, z, np.full(z.shape, table.sigma), (east, north, up), table.name, table.calibration), record


def vision(
    table: VisionTable, trajectories: dict[str, Trajectory], duration_s: float, streams: Streams, noise_scale: float
) -> tuple[VisionStream, SensorRecord]:
    """Directions and ranges of the whole flight. Raises InputError where the target is never seen."""
    record = _drawn(table.calibration, streams, noise_scale)
    t = epochs(table.rate_hz, table.offset_s, duration_s)
    observer, target = (Tag(tag.name, tag.vehicle, tag.lever_b, tag.position_m) for tag in (table.observer, table.target))
    for tag in (observer, target):
        if tag.vehicle is not None and tag.vehicle not in trajectories:
            raise InputError(f"vision {table.name}: no vehicle {tag.vehicle}; there are {', '.join(trajectories)}")
    motion = trajectories[table.observer.vehicle or ""].at(t)
    seen = target.position_n if target.vehicle is None else trajectories[target.vehicle].at(t).point(target.lever_b)[0]
    d_n = np.asarray(seen, float) - motion.point(observer.lever_b)[0]
    z = directions(np.einsum("nji,nj->ni", motion.C_nb, d_n) @ record.C_bs)[1]
    z += streams("noise").normal(0.0, 1.0, z.shape) * [*np.deg2rad([table.sigma_deg] * 2), table.sigma_m] * noise_scale
    shown = (streams("detection").random(len(t)) < table.detection) & (np.linalg.norm(d_n, axis=1) <= table.max_range_m)
    if not np.any(shown):
        raise InputError(f"vision {table.name}: {target.name} is never within max_range_m {table.max_range_m:g} m")
    t, z = t[shown], z[shown]
    if not table.angles:
        z[:, :2] = np.nan
    if not table.ranges:
        z[:, 2] = np.nan
    sigma_rad, sigma_m = np.full(len(t), np.deg2rad(table.sigma_deg)), np.full(len(t), table.sigma_m)
    stream = VisionStream(t, observer, target, z[:, 0], z[:, 1], z[:, 2], sigma_rad, sigma_m, table.name, table.calibration)
    return stream, record
