"""Kalman updates and exact discretisation against textbooks, independent matrix exponentials and closed forms."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm
from scipy.stats import chi2

from factorgraph.filters import kalman
from factorgraph.filters.discretise import discretise, gauss_markov_density
from factorgraph.filters.layout import Layout
from factorgraph.types import Array

sizes = given(st.integers(0, 2**32 - 1), st.integers(1, 12), st.integers(1, 15))
MANY = settings(deadline=None, max_examples=80)


def spd(rng: np.random.Generator, n: int, spread: float = 1.0) -> Array:
    """A random covariance; standard deviations spread over that many powers of ten on both sides of 1."""
    A = rng.normal(size=(n, 2 * n))
    s = 10.0 ** rng.uniform(-spread, spread, n)
    return A @ A.T / (2 * n) * s[:, None] * s


def random_case(seed: int, n: int, m: int) -> tuple[Array, Array, Array, Array]:
    """P, nu, H, R."""
    rng = np.random.default_rng(seed)
    return spd(rng, n), rng.normal(size=m), rng.normal(size=(m, n)), spd(rng, m)


@sizes
@MANY
def test_both_updates_are_the_textbooks(seed: int, n: int, m: int) -> None:
    """Gain and covariance in their plain and in information form."""
    P, nu, H, R = random_case(seed, n, m)
    S = H @ P @ H.T + R
    K = P @ H.T @ np.linalg.inv(S)
    information = np.linalg.inv(np.linalg.inv(P) + H.T @ np.linalg.inv(R) @ H)
    scale = np.sqrt(np.diag(P))
    np.testing.assert_allclose(kalman.innovation_covariance(P, H, R), S, rtol=1e-10, atol=1e-10 * np.abs(S).max())
    for function in (kalman.update, kalman.update_sequential):
        dx, posterior, nis = function(P, nu, H, R)
        np.testing.assert_allclose(dx / scale, K @ nu / scale, atol=1e-8 * (1 + np.abs(K @ nu / scale).max()))
        np.testing.assert_allclose(posterior / np.outer(scale, scale), information / np.outer(scale, scale), atol=1e-8)
        np.testing.assert_allclose(nis, nu @ np.linalg.solve(S, nu), rtol=1e-8)
        np.testing.assert_array_equal(posterior, posterior.T)


@sizes
@MANY
def test_neither_update_touches_its_arguments(seed: int, n: int, m: int) -> None:
    given = random_case(seed, n, m)
    kept = tuple(x.copy() for x in given)
    for function in (kalman.update, kalman.update_sequential):
        function(*given)
        for now, before in zip(given, kept, strict=True):
            np.testing.assert_array_equal(now, before)


def test_scalar_updates_work_in_place() -> None:
    P, nu, H, R = random_case(3, 7, 5)
    y, W = kalman.whiten(nu, H, R)
    dx, posterior, nis = kalman.update_sequential(P, nu, H, R)
    dx2, nis2 = kalman.scalar_updates(P, y, W)
    np.testing.assert_array_equal(P, posterior)
    np.testing.assert_array_equal(dx2, dx)
    assert nis2 == nis


@sizes
@MANY
def test_whitened_rows_carry_the_same_information(seed: int, n: int, m: int) -> None:
    _, nu, H, R = random_case(seed, n, m)
    y, W = kalman.whiten(nu, H, R)
    N, b = H.T @ np.linalg.solve(R, H), H.T @ np.linalg.solve(R, nu)
    np.testing.assert_allclose(W.T @ W, N, rtol=1e-8, atol=1e-9 * np.abs(N).max())
    np.testing.assert_allclose(W.T @ y, b, rtol=1e-7, atol=1e-8 * np.abs(N).max())


@given(st.integers(0, 2**32 - 1), st.integers(1, 8), st.integers(2, 10), st.integers(1, 9))
@MANY
def test_independent_blocks_in_sequence_are_the_batch(seed: int, n: int, m: int, cut: int) -> None:
    """Spec aar_two_stage.md, check 5: two uncorrelated blocks one after the other, innovations moved along."""
    P, nu, H, R = random_case(seed, n, m)
    cut = min(cut, m - 1)
    R[:cut, cut:] = R[cut:, :cut] = 0.0
    whole, P_whole, nis_whole = kalman.update_sequential(P, nu, H, R)
    d1, P1, nis1 = kalman.update_sequential(P, nu[:cut], H[:cut], R[:cut, :cut])
    d2, P2, nis2 = kalman.update_sequential(P1, nu[cut:] - H[cut:] @ d1, H[cut:], R[cut:, cut:])
    s = np.sqrt(np.diag(P))
    np.testing.assert_allclose((d1 + d2) / s, whole / s, atol=1e-9 * (1 + np.abs(whole / s).max()))
    np.testing.assert_allclose(P2 / np.outer(s, s), P_whole / np.outer(s, s), atol=1e-9)
    np.testing.assert_allclose(nis1 + nis2, nis_whole, rtol=1e-8)


def test_nothing_to_measure_changes_nothing() -> None:
    P = spd(np.random.default_rng(1), 4)
    dx, posterior, nis = kalman.update_sequential(P, np.zeros(0), np.zeros((0, 4)), np.zeros((0, 0)))
    np.testing.assert_array_equal(posterior, P)
    assert nis == 0 and not dx.any()


def test_covariance_survives_ten_thousand_steps_of_large_precise_rows() -> None:
    """Rows in the scale of ranges, 2.2e7 times larger than the others and almost exact: the plain (I - KH)P does not."""
    rng = np.random.default_rng(7)
    n, m = 6, 6
    Phi = np.eye(n) + np.diag(np.full(n - 3, 0.1), 3)
    Q = np.diag(np.r_[np.zeros(3), np.full(3, 1e-6)])
    P = joseph = plain = np.diag(np.r_[np.full(3, 1e8), np.full(3, 1e4)])
    R, nothing = np.diag(np.r_[np.full(3, 1.0), np.full(3, 1e-2)]), np.zeros(m)
    wrong = 0
    for _ in range(10_000):
        H = np.zeros((m, n))
        H[:, :3] = rng.normal(size=(m, 3))
        H[:3] *= 2.2e7
        P = kalman.update_sequential(kalman.predict(P, Phi, Q), nothing, H, R)[1]
        joseph = kalman.update(kalman.predict(joseph, Phi, Q), nothing, H, R)[1]
        prior = Phi @ plain @ Phi.T + Q
        plain = prior - prior @ H.T @ np.linalg.solve(H @ prior @ H.T + R, H @ prior)
        wrong += not np.array_equal(plain, plain.T) or bool(np.any(np.diag(plain) <= 0))
    assert wrong > 1000  # the case is hard
    for found in (P, joseph):
        np.testing.assert_array_equal(found, found.T)
        s = np.sqrt(np.diag(found))
        assert np.all(np.isfinite(found)) and np.linalg.eigvalsh(found / np.outer(s, s))[0] > 0


def test_nis_of_true_models_is_chi_square() -> None:
    rng = np.random.default_rng(11)
    P, _, H, R = random_case(5, 6, 4)
    S = kalman.innovation_covariance(P, H, R)
    trials = 2000
    nis = [kalman.update_sequential(P, nu, H, R)[2] for nu in rng.multivariate_normal(np.zeros(4), S, trials)]
    low, high = chi2.interval(0.9999, 4 * trials)
    assert low < np.sum(nis) < high


def test_layouts_say_who_owns_what() -> None:
    layout = Layout(position=3, clock=1)
    more = layout.extended(drift=1)
    assert (layout.size, more.size, more.names) == (4, 5, ("position", "clock", "drift"))
    assert more["drift"] == slice(4, 5) and layout["clock"] == more["clock"] and "drift" not in layout


# discretisation


def van_loan(F: Array, q: Array, dt: float) -> tuple[Array, Array]:
    """Phi and Q by one matrix exponential of twice the size."""
    n = len(F)
    big = np.block([[-F, q], [np.zeros((n, n)), F.T]])
    E = expm(big * dt)
    Phi = E[n:, n:].T
    return Phi, Phi @ E[:n, n:]


def assert_close(found: Array, expected: Array, relative: float) -> None:
    assert np.abs(found - expected).max() <= relative * np.abs(expected).max()


@given(st.integers(0, 2**32 - 1), st.integers(1, 20), st.floats(0.005, 10.0), st.floats(0.01, 3.0))
@settings(deadline=None, max_examples=150)
def test_discretisation_is_van_loans(seed: int, n: int, dt: float, size: float) -> None:
    """Any F, stable or not, norm of F dt up to 3, where the large exponential is itself good to 1e-13 or so."""
    rng = np.random.default_rng(seed)
    F = rng.normal(size=(n, n)) * 10.0 ** rng.uniform(-1, 0, (n, n))
    F *= size / (np.linalg.norm(F, 2) * dt)
    q = spd(rng, n, 0.5)
    Phi, Q = discretise(F, q, dt)
    expected = van_loan(F, q, dt)
    assert_close(Phi, expected[0], 1e-12)
    assert_close(Q, expected[1], 1e-12)
    np.testing.assert_array_equal(Q, Q.T)


@given(st.integers(0, 2**32 - 1), st.integers(1, 20), st.sampled_from([0.005, 0.1, 1.0, 10.0]), st.sampled_from([1.0, 30.0, 1e3]))
@settings(deadline=None, max_examples=100)
def test_stiff_systems_have_their_closed_form(seed: int, n: int, dt: float, fastest: float) -> None:
    """F = V diag(d) V' with rates over many decades, stable and unstable; Van Loan's own matrix overflows there."""
    rng = np.random.default_rng(seed)
    V = np.linalg.qr(rng.normal(size=(n, n)))[0]
    d = -fastest * 10.0 ** rng.uniform(-5, 0, n)
    d[rng.random(n) < 0.2] = min(1.0, 3.0 / dt)  # some grow
    q = spd(rng, n, 0.5)
    total = d[:, None] + d
    integral = np.where(np.abs(total * dt) > 1e-8, np.expm1(total * dt) / np.where(total == 0, 1.0, total), dt)
    Phi, Q = discretise((V * d) @ V.T, q, dt)
    expected_Q = V @ ((V.T @ q @ V) * integral) @ V.T
    assert np.abs(Phi - (V * np.exp(d * dt)) @ V.T).max() < 1e-11 * max(1.0, np.exp(d * dt).max())
    assert_close(Q, expected_Q, 1e-11)
    s = np.sqrt(np.diag(Q))
    assert np.linalg.eigvalsh(Q / np.outer(s, s))[0] > -1e-12


def test_constant_acceleration_is_exact() -> None:
    """The textbook blocks: T^5/20, T^4/8, T^3/6 and so on."""
    T, F = 0.7, np.diag([1.0, 1.0], 1)
    Phi, Q = discretise(F, np.diag([0.0, 0.0, 2.0]), T)
    np.testing.assert_allclose(Phi, np.array([[1.0, T, T**2 / 2], [0.0, 1.0, T], [0.0, 0.0, 1.0]]), rtol=1e-15)
    expected = np.array([[T**5 / 20, T**4 / 8, T**3 / 6], [T**4 / 8, T**3 / 3, T**2 / 2], [T**3 / 6, T**2 / 2, T]])
    np.testing.assert_allclose(Q, 2 * expected, rtol=1e-13)


def test_two_intervals_are_one() -> None:
    rng = np.random.default_rng(2)
    F, q = rng.normal(size=(5, 5)), spd(rng, 5)
    A, QA = discretise(F, q, 0.4)
    B, QB = discretise(F, q, 1.1)
    whole, Q = discretise(F, q, 1.5)
    assert_close(B @ A, whole, 1e-12)
    assert_close(B @ QA @ B.T + QB, Q, 1e-12)


@pytest.mark.parametrize(("sigma", "tau_s"), [(0.3, 1500.0), (2.0, 4000.0), (1e-8, 0.5)])
def test_gauss_markov_density_keeps_the_variance(sigma: float, tau_s: float) -> None:
    """Stationary: P = Phi P Phi' + Q for any interval, and the autocorrelation is exp(-dt / tau)."""
    for dt in (0.005, 1.0, 600.0):
        Phi, Q = discretise(np.array([[-1 / tau_s]]), np.array([[gauss_markov_density(sigma, tau_s)]]), dt)
        np.testing.assert_allclose(Phi[0, 0], np.exp(-dt / tau_s), rtol=1e-11)
        np.testing.assert_allclose(Q[0, 0], sigma**2 * -np.expm1(-2 * dt / tau_s), rtol=1e-11)
        np.testing.assert_allclose(Phi[0, 0] ** 2 * sigma**2 + Q[0, 0], sigma**2, rtol=1e-11)
