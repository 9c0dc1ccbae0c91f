"""GTSAM's own IMU factors for a vehicle: what the vectorised block is compared with."""

from __future__ import annotations

import gtsam
import numpy as np

from factorgraph.assembly.inertial_block import INTEGRATION_SIGMA_M
from factorgraph.assembly.variables import VehicleVariables
from factorgraph.models.preintegration import grouped_inputs


def add_imu_factors(graph: gtsam.NonlinearFactorGraph, vehicle: VehicleVariables, rotating: bool = True) -> None:
    """One CombinedImuFactor per grid interval, preintegrated at the vehicle's current bias."""
    noise = vehicle.vehicle.imu_noise
    t, K = vehicle.t_s, len(vehicle.t_s)
    vehicle.preintegrated_bias = vehicle.bias.copy()
    inputs = grouped_inputs(vehicle.imu, t[:-1], t[1:], vehicle.bias[:-1])
    middle = vehicle.r[:-1] + 0.5 * vehicle.v[:-1] * np.diff(t)[:, None]
    gravity = vehicle.frame.gravitation(middle) + vehicle.origin_centrifugal()
    eye = np.eye(3)
    for k in range(K - 1):
        params = gtsam.PreintegrationCombinedParams(gravity[k])
        if rotating:
            params.setOmegaCoriolis(vehicle.frame.w_ie_n)
        params.setGyroscopeCovariance(eye * noise.gyro_rps_rthz**2)
        params.setAccelerometerCovariance(eye * noise.accel_mps2_rthz**2)
        params.setIntegrationCovariance(eye * INTEGRATION_SIGMA_M**2)
        params.setBiasOmegaCovariance(eye * noise.gyro_bias_walk_rps_rts**2)
        params.setBiasAccCovariance(eye * noise.accel_bias_walk_mps2_rts**2)
        bias = gtsam.imuBias.ConstantBias(vehicle.bias[k, 3:], vehicle.bias[k, :3])
        pim = gtsam.PreintegratedCombinedMeasurements(params, bias)
        for i in range(inputs.first[k], inputs.first[k + 1]):
            pim.integrateMeasurement(inputs.f_b[i], inputs.w_b[i], inputs.dt_s[i])
        a, b = vehicle.keys(k), vehicle.keys(k + 1)
        graph.add(gtsam.CombinedImuFactor(a[0], a[1], b[0], b[1], a[2], b[2], pim))


def insert_states(values: gtsam.Values, v: VehicleVariables) -> None:
    """A vehicle's states as GTSAM has them."""
    for k in range(len(v.t_s)):
        pose, velocity, bias = v.keys(k)
        values.insert(pose, gtsam.Pose3(gtsam.Rot3(v.R[k]), v.r[k]))
        values.insert(velocity, v.v[k])
        values.insert(bias, gtsam.imuBias.ConstantBias(v.bias[k, 3:], v.bias[k, :3]))
