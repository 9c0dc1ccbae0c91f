"""One receiver clock for several constellations: which rows share it, which integers stay arbitrary, biases found."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from factorgraph.assembly.blocks import CODE, DOPPLER, PHASE
from factorgraph.assembly.integers import datum_arcs
from factorgraph.assembly.intersystem import biases, shared_clocks
from factorgraph.assembly.parameters import Parameters
from factorgraph.problem import NavigationProblem
from factorgraph.registry import solve
from factorgraph.solution import Fix
from scenarios.simulate import SimulatedFlight, load_scenario, simulate
from scenarios.studies import replace_duration
from tests.factorgraph.test_blocks import CARRIED, GNSS_STEP, assert_jacobians, evaluated, link_of, problem_of

NAMES = ("C2I/C2I", "E1C/E1C", "E5Q/E5Q", "G1C/G1C", "G5Q/G5Q", "R1C/R1C")
WAVELENGTH = np.array([0.19203949, 0.19029367, 0.25482805, 0.19029367, 0.25482805, 0.1871])
CODE_M, PHASE_M = 7.3, 3.456


def test_signals_of_one_frequency_share_their_clock() -> None:
    group = np.tile(np.arange(6), 3)
    kind = np.repeat([CODE, PHASE, DOPPLER], 6)
    clock = shared_clocks(kind, group, NAMES, WAVELENGTH[group])
    np.testing.assert_array_equal(clock[:6], [0, 1, 2, 1, 2, 5])
    np.testing.assert_array_equal(clock[6:12], clock[:6])
    assert not np.any(clock[12:])
    parameters = Parameters()
    found, of_row = biases(kind, group, clock, NAMES, "a-b", parameters)
    pairs = ("G1C/G1C - E1C/E1C", "G5Q/G5Q - E5Q/E5Q")
    assert [p.name for p in found] == [f"a-b {k} {pair}" for k in ("code", "phase") for pair in pairs]
    np.testing.assert_array_equal(np.flatnonzero(of_row >= 0), [3, 4, 9, 10])


def test_datums_are_as_many_as_clocks_and_biases_can_take_up() -> None:
    """Against the rank of what clocks (one per component) and biases (one per group but one) do to the integers."""
    rng = np.random.default_rng(2)
    for _ in range(20):
        component, group = rng.integers(0, 3, 12), rng.integers(0, 3, 12)
        shifts = np.column_stack([component[:, None] == np.arange(3), group[:, None] == np.arange(3)]).astype(float)
        chosen = datum_arcs(component, group, rng.permutation(12))
        assert len(chosen) == np.linalg.matrix_rank(shifts) == np.linalg.matrix_rank(shifts[chosen])
    # clocks of their own: one datum for each connected set, the first in the order
    assert datum_arcs(np.array([0, 0, 2, 2]), np.array([0, 0, 0, 0]), np.array([1, 3, 0, 2])) == [1, 3]


def test_jacobians_of_biases() -> None:
    problem, ends = problem_of(("imu", "imu"), 0.4)
    data = link_of(replace(problem, settings=replace(problem.settings, inter_system="constant")), ends)
    assert [b.name.split()[1] for b in data.block.biases] == ["code", "phase"]
    parameters = Parameters({b.name: b for b in data.block.biases})
    assert_jacobians(evaluated(ends, [data.block], parameters), data.block, GNSS_STEP | {"c": (1.0,)}, CARRIED)


@cache
def flight() -> SimulatedFlight:
    return simulate(replace_duration(load_scenario("two-uav"), 40.0), 41)


def biased(problem: NavigationProblem, constant: bool) -> NavigationProblem:
    """The follower's receiver delays Galileo."""
    leader, follower = problem.vehicles
    assert follower.gnss is not None
    s = follower.gnss.stream
    galileo = np.array([name[0] == "E" for name in s.satellites])[s.sat]
    s = replace(s, code_m=s.code_m + CODE_M * galileo, phase_cyc=s.phase_cyc + PHASE_M * galileo / s.wavelength_m)
    settings = replace(problem.settings, inter_system="constant" if constant else "free")
    return replace(problem, vehicles=(leader, replace(follower, gnss=replace(follower.gnss, stream=s))), settings=settings)


def test_biases_between_constellations_are_found() -> None:
    """The phase's but for whole cycles, which its datum holds. No worse a baseline than with clocks of their own."""
    free, constant = (solve(biased(flight().problem, c)) for c in (False, True))
    found = {p.name: p for p in constant.diagnostics.parameters}
    code = found["leader-follower code G1C/G1C - E1C/E1C"]
    phase = found["leader-follower phase G1C/G1C - E1C/E1C"]
    assert abs(code.value + CODE_M) < 4 * code.sigma and code.sigma < 0.1
    cycles = (phase.value + PHASE_M) / 0.190293672798
    assert cycles == pytest.approx(np.round(cycles), abs=0.02) and phase.sigma < 0.002
    a, b = free.pairs[0], constant.pairs[0]
    assert np.all(b.fix == Fix.FIXED.value)
    np.testing.assert_allclose(b.baseline_enu, a.baseline_enu, atol=6e-3)
    sigma = [np.sqrt(np.trace(p.P[:, :3, :3], axis1=1, axis2=2)).mean() for p in (a, b)]
    assert sigma[1] < sigma[0]
    assert constant.ambiguities.state.count("datum") == free.ambiguities.state.count("datum")
    assert 0.85 < constant.diagnostics.nis.sum() / constant.diagnostics.nis_dof.sum() < 1.05
