"""Acceptance tests: their geometry, and the failure rates they keep."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ambiguity import integer_least_squares, ratio_test, success_rate
from ambiguity.simulation import acceptance_rates, simulate, wilson
from ambiguity.types import Array
from ambiguity.validation import _tolerated, difference_test, ffrt_threshold, projector_test
from tests.ambiguity.models import double_difference_covariance, draw_float, random_covariance, with_success_rate

SURE = 1 - 1e-6
seeds = st.integers(0, 2**32 - 1)


def model(seed: int, target: float) -> Array:
    return with_success_rate(double_difference_covariance(np.random.default_rng(seed), (6,), 2, 0.003, 0.3), target)


def test_difference() -> None:
    assert difference_test([2.0, 6.0, 7.0], 4.0).passed
    assert difference_test([2.0, 6.0], 4.0).difference == 4.0
    assert not difference_test([2.0, 5.9], 4.0).passed
    assert difference_test([2.0], 1e9).difference == math.inf and difference_test([2.0], 1e9).passed
    with pytest.raises(ValueError, match="difference threshold must not be negative, got -1"):
        difference_test([2.0, 5.9], -1)
    with pytest.raises(ValueError, match="sorted vector of squared norms"):
        difference_test([5.9, 2.0], 1)


@settings(max_examples=60, deadline=None)
@given(seed=seeds, n=st.integers(1, 10))
def test_projection_is_its_formula_and_at_most_half_way(seed: int, n: int) -> None:
    rng = np.random.default_rng(seed)
    Q = random_covariance(rng, n, 1.0)
    a, _ = draw_float(rng, Q)
    best = integer_least_squares(a, Q)
    d, r = best.candidates[1] - best.candidates[0], a - best.candidates[0]
    P = np.linalg.inv(Q)
    projection = projector_test(a, Q, best.candidates, 0.0).projection
    length = math.sqrt(d @ P @ d)
    assert projection == pytest.approx(d @ P @ r / length, rel=1e-6, abs=1e-7)
    assert projection <= 0.5 * length * (1 + 1e-9)
    assert projection == pytest.approx((best.norms[0] - best.norms[1] + length**2) / (2 * length), rel=1e-6, abs=1e-6)


def test_projection_of_a_vector_between_two_candidates() -> None:
    """On the line from (0, 0) to (1, 0), sigma 0.1: 0.3 of the way is 3 sigma, half way is 5."""
    Q = np.diag([0.01, 0.02])
    for share in (0.0, 0.3, 0.5):
        test = projector_test([share, 0.0], Q, [[0, 0], [1, 0]], 3.0 + 1e-9)
        assert test.projection == pytest.approx(10 * share)
        assert test.passed == (share < 0.4)
    assert projector_test([10**9 + 0.25, 0.0], Q, [[10**9, 0], [10**9 + 1, 0]], 3).projection == pytest.approx(2.5, rel=1e-6)


def test_one_candidate_has_no_rival() -> None:
    assert projector_test([0.3], [[0.01]], [[0]], -100).passed
    assert projector_test([], np.zeros((0, 0)), np.zeros((1, 0)), 0).passed


@pytest.mark.parametrize(
    ("candidates", "threshold", "text"),
    [
        ([[0, 0], [0, 0]], 1.0, "first two candidates are equal"),
        ([[0, 0, 0]], 1.0, r"candidates must have shape \(k, 2\)"),
        ([0, 0], 1.0, r"candidates must have shape \(k, 2\)"),
        (np.zeros((0, 2)), 1.0, r"with k > 0"),
        ([[0, 0], [1, 0]], np.nan, "projector threshold is NaN"),
    ],
)
def test_candidates_that_are_none_are_refused(candidates: object, threshold: float, text: str) -> None:
    with pytest.raises(ValueError, match=text):
        projector_test([0.1, 0.2], np.eye(2), candidates, threshold)  # type: ignore[arg-type]


def test_threshold_of_one_ambiguity_is_the_closed_form() -> None:
    """Wrong and accepted: |a - k| <= h for some k but 0. The exact h lies between the ends of the interval."""
    sigma, tolerated = 0.4, 0.02

    def failures(h: float) -> float:
        def below(x: float) -> float:
            return 0.5 * (1 + math.erf(x / (sigma * math.sqrt(2))))

        return sum(below(k + h) - below(k - h) for k in range(-9, 10) if k)

    low, high = 0.0, 0.5
    for _ in range(60):
        h = 0.5 * (low + high)
        low, high = (h, high) if failures(h) < tolerated else (low, h)
    exact = (1 / h - 1) ** 2
    result = ffrt_threshold([[sigma**2]], tolerated, 40_000, 1, SURE)
    assert result.lower <= exact <= result.upper
    assert result.threshold == pytest.approx(exact, rel=0.2)


@pytest.mark.parametrize("target", [0.6, 0.9, 0.98])
@pytest.mark.parametrize("tolerated", [0.001, 0.01])
def test_the_failure_rate_is_kept_by_samples_the_threshold_has_not_seen(target: float, tolerated: float) -> None:
    Q = model(3, target)
    result = ffrt_threshold(Q, tolerated, 20_000, 11, SURE)
    assert 1 <= result.lower <= result.threshold <= result.upper
    assert result.rates.failure.value <= tolerated
    fresh = simulate(Q, 20_000, 12)
    assert acceptance_rates(fresh, fresh.ratio >= result.upper, SURE).failure.lower <= tolerated
    assert acceptance_rates(fresh, fresh.ratio >= result.lower, SURE).failure.upper >= min(tolerated, 1 - fresh.nearest.mean())
    at = acceptance_rates(fresh, fresh.ratio >= result.threshold, SURE)
    assert at.failure.lower < 2 * tolerated
    assert at.success.value == pytest.approx(result.rates.success.value, abs=0.08)


def test_interval_of_the_threshold_holds_as_often_as_it_says() -> None:
    """One ambiguity, 150 seeds, 80 %: fewer than two thirds or more than nineteen in twenty would be wrong."""
    reference = ffrt_threshold([[0.16]], 0.02, 1_000_000, 1).threshold
    held = 0
    for seed in range(150):
        result = ffrt_threshold([[0.16]], 0.02, 1000, seed, 0.8)
        held += result.lower <= reference <= result.upper
    assert 100 < held < 143


def test_a_smaller_failure_rate_needs_a_larger_threshold() -> None:
    Q = model(4, 0.8)
    thresholds = [ffrt_threshold(Q, p, 10_000, 5).threshold for p in (0.5, 0.05, 0.01, 0.002)]
    assert thresholds[0] == 1.0 and np.all(np.diff(thresholds) > 0)
    assert all(math.isfinite(t) for t in thresholds)


def test_a_strong_model_accepts_always_and_a_weak_one_is_asked_for_more() -> None:
    """The reason for the test: one failure rate, thresholds that differ with the model."""
    strong, weak = model(5, 0.9999), model(5, 0.7)
    sure = ffrt_threshold(strong, 0.001, 1000, 1)
    assert (sure.threshold, sure.lower, sure.upper) == (1.0, 1.0, 1.0)
    assert sure.rates.failure.value <= 0.001 and sure.rates.undecided.value == 0.0
    assert ffrt_threshold(weak, 0.001, 20_000, 1).threshold > 2.0


def test_no_tolerance_accepts_nothing_unless_it_is_promised() -> None:
    result = ffrt_threshold(model(5, 0.9), 0.0, 1000, 1)
    assert result.threshold == result.lower == result.upper == math.inf
    assert result.rates.undecided.value == 1.0
    a, _ = draw_float(np.random.default_rng(2), model(5, 0.9))
    assert not ratio_test(integer_least_squares(a, model(5, 0.9)).norms, result.threshold).passed
    assert ffrt_threshold(np.zeros((0, 0)), 0.0).threshold == 1.0
    assert ffrt_threshold([[1e-6]], 0.0).threshold == 1.0


def test_searches_that_spent_their_budget_allow_no_threshold() -> None:
    assert ffrt_threshold(model(5, 0.9), 0.01, 500, 1, max_nodes=2).threshold == math.inf


def test_the_decision_is_monotone_in_the_ratio() -> None:
    t = ffrt_threshold(model(6, 0.8), 0.01, 5000, 1).threshold
    passed = [ratio_test([1.0, r], t).passed for r in np.linspace(1.0, 3 * t, 50)]
    assert passed == sorted(passed) and passed[-1] and not passed[0]


def test_tolerated_counts_are_binomial_quantiles() -> None:
    rng = np.random.default_rng(1)
    for p, n in ((0.001, 5000), (0.02, 1000), (0.5, 41)):
        point, most, fewest = _tolerated(p, n, 0.9)
        counts = rng.binomial(n, p, 200_000)
        assert point == math.floor(p * n)
        assert np.mean(counts > most) <= 0.052 and np.mean(counts > most - 1) >= 0.048
        assert np.mean(counts <= fewest) <= 0.052 and np.mean(counts <= fewest + 1) >= 0.048
    assert _tolerated(0.0, 100, 0.9) == (-1, -1, -1)


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"failure_rate": 1.0}, r"failure_rate must lie in \[0, 1\), got 1.0"),
        ({"failure_rate": math.nan}, r"failure_rate must lie in \[0, 1\)"),
        ({"failure_rate": 1e-4, "n_samples": 1000}, "1000 samples cannot tell a failure rate of 0.0001; draw 1000000"),
        ({"failure_rate": 0.01, "confidence": 1.0}, r"confidence must lie in \(0, 1\), got 1.0"),
        ({"failure_rate": 0.0, "n_samples": 0}, "n_samples must be at least 1, got 0"),
    ],
)
def test_wrong_options_are_named(options: dict[str, float], text: str) -> None:
    with pytest.raises(ValueError, match=text):
        ffrt_threshold(np.eye(2), **options)  # type: ignore[arg-type]


def test_every_test_can_be_tuned_to_a_failure_rate() -> None:
    """Ratio, difference and projection tuned to 1 % failures each accept most of the right integers."""
    Q = model(7, 0.9)
    s = simulate(Q, 20_000, 9)
    for statistic in (s.ratio, s.difference, -s.projection):
        wrong = np.sort(statistic[~s.nearest])[::-1]
        rates = acceptance_rates(s, statistic > wrong[200])
        assert rates.failure.value == 0.01
        assert rates.success.value > 0.5
    assert success_rate(Q) - 0.02 < wilson(int(s.nearest.sum()), 20_000).value
