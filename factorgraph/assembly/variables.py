"""Variables of a problem: every vehicle's pose, velocity and bias on one time grid, and points observed from them.

Keys: `x` pose (body to n), `v` velocity in n, `b` bias (accelerometer, gyroscope); a vehicle
without an IMU has `p` (position of its antenna in n) instead of `x` and no bias; a base station has no variables.
`a` are ambiguities in cycles, `s` range bias and scale.

A point observed at time t belongs to the latest state at or before it and is carried forward by preintegrated IMU:

    R_t = Exp(-w_ie dt) R_k dR,   v_t = v_k + (g - 2 w_ie x v_k) dt + R_k dv,
    r_t = r_k + v_k dt + (g - 2 w_ie x v_k) dt^2 / 2 + R_k dp,   a = r_t + R_t l,   v_a = v_t + R_t (w_nb x l)

Perturbation of a pose: R Exp(dtheta), r + R drho.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from factorgraph.assembly._point_kernels import carried_points
from factorgraph.assembly.keys import symbol
from factorgraph.assembly.parameters import Parameter
from factorgraph.attitude import exp_so3, right_jacobian, skew
from factorgraph.geodesy import LocalFrame, centrifugal_ecef
from factorgraph.grid import MERGE_S
from factorgraph.measurements import ImuStream
from factorgraph.models import preintegration
from factorgraph.models.preintegration import Increments
from factorgraph.problem import Vehicle
from factorgraph.types import Array, BoolArray, IntArray

Mode = Literal["imu", "motion", "fixed"]
NEAR_S = 5e-3  # closer to a state than this, constant velocity carries the point
_STRIDE = 10_000_000


def key(letter: str, vehicle: int, k: int) -> int:
    """Key of a vehicle's variable at grid time k."""
    return symbol(letter, vehicle * _STRIDE + k)


@dataclass(frozen=True, slots=True)
class Query:
    """Points of one vehicle at measurement times: state index, time since it, lever arm, increments since it."""

    k: IntArray  # (n,)
    dt_s: Array  # (n,)
    lever_b: Array  # (n, 3)
    increments: Increments | None  # None: constant velocity only

    @property
    def columns(self) -> int:
        return 15 if self.increments is not None else 9


@dataclass(frozen=True, slots=True)
class Point:
    """Observed points and their Jacobians to the local columns (pose 6 or position 3, velocity 3, bias 6)."""

    r_n: Array  # (n, 3)
    v_n: Array  # (n, 3)
    J_r: Array  # (n, 3, w)
    J_v: Array  # (n, 3, w)
    R: Array  # (n, 3, 3) attitude; unit matrices without one


@dataclass(frozen=True, slots=True)
class Trajectory:
    """The values of a vehicle's variables."""

    r: Array  # (K, 3)
    v: Array  # (K, 3)
    R: Array  # (K, 3, 3)
    bias: Array  # (K, 6) gyroscope, accelerometer


class VehicleVariables:
    """One vehicle on the grid: current trajectory, keys, and how points follow from it."""

    def __init__(self, index: int, vehicle: Vehicle, grid_s: Array, frame: LocalFrame, use_imu: bool = True) -> None:
        K = len(grid_s)
        self.index, self.name, self.vehicle, self.frame = index, vehicle.name, vehicle, frame
        self.mode: Mode = "fixed" if vehicle.is_fixed else "imu" if vehicle.imu is not None and use_imu else "motion"
        self.t_s = grid_s
        self.r = np.tile(np.asarray(vehicle.fixed_n, float), (K, 1)) if vehicle.fixed_n is not None else np.zeros((K, 3))
        self.v = np.zeros((K, 3))
        self.R = np.tile(np.eye(3), (K, 1, 1))
        # of the first state: mean C_nb, standard deviations about east, north, up
        self.attitude_prior = (np.eye(3), np.array([1.0, 1.0, 3.0]))
        self.bias = np.zeros((K, 6))  # gyroscope, accelerometer
        self.preintegrated_bias = np.zeros((K, 6))
        letters = {"imu": "xvb", "motion": "pv", "fixed": ""}[self.mode]
        self._keys = [tuple(key(letter, index, k) for letter in letters) for k in range(K)]
        self.key_table = np.array(self._keys, np.int64).reshape(K, len(letters))
        self.imu_offset: Parameter | None = None  # of the IMU's time tags, where it is estimated
        self.imu_applied_s = 0.0  # what of it the stream in use is free of
        self.gyro_scale: Parameter | None = None  # of the IMU, each axis, where they are estimated
        self.accel_scale: Parameter | None = None
        self.applied_scale = np.zeros(6)  # gyroscope, accelerometer: what of them the stream in use is free of
        self._imu = self.vehicle.imu
        self.gaps_s = preintegration.gaps(self.imu) if self.mode == "imu" else np.zeros((0, 2))

    @property
    def imu(self) -> ImuStream:
        assert self._imu is not None
        return self._imu

    @property
    def imu_scale(self) -> Array:
        """Current scale factors (6,) of gyroscope and accelerometer; a sensor shows 1 + scale times truth plus bias."""
        return np.concatenate([np.zeros(3) if p is None else p.value for p in (self.gyro_scale, self.accel_scale)])

    def apply_imu_calibration(self) -> None:
        """Take the current estimates of the IMU's time offset and scale factors out of its stream."""
        imu = self.vehicle.imu
        if imu is None or (self.imu_offset is None and self.gyro_scale is None and self.accel_scale is None):
            return
        self.imu_applied_s = 0.0 if self.imu_offset is None else float(self.imu_offset.value[0])
        self.applied_scale = self.imu_scale
        gyro, accel = 1 + self.applied_scale[:3], 1 + self.applied_scale[3:]
        self._imu = replace(imu, t_s=imu.t_s - self.imu_applied_s, w_b=imu.w_b / gyro, f_b=imu.f_b / accel)
        self.gaps_s = preintegration.gaps(self.imu)

    def keys(self, k: int) -> tuple[int, ...]:
        """Keys of state k in the order of the local columns."""
        return self._keys[k]

    @property
    def dims(self) -> tuple[int, ...]:
        return {"imu": (6, 3, 6), "motion": (3, 3), "fixed": ()}[self.mode]

    def query(self, t_s: Array, lever_b: Array | tuple[float, float, float], states: IntArray | None = None) -> Query:
        """Attach times (n,) to states; points within NEAR_S of a state, or of a vehicle without IMU, use its velocity.

        states (n,): other states than the latest before each time.
        """
        t_s = np.asarray(t_s, float)
        lever = np.broadcast_to(np.asarray(lever_b, float), (len(t_s), 3))
        if self.mode != "imu":  # nearest state: dt is small, or the vehicle does not move
            k = np.clip(np.searchsorted(self.t_s, t_s), 1, max(len(self.t_s) - 1, 1))
            k = np.minimum(
                np.where(t_s - self.t_s[k - 1] <= self.t_s[np.minimum(k, len(self.t_s) - 1)] - t_s, k - 1, k), len(self.t_s) - 1
            )
            return Query(k, t_s - self.t_s[k], lever, None)
        k = self._before(t_s) if states is None else states
        dt = t_s - self.t_s[k]
        if np.all(dt <= NEAR_S):
            return Query(k, dt, lever, None)
        return Query(k, dt, lever, self._increments(k, dt))

    def is_carried(self, t_s: Array) -> BoolArray:
        """At which times (n,) points follow from a state: with an IMU, where no sample is missing since that state."""
        k = self._before(t_s)
        return (t_s - self.t_s[k] <= MERGE_S) | ~preintegration.crossing(self.gaps_s, self.t_s[k], t_s)

    def _before(self, t_s: Array) -> IntArray:
        """Latest states at or before times (n,)."""
        return np.clip(np.searchsorted(self.t_s, t_s + NEAR_S, side="right") - 1, 0, len(self.t_s) - 1)

    def _increments(self, k: IntArray, dt: Array) -> Increments:
        order = np.lexsort((dt, k))
        start = self.t_s[k]
        inc = preintegration.integrate(
            self.imu, start[order], start[order] + np.maximum(dt[order], 0.0), self.preintegrated_bias[k[order]]
        )
        back = np.empty_like(order)
        back[order] = np.arange(len(order))
        return Increments(*(getattr(inc, name)[back] for name in Increments.__dataclass_fields__))

    def refresh(self, query: Query) -> Query:
        """The same query with increments at the current preintegration bias."""
        if query.increments is None:
            return query
        return Query(query.k, query.dt_s, query.lever_b, self._increments(query.k, query.dt_s))

    def body_rate(self, t_s: Array, k: IntArray) -> Array:
        """Angular rate of body relative to n (n, 3) at times, from the gyroscope less bias and Earth rate."""
        i = np.clip(np.searchsorted(self.imu.t_s, t_s), 0, len(self.imu.t_s) - 1)
        w_ie_b = np.einsum("nji,j->ni", self.R[k], self.frame.w_ie_n)
        return np.asarray(self.imu.w_b[i] - self.bias[k, :3] - w_ie_b)

    def gravity_terms(self, k: IntArray) -> Array:
        """g - 2 w_ie x v at states k (n, 3)."""
        return self.frame.gravity(self.r[k]) - 2 * np.cross(self.frame.w_ie_n, self.v[k])

    def points(self, q: Query, velocity: bool = True) -> Point:
        """Observed points at the current trajectory; without `velocity` v_n and J_v are left zero."""
        n = len(q.k)
        if self.mode == "fixed":
            nothing = np.zeros((n, 3, 0))
            return Point(self.r[q.k], np.zeros((n, 3)), nothing, nothing, self.R[q.k])
        dt = q.dt_s[:, None]
        eye = np.broadcast_to(np.eye(3), (n, 3, 3))
        if self.mode == "motion":
            J_r, J_v = np.zeros((n, 3, 6)), np.zeros((n, 3, 6))
            J_r[:, :, :3], J_r[:, :, 3:], J_v[:, :, 3:] = eye, eye * dt[..., None], eye
            return Point(self.r[q.k] + self.v[q.k] * dt, self.v[q.k], J_r, J_v, self.R[q.k])
        R, v = self.R[q.k], self.v[q.k]
        rate = self.body_rate(self.t_s[q.k] + q.dt_s, q.k)
        if q.increments is None:
            w_l = np.cross(rate, q.lever_b)
            J_r, J_v = np.zeros((n, 3, 9)), np.zeros((n, 3, 9))
            r = self.r[q.k] + v * dt + np.einsum("nij,nj->ni", R, q.lever_b + w_l * dt)
            J_r[:, :, :3], J_r[:, :, 3:6], J_r[:, :, 6:] = -R @ skew(q.lever_b), R, eye * dt[..., None]
            if velocity:
                J_v[:, :, :3], J_v[:, :, 6:] = -R @ skew(w_l), eye
            return Point(r, v + np.einsum("nij,nj->ni", R, w_l), J_r, J_v, R)
        inc = q.increments
        db = self.bias[q.k] - self.preintegrated_bias[q.k]
        out = (np.empty((n, 3)), np.zeros((n, 3)), np.zeros((n, 3, 15)), np.zeros((n, 3, 15)), np.empty((n, 3, 3)))
        carried_points(
            q.k,
            q.dt_s,
            np.ascontiguousarray(q.lever_b),
            np.ascontiguousarray(self.R),
            self.r,
            self.v,
            self.gravity_terms(q.k),
            rate,
            db,
            self.frame.w_ie_n,
            inc.dR,
            inc.dv,
            inc.dp,
            inc.dR_dbg,
            inc.dv_dbg,
            inc.dv_dba,
            inc.dp_dbg,
            inc.dp_dba,
            velocity,
            out,
        )
        return Point(*out)

    def frames(self, q: Query) -> tuple[Array, Array]:
        """Attitude C_nb (n, 3, 3) at a query's times, and its Jacobian (n, 3, w): R_t Exp(J dx) for local columns dx.

        For vehicles with an IMU.
        """
        n = len(q.k)
        rate = self.body_rate(self.t_s[q.k] + q.dt_s, q.k)
        if q.increments is None:
            J = np.zeros((n, 3, 9))
            J[:, :, :3] = np.eye(3)
            return self.R[q.k] @ exp_so3(rate * q.dt_s[:, None]), J
        db = self.bias[q.k] - self.preintegrated_bias[q.k]
        phi = np.einsum("nij,nj->ni", q.increments.dR_dbg, db[:, :3])
        dR = q.increments.dR @ exp_so3(phi + rate * np.minimum(q.dt_s, 0.0)[:, None])
        J = np.zeros((n, 3, 15))
        J[:, :, :3], J[:, :, 12:15] = np.swapaxes(dR, 1, 2), right_jacobian(phi) @ q.increments.dR_dbg
        return exp_so3(-self.frame.w_ie_n * np.maximum(q.dt_s, 0.0)[:, None]) @ self.R[q.k] @ dR, J

    def acceleration(self, q: Query, p: Point) -> Array:
        """Acceleration of the body in n (n, 3) at observed points, from the accelerometer; zeros without IMU."""
        if self.mode != "imu":
            return np.zeros((len(q.k), 3))
        i = np.clip(np.searchsorted(self.imu.t_s, self.t_s[q.k] + q.dt_s), 0, len(self.imu.t_s) - 1)
        f_b = self.imu.f_b[i] - self.bias[q.k, 3:]
        return np.asarray(np.einsum("nij,nj->ni", p.R, f_b) + self.gravity_terms(q.k))

    @property
    def trajectory(self) -> Trajectory:
        return Trajectory(self.r, self.v, self.R, self.bias)

    @trajectory.setter
    def trajectory(self, values: Trajectory) -> None:
        self.r, self.v, self.R, self.bias = values.r, values.v, values.R, values.bias

    def retract(self, step: Callable[[IntArray], Array], states: slice = slice(None)) -> None:
        """Move states by a step, which gives the components (n, d) of variables by their keys; arrays are replaced."""
        if self.mode == "fixed":
            return
        pose, velocity, *bias = (step(keys) for keys in self.key_table[states].T)
        r, v, R, b = (x.copy() for x in (self.r, self.v, self.R, self.bias))
        v[states] += velocity
        if self.mode == "motion":
            r[states] += pose
        else:
            r[states] += np.einsum("kij,kj->ki", R[states], pose[:, 3:])
            R[states] = R[states] @ exp_so3(pose[:, :3])
            b[states] += np.hstack([bias[0][:, 3:], bias[0][:, :3]])
        self.r, self.v, self.R, self.bias = r, v, R, b

    def origin_centrifugal(self) -> Array:
        """Centrifugal acceleration at the frame's origin (3,), which the Earth rate leaves out."""
        return self.frame.rotate_from_ecef(centrifugal_ecef(self.frame.origin_ecef))
