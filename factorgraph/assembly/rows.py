"""Rows and ends of blocks whose rows are independent: what every sensor but GNSS shares."""

from __future__ import annotations

import numpy as np

from factorgraph.assembly.blocks import Endpoint, Offset, Rows
from factorgraph.assembly.parameters import Parameter, Parameters
from factorgraph.assembly.variables import VehicleVariables
from factorgraph.measurements import Calibration
from factorgraph.models.differencing import CommonGroups
from factorgraph.problem import Vec3
from factorgraph.types import Array, BoolArray, IntArray


def plain_rows(kind: int, t: Array, sigma: Array, factor: IntArray, source: str, label: list[str], label_index: IntArray) -> Rows:
    """Rows of one kind without common clocks; `factor` (n,) labels the factor of each, in order."""
    nothing = np.full(len(t), np.nan)
    zeros = np.zeros(len(t), np.int64)
    return Rows(
        np.full(len(t), kind),
        t,
        sigma,
        CommonGroups.from_labels(factor),
        None,
        source,
        label,
        label_index,
        [""],
        zeros,
        nothing,
        nothing,
    )


def interval_rows(t_s: Array, d: int, source: str, label: str) -> Rows:
    """d whitened rows for each interval between times (K,), a factor each."""
    n = len(t_s) - 1
    factor = np.repeat(np.arange(n), d)
    return plain_rows(-1, np.repeat(t_s[1:], d), np.ones(d * n), factor, source, [label], np.zeros(d * n, np.int64))


def in_grid(t: Array, grid: Array, time_sigma_s: float = 0.0) -> BoolArray:
    """Times inside the grid, by a margin where a time offset may yet move them."""
    margin = 3 * time_sigma_s - 1e-6
    return np.asarray((t >= grid[0] + margin) & (t <= grid[-1] - margin))


def time_offset(parameter: Parameter | None) -> list[Offset]:
    """A time offset of a sensor: what its tags call t was taken at t - offset."""
    return [] if parameter is None else [Offset(parameter, -1.0)]


def sensor_end(
    end: VehicleVariables, t: Array, lever_b: Vec3, name: str, calibration: Calibration, parameters: Parameters
) -> Endpoint:
    """Where a sensor observes, with its lever arm and time offset where they are estimated."""
    lever = parameters.vector(f"{name} lever arm", "m", calibration.lever_m) if end.mode == "imu" else None
    offset = time_offset(parameters.scalar(f"{name} time offset", "s", calibration.time_s))
    return Endpoint(end, end.query(t, lever_b), lever, offset)
