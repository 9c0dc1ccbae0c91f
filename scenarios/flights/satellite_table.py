"""Tables with a row per epoch and satellite: pseudorange, range rate and the satellite's state as another program left them.

What such programs have done is declared, and undone or allowed for, so that the models see what a receiver gives:

    turned      satellites turned into the Earth-fixed frame of reception, by the travel time or by pseudorange / c
                (which holds the receiver's clock: 1 ms turns a satellite by 2 m) - turned back
    troposphere taken off the pseudoranges - the model's delay is put back, for the models to take off again
    true_time   times of reception free of the receiver's clock - the tag is the time plus the clock
    group_delay left in the pseudoranges - that of the broadcast messages is taken off
    ionosphere  no coefficients come with a table: nothing is taken off, here or later

Pseudoranges and range rates are free of the satellite's clock unless its offset has columns. The range rate is positive
receding and holds the receiver's clock drift: D = -rate / lambda.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from factorgraph.errors import InputError
from factorgraph.geodesy import C_MPS, OMEGA_E_RPS, C_en, geodetic_from_ecef
from factorgraph.gpstime import GpsTime
from factorgraph.measurements import GnssStream, ReadReport
from factorgraph.models.atmosphere import troposphere_m
from factorgraph.models.gnss import look_angles, turned_satellites
from factorgraph.sampling import interpolate
from factorgraph.types import Array, BoolArray, IntArray
from scenarios.flights.epochs import approximate_position, every, points
from scenarios.flights.navigation import Navigation
from scenarios.flights.schema import SYSTEMS, SatelliteTable
from scenarios.flights.signals import wavelength_m
from scenarios.flights.tables import Names, RawTable, Times, read_columns, read_times, time_columns

SAME_EPOCH_S = 1e-4
# distances from the Earth's centre at which satellites of a constellation are [m]
ORBIT_M = {"G": (25e6, 28e6), "R": (25e6, 26.2e6), "E": (23e6, 36e6), "J": (36e6, 47e6), "C": (26e6, 44e6)}
CODE_RANGE_M = (1e6, 1e8)  # a pseudorange with a receiver clock within a quarter of a second


@dataclass(frozen=True, slots=True)
class RawSatellites:
    """A table as read: rows with a satellite, a pseudorange and a state, sorted by time and satellite."""

    times: Times
    epoch_s: Array  # (m,) as `times` counts
    epoch: IntArray  # (n,)
    sat: IntArray  # (n,) row -> satellites
    satellites: tuple[str, ...]
    code_m: Array  # (n,)
    rate_mps: Array  # (n,) NaN where absent
    cn0_dbhz: Array  # (n,)
    pos_ecef: Array  # (n, 3) as in the table
    vel_ecef: Array  # (n, 3) NaN where absent
    clock_m: Array  # (n,)
    clock_mps: Array  # (n,)
    signal: str  # band and attribute, "1C"
    report: ReadReport


def read_satellites(path: Path, declared: SatelliteTable) -> RawSatellites:
    """Read a table. Raises InputError for missing columns, unknown satellites and files without a usable row.

    Rows that cannot be used are counted.
    """
    columns = [declared.code, *declared.position, *(declared.velocity or ())]
    columns += [c for c in (declared.range_rate, declared.cn0, declared.clock, declared.clock_rate) if c is not None]
    time_numbers, time_texts = time_columns(declared.time)
    names = [declared.satellite, *([declared.system] if declared.system is not None else [])]
    table = read_columns(path, declared, declared.kind, [*time_numbers, *columns], [*time_texts, *names])
    times = read_times(table, declared.time)
    name = _names(table, declared)
    keep, dropped = _usable(times.t_s, table, declared, name != "")
    _check_orbits(path, name[keep], np.linalg.norm(table.stack(declared.position)[keep], axis=1))
    rows = np.flatnonzero(keep)
    rows = rows[np.lexsort((name[rows], times.t_s[rows]))]
    t = times.t_s[rows]
    epoch = np.cumsum(np.diff(t, prepend=t[0]) > SAME_EPOCH_S, dtype=np.int64)
    satellites, sat = np.unique(name[rows], return_inverse=True)
    again = np.zeros(len(rows), bool)
    again[1:] = (np.diff(epoch) == 0) & (sat[1:] == sat[:-1])
    if again.any():
        dropped["satellite twice in one epoch"] = int(again.sum())
    first = np.flatnonzero(np.diff(epoch, prepend=-1))
    rows, epoch, sat = rows[~again], epoch[~again], sat[~again]

    def column(which: str | int | None, otherwise: float) -> Array:
        return np.full(len(rows), otherwise) if which is None else table.numbers[which][rows]

    velocity = np.full((len(rows), 3), np.nan) if declared.velocity is None else table.stack(declared.velocity)[rows]
    return RawSatellites(
        times,
        t[first],
        epoch,
        sat,
        tuple(satellites.tolist()),
        column(declared.code, np.nan),
        column(declared.range_rate, np.nan),
        column(declared.cn0, np.nan),
        table.stack(declared.position)[rows],
        velocity,
        column(declared.clock, 0.0),
        column(declared.clock_rate, 0.0),
        declared.signal,
        ReadReport(str(path), len(rows), {**table.dropped, **dropped}),
    )


def _names(table: RawTable, declared: SatelliteTable) -> Names:
    """RINEX name of every row's satellite, "" where it has none."""
    cells = table.texts[declared.satellite]
    systems = np.full(len(cells), declared.default_system) if declared.system is None else table.texts[declared.system]
    pairs, inverse = np.unique(np.column_stack([systems, cells]), axis=0, return_inverse=True)
    return np.array([_name(system, cell, declared) for system, cell in pairs.tolist()])[inverse.ravel()]


def _name(system: str, cell: str, declared: SatelliteTable) -> str:
    """ "G05" for a satellite's cells; "" where they name none."""
    if cell in declared.names:
        return declared.names[cell]
    if cell[:1] in SYSTEMS and cell[1:].isdigit():
        return f"{cell[0]}{int(cell[1:]):02d}"
    letter = declared.systems.get(_whole(system), system if declared.system is None or system in SYSTEMS else "")
    number = _whole(cell)
    if number in declared.names:
        return declared.names[number]
    if not letter or not number.isdigit():
        return ""
    offset = next((n for system_letter, n in declared.number_offset.items() if system_letter == letter), 0)
    prn = int(number) - offset
    return f"{letter}{prn:02d}" if 0 < prn < 100 else ""


def _whole(cell: str) -> str:
    """A number such as 4.0 as "4"; other text as it is."""
    try:
        value = float(cell)
    except ValueError:
        return cell
    return str(int(value)) if value.is_integer() else cell


def _usable(t_s: Array, table: RawTable, declared: SatelliteTable, known: BoolArray) -> tuple[BoolArray, dict[str, int]]:
    """Rows (n,) with a time, a satellite, a pseudorange and a position; the others by reason."""
    code = table.numbers[declared.code]
    position = table.stack(declared.position)
    finite = np.isfinite(t_s) & np.isfinite(code) & np.isfinite(position).all(axis=1)
    distance = np.linalg.norm(np.nan_to_num(position), axis=1)
    measured = finite & (distance > 2e7) & (distance < 6e7) & (code > CODE_RANGE_M[0]) & (code < CODE_RANGE_M[1])
    unknown = measured & ~known
    cells = ", ".join([_whole(cell) for cell in np.unique(table.texts[declared.satellite][unknown])[:5]])
    if not (measured & known).any():
        why = f"satellites {cells} are unknown" if cells else f"{int(np.sum(~finite))} of {len(code)} rows have empty cells"
        raise InputError(
            f"{table.path}: no row with a known satellite, a pseudorange and a satellite position in ECEF metres ({why}); "
            "check gnss.table"
        )
    counts = {
        "with empty or non-numeric cells": int(np.sum(~finite)),
        f"of unknown satellites ({cells})": int(np.sum(unknown)),
        "without a satellite position or pseudorange": int(np.sum(finite & ~measured)),
    }
    return measured & known, {reason: n for reason, n in counts.items() if n}


def _check_orbits(path: Path, name: Names, radius_m: Array) -> None:
    """Raises InputError for a satellite whose distance from the Earth's centre is not one of its constellation."""
    for satellite in np.unique(name).tolist():
        low, high = ORBIT_M[satellite[0]]
        r = float(np.median(radius_m[name == satellite]))
        if not low < r < high:
            fits = [s for s, (a, b) in ORBIT_M.items() if a < r < b]
            hint = f"; {' or '.join(fits)} would fit: name it in gnss.table.names" if fits else "; check gnss.table.position"
            raise InputError(f"{path}: {satellite} is {r / 1e6:.1f} Mm from the Earth's centre, unlike all of its system{hint}")


def first_position(raw: RawSatellites) -> Array | None:
    """Single-point position (3,) ECEF of the first epochs, good to a hundred metres; None where there is none."""
    t0 = raw.times.ref or GpsTime(0, 0.0)
    return approximate_position(_as_it_stands(raw, t0), t0)


def satellite_stream(raw: RawSatellites, declared: SatelliteTable, t0: GpsTime) -> tuple[GnssStream, ReadReport]:
    """The receiver's observations with satellite states at transmission. Raises InputError where no position can be found."""
    stream = _as_it_stands(raw, t0)
    r_row = _positions(raw, stream, t0)[stream.epoch]
    stream = _turned_back(stream, declared, r_row)
    tropo = _troposphere(stream, r_row)
    if declared.troposphere_removed:
        stream = replace(stream, code_m=stream.code_m + tropo)
    if declared.true_time:
        stream = replace(stream, t_s=stream.t_s + _clock_s(stream, r_row, tropo))
    return stream, raw.report


def without_group_delay(stream: GnssStream, navigation: Navigation, t0: GpsTime) -> GnssStream:
    """The stream with the satellites' group delays, in metres of code, taken off with their clocks."""
    record = navigation.states_at(stream.satellites, stream.sat, t0, stream.t_s[stream.epoch]).record
    delay_m = navigation.group_delay_m(record, stream.signals, stream.signal)
    return replace(stream, sat_clock_m=stream.sat_clock_m - delay_m)


def _as_it_stands(raw: RawSatellites, t0: GpsTime) -> GnssStream:
    """The table's rows as a stream, with its times and states untouched."""
    signals = tuple(sorted({s[0] + raw.signal for s in raw.satellites}))
    of_sat = np.array([signals.index(s[0] + raw.signal) for s in raw.satellites], np.int64)
    # tables hold no GLONASS channels; the rate is turned into Doppler and back by the same wavelength
    wavelength = np.array([wavelength_m(s, 0) for s in signals])[of_sat][raw.sat]
    n = len(raw.epoch)
    t_s = Times(raw.epoch_s, raw.times.ref, raw.times.is_sow).since(t0)
    return GnssStream(
        t_s, raw.epoch, raw.sat, of_sat[raw.sat], raw.satellites, signals,
        wavelength, raw.code_m, np.full(n, np.nan), -raw.rate_mps / wavelength, raw.cn0_dbhz, np.zeros(n, np.int64),
        raw.pos_ecef, raw.vel_ecef, raw.clock_m, raw.clock_mps,
    )  # fmt: skip


def _positions(raw: RawSatellites, stream: GnssStream, t0: GpsTime) -> Array:
    """Approximate positions (m, 3) ECEF from an epoch a second, interpolated."""
    few = every(stream, 1.0, len(stream.t_s))
    r = points(few, t0).r_ecef
    if not np.isfinite(r).any():
        raise InputError(f"{raw.report.source}: no epoch has enough satellites for a position; check gnss.table")
    return interpolate(stream.t_s, few.t_s, r)


def _turned_back(stream: GnssStream, declared: SatelliteTable, r_row: Array) -> GnssStream:
    """Satellite states in the Earth-fixed frame of transmission, for antennas at r_row (n, 3) within 100 m."""
    if declared.turned == "no":
        return stream
    travel_m = stream.code_m if declared.turned == "pseudorange" else np.linalg.norm(stream.sat_pos_ecef - r_row, axis=1)
    angle = OMEGA_E_RPS / C_MPS * travel_m
    c, s = np.cos(angle), np.sin(angle)

    def back(vector: Array) -> Array:
        x, y, z = vector.T
        return np.column_stack([c * x - s * y, s * x + c * y, z])

    vel = back(stream.sat_vel_ecef) if declared.velocity_turned else stream.sat_vel_ecef
    return replace(stream, sat_pos_ecef=back(stream.sat_pos_ecef), sat_vel_ecef=vel)


def _troposphere(stream: GnssStream, r_row: Array) -> Array:
    """The model's delay (n,) for antennas at r_row (n, 3); heights good to 10 m leave 3 mm / sin(el)."""
    lat, lon, h = geodetic_from_ecef(r_row)
    d = stream.sat_pos_ecef - r_row
    _, el = look_angles(np.einsum("nij,nj->ni", C_en(lat, lon), d / np.linalg.norm(d, axis=1)[:, None]))
    return troposphere_m(lat, np.clip(h, -500.0, 15_000.0), el)


def _clock_s(stream: GnssStream, r_row: Array, tropo_m: Array) -> Array:
    """Receiver clock offset (m,) of every epoch: median of its pseudoranges against the approximate position."""
    sat, _ = turned_satellites(stream.sat_pos_ecef, stream.sat_vel_ecef, r_row)
    rest = stream.code_m + stream.sat_clock_m - tropo_m - np.linalg.norm(sat - r_row, axis=1)
    order = np.lexsort((rest, stream.epoch))
    first = np.flatnonzero(np.diff(stream.epoch, prepend=-1))
    return np.asarray(rest[order][first + np.diff(first, append=len(rest)) // 2] / C_MPS)
