"""Integers by bonmin are those of the search."""

from __future__ import annotations

import numpy as np
import pytest

from ambiguity import integer_least_squares
from factorgraph.assembly.optimizer import Graph
from factorgraph.errors import InputError
from factorgraph.least_squares.integers import MOST, nearest_integers
from factorgraph.types import Array
from tests.factorgraph.test_batch_simulation import WITH_BASE
from tests.factorgraph.test_nlp import graph_of, optimum


def float_problem(n: int, rng: np.random.Generator, spread: float) -> tuple[Array, Array]:
    """Floats and a correlated covariance whose axes differ by up to 10^spread in variance."""
    A = np.linalg.qr(rng.standard_normal((n, n)))[0]
    Q = A @ np.diag(10 ** rng.uniform(-2.5, spread - 2.5, n)) @ A.T
    return rng.multivariate_normal(rng.integers(-1000, 1000, n), Q), (Q + Q.T) / 2


@pytest.mark.parametrize("n", range(2, 8))
@pytest.mark.parametrize("spread", [1.0, 2.5, 4.0])
def test_integers_of_random_problems(n: int, spread: float, capfd: pytest.CaptureFixture[str]) -> None:
    """Strong ones, and weak ones whose rounded floats are wrong."""
    a, Q = float_problem(n, np.random.default_rng([n, int(10 * spread)]), spread)
    found, expected = nearest_integers(a, Q), integer_least_squares(a, Q, 1)
    np.testing.assert_array_equal(found.integers, expected.candidates[0])
    assert found.norm == pytest.approx(expected.norms[0], rel=1e-6)
    assert capfd.readouterr().out == ""


def ambiguities(graph: Graph) -> tuple[Array, Array]:
    """Float ambiguities of the first link, MOST at most, and their covariance."""
    eliminated = graph.eliminate()
    assert eliminated is not None
    free = np.flatnonzero([int(key) in graph.ambiguities for key in graph.gnss[0].amb_key])[:MOST]
    keys = graph.gnss[0].amb_key[free]
    return graph.gnss[0].amb_value[free], eliminated.covariance(keys.tolist())


def test_integers_of_a_flight() -> None:
    graph = graph_of(WITH_BASE)
    graph.take(optimum(WITH_BASE))
    a, Q = ambiguities(graph)
    assert len(a) > 5
    found, expected = nearest_integers(a, Q), integer_least_squares(a, Q, 2)
    np.testing.assert_array_equal(found.integers, expected.candidates[0])
    far = nearest_integers(a + 1e6, Q)
    np.testing.assert_array_equal(far.integers, found.integers + 1_000_000)


def test_what_cannot_be_used_is_said() -> None:
    with pytest.raises(InputError, match="1 to 10 ambiguities, got 11"):
        nearest_integers(np.zeros(11), np.eye(11))
    with pytest.raises(InputError, match="got 0"):
        nearest_integers(np.zeros(0), np.zeros((0, 0)))
    with pytest.raises(InputError, match="shape"):
        nearest_integers(np.zeros(2), np.eye(3))
    with pytest.raises(ValueError, match="definite"):
        nearest_integers(np.zeros(2), np.diag([1.0, -1.0]))
