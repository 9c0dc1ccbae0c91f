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
slowly. White noise of density 2 sigma^2 tau spreads the velocity as a Gauss-Markov error of correlation time tau does, but only
over times longer than tau: within them it promises too little. `coloured` carries psi as states instead.

    states      v_1 r_1 ... v_M r_M | df_0 ... df_M         attitude-referenced, and psi_0 ... psi_M where coloured
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
from scipy.linalg import block_diag

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
    attitude_rad: tuple[float, float, float]  # steady standard deviations about east, north and up
    attitude_s: float  # correlation time of the attitude errors

    def __post_init__(self) -> None:
        positive(self, "markov_s", "attitude_s")
        not_negative(self, "white_mps2_rthz", "markov_mps2")
        if not min(self.attitude_rad) >= 0:
            raise InputError(f"AccelModel.attitude_rad must not be negative, got {self.attitude_rad}")


PERFECT = AccelModel(0.0, 0.0, 1.0, (0.0, 0.0, 0.0), 1.0)  # of a reference that stands on the ground


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
    """A vehicle over the intervals between K + 1 epochs: gained velocity and way, and 12 states (v, r, df, psi)."""

    dv: Array  # (K, 3)
    dr: Array  # (K, 3)
    Phi: Array  # (K, 12, 12)
    Q: Array  # (K, 12, 12)


@njit(cache=True)
def _sample(
    C: Array, f: Array, S: Array, coloured: bool, white: float, tau: float, gm: float, tau_psi: float, dt: float
) -> tuple[Array, Array]:
    """Transition and noise (12, 12) of one sample; S (3, 3) the attitudes' steady covariance in e."""
    Phi, Q = np.eye(12), np.zeros((12, 12))
    decay, decay_psi = np.exp(-dt / tau), np.exp(-dt / tau_psi)
    X = np.array([[0.0, -f[2], f[1]], [f[2], 0.0, -f[0]], [-f[1], f[0], 0.0]])
    q = np.zeros((3, 3)) if coloured else X @ S @ X.T * (2.0 * tau_psi)
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
            if coloured:
                Phi[i, 9 + j] = -X[i, j] * dt
                Phi[3 + i, 9 + j] = -0.5 * X[i, j] * dt * dt
                Q[9 + i, 9 + j] = S[i, j] * (1.0 - decay_psi * decay_psi)
        Phi[9 + i, 9 + i] = decay_psi
    return Phi, Q


@njit(cache=True)
def _integrate(
    edges: Array, f: Array, C: Array, S: Array, coloured: bool, white: float, tau: float, gm: float, tau_psi: float, t: Array
) -> tuple[Array, Array, Array, Array]:
    K, n = len(t) - 1, len(f)
    dv, dr = np.zeros((K, 3)), np.zeros((K, 3))
    Phi, Q = np.zeros((K, 12, 12)), np.zeros((K, 12, 12))
    s = max(np.searchsorted(edges, t[0], side="right") - 1, 0)
    for k in range(K):
        Phi[k] = np.eye(12)
        at = t[k]
        while at < t[k + 1]:
            while s < n - 1 and edges[s + 1] <= at:
                s += 1
            until = t[k + 1] if s == n - 1 else min(edges[s + 1], t[k + 1])
            dt = until - at
            for i in range(3):
                dr[k, i] += dv[k, i] * dt + 0.5 * f[s, i] * dt * dt
                dv[k, i] += f[s, i] * dt
            step, noise = _sample(C[s], f[s], S, coloured, white, tau, gm, tau_psi, dt)
            Phi[k] = step @ Phi[k]
            Q[k] = kalman.predict(Q[k], step, noise)
            at = until
    return dv, dr, Phi, Q


def integrate(mover: Mover, t_s: Array, coloured: bool = False) -> Increments:
    """A vehicle between epochs t_s (K + 1,). Raises InputError where its samples do not cover them."""
    if t_s[0] < mover.edges[0] - 1e-3 or t_s[-1] > mover.edges[-1] + 0.05:
        raise InputError(
            f"vehicle {mover.name}: its IMU and attitudes cover {mover.edges[0]:.3f} to {mover.edges[-1]:.3f} s, "
            f"the epochs {t_s[0]:.3f} to {t_s[-1]:.3f} s"
        )
    m = mover.model
    scales = (m.white_mps2_rthz, m.markov_s, m.markov_mps2, m.attitude_s)
    return Increments(*_integrate(mover.edges, mover.f_e, mover.C_eb, _steady(mover), coloured, *scales, t_s))


def _steady(mover: Mover) -> Array:
    """Covariance (3, 3) of an attitude error psi in Earth-fixed axes."""
    return np.asarray(mover.C_en.T @ np.diag(np.square(mover.model.attitude_rad)) @ mover.C_en)


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


def tilt(M: int, j: int) -> slice:
    """States of psi of vehicle j, the reference 0, where attitude errors are coloured."""
    return slice(9 * M + 3 + 3 * j, 9 * M + 6 + 3 * j)


class AttitudeReferenced:
    """Dead reckoning of all vehicles with their attitudes and accelerometers.

    reference_e (K + 1, 3): where the reference is, ECEF, for gravity; a hundred metres are near enough. `increments`: what
    `integrate` gave for the same movers, times and colour, to save time.
    """

    def __init__(
        self,
        movers: Sequence[Mover],
        t_s: Array,
        reference_e: Array,
        coloured: bool = False,
        increments: list[Increments] | None = None,
    ) -> None:
        if len(movers) < 2:
            raise InputError("a formation needs a reference and at least one follower")
        self.n_followers, self.coloured = len(movers) - 1, coloured
        self.size = 6 * self.n_followers + (6 if coloured else 3) * len(movers)
        self.movers, self.t_s, self.reference_e = tuple(movers), t_s, reference_e
        self.increments = increments or [integrate(mover, t_s, coloured) for mover in movers]
        self._gradient = _gravity_gradient(reference_e[len(reference_e) // 2])

    def start(self) -> Array:
        own = [m.model.markov_mps2**2 * np.eye(3) for m in self.movers]
        return np.asarray(block_diag(*own, *([_steady(m) for m in self.movers] if self.coloured else [])))

    def _own(self, j: int) -> list[int]:
        """States of a vehicle's own errors."""
        M = self.n_followers
        parts = [error(M, j), tilt(M, j)] if self.coloured else [error(M, j)]
        return [state for part in parts for state in range(part.start, part.stop)]

    def predict(self, k: int, x: Array) -> tuple[Array, Array, Array]:
        M, T = self.n_followers, float(self.t_s[k] - self.t_s[k - 1])
        Phi, Q = np.zeros((self.size, self.size)), np.zeros((self.size, self.size))
        pair = np.eye(6)
        pair[:3, :3] -= 2.0 * T * TURN
        pair[3:, :3] = T * np.eye(3) - T * T * TURN
        pair[:3, 3:] = T * self._gradient
        pair[3:, 3:] += 0.5 * T * T * self._gradient
        for j in range(M + 1):
            own, part = self._own(j), self.increments[j]
            errors = slice(6, 6 + len(own))
            Phi[np.ix_(own, own)], Q[np.ix_(own, own)] = part.Phi[k - 1][errors, errors], part.Q[k - 1][errors, errors]
            for i in range(M) if j == 0 else (j - 1,):  # the reference is in every difference
                mine, sign = slice(6 * i, 6 * i + 6), -1.0 if j == 0 else 1.0
                Phi[mine, own] = sign * part.Phi[k - 1][:6, errors]
                Q[mine, own] = sign * part.Q[k - 1][:6, errors]
                Q[own, mine] = Q[mine, own].T
                for other in range(M) if j == 0 else (i,):
                    Q[mine, 6 * other : 6 * other + 6] += part.Q[k - 1][:6, :6]
        for i in range(M):
            Phi[6 * i : 6 * i + 6, 6 * i : 6 * i + 6] = pair
        out = Phi @ x
        for i in range(M):  # what velocity and errors do not bring; gravity's difference at r is exact, not its gradient times r
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
