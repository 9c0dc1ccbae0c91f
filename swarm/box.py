"""Bounds, first points and options of a search, checked once.

Every check raises ValueError with the argument's name, what is expected and the value.
"""

from __future__ import annotations

import math
from operator import index

import numpy as np
from numpy.typing import ArrayLike

from swarm.types import Array

LARGEST_BOUND = 1e300  # beyond it the width of the box may overflow


def box(bounds: ArrayLike) -> tuple[Array, Array]:
    """Lower and upper limits (n,) each of bounds (n, 2)."""
    b = np.asarray(bounds, dtype=np.float64)
    if b.ndim != 2 or b.shape[1] != 2 or b.shape[0] == 0:
        raise ValueError(f"bounds must have shape (n, 2) with n > 0, got {b.shape}")
    wrong = np.flatnonzero(~((b[:, 0] < b[:, 1]) & (np.abs(b) < LARGEST_BOUND).all(axis=1)))
    if wrong.size:
        i = wrong[0]
        raise ValueError(f"bounds[{i}] must be finite with lower < upper, got {b[i].tolist()}")
    return b[:, 0].copy(), b[:, 1].copy()


def first_points(rng: np.random.Generator, k: int, x0: ArrayLike | None, low: Array, high: Array) -> Array:
    """Points (k, n) drawn evenly from the box; the first one is x0 (n,) where given."""
    x = np.clip(low + (high - low) * rng.random((k, low.size)), low, high)
    if x0 is not None:
        x[0] = first_point(x0, low, high)
    return x


def first_point(x0: ArrayLike, low: Array, high: Array) -> Array:
    """x0 (n,), which has to lie in the box."""
    x = np.asarray(x0, dtype=np.float64)
    if x.shape != low.shape:
        raise ValueError(f"x0 must have shape {low.shape} to match bounds, got {x.shape}")
    outside = np.flatnonzero(~((x >= low) & (x <= high)))
    if outside.size:
        i = outside[0]
        raise ValueError(f"x0[{i}] = {x[i]} lies outside its bounds [{low[i]}, {high[i]}]")
    return x


def check_count(name: str, value: int, least: int) -> None:
    """A whole number of at least so many."""
    try:
        whole = index(value)
    except TypeError:
        raise ValueError(f"{name} must be a whole number, got {value!r}") from None
    if whole < least:
        raise ValueError(f"{name} must be at least {least}, got {value}")


def check_range(name: str, value: float, low: float, high: float = math.inf) -> None:
    """A finite number in [low, high]."""
    if not (math.isfinite(value) and low <= value <= high):
        wanted = f"in [{low:g}, {high:g}]" if math.isfinite(high) else "not negative" if low == 0 else f"at least {low:g}"
        raise ValueError(f"{name} must be finite and {wanted}, got {value}")
