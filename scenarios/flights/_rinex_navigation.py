"""Broadcast messages from RINEX 2.11, 3.x and 4 navigation files.

A record is a line that begins with the satellite and holds the clock epoch and three numbers, followed by lines of four
numbers (19 columns each, first column 3 in RINEX 2, 4 later). RINEX 4 announces each with `> EPH G01 LNAV` and puts
the ionosphere and system times into records of their own; messages of the CNAV family are counted and left out.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from factorgraph.gpstime import GpsTime
from factorgraph.types import Array
from scenarios.flights import _orbits as orbits
from scenarios.flights._rinex_text import RinexText, gpst, number

RECORD_LINES = {"G": 8, "E": 8, "C": 8, "J": 8, "R": 4}
MESSAGES = {"LNAV", "INAV", "FNAV", "D1", "D2", "FDMA", "D1D2", "IFNV"}  # RINEX 4 types with the classic layout
GLONASS_UNKNOWN = 1e-3  # seconds; larger group delays are the format's "unknown"


@dataclass(slots=True)
class Messages:
    """What has been read so far; one entry per record."""

    satellites: list[str] = field(default_factory=list)
    times: list[GpsTime] = field(default_factory=list)
    data: list[Array] = field(default_factory=list)
    klobuchar: dict[str, Array] = field(default_factory=dict)  # system -> (8,)
    dropped: Counter[str] = field(default_factory=Counter)
    notes: list[str] = field(default_factory=list)


def read_messages(text: RinexText, into: Messages) -> None:
    """Append a navigation file's records; InputError where it is no navigation file or a date is impossible."""
    if text.kind not in "NGH" or (text.kind == "G" and text.version >= 3):
        what = {"O": "an observation file", "M": "a meteorological file"}.get(text.kind, f"RINEX type {text.kind!r}")
        raise text.error(0, f"this is {what}, expected a navigation file")
    into.notes.extend(text.remarks)
    _header_ionosphere(text, into)
    for begin, end, message in _records(text):
        if message.startswith("ION"):
            _ionosphere_record(text, begin, end, message, into)
        elif message and message.split()[-1] not in MESSAGES:
            into.dropped[f"message type {message.split()[-1]} not used"] += 1
        else:
            _ephemeris(text, begin, end, into)


def _records(text: RinexText) -> Iterator[tuple[int, int, str]]:
    """(first line, one past last line, RINEX 4 message announcement) of each record."""
    letter_first = text.version >= 3
    begin, message, announced = -1, "", ""
    for i in range(text.first_line, len(text.starts)):
        head = text.data[text.starts[i] : min(text.starts[i] + 3, text.ends[i])]
        announcement = head.startswith(b">")
        starts = announcement or (head[:1].isalpha() if letter_first else bool(head[:2].strip()))
        # a RINEX 4 ionosphere record has no satellite in front of its epoch
        starts = starts or (announced.startswith("ION") and begin < 0 and bool(head))
        if not starts:
            continue
        if begin >= 0:
            yield begin, i, message
        begin = -1 if announcement else i
        if announcement:
            announced = text.line(i)[1:].strip()
        else:
            message, announced = announced, ""
    if begin >= 0:
        yield begin, len(text.starts), message


def _ephemeris(text: RinexText, begin: int, end: int, into: Messages) -> None:
    line = text.line(begin)
    system = line[0] if text.version >= 3 else {"G": "R", "H": "S"}.get(text.kind, "G")
    if system not in RECORD_LINES:
        into.dropped[f"system {system} not used"] += 1
        return
    if end - begin < RECORD_LINES[system]:
        into.dropped["record cut short"] += 1
        into.notes.append(f"line {begin + 1}: record of {end - begin} lines where {RECORD_LINES[system]} are needed")
        return
    epoch_end = 23 if text.version >= 3 else 22
    try:
        prn = int(line[1:3] if text.version >= 3 else line[:2])
        parts = line[3:epoch_end].split()
        year, month, day, hour, minute = (int(p) for p in parts[:5])
        time = gpst(year, month, day, hour, minute, float(parts[5]), system)
        if system == "R":  # reference times lie on quarters of an hour of UTC
            time = time + -((60.0 * minute + float(parts[5]) + 450.0) % 900.0 - 450.0)
    except (ValueError, IndexError):
        into.dropped["satellite or epoch unreadable"] += 1
        into.notes.append(f"line {begin + 1}: satellite or epoch unreadable")
        return
    n = orbits.N_GLONASS if system == "R" else orbits.N_KEPLER
    values = _numbers(text, begin, end, epoch_end, n)
    problem = unusable(values, system)
    if problem:
        into.dropped[problem] += 1
        into.notes.append(f"line {begin + 1}: {problem}")
        return
    into.satellites.append(f"{system}{prn:02d}")
    into.times.append(time)
    into.data.append(values)


def _numbers(text: RinexText, begin: int, end: int, first_column: int, n: int) -> Array:
    """The n numbers of a record, blanks NaN."""
    margin = 4 if text.version >= 3 else 3
    fields = [text.line(begin)[first_column:][19 * k : 19 * k + 19] for k in range(3)]
    for i in range(begin + 1, min(end, begin + 1 + (n - 3) // 4)):
        line = text.line(i)
        fields += [line[margin + 19 * k : margin + 19 * k + 19] for k in range(4)]
    values = np.full(n, np.nan)
    values[: len(fields)] = [number(f) for f in fields]
    return values


def unusable(values: Array, system: str) -> str:
    """Why a record cannot be used, or nothing."""
    needed = range(14) if system == "R" else (0, 1, 2, *range(orbits.CRS, orbits.I_DOT + 1), orbits.HEALTH)
    if not np.all(np.isfinite(values[list(needed)])):
        return "number missing or unreadable"
    if system == "R":
        sensible = 2e4 < np.linalg.norm(values[orbits.G_POS]) < 3e4
    else:
        flags = np.abs(np.nan_to_num(values[[orbits.CODES, orbits.HEALTH]]))
        sensible = 2e3 < values[orbits.SQRT_A] < 1e4 and 0 <= values[orbits.ECC] < 0.3 and flags.max() < 2**31
    return "" if sensible else "orbit impossible"


def _header_ionosphere(text: RinexText, into: Messages) -> None:
    """Klobuchar coefficients: ION ALPHA / ION BETA (RINEX 2), IONOSPHERIC CORR GPSA, BDSA, QZSA ... (RINEX 3)."""
    halves: dict[str, Array] = {}
    for label, content in text.header:
        if label in ("ION ALPHA", "ION BETA"):
            halves["GPS" + label[4]] = np.array([number(content[2 + 12 * k : 14 + 12 * k]) for k in range(4)])
        elif label == "IONOSPHERIC CORR" and content[3] in "AB":
            halves.setdefault(content[:4], np.array([number(content[5 + 12 * k : 17 + 12 * k]) for k in range(4)]))
    for name, letter in (("GPS", "G"), ("QZS", "J"), ("BDS", "C")):
        if name + "A" in halves and name + "B" in halves:
            both = np.concatenate([halves[name + "A"], halves[name + "B"]])
            if np.all(np.isfinite(both)):
                into.klobuchar[letter] = both


def _ionosphere_record(text: RinexText, begin: int, end: int, message: str, into: Messages) -> None:
    """RINEX 4: `> ION G01 LNAV` with alpha 0-3 and beta 0-3 after the epoch; the last one of a system counts."""
    words = message.split()
    if len(words) < 3 or words[1][0] not in "GCJ" or words[2] not in MESSAGES:
        return
    values = _numbers(text, begin, end, 23, 11)[:8]
    if np.all(np.isfinite(values)):
        into.klobuchar[words[1][0]] = values
