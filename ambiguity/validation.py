"""Acceptance of integers: the ratio test.

    ratio = |a_float - second|^2 / |a_float - best|^2   in the metric of inv(Q)

The best candidate is accepted where the ratio reaches a threshold; 2 to 3 is customary, and weak models need more.

Source: Euler and Schaffrin (1991); Verhagen and Teunissen (2013) for what the test can and cannot promise.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ambiguity.types import Array


@dataclass(frozen=True, slots=True)
class RatioTest:
    """Outcome of a ratio test."""

    ratio: float  # at least 1; infinite where there is no second candidate or the first is exact
    passed: bool


def ratio_test(norms: ArrayLike, threshold: float) -> RatioTest:
    """Compare the squared norms of the best candidates.

    Parameters
    ----------
    norms : (k,) squared norms, smallest first, as `IlsResult.norms`; only the first two count
    threshold : smallest ratio that passes, at least 1

    Raises ValueError for norms that are negative, unsorted, NaN or absent, and for a threshold below 1.
    """
    d = np.asarray(norms, dtype=np.float64)
    if d.ndim != 1 or d.size == 0 or not (np.all(d >= 0) and np.all(np.diff(d) >= 0)):
        raise ValueError(f"norms must be a sorted vector of squared norms, got {d}")
    check_threshold(threshold)
    ratio = ratio_of(d)
    return RatioTest(ratio, ratio >= threshold)


def ratio_of(norms: Array) -> float:
    """Second to first of sorted squared norms (k,); infinite where there is no second or the first is zero."""
    return float(norms[1] / norms[0]) if norms.size > 1 and norms[0] > 0 else math.inf


def check_threshold(threshold: float) -> None:
    """Raises ValueError for a ratio threshold below 1."""
    if not threshold >= 1:
        raise ValueError(f"the ratio threshold must be at least 1, got {threshold}")
