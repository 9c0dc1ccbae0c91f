"""Error states of an inertial navigator, and the navigator they correct.

n is the Earth-fixed tangent frame of the problem, so its rate against the Earth w_en is zero; the textbook equations of a
frame that travels along are kept by passing that rate. With delta = estimate - truth, C_est = (I - [phi x]) C_true and
errors b of what the sensors give after compensation (gyro: constant and Gauss-Markov part):

    d dr/dt  = -w_en x dr + dv
    d dv/dt  = -(2 w_ie + w_en) x dv - phi x f^n + C_nb b_a + Gamma dr
    d phi/dt = -(w_ie + w_en) x phi - C_nb (b_gc + b_gm)
    d b_gc/dt = 0,   d b_gm/dt = -b_gm / tau_g + w,   d b_a/dt = -b_a / tau_a + w

Gamma = g / R (3 u u' - I), u the vertical, is the change of gravity with position: (-g/R, -g/R, 2g/R) east, north, up.

Source: spec aar_two_stage.md, section 2.2, errata E3 and E6; spec common.md, section 2.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from factorgraph.attitude import exp_so3
from factorgraph.filters.discretise import discretise, gauss_markov_density
from factorgraph.filters.layout import Layout
from factorgraph.geodesy import LocalFrame
from factorgraph.measurements import ImuStream
from factorgraph.models.strapdown import propagate
from factorgraph.types import Array

INERTIAL = Layout(position=3, velocity=3, attitude=3, gyro_constant=3, gyro_markov=3, accel_markov=3)
POS, VEL, ATT, GYRO, GYRO_GM, ACCEL = (INERTIAL[name] for name in INERTIAL.names)


@dataclass(frozen=True, slots=True)
class InertialStart:
    """Position, velocity and attitude with their covariance, in that order; C_est = (I - [phi x]) C_true, phi in n."""

    r_n: Array  # (3,) [m]
    v_n: Array  # (3,) [m/s]
    C_nb: Array  # (3, 3)
    P: Array  # (9, 9)


@dataclass(frozen=True, slots=True)
class ImuModel:
    """How an IMU errs, for the filter: white-noise densities, a constant, Gauss-Markov parts with correlation times."""

    gyro_rps_rthz: float
    accel_mps2_rthz: float
    gyro_constant_rps: float  # standard deviation
    gyro_markov_rps: float
    gyro_markov_s: float
    accel_markov_mps2: float
    accel_markov_s: float

    @property
    def P(self) -> Array:
        """Covariance (9, 9) of the sensor states before anything is known of them."""
        sigma = np.repeat([self.gyro_constant_rps, self.gyro_markov_rps, self.accel_markov_mps2], 3)
        return np.diag(sigma**2)

    @property
    def density(self) -> Array:
        """Noise densities (18,) on the diagonal of the error states; those of the sensors' white noise are isotropic."""
        q = np.zeros(INERTIAL.size)
        q[VEL], q[ATT] = self.accel_mps2_rthz**2, self.gyro_rps_rthz**2
        q[GYRO_GM] = gauss_markov_density(self.gyro_markov_rps, self.gyro_markov_s)
        q[ACCEL] = gauss_markov_density(self.accel_markov_mps2, self.accel_markov_s)
        return q


@njit(cache=True)
def _put_cross(F: Array, row: int, column: int, v: Array, sign: float) -> None:
    """Add sign [v x] at (row, column)."""
    F[row, column + 1] -= sign * v[2]
    F[row, column + 2] += sign * v[1]
    F[row + 1, column] += sign * v[2]
    F[row + 1, column + 2] -= sign * v[0]
    F[row + 2, column] -= sign * v[1]
    F[row + 2, column + 1] += sign * v[0]


@njit(cache=True)
def fill_inertial(
    F: Array, C_nb: Array, f_n: Array, w_ie: Array, w_en: Array, up: Array, g_over_R: float, tau_g: float, tau_a: float
) -> None:
    """Write the 18 inertial error states' dynamics into the first rows and columns of F (n >= 18, zero before)."""
    for i in range(3):
        F[i, 3 + i] = 1.0
        F[12 + i, 12 + i] = -1.0 / tau_g
        F[15 + i, 15 + i] = -1.0 / tau_a
        for j in range(3):
            F[3 + i, j] = 3.0 * g_over_R * up[i] * up[j]
            F[3 + i, 15 + j] = C_nb[i, j]
            F[6 + i, 9 + j] = -C_nb[i, j]
            F[6 + i, 12 + j] = -C_nb[i, j]
        F[3 + i, i] -= g_over_R
    _put_cross(F, 0, 0, w_en, -1.0)
    _put_cross(F, 3, 3, 2.0 * w_ie + w_en, -1.0)
    _put_cross(F, 3, 6, f_n, 1.0)  # -phi x f = [f x] phi
    _put_cross(F, 6, 6, w_ie + w_en, -1.0)


@njit(cache=True)
def _transition(
    n: int, C_nb: Array, f_n: Array, w_ie: Array, up: Array, g_over_R: float, tau: Array, q: Array, dt: float
) -> tuple[Array, Array]:
    F = np.zeros((n, n))
    fill_inertial(F, C_nb, f_n, w_ie, np.zeros(3), up, g_over_R, tau[0], tau[1])
    return discretise(F, np.diag(q), dt)


class Navigator:
    """A strapdown navigator whose position, velocity, attitude and sensor errors a filter feeds back.

    Estimated sensor errors are taken off every sample. `advance` follows the IMU to a time, also between samples.
    """

    def __init__(self, imu: ImuStream, frame: LocalFrame, start: InertialStart, model: ImuModel, t_s: float) -> None:
        self.frame, self.model, self.t_s = frame, model, t_s
        self.r, self.v, self.C = start.r_n.copy(), start.v_n.copy(), start.C_nb.copy()
        self.gyro_constant, self.gyro_markov, self.accel, self.w = np.zeros((4, 3))
        self._t, self._f, self._w = imu.t_s, imu.f_b, imu.w_b
        self._tau = np.array([model.gyro_markov_s, model.accel_markov_s])

    def advance(self, t_s: float) -> tuple[Array, Array]:
        """Propagate to t_s and return the mean specific force in n (3,) and the mean attitude (3, 3) of the way there.

        The Gauss-Markov parts decay as the model says.
        """
        first = int(np.searchsorted(self._t, self.t_s + 1e-9))
        last = int(np.searchsorted(self._t, t_s + 1e-9))
        t = np.concatenate([[self.t_s], self._t[first:last]])
        rows = slice(max(first - 1, 0), last)
        f, w = self._f[rows], self._w[rows]
        if t[-1] < t_s - 1e-9 and last < len(self._t):  # the sample under way covers the rest
            t, f, w = np.append(t, t_s), np.vstack([f, self._f[last]]), np.vstack([w, self._w[last]])
        if len(f) < len(t):
            f, w = np.vstack([f[:1], f]), np.vstack([w[:1], w])
        r, v, C = propagate(self.frame, t, f - self.accel, w - self.gyro_constant - self.gyro_markov, self.r, self.v, self.C)
        dt = t[-1] - t[0]
        middle = C[len(C) // 2]
        f_n = middle @ (np.average(f[1:], axis=0, weights=np.diff(t)) - self.accel) if dt > 0 else self.C @ f[0]
        self.r, self.v, self.C, self.t_s = r[-1], v[-1], C[-1], float(t[-1])
        self.w = w[-1] - self.gyro_constant - self.gyro_markov
        decay = np.exp(-dt / self._tau)
        self.gyro_markov, self.accel = decay[0] * self.gyro_markov, decay[1] * self.accel
        return f_n, middle

    def transition(self, f_n: Array, C_nb: Array, q: Array, dt: float) -> tuple[Array, Array]:
        """Phi and Q (n, n) of the error states over dt; q (n,) densities, states beyond the 18 inertial ones are constant."""
        g = self.frame.gravity(self.r)
        size = float(np.linalg.norm(g))
        from_centre = float(np.linalg.norm(self.frame.to_ecef(self.r)))
        return _transition(len(q), C_nb, f_n, self.frame.w_ie_n, -g / size, size / from_centre, self._tau, q, dt)

    def point(self, lever_b: Array) -> tuple[Array, Array]:
        """Position and velocity (3,) of a point of the body."""
        turning = self.C @ np.cross(self.w, lever_b) - np.cross(self.frame.w_ie_n, self.C @ lever_b)
        return self.r + self.C @ lever_b, self.v + turning

    def correct(self, dx: Array) -> None:
        """Feed the estimated errors (18,) back; they are zero afterwards."""
        self.r = self.r - dx[POS]
        self.v = self.v - dx[VEL]
        self.C = exp_so3(dx[ATT]) @ self.C
        self.gyro_constant = self.gyro_constant + dx[GYRO]
        self.gyro_markov = self.gyro_markov + dx[GYRO_GM]
        self.accel = self.accel + dx[ACCEL]
