"""GNSS observations of real constellations: code, phase and Doppler as a receiver on the vehicle would give them.

A receiver whose clock is off by dt_u tags an epoch t_r and measures at the true instant t = t_r - dt_u. With the travel
time tau, rho is the range from the antenna at t to the satellite at t - tau, turned by the Earth's rotation during tau:

    P    = rho + c dt_u - c dt_s + T + I + noise + multipath + outlier
    Phi  = rho + c dt_u - c dt_s + T - I + noise + lambda N          (in cycles: Phi / lambda)
    -lambda D = d rho / dt (1 - ddt_u) + c ddt_u - c ddt_s + noise

T and I are the models that estimators use, times the factors of the environment, and disturbances (`simulate.atmosphere`);
these and errors of broadcast orbits and clocks are common to all receivers. Standard deviations grow with 1 / sin(el) as
`factorgraph.problem.GnssNoise` says. N is an integer, new whenever tracking starts again, and jumps at a cycle slip. Outliers
of single codes come at any time; faults of several codes at once in windows of time, also into observations that are there
already (`with_code_faults`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from pydantic import Field, PositiveFloat, PositiveInt

from factorgraph import geodesy
from factorgraph.errors import InputError
from factorgraph.geodesy import C_MPS, OMEGA_E_RPS, LocalFrame
from factorgraph.gpstime import GpsTime
from factorgraph.measurements import GnssStream
from factorgraph.models import atmosphere
from factorgraph.models.gnss import elevation_scale, look_angles
from factorgraph.problem import Antenna, GnssNoise, Vec3
from factorgraph.types import Array, BoolArray, IntArray
from scenarios.flights.navigation import Navigation
from scenarios.flights.schema import GnssNoiseTable, Table
from scenarios.flights.signals import MEGAHERTZ, wavelength_m
from scenarios.simulate.atmosphere import Rays, ionosphere_m, wet_m
from scenarios.simulate.fixes import epochs
from scenarios.simulate.streams import Streams, gauss_markov
from scenarios.simulate.trajectory import Trajectory

SEARCH_S = 60.0  # spacing at which satellites above the horizon are looked for
SEARCH_MARGIN_RAD = np.deg2rad(2.0)  # more than a satellite moves meanwhile
INTEGER_RANGE = 1000
ERROR_NODE_S = 30.0
SAME_EPOCH_S = 1e-3
WAVELENGTH_L1_M = wavelength_m("G1C")

Probability = Field(default=0.0, ge=0, le=1)


class Outage(Table):
    """No tracking from `start_s` to `end_s`, of some satellites or of all."""

    start_s: float
    end_s: float
    satellites: tuple[str, ...] = ()


class CodeFaults(Table):
    """Faults of several codes at every epoch from `start_s` to `end_s`, both included; at least one satellite is hit."""

    start_s: float
    end_s: float
    size_m: PositiveFloat  # either sign
    probability: float = Field(default=0.3, ge=0, le=1)  # of a satellite at an epoch
    spare_highest: bool = True  # the satellite most in view stays good

    def during(self, t_s: Array) -> BoolArray:
        """True (n,) at times inside the window."""
        return (t_s > self.start_s - SAME_EPOCH_S) & (t_s < self.end_s + SAME_EPOCH_S)


class ClockTable(Table):
    """Receiver clock: offset and drift at the start, and how the drift walks."""

    offset_s: float = Field(default=3e-4, ge=0, le=0.01)  # drawn evenly between plus and minus this
    drift: float = Field(default=1e-7, ge=0)  # standard deviation, seconds per second
    drift_walk_rts: float = Field(default=3e-10, ge=0)  # density, per sqrt(s)
    limit_s: float = Field(default=0.0, ge=0)  # an offset beyond it is set back by whole milliseconds; 0: never
    phase_follows: bool = True  # phases jump with the clock, as codes do


class GnssTable(Table):
    """A receiver and its antenna."""

    rate_hz: PositiveFloat = 1.0
    offset_s: float = Field(default=0.0, ge=0)
    lever_b: Vec3 = (0.0, 0.0, 0.0)
    signals: tuple[str, ...] = Field(default=("G1C", "E1C"), min_length=1)
    noise: GnssNoiseTable = GnssNoiseTable()  # simulated, and what the estimator is told
    mask_deg: float = Field(default=5.0, ge=3, lt=90)
    clock: ClockTable = ClockTable()
    multipath_m: float = Field(default=0.0, ge=0)  # zenith standard deviation, grows as the code's does
    multipath_s: PositiveFloat = 40.0
    outlier_probability: float = Probability  # of a code
    outlier_m: tuple[PositiveFloat, PositiveFloat] = (5.0, 50.0)  # smallest and largest size, either sign
    slips_per_hour: float = Field(default=0.0, ge=0)  # of every satellite
    slip_cycles: PositiveInt = 20  # largest
    slip_half_probability: float = Probability  # that a slip is half a cycle more
    lli_probability: float = Field(default=1.0, ge=0, le=1)  # that the receiver flags a slip
    half_cycle_s: float = Field(default=0.0, ge=0)  # from lock on, phases are flagged as ambiguous by half a cycle, and may be
    outages: tuple[Outage, ...] = ()
    code_faults: tuple[CodeFaults, ...] = ()


class EnvironmentTable(Table):
    """What all receivers share."""

    troposphere: float = Field(default=1.0, ge=0)  # times the model's delay
    ionosphere: float = Field(default=1.0, ge=0)  # times the broadcast model's delay; 0: none is broadcast either
    troposphere_mapping: Literal["sine", "niell"] = "sine"  # of the model's delay
    wet_m: float = Field(default=0.0, ge=0)  # wet delay of the zenith over the model's, standard deviation at sea level
    ionosphere_waves_m: float = Field(default=0.0, ge=0)  # travelling disturbances, vertical at L1, standard deviation
    ionosphere_gradient_ppm: float = Field(default=0.0, ge=0)  # of the vertical delay at L1, in a random direction
    satellite_error_m: float = Field(default=0.0, ge=0)  # broadcast orbits and clocks, standard deviation of a range
    satellite_error_s: PositiveFloat = 1800.0
    sky_s: float = Field(default=0.0, ge=0)  # the constellation has moved on for so long since its nominal sky


@dataclass(frozen=True, slots=True)
class Slip:
    """A jump of the integer of one satellite and signal."""

    t_s: float
    satellite: str
    signal: str
    cycles: float
    flagged: bool


@dataclass(frozen=True, slots=True)
class GnssRecord:
    """What was put in, row by row of the stream."""

    integer: IntArray  # (n,) N
    half: IntArray  # (n,) half cycles beside it
    outlier_m: Array  # (n,) 0 where there is none
    range_m: Array  # (n,) rho
    elevation_rad: Array  # (n,)
    slips: tuple[Slip, ...]
    clock_s: Array  # (m,) receiver clock offset per epoch
    clock_drift: Array  # (m,)

    @property
    def cycles(self) -> Array:
        """What the phase holds beside ranges and clocks (n,)."""
        return self.integer + 0.5 * self.half


@dataclass(frozen=True, slots=True)
class Sky:
    """Constellation, place, time and atmosphere."""

    navigation: Navigation
    frame: LocalFrame
    t0: GpsTime
    duration_s: float
    environment: EnvironmentTable
    streams: Streams

    def satellite_error_m(self, satellites: tuple[str, ...], sat: IntArray, t_s: Array) -> Array:
        """Range error (n,) of broadcast orbits and clocks: Gauss-Markov between nodes, the same for every receiver."""
        nodes = np.arange(-ERROR_NODE_S, self.duration_s + 2 * ERROR_NODE_S, ERROR_NODE_S)
        error = np.zeros(len(sat))
        for k, name in enumerate(satellites):
            rows = sat == k
            unit = gauss_markov(_white(self.streams(name), len(nodes)), ERROR_NODE_S / self.environment.satellite_error_s)
            error[rows] = np.interp(t_s[rows], nodes, unit)
        return error * self.environment.satellite_error_m

    def disturbances_m(self, rays: Rays) -> tuple[Array, Array]:
        """Slant ionosphere at L1 and slant wet delay (n,) beyond the models, the same fields for every receiver."""
        own, e = self.streams / "atmosphere", self.environment
        lat, lon, _ = geodesy.geodetic_from_ecef(self.frame.origin_ecef[None])
        origin = (float(lat[0]), float(lon[0]))
        iono, wet = np.zeros(len(rays.t_s)), np.zeros(len(rays.t_s))
        if e.ionosphere_waves_m > 0 or e.ionosphere_gradient_ppm > 0:
            iono = ionosphere_m(rays, e.ionosphere_waves_m, e.ionosphere_gradient_ppm, own("ionosphere"), origin)
        if e.wet_m > 0:
            wet = wet_m(rays, e.wet_m, own("wet"), origin)
        return iono, wet


@dataclass(frozen=True, slots=True)
class _Geometry:
    """Epochs by satellites; satellite states at transmission."""

    pos: Array  # (m, S, 3)
    vel: Array
    clock_m: Array  # (m, S)
    clock_mps: Array
    record: IntArray
    rho: Array
    rho_dot: Array
    el: Array
    tropo: Array
    iono_l1: Array


def check_signals(signals: tuple[str, ...]) -> None:
    """Raises InputError for a signal that is not system, band and attribute of a known carrier."""
    for name in signals:
        if len(name) != 3 or name[1] not in MEGAHERTZ.get(name[0], {}):
            raise InputError(f'signal "{name}": write system, band and attribute of a carrier, such as "G1C", "E5Q" or "C2I"')


def simulate(
    table: GnssTable, sky: Sky, trajectory: Trajectory, streams: Streams, noise_scale: float
) -> tuple[Antenna, GnssRecord]:
    """Observations of the whole flight.

    `noise_scale` multiplies noise, multipath, outliers and satellite errors; clocks, integers and slips stay. Raises
    InputError for unknown signals or when no satellite is ever in view.
    """
    check_signals(table.signals)
    table = table.model_copy(update={"signals": tuple(sorted(set(table.signals)))})
    t_tag = epochs(table.rate_hz, table.offset_s, sky.duration_s)
    clock_s, drift, reset_s = _clock(table.clock, t_tag, streams("clock"))
    t = t_tag - clock_s
    r_n, v_n = trajectory.at(t).point(table.lever_b)
    r = sky.frame.to_ecef(r_n)
    names = _in_view(table, sky, t, r)
    geometry = _geometry(sky, names, t, r, sky.frame.rotate_to_ecef(v_n), noise_scale)
    tracked = (geometry.el >= np.deg2rad(table.mask_deg)) & (geometry.record >= 0) & ~_outages(table.outages, names, t)
    rows = _rows(table, names, tracked, streams)
    integer, half, lli, slips = _integers(table, names, tracked, t_tag, streams)
    e, s, k = rows.epoch, rows.sat, rows.signal
    lam = np.array([[wavelength_m(j, sky.navigation.glonass_channels.get(i)) for j in table.signals] for i in names])[s, k]
    el = geometry.el[e, s]
    scale = noise_scale * elevation_scale(el, table.noise.noise.elevation)
    outlier = noise_scale * rows.drawn("outlier", lambda rng, n: _outliers(table, rng, n))
    sat_clock = geometry.clock_m[e, s] - sky.navigation.group_delay_m(geometry.record[e, s], table.signals, k)
    common = geometry.rho[e, s] + C_MPS * clock_s[e] - sat_clock + geometry.tropo[e, s]
    common += noise_scale * sky.satellite_error_m(names, s, t[e])
    iono = geometry.iono_l1[e, s] * (lam / WAVELENGTH_L1_M) ** 2
    rate = geometry.rho_dot[e, s] * (1 - drift[e]) + C_MPS * drift[e] - geometry.clock_mps[e, s]
    noise = _noise(table, rows, scale)
    used, sat = np.unique(s, return_inverse=True)
    used_signals, signal = np.unique(k, return_inverse=True)
    stream = GnssStream(
        t_s=t_tag,
        epoch=e,
        sat=sat,
        signal=signal,
        satellites=tuple(names[i] for i in used),
        signals=tuple(table.signals[j] for j in used_signals),
        wavelength_m=lam,
        code_m=common + iono + noise.code_m + outlier,
        phase_cyc=(common - iono + noise.phase_m - C_MPS * reset_s[e]) / lam + integer[e, s, k] + 0.5 * half[e, s, k],
        doppler_hz=-(rate + noise.rate_mps) / lam,
        cn0_dbhz=34.0 + 16.0 * np.sin(el) + noise_scale * 0.7 * rows.drawn("cn0", _white),
        lli=lli[e, s, k],
        sat_pos_ecef=geometry.pos[e, s],
        sat_vel_ecef=geometry.vel[e, s],
        sat_clock_m=sat_clock,
        sat_clock_mps=geometry.clock_mps[e, s],
        approx_ecef=np.round(r[0], 4),
        klobuchar=sky.navigation.klobuchar,
    )
    record = GnssRecord(integer[e, s, k], half[e, s, k], outlier, geometry.rho[e, s], el, slips, clock_s, drift)
    antenna = Antenna(stream, table.lever_b, told(table))
    return with_code_faults(antenna, record, table.code_faults, streams, noise_scale)


def with_code_faults(
    antenna: Antenna, record: GnssRecord, faults: Sequence[CodeFaults], streams: Streams, noise_scale: float = 1.0
) -> tuple[Antenna, GnssRecord]:
    """The same observations with faults of their codes, which are added to the record's outliers.

    `streams` are the receiver's; a window's numbers depend on its times and on nothing else. All signals of a satellite
    have the same fault.
    """
    stream = antenna.stream
    fault = noise_scale * sum((_faults_m(f, stream, record.elevation_rad, streams) for f in faults), np.zeros(stream.n_rows))
    hit = replace(stream, code_m=stream.code_m + fault)
    return replace(antenna, stream=hit), replace(record, outlier_m=record.outlier_m + fault)


def _faults_m(faults: CodeFaults, stream: GnssStream, elevation_rad: Array, streams: Streams) -> Array:
    """Faults (n,) of one window, row by row of the stream."""
    shape = (len(stream.t_s), len(stream.satellites))
    elevation = np.full(shape, -np.inf)
    elevation[stream.epoch, stream.sat] = elevation_rad
    open_to = np.isfinite(elevation) & faults.during(stream.t_s)[:, None]
    if faults.spare_highest:
        open_to &= elevation < elevation.max(axis=1, keepdims=True)
    own = streams / f"code faults {faults.start_s:g} to {faults.end_s:g} s"
    drawn = np.array([own(name).random((2, shape[0])) for name in stream.satellites])
    chance, sign = np.where(open_to, drawn[:, 0].T, np.inf), np.where(drawn[:, 1].T < 0.5, -1.0, 1.0)
    hit = open_to & ((chance < faults.probability) | (chance == chance.min(axis=1, keepdims=True)))
    return np.where(hit, sign * faults.size_m, 0.0)[stream.epoch, stream.sat]


@dataclass(frozen=True, slots=True)
class _Rows:
    """Rows in order of epoch, satellite and signal, and random numbers for them."""

    epoch: IntArray  # (n,)
    sat: IntArray
    signal: IntArray
    n_epochs: int
    channels: tuple[tuple[int, int, str], ...]  # satellite, signal, name
    streams: Streams

    def drawn(self, source: str, draw: Callable[[np.random.Generator, int], Array]) -> Array:
        """Numbers (n,) from a stream of each satellite and signal that covers every epoch, seen or not."""
        out = np.zeros(len(self.epoch))
        for i, j, name in self.channels:
            mine = (self.sat == i) & (self.signal == j)
            out[mine] = draw(self.streams(f"{source}/{name}"), self.n_epochs)[self.epoch[mine]]
        return out


def _rows(table: GnssTable, names: tuple[str, ...], tracked: BoolArray, streams: Streams) -> _Rows:
    belongs = np.array([[signal[0] == name[0] for signal in table.signals] for name in names])
    e, s, k = np.nonzero(tracked[:, :, None] & belongs)
    if not len(e):
        signals = ", ".join(table.signals)
        raise InputError(f"no satellite with {signals} is ever tracked above {table.mask_deg:g} deg: check mask and outages")
    channels = tuple((int(i), int(j), f"{names[i]}/{table.signals[j]}") for i, j in np.argwhere(belongs))
    return _Rows(e, s, k, len(tracked), channels, streams)


def _white(rng: np.random.Generator, n: int) -> Array:
    return rng.normal(0.0, 1.0, n)


@dataclass(frozen=True, slots=True)
class _Noise:
    """Noise of every row (n,); of the code with multipath."""

    code_m: Array
    phase_m: Array
    rate_mps: Array


def _noise(table: GnssTable, rows: _Rows, scale: Array) -> _Noise:
    noise = table.noise.noise
    step = 1 / (table.rate_hz * table.multipath_s)
    multipath = table.multipath_m * rows.drawn("multipath", lambda rng, n: gauss_markov(_white(rng, n), step))
    return _Noise(
        scale * (noise.code_m * rows.drawn("code", _white) + multipath),
        scale * noise.phase_m * rows.drawn("phase", _white),
        scale * noise.doppler_mps * rows.drawn("doppler", _white),
    )


def told(table: GnssTable) -> GnssNoise:
    """Noise as the estimator is told: multipath counts as code noise."""
    noise = table.noise.noise
    return replace(noise, code_m=float(np.hypot(noise.code_m, table.multipath_m)))


def _clock(table: ClockTable, t_s: Array, rng: np.random.Generator) -> tuple[Array, Array, Array]:
    """Offset and drift (m,), and the part of the offset (m,) that phases do not show."""
    start, rate, steps = rng.uniform(-1, 1), rng.normal(), rng.normal(0.0, 1.0, len(t_s))
    dt = np.diff(t_s, prepend=t_s[0])
    drift = table.drift * rate + np.cumsum(table.drift_walk_rts * np.sqrt(dt) * steps)
    mean = 0.5 * (drift + np.concatenate([drift[:1], drift[:-1]]))
    offset = table.offset_s * start + np.cumsum(mean * dt)
    if not table.limit_s:
        return offset, drift, np.zeros(len(t_s))
    reset, total = np.zeros(len(t_s)), 0.0
    for k, free in enumerate(offset):
        if abs(free + total) > table.limit_s:
            total -= 1e-3 * np.ceil((abs(free + total) - table.limit_s) / 1e-3) * np.sign(free + total)
        reset[k] = total
    return offset + reset, drift, np.zeros(len(t_s)) if table.phase_follows else reset


def _outliers(table: GnssTable, rng: np.random.Generator, n: int) -> Array:
    hit, sign = rng.random(n) < table.outlier_probability, rng.choice([-1.0, 1.0], n)
    return np.where(hit, sign * rng.uniform(*table.outlier_m, n), 0.0)


def _outages(outages: tuple[Outage, ...], names: tuple[str, ...], t_s: Array) -> BoolArray:
    """(m, S) True where tracking is interrupted."""
    lost = np.zeros((len(t_s), len(names)), bool)
    for outage in outages:
        during = (t_s >= outage.start_s) & (t_s < outage.end_s)
        which = np.array([not outage.satellites or name in outage.satellites for name in names])
        lost |= during[:, None] & which
    return lost


def _in_view(table: GnssTable, sky: Sky, t_s: Array, r_ecef: Array) -> tuple[str, ...]:
    """Satellites with a wanted signal that may come above the mask, at least one."""
    systems = {signal[0] for signal in table.signals}
    names = tuple(name for name in sky.navigation.satellites if name[0] in systems)
    if not names:
        raise InputError(f"no satellites of {', '.join(sorted(systems))} to simulate with; there are G, E, C and J")
    at = np.unique(np.append(np.arange(0, len(t_s), max(1, int(SEARCH_S * table.rate_hz))), len(t_s) - 1))
    i, sat = np.repeat(at, len(names)), np.tile(np.arange(len(names)), len(at))
    pos = sky.navigation.states_at(names, sat, sky.t0, t_s[i]).pos_ecef
    _, el = _angles(pos, r_ecef[i])
    seen = np.any((el > np.deg2rad(table.mask_deg) - SEARCH_MARGIN_RAD).reshape(len(at), len(names)), axis=0)
    return tuple(name for name, ok in zip(names, seen, strict=True) if ok) or names[:1]


def _angles(sat_ecef: Array, r_ecef: Array) -> tuple[Array, Array]:
    """Azimuth and elevation (n,); NaN for satellites without a state."""
    los = sat_ecef - r_ecef
    los /= np.linalg.norm(los, axis=1, keepdims=True)
    lat, lon, _ = geodesy.geodetic_from_ecef(r_ecef)
    return look_angles(np.einsum("nij,nj->ni", geodesy.C_en(lat, lon), los))


def _geometry(sky: Sky, names: tuple[str, ...], t_s: Array, r: Array, v: Array, noise_scale: float) -> _Geometry:
    m, S = len(t_s), len(names)
    epoch, sat = np.repeat(np.arange(m), S), np.tile(np.arange(S), m)
    states, travel = sky.navigation.states_seen_from(names, sat, sky.t0, t_s[epoch], r[epoch])
    turned, turning = _turned(states.pos_ecef, travel)
    e = turned - r[epoch]
    e /= np.linalg.norm(e, axis=1, keepdims=True)
    sat_vel, _ = _turned(states.vel_ecef, travel)
    # rho_dot = e.(v_s (1 - tau_dot) + turning tau_dot - v), tau_dot = rho_dot / c
    closing = np.einsum("ni,ni->n", e, sat_vel - v[epoch])
    rho_dot = closing / (1 + np.einsum("ni,ni->n", e, sat_vel - turning) / C_MPS)
    lat, lon, h = (x[epoch] for x in geodesy.geodetic_from_ecef(r))
    az, el = look_angles(np.einsum("nij,nj->ni", geodesy.C_en(lat, lon), e))
    day = sky.t0.day_of_year if sky.environment.troposphere_mapping == "niell" else None
    tropo = sky.environment.troposphere * atmosphere.troposphere_m(lat, h, el, day_of_year=day)
    iono = np.zeros(m * S)
    klobuchar = sky.navigation.klobuchar
    if klobuchar is not None:
        iono = sky.environment.ionosphere * atmosphere.klobuchar_m(klobuchar, sky.t0.sow + t_s[epoch], lat, lon, az, el)
    more_iono, more_tropo = sky.disturbances_m(Rays(t_s[epoch], lat, lon, h, az, el))
    iono, tropo = iono + noise_scale * more_iono, tropo + noise_scale * more_tropo
    return _Geometry(
        pos=states.pos_ecef.reshape(m, S, 3),
        vel=states.vel_ecef.reshape(m, S, 3),
        clock_m=states.clock_m.reshape(m, S),
        clock_mps=states.clock_mps.reshape(m, S),
        record=states.record.reshape(m, S),
        rho=C_MPS * travel.reshape(m, S),
        rho_dot=rho_dot.reshape(m, S),
        el=el.reshape(m, S),
        tropo=tropo.reshape(m, S),
        iono_l1=iono.reshape(m, S),
    )


def _turned(x: Array, travel_s: Array) -> tuple[Array, Array]:
    """Vectors (n, 3) of the transmission's ECEF frame in that of reception, and the derivative to the travel time."""
    c, s = np.cos(OMEGA_E_RPS * travel_s), np.sin(OMEGA_E_RPS * travel_s)
    out = np.column_stack([c * x[:, 0] + s * x[:, 1], c * x[:, 1] - s * x[:, 0], x[:, 2]])
    return out, OMEGA_E_RPS * np.column_stack([out[:, 1], -out[:, 0], np.zeros(len(x))])


def _integers(
    table: GnssTable, names: tuple[str, ...], tracked: BoolArray, t_tag: Array, streams: Streams
) -> tuple[IntArray, IntArray, IntArray, tuple[Slip, ...]]:
    """Integers and half cycles (m, S, K), flags (m, S, K) of lost lock and half cycles, and the list of slips."""
    m = len(tracked)
    begins = tracked & ~np.vstack([np.zeros((1, len(names)), bool), tracked[:-1]])
    arc = np.cumsum(begins, axis=0) - 1
    shape = (*tracked.shape, len(table.signals))
    lli = np.repeat((begins & (np.arange(m) > 0)[:, None]).astype(np.int64)[:, :, None], shape[2], axis=2)
    integer, half = np.zeros(shape, np.int64), np.zeros(shape, np.int64)
    slips = []
    for i, name in enumerate(names):
        own = streams / f"integers/{name}"
        slipped = (own("slips").random(m) < table.slips_per_hour / 3600 / table.rate_hz) & tracked[:, i] & ~begins[:, i]
        flagged = own("flags").random(m) < table.lli_probability
        lli[slipped & flagged, i] = 1
        for j, signal in enumerate(table.signals):
            if signal[0] != name[0]:
                continue
            rng = own(signal)
            start = rng.integers(-INTEGER_RANGE, INTEGER_RANGE + 1, m)
            jump = rng.integers(1, table.slip_cycles + 1, m) * rng.choice([-1, 1], m)
            integer[:, i, j] = start[np.maximum(arc[:, i], 0)] + np.cumsum(np.where(slipped, jump, 0))
            more = own(f"half slips/{signal}").random(m) < table.slip_half_probability
            half[:, i, j] = np.cumsum(slipped & more)
            open_, off = _unresolved(begins[:, i] | (slipped & flagged), table.half_cycle_s, t_tag, own(f"half/{signal}"))
            half[:, i, j] += off
            lli[open_, i, j] |= 2
            slips += [
                Slip(float(t_tag[n]), name, signal, jump[n] + 0.5 * more[n], bool(flagged[n])) for n in np.flatnonzero(slipped)
            ]
    return integer, half, lli, tuple(sorted(slips, key=lambda slip: (slip.t_s, slip.satellite, slip.signal)))


def _unresolved(locked: BoolArray, duration_s: float, t_s: Array, rng: np.random.Generator) -> tuple[BoolArray, IntArray]:
    """When half cycles are open (m,) since an epoch of `locked`, and half cycles (m,) the phase is then off by."""
    last = np.maximum.accumulate(np.where(locked, np.arange(len(t_s)), -1))
    is_open = (last >= 0) & (t_s - t_s[np.maximum(last, 0)] < duration_s)
    return is_open, np.where(is_open, rng.integers(0, 2, len(t_s))[np.maximum(last, 0)], 0)
