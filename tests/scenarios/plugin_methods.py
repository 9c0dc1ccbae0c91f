"""Estimators that only tests use, installed through the entry-point group as a user's own would be."""

from __future__ import annotations

import ctypes
import os
import time
from dataclasses import replace

from factorgraph.errors import InputError
from factorgraph.problem import NavigationProblem
from factorgraph.registry import Progress
from factorgraph.solution import Solution, Status
from tests.scenarios.solution_example import example_solution


class Example:
    """Returns a made-up solution at once."""

    summary = "made up"

    def solve(self, problem: NavigationProblem, progress: Progress) -> Solution:
        progress("making up", 0.5)
        return replace(example_solution(n=60), name=problem.name)


class Worse(Example):
    """The same covariances with five times the errors, at every second epoch."""

    def solve(self, problem: NavigationProblem, progress: Progress) -> Solution:
        return worse(super().solve(problem, progress))


def worse(solution: Solution, factor: float = 5.0, every: int = 2) -> Solution:
    """A solution with errors so many times as large, at every so manieth epoch."""
    vehicles, pairs = [], []
    for v in solution.vehicles:
        assert v.truth is not None
        r_n = v.truth.r_n + factor * (v.r_n - v.truth.r_n)
        rows = {name: getattr(v, name)[::every] for name in ("t_s", "v_n", "q_nb", "bias_gyro", "bias_accel", "P")}
        vehicles.append(replace(v, r_n=r_n[::every], **rows))
    for p in solution.pairs:
        assert p.truth_enu is not None
        baseline = p.truth_enu + factor * (p.baseline_enu - p.truth_enu)
        names = ("t_s", "velocity_enu", "P", "fix", "ratio", "n_sat", "truth_enu", "truth_velocity_enu")
        pairs.append(replace(p, baseline_enu=baseline[::every], **{name: getattr(p, name)[::every] for name in names}))
    return replace(solution, method="worse", vehicles=tuple(vehicles), pairs=tuple(pairs))


class Refusing(Example):
    """Cannot solve any flight."""

    def solve(self, problem: NavigationProblem, progress: Progress) -> Solution:
        raise InputError("no vehicle has an odometer; add one")


class Degraded(Example):
    """A solution that must not be trusted blindly."""

    def solve(self, problem: NavigationProblem, progress: Progress) -> Solution:
        solution = super().solve(problem, progress)
        diagnostics = replace(
            solution.diagnostics, status=Status.MAX_ITERATIONS, warnings=("leader: no position from 3 s to 9 s",)
        )
        return replace(solution, diagnostics=diagnostics)


class Slow(Example):
    """Waits for Ctrl-C after it has said so in the file that SLOW_READY names."""

    def solve(self, problem: NavigationProblem, progress: Progress) -> Solution:
        with open(os.environ["SLOW_READY"], "w", encoding="utf-8") as file:
            file.write("ready")
        time.sleep(60)
        return super().solve(problem, progress)


class Crashing(Example):
    """Reads address zero."""

    def solve(self, problem: NavigationProblem, progress: Progress) -> Solution:
        progress("reading address zero", 0.0)
        ctypes.string_at(0)
        return super().solve(problem, progress)


class Buggy(Example):
    """Raises what nobody expects."""

    def solve(self, problem: NavigationProblem, progress: Progress) -> Solution:
        raise ZeroDivisionError("an error of the estimator itself")
