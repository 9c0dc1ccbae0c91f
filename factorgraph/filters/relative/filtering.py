"""The relative filter: prediction, extended Kalman update, and what a corrector makes of it.

    1 predict      x, P <- motion                         2 - 4 update with all rows of the epoch, distances linearised at x
    5 judge, 6 accept, 7 correct                          a `Correct` sees prior, posterior and rows, and may replace the state

The corrector is any callable; the judgement rule and the swarm optimisers of Lu et al. (2024) are one. A strong tracking factor
on what the transition brings is the control that needs neither.

Source: Lu et al. (2024), section 3.5; spec ahrs_tdo.md, sections 2.7 and 2.8.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from factorgraph.filters import kalman
from factorgraph.filters.adaptive import Fading
from factorgraph.filters.relative.motion import Motion, position, velocity
from factorgraph.filters.relative.rows import Rows, Source, stacked
from factorgraph.types import Array, BoolArray, IntArray


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
    strong_tracking: bool = False
    observe: Callable[[int, Update], None] | None = None  # sees every update


def run(
    motion: Motion, sources: Sequence[Source], t_s: Array, start: tuple[Array, Array], options: Options | None = None
) -> RelativeTrack:
    """Filter a formation over epochs t_s (K,).

    start: followers' velocities and positions (6 M,) at the first epoch, v_1 r_1 v_2 .., with their covariance (6 M, 6 M).
    """
    options = options or Options()
    n, m = motion.size, 6 * motion.n_followers
    x, P = np.zeros(n), np.zeros((n, n))
    x[:m], P[:m, :m], P[m:, m:] = start[0], start[1], motion.start()
    K, fading = len(t_s), Fading()
    states, covariances = np.zeros((K, n)), np.zeros((K, n, n))
    nis_of, statistic, threshold = np.full((3, K), np.nan)
    n_rows, triggered = np.zeros(K, np.int64), np.zeros(K, bool)
    Phi, Q = np.eye(n), np.zeros((n, n))
    for k in range(K):
        if k:
            x, Phi, Q = motion.predict(k, x)
        parts = [rows for source in sources if (rows := source.rows(k, x)) is not None]
        moved = P if k == 0 else kalman.predict(P, Phi, np.zeros((n, n)))
        if not parts:
            P = moved + Q if k else P
        else:
            rows = stacked(parts)
            nu, H = rows.linearised(x)
            if options.strong_tracking and k:
                factor, fading = _fading(fading, moved, Q, nu, H, rows.R)
                moved = factor * moved
            prior = moved + Q if k else P
            dx, P_post, nis = kalman.update_sequential(prior, nu, H, rows.R)
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


def _fading(state: Fading, moved: Array, Q: Array, nu: Array, H: Array, R: Array) -> tuple[float, Fading]:
    """The factor on what the transition brings, of rows whitened by R."""
    y, W = kalman.whiten(nu, H, R)
    return state.step(y, float(np.einsum("mi,ij,mj->", W, Q, W)), float(np.einsum("mi,ij,mj->", W, moved, W)), float(len(y)))
