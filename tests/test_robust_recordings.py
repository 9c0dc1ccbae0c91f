"""Cars among high buildings: what robust losses make of their pseudoranges, beside least squares."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from factorgraph.models.outliers import NLOS
from factorgraph.problem import Robust
from factorgraph.registry import solve
from factorgraph.solution import Solution, Status
from factorgraph.types import Array
from scenarios.flights.load import load
from scenarios.metrics import vehicle_errors
from tests.helpers import shared_data

FILES = {
    "ixr-tokyo": "ixr_tokyo_car/GNSSTCData_GQ_20201105.mat",
    "smartloc-potsdamer": "librsf_smartloc_potsdamer/Berlin_Potsdamer_Platz_RTK_Input.txt",
}


@cache
def solved(name: str, is_robust: bool) -> Solution:
    """As the flight declares it, or without robust losses of GNSS; by the faster of the two methods that agree."""
    problem = load(name, shared_data(FILES[name]).parent.parent).problem
    if not is_robust:
        plain: Mapping[str, Robust] = {"code": Robust("none"), "doppler": Robust("none")}
        problem = replace(problem, settings=replace(problem.settings, robust={**problem.settings.robust, **plain}))
    return solve(problem, "least-squares")


def horizontal(solution: Solution) -> Array:
    position = next(e for e in vehicle_errors(solution.vehicles[0]) if e.quantity == "position")
    error = np.linalg.norm(position.error[:, :2], axis=1)
    return np.asarray(error[np.isfinite(error)])


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_tokyo() -> None:
    """Against fixed RTK; single points err by 4.1 m in the median and 54 m at 95 %."""
    solution = solved("ixr-tokyo", True)
    assert solution.diagnostics.status is Status.CONVERGED
    p50, p95 = np.percentile(horizontal(solution), [50, 95])
    assert p50 <= 2.0 and p95 <= 15.0
    assert p50 < 0.5 * np.median(horizontal(solved("ixr-tokyo", False)))


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_potsdamer_platz() -> None:
    rms = {
        is_robust: float(np.sqrt(np.mean(horizontal(solved("smartloc-potsdamer", is_robust)) ** 2)))
        for is_robust in (True, False)
    }
    assert rms[True] <= 0.6 * rms[False]
    table = solved("smartloc-potsdamer", True).residuals
    blocked = table.outlier_class == NLOS
    assert np.sum(blocked) > 500 and table.residual[blocked].mean() > 20.0  # the way by a reflector is longer
