"""Attitude for vehicles without an IMU that carry two antennas: an IMU in name only, which says level and not turning.

Its noise is how the vehicle may move: white noise on acceleration, as that of the motion prior, and on the turn rate. The
antennas then tell the direction of the line between them. The turn about that line is the one that puts the apparent vertical
upright: right on average, and off by the acceleration over gravity while the vehicle accelerates for long.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from factorgraph.measurements import ImuStream, PositionStream
from factorgraph.problem import Antenna, ImuNoise, NavigationProblem, Vehicle
from factorgraph.types import Array

RATE_HZ = 10.0
TURN_RPS_RTHZ = 0.5  # white noise on the turn rate of cars, boats and people
TURN_RPS = 0.3  # typical turn rate, which a rate of zero leaves in the velocities of antennas beside the origin
BIAS = 1e-4
G_MPS2 = 9.81


def with_attitudes(problem: NavigationProblem) -> NavigationProblem:
    """The problem with such an IMU for every vehicle that needs one; the same object where none does."""
    names = {v.name for v in problem.vehicles if _needs_one(problem, v)}
    if not names:
        return problem
    vehicles = tuple(
        _turning(_with_imu(problem, v)) if v.name in names else _turning(v) if v.carrier in names else v for v in problem.vehicles
    )
    return replace(problem, vehicles=vehicles)


def _needs_one(problem: NavigationProblem, v: Vehicle) -> bool:
    if v.imu is not None or v.is_fixed or v.carrier is not None:
        return False
    levers = {p.lever_b for p in v.positions} | ({v.gnss.lever_b} if v.gnss is not None else set())
    return len(levers) > 1 or any(u.carrier == v.name for u in problem.vehicles)


def _with_imu(problem: NavigationProblem, v: Vehicle) -> Vehicle:
    times = [u.gnss.stream.t_s for u in problem.vehicles if u.gnss is not None and v.name in (u.name, u.carrier)]
    times += [p.t_s for p in v.positions] + [h.t_s for h in v.heights]
    first, last = min(t[0] for t in times if len(t)), max(t[-1] for t in times if len(t))
    t = np.arange(np.floor(first * RATE_HZ) - 1, np.ceil(last * RATE_HZ) + 2) / RATE_HZ
    imu = ImuStream(t, np.tile([0.0, 0.0, G_MPS2], (len(t), 1)), np.zeros((len(t), 3)), True)
    noise = ImuNoise(TURN_RPS_RTHZ, float(np.linalg.norm(v.motion.accel_mps2_rthz)) / np.sqrt(3), BIAS, BIAS, BIAS, BIAS)
    return replace(v, imu=imu, imu_noise=noise)


def _turning(v: Vehicle) -> Vehicle:
    """With velocities of its antennas as good as they are without a known turn rate."""
    return replace(
        v,
        gnss=None if v.gnss is None else _antenna(v.gnss),
        positions=tuple(_positions(p) for p in v.positions),
    )


def _antenna(antenna: Antenna) -> Antenna:
    sigma = float(_widened(antenna.noise.doppler_mps, antenna.lever_b))
    return replace(antenna, noise=replace(antenna.noise, doppler_mps=sigma))


def _positions(stream: PositionStream) -> PositionStream:
    if stream.sigma_mps is None:
        return stream
    return replace(stream, sigma_mps=_widened(stream.sigma_mps, stream.lever_b))


def _widened(sigma_mps: Array | float, lever_b: Sequence[float]) -> Array:
    return np.asarray(np.hypot(sigma_mps, TURN_RPS * np.linalg.norm(lever_b)))
