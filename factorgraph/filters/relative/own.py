"""What each vehicle tells of itself: attitude and specific force at the rate of its IMU, and where its own filter has it.

The attitude is that of the vehicle's attitude system; without one, of the attitude filter `ahrs` of IMU and magnetometer. A
vehicle with a receiver is followed by the filter of 20 states of `tightly_coupled`, which starts from the single-point
solution and that attitude; what it estimates of the accelerometers' errors can be taken off the samples that follow.

Source: spec ahrs_tdo.md, sections 1, 2.1 and 2.3.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from factorgraph.attitude import matrix_from_quat
from factorgraph.errors import InputError
from factorgraph.filters import ahrs, tightly_coupled
from factorgraph.filters.ahrs import AhrsSettings, Aiding
from factorgraph.filters.inertial import INERTIAL, LONGEST_GAP_S, ImuModel
from factorgraph.filters.relative.flight import OwnMotion, OwnTrack, attitude_at
from factorgraph.filters.relative.motion import AccelModel
from factorgraph.filters.tightly_coupled import TightSettings, TightTrack, point_start
from factorgraph.measurements import AttitudeStream
from factorgraph.models.preintegration import sample_means
from factorgraph.models.receivers import Receiver
from factorgraph.problem import ImuNoise, NavigationProblem, Vehicle
from factorgraph.types import Array

UNAIDED, AIDED = AhrsSettings(accel_mps2=1.0), AhrsSettings()  # without velocities, accelerations are not known
VELOCITY_DOP = 2.0  # standard deviation of a velocity component over that of a Doppler
GYRO_MARKOV_S = 3600.0  # over which a walking gyro bias is said to return
ACCEL = slice(INERTIAL["accel_markov"].start - INERTIAL["gyro_constant"].start, None)  # of a track's sensor errors


@dataclass(frozen=True, slots=True)
class OwnSettings:
    """How vehicles are prepared."""

    attitude_s: float = 5.0  # correlation time of an attitude system's errors
    ahrs_s: float = 60.0  # and of the own attitude filter's, which trusts its gyros for about so long
    ahrs: AhrsSettings = UNAIDED
    aided_ahrs: AhrsSettings = AIDED
    use_doppler: bool = True  # in the vehicles' own filters; the source has code alone
    calibrate: bool = False  # take the own filter's accelerometer errors off, as the source does; their steps are no noise


def own_motions(
    problem: NavigationProblem, receivers: Mapping[str, Receiver], settings: OwnSettings | None = None
) -> dict[str, OwnMotion]:
    """Of every moving vehicle with an IMU. Raises InputError where an attitude cannot be had."""
    settings = settings or OwnSettings()
    return {
        v.name: own_motion(problem, v, receivers.get(v.name), settings)
        for v in problem.bodies
        if not v.is_fixed and v.imu is not None
    }


def own_motion(problem: NavigationProblem, vehicle: Vehicle, receiver: Receiver | None, settings: OwnSettings) -> OwnMotion:
    """Of one vehicle. Raises InputError where its attitude cannot be had."""
    assert vehicle.imu is not None
    edges, f, w = sample_means(vehicle.imu)
    attitude, correlation_s = _attitude(problem, vehicle, receiver, settings)
    edges, f, w = _covered(vehicle, edges, f, w, attitude)
    C = attitude_at(attitude.t_s, attitude.q_nb, 0.5 * (edges[1:] + edges[:-1]))
    noise = vehicle.imu_noise
    steady = _steady_sigma(attitude, correlation_s)
    model = AccelModel(noise.accel_mps2_rthz, noise.accel_bias_mps2, _markov_s(noise), steady, correlation_s)
    if receiver is None:
        return OwnMotion(edges, f, w, C, model, None)
    found = _follow(problem, receiver, attitude, np.square(steady), settings)
    if settings.calibrate:
        f = f - _before(edges, found)
    return OwnMotion(edges, f, w, C, model, OwnTrack(found.t_s, found.r_n, found.v_n, found.P[:, :6, :6]))


def _attitude(
    problem: NavigationProblem, vehicle: Vehicle, receiver: Receiver | None, settings: OwnSettings
) -> tuple[AttitudeStream, float]:
    """The attitude system that tells all three angles, or the vehicle's own attitude filter, and how long its errors last."""
    for stream in vehicle.attitudes:
        if np.all(np.isfinite(stream.sigma_rad)) and len(stream.t_s) > 1:
            return stream, settings.attitude_s
    assert vehicle.imu is not None
    magnetics = vehicle.magnetics[0] if vehicle.magnetics else None
    heading = None if vehicle.heading_hint_rad is None else (vehicle.heading_hint_rad, vehicle.heading_sigma_rad)
    if magnetics is None and heading is None:
        raise InputError(
            f"vehicle {vehicle.name}: nothing tells its heading; declare an attitude system, a magnetometer or heading_hint_deg"
        )
    aiding = None if receiver is None else _aiding(problem, receiver)
    tuned = settings.ahrs if aiding is None else settings.aided_ahrs
    track = ahrs.run(vehicle.imu, vehicle.imu_noise, problem.frame, magnetics, aiding, tuned, heading)
    return track.stream(settings.ahrs_s), settings.ahrs_s


def _covered(vehicle: Vehicle, edges: Array, f: Array, w: Array, attitude: AttitudeStream) -> tuple[Array, Array, Array]:
    """The samples of an IMU between the first and the last attitude. Raises InputError where attitudes are missing in between."""
    step = np.diff(attitude.t_s)
    gap = int(np.argmax(step))
    if step[gap] > LONGEST_GAP_S:
        raise InputError(
            f"vehicle {vehicle.name}: its attitudes {attitude.name} are missing from {attitude.t_s[gap]:.3f} to "
            f"{attitude.t_s[gap + 1]:.3f} s; the relative filter bridges {LONGEST_GAP_S:g} s"
        )
    usual = float(np.median(step))
    inside = (edges[:-1] >= attitude.t_s[0] - usual) & (edges[1:] <= attitude.t_s[-1] + usual)
    kept = np.flatnonzero(inside)
    if not len(kept):
        raise InputError(
            f"vehicle {vehicle.name}: its IMU runs from {edges[0]:.1f} to {edges[-1]:.1f} s, its attitudes {attitude.name} from "
            f"{attitude.t_s[0]:.1f} to {attitude.t_s[-1]:.1f} s; check time systems and offsets"
        )
    return edges[kept[0] : kept[-1] + 2], f[kept[0] : kept[-1] + 1], w[kept[0] : kept[-1] + 1]


def _aiding(problem: NavigationProblem, receiver: Receiver) -> Aiding | None:
    """Single-point positions and velocities, for the attitude filter."""
    point, t_s = receiver.point, receiver.antenna.stream.t_s - receiver.clock_s
    known = np.isfinite(point.r_ecef[:, 0]) & np.isfinite(point.v_ecef[:, 0])
    if np.sum(known) < 2:
        return None
    frame = problem.frame
    sigma = VELOCITY_DOP * receiver.antenna.noise.doppler_mps
    return Aiding(t_s[known], frame.from_ecef(point.r_ecef[known]), frame.rotate_from_ecef(point.v_ecef[known]), sigma)


def _steady_sigma(attitude: AttitudeStream, correlation_s: float) -> tuple[float, float, float]:
    """Standard deviations of one attitude about east, north and up, of told ones that count correlated samples once."""
    samples = max(1.0, 2.0 * correlation_s / float(np.median(np.diff(attitude.t_s))))
    east, north, up = (np.median(attitude.sigma_rad, axis=0) / np.sqrt(samples)).tolist()
    return east, north, up


def _markov_s(noise: ImuNoise) -> float:
    """Correlation time of an accelerometer bias whose walk and steady standard deviation are told."""
    return 2.0 * (noise.accel_bias_mps2 / noise.accel_bias_walk_mps2_rts) ** 2


def _follow(
    problem: NavigationProblem, receiver: Receiver, attitude: AttitudeStream, variance: Array, settings: OwnSettings
) -> TightTrack:
    """The vehicle's own filter over the whole flight; variance (3,) of the attitude it starts from."""
    imu, gnss = receiver.vehicle.imu_noise, receiver.antenna.noise
    model = ImuModel(
        gyro_rps_rthz=imu.gyro_rps_rthz,
        accel_mps2_rthz=imu.accel_mps2_rthz,
        gyro_constant_rps=imu.gyro_bias_rps,
        gyro_markov_rps=imu.gyro_bias_walk_rps_rts * float(np.sqrt(GYRO_MARKOV_S / 2)),
        gyro_markov_s=GYRO_MARKOV_S,
        accel_markov_mps2=imu.accel_bias_mps2,
        accel_markov_s=_markov_s(imu),
    )
    tight = TightSettings(
        code_m=gnss.absolute_code_m, doppler_mps=gnss.doppler_mps, elevation=gnss.elevation, use_doppler=settings.use_doppler
    )
    at = min(int(np.searchsorted(attitude.t_s, receiver.antenna.stream.t_s[0])), len(attitude.t_s) - 1)
    start = point_start(receiver, problem.frame, matrix_from_quat(attitude.q_nb[at : at + 1])[0], np.diag(variance))
    return tightly_coupled.run(receiver, problem.frame, start, model, tight)


def _before(edges: Array, track: TightTrack) -> Array:
    """Accelerometer errors (n, 3) as the own filter had them before each sample; zero before its first epoch."""
    last = np.searchsorted(track.t_s, edges[:-1] + 1e-6) - 1
    return np.where((last >= 0)[:, None], track.sensors[np.maximum(last, 0), ACCEL], 0.0)
