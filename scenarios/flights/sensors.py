"""From columns to measurement streams: units, axes, time order, and checks that find wrong declarations.

Reading comes first (`read_…`, times as the file counts them), conversion second (`…_stream`, once t0 and the local
frame are known). At rest a specific force is about +9.8 m/s^2 along the body's up axis: other magnitudes or
directions tell of wrong units, wrong axes, or gravity removed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from factorgraph.attitude import ENU_NED, matrix_from_quat, quat_from_matrix
from factorgraph.errors import InputError
from factorgraph.geodesy import LocalFrame, ecef_from_geodetic
from factorgraph.gpstime import GpsTime
from factorgraph.measurements import HeightStream, ImuStream, PositionStream, RangeStream, ReadReport, Tag, Truth
from factorgraph.problem import Vec3
from factorgraph.types import Array, BoolArray, IntArray
from scenarios.flights import schema
from scenarios.flights.nmea import NmeaPositions, read_nmea
from scenarios.flights.rtklib_pos import PosFile, read_pos
from scenarios.flights.schema import STANDARD_GRAVITY, axes_matrix
from scenarios.flights.tables import RawTable, Times, ordered, read_columns, read_times, time_columns
from scenarios.flights.time_tag import tagged_times
from scenarios.flights.ubx import read_ubx_fixes

G = 9.8
MAX_DISTANCE_M = 1e6  # of position fixes from the local origin
DEFAULT_SIGMA_M = (3.0, 3.0, 6.0)  # of position fixes that state none
DEFAULT_SIGMA_MPS = (0.1, 0.1, 0.2)  # of their velocities
MIN_SIGMA = 1e-4
MAX_RATE_RPS = 40.0  # no gyroscope of a vehicle measures more (2300 deg/s)
MAX_FORCE = 100.0  # times the median
SAME_S = 1e-3  # two logs of one ranging exchange agree to this


@dataclass(frozen=True, slots=True)
class Place:
    """What conversion needs to know: t0, the local frame n, and the turn from the recording's axes to n."""

    t0: GpsTime
    frame: LocalFrame
    C_nl: Array  # (3, 3)


@dataclass(frozen=True, slots=True)
class Raw:
    """A file as read: its times, and the table or the solution it holds."""

    times: Times
    table: RawTable | None = None
    pos: PosFile | None = None
    nmea: NmeaPositions | None = None

    def first_ecef(self, frame: str, position: Sequence[str | int]) -> Array | None:
        """First finite position (3,) ECEF; None when positions are local."""
        if self.pos is not None:
            r = self.pos.ecef()
        elif self.nmea is not None:
            r = _ecef_of_llh(self.nmea.llh_deg)
        elif self.table is not None and frame in ("ecef", "llh"):
            cells = self.table.stack(position)
            r = cells if frame == "ecef" else _ecef_of_llh(cells)
        else:
            return None
        if r is None:
            return None
        finite = r[np.isfinite(r).all(axis=1)]
        return finite[0] if len(finite) else None


def _ecef_of_llh(llh_deg: Array) -> Array:
    return ecef_from_geodetic(np.radians(llh_deg[:, 0]), np.radians(llh_deg[:, 1]), llh_deg[:, 2])


def read_raw(
    path: Path,
    options: schema.TextOptions,
    kind: str,
    time: schema.TimeColumn,
    columns: Sequence[str | int],
    texts: Sequence[str | int] = (),
    day: str = "",
) -> Raw:
    """Read a file of any kind; columns matter for "csv" and "mat" only. Raises InputError as its readers do."""
    if kind in ("rtklib-pos", "ubx"):
        pos = read_pos(path) if kind == "rtklib-pos" else read_ubx_fixes(path)
        return Raw(pos.times, pos=pos)
    if kind == "nmea":
        nmea = read_nmea(path, day)
        return Raw(nmea.times, nmea=nmea)
    time_numbers, time_texts = time_columns(time)
    table = read_columns(path, options, kind, [*time_numbers, *columns], [*time_texts, *texts])
    return Raw(tagged_times(table, options, time) if time.tag and kind == "csv" else read_times(table, time), table)


def the_table(raw: Raw) -> RawTable:
    assert raw.table is not None
    return raw.table


# IMU


def read_imu(path: Path, imu: schema.Imu) -> Raw:
    return read_raw(path, imu, imu.format, imu.time, imu.columns)


def imu_stream(raw: Raw, imu: schema.Imu, place: Place) -> tuple[ImuStream, ReadReport]:
    """Specific force and rate in the body frame. Raises InputError for wrong units and axes, as far as gravity tells."""
    table = the_table(raw)
    source = str(table.path)
    f = _forces(table, imu)
    t = raw.times.since(place.t0)
    w = _rates(table, imu, t)
    keep, dropped = ordered(t, np.hstack([f, w]), source)
    wild = keep & _wild(f, w, keep)
    keep &= ~wild
    if wild.any():
        dropped["beyond what an IMU measures"] = int(wild.sum())
    if keep.sum() < 2:
        raise InputError(f"{source}: {int(keep.sum())} usable row; an IMU needs two at least")
    C_bs = imu.C_bs
    stream = ImuStream(t[keep], f[keep] @ C_bs.T, w[keep] @ C_bs.T, imu.is_mean)
    notes = () if imu.accel == "level" else _check_gravity(stream, f[keep], w[keep], imu, source)
    return stream, ReadReport(source, len(stream.t_s), {**table.dropped, **dropped}, notes)


def _forces(table: RawTable, imu: schema.Imu) -> Array:
    """Specific forces (n, 3) along the columns' axes; those of a level vehicle without acceleration where none are measured."""
    if imu.accel == "level":
        return np.tile(STANDARD_GRAVITY * imu.C_bs[2], (table.n_rows_kept, 1))
    return table.stack(imu.accel) * (STANDARD_GRAVITY if imu.accel_unit == "g" else 1.0)


def _rates(table: RawTable, imu: schema.Imu, t_s: Array) -> Array:
    """Angular rates (n, 3) along the columns' axes; a single column is the rate about the body's up axis."""
    w = table.stack(imu.gyro_columns) * (np.pi / 180 if imu.gyro_unit == "deg/s" else 1.0)
    if imu.gyro_increments:
        w = w / np.diff(t_s, prepend=np.nan)[:, None]
    return w if w.shape[1] == 3 else w * imu.C_bs[2]


def _wild(f: Array, w: Array, among: BoolArray) -> BoolArray:
    """Single samples (n,) that cannot be; where most are so, units and columns are wrong, which is told elsewhere."""
    size, rate = np.linalg.norm(f, axis=1), np.linalg.norm(w, axis=1)
    too_fast = rate > MAX_RATE_RPS
    rates_fit = np.percentile(rate[among], 99.0) <= MAX_RATE_RPS
    return np.asarray((size > MAX_FORCE * np.median(size[among])) | (too_fast & rates_fit))


def _check_gravity(stream: ImuStream, f_s: Array, w_s: Array, imu: schema.Imu, source: str) -> tuple[str, ...]:
    """Notes on doubtful units and axes of samples f_s, w_s (n, 3); raises InputError for certain errors."""
    size, rate = _quiet(f_s, w_s, stream.t_s)
    notes: list[str] = []
    if abs(size - G) > 0.25 * G:
        likely = _likely_unit(size, rate, imu)
        raise InputError(f"{source}: |f| is {size:.4g} m/s2 where the IMU is quietest, expected about 9.8: {likely}")
    if abs(size - G) > 0.04 * G:
        notes.append(f"|f| is {size:.3f} m/s2 where the IMU is quietest, expected about 9.8: scale, bias, or never at rest")
    fastest = float(np.percentile(np.linalg.norm(w_s, axis=1), 99.0))
    if fastest > MAX_RATE_RPS:
        hint = 'gyro_unit = "deg/s" looks right' if imu.gyro_unit == "rad/s" else "check gyro columns and unit"
        raise InputError(f"{source}: rates reach {fastest:.0f} rad/s, more than gyroscopes measure; {hint}")
    if imu.gyro_unit == "rad/s" and rate > 0.2:
        notes.append(f'the gyroscopes read {rate:.2f} rad/s where the IMU is quietest; gyro_unit = "deg/s"?')
    mean = stream.f_b.mean(axis=0)
    up = float(mean[2] / np.linalg.norm(mean))
    if up < -0.5:
        likely = _likely_axes(f_s.mean(axis=0), imu)
        raise InputError(f"{source}: gravity says (along D, not U) the vehicle is upside down with axes {imu.axes}{likely}")
    return tuple(notes)


def _quiet(f: Array, w: Array, t_s: Array) -> tuple[float, float]:
    """Magnitudes of mean specific force and mean rate: medians over the quietest tenth of stretches of a second."""
    n = len(t_s)
    span = min(n, max(2, round(1.0 / max(float(np.median(np.diff(t_s))), 1e-4)))) if n > 1 else 1
    whole = n // span * span
    blocks_f, blocks_w = f[:whole].reshape(-1, span, 3), w[:whole].reshape(-1, span, 3)
    quietest = np.argsort(blocks_f.var(axis=1).sum(axis=1))[: max(1, len(blocks_f) // 10)]
    size, rate = (np.linalg.norm(blocks[quietest].mean(axis=1), axis=1) for blocks in (blocks_f, blocks_w))
    return float(np.median(size)), float(np.median(rate))


def _likely_unit(size: float, rate: float, imu: schema.Imu) -> str:
    if imu.accel_unit == "m/s2" and abs(size - 1) < 0.1:
        return 'the values look like g, write accel_unit = "g"'
    if imu.accel_unit == "g" and abs(size / STANDARD_GRAVITY - G) < 1.0:
        return 'the values look like m/s2, write accel_unit = "m/s2"'
    if abs(rate - G) < 1.0 or abs(rate - 1) < 0.1:
        return "accel and gyro columns look swapped"
    if abs(size - 1000 * G) < 100 * G or abs(size - 1000) < 100:
        return "the values look like thousandths (mg or mm/s2)"
    if size < 0.1 * G:
        return "gravity looks removed, but specific force is needed as the accelerometers measure it"
    return "check the accel columns and accel_unit"


def _likely_axes(f_s: Array, imu: schema.Imu) -> str:
    """The usual sets of axes with which a mean specific force (3,) points up."""
    unit = f_s / np.linalg.norm(f_s)
    fits = [axes for axes in ("RFU", "FRD", "FLU") if (imu.mounting.C @ axes_matrix(axes) @ unit)[2] > 0.8]
    if fits:
        return f"; {' or '.join(fits)} would have it upright"
    return f"; the columns see up along ({unit[0]:+.2f}, {unit[1]:+.2f}, {unit[2]:+.2f}), so check axes and mounting"


# positions, heights, truth


def read_positions(path: Path, p: schema.Positions) -> Raw:
    columns = (*p.position, *(p.sigma or ()), *(p.velocity or ()), *(() if p.quality is None else (p.quality,)))
    return read_raw(path, p, p.format, p.time, columns, day=p.date)


def position_streams(
    raw: Raw, p: schema.Positions, lever_b: Vec3, place: Place, path: Path
) -> tuple[tuple[PositionStream, ...], ReadReport]:
    """Position fixes in n with their standard deviations per axis of n, and their velocities where the file has them.

    Velocities that hold at another time than the positions are a stream of their own, without positions.
    """
    r_n, dropped = _positions_n(raw, p.frame, p.position, place)
    sigma = _position_sigma(raw, p, place, len(r_n)) * p.sigma_scale
    t = raw.times.since(place.t0)
    keep, more = ordered(t, np.hstack([r_n, sigma]), str(path))
    keep = _of_quality(raw, p, keep, more, path)
    distance_m = np.linalg.norm(r_n, axis=1)
    far = keep & (distance_m > MAX_DISTANCE_M)
    if far.sum() > 0.5 * keep.sum():
        km = float(np.median(distance_m[far])) / 1e3
        raise InputError(
            f"{path}: positions are {km:.4g} km from the local origin; check position, frame and the flight's origin"
        )
    keep &= ~far
    if far.any():
        more[f"farther than {MAX_DISTANCE_M / 1e3:g} km from the local origin"] = int(far.sum())
    sigma = np.maximum(sigma[keep], MIN_SIGMA)
    report = ReadReport(str(path), int(keep.sum()), {**dropped, **more})
    velocity = _velocity(raw, p, place) if p.use_velocity else None
    if velocity is None:
        return (PositionStream(t[keep], r_n[keep], sigma, lever_b, p.name),), report
    v_n, sigma_mps = velocity[0][keep], np.maximum(velocity[1][keep] * p.sigma_scale, MIN_SIGMA)
    if p.velocity_offset_s == 0:
        return (PositionStream(t[keep], r_n[keep], sigma, lever_b, p.name, v_n, sigma_mps),), report
    fixes = PositionStream(t[keep], r_n[keep], sigma, lever_b, p.name)
    none = np.full_like(v_n, np.nan)
    velocities = PositionStream(t[keep] + p.velocity_offset_s, none, none, lever_b, p.name, v_n, sigma_mps)
    return (fixes, velocities), report


def _of_quality(
    raw: Raw, p: schema.Positions | schema.TruthTable, keep: BoolArray, dropped: dict[str, int], path: Path
) -> BoolArray:
    """The kept rows (n,) that are of a wanted kind of fix; the others are counted in `dropped`."""
    if not p.qualities:
        return keep
    if raw.pos is not None:
        quality = raw.pos.quality
    elif raw.table is not None and p.quality is not None:
        quality = np.nan_to_num(raw.table.numbers[p.quality], nan=-1.0).astype(np.int64)
    else:
        raise InputError(f"{path}: qualities needs the column of the kind of fix; give quality")
    wanted = np.isin(quality, p.qualities)
    if not (keep & wanted).any():
        found = ", ".join(map(str, np.unique(quality[keep]).tolist()))
        raise InputError(f"{path}: no row is of the wanted qualities {', '.join(map(str, p.qualities))}; there are {found}")
    if (n := int((keep & ~wanted).sum())) > 0:
        dropped["of another kind of fix"] = n
    return keep & wanted


def _velocity(raw: Raw, p: schema.Positions, place: Place) -> tuple[Array, Array] | None:
    """Velocities (n, 3) of fixes in n and their standard deviations (n, 3); None where the file has none."""
    if raw.pos is not None:
        v_n, cov = raw.pos.velocity_enu(place.frame.C_en)
        if not np.isfinite(v_n).any():
            return None
        sigma = np.sqrt(np.diagonal(cov, axis1=1, axis2=2))
        sigma = np.where(sigma > 0, sigma, DEFAULT_SIGMA_MPS)
    elif raw.table is not None and p.velocity is not None:
        cells = raw.table.stack(p.velocity)
        v_n = cells if p.frame == "llh" else _velocity_n(cells, p.frame, place)
        sigma = np.tile(DEFAULT_SIGMA_MPS, (len(v_n), 1))
    else:
        return None
    return v_n, sigma if p.velocity_sigma_mps is None else np.tile(p.velocity_sigma_mps, (len(v_n), 1))


def _velocity_n(cells: Array, frame: str, place: Place) -> Array:
    """Velocities (n, 3) of a file's axes in n."""
    return place.frame.rotate_from_ecef(cells) if frame == "ecef" else np.asarray(cells @ turn(frame, place).T)


def _positions_n(raw: Raw, frame: str, columns: Sequence[str | int], place: Place) -> tuple[Array, dict[str, int]]:
    """Positions (n, 3) in the local frame, and what reading dropped."""
    if raw.pos is not None:
        r_ecef = raw.pos.ecef()
        r_n = raw.pos.position if r_ecef is None else place.frame.from_ecef(r_ecef)
        return r_n, raw.pos.dropped
    if raw.nmea is not None:
        return place.frame.from_ecef(_ecef_of_llh(raw.nmea.llh_deg)), raw.nmea.dropped
    table = the_table(raw)
    cells = table.stack(columns)
    if cells.shape[1] == 2:
        cells = np.column_stack([cells, np.zeros(len(cells))])
    if frame == "llh":
        r_n = place.frame.from_ecef(_ecef_of_llh(cells))
    elif frame == "ecef":
        r_n = place.frame.from_ecef(cells)
    else:
        r_n = cells @ turn(frame, place).T
    return r_n, table.dropped


def turn(frame: str, place: Place) -> Array:
    """Rotation (3, 3) from the axes of a local or north-east-down file to n."""
    return place.C_nl @ ENU_NED if frame == "ned" else place.C_nl


def _position_sigma(raw: Raw, p: schema.Positions, place: Place, n: int) -> Array:
    if p.sigma is not None and raw.table is not None:
        return raw.table.stack(p.sigma)
    if p.sigma_m is None and raw.pos is not None:
        sigma = np.sqrt(np.diagonal(raw.pos.cov_enu(place.frame.C_en), axis1=1, axis2=2))
        return np.where(sigma > 0, sigma, DEFAULT_SIGMA_M)
    if p.sigma_m is None and raw.nmea is not None:
        return raw.nmea.sigma_enu_m
    return np.tile(np.array(p.sigma_m or DEFAULT_SIGMA_M), (n, 1))


def read_heights(path: Path, h: schema.Heights) -> Raw:
    return read_raw(path, h, h.format, h.time, (h.height,))


def height_stream(raw: Raw, h: schema.Heights, lever_b: Vec3, place: Place) -> tuple[HeightStream, ReadReport]:
    """Heights above the local origin; cells outside [valid_min, valid_max] are counted."""
    table = the_table(raw)
    cells = table.numbers[h.height]
    up = h.scale * cells + h.offset_m - (place.frame.h_m if h.ellipsoidal else 0.0)
    t = raw.times.since(place.t0)
    keep, dropped = ordered(t, up[:, None], str(table.path))
    outside = keep & ~((cells >= h.valid_min) & (cells <= h.valid_max))
    keep &= ~outside
    thin = thinned(t, keep, h.min_interval_s)
    counts = {"outside valid_min and valid_max": int(outside.sum()), "thinned by min_interval_s": int(keep.sum() - thin.sum())}
    if not thin.any():
        raise InputError(f"{table.path}: no height lies between valid_min {h.valid_min:g} and valid_max {h.valid_max:g}")
    stream = HeightStream(t[thin], up[thin], np.full(int(thin.sum()), h.sigma_m), lever_b, h.name)
    dropped |= {reason: n for reason, n in counts.items() if n}
    return stream, ReadReport(str(table.path), len(stream.t_s), {**table.dropped, **dropped})


def thinned(t: Array, keep: BoolArray, interval_s: float) -> BoolArray:
    """The first kept row of every interval."""
    if interval_s <= 0:
        return keep
    thin = np.zeros(len(t), bool)
    rows = np.flatnonzero(keep)
    cell = np.floor((t[rows] - t[rows[0]]) / interval_s + 1e-6) if rows.size else np.zeros(0)
    thin[rows[np.unique(cell, return_index=True)[1]]] = True
    return thin


def constant_heights(h: schema.Heights, lever_b: Vec3, start_s: float, end_s: float) -> HeightStream:
    """The constant height at regular times over a span."""
    t = np.arange(start_s, end_s + 1e-6, h.interval_s)
    up = np.full(len(t), h.scale * (h.constant_m or 0.0) + h.offset_m)
    return HeightStream(t, up, np.full(len(t), h.sigma_m), lever_b, h.name)


def read_truth(path: Path, truth: schema.TruthTable) -> Raw:
    columns = (*truth.position, *(truth.velocity or ()), *(truth.quaternion or ()))
    columns += () if truth.quality is None else (truth.quality,)
    return read_raw(path, truth, truth.format, truth.time, columns, day=truth.date)


def truth_of(
    raw: Raw, truth: schema.TruthTable, C_ba: Array, lever_b: Array, place: Place, path: Path
) -> tuple[Truth, ReadReport]:
    """Reference trajectory of the IMU.

    C_ba (3, 3): from the vehicle's declared axes to the body; lever_b (3,): from the point of the trajectory to the IMU.
    Without attitude the vertical part of the lever arm is applied, as to a level vehicle.
    """
    r_n, dropped = _positions_n(raw, truth.frame, truth.position, place)
    t = raw.times.since(place.t0)
    C_nb, v_n = _truth_attitude(raw, truth, C_ba, place), _truth_velocity(raw, truth, place)
    keep, more = ordered(t, np.hstack([r_n, *(x.reshape(len(t), -1) for x in (C_nb, v_n) if x is not None)]), str(path))
    keep = _of_quality(raw, truth, keep, more, path)
    notes: tuple[str, ...] = ()
    if np.any(lever_b):
        if C_nb is None:
            r_n = r_n + lever_b * [0.0, 0.0, 1.0]
            if np.any(lever_b[:2]):
                notes = ("truth has no attitude, so it is moved to the IMU in height only",)
        else:
            r_n = r_n + C_nb @ lever_b
        if v_n is not None and (C_nb is not None or np.any(lever_b[:2])):
            v_n, notes = None, (*notes, "the true velocity is left out: it belongs to another point than the IMU")
    q_nb = None if C_nb is None else quat_from_matrix(C_nb[keep])
    result = Truth(t[keep], r_n[keep], None if v_n is None else v_n[keep], q_nb)
    return result, ReadReport(str(path), len(result.t_s), {**dropped, **more}, notes)


def constant_truth(truth: schema.TruthTable, t_s: Array, place: Place) -> Truth:
    """A vehicle that stands at a known position, at times t_s (n,)."""
    if truth.ecef_m is not None:
        r_n = place.frame.from_ecef(np.array(truth.ecef_m))
    else:
        r_n = place.C_nl @ np.array(truth.local_m)
    return Truth(t_s, np.tile(r_n, (len(t_s), 1)), np.zeros((len(t_s), 3)))


def _truth_attitude(raw: Raw, truth: schema.TruthTable, C_ba: Array, place: Place) -> Array | None:
    if truth.quaternion is None or raw.table is None:
        return None
    q = raw.table.stack(truth.quaternion)
    if truth.quaternion_order == "xyzw":
        q = q[:, [3, 0, 1, 2]]
    norm = np.linalg.norm(q, axis=1, keepdims=True)
    fits = np.abs(norm - 1) <= 0.01
    wrong = int(np.sum(~fits & np.isfinite(norm)))
    if wrong > 0.5 * len(q):
        raise InputError(f"{raw.table.path}: {wrong} of {len(q)} quaternions are not of unit length; check truth.quaternion")
    C = matrix_from_quat(np.where(fits, q, np.nan) / np.where(fits, norm, 1.0))
    return np.asarray(turn(truth.frame, place) @ C @ C_ba.T)


def _truth_velocity(raw: Raw, truth: schema.TruthTable, place: Place) -> Array | None:
    if truth.velocity is None or raw.table is None:
        return None
    return _velocity_n(raw.table.stack(truth.velocity), truth.frame, place)


# ranges


@dataclass(slots=True)
class _RangeRows:
    """Rows of the files of a range set, one after another."""

    t: list[Array] = field(default_factory=list)
    r: list[Array] = field(default_factory=list)
    sigma: list[Array] = field(default_factory=list)
    a: list[IntArray] = field(default_factory=list)
    b: list[IntArray] = field(default_factory=list)


def read_ranges(path: Path, ranges: schema.Ranges) -> Raw:
    numbers = (ranges.range, *(() if ranges.sigma is None else (ranges.sigma,)))
    return read_raw(path, ranges, ranges.format, ranges.time, numbers, (ranges.tag_a, ranges.tag_b))


def range_stream(
    raws: Sequence[Raw], ranges: schema.Ranges, tags: tuple[Tag, ...], place: Place
) -> tuple[RangeStream, ReadReport]:
    """Ranges of all files in time order; exchanges that two files log are kept once.

    Rows with tags that are not declared are counted. Raises InputError when no row is left.
    """
    index = {tag.name: i for i, tag in enumerate(tags)}
    unknown: set[str] = set()
    rows = _RangeRows()
    for raw in raws:
        table = the_table(raw)
        rows.t.append(raw.times.since(place.t0))
        rows.r.append(ranges.scale * table.numbers[ranges.range] + ranges.offset_m)
        rows.sigma.append(np.full(table.n_rows_kept, ranges.sigma_m) if ranges.sigma is None else table.numbers[ranges.sigma])
        rows.a.append(_tag_index(table.texts[ranges.tag_a], index, unknown))
        rows.b.append(_tag_index(table.texts[ranges.tag_b], index, unknown))
    t, r, sigma = (np.concatenate(column) for column in (rows.t, rows.r, rows.sigma))
    a, b = np.concatenate(rows.a), np.concatenate(rows.b)
    source = ", ".join(str(the_table(raw).path) for raw in raws)
    finite = np.isfinite(t) & np.isfinite(r) & np.isfinite(sigma) & (sigma > 0)
    declared = (a >= 0) & (b >= 0) & (a != b)
    usable = finite & declared & (r > 0)
    counts = {
        "with empty or non-numeric cells": int(np.sum(~finite)),
        "between tags that are not declared": int(np.sum(finite & ~declared)),
        "not positive": int(np.sum(finite & declared & ~(r > 0))),
    }
    if not usable.any():
        found = ", ".join(f"{n} {reason}" for reason, n in counts.items() if n)
        hint = f"; the file has tags {', '.join(sorted(unknown)[:10])}" if unknown else f": {found}"
        raise InputError(f"{source}: no range between declared tags ({', '.join(index)}){hint}")
    order = np.flatnonzero(usable)[np.argsort(t[usable], kind="stable")]
    again = _logged_twice(t[order], r[order], np.sort(np.column_stack([a[order], b[order]]), axis=1))
    kept = order[~again]
    counts["logged twice"] = int(again.sum())
    dropped = {reason: n for raw in raws for reason, n in the_table(raw).dropped.items()}
    dropped |= {reason: n for reason, n in counts.items() if n}
    stream = RangeStream(t[kept], a[kept], b[kept], tags, r[kept], sigma[kept], ranges.name)
    return stream, ReadReport(source, len(kept), dropped)


def _tag_index(names: np.ndarray[tuple[int], np.dtype[np.str_]], index: dict[str, int], unknown: set[str]) -> IntArray:
    """Row -> declared tag, -1 for others; a numeric name such as 2.0e+00 is the tag 2."""
    distinct, inverse = np.unique(names, return_inverse=True)
    numbers = [index.get(name, index.get(_plain(name), -1)) for name in distinct.tolist()]
    unknown.update(_plain(name) for name, number in zip(distinct.tolist(), numbers, strict=True) if number < 0)
    return np.array(numbers, np.int64)[inverse]


def _plain(name: str) -> str:
    try:
        value = float(name)
    except ValueError:
        return name
    return str(int(value)) if value.is_integer() else name


def _logged_twice(t: Array, r: Array, pair: Array) -> BoolArray:
    """Rows (in time order) that repeat the range of the same pair of tags within SAME_S."""
    order = np.lexsort((t, r, pair[:, 1], pair[:, 0]))
    same = np.zeros(len(t), bool)
    same[1:] = (np.diff(pair[order], axis=0) == 0).all(axis=1) & (np.diff(r[order]) == 0) & (np.abs(np.diff(t[order])) <= SAME_S)
    again = np.zeros(len(t), bool)
    again[order] = same
    return again
