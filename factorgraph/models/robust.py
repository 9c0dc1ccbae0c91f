"""M-estimators of a normalised residual t: cost rho(t) and weight w(t) = rho'(t) / t.

    huber            rho = t^2/2 inside c, c|t| - c^2/2 outside
    cauchy           rho = c^2/2 log(1 + t^2/c^2)
    geman-mcclure    rho = (t^2/2) / (1 + t^2/c^2)
    tukey            rho = c^2/6 (1 - (1 - t^2/c^2)^3) inside c, c^2/6 outside

The last three redescend. Source: Zhang (1997), Parameter estimation techniques, table 1; spec common.md, section 7.
"""

from __future__ import annotations

import numpy as np

from factorgraph.problem import Robust
from factorgraph.types import Array


def weight(robust: Robust | None, t: Array) -> Array:
    """Weights (n,) in [0, 1] of normalised residuals."""
    if robust is None or robust.kernel == "none":
        return np.ones_like(t)
    c, a = robust.width, np.abs(t)
    if robust.kernel == "huber":
        return np.where(a <= c, 1.0, c / np.maximum(a, c))
    s = (t / c) ** 2
    if robust.kernel == "cauchy":
        return 1 / (1 + s)
    if robust.kernel == "geman-mcclure":
        return 1 / (1 + s) ** 2
    return np.where(a < c, (1 - np.minimum(s, 1.0)) ** 2, 0.0)


def cost(robust: Robust | None, t: Array) -> Array:
    """rho(t) (n,)."""
    if robust is None or robust.kernel == "none":
        return 0.5 * t * t
    c, a = robust.width, np.abs(t)
    if robust.kernel == "huber":
        return np.where(a <= c, 0.5 * t * t, c * a - 0.5 * c * c)
    s = (t / c) ** 2
    if robust.kernel == "cauchy":
        return 0.5 * c * c * np.log1p(s)
    if robust.kernel == "geman-mcclure":
        return 0.5 * t * t / (1 + s)
    return np.where(a < c, c * c / 6 * (1 - (1 - np.minimum(s, 1.0)) ** 3), c * c / 6)


def igg3(t: Array, c0: float, c1: float, floor: float = 1e-12) -> Array:
    """IGG-III factors (n,) in [floor, 1] on the weights of standardised residuals: kept, reduced, rejected.

    1 to c0, (c0 / |t|) ((c1 - |t|) / (c1 - c0))^2 to c1, `floor` beyond. Source: Yang, Song and Xu (2002); spec common.md W1.
    """
    a = np.maximum(np.abs(t), c0)
    return np.maximum(np.where(a < c1, c0 / a * ((c1 - a) / (c1 - c0)) ** 2, 0.0), floor)


def bifactor(R: Array, w: Array) -> Array:
    """Covariance (n, n) of correlated rows whose weights are multiplied by sqrt(w_i w_j): R_ij / sqrt(w_i w_j).

    Equals the inverse of the scaled weight matrix and is positive definite for any w > 0. Source: Yang, Song and Xu (2002);
    spec common.md W2.
    """
    s = 1 / np.sqrt(w)
    return R * s[:, None] * s
