"""The worked example of de Jonge and Tiberius (1996), every step of it."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from ambiguity import bootstrap, decorrelate, factorise, fix, integer_least_squares, ratio_test
from ambiguity.partial import FixStatus

Q_A = np.array([[6.290, 5.978, 0.544], [5.978, 6.292, 2.340], [0.544, 2.340, 6.288]])
A_FLOAT = np.array([5.450, 3.100, 2.970])


def test_published_integers_and_norms() -> None:
    result = integer_least_squares(A_FLOAT, Q_A)
    assert result.candidates.tolist() == [[5, 3, 4], [6, 4, 4]]
    np.testing.assert_allclose(result.norms, [0.2183, 0.3073], atol=1e-4)
    assert result.proven


def test_published_decorrelated_variances() -> None:
    Qz = decorrelate(Q_A).covariance
    np.testing.assert_allclose(np.sort(np.diag(Qz)), [0.626, 1.146, 4.476], atol=1e-9)
    np.testing.assert_allclose(np.sort(np.abs(Qz[np.triu_indices(3, 1)])), [0.082, 0.230, 0.334], atol=1e-9)


def test_factors_rebuild_the_covariance() -> None:
    U, D, order = factorise(Q_A)
    np.testing.assert_allclose((U * D) @ U.T, Q_A[np.ix_(order, order)], atol=1e-14)
    assert np.all(np.tril(U, -1) == 0) and np.all(np.diag(U) == 1)
    assert D.prod() == pytest.approx(np.linalg.det(Q_A), rel=1e-12)


def test_brute_force_finds_the_published_integers() -> None:
    box = np.array(list(itertools.product(range(-2, 12), repeat=3)))
    d = A_FLOAT - box
    cost = np.einsum("ki,ki->k", d, np.linalg.solve(Q_A, d.T).T)
    order = np.argsort(cost)[:6]
    result = integer_least_squares(A_FLOAT, Q_A, n_candidates=6)
    np.testing.assert_array_equal(result.candidates, box[order])
    np.testing.assert_allclose(result.norms, cost[order], rtol=1e-12)


def test_the_example_is_too_weak_to_be_fixed() -> None:
    assert not ratio_test(integer_least_squares(A_FLOAT, Q_A).norms, 2.0).passed
    assert fix(A_FLOAT, Q_A).status is FixStatus.FLOAT
    assert bootstrap(A_FLOAT, Q_A).integers.tolist() == [5, 3, 4]
