"""Priors of first states and of parameters, and the motion prior that connects the states of a vehicle without an IMU.

The prior of an attitude is that of its alignment, C_0 Log(C_0^T R) with standard deviations about east, north, up; positions
and velocities have weak ones about where they start, so that what nothing measures is not singular; biases have that of the
IMU's grade. The motion prior is white noise on acceleration (constant velocity in the mean), exact between states:

    r_1 - r_0 - v_0 dt ~ , v_1 - v_0 ~ N(0, q [dt^3/3 dt^2/2; dt^2/2 dt]).   Source: Barfoot (2017), sec. 3.4.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from factorgraph.assembly.blocks import Block
from factorgraph.assembly.parameters import Parameter, Parameters
from factorgraph.assembly.rows import interval_rows, plain_rows
from factorgraph.assembly.variables import VehicleVariables, key
from factorgraph.attitude import log_so3, right_jacobian_inverse
from factorgraph.types import Array

POSITION_M, VELOCITY_MPS = 1e3, 100.0  # of first states


@dataclass(slots=True)
class StatePrior(Block):
    """Of a vehicle's first state: attitude, position, velocity, accelerometer and gyroscope bias, or position and velocity."""

    vehicle: VehicleVariables
    r: Array = field(init=False)  # (3,)
    v: Array = field(init=False)

    def __post_init__(self) -> None:
        Block.__post_init__(self)
        self.refresh()

    def keys(self, f: int) -> list[int]:
        return list(self.vehicle.keys(0))

    def widths(self) -> tuple[int, ...]:
        return self.vehicle.dims

    def refresh(self) -> None:
        """Weak priors are to hold nothing back: they move along."""
        self.r, self.v = self.vehicle.r[0].copy(), self.vehicle.v[0].copy()

    def predict(self) -> None:
        v = self.vehicle
        moved = [v.r[0] - self.r, v.v[0] - self.v]
        if v.mode == "motion":
            self.y, self.J = -np.concatenate(moved), np.eye(6)
            return
        C, R = v.attitude_prior[0], v.R[0]
        turned = log_so3((C.T @ R)[None])
        self.y = -np.concatenate([C @ turned[0], *moved, v.bias[0, 3:], v.bias[0, :3]])
        self.J = np.eye(15)
        self.J[:3, :3], self.J[3:6, 3:6] = C @ right_jacobian_inverse(turned)[0], R


def state_prior(vehicle: VehicleVariables) -> StatePrior | None:
    """The prior of a vehicle's first state; None of a base station."""
    if vehicle.mode == "fixed":
        return None
    velocity = np.full(3, VELOCITY_MPS)
    if vehicle.mode == "motion":
        sigma = np.concatenate([np.full(3, POSITION_M), velocity])
    else:
        noise = vehicle.vehicle.imu_noise
        biases = np.repeat([noise.accel_bias_mps2, noise.gyro_bias_rps], 3)
        sigma = np.concatenate([vehicle.attitude_prior[1], np.full(3, POSITION_M), velocity, biases])
    n = len(sigma)
    zeros = np.zeros(n, np.int64)
    return StatePrior(plain_rows(-1, np.full(n, vehicle.t_s[0]), sigma, zeros, vehicle.name, ["start"], zeros), vehicle=vehicle)


@dataclass(slots=True)
class ParameterPrior(Block):
    """Of parameters that have one dimension d, d rows each."""

    of: Sequence[Parameter]

    def keys(self, f: int) -> list[int]:
        return [self.of[f].key]

    def widths(self) -> tuple[int, ...]:
        return (len(self.of[0].value),)

    def predict(self) -> None:
        self.y = np.concatenate([p.prior - p.value for p in self.of])
        self.J = np.tile(np.eye(self.widths()[0]), (len(self.of), 1))


def parameter_priors(parameters: Parameters) -> list[ParameterPrior]:
    """Priors of all parameters, a block for each dimension."""
    blocks = []
    for d in sorted({len(p.value) for p in parameters}):
        mine = [p for p in parameters if len(p.value) == d]
        zeros = np.zeros(d * len(mine), np.int64)
        factor, sigma = np.repeat(np.arange(len(mine)), d), np.concatenate([p.sigma for p in mine])
        blocks.append(ParameterPrior(plain_rows(-1, zeros.astype(float), sigma, factor, "parameters", ["prior"], zeros), of=mine))
    return blocks


@dataclass(slots=True)
class MotionBlock(Block):
    """Motion prior of a vehicle without IMU; rows are already whitened by `L`."""

    vehicle: VehicleVariables
    L: Array  # (K - 1, 6, 6)
    J0: Array  # (K - 1, 6, 12)
    first: int = 0  # state at which the intervals begin, of a piece of the flight

    def keys(self, f: int) -> list[int]:
        return [key(letter, self.vehicle.index, k) for k in (self.first + f, self.first + f + 1) for letter in ("p", "v")]

    def widths(self) -> tuple[int, ...]:
        return (3, 3, 3, 3)

    def predict(self) -> None:
        v = self.vehicle
        k = slice(self.first, self.first + len(self.L) + 1)
        r, vel = v.r[k], v.v[k]
        x = np.hstack([r[:-1], vel[:-1], r[1:], vel[1:]])
        self.y = -np.einsum("nij,njk,nk->ni", self.L, self.J0, x).ravel()
        self.J = (self.L @ self.J0).reshape(self.n, 12)


def motion_block(vehicle: VehicleVariables) -> MotionBlock:
    """The motion prior between all neighbouring states of a vehicle."""
    L, J = motion_prior_rows(vehicle)
    return MotionBlock(interval_rows(vehicle.t_s, 6, vehicle.name, "motion"), vehicle=vehicle, L=L, J0=J)


def motion_prior_rows(vehicle: VehicleVariables) -> tuple[Array, Array]:
    """Whitening (K - 1, 6, 6) and Jacobians (K - 1, 6, 12) of the motion prior, rows (position 3, velocity 3)."""
    dt = np.diff(vehicle.t_s)
    q = np.asarray(vehicle.vehicle.motion.accel_mps2_rthz) ** 2
    n = len(dt)
    J = np.zeros((n, 6, 12))
    eye = np.eye(3)
    J[:, :3, :3], J[:, :3, 3:6], J[:, :3, 6:9] = -eye, -eye * dt[:, None, None], eye
    J[:, 3:, 3:6], J[:, 3:, 9:] = -eye, eye
    Q = np.zeros((n, 6, 6))
    diagonal = np.diag(q)
    Q[:, :3, :3] = diagonal * (dt**3 / 3)[:, None, None]
    Q[:, :3, 3:] = Q[:, 3:, :3] = diagonal * (dt**2 / 2)[:, None, None]
    Q[:, 3:, 3:] = diagonal * dt[:, None, None]
    return np.linalg.inv(np.linalg.cholesky(Q)), J
