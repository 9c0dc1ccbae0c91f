"""Measurement streams: what readers and simulators produce and estimators consume.

Every stream is a frozen struct of arrays with a strictly increasing time `t_s`, seconds since the flight's
`t0` (GPST), except where said. SI units and radians. Absent values are NaN. Constructors check shapes and
time order once and raise `InputError`, so estimators need not.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from factorgraph.errors import InputError, not_negative
from factorgraph.types import Array, IntArray


def _check(stream: object, **shapes: tuple[int, ...]) -> None:
    for name, shape in shapes.items():
        got = np.shape(getattr(stream, name))
        if got != shape:
            raise InputError(f"{type(stream).__name__}.{name} must have shape {shape}, got {got}")


def _check_time(stream: object, t_s: Array, strict: bool = True) -> None:
    name = type(stream).__name__
    if not np.all(np.isfinite(t_s)):
        raise InputError(f"{name}.t_s has {int(np.sum(~np.isfinite(t_s)))} non-finite values")
    step = np.diff(t_s)
    bad = np.flatnonzero(step <= 0 if strict else step < 0)
    if bad.size:
        i = int(bad[0])
        raise InputError(f"{name}.t_s must increase: row {i + 1} at {t_s[i + 1]:.6f} s follows {t_s[i]:.6f} s")


@dataclass(frozen=True, slots=True)
class ReadReport:
    """What a reader kept and dropped."""

    source: str
    n_rows: int
    dropped: dict[str, int] = field(default_factory=dict)  # reason -> rows
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Calibration:
    """What the flight estimates of a sensor beside its declared installation: prior standard deviations, 0: as declared.

    Each kind of sensor says which of them it knows; the others must be 0.
    """

    lever_m: float = 0.0  # of the lever arm, each axis
    time_s: float = 0.0  # of a constant offset of its time tags: taken at tag - offset
    scale: float = 0.0
    bias: float = 0.0  # in the sensor's unit
    bias_walk: float = 0.0  # of the bias, per sqrt(s)
    mounting_rad: float = 0.0  # rotation of the sensor against the body, each axis

    def __post_init__(self) -> None:
        not_negative(self, "lever_m", "time_s", "scale", "bias", "bias_walk", "mounting_rad")

    def only(self, owner: str, *known: str) -> None:
        """Raises InputError where something is asked for that `owner` cannot estimate."""
        for name in ("lever_m", "time_s", "scale", "bias", "bias_walk", "mounting_rad"):
            if getattr(self, name) > 0 and name not in known:
                raise InputError(f"{owner}: calibration.{name} cannot be estimated; it knows {', '.join(known)}")


AS_DECLARED = Calibration()


@dataclass(frozen=True, slots=True)
class ImuStream:
    """Specific force and angular rate of the IMU, resolved in the vehicle's body frame (RFU).

    Sample i holds the mean over (t_s[i-1], t_s[i]] when `is_mean`, else the instantaneous value at t_s[i].
    """

    t_s: Array  # (n,)
    f_b: Array  # (n, 3) [m/s^2]
    w_b: Array  # (n, 3) [rad/s]
    is_mean: bool = False

    def __post_init__(self) -> None:
        n = len(self.t_s)
        _check(self, t_s=(n,), f_b=(n, 3), w_b=(n, 3))
        _check_time(self, self.t_s)


@dataclass(frozen=True, slots=True)
class GnssStream:
    """One receiver: a row per epoch, satellite and signal, sorted by epoch, then satellite, then signal.

    `t_s` are receiver time tags: the true reception time is t_s minus the receiver clock offset.
    Satellite states are ECEF at the time of transmission, in the ECEF frame of that time (no Sagnac rotation).
    """

    t_s: Array  # (m,) one per epoch
    epoch: IntArray  # (n,) row -> epoch
    sat: IntArray  # (n,) row -> satellites
    signal: IntArray  # (n,) row -> signals
    satellites: tuple[str, ...]  # RINEX names: "G01"
    signals: tuple[str, ...]  # system + band + attribute: "G1C", "E5Q"
    wavelength_m: Array  # (n,)
    code_m: Array  # (n,)
    phase_cyc: Array  # (n,)
    doppler_hz: Array  # (n,) positive approaching
    cn0_dbhz: Array  # (n,)
    lli: IntArray  # (n,) bit 0: loss of lock since the previous epoch, bit 1: half-cycle ambiguity
    sat_pos_ecef: Array  # (n, 3) NaN without ephemeris
    sat_vel_ecef: Array  # (n, 3)
    sat_clock_m: Array  # (n,) c * satellite clock offset, relativity and group delay included
    sat_clock_mps: Array  # (n,)
    approx_ecef: Array | None = None  # (3,) receiver's own idea of its position
    klobuchar: Array | None = None  # (8,) broadcast ionosphere, alpha then beta

    def __post_init__(self) -> None:
        m, n = len(self.t_s), len(self.epoch)
        _check(self, t_s=(m,), epoch=(n,), sat=(n,), signal=(n,), wavelength_m=(n,), code_m=(n,), phase_cyc=(n,))
        _check(self, doppler_hz=(n,), cn0_dbhz=(n,), lli=(n,), sat_pos_ecef=(n, 3), sat_vel_ecef=(n, 3))
        _check(self, sat_clock_m=(n,), sat_clock_mps=(n,))
        _check_time(self, self.t_s)
        if np.any(np.diff(self.epoch) < 0):
            raise InputError("GnssStream rows must be sorted by epoch")

    @property
    def n_rows(self) -> int:
        return len(self.epoch)


@dataclass(frozen=True, slots=True)
class Tag:
    """A ranging radio: carried by a vehicle (lever arm in its body frame) or an anchor at a known position."""

    name: str
    vehicle: str | None = None
    lever_b: tuple[float, float, float] = (0.0, 0.0, 0.0)
    position_n: tuple[float, float, float] | None = None

    def __post_init__(self) -> None:
        if (self.vehicle is None) == (self.position_n is None):
            raise InputError(f"tag {self.name}: give either the vehicle that carries it or its position (an anchor)")


@dataclass(frozen=True, slots=True)
class RangeStream:
    """Two-way ranges between tags, one row each; times need not be distinct (several pairs at once)."""

    t_s: Array  # (n,) non-decreasing
    tag_a: IntArray  # (n,) row -> tags
    tag_b: IntArray  # (n,)
    tags: tuple[Tag, ...]
    range_m: Array  # (n,)
    sigma_m: Array  # (n,)
    name: str = "uwb"

    def __post_init__(self) -> None:
        n = len(self.t_s)
        _check(self, t_s=(n,), tag_a=(n,), tag_b=(n,), range_m=(n,), sigma_m=(n,))
        _check_time(self, self.t_s, strict=False)
        for column in (self.tag_a, self.tag_b):
            if n and not (0 <= column.min() and column.max() < len(self.tags)):
                raise InputError(f"{self.name}: tag index outside the {len(self.tags)} declared tags")


@dataclass(frozen=True, slots=True)
class PositionStream:
    """Position fixes of an antenna, in the flight's local frame n."""

    t_s: Array  # (n,)
    r_n: Array  # (n, 3)
    sigma_m: Array  # (n, 3) per axis of n
    lever_b: tuple[float, float, float] = (0.0, 0.0, 0.0)
    name: str = "position"
    v_n: Array | None = None  # (n, 3) velocity of the antenna, where the source gives it; NaN where it does not
    sigma_mps: Array | None = None  # (n, 3) per axis of n
    calibration: Calibration = AS_DECLARED

    def __post_init__(self) -> None:
        n = len(self.t_s)
        self.calibration.only(self.name, "lever_m", "time_s")
        if (self.v_n is None) != (self.sigma_mps is None):
            raise InputError(f"{self.name}: give both v_n and sigma_mps or neither")
        if self.v_n is not None:
            _check(self, v_n=(n, 3), sigma_mps=(n, 3))
        _check(self, t_s=(n,), r_n=(n, 3), sigma_m=(n, 3))
        _check_time(self, self.t_s)


@dataclass(frozen=True, slots=True)
class HeightStream:
    """Up coordinate of a point of the vehicle in the local frame n."""

    t_s: Array  # (n,)
    up_m: Array  # (n,)
    sigma_m: Array  # (n,)
    lever_b: tuple[float, float, float] = (0.0, 0.0, 0.0)
    name: str = "height"
    calibration: Calibration = AS_DECLARED  # a barometer has a bias that walks

    def __post_init__(self) -> None:
        n = len(self.t_s)
        self.calibration.only(self.name, "bias", "bias_walk", "time_s")
        _check(self, t_s=(n,), up_m=(n,), sigma_m=(n,))
        _check_time(self, self.t_s)


@dataclass(frozen=True, slots=True)
class VelocityStream:
    """Velocity of a point of the vehicle along its body axes (RFU): an odometer has the forward component only."""

    t_s: Array  # (n,)
    v_b: Array  # (n, 3) NaN where not measured
    sigma_mps: Array  # (n, 3)
    lever_b: tuple[float, float, float] = (0.0, 0.0, 0.0)
    name: str = "odometer"
    calibration: Calibration = AS_DECLARED

    def __post_init__(self) -> None:
        n = len(self.t_s)
        self.calibration.only(self.name, "lever_m", "time_s", "scale", "mounting_rad")
        _check(self, t_s=(n,), v_b=(n, 3), sigma_mps=(n, 3))
        _check_time(self, self.t_s)


@dataclass(frozen=True, slots=True)
class AttitudeStream:
    """Attitude of the vehicle from a reference system; `sigma_rad` is infinite about axes that it does not tell."""

    t_s: Array  # (n,)
    q_nb: Array  # (n, 4) body to n, scalar first
    sigma_rad: Array  # (n, 3) of the rotation error about east, north, up
    name: str = "attitude"
    calibration: Calibration = AS_DECLARED

    def __post_init__(self) -> None:
        n = len(self.t_s)
        self.calibration.only(self.name, "time_s", "mounting_rad")
        _check(self, t_s=(n,), q_nb=(n, 4), sigma_rad=(n, 3))
        _check_time(self, self.t_s)


@dataclass(frozen=True, slots=True)
class MagneticStream:
    """Magnetic field in the body frame, in the unit of the reference field; the bias is hard iron."""

    t_s: Array  # (n,)
    m_b: Array  # (n, 3)
    sigma: Array  # (n, 3)
    field_n: tuple[float, float, float]  # Earth's field in n
    name: str = "magnetometer"
    calibration: Calibration = AS_DECLARED

    def __post_init__(self) -> None:
        n = len(self.t_s)
        self.calibration.only(self.name, "bias", "mounting_rad")
        _check(self, t_s=(n,), m_b=(n, 3), sigma=(n, 3))
        _check_time(self, self.t_s)


@dataclass(frozen=True, slots=True)
class VisionStream:
    """Direction, and where known range, from a camera or radar on a vehicle to a point of another or a landmark.

    Azimuth counts clockwise from the body's forward axis, elevation up from its right-forward plane.
    """

    t_s: Array  # (n,)
    observer: Tag
    target: Tag
    azimuth_rad: Array  # (n,) NaN where not measured
    elevation_rad: Array  # (n,)
    range_m: Array  # (n,) NaN where not measured
    sigma_rad: Array  # (n,)
    sigma_m: Array  # (n,)
    name: str = "vision"
    calibration: Calibration = AS_DECLARED

    def __post_init__(self) -> None:
        n = len(self.t_s)
        if self.observer.vehicle is None:
            raise InputError(f"{self.name}: the observer {self.observer.name} must be on a vehicle")
        self.calibration.only(self.name, "mounting_rad", "time_s")
        _check(self, t_s=(n,), azimuth_rad=(n,), elevation_rad=(n,), range_m=(n,), sigma_rad=(n,), sigma_m=(n,))
        _check_time(self, self.t_s)


@dataclass(frozen=True, slots=True)
class Truth:
    """Reference trajectory of the body origin in the local frame n; velocity and attitude where known."""

    t_s: Array  # (n,)
    r_n: Array  # (n, 3)
    v_n: Array | None = None  # (n, 3)
    q_nb: Array | None = None  # (n, 4) scalar first

    def __post_init__(self) -> None:
        n = len(self.t_s)
        _check(self, t_s=(n,), r_n=(n, 3))
        if self.v_n is not None:
            _check(self, v_n=(n, 3))
        if self.q_nb is not None:
            _check(self, q_nb=(n, 4))
        _check_time(self, self.t_s)
