"""Which of several methods is better, judged over many seeds or problems without assuming a distribution.

    mean rank      R_j = mean over N blocks of the rank of method j among k; 1 is the lowest cost, equal costs share ranks
    Friedman       chi^2 of the R_j with k - 1 degrees of freedom, corrected for ties; its F form
                   F = (N - 1) chi^2 / (N (k - 1) - chi^2) with k - 1 and (k - 1)(N - 1) degrees of freedom gives p
    Nemenyi        two methods differ where their mean ranks do by more than CD = q sqrt(k (k + 1) / (12 N)),
                   q the upper quantile of the studentized range of k normal variables
    Wilcoxon       signed ranks of paired differences; even pairs are left out; exact up to 50 pairs without ties
    Holm           the i-th smallest of m values of p is multiplied by m - i + 1 and made monotone

A block is what all methods met alike: a seed, or a problem with the median over its seeds.

Source: Friedman (1937); Nemenyi (1963); Wilcoxon (1945); Holm (1979); Iman and Davenport (1980); Demšar (2006).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.stats import f as f_distribution
from scipy.stats import rankdata, studentized_range, wilcoxon

from factorgraph.errors import InputError
from factorgraph.types import Array

LEVEL = 0.05  # of significance
QUARTILES = (0.25, 0.5, 0.75)


@dataclass(frozen=True, slots=True)
class Spread:
    """Median and quartiles of n values."""

    lower: float
    median: float
    upper: float
    n: int


@dataclass(frozen=True, slots=True)
class Ranking:
    """Mean ranks of k methods over blocks, and whether they differ."""

    mean_ranks: Array  # (k,)
    n_blocks: int
    p: float  # that they do not differ, by Friedman's test; 1 where it cannot tell
    critical_difference: float  # of two mean ranks


@dataclass(frozen=True, slots=True)
class PairedTest:
    """A second method against a first one on the same blocks."""

    median_difference: float  # second less first
    sign: int  # of the sum of signed ranks: 1 where the second tends to be higher, -1 lower, 0 neither
    n_lower: int  # blocks in which the second is lower
    n_higher: int
    n_even: int
    p: float  # two-sided, that the differences lie symmetrically about zero


def spread(x: Array) -> Spread:
    """Median and quartiles of values (n,). Raises InputError where there are none or one is not finite."""
    if x.ndim != 1 or not len(x) or not np.isfinite(x).all():
        raise InputError(f"a spread needs finite values (n,) with n > 0, got shape {x.shape}")
    lower, median, upper = (float(v) for v in np.quantile(x, QUARTILES))
    return Spread(lower, median, upper, len(x))


def ranking(costs: Array, level: float = LEVEL) -> Ranking:
    """Mean ranks of costs (blocks, k), lower is better, with Friedman's test and Nemenyi's critical difference at `level`.

    Raises InputError unless there are a block and two methods, all costs finite. Source: Demšar (2006), sec. 3.2.
    """
    if costs.ndim != 2 or costs.shape[0] < 1 or costs.shape[1] < 2 or not np.isfinite(costs).all():
        raise InputError(f"ranks need finite costs (blocks, k) with k > 1, got shape {costs.shape}")
    n, k = costs.shape
    ranks = rankdata(costs, axis=1)
    q = float(studentized_range.ppf(1 - level, k, np.inf))
    return Ranking(ranks.mean(axis=0), n, _friedman(ranks), q * float(np.sqrt(k * (k + 1) / (12 * n))))


def _friedman(ranks: Array) -> float:
    """Friedman's test in its F form for ranks (n, k): the two-way analysis of variance of the ranks."""
    n, k = ranks.shape
    middle = 0.5 * (k + 1)
    between = n * float(np.sum((ranks.mean(axis=0) - middle) ** 2))
    rest = float(np.sum((ranks - middle) ** 2)) - between
    if n < 2 or between == 0:
        return 1.0
    F = np.inf if rest <= 1e-12 * between else (n - 1) * between / rest
    return float(f_distribution.sf(F, k - 1, (k - 1) * (n - 1)))


def cliques(found: Ranking) -> list[list[int]]:
    """Methods (indices, best first) that cannot be told apart: the longest runs of mean ranks within a critical difference."""
    order = np.argsort(found.mean_ranks, kind="stable")
    ranks = found.mean_ranks[order]
    runs: list[list[int]] = []
    end = 0
    for i in range(len(order)):
        last = int(np.flatnonzero(ranks <= ranks[i] + found.critical_difference)[-1])
        if last > max(i, end):
            runs.append([int(j) for j in order[i : last + 1]])
            end = last
    return runs


def paired_test(first: Array, second: Array) -> PairedTest:
    """Costs (n,) of two methods on the same blocks compared by Wilcoxon's signed ranks.

    Raises InputError where shapes differ or a cost is not finite.
    """
    if first.ndim != 1 or first.shape != second.shape or not len(first):
        raise InputError(f"paired costs must both be (n,) with n > 0, got {first.shape} and {second.shape}")
    if not (np.isfinite(first).all() and np.isfinite(second).all()):
        raise InputError("paired costs must be finite")
    d = second - first
    uneven = d[d != 0]
    p = float(wilcoxon(uneven).pvalue) if len(uneven) else 1.0
    sign = int(np.sign(np.sum(rankdata(np.abs(uneven)) * np.sign(uneven))))
    lower, higher = int(np.sum(d < 0)), int(np.sum(d > 0))
    return PairedTest(float(np.median(d)), sign, lower, higher, len(d) - lower - higher, p)


def holm(p: Array) -> Array:
    """Values of p (m,) of one family, adjusted so that comparing each with a level keeps that level for the family."""
    order = np.argsort(p, kind="stable")
    adjusted = np.maximum.accumulate(p[order] * np.arange(len(p), 0, -1))
    out = np.empty(len(p))
    out[order] = np.minimum(adjusted, 1.0)
    return out
