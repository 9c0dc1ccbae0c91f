"""A search under way: counted evaluations, the best point met, the history, and when to stop.

Optimisers ask `evaluate` for the costs of a population, then `goes_on` whether to make another. Compiled loops keep the same
account in arrays (`Account`, kernels `note` and `close`) and hand it back with `take`.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numba import njit

from swarm.box import check_count
from swarm.result import SwarmResult, SwarmStatus
from swarm.types import Array, Callback, Cost, IntArray, Progress

EVALS, INVALID, POPULATIONS, ITERATION, CONVERGED = range(5)  # of the counts of a compiled loop
CHUNK = 64  # iterations of a compiled loop between two returns to Python, where an interrupt is heard


@dataclass(slots=True)
class Search:
    """The account of one search; raises ValueError for budgets below one and for costs of a wrong shape."""

    cost: Cost
    max_evals: int
    n_iter: int | None
    target: float
    callback: Callback | None
    n: int
    n_evals: int = 0
    n_invalid: int = 0
    iteration: int = -1  # the first population is no iteration
    best_cost: float = np.inf
    status: SwarmStatus | None = None
    x: Array = field(init=False)
    history: list[float] = field(default_factory=list)
    history_evals: list[int] = field(default_factory=list)

    def __post_init__(self) -> None:
        check_count("max_evals", self.max_evals, 1)
        if self.n_iter is not None:
            check_count("n_iter", self.n_iter, 1)
        if np.isnan(self.target):
            raise ValueError("target must be a number or minus infinity, got nan")
        self.x = np.full(self.n, np.nan)

    @property
    def left(self) -> int:
        """Evaluations left."""
        return self.max_evals - self.n_evals

    def evaluate(self, points: Array) -> Array:
        """Costs (k,) of points (k, n), infinite where they are not finite."""
        f = np.array(self.cost(points.copy()), dtype=np.float64)  # both copied: neither side can change the other's
        if f.shape != (len(points),):
            raise ValueError(f"cost must return shape ({len(points)},) for points of shape {points.shape}, got {f.shape}")
        finite = np.isfinite(f)
        if not finite.all():
            self.n_invalid += int(np.count_nonzero(~finite))
            f[~finite] = np.inf
        self.n_evals += len(points)
        best = int(f.argmin())
        if f[best] < self.best_cost or self.n_evals == len(points):
            self.best_cost, self.x = float(f[best]), points[best].copy()
        return f

    def goes_on(self, contracted: bool = False) -> bool:
        """Close a population; whether another one may follow."""
        self.history.append(self.best_cost)
        self.history_evals.append(self.n_evals)
        self.iteration += 1
        return self._judge(contracted)

    def _judge(self, contracted: bool) -> bool:
        if self.best_cost <= self.target:
            self.status = SwarmStatus.TARGET
        elif contracted:
            self.status = SwarmStatus.CONVERGED
        elif self.left <= 0:
            self.status = SwarmStatus.BUDGET
        elif self.n_iter is not None and self.iteration >= self.n_iter:
            self.status = SwarmStatus.ITERATIONS
        if self.callback is not None and self.callback(Progress(self.n_evals, self.best_cost, self.x.copy())):
            self.status = self.status or SwarmStatus.STOPPED
        return self.status is None

    def account(self) -> Account:
        """The account of the next iterations of a compiled loop: one where a callback waits for it."""
        chunk = 1 if self.callback is not None else CHUNK
        if self.n_iter is not None:
            chunk = min(chunk, self.n_iter - self.iteration)
        counts = np.array([self.n_evals, self.n_invalid, 0, self.iteration, 0])
        best, history, history_evals = np.array([self.best_cost, self.target]), np.empty(chunk), np.empty(chunk)
        return Account(counts, best, self.x.copy(), history, history_evals, self.max_evals)

    def take(self, account: Account) -> bool:
        """Take over what a compiled loop has done; whether it may go on."""
        counts, n = account.counts, int(account.counts[POPULATIONS])
        self.n_evals, self.n_invalid, self.iteration = int(counts[EVALS]), int(counts[INVALID]), int(counts[ITERATION])
        self.best_cost, self.x = float(account.best[0]), account.x
        self.history.extend(account.history[:n].tolist())
        self.history_evals.extend(account.history_evals[:n].astype(int).tolist())
        return self._judge(bool(counts[CONVERGED]))

    def result(self) -> SwarmResult:
        """Where the search ended."""
        status = SwarmStatus.NO_FINITE_COST if np.isinf(self.best_cost) else self.status or SwarmStatus.BUDGET
        evals = np.array(self.history_evals, dtype=np.float64)
        return SwarmResult(self.x, self.best_cost, self.n_evals, self.n_invalid, np.array(self.history), status, evals)


class Account(NamedTuple):
    """What a compiled loop counts, in arrays it can write; its last arguments."""

    counts: IntArray  # evaluations, invalid ones, populations of this chunk, iteration, converged
    best: Array  # best cost, target
    x: Array  # (n,) best point
    history: Array  # (chunk,)
    history_evals: Array  # (chunk,)
    max_evals: int


@njit(cache=True, error_model="numpy")
def note(f: float, y: Array, counts: IntArray, best: Array, x: Array) -> float:
    """Count a cost met at y; infinite where it is not finite."""
    counts[EVALS] += 1
    if not np.isfinite(f):
        counts[INVALID] += 1
        return np.inf
    if f < best[0]:
        best[0] = f
        x[:] = y
    return f


@njit(cache=True, error_model="numpy")
def close(counts: IntArray, best: Array, history: Array, history_evals: Array, max_evals: int) -> bool:
    """Close a population; whether the loop may go on."""
    history[counts[POPULATIONS]] = best[0]
    history_evals[counts[POPULATIONS]] = counts[EVALS]
    counts[POPULATIONS] += 1
    counts[ITERATION] += 1
    return bool(best[0] > best[1] and counts[EVALS] < max_evals and counts[POPULATIONS] < history.size)
