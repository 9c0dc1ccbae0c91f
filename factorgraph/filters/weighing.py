"""Robust weights of a stage's rows with the problem's losses; and whether a filter still knows anything.

Weights start with innovations: nu of a row, in standard deviations of a single measurement, has variance p^2 (H P H') + 1, p the
row's persistence, and the clocks are the medians of theirs. What all rows share, a manoeuvre that the prediction did not expect,
hides there what one of them has of its own, such as a slip of a cycle. The weights are therefore found again a few times by the
residuals that an update with the present ones leaves, as a batch finds them (`assembly.blocks.Block.reweight`).

Rows that were whitened by u, with the mean of weights u^2 taken out, become rows of weights w u^2 by whitening with sqrt(w) u
and taking out the mean once more: what was common is common to both.

A filter has diverged where most rows of most stages in a while are off by many standard deviations of their innovations.

Source: spec common.md W1 for weights by predicted residuals; Huber (1981), ch. 7, for finding them again.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from factorgraph.assembly.blocks import KINDS
from factorgraph.assembly.optimizer import Graph
from factorgraph.filters import kalman
from factorgraph.filters.sequential import StageRows
from factorgraph.models.differencing import CommonGroups
from factorgraph.models.robust import Loss
from factorgraph.models.robust import weight as robust_weight
from factorgraph.types import Array, BoolArray, IntArray

LEAST = 1e-8  # weight
LEAST_SHARE = 0.05  # of a row beside its common clock
ROUNDS, STEADY = 3, 0.02  # of weights; their change that is none
COUNTS = 0.5  # weight from which on a row is one of the stage's
OFF, WHILE, LEAST_WHILE = 10.0, 50, 20  # standard deviations that are too many; stages, and of a flight that is shorter


@dataclass(frozen=True, slots=True)
class Whitening:
    """How a stage's rows were whitened."""

    u: Array  # (m,) one over the standard deviation
    clocks: CommonGroups
    shared: BoolArray  # (m,) rows from which a clock was taken out
    persistence: Array  # (m,)

    @classmethod
    def of(cls, graph: Graph, rows: StageRows) -> Whitening:
        m = len(rows.e)
        u, label, shared, persistence = np.ones(m), np.arange(m), np.zeros(m, bool), np.ones(m)
        done = 0
        for number, i, j in rows.at:
            table, own = graph.blocks[number].rows, slice(done, done + j - i)
            u[own], persistence[own] = 1 / table.sigma[i:j], np.broadcast_to(table.persistence, len(table.sigma))[i:j]
            if table.clocks is not None:
                shared[own] = True
                of_row = table.clocks.of_row[i:j]
                label[own] = done + of_row - of_row[0]  # a clock of this factor ends before the next one's first row
            done += j - i
        return cls(u, CommonGroups.from_labels(label), shared, persistence)

    def again(self, x: Array, w: Array) -> Array:
        """Whitened rows x (m,) or (m, n) with weights w (m,)."""
        by = self.u if x.ndim == 1 else self.u[:, None]
        root = np.sqrt(w)
        out = self.clocks.project(x / by, root * self.u)
        alone = ~self.shared
        out[alone] = x[alone] * (root[alone] if x.ndim == 1 else root[alone, None])
        return out

    def about(self, e: Array, centre: Array) -> Array:
        """Whitened rows e (m,) about other clocks (g,)."""
        return np.where(self.shared, e - self.u * centre[self.clocks.of_row], e)


@dataclass(frozen=True, slots=True)
class Weighed:
    """Rows of a stage with robust weights."""

    rows: StageRows
    e: Array  # (m,) innovations
    w: Array  # (m,)
    whitening: Whitening

    def again(self, x: Array) -> Array:
        """Other whitened rows (m,) or (m, n) of the stage, weighed alike."""
        return self.whitening.again(x, self.w)


def normalised(e: Array, rows: StageRows, P: Array, bent: Array, persistence: Array | float = 1.0) -> Array:
    """Innovations (m,) over their standard deviations, of single measurements; P (n, n) predicted.

    bent (m,): variance that models add which are not linear.
    """
    known = np.einsum("mi,mi->m", rows.H @ P, rows.H) + bent
    return np.asarray(e * persistence / np.sqrt(persistence**2 * known + np.maximum(rows.share, LEAST_SHARE)))


def weigh(graph: Graph, rows: StageRows, e: Array, P: Array, bent: Array, losses: Mapping[str, Loss]) -> Weighed | None:
    """Weights of a stage's innovations e (m,), `normalised` with P and `bent`; None where all are one."""
    used = [k for k, name in enumerate(KINDS) if name in losses and np.any(rows.kind == k)]
    if not used:
        return None
    whitening = Whitening.of(graph, rows)
    of_single = normalised(np.ones(len(e)), rows, P, bent, whitening.persistence)
    centre = whitening.clocks.median(e / whitening.u, np.ones(len(e), bool))
    w = _weights(whitening.about(e, centre) * of_single, rows.kind, used, losses)
    apart = 1 / np.sqrt(1 + bent)
    of_residual = whitening.persistence / np.sqrt(np.maximum(rows.share, LEAST_SHARE) + whitening.persistence**2 * bent)
    for _ in range(ROUNDS):
        H = whitening.again(rows.H, w) * apart[:, None]
        left = e - rows.H @ kalman.update_white(P, whitening.again(e, w) * apart, H)[0]
        centre = whitening.clocks.mean(left / whitening.u, np.sqrt(w) * whitening.u)
        before, w = w, _weights(whitening.about(left, centre) * of_residual, rows.kind, used, losses)
        if np.all(np.abs(w - before) < STEADY):
            break
    if np.all(w > 1 - STEADY):
        return None
    share = np.where(whitening.shared, 1 - whitening.clocks.leverage(np.sqrt(w) * whitening.u), 1.0)
    judged = rows.judged & (w > COUNTS)
    lost = float(np.sum((1 - share)[judged]))
    of_rows = replace(rows, e=whitening.again(rows.e, w), H=whitening.again(rows.H, w), share=share)
    return Weighed(replace(of_rows, judged=judged, judged_clocks=lost), whitening.again(e, w), w, whitening)


def _weights(t: Array, kind: IntArray, used: list[int], losses: Mapping[str, Loss]) -> Array:
    w = np.ones(len(t))
    for k in used:
        mine = kind == k
        w[mine] = np.maximum(robust_weight(losses[KINDS[k]], t[mine]), LEAST)
    return w


@dataclass(slots=True)
class Watch:
    """Whether innovations and covariances stay what they should be, and when they first were not."""

    trouble: str = ""
    _typical: deque[float] = field(default_factory=lambda: deque(maxlen=WHILE))

    def see(self, t_s: float, e: Array, rows: StageRows, P: Array, bent: Array) -> None:
        """Innovations e (m,) of a stage, `normalised` with P and `bent`."""
        measured = rows.kind >= 0
        if self.trouble or not np.any(measured):
            return
        self._typical.append(float(np.median(np.abs(normalised(e, rows, P, bent)[measured]))))
        if len(self._typical) == WHILE:
            self.judge(t_s)

    def judge(self, t_s: float) -> None:
        """Look back from a time; at the end of a flight, too."""
        n = len(self._typical)
        if not self.trouble and n >= LEAST_WHILE and np.median(self._typical) > OFF:
            self.trouble = f"the filter diverged: most innovations of the {n} epochs until {t_s:.2f} s exceed {OFF:.0f} sigma"

    def failed(self, t_s: float) -> None:
        """An update that cannot be used."""
        if not self.trouble:
            self.trouble = f"the filter broke down at {t_s:.2f} s: what an update leaves is not finite or no covariance"
