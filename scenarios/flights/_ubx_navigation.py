"""Broadcast messages in u-blox logs (RXM-SFRBX): GPS and QZSS LNAV, Galileo I/NAV, BeiDou D1.

Payload: constellation, satellite, signal, channel, number of words, channel, version, reserved (u1 each), words (u4). With the
parity left out the fields of a subframe follow one another, and their places below count those bits:

    LNAV   10 words of 24 bits in the upper of 30          ICD-GPS-200, 20.3.3.3-5
    I/NAV  two pages of 120 bits in 4 words each: 2 bits, then 112 and 16 bits of the word    Galileo OS SIS ICD, 4.3
    D1     a word of 26 bits and 9 of 22, in the upper of 30                                  BDS-SIS-ICD-2.1, 5.2.4

A record is complete when its parts carry one issue of data (D1: follow one another by 6 s). Weeks are those nearest to the
log's observations.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from factorgraph.errors import InputError
from factorgraph.gpstime import WEEK_S, GpsTime
from factorgraph.types import Array
from scenarios.flights import _orbits as orbits
from scenarios.flights._rinex_navigation import Messages, unusable
from scenarios.flights._rinex_text import BDT_GPST_S
from scenarios.flights.ubx import GNSS, RXM_SFRBX, first_instant, read_ubx

Field = tuple[int, int, bool, float]  # first bit, bits, signed, unit
Fields = Mapping[str | int, Field]  # by name, or by column of a Kepler record
PI = math.pi

HOW_ID = (43, 3)
IONOSPHERE_PAGE = 56
GPS_CLOCK: Fields = {
    orbits.HEALTH: (64, 6, False, 1.0),
    "iodc": (168, 8, False, 1.0),
    "toc": (176, 16, False, 16.0),
    orbits.DELAY_1: (160, 8, True, 2.0**-31),
    orbits.F2: (192, 8, True, 2.0**-55),
    orbits.F1: (200, 16, True, 2.0**-43),
    orbits.F0: (216, 22, True, 2.0**-31),
}
GPS_ORBIT_1: Fields = {
    "iode": (48, 8, False, 1.0),
    orbits.CRS: (56, 16, True, 2.0**-5),
    orbits.DN: (72, 16, True, 2.0**-43 * PI),
    orbits.M0: (88, 32, True, 2.0**-31 * PI),
    orbits.CUC: (120, 16, True, 2.0**-29),
    orbits.ECC: (136, 32, False, 2.0**-33),
    orbits.CUS: (168, 16, True, 2.0**-29),
    orbits.SQRT_A: (184, 32, False, 2.0**-19),
    orbits.TOE: (216, 16, False, 16.0),
}
GPS_ORBIT_2: Fields = {
    orbits.CIC: (48, 16, True, 2.0**-29),
    orbits.OMEGA0: (64, 32, True, 2.0**-31 * PI),
    orbits.CIS: (96, 16, True, 2.0**-29),
    orbits.I0: (112, 32, True, 2.0**-31 * PI),
    orbits.CRC: (144, 16, True, 2.0**-5),
    orbits.OMEGA: (160, 32, True, 2.0**-31 * PI),
    orbits.OMEGA_DOT: (192, 24, True, 2.0**-43 * PI),
    "iode": (216, 8, False, 1.0),
    orbits.I_DOT: (224, 14, True, 2.0**-43 * PI),
}
GALILEO_WORDS: Mapping[int, Fields] = {
    1: {
        "iod": (6, 10, False, 1.0),
        orbits.TOE: (16, 14, False, 60.0),
        orbits.M0: (30, 32, True, 2.0**-31 * PI),
        orbits.ECC: (62, 32, False, 2.0**-33),
        orbits.SQRT_A: (94, 32, False, 2.0**-19),
    },
    2: {
        "iod": (6, 10, False, 1.0),
        orbits.OMEGA0: (16, 32, True, 2.0**-31 * PI),
        orbits.I0: (48, 32, True, 2.0**-31 * PI),
        orbits.OMEGA: (80, 32, True, 2.0**-31 * PI),
        orbits.I_DOT: (112, 14, True, 2.0**-43 * PI),
    },
    3: {
        "iod": (6, 10, False, 1.0),
        orbits.OMEGA_DOT: (16, 24, True, 2.0**-43 * PI),
        orbits.DN: (40, 16, True, 2.0**-43 * PI),
        orbits.CUC: (56, 16, True, 2.0**-29),
        orbits.CUS: (72, 16, True, 2.0**-29),
        orbits.CRC: (88, 16, True, 2.0**-5),
        orbits.CRS: (104, 16, True, 2.0**-5),
    },
    4: {
        "iod": (6, 10, False, 1.0),
        orbits.CIC: (22, 16, True, 2.0**-29),
        orbits.CIS: (38, 16, True, 2.0**-29),
        "toc": (54, 14, False, 60.0),
        orbits.F0: (68, 31, True, 2.0**-34),
        orbits.F1: (99, 21, True, 2.0**-46),
        orbits.F2: (120, 6, True, 2.0**-59),
    },
    5: {
        orbits.DELAY_1: (47, 10, True, 2.0**-32),
        orbits.DELAY_2: (57, 10, True, 2.0**-32),
        "e5b_hs": (67, 2, False, 1.0),
        "e1b_hs": (69, 2, False, 1.0),
        "e5b_dvs": (71, 1, False, 1.0),
        "e1b_dvs": (72, 1, False, 1.0),
    },
}
GALILEO_SOURCE = 1 | 4 | 512  # I/NAV of E1-B and E5b, clock of E5b and E1
BEIDOU_CLOCK: Fields = {
    "sow": (18, 20, False, 1.0),
    orbits.HEALTH: (38, 1, False, 1.0),
    "toc": (61, 17, False, 8.0),
    orbits.DELAY_1: (78, 10, True, 1e-10),
    orbits.DELAY_2: (88, 10, True, 1e-10),
    orbits.F2: (162, 11, True, 2.0**-66),
    orbits.F0: (173, 24, True, 2.0**-33),
    orbits.F1: (197, 22, True, 2.0**-50),
    "aode": (219, 5, False, 1.0),
}
BEIDOU_ORBIT_1: Fields = {
    "sow": (18, 20, False, 1.0),
    orbits.DN: (38, 16, True, 2.0**-43 * PI),
    orbits.CUC: (54, 18, True, 2.0**-31),
    orbits.M0: (72, 32, True, 2.0**-31 * PI),
    orbits.ECC: (104, 32, False, 2.0**-33),
    orbits.CUS: (136, 18, True, 2.0**-31),
    orbits.CRC: (154, 18, True, 2.0**-6),
    orbits.CRS: (172, 18, True, 2.0**-6),
    orbits.SQRT_A: (190, 32, False, 2.0**-19),
    "toe_high": (222, 2, False, 8.0 * 2**15),
}
BEIDOU_ORBIT_2: Fields = {
    "sow": (18, 20, False, 1.0),
    "toe_low": (38, 15, False, 8.0),
    orbits.I0: (53, 32, True, 2.0**-31 * PI),
    orbits.CIC: (85, 18, True, 2.0**-31),
    orbits.OMEGA_DOT: (103, 24, True, 2.0**-43 * PI),
    orbits.CIS: (127, 18, True, 2.0**-31),
    orbits.I_DOT: (145, 14, True, 2.0**-43 * PI),
    orbits.OMEGA0: (159, 32, True, 2.0**-31 * PI),
    orbits.OMEGA: (191, 32, True, 2.0**-31 * PI),
}
KLOBUCHAR_UNITS = [2.0**e for e in (-30, -27, -24, -24, 11, 14, 16, 16)]
KLOBUCHAR_BITS = {"G": 56, "C": 98}

Parts = dict[int, dict[str | int, float]]  # subframe or word -> its fields


def read_ubx_messages(path: Path, into: Messages) -> None:
    """Append the records of a log. Raises InputError where it has no RXM-SFRBX or no observation to tell the week."""
    log = read_ubx(path)
    if RXM_SFRBX not in log.payloads:
        raise InputError(f"{path}: no RXM-SFRBX (02-13) message, so no orbits; give a RINEX navigation file in gnss.nav")
    now = first_instant(log)
    parts: dict[str, Parts] = {}
    issued: dict[str, tuple[float, ...]] = {}
    for name, message, bits, n_bits in _subframes(log.payloads[RXM_SFRBX]):
        known = parts.setdefault(name, {})
        if message == "lnav":
            record = _lnav(name, bits, n_bits, known, into)
        elif message == "inav":
            record = _inav(bits, n_bits, known)
        else:
            record = _d1(bits, n_bits, known, into)
        if record is None:
            continue
        toc, data = record
        key = (toc, float(data[orbits.TOE]), float(data[3]), float(data[orbits.HEALTH]))
        if issued.get(name) == key:
            continue
        issued[name] = key
        if problem := unusable(data, name[0]):
            into.dropped[problem] += 1
            continue
        into.satellites.append(name)
        into.times.append(_near(toc + (BDT_GPST_S if name[0] == "C" else 0.0), now))
        into.data.append(data)


def _near(sow: float, now: GpsTime) -> GpsTime:
    """The instant with these seconds of week that is nearest to another."""
    return now + float((sow - now.sow + WEEK_S / 2) % WEEK_S - WEEK_S / 2)


def _subframes(payloads: list[bytes]) -> Iterator[tuple[str, str, int, int]]:
    """Satellite, kind, bits without parity and their number of the messages that are used."""
    for payload in payloads:
        if len(payload) < 8 or len(payload) != 8 + 4 * payload[4]:
            continue
        gnss, number, signal, n = payload[0], payload[1], payload[2], payload[4]
        words = struct.unpack(f"<{n}I", payload[8:])
        letter = GNSS.get(gnss, "")
        name = f"{letter}{number:02d}"
        if letter in ("G", "J") and signal == 0 and n == 10:
            yield name, "lnav", _joined([(w >> 6) & 0xFFFFFF for w in words], [24] * 10), 240
        elif letter == "E" and signal in (1, 5) and n >= 8:
            yield name, "inav", _joined(list(words[:8]), [32] * 8), 256
        elif letter == "C" and signal in (0, 2, 4) and n == 10 and 6 <= number <= 58:
            sizes = [26, *[22] * 9]
            yield name, "d1", _joined([(w & 0x3FFFFFFF) >> (30 - size) for w, size in zip(words, sizes, strict=True)], sizes), 224


def _joined(words: list[int], sizes: list[int]) -> int:
    bits = 0
    for word, size in zip(words, sizes, strict=True):
        bits = bits << size | word
    return bits


def _take(bits: int, n_bits: int, first: int, size: int) -> int:
    return bits >> (n_bits - first - size) & ((1 << size) - 1)


def _fields(bits: int, n_bits: int, fields: Fields) -> dict[str | int, float]:
    out = {}
    for name, (first, size, is_signed, unit) in fields.items():
        value = _take(bits, n_bits, first, size)
        out[name] = (value - (1 << size) if is_signed and value >> (size - 1) else value) * unit
    return out


def _lnav(name: str, bits: int, n_bits: int, known: Parts, into: Messages) -> tuple[float, Array] | None:
    """The record that a subframe completes: (time of clock of week, columns)."""
    subframe = _take(bits, n_bits, *HOW_ID)
    if subframe == 4 and _take(bits, n_bits, 50, 6) == IONOSPHERE_PAGE:
        into.klobuchar[name[0]] = _klobuchar(bits, n_bits, KLOBUCHAR_BITS["G"])
    fields = {1: GPS_CLOCK, 2: GPS_ORBIT_1, 3: GPS_ORBIT_2}.get(subframe)
    if fields is None:
        return None
    known[subframe] = _fields(bits, n_bits, fields)
    if len(known) < 3 or not known[1]["iodc"] == known[2]["iode"] == known[3]["iode"]:
        return None
    return _record(known, known[2]["iode"])


def _inav(bits: int, n_bits: int, known: Parts) -> tuple[float, Array] | None:
    even, odd = _take(bits, n_bits, 0, 2), _take(bits, n_bits, 128, 2)
    if even != 0 or odd != 2:  # nominal pages, the even one first
        return None
    word = _take(bits, n_bits, 2, 112) << 16 | _take(bits, n_bits, 130, 16)
    kind = word >> 122
    if kind not in GALILEO_WORDS:
        return None
    known[kind] = _fields(word, 128, GALILEO_WORDS[kind])
    if len(known) < 5 or len({known[k]["iod"] for k in (1, 2, 3, 4)}) > 1:
        return None
    toc, data = _record(known, known[1]["iod"])
    flags = known[5]
    data[orbits.CODES] = GALILEO_SOURCE
    data[orbits.HEALTH] = flags["e1b_dvs"] + 2 * flags["e1b_hs"] + 64 * flags["e5b_dvs"] + 128 * flags["e5b_hs"]
    return toc, data


def _d1(bits: int, n_bits: int, known: Parts, into: Messages) -> tuple[float, Array] | None:
    subframe = _take(bits, n_bits, 15, 3)
    fields = {1: BEIDOU_CLOCK, 2: BEIDOU_ORBIT_1, 3: BEIDOU_ORBIT_2}.get(subframe)
    if fields is None:
        return None
    if subframe == 1:
        into.klobuchar["C"] = _klobuchar(bits, n_bits, KLOBUCHAR_BITS["C"])
    known[subframe] = _fields(bits, n_bits, fields)
    if len(known) < 3 or [known[k]["sow"] - known[1]["sow"] for k in (2, 3)] != [6.0, 12.0]:
        return None
    toc, data = _record(known, known[1]["aode"])
    data[orbits.TOE] = known[2]["toe_high"] + known[3]["toe_low"]
    return toc, data


def _record(known: Parts, issue: float) -> tuple[float, Array]:
    """Time of clock of week and the columns of a record."""
    data = np.zeros(orbits.N_KEPLER)
    toc = 0.0
    for fields in known.values():
        for name, value in fields.items():
            if isinstance(name, int):
                data[name] = value
        toc = fields.get("toc", toc)
    data[3] = issue
    return toc, data


def _klobuchar(bits: int, n_bits: int, first: int) -> Array:
    fields: Fields = {k: (first + 8 * k, 8, True, unit) for k, unit in enumerate(KLOBUCHAR_UNITS)}
    return np.array(list(_fields(bits, n_bits, fields).values()))
