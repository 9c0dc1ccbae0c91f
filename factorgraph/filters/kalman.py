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

from factorgraph.types import Array, IntArray


@njit(cache=True, error_model="numpy")
def predict(P: Array, Phi: Array, Q: Array) -> Array:
    """Covariance (n, n) after a time step, symmetric to the last digit; zeros of Phi, as a rule most of it, are skipped."""
    n = len(P)
    half, out = np.zeros((n, n)), Q.copy()
    for i in range(n):
        for k in range(n):
            c = Phi[i, k]
            if c != 0.0:
                for j in range(n):
                    half[i, j] += c * P[k, j]
    turned = half.T.copy()  # P Phi': rows are read one after the other below
    for i in range(n):
        for k in range(n):
            c = Phi[i, k]
            if c != 0.0:
                for j in range(i + 1):
                    out[i, j] += c * turned[k, j]
        for j in range(i):
            out[j, i] = out[i, j]
    return out


@njit(cache=True, error_model="numpy")
def innovation_covariance(P: Array, H: Array, R: Array) -> Array:
    """S = H P H' + R, (m, m)."""
    return H @ P @ H.T + R


@njit(cache=True, error_model="numpy")
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


@njit(cache=True, error_model="numpy")
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


@njit(cache=True, error_model="numpy")
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
        for k in range(n):
            ph[k] = 0.0
        for j in range(n):
            c = h[j]
            if c != 0.0:
                seen[count] = j
                count += 1
                nu -= c * dx[j]
                for k in range(n):
                    ph[k] += P[j, k] * c
        for e in range(count):
            s += h[seen[e]] * ph[seen[e]]
        nis += nu * nu / s
        for j in range(n):
            K[j] = ph[j] / s
            dx[j] += K[j] * nu
            d[j] = K[j]
        for e in range(count):  # d = K - A P h with A P = P - K ph', rounded as it is below: what Joseph's form repairs
            q = seen[e]
            c, g = h[q], ph[q]
            for j in range(n):
                d[j] -= (P[q, j] - K[j] * g) * c
        for j in range(n):  # (A P) A' + K K' = A P + d K'
            a, b = K[j], d[j]
            for k in range(n):
                P[j, k] = P[j, k] - a * ph[k] + b * K[k]
    for j in range(n if len(y) else 0):
        for k in range(j):
            P[j, k] = P[k, j] = 0.5 * (P[j, k] + P[k, j])
    return dx, nis


@njit(cache=True, error_model="numpy")
def compress(y: Array, W: Array) -> float:
    """Turn whitened rows so that W (m, c), c < m, is upper triangular and zero from row c on, in place.

    Rows of zeros say nothing of the state; returns the sum of squares of what was measured there, which is their share of
    the normalised innovation squared. Source: Golub and Van Loan (2013), sec. 5.2, Householder reflections.
    """
    m, c = W.shape
    for k in range(c):
        size = 0.0
        for i in range(k, m):
            size += W[i, k] * W[i, k]
        if size == 0.0:
            continue
        alpha = -np.sqrt(size) if W[k, k] > 0.0 else np.sqrt(size)
        head = W[k, k] - alpha
        scale = 1.0 / (alpha * head)  # -2 / |v|^2 of the reflecting vector v = (head, W[k + 1:, k])
        for j in range(k + 1, c):
            total = head * W[k, j]
            for i in range(k + 1, m):
                total += W[i, k] * W[i, j]
            total *= scale
            W[k, j] += total * head
            for i in range(k + 1, m):
                W[i, j] += total * W[i, k]
        total = head * y[k]
        for i in range(k + 1, m):
            total += W[i, k] * y[i]
        total *= scale
        y[k] += total * head
        for i in range(k + 1, m):
            y[i] += total * W[i, k]
            W[i, k] = 0.0
        W[k, k] = alpha
    rest = 0.0
    for i in range(c, m):
        rest += y[i] * y[i]
    return rest


@njit(cache=True, error_model="numpy")
def observed(H: Array) -> IntArray:
    """Columns of H (m, n) that are not all zero: states the rows see directly."""
    m, n = H.shape
    out, count = np.empty(n, np.int64), 0
    for k in range(n):
        for i in range(m):
            if H[i, k] != 0.0:
                out[count] = k
                count += 1
                break
    return out[:count]


@njit(cache=True, error_model="numpy")
def _of_columns(H: Array, columns: IntArray) -> Array:
    out = np.empty((len(H), len(columns)))
    for i in range(len(H)):
        for j in range(len(columns)):
            out[i, j] = H[i, columns[j]]
    return out


@njit(cache=True, error_model="numpy")
def _compressed(P: Array, y: Array, W: Array, columns: IntArray) -> tuple[Array, float]:
    """Process whitened rows W (m, c) of the states `columns`, m > c, by as many rows as states; P changes in place."""
    rest, c = compress(y, W), len(columns)
    full = np.zeros((c, len(P)))
    for i in range(c):
        for j in range(i, c):
            full[i, columns[j]] = W[i, j]
    dx, nis = scalar_updates(P, y[:c], full)
    return dx, nis + rest


@njit(cache=True, error_model="numpy")
def update_sequential(P: Array, nu: Array, H: Array, R: Array) -> tuple[Array, Array, float]:
    """As `update`, one whitened row after the other; the prior is not changed.

    Many rows that see few states, such as code and phase a position, are first compressed to as many rows as states.
    """
    out, columns = P.copy(), observed(H)
    if len(nu) <= len(columns):
        y, W = whiten(nu, H, R)
        dx, nis = scalar_updates(out, y, W)
    else:
        y, W = whiten(nu, _of_columns(H, columns), R)
        dx, nis = _compressed(out, y, W, columns)
    return dx, out, nis


@njit(cache=True, error_model="numpy")
def update_white(P: Array, e: Array, H: Array) -> tuple[Array, Array, float]:
    """As `update_sequential` with rows that are whitened already; none of the arguments is changed."""
    out, columns = P.copy(), observed(H)
    if len(e) <= len(columns):
        dx, nis = scalar_updates(out, e, H)
    else:
        dx, nis = _compressed(out, e.copy(), _of_columns(H, columns), columns)
    return dx, out, nis


@njit(cache=True, error_model="numpy")
def step(P: Array, Phi: Array, Q: Array, nu: Array, H: Array, R: Array) -> tuple[Array, Array, float, Array]:
    """`predict` and `update_sequential` in one call: the correction, the posterior, the NIS and the prior in between."""
    prior = predict(P, Phi, Q)
    dx, posterior, nis = update_sequential(prior, nu, H, R)
    return dx, posterior, nis, prior
