"""Pivot changes form a group, and every transition is the one the single differences make."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ambiguity.search import integer_least_squares
from ambiguity.states import DoubleDifferences, change_pivot, follow, stack
from tests.ambiguity.models import random_covariance

NAMES = [f"G{i:02d}" for i in range(1, 11)]
seeds = st.integers(0, 2**32 - 1)


def difference(dd: DoubleDifferences, single: dict[str, int]) -> list[int]:
    return [single[str(s)] - single[str(dd.pivot)] for s in dd.satellites]


def draw(rng: np.random.Generator, n_sat: int) -> DoubleDifferences:
    names = rng.permutation(NAMES)[:n_sat].tolist()
    return DoubleDifferences(names[0], tuple(names[1:]))


@settings(max_examples=80, deadline=None)
@given(seed=seeds, n_sat=st.integers(1, 10))
def test_pivot_changes_are_a_group_of_integer_matrices(seed: int, n_sat: int) -> None:
    rng = np.random.default_rng(seed)
    start = draw(rng, n_sat)
    names = (start.pivot, *start.satellites)
    p, q = names[rng.integers(n_sat)], names[rng.integers(n_sat)]
    to_p = change_pivot(start, p)
    to_q, back = change_pivot(to_p.after, q), change_pivot(to_p.after, start.pivot)
    assert back.after == start
    np.testing.assert_array_equal(back.T @ to_p.T, np.eye(n_sat - 1))
    assert round(np.linalg.det(to_p.T)) == (1 if p == start.pivot else -1)
    assert not (to_p.fresh.any() or to_q.fresh.any())
    np.testing.assert_array_equal(to_q.T @ to_p.T, follow(start, to_q.after).T)
    single = {s: int(rng.integers(-(10**9), 10**9)) for s in NAMES}
    assert (to_p.T @ np.array(difference(start, single), np.int64)).tolist() == difference(to_p.after, single)


@settings(max_examples=80, deadline=None)
@given(seed=seeds, n_before=st.integers(1, 8), n_after=st.integers(1, 8), n_slips=st.integers(0, 2))
def test_a_transition_is_that_of_the_single_differences(seed: int, n_before: int, n_after: int, n_slips: int) -> None:
    rng = np.random.default_rng(seed)
    before, after = draw(rng, n_before), draw(rng, n_after)
    slipped = set(rng.permutation([str(before.pivot), *map(str, before.satellites)])[:n_slips].tolist())
    step = follow(before, after, slipped)
    held = {before.pivot, *before.satellites} - slipped
    assert step.fresh.tolist() == [not (s in held and after.pivot in held) for s in after.satellites]
    single = {s: int(rng.integers(-(10**6), 10**6)) for s in NAMES}
    old, new = np.array(difference(before, single), float), np.array(difference(after, single), float)
    Q = random_covariance(rng, n_before - 1)
    a, Q_new = step.apply(old, Q, 100.0, 7.0)
    np.testing.assert_array_equal(a, np.where(step.fresh, 7.0, new))
    known = ~step.fresh
    np.testing.assert_allclose(Q_new[np.ix_(known, known)], (step.T @ Q @ step.T.T)[np.ix_(known, known)], atol=1e-12)
    np.testing.assert_array_equal(Q_new[step.fresh], 100.0 * np.eye(n_after - 1)[step.fresh])
    np.testing.assert_array_equal(Q_new, Q_new.T)
    carried = step.carry(old)
    np.testing.assert_array_equal(carried, np.where(step.fresh, np.nan, new))


@settings(max_examples=30, deadline=None)
@given(seed=seeds, n_sat=st.integers(2, 7))
def test_integers_are_the_same_whatever_the_pivot(seed: int, n_sat: int) -> None:
    rng = np.random.default_rng(seed)
    start = draw(rng, n_sat)
    a, Q = rng.uniform(-9, 9, n_sat - 1), random_covariance(rng, n_sat - 1)
    step = change_pivot(start, start.satellites[-1])
    here, there = integer_least_squares(a, Q), integer_least_squares(*step.apply(a, Q, 1.0))
    np.testing.assert_allclose(there.norms, here.norms, rtol=1e-6)
    np.testing.assert_array_equal(there.candidates, here.candidates @ step.T.T)


def test_a_worked_change() -> None:
    before = DoubleDifferences("A", ("B", "C", "D"))
    step = change_pivot(before, "C")
    assert step.after == DoubleDifferences("C", ("B", "A", "D"))
    assert step.T.tolist() == [[1, -1, 0], [0, -1, 0], [0, -1, 1]]
    gone = follow(step.after, DoubleDifferences("C", ("D", "E", "B")), slipped=["B"])
    assert gone.T.tolist() == [[0, 0, 1], [0, 0, 0], [0, 0, 0]] and gone.fresh.tolist() == [False, True, True]
    a, Q = gone.apply([1.0, 2.0, 3.0], np.diag([4.0, 5.0, 6.0]), [1.0, 2.0, 3.0], [7.0, 8.0, 9.0])
    assert a.tolist() == [3.0, 8.0, 9.0] and np.diag(Q).tolist() == [6.0, 2.0, 3.0]


def test_unknown_integers_make_what_needs_them_unknown() -> None:
    step = change_pivot(DoubleDifferences("A", ("B", "C", "D")), "C")
    np.testing.assert_array_equal(step.carry([1, 2, np.nan]), [-1, -2, np.nan])
    assert np.isnan(step.carry([1, np.nan, 3])).all()


def test_a_pivot_that_slips_or_goes_loses_all_but_a_change_in_time_saves_them() -> None:
    before = DoubleDifferences("A", ("B", "C"))
    assert follow(before, before, slipped=["A"]).fresh.all()
    assert follow(before, DoubleDifferences("X", ("B", "C"))).fresh.all()
    saved = follow(before, DoubleDifferences("B", ("A", "C")), slipped=["A"])
    assert saved.fresh.tolist() == [True, False] and saved.T.tolist() == [[0, 0], [-1, 1]]


def test_sets_of_one_filter_are_stacked() -> None:
    first = change_pivot(DoubleDifferences(("A", "L1"), [("B", "L1")]), ("B", "L1"))  # type: ignore[arg-type]
    second = follow(DoubleDifferences("A", ("B",)), DoubleDifferences("A", ("C", "B")))
    T, fresh = stack([first, second])
    assert T.tolist() == [[-1, 0], [0, 0], [0, 1]] and fresh.tolist() == [False, True, False]
    assert stack([])[0].shape == (0, 0)


def test_no_double_difference() -> None:
    alone = DoubleDifferences("A", ())
    assert change_pivot(alone, "A").T.shape == (0, 0)
    a, Q = follow(alone, DoubleDifferences("A", ("B",))).apply([], np.zeros((0, 0)), 9.0)
    assert a.tolist() == [0.0] and Q.tolist() == [[9.0]]


def test_wrong_input_is_named() -> None:
    with pytest.raises(ValueError, match="satellite B is given twice"):
        DoubleDifferences("A", ("B", "C", "B"))
    with pytest.raises(ValueError, match="satellite A is given twice, it is the pivot"):
        DoubleDifferences("A", ("B", "A"))
    before = DoubleDifferences("A", ("B", "C"))
    with pytest.raises(ValueError, match="satellite X is not among the double differences"):
        change_pivot(before, "X")
    with pytest.raises(ValueError, match=r"in neither set of double differences: \['X'\]"):
        follow(before, before, ["X"])
    step = follow(before, DoubleDifferences("A", ("B", "D")))
    good = np.eye(2)
    for a, Q, variance, value, text in (
        ([1.0], np.eye(1), 1.0, 0.0, "a must hold the 2 ambiguities"),
        ([1.0, 2.0], np.eye(3), 1.0, 0.0, r"Q must have shape \(2, 2\)"),
        ([1.0, 2.0], good, 0.0, 0.0, "fresh_variance must be positive"),
        ([1.0, 2.0], good, np.inf, 0.0, "fresh_variance must be finite"),
        ([1.0, 2.0], good, 1.0, np.nan, "fresh_value must be finite"),
        ([1.0, 2.0], good, [1.0], 0.0, r"fresh_variance must be a number or have shape \(2,\), got \(1,\)"),
    ):
        with pytest.raises(ValueError, match=text):
            step.apply(a, Q, variance, value)
    with pytest.raises(ValueError, match=r"integers must have shape \(2,\)"):
        step.carry([1])
    with pytest.raises(ValueError, match="must hold integers"):
        step.carry([0.5, 1])
