"""Raw observations in u-blox logs (RXM-RAWX).

Tags are receiver time; the receiver's clock is not steered, so that tags and code jump by milliseconds together. Phases come
in cycles with the sign of the code. Loss of lock follows from lock times: shorter than before, or than the time since the
satellite's last phase; and from a change of what is known of the half cycle.

Source: u-blox F9 and X20 HPG interface descriptions, UBX-RXM-RAWX and the table of signal identifiers.
"""

from __future__ import annotations

import math
import struct
from collections import Counter
from pathlib import Path

import numpy as np

from factorgraph.errors import InputError
from factorgraph.gpstime import GpsTime
from factorgraph.measurements import ReadReport
from factorgraph.types import Array, BoolArray, IntArray
from scenarios.flights.rinex import RawObservations
from scenarios.flights.signals import wavelength_m
from scenarios.flights.tables import Names
from scenarios.flights.ubx import GNSS, RAWX_HEAD, RXM_RAWX, Rows, UbxLog, first_instant, read_ubx

# signals by constellation: number -> RINEX band and attribute
SIGNALS = {
    "G": {0: "1C", 3: "2L", 4: "2S", 6: "5I", 7: "5Q"},
    "S": {0: "1C"},
    "E": {0: "1C", 1: "1B", 3: "5I", 4: "5Q", 5: "7I", 6: "7Q", 8: "6B", 9: "6C"},
    "C": {0: "2I", 1: "2I", 2: "7I", 3: "7I", 4: "6I", 10: "6I", 5: "1P", 6: "1D", 7: "5P", 8: "5D"},
    "J": {0: "1C", 1: "1Z", 4: "2S", 5: "2L", 8: "5I", 9: "5Q", 12: "1E"},
    "R": {0: "1C", 2: "2C"},
    "I": {0: "5A"},
}
RAWX = np.dtype(
    {
        "names": ["code", "phase", "doppler", "gnss", "number", "signal", "channel", "lock_ms", "cn0", "phase_sd", "status"],
        "formats": ["<f8", "<f8", "<f4", "u1", "u1", "u1", "u1", "<u2", "u1", "u1", "u1"],
        "offsets": [0, 8, 16, 20, 21, 22, 23, 24, 26, 28, 30],
        "itemsize": 32,
    }
)
CODE_VALID, PHASE_VALID, HALF_KNOWN, HALF_TAKEN_OFF = 1, 2, 4, 8  # bits of `status`
NO_PHASE_SD = 15
LOCK_LIMIT_MS = 64_500  # counted no further
GLONASS_CHANNEL_0 = 7
LOSS, HALF = 1, 2  # bits of the loss-of-lock indicator


def read_ubx_observations(path: Path) -> RawObservations:
    """Raw observations of RXM-RAWX. Raises InputError where there are none; what cannot be used is counted."""
    log = read_ubx(path)
    start = first_instant(log)
    t0 = GpsTime(start.week, math.floor(start.sow))
    dropped = Counter(log.dropped)
    t_s, rows, epoch = _measurements(log, t0, dropped)
    satellite, signal_name = _identities(rows)
    known = satellite != ""
    usable = known & ((rows["status"] & (CODE_VALID | PHASE_VALID)) != 0)
    dropped["measurement of an unknown satellite or signal"] += int((~known).sum())
    dropped["measurement without code and phase"] += int((known & ~usable).sum())
    satellites, sat = np.unique(satellite[usable], return_inverse=True)
    signals, signal = np.unique(signal_name[usable], return_inverse=True)
    rows, epoch = rows[usable], epoch[usable]
    order = np.lexsort((signal, sat, epoch))
    key = np.column_stack([epoch, sat, signal])[order]
    first = np.any(np.diff(key, axis=0, prepend=-1) != 0, axis=1)
    dropped["satellite and signal twice in one epoch"] += int((~first).sum())
    rows, epoch, sat, signal = rows[order][first], *key[first].T
    if not len(rows):
        raise InputError(f"{path}: no usable measurement in {len(t_s)} RXM-RAWX messages")
    filled, epoch = np.unique(epoch, return_inverse=True)
    t_s = t_s[filled]
    phase_valid = ((rows["status"] & PHASE_VALID) != 0) & ((rows["phase_sd"] & 15) != NO_PHASE_SD)
    channel = rows["channel"].astype(int) - GLONASS_CHANNEL_0
    wavelength = [wavelength_m(signals[k], c) for k, c in zip(signal.tolist(), channel.tolist(), strict=True)]
    return RawObservations(
        t0=t0,
        t_s=t_s,
        clock_s=np.full(len(t_s), np.nan),
        clock_applied=False,
        epoch=epoch,
        sat=sat,
        signal=signal,
        satellites=tuple(satellites.tolist()),
        signals=tuple(signals.tolist()),
        wavelength_m=np.array(wavelength),
        code_m=np.where((rows["status"] & CODE_VALID) != 0, rows["code"], np.nan),
        phase_cyc=np.where(phase_valid, rows["phase"], np.nan),
        doppler_hz=rows["doppler"].astype(float),
        cn0_dbhz=rows["cn0"].astype(float),
        lli=_loss_of_lock(t_s[epoch], sat * len(signals) + signal, rows, phase_valid),
        approx_ecef=None,
        antenna_delta_m=np.zeros(3),
        marker="",
        phase_shift_cyc={},
        report=ReadReport(str(path), len(rows), {reason: n for reason, n in dropped.items() if n}),
    )


def _measurements(log: UbxLog, t0: GpsTime, dropped: Counter[str]) -> tuple[Array, Rows, IntArray]:
    """Epochs in order of time (m,), their measurements one after another (n,), and the epoch of each."""
    t, blocks, latest = [], [], -math.inf
    for payload in log.payloads[RXM_RAWX]:
        if len(payload) < RAWX_HEAD or len(payload) != RAWX_HEAD + RAWX.itemsize * payload[11]:
            dropped["RXM-RAWX of a wrong length"] += 1
            continue
        tow, week = struct.unpack_from("<dH", payload)
        since = GpsTime(week, tow) - t0 if math.isfinite(tow) else math.nan
        if not latest < since < math.inf:
            dropped["epoch that repeats or goes back in time"] += 1
            continue
        latest = since
        t.append(since)
        blocks.append(payload[RAWX_HEAD:])
    epoch = np.repeat(np.arange(len(t)), [len(block) // RAWX.itemsize for block in blocks])
    return np.array(t), np.frombuffer(b"".join(blocks), RAWX), epoch


def _identities(rows: Rows) -> tuple[Names, Names]:
    """RINEX names of satellites and signals (n,); "" where either is unknown."""
    key = rows["gnss"].astype(np.int64) << 16 | rows["number"].astype(np.int64) << 8 | rows["signal"]
    distinct, inverse = np.unique(key, return_inverse=True)
    named = [_identity(k >> 16, k >> 8 & 255, k & 255) for k in distinct.tolist()]
    satellite, signal = np.array(named or [("", "")]).T
    return satellite[inverse], signal[inverse]


def _identity(gnss: int, number: int, signal: int) -> tuple[str, str]:
    letter = GNSS.get(gnss, "")
    band = SIGNALS.get(letter, {}).get(signal)
    number -= 100 if letter == "S" else 0
    return (f"{letter}{number:02d}", letter + band) if band and 0 < number < 100 else ("", "")


def _loss_of_lock(t_s: Array, series: IntArray, rows: Rows, phase_valid: BoolArray) -> IntArray:
    """Loss-of-lock indicators (n,): bit 0 where the phase may have slipped since the one before, bit 1 half a cycle open."""
    half_open = (rows["status"] & HALF_KNOWN) == 0
    order = np.lexsort((t_s, series))
    order = order[phase_valid[order]]
    same = np.diff(series[order], prepend=-1) == 0
    lock = rows["lock_ms"].astype(np.int64)[order]
    elapsed_ms = np.diff(t_s[order], prepend=0.0) * 1e3
    shorter = (np.diff(lock, prepend=0) < 0) | ((lock < LOCK_LIMIT_MS) & (lock < elapsed_ms - 1.0))
    state = (rows["status"] & (HALF_KNOWN | HALF_TAKEN_OFF))[order]
    lost = np.zeros(len(rows), bool)
    lost[order] = same & (shorter | (np.diff(state.astype(np.int64), prepend=0) != 0))
    return np.asarray(LOSS * lost + HALF * (half_open & phase_valid), np.int64)
