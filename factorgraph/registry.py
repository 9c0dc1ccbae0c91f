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


GRAPHS, LEAST_SQUARES, FILTERS = "factorgraph.graphs.", "factorgraph.least_squares.", "factorgraph.filters."
RECURSIVE = {
    "eskf": "error-state Kalman filter",
    "ekf": "extended Kalman filter, total state with Euler angles",
    "iekf": "error-state filter, updates iterated",
    "inekf": "invariant extended Kalman filter",
    "ukf": "unscented Kalman filter",
    "ckf": "cubature Kalman filter",
    "srukf": "square-root unscented Kalman filter",
    "srckf": "square-root cubature Kalman filter",
    "strong-tracking": "error-state filter with a fading factor",
    "huber": "error-state filter with Huber regressions",
    "rackf": "error-state filter with robust weights and adaptive prediction",
    "sage-husa": "error-state filter, noise levels by Sage and Husa",
    "iae": "error-state filter, noise levels by a window of innovations",
    "rae": "error-state filter, noise levels by a window of residuals",
    "forgetting": "error-state filter, noise levels by forgetting weights",
}
OURS = (
    ("graph", f"{GRAPHS}batch:Batch", "GTSAM factor graph over the whole flight"),
    ("least-squares", f"{LEAST_SQUARES}batch:Batch", "CasADi least squares over the whole flight"),
    ("moving-horizon", f"{LEAST_SQUARES}horizon:Horizon", "least squares over a sliding window, epoch by epoch"),
    ("eskf-passes", f"{FILTERS}passes:InPasses", "error-state Kalman filter in passes, without robust losses: for many flights"),
    ("ieks", f"{FILTERS}recursive:IteratedSmoother", "iterated Kalman smoother: the optimum of the whole flight by filters"),
    (
        "relative",
        f"{FILTERS}relative.method:RELATIVE",
        "relative filter: attitudes and accelerometers of all vehicles, two or many",
    ),
    *((name, f"{FILTERS}methods:{name}", summary) for name, summary in RECURSIVE.items()),
    *((f"{name}-rts", f"{FILTERS}methods:{name}-rts", f"{summary}, smoothed") for name, summary in RECURSIVE.items()),
)
METHODS = Names("method", "relnav.methods", tuple(Named(*each) for each in OURS))


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
