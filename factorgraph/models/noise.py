"""Noise levels from residuals: variance components.

A residual v_i of an adjustment has variance r_i sigma_i^2 with its redundancy number r_i in [0, 1]; so v_i^2 / r_i estimates
sigma_i^2 without bias, and sums of them the levels of whole groups. Outliers are kept from counting: squares are bounded
at `BOUND` standard deviations of the present estimate and divided by what that leaves of a normal distribution's
(Huber's proposal 2).

    one factor           f^2 = sum r_i psi(t_i)^2 / (b sum r_i),  t_i = v_i / (sigma_i sqrt(r_i))
    two components       sigma_i^2 = x_1 A_i1 + x_2 A_i2, x >= 0: least squares on v_i^2 / r_i, weights r_i / sigma_i^4

Both are iterated, since bounds and weights depend on the result.

Source: Foerstner (1979), Ein Verfahren zur Schaetzung von Varianz- und Kovarianzkomponenten; Horn, Horn and Duncan (1975) for
almost unbiased estimates; Huber (1981), sec. 6.7.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import nnls
from scipy.stats import norm

from factorgraph.types import Array

BOUND = 2.0
KEPT = float(norm.cdf(BOUND) - norm.cdf(-BOUND) - 2 * BOUND * norm.pdf(BOUND) + 2 * BOUND**2 * norm.sf(BOUND))
ITERATIONS = 30
LEAST_REDUNDANCY = 0.05  # residuals of rows below it are rounding and model


@dataclass(frozen=True, slots=True)
class Components:
    """Variance components (k,) with standard deviations, and the redundancy they rest on."""

    value: Array
    sigma: Array
    redundancy: float


def scale(v: Array, sigma: Array, redundancy: Array) -> Components:
    """Factor f on the standard deviations sigma (n,) that residuals v (n,) with redundancy numbers (n,) ask for.

    NaN without redundancy.
    """
    v, sigma, r = _usable(v, sigma, redundancy)
    total = float(r.sum())
    if total == 0:
        return Components(np.array([np.nan]), np.array([np.nan]), 0.0)
    sq = v**2 / (r * sigma**2)
    f2 = float(np.average(sq, weights=r))
    for _ in range(ITERATIONS):
        before, f2 = f2, float(np.sum(r * np.minimum(sq, BOUND**2 * f2)) / (KEPT * total))
        if abs(f2 - before) < 1e-6 * f2:
            break
    f = np.sqrt(f2)
    return Components(np.array([f]), np.array([f / np.sqrt(2 * total)]), total)


def components(v: Array, sigma: Array, redundancy: Array, A: Array) -> Components:
    """Components x (k,) of the variances A x, A (n, k); sigma (n,) is where to start from."""
    usable = _is_usable(v, sigma, redundancy)
    A = A[usable]
    v, sigma, r = (np.asarray(part)[usable] for part in (v, sigma, redundancy))
    total = float(r.sum())
    nothing = np.full(A.shape[1], np.nan)
    if total == 0:
        return Components(nothing, nothing, 0.0)
    variance = sigma**2 * scale(v, sigma, r).value[0] ** 2
    x, column = nothing, np.linalg.norm(A, axis=0)
    for _ in range(ITERATIONS):
        estimate = np.minimum(v**2 / r, BOUND**2 * variance) / KEPT
        u = np.sqrt(r) / variance
        before, x = x, nnls(u[:, None] * A / column, u * estimate)[0] / column
        variance = np.maximum(A @ x, 1e-6 * variance)
        if np.all(np.abs(x - before) <= 1e-5 * x.sum()):
            break
    # var(v^2 / r) = 2 sigma^4 / r of the normal distribution
    N = (A * (r / (2 * variance**2))[:, None]).T @ A
    return Components(x, np.sqrt(np.diag(np.linalg.pinv(N))), total)


def _is_usable(v: Array, sigma: Array, redundancy: Array) -> Array:
    return np.asarray(np.isfinite(v) & np.isfinite(sigma) & (redundancy > LEAST_REDUNDANCY))


def _usable(v: Array, sigma: Array, redundancy: Array) -> tuple[Array, Array, Array]:
    usable = _is_usable(v, sigma, redundancy)
    return v[usable], sigma[usable], redundancy[usable]
