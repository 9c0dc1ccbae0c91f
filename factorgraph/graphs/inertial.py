"""Priors of a vehicle's first state, and the continuous-time motion prior that connects its states where it has no IMU.

The motion prior is white noise on acceleration (constant velocity in the mean), exact between states:

    r_1 - r_0 - v_0 dt ~ , v_1 - v_0 ~ N(0, q [dt^3/3 dt^2/2; dt^2/2 dt]).   Source: Barfoot (2017), sec. 3.4.
"""

from __future__ import annotations

import gtsam
import numpy as np

from factorgraph.graphs.variables import VehicleVariables, key
from factorgraph.types import Array


def add_priors(graph: gtsam.NonlinearFactorGraph, vehicle: VehicleVariables) -> None:
    """Priors on the first state: attitude as alignment knows it, the rest weak; and the bias prior of the IMU's grade."""
    sigmas = gtsam.noiseModel.Diagonal.Sigmas
    if vehicle.mode == "imu":
        noise = vehicle.vehicle.imu_noise
        x, v, b = vehicle.keys(0)
        C_nb, sigma_rad = vehicle.attitude_prior
        pose = gtsam.Pose3(gtsam.Rot3(C_nb), vehicle.r[0])
        P = np.diag([0.0] * 3 + [1e6] * 3)
        P[:3, :3] = C_nb.T @ np.diag(sigma_rad**2) @ C_nb
        graph.add(gtsam.PriorFactorPose3(x, pose, gtsam.noiseModel.Gaussian.Covariance(P)))
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
