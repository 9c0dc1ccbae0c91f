"""Double differences: geometry, correlated noise, the table of shared observations."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from factorgraph.errors import InputError
from factorgraph.gpstime import GpsTime
from factorgraph.measurements import GnssStream
from factorgraph.models import double_differences as dd
from factorgraph.models.differencing import CommonGroups
from factorgraph.models.receivers import Receiver, receivers
from factorgraph.problem import Antenna, GnssNoise, Link, NavigationProblem, Settings, Vehicle
from factorgraph.types import Array, IntArray
from scenarios.published import aar
from tests.factorgraph import synthetic
from tests.factorgraph.relative import LAM, SD_CYCLES, pair

ORDER = np.array([0, 1, 2, 3, 4, 5, 6])
STILL = np.zeros(3)


def differencing(n: int, order: IntArray) -> Array:
    """D (m, n) of satellites minus the pivot order[0]."""
    return np.asarray(np.eye(n)[order[1:]] - np.eye(n)[order[0]])


# geometry


def test_prediction_is_the_definition() -> None:
    rng = np.random.default_rng(1)
    r_a, v_a, r_b, v_b = rng.normal(size=(4, 3)) * [[1e3], [1e2], [1e4], [1e2]]
    sat_a = rng.normal(size=(6, 3)) * 2e7
    sat_b, vel_a, vel_b = sat_a + rng.normal(size=(6, 3)), rng.normal(size=(6, 3)) * 3e3, rng.normal(size=(6, 3)) * 3e3
    order = np.array([4, 0, 5, 2])
    rho, rate, G = dd.predict(sat_a, sat_b, vel_a, vel_b, order, r_a, v_a, r_b, v_b)
    D = differencing(6, order)
    e_a, e_b, e = sat_a - r_a, sat_b - r_b, 0.5 * (sat_a + sat_b) - 0.5 * (r_a + r_b)
    rho_a, rho_b = np.linalg.norm(e_a, axis=1), np.linalg.norm(e_b, axis=1)
    np.testing.assert_allclose(rho, D @ (rho_b - rho_a), atol=1e-7)
    rate_a, rate_b = (np.sum(x / n[:, None] * v, axis=1) for x, n, v in ((e_a, rho_a, vel_a - v_a), (e_b, rho_b, vel_b - v_b)))
    np.testing.assert_allclose(rate, D @ (rate_b - rate_a), atol=1e-9)
    np.testing.assert_allclose(G, -D @ (e / np.linalg.norm(e, axis=1)[:, None]), atol=1e-14)


def test_midpoints_are_linear_along_the_whole_refuelling() -> None:
    """Spec aar_two_stage.md, check 3: below 1 mm all the way, where the rover's line of sight is more than 0.3 m off."""
    flight = aar.simulate_flight(3)
    ready = receivers(flight.problem)
    data = dd.pair_epochs(ready[aar.TANKER], ready[aar.UAV], flight.problem.settings)
    paths = flight.record.trajectories
    r_a, r_b = paths[aar.TANKER].at(data.t_reference_s).r_n, paths[aar.UAV].at(data.t_rover_s).r_n
    worst, rovers_own = [], []
    for k in range(data.n_epochs):
        order, sat = data.order(k), data.sat_rover[k]
        rho, _, G = dd.predict(sat, sat, data.vel_rover[k], data.vel_rover[k], order, r_a[k], STILL, r_b[k], STILL)
        e = sat - r_b[k]
        e /= np.linalg.norm(e, axis=1)[:, None]
        own = -(e[order[1:]] - e[order[0]])
        b = r_b[k] - r_a[k]
        worst.append(np.abs(G @ b - rho).max())
        rovers_own.append(np.abs(own @ b - rho).max())
    assert max(worst) < 1e-3
    assert rovers_own[0] > 0.3 and rovers_own[-1] < 1e-3


def test_a_baseline_far_off_is_still_linear() -> None:
    """What a filter relies on: DD rho(b) = DD rho(b_lin) + G (b - b_lin), 30 m from the truth at 5.7 km within 5 mm."""
    b, data = np.array([-4827.0, 3081.0, -99.0]), pair(np.zeros((1, 3)))
    sat, vel = data.sat_rover[0], data.vel_rover[0]
    true, _, _ = dd.predict(sat, sat, vel, vel, ORDER, STILL, STILL, b, STILL)
    for off in 30.0 * np.eye(3):
        rho, _, G = dd.predict(sat, sat, vel, vel, ORDER, STILL, STILL, b + off, STILL)
        np.testing.assert_allclose(rho - G @ off, true, atol=5e-3)


@pytest.mark.parametrize("off_m", [0.0, 1.0, 100.0])
def test_errorless_phases_give_the_baseline(off_m: float) -> None:
    b = np.array([-4827.0, 3081.0, -99.0])
    data = pair(b[None])
    phase = dd.difference(data.phase_m[0], ORDER) - LAM * dd.difference(SD_CYCLES[:7], ORDER)
    R = dd.covariance(1e-4 * data.variance_scale[0], ORDER)
    found, Q = dd.baseline_from_phase(
        phase, R, data.sat_reference[0], data.sat_rover[0], ORDER, STILL, b + off_m * np.ones(3) / 2
    )
    np.testing.assert_allclose(found, b, atol=1e-6)
    sat, vel = data.sat_rover[0], data.vel_rover[0]
    _, _, G = dd.predict(sat, sat, vel, vel, ORDER, STILL, STILL, b, STILL)
    np.testing.assert_allclose(Q, np.linalg.inv(G.T @ np.linalg.solve(R, G)), rtol=1e-6)


def test_baseline_covariance_is_that_of_samples() -> None:
    rng = np.random.default_rng(2)
    b = np.array([40.0, -70.0, -10.0])
    data = pair(b[None])
    R = dd.covariance(1e-4 * data.variance_scale[0], ORDER)
    exact = dd.difference(data.phase_m[0], ORDER) - LAM * dd.difference(SD_CYCLES[:7], ORDER)
    errors = []
    for noise in rng.multivariate_normal(np.zeros(6), R, 1500):
        found, Q = dd.baseline_from_phase(exact + noise, R, data.sat_reference[0], data.sat_rover[0], ORDER, STILL, b)
        errors.append(found - b)
    s = np.sqrt(np.diag(Q))
    np.testing.assert_allclose(np.cov(np.array(errors).T) / np.outer(s, s), Q / np.outer(s, s), atol=0.15)


# noise

rows = given(st.integers(0, 2**32 - 1), st.integers(3, 12))
MANY = settings(deadline=None, max_examples=60)


@rows
@MANY
def test_covariance_is_that_of_two_receivers_differenced(seed: int, n: int) -> None:
    rng = np.random.default_rng(seed)
    order = rng.permutation(n)[: rng.integers(2, n + 1)]
    variance = 10.0 ** rng.uniform(-4, 1, n)
    D = differencing(n, order)
    np.testing.assert_allclose(dd.covariance(variance, order), 2 * D @ np.diag(variance) @ D.T, rtol=1e-12)
    values = rng.normal(size=n)
    np.testing.assert_allclose(dd.difference(values, order), D @ values, atol=1e-14)


@rows
@MANY
def test_information_is_that_of_projected_clocks(seed: int, n: int) -> None:
    """The graph eliminates clocks by projection, the filters by a pivot: the same normal equations, for any pivot."""
    rng = np.random.default_rng(seed)
    order = rng.permutation(n)
    variance, J, y = 10.0 ** rng.uniform(-3, 1, n), rng.normal(size=(n, 3)), rng.normal(size=n)
    groups, u = CommonGroups.from_labels(np.zeros(n, np.int64)), 1 / np.sqrt(2 * variance)
    PJ, Py = groups.project(J, u), groups.project(y, u)
    D = differencing(n, order)
    W = np.linalg.inv(dd.covariance(variance, order))
    scale = np.abs(PJ.T @ PJ).max()
    np.testing.assert_allclose((D @ J).T @ W @ (D @ J), PJ.T @ PJ, atol=1e-9 * scale)
    np.testing.assert_allclose((D @ J).T @ W @ dd.difference(y, order), PJ.T @ Py, atol=1e-9 * scale)


# the table of shared observations

NAMES = ["G01", "G02", "G03", "G05", "G07", "G09"]


def problem_of(reference: GnssStream, rover: GnssStream, **changes: object) -> tuple[NavigationProblem, Receiver, Receiver]:
    noise = GnssNoise(elevation_mask_rad=0.1)
    vehicles = tuple(Vehicle(n, gnss=Antenna(s, noise=noise)) for n, s in (("a", reference), ("b", rover)))
    chosen = Settings(ionosphere_model="none", **changes)  # type: ignore[arg-type]
    problem = NavigationProblem("two", GpsTime(2300, 0.0), synthetic.FRAME, vehicles, (Link("a", "b"),), settings=chosen)
    ready = receivers(problem)
    return problem, ready["a"], ready["b"]


def test_the_table_holds_what_both_observe() -> None:
    t = np.arange(4.0)
    r_b = np.array([30.0, -20.0, 0.0])  # one height: nothing of the troposphere stays
    mine = [row for row in synthetic.every(4, NAMES, ["G1C"]) if row[:2] not in ((1, "G03"), (2, "G05"))]
    theirs = synthetic.every(4, [*NAMES[1:], "G11"], ["G1C"])
    a = synthetic.receiver(t, mine, clock_m=1.0, cycles={("G02", "G1C"): 5.0})
    b = synthetic.receiver(t, theirs, r_n=np.tile(r_b, (4, 1)), clock_m=-0.4, cycles={("G02", "G1C"): 12.0, ("G07", "G1C"): -4.0})
    problem, ra, rb = problem_of(a, b)
    data = dd.pair_epochs(ra, rb, problem.settings)
    assert data.satellites == tuple(NAMES[1:])
    expected = np.ones((4, 5), bool)
    expected[1, 1] = expected[2, 2] = False
    np.testing.assert_array_equal(data.usable, expected)
    np.testing.assert_array_equal(np.isfinite(data.code_m), expected)
    np.testing.assert_array_equal(data.arc < 0, ~expected)
    np.testing.assert_allclose(data.variance_scale[expected], 1 + 1 / np.sin(data.elevation_rad[expected]) ** 2)
    for k in range(4):
        order = data.order(k)
        assert data.elevation_rad[k, order[0]] == np.nanmax(data.elevation_rad[k])
        assert sorted(order) == np.flatnonzero(expected[k]).tolist()
        rho, rate, _ = dd.predict(
            data.sat_reference[k], data.sat_rover[k], data.vel_reference[k], data.vel_rover[k], order, STILL, STILL, r_b, STILL
        )  # fmt: skip
        N = dd.difference(np.array([7.0, 0.0, 0.0, -4.0, 0.0]), order)
        np.testing.assert_allclose(dd.difference(data.code_m[k], order), rho, atol=1e-3)
        np.testing.assert_allclose(dd.difference(data.phase_m[k], order), rho + data.wavelength_m * N, atol=1e-3)
        np.testing.assert_allclose(dd.difference(data.rate_mps[k], order), rate, atol=1e-3)


def test_pivots_are_the_highest_that_may_be() -> None:
    data = pair(np.zeros((1, 3)))
    assert data.order(0).tolist() == ORDER.tolist()
    assert data.order(0, avoid=np.array([0, 4])).tolist() == [2, 0, 1, 3, 4, 5, 6]
    assert data.order(0, avoid=np.arange(7))[0] == 0  # all are to be avoided: then none is
    some = replace(data, usable=np.arange(7)[None] > 2)
    assert some.order(0).tolist() == [4, 3, 5, 6]
    assert replace(data, usable=np.zeros((1, 7), bool)).order(0).tolist() == []


def test_rows_without_phase_or_doppler_are_not_used() -> None:
    t = np.arange(3.0)
    a = synthetic.receiver(t, synthetic.every(3, NAMES, ["G1C"]))
    phase, doppler = a.phase_cyc.copy(), a.doppler_hz.copy()
    phase[1], doppler[2] = np.nan, np.nan
    problem, ra, rb = problem_of(a, replace(a, phase_cyc=phase, doppler_hz=doppler))
    data = dd.pair_epochs(ra, rb, problem.settings)
    assert data.usable[0].tolist() == [True, False, False, True, True, True] and data.usable[1:].all()


def test_nothing_shared_is_one_line_of_advice() -> None:
    t = np.arange(3.0)
    a = synthetic.receiver(t, synthetic.every(3, NAMES, ["G1C"]))
    problem, ra, rb = problem_of(a, synthetic.receiver(t + 100.0, synthetic.every(3, NAMES, ["G1C"])))
    with pytest.raises(InputError, match="link a-b: nothing is observed by both") as told:
        dd.pair_epochs(ra, rb, problem.settings)
    assert "\n" not in str(told.value)


def test_several_signals_ask_for_a_choice() -> None:
    t = np.arange(3.0)
    a = synthetic.receiver(t, synthetic.every(3, NAMES, ["G1C", "G5Q"]))
    problem, ra, rb = problem_of(a, a)
    with pytest.raises(InputError, match=r"takes one signal, both share G1C/G1C, G5Q/G5Q; choose") as told:
        dd.pair_epochs(ra, rb, problem.settings)
    assert "\n" not in str(told.value)
    chosen, ra, rb = problem_of(a, a, bands="5")
    assert dd.pair_epochs(ra, rb, chosen.settings).wavelength_m == pytest.approx(synthetic.wavelength("G5Q"))
