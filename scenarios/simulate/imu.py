"""Inertial measurements with errors: measured = (1 + scale) true + bias + noise.

A density n gives samples of standard deviation n / sqrt(dt) (means over dt). A bias walks by sigma sqrt(dt) per sample, or
it is a constant plus a Gauss-Markov part of steady standard deviation s and correlation time tau. Estimators are told a
random walk in both cases, for the latter one of the same driving noise, s sqrt(2 / tau), and a first value as uncertain as
constant and s together.
Source: spec common.md, section 4.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from pydantic import Field, PositiveFloat, model_validator

from factorgraph.errors import InputError
from factorgraph.geodesy import LocalFrame
from factorgraph.measurements import ImuStream
from factorgraph.models.strapdown import ideal_imu
from factorgraph.problem import ImuNoise, Vec3
from factorgraph.types import Array
from scenarios.flights.schema import IMU_NOISE_UNITS, ImuNoiseTable, Table
from scenarios.simulate.streams import Streams, gauss_markov
from scenarios.simulate.trajectory import Trajectory


class ImuTable(Table):
    """An IMU at the body origin; biases are drawn from the noise table unless given."""

    rate_hz: PositiveFloat = 200.0
    noise: ImuNoiseTable = ImuNoiseTable()
    gyro_bias_rps: Vec3 | None = None
    accel_bias_mps2: Vec3 | None = None
    gyro_scale_ppm: float = Field(default=0.0, ge=0)  # standard deviation, drawn per axis
    accel_scale_ppm: float = Field(default=0.0, ge=0)
    gyro_gm_deg_h: float = Field(default=0.0, ge=0)  # steady standard deviation; above 0 the bias does not walk
    gyro_gm_s: PositiveFloat = 1000.0  # correlation time
    accel_gm_mg: float = Field(default=0.0, ge=0)
    accel_gm_s: PositiveFloat = 1000.0

    @model_validator(mode="after")
    def _walks_or_returns(self) -> ImuTable:
        parts = (
            ("gyro_gm_deg_h", self.gyro_gm_deg_h, "gyro_bias_walk_rps_rts"),
            ("accel_gm_mg", self.accel_gm_mg, "accel_bias_walk_mps2_rts"),
        )
        for key, gauss_markov_sigma, walk in parts:
            walks = [k for k in _keys(walk) if getattr(self.noise, k) is not None]
            if gauss_markov_sigma > 0 and walks:
                raise InputError(f"{key} and noise.{walks[0]} exclude each other: a bias walks or is Gauss-Markov")
        return self

    @property
    def gyro_gm_rps(self) -> float:
        return self.gyro_gm_deg_h * IMU_NOISE_UNITS["gyro_bias_deg_h"][1]

    @property
    def accel_gm_mps2(self) -> float:
        return self.accel_gm_mg * IMU_NOISE_UNITS["accel_bias_mg"][1]

    @property
    def told(self) -> ImuNoiseTable:
        """Noise as the estimator is told: a Gauss-Markov part counts as the random walk of the same driving noise.

        A first bias that is drawn is as uncertain as its constant and its Gauss-Markov part together; of a given one,
        the noise table says how well the estimator knows it.
        """
        values: dict[str, float | None] = {}
        if self.gyro_gm_rps > 0:
            values["gyro_bias_walk_rps_rts"] = self.gyro_gm_rps * math.sqrt(2 / self.gyro_gm_s)
            if self.gyro_bias_rps is None:
                values |= dict.fromkeys(_keys("gyro_bias_rps"))
                values["gyro_bias_rps"] = math.hypot(self.noise.noise.gyro_bias_rps, self.gyro_gm_rps)
        if self.accel_gm_mps2 > 0:
            values["accel_bias_walk_mps2_rts"] = self.accel_gm_mps2 * math.sqrt(2 / self.accel_gm_s)
            if self.accel_bias_mps2 is None:
                values |= dict.fromkeys(_keys("accel_bias_mps2"))
                values["accel_bias_mps2"] = math.hypot(self.noise.noise.accel_bias_mps2, self.accel_gm_mps2)
        return self.noise.model_copy(update=values)


def _keys(quantity: str) -> list[str]:
    """Keys of the noise table that state a quantity, in whatever unit."""
    return [key for key, (name, _) in IMU_NOISE_UNITS.items() if name == quantity]


@dataclass(frozen=True, slots=True)
class ImuRecord:
    """The errors put in."""

    gyro_bias_rps: Array  # (n, 3) at every sample
    accel_bias_mps2: Array  # (n, 3)
    gyro_scale: Array  # (3,)
    accel_scale: Array  # (3,)


def exact(table: ImuTable, trajectory: Trajectory, frame: LocalFrame, duration_s: float) -> ImuStream:
    """Mean samples without errors from 0 to the end of the flight."""
    t = np.arange(-1, int(np.floor(duration_s * table.rate_hz + 1e-6)) + 1) / table.rate_hz
    motion = trajectory.at(t)
    f, w = ideal_imu(frame, t, motion.r_n, motion.v_n, motion.C_nb)
    return ImuStream(t[1:], f[1:], w[1:], is_mean=True)


def simulate(table: ImuTable, true: ImuStream, streams: Streams, noise_scale: float) -> tuple[ImuStream, ImuRecord]:
    """The samples of `exact` with errors; `noise_scale` multiplies every one of them."""
    dt = 1 / table.rate_hz
    noise = table.noise.noise
    record = _errors(table, noise, len(true.t_s), dt, streams, noise_scale)
    f = true.f_b * (1 + record.accel_scale) + record.accel_bias_mps2
    w = true.w_b * (1 + record.gyro_scale) + record.gyro_bias_rps
    white = noise_scale / np.sqrt(dt)
    f += streams("accel noise").normal(0.0, 1.0, f.shape) * (noise.accel_mps2_rthz * white)
    w += streams("gyro noise").normal(0.0, 1.0, w.shape) * (noise.gyro_rps_rthz * white)
    return ImuStream(true.t_s, f, w, is_mean=True), record


def _errors(table: ImuTable, noise: ImuNoise, n: int, dt: float, streams: Streams, noise_scale: float) -> ImuRecord:
    def bias(name: str, given: Vec3 | None, sigma: float, varying: Array) -> Array:
        start = streams(f"{name} bias").normal(0.0, sigma, 3) if given is None else np.asarray(given)
        return np.asarray(noise_scale * (start + varying))

    def varying(name: str, walk: float, steady: float, tau_s: float) -> Array:
        if steady > 0:
            return steady * gauss_markov(streams(f"{name} gauss-markov").normal(0.0, 1.0, (n, 3)), dt / tau_s)
        return np.cumsum(streams(f"{name} walk").normal(0.0, walk * np.sqrt(dt), (n, 3)), axis=0)

    gyro = varying("gyro", noise.gyro_bias_walk_rps_rts, table.gyro_gm_rps, table.gyro_gm_s)
    accel = varying("accel", noise.accel_bias_walk_mps2_rts, table.accel_gm_mps2, table.accel_gm_s)
    return ImuRecord(
        bias("gyro", table.gyro_bias_rps, noise.gyro_bias_rps, gyro),
        bias("accel", table.accel_bias_mps2, noise.accel_bias_mps2, accel),
        noise_scale * streams("gyro scale").normal(0.0, 1.0, 3) * table.gyro_scale_ppm * 1e-6,
        noise_scale * streams("accel scale").normal(0.0, 1.0, 3) * table.accel_scale_ppm * 1e-6,
    )
