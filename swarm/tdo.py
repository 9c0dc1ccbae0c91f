"""Tasmanian devil optimisation (TDO): members move towards better ones and away from worse ones.

In iteration t = 1 .. T every member i picks another one k at random ("carrion", or "prey") and tries

    y = X_i + r o (X_k - I X_i)    where f_k < f_i,    y = X_i + r o (X_i - X_k)    otherwise

Half of the members, drawn anew each time, took prey (strategy 2) and then search around where they are:

    y = X_i + (2 r - 1) o R o X_i,    R = 0.01 (1 - t / T)

Points are clipped to the box and kept where they are better. r is uniform in [0, 1) for each coordinate; I is 1 or 2, one draw
for the member. That makes about 1.5 N T evaluations. In "tdo-chase-all", which other packages ship, every member chases: 2 N T.

A compiled cost lets members move in place as published, each against what the others have become by then. A Python cost is asked
for populations: all members try their first move against the population at the start of the iteration, then those that
chase try their second.

The moves depend on where the origin is: X_k - 2 X_i pulls towards it, and the chase shrinks with |X_i|. A problem whose minimum
lies at the origin is easier than the same elsewhere, so search in deviations from a first guess.

Source: Dehghani, Hubalovsky and Trojovsky (2022); the share of strategy 2 is theirs, as later texts omit it.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit
from numba.core import types
from numpy.typing import ArrayLike

from swarm.box import box, check_count, check_range, first_points
from swarm.compiled import ACCOUNT, COST, GENERATOR, MATRIX, VECTOR, CompiledCost, compiled_when_called
from swarm.result import SwarmResult
from swarm.search import EVALS, ITERATION, Search, close, note
from swarm.types import Array, Callback, Cost, IntArray

CHASING = 0.5  # share of members that take strategy 2
RADIUS = 0.01  # of the chase at first, relative to the coordinates
PICK, DOUBLE, STRATEGY, R = 0, 1, 2, 3  # random numbers of a member: which other one, I, strategy, r of each coordinate


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
    chase_all: bool = False,
    radius: float = RADIUS,
) -> SwarmResult:
    """Minimise a cost inside a box. Arguments as in `swarm.minimize`, and:

    Parameters
    ----------
    n_iter : T, after which the search ends; where None, what the evaluations allow on average
    chase_all : every member chases ("tdo-chase-all")
    radius : R at t = 0

    Raises ValueError for bounds, options or costs of a wrong shape or value. Source: Dehghani et al. (2022).
    """
    low, high = box(bounds)
    check_count("n_members", n_members, 2)
    check_range("radius", radius, 0.0)
    search = Search(cost, max_evals, n_iter, target, callback, low.size)
    share = 1.0 if chase_all else CHASING
    T = float(n_iter or max(1.0, np.ceil((max_evals - n_members) / ((1 + share) * n_members))))
    X = first_points(rng, min(n_members, max_evals), x0, low, high)
    f = search.evaluate(X)
    goes_on = search.goes_on()
    if isinstance(cost, CompiledCost):
        while goes_on:
            account = search.account()
            _run(cost.function, cost.data, rng, X, f, low, high, share, radius, T, *account)
            goes_on = search.take(account)
    while goes_on:
        _iterate(search, rng, X, f, low, high, share, radius * max(0.0, 1 - (search.iteration + 1) / T))
        goes_on = search.goes_on()
    return search.result()


def _iterate(
    search: Search, rng: np.random.Generator, X: Array, f: Array, low: Array, high: Array, share: float, radius: float
) -> None:
    """One iteration, a population at a time."""
    U = rng.random((min(len(X), search.left), R + low.size))
    Y = np.empty((len(U), low.size))
    _pick_all(U, X, f, low, high, Y)
    members = np.arange(len(U))
    _keep(members, Y, search.evaluate(Y), X, f)
    chasing = np.flatnonzero(U[:, STRATEGY] < share)[: search.left]
    if chasing.size:
        Y = np.clip(X[chasing] * (1 + radius * (2 * rng.random((chasing.size, low.size)) - 1)), low, high)
        _keep(chasing, Y, search.evaluate(Y), X, f)


@njit(cache=True, error_model="numpy")
def _pick(u: Array, i: int, X: Array, f: Array, low: Array, high: Array, y: Array) -> None:
    """First move of member i by its random numbers u (3 + n,), into y (n,)."""
    k = int(u[PICK] * (len(X) - 1))
    k += k >= i
    twice = 2.0 if u[DOUBLE] < 0.5 else 1.0
    for j in range(y.size):
        way = X[k, j] - twice * X[i, j] if f[k] < f[i] else X[i, j] - X[k, j]
        y[j] = min(max(X[i, j] + u[R + j] * way, low[j]), high[j])


@njit(cache=True, error_model="numpy")
def _pick_all(U: Array, X: Array, f: Array, low: Array, high: Array, Y: Array) -> None:
    for i in range(len(U)):
        _pick(U[i], i, X, f, low, high, Y[i])


@njit(cache=True, error_model="numpy")
def _keep(members: IntArray, Y: Array, f_Y: Array, X: Array, f: Array) -> None:
    """Points Y that are better than their members' become theirs."""
    for m in range(members.size):
        i = members[m]
        if f_Y[m] < f[i]:
            f[i] = f_Y[m]
            X[i] = Y[m]


@compiled_when_called(
    types.void(
        *(COST, VECTOR, GENERATOR, MATRIX, VECTOR, VECTOR, VECTOR, types.float64, types.float64, types.float64),
        *ACCOUNT,
    )
)
def _run(
    function: Any,
    data: Array,
    rng: np.random.Generator,
    X: Array,
    f: Array,
    low: Array,
    high: Array,
    share: float,
    radius: float,
    T: float,
    counts: IntArray,
    best: Array,
    x_best: Array,
    history: Array,
    history_evals: Array,
    max_evals: int,
) -> None:
    """Iterations in place until the chunk is full or the search ends."""
    n = low.size
    u, y, probe, goes_on = np.empty(R + n), np.empty(n), np.empty(n), True
    while goes_on:
        reach = radius * max(0.0, 1.0 - (counts[ITERATION] + 1) / T)
        for i in range(len(X)):
            if counts[EVALS] >= max_evals:
                break
            for j in range(u.size):
                u[j] = rng.random()
            _pick(u, i, X, f, low, high, y)
            probe[:] = y
            f_y = note(function(probe, data), y, counts, best, x_best)
            if f_y < f[i]:
                f[i] = f_y
                X[i] = y
            if u[STRATEGY] < share and counts[EVALS] < max_evals:
                for j in range(n):
                    y[j] = min(max(X[i, j] * (1.0 + reach * (2.0 * rng.random() - 1.0)), low[j]), high[j])
                probe[:] = y
                f_y = note(function(probe, data), y, counts, best, x_best)
                if f_y < f[i]:
                    f[i] = f_y
                    X[i] = y
        goes_on = close(counts, best, history, history_evals, max_evals)
