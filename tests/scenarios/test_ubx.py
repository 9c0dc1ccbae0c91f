"""u-blox logs: frames, fixes, raw observations and broadcast messages."""

from __future__ import annotations

import struct
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pyubx2 import UBXReader

from factorgraph.errors import InputError
from factorgraph.geodesy import C_MPS, LocalFrame
from factorgraph.gpstime import GpsTime
from factorgraph.models.gnss import single_point
from factorgraph.problem import GnssNoise
from scenarios.flights import _orbits as orbits
from scenarios.flights import _ubx_navigation as messages
from scenarios.flights.load import load
from scenarios.flights.navigation import builtin_constellation, read_navigation
from scenarios.flights.rinex import gnss_stream
from scenarios.flights.rtklib_pos import read_pos
from scenarios.flights.ubx import NAV_PVT, RXM_RAWX, RXM_SFRBX, read_ubx, read_ubx_fixes
from scenarios.flights.ubx_observations import read_ubx_observations
from tests.helpers import shared_data

T0 = GpsTime(2381, 408_639.0)
NMEA = b"$GNGLL,4005.80150,N,10508.82999,W,173021.75,A,D*6B\r\n"


def frame(kind: bytes, payload: bytes) -> bytes:
    body = kind + struct.pack("<H", len(payload)) + payload
    a = b = 0
    for byte in body:
        a = a + byte & 255
        b = b + a & 255
    return b"\xb5\x62" + body + bytes((a, b))


def pvt(second: int = 21, **changes: Any) -> bytes:
    """NAV-PVT of 2025-08-28 17:30:second UTC, RTK fixed."""
    values = {
        "year": 2025, "month": 8, "day": 28, "hour": 17, "minute": 30, "valid": 7, "nano": -250_000_000, "fix": 3, "flags": 0x83,
        "n_sat": 25, "lon": -1_051_471_665, "lat": 400_966_916, "height": 1_580_048, "h_acc": 14, "v_acc": 10, "vel_n": 1000,
        "vel_e": -2000, "vel_d": 300, "s_acc": 70,
    } | changes  # fmt: skip
    v = values
    return (
        struct.pack("<IHBBBBBB", 0, v["year"], v["month"], v["day"], v["hour"], v["minute"], second, v["valid"])
        + struct.pack("<IiBBBB", 21, v["nano"], v["fix"], v["flags"], 0, v["n_sat"])
        + struct.pack("<iiiiII", v["lon"], v["lat"], v["height"], 1_601_435, v["h_acc"], v["v_acc"])
        + struct.pack("<iiiiiII", v["vel_n"], v["vel_e"], v["vel_d"], 2236, 0, v["s_acc"], 0)
        + bytes(92 - 76)
    )


@dataclass
class Seen:
    """One measurement of RXM-RAWX."""

    gnss: int = 0
    number: int = 10
    signal: int = 0
    code: float = 2.1e7
    phase: float = 1.1e8
    doppler: float = 794.75
    channel: int = 0
    lock_ms: int = 64_500
    cn0: int = 45
    phase_sd: int = 1
    status: int = 7

    def pack(self) -> bytes:
        return struct.pack(
            "<ddfBBBBHBBBBBx", self.code, self.phase, self.doppler, self.gnss, self.number, self.signal, self.channel,
            self.lock_ms, self.cn0, 3, self.phase_sd, 5, self.status,
        )  # fmt: skip


@dataclass
class Log:
    """A log on disk, made of payloads."""

    folder: Path
    parts: list[bytes] = field(default_factory=list)

    def epoch(self, t_s: float, *seen: Seen) -> Log:
        head = struct.pack("<dHbBBB2x", T0.sow + t_s, T0.week, 18, len(seen), 1, 1)
        self.parts.append(frame(RXM_RAWX, head + b"".join(s.pack() for s in seen)))
        return self

    def words(self, gnss: int, number: int, signal: int, words: list[int]) -> Log:
        head = bytes((gnss, number, signal, 0, len(words), 1, 2, 0))
        self.parts.append(frame(RXM_SFRBX, head + struct.pack(f"<{len(words)}I", *words)))
        return self

    def write(self, data: bytes | None = None) -> Path:
        path = self.folder / "log.ubx"
        path.write_bytes(b"".join(self.parts) if data is None else data)
        return path


@pytest.fixture
def log(tmp_path: Path) -> Log:
    return Log(tmp_path)


def test_measurements_are_those_of_pyubx2(log: Log) -> None:
    seen = [
        Seen(),
        Seen(0, 18, 7, 2.2e7, 8.6e7, -1992.5),
        Seen(2, 14, 0, status=1),
        Seen(3, 21, 4, 2.3e7),
        Seen(6, 2, 0, 2.0e7, 1.07e8, channel=8),
        Seen(5, 3, 0, 3.7e7),
        Seen(1, 131, 0, 3.8e7, phase_sd=15),
    ]
    raw = read_ubx_observations(log.epoch(0.748, *seen).write())
    assert raw.t0 == T0 and raw.t_s.tolist() == pytest.approx([0.748])
    assert raw.satellites == ("C21", "E14", "G10", "G18", "J03", "R02", "S31")
    parsed = UBXReader.parse(log.parts[0])
    where = {(raw.satellites[s], raw.signals[k]): i for i, (s, k) in enumerate(zip(raw.sat, raw.signal, strict=True))}
    names = [("G10", "G1C"), ("G18", "G5Q"), ("E14", "E1C"), ("C21", "C6I"), ("R02", "R1C"), ("J03", "J1C"), ("S31", "S1C")]
    for n, name in enumerate(names, start=1):
        i = where[name]
        assert raw.code_m[i] == getattr(parsed, f"prMes_{n:02d}") and raw.doppler_hz[i] == getattr(parsed, f"doMes_{n:02d}")
        assert raw.cn0_dbhz[i] == getattr(parsed, f"cno_{n:02d}")
        if name[0] in ("E14", "S31"):  # without valid phase, without its deviation
            assert np.isnan(raw.phase_cyc[i])
        else:
            assert raw.phase_cyc[i] == getattr(parsed, f"cpMes_{n:02d}")
    assert raw.wavelength_m[where[("R02", "R1C")]] == pytest.approx(C_MPS / (1602e6 + 0.5625e6))


def test_loss_of_lock_and_open_half_cycles(log: Log) -> None:
    half_open, taken_off = 3, 15
    states = [(64_500, 7), (64_500, 7), (200, 7), (450, 7), (700, half_open), (950, taken_off), (1200, taken_off)]
    states += [(90, 1), (1700, taken_off)]
    for i, (lock, status) in enumerate(states):
        log.epoch(0.25 * i, Seen(lock_ms=lock, status=status), Seen(number=11))
    raw = read_ubx_observations(log.write())
    mine = raw.lli[raw.sat == raw.satellites.index("G10")]
    # restart; half cycle lost; settled; an epoch without phase has no indicator; after it the lock is old enough
    assert mine.tolist() == [0, 0, 1, 0, 3, 1, 0, 0, 0]
    assert not raw.lli[raw.sat == raw.satellites.index("G11")].any()


def test_a_lock_younger_than_the_gap_is_a_loss(log: Log) -> None:
    for t_s, lock_ms in ((0.0, 300), (5.0, 4000), (9.0, 8000)):
        log.epoch(t_s, Seen(lock_ms=lock_ms))
    raw = read_ubx_observations(log.write())
    assert raw.lli.tolist() == [0, 1, 0]


def test_what_cannot_be_used_is_counted(log: Log) -> None:
    log.epoch(0.0, Seen(), Seen(6, 255, 0), Seen(0, 3, 9), Seen(number=4, status=0), Seen())
    log.epoch(1.0, Seen()).epoch(0.5, Seen()).epoch(float("nan"), Seen())
    log.parts.append(frame(RXM_RAWX, bytes(20)))
    raw = read_ubx_observations(log.write())
    assert len(raw.t_s) == 2 and raw.report.n_rows == 2
    assert raw.report.dropped == {
        "measurement of an unknown satellite or signal": 2,
        "measurement without code and phase": 1,
        "satellite and signal twice in one epoch": 1,
        "epoch that repeats or goes back in time": 2,
        "RXM-RAWX of a wrong length": 1,
    }


def test_broken_frames_cost_only_themselves(log: Log) -> None:
    for i in range(6):
        log.epoch(float(i), Seen(), Seen(number=11))
    frames = log.parts
    damaged = bytearray(frames[2])
    damaged[30] ^= 1
    false_start = b"\xb5\x62\x02\x15\xff\x0f" + bytes(3)  # promises 4095 bytes
    data = NMEA + frames[0] + frames[1] + bytes(damaged) + NMEA + frames[3] + false_start + frames[4] + frames[5][:-20]
    found = read_ubx(log.write(data))
    assert len(found.payloads[RXM_RAWX]) == 4
    assert found.dropped["frame with a wrong checksum"] >= 1 and found.dropped["frame cut short"] >= 1
    raw = read_ubx_observations(log.write(data))
    assert raw.t_s.tolist() == [0.0, 1.0, 3.0, 4.0] and raw.report.dropped["frame cut short"] >= 1


def test_files_without_what_is_needed(log: Log) -> None:
    with pytest.raises(InputError, match="no UBX message"):
        read_ubx(log.write(NMEA * 3))
    with pytest.raises(InputError, match="empty"):
        read_ubx(log.write(b""))
    with pytest.raises(InputError, match=r"no NAV-PVT.*02-15"):
        read_ubx_fixes(log.epoch(0.0, Seen()).write())
    with pytest.raises(InputError, match="no RXM-SFRBX"):
        read_navigation([log.write()])
    with pytest.raises(InputError, match="no RXM-RAWX"):
        read_ubx_observations(log.write(frame(NAV_PVT, pvt())))
    with pytest.raises(InputError, match="no usable measurement"):
        read_ubx_observations(log.write(frame(RXM_RAWX, Log(log.folder).epoch(0.0, Seen(status=0)).parts[0][6:-2])))


def test_fixes(log: Log) -> None:
    kinds = [0x83, 0x43, 0x03, 0x01, 0x00]  # fixed, float, differential, single, not valid
    path = log.write(b"".join(NMEA + frame(NAV_PVT, pvt(21 + i, flags=flags)) for i, flags in enumerate(kinds)))
    pos = read_ubx_fixes(path)
    assert pos.quality.tolist() == [1, 2, 4, 5] and pos.dropped == {"NAV-PVT without a valid fix": 1}
    np.testing.assert_allclose(pos.times.since(T0), [-0.25 + i for i in range(4)], atol=1e-9)  # 18 leap seconds
    np.testing.assert_allclose(pos.position[0], [40.0966916, -105.1471665, 1580.048])
    np.testing.assert_allclose(pos.velocity[0], [-2.0, 1.0, -0.3])
    np.testing.assert_allclose(np.diagonal(pos.cov[0]), [98e-6, 98e-6, 100e-6])
    with pytest.raises(InputError, match="none of 1 NAV-PVT"):
        read_ubx_fixes(log.write(frame(NAV_PVT, pvt(valid=0))))


def packed(fields: messages.Fields, record: dict[str | int, float], n_bits: int, **also: tuple[int, int, int]) -> int:
    """A subframe's bits that hold a record."""
    bits = 0
    for name, (first, size, _, unit) in fields.items():
        value = round(record[name] / unit) & ((1 << size) - 1)
        bits |= value << (n_bits - first - size)
    for first, size, value in also.values():
        bits |= value << (n_bits - first - size)
    return bits


def words(bits: int, sizes: list[int], width: int = 30) -> list[int]:
    """Words of a subframe, their information bits uppermost in `width`."""
    out = []
    for size in reversed(sizes):
        out.append((bits & ((1 << size) - 1)) << (width - size))
        bits >>= size
    return out[::-1]


def broadcast(name: str) -> dict[str | int, float]:
    """A satellite's record at 2025-08-28 18:00, with the issue of data."""
    nav = builtin_constellation().shifted_to(T0)
    row = nav.kepler.satellites.index(name)
    data = nav.kepler.data[row].copy()
    data[orbits.HEALTH] = 0.0
    sow = (nav.t_ref + float(nav.kepler.toe_s[row])).sow - (14.0 if name[0] == "C" else 0.0)
    data[orbits.TOE] = sow
    return dict(enumerate(data.tolist())) | {"toc": sow, "iodc": 77.0, "iode": 77.0, "iod": 77.0, "aode": 7.0}


def log_messages(log: Log, name: str) -> None:
    """Add the subframes that carry a satellite's record."""
    record = broadcast(name)
    number = int(name[1:])
    if name[0] == "G":
        for i, fields in enumerate((messages.GPS_CLOCK, messages.GPS_ORBIT_1, messages.GPS_ORBIT_2), start=1):
            log.words(0, number, 0, words(packed(fields, record, 240, id=(43, 3, i)), [24] * 10))
    elif name[0] == "E":
        record |= {"e5b_hs": 0.0, "e1b_hs": 0.0, "e5b_dvs": 0.0, "e1b_dvs": 0.0}
        for kind, fields in messages.GALILEO_WORDS.items():
            word = packed(fields, record, 128, kind=(0, 6, kind))
            page = (word >> 16) << (254 - 112) | 2 << 126 | (word & 0xFFFF) << (126 - 16)
            log.words(2, number, 1, words(page, [32] * 8, 32))
    else:
        toe = round(record[orbits.TOE] / 8)
        record |= {"toe_high": float((toe >> 15) * 8 * 2**15), "toe_low": float((toe & 0x7FFF) * 8)}
        for i, fields in enumerate((messages.BEIDOU_CLOCK, messages.BEIDOU_ORBIT_1, messages.BEIDOU_ORBIT_2), start=1):
            bits = packed(fields, record | {"sow": 400_000.0 + 6 * i}, 224, id=(15, 3, i))
            log.words(3, number, 0, words(bits, [26, *[22] * 9]))


@pytest.mark.parametrize("system", ["G", "E", "C"])
def test_messages_give_back_the_orbits_they_were_made_of(log: Log, system: str) -> None:
    log.epoch(0.0, Seen())
    nav = builtin_constellation().shifted_to(T0)
    names = [s for s in nav.kepler.satellites if s[0] == system and not orbits.is_geostationary(s)][:3]
    for name in names:
        log_messages(log, name)
    read = read_navigation([log.write()])
    assert read.satellites == tuple(sorted(names))
    sat, t = np.arange(len(names)), np.full(len(names), 60.0)
    before, after = (n.states_at(tuple(names), sat, T0, t) for n in (nav, read))
    np.testing.assert_allclose(after.pos_ecef, before.pos_ecef, atol=0.5)  # rounded to the message's bits
    np.testing.assert_allclose(after.clock_m, before.clock_m, atol=0.3)


def test_half_a_set_of_subframes_is_no_record(log: Log) -> None:
    log.epoch(0.0, Seen())
    log_messages(log, next(s for s in builtin_constellation().satellites if s[0] == "G"))
    log.parts.pop()
    with pytest.raises(InputError, match="no usable navigation message"):
        read_navigation([log.write()])


def test_the_walk_s_fixes_are_those_of_its_solution_file() -> None:
    pos = read_pos(shared_data("gnss_imu_rtklibexplorer/gnss_1730_sf.pos"))
    ubx = read_ubx_fixes(shared_data("gnss_imu_rtklibexplorer/gnss_1730.ubx"))
    np.testing.assert_allclose(ubx.times.since(T0), pos.times.since(T0), atol=1e-3)
    np.testing.assert_allclose(ubx.position[:, :2], pos.position[:, :2], atol=1.1e-7)
    np.testing.assert_allclose(ubx.velocity, pos.velocity, atol=1e-6)
    assert ubx.quality.tolist() == pos.quality.tolist()
    # the solution file has heights above the geoid
    assert np.ptp(pos.position[:, 2] - ubx.position[:, 2]) < 0.01


@pytest.mark.parametrize(("systems", "limit_m"), [("G", 2.5), ("E", 2.5), ("C", 2.5), ("GE", 1.5)])
def test_each_constellation_of_the_walk_places_it_alike(systems: str, limit_m: float) -> None:
    """The receiver's RTK positions count from a base that is metres off; the constellations must agree with each other."""
    path = shared_data("gnss_imu_rtklibexplorer/gnss_1730.ubx")
    stream, report = gnss_stream(read_ubx_observations(path), read_navigation([path]), T0)
    assert report.n_rows == 36_271
    point = single_point(stream, GnssNoise(), systems, stream.klobuchar, T0.sow)
    fixes = read_ubx_fixes(path)
    r_ecef = fixes.ecef()
    assert r_ecef is not None
    frame = LocalFrame.at_ecef(r_ecef[0])
    t = stream.t_s - point.clock_s + (T0 - (fixes.times.ref or T0))
    r = np.column_stack([np.interp(t, fixes.times.t_s, r) for r in frame.from_ecef(r_ecef).T])
    error = np.median(frame.from_ecef(point.r_ecef) - r, axis=0)
    assert np.abs(error - [6.0, 4.5, -1.5]).max() < limit_m
    assert np.median(point.clock_s) == pytest.approx(-1.55782e-3, abs=3e-8)


def test_the_raw_walk_loads_with_the_messages_of_its_own_log(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("RELNAV_DATA", str(shared_data("gnss_imu_rtklibexplorer").parent))
    v = load("rtklibexplorer-walk-raw").problem.vehicles[0]
    assert v.gnss is not None and v.imu is not None and len(v.gnss.stream.t_s) == 536
    assert {"G1C", "E1C", "C6I"} <= set(v.gnss.stream.signals)
    assert np.mean(v.gnss.stream.lli & 1) < 0.05
