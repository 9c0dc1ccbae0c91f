"""Rows and ends of blocks whose rows are independent: what every sensor but GNSS shares."""

from __future__ import annotations

import numpy as np

from factorgraph.graphs.blocks import Endpoint, Offset, Rows
from factorgraph.graphs.parameters import Parameter, Parameters
from factorgraph.graphs.variables import VehicleVariables
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
