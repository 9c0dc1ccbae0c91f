"""Inertial measurements with errors: measured = (1 + scale) true + bias + noise.

A density n gives samples of standard deviation n / sqrt(dt) (means over dt); a bias walks by sigma sqrt(dt) per sample.
Source: spec common.md, section 4.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pydantic import Field, PositiveFloat

from factorgraph.geodesy import LocalFrame
from factorgraph.measurements import ImuStream
from factorgraph.models.strapdown import ideal_imu
from factorgraph.problem import ImuNoise, Vec3
from factorgraph.types import Array
from scenarios.flights.schema import ImuNoiseTable, Table
from scenarios.simulate.streams import Streams
from scenarios.simulate.trajectory import Trajectory


class ImuTable(Table):
    """An IMU at the body origin; biases are drawn from the noise table unless given."""

    rate_hz: PositiveFloat = 200.0
    noise: ImuNoiseTable = ImuNoiseTable()
    gyro_bias_rps: Vec3 | None = None
    accel_bias_mps2: Vec3 | None = None
    gyro_scale_ppm: float = Field(default=0.0, ge=0)  # standard deviation, drawn per axis
    accel_scale_ppm: float = Field(default=0.0, ge=0)


@dataclass(frozen=True, slots=True)
class ImuRecord:
    """The errors put in."""

    gyro_bias_rps: Array  # (n, 3) at every sample
    accel_bias_mps2: Array  # (n, 3)
    gyro_scale: Array  # (3,)
    accel_scale: Array  # (3,)


def simulate(
    table: ImuTable, trajectory: Trajectory, frame: LocalFrame, duration_s: float, streams: Streams, noise_scale: float
) -> tuple[ImuStream, ImuRecord]:
    """Mean samples from 0 to the end of the flight; `noise_scale` multiplies every error."""
    dt = 1 / table.rate_hz
    t = np.arange(-1, int(np.floor(duration_s * table.rate_hz + 1e-6)) + 1) / table.rate_hz
    motion = trajectory.at(t)
    f, w = (x[1:] for x in ideal_imu(frame, t, motion.r_n, motion.v_n, motion.C_nb))
    noise = table.noise.noise
    record = _errors(table, noise, len(f), dt, streams, noise_scale)
    f = f * (1 + record.accel_scale) + record.accel_bias_mps2
    w = w * (1 + record.gyro_scale) + record.gyro_bias_rps
    white = noise_scale / np.sqrt(dt)
    f += streams("accel noise").normal(0.0, 1.0, f.shape) * (noise.accel_mps2_rthz * white)
    w += streams("gyro noise").normal(0.0, 1.0, w.shape) * (noise.gyro_rps_rthz * white)
    return ImuStream(t[1:], f, w, is_mean=True), record


def _errors(table: ImuTable, noise: ImuNoise, n: int, dt: float, streams: Streams, noise_scale: float) -> ImuRecord:
    def bias(name: str, given: Vec3 | None, sigma: float, walk: float) -> Array:
        start = streams(f"{name} bias").normal(0.0, sigma, 3) if given is None else np.asarray(given)
        steps = streams(f"{name} walk").normal(0.0, walk * np.sqrt(dt), (n, 3))
        return np.asarray(noise_scale * (start + np.cumsum(steps, axis=0)))

    return ImuRecord(
        bias("gyro", table.gyro_bias_rps, noise.gyro_bias_rps, noise.gyro_bias_walk_rps_rts),
        bias("accel", table.accel_bias_mps2, noise.accel_bias_mps2, noise.accel_bias_walk_mps2_rts),
        noise_scale * streams("gyro scale").normal(0.0, 1.0, 3) * table.gyro_scale_ppm * 1e-6,
        noise_scale * streams("accel scale").normal(0.0, 1.0, 3) * table.accel_scale_ppm * 1e-6,
    )
