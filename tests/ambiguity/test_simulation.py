"""Counted rates against closed forms, against each other and against the bounds."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ambiguity import bootstrap, decorrelate, integer_least_squares, round_each, success_rate
from ambiguity.simulation import (
    Rate,
    _resolve,
    acceptance_rates,
    least_squares_upper_bound,
    simulate,
    simulated_success_rates,
    wilson,
)
from ambiguity.types import Array
from ambiguity.validation import projector_test
from tests.ambiguity.models import double_difference_covariance, random_covariance, with_success_rate

SURE = 1 - 1e-6  # confidence of intervals a test relies on


def within_half(sigma: float) -> float:
    return math.erf(1 / (math.sqrt(8) * sigma))


def test_one_ambiguity_meets_its_closed_form() -> None:
    for sigma in (0.15, 0.3, 0.6, 2.0):
        rates = simulated_success_rates([[sigma**2]], 20_000, 1, SURE)
        for rate in (rates.rounding, rates.bootstrapping, rates.least_squares):
            assert rate.lower <= within_half(sigma) <= rate.upper
        assert rates.rounding == rates.bootstrapping == rates.least_squares


def test_two_ambiguities_meet_their_closed_form_in_any_basis() -> None:
    """Uncorrelated they are a product; a unimodular change spoils rounding and leaves the others."""
    expected = within_half(0.3) * within_half(0.4)
    T = np.array([[1, 0], [2, 1]])
    plain = simulated_success_rates(np.diag([0.09, 0.16]), 20_000, 2, SURE)
    mixed = simulated_success_rates(T @ np.diag([0.09, 0.16]) @ T.T, 20_000, 3, SURE)
    for rate in (plain.rounding, plain.least_squares, mixed.bootstrapping, mixed.least_squares):
        assert rate.lower <= expected <= rate.upper
    assert mixed.rounding.upper < expected


def test_one_ambiguity_splits_into_the_known_three_rates() -> None:
    """Ratio t accepts |a - k| <= 1 / (1 + sqrt(t)), difference t |a - k| <= (1 - t sigma^2) / 2, projection t t sigma."""
    sigma, s = 0.35, simulate([[0.35**2]], 40_000, 4)

    def share(k: int, h: float) -> float:
        return 0.5 * (math.erf((k + h) / (sigma * math.sqrt(2))) - math.erf((k - h) / (sigma * math.sqrt(2))))

    for passed, h in (
        (s.ratio >= 2.0, 1 / (1 + math.sqrt(2.0))),
        (s.difference >= 2.0, 0.5 * (1 - 2 * sigma**2)),
        (s.projection <= 0.9, 0.9 * sigma),
    ):
        rates = acceptance_rates(s, passed, SURE)
        success, failure = share(0, h), sum(share(k, h) for k in range(-9, 10) if k)
        assert rates.success.lower <= success <= rates.success.upper
        assert rates.failure.lower <= failure <= rates.failure.upper
        assert rates.undecided.lower <= 1 - success - failure <= rates.undecided.upper


@pytest.mark.parametrize("target", [0.3, 0.8, 0.97])
def test_estimators_and_bounds_are_in_order(target: float) -> None:
    rng = np.random.default_rng(int(1000 * target))
    for model in (((6,), 2, 0.003, 0.3), ((8,), 1, 0.003, 0.3, 20), ((5, 5), 2, 0.003, 0.3)):
        Q = with_success_rate(double_difference_covariance(rng, *model), target)
        rates = simulated_success_rates(Q, 4000, rng, SURE)
        assert round_each(np.zeros(len(Q)), Q).success_rate <= rates.rounding.upper
        assert rates.bootstrapping.lower <= success_rate(Q) <= rates.bootstrapping.upper
        assert success_rate(Q) <= rates.least_squares.upper
        assert rates.least_squares.lower <= least_squares_upper_bound(Q)
        assert rates.rounding.value <= rates.least_squares.upper


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), n=st.integers(1, 8))
def test_samples_are_those_the_public_functions_resolve(seed: int, n: int) -> None:
    """Statistics of a sample in the decorrelated ambiguities are those of its float vector as given."""
    Q = random_covariance(np.random.default_rng(seed), n, 1.0)
    d = decorrelate(Q)
    z = np.random.default_rng(seed).standard_normal((5, n)) * np.sqrt(d.D) @ d.U.T
    right, statistics = np.empty((3, 5), bool), np.empty((3, 5))
    _resolve(d.U, d.D, z, 10**6, right, statistics)
    for k, a in enumerate(z @ d.Z_inv.T):
        best = integer_least_squares(a, Q)
        assert right[0, k] == (not bootstrap(a, Q).integers.any())
        assert right[1, k] == (not best.candidates[0].any()) and right[2, k]
        projection = projector_test(a, Q, best.candidates, 0.0).projection
        expected = [best.norms[1] / best.norms[0], best.norms[1] - best.norms[0], projection]
        np.testing.assert_allclose(statistics[:, k], expected, rtol=1e-6, atol=1e-6)


def test_draws_have_the_covariance_asked_for() -> None:
    """Rounding in the ambiguities as given sees their variances, however strong the correlation."""
    Q = double_difference_covariance(np.random.default_rng(1), (6,), 2, 0.003, 0.3)
    for k in range(len(Q)):
        rate = simulated_success_rates(Q[k : k + 1, k : k + 1], 4000, k, SURE).rounding
        assert rate.lower <= within_half(math.sqrt(Q[k, k])) <= rate.upper


def test_a_seed_repeats_and_a_generator_goes_on() -> None:
    Q = double_difference_covariance(np.random.default_rng(1), (6,), 2, 0.003, 0.3)
    a, b = simulate(Q, 300, 7), simulate(Q, 300, 7)
    np.testing.assert_array_equal(a.ratio, b.ratio)
    rng = np.random.default_rng(7)
    np.testing.assert_array_equal(simulate(Q, 300, rng).ratio, a.ratio)
    assert np.any(simulate(Q, 300, rng).ratio != a.ratio)


def test_a_spent_budget_is_counted_against_the_integers() -> None:
    Q = double_difference_covariance(np.random.default_rng(1), (6,), 2, 0.003, 0.3)
    s = simulate(Q, 200, 7, max_nodes=2)
    assert s.n_unproven == 200 and not s.nearest.any() and np.isinf(s.ratio).all()
    rates = acceptance_rates(s, s.ratio >= 1e9)
    assert rates.failure.value == 1.0


def test_no_ambiguity_is_always_right() -> None:
    empty = np.zeros((0, 0))
    rates = simulated_success_rates(empty, 100)
    assert rates.rounding.value == rates.bootstrapping.value == rates.least_squares.value == 1.0
    s = simulate(empty, 100)
    assert acceptance_rates(s, s.ratio >= 3).success.value == acceptance_rates(s, s.projection <= -9).success.value == 1.0
    assert least_squares_upper_bound(empty) == 1.0


def test_wilson_interval() -> None:
    """10 of 100: the textbook's 5.5 % to 17.4 %."""
    rate = wilson(10, 100)
    assert rate.value == 0.1
    assert rate.lower == pytest.approx(0.05523, abs=1e-5) and rate.upper == pytest.approx(0.17437, abs=1e-5)
    assert wilson(0, 50).lower == 0.0 < wilson(0, 50).upper < 0.08
    assert wilson(50, 50).upper == 1.0 > wilson(50, 50).lower > 0.92
    assert math.isnan(wilson(0, 0).value) and (wilson(0, 0).lower, wilson(0, 0).upper) == (0.0, 1.0)
    for a, b in pairwise(wilson(30, 100, c) for c in (0.5, 0.9, 0.99, 0.9999)):
        assert b.lower < a.lower < 0.3 < a.upper < b.upper


def test_wilson_interval_holds_the_share_as_often_as_it_says() -> None:
    rng, p = np.random.default_rng(3), 0.03
    held = [r.lower <= p <= r.upper for r in (wilson(int(c), 500, 0.9) for c in rng.binomial(500, p, 2000))]
    assert 0.87 < np.mean(held) < 0.94


def chi_square_below(n: int, x: Array) -> Array:
    return np.asarray([np.mean(np.random.default_rng(n).chisquare(n, 200_000) <= v) for v in x])


@pytest.mark.parametrize("n", [1, 2, 5, 12, 40])
def test_upper_bound_is_the_ball_of_unit_volume(n: int) -> None:
    """For Q = s^2 I the bound is the chance of a ball with the volume of the unit cube."""
    for sigma in (0.2, 0.35, 0.5):
        volume = math.pi ** (n / 2) / math.gamma(n / 2 + 1)
        radius = (1 / volume) ** (1 / n)
        expected = chi_square_below(n, np.array([(radius / sigma) ** 2]))[0]
        bound = least_squares_upper_bound(sigma**2 * np.eye(n))
        assert bound == pytest.approx(expected, abs=6e-3)
        assert within_half(sigma) ** n <= bound * (1 + 1e-12)
    assert least_squares_upper_bound(1e-12 * np.eye(n)) == 1.0
    assert 0 <= least_squares_upper_bound(1e12 * np.eye(n)) < 1e-5


def test_upper_bound_of_one_is_exact() -> None:
    for sigma in (0.1, 0.5, 3.0):
        assert least_squares_upper_bound([[sigma**2]]) == pytest.approx(within_half(sigma), rel=1e-12)


def test_wrong_options_are_named() -> None:
    Q = np.eye(2)
    for call, text in (
        (lambda: simulate(Q, 0), "n_samples must be at least 1, got 0"),
        (lambda: simulate(Q, 10, max_nodes=0), "max_nodes must be at least 1, got 0"),
        (lambda: simulated_success_rates(Q, 10, confidence=1.0), r"confidence must lie in \(0, 1\), got 1.0"),
        (lambda: acceptance_rates(simulate(Q, 10), np.ones(9)), r"passed must have shape \(10,\)"),
        (lambda: wilson(3, 2), "count must lie between 0 and the 2 samples, got 3"),
    ):
        with pytest.raises(ValueError, match=text):
            call()


def test_rates_add_up() -> None:
    s = simulate(with_success_rate(random_covariance(np.random.default_rng(5), 6), 0.7), 2000, 5)
    rates = acceptance_rates(s, s.ratio >= 1.5)
    assert rates.success.value + rates.failure.value + rates.undecided.value == pytest.approx(1.0)
    always = acceptance_rates(s, np.ones(2000, bool))
    assert always.undecided == Rate(0.0, 0.0, always.undecided.upper)
    assert always.success == wilson(int(s.nearest.sum()), 2000)
