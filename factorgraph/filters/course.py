"""What a filter leaves of a flight: stages with their covariances; smoothing them; handing them out as a solved problem.

The flight is a chain of stages d_{k+1} = F d_k + c + w, whose rows are those of the blocks. `ChainEngine` solves the linear
problem of an assembled flight this way, forward by Kalman and back by Rauch, Tung and Striebel: Gauss-Newton iterations with it
are the iterated extended Kalman smoother.

Source: Bell (1994), The iterated Kalman smoother as a Gauss-Newton method.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from factorgraph.assembly.blocks import Block
from factorgraph.assembly.engine import Linear
from factorgraph.assembly.flight import OFFSET_S, REBIAS
from factorgraph.assembly.keys import dimension
from factorgraph.assembly.optimizer import Graph
from factorgraph.filters import kalman, smoother
from factorgraph.filters.sequential import Stages, usable
from factorgraph.solution import Solution
from factorgraph.types import Array, IntArray


@dataclass(slots=True)
class Stage:
    """What the filter, or the smoother after it, knows of a stage."""

    dx: Array  # (n,) correction of the update
    P: Array  # (n, n) posterior, of errors about the state the rows were evaluated at
    T: Array  # (states, states) from there to errors about the state that was found
    prior: Array  # (n, n)
    F: Array  # (n, n of the stage before) from it, zero rows for scalars that are new
    Q: Array  # (n, n)
    nis: float
    dof: float
    A: Array | None = None  # (n, n of the stage ahead) gain of the smoother, once there is one


@dataclass(slots=True)
class Track:
    """A filtered flight; the blocks' variables hold its values."""

    stages: Stages
    course: list[Stage] = field(default_factory=list)
    y: dict[int, Array] = field(default_factory=dict)  # block -> residuals (n,) that updates left
    w: dict[int, Array] = field(default_factory=dict)
    unsettled: float | None = (
        None  # how far predictions still moved, in standard deviations, where passes ended before they stayed
    )


def joint(s: Stages, live: Sequence[int], k: int, F: Array | None, Q: Array | None) -> tuple[Array, Array]:
    """Transition (n, n before) and noise (n, n) to stage k from the one before with its scalars `live`."""
    n, now = s.n_fixed, s.live[k]
    step, noise = np.zeros((n + len(now), n + len(live))), np.zeros((n + len(now), n + len(now)))
    step[:n, :n] = np.eye(n) if F is None else F
    if Q is not None:
        noise[:n, :n] = Q
    known = {key: i for i, key in enumerate(live)}
    for i, key in enumerate(now):
        if key in known:
            step[n + i, n + known[key]] = 1.0
        else:
            noise[n + i, n + i] = s.scalars[key].sigma ** 2
    return step, noise


def smooth(stages: Stages, course: list[Stage]) -> list[Array]:
    """Covariances become those of the whole flight; returns each stage's smoothed less filtered deviation (n,)."""
    ahead, found = course[-1].dx, [np.zeros(len(course[-1].dx))]
    for k in range(stages.K - 2, -1, -1):
        here, there = course[k], course[k + 1]
        here.A = smoother.gain(here.P, there.F, there.prior)
        ds, here.P = here.A @ ahead, smoother.with_gain(here.A, here.P, there.F, there.Q, there.P)
        found.append(ds)
        ahead = here.dx + ds
    return found[::-1]


def smooth_values(track: Track) -> None:
    """Smooth a filtered flight; the problem's variables become those of the whole flight."""
    s = track.stages
    moved = smooth(s, track.course)
    s.move(0, np.array([stage.T @ ds[: s.n_states] for stage, ds in zip(track.course, moved, strict=True)]))
    for k, ds in enumerate(moved):
        stays = set(s.live[k + 1]) if k + 1 < s.K else set()
        for i, key in enumerate(s.live[k]):
            if key not in stays:
                x = s.scalars[key]
                x.values[x.index] += ds[s.n_fixed + i]


@dataclass(frozen=True, slots=True)
class StageCovariances:
    """Joint covariances of variables of one stage, from a filtered or smoothed course."""

    track: Track

    def joints(self, groups: Sequence[Sequence[int]]) -> Array:
        """Joint covariances (g, d, d) of groups of keys whose dimensions agree; NaN of pairs that share no stage."""
        return np.array([self.joint(keys) for keys in groups])

    def joint(self, keys: Sequence[int]) -> Array:
        """Joint covariance (d, d) of several keys, at the last stage at which all of them are there."""
        s = self.track.stages
        k = s.stage_of(keys)
        columns = s.columns(k, keys)
        out = np.full((len(columns), len(columns)), np.nan)
        there, stage = columns >= 0, self.track.course[k]
        T = np.eye(len(stage.P))[columns[there]]
        T[:, : s.n_states] = T[:, : s.n_states] @ stage.T
        out[np.ix_(there, there)] = T @ stage.P @ T.T
        return out


@dataclass(frozen=True, slots=True)
class Solved:
    """A chain solved: deviations of every stage, and covariances."""

    track: Track
    deviations: list[Array]

    def step(self, keys: Sequence[int] | IntArray) -> Array:
        """The minimiser's components (n, d) of variables of one dimension."""
        s = self.track.stages
        return np.array([self.deviations[k][s.columns(k, [key])] for key in map(int, keys) for k in (s.stage_of([key]),)])

    def covariance(self, keys: Sequence[int]) -> Array:
        """Joint covariance (d, d) of any few variables, each at the last stage at which it is there.

        Along the smoother's gains: cov(x_i, x_j) = A_i A_(i+1) ... A_(j-1) P_j.
        """
        s, course = self.track.stages, self.track.course
        stage = np.array([s.stage_of([key]) for key in keys])
        edges = np.cumsum([0, *(dimension(key) for key in keys)])
        out, met = np.zeros((edges[-1], edges[-1])), np.zeros(0, np.int64)
        W = np.zeros((0, 0))
        for k in range(int(stage.min()), int(stage.max()) + 1):
            own = course[k]
            A = course[k - 1].A
            W = W @ A if len(W) and A is not None else np.zeros((0, len(own.P)))
            for i in np.flatnonzero(stage == k).tolist():
                M = np.eye(len(own.P))[s.columns(k, [keys[i]])]
                M[:, : s.n_states] = M[:, : s.n_states] @ own.T
                mine = np.arange(edges[i], edges[i + 1])
                W, met = np.vstack([W, M]), np.concatenate([met, mine])
                out[np.ix_(met, mine)] = W @ own.P @ M.T
                out[np.ix_(mine, met)] = out[np.ix_(met, mine)].T
        return out

    def covariances(self) -> StageCovariances:
        """Those of variables that share a stage."""
        return StageCovariances(self.track)


@dataclass(frozen=True, slots=True)
class Chain:
    """An assembled problem at its current values."""

    graph: Graph

    def eliminate(self, lam: float) -> Solved | None:
        """Forward and back, damped by lam; None where a covariance is singular."""
        s = Stages(self.graph)
        track, deviations = Track(s), []
        F, c, Q = s.chain()
        d, P = s.start()
        live: list[int] = []
        same = np.eye(s.n_states)
        for k, rows in enumerate(s.rows_at_hand()):
            step, noise = joint(s, live, k, F[k - 1] if k else None, Q[k - 1] if k else None)
            d, prior = step @ d, step @ P @ step.T + noise
            if k:
                d[: s.n_states] += c[k - 1]
            e, H = rows.e - rows.H @ d, rows.H
            if lam > 0:  # constants only once
                new = np.array([key not in live for key in s.live[k]], bool)
                damped = np.concatenate([np.arange(s.n_states if k else s.n_fixed), s.n_fixed + np.flatnonzero(new)])
                e, H = np.concatenate([e, -np.sqrt(lam) * d[damped]]), np.vstack([H, np.sqrt(lam) * np.eye(len(d))[damped]])
            dx, P, _ = kalman.update_white(prior, e, H)
            track.course.append(Stage(dx, P, same, prior, step, noise, 0.0, 0.0))
            d, live = d + dx, s.live[k]
            deviations.append(d)
        try:
            ds = smooth(s, track.course)
        except np.linalg.LinAlgError:
            return None
        return Solved(track, [a + b for a, b in zip(deviations, ds, strict=True)])


class ChainEngine:
    """Linear problems of flights whose rows see one time, or two neighbouring ones, solved along time."""

    packages: tuple[str, ...] = ()

    def __init__(self, track: Track | None = None, left_out: list[str] | None = None) -> None:
        self.track = track  # in place of what would be solved for again
        self.left_out = [] if left_out is None else left_out  # told what the chain cannot see

    def predict(self, block: Block) -> None:
        """Set the block's y and J at the current variables."""
        block.predict()

    def linearise(self, graph: Graph, joints: bool) -> Linear:
        """The problem as the blocks hold it, or what was found already; states of one time are together anyway."""
        if self.track is not None:
            return Kept(self.track)
        for block in graph.blocks:
            if not usable(block) and np.any(block.active):
                block.active[:] = False  # what no step can follow must not count in the cost
                block.reweight({})
                self.left_out.append(f"{block.rows.source}: {len(block.rows.factor.start)} constraints between two times")
        return Chain(graph)

    def remarks(self, graph: Graph) -> list[str]:
        """Nothing beside that it failed."""
        return []


@dataclass(frozen=True, slots=True)
class Kept:
    """A problem solved before."""

    track: Track

    def eliminate(self, lam: float) -> Solved:
        """No step is left to take."""
        return Solved(self.track, [np.zeros(len(stage.dx)) for stage in self.track.course])


def with_innovations(solution: Solution, track: Track) -> Solution:
    """A filter's solution with the NIS of its innovations."""
    nis, dof = np.array([c.nis for c in track.course]), np.array([c.dof for c in track.course])
    seen = dof > 0
    of_filter = replace(solution.diagnostics, nis_t_s=track.stages.t_s[seen], nis=nis[seen], nis_dof=dof[seen])
    return replace(solution, diagnostics=of_filter)


def linear_in(s: Stages) -> list[str]:
    """What the filter could not use, and what it was linear in that has moved far."""
    notes = [f"left out: {what}" for what in s.left_out]
    for v in s.vehicles:
        if v.mode == "imu":
            off = np.median(np.abs(v.bias - v.preintegrated_bias), axis=0)
            if np.any(off > REBIAS):
                notes.append(
                    f"{v.name}: IMU increments belong to other biases (gyroscope {off[:3].max():.2g} rad/s, accelerometer"
                    f" {off[3:].max():.2g} m/s^2 off) and were corrected to first order; the graph integrates them again"
                )
    moved = [p.name for p in s.parameters if p.unit == "s" and np.any(np.abs(p.value - p.prior) > OFFSET_S)]
    if moved:
        notes.append(f"time offsets applied by rates, not by attaching measurements to other states: {', '.join(moved)}")
    return notes


def hand_out(graph: Graph, track: Track, smoothed: bool = False) -> None:
    """A track as the solved problem that a solution is made from."""
    graph.assemble()
    graph.engine = ChainEngine(track)
    graph.predict()
    for number, y in track.y.items() if not smoothed else ():
        graph.blocks[number].y = y
    for number, w in track.w.items():
        graph.blocks[number].w = w
