"""What each vehicle tells of itself: attitude and specific force at the rate of its IMU, and its own filter's position."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from factorgraph.attitude import matrix_from_quat
from factorgraph.errors import InputError
from factorgraph.filters import tightly_coupled
from factorgraph.filters.inertial import ImuModel, InertialStart
from factorgraph.filters.relative.flight import OwnMotion, OwnTrack, attitude_at
from factorgraph.filters.relative.motion import AccelModel
from factorgraph.filters.tightly_coupled import TightSettings
from factorgraph.models.preintegration import sample_means
from factorgraph.models.receivers import Receiver
from factorgraph.problem import NavigationProblem, Vehicle


def own_motions(problem: NavigationProblem, receivers: Mapping[str, Receiver]) -> dict[str, OwnMotion]:
    """Of every moving vehicle with an IMU."""
    return {v.name: own_motion(problem, v, receivers.get(v.name)) for v in problem.bodies if not v.is_fixed and v.imu is not None}


def own_motion(problem: NavigationProblem, vehicle: Vehicle, rx: Receiver | None) -> OwnMotion:
    assert vehicle.imu is not None
    edges, f, w = sample_means(vehicle.imu)
    if not vehicle.attitudes:
        raise InputError(f"vehicle {vehicle.name}: no attitude")
    at = vehicle.attitudes[0]
    C = attitude_at(at.t_s, at.q_nb, 0.5 * (edges[1:] + edges[:-1]))
    n = vehicle.imu_noise
    dt = float(np.median(np.diff(at.t_s)))
    east, north, up = (at.sigma_rad[0] * np.sqrt(dt)).tolist()
    model = AccelModel(
        n.accel_mps2_rthz, n.accel_bias_mps2, 2 * n.accel_bias_mps2**2 / n.accel_bias_walk_mps2_rts**2, (east, north, up)
    )
    track = None
    if rx is not None:
        im = ImuModel(
            n.gyro_rps_rthz,
            n.accel_mps2_rthz,
            n.gyro_bias_rps,
            n.gyro_bias_walk_rps_rts * np.sqrt(1800),
            3600.0,
            n.accel_bias_mps2,
            3600.0,
        )
        r0, v0 = problem.frame.from_ecef(rx.point.r_ecef[0]), problem.frame.rotate_from_ecef(rx.point.v_ecef[0])
        P = np.diag([25.0] * 3 + [0.01] * 3 + [4e-6, 4e-6, 3e-5])
        tr = tightly_coupled.run(
            rx,
            problem.frame,
            InertialStart(r0, v0, matrix_from_quat(at.q_nb[:1])[0], P),
            im,
            TightSettings(code_m=3.0, doppler_mps=0.03),
        )
        track = OwnTrack(tr.t_s, tr.r_n, tr.v_n, tr.P[:, :6, :6])
    return OwnMotion(edges, f, w, C, model, track)
