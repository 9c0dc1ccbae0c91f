"""Study `optimisers`: all methods of `swarm` on functions with known optima and on navigation, at equal evaluations.

A job is one seed of a function, or of a navigation snapshot; every method meets the same problem in it. Its parts:

    functions     the optimum lies anywhere in the middle of the box, coordinates as they are and turned
    origin        the optimum lies at the origin, and the same problem moved away, box and all: a method that treats all
                  places alike finds the same up to rounding, one that knows the origin does not
    navigation    one measurement update of relative navigation, searched in normalised and in whitened deviations from the
                  posterior and in raw coordinates

The error of a run is the cost above the optimum; in navigation J/J* - 1, J* by Gauss-Newton. A run ends at its budget of
evaluations, or when its error is too small to matter (`Task.even`); errors below that count as even.

Source: Hansen et al. (2009) for turned functions and equal budgets; Dehghani et al. (2022) for TDO.
"""

from __future__ import annotations

import argparse
import time
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Literal, cast

import numpy as np

import swarm
from factorgraph.errors import InputError
from factorgraph.types import Array
from scenarios.studies.study import Arrays, Job, Outcome, Results, chosen, seeds
from swarm.functions import FUNCTIONS, instance, random_offset, random_place, random_rotation

REVISION = 1  # of what a job computes
DIMENSIONS, QUICK_DIMENSIONS = (6, 12), (6,)
QUICK_FUNCTIONS = ("sphere", "rosenbrock", "rastrigin")
MAX_EVALS, QUICK_EVALS = 24_000, 3_000
N_MEMBERS = 30
GRID_POINTS = 60
SOLVED, EVEN = 1e-6, 1e-8  # of a function's value
SOLVED_RATIO, EVEN_RATIO = 1e-3, 1e-6  # of J/J* - 1
SEARCHES = {
    "pair-O1": 6,
    "pair-O2": 6,
    "pair-O3": 6,
    "formation-O3": 12,
}  # what is drawn (`optimisers_snapshots.DRAWS`) and the objective; number of states that rows see: all of them are searched
BOX_SIGMAS = 3.0  # to either side of the posterior
NAVIGATION: tuple[Literal["normalised", "whitened", "raw"], ...] = ("normalised", "whitened", "raw")  # coordinates


@dataclass(frozen=True, slots=True)
class Task:
    """One problem as the methods meet it."""

    name: str
    cost: swarm.CompiledCost
    bounds: Array  # (n, 2)
    solved: float = SOLVED  # an error this small counts as success
    even: float = EVEN  # errors below are not told apart
    scale: float = 1.0  # error = (cost - offset) / scale
    offset: float = 0.0


@dataclass(frozen=True, slots=True)
class Kind:
    """Tasks that are judged together."""

    title: str
    part: str
    about: str
    seeds_differ: bool = False  # every seed is another problem, not the same one at another place


KINDS = {
    "unimodal": Kind("one minimum", "functions", "sphere, ellipsoid and Rosenbrock's function, shifted, also turned"),
    "multimodal": Kind("many minima", "functions", "Rastrigin, Ackley, Griewank, Schwefel and Levy, shifted, also turned"),
    "origin": Kind("optimum at the origin", "origin", "all functions with their optimum at the origin"),
    "moved": Kind("the same moved away", "origin", "the same problems, moved by one to three half widths of the box"),
    "normalised": Kind("navigation, normalised", "navigation", "searched in deviations over their standard deviations", True),
    "whitened": Kind("navigation, whitened", "navigation", "searched along the axes of the posterior's ellipsoid", True),
    "raw": Kind("navigation, raw", "navigation", "the same snapshots searched in raw coordinates", True),
}
PARTS = tuple(dict.fromkeys(kind.part for kind in KINDS.values()))


def available() -> tuple[str, ...]:
    """Methods whose packages are installed."""
    return tuple(m for m in swarm.METHODS if m != "cma-es" or find_spec("cmaes") is not None)


def grid(max_evals: int) -> Array:
    """Numbers of evaluations (G,) at which histories are kept, evenly spaced in their logarithm."""
    return np.unique(np.round(np.geomspace(min(N_MEMBERS, max_evals), max_evals, GRID_POINTS)))


class OptimisersStudy:
    """Every method on every problem."""

    name = "optimisers"
    summary = "swarm optimisers on test functions and on navigation, at equal evaluations"

    def add_options(self, parser: argparse.ArgumentParser) -> None:
        def several(name: str, known: Sequence[str]) -> None:
            parser.add_argument(name, metavar="NAME", nargs="+", default=list(known), help=f"{', '.join(known)} (all)")

        several("--methods", available())
        several("--parts", PARTS)
        parser.add_argument(
            "--functions", metavar="NAME", nargs="+", help=f"{', '.join(FUNCTIONS)} (all; quick: {', '.join(QUICK_FUNCTIONS)})"
        )
        parser.add_argument(
            "--dimensions",
            metavar="N",
            type=int,
            nargs="+",
            help="of the functions, the smallest at the origin (6, 12; quick: 6)",
        )
        parser.add_argument("--evals", metavar="N", type=int, help=f"budget of a run ({MAX_EVALS}; quick: {QUICK_EVALS})")

    def jobs(self, options: argparse.Namespace) -> Sequence[Job]:
        parts = chosen("part", options.parts, PARTS)
        functions = chosen(
            "function", options.functions or (QUICK_FUNCTIONS if options.quick else tuple(FUNCTIONS)), tuple(FUNCTIONS)
        )
        dimensions = options.dimensions or (QUICK_DIMENSIONS if options.quick else DIMENSIONS)
        max_evals = options.evals if options.evals is not None else QUICK_EVALS if options.quick else MAX_EVALS
        if min(dimensions) < 2:
            raise InputError(f"--dimensions must be at least 2, got {min(dimensions)}")
        if max_evals < N_MEMBERS:
            raise InputError(f"--evals must be at least {N_MEMBERS}, got {max_evals}")
        common = {
            "methods": chosen("method", options.methods, available()),
            "max_evals": max_evals,
            "revision": REVISION,
        }
        return [
            Job(f"{part}-{name}-{n}-{seed:04d}", {"part": part, "name": name, "n": n, "seed": seed} | common)
            for seed in seeds(options, usual=25, quick=3)
            for part in parts
            for name, n in _problems(part, functions, dimensions)
        ]

    def run(self, job: Job) -> Arrays:
        p = job.parameters
        return trial(p["part"], p["name"], p["n"], p["seed"], p["methods"], p["max_evals"])

    def finish(self, results: Results[Job], folder: Path, options: argparse.Namespace) -> Outcome:
        from scenarios.studies.optimisers_record import write

        return write(results, folder, options)


STUDY = OptimisersStudy()


def _problems(part: str, functions: Sequence[str], dimensions: Sequence[int]) -> list[tuple[str, int]]:
    """Names of a part's problems and their numbers of coordinates."""
    if part == "navigation":
        return list(SEARCHES.items())
    used = [min(dimensions)] if part == "origin" else dict.fromkeys(dimensions)
    return [(name, n) for name in functions for n in used]


def trial(part: str, name: str, n: int, seed: int, methods: Sequence[str], max_evals: int) -> dict[str, Array]:
    """One seed of a problem, KIND/TASK/NAME: arrays over the methods.

    error (M,), evals (M,), hit (M,) evaluations until solved (NaN: not), runtime_s (M,), history (M, G) errors on `grid`.
    """
    out: dict[str, Array] = {}
    for kind, task in tasks(part, name, n, seed):
        runs = [_run(task, method, _stream(seed, part, name, n), max_evals) for method in methods]
        out |= {f"{kind}/{task.name}/{key}": np.array([run[key] for run in runs]) for key in runs[0]}
        out[f"{kind}/{task.name}/levels"] = np.array([task.solved, task.even])
    return out


def _stream(seed: int, *names: object) -> np.random.Generator:
    """The same for all methods, and for a problem wherever it is placed."""
    return np.random.default_rng([seed, zlib.crc32("/".join(map(str, names)).encode())])


def _run(task: Task, method: str, rng: np.random.Generator, max_evals: int) -> dict[str, Any]:
    goal = task.offset + task.scale * task.even
    began = time.perf_counter()
    found = swarm.minimize(method, task.cost, task.bounds, rng=rng, max_evals=max_evals, n_members=N_MEMBERS, target=goal)
    spent = time.perf_counter() - began
    errors = (found.history - task.offset) / task.scale
    solved = np.flatnonzero(errors <= task.solved)
    return {
        "error": (found.cost - task.offset) / task.scale,
        "evals": float(found.n_evals),
        "hit": float(found.history_evals[solved[0]]) if len(solved) else np.nan,
        "runtime_s": spent,
        "history": on_grid(found.history_evals, errors, grid(max_evals)),
    }


def on_grid(evals: Array, errors: Array, at: Array) -> Array:
    """Best error (G,) known after `at` (G,) evaluations; before the first population is complete, its error."""
    return np.asarray(errors[np.maximum(np.searchsorted(evals, at, side="right") - 1, 0)])


# problems


def tasks(part: str, name: str, n: int, seed: int) -> Iterator[tuple[str, Task]]:
    """Kinds and tasks of one seed."""
    return TASKS[part](name, n, np.random.default_rng([seed, n, zlib.crc32(name.encode())]))


def _shifted(name: str, n: int, rng: np.random.Generator) -> Iterator[tuple[str, Task]]:
    f = FUNCTIONS[name]
    kind = "multimodal" if f.is_multimodal else "unimodal"
    x_best, C = random_place(name, n, rng), random_rotation(n, rng)
    yield kind, _task(f"{name}, n = {n}", name, n, x_best=x_best)
    if f.turns:
        yield kind, _task(f"{name} turned, n = {n}", name, n, x_best=x_best, C=C)


def _moved(name: str, n: int, rng: np.random.Generator) -> Iterator[tuple[str, Task]]:
    offset = random_offset(name, n, rng)
    yield "origin", _task(f"{name}, n = {n}", name, n)
    yield "moved", _task(f"{name}, n = {n}", name, n, offset=offset)


def _task(label: str, name: str, n: int, **place: Array) -> Task:
    placed = instance(name, n, **place)
    return Task(label, placed.cost, placed.bounds)


def _navigation(name: str, n: int, rng: np.random.Generator) -> Iterator[tuple[str, Task]]:
    from scenarios.studies.optimisers_snapshots import DRAWS
    from swarm import gauss_newton
    from swarm.corrector import CorrectorSettings, posed
    from swarm.objective import Which

    drawn, _, which = name.partition("-")
    snapshot = DRAWS[drawn](rng)
    for kind in NAVIGATION:
        settings = CorrectorSettings(objective=cast(Which, which), others="kept", coordinates=kind, box_sigmas=BOX_SIGMAS)
        within, cost = posed(settings, snapshot)
        best = gauss_newton.minimize(cost, within.bounds, within.start).cost
        yield kind, Task(f"{name}, n = {n}", cost.compiled(), within.bounds, SOLVED_RATIO, EVEN_RATIO, scale=best, offset=best)


TASKS: Mapping[str, Callable[[str, int, np.random.Generator], Iterator[tuple[str, Task]]]] = {
    "functions": _shifted,
    "origin": _moved,
    "navigation": _navigation,
}
