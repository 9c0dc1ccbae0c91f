"""Time tag files (`.tag`) that RTKLIB's logger writes beside a recording: when each byte of it arrived.

    header   60 bytes "TIMETAG RTKLIB ...", tick of the opening [ms, u4], GPST of the opening [s since 1970, u4; + f8]
    records  milliseconds since the opening (u4), bytes of the recording written by then (u4)

A row's own counter c and its arrival are a = c0 + k c + latency, latency >= 0: the line under all arrivals that lies
closest to them on average gives the counter's offset and rate free of the latency's jitter; a constant latency stays.

Source: RTKLIB 2.4.3, stream.c (openfile_, writefile); Moon, Skelly, Towsley: Estimation and removal of clock skew, 1999.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from factorgraph.errors import InputError
from factorgraph.gpstime import GPS_EPOCH, GpsTime
from factorgraph.types import Array, IntArray
from scenarios.flights.schema import TextOptions, TimeColumn
from scenarios.flights.tables import UNIT_S, UNIX_EPOCH, RawTable, Times, read_bytes, require_file

MAGIC = b"TIMETAG RTKLIB"
HEADER = 76  # bytes
MIN_ARRIVALS = 10
MAX_RATE = 0.05  # of a counter against GPST; more tells of another unit or of a tag of another file


@dataclass(frozen=True, slots=True)
class Tag:
    """A tag file: opening of the recording, and bytes written by times since."""

    path: Path
    opened: GpsTime
    t_s: Array  # (n,)
    n_bytes: IntArray  # (n,)


def tagged_times(table: RawTable, options: TextOptions, time: TimeColumn) -> Times:
    """Times of a text recording's rows by their counter and the tag file beside it. Raises InputError as its parts do."""
    if not isinstance(time.column, int):
        raise InputError(f"{table.path}: with time.tag, time.column is a number from 0, got {time.column}")
    tag = read_tag(require_file(table.path.parent / time.tag))
    unit_s = UNIT_S[time.unit] * time.scale
    c0, k = counter_clock(tag, table.path, time.column, options.delimiter, unit_s)
    return Times(c0 + k * unit_s * table.numbers[time.column] + time.offset_s, tag.opened)


def read_tag(path: Path) -> Tag:
    """Read a tag file. Raises InputError where it is none; half a record at the end is left out."""
    data = read_bytes(path)
    if not data.startswith(MAGIC) or len(data) < HEADER + 8:
        raise InputError(f"{path}: not a time tag file of RTKLIB (it begins with {MAGIC.decode()}) or without records")
    whole = int.from_bytes(data[64:68], "little")
    part = float(np.frombuffer(data[68:HEADER], "<f8")[0])
    if not 0 <= part < 1:
        raise InputError(f"{path}: the opening time in the header cannot be read")
    records = np.frombuffer(data[HEADER : len(data) - (len(data) - HEADER) % 8], "<u4").reshape(-1, 2)
    since = whole - int((GPS_EPOCH - UNIX_EPOCH).total_seconds())
    opened = GpsTime(0, since + part)
    return Tag(path, opened, records[:, 0] * 1e-3, records[:, 1].astype(np.int64))


def counter_clock(tag: Tag, recording: Path, column: int, delimiter: str, unit_s: float) -> tuple[float, float]:
    """Offset and rate (c0, k) of a counter in a column of a text recording: c0 + k * cell is seconds since its opening.

    Positions of tags count carriage returns even where the text has lost them. Raises InputError where the counter does
    not run as the tags do.
    """
    text = read_bytes(recording)
    ends = np.flatnonzero(np.frombuffer(text, np.uint8) == ord("\n")) + 1
    if b"\r" not in text and tag.n_bytes[-1] > len(text):
        ends = ends + np.arange(1, len(ends) + 1)
    line = np.searchsorted(ends, tag.n_bytes, side="right") - 1  # the last one written by then
    rows = text.split(b"\n")
    mark = None if delimiter == "whitespace" else delimiter.encode()
    cells = np.array([_cell(rows[i], column, mark) if i >= 0 else np.nan for i in line.tolist()]) * unit_s
    there = np.isfinite(cells)
    if (n_lines := len(np.unique(line[there]))) < MIN_ARRIVALS:
        raise InputError(f"{tag.path}: its {len(line)} records point to {n_lines} lines of {recording.name} with a counter")
    k, c0 = _line_under(cells[there], tag.t_s[there])
    if not abs(k - 1) < MAX_RATE:
        raise InputError(
            f"{tag.path}: the counter of {recording.name} runs {k:.4g} times as fast as the tags; check its column and unit"
        )
    return c0, k


def _cell(row: bytes, column: int, delimiter: bytes | None) -> float:
    cells = row.split(delimiter)
    try:
        return float(cells[column])
    except (ValueError, IndexError):
        return np.nan


def _line_under(x: Array, y: Array) -> tuple[float, float]:
    """Slope and offset of the line below all points that is closest to them on average: an edge of their lower hull."""
    order = np.lexsort((y, x))
    hull: list[tuple[float, float]] = []
    for point in zip(x[order].tolist(), y[order].tolist(), strict=True):
        while len(hull) > 1 and _turn(hull[-2], hull[-1], point) <= 0:
            hull.pop()
        if not hull or point[0] > hull[-1][0]:
            hull.append(point)
    if len(hull) < 2:
        return np.nan, np.nan
    middle = float(x.mean())
    i = min(int(np.searchsorted([p[0] for p in hull], middle)), len(hull) - 1)
    (x0, y0), (x1, y1) = hull[max(i - 1, 0)], hull[max(i, 1)]
    slope = (y1 - y0) / (x1 - x0)
    return slope, y0 - slope * x0


def _turn(a: tuple[float, float], b: tuple[float, float], c: tuple[float, float]) -> float:
    """Positive where a, b, c turn to the left."""
    return (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
