"""Kalman time and measurement updates.

    predict      P <- Phi P Phi' + Q
    update       S = H P H' + R,  K = P H' inv(S),  x <- x + K nu,  P <- (I - K H) P (I - K H)' + K R K'   (Joseph)
    sequential   the same, rows whitened by the Cholesky factor of R and taken one at a time

The form of Joseph keeps P symmetric and positive semi-definite for any gain, also one that an adaptive or robust factor
changed. Rows with infinite variance do not occur here: leave them out.

Source: Bierman (1977) for scalar processing; Bar-Shalom et al. (2001), sec. 5.2.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from factorgraph.types import Array


@njit(cache=True)
def predict(P: Array, Phi: Array, Q: Array) -> Array:
    """Covariance (n, n) after a time step, symmetric to the last digit."""
    out = Phi @ P @ Phi.T + Q
    return 0.5 * (out + out.T)


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
    """inv(L) nu and inv(L) H with R = L L': rows of unit, independent noise."""
    m, n = H.shape
    L = np.linalg.cholesky(R)
    y, W = nu.copy(), H.copy()
    for i in range(m):
        for j in range(i):
            c = L[i, j]
            if c != 0.0:
                y[i] -= c * y[j]
                for k in range(n):
                    W[i, k] -= c * W[j, k]
        d = 1.0 / L[i, i]
        y[i] *= d
        for k in range(n):
            W[i, k] *= d
    return y, W


@njit(cache=True)
def scalar_updates(P: Array, y: Array, W: Array) -> tuple[Array, float]:
    """Process whitened rows one at a time; P (n, n) becomes the posterior in place.

    Returns the correction (n,) and the normalised innovation squared.
    """
    n = P.shape[0]
    dx, ph, K, aph = np.zeros(n), np.empty(n), np.empty(n), np.empty(n)
    nis = 0.0
    for i in range(len(y)):
        h = W[i]
        s, nu = 1.0, y[i]
        for j in range(n):
            total = 0.0
            for k in range(n):
                total += P[j, k] * h[k]
            ph[j] = total
            s += h[j] * total
            nu -= h[j] * dx[j]
        nis += nu * nu / s
        for j in range(n):
            K[j] = ph[j] / s
            dx[j] += K[j] * nu
        for j in range(n):  # A P with A = I - K h'
            for k in range(n):
                P[j, k] -= K[j] * ph[k]
        for j in range(n):
            total = 0.0
            for k in range(n):
                total += P[j, k] * h[k]
            aph[j] = total
        for j in range(n):  # (A P) A' + K K', filled symmetrically
            for k in range(j + 1):
                P[j, k] += K[k] * (K[j] - aph[j])
                P[k, j] = P[j, k]
    return dx, nis


@njit(cache=True)
def update_sequential(P: Array, nu: Array, H: Array, R: Array) -> tuple[Array, Array, float]:
    """As `update`, one whitened row after the other; the prior is not changed."""
    y, W = whiten(nu, H, R)
    out = P.copy()
    dx, nis = scalar_updates(out, y, W)
    return dx, out, nis
