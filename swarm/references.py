"""Well-kept optimisers of others behind the same interface, to compare with.

CMA-ES is that of the package `cmaes`; differential evolution that of SciPy (best1bin, deferred updating, a population at a
time, without polish). Both draw from the passed generator alone, and both search the box scaled to unit width.

Source: Hansen and Ostermeier (2001); Storn and Price (1997).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from scipy import optimize

from swarm.box import box, check_count, check_range, first_point, first_points
from swarm.compiled import CompiledCost
from swarm.result import SwarmResult, SwarmStatus
from swarm.search import Search
from swarm.types import Array, Callback, Cost

SIGMA = 0.3  # of the box, first standard deviation of CMA-ES


def cma_es(
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
    sigma: float = SIGMA,
) -> SwarmResult:
    """Covariance matrix adaptation from x0, or the middle of the box, with a first standard deviation of so much of the box.

    Arguments as in `swarm.minimize`; x0 is also one point of the first population. Ends as CONVERGED where the package sees
    nothing left to gain.

    Raises ValueError for bounds, options or costs of a wrong shape or value, ImportError where `cmaes` is not installed.
    """
    try:
        from cmaes import CMA
    except ImportError as error:
        raise ImportError('cma-es needs the package cmaes: pip install "relnav[optimisers]"') from error
    low, high = box(bounds)
    if low.size < 2:
        raise ValueError(f"cma-es needs bounds of at least 2 coordinates, got {low.size}")
    check_count("n_members", n_members, 2)
    check_range("sigma", sigma, np.finfo(float).tiny)
    search, width = Search(cost, max_evals, n_iter, target, callback, low.size), high - low
    start = None if x0 is None else (first_point(x0, low, high) - low) / width
    unit = np.tile([0.0, 1.0], (low.size, 1))
    mean = np.full(low.size, 0.5) if start is None else start
    model = CMA(mean, sigma, bounds=unit, population_size=n_members, seed=int(rng.integers(2**32)))
    goes_on = True
    while goes_on:
        Y = np.array([model.ask() for _ in range(min(n_members, search.left))])
        if start is not None:
            Y[0], start = start, None
        f = search.evaluate(np.clip(low + width * Y, low, high))
        if len(Y) == n_members:
            model.tell([(y, float(c)) for y, c in zip(Y, f, strict=True)])
        goes_on = search.goes_on(bool(np.isfinite(search.best_cost) and model.should_stop()))
    return search.result()


def differential_evolution(
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
) -> SwarmResult:
    """Differential evolution of SciPy, best1bin with dithered mutation.

    Arguments as in `swarm.minimize`. Ends as CONVERGED where all members cost the same.

    Raises ValueError for bounds, options or costs of a wrong shape or value.
    """
    low, high = box(bounds)
    check_count("n_members", n_members, 5)
    search, width = Search(cost, max_evals, n_iter, target, callback, low.size), high - low
    first = first_points(rng, n_members, x0, low, high)

    def costs(Y: Array) -> Array:
        """Of columns (n, k); those the search may no longer ask are infinite."""
        f = np.full(Y.shape[1], np.inf)
        k = 0 if search.status else min(Y.shape[1], search.left)
        if k:
            f[:k] = search.evaluate(np.clip(low + width * Y[:, :k].T, low, high))
        if not search.history:
            search.goes_on()
        return f

    try:
        found = optimize.differential_evolution(
            costs,
            np.tile([0.0, 1.0], (low.size, 1)),
            init=(first - low) / width,
            maxiter=n_iter or max_evals,
            callback=lambda intermediate_result: search.status is not None or not search.goes_on(),
            tol=0.0,
            atol=0.0,
            rng=rng,
            polish=False,
            updating="deferred",
            vectorized=True,
        )
    except RuntimeError as error:  # SciPy's wrapping of errors from inside the cost
        if isinstance(error.__cause__, TypeError | ValueError):
            raise error.__cause__ from None
        raise
    if found.success and search.status is None:
        search.status = SwarmStatus.CONVERGED
    return search.result()
