"""Acceptance of integers.

    ratio       |a_float - a2|^2 / |a_float - a1|^2                  accept where at least a threshold >= 1
    difference  |a_float - a2|^2 - |a_float - a1|^2                  accept where at least a threshold >= 0
    projection  (a2 - a1)' inv(Q) (a_float - a1) / |a2 - a1|         accept where at most a threshold

a1 is the best candidate, a2 the second, |x|^2 = x' inv(Q) x. Literature on fixed failure rates states the ratio test as
|a_float - a1|^2 / |a_float - a2|^2 <= mu with mu in (0, 1]; its mu is one over the threshold here.

A customary ratio of 2 to 3 promises no failure rate: the same threshold is wasteful in a strong model and careless in a
weak one. `ffrt_threshold` turns a failure rate into the threshold of a given Q.

Source: Euler and Schaffrin (1991) for the ratio, Tiberius and de Jonge (1995) for the difference, Han (1997) and Wang,
Stewart and Tsakiri (1998) for the projection, Teunissen and Verhagen (2009), Verhagen and Teunissen (2013) for
thresholds from a failure rate.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ambiguity._input import pair, require_sound, square
from ambiguity.bootstrapping import success_rate
from ambiguity.decorrelation import factorise
from ambiguity.simulation import CONFIDENCE, MAX_NODES, N_SAMPLES, AcceptanceRates, Rate, acceptance_rates, simulate
from ambiguity.types import Array


@dataclass(frozen=True, slots=True)
class RatioTest:
    """Outcome of a ratio test."""

    ratio: float  # at least 1; infinite where there is no second candidate or the first is exact
    passed: bool


@dataclass(frozen=True, slots=True)
class DifferenceTest:
    """Outcome of a difference test."""

    difference: float  # of squared norms, not negative; infinite where there is no second candidate
    passed: bool


@dataclass(frozen=True, slots=True)
class ProjectorTest:
    """Outcome of a projector test."""

    projection: float  # at most half the distance of the candidates; minus infinity where there is no second
    passed: bool


@dataclass(frozen=True, slots=True)
class FailureRateThreshold:
    """Threshold of the ratio test that keeps a failure rate, and how sure the samples make it."""

    threshold: float  # 1: accept always; infinite: accept only what is integer already
    lower: float  # the exact threshold lies between lower and upper with the confidence asked for
    upper: float
    rates: AcceptanceRates  # at `threshold`, of the same samples; bounds where no samples were needed


def ratio_test(norms: ArrayLike, threshold: float) -> RatioTest:
    """Compare the squared norms of the best candidates.

    Parameters
    ----------
    norms : (k,) squared norms, smallest first, as `IlsResult.norms`; only the first two count
    threshold : smallest ratio that passes, at least 1

    Raises ValueError for norms that are negative, unsorted, NaN or absent, and for a threshold below 1.
    """
    d = _sorted_norms(norms)
    check_threshold(threshold)
    ratio = ratio_of(d)
    return RatioTest(ratio, ratio >= threshold)


def difference_test(norms: ArrayLike, threshold: float) -> DifferenceTest:
    """Compare how much worse the second candidate is with a threshold in units of the squared norm.

    norms (k,) as for `ratio_test`. Raises ValueError for norms that are negative, unsorted, NaN or absent, and for a
    negative threshold. Source: Tiberius and de Jonge (1995).
    """
    d = _sorted_norms(norms)
    if not threshold >= 0:
        raise ValueError(f"the difference threshold must not be negative, got {threshold}")
    difference = float(d[1] - d[0]) if d.size > 1 else math.inf
    return DifferenceTest(difference, difference >= threshold)


def projector_test(a_float: ArrayLike, Q: ArrayLike, candidates: ArrayLike, threshold: float) -> ProjectorTest:
    """How far the float vector lies from the best candidate on the way to the second, in standard deviations.

    Were the best candidate the truth, the projection would be standard normal for a second candidate fixed beforehand.

    Parameters
    ----------
    a_float, Q : (n,), (n, n) [cyc], [cyc^2]
    candidates : (k, n) integers, best first, as `IlsResult.candidates`; only the first two count
    threshold : largest projection that passes

    Raises ValueError for unusable a_float or Q, candidates of another shape, two equal candidates, a NaN threshold.
    Source: Han (1997); Wang, Stewart and Tsakiri (1998).
    """
    a, Q = pair(a_float, Q)
    c = np.asarray(candidates)
    if c.ndim != 2 or len(c) == 0 or c.shape[1] != a.size:
        raise ValueError(f"candidates must have shape (k, {a.size}) with k > 0, got {c.shape}")
    if math.isnan(threshold):
        raise ValueError("the projector threshold is NaN")
    require_sound(a, Q)
    if len(c) == 1:
        return ProjectorTest(-math.inf, True)
    if np.array_equal(c[0], c[1]):
        raise ValueError("the first two candidates are equal")
    offset = np.rint(a)  # keeps differences exact where the ambiguities are large
    residual = (a - offset) - (c[0] - offset)
    U, D, order = factorise(Q)
    whitened = np.linalg.solve(U, np.column_stack([residual, c[1] - c[0]])[order]) / np.sqrt(D)[:, None]
    r, d = whitened.T
    projection = float(r @ d / np.linalg.norm(d))
    return ProjectorTest(projection, projection <= threshold)


def ffrt_threshold(
    Q: ArrayLike,
    failure_rate: float,
    n_samples: int = N_SAMPLES,
    rng: np.random.Generator | int | None = None,
    confidence: float = CONFIDENCE,
    max_nodes: int = MAX_NODES,
) -> FailureRateThreshold:
    """Smallest threshold t of the ratio test with P(ratio >= t and integers wrong) <= failure_rate, the model being right.

    The failure rate counts among all epochs, not among the accepted. Where the bootstrapped success rate promises it
    already, t is 1 without samples, and everything is accepted. Otherwise N samples leave the smallest t that no more
    than failure_rate N wrong ones reach; the order statistics around it give the interval. t is infinite for a failure
    rate of zero that nothing promises, and where more searches than allowed spent their budget.

    Parameters
    ----------
    Q : (n, n) [cyc^2]
    failure_rate : tolerated, in [0, 1)
    n_samples : at least 1 / failure_rate where that is positive; 100 / failure_rate makes the threshold good to a tenth
    rng : generator or seed
    confidence : of the interval and the rates, in (0, 1)
    max_nodes : budget of each search

    Raises ValueError for unusable Q and for options outside their ranges.
    Source: Teunissen and Verhagen (2009); Verhagen and Teunissen (2013).
    """
    Q = square(Q)
    if not 0 <= failure_rate < 1:
        raise ValueError(f"failure_rate must lie in [0, 1), got {failure_rate}")
    if not 0 < confidence < 1:
        raise ValueError(f"the confidence must lie in (0, 1), got {confidence}")
    if 0 < failure_rate * n_samples < 1:
        raise ValueError(f"{n_samples} samples cannot tell a failure rate of {failure_rate}; draw {100 / failure_rate:.0f}")
    promised = 1.0 - success_rate(Q)
    if promised <= failure_rate:
        return FailureRateThreshold(1.0, 1.0, 1.0, _rates_within(promised))
    samples = simulate(Q, n_samples, rng, max_nodes)
    wrong = np.sort(samples.ratio[~samples.nearest])[::-1]
    threshold, lower, upper = (_above(wrong, count) for count in _tolerated(failure_rate, n_samples, confidence))
    rates = acceptance_rates(samples, samples.ratio >= threshold, confidence)
    return FailureRateThreshold(threshold, lower, upper, rates)


def ratio_of(norms: Array) -> float:
    """Second to first of sorted squared norms (k,); infinite where there is no second or the first is zero."""
    return float(norms[1] / norms[0]) if norms.size > 1 and norms[0] > 0 else math.inf


def check_threshold(threshold: float) -> None:
    """Raises ValueError for a ratio threshold below 1."""
    if not threshold >= 1:
        raise ValueError(f"the ratio threshold must be at least 1, got {threshold}")


def _sorted_norms(norms: ArrayLike) -> Array:
    d = np.asarray(norms, dtype=np.float64)
    if d.ndim != 1 or d.size == 0 or not (np.all(d >= 0) and np.all(np.diff(d) >= 0)):
        raise ValueError(f"norms must be a sorted vector of squared norms, got {d}")
    return d


def _above(wrong: Array, count: int) -> float:
    """Smallest threshold that at most `count` of the ratios `wrong`, largest first, reach; infinite for none allowed."""
    if count < 0:
        return math.inf
    return 1.0 if count >= wrong.size else float(np.nextafter(wrong[count], math.inf))


def _tolerated(failure_rate: float, n_samples: int, confidence: float) -> tuple[int, int, int]:
    """Wrong samples to accept for the threshold itself, its lower and its upper end; -1 where nothing may be accepted.

    At the exact threshold the number of wrong samples accepted is binomial, whatever Q: the ends are its quantiles.
    """
    if failure_rate == 0:
        return -1, -1, -1
    k = np.arange(n_samples)
    steps = np.log((n_samples - k) / (k + 1.0)) + math.log(failure_rate / (1.0 - failure_rate))
    below = np.cumsum(np.exp(n_samples * math.log1p(-failure_rate) + np.concatenate([[0.0], np.cumsum(steps)])))
    tail = 0.5 - 0.5 * confidence
    most, fewest = np.searchsorted(below, 1.0 - tail), np.searchsorted(below, tail, side="right") - 1
    return math.floor(failure_rate * n_samples), int(most), int(fewest)


def _rates_within(promised: float) -> AcceptanceRates:
    """Rates of accepting always, from the failure rate the bootstrapped success rate promises."""
    return AcceptanceRates(Rate(1.0 - promised, 1.0 - promised, 1.0), Rate(promised, 0.0, promised), Rate(0.0, 0.0, 0.0))
