"""Costs compiled by numba, which compiled searches call without going back to Python.

A kernel that takes the cost as an argument has an explicit signature with a first-class function in it: it is compiled once
for all costs, when first called, and kept on disk.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, wraps
from typing import Any

import numpy as np
from numba import njit
from numba.core import types

from swarm.types import Array

VECTOR, MATRIX = types.Array(types.float64, 1, "C"), types.Array(types.float64, 2, "C")
COUNTS = types.Array(types.int64, 1, "C")
COST = types.FunctionType(types.float64(VECTOR, VECTOR))
GENERATOR = types.npy_rng
ACCOUNT = (COUNTS, VECTOR, VECTOR, VECTOR, VECTOR, types.int64)  # the last arguments of every compiled loop: search.Account


def compiled_when_called(signature: Any) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """`njit` with a signature, put off until the first call: importing stays fast."""

    def decorate(function: Callable[..., Any]) -> Callable[..., Any]:
        @cache
        def kernel() -> Callable[..., Any]:
            compiled: Callable[..., Any] = njit(signature, cache=True, error_model="numpy")(function)
            return compiled

        @wraps(function)
        def call(*arguments: Any) -> Any:
            return kernel()(*arguments)

        return call

    return decorate


@dataclass(frozen=True, slots=True)
class CompiledCost:
    """A compiled cost of one point and its data.

    function : `@njit("float64(float64[::1], float64[::1])", cache=True)` of a point (n,) and data
    data : (any,) what the cost depends on besides the point

    Called with points (k, n) it returns costs (k,), as any other cost does. Raises ValueError for data of another shape and
    for a function without that signature.
    """

    function: Any
    data: Array

    def __post_init__(self) -> None:
        if np.ndim(self.data) != 1:
            raise ValueError(f"data of a compiled cost must have shape (any,), got {np.shape(self.data)}")
        object.__setattr__(self, "data", np.ascontiguousarray(self.data, dtype=np.float64))
        if (VECTOR, VECTOR) not in getattr(self.function, "signatures", ()):
            raise ValueError(
                'function of a compiled cost must be decorated with njit("float64(float64[::1], float64[::1])"), '
                f"got {getattr(self.function, '__name__', self.function)!r}"
            )

    def __call__(self, X: Array) -> Array:
        """Costs (k,) of points (k, n)."""
        f = np.empty(len(X))
        _costs(self.function, self.data, np.array(X, dtype=np.float64, order="C"), f)
        return f


@compiled_when_called(types.void(COST, VECTOR, MATRIX, VECTOR))
def _costs(function: Any, data: Array, X: Array, f: Array) -> None:
    for i in range(len(X)):
        f[i] = function(X[i], data)
