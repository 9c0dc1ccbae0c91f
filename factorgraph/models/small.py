"""3 x 3 matrices and rotations inside compiled loops: what `attitude` does for arrays, without allocating.

Results go into `out`, which must not be an argument.
"""

from __future__ import annotations

import numpy as np
from numba import njit


@njit(cache=True)
def rotation_coefficients(a2):  # type: ignore[no-untyped-def]
    """sin a / a, (1 - cos a) / a^2, (a - sin a) / a^3."""
    if a2 < 1e-8:
        return 1 - a2 / 6, 0.5 - a2 / 24, 1.0 / 6 - a2 / 120
    a = np.sqrt(a2)
    return np.sin(a) / a, (1 - np.cos(a)) / a2, (a - np.sin(a)) / (a2 * a)


@njit(cache=True)
def jr_coefficients(a2):  # type: ignore[no-untyped-def]
    """b, c of Jr = I - b [x] + c [x]^2 and their derivatives by a, over a."""
    if a2 < 1e-3:
        b, c = 0.5 - a2 / 24 + a2 * a2 / 720, 1.0 / 6 - a2 / 120 + a2 * a2 / 5040
        return b, c, -1.0 / 12 + a2 / 180 - a2 * a2 / 6720, -1.0 / 60 + a2 / 1260 - a2 * a2 / 60480
    a = np.sqrt(a2)
    s, m = np.sin(a), 1 - np.cos(a)
    return m / a2, (a - s) / (a2 * a), (a * s - 2 * m) / (a2 * a2), (a * m - 3 * (a - s)) / (a2 * a2 * a)


@njit(cache=True)
def inverse_coefficients(a2):  # type: ignore[no-untyped-def]
    """c of Jr^-1 = I + [x] / 2 + c [x]^2 and its derivative by a, over a."""
    if a2 < 1e-3:
        return 1.0 / 12 + a2 / 720 + a2 * a2 / 30240, 1.0 / 360 + a2 / 7560 + a2 * a2 / 201600
    a = np.sqrt(a2)
    s, cot = np.sin(a / 2), 1 / np.tan(a / 2)
    return 1 / a2 - cot / (2 * a), (-2 / a2 + cot / (2 * a) + 0.25 / (s * s)) / a2


@njit(cache=True)
def polynomial(x, a, b, c, out):  # type: ignore[no-untyped-def]
    """out = a I + b [x] + c [x]^2."""
    x0, x1, x2 = x[0], x[1], x[2]
    out[0, 0], out[0, 1], out[0, 2] = a - c * (x1 * x1 + x2 * x2), c * x0 * x1 - b * x2, c * x0 * x2 + b * x1
    out[1, 0], out[1, 1], out[1, 2] = c * x0 * x1 + b * x2, a - c * (x0 * x0 + x2 * x2), c * x1 * x2 - b * x0
    out[2, 0], out[2, 1], out[2, 2] = c * x0 * x2 - b * x1, c * x1 * x2 + b * x0, a - c * (x0 * x0 + x1 * x1)


@njit(cache=True)
def apply(A, x, out):  # type: ignore[no-untyped-def]
    """out = A x."""
    for i in range(3):
        out[i] = A[i, 0] * x[0] + A[i, 1] * x[1] + A[i, 2] * x[2]


@njit(cache=True)
def mul(A, B, out):  # type: ignore[no-untyped-def]
    """out = A B."""
    for i in range(3):
        for j in range(3):
            out[i, j] = A[i, 0] * B[0, j] + A[i, 1] * B[1, j] + A[i, 2] * B[2, j]


@njit(cache=True)
def exp(phi, out):  # type: ignore[no-untyped-def]
    """Rotation matrix of a rotation vector."""
    s, c, _ = rotation_coefficients(phi[0] * phi[0] + phi[1] * phi[1] + phi[2] * phi[2])
    polynomial(phi, 1.0, s, c, out)
