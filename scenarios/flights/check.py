"""What a flight holds and what is doubtful in it, before anything is estimated.

Slips are counted three ways, between neighbouring epochs of a satellite and signal: the receiver's loss-of-lock flag;
the geometry-free combination of the satellite's first two bands; phase against the integral of Doppler. The median
over satellites, which the receiver's clock causes, is taken out of the last. A clock jump shows as a step of whole
milliseconds of the code, with the phase or without, or of the time tags.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from factorgraph.geodesy import C_MPS
from factorgraph.measurements import GnssStream
from factorgraph.problem import AmbiguitySettings, Vehicle
from factorgraph.types import Array, BoolArray, IntArray
from scenarios.flights.load import LoadedFlight

Cell = str | int | float | None

GAP_INTERVALS = 3.0  # nominal intervals without a sample that make a gap
LISTED_GAPS = 8  # per sensor
MS_M = 1e-3 * C_MPS


@dataclass(frozen=True, slots=True)
class CheckTable:
    """A titled table of plain cells; `key` names it in JSON."""

    key: str
    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[Cell, ...], ...]


def check(flight: LoadedFlight) -> list[CheckTable]:
    """Tables of vehicles and sensors, gaps, overlaps, satellites, slips, clock jumps, links and dropped rows.

    Tables without rows are left out.
    """
    problem = flight.problem
    receivers = [(v.name, v.gnss.stream) for v in problem.vehicles if v.gnss is not None]
    settings = problem.settings.ambiguity
    tables = [
        CheckTable("flight", f"Flight {problem.name}", ("what", "value"), tuple(_facts(flight))),
        CheckTable("findings", "Wrong or doubtful", ("of", "what", "how bad"), tuple(_finding_rows(flight))),
        CheckTable("sensors", "Sensors", SENSOR_COLUMNS, tuple(_sensor_row(*s) for s in _sensors(flight))),
        CheckTable("gaps", "Gaps", ("sensor", "from s", "to s", "length s"), tuple(_gap_rows(flight))),
        CheckTable("offsets", "Times of sensors against each other", OFFSET_COLUMNS, tuple(_offset_rows(flight))),
        CheckTable("overlaps", "Common time", ("first", "second", "from s", "to s", "length s"), tuple(_overlap_rows(flight))),
        CheckTable("satellites", "Satellites", SATELLITE_COLUMNS, tuple(row for r in receivers for row in _satellite_rows(*r))),
        CheckTable("slips", "Cycle slips", SLIP_COLUMNS, tuple(row for r in receivers for row in _slip_rows(*r, settings))),
        CheckTable("clocks", "Receiver clocks", CLOCK_COLUMNS, tuple(_clock_row(*r) for r in receivers)),
        CheckTable(
            "links", "Links", ("link", "common epochs", "common satellites", "median per epoch"), tuple(_link_rows(flight))
        ),
        CheckTable("reading", "Reading", ("source", "rows used", "dropped", "notes"), tuple(_report_rows(flight))),
    ]
    return [table for table in tables if table.rows]


def render(tables: list[CheckTable]) -> RenderableType:
    """The tables for a terminal."""
    return Group(*(part for table in tables for part in (_rich(table), Text())))


def as_json(tables: list[CheckTable]) -> dict[str, list[dict[str, Cell]]]:
    """The tables as plain JSON types: key -> rows of column -> cell; numbers that are not known are null."""
    return {t.key: [{c: _plain(x) for c, x in zip(t.columns, row, strict=True)} for row in t.rows] for t in tables}


def _plain(cell: Cell) -> Cell:
    return None if isinstance(cell, float) and not math.isfinite(cell) else cell


def _rich(table: CheckTable) -> Table:
    view = Table(title=table.title, title_justify="left", header_style="bold", box=None, pad_edge=False)
    for i, column in enumerate(table.columns):
        numeric = all(not isinstance(row[i], str) for row in table.rows)
        view.add_column(column, justify="right" if numeric else "left", overflow="fold")
    for row in table.rows:
        view.add_row(*(Text(_text(cell)) for cell in row))
    return view


def _text(cell: Cell) -> str:
    if cell is None or (isinstance(cell, float) and math.isnan(cell)):
        return "-"
    return f"{cell:.3f}".rstrip("0").rstrip(".") if isinstance(cell, float) else str(cell)


# flight and sensors


def _finding_rows(flight: LoadedFlight) -> Iterator[tuple[Cell, ...]]:
    for finding in flight.examined.findings:
        yield finding.subject, finding.text, "cannot be right" if finding.is_wrong else "doubtful"


OFFSET_COLUMNS = ("vehicle", "sensor", "against", "late by s", "sigma s", "misfit m/s2", "told %")


def _offset_rows(flight: LoadedFlight) -> Iterator[tuple[Cell, ...]]:
    for c in flight.examined.offsets:
        o = c.offset
        numbers = round(o.offset_s, 3), round(o.sigma_s, 3), round(o.misfit_mps2, 3), round(100 * o.contrast)
        yield c.vehicle, c.sensor, c.against, *numbers


def _facts(flight: LoadedFlight) -> Iterator[tuple[Cell, ...]]:
    problem = flight.problem
    frame = problem.frame
    t0 = problem.t0
    date = f"{t0.calendar():%Y-%m-%d %H:%M:%S} GPST, week {t0.week}, {t0.sow:.3f} s"
    yield "t0", date if t0.week else f"{t0.sow:.3f} s of the recording's own clock"
    yield "origin", f"{math.degrees(frame.lat_rad):.7f} deg, {math.degrees(frame.lon_rad):.7f} deg, {frame.h_m:.2f} m"
    for v in problem.vehicles:
        yield f"vehicle {v.name}", ", ".join(_describe(v))
    for link in problem.links:
        yield "link", f"{link.reference} to {link.rover}"


def _describe(v: Vehicle) -> Iterator[str]:
    if v.fixed_n is not None:
        yield "base station at ({:.2f}, {:.2f}, {:.2f}) m".format(*(round(x, 2) + 0.0 for x in v.fixed_n))
    elif v.imu is None:
        yield "no IMU: moves by its motion prior"
    if v.imu is not None:
        yield "IMU"
    if v.gnss is not None:
        yield "GNSS"
    yield from (p.name for p in v.positions)
    yield from (h.name for h in v.heights)
    if v.truth is not None:
        yield "truth" if v.truth.q_nb is None else "truth with attitude"


def _sensors(flight: LoadedFlight) -> Iterator[tuple[str, Array]]:
    """Name and times of every stream."""
    for v in flight.problem.vehicles:
        if v.imu is not None:
            yield f"{v.name} imu", v.imu.t_s
        if v.gnss is not None:
            yield f"{v.name} gnss", v.gnss.stream.t_s
        for streams in (v.positions, v.heights, v.velocities, v.attitudes, v.magnetics):
            yield from ((f"{v.name} {stream.name}", stream.t_s) for stream in streams)
        if v.truth is not None:
            yield f"{v.name} truth", v.truth.t_s
    for model in flight.problem.ranges:
        yield f"ranges {model.stream.name}", np.unique(model.stream.t_s)
    for vision in flight.problem.visions:
        yield f"vision {vision.name}", vision.t_s


SENSOR_COLUMNS = ("sensor", "samples", "rate Hz", "from s", "to s", "gaps", "longest gap s")


def _sensor_row(name: str, t_s: Array) -> tuple[Cell, ...]:
    if not t_s.size:
        return name, 0, math.nan, math.nan, math.nan, 0, math.nan
    interval = nominal_interval_s(t_s)
    longest = float(np.diff(t_s).max()) if t_s.size > 1 else math.nan
    rate = round(1 / interval, 3) if interval > 0 else math.nan
    return name, t_s.size, rate, round(float(t_s[0]), 3), round(float(t_s[-1]), 3), int(_gaps(t_s).size), round(longest, 4)


def nominal_interval_s(t_s: Array) -> float:
    """The median interval of times (n,); NaN with fewer than two."""
    return float(np.median(np.diff(t_s))) if t_s.size > 1 else math.nan


def _gaps(t_s: Array) -> IntArray:
    """Rows after which more than GAP_INTERVALS nominal intervals pass."""
    return np.flatnonzero(np.diff(t_s) > GAP_INTERVALS * nominal_interval_s(t_s)) if t_s.size > 2 else np.zeros(0, np.int64)


def _gap_rows(flight: LoadedFlight) -> Iterator[tuple[Cell, ...]]:
    for name, t_s in _sensors(flight):
        gaps = _gaps(t_s)
        longest = gaps[np.argsort(-np.diff(t_s)[gaps], kind="stable")][:LISTED_GAPS]
        for i in np.sort(longest):
            yield name, round(float(t_s[i]), 3), round(float(t_s[i + 1]), 3), round(float(t_s[i + 1] - t_s[i]), 3)


def _overlap_rows(flight: LoadedFlight) -> Iterator[tuple[Cell, ...]]:
    """Common time of the vehicles' sensors, pair by pair of vehicles, and of ranges with each."""
    spans: dict[str, tuple[float, float]] = {}
    for name, t_s in _sensors(flight):
        owner = name if name.startswith("ranges ") else name.rsplit(" ", 1)[0]
        if t_s.size and not name.endswith(" truth"):
            low, high = spans.get(owner, (math.inf, -math.inf))
            spans[owner] = (min(low, float(t_s[0])), max(high, float(t_s[-1])))
    owners = list(spans)
    for i, a in enumerate(owners):
        for b in owners[i + 1 :]:
            start, end = max(spans[a][0], spans[b][0]), min(spans[a][1], spans[b][1])
            yield a, b, round(start, 3), round(end, 3), round(max(end - start, 0.0), 3)


# satellites


SATELLITE_COLUMNS = ("receiver", "signal", "satellites", "rows", "code %", "phase %", "Doppler %", "C/N0 dB-Hz", "no ephemeris")


def _satellite_rows(name: str, stream: GnssStream) -> Iterator[tuple[Cell, ...]]:
    for k in np.argsort(stream.signals):
        rows = stream.signal == k
        n = int(rows.sum())
        if not n:
            continue
        cn0 = stream.cn0_dbhz[rows]
        known = cn0[np.isfinite(cn0)]
        shares = [
            round(100 * float(np.isfinite(x[rows]).mean()), 1) for x in (stream.code_m, stream.phase_cyc, stream.doppler_hz)
        ]
        without = int(np.sum(~np.isfinite(stream.sat_pos_ecef[rows, 0])))
        satellites = int(np.unique(stream.sat[rows]).size)
        yield name, stream.signals[k], satellites, n, *shares, round(float(known.mean()), 1) if known.size else math.nan, without


@dataclass(frozen=True, slots=True)
class _Steps:
    """Pairs of rows of one satellite and signal at neighbouring epochs."""

    before: IntArray  # (m,)
    after: IntArray  # (m,)
    dt_s: Array  # (m,)
    epoch: IntArray  # (m,) of the second row


def _steps(stream: GnssStream) -> _Steps:
    order = np.lexsort((stream.epoch, stream.signal, stream.sat))
    a, b = order[:-1], order[1:]
    same = (stream.sat[a] == stream.sat[b]) & (stream.signal[a] == stream.signal[b]) & (stream.epoch[b] == stream.epoch[a] + 1)
    a, b = a[same], b[same]
    dt = stream.t_s[stream.epoch[b]] - stream.t_s[stream.epoch[a]]
    near = dt <= GAP_INTERVALS * nominal_interval_s(stream.t_s)
    return _Steps(a[near], b[near], dt[near], stream.epoch[b[near]])


SLIP_COLUMNS = ("receiver", "system", "steps", "loss of lock", "geometry-free", "phase against Doppler")


def _slip_rows(name: str, stream: GnssStream, settings: AmbiguitySettings) -> Iterator[tuple[Cell, ...]]:
    steps = _steps(stream)
    flagged = (stream.lli[steps.after] & 1) > 0
    free = _geometry_free_slips(stream, steps, settings.slip_geometry_free_m)
    doppler = _doppler_slips(stream, steps, settings.slip_phase_doppler_cyc)
    phase = np.isfinite(stream.phase_cyc[steps.after] - stream.phase_cyc[steps.before])
    system = np.array([s[0] for s in stream.satellites])[stream.sat[steps.after]]
    for letter in sorted(set(system.tolist())):
        mine = (system == letter) & phase
        counts = [int(np.sum(mine & x)) if x is not None else None for x in (flagged, free, doppler)]
        yield name, letter, int(mine.sum()), *counts


def _geometry_free_slips(stream: GnssStream, steps: _Steps, threshold_m: float) -> BoolArray | None:
    """Steps of a satellite's second band whose phase moves against its first; None without two bands."""
    d_phase = stream.wavelength_m[steps.after] * (stream.phase_cyc[steps.after] - stream.phase_cyc[steps.before])
    band = np.array([s[1] for s in stream.signals])[stream.signal[steps.after]]
    order = np.lexsort((stream.signal[steps.after], stream.sat[steps.after], steps.epoch))
    order = order[np.isfinite(d_phase[order])]
    key = steps.epoch[order] * len(stream.satellites) + stream.sat[steps.after][order]
    first = np.flatnonzero(np.diff(key, prepend=-1))
    lead = np.repeat(order[first], np.diff(first, append=order.size))
    other = band[order] != band[lead]
    if not other.any():
        return None
    slips = np.zeros(len(d_phase), bool)
    slips[order[other]] = np.abs(d_phase[order] - d_phase[lead])[other] > threshold_m
    return slips


def _doppler_slips(stream: GnssStream, steps: _Steps, threshold_cyc: float) -> BoolArray | None:
    """Steps whose phase differs from the integral of Doppler (trapezoid); None without Doppler."""
    mean_hz = 0.5 * (stream.doppler_hz[steps.after] + stream.doppler_hz[steps.before])
    excess = stream.phase_cyc[steps.after] - stream.phase_cyc[steps.before] + mean_hz * steps.dt_s
    if not np.isfinite(excess).any():
        return None
    wavelength = stream.wavelength_m[steps.after]
    common_m = _per_epoch(np.median, excess * wavelength, steps.epoch, len(stream.t_s))[steps.epoch]
    return np.abs(excess - common_m / wavelength) > threshold_cyc


def _per_epoch(of: Callable[[Array], np.floating], values: Array, epoch: IntArray, n: int) -> Array:
    """A statistic of the finite values of each epoch (n,); NaN where there is none."""
    out = np.full(n, np.nan)
    finite = np.isfinite(values)
    order = np.flatnonzero(finite)[np.argsort(epoch[finite], kind="stable")]
    starts = np.flatnonzero(np.diff(epoch[order], prepend=-1))
    for group in np.split(order, starts[1:]):
        if group.size:
            out[epoch[group[0]]] = of(values[group])
    return out


CLOCK_COLUMNS = ("receiver", "epochs", "code jumps", "code against phase jumps", "time tag jumps", "epochs under 4 satellites")


def _clock_row(name: str, stream: GnssStream) -> tuple[Cell, ...]:
    steps = _steps(stream)
    d_code = stream.code_m[steps.after] - stream.code_m[steps.before]
    d_phase = stream.wavelength_m[steps.after] * (stream.phase_cyc[steps.after] - stream.phase_cyc[steps.before])
    n = len(stream.t_s)
    code = _per_epoch(np.median, d_code / np.where(steps.dt_s > 0, steps.dt_s, np.nan), steps.epoch, n)
    against = _per_epoch(np.median, d_code - d_phase, steps.epoch, n)
    dt = np.diff(stream.t_s)
    interval = nominal_interval_s(stream.t_s)
    tag = np.abs(dt - interval * np.round(dt / interval)) if n > 1 else np.zeros(0)
    used = np.isfinite(stream.code_m) & np.isfinite(stream.sat_pos_ecef[:, 0])
    pairs = np.unique(np.column_stack([stream.epoch[used], stream.sat[used]]), axis=0)
    few = int(np.sum(np.bincount(pairs[:, 0], minlength=n) < 4))
    usual = np.nanmedian(code) if np.isfinite(code).any() else 0.0
    code_jumps = int(np.sum(np.abs(code - usual) * interval > 0.5 * MS_M)) if n > 1 else 0
    return name, n, code_jumps, int(np.sum(np.abs(against) > 0.5 * MS_M)), int(np.sum(tag > 4e-4)), few


def _link_rows(flight: LoadedFlight) -> Iterator[tuple[Cell, ...]]:
    problem = flight.problem
    for link in problem.links:
        a, b = (problem.vehicle(end).gnss for end in (link.reference, link.rover))
        if a is None or b is None:
            continue
        seen_a, seen_b = _seen(a.stream), _seen(b.stream)
        counts = [len(seen_a[t] & seen_b[t]) for t in seen_a.keys() & seen_b.keys()]
        both = set().union(*seen_a.values()) & set().union(*seen_b.values())
        yield f"{link.reference} to {link.rover}", len(counts), len(both), float(np.median(counts)) if counts else math.nan


def _seen(stream: GnssStream) -> dict[int, set[str]]:
    """Satellites with code and state by time, rounded to 0.1 s."""
    used = np.isfinite(stream.code_m) & np.isfinite(stream.sat_pos_ecef[:, 0])
    seen: dict[int, set[str]] = {}
    for epoch, sat in np.unique(np.column_stack([stream.epoch[used], stream.sat[used]]), axis=0).tolist():
        seen.setdefault(round(10 * stream.t_s[epoch]), set()).add(stream.satellites[sat])
    return seen


def _report_rows(flight: LoadedFlight) -> Iterator[tuple[Cell, ...]]:
    for report in flight.reports:
        dropped = ", ".join(f"{n} {reason}" for reason, n in report.dropped.items() if n)
        yield report.source, report.n_rows, dropped or "none", "; ".join(report.notes)
