"""A simulated flight as a flight folder: flight.toml, RINEX 3 and CSV files that `scenarios.flights.load` reads back.

    flight.toml             the description, written last
    NAME.obs, flight.nav    RINEX observations of each receiver and the navigation messages of all
    NAME-imu.csv            t_s, specific force [m/s^2], angular rate [rad/s]; right, front, up
    NAME-truth.csv          t_s, position, velocity, attitude quaternion (scalar first)
    NAME-SENSOR.csv         position fixes, heights, velocities, attitudes, magnetic fields
    SENSOR.csv              ranges: t_s, from_id, to_id, range, sigma; sights: t_s, azimuth, elevation, range [rad, m]

Numbers come back to the last digit, except for observations and orbits, which RINEX rounds.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path

import pyarrow as pa
import pyarrow.csv as pacsv

from factorgraph.measurements import (
    AttitudeStream,
    HeightStream,
    ImuStream,
    MagneticStream,
    PositionStream,
    RangeStream,
    Truth,
    VelocityStream,
)
from factorgraph.problem import Vehicle
from factorgraph.types import Array
from scenarios.flights import schema
from scenarios.flights.rinex_writer import write_navigation, write_observations
from scenarios.simulate.flight import SimulatedFlight
from scenarios.simulate.gnss import told
from scenarios.simulate.motion_sensors import AttitudeTable, MagnetometerTable, VelocityTable
from scenarios.simulate.scenario import VehicleTable

NAVIGATION_FILE = "flight.nav"
ACCEL, GYRO = ("f_right", "f_front", "f_up"), ("w_right", "w_front", "w_up")
POSITION, VELOCITY = ("r_east", "r_north", "r_up"), ("v_east", "v_north", "v_up")
QUATERNION = ("q_w", "q_x", "q_y", "q_z")
VELOCITY_B, FIELD = ("v_right", "v_front", "v_up"), ("m_right", "m_front", "m_up")
SIGMA = ("sigma_east", "sigma_north", "sigma_up")
Columns = Mapping[str, Array | list[str]]

TIME = schema.TimeColumn(column="t_s")


def write_flight(flight: SimulatedFlight, folder: Path) -> Path:
    """Write the folder, made where it does not exist; returns the path of its flight.toml. Raises OSError."""
    folder.mkdir(parents=True, exist_ok=True)
    vehicles = tuple(_vehicle(flight, table, folder) for table in flight.scenario.vehicle)
    if any(v.gnss for v in vehicles):
        write_navigation(folder / NAVIGATION_FILE, flight.navigation)
    ranges = tuple(_ranges(flight, k, folder) for k in range(len(flight.problem.ranges)))
    info = flight.scenario.scenario
    description = schema.Flight(
        flight=schema.FlightInfo(name=info.name, summary=info.summary, t0=info.t0, origin=info.origin),
        vehicle=vehicles,
        range=ranges,
        vision=tuple(_vision(flight, k, folder) for k in range(len(flight.problem.visions))),
        link=flight.scenario.link,
        pair=flight.scenario.pair,
        settings=flight.scenario.settings,
    )
    path = folder / schema.FILE_NAME
    path.write_text(schema.dump(description), encoding="utf-8")
    return path


def _vehicle(flight: SimulatedFlight, table: VehicleTable, folder: Path) -> schema.VehicleTable:
    v = flight.problem.vehicle(table.name)
    return schema.VehicleTable(
        name=v.name,
        imu=_imu(v.name, v.imu, folder) if v.imu else None,
        imu_noise=table.imu.told if table.imu else schema.ImuNoiseTable(),
        gnss=_gnss(flight, v, table, folder),
        positions=tuple(_positions(v.name, p, folder) for p in v.positions),
        heights=tuple(_heights(v.name, h, folder) for h in v.heights),
        velocities=tuple(_velocities(v.name, s, t, folder) for s, t in zip(v.velocities, table.velocities, strict=True)),
        attitudes=tuple(_attitudes(v.name, s, t, folder) for s, t in zip(v.attitudes, table.attitudes, strict=True)),
        magnetometers=tuple(_magnetics(v.name, s, t, folder) for s, t in zip(v.magnetics, table.magnetometers, strict=True)),
        constraints=table.constraints,
        motion=table.motion,
        fixed=schema.Fixed(local_m=v.fixed_n) if v.fixed_n else None,
        truth=_truth(v.name, v.truth, folder) if v.truth else None,
        heading_hint_deg=_degrees(v.heading_hint_rad),
        carrier=v.carrier,
    )


def _degrees(angle_rad: float | None) -> float | None:
    return None if angle_rad is None else math.degrees(angle_rad)


def _named(names: tuple[str, ...], columns: Array) -> dict[str, Array]:
    return dict(zip(names, columns.T, strict=True))


def _columns(path: Path, columns: Columns) -> str:
    """Write named columns; returns the file's name."""
    has_text = any(isinstance(column, list) for column in columns.values())
    pacsv.write_csv(pa.table(dict(columns)), path, pacsv.WriteOptions(quoting_style="needed" if has_text else "none"))
    return path.name


def _imu(name: str, stream: ImuStream, folder: Path) -> schema.Imu:
    columns = {"t_s": stream.t_s, **_named(ACCEL, stream.f_b), **_named(GYRO, stream.w_b)}
    file = _columns(folder / f"{name}-imu.csv", columns)
    return schema.Imu(file=file, time=TIME, accel=ACCEL, gyro=GYRO, is_mean=stream.is_mean)


def _gnss(flight: SimulatedFlight, v: Vehicle, table: VehicleTable, folder: Path) -> schema.Gnss | None:
    if v.gnss is None or table.gnss is None:
        return None
    file = f"{v.name}.obs"
    channels = flight.navigation.glonass_channels
    write_observations(folder / file, v.gnss.stream, flight.problem.t0, marker=v.name, channels=channels)
    noise = table.gnss.noise.model_copy(update={"code_m": told(table.gnss).code_m})
    return schema.Gnss(obs=file, nav=(NAVIGATION_FILE,), lever_b=v.gnss.lever_b, noise=noise)


def _positions(name: str, stream: PositionStream, folder: Path) -> schema.Positions:
    columns = {"t_s": stream.t_s, **_named(POSITION, stream.r_n), **_named(SIGMA, stream.sigma_m)}
    if stream.v_n is not None and stream.sigma_mps is not None:
        columns |= _named(VELOCITY, stream.v_n)
        sigma_v = tuple(stream.sigma_mps[0].tolist())
    file = _columns(folder / f"{name}-{stream.name}.csv", columns)
    return schema.Positions(
        file=file,
        name=stream.name,
        time=TIME,
        position=POSITION,
        sigma=SIGMA,
        velocity=VELOCITY if stream.v_n is not None else None,
        velocity_sigma_mps=sigma_v if stream.v_n is not None else None,
        lever_b=stream.lever_b,
    )


def _heights(name: str, stream: HeightStream, folder: Path) -> schema.Heights:
    file = _columns(folder / f"{name}-{stream.name}.csv", {"t_s": stream.t_s, "up": stream.up_m})
    return schema.Heights(
        file=file,
        name=stream.name,
        time=TIME,
        height="up",
        sigma_m=float(stream.sigma_m[0]),
        lever_b=stream.lever_b,
        bias_sigma_m=stream.calibration.bias,
        bias_walk_m_rts=stream.calibration.bias_walk,
    )


def _velocities(name: str, stream: VelocityStream, table: VelocityTable, folder: Path) -> schema.Velocities:
    forward = table.axes == "forward"
    columns = {"t_s": stream.t_s, **({"v_front": stream.v_b[:, 1]} if forward else _named(VELOCITY_B, stream.v_b))}
    return schema.Velocities(
        file=_columns(folder / f"{name}-{stream.name}.csv", columns),
        name=stream.name,
        time=TIME,
        forward="v_front" if forward else None,
        velocity=None if forward else VELOCITY_B,
        sigma_mps=table.sigma_mps,
        lever_b=stream.lever_b,
        scale_sigma=table.scale_sigma,
        mounting_sigma_deg=table.mounting_sigma_deg,
    )


def _attitudes(name: str, stream: AttitudeStream, table: AttitudeTable, folder: Path) -> schema.Attitudes:
    return schema.Attitudes(
        file=_columns(folder / f"{name}-{stream.name}.csv", {"t_s": stream.t_s, **_named(QUATERNION, stream.q_nb)}),
        name=stream.name,
        time=TIME,
        quaternion=QUATERNION,
        sigma_deg=table.told_deg,
        tells=table.tells,
        mounting_sigma_deg=table.mounting_sigma_deg,
    )


def _magnetics(name: str, stream: MagneticStream, table: MagnetometerTable, folder: Path) -> schema.Magnetometers:
    return schema.Magnetometers(
        file=_columns(folder / f"{name}-{stream.name}.csv", {"t_s": stream.t_s, **_named(FIELD, stream.m_b)}),
        name=stream.name,
        time=TIME,
        field=FIELD,
        field_m=stream.field_n,
        sigma=table.sigma,
        bias_sigma=table.bias_sigma,
        mounting_sigma_deg=table.mounting_sigma_deg,
    )


def _vision(flight: SimulatedFlight, index: int, folder: Path) -> schema.Vision:
    table, stream = flight.scenario.vision[index], flight.problem.visions[index]
    angles = {"azimuth": stream.azimuth_rad, "elevation": stream.elevation_rad} if table.angles else {}
    columns = {"t_s": stream.t_s, **angles, **({"range": stream.range_m} if table.ranges else {})}
    return schema.Vision(
        name=table.name,
        file=_columns(folder / f"{table.name}.csv", columns),
        time=TIME,
        observer=table.observer,
        target=table.target,
        azimuth="azimuth" if table.angles else None,
        elevation="elevation" if table.angles else None,
        range="range" if table.ranges else None,
        unit="rad",
        sigma_deg=table.sigma_deg,
        sigma_m=table.sigma_m,
        mounting_sigma_deg=table.mounting_sigma_deg,
    )


def _truth(name: str, truth: Truth, folder: Path) -> schema.TruthTable:
    assert truth.v_n is not None and truth.q_nb is not None
    columns = {"t_s": truth.t_s, **_named(POSITION, truth.r_n), **_named(VELOCITY, truth.v_n)}
    file = _columns(folder / f"{name}-truth.csv", {**columns, **_named(QUATERNION, truth.q_nb)})
    return schema.TruthTable(file=file, time=TIME, position=POSITION, velocity=VELOCITY, quaternion=QUATERNION)


def _ranges(flight: SimulatedFlight, index: int, folder: Path) -> schema.Ranges:
    table, stream = flight.scenario.range[index], flight.problem.ranges[index].stream
    columns: Columns = {"t_s": stream.t_s, **_tag_columns(stream), "range": stream.range_m, "sigma": stream.sigma_m}
    return schema.Ranges(
        name=table.name,
        files=(_columns(folder / f"{table.name}.csv", columns),),
        time=TIME,
        sigma="sigma",
        tags=table.tags,
        bias_sigma_m=table.bias_sigma_m,
        scale_sigma=table.scale_sigma,
        per_pair=table.per_pair,
    )


def _tag_columns(stream: RangeStream) -> dict[str, list[str]]:
    names = [tag.name for tag in stream.tags]
    return {"from_id": [names[k] for k in stream.tag_a], "to_id": [names[k] for k in stream.tag_b]}
