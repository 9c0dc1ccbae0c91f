"""M-estimators of a normalised residual t: cost rho(t) and weight w(t) = rho'(t) / t.

    huber            rho = t^2/2 inside c, c|t| - c^2/2 outside
    cauchy           rho = c^2/2 log(1 + t^2/c^2)
    geman-mcclure    rho = (t^2/2) / (1 + t^2/c^2)
    tukey            rho = c^2/6 (1 - (1 - t^2/c^2)^3) inside c, c^2/6 outside
    dcs              rho = t^2/2 inside c, c^2 (3 t^2 - c^2) / (2 (c^2 + t^2)) outside
    tls              rho = t^2/2 inside c, c^2/2 outside
    self-tuned       rho = -log(sqrt(2 pi) p(t)), p a mixture of two normal distributions that the residuals themselves decide

All but huber have local minima: from far away they need graduation (`assembly.graduated`). With a factor s, a residual s t
and a width s c give s^2 rho(t) and the same weight.

"dcs" is dynamic covariance scaling: a row's weight is s^2 with s = min(1, 2 c^2 / (c^2 + t^2)), what a switch variable of
the row would settle at, and rho is what that weight is the slope of. "tls", truncated least squares, rejects outright.

Source: Zhang (1997), Parameter estimation techniques, table 1; Agarwal et al. (2013), Robust map optimization using dynamic
covariance scaling, for dcs; Yang et al. (2020), Graduated non-convexity, for the relaxed tls; Pfeifer and Protzel (2019),
Expectation-maximization for adaptive mixture models in graph optimization, for self-tuned; spec common.md, section 7.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from factorgraph.problem import Robust
from factorgraph.types import Array

MIXTURE_STEPS = 30
MIXTURE_START = (0.1, 10.0)  # share of the wide component and its standard deviation
MAX_SHARE = 0.5  # of the wide component: it is the exception


@dataclass(frozen=True, slots=True)
class Mixture:
    """Normalised residuals as a mixture of two zero-mean normal distributions: the good rows' and a wide one."""

    share: float = MIXTURE_START[0]  # of rows in the wide one
    inner: float = 1.0  # standard deviations, in units of the declared one
    outer: float = MIXTURE_START[1]

    def weight(self, t: Array) -> Array:
        good = self._good(t)
        return good / self.inner**2 + (1 - good) / self.outer**2

    def cost(self, t: Array) -> Array:
        return -np.asarray(np.logaddexp(*self._log_parts(t)))

    def _log_parts(self, t: Array) -> tuple[Array, Array]:
        inner = np.log((1 - self.share) / self.inner) - 0.5 * (t / self.inner) ** 2
        return inner, np.log(self.share / self.outer) - 0.5 * (t / self.outer) ** 2

    def _good(self, t: Array) -> Array:
        """Probability (n,) of every row to be of the inner component."""
        inner, outer = self._log_parts(t)
        return np.asarray(np.exp(inner - np.logaddexp(inner, outer)))


@dataclass(frozen=True, slots=True)
class RelaxedTls:
    """Truncated least squares on its way from convex (`control` near 0) to itself (`control` large)."""

    width: float
    control: float

    def weight(self, t: Array) -> Array:
        c, mu, a = self.width, self.control, np.abs(t)
        between = c * np.sqrt(mu * (mu + 1)) / np.maximum(a, 1e-300) - mu
        return np.asarray(np.clip(between, 0.0, 1.0))

    def cost(self, t: Array) -> Array:
        c, mu, a = self.width, self.control, np.abs(t)
        between = c * a * np.sqrt(mu * (mu + 1)) - 0.5 * mu * (c * c + a * a)
        inside, outside = a * a <= mu / (mu + 1) * c * c, a * a >= (mu + 1) / mu * c * c
        return np.where(inside, 0.5 * a * a, np.where(outside, 0.5 * c * c, between))


Loss = Robust | Mixture | RelaxedTls


def mixture(t: Array, width: float) -> Mixture:
    """The mixture that residuals t (n,) follow, by expectation maximisation.

    The inner standard deviation is at least the declared one, for residuals of a fit are too small, and the outer at least
    `width` times that; the wide component holds at most half of the rows.
    """
    found = Mixture(outer=max(MIXTURE_START[1], width))
    sq = t * t
    for _ in range(MIXTURE_STEPS if len(t) else 0):
        good = found._good(t)
        n = float(good.sum())
        inner = max(1.0, float(np.sqrt(np.sum(good * sq) / max(n, 1e-9))))
        outer = float(np.sqrt(np.sum((1 - good) * sq) / max(len(t) - n, 1e-9)))
        share = float(np.clip(1 - n / len(t), 1 / (len(t) + 1), MAX_SHARE))
        found = Mixture(share, inner, max(width * inner, outer))
    return found


def _huber_weight(a: Array, c: float) -> Array:
    return np.where(a <= c, 1.0, c / np.maximum(a, c))


def _huber_cost(a: Array, c: float) -> Array:
    return np.where(a <= c, 0.5 * a * a, c * a - 0.5 * c * c)


def _tukey_weight(a: Array, c: float) -> Array:
    return (1 - np.minimum((a / c) ** 2, 1.0)) ** 2


def _tukey_cost(a: Array, c: float) -> Array:
    return np.asarray(c * c / 6 * (1 - (1 - np.minimum((a / c) ** 2, 1.0)) ** 3))


def _dcs_weight(a: Array, c: float) -> Array:
    return np.minimum(1.0, 2 / (1 + (a / c) ** 2)) ** 2


def _dcs_cost(a: Array, c: float) -> Array:
    s = (a / c) ** 2
    return np.where(s <= 1, 0.5 * a * a, 0.5 * c * c * (3 * s - 1) / (1 + s))


WEIGHTS: dict[str, Callable[[Array, float], Array]] = {
    "none": lambda a, c: np.ones_like(a),
    "huber": _huber_weight,
    "cauchy": lambda a, c: 1 / (1 + (a / c) ** 2),
    "geman-mcclure": lambda a, c: 1 / (1 + (a / c) ** 2) ** 2,
    "tukey": _tukey_weight,
    "dcs": _dcs_weight,
    "tls": lambda a, c: (a < c).astype(float),
    "self-tuned": lambda a, c: mixture(a, c).weight(a),
}
COSTS: dict[str, Callable[[Array, float], Array]] = {
    "none": lambda a, c: 0.5 * a * a,
    "huber": _huber_cost,
    "cauchy": lambda a, c: 0.5 * c * c * np.log1p((a / c) ** 2),
    "geman-mcclure": lambda a, c: 0.5 * a * a / (1 + (a / c) ** 2),
    "tukey": _tukey_cost,
    "dcs": _dcs_cost,
    "tls": lambda a, c: 0.5 * np.minimum(a, c) ** 2,
    "self-tuned": lambda a, c: mixture(a, c).cost(a),
}


def weight(loss: Loss | None, t: Array) -> Array:
    """Weights (n,) in [0, 1] of normalised residuals; a self-tuned loss without a mixture takes that of `t`."""
    if loss is None:
        return np.ones_like(t)
    return WEIGHTS[loss.kernel](np.abs(t), loss.width) if isinstance(loss, Robust) else loss.weight(t)


def cost(loss: Loss | None, t: Array) -> Array:
    """rho(t) (n,)."""
    if loss is None:
        return 0.5 * t * t
    return COSTS[loss.kernel](np.abs(t), loss.width) if isinstance(loss, Robust) else loss.cost(t)


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
