"""The particle swarm on functions whose minimum is known, over many seeds."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from swarm import SwarmResult, SwarmStatus, pso
from swarm.types import Array

SHIFT = np.array([1.3, -2.1, 0.4, 3.2, -0.7])


def sphere(x: Array) -> Array:
    return np.asarray(np.sum((x - SHIFT[: x.shape[1]]) ** 2, axis=1))


def rosenbrock(x: Array) -> Array:
    return np.asarray(np.sum(100 * (x[:, 1:] - x[:, :-1] ** 2) ** 2 + (1 - x[:, :-1]) ** 2, axis=1))


def rastrigin(x: Array) -> Array:
    d = x - SHIFT[: x.shape[1]]
    return np.asarray(np.sum(d**2 + 10 * (1 - np.cos(2 * np.pi * d)), axis=1))


def box(n: int, half: float = 5.12) -> Array:
    return np.tile([-half, half], (n, 1))


class Recorder:
    """A cost that remembers what it was asked."""

    def __init__(self, cost: Callable[[Array], Array]) -> None:
        self.cost = cost
        self.calls: list[Array] = []

    def __call__(self, x: Array) -> Array:
        self.calls.append(x.copy())
        return self.cost(x)

    @property
    def points(self) -> Array:
        return np.concatenate(self.calls)


@pytest.mark.parametrize(
    ("cost", "n", "median", "worst"),
    [(sphere, 5, 1e-12, 1e-8), (rosenbrock, 2, 1e-10, 1e-3), (rosenbrock, 4, 0.5, 10.0), (rastrigin, 3, 1e-8, 5.0)],
)
def test_finds_the_minimum_over_many_seeds(cost: Callable[[Array], Array], n: int, median: float, worst: float) -> None:
    costs = [pso.minimize(cost, box(n), rng=np.random.default_rng(seed), max_evals=8000).cost for seed in range(31)]
    assert np.median(costs) < median
    assert max(costs) < worst


def test_beats_random_search_at_the_same_budget() -> None:
    rng = np.random.default_rng(0)
    ours = np.median([pso.minimize(rastrigin, box(5), rng=np.random.default_rng(s), max_evals=3000).cost for s in range(15)])
    random = np.median([rastrigin(rng.uniform(-5.12, 5.12, (3000, 5))).min() for _ in range(15)])
    assert ours < 0.4 * random


@pytest.mark.parametrize("max_evals", [1, 7, 30, 31, 100, 1000])
@pytest.mark.parametrize("n_members", [1, 8, 30])
def test_budget_is_never_exceeded_and_truly_counted(max_evals: int, n_members: int) -> None:
    cost = Recorder(rastrigin)
    result = pso.minimize(cost, box(3), rng=np.random.default_rng(1), n_members=n_members, max_evals=max_evals)
    assert result.n_evals == len(cost.points) == max_evals
    assert result.status is SwarmStatus.BUDGET
    assert len(result.history) == len(cost.calls)


def test_every_point_lies_in_the_box_even_when_the_minimum_is_outside() -> None:
    bounds = np.array([[0.1, 0.3], [-1e6, -1e5], [7.0, 7.0 + 1e-9]])
    cost = Recorder(lambda x: -x[:, 0] - 1e-6 * x[:, 1] + x[:, 2])
    result = pso.minimize(cost, bounds, rng=np.random.default_rng(5))
    assert np.all(cost.points >= bounds[:, 0]) and np.all(cost.points <= bounds[:, 1])
    assert result.x == pytest.approx([0.3, -1e5, 7.0], rel=1e-5)


def test_reported_cost_belongs_to_the_reported_point_and_is_the_best_met() -> None:
    cost = Recorder(rosenbrock)
    result = pso.minimize(cost, box(4), rng=np.random.default_rng(8), max_evals=900)
    assert result.cost == rosenbrock(result.x[None])[0] == rosenbrock(cost.points).min() == result.history[-1]
    assert np.all(np.diff(result.history) <= 0)


def run(seed: int, **options: float) -> SwarmResult:
    return pso.minimize(rastrigin, box(4), rng=np.random.default_rng(seed), max_evals=1500, **options)  # type: ignore[arg-type]


def test_same_seed_same_result_and_other_seed_another() -> None:
    one, two, other = run(3), run(3), run(4)
    np.testing.assert_array_equal(one.x, two.x)
    np.testing.assert_array_equal(one.history, two.history)
    assert not np.array_equal(one.x, other.x)


def test_scale_of_the_coordinates_does_not_matter() -> None:
    scale, offset = np.array([1.0, 1e6, 1e-4]), np.array([0.0, -3e5, 2.0])
    plain = pso.minimize(rastrigin, box(3), rng=np.random.default_rng(2), max_evals=300)
    bounds = offset[:, None] + scale[:, None] * box(3)
    scaled = pso.minimize(lambda x: rastrigin((x - offset) / scale), bounds, rng=np.random.default_rng(2), max_evals=300)
    assert (scaled.x - offset) / scale == pytest.approx(plain.x, abs=1e-4)


def test_first_point_is_used() -> None:
    x0 = SHIFT[:3].copy()
    result = pso.minimize(rastrigin, box(3), rng=np.random.default_rng(0), max_evals=30, x0=x0)
    assert result.cost == 0.0
    np.testing.assert_array_equal(result.x, x0)


def test_cost_that_is_nan_in_half_the_box_is_counted_and_avoided() -> None:
    calls = Recorder(lambda x: np.where(x[:, 0] > 1.0, np.nan, sphere(x)))
    result = pso.minimize(calls, box(2), rng=np.random.default_rng(6), max_evals=3000)
    assert result.n_invalid == np.count_nonzero(calls.points[:, 0] > 1.0) > 0
    assert result.x == pytest.approx([1.0, SHIFT[1]], abs=2e-2)
    assert np.isfinite(result.cost)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_no_finite_cost_is_said(value: float) -> None:
    result = pso.minimize(lambda x: np.full(len(x), value), box(2), rng=np.random.default_rng(6), max_evals=200)
    assert result.status is SwarmStatus.NO_FINITE_COST
    assert result.cost == np.inf and result.n_invalid == result.n_evals == 200


def test_stops_at_the_target_and_when_contracted() -> None:
    hit = pso.minimize(sphere, box(3), rng=np.random.default_rng(6), max_evals=100_000, target=1e-3)
    assert hit.status is SwarmStatus.TARGET and hit.cost <= 1e-3 and hit.n_evals < 5000
    contracted = pso.minimize(sphere, box(3), rng=np.random.default_rng(6), max_evals=100_000, xtol=1e-6)
    assert contracted.status is SwarmStatus.CONVERGED and contracted.n_evals < 20_000
    assert contracted.x == pytest.approx(SHIFT[:3], abs=1e-4)


def test_cost_cannot_disturb_the_swarm() -> None:
    buffer = np.zeros(30)

    def careless(x: Array) -> Array:
        buffer[: len(x)] = sphere(x)
        x[:] = np.nan
        return buffer[: len(x)]

    plain = pso.minimize(sphere, box(3), rng=np.random.default_rng(9), max_evals=600)
    disturbed = pso.minimize(careless, box(3), rng=np.random.default_rng(9), max_evals=600)
    np.testing.assert_array_equal(plain.x, disturbed.x)


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"bounds": [[0, 1], [2, 2]]}, r"bounds\[1\] must be finite with lower < upper, got \[2.0, 2.0\]"),
        ({"bounds": [[0, np.nan]]}, r"bounds\[0\]"),
        ({"bounds": [[-np.inf, 0]]}, r"bounds\[0\]"),
        ({"bounds": [0, 1]}, r"shape \(n, 2\)"),
        ({"bounds": np.zeros((0, 2))}, r"n > 0"),
        ({"n_members": 0}, "n_members must be at least 1, got 0"),
        ({"max_evals": 0}, "max_evals must be at least 1, got 0"),
        ({"x0": [0.5]}, r"x0 must have shape \(2,\)"),
        ({"x0": [0.5, 1.5]}, r"x0\[1\] = 1.5 lies outside its bounds \[0.0, 1.0\]"),
        ({"x0": [0.5, np.nan]}, r"x0\[1\]"),
        ({"xtol": -1.0}, "xtol"),
        ({"w": np.nan}, "w must be finite"),
        (
            {"cost": lambda x: np.zeros((len(x), 1))},
            r"cost must return shape \(30,\) for points of shape .*, got \(30, 1\)",
        ),
        ({"cost": lambda x: 1.0}, r"cost must return shape"),
    ],
)
def test_wrong_input_is_named(options: dict[str, object], text: str) -> None:
    arguments: dict[str, object] = {"cost": sphere, "bounds": [[0, 1], [0, 1]], "rng": np.random.default_rng(0)} | options
    with pytest.raises(ValueError, match=text):
        pso.minimize(**arguments)  # type: ignore[arg-type]
