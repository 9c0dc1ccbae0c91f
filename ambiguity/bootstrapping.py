"""Rounding, sequential rounding, and how often they succeed.

    bootstrapped success rate  P = prod_k (2 Phi(1 / (2 sigma_k)) - 1),  sigma_k^2 = D[k]
    ADOP = det(Q)^(1 / 2n)   [cyc],   P <= (2 Phi(1 / (2 ADOP)) - 1)^n

2 Phi(x / 2) - 1 = erf(x / sqrt(8)). The bootstrapped rate of the decorrelated ambiguities is a sharp lower bound of the
rate of integer least squares; ADOP does not depend on the parametrisation, so its formula bounds every bootstrapping.

Source: Teunissen (1998) for the rates, Teunissen and Odijk (1997) for ADOP, Verhagen and Li (2012) for the comparison.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ambiguity import _kernels as kernels
from ambiguity._input import pair, raise_fault, require_sound, square
from ambiguity.decorrelation import decorrelate, factorise
from ambiguity.types import Array, IntArray


@dataclass(frozen=True, slots=True)
class Rounded:
    """Integers and the probability that they are right, the model being right."""

    integers: IntArray  # (n,)
    success_rate: float


def round_each(a_float: ArrayLike, Q: ArrayLike) -> Rounded:
    """Nearest integer of every ambiguity by itself; the success rate is a lower bound.

    a_float (n,) [cyc], Q (n, n) [cyc^2]. Raises ValueError for unusable input. Source: Teunissen (1998).
    """
    a, Q = pair(a_float, Q)
    require_sound(a, Q)
    return Rounded(np.rint(a).astype(np.int64), _product_of_rates(np.diag(Q)))


def bootstrap(a_float: ArrayLike, Q: ArrayLike) -> Rounded:
    """Sequential rounding of the decorrelated ambiguities, the most precise first; the success rate is exact.

    a_float (n,) [cyc], Q (n, n) [cyc^2]. Raises ValueError for unusable input. Source: Teunissen (1998).
    """
    a, Q = pair(a_float, Q)
    require_sound(a, Q)
    offset, remainder = kernels.split(a)
    code, row, value, U, D, Y, z = kernels.reduce_without_Z(remainder, Q)
    if code != kernels.OK:
        raise_fault(code, row, row, value, Q)
    integers = np.empty(a.size, np.int64)
    kernels.restore(Y, kernels.round_sequentially(U, z), offset, integers)
    return Rounded(integers, _product_of_rates(D))


def success_rate(Q: ArrayLike) -> float:
    """Bootstrapped success rate after decorrelation: a lower bound of integer least squares. Q (n, n) [cyc^2].

    Raises ValueError where Q is not finite, symmetric and positive definite.
    """
    return _product_of_rates(decorrelate(Q).D)


def adop(Q: ArrayLike) -> float:
    """Ambiguity dilution of precision [cyc]; below about 0.14 cycles the success rate exceeds 0.999.

    Q (n, n) [cyc^2] with n > 0. Raises ValueError where Q is not finite, symmetric and positive definite.
    Source: Teunissen and Odijk (1997).
    """
    if len(square(Q)) == 0:
        raise ValueError("ADOP is defined for at least one ambiguity, Q is empty")
    return math.exp(0.5 * float(np.mean(np.log(factorise(Q)[1]))))


def adop_success_rate(adop_cyc: float, n: int) -> float:
    """Upper bound of the bootstrapped success rate of n ambiguities with this ADOP [cyc]."""
    if not adop_cyc > 0 or n < 0:
        raise ValueError(f"ADOP must be positive and n not negative, got {adop_cyc} and {n}")
    return math.erf(1.0 / (math.sqrt(8.0) * adop_cyc)) ** n


def _product_of_rates(variances: Array) -> float:
    return float(kernels.trailing_success(np.ascontiguousarray(variances))[0])
