"""One measurement update of a filter as plain arrays: what a judgement and a correction need of it.

    z = h(x) + v,   cov v = R;   rows h_j = H_j x, but some may be distances, h_j = s |D x + d| + G x

x is whatever vector the filter estimates: a total state, or deviations from a mean. The prior N(x_prior, P_prior) and the
posterior N(x_post, P_post) are the filter's own.

Source: spec ahrs_tdo.md 2.4; its erratum E19 for rows that are not linear.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from swarm.types import Array

IntArray = NDArray[np.intp]


def _no_rows() -> IntArray:
    return np.zeros(0, np.intp)


@dataclass(frozen=True, slots=True)
class Snapshot:
    """An update with n states and m rows, q of them distances. Raises ValueError for shapes or rows that do not fit."""

    x_prior: Array  # (n,)
    P_prior: Array  # (n, n)
    x_post: Array  # (n,)
    P_post: Array  # (n, n)
    z: Array  # (m,)
    R: Array  # (m, m)
    H: Array  # (m, n) rows of distances hold their Jacobian at x_prior
    norm_rows: IntArray = field(default_factory=_no_rows)  # (q,) which rows are distances
    norm_D: Array = field(default_factory=lambda: np.zeros((0, 3, 0)))  # (q, 3, n)
    norm_d: Array = field(default_factory=lambda: np.zeros((0, 3)))  # (q, 3)
    norm_scale: Array = field(default_factory=lambda: np.zeros(0))  # (q,)
    norm_G: Array | None = None  # (q, n) what distances hold besides, such as biases; None for nothing
    dof: float | None = None  # that the rows have of the innovation's chi-square; None for m

    def __post_init__(self) -> None:
        n, m, q = len(self.x_prior), len(self.z), len(self.norm_rows)
        expected = {"P_prior": (n, n), "x_post": (n,), "P_post": (n, n), "R": (m, m), "H": (m, n)}
        if q:
            expected |= {"norm_D": (q, 3, n), "norm_d": (q, 3), "norm_scale": (q,)}
        if self.norm_G is not None:
            expected["norm_G"] = (q, n)
        for name, shape in expected.items():
            if getattr(self, name).shape != shape:
                raise ValueError(f"{name} must have shape {shape}, got {getattr(self, name).shape}")
        if not m:
            raise ValueError("a snapshot needs at least one row, got z of shape (0,)")
        if q and not (0 <= self.norm_rows.min() and self.norm_rows.max() < m and len(set(self.norm_rows.tolist())) == q):
            raise ValueError(f"norm_rows must be different rows below {m}, got {self.norm_rows.tolist()}")

    @property
    def n(self) -> int:
        """Number of states."""
        return len(self.x_prior)

    @property
    def m(self) -> int:
        """Number of rows."""
        return len(self.z)

    @property
    def innovation(self) -> Array:
        """z - h(x_prior) (m,)."""
        return np.asarray(self.z - self.h(self.x_prior[None])[0])

    @property
    def residual(self) -> Array:
        """z - h(x_post) (m,)."""
        return np.asarray(self.z - self.h(self.x_post[None])[0])

    @property
    def S(self) -> Array:
        """Covariance (m, m) of the innovation."""
        return self.H @ self.P_prior @ self.H.T + self.R

    @property
    def linear(self) -> Array:
        """Rows (m, n) without their distances: h = linear x + s |D x + d|."""
        H = self.H.copy()
        H[self.norm_rows] = 0.0 if self.norm_G is None else self.norm_G
        return H

    @property
    def seen(self) -> IntArray:
        """States (any,) that some row depends on."""
        depends = np.any(self.linear != 0.0, axis=0)
        if len(self.norm_rows):
            depends |= np.any(self.norm_D != 0.0, axis=(0, 1))
        return np.flatnonzero(depends)

    def h(self, X: Array) -> Array:
        """Predicted measurements (k, m) of states X (k, n)."""
        h = X @ self.linear.T
        if len(self.norm_rows):
            h[:, self.norm_rows] += self.norm_scale * np.linalg.norm(self._arms(X), axis=2)
        return h

    def jacobian(self, x: Array) -> Array:
        """dh/dx (m, n) at x (n,); a distance that is zero has none."""
        if not len(self.norm_rows):
            return self.H
        H = self.linear
        arm = self._arms(x[None])[0]
        unit = arm / np.maximum(np.linalg.norm(arm, axis=1), np.finfo(float).tiny)[:, None]
        H[self.norm_rows] += self.norm_scale[:, None] * np.einsum("qi,qin->qn", unit, self.norm_D)
        return H

    def _arms(self, X: Array) -> Array:
        """D x + d, (k, q, 3)."""
        return np.asarray(np.einsum("qin,kn->kqi", self.norm_D, X) + self.norm_d)
