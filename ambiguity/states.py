"""Bookkeeping of double-difference ambiguities: satellites that come, go, slip, and a pivot that changes.

With one reference satellite, the pivot p, and N_s the single-difference ambiguity of satellite s,

    x_s = N_s - N_p,   s != p
    x_s' = N_s - N_q = x_s - x_q,   x_p' = -x_q        pivot q instead of p

so that any change of satellites and pivot is a matrix of 0, 1 and -1 with one row per new ambiguity, exact on integers. A
new ambiguity is known where its satellite and the new pivot were both there before and neither slipped; the others start
afresh, with a variance of their own and no correlation. A filter must therefore leave a pivot while it is still tracked.

Labels are any hashable names, such as "G05" or ("G05", "L1"); one pivot per system and signal, each with its own set.

Source: Teunissen and Montenbruck (2017), chapter 21, for double differences and their reference.
"""

from __future__ import annotations

from collections.abc import Hashable, Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ambiguity._input import pair
from ambiguity.types import Array, BoolArray, IntArray

LARGEST_INTEGER = 2.0**53  # that floats hold exactly


@dataclass(frozen=True, slots=True)
class DoubleDifferences:
    """A pivot and the satellites differenced against it, in the order of the ambiguities."""

    pivot: Hashable
    satellites: tuple[Hashable, ...]  # (n,) without the pivot

    def __post_init__(self) -> None:
        """Raises ValueError for a satellite given twice, the pivot included."""
        object.__setattr__(self, "satellites", tuple(self.satellites))
        seen = {self.pivot}
        for s in self.satellites:
            if s in seen:
                raise ValueError(f"satellite {s} is given twice" + (", it is the pivot" if s == self.pivot else ""))
            seen.add(s)

    @property
    def index(self) -> dict[Hashable, int]:
        """Index of each satellite's ambiguity."""
        return {s: i for i, s in enumerate(self.satellites)}


@dataclass(frozen=True, slots=True)
class Transition:
    """x_new = T x_old for the ambiguities that are known; the others start afresh."""

    before: DoubleDifferences
    after: DoubleDifferences
    T: IntArray  # (m, n) entries 0, 1, -1; rows of zeros where `fresh`
    fresh: BoolArray  # (m,) new, slipped, or without a pivot known to both

    def apply(self, a: ArrayLike, Q: ArrayLike, fresh_variance: ArrayLike, fresh_value: ArrayLike = 0.0) -> tuple[Array, Array]:
        """Ambiguities (m,) [cyc] and covariance (m, m) [cyc^2] after the transition.

        a (n,), Q (n, n) before; `fresh_variance` and `fresh_value`, scalars or (m,), for the ambiguities that start afresh.
        Raises ValueError where shapes disagree or a fresh variance is not positive and finite.
        """
        a, Q = pair(a, Q)
        m, n = self.T.shape
        if a.size != n:
            raise ValueError(f"a must hold the {n} ambiguities before the transition, got {a.size}")
        variance, value = np.zeros(m), np.zeros(m)
        for name, target, given in (("fresh_variance", variance, fresh_variance), ("fresh_value", value, fresh_value)):
            x = np.asarray(given, dtype=np.float64)
            if x.shape not in ((), (m,)):
                raise ValueError(f"{name} must be a number or have shape ({m},), got {x.shape}")
            target[self.fresh] = np.broadcast_to(x, m)[self.fresh]
            if not np.isfinite(target).all():
                raise ValueError(f"{name} must be finite")
        if np.any(variance[self.fresh] <= 0):
            raise ValueError("fresh_variance must be positive")
        T = self.T.astype(np.float64)
        Q_new = T @ Q @ T.T
        return T @ a + value, 0.5 * (Q_new + Q_new.T) + np.diag(variance)

    def carry(self, integers: ArrayLike) -> Array:
        """Fixed integers (n,) after the transition, (m,) as floats: NaN where not known before or fresh.

        Raises ValueError for another shape and for values that are neither integers nor NaN.
        """
        x = np.asarray(integers, dtype=np.float64)
        n = self.T.shape[1]
        if x.shape != (n,):
            raise ValueError(f"integers must have shape ({n},), got {x.shape}")
        known = ~np.isnan(x)
        if np.any(x[known] != np.rint(x[known])) or np.any(np.abs(x[known]) > LARGEST_INTEGER):
            raise ValueError("integers must hold integers a float can tell apart, NaN where unknown")
        values = (self.T @ np.where(known, x, 0).astype(np.int64)).astype(np.float64)
        values[self.fresh | (self.T[:, ~known] != 0).any(axis=1)] = np.nan
        return values


def change_pivot(before: DoubleDifferences, pivot: Hashable) -> Transition:
    """The same satellites against another of them: the old pivot takes the place of the new one.

    T (n, n) has determinant -1, or is the identity for the pivot that is; pivots changed one after the other are the pivot
    changed at once, and back is the inverse. Raises ValueError where the pivot is not among the satellites.
    """
    if pivot == before.pivot:
        return follow(before, before)
    if pivot not in before.satellites:
        raise ValueError(f"satellite {pivot} is not among the double differences and cannot be their pivot")
    return follow(before, DoubleDifferences(pivot, tuple(before.pivot if s == pivot else s for s in before.satellites)))


def follow(before: DoubleDifferences, after: DoubleDifferences, slipped: Iterable[Hashable] = ()) -> Transition:
    """From one set of double differences to another, in any order, with satellites gone, new, or slipped in between.

    Every ambiguity is fresh where the new pivot is new or slipped: change the pivot before that. Raises ValueError for a
    slipped satellite that is in neither set.
    """
    lost = set(slipped)
    held = {before.pivot, *before.satellites}
    stray = lost - held - {after.pivot, *after.satellites}
    if stray:
        raise ValueError(f"slipped satellites are in neither set of double differences: {sorted(map(str, stray))}")
    column = before.index
    T = np.zeros((len(after.satellites), len(before.satellites)), np.int64)
    fresh = np.ones(len(after.satellites), bool)
    for i, s in enumerate(after.satellites):
        if not {s, after.pivot} <= held - lost:
            continue
        fresh[i] = False
        if s in column:
            T[i, column[s]] += 1
        if after.pivot in column:
            T[i, column[after.pivot]] -= 1
    return Transition(before, after, T, fresh)


def stack(transitions: Iterable[Transition]) -> tuple[IntArray, BoolArray]:
    """T (sum m, sum n) and fresh (sum m,) of several sets, one block each: systems and signals of one filter."""
    parts = list(transitions)
    m, n = (np.cumsum([0] + [t.T.shape[axis] for t in parts]) for axis in (0, 1))
    T, fresh = np.zeros((m[-1], n[-1]), np.int64), np.zeros(m[-1], bool)
    for i, t in enumerate(parts):
        T[m[i] : m[i + 1], n[i] : n[i + 1]] = t.T
        fresh[m[i] : m[i + 1]] = t.fresh
    return T, fresh
