"""Position fixes and heights with white noise."""

from __future__ import annotations

import numpy as np
from pydantic import Field, PositiveFloat

from factorgraph.errors import InputError
from factorgraph.measurements import HeightStream, PositionStream
from factorgraph.problem import Vec3
from factorgraph.types import Array
from scenarios.flights.schema import Table
from scenarios.simulate.streams import Name, Streams
from scenarios.simulate.trajectory import Trajectory


class PositionTable(Table):
    """Position fixes of an antenna."""

    name: Name = "position"
    rate_hz: PositiveFloat = 1.0
    offset_s: float = Field(default=0.0, ge=0)
    sigma_m: tuple[PositiveFloat, PositiveFloat, PositiveFloat] = (1.5, 1.5, 3.0)
    lever_b: Vec3 = (0.0, 0.0, 0.0)


class HeightTable(Table):
    """Heights of a point of the body above the local origin."""

    name: Name = "height"
    rate_hz: PositiveFloat = 10.0
    offset_s: float = Field(default=0.0, ge=0)
    sigma_m: PositiveFloat = 0.5
    lever_b: Vec3 = (0.0, 0.0, 0.0)


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
    r, _ = trajectory.at(t).point(table.lever_b)
    sigma = np.tile(table.sigma_m, (len(t), 1))
    noise = streams("noise").normal(0.0, 1.0, r.shape) * sigma * noise_scale
    return PositionStream(t, r + noise, sigma, table.lever_b, table.name)


def heights(table: HeightTable, trajectory: Trajectory, duration_s: float, streams: Streams, noise_scale: float) -> HeightStream:
    """Heights of the whole flight."""
    t = epochs(table.rate_hz, table.offset_s, duration_s)
    r, _ = trajectory.at(t).point(table.lever_b)
    noise = streams("noise").normal(0.0, table.sigma_m, len(t)) * noise_scale
    return HeightStream(t, r[:, 2] + noise, np.full(len(t), table.sigma_m), table.lever_b, table.name)
