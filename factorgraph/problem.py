"""The navigation problem: everything an estimator may know, and no estimator in it.

A problem is vehicles (sensors, lever arms, noise), links between vehicles (which pairs difference their GNSS
observations), ranges between tags, and settings. Lever arms run from the body origin to the sensor, in the
body frame RFU. The IMU is at the body origin.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from factorgraph.errors import InputError, not_negative, positive
from factorgraph.geodesy import LocalFrame
from factorgraph.gpstime import GpsTime
from factorgraph.measurements import (
    AS_DECLARED,
    AttitudeStream,
    Calibration,
    GnssStream,
    HeightStream,
    ImuStream,
    MagneticStream,
    PositionStream,
    RangeStream,
    Truth,
    VelocityStream,
    VisionStream,
)
from factorgraph.types import Array

Vec3 = tuple[float, float, float]
Sensor = PositionStream | HeightStream | VelocityStream | AttitudeStream | MagneticStream
HEADING_SIGMA_RAD = 0.3  # of a declared heading
Kernel = Literal["none", "huber", "cauchy", "geman-mcclure", "tukey", "dcs", "tls", "self-tuned"]
Elevation = Literal["sine", "flat"]
NoiseModel = Literal["scale", "elevation", "cn0"]


@dataclass(frozen=True, slots=True)
class ImuNoise:
    """White-noise densities and bias behaviour; defaults are a consumer MEMS unit."""

    gyro_rps_rthz: float = 2e-4
    accel_mps2_rthz: float = 2e-3
    gyro_bias_rps: float = 1e-2  # prior standard deviation
    accel_bias_mps2: float = 0.3
    gyro_bias_walk_rps_rts: float = 2e-5  # random-walk density, per sqrt(s)
    accel_bias_walk_mps2_rts: float = 2e-4

    def __post_init__(self) -> None:
        positive(self, "gyro_rps_rthz", "accel_mps2_rthz", "gyro_bias_rps", "accel_bias_mps2")
        positive(self, "gyro_bias_walk_rps_rts", "accel_bias_walk_mps2_rts")


@dataclass(frozen=True, slots=True)
class GnssNoise:
    """Zenith standard deviations per receiver; sigma^2(el) = sigma0^2 (1 + 1/sin^2 el) / 2 where `elevation` is "sine"."""

    code_m: float = 0.30
    phase_m: float = 0.003
    doppler_mps: float = 0.05
    absolute_code_m: float = 3.0  # undifferenced: broadcast orbits and clocks, atmosphere
    absolute_correlation_s: float = 60.0  # those errors persist: code of nearby epochs counts once
    elevation_mask_rad: float = np.deg2rad(15.0)
    min_cn0_dbhz: float = 0.0
    elevation: Elevation = "sine"  # "flat": the same at every elevation

    def __post_init__(self) -> None:
        positive(self, "code_m", "phase_m", "doppler_mps", "absolute_code_m", "absolute_correlation_s")


@dataclass(frozen=True, slots=True)
class MotionPrior:
    """How a vehicle without an IMU may move: white noise on acceleration [m/s^2/sqrt(Hz)], per axis of n."""

    accel_mps2_rthz: Vec3 = (1.0, 1.0, 0.5)

    def __post_init__(self) -> None:
        if not min(self.accel_mps2_rthz) > 0:
            raise InputError(f"MotionPrior.accel_mps2_rthz must be positive, got {self.accel_mps2_rthz}")


@dataclass(frozen=True, slots=True)
class Antenna:
    """A GNSS antenna and its receiver's observations."""

    stream: GnssStream
    lever_b: Vec3 = (0.0, 0.0, 0.0)
    noise: GnssNoise = GnssNoise()
    calibration: Calibration = AS_DECLARED

    def __post_init__(self) -> None:
        self.calibration.only("gnss", "lever_m", "time_s")


@dataclass(frozen=True, slots=True)
class ImuCalibration:
    """What the flight estimates of an IMU: prior standard deviations, 0: as declared."""

    time_s: float = 0.0  # offset of its time tags: sampled at tag - offset
    gyro_scale: float = 0.0  # each axis
    accel_scale: float = 0.0

    def __post_init__(self) -> None:
        not_negative(self, "time_s", "gyro_scale", "accel_scale")


@dataclass(frozen=True, slots=True)
class Constraints:
    """What is known of how a vehicle moves; 0: not used. They act every `interval_s`."""

    lateral_mps: float = 0.0  # non-holonomic: sideways velocity of `axle_b` in the body frame
    vertical_mps: float = 0.0  # upward velocity of it
    axle_b: Vec3 = (0.0, 0.0, 0.0)  # a point that does not slip: the middle of the rear axle
    mounting_rad: float = 0.0  # prior of the IMU's yaw and pitch against the direction of travel; 0: aligned
    zero_velocity_mps: float = 0.0  # while the IMU shows rest
    zero_rotation_rps: float = 0.0
    height_mps: float = 0.0  # height hold: vertical velocity in n
    interval_s: float = 0.5

    def __post_init__(self) -> None:
        not_negative(self, "lateral_mps", "vertical_mps", "mounting_rad", "zero_velocity_mps", "zero_rotation_rps", "height_mps")
        positive(self, "interval_s")


@dataclass(frozen=True, slots=True)
class Vehicle:
    """A moving vehicle, or a base station when `fixed_n` gives its antenna's known position.

    A further antenna of a vehicle is a vehicle of its own that names its `carrier`: it has `gnss`, with the lever arm from the
    carrier's body origin, and no state.
    """

    name: str
    imu: ImuStream | None = None
    imu_noise: ImuNoise = ImuNoise()
    gnss: Antenna | None = None
    positions: tuple[PositionStream, ...] = ()
    heights: tuple[HeightStream, ...] = ()
    velocities: tuple[VelocityStream, ...] = ()
    attitudes: tuple[AttitudeStream, ...] = ()
    magnetics: tuple[MagneticStream, ...] = ()
    constraints: Constraints = Constraints()
    imu_calibration: ImuCalibration = ImuCalibration()
    carrier: str | None = None
    motion: MotionPrior = MotionPrior()
    fixed_n: Vec3 | None = None
    truth: Truth | None = None
    heading_hint_rad: float | None = None  # heading at the start, as declared
    heading_sigma_rad: float = HEADING_SIGMA_RAD

    @property
    def sensors(self) -> tuple[Sensor, ...]:
        """All but receiver and IMU."""
        return (*self.positions, *self.heights, *self.velocities, *self.attitudes, *self.magnetics)

    @property
    def motion_times(self) -> tuple[Array, ...]:
        """Times of the sensors that tell how the vehicle moves or is turned, without being positions."""
        told: tuple[Sensor, ...] = (*self.velocities, *self.attitudes, *self.magnetics)
        return tuple(sensor.t_s for sensor in told)

    @property
    def is_fixed(self) -> bool:
        return self.fixed_n is not None


@dataclass(frozen=True, slots=True)
class Link:
    """A pair whose GNSS observations are differenced; baseline = rover - reference."""

    reference: str
    rover: str


@dataclass(frozen=True, slots=True)
class RangeModel:
    """What else a range set estimates: bias [m] and scale [1] per tag pair or one for all."""

    stream: RangeStream
    bias_sigma_m: float = 0.0  # prior; 0: not estimated
    scale_sigma: float = 0.0
    per_pair: bool = False  # of tags
    lever_sigma_m: float = 0.0  # prior of every carried tag's lever arm
    time_sigma_s: float = 0.0  # prior of a time offset of the whole set

    def __post_init__(self) -> None:
        not_negative(self, "bias_sigma_m", "scale_sigma", "lever_sigma_m", "time_sigma_s")


@dataclass(frozen=True, slots=True)
class Robust:
    """M-estimator of one measurement kind; `width` in standard deviations."""

    kernel: Kernel = "huber"
    width: float = 1.345

    def __post_init__(self) -> None:
        positive(self, "width")


@dataclass(frozen=True, slots=True)
class AmbiguitySettings:
    """How integers are fixed."""

    fix: bool = True
    ratio_threshold: float = 3.0
    min_success_rate: float = 0.999  # of the subset that partial fixing keeps
    wide_lanes: bool = False  # differences of two bands' ambiguities are fixed first and held: long baselines, short times
    min_arc_epochs: int = 5
    release_sigma: float = 5.0  # an integer is released when its phase residuals' rms exceeds this many sigma
    hold: Literal["constant", "switchable"] = "constant"  # switchable: a soft constraint that its phases may switch off
    slip_phase_doppler_cyc: float = 3.0  # threshold of the phase-against-Doppler test
    slip_geometry_free_m: float = 0.05
    slip_repair: bool = True  # arcs go on over slips that are known for certain
    slip_success: float = 0.9999  # smallest probability of rounding a slip right that is certain enough
    slip_gap_s: float = 10.0  # longest gap an arc goes on over

    def __post_init__(self) -> None:
        positive(self, "ratio_threshold", "release_sigma", "slip_phase_doppler_cyc", "slip_geometry_free_m", "slip_gap_s")
        if not 0 < self.slip_success < 1:
            raise InputError(f"AmbiguitySettings.slip_success must lie in (0, 1), got {self.slip_success}")
        if not 0 < self.min_success_rate < 1:
            raise InputError(f"AmbiguitySettings.min_success_rate must lie in (0, 1), got {self.min_success_rate}")


@dataclass(frozen=True, slots=True)
class Settings:
    """Choices of the estimation, all with defaults."""

    max_state_interval_s: float = 1.0
    systems: str = "GREJC"  # constellations used, RINEX letters (GLONASS: phases without integers)
    bands: str = "125678"  # RINEX band digits used
    use_absolute: bool = True  # undifferenced code and Doppler in the graph
    # Klobuchar: "broadcast" corrects every observation, "absolute" only undifferenced code, "none" nothing
    ionosphere_model: Literal["broadcast", "absolute", "none"] = "broadcast"
    absolute_code: Literal["single", "ionosphere-free"] = "single"  # of two bands, where a constellation has them
    ionosphere_ppm: float = 2.0  # differential vertical ionosphere per baseline length, standard deviation; 0: none
    ionosphere_min_baseline_m: float = 10_000.0  # shorter links: antenna phase centres, which are not modelled, matter more
    ionosphere_step_s: float = 30.0  # between nodes of each satellite, linear between them
    ionosphere_correlation_s: float = 600.0
    troposphere_mapping: Literal["sine", "niell"] = "sine"  # of the model's delay
    troposphere_ppm: float = 1.0  # differential wet delay of the zenith per baseline length, standard deviation
    troposphere_height_ppm: float = 25.0  # and per difference in height: a third of the model's own
    troposphere_min_baseline_m: float = 10_000.0  # links shorter and more level than these have none
    troposphere_min_height_m: float = 300.0
    troposphere_absolute_m: float = 0.0  # wet delay of single receivers over the model's; 0: none
    troposphere_step_s: float = 120.0
    troposphere_correlation_s: float = 1800.0
    inter_system: Literal["free", "constant"] = "free"  # a receiver clock per constellation, or one and constant biases
    ambiguity: AmbiguitySettings = AmbiguitySettings()
    robust: dict[str, Robust] = field(
        default_factory=lambda: {
            "code": Robust("dcs", 2.5),
            "phase": Robust("huber", 2.5),
            "doppler": Robust("dcs", 2.5),
            "range": Robust("cauchy", 2.0),
            "position": Robust("huber", 2.0),
            "height": Robust("huber", 2.0),
            "velocity": Robust("huber", 2.0),
            "attitude": Robust("huber", 2.0),
            "magnetic": Robust("huber", 2.0),
            "bearing": Robust("huber", 2.0),
            "constraint": Robust("huber", 2.0),
        }
    )
    graduated: bool = False  # approach losses with local minima from convex ones: for bad starts
    graduation_step: float = 1.4  # factor between steps
    max_iterations: int = 50
    tolerance: float = 1e-5  # relative decrease of the cost that counts as converged
    outlier_sigma: float = 4.0  # normalised residuals beyond this are listed
    estimate_noise: NoiseModel | Literal["no"] = "no"  # from the residuals, between float solution and integers

    def __post_init__(self) -> None:
        not_negative(self, "ionosphere_ppm", "troposphere_ppm", "troposphere_height_ppm", "troposphere_absolute_m")
        positive(self, "ionosphere_step_s", "ionosphere_correlation_s", "troposphere_step_s", "troposphere_correlation_s")
        if not self.graduation_step > 1:
            raise InputError(f"Settings.graduation_step must be greater than 1, got {self.graduation_step}")


@dataclass(frozen=True, slots=True)
class NavigationProblem:
    """A flight as estimators see it."""

    name: str
    t0: GpsTime
    frame: LocalFrame
    vehicles: tuple[Vehicle, ...]
    links: tuple[Link, ...] = ()
    ranges: tuple[RangeModel, ...] = ()
    visions: tuple[VisionStream, ...] = ()
    pairs: tuple[Link, ...] = ()  # pairs whose relative solution is wanted; empty: every link, else every pair
    settings: Settings = field(default_factory=Settings)

    def __post_init__(self) -> None:
        names = [v.name for v in self.vehicles]
        doubled = {n for n in names if names.count(n) > 1}
        if doubled:
            raise InputError(f"vehicle names must be distinct; repeated: {', '.join(sorted(doubled))}")
        for link in (*self.links, *self.pairs):
            for end in (link.reference, link.rover):
                if end not in names:
                    raise InputError(f"link {link.reference}-{link.rover}: no vehicle named {end}; there are {', '.join(names)}")
        for v in self.vehicles:
            if v.carrier is not None and (v.carrier not in names or self.vehicle(v.carrier).carrier is not None):
                raise InputError(
                    f"vehicle {v.name}: its carrier {v.carrier} is no vehicle with states; there are {', '.join(names)}"
                )
            if v.carrier is not None and (v.gnss is None or v.imu is not None or v.positions or v.heights or v.is_fixed):
                raise InputError(f"vehicle {v.name}: an antenna that {v.carrier} carries has gnss and no other sensor")
        tags = [tag for model in self.ranges for tag in model.stream.tags]
        tags += [tag for vision in self.visions for tag in (vision.observer, vision.target)]
        for tag in tags:
            if tag.vehicle is not None and tag.vehicle not in names:
                raise InputError(f"tag {tag.name}: no vehicle named {tag.vehicle}; there are {', '.join(names)}")

    @property
    def bodies(self) -> tuple[Vehicle, ...]:
        """The vehicles that have states, or stand still: all but antennas carried by another."""
        return tuple(v for v in self.vehicles if v.carrier is None)

    def vehicle(self, name: str) -> Vehicle:
        return next(v for v in self.vehicles if v.name == name)

    @property
    def wanted_pairs(self) -> tuple[Link, ...]:
        if self.pairs:
            return self.pairs
        if self.links:
            return self.links
        names = [v.name for v in self.vehicles]
        return tuple(Link(a, b) for i, a in enumerate(names) for b in names[i + 1 :])
