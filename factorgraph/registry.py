"""Estimators by name.

A method is a class with `summary: str` and `solve(problem, progress) -> Solution`. Ours are listed here;
an installed package adds its own through the entry-point group `relnav.methods`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from factorgraph.named import Named, Names
from factorgraph.problem import NavigationProblem
from factorgraph.solution import Solution

Progress = Callable[[str, float], None]  # stage name, fraction done in [0, 1]


class Method(Protocol):
    """An estimator of whole flights."""

    summary: str

    def solve(self, problem: NavigationProblem, progress: Progress) -> Solution: ...


METHODS = Names(
    "method",
    "relnav.methods",
    (
        Named("graph", "factorgraph.graphs.batch:Batch", "GTSAM factor graph over the whole flight"),
        Named("least-squares", "factorgraph.least_squares.batch:Batch", "CasADi least squares over the whole flight"),
        Named("moving-horizon", "factorgraph.least_squares.horizon:Horizon", "least squares over a sliding window, epoch by epoch"),
    ),
)


def methods() -> dict[str, Named]:
    """All methods, ours first."""
    return METHODS.all()


def create(name: str) -> Method:
    """An estimator by name. Raises InputError with the nearest name for an unknown one."""
    method: Method = METHODS.create(name)
    return method


def solve(problem: NavigationProblem, method: str = "graph", progress: Progress | None = None) -> Solution:
    """Solve a problem with a method by name."""
    return create(method).solve(problem, progress or (lambda stage, fraction: None))
