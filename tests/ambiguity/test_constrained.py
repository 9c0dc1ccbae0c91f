"""Mixed integer least squares under constraints against brute force, general minimisation and counting."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from ambiguity import _kernels
from ambiguity.constrained import FloatSolution, float_solution, length_constrained, mixed_integer_least_squares, position_prior
from ambiguity.search import integer_least_squares
from ambiguity.types import Array, IntArray
from tests.ambiguity.models import WAVELENGTHS_M, random_covariance

seeds = st.integers(0, 2**32 - 1)


def random_solution(rng: np.random.Generator, n: int, p: int) -> FloatSolution:
    Q = random_covariance(rng, n + p, spread=0.6)
    return FloatSolution(rng.uniform(-30, 30, n), rng.normal(0, 1.5, p), Q[:n, :n], Q[:n, n:], Q[n:, n:])


def compass(
    rng: np.random.Generator, n_sat: int, b: Array, sigma_phase_m: float, sigma_code_m: float, noise: float = 1.0
) -> tuple[FloatSolution, IntArray]:
    """Single-frequency, single-epoch baseline b: code and phase double differences, and the integers behind them."""
    az, el = rng.uniform(0, 2 * np.pi, n_sat), np.arcsin(rng.uniform(0.2, 1, n_sat))
    u = np.column_stack([np.cos(el) * np.sin(az), np.cos(el) * np.cos(az), np.sin(el)])
    n = n_sat - 1
    B, R = u[1:] - u[0], 2.0 * (np.eye(n) + 1.0)
    truth = rng.integers(-50, 50, n)
    A = np.vstack([WAVELENGTHS_M[0] * np.eye(n), np.zeros((n, n))])
    Q_y = np.kron(np.diag([sigma_phase_m**2, sigma_code_m**2]), R)
    B = np.vstack([B, B])
    y = A @ truth + B @ b + noise * np.linalg.cholesky(Q_y) @ rng.standard_normal(2 * n)
    return float_solution(A, B, y, Q_y), truth


def nearest_on_sphere(P: Array, c: Array, length: float, variance: float) -> float:
    """Least charge over directions, dense and then denser about the best, with the exact best size along each."""

    def charges(directions: Array) -> Array:
        if variance == 0:
            sizes = np.full(len(directions), length)
        else:
            quadratic = np.einsum("ki,ij,kj->k", directions, P, directions)
            sizes = np.maximum(0, (directions @ P @ c + length / variance) / (quadratic + 1 / variance))
        d = sizes[:, None] * directions - c
        cost = np.einsum("ki,ij,kj->k", d, P, d)
        return np.asarray(cost if variance == 0 else cost + (sizes - length) ** 2 / variance)

    if c.size == 1:
        return float(charges(np.array([[1.0], [-1.0]])).min())
    centre, half = 0.0, np.pi
    for _ in range(4):
        angle = centre + np.linspace(-half, half, 721)
        cost = charges(np.column_stack([np.cos(angle), np.sin(angle)]))
        centre, half = angle[np.argmin(cost)], half / 180
    return float(cost.min())


@settings(max_examples=80, deadline=None)
@given(seed=seeds, p=st.integers(1, 2), length=st.floats(0.05, 5), sigma=st.sampled_from([0.0, 0.03, 1.0]))
def test_the_nearest_point_of_a_sphere(seed: int, p: int, length: float, sigma: float) -> None:
    rng = np.random.default_rng(seed)
    P, c = np.asarray(np.linalg.inv(random_covariance(rng, p, spread=1.0)), np.float64), rng.normal(0, 2, p)
    value, V = np.linalg.eigh(P)
    x = np.empty(p)
    cost = _kernels.onto_length(value, V.T @ c, length, sigma**2, x)
    b = V @ x
    written = (b - c) @ P @ (b - c) + ((np.linalg.norm(b) - length) ** 2 / sigma**2 if sigma else 0.0)
    assert cost == pytest.approx(written, rel=1e-7, abs=1e-9)
    if sigma == 0:
        assert np.linalg.norm(b) == pytest.approx(length, rel=1e-12)
    assert cost == pytest.approx(nearest_on_sphere(P, c, length, sigma**2), rel=1e-6, abs=1e-7)


@pytest.mark.parametrize(
    ("p", "c", "length", "variance", "size"),
    [
        ([1.0, 4.0, 9.0], [0.0, 0.0, 0.0], 2.0, 0.0, 2.0),  # the centre: anywhere along the softest axis
        ([1.0, 4.0, 9.0], [0.0, 0.1, 0.1], 2.0, 0.0, 2.0),  # nothing along the softest axis, inside
        ([1.0, 4.0, 9.0], [0.0, 9.0, 9.0], 2.0, 0.0, 2.0),  # nothing along the softest axis, outside
        ([1.0, 4.0, 9.0], [1e-200, 0.1, 0.1], 2.0, 0.0, 2.0),
        ([1.0, 4.0, 9.0], [-1e-30, 0.1, 0.1], 2.0, 0.0, 2.0),
        ([1.0, 4.0, 9.0], [1e-9, 0.1, 0.1], 2.0, 0.25, 1.6),
        ([1.0, 1.0, 1.0], [0.0, 3.0, 4.0], 1.0, 0.0, 1.0),
        ([1.0, 1.0, 1.0], [0.0, 3.0, 4.0], 1.0, 1.0, 3.0),  # half-way from 5 to 1
        ([1e-6, 1e6, 1e6], [1e-3, 3.0, 4.0], 1.0, 0.0, 1.0),
        ([1.0, 4.0, 9.0], [0.0, 0.0, 0.0], 2.0, 1.0, 1.0),
        ([5.0], [-3.0], 1.0, 0.0, 1.0),
    ],
)
def test_degenerate_spheres(p: list[float], c: list[float], length: float, variance: float, size: float) -> None:
    x = np.empty(len(p))
    P, centre = np.array(p), np.array(c)
    cost = _kernels.onto_length(P, centre, length, variance, x)
    assert np.linalg.norm(x) == pytest.approx(size, rel=1e-8)
    # no direction does better
    rng = np.random.default_rng(1)
    d = rng.standard_normal((20000, len(p)))
    d *= (size / np.linalg.norm(d, axis=1))[:, None]
    extra = (size - length) ** 2 / variance if variance else 0.0
    assert cost == pytest.approx(float(P @ (x - centre) ** 2) + extra, rel=1e-9)
    assert cost <= ((d - centre) ** 2 @ P).min() * (1 + 1e-9) + extra
    other = np.empty(len(p))
    assert _kernels.onto_length.py_func(P, centre, length, variance, other) == pytest.approx(cost, rel=1e-9)


@settings(max_examples=60, deadline=None)
@given(seed=seeds, n=st.integers(1, 3), p=st.integers(1, 2), length=st.floats(0.2, 4), sigma=st.sampled_from([0.0, 0.2]))
def test_length_agrees_with_brute_force(seed: int, n: int, p: int, length: float, sigma: float) -> None:
    rng = np.random.default_rng(seed)
    x = random_solution(rng, n, p)
    result = length_constrained(x, length, sigma, 3)
    assert result.proven and np.all(np.diff(result.objectives) >= 0)
    half = np.sqrt(result.objectives[-1] * np.diag(x.Q_a)) + 1e-9
    ranges = [np.arange(math.ceil(a - h), math.floor(a + h) + 1) for a, h in zip(x.a, half, strict=True)]
    box = np.array(list(itertools.product(*ranges)))
    d = box - x.a
    gain = np.linalg.solve(x.Q_a, x.Q_ab)
    norms = np.einsum("ki,ki->k", d, np.linalg.solve(x.Q_a, d.T).T)
    P = np.asarray(np.linalg.inv(x.Q_b - x.Q_ab.T @ gain), np.float64)
    near = np.flatnonzero(norms <= result.objectives[-1] + 1e-6)  # the sphere only adds to what is farther
    assume(len(near) < 2000)
    cost = np.array([norms[i] + nearest_on_sphere(P, x.b + d[i] @ gain, length, sigma**2) for i in near])
    np.testing.assert_allclose(np.sort(cost)[:3], result.objectives, rtol=1e-5, atol=1e-6)
    for candidate, b, objective in zip(result.candidates, result.b, result.objectives, strict=True):
        step = candidate - x.a
        off = b - x.b - step @ gain
        charge = (np.linalg.norm(b) - length) ** 2 / sigma**2 if sigma else 0.0
        assert step @ np.linalg.solve(x.Q_a, step) + off @ P @ off + charge == pytest.approx(objective, rel=1e-6, abs=1e-7)
        if sigma == 0:
            assert np.linalg.norm(b) == pytest.approx(length, rel=1e-10)


@settings(max_examples=40, deadline=None)
@given(seed=seeds, n=st.integers(1, 6), scale=st.floats(0.1, 10))
def test_length_follows_shift_permutation_and_unit(seed: int, n: int, scale: float) -> None:
    rng = np.random.default_rng(seed)
    x = random_solution(rng, n, 3)
    plain = length_constrained(x, 1.5)
    offset = rng.integers(-(10**6), 10**6, n)
    order = rng.permutation(n)
    C, _ = np.linalg.qr(rng.standard_normal((3, 3)))
    C *= scale
    moved = FloatSolution((x.a + offset)[order], C @ x.b, x.Q_a[np.ix_(order, order)], x.Q_ab[order] @ C.T, C @ x.Q_b @ C.T)
    other = length_constrained(moved, 1.5 * scale)
    np.testing.assert_allclose(other.objectives, plain.objectives, rtol=1e-5, atol=1e-6)
    if plain.objectives[1] - plain.objectives[0] > 1e-4:
        np.testing.assert_array_equal(other.candidates[0], (plain.candidates[0] + offset)[order])
        np.testing.assert_allclose(other.b[0], C @ plain.b[0], atol=1e-4 * scale)


def test_exact_data_give_back_integers_and_baseline() -> None:
    rng = np.random.default_rng(4)
    for _ in range(20):
        b = rng.normal(0, 1, 3)
        x, truth = compass(rng, 6, b, 0.003, 0.3, 0.0)
        for sigma in (0.0, 0.01):
            result = length_constrained(x, float(np.linalg.norm(b)), sigma)
            assert result.proven
            np.testing.assert_array_equal(result.candidates[0], truth)
            np.testing.assert_allclose(result.b[0], b, atol=1e-8)
            assert result.objectives[0] < 1e-12


def test_a_known_length_finds_the_integers_of_a_weak_compass() -> None:
    rng = np.random.default_rng(9)
    n_trials, right = 150, np.zeros(3)
    for _ in range(n_trials):
        b = rng.normal(0, 1, 3)
        b *= 2.0 / np.linalg.norm(b)
        x, truth = compass(rng, 6, b, 0.003, 0.3)
        hard, soft = length_constrained(x, 2.0), length_constrained(x, 2.0, 0.01)
        assert hard.proven and soft.proven
        assert hard.objectives[0] >= soft.objectives[0] - 1e-9 >= integer_least_squares(x.a, x.Q_a, 1).norms[0] - 2e-9
        for i, integers in enumerate(
            (integer_least_squares(x.a, x.Q_a, 1).candidates[0], soft.candidates[0], hard.candidates[0])
        ):
            right[i] += np.array_equal(integers, truth)
    share = right / n_trials
    assert share[0] < 0.5
    assert share[2] > share[0] + 0.25 and share[1] > share[0] + 0.2


def test_a_vague_length_is_no_constraint() -> None:
    rng = np.random.default_rng(2)
    x = random_solution(rng, 5, 3)
    free, vague = mixed_integer_least_squares(x), length_constrained(x, 1.0, 1e6)
    np.testing.assert_array_equal(vague.candidates, free.candidates)
    np.testing.assert_allclose(vague.objectives, free.objectives, rtol=1e-6)
    np.testing.assert_allclose(vague.b, free.b, rtol=1e-6)
    np.testing.assert_allclose(vague.Q_b, free.Q_b, atol=1e-12)


def test_float_solution_is_the_weighted_least_squares_one() -> None:
    rng = np.random.default_rng(6)
    A, B, y, Q_y = rng.normal(size=(9, 3)), rng.normal(size=(9, 2)), rng.normal(size=9), random_covariance(rng, 9)
    x = float_solution(A, B, y, Q_y)
    design = np.hstack([A, B])
    N = design.T @ np.linalg.solve(Q_y, design)
    np.testing.assert_allclose(np.append(x.a, x.b), np.linalg.solve(N, design.T @ np.linalg.solve(Q_y, y)), rtol=1e-6)
    np.testing.assert_allclose(np.block([[x.Q_a, x.Q_ab], [x.Q_ab.T, x.Q_b]]), np.linalg.inv(N), rtol=1e-6, atol=1e-9)


@settings(max_examples=40, deadline=None)
@given(seed=seeds, n=st.integers(1, 4), p=st.integers(1, 3), sharp=st.booleans())
def test_a_prior_is_an_observation_more(seed: int, n: int, p: int, sharp: bool) -> None:
    """Brute force over all integers with b eliminated from both terms; a sharp prior holds b where it says."""
    rng = np.random.default_rng(seed)
    x = random_solution(rng, n, p)
    b_0, Q_0 = rng.normal(0, 1, p), np.zeros((p, p)) if sharp else random_covariance(rng, p)
    updated = position_prior(x, b_0, Q_0)
    result = mixed_integer_least_squares(updated, 1)
    gain = np.linalg.solve(x.Q_a, x.Q_ab)
    Q_given = x.Q_b - x.Q_ab.T @ gain

    def cost(a: Array) -> float:
        step = a - x.a
        off = b_0 - x.b - step @ gain
        return float(step @ np.linalg.solve(x.Q_a, step) + off @ np.linalg.solve(Q_given + Q_0, off))

    best = result.candidates[0]
    neighbours = best + np.array(list(itertools.product((-1, 0, 1), repeat=n)))
    assert cost(best) == pytest.approx(min(cost(a) for a in neighbours), rel=1e-9)
    prior_cost = (b_0 - x.b) @ np.linalg.solve(x.Q_b + Q_0, b_0 - x.b)
    assert result.objectives[0] + prior_cost == pytest.approx(cost(best), rel=1e-6, abs=1e-6)
    weight = np.linalg.solve(Q_given + Q_0, Q_given).T
    given_both = x.b + (best - x.a) @ gain
    np.testing.assert_allclose(result.b[0], given_both + weight @ (b_0 - given_both), atol=1e-6)
    if sharp:
        np.testing.assert_allclose(result.b[0], b_0, atol=1e-9)


def test_a_spent_budget_is_reported() -> None:
    x = random_solution(np.random.default_rng(1), 8, 3)
    free = length_constrained(x, 1.0)
    cut = length_constrained(x, 1.0, max_nodes=2)
    assert free.proven and not cut.proven and cut.candidates.shape == (2, 8)
    assert length_constrained(x, 1.0, max_nodes=free.nodes).proven
    assert not length_constrained(x, 1.0, max_nodes=free.nodes - 1).proven


def test_no_ambiguity_leaves_the_sphere() -> None:
    x = FloatSolution(np.zeros(0), np.array([3.0, 4.0]), np.zeros((0, 0)), np.zeros((0, 2)), np.eye(2))
    result = length_constrained(x, 1.0)
    np.testing.assert_allclose(result.b, [[0.6, 0.8]], rtol=1e-12)
    assert result.objectives[0] == pytest.approx(16.0) and result.candidates.shape == (1, 0) and result.proven
    assert mixed_integer_least_squares(x).b.tolist() == [[3.0, 4.0]]
    assert position_prior(x, [1.0, 0.0], np.eye(2)).b.tolist() == [2.0, 2.0]


def test_wrong_input_is_named() -> None:
    x = random_solution(np.random.default_rng(1), 2, 3)
    wrong: list[tuple[FloatSolution, float, float, str]] = [
        (x, 0.0, 0.0, "length must be positive"),
        (x, math.nan, 0.0, "length must be positive"),
        (x, 1.0, -1.0, "sigma not negative"),
        (FloatSolution(x.a, x.b, x.Q_a, x.Q_ab.T, x.Q_b), 1.0, 0.0, r"Q_ab \(2, p\), got \(3,\), \(3, 3\) and \(3, 2\)"),
        (FloatSolution(x.a, x.b * np.nan, x.Q_a, x.Q_ab, x.Q_b), 1.0, 0.0, "b, Q_b and Q_ab must be finite"),
        (FloatSolution(x.a, x.b, np.ones((2, 2)), x.Q_ab, x.Q_b), 1.0, 0.0, "positive definite"),
        (FloatSolution(x.a, x.b, x.Q_a, x.Q_ab, 0 * x.Q_b), 1.0, 0.0, "b given the integers must have a positive definite"),
        (FloatSolution(x.a, x.b, x.Q_a, x.Q_ab, x.Q_b + np.triu(np.ones((3, 3)), 1)), 1.0, 0.0, "Q_b must be symmetric"),
        (FloatSolution(x.a, np.zeros(0), x.Q_a, np.zeros((2, 0)), np.zeros((0, 0))), 1.0, 0.0, "at least one entry"),
    ]
    for solution, length, sigma, text in wrong:
        with pytest.raises(ValueError, match=text):
            length_constrained(solution, length, sigma)
    with pytest.raises(ValueError, match=r"b_prior must have shape \(3,\)"):
        position_prior(x, [1.0], np.eye(3))
    with pytest.raises(ValueError, match="Q_prior symmetric"):
        position_prior(x, np.zeros(3), np.triu(np.ones((3, 3))))
    with pytest.raises(ValueError, match=r"Q_b \+ Q_prior must be positive definite"):
        position_prior(x, np.zeros(3), -1e3 * np.eye(3))
    with pytest.raises(ValueError, match="lacks rank"):
        float_solution(np.ones((4, 1)), np.ones((4, 1)), np.zeros(4), np.eye(4))
    with pytest.raises(ValueError, match="1 observations do not determine 2"):
        float_solution([[1.0]], [[1.0]], [0.0], [[1.0]])
    with pytest.raises(ValueError, match="A and B must have 2 rows"):
        float_solution(np.ones((3, 1)), np.ones((2, 1)), np.zeros(2), np.eye(2))
    with pytest.raises(ValueError, match="A, B and y must be finite"):
        float_solution([[np.nan], [1.0]], np.ones((2, 1)), np.zeros(2), np.eye(2))
    with pytest.raises(ValueError, match="Q_y must be positive definite"):
        float_solution(np.eye(2)[:, :1], np.eye(2)[:, 1:], np.zeros(2), np.ones((2, 2)))
