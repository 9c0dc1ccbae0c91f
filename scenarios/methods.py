"""Estimators by name: those of `factorgraph.registry`, and any recursive filter with a search that corrects it.

FILTER-SEARCH such as eskf-tdo, ukf-gauss-newton or relative-tdo is made by `corrected`; FILTER-SEARCH-rts is smoothed, but for
the relative filter, which has no smoother.
"""

from __future__ import annotations

from dataclasses import replace

from factorgraph import registry
from factorgraph.named import Family, Named
from factorgraph.problem import NavigationProblem
from factorgraph.registry import RECURSIVE, Method, Progress
from factorgraph.solution import Solution

SMOOTHED = "-rts"
RELATIVE = "relative"
SEARCHES = ("tdo", "pso", "ga", "cma-es", "de", "gauss-newton")
CORRECTED = Family(
    "FILTER-SEARCH",
    (
        *(f"{name}-{search}{end}" for name in RECURSIVE for search in SEARCHES for end in ("", SMOOTHED)),
        *(f"{RELATIVE}-{search}" for search in SEARCHES),
    ),
    "scenarios.corrected",
    f"a filter that a search corrects where its innovations do not fit, such as eskf-tdo: {', '.join(SEARCHES)}",
)
METHODS = replace(registry.METHODS, families=(CORRECTED,))


def methods() -> list[Named]:
    """What can be chosen, ours first, families by their pattern."""
    families = (Named(family.pattern, family.module, family.summary) for family in METHODS.families)
    return [*METHODS.all().values(), *families]


def create(name: str) -> Method:
    """An estimator by name. Raises InputError with the nearest name for an unknown one."""
    method: Method = METHODS.create(name)
    return method


def solve(problem: NavigationProblem, method: str = "graph", progress: Progress | None = None) -> Solution:
    """Solve a problem with a method by name."""
    return create(method).solve(problem, progress or (lambda stage, fraction: None))
