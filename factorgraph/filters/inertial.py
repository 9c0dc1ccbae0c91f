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

from factorgraph.attitude import quat_from_matrix
from factorgraph.errors import InputError, not_negative, positive
from factorgraph.filters.discretise import discretise, gauss_markov_density
from factorgraph.filters.layout import Layout
from factorgraph.geodesy import LocalFrame
from factorgraph.measurements import ImuStream
from factorgraph.models.preintegration import sample_means
from factorgraph.models.strapdown import gravity_into, propagate_into, quat_exp, quat_mul
from factorgraph.types import Array

LONGEST_GAP_S = 1.0  # of an IMU that a filter bridges with the mean of the samples around
LATE_S = 0.011  # an epoch after the last sample: one interval at 100 Hz
INERTIAL = Layout(position=3, velocity=3, attitude=3, gyro_constant=3, gyro_markov=3, accel_markov=3)
POS, VEL, ATT, GYRO, GYRO_GM, ACCEL = (INERTIAL[name] for name in INERTIAL.names)
NAVIGATION, SENSORS = slice(POS.start, ATT.stop), slice(GYRO.start, ACCEL.stop)
_R, _V, _A, _G, _GM, _B = (INERTIAL[name].start for name in INERTIAL.names)  # for kernels, which freeze them


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

    def __post_init__(self) -> None:
        positive(self, "gyro_markov_s", "accel_markov_s")
        not_negative(self, *(name for name in self.__slots__ if not name.endswith("_s")))

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
        F[_R + i, _V + i] = 1.0
        F[_GM + i, _GM + i] = -1.0 / tau_g
        F[_B + i, _B + i] = -1.0 / tau_a
        for j in range(3):
            F[_V + i, _R + j] = 3.0 * g_over_R * up[i] * up[j]
            F[_V + i, _B + j] = C_nb[i, j]
            F[_A + i, _G + j] = -C_nb[i, j]
            F[_A + i, _GM + j] = -C_nb[i, j]
        F[_V + i, _R + i] -= g_over_R
    _put_cross(F, _R, _R, w_en, -1.0)
    _put_cross(F, _V, _V, 2.0 * w_ie + w_en, -1.0)
    _put_cross(F, _V, _A, f_n, 1.0)  # -phi x f = [f x] phi
    _put_cross(F, _A, _A, w_ie + w_en, -1.0)


@njit(cache=True)
def _matrix(q: Array) -> Array:
    """C (3, 3) of a unit quaternion, scalar first."""
    w, x, y, z = q[0], q[1], q[2], q[3]
    return np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ])  # fmt: skip


@njit(cache=True)
def _advance(
    origin: Array, C_en: Array, w_ie: Array, t: Array, f: Array, w: Array, gyro: Array, accel: Array,
    r0: Array, v0: Array, q0: Array,
) -> tuple[Array, Array, Array, Array, Array, Array]:  # fmt: skip
    """Position, velocity, quaternion at t[-1]; mean force in n, attitude half way, rate of the last sample."""
    n = len(t)
    r, v, q = np.zeros((n, 3)), np.zeros((n, 3)), np.zeros((n, 4))
    r[0], v[0], q[0] = r0, v0, q0
    f, w = f - accel, w - gyro
    propagate_into(origin, C_en, w_ie, t, f, w, r, v, q)
    mean = np.zeros(3)
    for i in range(1, n):
        mean += f[i] * ((t[i] - t[i - 1]) / (t[-1] - t[0]))
    middle = _matrix(q[n // 2])
    return r[-1].copy(), v[-1].copy(), q[-1].copy(), middle @ mean, middle, w[-1].copy()


@njit(cache=True)
def _transition(
    origin: Array, C_en: Array, w_ie: Array, r: Array, C_nb: Array, f_n: Array, tau: Array, q: Array, dt: float
) -> tuple[Array, Array]:
    n, g = len(q), np.empty(3)
    gravity_into(origin, C_en, r, g)
    size = float(np.sqrt(g @ g))
    place = origin + C_en.T @ r
    F = np.zeros((n, n))
    fill_inertial(F, C_nb, f_n, w_ie, np.zeros(3), -g / size, size / float(np.sqrt(place @ place)), tau[0], tau[1])
    return discretise(F, np.diag(q), dt)


@njit(cache=True)
def _point(r: Array, v: Array, C: Array, w: Array, w_ie: Array, lever: Array) -> tuple[Array, Array]:
    arm = C @ lever
    return r + arm, v + C @ np.cross(w, lever) - np.cross(w_ie, arm)


@njit(cache=True)
def _turned(q: Array, phi: Array) -> Array:
    """The quaternion after a small rotation phi in n."""
    dq, out = np.empty(4), np.empty(4)
    quat_exp(phi, dq)
    quat_mul(dq, q, out)
    return out / np.sqrt(out @ out)


class Navigator:
    """A strapdown navigator whose position, velocity, attitude and sensor errors a filter feeds back.

    Estimated sensor errors are taken off every sample. `advance` follows the IMU to a time, also between samples.
    """

    def __init__(self, imu: ImuStream, frame: LocalFrame, start: InertialStart, model: ImuModel, t_s: float) -> None:
        self.t_s, self.r, self.v = t_s, start.r_n.copy(), start.v_n.copy()
        self.gyro_constant, self.gyro_markov, self.accel, self.w = np.zeros((4, 3))
        self._q = quat_from_matrix(start.C_nb)
        gap = int(np.argmax(np.diff(imu.t_s))) if len(imu.t_s) > 1 else 0
        if len(imu.t_s) > 1 and imu.t_s[gap + 1] - imu.t_s[gap] > LONGEST_GAP_S:
            raise InputError(
                f"the IMU has no samples from {imu.t_s[gap]:.3f} to {imu.t_s[gap + 1]:.3f} s; "
                f"filters bridge {LONGEST_GAP_S:g} s, the graph any gap"
            )
        self._t, (_, self._f, self._w) = imu.t_s, sample_means(imu)
        self._frame = (frame.origin_ecef, np.ascontiguousarray(frame.C_en), frame.w_ie_n)
        self._tau = np.array([model.gyro_markov_s, model.accel_markov_s])

    @property
    def C(self) -> Array:
        """C_nb (3, 3)."""
        matrix: Array = _matrix(self._q)
        return matrix

    def advance(self, t_s: float) -> tuple[Array, Array]:
        """Propagate to t_s and return the mean specific force in n (3,) and the attitude (3, 3) half way there.

        The Gauss-Markov parts decay as the model says. Raises InputError where the IMU does not reach t_s.
        """
        if t_s > self._t[-1] + LATE_S:
            raise InputError(f"the IMU ends at {self._t[-1]:.3f} s, before the epoch at {t_s:.3f} s; leave later epochs out")
        first = int(np.searchsorted(self._t, self.t_s + 1e-9))
        last = int(np.searchsorted(self._t, t_s + 1e-9))
        t = np.concatenate([[self.t_s], self._t[first:last]])
        rows = slice(max(first - 1, 0), last)
        f, w = self._f[rows], self._w[rows]
        if t[-1] < t_s - 1e-9 and last < len(self._t):  # the sample under way covers the rest
            t, f, w = np.append(t, t_s), np.vstack([f, self._f[last : last + 1]]), np.vstack([w, self._w[last : last + 1]])
        if len(f) < len(t):  # before the first sample: row 0 is not used
            f, w = np.vstack([f[:1], f]), np.vstack([w[:1], w])
        if len(t) < 2:
            raise InputError(f"the IMU has no samples from {self.t_s:.3f} to {t_s:.3f} s; filters need it at every epoch")
        gyro = self.gyro_constant + self.gyro_markov
        self.r, self.v, self._q, f_n, middle, self.w = _advance(*self._frame, t, f, w, gyro, self.accel, self.r, self.v, self._q)
        decay = np.exp(-(t[-1] - t[0]) / self._tau)
        self.gyro_markov, self.accel = decay[0] * self.gyro_markov, decay[1] * self.accel
        self.t_s = float(t[-1])
        return f_n, middle

    def transition(self, f_n: Array, C_nb: Array, q: Array, dt: float) -> tuple[Array, Array]:
        """Phi and Q (n, n) of the error states over dt; q (n,) densities, states beyond the 18 inertial ones are constant."""
        Phi, Q = _transition(*self._frame, self.r, C_nb, f_n, self._tau, q, dt)
        return Phi, Q

    def point(self, lever_b: Array) -> tuple[Array, Array]:
        """Position and velocity (3,) of a point of the body."""
        r, v = _point(self.r, self.v, _matrix(self._q), self.w, self._frame[2], lever_b)
        return r, v

    def correct(self, dx: Array) -> None:
        """Feed the estimated errors (18,) back; they are zero afterwards."""
        self.r = self.r - dx[POS]
        self.v = self.v - dx[VEL]
        self._q = _turned(self._q, dx[ATT])
        self.gyro_constant = self.gyro_constant + dx[GYRO]
        self.gyro_markov = self.gyro_markov + dx[GYRO_GM]
        self.accel = self.accel + dx[ACCEL]
