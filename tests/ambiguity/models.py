"""Float ambiguities of realistic short-baseline geometry and of random shape, and RTKLIB's answer to them."""

from __future__ import annotations

import numpy as np
import pytest

from ambiguity import success_rate
from ambiguity.types import Array, IntArray

WAVELENGTHS_M = (299792458.0 / 1575.42e6, 299792458.0 / 1227.60e6, 299792458.0 / 1176.45e6)


MODELS: dict[str, tuple[tuple[int, ...], int, float, float, int]] = {
    # satellites per system, frequencies, phase and code sigma [m], epochs
    "n=6 single frequency": ((7,), 1, 0.010, 0.3, 10),
    "n=8 dual": ((5,), 2, 0.003, 0.3, 1),
    "n=12 dual": ((7,), 2, 0.003, 0.3, 1),
    "n=20 dual": ((6, 6), 2, 0.003, 0.3, 1),
    "n=40 dual": ((8, 8, 7), 2, 0.010, 0.3, 1),
    "n=60 triple": ((8, 8, 7), 3, 0.010, 0.3, 1),
}


def double_difference_covariance(
    rng: np.random.Generator,
    n_sats: tuple[int, ...],
    n_freq: int,
    sigma_phase_m: float,
    sigma_code_m: float,
    n_epochs: int = 1,
    weighted: bool = True,
) -> Array:
    """Covariance [cyc^2] of the float ambiguities of a baseline from code and phase, nothing known of the baseline.

    One reference satellite per system (`n_sats` holds the satellites of each), undifferenced sigmas at the zenith grow
    with 1 / sin(elevation) unless not `weighted`; epochs share one geometry. With B the double differences' lines of sight:
    Q_a = (R_phase + B inv(B' inv(R_code) B) B') / (wavelengths).
    """
    B_rows, cofactors = [], []
    for n_sat in n_sats:
        az, el = rng.uniform(0, 2 * np.pi, n_sat), np.arcsin(rng.uniform(np.sin(np.deg2rad(12)), 1.0, n_sat))
        top = np.argmax(el)
        u = np.column_stack([np.cos(el) * np.sin(az), np.cos(el) * np.cos(az), np.sin(el)])
        T = np.insert(np.eye(n_sat - 1), top, -1.0, axis=1)
        B_rows.append(T @ u)
        cofactors.append(2.0 * T @ np.diag(1.0 / np.sin(el) ** (2 if weighted else 0)) @ T.T)
    n = sum(len(b) for b in B_rows)
    C, at = np.zeros((n, n)), 0
    for c in cofactors:
        C[at : at + len(c), at : at + len(c)] = c
        at += len(c)
    B = np.tile(np.vstack(B_rows), (n_freq, 1))
    R = np.kron(np.eye(n_freq), C) / n_epochs
    per_wave = np.repeat(1.0 / np.array(WAVELENGTHS_M[:n_freq]), n)
    P_b = np.linalg.inv(B.T @ np.linalg.solve(sigma_code_m**2 * R, B))
    Q = (sigma_phase_m**2 * R + B @ P_b @ B.T) * np.outer(per_wave, per_wave)
    return np.asarray(0.5 * (Q + Q.T))


def draw_float(rng: np.random.Generator, Q: Array, spread_cyc: int = 1000) -> tuple[Array, IntArray]:
    """Float ambiguities around random integers: (a_float, a_true)."""
    truth = rng.integers(-spread_cyc, spread_cyc + 1, len(Q))
    return truth + np.linalg.cholesky(Q) @ rng.standard_normal(len(Q)), truth


def random_covariance(rng: np.random.Generator, n: int, spread: float = 2.0) -> Array:
    """A positive definite matrix with standard deviations over `spread` decades along random axes."""
    V, _ = np.linalg.qr(rng.standard_normal((n, n)))
    Q = (V * 10.0 ** rng.uniform(-spread, 0.5, n)) @ V.T
    return np.asarray(0.5 * (Q + Q.T))


def mixed_covariance(rng: np.random.Generator, n: int) -> Array:
    """Independent ambiguities of any precision, hidden behind a sparse unimodular change of variables."""
    lower = np.tril(rng.integers(-2, 3, (n, n)) * (rng.random((n, n)) < 1.5 / n), -1) + np.eye(n)
    T = lower[:, rng.permutation(n)]
    Q = (T * 10.0 ** rng.uniform(-3.0, 0.0, n)) @ T.T
    return np.asarray(0.5 * (Q + Q.T))


def with_success_rate(Q: Array, target: float) -> Array:
    """Q scaled so that the decorrelated, bootstrapped success rate is about `target`."""
    low, high = 1e-9, 1e9
    for _ in range(60):
        middle = np.sqrt(low * high)
        low, high = (middle, high) if success_rate(middle * Q) > target else (low, middle)
    return np.asarray(low * Q)


class Rtklib:
    """RTKLIB's two best candidates through pyrtklib5; skips the test where it is not installed."""

    def __init__(self, n: int) -> None:
        self._module = pytest.importorskip("pyrtklib5")
        self._lambda = getattr(self._module, "lambda")
        self.n = n
        self._a, self._Q, self._F, self._s = (self._module.Arr1Ddouble(size) for size in (n, n * n, 2 * n, 2))

    def fill(self, a_float: Array, Q: Array) -> None:
        for i, value in enumerate(a_float.tolist()):
            self._a[i] = value
        for i, value in enumerate(Q.ravel().tolist()):
            self._Q[i] = value

    def core(self) -> int:
        """The C routine alone; 0 when it found the candidates."""
        return int(self._lambda(self.n, 2, self._a, self._Q, self._F, self._s))

    def read(self) -> tuple[IntArray, Array]:
        F = np.array([self._F[i] for i in range(2 * self.n)]).reshape(2, self.n)
        return np.rint(F).astype(np.int64), np.array([self._s[0], self._s[1]])

    def __call__(self, a_float: Array, Q: Array) -> tuple[IntArray, Array] | None:
        """Candidates (2, n) and squared norms (2,); None where it gave up."""
        self.fill(a_float, Q)
        return self.read() if self.core() == 0 else None
