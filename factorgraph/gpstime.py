"""GPS time as week and seconds of week, and seconds since a stated `t0`.

A float64 of seconds since 1980 resolves 0.24 us (71 m of light travel), so absolute instants are kept
as `GpsTime` and everything else counts seconds from a flight's `t0`. No leap seconds anywhere inside;
UTC appears only in readers that need it (NMEA) and in writers.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta

WEEK_S = 604_800.0
GPS_EPOCH = datetime(1980, 1, 6, tzinfo=UTC)

# Dates from which GPST - UTC takes the value, seconds. Source: IERS Bulletin C (last change 2017-01-01).
LEAP_SECONDS = (
    (datetime(1999, 1, 1, tzinfo=UTC), 13),
    (datetime(2006, 1, 1, tzinfo=UTC), 14),
    (datetime(2009, 1, 1, tzinfo=UTC), 15),
    (datetime(2012, 7, 1, tzinfo=UTC), 16),
    (datetime(2015, 7, 1, tzinfo=UTC), 17),
    (datetime(2017, 1, 1, tzinfo=UTC), 18),
)


@dataclass(frozen=True, slots=True, order=True)
class GpsTime:
    """An instant in GPST: full week number and seconds of week in [0, 604800)."""

    week: int
    sow: float

    def __post_init__(self) -> None:
        if not math.isfinite(self.sow):
            raise ValueError(f"sow must be finite, got {self.sow}")
        carry = math.floor(self.sow / WEEK_S)
        if carry:
            object.__setattr__(self, "week", self.week + carry)
            object.__setattr__(self, "sow", self.sow - carry * WEEK_S)

    def __sub__(self, other: GpsTime) -> float:
        """Seconds from `other` to this instant."""
        return (self.week - other.week) * WEEK_S + (self.sow - other.sow)

    def __add__(self, seconds: float) -> GpsTime:
        return GpsTime(self.week, self.sow + seconds)

    @classmethod
    def from_calendar(cls, year: int, month: int, day: int, hour: int = 0, minute: int = 0, second: float = 0.0) -> GpsTime:
        """From a calendar date and time already in GPST; `second` may be 60 or more."""
        days = (datetime(year, month, day, tzinfo=UTC) - GPS_EPOCH).days
        return cls(days // 7, (days % 7) * 86_400.0 + hour * 3600.0 + minute * 60.0 + second)

    @classmethod
    def from_utc(cls, utc: datetime) -> GpsTime:
        """From an aware UTC datetime, leap seconds applied."""
        delta = utc - GPS_EPOCH
        sow = (delta.days % 7) * 86_400.0 + delta.seconds + delta.microseconds * 1e-6
        return cls(delta.days // 7, sow + leap_seconds(utc))

    def calendar(self) -> datetime:
        """The GPST calendar reading (microsecond resolution); tzinfo is UTC only formally."""
        return GPS_EPOCH + timedelta(weeks=self.week, seconds=self.sow)

    @property
    def day_of_year(self) -> float:
        """Days since the year began, the first day counting from 1."""
        when = self.calendar()
        return when.timetuple().tm_yday + (self.sow % 86_400.0) / 86_400.0

    def utc(self) -> datetime:
        gpst = self.calendar()
        return gpst - timedelta(seconds=leap_seconds(gpst - timedelta(seconds=leap_seconds(gpst))))


def leap_seconds(utc: datetime) -> int:
    """GPST - UTC in seconds at a UTC instant after 1999."""
    return next((n for start, n in reversed(LEAP_SECONDS) if utc >= start), LEAP_SECONDS[0][1])
