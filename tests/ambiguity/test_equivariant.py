"""The equivariant mean against sums written out, its limits, and the bound on what it neglects."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ambiguity import _kernels
from ambiguity.equivariant import _log_theta, best_integer_equivariant
from ambiguity.search import integer_least_squares
from ambiguity.types import Array
from tests.ambiguity.models import double_difference_covariance, draw_float, random_covariance

seeds = st.integers(0, 2**32 - 1)


def written_out(a: Array, Q: Array, reach: float = 9.0) -> tuple[Array, Array, float, Array]:
    """Weighted mean, covariance, largest share and squared norms over a box of `reach` standard deviations."""
    ranges = [
        np.arange(math.floor(x - reach * s) - 1, math.ceil(x + reach * s) + 2)
        for x, s in zip(a, np.sqrt(np.diag(Q)), strict=True)
    ]
    box = np.array(list(itertools.product(*ranges)))
    d = a - box
    norms = np.einsum("ki,ki->k", d, np.linalg.solve(Q, d.T).T)
    w = np.exp(-0.5 * (norms - norms.min()))
    w /= w.sum()
    mean = w @ box
    return mean, (w[:, None] * (box - mean)).T @ (box - mean), float(w.max()), norms


@pytest.mark.parametrize("sigma", [0.05, 0.2, 0.5, 1.0, 4.0, 30.0])
@pytest.mark.parametrize("a", [0.0, 0.3, 0.5, -7.49])
def test_one_ambiguity_is_the_sum_over_all_integers(a: float, sigma: float) -> None:
    z = np.arange(-600, 601)
    w = np.exp(-0.5 * ((a - z) / sigma) ** 2 + 0.5 * ((a - round(a)) / sigma) ** 2)
    expected = (w @ z) / w.sum()
    result = best_integer_equivariant([a], [[sigma**2]])
    assert result.proven
    assert result.a_bie[0] == pytest.approx(expected, abs=1e-7 * sigma)
    assert result.covariance[0, 0] == pytest.approx((w @ (z - expected) ** 2) / w.sum(), rel=1e-5, abs=1e-7 * sigma**2)
    assert result.best_weight == pytest.approx(w.max() / w.sum(), rel=1e-8)


@settings(max_examples=80, deadline=None)
@given(seed=seeds, n=st.integers(1, 3), scale=st.floats(-2.5, 0.3))
def test_agrees_with_the_sum_written_out(seed: int, n: int, scale: float) -> None:
    rng = np.random.default_rng(seed)
    Q = random_covariance(rng, n, spread=0.7) * 10.0**scale
    a = rng.uniform(-20, 20, n)
    mean, covariance, share, norms = written_out(a, Q)
    result = best_integer_equivariant(a, Q)
    assert result.proven and 0 < result.neglected <= 1.0000001e-9
    np.testing.assert_allclose(result.a_bie, mean, rtol=0, atol=1e-7 * (1 + np.sqrt(np.trace(Q))))
    np.testing.assert_allclose(result.covariance, covariance, rtol=0, atol=1e-6 * (1e-3 + np.trace(Q)))
    assert result.best_weight == pytest.approx(share, rel=1e-6)
    if result.radius < 64:  # within the box written out
        near = norms <= result.radius
        assert result.count == near.sum()
        w = np.exp(-0.5 * (norms - norms.min()))
        assert w[~near].sum() / w[near].sum() <= result.neglected * (1 + 1e-9)


@settings(max_examples=60, deadline=None)
@given(seed=seeds, n=st.integers(1, 6), shift=st.integers(-(10**7), 10**7))
def test_integer_shifts_move_it_along(seed: int, n: int, shift: int) -> None:
    rng = np.random.default_rng(seed)
    Q = random_covariance(rng, n, spread=1.0) * 0.1
    a = np.round(rng.uniform(-1, 1, n) * 2**20) / 2**20
    offset = rng.integers(-abs(shift) - 1, abs(shift) + 1, n)
    near, far = best_integer_equivariant(a, Q), best_integer_equivariant(a + offset, Q)
    np.testing.assert_allclose(far.a_bie - offset, near.a_bie, rtol=0, atol=2e-8)
    np.testing.assert_allclose(far.covariance, near.covariance, rtol=1e-6, atol=1e-12)


@settings(max_examples=40, deadline=None)
@given(seed=seeds, n=st.integers(2, 6))
def test_order_of_the_ambiguities_does_not_matter(seed: int, n: int) -> None:
    rng = np.random.default_rng(seed)
    Q, a = random_covariance(rng, n, spread=1.0) * 0.1, rng.uniform(-9, 9, n)
    p = rng.permutation(n)
    plain, permuted = best_integer_equivariant(a, Q), best_integer_equivariant(a[p], Q[np.ix_(p, p)])
    np.testing.assert_allclose(permuted.a_bie, plain.a_bie[p], rtol=0, atol=1e-6)
    np.testing.assert_allclose(permuted.covariance, plain.covariance[np.ix_(p, p)], rtol=0, atol=1e-6)


def test_limits_are_the_integers_and_the_float() -> None:
    rng = np.random.default_rng(5)
    strong = double_difference_covariance(rng, (7,), 2, 0.002, 0.2, 10)
    a, truth = draw_float(rng, strong, 10**6)
    sharp = best_integer_equivariant(a, strong)
    np.testing.assert_allclose(sharp.a_bie, integer_least_squares(a, strong).candidates[0], rtol=0, atol=1e-6)
    np.testing.assert_array_equal(np.rint(sharp.a_bie), truth)
    assert sharp.best_weight > 0.999 and np.abs(sharp.covariance).max() < 1e-3
    weak = 3.0 * (np.eye(4) + 0.3)
    b = rng.uniform(-9, 9, 4)
    flat = best_integer_equivariant(b, weak)
    assert flat.proven
    np.testing.assert_allclose(flat.a_bie, b, rtol=0, atol=1e-5)
    np.testing.assert_allclose(flat.covariance, weak, rtol=1e-4)
    assert flat.best_weight < 0.01


def test_its_mean_squared_error_is_least_and_as_told() -> None:
    """Between the two limits it beats both integers and float; the mean of its covariances is its mean squared error."""
    rng = np.random.default_rng(11)
    Q = random_covariance(rng, 3, spread=0.3) * 0.08
    L = np.linalg.cholesky(Q)
    error = np.zeros(3)
    told = 0.0
    n_trials = 4000
    for _ in range(n_trials):
        a = L @ rng.standard_normal(3)
        result = best_integer_equivariant(a, Q, tolerance=1e-6)
        told += np.trace(result.covariance) / n_trials
        for i, estimate in enumerate((result.a_bie, integer_least_squares(a, Q, 1).candidates[0], a)):
            error[i] += estimate @ estimate / n_trials
    assert error[0] < 0.97 * error[1] and error[0] < 0.97 * error[2]
    assert told == pytest.approx(error[0], rel=0.1)


def test_a_spent_budget_shrinks_the_radius_and_says_so() -> None:
    Q = 0.6 * (np.eye(6) + 0.2)
    a = np.linspace(-0.5, 0.7, 6)
    full, cut = best_integer_equivariant(a, Q, 1e-6), best_integer_equivariant(a, Q, 1e-6, max_nodes=20_000)
    assert full.proven and not cut.proven
    assert cut.radius < full.radius and 1e-6 < cut.neglected <= 1 and cut.count <= 20_000
    missing = 1 - (full.best_weight / (cut.best_weight / (1 - cut.neglected)) if cut.neglected < 1 else 0)
    assert missing <= cut.neglected
    starved = best_integer_equivariant(a, Q, max_nodes=1)
    assert not starved.proven and starved.neglected == 1.0 and starved.count == 1
    np.testing.assert_array_equal(starved.a_bie, np.rint(starved.a_bie))


@pytest.mark.parametrize("s", [1e-4, 0.3, math.pi, 3.2, 40.0, 900.0])
def test_sums_that_bound_the_weights(s: float) -> None:
    j = np.arange(-2000, 2001)
    whole, half = np.exp(-s * j**2.0).sum(), np.exp(-s * ((j - 0.5) ** 2 - 0.25)).sum()
    assert float(_log_theta(np.array([s]))) == pytest.approx(math.log(whole), abs=1e-13)
    assert float(_log_theta(np.array([s]), half_way=True)) == pytest.approx(math.log(half) - 0.25 * s, abs=1e-12)
    assert float(_log_theta(np.array([s, s]))) == pytest.approx(2 * math.log(whole), abs=1e-12)


def test_kernel_agrees_with_its_interpreted_twin() -> None:
    rng = np.random.default_rng(2)
    Q = random_covariance(rng, 4, spread=0.5)
    _, _, _, U, D, _, z = _kernels.reduce(rng.uniform(-0.5, 0.5, 4), Q)
    compiled = _kernels.weigh(U, D, z, 12.0, 0.5, 10**5)
    for ours, twin in zip(compiled, _kernels.weigh.py_func(U, D, z, 12.0, 0.5, 10**5), strict=True):
        np.testing.assert_allclose(np.asarray(ours, float), np.asarray(twin, float), rtol=1e-10, atol=1e-12)


def test_no_ambiguity_and_wrong_options() -> None:
    none = best_integer_equivariant([], np.zeros((0, 0)))
    assert none.a_bie.shape == (0,) and none.proven and none.count == 1
    with pytest.raises(ValueError, match="tolerance must lie between 0 and 1, got 0"):
        best_integer_equivariant([0.1], [[1.0]], tolerance=0)
    with pytest.raises(ValueError, match="max_nodes must be at least 1, got 0"):
        best_integer_equivariant([0.1], [[1.0]], max_nodes=0)
    with pytest.raises(ValueError, match="positive definite"):
        best_integer_equivariant([0.1, 0.2], np.ones((2, 2)))
    with pytest.raises(ValueError, match=r"a_float\[0\] is nan"):
        best_integer_equivariant([np.nan], [[1.0]])
