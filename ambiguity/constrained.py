"""Mixed integer least squares: integer ambiguities a beside real parameters b, and what else is known of b.

    y = A a + B b + noise
    objective(a, b) = |a_float - a|^2 in inv(Q_a)  +  |b(a) - b|^2 in inv(Q_b|a)  +  what b is charged
    b(a) = b_float - Q_ba inv(Q_a) (a_float - a),   Q_b|a = Q_b - Q_ba inv(Q_a) Q_ab

Without a charge b = b(a), and the integers are those of `integer_least_squares`. A known position changes the float
solution, linearly and once. A known length |b| = l does not: each integer vector has its own nearest point of the sphere,
found from one secular equation, and an integer vector that is second by itself can be best together with its b. The
search therefore carries b(z[k:]), the mean of b given the integers fixed so far, and drops a branch where the squared
norm plus the least charge of any b of that length, given those integers, already exceeds the best found. That bound is
exact for the relaxed problem with real z[:k], so that the result is exact too; an eigenvalue bound spares most of the
secular equations.

Source: Teunissen (1995) for the decomposition; Teunissen (2010) for the constrained problem, its bounds and the compass;
Golub and von Matt (1991) for the secular equation of least squares on a sphere.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ambiguity import _kernels as kernels
from ambiguity._input import at_least_one, pair, raise_fault, require_sound
from ambiguity.decorrelation import factorise
from ambiguity.search import MAX_NODES, integer_least_squares
from ambiguity.types import Array, IntArray


@dataclass(frozen=True, slots=True)
class FloatSolution:
    """Least-squares estimates of ambiguities and real parameters with the ambiguities real."""

    a: Array  # (n,) [cyc]
    b: Array  # (p,)
    Q_a: Array  # (n, n) [cyc^2]
    Q_ab: Array  # (n, p)
    Q_b: Array  # (p, p)


@dataclass(frozen=True, slots=True)
class MixedResult:
    """The best integer vectors, each with its real parameters, best first."""

    candidates: IntArray  # (k, n)
    b: Array  # (k, p)
    objectives: Array  # (k,)
    Q_b: Array  # (p, p) of b given the integers, before any charge
    proven: bool  # no better vector exists
    nodes: int  # integers tried


def float_solution(A: ArrayLike, B: ArrayLike, y: ArrayLike, Q_y: ArrayLike) -> FloatSolution:
    """Weighted least squares of y = A a + B b: A (m, n), B (m, p), y (m,), Q_y (m, m).

    Raises ValueError where shapes disagree, an entry is not finite, Q_y is not positive definite or [A, B] lacks rank.
    """
    A, B = np.asarray(A, np.float64), np.asarray(B, np.float64)
    y, Q_y = pair(y, Q_y)
    require_sound(np.zeros(y.size), Q_y)
    if A.ndim != 2 or B.ndim != 2 or len(A) != y.size or len(B) != y.size:
        raise ValueError(f"A and B must have {y.size} rows to match y, got shapes {A.shape} and {B.shape}")
    design = np.hstack([A, B])
    if not (np.isfinite(design).all() and np.isfinite(y).all()):
        raise ValueError("A, B and y must be finite")
    n, columns = A.shape[1], design.shape[1]
    try:
        U, D, order = factorise(Q_y)
    except ValueError:
        raise ValueError("Q_y must be positive definite (an ambiguity or observation given twice?)") from None
    whitened = np.linalg.solve(U, np.column_stack([design, y])[order]) / np.sqrt(D)[:, None]
    scale = np.linalg.norm(whitened[:, :columns], axis=0)
    if columns > y.size or np.any(scale == 0):
        raise ValueError(f"{y.size} observations do not determine {columns} parameters")
    left, R = np.linalg.qr(whitened[:, :columns] / scale)
    if np.any(np.abs(np.diag(R)) <= 10 * columns * np.finfo(np.float64).eps):
        raise ValueError(f"{y.size} observations do not determine {columns} parameters: [A, B] lacks rank")
    root = np.linalg.solve(R, np.eye(columns)) / scale[:, None]
    x, Q = root @ (left.T @ whitened[:, columns]), root @ root.T
    return FloatSolution(x[:n], x[n:], Q[:n, :n], Q[:n, n:], Q[n:, n:])


def position_prior(x: FloatSolution, b_prior: ArrayLike, Q_prior: ArrayLike) -> FloatSolution:
    """The float solution with b observed as b_prior (p,), covariance Q_prior (p, p); zeros hold b there exactly.

    Raises ValueError where shapes disagree, an entry is not finite, or Q_b + Q_prior is not positive definite.
    """
    x = _checked(x)
    b, Q = np.asarray(b_prior, np.float64), np.asarray(Q_prior, np.float64)
    p = x.b.size
    if b.shape != (p,) or Q.shape != (p, p):
        raise ValueError(f"b_prior must have shape ({p},) and Q_prior ({p}, {p}), got {b.shape} and {Q.shape}")
    if not (np.isfinite(b).all() and np.isfinite(Q).all() and np.allclose(Q, Q.T, rtol=kernels.SYMMETRY, atol=0)):
        raise ValueError("b_prior and Q_prior must be finite and Q_prior symmetric")
    S = x.Q_b + Q
    if p and np.linalg.eigvalsh(S)[0] <= 0:
        raise ValueError("Q_b + Q_prior must be positive definite")
    gain = np.linalg.solve(S, np.hstack([x.Q_ab.T, x.Q_b]))  # (p, n + p), transposed
    n = x.a.size
    to_a, to_b = gain[:, :n].T, gain[:, n:].T
    step = b - x.b
    Q_a, Q_b = x.Q_a - to_a @ x.Q_ab.T, to_b @ Q
    return FloatSolution(x.a + to_a @ step, x.b + to_b @ step, 0.5 * (Q_a + Q_a.T), to_a @ Q, 0.5 * (Q_b + Q_b.T))


def mixed_integer_least_squares(x: FloatSolution, n_candidates: int = 2, max_nodes: int = MAX_NODES) -> MixedResult:
    """The nearest integer vectors and b given each of them.

    Raises ValueError for unusable input, as `integer_least_squares`. Source: Teunissen (1995).
    """
    x = _checked(x)
    found = integer_least_squares(x.a, x.Q_a, n_candidates, max_nodes)
    gain = np.linalg.solve(x.Q_a, x.Q_ab) if x.a.size else x.Q_ab
    b = x.b + (found.candidates - x.a) @ gain
    return MixedResult(found.candidates, b, found.norms, x.Q_b - x.Q_ab.T @ gain, found.proven, found.nodes)


def length_constrained(
    x: FloatSolution, length: float, sigma: float = 0.0, n_candidates: int = 2, max_nodes: int = MAX_NODES
) -> MixedResult:
    """The integer vectors and vectors b of known length that fit the float solution best, exactly.

    Parameters
    ----------
    x : float solution, b in the unit of the length
    length : of b, positive
    sigma : its standard deviation; 0 demands |b| = length, else (|b| - length)^2 / sigma^2 is added to the objective
    n_candidates : how many to return; for n = 0 the only vector, the empty one, is returned
    max_nodes : integers to try before giving up the proof

    Raises ValueError for unusable input, as `integer_least_squares`, where b given the integers has no positive definite
    covariance, and for a length or sigma outside its range. Source: Teunissen (2010).
    """
    x = _checked(x)
    k, budget = at_least_one("n_candidates", n_candidates), at_least_one("max_nodes", max_nodes)
    if not (0 < length < math.inf and 0 <= sigma < math.inf):
        raise ValueError(f"length must be positive and sigma not negative, both finite, got {length} and {sigma}")
    n, p = x.Q_ab.shape
    if p == 0:
        raise ValueError("b must have at least one entry to have a length")
    offset, remainder = kernels.split(x.a)
    code, row, value, UZ, D, Y, z_float = kernels.reduce(remainder, x.Q_a)
    if code != kernels.OK:
        raise_fault(code, row, row, value, x.Q_a)
    M = np.linalg.solve(UZ[:, :n], UZ[:, n:] @ x.Q_ab)  # covariance of the independent innovations and b
    G = M / D[:, None]
    # Covariance of b given z[k:], k = 0 ... n: built up from the smallest, so that nothing cancels.
    shares = M[:, :, None] * G[:, None, :]
    covariance = np.concatenate([np.zeros((1, p, p)), np.cumsum(shares, axis=0)])
    Q_b = x.Q_b - covariance[-1]
    Q_b = 0.5 * (Q_b + Q_b.T)
    spread, axes = np.linalg.eigh(Q_b + covariance)
    if not spread[0, 0] > 10 * p * np.finfo(np.float64).eps * spread[-1, -1]:
        raise ValueError(
            f"b given the integers must have a positive definite covariance; its smallest eigenvalue is {spread[0, 0]:.3g}"
        )
    if n == 0:
        b = np.empty(p)
        cost = kernels.onto_length(1 / spread[0], axes[0].T @ x.b, float(length), float(sigma) ** 2, b)
        return MixedResult(np.zeros((1, 0), np.int64), (axes[0] @ b)[None], np.array([cost]), Q_b, True, 0)
    best, b_best, objectives, nodes, proven = kernels.search_length(
        np.ascontiguousarray(UZ[:, :n]), D, z_float, x.b, G, axes[:n], 1 / spread[:n], float(length), float(sigma) ** 2, k, budget
    )
    candidates = np.empty((k, n), np.int64)
    for c in range(k):
        kernels.restore(Y, best[c], offset, candidates[c])
    return MixedResult(candidates, b_best.copy(), objectives, Q_b, proven, nodes)


def _checked(x: FloatSolution) -> FloatSolution:
    """A copy with arrays of agreeing shapes. Raises ValueError where they do not or an entry is not usable."""
    a, Q_a = pair(x.a, x.Q_a)
    require_sound(a, Q_a)
    b, Q_b, Q_ab = (np.array(v, dtype=np.float64, order="C") for v in (x.b, x.Q_b, x.Q_ab))
    if b.ndim != 1 or Q_b.shape != (b.size, b.size) or Q_ab.shape != (a.size, b.size):
        raise ValueError(
            f"b must have shape (p,), Q_b (p, p) and Q_ab ({a.size}, p), got {b.shape}, {Q_b.shape} and {Q_ab.shape}"
        )
    if not (np.isfinite(b).all() and np.isfinite(Q_b).all() and np.isfinite(Q_ab).all()):
        raise ValueError("b, Q_b and Q_ab must be finite")
    size = np.sqrt(np.abs(np.diag(Q_b)))
    if np.any(np.abs(Q_b - Q_b.T) > kernels.SYMMETRY * np.outer(size, size)):
        raise ValueError("Q_b must be symmetric")
    return FloatSolution(a, b, Q_a, Q_ab, Q_b)
