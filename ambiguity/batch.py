"""Many ambiguity problems of one size in one call: epochs, draws, or vehicles.

Every row stands alone. A row that cannot be used (not finite, not positive definite, ...) is listed in `faults` with the
words the single call would raise, its numbers are NaN and its integers 0; the other rows are unaffected. What is wrong
with the call itself, shapes and options, raises ValueError.

One covariance (n, n) for all rows is decorrelated once.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from ambiguity import _kernels as kernels
from ambiguity._input import at_least_one, fault_text
from ambiguity.search import MAX_NODES
from ambiguity.types import Array, BoolArray, IntArray

Faults: TypeAlias = tuple[tuple[int, str], ...]  # row and what is wrong with it


@dataclass(frozen=True, slots=True)
class IlsBatch:
    """The nearest integer vectors of every row, best first."""

    candidates: IntArray  # (B, k, n)
    norms: Array  # (B, k) squared distances in the metric of inv(Q); NaN in a row at fault
    proven: BoolArray  # (B,) no nearer vector exists; False in a row at fault
    nodes: IntArray  # (B,) integers tried
    faults: Faults


@dataclass(frozen=True, slots=True)
class RoundedBatch:
    """Integers of every row and the probability that they are right."""

    integers: IntArray  # (B, n)
    success_rate: Array  # (B,) NaN in a row at fault
    faults: Faults


@dataclass(frozen=True, slots=True)
class Strength:
    """What covariances promise before any data."""

    success_rate: Array  # (B,) bootstrapped, after decorrelation; NaN in a row at fault
    adop: Array  # (B,) [cyc]; NaN in a row at fault and where there is no ambiguity
    faults: Faults


def integer_least_squares_batch(a_float: ArrayLike, Q: ArrayLike, n_candidates: int = 2, max_nodes: int = MAX_NODES) -> IlsBatch:
    """`integer_least_squares` of every row.

    Parameters
    ----------
    a_float : (B, n) float ambiguities [cyc]
    Q : (B, n, n) their covariances, or (n, n) for all rows [cyc^2]
    n_candidates : how many to return; for n = 0 the only vector, the empty one, is returned
    max_nodes : integers to try in each row before giving up its proof

    Rows at fault are listed, not raised. Raises ValueError where shapes disagree. Source: as `integer_least_squares`.
    """
    a, Q = _stack(a_float, Q)
    k, budget = at_least_one("n_candidates", n_candidates), at_least_one("max_nodes", max_nodes)
    n_rows, n = a.shape
    if n == 0:
        none = np.zeros((n_rows, 1, 0), np.int64)
        return IlsBatch(none, np.zeros((n_rows, 1)), np.ones(n_rows, bool), np.zeros(n_rows, np.int64), ())
    codes, values, candidates, norms, proven, nodes = kernels.integer_least_squares_batch(a, Q, k, budget)
    return IlsBatch(candidates, norms, proven, nodes, _faults(codes, values, Q))


def bootstrap_batch(a_float: ArrayLike, Q: ArrayLike) -> RoundedBatch:
    """`bootstrap` of every row: a_float (B, n) [cyc], Q (B, n, n) or (n, n) [cyc^2].

    Rows at fault are listed, not raised. Raises ValueError where shapes disagree. Source: Teunissen (1998).
    """
    a, Q = _stack(a_float, Q)
    codes, values, integers, variances = kernels.bootstrap_batch(a, Q)
    return RoundedBatch(integers, kernels.success_of_rows(variances), _faults(codes, values, Q))


def round_each_batch(a_float: ArrayLike, Q: ArrayLike) -> RoundedBatch:
    """`round_each` of every row: a_float (B, n) [cyc], Q (B, n, n) or (n, n) [cyc^2]; the success rates are lower bounds.

    Rows at fault are listed, not raised. Raises ValueError where shapes disagree. Source: Teunissen (1998).
    """
    a, Q = _stack(a_float, Q)
    codes, values = kernels.check_batch(a, Q)
    bad = codes[:, 0] != kernels.OK
    variances = np.array(np.broadcast_to(np.diagonal(Q, axis1=1, axis2=2), a.shape))
    variances[bad] = np.nan
    rates = kernels.success_of_rows(variances)
    rates[bad] = np.nan
    integers = np.rint(np.where(bad[:, None], 0.0, a)).astype(np.int64)
    return RoundedBatch(integers, rates, _faults(codes, values, Q))


def strength_batch(Q: ArrayLike) -> Strength:
    """`success_rate` and `adop` of covariances Q (B, n, n) [cyc^2].

    Rows at fault are listed, not raised. Raises ValueError for another shape.
    Source: Teunissen (1998); Teunissen and Odijk (1997).
    """
    Q = np.array(Q, dtype=np.float64, order="C")
    if Q.ndim != 3 or Q.shape[1] != Q.shape[2]:
        raise ValueError(f"Q must have shape (B, n, n), got {Q.shape}")
    codes, values, _, variances = kernels.bootstrap_batch(np.zeros(Q.shape[:2]), Q)
    adop = np.exp(0.5 * np.log(variances).mean(axis=1)) if Q.shape[1] else np.full(len(Q), np.nan)
    return Strength(kernels.success_of_rows(variances), adop, _faults(codes, values, Q))


def _stack(a_float: ArrayLike, Q: ArrayLike) -> tuple[Array, Array]:
    """Rows (B, n) and covariances (B, n, n) or (1, n, n). Raises ValueError where the shapes disagree."""
    a, Q = np.array(a_float, dtype=np.float64, order="C"), np.array(Q, dtype=np.float64, order="C")
    if a.ndim != 2:
        raise ValueError(f"a_float must have shape (B, n), got {a.shape}")
    n_rows, n = a.shape
    if Q.shape == (n, n):
        return a, Q[None]
    if Q.shape != (n_rows, n, n):
        raise ValueError(f"Q must have shape {(n_rows, n, n)} or {(n, n)} to match a_float of shape {a.shape}, got {Q.shape}")
    return a, Q


def _faults(codes: IntArray, values: Array, Q: Array) -> Faults:
    faults = []
    for b in np.flatnonzero(codes[:, 0] != kernels.OK).tolist():
        code, row, column = codes[b].tolist()
        faults.append((b, fault_text(code, row, column, float(values[b]), Q[0 if len(Q) == 1 else b])))
    return tuple(faults)
