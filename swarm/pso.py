"""Particle swarm: every particle is drawn to its own best point and to the best one its neighbours know.

    v <- w v + c1 r1 (own best - x) + c2 r2 (neighbours' best - x),   x <- x + v

with r1, r2 uniform in [0, 1) for each coordinate. Neighbours are all particles ("global") or one to each side ("ring": news
travels slowly, so that several minima are looked at for longer). All particles move, then all are evaluated. A particle that
leaves the box is mirrored at its wall and its velocity turned; speed is limited to half the box, so that one reflection suffices.

Compiled and Python costs see the same points, bit by bit.

Source: Kennedy and Eberhart (1995); Kennedy and Mendes (2002) for the ring; Clerc and Kennedy (2002) for the coefficients of
the constricted swarm.
"""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
from numba import njit
from numba.core import types
from numpy.typing import ArrayLike

from swarm.box import box, check_count, check_range, first_points
from swarm.compiled import ACCOUNT, COST, GENERATOR, MATRIX, VECTOR, CompiledCost, compiled_when_called
from swarm.result import SwarmResult
from swarm.search import CONVERGED, EVALS, Search, close, note
from swarm.types import Array, Callback, Cost, IntArray

W, C1, C2 = 0.7298, 1.49618, 1.49618
MAX_STEP = 0.5  # of the box
TOPOLOGIES = ("global", "ring")


def minimize(
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
    topology: Literal["global", "ring"] = "global",
    xtol: float = 1e-10,
    w: float = W,
    c1: float = C1,
    c2: float = C2,
) -> SwarmResult:
    """Minimise a cost inside a box. Arguments as in `swarm.minimize`, and:

    Parameters
    ----------
    n_iter : iterations after the first population; as many as the evaluations allow where None
    topology : "global" or "ring"
    xtol : stop once all particles and their best points lie within this part of the box in every coordinate
    w, c1, c2 : inertia, pull of the own best, pull of the neighbours' best

    Raises ValueError for bounds, options or costs of a wrong shape or value. Source: Clerc and Kennedy (2002).
    """
    low, high = box(bounds)
    check_count("n_members", n_members, 1)
    if topology not in TOPOLOGIES:
        raise ValueError(f"topology must be one of {', '.join(TOPOLOGIES)}, got {topology}")
    for name, value in (("xtol", xtol), ("w", w), ("c1", c1), ("c2", c2)):
        check_range(name, value, 0.0)
    search = Search(cost, max_evals, n_iter, target, callback, low.size)
    k, reach = min(n_members, max_evals), 1 if topology == "ring" else n_members
    x = first_points(rng, k, x0, low, high)
    fastest = MAX_STEP * (high - low)
    v = fastest * (2.0 * rng.random(x.shape) - 1.0)
    own, own_cost = x.copy(), search.evaluate(x)
    coefficients, tolerance = np.array([w, c1, c2]), xtol * (high - low)
    goes_on = search.goes_on(_contracted(x, own, own_cost, tolerance))
    swarm = (x, v, own, own_cost, coefficients, reach, fastest, low, high, tolerance)
    if isinstance(cost, CompiledCost):
        while goes_on:
            account = search.account()
            _run(cost.function, cost.data, rng, *swarm, *account)
            goes_on = search.take(account)
    while goes_on:
        k = min(k, search.left)
        _fly(rng.random((k, low.size, 2)), *swarm[:-1])
        _keep(x, search.evaluate(x[:k]), own, own_cost)
        goes_on = search.goes_on(_contracted(x, own, own_cost, tolerance))
    return search.result()


@njit(cache=True, error_model="numpy")
def _fly(
    r: Array,
    x: Array,
    v: Array,
    own: Array,
    own_cost: Array,
    coefficients: Array,
    reach: int,
    fastest: Array,
    low: Array,
    high: Array,
) -> None:
    """Move the first particles by random numbers r (k, n, 2)."""
    w, c1, c2 = coefficients
    best = np.argmin(own_cost)
    for i in range(len(r)):
        guide = best if reach > 1 else _best_of_three(own_cost, i)
        for j in range(low.size):
            pull = c1 * r[i, j, 0] * (own[i, j] - x[i, j]) + c2 * r[i, j, 1] * (own[guide, j] - x[i, j])
            speed = min(max(w * v[i, j] + pull, -fastest[j]), fastest[j])
            there = x[i, j] + speed
            if there < low[j]:
                there, speed = 2.0 * low[j] - there, -speed
            elif there > high[j]:
                there, speed = 2.0 * high[j] - there, -speed
            x[i, j], v[i, j] = min(max(there, low[j]), high[j]), speed


@njit(cache=True, error_model="numpy")
def _best_of_three(own_cost: Array, i: int) -> int:
    k = own_cost.size
    best = i
    for other in ((i - 1) % k, (i + 1) % k):
        if own_cost[other] < own_cost[best]:
            best = other
    return best


@njit(cache=True, error_model="numpy")
def _keep(x: Array, f: Array, own: Array, own_cost: Array) -> None:
    """Remember points that are better than the particles' own best ones."""
    for i in range(f.size):
        if f[i] < own_cost[i]:
            own_cost[i] = f[i]
            own[i] = x[i]


@njit(cache=True, error_model="numpy")
def _contracted(x: Array, own: Array, own_cost: Array, tolerance: Array) -> bool:
    """Whether all particles and their best points lie within the tolerance (n,)."""
    if len(x) < 2 or not np.isfinite(own_cost.min()):
        return False
    for j in range(tolerance.size):
        least = most = x[0, j]
        for i in range(len(x)):
            least, most = min(least, x[i, j], own[i, j]), max(most, x[i, j], own[i, j])
            if most - least > tolerance[j]:
                return False
    return True


@compiled_when_called(
    types.void(
        *(COST, VECTOR, GENERATOR, MATRIX, MATRIX, MATRIX, VECTOR, VECTOR, types.int64, VECTOR, VECTOR, VECTOR, VECTOR),
        *ACCOUNT,
    )
)
def _run(
    function: Any,
    data: Array,
    rng: np.random.Generator,
    x: Array,
    v: Array,
    own: Array,
    own_cost: Array,
    coefficients: Array,
    reach: int,
    fastest: Array,
    low: Array,
    high: Array,
    tolerance: Array,
    counts: IntArray,
    best: Array,
    x_best: Array,
    history: Array,
    history_evals: Array,
    max_evals: int,
) -> None:
    """Iterations until the chunk is full or the search ends."""
    n = low.size
    probe, goes_on = np.empty(n), True
    while goes_on:
        k = min(len(x), max_evals - counts[EVALS])
        r, f = np.empty((k, n, 2)), np.empty(k)
        for i in range(k):
            for j in range(n):
                r[i, j, 0] = rng.random()
                r[i, j, 1] = rng.random()
        _fly(r, x, v, own, own_cost, coefficients, reach, fastest, low, high)
        for i in range(k):
            probe[:] = x[i]
            f[i] = note(function(probe, data), x[i], counts, best, x_best)
        _keep(x, f, own, own_cost)
        goes_on = close(counts, best, history, history_evals, max_evals)
        if _contracted(x, own, own_cost, tolerance):
            counts[CONVERGED] = 1
            goes_on = False
