"""Phase arcs: every slip detector alone on exact observations, and steps of residuals."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from factorgraph.measurements import GnssStream
from factorgraph.models.arcs import CAUSES, Arcs, find_arcs, split_at_steps
from factorgraph.models.gnss import PairedRows, pair_rows
from factorgraph.problem import AmbiguitySettings
from factorgraph.types import Array, IntArray
from tests.factorgraph.synthetic import every, receiver

SATELLITES = ("G01", "G02", "G03", "G04", "G05")
EPOCHS = 30
T = np.arange(float(EPOCHS))
FAR_N = np.tile([300.0, -200.0, 40.0], (EPOCHS, 1))
Rows = list[tuple[int, str, str]]


def receivers(
    signals: tuple[str, ...], without: Callable[[int, str, str], bool] = lambda e, s, k: False
) -> tuple[GnssStream, GnssStream]:
    """Two receivers at rest, the rover without some rows."""
    rows = every(EPOCHS, SATELLITES, signals)
    return receiver(T, rows), receiver(T, [row for row in rows if not without(*row)], r_n=FAR_N, clock_m=120.0)


def at(stream: GnssStream, satellite: str, signal: str, epochs: IntArray | int | slice = slice(None)) -> IntArray:
    """Rows of a satellite and signal at some epochs."""
    chosen = np.arange(len(stream.t_s))[epochs]
    mine = (stream.sat == stream.satellites.index(satellite)) & (stream.signal == stream.signals.index(signal))
    return np.flatnonzero(mine & np.isin(stream.epoch, chosen))


def slipped(stream: GnssStream, satellite: str, signal: str, epoch: int, cycles: float) -> GnssStream:
    phase = stream.phase_cyc.copy()
    phase[at(stream, satellite, signal, slice(epoch, None))] += cycles
    return replace(stream, phase_cyc=phase)


def flagged(stream: GnssStream, rows: IntArray, bit: int = 1) -> GnssStream:
    lli = stream.lli.copy()
    lli[rows] |= bit
    return replace(stream, lli=lli)


def arcs_of(a: GnssStream, b: GnssStream, settings: AmbiguitySettings | None = None) -> tuple[Arcs, PairedRows]:
    pairs = pair_rows(a, b, np.ones(a.n_rows, bool), np.ones(b.n_rows, bool), "125")
    usable = np.isfinite(a.phase_cyc[pairs.a]) & np.isfinite(b.phase_cyc[pairs.b])
    return find_arcs(a, b, pairs, usable, settings or AmbiguitySettings()), pairs


def cuts(b: GnssStream, arcs: Arcs, pairs: PairedRows) -> dict[tuple[str, str], list[int]]:
    """Epochs at which arcs begin after the first, of every satellite and signal that has any."""
    out = {}
    for satellite in b.satellites:
        for signal in b.signals:
            rows = np.flatnonzero(np.isin(pairs.b, at(b, satellite, signal)) & (arcs.of_row >= 0))
            rows = rows[np.argsort(pairs.epoch[rows])]
            begins = pairs.epoch[rows][1:][np.diff(arcs.of_row[rows]) != 0]
            if len(begins):
                out[satellite, signal] = begins.tolist()
    return out


def found(arcs: Arcs) -> dict[str, int]:
    return dict(Counter(CAUSES[cause] for cause in arcs.cause.tolist() if cause >= 0))


def test_clean_observations_are_one_arc_each() -> None:
    a, b = receivers(("G1C", "G2W"))
    arcs, pairs = arcs_of(a, b)
    assert arcs.count == len(SATELLITES) * 2 and not found(arcs)
    assert np.all(np.bincount(arcs.of_row) == EPOCHS)
    for arc in range(arcs.count):
        mine = arcs.of_row == arc
        assert len(set(zip(b.sat[pairs.b[mine]].tolist(), pairs.group[mine].tolist(), strict=True))) == 1


@pytest.mark.parametrize("side", ["reference", "rover"])
def test_loss_of_lock_of_either_receiver(side: str) -> None:
    a, b = receivers(("G1C",))
    if side == "reference":
        a = flagged(a, at(a, "G03", "G1C", 12))
    else:
        b = flagged(b, at(b, "G03", "G1C", 12))
    arcs, pairs = arcs_of(a, b)
    assert cuts(b, arcs, pairs) == {("G03", "G1C"): [12]} and found(arcs) == {"loss of lock": 1}


def test_loss_of_lock_while_the_other_receiver_was_silent_counts() -> None:
    """The flag stands on a row that is not paired; the arc must not run on past it."""
    a, b = receivers(("G1C",), without=lambda e, s, k: s == "G02" and e == 9)
    a = flagged(a, at(a, "G02", "G1C", 9))
    arcs, pairs = arcs_of(a, b)
    assert cuts(b, arcs, pairs) == {("G02", "G1C"): [10]}


def test_flags_that_are_no_loss() -> None:
    """A loss at the first epoch of all ends nothing."""
    a, b = receivers(("G1C",))
    b = flagged(b, np.flatnonzero(b.epoch == 0))
    arcs, _ = arcs_of(a, b)
    assert arcs.count == len(SATELLITES) and not found(arcs)


@pytest.mark.parametrize("side", ["reference", "rover"])
def test_phases_ambiguous_by_half_a_cycle_are_arcs_of_their_own(side: str) -> None:
    """Only where the flag comes or goes."""
    a, b = receivers(("G1C", "G2W"))
    if side == "reference":
        a = flagged(a, at(a, "G03", "G1C", slice(0, 12)), bit=2)
    else:
        b = flagged(b, at(b, "G03", "G1C", slice(0, 12)), bit=2)
    arcs, pairs = arcs_of(a, b)
    assert cuts(b, arcs, pairs) == {("G03", "G1C"): [12]} and found(arcs) == {"half-cycle flag": 1}
    assert np.array_equal(np.flatnonzero(arcs.half), np.flatnonzero(np.isin(pairs.b, at(b, "G03", "G1C", slice(0, 12)))))


@pytest.mark.parametrize(("missing", "begins"), [((9,), []), ((9, 10), [11]), ((9, 10, 11), [12])])
def test_gaps(missing: tuple[int, ...], begins: list[int]) -> None:
    """Up to 2.5 intervals are bridged."""
    a, b = receivers(("G1C",), without=lambda e, s, k: s == "G04" and e in missing)
    arcs, pairs = arcs_of(a, b)
    assert cuts(b, arcs, pairs).get(("G04", "G1C"), []) == begins
    assert found(arcs) == ({"gap": 1} if begins else {})


@pytest.mark.parametrize("side", ["reference", "rover"])
@pytest.mark.parametrize(("cycles", "is_found"), [(10.0, True), (-4.0, True), (2.0, False)])
def test_phase_against_doppler(side: str, cycles: float, is_found: bool) -> None:
    """One band only, so nothing else can see it; the threshold is three cycles."""
    a, b = receivers(("G1C",))
    if side == "reference":
        a = slipped(a, "G05", "G1C", 17, cycles)
    else:
        b = slipped(b, "G05", "G1C", 17, cycles)
    arcs, pairs = arcs_of(a, b)
    assert cuts(b, arcs, pairs) == ({("G05", "G1C"): [17]} if is_found else {})
    assert found(arcs) == ({"phase against Doppler": 1} if is_found else {})


def test_without_doppler_there_is_no_such_test() -> None:
    a, b = receivers(("G1C",))
    b = replace(slipped(b, "G05", "G1C", 17, 10.0), doppler_hz=np.full(b.n_rows, np.nan))
    arcs, _ = arcs_of(a, b)
    assert not found(arcs)


@pytest.mark.parametrize("signals", [("G1C",), ("G1C", "G2W"), ("G1C", "G2W", "G5Q")])
def test_a_jump_of_the_receiver_clock_is_no_slip(signals: tuple[str, ...]) -> None:
    """A millisecond, in all codes and phases of one receiver, which then observes so much earlier than its time tags say."""
    a, _ = receivers(signals)
    early = receiver(T - np.where(T >= 15, 1e-3, 0.0), every(EPOCHS, SATELLITES, signals), r_n=FAR_N, clock_m=120.0)
    jump = np.where(early.epoch >= 15, 299_792.458, 0.0)
    b = replace(early, t_s=T, code_m=early.code_m + jump, phase_cyc=early.phase_cyc + jump / early.wavelength_m)
    arcs, _ = arcs_of(a, b)
    assert arcs.count == len(SATELLITES) * len(signals) and not found(arcs)


def test_two_bands_apart_cut_both() -> None:
    """One cycle: too small for Doppler, and nothing tells which of two bands slipped."""
    a, b = receivers(("G1C", "G2W"))
    arcs, pairs = arcs_of(a, slipped(b, "G02", "G2W", 20, 1.0))
    assert cuts(b, arcs, pairs) == {("G02", "G1C"): [20], ("G02", "G2W"): [20]}
    assert found(arcs) == {"geometry-free": 2}


def test_of_three_bands_the_odd_one_is_cut() -> None:
    a, b = receivers(("G1C", "G2W", "G5Q"))
    arcs, pairs = arcs_of(a, slipped(b, "G02", "G2W", 20, -1.0))
    assert cuts(b, arcs, pairs) == {("G02", "G2W"): [20]} and found(arcs) == {"geometry-free": 1}


def test_ionosphere_and_noise_below_the_threshold_are_no_slips() -> None:
    a, b = receivers(("G1C", "G2W"))
    rng = np.random.default_rng(1)
    quiet = b.phase_cyc + (rng.normal(0.0, 0.005, b.n_rows) + 0.01 * np.sin(b.epoch)) / b.wavelength_m
    arcs, _ = arcs_of(a, replace(b, phase_cyc=quiet))
    assert not found(arcs)


def test_simultaneous_slips_of_some_satellites() -> None:
    """The median of an epoch stands while fewer than half of its satellites slip."""
    a, b = receivers(("G1C",))
    b = slipped(slipped(b, "G01", "G1C", 8, 25.0), "G04", "G1C", 8, -12.0)
    arcs, pairs = arcs_of(a, b)
    assert cuts(b, arcs, pairs) == {("G01", "G1C"): [8], ("G04", "G1C"): [8]}


def test_a_slip_seen_by_several_detectors_is_one() -> None:
    a, b = receivers(("G1C",))
    b = flagged(slipped(b, "G01", "G1C", 8, 25.0), at(b, "G01", "G1C", 8))
    arcs, pairs = arcs_of(a, b)
    assert cuts(b, arcs, pairs) == {("G01", "G1C"): [8]} and sum(found(arcs).values()) == 1


def test_rows_without_phase_are_in_no_arc() -> None:
    a, b = receivers(("G1C",))
    hole = at(b, "G03", "G1C", slice(5, 8))
    phase = b.phase_cyc.copy()
    phase[hole] = np.nan
    arcs, pairs = arcs_of(a, replace(b, phase_cyc=phase))
    assert np.all((arcs.of_row < 0) == np.isin(pairs.b, hole))
    assert cuts(b, arcs, pairs) == {("G03", "G1C"): [8]}


def test_nothing_usable_is_no_arc() -> None:
    a, b = receivers(("G1C",))
    pairs = pair_rows(a, b, np.ones(a.n_rows, bool), np.ones(b.n_rows, bool), "1")
    arcs = find_arcs(a, b, pairs, np.zeros(len(pairs.a), bool), AmbiguitySettings())
    assert arcs.count == 0 and np.all(arcs.of_row == -1)


# -- steps of residuals ----------------------------------------------------------------------------

WAVELENGTH_M = 0.19
SIGMA_M = 0.0042


def split(x: Array, arc: IntArray | None = None, t: Array | None = None, min_epochs: int = 5) -> tuple[IntArray, int]:
    n = len(x)
    arc = np.zeros(n, np.int64) if arc is None else arc
    t = np.arange(float(n)) if t is None else t
    return split_at_steps(x, np.full(n, SIGMA_M), arc, t, np.full(n, 0.3 * WAVELENGTH_M), min_epochs)


def test_white_noise_never_splits() -> None:
    """Neither honest noise nor noise ten times what was assumed, whose own steps exceed the smallest step looked for."""
    rng = np.random.default_rng(0)
    for _ in range(300):
        n = int(rng.integers(10, 400))
        assert split(rng.normal(0.0, SIGMA_M, n))[1] == 0
    wild = sum(split(rng.normal(0.0, 10 * SIGMA_M, 100))[1] for _ in range(300))
    assert wild <= 1


@pytest.mark.parametrize("where", [5, 20, 50, 95])
@pytest.mark.parametrize("seed", range(5))
def test_half_a_cycle_splits_where_it_is(where: int, seed: int) -> None:
    x = np.random.default_rng(seed).normal(0.0, SIGMA_M, 100)
    x[where:] += 0.5 * WAVELENGTH_M
    arc, n = split(x)
    assert n == 1
    np.testing.assert_array_equal(arc, np.where(np.arange(100) < where, 0, 1))


def test_a_step_on_slow_motion_is_found() -> None:
    """Residuals of a float solution bend: slowly, not like a slip."""
    rng = np.random.default_rng(3)
    t = np.arange(200.0)
    bend = 0.02 * np.sin(t / 30)
    assert split(rng.normal(0.0, SIGMA_M, 200) + bend)[1] == 0
    arc, n = split(rng.normal(0.0, SIGMA_M, 200) + bend + np.where(t >= 120, WAVELENGTH_M, 0.0))
    assert n == 1 and abs(int(np.argmax(arc == 1)) - 120) <= 1


def test_steps_too_small_or_too_close_to_the_ends_stay() -> None:
    rng = np.random.default_rng(4)
    x = rng.normal(0.0, SIGMA_M, 60)
    small, late = x.copy(), x.copy()
    small[30:] += 0.2 * WAVELENGTH_M  # five sigma by far, but no slip
    late[57:] += WAVELENGTH_M  # three epochs would be an arc shorter than allowed
    assert split(small)[1] == 0
    arc, _ = split(late)
    assert np.bincount(arc).min() >= 5
    assert split(np.concatenate([np.zeros(4), np.ones(5)]))[1] == 0  # too short to have two arcs


def test_arcs_are_judged_alone_in_order_of_time() -> None:
    """Rows of two arcs shuffled, others without an arc; only the arc with a step splits, at its time."""
    rng = np.random.default_rng(5)
    n = 300
    t = rng.permutation(n).astype(float)
    arc = rng.integers(-1, 2, n)
    x = rng.normal(0.0, SIGMA_M, n) + np.where((arc == 1) & (t >= 140), 0.5 * WAVELENGTH_M, 0.0)
    x[arc == -1] += 100.0
    new, count = split(x, arc, t)
    assert count == 1
    np.testing.assert_array_equal(new, np.where((arc == 1) & (t >= 140), 2, arc))
    np.testing.assert_array_equal(split(x[:0], arc[:0], t[:0])[0], [])
