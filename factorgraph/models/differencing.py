"""Eliminating what a group of observations has in common: receiver clocks, and with them double differences.

Observations y_i = h_i(x) + c + v_i, v_i ~ N(0, sigma_i^2), share an unknown c (the receiver clock of one epoch and
constellation, or the difference of two clocks). With u_i = 1 / sigma_i, the least-squares elimination of c is the
projection of the whitened rows

    P = I - u u^T / (u^T u).

For single differences between two receivers this is the double-difference model with its full correlated covariance
R_DD = D diag(sigma_i^2) D^T, for any choice of pivot: D^T R_DD^-1 D = W - W 1 1^T W / (1^T W 1), W = diag(u_i^2).
No pivot has to be chosen, and every row keeps the name of its satellite, which robust weights and residual tables need.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from factorgraph.types import Array, BoolArray, IntArray


@njit(cache=True)
def _project(start, rows, u, out):  # type: ignore[no-untyped-def]
    """out = P diag(u) rows for every group of consecutive rows."""
    n, w = rows.shape
    common = np.empty(w)
    for g in range(len(start)):
        a, b = start[g], start[g + 1] if g + 1 < len(start) else n
        total = 0.0
        common[:] = 0.0
        for i in range(a, b):
            weight = u[i] * u[i]
            total += weight
            for c in range(w):
                common[c] += weight * rows[i, c]
        if total > 0:
            for c in range(w):
                common[c] /= total
        for i in range(a, b):
            for c in range(w):
                out[i, c] = u[i] * (rows[i, c] - common[c])


@dataclass(frozen=True, slots=True)
class CommonGroups:
    """Rows sorted by group; group g owns rows start[g] : start[g + 1]."""

    start: IntArray  # (g,)
    of_row: IntArray  # (n,) row -> group

    @classmethod
    def from_labels(cls, label: IntArray) -> CommonGroups:
        """Groups of equal consecutive labels."""
        label = np.asarray(label)
        if label.size == 0:
            return cls(np.zeros(0, np.int64), np.zeros(0, np.int64))
        new = np.concatenate([[True], label[1:] != label[:-1]])
        return cls(np.flatnonzero(new), np.cumsum(new) - 1)

    def sum(self, values: Array) -> Array:
        """Sums over each group, (g, ...)."""
        if len(self.start) == 0:
            return np.zeros((0, *values.shape[1:]))
        total: Array = np.add.reduceat(values, self.start, axis=0)
        return total

    def mean(self, values: Array, u: Array) -> Array:
        """Weighted means of each group (g,), weights u^2; 0 for a group without weight."""
        S = self.sum(u * u)
        return self.sum(u * u * values) / np.where(S > 0, S, 1.0)

    def median(self, values: Array, active: BoolArray) -> Array:
        """Medians of the active values of each group (g,); 0 for a group without any."""
        if len(self.start) == 0:
            return np.zeros(0)
        ordered = values[np.lexsort((values, ~active, self.of_row))]
        count = self.sum(active.astype(np.int64))
        low, high = self.start + np.maximum(count - 1, 0) // 2, self.start + np.minimum(count // 2, np.maximum(count - 1, 0))
        return np.where(count > 0, 0.5 * (ordered[low] + ordered[high]), 0.0)

    def project(self, rows: Array, u: Array) -> Array:
        """Whiten rows (n,) or (n, w) by u (n,) and take out what is common to each group."""
        out = np.empty(rows.shape)
        shape = (len(u), 1 if rows.ndim == 1 else rows.shape[1])
        _project(self.start, np.ascontiguousarray(rows).reshape(shape), u, out.reshape(shape))
        return out

    def leverage(self, u: Array) -> Array:
        """Share (n,) of each row in its own group's common value: var(residual) = sigma^2 (1 - leverage)."""
        S = self.sum(u * u)
        return u * u / np.where(S > 0, S, 1.0)[self.of_row]
