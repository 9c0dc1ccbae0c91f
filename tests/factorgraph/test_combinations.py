"""Combinations of two frequencies: what they cancel, and that estimated ionospheres do the same as leaving them out."""

from __future__ import annotations

import numpy as np
import pytest

from factorgraph.models.combinations import ionosphere_free, melbourne_wuebbena, wide_lane_m
from factorgraph.types import Array

L1, L5 = np.array([0.190293672798]), np.array([0.254828048791])


def observed(rng: np.random.Generator, n: int) -> tuple[Array, Array, Array, Array, Array, Array]:
    """Codes and phases of two bands [m] without noise, and their integers."""
    rho, iono = rng.uniform(2e7, 2.5e7, n), rng.uniform(0, 30, n)
    N1, N2 = (rng.integers(-1000, 1000, n).astype(float) for _ in range(2))
    more = iono * (L5 / L1) ** 2
    return rho + iono, rho + more, rho - iono + L1 * N1, rho - more + L5 * N2, N1, N2


def test_melbourne_wuebbena_leaves_the_wide_lane() -> None:
    P1, P2, phi1, phi2, N1, N2 = observed(np.random.default_rng(1), 50)
    np.testing.assert_allclose(melbourne_wuebbena(phi1, phi2, P1, P2, L1, L5), N1 - N2, atol=1e-6)
    assert wide_lane_m(L1, L5)[0] == pytest.approx(0.751, abs=1e-3)


def test_ionosphere_free_codes_are_ranges() -> None:
    rng = np.random.default_rng(2)
    rho, iono = rng.uniform(2e7, 2.5e7, 50), rng.uniform(0, 30, 50)
    a, b = ionosphere_free(L1, L5)
    np.testing.assert_allclose(a * (rho + iono) + b * (rho + iono * (L5 / L1) ** 2), rho, atol=1e-6)
    assert a + b == pytest.approx(1.0) and np.hypot(a, b) == pytest.approx(2.588, abs=1e-3)


def test_estimating_the_ionosphere_is_leaving_it_out() -> None:
    """Least squares of position and clock from two codes per satellite with one unconstrained ionosphere each, and from the
    ionosphere-free codes: the same estimate and the same covariance. A tight prior on the ionosphere is better than either.
    """
    rng = np.random.default_rng(3)
    n, sigma = 9, 0.4
    e = rng.normal(0, 1, (n, 3)) + [0, 0, 1.5]
    G = np.column_stack([e / np.linalg.norm(e, axis=1, keepdims=True), np.ones(n)])
    x, iono = rng.normal(0, 10, 4), rng.uniform(0, 5, n)
    ratio = float((L5 / L1)[0] ** 2)
    y = np.concatenate([G @ x + iono, G @ x + ratio * iono]) + sigma * rng.normal(0, 1, 2 * n)

    def uncombined(prior: float) -> tuple[Array, Array]:
        A = np.hstack([np.vstack([G, G]), np.vstack([np.eye(n), ratio * np.eye(n)])])
        N = A.T @ A / sigma**2 + np.diag([0.0] * 4 + [1 / prior**2] * n)
        P = np.linalg.inv(N)
        return (P @ A.T @ y / sigma**2)[:4], P[:4, :4]

    a, b = (float(f[0]) for f in ionosphere_free(L1, L5))
    free = a * y[:n] + b * y[n:]
    P = np.linalg.inv(G.T @ G) * sigma**2 * (a * a + b * b)
    estimate, covariance = uncombined(1e6)
    np.testing.assert_allclose(estimate, np.linalg.lstsq(G, free, rcond=None)[0], atol=1e-5)
    np.testing.assert_allclose(covariance, P, rtol=1e-4)
    assert np.trace(uncombined(0.1)[1]) < 0.5 * np.trace(P)
