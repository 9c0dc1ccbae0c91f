"""Eliminating common clocks: the projection against explicit double differences with their full covariance."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from factorgraph.models.differencing import CommonGroups
from factorgraph.types import Array


def differences(n: int, pivot: int) -> Array:
    """D (n - 1, n): every row minus the pivot."""
    return np.delete(np.eye(n) - np.eye(n)[pivot], pivot, axis=0)


@given(st.integers(0, 10_000), st.lists(st.integers(2, 7), min_size=1, max_size=4))
@settings(deadline=None, max_examples=50)
def test_projection_is_the_double_difference_model(seed: int, sizes: list[int]) -> None:
    """Normal matrix and right-hand side equal those of D J and D y with R_DD = D diag(sigma^2) D^T, for any pivot."""
    rng = np.random.default_rng(seed)
    n, w = sum(sizes), 4
    label = np.repeat(rng.permutation(len(sizes)), sizes)  # labels need not increase
    groups = CommonGroups.from_labels(label)
    sigma = 10.0 ** rng.uniform(-3, 1, n)
    J, y = rng.normal(size=(n, w)), rng.normal(size=n)
    P_J, P_y = groups.project(J, 1 / sigma), groups.project(y, 1 / sigma)
    N, b, cost = np.zeros((w, w)), np.zeros(w), 0.0
    first = 0
    for size in sizes:
        part = slice(first, first + size)
        D = differences(size, int(rng.integers(size)))
        R_DD = D @ np.diag(sigma[part] ** 2) @ D.T
        DJ, Dy = D @ J[part], D @ y[part]
        N += DJ.T @ np.linalg.solve(R_DD, DJ)
        b += DJ.T @ np.linalg.solve(R_DD, Dy)
        cost += float(Dy @ np.linalg.solve(R_DD, Dy))
        first += size
    scale = np.abs(N).max()
    np.testing.assert_allclose(P_J.T @ P_J, N, atol=1e-9 * scale)
    np.testing.assert_allclose(P_J.T @ P_y, b, atol=1e-9 * scale)
    np.testing.assert_allclose(P_y @ P_y, cost, atol=1e-9 * scale)


def test_clocks_vanish_and_differences_stay() -> None:
    rng = np.random.default_rng(2)
    groups = CommonGroups.from_labels(np.array([3, 3, 3, 1, 1, 3, 3]))
    np.testing.assert_array_equal(groups.start, [0, 3, 5])  # equal labels apart from each other are two groups
    np.testing.assert_array_equal(groups.of_row, [0, 0, 0, 1, 1, 2, 2])
    u, y, clock = rng.uniform(0.1, 10, 7), rng.normal(size=7), np.array([1e5, -3e4, 7.0])
    np.testing.assert_allclose(groups.project(y + clock[groups.of_row], u), groups.project(y, u), atol=1e-9)
    np.testing.assert_allclose(groups.sum(u * groups.project(y, u)), 0.0, atol=1e-12)  # orthogonal to u
    np.testing.assert_allclose(groups.project(groups.project(y, u) / u, u), groups.project(y, u), atol=1e-12)  # idempotent


def test_columns_are_projected_as_vectors_are() -> None:
    rng = np.random.default_rng(3)
    groups = CommonGroups.from_labels(np.array([0, 0, 0, 1, 1]))
    rows, u = rng.normal(size=(5, 3)), rng.uniform(0.5, 2, 5)
    np.testing.assert_allclose(groups.project(rows, u), np.column_stack([groups.project(c, u) for c in rows.T]), atol=1e-15)


def test_mean_is_least_squares() -> None:
    rng = np.random.default_rng(4)
    groups = CommonGroups.from_labels(np.array([0, 0, 0, 1, 1]))
    y, u = rng.normal(size=5), rng.uniform(0.5, 2, 5)
    expected = [np.average(y[:3], weights=u[:3] ** 2), np.average(y[3:], weights=u[3:] ** 2)]
    np.testing.assert_allclose(groups.mean(y, u), expected, atol=1e-14)


def test_rows_without_weight_take_no_part() -> None:
    """A rejected row changes nothing, and a group without any weight is zero, not a division by it."""
    y, u = np.array([1.0, 2.0, 50.0, 7.0, 9.0]), np.array([1.0, 2.0, 0.0, 0.0, 0.0])
    groups = CommonGroups.from_labels(np.array([0, 0, 0, 1, 1]))
    alone = CommonGroups.from_labels(np.array([0, 0])).project(y[:2], u[:2])
    np.testing.assert_allclose(groups.project(y, u), [*alone, 0.0, 0.0, 0.0], atol=1e-15)
    np.testing.assert_array_equal(groups.mean(y, u)[1], 0.0)
    np.testing.assert_array_equal(groups.leverage(u)[2:], 0.0)


def test_leverage_is_the_diagonal_of_the_projection() -> None:
    """var(y_i - mean) = sigma_i^2 (1 - h_i): against the projection matrix and against samples."""
    rng = np.random.default_rng(5)
    groups = CommonGroups.from_labels(np.array([0, 0, 0, 0, 1, 1]))
    sigma = rng.uniform(0.2, 3, 6)
    h = groups.leverage(1 / sigma)
    projection = groups.project(np.diag(sigma), 1 / sigma)  # P applied to whitened unit errors
    np.testing.assert_allclose(np.diag(projection), 1 - h, atol=1e-14)
    np.testing.assert_allclose(groups.sum(h), 1.0, atol=1e-14)
    noise = rng.normal(size=(20_000, 6)) * sigma
    res = np.array([y - groups.mean(y, 1 / sigma)[groups.of_row] for y in noise])
    np.testing.assert_allclose(res.var(axis=0), sigma**2 * (1 - h), rtol=0.06)


@pytest.mark.parametrize("shape", [(0,), (0, 3)])
def test_nothing_is_a_case(shape: tuple[int, ...]) -> None:
    groups = CommonGroups.from_labels(np.zeros(0, np.int64))
    assert groups.project(np.zeros(shape), np.zeros(0)).shape == shape
    assert groups.mean(np.zeros(0), np.zeros(0)).shape == (0,)


@given(st.integers(0, 10_000), st.lists(st.integers(1, 7), min_size=1, max_size=5))
@settings(deadline=None, max_examples=50)
def test_medians_are_those_of_active_rows(seed: int, sizes: list[int]) -> None:
    rng = np.random.default_rng(seed)
    label = np.repeat(np.arange(len(sizes)), sizes)
    groups, y, active = CommonGroups.from_labels(label), rng.normal(size=sum(sizes)), rng.random(sum(sizes)) < 0.8
    expected = [np.median(y[(label == g) & active]) if np.any(active & (label == g)) else 0.0 for g in range(len(sizes))]
    np.testing.assert_allclose(groups.median(y, active), expected, rtol=1e-12)
