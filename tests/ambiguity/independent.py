"""Every integer vector inside an ellipsoid, by a path that shares nothing with the package.

    |a_float - a|^2 = |R (a_float - a)|^2,   R' R = inv(Q)

The columns of R are reduced after Lenstra, Lenstra and Lovász (1982) in the textbook's form, and the ellipsoid is walked
after Fincke and Pohst (1985): a fixed radius, intervals in ascending order, nothing shrinks. Two vectors within the
second norm of a pair, and none more, prove the pair.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from ambiguity.types import Array, IntArray


@njit(cache=True)
def _gram_schmidt(B: Array) -> tuple[Array, Array]:
    """mu (n, n) and squared lengths (n,) of the orthogonalised columns of B."""
    n = B.shape[1]
    S, mu, c = B.copy(), np.eye(n), np.empty(n)
    for i in range(n):
        for j in range(i):
            mu[i, j] = (B[:, i] * S[:, j]).sum() / c[j]
            S[:, i] -= mu[i, j] * S[:, j]
        c[i] = (S[:, i] ** 2).sum()
    return mu, c


@njit(cache=True)
def lenstra(B: Array) -> IntArray:
    """Unimodular T such that the columns of B T are reduced; the factors are computed afresh after every exchange."""
    B = B.copy()
    n = B.shape[1]
    T = np.eye(n).astype(np.int64)
    mu, c = _gram_schmidt(B)
    k = 1
    while k < n:
        for j in range(k - 1, -1, -1):
            q = round(mu[k, j])
            if q != 0:
                B[:, k] -= q * B[:, j]
                T[:, k] -= np.int64(q) * T[:, j]
                mu[k, : j + 1] -= q * mu[j, : j + 1]
        if c[k] >= (0.75 - mu[k, k - 1] ** 2) * c[k - 1]:
            k += 1
        else:
            for row in range(n):
                B[row, k], B[row, k - 1] = B[row, k - 1], B[row, k]
                T[row, k], T[row, k - 1] = T[row, k - 1], T[row, k]
            mu, c = _gram_schmidt(B)
            k = max(k - 1, 1)
    return T


@njit(cache=True)
def _walk(R: Array, y: Array, radius: float, found: Array, norms: Array) -> int:
    """Fill found (k, n) and norms (k,) with the vectors within the radius; returns how many there are, also beyond k."""
    n = y.size
    x, last, centre, left = np.empty(n), np.empty(n), np.empty(n), np.empty(n + 1)
    left[n] = radius
    count, k, enter = 0, n - 1, True
    while k < n:
        if enter:
            s = 0.0
            for j in range(k + 1, n):
                s += R[k, j] * (y[j] - x[j])
            centre[k] = y[k] + s / R[k, k]
            half = math.sqrt(left[k + 1]) / abs(R[k, k])
            x[k], last[k] = math.ceil(centre[k] - half), math.floor(centre[k] + half)
        else:
            x[k] += 1.0
        if x[k] > last[k]:
            k, enter = k + 1, False
            continue
        rest = left[k + 1] - (R[k, k] * (centre[k] - x[k])) ** 2
        if rest < 0.0:
            enter = False
        elif k > 0:
            left[k] = rest
            k, enter = k - 1, True
        else:
            if count < len(norms):
                found[count] = x
                norms[count] = radius - rest
            count += 1
            enter = False
    return count


def vectors_within(a_float: Array, Q: Array, squared_radius: float, at_most: int = 16) -> tuple[IntArray, Array]:
    """All integer vectors with |a_float - a|^2 <= squared_radius, nearest first: (k, n) and squared norms (k,)."""
    offset = np.rint(a_float)
    R = np.linalg.cholesky(np.linalg.inv(Q)).T
    T = lenstra(np.ascontiguousarray(R))
    reduced = np.linalg.qr(R @ T, mode="r")
    y = np.linalg.solve(T.astype(float), a_float - offset)
    found, norms = np.empty((at_most, len(y))), np.empty(at_most)
    count = _walk(np.ascontiguousarray(reduced), y, squared_radius, found, norms)
    assert count <= at_most
    order = np.argsort(norms[:count])
    integers = np.rint(found[order]).astype(np.int64) @ T.T + offset.astype(np.int64)
    return integers, norms[order]
