"""Recursive estimation of whole flights against the truth, the batch solution and the graph's own elimination."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from factorgraph.assembly.blocks import EndsBlock
from factorgraph.assembly.build import Built
from factorgraph.assembly.flight import WholeFlight
from factorgraph.assembly.pieces import sliced
from factorgraph.attitude import log_so3, matrix_from_quat
from factorgraph.filters import methods
from factorgraph.filters.course import ChainEngine
from factorgraph.filters.recursive import IteratedSmoother
from factorgraph.filters.sequential import Stages
from factorgraph.graphs.engine import GtsamEngine
from factorgraph.models.imu_interval import Intervals, carry
from factorgraph.problem import NavigationProblem
from factorgraph.solution import ATT, POS, VEL, Solution, Status
from factorgraph.types import Array
from tests.factorgraph.test_batch_simulation import PAIR, WITH_BASE, flight_of, pair_flight


def quiet(stage: str, fraction: float) -> None:
    """No progress."""


def floating(problem: NavigationProblem) -> NavigationProblem:
    return replace(problem, settings=replace(problem.settings, ambiguity=replace(problem.settings.ambiguity, fix=False)))


@cache
def solved(name: str) -> Solution:
    return methods.create(name, integers=False).solve(pair_flight(1.0, 3)[0].problem, quiet)


def in_sigmas(solution: Solution) -> Array:
    """Errors of baseline, positions, velocities and attitudes at the last state over their standard deviations."""
    flight = pair_flight(1.0, 3)[0]
    found: list[float] = []
    for v in solution.vehicles:
        truth = flight.record.trajectories[v.name].at(v.t_s[-1:])
        turned = log_so3(np.swapaxes(truth.C_nb, 1, 2) @ matrix_from_quat(v.q_nb[-1:]))[0]
        size = np.sqrt([np.trace(v.P[-1, part, part]) for part in (POS, VEL, ATT)])
        errors = (v.r_n[-1] - truth.r_n[0], v.v_n[-1] - truth.v_n[0], turned)
        found += [float(np.linalg.norm(e) / s) for e, s in zip(errors, size, strict=True)]
    pair = solution.pair("a", "b")
    assert pair.truth_enu is not None
    off = np.linalg.norm(pair.baseline_enu[-1] - pair.truth_enu[-1])
    found.append(float(off / np.sqrt(np.trace(pair.P[-1, :3, :3]))))
    return np.array(found)


@pytest.mark.parametrize("name", ["eskf", "iekf", "strong-tracking", "huber", "rackf", "sage-husa", "iae", "forgetting"])
def test_filters_end_where_the_vehicles_are(name: str) -> None:
    solution = solved(name)
    assert solution.diagnostics.status is Status.CONVERGED
    assert np.all(in_sigmas(solution) < 4.0)
    for v in solution.vehicles:
        assert np.all(np.linalg.eigvalsh(v.P) > 0)


def test_innovations_are_as_large_as_said() -> None:
    found = solved("eskf").diagnostics
    assert 0.85 < found.nis[10:].sum() / found.nis_dof[10:].sum() < 1.2
    assert set(np.unique(found.nis_t_s)) <= set(solved("eskf").vehicle("a").t_s)


def test_smoothed_filter_is_close_to_the_batch_solution() -> None:
    """One pass back is the batch solution but for what the first epochs' errors bend; the attitudes were degrees off."""
    flight, _ = pair_flight(1.0, 3)
    batch = WholeFlight("graph", GtsamEngine).solve(floating(flight.problem), quiet)
    once = solved("eskf-rts")
    for name in "ab":
        x, y = once.vehicle(name), batch.vehicle(name)
        sigma = np.sqrt(np.einsum("kii->ki", y.P))
        assert np.all(np.abs(x.r_n - y.r_n) < 0.2 * sigma[:, POS])
        assert np.all(np.abs(x.v_n - y.v_n) < 1.0 * sigma[:, VEL])
        np.testing.assert_allclose(np.sqrt(np.einsum("kii->ki", x.P))[20:], sigma[20:], rtol=0.1)


def test_iterated_smoother_is_the_batch_solution() -> None:
    """With integers; Gauss-Newton forward and back along time, and in a graph."""
    flight, batch = pair_flight(1.0, 3)
    found = IteratedSmoother().solve(flight.problem, quiet)
    for name in "ab":
        x, y = found.vehicle(name), batch.vehicle(name)
        sigma = np.sqrt(np.einsum("kii->ki", y.P))
        assert np.all(np.abs(x.r_n - y.r_n) < 1e-2 * sigma[:, POS])
        np.testing.assert_allclose(np.sqrt(np.einsum("kii->ki", x.P)), sigma, rtol=1e-3)
    np.testing.assert_array_equal(found.pair("a", "b").fix, batch.pair("a", "b").fix)
    np.testing.assert_array_equal(found.ambiguities.integer, batch.ambiguities.integer)


# -- stages -----------------------------------------------------------------------------------------


@cache
def built_flight(text: str = PAIR, imu: str | None = None) -> Built:
    """A flight's blocks at start values."""
    problem = (flight_of(text, 1.0, 4) if imu is None else flight_of(text, 1.0, 4, imu)).problem
    built, _, _ = WholeFlight("", GtsamEngine).started(problem, lambda stage, fraction: None)
    built.graph.assemble()
    return built


def test_part_of_a_block_is_that_part_of_its_rows() -> None:
    for block in built_flight().graph.blocks:
        if isinstance(block, EndsBlock):
            block.predict()
            block.whiten()
            n = len(block.rows.factor.start)
            f0, f1 = n // 3, n // 2
            part = sliced(block, f0, f1)
            part.predict()
            part.whiten()
            rows = slice(block.slices(f0)[0], block.slices(f1 - 1)[1])
            np.testing.assert_array_equal(part.e, block.e[rows])
            np.testing.assert_array_equal(part.Jw, block.Jw[rows])
            whole, own = block.scalars(), part.scalars()
            if whole is not None and own is not None:
                for f in range(f1 - f0):
                    assert own.of(f) == whole.of(f0 + f)
                    np.testing.assert_array_equal(own.matrix(f), whole.matrix(f0 + f))


@pytest.mark.parametrize("text, imu", [(PAIR, None), (WITH_BASE, ""), (PAIR, "")])
def test_chain_is_eliminated_as_a_graph_is(text: str, imu: str | None) -> None:
    """Step and covariances of one linearised flight, with and without IMUs, damped and not."""
    graph = built_flight(text, imu).graph
    graph.predict()
    for block in graph.blocks:
        block.whiten()
    for lam in (0.0, 1.0):
        graphs, chain = (engine.linearise(graph, True).eliminate(lam) for engine in (GtsamEngine(), ChainEngine()))
        assert graphs is not None and chain is not None
        for v in graph.vehicles:
            if v.mode == "fixed":
                continue
            for part, key in enumerate(v.keys(0)):
                keys = [v.keys(k)[part] for k in range(0, len(v.t_s), 5)]
                P = graphs.covariances().joints([[key] for key in keys])
                sigma = np.sqrt(np.einsum("kii->ki", P))
                assert np.all(np.abs(chain.step(keys) - graphs.step(keys)) < 1e-2 * sigma), (v.name, part, lam)
                np.testing.assert_allclose(
                    np.sqrt(np.einsum("kii->ki", chain.covariances().joints([[k] for k in keys]))), sigma, rtol=1e-3
                )


def test_scalars_live_as_long_as_rows_see_them() -> None:
    stages = Stages(built_flight().graph)
    for gnss in stages.graph.gnss:
        for key, t in zip(*gnss.sightings(), strict=True):
            k = int(np.argmin(np.abs(stages.t_s - t)))
            assert int(key) in stages.live[k]
    assert len({key for keys in stages.live for key in keys}) == len(stages.scalars)


def test_states_are_carried_where_the_rows_of_intervals_vanish() -> None:
    graph = built_flight().graph
    stages, values = Stages(graph), graph.values()
    for v in stages.vehicles:
        v.r, v.v, v.R, v.bias = v.r.copy(), v.v.copy(), v.R.copy(), v.bias.copy()
        v.bias[3] += 1e-3
    stages.carry(3, 20)
    for v in stages.vehicles:
        block, own = stages.imu[v.index], slice(10, 11)
        block.predict()
        assert np.abs(block.y.reshape(-1, 15)[3:19]).max() < 1e-4
        part = Intervals(*(getattr(block.intervals, name)[own] for name in Intervals.__dataclass_fields__))
        at = (v.bias[own], block.at_bias[own], block.gravitation_n[own], v.frame.w_ie_n)
        for once, chained in zip(carry(part, v.R[own], v.r[own], v.v[own], *at), (v.R[11], v.r[11], v.v[11]), strict=True):
            np.testing.assert_allclose(once[0], chained, rtol=1e-12, atol=1e-9)
    graph.take(values)
