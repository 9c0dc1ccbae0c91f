"""Float double-difference ambiguities from code and phase: one epoch alone, filtered, aided by inertial, robust, adaptive.

    scheme    dynamics   baseline of the INS   code              predicted state
    WLS       none       no                    as it is          -
    EKF       yes        no                    as it is          as it is
    IEKF      yes        observed              as it is          as it is
    IBRKF     yes        observed              IGG-III bifactor  as it is
    IBRCAF    yes        observed              IGG-III bifactor  classified factors

State of the filters: baseline, its velocity and acceleration (constant-acceleration model driven by white noise), and m
double-difference ambiguities in cycles (random walk), in total quantities, observed through

    DD P - DD rho(x_lin) + G b_lin   =  G b            + noise,  R_P
    DD Phi - DD rho(x_lin) + G b_lin =  G b + lam N    + noise,  R_Phi
    b_ins                            =  b              + noise,  R_ins

linearised at x_lin, the INS baseline or the filter's own prediction. {P, ins} is taken first, then {Phi}. The frame is n,
which is at rest in ECEF: the models are the same in both.

Source: spec aar_two_stage.md, sections 2.3 to 2.5, errata E9 to E14.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import Literal

import numpy as np
from numba import njit

from ambiguity import DoubleDifferences, follow
from factorgraph.errors import InputError, not_negative, positive
from factorgraph.filters import adaptive, kalman
from factorgraph.filters.adaptive import Statistic
from factorgraph.filters.layout import Layout
from factorgraph.filters.motion import constant_acceleration
from factorgraph.models import double_differences as dd
from factorgraph.models.double_differences import PairEpochs
from factorgraph.models.robust import bifactor, igg3
from factorgraph.types import Array, IntArray

MOTION = Layout(baseline=3, velocity=3, acceleration=3)
BASE, RATE = MOTION["baseline"], MOTION["velocity"]
CLASS_1, N0 = slice(0, MOTION.size), MOTION.size
START_SIGMA = np.repeat([100.0, 200.0, 5.0], 3)  # m, m/s, m/s^2: knows nothing
NEW_CYC = 30.0  # standard deviation of an ambiguity started from phase minus code
WLS_STEPS = 2


class Scheme(Enum):
    """What a float-ambiguity estimator uses."""

    WLS = "WLS"
    EKF = "EKF"
    IEKF = "IEKF"
    IBRKF = "IBRKF"
    IBRCAF = "IBRCAF"

    @property
    def has_ins(self) -> bool:
        return self in (Scheme.IEKF, Scheme.IBRKF, Scheme.IBRCAF)

    @property
    def is_robust(self) -> bool:
        return self in (Scheme.IBRKF, Scheme.IBRCAF)


@dataclass(frozen=True, slots=True)
class FloatSettings:
    """Tuning of the filters. Source: spec aar_two_stage.md, sections 2.5 and 3."""

    code_m: float  # undifferenced standard deviation factor: sigma^2 = sigma0^2 (1 + 1 / sin^2 el)
    phase_m: float
    accel_walk: float = 1.0  # m/s^2 per sqrt(s)
    ambiguity_walk: float = 1.5  # cycles per sqrt(s): hardly any memory
    c0: float = 1.5  # IGG-III: kept below
    c1: float = 4.5  # rejected above
    c2: float = 2.0  # classified factors: kept below
    statistic: Statistic = "literal"
    code_statistic: Literal["predicted", "postfit"] = "predicted"
    passes: int = 1  # at most, of the robust update
    full_noise: bool = False  # with what the noise of the acceleration does to position and velocity within a step

    def __post_init__(self) -> None:
        positive(self, "code_m", "phase_m", "c2")
        not_negative(self, "accel_walk", "ambiguity_walk")
        if not 0 < self.c0 < self.c1:
            raise InputError(f"FloatSettings: c0 must lie between 0 and c1, got {self.c0} and {self.c1}")
        if self.passes < 1:
            raise InputError(f"FloatSettings.passes must be at least 1, got {self.passes}")


@dataclass(frozen=True, slots=True)
class InsBaseline:
    """What the inertial navigator predicts, before this epoch's observations."""

    b_n: Array  # (3,)
    R: Array  # (3, 3)


@dataclass(frozen=True, slots=True)
class FloatSolution:
    """Float ambiguities and baseline of one epoch, with everything about their covariance."""

    order: IntArray  # (m + 1,) satellites, the pivot first
    a_cyc: Array  # (m,)
    Q_a: Array  # (m, m) [cyc^2]
    b_n: Array  # (3,)
    Q_b: Array  # (3, 3)
    Q_ba: Array  # (3, m)
    weights: Array  # (m,) factors on the weights of the codes; 1 unless robust
    factors: tuple[float, float]  # on the predicted motion and ambiguities; 1 unless adaptive


@dataclass(frozen=True, slots=True)
class _Epoch:
    """Observations of one epoch against its pivot."""

    order: IntArray
    sat_a: Array
    sat_b: Array
    zero: Array  # velocities of satellites, which ranges do not need
    code: Array  # (m,)
    phase: Array
    R_code: Array
    R_phase: Array
    lam: float
    r_a: Array

    def predict(self, b: Array) -> tuple[Array, Array]:
        """DD ranges (m,) and geometry rows (m, 3) at a baseline."""
        still = np.zeros(3)
        rho, _, G = dd.predict(self.sat_a, self.sat_b, self.zero, self.zero, self.order, self.r_a, still, self.r_a + b, still)
        return rho, G


def _epoch(data: PairEpochs, k: int, order: IntArray, r_reference: Array, settings: FloatSettings) -> _Epoch:
    scale = data.variance_scale[k]
    return _Epoch(
        order,
        data.sat_reference[k],
        data.sat_rover[k],
        np.zeros_like(data.sat_rover[k]),
        dd.difference(data.code_m[k], order),
        dd.difference(data.phase_m[k], order),
        dd.covariance(settings.code_m**2 * scale, order),
        dd.covariance(settings.phase_m**2 * scale, order),
        data.wavelength_m,
        r_reference,
    )


def single_epoch(data: PairEpochs, k: int, r_reference: Array, settings: FloatSettings, b_start: Array) -> FloatSolution | None:
    """Weighted least squares of baseline and ambiguities from one epoch alone; None with fewer than four satellites."""
    order = data.order(k)
    if len(order) < 4:
        return None
    e = _epoch(data, k, order, r_reference, settings)
    W = np.linalg.inv(e.R_code)
    b = b_start
    for _ in range(WLS_STEPS):
        rho, G = e.predict(b)
        Q_b = np.asarray(np.linalg.inv(G.T @ W @ G))
        b = b + Q_b @ (G.T @ (W @ (e.code - rho)))
    rho, G = e.predict(b)
    # the phase adds as many unknowns as rows: it only sees the ambiguities
    a = (e.phase - rho) / e.lam
    GQ = G @ Q_b
    Q_a = (e.R_phase + GQ @ G.T) / e.lam**2
    return FloatSolution(order, a, 0.5 * (Q_a + Q_a.T), b, Q_b, -GQ.T / e.lam, np.ones(len(a)), (1.0, 1.0))


@njit(cache=True)
def _time_update(x: Array, P: Array, dt: float, accel_walk: float, ambiguity_walk: float, full: bool) -> tuple[Array, Array]:
    n, k = len(x), N0
    Phi, Q = np.eye(n), np.zeros((n, n))
    Phi[:k, :k], Q[:k, :k] = constant_acceleration(dt, accel_walk, full)
    for i in range(k, n):
        Q[i, i] = dt * ambiguity_walk**2
    return Phi @ x, kalman.predict(P, Phi, Q)


class FloatFilter:
    """The filtering schemes; one `step` per epoch, in order. Satellites may come, go and slip, the pivot may change."""

    def __init__(self, scheme: Scheme, settings: FloatSettings) -> None:
        if scheme is Scheme.WLS:
            raise ValueError("WLS has no state to filter: use single_epoch")
        self.scheme, self.settings = scheme, settings
        self._x, self._P = np.zeros(0), np.zeros((0, 0))
        self._order, self._arc, self._t = np.zeros(0, np.int64), np.zeros(0, np.int64), np.nan

    def step(
        self, data: PairEpochs, k: int, r_reference: Array, ins: InsBaseline | None = None, disturbance: Array | None = None
    ) -> FloatSolution | None:
        """Take epoch k; None with fewer than four satellites, when the state is only predicted.

        r_reference (3,): the reference antenna in n. ins: needed by the aided schemes. disturbance (3,): added to the
        predicted velocity, to study faults of the model.
        """
        if self.scheme.has_ins and ins is None:
            raise ValueError(f"{self.scheme.value} needs the baseline of the INS")
        arc = data.arc[k]
        unknown = np.flatnonzero(arc != self._arc) if len(self._arc) else None  # broken or new: a pivot that resets all others
        order = data.order(k, avoid=unknown)
        t = float(data.t_rover_s[k])
        if len(order) < 4:
            self._predict(t, disturbance)
            return None
        e = _epoch(data, k, order, r_reference, self.settings)
        if not len(self._x):
            self._start(data, k, r_reference, ins)
        self._predict(t, disturbance)
        self._carry(e, arc)
        out = self._update(e, ins if self.scheme.has_ins else None)
        self._order, self._arc, self._t = order, np.where(data.usable[k], arc, -1), t
        return out

    def _start(self, data: PairEpochs, k: int, r_reference: Array, ins: InsBaseline | None) -> None:
        if ins is not None and self.scheme.has_ins:
            b = ins.b_n
        else:
            first = single_epoch(data, k, r_reference, self.settings, np.zeros(3))
            assert first is not None
            b = first.b_n
        self._x = np.concatenate([b, np.zeros(6)])
        self._P = np.diag(START_SIGMA**2)
        self._t = float(data.t_rover_s[k])

    def _predict(self, t: float, disturbance: Array | None) -> None:
        if not len(self._x):
            return
        dt = t - self._t
        if dt > 0:
            s = self.settings
            self._x, self._P = _time_update(self._x, self._P, dt, s.accel_walk, s.ambiguity_walk, s.full_noise)
            self._t = t
        if disturbance is not None:
            self._x[RATE] += disturbance

    def _carry(self, e: _Epoch, arc: IntArray) -> None:
        """Express the ambiguities against this epoch's pivot; those that are new or slipped start from phase minus code."""
        old = self._order
        slipped = old[arc[old] != self._arc[old]]
        if len(old) and not len(slipped) and np.array_equal(old, e.order):
            return
        after = DoubleDifferences(int(e.order[0]), tuple(e.order[1:].tolist()))
        if len(old):
            before = DoubleDifferences(int(old[0]), tuple(old[1:].tolist()))
            step = follow(before, after, slipped.tolist())
            T, fresh = step.T, step.fresh
        else:
            T, fresh = np.zeros((len(after.satellites), 0), np.int64), np.ones(len(after.satellites), bool)
        M = np.zeros((N0 + len(T), len(self._x)))
        M[CLASS_1, CLASS_1] = np.eye(N0)
        M[N0:, N0:] = T
        self._x, self._P = M @ self._x, M @ self._P @ M.T
        new = N0 + np.flatnonzero(fresh)
        self._x[new] = ((e.phase - e.code) / e.lam)[fresh]
        self._P[new, new] = NEW_CYC**2

    def _update(self, e: _Epoch, ins: InsBaseline | None) -> FloatSolution:
        x_p, P_p, s = self._x, self._P, self.settings
        b_lin = x_p[BASE].copy() if ins is None else ins.b_n
        rho, G = e.predict(b_lin)
        offset = rho + G @ (x_p[BASE] - b_lin)  # predicted without ambiguities
        nu_code, nu_phase = e.code - offset, e.phase - offset - e.lam * x_p[N0:]
        P_bar = P_p
        x, P = _two_blocks(x_p, P_bar, G, e.lam, nu_code, nu_phase, e.R_code, e.R_phase, ins)
        weights, gammas = np.ones(len(nu_code)), (1.0, 1.0)
        for _ in range(s.passes if self.scheme.is_robust else 0):
            found = self._factors(x, P, P_bar, e, G, nu_code)
            if found[0].min() == 1.0 and min(found[1]) == 1.0:
                break
            weights, gammas = found
            R = bifactor(e.R_code, weights)
            P_bar = adaptive.classified(P_p, [(CLASS_1, gammas[0]), (slice(N0, None), gammas[1])])
            x, P = _two_blocks(x_p, P_bar, G, e.lam, nu_code, nu_phase, R, e.R_phase, ins)
        self._x, self._P = x, P
        return FloatSolution(e.order, x[N0:], P[N0:, N0:], x[BASE], P[BASE, BASE], P[BASE, N0:], weights, gammas)

    def _factors(self, x: Array, P: Array, P_p: Array, e: _Epoch, G: Array, nu_code: Array) -> tuple[Array, tuple[float, float]]:
        """Factors on the codes' weights (m,) and on the two classes of the predicted state."""
        s, x_p = self.settings, self._x
        d = x - x_p
        if s.code_statistic == "predicted":
            spread = np.einsum("ij,jk,ik->i", G, P_p[BASE, BASE], G) + np.diag(e.R_code)
            t = nu_code / np.sqrt(spread)
        else:
            spread = np.diag(e.R_code) - np.einsum("ij,jk,ik->i", G, P[BASE, BASE], G)
            t = (nu_code - G @ d[BASE]) / np.sqrt(np.maximum(spread, 1e-12))
        weights = igg3(t, s.c0, s.c1)
        if self.scheme is not Scheme.IBRCAF:
            return weights, (1.0, 1.0)
        gamma_1, gamma_2 = (
            adaptive.factor(adaptive.correction_statistic(d[c], P_p[c, c], P[c, c], s.statistic), s.c2)
            for c in (CLASS_1, slice(N0, None))
        )
        return weights, (gamma_1, gamma_2)


def _two_blocks(
    x_p: Array,
    P_p: Array,
    G: Array,
    lam: float,
    nu_code: Array,
    nu_phase: Array,
    R_code: Array,
    R_phase: Array,
    ins: InsBaseline | None,
) -> tuple[Array, Array]:
    nu_ins, R_ins = (np.zeros(3), np.zeros((3, 3))) if ins is None else (ins.b_n - x_p[BASE], ins.R)
    return _two_blocks_kernel(x_p, P_p, G, lam, nu_code, nu_phase, R_code, R_phase, ins is not None, nu_ins, R_ins)


@njit(cache=True)
def _two_blocks_kernel(
    x_p: Array, P_p: Array, G: Array, lam: float, nu_code: Array, nu_phase: Array, R_code: Array, R_phase: Array,
    has_ins: bool, nu_ins: Array, R_ins: Array,
) -> tuple[Array, Array]:  # fmt: skip
    """Update with {code, ins}, then {phase}."""
    n, m = len(x_p), len(nu_code)
    rows = m + 3 if has_ins else m
    nu, H, R = np.zeros(rows), np.zeros((rows, n)), np.zeros((rows, rows))
    nu[:m] = nu_code
    H[:m, :3] = G
    R[:m, :m] = R_code
    if has_ins:
        nu[m:] = nu_ins
        for i in range(3):
            H[m + i, i] = 1.0
        R[m:, m:] = R_ins
    dx, P, _ = kalman.update_sequential(P_p, nu, H, R)
    H2 = np.zeros((m, n))
    H2[:, :3] = G
    for i in range(m):
        H2[i, N0 + i] = lam
    dx2, P2, _ = kalman.update_sequential(P, nu_phase - H2 @ dx, H2, R_phase)
    return x_p + dx + dx2, P2
