"""NMEA 0183: positions from GGA, the date from RMC.

GGA has the time of day in UTC only; the day follows from the RMC sentences of the file, or is given. The height is
above the ellipsoid: altitude above the geoid plus geoid separation.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from datetime import UTC, date, datetime, time, timedelta
from pathlib import Path

import numpy as np
from pynmeagps import NMEAMessage, NMEAParseError, NMEAReader, NMEATypeError
from pynmeagps.nmeatypes_core import VALCKSUM

from factorgraph.errors import InputError
from factorgraph.gpstime import GpsTime
from factorgraph.types import Array
from scenarios.flights.tables import Times, read_bytes

DAY_S = 86_400.0
SENTENCE = re.compile(rb"\$[A-Z]{2}(?:GGA|RMC),[^\r\n$]*")
# GGA quality -> horizontal sigma [m] at HDOP 1: single, differential, PPS, RTK fixed, RTK float, dead reckoning
QUALITY_SIGMA_M = {1: 3.0, 2: 1.0, 3: 1.0, 4: 0.02, 5: 0.5, 6: 10.0}


@dataclass(frozen=True, slots=True)
class NmeaPositions:
    """GGA fixes of a file, in its order."""

    times: Times
    llh_deg: Array  # (n, 3) degrees, degrees, metres above the ellipsoid
    sigma_enu_m: Array  # (n, 3) assumed from quality and HDOP
    n_rows: int  # sentences of the two kinds
    dropped: dict[str, int]


def read_nmea(path: Path, day: str = "") -> NmeaPositions:
    """GGA positions of an NMEA file; `day` "YYYY-MM-DD" (UTC) where no RMC tells it.

    Sentences with a wrong checksum, unreadable ones and those without a fix are counted. Raises InputError when no
    position is left or the date is not known.
    """
    given = _given_day(day, path)
    dropped = {"with a wrong checksum or unreadable": 0, "without a fix": 0}
    rows: list[tuple[float, float, float, float, float, int]] = []
    clock = _DayCount()
    first_day: date | None = None
    sentences = SENTENCE.findall(read_bytes(path))
    for sentence in sentences:
        message = _parsed(sentence)
        if message is None or not isinstance(message.time, time):
            dropped["with a wrong checksum or unreadable" if message is None else "without a fix"] += 1
            continue
        t = clock.seconds(message.time)
        if message.msgID == "RMC":
            if first_day is None and isinstance(message.date, date):
                first_day = message.date - timedelta(days=clock.days)
        elif (row := _fix(message)) is None:
            dropped["without a fix"] += 1
        else:
            rows.append((t, *row))
    start = given or first_day
    if not rows:
        raise InputError(f"{path}: no GGA sentence with a position ({len(sentences)} GGA and RMC sentences found)")
    if start is None:
        raise InputError(f'{path}: GGA has no date and the file has no RMC; give date = "YYYY-MM-DD" (UTC)')
    table = np.array([row[:5] for row in rows])
    horizontal = table[:, 4] * np.array([QUALITY_SIGMA_M.get(row[5], 10.0) for row in rows])
    return NmeaPositions(
        Times(table[:, 0], GpsTime.from_utc(datetime.combine(start, time(), UTC))),
        table[:, 1:4],
        horizontal[:, None] * [1.0, 1.0, 2.0],
        len(sentences),
        {reason: n for reason, n in dropped.items() if n},
    )


class _DayCount:
    """Times of day as seconds since the first day began, across midnights."""

    def __init__(self) -> None:
        self.days = 0
        self._last = 0.0

    def seconds(self, of_day: time) -> float:
        t = of_day.hour * 3600.0 + of_day.minute * 60.0 + of_day.second + of_day.microsecond * 1e-6
        if t < self._last - DAY_S / 2:
            self.days += 1
        self._last = t
        return t + self.days * DAY_S


def _given_day(day: str, path: Path) -> date | None:
    try:
        return date.fromisoformat(day) if day else None
    except ValueError as error:
        raise InputError(f'{path}: date "{day}" is not written as YYYY-MM-DD') from error


def _parsed(sentence: bytes) -> NMEAMessage | None:
    try:
        return NMEAReader.parse(sentence + b"\r\n", validate=VALCKSUM)
    except (NMEAParseError, NMEATypeError, ValueError, IndexError):
        return None


def _fix(message: NMEAMessage) -> tuple[float, float, float, float, int] | None:
    """Latitude, longitude, ellipsoidal height, HDOP and quality; None without a fix."""
    fields = (message.lat, message.lon, message.alt)
    if not message.quality or any(not isinstance(v, float | int) for v in fields):
        return None
    separation = message.sep if isinstance(message.sep, float | int) else 0.0
    hdop = message.HDOP if isinstance(message.HDOP, float | int) and message.HDOP > 0 else 1.0
    return message.lat, message.lon, message.alt + separation, hdop, int(message.quality)
