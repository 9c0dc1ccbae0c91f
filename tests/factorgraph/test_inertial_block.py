"""The vectorised IMU block against GTSAM's CombinedImuFactor, central differences, and simulated scale factors."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest

from factorgraph.assembly.inertial_block import GAP_ACCEL, ImuBlock, imu_block
from factorgraph.assembly.parameters import Parameters
from factorgraph.assembly.variables import VehicleVariables
from factorgraph.attitude import exp_so3
from factorgraph.geodesy import LocalFrame
from factorgraph.measurements import ImuStream
from factorgraph.models import imu_interval
from factorgraph.problem import ImuCalibration, Vehicle
from factorgraph.types import Array
from tests.factorgraph.native_imu import add_imu_factors, insert_states
from tests.factorgraph.test_preintegration import BIAS, moving_vehicle, rough_imu

GRID = np.array([0.11, 0.61, 1.06, 1.11])
FRAME = LocalFrame(np.deg2rad(40.0), np.deg2rad(-3.0), 500.0)


def rough_vehicle(seed: int, far: float, calibration: ImuCalibration | None = None) -> VehicleVariables:
    """States near what hard manoeuvring predicts, off by `far` radians, decimetres and decimetres per second."""
    rng = np.random.default_rng(seed)
    v = VehicleVariables(0, Vehicle("a", imu=rough_imu(seed), imu_calibration=calibration or ImuCalibration()), GRID, FRAME)
    v.bias[:] = BIAS * rng.normal(1, 0.3, 6)
    v.preintegrated_bias = v.bias.copy()
    v.R[0], v.r[0], v.v[0] = exp_so3(rng.normal(0, 1, 3)), rng.normal(0, 3000, 3), rng.normal(0, 30, 3)
    graph = gtsam.NonlinearFactorGraph()
    v.r[:], v.v[:] = v.r[0], v.v[0]
    add_imu_factors(graph, v)
    for k in range(len(GRID) - 1):
        state = gtsam.NavState(gtsam.Rot3(v.R[k]), v.r[k], v.v[k])
        bias = gtsam.imuBias.ConstantBias(v.bias[k, 3:], v.bias[k, :3])
        end = graph.at(k).preintegratedMeasurements().predict(state, bias)  # type: ignore[attr-defined]
        v.R[k + 1] = end.attitude().matrix() @ exp_so3(far * rng.normal(0, 1, 3))
        v.r[k + 1], v.v[k + 1] = end.position() + far * rng.normal(0, 1, 3), end.velocity() + far * rng.normal(0, 1, 3)
    return v


def native(v: VehicleVariables, rotating: bool) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    add_imu_factors(graph, v, rotating)
    return graph, values


def block_of(v: VehicleVariables) -> ImuBlock:
    block = imu_block(v, Parameters())
    assert block is not None
    return block


def unwhitened(block: ImuBlock, k: int) -> tuple[Array, Array]:
    L = np.linalg.inv(block.intervals.whitening[k])
    rows = slice(15 * k, 15 * k + 15)
    return L @ -block.y[rows], L @ block.J[rows]


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("far", [0.0, 1e-3, 0.3])
def test_residuals_and_jacobians_are_gtsams(seed: int, far: float) -> None:
    """Earth rate included, biases moved from those preintegrated at; 1e-9 of the largest entry."""
    v = rough_vehicle(seed, far)
    block = block_of(v)
    graph, values = native(v, rotating=True)
    v.bias += np.random.default_rng(seed).normal(0, 0.01, v.bias.shape)
    insert_states(values, v)
    block.predict()
    for k in range(len(GRID) - 1):
        factor = graph.at(k)
        e, J = unwhitened(block, k)
        np.testing.assert_allclose(e, factor.unwhitenedError(values), atol=1e-9)  # type: ignore[attr-defined]
        A, b = factor.linearize(values).jacobian()
        keys = list(factor.linearize(values).keys())
        edges = np.cumsum([0, *({"x": 6, "v": 3, "b": 6}[chr(gtsam.symbolChr(key))] for key in keys)])
        A = np.hstack([A[:, edges[keys.index(key)] : edges[keys.index(key) + 1]] for key in block.keys(k)])
        R = factor.noiseModel().R()  # type: ignore[attr-defined]
        raw = np.linalg.solve(R, A)
        np.testing.assert_allclose(J, raw, atol=1e-9 * np.abs(raw).max())
        np.testing.assert_allclose(np.linalg.solve(R, b), -e, atol=1e-9)


@pytest.mark.parametrize("seed", range(4))
def test_information_is_gtsams(seed: int) -> None:
    """To rounding without the Earth rate, whose turn of the position noise GTSAM adds: with it to 1e-4."""
    for rotating, tolerance in ((False, 1e-10), (True, 2e-4)):
        v = rough_vehicle(seed, 1e-3)
        graph, _ = native(v, rotating)
        block = block_of(v)
        for k in range(len(GRID) - 1):
            L, R = block.intervals.whitening[k], graph.at(k).noiseModel().R()  # type: ignore[attr-defined]
            mine, theirs = L.T @ L, R.T @ R
            scale = np.sqrt(np.diag(theirs))
            np.testing.assert_allclose(mine / np.outer(scale, scale), theirs / np.outer(scale, scale), atol=tolerance)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("far", [1e-4, 0.2, 1.0])
def test_jacobians_by_central_differences(seed: int, far: float) -> None:
    """All columns of the first interval, scale factors too, near and far from the optimum."""
    calibration = ImuCalibration(gyro_scale=0.01, accel_scale=0.01)
    v = rough_vehicle(seed, far, calibration)
    block = block_of(v)
    assert v.accel_scale is not None and v.gyro_scale is not None

    def residual(column: int, step: float) -> Array:
        w = VehicleVariables(0, v.vehicle, GRID, FRAME)
        w.R, w.r, w.v, w.bias, w.preintegrated_bias = v.R.copy(), v.r.copy(), v.v.copy(), v.bias.copy(), v.preintegrated_bias
        k, c = (column // 15, column % 15) if column < 30 else (2, column - 30)
        d = step * np.eye(3)[c % 3]
        scales = [np.zeros(3), np.zeros(3)]
        if k == 2:
            scales[c // 3] = d
        elif c < 3:
            w.R[k] = w.R[k] @ exp_so3(d)
        elif c < 6:
            w.r[k] = w.r[k] + w.R[k] @ d
        elif c < 9:
            w.v[k] = w.v[k] + d
        else:
            w.bias[k, 3:] += d if c < 12 else 0.0
            w.bias[k, :3] += d if c >= 12 else 0.0
        e, _ = imu_interval.evaluate(
            block.intervals,
            imu_interval.States(w.R, w.r, w.v),
            w.bias,
            block.at_bias,
            block.gravitation_n,
            FRAME.w_ie_n,
            np.concatenate(scales[::-1]),
        )
        return np.asarray(np.linalg.solve(block.intervals.whitening[0], e[0]))

    block.predict()
    _, J = unwhitened(block, 0)
    for column in range(36):
        step = 1e-5
        numeric = (residual(column, step) - residual(column, -step)) / (2 * step)
        np.testing.assert_allclose(J[:, column], numeric, atol=3e-7 * max(1.0, np.abs(J[:, column]).max()), err_msg=str(column))


@pytest.mark.parametrize("seed", range(3))
def test_increments_follow_biases_and_scale_factors(seed: int) -> None:
    """To first order as preintegrating again says, for samples that show scale times truth plus bias."""
    v = rough_vehicle(seed, 0.0, ImuCalibration(gyro_scale=0.01, accel_scale=0.01))
    scale = np.array([2e-3, -1e-3, 3e-3, -2e-3, 1e-3, 2e-3])
    assert v.vehicle.imu is not None
    gone = ImuStream(v.vehicle.imu.t_s, v.imu.f_b / (1 + scale[3:]), v.imu.w_b / (1 + scale[:3]), True)
    block = block_of(v)
    again = VehicleVariables(0, Vehicle("a", imu=gone), GRID, FRAME)
    again.r[:], again.v[:] = v.r, v.v
    again.preintegrated_bias = v.preintegrated_bias + 1e-3
    other = block_of(again)
    by = block.intervals.zeta + np.einsum("nac,c->na", block.intervals.by_bias, np.full(6, 1e-3))
    by = by + np.einsum("nac,c->na", block.intervals.by_scale, np.concatenate([scale[3:], scale[:3]]))
    moved = np.abs(other.intervals.zeta - block.intervals.zeta).max()
    assert moved > 3e-3
    # means over tens of milliseconds of rates and forces that are white noise: their products are lost
    np.testing.assert_allclose(by, other.intervals.zeta, atol=0.05 * moved)


def test_the_truth_satisfies_the_block() -> None:
    """Noise-free at 100 m/s, turning and climbing: less than 0.1 of weighted squares over twenty intervals."""
    v = moving_vehicle(np.arange(21.0), bias=BIAS)
    v.preintegrated_bias = v.bias.copy()
    block = block_of(v)
    block.predict()
    assert block.cost({}) < 0.1
    v.r[5] += [0.0, 0.05, 0.0]
    block.predict()
    assert block.cost({}) > 10


def test_gaps_leave_the_vehicle_all_but_free() -> None:
    imu = rough_imu(1, n=1200)
    keep = (imu.t_s <= 1.2) | (imu.t_s >= 2.8)
    v = VehicleVariables(0, Vehicle("a", imu=ImuStream(imu.t_s[keep], imu.f_b[keep], imu.w_b[keep], True)), np.arange(5.0), FRAME)
    L = block_of(v).intervals.whitening
    sigma = np.sqrt(np.diagonal(np.linalg.inv(np.swapaxes(L, 1, 2) @ L), axis1=1, axis2=2))
    assert np.all(sigma[1:3, 6:9] > 0.5 * GAP_ACCEL) and np.all(sigma[[0, 3], 6:9] < 0.1)


def test_only_the_scale_factors_asked_for_have_columns() -> None:
    accel, gyro = ImuCalibration(accel_scale=0.01), ImuCalibration(gyro_scale=0.01)
    for calibration, columns in ((accel, range(30, 33)), (gyro, range(33, 36))):
        full, part = (rough_vehicle(2, 1e-2, c) for c in (ImuCalibration(0.0, 0.01, 0.01), calibration))
        a, b = block_of(full), block_of(part)
        a.predict()
        b.predict()
        assert b.widths() == (6, 3, 6, 6, 3, 6, 3) and len(b.keys(0)) == 7
        np.testing.assert_array_equal(b.J, a.J[:, [*range(30), *columns]])


def test_applied_scale_factors_change_the_stream_once() -> None:
    v = rough_vehicle(3, 0.0, ImuCalibration(gyro_scale=0.01, accel_scale=0.01))
    block_of(v)
    assert v.gyro_scale is not None and v.accel_scale is not None
    raw = v.imu
    v.gyro_scale.value, v.accel_scale.value = np.full(3, 0.01), np.full(3, -0.02)
    for _ in range(2):
        v.apply_imu_calibration()
        np.testing.assert_allclose(v.imu.w_b * 1.01, raw.w_b)
        np.testing.assert_allclose(v.imu.f_b * 0.98, raw.f_b)
        np.testing.assert_array_equal(v.applied_scale, [0.01] * 3 + [-0.02] * 3)
