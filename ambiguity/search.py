"""Exact integer least squares.

    minimise (a_float - a)' inv(Q) (a_float - a) over integer vectors a

by decorrelation and a depth-first search that shrinks with the candidates found. The result is proven when the whole
tree inside the last radius has been visited; a budget of nodes bounds the time, and a result it cut short says so.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ambiguity import _kernels as kernels
from ambiguity._input import at_least_one, pair, raise_fault
from ambiguity.types import Array, IntArray

MAX_NODES = 50_000_000  # about a second


@dataclass(frozen=True, slots=True)
class IlsResult:
    """The nearest integer vectors, best first."""

    candidates: IntArray  # (k, n)
    norms: Array  # (k,) squared distances in the metric of inv(Q)
    proven: bool  # no nearer vector exists
    nodes: int  # integers tried


def integer_least_squares(a_float: ArrayLike, Q: ArrayLike, n_candidates: int = 2, max_nodes: int = MAX_NODES) -> IlsResult:
    """The `n_candidates` integer vectors nearest to a_float.

    Parameters
    ----------
    a_float : (n,) float ambiguities [cyc], of any size up to 2e15
    Q : (n, n) their covariance [cyc^2]
    n_candidates : how many to return; for n = 0 the only vector, the empty one, is returned
    max_nodes : integers to try before giving up the proof

    Raises ValueError where Q is not finite, symmetric and positive definite, where shapes disagree, and where Q is too
    ill-conditioned for exact integers. Source: Teunissen (1995); Chang, Yang and Zhou (2005). Ties keep the first found.
    """
    a, Q = pair(a_float, Q)
    k, budget = at_least_one("n_candidates", n_candidates), at_least_one("max_nodes", max_nodes)
    if a.size == 0:
        return IlsResult(np.zeros((1, 0), np.int64), np.zeros(1), True, 0)
    code, row, column, value, candidates, norms, proven, nodes = kernels.integer_least_squares(a, Q, k, budget)
    if code != kernels.OK:
        raise_fault(code, row, column, value, Q)
    return IlsResult(candidates, norms, proven, nodes)
