"""Batches against their single calls, row by row, and what a bad row does."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ambiguity.batch import bootstrap_batch, integer_least_squares_batch, round_each_batch, strength_batch
from ambiguity.bootstrapping import adop, bootstrap, round_each, success_rate
from ambiguity.search import integer_least_squares
from ambiguity.types import Array
from tests.ambiguity.models import double_difference_covariance, draw_float, random_covariance


def draws(rng: np.random.Generator, n: int, n_rows: int) -> tuple[Array, Array]:
    Q = np.array([random_covariance(rng, n) for _ in range(n_rows)]).reshape(n_rows, n, n)
    return np.array([draw_float(rng, q)[0] for q in Q]).reshape(n_rows, n), Q


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), n=st.integers(1, 10), n_rows=st.integers(0, 6), k=st.integers(1, 3))
def test_rows_are_their_single_calls(seed: int, n: int, n_rows: int, k: int) -> None:
    a, Q = draws(np.random.default_rng(seed), n, n_rows)
    result, rounded, boot, strength = (
        integer_least_squares_batch(a, Q, k),
        round_each_batch(a, Q),
        bootstrap_batch(a, Q),
        strength_batch(Q),
    )
    assert result.candidates.shape == (n_rows, k, n)
    assert not (result.faults or rounded.faults or boot.faults or strength.faults)
    for b in range(n_rows):
        one = integer_least_squares(a[b], Q[b], k)
        np.testing.assert_array_equal(result.candidates[b], one.candidates)
        np.testing.assert_array_equal(result.norms[b], one.norms)
        assert (result.proven[b], result.nodes[b]) == (one.proven, one.nodes)
        for batch, single in ((rounded, round_each(a[b], Q[b])), (boot, bootstrap(a[b], Q[b]))):
            np.testing.assert_array_equal(batch.integers[b], single.integers)
            assert batch.success_rate[b] == pytest.approx(single.success_rate, rel=1e-12)
        assert strength.success_rate[b] == pytest.approx(success_rate(Q[b]), rel=1e-12)
        assert strength.adop[b] == pytest.approx(adop(Q[b]), rel=1e-10)


def test_one_covariance_serves_all_rows() -> None:
    rng = np.random.default_rng(7)
    Q = double_difference_covariance(rng, (7,), 2, 0.003, 0.3)
    a = np.array([draw_float(rng, Q, 10**7)[0] for _ in range(50)])
    shared, each = integer_least_squares_batch(a, Q), integer_least_squares_batch(a, np.repeat(Q[None], 50, axis=0))
    np.testing.assert_array_equal(shared.candidates, each.candidates)
    np.testing.assert_allclose(shared.norms, each.norms, rtol=1e-6)
    np.testing.assert_array_equal(bootstrap_batch(a, Q).integers, bootstrap_batch(a, np.repeat(Q[None], 50, axis=0)).integers)
    np.testing.assert_allclose(round_each_batch(a, Q).success_rate, round_each(a[0], Q).success_rate)


def test_a_bad_row_is_named_and_loses_no_other() -> None:
    rng = np.random.default_rng(3)
    a, Q = draws(rng, 4, 6)
    good = integer_least_squares_batch(a, Q)
    bad_a, bad_Q = a.copy(), Q.copy()
    bad_a[1, 2] = np.nan
    bad_Q[3] = 1.0
    bad_Q[4, 0, 1] += 1e3
    result = integer_least_squares_batch(bad_a, bad_Q)
    assert [row for row, _ in result.faults] == [1, 3, 4]
    for (_, text), expected in zip(
        result.faults, ("a_float[2] is nan", "Q must be positive definite", "Q must be symmetric"), strict=True
    ):
        assert expected in text
    assert not result.proven[[1, 3, 4]].any() and np.isnan(result.norms[[1, 3, 4]]).all()
    assert not result.candidates[[1, 3, 4]].any()
    rest = [0, 2, 5]
    np.testing.assert_array_equal(result.candidates[rest], good.candidates[rest])
    np.testing.assert_array_equal(result.norms[rest], good.norms[rest])
    boot, rounded, strength = bootstrap_batch(bad_a, bad_Q), round_each_batch(bad_a, bad_Q), strength_batch(bad_Q)
    assert [row for row, _ in boot.faults] == [1, 3, 4] and np.isnan(boot.success_rate[[1, 3, 4]]).all()
    assert [row for row, _ in rounded.faults] == [1, 4]  # rounding by itself needs no factors
    assert np.isnan(rounded.success_rate[[1, 4]]).all() and np.isfinite(rounded.success_rate[[0, 2, 3, 5]]).all()
    assert [row for row, _ in strength.faults] == [3, 4] and np.isnan(strength.adop[[3, 4]]).all()
    assert np.isfinite(strength.adop[[0, 1, 2, 5]]).all()


def test_a_bad_shared_covariance_faults_every_row() -> None:
    result = integer_least_squares_batch(np.zeros((3, 2)), np.ones((2, 2)))
    assert [row for row, _ in result.faults] == [0, 1, 2] and not result.proven.any()
    assert integer_least_squares_batch(np.zeros((0, 2)), np.ones((2, 2))).faults == ()


def test_a_spent_budget_is_no_fault_and_stays_in_its_row() -> None:
    rng = np.random.default_rng(3)
    a, Q = draws(rng, 8, 5)
    free = integer_least_squares_batch(a, Q)
    budget = int(np.median(free.nodes))
    cut = integer_least_squares_batch(a, Q, max_nodes=budget)
    np.testing.assert_array_equal(cut.proven, free.nodes <= budget)
    assert cut.faults == () and np.isfinite(cut.norms).all()


def test_nothing_and_one() -> None:
    none = integer_least_squares_batch(np.zeros((3, 0)), np.zeros((3, 0, 0)))
    assert none.candidates.shape == (3, 1, 0) and none.norms.tolist() == [[0.0]] * 3 and none.proven.all()
    assert strength_batch(np.zeros((2, 0, 0))).success_rate.tolist() == [1.0, 1.0]
    assert np.isnan(strength_batch(np.zeros((2, 0, 0))).adop).all()
    assert bootstrap_batch(np.zeros((2, 0)), np.zeros((0, 0))).success_rate.tolist() == [1.0, 1.0]
    one = integer_least_squares_batch([[2.25], [-0.4]], [[0.25]])
    assert one.candidates[..., 0].tolist() == [[2, 3], [0, -1]]


@pytest.mark.parametrize(
    ("a", "Q", "text"),
    [
        (np.zeros(3), np.eye(3), r"a_float must have shape \(B, n\), got \(3,\)"),
        (np.zeros((2, 3)), np.eye(2), r"Q must have shape \(2, 3, 3\) or \(3, 3\)"),
        (np.zeros((2, 3)), np.zeros((3, 3, 3)), r"got \(3, 3, 3\)"),
    ],
)
def test_wrong_shapes_are_named(a: Array, Q: Array, text: str) -> None:
    for call in (integer_least_squares_batch, bootstrap_batch, round_each_batch):
        with pytest.raises(ValueError, match=text):
            call(a, Q)


def test_wrong_options_are_named() -> None:
    with pytest.raises(ValueError, match="n_candidates must be at least 1, got 0"):
        integer_least_squares_batch(np.zeros((1, 1)), np.eye(1), 0)
    with pytest.raises(ValueError, match=r"Q must have shape \(B, n, n\), got \(2, 2\)"):
        strength_batch(np.eye(2))
