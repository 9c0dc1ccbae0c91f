"""The whole flight as one nonlinear least-squares problem of symbolic models."""

from __future__ import annotations

from factorgraph.assembly.flight import WholeFlight
from factorgraph.least_squares.engine import StageEngine
from factorgraph.problem import NavigationProblem
from factorgraph.registry import Progress
from factorgraph.solution import Solution


class Batch:
    """Least squares over the whole flight with CasADi models, solved along its stages."""

    summary = "CasADi least squares over the whole flight, solved along its stages"

    def solve(self, problem: NavigationProblem, progress: Progress) -> Solution:
        """Solve a problem. Raises InputError for what cannot be estimated; anything less is in the diagnostics."""
        return WholeFlight("least-squares", StageEngine).solve(problem, progress)
