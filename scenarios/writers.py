"""Solutions in the formats other programs read.

    tables   Parquet and CSV: vehicles, pairs, ambiguities, residuals; one column per number, units in the names
    .pos     RTKLIB solutions: positions per vehicle, baselines east-north-up per pair
    .tum     trajectories for evo: t x y z qx qy qz qw
    .kml     paths on a map

Angles are degrees here. Q of a .pos row is 1 fixed, 2 float (some or no integers), 4 code only, and 5 where a vehicle
is not differenced with a base.
Source: RTKLIB 2.4.3 manual, appendix B.1; evo, "Formats".
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from datetime import timedelta
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.csv as pacsv
import pyarrow.parquet as pq

from factorgraph.attitude import euler_from_matrix, matrix_from_quat
from factorgraph.geodesy import LocalFrame, geodetic_from_ecef
from factorgraph.gpstime import WEEK_S, GpsTime
from factorgraph.solution import ATT, BA, BG, OUTLIER_CLASSES, POS, VEL, Fix, PairSolution, Solution, VehicleSolution
from factorgraph.types import Array, IntArray
from scenarios.solutions import replace_with

QUALITY = {Fix.FIXED.value: 1, Fix.PARTIAL.value: 2, Fix.FLOAT.value: 2, Fix.NONE.value: 4}
SINGLE = 5
KML_POINTS = 5000  # per path: viewers grow slow beyond
COLOURS = ("ff0000ff", "ffff8000", "ff00a000", "ff00a5ff", "ff800080", "ff606060")  # aabbggrr


def write_all(solution: Solution, folder: Path) -> list[Path]:
    """Every format, in a folder. Raises InputError naming the file that cannot be written."""
    written: list[Path] = []
    for name, table in tables(solution).items():
        for kind, write in (("parquet", write_parquet), ("csv", write_csv)):
            written.append(folder / f"{name}.{kind}")
            write(table, written[-1])
    for v in solution.vehicles:
        stem = file_name(v.name)
        written += [folder / f"{stem}.pos", folder / f"{stem}.tum"]
        write_pos(solution, v.name, written[-2])
        write_tum(v.t_s, v.r_n, v.q_nb, written[-1])
        if v.truth is not None:
            written.append(folder / f"{stem}-truth.tum")
            write_tum(v.truth.t_s, v.truth.r_n, v.truth.q_nb, written[-1])
    for p in solution.pairs:
        written.append(folder / f"{file_name(f'{p.reference}-{p.rover}')}.pos")
        write_baseline_pos(solution, p, written[-1])
    written.append(folder / "paths.kml")
    write_kml(solution, written[-1])
    return written


def file_name(name: str) -> str:
    """A vehicle's or pair's name with only what every file system takes."""
    return re.sub(r"[^\w.-]+", "_", name).strip(".") or "_"


# tables


def tables(solution: Solution) -> dict[str, pa.Table]:
    """File stem -> table: "vehicle-…", "pair-…", "ambiguities", "residuals"."""
    found = {f"vehicle-{file_name(v.name)}": vehicle_table(solution, v) for v in solution.vehicles}
    found |= {f"pair-{file_name(f'{p.reference}-{p.rover}')}": pair_table(solution, p) for p in solution.pairs}
    return found | {"ambiguities": _ambiguity_table(solution), "residuals": _residual_table(solution)}


def vehicle_table(solution: Solution, v: VehicleSolution) -> pa.Table:
    """A row per state: time, position local and geodetic, velocity, attitude, biases, standard deviations."""
    lat, lon, h = geodetic_from_ecef(solution.frame.to_ecef(v.r_n))
    angles = _euler_deg(v.q_nb)
    sigma = np.sqrt(np.diagonal(v.P, axis1=1, axis2=2))
    columns = _time_columns(v.t_s, solution.t0) | {"lat_deg": np.degrees(lat), "lon_deg": np.degrees(lon), "h_m": h}
    columns |= _named(v.r_n, "{}_m", "east north up") | _named(v.v_n, "v_{}_mps", "east north up")
    columns |= _named(v.q_nb, "q{}", "w x y z") | _named(angles, "{}_deg", "pitch roll heading")
    columns |= _named(v.bias_gyro, "bias_gyro_{}_rps", "x y z") | _named(v.bias_accel, "bias_accel_{}_mps2", "x y z")
    columns |= _named(sigma[:, POS], "sigma_{}_m", "east north up") | _named(sigma[:, VEL], "sigma_v_{}_mps", "east north up")
    columns |= _named(np.degrees(sigma[:, ATT]), "sigma_phi_{}_deg", "east north up")
    columns |= _named(sigma[:, BG], "sigma_bias_gyro_{}_rps", "x y z") | _named(sigma[:, BA], "sigma_bias_accel_{}_mps2", "x y z")
    return pa.table(columns)


def pair_table(solution: Solution, p: PairSolution) -> pa.Table:
    """A row per epoch: baseline, relative velocity, standard deviations, fix status."""
    sigma = np.sqrt(np.diagonal(p.P, axis1=1, axis2=2))
    columns = _time_columns(p.t_s, solution.t0) | _named(p.baseline_enu, "{}_m", "east north up")
    columns |= _named(p.velocity_enu, "v_{}_mps", "east north up") | {"length_m": np.linalg.norm(p.baseline_enu, axis=1)}
    columns |= _named(sigma[:, :3], "sigma_{}_m", "east north up") | _named(sigma[:, 3:], "sigma_v_{}_mps", "east north up")
    fix = pa.array([Fix(value).name.lower() for value in p.fix.tolist()])
    columns |= {"fix": fix, "ratio": p.ratio, "n_sat": p.n_sat}
    if p.truth_enu is not None:
        columns |= _named(p.truth_enu, "true_{}_m", "east north up")
    return pa.table(columns)


def _ambiguity_table(solution: Solution) -> pa.Table:
    a = solution.ambiguities
    texts = {"link": a.link, "satellite": a.satellite, "signal": a.signal}
    numbers = {
        "t_start_s": a.t_start_s,
        "t_end_s": a.t_end_s,
        "float_cyc": a.float_cyc,
        "sigma_cyc": a.sigma_cyc,
        "integer": a.integer,
    }
    return pa.table(
        {k: pa.array(list(v), pa.string()) for k, v in texts.items()} | numbers | {"state": pa.array(list(a.state), pa.string())}
    )


def _residual_table(solution: Solution) -> pa.Table:
    r = solution.residuals
    texts = (("kind", r.kind, r.kind_index), ("source", r.source, r.source_index), ("label", r.label, r.label_index))
    columns: dict[str, object] = {"t_s": r.t_s}
    columns |= {
        n: pa.DictionaryArray.from_arrays(index.astype(np.int32), pa.array(list(names), pa.string())) for n, names, index in texts
    }
    columns |= {"residual": r.residual, "sigma": r.sigma, "weight": r.weight, "outlier": r.outlier}
    classes = pa.DictionaryArray.from_arrays(r.outlier_class.astype(np.int32), pa.array(list(OUTLIER_CLASSES), pa.string()))
    columns |= {"outlier_class": classes, "cn0_dbhz": r.cn0_dbhz}
    return pa.table(columns | {"azimuth_deg": np.degrees(r.azimuth_rad), "elevation_deg": np.degrees(r.elevation_rad)})


def _time_columns(t_s: Array, t0: GpsTime) -> dict[str, object]:
    sow = t0.sow + t_s
    week = t0.week + np.floor(sow / WEEK_S).astype(np.int64)
    return {"t_s": t_s, "gps_week": week, "gps_sow_s": sow - (week - t0.week) * WEEK_S}


def _named(values: Array, pattern: str, names: str) -> dict[str, object]:
    return {pattern.format(name): np.ascontiguousarray(values[:, i]) for i, name in enumerate(names.split())}


def _euler_deg(q_nb: Array) -> Array:
    """Pitch, roll, heading in [0, 360) (n, 3); NaN without attitude."""
    pitch, roll, heading = euler_from_matrix(matrix_from_quat(q_nb))
    return np.asarray(np.degrees(np.column_stack([pitch, roll, np.mod(heading, 2 * np.pi)])))


def write_parquet(table: pa.Table, path: Path) -> None:
    replace_with(path, lambda part: pq.write_table(table, part))


def write_csv(table: pa.Table, path: Path) -> None:
    """CSV with a header; dictionary columns as text, NaN as empty cells."""
    plain = [_plain_column(table[name]) for name in table.column_names]
    replace_with(path, lambda part: pacsv.write_csv(pa.table(plain, names=table.column_names), part))


def _plain_column(column: pa.ChunkedArray) -> pa.ChunkedArray:
    if pa.types.is_dictionary(column.type):
        return column.cast(pa.string())
    if not pa.types.is_floating(column.type):
        return column
    values = column.to_numpy()
    return pa.chunked_array([pa.array(values, mask=np.isnan(values))])


# RTKLIB


def write_pos(solution: Solution, vehicle: str, path: Path) -> None:
    """Latitude, longitude and ellipsoidal height of a vehicle, with standard deviations north, east, up."""
    v = solution.vehicle(vehicle)
    lat, lon, h = geodetic_from_ecef(solution.frame.to_ecef(v.r_n))
    C = solution.frame.C_to_enu(v.r_n)
    P = C @ v.P[:, POS, POS] @ np.swapaxes(C, 1, 2)
    quality, n_sat, ratio = _quality(solution, v)
    sd = _deviations(P[:, [[1], [0], [2]], [1, 0, 2]])
    rows = np.column_stack([np.degrees(lat), np.degrees(lon), h])
    title = f"%  GPST           {'latitude(deg)':>17} {'longitude(deg)':>14} {'height(m)':>10}" + _title("n", "e", "u")
    legend = f"% (lat/lon/height=WGS84/ellipsoidal,{LEGEND})"
    lines = _pos_lines(solution, v.t_s, rows, ("14.9f", "14.9f", "10.4f"), quality, n_sat, sd, ratio)
    _write_lines(path, _pos_header(solution, v.t_s, [legend, title]), lines)


def write_baseline_pos(solution: Solution, p: PairSolution, path: Path) -> None:
    """Baseline of a pair, east-north-up at the reference."""
    reference = solution.vehicle(p.reference)
    sd = _deviations(p.P[:, :3, :3])
    title = f"%  GPST           {'e-baseline(m)':>17} {'n-baseline(m)':>14} {'u-baseline(m)':>14}" + _title("e", "n", "u")
    header = [f"% (e/n/u-baseline=WGS84,{LEGEND})", title]
    if reference.is_fixed:
        header.insert(0, f"% ref pos   : {' '.join(f'{x:14.4f}' for x in solution.frame.to_ecef(reference.r_n[0]))}")
    quality = _quality_of(p)
    lines = _pos_lines(solution, p.t_s, p.baseline_enu, ("14.4f",) * 3, quality, p.n_sat, sd, p.ratio)
    _write_lines(path, _pos_header(solution, p.t_s, header), lines)


LEGEND = "Q=1:fix,2:float,3:sbas,4:dgps,5:single,6:ppp,ns=# of satellites"


def _title(a: str, b: str, c: str) -> str:
    names = (f"sd{x}(m)" for x in (a, b, c, a + b, b + c, c + a))
    return f" {'Q':>3} {'ns':>3} " + " ".join(f"{name:>8}" for name in names) + f" {'age(s)':>6} {'ratio':>6}"


def _quality_of(p: PairSolution) -> IntArray:
    return np.array([QUALITY[value] for value in p.fix.tolist()], np.int64)


def _quality(solution: Solution, v: VehicleSolution) -> tuple[IntArray, IntArray, Array]:
    """Q, number of satellites and ratio at a vehicle's times, from its pair with a base where there is one."""
    n = len(v.t_s)
    fixed = {s.name for s in solution.vehicles if s.is_fixed}
    pair = next(
        (p for p in solution.pairs if {p.reference, p.rover} - {v.name} <= fixed and v.name in (p.reference, p.rover)), None
    )
    if pair is None or not len(pair.t_s) or v.is_fixed:
        return np.full(n, SINGLE, np.int64), np.zeros(n, np.int64), np.full(n, np.nan)
    near = np.clip(np.searchsorted(pair.t_s, v.t_s), 1, max(len(pair.t_s) - 1, 1)) if len(pair.t_s) > 1 else np.zeros(n, np.int64)
    near = np.where((near > 0) & (v.t_s - pair.t_s[near - 1] < pair.t_s[near] - v.t_s), near - 1, near)
    return _quality_of(pair)[near], pair.n_sat[near], pair.ratio[near]


def _deviations(P: Array) -> Array:
    """Standard deviations a, b, c, and sign(cov) sqrt(|cov|) of ab, bc, ca (n, 6)."""
    cov = np.column_stack([P[:, 0, 0], P[:, 1, 1], P[:, 2, 2], P[:, 0, 1], P[:, 1, 2], P[:, 2, 0]])
    return np.asarray(np.sign(cov) * np.sqrt(np.abs(cov)))


def _pos_header(solution: Solution, t_s: Array, titles: list[str]) -> list[str]:
    lines = [
        f"% program   : relnav {solution.versions.get('relnav', '')}".rstrip(),
        f"% flight    : {solution.name}, {solution.method}",
    ]
    for name, t in (("start", t_s[0]), ("end  ", t_s[-1])) if len(t_s) else ():
        instant = solution.t0 + float(t)
        lines.append(f"% obs {name} : {_calendar(instant)[:-2]} GPST (week{instant.week:04d} {instant.sow:8.1f}s)")
    return [*lines, "%", *titles]


def _calendar(instant: GpsTime) -> str:
    """Date and time to the millisecond, rounded."""
    date = GpsTime(instant.week, round(instant.sow, 3)).calendar() + timedelta(microseconds=500)
    return date.strftime("%Y/%m/%d %H:%M:%S.") + f"{date.microsecond // 1000:03d}"


def _pos_lines(
    solution: Solution,
    t_s: Array,
    rows: Array,
    formats: tuple[str, ...],
    quality: IntArray,
    n_sat: IntArray,
    sd: Array,
    ratio: Array,
) -> Iterator[str]:
    usable = np.isfinite(rows).all(axis=1)
    sd = np.nan_to_num(sd)
    for i in np.flatnonzero(usable):
        position = " ".join(f"{x:{f}}" for x, f in zip(rows[i], formats, strict=True))
        spread = " ".join(f"{x:8.4f}" for x in sd[i])
        r = ratio[i] if np.isfinite(ratio[i]) else 0.0
        yield f"{_calendar(solution.t0 + float(t_s[i]))} {position} {quality[i]:3d} {n_sat[i]:3d} {spread} {0.0:6.2f} {r:6.1f}"


def _write_lines(path: Path, header: list[str], lines: Iterator[str]) -> None:
    text = "\n".join([*header, *lines]) + "\n"
    replace_with(path, lambda part: part.write_text(text, encoding="ascii", errors="replace"))


# trajectories and maps


def write_tum(t_s: Array, r_n: Array, q_nb: Array | None, path: Path) -> None:
    """`t x y z qx qy qz qw`: seconds since t0, local frame, body (right, front, up) to east-north-up.

    t_s (n,), r_n (n, 3), q_nb (n, 4) scalar first. Without attitude the rotation is the identity.
    """
    q = np.full((len(t_s), 4), np.nan) if q_nb is None else q_nb
    q = np.where(np.isfinite(q).all(axis=1, keepdims=True), q, [1.0, 0.0, 0.0, 0.0])
    rows = np.column_stack([t_s, r_n, q[:, [1, 2, 3, 0]]])
    lines = (f"{row[0]:.9f} " + " ".join(f"{x:.9f}" for x in row[1:]) for row in rows if np.isfinite(row).all())
    _write_lines(path, [], lines)


def write_kml(solution: Solution, path: Path) -> None:
    """A path per moving vehicle (thinned to KML_POINTS) and a mark per base."""
    import simplekml

    kml = simplekml.Kml(name=solution.name)
    for v, colour in zip(solution.vehicles, COLOURS * len(solution.vehicles), strict=False):
        coordinates = _lon_lat_h(solution.frame, v)
        if v.is_fixed and coordinates:
            kml.newpoint(name=v.name, coords=coordinates[:1], altitudemode=simplekml.AltitudeMode.absolute)
        elif coordinates:
            line = kml.newlinestring(name=v.name, coords=coordinates, altitudemode=simplekml.AltitudeMode.absolute)
            line.style.linestyle.color, line.style.linestyle.width = colour, 3
    replace_with(path, lambda part: part.write_text(kml.kml(), encoding="utf-8"))


def _lon_lat_h(frame: LocalFrame, v: VehicleSolution) -> list[tuple[float, float, float]]:
    r_n = v.r_n[np.isfinite(v.r_n).all(axis=1)]
    step = max(1, -(-len(r_n) // KML_POINTS))
    lat, lon, h = geodetic_from_ecef(frame.to_ecef(r_n[::step]))
    rows = np.column_stack([np.degrees(lon), np.degrees(lat), h])
    return [(float(a), float(b), round(float(c), 3)) for a, b, c in rows]
