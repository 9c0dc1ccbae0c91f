"""Scenario descriptions: a TOML file that says which vehicles move how, carry what, and how well it measures.

    [scenario]     name, summary, t0, origin, duration_s, noise_scale
    [environment]  troposphere, ionosphere, errors of broadcast orbits and clocks
    [[vehicle]]    name, trajectory, imu, gnss, positions, heights, velocities, attitudes, magnetometers, constraints,
                   motion, is_base
    [[range]]      a set of ranges between tags
    [[vision]]     a camera or radar on a vehicle that follows a point of another
    [[link]]       a pair whose GNSS observations are differenced
    [[pair]]       a pair whose relative solution is wanted
    [settings]     the fields of `factorgraph.problem.Settings`

Noise and lever-arm keys are those of `flight.toml`; what is simulated is also what the estimator is told.
"""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

from pydantic import Field, PositiveFloat, ValidationError, model_validator

from factorgraph.errors import InputError
from factorgraph.gpstime import GpsTime
from scenarios.flights.schema import T0, ConstraintsTable, LinkTable, Motion, Origin, Table, _message, dotted, nearest_hint
from scenarios.simulate.fixes import HeightTable, PositionTable
from scenarios.simulate.gnss import EnvironmentTable, GnssTable
from scenarios.simulate.imu import ImuTable
from scenarios.simulate.motion_sensors import AttitudeTable, MagnetometerTable, VelocityTable, VisionTable
from scenarios.simulate.ranging import RangeTable
from scenarios.simulate.streams import Name
from scenarios.simulate.trajectory import Carried, Static, TrajectoryTable

FOLDER = Path(__file__).resolve().parent.parent / "data" / "scenarios"


class ScenarioInfo(Table):
    """Name, time, place and length."""

    name: str
    summary: str = ""
    t0: T0 = GpsTime(2317, 295_200.0)
    origin: Origin
    duration_s: PositiveFloat
    noise_scale: float = Field(default=1.0, ge=0)  # multiplies every random error; 0: exact measurements
    truth_hz: PositiveFloat = 50.0

    @model_validator(mode="after")
    def _points_north(self) -> ScenarioInfo:
        if self.origin.heading_deg != 0:
            raise InputError("origin.heading_deg: simulated flights count east, north, up; leave it out")
        return self


class VehicleTable(Table):
    """A vehicle, or a base station whose antenna position is known."""

    name: Name
    trajectory: TrajectoryTable
    imu: ImuTable | None = None
    gnss: GnssTable | None = None
    positions: tuple[PositionTable, ...] = ()
    heights: tuple[HeightTable, ...] = ()
    velocities: tuple[VelocityTable, ...] = ()
    attitudes: tuple[AttitudeTable, ...] = ()
    magnetometers: tuple[MagnetometerTable, ...] = ()
    constraints: ConstraintsTable = ConstraintsTable()  # told to the estimator
    motion: Motion | None = None
    is_base: bool = False
    heading_hint: bool = False  # the estimator is told the true heading at the start

    def sensors(self) -> list[PositionTable | HeightTable | VelocityTable | AttitudeTable | MagnetometerTable]:
        """The named ones."""
        return [*self.positions, *self.heights, *self.velocities, *self.attitudes, *self.magnetometers]

    @model_validator(mode="after")
    def _base_rests(self) -> VehicleTable:
        if self.is_base and not (isinstance(self.trajectory, Static) and self.imu is None and self.gnss is not None):
            raise InputError(f"vehicle {self.name}: a base has a static trajectory, a receiver and no IMU")
        more = self.imu is not None or self.positions or self.heights or self.motion is not None or self.heading_hint
        if isinstance(self.trajectory, Carried) and (self.gnss is None or more):
            raise InputError(f"vehicle {self.name}: a carried antenna has gnss and nothing else")
        return self


class Scenario(Table):
    """A whole scenario."""

    scenario: ScenarioInfo
    environment: EnvironmentTable = EnvironmentTable()
    vehicle: tuple[VehicleTable, ...] = Field(min_length=1)
    range: tuple[RangeTable, ...] = ()
    vision: tuple[VisionTable, ...] = ()
    link: tuple[LinkTable, ...] = ()
    pair: tuple[LinkTable, ...] = ()
    settings: dict[str, Any] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _distinct(self) -> Scenario:
        names = {"vehicles": [v.name for v in self.vehicle], "range sets": [r.name for r in self.range]}
        names["visions"] = [s.name for s in self.vision]
        names |= {f"sensors of {v.name}": [s.name for s in v.sensors()] for v in self.vehicle}
        for what, given in names.items():
            doubled = sorted({name for name in given if given.count(name) > 1})
            if doubled:
                raise InputError(f"names of {what} must be distinct; repeated: {', '.join(doubled)}")
        return self


def built_in() -> tuple[str, ...]:
    """Names of the scenarios that come with the package."""
    return tuple(sorted(path.stem for path in FOLDER.glob("*.toml")))


def load_scenario(name_or_path: str | Path) -> Scenario:
    """A built-in scenario by name, or one from a TOML file.

    Raises InputError for a name or file that does not exist, and for wrong content, naming the key.
    """
    names = built_in()
    path = FOLDER / f"{name_or_path}.toml" if str(name_or_path) in names else Path(name_or_path)
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        hint = nearest_hint(str(name_or_path), list(names))
        raise InputError(f"no scenario or file {name_or_path}{hint}") from None
    except OSError as error:
        raise InputError(f"{path}: {error.strerror or error}") from error
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: not UTF-8 text (byte {error.start})") from error
    return parse(text, str(path))


def parse(text: str, source: str = "scenario") -> Scenario:
    """A scenario from TOML text. Raises InputError naming `source`, the dotted key and what would help."""
    try:
        return Scenario.model_validate(tomllib.loads(text))
    except tomllib.TOMLDecodeError as error:
        raise InputError(f"{source}: {error}") from error
    except ValidationError as error:
        first = error.errors()[0]
        where = dotted(first["loc"])
        raise InputError(f"{source}: {where + ': ' if where else ''}{_message(first)}") from error
