"""What may enter: shapes, and the faults the kernels report in words.

Input is copied, so that a read-only array does not make the kernels compile once more.
"""

from __future__ import annotations

from typing import NoReturn

import numpy as np
from numpy.typing import ArrayLike

from ambiguity import _kernels as kernels
from ambiguity.types import Array


def square(Q: ArrayLike) -> Array:
    """A covariance matrix (n, n). Raises ValueError for any other shape."""
    Q = np.array(Q, dtype=np.float64, order="C")
    if Q.ndim != 2 or Q.shape[0] != Q.shape[1]:
        raise ValueError(f"Q must be a square matrix (n, n), got shape {Q.shape}")
    return Q


def pair(a_float: ArrayLike, Q: ArrayLike) -> tuple[Array, Array]:
    """Float ambiguities (n,) and their covariance (n, n). Raises ValueError where the shapes disagree."""
    a, Q = np.array(a_float, dtype=np.float64, order="C"), np.array(Q, dtype=np.float64, order="C")
    if a.ndim != 1:
        raise ValueError(f"a_float must have shape (n,), got {a.shape}")
    if Q.shape != (a.size, a.size):
        raise ValueError(f"Q must have shape {(a.size, a.size)} to match a_float with {a.size} entries, got {Q.shape}")
    return a, Q


def require_sound(a: Array, Q: Array) -> None:
    """Raises ValueError where an entry is not finite or Q is not symmetric with a positive diagonal."""
    code, row, column, value = kernels.check(a, Q)
    if code != kernels.OK:
        raise_fault(code, row, column, value, Q)


def raise_fault(code: int, row: int, column: int, value: float, Q: Array) -> NoReturn:
    """ValueError with the words for a kernel's fault."""
    raise ValueError(fault_text(code, row, column, value, Q))


def fault_text(code: int, row: int, column: int, value: float, Q: Array) -> str:
    """The words for a kernel's fault."""
    if code == kernels.BAD_FLOAT:
        return f"a_float must be finite; a_float[{row}] is {value}"
    if code == kernels.HUGE_FLOAT:
        return f"a_float[{row}] = {value:.3g} cycles is too large to carry a fraction; remove a common offset first"
    if code == kernels.BAD_COVARIANCE:
        return f"Q must be finite; Q[{row}, {column}] or its mirror is not"
    if code == kernels.ASYMMETRIC:
        return f"Q must be symmetric; Q[{row}, {column}] - Q[{column}, {row}] = {value:.3g}"
    if code == kernels.NOT_POSITIVE:
        smallest = np.linalg.eigvalsh(0.5 * (Q + Q.T))[0]
        return (
            f"Q must be positive definite; ambiguity {row} has conditional variance {value:.3g} and the smallest eigenvalue "
            f"is {smallest:.3g} (an ambiguity given twice, or a datum missing?)"
        )
    return f"Q is too ill-conditioned to decorrelate with exact integers; its condition number is {np.linalg.cond(Q):.1e}"


def at_least_one(name: str, value: int) -> int:
    """The option as a whole number. Raises ValueError below 1."""
    if value < 1:
        raise ValueError(f"{name} must be at least 1, got {value}")
    return int(value)
