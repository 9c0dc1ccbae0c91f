"""Relative position and velocity of two points: vehicles' own points (body origin, base antenna), or carried antennas.

A pair of two antennas of one vehicle is the line between them: R (l_b - l_a), constant in the body. The rate that turns it is
taken as known.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from factorgraph.assembly.engine import Covariances
from factorgraph.assembly.variables import VehicleVariables
from factorgraph.attitude import matrix_from_quat, skew
from factorgraph.problem import Link, NavigationProblem, Vehicle
from factorgraph.sampling import interpolate
from factorgraph.types import Array


@dataclass(frozen=True, slots=True)
class PairEnd:
    """One end of a pair, a point of a vehicle."""

    vehicle: VehicleVariables
    lever_b: Array  # (3,) zeros: the vehicle's own point

    @property
    def has_lever(self) -> bool:
        return bool(np.any(self.lever_b)) and self.vehicle.mode == "imu"

    def motion(self) -> tuple[Array, Array]:
        """Position and velocity (K, 3) of the point."""
        v = self.vehicle
        if not self.has_lever:
            return v.r, v.v
        return v.r + v.R @ self.lever_b, v.v + np.einsum("kij,kj->ki", v.R, self._turning())

    def _turning(self) -> Array:
        v = self.vehicle
        return np.cross(v.body_rate(v.t_s, np.arange(len(v.t_s))), self.lever_b)

    def map(self) -> Array:
        """d(position, velocity) / d(pose or position, velocity columns), (K, 6, w)."""
        v = self.vehicle
        K = len(v.t_s)
        if v.mode == "fixed":
            return np.zeros((K, 6, 0))
        if v.mode == "motion":
            return np.tile(np.eye(6), (K, 1, 1))
        T = np.zeros((K, 6, 9))
        T[:, :3, 3:6], T[:, 3:, 6:] = v.R, np.eye(3)
        if self.has_lever:
            T[:, :3, :3] = -v.R @ skew(self.lever_b)
            T[:, 3:, :3] = -v.R @ skew(self._turning())
        return T

    def truth(self) -> tuple[Array, Array | None] | None:
        """True position and, where known, velocity (K, 3) at the state times, NaN beyond the truth; None without one."""
        v = self.vehicle
        if v.mode == "fixed":
            return v.r, v.v
        truth = v.vehicle.truth
        if truth is None or (self.has_lever and truth.q_nb is None):
            return None
        outside = ((v.t_s < truth.t_s[0] - 1e-6) | (v.t_s > truth.t_s[-1] + 1e-6))[:, None]
        r = truth.r_n
        if self.has_lever and truth.q_nb is not None:
            r = r + matrix_from_quat(truth.q_nb) @ self.lever_b
        at = np.where(outside, np.nan, interpolate(v.t_s, truth.t_s, r))
        if truth.v_n is None or self.has_lever:
            return at, None
        return at, np.where(outside, np.nan, interpolate(v.t_s, truth.t_s, truth.v_n))


def pair_ends(problem: NavigationProblem, vehicles: list[VehicleVariables], pair: Link) -> tuple[PairEnd, PairEnd]:
    """Reference and rover. Of two ends on one vehicle each is its antenna; else a vehicle with states is its own point."""
    named = {v.name: v for v in vehicles}
    a, b = problem.vehicle(pair.reference), problem.vehicle(pair.rover)
    one_body = (a.carrier or a.name) == (b.carrier or b.name)
    ends = [PairEnd(named[v.carrier or v.name], _lever(v, one_body)) for v in (a, b)]
    return ends[0], ends[1]


def _lever(v: Vehicle, is_antenna: bool) -> Array:
    if v.gnss is None or v.is_fixed or not (is_antenna or v.carrier is not None):
        return np.zeros(3)
    return np.asarray(v.gnss.lever_b, float)


def pair_covariance(problem: NavigationProblem, pair: tuple[PairEnd, PairEnd], cov: Covariances) -> Array:
    """Covariance (K, 6, 6) of rover relative to reference, position and velocity, east-north-up at the reference."""
    a, b = pair
    C = problem.frame.C_to_enu(a.motion()[0])
    CC = np.zeros((len(C), 6, 6))
    CC[:, :3, :3], CC[:, 3:, 3:] = C, C
    same = a.vehicle is b.vehicle
    bodies = [a.vehicle] if same else [a.vehicle, b.vehicle]
    T = b.map() - a.map() if same else np.concatenate([-a.map(), b.map()], axis=2)
    keys = [[key for v in bodies for key in v.keys(k)[:2]] for k in range(len(C))]
    CT = CC @ T
    return np.asarray(CT @ cov.joints(keys) @ np.swapaxes(CT, 1, 2))


def pair_truth(pair: tuple[PairEnd, PairEnd], C: Array) -> tuple[Array | None, Array | None]:
    """True baseline and relative velocity (K, 3) in the axes C (K, 3, 3) of n, None where unknown."""
    true = [end.truth() for end in pair]
    if true[0] is None or true[1] is None:
        return None, None
    (r_a, v_a), (r_b, v_b) = true[0], true[1]
    dv = None if v_a is None or v_b is None else np.einsum("kij,kj->ki", C, v_b - v_a)
    return np.einsum("kij,kj->ki", C, r_b - r_a), dv
