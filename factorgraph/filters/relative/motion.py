"""How a formation moves: attitude-referenced dead reckoning, and the models that know nothing but smoothness.

Vehicle 0 is the reference, r_i = place of follower i less that of the reference, v_i its derivative in Earth-fixed axes e. With
specific forces f measured in the body, attitudes C and delta_f = true - measured (the sign of the source),

    dv_i/dt = C_i (f_i + df_i) - C_0 (f_0 + df_0) + g_i - g_0 - 2 w_ie x v_i
    dr_i/dt = v_i,      d df_j/dt = -df_j / T_a + w

Every vehicle is integrated for itself from epoch to epoch (velocity and position gained, their sensitivity to df, noise), at
the rate of its IMU; a pair of them is a difference, so that N vehicles cost N integrations. Coriolis acceleration enters through
the way made, which integrates it exactly; gravity differs by its value at the start of the interval and by its gradient
g / R (3 u u' - I) along the way, u the vertical.

Attitude errors psi, C_true = (I + [psi x]) C, push the velocity by psi x f. The source takes them for white; attitude systems err
slowly, and white noise of density 2 sigma^2 tau spreads the velocity as a Gauss-Markov error of correlation time tau does.

    states      v_1 r_1 ... v_M r_M | df_0 ... df_M         attitude-referenced
                v_1 r_1 ... v_M r_M | a_1 ... a_M           constant acceleration, walking
                v_1 r_1 ... v_M r_M                         constant velocity, walking

Source: Lu et al. (2024), eqs. 8 to 12 and 25 to 31; spec ahrs_tdo.md, section 2.2, errata E2 to E6, E16 and E29.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np
from numba import njit

from factorgraph.attitude import skew
from factorgraph.errors import InputError, not_negative, positive
from factorgraph.filters import kalman
from factorgraph.filters.motion import constant_acceleration
from factorgraph.geodesy import OMEGA_E_RPS, centrifugal_ecef, gravitation_ecef
from factorgraph.types import Array

EARTH_RATE = np.array([0.0, 0.0, OMEGA_E_RPS])  # ECEF
TURN = skew(EARTH_RATE)


@dataclass(frozen=True, slots=True)
class AccelModel:
    """How accelerometers and attitudes err, for the filter."""

    white_mps2_rthz: float
    markov_mps2: float  # steady standard deviation of df
    markov_s: float
    attitude_rad_rthz: tuple[float, float, float]  # errors as white noise about east, north, up: sigma sqrt(2 tau)

    def __post_init__(self) -> None:
        positive(self, "markov_s")
        not_negative(self, "white_mps2_rthz", "markov_mps2")
        if not min(self.attitude_rad_rthz) >= 0:
            raise InputError(f"AccelModel.attitude_rad_rthz must not be negative, got {self.attitude_rad_rthz}")


PERFECT = AccelModel(0.0, 0.0, 1.0, (0.0, 0.0, 0.0))  # of a reference that stands on the ground


@dataclass(frozen=True, slots=True)
class Mover:
    """What is known of a vehicle's own motion: sample k holds from edges[k] to edges[k + 1]."""

    name: str
    edges: Array  # (n + 1,) [s]
    f_e: Array  # (n, 3) measured specific force in Earth-fixed axes, as measured
    C_eb: Array  # (n, 3, 3) attitude at the middle of each sample
    model: AccelModel
    C_en: Array  # (3, 3) level axes in which the attitude errors are told: v_n = C_en v_e

    def __post_init__(self) -> None:
        if not (np.all(np.isfinite(self.f_e)) and np.all(np.isfinite(self.C_eb))):
            raise InputError(f"vehicle {self.name}: specific force and attitude must be finite at every sample")


@dataclass(frozen=True, slots=True)
class Increments:
    """A vehicle over the intervals between K + 1 epochs: gained velocity and way, and 9 states (v, r, df)."""

    dv: Array  # (K, 3)
    dr: Array  # (K, 3)
    Phi: Array  # (K, 9, 9)
    Q: Array  # (K, 9, 9)


@njit(cache=True)
def _sample(C: Array, f: Array, S: Array, white: float, tau: float, gm: float, dt: float) -> tuple[Array, Array]:
    """Transition and noise (9, 9) of one sample; S (3, 3) the attitudes' density in e."""
    Phi, Q = np.eye(9), np.zeros((9, 9))
    decay = np.exp(-dt / tau)
    X = np.array([[0.0, -f[2], f[1]], [f[2], 0.0, -f[0]], [-f[1], f[0], 0.0]])
    q = X @ S @ X.T
    for i in range(3):
        q[i, i] += white * white
        Phi[3 + i, i] = dt
        Phi[6 + i, 6 + i] = decay
        Q[6 + i, 6 + i] = gm * gm * (1.0 - decay * decay)
        for j in range(3):
            Phi[i, 6 + j] = C[i, j] * dt
            Phi[3 + i, 6 + j] = 0.5 * C[i, j] * dt * dt
    for i in range(3):
        for j in range(3):
            Q[i, j] = q[i, j] * dt
            Q[3 + i, j] = Q[i, 3 + j] = 0.5 * q[i, j] * dt * dt
            Q[3 + i, 3 + j] = q[i, j] * dt * dt * dt / 3.0
    return Phi, Q


@njit(cache=True)
def _integrate(
    edges: Array, f: Array, C: Array, S: Array, white: float, tau: float, gm: float, t: Array
) -> tuple[Array, Array, Array, Array]:
    K, n = len(t) - 1, len(f)
    dv, dr = np.zeros((K, 3)), np.zeros((K, 3))
    Phi, Q = np.zeros((K, 9, 9)), np.zeros((K, 9, 9))
    s = max(np.searchsorted(edges, t[0], side="right") - 1, 0)
    for k in range(K):
        Phi[k] = np.eye(9)
        at = t[k]
        while at < t[k + 1]:
            while s < n - 1 and edges[s + 1] <= at:
                s += 1
            until = t[k + 1] if s == n - 1 else min(edges[s + 1], t[k + 1])
            dt = until - at
            for i in range(3):
                dr[k, i] += dv[k, i] * dt + 0.5 * f[s, i] * dt * dt
                dv[k, i] += f[s, i] * dt
            step, noise = _sample(C[s], f[s], S, white, tau, gm, dt)
            Phi[k] = step @ Phi[k]
            Q[k] = kalman.predict(Q[k], step, noise)
            at = until
    return dv, dr, Phi, Q


def integrate(mover: Mover, t_s: Array) -> Increments:
    """A vehicle between epochs t_s (K + 1,). Raises InputError where its samples do not cover them."""
    if t_s[0] < mover.edges[0] - 1e-3 or t_s[-1] > mover.edges[-1] + 0.05:
        raise InputError(
            f"vehicle {mover.name}: its IMU and attitudes cover {mover.edges[0]:.3f} to {mover.edges[-1]:.3f} s, "
            f"the epochs {t_s[0]:.3f} to {t_s[-1]:.3f} s"
        )
    m = mover.model
    S = mover.C_en.T @ np.diag(np.square(m.attitude_rad_rthz)) @ mover.C_en
    return Increments(*_integrate(mover.edges, mover.f_e, mover.C_eb, S, m.white_mps2_rthz, m.markov_s, m.markov_mps2, t_s))


class Motion(Protocol):
    """Prediction of a formation's states from epoch k - 1 to epoch k."""

    n_followers: int
    size: int

    def predict(self, k: int, x: Array) -> tuple[Array, Array, Array]:
        """The states x (size,) carried to epoch k, with transition and noise (size, size)."""
        ...

    def start(self) -> Array:
        """Covariance (size - 6 M, size - 6 M) of what is beside velocities and positions at the first epoch."""
        ...


def velocity(i: int) -> slice:
    """States of follower i's velocity, i from 0."""
    return slice(6 * i, 6 * i + 3)


def position(i: int) -> slice:
    """States of follower i's position, i from 0."""
    return slice(6 * i + 3, 6 * i + 6)


def error(M: int, j: int) -> slice:
    """States of df of vehicle j, the reference 0, in a formation of M followers."""
    return slice(6 * M + 3 * j, 6 * M + 3 * j + 3)


class AttitudeReferenced:
    """Dead reckoning of all vehicles with their attitudes and accelerometers.

    reference_e (K + 1, 3): where the reference is, ECEF, for gravity; a hundred metres are near enough. `increments`: what
    `integrate` gave for the same movers and times, to save time.
    """

    def __init__(
        self, movers: Sequence[Mover], t_s: Array, reference_e: Array, increments: Sequence[Increments] | None = None
    ) -> None:
        if len(movers) < 2:
            raise InputError("a formation needs a reference and at least one follower")
        self.n_followers = len(movers) - 1
        self.size = 6 * self.n_followers + 3 * len(movers)
        self.movers, self.t_s, self.reference_e = tuple(movers), t_s, reference_e
        self.increments = increments or [integrate(mover, t_s) for mover in movers]
        self._gradient = _gravity_gradient(reference_e[len(reference_e) // 2])

    def start(self) -> Array:
        return np.diag(np.repeat([m.model.markov_mps2**2 for m in self.movers], 3))

    def predict(self, k: int, x: Array) -> tuple[Array, Array, Array]:
        M, T = self.n_followers, float(self.t_s[k] - self.t_s[k - 1])
        Phi, Q = np.zeros((self.size, self.size)), np.zeros((self.size, self.size))
        own = [(part.Phi[k - 1], part.Q[k - 1]) for part in self.increments]
        gradient = self._gradient
        pair = np.eye(6)
        pair[:3, :3] -= 2.0 * T * TURN
        pair[3:, :3] = T * np.eye(3) - T * T * TURN
        pair[:3, 3:] = T * gradient
        pair[3:, 3:] += 0.5 * T * T * gradient
        for i in range(M):
            mine = slice(6 * i, 6 * i + 6)
            Phi[mine, mine] = pair
            Phi[mine, error(M, 0)], Phi[mine, error(M, i + 1)] = -own[0][0][:6, 6:], own[i + 1][0][:6, 6:]
            Q[mine, error(M, 0)], Q[mine, error(M, i + 1)] = -own[0][1][:6, 6:], own[i + 1][1][:6, 6:]
            Q[error(M, 0), mine], Q[error(M, i + 1), mine] = Q[mine, error(M, 0)].T, Q[mine, error(M, i + 1)].T
            for j in range(M):
                Q[mine, 6 * j : 6 * j + 6] = own[0][1][:6, :6] + (own[i + 1][1][:6, :6] if i == j else 0.0)
        for j in range(M + 1):
            Phi[error(M, j), error(M, j)], Q[error(M, j), error(M, j)] = own[j][0][6:, 6:], own[j][1][6:, 6:]
        out = Phi @ x
        for i in range(M):  # what velocity and df do not bring; gravity's difference at r is exact, not its gradient times r
            dv, dr = self._gained(k - 1, i + 1, x[position(i)], T)
            out[velocity(i)] += dv
            out[position(i)] += dr
        return out, Phi, Q

    def _gained(self, k: int, vehicle: int, r: Array, T: float) -> tuple[Array, Array]:
        """Velocity and way gained against the reference in interval k, beside what velocity and df bring."""
        a, b, place = self.increments[0], self.increments[vehicle], self.reference_e[k]
        ends = _gravity(np.array([place, place + r]))
        pull = ends[1] - ends[0] - self._gradient @ r
        dr = b.dr[k] - a.dr[k] + 0.5 * pull * T * T
        dv = b.dv[k] - a.dv[k] + pull * T
        turned = TURN @ dr
        return dv - 2.0 * turned, dr - (2.0 * T / 3.0) * turned


def _gravity(r_e: Array) -> Array:
    return gravitation_ecef(r_e) + centrifugal_ecef(r_e)


def _gravity_gradient(r_e: Array) -> Array:
    """Change (3, 3) of gravity with position, of a sphere."""
    R = float(np.linalg.norm(r_e))
    u = r_e / R
    return np.asarray(float(np.linalg.norm(_gravity(r_e))) / R * (3.0 * np.outer(u, u) - np.eye(3)))


class Smooth:
    """Constant velocity or acceleration of each follower against the reference, walking.

    walk: of the velocity [m/s per sqrt(s)] or of the acceleration [m/s^2 per sqrt(s)]. Followers share half of the noise, the
    reference's. Source: spec common.md M10, ahrs_tdo.md, section 2.8.
    """

    def __init__(self, kind: Literal["velocity", "acceleration"], n_followers: int, t_s: Array, walk: float) -> None:
        if not walk > 0:
            raise InputError(f"the walk of a constant {kind} must be positive, got {walk}")
        self.kind, self.n_followers, self.t_s, self.walk = kind, n_followers, t_s, walk
        self.size = n_followers * (9 if kind == "acceleration" else 6)

    def start(self) -> Array:
        n = self.size - 6 * self.n_followers
        return np.eye(n)  # (1 m/s^2)^2: manoeuvres are of this order

    def predict(self, k: int, x: Array) -> tuple[Array, Array, Array]:
        M, dt = self.n_followers, float(self.t_s[k] - self.t_s[k - 1])
        own_Phi, own_Q = (
            _walking_velocity(dt, self.walk) if self.kind == "velocity" else constant_acceleration(dt, self.walk, True)
        )
        Phi, Q = np.zeros((self.size, self.size)), np.zeros((self.size, self.size))
        for i in range(M):
            rows = self._states(i)
            Phi[np.ix_(rows, rows)] = own_Phi
            for j in range(M):
                Q[np.ix_(rows, self._states(j))] = own_Q if i == j else 0.5 * own_Q
        return Phi @ x, Phi, Q

    def _states(self, i: int) -> list[int]:
        """States of follower i: position, velocity, acceleration."""
        r, v = position(i), velocity(i)
        states = [*range(r.start, r.stop), *range(v.start, v.stop)]
        if self.kind == "acceleration":
            a = 6 * self.n_followers + 3 * i
            states += [a, a + 1, a + 2]
        return states


def _walking_velocity(dt: float, walk: float) -> tuple[Array, Array]:
    """Transition and noise (6, 6) of position and velocity."""
    one, q = np.eye(3), walk * walk
    Phi = np.block([[one, dt * one], [0.0 * one, one]])
    return Phi, q * np.block([[dt**3 / 3 * one, dt**2 / 2 * one], [dt**2 / 2 * one, dt * one]])
