"""All optimisers by name, behind one call."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from swarm import ga, pso, references, tdo
from swarm.compiled import CompiledCost
from swarm.result import SwarmResult
from swarm.types import Callback, Cost


@dataclass(frozen=True, slots=True)
class Optimiser:
    """A method and where it comes from."""

    summary: str
    source: str
    minimize: Callable[..., SwarmResult]
    is_compiled_capable: bool  # its whole loop is compiled where the cost is

    @property
    def options(self) -> tuple[str, ...]:
        """Names of what this method takes besides the arguments of all."""
        arguments = inspect.signature(self.minimize).parameters
        fixed = self.minimize.keywords if isinstance(self.minimize, partial) else {}
        return tuple(a for a in arguments if a not in COMMON and a not in fixed)


COMMON = ("cost", "bounds", "rng", "max_evals", "n_members", "n_iter", "x0", "target", "callback")
METHODS: Mapping[str, Optimiser] = MappingProxyType(
    {
        "tdo": Optimiser(
            "Tasmanian devil optimisation as published: half of the members chase",
            "Dehghani, Hubalovsky and Trojovsky (2022)",
            tdo.minimize,
            True,
        ),
        "tdo-chase-all": Optimiser(
            "Tasmanian devil optimisation as other packages ship it: every member chases",
            "variant of Dehghani, Hubalovsky and Trojovsky (2022)",
            partial(tdo.minimize, chase_all=True),
            True,
        ),
        "pso": Optimiser(
            "particle swarm, all particles neighbours, constricted",
            "Kennedy and Eberhart (1995); Clerc and Kennedy (2002)",
            pso.minimize,
            True,
        ),
        "pso-ring": Optimiser(
            "particle swarm, one neighbour to each side, constricted",
            "Kennedy and Mendes (2002); Clerc and Kennedy (2002)",
            partial(pso.minimize, topology="ring"),
            True,
        ),
        "ga": Optimiser(
            "genetic algorithm: tournament, blend crossover, Gaussian mutation of shrinking step, elitism",
            "Eshelman and Schaffer (1993); Deb (2001)",
            ga.minimize,
            True,
        ),
        "cma-es": Optimiser(
            "covariance matrix adaptation, package cmaes",
            "Hansen and Ostermeier (2001)",
            references.cma_es,
            False,
        ),
        "de": Optimiser(
            "differential evolution, best1bin, SciPy",
            "Storn and Price (1997)",
            references.differential_evolution,
            False,
        ),
    }
)


def minimize(
    method: str,
    cost: Cost | CompiledCost,
    bounds: ArrayLike,
    *,
    rng: np.random.Generator,
    max_evals: int = 24_000,
    n_members: int = 30,
    n_iter: int | None = None,
    x0: ArrayLike | None = None,
    target: float = -np.inf,
    callback: Callback | None = None,
    **options: Any,
) -> SwarmResult:
    """Minimise a cost inside a box by a named method.

    Parameters
    ----------
    method : one of `METHODS`
    cost : takes points (k, n), k <= n_members, and returns their costs (k,), or a `CompiledCost`; what is not finite counts
        as infinite
    bounds : (n, 2) lower and upper limit of each coordinate
    rng : source of all randomness
    max_evals : points the cost may see in all; never exceeded
    n_members : size of the population
    n_iter : iterations after the first population, and the length of schedules; from max_evals where None
    x0 : (n,) a first point inside the box, given to one member
    target : stop once the best cost is this low
    callback : hears of every population; the search stops where it returns True
    options : of the method

    Raises ValueError for an unknown method or option, and for bounds, options or costs of a wrong shape or value.
    """
    if not callable(cost):
        raise ValueError(f"cost must be a function of points (k, n) or a CompiledCost, got {cost!r}")
    if not isinstance(rng, np.random.Generator):
        raise ValueError(f"rng must be a numpy.random.Generator, got {rng!r}")
    if method not in METHODS:
        raise ValueError(f"method must be one of {', '.join(METHODS)}, got {method}")
    chosen = METHODS[method]
    for name in options:
        if name not in chosen.options:
            raise ValueError(f"{method} takes the options {', '.join(chosen.options) or 'none'}, got {name}")
    return chosen.minimize(
        cost,
        bounds,
        rng=rng,
        max_evals=max_evals,
        n_members=n_members,
        n_iter=n_iter,
        x0=x0,
        target=target,
        callback=callback,
        **options,
    )
