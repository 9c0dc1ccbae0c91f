"""Attitude and heading reference: gyros carry the attitude, gravity and the magnetic field keep it upright and north.

A multiplicative Kalman filter. With C_est = (I - [phi x]) C_true, b = true - estimated gyro bias, and two errors that are
counted but not estimated (Schmidt), b_a of the accelerometers and b_m of the magnetometer (hard iron), all in body axes:

    dC_nb/dt = C_nb [(w - bias) x] - [w_ie x] C_nb          d phi/dt = -w_ie x phi - C_nb b + white noise
    gravity   mean of C_est f = s + s x phi + C b_a         across the expected specific force s, so two rows
    heading   azimuth of C_est m_b - azimuth of the field F = phi_U - F_U (F . phi)_level / F_level^2
                                                              + (F_N, -F_E, 0) / F_level^2 . C b_m

s is what a body without acceleration feels, minus gravity, over each interval of `update_s`; the row is left out where the
size of f differs from that of s by more than `gate_g`. A coordinated turn passes that gate (3 deg/s at 50 m/s: 4% of g), and
its specific force points along the body's up axis however the body banks. Two remedies, as in practice:

    turn_mps   the gravity row's deviation grows by turn_mps times the measured rate about the vertical, and rows within
               twice `turn_s` count once, since the error stays as long as the turn
    Aiding     velocities (GNSS, a filter) of the vehicle: s is their change, less gravity, plus 2 w_ie x v, from one to the next

n is the problem's Earth-fixed frame, so that without aiding "up" is that of its origin: 0.01 deg off per kilometre from there.

Source: Markley (2003), multiplicative filter; Groves (2013), sec. 6.1 (heading) and 16.3 (attitude systems); Schmidt (1966);
spec ahrs_tdo.md, section 2.1.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from factorgraph.attitude import exp_so3, quat_from_matrix
from factorgraph.errors import InputError, not_negative, positive
from factorgraph.filters.layout import Layout
from factorgraph.geodesy import LocalFrame
from factorgraph.measurements import AttitudeStream, ImuStream, MagneticStream
from factorgraph.models import small
from factorgraph.models.preintegration import sample_means
from factorgraph.problem import ImuNoise
from factorgraph.types import Array, BoolArray, IntArray

STATES = Layout(attitude=3, gyro=3, accel=3, iron=3)
ATT, GYRO, ACCEL, IRON = (STATES[name] for name in STATES.names)
G_MPS2 = 9.80665
ANY_HEADING_RAD = np.pi / np.sqrt(3)  # of a heading of which nothing is known
_N, _G, _B, _M = STATES.size, GYRO.start, ACCEL.start, IRON.start  # for kernels
_ESTIMATED = ACCEL.start


@dataclass(frozen=True, slots=True)
class AhrsSettings:
    """What is tuned; sensors' noise is the vehicle's."""

    update_s: float = 0.1  # between gravity rows
    start_s: float = 0.5  # of the samples that the first attitude is taken from
    accel_mps2: float = 0.05  # accelerations that are not expected, standard deviation of a row
    gate_g: float = 0.1
    turn_mps: float = 0.0  # speed that makes accelerations of turns; 0: turns count like straight flight
    turn_s: float = 30.0  # how long turns last

    def __post_init__(self) -> None:
        positive(self, "update_s", "start_s", "accel_mps2", "gate_g", "turn_s")
        not_negative(self, "turn_mps")


@dataclass(frozen=True, slots=True)
class Aiding:
    """Positions and velocities of the body, from GNSS or a filter."""

    t_s: Array  # (k,)
    r_n: Array  # (k, 3) good to a kilometre: they say where up is
    v_n: Array  # (k, 3)
    sigma_mps: float  # of a component

    def __post_init__(self) -> None:
        positive(self, "sigma_mps")
        for name in ("r_n", "v_n"):
            if np.shape(getattr(self, name)) != (len(self.t_s), 3):
                raise InputError(f"Aiding.{name} must be ({len(self.t_s)}, 3), got {np.shape(getattr(self, name))}")


@dataclass(frozen=True, slots=True)
class AhrsTrack:
    """Attitude at every IMU sample, and which gravity rows counted."""

    t_s: Array  # (n,)
    q_nb: Array  # (n, 4) scalar first
    P: Array  # (n, 3, 3) of phi in n [rad^2]
    gyro_bias: Array  # (n, 3) [rad/s]
    gravity_s: Array  # (m,) times of gravity rows
    gravity_used: BoolArray  # (m,)

    def stream(self, correlation_s: float, name: str = "ahrs") -> AttitudeStream:
        """The attitudes as a measurement whose deviations count samples within twice `correlation_s` once."""
        once = np.sqrt(max(1.0, 2 * correlation_s / float(np.median(np.diff(self.t_s)))))
        sigma = once * np.sqrt(np.diagonal(self.P, axis1=1, axis2=2))
        return AttitudeStream(self.t_s, self.q_nb, sigma, name)


@dataclass(frozen=True, slots=True)
class _Rows:
    """Gravity rows: the sample after which each comes, and what is expected since the row before."""

    after: IntArray  # (m,)
    s_n: Array  # (m, 3) specific force
    sigma_mps2: Array  # (m,); 0: nothing is compared, an interval begins


@dataclass(frozen=True, slots=True)
class _Compass:
    """Fields: the sample after which each comes, deviations of their azimuth, the Earth's field, and the hard iron's."""

    after: IntArray  # (k,)
    m_b: Array  # (k, 3)
    sigma_rad: Array  # (k,)
    field_n: Array  # (3,)
    iron: float


def run(
    imu: ImuStream,
    noise: ImuNoise,
    frame: LocalFrame,
    magnetics: MagneticStream | None = None,
    aiding: Aiding | None = None,
    settings: AhrsSettings | None = None,
    heading: tuple[float, float] | None = None,
) -> AhrsTrack:
    """Attitudes at all samples of an IMU (n of them).

    magnetics: with the field at the place and date (`models.magnetic_field`), so heading is from true north. heading: first
    heading and its standard deviation [rad], where there is no magnetometer; unknown when not given. The first level is
    taken from the first specific forces, the first heading from the first magnetic sample. Raises InputError for an IMU
    shorter than the start, for magnetics that miss it, and for velocities that do not overlap it.
    """
    settings = settings or AhrsSettings()
    edges, f, w = sample_means(imu)
    dt = np.diff(edges)
    first = int(np.searchsorted(edges, edges[0] + settings.start_s - 1e-9))
    if first >= len(dt):
        raise InputError(f"the IMU has {edges[-1] - edges[0]:.2f} s of samples, an attitude starts from {settings.start_s:g} s")
    rows = _still(edges, first, frame, settings) if aiding is None else _aided(edges, first, frame, settings, aiding)
    compass = _compass(edges, first, magnetics)
    C, P = _aligned(f[:first], w[:first], dt[:first], rows.s_n[0], noise, settings, compass, heading)
    n = len(dt)
    out = np.empty((n, 3, 3)), np.empty((n, 3, 3)), np.empty((n, 3)), np.zeros(len(rows.after), np.bool_)
    density = (noise.gyro_rps_rthz**2, noise.gyro_bias_walk_rps_rts**2)
    options = (settings.gate_g * G_MPS2, settings.turn_mps, settings.turn_s)
    gravity = (rows.after, rows.s_n, rows.sigma_mps2)
    fields = (compass.after[1:], compass.m_b[1:], compass.sigma_rad[1:], compass.field_n)
    _run(dt, f, w, C, P, frame.w_ie_n, density, options, *gravity, *fields, *out)
    compared = rows.sigma_mps2 > 0
    t, q = edges[1:], quat_from_matrix(out[0])
    return AhrsTrack(t, q, out[1], out[2], t[rows.after[compared]], out[3][compared])


def _nearest(edges: Array, t_s: Array) -> IntArray:
    """Samples (k,) that end nearest to times; -1 for times at or before the first one's start."""
    return np.searchsorted(edges, t_s - 0.5 * float(np.median(np.diff(edges)))) - 1


def _still(edges: Array, first: int, frame: LocalFrame, settings: AhrsSettings) -> _Rows:
    """Rows every `update_s` that expect no acceleration."""
    ends = np.arange(edges[first], edges[-1] + 1e-9, settings.update_s)
    after = np.unique(np.searchsorted(edges, ends - 1e-9)) - 1
    sigma = np.full(len(after), settings.accel_mps2)
    sigma[0] = 0.0
    return _Rows(after, np.tile(-frame.gravity(np.zeros(3)), (len(after), 1)), sigma)


def _aided(edges: Array, first: int, frame: LocalFrame, settings: AhrsSettings, aiding: Aiding) -> _Rows:
    """Rows from velocity to velocity."""
    after = _nearest(edges, aiding.t_s)
    inside = np.isfinite(aiding.v_n[:, 0]) & (after >= first - 1) & (after < len(edges) - 1)
    after, keep = np.unique(after[inside], return_index=True)
    if len(after) < 2:
        raise InputError(f"no two velocities between {edges[first]:.2f} and {edges[-1]:.2f} s, where the attitude is wanted")
    t, r, v = (x[inside][keep] for x in (aiding.t_s, aiding.r_n, aiding.v_n))
    step = np.diff(t)
    s = np.diff(v, axis=0) / step[:, None] - 0.5 * (frame.gravity(r[1:]) + frame.gravity(r[:-1]))
    s += np.cross(frame.w_ie_n, v[1:] + v[:-1])
    sigma = np.hypot(settings.accel_mps2, np.sqrt(2) * aiding.sigma_mps / step)
    return _Rows(after, np.vstack([s[:1], s]), np.concatenate([[0.0], sigma]))


def _compass(edges: Array, first: int, magnetics: MagneticStream | None) -> _Compass:
    if magnetics is None:
        return _Compass(np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros(0), np.array([0.0, 1.0, 0.0]), 0.0)
    after = _nearest(edges, magnetics.t_s)
    kept = np.all(np.isfinite(magnetics.m_b), axis=1) & (after >= -1) & (after < len(edges) - 1)
    kept &= magnetics.t_s > edges[0] - 0.5 * (edges[1] - edges[0])
    after, field = np.maximum(after[kept], 0), np.asarray(magnetics.field_n, float)
    if not len(after) or after[0] >= first:
        raise InputError(
            f"{magnetics.name} measures nothing between {edges[0]:.2f} and {edges[first]:.2f} s, where attitude starts"
        )
    sigma = np.sqrt(np.mean(magnetics.sigma[kept] ** 2, axis=1)) / np.hypot(field[0], field[1])
    return _Compass(after, magnetics.m_b[kept], sigma, field, magnetics.calibration.bias)


def _aligned(
    f: Array,
    w: Array,
    dt: Array,
    s_n: Array,
    noise: ImuNoise,
    settings: AhrsSettings,
    compass: _Compass,
    heading: tuple[float, float] | None,
) -> tuple[Array, Array]:
    """C_nb (3, 3) before the first sample and the covariance (12, 12), from the first k samples (k, 3) and the first field."""
    C, up_b, m_b = np.eye(3), np.zeros(3), np.zeros(3)
    for k, (force, rate, step) in enumerate(zip(f, w, dt, strict=True)):
        up_b, C = up_b + C @ force * step, C @ exp_so3(rate * step)
        if len(compass.after) and k == compass.after[0]:
            m_b = C @ compass.m_b[0]
    g = float(np.linalg.norm(s_n))
    up_n, up_b = s_n / g, up_b / np.linalg.norm(up_b)
    axis = np.cross(up_b, up_n)
    size = float(np.linalg.norm(axis))
    C_nb = exp_so3(axis / max(size, 1e-12) * np.arctan2(size, up_b @ up_n))
    field, flat = compass.field_n, compass.field_n[0] ** 2 + compass.field_n[1] ** 2
    # phi of the level that the mean force gives, and of the heading that follows from it
    K = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0]]) / g
    azimuth = np.array([field[1], -field[0], 0.0]) / flat
    if len(compass.after):
        seen, wanted, sigma = C_nb @ m_b, _azimuth(field), float(compass.sigma_rad[0])
        K[2] = field[2] / flat * (field[0] * K[0] + field[1] * K[1])
    else:
        seen, (wanted, sigma) = C_nb[:, 1], heading or (0.0, ANY_HEADING_RAD)
    C_nb = exp_so3((_azimuth(seen) - wanted) * up_n) @ C_nb
    turning = settings.turn_mps * float(np.linalg.norm(np.mean(w, axis=0)))
    P, J = np.zeros((_N, _N)), np.zeros((3, _N))
    P[GYRO, GYRO] = noise.gyro_bias_rps**2 * np.eye(3)
    P[ACCEL, ACCEL] = noise.accel_bias_mps2**2 * np.eye(3)
    P[IRON, IRON] = compass.iron**2 * np.eye(3)
    J[:, ACCEL], J[2, IRON] = K @ C_nb, -azimuth @ C_nb
    P[ATT, :] = J @ P
    P[:, ATT] = P[ATT, :].T
    P[ATT, ATT] = J[:, ACCEL.start :] @ P[ACCEL.start :, ATT] + (settings.accel_mps2**2 + turning**2) * K @ K.T
    P[2, 2] += sigma**2
    return C_nb, P


def _azimuth(v_n: Array) -> float:
    """Of a vector (3,), clockwise from north."""
    return float(np.arctan2(v_n[0], v_n[1]))


@njit(cache=True)
def _update(P, dx, h, nu, r):  # type: ignore[no-untyped-def]
    """One row: adds the gain's share of nu to dx, which already holds that of rows before, and updates P (Schmidt)."""
    Ph, K, S = np.empty(_N), np.zeros(_N), r
    for i in range(_N):
        Ph[i] = 0.0
        for j in range(_N):
            Ph[i] += P[i, j] * h[j]
        S += h[i] * Ph[i]
        nu -= h[i] * dx[i]
    for i in range(_ESTIMATED):
        K[i] = Ph[i] / S
        dx[i] += K[i] * nu
    for i in range(_N):
        for j in range(_N):
            P[i, j] += K[i] * K[j] * S - K[i] * Ph[j] - Ph[i] * K[j]


@njit(cache=True)
def _feed_back(C, bias, dx):  # type: ignore[no-untyped-def]
    """C_true = Exp(phi) C_est; dx is zero afterwards."""
    turn, old = np.empty((3, 3)), C.copy()
    small.exp(dx, turn)
    small.mul(turn, old, C)
    for i in range(3):
        bias[i] += dx[_G + i]
    for i in range(_N):
        dx[i] = 0.0


@njit(cache=True)
def _earth_turned(x, y, z, w_dt, out):  # type: ignore[no-untyped-def]
    """out = (I - [w_dt x]) (x, y, z)."""
    out[0] = x - w_dt[1] * z + w_dt[2] * y
    out[1] = y - w_dt[2] * x + w_dt[0] * z
    out[2] = z - w_dt[0] * y + w_dt[1] * x


@njit(cache=True)
def _propagate(P, C, w_dt, dt, q_angle, q_bias):  # type: ignore[no-untyped-def]
    """P of a sample: only the attitude changes, with the Earth's turn w_dt and by the gyro bias."""
    A, column = np.empty((3, _N)), np.empty(3)
    for j in range(_N):
        _earth_turned(P[0, j], P[1, j], P[2, j], w_dt, column)
        for i in range(3):
            A[i, j] = column[i]
            for k in range(3):
                A[i, j] -= dt * C[i, k] * P[_G + k, j]
    for i in range(3):
        for j in range(3, _N):
            P[i, j] = P[j, i] = A[i, j]
        _earth_turned(A[i, 0], A[i, 1], A[i, 2], w_dt, column)
        for j in range(3):
            P[i, j] = column[j]
            for k in range(3):
                P[i, j] -= dt * C[j, k] * A[i, _G + k]
    for i in range(3):
        P[i, i] += q_angle * dt
        P[_G + i, _G + i] += q_bias * dt


@njit(cache=True)
def _norm(v):  # type: ignore[no-untyped-def]
    return np.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])


@njit(cache=True)
def _gravity_row(P, dx, h, C, e, u, mean, size, r):  # type: ignore[no-untyped-def]
    """Along e, across the unit vector u of the expected specific force of this size."""
    nu = 0.0
    for k in range(_N):
        h[k] = 0.0
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        h[i] = e[j] * u[k] - e[k] * u[j]
        nu += e[i] * mean[i] / _norm(mean)
        for m in range(3):
            h[_B + m] += C[i, m] * e[i] / size
    _update(P, dx, h, nu, r / (size * size))


@njit(cache=True)
def _gravity(P, dx, h, C, mean, s, r):  # type: ignore[no-untyped-def]
    """Both rows of the direction of the specific force, mean (3,) against s (3,); r of an acceleration."""
    size, flat = _norm(s), np.sqrt(s[0] * s[0] + s[2] * s[2])
    u, e = np.empty(3), np.empty(3)
    for i in range(3):
        u[i] = s[i] / size
    e[0], e[1], e[2] = s[2] / flat, 0.0, -s[0] / flat
    _gravity_row(P, dx, h, C, e, u, mean, size, r)
    # u x e
    e[0], e[1], e[2] = u[1] * e[2], u[2] * e[0] - u[0] * e[2], -u[1] * e[0]
    _gravity_row(P, dx, h, C, e, u, mean, size, r)


@njit(cache=True)
def _heading(P, dx, h, C, m_b, field, r):  # type: ignore[no-untyped-def]
    m = np.empty(3)
    small.apply(C, m_b, m)
    flat = field[0] * field[0] + field[1] * field[1]
    nu = np.arctan2(m[0], m[1]) - np.arctan2(field[0], field[1])
    nu -= 2 * np.pi * np.floor(nu / (2 * np.pi) + 0.5)
    for k in range(_N):
        h[k] = 0.0
    h[0], h[1], h[2] = -field[2] * field[0] / flat, -field[2] * field[1] / flat, 1.0
    for k in range(3):
        h[_M + k] = (field[1] * C[0, k] - field[0] * C[1, k]) / flat
    _update(P, dx, h, nu, r)


@njit(cache=True)
def _carry(C, w, f, dt, w_ie, P, density, force):  # type: ignore[no-untyped-def]
    """C and P of a sample; adds its specific force in n to `force` and returns its turn about up."""
    x, half, middle, turned = np.empty(3), np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    for k in range(3):
        x[k] = 0.5 * dt * w[k]
    small.exp(x, half)
    small.mul(C, half, middle)
    small.mul(middle, half, turned)
    for k in range(3):
        x[k] = -dt * w_ie[k]
    small.exp(x, half)
    small.mul(half, turned, C)
    for k in range(3):
        x[k] = -x[k]
    _propagate(P, middle, x, dt, density[0], density[1])
    small.apply(middle, f, x)
    for k in range(3):
        force[k] += dt * x[k]
    small.apply(middle, w, x)
    return dt * x[2]


@njit(cache=True)
def _run(  # type: ignore[no-untyped-def]
    dt, f, w, C, P, w_ie, density, options, after, s_n, sigma, m_after, m_b, m_sigma, field, C_out, P_out, bias_out, used
):
    """All samples; C (3, 3) and P (12, 12) are the start's and change."""
    gate, speed, lasting = options
    bias, dx, h = np.zeros(3), np.zeros(_N), np.zeros(_N)
    rate, force, mean = np.empty(3), np.zeros(3), np.empty(3)
    turn, span, g, m = 0.0, 0.0, 0, 0
    for i in range(len(dt)):
        for k in range(3):
            rate[k] = w[i, k] - bias[k]
        turn += _carry(C, rate, f[i], dt[i], w_ie, P, density, force)
        span += dt[i]
        while g < len(after) and after[g] == i:
            for k in range(3):
                mean[k], force[k] = force[k] / max(span, 1e-9), 0.0
            if sigma[g] > 0 and abs(_norm(mean) - _norm(s_n[g])) < gate:
                used[g] = True
                sideways = speed * turn / span
                _gravity(P, dx, h, C, mean, s_n[g], sigma[g] ** 2 + sideways**2 * max(1.0, 2 * lasting / span))
                _feed_back(C, bias, dx)
            turn, span = 0.0, 0.0
            g += 1
        while m < len(m_after) and m_after[m] == i:
            _heading(P, dx, h, C, m_b[m], field, m_sigma[m] ** 2)
            _feed_back(C, bias, dx)
            m += 1
        for j in range(3):
            bias_out[i, j] = bias[j]
            for k in range(3):
                C_out[i, j, k], P_out[i, j, k] = C[j, k], P[j, k]
