"""Numbers over seeds with intervals, and paired differences of them.

Intervals of differences are bootstrapped over the seeds; both of a pair saw the same noise.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np

from factorgraph.consistency import Interval, mean_difference, paired_bootstrap
from factorgraph.types import Array

NAN = float("nan")
NEES_PROB = 0.99
CONSISTENT_PCT = 90.0
Subject = TypeVar("Subject")


@dataclass(frozen=True, slots=True)
class Metric:
    """What a number of the summary means; `better` is +1 where larger is better, -1 where smaller is, else 0."""

    title: str
    unit: str
    better: int

    @property
    def heading(self) -> str:
        """Title with the unit, for the head of a column."""
        return f"{self.title} [{self.unit}]" if self.unit else self.title


@dataclass(frozen=True, slots=True)
class Statistic:
    """Mean over seeds with its interval (NaN of a single seed), the smallest and the largest seed."""

    value: float
    lower: float
    upper: float
    low: float
    high: float
    n: int

    @property
    def numbers(self) -> tuple[float, float, float, float, float]:
        """Mean, lower, upper, smallest, largest."""
        return self.value, self.lower, self.upper, self.low, self.high


@dataclass(frozen=True)  # no slots: with them, frozen instances of PairedDifference[…] cannot be made
class PairedDifference(Generic[Subject]):
    """`second` less `first` over common seeds, and in percent of the first's mean; better counts the seeds `second` wins."""

    metric: str
    first: Subject
    second: Subject
    difference: Statistic
    percent: Statistic
    better: int
    worse: int

    @property
    def tally(self) -> str:
        """Seeds better / worse / even."""
        return f"{self.better} / {self.worse} / {self.difference.n - self.better - self.worse}"


def compared(a: Array, b: Array, compare: Callable[[Array, Array], Array] = mean_difference) -> Statistic:
    """compare(a, b) over seeds (S,) with its bootstrap interval; low and high are of the seeds one by one."""
    if len(a) > 1:
        found = paired_bootstrap(a, b, np.random.default_rng(0), compare)
    else:
        found = Interval(float(compare(a, b)), NAN, NAN, len(a))
    single = compare(a[:, None], b[:, None])
    return Statistic(found.value, found.lower, found.upper, float(np.min(single)), float(np.max(single)), len(a))


def gain_percent(a: Array, b: Array) -> Array:
    """How much larger the mean of b over the last axis is than that of a, in percent of the latter's size; NaN where it is 0."""
    base = np.mean(a, axis=-1)
    size = np.where(base != 0, np.abs(base), np.nan)
    return np.asarray(100 * (np.mean(b, axis=-1) - base) / size)


def mean_of_known(x: Array) -> float:
    """Mean of what is finite, NaN of nothing."""
    x = x[np.isfinite(x)]
    return float(np.mean(x)) if x.size else NAN
