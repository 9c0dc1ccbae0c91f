"""Graph and least squares on recordings: two formulations, one optimum."""

from __future__ import annotations

import pytest

from factorgraph.registry import solve
from factorgraph.solution import Status
from scenarios.flights import load
from tests.factorgraph.test_agreement import ATTITUDE_RAD, COVARIANCE, POSITION_M, differences
from tests.helpers import shared_data

FLIGHTS = ("cssrlib-static", "cssrlib_kin_2021_265", "kitti", "plaza2")


@pytest.mark.parametrize("name", FLIGHTS)
def test_graph_and_least_squares_agree(name: str) -> None:
    problem = load(name, shared_data("README.md").parent).problem
    graph, other = solve(problem), solve(problem, "least-squares")
    assert graph.diagnostics.status is other.diagnostics.status is Status.CONVERGED
    r, turn, sigma = differences(graph, other)
    assert r < POSITION_M and turn < ATTITUDE_RAD and sigma < COVARIANCE


def test_a_smoother_iterated_finds_the_same_integers_and_optimum() -> None:
    """Arcs that end and begin: their ambiguities share no epoch, and the filter's chain still knows their covariance."""
    problem = load("cssrlib_kin_2021_265", shared_data("README.md").parent).problem
    graph, other = solve(problem), solve(problem, "ieks")
    r, _, sigma = differences(graph, other)
    assert r < POSITION_M and sigma < COVARIANCE
