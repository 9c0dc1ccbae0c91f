"""From a flight's description and files to a navigation problem, with checks across files.

Order: read every file; fix t0 and the local frame; convert to streams; keep the declared part; check that sensors
overlap in time, that the base stands where it is said to, and that linked receivers see common satellites.
"""

from __future__ import annotations

import dataclasses
import math
import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from factorgraph.errors import InputError
from factorgraph.geodesy import LocalFrame
from factorgraph.gpstime import GpsTime
from factorgraph.measurements import (
    AttitudeStream,
    GnssStream,
    HeightStream,
    ImuStream,
    MagneticStream,
    PositionStream,
    RangeStream,
    ReadReport,
    Tag,
    Truth,
    VelocityStream,
    VisionStream,
)
from factorgraph.problem import Antenna, Link, MotionPrior, NavigationProblem, RangeModel, Vec3, Vehicle
from factorgraph.types import Array
from scenarios.flights import motion_sensors, schema, sensors
from scenarios.flights.catalogue import Located, locate
from scenarios.flights.epochs import approximate_position, epochs_of
from scenarios.flights.navigation import Navigation, read_navigation
from scenarios.flights.plausibility import Examined, Finding, examine, shift_hint
from scenarios.flights.rinex import RawObservations, gnss_stream, read_observations
from scenarios.flights.satellite_table import (
    RawSatellites,
    first_position,
    read_satellites,
    satellite_stream,
    without_group_delay,
)
from scenarios.flights.schema import axes_matrix
from scenarios.flights.sensors import Place, Raw
from scenarios.flights.tables import require_file
from scenarios.flights.ubx_observations import read_ubx_observations

BASE_TOLERANCE_M = 200.0  # a single-point position is never wrong by more
BASE_DOUBT_M = 50.0
SHORT_IMU_S = 2.0
MIN_SATELLITES = 4  # for a position
MIN_COMMON = 5  # satellites two receivers must share to be worth differencing

Stream = TypeVar(
    "Stream",
    ImuStream,
    GnssStream,
    PositionStream,
    HeightStream,
    VelocityStream,
    AttitudeStream,
    MagneticStream,
    RangeStream,
    VisionStream,
    Truth,
)


@dataclass(frozen=True, slots=True)
class LoadedFlight:
    """A flight ready to be solved, and what its readers kept and dropped."""

    problem: NavigationProblem
    reports: tuple[ReadReport, ...]
    examined: Examined = field(default_factory=Examined)  # what is doubtful


def load(flight: str | Path, data: Path | None = None, strict: bool = True) -> LoadedFlight:
    """Read a flight: a folder with flight.toml, such a file, or the name of one that comes with relnav.

    `data`: folder of the recordings of a flight that names none. Raises InputError with one line for whatever is wrong
    in the description or the files; what cannot be right of the sensors together is among the findings unless `strict`.
    """
    return _Loader(locate(flight, data), strict).load()


@dataclass(slots=True)
class _RawVehicle:
    """The files of a vehicle as read."""

    table: schema.VehicleTable
    imu: Raw | None
    gnss: RawObservations | RawSatellites | None
    positions: list[Raw]
    heights: list[Raw | None]  # None: a constant
    velocities: list[Raw]
    attitudes: list[Raw]
    magnetometers: list[Raw]
    truth: Raw | None
    carrier: _RawVehicle | None = None  # of a further antenna

    def files(self) -> list[Raw | None]:
        """The files of its sensors, None for a constant."""
        return [self.imu, *self.positions, *self.heights, *self.velocities, *self.attitudes, *self.magnetometers]

    @property
    def C_ba(self) -> Array:
        """Rotation (3, 3) from the declared axes to right-front-up."""
        return axes_matrix(self.table.axes)

    @property
    def imu_b(self) -> Array:
        """Lever arm (3,) from the declared origin to the IMU, which is the body origin of the problem."""
        return self.C_ba @ np.array(self.table.imu.lever_b) if self.table.imu else np.zeros(3)

    def lever(self, declared: Vec3) -> Vec3:
        """A declared lever arm, from the IMU in the body frame; of a carried antenna, those of its carrier."""
        if self.carrier is not None:
            return self.carrier.lever(declared)
        x, y, z = (self.C_ba @ np.array(declared) - self.imu_b).tolist()
        return (x, y, z)


class _Loader:
    """One flight's files, read once each."""

    def __init__(self, located: Located, strict: bool) -> None:
        self.located = located
        self.strict = strict
        self.flight = located.flight
        self.reports: list[ReadReport] = []
        self._observations: dict[Path, RawObservations] = {}
        self._messages: Navigation | None = None

    def load(self) -> LoadedFlight:
        raws = [self._read(vehicle) for vehicle in self.flight.vehicle]
        for raw in raws:
            raw.carrier = next((other for other in raws if other.table.name == raw.table.carrier), None)
        ranges = [[sensors.read_ranges(self._path(file), r) for file in r.files] for r in self.flight.range]
        sights = [motion_sensors.read_vision(self._path(s.file), s) for s in self.flight.vision]
        place = self._place(raws)
        vehicles = [self._vehicle(raw, place) for raw in raws]
        models = [self._range_model(r, files, raws, place) for r, files in zip(self.flight.range, ranges, strict=True)]
        visions = [self._vision(s, read, raws, place) for s, read in zip(self.flight.vision, sights, strict=True)]
        vehicles = [_with_constant_truth(v, raw, place) for v, raw in zip(vehicles, raws, strict=True)]
        vehicles = [self._with_constant_heights(v, raw, models) for v, raw in zip(vehicles, raws, strict=True)]
        t0 = place.t0
        if not _has_absolute_time(self.flight.flight, raws):
            t0, vehicles, models, visions = _counted_from_start(vehicles, models, visions)
        info = self.flight.flight
        vehicles = [_part_of_vehicle(v, info.start_s, info.end_s) for v in vehicles]
        models = [_with_stream(m, _part(m.stream, info.start_s, info.end_s)) for m in models]
        visions = [_part(s, info.start_s, info.end_s) for s in visions]
        problem = self._problem(t0, place.frame, vehicles, models, visions)
        examined = self._check(problem)
        return LoadedFlight(problem, tuple(self._short(report) for report in self.reports), examined)

    def _short(self, report: ReadReport) -> ReadReport:
        """The report with its files named from the folder they are in."""
        return dataclasses.replace(report, source=report.source.replace(f"{self.located.base}{os.sep}", ""))

    def _problem(
        self,
        t0: GpsTime,
        frame: LocalFrame,
        vehicles: list[Vehicle],
        models: list[RangeModel],
        visions: list[VisionStream],
    ) -> NavigationProblem:
        try:
            return NavigationProblem(
                name=self.located.name,
                t0=t0,
                frame=frame,
                vehicles=tuple(vehicles),
                links=tuple(Link(link.reference, link.rover) for link in self.flight.link),
                ranges=tuple(m for m in models if m.stream.t_s.size),
                visions=tuple(s for s in visions if s.t_s.size),
                pairs=tuple(Link(pair.reference, pair.rover) for pair in self.flight.pair),
                settings=self.flight.problem_settings,
            )
        except InputError as error:
            raise InputError(f"{self.located.source}: {error}") from error

    # reading

    def _path(self, file: str) -> Path:
        return self.located.base / file

    def _read(self, v: schema.VehicleTable) -> _RawVehicle:
        return _RawVehicle(
            v,
            sensors.read_imu(self._path(v.imu.file), v.imu) if v.imu else None,
            self._read_gnss(v.gnss) if v.gnss else None,
            [sensors.read_positions(self._path(p.file), p) for p in v.positions],
            [sensors.read_heights(self._path(h.file), h) if h.file else None for h in v.heights],
            [motion_sensors.read_velocities(self._path(s.file), s) for s in v.velocities],
            [motion_sensors.read_attitudes(self._path(a.file), a) for a in v.attitudes],
            [motion_sensors.read_magnetometers(self._path(m.file), m) for m in v.magnetometers],
            sensors.read_truth(self._path(v.truth.file), v.truth) if v.truth and v.truth.file else None,
        )

    def _read_gnss(self, gnss: schema.Gnss) -> RawObservations | RawSatellites:
        if gnss.table is not None:
            return read_satellites(require_file(self._path(gnss.obs)), gnss.table)
        return self._read_observations(gnss)

    def _gnss_stream(self, raw: _RawVehicle, t0: GpsTime) -> tuple[GnssStream, ReadReport]:
        assert raw.gnss is not None
        if isinstance(raw.gnss, RawObservations):
            return gnss_stream(raw.gnss, self._navigation(), t0)
        assert raw.table.gnss is not None and raw.table.gnss.table is not None
        stream, report = satellite_stream(raw.gnss, raw.table.gnss.table, t0)
        if not raw.table.gnss.table.group_delay_removed:
            stream = without_group_delay(stream, self._navigation(), t0)
        return stream, report

    def _read_observations(self, gnss: schema.Gnss) -> RawObservations:
        path = self._path(gnss.obs)
        if path not in self._observations:
            read = read_ubx_observations if gnss.format == "ubx" else read_observations
            self._observations[path] = read(require_file(path))
        return self._observations[path]

    def _navigation(self) -> Navigation:
        if self._messages is not None:
            return self._messages
        receivers = [v.gnss for v in self.flight.vehicle if v.gnss]
        files = list(dict.fromkeys(file for gnss in receivers for file in gnss.nav))
        if not files:  # a log has its messages in itself
            files = list(dict.fromkeys(gnss.obs for gnss in receivers if gnss.format == "ubx"))
        if not files:
            raise InputError(f"{self.located.source}: gnss.nav is needed: the RINEX navigation files for the observations")
        self._messages = read_navigation([require_file(self._path(file)) for file in files])
        return self._messages

    # time and place

    def _place(self, raws: Sequence[_RawVehicle]) -> Place:
        origin = self.flight.flight.origin
        C_nl = origin.C_nl if origin else np.eye(3)
        return Place(_first_instant(self.flight.flight, raws), origin.frame if origin else self._frame(raws), C_nl)

    def _frame(self, raws: Sequence[_RawVehicle]) -> LocalFrame:
        """The local frame at the base, else at the first receiver, else at the first absolute position."""
        for raw in raws:
            if raw.table.fixed is not None and (r := raw.table.fixed.ecef) is not None:
                return LocalFrame.at_ecef(r)
        for raw in raws:
            if raw.gnss is not None and (approx := self._receiver_position(raw)) is not None:
                return LocalFrame.at_ecef(approx)
        for raw in raws:
            for positions, table in zip(raw.positions, raw.table.positions, strict=True):
                if (r := positions.first_ecef(table.frame, table.position)) is not None:
                    return LocalFrame.at_ecef(r)
        raise InputError(
            f"{self.located.source}: flight.origin is needed (lat_deg, lon_deg, h_m): no file tells where on Earth this is; "
            "a few kilometres are good enough for gravity and Earth rate"
        )

    def _receiver_position(self, raw: _RawVehicle) -> Array | None:
        """The receiver's own approximate position, else a single-point position."""
        assert raw.gnss is not None
        if isinstance(raw.gnss, RawSatellites):
            return first_position(raw.gnss)
        if raw.gnss.approx_ecef is not None and np.linalg.norm(raw.gnss.approx_ecef) > 6e6:
            return raw.gnss.approx_ecef
        stream, _ = gnss_stream(raw.gnss, self._navigation(), raw.gnss.t0)
        return approximate_position(stream, raw.gnss.t0)

    # streams

    def _vehicle(self, raw: _RawVehicle, place: Place) -> Vehicle:
        v = raw.table
        hint = None if v.heading_hint_deg is None else math.radians(v.heading_hint_deg)
        return Vehicle(
            name=v.name,
            imu=self._imu(raw, place),
            imu_noise=v.imu_noise.noise,
            gnss=self._antenna(raw, place),
            positions=tuple(self._positions(raw, place)),
            heights=tuple(self._heights(raw, place)),
            velocities=tuple(self._velocities(raw, place)),
            attitudes=tuple(self._attitudes(raw, place)),
            magnetics=tuple(self._magnetics(raw, place)),
            constraints=v.constraints.constraints(raw.lever(v.constraints.axle_b)),
            imu_calibration=v.imu_calibration.calibration,
            motion=v.motion.prior if v.motion else MotionPrior(),
            fixed_n=_fixed(v.fixed, place),
            truth=self._truth(raw, place),
            heading_hint_rad=hint,
            heading_sigma_rad=math.radians(v.heading_sigma_deg),
            carrier=v.carrier,
        )

    def _imu(self, raw: _RawVehicle, place: Place) -> ImuStream | None:
        if raw.imu is None or raw.table.imu is None:
            return None
        stream, report = sensors.imu_stream(raw.imu, raw.table.imu, place)
        self.reports.append(report)
        return stream

    def _antenna(self, raw: _RawVehicle, place: Place) -> Antenna | None:
        if raw.gnss is None or raw.table.gnss is None:
            return None
        info = self.flight.flight
        stream, report = self._gnss_stream(raw, place.t0)
        self.reports.append(report)
        source = str(self._path(raw.table.gnss.obs))
        if not np.isfinite(stream.code_m).any():
            raise InputError(f"{source}: no pseudorange (code) in any row; phase alone gives no position")
        if not np.isfinite(stream.sat_pos_ecef[:, 0]).any():
            raise InputError(
                f"{source}: the navigation files have no message for any of its satellites and times; are they of the same day?"
            )
        stream = _part_of_gnss(stream, info.start_s, info.end_s, source)
        if (most := _most_satellites(stream)) < MIN_SATELLITES:
            raise InputError(
                f"{source}: at most {most} satellites with code and orbit at a time, a position needs {MIN_SATELLITES}; "
                "check the navigation files, the systems logged and the antenna's view"
            )
        gnss = raw.table.gnss
        return Antenna(stream, raw.lever(gnss.lever_b), gnss.noise.noise, gnss.calibration)

    def _positions(self, raw: _RawVehicle, place: Place) -> list[PositionStream]:
        streams: list[PositionStream] = []
        for positions, table in zip(raw.positions, raw.table.positions, strict=True):
            lever = raw.lever(table.lever_b)
            found, report = sensors.position_streams(positions, table, lever, place, self._path(table.file))
            streams += [dataclasses.replace(s, calibration=table.calibration) for s in found]
            self.reports.append(report)
        return streams

    def _heights(self, raw: _RawVehicle, place: Place) -> list[HeightStream]:
        streams = []
        for heights, table in zip(raw.heights, raw.table.heights, strict=True):
            if heights is not None:
                stream, report = sensors.height_stream(heights, table, raw.lever(table.lever_b), place)
                streams.append(dataclasses.replace(stream, calibration=table.calibration))
                self.reports.append(report)
        return streams

    def _velocities(self, raw: _RawVehicle, place: Place) -> list[VelocityStream]:
        streams = []
        for read, table in zip(raw.velocities, raw.table.velocities, strict=True):
            stream, report = motion_sensors.velocity_stream(read, table, raw.lever(table.lever_b), place)
            streams.append(stream)
            self.reports.append(report)
        return streams

    def _attitudes(self, raw: _RawVehicle, place: Place) -> list[AttitudeStream]:
        streams = []
        for read, table in zip(raw.attitudes, raw.table.attitudes, strict=True):
            stream, report = motion_sensors.attitude_stream(read, table, raw.C_ba, place)
            streams.append(stream)
            self.reports.append(report)
        return streams

    def _magnetics(self, raw: _RawVehicle, place: Place) -> list[MagneticStream]:
        streams = []
        for read, table in zip(raw.magnetometers, raw.table.magnetometers, strict=True):
            stream, report = motion_sensors.magnetic_stream(read, table, place)
            streams.append(stream)
            self.reports.append(report)
        return streams

    def _vision(self, vision: schema.Vision, read: Raw, raws: Sequence[_RawVehicle], place: Place) -> VisionStream:
        carriers = {raw.table.name: raw for raw in raws}
        observer, target = (self._tag(tag, carriers, place) for tag in (vision.observer, vision.target))
        stream, report = motion_sensors.vision_stream(read, vision, observer, target, place)
        self.reports.append(report)
        return stream

    def _truth(self, raw: _RawVehicle, place: Place) -> Truth | None:
        if raw.truth is None or raw.table.truth is None:
            return None
        path = self._path(raw.table.truth.file)
        at = raw.table.truth.lever_b
        lever_b = raw.imu_b if at is None else -np.array(raw.lever(at))
        truth, report = sensors.truth_of(raw.truth, raw.table.truth, raw.C_ba, lever_b, place, path)
        self.reports.append(report)
        return truth

    def _range_model(self, ranges: schema.Ranges, files: Sequence[Raw], raws: Sequence[_RawVehicle], place: Place) -> RangeModel:
        carriers = {raw.table.name: raw for raw in raws}
        stream, report = sensors.range_stream(files, ranges, tuple(self._tag(tag, carriers, place) for tag in ranges.tags), place)
        self.reports.append(report)
        return RangeModel(
            stream, ranges.bias_sigma_m, ranges.scale_sigma, ranges.per_pair, ranges.lever_sigma_m, ranges.time_sigma_s
        )

    def _tag(self, tag: schema.TagTable, carriers: dict[str, _RawVehicle], place: Place) -> Tag:
        if tag.position_m is not None:
            x, y, z = (place.C_nl @ np.array(tag.position_m)).tolist()
            return Tag(tag.name, position_n=(x, y, z))
        if tag.vehicle is None or tag.vehicle not in carriers:
            hint = schema.nearest_hint(str(tag.vehicle), sorted(carriers))
            raise InputError(f"{self.located.source}: tag {tag.name}: no vehicle named {tag.vehicle}{hint}")
        return Tag(tag.name, tag.vehicle, carriers[tag.vehicle].lever(tag.lever_b))

    def _with_constant_heights(self, v: Vehicle, raw: _RawVehicle, models: Sequence[RangeModel]) -> Vehicle:
        constants = [h for h, read in zip(raw.table.heights, raw.heights, strict=True) if read is None]
        if not constants:
            return v
        spans = [span for _, span in _spans(v)] + [s for m in models if (s := _range_span(m, v.name)) is not None]
        if not spans:
            raise InputError(f"{self.located.source}: vehicle {v.name}: a constant height needs a sensor or ranges beside it")
        start, end = min(s[0] for s in spans), max(s[1] for s in spans)
        more = tuple(sensors.constant_heights(h, raw.lever(h.lever_b), start, end) for h in constants)
        return dataclasses.replace(v, heights=(*v.heights, *more))

    # checks across files

    def _check(self, problem: NavigationProblem) -> Examined:
        wrong = list(self._wrong(problem))
        examined = Examined()
        if not wrong:
            examined = examine(problem, {v.name: v.imu for v in self.flight.vehicle if v.imu is not None})
            wrong = [str(finding) for finding in examined.findings if finding.is_wrong]
        if wrong and self.strict:
            raise InputError(wrong[0])
        return examined if examined.findings or not wrong else Examined(tuple(Finding("", text, True) for text in wrong))

    def _wrong(self, problem: NavigationProblem) -> Iterator[str]:
        """What single checks refuse; what they doubt is noted."""
        for vehicle in problem.vehicles:
            yield from self._checked("", _check_overlap, vehicle, problem)
            self._note(vehicle.name, _short_imu(vehicle))
            if vehicle.gnss is not None and vehicle.fixed_n is not None:
                yield from self._checked(vehicle.name, _check_base, vehicle, problem)
        for link in problem.links:
            ends = problem.vehicle(link.reference), problem.vehicle(link.rover)
            yield from self._checked(f"{link.reference}-{link.rover}", _check_common, *ends)
        for model in problem.ranges:
            yield from self._checked("", _check_ranges, model, problem)

    def _checked(self, source: str, check: Callable[..., str | None], *of: object) -> Iterator[str]:
        try:
            self._note(source, check(*of) or "")
        except InputError as error:
            yield str(error)

    def _note(self, source: str, note: str) -> None:
        if note:
            self.reports.append(ReadReport(source, 0, notes=(note,)))


def _with_constant_truth(v: Vehicle, raw: _RawVehicle, place: Place) -> Vehicle:
    truth, spans = raw.table.truth, _spans(v)
    if truth is None or truth.file or not spans:
        return v
    t_s = np.arange(min(s[0] for _, s in spans), max(s[1] for _, s in spans) + 0.5, 1.0)
    return dataclasses.replace(v, truth=sensors.constant_truth(truth, t_s, place))


def _fixed(fixed: schema.Fixed | None, place: Place) -> Vec3 | None:
    if fixed is None:
        return None
    r_ecef = fixed.ecef
    r_n = place.C_nl @ np.array(fixed.local_m) if r_ecef is None else place.frame.from_ecef(r_ecef)
    x, y, z = r_n.tolist()
    return (x, y, z)


def _refs(raws: Sequence[_RawVehicle]) -> list[GpsTime]:
    """Instants from which files with absolute times count, receivers first."""
    gnss = [raw.gnss.t0 for raw in raws if isinstance(raw.gnss, RawObservations)]
    times = [raw.gnss.times for raw in raws if isinstance(raw.gnss, RawSatellites)]
    times += [r.times for raw in raws for r in raw.files() if r is not None]
    return [min(gnss)] if gnss else sorted(t.ref for t in times if t.ref is not None)


def _has_absolute_time(info: schema.FlightInfo, raws: Sequence[_RawVehicle]) -> bool:
    return info.t0 is not None or bool(_refs(raws))


def _first_instant(info: schema.FlightInfo, raws: Sequence[_RawVehicle]) -> GpsTime:
    """The declared t0, else the whole second of the first GNSS epoch or absolute time, else the zero of the clock."""
    if info.t0 is not None:
        return info.t0
    refs = _refs(raws)
    return GpsTime(refs[0].week, math.floor(refs[0].sow)) if refs else GpsTime(0, 0.0)


def _most_satellites(stream: GnssStream) -> int:
    """Satellites with code and state, at the epoch with most of them."""
    known = np.isfinite(stream.code_m) & np.isfinite(stream.sat_pos_ecef[:, 0])
    pairs = np.unique(np.column_stack([stream.epoch[known], stream.sat[known]]), axis=0)
    return int(np.bincount(pairs[:, 0], minlength=1).max())


# parts of streams


def _part_of_gnss(stream: GnssStream, start_s: float, end_s: float, source: str) -> GnssStream:
    keep = (stream.t_s >= start_s) & (stream.t_s <= end_s)
    if keep.all():
        return stream
    if not keep.any():
        raise InputError(f"{source}: no epoch between start_s {start_s:g} and end_s {end_s:g} of the flight")
    return epochs_of(stream, keep)


def _part(stream: Stream, start_s: float, end_s: float) -> Stream:
    """The rows of a stream between two times, inclusive."""
    keep = (stream.t_s >= start_s) & (stream.t_s <= end_s)
    if keep.all():
        return stream
    n = len(keep)
    arrays = {f.name: getattr(stream, f.name) for f in dataclasses.fields(stream)}
    changes: dict[str, Any] = {name: x[keep] for name, x in arrays.items() if isinstance(x, np.ndarray) and len(x) == n}
    return dataclasses.replace(stream, **changes)


def _parts(streams: Sequence[Stream], start_s: float, end_s: float) -> tuple[Stream, ...]:
    """The parts of streams that have rows."""
    return tuple(part for s in streams if (part := _part(s, start_s, end_s)).t_s.size)


def _part_of_vehicle(v: Vehicle, start_s: float, end_s: float) -> Vehicle:
    imu = None if v.imu is None else _part(v.imu, start_s, end_s)
    if imu is not None and len(imu.t_s) < 2:
        raise InputError(f"vehicle {v.name}: no IMU samples between start_s {start_s:g} and end_s {end_s:g} of the flight")
    return dataclasses.replace(
        v,
        imu=imu,
        positions=_parts(v.positions, start_s, end_s),
        heights=_parts(v.heights, start_s, end_s),
        velocities=_parts(v.velocities, start_s, end_s),
        attitudes=_parts(v.attitudes, start_s, end_s),
        magnetics=_parts(v.magnetics, start_s, end_s),
        truth=None if v.truth is None else _part(v.truth, start_s, end_s),
    )


def _with_stream(model: RangeModel, stream: RangeStream) -> RangeModel:
    return dataclasses.replace(model, stream=stream)


def _later(stream: Stream, shift_s: float) -> Stream:
    return dataclasses.replace(stream, t_s=stream.t_s - shift_s)


def _counted_from_start(
    vehicles: list[Vehicle], models: list[RangeModel], visions: list[VisionStream]
) -> tuple[GpsTime, list[Vehicle], list[RangeModel], list[VisionStream]]:
    """Times of a clock of its own, counted from the whole second before the first measurement."""
    starts = [span[0] for v in vehicles for _, span in _spans(v)]
    starts += [float(m.stream.t_s[0]) for m in models] + [float(s.t_s[0]) for s in visions]
    shift = math.floor(min(starts)) if starts else 0.0
    moved = [
        dataclasses.replace(
            v,
            imu=None if v.imu is None else _later(v.imu, shift),
            gnss=None if v.gnss is None else dataclasses.replace(v.gnss, stream=_later(v.gnss.stream, shift)),
            positions=tuple(_later(s, shift) for s in v.positions),
            heights=tuple(_later(s, shift) for s in v.heights),
            velocities=tuple(_later(s, shift) for s in v.velocities),
            attitudes=tuple(_later(s, shift) for s in v.attitudes),
            magnetics=tuple(_later(s, shift) for s in v.magnetics),
            truth=None if v.truth is None else _later(v.truth, shift),
        )
        for v in vehicles
    ]
    later = [_with_stream(m, _later(m.stream, shift)) for m in models]
    return GpsTime(0, float(shift)), moved, later, [_later(s, shift) for s in visions]


# checks


def _spans(v: Vehicle) -> list[tuple[str, tuple[float, float]]]:
    """Name and time span of each sensor of a vehicle."""
    streams: list[tuple[str, Array]] = []
    if v.imu is not None:
        streams.append(("imu", v.imu.t_s))
    if v.gnss is not None:
        streams.append(("gnss", v.gnss.stream.t_s))
    for more in (v.positions, v.heights, v.velocities, v.attitudes, v.magnetics):
        streams += [(s.name, s.t_s) for s in more]
    return [(name, (float(t[0]), float(t[-1]))) for name, t in streams if t.size]


def _range_span(model: RangeModel, vehicle: str) -> tuple[float, float] | None:
    stream = model.stream
    mine = np.array([tag.vehicle == vehicle for tag in stream.tags])
    t = stream.t_s[mine[stream.tag_a] | mine[stream.tag_b]]
    return (float(t[0]), float(t[-1])) if t.size else None


def _apart(a: tuple[float, float], b: tuple[float, float]) -> bool:
    return a[1] < b[0] or b[1] < a[0]


def _as_span(span: tuple[float, float]) -> str:
    return f"{span[0]:.1f} to {span[1]:.1f} s"


def _check_overlap(v: Vehicle, problem: NavigationProblem) -> None:
    """Raises InputError when two sensors of a vehicle have no common time, or the vehicle has no measurement."""
    spans = _spans(v)
    ranged = [s for m in problem.ranges if (s := _range_span(m, v.name)) is not None]
    if not spans and not ranged and not v.is_fixed:
        raise InputError(f"vehicle {v.name}: no measurement of it is left")
    for i, (name, span) in enumerate(spans):
        for other, other_span in spans[i + 1 :]:
            if _apart(span, other_span):
                raise InputError(
                    f"vehicle {v.name}: {name} ({_as_span(span)}) and {other} ({_as_span(other_span)}) do not overlap"
                    f"{shift_hint(name, span, other_span)}; check epoch, unit and offset_s of their time columns"
                )
    if v.truth is None or not v.truth.t_s.size or not spans:
        return
    known = (float(v.truth.t_s[0]), float(v.truth.t_s[-1]))
    if all(_apart(span, known) for _, span in spans):
        name, span = spans[0]
        raise InputError(
            f"vehicle {v.name}: truth ({_as_span(known)}) and {name} ({_as_span(span)}) do not overlap"
            f"{shift_hint('truth', known, span)}; check epoch, unit and offset_s of their time columns"
        )


def _short_imu(v: Vehicle) -> str:
    """A note where the IMU leaves out part of what the vehicle's other sensors measured."""
    others = [span for name, span in _spans(v) if name != "imu"]
    if v.imu is None or not others:
        return ""
    first, last = min(s[0] for s in others), max(s[1] for s in others)
    start, end = float(v.imu.t_s[0]), float(v.imu.t_s[-1])
    lost_s = max(start - first, 0.0) + max(last - end, 0.0)
    if lost_s < SHORT_IMU_S:
        return ""
    spans = f"the IMU ({_as_span((start, end))}) is short of the other sensors ({_as_span((first, last))})"
    return f"{spans}; {lost_s:.1f} s are left out"


def _check_ranges(model: RangeModel, problem: NavigationProblem) -> None:
    for vehicle in problem.vehicles:
        ranged = _range_span(model, vehicle.name)
        for name, span in _spans(vehicle):
            if ranged is not None and _apart(ranged, span):
                both = f"ranges {model.stream.name} ({_as_span(ranged)}) and {name} ({_as_span(span)})"
                raise InputError(
                    f"vehicle {vehicle.name}: {both} do not overlap{shift_hint('the ranges', ranged, span)}; "
                    "check epoch, unit and offset_s of their time columns"
                )


def _check_base(base: Vehicle, problem: NavigationProblem) -> str:
    """A note when the declared position of a base is doubtful; raises InputError when its observations refute it."""
    assert base.gnss is not None and base.fixed_n is not None
    measured = approximate_position(base.gnss.stream, problem.t0)
    if measured is None:
        return "no single-point position, so the declared position is not checked"
    declared = problem.frame.to_ecef(np.array(base.fixed_n))
    distance = float(np.linalg.norm(measured - declared))
    if distance < BASE_DOUBT_M:
        return ""
    text = f"the declared position is {distance:.0f} m from where its observations place it"
    swapped = next((v.name for v in problem.vehicles if v is not base and _is_at(v, declared, distance, problem)), None)
    if swapped is not None:
        raise InputError(f"base {base.name}: {text}, but those of {swapped} fit: are the observation files swapped?")
    if distance > BASE_TOLERANCE_M:
        x, y, z = measured
        raise InputError(f"base {base.name}: {text} (ECEF {x:.0f} {y:.0f} {z:.0f} m); correct `fixed`, or gnss.obs is another's")
    return text


def _is_at(v: Vehicle, r_ecef: Array, distance_m: float, problem: NavigationProblem) -> bool:
    """Whether a vehicle's observations place it near a position, and much nearer than `distance_m`."""
    measured = approximate_position(v.gnss.stream, problem.t0) if v.gnss is not None else None
    return measured is not None and float(np.linalg.norm(measured - r_ecef)) < min(BASE_DOUBT_M, 0.3 * distance_m)


def _check_common(a: Vehicle, b: Vehicle) -> str:
    """A note when two linked receivers share little; raises InputError when they share nothing."""
    if a.gnss is None or b.gnss is None:
        lacking = a.name if a.gnss is None else b.name
        raise InputError(f"link {a.name}-{b.name}: {lacking} has no gnss, so there is nothing to difference")
    x, y = a.gnss.stream, b.gnss.stream
    first, second = (float(x.t_s[0]), float(x.t_s[-1])), (float(y.t_s[0]), float(y.t_s[-1]))
    if _apart(first, second):
        spans = f"({_as_span(first)}; {_as_span(second)})"
        hint = shift_hint(f"the times of {a.name}", first, second)
        raise InputError(f"link {a.name}-{b.name}: the receivers were not on together {spans}{hint}")
    bands_a, bands_b = _satellite_bands(x), _satellite_bands(y)
    common = bands_a & bands_b
    satellites = sorted({name.split()[0] for name in common})
    if not common:
        raise InputError(
            f"link {a.name}-{b.name}: no common satellite on a common band; "
            f"{a.name} has {_seen(bands_a)}, {b.name} has {_seen(bands_b)}"
        )
    if len(satellites) < MIN_COMMON:
        return f"only {len(satellites)} common satellites ({', '.join(satellites)})"
    return ""


def _satellite_bands(stream: GnssStream) -> set[str]:
    """ "G05 1": satellites with a known state, and the bands of their phases."""
    known = np.isfinite(stream.sat_pos_ecef[:, 0]) & np.isfinite(stream.code_m)
    rows = np.unique(np.column_stack([stream.sat[known], stream.signal[known]]), axis=0)
    return {f"{stream.satellites[s]} {stream.signals[k][1]}" for s, k in rows.tolist()}


def _seen(bands: set[str]) -> str:
    satellites = sorted({name.split()[0] for name in bands})
    systems = sorted({f"{name[0]} band {name.split()[1]}" for name in bands})
    return f"{len(satellites)} satellites ({', '.join(systems)})"
