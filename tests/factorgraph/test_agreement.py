"""One problem, several ways: states and covariances of all methods beside each other."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from factorgraph.gpstime import GpsTime
from factorgraph.measurements import PositionStream
from factorgraph.problem import AmbiguitySettings, Link, MotionPrior, NavigationProblem, Settings, Vehicle
from factorgraph.registry import solve
from factorgraph.solution import ATT, POS, Solution, Status
from tests.factorgraph.synthetic import FRAME
from tests.factorgraph.test_batch_simulation import pair_flight

LINEAR_TO = 1e-8
POSITION_M, ATTITUDE_RAD, COVARIANCE = 1e-4, 1e-5, 0.01
EXACT = Settings(robust={}, tolerance=1e-12)
T = np.arange(0.0, 40.0)


def linear_problem(seed: int) -> NavigationProblem:
    """Two vehicles without IMU, positions of both measured: Gaussian and linear to the last digit."""
    rng = np.random.default_rng(seed)
    vehicles = []
    for name in "ab":
        track = np.cumsum(rng.normal(0.0, 1.0, (len(T), 3)), axis=0)
        sigma = rng.uniform(0.5, 2.0, (len(T), 3))
        fixes = PositionStream(T, track + sigma * rng.normal(0.0, 1.0, track.shape), sigma)
        vehicles.append(Vehicle(name, positions=(fixes,), motion=MotionPrior((1.0, 0.8, 0.5))))
    return NavigationProblem("linear", GpsTime(2300, 0.0), FRAME, tuple(vehicles), pairs=(Link("a", "b"),), settings=EXACT)


def differences(a: Solution, b: Solution) -> tuple[float, float, float]:
    """Largest differences of positions [m] and attitudes [rad], and of standard deviations, relative."""
    r, turn, sigma = [0.0], [0.0], [0.0]
    for x, y in zip(a.vehicles, b.vehicles, strict=True):
        if x.is_fixed:
            continue
        r.append(float(np.abs(x.r_n - y.r_n).max()))
        d = np.abs(np.einsum("ki,ki->k", x.q_nb, y.q_nb))
        turn.append(float(np.nan_to_num(2 * np.sqrt(np.maximum(1 - d**2, 0.0))).max()))
        P, Q = (np.diagonal(v.P, axis1=1, axis2=2) for v in (x, y))
        known = np.isfinite(P)
        assert np.array_equal(known, np.isfinite(Q))
        sigma.append(float(np.abs(np.sqrt(P[known] / Q[known]) - 1).max()))
    for p, q in zip(a.pairs, b.pairs, strict=True):
        r.append(float(np.abs(p.baseline_enu - q.baseline_enu).max()))
        sigma.append(float(np.abs(np.sqrt(np.diagonal(p.P, axis1=1, axis2=2) / np.diagonal(q.P, axis1=1, axis2=2)) - 1).max()))
        assert np.array_equal(p.fix, q.fix)
    return max(r), max(turn), max(sigma)


@pytest.mark.parametrize("seed", [0, 1])
def test_linear_gaussian_problems_have_one_answer(seed: int) -> None:
    problem = linear_problem(seed)
    graph, other = solve(problem), solve(problem, "least-squares")
    for x, y in zip(graph.vehicles, other.vehicles, strict=True):
        np.testing.assert_allclose(y.r_n, x.r_n, rtol=0, atol=LINEAR_TO)
        np.testing.assert_allclose(y.v_n, x.v_n, rtol=0, atol=LINEAR_TO)
        np.testing.assert_allclose(y.P[:, :6, :6], x.P[:, :6, :6], rtol=0, atol=LINEAR_TO)
    np.testing.assert_allclose(other.pairs[0].P, graph.pairs[0].P, rtol=0, atol=LINEAR_TO)


@pytest.mark.parametrize("seed", [10, 14])
def test_graph_and_least_squares_agree_on_a_flight(seed: int) -> None:
    """Phases, integers, robust weights, IMUs and ranges of a simulated pair."""
    flight, _ = pair_flight(1.0, seed)
    graph, other = solve(flight.problem), solve(flight.problem, "least-squares")
    assert graph.diagnostics.status is other.diagnostics.status is Status.CONVERGED
    r, turn, sigma = differences(graph, other)
    assert r < POSITION_M and turn < ATTITUDE_RAD and sigma < COVARIANCE
    np.testing.assert_array_equal(other.ambiguities.integer, graph.ambiguities.integer)
    np.testing.assert_allclose(other.diagnostics.nis_dof, graph.diagnostics.nis_dof, rtol=1e-3)
    np.testing.assert_allclose(other.residuals.residual, graph.residuals.residual, atol=1e-5)


def test_float_ambiguities_agree() -> None:
    flight, _ = pair_flight(1.0, 11)
    settings = replace(flight.problem.settings, ambiguity=AmbiguitySettings(fix=False))
    problem = replace(flight.problem, settings=settings)
    graph, other = solve(problem), solve(problem, "least-squares")
    r, turn, sigma = differences(graph, other)
    assert r < POSITION_M and turn < ATTITUDE_RAD and sigma < COVARIANCE
    np.testing.assert_allclose(other.ambiguities.float_cyc, graph.ambiguities.float_cyc, atol=1e-3)
    np.testing.assert_allclose(other.ambiguities.sigma_cyc, graph.ambiguities.sigma_cyc, rtol=0.01)
    assert np.isfinite(other.vehicle("a").P[:, POS, ATT]).all()
