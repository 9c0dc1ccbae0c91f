"""Recursive estimation of any flight: a filter over the stages of the assembled problem, and a smoother on top.

A `Filter` says how errors are charted (`filters.charts`), how a stage is corrected, and whether models are seen through Jacobians
or a cloud of sigma points (`filters.clouds`).

With Jacobians, stages of a window are evaluated together at states carried without measurements from the last corrected one;
windows are single stages while corrections are large and grow to `WINDOW` while they stay small (`CALM`). A cloud goes stage by
stage. Rows have the robust weights of their innovations (`filters.weighing`). The filter's covariances, or the smoother's, take
the place of an eliminated problem's in `assembly.result`; residuals are those that each update left.

Source: Rauch, Tung and Striebel (1965) for the smoother; for the kinds of updates `filters.updates` and `filters.adaptive`.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import block_diag

from factorgraph.assembly.conditioned import Conditioned, EpochIntegers, condition
from factorgraph.assembly.flight import WholeFlight
from factorgraph.assembly.optimizer import Graph, Result
from factorgraph.assembly.result import make_solution
from factorgraph.errors import InputError
from factorgraph.filters import kalman
from factorgraph.filters.charts import BODY, Chart
from factorgraph.filters.clouds import Cloud
from factorgraph.filters.correctors import Corrector
from factorgraph.filters.course import ChainEngine, Stage, Track, hand_out, joint, linear_in, smooth_values, with_innovations
from factorgraph.filters.sequential import StageRows, Stages
from factorgraph.filters.sigma_points import Rule, root, rooted
from factorgraph.filters.updates import Linearise, Updated
from factorgraph.filters.weighing import Watch, weigh
from factorgraph.models.robust import Loss
from factorgraph.problem import AmbiguitySettings, NavigationProblem
from factorgraph.registry import Progress
from factorgraph.solution import Solution, Status
from factorgraph.types import Array

WINDOW = 8  # stages at most
CALM = (1e-3, 5.0, 0.1)  # rad, m, m/s: deviations in a window that let the next one grow; 0.2 mm of a baseline


@dataclass(frozen=True, slots=True)
class Filter:
    """A recursive method."""

    corrector: Callable[[], Corrector] = Corrector
    chart: Chart = BODY
    rule: Callable[[int], Rule] | None = None  # of sigma points in place of Jacobians
    root: bool = False  # covariances only ever by their roots; with sigma points


Again = Callable[[Array], Array]  # weighs other rows of a stage as its own were
Update = Callable[[Array, Array, StageRows, Again], Updated]  # prior, innovations, rows


class Run:
    """A flight being filtered; the problem's variables are left at the filtered values."""

    def __init__(self, graph: Graph, method: Filter, losses: Mapping[str, Loss]) -> None:
        self.s, self.method, self.corrector, self.losses = Stages(graph, method.chart), method, method.corrector(), losses
        self.track, self.watch = Track(self.s), Watch()
        for v in self.s.vehicles:
            v.r, v.v, v.R, v.bias = (x.copy() for x in (v.r, v.v, v.R, v.bias))
        d, self.P = self.s.start()
        self.s.move(0, d[None, : self.s.n_states])
        self.s.move_parameters(d)
        self.live: list[int] = []
        self.whole = integer_keys(graph)
        self.floats: list[Array] = []  # of each stage's ambiguities that are integers

    def by_jacobians(self, progress: Callable[[float], None]) -> None:
        """Windows of stages, linearised where they are carried to."""
        s, course = self.s, self.track.course
        d = np.zeros(s.n_fixed)
        T = same = np.eye(s.n_states)
        a, size = 0, 1
        while a < s.K:
            b, before = min(a + size, s.K), max(a - 1, 0)
            s.carry(before, b)
            F, Q = s.transitions(before, b)
            deviations = []
            for k, rows in zip(range(a, b), s.rows(a, b), strict=True):
                step, noise = joint(s, self.live, k, F[k - before - 1] if k else None, Q[k - before - 1] if k else None)
                _leave(s, self.live, s.live[k], d)
                step[:, : s.n_states] = step[:, : s.n_states] @ T
                d, T = step @ d, same
                e, moved = rows.e - rows.H @ d, step @ self.P @ step.T
                update = self._by_rows(k if b == a + 1 else None)
                u = self.correct(k, rows, e, moved, noise, step, update, np.zeros((len(e), 0)))
                d, self.P = d + u.dx, u.P
                self._note(k, d)
                deviations.append(d[: s.n_states])
            D = np.array(deviations)
            for stage, T in zip(course[a:b], s.move(a, D), strict=True):
                stage.T = T
            s.move_parameters(d)
            s.move_scalars(self.live, d)
            d = np.zeros(len(d))
            size = min(2 * size, WINDOW) if _is_calm(s, D) else 1
            a = b
            progress(a / s.K)

    def by_points(self, rule: Callable[[int], Rule], progress: Callable[[float], None]) -> None:
        """Stage by stage, with clouds about the filter's own states; P and its root L are about where it is."""
        s, n, rooted_only = self.s, self.s.n_states, self.method.root
        cloud, L = Cloud(s, rule), root(self.P)
        T = np.eye(n)
        for k in range(s.K):
            F, Q, root_Q = self._carried(cloud, k, L[:n, :n])
            step, noise = joint(s, self.live, k, F, Q)
            if rooted_only:
                L = rooted([step @ L, _noise_root(noise, root_Q)])
                moved = L @ L.T - noise
            else:
                moved = step @ self.P @ step.T
                L = root((moved + noise)[:n, :n])
            rows, bend = cloud.rows(k, L[:n, :n])
            step[:, :n] = step[:, :n] @ T  # of errors about where the stage before was evaluated
            update = _by_cloud(self.corrector, bend, L if rooted_only else None)
            u = self.correct(k, rows, rows.e, moved, noise, step, update, bend)
            T = self.track.course[k].T = s.move(k, u.dx[None, :n])[0]
            s.move_parameters(u.dx)
            s.move_scalars(self.live, u.dx)
            self._note(k, np.zeros(len(u.dx)))
            whole = np.eye(len(u.dx))
            whole[:n, :n] = T
            self.P = whole @ u.P @ whole.T
            L = rooted([whole @ (L if u.L is None else u.L)]) if rooted_only else root(self.P)
            progress((k + 1) / s.K)

    def _carried(self, cloud: Cloud, k: int, L: Array) -> tuple[Array | None, Array | None, Array]:
        """State k from the one before, whose states have a covariance of root L (n, n): F, Q and a root of Q (n, any)."""
        if not k:
            return None, None, np.zeros((0, 0))
        s, n = self.s, self.s.n_states
        seen, noise = cloud.transition(k - 1, L)
        F = np.eye(s.n_fixed)
        if any(block.scales for block in s.imu.values()):
            F = s.transitions(k - 1, k + 1)[0][0]
        turned = s.move(k, seen.mean[None])[0]
        F[:n, :n] = seen.slope
        F[:n] = turned @ F[:n]
        root_Q, Q = np.hstack([noise, turned @ seen.E]), np.zeros_like(F)
        Q[:n, :n] = root_Q @ root_Q.T
        return F, Q, root_Q

    def correct(
        self, k: int, rows: StageRows, e: Array, moved: Array, noise: Array, step: Array, update: Update, bend: Array
    ) -> Updated:
        """Weigh the innovations e (m,) of stage k's rows and update; what is not finite leaves the prediction as it is.

        bend (m, any): root of the variance that models add which are not linear.
        """
        s, prior = self.s, moved + noise
        bent = np.einsum("mi,mi->m", bend, bend)
        self.watch.see(float(s.t_s[k]), e, rows, prior, bent)
        weighed = None if self.corrector.own_weights else weigh(s.graph, rows, e, prior, bent, self.losses)
        used, mine, again = (rows, e, _same) if weighed is None else (weighed.rows, weighed.e, weighed.again)
        prior = self.corrector.inflation(prior, moved, noise, used, mine)
        u = self._updated(k, prior, mine, used, again, update)
        new = len(set(s.live[k]) - set(self.live))
        nis = _judged(used, prior, mine, again(bend), new)
        self.track.course.append(Stage(u.dx, u.P, np.eye(s.n_states), prior, step, noise, *nis))
        _keep(self.track, rows, e - rows.H @ u.dx, u.weights if weighed is None else weighed.w)
        self.live = s.live[k]
        return u

    def _updated(self, k: int, prior: Array, e: Array, rows: StageRows, again: Again, update: Update) -> Updated:
        try:
            u = update(prior, e, rows, again)
        except np.linalg.LinAlgError:
            u = None
        if u is None or not (np.all(np.isfinite(u.dx)) and np.all(np.isfinite(u.P))):
            self.watch.failed(float(self.s.t_s[k]))
            return Updated(np.zeros(len(prior)), prior, 0.0)
        return u

    def _by_rows(self, k: int | None) -> Update:
        """The corrector's update by a linearisation; at stage k it may ask for others."""

        def update(P: Array, e: Array, rows: StageRows, again: Again) -> Updated:
            return self.corrector.update(P, e, rows, None if k is None else self._linearise(k, again))

        return update

    def _linearise(self, k: int, again: Again) -> Linearise:
        """Rows of stage k at other deviations from its current states."""
        s = self.s

        def at(x: Array) -> tuple[Array, Array]:
            before = [(v.R[k].copy(), v.r[k].copy(), v.v[k].copy(), v.bias[k].copy()) for v in s.vehicles]
            T = s.move(k, x[None, : s.n_states])[0]
            s.move_parameters(x)
            s.move_scalars(s.live[k], x)
            rows = next(s.rows(k, k + 1))
            for v, each in zip(s.vehicles, before, strict=True):
                v.R[k], v.r[k], v.v[k], v.bias[k] = each
            s.move_parameters(-x)
            s.move_scalars(s.live[k], -x)
            H = rows.H.copy()
            H[:, : s.n_states] = H[:, : s.n_states] @ T
            return again(rows.e), again(H)

        return at

    def _note(self, k: int, d: Array) -> None:
        """Integer ambiguities of stage k as they are now, d (n,) from where their values are."""
        s = self.s
        own = ((s.scalars[key], s.n_fixed + i) for i, key in enumerate(s.live[k]) if key in self.whole)
        self.floats.append(np.array([x.values[x.index] + d[column] for x, column in own]))


def _leave(s: Stages, live: Sequence[int], now: Sequence[int], d: Array) -> None:
    """Scalars that end keep what was found."""
    stay = set(now)
    gone = [i for i, key in enumerate(live) if key not in stay]
    for i in gone:
        x = s.scalars[live[i]]
        x.values[x.index] += d[s.n_fixed + i]


def _judged(rows: StageRows, prior: Array, e: Array, E: Array, new: int) -> tuple[float, float]:
    """Normalised innovation squared of rows that are judged, and its expectation; scalars that are new explain a row each."""
    mine = rows.judged
    if not np.any(mine):
        return 0.0, 0.0
    H, nu, bent = rows.H[mine], e[mine], E[mine]
    S = H @ prior @ H.T + bent @ bent.T + np.eye(len(nu))
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


def _same(x: Array) -> Array:
    return x


def _noise_root(noise: Array, root_Q: Array) -> Array:
    """Root (n, any) of a stage's noise: that of the states, and scalars that are new."""
    n = len(root_Q)
    return np.asarray(block_diag(root_Q, np.diag(np.sqrt(np.diag(noise)[n:]))))


def _by_cloud(corrector: Corrector, bend: Array, L: Array | None) -> Update:
    """Update with rows that a cloud has seen; by the root L of the prior where it is given."""

    def update(P: Array, e: Array, rows: StageRows, again: Again) -> Updated:
        E = again(bend)
        if L is not None:
            return corrector.rooted(L, e, rows, E)
        e, H = kalman.whiten(e, rows.H, np.eye(len(e)) + E @ E.T)
        return corrector.update(P, e, replace(rows, H=H), None)

    return update


def run(graph: Graph, method: Filter, losses: Mapping[str, Loss], progress: Callable[[float], None] = lambda f: None) -> Run:
    """Filter a flight from the first state's prior; the problem's variables are left at the filtered values."""
    found = Run(graph, method, losses)
    if method.rule is None:
        found.by_jacobians(progress)
    else:
        found.by_points(method.rule, progress)
    found.watch.judge(float(found.s.t_s[-1]))
    return found


def integer_keys(graph: Graph) -> set[int]:
    """Ambiguities that are whole cycles: all but those of GLONASS, whose satellites have frequencies of their own."""
    whole = set()
    for block in graph.gnss:
        seen = np.flatnonzero(block.arc >= 0)
        for arc, label in zip(block.arc[seen].tolist(), block.rows.label_index[seen].tolist(), strict=True):
            if block.amb_key[arc] and block.rows.label[label][0] != "R":
                whole.add(int(block.amb_key[arc]))
    return whole


def condition_on_integers(found: Run, settings: AmbiguitySettings, smoothed: bool) -> EpochIntegers:
    """Condition every stage of a run on the integers that can be fixed there; the problem's ambiguities stay float."""
    s, D, epochs = found.s, np.zeros((found.s.K, found.s.n_states)), []
    for k, stage in enumerate(found.track.course):
        own = [i for i, key in enumerate(s.live[k]) if key in found.whole]
        now = [s.scalars[s.live[k][i]] for i in own]
        a = np.array([x.values[x.index] for x in now]) if smoothed else found.floats[k]
        columns = np.concatenate([np.arange(s.n_fixed), s.n_fixed + np.array(own, np.int64)])
        epoch = _conditioned(stage.P[np.ix_(columns, columns)], a, settings)
        stage.P[: s.n_fixed, : s.n_fixed] = epoch.P
        D[k] = stage.T @ epoch.dx[: s.n_states]
        epochs.append(epoch)
    s.move(0, D)
    return EpochIntegers.of(epochs)


def _conditioned(P: Array, a: Array, settings: AmbiguitySettings) -> Conditioned:
    """As `condition`; a covariance that is not sound fixes nothing."""
    n = len(P) - len(a)
    try:
        return condition(P, a, settings)
    except ValueError:
        return Conditioned(np.zeros(n), P[:n, :n], 0, len(a), np.nan)


class Recursive:
    """A filter over a flight, forward once; `smoothed`, back once. Ambiguities stay float in it.

    integers: whether what is put out is conditioned on integers; by default where the problem wants them fixed.
    """

    def __init__(self, name: str, summary: str, method: Filter, smoothed: bool = False, integers: bool | None = None) -> None:
        self.name, self.summary, self.method = name, summary + (", smoothed" if smoothed else ""), method
        self.smoothed, self.integers = smoothed, integers

    def solve(self, problem: NavigationProblem, progress: Progress) -> Solution:
        """Solve a problem. Raises InputError for what cannot be estimated."""
        built, notes, spent = WholeFlight(self.name, ChainEngine).started(problem, progress)
        began = time.perf_counter()
        progress("filter", 0.3)
        try:
            found = run(built.graph, self.method, problem.settings.robust, lambda f: progress("filter", 0.3 + 0.5 * f))
            if self.smoothed:
                progress("smoother", 0.8)
                smooth_values(found.track)
        except np.linalg.LinAlgError as error:
            raise InputError(
                f"{self.name} lost the covariance of this flight ({error}); a square-root filter may keep it"
            ) from error
        spent[self.name] = time.perf_counter() - began
        settings = problem.settings.ambiguity
        wanted = settings.fix if self.integers is None else self.integers
        notes += linear_in(found.s)
        result = Result(Status.DIVERGED if found.watch.trouble else Status.CONVERGED, [0.0])
        hand_out(built.graph, found.track, self.smoothed)
        if not wanted or not found.whole:
            solution = make_solution(problem, self.name, built, result, np.nan, spent, notes)
            return finished(solution, found, self.smoothed)
        of_floats = make_solution(problem, self.name, built, result, np.nan, spent, notes) if self.smoothed else None
        integers = condition_on_integers(found, replace(settings, fix=True), self.smoothed)
        solution = make_solution(problem, self.name, built, result, np.nan, spent, notes, integers)
        if of_floats is not None:  # ambiguities in the residuals are float, and so are the states they belong to
            d = of_floats.diagnostics
            diagnostics = replace(solution.diagnostics, nis_t_s=d.nis_t_s, nis=d.nis, nis_dof=d.nis_dof)
            solution = replace(solution, residuals=of_floats.residuals, diagnostics=diagnostics)
        return finished(solution, found, self.smoothed)


def finished(solution: Solution, found: Run, smoothed: bool) -> Solution:
    """A filter's NIS is that of its innovations, a smoothed flight's that of its residuals; and whether it went wrong."""
    if found.watch.trouble:
        d = solution.diagnostics
        solution = replace(solution, diagnostics=replace(d, warnings=(*d.warnings, found.watch.trouble)))
    return solution if smoothed else with_innovations(solution, found.track)


class IteratedSmoother:
    """Smoothing iterated to the optimum of the whole flight, integers included."""

    summary = "iterated extended Kalman smoother: the whole flight by a filter forward and back, repeated"

    def solve(self, problem: NavigationProblem, progress: Progress) -> Solution:
        """Solve a problem. Raises InputError for what cannot be estimated; anything less is in the diagnostics."""
        left_out: list[str] = []
        solution = WholeFlight("ieks", lambda: ChainEngine(left_out=left_out)).solve(problem, progress)
        notes = tuple(f"left out: {what}" for what in dict.fromkeys(left_out))
        return replace(solution, diagnostics=replace(solution.diagnostics, notes=solution.diagnostics.notes + notes))
