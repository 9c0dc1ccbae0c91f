"""RINEX observation files, versions 2.11 to 4, as arrays.

The bytes are decoded in one pass by fixed columns; nothing loops over satellites in Python. Values are the file's own:
phases keep the shifts the file says it applied (SYS / PHASE SHIFT aligns signals of one band and is meant to stay), only
scale factors are undone. Numbers written as 0 or left blank are absent. A power failure (event flag 1) counts as loss of
lock on every signal of its epoch.

Source: RINEX 2.11, tables A1-A2; RINEX 3.05, tables A2-A3; RINEX 4.01.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from factorgraph.errors import InputError
from factorgraph.gpstime import GpsTime, leap_seconds
from factorgraph.measurements import GnssStream, ReadReport
from factorgraph.types import Array, BoolArray, IntArray
from scenarios.flights import _rinex_kernels as kernels
from scenarios.flights._rinex_observation_header import ObservationHeader, check_unchanged, read_header
from scenarios.flights._rinex_text import BDT_GPST_S, RinexText, read_rinex
from scenarios.flights.navigation import Navigation
from scenarios.flights.signals import SYSTEMS, wavelength_m
from scenarios.flights.tables import spikes

# Columns of year, month, day, hour, minute, second, event flag, number of records, receiver clock offset.
EPOCH_3 = np.array([(2, 6), (7, 9), (10, 12), (13, 15), (16, 18), (18, 29), (31, 32), (32, 35), (41, 56)])
EPOCH_2 = np.array([(1, 3), (4, 6), (7, 9), (10, 12), (13, 15), (15, 26), (28, 29), (29, 32), (68, 80)])
YEAR, MONTH, DAY, HOUR, MINUTE, SECOND, FLAG, COUNT, CLOCK = range(9)
POWER_FAILURE, NEW_HEADER, SLIPS = 1, 4, 6
MAX_NOTES = 20
SLOTS = 64  # satellite numbers per system in keys


@dataclass(frozen=True, slots=True)
class RawObservations:
    """A receiver's file: a row per epoch, satellite and signal, sorted so; as GnssStream without satellite states."""

    t0: GpsTime  # first epoch
    t_s: Array  # (m,) receiver tags, seconds since t0
    clock_s: Array  # (m,) receiver clock offset written with the epoch, NaN where absent
    clock_applied: bool  # tags and observations are already free of clock_s
    epoch: IntArray  # (n,)
    sat: IntArray  # (n,)
    signal: IntArray  # (n,)
    satellites: tuple[str, ...]
    signals: tuple[str, ...]
    wavelength_m: Array  # (n,) NaN for GLONASS satellites of unknown channel
    code_m: Array  # (n,)
    phase_cyc: Array  # (n,)
    doppler_hz: Array  # (n,)
    cn0_dbhz: Array  # (n,)
    lli: IntArray  # (n,)
    approx_ecef: Array | None
    antenna_delta_m: Array  # (3,) height, east, north of the antenna over the marker
    marker: str
    phase_shift_cyc: dict[str, float]  # corrections the file's phases contain, by signal
    report: ReadReport


@dataclass(slots=True)
class _Tally:
    """What was dropped, with the first few places."""

    dropped: Counter[str]
    notes: list[str]

    def add(self, reason: str, n: int, line: int | None = None) -> None:
        if n:
            self.dropped[reason] += n
            if line is not None and len(self.notes) < MAX_NOTES:
                self.notes.append(f"line {line + 1}: {reason}")


@dataclass(frozen=True, slots=True)
class _Layout:
    """Where the observation records are."""

    t0: GpsTime
    t_s: Array  # (m,)
    clock_s: Array  # (m,)
    power_failure: BoolArray  # (m,)
    line: IntArray  # (n,) first line of each record
    epoch: IntArray  # (n,)
    system: NDArray[np.uint8]  # (n,) letter
    number: IntArray  # (n,)


def read_observations(path: Path) -> RawObservations:
    """Read a RINEX 2.11, 3.x or 4 observation file (plain, gzip, Unix compress, Hatanaka).

    Raises InputError for files that are absent, empty, of another kind, of an unknown version, cut inside the header or
    without any observation. Epochs and numbers that cannot be used are dropped and counted in `report`.
    """
    text = read_rinex(Path(path))
    header = read_header(text)
    tally = _Tally(Counter(), list(text.remarks))
    raw = np.frombuffer(text.data, np.uint8)
    layout = _layout_2(text, raw, header, tally) if text.version < 3 else _layout_3(text, raw, header, tally)
    parts = [_decode(text, raw, header, layout, system, tally) for system in header.types]
    return _assemble(text, header, layout, [p for p in parts if p is not None], tally)


def gnss_stream(
    raw: RawObservations,
    navigation: Navigation,
    t0: GpsTime,
    systems: str = "GREJC",
    signals: Iterable[str] | None = None,
) -> tuple[GnssStream, ReadReport]:
    """Attach satellite states; tags become seconds since t0.

    Keeps the systems and, if given, the signals ("G1C") named. A satellite's signals of one epoch share the state of the
    first one with a code (0.2 mm at most). Raises InputError if nothing is left.
    """
    wanted = None if signals is None else set(signals)
    use = np.array([s[0] in systems and (wanted is None or s in wanted) for s in raw.signals], bool)
    rows = np.flatnonzero(use[raw.signal])
    if not rows.size:
        chosen = systems if wanted is None else f"{systems} {' '.join(sorted(wanted))}"
        raise InputError(f"{raw.report.source}: no observation of {chosen} (the file has {' '.join(raw.signals)})")
    epoch, old_epoch = _compressed(raw.epoch[rows])
    sat, old_sat = _compressed(raw.sat[rows])
    signal, old_signal = _compressed(raw.signal[rows])
    satellites, names = tuple(raw.satellites[i] for i in old_sat), tuple(raw.signals[i] for i in old_signal)
    t_s = raw.t_s[old_epoch] + (raw.t0 - t0)
    code = raw.code_m[rows]

    first = np.flatnonzero(np.diff(epoch, prepend=-1) | np.diff(sat, prepend=-1))
    group = np.repeat(np.arange(first.size), np.diff(first, append=rows.size))
    coded = np.minimum.reduceat(np.where(np.isfinite(code), np.arange(rows.size), rows.size), first)
    group_code = np.append(code, np.nan)[coded]
    t_sv_s = t_s[epoch[first]] - group_code / 299_792_458.0
    states = navigation.satellite_states(satellites, sat[first], t0, t_sv_s)
    delay = navigation.group_delay_m(states.record[group], names, signal)

    wavelength = raw.wavelength_m[rows]
    unknown = np.flatnonzero(np.isnan(wavelength))
    if unknown.size:
        wavelength[unknown] = _wavelengths(names, satellites, navigation.glonass_channels)[signal[unknown], sat[unknown]]
    stream = GnssStream(
        t_s, epoch, sat, signal, satellites, names, wavelength, code, raw.phase_cyc[rows], raw.doppler_hz[rows],
        raw.cn0_dbhz[rows], raw.lli[rows], states.pos_ecef[group], states.vel_ecef[group], states.clock_m[group] - delay,
        states.clock_mps[group], raw.approx_ecef, navigation.klobuchar,
    )  # fmt: skip
    without = np.isnan(states.clock_m)
    notes = raw.report.notes
    if without.any():
        named = " ".join(satellites[i] for i in np.unique(sat[first[without]]))
        notes += (f"{int(without[group].sum())} rows without satellite state ({named})",)
    dropped = dict(raw.report.dropped)
    if rows.size < len(raw.epoch):
        dropped["system or signal not used"] = len(raw.epoch) - int(rows.size)
    return stream, ReadReport(raw.report.source, int(rows.size), dropped, notes)


def _compressed(index: IntArray) -> tuple[IntArray, IntArray]:
    """Indices renumbered without gaps, and the old number of each new one."""
    used = np.zeros(int(index.max()) + 1, bool)
    used[index] = True
    return (np.cumsum(used) - 1)[index], np.flatnonzero(used)


def _wavelengths(signals: tuple[str, ...], satellites: tuple[str, ...], channels: dict[str, int]) -> Array:
    """(signals, satellites)."""
    return np.array([[wavelength_m(s, channels.get(name)) for name in satellites] for s in signals])


# Where the records are


def _layout_3(text: RinexText, raw: NDArray[np.uint8], header: ObservationHeader, tally: _Tally) -> _Layout:
    n_lines = _last_full_line(text)
    lead = np.zeros(n_lines, np.uint8)
    filled = np.flatnonzero(text.ends[:n_lines] > text.starts[:n_lines])
    lead[filled] = raw[text.starts[filled]]
    heads = np.flatnonzero(lead == ord(">"))
    heads = heads[heads >= text.first_line]
    line, epoch, times, _ = _records(text, raw, header, tally, heads, n_lines, EPOCH_3, 1, None)
    places = text.starts[line][:, None] + np.arange(3)
    short = text.ends[line] < text.starts[line] + 3
    return _located(text, header, tally, times, line, epoch, _bytes_at(raw, places, short), "G")


def _layout_2(text: RinexText, raw: NDArray[np.uint8], header: ObservationHeader, tally: _Tally) -> _Layout:
    n_lines = _last_full_line(text)
    starts, length = text.starts[:n_lines], text.ends[:n_lines] - text.starts[:n_lines]
    # no observation has a point in column 18 of its line; events may leave their time blank
    dated = np.zeros(n_lines, bool)
    dated[length > 28] = raw[starts[length > 28] + 18] == ord(".")
    candidates = np.flatnonzero(~dated & (length > 28))
    flag = raw[starts[candidates] + 28]
    candidates = candidates[(flag >= ord("2")) & (flag <= ord("6"))]
    blank = (raw[starts[candidates][:, None] + np.arange(28)] == 32).all(axis=1)
    dated[candidates[blank]] = True
    heads = np.flatnonzero(dated)
    heads = heads[heads >= text.first_line]
    n_types = len(next(iter(header.types.values())))
    line, epoch, times, place = _records(text, raw, header, tally, heads, n_lines, EPOCH_2, max(1, -(-n_types // 5)), 12)
    list_line = place[:, 0]
    places = (text.starts[list_line] + 32 + 3 * place[:, 1])[:, None] + np.arange(3)
    short = places[:, 2] >= text.ends[list_line]
    default = text.system if text.system and text.system in SYSTEMS else "G"
    return _located(text, header, tally, times, line, epoch, _bytes_at(raw, places, short), default)


def _last_full_line(text: RinexText) -> int:
    """Number of lines to look at, without blank ones at the end."""
    filled = np.flatnonzero(text.ends > text.starts)
    return int(filled[-1]) + 1 if filled.size else 0


def _bytes_at(raw: NDArray[np.uint8], places: IntArray, absent: BoolArray) -> NDArray[np.uint8]:
    out = raw[np.minimum(places, raw.size - 1)]
    out[absent] = 0
    return out


def _records(
    text: RinexText,
    raw: NDArray[np.uint8],
    header: ObservationHeader,
    tally: _Tally,
    heads: IntArray,
    n_lines: int,
    bounds: IntArray,
    lines_each: int,
    listed_per_line: int | None,
) -> tuple[IntArray, IntArray, Array, IntArray]:
    """Records of the observation epochs that begin at lines `heads`.

    Returns the first line (n,) and epoch (n,) of each record, the epochs' numbers (m, 9), and for RINEX 2 the line and
    place (n, 2) in the epoch's list of satellites.
    """
    if not heads.size:
        raise InputError(f"{text.path}: no epoch in the file")
    fields = kernels.columns(raw, text.starts[heads], text.ends[heads], bounds)
    available = np.append(heads[1:], n_lines) - heads - 1
    flag = np.where(np.isnan(fields[:, FLAG]), 0.0, fields[:, FLAG])
    events = np.flatnonzero((flag > POWER_FAILURE) & (flag <= SLIPS))
    for i in events[flag[events] == NEW_HEADER]:
        check_unchanged(text, int(heads[i]) + 1, int(heads[i] + 1 + available[i]), header)
    tally.add("event record (flag 2-6)", len(events))
    # blank clock offsets are usual, the rest must be there
    good = (flag <= POWER_FAILURE) & np.isfinite(fields[:, [*range(SECOND + 1), COUNT]]).all(axis=1)
    good &= fields[:, COUNT] >= 0
    broken = np.flatnonzero(~good & ~((flag > POWER_FAILURE) & (flag <= SLIPS)))
    if broken.size:
        tally.add("epoch line unreadable", len(broken), int(heads[broken[0]]))
    kept = np.flatnonzero(good)
    promised = fields[kept, COUNT].astype(np.int64)
    n_list = np.zeros_like(promised) if listed_per_line is None else np.maximum(-(-promised // listed_per_line) - 1, 0)
    room = np.maximum(available[kept] - n_list, 0) // lines_each
    count = np.minimum(promised, room)
    short = np.flatnonzero(room < promised)
    last = short.size and kept[short[-1]] == heads.size - 1
    if last:
        tally.add("satellite missing from the last epoch (file cut short)", int((promised - count)[short[-1]]), int(heads[-1]))
        short = short[:-1]
    if short.size:
        missing = int((promised - count)[short].sum())
        tally.add("satellite announced by its epoch but not there", missing, int(heads[kept[short[0]]]))
    surplus = np.flatnonzero(available[kept] - n_list > promised * lines_each)
    if surplus.size:
        extra = int((available[kept] - n_list - promised * lines_each)[surplus].sum())
        tally.add("line beyond its epoch's satellites", extra, int(heads[kept[surplus[0]]]))
    epoch = np.repeat(np.arange(kept.size), count)
    within = np.arange(epoch.size) - np.repeat(np.cumsum(count) - count, count)
    line = heads[kept][epoch] + 1 + n_list[epoch] + within * lines_each
    per_line = listed_per_line or 1
    place = np.column_stack([heads[kept][epoch] + within // per_line, within % per_line])
    fields[:, FLAG] = flag
    return line, epoch, fields[kept], place


def _located(
    text: RinexText,
    header: ObservationHeader,
    tally: _Tally,
    times: Array,
    line: IntArray,
    epoch: IntArray,
    name: NDArray[np.uint8],
    default_system: str,
) -> _Layout:
    """Drop records without a usable satellite or time and put epochs on one time axis."""
    name = name.astype(np.int64)
    letter = np.where(name[:, 0] == 32, ord(default_system), name[:, 0])
    tens, ones = np.where(name[:, 1] == 32, 0, name[:, 1] - 48), name[:, 2] - 48
    readable = (tens >= 0) & (tens <= 9) & (ones >= 0) & (ones <= 9) & (10 * tens + ones > 0) & (10 * tens + ones < SLOTS)
    known = np.isin(letter, np.frombuffer("".join(s for s, t in header.types.items() if t).encode(), np.uint8))
    if not readable.all():
        tally.add("satellite unreadable", int((~readable).sum()), int(line[np.flatnonzero(~readable)[0]]))
    tally.add("satellite of a system without observation types", int((readable & ~known).sum()))

    t0, t_s = _time_axis(text, header, times)
    impossible = np.isnan(t_s)
    astray = np.zeros(len(t_s), bool)
    astray[~impossible] = spikes(t_s[~impossible])
    tally.add("epoch with a time far from its neighbours'", int(astray.sum()))
    t_s[astray] = np.nan
    seen = np.maximum.accumulate(np.where(np.isnan(t_s), -np.inf, t_s))
    ahead = np.isfinite(t_s) & np.concatenate([[True], np.nan_to_num(t_s[1:], nan=-np.inf) > seen[:-1]])
    tally.add("epoch with an impossible date", int(impossible.sum()))
    tally.add("epoch that repeats or goes back in time", int((~ahead & np.isfinite(t_s)).sum()))

    take = readable & known & ahead[epoch]
    filled = np.zeros(len(t_s), bool)
    filled[epoch[take]] = True
    tally.add("epoch without a usable satellite", int((ahead & ~filled).sum()))
    kept = np.flatnonzero(filled)
    if not kept.size:
        raise InputError(f"{text.path}: no usable observation ({_reasons(tally)})")
    renumbered = np.cumsum(filled) - 1
    clock = times[kept, CLOCK]
    first = float(t_s[kept[0]])
    return _Layout(
        t0 + first,
        t_s[kept] - first,
        np.where(np.isfinite(clock), clock, np.nan),
        times[kept, FLAG] == POWER_FAILURE,
        line[take],
        renumbered[epoch[take]],
        letter[take].astype(np.uint8),
        (10 * tens + ones)[take],
    )


def _reasons(tally: _Tally) -> str:
    return "; ".join(f"{n} x {why}" for why, n in tally.dropped.items()) or "no epoch holds a satellite"


def _time_axis(text: RinexText, header: ObservationHeader, times: Array) -> tuple[GpsTime, Array]:
    """GPST of the first possible epoch, and seconds from it of all; NaN for impossible dates."""
    year = np.where(times[:, YEAR] < 80, times[:, YEAR] + 2000, times[:, YEAR] + 1900) if text.version < 3 else times[:, YEAR]
    possible = (year >= 1980) & (year < 2200)
    for column, low, high in ((MONTH, 1, 12), (DAY, 1, 31), (HOUR, 0, 23), (MINUTE, 0, 59), (SECOND, 0, 61)):
        possible &= (times[:, column] >= low) & (times[:, column] <= high)
    if not possible.any():
        raise InputError(f"{text.path}: no epoch with a possible date")
    months = ((year - 1970) * 12 + times[:, MONTH] - 1)[possible].astype(np.int64)
    day = months.astype("M8[M]").astype("M8[D]").astype(np.int64) + times[possible, DAY].astype(np.int64) - 1
    of_day = times[possible, HOUR] * 3600 + times[possible, MINUTE] * 60 + times[possible, SECOND]
    t_s = np.full(len(times), np.nan)
    t_s[possible] = (day - day[0]) * 86_400.0 + (of_day - of_day[0])
    days = int(day[0]) - 3657  # from 1970-01-01 to 1980-01-06
    t0 = GpsTime(days // 7, (days % 7) * 86_400.0 + float(of_day[0]))
    if header.time_system == "C":
        t0 = t0 + BDT_GPST_S
    elif header.time_system == "R":
        t0 = t0 + leap_seconds(t0.calendar())
    return t0, t_s


# What the records hold


@dataclass(frozen=True, slots=True)
class _Decoded:
    """Rows of one system: a row per record and signal that has a code, phase or Doppler."""

    epoch: IntArray
    number: IntArray
    signal: IntArray  # into `signals`
    signals: tuple[str, ...]
    values: Array  # (4, n) code, phase, Doppler, C/N0
    lli: IntArray


def _decode(
    text: RinexText, raw: NDArray[np.uint8], header: ObservationHeader, layout: _Layout, system: str, tally: _Tally
) -> _Decoded | None:
    rows = np.flatnonzero(layout.system == ord(system))
    types = header.types[system]
    signals = tuple(dict.fromkeys(t[1:] for t in types if t and t[0] in "CLD"))
    if not rows.size or not signals:
        return None
    per_line, margin = (5, 0) if text.version < 3 else (len(types), 3)
    values, lli, ssi, unreadable = kernels.observations(
        raw, text.starts, text.ends, layout.line[rows], len(types), per_line, margin
    )
    tally.add("number unreadable", unreadable)
    for name, factor in header.scale.get(system, {}).items():
        if name in types and factor != 1.0:
            values[:, types.index(name)] /= factor
    cells = np.full((4, len(rows), len(signals)), np.nan)
    slips, strength = np.zeros((len(rows), len(signals)), np.int64), np.zeros((len(rows), len(signals)), np.int8)
    for column, name in enumerate(types):
        if name and name[1:] in signals and name[0] in "CLDS":
            place = signals.index(name[1:])
            cells["CLDS".index(name[0]), :, place] = values[:, column]
            if name[0] == "L":
                slips[:, place], strength[:, place] = lli[:, column] & 3, ssi[:, column]
    cells[cells == 0.0] = np.nan
    # without its own observation the strength is known in steps of 6 dB
    coarse = np.isnan(cells[3]) & (strength > 0)
    cells[3][coarse] = 6.0 * strength[coarse] + 3.0
    record, signal = np.nonzero(np.isfinite(cells[:3]).any(axis=0))
    epoch = layout.epoch[rows][record]
    loss = slips[record, signal] | layout.power_failure[epoch]
    return _Decoded(
        epoch, layout.number[rows][record], signal, tuple(system + s for s in signals), cells[:, record, signal], loss
    )


def _assemble(
    text: RinexText, header: ObservationHeader, layout: _Layout, parts: list[_Decoded], tally: _Tally
) -> RawObservations:
    """One table sorted by epoch, satellite and signal."""
    if not parts:
        raise InputError(f"{text.path}: the header declares no code, phase or Doppler of the satellites in the file")
    signals = tuple(sorted({s for p in parts for s in p.signals}))
    letters = sorted({p.signals[0][0] for p in parts})
    signal = np.concatenate([np.array([signals.index(s) for s in p.signals], np.int64)[p.signal] for p in parts])
    slot = np.concatenate([p.number + SLOTS * letters.index(p.signals[0][0]) for p in parts])
    epoch = np.concatenate([p.epoch for p in parts])
    key = (epoch * (SLOTS * len(letters)) + slot) * len(signals) + signal
    order = np.argsort(key, kind="stable")
    repeated = np.diff(key[order], prepend=-1) == 0
    tally.add("satellite twice in one epoch", int(repeated.sum()))
    order = order[~repeated]
    if not order.size:
        raise InputError(f"{text.path}: no usable observation ({_reasons(tally)})")
    values = np.concatenate([p.values for p in parts], axis=1)[:, order]
    sat, slots = _compressed(slot[order])
    satellites = tuple(f"{letters[k // SLOTS]}{k % SLOTS:02d}" for k in slots.tolist())
    dense_signal, used = _compressed(signal[order])
    signals = tuple(signals[k] for k in used)
    return RawObservations(
        t0=layout.t0,
        t_s=layout.t_s,
        clock_s=layout.clock_s,
        clock_applied=header.clock_applied,
        epoch=epoch[order],
        sat=sat,
        signal=dense_signal,
        satellites=satellites,
        signals=signals,
        wavelength_m=_wavelengths(signals, satellites, header.channels)[dense_signal, sat],
        code_m=values[0],
        phase_cyc=values[1],
        doppler_hz=values[2],
        cn0_dbhz=values[3],
        lli=np.concatenate([p.lli for p in parts])[order],
        approx_ecef=header.approx_ecef,
        antenna_delta_m=header.antenna_delta_m,
        marker=header.marker,
        phase_shift_cyc=header.phase_shift_cyc,
        report=ReadReport(str(text.path), int(order.size), dict(tally.dropped), tuple(tally.notes)),
    )
