"""Position fixes and heights with white noise."""

from __future__ import annotations

import numpy as np
from pydantic import Field, PositiveFloat

from factorgraph.errors import InputError
from factorgraph.measurements import Calibration, HeightStream, PositionStream
from factorgraph.problem import Vec3
from factorgraph.types import Array
from scenarios.flights.schema import NonNegative, Table
from scenarios.simulate.streams import Name, Streams
from scenarios.simulate.trajectory import Trajectory


class Silence(Table):
    """A stretch without fixes."""

    start_s: float
    end_s: float


class PositionTable(Table):
    """Position fixes of an antenna, with its velocity where `velocity_sigma_mps` is given."""

    name: Name = "position"
    rate_hz: PositiveFloat = 1.0
    offset_s: float = Field(default=0.0, ge=0)
    sigma_m: tuple[PositiveFloat, PositiveFloat, PositiveFloat] = (1.5, 1.5, 3.0)
    velocity_sigma_mps: tuple[PositiveFloat, PositiveFloat, PositiveFloat] | None = None
    lever_b: Vec3 = (0.0, 0.0, 0.0)
    outages: tuple[Silence, ...] = ()


class HeightTable(Table):
    """Heights of a point of the body above the local origin."""

    name: Name = "height"
    rate_hz: PositiveFloat = 10.0
    offset_s: float = Field(default=0.0, ge=0)
    sigma_m: PositiveFloat = 0.5
    lever_b: Vec3 = (0.0, 0.0, 0.0)
    bias_sigma_m: NonNegative = 0.0  # a barometer's, drawn from this and walking
    bias_walk_m_rts: NonNegative = 0.0

    @property
    def calibration(self) -> Calibration:
        return Calibration(bias=self.bias_sigma_m, bias_walk=self.bias_walk_m_rts)


def epochs(rate_hz: float, offset_s: float, duration_s: float) -> Array:
    """Times offset + k / rate up to the end of the flight. Raises InputError when there are none."""
    n = int(np.floor((duration_s - offset_s) * rate_hz + 1e-6)) + 1
    if n < 1:
        raise InputError(f"a sensor that starts at {offset_s:g} s measures nothing in a flight of {duration_s:g} s")
    return np.asarray(offset_s + np.arange(n) / rate_hz)


def positions(
    table: PositionTable, trajectory: Trajectory, duration_s: float, streams: Streams, noise_scale: float
) -> PositionStream:
    """Fixes of the whole flight."""
    t = epochs(table.rate_hz, table.offset_s, duration_s)
    r, v = trajectory.at(t).point(table.lever_b)
    sigma = np.tile(table.sigma_m, (len(t), 1))
    r = r + streams("noise").normal(0.0, 1.0, r.shape) * sigma * noise_scale
    heard = ~np.any([(t >= gap.start_s) & (t < gap.end_s) for gap in table.outages] or np.zeros((1, len(t)), bool), axis=0)
    if not np.any(heard):
        raise InputError(f"{table.name}: its outages leave no fix")
    if table.velocity_sigma_mps is None:
        return PositionStream(t[heard], r[heard], sigma[heard], table.lever_b, table.name)
    sigma_v = np.tile(table.velocity_sigma_mps, (len(t), 1))
    v = v + streams("velocity noise").normal(0.0, 1.0, v.shape) * sigma_v * noise_scale
    return PositionStream(t[heard], r[heard], sigma[heard], table.lever_b, table.name, v[heard], sigma_v[heard])


def heights(table: HeightTable, trajectory: Trajectory, duration_s: float, streams: Streams, noise_scale: float) -> HeightStream:
    """Heights of the whole flight."""
    t = epochs(table.rate_hz, table.offset_s, duration_s)
    r, _ = trajectory.at(t).point(table.lever_b)
    noise = streams("noise").normal(0.0, table.sigma_m, len(t)) * noise_scale
    walk = np.cumsum(streams("bias walk").normal(0.0, table.bias_walk_m_rts / np.sqrt(table.rate_hz), len(t))) * noise_scale
    bias = float(streams("bias").normal(0.0, 1.0)) * table.bias_sigma_m * noise_scale + walk
    sigma = np.full(len(t), table.sigma_m)
    return HeightStream(t, r[:, 2] + bias + noise, sigma, table.lever_b, table.name, table.calibration)
