"""One vehicle's own tightly coupled filter: inertial error states and a receiver clock, corrected by code and Doppler.

States: the 18 of `inertial`, receiver clock offset [m] and drift [m/s] of one constellation. With e the line of sight to
a satellite, a = r + C_nb l the antenna,

    P      - predicted = e . (dr + [C_nb l x] phi) + c (dt_u - its estimate)
    -lam D - predicted = e . dv                    + c (ddt_u - its estimate)

The inertial errors are estimate - truth and taken off; what the clock states hold is added to the clock. The drift may
return to zero, d ddt_u/dt = -beta ddt_u + w. Without Doppler, code alone.

As the reference of moving-base differences (the defaults) its position should be smooth rather than quick: the standard
deviations told to it are larger than the receiver's noise.

Source: spec aar_two_stage.md, sections 1 and 3 (tanker); spec ahrs_tdo.md, section 2.3 and erratum E12 (local filter; its
states are the same but for positions, here metres of n instead of latitude, longitude and height); Groves (2013),
sec. 14.3.
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
from factorgraph.problem import Elevation
from factorgraph.types import Array, BoolArray, IntArray

STATES = INERTIAL.extended(clock=1, drift=1)
CLOCK, DRIFT = STATES["clock"].start, STATES["drift"].start


@dataclass(frozen=True, slots=True)
class TightSettings:
    """Undifferenced standard deviations, sigma^2 = sigma0^2 (1 + 1 / sin^2 el) or flat, and the clock's behaviour."""

    code_m: float = 30.0
    doppler_mps: float = 0.005
    elevation: Elevation = "sine"
    use_doppler: bool = True
    clock_m: float = 1e5  # standard deviations at the start
    drift_mps: float = 100.0
    clock_walk: float = 0.1  # m per sqrt(s)
    drift_walk: float = 0.05  # m/s per sqrt(s)
    drift_beta_hz: float = 0.0  # the drift returns to zero at this rate

    def __post_init__(self) -> None:
        positive(self, "code_m", "doppler_mps", "clock_m", "drift_mps")
        not_negative(self, "clock_walk", "drift_walk", "drift_beta_hz")

    def sigmas(self, elevation_rad: Array) -> tuple[Array, Array]:
        """Standard deviations (m,) of code [m] and Doppler [m/s]."""
        scale = np.ones(len(elevation_rad))
        if self.elevation == "sine":
            scale = np.sqrt(2.0) * elevation_scale(elevation_rad)
        return self.code_m * scale, self.doppler_mps * scale


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
    sensors: Array  # (K, 9) estimated errors: gyro constant, gyro Markov [rad/s], accelerometer Markov [m/s^2], body axes
    clock: Array  # (K, 2) receiver clock [m] and its drift [m/s]
    P_all: Array  # (K, 20, 20) of all states; sensors and clock truth - estimate, unlike position, velocity, attitude


def point_start(
    receiver: Receiver, frame: LocalFrame, C_nb: Array, P_attitude: Array, position_m: float = 100.0, velocity_mps: float = 10.0
) -> InertialStart:
    """A start at the first epoch from the first single-point solution and an attitude (3, 3) with its covariance (3, 3).

    The standard deviations of position and velocity should be wide: the filter uses the observations behind that
    solution again. Raises InputError where no epoch has position and velocity.
    """
    point = receiver.point
    known = np.flatnonzero(np.isfinite(point.r_ecef[:, 0]) & np.isfinite(point.v_ecef[:, 0]))
    if not len(known):
        raise InputError(f"vehicle {receiver.vehicle.name}: no epoch has a position and a velocity to start from")
    v = frame.rotate_from_ecef(point.v_ecef[known[0]])
    late_s = receiver.antenna.stream.t_s[known[0]] - receiver.antenna.stream.t_s[0]
    r = frame.from_ecef(point.r_ecef[known[0]]) - C_nb @ np.asarray(receiver.lever_b, float) - late_s * v
    P = np.zeros((9, 9))
    P[POS, POS], P[VEL, VEL], P[ATT, ATT] = position_m**2 * np.eye(3), velocity_mps**2 * np.eye(3), P_attitude
    return InertialStart(r, v, C_nb, P)


def run(
    receiver: Receiver, frame: LocalFrame, start: InertialStart, model: ImuModel, settings: TightSettings | None = None
) -> TightTrack:
    """Filter one vehicle from the epoch of `start` to its last observation. Raises InputError without an IMU."""
    settings = settings or TightSettings()
    if receiver.vehicle.imu is None:
        raise InputError(f"vehicle {receiver.vehicle.name}: a tightly coupled filter needs an IMU")
    stream, prepared = receiver.antenna.stream, receiver.prepared
    usable = receiver.usable & np.isfinite(prepared.code_m)
    if settings.use_doppler:
        usable &= np.isfinite(prepared.rate_mps) & np.all(np.isfinite(prepared.sat_vel_n), axis=1)
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
            Phi[CLOCK, DRIFT], Phi[DRIFT, DRIFT] = _drift_over(dt, settings.drift_beta_hz)
            clock, drift = clock + Phi[CLOCK, DRIFT] * drift, Phi[DRIFT, DRIFT] * drift
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
            nu = prepared.code_m[rows] - rho - clock
            H = np.zeros((m, STATES.size))
            H[:, POS], H[:, ATT], H[:, CLOCK] = e, e @ skew(place - nav.r), 1.0
            sigma, sigma_rate = settings.sigmas(prepared.elevation_rad[rows])
            if settings.use_doppler:
                rate = np.einsum("ij,ij->i", e, prepared.sat_vel_n[rows] - speed)
                H_rate = np.zeros((m, STATES.size))
                H_rate[:, VEL], H_rate[:, DRIFT] = e, 1.0
                nu = np.concatenate([nu, prepared.rate_mps[rows] - rate - drift])
                H, sigma = np.vstack([H, H_rate]), np.concatenate([sigma, sigma_rate])
            dx, P, nis, prior = kalman.step(P, Phi, Q, nu, H, np.diag(sigma**2))
            nav.correct(dx)
            clock, drift = clock + dx[CLOCK], drift + dx[DRIFT]
            track.jump[k] = prior[:6, :6] - P[:6, :6]
            track.nis[k], track.n_rows[k] = nis, len(nu)
        track.r_n[k], track.v_n[k], track.C_nb[k], track.P[k] = nav.r, nav.v, nav.C, P[NAVIGATION, NAVIGATION]
        track.antenna_n[k], track.antenna_v_n[k] = nav.point(lever)
        track.sensors[k] = np.concatenate([nav.gyro_constant, nav.gyro_markov, nav.accel])
        track.clock[k], track.P_all[k] = (clock, drift), P
    return track


def _drift_over(dt: float, beta_hz: float) -> tuple[float, float]:
    """What a unit of drift has become after dt: clock offset and drift."""
    if beta_hz == 0:
        return dt, 1.0
    return float(-np.expm1(-beta_hz * dt)) / beta_hz, float(np.exp(-beta_hz * dt))


def _rows_by_epoch(epoch: IntArray, usable: BoolArray, n_epochs: int) -> list[IntArray]:
    rows = np.flatnonzero(usable)
    return np.split(rows, np.searchsorted(epoch[rows], np.arange(1, n_epochs)))


def _empty(times: Array) -> TightTrack:
    n = len(times)
    r, v, antenna, antenna_v = np.zeros((4, n, 3))
    matrices = (np.zeros((n, 3, 3)), np.zeros((n, 9, 9)), np.zeros((n, 6, 6)))
    extra = (np.zeros((n, 9)), np.zeros((n, 2)), np.zeros((n, STATES.size, STATES.size)))
    return TightTrack(times, r, v, *matrices, antenna, antenna_v, np.full(n, np.nan), np.zeros(n), *extra)
