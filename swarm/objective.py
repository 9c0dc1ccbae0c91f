"""What a correction minimises, as rows of a few coordinates.

    O1 = sum a_j |z_j - h_j(x)|        weights of the literal rule
    O2 = e' inv(R) e,                  e = z - h(x)
    O3 = O2 + (x - x_prior)' inv(P_prior) (x - x_prior)

x = x_0 + T y moves with the decided states. Normalised coordinates are y = (x - x_post) / sigma, sigma^2 the diagonal of P_post;
whitened ones y = inv(L) (x - x_post), L L' = P_post of the decided states, where O3 is round; "raw" ones are the decided states
themselves. The other states stay as the filter left them, or follow as their conditional mean

    x_other = x_post + C (x_decided - x_post),   C = P_other,decided inv(P_decided,decided) of P_post

which for O3 and linear rows is where O3 is least given the decided states: nothing is lost by deciding some of them only.

All three are made of rows r(y) = c - A y - B |D y + d|, with a column of B for every distance: O1 the sum of their sizes, rows
times a_j; O2 and O3 the sum of their squares, the rows whitened, and those of the prior below. A rotation leaves squares as they
are, so that no more than 1 + len(y) + q rows of [c A B] are kept.

Source: spec ahrs_tdo.md 2.6, errata E19, E22, E23.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numba import njit
from scipy.linalg import solve_triangular

from swarm.compiled import CompiledCost
from swarm.judgement import literal_weights
from swarm.snapshot import IntArray, Snapshot
from swarm.types import Array

Which = Literal["O1", "O2", "O3"]


@dataclass(frozen=True, slots=True)
class Space:
    """Coordinates y (p,) of a search, within bounds: x = x_0 + T y."""

    x_0: Array  # (n,)
    T: Array  # (n, p)
    bounds: Array  # (p, 2)
    start: Array  # (p,) the posterior

    def state(self, y: Array) -> Array:
        """x (n,) of y (p,)."""
        return self.x_0 + self.T @ y


def space(snapshot: Snapshot, decided: IntArray, box_sigmas: float, raw: bool, follow: bool, whitened: bool = False) -> Space:
    """Coordinates of the decided states (p,), in a box of so many standard deviations about the posterior.

    raw, whitened: coordinates that are not the normalised ones. follow: the other states follow. Raises ValueError where a
    decided state has no variance, and LinAlgError where whitened states have no positive definite covariance.
    """
    x, P, p = snapshot.x_post, snapshot.P_post, len(decided)
    variance = np.diag(P)[decided]
    if not np.all(variance > 0):
        i = int(decided[np.flatnonzero(~(variance > 0))[0]])
        raise ValueError(f"a decided state needs a positive variance in P_post, got {P[i, i]:g} of state {i}")
    sigma = np.sqrt(variance)
    T, correlation = np.zeros((snapshot.n, p)), P[np.ix_(decided, decided)] / np.outer(sigma, sigma)
    T[decided, np.arange(p)] = sigma
    if follow:
        others = np.setdiff1d(np.arange(snapshot.n), decided)
        T[others] = np.linalg.solve(correlation, (P[np.ix_(others, decided)] / sigma).T).T
    half = np.full(p, box_sigmas)
    if raw:
        T = T / sigma
        return Space(x - T @ x[decided], T, np.column_stack([x[decided] - half * sigma, x[decided] + half * sigma]), x[decided])
    if whitened:
        T = T @ np.linalg.cholesky(correlation)
    return Space(x, T, np.column_stack([-half, half]), np.zeros(p))


@dataclass(frozen=True, slots=True)
class Objective:
    """A cost of points Y (k, p) made of rows r(y) = c - A y - B |D y + d|."""

    c: Array  # (m,)
    A: Array  # (m, p)
    B: Array  # (m, q)
    D: Array  # (q, 3, p)
    d: Array  # (q, 3)
    absolute: bool  # sum of the rows' sizes, not of their squares

    def __call__(self, Y: Array) -> Array:
        """Costs (k,) of points Y (k, p)."""
        r = self.rows(Y)
        return np.asarray(np.abs(r).sum(axis=1) if self.absolute else np.einsum("km,km->k", r, r))

    def rows(self, Y: Array) -> Array:
        """r (k, m) of points Y (k, p)."""
        r = self.c - Y @ self.A.T
        if len(self.d):
            r -= np.linalg.norm(np.einsum("qip,kp->kqi", self.D, Y) + self.d, axis=2) @ self.B.T
        return np.asarray(r)

    def jacobian(self, y: Array) -> Array:
        """dr/dy (m, p) at y (p,); of a distance that is zero, zero."""
        if not len(self.d):
            return -self.A
        arm = np.einsum("qip,p->qi", self.D, y) + self.d
        unit = arm / np.maximum(np.linalg.norm(arm, axis=1), np.finfo(float).tiny)[:, None]
        return np.asarray(-self.A - self.B @ np.einsum("qi,qip->qp", unit, self.D))

    def compiled(self) -> CompiledCost:
        """The same cost for compiled optimisers."""
        head = np.array([len(self.c), len(self.d)], dtype=np.float64)
        data = np.concatenate([head, self.c, self.A.ravel(), self.B.ravel(), self.D.ravel(), self.d.ravel()])
        return CompiledCost(_sum_of_sizes if self.absolute else _sum_of_squares, data)


def objective(which: Which, snapshot: Snapshot, coordinates: Space) -> Objective:
    """O1, O2 or O3 of a snapshot in these coordinates.

    Raises LinAlgError where R (O2, O3) or P_prior (O3) is not positive definite.
    """
    T, x, q = coordinates.T, coordinates.x_0, len(snapshot.norm_rows)
    H = snapshot.linear
    B = np.zeros((snapshot.m, q))
    B[snapshot.norm_rows, np.arange(q)] = snapshot.norm_scale
    D = np.einsum("qin,np->qip", snapshot.norm_D, T) if q else np.zeros((0, 3, T.shape[1]))
    d = np.einsum("qin,n->qi", snapshot.norm_D, x) + snapshot.norm_d if q else np.zeros((0, 3))
    M = np.column_stack([snapshot.z - H @ x, H @ T, B])
    if which == "O1":
        M = literal_weights(np.sqrt(np.diag(snapshot.R)))[:, None] * M
    else:
        M = solve_triangular(np.linalg.cholesky(snapshot.R), M, lower=True, check_finite=False)
        if which == "O3":
            M = np.vstack([M, _of_prior(snapshot, x, T, q)])
        if len(M) > M.shape[1]:
            M = np.asarray(np.linalg.qr(M, mode="r"))
    p = T.shape[1]
    return Objective(M[:, 0].copy(), M[:, 1 : p + 1].copy(), M[:, p + 1 :].copy(), D, d, which == "O1")


def _of_prior(snapshot: Snapshot, x: Array, T: Array, q: int) -> Array:
    """Rows [c A B] (n, 1 + p + q) of the prior."""
    L = np.linalg.cholesky(snapshot.P_prior)
    c_A = solve_triangular(L, np.column_stack([snapshot.x_prior - x, T]), lower=True, check_finite=False)
    return np.hstack([c_A, np.zeros((snapshot.n, q))])


@njit(cache=True, error_model="numpy")
def _row_values(y: Array, data: Array) -> Array:
    """r (m,) of y (p,); data holds m, q, c, A, B, D and d, one after the other, by rows."""
    p, m, q = y.size, int(data[0]), int(data[1])
    r = data[2 : 2 + m].copy()
    A = 2 + m
    B = A + m * p
    D = B + m * q
    d = D + 3 * q * p
    for i in range(m):
        s = r[i]
        for j in range(p):
            s -= data[A + i * p + j] * y[j]
        r[i] = s
    for k in range(q):
        square = 0.0
        for i in range(3):
            s = data[d + 3 * k + i]
            for j in range(p):
                s += data[D + (3 * k + i) * p + j] * y[j]
            square += s * s
        distance = np.sqrt(square)
        for i in range(m):
            r[i] -= data[B + i * q + k] * distance
    return r


@njit("float64(float64[::1], float64[::1])", cache=True, error_model="numpy")
def _sum_of_squares(y: Array, data: Array) -> float:
    r = _row_values(y, data)
    total = 0.0
    for i in range(r.size):
        total += r[i] * r[i]
    return total


@njit("float64(float64[::1], float64[::1])", cache=True, error_model="numpy")
def _sum_of_sizes(y: Array, data: Array) -> float:
    r = _row_values(y, data)
    total = 0.0
    for i in range(r.size):
        total += abs(r[i])
    return total
