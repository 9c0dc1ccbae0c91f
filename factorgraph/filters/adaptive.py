"""Factors that say how far the predicted state is to be believed: at most 1, they divide its covariance.

    one factor       P <- P / alpha,  alpha = 1 up to k0, k0 / statistic beyond            (Yang and Gao 2006)
    classified       P <- Y^-1/2 P Y^-1/2,  Y = diag of one factor per class of states     (Huang and Zhang 2012)

Statistics exist in two forms. The literal ones of the literature sum quantities of different units,

    sqrt(nu' nu / tr S)          of innovations nu with covariance S
    |x - x_p| / sqrt(tr P_p)     of a class's correction

the normalised ones are free of units and of expectation one when the model holds:

    sqrt(nu' inv(S) nu / m),     sqrt(d' inv(cov d) d / rank),  cov d = P_p - P_u

Source: spec aar_two_stage.md, sections 2.2 and 2.5, errata E7, E13 and E14; Yang, He and Xu (2001).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np

from factorgraph.types import Array

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
