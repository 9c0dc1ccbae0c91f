"""Rotations of three dimensions as CasADi expressions, differentiable everywhere they are used.

    Exp(phi) = I + s [phi x] + c [phi x]^2,   s = sin a / a,  c = (1 - cos a) / a^2,  a = |phi|

Both sides of a switch between series and closed form are evaluated, so the closed form sees a = 1 where the series counts: no
derivative is then infinite. Conventions are those of `factorgraph.attitude`.

Source: Sola, Deray, Atchuthan (2018), A micro Lie theory for state estimation in robotics, app. B.
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca

SMALL = 1e-3  # squared angle [rad^2] below which series of a few terms are exact to rounding


def exp_so3(phi: ca.SX) -> ca.SX:
    """Rotation matrix (3, 3) of a rotation vector (3,)."""
    return _polynomial(phi, *_coefficients(phi))


def exp_small(phi: ca.SX) -> ca.SX:
    """`exp_so3` by series alone, to 1e-13 up to 0.1 rad: of the Earth's turn, or of what biases change between two states."""
    a2 = ca.dot(phi, phi)
    return _polynomial(phi, _sine_series(a2), _cosine_series(a2))


def _polynomial(phi: ca.SX, s: ca.SX, c: ca.SX) -> ca.SX:
    """I + s [phi x] + c [phi x]^2."""
    scaled = c * phi
    squares = scaled * phi
    return ca.diag(1 - ca.sum1(squares) + squares) + s * ca.skew(phi) + _off_diagonal(scaled, phi)


def _off_diagonal(x: ca.SX, y: ca.SX) -> ca.SX:
    """x y^T of parallel vectors (3,) without its diagonal."""
    xy, xz, yz = x[0] * y[1], x[0] * y[2], x[1] * y[2]
    return ca.vertcat(ca.horzcat(0, xy, xz), ca.horzcat(xy, 0, yz), ca.horzcat(xz, yz, 0))


def turned(phi: ca.SX, x: ca.SX) -> ca.SX:
    """Exp(phi) x (3,), which takes fewer operations than the matrix."""
    s, c = _coefficients(phi)
    across = ca.cross(phi, x)
    return x + s * across + c * ca.cross(phi, across)


def turned_little(phi: ca.SX, x: ca.SX) -> ca.SX:
    """`turned` by series alone, to 1e-13 up to 0.1 rad."""
    a2 = ca.dot(phi, phi)
    across = ca.cross(phi, x)
    return x + _sine_series(a2) * across + _cosine_series(a2) * ca.cross(phi, across)


def _coefficients(phi: ca.SX) -> tuple[ca.SX, ca.SX]:
    """s and c of Exp."""
    a2 = ca.dot(phi, phi)
    small = a2 < SMALL
    a = ca.sqrt(ca.if_else(small, 1, a2))
    s = ca.if_else(small, _sine_series(a2), ca.sin(a) / a)
    return s, ca.if_else(small, _cosine_series(a2), 2 * (ca.sin(a / 2) / a) ** 2)


def _sine_series(a2: ca.SX) -> ca.SX:
    return 1 - a2 * (1 / 6) * (1 - a2 * (1 / 20) * (1 - a2 * (1 / 42)))


def _cosine_series(a2: ca.SX) -> ca.SX:
    return 0.5 - a2 * (1 / 24) * (1 - a2 * (1 / 30) * (1 - a2 * (1 / 56)))


@dataclass(frozen=True, slots=True)
class Turn:
    """A product of rotations, each a matrix (3, 3) or the vector (3,) of a rotation, small ones marked."""

    factors: tuple[tuple[ca.SX, bool], ...] = ()

    def __mul__(self, other: Turn) -> Turn:
        return Turn(self.factors + other.factors)

    @classmethod
    def matrix(cls, C: ca.SX) -> Turn:
        return cls(((C, False),))

    @classmethod
    def by(cls, phi: ca.SX, small: bool = False) -> Turn:
        """Exp(phi)."""
        return cls(((phi, small),))

    def apply(self, x: ca.SX) -> ca.SX:
        """The rotated vector (3,)."""
        for C, small in reversed(self.factors):
            x = C @ x if C.is_square() else (turned_little if small else turned)(C, x)
        return x

    def back(self, x: ca.SX) -> ca.SX:
        """The vector (3,) that `apply` takes to x."""
        for C, small in self.factors:
            x = C.T @ x if C.is_square() else (turned_little if small else turned)(-C, x)
        return x

    def whole(self) -> ca.SX:
        """The rotation matrix (3, 3)."""
        C = ca.SX.eye(3)
        for factor, small in reversed(self.factors):
            C = (factor if factor.is_square() else (exp_small if small else exp_so3)(factor)) @ C
        return C


def log_so3(C: ca.SX) -> ca.SX:
    """Rotation vector (3,), norm below pi, of a rotation matrix (3, 3).

    By the unit quaternion, from whichever of its four components is the largest.
    """
    trace = C[0, 0] + C[1, 1] + C[2, 2]
    square = [1 + trace, *(1 + 2 * C[i, i] - trace for i in range(3))]
    x, y, z = C[2, 1] - C[1, 2], C[0, 2] - C[2, 0], C[1, 0] - C[0, 1]
    xy, xz, yz = C[0, 1] + C[1, 0], C[0, 2] + C[2, 0], C[1, 2] + C[2, 1]
    rows = ((square[0], x, y, z), (x, square[1], xy, xz), (y, xy, square[2], yz), (z, xz, yz, square[3]))
    largest, q = square[0], ca.vertcat(*rows[0])
    for pivot, row in zip(square[1:], rows[1:], strict=True):
        better = pivot > largest
        largest, q = ca.if_else(better, pivot, largest), ca.if_else(better, ca.vertcat(*row), q)
    q = ca.if_else(q[0] < 0, -q, q) / ca.sqrt(ca.dot(q, q))
    w, v = q[0], q[1:]
    n2 = ca.dot(v, v)
    small = n2 < SMALL / 4
    n = ca.sqrt(ca.if_else(small, 1, n2))
    t2 = ca.if_else(small, n2 / ca.if_else(small, w**2, 1), 0)
    series = 1 - t2 * (1 / 3 - t2 * (1 / 5 - t2 * (1 / 7 - t2 / 9)))
    return 2 * v * ca.if_else(small, series / ca.if_else(small, w, 1), ca.atan2(n, w) / n)


def left_jacobian_inverse(phi: ca.SX) -> ca.SX:
    """Inverse (3, 3) of the left Jacobian of a rotation vector (3,), norm below 2 pi."""
    a2 = ca.dot(phi, phi)
    small = a2 < SMALL
    a = ca.sqrt(ca.if_else(small, 1, a2))
    series = (1 + a2 / 60 * (1 + a2 / 42 * (1 + a2 / 40))) / 12
    c = ca.if_else(small, series, (1 - 0.5 * a / ca.tan(a / 2)) / a**2)
    S = ca.skew(phi)
    return ca.SX.eye(3) - 0.5 * S + c * ca.mtimes(S, S)


def wrapped(angle_rad: ca.SX) -> ca.SX:
    """Angle in [-pi, pi)."""
    return angle_rad - 2 * ca.pi * ca.floor((angle_rad + ca.pi) / (2 * ca.pi))
