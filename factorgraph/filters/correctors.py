"""How a filter corrects a stage: plain, iterated, robust, or following the noise.

Source: for the updates themselves `filters.updates` and `filters.adaptive`.
"""

from __future__ import annotations

import numpy as np

from factorgraph.assembly.blocks import KINDS
from factorgraph.filters import adaptive, updates
from factorgraph.filters.adaptive import Fading, Level, NoiseLevels
from factorgraph.filters.sequential import StageRows
from factorgraph.filters.updates import Linearise, Updated
from factorgraph.types import Array

ITERATED = 1e-3  # of an iterated update, in standard deviations of the prior


class Corrector:
    """One kind of update; those that adapt remember between stages."""

    own_weights = False  # rows are weighed by the update, not by the problem's losses

    def inflation(self, P: Array, moved: Array, Q: Array, rows: StageRows, e: Array) -> Array:
        """Predicted covariance (n, n), from what the transition brings (`moved`) and its noise; P is their sum."""
        return P

    def update(self, P: Array, e: Array, rows: StageRows, linearise: Linearise | None) -> Updated:
        """Correct with innovations e (m,) of a stage's rows; `linearise` evaluates them at other deviations, where it can."""
        return updates.linear(P, e, rows.H)


class Iterated(Corrector):
    """Rows linearised again where the correction leads."""

    def update(self, P: Array, e: Array, rows: StageRows, linearise: Linearise | None) -> Updated:
        return updates.linear(P, e, rows.H) if linearise is None else updates.iterated(P, linearise, tolerance=ITERATED)


class Huber(Corrector):
    """Rows and prior reweighted by their residuals."""

    own_weights = True

    def update(self, P: Array, e: Array, rows: StageRows, linearise: Linearise | None) -> Updated:
        return updates.regression(P, e, rows.H)


class RobustFading(Corrector):
    """Rows in question weighted, then the prior divided."""

    own_weights = True

    def update(self, P: Array, e: Array, rows: StageRows, linearise: Linearise | None) -> Updated:
        return updates.robust_fading(P, e, rows.H, updates.huber_weight, lost=rows.clocks, least=0.1)


class StrongTracking(Corrector):
    """What the transition brings multiplied by a factor of the innovations."""

    def __init__(self) -> None:
        self.state = Fading()

    def inflation(self, P: Array, moved: Array, Q: Array, rows: StageRows, e: Array) -> Array:
        if rows.dof <= 0:
            return moved + Q
        H = rows.H
        HQH, HPH = (float(np.einsum("mi,ij,mj->", H, X, H, optimize=True)) for X in (Q, moved))
        factor, self.state = self.state.step(e, HQH, HPH, float(max(rows.dof, 1)))
        return factor * moved + Q


class Adaptive(Corrector):
    """Noise levels of the kinds of measurements followed."""

    def __init__(self, level: Level, residual: bool) -> None:
        self.levels, self.residual = NoiseLevels(level, len(KINDS) + 1), residual

    def update(self, P: Array, e: Array, rows: StageRows, linearise: Linearise | None) -> Updated:
        factors = self.levels.factors
        factors[-1] = 1.0  # of processes, which are no measurements
        scale = np.sqrt(factors[rows.kind])
        u = updates.linear(P, e / scale, rows.H / scale[:, None])
        share = rows.share
        if self.residual:
            sample = adaptive.residual_samples(e - rows.H @ u.dx, rows.H, u.P)
        else:  # innovations say less of the noise the less the state is known: inverse of their squares' variance
            sample = adaptive.innovation_samples(e, rows.H, P)
            weight = 1 / (1 + np.einsum("mi,ij,mj->m", rows.H, P, rows.H, optimize=True)) ** 2
            sample, share = weight * sample, weight * share
        self.levels.add(sample, np.where(rows.kind < 0, self.levels.n_classes - 1, rows.kind), share)
        return u
