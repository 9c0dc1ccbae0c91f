"""Broadcast navigation data: reading, satellite states, a constellation to simulate with.

The time of transmission follows from a receiver's tag t_r and code P without knowing either clock: the satellite's
clock read t_r - P / c when the signal left, and the polynomial of the message turns this into GPST. Satellite clocks
are P's own: P = rho + c dt_u - (clock_m - group_delay_m) + T + I, where `clock_m` is c times the offset of the
message's clock with relativity (RTKLIB: satposs) and `group_delay_m` moves it from the message's reference signal to
the one observed (RTKLIB: the TGD of prange):

    GPS, QZSS   L1 TGD, L2 and L5 (f1 / f)^2 TGD (inter-signal corrections are not in LNAV)
    Galileo     E1 BGD of the message's own pair (I/NAV E5b, F/NAV E5a); E5a and E5b from the BGDs; E5, E6 as E1
    BeiDou      B1I and B1C TGD1, B2I and B2a TGD2, B3I none
    GLONASS     -(tau L2 - tau L1) / (gamma - 1), gamma = (f1 / f2)^2; times gamma on L2

Galileo satellites with I/NAV records use those only, others F/NAV. SP3 orbits (`flights.sp3`) have clocks of the same reference
signals but for Galileo, E1 and E5a, which the BGDs of I/NAV miss by nanoseconds.

Source: IS-GPS-200, 20.3.3.3; Galileo OS SIS ICD, 5.1.5; BDS-SIS-ICD-2.1, 5.2.4.10.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from pathlib import Path

import numpy as np

from factorgraph.errors import InputError
from factorgraph.geodesy import C_MPS, MU_M3S2, OMEGA_E_RPS
from factorgraph.gpstime import WEEK_S, GpsTime, leap_seconds
from factorgraph.measurements import ReadReport
from factorgraph.types import Array, BoolArray, IntArray
from scenarios.flights import _orbits as orbits
from scenarios.flights._orbits import GlonassSet, KeplerSet, OrbitClock
from scenarios.flights._rinex_navigation import GLONASS_UNKNOWN, Messages, read_messages
from scenarios.flights._rinex_text import BDT_GPST_S, read_rinex
from scenarios.flights._ubx_navigation import read_ubx_messages
from scenarios.flights.signals import carrier_hz
from scenarios.flights.sp3 import PreciseOrbits, is_sp3, read_sp3
from scenarios.flights.ubx import is_ubx

CONSTELLATION = Path(__file__).resolve().parent.parent / "data" / "constellation.rnx"
BDT_WEEK = 1356  # GPS week in which BeiDou's count begins
ISSUE_S = 7200.0  # between the records that `shifted_to` lays out
FNAV, INAV = 1 << 8, 1 << 9  # Galileo data source: the pair the clock refers to


@dataclass(frozen=True, slots=True)
class SatelliteStates:
    """Rows of satellites at their times of transmission, ECEF of that instant; NaN without a usable message."""

    pos_ecef: Array  # (n, 3)
    vel_ecef: Array  # (n, 3)
    clock_m: Array  # (n,) c * clock offset, relativity included, group delay not
    clock_mps: Array  # (n,)
    record: IntArray  # (n,) the message used, -1 none


@dataclass(frozen=True)
class Navigation:
    """Broadcast ephemerides, immutable. Records are the Kepler rows, then the GLONASS rows."""

    t_ref: GpsTime  # toe_s and toc_s count from here
    kepler: KeplerSet
    glonass: GlonassSet
    klobuchar: Array | None = None  # (8,) GPS alpha, beta (BeiDou's or QZSS's where GPS has none)
    precise: PreciseOrbits | None = None  # used in place of the messages where they cover
    report: ReadReport = field(default_factory=lambda: ReadReport("", 0))

    @cached_property
    def satellites(self) -> tuple[str, ...]:
        """Satellites that have a record."""
        precise = self.precise.satellites if self.precise is not None else ()
        return tuple(sorted({*self.kepler.satellites, *self.glonass.satellites, *precise}))

    @cached_property
    def glonass_channels(self) -> dict[str, int]:
        """FDMA channel k of the GLONASS satellites."""
        channel = self.glonass.data[:, orbits.G_CHANNEL]
        return {s: int(k) for s, k in zip(self.glonass.satellites, channel, strict=True) if np.isfinite(k)}

    def satellite_states(self, satellites: tuple[str, ...], sat: IntArray, t0: GpsTime, t_sv_s: Array) -> SatelliteStates:
        """States for transmission times read on the satellites' own clocks (tag minus code / c).

        sat (n,) indexes `satellites`; t_sv_s (n,) seconds since t0, NaN gives NaN.
        """
        t_sv = t_sv_s + (t0 - self.t_ref)
        record = self._records(satellites, sat, t_sv)
        offset = np.zeros_like(t_sv)
        for _ in range(2):
            offset = self._clock_s(satellites, sat, record, t_sv - offset)
        return self._states(satellites, sat, record, t_sv - offset)

    def states_at(self, satellites: tuple[str, ...], sat: IntArray, t0: GpsTime, t_s: Array) -> SatelliteStates:
        """States at true instants t_s (n,), GPST seconds since t0."""
        t = t_s + (t0 - self.t_ref)
        return self._states(satellites, sat, self._records(satellites, sat, t), t)

    def states_seen_from(
        self, satellites: tuple[str, ...], sat: IntArray, t0: GpsTime, t_rx_s: Array, r_ecef: Array
    ) -> tuple[SatelliteStates, Array]:
        """States at transmission of signals that arrive at r_ecef (n, 3) at true instants t_rx_s (n,).

        Also returns the travel time (n,), of the geometric range with the Earth's rotation (no atmosphere).
        """
        t = t_rx_s + (t0 - self.t_ref)
        record = self._records(satellites, sat, t)
        travel = np.full(len(t), 0.075)
        states = self._states(satellites, sat, record, t - travel)
        for _ in range(3):
            travel = turned_range(states.pos_ecef, r_ecef) / C_MPS
            states = self._states(satellites, sat, record, t - travel)
        return states, travel

    def group_delay_m(self, record: IntArray, signals: tuple[str, ...], signal: IntArray) -> Array:
        """Delay (n,) to take off `clock_m` for the signal observed (module docstring); record and signal (n,)."""
        out = np.zeros(len(record))
        n_kepler = len(self.kepler.satellites)
        for k, name in enumerate(signals):
            rows = np.flatnonzero((signal == k) & (record >= 0))
            if name[0] == "R":
                out[rows] = _glonass_delay_s(name, self.glonass.data)[record[rows] - n_kepler]
            else:
                out[rows] = _kepler_delay_s(name, self.kepler.data)[record[rows]]
        return np.asarray(out * C_MPS)

    def shifted_to(self, t0: GpsTime, span_s: float = 0.0) -> Navigation:
        """The same sky over the Earth, moved in time so that [t0, t0 + span_s] has valid messages.

        The newest record of each satellite gets the last full hour before t0 (of its own system time) as its reference
        and, for longer spans, further records every two hours that continue the same orbit; BeiDou's geostationary
        ones are held over their place. GLONASS records are moved to the last quarter of an hour and reach half an hour.
        """
        early = t0 + -60.0  # no receiver uses a Galileo orbit before its toe
        hour = GpsTime(early.week, np.floor(early.sow / 3600.0) * 3600.0)
        starts_s = ISSUE_S * np.arange(max(1, int(np.ceil(((t0 - hour) + span_s) / ISSUE_S))))
        k = self.kepler
        names, toe_s, data = [], [], []
        for i in _last_of_each(k.satellites):
            name = k.satellites[i]
            at_toe = _clock_moved(k.data[i], k.toe_s[i] - k.toc_s[i])
            for start in starts_s.tolist():
                names.append(name)
                toe_s.append(start + (BDT_GPST_S if name[0] == "C" else 0.0))
                data.append(_continued(at_toe, name, start, hour + start))
        toe = np.array(toe_s, float)
        kepler = KeplerSet(tuple(names), toe, toe, np.array(data, float).reshape(-1, orbits.N_KEPLER))
        newest = _last_of_each(self.glonass.satellites)
        leap = float(leap_seconds(t0.calendar()))
        quarter = np.floor((t0 - hour - leap) / 900.0) * 900.0 + leap
        glonass = GlonassSet(
            tuple(self.glonass.satellites[i] for i in newest), np.full(len(newest), quarter), self.glonass.data[newest]
        )
        return replace(self, t_ref=hour, kepler=kepler, glonass=glonass, precise=None)

    def _records(self, satellites: tuple[str, ...], sat: IntArray, t: Array) -> IntArray:
        """Healthy record in use at t (seconds since t_ref), -1 none."""
        chosen = np.full(len(t), -1, np.int64)
        if not satellites:
            return chosen
        for first, records_of, toe_s, healthy in self._tables:
            found = orbits.nearest_records(records_of, toe_s, satellites, sat, t)
            take = found >= 0
            take[take] = healthy[found[take]]
            chosen[take] = found[take] + first
        return chosen

    @cached_property
    def _tables(self) -> tuple[tuple[int, dict[str, tuple[int, int]], Array, BoolArray], ...]:
        """First record, records of each satellite, reference times and health of the two sets."""
        k, g = self.kepler, self.glonass
        return (
            (0, _ranges(k.satellites), k.toe_s, orbits.healthy_kepler(k.satellites, k.data)),
            (len(k.satellites), _ranges(g.satellites), g.toe_s, g.data[:, orbits.G_HEALTH] == 0),
        )

    def _clock_s(self, satellites: tuple[str, ...], sat: IntArray, record: IntArray, t: Array) -> Array:
        """Clock offsets without relativity; zero where they are unknown."""
        offset = np.zeros(len(t))
        n_kepler = len(self.kepler.satellites)
        k, g = np.flatnonzero((record >= 0) & (record < n_kepler)), np.flatnonzero(record >= n_kepler)
        rk, rg = record[k], record[g] - n_kepler
        offset[k] = orbits.kepler_clock_s(np.take(self.kepler.data.T, rk, axis=1), t[k] - self.kepler.toc_s[rk])
        offset[g] = orbits.glonass_clock_s(np.take(self.glonass.data.T, rg, axis=1), t[g] - self.glonass.toe_s[rg])
        if self.precise is not None:
            covered, node = self.precise.covers(satellites, sat, t)
            offset[covered] = np.nan_to_num(self.precise.clock_at(node[covered], t[covered])[0])
        return offset

    def _states(self, satellites: tuple[str, ...], sat: IntArray, record: IntArray, t: Array) -> SatelliteStates:
        n, n_kepler = len(t), len(self.kepler.satellites)
        pos, vel = np.full((n, 3), np.nan), np.full((n, 3), np.nan)
        clock, rate = np.full(n, np.nan), np.full(n, np.nan)

        def put(rows: IntArray, got: OrbitClock) -> None:
            pos[rows], vel[rows], clock[rows], rate[rows] = got.pos, got.vel, got.clock_s, got.rate

        k, g = np.flatnonzero((record >= 0) & (record < n_kepler)), np.flatnonzero(record >= n_kepler)
        if k.size:
            rk, ks = record[k], self.kepler
            system = np.array([s[0] for s in satellites])[sat[k]]
            geo = np.array([orbits.is_geostationary(s) for s in satellites])[sat[k]]
            put(k, orbits.kepler_states(np.take(ks.data.T, rk, axis=1), system, geo, t[k] - ks.toe_s[rk], t[k] - ks.toc_s[rk]))
        if g.size:
            rg = record[g] - n_kepler
            put(g, orbits.glonass_states(np.take(self.glonass.data.T, rg, axis=1), t[g] - self.glonass.toe_s[rg]))
        if self.precise is not None:
            covered, node = self.precise.covers(satellites, sat, t)
            put(np.flatnonzero(covered), OrbitClock(*self.precise.states(node[covered], t[covered])))
        return SatelliteStates(pos, vel, clock * C_MPS, rate * C_MPS, record)


def turned_range(sat_ecef: Array, r_ecef: Array) -> Array:
    """Range (n,) from r_ecef to a satellite given in the ECEF frame of its transmission time (n, 3)."""
    travel = np.linalg.norm(sat_ecef - r_ecef, axis=1) / C_MPS
    for _ in range(2):
        c, s = np.cos(OMEGA_E_RPS * travel), np.sin(OMEGA_E_RPS * travel)
        turned = np.column_stack(
            [c * sat_ecef[:, 0] + s * sat_ecef[:, 1], c * sat_ecef[:, 1] - s * sat_ecef[:, 0], sat_ecef[:, 2]]
        )
        travel = np.linalg.norm(turned - r_ecef, axis=1) / C_MPS
    return np.asarray(travel * C_MPS)


def read_navigation(paths: Sequence[Path]) -> Navigation:
    """Read RINEX 2.11, 3.x or 4 navigation files, SP3 orbits (plain, gzip, Unix compress) and u-blox logs into one set.

    Where SP3 orbits cover a satellite they are used in place of its messages, which still give the group delays.
    Duplicate records are kept once. Raises InputError for files that cannot be read as navigation data or hold no
    usable record; records that cannot be used are counted in `report`.
    """
    if not paths:
        raise InputError("no navigation file given")
    messages = Messages()
    files = [Path(path) for path in paths]
    sp3 = [path for path in files if is_sp3(path)]
    for path in files:
        if is_ubx(path):
            read_ubx_messages(path, messages)
        elif path not in sp3:
            read_messages(read_rinex(path), messages)
    source = ", ".join(str(p) for p in paths)
    if sp3:
        return _with_precise(sp3, messages, source)
    if not messages.satellites:
        reasons = "; ".join(f"{n} x {why}" for why, n in messages.dropped.items())
        raise InputError(f"{source}: no usable navigation message" + (f" ({reasons})" if reasons else ""))
    return _assembled(messages, source)


@cache
def builtin_constellation() -> Navigation:
    """The constellations the simulator uses: GPS, Galileo, BeiDou and QZSS, one message per satellite."""
    return read_navigation([CONSTELLATION])


def _with_precise(sp3: Sequence[Path], messages: Messages, source: str) -> Navigation:
    """SP3 orbits, with the broadcast messages beside them where there are any."""
    precise, t_ref, report = read_sp3(sp3)
    if not messages.satellites:
        kepler = KeplerSet((), np.zeros(0), np.zeros(0), np.zeros((0, orbits.N_KEPLER)))
        glonass = GlonassSet((), np.zeros(0), np.zeros((0, orbits.N_GLONASS)))
        klobuchar = next((messages.klobuchar[s] for s in "GCJ" if s in messages.klobuchar), None)
        note = "no broadcast messages beside SP3 orbits: group delays are unknown, of GPS several metres"
        return Navigation(t_ref, kepler, glonass, klobuchar, precise, replace(report, notes=(*report.notes, note)))
    broadcast = _assembled(messages, source)
    own = broadcast.report
    shift = t_ref - broadcast.t_ref
    both = ReadReport(source, own.n_rows + report.n_rows, {**own.dropped, **report.dropped}, own.notes)
    return replace(broadcast, precise=replace(precise, t_s=precise.t_s + shift), report=both)


def _assembled(messages: Messages, source: str) -> Navigation:
    # order: satellite, reference time; of equal keys the later in the files stays
    t_ref = GpsTime(messages.times[0].week, 0.0)
    toc = np.array([t - t_ref for t in messages.times])
    rows: dict[tuple[str, float, float, float], int] = {}
    with_inav = {s for s, d in zip(messages.satellites, messages.data, strict=True) if s[0] == "E" and not _is_fnav(d)}
    for i, (name, data) in enumerate(zip(messages.satellites, messages.data, strict=True)):
        if name in with_inav and _is_fnav(data):
            messages.dropped["F/NAV beside I/NAV"] += 1
            continue
        toe = _toe_s(name, toc[i], data, t_ref)
        key = (name, toe, toc[i], 0.0 if name[0] == "R" else float(np.nan_to_num(data[3])))
        if key in rows:
            messages.dropped["duplicate message"] += 1
        rows[key] = i
    ordered = sorted(rows.items())
    k = [(key, i) for key, i in ordered if key[0][0] != "R"]
    g = [(key, i) for key, i in ordered if key[0][0] == "R"]
    kepler = KeplerSet(
        tuple(key[0] for key, _ in k),
        np.array([key[2] for key, _ in k], float),
        np.array([key[1] for key, _ in k], float),
        np.array([messages.data[i] for _, i in k], float).reshape(-1, orbits.N_KEPLER),
    )
    glonass = GlonassSet(
        tuple(key[0] for key, _ in g),
        np.array([key[1] for key, _ in g], float),
        np.array([messages.data[i] for _, i in g], float).reshape(-1, orbits.N_GLONASS),
    )
    klobuchar = next((messages.klobuchar[s] for s in "GCJ" if s in messages.klobuchar), None)
    return Navigation(
        t_ref, kepler, glonass, klobuchar, None, ReadReport(source, len(rows), dict(messages.dropped), tuple(messages.notes))
    )


def _toe_s(name: str, toc_s: float, data: Array, t_ref: GpsTime) -> float:
    """Reference time of the orbit: its seconds of week, in the week that brings it nearest to the clock's epoch."""
    if name[0] == "R":
        return toc_s
    sow = data[orbits.TOE] + (BDT_GPST_S if name[0] == "C" else 0.0)
    return toc_s + float((sow - (t_ref + toc_s).sow + WEEK_S / 2) % WEEK_S - WEEK_S / 2)


def _is_fnav(data: Array) -> BoolArray:
    """Galileo messages (..., 31) of type F/NAV, by the clock's signal pair or else by the signal they came from."""
    source = np.nan_to_num(data[..., orbits.CODES]).astype(np.int64)
    by_clock, by_signal = (source & FNAV) != 0, ((source & 2) != 0) & ((source & 5) == 0)
    return np.asarray(np.where((source & (FNAV | INAV)) != 0, by_clock, by_signal))


def _kepler_delay_s(signal: str, data: Array) -> Array:
    first, second = np.nan_to_num(data[:, orbits.DELAY_1]), np.nan_to_num(data[:, orbits.DELAY_2])
    system, band = signal[0], signal[1]
    if system in "GJ":
        return np.asarray(_gamma(signal) * first)
    if system == "E":
        e1 = np.where(_is_fnav(data), first, second)
        return np.asarray(e1 + {"5": (_gamma(signal) - 1) * first, "7": (_gamma(signal) - 1) * second}.get(band, 0.0))
    return {"1": first, "2": first, "7": second, "5": second}.get(band, np.zeros(len(data)))


def _glonass_delay_s(signal: str, data: Array) -> Array:
    dtau = np.nan_to_num(data[:, orbits.G_DTAU])
    dtau = np.where(np.abs(dtau) < GLONASS_UNKNOWN, dtau, 0.0)
    gamma = _gamma("R2C")
    return np.asarray(-dtau / (gamma - 1) * {"1": 1.0, "2": gamma}.get(signal[1], 0.0))


def _gamma(signal: str) -> float:
    """(f of band 1 / f of this band)^2."""
    return (carrier_hz(signal[0] + "1C", 0) / carrier_hz(signal, 0)) ** 2


def _clock_moved(row: Array, seconds: float) -> Array:
    """The message with its clock polynomial referred to a later instant."""
    new = row.copy()
    new[orbits.F0] += seconds * (row[orbits.F1] + seconds * row[orbits.F2])
    new[orbits.F1] += 2 * row[orbits.F2] * seconds
    return new


def _continued(row: Array, name: str, seconds: float, toe: GpsTime) -> Array:
    """The message `seconds` later, as orbit and clock continue, with `toe` (system time) written as its reference."""
    o, system = orbits, name[0]
    new = _clock_moved(row, seconds)
    w_e = o.OMEGA_BDS if system == "C" else OMEGA_E_RPS
    node_rate = row[o.OMEGA_DOT] - w_e
    if o.is_geostationary(name):
        node_rate = 0.0
    else:
        mu = o.MU_GPS if system in "GJ" else MU_M3S2
        new[o.M0] = _wrapped(row[o.M0] + (np.sqrt(mu) / row[o.SQRT_A] ** 3 + row[o.DN]) * seconds)
        new[o.I0] += row[o.I_DOT] * seconds
    # what the Earth sees is the node's longitude, Omega0 - w_e toe
    new[o.OMEGA0] = _wrapped(row[o.OMEGA0] + node_rate * seconds + w_e * (toe.sow - row[o.TOE]))
    new[o.TOE] = toe.sow
    new[o.WEEK] = toe.week - (BDT_WEEK if system == "C" else 0)
    return new


def _wrapped(angle: float) -> float:
    return float(np.mod(angle + np.pi, 2 * np.pi) - np.pi)


def _last_of_each(names: tuple[str, ...]) -> list[int]:
    return [end - 1 for _, end in _ranges(names).values()]


def _ranges(names: tuple[str, ...]) -> dict[str, tuple[int, int]]:
    """First and one past last row of each name of a sorted tuple."""
    out: dict[str, tuple[int, int]] = {}
    for i, name in enumerate(names):
        out[name] = (out[name][0] if name in out else i, i + 1)
    return out
