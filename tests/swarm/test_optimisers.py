"""What holds for every optimiser behind `swarm.minimize`, and for compiled costs."""

from __future__ import annotations

import sys
from typing import Any

import numpy as np
import pytest
from numba import njit

import swarm
from swarm import CompiledCost, Progress, SwarmStatus, ga, pso, references, tdo
from swarm.types import Array
from tests.benchmarks.bench_swarm import problem
from tests.swarm.test_pso import Recorder, box, rastrigin, sphere

ALL = tuple(swarm.METHODS)
COMPILED = tuple(name for name, method in swarm.METHODS.items() if method.is_compiled_capable)


@njit("float64(float64[::1], float64[::1])", cache=True)
def shifted_sphere(x: Array, data: Array) -> float:
    """|x - data|^2, and nan where x[0] > 4."""
    s = 0.0
    for j in range(x.size):
        s += (x[j] - data[j]) ** 2
    if x[0] > 4.0:
        s = np.nan
    x[0] = 1e9  # a cost that does what it should not
    return s


def sphere_like_it(X: Array) -> Array:
    """The same, of points (k, 3), summed in the same order."""
    d = X - np.array([1.3, -2.1, 0.4])
    return np.where(X[:, 0] > 4.0, np.nan, d[:, 0] ** 2 + d[:, 1] ** 2 + d[:, 2] ** 2)


COST = CompiledCost(shifted_sphere, np.array([1.3, -2.1, 0.4]))


def run(method: str, cost: Any, seed: int = 3, **arguments: Any) -> swarm.SwarmResult:
    return swarm.minimize(method, cost, box(3), rng=np.random.default_rng(seed), **{"max_evals": 1500, **arguments})


def same(a: swarm.SwarmResult, b: swarm.SwarmResult) -> bool:
    return np.array_equal(a.x, b.x) and np.array_equal(a.history, b.history) and a.n_evals == b.n_evals


@pytest.mark.parametrize("method", ALL)
def test_every_method_finds_a_minimum_reproducibly_from_its_seed(method: str) -> None:
    one, two, other = run(method, sphere), run(method, sphere), run(method, sphere, seed=4)
    assert one.cost < 1e-3
    assert same(one, two) and not np.array_equal(one.x, other.x)
    assert one.cost == sphere(one.x[None])[0] == one.history[-1]
    assert len(one.history) == len(one.history_evals) and one.history_evals[-1] == one.n_evals
    assert np.all(np.diff(one.history) <= 0) and np.all(np.diff(one.history_evals) > 0)


@pytest.mark.parametrize("method", ALL)
@pytest.mark.parametrize("max_evals", [1, 7, 30, 31, 44, 200])
def test_budget_is_never_exceeded_and_truly_counted(method: str, max_evals: int) -> None:
    cost = Recorder(rastrigin)
    result = run(method, cost, max_evals=max_evals)
    assert result.n_evals == len(cost.points) == max_evals
    assert max(map(len, cost.calls)) <= 30
    assert result.status is SwarmStatus.BUDGET
    assert np.all(np.abs(cost.points) <= 5.12)
    assert result.cost == rastrigin(cost.points).min()


@pytest.mark.parametrize("method", COMPILED)
@pytest.mark.parametrize("max_evals", [1, 30, 44, 3000])
def test_compiled_loop_keeps_the_budget(method: str, max_evals: int) -> None:
    result = run(method, COST, max_evals=max_evals)
    assert result.n_evals == result.history_evals[-1] == max_evals
    assert result.cost == result.history[-1] == sphere_like_it(result.x[None])[0]
    assert np.all(np.diff(result.history) <= 0) and np.all(np.diff(result.history_evals) > 0)


@pytest.mark.parametrize("method", ALL)
def test_first_point_iterations_target_and_callback(method: str) -> None:
    x0 = np.array([1.3, -2.1, 0.4])
    assert run(method, sphere, max_evals=30, x0=x0).cost == pytest.approx(0.0, abs=1e-25)
    for cost in (sphere, COST):
        limited = run(method, cost, n_iter=7)
        assert limited.status is SwarmStatus.ITERATIONS and len(limited.history) == 8
        hit = run(method, cost, max_evals=20_000, target=1e-2)
        assert hit.status is SwarmStatus.TARGET and hit.cost <= 1e-2 < hit.history[-2] and hit.n_evals < 10_000
        heard: list[Progress] = []

        def stop_at_five(progress: Progress, heard: list[Progress] = heard) -> bool:
            heard.append(progress)
            return len(heard) == 5

        stopped = run(method, cost, callback=stop_at_five)
        assert stopped.status is SwarmStatus.STOPPED
        assert [p.cost for p in heard] == stopped.history.tolist()
        assert [p.n_evals for p in heard] == stopped.history_evals.tolist()
        np.testing.assert_array_equal(heard[-1].x, stopped.x)


@pytest.mark.parametrize("method", ALL)
def test_what_is_not_finite_is_counted_and_avoided(method: str) -> None:
    cost = Recorder(sphere_like_it)
    result = run(method, cost, max_evals=600)
    assert result.n_invalid == np.count_nonzero(cost.points[:, 0] > 4.0) > 0
    nothing = run(method, lambda x: np.full(len(x), np.nan), max_evals=200)
    assert nothing.status is SwarmStatus.NO_FINITE_COST and nothing.cost == np.inf
    assert nothing.n_invalid == nothing.n_evals == 200
    assert np.all(np.abs(nothing.x) <= 5.12)


@pytest.mark.parametrize("method", ALL)
def test_cost_cannot_disturb_the_search(method: str) -> None:
    buffer = np.zeros(30)

    def careless(x: Array) -> Array:
        buffer[: len(x)] = sphere(x)
        x[:] = np.nan
        return buffer[: len(x)]

    assert same(run(method, sphere, max_evals=300), run(method, careless, max_evals=300))


@pytest.mark.parametrize("method", ["pso", "pso-ring", "ga"])
def test_compiled_and_python_costs_see_the_same_points(method: str) -> None:
    compiled, plain = run(method, COST), run(method, sphere_like_it)
    assert same(compiled, plain) and compiled.n_invalid == plain.n_invalid > 0
    assert compiled.status is plain.status


@pytest.mark.parametrize("method", ["tdo", "tdo-chase-all"])
def test_tdo_in_place_and_by_populations_are_alike(method: str) -> None:
    """log10 of the cost at an equal budget; the medians differ by less than the spread."""
    logs = [[np.log10(run(method, cost, seed, max_evals=2500).cost) for seed in range(25)] for cost in (COST, sphere_like_it)]
    assert abs(np.median(logs[0]) - np.median(logs[1])) < 0.5 * (np.std(logs[0]) + np.std(logs[1]))


def test_callback_does_not_change_a_compiled_search() -> None:
    for method in COMPILED:
        assert same(run(method, COST), run(method, COST, callback=lambda progress: None))


@pytest.mark.parametrize(("chase_all", "per_member"), [(False, 1.5), (True, 2.0)])
def test_tdo_solves_the_sphere_and_evaluates_as_often_as_published(chase_all: bool, per_member: float) -> None:
    """Spec check 9: six dimensions, N = 30, T = 800."""
    cost = CompiledCost(shifted_sphere, np.zeros(6))
    for given in (cost, lambda x: np.sum(x**2, axis=1)):
        result = tdo.minimize(given, box(6, 3.0), rng=np.random.default_rng(5), max_evals=10**6, n_iter=800, chase_all=chase_all)
        assert result.cost < 1e-6
        assert result.n_evals == pytest.approx(per_member * 30 * 800, rel=0.05)
        assert result.status is SwarmStatus.ITERATIONS


def test_tdo_depends_on_where_the_origin_is_and_normalised_deviations_cure_it() -> None:
    """Spec check 9: the optimum at 100 in raw coordinates, against the same box in deviations from its middle."""
    centre, half = np.full(6, 100.0), 10.0
    raw_bounds = np.column_stack([centre - half, centre + half])

    def cost(x: Array) -> Array:
        return np.asarray(np.sum((x - centre - 0.3) ** 2, axis=1))

    def median(method: str, is_raw: bool) -> float:
        given = (cost, raw_bounds) if is_raw else (lambda y: cost(centre + half * y), box(6, 1.0))
        runs = [swarm.minimize(method, *given, rng=np.random.default_rng(s), max_evals=6000) for s in range(9)]
        return float(np.median([r.cost for r in runs]))

    assert median("tdo", True) > 10 * median("tdo", False)
    assert median("pso", True) == pytest.approx(median("pso", False), abs=1e-15)


def test_published_methods_reach_the_least_squares_optimum() -> None:
    """12 states, 30 rows, 24,000 evaluations; J* from SciPy."""
    problems = [problem(seed) for seed in range(20)]
    best = np.array([p.best() for p in problems])
    points = np.random.default_rng(0).uniform(-3, 3, (9, 12))
    np.testing.assert_allclose(problems[0].compiled()(points), problems[0](points), rtol=1e-12)
    for method in ("tdo", "pso", "ga"):
        costs = [
            swarm.minimize(method, p.compiled(), p.bounds, rng=np.random.default_rng(s)).cost for s, p in enumerate(problems)
        ]
        assert np.median(costs / best - 1) < 1e-3, method
        assert np.min(costs / best - 1) > -1e-9


def test_ring_escapes_more_local_minima() -> None:
    def mean(method: str) -> float:
        runs = [swarm.minimize(method, rastrigin, box(5), rng=np.random.default_rng(s), max_evals=20_000) for s in range(15)]
        return float(np.mean([r.cost for r in runs]))

    assert mean("pso-ring") < 0.7 * mean("pso")


def test_ga_keeps_its_best_member_and_ends_with_fine_steps() -> None:
    coarse = run("ga", sphere, last_step=0.1, max_evals=6000, crossover=0.0)
    fine = run("ga", sphere, max_evals=6000, crossover=0.0)
    assert fine.cost < 1e-3 * coarse.cost


def test_wrong_input_is_named() -> None:
    def wrong(text: str, method: str = "tdo", **arguments: Any) -> None:
        with pytest.raises(ValueError, match=text):
            swarm.minimize(
                method, **{"cost": sphere, "bounds": box(2), "rng": np.random.default_rng(0), "max_evals": 100, **arguments}
            )

    wrong("method must be one of tdo, .*de, got sgd", "sgd")
    wrong("tdo takes the options chase_all, radius, got w", w=1.0)
    wrong("tdo-chase-all takes the options radius, got chase_all", "tdo-chase-all", chase_all=True)
    wrong("pso takes the options .*, got inertia", "pso", inertia=1.0)
    wrong("de takes the options none, got w", "de", w=1.0)
    for method in ALL:
        wrong(r"bounds must have shape \(n, 2\)", method, bounds=[0.0, 1.0])
        wrong(r"x0\[1\] = 9.0 lies outside its bounds", method, x0=[0.0, 9.0])
        wrong("max_evals must be at least 1, got 0", method, max_evals=0)
        wrong("n_members must be at least . got 0".replace(" . ", r" \d, "), method, n_members=0)
        wrong("n_members must be a whole number, got 2.5", method, n_members=2.5)
        wrong("n_iter must be at least 1, got 0", method, n_iter=0)
        wrong("target must be a number or minus infinity, got nan", method, target=np.nan)
        wrong(r"cost must return shape \(30,\) for points of shape .*, got \(\)", method, cost=lambda x: 1.0)
    wrong("radius must be finite and not negative, got -1", radius=-1.0)
    wrong("topology must be one of global, ring, got star", "pso", topology="star")
    wrong(r"crossover must be finite and in \[0, 1\], got 2", "ga", crossover=2.0)
    wrong(r"mutation must be finite and in \[0, 1\], got nan", "ga", mutation=np.nan)
    wrong("alpha must be finite and not negative", "ga", alpha=-0.5)
    wrong("last_step must be finite and in", "ga", last_step=0.5)
    wrong("sigma must be finite and at least", "cma-es", sigma=0.0)
    wrong("cma-es needs bounds of at least 2 coordinates, got 1", "cma-es", bounds=box(1))
    with pytest.raises(ValueError, match=r"data of a compiled cost must have shape \(any,\), got \(2, 2\)"):
        CompiledCost(shifted_sphere, np.zeros((2, 2)))
    with pytest.raises(ValueError, match=r"function of a compiled cost must be decorated .*, got 'sphere'"):
        CompiledCost(sphere, np.zeros(2))


def test_missing_package_of_cma_es_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "cmaes", None)
    with pytest.raises(ImportError, match=r"relnav\[optimisers\]"):
        references.cma_es(sphere, box(2), rng=np.random.default_rng(0))


def test_modules_offer_what_the_names_stand_for() -> None:
    rng = np.random.default_rng
    assert same(run("ga", sphere), ga.minimize(sphere, box(3), rng=rng(3), max_evals=1500))
    assert same(run("pso-ring", sphere), pso.minimize(sphere, box(3), rng=rng(3), max_evals=1500, topology="ring"))
    assert same(run("tdo-chase-all", sphere), tdo.minimize(sphere, box(3), rng=rng(3), max_evals=1500, chase_all=True))
    assert all(method.summary and method.source for method in swarm.METHODS.values())


def test_what_is_no_cost_or_generator_is_told() -> None:
    box = [[-1.0, 1.0]]
    with pytest.raises(ValueError, match=r"rng must be a numpy.random.Generator, got 3"):
        swarm.minimize("pso", lambda x: x[:, 0], box, rng=3)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"cost must be a function of points .*, got 1\.0"):
        swarm.minimize("pso", 1.0, box, rng=np.random.default_rng(0))  # type: ignore[arg-type]
