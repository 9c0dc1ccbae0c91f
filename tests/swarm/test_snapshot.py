"""One update as plain arrays: predictions, Jacobians and what is wrong with shapes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from swarm.snapshot import Snapshot
from tests.swarm.snapshots import POS, PRIOR, RANGE, N, drawn

BIASED = np.eye(1, N, 9) - 2.0 * np.eye(1, N, 11)


def test_rows_predict_products_and_distances() -> None:
    s, _ = drawn(1)
    X = PRIOR + np.random.default_rng(0).normal(size=(4, s.n))
    h = s.h(X)
    np.testing.assert_allclose(np.delete(h, RANGE, 1), X @ np.delete(s.H, RANGE, 0).T)
    np.testing.assert_allclose(h[:, RANGE], np.linalg.norm(X[:, POS], axis=1))
    np.testing.assert_allclose(s.innovation, s.z - s.H @ PRIOR)  # the row of the range, too: it has no constant
    np.testing.assert_allclose(s.residual, s.z - s.h(s.x_post[None])[0])


def test_jacobian_is_the_difference_of_predictions() -> None:
    s, _ = drawn(2)
    s = replace(s, norm_d=np.array([[3.0, -5.0, 40.0]]), norm_scale=np.array([1.001]), norm_G=BIASED)
    step = 1e-3 * np.eye(s.n)
    numeric = (s.h(PRIOR + step) - s.h(PRIOR - step)).T / 2e-3
    np.testing.assert_allclose(s.jacobian(PRIOR), numeric, atol=1e-7)
    assert np.abs(s.jacobian(PRIOR)[RANGE] - s.H[RANGE]).max() > 0.1
    np.testing.assert_allclose(s.S, s.H @ s.P_prior @ s.H.T + s.R)


def test_distances_may_hold_products_besides() -> None:
    s, _ = drawn(2)
    biased = replace(s, norm_G=BIASED)
    X = PRIOR + np.random.default_rng(0).normal(size=(4, s.n))
    more = biased.h(X) - s.h(X)
    np.testing.assert_allclose(more[:, RANGE], X[:, 9] - 2.0 * X[:, 11])
    assert not np.delete(more, RANGE, 1).any()
    np.testing.assert_array_equal(biased.linear[RANGE], BIASED[0])
    assert not s.linear[RANGE].any() and s.H[RANGE].any()


def test_states_that_rows_see() -> None:
    s, _ = drawn(3)
    assert s.seen.tolist() == [0, 1, 2, 3, 4, 5]
    assert replace(s, norm_G=BIASED).seen.tolist() == [0, 1, 2, 3, 4, 5, 9, 11]
    D = s.norm_D.copy()
    D[0, 1, 9] = 0.5
    assert 9 in replace(s, norm_D=D).seen


def test_a_distance_of_zero_has_no_direction() -> None:
    s, _ = drawn(4)
    assert not s.jacobian(np.zeros(s.n))[RANGE].any()


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"P_prior": np.eye(3)}, r"P_prior must have shape \(12, 12\), got \(3, 3\)"),
        ({"x_post": np.zeros(11)}, r"x_post must have shape \(12,\), got \(11,\)"),
        ({"R": np.eye(20)}, r"R must have shape \(21, 21\)"),
        ({"H": np.zeros((12, 21))}, r"H must have shape \(21, 12\)"),
        ({"norm_D": np.zeros((1, 2, 12))}, r"norm_D must have shape \(1, 3, 12\)"),
        ({"norm_G": np.zeros((2, 12))}, r"norm_G must have shape \(1, 12\), got \(2, 12\)"),
        ({"norm_scale": np.ones(2)}, r"norm_scale must have shape \(1,\)"),
        ({"norm_rows": np.array([21])}, r"norm_rows must be different rows below 21, got \[21\]"),
    ],
)
def test_wrong_shapes_are_named(change: dict[str, object], text: str) -> None:
    with pytest.raises(ValueError, match=text):
        replace(drawn(5)[0], **change)  # type: ignore[arg-type]
    none = np.zeros(0)
    with pytest.raises(ValueError, match="at least one row"):
        Snapshot(np.zeros(2), np.eye(2), np.zeros(2), np.eye(2), none, np.zeros((0, 0)), np.zeros((0, 2)))
