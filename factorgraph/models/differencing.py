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

from factorgraph.types import Array, IntArray


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

    def project(self, rows: Array, u: Array) -> Array:
        """Whiten rows (n,) or (n, w) by u (n,) and take out what is common to each group."""
        column = u if rows.ndim == 1 else u[:, None]
        S = self.sum(u * u)
        S = np.where(S > 0, S, 1.0)
        common = self.sum(column * column * rows) / (S if rows.ndim == 1 else S[:, None])
        return column * (rows - common[self.of_row])

    def leverage(self, u: Array) -> Array:
        """Share (n,) of each row in its own group's common value: var(residual) = sigma^2 (1 - leverage)."""
        S = self.sum(u * u)
        return u * u / np.where(S > 0, S, 1.0)[self.of_row]
