"""Measurement updates of many kinds over one interface: error states, whitened rows, pure functions.

The state is a deviation d of covariance P (n, n) from the current mean. Rows are whitened, e(d) = measured - predicted in
standard deviations, independent and of unit variance. Rows from which a common clock was taken out keep their number: of as
many directions as were taken out they say nothing, e = 0 and H = 0 there, so that neither gain nor e'inv(S)e notice.

A model says either `Linearise`, e(d) (m,) and H = -de/dd (m, n) at one deviation, or `Residuals`, e (s, m) at many.

    linear          d = K e,  K = P H' inv(S),  S = H P H' + I
    iterated        Gauss-Newton for |e(d)|^2 + d' inv(P) d, steps halved while they do not reduce it
    sigma_point     the same with (G, E) of `sigma_points` in place of H: P = L L', S = G G' + E E' + I, K = L G' inv(S)
    square_root     the same, P = L L' only ever by its root: L+ = L tria [I - K G, K, K E], no difference of covariances
    huber           regression of rows and prior alike, both with weights psi(t) = min(1, c / |t|) of their residuals
    robust_fading   rows in question weighted, then the prior divided by theta <= 1 where innovations still are too large

The last two take rows e, H of a linearisation or, whitened again by `kalman.whiten`, those of `statistical`.

Source: Bell and Cathey (1993) for the iterated filter as Gauss-Newton; Julier and Uhlmann (2004); Arasaratnam and Haykin
(2009) for the cubature filter and its root; Karlgaard and Schaub (2007) for huber; spec common.md F1 to F7 and A3,
ultratight_ckf.md 2.3 to 2.5 for robust_fading.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numba import njit

from factorgraph.filters import kalman
from factorgraph.filters.adaptive import trace_ratio
from factorgraph.filters.sigma_points import Images, Rule, curvature, parts, product, root, rooted, slope, spread, through
from factorgraph.models.robust import WEIGHTS, bifactor
from factorgraph.types import Array

Linearise = Callable[[Array], tuple[Array, Array]]
Residuals = Images  # whitened measured - predicted
Weigh = Callable[[Array], Array]  # normalised residuals (k,) -> weights (k,)

STEPS, HALVINGS = 10, 6
TOLERANCE = 1e-8  # of a Gauss-Newton step, in standard deviations of the prior
HUBER, HUBER_STEPS = 1.345, 10
SETTLED = 1e-6  # of a regression, in standard deviations of the prior
LEAST = 1e-12  # weight


@dataclass(frozen=True, slots=True)
class Updated:
    """Correction, posterior covariance and normalised innovation squared; what robust and adaptive updates decided."""

    dx: Array  # (n,)
    P: Array  # (n, n)
    nis: float
    weights: Array | None = None  # (m,) of rows
    theta: float = 1.0  # the prior's covariance was divided by
    steps: int = 1
    L: Array | None = None  # (n, n) root of P where it came as one


def linear(P: Array, e: Array, H: Array) -> Updated:
    """Kalman update of whitened rows, one after the other."""
    return Updated(*kalman.update_white(P, e, H))


def _gauss_newton(P: Array, e: Array, H: Array) -> tuple[Array, Array]:
    """v with d = P v the minimiser of |e - H d|^2 + d' inv(P) d, and d."""
    PH = P @ H.T
    S = H @ PH + np.eye(len(e))
    v = H.T @ np.linalg.solve(S, e)
    return v, P @ v


def iterated(P: Array, linearise: Linearise, steps: int = STEPS, tolerance: float = TOLERANCE) -> Updated:
    """Linearise again at the corrected mean until it stays; the covariance is that of the last linearisation."""
    d, v = np.zeros(len(P)), np.zeros(len(P))
    e, H = linearise(d)
    cost, taken, size = float(e @ e), 0, np.inf
    while taken < steps and size >= tolerance:
        v_to, d_to = _gauss_newton(P, e + H @ d, H)
        whole, share = float(np.sqrt(max(float((v_to - v) @ (d_to - d)), 0.0))), 1.0
        for _ in range(HALVINGS):
            v_try, d_try = v + share * (v_to - v), d + share * (d_to - d)
            e_try, H_try = linearise(d_try)
            cost_try = float(e_try @ e_try + v_try @ d_try)
            if cost_try <= cost or whole < tolerance:
                break
            share *= 0.5
        v, d, e, H, cost = v_try, d_try, e_try, H_try, cost_try
        taken, size = taken + 1, share * whole
    _, posterior, _ = kalman.update_white(P, e, H)
    return Updated(d, posterior, cost, steps=taken)


def _from_root(L: Array, e: Array, G: Array, R: Array) -> tuple[Array, Array, float]:
    """Correction (n,), covariance (n, n) in Joseph's form, e' inv(S) e for rows of slope G inv(L) (m, n) and noise R (m, m)."""
    S = G @ G.T + R
    solved = np.linalg.solve(S, np.column_stack([G, e]))
    K, to_e = solved[:, :-1].T, solved[:, -1]
    A = np.eye(G.shape[1]) - K @ G
    P = L @ (A @ A.T + K @ R @ K.T) @ L.T
    return L @ (G.T @ to_e), 0.5 * (P + P.T), float(e @ to_e)


def statistical(L: Array, residuals: Residuals, rule: Rule) -> tuple[Array, Array, Array]:
    """Statistical linearisation over L L': e (m,), H (m, n), covariance R = I + Omega (m, m) with what no slope explains."""
    s = through(residuals, L, rule)
    return s.mean, slope(L, -s.G), s.curvature + np.eye(len(s.mean))


@njit(cache=True, error_model="numpy")
def _spread(P: Array, gamma: float) -> tuple[Array, Array]:
    L = root(P)
    return L, spread(L, gamma)


@njit(cache=True, error_model="numpy")
def _corrected(
    P: Array, L: Array, Y: Array, weight: float, shifted: bool, shift: float, sign: float
) -> tuple[Array, Array, float]:
    """`statistical` and the update in one call."""
    e, G, E = parts(Y, weight, shifted, shift)
    R = curvature(E, sign)
    for i in range(len(R)):
        R[i, i] += 1.0
    return kalman.update_sequential(P, e, slope(L, -G), R)


@njit(cache=True, error_model="numpy")
def _moved(L: Array, Y: Array, Q: Array, weight: float, shifted: bool, shift: float, sign: float) -> tuple[Array, Array, Array]:
    """Mean, covariance and cross covariance of images."""
    mean, G, E = parts(Y, weight, shifted, shift)
    return mean, product(G, G) + curvature(E, sign) + Q, product(L, G)


def sigma_point(P: Array, residuals: Residuals, rule: Rule) -> Updated:
    """Unscented or cubature update, as the rule is. Raises LinAlgError where P is not positive definite."""
    L, D = _spread(P, rule.gamma)
    return Updated(*_corrected(P, L, residuals(D), rule.weight, rule.shifted, rule.shift, rule.sign))


def square_root(L: Array, residuals: Residuals, rule: Rule) -> Updated:
    """The same from and to a root of the covariance, P = L L' with L (n, n) lower triangular."""
    s = through(residuals, L, rule)
    return rooted_update(L, s.mean, -s.G, s.E, s.sign)


def rooted_update(L: Array, e: Array, G: Array, E: Array, sign: float = 1.0) -> Updated:
    """Update of a root L (n, n) by rows e (m,) with G = H L (m, n) and, besides their unit noise, E E' of E (m, any)."""
    m = len(e)
    root_S = rooted([G, np.eye(m), E], sign)
    K = np.linalg.solve(root_S.T, np.linalg.solve(root_S, G)).T
    posterior = L @ rooted([np.eye(len(L)) - K @ G, K, K @ E], sign)
    t = np.linalg.solve(root_S, e)
    return Updated(L @ (K @ e), posterior @ posterior.T, float(t @ t), L=posterior)


def predict(P: Array, move: Images, Q: Array, rule: Rule) -> tuple[Array, Array, Array]:
    """Sigma-point time update: mean (k,) and covariance (k, k) of `move`'s images plus noise Q, cross covariance (n, k)."""
    L, D = _spread(P, rule.gamma)
    return _moved(L, move(D), Q, rule.weight, rule.shifted, rule.shift, rule.sign)


def predict_root(L: Array, move: Images, root_Q: Array, rule: Rule) -> tuple[Array, Array, Array]:
    """The same from and to roots; root_Q (k, any)."""
    s = through(move, L, rule)
    return s.mean, rooted([s.G, root_Q, s.E], s.sign), L @ s.G.T


def huber_weight(t: Array) -> Array:
    """Huber's weights at 95 % efficiency."""
    return WEIGHTS["huber"](np.abs(t), HUBER)


def regression(P: Array, e: Array, H: Array, weigh: Weigh = huber_weight, steps: int = HUBER_STEPS) -> Updated:
    """Robust regression of whitened rows e, H and of the prior, both reweighted by their own residuals.

    With the weights of the end rows have variance 1 / w and the prior's directions, in units of its Cholesky factor, too.
    """
    L = root(P)
    G, w, prior = H @ L, np.ones(len(e)), np.ones(len(P))
    out, taken, size = _from_root(L, e, G, np.eye(len(e))), 1, np.inf
    xi = np.asarray(np.linalg.solve(L, out[0]), float)
    while taken < steps and size >= SETTLED:
        w, prior = np.maximum(weigh(e - G @ xi), LEAST), np.maximum(weigh(xi), LEAST)
        sharp = np.sqrt(prior)
        out = _from_root(L / sharp, e, G / sharp, np.diag(1 / w))
        before, xi = xi, np.asarray(np.linalg.solve(L, out[0]), float)
        taken, size = taken + 1, float(np.abs(xi - before).max())
    return Updated(*out, weights=w, steps=taken)


def robust_fading(
    P: Array,
    e: Array,
    H: Array,
    weigh: Weigh,
    form: Literal["exact", "approximate"] = "exact",
    lost: int = 0,
    least: float = 1e-3,
) -> Updated:
    """Rows weighted by their standardised innovations, then the prior's covariance divided by the ratio of traces.

    lost: directions of the rows from which common clocks were taken out; least: bound of theta from below. Both covariances,
    in the gain and in what remains, are those of the divided prior. Source: spec ultratight_ckf.md, sections 2.3 to 2.5.
    """
    M = H @ P @ H.T
    w = np.maximum(weigh(e / np.sqrt(np.diag(M) + 1.0)), LEAST)
    R = bifactor(np.eye(len(e)), w)
    noise = float(np.trace(R)) - lost
    theta = max(trace_ratio(float(e @ e), float(np.trace(M)) + noise, noise, form), least)
    dx, posterior, nis = kalman.update_sequential(P / theta, e, H, R)
    return Updated(dx, posterior, nis, weights=w, theta=theta)
