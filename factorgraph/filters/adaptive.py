"""Factors that say how far the predicted state is to be believed: at most 1, they divide its covariance. And noise levels.

    one factor       P <- P / alpha,  alpha = 1 up to k0, k0 / statistic beyond            (Yang and Gao 2006)
    classified       P <- Y^-1/2 P Y^-1/2,  Y = diag of one factor per class of states     (Huang and Zhang 2012)

Statistics exist in two forms. The literal ones of the literature sum quantities of different units,

    sqrt(nu' nu / tr S)          of innovations nu with covariance S
    |x - x_p| / sqrt(tr P_p)     of a class's correction

the normalised ones are free of units and of expectation one when the model holds:

    sqrt(nu' inv(S) nu / m),     sqrt(d' inv(cov d) d / rank),  cov d = P_p - P_u

    trace ratio      theta = (tr S - tr R) / (nu' nu - tr R) where nu' nu > tr S, or tr S / nu' nu           (spec A3)

A strong tracking filter multiplies instead, and only what the transition brings of the state before:

    P <- lambda Phi P Phi' + Q,  lambda = max(1, (V - tr(H Q H') - beta tr R) / tr(H Phi P Phi' H')),
    V <- (rho V + nu' nu) / (1 + rho)

Levels of the measurements' noise, one factor s^2 on the declared variances of each class of rows (code, phase, ranges), are
means of samples of unit expectation, with rows of unit declared variance, S = H P H' of prior or posterior P:

    innovations      nu^2 - diag S          may be negative: a floor is needed
    residuals        res^2 + diag S         of what an update leaves, res = e - H dx, never negative

over a memory, weights mu of the newest sample, j = 0, the one before, ..: `window` equal weights of the last m epochs (Sage
windows: IAE of innovations, RAE of residuals), `forgetting` (1 - d) / (1 - d^(j+2)) within a window, `fading` the recursion
s <- (1 - d_k) s + d_k sample, d_k = (1 - b) / (1 - b^k+1) (Sage and Husa). Numbers of rows may change from epoch to epoch.

Source: spec aar_two_stage.md, sections 2.2 and 2.5, errata E7, E13 and E14; Yang, He and Xu (2001); spec common.md A3 to A6
and F6, deep_bds_ins.md 2.5; Sage and Husa (1969); Mohamed and Schwarz (1999) for IAE and RAE; Zhou and Frank (1996) for
strong tracking.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from factorgraph.errors import InputError, positive
from factorgraph.types import Array, IntArray

Statistic = Literal["literal", "normalised"]


def factor(statistic: float, threshold: float) -> float:
    """1 up to the threshold, threshold / statistic beyond."""
    return 1.0 if statistic <= threshold else threshold / statistic


def innovation_statistic(nu: Array, S: Array, form: Statistic) -> float:
    """How far innovations (m,) with covariance S (m, m) depart from zero."""
    if form == "literal":
        return float(np.sqrt(nu @ nu / np.trace(S)))
    return float(np.sqrt(nu @ np.linalg.solve(S, nu) / len(nu)))


def correction_statistic(d: Array, P_prior: Array, P_posterior: Array, form: Statistic) -> float:
    """How far the correction d (n,) of one class of states exceeds what its covariances (n, n) allow."""
    if form == "literal":
        return float(np.sqrt(d @ d / np.trace(P_prior)))
    size, vectors = np.linalg.eigh(P_prior - P_posterior)
    known = size > 1e-9 * size[-1]  # directions the measurements do not correct say nothing
    return float(np.sqrt(np.sum((vectors[:, known].T @ d) ** 2 / size[known]) / np.sum(known)))


def classified(P: Array, classes: Sequence[tuple[slice, float]]) -> Array:
    """Predicted covariance (n, n) with the classes' factors (0, 1] divided out: Y^-1/2 P Y^-1/2."""
    s = np.ones(len(P))
    for part, gamma in classes:
        s[part] = 1 / np.sqrt(gamma)
    return P * s[:, None] * s


def trace_ratio(nu2: float, trace_S: float, trace_R: float, form: Literal["exact", "approximate"]) -> float:
    """theta in (0, 1] of squared innovations nu' nu and the traces of their covariance S and of its noise R."""
    if nu2 <= trace_S:
        return 1.0
    return (trace_S - trace_R) / (nu2 - trace_R) if form == "exact" else trace_S / nu2


@dataclass(frozen=True, slots=True)
class Fading:
    """The fading factor of a strong tracking filter, with what it remembers of innovations (squares per row)."""

    rho: float = 0.95
    softening: float = 1.0  # beta
    limit: float = 1e3
    V: float = np.nan  # nothing yet

    def step(self, nu: Array, HQH: float, HPH: float, rows: float) -> tuple[float, Fading]:
        """lambda >= 1 of innovations nu (m,) of whitened rows, the traces of H Q H' and of H Phi P Phi' H', and tr R."""
        mean = float(nu @ nu) / max(rows, 1e-12)
        V = mean if np.isnan(self.V) else (self.rho * self.V + mean) / (1 + self.rho)
        ratio = (V * rows - HQH - self.softening * rows) / max(HPH, 1e-300)
        return float(np.clip(ratio, 1.0, self.limit)), replace(self, V=V)


Memory = Literal["window", "forgetting", "fading"]


@dataclass(frozen=True, slots=True)
class Level:
    """Settings of noise levels: memory, its length, and bounds of the factor on variances."""

    memory: Memory = "window"
    epochs: int = 20  # of window and forgetting
    forget: float = 0.95  # d of forgetting, b of fading
    bounds: tuple[float, float] = (0.1, 100.0)

    def __post_init__(self) -> None:
        positive(self, "epochs")
        if not 0 < self.forget < 1:
            raise InputError(f"Level.forget must lie between 0 and 1, got {self.forget}")
        if not 0 < self.bounds[0] <= 1 <= self.bounds[1]:
            raise InputError(f"Level.bounds must enclose 1 and be positive, got {self.bounds}")

    def weights(self, n: int) -> Array:
        """Weights (n,) of the last n samples, the newest last."""
        j = np.arange(n - 1, -1, -1)
        if self.memory == "window":
            return np.ones(n)
        if self.memory == "forgetting":
            return np.asarray((1 - self.forget) / (1 - self.forget ** (j + 2.0)))
        return np.asarray(self.forget**j)


@dataclass(slots=True)
class NoiseLevels:
    """Factors on the declared variances of classes of rows, followed from epoch to epoch."""

    settings: Level
    n_classes: int
    _sums: list[Array] = field(default_factory=list)  # (2, classes) of an epoch: samples, numbers of rows

    @property
    def factors(self) -> Array:
        """Present factor of every class (classes,); 1 for a class that was not seen yet."""
        if not self._sums:
            return np.ones(self.n_classes)
        total = np.einsum("k,kab->ab", self.settings.weights(len(self._sums)), np.array(self._sums))
        mean = np.divide(total[0], total[1], out=np.ones(self.n_classes), where=total[1] > 0)
        return np.asarray(np.clip(mean, *self.settings.bounds))

    def add(self, samples: Array, classes: IntArray, share: Array | None = None) -> None:
        """Samples (m,) of an epoch's rows, the class of each, and their share in the rows' number (1; less where clocks are)."""
        n = np.ones(len(samples)) if share is None else share
        sums = [np.bincount(classes, x, minlength=self.n_classes) for x in (samples, n)]
        self._sums.append(np.array(sums))
        if self.settings.memory == "fading":  # one sum that fades holds them all
            if len(self._sums) > 1:
                self._sums[:] = [self.settings.forget * self._sums[0] + self._sums[1]]
        elif len(self._sums) > self.settings.epochs:
            del self._sums[0]


def innovation_samples(nu: Array, H: Array, P_prior: Array) -> Array:
    """nu^2 - diag(H P H') (m,): expectation is the variance of each row's noise."""
    return np.asarray(nu**2 - np.einsum("mi,ij,mj->m", H, P_prior, H, optimize=True))


def residual_samples(res: Array, H: Array, P_posterior: Array) -> Array:
    """res^2 + diag(H P H') (m,) of what an update left: expectation is the variance of each row's noise."""
    return np.asarray(res**2 + np.einsum("mi,ij,mj->m", H, P_posterior, H, optimize=True))


def process_noise(K: Array, C: Array, nominal: Array, floor: float = 0.01) -> Array:
    """Diagonal process noise (n, n) that corrections K nu ask for, C (m, m) the mean of nu nu'; a share of the nominal at least.

    Source: spec common.md A4, deep_bds_ins.md section 2.5 for the diagonal and the floor.
    """
    return np.diag(np.maximum(np.einsum("im,mk,ik->i", K, C, K), floor * np.diag(nominal)))
