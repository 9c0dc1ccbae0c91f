"""Integers fixed anew at every epoch: a state conditioned on them is put out, the float state carries on.

With ambiguities a of covariance Q and integers z, a state x that shares P_xa with them becomes

    x + P_xa Q^-1 (z - a),    P_x - P_xa Q^-1 P_ax

Source: Teunissen (1995), sec. 2, for the third step of integer least squares.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ambiguity import partial
from factorgraph.problem import AmbiguitySettings
from factorgraph.solution import Fix, PairSolution
from factorgraph.types import Array, IntArray


@dataclass(frozen=True, slots=True)
class Conditioned:
    """What integers make of a state: its correction, its covariance, and how they were found."""

    dx: Array  # (n,)
    P: Array  # (n, n)
    fixed: int  # ambiguities
    free: int  # that could have been
    ratio: float


def condition(P: Array, a: Array, settings: AmbiguitySettings) -> Conditioned:
    """Condition a state on those of its ambiguities a (m,) that can be fixed; P (n + m, n + m) is their joint covariance."""
    n, m = len(P) - len(a), len(a)
    own = P[:n, :n]
    if not m or not settings.fix:
        return Conditioned(np.zeros(n), own, 0, m, np.nan)
    Q = 0.5 * (P[n:, n:] + P[n:, n:].T)
    got = partial.fix(a, Q, ratio_threshold=settings.ratio_threshold, min_success_rate=settings.min_success_rate)
    held = np.flatnonzero(got.fixed)
    if not len(held):
        return Conditioned(np.zeros(n), own, 0, m, np.nan)
    across = P[n + held, :n]
    G = np.linalg.solve(Q[np.ix_(held, held)], across).T
    after = own - G @ across
    return Conditioned(G @ (got.integers - a)[held], 0.5 * (after + after.T), len(held), m, float(got.ratio))


@dataclass(frozen=True, slots=True)
class EpochIntegers:
    """Status of the integers at every state time."""

    fix: IntArray  # (K,) values of Fix
    ratio: Array  # (K,)

    @classmethod
    def of(cls, epochs: Sequence[Conditioned]) -> EpochIntegers:
        return cls(np.array([_status(e).value for e in epochs]), np.array([e.ratio for e in epochs]))

    def applied(self, pair: PairSolution) -> PairSolution:
        """A pair with the status of its epochs; those without phases keep none."""
        fix = np.where(pair.fix == Fix.NONE.value, pair.fix, self.fix)
        return replace(pair, fix=fix, ratio=self.ratio)


def _status(epoch: Conditioned) -> Fix:
    if epoch.free == 0:
        return Fix.NONE
    return Fix.FIXED if epoch.fixed == epoch.free else Fix.PARTIAL if epoch.fixed else Fix.FLOAT
