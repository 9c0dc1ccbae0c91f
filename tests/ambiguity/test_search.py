"""Integer least squares against brute force and its own symmetries."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ambiguity import _kernels, decorrelate, integer_least_squares
from ambiguity.types import Array, IntArray
from tests.ambiguity.models import MODELS, double_difference_covariance, draw_float, random_covariance

seeds = st.integers(0, 2**32 - 1)


def squared_norm(a: Array, integers: IntArray, Q: Array) -> float:
    d = a - integers
    return float(d @ np.linalg.solve(Q, d))


def brute_force(a: Array, Q: Array, k: int) -> tuple[IntArray, Array]:
    """The k nearest vectors among all integers of the bounding box of an ellipsoid that holds enough of them."""
    centre = np.rint(a).astype(np.int64)
    neighbours = centre + np.vstack([np.zeros((1, len(a))), np.eye(len(a)), -np.eye(len(a))]).astype(np.int64)
    radius = np.sort([squared_norm(a, x, Q) for x in neighbours])[k - 1]
    half = np.sqrt(radius * np.diag(Q))
    ranges = [np.arange(np.ceil(x - h), np.floor(x + h) + 1) for x, h in zip(a, half, strict=True)]
    box = np.array(list(itertools.product(*ranges)))
    d = a - box
    cost = np.einsum("ki,ki->k", d, np.linalg.solve(Q, d.T).T)
    order = np.argsort(cost)[:k]
    return box[order].astype(np.int64), cost[order]


@settings(max_examples=150, deadline=None)
@given(seed=seeds, n=st.integers(1, 4), k=st.integers(1, 3))
def test_agrees_with_brute_force(seed: int, n: int, k: int) -> None:
    rng = np.random.default_rng(seed)
    Q = random_covariance(rng, n, spread=0.7)
    a = rng.uniform(-50, 50, n)
    expected, cost = brute_force(a, Q, k)
    result = integer_least_squares(a, Q, k)
    assert result.proven
    np.testing.assert_array_equal(result.candidates, expected)
    np.testing.assert_allclose(result.norms, cost, rtol=1e-8)


@settings(max_examples=60, deadline=None)
@given(seed=seeds, n=st.integers(1, 12), shift=st.integers(-(10**8), 10**8))
def test_integer_shift_moves_the_integers_along(seed: int, n: int, shift: int) -> None:
    rng = np.random.default_rng(seed)
    Q = random_covariance(rng, n)
    a = np.round(rng.uniform(-1, 1, n), 6)
    offset = rng.integers(-abs(shift) - 1, abs(shift) + 1, n)
    near, far = integer_least_squares(a, Q), integer_least_squares(a + offset, Q)
    np.testing.assert_allclose(far.norms, near.norms, rtol=1e-4, atol=1e-4)  # 1e8 cycles leave 1.5e-8 of fraction
    np.testing.assert_array_equal(far.candidates, near.candidates + offset)


def test_offsets_far_beyond_any_range_keep_the_integers() -> None:
    rng = np.random.default_rng(4)
    Q = double_difference_covariance(rng, *MODELS["n=12 dual"])
    a, _ = draw_float(rng, Q, spread_cyc=0)
    a = np.rint(a * 64) / 64  # exact in every sum below
    for offset in (1e8, -1e12, 2.0**45):
        shifted = integer_least_squares(a + offset, Q)
        plain = integer_least_squares(a, Q)
        np.testing.assert_array_equal(shifted.candidates - np.int64(offset), plain.candidates)
        np.testing.assert_array_equal(shifted.norms, plain.norms)


@settings(max_examples=60, deadline=None)
@given(seed=seeds, n=st.integers(1, 12), power=st.integers(-30, 30))
def test_scale_of_the_covariance_only_scales_the_norms(seed: int, n: int, power: int) -> None:
    rng = np.random.default_rng(seed)
    Q, a = random_covariance(rng, n), rng.uniform(-9, 9, n)
    plain, scaled = integer_least_squares(a, Q), integer_least_squares(a, Q * 2.0**power)
    np.testing.assert_array_equal(scaled.candidates, plain.candidates)
    np.testing.assert_array_equal(scaled.norms * 2.0**power, plain.norms)


@settings(max_examples=60, deadline=None)
@given(seed=seeds, n=st.integers(1, 12))
def test_order_of_the_ambiguities_does_not_matter(seed: int, n: int) -> None:
    rng = np.random.default_rng(seed)
    Q, a, p = random_covariance(rng, n), rng.uniform(-9, 9, n), rng.permutation(n)
    plain, permuted = integer_least_squares(a, Q), integer_least_squares(a[p], Q[np.ix_(p, p)])
    np.testing.assert_array_equal(permuted.candidates, plain.candidates[:, p])
    np.testing.assert_allclose(permuted.norms, plain.norms, rtol=1e-7)


@settings(max_examples=60, deadline=None)
@given(seed=seeds, n=st.integers(1, 8))
def test_any_basis_gives_the_same_vectors(seed: int, n: int) -> None:
    rng = np.random.default_rng(seed)
    Q, a = random_covariance(rng, n, spread=1.0), rng.uniform(-9, 9, n)
    T = np.tril(rng.integers(-3, 4, (n, n)), -1) + np.eye(n, dtype=np.int64)
    plain, mixed = integer_least_squares(a, Q), integer_least_squares(T @ a, T @ Q @ T.T)
    np.testing.assert_array_equal(mixed.candidates, plain.candidates @ T.T)


@settings(max_examples=60, deadline=None)
@given(seed=seeds, n=st.integers(1, 30), spread=st.floats(0, 6))
def test_decorrelation_is_unimodular_and_reduced(seed: int, n: int, spread: float) -> None:
    Q = random_covariance(np.random.default_rng(seed), n, spread)
    d = decorrelate(Q)
    exact = d.Z.astype(object) @ d.Z_inv.astype(object)
    assert np.array_equal(exact, np.eye(n, dtype=object))
    assert np.all(np.abs(np.triu(d.U, 1)) <= 0.5 + 1e-9)
    sigma = np.abs(d.Z) @ np.sqrt(np.diag(Q))
    np.testing.assert_allclose(d.covariance, d.Z @ Q @ d.Z.T, rtol=0, atol=1e-13 * n * np.max(np.outer(sigma, sigma)))
    assert np.log(d.D).sum() == pytest.approx(np.linalg.slogdet(Q)[1], abs=1e-6)
    u, D = np.diagonal(d.U, 1), d.D
    assert np.all(D[:-1] + u**2 * D[1:] >= (1 - 1e-5) * D[1:])  # no exchange is left to do


def test_decorrelation_levels_a_dual_frequency_spectrum() -> None:
    Q = double_difference_covariance(np.random.default_rng(2), *MODELS["n=12 dual"])
    d = decorrelate(Q)
    before = np.linalg.cond(Q / np.sqrt(np.outer(np.diag(Q), np.diag(Q))))
    Qz = d.covariance
    after = np.linalg.cond(Qz / np.sqrt(np.outer(np.diag(Qz), np.diag(Qz))))
    assert before > 1e4 and after < 100
    assert np.trace(Qz) < 0.05 * np.trace(Q)


def test_more_candidates_extend_fewer() -> None:
    rng = np.random.default_rng(12)
    Q, a = random_covariance(rng, 6), rng.uniform(-9, 9, 6)
    twenty = integer_least_squares(a, Q, 20)
    assert np.all(np.diff(twenty.norms) >= 0)
    assert len(np.unique(twenty.candidates, axis=0)) == 20
    for k in (1, 2, 7):
        np.testing.assert_array_equal(integer_least_squares(a, Q, k).candidates, twenty.candidates[:k])


def test_a_spent_budget_is_reported_and_the_candidates_are_still_vectors_with_their_norms() -> None:
    rng = np.random.default_rng(3)
    Q = random_covariance(rng, 30, spread=0.1)
    a = rng.uniform(-9, 9, 30)
    cut = integer_least_squares(a, Q, max_nodes=500)
    assert not cut.proven and cut.nodes == 500
    for candidate, norm in zip(cut.candidates, cut.norms, strict=True):
        assert squared_norm(a, candidate, Q) == pytest.approx(norm, rel=1e-9)
    tiny = integer_least_squares(a, Q, max_nodes=1)
    assert not tiny.proven and tiny.candidates.shape == (2, 30)  # two candidates always come back


def test_budget_does_not_spoil_a_search_that_needs_less() -> None:
    rng = np.random.default_rng(3)
    Q, a = random_covariance(rng, 5), rng.uniform(-9, 9, 5)
    free = integer_least_squares(a, Q)
    assert integer_least_squares(a, Q, max_nodes=free.nodes).proven
    assert not integer_least_squares(a, Q, max_nodes=free.nodes - 1).proven


def test_no_ambiguity_and_one() -> None:
    none = integer_least_squares([], np.zeros((0, 0)))
    assert none.candidates.shape == (1, 0) and none.norms.tolist() == [0.0] and none.proven
    one = integer_least_squares([2.25], [[0.25]], 4)
    assert one.candidates.ravel().tolist() == [2, 3, 1, 4]
    assert one.norms.tolist() == [0.25, 2.25, 6.25, 12.25]


def test_exact_integers_have_zero_norm() -> None:
    Q = random_covariance(np.random.default_rng(0), 5)
    result = integer_least_squares([1, -2, 3, 10**8, 0], Q)
    assert result.candidates[0].tolist() == [1, -2, 3, 10**8, 0]
    assert result.norms[0] == 0.0 < result.norms[1]


def test_uncorrelated_ambiguities_are_rounded() -> None:
    a = np.array([0.4, -1.6, 7.2])
    assert integer_least_squares(a, np.diag([1.0, 1e-4, 1e4])).candidates[0].tolist() == [0, -2, 7]


def test_any_layout_of_the_input_is_taken_and_left_alone() -> None:
    rng = np.random.default_rng(1)
    Q, a = random_covariance(rng, 6), rng.uniform(-9, 9, 6)
    plain = integer_least_squares(a, Q)
    wide = np.zeros((12, 12))
    wide[::2, ::2] = Q
    read_only = np.asfortranarray(Q)
    read_only.flags.writeable = False
    for other in (wide[::2, ::2], read_only, Q.tolist()):
        np.testing.assert_array_equal(integer_least_squares(a.tolist(), other).candidates, plain.candidates)
    np.testing.assert_array_equal(integer_least_squares(a, Q).norms, plain.norms)


def test_kernels_agree_with_their_interpreted_twins() -> None:
    rng = np.random.default_rng(6)
    Q = double_difference_covariance(rng, *MODELS["n=8 dual"])
    a = draw_float(rng, Q, spread_cyc=0)[0]
    _, _, _, U, D, order = _kernels.factorise(Q)
    for ours, twin in zip((U, D, order), _kernels.factorise.py_func(Q)[3:], strict=True):
        np.testing.assert_allclose(ours, twin, rtol=1e-12)
    compiled = _kernels.reduce(a, Q)
    for ours, twin in zip(compiled[3:], _kernels.reduce.py_func(a, Q)[3:], strict=True):
        np.testing.assert_allclose(ours, twin, rtol=1e-9)
    UZ, D, _, z = compiled[3:]
    best, norms, nodes, proven = _kernels.search(UZ, D, z, 2, 10**6)
    twin_best, twin_norms, twin_nodes, twin_proven = _kernels.search.py_func(UZ, D, z, 2, 10**6)
    np.testing.assert_array_equal(best, twin_best)
    np.testing.assert_allclose(norms, twin_norms, rtol=1e-12)
    assert (nodes, proven) == (twin_nodes, twin_proven)


GOOD = np.array([[2.0, 0.5], [0.5, 1.0]])


@pytest.mark.parametrize(
    ("a", "Q", "text"),
    [
        ([0.1, np.nan], GOOD, r"a_float must be finite; a_float\[1\] is nan"),
        ([np.inf, 0.0], GOOD, r"a_float\[0\] is inf"),
        ([0.1, 1e17], GOOD, r"a_float\[1\] = 1e\+17 cycles is too large"),
        ([0.1, 0.2], [[1, 0], [np.nan, 1]], r"Q must be finite; Q\[1, 0\]"),
        ([0.1, 0.2], [[1, np.inf], [np.inf, 1]], r"Q must be finite"),
        ([0.1, 0.2], [[1, 0.1], [0.2, 1]], r"Q must be symmetric; Q\[1, 0\] - Q\[0, 1\] = 0.1"),
        ([0.1, 0.2], [[1, 2], [2, 1]], r"Q must be positive definite; .* smallest eigenvalue is -1"),
        ([0.1, 0.2], [[1, 1], [1, 1]], r"Q must be positive definite"),
        ([0.1, 0.2], [[1, 0], [0, 0]], r"ambiguity 1 has conditional variance 0"),
        ([0.1, 0.2], [[-1, 0], [0, 1]], r"ambiguity 0 has conditional variance -1"),
        ([0.1, 0.2, 0.3], GOOD, r"Q must have shape \(3, 3\) to match a_float with 3 entries, got \(2, 2\)"),
        ([[0.1, 0.2]], GOOD, r"a_float must have shape \(n,\), got \(1, 2\)"),
    ],
)
def test_wrong_input_is_named(a: object, Q: object, text: str) -> None:
    with pytest.raises(ValueError, match=text):
        integer_least_squares(a, Q)  # type: ignore[arg-type]


def test_wrong_options_are_named() -> None:
    with pytest.raises(ValueError, match="n_candidates must be at least 1, got 0"):
        integer_least_squares([0.1, 0.2], GOOD, 0)
    with pytest.raises(ValueError, match="max_nodes must be at least 1, got 0"):
        integer_least_squares([0.1, 0.2], GOOD, max_nodes=0)
    with pytest.raises(ValueError, match=r"Q must be a square matrix \(n, n\), got shape \(2, 3\)"):
        decorrelate(np.zeros((2, 3)))


def test_singular_covariance_is_refused_at_every_size() -> None:
    """A duplicated ambiguity leaves rounding noise for a pivot; that must not pass for a variance."""
    rng = np.random.default_rng(9)
    for n in (2, 5, 20, 40):
        G = rng.standard_normal((n + 1, n))
        G[n] = G[0]
        Q = G @ G.T
        with pytest.raises(ValueError, match="positive definite"):
            integer_least_squares(np.zeros(n + 1), Q)


def test_nearly_parallel_ambiguities_beyond_exact_integers_are_refused() -> None:
    Q = np.array([[1.0, 1e13], [1e13, 1e26 * (1 + 1e-12)]])
    with pytest.raises(ValueError, match="ill-conditioned"):
        integer_least_squares([0.2, 0.3], Q)
