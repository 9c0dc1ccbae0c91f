"""Points that carry a mean and a covariance through a nonlinear function, in deviations from a reference.

Around a mean, with P = L L', stand 2n points at d = +-gamma L e_i beside the reference d = 0, each of the 2n with weight w:

    unscented    gamma^2 = alpha^2 (n + kappa),  w = 1 / (2 gamma^2)
    cubature     gamma^2 = n,                    w = 1 / (2 n)

Images y_0 (of the reference) and y_i enter as differences from y_0, before anything is squared: ranges of 2.2e7 m then lose
nothing, and the unscented centre's weight, -1e6 for alpha = 1e-3, drops out. With delta = w sum (y_i - y_0)

    mean        y_0 + delta
    covariance  w sum (y_i - y_0)(y_i - y_0)' + (beta - alpha^2) delta delta'       unscented
                w sum (y_i - y_0 - delta)(y_i - y_0 - delta)'                       cubature

for the centre's weights Wm = 1 - 2 n w and Wc = Wm + 1 - alpha^2 + beta. As w gamma^2 = 1 / 2, the odd part of the images

    G = sqrt(w / 2) [.., y_(i+) - y_(i-), ..]                (m, n)

is what a linear function would do to L, G = H L: `L G'` is the cross covariance and G L^-1 the slope of statistical
linearisation. The even part E, with a column of delta, is what remains, covariance = G G' + E E': it is positive
semi-definite by construction wherever the last column is not to be taken off, which only happens for alpha^2 > beta with
2 n w > 1.

Source: Julier (2002), The scaled unscented transformation; Arasaratnam and Haykin (2009), Cubature Kalman filters;
Lefebvre et al. (2002) for the statistical linearisation; spec common.md F3 and F5, erratum E1 of deep_bds_ins.md.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numba import njit

from factorgraph.errors import InputError
from factorgraph.filters import kalman
from factorgraph.types import Array

REORDERED = {"reassoc"}  # sums of products may be taken in any order
Images = Callable[[Array], Array]  # deviations (s, n) -> images (s, m)


@dataclass(frozen=True, slots=True)
class Rule:
    """Where points stand, in standard deviations, their weight, and how the mean's shift delta enters the covariance."""

    gamma: float
    weight: float
    shifted: bool  # whether points are taken from the mean, not from the reference
    shift: float  # coefficient of delta delta' besides

    @property
    def sign(self) -> float:
        """Of the last column of the even part."""
        return 1.0 if self.shift >= 0 else -1.0


def unscented(n: int, alpha: float = 1.0, beta: float = 2.0, kappa: float = 0.0) -> Rule:
    """The scaled unscented transform of n dimensions. Raises InputError where points would not spread."""
    gamma2 = alpha**2 * (n + kappa)
    if not gamma2 > 0:
        raise InputError(f"unscented transform: alpha^2 (n + kappa) must be positive, got alpha {alpha} and kappa {kappa}, n {n}")
    bend, shifted = beta - alpha**2, beta < alpha**2
    return Rule(np.sqrt(gamma2), 0.5 / gamma2, shifted, bend + (2 - n / gamma2 if shifted else 0.0))


def cubature(n: int) -> Rule:
    """The third-degree spherical-radial rule of n dimensions."""
    return Rule(np.sqrt(n), 0.5 / n, True, 0.0)


@njit(cache=True, error_model="numpy")
def spread(L: Array, gamma: float) -> Array:
    """Deviations (2n + 1, n): none, then + and - gamma along each column of L (n, n)."""
    n = len(L)
    D = np.zeros((2 * n + 1, n))
    for j in range(n):
        for i in range(j, n):
            D[1 + j, i] = gamma * L[i, j]
            D[1 + n + j, i] = -D[1 + j, i]
    return D


@njit(cache=True, error_model="numpy")
def parts(Y: Array, weight: float, shifted: bool, shift: float) -> tuple[Array, Array, Array]:
    """Mean (m,), odd part G (m, n) and even part E (m, n + 1) of images Y (2n + 1, m); the last column of E is of delta."""
    m, n = Y.shape[1], len(Y) // 2
    mean, G, E = np.zeros(m), np.empty((m, n)), np.empty((m, n + 1))
    half = np.sqrt(0.5 * weight)
    for j in range(n):
        for i in range(m):
            a, b = Y[1 + j, i] - Y[0, i], Y[1 + n + j, i] - Y[0, i]
            mean[i] += weight * (a + b)
            G[i, j] = half * (a - b)
            E[i, j] = half * (a + b)
    scale, off = np.sqrt(abs(shift)), 2 * half if shifted else 0.0
    for i in range(m):
        delta = mean[i]
        for j in range(n):
            E[i, j] -= off * delta
        E[i, n] = scale * delta
        mean[i] = Y[0, i] + delta
    return mean, G, E


@njit(cache=True, error_model="numpy", fastmath=REORDERED)
def product(A: Array, B: Array) -> Array:
    """A B' (m, k) of A (m, n) and B (k, n), which are small."""
    out = np.empty((len(A), len(B)))
    for i in range(len(A)):
        for j in range(len(B)):
            total = 0.0
            for k in range(A.shape[1]):
                total += A[i, k] * B[j, k]
            out[i, j] = total
    return out


@dataclass(frozen=True, slots=True)
class Spread:
    """What a function does to a distribution: mean (m,), odd part G (m, n), even part E (m, n + 1), sign of its last column."""

    mean: Array
    G: Array
    E: Array
    sign: float

    @property
    def covariance(self) -> Array:
        """(m, m)."""
        return product(self.G, self.G) + self.curvature

    @property
    def curvature(self) -> Array:
        """Covariance (m, m) that no linear function explains."""
        return curvature(self.E, self.sign)


def through(images: Images, L: Array, rule: Rule) -> Spread:
    """Send deviations of covariance L L' (n, n) through a function; `images` sees all points (2n + 1, n) at once."""
    Y = images(spread(L, rule.gamma))
    return Spread(*parts(Y, rule.weight, rule.shifted, rule.shift), rule.sign)


@njit(cache=True, error_model="numpy")
def root(P: Array) -> Array:
    """Lower triangular L (n, n) with L L' = P. Raises LinAlgError where P is not positive definite."""
    n = len(P)
    L = np.zeros((n, n))
    for i in range(n):
        for j in range(i + 1):
            total = P[i, j]
            for k in range(j):
                total -= L[i, k] * L[j, k]
            if i > j:
                L[i, j] = total / L[j, j]
            elif total > 0.0:
                L[i, i] = np.sqrt(total)
            else:
                raise np.linalg.LinAlgError("the covariance is not positive definite")
    return L


@njit(cache=True, error_model="numpy")
def slope(L: Array, G: Array) -> Array:
    """H (m, n) with H L = G."""
    H = G.copy()
    for i in range(len(H)):
        for j in range(H.shape[1] - 1, -1, -1):
            H[i, j] /= L[j, j]
            c = H[i, j]
            for k in range(j):
                H[i, k] -= c * L[j, k]
    return H


@njit(cache=True, error_model="numpy", fastmath=REORDERED)
def curvature(E: Array, sign: float) -> Array:
    """E E' (m, m), the last column of E (m, k) with a sign."""
    m, last = E.shape[0], E.shape[1] - 1
    out = np.empty((m, m))
    for i in range(m):
        for j in range(i + 1):
            total = sign * E[i, last] * E[j, last]
            for k in range(last):
                total += E[i, k] * E[j, k]
            out[i, j] = out[j, i] = total
    return out


def lower(A: Array) -> Array:
    """Lower triangular L (n, n), positive diagonal, with L L' = A A' for A (n, k), k >= n: square roots without squares."""
    W, n = np.ascontiguousarray(A.T), len(A)
    kalman.compress(np.zeros(len(W)), W)
    return np.asarray((W[:n] * np.sign(np.diag(W))[:, None]).T)


@njit(cache=True, error_model="numpy")
def downdate(L: Array, x: Array) -> Array:
    """Lower triangular root of L L' - x x'. Raises LinAlgError where that is not positive definite.

    Source: Golub and Van Loan (2013), sec. 6.5.4, hyperbolic rotations.
    """
    n = len(x)
    L, x = L.copy(), x.copy()
    for k in range(n):
        r2 = (L[k, k] - x[k]) * (L[k, k] + x[k])
        if not r2 > 0.0:
            raise np.linalg.LinAlgError("taking that much off leaves no positive definite covariance")
        r = np.sqrt(r2)
        c, s = r / L[k, k], x[k] / L[k, k]
        L[k, k] = r
        for i in range(k + 1, n):
            L[i, k] = (L[i, k] - s * x[i]) / c
            x[i] = c * x[i] - s * L[i, k]
    return L


def rooted(columns: list[Array], sign: float = 1.0) -> Array:
    """Lower triangular root of the sum of C C' over `columns`; with a negative sign the very last column is taken off."""
    A = np.hstack(columns)
    if sign > 0:
        return lower(A)
    return downdate(lower(A[:, :-1]), A[:, -1])
