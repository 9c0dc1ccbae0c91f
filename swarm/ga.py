"""Genetic algorithm with real genes: parents are chosen by fitness, children lie between and around them.

    parent = the better of two members drawn at random (tournament), twice
    child gene = a + u (b - a),  u even in [-alpha, 1 + alpha]      with probability 0.9 for the child (BLX-alpha blend);
                                                                    otherwise the child is the first parent
    child gene += sigma_t N(0, 1)                                   with probability 1/n for each gene (mutation)
    sigma_t = width of the box * first step * (last step / first step)^(t / T)

The best member lives on unchanged (elitism of one), so that a generation costs n_members - 1 evaluations. The step of the
mutation falls geometrically: equally many generations search at every scale, from a tenth of the box to a millionth. A child
of blend takes its spread from its parents, so that without mutation all would end where the population has contracted.
Children that leave the box are clipped to it.

Compiled and Python costs see the same points, bit by bit.

Source: Eshelman and Schaffer (1993) for the blend; Deb (2001), ch. 4; the schedule is that of non-uniform mutation
(Michalewicz 1996) with a geometric instead of a power law.
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

CROSSOVER, ALPHA = 0.9, 0.5
FIRST_STEP, LAST_STEP = 0.1, 1e-6  # of mutation, in widths of the box
BLEND, GENES = 4, 5  # random numbers of a child: four in tournaments, whether it blends, then two for each gene


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
    crossover: float = CROSSOVER,
    alpha: float = ALPHA,
    mutation: float | None = None,
    first_step: float = FIRST_STEP,
    last_step: float = LAST_STEP,
) -> SwarmResult:
    """Minimise a cost inside a box. Arguments as in `swarm.minimize`, and:

    Parameters
    ----------
    n_iter : generations T, after which the search ends; where None, what the evaluations allow
    crossover : probability that a child blends two parents
    alpha : how far beyond its parents a child may lie, in their distance
    mutation : probability for a gene; 1 / n where None
    first_step, last_step : standard deviations of mutation at first and at last, in widths of the box

    Raises ValueError for bounds, options or costs of a wrong shape or value. Source: Deb (2001).
    """
    low, high = box(bounds)
    n = low.size
    check_count("n_members", n_members, 2)
    mutation = 1.0 / n if mutation is None else mutation
    check_range("crossover", crossover, 0.0, 1.0)
    check_range("mutation", mutation, 0.0, 1.0)
    check_range("alpha", alpha, 0.0)
    check_range("first_step", first_step, np.finfo(float).tiny, 1.0)
    check_range("last_step", last_step, np.finfo(float).tiny, first_step)
    search = Search(cost, max_evals, n_iter, target, callback, n)
    T = float(n_iter or max(1.0, np.ceil((max_evals - n_members) / (n_members - 1))))
    X = first_points(rng, min(n_members, max_evals), x0, low, high)
    f = search.evaluate(X)
    goes_on = search.goes_on()
    rates = np.array([crossover, alpha, mutation])
    steps = np.array([first_step, last_step, T])
    if isinstance(cost, CompiledCost):
        while goes_on:
            account = search.account()
            _run(cost.function, cost.data, rng, X, f, low, high, rates, steps, *account)
            goes_on = search.take(account)
    while goes_on:
        k = min(len(X) - 1, search.left)
        Y = np.empty((k, n))
        sigma = _step(search.iteration + 1, steps)
        _breed(rng.random((k, GENES + 2 * n)), sigma * rng.standard_normal((k, n)), X, f, low, high, rates, Y)
        _succeed(Y, search.evaluate(Y), X, f)
        goes_on = search.goes_on()
    return search.result()


@njit(cache=True, error_model="numpy")
def _step(t: int, steps: Array) -> float:
    """Mutation's standard deviation in generation t, in widths of the box; steps: first, last, T."""
    return float(steps[0] * (steps[1] / steps[0]) ** min(t / steps[2], 1.0))


@njit(cache=True, error_model="numpy")
def _winner(u: float, w: float, f: Array) -> int:
    """The better of two members drawn by u and w."""
    a, b = int(u * f.size), int(w * f.size)
    return a if f[a] <= f[b] else b


@njit(cache=True, error_model="numpy")
def _breed(U: Array, S: Array, X: Array, f: Array, low: Array, high: Array, rates: Array, Y: Array) -> None:
    """Children Y (k, n) by random numbers U (k, 5 + 2 n) and normal ones times sigma, S (k, n)."""
    crossover, alpha, mutation = rates
    n = low.size
    for i in range(len(Y)):
        a, b = _winner(U[i, 0], U[i, 1], f), _winner(U[i, 2], U[i, 3], f)
        for j in range(n):
            gene = X[a, j]
            if U[i, BLEND] < crossover:
                gene += ((1.0 + 2.0 * alpha) * U[i, GENES + j] - alpha) * (X[b, j] - gene)
            if U[i, GENES + n + j] < mutation:
                gene += (high[j] - low[j]) * S[i, j]
            Y[i, j] = min(max(gene, low[j]), high[j])


@njit(cache=True, error_model="numpy")
def _succeed(Y: Array, f_Y: Array, X: Array, f: Array) -> None:
    """Children follow their parents, of whom the best one stays as the first member."""
    best = np.argmin(f)
    f[0], X[0] = f[best], X[best].copy()
    f[1 : 1 + f_Y.size] = f_Y
    X[1 : 1 + f_Y.size] = Y


@compiled_when_called(types.void(*(COST, VECTOR, GENERATOR, MATRIX, VECTOR, VECTOR, VECTOR, VECTOR, VECTOR), *ACCOUNT))
def _run(
    function: Any,
    data: Array,
    rng: np.random.Generator,
    X: Array,
    f: Array,
    low: Array,
    high: Array,
    rates: Array,
    steps: Array,
    counts: IntArray,
    best: Array,
    x_best: Array,
    history: Array,
    history_evals: Array,
    max_evals: int,
) -> None:
    """Generations until the chunk is full or the search ends."""
    n = low.size
    probe, goes_on = np.empty(n), True
    while goes_on:
        k = min(len(X) - 1, max_evals - counts[EVALS])
        U, S, Y, f_Y = np.empty((k, GENES + 2 * n)), np.empty((k, n)), np.empty((k, n)), np.empty(k)
        sigma = _step(counts[ITERATION] + 1, steps)
        for i in range(k):
            for j in range(GENES + 2 * n):
                U[i, j] = rng.random()
        for i in range(k):
            for j in range(n):
                S[i, j] = sigma * rng.standard_normal()
        _breed(U, S, X, f, low, high, rates, Y)
        for i in range(k):
            probe[:] = Y[i]
            f_Y[i] = note(function(probe, data), Y[i], counts, best, x_best)
        _succeed(Y, f_Y, X, f)
        goes_on = close(counts, best, history, history_evals, max_evals)
