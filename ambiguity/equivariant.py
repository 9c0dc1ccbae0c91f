"""Best integer equivariant estimation: the mean of all integer vectors, weighted with their likelihood.

    a_bie = sum_z z w(z) / sum_z w(z),   w(z) = exp(-|a_float - z|^2 / 2)   in the metric of inv(Q)

Of all estimators that follow integer shifts of the data it has the least mean squared error; it tends to the integer
least-squares solution for precise ambiguities and to a_float for imprecise ones.

The sum runs over the vectors with |a_float - z|^2 <= radius. After decorrelation, with conditional variances D,
every one-dimensional sum of the sequential product is largest where its centre is an integer and smallest half-way,

    theta(s, c) = sum_j exp(-s (j - c)^2),   theta(s, 1/2) <= theta(s, c) <= theta(s, 0)

so that for every 0 < t < 1 the weight outside is at most exp(-(1 - t) radius / 2) prod_k theta(t / (2 D_k), 0), and the
whole weight at least the larger of the best vector's and prod_k theta(1 / (2 D_k), 1/2). The radius follows from the
tolerated share, and what is reported as neglected is a bound, not an estimate.

Source: Teunissen (2003) for the estimator; Teunissen (2005) for its computation inside an ellipsoid; the bound on what
is neglected is the Chernoff bound of the weights.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ambiguity import _kernels as kernels
from ambiguity._input import at_least_one, pair, raise_fault, require_sound
from ambiguity.types import Array

TOLERANCE = 1e-9
MAX_NODES = 2_000_000  # at most seconds for tens of ambiguities
SHRINK = 0.7  # of the radius whenever the budget is spent
TILTS = np.concatenate([np.geomspace(1e-3, 0.5, 24)[:-1], 1.0 - np.geomspace(1e-3, 0.5, 24)[::-1]])  # values of t tried


@dataclass(frozen=True, slots=True)
class BieResult:
    """The weighted mean of the integer vectors inside a radius."""

    a_bie: Array  # (n,) [cyc]
    covariance: Array  # (n, n) [cyc^2] spread of the weighted integers about a_bie: its mean squared error given the data
    best_weight: float  # share of the nearest vector at least: the probability that it is right, the model being right
    count: int  # integer vectors summed
    radius: float  # largest squared norm summed
    neglected: float  # upper bound of the share of the weight outside
    proven: bool  # the neglected share is within the tolerance
    nodes: int  # integers tried, spent attempts included


def best_integer_equivariant(
    a_float: ArrayLike, Q: ArrayLike, tolerance: float = TOLERANCE, max_nodes: int = MAX_NODES
) -> BieResult:
    """Minimum mean squared error estimate of the ambiguities among those that follow integer shifts.

    Parameters
    ----------
    a_float : (n,) float ambiguities [cyc], of any size up to 2e15
    Q : (n, n) their covariance [cyc^2]
    tolerance : share of the weight that may be neglected, in (0, 1)
    max_nodes : integers to try in one sum; where they do not suffice the radius shrinks until they do, and `neglected`
        tells what that may have cost

    Raises ValueError for unusable input, as `integer_least_squares`. Source: Teunissen (2003).
    """
    a, Q = pair(a_float, Q)
    budget = at_least_one("max_nodes", max_nodes)
    if not 0 < tolerance < 1:
        raise ValueError(f"tolerance must lie between 0 and 1, got {tolerance}")
    n = a.size
    if n == 0:
        return BieResult(np.zeros(0), np.zeros((0, 0)), 1.0, 1, 0.0, 0.0, True, 0)
    require_sound(a, Q)
    offset, remainder = kernels.split(a)
    code, row, value, U, D, Y, z_float = kernels.reduce_without_Z(remainder, Q)
    if code != kernels.OK:
        raise_fault(code, row, row, value, Q)
    best, norms, nodes, _ = kernels.search(U, D, z_float, 1, budget)
    z, least = best[0], float(norms[0])
    # Integers are counted from the nearest vector: the sums keep their digits.
    log_outside = _log_theta(TILTS[:, None] / (2 * D))
    log_whole = max(-0.5 * least, float(_log_theta(1 / (2 * D), half_way=True)))
    radius = float(np.min((log_outside - log_whole - math.log(tolerance)) * 2 / (1 - TILTS)))
    # A radius far beyond the budget need not be tried.
    radius = max(least, min(radius, _radius_of_volume(D, 4.0 * budget)))
    while True:
        total, largest, mean, moment, count, visited, closed = kernels.weigh(U, D, z_float - z, radius, least, budget)
        nodes += visited
        if closed:
            break
        if radius == least:
            # Not even what is nearer than the vector found fits the budget: it stands alone, and nothing is known of the rest.
            total, largest, mean, moment, count, radius = 1.0, 1.0, np.zeros(n), np.zeros((n, n)), 1, 0.0
            break
        radius = max(least, SHRINK * radius)
    log_bound = float(np.min(log_outside - 0.5 * (1 - TILTS) * radius)) + 0.5 * least - math.log(total)
    neglected = min(1.0, math.exp(min(0.0, log_bound)))
    back = Y[:, :n].T
    spread = back @ (moment - np.outer(mean, mean)) @ back.T
    a_bie = offset + back @ (z + mean)
    covariance = 0.5 * (spread + spread.T)
    best_weight = (1.0 - neglected) * largest / total
    return BieResult(a_bie, covariance, best_weight, count, radius, neglected, neglected <= tolerance * (1 + 1e-9), nodes)


def _log_theta(s: Array, half_way: bool = False) -> Array:
    """log prod_k sum_j exp(-s_k (j - c)^2) over the last axis, c = 0 or one half."""
    # Large s sum quickly as they stand, small ones after Poisson's formula.
    x, y = np.maximum(s, math.pi)[..., None], np.minimum(s, math.pi)[..., None]
    j = np.arange(1, 8)
    fourier = 2 * ((-1.0) ** j if half_way else 1.0) * np.exp(-(math.pi**2) * j**2 / y)
    dual = 0.5 * np.log(math.pi / y[..., 0]) + np.log1p(fourier.sum(axis=-1))
    if half_way:
        direct = math.log(2) - 0.25 * x[..., 0] + np.log1p(np.exp(-x * j * (j + 1)).sum(axis=-1))
    else:
        direct = np.log1p(2 * np.exp(-x * j**2).sum(axis=-1))
    return np.asarray(np.where(s > math.pi, direct, dual).sum(axis=-1))


def _radius_of_volume(D: Array, count: float) -> float:
    """Squared radius of the ellipsoid whose volume holds so many integer vectors on average."""
    n = D.size
    log_unit_ball = 0.5 * n * math.log(math.pi) - math.lgamma(0.5 * n + 1)
    return math.exp(2 / n * (math.log(count) - log_unit_ball - 0.5 * float(np.log(D).sum())))
