"""Success and failure rates counted in samples, where no closed form exists.

    a_float ~ N(0, Q): the true integers are zero, which costs no generality

Q is decorrelated once; every sample z = U sqrt(D) e is drawn and searched in the decorrelated ambiguities. Rounding is
judged in the ambiguities as given, because it is the only estimator that depends on their choice.

An acceptance test splits the samples in three: right and accepted (success), wrong and accepted (failure), not accepted
(undecided). A sample whose search ran out of its budget counts as wrong and accepted, the worst it could be.

    P(integer least squares) <= P(chi^2_n <= c_n / ADOP^2),   c_n = (n/2 Gamma(n/2))^(2/n) / pi

Source: Verhagen and Teunissen (2013) and Teunissen (2005) for the three rates, Wilson (1927) for the interval of a
counted share, Hassibi and Boyd (1998) and Teunissen (2000) for the bound.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from statistics import NormalDist

import numpy as np
from numba import njit
from numpy.typing import ArrayLike

from ambiguity import _kernels as kernels
from ambiguity._input import at_least_one, raise_fault, require_sound, square
from ambiguity.bootstrapping import adop
from ambiguity.types import Array, BoolArray

N_SAMPLES = 20_000
CONFIDENCE = 0.95
MAX_NODES = 100_000  # for each sample
CHUNK = 4096  # samples in memory at a time


@dataclass(frozen=True, slots=True)
class Rate:
    """A probability counted in samples, and the interval that holds it with the confidence asked for."""

    value: float  # NaN without samples
    lower: float
    upper: float


@dataclass(frozen=True, slots=True)
class SuccessRates:
    """How often each estimator finds the true integers."""

    rounding: Rate  # of the ambiguities as given
    bootstrapping: Rate  # of the decorrelated ambiguities
    least_squares: Rate


@dataclass(frozen=True, slots=True)
class AcceptanceRates:
    """How often a test accepts right integers, wrong integers, or none; the three values sum to one."""

    success: Rate
    failure: Rate
    undecided: Rate


@dataclass(frozen=True, slots=True)
class Simulation:
    """What became of every sample: was it right, and what would the acceptance tests see.

    Without ambiguities every sample is right, and the statistics are those that every threshold passes.
    """

    rounded: BoolArray  # (N,) rounding each ambiguity is right
    bootstrapped: BoolArray  # (N,)
    nearest: BoolArray  # (N,) integer least squares is right
    ratio: Array  # (N,) second to first squared norm
    difference: Array  # (N,) second minus first squared norm
    projection: Array  # (N,) of the float residual on the way from the best to the second, as `projector_test`
    n_unproven: int  # samples whose search spent its budget: not `nearest`, and passing every test


def simulate(
    Q: ArrayLike, n_samples: int = N_SAMPLES, rng: np.random.Generator | int | None = None, max_nodes: int = MAX_NODES
) -> Simulation:
    """Draw float ambiguities around zero and resolve them.

    Parameters
    ----------
    Q : (n, n) covariance of the float ambiguities [cyc^2]
    n_samples : how many to draw, at least 1
    rng : generator or seed; the same seed gives the same samples
    max_nodes : budget of each search

    Raises ValueError for unusable Q, as `integer_least_squares`, and for counts below 1.
    """
    Q = square(Q)
    n_samples, max_nodes = at_least_one("n_samples", n_samples), at_least_one("max_nodes", max_nodes)
    n = len(Q)
    if n == 0:
        right, passing = np.ones(n_samples, bool), np.full(n_samples, np.inf)
        return Simulation(right, right, right, passing, passing, -passing, 0)
    require_sound(np.zeros(n), Q)
    code, row, value, UZ, D, Y, _ = kernels.reduce(np.zeros(n), Q)
    if code != kernels.OK:
        raise_fault(code, row, row, value, Q)
    U = np.ascontiguousarray(UZ[:, :n])
    rng = np.random.default_rng(rng)
    rounded, right, statistics = np.empty(n_samples, bool), np.empty((3, n_samples), bool), np.empty((3, n_samples))
    for start in range(0, n_samples, CHUNK):
        part = slice(start, min(start + CHUNK, n_samples))
        z = (rng.standard_normal((part.stop - part.start, n)) * np.sqrt(D)) @ U.T
        rounded[part] = np.all(np.abs(z @ Y) < 0.5, axis=1)
        _resolve(U, D, z, max_nodes, right[:, part], statistics[:, part])
    bootstrapped, nearest, proven = right
    ratio, difference, projection = statistics
    return Simulation(rounded, bootstrapped, nearest, ratio, difference, projection, int(np.count_nonzero(~proven)))


def simulated_success_rates(
    Q: ArrayLike,
    n_samples: int = N_SAMPLES,
    rng: np.random.Generator | int | None = None,
    confidence: float = CONFIDENCE,
    max_nodes: int = MAX_NODES,
) -> SuccessRates:
    """Share of samples in which rounding, bootstrapping and integer least squares find the true integers.

    Q (n, n) [cyc^2]; the intervals hold each rate with probability `confidence`. Samples that spent `max_nodes` count
    against integer least squares. Raises ValueError as `simulate`, and for a confidence outside (0, 1).
    """
    _quantile(confidence)
    s = simulate(Q, n_samples, rng, max_nodes)
    return SuccessRates(*(_share(right, confidence) for right in (s.rounded, s.bootstrapped, s.nearest)))


def acceptance_rates(simulation: Simulation, passed: ArrayLike, confidence: float = CONFIDENCE) -> AcceptanceRates:
    """Success, failure and undecided rate of a test of integer least squares.

    passed (N,): which samples the test accepts, such as `simulation.ratio >= 3`. Raises ValueError where its shape does
    not match the samples and for a confidence outside (0, 1).
    """
    accepted = np.asarray(passed, dtype=bool)
    if accepted.shape != simulation.nearest.shape:
        raise ValueError(f"passed must have shape {simulation.nearest.shape} as the samples, got {accepted.shape}")
    kinds = (accepted & simulation.nearest, accepted & ~simulation.nearest, ~accepted)
    return AcceptanceRates(*(_share(kind, confidence) for kind in kinds))


def wilson(count: int, n_samples: int, confidence: float = CONFIDENCE) -> Rate:
    """Share `count` of `n_samples` with its Wilson score interval; no samples leave the whole of [0, 1].

    Raises ValueError for a count outside [0, n_samples] and a confidence outside (0, 1). Source: Wilson (1927).
    """
    if not 0 <= count <= n_samples:
        raise ValueError(f"the count must lie between 0 and the {n_samples} samples, got {count}")
    x = _quantile(confidence)
    if n_samples == 0:
        return Rate(math.nan, 0.0, 1.0)
    p, size = count / n_samples, n_samples + x * x
    centre = (count + 0.5 * x * x) / size
    half = x * math.sqrt(n_samples * p * (1.0 - p) + 0.25 * x * x) / size
    lower = 0.0 if count == 0 else max(centre - half, 0.0)
    return Rate(p, lower, 1.0 if count == n_samples else min(centre + half, 1.0))


def least_squares_upper_bound(Q: ArrayLike) -> float:
    """Upper bound of the success rate of integer least squares from ADOP; 1 without ambiguities.

    The pull-in region has unit volume; of all regions of that volume the ellipsoid of Q holds most probability.
    Q (n, n) [cyc^2]. Raises ValueError where Q is not finite, symmetric and positive definite. Source: Hassibi and Boyd
    (1998).
    """
    Q = square(Q)
    n = len(Q)
    if n == 0:
        return 1.0
    log_radius = (2.0 * math.lgamma(0.5 * n + 1.0)) / n - math.log(math.pi) - 2.0 * math.log(adop(Q))
    return _chi_square_below(n, log_radius)


def _chi_square_below(n: int, log_x: float) -> float:
    """P(chi^2_n <= x) by the power series of the incomplete gamma function, whose terms are all positive."""
    s, log_half = 0.5 * n, log_x - math.log(2.0)
    if log_half > math.log(2.0 * s + 100.0):  # what is left is below 1e-30
        return 1.0
    half = math.exp(log_half)
    term = total = 1.0
    k = 0
    while term > 1e-17 * total:
        k += 1
        term *= half / (s + k)
        total += term
    return min(math.exp(s * log_half - half - math.lgamma(s + 1.0)) * total, 1.0)


def _share(chosen: BoolArray, confidence: float) -> Rate:
    return wilson(int(np.count_nonzero(chosen)), chosen.size, confidence)


def _quantile(confidence: float) -> float:
    """Of the standard normal distribution, two-sided. Raises ValueError outside (0, 1)."""
    if not 0.0 < confidence < 1.0:
        raise ValueError(f"the confidence must lie in (0, 1), got {confidence}")
    return NormalDist().inv_cdf(0.5 + 0.5 * confidence)


@njit(cache=True, error_model="numpy")
def _is_zero(z: Array) -> bool:
    for value in z:
        if value != 0.0:
            return False
    return True


@njit(cache=True, error_model="numpy")
def _squared_distance(U: Array, D: Array, first: Array, second: Array) -> float:
    """Squared length of second - first in the metric of inv(U D U')."""
    n = D.size
    x = second - first
    total = 0.0
    for k in range(n - 1, -1, -1):
        for i in range(k + 1, n):
            x[k] -= U[k, i] * x[i]
        total += x[k] * x[k] / D[k]
    return total


@njit(cache=True, error_model="numpy")
def _resolve(U: Array, D: Array, z_float: Array, max_nodes: int, right: BoolArray, statistics: Array) -> None:
    """Fill right (3, N): bootstrapping, least squares, proven; statistics (3, N): ratio, difference, projection."""
    for s in range(len(z_float)):
        z = z_float[s]
        right[0, s] = _is_zero(kernels.round_sequentially(U, z))
        best, norms, _, proven = kernels.search(U, D, z, 2, max_nodes)
        right[1, s], right[2, s] = proven and _is_zero(best[0]), proven
        if not proven:
            statistics[0, s], statistics[1, s], statistics[2, s] = np.inf, np.inf, -np.inf
            continue
        squared = _squared_distance(U, D, best[0], best[1])
        statistics[0, s] = norms[1] / norms[0] if norms[0] > 0.0 else np.inf
        statistics[1, s] = norms[1] - norms[0]
        statistics[2, s] = 0.5 * (squared - statistics[1, s]) / math.sqrt(squared)
