"""Observation files: against RTKLIB, between versions, with every kind of damage; and the writers."""

from __future__ import annotations

import gzip
import shutil
import subprocess
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from factorgraph import geodesy
from factorgraph.errors import InputError
from factorgraph.geodesy import C_MPS
from factorgraph.gpstime import GpsTime
from factorgraph.measurements import GnssStream
from factorgraph.models import atmosphere
from factorgraph.types import Array
from scenarios.flights import _rinex_kernels as kernels
from scenarios.flights.navigation import builtin_constellation, read_navigation
from scenarios.flights.rinex import RawObservations, gnss_stream, read_observations
from scenarios.flights.rinex_writer import write_navigation, write_observations
from scenarios.flights.signals import wavelength_m
from tests.helpers import shared_data


def header(version: float, *lines: tuple[str, str], kind: str = "OBSERVATION DATA", system: str = "M") -> str:
    first = (f"{version:9.2f}{'':11}{kind:<20}{system:<20}", "RINEX VERSION / TYPE")
    return "".join(f"{content:<60}{label}\n" for content, label in (first, *lines, ("", "END OF HEADER")))


TYPES = (
    ("G    8 C1C L1C D1C S1C C2W L2W D2W S2W", "SYS / # / OBS TYPES"),
    ("R    4 C1C L1C D1C S1C", "SYS / # / OBS TYPES"),
)
FIRST = ("  2024     2    29    23    59   59.0000000     GPS", "TIME OF FIRST OBS")
HEAD = header(3.04, *TYPES, FIRST)


def field(value: float | None, flags: str = "  ") -> str:
    return " " * 16 if value is None else f"{value:14.3f}{flags}"


def gps(prn: int, k: int = 0, lli: str = "  ") -> str:
    values = [2.1e7 + 1000 * prn + k, 1.1e8 + prn + 0.5 * k, -1500.25 - prn, 44.5, 2.1e7 + 1000 * prn + 3, 8.6e7, -1169.0, 38.25]
    return f"G{prn:02d}" + "".join(field(v, lli if j == 1 else "  ") for j, v in enumerate(values)).rstrip()


def glonass(prn: int) -> str:
    return f"R{prn:02d}" + "".join(field(v) for v in (2.2e7, 1.2e8, 512.5, 41.0)).rstrip()


def epoch(second: float, *records: str, flag: int = 0, count: int | None = None) -> str:
    n = len(records) if count is None else count
    minute, rest = divmod(23 * 60 * 60 + 59 * 60 + second, 60)  # seconds after 2024-02-29 00:00
    day, minute = divmod(int(minute), 24 * 60)
    month, day = (2, 29) if day == 0 else (3, day)
    stamp = f"> 2024 {month:02d} {day:02d} {minute // 60:02d} {minute % 60:02d} {rest:10.7f}  {flag}{n:3d}"
    return "\n".join((stamp, *records)) + "\n"


@pytest.fixture
def read(tmp_path: Path) -> Callable[[str], RawObservations]:
    def from_text(text: str) -> RawObservations:
        path = tmp_path / "obs.rnx"
        path.write_text(text)
        return read_observations(path)

    return from_text


# Against RTKLIB


@pytest.mark.parametrize("file", ["SEPT265G.21O", "3034265G.21O"])
def test_recording_agrees_with_rtklib(file: str) -> None:
    rtklib = pytest.importorskip("pyrtklib5")
    path = shared_data(f"cssrlib_kin_2021_265/{file}")
    obs = rtklib.obs_t()
    assert rtklib.readrnx(str(path), 1, "", obs, rtklib.nav_t(), rtklib.sta_t()) > 0
    raw = read_observations(path)
    first_code = {}
    for i in range(len(raw.epoch)):  # RTKLIB's first slot holds C1C of GPS and QZSS
        if raw.signals[raw.signal[i]][1:] == "1C" and raw.satellites[raw.sat[i]][0] in "GJ":
            first_code[raw.epoch[i], raw.satellites[raw.sat[i]]] = i
    names = {rtklib.satid2no(s): s for s in raw.satellites}
    start, seen = obs.data[0].time, 0
    for k in range(0, obs.n, 7):
        o = obs.data[k]
        name = names[o.sat]
        if name[0] in "GJ" and (o.P[0] or o.L[0]):
            dt = (o.time.time - start.time) + (o.time.sec - start.sec)
            i = first_code[int(np.searchsorted(raw.t_s, dt - 1e-4)), name]
            assert (raw.code_m[i], raw.phase_cyc[i]) == (o.P[0], o.L[0] if o.L[0] else pytest.approx(np.nan, nan_ok=True))
            assert raw.lli[i] == o.LLI[0] & 3
            seen += 1
    assert seen > 300


def test_states_of_a_recording_agree_with_rtklib() -> None:
    """RTKLIB: satellite states at the time of transmission, found from each code."""
    rtklib = pytest.importorskip("pyrtklib5")
    obs_path, nav_path = (shared_data(f"cssrlib_kin_2021_265/{f}") for f in ("SEPT265G.21O", "SEPT2650.21P"))
    before = rtklib.getseleph(rtklib.SYS_GAL)
    rtklib.setseleph(rtklib.SYS_GAL, 1)
    obs, nav = rtklib.obs_t(), rtklib.nav_t()
    rtklib.readrnx(str(obs_path), 1, "", obs, nav, rtklib.sta_t())
    rtklib.readrnx(str(nav_path), 1, "", obs, nav, rtklib.sta_t())
    raw, navigation = read_observations(obs_path), read_navigation([nav_path])
    stream, report = gnss_stream(raw, navigation, raw.t0)
    assert report.n_rows == stream.n_rows
    names = {rtklib.satid2no(s): s for s in stream.satellites}
    found: dict[str, int] = {}
    for i in range(stream.n_rows):
        if stream.epoch[i] == 5:
            found.setdefault(stream.satellites[stream.sat[i]], i)
    start, compared = obs.data[0].time, set()
    for k in range(obs.n):
        o = obs.data[k]
        if abs((o.time.time - start.time) + (o.time.sec - start.sec) - 5.0) > 0.1 or o.P[0] == 0.0:
            continue
        rs, dts, var, svh = rtklib.Arr1Ddouble(6), rtklib.Arr1Ddouble(2), rtklib.Arr1Ddouble(1), rtklib.Arr1Dint(1)
        rtklib.satposs(o.time, o, 1, nav, 0, rs, dts, var, svh)
        i = found[names[o.sat]]
        theirs = np.array([rs[j] for j in range(6)])
        if not np.any(theirs) or np.isnan(stream.sat_clock_m[i]):
            continue
        np.testing.assert_allclose(stream.sat_pos_ecef[i], theirs[:3], atol=1e-3)
        np.testing.assert_allclose(stream.sat_vel_ecef[i], theirs[3:], atol=1e-3)
        compared.add(names[o.sat][0])
    rtklib.setseleph(rtklib.SYS_GAL, before)
    assert compared == {"G", "E", "J"}


# Values and layout


def test_values_flags_and_order(read: Callable[[str], RawObservations]) -> None:
    raw = read(HEAD + epoch(59, glonass(3), gps(7, lli="1 "), gps(2)) + epoch(60, gps(2, 1, lli="3 "), gps(7, 1)))
    assert raw.satellites == ("G02", "G07", "R03") and raw.signals == ("G1C", "G2W", "R1C")
    assert raw.t_s.tolist() == [0.0, 1.0]
    assert raw.t0 == GpsTime.from_calendar(2024, 2, 29, 23, 59, 59)
    assert raw.epoch.tolist() == [0] * 5 + [1] * 4
    assert raw.sat.tolist() == [0, 0, 1, 1, 2, 0, 0, 1, 1]
    assert raw.signal.tolist() == [0, 1, 0, 1, 2, 0, 1, 0, 1]
    assert raw.code_m[:2].tolist() == [21_002_000.0, 21_002_003.0]
    assert raw.doppler_hz[2] == -1507.25 and raw.cn0_dbhz[3] == 38.25
    assert raw.lli.tolist() == [0, 0, 1, 0, 0, 3, 0, 0, 0]
    assert raw.report.dropped == {}
    assert raw.wavelength_m[0] == pytest.approx(0.190293673, abs=1e-9)
    assert np.isnan(raw.wavelength_m[4])  # GLONASS channel unknown


@pytest.mark.parametrize(
    ("version", "named", "signal"),
    [(3.02, "C1I", "C2I"), (3.02, "C1X", "C2X"), (3.04, "C2I", "C2I"), (3.05, "C1X", "C1X"), (4.01, "C1P", "C1P")],
)
def test_versions_name_beidou_signals_differently(
    read: Callable[[str], RawObservations], version: float, named: str, signal: str
) -> None:
    record = "C21" + field(2.3e7) + field(1.2e8).rstrip()
    raw = read(header(version, (f"C    2 {named} L{named[1:]}", "SYS / # / OBS TYPES"), FIRST) + epoch(59, record))
    assert raw.signals == (signal,) and raw.satellites == ("C21",) and raw.phase_cyc[0] == 1.2e8


def test_absent_numbers(read: Callable[[str], RawObservations]) -> None:
    record = "G05" + field(None) + field(1.1e8, " 7") + field(0.0) + field(None) + field(0.0) + field(0.0)
    raw = read(HEAD + epoch(59, record, gps(6)))
    row = 0
    assert np.isnan(raw.code_m[row]) and raw.phase_cyc[row] == 1.1e8 and np.isnan(raw.doppler_hz[row])
    assert raw.cn0_dbhz[row] == 45.0  # strength digit 7: 42 to 48
    assert raw.signals[raw.signal[1]] == "G1C"  # the empty second band makes no row


def test_scale_factor_is_undone_and_phase_shift_kept(read: Callable[[str], RawObservations]) -> None:
    extra = (("G  100  2 L1C S1C", "SYS / SCALE FACTOR"), ("G L2W -0.25000", "SYS / PHASE SHIFT"))
    raw = read(header(3.04, *TYPES, *extra, FIRST) + epoch(59, gps(2)))
    assert raw.phase_cyc[0] == pytest.approx((1.1e8 + 2) / 100, abs=1e-9) and raw.cn0_dbhz[0] == pytest.approx(0.445)
    assert raw.code_m[0] == 21_002_000.0 and raw.phase_cyc[1] == 8.6e7
    assert raw.phase_shift_cyc == {"G2W": -0.25}


def test_glonass_channels_from_header_or_navigation(read: Callable[[str], RawObservations]) -> None:
    slots = ("  2 R03  5 R04 -7", "GLONASS SLOT / FRQ #")
    raw = read(header(3.04, *TYPES, slots, FIRST) + epoch(59, glonass(3), glonass(4)))
    np.testing.assert_allclose(raw.wavelength_m, C_MPS / (1602e6 + 562.5e3 * np.array([5, -7])))
    without = read(HEAD + epoch(59, glonass(3)))
    navigation = builtin_constellation()
    row = np.full((1, 19), 0.0)
    row[0, 10] = 5.0
    with_glonass = replace(navigation, glonass=replace(navigation.glonass, satellites=("R03",), toe_s=np.zeros(1), data=row))
    stream, _ = gnss_stream(without, with_glonass, without.t0)
    assert stream.wavelength_m[0] == pytest.approx(raw.wavelength_m[0])


@pytest.mark.parametrize(
    ("signal", "mhz"),
    [
        ("G5Q", 1176.45),
        ("E7Q", 1207.14),
        ("E8X", 1191.795),
        ("C2I", 1561.098),
        ("C1P", 1575.42),
        ("C6I", 1268.52),
        ("C7D", 1207.14),
    ],
)
def test_wavelengths(signal: str, mhz: float) -> None:
    assert wavelength_m(signal) == pytest.approx(C_MPS / (mhz * 1e6))


@pytest.mark.parametrize(("system", "lag_s"), [("GPS", 0.0), ("BDT", 14.0), ("GLO", 18.0), ("GAL", 0.0)])
def test_time_systems(read: Callable[[str], RawObservations], system: str, lag_s: float) -> None:
    raw = read(HEAD.replace("0000000     GPS", f"0000000     {system}") + epoch(59, gps(2)))
    assert raw.t0 - GpsTime.from_calendar(2024, 2, 29, 23, 59, 59) == lag_s


def test_receiver_clock_and_station_header(read: Callable[[str], RawObservations]) -> None:
    lines = (
        ("TOWER", "MARKER NAME"),
        ("  4075580.1111   931853.2222  4801568.3333", "APPROX POSITION XYZ"),
        ("        1.5000        0.1000       -0.2000", "ANTENNA: DELTA H/E/N"),
        ("     1", "RCV CLOCK OFFS APPL"),
    )
    text = header(3.04, *TYPES, *lines, FIRST) + epoch(59, gps(2)) + epoch(60, gps(2))
    first = text.index("> ")
    end = text.index("\n", first)
    text = text[:end] + f"{'':6}{-0.000123456789:15.12f}" + text[end:]
    raw = read(text)
    assert raw.clock_applied and raw.clock_s[0] == -0.000123456789 and np.isnan(raw.clock_s[1])
    assert raw.marker == "TOWER" and raw.antenna_delta_m.tolist() == [1.5, 0.1, -0.2]
    assert raw.approx_ecef is not None and raw.approx_ecef[2] == 4801568.3333


# Version 2, compression


def version_2(n: int, seconds: tuple[float, ...]) -> str:
    """n satellites with seven observation types: lists and records run over several lines."""
    text = header(
        2.11,
        ("     7    C1    P1    L1    L2    P2    D1    S1", "# / TYPES OF OBSERV"),
        ("  2024     2    29    23    59   59.0000000     GPS", "TIME OF FIRST OBS"),
        system="M",
    )
    names = [f"G{k:2d}" if k <= n - 2 else f"R{k - n + 2:02d}" for k in range(1, n + 1)]
    for s in seconds:
        listed = ["".join(names[k : k + 12]) for k in range(0, n, 12)]
        text += f" 24  2 29 23 59 {s:10.7f}  0{n:3d}{listed[0]}\n" + "".join(f"{'':32}{more}\n" for more in listed[1:])
        for k in range(n):
            values = [2.1e7 + k, 2.1e7 + k + 0.5, 1.1e8 + k, 8.6e7 + k, 2.1e7 + k + 7, -1000.0 - k, 40.0 + k]
            fields = [field(v) for v in values]
            text += "".join(fields[:5]).rstrip() + "\n" + "".join(fields[5:]).rstrip() + "\n"
    return text


def test_version_2_lists_and_records_over_several_lines(read: Callable[[str], RawObservations]) -> None:
    raw = read(version_2(26, (58.0, 58.2)))
    assert len(raw.t_s) == 2 and raw.t_s[1] == pytest.approx(0.2, abs=1e-9)
    assert raw.satellites == (*(f"G{k:02d}" for k in range(1, 25)), "R01", "R02")
    assert raw.signals == ("G1C", "G1W", "G2W", "R1C", "R1P", "R2P")
    at = [i for i in range(len(raw.epoch)) if raw.epoch[i] == 1 and raw.satellites[raw.sat[i]] == "G14"]
    assert [raw.signals[raw.signal[i]] for i in at] == ["G1C", "G1W", "G2W"]
    assert raw.code_m[at].tolist() == [21_000_013.0, 21_000_013.5, 21_000_020.0]
    assert raw.phase_cyc[at[0]] == 110_000_013.0 and np.isnan(raw.phase_cyc[at[1]]) and raw.phase_cyc[at[2]] == 86_000_013.0
    assert raw.doppler_hz[at[0]] == -1013.0 and raw.cn0_dbhz[at[0]] == 53.0
    assert raw.report.dropped == {}


def test_version_2_epoch_with_too_few_satellites_and_events(read: Callable[[str], RawObservations]) -> None:
    text = version_2(3, (57.0, 58.0, 59.0))
    lines = text.splitlines()
    at = [i for i, line in enumerate(lines) if line.startswith(" 24")]
    del lines[at[1] + 5 : at[1] + 7]  # last satellite of the second epoch
    event = [f"{'':28}4  1", f"{'antenna moved':<60}COMMENT"]
    raw = read("\n".join(lines[: at[1]] + event + lines[at[1] :]) + "\n")
    assert raw.report.dropped == {"event record (flag 2-6)": 1, "satellite announced by its epoch but not there": 1}
    assert [int(np.unique(raw.sat[raw.epoch == e]).size) for e in range(3)] == [3, 2, 3]


def test_compressed_files_read_the_same(tmp_path: Path) -> None:
    hatanaka = pytest.importorskip("hatanaka")
    text = HEAD + "".join(epoch(59 + k, gps(2, k), gps(7, k), glonass(3)) for k in range(5))
    (tmp_path / "plain.rnx").write_text(text)
    (tmp_path / "a.rnx.gz").write_bytes(gzip.compress(text.encode()))
    (tmp_path / "b.crx.gz").write_bytes(hatanaka.compress(text.encode(), compression="gz"))
    (tmp_path / "c.crx").write_bytes(hatanaka.rnx2crx(text.encode()))
    (tmp_path / "d.24o").write_bytes(text.replace("\n", "\r\n").encode())
    plain = read_observations(tmp_path / "plain.rnx")
    for name in ("a.rnx.gz", "b.crx.gz", "c.crx", "d.24o"):
        other = read_observations(tmp_path / name)
        for column in ("t_s", "epoch", "sat", "signal", "code_m", "phase_cyc", "doppler_hz", "cn0_dbhz", "lli"):
            np.testing.assert_array_equal(getattr(other, column), getattr(plain, column), err_msg=f"{name} {column}")


def test_broken_hatanaka_file_is_refused(tmp_path: Path) -> None:
    hatanaka = pytest.importorskip("hatanaka")
    packed = hatanaka.rnx2crx((HEAD + epoch(59, gps(2), gps(7)) + epoch(60, gps(2, 1), gps(7, 1))).encode())
    (tmp_path / "x.crx").write_bytes(packed.splitlines()[0] + b"\njunk\n")
    with pytest.raises(InputError, match=r"x\.crx: cannot be decompressed"):
        read_observations(tmp_path / "x.crx")


# Damage


def test_power_failure_is_a_slip_and_events_are_skipped(read: Callable[[str], RawObservations]) -> None:
    comment = f"{'new site':<60}COMMENT"
    text = (
        HEAD
        + epoch(59, gps(2))
        + epoch(60, comment, flag=4)
        + epoch(61, gps(2), flag=1)
        + epoch(61, gps(2), flag=6)
        + epoch(62, gps(2))
    )
    raw = read(text)
    assert raw.t_s.tolist() == [0.0, 2.0, 3.0]
    assert raw.lli.tolist() == [0, 0, 1, 1, 0, 0]
    assert raw.report.dropped == {"event record (flag 2-6)": 2}


def test_changed_types_inside_the_file_are_refused(read: Callable[[str], RawObservations]) -> None:
    change = f"{'G    2 C1C L1C':<60}SYS / # / OBS TYPES"
    with pytest.raises(InputError, match=r"obs\.rnx, line \d+: the observation types change"):
        read(HEAD + epoch(59, gps(2)) + epoch(60, change, flag=4) + epoch(61, gps(2)))
    same = f"{TYPES[1][0]:<60}SYS / # / OBS TYPES"
    assert len(read(HEAD + epoch(59, gps(2)) + epoch(60, same, flag=4) + epoch(61, gps(2))).t_s) == 2


def test_short_epochs_repeats_and_time_running_back(read: Callable[[str], RawObservations]) -> None:
    text = (
        HEAD
        + epoch(59, gps(2), gps(3), count=3)
        + epoch(60, gps(2), gps(3))
        + epoch(60, gps(2))
        + epoch(58, gps(2))
        + epoch(61, gps(2), gps(2, 9), gps(3))
        + epoch(62, gps(2), "G 9", "?05 123", "Gxx", count=4)
        + epoch(63, count=0)
        + epoch(64, gps(2), gps(3), count=1)
    )
    raw = read(text)
    assert raw.t_s.tolist() == [0.0, 1.0, 2.0, 3.0, 5.0]
    assert raw.report.dropped == {
        "satellite announced by its epoch but not there": 1,
        "epoch that repeats or goes back in time": 2,
        "satellite twice in one epoch": 2,  # rows: both bands
        "satellite unreadable": 1,
        "satellite of a system without observation types": 1,
        "epoch without a usable satellite": 1,
        "line beyond its epoch's satellites": 1,
    }
    assert raw.code_m[(raw.epoch == 2) & (raw.sat == 0)][0] == 21_002_000.0  # the first of the two


@pytest.mark.parametrize("cut", range(1, 130, 7))
def test_file_cut_anywhere_in_its_last_epoch_keeps_what_is_complete(read: Callable[[str], RawObservations], cut: int) -> None:
    whole = HEAD + epoch(59, gps(2), gps(3)) + epoch(60, gps(2), gps(3))
    raw = read(whole[:-cut])
    complete = raw.epoch == 0
    assert complete.sum() == 4
    true = np.array([21_002_000.0, 21_002_003.0, 21_003_000.0, 21_003_003.0])
    second = raw.code_m[raw.epoch == 1]
    assert np.isin(second[np.isfinite(second)], true).all()
    assert np.isin(raw.cn0_dbhz[np.isfinite(raw.cn0_dbhz)], [44.5, 38.25]).all()


def test_cut_number_and_missing_satellites_are_counted(read: Callable[[str], RawObservations]) -> None:
    whole = HEAD + epoch(59, gps(2), gps(3)) + epoch(60, gps(2), gps(3))
    assert read(whole[:-4]).report.dropped == {"number unreadable": 1}
    lost = read(whole[: whole.rindex("G03")])
    assert lost.report.dropped == {"satellite missing from the last epoch (file cut short)": 1}


@pytest.mark.parametrize("text", ["           nan", "   1.2.3      ", "  *************", "  12a45678.000", "     +-1.000  "])
def test_unreadable_numbers_are_absent_and_counted(read: Callable[[str], RawObservations], text: str) -> None:
    record = gps(2)
    raw = read(HEAD + epoch(59, record[:3] + text[:14].ljust(16) + record[19:], gps(3)))
    assert raw.report.dropped == {"number unreadable": 1}
    assert np.isnan(raw.code_m[0]) and raw.phase_cyc[0] == 1.1e8 + 2


@pytest.mark.parametrize(
    "bad", ["> 2024 13 29 23 59 58.0000000  0  1", "> 2024 02 29 23 59 xx.0000000  0  1", "> 2024 02 29 23 59 58.0  0"]
)
def test_unreadable_epochs_are_dropped_with_their_satellites(read: Callable[[str], RawObservations], bad: str) -> None:
    raw = read(HEAD + bad + "\n" + gps(2) + "\n" + epoch(59, gps(3)))
    assert raw.satellites == ("G03",) and sum(raw.report.dropped.values()) == 1


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "file is empty"),
        ("\n \n", "file is empty"),
        ("$GPGGA,1,2,3\n", "line 1: not a RINEX file"),
        (HEAD[: HEAD.index("TIME OF")], "ends inside the header"),
        (HEAD, "no epoch in the file"),
        (header(3.04, FIRST) + epoch(59, gps(2)), "declares no observation types"),
        (header(3.04, ("G    9 C1C L1C", "SYS / # / OBS TYPES")), "line 2: 9 observation types of G announced, 2 listed"),
        (header(2.11, ("     x    C1", "# / TYPES OF OBSERV")), "line 2: number of observation types 'x'"),
        (header(1.00, *TYPES), "version 1.00 is not supported"),
        (header(3.04, kind="N: GNSS NAV DATA"), "navigation file, expected an observation file"),
        (header(3.04, *TYPES) + epoch(59, "X02 1234"), "no usable observation"),
        (header(3.04, *TYPES) + "> 2024 13 40 99 99 99.0  0  1\n" + gps(2) + "\n", "no epoch"),
    ],
)
def test_unusable_files_are_refused_in_one_line(read: Callable[[str], RawObservations], text: str, says: str) -> None:
    with pytest.raises(InputError, match=says) as error:
        read(text)
    assert "obs.rnx" in str(error.value) and "\n" not in str(error.value)


def test_any_damage_raises_input_error_or_reads(read: Callable[[str], RawObservations]) -> None:
    rng = np.random.default_rng(11)
    for base in (HEAD + "".join(epoch(59 + k, gps(2), gps(7), glonass(3)) for k in range(3)), version_2(14, (57.0, 58.0))):
        clean = np.frombuffer(base.encode(), np.uint8)
        for _ in range(150):
            data = clean.copy()
            places = rng.integers(0, data.size, rng.integers(1, 12))
            data[places] = rng.choice(np.frombuffer(b"0123456789 .-+GRX>\n", np.uint8), places.size)
            try:
                raw = read(bytes(data[: rng.integers(1, data.size + 1)]).decode())
            except InputError:
                continue
            assert np.all(np.diff(raw.t_s) > 0) and len(raw.code_m) == len(raw.epoch) == raw.report.n_rows


def test_kernels_agree_with_python() -> None:
    rng = np.random.default_rng(5)
    texts = [f"{v:14.3f}" for v in rng.uniform(-1e9, 1e9, 200)] + ["           .500", "          7.", "-.25", " "]
    for text in texts:
        raw = np.frombuffer(text.encode(), np.uint8)
        value, found = kernels.fixed(raw, 0, raw.size)
        plain = kernels.fixed.py_func(raw, 0, raw.size)
        assert found == plain[1] and (value == plain[0] or found == kernels.BLANK)
        assert found == kernels.BLANK if not text.strip() else value == float(text)


# Streams and writers


def simulated(signals: tuple[str, ...], n_epochs: int = 5) -> tuple[GnssStream, GpsTime, Array]:
    """Noise-free observations at a fixed place with the built-in constellation, and that place."""
    t0 = GpsTime(2380, 345_600.0)
    navigation = builtin_constellation().shifted_to(t0)
    names = tuple(s for s in navigation.satellites if s[0] in {sig[0] for sig in signals})
    place = geodesy.ecef_from_geodetic(np.deg2rad(48.1), np.deg2rad(11.6), 540.0)
    lat, lon, h = geodesy.geodetic_from_ecef(place)
    columns: list[tuple[float, ...]] = []
    states = []
    for k in range(n_epochs):
        sat = np.arange(len(names))
        at = np.full(len(names), 30.0 * k)
        clock = 1e-4 + 1e-7 * k
        s, travel = navigation.states_seen_from(names, sat, t0, at - clock, np.broadcast_to(place, (len(names), 3)))
        los = (s.pos_ecef - place) / np.linalg.norm(s.pos_ecef - place, axis=1)[:, None]
        enu = los @ geodesy.C_en(lat, lon).T
        el, az = np.arcsin(enu[:, 2]), np.arctan2(enu[:, 0], enu[:, 1])
        tropo = atmosphere.troposphere_m(lat, h, el)
        iono = atmosphere.klobuchar_m(navigation.klobuchar, t0.sow + at, lat, lon, az, el)
        for i in np.flatnonzero(el > np.deg2rad(12)):
            for j, signal in enumerate(signals):
                if signal[0] == names[i][0]:
                    wave = wavelength_m(signal)
                    delay = navigation.group_delay_m(s.record[[i]], signals, np.array([j]))[0]
                    scaled = iono[i] * (wave / wavelength_m("G1C")) ** 2
                    clocks = C_MPS * clock - s.clock_m[i] + delay
                    code = travel[i] * C_MPS + clocks + tropo[i] + scaled
                    phase = (travel[i] * C_MPS + clocks + tropo[i] - scaled) / wave
                    columns.append((k, i, j, wave, code, phase, -1000.5 + i, 40.0 + j))
                    states.append((*s.pos_ecef[i], *s.vel_ecef[i], s.clock_m[i] - delay, s.clock_mps[i]))
    epoch_, sat_, signal_, wave_, code_, phase_, doppler_, cn0_ = (np.array(c) for c in zip(*columns, strict=True))
    state = np.array(states)
    lli = np.where(np.arange(epoch_.size) % 9 == 0, 1, 0)
    epoch_, sat_, signal_ = (c.astype(np.int64) for c in (epoch_, sat_, signal_))
    stream = GnssStream(
        30.0 * np.arange(n_epochs), epoch_, sat_, signal_, names, signals, wave_, code_, phase_, doppler_, cn0_, lli,
        state[:, :3], state[:, 3:6], state[:, 6], state[:, 7], place,
    )  # fmt: skip
    return stream, t0, place


ALL_SIGNALS = ("C2I", "C6I", "E1C", "E5Q", "G1C", "G2W", "J1C")


def test_written_observations_read_back_with_the_same_states(tmp_path: Path) -> None:
    stream, t0, place = simulated(ALL_SIGNALS)
    navigation = builtin_constellation().shifted_to(t0)
    write_observations(tmp_path / "o.rnx", stream, t0, marker="HILL", antenna_delta_m=(1.0, 0.0, 0.0), comments=("made up",))
    write_navigation(tmp_path / "n.rnx", navigation)
    raw = read_observations(tmp_path / "o.rnx")
    again, report = gnss_stream(raw, read_navigation([tmp_path / "n.rnx"]), t0)
    assert report.dropped == {} and raw.marker == "HILL"
    assert [again.satellites[i] for i in again.sat] == [stream.satellites[i] for i in stream.sat]
    assert [again.signals[i] for i in again.signal] == [stream.signals[i] for i in stream.signal]
    for column, digits in (
        ("t_s", 1e-7),
        ("code_m", 5.1e-4),
        ("phase_cyc", 5.1e-4),
        ("doppler_hz", 5.1e-4),
        ("cn0_dbhz", 5.1e-4),
    ):
        np.testing.assert_allclose(getattr(again, column), getattr(stream, column), rtol=0, atol=digits, err_msg=column)
    np.testing.assert_array_equal(again.lli, stream.lli)
    np.testing.assert_allclose(again.wavelength_m, stream.wavelength_m, rtol=1e-12)
    np.testing.assert_allclose(again.sat_pos_ecef, stream.sat_pos_ecef, atol=1e-3)
    np.testing.assert_allclose(again.sat_vel_ecef, stream.sat_vel_ecef, atol=1e-5)
    np.testing.assert_allclose(again.sat_clock_m, stream.sat_clock_m, atol=1e-5)
    np.testing.assert_allclose(raw.approx_ecef, place, atol=1e-4)


@pytest.mark.parametrize("system", ["G", "E", "C"])
def test_rtklib_finds_the_place_in_written_files(tmp_path: Path, system: str) -> None:
    """Satellite clocks, group delays, atmosphere and the files themselves: a wrong sign of a group delay alone gives metres."""
    program = shutil.which("rnx2rtkp")
    if program is None:
        pytest.skip("RTKLIB's rnx2rtkp is not installed")
    stream, t0, place = simulated(ALL_SIGNALS, 2)
    write_observations(tmp_path / "o.rnx", stream, t0, np.zeros(3))
    write_navigation(tmp_path / "n.rnx", builtin_constellation().shifted_to(t0))
    options = {
        "pos1-posmode": "single", "pos1-navsys": {"G": 1, "E": 8, "C": 32}[system], "pos1-elmask": 10, "pos1-ionoopt": "brdc",
        "pos1-tropopt": "saas", "out-solformat": "xyz", "pos1-frequency": "l1",
    }  # fmt: skip
    (tmp_path / "c.conf").write_text("".join(f"{k}={v}\n" for k, v in options.items()))
    command = [
        program,
        "-k",
        str(tmp_path / "c.conf"),
        "-o",
        str(tmp_path / "out.pos"),
        str(tmp_path / "o.rnx"),
        str(tmp_path / "n.rnx"),
    ]
    subprocess.run(command, check=True, capture_output=True, timeout=60)
    rows = [line.split() for line in (tmp_path / "out.pos").read_text().splitlines() if not line.startswith("%")]
    assert len(rows) == 2
    for row in rows:
        error = np.array([float(v) for v in row[2:5]]) - place
        assert np.linalg.norm(error) < 0.01, error


def test_selection_and_time_base(read: Callable[[str], RawObservations]) -> None:
    stream, t0, _ = simulated(ALL_SIGNALS, 2)
    navigation = builtin_constellation().shifted_to(t0)
    raw = read(HEAD + epoch(59, gps(2), glonass(3)))
    with pytest.raises(InputError, match="no observation of E"):
        gnss_stream(raw, navigation, raw.t0, systems="E")
    only, report = gnss_stream(raw, navigation, raw.t0 + -10.0, signals=("G2W",))
    assert only.signals == ("G2W",) and only.satellites == ("G02",) and only.t_s.tolist() == [10.0]
    assert report.dropped == {"system or signal not used": 2}
    assert any("without satellite state (G02)" in note for note in report.notes)  # messages of another year
    assert np.isnan(only.sat_clock_m).all() and stream.n_rows > 0
