"""Broadcast navigation: orbits and clocks against RTKLIB, formats, the built-in constellation."""

from __future__ import annotations

import gzip
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from factorgraph import geodesy
from factorgraph.errors import InputError
from factorgraph.geodesy import C_MPS
from factorgraph.gpstime import GpsTime
from factorgraph.types import Array
from scenarios.flights import _orbits as orbits
from scenarios.flights.constellation import nominal_constellation
from scenarios.flights.navigation import CONSTELLATION, Navigation, builtin_constellation, read_navigation, turned_range
from scenarios.flights.rinex_writer import write_navigation
from tests.helpers import shared_data

GLONASS = """\
     3.04           N: GNSS NAV DATA    R                   RINEX VERSION / TYPE
                                                            END OF HEADER
R03 2021 09 22 06 15 00 1.376681029800E-05-4.547473508860E-12 2.838000000000E+05
     1.575949218750E+04-1.455663681030E+00 9.313225746150E-10 0.000000000000E+00
    -8.137114746090E+03 2.050067901610E+00 9.313225746150E-10 5.000000000000E+00
     1.834133984380E+04 2.153884887700E+00-1.862645149230E-09 1.000000000000E+00
R11 2021 09 22 06 15 00-1.376681029800E-04 9.094947017730E-13 2.838000000000E+05
    -1.575949218750E+04 1.455663681030E+00 0.000000000000E+00 1.000000000000E+00
     8.137114746090E+03-2.050067901610E+00 9.313225746150E-10-7.000000000000E+00
     1.834133984380E+04 2.153884887700E+00-1.862645149230E-09 1.000000000000E+00
"""


def sats(navigation: Navigation) -> tuple[tuple[str, ...], np.ndarray[tuple[int], np.dtype[np.int64]]]:
    return navigation.satellites, np.arange(len(navigation.satellites))


@pytest.fixture
def rtklib() -> Iterator[ModuleType]:
    module = pytest.importorskip("pyrtklib5")
    before = module.getseleph(module.SYS_GAL)
    module.setseleph(module.SYS_GAL, 1)  # I/NAV, as here
    yield module
    module.setseleph(module.SYS_GAL, before)


def rtklib_states(rtklib: ModuleType, path: Path, names: tuple[str, ...], at: GpsTime) -> Array:
    """Position, velocity, clock and clock rate (n, 8) in metres; NaN where RTKLIB has none or finds it unhealthy."""
    nav = rtklib.nav_t()
    assert rtklib.readrnx(str(path), 1, "", rtklib.obs_t(), nav, rtklib.sta_t()) > 0
    time = rtklib.gpst2time(at.week, at.sow)
    out = np.full((len(names), 8), np.nan)
    for i, name in enumerate(names):
        rs, dts, var, svh = rtklib.Arr1Ddouble(6), rtklib.Arr1Ddouble(2), rtklib.Arr1Ddouble(1), rtklib.Arr1Dint(1)
        if rtklib.satpos(time, time, rtklib.satid2no(name), 0, nav, rs, dts, var, svh) and svh[0] == 0:
            out[i] = [*(rs[k] for k in range(6)), dts[0] * C_MPS, dts[1] * C_MPS]
    return out


def assert_agrees(rtklib: ModuleType, path: Path, at: GpsTime, at_least: int) -> None:
    navigation = read_navigation([path])
    names, index = sats(navigation)
    ours = navigation.states_at(names, index, at, np.zeros(len(names)))
    theirs = rtklib_states(rtklib, path, names, at)
    both = np.isfinite(theirs[:, 6]) & np.isfinite(ours.clock_m)
    assert both.sum() >= at_least
    np.testing.assert_allclose(ours.pos_ecef[both], theirs[both, :3], atol=1e-5, rtol=0)
    # RTKLIB differences over 1 ms: half the acceleration, 0.3 mm/s
    np.testing.assert_allclose(ours.vel_ecef[both], theirs[both, 3:6], atol=1e-3, rtol=0)
    np.testing.assert_allclose(ours.clock_m[both], theirs[both, 6], atol=1e-5, rtol=0)
    np.testing.assert_allclose(ours.clock_mps[both], theirs[both, 7], atol=1e-4, rtol=0)


@pytest.mark.parametrize(
    ("file", "at", "at_least"),
    [
        ("cssrlib_kin_2021_265/SEPT2650.21P", GpsTime(2176, 282_600.3), 20),
        ("cssrlib_kin_2021_265/SEPT2650.21P", GpsTime(2176, 286_111.7), 20),
        ("cssrlib_static_2021_078/SEPT078M.21P", GpsTime(2149, 475_230.25), 20),
        ("ixr_tokyo_car/base_GQ_L1_20201105.nav", GpsTime(2130, 367_000.1), 10),
    ],
)
def test_recorded_messages_agree_with_rtklib(rtklib: ModuleType, file: str, at: GpsTime, at_least: int) -> None:
    assert_agrees(rtklib, shared_data(file), at, at_least)


@pytest.mark.parametrize("offset_s", [-3000.3, 0.0, 14.0, 5400.7])
def test_every_system_and_beidou_orbit_type_agrees_with_rtklib(rtklib: ModuleType, offset_s: float) -> None:
    at = builtin_constellation().t_ref + (float(builtin_constellation().kepler.toe_s[-1]) + offset_s)
    assert_agrees(rtklib, CONSTELLATION, at, 84 if offset_s > 0 else 60)  # RTKLIB uses no Galileo orbit before its toe


@pytest.mark.parametrize("offset_s", [-870.0, -30.5, 0.0, 59.9, 890.0])
def test_glonass_agrees_with_rtklib(rtklib: ModuleType, tmp_path: Path, offset_s: float) -> None:
    path = tmp_path / "glo.rnx"
    path.write_text(GLONASS)
    assert_agrees(rtklib, path, GpsTime.from_calendar(2021, 9, 22, 6, 15, 18) + offset_s, 1)


def test_glonass_channel_health_and_age(tmp_path: Path) -> None:
    path = tmp_path / "glo.rnx"
    path.write_text(GLONASS)
    navigation = read_navigation([path])
    assert navigation.glonass_channels == {"R03": 5, "R11": -7}
    t = GpsTime.from_calendar(2021, 9, 22, 6, 15, 18)
    states = navigation.states_at(("R03", "R11", "R09"), np.array([0, 1, 2, 0]), t, np.array([0.0, 0.0, 0.0, 1900.0]))
    assert np.isfinite(states.clock_m).tolist() == [True, False, False, False]


def test_velocity_and_clock_rate_are_derivatives() -> None:
    navigation = builtin_constellation()
    names, index = sats(navigation)
    t0, h = navigation.t_ref + (float(navigation.kepler.toe_s[0]) + 1000.0), 0.5
    before, now, after = (navigation.states_at(names, index, t0, np.full(len(names), dt)) for dt in (-h, 0.0, h))
    np.testing.assert_allclose((after.pos_ecef - before.pos_ecef) / (2 * h), now.vel_ecef, atol=1e-5)
    np.testing.assert_allclose((after.clock_m - before.clock_m) / (2 * h), now.clock_mps, atol=1e-6)


def test_transmission_time_from_position_and_from_code_agree() -> None:
    navigation = builtin_constellation()
    names, index = sats(navigation)
    t0 = navigation.t_ref + float(navigation.kepler.toe_s[-1])
    receiver = geodesy.ecef_from_geodetic(0.6, 2.1, 50.0)
    r = np.broadcast_to(receiver, (len(names), 3))
    seen, travel = navigation.states_seen_from(names, index, t0, np.full(len(names), 100.0), r)
    clock_u_s = 3e-4  # the receiver's tag and code both hold its clock
    code = travel * C_MPS + clock_u_s * C_MPS - seen.clock_m
    found = navigation.satellite_states(names, index, t0, 100.0 + clock_u_s - code / C_MPS)
    np.testing.assert_allclose(found.pos_ecef, seen.pos_ecef, atol=2e-5)  # relativity is not in a satellite's reading
    np.testing.assert_allclose(turned_range(found.pos_ecef, r), travel * C_MPS, atol=2e-5)


def test_states_are_absent_without_a_message() -> None:
    navigation = builtin_constellation()
    t0 = navigation.t_ref + float(navigation.kepler.toe_s[-1])
    age = orbits.MAX_AGE_S["G"]
    at = np.array([age - 10, age + 10, np.nan, 0.0])
    got = navigation.states_at(("G01", "G40"), np.array([0, 0, 0, 1]), t0, at)
    assert np.isfinite(got.pos_ecef[:, 0]).tolist() == [True, False, False, False]
    assert np.isnan(got.clock_m[1:]).all() and got.record[3] == -1


def test_group_delays_follow_the_messages() -> None:
    navigation = builtin_constellation()
    record = {name: i for i, name in enumerate(navigation.kepler.satellites)}

    def delay_s(signal: str, satellite: str) -> float:
        return float(navigation.group_delay_m(np.array([record[satellite]]), (signal,), np.array([0]))[0]) / C_MPS

    gps, gal, bds = (navigation.kepler.data[record[s]] for s in ("G05", "E07", "C20"))
    assert delay_s("G1C", "G05") == pytest.approx(gps[25], abs=1e-18)
    assert delay_s("G2W", "G05") == pytest.approx(gps[25] * (1575.42 / 1227.6) ** 2, abs=1e-18)
    # the ionosphere-free combination of its own pair sees the message clock undelayed
    f1, f7 = 1575.42**2, 1207.14**2
    assert f1 * delay_s("E1C", "E07") - f7 * delay_s("E7Q", "E07") == pytest.approx(0.0, abs=1e-9)
    assert delay_s("E1C", "E07") == pytest.approx(gal[26], abs=1e-18)
    f5 = 1176.45**2
    own_clock = gal[26] - gal[25]  # F/NAV clock - I/NAV clock, from the same E1
    free_5 = (f1 * delay_s("E1C", "E07") - f5 * delay_s("E5Q", "E07")) / (f1 - f5)
    assert free_5 == pytest.approx(own_clock, abs=1e-15)
    assert delay_s("C2I", "C20") == pytest.approx(bds[25], abs=1e-18)
    assert delay_s("C6I", "C20") == 0.0


def test_glonass_group_delay_is_rtklibs(tmp_path: Path) -> None:
    path = tmp_path / "glo.rnx"
    with_delay = GLONASS.replace("     3.04 ", "     3.05 ")
    fourth = "     0.000000000000E+00 5.587935447690E-09 0.000000000000E+00 0.000000000000E+00\n"
    path.write_text(with_delay.replace("R11", fourth + "R11") + fourth)
    navigation = read_navigation([path])
    got = navigation.group_delay_m(np.array([0, 0]), ("R1C", "R2C"), np.array([0, 1]))
    gamma = (1602.0 / 1246.0) ** 2
    np.testing.assert_allclose(got, -C_MPS * 5.58793544769e-9 / (gamma - 1) * np.array([1, gamma]), rtol=1e-12)


def test_builtin_file_is_what_its_generator_makes() -> None:
    built, made = builtin_constellation(), nominal_constellation()
    assert built.kepler.satellites == made.kepler.satellites
    np.testing.assert_allclose(built.kepler.data, np.nan_to_num(made.kepler.data), rtol=1e-11, atol=1e-25)
    assert built.klobuchar is not None and made.klobuchar is not None
    np.testing.assert_allclose(built.klobuchar, made.klobuchar, rtol=1e-4)


@pytest.mark.parametrize("lat_deg", [-75.0, -35.0, 0.0, 48.0, 80.0])
def test_builtin_sky_suffices_everywhere_and_always(lat_deg: float) -> None:
    navigation = builtin_constellation()
    names, index = sats(navigation)
    t0 = GpsTime(2500, 601_234.5)  # crosses the week's end
    moved = navigation.shifted_to(t0, 12 * 3600.0)
    for hours in range(0, 13, 3):
        states = moved.states_at(names, index, t0, np.full(len(names), 3600.0 * hours))
        assert np.isfinite(states.clock_m).all()
        for lon_deg in (-150.0, 10.0, 110.0):
            lat, lon = np.deg2rad(lat_deg), np.deg2rad(lon_deg)
            los = states.pos_ecef - geodesy.ecef_from_geodetic(lat, lon, 0.0)
            up = los @ geodesy.C_en(lat, lon)[2] / np.linalg.norm(los, axis=1) > np.sin(np.deg2rad(5.0))
            count = {s: int(sum(up[i] for i in index if names[i][0] == s)) for s in "GEC"}
            assert count["G"] >= 5 and count["E"] >= 5 and count["C"] >= 5, count


def test_shifting_keeps_the_sky_and_joins_issues_smoothly() -> None:
    navigation = builtin_constellation()
    names, index = sats(navigation)
    n, old = len(names), navigation.t_ref + float(navigation.kepler.toe_s[-1])
    new = GpsTime(2399, 3600.0)
    moved = navigation.shifted_to(new + 3600.0, 7 * 3600.0)
    at_old = navigation.states_at(names, index, old, np.zeros(n))
    at_new = moved.states_at(names, index, new, np.zeros(n))
    np.testing.assert_allclose(at_new.pos_ecef, at_old.pos_ecef, atol=1e-3)
    for switch in (3600.0, 7200.0, 7214.0, 10_800.0):
        a, b = (moved.states_at(names, index, new, np.full(n, switch + dt)) for dt in (-5e-3, 5e-3))
        np.testing.assert_allclose(b.pos_ecef - a.pos_ecef, 0.5e-2 * (a.vel_ecef + b.vel_ecef), atol=1e-5)
        np.testing.assert_allclose(b.clock_m - a.clock_m, 1e-2 * a.clock_mps, atol=1e-7)


def test_written_messages_read_back(tmp_path: Path) -> None:
    glo = tmp_path / "glo.rnx"
    glo.write_text(GLONASS)
    navigation = read_navigation([CONSTELLATION, glo])
    write_navigation(tmp_path / "out.rnx", navigation)
    again = read_navigation([tmp_path / "out.rnx"])
    assert again.kepler.satellites == navigation.kepler.satellites and again.glonass.satellites == ("R03", "R11")
    np.testing.assert_array_equal(np.nan_to_num(again.kepler.data), np.nan_to_num(navigation.kepler.data))
    np.testing.assert_array_equal(again.glonass.data[:, :15], navigation.glonass.data[:, :15])
    shift = navigation.t_ref - again.t_ref
    np.testing.assert_allclose(again.kepler.toe_s, navigation.kepler.toe_s + shift)
    np.testing.assert_allclose(again.glonass.toe_s, navigation.glonass.toe_s + shift)


def record_lines(satellite: str) -> list[str]:
    lines = CONSTELLATION.read_text().splitlines()
    at = next(i for i, line in enumerate(lines) if line.startswith(satellite))
    return lines[at : at + 8]


def test_versions_2_and_4_hold_the_same_orbit(tmp_path: Path) -> None:
    v3 = record_lines("G07")
    v2 = [
        "     2.11           N: GPS NAV DATA                         RINEX VERSION / TYPE",
        "    1.1176D-08  7.4506D-09 -5.9605D-08 -5.9605D-08          ION ALPHA",
        "    9.0112D+04  1.6384D+04 -1.9661D+05 -6.5536D+04          ION BETA",
        "                                                            END OF HEADER",
        " 7 26  1  7 12  0  0.0" + v3[0][23:].replace("E", "D"),
        *(line[1:].replace("E", "D") for line in v3[1:]),
    ]
    v4 = [
        "     4.00           NAVIGATION DATA     M                   RINEX VERSION / TYPE",
        "                                                            END OF HEADER",
        "> STO G07 LNAV",
        "    2026 01 07 12 00 00 GPUT UTC(USNO)",
        "     3.000000000000E+05 0.000000000000E+00 0.000000000000E+00 0.000000000000E+00",
        "> ION G07 LNAV",
        "    2026 01 07 12 00 00 1.117600000000E-08 7.450600000000E-09-5.960500000000E-08",
        "    -5.960500000000E-08 9.011200000000E+04 1.638400000000E+04-1.966100000000E+05",
        "    -6.553600000000E+04 0.000000000000E+00",
        "> EPH G07 LNAV",
        *v3,
        "> EPH G08 CNAV",
        *record_lines("G08"),
        " " * 4 + "0.000000000000E+00",
    ]
    navigations = []
    for name, lines in (("a.26n", v2), ("b.rnx", v4)):
        (tmp_path / name).write_text("\n".join(lines) + "\n")
        navigations.append(read_navigation([tmp_path / name]))
    assert navigations[1].report.dropped == {"message type CNAV not used": 1}
    reference = builtin_constellation()
    row = reference.kepler.satellites.index("G07")
    for navigation in navigations:
        assert navigation.kepler.satellites == ("G07",)
        np.testing.assert_array_equal(np.nan_to_num(navigation.kepler.data[0]), reference.kepler.data[row])
        np.testing.assert_allclose(navigation.klobuchar, reference.klobuchar)


def test_compressed_file_and_dropped_records(tmp_path: Path) -> None:
    lines = CONSTELLATION.read_text().splitlines()
    body = next(i for i, line in enumerate(lines) if "END OF HEADER" in line) + 1
    lines[body + 2] = lines[body + 2].replace("E", "x", 1)  # C01, a number
    lines[body + 8] = "C02 2026 13 07 12" + lines[body + 8][17:]
    path = tmp_path / "brdc.rnx.gz"
    path.write_bytes(gzip.compress("\n".join(lines[:-3]).encode()))
    navigation = read_navigation([path, CONSTELLATION, CONSTELLATION])
    assert len(navigation.kepler.satellites) == 84
    dropped = navigation.report.dropped
    assert dropped["number missing or unreadable"] == 1
    assert dropped["satellite or epoch unreadable"] == 1
    assert dropped["record cut short"] == 1
    assert dropped["duplicate message"] == 81 + 84
    assert any(note.startswith("line ") for note in navigation.report.notes)


HEADER = "     3.04           N: GNSS NAV DATA    M                   RINEX VERSION / TYPE\n"
END = " " * 60 + "END OF HEADER\n"


@pytest.mark.parametrize(
    ("content", "says"),
    [
        ("", "empty"),
        ("hello\nworld\n", "line 1: not a RINEX file"),
        (HEADER, "ends inside the header"),
        (HEADER.replace("3.04", "5.00") + END, "version 5.00 is not supported"),
        (HEADER.replace("3.04", "x.04") + END, "is not a number"),
        (HEADER.replace("N: GNSS NAV DATA", "OBSERVATION DATA") + END, "observation file, expected a navigation file"),
        (HEADER + END, "no usable navigation message"),
        (HEADER + END + "G01 2026 01 07\n", "record cut short"),
    ],
)
def test_unusable_files_are_refused_in_one_line(tmp_path: Path, content: str, says: str) -> None:
    path = tmp_path / "bad.rnx"
    path.write_text(content)
    with pytest.raises(InputError, match=says) as error:
        read_navigation([path])
    assert "bad.rnx" in str(error.value) and "\n" not in str(error.value)


def test_absent_and_broken_archives_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cannot be read"):
        read_navigation([tmp_path / "none.rnx"])
    broken = tmp_path / "x.rnx.gz"
    broken.write_bytes(gzip.compress(CONSTELLATION.read_bytes())[:500])
    with pytest.raises(InputError, match="broken gzip"):
        read_navigation([broken])
    broken.write_bytes(b"\x1f\x9d\x90garbage")
    with pytest.raises(InputError, match=r"x\.rnx\.gz"):
        read_navigation([broken])
