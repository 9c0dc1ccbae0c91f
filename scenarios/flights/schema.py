"""`flight.toml`: what a flight folder declares, checked key by key.

    [flight]     name, t0, origin, where the files are, part of the recording to use
    [[vehicle]]  name, body axes, imu, imu_noise, imu_calibration, gnss, positions, heights, velocities, attitudes,
                 magnetometers, constraints, motion, fixed, truth
    [[range]]    a set of ranges between tags
    [[vision]]   directions and ranges from a camera or radar on a vehicle
    [[link]]     a pair whose GNSS observations are differenced
    [[pair]]     a pair whose relative solution is wanted
    [settings]   the fields of `factorgraph.problem.Settings`

Units are in the key names or declared beside the columns; axes are declared, never guessed. Columns are given by
name or by number from 0. Unknown keys are errors that name the nearest known one.
"""

from __future__ import annotations

import dataclasses
import difflib
import json
import math
import tomllib
from collections.abc import Iterator, Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any, Literal, get_type_hints

import numpy as np
from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    PlainSerializer,
    PlainValidator,
    PositiveFloat,
    TypeAdapter,
    ValidationError,
    model_validator,
)
from pydantic_core import PydanticCustomError

from factorgraph.attitude import matrix_from_euler
from factorgraph.errors import InputError
from factorgraph.geodesy import LocalFrame, ecef_from_geodetic
from factorgraph.gpstime import GpsTime
from factorgraph.measurements import Calibration
from factorgraph.problem import (
    HEADING_SIGMA_RAD,
    Constraints,
    Elevation,
    GnssNoise,
    ImuCalibration,
    ImuNoise,
    MotionPrior,
    Settings,
    Vec3,
)
from factorgraph.types import Array

FILE_NAME = "flight.toml"
STANDARD_GRAVITY = 9.80665  # m/s^2 per g

SYSTEMS = "GREJC"  # constellations an estimator may use

AxisFrame = Literal["local", "ned", "ecef", "llh"]  # local: the flight's x, y, z-up; llh: degrees, degrees, metres
Epoch = Literal["flight", "sow", "gps", "unix", "unix-gpst", "iso-gpst", "iso-utc"]


def _column(value: object) -> str | int:
    if isinstance(value, bool) or not isinstance(value, str | int) or (isinstance(value, int) and value < 0):
        raise PydanticCustomError("column", "a column is a name or a number from 0, got {value}", {"value": repr(value)})
    return value


Column = Annotated[str | int, PlainValidator(_column)]
Columns3 = tuple[Column, Column, Column]


def _two_or_three(columns: tuple[str | int, ...]) -> tuple[str | int, ...]:
    if len(columns) not in (2, 3):
        raise InputError(f"name two or three columns, got {len(columns)}")
    return columns


def axes_matrix(axes: str) -> Array:
    """Rotation (3, 3) from axes named by three letters of R/L, F/B, U/D (one of each) to right-front-up.

    Raises InputError for other letters, a direction named twice, or a left-handed set.
    """
    unit = {"R": (1, 0, 0), "L": (-1, 0, 0), "F": (0, 1, 0), "B": (0, -1, 0), "U": (0, 0, 1), "D": (0, 0, -1)}
    if len(axes) != 3 or any(letter not in unit for letter in axes):
        raise InputError(f'axes "{axes}": write three of R L F B U D, for instance "RFU", "FRD" or "FLU"')
    C = np.column_stack([unit[letter] for letter in axes]).astype(float)
    if np.linalg.det(C) < 0.5:
        kind = "name one direction twice" if abs(np.linalg.det(C)) < 0.5 else "are left-handed"
        raise InputError(f'axes "{axes}" {kind}; usual sets are "RFU", "FRD" and "FLU"')
    return C


def _check_axes(axes: str) -> str:
    axes_matrix(axes)
    return axes


Axes = Annotated[str, AfterValidator(_check_axes)]


def _read_t0(value: object) -> GpsTime:
    if isinstance(value, GpsTime):
        return value
    if isinstance(value, Mapping) and set(value) == {"week", "sow"}:
        return GpsTime(int(value["week"]), float(value["sow"]))
    if isinstance(value, str):
        try:
            value = datetime.fromisoformat(value)
        except ValueError:
            pass
    if isinstance(value, datetime):
        if value.tzinfo is not None:
            raise PydanticCustomError("t0", "t0 is GPST: write it without a time zone", {})
        delta = value.replace(tzinfo=UTC)
        second = delta.second + delta.microsecond * 1e-6
        return GpsTime.from_calendar(delta.year, delta.month, delta.day, delta.hour, delta.minute, second)
    raise PydanticCustomError("t0", 'write t0 as "2021-09-22T06:30:00" (GPST) or as week and sow', {})


def _write_t0(t0: GpsTime) -> dict[str, float]:
    return {"week": t0.week, "sow": t0.sow}


T0 = Annotated[GpsTime, PlainValidator(_read_t0), PlainSerializer(_write_t0)]


class Table(BaseModel):
    """A table of `flight.toml`: frozen, finite numbers, unknown keys refused with the nearest known one."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    @model_validator(mode="before")
    @classmethod
    def _known_keys(cls, values: Any) -> Any:
        if isinstance(values, Mapping):
            known = {field.alias or name for name, field in cls.model_fields.items()}
            for key in values:
                if key not in known:
                    hint = nearest_hint(key, sorted(known))
                    raise PydanticCustomError("key", "unknown key {key}{hint}", {"key": str(key), "hint": hint})
        return values


def nearest_hint(name: str, known: list[str]) -> str:
    """ "; did you mean …?" with the nearest known name, else what there is."""
    near = difflib.get_close_matches(name, known, n=1, cutoff=0.5)
    return f"; did you mean {near[0]}?" if near else f"; there are {', '.join(known)}"


def _time_shorthand(value: object) -> object:
    return {"column": value} if isinstance(value, str | int) else value


class TimeColumn(Table):
    """Where times are and what they count: t = scale * unit * cell + offset_s, from the epoch."""

    column: Column = 0
    unit: Literal["s", "ms", "us", "ns"] = "s"
    scale: float = 1.0
    offset_s: float = 0.0
    epoch: Epoch = "flight"
    tag: str = ""  # RTKLIB time tag file beside a text file whose column is a counter; `epoch` is not used then


Time = Annotated[TimeColumn, BeforeValidator(_time_shorthand)]


class Origin(Table):
    """Origin of the local frame; `heading_deg` turns the recording's y axis clockwise from north."""

    lat_deg: float = Field(ge=-90, le=90)
    lon_deg: float = Field(ge=-360, le=360)
    h_m: float = 0.0
    heading_deg: float = 0.0

    @property
    def frame(self) -> LocalFrame:
        return LocalFrame(math.radians(self.lat_deg), math.radians(self.lon_deg), self.h_m)

    @property
    def C_nl(self) -> Array:
        """Rotation (3, 3) from the recording's local axes to east-north-up."""
        return matrix_from_euler(0.0, 0.0, math.radians(self.heading_deg))


class FlightInfo(Table):
    """Name, time, place and files of the flight."""

    name: str = ""
    summary: str = ""
    t0: T0 | None = None  # default: first GNSS epoch, else the smallest time
    origin: Origin | None = None  # default: the base, else the first receiver's approximate position
    data: str = ""  # folder of the files, relative to flight.toml or to the package
    package: str = ""  # installed package that brings the files
    start_s: float = -math.inf
    end_s: float = math.inf

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=True)


class TextOptions(Table):
    """How columns are read from delimited text, or from a variable of a MATLAB file."""

    delimiter: str = ","  # one character, or "whitespace": any run of blanks
    header: bool = True
    skip_rows: int = Field(default=0, ge=0)  # lines before the header or the first row
    comment: str = ""  # lines that start with it are left out
    only: str = ""  # where given, lines that start with it are read and all others left out
    variable: str = ""  # of the MATLAB file


class Mounting(Table):
    """Rotation from the sensor's axes (as named by `axes`) to the body: Euler angles or a matrix to right-front-up."""

    rpy_deg: Vec3 | None = None  # roll, pitch, yaw, applied in the order yaw, pitch, roll
    matrix: tuple[Vec3, Vec3, Vec3] | None = None

    @model_validator(mode="after")
    def _is_rotation(self) -> Mounting:
        if self.matrix is not None:
            C = np.array(self.matrix)
            if self.rpy_deg is not None or np.abs(C @ C.T - np.eye(3)).max() > 1e-3 or np.linalg.det(C) < 0:
                raise InputError("mounting: give either rpy_deg or a right-handed rotation matrix")
        return self

    @property
    def C(self) -> Array:
        """The rotation (3, 3)."""
        if self.matrix is not None:
            U, _, Vt = np.linalg.svd(np.array(self.matrix))
            return np.asarray(U @ Vt)
        roll, pitch, yaw = np.radians(self.rpy_deg or (0.0, 0.0, 0.0))
        return matrix_from_euler(pitch, roll, yaw)


class Imu(TextOptions):
    """Specific force and angular rate."""

    file: str
    format: Literal["csv", "mat"] = "csv"
    time: Time = TimeColumn()
    accel: Columns3 | Literal["level"] = (1, 2, 3)  # "level": none; gravity along the body's up axis stands in
    gyro: Columns3 | Column = (4, 5, 6)  # one column: the rate about the up axis, to the left
    gyro_increments: bool = False  # cells are angles turned since the row before, in rad or deg
    accel_unit: Literal["m/s2", "g"] = "m/s2"
    gyro_unit: Literal["rad/s", "deg/s"] = "rad/s"
    axes: Axes = "RFU"
    mounting: Mounting = Mounting()
    is_mean: bool = False  # samples are means over the past interval
    lever_b: Vec3 = (0.0, 0.0, 0.0)  # from the origin of the other lever arms

    @property
    def C_bs(self) -> Array:
        """Rotation (3, 3) from the columns' axes to right-front-up."""
        return self.mounting.C @ axes_matrix(self.axes)

    @property
    def columns(self) -> tuple[Column, ...]:
        """The columns of the accelerometers, where there are, and of the gyroscopes."""
        return (*(() if self.accel == "level" else self.accel), *self.gyro_columns)

    @property
    def gyro_columns(self) -> tuple[Column, ...]:
        """One or three."""
        return self.gyro if isinstance(self.gyro, tuple) else (self.gyro,)

    @model_validator(mode="after")
    def _tag_of_text(self) -> Imu:
        if self.time.tag and self.format != "csv":
            raise InputError("imu: time.tag belongs to a text file")
        return self


_DEG, _HOUR = math.pi / 180, 3600.0
# key of the file -> field of ImuNoise, factor to SI (spec common.md, section 4)
IMU_NOISE_UNITS: dict[str, tuple[str, float]] = {
    "gyro_rps_rthz": ("gyro_rps_rthz", 1.0),
    "gyro_dps_rthz": ("gyro_rps_rthz", _DEG),
    "gyro_deg_h_rthz": ("gyro_rps_rthz", _DEG / _HOUR),
    "gyro_deg_rth": ("gyro_rps_rthz", _DEG / 60),
    "accel_mps2_rthz": ("accel_mps2_rthz", 1.0),
    "accel_mg_rthz": ("accel_mps2_rthz", 1e-3 * STANDARD_GRAVITY),
    "accel_ug_rthz": ("accel_mps2_rthz", 1e-6 * STANDARD_GRAVITY),
    "accel_mps_rth": ("accel_mps2_rthz", 1 / 60),
    "gyro_bias_rps": ("gyro_bias_rps", 1.0),
    "gyro_bias_dps": ("gyro_bias_rps", _DEG),
    "gyro_bias_deg_h": ("gyro_bias_rps", _DEG / _HOUR),
    "accel_bias_mps2": ("accel_bias_mps2", 1.0),
    "accel_bias_mg": ("accel_bias_mps2", 1e-3 * STANDARD_GRAVITY),
    "accel_bias_ug": ("accel_bias_mps2", 1e-6 * STANDARD_GRAVITY),
    "gyro_bias_walk_rps_rts": ("gyro_bias_walk_rps_rts", 1.0),
    "gyro_bias_walk_dps_rts": ("gyro_bias_walk_rps_rts", _DEG),
    "gyro_bias_walk_deg_h_rts": ("gyro_bias_walk_rps_rts", _DEG / _HOUR),
    "accel_bias_walk_mps2_rts": ("accel_bias_walk_mps2_rts", 1.0),
    "accel_bias_walk_mg_rts": ("accel_bias_walk_mps2_rts", 1e-3 * STANDARD_GRAVITY),
    "accel_bias_walk_ug_rts": ("accel_bias_walk_mps2_rts", 1e-6 * STANDARD_GRAVITY),
}


class ImuNoiseTable(Table):
    """Noise of the IMU: SI or the units of data sheets, one key per quantity."""

    gyro_rps_rthz: PositiveFloat | None = None
    gyro_dps_rthz: PositiveFloat | None = None
    gyro_deg_h_rthz: PositiveFloat | None = None
    gyro_deg_rth: PositiveFloat | None = None
    accel_mps2_rthz: PositiveFloat | None = None
    accel_mg_rthz: PositiveFloat | None = None
    accel_ug_rthz: PositiveFloat | None = None
    accel_mps_rth: PositiveFloat | None = None
    gyro_bias_rps: PositiveFloat | None = None
    gyro_bias_dps: PositiveFloat | None = None
    gyro_bias_deg_h: PositiveFloat | None = None
    accel_bias_mps2: PositiveFloat | None = None
    accel_bias_mg: PositiveFloat | None = None
    accel_bias_ug: PositiveFloat | None = None
    gyro_bias_walk_rps_rts: PositiveFloat | None = None
    gyro_bias_walk_dps_rts: PositiveFloat | None = None
    gyro_bias_walk_deg_h_rts: PositiveFloat | None = None
    accel_bias_walk_mps2_rts: PositiveFloat | None = None
    accel_bias_walk_mg_rts: PositiveFloat | None = None
    accel_bias_walk_ug_rts: PositiveFloat | None = None

    @model_validator(mode="after")
    def _once(self) -> ImuNoiseTable:
        given: dict[str, str] = {}
        for key, (name, _) in IMU_NOISE_UNITS.items():
            if getattr(self, key) is not None and given.setdefault(name, key) != key:
                raise InputError(f"{given[name]} and {key} state the same quantity; keep one")
        return self

    @property
    def noise(self) -> ImuNoise:
        """In SI units; what is not given keeps its default."""
        values = {n: getattr(self, k) * factor for k, (n, factor) in IMU_NOISE_UNITS.items() if getattr(self, k) is not None}
        return ImuNoise(**values)


class GnssNoiseTable(Table):
    """Zenith standard deviations of a receiver; see `factorgraph.problem.GnssNoise`."""

    code_m: PositiveFloat | None = None
    phase_m: PositiveFloat | None = None
    doppler_mps: PositiveFloat | None = None
    absolute_code_m: PositiveFloat | None = None
    absolute_correlation_s: PositiveFloat | None = None
    elevation_mask_deg: float | None = Field(default=None, ge=0, lt=90)
    min_cn0_dbhz: float | None = None
    elevation: Elevation | None = None

    @property
    def noise(self) -> GnssNoise:
        """In SI units; what is not given keeps its default."""
        values = {k: v for k, v in self.model_dump(exclude_none=True).items() if k != "elevation_mask_deg"}
        if self.elevation_mask_deg is not None:
            values["elevation_mask_rad"] = math.radians(self.elevation_mask_deg)
        return GnssNoise(**values)


def _as_list(value: object) -> object:
    return [value] if isinstance(value, str) else value


Files = Annotated[tuple[str, ...], BeforeValidator(_as_list)]
NonNegative = Annotated[float, Field(ge=0)]


def _check_satellites(names: dict[str, str]) -> dict[str, str]:
    for cell, name in names.items():
        if len(name) != 3 or name[0] not in SYSTEMS or not name[1:].isdigit():
            raise InputError(f'names: "{cell}" is named "{name}"; write a RINEX name such as "G05" or "J02"')
    return names


def _check_systems(systems: dict[str, str]) -> dict[str, str]:
    for cell, letter in systems.items():
        if len(letter) != 1 or letter not in SYSTEMS:
            raise InputError(f'systems: "{cell}" is "{letter}"; write one letter of {SYSTEMS}')
    return systems


class SatelliteTable(TextOptions):
    """Columns of a table with a row per epoch and satellite, and what was done to them; see `satellite_table`."""

    kind: Literal["csv", "mat"] = "csv"
    time: Time = TimeColumn()
    satellite: Column = "satellite"  # a RINEX name or a number
    system: Column | None = None
    default_system: Literal["G", "R", "E", "J", "C"] = "G"  # of numbers without a system column
    systems: Annotated[dict[str, str], AfterValidator(_check_systems)] = {}  # cell of the system column -> letter
    number_offset: dict[Literal["G", "R", "E", "J", "C"], int] = {}  # taken off a system's numbers
    names: Annotated[dict[str, str], AfterValidator(_check_satellites)] = {}  # satellite cell -> RINEX name
    signal: str = Field(default="1C", pattern="^[0-9][A-Z]$")
    code: Column
    range_rate: Column | None = None  # positive receding [m/s]
    cn0: Column | None = None
    position: Columns3  # ECEF
    velocity: Columns3 | None = None
    clock: Column | None = None  # satellite's, times the speed of light; default: taken off the pseudoranges
    clock_rate: Column | None = None
    turned: Literal["no", "range", "pseudorange"] = "no"  # by the Earth's rotation during the travel time, from ...
    velocity_turned: bool = False
    troposphere_removed: bool = False
    group_delay_removed: bool = True  # false: the delays of gnss.nav are taken off
    true_time: bool = False  # the receiver's clock is off the times, but in the pseudoranges


class Gnss(Table):
    """A receiver: its observations and, for RINEX and UBX, the navigation messages to use with them."""

    obs: str
    format: Literal["rinex", "ubx", "satellite-table"] = "rinex"
    table: SatelliteTable | None = None
    nav: Files = ()  # default: the navigation files of the other receivers, else the messages in UBX logs
    lever_b: Vec3 = (0.0, 0.0, 0.0)
    lever_sigma_m: NonNegative = 0.0
    time_sigma_s: NonNegative = 0.0
    noise: GnssNoiseTable = GnssNoiseTable()

    @model_validator(mode="after")
    def _table_with_its_format(self) -> Gnss:
        if (self.format == "satellite-table") != (self.table is not None):
            raise InputError('gnss: format = "satellite-table" and the columns in gnss.table belong together')
        return self

    @property
    def calibration(self) -> Calibration:
        return Calibration(lever_m=self.lever_sigma_m, time_s=self.time_sigma_s)


class Positions(TextOptions):
    """Position fixes of an antenna."""

    file: str
    format: Literal["csv", "mat", "rtklib-pos", "nmea", "ubx"] = "csv"
    name: str = "position"
    time: Time = TimeColumn()
    position: Columns3 = (1, 2, 3)
    frame: AxisFrame = "local"
    sigma: Columns3 | None = None  # columns, per axis of east-north-up
    sigma_m: Vec3 | None = None  # default: the file's own, else 3, 3, 6 m
    sigma_scale: PositiveFloat = 1.0  # of positions and velocities: receivers may be too confident
    velocity: Columns3 | None = None  # columns, in the axes of `frame` (llh: east, north, up); RTKLIB files have their own
    velocity_sigma_mps: Vec3 | None = None  # per axis of east-north-up; default: the file's own, else 0.1, 0.1, 0.2 m/s
    velocity_offset_s: float = 0.0  # from the time of the position to the one at which its velocity holds
    use_velocity: bool = True  # where there is one
    quality: Column | None = None  # column of the kind of fix; RTKLIB files and UBX have their own
    qualities: tuple[int, ...] = ()  # kinds of fix used; default: all
    date: str = ""  # of an NMEA file without dates: "2021-09-22" (UTC)
    lever_b: Vec3 = (0.0, 0.0, 0.0)
    lever_sigma_m: NonNegative = 0.0  # what is estimated beside the states: prior standard deviations
    time_sigma_s: NonNegative = 0.0

    @property
    def calibration(self) -> Calibration:
        return Calibration(lever_m=self.lever_sigma_m, time_s=self.time_sigma_s)


class Heights(TextOptions):
    """Up coordinate: up = scale * cell + offset_m, or a constant without a file."""

    file: str = ""
    format: Literal["csv", "mat"] = "csv"
    name: str = "height"
    time: Time = TimeColumn()
    height: Column = 1
    scale: float = 1.0
    offset_m: float = 0.0
    ellipsoidal: bool = False  # heights above the ellipsoid rather than above the local origin
    constant_m: float | None = None
    interval_s: PositiveFloat = 1.0  # of the constant; files are thinned by `min_interval_s`
    min_interval_s: float = Field(default=0.0, ge=0)
    valid_min: float = -math.inf  # cells outside are dropped: a range finder has limits
    valid_max: float = math.inf
    sigma_m: PositiveFloat = 1.0
    lever_b: Vec3 = (0.0, 0.0, 0.0)
    bias_sigma_m: NonNegative = 0.0  # a barometer has a bias that walks
    bias_walk_m_rts: NonNegative = 0.0
    time_sigma_s: NonNegative = 0.0

    @property
    def calibration(self) -> Calibration:
        return Calibration(bias=self.bias_sigma_m, bias_walk=self.bias_walk_m_rts, time_s=self.time_sigma_s)

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=True)

    @model_validator(mode="after")
    def _file_or_constant(self) -> Heights:
        if bool(self.file) == (self.constant_m is not None):
            raise InputError("heights: give either file or constant_m")
        return self


class TruthTable(TextOptions):
    """Reference trajectory of the vehicle's lever-arm origin: a file, or where it stands."""

    file: str = ""
    ecef_m: Vec3 | None = None
    local_m: Vec3 | None = None
    format: Literal["csv", "mat", "rtklib-pos", "nmea"] = "csv"
    time: Time = TimeColumn()
    position: Annotated[tuple[Column, ...], AfterValidator(_two_or_three)] = (1, 2, 3)  # two columns: up is 0
    velocity: Columns3 | None = None
    quaternion: tuple[Column, Column, Column, Column] | None = None  # the vehicle's axes to `frame`
    quaternion_order: Literal["wxyz", "xyzw"] = "wxyz"
    frame: AxisFrame = "local"
    quality: Column | None = None  # column of the kind of fix; RTKLIB files have their own
    qualities: tuple[int, ...] = ()  # kinds of fix that count as truth; default: all
    lever_b: Vec3 | None = None  # of the point whose trajectory this is; default: the origin of the lever arms
    date: str = ""

    @model_validator(mode="after")
    def _consistent(self) -> TruthTable:
        if bool(self.file) + (self.ecef_m is not None) + (self.local_m is not None) != 1:
            raise InputError("truth: give file, ecef_m or local_m")
        if self.quaternion is not None and self.frame not in ("local", "ned"):
            raise InputError(f"truth: attitudes are read with frame local or ned, not {self.frame}")
        return self


class ImuCalibrationTable(Table):
    """What the flight estimates of an IMU; see `factorgraph.problem.ImuCalibration`."""

    time_sigma_s: NonNegative = 0.0
    gyro_scale_sigma: NonNegative = 0.0
    accel_scale_sigma: NonNegative = 0.0

    @property
    def calibration(self) -> ImuCalibration:
        return ImuCalibration(self.time_sigma_s, self.gyro_scale_sigma, self.accel_scale_sigma)


class Velocities(TextOptions):
    """Velocities along the axes of a sensor on the vehicle: an odometer has one component."""

    file: str
    format: Literal["csv", "mat"] = "csv"
    name: str = "odometer"
    time: Time = TimeColumn()
    forward: Column | None = None  # speed along the sensor's forward axis
    velocity: Columns3 | None = None  # or all components, along `axes`
    unit: Literal["m/s", "km/h"] = "m/s"
    scale: float = 1.0
    increments: bool = False  # cells are distances travelled since the row before [m]
    axes: Axes = "RFU"
    mounting: Mounting = Mounting()
    sigma_mps: PositiveFloat = 0.1
    lever_b: Vec3 = (0.0, 0.0, 0.0)
    lever_sigma_m: NonNegative = 0.0  # what is estimated beside the states: prior standard deviations
    time_sigma_s: NonNegative = 0.0
    scale_sigma: NonNegative = 0.0
    mounting_sigma_deg: NonNegative = 0.0

    @model_validator(mode="after")
    def _one_way(self) -> Velocities:
        if (self.forward is None) == (self.velocity is None):
            raise InputError("velocities: give either forward (one column) or velocity (three)")
        if self.forward is not None and self.mounting != Mounting():
            raise InputError("velocities: a mounting turns all three components; give velocity rather than forward")
        return self

    @property
    def calibration(self) -> Calibration:
        return Calibration(
            lever_m=self.lever_sigma_m,
            time_s=self.time_sigma_s,
            scale=self.scale_sigma,
            mounting_rad=math.radians(self.mounting_sigma_deg),
        )


class Attitudes(TextOptions):
    """Attitude from a reference system, a two-antenna compass or the like."""

    file: str
    format: Literal["csv", "mat"] = "csv"
    name: str = "attitude"
    time: Time = TimeColumn()
    quaternion: tuple[Column, Column, Column, Column] | None = None  # the vehicle's axes to `frame`
    quaternion_order: Literal["wxyz", "xyzw"] = "wxyz"
    frame: Literal["local", "ned"] = "local"
    rpy: Columns3 | None = None  # or roll (right side down), pitch (nose up) and heading (clockwise from north)
    heading: Column | None = None  # or the heading alone
    unit: Literal["deg", "rad"] = "deg"
    offset_deg: float = 0.0  # added to headings
    sigma_deg: Vec3 = (0.5, 0.5, 1.0)  # of the rotation error about east, north and up
    tells: Literal["all", "tilt", "heading"] = "all"
    time_sigma_s: NonNegative = 0.0
    mounting_sigma_deg: NonNegative = 0.0

    @model_validator(mode="after")
    def _one_way(self) -> Attitudes:
        if sum(way is not None for way in (self.quaternion, self.rpy, self.heading)) != 1:
            raise InputError("attitudes: give one of quaternion, rpy and heading")
        if min(self.sigma_deg) <= 0:
            raise InputError(f"attitudes: sigma_deg must be positive, got {list(self.sigma_deg)}")
        if self.heading is not None and self.tells == "tilt":
            raise InputError("attitudes: a heading does not tell the tilt")
        return self

    @property
    def calibration(self) -> Calibration:
        return Calibration(time_s=self.time_sigma_s, mounting_rad=math.radians(self.mounting_sigma_deg))


class Magnetometers(TextOptions):
    """Magnetic field along the axes of a sensor; the unit is that of the reference field."""

    file: str
    format: Literal["csv", "mat"] = "csv"
    name: str = "magnetometer"
    time: Time = TimeColumn()
    field: Columns3
    scale: float = 1.0
    axes: Axes = "RFU"
    mounting: Mounting = Mounting()
    field_m: Vec3  # Earth's field along the recording's local axes
    sigma: PositiveFloat
    min_interval_s: NonNegative = 0.0
    bias_sigma: NonNegative = 0.0  # hard iron
    mounting_sigma_deg: NonNegative = 0.0

    @property
    def calibration(self) -> Calibration:
        return Calibration(bias=self.bias_sigma, mounting_rad=math.radians(self.mounting_sigma_deg))


class ConstraintsTable(Table):
    """What is known of how a vehicle moves; see `factorgraph.problem.Constraints`."""

    lateral_mps: NonNegative = 0.0
    vertical_mps: NonNegative = 0.0
    axle_b: Vec3 = (0.0, 0.0, 0.0)
    mounting_sigma_deg: NonNegative = 0.0
    zero_velocity_mps: NonNegative = 0.0
    zero_rotation_dps: NonNegative = 0.0
    height_mps: NonNegative = 0.0
    interval_s: PositiveFloat = 0.5

    def constraints(self, axle_b: Vec3) -> Constraints:
        """In SI units, the axle point from the body origin."""
        return Constraints(
            self.lateral_mps,
            self.vertical_mps,
            axle_b,
            math.radians(self.mounting_sigma_deg),
            self.zero_velocity_mps,
            math.radians(self.zero_rotation_dps),
            self.height_mps,
            self.interval_s,
        )


class Motion(Table):
    """How a vehicle without an IMU may move."""

    accel_mps2_rthz: Vec3

    @property
    def prior(self) -> MotionPrior:
        return MotionPrior(self.accel_mps2_rthz)


class Fixed(Table):
    """Known antenna position of a base station, one of three ways."""

    ecef_m: Vec3 | None = None
    lat_deg: float | None = None
    lon_deg: float | None = None
    h_m: float | None = None
    local_m: Vec3 | None = None

    @model_validator(mode="after")
    def _one_way(self) -> Fixed:
        geodetic = [v is not None for v in (self.lat_deg, self.lon_deg, self.h_m)]
        ways = (self.ecef_m is not None) + (self.local_m is not None) + any(geodetic)
        if ways != 1 or any(geodetic) != all(geodetic):
            raise InputError("fixed: give ecef_m, or lat_deg with lon_deg and h_m, or local_m")
        return self

    @property
    def ecef(self) -> Array | None:
        """ECEF position (3,), None when it is given in the local frame."""
        if self.ecef_m is not None:
            return np.array(self.ecef_m)
        if self.lat_deg is None or self.lon_deg is None or self.h_m is None:
            return None
        return ecef_from_geodetic(math.radians(self.lat_deg), math.radians(self.lon_deg), self.h_m)


class VehicleTable(Table):
    """A vehicle, or a base station with `fixed`."""

    name: str
    axes: Axes = "RFU"  # of its lever arms and truth attitudes
    imu: Imu | None = None
    imu_noise: ImuNoiseTable = ImuNoiseTable()
    imu_calibration: ImuCalibrationTable = ImuCalibrationTable()
    gnss: Gnss | None = None
    positions: tuple[Positions, ...] = ()
    heights: tuple[Heights, ...] = ()
    velocities: tuple[Velocities, ...] = ()
    attitudes: tuple[Attitudes, ...] = ()
    magnetometers: tuple[Magnetometers, ...] = ()
    constraints: ConstraintsTable = ConstraintsTable()
    motion: Motion | None = None
    fixed: Fixed | None = None
    truth: TruthTable | None = None
    heading_hint_deg: float | None = None  # of the first state
    heading_sigma_deg: PositiveFloat = math.degrees(HEADING_SIGMA_RAD)  # of it
    carrier: str | None = None  # a further antenna of that vehicle: `gnss` alone, its lever arm in the carrier's axes


class TagTable(Table):
    """A ranging radio, named as in the file: on a vehicle or an anchor at a local position."""

    name: str
    vehicle: str | None = None
    lever_b: Vec3 = (0.0, 0.0, 0.0)
    position_m: Vec3 | None = None

    @model_validator(mode="after")
    def _carried_or_anchor(self) -> TagTable:
        if (self.vehicle is None) == (self.position_m is None):
            raise InputError(f"tag {self.name}: give either vehicle (with lever_b) or position_m (an anchor)")
        return self


class Ranges(TextOptions):
    """Ranges between tags, from one file or several with the same columns: range = scale * cell + offset_m."""

    name: str = "uwb"
    files: Files
    format: Literal["csv", "mat"] = "csv"
    time: Time = TimeColumn()
    range: Column = "range"
    tag_a: Column = "from_id"
    tag_b: Column = "to_id"
    scale: float = 1.0
    offset_m: float = 0.0
    sigma: Column | None = None
    sigma_m: PositiveFloat = 0.15
    tags: tuple[TagTable, ...]
    bias_sigma_m: NonNegative = 0.0
    scale_sigma: NonNegative = 0.0
    per_pair: bool = False
    lever_sigma_m: NonNegative = 0.0  # of every carried tag
    time_sigma_s: NonNegative = 0.0  # of the whole set


class Vision(TextOptions):
    """Azimuth, elevation and range of a target, seen along the axes of the observer's vehicle (right, front, up)."""

    name: str = "vision"
    file: str
    format: Literal["csv", "mat"] = "csv"
    time: Time = TimeColumn()
    observer: TagTable
    target: TagTable
    azimuth: Column | None = None  # clockwise from forward
    elevation: Column | None = None  # up from the right-forward plane
    range: Column | None = None
    unit: Literal["deg", "rad"] = "deg"
    sigma_deg: PositiveFloat = 0.5
    sigma_m: PositiveFloat = 1.0
    time_sigma_s: NonNegative = 0.0
    mounting_sigma_deg: NonNegative = 0.0

    @model_validator(mode="after")
    def _something(self) -> Vision:
        if self.azimuth is None and self.elevation is None and self.range is None:
            raise InputError(f"vision {self.name}: give azimuth, elevation or range")
        if self.observer.vehicle is None:
            raise InputError(f"vision {self.name}: the observer {self.observer.name} must be on a vehicle")
        if self.observer.vehicle == self.target.vehicle:
            raise InputError(f"vision {self.name}: observer and target are both on {self.target.vehicle}")
        return self

    @property
    def calibration(self) -> Calibration:
        return Calibration(time_s=self.time_sigma_s, mounting_rad=math.radians(self.mounting_sigma_deg))


class LinkTable(Table):
    """A pair of vehicles; baseline = rover - reference."""

    reference: str
    rover: str


def _check_settings(tree: object) -> dict[str, Any]:
    if not isinstance(tree, dict):
        raise PydanticCustomError("settings", "[settings] is a table", {})
    changed_settings(Settings(), tree)
    return tree


def changed_settings(settings: Settings, tree: dict[str, Any]) -> Settings:
    """Settings with the entries of a `[settings]` tree changed.

    Raises InputError for an unknown key (with the nearest), a value of the wrong type and one that is refused.
    """
    changed: Settings = _replaced(settings, tree, "")
    if not changed.systems or set(changed.systems) - set(SYSTEMS):
        raise InputError(f'systems: "{changed.systems}" must hold letters of {SYSTEMS}, for instance "GE" for GPS and Galileo')
    return changed


def _replaced(owner: Any, tree: dict[str, Any], path: str) -> Any:
    """A copy of a settings dataclass or dictionary with the entries of a tree."""
    is_table = isinstance(owner, dict)
    children = owner if is_table else {f.name: getattr(owner, f.name) for f in dataclasses.fields(owner)}
    changes: dict[str, Any] = {}
    for name, value in tree.items():
        if name not in children:
            raise InputError(f"unknown key {path}{name}{nearest_hint(name, sorted(children))}")
        child = children[name]
        if isinstance(child, dict) or dataclasses.is_dataclass(child):
            if not isinstance(value, dict):
                raise InputError(f"{path}{name} is a table of {', '.join(_names(child))}")
            changes[name] = _replaced(child, value, f"{path}{name}.")
        else:
            changes[name] = _leaf(get_type_hints(type(owner))[name], value, path + name)
    return {**owner, **changes} if is_table else dataclasses.replace(owner, **changes)


def _names(owner: Any) -> list[str]:
    return list(owner) if isinstance(owner, dict) else [f.name for f in dataclasses.fields(owner)]


def _leaf(hint: Any, value: object, path: str) -> Any:
    try:
        return TypeAdapter(hint, config=ConfigDict(allow_inf_nan=False)).validate_python(value)
    except ValidationError as error:
        raise InputError(f"{path}: {_message(error.errors()[0])}") from error


class Flight(Table):
    """A whole `flight.toml`."""

    flight: FlightInfo = FlightInfo()
    vehicle: tuple[VehicleTable, ...] = Field(min_length=1)
    range: tuple[Ranges, ...] = ()
    vision: tuple[Vision, ...] = ()
    link: tuple[LinkTable, ...] = ()
    pair: tuple[LinkTable, ...] = ()
    settings: Annotated[dict[str, Any], PlainValidator(_check_settings)] = Field(default_factory=dict)

    @property
    def problem_settings(self) -> Settings:
        """The settings with the file's changes applied to the defaults."""
        return changed_settings(Settings(), self.settings)


def parse(text: str, source: str = FILE_NAME) -> Flight:
    """Read the text of a `flight.toml`. Raises InputError naming `source`, the dotted key and what would help."""
    try:
        tree = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise InputError(f"{source}: {error}") from error
    try:
        return Flight.model_validate(tree)
    except ValidationError as error:
        first = error.errors()[0]
        where = dotted(first["loc"])
        raise InputError(f"{source}: {where + ': ' if where else ''}{_message(first)}") from error


def read(path: Path) -> Flight:
    """Read a `flight.toml`. Raises InputError for a missing, unreadable or wrong file."""
    try:
        return parse(path.read_text(encoding="utf-8"), str(path))
    except OSError as error:
        raise InputError(f"{path}: {error.strerror or error}") from error
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: not UTF-8 text (byte {error.start})") from error


def dotted(location: tuple[int | str, ...]) -> str:
    """A pydantic location as a dotted key: ("vehicle", 0, "imu", "axes") is vehicle[0].imu.axes."""
    text = ""
    for part in location:
        text += f"[{part}]" if isinstance(part, int) else f".{part}" if text else part
    return text


def _message(error: Any) -> str:
    if error["type"] == "missing":
        return "this key is needed"
    text = str(error["msg"]).removeprefix("Value error, ")
    value = error.get("input")
    shows_value = error["type"] not in ("key", "column", "t0", "value_error", "settings") and isinstance(value, str | int | float)
    return f"{text}, got {value!r}" if shows_value else text


def dump(flight: Flight) -> str:
    """The text of a `flight.toml` that `parse` reads back to an equal model; defaults are left out."""
    tree = flight.model_dump(mode="python", exclude_defaults=True, exclude_none=True)
    return "\n".join(_table_lines("", tree)).strip() + "\n"


def _table_lines(prefix: str, tree: Mapping[str, Any]) -> Iterator[str]:
    """Lines of a table: its values first, then its sub-tables under their own headings."""
    values = {k: v for k, v in tree.items() if not _is_headed(v, prefix)}
    for key, value in values.items():
        yield f"{_key(key)} = {_value(value)}"
    for key, value in tree.items():
        if key in values:
            continue
        path = f"{prefix}.{_key(key)}" if prefix else _key(key)
        heading = f"[{path}]" if isinstance(value, Mapping) else f"[[{path}]]"
        for item in [value] if isinstance(value, Mapping) else value:
            yield from ("", heading, *_table_lines(path, item))


def _is_headed(value: object, prefix: str) -> bool:
    """Tables get headings down to the second level; deeper ones and tags are written in line."""
    if isinstance(value, Mapping):
        return prefix.count(".") < 1
    return isinstance(value, list | tuple) and bool(value) and isinstance(value[0], Mapping) and prefix in ("", "vehicle")


def _key(key: str) -> str:
    return key if key.replace("_", "").replace("-", "").isalnum() and key.isascii() else json.dumps(key)


def _value(value: object) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    if isinstance(value, Mapping):
        return "{ " + ", ".join(f"{_key(k)} = {_value(v)}" for k, v in value.items()) + " }"
    if isinstance(value, list | tuple):
        if value and isinstance(value[0], Mapping):
            return "[\n" + "".join(f"  {_value(item)},\n" for item in value) + "]"
        return "[" + ", ".join(_value(item) for item in value) + "]"
    return repr(float(value)) if isinstance(value, float) else str(value)
