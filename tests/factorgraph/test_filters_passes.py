"""Passes over the whole flight against the filter stage by stage, the batch solution and what may not matter."""

from __future__ import annotations

import copy
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from factorgraph.assembly.blocks import GnssBlock, RangeBlock
from factorgraph.assembly.flight import WholeFlight
from factorgraph.assembly.optimizer import Graph, Result
from factorgraph.assembly.result import make_solution
from factorgraph.filters import passes, recursive
from factorgraph.filters.course import ChainEngine, Track, smooth_values
from factorgraph.problem import NavigationProblem, Robust
from factorgraph.registry import solve
from factorgraph.solution import Status
from factorgraph.types import Array
from tests.factorgraph.test_agreement import LINEAR_TO, linear_problem
from tests.factorgraph.test_batch_simulation import IMU, PAIR, WITH_BASE, flight_of, pair_flight, relative, true_baseline
from tests.factorgraph.test_horizon import with_barometer


def quiet(stage: str, fraction: float) -> None:
    """No progress."""


def with_parameters(problem: NavigationProblem) -> NavigationProblem:
    """Scale factors of one IMU, and an ionosphere in nodes although the vehicles are near each other."""
    a, *others = problem.vehicles
    a = replace(a, imu_calibration=replace(a.imu_calibration, accel_scale=2e-3, gyro_scale=1e-3))
    settings = replace(problem.settings, ionosphere_min_baseline_m=0.0, ionosphere_ppm=200.0, ionosphere_step_s=20.0)
    return replace(problem, vehicles=(a, *others), settings=settings)


@cache
def _started(name: str) -> Graph:
    text, imu = {"pair": (PAIR, IMU), "motion": (PAIR, ""), "base": (WITH_BASE, IMU), "parameters": (PAIR, IMU)}[name]
    problem = flight_of(text, 1.0, 4, imu).problem
    if name == "parameters":
        problem = with_parameters(problem)
    graph = WholeFlight("", ChainEngine).started(problem, quiet)[0].graph
    graph.assemble()
    return graph


def flight(name: str) -> Graph:
    """A flight at its start values."""
    return copy.deepcopy(_started(name))


def off(track: Track, other: Track) -> float:
    """Largest difference of states and of parameters and ambiguities in standard deviations."""
    s, worst = track.stages, 0.0
    sigma = [np.sqrt(np.diag(stage.P)) for stage in track.course]
    for v, w in zip(s.vehicles, other.stages.vehicles, strict=True):
        at = s.offset[v.index]
        own = np.array([x[at : at + sum(v.dims)] for x in sigma])
        d = [v.r - w.r, v.v - w.v]
        if v.mode == "imu":
            turned = 0.5 * np.array([np.cross(a.T, b.T).sum(axis=0) for a, b in zip(v.R, w.R, strict=True)])
            along = np.einsum("kji,kj->ki", v.R, d[0])
            d = [turned, along, d[1], v.bias[:, 3:] - w.bias[:, 3:], v.bias[:, :3] - w.bias[:, :3]]
        worst = max(worst, float(np.abs(np.hstack(d) / own).max()))
    for p, q in zip(s.parameters, other.stages.parameters, strict=True):
        worst = max(worst, float(np.abs((p.value - q.value) / sigma[-1][s.place[p.key] : s.place[p.key] + len(p.value)]).max()))
    for key, x in s.scalars.items():
        y = other.stages.scalars[key]
        column = s.n_fixed + s.live[x.last].index(key)
        worst = max(worst, float(abs(x.values[x.index] - y.values[y.index]) / sigma[x.last][column]))
    return worst


@pytest.mark.parametrize("name, states", [("pair", 3e-3), ("motion", 3e-3), ("base", 3e-3), ("parameters", 1e-2)])
def test_passes_are_the_filter_stage_by_stage(monkeypatch: pytest.MonkeyPatch, name: str, states: float) -> None:
    """Single stages evaluate at their own predictions; parameters, unlike there, are linearised once."""
    monkeypatch.setattr(recursive, "WINDOW", 1)
    graphs = flight(name), flight(name)
    by_stage, track = recursive.run(graphs[0], recursive.Filter(), {}).track, passes.filtered(graphs[1])
    assert track.unsettled is None and bool(track.stages.processes) == bool(track.stages.parameters) == (name == "parameters")
    assert off(by_stage, track) < states
    for x, y in zip(by_stage.course, track.course, strict=True):
        assert np.all(np.abs(x.dx - y.dx) < states * np.sqrt(np.diag(x.prior)))
        np.testing.assert_allclose(np.sqrt(np.diag(y.P)), np.sqrt(np.diag(x.P)), rtol=10 * states)
        np.testing.assert_allclose([y.nis, y.dof], [x.nis, x.dof], rtol=10 * states, atol=states)
    for number, residuals in by_stage.y.items():
        assert np.all(np.abs(residuals - track.y[number]) < states * graphs[0].blocks[number].rows.sigma)
    smooth_values(by_stage)
    smooth_values(track)
    assert off(by_stage, track) < 2 * states


@pytest.mark.parametrize("seed", [0, 1])
def test_linear_gaussian_problems_have_one_answer(seed: int) -> None:
    problem = linear_problem(seed)
    built, _, spent = WholeFlight("", ChainEngine).started(problem, quiet)
    built.graph.assemble()
    track = passes.filtered(built.graph)
    smooth_values(track)
    built.graph.engine = ChainEngine(track)
    built.graph.predict()
    found = make_solution(problem, "eskf-rts", built, Result(Status.CONVERGED, [0.0]), np.nan, spent, [])
    graph = solve(problem)
    for x, y in zip(graph.vehicles, found.vehicles, strict=True):
        np.testing.assert_allclose(y.r_n, x.r_n, rtol=0, atol=LINEAR_TO)
        np.testing.assert_allclose(y.v_n, x.v_n, rtol=0, atol=LINEAR_TO)
        np.testing.assert_allclose(y.P[:, :6, :6], x.P[:, :6, :6], rtol=0, atol=LINEAR_TO)
    np.testing.assert_allclose(found.pairs[0].P, graph.pairs[0].P, rtol=0, atol=LINEAR_TO)


def predictions_of(graph: Graph) -> tuple[Array, Array]:
    track = passes.filtered(graph)
    return np.array([np.hstack([v.r, v.v, v.bias]) for v in track.stages.vehicles]), np.array([x.dx[:30] for x in track.course])


def test_what_comes_later_and_where_rows_were_evaluated_first_do_not_matter(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(passes, "SETTLED", 1e-7)
    one, other, K = flight("pair"), flight("pair"), 40
    for v in other.vehicles:
        v.r[1:] += 3.0
        v.bias[1:, :3] += 1e-3
    for block in other.blocks:
        if isinstance(block, RangeBlock):
            block.z_m[block.a.query.k >= K] += 2.0
    (x, dx), (y, dy) = predictions_of(one), predictions_of(other)
    np.testing.assert_allclose(y[:, :K], x[:, :K], rtol=0, atol=1e-6)
    np.testing.assert_allclose(dy[:K], dx[:K], rtol=0, atol=1e-6)
    assert np.abs(y[:, K:] - x[:, K:]).max() > 0.1


def spoiled(graph: Graph) -> Graph:
    """From the tenth stage on every tenth range 4 m and every sixtieth GNSS row 30 standard deviations too long."""
    for block in graph.blocks:
        if isinstance(block, RangeBlock):
            block.z_m[50::10] += 4.0
        elif isinstance(block, GnssBlock):
            late = np.flatnonzero(block.rows.t_s > graph.vehicles[0].t_s[10])[::60]
            block.z[late] += 30 * block.rows.sigma[late]
    return graph


@pytest.mark.parametrize("kernel, width", [("huber", 2.0), ("cauchy", 2.0), ("dcs", 2.5), ("tukey", 5.0), ("geman-mcclure", 3.0)])
def test_robust_weights_hold_gross_errors_off(kernel: str, width: float) -> None:
    losses = {kind: Robust(kernel, width) for kind in ("code", "phase", "doppler", "range")}  # type: ignore[arg-type]
    clean, drawn = passes.filtered(flight("pair")), passes.filtered(spoiled(flight("pair")))
    robust = passes.filtered(spoiled(flight("pair")), robust=losses)
    assert off(clean, drawn) > 10.0
    assert off(clean, robust) < 0.15 * off(clean, drawn)
    for number, block in enumerate(robust.stages.graph.blocks):
        if isinstance(block, RangeBlock):
            w = robust.w[number]
            assert np.median(w[50::10]) < 0.3 < 0.9 < np.median(np.delete(w, np.s_[50::10]))


def test_passes_that_do_not_settle_say_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(passes, "PASSES", 1)
    unsettled = passes.filtered(flight("motion")).unsettled
    assert unsettled is not None and unsettled > passes.SETTLED


def test_the_method_ends_where_the_vehicles_are() -> None:
    flight, _ = pair_flight(1.0, 10)
    solution = solve(flight.problem, "eskf-passes")
    pair = solution.pair("a", "b")
    error = relative(solution, "a", "b")[0] - true_baseline(flight, pair)[0]
    assert np.all(np.abs(error[-1]) < 4 * np.sqrt(np.diagonal(pair.P[-1])[:3]))
    nis = solution.diagnostics
    assert 0.9 < nis.nis.sum() / nis.nis_dof.sum() < 1.1


def test_a_barometers_nodes_have_their_places() -> None:
    problem = with_barometer()
    stagewise, whole = (solve(problem, method).vehicles[0] for method in ("eskf", "eskf-passes"))
    np.testing.assert_allclose(whole.r_n, stagewise.r_n, rtol=0, atol=1e-4)
