"""GNSS models: single points on exact observations, pairing of two receivers, the Earth's rotation during travel."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from factorgraph.geodesy import C_MPS, OMEGA_E_RPS, ecef_from_geodetic
from factorgraph.measurements import GnssStream
from factorgraph.models.gnss import (
    PairedRows,
    SinglePoint,
    elevation_scale,
    look_angles,
    one_code_per_satellite,
    pair_rows,
    prepare,
    single_point,
    turned_satellites,
)
from factorgraph.problem import GnssNoise
from factorgraph.types import Array
from scenarios.simulate import SimulatedFlight, simulate
from scenarios.simulate.scenario import parse
from tests.factorgraph.synthetic import FRAME, every, receiver

EXACT = """
[scenario]
name = "exact"
origin = { lat_deg = 48.5, lon_deg = 12.0, h_m = 400.0 }
duration_s = 6.0
noise_scale = 0.0

[[vehicle]]
name = "a"
trajectory = { kind = "manoeuvres", speed_mps = 50.0, segments = [{ duration_s = 10.0, turn_dps = 5.0, climb_mps = 2.0 }] }
gnss = { lever_b = [0.3, 0.5, 0.2], signals = ["G1C", "E1C", "C2I"], rate_hz = 2.0 }
"""
NOISE = GnssNoise()


@pytest.fixture(scope="module")
def flight() -> SimulatedFlight:
    return simulate(parse(EXACT), seed=3)


def antenna_truth(flight: SimulatedFlight) -> tuple[Array, Array, Array]:
    """Antenna position and velocity (m, 3) at the true times of reception, clock (m,)."""
    stream, record = stream_of(flight), flight.record.gnss["a"]
    r, v = flight.record.trajectories["a"].at(stream.t_s - record.clock_s).point((0.3, 0.5, 0.2))
    return r, v, record.clock_s


def stream_of(flight: SimulatedFlight) -> GnssStream:
    antenna = flight.problem.vehicles[0].gnss
    assert antenna is not None
    return antenna.stream


def solved(flight: SimulatedFlight, stream: GnssStream, systems: str = "GEC") -> SinglePoint:
    return single_point(stream, NOISE, systems, stream.klobuchar, flight.problem.t0.sow)


# -- single points ---------------------------------------------------------------------------------


@pytest.mark.parametrize("systems", ["G", "GE", "GEC"])
@pytest.mark.parametrize("knows_its_place", [True, False])
def test_exact_observations_give_the_exact_point(flight: SimulatedFlight, systems: str, knows_its_place: bool) -> None:
    """Troposphere, ionosphere, clocks and light travel simulated apart from the model; from the Earth's centre too."""
    stream = stream_of(flight)
    if not knows_its_place:
        stream = replace(stream, approx_ecef=None)
    point = solved(flight, stream, systems)
    r, v, clock = antenna_truth(flight)
    frame = flight.problem.frame
    np.testing.assert_allclose(frame.from_ecef(point.r_ecef), r, atol=1e-3)
    np.testing.assert_allclose(point.clock_s * C_MPS, clock * C_MPS, atol=1e-3)
    # second-order terms of the range rate are left out
    np.testing.assert_allclose(frame.rotate_from_ecef(point.v_ecef), v, atol=5e-3)
    assert np.all(point.rms_m < 1e-3) and np.all(point.n_sat >= 5)


def test_a_gross_code_error_is_weighed_down(flight: SimulatedFlight) -> None:
    stream = stream_of(flight)
    code = stream.code_m.copy()
    spoiled = (stream.sat == stream.sat[0]) & (stream.epoch == 2)
    code[spoiled] += 5000.0
    point = solved(flight, replace(stream, code_m=code))
    off = np.linalg.norm(flight.problem.frame.from_ecef(point.r_ecef) - antenna_truth(flight)[0], axis=1)
    assert off[2] < 20.0
    np.testing.assert_allclose(np.delete(off, 2), 0.0, atol=1e-3)


def test_too_few_satellites_are_no_point(flight: SimulatedFlight) -> None:
    """Three satellites of one constellation, or four of two: NaN at that epoch, the others unharmed."""
    stream = stream_of(flight)
    gps = [i for i, s in enumerate(stream.satellites) if s[0] == "G"]
    galileo = [i for i, s in enumerate(stream.satellites) if s[0] == "E"]
    code = stream.code_m.copy()
    for epoch, keep in ((1, gps[:3]), (2, gps[:2] + galileo[:2]), (3, gps[:4])):
        code[(stream.epoch == epoch) & ~np.isin(stream.sat, keep)] = np.nan
    point = solved(flight, replace(stream, code_m=code), "GE")
    found = np.isfinite(point.clock_s)
    assert not found[1] and not found[2] and np.all(found[4:]) and found[0]
    assert np.all(np.isnan(point.r_ecef[[1, 2]])) and list(point.n_sat[1:4]) == [3, 4, 4]
    np.testing.assert_allclose(point.r_ecef[4], solved(flight, stream, "GE").r_ecef[4], atol=1e-6)


def test_an_epoch_without_rows_is_nan(flight: SimulatedFlight) -> None:
    stream = stream_of(flight)
    point = solved(flight, replace(stream, code_m=np.where(stream.epoch == 4, np.nan, stream.code_m)))
    assert np.isnan(point.clock_s[4]) and point.n_sat[4] == 0 and np.all(np.isfinite(np.delete(point.clock_s, 4)))


def test_prepared_codes_are_ranges_and_clock(flight: SimulatedFlight) -> None:
    """Approximate positions 10 m off leave the corrections as they are."""
    stream = stream_of(flight)
    r, _, clock = antenna_truth(flight)
    prepared = prepare(stream, flight.problem.frame, r + [6.0, -6.0, 5.0], clock, stream.klobuchar, flight.problem.t0.sow)
    rho = np.linalg.norm(prepared.sat_n - r[stream.epoch], axis=1)
    np.testing.assert_allclose(rho, flight.record.gnss["a"].range_m, atol=1e-3)
    np.testing.assert_allclose(prepared.code_m - C_MPS * clock[stream.epoch], rho, atol=5e-3)
    whole = (prepared.phase_m - prepared.code_m) / stream.wavelength_m - flight.record.gnss["a"].integer
    np.testing.assert_allclose(whole, 0.0, atol=1e-3)
    np.testing.assert_allclose(prepared.t_s, stream.t_s[stream.epoch] - clock[stream.epoch], atol=1e-15)
    np.testing.assert_allclose(prepared.elevation_rad, flight.record.gnss["a"].elevation_rad, atol=1e-5)


def test_one_code_per_satellite_prefers_the_first_band() -> None:
    stream = receiver(np.arange(2.0), [*every(2, ["G01", "G02"], ["G2W", "G1C"]), (0, "G03", "G2W")])
    code = stream.code_m.copy()
    code[(stream.epoch == 1) & (stream.sat == 0) & (stream.signal == 0)] = np.nan
    stream = replace(stream, code_m=code)
    rows = one_code_per_satellite(stream, np.ones(stream.n_rows, bool))
    got = [(int(stream.epoch[i]), stream.satellites[stream.sat[i]], stream.signals[stream.signal[i]]) for i in rows]
    assert got == [(0, "G01", "G1C"), (0, "G02", "G1C"), (0, "G03", "G2W"), (1, "G01", "G2W"), (1, "G02", "G1C")]


# -- geometry --------------------------------------------------------------------------------------


def test_turned_satellites_are_the_sagnac_term() -> None:
    """|turned - r| - |s - r| = omega / c (x_s y_r - y_s x_r). Source: IS-GPS-200; the remainder is below 1e-4 m."""
    rng = np.random.default_rng(0)
    r = ecef_from_geodetic(rng.uniform(-1.2, 1.2, 40), rng.uniform(-3, 3, 40), 100.0)
    s = r + rng.normal(size=(40, 3)) * 1e7
    s *= (2.66e7 / np.linalg.norm(s, axis=1))[:, None]
    v = rng.normal(0.0, 2000.0, (40, 3))
    turned, turned_v = turned_satellites(s, v, r)
    longer = np.linalg.norm(turned - r, axis=1) - np.linalg.norm(s - r, axis=1)
    sagnac = OMEGA_E_RPS / C_MPS * (s[:, 0] * r[:, 1] - s[:, 1] * r[:, 0])
    np.testing.assert_allclose(longer, sagnac, atol=5e-4)
    assert np.abs(sagnac).max() > 10.0
    # one rotation turns both: scalar products stay
    np.testing.assert_allclose(np.einsum("ni,ni->n", turned, turned_v), np.einsum("ni,ni->n", s, v), rtol=1e-9, atol=1.0)
    np.testing.assert_allclose(np.linalg.norm(turned_v, axis=1), np.linalg.norm(v, axis=1), rtol=1e-12)


def test_look_angles_of_the_axes() -> None:
    az, el = look_angles(np.array([[1.0, 0, 0], [0, 1, 0], [0, 0, 1], [-1, 0, 0]]))
    np.testing.assert_allclose(az[[0, 1, 3]], [np.pi / 2, 0.0, -np.pi / 2], atol=1e-15)
    np.testing.assert_allclose(el, [0.0, 0.0, np.pi / 2, 0.0], atol=1e-15)


def test_elevation_scale() -> None:
    np.testing.assert_allclose(elevation_scale(np.deg2rad([90.0, 30.0])), [1.0, np.sqrt(2.5)], atol=1e-15)
    assert np.isfinite(elevation_scale(np.array([-0.1, 0.0]))).all()


# -- pairing ---------------------------------------------------------------------------------------


def paired(a: GnssStream, b: GnssStream, bands: str = "125") -> PairedRows:
    return pair_rows(a, b, np.ones(a.n_rows, bool), np.ones(b.n_rows, bool), bands)


def described(a: GnssStream, b: GnssStream, pairs: PairedRows) -> list[tuple[int, str, str, str]]:
    """(epoch of b, satellite, signal of a, signal of b) in order; the satellites of both rows must agree."""
    out = []
    for i, j, e in zip(pairs.a, pairs.b, pairs.epoch, strict=True):
        assert a.satellites[a.sat[i]] == b.satellites[b.sat[j]] and b.epoch[j] == e
        out.append((int(e), b.satellites[b.sat[j]], a.signals[a.signal[i]], b.signals[b.signal[j]]))
    return out


def test_pairs_hold_what_both_receivers_see() -> None:
    """Satellite numbers differ between the streams; the order is epoch, clock group, satellite."""
    t = np.arange(2.0)
    a = receiver(t, every(2, ["G02", "G05", "G09"], ["G1C"]))
    b = receiver(t, every(2, ["G01", "G05", "G02"], ["G1C", "G2W"]))
    pairs = paired(a, b)
    assert described(a, b, pairs) == [(e, s, "G1C", "G1C") for e in range(2) for s in ("G02", "G05")]
    assert pairs.group_names == ("G1C/G1C",)


def test_a_common_tracking_mode_comes_first() -> None:
    """G5Q with G5Q though each receiver would prefer another of its own; without a common one the best of each."""
    t = np.zeros(1)
    a = receiver(t, [(0, "G01", "G5X"), (0, "G01", "G5Q"), (0, "G02", "G5X"), (0, "G03", "G1C"), (0, "G03", "G1W")])
    b = receiver(
        t, [(0, "G01", "G5Q"), (0, "G01", "G5I"), (0, "G02", "G5I"), (0, "G02", "G5Q"), (0, "G03", "G1W"), (0, "G03", "G1C")]
    )
    pairs = paired(a, b)
    # between two signals common to both, C is preferred to W
    assert described(a, b, pairs) == [(0, "G03", "G1C", "G1C"), (0, "G01", "G5Q", "G5Q"), (0, "G02", "G5X", "G5Q")]
    # unlike modes have unlike biases: a clock group of their own
    assert pairs.group_names == ("G1C/G1C", "G5Q/G5Q", "G5X/G5Q") and list(pairs.group) == [0, 1, 2]


def test_a_mode_with_phase_comes_before_one_without() -> None:
    t = np.zeros(1)
    rows = [(0, "G01", "G2L"), (0, "G01", "G2W")]
    a, b = receiver(t, rows), receiver(t, rows)
    wanted = described(a, b, paired(a, b))
    assert len(wanted) == 1
    name = wanted[0][2]
    phase = np.where(np.array(b.signals)[b.signal] == name, np.nan, b.phase_cyc)
    other = replace(b, phase_cyc=phase)
    assert described(a, other, paired(a, other))[0][2] != name


def test_epochs_match_by_time_within_the_tolerance() -> None:
    """Receivers started apart, at other rates, one with a gap: every epoch is used at most once."""
    a = receiver(np.arange(0.0, 4.0, 0.5), every(8, ["G01", "G02"], ["G1C"]))
    b = receiver(np.array([-1.0, 1.015, 2.0, 3.03, 3.5, 9.0]), every(6, ["G01", "G02"], ["G1C"]))
    pairs = paired(a, b)
    found = sorted({(float(a.t_s[a.epoch[i]]), float(b.t_s[e])) for i, e in zip(pairs.a, pairs.epoch, strict=True)})
    assert found == [(1.0, 1.015), (2.0, 2.0), (3.5, 3.5)]


def test_two_epochs_of_one_receiver_never_share_one_of_the_other() -> None:
    a = receiver(np.array([0.0, 1.0]), every(2, ["G01", "G02"], ["G1C"]))
    b = receiver(np.array([0.99, 1.01]), every(2, ["G01", "G02"], ["G1C"]))
    pairs = paired(a, b)
    assert len(set(pairs.a.tolist())) == len(pairs.a) == 2


def test_unusable_rows_unwanted_bands_and_empty_rows_are_left_out() -> None:
    t = np.zeros(1)
    a = receiver(t, every(1, ["G01", "G02", "G03"], ["G1C", "G2W"]))
    b = receiver(t, every(1, ["G01", "G02", "G03"], ["G1C", "G2W"]))
    usable = ~((b.sat == 0) & (b.signal == 0))
    empty = (a.sat == 1) & (a.signal == 1)
    a = replace(a, code_m=np.where(empty, np.nan, a.code_m), phase_cyc=np.where(empty, np.nan, a.phase_cyc))
    got = described(a, b, pair_rows(a, b, np.ones(6, bool), usable, "12"))
    assert [(s, k) for _, s, k, _ in got] == [("G02", "G1C"), ("G03", "G1C"), ("G01", "G2W"), ("G03", "G2W")]
    assert {k for _, _, k, _ in described(a, b, paired(a, b, "1"))} == {"G1C"}


@pytest.mark.parametrize("other", ["epochs", "satellites"])
def test_nothing_in_common_is_no_pairs(other: str) -> None:
    a = receiver(np.arange(3.0), every(3, ["G01", "G02"], ["G1C"]))
    names = ["G07", "G08"] if other == "satellites" else ["G01", "G02"]
    b = receiver(np.arange(3.0) + (0.0 if other == "satellites" else 100.0), every(3, names, ["G1C"]))
    pairs = paired(a, b)
    assert len(pairs.a) == len(pairs.b) == len(pairs.epoch) == 0


def test_synthetic_receivers_agree_with_the_model() -> None:
    """The hand-made observations of other tests: their codes are the ranges that `prepare` predicts."""
    r_n = np.array([[100.0, 50.0, 10.0], [120.0, 40.0, 12.0]])
    stream = receiver(np.arange(2.0), every(2, ["G01", "G02", "G03"], ["G1C"]), r_n=r_n, clock_m=30.0)
    prepared = prepare(stream, FRAME, r_n, np.zeros(2), None, 0.0)
    rho = np.linalg.norm(prepared.sat_n - r_n[stream.epoch], axis=1)
    delay = rho + 30.0 - prepared.code_m  # the troposphere is taken off observations that have none
    assert np.all((delay > 1.0) & (delay < 10.0))
    assert np.all(prepared.elevation_rad > np.deg2rad(20.0))
