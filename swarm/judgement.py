"""Whether an update's innovations fit what filter and sensors say of themselves: the rule that triggers a correction.

With k rows of innovation e, its covariance S = H P H' + R and sigma_j = sqrt(R_jj):

    literal      mean = sum a_j |e_j|,  limit = sum a_j sigma_j,  a_j = (sum_i sigma_i - sigma_j) / sum_i sigma_i;  mean >= limit
    normalised   t_j = e_j / sqrt(S_jj):  mean |t_j| >= its quantile
    nis          e' inv(S) e >= its quantile, chi-square of k degrees of freedom

The literal rule is the published one. It adds rows of different units, ignores P, and gives all rows nearly the same weight, so
that the coarsest sensor sets both sides: the rule neither keeps a stated rate of false alarms nor sees a large error of a precise
sensor. It may be asked of the innovation or of the residual z - h(x_post). A single row's weight, which would be zero, is one.

The normalised rule is the same sum of standardised innovations, where all weights are equal. sigma_i as a limit would be one;
the expectation of |t_j| is sqrt(2/pi). Its mean over the rows has the variance

    (1/k^2) sum_ij (2/pi) (sqrt(1 - rho_ij^2) + rho_ij arcsin rho_ij - 1),   rho the correlations of S

and is taken as a Gamma variable of that mean and variance: near enough for false alarms of 0.7 to 1.6 % where 1 % is asked.

Source: spec ahrs_tdo.md 2.5, errata E20; Nabeya (1951) for absolute moments of two normal variables; Bar-Shalom et al. (2001),
sec. 5.4 for nis.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from scipy.special import chdtri, gammaincinv

from swarm.snapshot import Snapshot
from swarm.types import Array

Form = Literal["literal", "normalised", "nis", "always", "never"]
Of = Literal["innovation", "residual"]
MEAN = np.sqrt(2 / np.pi)  # of a standard normal variable's size


@dataclass(frozen=True, slots=True)
class Rule:
    """Which rule, and of what; `quantile` of the normalised rule and nis is the share of sound updates that pass."""

    form: Form = "nis"
    of: Of = "innovation"  # the residual only in the literal rule
    quantile: float = 0.99

    def __post_init__(self) -> None:
        if self.form not in get_args(Form):
            raise ValueError(f"form must be one of {', '.join(get_args(Form))}, got {self.form}")
        if self.of not in get_args(Of):
            raise ValueError(f"of must be innovation or residual, got {self.of}")
        if self.of == "residual" and self.form not in ("literal", "always", "never"):
            raise ValueError(f"only the literal rule may judge the residual, not {self.form}")
        if not 0 < self.quantile < 1:
            raise ValueError(f"quantile must lie in (0, 1), got {self.quantile}")


@dataclass(frozen=True, slots=True)
class Verdict:
    """What a rule said of an update; statistic and threshold are NaN for rules that look at nothing."""

    triggered: bool
    statistic: float
    threshold: float


def literal_weights(sigma: Array) -> Array:
    """a_j (k,) of the rows' standard deviations sigma (k,)."""
    total = float(sigma.sum())
    return (total - sigma) / total if len(sigma) > 1 else np.ones(1)


def literal(e: Array, R: Array) -> tuple[Array, float]:
    """Weighted mean (...,) of innovations or residuals e (..., k), and its limit."""
    sigma = np.sqrt(np.diag(R))
    a = literal_weights(sigma)
    return np.abs(e) @ a, float(a @ sigma)


def normalised(e: Array, S: Array, quantile: float = 0.99) -> tuple[Array, float]:
    """Mean size (...,) of standardised innovations e (..., k), and the quantile of what it should be."""
    sigma = np.sqrt(np.diag(S))
    rho = np.clip(S / np.outer(sigma, sigma), -1.0, 1.0)
    variance = float(np.mean(MEAN**2 * (np.sqrt(1 - rho**2) + rho * np.arcsin(rho) - 1)))
    shape = MEAN**2 / variance
    return np.mean(np.abs(e) / sigma, axis=-1), float(gammaincinv(shape, quantile) * variance / MEAN)


def nis(e: Array, S: Array, quantile: float = 0.99, dof: float | None = None) -> tuple[Array, float]:
    """Normalised innovation squared (...,) of e (..., k), and the quantile of its distribution, of k or `dof` degrees."""
    statistic = np.sum(e * np.linalg.solve(S, e.reshape(-1, len(S)).T).T.reshape(e.shape), axis=-1)
    return statistic, float(chdtri(len(S) if dof is None else dof, 1 - quantile))


def judge(rule: Rule, snapshot: Snapshot) -> Verdict:
    """Apply a rule to an update."""
    if rule.form in ("always", "never"):
        return Verdict(rule.form == "always", np.nan, np.nan)
    e = snapshot.residual if rule.of == "residual" else snapshot.innovation
    statistic, threshold = _measured(rule, e, snapshot.S, snapshot.R, snapshot.dof)
    return Verdict(bool(statistic >= threshold), float(statistic), threshold)


def _measured(rule: Rule, e: Array, S: Array, R: Array, dof: float | None = None) -> tuple[Array, float]:
    if rule.form == "literal":
        return literal(e, R)
    return normalised(e, S, rule.quantile) if rule.form == "normalised" else nis(e, S, rule.quantile, dof)


def trigger_rates(
    rules: Mapping[str, Rule],
    mismatches: Mapping[str, Array],
    H: Array,
    P: Array,
    R: Array,
    rng: np.random.Generator,
    n_trials: int = 20_000,
) -> dict[str, dict[str, float]]:
    """Share of updates in which each rule triggers, by rule and mismatch, simulated with the same noise for all.

    H (m, n), P (n, n), R (m, m): rows linearised, prior and noise, both as the filter believes and as they are.
    mismatches: what besides adds to the innovation (m,): of a state error dx that is H dx; zeros for the false alarms.
    """
    S = H @ P @ H.T + R
    noise = rng.standard_normal((n_trials, len(R))) @ np.linalg.cholesky(S).T
    to_residual = np.linalg.solve(S, R)  # z - h(x_post) = R inv(S) e
    rates: dict[str, dict[str, float]] = {}
    for name, rule in rules.items():
        rates[name] = {}
        for what, mismatch in mismatches.items():
            e = noise + mismatch
            rates[name][what] = _rate(rule, e @ to_residual if rule.of == "residual" else e, S, R)
    return rates


def _rate(rule: Rule, e: Array, S: Array, R: Array) -> float:
    if rule.form in ("always", "never"):
        return float(rule.form == "always")
    statistic, threshold = _measured(rule, e, S, R)
    return float(np.mean(statistic >= threshold))
