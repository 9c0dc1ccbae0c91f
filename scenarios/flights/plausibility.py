"""What of a flight cannot be right or is doubtful, told by its sensors together.

What cannot be right stops `relnav smooth`; what is doubtful is told with the result, which counts as degraded. `relnav check`
lists both. Checks: time tags of receivers against the orbits; times of an IMU against fixes, and of truth against both; axes,
signs and units of an IMU; antennas of one vehicle against its course; sensors that hang or end early.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import chain

import numpy as np

from factorgraph.gpstime import WEEK_S, GpsTime, leap_seconds
from factorgraph.measurements import PositionStream, Truth
from factorgraph.problem import NavigationProblem, Vehicle
from factorgraph.types import Array
from scenarios.flights import antennas, frozen, imu_axes
from scenarios.flights.epochs import FITS_M, code_misfit_m, every, points, tag_error_s
from scenarios.flights.motion_match import (
    MAX_OFFSET_S,
    Carried,
    Fixes,
    Offset,
    Steps,
    carried_along,
    carry,
    gyro_bias,
    slowed,
    steps_of,
    time_offset,
)
from scenarios.flights.schema import Imu

Span = tuple[float, float]

SMALL_OFFSET_S = 0.1  # what receivers and filters in sensors delay
SURE_SIGMA, SURE, SURE_NAMED = 3.0, 4.5, 3.0  # evidence for an offset, and for one that has a name
CONTRAST = 0.15  # less tells nothing
WRONG_S = 1.0  # larger offsets cannot be right
NAMED_S = 0.25  # an offset so near to a whole one is that
PRECISE_M = 0.5  # positions as good tell more than their velocities
DOPPLER_MPS, POINT_M = 0.1, 2.0  # usual noise
GNSS_STEP_S, MAX_EPOCHS = 1.0, 900
HOUR_S = 3600.0
UNIX_S = 315_964_800.0  # from 1970 to the epoch of GPS
COVERED, EARLY_S, LATE_START = 0.6, 10.0, 0.1
MIN_TIME_S = 20.0  # in common, for a time offset


@dataclass(frozen=True, slots=True)
class Finding:
    """Something wrong or doubtful."""

    subject: str  # vehicle or set of ranges; empty where the text names it
    text: str
    is_wrong: bool = False  # it cannot be right

    def __str__(self) -> str:
        return f"{self.subject}: {self.text}" if self.subject else self.text


@dataclass(frozen=True, slots=True)
class Compared:
    """Times of two sensors of a vehicle."""

    vehicle: str
    sensor: str
    against: str
    offset: Offset


@dataclass(frozen=True, slots=True)
class Examined:
    """All findings of a flight, and the time offsets between its sensors as far as motion tells them."""

    findings: tuple[Finding, ...] = ()
    offsets: tuple[Compared, ...] = ()


def examine(problem: NavigationProblem, imus: Mapping[str, Imu]) -> Examined:
    """Look for what is wrong or doubtful; `imus`: declarations by vehicle."""
    findings: list[Finding] = []
    offsets: list[Compared] = []
    for vehicle in problem.vehicles:
        imu = imus.get(vehicle.name)
        doubts = chain(_hanging(vehicle, imu), _early_ends(vehicle, problem), antennas.doubts(vehicle, problem))
        if vehicle.imu is not None and imu is not None and (text := imu_axes.gravity_doubt(vehicle.imu, imu)):
            findings.append(Finding(vehicle.name, text))
        findings += [Finding(vehicle.name, text) for text in doubts]
        if vehicle.gnss is not None and (finding := _tags(vehicle, problem.t0)) is not None:
            findings.append(finding)
        else:
            motion = _Motion(vehicle, problem, imu)
            findings += motion.findings()
            offsets += motion.compared
    for model in problem.ranges:
        findings += [Finding(model.stream.name, f"{text}: did the radio hang?") for text in frozen.ranges(model.stream)]
    return Examined(tuple(sorted(findings, key=lambda f: not f.is_wrong)), tuple(offsets))


# one sensor


def _hanging(v: Vehicle, imu: Imu | None) -> Iterator[str]:
    found: list[str] = []
    if v.imu is not None:
        found += frozen.imu(v.imu, np.eye(3) if imu is None else imu.C_bs)
    if v.gnss is not None:
        found += frozen.receiver(v.gnss.stream)
    for fixes in v.positions:
        found += frozen.positions(fixes)
    yield from (f"{text}: did it hang? leave those rows out" for text in found)


def _tags(v: Vehicle, t0: GpsTime) -> Finding | None:
    """Observations that do not fit the orbits at their time tags."""
    assert v.gnss is not None
    misfit = code_misfit_m(v.gnss.stream, t0)
    if not misfit > FITS_M:
        return None
    late = tag_error_s(v.gnss.stream, t0)
    text = f"its pseudoranges miss the satellites by {misfit:.0f} m (rms)"
    if late is None:
        return Finding(v.name, f"{text}: do observations and navigation files belong together?")
    why = "; GPST less UTC is that, so the time tags count UTC" if abs(late) == _leap(t0) else ""
    return Finding(v.name, f"{text}; they fit with time tags {_late(-late)}{why}: correct the times of gnss.obs", True)


def _leap(t0: GpsTime) -> int:
    return leap_seconds(t0.utc()) if t0.week else 18


def _late(seconds: float) -> str:
    return f"{abs(seconds):.2f} s {'later' if seconds > 0 else 'earlier'}".replace(".00 s", " s")


# spans


def shift_hint(name: str, span: Span, other: Span) -> str:
    """Which usual error of times explains that two sensors do not overlap; empty where none does."""
    shifts = {k * WEEK_S: f"exactly {_weeks(k)}: wrong GPS week?" for k in (1, 2, 3, 1024, 2048)}
    shifts |= {k * HOUR_S / 2: f"{k / 2:g} h: a time zone?" for k in range(1, 29)}
    shifts |= {UNIX_S: "Unix time read as GPS time, or the reverse", 18.0: "leap seconds: UTC for GPST?"}
    best, hint = 0.5, ""
    for shift, meaning in shifts.items():
        for sign in (-1.0, 1.0):
            moved = span[0] + sign * shift, span[1] + sign * shift
            common = (min(moved[1], other[1]) - max(moved[0], other[0])) / max(min(span[1] - span[0], other[1] - other[0]), 1e-3)
            if common > best + 0.01:
                best, hint = common, f"; they would with {name} {shift:.0f} s {'earlier' if sign < 0 else 'later'}, {meaning}"
    return hint


def _weeks(k: int) -> str:
    return "one week" if k == 1 else f"{k} weeks"


def _early_ends(v: Vehicle, problem: NavigationProblem) -> Iterator[str]:
    """Sensors that begin with the others and end long before."""
    linked = {n for link in problem.links if v.name in (link.reference, link.rover) for n in (link.reference, link.rover)}
    everything = [t for other in problem.vehicles if other is v or other.name in linked for _, t in _sensors(other)]
    if not everything:
        return
    first, last = min(t[0] for t in everything), max(t[-1] for t in everything)
    for name, t in _sensors(v):
        begins = t[0] - first < LATE_START * (last - first)
        if begins and t[-1] - first < COVERED * (last - first) and last - t[-1] > EARLY_S:
            yield f"{name} ends at {t[-1]:.1f} s, {last - t[-1]:.1f} s before the others: is its file complete?"


def _sensors(v: Vehicle) -> list[tuple[str, Array]]:
    out = [] if v.imu is None else [("imu", v.imu.t_s)]
    out += [] if v.gnss is None else [("gnss", v.gnss.stream.t_s)]
    return [(name, t) for name, t in [*out, *((p.name, p.t_s) for p in v.positions)] if t.size]


# sensors together


class _Motion:
    """What the sensors of a vehicle tell of its motion, compared."""

    def __init__(self, vehicle: Vehicle, problem: NavigationProblem, imu: Imu | None) -> None:
        self.vehicle, self.problem, self.imu = vehicle, problem, imu
        self.stream = None if vehicle.imu is None else slowed(vehicle.imu)
        self.gravity_n = problem.frame.gravity(np.zeros(3))
        self.compared: list[Compared] = []

    def findings(self) -> Iterator[Finding]:
        v = self.vehicle
        truth = None if v.truth is None else _of_truth(v.truth)
        if self.stream is None:
            yield from self._truth_against_fixes(truth)
            return
        if not np.any(np.ptp(self.stream.f_b, axis=0)) or self.stream.t_s[-1] - self.stream.t_s[0] < MIN_TIME_S:
            return
        matches = [m for fixes in self._fixes() if (m := self._match(fixes)) is not None]
        found = [f for _, _, fixes, offset in matches if (f := self._offset(fixes, offset)) is not None]
        yield from found
        if matches and not found:
            yield from self._axes(*max(matches, key=lambda m: m[3].contrast))
        if truth is not None and (match := self._match(truth, "truth", "imu")) is not None and not found:
            yield from self._truth(match[3], "the IMU")

    def _fixes(self) -> Iterator[Fixes]:
        v = self.vehicle
        streams = [p for p in v.positions if np.isfinite(p.r_n).any()] or list(v.positions)
        yield from (_of_positions(p) for p in streams if p.t_s.size)
        if v.gnss is not None and not v.is_fixed:
            stream = every(v.gnss.stream, GNSS_STEP_S, MAX_EPOCHS)
            point = points(stream, self.problem.t0, v.gnss.noise)
            if np.isfinite(point.v_ecef[:, 0]).mean() > 0.5:
                yield Fixes("gnss", 1, stream.t_s, point.v_ecef @ self.problem.frame.C_en.T, DOPPLER_MPS, v.gnss.lever_b)
            else:
                yield Fixes("gnss", 2, stream.t_s, self.problem.frame.from_ecef(point.r_ecef), POINT_M, v.gnss.lever_b)

    def _match(self, fixes: Fixes, sensor: str = "imu", against: str = "") -> tuple[Steps, Carried, Fixes, Offset] | None:
        imu = self.stream
        assert imu is not None
        steps = steps_of(fixes, self.gravity_n)
        if len(steps.start) < 2:
            return None
        carried = carry(imu, np.zeros(3), fixes.lever_b)
        carried = carry(imu, gyro_bias(steps, carried), fixes.lever_b)
        return self._compare(steps, carried, fixes, sensor, against or fixes.name)

    def _compare(
        self, steps: Steps, carried: Carried, fixes: Fixes, sensor: str, against: str
    ) -> tuple[Steps, Carried, Fixes, Offset] | None:
        span = min(carried.end_s, float(fixes.t_s[-1])) - max(carried.t0_s, float(fixes.t_s[0]))
        hours = [k * HOUR_S / 2 for k in range(1, 29) if k * HOUR_S / 2 < span - MIN_TIME_S]
        offset = time_offset(steps, carried, (0.0, *hours, *(-h for h in hours)))
        if offset is None:
            return None
        if offset.contrast > CONTRAST:
            self.compared.append(Compared(self.vehicle.name, sensor, against, offset))
        return steps, carried, fixes, offset

    def _offset(self, fixes: Fixes, offset: Offset) -> Finding | None:
        v = self.vehicle
        declared = [p.calibration.time_s for p in v.positions if p.name == fixes.name]
        declared += [v.gnss.calibration.time_s] if v.gnss is not None and fixes.name == "gnss" else []
        told = _doubt(offset, self.problem.t0, 3 * float(np.hypot(v.imu_calibration.time_s, max(declared, default=0.0))))
        if told is None:
            return None
        meaning, is_wrong = told
        times = f"the IMU's times are {_late(offset.offset_s)} than those of {fixes.name} (+- {offset.sigma_s:.2g} s){meaning}"
        return Finding(v.name, f"{times}; offset_s = {-offset.offset_s:.2f} in the IMU's time would undo it", is_wrong)

    def _axes(self, steps: Steps, carried: Carried, fixes: Fixes, offset: Offset) -> Iterator[Finding]:
        stream = self.stream
        if self.imu is None or stream is None:
            return
        offset_s = offset.offset_s if offset.evidence > SURE else 0.0
        reading = imu_axes.reading_doubt(steps, stream, self.imu, offset_s)
        travel = "" if reading else imu_axes.travel_doubt(steps, carried, offset_s, stream, self.imu)
        yield from (Finding(self.vehicle.name, f"{text} (against {fixes.name})") for text in (reading, travel) if text)

    def _truth_against_fixes(self, truth: Fixes | None) -> Iterator[Finding]:
        if truth is None or len(truth.t_s) < 3:
            return
        path = carried_along(truth.t_s, truth.z_n, self.gravity_n)
        for fixes in self._fixes():
            steps = steps_of(fixes, self.gravity_n)
            match = self._compare(steps, path, fixes, "truth", fixes.name) if len(steps.start) > 1 else None
            if match is not None:
                yield from self._truth(_reversed(match[3]), fixes.name)

    def _truth(self, offset: Offset, against: str) -> Iterator[Finding]:
        """Times of truth that are off; offset: of what it is compared with."""
        told = _doubt(offset, self.problem.t0, 0.0)
        if told is not None:
            late = f"{_late(-offset.offset_s)} than those of {against} (+- {offset.sigma_s:.2g} s){told[0]}"
            yield Finding(
                self.vehicle.name,
                f"the times of truth are {late}; offset_s = {offset.offset_s:.2f} in the time of truth would undo it",
            )


def _of_positions(p: PositionStream) -> Fixes:
    sigma_m = float(np.median(p.sigma_m[np.isfinite(p.r_n).all(axis=1)])) if np.isfinite(p.r_n).any() else np.inf
    if p.v_n is not None and p.sigma_mps is not None and sigma_m > PRECISE_M:
        return Fixes(p.name, 1, p.t_s, p.v_n, float(np.nanmedian(p.sigma_mps)), p.lever_b)
    return Fixes(p.name, 2, p.t_s, p.r_n, sigma_m, p.lever_b)


def _of_truth(truth: Truth) -> Fixes:
    return Fixes("truth", 2, truth.t_s, truth.r_n, 0.0)


def _reversed(offset: Offset) -> Offset:
    return Offset(-offset.offset_s, offset.sigma_s, offset.evidence, offset.contrast, offset.misfit_mps2)


def _doubt(offset: Offset, t0: GpsTime, tolerated_s: float) -> tuple[str, bool] | None:
    """What a time offset means and whether it cannot be right; None where it is small or not certain."""
    size, margin = abs(offset.offset_s), SURE_SIGMA * offset.sigma_s
    if offset.contrast < CONTRAST or size - margin < max(SMALL_OFFSET_S, tolerated_s):
        return None
    near = NAMED_S + margin
    if abs(size - _leap(t0)) < near and margin < 1 and offset.evidence > SURE_NAMED:
        return f": GPST less UTC is {_leap(t0)} s, so one of them counts UTC", True
    if size > MAX_OFFSET_S and offset.evidence > SURE_NAMED:
        return f": {round(2 * size / HOUR_S) / 2:g} h, a time zone?", True
    return ("", size > WRONG_S) if offset.evidence > SURE else None
