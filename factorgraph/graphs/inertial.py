"""What connects a vehicle's states in time: native IMU factors, or a continuous-time motion prior.

GTSAM adds Coriolis and centrifugal terms of the position relative to the frame's origin; gravity of every interval is
therefore gravitation at its middle plus the centrifugal acceleration of the origin.

An interval that IMU samples are missing from keeps its factor, with noise that leaves the vehicle all but free.

The motion prior is white noise on acceleration (constant velocity in the mean), exact between states:

    r_1 - r_0 - v_0 dt ~ , v_1 - v_0 ~ N(0, q [dt^3/3 dt^2/2; dt^2/2 dt]).   Source: Barfoot (2017), sec. 3.4.
"""

from __future__ import annotations

import gtsam
import numpy as np

from factorgraph.graphs.variables import VehicleVariables, key
from factorgraph.models.preintegration import crossing, gtsam_inputs
from factorgraph.types import Array

GAP_GYRO, GAP_ACCEL = 0.3, 10.0  # rad/s and m/s^2 per sqrt(Hz)
INTEGRATION_SIGMA_M = 3e-4  # per sqrt(s): keeps the position pivots of the Cholesky elimination well conditioned


def add_imu_factors(graph: gtsam.NonlinearFactorGraph, vehicle: VehicleVariables) -> None:
    """One CombinedImuFactor per grid interval, preintegrated at the vehicle's current bias."""
    noise = vehicle.vehicle.imu_noise
    t, K = vehicle.t_s, len(vehicle.t_s)
    vehicle.preintegrated_bias = vehicle.bias.copy()
    inputs = gtsam_inputs(vehicle.imu, t[:-1], t[1:], vehicle.bias[:-1])
    missing = crossing(vehicle.gaps_s, t[:-1], t[1:])
    middle = vehicle.r[:-1] + 0.5 * vehicle.v[:-1] * np.diff(t)[:, None]
    gravity = vehicle.frame.gravitation(middle) + vehicle.origin_centrifugal()
    w_ie, eye = vehicle.frame.w_ie_n, np.eye(3)
    gyro, accel = eye * noise.gyro_rps_rthz**2, eye * noise.accel_mps2_rthz**2
    gyro_walk, accel_walk = eye * noise.gyro_bias_walk_rps_rts**2, eye * noise.accel_bias_walk_mps2_rts**2
    for k in range(K - 1):
        params = gtsam.PreintegrationCombinedParams(gravity[k])
        params.setOmegaCoriolis(w_ie)
        params.setGyroscopeCovariance(eye * GAP_GYRO**2 if missing[k] else gyro)
        params.setAccelerometerCovariance(eye * GAP_ACCEL**2 if missing[k] else accel)
        params.setIntegrationCovariance(eye * INTEGRATION_SIGMA_M**2)
        params.setBiasOmegaCovariance(gyro_walk)
        params.setBiasAccCovariance(accel_walk)
        bias = gtsam.imuBias.ConstantBias(vehicle.bias[k, 3:], vehicle.bias[k, :3])
        pim = gtsam.PreintegratedCombinedMeasurements(params, bias)
        for i in range(inputs.first[k], inputs.first[k + 1]):
            pim.integrateMeasurement(inputs.f_b[i], inputs.w_b[i], inputs.dt_s[i])
        a, b = vehicle.keys(k), vehicle.keys(k + 1)
        graph.add(gtsam.CombinedImuFactor(a[0], a[1], b[0], b[1], a[2], b[2], pim))


def add_priors(graph: gtsam.NonlinearFactorGraph, vehicle: VehicleVariables, heading_sigma_rad: float) -> None:
    """Weak priors on the first state that make the problem determinate, and the bias prior of the IMU's grade."""
    sigmas = gtsam.noiseModel.Diagonal.Sigmas
    if vehicle.mode == "imu":
        noise = vehicle.vehicle.imu_noise
        x, v, b = vehicle.keys(0)
        pose = gtsam.Pose3(gtsam.Rot3(vehicle.R[0]), vehicle.r[0])
        graph.add(gtsam.PriorFactorPose3(x, pose, sigmas(np.array([1.0, 1.0, heading_sigma_rad, 1e3, 1e3, 1e3]))))
        graph.add(gtsam.PriorFactorVector(v, vehicle.v[0], sigmas(np.full(3, 100.0))))
        bias = np.array([noise.accel_bias_mps2] * 3 + [noise.gyro_bias_rps] * 3)
        graph.add(gtsam.PriorFactorConstantBias(b, gtsam.imuBias.ConstantBias(), sigmas(bias)))
    elif vehicle.mode == "motion":
        p, v = vehicle.keys(0)
        graph.add(gtsam.PriorFactorVector(p, vehicle.r[0], sigmas(np.full(3, 1e3))))
        graph.add(gtsam.PriorFactorVector(v, vehicle.v[0], sigmas(np.full(3, 100.0))))


def motion_prior_rows(vehicle: VehicleVariables) -> tuple[Array, Array]:
    """Whitening (K - 1, 6, 6) and Jacobians (K - 1, 6, 12) of the motion prior, rows (position 3, velocity 3)."""
    dt = np.diff(vehicle.t_s)
    q = np.asarray(vehicle.vehicle.motion.accel_mps2_rthz) ** 2
    n = len(dt)
    J = np.zeros((n, 6, 12))
    eye = np.eye(3)
    J[:, :3, :3], J[:, :3, 3:6], J[:, :3, 6:9] = -eye, -eye * dt[:, None, None], eye
    J[:, 3:, 3:6], J[:, 3:, 9:] = -eye, eye
    Q = np.zeros((n, 6, 6))
    diagonal = np.diag(q)
    Q[:, :3, :3] = diagonal * (dt**3 / 3)[:, None, None]
    Q[:, :3, 3:] = Q[:, 3:, :3] = diagonal * (dt**2 / 2)[:, None, None]
    Q[:, 3:, 3:] = diagonal * dt[:, None, None]
    return np.linalg.inv(np.linalg.cholesky(Q)), J


def motion_keys(vehicle: VehicleVariables, k: int) -> tuple[int, int, int, int]:
    return (
        key("p", vehicle.index, k),
        key("v", vehicle.index, k),
        key("p", vehicle.index, k + 1),
        key("v", vehicle.index, k + 1),
    )
