"""Fixing what can be fixed, and conditioning on it.

All ambiguities are tried first. Where their success rate or ratio does not suffice, `fix` drops the least precise of the
decorrelated ambiguities z = Z a one by one until both suffice. What is then fixed are integer combinations

    Z_fixed a = z

an estimator conditions on; an original ambiguity is fixed by itself where Z_fixed determines it, that is where its row of
inv(Z) has no entry in the columns of the combinations left free.

`fix_ordered` drops original ambiguities instead, in an order given: by elevation, by the length of their arcs, by
carrier-to-noise density. Each subset is decorrelated anew. Fewer are fixed than from combinations, but each by itself.

Source: Teunissen, Joosten and Tiberius (1999) for partial resolution; Verhagen and others (2011) for subsets of the original
ambiguities; the ratio test on each subset is added.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import numpy as np
from numpy.typing import ArrayLike

from ambiguity import _kernels as kernels
from ambiguity._input import at_least_one, pair, raise_fault, require_sound
from ambiguity.decorrelation import factorise
from ambiguity.types import Array, BoolArray, IntArray
from ambiguity.validation import check_threshold, ratio_of

LARGEST_SUM = 2.0**62  # of integer products
MAX_NODES = 1_000_000  # for each subset; one that needs more is far from fixable


class FixStatus(Enum):
    """What became integer, from worst to best."""

    NONE = 0  # there are no ambiguities
    FLOAT = 1
    PARTIAL = 2
    FIXED = 3


@dataclass(frozen=True, slots=True)
class FixResult:
    """Integer constraints Z_fixed a = z and what they say about single ambiguities."""

    status: FixStatus
    Z_fixed: IntArray  # (m, n) identity when all are fixed, rows of it from `fix_ordered`, no rows when none is
    z: IntArray  # (m,)
    fixed: BoolArray  # (n,) ambiguities the constraints determine
    integers: Array  # (n,) [cyc] NaN where not fixed
    ratio: float  # of the integers in use; NaN without
    success_rate: float  # bootstrapped, of the integers in use; NaN without
    ratio_all: float  # of the whole set; NaN where its success rate ruled it out or its search was not proven
    success_rate_all: float  # of the whole set; 1 for none
    nodes: int  # integers tried in all searches


def fix(
    a_float: ArrayLike, Q: ArrayLike, ratio_threshold: float = 3.0, min_success_rate: float = 0.999, max_nodes: int = MAX_NODES
) -> FixResult:
    """Fix all ambiguities, or the largest decorrelated subset that passes both tests.

    Parameters
    ----------
    a_float : (n,) float ambiguities [cyc]
    Q : (n, n) their covariance [cyc^2]
    ratio_threshold : smallest ratio of squared norms, second to best, at least 1
    min_success_rate : smallest bootstrapped success rate in [0, 1]; 0 leaves the decision to the ratio alone
    max_nodes : budget of each search; a subset whose search is not proven is not fixed

    Raises ValueError for unusable input, as `integer_least_squares`.
    """
    a, Q = pair(a_float, Q)
    budget = _budget(ratio_threshold, min_success_rate, max_nodes)
    n = a.size
    if n == 0:
        return _unfixed(0, FixStatus.NONE, np.nan, 1.0, 0)
    require_sound(a, Q)
    offset, remainder = kernels.split(a)
    UZ, D, Y, z_float = _reduced(remainder, Q)
    success = kernels.trailing_success(D)
    ratio_all, nodes = np.nan, 0
    for first in np.flatnonzero(success[:n] >= min_success_rate).tolist():
        z, ratio, visited = _nearest(np.ascontiguousarray(UZ[first:, first:n]), D[first:], z_float[first:], budget)
        nodes += visited
        if first == 0:
            ratio_all = ratio
        if ratio >= ratio_threshold:
            constraints = _constraints(UZ[:, n:], Y, z, offset)
            return FixResult(*constraints, ratio, float(success[first]), ratio_all, float(success[0]), nodes)
    return _unfixed(n, FixStatus.FLOAT, ratio_all, float(success[0]), nodes)


def fix_ordered(
    a_float: ArrayLike,
    Q: ArrayLike,
    priority: ArrayLike,
    ratio_threshold: float = 3.0,
    min_success_rate: float = 0.999,
    max_nodes: int = MAX_NODES,
) -> FixResult:
    """Fix all ambiguities, or drop those of the lowest priority one by one until the rest passes both tests.

    Parameters
    ----------
    a_float : (n,) float ambiguities [cyc]
    Q : (n, n) their covariance [cyc^2]
    priority : (n,) the larger the longer kept: elevation [rad], arc length [s] or epochs since the last slip; of equal ones
        the later is dropped first
    ratio_threshold, min_success_rate, max_nodes : as in `fix`

    Raises ValueError for unusable input, as `integer_least_squares`, and for priorities that are not n numbers.
    Source: Verhagen and others (2011).
    """
    a, Q = pair(a_float, Q)
    budget = _budget(ratio_threshold, min_success_rate, max_nodes)
    rank = np.asarray(priority, dtype=np.float64)
    n = a.size
    if rank.shape != (n,) or np.isnan(rank).any():
        raise ValueError(f"priority must hold {n} numbers, one for each ambiguity, got {rank}")
    if n == 0:
        return _unfixed(0, FixStatus.NONE, np.nan, 1.0, 0)
    require_sound(a, Q)
    offset, remainder = kernels.split(a)
    order = np.argsort(-rank, kind="stable")
    ratio_all, success_all, nodes = np.nan, np.nan, 0
    for m in range(n, 0, -1):
        kept = np.sort(order[:m])
        UZ, D, Y, z_float = _reduced(remainder[kept], Q[np.ix_(kept, kept)])
        success = float(kernels.trailing_success(D)[0])
        if m == n:
            success_all = success
        if success < min_success_rate:
            continue
        z, ratio, visited = _nearest(UZ, D, z_float, budget)
        nodes += visited
        if m == n:
            ratio_all = ratio
        if ratio >= ratio_threshold:
            _, Z, values, _, _ = _constraints(UZ[:, m:], Y, z, offset[kept])
            Z_fixed, integers = np.zeros((m, n), np.int64), np.full(n, np.nan)
            Z_fixed[:, kept], integers[kept] = Z, values
            status = FixStatus.FIXED if m == n else FixStatus.PARTIAL
            return FixResult(
                status, Z_fixed, values, np.isfinite(integers), integers, ratio, success, ratio_all, success_all, nodes
            )
    return _unfixed(n, FixStatus.FLOAT, ratio_all, success_all, nodes)


def _budget(ratio_threshold: float, min_success_rate: float, max_nodes: int) -> int:
    """The budget of a search; raises ValueError for an option outside its range."""
    check_threshold(ratio_threshold)
    if not 0 <= min_success_rate <= 1:
        raise ValueError(f"min_success_rate must lie in [0, 1], got {min_success_rate}")
    return at_least_one("max_nodes", max_nodes)


def _nearest(U: Array, D: Array, z_float: Array, budget: int) -> tuple[Array, float, int]:
    """Nearest integers, the ratio of the two nearest (NaN where not proven), nodes."""
    best, norms, nodes, proven = kernels.search(U, D, z_float, 2, budget)
    return best[0], ratio_of(norms) if proven else np.nan, nodes


def _reduced(remainder: Array, Q: Array) -> tuple[Array, Array, Array, Array]:
    """[U, Z], D, Y and z of `kernels.reduce`; raises its fault."""
    code, row, value, UZ, D, Y, z_float = kernels.reduce(remainder, Q)
    if code != kernels.OK:
        raise_fault(code, row, row, value, Q)
    return UZ, D, Y, z_float


def _constraints(Z_float: Array, Y: Array, z: Array, offset: Array) -> tuple[FixStatus, IntArray, IntArray, BoolArray, Array]:
    """The first five fields of a result: status, Z_fixed, z, fixed, integers, from the trailing integers of Z (a - offset)."""
    n = len(offset)
    first = n - len(z)
    if np.max(np.abs(Z_float) @ np.abs(offset)) > LARGEST_SUM:
        raise ValueError("a_float is too large for this Q: Z a exceeds 64-bit integers; remove a common offset first")
    shift = offset.astype(np.int64)
    z_fixed = z.astype(np.int64)
    fixed: BoolArray = ~np.any(Y[:first], axis=0)
    # inv(Z) z of the fixed part is a whole ambiguity where `fixed` says so, and unused elsewhere.
    values = z_fixed @ Y[first:].astype(np.int64) + shift
    integers = np.where(fixed, values, np.nan)
    if first == 0:
        return FixStatus.FIXED, np.eye(n, dtype=np.int64), values, fixed, integers
    Z_fixed = Z_float[first:].astype(np.int64)
    return FixStatus.PARTIAL, Z_fixed, z_fixed + Z_fixed @ shift, fixed, integers


def condition(a_float: ArrayLike, Q: ArrayLike, Z: ArrayLike, z: ArrayLike) -> tuple[Array, Array]:
    """Float ambiguities and covariance given Z a = z.

        K = Q Z' inv(Z Q Z'),   a_cond = a + K (z - Z a),   Q_cond = Q - K Z Q

    in square-root form: with Q = C C' and Z C = (B R)', B of orthonormal columns, K = C B inv(R') and
    Q_cond = E E', E = C - C B B', which stays symmetric and non-negative.

    Parameters
    ----------
    a_float, Q : (n,), (n, n) [cyc], [cyc^2]
    Z, z : (m, n), (m,) integer constraints with independent rows; m = 0 returns the input

    Returns a_cond (n,) and Q_cond (n, n), of rank n - m. Raises ValueError for shapes that disagree, constraints that are
    not integers or not independent, and unusable a_float or Q. Source: Teunissen (1995), the fixed solution.
    """
    a, Q = pair(a_float, Q)
    Z, z = _integers("Z", Z), _integers("z", z)
    if Z.shape != (z.size, a.size) or z.ndim != 1:
        raise ValueError(f"Z must have shape (m, {a.size}) and z (m,), got {Z.shape} and {z.shape}")
    require_sound(a, Q)
    if z.size == 0:
        return a, Q
    U, D, order = factorise(Q)
    C = np.empty_like(U)
    C[order] = U * np.sqrt(D)
    B, R = np.linalg.qr((Z @ C).T)
    size = np.linalg.norm(np.abs(Z) @ np.abs(C), axis=1)
    if z.size > a.size or np.any(np.abs(np.diag(R)) <= 10 * a.size * np.finfo(np.float64).eps * size):
        raise ValueError(f"the {z.size} constraints Z a = z must be independent")
    offset = np.rint(a)  # keeps Z a exact where the ambiguities are large
    misclosure = (z - Z @ offset.astype(np.int64)) - Z @ (a - offset)
    CB = C @ B
    E = C - CB @ B.T
    return a + CB @ np.linalg.solve(R.T, misclosure), E @ E.T


def _integers(name: str, values: ArrayLike) -> IntArray:
    x = np.asarray(values)
    if x.size and not (np.all(np.isfinite(x)) and np.all(x == np.rint(x))):
        raise ValueError(f"{name} must hold integers")
    return x.astype(np.int64)


def _unfixed(n: int, status: FixStatus, ratio_all: float, success_rate_all: float, nodes: int) -> FixResult:
    none = np.zeros(0, np.int64)
    free = np.zeros(n, bool)
    unknown = np.full(n, np.nan)
    return FixResult(status, none.reshape(0, n), none, free, unknown, np.nan, np.nan, ratio_all, success_rate_all, nodes)
