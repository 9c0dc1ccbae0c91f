"""How a filter corrects a stage: plain, iterated, robust, or following the noise.

A correction from outside, such as a search for the least of an objective, comes in as a callable of a `Case` (`Searched`).

Source: for the updates themselves `filters.updates` and `filters.adaptive`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from factorgraph.assembly.blocks import KINDS
from factorgraph.filters import adaptive, kalman, updates
from factorgraph.filters.adaptive import Fading, Level, NoiseLevels
from factorgraph.filters.sequential import StageRows
from factorgraph.filters.sigma_points import root
from factorgraph.filters.updates import Linearise, Updated
from factorgraph.types import Array, BoolArray

ITERATED = 1e-3  # of an iterated update, in standard deviations of the prior


class Corrector:
    """One kind of update; those that adapt remember between stages."""

    own_weights = False  # rows are weighed by the update, not by the problem's losses
    relinearises = False  # the corrected state is that of rows as they are there

    def inflation(self, P: Array, moved: Array, Q: Array, rows: StageRows, e: Array) -> Array:
        """Predicted covariance (n, n), from what the transition brings (`moved`) and its noise; P is their sum."""
        return P

    def update(self, P: Array, e: Array, rows: StageRows, linearise: Linearise | None) -> Updated:
        """Correct with innovations e (m,) of a stage's rows; `linearise` evaluates them at other deviations, where it can."""
        return updates.linear(P, e, rows.H)

    def rooted(self, L: Array, e: Array, rows: StageRows, E: Array) -> Updated:
        """The same with a prior only known by its root L (n, n) and, besides the rows' unit noise, E E' of E (m, any)."""
        return updates.rooted_update(L, e, rows.H @ L, E)


class Iterated(Corrector):
    """Rows linearised again where the correction leads."""

    relinearises = True

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


@dataclass(frozen=True, slots=True)
class Case:
    """An update of deviations about a prior mean of zero as plain arrays: e = H x + v, cov v = I."""

    P_prior: Array  # (n, n)
    x_post: Array  # (n,)
    P_post: Array  # (n, n)
    e: Array  # (m,)
    H: Array  # (m, n)
    judged: BoolArray  # (m,) rows whose standard deviation is that of a single measurement
    dof: float  # of the judged rows' innovations


Correct = Callable[[Case], tuple[Array, Array] | None]  # another state (n,) and covariance (n, n), or none


class Searched(Corrector):
    """A plain update, and what a correction from outside makes of it."""

    def __init__(self, plain: Corrector, correct: Correct) -> None:
        self.plain, self.correct = plain, correct
        self.own_weights, self.relinearises = plain.own_weights, plain.relinearises

    def inflation(self, P: Array, moved: Array, Q: Array, rows: StageRows, e: Array) -> Array:
        return self.plain.inflation(P, moved, Q, rows, e)

    def update(self, P: Array, e: Array, rows: StageRows, linearise: Linearise | None) -> Updated:
        u, H = self.plain.update(P, e, rows, linearise), rows.H
        if linearise is not None and self.relinearises:
            e, H = linearise(u.dx)
            e = e + H @ u.dx
        return self._corrected(P, e, H, rows, u)

    def rooted(self, L: Array, e: Array, rows: StageRows, E: Array) -> Updated:
        u = self.plain.rooted(L, e, rows, E)
        e, H = kalman.whiten(e, rows.H, np.eye(len(e)) + E @ E.T)
        found = self._corrected(L @ L.T, e, H, rows, u)
        return u if found is u else replace(found, L=root(found.P))

    def _corrected(self, P: Array, e: Array, H: Array, rows: StageRows, u: Updated) -> Updated:
        dof = float(np.count_nonzero(rows.judged)) - rows.judged_clocks
        found = self.correct(Case(P, u.dx, u.P, e, H, rows.judged, dof))
        return u if found is None else replace(u, dx=found[0], P=found[1])
