"""Sparse linear least squares along time: a chain of dense fronts, its factor, steps and covariances.

    d = argmin |J d + e|^2 + sum_c damping_c d_c^2

Every variable lives on a grid of stages and is eliminated at its last one; a factor (a few rows over a few variables) enters
at the stage at which the first of its variables is eliminated, and until then all its variables are alive. Front k holds the
variables eliminated at stage k (E) and those that live on (S, the separator, all of them part of front k + 1):

    [R_EE R_ES z_E]  with  R^T R = the front's rows of [J e]^T [J e], damping included,
    front k + 1 receives  A_SS - R_ES^T R_ES  and the same of the right-hand side,

so that backwards R_EE d_E = -z_E - R_ES d_S. Cost and memory are linear in the number of stages: that of the fronts.

Pivots are judged relative to the squared norm of their whole column of J (with its damping), which is the pivot of the matrix
with unit diagonal: 1 for a direction of its own, 0 for one that all variables eliminated before can make up for. Cholesky's
rounding errors do not depend on the scaling of columns, so that none is applied: metres and cycles may share a matrix. They do
grow with the square of J's condition: what is known 3e5 times worse than what it is combined with keeps four digits of its
standard deviation. The next iteration, from residuals evaluated anew, repairs the step.

Covariances: of a few variables anywhere, Y^T Y with R^T Y = E along the path from their elimination to the end; of all that
share a front, by one sweep backwards,

    Sigma_ES = -G Sigma_SS,  Sigma_EE = R_EE^-1 R_EE^-T - Sigma_ES G^T,  G = R_EE^-1 R_ES.

Source: Duff and Reid (1983), multifrontal elimination; Higham (2002), Accuracy and stability of numerical algorithms, ch. 10;
Takahashi et al. (1973) for the sweep backwards.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numba import njit

from factorgraph.errors import InputError
from factorgraph.types import Array, IntArray

SMALLEST_PIVOT = 1e-12  # relative; rounding was seen to leave 1.3e-13 of an undetermined direction after 1500 stages
PANEL = 10  # rows that are factored one by one before the next ones are updated by a matrix product
CHUNK = 1 << 17  # entries of [J e] that are gathered at once: what stays in the cache
NEVER = np.iinfo(np.int64).max


@dataclass(frozen=True, slots=True)
class Variables:
    """What is estimated: one entry per variable."""

    key: IntArray  # (v,) any distinct numbers
    dim: IntArray  # (v,)
    last: IntArray  # (v,) stage of elimination; -1: the latest at which a factor joins it to variables that have one


@dataclass(frozen=True, slots=True)
class Scalars:
    """Scalar variables of factors that differ in number; factor f has keys[first_key[f] : first_key[f + 1]].

    Its columns are the Fortran-ordered piece first[f] : first[f + 1] of an array handed over with the rows.
    """

    keys: IntArray
    first_key: IntArray  # (f + 1,)
    first: IntArray  # (f + 1,)


@dataclass(frozen=True, slots=True)
class FactorBlock:
    """Factors of the same shape: factor f has rows start[f] : start[f + 1] over variables keys[f] of the given widths."""

    widths: tuple[int, ...]
    keys: IntArray  # (f, len(widths))
    start: IntArray  # (f + 1,)
    scalars: Scalars | None = None


@dataclass(frozen=True, slots=True)
class Part:
    """Numbers of a block: residuals e (n,), Jacobian Jw (n, sum of widths), both whitened, and the columns of its scalars."""

    e: Array
    Jw: Array
    dense: Array = field(default_factory=lambda: np.zeros(0))


@dataclass(frozen=True, slots=True)
class Undetermined:
    """A direction the rows do not determine: along it the variables eliminated before make up for a change of `key`."""

    key: int
    component: int  # of that variable
    stage: int
    pivot: float  # relative; NaN where rows were not finite
    direction: Array  # (N,) by Layout.offset: `component` changes by one


@dataclass(frozen=True, slots=True)
class Marginal:
    """What the factors before a stage say about the variables alive there: x^T information x + 2 vector^T x + constant."""

    keys: IntArray
    dims: IntArray
    information: Array  # (d, d)
    vector: Array  # (d,)

    def rows(self, smallest: float = SMALLEST_PIVOT) -> tuple[Array, Array]:
        """The same as whitened rows: e (m,) and J (m, d) with J^T J = information, J^T e = vector; m <= d.

        Directions with less than `smallest` of the information that a unit diagonal would give are left out as unknown.
        """
        s = np.sqrt(np.diag(self.information))
        s[s == 0] = 1.0
        value, U = np.linalg.eigh(self.information / np.outer(s, s))
        known = value > smallest
        root, U = np.sqrt(value[known]), U[:, known]
        return U.T @ (self.vector / s) / root, root[:, None] * U.T * s


@njit(cache=True)
def _derive_last(inc_first, inc_var, last, known):  # type: ignore[no-untyped-def]
    """Latest stage at which factors join variables of unknown stage to known ones; number of those found."""
    found = np.full(len(last), -1, np.int64)
    for f in range(len(inc_first) - 1):
        stage = NEVER
        for i in range(inc_first[f], inc_first[f + 1]):
            if known[inc_var[i]]:
                stage = min(stage, last[inc_var[i]])
        if stage < NEVER:
            for i in range(inc_first[f], inc_first[f + 1]):
                if not known[inc_var[i]]:
                    found[inc_var[i]] = max(found[inc_var[i]], stage)
    n = 0
    for v in range(len(last)):
        if found[v] >= 0:
            last[v], known[v] = found[v], True
            n += 1
    return n


@njit(cache=True)
def _enter(inc_first, inc_var, last):  # type: ignore[no-untyped-def]
    """Stages at which factors are assembled, and at which variables are first needed."""
    front = np.zeros(len(inc_first) - 1, np.int64)
    begin = last.copy()
    for f in range(len(front)):
        stage = NEVER
        for i in range(inc_first[f], inc_first[f + 1]):
            stage = min(stage, last[inc_var[i]])
        front[f] = stage if stage < NEVER else 0
        for i in range(inc_first[f], inc_first[f + 1]):
            begin[inc_var[i]] = min(begin[inc_var[i]], stage)
    return front, begin


@njit(cache=True)
def _place(  # type: ignore[no-untyped-def]
    column,
    column_of_front,
    joiner,
    joiner_first,
    factor_first,
    inc_first,
    inc_var,
    inc_src,
    sep_first,
    cols_first,
    sep,
    carry,
    src,
    dst,
):
    """Separators' columns, their places in the next front, and for every factor its columns in the order of its front.

    Variables are numbered by elimination. Returns a factor that has a variable twice, or -1.
    """
    alive = np.empty(len(column) - 1, np.int64)
    merged = np.empty(len(column) - 1, np.int64)
    n_alive = 0
    where = np.empty(column[-1], np.int64)
    for k in range(len(column_of_front) - 1):
        a, n, j, end = 0, 0, joiner_first[k], joiner_first[k + 1]
        while a < n_alive and column[alive[a]] < column_of_front[k]:
            a += 1
        while a < n_alive or j < end:
            if j == end or (a < n_alive and alive[a] < joiner[j]):
                merged[n] = alive[a]
                a += 1
            else:
                merged[n] = joiner[j]
                j += 1
            n += 1
        alive, merged, n_alive = merged, alive, n
        at, to = 0, sep_first[k]
        for i in range(n_alive):
            v = alive[i]
            for c in range(column[v], column[v + 1]):
                where[c] = at
                at += 1
                if c >= column_of_front[k + 1]:
                    sep[to] = c
                    to += 1
        if k > 0:
            for i in range(sep_first[k - 1], sep_first[k]):
                carry[i] = where[sep[i]]
        for f in range(factor_first[k], factor_first[k + 1]):
            for i in range(inc_first[f] + 1, inc_first[f + 1]):  # insertion: nearly sorted as a rule
                v, s, h = inc_var[i], inc_src[i], i
                while h > inc_first[f] and inc_var[h - 1] > v:
                    inc_var[h], inc_src[h] = inc_var[h - 1], inc_src[h - 1]
                    h -= 1
                inc_var[h], inc_src[h] = v, s
            to = cols_first[f]
            for i in range(inc_first[f], inc_first[f + 1]):
                v = inc_var[i]
                if i > inc_first[f] and inc_var[i - 1] == v:
                    return f
                for c in range(column[v + 1] - column[v]):
                    src[to], dst[to] = inc_src[i] + c, where[column[v]] + c
                    to += 1
    return -1


@njit(cache=True)
def _gather(factors, rows, row, within, cols_first, src, piece, e, Jw, dense, dense_first, out):  # type: ignore[no-untyped-def]
    """Rows [J e] of one block's factors, columns in the order of the front."""
    own = Jw.shape[1]
    for f in factors:
        m, c0, w, o = rows[f], cols_first[f], cols_first[f + 1] - cols_first[f], piece[f]
        for r in range(m):
            i = row[f] + r
            for c in range(w):
                s = src[c0 + c]
                out[o] = Jw[i, s] if s < own else dense[dense_first[within[f]] + (s - own) * m + r]
                o += 1
            out[o] = e[i]
            o += 1


@njit(cache=True)
def _subtract(row, factor, other):  # type: ignore[no-untyped-def]
    """row -= factor other. Loops from zero over slices are compiled to vector instructions, others are not."""
    for c in range(len(row)):
        row[c] -= factor * other[c]


@njit(cache=True)
def _scale(row, factor):  # type: ignore[no-untyped-def]
    for c in range(len(row)):
        row[c] *= factor


@njit(cache=True)
def _product(A, B, out):  # type: ignore[no-untyped-def]
    """out = A^T B; by itself, since each place that calls BLAS takes seconds to compile."""
    np.dot(A.T, B, out)


@njit(cache=True)
def _factor_rows(flat, e, w, norm2, smallest, work, weakest):  # type: ignore[no-untyped-def]
    """Replace the first e rows of a front, width w, by those of R; number of rows done, e where all have a pivot.

    weakest: (2,) smallest relative pivot so far and its row, here relative to the front.
    """
    P = flat[: e * w].reshape(e, w)
    for j0 in range(0, e, PANEL):
        nb = min(PANEL, e - j0)
        if j0:
            L = work[: j0 * nb].reshape(j0, nb)
            for i in range(j0):
                for j in range(nb):
                    L[i, j] = P[i, j0 + j]
            T = work[j0 * nb : (j0 + w) * nb].reshape(nb, w)
            _product(L, flat[: j0 * w].reshape(j0, w), T)
            for j in range(nb):
                _subtract(P[j0 + j, j0:], 1.0, T[j, j0:])
        for j in range(j0, j0 + nb):
            relative = P[j, j] / norm2[j] if norm2[j] != 0 else 0.0
            if relative < weakest[0]:
                weakest[0], weakest[1] = relative, j
            if not relative > smallest:
                weakest[0], weakest[1] = relative, j
                return j
            _scale(P[j, j:], 1 / np.sqrt(P[j, j]))
            for i in range(j + 1, j0 + nb):
                _subtract(P[i, i:], P[j, i], P[j, i:])
    return e


@njit(cache=True)
def _eliminate(  # type: ignore[no-untyped-def]
    k0, k1, pieces, factor_first, rows, cols_first, dst, piece, column_of_front, sep_first, sep, carry,
    damping, smallest, fronts, square, work, norm2, out, out_first, weakest,
):  # fmt: skip
    """Eliminate stages k0 to k1 - 1. fronts[k % 2] holds front k, with what came from before; stage reached, k1 if all."""
    stages = len(column_of_front) - 1
    for k in range(k0, k1):
        base = column_of_front[k]
        e, ns = column_of_front[k + 1] - base, sep_first[k + 1] - sep_first[k]
        n, w = e + ns, e + ns + 1
        A = fronts[k % 2, : n * w].reshape(n, w)
        for f in range(factor_first[k], factor_first[k + 1]):
            m, c = rows[f], cols_first[f + 1] - cols_first[f]
            B = pieces[piece[f] : piece[f] + m * (c + 1)].reshape(m, c + 1)
            H = square[: (c + 1) * (c + 1)].reshape(c + 1, c + 1)
            _product(B, B, H)
            at = dst[cols_first[f] : cols_first[f + 1]]
            for i in range(c):
                p = at[i]
                row, new, to = A[p], H[i, i:], at[i:]
                for j in range(len(to)):
                    row[to[j]] += new[j]
                row[n] += H[i, c]
                norm2[base + p if p < e else sep[sep_first[k] + p - e]] += H[i, i]
        for i in range(e):
            A[i, i] += damping[base + i]
            norm2[base + i] += damping[base + i]
        P = out[out_first[k] : out_first[k + 1]]
        P[:] = fronts[k % 2, : e * w]
        before = weakest[0]
        done = _factor_rows(P, e, w, norm2[base : base + e], smallest, work, weakest)
        if weakest[0] < before or done < e:
            weakest[1] += base
        if done < e:
            return k
        if k + 1 == stages:
            break
        n2 = column_of_front[k + 2] - column_of_front[k + 1] + sep_first[k + 2] - sep_first[k + 1]
        A2 = fronts[(k + 1) % 2, : n2 * (n2 + 1)].reshape(n2, n2 + 1)
        A2[:] = 0.0
        if ns:
            S = work[: e * (ns + 1)].reshape(e, ns + 1)
            R = P.reshape(e, w)
            for i in range(e):
                for j in range(ns + 1):
                    S[i, j] = R[i, e + j]
            H = square[: (ns + 1) * (ns + 1)].reshape(ns + 1, ns + 1)
            _product(S, S, H)
            to = carry[sep_first[k] : sep_first[k + 1]]
            for i in range(ns):
                row, left, gone, more = A2[to[i]], A[e + i, e + i :], H[i, i:], to[i:]
                for j in range(len(more)):
                    row[more[j]] = left[j] - gone[j]
                row[n2] = A[e + i, n] - H[i, ns]
    return k1


@njit(cache=True)
def _back(k_last, rows_last, share, column_of_front, sep_first, sep, out, out_first, x):  # type: ignore[no-untyped-def]
    """Solve R x = -share z backwards from the first rows of a front, x being set beyond them."""
    for k in range(k_last, -1, -1):
        base = column_of_front[k]
        e, s0 = column_of_front[k + 1] - base, sep_first[k]
        ns = sep_first[k + 1] - s0
        P = out[out_first[k] : out_first[k + 1]].reshape(e, e + ns + 1)
        for i in range((rows_last if k == k_last else e) - 1, -1, -1):
            total = share * P[i, e + ns]
            for j in range(i + 1, e):
                total += P[i, j] * x[base + j]
            for j in range(ns):
                total += P[i, e + j] * x[sep[s0 + j]]
            x[base + i] = -total / P[i, i]


@njit(cache=True)
def _path(columns, k0, largest, column_of_front, sep_first, carry, out, out_first):  # type: ignore[no-untyped-def]
    """Y^T Y for R^T Y = E, E the unit columns of the given columns in the order of elimination, from front k0 on."""
    m = len(columns)
    P = np.zeros((m, m))
    pending, other, product = np.empty(largest * m), np.zeros(largest * m), np.empty((largest + 1) * m)
    active = 0
    stages = len(column_of_front) - 1
    for k in range(k0, stages):
        base = column_of_front[k]
        e, ns = column_of_front[k + 1] - base, sep_first[k + 1] - sep_first[k]
        n, had = e + ns, active
        while active < m and columns[active] < column_of_front[k + 1]:
            active += 1
        Y = pending[: n * active].reshape(n, active)
        Y[:] = 0.0
        if k > k0:
            before = sep_first[k] - sep_first[k - 1]
            left = other[: before * had].reshape(before, had)
            for i in range(before):
                p = carry[sep_first[k - 1] + i]
                for c in range(had):
                    Y[p, c] = left[i, c]
        for c in range(had, active):
            Y[columns[c] - base, c] = 1.0
        R = out[out_first[k] : out_first[k + 1]].reshape(e, n + 1)
        for i in range(e):
            _scale(Y[i], 1 / R[i, i])
            for j in range(i + 1, e):
                _subtract(Y[j], R[i, j], Y[i])
        top = pending[: e * active].reshape(e, active)
        P[:active, :active] += np.dot(top.T, top)
        T = product[: (n + 1) * active].reshape(n + 1, active)
        _product(R, top, T)
        left = other[: ns * active].reshape(ns, active)
        for i in range(ns):
            left[i] = Y[e + i]
            _subtract(left[i], 1.0, T[e + i])
    return P


@njit(cache=True)
def _sweep(largest, column_of_front, sep_first, carry, out, out_first, sigma):  # type: ignore[no-untyped-def]
    """Put [Sigma_EE Sigma_ES] of every front, from the last to the first, in the place of its [R_EE R_ES z_E]."""
    full = np.zeros((2, largest * largest))
    flat = np.zeros((6, largest * largest))
    stages = len(column_of_front) - 1
    n_next = 0
    for k in range(stages - 1, -1, -1):
        e, ns = column_of_front[k + 1] - column_of_front[k], sep_first[k + 1] - sep_first[k]
        n = e + ns
        R = out[out_first[k] : out_first[k + 1]].reshape(e, n + 1)
        to = carry[sep_first[k] : sep_first[k + 1]]
        later = full[(k + 1) % 2, : n_next * n_next].reshape(n_next, n_next)
        SS = flat[0, : ns * ns].reshape(ns, ns)
        for i in range(ns):
            for j in range(ns):
                SS[i, j] = later[to[i], to[j]]
        X = flat[1, : e * n].reshape(e, n)  # R_EE^-1 [I R_ES]
        for i in range(e - 1, -1, -1):
            for c in range(n):
                X[i, c] = R[i, c] if c >= e else 0.0
            X[i, i] = 1.0
            for j in range(i + 1, e):
                _subtract(X[i, j:], R[i, j], X[j, j:])
            _scale(X[i, i:], 1 / R[i, i])
        inverse, gain = flat[2, : e * e].reshape(e, e), flat[3, : e * ns].reshape(e, ns)
        inverse[:], gain[:] = X[:, :e], X[:, e:]
        EE, ES, change = flat[4, : e * e].reshape(e, e), flat[5, : e * ns].reshape(e, ns), flat[1, : e * e].reshape(e, e)
        np.dot(inverse, inverse.T, EE)
        if ns:
            np.dot(gain, SS, ES)
            np.dot(ES, gain.T, change)
            EE += change
        here = full[k % 2, : n * n].reshape(n, n)
        for i in range(e):
            for j in range(i, e):
                here[i, j] = here[j, i] = 0.5 * (EE[i, j] + EE[j, i])
            for j in range(ns):
                here[i, e + j] = here[e + j, i] = -ES[i, j]
        here[e:, e:] = SS
        sigma[out_first[k] : out_first[k + 1]].reshape(e, n + 1)[:, :n] = here[:e]
        n_next = n


@njit(cache=True)
def _joints(groups, column, front_of, column_of_front, sep_first, sep, sigma, out_first, target):  # type: ignore[no-untyped-def]
    """Covariances of groups of variables, numbered by elimination; pairs that share no front keep what they have."""
    for g in range(len(groups)):
        i = 0
        for p in range(groups.shape[1]):
            j = 0
            for q in range(groups.shape[1]):
                a, b = groups[g, p], groups[g, q]
                if a <= b:
                    k = front_of[a]
                    base, s0, s1 = column_of_front[k], sep_first[k], sep_first[k + 1]
                    e = column_of_front[k + 1] - base
                    block = sigma[out_first[k] : out_first[k + 1]].reshape(e, e + s1 - s0 + 1)
                    at = column[b] - base
                    if at >= e:
                        s = s0 + np.searchsorted(sep[s0:s1], column[b])
                        at = e + s - s0 if s < s1 and sep[s] == column[b] else -1
                    if at >= 0:
                        for x in range(column[a + 1] - column[a]):
                            for y in range(column[b + 1] - column[b]):
                                value = block[column[a] - base + x, at + y]
                                target[g, i + x, j + y] = target[g, j + y, i + x] = value
                j += column[groups[g, q] + 1] - column[groups[g, q]]
            i += column[groups[g, p] + 1] - column[groups[g, p]]


def _starts(counts: IntArray) -> IntArray:
    return np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)


@dataclass(frozen=True, slots=True)
class _Incidence:
    """Which variables factors have: those of factor f are var[first[f] : first[f + 1]]; src: first column in its block."""

    first: IntArray
    var: IntArray
    src: IntArray
    rows: IntArray  # (f,)
    row: IntArray  # (f,) first row in its block
    block: IntArray  # (f,)
    within: IntArray  # (f,) number in its block

    def take(self, order: IntArray) -> _Incidence:
        counts = np.diff(self.first)[order]
        first = _starts(counts)
        at = np.repeat(self.first[order] - first[:-1], counts) + np.arange(first[-1])
        return _Incidence(
            first, self.var[at], self.src[at], self.rows[order], self.row[order], self.block[order], self.within[order]
        )


class Layout:
    """Where everything goes, for one structure of the problem; the numbers come with every `factorise`.

    variables : each in any order; within a stage they are eliminated in the order given
    blocks : the factors

    key, dim, offset : variable i has components offset[i] : offset[i + 1] of steps
    begin, last : (v,) stages it lives at, both included

    Raises InputError for a key that is given twice, unknown, of another width, or twice in a factor.
    """

    def __init__(self, variables: Variables, blocks: Sequence[FactorBlock]) -> None:
        self.dim = np.asarray(variables.dim, np.int64)
        self.offset = _starts(self.dim)
        self.blocks = tuple(blocks)
        self._name(np.asarray(variables.key, np.int64))
        if np.any(self._sorted[1:] == self._sorted[:-1]):
            raise InputError(f"variable {self._sorted[1:][self._sorted[1:] == self._sorted[:-1]][0]} is given twice")
        every = self._incidence()
        self.last = np.array(variables.last, np.int64)
        known = self.last >= 0
        while not np.all(known) and _derive_last(every.first, every.var, self.last, known):
            pass
        self.last[~known] = self.last.max(initial=0)
        front, self.begin = _enter(every.first, every.var, self.last)
        self.stages = int(self.last.max(initial=-1)) + 1
        self._order = np.argsort(self.last, kind="stable")  # of elimination
        self._rank = np.empty_like(self._order)
        self._rank[self._order] = np.arange(len(self._order))
        self._column = _starts(self.dim[self._order])
        self._to_user = np.repeat(self.offset[:-1][self._order] - self._column[:-1], self.dim[self._order])
        self._to_user = self._to_user + np.arange(self._column[-1])
        self._arrange(every.take(np.argsort(front, kind="stable")), np.sort(front))

    def _name(self, key: IntArray) -> None:
        self.key, self._by_key = key, np.argsort(key, kind="stable")
        self._sorted = key[self._by_key]

    def renamed(self, key: IntArray) -> Layout:
        """The same structure of other variables: key (v,) in the order in which they were given. `blocks` keep the old names."""
        other = copy.copy(self)
        other._name(key)
        return other

    def _incidence(self) -> _Incidence:
        none = np.zeros(0, np.int64)
        counts, var, src, rows, row, block, within = ([none] for _ in range(7))
        for b, each in enumerate(self.blocks):
            n, k = len(each.start) - 1, len(each.widths)
            own = self.index(np.reshape(each.keys, -1)).reshape(n, k)
            wrong = self.dim[own] != np.array(each.widths, np.int64)
            if np.any(wrong):
                raise InputError(f"variable {self.key[own[wrong]][0]} does not have the width that block {b} gives it")
            scalar, more = none, np.zeros(n, np.int64)
            if each.scalars is not None:
                scalar, more = self.index(each.scalars.keys), np.diff(each.scalars.first_key)
                if np.any(self.dim[scalar] != 1):
                    raise InputError(f"variable {self.key[scalar[self.dim[scalar] != 1]][0]} of block {b} is not a scalar")
            first = _starts(k + more)
            v, s = np.empty(first[-1], np.int64), np.empty(first[-1], np.int64)
            at = first[:-1, None] + np.arange(k)
            v[at], s[at] = own, _starts(np.array(each.widths, np.int64))[:-1]
            local = np.arange(len(scalar)) - np.repeat(_starts(more)[:-1], more)
            at = np.repeat(first[:-1] + k, more) + local
            v[at], s[at] = scalar, sum(each.widths) + local
            parts = (k + more, v, s, np.diff(each.start), each.start[:-1], np.full(n, b), np.arange(n))
            for known, part in zip((counts, var, src, rows, row, block, within), parts, strict=True):
                known.append(part)
        joined = [np.concatenate(each).astype(np.int64) for each in (var, src, rows, row, block, within)]
        return _Incidence(_starts(np.concatenate(counts)), *joined)

    def _arrange(self, factors: _Incidence, front: IntArray) -> None:
        """Fronts, and the places of the factors' columns in them."""
        stages = np.arange(self.stages + 1)
        self._factors, self._factor_first = factors, np.searchsorted(front, stages).astype(np.int64)
        last, begin = self.last[self._order], self.begin[self._order]
        self._front_of = last
        self._column_of_front = self._column[np.searchsorted(last, stages)]
        dim = self.dim[self._order]
        alive = np.zeros(self.stages + 1, np.int64)
        np.add.at(alive, begin, dim)
        np.add.at(alive, last, -dim)
        width = np.cumsum(alive)[: self.stages]
        self._sep_first = _starts(width)
        joiner = np.argsort(begin, kind="stable")
        widths = self.dim[factors.var]
        total = np.concatenate([[0], np.cumsum(widths)])
        self._cols_first = total[factors.first].astype(np.int64)
        self._sep, self._carry = (np.zeros(self._sep_first[-1], np.int64) for _ in range(2))
        self._src, self._dst = (np.zeros(self._cols_first[-1], np.int64) for _ in range(2))
        twice = _place(
            self._column,
            self._column_of_front,
            joiner,
            np.searchsorted(begin[joiner], stages).astype(np.int64),
            self._factor_first,
            factors.first,
            self._rank[factors.var],
            factors.src.copy(),
            self._sep_first,
            self._cols_first,
            self._sep,
            self._carry,
            self._src,
            self._dst,
        )
        if twice >= 0:
            raise InputError(f"factor {factors.within[twice]} of block {factors.block[twice]} has a variable twice")
        eliminated = np.diff(self._column_of_front)
        self._out_first = _starts(eliminated * (eliminated + width + 1))
        self._largest = int((eliminated + width).max(initial=0))
        self._chunk()

    def _chunk(self) -> None:
        """Runs of stages whose rows are gathered together."""
        size = self._factors.rows * (np.diff(self._cols_first) + 1)
        before = _starts(size)
        by_front = before[self._factor_first]
        edges = [0]
        while edges[-1] < self.stages:
            reach = int(np.searchsorted(by_front, by_front[edges[-1]] + CHUNK, side="right")) - 1
            edges.append(min(max(reach, edges[-1] + 1), self.stages))
        self._edges = edges
        bounds = self._factor_first[edges]
        start = before[bounds]
        self._piece = before[:-1] - np.repeat(start[:-1], np.diff(bounds))
        self._pieces = int(np.diff(start).max(initial=0))
        self._of_block = [np.flatnonzero(self._factors.block == b) for b in range(len(self.blocks))]
        self._bounds = [np.searchsorted(mine, bounds) for mine in self._of_block]

    @property
    def size(self) -> int:
        """Number N of unknowns."""
        return int(self.offset[-1])

    @property
    def front_sizes(self) -> IntArray:
        """Columns (stages,) of the fronts."""
        return np.diff(self._column_of_front) + np.diff(self._sep_first)

    def index(self, keys: IntArray | Sequence[int]) -> IntArray:
        """Places of variables in `key`. Raises InputError for one that is unknown."""
        keys = np.asarray(keys, np.int64)
        if not len(self.key):
            at = np.zeros(0, np.int64)
            unknown = keys
        else:
            at = self._by_key[np.minimum(np.searchsorted(self._sorted, keys), len(self.key) - 1)]
            unknown = keys[self.key[at] != keys]
        if unknown.size:
            raise InputError(f"no variable {unknown.flat[0]}")
        return at

    def factorise(
        self, parts: Sequence[Part], damping: float | Array = 0.0, smallest: float = SMALLEST_PIVOT
    ) -> Factorised | Undetermined:
        """Factor of the normal equations of the blocks' rows.

        parts: one per block; damping: what is added to the diagonal of J^T J, (N,) or for all; smallest: pivots that are not
        above it (relative, see the module) mean that the rows do not determine a direction, which is then told instead.
        Raises InputError for parts whose shapes do not fit the blocks.
        """
        return self._eliminated(parts, damping, smallest, self.stages)[0]

    def marginal(self, parts: Sequence[Part], stage: int, smallest: float = SMALLEST_PIVOT) -> Marginal | Undetermined:
        """What the factors assembled before a stage leave on the variables that live on: a window's arrival cost.

        Costs the elimination of the stages before. Raises InputError where there is no such stage.
        """
        if not 0 < stage < self.stages:
            raise InputError(f"stage must lie in [1, {self.stages - 1}], got {stage}")
        factor, front = self._eliminated(parts, 0.0, smallest, stage)
        if isinstance(factor, Undetermined):
            return factor
        n = int(self.front_sizes[stage])
        A = front[: n * (n + 1)].reshape(n, n + 1)
        at = slice(self._sep_first[stage - 1], self._sep_first[stage])
        of_var = np.searchsorted(self._column, self._sep[at], side="right") - 1
        var, place = self._order[np.unique(of_var)], self._carry[at]
        upper = np.triu(A[np.ix_(place, place)])
        return Marginal(self.key[var], self.dim[var], upper + np.triu(upper, 1).T, A[place, n])

    def _eliminated(
        self, parts: Sequence[Part], damping: float | Array, smallest: float, stop: int
    ) -> tuple[Factorised | Undetermined, Array]:
        """The factor of the stages before `stop`, and the front of that one as it then is."""
        self._check(parts)
        shape = np.broadcast_to(np.asarray(damping, float), (self.size,))
        column_damping = shape[self._to_user]
        n = self._largest
        fronts, square = np.zeros((2, n * (n + 1))), np.empty((n + 1) ** 2)
        work, pieces = np.empty((n + 1) * (n + PANEL)), np.empty(self._pieces)
        norm2, out, weakest = np.zeros(self.size), np.empty(self._out_first[stop]), np.array([np.inf, 0.0])
        f = self._factors
        for chunk, (k0, k1) in enumerate(zip(self._edges[:-1], self._edges[1:], strict=True)):
            if k0 >= stop:
                break
            self._fill(chunk, parts, pieces)
            reached = _eliminate(
                k0, min(k1, stop), pieces, self._factor_first, f.rows, self._cols_first, self._dst, self._piece,
                self._column_of_front, self._sep_first, self._sep, self._carry,
                column_damping, smallest, fronts, square, work, norm2, out, self._out_first, weakest,
            )  # fmt: skip
            if reached < min(k1, stop):
                return self._undetermined(reached, out, weakest), fronts[0]
        return Factorised(self, out, norm2, float(weakest[0]), self._key_of(int(weakest[1]))[0]), fronts[stop % 2]

    def _check(self, parts: Sequence[Part]) -> None:
        if len(parts) != len(self.blocks):
            raise InputError(f"{len(self.blocks)} blocks need as many parts, got {len(parts)}")
        for b, (block, part) in enumerate(zip(self.blocks, parts, strict=True)):
            n = int(block.start[-1])
            wanted = ((n,), (n, sum(block.widths)), (int(block.scalars.first[-1]) if block.scalars is not None else 0,))
            got = (part.e.shape, part.Jw.shape, part.dense.shape)
            if got != wanted:
                raise InputError(f"part {b} must have e, Jw and dense of shapes {wanted}, got {got}")

    def _fill(self, chunk: int, parts: Sequence[Part], pieces: Array) -> None:
        """Gather the rows of a run of stages."""
        f, nowhere = self._factors, np.zeros(0, np.int64)
        for block, part, mine, bounds in zip(self.blocks, parts, self._of_block, self._bounds, strict=True):
            if bounds[chunk] < bounds[chunk + 1]:
                now = mine[bounds[chunk] : bounds[chunk + 1]]
                e, Jw, dense = (np.ascontiguousarray(each, dtype=float) for each in (part.e, part.Jw, part.dense))
                dense_first = nowhere if block.scalars is None else block.scalars.first
                cols_first, src, piece = self._cols_first, self._src, self._piece
                _gather(now, f.rows, f.row, f.within, cols_first, src, piece, e, Jw, dense, dense_first, pieces)

    def _key_of(self, column: int) -> tuple[int, int]:
        rank = int(np.searchsorted(self._column, column, side="right")) - 1
        return int(self.key[self._order[rank]]) if self.size else 0, column - int(self._column[rank])

    def _undetermined(self, stage: int, out: Array, weakest: Array) -> Undetermined:
        column = int(weakest[1])
        x = np.zeros(self.size)
        x[column] = 1.0
        rows = column - int(self._column_of_front[stage])
        _back(stage, rows, 0.0, self._column_of_front, self._sep_first, self._sep, out, self._out_first, x)
        return Undetermined(*self._key_of(column), stage, float(weakest[0]), self._by_user(x))

    def _by_user(self, x: Array) -> Array:
        y = np.empty_like(x)
        y[self._to_user] = x
        return y


@dataclass(frozen=True, slots=True)
class Factorised:
    """The factor R of the normal equations, with R^-T J^T e beside it."""

    layout: Layout
    out: Array  # front after front [R_EE R_ES z_E]
    norm2: Array  # (N,) squared norms of J's columns, damping included, by elimination
    weakest_pivot: float  # relative
    weakest_key: int  # variable it belongs to

    def step(self) -> Array:
        """The minimiser d (N,), variable i at layout.offset[i]."""
        la = self.layout
        x = np.zeros(la.size)
        rows = int(np.diff(la._column_of_front)[-1]) if la.stages else 0
        _back(la.stages - 1, rows, 1.0, la._column_of_front, la._sep_first, la._sep, self.out, la._out_first, x)
        return la._by_user(x)

    def log_det(self) -> float:
        """Logarithm of the determinant of J^T J + damping."""
        return 2 * float(np.sum(np.log(self._rows(diagonal=True))))

    def decrease(self) -> float:
        """By how much the step lowers |J d + e|^2 + damping: |R^-T J^T e|^2."""
        return float(np.sum(self._rows(diagonal=False) ** 2))

    def _rows(self, diagonal: bool) -> Array:
        """R's diagonal or the right-hand side (N,), by elimination."""
        la = self.layout
        e = np.diff(la._column_of_front)
        width = la.front_sizes + 1
        row = np.arange(la.size) - np.repeat(la._column_of_front[:-1], e)
        start = np.repeat(la._out_first[:-1], e) + row * np.repeat(width, e)
        return np.asarray(self.out[start + (row if diagonal else np.repeat(width - 1, e))])

    def covariance(self, keys: Sequence[int] | IntArray) -> Array:
        """Joint covariance (d, d) of any variables, in the order given.

        Costs the path from the first of them to the end of the flight, times their number.
        """
        la = self.layout
        var = la._rank[la.index(keys)]
        columns = np.concatenate([np.arange(la._column[v], la._column[v + 1]) for v in var] or [np.zeros(0, np.int64)])
        if not len(columns):
            return np.zeros((0, 0))
        order = np.argsort(columns, kind="stable")
        k0 = int(la._front_of[var.min()])
        of_front, sep_first = la._column_of_front, la._sep_first
        P = _path(columns[order], k0, la._largest, of_front, sep_first, la._carry, self.out, la._out_first)
        result = np.empty(P.shape)
        result[np.ix_(order, order)] = P
        return result

    def selected(self) -> SelectedCovariance:
        """Covariances of all that share a front, at the cost of about one more factorisation."""
        return SelectedCovariance(self)


class SelectedCovariance:
    """Covariance blocks of variables that share a front."""

    def __init__(self, factor: Factorised) -> None:
        self.layout = la = factor.layout
        self._sigma = np.empty_like(factor.out)
        of_front, sep_first = la._column_of_front, la._sep_first
        _sweep(la._largest, of_front, sep_first, la._carry, factor.out, la._out_first, self._sigma)

    def joint(self, keys: Sequence[int]) -> Array:
        """Joint covariance of several keys in the given order; pairs that share no front are NaN."""
        return np.asarray(self.joints([keys])[0])

    def joints(self, groups: Sequence[Sequence[int]] | IntArray) -> Array:
        """Joint covariances (g, d, d) of groups of keys whose dimensions agree from group to group."""
        la = self.layout
        at = la._rank[la.index(np.asarray(groups, np.int64))]
        widths = np.diff(la._column)[at]
        if np.any(widths != widths[:1]):
            raise InputError("groups of keys must agree in their variables' dimensions")
        d = int(widths[0].sum()) if len(at) else 0
        target = np.full((len(at), d, d), np.nan)
        of_front, sep_first = la._column_of_front, la._sep_first
        _joints(at, la._column, la._front_of, of_front, sep_first, la._sep, self._sigma, la._out_first, target)
        return target
