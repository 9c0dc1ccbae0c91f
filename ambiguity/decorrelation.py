"""Factorisation and decorrelation of the covariance of float ambiguities.

    Q[order][:, order] = U D U'        U unit upper triangular, D conditional variances
    z = Z a,   Qz = Z Q Z' = U D U'    Z and its inverse integer, determinant +-1

D[k] is the variance of z[k] given all later entries. With L = U' this is the L' D L of the literature. Integer Gauss
steps bring |U[k, i]| to at most one half and exchanges of neighbours bring the small variances to the end, which levels
the spectrum: the search then visits few integers and sequential rounding succeeds more often.

Source: de Jonge and Tiberius (1996); Teunissen (1995).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ambiguity import _kernels as kernels
from ambiguity._input import raise_fault, require_sound, square
from ambiguity.types import Array, IntArray


@dataclass(frozen=True, slots=True)
class Decorrelation:
    """An integer change of variables z = Z a and the factors of its covariance U diag(D) U'."""

    Z: IntArray  # (n, n) unimodular
    Z_inv: IntArray  # (n, n) exact inverse
    U: Array  # (n, n) unit upper triangular, off-diagonal at most one half
    D: Array  # (n,) [cyc^2] variance of z[k] given z[k + 1:]

    @property
    def covariance(self) -> Array:
        """Z Q Z', shape (n, n) [cyc^2]."""
        return np.asarray((self.U * self.D) @ self.U.T)


def factorise(Q: ArrayLike) -> tuple[Array, Array, IntArray]:
    """Factors of a covariance with the smallest conditional variance last.

    Returns U (n, n), D (n,), order (n,) with Q[order][:, order] = U diag(D) U'. Raises ValueError where Q is not finite,
    symmetric and positive definite. Source: Chang, Yang and Zhou (2005) for the symmetric pivoting.
    """
    Q = square(Q)
    require_sound(np.zeros(len(Q)), Q)
    code, row, value, U, D, order = kernels.factorise(Q)
    if code != kernels.OK:
        raise_fault(code, row, row, value, Q)
    return U, D, order


def decorrelate(Q: ArrayLike) -> Decorrelation:
    """Unimodular Z that levels the conditional variances of Q (n, n) [cyc^2].

    Raises ValueError where Q is not finite, symmetric and positive definite, or where Z would outgrow exact integers.
    """
    Q = square(Q)
    n = len(Q)
    a = np.zeros(n)
    require_sound(a, Q)
    code, row, value, UZ, D, Y, _ = kernels.reduce(a, Q)
    if code != kernels.OK:
        raise_fault(code, row, row, value, Q)
    return Decorrelation(UZ[:, n:].astype(np.int64), np.ascontiguousarray(Y.T.astype(np.int64)), UZ[:, :n].copy(), D)
