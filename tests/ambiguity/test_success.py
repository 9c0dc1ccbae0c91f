"""Success rates against counting, the ratio test, and the bounds between the methods."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ambiguity import (
    adop,
    adop_success_rate,
    bootstrap,
    decorrelate,
    integer_least_squares,
    ratio_test,
    round_each,
    success_rate,
)
from tests.ambiguity.models import double_difference_covariance, draw_float, random_covariance

TRIALS = 3000


def test_predicted_rates_are_met_in_counting() -> None:
    """Bootstrapping meets its rate, integer least squares at least that, rounding at least its bound and no more than both."""
    rng = np.random.default_rng(20)
    Q = double_difference_covariance(rng, (6,), 2, 0.003, 0.3)
    while success_rate(Q) > 0.9:  # rates near one would say little
        Q *= 1.2
    while success_rate(Q) < 0.6:
        Q /= 1.2
    L = np.linalg.cholesky(Q)
    right = np.zeros(3)
    for _ in range(TRIALS):
        a = L @ rng.standard_normal(len(Q))
        right += (
            not bootstrap(a, Q).integers.any(),
            not integer_least_squares(a, Q, 1).candidates.any(),
            not round_each(a, Q).integers.any(),
        )
    share = right / TRIALS
    p = success_rate(Q)
    sigma = math.sqrt(p * (1 - p) / TRIALS)
    assert abs(share[0] - p) < 4 * sigma
    assert share[1] > p - 4 * sigma
    assert round_each(a, Q).success_rate - 4 * sigma < share[2] <= share[0] + 4 * sigma


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), n=st.integers(1, 15))
def test_bounds_are_ordered(seed: int, n: int) -> None:
    Q = random_covariance(np.random.default_rng(seed), n)
    rounding, bootstrapped, bound = round_each(np.zeros(n), Q).success_rate, success_rate(Q), adop_success_rate(adop(Q), n)
    assert 0 <= rounding <= bootstrapped * (1 + 1e-9)
    assert bootstrapped <= bound * (1 + 1e-9) <= 1 + 1e-9


def test_adop_is_the_root_of_the_determinant_in_any_basis() -> None:
    Q = random_covariance(np.random.default_rng(4), 7, spread=1.0)
    expected = np.linalg.det(Q) ** (1 / 14)
    assert adop(Q) == pytest.approx(expected, rel=1e-10)
    assert adop(decorrelate(Q).covariance) == pytest.approx(expected, rel=1e-8)
    assert adop(4 * Q) == pytest.approx(2 * expected, rel=1e-10)


def test_one_ambiguity_has_the_normal_probability() -> None:
    assert success_rate([[0.25]]) == pytest.approx(0.682689492137, abs=1e-12)  # half a cycle is one sigma
    assert adop([[0.25]]) == pytest.approx(0.5)
    assert adop_success_rate(0.5, 1) == pytest.approx(0.682689492137, abs=1e-12)


def test_customary_adop_promises_the_customary_rate() -> None:
    assert adop_success_rate(0.14, 10) > 0.995
    assert adop_success_rate(0.12, 10) > 0.999


def test_bootstrap_matches_least_squares_in_a_strong_model_at_any_offset() -> None:
    rng = np.random.default_rng(2)
    for _ in range(20):
        Q = double_difference_covariance(rng, (7,), 2, 0.002, 0.3, 5)
        a, truth = draw_float(rng, Q, spread_cyc=10**8)
        result = bootstrap(a, Q)
        assert result.success_rate > 0.999
        np.testing.assert_array_equal(result.integers, truth)


def test_nothing_to_round_succeeds_surely() -> None:
    empty = np.zeros((0, 0))
    assert success_rate(empty) == 1.0
    assert bootstrap([], empty).integers.shape == round_each([], empty).integers.shape == (0,)
    with pytest.raises(ValueError, match="at least one ambiguity"):
        adop(empty)


@pytest.mark.parametrize("call", [success_rate, adop, lambda Q: bootstrap([0, 0], Q)])
def test_singular_covariance_is_refused(call) -> None:  # type: ignore[no-untyped-def]
    with pytest.raises(ValueError, match="positive definite"):
        call(np.ones((2, 2)))


def test_ratio() -> None:
    passed = ratio_test([2.0, 6.0, 7.0], 3.0)
    assert passed.ratio == 3.0 and passed.passed
    assert not ratio_test([2.0, 5.9], 3.0).passed
    assert ratio_test([0.0, 5.9], 3.0) == ratio_test([2.0], 3.0)
    assert ratio_test([2.0], 3.0).ratio == math.inf


@pytest.mark.parametrize("norms", [[3.0, 2.0], [-1.0, 2.0], [np.nan, 1.0], [], 1.0])
def test_norms_that_are_none_are_refused(norms: object) -> None:
    with pytest.raises(ValueError, match="sorted vector of squared norms"):
        ratio_test(norms, 3.0)  # type: ignore[arg-type]


@pytest.mark.parametrize("threshold", [0.5, np.nan])
def test_a_threshold_below_one_is_refused(threshold: float) -> None:
    with pytest.raises(ValueError, match="at least 1"):
        ratio_test([1.0, 2.0], threshold)
