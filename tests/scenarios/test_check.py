"""`relnav check`: what the tables say about flights with known faults."""

from __future__ import annotations

import dataclasses
import io
import json
from pathlib import Path

import numpy as np
from rich.console import Console

from factorgraph.measurements import GnssStream
from scenarios.flights import LoadedFlight, load
from scenarios.flights.check import Cell, as_json, check, nominal_interval_s, render
from tests.helpers import wheel_file
from tests.scenarios.flight_files import FLIGHT, resting_imu, write_flight


def _tables(flight: LoadedFlight) -> dict[str, list[dict[str, Cell]]]:
    return as_json(check(flight))


def test_gaps_rates_and_dropped_rows(tmp_path: Path) -> None:
    imu = np.delete(resting_imu(), slice(50, 80), axis=0)
    imu[10, 1] = np.nan
    tables = _tables(load(write_flight(tmp_path, imu=imu)))
    sensor = next(row for row in tables["sensors"] if row["sensor"] == "uav imu")
    assert sensor["rate Hz"] == 10.0 and sensor["samples"] == 169 and sensor["gaps"] == 1
    assert tables["gaps"] == [{"sensor": "uav imu", "from s": 4.9, "to s": 8.0, "length s": 3.1}]
    reading = next(row for row in tables["reading"] if row["source"] == "imu.csv")
    assert reading["dropped"] == "1 with empty or non-numeric cells"


def test_common_time_of_two_vehicles(tmp_path: Path) -> None:
    second = (
        FLIGHT.split("[[vehicle]]")[1].replace('"uav"', '"other"').replace('time = "t"', 'time = { column = "t", offset_s = 3 }')
    )
    tables = _tables(load(write_flight(tmp_path, FLIGHT + "[[vehicle]]" + second)))
    assert tables["overlaps"] == [{"first": "uav", "second": "other", "from s": 3.0, "to s": 19.9, "length s": 16.9}]


def _broken(stream: GnssStream) -> GnssStream:
    """Loss-of-lock flags, one slip of 40 cycles, a millisecond jump of code, and one of the tags."""
    phase, code, lli, t_s = stream.phase_cyc.copy(), stream.code_m.copy(), stream.lli.copy(), stream.t_s.copy()
    row = np.flatnonzero((stream.signal == stream.signals.index("G1C")) & np.isfinite(phase) & (stream.epoch == 20))[0]
    same = (stream.sat == stream.sat[row]) & (stream.signal == stream.signal[row])
    phase[same & (stream.epoch >= 20)] += 40.0
    lli[same & (stream.epoch == 30)] |= 1
    code[stream.epoch >= 40] += 299_792.458
    t_s[50:] += 1e-3
    return dataclasses.replace(stream, phase_cyc=phase, code_m=code, lli=lli, t_s=t_s)


def test_slips_and_clock_jumps_are_counted() -> None:
    wheel_file("cssrlib", "data/SEPT078M1.21O")
    clean = load("cssrlib-static")
    rover = clean.problem.vehicle("rover")
    assert rover.gnss is not None
    antenna = dataclasses.replace(rover.gnss, stream=_broken(rover.gnss.stream))
    vehicles = (clean.problem.vehicles[0], dataclasses.replace(rover, gnss=antenna))
    broken = LoadedFlight(dataclasses.replace(clean.problem, vehicles=vehicles), clean.reports)

    def counted(flight: LoadedFlight) -> tuple[dict[str, Cell], dict[str, Cell]]:
        tables = _tables(flight)
        slips = next(r for r in tables["slips"] if r["receiver"] == "rover" and r["system"] == "G")
        return slips, next(r for r in tables["clocks"] if r["receiver"] == "rover")

    before, clock_before = counted(clean)
    after, clock_after = counted(broken)
    for key, n in (("loss of lock", 1), ("geometry-free", 1)):
        a, b = after[key], before[key]
        assert isinstance(a, int) and isinstance(b, int) and a - b >= n, key
    assert after["geometry-free"] != before["geometry-free"]
    assert [clock_before[k] for k in ("code jumps", "code against phase jumps", "time tag jumps")] == [0, 0, 0]
    assert [clock_after[k] for k in ("code jumps", "code against phase jumps", "time tag jumps")] == [1, 1, 1]


def test_satellites_and_links_of_a_gnss_flight() -> None:
    wheel_file("cssrlib", "data/SEPT078M1.21O")
    tables = _tables(load("cssrlib-static"))
    l1 = next(r for r in tables["satellites"] if r["receiver"] == "base" and r["signal"] == "G1C")
    assert isinstance(l1["satellites"], int) and l1["satellites"] >= 7 and l1["no ephemeris"] == 0
    link = tables["links"][0]
    assert link["common epochs"] == 60 and isinstance(link["common satellites"], int) and link["common satellites"] > 10


def test_rendering_and_json(tmp_path: Path) -> None:
    tables = check(load(write_flight(tmp_path)))
    out = io.StringIO()
    Console(file=out, width=100).print(render(tables))
    assert "Sensors" in out.getvalue() and "uav imu" in out.getvalue()
    assert json.loads(json.dumps(as_json(tables), allow_nan=False))["sensors"][0]["samples"] == 200
    assert np.isnan(nominal_interval_s(np.zeros(1)))
