"""Scale factors of gyroscope and accelerometer, estimated in flight."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from factorgraph.problem import ImuCalibration, Vehicle
from factorgraph.registry import solve
from tests.factorgraph.test_calibration import changed, errors, flown


@pytest.mark.parametrize("seed", [1, 2])
def test_scale_factors_of_half_a_percent_are_found(seed: int) -> None:
    """Turns tell the gyroscopes', climbs and banks the accelerometer's up axis; the level ones are hardly used."""
    scale = 5e-3 * np.random.default_rng(seed).normal(size=6)

    def change(v: Vehicle) -> Vehicle:
        assert v.imu is not None
        imu = replace(v.imu, w_b=v.imu.w_b * (1 + scale[:3]), f_b=v.imu.f_b * (1 + scale[3:]))
        return replace(v, imu=imu, imu_calibration=ImuCalibration(gyro_scale=0.01, accel_scale=0.01))

    solution = solve(changed(flown("two-uav", seed, 100.0), "follower", change))
    names = [p.name for p in solution.diagnostics.parameters]
    assert names[0] == "follower/accelerometer scale x" and names[5] == "follower/gyroscope scale z"
    _, scaled = errors(solution, np.concatenate([scale[3:], scale[:3]]).tolist())
    assert np.abs(scaled).max() < 4
    sigma = {name: p.sigma for name, p in zip(names, solution.diagnostics.parameters, strict=True)}
    assert max(sigma[f"follower/gyroscope scale {axis}"] for axis in "xyz") < 2e-3
    assert sigma["follower/accelerometer scale z"] < 2e-3
