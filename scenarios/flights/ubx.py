"""u-blox binary logs (UBX): their frames, and position fixes (NAV-PVT).

Frames are b5 62, class, identity, length, payload and two checksum bytes; NMEA and RTCM between them are skipped. Frames
with a wrong checksum and a frame cut short are counted, and reading goes on behind their first two bytes. Payloads are
decoded by their layout, all of one kind at once.

Source: u-blox F9 and X20 HPG interface descriptions, UBX protocol and UBX-NAV-PVT.
"""

from __future__ import annotations

import io
import math
import struct
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from factorgraph.errors import InputError
from factorgraph.gpstime import WEEK_S, GpsTime, leap_seconds
from factorgraph.types import Array, IntArray
from scenarios.flights.rtklib_pos import PosFile
from scenarios.flights.tables import Times, read_bytes

SYNC = b"\xb5\x62"
HEAD, TAIL = 6, 2  # bytes around a payload
NAV_PVT, RXM_RAWX, RXM_SFRBX = b"\x01\x07", b"\x02\x15", b"\x02\x13"
PVT = np.dtype(
    {
        "names": ["year", "month", "day", "hour", "minute", "second", "valid", "nano", "fix", "flags", "n_sat", "lon", "lat"]
        + ["height", "h_acc", "v_acc", "vel_n", "vel_e", "vel_d", "s_acc"],
        "formats": ["<u2", "u1", "u1", "u1", "u1", "u1", "u1", "<i4", "u1", "u1", "u1", "<i4", "<i4"]
        + ["<i4", "<u4", "<u4", "<i4", "<i4", "<i4", "<u4"],
        "offsets": [4, 6, 7, 8, 9, 10, 11, 16, 20, 21, 23, 24, 28, 32, 40, 44, 48, 52, 56, 68],
        "itemsize": 92,
    }
)
DATE_AND_TIME = 3  # bits of `valid`
FIX_OK, DIFFERENTIAL = 1, 2  # bits of `flags`
POSITION_FIXES = (2, 3, 4)  # of `fix`: 2D, 3D, with dead reckoning

GNSS = {0: "G", 1: "S", 2: "E", 3: "C", 5: "J", 6: "R", 7: "I"}
RAWX_HEAD = 16  # bytes before the measurements of RXM-RAWX: time of week (f8), week (u2), ...

Rows = np.ndarray[tuple[int], np.dtype[np.void]]


@dataclass(frozen=True, slots=True)
class UbxLog:
    """Payloads of a log by class and identity, and what was dropped."""

    path: Path
    payloads: dict[bytes, list[bytes]]
    dropped: dict[str, int]


def is_ubx(path: Path) -> bool:
    """Whether a file is named as a u-blox log."""
    return path.suffix.lower() == ".ubx"


def read_ubx(path: Path) -> UbxLog:
    """Read a log's frames. Raises InputError when it holds none."""
    data = read_bytes(path)
    payloads: dict[bytes, list[bytes]] = {}
    dropped: Counter[str] = Counter()
    for frame in _frames(data, dropped):
        payloads.setdefault(frame[2:4], []).append(frame[HEAD:-TAIL])
    if not payloads:
        raise InputError(f"{path}: no UBX message in it; a u-blox log holds frames that begin with b5 62")
    return UbxLog(path, payloads, dict(dropped))


def _frames(data: bytes, dropped: Counter[str]) -> Iterator[bytes]:
    """Whole frames with a right checksum."""
    from pyubx2 import ERR_IGNORE, UBX_PROTOCOL, UBXReader  # slow to import

    stream = io.BytesIO(data)
    reader = UBXReader(stream, protfilter=UBX_PROTOCOL, quitonerror=ERR_IGNORE, parsing=False)
    behind = 0  # the last good frame, or the start of the last bad one
    while True:
        frame = reader.read()[0]
        if frame is not None and _checks(frame):
            behind = stream.tell()
            yield frame
            continue
        start = data.find(SYNC, behind) if frame is None else stream.tell() - len(frame)
        if start < 0:
            return
        dropped["frame with a wrong checksum" if frame is not None else "frame cut short"] += 1
        behind = start + len(SYNC)
        stream.seek(behind)


def _checks(frame: bytes) -> bool:
    """Whether the 8-bit Fletcher checksum is right."""
    body = np.frombuffer(frame, np.uint8)[len(SYNC) : -TAIL].astype(np.int64)
    a, b = int(body.sum()) & 255, int(body @ np.arange(len(body), 0, -1)) & 255
    return frame[-2:] == bytes((a, b))


def read_ubx_fixes(path: Path) -> PosFile:
    """Positions and velocities of NAV-PVT, heights above the ellipsoid. Raises InputError when there is no valid one."""
    log = read_ubx(path)
    payloads = [p for p in log.payloads.get(NAV_PVT, []) if len(p) == PVT.itemsize]
    if not payloads:
        found = ", ".join(sorted({f"{k[0]:02x}-{k[1]:02x}" for k in log.payloads}))
        raise InputError(f"{path}: no NAV-PVT (01-07) message, so no positions; there are {found}")
    pvt = np.frombuffer(b"".join(payloads), PVT)
    dated = (pvt["valid"] & DATE_AND_TIME) == DATE_AND_TIME
    good = dated & ((pvt["flags"] & FIX_OK) != 0) & np.isin(pvt["fix"], POSITION_FIXES)
    if not good.any():
        raise InputError(f"{path}: none of {len(pvt)} NAV-PVT messages has a date and a valid fix")
    dropped = log.dropped | ({"NAV-PVT without a valid fix": int((~good).sum())} if not good.all() else {})
    pvt = pvt[good]
    start, t_s = _instants(pvt)
    variance = np.stack([0.5 * _square(pvt["h_acc"]), 0.5 * _square(pvt["h_acc"]), _square(pvt["v_acc"])], axis=1)
    velocity = np.stack([pvt["vel_e"], pvt["vel_n"], -pvt["vel_d"]], axis=1) * 1e-3
    carrier = pvt["flags"] >> 6  # 0: none, 1: float, 2: fixed
    differential = (pvt["flags"] & DIFFERENTIAL) != 0
    return PosFile(
        Times(t_s, start),
        "llh",
        np.stack([pvt["lat"] * 1e-7, pvt["lon"] * 1e-7, pvt["height"] * 1e-3], axis=1),
        variance[:, :, None] * np.eye(3),
        np.select([carrier == 2, carrier == 1, differential], [1, 2, 4], 5).astype(np.int64),
        pvt["n_sat"].astype(np.int64),
        np.full(len(pvt), np.nan),
        velocity,
        _square(pvt["s_acc"])[:, None, None] / 3 * np.eye(3),
        None,
        len(payloads),
        dropped,
    )


def _square(millimetres: IntArray) -> Array:
    return np.asarray((millimetres * 1e-3) ** 2)


def _instants(pvt: Rows) -> tuple[GpsTime, Array]:
    """GPST of the first whole second, and seconds from it of every fix (calendar dates are UTC)."""
    months = (pvt["year"].astype(np.int64) - 1970) * 12 + pvt["month"] - 1
    days = months.astype("M8[M]").astype("M8[D]").astype(np.int64) + pvt["day"] - 1 - 3657  # from 1980-01-06
    of_day = pvt["hour"] * 3600.0 + pvt["minute"] * 60.0 + pvt["second"]
    first = GpsTime(int(days[0]) // 7, (int(days[0]) % 7) * 86_400.0 + float(of_day[0]))
    start = first + float(leap_seconds(first.calendar()))
    t_s = (days - days[0]) * 86_400.0 + (of_day - of_day[0]) + pvt["nano"] * 1e-9
    return start, np.asarray(t_s)


def first_instant(log: UbxLog) -> GpsTime:
    """Time of the first observations. Raises InputError where there are none."""
    for payload in log.payloads.get(RXM_RAWX, []):
        if len(payload) >= RAWX_HEAD:
            tow, week = struct.unpack_from("<dH", payload)
            if math.isfinite(tow) and 0 <= tow < WEEK_S:
                return GpsTime(week, tow)
    raise InputError(f"{log.path}: no RXM-RAWX (02-15) message, so no raw observations")
