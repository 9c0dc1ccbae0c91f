"""From a scenario and a seed to a navigation problem with truth, and a record of every error put in."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from factorgraph.measurements import ImuStream
from factorgraph.models import magnetic_field
from factorgraph.problem import ImuNoise, Link, MotionPrior, NavigationProblem, Vehicle
from factorgraph.types import Array
from scenarios.flights.navigation import Navigation, builtin_constellation
from scenarios.flights.schema import Flight
from scenarios.simulate import fixes, gnss, imu, motion_sensors, ranging, trajectory
from scenarios.simulate.gnss import GnssRecord, Sky
from scenarios.simulate.imu import ImuRecord
from scenarios.simulate.motion_sensors import SensorRecord
from scenarios.simulate.ranging import RangeRecord
from scenarios.simulate.scenario import Scenario, VehicleTable
from scenarios.simulate.streams import Streams
from scenarios.simulate.trajectory import Carried, Trajectory


@dataclass(frozen=True, slots=True)
class Record:
    """What a simulation knows and an estimator does not; keys are vehicle names."""

    trajectories: dict[str, Trajectory]
    imu: dict[str, ImuRecord]
    gnss: dict[str, GnssRecord]
    ranges: tuple[RangeRecord, ...]  # in the order of the problem's ranges
    sensors: dict[str, SensorRecord]  # "car/odometer"; of visions by their name


@dataclass(frozen=True, slots=True)
class SimulatedFlight:
    """A navigation problem, where it came from, and the truth behind it."""

    problem: NavigationProblem
    record: Record
    scenario: Scenario
    seed: int
    navigation: Navigation  # broadcast messages of the flight


@dataclass(frozen=True, slots=True)
class Exact:
    """Motion and inertial measurements without errors, by vehicle; no seed changes them unless a vehicle sways."""

    trajectories: dict[str, Trajectory]
    imu: dict[str, ImuStream]


def exact(scenario: Scenario, seed: int) -> Exact:
    """The errorless part of a simulation. Raises InputError as `simulate` does."""
    info, streams = scenario.scenario, Streams(seed)
    tables = {v.name: v.trajectory for v in scenario.vehicle}
    rngs = {name: (streams / name)("motion") for name in tables}
    paths = trajectory.build(tables, info.duration_s, rngs, info.origin.frame)
    sensed = {v.name: v.imu for v in scenario.vehicle if v.imu is not None}
    return Exact(paths, {n: imu.exact(table, paths[n], info.origin.frame, info.duration_s) for n, table in sensed.items()})


def simulate(scenario: Scenario, seed: int, known: Exact | None = None) -> SimulatedFlight:
    """Simulate a scenario; the same seed gives the same numbers.

    known: what `exact` gave for the same vehicles, to save time over many seeds. Raises InputError where parts of the
    scenario contradict each other.
    """
    info = scenario.scenario
    streams = Streams(seed)
    known = known or exact(scenario, seed)
    sky = _sky(scenario, streams)
    record = Record(known.trajectories, {}, {}, (), {})
    vehicles = tuple(_vehicle(v, scenario, sky, streams / v.name, known, record) for v in scenario.vehicle)
    ranges = [
        ranging.simulate(table, known.trajectories, info.duration_s, streams / f"range {table.name}", info.noise_scale)
        for table in scenario.range
    ]
    visions = []
    for sight in scenario.vision:
        stream, record.sensors[sight.name] = motion_sensors.vision(
            sight, known.trajectories, info.duration_s, streams / f"vision {sight.name}", info.noise_scale
        )
        visions.append(stream)
    problem = NavigationProblem(
        name=info.name,
        t0=info.t0,
        frame=sky.frame,
        vehicles=vehicles,
        links=tuple(Link(k.reference, k.rover) for k in scenario.link),
        ranges=tuple(model for model, _ in ranges),
        visions=tuple(visions),
        pairs=tuple(Link(k.reference, k.rover) for k in scenario.pair),
        settings=Flight.model_construct(settings=scenario.settings).problem_settings,
    )
    return SimulatedFlight(problem, replace(record, ranges=tuple(r for _, r in ranges)), scenario, seed, sky.navigation)


def _sky(scenario: Scenario, streams: Streams) -> Sky:
    info, environment = scenario.scenario, scenario.environment
    navigation = builtin_constellation().shifted_to(info.t0 + -environment.sky_s, environment.sky_s + info.duration_s)
    if environment.ionosphere == 0:
        navigation = replace(navigation, klobuchar=None)
    return Sky(navigation, info.origin.frame, info.t0, info.duration_s, environment, streams / "satellites")


def _vehicle(table: VehicleTable, scenario: Scenario, sky: Sky, streams: Streams, known: Exact, record: Record) -> Vehicle:
    """The vehicle with its measurements; fills `record`."""
    info, path = scenario.scenario, record.trajectories[table.name]
    duration, scale = info.duration_s, info.noise_scale
    imu_stream, antenna = None, None
    if table.imu is not None:
        imu_stream, record.imu[table.name] = imu.simulate(table.imu, known.imu[table.name], streams / "imu", scale)
    if table.gnss is not None:
        antenna, record.gnss[table.name] = gnss.simulate(table.gnss, sky, path, streams / "gnss", scale)

    def field() -> Array:
        return magnetic_field.field_n(info.origin.frame, info.t0)

    moving = (
        [motion_sensors.velocities(s, path, duration, streams / s.name, scale) for s in table.velocities],
        [motion_sensors.attitudes(s, path, duration, streams / s.name, scale) for s in table.attitudes],
        [motion_sensors.magnetics(s, path, duration, streams / s.name, scale, field) for s in table.magnetometers],
    )
    record.sensors.update({f"{table.name}/{s.name}": errors for sensors in moving for s, errors in sensors})
    if isinstance(table.trajectory, Carried):
        return Vehicle(table.name, gnss=antenna, carrier=table.trajectory.carrier)
    return Vehicle(
        name=table.name,
        imu=imu_stream,
        imu_noise=table.imu.told.noise if table.imu else ImuNoise(),
        gnss=antenna,
        positions=tuple(fixes.positions(p, path, duration, streams / p.name, scale) for p in table.positions),
        heights=tuple(fixes.heights(h, path, duration, streams / h.name, scale) for h in table.heights),
        velocities=tuple(s for s, _ in moving[0]),
        attitudes=tuple(s for s, _ in moving[1]),
        magnetics=tuple(s for s, _ in moving[2]),
        constraints=table.constraints.constraints(table.constraints.axle_b),
        motion=table.motion.prior if table.motion else MotionPrior(),
        fixed_n=_fixed(table, path),
        truth=trajectory.truth(path, fixes.epochs(info.truth_hz, 0.0, duration)),
        heading_hint_rad=float(path.euler(np.zeros(1))[0, 2]) if table.heading_hint else None,
    )


def _fixed(table: VehicleTable, path: Trajectory) -> tuple[float, float, float] | None:
    """The antenna's position of a base."""
    if not table.is_base or table.gnss is None:
        return None
    x, y, z = path.at(np.zeros(1)).point(table.gnss.lever_b)[0][0]
    return float(x), float(y), float(z)
