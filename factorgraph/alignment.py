"""Start attitudes from the motion: velocities known in n against specific force integrated in the body.

Within a window of a minute, with u(t) the change of velocity since its start less that of gravity, as known in n, and s(t) the
integral of specific force in the body axes of the start,

    u(t) = c + R_0 s(t; b_g, b_a) + e(t),

least squares give the attitude R_0 (body to n) at the window's start, the biases b_g, b_a and the offset c that the start's own
velocity error leaves. e is the error of the velocities and what the noise of the IMU integrates to: white noise of the
gyroscope tilts gravity, so its share grows with t^3. Directions known in both frames,

    u_n = R_0 dR(t; b_g) u_b + e,

from two antennas, a magnetometer, an attitude sensor, or from the course of a vehicle that only moves forward, are rows of the
same problem. A vehicle at rest is the special case that only tells level and rate biases.

The only unknown with more than one minimum is the heading: the window with the most motion is solved from several headings
evenly spread, and the best is kept. The other windows follow outwards from it, each starting where the gyroscope carries the
one before it, with that attitude's covariance as prior. Every stretch without gaps in the IMU is solved for itself.

Perturbation: R <- Exp(phi) R, phi in n.
Source: Groves (2013), ch. 5 and 14, for velocity-matching alignment; Wu and Pan (2013) for integrated velocity increments.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Literal

import numpy as np
from scipy.linalg import solve_triangular

from factorgraph.attitude import euler_from_matrix, exp_so3, log_so3, skew, wrapped
from factorgraph.errors import InputError
from factorgraph.geodesy import LocalFrame
from factorgraph.measurements import ImuStream
from factorgraph.models import preintegration
from factorgraph.problem import ImuNoise
from factorgraph.rest import inside, rest_spans
from factorgraph.types import Array, IntArray

Way = Literal["levelling", "motion", "course", "antennas", "magnetometer", "attitude sensor", "declared", "starts compared"]

WINDOW_S, LONG_S = 60.0, 240.0  # the longer where the shorter leaves the heading open
STEP_S = 1.0  # of the states that are matched
HEADINGS = 8
DECIDED_RAD = 0.8  # standard deviation of a heading that is known well enough to start from
SIGMA_MPS = 0.1  # of the velocities, to begin with
SIGMA_RANGE_MPS = (0.03, 5.0)
ALTERNATIVE = 6.0  # another minimum whose cost is higher by less than this is as likely as the best
APART_RAD = 0.5  # attitudes further apart are different minima
REST_S = 4.0
REST_RPS = 5e-4  # of the mean rate at rest as bias: the Earth's rate, and noise
WIDENED = 10.0  # what the graph sees again may count once: 1 % of it as prior
WIDEST_RAD = np.array([1.0, 1.0, 3.0])
STEPS, SMALL_STEP = 25, 1e-5
FREE_RPS_RTHZ = 0.1  # gyroscope noise from which attitudes are not carried from one moment to another
REFUTED = 8.0  # cost beyond which motion refutes a declared heading: 4 standard deviations
GAP_RAD_RTS = 0.3  # per sqrt(s): how a gap in the IMU wears a heading out
G_MPS2 = 9.81

C, PHI, BG, BA = (slice(i, i + 3) for i in range(0, 12, 3))
SOMEWHERE = np.diag([0.0] * 3 + [1 / 9.0] * 3 + [0.0] * 6)  # information that an attitude is an angle, so that none is infinite


@dataclass(frozen=True, slots=True)
class Directions:
    """Directions known in body and in n; their errors persist, so many of them count like one."""

    way: Way
    t_s: Array  # (m,)
    u_b: Array  # (m, 3) unit vectors
    u_n: Array  # (m, 3)
    sigma_rad: Array  # (m,)


@dataclass(frozen=True, slots=True)
class Alignment:
    """Attitudes and biases at grid times, and how well the first attitude is known."""

    C_nb: Array  # (K, 3, 3)
    bias: Array  # (K, 6) gyroscope, accelerometer
    way: Way  # what told the heading; "levelling": nothing did
    sigma_rad: Array  # (3,) of the first attitude about east, north, up
    declared: tuple[float, float] | None  # the heading of the first state and its standard deviation, unless refuted

    @property
    def is_decided(self) -> bool:
        """Whether anything tells the heading."""
        return self.way != "levelling"

    @property
    def prior(self) -> tuple[Array, Array]:
        """Mean (3, 3) and standard deviations (3,) about east, north, up of the graph's prior on the first attitude.

        A declared heading is information of its own. Whatever else told the attitude is in the graph as measurements, and the
        prior is so wide that they do not count twice.
        """
        C_nb, wide = self.C_nb[0], np.minimum(WIDENED * self.sigma_rad, WIDEST_RAD)
        if self.declared is None:
            return C_nb, wide
        turn = exp_so3(np.array([0.0, 0.0, _heading(C_nb) - self.declared[0]]))
        return turn @ C_nb, np.array([wide[0], wide[1], self.declared[1]])

    def turned(self, heading_rad: float) -> Array:
        """The attitudes (K, 3, 3) with all headings greater by an angle."""
        return np.asarray(exp_so3(np.array([0.0, 0.0, -heading_rad])) @ self.C_nb)


def align(
    imu: ImuStream,
    grid_s: Array,
    r_n: Array,
    v_n: Array,
    frame: LocalFrame,
    noise: ImuNoise | None = None,
    heading: tuple[float, float] | None = None,
    directions: Sequence[Directions] = (),
) -> Alignment:
    """Attitudes and biases at grid times (K,) from positions good to metres and velocities good to decimetres per second.

    r_n, v_n (K, 3). heading: a declared heading of the first state and its standard deviation [rad]; motion may refute it.
    """
    noise = noise or ImuNoise()
    if noise.gyro_rps_rthz > FREE_RPS_RTHZ:
        return _by_directions(grid_s, v_n, directions, heading)
    known = _Known(imu, grid_s, r_n, v_n, frame, noise, tuple(directions))
    if not (np.all(np.isfinite(r_n)) and np.all(np.isfinite(v_n))):
        raise InputError("alignment needs finite positions and velocities at every state")
    unknown = preintegration.crossing(preintegration.gaps(imu), grid_s[:-1], grid_s[1:])
    stretch = np.concatenate([[0], np.cumsum(unknown)])
    pieces: list[_Piece] = []
    for s in range(int(stretch[-1]) + 1):
        rows = np.flatnonzero(stretch == s)
        pieces += _stretch(known, rows, heading if s == 0 else _over_gap(known, pieces[-1], rows))
    return _joined(known, pieces, heading)


def course(grid_s: Array, v_n: Array, slip_mps: float, moving_mps: float = 2.0) -> Directions:
    """The front axis along the horizontal velocity, of a vehicle that only moves forward; slip_mps (1 sigma) sideways."""
    speed = np.linalg.norm(v_n[:, :2], axis=1)
    moving = speed > moving_mps
    u_n = np.column_stack([v_n[moving, :2] / speed[moving, None], np.zeros(int(moving.sum()))])
    sigma = np.hypot(0.05, np.hypot(slip_mps, SIGMA_MPS) / speed[moving])
    return Directions("course", grid_s[moving], np.tile([0.0, 1.0, 0.0], (len(u_n), 1)), u_n, sigma)


def _by_directions(grid_s: Array, v_n: Array, directions: Sequence[Directions], heading: tuple[float, float] | None) -> Alignment:
    """Attitudes of a vehicle whose turns no gyroscope knows: the direction of each moment, level about it."""
    K = len(grid_s)
    up, level_rad = np.array([0.0, 0.0, 1.0]), WIDEST_RAD[0]
    told = [d for d in directions if len(d.t_s)]
    if told:
        best = min(told, key=lambda d: float(np.median(d.sigma_rad)))
        u_n = np.column_stack([np.interp(grid_s, best.t_s, axis) for axis in best.u_n.T])
        u_b = np.column_stack([np.interp(grid_s, best.t_s, axis) for axis in best.u_b.T])
        C_nb = _triad(u_n, up) @ np.swapaxes(_triad(u_b, up), 1, 2)
        sigma = np.array([level_rad, level_rad, np.interp(grid_s[0], best.t_s, best.sigma_rad)])
        return Alignment(C_nb, np.zeros((K, 6)), best.way, sigma, heading)
    turn = 0.0 if heading is None else heading[0]
    sigma = np.array([level_rad, level_rad, WIDEST_RAD[2] if heading is None else heading[1]])
    C_nb = np.tile(exp_so3(np.array([0.0, 0.0, -turn])), (K, 1, 1))
    return Alignment(C_nb, np.zeros((K, 6)), "levelling" if heading is None else "declared", sigma, heading)


def _triad(first: Array, second: Array) -> Array:
    """Axes (K, 3, 3), as columns, of which the first is along `first` (K, 3) and the third across `second` (3,) too."""
    x = first / np.linalg.norm(first, axis=1, keepdims=True)
    z = np.cross(x, second)
    z /= np.maximum(np.linalg.norm(z, axis=1, keepdims=True), 1e-9)
    return np.stack([x, np.cross(z, x), z], axis=-1)


@dataclass(frozen=True, slots=True)
class _Known:
    """What alignment goes by."""

    imu: ImuStream
    t: Array
    r: Array
    v: Array
    frame: LocalFrame
    noise: ImuNoise
    directions: tuple[Directions, ...]

    def samples(self, start_s: float, stop_s: float) -> ImuStream:
        """The part of the IMU's samples that cover a time."""
        t = self.imu.t_s
        i = max(int(np.searchsorted(t, start_s)) - 2, 0)
        j = min(max(int(np.searchsorted(t, stop_s)) + 2, i + 3), len(t))
        i = max(min(i, j - 3), 0)
        return ImuStream(t[i:j], self.imu.f_b[i:j], self.imu.w_b[i:j], self.imu.is_mean)


@dataclass(slots=True)
class _Prior:
    """What is known before a window is solved."""

    bias: Array  # (6,)
    bias_sigma: Array  # (6,)
    R: Array | None = None  # (3, 3) at the window's start
    P: Array = field(default_factory=lambda: np.eye(3))  # (3, 3) of R
    heading: tuple[float, float] | None = None


@dataclass(slots=True)
class _Fit:
    R: Array
    c: Array
    bias: Array  # (6,)
    cost: float
    P: Array  # (12, 12) of c, phi, gyroscope bias, accelerometer bias


@dataclass(slots=True)
class _Piece:
    """A solved window: grid rows and attitudes at all of them."""

    rows: IntArray
    fit: _Fit
    C_nb: Array  # (n, 3, 3)
    dR: Array  # (n, 3, 3) since its first row
    dR_dbg: Array
    way: Way


class _Window:
    """One window's observations, whitened."""

    def __init__(self, known: _Known, rows: IntArray, sigma_mps: float) -> None:
        t = known.t[rows]
        # states closer than STEP_S tell no more together than apart
        cell = np.floor((t - t[0]) / STEP_S)
        keep = np.concatenate([[True], np.diff(cell) > 0])
        keep[-1] = True
        self.known = known
        self.t, self.t0 = t[keep], float(t[0])
        self.imu = known.samples(float(t[0]), float(t[-1]))
        self.u = self._velocity_changes(rows)[keep]
        self.sigma_mps = sigma_mps
        self.Wh, self.Wu, self.illusion = self._whitening()
        parts = [(d, (d.t_s >= t[0]) & (d.t_s <= t[-1])) for d in known.directions]
        self.given = [
            replace(d, t_s=d.t_s[m], u_b=d.u_b[m], u_n=d.u_n[m], sigma_rad=d.sigma_rad[m] * np.sqrt(np.count_nonzero(m)))
            for d, m in parts
            if np.any(m)
        ]
        order = np.argsort(np.concatenate([d.t_s for d in self.given]), kind="stable") if self.given else np.zeros(0, int)

        def column(name: str, width: tuple[int, ...]) -> Array:
            joined = [getattr(d, name) for d in self.given]
            return np.concatenate(joined)[order] if joined else np.zeros((0, *width))

        self.t_d, self.u_b, self.u_n = column("t_s", ()), column("u_b", (3,)), column("u_n", (3,))
        self.sigma_d = column("sigma_rad", ())

    def _velocity_changes(self, rows: IntArray) -> Array:
        """u (n, 3): velocity less gravity since the first row, in the axes that n had then as the Earth turns."""
        known = self.known
        t, v, w_ie = known.t[rows], known.v[rows], known.frame.w_ie_n
        pull = known.frame.gravity(known.r[rows]) - 2 * np.cross(w_ie, v)
        du = np.diff(v, axis=0) - np.diff(t)[:, None] * 0.5 * (pull[1:] + pull[:-1])
        turned = exp_so3(w_ie * (t[:-1] - t[0])[:, None])
        return np.concatenate([np.zeros((1, 3)), np.cumsum(np.einsum("nij,nj->ni", turned, du), axis=0)])

    def _whitening(self) -> tuple[Array, Array, float]:
        """Inverse Cholesky factors (n, n) of the errors' covariance, horizontal axes and up, and what noise seems to tell.

        s(t) holds the IMU's noise, and its horizontal part looks like motion that tells the heading: information of one per
        whitened component that is all noise of the IMU.
        """
        noise, n = self.known.noise, len(self.t)
        dt = np.diff(self.t, prepend=self.t[0])
        D, B = np.tril(np.tile(dt, (n, 1))), np.tril(np.tile(np.sqrt(dt), (n, 1)))
        DB = D @ B
        up = self.sigma_mps**2 * np.eye(n)
        up += noise.accel_mps2_rthz**2 * B @ B.T + noise.accel_bias_walk_mps2_rts**2 * DB @ DB.T
        DDB = D @ DB
        tilt = noise.gyro_rps_rthz**2 * DB @ DB.T + noise.gyro_bias_walk_rps_rts**2 * DDB @ DDB.T
        horizontal = up + G_MPS2**2 * tilt
        Wh = _inverse_root(horizontal)
        illusion = 2 * (n - self.sigma_mps**2 * float(np.sum(Wh**2)))
        return Wh, _inverse_root(up), illusion

    def linearised(self, bias: Array) -> _Linear:
        return _Linear(self, bias)


class _Linear:
    """A window at one bias, first order about it."""

    def __init__(self, window: _Window, bias: Array) -> None:
        self.w, self.bias0 = window, bias.copy()
        n, m = len(window.t), len(window.t_d)
        rate = np.tile(bias, (n, 1))
        self.inc = preintegration.integrate(window.imu, np.full(n, window.t0), window.t, rate)
        at = preintegration.integrate(window.imu, np.full(m, window.t0), window.t_d, np.tile(bias, (m, 1)))
        self.dR_d, self.dR_d_dbg = at.dR, at.dR_dbg

    def forces(self, bias: Array) -> Array:
        """s (n, 3) at a bias."""
        inc, db = self.inc, bias - self.bias0
        return np.asarray(inc.dv + inc.dv_dbg @ db[:3] + inc.dv_dba @ db[3:])

    def solve(self, prior: _Prior, R: Array, bias: Array) -> _Fit:
        """Gauss-Newton with damping from an attitude and a bias."""
        c = np.zeros(3)
        e, J = self._rows(prior, R, c, bias)
        cost, damping = 0.5 * float(e @ e), 0.0
        for _ in range(STEPS):
            H, g = J.T @ J + SOMEWHERE, J.T @ e
            step = np.linalg.solve(H + damping * np.diag(np.diag(H)), -g)
            turned, c_new, b_new = exp_so3(np.asarray(step[PHI])) @ R, c + step[C], bias + step[6:]
            e_new, J_new = self._rows(prior, turned, c_new, b_new)
            new = 0.5 * float(e_new @ e_new)
            if new > cost * (1 + 1e-9) + 1e-9:
                damping = max(10 * damping, 1e-3)
                if damping > 1e6:
                    break
                continue
            R, c, bias, e, J = turned, c_new, b_new, e_new, J_new
            done = np.linalg.norm(step[PHI]) < SMALL_STEP or cost - new < 1e-6 * (1 + cost)
            cost, damping = new, 0.0 if damping < 1e-2 else damping / 10
            if done:
                break
        return _Fit(R, c, bias, cost, self._covariance(prior, J))

    def _covariance(self, prior: _Prior, J: Array) -> Array:
        """Covariance (12, 12), the heading's without what noise alone seems to tell."""
        P = np.linalg.inv(J.T @ J + SOMEWHERE)
        up = PHI.stop - 1
        least = SOMEWHERE[up, up] if prior.R is None else 1 / prior.P[2, 2]
        least += 0.0 if prior.heading is None else prior.heading[1] ** -2
        told = max(1 / P[up, up] - self.w.illusion, least)
        scale = np.ones(len(P))
        scale[up] = max(1 / np.sqrt(told * P[up, up]), 1.0)
        return np.asarray(P * np.outer(scale, scale))

    def _rows(self, prior: _Prior, R: Array, c: Array, bias: Array) -> tuple[Array, Array]:
        """Whitened residuals and their Jacobian to c, phi, gyroscope bias, accelerometer bias."""
        w, inc = self.w, self.inc
        Rs = self.forces(bias) @ R.T
        e = w.u - c - Rs
        n = len(e)
        J = np.zeros((n, 3, 12))
        J[:, :, C], J[:, :, PHI], J[:, :, BG], J[:, :, BA] = -np.eye(3), skew(Rs), -R @ inc.dv_dbg, -R @ inc.dv_dba
        parts_e, parts_J = [], []
        for axis, W in enumerate((w.Wh, w.Wh, w.Wu)):
            parts_e.append(W @ e[:, axis])
            parts_J.append(W @ J[:, axis])
        if len(w.t_d):
            dR = self.dR_d @ exp_so3(self.dR_d_dbg @ (bias - self.bias0)[:3])
            seen = np.einsum("ij,njk,nk->ni", R, dR, w.u_b)
            Jd = np.zeros((len(seen), 3, 12))
            Jd[:, :, PHI], Jd[:, :, BG] = skew(seen), R @ dR @ skew(w.u_b) @ self.dR_d_dbg
            parts_e.append(((w.u_n - seen) / w.sigma_d[:, None]).ravel())
            parts_J.append((Jd / w.sigma_d[:, None, None]).reshape(-1, 12))
        for row_e, row_J in self._prior_rows(prior, R, bias):
            parts_e.append(row_e)
            parts_J.append(row_J)
        return np.concatenate(parts_e), np.concatenate(parts_J)

    def _prior_rows(self, prior: _Prior, R: Array, bias: Array) -> list[tuple[Array, Array]]:
        J = np.zeros((6, 12))
        J[:, 6:] = np.diag(1 / prior.bias_sigma)
        rows = [((bias - prior.bias) / prior.bias_sigma, J)]
        if prior.R is not None:
            W = np.linalg.inv(np.linalg.cholesky(prior.P))
            J = np.zeros((3, 12))
            J[:, PHI] = W
            rows.append((W @ log_so3(R @ prior.R.T), J))
        if prior.heading is not None:
            J = np.zeros((1, 12))
            J[0, PHI] = [0.0, 0.0, -1.0 / prior.heading[1]]  # heading counts clockwise
            rows.append((np.array([float(wrapped(_heading(R) - prior.heading[0])) / prior.heading[1]]), J))
        return rows


def _inverse_root(K: Array) -> Array:
    """Inverse Cholesky factor (n, n)."""
    return np.asarray(solve_triangular(np.linalg.cholesky(K), np.eye(len(K)), lower=True))


def _heading(R: Array) -> float:
    return float(euler_from_matrix(R)[2])


def _levelled(linear: _Linear) -> Array:
    """An attitude (3, 3) that turns the mean specific force of the first seconds upright, its heading arbitrary."""
    w = linear.w
    near = min(int(np.searchsorted(w.t, w.t0 + 10.0)), len(w.t) - 1)
    a, b = linear.forces(linear.bias0)[near], w.u[near]
    if np.linalg.norm(a) < 1e-9 or np.linalg.norm(b) < 1e-9:
        return np.eye(3)
    return _upright(a, b / np.linalg.norm(b))


def _upright(a: Array, b: Array) -> Array:
    """The smallest rotation (3, 3) of direction a (3,) to unit vector b."""
    a = a / np.linalg.norm(a)
    axis = np.cross(a, b)
    size = np.linalg.norm(axis)
    if size < 1e-9 and a @ b < 0:  # upside down: any horizontal axis
        axis = np.cross(a, [1.0, 0.0, 0.0] if abs(a[0]) < 0.9 else [0.0, 1.0, 0.0])
        return np.asarray(exp_so3(np.pi * axis / np.linalg.norm(axis)))
    return np.asarray(exp_so3(axis / max(float(size), 1e-12) * np.arctan2(size, a @ b)))


def _again(window: _Window, fit: _Fit, prior: _Prior) -> _Fit:
    """The same minimum with the increments renewed at its bias, until it stays."""
    for _ in range(4):
        before = fit
        fit = window.linearised(fit.bias).solve(prior, fit.R, fit.bias)
        if np.abs(fit.bias - before.bias)[:3].max() < 1e-4:
            break
    return fit


def _rescaled(window: _Window, fit: _Fit) -> float:
    """Standard deviation of the velocities as the residuals show it."""
    Rs = window.linearised(fit.bias).forces(fit.bias) @ fit.R.T
    e = window.u - fit.c - Rs
    white = np.concatenate([window.Wh @ e[:, 0], window.Wh @ e[:, 1], window.Wu @ e[:, 2]])
    # the median hardly sees the few epochs that multipath spoils
    scale = float(np.median(np.abs(white))) / 0.6745 * np.sqrt(len(white) / max(len(white) - 9, 3))
    return float(np.clip(window.sigma_mps * scale, *SIGMA_RANGE_MPS))


def _searched(known: _Known, rows: IntArray, prior: _Prior) -> tuple[_Fit, bool]:
    """The best minimum over all headings, and whether it stands out from every other."""
    window = _Window(known, rows, SIGMA_MPS)
    best, others = _minima(window, prior, [])
    for _ in range(2):
        sigma = _rescaled(window, best)
        if abs(np.log(sigma / window.sigma_mps)) < 0.2:
            break
        window = _Window(known, rows, sigma)
        best, others = _minima(window, prior, [best.R, *(fit.R for fit in others)])
    return best, all(fit.cost - best.cost > ALTERNATIVE for fit in others)


def _minima(window: _Window, prior: _Prior, more: Sequence[Array]) -> tuple[_Fit, list[_Fit]]:
    """The best minimum, and the other distinct ones; `more` are attitudes to start from besides the headings."""
    linear = window.linearised(prior.bias)
    level = _levelled(linear)
    turns = exp_so3(np.linspace(0, 2 * np.pi, HEADINGS, endpoint=False)[:, None] * [0.0, 0.0, 1.0])
    fits = sorted((linear.solve(prior, R, prior.bias) for R in (*(turns @ level), *more)), key=lambda fit: fit.cost)
    distinct: list[_Fit] = []
    for fit in fits:
        if all(np.linalg.norm(log_so3(fit.R @ other.R.T)) > APART_RAD for other in distinct):
            distinct.append(fit)
    near = [_again(window, fit, prior) for fit in distinct if fit.cost < distinct[0].cost + 10 * ALTERNATIVE]
    near.sort(key=lambda fit: fit.cost)
    return near[0], [fit for fit in near[1:] if np.linalg.norm(log_so3(fit.R @ near[0].R.T)) > APART_RAD]


def _rest_prior(known: _Known, start_s: float, stop_s: float) -> _Prior:
    """Priors of the biases: the IMU's grade, and the mean rate at rest where the vehicle is seen to rest."""
    noise = known.noise
    sigma = np.array([noise.gyro_bias_rps] * 3 + [noise.accel_bias_mps2] * 3)
    imu = known.samples(start_s, stop_s)
    spans = rest_spans(imu, known.t, np.linalg.norm(known.v, axis=1))
    spans = spans[spans[:, 1] - spans[:, 0] >= REST_S]
    resting = inside(spans, imu.t_s, imu.t_s)
    mean = imu.w_b[resting].mean(axis=0) if np.any(resting) else np.full(3, np.inf)
    if np.any(np.abs(mean) > 4 * noise.gyro_bias_rps):
        return _Prior(np.zeros(6), sigma)
    # a smooth hover may look like rest, and a slow turn in it like a bias
    sigma[:3] = np.minimum(sigma[:3], np.hypot(REST_RPS, 0.5 * mean))
    return _Prior(np.concatenate([mean, np.zeros(3)]), sigma)


def _chunks(known: _Known, rows: IntArray, length_s: float) -> list[IntArray]:
    """Rows of windows of about a length; the last row of one is the first of the next."""
    t = known.t[rows]
    count = max(round(float(t[-1] - t[0]) / length_s), 1)
    edges = np.unique(np.searchsorted(t, np.linspace(t[0], t[-1], count + 1) - 1e-9))
    edges[-1] = len(rows) - 1
    if len(edges) < 2:
        return [rows]
    return [rows[a : b + 1] for a, b in pairwise(edges.tolist())]


def _over_gap(known: _Known, before: _Piece, rows: IntArray) -> tuple[float, float] | None:
    """Heading after a gap and its standard deviation, from the turn rates on either side of it; None where neither is known."""
    if before.way == "levelling":
        return None
    a, b = known.t[before.rows[-1]], known.t[rows[0]]
    turn = preintegration.integrate(known.samples(a, b), np.array([a]), np.array([b]), before.fit.bias[None])
    sigma = np.hypot(_up_sigma(before.fit), GAP_RAD_RTS * np.sqrt(b - a))
    return _heading(before.C_nb[-1] @ turn.dR[0]), float(min(sigma, WIDEST_RAD[2]))


def _single(known: _Known, rows: IntArray, heading: tuple[float, float] | None) -> _Piece:
    """One state between two gaps: upright as its samples are."""
    t = float(known.t[rows[0]])
    f_b = known.samples(t, t).f_b.mean(axis=0)
    turn = exp_so3(np.array([0.0, 0.0, -heading[0] if heading is not None else 0.0]))
    R = turn @ _upright(f_b, np.array([0.0, 0.0, 1.0]))
    P = np.diag([1.0] * 3 + [1.0, 1.0, heading[1] ** 2 if heading is not None else 9.0] + [1e-4] * 3 + [0.1] * 3)
    return _Piece(rows, _Fit(R, np.zeros(3), np.zeros(6), 0.0, P), R[None], np.eye(3)[None], np.zeros((1, 3, 3)), "levelling")


def _stretch(known: _Known, rows: IntArray, heading: tuple[float, float] | None) -> list[_Piece]:
    """All windows of a stretch without gaps."""
    if len(rows) < 2:
        return [_single(known, rows, heading)]
    start_s, stop_s = float(known.t[rows[0]]), float(known.t[rows[-1]])
    prior = _rest_prior(known, start_s, min(stop_s, start_s + LONG_S))
    for length in (WINDOW_S, LONG_S):
        obeyed = False
        chunks = _chunks(known, rows, length)
        best = int(np.argmax([_excitement(known, chunk) for chunk in chunks]))
        fit, stands_out = _searched(known, chunks[best], prior)
        if heading is not None and best == 0:
            told = _searched(known, chunks[best], replace(prior, heading=heading))
            if told[0].cost < fit.cost + REFUTED:
                (fit, stands_out), obeyed = told, True
        decided = stands_out and _up_sigma(fit) < DECIDED_RAD
        if decided or stop_s - start_s <= length * 1.5:
            break
    way = _way(known, chunks[best], fit, decided, heading if obeyed else None)
    pieces = {best: _piece(known, chunks[best], fit, way)}
    for i in range(best + 1, len(chunks)):
        pieces[i] = _next(known, chunks[i], pieces[i - 1])
    for i in range(best - 1, -1, -1):
        pieces[i] = _previous(known, chunks[i], pieces[i + 1])
    ordered = [pieces[i] for i in range(len(chunks))]
    if heading is not None and not decided and best > 0:
        return _declared(ordered, heading)
    return ordered


def _declared(pieces: list[_Piece], heading: tuple[float, float]) -> list[_Piece]:
    """Windows whose heading nothing told, turned to the declared one."""
    turn = exp_so3(np.array([0.0, 0.0, -float(wrapped(heading[0] - _heading(pieces[0].fit.R)))]))
    for piece in pieces:
        piece.fit.R, piece.C_nb, piece.way = turn @ piece.fit.R, turn @ piece.C_nb, "declared"
    pieces[0].fit.P[PHI, PHI][2, 2] = heading[1] ** 2
    return pieces


def _way(known: _Known, rows: IntArray, fit: _Fit, decided: bool, heading: tuple[float, float] | None) -> Way:
    """What told a window's heading: the direction given, where one was, else motion; nothing where it is not decided."""
    if not decided:
        return "levelling"
    if heading is not None and _up_sigma(fit) > 0.7 * heading[1]:
        return "declared"
    t = known.t[rows]
    given = [d for d in known.directions if np.any((d.t_s >= t[0]) & (d.t_s <= t[-1]))]
    if not given:
        return "motion"
    alone, stands_out = _searched(replace(known, directions=()), rows, _rest_prior(known, float(t[0]), float(t[-1])))
    tells = stands_out and _up_sigma(alone) < 2 * _up_sigma(fit)
    return "motion" if tells else min(given, key=lambda d: float(np.median(d.sigma_rad))).way


def _up_sigma(fit: _Fit) -> float:
    return float(np.sqrt(fit.P[PHI, PHI][2, 2]))


def _excitement(known: _Known, rows: IntArray) -> float:
    """How much the horizontal velocity changes in a window, beyond its noise."""
    t, v = known.t[rows], known.v[rows, :2]
    step = max(int(np.searchsorted(t, t[0] + 2.0)), 1)
    return float(np.sum((v[step:] - v[:-step]) ** 2)) / max(step, 1)


def _piece(known: _Known, rows: IntArray, fit: _Fit, way: Way) -> _Piece:
    t = known.t[rows]
    n = len(t)
    inc = preintegration.integrate(known.samples(t[0], t[-1]), np.full(n, t[0]), t, np.tile(fit.bias, (n, 1)))
    C_nb = exp_so3(-known.frame.w_ie_n * (t - t[0])[:, None]) @ fit.R @ inc.dR
    return _Piece(rows, fit, C_nb, inc.dR, inc.dR_dbg, way)


def _inherited(known: _Known, of: _Piece, length_s: float) -> tuple[Array, Array]:
    """Standard deviations (6,) of a neighbour's biases as prior."""
    noise = known.noise
    walk = np.array([noise.gyro_bias_walk_rps_rts] * 3 + [noise.accel_bias_walk_mps2_rts] * 3) * np.sqrt(length_s)
    return of.fit.bias, np.hypot(np.sqrt(np.diag(of.fit.P)[6:]), walk)


def _next(known: _Known, rows: IntArray, before: _Piece) -> _Piece:
    """The window after a solved one."""
    length = float(known.t[rows[0]] - known.t[before.rows[0]])
    bias, sigma = _inherited(known, before, length)
    G = np.zeros((3, 12))
    G[:, PHI], G[:, BG] = np.eye(3), before.C_nb[-1] @ before.dR_dbg[-1]
    P = G @ before.fit.P @ G.T + np.eye(3) * known.noise.gyro_rps_rthz**2 * length
    return _piece(known, rows, _followed(known, rows, _Prior(bias, sigma, before.C_nb[-1], P)), before.way)


def _previous(known: _Known, rows: IntArray, after: _Piece) -> _Piece:
    """The window before a solved one."""
    length = float(known.t[rows[-1]] - known.t[rows[0]])
    bias, sigma = _inherited(known, after, length)
    turn = _piece(known, rows, _Fit(np.eye(3), np.zeros(3), bias, 0.0, after.fit.P), after.way)
    R = exp_so3(known.frame.w_ie_n * length) @ after.fit.R @ turn.dR[-1].T
    G = np.zeros((3, 12))
    G[:, PHI], G[:, BG] = np.eye(3), -after.fit.R @ turn.dR_dbg[-1]
    P = G @ after.fit.P @ G.T + np.eye(3) * known.noise.gyro_rps_rthz**2 * length
    return _piece(known, rows, _followed(known, rows, _Prior(bias, sigma, R, P)), after.way)


def _followed(known: _Known, rows: IntArray, prior: _Prior) -> _Fit:
    """A window solved from the attitude that a neighbour hands over."""
    assert prior.R is not None
    window = _Window(known, rows, SIGMA_MPS)
    fit = window.linearised(prior.bias).solve(prior, prior.R, prior.bias)
    sigma = _rescaled(window, fit)
    if abs(np.log(sigma / SIGMA_MPS)) > 0.2:
        window = _Window(known, rows, sigma)
    return _again(window, fit, prior)


def _joined(known: _Known, pieces: list[_Piece], heading: tuple[float, float] | None) -> Alignment:
    K = len(known.t)
    C_nb, bias = np.empty((K, 3, 3)), np.empty((K, 6))
    for piece in pieces:
        C_nb[piece.rows], bias[piece.rows] = piece.C_nb, piece.fit.bias
    first = pieces[0]
    sigma = np.sqrt(np.diag(first.fit.P)[PHI])
    if first.way == "levelling":
        sigma = np.array([sigma[0], sigma[1], WIDEST_RAD[2]])
    if heading is not None and abs(float(wrapped(_heading(C_nb[0]) - heading[0]))) > 4 * np.hypot(heading[1], sigma[2]):
        heading = None
    return Alignment(C_nb, bias, first.way, sigma, heading)
