"""Slowly changing delays of links: Jacobians, processes, when they are there, and what a simulated atmosphere leaves."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from factorgraph.assembly import wide_lanes
from factorgraph.assembly.atmosphere import NodeBlock, add_ionosphere, add_wet_delay, wet_sigma_m
from factorgraph.assembly.blocks import CODE, DOPPLER, PHASE, GnssBlock
from factorgraph.assembly.build import link_block
from factorgraph.assembly.integers import start_ambiguities
from factorgraph.assembly.nodes import Nodes, Process
from factorgraph.assembly.parameters import Parameters
from factorgraph.assembly.variables import VehicleVariables
from factorgraph.grid import common_grid
from factorgraph.models.receivers import receivers
from factorgraph.problem import Settings
from factorgraph.registry import solve
from factorgraph.sampling import interpolate
from factorgraph.solution import Fix, Solution, Status
from factorgraph.types import Array
from scenarios.simulate import SimulatedFlight, load_scenario, simulate
from scenarios.studies import replace_duration
from tests.factorgraph.test_blocks import CARRIED, GNSS_STEP, SATELLITES, assert_jacobians, evaluated, link_of, problem_of
from tests.helpers import assert_consistent

FAST = Settings(ionosphere_step_s=2.0, troposphere_step_s=2.0)


def of_long_link(modes: tuple[str, str] = ("imu", "imu"), settings: Settings = FAST) -> tuple[GnssBlock, NodeBlock, NodeBlock]:
    problem, ends = problem_of(modes, 0.4)
    block = link_of(problem, ends).block
    ionosphere, wet = add_ionosphere(settings, block, 0, 20_000.0), add_wet_delay(settings, block, 0, 0.02, 0.8)
    assert ionosphere is not None and wet is not None
    return block, ionosphere, wet


def test_jacobians_of_delays_and_their_processes() -> None:
    problem, ends = problem_of(("imu", "imu"), 0.4)
    block = link_of(problem, ends).block
    priors = [add_ionosphere(FAST, block, 0, 20_000.0), add_wet_delay(FAST, block, 0, 0.02, 0.8)]
    rng = np.random.default_rng(0)
    for nodes in block.nodes:
        nodes.value = rng.normal(0, 0.02, len(nodes.value))
    known = [prior for prior in priors if prior is not None]
    assert len(known) == 2
    graph = evaluated(ends, [block, *known])
    assert_jacobians(graph, block, GNSS_STEP, CARRIED)
    for prior in known:
        assert_jacobians(graph, prior, GNSS_STEP)
        assert {len(prior.columns(f)[0]) for f in range(prior.n)} == {1, 2}


def test_code_and_phase_bend_opposite_ways_and_wet_delays_alike() -> None:
    block, ionosphere, wet = of_long_link()
    rows = block.rows
    ionosphere.of.value[:] = 1.0
    wet.of.value[:] = 1.0
    bent, slowed = ionosphere.of.seen(block.n), wet.of.seen(block.n)
    assert not np.any(bent[rows.kind == DOPPLER]) and not np.any(slowed[rows.kind == DOPPLER])
    assert np.all(bent[rows.kind == CODE] >= 1.0) and np.all(slowed[np.isin(rows.kind, (CODE, PHASE))] >= 1.0)
    for satellite in range(len(SATELLITES)):
        of_first = (rows.label_index == satellite) & (rows.factor.of_row == 0)
        code, phase = (of_first & (rows.kind == kind) for kind in (CODE, PHASE))
        np.testing.assert_allclose(bent[code], -bent[phase])
        np.testing.assert_allclose(slowed[code], slowed[phase])
        wavelengths = block.wavelength_m[code]
        np.testing.assert_allclose(bent[code] / wavelengths**2, bent[code][0] / wavelengths[0] ** 2)


def test_a_process_keeps_its_spread_and_its_steps() -> None:
    """Both kinds of process against their own covariance, written out from the rows."""
    t = np.array([0.0, 10.0, 40.0, 45.0])
    for process, P in (
        (Process(0.3, 25.0), 0.09 * np.exp(-np.abs(t[:, None] - t) / 25.0)),
        (Process(0.3, walk=0.05), 0.09 + 0.0025 * np.minimum(t[:, None], t)),
    ):
        decay, sigma = process.step(np.diff(t))
        L = np.eye(4)
        for i in range(3):
            L[i + 1, i] = -decay[i]
        W = L / np.concatenate([[0.3], sigma])[:, None]
        np.testing.assert_allclose(np.linalg.inv(W.T @ W), P, rtol=1e-9)


def test_series_are_linear_between_nodes_and_independent() -> None:
    t = np.array([3.0, 4.0, 7.5, 3.0, 12.9])
    series = np.array([0, 0, 0, 1, 1])
    nodes = Nodes.of("bias", 0, np.arange(5), series, t, np.full(5, 2.0), 5.0)
    nodes.value = 10.0 * nodes.series + nodes.t_s
    np.testing.assert_allclose(nodes.seen(5), 2.0 * (10.0 * series + t))
    np.testing.assert_array_equal(np.flatnonzero(nodes.previous < 0), np.flatnonzero(np.diff(nodes.series, prepend=-1)))
    assert len(nodes.key) == len(set(nodes.key.tolist())) == 2 + 3


@pytest.mark.parametrize(
    ("baseline_m", "height_m", "expected_m"), [(5_000.0, 50.0, 0.0), (20_000.0, 0.0, 0.02), (1_000.0, 1_000.0, 0.02502)]
)
def test_delays_are_there_where_a_link_is_long_or_high(baseline_m: float, height_m: float, expected_m: float) -> None:
    assert wet_sigma_m(Settings(), baseline_m, height_m) == pytest.approx(expected_m, abs=1e-4)


def test_short_links_have_no_ionosphere() -> None:
    problem, ends = problem_of(("imu", "imu"))
    block = link_of(problem, ends).block
    assert add_ionosphere(Settings(), block, 0, 5_000.0) is None
    assert add_ionosphere(replace(Settings(), ionosphere_ppm=0.0), block, 0, 50_000.0) is None
    assert add_wet_delay(Settings(), block, 0, 0.0, 0.8) is None and not block.nodes


# -- simulated flights -------------------------------------------------------------------------------------------------


@cache
def long_flight(seed: int, duration_s: float, km: float = 20.0) -> SimulatedFlight:
    scenario = replace_duration(load_scenario("long-baseline"), duration_s)
    base, *others = scenario.vehicle
    place = (-0.6e3 * km, -0.8e3 * km, -0.0785 * km**2)  # falls with the Earth
    base = base.model_copy(update={"trajectory": base.trajectory.model_copy(update={"r_n": place})})
    return simulate(scenario.model_copy(update={"vehicle": (base, *others)}), seed)


def pair_errors(solution: Solution) -> tuple[Array, Array]:
    pair = solution.pair("base", "uav")
    assert pair.truth_enu is not None
    return pair.baseline_enu - pair.truth_enu, pair.P[:, :3, :3]


def assert_fixed_arcs_are_true(flight: SimulatedFlight, solution: Solution) -> int:
    """Integers against the record's, relative to each signal's datum; returns the number of arcs."""
    table, off = solution.ambiguities, {}  # type: ignore[var-annotated]
    for i in np.flatnonzero(np.isin(table.state, ("fixed", "datum"))):
        true = 0
        for name, sign in (("base", -1), ("uav", 1)):
            antenna = flight.problem.vehicle(name).gnss
            assert antenna is not None
            s = antenna.stream
            mine = s.sat == s.satellites.index(table.satellite[i])
            mine &= (s.signal == s.signals.index(table.signal[i][:3])) & (s.t_s[s.epoch] >= table.t_start_s[i] - 0.1)
            true += sign * int(flight.record.gnss[name].integer[np.flatnonzero(mine)[0]])
        off.setdefault(table.signal[i], []).append(table.integer[i] - true)
    assert off and all(len(set(values)) == 1 for values in off.values())
    return int(np.sum([len(values) for values in off.values()]))


def test_twenty_kilometres_are_fixed_and_consistent() -> None:
    """Differential delays of centimetres per satellite, which leave no trace in the baseline."""
    errors, covariances = [], []
    for seed in (51, 52):
        flight = long_flight(seed, 90.0)
        solution = solve(flight.problem)
        pair = solution.pair("base", "uav")
        assert np.mean(pair.fix == Fix.FIXED.value) >= 0.95 and assert_fixed_arcs_are_true(flight, solution) > 30
        error, P = pair_errors(solution)
        assert np.abs(error).max() < 0.05
        assert 0.9 < solution.diagnostics.nis.sum() / solution.diagnostics.nis_dof.sum() < 1.05
        errors.append(error[45])
        covariances.append(P[45])
    assert_consistent(np.array(errors), np.array(covariances))


def test_without_these_delays_the_same_flight_goes_wrong() -> None:
    problem = long_flight(51, 90.0).problem
    plain = replace(problem.settings, ionosphere_ppm=0.0, troposphere_min_baseline_m=1e9)
    error, P = pair_errors(solve(replace(problem, settings=plain)))
    nees = np.einsum("ni,nij,nj->n", error, np.linalg.inv(P), error)
    assert np.mean(nees) > 12


def test_wide_lanes_help_long_baselines_over_short_times() -> None:
    """50 km, one minute: more arcs are fixed with them than without, none wrong."""
    flight = long_flight(201, 60.0, km=50.0)
    fixed = []
    for first in (False, True):
        ambiguity = replace(flight.problem.settings.ambiguity, wide_lanes=first)
        solution = solve(replace(flight.problem, settings=replace(flight.problem.settings, ambiguity=ambiguity)))
        assert_fixed_arcs_are_true(flight, solution)
        fixed.append(solution.ambiguities.state.count("fixed"))
    assert fixed[1] > 1.3 * fixed[0]


def test_codes_and_phases_contradict_a_wrong_wide_lane() -> None:
    flight = long_flight(51, 90.0)
    problem = flight.problem
    rx = receivers(problem)
    grid = common_grid(problem)
    ends = {v.name: VehicleVariables(i, v, grid, problem.frame) for i, v in enumerate(problem.vehicles)}
    data = link_block(problem, problem.links[0], ends, rx, 0, True, Parameters())
    start_ambiguities(data)
    phase = np.flatnonzero(data.block.arc >= 0)
    true = np.zeros(len(data.block.amb_key))
    base, uav = (flight.record.gnss[name].integer for name in ("base", "uav"))
    true[data.block.arc[phase]] = uav[data.row_rover[phase]] - base[data.row_reference[phase]]
    pairs = wide_lanes.open_pairs(data, set())
    pairs = pairs[np.bincount(data.block.arc[phase])[pairs].min(axis=1) > 60]
    assert len(pairs) >= 8
    value = true[pairs[:, 0]] - true[pairs[:, 1]]
    assert not np.any(wide_lanes.contradicted(data.block, pairs, value))
    for off in (1.0, -2.0):
        found = wide_lanes.contradicted(data.block, pairs, value + np.where(np.arange(len(pairs)) == 3, off, 0.0))
        assert found[3] and found.sum() == 1


def test_ionosphere_free_codes_leave_a_wrong_model_behind() -> None:
    """Without noise, the ionosphere three times what is broadcast: single codes are metres off in height, combined ones not."""
    scenario = replace_duration(load_scenario("long-baseline"), 30.0)
    environment = scenario.environment.model_copy(update={"ionosphere": 3.0})
    info = scenario.scenario.model_copy(update={"noise_scale": 0.0})
    problem = simulate(scenario.model_copy(update={"environment": environment, "scenario": info, "link": ()}), 7).problem
    problem = replace(problem, links=(), vehicles=problem.vehicles[1:])
    up = []
    for kind in ("single", "ionosphere-free"):
        solution = solve(replace(problem, settings=replace(problem.settings, absolute_code=kind)))
        vehicle = solution.vehicle("uav")
        truth = interpolate(vehicle.t_s, vehicle.truth.t_s, vehicle.truth.r_n)  # type: ignore[union-attr]
        up.append(float(np.mean(np.abs(vehicle.r_n[:, 2] - truth[:, 2]))))
    assert up[0] > 3.0 and up[1] < 0.2


def test_a_single_receiver_may_estimate_its_wet_delay() -> None:
    problem = replace(long_flight(51, 90.0).problem, links=())
    problem = replace(problem, vehicles=problem.vehicles[1:], settings=replace(problem.settings, troposphere_absolute_m=0.1))
    solution = solve(problem)
    assert solution.diagnostics.status is Status.CONVERGED and np.all(np.isfinite(solution.vehicle("uav").P))
