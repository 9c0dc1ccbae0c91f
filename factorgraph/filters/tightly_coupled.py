"""One vehicle's own tightly coupled filter: inertial error states and a receiver clock, corrected by code and Doppler.

States: the 18 of `inertial`, receiver clock offset [m] and drift [m/s] of one constellation. With e the line of sight to
a satellite, a = r + C_nb l the antenna,

    P      - predicted = e . (dr + [C_nb l x] phi) + c (dt_u - its estimate)
    -lam D - predicted = e . dv                    + c (ddt_u - its estimate)

The inertial errors are estimate - truth and taken off; what the clock states hold is added to the clock.

Its position is the reference of moving-base differences, so it should be smooth rather than quick: the standard
deviations told to it are larger than the receiver's noise.

Source: spec aar_two_stage.md, sections 1 and 3 (tanker); Groves (2013), sec. 14.3.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from factorgraph.attitude import skew
from factorgraph.errors import InputError, not_negative, positive
from factorgraph.filters import kalman
from factorgraph.filters.inertial import ATT, INERTIAL, NAVIGATION, POS, SENSORS, VEL, ImuModel, InertialStart, Navigator
from factorgraph.geodesy import LocalFrame
from factorgraph.models.gnss import elevation_scale
from factorgraph.models.receivers import Receiver
from factorgraph.types import Array, BoolArray, IntArray

STATES = INERTIAL.extended(clock=1, drift=1)
CLOCK, DRIFT = STATES["clock"].start, STATES["drift"].start


@dataclass(frozen=True, slots=True)
class TightSettings:
    """Undifferenced standard deviations, sigma^2 = sigma0^2 (1 + 1 / sin^2 el), and the clock's behaviour."""

    code_m: float = 30.0
    doppler_mps: float = 0.005
    clock_m: float = 1e5  # standard deviations at the start
    drift_mps: float = 100.0
    clock_walk: float = 0.1  # m per sqrt(s)
    drift_walk: float = 0.05  # m/s per sqrt(s)

    def __post_init__(self) -> None:
        positive(self, "code_m", "doppler_mps", "clock_m", "drift_mps")
        not_negative(self, "clock_walk", "drift_walk")


@dataclass(frozen=True, slots=True)
class TightTrack:
    """The vehicle after each epoch's correction."""

    t_s: Array  # (K,) true times of reception
    r_n: Array  # (K, 3)
    v_n: Array  # (K, 3)
    C_nb: Array  # (K, 3, 3)
    P: Array  # (K, 9, 9) of position, velocity, attitude
    jump: Array  # (K, 6, 6) covariance of the correction of position and velocity at each epoch
    antenna_n: Array  # (K, 3)
    antenna_v_n: Array  # (K, 3)
    nis: Array  # (K,)
    n_rows: Array  # (K,)


def run(
    receiver: Receiver, frame: LocalFrame, start: InertialStart, model: ImuModel, settings: TightSettings | None = None
) -> TightTrack:
    """Filter one vehicle from the epoch of `start` to its last observation. Raises InputError without an IMU."""
    settings = settings or TightSettings()
    if receiver.vehicle.imu is None:
        raise InputError(f"vehicle {receiver.vehicle.name}: a tightly coupled filter needs an IMU")
    stream, prepared = receiver.antenna.stream, receiver.prepared
    usable = receiver.usable & np.isfinite(prepared.code_m) & np.isfinite(prepared.rate_mps)
    usable &= np.all(np.isfinite(prepared.sat_vel_n), axis=1)
    rows_of = _rows_by_epoch(stream.epoch, usable, len(stream.t_s))
    lever = np.asarray(receiver.antenna.lever_b, float)
    times = stream.t_s - receiver.clock_s
    P = np.zeros((STATES.size, STATES.size))
    P[NAVIGATION, NAVIGATION], P[SENSORS, SENSORS] = start.P, model.P
    P[CLOCK, CLOCK], P[DRIFT, DRIFT] = settings.clock_m**2, settings.drift_mps**2
    q = np.concatenate([model.density, [settings.clock_walk**2, settings.drift_walk**2]])
    nav = Navigator(receiver.vehicle.imu, frame, start, model, float(times[0]))
    clock, drift = 0.0, 0.0
    track = _empty(times)
    for k, t in enumerate(times):
        if t > nav.t_s:
            dt = t - nav.t_s
            f_n, middle = nav.advance(float(t))
            Phi, Q = nav.transition(f_n, middle, q, dt)
            Phi[CLOCK, DRIFT] = dt
            clock += drift * dt
        else:
            Phi, Q = np.eye(STATES.size), np.zeros((STATES.size, STATES.size))
        rows = rows_of[k]
        if not len(rows):
            P = kalman.predict(P, Phi, Q)
        else:
            place, speed = nav.point(lever)
            e = prepared.sat_n[rows] - place
            rho = np.linalg.norm(e, axis=1)
            e /= rho[:, None]
            m = len(rows)
            nu = np.concatenate([
                prepared.code_m[rows] - rho - clock,
                prepared.rate_mps[rows] - np.einsum("ij,ij->i", e, prepared.sat_vel_n[rows] - speed) - drift,
            ])  # fmt: skip
            H = np.zeros((2 * m, STATES.size))
            H[:m, POS], H[:m, ATT], H[:m, CLOCK] = e, e @ skew(place - nav.r), 1.0
            H[m:, VEL], H[m:, DRIFT] = e, 1.0
            scale = np.sqrt(2.0) * elevation_scale(prepared.elevation_rad[rows])
            sigma = np.concatenate([settings.code_m * scale, settings.doppler_mps * scale])
            dx, P, nis, prior = kalman.step(P, Phi, Q, nu, H, np.diag(sigma**2))
            nav.correct(dx)
            clock, drift = clock + dx[CLOCK], drift + dx[DRIFT]
            track.jump[k] = prior[:6, :6] - P[:6, :6]
            track.nis[k], track.n_rows[k] = nis, 2 * m
        track.r_n[k], track.v_n[k], track.C_nb[k], track.P[k] = nav.r, nav.v, nav.C, P[NAVIGATION, NAVIGATION]
        track.antenna_n[k], track.antenna_v_n[k] = nav.point(lever)
    return track


def _rows_by_epoch(epoch: IntArray, usable: BoolArray, n_epochs: int) -> list[IntArray]:
    rows = np.flatnonzero(usable)
    return np.split(rows, np.searchsorted(epoch[rows], np.arange(1, n_epochs)))


def _empty(times: Array) -> TightTrack:
    n = len(times)
    r, v, antenna, antenna_v = np.zeros((4, n, 3))
    matrices = (np.zeros((n, 3, 3)), np.zeros((n, 9, 9)), np.zeros((n, 6, 6)))
    return TightTrack(times, r, v, *matrices, antenna, antenna_v, np.full(n, np.nan), np.zeros(n))
