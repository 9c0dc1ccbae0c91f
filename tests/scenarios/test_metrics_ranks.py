"""Rank statistics against published examples, scipy, and what chance would do."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import f, friedmanchisquare

from factorgraph.errors import InputError
from scenarios.metrics_ranks import Ranking, cliques, holm, paired_test, ranking, spread

# Table 6 of Demšar (2006): areas under the curve of C4.5 and three variants on 14 data sets; higher is better. In the last
# but one row two areas are printed alike and ranked 2 and 3; here the lower one is 0.974.
DEMSAR = np.array([
    [0.763, 0.768, 0.771, 0.798], [0.599, 0.591, 0.590, 0.569], [0.954, 0.971, 0.968, 0.967], [0.628, 0.661, 0.654, 0.657],
    [0.882, 0.888, 0.886, 0.898], [0.936, 0.931, 0.916, 0.931], [0.661, 0.668, 0.609, 0.685], [0.583, 0.583, 0.563, 0.625],
    [0.775, 0.838, 0.866, 0.875], [1.000, 1.000, 1.000, 1.000], [0.940, 0.962, 0.965, 0.962], [0.619, 0.666, 0.614, 0.669],
    [0.972, 0.981, 0.975, 0.974], [0.957, 0.978, 0.946, 0.970],
])  # fmt: skip


def test_the_worked_example_of_demsar() -> None:
    found = ranking(-DEMSAR)
    assert found.mean_ranks == pytest.approx([3.143, 2.000, 2.893, 1.964], abs=5e-4)
    assert found.critical_difference == pytest.approx(2.569 * np.sqrt(4 * 5 / (6 * 14)), abs=1e-3)
    uncorrected = 12 * 14 / (4 * 5) * (np.sum(found.mean_ranks**2) - 4 * 25 / 4)  # for ties, as there
    assert uncorrected == pytest.approx(9.28, abs=5e-3) and found.p < f.sf(3.69, 3, 39)
    assert ranking(-DEMSAR, 0.10).critical_difference == pytest.approx(1.12, abs=5e-3)


def test_friedman_is_the_f_form_of_scipys_with_ties() -> None:
    n, k = DEMSAR.shape
    chi2 = friedmanchisquare(*DEMSAR.T).statistic
    assert ranking(-DEMSAR).p == pytest.approx(f.sf((n - 1) * chi2 / (n * (k - 1) - chi2), k - 1, (k - 1) * (n - 1)))


def test_ranks_of_equal_costs_are_shared_and_say_nothing() -> None:
    found = ranking(np.ones((5, 3)))
    assert found.mean_ranks.tolist() == [2.0, 2.0, 2.0] and found.p == 1.0
    assert cliques(found) == [[0, 1, 2]]
    always = ranking(np.tile([3.0, 1.0, 2.0], (6, 1)))
    assert always.mean_ranks.tolist() == [3.0, 1.0, 2.0] and always.p == 0.0


def test_methods_within_a_critical_difference_are_joined_once() -> None:
    ranks = np.array([4.4, 1.0, 1.5, 2.4, 4.2])
    assert cliques(Ranking(ranks, 9, 0.0, 1.0)) == [[1, 2], [2, 3], [4, 0]]
    assert cliques(Ranking(ranks, 9, 0.0, 0.1)) == []
    assert cliques(Ranking(ranks, 9, 0.0, 4.0)) == [[1, 2, 3, 4, 0]]


def test_nemenyi_rarely_tells_apart_what_is_the_same() -> None:
    rng = np.random.default_rng(1)
    apart = [np.ptp((r := ranking(rng.normal(size=(30, 7)))).mean_ranks) > r.critical_difference for _ in range(200)]
    assert np.mean(apart) < 0.11  # level 0.05, standard deviation 0.015


def test_signed_ranks_by_hand() -> None:
    first = np.array([5.0, 5.0, 5.0, 5.0, 5.0, 5.0])
    found = paired_test(first, np.array([4.0, 3.0, 2.0, 1.0, 0.0, 5.0]))
    assert found.p == pytest.approx(2 / 2**5)  # all five uneven pairs alike; the even one says nothing
    assert (found.n_lower, found.n_higher, found.n_even) == (5, 0, 1)
    assert found.median_difference == -2.5 and found.sign == -1
    assert paired_test(first, first + np.array([0.0, 0.0, 0.0, 0.0, -1.0, 2.0])).sign == 1
    same = paired_test(first, first)
    assert same.p == 1.0 and same.n_even == 6 and same.sign == 0


def test_signed_ranks_see_a_shift_and_not_noise() -> None:
    rng = np.random.default_rng(4)
    base, noise = rng.normal(size=(300, 25)), rng.normal(size=(300, 25))
    p = np.array([paired_test(a, a + e).p for a, e in zip(base, noise, strict=True)])
    shifted = np.array([paired_test(a, a + e + 1.0).p for a, e in zip(base, noise, strict=True)])
    assert np.mean(p < 0.05) < 0.09 and np.mean(shifted < 0.05) > 0.95


def test_holm_by_hand() -> None:
    assert holm(np.array([0.01, 0.04, 0.03, 0.005])) == pytest.approx([0.03, 0.06, 0.06, 0.02])
    assert holm(np.array([0.6, 0.7])).tolist() == [1.0, 1.0]
    assert holm(np.zeros(0)).size == 0


def test_spread_is_of_quartiles() -> None:
    found = spread(np.array([4.0, 1.0, 2.0, 3.0, 90.0]))
    assert (found.lower, found.median, found.upper, found.n) == (2.0, 3.0, 4.0, 5)


def test_what_cannot_be_judged_is_said() -> None:
    with pytest.raises(InputError, match="values"):
        spread(np.zeros(0))
    with pytest.raises(InputError, match=r"got shape \(4, 1\)"):
        ranking(np.zeros((4, 1)))
    with pytest.raises(InputError, match="finite"):
        ranking(np.array([[1.0, np.nan]]))
    with pytest.raises(InputError, match=r"got \(3,\) and \(2,\)"):
        paired_test(np.zeros(3), np.zeros(2))
    with pytest.raises(InputError, match="must be finite"):
        paired_test(np.array([1.0, np.inf]), np.array([1.0, np.inf]))
