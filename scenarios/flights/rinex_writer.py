"""RINEX 3.04 observation and navigation files from our own records.

Numbers are rounded to what the format holds: 1 mm of code, 0.001 cycle of phase, 0.001 Hz, 0.001 dB-Hz, tags to 100 ns,
thirteen digits of an ephemeris. GLONASS group delays have no place in 3.04 and are left out.
"""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from factorgraph.gpstime import GpsTime, leap_seconds
from factorgraph.measurements import GnssStream
from factorgraph.types import Array, IntArray
from scenarios.flights._rinex_text import BDT_GPST_S
from scenarios.flights.navigation import Navigation

TICKS = 10_000_000  # per second, the last digit of an epoch
PROGRAM = "relnav"
MONTHS = ("JAN", "FEB", "MAR", "APR", "MAY", "JUN", "JUL", "AUG", "SEP", "OCT", "NOV", "DEC")


def write_observations(
    path: Path,
    stream: GnssStream,
    t0: GpsTime,
    approx_ecef: Array | None = None,
    marker: str = "ROVER",
    antenna_delta_m: Sequence[float] = (0.0, 0.0, 0.0),
    comments: Sequence[str] = (),
    channels: dict[str, int] | None = None,
) -> None:
    """Write a receiver's rows; tags are t0 + t_s.

    approx_ecef (3,): the header's position (the stream's own where None); antenna_delta_m: height, east, north;
    channels: GLONASS FDMA numbers. Epochs without rows are left out.
    """
    approx = stream.approx_ecef if approx_ecef is None else approx_ecef
    systems = sorted({s[0] for s in stream.satellites}, key="GREJCIS".index)
    types = {system: _types(stream, system) for system in systems}
    seconds = _calendar_ticks(t0, stream.t_s)
    present = np.unique(stream.epoch)
    lines = [
        _version("OBSERVATION DATA", systems),
        *_origin(comments),
        _header(f"{marker:<60.60}", "MARKER NAME"),
        _header(f"{'':<20}{PROGRAM:<40}", "OBSERVER / AGENCY"),
        _header("", "REC # / TYPE / VERS"),
        _header("", "ANT # / TYPE"),
        _header("".join(f"{v:14.4f}" for v in (np.zeros(3) if approx is None else approx)), "APPROX POSITION XYZ"),
        _header("".join(f"{v:14.4f}" for v in antenna_delta_m), "ANTENNA: DELTA H/E/N"),
    ]
    for system, kinds in types.items():
        for k in range(0, len(kinds), 13):
            start = f"{system}  {len(kinds):3d}" if k == 0 else " " * 6
            lines.append(_header(start + "".join(f" {t}" for t in kinds[k : k + 13]), "SYS / # / OBS TYPES"))
    for system, kinds in types.items():
        lines += [_header(f"{system} {t}  0.00000", "SYS / PHASE SHIFT") for t in kinds if t[0] == "L"]
    lines.append(_header(_first_epoch(seconds[present[0]]) if present.size else "", "TIME OF FIRST OBS"))
    if "R" in systems:
        lines += _slots(channels or {})
        lines.append(_header("".join(f" {c}{0.0:9.3f}" for c in ("C1C", "C1P", "C2C", "C2P")), "GLONASS COD/PHS/BIS"))
    lines.append(_header("DBHZ", "SIGNAL STRENGTH UNIT"))
    lines.append(_header("", "END OF HEADER"))
    lines += _epochs(stream, types, seconds)
    path.write_text("\n".join(lines) + "\n", encoding="ascii", errors="replace")


def write_navigation(path: Path, navigation: Navigation, comments: Sequence[str] = ()) -> None:
    """Write every message of `navigation` and its Klobuchar coefficients."""
    systems = sorted({s[0] for s in navigation.satellites}, key="GREJCIS".index)
    lines = [_version("N: GNSS NAV DATA", systems), *_origin(comments)]
    if navigation.klobuchar is not None:
        for name, half in zip(("GPSA", "GPSB"), navigation.klobuchar.reshape(2, 4), strict=True):
            lines.append(_header(f"{name} " + "".join(f"{v:12.4E}" for v in half), "IONOSPHERIC CORR"))
    lines.append(_header(f"{leap_seconds(navigation.t_ref.calendar()):6d}", "LEAP SECONDS"))
    lines.append(_header("", "END OF HEADER"))
    k, g = navigation.kepler, navigation.glonass
    for name, toc_s, data in zip(k.satellites, k.toc_s, k.data, strict=True):
        toc = navigation.t_ref + (toc_s - (BDT_GPST_S if name[0] == "C" else 0.0))
        lines += _message(name, toc, data)
    for name, toe_s, data in zip(g.satellites, g.toe_s, g.data, strict=True):
        toe = navigation.t_ref + toe_s
        lines += _message(name, toe + -float(leap_seconds(toe.utc())), data[:15])
    path.write_text("\n".join(lines) + "\n", encoding="ascii", errors="replace")


def _header(content: str, label: str) -> str:
    return f"{content:<60.60}{label:<20}".rstrip()


def _version(what: str, systems: Sequence[str]) -> str:
    system = systems[0] if len(systems) == 1 else "M"
    return _header(f"{3.04:9.2f}{'':<11}{what:<20}{system}", "RINEX VERSION / TYPE")


def _origin(comments: Sequence[str]) -> list[str]:
    now = datetime.now(UTC)
    run = f"{PROGRAM:<20}{'':<20}{now:%Y%m%d %H%M%S} UTC"
    return [_header(run, "PGM / RUN BY / DATE"), *(_header(c, "COMMENT") for c in comments)]


def _slots(channels: dict[str, int]) -> list[str]:
    items = [f"{name} {k:2d} " for name, k in sorted(channels.items())]
    out = []
    for k in range(0, max(len(items), 1), 8):
        start = f"{len(items):3d} " if k == 0 else " " * 4
        out.append(_header(start + "".join(items[k : k + 8]), "GLONASS SLOT / FRQ #"))
    return out


def _calendar_ticks(t0: GpsTime, t_s: Array) -> NDArray[np.object_]:
    """(m, 6) integers of year, month, day, hour, minute and ticks of 100 ns."""
    week_start = np.datetime64("1980-01-06") + np.timedelta64(7 * t0.week, "D")
    ticks = np.round((t0.sow + t_s) * TICKS).astype(np.int64)
    minute, rest = np.divmod(ticks, 60 * TICKS)
    stamps = (week_start + minute.astype("m8[m]")).astype("M8[m]").tolist()
    return np.array([(s.year, s.month, s.day, s.hour, s.minute, r) for s, r in zip(stamps, rest.tolist(), strict=True)], object)


def _first_epoch(stamp: NDArray[np.object_]) -> str:
    year, month, day, hour, minute, ticks = stamp
    return f"{year:6d}{month:6d}{day:6d}{hour:6d}{minute:6d}{ticks // TICKS:5d}.{ticks % TICKS:07d}     GPS"


def _epochs(stream: GnssStream, types: dict[str, tuple[str, ...]], stamps: NDArray[np.object_]) -> list[str]:
    """Epoch lines followed by a line per satellite."""
    group, epoch, sat = _groups(stream)
    records = np.empty(epoch.size, object)
    for system, kinds in types.items():
        mine = np.array([s[0] == system for s in stream.satellites], bool)[sat]
        if mine.any():
            records[mine] = _record_texts(stream, system, kinds, group, mine, sat)
    first = np.flatnonzero(np.diff(epoch, prepend=-1))
    counts = np.diff(first, append=epoch.size)
    lines: list[str] = []
    for begin, n in zip(first.tolist(), counts.tolist(), strict=True):
        year, month, day, hour, minute, ticks = stamps[epoch[begin]]
        clock = f"{ticks // TICKS:2d}.{ticks % TICKS:07d}"
        lines.append(f"> {year:04d} {month:02d} {day:02d} {hour:02d} {minute:02d} {clock}  0{n:3d}")
        lines.extend(records[begin : begin + n].tolist())
    return lines


def _groups(stream: GnssStream) -> tuple[IntArray, IntArray, IntArray]:
    """Row -> record, and epoch and satellite of each record, in order of epoch and satellite."""
    key = stream.epoch * len(stream.satellites) + stream.sat
    records, group = np.unique(key, return_inverse=True)
    epoch, sat = np.divmod(records, max(len(stream.satellites), 1))
    return group.astype(np.int64), epoch, sat


def _columns(stream: GnssStream) -> dict[str, Array]:
    return {"C": stream.code_m, "L": stream.phase_cyc, "D": stream.doppler_hz, "S": stream.cn0_dbhz}


def _types(stream: GnssStream, system: str) -> tuple[str, ...]:
    """Observation types of a system that hold a number, signal by signal."""
    out = []
    for k, name in enumerate(stream.signals):
        if name[0] == system:
            rows = stream.signal == k
            out += [kind + name[1:] for kind, values in _columns(stream).items() if np.isfinite(values[rows]).any()]
    return tuple(out)


def _record_texts(
    stream: GnssStream, system: str, kinds: tuple[str, ...], group: IntArray, mine: NDArray[np.bool_], sat: IntArray
) -> list[str]:
    """The lines of one system's records."""
    place = np.cumsum(mine) - 1
    text = np.array(stream.satellites)[sat[mine]].astype("U3")
    for kind in kinds:
        rows = np.flatnonzero(stream.signal == stream.signals.index(system + kind[1:]))
        values = _columns(stream)[kind[0]][rows]
        there = np.isfinite(values)
        field = np.full(text.size, " " * 16, "U16")
        lli = stream.lli[rows][there] if kind[0] == "L" else np.zeros(int(there.sum()), np.int64)
        field[place[group[rows]][there]] = _fields(values[there], lli)
        text = np.char.add(text, field)
    return [str(t) for t in np.char.rstrip(text)]


def _fields(values: Array, lli: IntArray) -> NDArray[np.str_]:
    """F14.3, loss-of-lock digit (blank for none), blank strength."""
    return np.char.add(np.char.mod("%14.3f", values), np.array(["  ", "1 ", "2 ", "3 "])[lli & 3])


def _message(name: str, epoch: GpsTime, data: Array) -> list[str]:
    stamp = GpsTime(epoch.week, float(round(epoch.sow))).calendar()
    head = f"{name} {stamp:%Y %m %d %H %M %S}"
    text = ["".join(f"{v:19.12E}" if np.isfinite(v) else " " * 19 for v in data[:3])]
    text += ["".join(f"{v:19.12E}" if np.isfinite(v) else " " * 19 for v in data[k : k + 4]) for k in range(3, len(data), 4)]
    return [(head if k == 0 else " " * 4) + t.rstrip() for k, t in enumerate(text)]
