"""A solution between its states, up to IMU rate.

From the state k before, at its estimated bias, increments of the IMU (`factorgraph.models.preintegration`) carry the
vehicle to t = t_k + dt (`factorgraph.assembly.variables`):

    R_p = Exp(-w_ie dt) R_k dR,   v_p = v_k + (g - 2 w_ie x v_k) dt + R_k dv,
    r_p = r_k + v_k dt + (g - 2 w_ie x v_k) dt^2 / 2 + R_k dp

At the next state, T later, this misses by e_r, e_v and phi = Log(R_p' R_k+1). What is missing is spread over the
interval, with u = dt / T:

    r = r_p + c(dt),   v = v_p + dc/dt,   R = R_p Exp(u phi)

c is the cubic that is zero with zero slope at the start and e_r with slope e_v at the end. That is the mean of white
accelerometer and gyroscope noise given its integrals, and removes constant errors of both exactly to first order.
Position, velocity and attitude are continuous and equal the solution at its states, and v is the derivative of r.
Without an IMU, and between states that IMU samples are missing between, the same equations with R_p = R_k, v_p = v_k and
r_p = r_k + v_k dt are cubic Hermite interpolation, the mean of the white-noise-on-acceleration prior, and the shortest
rotation.

Covariances, biases and ambiguity status between states are those of the nearest earlier state.

Source: Barfoot (2017), sec. 3.4, for the interpolation that the prior implies.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from factorgraph.attitude import exp_so3, log_so3, matrix_from_quat, quat_from_matrix
from factorgraph.errors import InputError
from factorgraph.geodesy import LocalFrame
from factorgraph.measurements import ImuStream
from factorgraph.models import preintegration
from factorgraph.problem import NavigationProblem, Vec3
from factorgraph.solution import PairSolution, Solution, VehicleSolution
from factorgraph.types import Array, BoolArray, IntArray

Rate = float | Literal["imu"]  # Hz, or the times of the IMU
CHUNK = 32_768  # times at once, which bounds memory
RATE_STEP_S = 2e-3  # either side of a time, for how fast a lever arm turns


@dataclass(frozen=True, slots=True)
class Trajectory:
    """Motion of a vehicle at any times; scalar parts of the quaternions are not negative."""

    t_s: Array  # (n,)
    r_n: Array  # (n, 3) local frame
    v_n: Array  # (n, 3)
    q_nb: Array  # (n, 4) NaN without attitude


@dataclass(frozen=True, slots=True)
class PairTrajectory:
    """Rover relative to reference at any times, resolved east-north-up at the reference's position."""

    t_s: Array  # (n,)
    baseline_enu: Array  # (n, 3) rover - reference
    velocity_enu: Array  # (n, 3)


def interpolate(vehicle: VehicleSolution, imu: ImuStream | None, frame: LocalFrame, t_s: Array) -> Trajectory:
    """The vehicle's motion at times t_s (n,), in any order.

    `imu` is used where the solution has attitude and biases. Raises InputError (a ValueError) for times outside the
    solution.
    """
    t_s = np.asarray(t_s, float)
    _check_inside(vehicle.name, vehicle.t_s, t_s)
    if not len(t_s):
        return Trajectory(t_s, np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 4)))
    carrier = _Carrier(vehicle, imu, frame)
    missing = carrier.missing()
    r_n, v_n, q_nb = np.empty((len(t_s), 3)), np.empty((len(t_s), 3)), np.empty((len(t_s), 4))
    order = np.argsort(t_s, kind="stable")
    for first in range(0, len(order), CHUNK):
        rows = order[first : first + CHUNK]
        k = earlier_state(vehicle.t_s, t_s[rows])
        dt = t_s[rows] - vehicle.t_s[k]
        r, v, R = carrier.carried(k, dt)
        e_r, e_v, phi, T = (x[k] for x in missing)
        u, step = (dt / T)[:, None], T[:, None]
        r_n[rows] = r + u * u * ((3 - 2 * u) * e_r + (u - 1) * step * e_v)
        v_n[rows] = v + u * (6 * (1 - u) / step * e_r + (3 * u - 2) * e_v)
        q_nb[rows] = quat_from_matrix(R @ exp_so3(u * phi))
    return Trajectory(t_s, r_n, v_n, q_nb)


def interpolate_pair(
    reference: VehicleSolution,
    rover: VehicleSolution,
    reference_imu: ImuStream | None,
    rover_imu: ImuStream | None,
    frame: LocalFrame,
    t_s: Array,
    reference_lever_b: Vec3 = (0.0, 0.0, 0.0),
    rover_lever_b: Vec3 = (0.0, 0.0, 0.0),
) -> PairTrajectory:
    """Baseline and relative velocity at times t_s (n,), of points with lever arms from the vehicles' own.

    Raises InputError for times outside either solution.
    """
    t_s = np.asarray(t_s, float)
    r_a, v_a = _point(reference, reference_imu, frame, t_s, reference_lever_b)
    r_b, v_b = _point(rover, rover_imu, frame, t_s, rover_lever_b)
    C = frame.C_to_enu(r_a)
    return PairTrajectory(t_s, _rotated(C, r_b - r_a), _rotated(C, v_b - v_a))


def _point(vehicle: VehicleSolution, imu: ImuStream | None, frame: LocalFrame, t_s: Array, lever_b: Vec3) -> tuple[Array, Array]:
    """Position and velocity (n, 3) of a point of a vehicle."""
    at = interpolate(vehicle, imu, frame, t_s)
    if not any(lever_b) or not len(t_s):
        return at.r_n, at.v_n
    lever = np.asarray(lever_b, float)
    around = [np.clip(t_s + h, vehicle.t_s[0], vehicle.t_s[-1]) for h in (-RATE_STEP_S, RATE_STEP_S)]
    turned = [matrix_from_quat(interpolate(vehicle, imu, frame, t).q_nb) @ lever for t in around]
    about = (turned[1] - turned[0]) / (around[1] - around[0])[:, None]
    return at.r_n + matrix_from_quat(at.q_nb) @ lever, at.v_n + about


def resample(solution: Solution, problem: NavigationProblem, rate: Rate = "imu") -> Solution:
    """The solution with vehicles and pairs at a rate [Hz], or at the times of each vehicle's IMU.

    With a rate, times are multiples of 1 / rate since t0. At the rate of the IMU a pair follows its reference's, else its
    rover's, and what has no IMU keeps its states. Pairs follow from their vehicles; their truth, known at the states
    only, is left out. Every row holds a full covariance: 1.8 kB.
    Raises InputError for a rate that is not positive.
    """
    if rate != "imu" and not 0 < rate < np.inf:
        raise InputError(f"the rate of trajectories must be positive, got {rate} Hz")
    imus = {v.name: problem.vehicle(v.carrier or v.name).imu for v in problem.vehicles}
    vehicles = [
        _vehicle_at(v, imus.get(v.name), solution.frame, _times(v.t_s, rate, imus.get(v.name))) for v in solution.vehicles
    ]
    pairs = [_pair_at(solution, p, imus, rate) for p in solution.pairs]
    return replace(solution, vehicles=tuple(vehicles), pairs=tuple(pairs))


def earlier_state(state_s: Array, t_s: Array) -> IntArray:
    """Index (n,) of the last state at or before each time (n,)."""
    return np.asarray(np.searchsorted(state_s, t_s, side="right") - 1)


def _check_inside(name: str, state_s: Array, t_s: Array) -> None:
    if not len(t_s):
        return
    if not len(state_s):
        raise InputError(f"{name}: the solution has no states to interpolate between")
    low, high = float(np.min(t_s)), float(np.max(t_s))
    if not (state_s[0] <= low and high <= state_s[-1]):  # NaN included
        raise InputError(
            f"{name}: times from {low:g} s to {high:g} s are not within the solution, {state_s[0]:g} s to {state_s[-1]:g} s"
        )


class _Carrier:
    """States of a vehicle carried forward, by the IMU where it may."""

    def __init__(self, vehicle: VehicleSolution, imu: ImuStream | None, frame: LocalFrame) -> None:
        self.vehicle, self.imu, self.frame = vehicle, imu, frame
        self.R = matrix_from_quat(vehicle.q_nb)
        self.bias = np.hstack([vehicle.bias_gyro, vehicle.bias_accel])
        self.by_imu = self._by_imu()

    def _by_imu(self) -> BoolArray:
        """States (K,) that have attitude and biases, and a recording without gaps until the next state."""
        t_s, imu = self.vehicle.t_s, self.imu
        if imu is None or not len(imu.t_s):
            return np.zeros(len(t_s), bool)
        before, after = [-np.inf, imu.t_s[0] - preintegration.GAP_S], [imu.t_s[-1] + preintegration.GAP_S, np.inf]
        missing_s = np.vstack([before, preintegration.gaps(imu), after])
        estimated = np.isfinite(self.vehicle.q_nb).all(axis=1) & np.isfinite(self.bias).all(axis=1)
        return np.asarray(estimated & ~preintegration.crossing(missing_s, t_s, np.append(t_s[1:], t_s[-1:])))

    def carried(self, k: IntArray, dt_s: Array) -> tuple[Array, Array, Array]:
        """r_p, v_p (n, 3) and R_p (n, 3, 3): states k (n,), sorted, after dt_s (n,)."""
        r, v, R = self.vehicle.r_n[k] + self.vehicle.v_n[k] * dt_s[:, None], self.vehicle.v_n[k], self.R[k]
        i = np.flatnonzero(self.by_imu[k])
        if self.imu is None or not len(i):
            return r, v, R
        start, dt, R_k = self.vehicle.t_s[k[i]], dt_s[i, None], R[i]
        inc = preintegration.integrate(self.imu, start, start + dt_s[i], self.bias[k[i]])
        g = self.frame.gravity(self.vehicle.r_n[k[i]]) - 2 * np.cross(self.frame.w_ie_n, v[i])
        r[i] += 0.5 * g * dt**2 + _rotated(R_k, inc.dp)
        v[i] += g * dt + _rotated(R_k, inc.dv)
        R[i] = exp_so3(-self.frame.w_ie_n * dt) @ R_k @ inc.dR
        return r, v, R

    def missing(self) -> tuple[Array, Array, Array, Array]:
        """e_r, e_v, phi (K, 3) and T (K,) of the intervals after each state; nothing is missing after the last."""
        t_s = self.vehicle.t_s
        e_r, e_v, phi, T = (np.zeros((len(t_s), *shape)) for shape in ((3,), (3,), (3,), ()))
        T[:-1], T[-1] = np.diff(t_s), 1.0
        r, v, R = self.carried(np.arange(len(t_s) - 1), T[:-1])
        e_r[:-1], e_v[:-1] = self.vehicle.r_n[1:] - r, self.vehicle.v_n[1:] - v
        phi[:-1] = log_so3(np.swapaxes(R, 1, 2) @ self.R[1:])
        return e_r, e_v, phi, T


def _rotated(C: Array, x: Array) -> Array:
    """C x (n, 3) of rotations (n, 3, 3) and vectors (n, 3)."""
    return np.asarray(np.squeeze(C @ x[:, :, None], axis=2))


def _times(state_s: Array, rate: Rate, imu: ImuStream | None) -> Array:
    """Times within the states: multiples of 1 / rate, else those of the IMU, else the states'."""
    if not len(state_s):
        return state_s
    first, last = state_s[0], state_s[-1]
    if rate == "imu":
        if imu is None:
            return state_s
        return np.asarray(imu.t_s[(imu.t_s >= first) & (imu.t_s <= last)])
    # a state on a multiple counts although its time is rounded
    n = np.arange(np.ceil(first * rate - 1e-6), np.floor(last * rate + 1e-6) + 1)
    return np.clip(n / rate, first, last)


def _vehicle_at(vehicle: VehicleSolution, imu: ImuStream | None, frame: LocalFrame, t_s: Array) -> VehicleSolution:
    found, k = interpolate(vehicle, imu, frame, t_s), earlier_state(vehicle.t_s, t_s)
    return replace(
        vehicle,
        t_s=t_s,
        r_n=found.r_n,
        v_n=found.v_n,
        q_nb=found.q_nb,
        bias_gyro=vehicle.bias_gyro[k],
        bias_accel=vehicle.bias_accel[k],
        P=vehicle.P[k],
    )


def _pair_at(solution: Solution, pair: PairSolution, imus: dict[str, ImuStream | None], rate: Rate) -> PairSolution:
    a, b = imus.get(pair.reference), imus.get(pair.rover)
    t_s = _times(pair.t_s, rate, b if a is None else a)
    ends = solution.vehicle(pair.reference), solution.vehicle(pair.rover)
    found = interpolate_pair(*ends, a, b, solution.frame, t_s, pair.reference_lever_b, pair.rover_lever_b)
    k = earlier_state(pair.t_s, t_s)
    return replace(
        pair,
        t_s=t_s,
        baseline_enu=found.baseline_enu,
        velocity_enu=found.velocity_enu,
        P=pair.P[k],
        fix=pair.fix[k],
        ratio=pair.ratio[k],
        n_sat=pair.n_sat[k],
        truth_enu=None,
        truth_velocity_enu=None,
    )
