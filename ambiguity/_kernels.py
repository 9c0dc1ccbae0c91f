"""Compiled loops of integer ambiguity resolution.

    Q = W' U D U' W,  U unit upper triangular, D diagonal, W a permutation
    z = Z a,          Z unimodular; Qz = Z Q Z' = U D U' after reduction

U is the transpose of the factor L in Q = L' D L. D[k] is the variance of z[k] given z[k+1:], so the trailing m
entries of z have covariance U[-m:, -m:] D[-m:] U[-m:, -m:]' without another factorisation. Rows are contiguous in
every inner loop; the inverse of Z is kept transposed (`Y = inv(Z)'`) for the same reason.

The float vector is shifted by its rounded value before anything else, so its size costs no digits.

Source: de Jonge and Tiberius (1996) for factorisation and reduction; Chang, Yang and Zhou (2005) for the pivoting and
for searching while shrinking; Xie, Chang and Al Borno (2011) for reducing a row only when it is exchanged; Schnorr and
Euchner (1994) for the order of the search.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from ambiguity.types import Array, IntArray

OK, BAD_FLOAT, HUGE_FLOAT, BAD_COVARIANCE, ASYMMETRIC, NOT_POSITIVE, ILL_CONDITIONED = range(7)

SYMMETRY = 1e-6  # of sqrt(Q_ii Q_jj)
LARGEST_FLOAT = 2.0**51  # cycles; beyond it no fraction is left
LARGEST_ENTRY = 2.0**40  # of Z and its inverse: floats keep 12 bits of fraction
EXCHANGE = 1.0 - 1e-6  # an exchange must shrink the conditional variance by this factor: no endless ties


@njit(cache=True)
def check(a: Array, Q: Array) -> tuple[int, int, int, float]:
    """First fault of the input: code, row, column, value."""
    n = a.size
    for i in range(n):
        if not math.isfinite(a[i]):
            return BAD_FLOAT, i, 0, a[i]
        if abs(a[i]) > LARGEST_FLOAT:
            return HUGE_FLOAT, i, 0, a[i]
    for i in range(n):
        for j in range(i + 1):
            if not (math.isfinite(Q[i, j]) and math.isfinite(Q[j, i])):
                return BAD_COVARIANCE, i, j, Q[i, j]
        if not Q[i, i] > 0.0:
            return NOT_POSITIVE, i, i, Q[i, i]
    for i in range(n):
        for j in range(i):
            if abs(Q[i, j] - Q[j, i]) > SYMMETRY * math.sqrt(Q[i, i] * Q[j, j]):
                return ASYMMETRIC, i, j, Q[i, j] - Q[j, i]
    return OK, 0, 0, 0.0


@njit(cache=True)
def _swap_symmetric(L: Array, p: int, k: int) -> None:
    """Exchange indices p < k of a symmetric matrix held in its lower triangle; rows below k are finished factors."""
    n = L.shape[0]
    for j in range(p):
        L[k, j], L[p, j] = L[p, j], L[k, j]
    for i in range(p + 1, k):
        L[i, p], L[k, i] = L[k, i], L[i, p]
    L[k, k], L[p, p] = L[p, p], L[k, k]
    for i in range(k + 1, n):
        L[i, p], L[i, k] = L[i, k], L[i, p]


@njit(cache=True)
def factorise(Q: Array) -> tuple[int, int, float, Array, Array, IntArray]:
    """Q[order][:, order] = U D U', the smallest conditional variance last.

    Returns code, index and value of a pivot that is not positive, U (n, n), D (n,), order (n,).
    """
    n = Q.shape[0]
    U, D, order = np.zeros((n, n)), np.empty(n), np.empty(n, np.int64)
    L = np.empty((n, n))
    for i in range(n):
        U[i, i] = 1.0
        order[i] = i
        for j in range(i + 1):
            L[i, j] = 0.5 * (Q[i, j] + Q[j, i])
    for k in range(n - 1, -1, -1):
        p = k
        for i in range(k):
            if L[i, i] < L[p, p]:
                p = i
        if p != k:
            _swap_symmetric(L, p, k)
            order[p], order[k] = order[k], order[p]
        d = L[k, k]
        # What rounding leaves of a diagonal element is no variance.
        if not d > 4 * np.finfo(np.float64).eps * n * Q[order[k], order[k]]:
            return NOT_POSITIVE, order[k], d, U, D, order
        D[k] = d
        for i in range(k):
            u = L[k, i] / d
            for j in range(i + 1):
                L[i, j] -= u * L[k, j]
        for i in range(k):
            L[k, i] /= d
    for i in range(n):
        for j in range(i):
            U[j, i] = L[i, j]
    return OK, 0, 0.0, U, D, order


@njit(cache=True)
def _largest(row: Array, start: int) -> float:
    m = 0.0
    for j in range(start, row.size):
        m = max(m, abs(row[j]))
    return m


@njit(cache=True)
def _add_multiple(x: Array, m: float, y: Array) -> None:
    for j in range(x.size):
        x[j] += m * y[j]


@njit(cache=True)
def _swap(x: Array, y: Array, start: int) -> None:
    for j in range(start, x.size):
        t = x[j]
        x[j] = y[j]
        y[j] = t


@njit(cache=True)
def _within_bounds(UZ: Array, Y: Array, bounds: Array, k: int, i: int, m: float) -> bool:
    """Whether Z[k] - m Z[i] and Y[i] + m Y[k] stay exact; renews the rows' bounds when they say no."""
    n = Y.shape[0]
    for attempt in range(2):
        if attempt == 1:
            for r in (k, i):
                bounds[0, r], bounds[1, r] = _largest(UZ[r], n), _largest(Y[r], 0)
        z_k, y_i = bounds[0, k] + m * bounds[0, i], bounds[1, i] + m * bounds[1, k]
        if z_k <= LARGEST_ENTRY and y_i <= LARGEST_ENTRY:
            bounds[0, k], bounds[1, i] = z_k, y_i
            return True
    return False


@njit(cache=True)
def _round_row(UZ: Array, Y: Array, bounds: Array, z: Array, k: int) -> bool:
    """Integer Gauss on row k: every U[k, i > k] to at most one half. False where an entry of Z would grow too large."""
    row = UZ[k]
    for i in range(k + 1, z.size):
        m = np.rint(row[i])
        if m != 0.0:
            if not _within_bounds(UZ, Y, bounds, k, i, abs(m)):
                return False
            _add_multiple(row, -m, UZ[i])
            _add_multiple(Y[i], m, Y[k])
            z[k] -= m * z[i]
    return True


@njit(cache=True)
def _exchange(UZ: Array, D: Array, Y: Array, bounds: Array, z: Array, k: int) -> None:
    """Exchange z[k] and z[k + 1] and restore Qz = U D U'."""
    u = UZ[k, k + 1]
    d = D[k] + u * u * D[k + 1]
    eta, lam = D[k] / d, u * D[k + 1] / d
    D[k], D[k + 1] = eta * D[k + 1], d
    for r in range(k):
        x, y = UZ[r, k], UZ[r, k + 1]
        UZ[r, k], UZ[r, k + 1] = y - u * x, eta * x + lam * y
    _swap(UZ[k], UZ[k + 1], k + 2)
    _swap(Y[k], Y[k + 1], 0)
    UZ[k, k + 1] = lam
    for side in range(2):
        bounds[side, k], bounds[side, k + 1] = bounds[side, k + 1], bounds[side, k]
    z[k], z[k + 1] = z[k + 1], z[k]


@njit(cache=True)
def reduce(a: Array, Q: Array) -> tuple[int, int, float, Array, Array, Array, Array]:
    """Decorrelate: code, index, value of a fault, then [U, Z] (n, 2n), D, Y = inv(Z)', z = Z a.

    Z and Y hold integers as floats, exact because their size is limited: rows then take part in vector instructions.
    """
    n = a.size
    UZ, Y, bounds, z = np.zeros((n, 2 * n)), np.zeros((n, n)), np.ones((2, n)), np.empty(n)
    code, index, value, U, D, order = factorise(Q)
    if code != OK:
        return code, index, value, UZ, D, Y, z
    for k in range(n):
        for j in range(k, n):
            UZ[k, j] = U[k, j]
        UZ[k, n + order[k]] = 1.0
        Y[k, order[k]] = 1.0
        z[k] = a[order[k]]
    k = n - 2
    while k >= 0:
        m = np.rint(UZ[k, k + 1])
        u = UZ[k, k + 1] - m
        if D[k] + u * u * D[k + 1] < EXCHANGE * D[k + 1]:
            # Rows are rounded only where it changes what is exchanged; that is often enough to keep U small.
            if m != 0.0 and not _round_row(UZ, Y, bounds, z, k):
                return ILL_CONDITIONED, k, 0.0, UZ, D, Y, z
            _exchange(UZ, D, Y, bounds, z, k)
            k = min(k + 1, n - 2)
        else:
            k -= 1
    for k in range(n - 2, -1, -1):
        if not _round_row(UZ, Y, bounds, z, k):
            return ILL_CONDITIONED, k, 0.0, UZ, D, Y, z
    return OK, 0, 0.0, UZ, D, Y, z


@njit(cache=True)
def search(U: Array, D: Array, z_float: Array, n_candidates: int, max_nodes: int) -> tuple[Array, Array, int, bool]:
    """The integer vectors z nearest to z_float in the metric of inv(U D U'), best first; U may have more columns.

    Depth first from the last entry, integers in order of distance; the radius is the worst of the kept candidates once
    there are enough. One node is one integer tried. Returns (n_candidates, n) integers as floats, their squared norms,
    nodes, and whether the tree was closed.
    """
    n = D.size
    best, norms = np.empty((n_candidates, n)), np.empty(n_candidates)
    z, centre, step, w = np.empty(n), np.empty(n), np.empty(n), np.empty(n)
    above, weight = np.zeros(n), np.empty(n)
    # partial[k, j] holds sum_{i >= j} U[k, i] (z_i - centre_i); stale[k] is the highest i changed since.
    partial, stale = np.zeros((n, n + 1)), np.empty(n, np.int64)
    for j in range(n):
        weight[j] = 1.0 / D[j]
        stale[j] = n - 1
    found, nodes, radius = 0, 0, np.inf
    k = n - 1
    centre[k] = z_float[k]
    z[k] = np.rint(centre[k])
    w[k] = z[k] - centre[k]
    step[k] = -1.0 if w[k] > 0.0 else 1.0
    while True:
        if nodes >= max_nodes and found == n_candidates:
            return best, norms, nodes, False
        nodes += 1
        norm = above[k] + w[k] * w[k] * weight[k]
        if norm < radius and k > 0:
            k -= 1
            above[k] = norm
            top = stale[k]
            for j in range(top, k, -1):
                partial[k, j] = partial[k, j + 1] + U[k, j] * w[j]
            if k > 0 and stale[k - 1] < top:
                stale[k - 1] = top
            stale[k] = k + 1
            centre[k] = z_float[k] + partial[k, k + 1]
            z[k] = np.rint(centre[k])
            w[k] = z[k] - centre[k]
            step[k] = -1.0 if w[k] > 0.0 else 1.0
            continue
        if norm < radius:
            p = min(found, n_candidates - 1)
            while p > 0 and norms[p - 1] > norm:
                norms[p] = norms[p - 1]
                for j in range(n):
                    best[p, j] = best[p - 1, j]
                p -= 1
            norms[p] = norm
            for j in range(n):
                best[p, j] = z[j]
            if found < n_candidates:
                found += 1
            if found == n_candidates:
                radius = norms[n_candidates - 1]
        else:
            k += 1
            if k == n:
                return best, norms, nodes, True
        z[k] += step[k]
        w[k] = z[k] - centre[k]
        step[k] = -step[k] - (1.0 if step[k] > 0.0 else -1.0)


@njit(cache=True)
def restore(Y: Array, z: Array, offset: Array, a: IntArray) -> None:
    """Fill a = offset + inv(Z) z, exact: overflow wraps, so sums of which only the total fits are right."""
    n = offset.size
    for j in range(n):
        a[j] = np.int64(offset[j])
    for k in range(n):
        m = np.int64(z[k])
        if m != 0:
            for j in range(n):
                a[j] += m * np.int64(Y[k, j])


@njit(cache=True)
def split(a: Array) -> tuple[Array, Array]:
    """Nearest integers and what remains of a."""
    offset, remainder = np.empty(a.size), np.empty(a.size)
    for i in range(a.size):
        offset[i] = np.rint(a[i])
        remainder[i] = a[i] - offset[i]
    return offset, remainder


@njit(cache=True)
def integer_least_squares(
    a: Array, Q: Array, n_candidates: int, max_nodes: int
) -> tuple[int, int, int, float, IntArray, Array, bool, int]:
    """Check, decorrelate, search: code, row, column, value of a fault; candidates, norms, proven, nodes."""
    n = a.size
    candidates, norms = np.empty((n_candidates, n), np.int64), np.empty(n_candidates)
    code, row, column, value = check(a, Q)
    if code != OK:
        return code, row, column, value, candidates, norms, False, 0
    offset, remainder = split(a)
    code, row, value, UZ, D, Y, z = reduce(remainder, Q)
    if code != OK:
        return code, row, row, value, candidates, norms, False, 0
    best, norms, nodes, proven = search(UZ, D, z, n_candidates, max_nodes)
    for c in range(n_candidates):
        restore(Y, best[c], offset, candidates[c])
    return OK, 0, 0, 0.0, candidates, norms, proven, nodes


@njit(cache=True)
def round_sequentially(UZ: Array, z_float: Array) -> Array:
    """Integer bootstrapping from the last entry: each is rounded given those already rounded. Integers as floats."""
    n = z_float.size
    z, w = np.empty(n), np.empty(n)
    for k in range(n - 1, -1, -1):
        centre = z_float[k]
        for i in range(k + 1, n):
            centre += UZ[k, i] * w[i]
        z[k] = np.rint(centre)
        w[k] = z[k] - centre
    return z


@njit(cache=True)
def trailing_success(D: Array) -> Array:
    """Bootstrapped success rate of the trailing entries k, k + 1, ... for every k; 1 for none of them. Shape (n + 1,)."""
    n = D.size
    p = np.ones(n + 1)
    for k in range(n - 1, -1, -1):
        p[k] = p[k + 1] * math.erf(1.0 / math.sqrt(8.0 * D[k]))
    return p
