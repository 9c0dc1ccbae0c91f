"""Test functions with known optima, to be shifted, rotated and moved: compiled costs.

All are zero at their optimum and positive elsewhere. With z the point and n >= 2:

    sphere      sum z_i^2
    ellipsoid   sum 10^(6 (i - 1)/(n - 1)) z_i^2
    rosenbrock  sum 100 (z_(i+1) - z_i^2)^2 + (1 - z_i)^2
    rastrigin   sum z_i^2 + 10 (1 - cos 2 pi z_i)
    ackley      20 (1 - exp(-0.2 |z|/sqrt n)) + e - exp(mean cos 2 pi z_i)
    griewank    1 + |z|^2/4000 - prod cos(z_i/sqrt i)
    schwefel    sum c - z_i sin sqrt|z_i|, z_i held at +-500 and the square of what exceeds it added
    levy        sin^2 pi w_1 + sum_(i<n) (w_i - 1)^2 (1 + 10 sin^2(pi w_i + 1)) + (w_n - 1)^2 (1 + sin^2 2 pi w_n),
                w = 1 + (z - 1)/4

An instance places the optimum at x_best and turns the coordinates: z = z_best + C (x - x_best), C orthogonal. Its bounds are
the usual box unless it is moved, box and all, by an offset: what then changes the outcome is a search that knows the origin.

Source: Rosenbrock (1960); Ackley (1987); Griewank (1981); Schwefel (1981); Mühlenbein et al. (1991), Rastrigin's function
generalised; Levy and Montalvo (1985); Hansen et al. (2009) for the ellipsoid and for turning; Mezzadri (2007) for random
orthogonal matrices. Schwefel's function is lower outside its box; that it is held there is ours.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numba import njit

from swarm.compiled import CompiledCost
from swarm.types import Array

CONDITION_EXPONENT = 6.0  # of the ellipsoid
SCHWEFEL_Z, SCHWEFEL_LEVEL, SCHWEFEL_EDGE = 420.9687462275036, 418.9828872724338, 500.0
MIDDLE = 0.8  # part of the box, about its centre, in which optima are placed


@njit(cache=True, error_model="numpy")
def sphere(z: Array) -> float:
    """Sum of squares."""
    return float(np.sum(z * z))


@njit(cache=True, error_model="numpy")
def ellipsoid(z: Array) -> float:
    """Sum of squares with weights from 1 to 10^6."""
    total = 0.0
    for i in range(z.size):
        total += 10.0 ** (CONDITION_EXPONENT * i / (z.size - 1)) * z[i] ** 2
    return total


@njit(cache=True, error_model="numpy")
def rosenbrock(z: Array) -> float:
    """A bent valley; from four coordinates on it has a second minimum."""
    total = 0.0
    for i in range(z.size - 1):
        total += 100.0 * (z[i + 1] - z[i] ** 2) ** 2 + (1.0 - z[i]) ** 2
    return total


@njit(cache=True, error_model="numpy")
def rastrigin(z: Array) -> float:
    """A bowl with a regular grid of deep pits."""
    return float(np.sum(z**2 + 10.0 * (1.0 - np.cos(2 * np.pi * z))))


@njit(cache=True, error_model="numpy")
def ackley(z: Array) -> float:
    """Shallow pits on a plain around a funnel."""
    radius = np.sqrt(np.mean(z**2))
    return float(-20.0 * np.expm1(-0.2 * radius) - np.e * np.expm1(np.mean(np.cos(2 * np.pi * z) - 1.0)))


@njit(cache=True, error_model="numpy")
def griewank(z: Array) -> float:
    """A wide bowl with ripples that hang together between coordinates."""
    product = 1.0
    for i in range(z.size):
        product *= np.cos(z[i] / np.sqrt(i + 1))
    return float(np.sum(z * z)) / 4000.0 + 1.0 - product


@njit(cache=True, error_model="numpy")
def schwefel(z: Array) -> float:
    """The second best pit is far from the best, which lies near the edge."""
    total = 0.0
    for i in range(z.size):
        held = min(max(z[i], -SCHWEFEL_EDGE), SCHWEFEL_EDGE)
        total += max(SCHWEFEL_LEVEL - held * np.sin(np.sqrt(abs(held))), 0.0) + (z[i] - held) ** 2
    return total


@njit(cache=True, error_model="numpy")
def levy(z: Array) -> float:
    """Ripples across a bowl, of another length in the last coordinate."""
    w = 1.0 + (z - 1.0) / 4.0
    total = np.sin(np.pi * w[0]) ** 2 + (w[-1] - 1.0) ** 2 * (1.0 + np.sin(2 * np.pi * w[-1]) ** 2)
    for i in range(z.size - 1):
        total += (w[i] - 1.0) ** 2 * (1.0 + 10.0 * np.sin(np.pi * w[i] + 1.0) ** 2)
    return float(total)


@dataclass(frozen=True, slots=True)
class Function:
    """A test function, the box it is usually searched in, and where its optimum lies."""

    name: str
    value: Callable[[Array], float]  # of z (n,)
    low: float
    high: float
    z_best: float  # every coordinate of the optimum
    is_multimodal: bool
    turns: bool = True  # whether turned coordinates make it another function


FUNCTIONS = {
    f.name: f
    for f in (
        Function("sphere", sphere, -100.0, 100.0, 0.0, is_multimodal=False, turns=False),
        Function("ellipsoid", ellipsoid, -100.0, 100.0, 0.0, is_multimodal=False),
        Function("rosenbrock", rosenbrock, -5.0, 10.0, 1.0, is_multimodal=False),
        Function("rastrigin", rastrigin, -5.12, 5.12, 0.0, is_multimodal=True),
        Function("ackley", ackley, -32.768, 32.768, 0.0, is_multimodal=True),
        Function("griewank", griewank, -600.0, 600.0, 0.0, is_multimodal=True),
        Function("schwefel", schwefel, -500.0, 500.0, SCHWEFEL_Z, is_multimodal=True),
        Function("levy", levy, -10.0, 10.0, 1.0, is_multimodal=True),
    )
}
NUMBERS = {name: i for i, name in enumerate(FUNCTIONS)}


@njit("float64(float64[::1], float64[::1])", cache=True, error_model="numpy")
def _placed(x: Array, data: Array) -> float:
    """Value at x (n,); data holds the function's number, z_best, whether there is a C, x_best and C by rows."""
    n, number = x.size, int(data[0])
    d = x - data[3 : 3 + n]
    z = np.full(n, data[1])
    if data[2] != 0.0:
        for i in range(n):
            for j in range(n):
                z[i] += data[3 + n + i * n + j] * d[j]
    else:
        z += d
    if number == 0:
        return sphere(z)
    if number == 1:
        return ellipsoid(z)
    if number == 2:
        return rosenbrock(z)
    if number == 3:
        return rastrigin(z)
    if number == 4:
        return ackley(z)
    if number == 5:
        return griewank(z)
    if number == 6:
        return schwefel(z)
    return levy(z)


@dataclass(frozen=True, slots=True)
class Instance:
    """A function placed in a box."""

    function: Function
    cost: CompiledCost
    x_best: Array  # (n,) where the cost is zero
    bounds: Array  # (n, 2)


def instance(name: str, n: int, *, x_best: Array | None = None, C: Array | None = None, offset: Array | None = None) -> Instance:
    """A function of n coordinates.

    Parameters
    ----------
    name : of FUNCTIONS
    x_best : (n,) its optimum, inside the usual box; the origin by default
    C : (n, n) orthogonal, turns the coordinates about the optimum
    offset : (n,) moves optimum and box

    Raises ValueError for an unknown name or a wrong dimension, place or matrix.
    """
    if name not in FUNCTIONS:
        raise ValueError(f"name must be one of {', '.join(FUNCTIONS)}, got {name}")
    if n < 2:
        raise ValueError(f"n must be at least 2, got {n}")
    f = FUNCTIONS[name]
    at = _vector("x_best", x_best, n)
    if not (np.all(at >= f.low) and np.all(at <= f.high)):
        raise ValueError(f"x_best must lie inside [{f.low:g}, {f.high:g}], got {at.tolist()}")
    if C is not None and (C.shape != (n, n) or not np.allclose(C @ C.T, np.eye(n), atol=1e-9)):
        raise ValueError(f"C must be an orthogonal matrix of shape ({n}, {n}), got shape {C.shape}")
    move = _vector("offset", offset, n)
    head = np.array([NUMBERS[name], f.z_best, C is not None], dtype=np.float64)
    data = np.concatenate([head, at + move, np.zeros(0) if C is None else C.ravel()])
    return Instance(f, CompiledCost(_placed, data), at + move, np.array([f.low, f.high]) + move[:, None])


def _vector(name: str, value: Array | None, n: int) -> Array:
    x = np.zeros(n) if value is None else np.asarray(value, np.float64)
    if x.shape != (n,) or not np.all(np.isfinite(x)):
        raise ValueError(f"{name} must be finite with shape ({n},), got shape {x.shape}")
    return x


def random_place(name: str, n: int, rng: np.random.Generator) -> Array:
    """A place (n,) for the optimum, uniform in the middle of the function's box."""
    f = FUNCTIONS[name]
    return 0.5 * (f.low + f.high) + 0.5 * MIDDLE * (f.high - f.low) * rng.uniform(-1.0, 1.0, n)


def random_offset(name: str, n: int, rng: np.random.Generator) -> Array:
    """An offset (n,) of one to three half widths of the function's box in every coordinate, of either sign."""
    f = FUNCTIONS[name]
    return 0.5 * (f.high - f.low) * rng.choice([-1.0, 1.0], n) * rng.uniform(1.0, 3.0, n)


def random_rotation(n: int, rng: np.random.Generator) -> Array:
    """An orthogonal matrix (n, n), uniform over all of them. Source: Mezzadri (2007)."""
    Q, R = np.linalg.qr(rng.normal(size=(n, n)))
    return np.asarray(Q * np.sign(np.diag(R)))
