"""Kalman time and measurement updates.

    predict      P <- Phi P Phi' + Q
    update       S = H P H' + R,  K = P H' inv(S),  x <- x + K nu,  P <- (I - K H) P (I - K H)' + K R K'   (Joseph)
    sequential   the same, rows whitened by the Cholesky factor of R and taken one at a time, zeros skipped

The form of Joseph keeps P symmetric and positive semi-definite for any gain, also one that an adaptive or robust factor
changed. Rows with infinite variance do not occur here: leave them out.

Source: Bierman (1977) for scalar processing; Bar-Shalom et al. (2001), sec. 5.2.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from factorgraph.types import Array


@njit(cache=True)
def _product(A: Array, B: Array) -> Array:
    """A (l, m) times B (m, n), quick where A is mostly zero as transitions are."""
    out = np.zeros((A.shape[0], B.shape[1]))
    for i in range(A.shape[0]):
        for k in range(A.shape[1]):
            c = A[i, k]
            if c != 0.0:
                for j in range(B.shape[1]):
                    out[i, j] += c * B[k, j]
    return out


@njit(cache=True)
def predict(P: Array, Phi: Array, Q: Array) -> Array:
    """Covariance (n, n) after a time step, symmetric to the last digit."""
    out = _product(Phi, _product(Phi, P).T.copy())
    for i in range(len(P)):
        for j in range(i + 1):
            out[i, j] = 0.5 * ((out[i, j] + Q[i, j]) + (out[j, i] + Q[j, i]))
            out[j, i] = out[i, j]
    return out


@njit(cache=True)
def innovation_covariance(P: Array, H: Array, R: Array) -> Array:
    """S = H P H' + R, (m, m)."""
    return H @ P @ H.T + R


@njit(cache=True)
def update(P: Array, nu: Array, H: Array, R: Array) -> tuple[Array, Array, float]:
    """All rows at once.

    P (n, n) prior, nu (m,) innovation, H (m, n), R (m, m). Returns the correction K nu (n,), the covariance (n, n) and the
    normalised innovation squared nu' inv(S) nu.
    """
    n = P.shape[0]
    PH = P @ H.T
    S = H @ PH + R
    K = np.linalg.solve(S, PH.T).T
    A = np.eye(n) - K @ H
    out = A @ P @ A.T + K @ R @ K.T
    return K @ nu, 0.5 * (out + out.T), float(nu @ np.linalg.solve(S, nu))


@njit(cache=True)
def whiten(nu: Array, H: Array, R: Array) -> tuple[Array, Array]:
    """inv(L) nu and inv(L) H with R = L L': rows of unit, independent noise.

    Raises LinAlgError where R is not positive definite.
    """
    m, n = H.shape
    U, y, W = R.copy(), nu.copy(), H.copy()  # eliminating with rows of U = L' is the forward substitution, too
    for i in range(m):
        if not U[i, i] > 0.0:
            raise np.linalg.LinAlgError("the covariance of the measurements is not positive definite")
        d = 1.0 / np.sqrt(U[i, i])
        y[i] *= d
        for k in range(n):
            W[i, k] *= d
        for k in range(i, m):
            U[i, k] *= d
        for j in range(i + 1, m):
            c = U[i, j]
            if c != 0.0:
                y[j] -= c * y[i]
                for k in range(n):
                    W[j, k] -= c * W[i, k]
                for k in range(j, m):
                    U[j, k] -= c * U[i, k]
    return y, W


@njit(cache=True)
def scalar_updates(P: Array, y: Array, W: Array) -> tuple[Array, float]:
    """Process whitened rows one at a time; P (n, n) becomes the posterior in place.

    Returns the correction (n,) and the normalised innovation squared.
    """
    n = P.shape[0]
    dx, ph, K, d = np.zeros(n), np.empty(n), np.empty(n), np.empty(n)
    seen = np.empty(n, np.int64)  # states that a row observes, mostly few
    nis = 0.0
    for i in range(len(y)):
        h, count = W[i], 0
        s, nu = 1.0, y[i]
        ph[:] = 0.0
        for j in range(n):
            c = h[j]
            if c != 0.0:
                seen[count] = j
                count += 1
                nu -= c * dx[j]
                for k in range(n):
                    ph[k] += P[j, k] * c
        for j in seen[:count]:
            s += h[j] * ph[j]
        nis += nu * nu / s
        for j in range(n):
            K[j] = ph[j] / s
            dx[j] += K[j] * nu
            d[j] = K[j]
        for q in seen[:count]:  # d = K - A P h with A P = P - K ph', rounded as it is below: that is what Joseph's form repairs
            c, g = h[q], ph[q]
            for j in range(n):
                d[j] -= (P[q, j] - K[j] * g) * c
        for j in range(n):  # (A P) A' + K K' = A P + d K', filled symmetrically
            a, b = K[j], d[j]
            for k in range(n):
                P[j, k] = P[j, k] - a * ph[k] + b * K[k]
            for k in range(j):
                P[k, j] = P[j, k]
    return dx, nis


@njit(cache=True)
def update_sequential(P: Array, nu: Array, H: Array, R: Array) -> tuple[Array, Array, float]:
    """As `update`, one whitened row after the other; the prior is not changed."""
    y, W = whiten(nu, H, R)
    out = P.copy()
    dx, nis = scalar_updates(out, y, W)
    return dx, out, nis
