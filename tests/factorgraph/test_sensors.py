"""Blocks of odometers, attitude systems, magnetometers, cameras and constraints: Jacobians, and what their rows mean."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from factorgraph.assembly.barometer import BarometerBlock
from factorgraph.assembly.blocks import Block
from factorgraph.assembly.build import position_blocks
from factorgraph.assembly.constraints import constraint_blocks
from factorgraph.assembly.parameters import Parameters
from factorgraph.assembly.sensors import HeadingBlock, sensor_blocks
from factorgraph.assembly.variables import VehicleVariables
from factorgraph.attitude import exp_so3, matrix_from_euler, quat_from_matrix, right_jacobian, right_jacobian_inverse
from factorgraph.errors import InputError
from factorgraph.gpstime import GpsTime
from factorgraph.measurements import (
    AttitudeStream,
    Calibration,
    HeightStream,
    MagneticStream,
    PositionStream,
    Tag,
    VelocityStream,
    VisionStream,
)
from factorgraph.problem import Constraints, ImuCalibration, NavigationProblem, Vehicle
from factorgraph.types import Array
from tests.factorgraph.synthetic import FRAME
from tests.factorgraph.test_blocks import CARRIED, GRID, LEVER, assert_jacobians, evaluated, letter_of, variables
from tests.factorgraph.test_blocks import vehicle as bare_vehicle

STEP = {"x": (1e-4, 1e-3), "p": (1e-2,), "v": (1e-2,), "b": (1e-2, 1e-4), "s": (1e-4,), "l": (1e-4,), "c": (1e-4,)}
EXACT = 1e-6
FIELD_N = (2.0, 21.0, -43.0)


def times(where: str) -> Array:
    return GRID[:-1] if where == "at states" else np.sort(np.random.default_rng(5).uniform(0.2, 3.8, 7))


def vehicle(**sensors: object) -> Vehicle:
    plain = replace(bare_vehicle("a", "imu", 0.0), gnss=None, positions=(), heights=())
    return replace(plain, **sensors)  # type: ignore[arg-type]


def graph_of(
    first: Vehicle, others: tuple[Vehicle, ...] = (), **more: object
) -> tuple[NavigationProblem, dict[str, VehicleVariables]]:
    vehicles = (first, *others)
    problem = NavigationProblem("sensors", GpsTime(2300, 0.0), FRAME, vehicles, **more)  # type: ignore[arg-type]
    return problem, {v.name: variables(i, v) for i, v in enumerate(vehicles)}


def check(
    problem: NavigationProblem, ends: dict[str, VehicleVariables], tolerance: float, build: object = sensor_blocks
) -> list[Block]:
    """All blocks of a problem with their parameters off their priors, Jacobians compared; returns the blocks."""
    parameters = Parameters()
    blocks = build(problem, ends, parameters)  # type: ignore[operator]
    rng = np.random.default_rng(11)
    for p in parameters:
        p.value = p.value + rng.normal(0.0, 0.3, len(p.value)) * p.sigma
    graph = evaluated(ends, blocks, parameters)
    for block in blocks:
        assert_jacobians(graph, block, STEP, tolerance)
    return list(blocks)


def random_rotations(n: int) -> Array:
    return quat_from_matrix(exp_so3(np.random.default_rng(8).normal(0, 1, (n, 3))))


def test_right_jacobians_are_derivatives_and_inverses() -> None:
    rng = np.random.default_rng(0)
    phi = np.concatenate([rng.normal(0, 1.0, (20, 3)), rng.normal(0, 1e-5, (5, 3)), np.zeros((1, 3))])
    d = 1e-6 * rng.normal(0, 1, phi.shape)
    moved = exp_so3(phi) @ exp_so3(np.einsum("nij,nj->ni", right_jacobian(phi), d))
    np.testing.assert_allclose(moved, exp_so3(phi + d), atol=1e-11)
    unit = right_jacobian(phi) @ right_jacobian_inverse(phi)
    np.testing.assert_allclose(unit, np.broadcast_to(np.eye(3), unit.shape), atol=1e-9)


@pytest.mark.parametrize("where", ["at states", "between"])
@pytest.mark.parametrize("calibrated", [False, True])
def test_odometer(where: str, calibrated: bool) -> None:
    """Forward only, and all three axes; scale, mounting, lever arm and time offset estimated beside it."""
    t = times(where)
    v_b = np.random.default_rng(2).normal(5.0, 3.0, (len(t), 3))
    v_b[::2, [0, 2]] = np.nan
    calibration = Calibration(lever_m=0.3, time_s=0.0, scale=0.05, mounting_rad=0.2) if calibrated else Calibration()
    stream = VelocityStream(t, v_b, np.full((len(t), 3), 0.1), LEVER["a"], calibration=calibration)
    (block,) = check(*graph_of(vehicle(velocities=(stream,))), 5e-5 if where == "at states" else CARRIED)
    assert block.n == len(t) + 2 * (len(t) // 2)
    letters = {letter_of(k) for k in block.keys(0)}
    assert ({"c", "l"} <= letters) == calibrated


@pytest.mark.parametrize("where", ["at states", "between"])
@pytest.mark.parametrize("mounting_rad", [0.0, 0.3])
def test_attitude(where: str, mounting_rad: float) -> None:
    t = times(where)
    sigma = np.full((len(t), 3), 0.02)
    sigma[1, :2] = np.inf  # tells the heading alone
    sigma[2, 2] = np.inf  # tells roll and pitch alone
    stream = AttitudeStream(t, random_rotations(len(t)), sigma, calibration=Calibration(mounting_rad=mounting_rad))
    tilt, heading = check(*graph_of(vehicle(attitudes=(stream,))), EXACT)
    assert tilt.n == 3 * (len(t) - 1) - 1 and heading.n == 1 and isinstance(heading, HeadingBlock)


@pytest.mark.parametrize("where", ["at states", "between"])
def test_magnetometer(where: str) -> None:
    t = times(where)
    m_b = np.random.default_rng(2).normal(0.0, 30.0, (len(t), 3))
    calibration = Calibration(bias=10.0, mounting_rad=0.1)
    stream = MagneticStream(t, m_b, np.full((len(t), 3), 0.5), FIELD_N, calibration=calibration)
    (block,) = check(*graph_of(vehicle(magnetics=(stream,))), EXACT)
    assert block.n == 3 * len(t)


@pytest.mark.parametrize("where", ["at states", "between"])
@pytest.mark.parametrize("target", ["vehicle with IMU", "vehicle without", "base", "landmark"])
def test_vision(where: str, target: str) -> None:
    t = times(where)
    mode = {"vehicle with IMU": "imu", "vehicle without": "motion", "base": "fixed"}.get(target)
    other = () if mode is None else (replace(bare_vehicle("b", mode, 0.0), positions=(), heights=()),)
    tag = Tag("lamp", position_n=(5.0, 40.0, 3.0)) if mode is None else Tag("lamp", "b", LEVER["b"])
    rng = np.random.default_rng(4)
    azimuth, elevation, range_m = rng.uniform(-3, 3, len(t)), rng.uniform(-1, 1, len(t)), rng.uniform(20, 60, len(t))
    range_m[::2] = np.nan
    stream = VisionStream(
        t,
        Tag("camera", "a", LEVER["a"]),
        tag,
        azimuth,
        elevation,
        range_m,
        np.full(len(t), 0.01),
        np.full(len(t), 0.5),
        calibration=Calibration(mounting_rad=0.1),
    )
    (block,) = check(*graph_of(vehicle(), other, visions=(stream,)), CARRIED if where == "between" else 5e-6)
    assert block.n == 2 * len(t) + len(t) // 2


@pytest.mark.parametrize("offset_s", [0.0, 0.4])
@pytest.mark.parametrize("mode", ["imu", "motion"])
def test_velocities_of_fixes(mode: str, offset_s: float) -> None:
    t = GRID[:-1] + offset_s
    rng = np.random.default_rng(3)
    v_n = rng.normal(0, 8, (4, 3))
    v_n[1] = np.nan
    stream = PositionStream(t, rng.normal(0, 9, (4, 3)), np.ones((4, 3)), LEVER["b"], "rtk", v_n, np.full((4, 3), 0.05))
    alone = replace(bare_vehicle("b", mode, 0.0), gnss=None, positions=(stream,), heights=())
    (block,) = check(*graph_of(alone), 5e-5 if offset_s == 0 else CARRIED)
    assert block.n == 9


def test_time_offsets_turn_and_move() -> None:
    """An odometer whose tags are late: the derivative follows rate and acceleration, lever arm zero."""
    t = times("between")
    stream = VelocityStream(
        t, np.full((len(t), 3), 5.0), np.full((len(t), 3), 0.1), calibration=Calibration(time_s=1e-3, scale=0.01)
    )
    attitude = AttitudeStream(t, random_rotations(len(t)), np.full((len(t), 3), 0.02), calibration=Calibration(time_s=1e-3))
    check(*graph_of(vehicle(velocities=(stream,), attitudes=(attitude,))), CARRIED)


def test_imu_time_offset_reaches_the_attitude() -> None:
    t = times("between")
    attitude = AttitudeStream(t, random_rotations(len(t)), np.full((len(t), 3), 0.02))
    problem, ends = graph_of(vehicle(attitudes=(attitude,), imu_calibration=ImuCalibration(time_s=1e-3)))
    parameters = Parameters()
    ends["a"].imu_offset = parameters.scalar("a/imu time offset", "s", 1e-3)
    blocks = sensor_blocks(problem, ends, parameters)
    graph = evaluated(ends, blocks, parameters)
    assert_jacobians(graph, blocks[0], STEP, CARRIED)


@pytest.mark.parametrize("mode", ["imu", "motion"])
def test_barometer(mode: str) -> None:
    """Heights at odd times, a node every second, factors that see two nodes each, and the walk between nodes."""
    t = np.sort(np.random.default_rng(5).uniform(0.1, 3.9, 20))
    walking = Calibration(bias=5.0, bias_walk=0.5)
    stream = HeightStream(t, np.random.default_rng(6).normal(20, 3, 20), np.full(20, 0.3), LEVER["a"], "barometer", walking)
    plain = replace(bare_vehicle("a", mode, 0.0), gnss=None, positions=(), heights=(stream,))
    _, ends = graph_of(plain)
    heights, prior = position_blocks(ends["a"], Parameters())
    assert isinstance(heights, BarometerBlock) and heights.n == 20
    nodes = heights.nodes[0]
    nodes.value[:] = np.random.default_rng(7).normal(0, 2, len(nodes.value))
    graph = evaluated(ends, [heights, prior])
    for block in (heights, prior):
        assert_jacobians(graph, block, STEP | {"i": (0.1,)}, CARRIED)
    assert prior.rows.sigma[0] == 5.0 and np.allclose(prior.rows.sigma[1:], 0.5 * np.sqrt(1.0))
    before = heights.y.copy()
    nodes.value += 1.0
    heights.predict()
    np.testing.assert_allclose(before - heights.y, 1.0, atol=1e-9)


# -- constraints -----------------------------------------------------------------------------------


def test_non_holonomic_rows() -> None:
    """At states and between them; lateral and vertical, or one of the two; mounting of pitch and yaw."""
    c = Constraints(lateral_mps=0.1, vertical_mps=0.2, axle_b=(0.0, -1.0, -0.5), mounting_rad=0.1, interval_s=0.4)
    (block,) = check(*graph_of(vehicle(constraints=c)), CARRIED, constraint_blocks)
    assert block.n == 2 * 13 and block.rows.sigma[:2].tolist() == [0.1, 0.2]
    (only,) = check(*graph_of(vehicle(constraints=Constraints(lateral_mps=0.1, interval_s=1.0))), 5e-5, constraint_blocks)
    assert only.n == 5


@pytest.mark.parametrize("mode", ["imu", "motion"])
def test_height_hold(mode: str) -> None:
    held = replace(bare_vehicle("a", mode, 0.0), gnss=None, constraints=Constraints(height_mps=0.1, interval_s=2.0))
    (block,) = check(*graph_of(held), 5e-5, constraint_blocks)
    assert block.n == 3 and block.rows.label == ["E", "N", "U"] and set(block.rows.label_index.tolist()) == {2}


def test_rest_by_the_odometer() -> None:
    """An odometer at zero from 1 to 3 s: velocities there are zero, attitudes the same, and none elsewhere."""
    t = np.arange(0, 4.01, 0.1)
    v_b = np.full((len(t), 3), np.nan)
    v_b[:, 1] = np.where((t > 0.95) & (t < 3.05), 0.0, 4.0)
    stream = VelocityStream(t, v_b, np.full((len(t), 3), 0.05))
    c = Constraints(zero_velocity_mps=0.02, zero_rotation_rps=1e-3, interval_s=1.0)
    problem, ends = graph_of(vehicle(velocities=(stream,), constraints=c))
    still, rotation = check(problem, ends, 1e-5, constraint_blocks)
    assert sorted(set(still.rows.t_s.tolist())) == [1.0, 2.0, 3.0] and still.n == 9
    assert rotation.n == 6 and sorted(set(rotation.rows.t_s.tolist())) == [2.0, 3.0]
    rate = np.array([0.01, -0.02, 0.03])
    ends["a"].R = exp_so3(rate * GRID[:, None])
    rotation.predict()
    np.testing.assert_allclose(rotation.y.reshape(-1, 3), np.tile(-rate, (2, 1)), atol=1e-12)


# -- what rows mean --------------------------------------------------------------------------------


def still_vehicle(C_nb: Array, **sensors: object) -> tuple[NavigationProblem, dict[str, VehicleVariables]]:
    """One vehicle with attitude C_nb and velocity (3, 4, 0.5) at the origin, at every state."""
    problem, ends = graph_of(vehicle(**sensors))
    a = ends["a"]
    a.r, a.v, a.R = np.zeros((5, 3)), np.tile([3.0, 4.0, 0.5], (5, 1)), np.tile(C_nb, (5, 1, 1))
    return problem, ends


def residual(problem: NavigationProblem, ends: dict[str, VehicleVariables], **values: Array) -> Array:
    """Residuals of the only block, with parameters whose names end so set to values."""
    parameters = Parameters()
    (block,) = sensor_blocks(problem, ends, parameters)
    for name, value in values.items():
        (p,) = [p for p in parameters if p.name.endswith(name.replace("_", " "))]
        p.value = np.atleast_1d(np.asarray(value, float))
    block.predict()
    return block.y.reshape(4, -1)


def test_an_odometer_reads_scaled_speed_along_its_own_axis() -> None:
    heading = np.arctan2(3.0, 4.0)
    C_nb = matrix_from_euler(np.arcsin(0.5 / np.hypot(5.0, 0.5)), 0.0, heading)  # forward is the velocity
    speed = np.full((4, 3), np.nan)
    yaw = 0.1  # sensor turned to the left about up
    speed[:, 1] = 1.02 * np.hypot(5.0, 0.5) * np.cos(yaw)
    stream = VelocityStream(GRID[:4], speed, np.ones((4, 3)), calibration=Calibration(scale=0.1, mounting_rad=0.3))
    problem, ends = still_vehicle(C_nb, velocities=(stream,))
    np.testing.assert_allclose(residual(problem, ends, scale=0.02, mounting=np.array([0, 0, yaw])), 0.0, atol=1e-12)
    assert np.abs(residual(problem, ends)).min() > 0.01


def test_a_lever_arm_turns_with_the_body() -> None:
    problem, ends = still_vehicle(np.eye(3))
    rate = ends["a"].body_rate(GRID[:4], np.arange(4))
    lever = (0.5, -2.0, 0.3)
    v_b = np.array([3.0, 4.0, 0.5]) + np.cross(rate, lever)
    problem, ends = still_vehicle(np.eye(3), velocities=(VelocityStream(GRID[:4], v_b, np.ones((4, 3)), lever),))
    np.testing.assert_allclose(residual(problem, ends), 0.0, atol=1e-12)


def test_attitude_errors_are_about_east_north_up() -> None:
    """A system that errs by a rotation about n's axes: its residual is that rotation, and the mounting is right of C_nb."""
    C_nb, error, mounting = matrix_from_euler(0.2, -0.3, 2.0), np.array([0.01, -0.02, 0.03]), np.array([0.1, 0.2, -0.1])
    q = np.tile(quat_from_matrix(exp_so3(error) @ C_nb @ exp_so3(mounting)), (4, 1))
    stream = AttitudeStream(GRID[:4], q, np.full((4, 3), 0.01), calibration=Calibration(mounting_rad=0.2))
    problem, ends = still_vehicle(C_nb, attitudes=(stream,))
    np.testing.assert_allclose(residual(problem, ends, mounting=mounting), np.tile(error, (4, 1)), atol=1e-9)


def test_a_heading_alone_is_compared_as_a_heading() -> None:
    """A compass that knows nothing of 15 degrees of pitch and roll, north between the two headings."""
    q = np.tile(quat_from_matrix(matrix_from_euler(0.0, 0.0, np.deg2rad(-179.0))), (4, 1))
    sigma = np.tile([np.inf, np.inf, 0.01], (4, 1))
    stream = AttitudeStream(GRID[:4], q, sigma)
    C_nb = matrix_from_euler(np.deg2rad(15.0), np.deg2rad(-15.0), np.deg2rad(178.0))
    problem, ends = still_vehicle(C_nb, attitudes=(stream,))
    np.testing.assert_allclose(residual(problem, ends), np.deg2rad(3.0), atol=1e-9)


def test_a_magnetometer_sees_the_field_and_its_own_iron() -> None:
    C_nb, iron = matrix_from_euler(0.1, 0.4, 1.0), np.array([5.0, -3.0, 2.0])
    m_b = np.tile(C_nb.T @ np.array(FIELD_N) + iron, (4, 1))
    stream = MagneticStream(GRID[:4], m_b, np.ones((4, 3)), FIELD_N, calibration=Calibration(bias=10.0))
    problem, ends = still_vehicle(C_nb, magnetics=(stream,))
    np.testing.assert_allclose(residual(problem, ends, hard_iron=iron), 0.0, atol=1e-9)


def test_a_camera_counts_clockwise_from_forward_and_up() -> None:
    """Level, heading east: a landmark to the north-east above is left of forward."""
    target = Tag("lamp", position_n=(10.0, 10.0, 10.0 * np.sqrt(2)))
    n = 4
    stream = VisionStream(
        GRID[:n],
        Tag("camera", "a"),
        target,
        np.full(n, -np.pi / 4),
        np.full(n, np.pi / 4),
        np.full(n, 20.0),
        np.full(n, 0.01),
        np.full(n, 0.1),
    )
    problem, ends = still_vehicle(matrix_from_euler(0.0, 0.0, np.pi / 2))
    problem = replace(problem, visions=(stream,))
    np.testing.assert_allclose(residual(problem, ends), 0.0, atol=1e-12)


def test_what_needs_an_attitude_says_so() -> None:
    none = replace(vehicle(), imu=None)
    t = GRID[:4]
    for sensors in (
        {"velocities": (VelocityStream(t, np.ones((4, 3)), np.ones((4, 3))),)},
        {"attitudes": (AttitudeStream(t, random_rotations(4), np.ones((4, 3))),)},
        {"magnetics": (MagneticStream(t, np.ones((4, 3)), np.ones((4, 3)), FIELD_N),)},
    ):
        problem, ends = graph_of(replace(none, **sensors))  # type: ignore[arg-type]
        with pytest.raises(InputError, match=r"vehicle a: (odometer|attitude|magnetometer) .*IMU"):
            sensor_blocks(problem, ends, Parameters())
    problem, ends = graph_of(replace(none, constraints=Constraints(lateral_mps=0.1)))
    with pytest.raises(InputError, match=r"vehicle a: .*lateral_mps.*IMU"):
        constraint_blocks(problem, ends, Parameters())


def test_the_start_graph_leaves_attitudes_out() -> None:
    """An IMU that a first graph does not use yet is no error."""
    stream = VelocityStream(GRID, np.ones((5, 3)), np.ones((5, 3)))
    a = vehicle(velocities=(stream,), constraints=Constraints(lateral_mps=0.1, height_mps=0.1))
    problem, _ = graph_of(a)
    ends = {"a": VehicleVariables(0, a, GRID, FRAME, use_imu=False)}
    assert not sensor_blocks(problem, ends, Parameters())
    assert [b.rows.source for b in constraint_blocks(problem, ends, Parameters())] == ["a/height hold"]
