"""Fixing what can be fixed, and conditioning on it.

All ambiguities are tried first. Where their success rate or ratio does not suffice, the decorrelated ambiguities z = Z a
lose their least precise members one by one until both suffice. What is then fixed are integer combinations

    Z_fixed a = z

an estimator conditions on; an original ambiguity is fixed by itself where Z_fixed determines it, that is where its row of
inv(Z) has no entry in the columns of the combinations left free.

Source: Teunissen, Joosten and Tiberius (1999) for partial resolution; the ratio test on each subset is added.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import numpy as np
from numpy.typing import ArrayLike

from ambiguity import _kernels as kernels
from ambiguity._input import pair, raise_fault, require_sound
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
    Z_fixed: IntArray  # (m, n) identity when all are fixed, no rows when none is
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
    check_threshold(ratio_threshold)
    if not 0 <= min_success_rate <= 1:
        raise ValueError(f"min_success_rate must lie in [0, 1], got {min_success_rate}")
    if max_nodes < 1:
        raise ValueError(f"max_nodes must be at least 1, got {max_nodes}")
    n = a.size
    if n == 0:
        return _unfixed(0, FixStatus.NONE, np.nan, 1.0, 0)
    require_sound(a, Q)
    offset, remainder = kernels.split(a)
    code, row, value, UZ, D, Y, z_float = kernels.reduce(remainder, Q)
    if code != kernels.OK:
        raise_fault(code, row, row, value, Q)
    success = kernels.trailing_success(D)
    ratio_all, nodes = np.nan, 0
    for first in np.flatnonzero(success[:n] >= min_success_rate).tolist():
        U = np.ascontiguousarray(UZ[first:, first:n])
        best, norms, visited, proven = kernels.search(U, D[first:], z_float[first:], 2, int(max_nodes))
        nodes += visited
        ratio = ratio_of(norms) if proven else np.nan
        if first == 0:
            ratio_all = ratio
        if ratio >= ratio_threshold:
            constraints = _constraints(UZ[:, n:], Y, best[0], offset)
            return FixResult(*constraints, ratio, float(success[first]), ratio_all, float(success[0]), nodes)
    return _unfixed(n, FixStatus.FLOAT, ratio_all, float(success[0]), nodes)


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
    try:
        C = np.linalg.cholesky(0.5 * (Q + Q.T))
    except np.linalg.LinAlgError:
        smallest = np.linalg.eigvalsh(Q)[0]
        raise ValueError(f"Q must be positive definite; its smallest eigenvalue is {smallest:.3g}") from None
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
