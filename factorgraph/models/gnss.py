"""GNSS observations in the local frame: ranges and range rates to satellites, single-point positions, pairing.

With the satellite at s (ECEF at transmission, turned by the Earth's rotation during the travel time) and the antenna at
a, both in n, rho = |s - a| and e = (s - a) / rho (user to satellite):

    P    = rho + c dt_u - c dt_s + T + I            d rho / d a = -e^T
    Phi  = rho + c dt_u - c dt_s + T - I + lambda N
    -lambda D = e . (v_s - v_a) + c ddt_u - c ddt_s

T and I are the Saastamoinen and Klobuchar models; what they leave is in the noise. Satellite velocities are turned with
the positions; the rate's own second-order terms (below 1 mm/s) are left out.

Source: spec common.md, section 5; IS-GPS-200 (Sagnac).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from factorgraph import geodesy
from factorgraph.geodesy import C_MPS, OMEGA_E_RPS, LocalFrame
from factorgraph.measurements import GnssStream
from factorgraph.models import atmosphere
from factorgraph.models.differencing import CommonGroups
from factorgraph.problem import Elevation, GnssNoise
from factorgraph.types import Array, BoolArray, IntArray

# Order in which a receiver's tracking modes of one band are preferred; a common mode of both receivers comes first.
ATTRIBUTES = "CPWQXLZSYMNIDBAE"


def elevation_scale(el_rad: Array, model: Elevation = "sine") -> Array:
    """sigma(el) / sigma(zenith): sqrt((1 + 1 / sin^2 el) / 2), or 1 where flat. Source: spec common.md, section 5."""
    if model == "flat":
        return np.ones_like(el_rad, float)
    return np.sqrt(0.5 * (1 + 1 / np.sin(np.maximum(el_rad, np.deg2rad(3.0))) ** 2))


def turned_satellites(sat_pos_ecef: Array, sat_vel_ecef: Array, r_ecef: Array) -> tuple[Array, Array]:
    """Satellite positions and velocities (n, 3) in the ECEF frame of reception at r_ecef (n, 3)."""
    angle = OMEGA_E_RPS / C_MPS * np.linalg.norm(sat_pos_ecef - r_ecef, axis=-1)
    c, s = np.cos(angle), np.sin(angle)

    def turn(vector: Array) -> Array:
        x, y, z = vector.T
        return np.column_stack([c * x + s * y, c * y - s * x, z])

    return turn(sat_pos_ecef), turn(sat_vel_ecef)


def look_angles(los_n: Array) -> tuple[Array, Array]:
    """Azimuth (clockwise from north) and elevation of unit vectors (n, 3) in n."""
    return np.arctan2(los_n[:, 0], los_n[:, 1]), np.arcsin(np.clip(los_n[:, 2], -1.0, 1.0))


@dataclass(frozen=True, slots=True)
class Prepared:
    """A receiver's rows with everything that does not depend on the antenna's exact position, in n."""

    t_s: Array  # (n,) true reception time: tag minus receiver clock
    sat_n: Array  # (n, 3) satellite, turned to the time of reception
    sat_vel_n: Array  # (n, 3)
    code_m: Array  # (n,) corrected for satellite clock, troposphere and ionosphere
    phase_m: Array  # (n,) likewise; still holds lambda N
    rate_mps: Array  # (n,) -lambda D corrected for the satellite clock drift
    azimuth_rad: Array  # (n,)
    elevation_rad: Array  # (n,)
    ionosphere_m: Array  # (n,) the delay taken off the code and put on the phase


def without_ionosphere(p: Prepared) -> Prepared:
    """The same rows with the ionosphere's model left out."""
    zero = np.zeros_like(p.ionosphere_m)
    return replace(p, code_m=p.code_m + p.ionosphere_m, phase_m=p.phase_m - p.ionosphere_m, ionosphere_m=zero)


def prepare(
    stream: GnssStream,
    frame: LocalFrame,
    r_n: Array,
    clock_s: Array,
    klobuchar: Array | None,
    tow0_s: float,
    day_of_year: float | None = None,
) -> Prepared:
    """Correct a receiver's rows given approximate antenna positions r_n (m, 3) and clock offsets (m,) per epoch.

    With the day of the year the troposphere is mapped by Niell's functions, else by 1 / sin(el).

    Positions good to 10 m leave 1e-4 m in the geometry of single ranges and nothing in differences; heights good to 1 m
    leave 0.3 mm / sin(el) of troposphere, in differences too.
    """
    r_row = frame.to_ecef(r_n)[stream.epoch]
    sat, sat_vel = turned_satellites(stream.sat_pos_ecef, stream.sat_vel_ecef, r_row)
    sat_n = frame.from_ecef(sat)
    lat, lon, h = geodesy.geodetic_from_ecef(r_row)
    los = sat - r_row
    los /= np.linalg.norm(los, axis=1, keepdims=True)
    enu = np.einsum("nij,nj->ni", geodesy.C_en(lat, lon), los)
    az, el = look_angles(enu)
    tropo = atmosphere.troposphere_m(lat, h, el, day_of_year=day_of_year)
    iono = np.zeros_like(tropo)
    if klobuchar is not None:
        l1 = atmosphere.klobuchar_m(klobuchar, tow0_s + stream.t_s[stream.epoch], lat, lon, az, el)
        iono = l1 * (stream.wavelength_m / WAVELENGTH_L1_M) ** 2
    return Prepared(
        t_s=stream.t_s[stream.epoch] - clock_s[stream.epoch],
        sat_n=sat_n,
        sat_vel_n=frame.rotate_from_ecef(sat_vel),
        code_m=stream.code_m + stream.sat_clock_m - tropo - iono,
        phase_m=stream.phase_cyc * stream.wavelength_m + stream.sat_clock_m - tropo + iono,
        rate_mps=-stream.doppler_hz * stream.wavelength_m + stream.sat_clock_mps,
        azimuth_rad=az,
        elevation_rad=el,
        ionosphere_m=iono,
    )


WAVELENGTH_L1_M = C_MPS / 1575.42e6


def system_of(stream: GnssStream) -> Array:
    """Constellation letter of every row (n,), dtype <U1."""
    return np.array([s[0] for s in stream.satellites] or [""])[stream.sat]


def one_code_per_satellite(stream: GnssStream, usable: BoolArray) -> IntArray:
    """Rows with a code, one per epoch and satellite: the lowest band (L1, E1, B1 where tracked)."""
    rows = np.flatnonzero(usable & np.isfinite(stream.code_m) & np.isfinite(stream.sat_clock_m))
    rank = np.array([(int(s[1]) if s[1].isdigit() else 9) * 100 + max(ATTRIBUTES.find(s[2]), 0) for s in stream.signals] or [0])
    order = np.lexsort((rank[stream.signal[rows]], stream.sat[rows], stream.epoch[rows]))
    rows = rows[order]
    key = stream.epoch[rows] * len(stream.satellites) + stream.sat[rows]
    first = np.concatenate([[True], key[1:] != key[:-1]]) if rows.size else np.zeros(0, bool)
    return np.sort(rows[first])


def two_codes_per_satellite(stream: GnssStream, usable: BoolArray) -> tuple[IntArray, IntArray]:
    """Rows of two bands' codes of one satellite and epoch: of every constellation the two signals seen together most often.

    The pair is one and the same all along, so that its delays in the receiver stay with the clock.
    """
    rows = np.flatnonzero(usable & np.isfinite(stream.code_m) & np.isfinite(stream.sat_clock_m))
    letters = system_of(stream)[rows]
    firsts, seconds = [np.zeros(0, np.int64)], [np.zeros(0, np.int64)]
    for letter in np.unique(letters):
        mine = rows[letters == letter]
        key = stream.epoch[mine] * len(stream.satellites) + stream.sat[mine]
        signals = [k for k in np.unique(stream.signal[mine]).tolist()]
        best = (np.zeros(0, np.int64), np.zeros(0, np.int64))
        for a in signals:
            for b in signals:
                if stream.signals[a][1] < stream.signals[b][1]:
                    of_a, of_b = stream.signal[mine] == a, stream.signal[mine] == b
                    _, i, j = np.intersect1d(key[of_a], key[of_b], assume_unique=True, return_indices=True)
                    if len(i) > len(best[0]):
                        best = (mine[of_a][i], mine[of_b][j])
        firsts.append(best[0])
        seconds.append(best[1])
    first, second = np.concatenate(firsts), np.concatenate(seconds)
    order = np.argsort(first)
    return first[order], second[order]


@dataclass(frozen=True, slots=True)
class SinglePoint:
    """Single-point solution of each epoch; NaN where there are too few satellites."""

    r_ecef: Array  # (m, 3)
    clock_s: Array  # (m,) of the first constellation, seconds
    v_ecef: Array  # (m, 3) from Doppler
    n_sat: IntArray  # (m,)
    rms_m: Array  # (m,) of the code residuals


def single_point(stream: GnssStream, noise: GnssNoise, systems: str, klobuchar: Array | None, tow0_s: float) -> SinglePoint:
    """Positions, clocks and velocities from code and Doppler, all epochs at once.

    Gauss-Newton on the position of every epoch with one clock per constellation eliminated, Huber weights. Velocities
    likewise from Doppler. The start is the receiver's own approximate position or the centre of the Earth.
    """
    m = len(stream.t_s)
    rows = one_code_per_satellite(stream, np.isin(system_of(stream), list(systems)))
    sys_all = system_of(stream)
    rows = rows[np.lexsort((stream.sat[rows], sys_all[rows], stream.epoch[rows]))]
    epoch, system = stream.epoch[rows], sys_all[rows]
    letters, sys_index = np.unique(system, return_inverse=True)
    clocks = CommonGroups.from_labels(epoch * max(len(letters), 1) + sys_index)
    at_epoch = CommonGroups.from_labels(epoch)
    ids = epoch[at_epoch.start] if rows.size else np.zeros(0, np.int64)
    r = np.zeros((len(ids), 3))
    if stream.approx_ecef is not None and np.linalg.norm(stream.approx_ecef) > 6e6:
        r += stream.approx_ecef
    sat, vel = stream.sat_pos_ecef[rows], stream.sat_vel_ecef[rows]  # velocities are turned with the positions below
    base = stream.code_m[rows] + stream.sat_clock_m[rows]
    here = at_epoch.of_row
    sigma = np.full(len(rows), noise.absolute_code_m)
    mask = np.ones(len(rows), bool)
    w = np.ones(len(rows))
    y = np.zeros(len(rows))
    e = np.zeros((len(rows), 3))
    for iteration in range(12):
        rr = r[here]
        s, vel = turned_satellites(sat, stream.sat_vel_ecef[rows], rr)
        d = s - rr
        rho = np.linalg.norm(d, axis=1)
        e = d / rho[:, None]
        z = base
        if iteration >= 3:
            lat, lon, h = geodesy.geodetic_from_ecef(rr)
            az, el = look_angles(np.einsum("nij,nj->ni", geodesy.C_en(lat, lon), e))
            h = np.clip(h, -500.0, 15_000.0)
            z = base - atmosphere.troposphere_m(lat, h, el)
            if klobuchar is not None:
                l1 = atmosphere.klobuchar_m(klobuchar, tow0_s + stream.t_s[epoch], lat, lon, az, el)
                z = z - l1 * (stream.wavelength_m[rows] / WAVELENGTH_L1_M) ** 2
            mask = el > np.deg2rad(5.0)
            sigma = noise.absolute_code_m * elevation_scale(el, noise.elevation)
        y = z - rho
        u = np.where(mask, np.sqrt(w) / sigma, 0.0)
        dr = _solve_epochs(clocks.project(-e, u), clocks.project(y, u), at_epoch)
        r = r + dr
        if iteration >= 4:
            res = y + np.einsum("ni,ni->n", e, dr[here])
            t = np.abs(res - clocks.mean(res, u)[clocks.of_row]) / sigma
            w = np.minimum(1.0, 2.0 / np.maximum(t, 1e-12))
    u = np.where(mask, np.sqrt(w) / sigma, 0.0)
    clock_m = clocks.mean(y, u)
    first_clock = clock_m[clocks.of_row[at_epoch.start]] if rows.size else np.zeros(0)
    res = y - clock_m[clocks.of_row]
    used = np.bincount(here, mask, len(ids)).astype(np.int64)
    dof = used - 3 - np.bincount(here[clocks.start], minlength=len(ids))
    sq = np.bincount(here, np.where(mask, res**2, 0.0), len(ids))
    v = _doppler_velocity(stream, rows, e, vel, mask, clocks, at_epoch, noise)

    def spread(values: Array) -> Array:
        out = np.full((m, *values.shape[1:]), np.nan)
        out[ids] = values
        return out

    good = dof >= 0
    r[~good] = np.nan
    first_clock = np.where(good, first_clock, np.nan)
    rms = np.sqrt(sq / np.maximum(dof, 1))
    n_sat = np.zeros(m, np.int64)
    n_sat[ids] = used
    return SinglePoint(spread(r), spread(first_clock) / C_MPS, spread(v), n_sat, spread(np.where(good, rms, np.nan)))


def _solve_epochs(J: Array, y: Array, at_epoch: CommonGroups) -> Array:
    """Least squares of every epoch's own three unknowns, (g, 3); 0 where the geometry is singular."""
    N = at_epoch.sum(J[:, :, None] * J[:, None, :])
    b = at_epoch.sum(J * y[:, None])
    scale = np.trace(N, axis1=1, axis2=2)
    ok = np.linalg.det(N / np.where(scale > 0, scale, 1.0)[:, None, None]) > 1e-12
    x = np.zeros_like(b)
    x[ok] = np.linalg.solve(N[ok], b[ok][..., None])[..., 0]
    return x


def _doppler_velocity(
    stream: GnssStream,
    rows: IntArray,
    e: Array,
    vel: Array,
    mask: BoolArray,
    clocks: CommonGroups,
    at_epoch: CommonGroups,
    noise: GnssNoise,
) -> Array:
    rate = -stream.doppler_hz[rows] * stream.wavelength_m[rows] + stream.sat_clock_mps[rows]
    ok = mask & np.isfinite(rate) & np.all(np.isfinite(vel), axis=1)
    y = np.where(ok, rate - np.einsum("ni,ni->n", e, np.nan_to_num(vel)), 0.0)
    w = np.ones(len(rows))
    v = np.zeros((len(at_epoch.start), 3))
    for _ in range(5):
        u = np.where(ok, np.sqrt(w), 0.0) / noise.doppler_mps
        v = _solve_epochs(clocks.project(-e, u), clocks.project(y, u), at_epoch)
        res = y + np.einsum("ni,ni->n", e, v[at_epoch.of_row])
        t = np.abs(res - clocks.mean(res, u)[clocks.of_row]) / noise.doppler_mps
        w = np.minimum(1.0, 2.0 / np.maximum(t, 1e-12))
    count = at_epoch.sum(ok.astype(float))
    v[count < 5] = np.nan
    return v


@dataclass(frozen=True, slots=True)
class PairedRows:
    """Observations that two receivers share: rows of each, sorted by epoch, then clock group, then satellite."""

    a: IntArray  # (n,) rows of the reference's stream
    b: IntArray  # (n,) rows of the rover's stream
    epoch: IntArray  # (n,) epoch of the rover's stream
    group: IntArray  # (n,) clock group within the flight: system and the two signals
    group_names: tuple[str, ...]


def pair_rows(
    a: GnssStream, b: GnssStream, usable_a: BoolArray, usable_b: BoolArray, bands: str, tolerance_s: float = 0.02
) -> PairedRows:
    """Match epochs, satellites and bands of two receivers; one signal per satellite and band.

    Signals of one band are matched by the same tracking mode where both have it (C with C, W with W), else by each
    receiver's best; unlike modes form their own clock group, since their biases differ.
    """
    nearest = np.clip(np.searchsorted(a.t_s, b.t_s), 1, max(len(a.t_s) - 1, 1))
    nearest = np.where(
        np.abs(a.t_s[nearest - 1] - b.t_s) <= np.abs(a.t_s[np.minimum(nearest, len(a.t_s) - 1)] - b.t_s), nearest - 1, nearest
    )
    nearest = np.minimum(nearest, len(a.t_s) - 1)
    matched = np.abs(a.t_s[nearest] - b.t_s) <= tolerance_s
    epoch_of_a = np.full(len(a.t_s), -1)
    epoch_of_a[nearest[matched]] = np.flatnonzero(matched)

    satellites = sorted(set(a.satellites) & set(b.satellites))
    number = {s: i for i, s in enumerate(satellites)}

    def table(stream: GnssStream, usable: BoolArray, epoch: IntArray) -> tuple[IntArray, Array, IntArray, IntArray, IntArray]:
        sat = np.array([number.get(s, -1) for s in stream.satellites] or [-1])[stream.sat]
        band = np.array([bands.find(s[1]) for s in stream.signals] or [-1])[stream.signal]
        mode = np.array([ATTRIBUTES.find(s[2]) for s in stream.signals] or [-1])[stream.signal]
        keep = usable & (sat >= 0) & (band >= 0) & (epoch >= 0) & (np.isfinite(stream.code_m) | np.isfinite(stream.phase_cyc))
        rows = np.flatnonzero(keep)
        # among equal modes-to-be, rows with a phase come first
        return rows, (epoch[rows] * len(satellites) + sat[rows]) * len(bands) + band[rows], mode[rows], sat[rows], band[rows]

    rows_a, key_a, mode_a, _, _ = table(a, usable_a, epoch_of_a[a.epoch])
    rows_b, key_b, mode_b, _, _ = table(b, usable_b, np.where(matched, np.arange(len(b.t_s)), -1)[b.epoch])
    # every combination of a's and b's modes within a key, then the best of them
    order_a, order_b = np.argsort(key_a, kind="stable"), np.argsort(key_b, kind="stable")
    ka, kb = key_a[order_a], key_b[order_b]
    lo, hi = np.searchsorted(ka, kb, "left"), np.searchsorted(ka, kb, "right")
    count = hi - lo
    ib = np.repeat(np.arange(len(kb)), count)
    ia = np.repeat(lo, count) + (np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count))
    ra, rb = rows_a[order_a][ia], rows_b[order_b][ib]
    ma, mb = mode_a[order_a][ia], mode_b[order_b][ib]
    no_phase = ~(np.isfinite(a.phase_cyc[ra]) & np.isfinite(b.phase_cyc[rb]))
    key = kb[ib]
    best = np.lexsort((ma + mb, ma != mb, no_phase, key))
    first = np.concatenate([[True], key[best][1:] != key[best][:-1]]) if key.size else np.zeros(0, bool)
    pick = best[first]
    ra, rb = ra[pick], rb[pick]

    names_a, names_b = np.array(a.signals or ("",)), np.array(b.signals or ("",))
    pair_name = np.char.add(np.char.add(names_a[a.signal[ra]], "/"), names_b[b.signal[rb]]) if len(ra) else np.zeros(0, "<U7")
    group_names, group = np.unique(pair_name, return_inverse=True)
    order = np.lexsort((b.sat[rb], group, b.epoch[rb]))
    return PairedRows(ra[order], rb[order], b.epoch[rb][order], group[order].astype(np.int64), tuple(str(g) for g in group_names))
