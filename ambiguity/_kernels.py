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

from ambiguity.types import Array, BoolArray, IntArray

OK, BAD_FLOAT, HUGE_FLOAT, BAD_COVARIANCE, ASYMMETRIC, NOT_POSITIVE, ILL_CONDITIONED = range(7)

SYMMETRY = 1e-6  # of sqrt(Q_ii Q_jj)
LARGEST_FLOAT = 2.0**51  # cycles; beyond it no fraction is left
LARGEST_ENTRY = 2.0**40  # of Z and its inverse: floats keep 12 bits of fraction
EXCHANGE = 1.0 - 1e-6  # an exchange must shrink the conditional variance by this factor: no endless ties


@njit(cache=True, error_model="numpy")
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


@njit(cache=True, error_model="numpy")
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


@njit(cache=True, error_model="numpy")
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


@njit(cache=True, error_model="numpy")
def _largest(A: Array, row: int, start: int) -> float:
    m = 0.0
    for j in range(start, A.shape[1]):
        m = max(m, abs(A[row, j]))
    return m


@njit(cache=True, error_model="numpy")
def _renew_bounds(UZ: Array, Y: Array, bounds: Array, k: int, i: int, m: float) -> tuple[float, float]:
    """Bounds of Z[k] - m Z[i] and Y[i] + m Y[k] from the entries themselves; infinite without Z."""
    n = Y.shape[0]
    if UZ.shape[1] == n:
        return np.inf, np.inf
    for r in (k, i):
        bounds[0, r], bounds[1, r] = _largest(UZ, r, n), _largest(Y, r, 0)
    return bounds[0, k] + m * bounds[0, i], bounds[1, i] + m * bounds[1, k]


@njit(cache=True, error_model="numpy", inline="always")
def _round_row(UZ: Array, Y: Array, bounds: Array, z: Array, k: int) -> bool:
    """Integer Gauss on row k: every U[k, i > k] to at most one half. False where an entry of Z would grow too large."""
    n, width = UZ.shape
    for i in range(k + 1, n):
        m = np.rint(UZ[k, i])
        if m != 0.0:
            z_k, y_i = bounds[0, k] + abs(m) * bounds[0, i], bounds[1, i] + abs(m) * bounds[1, k]
            if max(z_k, y_i) > LARGEST_ENTRY:
                z_k, y_i = _renew_bounds(UZ, Y, bounds, k, i, abs(m))
                if max(z_k, y_i) > LARGEST_ENTRY:
                    return False
            bounds[0, k], bounds[1, i] = z_k, y_i
            for j in range(i, width):
                UZ[k, j] -= m * UZ[i, j]
            for j in range(n):
                Y[i, j] += m * Y[k, j]
            z[k] -= m * z[i]
    return True


@njit(cache=True, error_model="numpy", inline="always")
def _exchange(UZ: Array, D: Array, Y: Array, bounds: Array, z: Array, k: int) -> None:
    """Exchange z[k] and z[k + 1] and restore Qz = U D U'."""
    n, width = UZ.shape
    u = UZ[k, k + 1]
    d = D[k] + u * u * D[k + 1]
    eta, lam = D[k] / d, u * D[k + 1] / d
    D[k], D[k + 1] = eta * D[k + 1], d
    for r in range(k):
        x, y = UZ[r, k], UZ[r, k + 1]
        UZ[r, k], UZ[r, k + 1] = y - u * x, eta * x + lam * y
    for j in range(k + 2, width):
        UZ[k, j], UZ[k + 1, j] = UZ[k + 1, j], UZ[k, j]
    for j in range(n):
        Y[k, j], Y[k + 1, j] = Y[k + 1, j], Y[k, j]
    UZ[k, k + 1] = lam
    for side in range(2):
        bounds[side, k], bounds[side, k + 1] = bounds[side, k + 1], bounds[side, k]
    z[k], z[k + 1] = z[k + 1], z[k]


@njit(cache=True, error_model="numpy", inline="always")
def _reduce(a: Array, Q: Array, width: int) -> tuple[int, int, float, Array, Array, Array, Array]:
    """As `reduce`, the first `width` columns of [U, Z] alone: n leaves out Z."""
    n = a.size
    UZ, Y, bounds, z = np.zeros((n, width)), np.zeros((n, n)), np.ones((2, n)), np.empty(n)
    code, index, value, U, D, order = factorise(Q)
    if code != OK:
        return code, index, value, UZ, D, Y, z
    for k in range(n):
        for j in range(k, n):
            UZ[k, j] = U[k, j]
        if width > n:
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


@njit(cache=True, error_model="numpy")
def reduce(a: Array, Q: Array) -> tuple[int, int, float, Array, Array, Array, Array]:
    """Decorrelate: code, index, value of a fault, then [U, Z] (n, 2n), D, Y = inv(Z)', z = Z a.

    Z and Y hold integers as floats, exact because their size is limited: rows then take part in vector instructions.
    """
    return _reduce(a, Q, 2 * a.size)


@njit(cache=True, error_model="numpy")
def reduce_without_Z(a: Array, Q: Array) -> tuple[int, int, float, Array, Array, Array, Array]:
    """As `reduce` in less time, U (n, n) in place of [U, Z] where the size of Z can be vouched for without it."""
    reduced = _reduce(a, Q, a.size)
    return reduce(a, Q) if reduced[0] == ILL_CONDITIONED else reduced


@njit(cache=True, error_model="numpy")
def _keep(best: Array, norms: Array, found: int, z: Array, norm: float) -> int:
    """Insert z among the candidates found so far, the worst giving way; how many there are then."""
    n_candidates, n = best.shape
    p = min(found, n_candidates - 1)
    while p > 0 and norms[p - 1] > norm:
        norms[p] = norms[p - 1]
        for j in range(n):
            best[p, j] = best[p - 1, j]
        p -= 1
    norms[p] = norm
    for j in range(n):
        best[p, j] = z[j]
    return found + 1 if found < n_candidates else found


@njit(cache=True, error_model="numpy")
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
            found = _keep(best, norms, found, z, norm)
            if found == n_candidates:
                radius = norms[n_candidates - 1]
        else:
            k += 1
            if k == n:
                return best, norms, nodes, True
        z[k] += step[k]
        w[k] = z[k] - centre[k]
        step[k] = -step[k] - (1.0 if step[k] > 0.0 else -1.0)


@njit(cache=True, error_model="numpy")
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


@njit(cache=True, error_model="numpy")
def split(a: Array) -> tuple[Array, Array]:
    """Nearest integers and what remains of a."""
    offset, remainder = np.empty(a.size), np.empty(a.size)
    for i in range(a.size):
        offset[i] = np.rint(a[i])
        remainder[i] = a[i] - offset[i]
    return offset, remainder


@njit(cache=True, error_model="numpy")
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
    code, row, value, U, D, Y, z = reduce_without_Z(remainder, Q)
    if code != OK:
        return code, row, row, value, candidates, norms, False, 0
    best, norms, nodes, proven = search(U, D, z, n_candidates, max_nodes)
    for c in range(n_candidates):
        restore(Y, best[c], offset, candidates[c])
    return OK, 0, 0, 0.0, candidates, norms, proven, nodes


@njit(cache=True, error_model="numpy")
def _search_reduced(
    a: Array,
    Q: Array,
    reduced: tuple[int, int, float, Array, Array, Array, Array],
    n_candidates: int,
    max_nodes: int,
) -> tuple[int, int, int, float, IntArray, Array, bool, int]:
    """As `integer_least_squares`, with what `reduce` made of Q."""
    n = a.size
    candidates, norms = np.empty((n_candidates, n), np.int64), np.empty(n_candidates)
    code, row, column, value = check(a, Q)
    if code != OK:
        return code, row, column, value, candidates, norms, False, 0
    code, row, value, UZ, D, Y, _ = reduced
    if code != OK:
        return code, row, row, value, candidates, norms, False, 0
    offset, remainder = split(a)
    best, norms, nodes, proven = search(UZ, D, transform(UZ, remainder), n_candidates, max_nodes)
    for c in range(n_candidates):
        restore(Y, best[c], offset, candidates[c])
    return OK, 0, 0, 0.0, candidates, norms, proven, nodes


@njit(cache=True, error_model="numpy")
def integer_least_squares_batch(
    a: Array, Q: Array, n_candidates: int, max_nodes: int
) -> tuple[IntArray, Array, IntArray, Array, BoolArray, IntArray]:
    """Every row of a (B, n) by itself; Q (B, n, n), or (1, n, n) reduced once for all rows.

    Returns faults (B, 3) of code, row, column, their values (B,), candidates (B, k, n), norms (B, k), proven and nodes (B,).
    A row at fault keeps zeros for candidates and NaN for norms.
    """
    n_rows, n = a.shape
    faults, values = np.zeros((n_rows, 3), np.int64), np.zeros(n_rows)
    candidates, norms = np.zeros((n_rows, n_candidates, n), np.int64), np.full((n_rows, n_candidates), np.nan)
    proven, nodes = np.zeros(n_rows, np.bool_), np.zeros(n_rows, np.int64)
    shared = Q.shape[0] == 1
    first = reduce(np.zeros(n), Q[0]) if shared else reduce(np.zeros(0), np.zeros((0, 0)))
    for b in range(n_rows):
        if shared:
            code, row, column, value, found, distances, closed, visited = _search_reduced(
                a[b], Q[0], first, n_candidates, max_nodes
            )
        else:
            code, row, column, value, found, distances, closed, visited = integer_least_squares(
                a[b], Q[b], n_candidates, max_nodes
            )
        if code != OK:
            faults[b, 0], faults[b, 1], faults[b, 2], values[b] = code, row, column, value
            continue
        candidates[b], norms[b], proven[b], nodes[b] = found, distances, closed, visited
    return faults, values, candidates, norms, proven, nodes


@njit(cache=True, error_model="numpy")
def transform(UZ: Array, remainder: Array) -> Array:
    """z = Z a of a small a."""
    n = remainder.size
    z = np.empty(n)
    for k in range(n):
        total = 0.0
        for j in range(n):
            total += UZ[k, n + j] * remainder[j]
        z[k] = total
    return z


@njit(cache=True, error_model="numpy")
def bootstrap_batch(a: Array, Q: Array) -> tuple[IntArray, Array, IntArray, Array]:
    """Sequential rounding of every row of a (B, n) with Q (B, n, n) or (1, n, n).

    Returns faults (B, 3), values (B,), integers (B, n), conditional variances (B, n); NaN variances in a row at fault.
    """
    n_rows, n = a.shape
    faults, values = np.zeros((n_rows, 3), np.int64), np.zeros(n_rows)
    integers, variances = np.zeros((n_rows, n), np.int64), np.full((n_rows, n), np.nan)
    for b in range(n_rows):
        Q_b = Q[0] if Q.shape[0] == 1 else Q[b]
        code, row, column, value = check(a[b], Q_b)
        if code == OK:
            offset, remainder = split(a[b])
            code, row, value, U, D, Y, z = reduce_without_Z(remainder, Q_b)
            column = row
        if code != OK:
            faults[b, 0], faults[b, 1], faults[b, 2], values[b] = code, row, column, value
            continue
        variances[b] = D
        restore(Y, round_sequentially(U, z), offset, integers[b])
    return faults, values, integers, variances


@njit(cache=True, error_model="numpy")
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


@njit(cache=True, error_model="numpy")
def trailing_success(D: Array) -> Array:
    """Bootstrapped success rate of the trailing entries k, k + 1, ... for every k; 1 for none of them. Shape (n + 1,)."""
    n = D.size
    p = np.ones(n + 1)
    for k in range(n - 1, -1, -1):
        p[k] = p[k + 1] * math.erf(1.0 / math.sqrt(8.0 * D[k]))
    return p


@njit(cache=True, error_model="numpy")
def success_of_rows(variances: Array) -> Array:
    """Bootstrapped success rate (B,) of conditional variances (B, n); NaN where a row holds one."""
    p = np.ones(variances.shape[0])
    for b in range(variances.shape[0]):
        for k in range(variances.shape[1]):
            p[b] *= math.erf(1.0 / math.sqrt(8.0 * variances[b, k]))
    return p


@njit(cache=True, error_model="numpy")
def check_batch(a: Array, Q: Array) -> tuple[IntArray, Array]:
    """`check` of every row: codes, rows, columns (B, 3) and values (B,)."""
    faults, values = np.zeros((a.shape[0], 3), np.int64), np.zeros(a.shape[0])
    for b in range(a.shape[0]):
        faults[b, 0], faults[b, 1], faults[b, 2], values[b] = check(a[b], Q[0] if Q.shape[0] == 1 else Q[b])
    return faults, values


@njit(cache=True, error_model="numpy")
def weigh(
    U: Array, D: Array, z_float: Array, radius: float, least: float, max_nodes: int
) -> tuple[float, float, Array, Array, int, int, bool]:
    """Sums over the integer vectors z with |z - z_float|^2 <= radius in the metric of inv(U D U').

    Weights are exp(-(|z - z_float|^2 - least) / 2). Returns their sum and largest, weighted mean (n,) and second moment
    (n, n) of z, the number of vectors, nodes, and whether all were visited.
    """
    n = D.size
    total, largest, mean, moment, count, nodes = 0.0, 0.0, np.zeros(n), np.zeros((n, n)), 0, 0
    z, last, w, above = np.zeros(n), np.empty(n), np.zeros(n), np.zeros(n)
    reach = radius * (1.0 + 1e-12)  # vectors on the boundary belong to the sum whatever the rounding
    k = n - 1
    enter = True
    while k < n:
        if enter:
            centre = z_float[k]
            for j in range(k + 1, n):
                centre += U[k, j] * w[j]
            half = math.sqrt(max(0.0, reach - above[k]) * D[k])
            first, last[k] = math.ceil(centre - half), math.floor(centre + half)
            if k == 0:
                w_0, w_1, w_2 = 0.0, 0.0, 0.0
                x = first
                while x <= last[0]:
                    if nodes >= max_nodes:
                        return total, largest, mean, moment, count, nodes, False
                    nodes += 1
                    count += 1
                    p = math.exp(-0.5 * (above[0] + (x - centre) * (x - centre) / D[0] - least))
                    largest = max(largest, p)
                    w_0 += p
                    w_1 += p * x
                    w_2 += p * x * x
                    x += 1.0
                total += w_0
                mean[0] += w_1
                moment[0, 0] += w_2
                for i in range(1, n):
                    mean[i] += w_0 * z[i]
                    moment[i, 0] += w_1 * z[i]
                    for j in range(1, i + 1):
                        moment[i, j] += w_0 * z[i] * z[j]
                k = 1
                enter = False
                continue
            z[k] = first
            w[k] = first - centre
        else:
            z[k] += 1.0
            w[k] += 1.0
        if z[k] > last[k]:
            k += 1
            enter = False
            continue
        if nodes >= max_nodes:
            return total, largest, mean, moment, count, nodes, False
        nodes += 1
        above[k - 1] = above[k] + w[k] * w[k] / D[k]
        k -= 1
        enter = True
    for i in range(n):
        mean[i] /= total
        for j in range(i + 1):
            moment[i, j] /= total
            moment[j, i] = moment[i, j]
    return total, largest, mean, moment, count, nodes, True


@njit(cache=True, error_model="numpy")
def onto_length(p: Array, c: Array, length: float, variance: float, x: Array) -> float:
    """Minimise sum_i p_i (x_i - c_i)^2 + (|x| - length)^2 / variance; variance 0 demands |x| = length. Fills x.

    Stationary points have x_i = p_i c_i / (p_i + mu) and |x| (1 - mu variance) = length; the one with mu >= -min p is the
    minimum. nu = mu + min p is found by Newton's method on 1 / |x|, which is nearly a line, inside a bracket.
    """
    m = p.size
    low, high, size = p[0], p[0], 0.0
    for i in range(m):
        low, high = min(low, p[i]), max(high, p[i])
        size += c[i] * c[i]
    size = math.sqrt(size)
    # |x| as nu goes to 0, without the softest axes, and what of c lies along those
    soft, along, rest = 0, 0.0, 0.0
    for i in range(m):
        if p[i] == low:
            soft = i
            along = max(along, abs(c[i]))
        else:
            t = p[i] * c[i] / (p[i] - low)
            rest += t * t
    nu, nothing = 0.0, 1e-100 * length
    target = length / (1.0 + low * variance)
    if along > nothing or rest > target * target:
        left, right = min(low, low * along / length), low + max(0.0, high * (size / length - 1.0))
        nu = right
        for _ in range(200):
            s2, slope = 0.0, 0.0
            for i in range(m):
                if abs(c[i]) > nothing:
                    t = p[i] * c[i] / (p[i] - low + nu)
                    s2 += t * t
                    slope += t * t / (p[i] - low + nu)
            s = math.sqrt(s2)
            g = 1.0 / s - (1.0 + (low - nu) * variance) / length
            if g > 0.0:
                right = nu
            else:
                left = nu
            step = -g / (slope / (s2 * s) + variance / length)
            following = nu + step
            if not left < following < right:
                following = math.sqrt(left * right) if left > 0.0 else 0.5 * right
            if abs(following - nu) <= 1e-15 * nu:
                break
            nu = following
    s2 = 0.0
    for i in range(m):
        x[i] = p[i] * c[i] / (p[i] - low + nu) if abs(c[i]) > nothing else 0.0
        s2 += x[i] * x[i]
    if nu == 0.0:
        # c has no part along the softest axis: two minima, either side of it, are as good as each other.
        x[soft] = math.sqrt(max(0.0, target * target - s2))
        s2 += x[soft] * x[soft]
    s = math.sqrt(s2)
    cost = (s - length) * (s - length) / variance if variance > 0.0 else 0.0
    for i in range(m):
        if variance == 0.0:
            x[i] *= length / s
        cost += p[i] * (x[i] - c[i]) * (x[i] - c[i])
    return cost


@njit(cache=True, error_model="numpy")
def search_length(
    U: Array,
    D: Array,
    z_float: Array,
    b_float: Array,
    G: Array,
    axes: Array,
    precision: Array,
    length: float,
    variance: float,
    n_candidates: int,
    max_nodes: int,
) -> tuple[Array, Array, Array, int, bool]:
    """As `search`, every vector charged also with the best b of a given length.

    b has the mean b_float + sum_{j >= k} G[j] w[j] given z[k:], w[j] = z[j] - centre[j], and the covariance with
    eigenvectors axes[k] (columns) and inverse eigenvalues precision[k]. The charge given z[k:] bounds all below it.
    Returns integers, b (n_candidates, p), objectives, nodes, and whether the tree was closed.
    """
    n, m = G.shape
    best, norms = np.empty((n_candidates, n + m)), np.empty(n_candidates)
    both, w, step, above = np.empty(n + m), np.zeros(n), np.empty(n), np.zeros(n)
    b, c, x = np.empty((n + 1, m)), np.empty(m), np.empty(m)
    b[n] = b_float
    softness = np.empty(n)
    for k in range(n):
        softness[k] = variance + 1.0 / precision[k].min()
    found, nodes, radius = 0, 0, np.inf
    k = n - 1
    enter = True
    while k < n:
        if enter:
            centre = z_float[k]
            for j in range(k + 1, n):
                centre += U[k, j] * w[j]
            both[k] = np.rint(centre)
            w[k] = both[k] - centre
            step[k] = -1.0 if w[k] > 0.0 else 1.0
        else:
            both[k] += step[k]
            w[k] += step[k]
            step[k] = -step[k] - (1.0 if step[k] > 0.0 else -1.0)
        enter = False
        if nodes >= max_nodes and found == n_candidates:
            return best[:, :n], best[:, n:], norms, nodes, False
        nodes += 1
        norm = above[k] + w[k] * w[k] / D[k]
        if not norm < radius:
            k += 1
            continue
        size = 0.0
        for i in range(m):
            b[k, i] = b[k + 1, i] + G[k, i] * w[k]
            size += b[k, i] * b[k, i]
        gap = math.sqrt(size) - length
        if not norm + gap * gap / softness[k] < radius:
            continue
        for i in range(m):
            c[i] = 0.0
            for j in range(m):
                c[i] += axes[k, j, i] * b[k, j]
        charge = onto_length(precision[k], c, length, variance, x)
        if not norm + charge < radius:
            continue
        if k > 0:
            k -= 1
            above[k] = norm
            enter = True
            continue
        for j in range(m):
            both[n + j] = 0.0
            for i in range(m):
                both[n + j] += axes[0, j, i] * x[i]
        found = _keep(best, norms, found, both, norm + charge)
        if found == n_candidates:
            radius = norms[n_candidates - 1]
    return best[:, :n], best[:, n:], norms, nodes, True
