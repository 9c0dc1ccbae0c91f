"""The error-state filter in passes over the whole flight.

Every pass evaluates all rows of all blocks at once, at the states that the pass before predicted from measurements until the
stage before, x_k|k-1, and then runs the recursion over the stages with rows corrected to first order,

    e - H d,   d = x_k|k-1 - x'_k|k-1 as an error about the point x' of evaluation,

transitions and transport of covariances at the filter's own states. Where predictions stay, d = 0, and the pass is the extended
Kalman filter that linearises each stage at its own prediction; where the first pass evaluates (the start values) matters no more.
Parameters, which hardly change, are linearised once, at their priors; ambiguities and nodes are linear.

Passes end when no prediction moved by more than `SETTLED` of its standard deviation: the next pass was seen to move them by a
tenth of that. After `PASSES` the track says in its notes that they had not, and is the filter linearised at the last but one
pass's predictions.

Robust weights follow from the innovations of the pass before, their clocks taken out, over the standard deviations that these
have at full weight; the first passes weigh by Huber's loss whatever the loss is. With many gross errors or a loss that
redescends, passes may end unsettled.

Memory: four square matrices of all stages (posterior, prior, F, Q), 70 MB for 1200 stages of 43 columns.

Source: Bell (1994) for passes as iterations; Bierman (1977) for scalar updates; `models.robust` for the weights.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from factorgraph.assembly.blocks import KINDS, EndsBlock
from factorgraph.assembly.flight import WholeFlight
from factorgraph.assembly.optimizer import Graph, Result
from factorgraph.assembly.result import make_solution
from factorgraph.filters._scan import Found, Layout, Motion, Points, scan
from factorgraph.filters.course import ChainEngine, Stage, Track, hand_out, linear_in, with_innovations
from factorgraph.filters.sequential import Stages
from factorgraph.models.robust import Loss
from factorgraph.models.robust import weight as robust_weight
from factorgraph.problem import NavigationProblem, Robust
from factorgraph.registry import Progress
from factorgraph.solution import Solution, Status
from factorgraph.types import Array, BoolArray, IntArray

PASSES = 15
SETTLED = 3e-2  # standard deviations of the prediction
CONVEX = 3  # passes after the first whose weights are Huber's: losses that redescend would keep what a bad start rejects
LEAST = 1e-8  # weight of rejected rows, whose innovations are wanted still


@dataclass(frozen=True, slots=True)
class _Gathered:
    """Rows of a flight by stage, those that are judged first, and where the numbers of their entries are."""

    rows: list[IntArray]  # of each block in `Stages.sorted`, those in use
    place: list[IntArray]  # of these rows in the flight's order
    sorted_stage: IntArray  # (rows,)
    entry: IntArray  # (entries,) into what `values` lines up
    last: IntArray  # (scalars,) their columns at their last stages, in the flat order
    layout: Layout

    def values(self, s: Stages, constant: Array) -> Array:
        """Entries (entries,) of all rows' whitened Jacobians."""
        parts = []
        for each in s.sorted:
            parts.append(each.block.Jw.ravel())
            if (scalars := each.block.scalars()) is not None:
                parts.append(scalars.dense)
        return np.concatenate([*parts, constant])[self.entry]

    def spread(self, of_blocks: list[Array], rest: Array) -> Array:
        """Numbers of all rows (rows,) from those of the blocks' rows and those of processes."""
        out = np.empty(len(self.sorted_stage))
        for rows, place, numbers in zip(self.rows, self.place, of_blocks, strict=False):
            out[place] = numbers[rows]
        out[self.place[-1]] = rest
        return out


@dataclass(frozen=True, slots=True)
class _Processes:
    """Rows of nodes: they are linear and never change."""

    stage: IntArray  # (m,)
    e: Array  # (m,)
    row: IntArray  # (entries,)
    key: IntArray  # (entries,)
    value: Array  # (entries,)


def _processes(s: Stages) -> _Processes:
    stage: list[int] = []
    e: list[float] = []
    row, keys, values = [], [], []
    for k, due in sorted(s.processes.items()):
        for block, f in due:
            own, before = block.keys(f)
            sigma, x = float(block.rows.sigma[f]), s.scalars[own]
            y = -x.values[x.index]
            entries = [(own, 1 / sigma)]
            if before in s.scalars and s.scalars[before].first <= k <= s.scalars[before].last:
                o, decay = s.scalars[before], float(block.decay[f])
                y += decay * o.values[o.index]
                entries.append((before, -decay / sigma))
            row += [len(e)] * len(entries)
            keys += [key for key, _ in entries]
            values += [value for _, value in entries]
            stage.append(k)
            e.append(y / sigma)
    whole = np.int64
    return _Processes(np.array(stage, whole), np.array(e), np.array(row, whole), np.array(keys, whole), np.array(values))


def _live(s: Stages) -> tuple[IntArray, IntArray, IntArray, IntArray]:
    """first_live (K + 1,), and of every stage's scalars their column at the stage before, their number and their stage."""
    number = {key: i for i, key in enumerate(sorted(s.scalars))}
    first = np.concatenate([[0], np.cumsum([len(keys) for keys in s.live])]).astype(np.int64)
    numbers = np.array([number[key] for keys in s.live for key in keys], np.int64)
    stage = np.repeat(np.arange(s.K), np.diff(first))
    code = stage * max(len(number), 1) + numbers  # sorted
    wanted = code - max(len(number), 1)
    at = np.minimum(np.searchsorted(code, wanted), max(len(code) - 1, 0))
    known = (code[at] == wanted) if len(code) else np.zeros(0, bool)
    before = np.where(known, at - first[np.maximum(stage - 1, 0)] + s.n_fixed, -1)
    return first, before, numbers, stage


def _gather(s: Stages, processes: _Processes) -> _Gathered:
    """Where everything goes; once per structure."""
    first_live, before, numbers, live_stage = _live(s)
    keys = np.array(sorted(s.scalars), np.int64)
    code = live_stage * max(len(keys), 1) + numbers

    def column_of(key: IntArray, stage: IntArray) -> IntArray:
        wanted = stage * max(len(keys), 1) + np.searchsorted(keys, key)
        return np.asarray(s.n_fixed + np.searchsorted(code, wanted) - first_live[stage])

    rows, stages, judged, of_entry, columns, entries = [], [], [], [], [], []
    base = done = 0
    for each in s.sorted:
        b = each.block
        factor = b.rows.factor.of_row
        alive = np.array(each.alive, bool)[factor]
        mine = np.flatnonzero(alive)
        place = np.full(b.n, -1)
        place[mine] = done + np.arange(len(mine))
        table, w = b.key_table(), sum(b.widths())
        local = np.empty((len(mine), w), np.int64)
        for own, (c0, c1) in zip(table.T, b.edges(), strict=True):
            if own[0] in s.place:  # of states, which have one place, and of parameters
                local[:, c0:c1] = s.place[int(own[0])] + np.arange(c1 - c0)
            else:
                local[:, c0] = column_of(own[factor[mine]], each.stage[factor[mine]])
        of_entry.append(np.repeat(place[mine], w))
        columns.append(local.ravel())
        entries.append((base + mine[:, None] * w + np.arange(w)).ravel())
        base += b.n * w
        if (c := b.scalars()) is not None:
            row, key, index = _scalar_entries(c.start, c.first_key, c.first, c.keys)
            used = alive[row]
            of_entry.append(place[row[used]])
            columns.append(column_of(key[used], each.stage[factor[row[used]]]))
            entries.append(base + index[used])
            base += len(c.dense)
        rows.append(mine)
        stages.append(each.stage[factor[mine]])
        judged.append(each.judged[mine])
        done += len(mine)
    of_entry.append(done + processes.row)
    columns.append(column_of(processes.key, processes.stage[processes.row]))
    entries.append(base + np.arange(len(processes.value)))
    stages.append(processes.stage)
    judged.append(np.zeros(len(processes.stage), bool))

    stage, is_judged = np.concatenate(stages), np.concatenate(judged)
    order = np.lexsort((~is_judged, stage))
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order))
    row = rank[np.concatenate(of_entry)]
    by_row = np.argsort(row, kind="stable")
    width = s.n_fixed + np.diff(first_live)
    of_before = np.concatenate([[s.n_fixed], width[:-1]])
    layout = Layout(
        s.n_states,
        s.n_fixed,
        first_live,
        before,
        np.array([x.sigma for _, x in sorted(s.scalars.items())])[numbers],
        np.searchsorted(stage[order], np.arange(s.K + 1)),
        np.bincount(stage[is_judged], minlength=s.K),
        np.searchsorted(row[by_row], np.arange(len(order) + 1)),
        np.concatenate(columns)[by_row],
        *(np.concatenate([[0], np.cumsum(size)]) for size in (width, width**2, width * of_before)),
    )
    ends = np.cumsum([len(part) for part in stages])[:-1]
    last = np.full(len(keys), -1)
    last[numbers] = layout.first_column[live_stage] + s.n_fixed + np.arange(len(numbers)) - first_live[live_stage]
    return _Gathered(rows, np.split(rank, ends), stage[order], np.concatenate(entries)[by_row], last, layout)


def _scalar_entries(start: IntArray, first_key: IntArray, first: IntArray, keys: IntArray) -> tuple[IntArray, IntArray, IntArray]:
    """Row, key and place in `dense` of every entry of the scalar columns of a block (`blocks.ScalarColumns`)."""
    height = np.diff(start)
    factor = np.repeat(np.arange(len(height)), np.diff(first_key))  # of every column
    tall = height[factor]
    column = np.repeat(np.arange(len(keys)), tall)
    within = np.arange(len(column)) - np.repeat(np.cumsum(tall) - tall, tall)
    f = factor[column]
    return start[f] + within, keys[column], first[f] + (column - first_key[f]) * height[f] + within


def _motion(s: Stages) -> Motion:
    """Intervals of all vehicles."""
    V, M = len(s.vehicles), s.K - 1
    m = Motion(
        has_imu=np.array([v.index in s.imu for v in s.vehicles], bool),
        offset=np.array([s.offset[v.index] for v in s.vehicles], np.int64),
        F=np.zeros((V, M, 6, 6)),
        Q=np.zeros((V, M, 15, 15)),
        dt_s=np.zeros((V, M)),
        zeta=np.zeros((V, M, 9)),
        by_bias=np.zeros((V, M, 9, 6)),
        by_scale=np.zeros((V, M, 9, 6)),
        at_bias=np.zeros((V, M, 6)),
        gravitation_n=np.zeros((V, M, 3)),
        w_ie_n=np.array([v.frame.w_ie_n for v in s.vehicles]),
        scale=np.zeros((V, 6)),
        number=np.full((V, 6), -1),
        column=np.full((V, 12), -1),
    )
    for u, v in enumerate(s.vehicles if M else []):
        m.dt_s[u] = np.diff(v.t_s)
        if v.index not in s.imu:
            J = s.motion[v.index].L @ s.motion[v.index].J0
            back = np.linalg.inv(J[:, :, 6:])
            m.F[u], m.Q[u, :, :6, :6] = -back @ J[:, :, :6], back @ np.swapaxes(back, 1, 2)
            continue
        block = s.imu[v.index]
        part, back = block.intervals, np.linalg.inv(block.intervals.whitening)
        m.Q[u], m.dt_s[u], m.zeta[u], m.by_bias[u] = back @ np.swapaxes(back, 1, 2), part.dt_s, part.zeta, part.by_bias
        m.at_bias[u], m.gravitation_n[u] = block.at_bias, block.gravitation_n
        m.column[u, :6] = s.offset[v.index] + np.arange(9, 15)
        if block.scales:
            m.by_scale[u], m.scale[u] = part.by_scale, np.roll(v.imu_scale - v.applied_scale, 3)
            for i, p in enumerate((v.accel_scale, v.gyro_scale)):
                if p is not None:
                    m.column[u, 6 + 3 * i : 9 + 3 * i] = s.place[p.key] + np.arange(3)
                    m.number[u, 3 * i : 3 * i + 3] = s.place[p.key] - s.n_states + np.arange(3)
    return m


def _points(s: Stages) -> Points:
    """A copy of the current states."""
    return Points(*(np.array([getattr(v, name) for v in s.vehicles]) for name in Points._fields))


def _found(s: Stages, layout: Layout, n_rows: int) -> Found:
    V, K = len(s.vehicles), s.K
    squares, steps = int(layout.first_square[-1]), int(layout.first_step[-1])
    of_stages = [np.zeros(n) for n in (int(layout.first_column[-1]), squares, squares, squares, steps)]
    T = np.tile(np.eye(3), (V, K, 2, 1, 1))
    of_rows = [np.zeros(n_rows) for _ in range(3)]
    dx, P, prior, Q, F = of_stages
    e, variance, left = of_rows
    return Found(_points(s), _points(s), dx, P, prior, Q, F, T, np.zeros(K), np.zeros(K), e, variance, left, np.zeros_like(dx))


def _place(s: Stages, x: Points) -> None:
    """Make states current."""
    for u, v in enumerate(s.vehicles):
        v.R, v.r, v.v, v.bias = x.R[u].copy(), x.r[u].copy(), x.v[u].copy(), x.bias[u].copy()


def filtered(graph: Graph, progress: Callable[[float], None] = lambda f: None, robust: Mapping[str, Loss] | None = None) -> Track:
    """Filter a flight from the first state's prior; the problem's variables are left at the filtered values.

    robust: losses of kinds of measurements (`Settings.robust`); rows keep their weight without. The track's residuals are those
    that updates left, NIS and its expectation those of weighted innovations.
    """
    s = Stages(graph)
    track = Track(s)
    processes = _processes(s)
    gathered = _gather(s, processes)
    d, P0 = s.start()
    for v in s.vehicles:
        v.r, v.v, v.R, v.bias = (x.copy() for x in (v.r, v.v, v.R, v.bias))
    s.move(0, d[None, : s.n_states])
    s.move_parameters(d)
    motion = _motion(s)
    found = _found(s, gathered.layout, len(gathered.sorted_stage))
    blocks = [each.block for each in s.sorted]
    for turn in range(PASSES):
        at = Points(*(x.copy() for x in found.predicted))
        if turn:
            _place(s, at)
            if robust:
                _reweigh(blocks, gathered, found, _convex(robust) if turn <= CONVEX else robust)
        for block in blocks:
            block.predict()
            block.whiten()
        e = gathered.spread([-block.e for block in blocks], processes.e)
        scan(motion, gathered.layout, e, gathered.values(s, processes.value), at, P0, bool(robust), found)
        progress((turn + 1) / PASSES)
        if float(found.drift.max()) <= SETTLED and (turn > CONVEX or not robust):
            break
    else:
        track.unsettled = float(found.drift.max())
    _place(s, found.filtered)
    s.move_parameters(found.z[gathered.layout.first_column[-2] :])
    for key, value in zip(sorted(s.scalars), found.z[gathered.last].tolist(), strict=True):
        x = s.scalars[key]
        x.values[x.index] += value
    _fill(track, gathered, motion.has_imu, found, bool(robust))
    progress(1.0)
    return track


def _reweigh(blocks: list[EndsBlock], gathered: _Gathered, found: Found, robust: Mapping[str, Loss]) -> None:
    """Weights by the innovations of the pass before.

    Common clocks are at first the medians of their groups: means would be drawn off by gross errors (`Block.reweight`).
    """
    for block, rows, place in zip(blocks, gathered.rows, gathered.place, strict=False):
        before = np.maximum(block.w, LEAST)
        y, spread = np.zeros(block.n), np.ones(block.n)
        y[rows] = found.innovation[place]
        spread[rows] = np.sqrt(1 + (found.variance[place] - 1) / before[rows])
        block.y = y * block.rows.sigma / np.sqrt(before)
        if (clocks := block.rows.clocks) is not None:
            centred = block.y - clocks.median(block.y, block.active)[clocks.of_row]
            block.w = _weights(block, centred / block.rows.single_sigma / spread, robust)
        block.w = _weights(block, block.normalised() / spread, robust)


def _convex(robust: Mapping[str, Loss]) -> dict[str, Loss]:
    """Huber's loss of the same widths."""
    return {kind: Robust("huber", loss.width) if isinstance(loss, Robust) else loss for kind, loss in robust.items()}


def _weights(block: EndsBlock, t: Array, robust: Mapping[str, Loss]) -> Array:
    w = np.where(block.active, 1.0, 0.0)
    for index in np.unique(block.rows.kind[block.rows.kind >= 0]).tolist():
        mine: BoolArray = block.active & (block.rows.kind == index)
        w[mine] = np.maximum(robust_weight(robust.get(KINDS[index]), t[mine]), LEAST)
    return w


def _fill(track: Track, gathered: _Gathered, has_imu: BoolArray, found: Found, weighed: bool) -> None:
    """Stages, residuals and weights of the last pass."""
    s, layout, K = track.stages, gathered.layout, track.stages.K
    T = np.tile(np.eye(s.n_states), (K, 1, 1))
    for u in np.flatnonzero(has_imu):
        for part in range(2):
            at = s.offset[s.vehicles[u].index] + 3 * part
            T[:, at : at + 3, at : at + 3] = found.T[u, :, part]
    expected = np.zeros(K)
    for each, rows, place in zip(s.sorted, gathered.rows, gathered.place, strict=False):
        block, number = each.block, each.number
        clocks = block.rows.clocks
        share = np.ones(block.n) if clocks is None else 1 - clocks.leverage(block.u)
        share = np.where(each.judged, share * block.w, 0.0)[rows] if weighed else np.where(each.judged, share, 0.0)[rows]
        expected += np.bincount(gathered.sorted_stage[place], share, minlength=K)
        y = np.zeros(block.n)
        y[rows] = found.left[place] * block.rows.sigma[rows]
        if weighed:
            y[rows] /= np.sqrt(np.maximum(block.w[rows], LEAST))
            track.w[number] = block.w
        track.y[number] = y
    new = np.bincount(np.repeat(np.arange(K), np.diff(layout.first_live))[layout.before < 0], minlength=K)
    dof = np.where(layout.judged > 0, np.maximum(expected - new, 0.0), 0.0)
    columns, squares, steps = layout.first_column.tolist(), layout.first_square.tolist(), layout.first_step.tolist()
    for k in range(K):
        n, square = columns[k + 1] - columns[k], slice(squares[k], squares[k + 1])
        P, prior, Q = (x[square].reshape(n, n) for x in (found.P, found.prior, found.Q))
        F = found.F[steps[k] : steps[k + 1]].reshape(n, -1)
        dx = found.dx[columns[k] : columns[k + 1]]
        track.course.append(Stage(dx, P, T[k], prior, F, Q, float(found.nis[k]), float(dof[k])))


class InPasses:
    """The error-state filter in passes as a method; ambiguities stay float."""

    summary = "error-state Kalman filter in passes over the whole flight"

    def solve(self, problem: NavigationProblem, progress: Progress) -> Solution:
        """Solve a problem. Raises InputError for what cannot be estimated."""
        built, notes, spent = WholeFlight("eskf-passes", ChainEngine).started(problem, progress)
        began = time.perf_counter()
        track = filtered(built.graph, lambda f: progress("filter", 0.3 + 0.6 * f), problem.settings.robust)
        spent["eskf-passes"] = time.perf_counter() - began
        hand_out(built.graph, track)
        notes += linear_in(track.stages)
        if track.unsettled is not None:
            notes.append(f"predictions still moved by {track.unsettled:.2g} of their standard deviations after {PASSES} passes")
        result = Result(Status.CONVERGED if track.unsettled is None else Status.MAX_ITERATIONS, [0.0])
        return with_innovations(make_solution(problem, "eskf-passes", built, result, np.nan, spent, notes), track)
