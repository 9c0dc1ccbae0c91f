"""Whether an estimator's covariances tell the truth, and how far a statistic over few trials may be believed.

    NEES   e' P^-1 e of an error e with covariance P, chi-square with dim(e) degrees of freedom when P is honest
    NIS    the same of an innovation with its covariance
    mean NEES of N trials at one epoch: N times it is chi-square with N dim(e) degrees of freedom
    whiteness   rho(l) = sum_k nu_k . nu_(k+l) / sqrt(sum_k |nu_k|^2 sum_k |nu_(k+l)|^2), about N(0, 1 / products) when white

Bands are two-sided: a value above is optimistic (covariance too small), below is pessimistic. Trials are independent,
epochs of one run are not: judge errors across trials at one epoch, and count epochs only for white innovations.
Values that are NaN are left out and not counted.

Source: Bar-Shalom et al. (2001), sec. 5.4; Wilson (1927); Efron (1987), bias-corrected and accelerated bootstrap.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.special import chdtri, ndtr, ndtri, stdtrit

from factorgraph.errors import InputError
from factorgraph.types import Array, IntArray

TOO_FLAT = 1e-12  # smallest pivot of a correlation matrix, per dimension, that counts as positive definite


@dataclass(frozen=True, slots=True)
class Consistency:
    """A chi-square statistic per epoch with its two-sided band; epochs that cannot be judged are NaN."""

    t_s: Array  # (n,)
    value: Array  # (n,)
    lower: Array  # (n,)
    upper: Array  # (n,)
    prob: float

    @property
    def share_inside(self) -> float:
        """Share of judged epochs inside the band, NaN without any. Epochs of one run are correlated."""
        judged = np.isfinite(self.value) & np.isfinite(self.upper)
        inside = (self.value >= self.lower) & (self.value <= self.upper)
        return float(np.mean(inside[judged])) if judged.any() else float("nan")


@dataclass(frozen=True, slots=True)
class Whiteness:
    """Normalised autocorrelation of innovations at lags 1 to m, and the half width of its band around zero."""

    rho: Array  # (m,)
    half_width: Array  # (m,)
    n_products: IntArray  # (m,) scalar products behind each lag
    prob: float

    @property
    def share_inside(self) -> float:
        """Share of lags inside the band; `prob` is expected of white innovations."""
        return float(np.mean(np.abs(self.rho) <= self.half_width))


@dataclass(frozen=True, slots=True)
class Interval:
    """An estimate with its two-sided confidence interval, from n trials."""

    value: float
    lower: float
    upper: float
    n: int


def standard_deviations(P: Array) -> Array:
    """Square roots (..., k) of the diagonals of covariances (..., k, k); NaN where negative or not estimated."""
    variance = np.diagonal(P, axis1=-2, axis2=-1)
    return np.sqrt(np.where(variance >= 0, variance, np.nan))


def nees(err: Array, P: Array) -> Array:
    """Normalised squares e' P^-1 e (t,) of errors (t, n) and covariances (t, n, n); of innovations it is the NIS.

    NaN where the error or P is unknown or P is not positive definite.
    """
    t, n = _checked(err, P)
    sigma = standard_deviations(P)
    rows = np.flatnonzero(np.isfinite(err).all(axis=1) & np.isfinite(P).all(axis=(1, 2)) & (sigma > 0).all(axis=1))
    # unit diagonal first: definiteness is then judged free of units
    A = P[rows] / (sigma[rows][:, :, None] * sigma[rows][:, None, :])
    e = err[rows] / sigma[rows]
    sum_squares, definite = np.zeros(len(rows)), np.ones(len(rows), bool)
    for j in range(n):  # LDL' by elimination, all epochs at once
        definite &= A[:, j, j] > TOO_FLAT * n
        pivot = np.where(definite, A[:, j, j], 1.0)
        sum_squares += e[:, j] ** 2 / pivot
        factor = A[:, j + 1 :, j] / pivot[:, None]
        e[:, j + 1 :] -= factor * e[:, j, None]
        A[:, j + 1 :, j + 1 :] -= factor[:, :, None] * A[:, j, None, j + 1 :]
    value = np.full(t, np.nan)
    value[rows] = np.where(definite, sum_squares, np.nan)
    return value


def _checked(err: Array, P: Array) -> tuple[int, int]:
    if err.ndim != 2 or P.shape != (*err.shape, err.shape[1]):
        raise InputError(f"errors (t, n) and covariances (t, n, n) do not match: got {err.shape} and {P.shape}")
    return err.shape[0], err.shape[1]


def band(dof: Array | float, prob: float = 0.95) -> tuple[Array, Array]:
    """Two-sided chi-square band: lower and upper quantiles of degrees of freedom (...), fractional ones allowed.

    NaN where there are none. Raises InputError unless 0 < prob < 1.
    """
    tail = _tail(prob)
    usable = np.where(np.asarray(dof, float) > 0, dof, np.nan)
    return np.asarray(chdtri(usable, 1 - tail)), np.asarray(chdtri(usable, tail))


def _tail(prob: float) -> float:
    if not 0 < prob < 1:
        raise InputError(f"prob must lie in (0, 1), got {prob}")
    return 0.5 * (1 - prob)


def judge(t_s: Array, value: Array, dof: Array, prob: float = 0.95) -> Consistency:
    """Chi-square statistics (n,) at epochs (n,) with degrees of freedom (n,) against their bands."""
    lower, upper = band(dof, prob)
    return Consistency(t_s, np.where(np.isfinite(upper), value, np.nan), lower, upper, prob)


def average_nees(t_s: Array, values: Array, dim: int, prob: float = 0.95) -> Consistency:
    """Mean over trials of the NEES (trials, n) of errors of `dim` components, at every epoch (n,), with its band.

    Its expectation is `dim`; the band narrows with the finite trials at the epoch. Epochs without any are NaN.
    """
    known = np.isfinite(values)
    n_trials = known.sum(axis=0)
    divisor = np.maximum(n_trials, 1)
    found = judge(t_s, np.where(known, values, 0.0).sum(axis=0), dim * n_trials, prob)
    return Consistency(t_s, found.value / divisor, found.lower / divisor, found.upper / divisor, prob)


def nis_band(dof: Array, prob: float = 0.95) -> tuple[float, float]:
    """Band of the mean NIS over the epochs of one run, degrees of freedom (k,) each; its expectation is their mean.

    Holds when the innovations are white (`whiteness`). NaN without epochs that have degrees of freedom.
    """
    counted = np.asarray(dof, float)
    counted = counted[counted > 0]
    lower, upper = band(float(counted.sum()), prob)
    return float(lower) / max(len(counted), 1), float(upper) / max(len(counted), 1)


def whiteness(nu: Array, max_lag: int, prob: float = 0.95) -> Whiteness:
    """Autocorrelation of normalised innovations (k,) or (k, m), equally spaced, at lags 1 to max_lag.

    The mean is not removed: a bias is a defect as well. Missing epochs are NaN; products with them are left out.
    Raises InputError where a lag has no products.
    """
    x = np.asarray(nu, float).reshape(len(nu), -1)
    if not 1 <= max_lag < len(x):
        raise InputError(f"lags up to {max_lag} need more than {max_lag} innovations and at least lag 1; there are {len(x)}")
    known = np.isfinite(x)
    x = np.where(known, x, 0.0)
    rho, count = np.zeros(max_lag), np.zeros(max_lag, np.int64)
    for lag in range(1, max_lag + 1):
        both = known[:-lag] & known[lag:]
        a, b = np.where(both, x[:-lag], 0.0), np.where(both, x[lag:], 0.0)
        size = np.sqrt(np.sum(a * a) * np.sum(b * b))
        count[lag - 1] = both.sum()
        if not size > 0:
            raise InputError(f"whiteness: no innovations {lag} apart, or all of them are zero; choose a smaller max_lag")
        rho[lag - 1] = np.sum(a * b) / size
    return Whiteness(rho, float(-ndtri(_tail(prob))) / np.sqrt(count), count, prob)


def wilson(successes: int, n: int, prob: float = 0.95) -> Interval:
    """Wilson's score interval of a share; (0, 1) around NaN without trials.

    Raises InputError unless 0 <= successes <= n.
    """
    if not 0 <= successes <= n:
        raise InputError(f"successes must lie between 0 and the {n} trials, got {successes}")
    _tail(prob)
    from ambiguity import wilson as share_of  # compiled, which a light import must not wait for

    share = share_of(successes, n, prob)
    return Interval(share.value, share.lower, share.upper, n)


def mean_interval(x: Array, prob: float = 0.95) -> Interval:
    """Mean of trials (n,) with Student's interval; unbounded with fewer than two, NaN without any."""
    kept = np.asarray(x, float)
    kept = kept[np.isfinite(kept)]
    n, tail = len(kept), _tail(prob)
    mean = float(np.mean(kept)) if n else float("nan")
    if n < 2:
        return Interval(mean, -np.inf, np.inf, n)
    half = float(stdtrit(n - 1, 1 - tail) * np.std(kept, ddof=1) / np.sqrt(n))
    return Interval(mean, mean - half, mean + half, n)


def mean_difference(a: Array, b: Array) -> Array:
    """Mean of b less mean of a over the last axis."""
    return np.asarray(np.mean(b, axis=-1) - np.mean(a, axis=-1))


def paired_bootstrap(
    a: Array,
    b: Array,
    rng: np.random.Generator,
    compare: Callable[[Array, Array], Array] = mean_difference,
    prob: float = 0.95,
    n_resamples: int = 2000,
) -> Interval:
    """compare(a, b) of two methods' results on the same seeds (n,), with the bootstrap interval over seeds.

    Seeds are drawn with replacement, both methods' results of a seed together. `compare` takes (..., n) and (..., n) to
    (...). Seeds with NaN in either are left out. Where all seeds say the same, the interval is a point.
    Raises InputError when shapes differ or fewer than two seeds are left.
    """
    if a.shape != b.shape or a.ndim != 1:
        raise InputError(f"paired_bootstrap needs one value per seed of each method, got {a.shape} and {b.shape}")
    known = np.isfinite(a) & np.isfinite(b)
    a, b, n, tail = a[known], b[known], int(known.sum()), _tail(prob)
    if n < 2:
        raise InputError(f"paired_bootstrap needs at least two seeds with finite values of both methods, got {n}")
    value = float(compare(a, b))
    pick = rng.integers(0, n, (n_resamples, n))
    draws = compare(a[pick], b[pick])
    left_out = np.flatnonzero(~np.eye(n, dtype=bool)).reshape(n, n - 1) % n  # row i: every seed but i
    jackknife = compare(a[left_out], b[left_out])
    deviation = jackknife.mean() - jackknife
    spread = float(np.sum(deviation**2))
    if spread <= (1e-12 * abs(value)) ** 2:
        return Interval(value, value, value, n)
    acceleration = float(np.sum(deviation**3)) / (6 * spread**1.5)
    below = (np.sum(draws < value) + 0.5 * np.sum(draws == value)) / n_resamples
    z0 = ndtri(np.clip(below, 0.5 / n_resamples, 1 - 0.5 / n_resamples))
    z = z0 + ndtri([tail, 1 - tail])
    lower, upper = np.quantile(draws, ndtr(z0 + z / (1 - acceleration * z)))
    return Interval(value, float(lower), float(upper), n)
