"""Slips against a prediction: found one by one, sized, repaired or made the end of an arc; never left inside."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest

from factorgraph.geodesy import C_MPS
from factorgraph.measurements import GnssStream
from factorgraph.models.clock_jumps import MS_M, clock_jumps, phase_lags, with_phases_following
from factorgraph.models.slips import Phases, Repaired, Steps, find_steps, repair, whole_cycles
from factorgraph.problem import AmbiguitySettings, NavigationProblem
from factorgraph.registry import solve
from factorgraph.solution import Fix, Solution
from factorgraph.types import Array, IntArray
from scenarios.flights import load
from scenarios.simulate import SimulatedFlight, load_scenario, simulate
from scenarios.simulate.gnss import ClockTable, GnssTable
from scenarios.studies import replace_duration
from scenarios.studies.slip_truth import judge
from tests.factorgraph.synthetic import every, receiver
from tests.helpers import shared_data

LAM = 0.19
SIGMA_M = 0.004
LEAST = 0.9999


def sky(n_sats: int, rng: np.random.Generator) -> Array:
    """Unit vectors (n_sats, 3) above 15 degrees."""
    azimuth, up = rng.uniform(0, 2 * np.pi, n_sats), rng.uniform(np.sin(np.deg2rad(15.0)), 1.0, n_sats)
    return np.column_stack([np.sqrt(1 - up**2) * np.cos(azimuth), np.sqrt(1 - up**2) * np.sin(azimuth), up])


def phases_of(
    rng: np.random.Generator,
    n_sats: int = 12,
    m: int = 120,
    predicted_m: float = 0.02,
    slips: dict[tuple[int, int], float] | None = None,
) -> Phases:
    """Phases of every satellite at every epoch of a second, predicted with an error that walks by `predicted_m` per epoch.

    slips: (epoch, satellite) -> cycles. The clocks drift by metres.
    """
    e = sky(n_sats, rng)
    d = np.cumsum(rng.normal(0.0, predicted_m, (m, 3)), axis=0)
    y = -d @ e.T + 300.0 * np.arange(m)[:, None] + np.cumsum(rng.normal(0.0, 5.0, m))[:, None]
    y = y + rng.normal(0.0, SIGMA_M, y.shape) + LAM * rng.integers(-100, 100, n_sats)
    for (k, i), cycles in (slips or {}).items():
        y[k:, i] += LAM * cycles
    epoch, sat = np.divmod(np.arange(m * n_sats), n_sats)
    return Phases(
        epoch=epoch,
        t_s=epoch.astype(float),
        series=sat,
        arc=sat.copy(),
        residual_m=y.ravel(),
        jump_cyc=np.zeros(m * n_sats),
        gradient=-e[sat],
        sigma_m=np.full(m * n_sats, SIGMA_M),
        wavelength_m=np.full(m * n_sats, LAM),
        half=np.zeros(m * n_sats, bool),
    )


def part(p: Phases, keep: Array) -> Phases:
    """Some of the rows."""
    return Phases(*(getattr(p, name)[keep] for name in Phases.__dataclass_fields__))


def found(p: Phases, steps: Steps) -> set[tuple[int, int]]:
    """Epoch and satellite of what is called a slip."""
    return {(int(p.epoch[r]), int(p.series[r])) for r in steps.after[steps.slipped]}


def mended(p: Phases, result: Repaired) -> dict[tuple[int, int], float]:
    """Epoch and satellite -> cycles of the repaired slips."""
    return {(int(p.epoch[r]), int(p.series[r])): float(c) for r, c in zip(result.joined, result.cycles, strict=True)}


@pytest.mark.parametrize("predicted_m", [0.002, 0.02, 0.5])
def test_no_slips_where_there_are_none(predicted_m: float) -> None:
    """Whatever the prediction is worth."""
    for seed in range(5):
        p = phases_of(np.random.default_rng(seed), predicted_m=predicted_m)
        steps = find_steps(p)
        assert not found(p, steps) and not np.any(steps.cut)
        np.testing.assert_array_equal(repair(p, steps, LEAST, 10.0).arc, p.arc)


@pytest.mark.parametrize("predicted_m", [0.002, 0.02, 0.5])
def test_single_cycles_are_found_at_once_and_taken_off(predicted_m: float) -> None:
    for seed in range(5):
        rng = np.random.default_rng(seed)
        slips = {(k, int(rng.integers(0, 12))): float(rng.choice([-1, 1])) for k in range(5, 115, 10)}
        p = phases_of(rng, predicted_m=predicted_m, slips=slips)
        steps = find_steps(p)
        assert found(p, steps) == set(slips)
        assert mended(p, repair(p, steps, LEAST, 10.0)) == slips


def test_several_satellites_at_once() -> None:
    """Up to four of twelve, of any size: all are found, none is taken for another; next to all can be repaired."""
    n, n_mended = 0, 0
    for seed in range(20):
        rng = np.random.default_rng(seed)
        slips = {
            (k, int(i)): float(rng.integers(1, 30) * rng.choice([-1, 1]))
            for k in range(10, 110, 20)
            for i in rng.choice(12, rng.integers(2, 5), replace=False)
        }
        p = phases_of(rng, slips=slips)
        steps = find_steps(p)
        taken = mended(p, repair(p, steps, LEAST, 10.0))
        assert found(p, steps) == set(slips) and taken.items() <= slips.items()
        n, n_mended = n + len(slips), n_mended + len(taken)
    assert n_mended > 0.9 * n


def test_where_most_satellites_slip_all_arcs_end() -> None:
    """Nobody can tell which are right."""
    rng = np.random.default_rng(7)
    p = phases_of(rng, slips={(50, i): float(3 * i + 1) for i in range(8)})
    result = repair(p, find_steps(p), LEAST, 10.0)
    before, after = result.arc[p.epoch == 49], result.arc[p.epoch == 50]
    assert not set(before.tolist()) & set(after.tolist()) and not len(result.joined)


def test_without_repair_arcs_end_at_slips() -> None:
    p = phases_of(np.random.default_rng(3), slips={(40, 2): 5.0, (80, 7): -1.0})
    result = repair(p, find_steps(p), 1.0, 10.0)
    assert not len(result.joined) and len(np.unique(result.arc)) == 14
    assert np.all(result.jump_cyc == 0)
    ends = {(int(k), int(i)) for i in range(12) for k in 1 + np.flatnonzero(np.diff(result.arc[p.series == i]))}
    assert ends == {(40, 2), (80, 7)}


def test_an_end_without_a_slip_is_joined() -> None:
    """A loss of lock that was none."""
    p = phases_of(np.random.default_rng(4))
    arc = np.where((p.series == 3) & (p.epoch >= 60), 99, p.arc)
    p = replace(p, arc=arc)
    result = repair(p, find_steps(p), LEAST, 10.0)
    assert mended(p, result) == {(60, 3): 0.0} and len(np.unique(result.arc)) == 12


@pytest.mark.parametrize(("gap", "goes_on"), [(2, True), (4, True), (14, False)])
def test_gaps_are_bridged_by_the_other_satellites(gap: int, goes_on: bool) -> None:
    p = phases_of(np.random.default_rng(5), slips={(50 + gap, 3): -7.0})
    p = part(p, ~((p.series == 3) & (p.epoch >= 50) & (p.epoch < 50 + gap)))
    p = replace(p, arc=np.where((p.series == 3) & (p.epoch >= 50), 99, p.arc))
    assert mended(p, repair(p, find_steps(p), LEAST, 10.0)) == ({(50 + gap, 3): -7.0} if goes_on else {})


def test_over_an_outage_of_all_nothing_is_known() -> None:
    p = phases_of(np.random.default_rng(6))
    p = replace(p, arc=np.where(p.epoch >= 50, 100 + p.series, p.arc))
    steps = find_steps(p)
    assert np.all(np.isnan(steps.cycles[steps.cut])) and not len(repair(p, steps, LEAST, 10.0).joined)


@pytest.mark.parametrize(("predicted_m", "hidden_share"), [(0.03, 0.05), (0.003, 0.0)])
def test_repairs_are_right_where_the_geometry_is_weak(predicted_m: float, hidden_share: float) -> None:
    """Six satellites, where one slip may look like another's: all arcs that might have one end.

    A prediction of centimetres may also be bent until nothing is seen of a slip; one of millimetres may not.
    """
    right, wrong, hidden = 0, 0, 0
    for seed in range(40):
        rng = np.random.default_rng(100 + seed)
        slips = {(k, int(rng.integers(0, 6))): float(rng.choice([-2, -1, 1, 2])) for k in range(10, 110, 10)}
        p = phases_of(rng, n_sats=6, predicted_m=predicted_m, slips=slips)
        result = repair(p, find_steps(p), LEAST, 10.0)
        taken = mended(p, result)
        right += sum(taken.get(key) == cycles for key, cycles in slips.items())
        wrong += sum(slips.get(key, 0.0) != cycles for key, cycles in taken.items())
        for k, i in slips.keys() - taken.keys():
            before, after = (result.arc[(p.epoch == at) & (p.series == i)][0] for at in (k - 1, k))
            hidden += bool(before == after)
    assert wrong == 0 and right > 150 and hidden <= hidden_share * 400


def test_slip_sizes_scatter_as_their_sigma_says() -> None:
    normalised = []
    for seed in range(30):
        rng = np.random.default_rng(seed)
        slips = {(k, int(rng.integers(0, 12))): 3.0 for k in range(10, 110, 10)}
        p = phases_of(rng, slips=slips)
        steps = find_steps(p)
        normalised += [(steps.cycles[i] - 3.0) / steps.sigma_cyc[i] for i in np.flatnonzero(steps.slipped)]
    assert len(normalised) == 300
    assert 0.85 < np.std(normalised) < 1.15 and abs(np.mean(normalised)) < 0.25


def test_half_cycles_end_arcs_or_are_taken_off() -> None:
    """Unannounced, they end an arc; announced, they are taken off."""
    p = phases_of(np.random.default_rng(8), slips={(60, 4): 0.5, (90, 5): 2.0})
    result = repair(p, find_steps(p), LEAST, 10.0)
    assert mended(p, result) == {(90, 5): 2.0}
    assert len(np.unique(result.arc[p.series == 4])) == 2
    p = replace(p, half=(p.series == 4) & (p.epoch < 60))
    result = repair(p, find_steps(p), LEAST, 10.0)
    assert mended(p, result) == {(60, 4): 0.5, (90, 5): 2.0}
    jump, half = whole_cycles(result.arc, result.jump_cyc, p.half, np.zeros(len(p.arc), bool))
    assert not np.any(half)
    np.testing.assert_array_equal(jump[p.series == 4], np.where(np.arange(120) >= 60, 0.0, -0.5))


def test_flagged_phases_count_from_unflagged_ones() -> None:
    """Half a cycle off while the flag stands: once joined, the arc is whole where it is not flagged."""
    arc, jump = np.zeros(6, np.int64), np.array([0.0, 0.0, -0.5, -0.5, 1.5, 1.5])
    flagged = np.array([True, True, False, False, False, False])
    counted, half = whole_cycles(arc, jump, flagged, np.zeros(6, bool))
    np.testing.assert_array_equal(counted, [0.5, 0.5, 0.0, 0.0, 2.0, 2.0])
    assert not half[0]
    assert whole_cycles(arc, jump, np.ones(6, bool), np.zeros(6, bool))[1][0]
    assert whole_cycles(arc, np.array([0.0, 0.0, -0.5, -0.5, -1.0, -1.0]), flagged, np.zeros(6, bool))[1][0]


# -- jumps of receiver clocks ----------------------------------------------------------------------


def jumping(follow: bool, ms: tuple[int, ...] = (1, -2)) -> tuple[GnssStream, GnssStream]:
    """A receiver without and with jumps at epochs 10, 20, ..."""
    names = ("G01", "G02", "G03", "G04", "G05")
    stream = receiver(np.arange(40.0), every(40, names, ("G1C", "G2W")), clock_m=50.0)
    offset = sum((np.where(stream.epoch >= 10 * (i + 1), n * MS_M, 0.0) for i, n in enumerate(ms)), np.zeros(stream.n_rows))
    phase = stream.phase_cyc + (offset / stream.wavelength_m if follow else 0.0)
    return stream, replace(stream, code_m=stream.code_m + offset, phase_cyc=phase)


def test_phases_are_made_to_follow_codes() -> None:
    _, lagging = jumping(follow=False)
    _, whole = jumping(follow=True)
    stream, lags = with_phases_following(lagging)
    assert {int(k): int(lags[k]) for k in np.flatnonzero(lags)} == {10: 1, 20: -2}
    np.testing.assert_allclose(stream.phase_cyc, whole.phase_cyc, atol=1e-6)
    assert not np.any(phase_lags(whole)) and with_phases_following(whole)[0] is whole


def test_noise_and_slips_are_no_jumps() -> None:
    clean, _ = jumping(follow=True)
    rng = np.random.default_rng(2)
    noisy = replace(clean, code_m=clean.code_m + rng.normal(0.0, 10.0, clean.n_rows))
    assert not np.any(phase_lags(noisy))
    one = (clean.sat == 0) & (clean.epoch >= 15)  # a millisecond of one satellite is a slip
    assert not np.any(phase_lags(replace(clean, phase_cyc=clean.phase_cyc + np.where(one, MS_M / clean.wavelength_m, 0.0))))


def test_jumps_of_clock_offsets_are_counted_whatever_the_drift() -> None:
    t = np.arange(100.0)
    clock = 2e-6 * t + np.where(t >= 30, 1e-3, 0.0) - np.where(t >= 70, 3e-3, 0.0)
    clock[50:53] = np.nan
    lags = np.zeros(100, np.int64)
    lags[70] = -3
    jumps = clock_jumps(t, clock, lags)
    assert jumps.t_s.tolist() == [30.0, 70.0] and jumps.ms.tolist() == [1, -3]
    assert jumps.phases_followed.tolist() == [True, False]
    assert str(jumps) == "2 jumps of the clock: +1 ms at 30.0 s, -3 ms at 70.0 s; phases made to follow 1 of them"


# -- whole flights ---------------------------------------------------------------------------------


def flight_with(seed: int, duration_s: float = 90.0, **gnss: object) -> SimulatedFlight:
    """Two UAVs with other GNSS tables."""
    scenario = replace_duration(load_scenario("two-uav"), duration_s)
    tables = {v.name: GnssTable(**{**v.gnss.model_dump(), **gnss}) for v in scenario.vehicle if v.gnss is not None}
    vehicles = tuple(v.model_copy(update={"gnss": tables[v.name]}) for v in scenario.vehicle)
    return simulate(scenario.model_copy(update={"vehicle": vehicles}), seed)


def rmse(solution: Solution) -> float:
    pair = solution.pairs[0]
    assert pair.truth_enu is not None
    return float(np.sqrt(np.mean(np.sum((pair.baseline_enu - pair.truth_enu) ** 2, axis=1))))


def assert_fixed_and_close(solution: Solution, clean_m: float) -> None:
    assert np.all(solution.pairs[0].fix == Fix.FIXED.value)
    assert rmse(solution) < 1.15 * clean_m


@pytest.mark.parametrize("repaired", [True, False])
def test_no_slip_stays_inside_an_arc(repaired: bool) -> None:
    """Sixty unannounced slips of one to four cycles per satellite and hour, on both receivers."""
    clean = rmse(solve(flight_with(31).problem))
    total: Counter[str] = Counter()
    for seed in (31, 32):
        flight = flight_with(seed, slips_per_hour=60.0, slip_cycles=4, lli_probability=0.0)
        solution = solve(with_ambiguity(flight.problem, slip_repair=repaired))
        total += judge(flight, solution)
        if seed == 31:
            assert_fixed_and_close(solution, clean)
    assert not {"missed", "wrongly repaired", "invented"} & set(total)
    assert total["repaired"] + total["ended"] > 40
    assert total["repaired"] > 0.6 * total.total() if repaired else not total["repaired"]


def with_ambiguity(problem: NavigationProblem, **changes: object) -> NavigationProblem:
    ambiguity = AmbiguitySettings(**{"slip_repair": True, **changes})  # type: ignore[arg-type]
    return replace(problem, settings=replace(problem.settings, ambiguity=ambiguity))


def test_half_cycles_announced_or_not() -> None:
    """Phases half a cycle off for 8 s after lock, and slips by half cycles that nobody announces."""
    clean = rmse(solve(flight_with(33).problem))
    announced = {"half_cycle_s": 8.0, "lli_probability": 1.0, "slips_per_hour": 60.0}
    unannounced = {"slip_half_probability": 0.5, "lli_probability": 0.0, "slips_per_hour": 20.0}
    for gnss in (announced, unannounced):
        flight = flight_with(33, slip_cycles=3, **gnss)
        solution = solve(flight.problem)
        assert not {"missed", "wrongly repaired", "invented"} & set(judge(flight, solution))
        assert_fixed_and_close(solution, clean)


@pytest.mark.parametrize("follow", [True, False])
def test_clock_jumps_break_no_arc(follow: bool) -> None:
    """Clocks that drift by 50 us/s and are set back at half a millisecond, with the phases or without."""
    plain = solve(flight_with(34, 60.0).problem)
    clock = ClockTable(limit_s=5e-4, drift=5e-5, offset_s=4e-4, phase_follows=follow)
    flight = flight_with(34, 60.0, clock=clock)
    solution = solve(flight.problem)
    jumps = [int(np.sum(np.abs(np.diff(r.clock_s)) > 5e-4)) for r in flight.record.gnss.values()]
    assert sum(jumps) >= 4
    notes = " ".join(solution.diagnostics.notes)
    for name, n in zip(flight.record.gnss, jumps, strict=True):
        assert n == 0 or f"{name}: {n} jump" in notes
    assert ("phases made to follow" in notes) is not follow
    assert len(solution.ambiguities.state) == len(plain.ambiguities.state) and not len(solution.slips.t_s)
    assert_fixed_and_close(solution, rmse(plain))


def as_glonass(stream: GnssStream, delay_m: float) -> GnssStream:
    """Galileo's satellites on carriers of their own, with a delay that grows with the channel."""
    channel = np.array([int(name[1:]) % 13 - 7 for name in stream.satellites])[stream.sat]
    mine = np.array([name[0] == "E" for name in stream.satellites])[stream.sat]
    lam = np.where(mine, C_MPS / (1602e6 + 562_500.0 * channel), stream.wavelength_m)
    return replace(
        stream,
        satellites=tuple(name.replace("E", "R") for name in stream.satellites),
        signals=tuple(name.replace("E", "R") for name in stream.signals),
        wavelength_m=lam,
        phase_cyc=(stream.phase_cyc * stream.wavelength_m + np.where(mine, delay_m * channel, 0.0)) / lam,
        doppler_hz=stream.doppler_hz * stream.wavelength_m / lam,
    )


def test_glonass_phases_help_without_integers() -> None:
    """Delays of 5 cm per channel between the two receivers are absorbed; no GLONASS arc is called an integer."""
    alone, both, nees = [], [], []
    for seed in range(35, 38):
        problem = flight_with(seed, 60.0, slips_per_hour=20.0, slip_cycles=3, lli_probability=0.0).problem
        vehicles = tuple(
            replace(v, gnss=replace(v.gnss, stream=as_glonass(v.gnss.stream, 0.05 * i)))  # type: ignore[type-var, union-attr]
            for i, v in enumerate(problem.vehicles)
        )
        problem = replace(problem, vehicles=vehicles)
        gps = solve(replace(problem, settings=replace(problem.settings, systems="G")))
        mixed = solve(replace(problem, settings=replace(problem.settings, systems="GR")))
        arcs = mixed.ambiguities
        states = {state for name, state in zip(arcs.satellite, arcs.state, strict=True) if name[0] == "R"}
        assert states <= {"float", "datum"} and "float" in states
        alone.append(rmse(gps))
        both.append(rmse(mixed))
        pair = mixed.pairs[0]
        assert pair.truth_enu is not None
        error = pair.baseline_enu - pair.truth_enu
        nees.append(np.mean(np.einsum("ni,ni->n", error, np.linalg.solve(pair.P[:, :3, :3], error[..., None])[..., 0])) / 3)
    assert np.mean(both) < 0.95 * np.mean(alone)
    assert 0.6 < np.mean(nees) < 1.6


def test_no_phases_are_no_steps() -> None:
    """An empty table of phases has no steps."""
    none: IntArray = np.zeros(0, np.int64)
    empty = Phases(none, np.zeros(0), none, none, np.zeros(0), np.zeros(0), np.zeros((0, 3)), np.zeros(0), np.zeros(0), none > 0)
    steps = find_steps(empty)
    assert not len(steps.after) and not len(repair(empty, steps, LEAST, 10.0).arc)


@pytest.mark.parametrize("bands", ["127", "1", "27"])
def test_a_recording_is_fixed_with_both_bands_and_with_each(bands: str) -> None:
    """A moving receiver without Doppler and IMU 5 km from its base; slips and gaps are bridged by the other satellites."""
    problem = load("cssrlib_kin_2021_265", shared_data("cssrlib_kin_2021_265").parent).problem
    solution = solve(replace(problem, settings=replace(problem.settings, bands=bands)))
    pair = solution.pairs[0]
    assert np.mean(pair.fix == Fix.FIXED.value) >= 0.99 and not solution.diagnostics.warnings
    assert 0.5 < solution.diagnostics.nis.sum() / solution.diagnostics.nis_dof.sum() < 1.2
    mended = solution.slips.repaired
    assert np.any(mended) and np.all(solution.slips.sigma_cyc[mended] < 0.07)
