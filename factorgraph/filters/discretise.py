"""Transition and process noise of a linear system over one interval, exactly.

    dx/dt = F x + w,  w white with density q        x(t + dt) = Phi x(t) + noise of covariance Q

    Phi = exp(F dt),   Q = integral over [0, dt] of exp(F s) q exp(F s)'

Both are the Taylor series of a short step, doubled until the interval is filled:

    Q(h) = sum_k h^k / k! M_k,  M_1 = q,  M_(k+1) = F M_k + M_k F'
    Phi(2h) = Phi(h)^2,         Q(2h) = Phi(h) Q(h) Phi(h)' + Q(h)

which equals the matrix exponential of Van Loan (1978) to rounding, without its matrix of twice the size.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from factorgraph.types import Array

SHORT = 0.5  # norm of F h of the step that is expanded
TERMS = 17  # terms of Q hold both sides, twice the norm: 1 / 17! is below rounding


@njit(cache=True)
def discretise(F: Array, q: Array, dt: float) -> tuple[Array, Array]:
    """Phi (n, n) and Q (n, n) over dt of constant F (n, n) and noise density q (n, n). Source: Van Loan (1978)."""
    n = F.shape[0]
    size = 0.0
    for i in range(n):
        row = 0.0
        for j in range(n):
            row += abs(F[i, j])
        size = max(size, row * dt)
    doublings = 0
    while size > SHORT:
        size *= 0.5
        doublings += 1
    h = dt / 2.0**doublings
    A = F * h
    power, noise = A.copy(), q * h
    Phi, Q = np.eye(n) + power, noise.copy()
    for k in range(2, TERMS):
        AN = A @ noise
        noise = (AN + AN.T) / k
        Q += noise
        power = A @ power / k
        Phi += power
    for _ in range(doublings):
        Q += Phi @ Q @ Phi.T
        Phi = Phi @ Phi
    return Phi, 0.5 * (Q + Q.T)


def gauss_markov_density(sigma: float, tau_s: float) -> float:
    """White-noise density that holds a first-order Gauss-Markov state at standard deviation sigma: 2 sigma^2 / tau."""
    return 2.0 * sigma**2 / tau_s
