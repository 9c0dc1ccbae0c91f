"""The whole flight as one GTSAM factor graph."""

from __future__ import annotations

from factorgraph.assembly.flight import WholeFlight
from factorgraph.graphs.engine import GtsamEngine
from factorgraph.problem import NavigationProblem
from factorgraph.registry import Progress
from factorgraph.solution import Solution


class Batch:
    """Factor graph over the whole flight, solved with GTSAM."""

    summary = "GTSAM factor graph over the whole flight"

    def solve(self, problem: NavigationProblem, progress: Progress) -> Solution:
        """Solve a problem. Raises InputError for what cannot be estimated; anything less is in the diagnostics."""
        return WholeFlight("graph", GtsamEngine).solve(problem, progress)
