"""Forty ambiguities where other searches stop or err: a full enumeration in another basis finds the same pair."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ambiguity import integer_least_squares, success_rate
from ambiguity.types import Array
from tests.ambiguity.independent import lenstra, vectors_within
from tests.ambiguity.models import double_difference_covariance, draw_float, random_covariance

MARGIN = 1e-6  # of the squared radius: holds the pair in spite of rounding, and nothing else


def require_exact(a: Array, Q: Array) -> int:
    """The pair is proven, and all that a full enumeration finds as near; nodes of the search."""
    ours = integer_least_squares(a, Q)
    assert ours.proven
    integers, norms = vectors_within(a, Q, ours.norms[1] * (1 + MARGIN))
    np.testing.assert_array_equal(integers, ours.candidates)
    np.testing.assert_allclose(norms, ours.norms, rtol=1e-7)
    return ours.nodes


@pytest.mark.parametrize("n_sats", [(21,), (8, 8, 7)])
def test_strong_models_that_need_many_nodes(n_sats: tuple[int, ...]) -> None:
    """Forty draws: 3 mm phase, all of one precision. The truth is found; what takes time is the second candidate."""
    rng = np.random.default_rng(3)
    nodes = []
    for _ in range(20):
        Q = double_difference_covariance(rng, n_sats, 2, 0.003, 0.6, weighted=False)
        a, truth = draw_float(rng, Q)
        nodes.append(require_exact(a, Q))
        assert success_rate(Q) > 0.9999
        np.testing.assert_array_equal(integer_least_squares(a, Q, 1).candidates[0], truth)
    assert np.median(nodes) > 5000


@pytest.mark.parametrize("weighted", [True, False])
def test_weak_models(weighted: bool) -> None:
    """Code of 1.5 m, phase of 10 mm."""
    rng = np.random.default_rng(4)
    nodes = []
    for _ in range(10):
        Q = double_difference_covariance(rng, (8, 8, 7), 2, 0.010, 1.5, weighted=weighted)
        a, truth = draw_float(rng, Q)
        nodes.append(require_exact(a, Q))
        d = a - truth
        assert integer_least_squares(a, Q).norms[0] <= d @ np.linalg.solve(Q, d) * (1 + 1e-9)
    assert np.median(nodes) > 1000


def test_the_order_of_weak_ambiguities_does_not_matter() -> None:
    rng = np.random.default_rng(77)
    for _ in range(5):
        Q = double_difference_covariance(rng, (8, 8, 7), 2, 0.010, 1.5)
        a, _ = draw_float(rng, Q)
        p = rng.permutation(len(Q))
        plain, permuted = integer_least_squares(a, Q), integer_least_squares(a[p], Q[np.ix_(p, p)])
        assert plain.proven and permuted.proven
        np.testing.assert_array_equal(permuted.candidates, plain.candidates[:, p])


def test_what_a_budget_cut_short_never_claims_to_be_proven() -> None:
    """Without enough nodes the pair may be wrong; it is then no nearer than the proven one, and says so."""
    rng = np.random.default_rng(6)
    wrong = 0
    for _ in range(10):
        Q = double_difference_covariance(rng, (8, 8, 7), 2, 0.010, 1.5)
        a, _ = draw_float(rng, Q)
        full = integer_least_squares(a, Q)
        cut = integer_least_squares(a, Q, max_nodes=full.nodes // 20)
        assert not cut.proven and np.all(cut.norms >= full.norms)
        wrong += not np.array_equal(cut.candidates, full.candidates)
    assert wrong >= 1


@settings(max_examples=100, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), n=st.integers(1, 14), spread=st.floats(0, 2))
def test_random_models_of_any_size(seed: int, n: int, spread: float) -> None:
    rng = np.random.default_rng(seed)
    require_exact(rng.uniform(-9, 9, n), random_covariance(rng, n, spread))


def test_the_enumeration_is_itself_complete() -> None:
    """Against counting in a box: every vector of the ellipsoid, none twice, none outside."""
    rng = np.random.default_rng(2)
    for n in (1, 2, 3):
        Q, a = random_covariance(rng, n, 0.5), rng.uniform(-5, 5, n)
        box = np.stack(np.meshgrid(*[np.arange(-60, 61)] * n, indexing="ij"), axis=-1).reshape(-1, n)
        cost = np.einsum("ki,ki->k", a - box, np.linalg.solve(Q, (a - box).T).T)
        radius = np.sort(cost)[9] * (1 + 1e-9)
        integers, norms = vectors_within(a, Q, radius)
        np.testing.assert_array_equal(integers, box[np.argsort(cost)[:10]])
        np.testing.assert_allclose(norms, np.sort(cost)[:10], rtol=1e-9)


def test_the_other_basis_is_unimodular_and_differs() -> None:
    rng = np.random.default_rng(2)
    Q = double_difference_covariance(rng, (8, 8, 7), 2, 0.010, 1.5)
    T = lenstra(np.ascontiguousarray(np.linalg.cholesky(np.linalg.inv(Q)).T))
    assert abs(round(np.linalg.det(T.astype(float)))) == 1
    assert np.any(T != np.eye(len(Q), dtype=np.int64))
