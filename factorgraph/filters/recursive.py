"""Recursive estimation of any flight: a filter over the stages of the assembled problem, and a smoother on top.

Errors are those of an error-state filter (ESKF): attitude turned on the right, position along body axes.

Stages of a window are evaluated together at states carried without measurements from the last corrected one; windows are
single stages while corrections are large and grow to `WINDOW` while they stay small (`CALM`). The filter's covariances, or the
smoother's, take the place of an eliminated problem's in `assembly.result`; residuals are those that each update left.

Source: Rauch, Tung and Striebel (1965) for the smoother; for the kinds of updates `filters.updates` and `filters.adaptive`.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import ClassVar

import numpy as np

from factorgraph.assembly.blocks import KINDS
from factorgraph.assembly.build import Built
from factorgraph.assembly.flight import WholeFlight
from factorgraph.assembly.optimizer import Graph, Result
from factorgraph.assembly.result import make_solution
from factorgraph.filters import adaptive, updates
from factorgraph.filters.adaptive import Fading, Level, NoiseLevels
from factorgraph.filters.course import ChainEngine, Stage, Track, joint, smooth_values
from factorgraph.filters.sequential import StageRows, Stages
from factorgraph.filters.updates import Updated
from factorgraph.problem import NavigationProblem
from factorgraph.registry import Progress
from factorgraph.solution import Solution, Status
from factorgraph.types import Array

WINDOW = 8  # stages at most
CALM = (1e-3, 5.0, 0.1)  # rad, m, m/s: deviations in a window that let the next one grow; 0.2 mm of a baseline


class Corrector:
    """One kind of update; those that adapt remember between stages."""

    def inflation(self, P: Array, moved: Array, Q: Array, rows: StageRows, e: Array) -> Array:
        """Predicted covariance (n, n), from what the transition brings (`moved`) and its noise."""
        return moved + Q

    def update(self, P: Array, e: Array, rows: StageRows) -> Updated:
        """Correct with innovations e (m,) of a stage's rows."""
        return updates.linear(P, e, rows.H)


class Huber(Corrector):
    """Rows and prior reweighted by their residuals."""

    def update(self, P: Array, e: Array, rows: StageRows) -> Updated:
        return updates.regression(P, e, rows.H)


class RobustFading(Corrector):
    """Rows in question weighted, then the prior divided."""

    def update(self, P: Array, e: Array, rows: StageRows) -> Updated:
        return updates.robust_fading(P, e, rows.H, updates.huber_weight, lost=rows.clocks, least=0.1)


class StrongTracking(Corrector):
    """What the transition brings multiplied by a factor of the innovations."""

    def __init__(self) -> None:
        self.state = Fading()

    def inflation(self, P: Array, moved: Array, Q: Array, rows: StageRows, e: Array) -> Array:
        H = rows.H
        HQH, HPH = (float(np.einsum("mi,ij,mj->", H, X, H, optimize=True)) for X in (Q, moved))
        factor, self.state = self.state.step(e, HQH, HPH, float(max(rows.dof, 1)))
        return factor * moved + Q


class Adaptive(Corrector):
    """Noise levels of the kinds of measurements followed."""

    def __init__(self, level: Level, residual: bool, n_kinds: int) -> None:
        self.levels, self.residual = NoiseLevels(level, n_kinds + 1), residual

    def update(self, P: Array, e: Array, rows: StageRows) -> Updated:
        factors = self.levels.factors
        factors[-1] = 1.0  # of processes, which are no measurements
        scale = np.sqrt(factors[rows.kind])
        u = updates.linear(P, e / scale, rows.H / scale[:, None])
        share = rows.share
        if self.residual:
            sample = adaptive.residual_samples(e - rows.H @ u.dx, rows.H, u.P)
        else:  # innovations say less of the noise the less the state is known: inverse of their squares' variance
            sample = adaptive.innovation_samples(e, rows.H, P)
            weight = 1 / (1 + np.einsum("mi,ij,mj->m", rows.H, P, rows.H, optimize=True)) ** 2
            sample, share = weight * sample, weight * share
        self.levels.add(sample, np.where(rows.kind < 0, self.levels.n_classes - 1, rows.kind), share)
        return u


def run(graph: Graph, corrector: Corrector, progress: Callable[[float], None] = lambda f: None) -> Track:
    """Filter a flight from the first state's prior; the problem's variables are left at the filtered values."""
    s = Stages(graph)
    track = Track(s)
    for v in s.vehicles:
        v.r, v.v, v.R, v.bias = (x.copy() for x in (v.r, v.v, v.R, v.bias))
    d, P = s.start()
    s.move(0, d[None, : s.n_states])
    s.move_parameters(d)
    d[:] = 0.0
    live: list[int] = []
    T = same = np.eye(s.n_states)
    a, size = 0, 1
    while a < s.K:
        b = min(a + size, s.K)
        before = max(a - 1, 0)
        s.carry(before, b)
        F, Q = s.transitions(before, b)
        deviations = []
        for k, rows in zip(range(a, b), s.rows(a, b), strict=True):
            step, noise = joint(s, live, k, F[k - before - 1] if k else None, Q[k - before - 1] if k else None)
            _leave(s, live, s.live[k], d)
            step[:, : s.n_states] = step[:, : s.n_states] @ T
            d = step @ d
            e = rows.e - rows.H @ d
            prior = corrector.inflation(P, step @ P @ step.T, noise, rows, e)
            u = corrector.update(prior, e, rows)
            judged, dof = _judged(rows, prior, e, len(set(s.live[k]) - set(live)))
            T = same
            track.course.append(Stage(u.dx, u.P, T, prior, step, noise, judged, dof))
            _keep(track, rows, e - rows.H @ u.dx, u.weights)
            d, P, live = d + u.dx, u.P, s.live[k]
            deviations.append(d[: s.n_states])
        D = np.array(deviations)
        for k, T in zip(range(a, b), s.transport(D), strict=True):
            track.course[k].T = T
        s.move(a, D)
        s.move_parameters(d)
        s.move_scalars(live, d)
        d = np.zeros(len(d))
        size = min(2 * size, WINDOW) if _is_calm(s, D) else 1
        a = b
        progress(a / s.K)
    return track


def _leave(s: Stages, live: Sequence[int], now: Sequence[int], d: Array) -> None:
    """Scalars that end keep what was found."""
    stay = set(now)
    gone = [i for i, key in enumerate(live) if key not in stay]
    for i in gone:
        x = s.scalars[live[i]]
        x.values[x.index] += d[s.n_fixed + i]


def _judged(rows: StageRows, prior: Array, e: Array, new: int) -> tuple[float, float]:
    """Normalised innovation squared of rows that are judged, and its expectation; scalars that are new explain a row each."""
    mine = rows.judged
    if not np.any(mine):
        return 0.0, 0.0
    H, nu = rows.H[mine], e[mine]
    S = H @ prior @ H.T + np.eye(len(nu))
    return float(nu @ np.linalg.solve(S, nu)), float(max(len(nu) - rows.judged_clocks - new, 0))


def _keep(track: Track, rows: StageRows, left: Array, weights: Array | None) -> None:
    """Residuals of the blocks' rows, unwhitened."""
    done = 0
    for number, i, j in rows.at:
        block = track.stages.graph.blocks[number]
        y = track.y.setdefault(number, np.zeros(block.n))
        own = slice(done, done + j - i)
        y[i:j] = left[own] * block.rows.sigma[i:j]
        if weights is not None:
            track.w.setdefault(number, np.ones(block.n))[i:j] = weights[own]
        done += j - i


def _is_calm(s: Stages, D: Array) -> bool:
    for v in s.vehicles:
        x = np.abs(D[:, s.offset[v.index] :]).max(axis=0)
        parts = (x[:3], x[3:6], x[6:9]) if v.mode == "imu" else (np.zeros(3), x[:3], x[3:6])
        if any(float(part.max()) > most for part, most in zip(parts, CALM, strict=True)):
            return False
    return True


class Recursive:
    """A filter over a flight, forward once; with `smoothed`, back once. Subclasses name the update."""

    method: ClassVar[str] = "eskf"
    summary: ClassVar[str] = "error-state Kalman filter, forward in time"
    smoothed: ClassVar[bool] = False

    def corrector(self) -> Corrector:
        """A new one for a flight."""
        return Corrector()

    def solve(self, problem: NavigationProblem, progress: Progress) -> Solution:
        """Solve a problem; ambiguities stay float. Raises InputError for what cannot be estimated."""
        built, notes, spent = WholeFlight(self.method, ChainEngine).started(problem, progress)
        began = time.perf_counter()
        progress("filter", 0.3)
        track = run(built.graph, self.corrector(), lambda f: progress("filter", 0.3 + 0.5 * f))
        if self.smoothed:
            progress("smoother", 0.8)
            smooth_values(track)
        spent[self.method] = time.perf_counter() - began
        return solution_of(problem, self.method, built, track, spent, [*notes, *left_out(track)], self.smoothed)


def left_out(track: Track) -> list[str]:
    """What the filter could not use."""
    return [f"left out: {what}" for what in track.stages.left_out]


def solution_of(
    problem: NavigationProblem, method: str, built: Built, track: Track, spent: dict[str, float], notes: list[str], smoothed: bool
) -> Solution:
    """The solution at a track's values; NIS and residuals are the innovations' and what updates left, or a smoothed flight's."""
    graph = built.graph
    graph.assemble()
    graph.engine = ChainEngine(track)
    graph.predict()
    for number, y in track.y.items() if not smoothed else ():
        graph.blocks[number].y = y
    for number, w in track.w.items():
        graph.blocks[number].w = w
    solution = make_solution(problem, method, built, Result(Status.CONVERGED, [0.0]), np.nan, spent, notes)
    if smoothed:
        return solution
    nis, dof = np.array([c.nis for c in track.course]), np.array([c.dof for c in track.course])
    seen = dof > 0
    of_filter = replace(solution.diagnostics, nis_t_s=track.stages.t_s[seen], nis=nis[seen], nis_dof=dof[seen])
    return replace(solution, diagnostics=of_filter)


class Smoothed(Recursive):
    """The error-state filter, smoothed."""

    method, summary, smoothed = "eskf-rts", "error-state Kalman filter and Rauch-Tung-Striebel smoother", True


class StrongTrackingFilter(Recursive):
    """The strong tracking filter."""

    method, summary = "strong-tracking", "error-state filter with a fading factor from its innovations"

    def corrector(self) -> Corrector:
        return StrongTracking()


class HuberFilter(Recursive):
    """Robust regression of rows and prior."""

    method, summary = "huber", "error-state filter whose updates are Huber regressions of measurements and prediction"

    def corrector(self) -> Corrector:
        return Huber()


class Rackf(Recursive):
    """Robust weights, then the prior divided."""

    method, summary = "rackf", "error-state filter with robust weights and an adaptive factor on the prediction"

    def corrector(self) -> Corrector:
        return RobustFading()


class SageHusa(Recursive):
    """Noise levels by a fading mean of residuals."""

    method, summary = "sage-husa", "error-state filter that follows noise levels by Sage and Husa's recursion"

    def corrector(self) -> Corrector:
        return Adaptive(Level("fading"), True, len(KINDS))


class Iae(Recursive):
    """Noise levels by a window of innovations."""

    method, summary = "iae", "error-state filter that follows noise levels by a window of innovations"

    def corrector(self) -> Corrector:
        return Adaptive(Level("window"), False, len(KINDS))


class Rae(Recursive):
    """Noise levels by a window of residuals."""

    method, summary = "rae", "error-state filter that follows noise levels by a window of residuals"

    def corrector(self) -> Corrector:
        return Adaptive(Level("window"), True, len(KINDS))


class Forgetting(Recursive):
    """Noise levels by forgetting weights."""

    method, summary = "forgetting", "error-state filter that follows noise levels by forgetting weights of residuals"

    def corrector(self) -> Corrector:
        return Adaptive(Level("forgetting"), True, len(KINDS))


class IteratedSmoother:
    """Smoothing iterated to the optimum of the whole flight, integers included."""

    summary = "iterated extended Kalman smoother: the whole flight by a filter forward and back, repeated"

    def solve(self, problem: NavigationProblem, progress: Progress) -> Solution:
        """Solve a problem. Raises InputError for what cannot be estimated; anything less is in the diagnostics."""
        return WholeFlight("ieks", ChainEngine).solve(problem, progress)
