"""Estimators by name.

A method is a class with `summary: str` and `solve(problem, progress) -> Solution`. Ours are listed here;
an installed package adds its own through the entry-point group `relnav.methods`.
"""

from __future__ import annotations

import difflib
from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from importlib.metadata import entry_points
from typing import Protocol

from factorgraph.errors import InputError
from factorgraph.problem import NavigationProblem
from factorgraph.solution import Solution

Progress = Callable[[str, float], None]  # stage name, fraction done in [0, 1]


class Method(Protocol):
    """An estimator of whole flights."""

    summary: str

    def solve(self, problem: NavigationProblem, progress: Progress) -> Solution: ...


@dataclass(frozen=True, slots=True)
class MethodInfo:
    name: str
    path: str  # "package.module:Class"
    summary: str


BUILT_IN = (MethodInfo("graph", "factorgraph.graphs.batch:Batch", "GTSAM factor graph over the whole flight"),)


def methods() -> dict[str, MethodInfo]:
    """All methods, ours first."""
    found = {m.name: m for m in BUILT_IN}
    for entry in entry_points(group="relnav.methods"):
        found.setdefault(entry.name, MethodInfo(entry.name, entry.value, f"from {entry.dist.name if entry.dist else '?'}"))
    return found


def create(name: str) -> Method:
    """An estimator by name. Raises InputError with the nearest names for an unknown one."""
    known = methods()
    if name not in known:
        near = difflib.get_close_matches(name, known, n=1)
        hint = f"; did you mean {near[0]}?" if near else ""
        raise InputError(f"no method named {name}{hint} There are: {', '.join(known)}")
    module, _, attribute = known[name].path.partition(":")
    method: Method = getattr(import_module(module), attribute)()
    return method


def solve(problem: NavigationProblem, method: str = "graph", progress: Progress | None = None) -> Solution:
    """Solve a problem with a method by name."""
    return create(method).solve(problem, progress or (lambda stage, fraction: None))
