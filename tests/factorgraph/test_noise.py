"""Variance components: on plain least squares, with outliers, and in simulated flights whose noise is not what was declared."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from factorgraph.models.noise import KEPT, components, scale
from factorgraph.problem import NavigationProblem, NoiseModel
from factorgraph.registry import solve
from factorgraph.solution import Fix
from factorgraph.types import Array
from scenarios.flights import load
from scenarios.flights.schema import GnssNoiseTable
from scenarios.simulate import SimulatedFlight, load_scenario, simulate
from scenarios.studies import replace_duration
from tests.helpers import assert_consistent, shared_data


def adjusted(rng: np.random.Generator, sigma: Array, unknowns: int, declared: Array) -> tuple[Array, Array]:
    """Residuals and redundancy numbers of a weighted least-squares fit of noise."""
    n = len(sigma)
    A = rng.normal(0, 1, (n, unknowns))
    y = sigma * rng.normal(0, 1, n)
    W = A / declared[:, None] ** 2
    H = A @ np.linalg.solve(A.T @ W, W.T)
    return y - H @ y, 1 - np.diag(H)


def test_bounded_squares_keep_their_share() -> None:
    t = np.random.default_rng(0).normal(0, 1, 400_000)
    assert np.mean(np.minimum(t**2, 4.0)) == pytest.approx(KEPT, rel=5e-3)


@pytest.mark.parametrize("factor", [0.5, 1.0, 2.0])
def test_a_factor_is_found_without_bias(factor: float) -> None:
    """Many unknowns: without redundancy numbers it would be a third too small."""
    rng = np.random.default_rng(3)
    declared = rng.uniform(0.1, 0.5, 300)
    found = [scale(*_with(adjusted(rng, factor * declared, 160, declared), declared)).value[0] for _ in range(30)]
    assert np.mean(found) == pytest.approx(factor, rel=0.03)
    one = scale(*_with(adjusted(rng, factor * declared, 160, declared), declared))
    assert one.redundancy == pytest.approx(140, abs=3) and one.sigma[0] == pytest.approx(np.std(found), rel=0.5)


def _with(fit: tuple[Array, Array], sigma: Array) -> tuple[Array, Array, Array]:
    return fit[0], sigma, fit[1]


def test_outliers_hardly_count() -> None:
    rng = np.random.default_rng(4)
    v = rng.normal(0, 0.3, 2000)
    v[:100] += 20.0
    assert scale(v, np.full(2000, 0.3), np.ones(2000)).value[0] == pytest.approx(1.12, abs=0.1)
    assert np.std(v) / 0.3 > 10


def test_two_components_are_told_apart() -> None:
    rng = np.random.default_rng(5)
    el = rng.uniform(np.deg2rad(10), np.deg2rad(85), 6000)
    A = np.column_stack([np.ones(6000), 1 / np.sin(el) ** 2])
    sigma = np.sqrt(A @ [0.04, 0.01])
    found = components(sigma * rng.normal(0, 1, 6000), np.full(6000, 0.5), np.ones(6000), A)
    np.testing.assert_allclose(found.value, [0.04, 0.01], rtol=0.15)
    assert np.all(np.abs(found.value - [0.04, 0.01]) < 4 * found.sigma)
    only = components(0.2 * rng.normal(0, 1, 6000), np.full(6000, 0.5), np.ones(6000), A)
    assert only.value[0] == pytest.approx(0.04, rel=0.1) and only.value[1] < 0.002


def test_nothing_to_estimate_from_is_nan() -> None:
    assert np.isnan(scale(np.zeros(3), np.ones(3), np.zeros(3)).value[0])
    assert np.all(np.isnan(components(np.zeros(3), np.ones(3), np.zeros(3), np.ones((3, 2))).value))


# -- whole flights -----------------------------------------------------------------------------------------------------

DECLARED = GnssNoiseTable(code_m=0.3, phase_m=0.003, doppler_mps=0.05, elevation_mask_deg=10.0)


@cache
def flight(seed: int) -> SimulatedFlight:
    return simulate(replace_duration(load_scenario("two-uav"), 40.0), seed)


def declared_wrong(problem: NavigationProblem, factor: float) -> NavigationProblem:
    """Noise that is `factor` times what the estimator is told."""
    true = DECLARED.noise
    told = replace(true, code_m=true.code_m / factor, phase_m=true.phase_m / factor, doppler_mps=true.doppler_mps / factor)
    vehicles = tuple(replace(v, gnss=replace(v.gnss, noise=told)) for v in problem.vehicles if v.gnss)
    return replace(problem, vehicles=vehicles, settings=replace(problem.settings, estimate_noise="scale"))


@pytest.mark.parametrize("factor", [0.5, 2.0])
def test_wrong_noise_of_a_flight_is_recovered(factor: float) -> None:
    found: dict[str, list[float]] = {}
    errors, covariances = [], []
    for seed in (31, 32):
        solution = solve(declared_wrong(flight(seed).problem, factor))
        for p in solution.diagnostics.parameters:
            if p.name.endswith("noise factor"):
                found.setdefault(p.name.rsplit(" ", 3)[1], []).append(p.value)
        pair = solution.pair("leader", "follower")
        assert np.all(pair.fix == Fix.FIXED.value) and pair.truth_enu is not None
        assert float(solution.diagnostics.nis.sum() / solution.diagnostics.nis_dof.sum()) == pytest.approx(0.96, abs=0.06)
        errors.append(pair.baseline_enu - pair.truth_enu)
        covariances.append(pair.P[:, :3, :3])
    for kind in ("code", "phase"):
        assert np.mean(found[kind]) == pytest.approx(factor, rel=0.1), kind
    assert np.mean(found["doppler"]) == pytest.approx(factor, rel=0.15)  # what Doppler leaves out does not scale with it
    assert_consistent(np.array([e[20] for e in errors]), np.array([P[20] for P in covariances]))


@pytest.mark.parametrize("model", ["elevation", "cn0"])
def test_two_components_of_a_flight(model: NoiseModel) -> None:
    """Simulated as sigma0^2 (1 + 1 / sin^2) / 2: a and b are sigma0 / sqrt(2) each; C/N0 follows elevation there."""
    problem = flight(31).problem
    solution = solve(replace(problem, settings=replace(problem.settings, estimate_noise=model)))
    value = {p.name: p.value for p in solution.diagnostics.parameters}
    a, b = (value[f"leader-follower code noise {part} ({model})"] for part in "ab")
    assert (solution.diagnostics.nis.sum() / solution.diagnostics.nis_dof.sum()) == pytest.approx(0.96, abs=0.06)
    if model == "elevation":
        assert np.hypot(a, b) == pytest.approx(0.3, rel=0.1) and b == pytest.approx(0.21, rel=0.25)
    else:
        assert a > 0.1 and b > 0.05


def test_a_static_pair_of_geodetic_receivers() -> None:
    """Much better than the defaults declare: residuals come to what is said of them, the baseline stays."""
    data = shared_data("cssrlib_static_2021_078")
    problem = load("cssrlib_static_2021_078", data.parent).problem
    before = solve(problem)
    after = solve(replace(problem, settings=replace(problem.settings, estimate_noise="scale")))
    ratio = [float(s.diagnostics.nis.sum() / s.diagnostics.nis_dof.sum()) for s in (before, after)]
    assert ratio[0] < 0.6 and 0.9 < ratio[1] < 1.1
    pair = after.pairs[0]
    assert np.all(pair.fix == Fix.FIXED.value)
    np.testing.assert_allclose(pair.baseline_enu, before.pairs[0].baseline_enu, atol=5e-3)
