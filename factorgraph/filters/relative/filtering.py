"""The relative filter: prediction, extended Kalman update, and what a corrector makes of it.

    1 predict      x, P <- motion                         2 - 4 update with all rows of the epoch, distances linearised at x
    5 judge, 6 accept, 7 correct                          a `Correct` sees prior, posterior and rows, and may replace the state

The corrector is any callable; the judgement rule and the swarm optimisers of Lu et al. (2024) are one. A strong tracking factor
on what the transition brings is the control that needs neither. Where ranges alone place vehicles a few metres apart, distances
bend within the prior's covariance: an iterated update linearises them again where it leads. Losses weigh ranges and heights by
their standardised innovations; double differences are correlated and are not weighed.

Source: Lu et al. (2024), section 3.5; spec ahrs_tdo.md, sections 2.7 and 2.8.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal, Protocol

import numpy as np
from scipy.linalg import solve_triangular

from factorgraph.filters import kalman, updates
from factorgraph.filters.adaptive import Fading
from factorgraph.filters.relative.motion import Motion, position, velocity
from factorgraph.filters.relative.rows import KINDS, Rows, Source, stacked
from factorgraph.models.robust import Loss
from factorgraph.models.robust import weight as robust_weight
from factorgraph.types import Array, BoolArray, IntArray

Form = Literal["linear", "iterated"]
WEIGHED = ("range", "height")  # kinds whose rows are independent
LEAST = 1e-6  # weight
SHOWS = 0.1  # of the noise: second order that an update is iterated for


@dataclass(frozen=True, slots=True)
class Update:
    """One measurement update; the names are those of `swarm.Snapshot`."""

    x_prior: Array  # (n,)
    P_prior: Array  # (n, n)
    x_post: Array
    P_post: Array
    rows: Rows
    H: Array  # (m, n) linearised at the prior


class Replaced(Protocol):
    """What a corrector returns."""

    @property
    def x(self) -> Array: ...
    @property
    def P(self) -> Array: ...
    @property
    def triggered(self) -> bool: ...
    @property
    def statistic(self) -> float: ...
    @property
    def threshold(self) -> float: ...


Correct = Callable[[Update], Replaced]


@dataclass(frozen=True, slots=True)
class RelativeTrack:
    """A filtered formation: K epochs, n states."""

    t_s: Array  # (K,)
    x: Array  # (K, n)
    P: Array  # (K, n, n)
    n_followers: int
    nis: Array  # (K,) NaN without rows
    n_rows: IntArray  # (K,)
    triggered: BoolArray  # (K,) the corrector replaced the state
    statistic: Array  # (K,) of the judgement, NaN without a corrector or rows
    threshold: Array  # (K,)

    def pair(self, a: int, b: int) -> tuple[Array, Array, Array]:
        """Position and velocity (K, 3) of vehicle b less vehicle a, the reference 0, ECEF; P (K, 6, 6), position first."""
        A = np.zeros((6, self.x.shape[1]))
        for vehicle, sign in ((b, 1.0), (a, -1.0)):
            if vehicle > 0:
                A[:3, position(vehicle - 1)] += sign * np.eye(3)
                A[3:, velocity(vehicle - 1)] += sign * np.eye(3)
        both = self.x @ A.T
        return both[:, :3], both[:, 3:], A @ self.P @ A.T


@dataclass(frozen=True, slots=True)
class Options:
    """How updates are made."""

    correct: Correct | None = None
    update: Form = "linear"
    losses: Mapping[str, Loss] = field(default_factory=dict)  # by kind of measurement
    strong_tracking: bool = False
    constants: tuple[float, ...] = ()  # standard deviations of constants behind the states: scales and biases of ranges
    observe: Callable[[int, Update], None] | None = None  # sees every update


def run(
    motion: Motion, sources: Sequence[Source], t_s: Array, start: tuple[Array, Array], options: Options | None = None
) -> RelativeTrack:
    """Filter a formation over epochs t_s (K,).

    start: followers' velocities and positions (6 M,) at the first epoch, v_1 r_1 v_2 .., with their covariance (6 M, 6 M).
    """
    options = options or Options()
    moving, m = motion.size, 6 * motion.n_followers
    n = moving + len(options.constants)
    x, P = np.zeros(n), np.zeros((n, n))
    x[:m], P[:m, :m], P[m:moving, m:moving] = start[0], start[1], motion.start()
    P[moving:, moving:] = np.diag(np.square(options.constants))
    K, fading = len(t_s), Fading()
    states, covariances = np.zeros((K, n)), np.zeros((K, n, n))
    nis_of, statistic, threshold = np.full((3, K), np.nan)
    n_rows, triggered = np.zeros(K, np.int64), np.zeros(K, bool)
    Phi, Q, nothing = np.eye(n), np.zeros((n, n)), np.zeros((n, n))  # what the first epoch is carried by
    for k in range(K):
        x = x.copy()
        if k:
            x[:moving], Phi[:moving, :moving], Q[:moving, :moving] = motion.predict(k, x[:moving])
        parts = [rows for source in sources if (rows := source.rows(k, x)) is not None]
        moved = kalman.predict(P, Phi, nothing)
        if not parts:
            P = moved + Q
        else:
            rows = stacked(parts)
            nu, H = rows.linearised(x)
            rows = _weighed(rows, nu, H, moved + Q, options.losses)
            if options.strong_tracking and k:
                factor, fading = _fading(fading, moved, Q, nu, H, rows.R)
                moved = factor * moved
            prior = moved + Q
            dx, P_post, nis = _corrected(options.update, prior, x, rows, nu, H)
            update = Update(x, prior, x + dx, P_post, rows, H)
            if options.observe is not None:
                options.observe(k, update)
            x, P, nis_of[k], n_rows[k] = update.x_post, P_post, nis, len(nu)
            if options.correct is not None:
                made = options.correct(update)
                x, P = made.x, made.P
                triggered[k], statistic[k], threshold[k] = made.triggered, made.statistic, made.threshold
        states[k], covariances[k] = x, P
    return RelativeTrack(t_s, states, covariances, motion.n_followers, nis_of, n_rows, triggered, statistic, threshold)


def _weighed(rows: Rows, nu: Array, H: Array, P: Array, losses: Mapping[str, Loss]) -> Rows:
    """Rows of ranges and heights with the variance that their innovations ask for."""
    told = [name for name in WEIGHED if name in losses and np.any(rows.kind == KINDS.index(name))]
    if not told:
        return rows
    R = rows.R.copy()
    for name in told:
        mine = np.flatnonzero(rows.kind == KINDS.index(name))
        variance = np.einsum("mi,ij,mj->m", H[mine], P, H[mine]) + R[mine, mine]
        R[mine, mine] /= np.maximum(robust_weight(losses[name], nu[mine] / np.sqrt(variance)), LEAST)
    return replace(rows, R=R)


def _bends(P: Array, x: Array, rows: Rows) -> bool:
    """Whether a distance's second order, the variance across it over twice its length, shows beside its noise."""
    if not len(rows.norm_rows):
        return False
    size = np.linalg.norm(rows.norm_D @ x + rows.norm_d, axis=1)
    spread = np.einsum("qan,nm,qam->q", rows.norm_D, P, rows.norm_D, optimize=True)
    noise = np.sqrt(np.diag(rows.R)[rows.norm_rows])
    return bool(np.any(spread > 2.0 * SHOWS * noise * size))


def _corrected(form: Form, P: Array, x: Array, rows: Rows, nu: Array, H: Array) -> tuple[Array, Array, float]:
    """Correction (n,), posterior covariance (n, n) and normalised innovation squared."""
    if form == "linear" or not _bends(P, x, rows):
        dx, posterior, nis = kalman.update_sequential(P, nu, H, rows.R)
        return dx, posterior, nis
    L = np.linalg.cholesky(rows.R)
    free = np.flatnonzero(np.diag(P) > 0.0)  # a reference that stands still has no errors

    def linearise(d: Array) -> tuple[Array, Array]:
        at = x.copy()
        at[free] += d
        at_nu, at_H = rows.linearised(at)
        return solve_triangular(L, at_nu, lower=True), solve_triangular(L, at_H[:, free], lower=True)

    square = np.ix_(free, free)
    u = updates.iterated(P[square], linearise)
    dx, posterior = np.zeros(len(x)), np.zeros_like(P)
    dx[free], posterior[square] = u.dx, u.P
    return dx, posterior, u.nis


def _fading(state: Fading, moved: Array, Q: Array, nu: Array, H: Array, R: Array) -> tuple[float, Fading]:
    """The factor on what the transition brings, of rows whitened by R."""
    y, W = kalman.whiten(nu, H, R)
    return state.step(y, float(np.einsum("mi,ij,mj->", W, Q, W)), float(np.einsum("mi,ij,mj->", W, moved, W)), float(len(y)))
