"""Particle swarm: every particle is drawn to its own best point and to the swarm's.

    v <- w v + c1 r1 (own best - x) + c2 r2 (swarm best - x),   x <- x + v

with r1, r2 uniform in [0, 1) for each coordinate. A particle that leaves the box is mirrored at its wall and its velocity
turned; speed is limited to half the box, so that one reflection suffices.

Source: Kennedy and Eberhart (1995); Clerc and Kennedy (2002) for the coefficients of the constricted swarm.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

from swarm.result import SwarmResult, SwarmStatus
from swarm.types import Array

W, C1, C2 = 0.7298, 1.49618, 1.49618
MAX_STEP = 0.5  # of the box
LARGEST_BOUND = 1e300  # beyond it the width of the box may overflow


def minimize(
    cost: Callable[[Array], Array],
    bounds: ArrayLike,
    *,
    rng: np.random.Generator,
    n_particles: int = 30,
    max_evals: int = 5000,
    x0: ArrayLike | None = None,
    target: float = -np.inf,
    xtol: float = 1e-10,
    w: float = W,
    c1: float = C1,
    c2: float = C2,
) -> SwarmResult:
    """Minimise a vectorised cost inside a box.

    Parameters
    ----------
    cost : takes points (k, n), k <= n_particles, and returns their costs (k,); what is not finite counts as infinite
    bounds : (n, 2) lower and upper limit of each coordinate
    rng : source of all randomness
    max_evals : points the cost may see in all; never exceeded
    x0 : (n,) a first point inside the box, given to one particle
    target : stop once the best cost is this low
    xtol : stop once all particles and their best points lie within this part of the box in every coordinate
    w, c1, c2 : inertia, pull of the own best, pull of the swarm's best

    Raises ValueError for bounds, options or costs of a wrong shape or value. Source: Clerc and Kennedy (2002).
    """
    low, high = _box(bounds)
    _check_options(n_particles, max_evals, xtol, w, c1, c2)
    n, width, k = low.size, high - low, min(n_particles, max_evals)
    x = np.clip(low + width * rng.random((k, n)), low, high)
    if x0 is not None:
        x[0] = _first_point(x0, low, high)
    fastest = MAX_STEP * width
    v = fastest * (2.0 * rng.random((k, n)) - 1.0)
    f, n_invalid = _evaluate(cost, x)
    own, own_cost = x.copy(), f
    best = int(np.argmin(own_cost))
    n_evals, history = k, [float(own_cost[best])]
    while (status := _stop(own_cost[best], target, x, own, xtol * width)) is None and n_evals < max_evals:
        k = min(k, max_evals - n_evals)
        pull = c1 * rng.random((k, n)) * (own[:k] - x[:k]) + c2 * rng.random((k, n)) * (own[best] - x[:k])
        v[:k] = np.clip(w * v[:k] + pull, -fastest, fastest)
        x[:k], v[:k] = _reflect(x[:k] + v[:k], v[:k], low, high)
        f, invalid = _evaluate(cost, x[:k])
        n_evals, n_invalid = n_evals + k, n_invalid + invalid
        better = np.flatnonzero(f < own_cost[:k])
        own[better], own_cost[better] = x[better], f[better]
        best = int(np.argmin(own_cost))
        history.append(float(own_cost[best]))
    if np.isinf(own_cost[best]):
        status = SwarmStatus.NO_FINITE_COST
    return SwarmResult(own[best].copy(), history[-1], n_evals, n_invalid, np.array(history), status or SwarmStatus.BUDGET)


def _stop(cost: float, target: float, x: Array, own: Array, tolerance: Array) -> SwarmStatus | None:
    if cost <= target:
        return SwarmStatus.TARGET
    if np.isfinite(cost) and len(x) > 1 and np.all(np.ptp(np.concatenate([x, own]), axis=0) <= tolerance):
        return SwarmStatus.CONVERGED
    return None


def _reflect(x: Array, v: Array, low: Array, high: Array) -> tuple[Array, Array]:
    """Mirror positions that left the box by at most its width, and turn their velocity."""
    below, above = x < low, x > high
    x = np.where(below, 2.0 * low - x, np.where(above, 2.0 * high - x, x))
    return np.clip(x, low, high), np.where(below | above, -v, v)


def _evaluate(cost: Callable[[Array], Array], points: Array) -> tuple[Array, int]:
    """Costs (k,) with infinity where they are not finite, and how many of those."""
    f = np.array(cost(points.copy()), dtype=np.float64)  # both copied: neither side can change the other's
    if f.shape != (len(points),):
        raise ValueError(f"cost must return shape ({len(points)},) for points of shape {points.shape}, got {f.shape}")
    invalid = ~np.isfinite(f)
    f[invalid] = np.inf
    return f, int(np.count_nonzero(invalid))


def _box(bounds: ArrayLike) -> tuple[Array, Array]:
    b = np.asarray(bounds, dtype=np.float64)
    if b.ndim != 2 or b.shape[1] != 2 or b.shape[0] == 0:
        raise ValueError(f"bounds must have shape (n, 2) with n > 0, got {b.shape}")
    wrong = np.flatnonzero(~((b[:, 0] < b[:, 1]) & (np.abs(b) < LARGEST_BOUND).all(axis=1)))
    if wrong.size:
        i = wrong[0]
        raise ValueError(f"bounds[{i}] must be finite with lower < upper, got {b[i].tolist()}")
    return b[:, 0], b[:, 1]


def _first_point(x0: ArrayLike, low: Array, high: Array) -> Array:
    x = np.asarray(x0, dtype=np.float64)
    if x.shape != low.shape:
        raise ValueError(f"x0 must have shape {low.shape} to match bounds, got {x.shape}")
    outside = np.flatnonzero(~((x >= low) & (x <= high)))
    if outside.size:
        i = outside[0]
        raise ValueError(f"x0[{i}] = {x[i]} lies outside its bounds [{low[i]}, {high[i]}]")
    return x


def _check_options(n_particles: int, max_evals: int, xtol: float, w: float, c1: float, c2: float) -> None:
    if n_particles < 1:
        raise ValueError(f"n_particles must be at least 1, got {n_particles}")
    if max_evals < 1:
        raise ValueError(f"max_evals must be at least 1, got {max_evals}")
    if not xtol >= 0:
        raise ValueError(f"xtol must not be negative, got {xtol}")
    for name, value in (("w", w), ("c1", c1), ("c2", c2)):
        if not (np.isfinite(value) and value >= 0):
            raise ValueError(f"{name} must be finite and not negative, got {value}")
