"""Robust kernels: weights belong to costs, and both to their definitions; factors on covariances of filters."""

from __future__ import annotations

from typing import get_args

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from factorgraph.filters import adaptive, kalman
from factorgraph.models.robust import Mixture, RelaxedTls, bifactor, cost, igg3, mixture, weight
from factorgraph.problem import Kernel, Robust
from factorgraph.types import Array

KERNELS = [k for k in get_args(Kernel) if k != "self-tuned"]
MIXTURES = [Mixture(), Mixture(0.3, 1.4, 6.0), Mixture(1e-3, 1.0, 50.0)]
T = np.concatenate([-np.geomspace(50, 1e-3, 60), np.geomspace(1e-3, 50, 60)])


@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize("width", [0.7, 1.345, 4.0])
def test_weight_is_the_slope_of_the_cost_over_t(kernel: Kernel, width: float) -> None:
    robust = Robust(kernel, width)
    t = T[np.abs(np.abs(T) - width) > 1e-3]  # the second derivative may jump there
    h = 1e-5 * np.maximum(np.abs(t), 0.01)
    slope = (cost(robust, t + h) - cost(robust, t - h)) / (2 * h)
    np.testing.assert_allclose(weight(robust, t), slope / t, rtol=2e-5, atol=1e-8)


@pytest.mark.parametrize("kernel", KERNELS)
def test_small_residuals_are_least_squares(kernel: Kernel) -> None:
    robust = Robust(kernel, 2.0)
    t = np.array([-1e-4, 0.0, 1e-4])
    np.testing.assert_allclose(weight(robust, t), 1.0, atol=1e-7)
    np.testing.assert_allclose(cost(robust, t), 0.5 * t**2, rtol=1e-7)


@pytest.mark.parametrize("kernel", KERNELS)
def test_even_bounded_and_never_rising(kernel: Kernel) -> None:
    robust = Robust(kernel, 2.0)
    t = np.linspace(0, 100, 5001)
    w, rho = weight(robust, t), cost(robust, t)
    np.testing.assert_array_equal(w, weight(robust, -t))
    np.testing.assert_array_equal(rho, cost(robust, -t))
    assert np.all((w >= 0) & (w <= 1)) and np.all(np.diff(w) <= 0)
    assert np.all(np.diff(rho) >= 0) and np.all(np.abs(np.diff(rho)) < 3)  # no jump of the cost


@pytest.mark.parametrize(
    ("kernel", "w", "rho"),
    [
        ("huber", 0.5, 2 * 4 - 2),
        ("cauchy", 0.2, 2 * np.log(5)),
        ("geman-mcclure", 0.04, 8 / 5),
        ("tukey", 0.0, 4 / 6),
        ("none", 1.0, 8.0),
        ("dcs", 0.16, 4 * (48 - 4) / (2 * 20)),
        ("tls", 0.0, 2.0),
    ],
)
def test_values_at_twice_the_width(kernel: Kernel, w: float, rho: float) -> None:
    """By hand from the definitions with c = 2, t = 4."""
    t = np.array([4.0])
    np.testing.assert_allclose(weight(Robust(kernel, 2.0), t), w, atol=1e-15)
    np.testing.assert_allclose(cost(Robust(kernel, 2.0), t), rho, atol=1e-14)


def test_no_kernel_is_least_squares() -> None:
    np.testing.assert_array_equal(weight(None, T), 1.0)
    np.testing.assert_array_equal(cost(None, T), 0.5 * T**2)


@pytest.mark.parametrize("loss", [*MIXTURES, *(RelaxedTls(2.0, mu) for mu in (0.01, 0.5, 20.0))])
def test_weights_of_tuned_and_relaxed_losses_are_slopes(loss: Mixture | RelaxedTls) -> None:
    t = T
    if isinstance(loss, RelaxedTls):
        bends = 2.0 * np.sqrt([loss.control / (loss.control + 1), (loss.control + 1) / loss.control])
        t = T[np.min(np.abs(np.abs(T)[:, None] - bends), axis=1) > 2e-3]
    h = 1e-5 * np.maximum(np.abs(t), 0.01)
    slope = (cost(loss, t + h) - cost(loss, t - h)) / (2 * h)
    np.testing.assert_allclose(weight(loss, t), slope / t, rtol=2e-4, atol=1e-7)
    w = weight(loss, np.linspace(0, 100, 5001))
    assert np.all((w >= 0) & (w <= 1)) and np.all(np.diff(w) <= 1e-15)
    assert np.all(np.diff(cost(loss, np.linspace(0, 100, 5001))) >= -1e-12)


def test_a_switch_variable_settles_at_what_dcs_weighs() -> None:
    """Agarwal et al. (2013): s = min(1, 2 phi / (phi + t^2)) on the residual, so s^2 on its square."""
    t = np.linspace(0.0, 30.0, 301)
    phi = 2.5**2
    np.testing.assert_allclose(weight(Robust("dcs", 2.5), t), np.minimum(1, 2 * phi / (phi + t**2)) ** 2, rtol=1e-12)


@pytest.mark.parametrize(("loss", "relaxed_loss"), [(Robust("tls", 2.0), RelaxedTls(2.0, 1e6))])
def test_a_relaxed_loss_ends_as_itself(loss: Robust, relaxed_loss: RelaxedTls) -> None:
    t = T[np.abs(np.abs(T) - 2.0) > 1e-3]
    np.testing.assert_allclose(weight(relaxed_loss, t), weight(loss, t), atol=1e-12)
    np.testing.assert_allclose(cost(relaxed_loss, t), cost(loss, t), atol=1e-5)


@pytest.mark.parametrize(("share", "outer"), [(0.1, 12.0), (0.3, 6.0), (0.02, 30.0)])
def test_a_mixture_finds_what_was_drawn(share: float, outer: float) -> None:
    rng = np.random.default_rng(8)
    n = 20_000
    t = rng.normal(size=n) * np.where(rng.random(n) < share, outer, 1.0)
    found = mixture(t, 3.0)
    assert abs(found.share - share) < 0.15 * share + 0.005
    assert abs(found.inner - 1) < 0.05 and abs(found.outer / outer - 1) < 0.15
    likelihood = [
        float(np.sum(loss.cost(t))) for loss in (found, Mixture(), Mixture(share / 2, 1.0, outer), Mixture(share, 1.0, 2 * outer))
    ]
    assert likelihood[0] == min(likelihood)


def test_a_mixture_does_not_believe_that_residuals_are_better_than_declared() -> None:
    t = np.random.default_rng(9).normal(0, 0.2, 5000)
    found = mixture(t, 3.0)
    assert found.inner == 1.0 and found.share < 0.01 and found.outer >= 3.0
    np.testing.assert_allclose(weight(found, t), 1.0, atol=0.01)
    assert mixture(np.zeros(0), 3.0) == mixture(np.zeros(0), 3.0)  # no rows, no change


def test_self_tuned_weights_are_the_mixtures() -> None:
    t = np.random.default_rng(10).standard_t(2, 500)
    np.testing.assert_array_equal(weight(Robust("self-tuned", 3.0), t), mixture(t, 3.0).weight(t))
    np.testing.assert_array_equal(cost(Robust("self-tuned", 3.0), t), mixture(t, 3.0).cost(t))


@pytest.mark.parametrize("kernel", ["cauchy", "geman-mcclure", "tukey", "dcs", "tls"])
def test_redescending_kernels_forget_gross_errors(kernel: Kernel) -> None:
    """Their influence t w(t) falls towards zero; huber's does not."""
    t = np.array([10.0, 1000.0])
    influence = t * weight(Robust(kernel, 2.0), t)
    assert influence[1] <= influence[0] / 5
    huber = t * weight(Robust("huber", 2.0), t)
    np.testing.assert_allclose(huber, 2.0)


# factors on the weights of correlated rows

RANDOM = settings(deadline=None, max_examples=100)


def covariance(rng: np.random.Generator, n: int) -> Array:
    A = rng.normal(size=(n, 2 * n))
    return A @ A.T / (2 * n)


def test_igg3_keeps_reduces_and_rejects() -> None:
    """Spec common.md, W1, by hand with c0 = 1.5, c1 = 4.5."""
    t = np.array([0.0, 1.5, 3.0, -3.0, 4.5, 100.0])
    np.testing.assert_allclose(igg3(t, 1.5, 4.5), [1, 1, 0.5 * 0.25, 0.5 * 0.25, 1e-12, 1e-12], rtol=1e-14)
    assert igg3(np.array([50.0]), 1.5, 4.5, floor=1e-3)[0] == 1e-3


@given(st.floats(0.5, 2.5), st.floats(3.0, 8.0))
@RANDOM
def test_igg3_is_continuous_even_and_never_rises(c0: float, c1: float) -> None:
    t = np.linspace(0, 10, 20_001)
    w = igg3(t, c0, c1)
    np.testing.assert_array_equal(w, igg3(-t, c0, c1))
    assert np.all(np.diff(w) <= 0) and w[0] == 1 and w[-1] == 1e-12
    assert np.abs(np.diff(w)).max() < 0.005 * (1 + 1 / c0 + 2 / (c1 - c0))  # no step


@given(st.integers(0, 2**32 - 1), st.integers(1, 12))
@RANDOM
def test_bifactor_is_the_inverse_of_scaled_weights(seed: int, n: int) -> None:
    """Spec aar_two_stage.md, check 6: W_ij sqrt(r_i r_j) inverted, positive definite for every r in [1e-12, 1]."""
    rng = np.random.default_rng(seed)
    R, r = covariance(rng, n), 10.0 ** rng.uniform(-12, 0, n)
    r[rng.random(n) < 0.3] = 1e-12
    r[rng.random(n) < 0.3] = 1.0
    found = bifactor(R, r)
    s = np.sqrt(r)
    whitened = found * s[:, None] * s  # of size 1 in every entry: rows of 1e6 and of 1 are judged alike
    np.testing.assert_allclose(whitened, np.linalg.inv(np.linalg.inv(R)), rtol=0, atol=1e-9)
    W = np.linalg.inv(R) * s[:, None] * s
    np.testing.assert_allclose((found @ W) / s * s[:, None], np.eye(n), atol=1e-9)
    np.testing.assert_allclose(found, found.T, rtol=1e-15)
    assert np.all(np.linalg.eigvalsh(whitened) > 0)
    np.linalg.cholesky(found)
    mild = 10.0 ** rng.uniform(-2, 0, n)
    m = np.sqrt(mild)
    np.testing.assert_allclose(bifactor(R, mild), np.linalg.inv(np.linalg.inv(R) * m[:, None] * m), rtol=1e-7, atol=1e-9)


@pytest.mark.parametrize("error", [0.0, 40.0, -1000.0])
def test_rejected_rows_no_longer_count(error: float) -> None:
    """A row at the floor has no influence, whatever it says; what stays is the scaled weight matrix."""
    rng = np.random.default_rng(4)
    H, R, nu, r = rng.normal(size=(6, 3)), covariance(rng, 6), rng.normal(size=6), np.ones(6)
    r[2] = 1e-12
    weights = np.linalg.inv(R) * np.sqrt(np.outer(r, r))
    information = np.eye(3) + H.T @ weights @ H
    expected = np.linalg.solve(information, H.T @ weights @ nu)
    nu[2] += error
    dx, Q, _ = kalman.update_sequential(np.eye(3), nu, H, bifactor(R, r))
    np.testing.assert_allclose(Q, np.linalg.inv(information), atol=1e-9)
    np.testing.assert_allclose(dx, expected, atol=1e-2)  # 1000 times the root of the floor, 1e-6, and what multiplies it


# factors on predicted states


def test_factor_is_one_up_to_the_threshold() -> None:
    assert [adaptive.factor(x, 1.5) for x in (0.0, 1.5, 3.0, 15.0)] == [1.0, 1.0, 0.5, 0.1]


@given(st.integers(0, 2**32 - 1), st.floats(0.01, 1.0), st.floats(0.01, 1.0))
@RANDOM
def test_classified_factors_scale_the_information(seed: int, first: float, second: float) -> None:
    """Erratum E13: Y acts on weights, so the covariance is Y^-1/2 P Y^-1/2; correlations stay."""
    P = covariance(np.random.default_rng(seed), 7)
    found = adaptive.classified(P, [(slice(0, 4), first), (slice(4, None), second)])
    y = np.sqrt(np.repeat([first, second], [4, 3]))
    np.testing.assert_allclose(found, P / np.outer(y, y), rtol=1e-12)
    np.testing.assert_allclose(np.linalg.inv(found), np.linalg.inv(P) * np.outer(y, y), rtol=1e-6, atol=1e-8)
    np.testing.assert_array_equal(adaptive.classified(P, [(slice(0, 4), 1.0), (slice(4, None), 1.0)]), P)


def test_normalised_statistics_expect_one() -> None:
    """Root mean square over draws of the model, in units of any size; the literal ones depend on the units."""
    rng = np.random.default_rng(6)
    units = np.diag([1.0, 1e-3, 1e3, 1.0, 1e-2, 10.0])
    P, H = units @ covariance(rng, 6) @ units, rng.normal(size=(4, 6)) @ np.linalg.inv(units)
    R = covariance(rng, 4)
    S = kalman.innovation_covariance(P, H, R)
    K = P @ H.T @ np.linalg.inv(S)
    posterior = P - K @ S @ K.T
    innovation, correction, literal = [], [], []
    part = slice(1, 4)
    for nu in rng.multivariate_normal(np.zeros(4), S, 4000):
        innovation.append(adaptive.innovation_statistic(nu, S, "normalised"))
        literal.append(adaptive.innovation_statistic(nu, S, "literal"))
        correction.append(adaptive.correction_statistic((K @ nu)[part], P[part, part], posterior[part, part], "normalised"))
    for values, dof in ((innovation, 4), (correction, 3)):
        assert abs(np.mean(np.square(values)) - 1) < 4 * np.sqrt(2 / (dof * 4000))
    assert abs(np.mean(np.square(literal)) - 1) < 0.2  # of mean one, but not chi-square
    assert np.var(np.square(literal)) > 1.2 * np.var(np.square(innovation))


def test_literal_correction_is_the_published_one() -> None:
    P = np.diag([4.0, 9.0, 3.0])
    assert adaptive.correction_statistic(np.array([4.0, 0.0, 0.0]), P, 0.5 * P, "literal") == pytest.approx(1.0)


def test_directions_without_information_say_nothing() -> None:
    """A class of which the measurements correct one direction has one degree of freedom."""
    P, posterior = np.eye(3), np.diag([0.5, 1.0, 1.0])
    d = np.array([np.sqrt(0.5), 0.0, 0.0])
    assert adaptive.correction_statistic(d, P, posterior, "normalised") == pytest.approx(1.0)
