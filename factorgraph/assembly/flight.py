"""The whole flight at once, with any engine: start values, float solution, integers, covariances.

Stages: single points and slip detection; a first graph with motion priors only, which smooths positions and velocities
and aligns the IMUs; the full graph with float ambiguities; integers fixed, checked against their residuals and released
where refused, re-smoothed each time; joint covariances.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from factorgraph.assembly import graduated, integers, noise, phases, wide_lanes
from factorgraph.assembly.attitudes import start_attitudes
from factorgraph.assembly.blocks import KINDS
from factorgraph.assembly.build import Built, build, correct_again
from factorgraph.assembly.engine import Engine
from factorgraph.assembly.optimizer import Graph, Result, optimise
from factorgraph.assembly.result import make_solution
from factorgraph.assembly.variables import VehicleVariables
from factorgraph.grid import common_grid
from factorgraph.models.receivers import Receiver, receivers
from factorgraph.motion_imu import with_attitudes
from factorgraph.problem import MotionPrior, NavigationProblem, Robust, Settings
from factorgraph.registry import Progress
from factorgraph.sampling import interpolate
from factorgraph.solution import Solution, Status
from factorgraph.types import Array

START_MOTION = MotionPrior((3.0, 3.0, 3.0))  # for the first graph, vehicles with an IMU
START_ROBUST = {kind: Robust("huber", 2.0) for kind in ("code", "doppler", "range", "position", "height")}
WIDENED = (8.0, 4.0, 2.0)  # times the width of a loss with local minima, while starts from ranges alone are far off
FIX_ROUNDS = 8
NOISE_ROUNDS = 5
SLIP_ROUNDS = 3  # of fixing, while fixed solutions show slips
CORRECTED_M = 1e-4  # change of a correction that is worth another solution
ROUGH = 1e-3  # tolerance between rounds; only the last solution needs the settings' own
FIRST = 3e-2  # tolerance before the first biases are known
OFFSET_S = 1e-4  # change of a time offset that asks for it too
RESCALE = 2e-4  # and of a scale factor
REBIAS = np.array([3e-3, 3e-3, 3e-3, 0.1, 0.1, 0.1])  # bias change that asks for preintegrating again


@dataclass(frozen=True, slots=True)
class WholeFlight:
    """The course of a solution over the whole flight: `method` names it, `engine` solves its linear systems."""

    method: str
    engine: Callable[[], Engine]  # a new one per graph: engines keep what they made of its structure

    def solve(self, problem: NavigationProblem, progress: Progress) -> Solution:
        """Solve a problem. Raises InputError for what cannot be estimated; anything less is in the diagnostics."""
        clock = _Clock(progress)
        built, notes = self._started(problem, clock)
        result, ratio = self._optimise(problem, built, clock)
        clock.stage("covariances", 0.9)
        solution = make_solution(problem, self.method, built, result, ratio, clock.spent, notes)
        clock.stage("done", 1.0)
        return solution

    def started(self, problem: NavigationProblem, progress: Progress) -> tuple[Built, list[str], dict[str, float]]:
        """The problem assembled at its start values, with notes and the seconds that stages took."""
        clock = _Clock(progress)
        built, notes = self._started(problem, clock)
        clock.stage("", 0.3)
        return built, notes, clock.spent

    def _started(self, problem: NavigationProblem, clock: _Clock) -> tuple[Built, list[str]]:
        problem = with_attitudes(problem)
        grid = common_grid(problem)
        rx = receivers(problem)
        clock.stage("start values", 0.1)
        vehicles = [VehicleVariables(i, v, grid, problem.frame) for i, v in enumerate(problem.bodies)]
        notes = self._start(problem, vehicles, rx, grid)
        clock.stage("building the graph", 0.25)
        built = build(problem, vehicles, rx, use_phase=True, engine=self.engine())
        for data in built.links:
            phases.prepare(data, problem.settings.ambiguity)
        return built, notes

    def _start(
        self, problem: NavigationProblem, vehicles: list[VehicleVariables], rx: dict[str, Receiver], grid: Array
    ) -> list[str]:
        """Positions, velocities and attitudes into `vehicles`, by way of a graph without IMU."""
        rough = [
            VehicleVariables(
                v.index,
                replace(v.vehicle, motion=START_MOTION) if v.vehicle.imu is not None else v.vehicle,
                grid,
                problem.frame,
                use_imu=False,
            )
            for v in vehicles
        ]
        notes = []
        known = [self._start_positions(problem, v, rx, grid) for v in rough]
        anchors = [t.position_n for m in problem.ranges for t in m.stream.tags if t.position_n is not None]
        fallback = (
            np.mean(anchors, axis=0)
            if anchors
            else np.mean([v.r.mean(axis=0) for v, k in zip(rough, known, strict=True) if k] or [np.zeros(3)], axis=0)
        )
        rng = np.random.default_rng(0)
        for v, is_known in zip(rough, known, strict=True):
            if not is_known:
                # apart from each other: ranges between coincident points have no direction
                v.r[:] = fallback + rng.normal(0.0, 0.5, 3)
        if not all(v.mode == "fixed" for v in rough):
            # velocities that are to align the IMUs need absolute measurements, wanted in the solution or not
            absolute = replace(problem, settings=replace(problem.settings, use_absolute=True))
            if all(known):  # ranges only help to find positions
                absolute = replace(absolute, ranges=())
            graph = build(absolute, rough, rx, use_phase=False, engine=self.engine()).graph
            graph.assemble()
            result = optimise(graph, START_ROBUST, 30, 1e-4, lambda i, c: None)
            if result.status is Status.SINGULAR:
                notes.append("the start graph was singular")
        for v, r in zip(vehicles, rough, strict=True):
            v.r, v.v = r.r.copy(), r.v.copy()
        return notes + start_attitudes(problem, vehicles, rough, rx, self.engine)

    @staticmethod
    def _start_positions(problem: NavigationProblem, v: VehicleVariables, rx: dict[str, Receiver], grid: Array) -> bool:
        """Fill r and v from single points or position fixes; False where neither exists."""
        if v.mode == "fixed":
            return True
        if v.name in rx:
            point = rx[v.name].point
            t = rx[v.name].vehicle.gnss.stream.t_s  # type: ignore[union-attr]
            v.r = interpolate(grid, t, problem.frame.from_ecef(point.r_ecef))
            velocity = problem.frame.rotate_from_ecef(point.v_ecef)
            if np.any(np.all(np.isfinite(velocity), axis=1)):
                v.v = interpolate(grid, t, velocity)
            return True
        if v.vehicle.positions:
            p = v.vehicle.positions[0]
            v.r = interpolate(grid, p.t_s, p.r_n)
            if len(grid) > 1:
                v.v = np.asarray(np.gradient(v.r, grid, axis=0))
            return True
        return False

    def _optimise(self, problem: NavigationProblem, built: Built, clock: _Clock) -> tuple[Result, float]:
        """Float solution, integers, releases; the result carries the whole cost history."""
        settings, graph = problem.settings, built.graph
        clock.stage("float solution", 0.3)
        placed = all(v.is_fixed or v.gnss is not None or v.positions for v in problem.vehicles)
        if settings.graduated:
            graduated.approach(graph, settings.robust, settings.graduation_step, clock.iteration)
        # starts found from ranges alone may be far off
        for wide in [] if placed or settings.graduated else _widened(settings, graph):
            self._settle(replace(problem, settings=wide), graph, clock)
        result = self._settle(problem, graph, clock)
        if max((correct_again(problem, data, built.receivers, built.ends) for data in built.links), default=0.0) > CORRECTED_M:
            result = self._continue(problem, graph, result, clock)
        for _ in range(4):
            if not sum(phases.split_slipped(data, settings.ambiguity) for data in built.links):
                break
            result = self._continue(problem, graph, result, clock)
        declared = noise.declared(graph) if settings.estimate_noise != "no" else []
        if declared:
            clock.stage("noise levels", 0.5)
            result = self._estimate_noise(problem, built, result, clock, declared, is_float=True)
        ratio = np.nan
        if not settings.ambiguity.fix or not any(len(d.block.amb_key) for d in built.links):
            return self._continue(problem, graph, result, clock, settings.tolerance), ratio
        clock.stage("integers", 0.6)
        if result.eliminated is not None and phases.open_halves(built.links, result.eliminated, settings.ambiguity):
            result = self._continue(problem, graph, result, clock)
        for _ in range(SLIP_ROUNDS):
            result, ratio = self._fix(problem, built, result, clock)
            # what integers hold in place shows slips that floats gave way to
            if not sum(phases.split_slipped(data, settings.ambiguity, join=False) for data in built.links):
                break
            graph.blocks = [b for b in graph.blocks if not b.is_stale]
            result = self._continue(problem, graph, result, clock)
        if declared:
            result = self._estimate_noise(problem, built, result, clock, declared, is_float=False)
            result, again = self._fix(problem, built, result, clock)
            ratio = float(np.fmin(ratio, again))
        return self._continue(problem, graph, result, clock, settings.tolerance), ratio

    def _estimate_noise(
        self,
        problem: NavigationProblem,
        built: Built,
        result: Result,
        clock: _Clock,
        declared: list[noise.Declared],
        is_float: bool,
    ) -> Result:
        """Standard deviations from the residuals, and a solution with them, until they stay."""
        graph, model = built.graph, problem.settings.estimate_noise
        for _ in range(NOISE_ROUNDS):
            eliminated = graph.eliminate(joints=True)
            if eliminated is None or model == "no":
                break
            cov = eliminated.covariances()
            built.noise, change = noise.estimate(model, declared, built.links, built.receivers, cov, is_float)
            result = self._continue(problem, graph, result, clock)
            if change < noise.SETTLED:
                break
        return result

    def _fix(self, problem: NavigationProblem, built: Built, result: Result, clock: _Clock) -> tuple[Result, float]:
        """Integers fixed where they can be, released where their residuals refuse them, and the smallest ratio."""
        settings, graph, ratio = problem.settings, built.graph, np.nan
        for _ in range(FIX_ROUNDS):
            if settings.ambiguity.wide_lanes and result.eliminated is not None:
                if wide_lanes.hold(graph, built.links, result.eliminated, settings.ambiguity):
                    result = self._continue(problem, graph, result, clock)
                if wide_lanes.release_refused(graph, settings.ambiguity):
                    result = self._continue(problem, graph, result, clock)
            if result.eliminated is None:
                break
            fixed = integers.fix_integers(graph, built.links, result.eliminated, settings.ambiguity)
            if fixed.fixed:
                ratio = fixed.ratio if np.isnan(ratio) else min(ratio, fixed.ratio)
                result = self._continue(problem, graph, result, clock)
            released = integers.release_refused(graph, built.links, settings.ambiguity)
            if released:
                result = self._continue(problem, graph, result, clock)
            if not fixed.fixed and not released:
                break
        return result, ratio

    def _settle(self, problem: NavigationProblem, graph: Graph, clock: _Clock) -> Result:
        """Optimise, preintegrating again while biases and time offsets move away from those preintegrated at."""
        graph.assemble()
        costs: list[float] = []
        taken = graph.parameters.offsets_s()
        for turn in range(6):
            tolerance = ROUGH if turn else FIRST
            result = optimise(graph, problem.settings.robust, problem.settings.max_iterations, tolerance, clock.iteration)
            costs += result.costs
            biased = any(
                v.mode == "imu" and np.any(np.abs(v.bias - v.preintegrated_bias).max(axis=0) > REBIAS) for v in graph.vehicles
            )
            offsets = graph.parameters.offsets_s()
            scaled = any(np.any(np.abs(v.imu_scale - v.applied_scale) > RESCALE) for v in graph.vehicles)
            stale = biased or scaled or bool(np.any(np.abs(offsets - taken) > OFFSET_S))
            if turn and (not stale or result.status is not Status.CONVERGED):
                break
            if not stale:
                continue
            taken = offsets
            graph.preintegrate()
            graph.assemble()
        return Result(result.status, costs, result.eliminated)

    def _continue(
        self, problem: NavigationProblem, graph: Graph, before: Result, clock: _Clock, tolerance: float = ROUGH
    ) -> Result:
        graph.assemble()
        result = optimise(graph, problem.settings.robust, problem.settings.max_iterations, tolerance, clock.iteration)
        return Result(result.status, before.costs + result.costs, result.eliminated)


def _widened(settings: Settings, graph: Graph) -> list[Settings]:
    """Settings whose losses with local minima are wider, the widest first; none where no measurement uses such a loss.

    Source: Blake and Zisserman (1987) for approaching a loss with local minima through smoother ones.
    """
    kinds = {KINDS[i] for block in graph.blocks for i in np.unique(block.rows.kind).tolist() if i >= 0}
    redescending = {k: r for k, r in settings.robust.items() if k in kinds and r.kernel not in ("none", "huber")}
    if not redescending:
        return []
    return [
        replace(settings, robust={**settings.robust, **{k: replace(r, width=f * r.width) for k, r in redescending.items()}})
        for f in WIDENED
    ]


class _Clock:
    """Progress and the time each stage took."""

    def __init__(self, progress: Progress) -> None:
        self.progress, self.spent = progress, {}  # type: tuple[Progress, dict[str, float]]
        self._name, self._since, self._fraction = "", time.perf_counter(), 0.0

    def stage(self, name: str, fraction: float) -> None:
        now = time.perf_counter()
        if self._name:
            self.spent[self._name] = self.spent.get(self._name, 0.0) + now - self._since
        self._name, self._since, self._fraction = name, now, fraction
        self.progress(name, fraction)

    def iteration(self, i: int, cost: float) -> None:
        self.progress(f"{self._name}: iteration {i}, cost {cost:.4g}", self._fraction)
