"""Fixed-interval smoothing: what later measurements say about earlier states.

Backward from the last state, with the filtered (x+, P+) of a state, the predicted (x-, P-) of the next and their cross
covariance C, which a linear transition gives as P+ F' and sigma points as L G',

    A = C inv(P-),   d = A (x_s - x-),   P_s = P+ + A (P_s_next - P-) A'

where d is the smoothed less the filtered state. With F and Q, P- = F P+ F' + Q, the covariance is a sum of squares,

    P_s = (I - A F) P+ (I - A F)' + A (P_s_next + Q) A'

States may come and go between the two times: F (k, n) has zero rows for new ones, whose prior is in Q, and none for those
that end. Differences are those of error states: x_s - x- as the perturbation that leads from x- to x_s.

Source: Rauch, Tung and Striebel (1965); Sarkka (2013), Bayesian filtering and smoothing, ch. 8 and 10.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from factorgraph.types import Array


def _gain(cross: Array, P_prior: Array) -> Array:
    """cross inv(P_prior) (n, k), in units of the standard deviations: states may be of any scale."""
    s = np.sqrt(np.diag(P_prior))
    return np.asarray(np.linalg.solve(P_prior / np.outer(s, s), (cross / s).T).T / s)


def linear(P: Array, F: Array, Q: Array, P_prior: Array, ahead: Array, P_ahead: Array) -> tuple[Array, Array]:
    """Smoothed less filtered state (n,) and smoothed covariance (n, n).

    P (n, n) filtered; F (k, n), Q (k, k) to the next time; P_prior (k, k) predicted there; ahead (k,), P_ahead (k, k): smoothed
    less predicted state and smoothed covariance there. Raises LinAlgError where P_prior is singular.
    """
    A = gain(P, F, P_prior)
    return A @ ahead, with_gain(A, P, F, Q, P_ahead)


def gain(P: Array, F: Array, P_prior: Array) -> Array:
    """A (n, k) of the smoother; of smoothed states, cov(x_i, x_(i+1)) = A cov(x_(i+1)), and so on. Raises as `linear`."""
    return _gain((F @ P).T, P_prior)


def with_gain(A: Array, P: Array, F: Array, Q: Array, P_ahead: Array) -> Array:
    """Smoothed covariance (n, n)."""
    B = np.eye(len(P)) - A @ F
    out = B @ P @ B.T + A @ (P_ahead + Q) @ A.T
    return np.asarray(0.5 * (out + out.T))


def crossed(P: Array, cross: Array, P_prior: Array, ahead: Array, P_ahead: Array) -> tuple[Array, Array]:
    """The same from the cross covariance (n, k) of the two states, as sigma points give it."""
    A = _gain(cross, P_prior)
    AP = A @ (P_ahead - P_prior)
    out = P + AP @ A.T
    return A @ ahead, 0.5 * (out + out.T)


def chain(
    x: Sequence[Array], P: Sequence[Array], x_prior: Sequence[Array], P_prior: Sequence[Array], F: Sequence[Array],
    Q: Sequence[Array],
) -> tuple[list[Array], list[Array]]:  # fmt: skip
    """Smoothed states and covariances of K times whose states are vectors.

    x, P: filtered, K each; x_prior, P_prior, F, Q: predicted and the transition to times 1 to K - 1, K - 1 each.
    """
    xs, Ps = [x[-1]], [P[-1]]
    for k in range(len(x) - 2, -1, -1):
        d, P_s = linear(P[k], F[k], Q[k], P_prior[k], xs[0] - x_prior[k], Ps[0])
        xs.insert(0, x[k] + d)
        Ps.insert(0, P_s)
    return xs, Ps
