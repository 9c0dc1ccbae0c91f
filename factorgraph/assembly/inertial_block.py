"""IMU constraints between a vehicle's states: one block of all intervals, preintegrated at the current biases.

`models.imu_interval` has the equations, those of GTSAM's CombinedImuFactor. Gravity of every interval is gravitation at its
middle plus the centrifugal acceleration of the frame's origin; the Earth rate does the rest. An interval that IMU samples are
missing from keeps its factor, with noise that leaves the vehicle all but free. Scale factors of accelerometer and gyroscope
enter as parameters: samples are (1 + s) (truth + bias), axis by axis.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from factorgraph.assembly.blocks import Block
from factorgraph.assembly.parameters import Parameter, Parameters
from factorgraph.assembly.rows import interval_rows
from factorgraph.assembly.variables import VehicleVariables
from factorgraph.models.imu_interval import STATE, Intervals, States, WhiteNoise, evaluate, preintegrate
from factorgraph.models.preintegration import crossing, grouped_inputs
from factorgraph.models.robust import Loss
from factorgraph.types import Array, IntArray

GAP_GYRO, GAP_ACCEL = 0.3, 10.0  # rad/s and m/s^2 per sqrt(Hz)
INTEGRATION_SIGMA_M = 3e-4  # per sqrt(s): keeps the position pivots of the Cholesky elimination well conditioned


@dataclass(slots=True)
class ImuBlock(Block):
    """Intervals between neighbouring states of a vehicle, 15 rows each; rows and Jacobians are already whitened."""

    vehicle: VehicleVariables
    scales: tuple[Parameter, ...]
    kept: IntArray | slice  # columns in use
    intervals: Intervals = field(init=False)
    at_bias: Array = field(init=False)  # (K - 1, 6)
    gravitation_n: Array = field(init=False)  # (K - 1, 3)
    first: int = 0  # state at which the intervals begin, of a piece of the flight

    def __post_init__(self) -> None:
        Block.__post_init__(self)
        self.refresh()

    def keys(self, f: int) -> list[int]:
        k = self.first + f
        return [*self.vehicle.keys(k), *self.vehicle.keys(k + 1), *(p.key for p in self.scales)]

    def key_table(self) -> IntArray:
        n, table = len(self.at_bias), self.vehicle.key_table[self.first : self.first + len(self.at_bias) + 1]
        return np.hstack([table[:-1], table[1:], np.tile(np.array([p.key for p in self.scales], np.int64), (n, 1))])

    def widths(self) -> tuple[int, ...]:
        return (6, 3, 6, 6, 3, 6, *(3 for _ in self.scales))

    def refresh(self) -> None:
        """Preintegrate at the vehicle's preintegration bias and with the scale factors taken out of its stream."""
        v = self.vehicle
        self.at_bias = v.preintegrated_bias[:-1].copy()
        middle = v.r[:-1] + 0.5 * v.v[:-1] * np.diff(v.t_s)[:, None]
        self.gravitation_n = v.frame.gravitation(middle) + v.origin_centrifugal()
        inputs = grouped_inputs(v.imu, v.t_s[:-1], v.t_s[1:], self.at_bias)
        self.intervals = preintegrate(inputs, self.at_bias, self._noise(), v.applied_scale)

    def _noise(self) -> WhiteNoise:
        v, noise = self.vehicle, self.vehicle.vehicle.imu_noise
        missing = crossing(v.gaps_s, v.t_s[:-1], v.t_s[1:])
        return WhiteNoise(
            np.where(missing, GAP_GYRO, noise.gyro_rps_rthz),
            np.where(missing, GAP_ACCEL, noise.accel_mps2_rthz),
            noise.gyro_bias_walk_rps_rts,
            noise.accel_bias_walk_mps2_rts,
            INTEGRATION_SIGMA_M,
        )

    def predict(self) -> None:
        v = self.vehicle
        change = v.imu_scale - v.applied_scale if self.scales else None
        k = slice(self.first, self.first + len(self.at_bias) + 1)
        states = States(v.R[k], v.r[k], v.v[k])
        e, J = evaluate(self.intervals, states, v.bias[k], self.at_bias, self.gravitation_n, v.frame.w_ie_n, change)
        self.y = -e.ravel()
        self.J = J.reshape(self.n, -1)[:, self.kept]

    def reweight(self, losses: Mapping[str, Loss], afresh: bool = False) -> None:
        """Inertial constraints keep their weight."""

    def cost(self, losses: Mapping[str, Loss]) -> float:
        return 0.5 * float(self.y @ self.y)

    def whiten(self) -> None:
        self.white.e, self.white.Jw = -self.y, self.J


def imu_block(vehicle: VehicleVariables, parameters: Parameters) -> ImuBlock | None:
    """The IMU block of a vehicle with its scale factors where they are estimated; None where there is but one state."""
    n = len(vehicle.t_s) - 1
    if vehicle.mode != "imu" or n < 1:
        return None
    sigmas = vehicle.vehicle.imu_calibration
    accel = vehicle.accel_scale = parameters.vector(f"{vehicle.name}/accelerometer scale", "1", sigmas.accel_scale)
    gyro = vehicle.gyro_scale = parameters.vector(f"{vehicle.name}/gyroscope scale", "1", sigmas.gyro_scale)
    used = [p is not None for p in (accel, gyro)]
    kept: IntArray | slice = slice(None)
    if any(used) and not all(used):
        kept = np.concatenate([np.arange(2 * STATE), 2 * STATE + np.flatnonzero(np.repeat(used, 3))])
    rows = interval_rows(vehicle.t_s, 15, vehicle.name, "imu")
    return ImuBlock(rows, vehicle=vehicle, scales=tuple(p for p in (accel, gyro) if p is not None), kept=kept)
