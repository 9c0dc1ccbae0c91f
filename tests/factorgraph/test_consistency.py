"""Consistency statistics: against definitions, other libraries, and their promised coverage on synthetic draws."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from factorgraph import consistency
from factorgraph.errors import InputError
from factorgraph.types import Array


def rng_of(seed: int) -> np.random.Generator:
    return np.random.default_rng([20, seed])


def binomial_margin(share: float, n: int) -> float:
    """Four standard deviations of an observed share."""
    return 4 * float(np.sqrt(share * (1 - share) / n))


def correlated(rng: np.random.Generator, n: int, dim: int) -> tuple[Array, Array]:
    """Errors (n, dim) drawn from covariances (n, dim, dim), all different."""
    A = rng.standard_normal((n, dim, dim)) + 2 * np.eye(dim)
    return np.einsum("tij,tj->ti", A, rng.standard_normal((n, dim))), A @ np.swapaxes(A, 1, 2)


def test_nees_agrees_with_a_solver_and_refuses_bad_covariances() -> None:
    rng = rng_of(0)
    A = rng.standard_normal((50, 4, 4)) * [1e-3, 1.0, 30.0, 1e4]  # units apart
    P = np.swapaxes(A, 1, 2) @ A
    e = rng.standard_normal((50, 4))
    P[0], P[1, 2, 2], P[2] = np.nan, -1.0, np.ones((4, 4))  # unknown, negative, singular
    P[3] = np.eye(4) + 2 * (np.eye(4, k=1) + np.eye(4, k=-1))  # indefinite with a positive diagonal
    e[4, 1] = np.nan
    value = consistency.nees(e, P)
    assert np.isnan(value[:5]).all()
    expected = np.sum(e[5:] * np.linalg.solve(P[5:], e[5:, :, None])[..., 0], axis=1)
    np.testing.assert_allclose(value[5:], expected, rtol=1e-6)


def test_nees_of_honest_errors_is_chi_square() -> None:
    value = consistency.nees(*correlated(rng_of(1), 4000, 3))
    assert stats.kstest(value, stats.chi2(3).cdf).pvalue > 1e-4


def test_nees_names_shapes_that_do_not_match() -> None:
    with pytest.raises(InputError, match=r"\(5, 3\) and \(5, 2, 2\)"):
        consistency.nees(np.zeros((5, 3)), np.zeros((5, 2, 2)))


def test_standard_deviations_are_nan_where_there_is_no_variance() -> None:
    sigma = consistency.standard_deviations(np.array([[4.0, 0.0], [0.0, -1.0]]))
    np.testing.assert_array_equal(sigma, [2.0, np.nan])


def test_band_holds_its_probability_for_any_degrees_of_freedom() -> None:
    dof = np.array([0.7, 1.0, 3.0, 250.0, 0.0])
    lower, upper = consistency.band(dof, 0.9)
    np.testing.assert_allclose(stats.chi2.cdf(lower[:4], dof[:4]), 0.05, rtol=1e-9)
    np.testing.assert_allclose(stats.chi2.sf(upper[:4], dof[:4]), 0.05, rtol=1e-9)
    assert np.isnan([lower[4], upper[4]]).all()
    with pytest.raises(InputError, match="prob"):
        consistency.band(3.0, 95.0)


def test_judge_takes_fractional_and_empty_degrees_of_freedom() -> None:
    test = consistency.judge(np.arange(3.0), np.array([2.0, 0.0, 99.0]), np.array([2.5, 0.0, 2.5]))
    assert np.isnan(test.value[1]) and np.isnan(test.upper[1])
    assert test.share_inside == 0.5


@pytest.mark.parametrize(("scale", "side"), [(1.0, "inside"), (1.3, "above"), (0.7, "below")])
def test_average_nees_finds_optimism_and_pessimism_and_accepts_honesty(scale: float, side: str) -> None:
    """Many epochs of 50 trials each; a quarter of the trials is missing at the later epochs."""
    n_trials, n_epochs = 50, 600
    values = stats.chi2(3).rvs((n_trials, n_epochs), random_state=rng_of(2)) * scale**2
    values[: n_trials // 4, n_epochs // 2 :] = np.nan
    found = consistency.average_nees(np.arange(n_epochs, dtype=float), values, 3)
    assert found.upper[-1] > found.upper[0] > 3 > found.lower[0] > found.lower[-1]
    above, below = float(np.mean(found.value > found.upper)), float(np.mean(found.value < found.lower))
    shares = {"above": above, "below": below, "inside": found.share_inside}
    if side == "inside":
        assert abs(shares["inside"] - 0.95) < binomial_margin(0.95, n_epochs)
    else:
        assert shares[side] > 0.5
        assert shares["below" if side == "above" else "above"] < 0.01


def test_average_nees_is_nan_where_no_trial_is_known() -> None:
    values = np.array([[1.0, np.nan], [2.0, np.nan]])
    found = consistency.average_nees(np.arange(2.0), values, 1)
    assert found.value[0] == 1.5
    assert np.isnan([found.value[1], found.lower[1], found.upper[1]]).all()


def test_nis_band_holds_the_mean_of_a_run_with_its_probability() -> None:
    rng, runs = rng_of(3), 800
    dof = rng.integers(0, 12, 40).astype(float)  # some epochs have no redundancy
    used = dof[dof > 0]
    means = stats.chi2(used).rvs((runs, len(used)), random_state=rng).mean(axis=1)
    lower, upper = consistency.nis_band(dof, 0.9)
    assert lower < used.mean() < upper
    assert abs(np.mean((means >= lower) & (means <= upper)) - 0.9) < binomial_margin(0.9, runs)
    assert np.isnan(consistency.nis_band(np.zeros(4))).all()


def test_white_innovations_stay_inside_and_coloured_ones_show_their_correlation() -> None:
    rng = rng_of(4)
    white = rng.standard_normal((2000, 3))
    white[rng.random((2000, 3)) < 0.1] = np.nan
    lags, runs = 40, 10
    inside = [consistency.whiteness(rng.standard_normal((2000, 2)), lags).share_inside for _ in range(runs)]
    assert abs(np.mean(inside) - 0.95) < binomial_margin(0.95, lags * runs)
    found = consistency.whiteness(white, 2)
    assert np.all(found.n_products < 0.85 * white.size) and np.all(np.abs(found.rho) < 2 * found.half_width)
    coloured = np.zeros(5000)
    for k in range(1, len(coloured)):
        coloured[k] = 0.6 * coloured[k - 1] + rng.standard_normal()
    np.testing.assert_allclose(consistency.whiteness(coloured, 3).rho, 0.6 ** np.arange(1, 4), atol=0.08)


def test_whiteness_follows_its_definition_and_shows_a_bias() -> None:
    nu = np.array([[1.0, 2.0], [0.5, -1.0], [2.0, 0.0], [1.0, 1.0]])
    expected = (1 * 2 + 0.5 * 1 + 2 * 0 - 1 * 1) / np.sqrt((1 + 4 + 0.25 + 1) * (4 + 0 + 1 + 1))
    np.testing.assert_allclose(consistency.whiteness(nu, 2).rho[1], expected, rtol=1e-12)
    assert np.all(consistency.whiteness(3 + rng_of(5).standard_normal(500), 5).rho > 0.8)


@pytest.mark.parametrize(("nu", "lag"), [(np.ones(5), 5), (np.ones(5), 0), (np.array([1.0, np.nan, 1.0, np.nan]), 1)])
def test_whiteness_refuses_lags_without_products(nu: Array, lag: int) -> None:
    with pytest.raises(InputError, match="lag"):
        consistency.whiteness(nu, lag)


@pytest.mark.parametrize(("k", "n"), [(0, 10), (3, 10), (10, 10), (498, 500)])
def test_wilson_agrees_with_another_library(k: int, n: int) -> None:
    found = consistency.wilson(k, n, 0.99)
    expected = stats.binomtest(k, n).proportion_ci(0.99, method="wilson")
    np.testing.assert_allclose([found.lower, found.upper], [expected.low, expected.high], atol=1e-12)
    assert (found.value, found.n) == (k / n, n)


def test_wilson_without_trials_knows_nothing_and_refuses_nonsense() -> None:
    assert (consistency.wilson(0, 0).lower, consistency.wilson(0, 0).upper) == (0.0, 1.0)
    with pytest.raises(InputError, match="between 0 and the 3 trials"):
        consistency.wilson(4, 3)


def test_mean_interval_agrees_with_another_library_and_leaves_nan_out() -> None:
    x = rng_of(6).normal(2.0, 0.3, 12)
    found = consistency.mean_interval(np.append(x, np.nan), 0.9)
    expected = stats.ttest_1samp(x, 0.0).confidence_interval(0.9)
    np.testing.assert_allclose([found.lower, found.upper], [expected.low, expected.high], rtol=1e-12)
    assert found.n == 12
    assert found.value == pytest.approx(x.mean())
    assert consistency.mean_interval(np.array([1.0])).upper == np.inf
    assert np.isnan(consistency.mean_interval(np.zeros(0)).value)


def test_paired_bootstrap_agrees_with_another_library() -> None:
    rng = rng_of(7)
    a = rng.exponential(1.0, 40)
    b = a * rng.uniform(0.7, 1.2, 40)

    def ratio(x: Array, y: Array) -> Array:
        return np.asarray(np.sqrt(np.mean(y**2, axis=-1) / np.mean(x**2, axis=-1)))

    found = consistency.paired_bootstrap(a, b, rng, ratio, n_resamples=20_000)
    expected = stats.bootstrap(
        (a, b), lambda x, y, axis: ratio(x, y), paired=True, vectorized=True, n_resamples=20_000, rng=rng
    ).confidence_interval
    width = expected.high - expected.low
    np.testing.assert_allclose([found.lower, found.upper], [expected.low, expected.high], atol=0.06 * width)
    assert found.value == pytest.approx(float(ratio(a, b)))


def test_paired_bootstrap_covers_the_true_difference_and_profits_from_pairs() -> None:
    rng, studies, n = rng_of(8), 300, 30
    hits, width = 0, 0.0
    for _ in range(studies):
        common = rng.normal(0.0, 5.0, n)  # what both methods share on a seed
        a, b = common + rng.standard_normal(n), common + 0.4 + rng.standard_normal(n)
        found = consistency.paired_bootstrap(a, b, rng, n_resamples=600)
        hits += found.lower <= 0.4 <= found.upper
        width += (found.upper - found.lower) / studies
    assert 0.88 < hits / studies < 0.985  # the bootstrap of 30 seeds is known to cover a little less than 95 %
    assert width == pytest.approx(2 * 1.96 * np.sqrt(2 / n), rel=0.1)


def test_paired_bootstrap_of_equal_differences_is_a_point_and_bad_input_is_refused() -> None:
    rng = rng_of(9)
    a = np.array([1.0, 2.0, 3.0, np.nan])
    found = consistency.paired_bootstrap(a, a + 0.5, rng)
    assert (found.value, found.lower, found.upper, found.n) == (0.5, 0.5, 0.5, 3)
    with pytest.raises(InputError, match="one value per seed"):
        consistency.paired_bootstrap(a, a[:2], rng)
    with pytest.raises(InputError, match="at least two seeds"):
        consistency.paired_bootstrap(a[2:], a[2:], rng)
