"""Streams of odometers, attitude systems, magnetometers and cameras from columns."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from factorgraph.attitude import matrix_from_euler, matrix_from_quat, quat_from_matrix
from factorgraph.errors import InputError
from factorgraph.measurements import AttitudeStream, MagneticStream, ReadReport, Tag, VelocityStream, VisionStream
from factorgraph.problem import Vec3
from factorgraph.types import Array, BoolArray
from scenarios.flights import schema
from scenarios.flights.schema import axes_matrix
from scenarios.flights.sensors import Place, Raw, read_raw, the_table, thinned, turn
from scenarios.flights.tables import ordered

MPS = {"m/s": 1.0, "km/h": 1 / 3.6}
RAD = {"rad": 1.0, "deg": np.pi / 180}


def read_velocities(path: Path, v: schema.Velocities) -> Raw:
    return read_raw(path, v, v.format, v.time, v.velocity or (v.forward or 0,))


def velocity_stream(raw: Raw, v: schema.Velocities, lever_b: Vec3, place: Place) -> tuple[VelocityStream, ReadReport]:
    """Velocities along the body axes; of distances since the row before, the mean velocity, at the middle of the two."""
    table = the_table(raw)
    t = raw.times.since(place.t0)
    cells = v.scale * MPS[v.unit] * table.stack(v.velocity or (v.forward or 0,))
    keep, dropped = ordered(t, cells, str(table.path))
    t, cells = t[keep], cells[keep]
    sigma = np.full(len(t), v.sigma_mps)
    if v.increments:
        dt = np.diff(t)
        t, cells, sigma = t[1:] - dt / 2, cells[1:] / dt[:, None], sigma[1:]
    if v.velocity is not None:
        v_b = cells @ (v.mounting.C @ axes_matrix(v.axes)).T
    else:
        v_b = np.full((len(t), 3), np.nan)
        v_b[:, 1] = cells[:, 0]
    stream = VelocityStream(t, v_b, np.tile(sigma[:, None], 3), lever_b, v.name, v.calibration)
    return stream, ReadReport(str(table.path), len(t), {**table.dropped, **dropped})


def read_attitudes(path: Path, a: schema.Attitudes) -> Raw:
    return read_raw(path, a, a.format, a.time, _attitude_columns(a))


def _attitude_columns(a: schema.Attitudes) -> tuple[str | int, ...]:
    return a.quaternion or a.rpy or (a.heading or 0,)


def attitude_stream(raw: Raw, a: schema.Attitudes, C_ba: Array, place: Place) -> tuple[AttitudeStream, ReadReport]:
    """Attitudes of the body. C_ba (3, 3): from the vehicle's declared axes to the body, of which quaternions tell."""
    table = the_table(raw)
    t = raw.times.since(place.t0)
    cells = table.stack(_attitude_columns(a))
    keep, dropped = ordered(t, cells, str(table.path))
    if a.quaternion is not None:
        wrong = keep & (np.abs(np.linalg.norm(cells, axis=1) - 1) > 0.01)
        if wrong.sum() > 0.5 * keep.sum():
            raise InputError(f"{table.path}: {int(wrong.sum())} of {int(keep.sum())} quaternions are not of unit length")
        if wrong.any():
            dropped["quaternions not of unit length"] = int(wrong.sum())
        keep &= ~wrong
    C_nb = _attitude(cells[keep], a, C_ba, place)
    sigma = np.radians(a.sigma_deg)
    if a.heading is not None or a.tells == "heading":
        sigma[:2] = np.inf
    if a.tells == "tilt":
        sigma[2] = np.inf
    n = int(keep.sum())
    stream = AttitudeStream(t[keep], quat_from_matrix(C_nb), np.tile(sigma, (n, 1)), a.name, a.calibration)
    return stream, ReadReport(str(table.path), n, {**table.dropped, **dropped})


def _attitude(cells: Array, a: schema.Attitudes, C_ba: Array, place: Place) -> Array:
    """C_nb (n, 3, 3) from cells; angles count from the recording's own north."""
    if a.quaternion is not None:
        q = cells[:, [3, 0, 1, 2]] if a.quaternion_order == "xyzw" else cells
        C = matrix_from_quat(q / np.linalg.norm(q, axis=1, keepdims=True))
        return np.asarray(turn(a.frame, place) @ C @ C_ba.T)
    roll, pitch, heading = (cells * RAD[a.unit]).T if a.rpy is not None else (0.0, 0.0, cells[:, 0] * RAD[a.unit])
    return place.C_nl @ matrix_from_euler(pitch, roll, heading + np.radians(a.offset_deg))


def read_magnetometers(path: Path, m: schema.Magnetometers) -> Raw:
    return read_raw(path, m, m.format, m.time, m.field)


def magnetic_stream(raw: Raw, m: schema.Magnetometers, place: Place) -> tuple[MagneticStream, ReadReport]:
    """Fields along the body axes with Earth's field in n. Raises InputError where their sizes tell of different units."""
    table = the_table(raw)
    t = raw.times.since(place.t0)
    m_s = m.scale * table.stack(m.field)
    keep, dropped = ordered(t, m_s, str(table.path))
    thin = thinned(t, keep, m.min_interval_s)
    if (n := int(keep.sum() - thin.sum())) > 0:
        dropped["thinned by min_interval_s"] = n
    m_b = m_s[thin] @ (m.mounting.C @ axes_matrix(m.axes)).T
    earth = place.C_nl @ np.array(m.field_m)
    size, expected = float(np.median(np.linalg.norm(m_b, axis=1))), float(np.linalg.norm(earth))
    if not 0.2 * expected < size < 5 * expected:
        raise InputError(
            f"{table.path}: the field measured is {size:.4g}, field_m says {expected:.4g}: both need the same unit; use scale"
        )
    x, y, z = earth.tolist()
    stream = MagneticStream(t[thin], m_b, np.full(m_b.shape, m.sigma), (x, y, z), m.name, m.calibration)
    return stream, ReadReport(str(table.path), len(m_b), {**table.dropped, **dropped})


def read_vision(path: Path, v: schema.Vision) -> Raw:
    return read_raw(path, v, v.format, v.time, [c for c in (v.azimuth, v.elevation, v.range) if c is not None])


def vision_stream(raw: Raw, v: schema.Vision, observer: Tag, target: Tag, place: Place) -> tuple[VisionStream, ReadReport]:
    """Angles and ranges; a cell may be empty where another of its row is not."""
    table = the_table(raw)
    t = raw.times.since(place.t0)
    z = np.column_stack([np.full(len(t), np.nan) if c is None else table.numbers[c] for c in (v.azimuth, v.elevation, v.range)])
    z[:, :2] *= RAD[v.unit]
    known: BoolArray = np.isfinite(z)
    some = np.where(known.any(axis=1), 0.0, np.nan)
    keep, dropped = ordered(t, some[:, None], str(table.path))
    n, (az, el, r) = int(keep.sum()), z[keep].T
    sigma_rad, sigma_m = np.full(n, np.radians(v.sigma_deg)), np.full(n, v.sigma_m)
    stream = VisionStream(t[keep], observer, target, az, el, r, sigma_rad, sigma_m, v.name, v.calibration)
    return stream, ReadReport(str(table.path), n, {**table.dropped, **dropped})
