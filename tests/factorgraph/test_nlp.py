"""CasADi's solvers on an assembled problem: the optimum of our own, and constraints that hold where they are active."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import casadi as ca
import numpy as np
import pytest

from factorgraph.assembly import phases
from factorgraph.assembly.blocks import Block, RangeBlock
from factorgraph.assembly.build import build
from factorgraph.assembly.engine import Eliminated
from factorgraph.assembly.optimizer import Graph, Values, optimise
from factorgraph.assembly.variables import Trajectory, VehicleVariables
from factorgraph.attitude import exp_so3, log_so3
from factorgraph.errors import InputError
from factorgraph.grid import common_grid
from factorgraph.least_squares import nlp
from factorgraph.least_squares.engine import StageEngine
from factorgraph.least_squares.nlp import Limits, SmoothLoss, Solver, solve
from factorgraph.models.receivers import receivers
from factorgraph.problem import Robust
from scenarios.simulate import simulate
from scenarios.simulate.scenario import parse
from tests.factorgraph import test_blocks, test_intersystem, test_link_atmosphere, test_sensors
from tests.factorgraph.test_batch_simulation import IMU, INFO, PAIR, WITH_BASE

POSITION_M, ATTITUDE_RAD = 1e-5, 1e-6
DURATION_S = {PAIR: 6.0, WITH_BASE: 7.0}


@cache
def _start(text: str) -> tuple[Graph, Values]:
    """A short flight at values near the truth: a metre, 0.1 m/s and 0.01 rad off."""
    info = INFO.replace("duration_s = 65.0", f"duration_s = {DURATION_S[text]}")
    flight = simulate(parse((info + text).format(noise=1.0, imu=IMU, gnss="")), 5)
    problem, rng = flight.problem, np.random.default_rng(1)
    vehicles = [VehicleVariables(i, v, common_grid(problem), problem.frame) for i, v in enumerate(problem.bodies)]
    for v in vehicles:
        if v.mode != "fixed":
            truth = flight.record.trajectories[v.name].at(v.t_s)
            v.r, v.v, v.R = truth.r_n.copy(), truth.v_n.copy(), truth.C_nb.copy()
            v.attitude_prior = v.R[0].copy(), np.full(3, 1e-3)
    built = build(problem, vehicles, receivers(problem), use_phase=True, engine=StageEngine())
    for link in built.links:
        phases.prepare(link, problem.settings.ambiguity)
    built.graph.assemble()
    for v in vehicles:
        if v.mode != "fixed":
            v.r, v.v = v.r + rng.normal(0, 1, v.r.shape), v.v + rng.normal(0, 0.1, v.v.shape)
            v.R = v.R @ exp_so3(rng.normal(0, 0.01, v.r.shape))
    return built.graph, built.graph.values()


def graph_of(text: str) -> Graph:
    graph, start = _start(text)
    for block in graph.blocks:
        block.w = np.ones(block.n)
    graph.take(start)
    return graph


@cache
def optimum(text: str) -> Values:
    """By Gauss-Newton: whole steps, which no rounding of costs stops."""
    graph = graph_of(text)
    for _ in range(8):
        graph.move(_eliminated(graph))
    return graph.values()


def _eliminated(graph: Graph) -> Eliminated:
    eliminated = graph.eliminate()
    assert eliminated is not None
    return eliminated


def apart(a: list[Trajectory], b: list[Trajectory]) -> tuple[float, float]:
    """Largest differences of positions [m] and attitudes [rad]."""
    turn = [np.abs(log_so3(np.swapaxes(x.R, 1, 2) @ y.R)).max() for x, y in zip(a, b, strict=True)]
    return max(float(np.abs(x.r - y.r).max()) for x, y in zip(a, b, strict=True)), float(max(turn))


@pytest.mark.parametrize(
    ("text", "solver"),
    [
        (PAIR, Solver("sqpmethod")),
        (PAIR, Solver("ipopt")),
        (WITH_BASE, Solver("sqpmethod", qp="daqp")),
        (WITH_BASE, Solver("fatrop")),
    ],
    ids=lambda x: "-".join((x.name, x.qp)) if isinstance(x, Solver) else "pair" if x is PAIR else "base",
)
def test_all_solvers_reach_the_optimum(text: str, solver: Solver, capfd: pytest.CaptureFixture[str]) -> None:
    graph = graph_of(text)
    before = graph.cost({})
    answer = solve(graph, solver)
    assert answer.success and answer.refusing is None and answer.iterations > 0
    r, turn = apart(graph.values().trajectories, optimum(text).trajectories)
    assert r < POSITION_M and turn < ATTITUDE_RAD
    np.testing.assert_allclose(graph.values().ambiguities[0], optimum(text).ambiguities[0], atol=1e-4)
    assert before > 10 * graph.cost({}) and abs(graph.cost({}) - answer.cost) < 1e-4
    out = capfd.readouterr()
    assert out.out == "" and out.err == ""


@pytest.mark.parametrize("solver", ["sqpmethod", "fatrop"])
def test_a_bound_is_held_and_costs_what_fixing_there_costs(solver: str) -> None:
    """An accelerometer bias bound below its estimate; the same bias all but fixed at the bound by both limits."""
    estimate = optimum(WITH_BASE).trajectories[1].bias[:, 5]
    bound = float(estimate.min()) - 0.02
    answers, states = [], []
    for low in (-np.inf, bound):
        graph = graph_of(WITH_BASE)
        limits = Limits()
        limits.bias(graph, "a", "accelerometer", 2, low, bound)
        answers.append(solve(graph, Solver(solver), limits))
        states.append(graph.values().trajectories)
        assert answers[-1].success
        np.testing.assert_allclose(graph.vehicles[1].bias[:, 5], bound, atol=1e-5)
    r, turn = apart(*states)
    assert r < 1e-4 and turn < 1e-5
    assert answers[0].cost == pytest.approx(answers[1].cost, rel=1e-5)
    graph = graph_of(WITH_BASE)
    graph.take(optimum(WITH_BASE))
    assert answers[0].cost > graph.cost({}) + 0.1


def test_ranges_stay_above_a_limit() -> None:
    graph = graph_of(PAIR)
    graph.take(optimum(PAIR))
    block = next(b for b in graph.blocks if isinstance(b, RangeBlock))
    least = float((block.z_m - block.y).min()) + 0.02
    limits = Limits()
    limits.range(block, least)
    limits.height(graph, "a", 0.0, 1000.0)  # far away
    assert solve(graph, Solver("ipopt"), limits).success
    predicted = block.z_m - block.y
    assert predicted.min() > least - 1e-5 and predicted.min() < least + 1e-5


@pytest.mark.parametrize("solver", ["ipopt", "fatrop"])
def test_heights_stay_below_a_ceiling(solver: str) -> None:
    graph = graph_of(WITH_BASE)
    up = optimum(WITH_BASE).trajectories[1].r[:, 2]
    ceiling = float(up.max()) - 0.01
    limits = Limits()
    limits.height(graph, "a", -np.inf, ceiling)
    assert solve(graph, Solver(solver), limits).success
    below = ceiling - graph.vehicles[1].r[:, 2]
    assert below.min() > -5e-6 and below[np.argmax(up)] < 1e-5


def test_what_is_impossible_names_the_measurement(capfd: pytest.CaptureFixture[str]) -> None:
    """A vehicle that is to be at two heights."""
    graph = graph_of(WITH_BASE)
    before = graph.values()
    limits = Limits()
    limits.height(graph, "a", 100.0, 101.0)
    limits.height(graph, "a", 300.0, 301.0)
    answer = solve(graph, Solver("ipopt", max_iterations=25), limits)
    assert not answer.success
    assert answer.status in ("Infeasible_Problem_Detected", "Restoration_Failed", "Maximum_Iterations_Exceeded")
    assert answer.refusing is not None and "sigma" in answer.refusing
    assert apart(graph.values().trajectories, before.trajectories) == (0.0, 0.0)
    assert capfd.readouterr().out == ""


def test_a_written_out_loss_is_that_of_reweighting() -> None:
    """Cauchy's, with a code off by 60 m. Reweighting judges residuals by their own variance, which the clock takes from."""
    graph = graph_of(WITH_BASE)
    block = graph.gnss[0]
    code = int(np.flatnonzero(block.rows.kind == 0)[3])
    honest = block.z.copy()
    block.z = block.z + np.where(np.arange(block.n) == code, 60.0, 0.0)
    try:
        assert solve(graph, Solver("ipopt"), losses={"code": SmoothLoss("cauchy", 2.0)}).success
        written = graph.values().trajectories
        graph = graph_of(WITH_BASE)
        graph.move(_eliminated(graph))
        plain = graph.values().trajectories
        graph = graph_of(WITH_BASE)
        optimise(graph, {"code": Robust("cauchy", 2.0)}, 60, 1e-12, lambda i, c: None)
    finally:
        block.z = honest
    r, _ = apart(written, graph.values().trajectories)
    assert r < 0.01 and apart(plain, graph.values().trajectories)[0] > 10 * r


def test_what_cannot_be_used_is_said() -> None:
    graph = graph_of(WITH_BASE)
    for solver in (Solver("gurobi"), Solver("sqpmethod", qp="mosek"), Solver("fatrop", hessian="limited-memory")):
        with pytest.raises(InputError, match="there are"):
            solve(graph, solver)
    with pytest.raises(InputError, match="not smooth"):
        SmoothLoss("tukey", 2.0)
    limits = Limits()
    with pytest.raises(InputError, match="no vehicle 'c'"):
        limits.height(graph, "c", 0.0, 1.0)
    with pytest.raises(InputError, match="no parameter"):
        limits.parameter(graph, "no such", 0.0, 1.0)
    limits.bias(graph, "a", "gyroscope", 0, 1.0, 0.0)
    with pytest.raises(InputError, match="above its upper limit"):
        solve(graph, replace(Solver(), name="sqpmethod"), limits)


ROWS: list[tuple[Any, ...]] = [
    (test_blocks.test_differences_of_code_phase_and_doppler, ("imu", "imu"), 0.4),
    (test_blocks.test_differences_of_code_phase_and_doppler, ("motion", "imu"), 0.0),
    (test_blocks.test_positions_and_heights, "imu", 0.4),
    (test_blocks.test_ranges_with_bias_and_scale, ("imu", "imu"), False),
    (test_blocks.test_ranges_with_bias_and_scale, ("motion", "imu"), True),
    (test_blocks.test_levers_and_time_offsets_of_differences, 0.4),
    (test_intersystem.test_jacobians_of_biases,),
    (test_link_atmosphere.test_jacobians_of_delays_and_their_processes,),
    (test_sensors.test_odometer, "between", True),
    (test_sensors.test_attitude, "between", 0.3),
    (test_sensors.test_vision, "at states", "vehicle without"),
    (test_sensors.test_barometer, "imu"),
]


def rows_follow(graph: Graph, block: Block, *_: Any) -> None:
    """Rows at a step are those of the block after the step, common clocks aside."""
    program = nlp._Program(replace(graph, blocks=[block]), Limits(), {}, staged=False)
    scale = np.array(
        [1e-3 if chr(key >> 56) in "xbl" else 0.1 for key in program.unknowns.dim for _ in range(program.unknowns.dim[key])]
    )
    d = np.random.default_rng(4).normal(0, 1.0, program.unknowns.size)
    d[: len(scale)] *= scale
    before = graph.values()
    found = ca.Function("rows", [program.d, program.held], [program.residual])(d, d).full()[:, 0]
    graph.move(nlp._Step(program.unknowns, d))  # type: ignore[arg-type]
    block.whiten()
    if block.rows.clocks is not None:
        found = block.rows.clocks.project(found / block.u, block.u)
    np.testing.assert_allclose(found, block.e, rtol=1e-8, atol=2e-5)
    graph.take(before)
    block.whiten()


@pytest.mark.parametrize("case", ROWS, ids=lambda case: " ".join([case[0].__name__.removeprefix("test_"), *map(str, case[1:])]))
def test_rows_are_those_after_the_step(case: tuple[Any, ...], monkeypatch: pytest.MonkeyPatch) -> None:
    for module in (test_blocks, test_sensors, test_intersystem, test_link_atmosphere):
        monkeypatch.setattr(module, "assert_jacobians", rows_follow)
    run, *arguments = case
    run(*arguments)
