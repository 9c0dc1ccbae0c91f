"""The optimisation loop on small problems: against scipy, from bad starts, with gross errors, without enough information."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest
from scipy.optimize import least_squares

from factorgraph.assembly import optimizer
from factorgraph.assembly.blocks import Block
from factorgraph.assembly.build import position_blocks, range_blocks
from factorgraph.assembly.optimizer import Graph, Result, optimise
from factorgraph.assembly.parameters import Parameters
from factorgraph.assembly.priors import motion_block, motion_prior_rows, state_prior
from factorgraph.assembly.variables import VehicleVariables
from factorgraph.graphs import engine
from factorgraph.graphs.engine import GtsamEngine
from factorgraph.measurements import HeightStream, PositionStream, RangeStream, Tag
from factorgraph.problem import MotionPrior, RangeModel, Robust, Vehicle
from factorgraph.solution import Status
from factorgraph.types import Array
from tests.factorgraph.synthetic import FRAME

T = np.arange(12.0)
ANCHORS = ((0.0, 0.0, 0.0), (60.0, 0.0, 5.0), (60.0, 50.0, 1.0), (0.0, 50.0, 8.0), (30.0, 25.0, 20.0))
SIGMA_M = 0.1


def track(t: Array) -> Array:
    return np.column_stack([10 + 3 * t, 30 - 1.5 * t, 3 + 0.5 * np.sin(t)])


def measured(seed: int, gross: float = 0.0) -> RangeModel:
    """Ranges to every anchor at every state; a share of them metres too long."""
    rng = np.random.default_rng(seed)
    tags = (Tag("a", "a"), *(Tag(f"x{i}", position_n=p) for i, p in enumerate(ANCHORS)))
    t, b = np.repeat(T, len(ANCHORS)), np.tile(np.arange(len(ANCHORS)) + 1, len(T))
    true = np.linalg.norm(track(t) - np.array(ANCHORS)[b - 1], axis=1)
    z = true + rng.normal(0, SIGMA_M, len(t)) + np.where(rng.random(len(t)) < gross, rng.uniform(5, 40, len(t)), 0.0)
    return RangeModel(RangeStream(t, np.zeros(len(t), int), b, tags, z, np.full(len(t), SIGMA_M)))


def ranging(model: RangeModel, start: Array) -> tuple[Graph, VehicleVariables]:
    """A vehicle with a motion prior and ranges, started at one point."""
    v = VehicleVariables(0, Vehicle("a", motion=MotionPrior((0.5, 0.5, 0.5))), T, FRAME)
    v.r[:] = start
    ranges = range_blocks(model, {"a": v}, Parameters())
    return graph_of(v, [*ranges, motion_block(v)]), v


def graph_of(v: VehicleVariables, blocks: list[Block]) -> Graph:
    graph = Graph([v], GtsamEngine(), blocks)
    graph.assemble()
    return graph


def run(graph: Graph, robust: dict[str, Robust] | None = None, iterations: int = 60) -> Result:
    return optimise(graph, robust or {}, iterations, 1e-9, lambda i, c: None)


def rms(v: VehicleVariables) -> float:
    return float(np.sqrt(np.mean(np.sum((v.r - track(T)) ** 2, axis=1))))


def count_damped(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """The dampings tried from now on."""
    tried: list[float] = []
    damped = engine._damped

    def spy(linear: gtsam.GaussianFactorGraph, lam: float) -> gtsam.GaussianFactorGraph:
        tried.append(lam)
        return damped(linear, lam)

    monkeypatch.setattr(engine, "_damped", spy)
    return tried


def test_the_minimum_is_scipys() -> None:
    model = measured(1)
    graph, v = ranging(model, np.array([30.0, 20.0, 4.0]))
    result = run(graph)
    assert result.status is Status.CONVERGED and result.eliminated is not None
    L, J0 = motion_prior_rows(v)
    anchors = np.array(ANCHORS)[model.stream.tag_b - 1]
    state = np.searchsorted(T, model.stream.t_s)

    def whitened(x: Array) -> Array:
        r, vel = x.reshape(2, -1, 3)
        ranges = (np.linalg.norm(r[state] - anchors, axis=1) - model.stream.range_m) / SIGMA_M
        steps = np.hstack([r[:-1], vel[:-1], r[1:], vel[1:]])
        return np.concatenate([ranges, np.einsum("nij,njk,nk->ni", L, J0, steps).ravel()])

    found = least_squares(whitened, np.concatenate([track(T).ravel(), np.zeros(3 * len(T))]), xtol=1e-12, ftol=1e-12, gtol=1e-12)
    np.testing.assert_allclose(v.r, found.x[: 3 * len(T)].reshape(-1, 3), atol=1e-5)
    np.testing.assert_allclose(graph.cost({}), found.cost, rtol=1e-6)  # of measurements and motion prior together


@pytest.mark.parametrize("start", [(300.0, -200.0, 90.0), (-150.0, 400.0, 30.0), (30.0, 25.0, 2000.0)])
def test_bad_starts_reach_the_same_minimum(start: tuple[float, float, float]) -> None:
    near, v = ranging(measured(2), np.array([30.0, 20.0, 4.0]))
    assert run(near).status is Status.CONVERGED
    far, w = ranging(measured(2), np.array(start))
    result = run(far)
    assert result.status is Status.CONVERGED and rms(w) < 0.3
    np.testing.assert_allclose(w.r, v.r, atol=1e-4)


def test_damping_engages_where_a_full_step_overshoots(monkeypatch: pytest.MonkeyPatch) -> None:
    """From kilometres above, where all ranges point the same way; near the minimum there is none."""
    tried = count_damped(monkeypatch)
    graph, v = ranging(measured(3), np.array([2000.0, -1500.0, 10_000.0]))
    result = run(graph)
    assert result.status is Status.CONVERGED and rms(v) < 0.3
    assert tried and max(tried) > optimizer.LAMBDA_START
    tried.clear()
    assert run(graph).status is Status.CONVERGED
    assert not tried


def test_cost_never_rises() -> None:
    """Not even by robust weights that lag, beyond the tolerance of a step."""
    for seed in range(5):
        graph, _ = ranging(measured(seed, gross=0.1), np.array([200.0, 100.0, 50.0]))
        result = run(graph, {"range": Robust("cauchy", 2.0)})
        costs = np.array(result.costs)
        assert len(costs) > 2
        assert np.all(np.diff(costs) <= 1e-9 * costs[:-1] + 1e-6)


@pytest.mark.parametrize("kernel", ["huber", "cauchy", "geman-mcclure", "tukey"])
def test_gross_errors_lose_their_weight(kernel: str) -> None:
    """One range in ten is 5 to 40 m too long; without a kernel the solution is metres off."""
    robust = {"range": Robust(kernel, 2.0)}  # type: ignore[arg-type]
    model = measured(4, gross=0.1)
    plain, u = ranging(model, np.array([30.0, 20.0, 4.0]))
    run(plain)
    assert rms(u) > 1.0
    graph, v = ranging(model, np.array([30.0, 20.0, 4.0]))
    run(graph, {"range": Robust("huber", 2.0)})  # redescending kernels want a start
    result = run(graph, robust)
    assert result.status is Status.CONVERGED
    assert rms(v) < (0.5 if kernel == "huber" else 0.25)
    true = np.linalg.norm(track(model.stream.t_s) - np.array(ANCHORS)[model.stream.tag_b - 1], axis=1)
    wrong = np.abs(model.stream.range_m - true) > 1.0
    block = graph.blocks[0]
    assert wrong.sum() >= 3
    assert block.w[wrong].max() < 0.1 and np.median(block.w[~wrong]) > 0.7


def test_weights_belong_to_rows_not_to_factors() -> None:
    """A gross error leaves its neighbours of the same epoch their weight."""
    model = measured(5)
    model.stream.range_m[7] += 25.0
    graph, _ = ranging(model, np.array([30.0, 20.0, 4.0]))
    run(graph, {"range": Robust("cauchy", 2.0)})
    block = graph.blocks[0]
    neighbours = block.rows.factor.of_row == block.rows.factor.of_row[7]
    neighbours[7] = False
    assert block.w[7] < 0.01 and block.w[neighbours].min() > 0.3


# -- not enough information ------------------------------------------------------------------------


def test_heights_alone_are_singular() -> None:
    """East and north have no information; the start stays where it is and nothing passes for a covariance."""
    v = VehicleVariables(0, Vehicle("a", heights=(HeightStream(T, 5 + 0.1 * np.sin(T), np.full(12, 0.3)),)), T, FRAME)
    v.v[:] = [1.0, 2.0, 0.3]
    graph = graph_of(v, [*position_blocks(v, Parameters()), motion_block(v)])
    result = run(graph)
    assert result.status is Status.SINGULAR and result.eliminated is None and graph.eliminate() is None
    assert np.abs(v.r).max() < 100.0
    np.testing.assert_allclose(v.r[:, 2], 5.0, atol=1.0)


def test_one_range_per_state_is_singular() -> None:
    model = measured(6)
    stream = model.stream
    keep = stream.tag_b == 1
    one = RangeModel(
        RangeStream(
            stream.t_s[keep], stream.tag_a[keep], stream.tag_b[keep], stream.tags, stream.range_m[keep], stream.sigma_m[keep]
        )
    )
    v = VehicleVariables(0, Vehicle("a"), T, FRAME)
    v.r[:] = [20.0, 20.0, 3.0]
    ranges = range_blocks(one, {"a": v}, Parameters())
    assert run(graph_of(v, list(ranges))).status is Status.SINGULAR
    np.testing.assert_allclose(np.linalg.norm(v.r, axis=1), one.stream.range_m, atol=1e-3)  # what can be had is had


def test_weak_priors_make_it_regular() -> None:
    v = VehicleVariables(0, Vehicle("a", heights=(HeightStream(T, np.full(12, 5.0), np.full(12, 0.3)),)), T, FRAME)
    prior = state_prior(v)
    assert prior is not None
    graph = graph_of(v, [*position_blocks(v, Parameters()), motion_block(v), prior])
    assert run(graph).status is Status.CONVERGED and graph.eliminate() is not None


# -- how it ends -----------------------------------------------------------------------------------


def test_the_iteration_limit_is_a_status() -> None:
    graph, _ = ranging(measured(7), np.array([300.0, -200.0, 90.0]))
    result = run(graph, iterations=2)
    assert result.status is Status.MAX_ITERATIONS and len(result.costs) == 3


def test_progress_hears_every_iteration() -> None:
    graph, _ = ranging(measured(8), np.array([30.0, 20.0, 4.0]))
    heard: list[tuple[int, float]] = []
    result = optimise(graph, {}, 50, 1e-9, lambda i, c: heard.append((i, c)))
    assert [i for i, _ in heard] == list(range(1, len(result.costs)))
    assert [c for _, c in heard] == result.costs[1:]


def test_a_linear_problem_takes_one_step_and_one_to_see_it() -> None:
    rng = np.random.default_rng(9)
    fixes = PositionStream(T, track(T) + rng.normal(0, 1, (12, 3)), np.ones((12, 3)))
    v = VehicleVariables(0, Vehicle("a", positions=(fixes,)), T, FRAME)
    graph = graph_of(v, [*position_blocks(v, Parameters()), motion_block(v)])
    result = run(graph)
    assert result.status is Status.CONVERGED and len(result.costs) == 3
    assert result.costs[1] - result.costs[2] < 1e-6
