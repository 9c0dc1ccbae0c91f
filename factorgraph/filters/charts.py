"""Coordinates of a vehicle's error: how a correction moves attitude, position and velocity, and what becomes of covariances.

Covariances are about the columns of `assembly.variables` at the current estimate, R Exp(theta), r + R rho, v + nu. A chart moves
a state by such an x = (theta, rho, nu), and has errors about the state before become errors about the one after, y = T x:

    body          R Exp(theta), r + R rho, v + nu                  T = diag(Jr(theta), Exp(-theta), I)
    Euler         pitch, roll, heading + inv(B) theta; r, v as above    T = diag(B+ inv(B), R+' R, I)
    invariant     Exp(phi) (R, r, v) of SE_2(3), phi = R theta     T = A+ inv(A)

`body` is the error state of an ESKF. `Euler` is the total state of a plain EKF, whose covariance stays with the angles: B takes
their rates to body rates, theta = B d(angles), and is singular where the nose points straight up. `invariant` keeps the
covariance of the right-invariant error (phi, xi_v, xi_r), x = A (phi, xi_v, xi_r):

    theta = R' phi,   nu = xi_v - v x phi,   rho = R' (xi_r - r x phi)
    R+ = Exp(phi) R,  v+ = Exp(phi) v + Jl(phi) xi_v = v + Jl(phi) nu,   r+ = r + Jl(phi) R rho

Its transition inv(A+) F A does not depend on the estimate but by the biases and the Earth's turn. Corrections do not depend on
where the origin lies. What fixes of positions in n have told, `body` keeps when the attitude is corrected, and `invariant` does
not: T lets positions turn with what the correction moved.

Source: Barrau and Bonnabel (2017), The invariant extended Kalman filter as a stable observer; Hartley et al. (2020) for biases
beside the group; Markley (2003), Attitude error representations for Kalman filtering.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np

from factorgraph.attitude import euler_from_matrix, exp_so3, matrix_from_euler, right_jacobian, skew
from factorgraph.models.imu_interval import States
from factorgraph.types import Array

TURN, MOVED, SPEED = slice(0, 3), slice(3, 6), slice(6, 9)


class Chart(Protocol):
    """Coordinates of an error."""

    def move(self, at: States, x: Array) -> tuple[States, Array]:
        """States (m) moved by x (m, 9), and T (m, 9, 9)."""


def _transposed(R: Array) -> Array:
    return np.swapaxes(R, 1, 2)


def _times(A: Array, x: Array) -> Array:
    return np.asarray((A @ x[..., None])[..., 0])


class Body:
    """Attitude turned on the right, position along body axes, which turn.

    What is known of two vehicles' difference would not survive with axes that do not.
    """

    def move(self, at: States, x: Array) -> tuple[States, Array]:
        """As `Chart`."""
        T = np.tile(np.eye(9), (len(x), 1, 1))
        turn = exp_so3(x[:, TURN])
        T[:, TURN, TURN], T[:, MOVED, MOVED] = right_jacobian(x[:, TURN]), _transposed(turn)
        return States(at.R @ turn, at.r_n + _times(at.R, x[:, MOVED]), at.v_n + x[:, SPEED]), T


def by_angles(R: Array) -> Array:
    """B (m, 3, 3): a small turn about body axes by pitch, roll and heading."""
    _, roll, _ = euler_from_matrix(R)
    zero, one = np.zeros_like(roll), np.ones_like(roll)
    pitch = np.stack([np.cos(roll), zero, np.sin(roll)], axis=1)
    return np.stack([pitch, np.stack([zero, one, zero], axis=1), -R[:, 2, :]], axis=2)


class Euler:
    """Pitch, roll and heading corrected by addition."""

    def move(self, at: States, x: Array) -> tuple[States, Array]:
        """As `Chart`."""
        inverse = np.asarray(np.linalg.inv(by_angles(at.R)), float)
        d = _times(inverse, x[:, TURN])
        R = matrix_from_euler(*(angle + d[:, i] for i, angle in enumerate(euler_from_matrix(at.R))))
        T = np.tile(np.eye(9), (len(x), 1, 1))
        T[:, TURN, TURN], T[:, MOVED, MOVED] = by_angles(R) @ inverse, _transposed(R) @ at.R
        return States(R, at.r_n + _times(at.R, x[:, MOVED]), at.v_n + x[:, SPEED]), T


class Invariant:
    """The group of attitude, position and velocity, perturbed from the left."""

    def move(self, at: States, x: Array) -> tuple[States, Array]:
        """As `Chart`."""
        phi = _times(at.R, x[:, TURN])
        left = right_jacobian(-phi)
        dr, dv = _times(left, _times(at.R, x[:, MOVED])), _times(left, x[:, SPEED])
        R = exp_so3(phi) @ at.R
        T = np.tile(np.eye(9), (len(x), 1, 1))
        back = _transposed(R)
        T[:, TURN, TURN] = T[:, MOVED, MOVED] = back @ at.R
        T[:, MOVED, TURN], T[:, SPEED, TURN] = -back @ skew(dr) @ at.R, -skew(dv) @ at.R
        return States(R, at.r_n + dr, at.v_n + dv), T


BODY, EULER, INVARIANT = Body(), Euler(), Invariant()
