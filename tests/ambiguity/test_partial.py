"""Partial fixing: what is fixed is right, as much as the tests allow, and conditioning agrees with the textbook."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ambiguity import FixStatus, condition, decorrelate, fix, integer_least_squares, success_rate
from ambiguity.partial import fix_ordered
from ambiguity.types import Array
from tests.ambiguity.models import double_difference_covariance, draw_float, random_covariance

seeds = st.integers(0, 2**32 - 1)


def block_diagonal(*blocks: Array) -> Array:
    n = sum(len(b) for b in blocks)
    Q, at = np.zeros((n, n)), 0
    for b in blocks:
        Q[at : at + len(b), at : at + len(b)] = b
        at += len(b)
    return Q


def test_a_strong_model_is_fixed_in_full() -> None:
    rng = np.random.default_rng(1)
    for _ in range(20):
        Q = double_difference_covariance(rng, (7,), 2, 0.002, 0.2, 5)
        a, truth = draw_float(rng, Q, spread_cyc=10**8)
        result = fix(a, Q)
        assert result.status is FixStatus.FIXED and result.fixed.all()
        np.testing.assert_array_equal(result.integers, truth)
        np.testing.assert_array_equal(result.Z_fixed @ truth, result.z)
        assert result.ratio == result.ratio_all >= 3.0
        assert result.success_rate == result.success_rate_all == pytest.approx(success_rate(Q))


def test_the_full_set_carries_the_ratio_of_least_squares() -> None:
    rng = np.random.default_rng(3)
    Q = double_difference_covariance(rng, (7,), 2, 0.005, 0.3)
    a, _ = draw_float(rng, Q)
    norms = integer_least_squares(a, Q).norms
    result = fix(a, Q, ratio_threshold=1.0, min_success_rate=0.0)
    assert result.status is FixStatus.FIXED
    assert result.ratio == pytest.approx(norms[1] / norms[0], rel=1e-9)


def test_only_the_good_half_is_fixed() -> None:
    """Two independent groups: what is precise is fixed and named, the rest stays float."""
    rng = np.random.default_rng(5)
    good, bad = double_difference_covariance(rng, (5,), 2, 0.001, 0.1, 10), 50.0 * np.eye(3)
    Q = block_diagonal(bad, good)
    order = rng.permutation(len(Q))
    Q = Q[np.ix_(order, order)]
    a, truth = draw_float(rng, Q)
    result = fix(a, Q)
    assert result.status is FixStatus.PARTIAL
    np.testing.assert_array_equal(result.fixed, order >= 3)
    np.testing.assert_array_equal(result.integers[result.fixed], truth[result.fixed])
    assert np.isnan(result.integers[~result.fixed]).all()
    assert result.z.shape == (8,)
    assert result.success_rate >= 0.999 > result.success_rate_all


def test_combinations_can_be_fixed_where_no_single_ambiguity_can() -> None:
    """A model at its limit: some combinations are sure while few of their members are."""
    rng = np.random.default_rng(8)
    seen = n_constraints = n_single = 0
    for _ in range(40):
        Q = double_difference_covariance(rng, (6,), 2, 0.003, 0.3)
        a, truth = draw_float(rng, Q)
        result = fix(a, Q, min_success_rate=0.99)
        if result.status is not FixStatus.PARTIAL:
            continue
        seen, n_constraints, n_single = seen + 1, n_constraints + len(result.z), n_single + result.fixed.sum()
        np.testing.assert_array_equal(result.Z_fixed @ truth, result.z)
        assert np.linalg.matrix_rank(result.Z_fixed) == len(result.z) < len(a)
        assert result.ratio >= 3.0 and result.success_rate >= 0.99
        a_cond, Q_cond = condition(a, Q, result.Z_fixed, result.z)
        np.testing.assert_allclose(result.Z_fixed @ a_cond, result.z, atol=1e-7)
        assert np.linalg.norm(a_cond - truth) < 5 * np.sqrt(np.trace(Q_cond)) + 1e-6
        assert np.trace(Q_cond) < np.trace(Q)
    assert seen >= 10 and n_single < 0.5 * n_constraints


def test_wrong_fixes_stay_rare() -> None:
    rng = np.random.default_rng(13)
    n_fixed = n_wrong = 0
    for _ in range(400):
        Q = double_difference_covariance(rng, (7,), 2, 0.003, 0.5)
        a, truth = draw_float(rng, Q)
        result = fix(a, Q, ratio_threshold=2.0, min_success_rate=0.99)
        if result.z.size:
            n_fixed += 1
            n_wrong += not np.array_equal(result.Z_fixed @ truth, result.z)
    assert n_fixed > 200
    assert n_wrong <= 0.02 * n_fixed


@settings(max_examples=80, deadline=None)
@given(seed=seeds, n=st.integers(1, 12), p=st.floats(0, 0.9999), ratio=st.floats(1, 4))
def test_result_is_consistent_in_itself(seed: int, n: int, p: float, ratio: float) -> None:
    rng = np.random.default_rng(seed)
    Q = random_covariance(rng, n)
    a, _ = draw_float(rng, Q)
    r = fix(a, Q, ratio, p)
    m = len(r.z)
    assert r.Z_fixed.shape == (m, n) and m == {FixStatus.FIXED: n, FixStatus.FLOAT: 0}.get(r.status, m)
    assert np.array_equal(np.isfinite(r.integers), r.fixed)
    if m:
        assert r.ratio >= ratio and r.success_rate >= p
    if r.status is FixStatus.PARTIAL:
        assert 0 < m < n and not r.fixed.all()
        assert r.success_rate_all < p or r.ratio_all < ratio
        # an ambiguity is determined exactly where its unit vector lies in the row space of the constraints
        within = np.array([np.linalg.matrix_rank(np.vstack([r.Z_fixed, e])) == m for e in np.eye(n)])
        np.testing.assert_array_equal(r.fixed, within)
        particular = np.linalg.lstsq(r.Z_fixed.astype(float), r.z.astype(float), rcond=None)[0]
        np.testing.assert_allclose(particular[r.fixed], r.integers[r.fixed], atol=1e-6)
    if r.status is FixStatus.FLOAT:
        assert np.isnan(r.ratio) and np.isnan(r.success_rate)


def test_more_is_fixed_when_less_is_asked() -> None:
    rng = np.random.default_rng(4)
    Q = double_difference_covariance(rng, (6,), 2, 0.004, 1.0)
    a, _ = draw_float(rng, Q)
    sizes = [len(fix(a, Q, 1.0, p).z) for p in (0.99999, 0.999, 0.99, 0.9, 0.0)]
    assert sizes == sorted(sizes) and sizes[-1] == len(a)


def test_offset_only_moves_the_values() -> None:
    rng = np.random.default_rng(6)
    Q = block_diagonal(9.0 * np.eye(2), double_difference_covariance(rng, (7,), 2, 0.001, 0.1, 10))
    a = np.rint(draw_float(rng, Q)[0] * 1024) / 1024
    near, far = fix(a, Q), fix(a + 10**8, Q)
    assert near.status is far.status is FixStatus.PARTIAL
    np.testing.assert_array_equal(near.Z_fixed, far.Z_fixed)
    np.testing.assert_array_equal(far.z - near.z, 10**8 * near.Z_fixed.sum(axis=1))


def test_an_unproven_search_fixes_nothing() -> None:
    rng = np.random.default_rng(6)
    Q = double_difference_covariance(rng, (7,), 2, 0.002, 0.2, 5)
    a, _ = draw_float(rng, Q)
    assert fix(a, Q).status is FixStatus.FIXED
    starved = fix(a, Q, max_nodes=2)
    assert starved.status is not FixStatus.FIXED and np.isnan(starved.ratio_all)


def test_nothing_to_fix() -> None:
    result = fix([], np.zeros((0, 0)))
    assert result.status is FixStatus.NONE and result.integers.shape == result.z.shape == (0,)
    a, Q = condition([], np.zeros((0, 0)), np.zeros((0, 0)), [])
    assert a.shape == (0,) and Q.shape == (0, 0)


def test_one_ambiguity() -> None:
    assert fix([7.1], [[1e-3]]).integers.tolist() == [7.0]
    assert fix([7.4], [[1e-3]]).status is FixStatus.FLOAT  # ratio 2.25
    assert fix([7.1], [[1.0]]).status is FixStatus.FLOAT  # success rate 0.38


@settings(max_examples=50, deadline=None)
@given(seed=seeds, n=st.integers(1, 10), data=st.data())
def test_conditioning_is_the_gaussian_one(seed: int, n: int, data: st.DataObject) -> None:
    rng = np.random.default_rng(seed)
    m = data.draw(st.integers(0, n))
    Q, a = random_covariance(rng, n, spread=1.0), rng.uniform(-9, 9, n)
    Z, z = decorrelate(Q).Z[n - m :], rng.integers(-9, 10, m)
    a_cond, Q_cond = condition(a, Q, Z, z)
    S = Z @ Q @ Z.T
    np.testing.assert_allclose(a_cond, a + Q @ Z.T @ np.linalg.solve(S, z - Z @ a), atol=1e-7)
    np.testing.assert_allclose(Q_cond, Q - Q @ Z.T @ np.linalg.solve(S, Z @ Q), atol=1e-7)
    np.testing.assert_array_equal(Q_cond, Q_cond.T)
    assert np.linalg.eigvalsh(Q_cond)[0] > -1e-12
    np.testing.assert_allclose(Z @ a_cond, z, atol=1e-7)


def test_conditioning_on_all_integers_leaves_nothing_open() -> None:
    rng = np.random.default_rng(3)
    Q = double_difference_covariance(rng, (8, 8, 7), 2, 0.003, 0.3)
    a, truth = draw_float(rng, Q, spread_cyc=10**8)
    a_cond, Q_cond = condition(a, Q, np.eye(40, dtype=np.int64), truth)
    np.testing.assert_allclose(a_cond, truth, rtol=0, atol=1e-7)
    assert np.abs(Q_cond).max() < 1e-9


@pytest.mark.parametrize(
    ("Z", "z", "text"),
    [
        ([[1, 0], [2, 0]], [1, 2], "constraints Z a = z must be independent"),
        ([[0, 0]], [0], "must be independent"),
        ([[1, 0], [0, 1], [1, 1]], [1, 2, 3], "must be independent"),
        ([[1.5, 0]], [1], "Z must hold integers"),
        ([[1, 0]], [0.5], "z must hold integers"),
        ([[1, 0]], [np.nan], "z must hold integers"),
        ([[1, 0, 0]], [1], r"Z must have shape \(m, 2\)"),
        ([1, 0], [1], r"Z must have shape \(m, 2\)"),
    ],
)
def test_wrong_constraints_are_named(Z: object, z: object, text: str) -> None:
    with pytest.raises(ValueError, match=text):
        condition([0.1, 0.2], [[2.0, 0.5], [0.5, 1.0]], Z, z)  # type: ignore[arg-type]


def test_low_satellites_are_dropped_until_the_rest_is_sure() -> None:
    """Noise that grows towards the horizon: high satellites are fixed, each by itself, low ones stay float."""
    rng = np.random.default_rng(17)
    seen = 0
    for _ in range(40):
        elevation = np.sort(rng.uniform(0.1, 1.5, 8))[::-1]
        sigma = 0.004 / np.sin(elevation) ** 2
        Q = np.diag(sigma**2) + 0.02 * np.ones((8, 8)) * np.outer(sigma, sigma)
        order = rng.permutation(8)
        Q, elevation = Q[np.ix_(order, order)], elevation[order]
        a, truth = draw_float(rng, Q)
        result = fix_ordered(a, Q, elevation)
        if result.status is not FixStatus.PARTIAL:
            continue
        seen += 1
        assert elevation[result.fixed].min() > elevation[~result.fixed].max()
        np.testing.assert_array_equal(result.integers[result.fixed], truth[result.fixed])
        np.testing.assert_array_equal(result.Z_fixed, np.eye(8, dtype=np.int64)[result.fixed])
        kept = np.flatnonzero(result.fixed)
        subset = Q[np.ix_(kept, kept)]
        norms = integer_least_squares(a[kept], subset).norms
        assert result.ratio == pytest.approx(norms[1] / norms[0], rel=1e-8) and result.ratio >= 3
        assert result.success_rate == pytest.approx(success_rate(subset)) and result.success_rate >= 0.999
        # one more would not have passed
        more = np.sort(np.append(kept, np.flatnonzero(~result.fixed)[np.argmax(elevation[~result.fixed])]))
        wider = Q[np.ix_(more, more)]
        norms = integer_least_squares(a[more], wider).norms
        assert success_rate(wider) < 0.999 or norms[1] / norms[0] < 3
    assert seen >= 10


@settings(max_examples=60, deadline=None)
@given(seed=seeds, n=st.integers(1, 9), p=st.floats(0, 0.9999), ratio=st.floats(1, 4))
def test_ordered_and_combined_fixing_agree_on_the_whole_set(seed: int, n: int, p: float, ratio: float) -> None:
    rng = np.random.default_rng(seed)
    Q = random_covariance(rng, n)
    a, _ = draw_float(rng, Q)
    ordered, combined = fix_ordered(a, Q, rng.uniform(0, 1, n), ratio, p), fix(a, Q, ratio, p)
    assert ordered.success_rate_all == pytest.approx(combined.success_rate_all, rel=1e-12)
    assert (ordered.status is FixStatus.FIXED) == (combined.status is FixStatus.FIXED)
    if combined.status is FixStatus.FIXED:
        np.testing.assert_array_equal(ordered.integers, combined.integers)
        np.testing.assert_array_equal(ordered.Z_fixed, np.eye(n))
    np.testing.assert_array_equal(ordered.integers[ordered.fixed], ordered.z)
    assert np.isnan(ordered.integers[~ordered.fixed]).all()


@settings(max_examples=40, deadline=None)
@given(seed=seeds, n=st.integers(2, 8))
def test_ordered_fixing_follows_a_permutation(seed: int, n: int) -> None:
    rng = np.random.default_rng(seed)
    Q, priority = random_covariance(rng, n), rng.permutation(n).astype(float)
    a, _ = draw_float(rng, Q)
    order = rng.permutation(n)
    plain, permuted = (
        fix_ordered(a, Q, priority, 2.0, 0.9),
        fix_ordered(a[order], Q[np.ix_(order, order)], priority[order], 2.0, 0.9),
    )
    assert plain.status is permuted.status
    np.testing.assert_array_equal(permuted.integers, plain.integers[order])


def test_of_equal_priorities_the_later_goes_first() -> None:
    result = fix_ordered([0.01, 0.4, 0.02, 0.45], np.diag([1e-4, 4.0, 1e-4, 4.0]), [1, 1, 1, 1])
    assert result.fixed.tolist() == [True, False, False, False]  # ambiguity 1 stands in the way of 2
    result = fix_ordered([0.01, 0.4, 0.02, 0.45], np.diag([1e-4, 4.0, 1e-4, 4.0]), [np.inf, 1, 2, -np.inf])
    assert result.fixed.tolist() == [True, False, True, False]
    assert result.Z_fixed.tolist() == [[1, 0, 0, 0], [0, 0, 1, 0]] and result.z.tolist() == [0, 0]


def test_ordered_fixing_of_nothing_and_wrong_priorities() -> None:
    assert fix_ordered([], np.zeros((0, 0)), []).status is FixStatus.NONE
    assert fix_ordered([0.5], [[9.0]], [1.0]).status is FixStatus.FLOAT
    for priority in ([1.0], [1.0, np.nan], [[1.0, 2.0]]):
        with pytest.raises(ValueError, match="priority must hold 2 numbers"):
            fix_ordered([0.1, 0.2], np.eye(2), priority)
    with pytest.raises(ValueError, match="max_nodes must be at least 1"):
        fix_ordered([0.1], [[1.0]], [1.0], max_nodes=0)


def test_wrong_options_are_named() -> None:
    with pytest.raises(ValueError, match=r"min_success_rate must lie in \[0, 1\], got 1.2"):
        fix([0.1], [[1.0]], min_success_rate=1.2)
    with pytest.raises(ValueError, match="ratio threshold must be at least 1"):
        fix([0.1], [[1.0]], ratio_threshold=0.5)
    with pytest.raises(ValueError, match="max_nodes must be at least 1, got 0"):
        fix([0.1], [[1.0]], max_nodes=0)
    with pytest.raises(ValueError, match="positive definite"):
        fix([0.1, 0.2], np.ones((2, 2)))
    with pytest.raises(ValueError, match="positive definite"):
        condition([0.1, 0.2], np.ones((2, 2)), [[1, 0]], [1])
