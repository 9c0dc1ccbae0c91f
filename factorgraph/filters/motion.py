"""Constant acceleration in three axes: position, velocity, acceleration, driven by white noise on the acceleration.

    r <- r + T v + T^2/2 a,   v <- v + T a,   a <- a + w,   var w = T s^2

with s the random walk of the acceleration [m/s^2 per sqrt(s)]. The noise that w has already integrated into position and
velocity within the step is left out unless `full`: then Q is s^2 times the exact integral, [T^5/20 T^4/8 T^3/6; .. T^3/3
T^2/2; .. T] per axis. Source: Bar-Shalom et al. (2001), sec. 6.2.3; Wu et al. (2022), eqs. 17 to 19, without.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from factorgraph.types import Array


@njit(cache=True)
def constant_acceleration(dt: float, accel_walk: float, full: bool = False) -> tuple[Array, Array]:
    """Transition (9, 9) and noise covariance (9, 9) over dt [s]; accel_walk in m/s^2 per sqrt(s)."""
    Phi, Q = np.eye(9), np.zeros((9, 9))
    q = accel_walk**2
    for i in range(3):
        v, a = 3 + i, 6 + i
        Phi[i, v] = Phi[v, a] = dt
        Phi[i, a] = 0.5 * dt * dt
        Q[a, a] = q * dt
        if full:
            Q[i, i], Q[v, v] = q * dt**5 / 20, q * dt**3 / 3
            Q[i, v] = Q[v, i] = q * dt**4 / 8
            Q[i, a] = Q[a, i] = q * dt**3 / 6
            Q[v, a] = Q[a, v] = q * dt**2 / 2
    return Phi, Q
