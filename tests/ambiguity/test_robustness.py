"""Every public function that takes a covariance: what it cannot use it names, what is empty it answers."""

from __future__ import annotations

import importlib
import inspect
import pkgutil
from collections.abc import Callable

import numpy as np
import pytest

import ambiguity
from ambiguity import (
    adop,
    bootstrap,
    condition,
    decorrelate,
    factorise,
    fix,
    integer_least_squares,
    round_each,
    success_rate,
)
from ambiguity.batch import (
    IlsBatch,
    RoundedBatch,
    Strength,
    bootstrap_batch,
    integer_least_squares_batch,
    round_each_batch,
    strength_batch,
)
from ambiguity.constrained import (
    FloatSolution,
    float_solution,
    length_constrained,
    mixed_integer_least_squares,
    position_prior,
)
from ambiguity.equivariant import best_integer_equivariant
from ambiguity.partial import fix_ordered
from ambiguity.simulation import least_squares_upper_bound, simulate, simulated_success_rates
from ambiguity.types import Array
from ambiguity.validation import ffrt_threshold, projector_test

GOOD = np.array([[2.0, 0.5, 0.1], [0.5, 1.0, 0.2], [0.1, 0.2, 3.0]])


def two_candidates(n: int) -> Array:
    return np.arange(2.0 * n).reshape(2, n)


def alone(batch: IlsBatch | RoundedBatch | Strength) -> object:
    """The only row of a batch, whose fault is raised as the single call would."""
    for row, text in batch.faults:
        assert row == 0
        raise ValueError(text)
    return batch


def beside_position(a: Array, Q: Array) -> FloatSolution:
    """Ambiguities beside three real parameters, correlated with the first."""
    Q_ab = np.zeros((a.size, 3))
    Q_ab[:1, 0] = 0.1
    return FloatSolution(a, np.array([1.0, 0.2, 0.1]), Q, Q_ab, np.eye(3))


CALLS: dict[str, Callable[[Array, Array], object]] = {
    "best_integer_equivariant": best_integer_equivariant,
    "bootstrap_batch": lambda a, Q: alone(bootstrap_batch(a[None], Q)),
    "fix_ordered": lambda a, Q: fix_ordered(a, Q, np.arange(len(a))),
    "integer_least_squares_batch": lambda a, Q: alone(integer_least_squares_batch(a[None], Q)),
    "round_each_batch": lambda a, Q: alone(round_each_batch(a[None], Q)),
    "strength_batch": lambda a, Q: alone(strength_batch(Q[None])),
    "float_solution": lambda a, Q: float_solution(np.zeros((len(a), 0)), np.eye(len(a)), a, Q),
    "length_constrained": lambda a, Q: length_constrained(beside_position(a, Q), 1.0),
    "mixed_integer_least_squares": lambda a, Q: mixed_integer_least_squares(beside_position(a, Q)),
    "position_prior": lambda a, Q: position_prior(beside_position(a, Q), np.zeros(3), np.eye(3)),
    "adop": lambda a, Q: adop(Q),
    "bootstrap": bootstrap,
    "condition": lambda a, Q: condition(a, Q, np.eye(len(a))[:1], np.zeros(min(len(a), 1))),
    "decorrelate": lambda a, Q: decorrelate(Q),
    "factorise": lambda a, Q: factorise(Q),
    "ffrt_threshold": lambda a, Q: ffrt_threshold(Q, 0.01, 200, 1),
    "fix": fix,
    "integer_least_squares": integer_least_squares,
    "least_squares_upper_bound": lambda a, Q: least_squares_upper_bound(Q),
    "projector_test": lambda a, Q: projector_test(a, Q, two_candidates(len(a)) if len(a) else np.zeros((1, 0)), 1.0),
    "round_each": round_each,
    "simulate": lambda a, Q: simulate(Q, 200, 1),
    "simulated_success_rates": lambda a, Q: simulated_success_rates(Q, 200, 1),
    "success_rate": lambda a, Q: success_rate(Q),
}
# Rounding needs variances alone; a position prior is a linear update and leaves the rest to the search that follows.
FACTORED = [name for name in CALLS if name not in ("round_each", "round_each_batch", "position_prior")]


def public_functions() -> dict[str, Callable[..., object]]:
    """Functions of the package's modules that take a covariance."""
    found: dict[str, Callable[..., object]] = {}
    for info in pkgutil.iter_modules(ambiguity.__path__):
        if not info.name.startswith("_"):
            module = importlib.import_module(f"ambiguity.{info.name}")
            for name, function in inspect.getmembers(module, inspect.isfunction):
                own = function.__module__ == module.__name__ and not name.startswith("_")
                if own and {"Q", "Q_y", "x"} & set(inspect.signature(function).parameters):
                    found[name] = function
    return found


FLOATS = [name for name, function in public_functions().items() if "a_float" in inspect.signature(function).parameters]


def test_every_public_function_of_a_covariance_is_listed() -> None:
    assert set(public_functions()) == set(CALLS)


def bad(row: int, column: int, value: float, mirrored: bool = True) -> Array:
    Q = GOOD.copy()
    Q[row, column] = value
    if mirrored:
        Q[column, row] = value
    return Q


@pytest.mark.parametrize("name", CALLS)
@pytest.mark.parametrize(
    ("Q", "text"),
    [
        (bad(1, 0, np.nan), r"Q must be finite; Q\[1, 0\]"),
        (bad(2, 2, np.inf), r"Q must be finite; Q\[2, 2\]"),
        (bad(2, 0, 0.7, mirrored=False), r"Q must be symmetric; Q\[2, 0\]"),
        (bad(1, 1, 0.0), "Q must be positive definite; ambiguity 1"),
        (bad(1, 1, -1.0), "Q must be positive definite; ambiguity 1"),
        (GOOD[:2], r"Q must (be|have) .* got (shape )?\((1, )?2, 3\)"),
        (np.diag(GOOD), r"Q must (be|have) .* got (shape )?\((1, )?3,?\)"),
    ],
)
def test_a_covariance_that_is_none_is_named(name: str, Q: Array, text: str) -> None:
    with pytest.raises(ValueError, match=text):
        CALLS[name](np.array([0.1, 0.2, 0.3]), Q)


def duplicated_satellite(n: int) -> Array:
    """Two ambiguities that are one: identical rows and columns."""
    G = np.random.default_rng(n).standard_normal((n, n))
    G = np.vstack([G, G[n // 2]])
    return np.asarray(G @ G.T)


@pytest.mark.parametrize("name", FACTORED)
def test_an_indefinite_covariance_is_named(name: str) -> None:
    with pytest.raises(ValueError, match=r"Q(_y)? must be positive definite"):
        CALLS[name](np.zeros(3), bad(1, 0, 1.5))


@pytest.mark.parametrize("name", FACTORED)
@pytest.mark.parametrize("n", [1, 6, 25])
def test_a_satellite_given_twice_is_named(name: str, n: int) -> None:
    with pytest.raises(ValueError, match=r"Q(_y)? must be positive definite.* given twice"):
        CALLS[name](np.zeros(n + 1), duplicated_satellite(n))


@pytest.mark.parametrize("name", FLOATS)
@pytest.mark.parametrize(("value", "text"), [(np.nan, "must be finite"), (np.inf, "must be finite"), (1e17, "too large")])
def test_a_float_ambiguity_that_is_none_is_named(name: str, value: float, text: str) -> None:
    with pytest.raises(ValueError, match=rf"a_float\[1\].*|a_float.*{text}"):
        CALLS[name](np.array([0.1, value, 0.3]), GOOD)


@pytest.mark.parametrize("name", CALLS)
@pytest.mark.parametrize("n", [0, 1, 3])
def test_none_one_and_some_have_a_result(name: str, n: int) -> None:
    if name == "adop" and n == 0:
        with pytest.raises(ValueError, match="at least one ambiguity"):
            adop(np.zeros((0, 0)))
        return
    assert CALLS[name](np.full(n, 0.2), GOOD[:n, :n]) is not None


@pytest.mark.parametrize("name", CALLS)
def test_the_input_is_left_alone(name: str) -> None:
    a, Q = np.array([0.1, 7.2, 0.3]), GOOD.copy()
    Q[0, 1] += 1e-9  # within what counts as symmetric
    a_before, before = a.copy(), Q.copy()
    CALLS[name](a, Q)
    np.testing.assert_array_equal(Q, before)
    np.testing.assert_array_equal(a, a_before)
