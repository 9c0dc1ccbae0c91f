"""GNSS observations: exact geometry without noise, statistics of noise, outliers, slips and outages."""

from __future__ import annotations

import numpy as np
import pytest

from factorgraph.errors import InputError
from factorgraph.gpstime import GpsTime
from factorgraph.models.gnss import elevation_scale, prepare, single_point
from factorgraph.problem import Antenna, GnssNoise
from factorgraph.types import Array
from scenarios.flights.navigation import builtin_constellation
from scenarios.flights.schema import GnssNoiseTable, Origin
from scenarios.simulate.gnss import (
    ClockTable,
    CodeFaults,
    EnvironmentTable,
    GnssRecord,
    GnssTable,
    Outage,
    Sky,
    simulate,
    with_code_faults,
)
from scenarios.simulate.streams import Streams
from scenarios.simulate.trajectory import Formation, Manoeuvres, Segment, Static, Trajectory, TrajectoryTable, build

T0 = GpsTime(2317, 300_000.0)
ORIGIN = Origin(lat_deg=47.0, lon_deg=11.0, h_m=500.0)
LEVER = (0.1, -0.4, 0.3)


def sky(duration_s: float, **environment: float) -> Sky:
    navigation = builtin_constellation().shifted_to(T0, duration_s)
    return Sky(navigation, ORIGIN.frame, T0, duration_s, EnvironmentTable(**environment), Streams(4, "/satellites"))


def paths(duration_s: float) -> dict[str, Trajectory]:
    fast = Manoeuvres(
        kind="manoeuvres", start_n=(0.0, 0.0, 900.0), speed_mps=110.0, segments=(Segment(duration_s=duration_s, turn_dps=2.0),)
    )
    tables: dict[str, TrajectoryTable] = {
        "fast": fast,
        "near": Formation(kind="formation", leader="fast", offset_m=(40.0, -60.0, 10.0), sway_m=1.0),
        "rest": Static(kind="static"),
    }
    return build(tables, duration_s, {name: np.random.default_rng(1) for name in tables}, ORIGIN.frame)


def observed(
    name: str, table: GnssTable, duration_s: float, noise_scale: float, seed: int = 9, **environment: float
) -> tuple[Antenna, GnssRecord, Trajectory]:
    path = paths(duration_s)[name]
    antenna, record = simulate(table, sky(duration_s, **environment), path, Streams(seed, f"/{name}/gnss"), noise_scale)
    return antenna, record, path


def phase_without_integers(antenna: Antenna, record: GnssRecord, path: Trajectory) -> tuple[Array, Array]:
    """Code and phase residuals in metres of the estimators' model at the true antenna; what is left is the clock."""
    s = antenna.stream
    r_n, _ = path.at(s.t_s - record.clock_s).point(antenna.lever_b)
    p = prepare(s, ORIGIN.frame, r_n, record.clock_s, s.klobuchar, T0.sow)
    rho = np.linalg.norm(p.sat_n - r_n[s.epoch], axis=1)
    return p.code_m - rho, p.phase_m - record.integer * s.wavelength_m - rho


@pytest.mark.parametrize("signals", [("G1C", "G2W", "E1C"), ("C2I", "C6I", "E5Q")])
def test_without_noise_double_differences_are_geometry(signals: tuple[str, ...]) -> None:
    """Spec common.md, section 5: P, Phi = rho + c dt_u + T +- I (+ lambda N), at the antenna, at tag minus clock."""
    table = GnssTable(signals=signals, lever_b=LEVER, rate_hz=2.0)
    residuals = {}
    for name in ("fast", "near"):
        antenna, record, path = observed(name, table, 40.0, 0.0, satellite_error_m=1.0)
        code, phase = phase_without_integers(antenna, record, path)
        clock_m = record.clock_s[antenna.stream.epoch] * 299_792_458.0
        # the estimators' model leaves 1e-4 m in single ranges
        assert np.max(np.abs(code - clock_m)) < 2e-4
        assert np.max(np.abs(phase - clock_m)) < 2e-4
        s = antenna.stream
        rows = zip(s.epoch, s.sat, s.signal, strict=True)
        residuals[name] = {(e, s.satellites[i], s.signals[j]): phase[k] for k, (e, i, j) in enumerate(rows)}
    common = sorted(residuals["fast"].keys() & residuals["near"].keys())
    single = np.array([residuals["near"][k] - residuals["fast"][k] for k in common])
    epoch = np.array([k[0] for k in common])
    double = np.concatenate([single[epoch == e][1:] - single[epoch == e][0] for e in np.unique(epoch)])
    assert len(double) > 100 and np.max(np.abs(double)) < 1e-5


def test_doppler_is_the_rate_of_the_phase() -> None:
    """Without the atmosphere, whose change (below 1 mm/s) the Doppler leaves out."""
    table = GnssTable(rate_hz=10.0, lever_b=LEVER, clock=ClockTable(drift=1e-6, drift_walk_rts=0.0))
    antenna, record, _ = observed("rest", table, 10.0, 0.0, troposphere=0.0, ionosphere=0.0)
    s = antenna.stream
    for i in range(len(s.satellites)):
        rows = np.flatnonzero(s.sat == i)
        rate = (s.phase_cyc[rows[2:]] - s.phase_cyc[rows[:-2]]) / 0.2
        np.testing.assert_allclose(-s.doppler_hz[rows[1:-1]], rate, atol=1e-5)
    assert np.ptp(record.clock_s) > 0


def test_single_points_find_antenna_and_clock() -> None:
    antenna, record, path = observed("fast", GnssTable(lever_b=LEVER), 30.0, 0.0)
    s = antenna.stream
    point = single_point(s, antenna.noise, "GREC", s.klobuchar, T0.sow)
    r_n, v_n = path.at(s.t_s - record.clock_s).point(LEVER)
    np.testing.assert_allclose(ORIGIN.frame.from_ecef(point.r_ecef), r_n, atol=0.01)
    np.testing.assert_allclose(point.clock_s, record.clock_s, atol=1e-10)
    np.testing.assert_allclose(ORIGIN.frame.rotate_from_ecef(point.v_ecef), v_n, atol=0.1)


def test_noise_follows_elevation_and_outliers_their_probability() -> None:
    table = GnssTable(
        rate_hz=5.0,
        noise=GnssNoiseTable(code_m=0.5, phase_m=0.002, doppler_mps=0.1),
        outlier_probability=0.02,
        outlier_m=(8.0, 30.0),
    )
    (clean, _, _), (noisy, record, _) = observed("rest", table, 120.0, 0.0), observed("rest", table, 120.0, 1.0)
    a, b = clean.stream, noisy.stream
    scale = elevation_scale(record.elevation_rad)
    n = b.n_rows
    for got, sigma in (
        (b.code_m - a.code_m - record.outlier_m, 0.5),
        ((b.phase_cyc - a.phase_cyc) * a.wavelength_m, 0.002),
        ((b.doppler_hz - a.doppler_hz) * a.wavelength_m, 0.1),
    ):
        z = got / (sigma * scale)
        assert abs(z.std() - 1) < 4 / np.sqrt(2 * n) + 1e-3 and abs(z.mean()) < 4 / np.sqrt(n)
    hit = record.outlier_m != 0
    assert abs(hit.mean() - 0.02) < 4 * np.sqrt(0.02 * 0.98 / n)
    assert np.all((np.abs(record.outlier_m[hit]) >= 8.0) & (np.abs(record.outlier_m[hit]) <= 30.0))
    assert 0.3 < np.mean(record.outlier_m[hit] > 0) < 0.7


def test_flat_noise_is_the_same_at_every_elevation() -> None:
    noise = GnssNoiseTable(code_m=0.5, phase_m=0.002, doppler_mps=0.1, elevation="flat")
    table = GnssTable(rate_hz=5.0, noise=noise)
    (clean, _, _), (noisy, record, _) = observed("rest", table, 120.0, 0.0), observed("rest", table, 120.0, 1.0)
    z = (noisy.stream.code_m - clean.stream.code_m) / 0.5
    low = record.elevation_rad < np.deg2rad(30.0)
    for part in (z[low], z[~low]):
        assert abs(part.std() - 1) < 4 / np.sqrt(2 * len(part))
    assert noisy.noise.elevation == "flat"
    np.testing.assert_array_equal(elevation_scale(record.elevation_rad, "flat"), 1.0)


def faulty(seed: int, *faults: CodeFaults) -> tuple[Antenna, GnssRecord]:
    table = GnssTable(signals=("G1C", "G2W"), code_faults=faults)
    antenna, record, _ = observed("rest", table, 120.0, 1.0, seed)
    return antenna, record


def test_code_faults_stay_in_their_windows_and_spare_the_highest() -> None:
    window = CodeFaults(start_s=20.0, end_s=100.0, size_m=7.0, probability=0.3)
    hits, chances, signs = 0, 0, []
    for seed in range(4):
        antenna, record = faulty(seed, window)
        s, fault = antenna.stream, record.outlier_m
        inside = (s.t_s >= 20.0) & (s.t_s <= 100.0)
        assert np.array_equal(np.unique(s.epoch[fault != 0]), np.flatnonzero(inside))  # every epoch, both ends included
        assert set(np.unique(np.abs(fault))) == {0.0, 7.0}
        for e in np.flatnonzero(inside):
            rows = np.flatnonzero(s.epoch == e)
            highest = s.sat[rows[np.argmax(record.elevation_rad[rows])]]
            assert not np.any(fault[rows[s.sat[rows] == highest]])
            of = {int(k): set(fault[rows[s.sat[rows] == k]]) for k in s.sat[rows]}
            assert all(len(values) == 1 for values in of.values())  # both signals alike
            hits, chances = hits + sum(values != {0.0} for values in of.values()), chances + len(of) - 1
        signs.append(np.sign(fault[fault != 0]))
    n = chances / (81 * 4)
    expected = 0.3 + 0.7**n / n  # at least one
    assert abs(hits / chances - expected) < 4 * np.sqrt(0.21 / chances) + 0.01
    assert abs(np.mean(np.concatenate(signs))) < 0.2


def test_code_faults_can_be_added_later_and_leave_everything_else() -> None:
    windows = (CodeFaults(start_s=5.0, end_s=9.0, size_m=3.0), CodeFaults(start_s=50.0, end_s=50.0, size_m=9.0, probability=0.0))
    (clean, before), (hit, record) = faulty(3), faulty(3, *windows)
    later, same = with_code_faults(clean, before, windows, Streams(3, "/rest/gnss"))
    np.testing.assert_array_equal(later.stream.code_m, hit.stream.code_m)
    np.testing.assert_array_equal(same.outlier_m, record.outlier_m)
    np.testing.assert_allclose(hit.stream.code_m - clean.stream.code_m, record.outlier_m, atol=1e-7)
    np.testing.assert_array_equal(hit.stream.phase_cyc, clean.stream.phase_cyc)
    assert len(np.unique(hit.stream.sat[np.abs(record.outlier_m) == 9.0])) == 1  # without any chance still one satellite
    alone, _ = with_code_faults(clean, before, windows[1:], Streams(3, "/rest/gnss"))
    at = clean.stream.t_s[clean.stream.epoch] == 50.0
    np.testing.assert_array_equal(alone.stream.code_m[at], hit.stream.code_m[at])


def test_the_sky_moves_on() -> None:
    """Two hours later BeiDou's geostationary satellites are where they were and others are not."""
    later = builtin_constellation().shifted_to(T0 + -7200.0, 7200.0 + 30.0)
    names = ("C01", "C20")
    now, then = (nav.states_at(names, np.arange(2), T0, np.zeros(2)).pos_ecef for nav in (sky(30.0).navigation, later))
    moved = np.linalg.norm(now - then, axis=1)
    assert moved[0] < 1e3 and moved[1] > 1e7


def test_multipath_is_correlated_and_told_to_the_estimator() -> None:
    table = GnssTable(rate_hz=1.0, multipath_m=1.0, multipath_s=20.0, noise=GnssNoiseTable(code_m=1e-6))
    (clean, _, _), (dirty, record, _) = observed("rest", table, 600.0, 0.0), observed("rest", table, 600.0, 1.0)
    z = (dirty.stream.code_m - clean.stream.code_m) / elevation_scale(record.elevation_rad)
    lag = []
    for i in range(len(clean.stream.satellites)):
        x = z[clean.stream.sat == i]
        lag.append(np.mean(x[1:] * x[:-1]) / np.mean(x * x))
    np.testing.assert_allclose(np.mean(lag), np.exp(-1 / 20), atol=0.03)
    np.testing.assert_allclose(z.std(), 1.0, atol=0.2)
    assert dirty.noise == GnssNoise(code_m=float(np.hypot(1e-6, 1.0)))


def test_slips_jump_by_integers_and_are_recorded() -> None:
    table = GnssTable(rate_hz=5.0, slips_per_hour=60.0, lli_probability=0.6, slip_cycles=4)
    (smooth, calm, _), (antenna, record, _) = (
        observed("rest", GnssTable(rate_hz=5.0), 120.0, 0.0),
        observed("rest", table, 120.0, 0.0),
    )
    s = antenna.stream
    np.testing.assert_allclose(s.phase_cyc - smooth.stream.phase_cyc, record.integer - calm.integer, atol=1e-6)
    hours = s.n_rows / 5.0 / 3600.0
    assert abs(len(record.slips) - 60 * hours) < 4 * np.sqrt(60 * hours)
    flagged = np.mean([slip.flagged for slip in record.slips])
    assert abs(flagged - 0.6) < 4 * np.sqrt(0.24 / len(record.slips))
    for slip in record.slips:
        rows = np.flatnonzero((s.sat == s.satellites.index(slip.satellite)) & (s.signal == s.signals.index(slip.signal)))
        at = int(np.searchsorted(s.t_s[s.epoch[rows]], slip.t_s))
        assert record.integer[rows[at]] - record.integer[rows[at - 1]] == slip.cycles != 0
        assert abs(slip.cycles) <= 4 and s.lli[rows[at]] == slip.flagged


def test_half_cycles_stand_until_they_are_resolved() -> None:
    """Eight seconds after lock; slips by half cycles stay."""
    antenna, record, _ = observed("rest", GnssTable(half_cycle_s=8.0, outages=(Outage(start_s=20, end_s=24),)), 40.0, 0.0)
    s, calm = antenna.stream, observed("rest", GnssTable(outages=(Outage(start_s=20, end_s=24),)), 40.0, 0.0)[0].stream
    t = s.t_s[s.epoch]
    unresolved = (t < 8 - 1e-9) | ((t >= 24) & (t < 32 - 1e-9))
    np.testing.assert_array_equal((s.lli & 2) > 0, unresolved)
    np.testing.assert_allclose(s.phase_cyc - calm.phase_cyc, 0.5 * record.half, atol=1e-6)
    assert set(record.half.tolist()) == {0, 1} and not np.any(record.half[~unresolved])
    table = GnssTable(rate_hz=5.0, slips_per_hour=60.0, slip_half_probability=0.5)
    _, record, _ = observed("rest", table, 120.0, 0.0)
    assert {slip.cycles % 1 for slip in record.slips} == {0.0, 0.5}


def test_clocks_are_set_back_by_milliseconds_with_the_phases_or_without() -> None:
    tables = [ClockTable(drift=5e-5, limit_s=5e-4, phase_follows=follow) for follow in (True, False)]
    streams, records = zip(
        *((antenna.stream, record) for antenna, record, _ in (observed("rest", GnssTable(clock=c), 60.0, 0.0) for c in tables)),
        strict=True,
    )
    step = np.diff(records[0].clock_s)
    jumps = np.flatnonzero(np.abs(step) > 5e-4)
    assert len(jumps) >= 1 and np.abs(records[0].clock_s).max() < 5.6e-4
    np.testing.assert_allclose(step[jumps] - np.median(step), -1e-3 * np.sign(np.median(step)), atol=1e-5)
    np.testing.assert_array_equal(streams[0].code_m, streams[1].code_m)
    apart = (streams[1].phase_cyc - streams[0].phase_cyc) * streams[0].wavelength_m / 299_792.458
    np.testing.assert_allclose(apart, np.rint(apart), atol=1e-6)
    assert len(np.unique(np.rint(apart))) == len(jumps) + 1


def test_after_an_outage_tracking_starts_with_another_integer() -> None:
    free, _, _ = observed("rest", GnssTable(), 30.0, 0.0)
    name = free.stream.satellites[0]
    table = GnssTable(outages=(Outage(start_s=10, end_s=15), Outage(start_s=20, end_s=25, satellites=(name,))))
    antenna, record, _ = observed("rest", table, 30.0, 0.0)
    s = antenna.stream
    t = s.t_s[s.epoch]
    clock = 0.001  # tags are off by less than this
    assert not np.any((t >= 10 + clock) & (t < 15 - clock))
    rows = np.flatnonzero(s.sat == s.satellites.index(name))
    assert not np.any((t[rows] >= 20 + clock) & (t[rows] < 25 - clock)) and np.any((t > 20) & (t < 25))
    values = record.integer[rows]
    starts = np.flatnonzero(s.lli[rows])
    assert len(starts) == 2 and len(np.unique(values)) == 3
    assert np.array_equal(np.flatnonzero(np.diff(values)) + 1, starts)


def test_error_sources_do_not_disturb_each_other() -> None:
    plain, a, _ = observed("rest", GnssTable(), 20.0, 1.0)
    dirty, b, _ = observed("rest", GnssTable(outlier_probability=0.1, slips_per_hour=500.0), 20.0, 1.0)
    np.testing.assert_allclose(dirty.stream.code_m - b.outlier_m, plain.stream.code_m, atol=1e-6)
    np.testing.assert_allclose(dirty.stream.phase_cyc - b.integer, plain.stream.phase_cyc - a.integer, atol=1e-6)
    assert np.array_equal(dirty.stream.doppler_hz, plain.stream.doppler_hz)


def test_satellite_errors_are_common_to_receivers() -> None:
    both = []
    for name, seed in (("fast", 1), ("rest", 2)):
        (a, _, _), (b, _, _) = (
            observed(name, GnssTable(noise=GnssNoiseTable(code_m=1e-9)), 30.0, 1.0, seed, satellite_error_m=x) for x in (0.0, 2.0)
        )
        d = b.stream.code_m - a.stream.code_m
        both.append({(e, b.stream.satellites[i]): v for e, i, v in zip(b.stream.epoch, b.stream.sat, d, strict=True)})
    common = both[0].keys() & both[1].keys()
    x, y = (np.array([d[k] for k in common]) for d in both)
    assert np.std(x) > 0.5 and np.max(np.abs(x - y)) < 1e-3


def test_unknown_signals_and_empty_skies_are_errors() -> None:
    with pytest.raises(InputError, match='signal "G9X"'):
        observed("rest", GnssTable(signals=("G9X",)), 5.0, 0.0)
    with pytest.raises(InputError, match="no satellites of R"):
        observed("rest", GnssTable(signals=("R1C",)), 5.0, 0.0)
    with pytest.raises(InputError, match="ever tracked above 89 deg"):
        observed("rest", GnssTable(mask_deg=89.0), 5.0, 0.0)
    with pytest.raises(InputError, match="ever tracked"):
        observed("rest", GnssTable(outages=(Outage(start_s=-1, end_s=99),)), 5.0, 0.0)
