"""Odometers, attitude systems, magnetometers, cameras, constraints and calibrations: simulated, written, read back, refused."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from factorgraph.attitude import euler_from_matrix, log_so3, matrix_from_quat
from factorgraph.errors import InputError
from factorgraph.measurements import Calibration
from factorgraph.problem import Constraints, ImuCalibration
from factorgraph.types import Array
from scenarios.flights import load
from scenarios.simulate import simulate
from scenarios.simulate.scenario import parse
from scenarios.simulate.write import write_flight
from tests.scenarios import flight_files

ALL = """
[scenario]
name = "all"
origin = { lat_deg = 48.0, lon_deg = 11.0, h_m = 500.0 }
duration_s = 20.0

[[vehicle]]
name = "car"
trajectory = { kind = "manoeuvres", speed_mps = 15.0, segments = [{ duration_s = 20.0, turn_dps = 5.0, climb_mps = 0.5 }] }
imu = { rate_hz = 100.0 }
positions = [{ rate_hz = 4.0, velocity_sigma_mps = [0.1, 0.1, 0.2], outages = [{ start_s = 8.0, end_s = 12.0 }] }]
heights = [{ name = "barometer", bias_sigma_m = 5.0, bias_walk_m_rts = 0.1 }]
velocities = [
    { scale_sigma = 0.05, lever_b = [0.0, 1.0, 0.0] },
    { name = "radar", axes = "all", mounting_sigma_deg = 3.0 },
]
attitudes = [{ mounting_sigma_deg = 2.0 }, { name = "compass", tells = "heading" }, { name = "level", tells = "tilt" }]
magnetometers = [{ bias_sigma = 8.0 }]
constraints = { lateral_mps = 0.1, zero_rotation_dps = 0.1, axle_b = [0.0, -1.0, 0.0], mounting_sigma_deg = 2.0 }

[[vehicle]]
name = "other"
trajectory = { kind = "formation", leader = "car", offset_m = [10.0, 20.0, 5.0] }
imu = { rate_hz = 100.0 }
positions = [{}]

[[vision]]
observer = { name = "camera", vehicle = "car", lever_b = [0.0, 1.0, 1.0] }
target = { name = "light", vehicle = "other" }
ranges = true
detection = 0.7
mounting_sigma_deg = 1.0

[[vision]]
name = "radar"
observer = { name = "radar", vehicle = "other" }
target = { name = "mast", position_m = [100.0, 100.0, 30.0] }
angles = false
ranges = true
"""


def scene(**info: object) -> object:
    text = ALL
    for key, value in info.items():
        text = text.replace("duration_s = 20.0\n", f"duration_s = 20.0\n{key} = {value}\n", 1)
    return parse(text)


def assert_same_stream(a: object, b: object) -> None:
    assert type(a) is type(b)
    for field in dataclasses.fields(a):  # type: ignore[arg-type]
        x, y = getattr(a, field.name), getattr(b, field.name)
        if isinstance(x, np.ndarray):
            np.testing.assert_allclose(y, x, atol=1e-12, err_msg=field.name)
        elif isinstance(x, Calibration):
            np.testing.assert_allclose(dataclasses.astuple(y), dataclasses.astuple(x), atol=1e-12)
        else:
            assert x == y, field.name


def test_what_is_simulated_is_written_and_read_back(tmp_path: Path) -> None:
    flight = simulate(scene(), 3)  # type: ignore[arg-type]
    problem = load(write_flight(flight, tmp_path)).problem
    for v in flight.problem.vehicles:
        read = problem.vehicle(v.name)
        for name in ("positions", "heights", "velocities", "attitudes", "magnetics"):
            for a, b in zip(getattr(v, name), getattr(read, name), strict=True):
                assert_same_stream(a, b)
        np.testing.assert_allclose(
            [x for x in dataclasses.astuple(read.constraints) if isinstance(x, float)],
            [x for x in dataclasses.astuple(v.constraints) if isinstance(x, float)],
        )
    for a, b in zip(flight.problem.visions, problem.visions, strict=True):
        assert_same_stream(a, b)
    fixes = problem.vehicle("car").positions[0]
    assert fixes.v_n is not None and not np.any((fixes.t_s >= 8.0) & (fixes.t_s < 12.0))


def test_without_noise_sensors_tell_the_truth() -> None:
    """Each sensor against the trajectory it was on, every error off."""
    flight = simulate(scene(noise_scale=0.0), 3)  # type: ignore[arg-type]
    car = flight.problem.vehicle("car")
    path = flight.record.trajectories["car"]

    def body(t: Array) -> Array:
        return path.at(t).C_nb

    odometer, radar = car.velocities
    v_b = np.einsum("nji,nj->ni", body(odometer.t_s), path.at(odometer.t_s).point(odometer.lever_b)[1])
    np.testing.assert_allclose(odometer.v_b[:, 1], v_b[:, 1], atol=1e-9)
    assert np.all(np.isnan(odometer.v_b[:, [0, 2]])) and np.all(np.isfinite(radar.v_b))
    full, compass, level = car.attitudes
    np.testing.assert_allclose(matrix_from_quat(full.q_nb), body(full.t_s), atol=1e-12)
    assert np.isinf(compass.sigma_rad[0]).tolist() == [True, True, False]
    assert np.isinf(level.sigma_rad[0]).tolist() == [False, False, True]
    field = car.magnetics[0]
    np.testing.assert_allclose(np.einsum("nij,nj->ni", body(field.t_s), field.m_b), np.tile(field.field_n, (len(field.t_s), 1)))
    sight = flight.problem.visions[0]
    d = flight.record.trajectories["other"].at(sight.t_s).r_n - path.at(sight.t_s).point(sight.observer.lever_b)[0]
    d_b = np.einsum("nji,nj->ni", body(sight.t_s), d)
    np.testing.assert_allclose(sight.azimuth_rad, np.arctan2(d_b[:, 0], d_b[:, 1]), atol=1e-9)
    np.testing.assert_allclose(sight.range_m, np.linalg.norm(d, axis=1), atol=1e-9)
    assert len(sight.t_s) < 0.9 * 101
    np.testing.assert_allclose(car.heights[0].up_m, path.at(car.heights[0].t_s).r_n[:, 2], atol=1e-9)


def test_errors_are_as_recorded() -> None:
    """Scale, mounting and hard iron are in the measurements and in the record, of the size that the estimator is told."""
    noisy, exact = (simulate(scene(noise_scale=s), 5) for s in (1.0, 0.0))  # type: ignore[arg-type]
    record = noisy.record.sensors
    car, true = noisy.problem.vehicle("car"), exact.problem.vehicle("car")
    ratio = np.median(car.velocities[0].v_b[:, 1] / true.velocities[0].v_b[:, 1])
    assert abs(ratio - 1 - record["car/odometer"].scale) < 1e-3 and abs(record["car/odometer"].scale) > 1e-3
    iron = np.median(car.magnetics[0].m_b - true.magnetics[0].m_b, axis=0)
    np.testing.assert_allclose(iron, record["car/magnetometer"].bias, atol=0.2)
    turned = np.median(car.velocities[1].v_b, axis=0)
    np.testing.assert_allclose(turned, record["car/radar"].C_bs.T @ np.median(true.velocities[1].v_b, axis=0), atol=0.05)
    assert np.linalg.norm(record["vision"].mounting_rad) > 0


def sensors_flight(folder: Path, table: str, rows: Array, header: str = "t,a,b,c,d") -> Path:
    """A hand-written flight with one more sensor in more.csv."""
    flight_files.write_flight(folder, flight_files.FLIGHT + table)
    flight_files.write_csv(folder / "more.csv", header, rows)
    return folder


def test_attitude_errors_persist_and_are_told_as_noise_that_counts_them_once(tmp_path: Path) -> None:
    """Gauss-Markov part of the stated size and correlation time, recorded sample by sample; the folder tells the same."""
    table = "{ rate_hz = 50.0, sigma_deg = [0.02, 0.02, 0.04], gm_deg = [0.5, 0.5, 1.5], gm_s = 0.4 }"
    head = ALL[: ALL.index("imu =")].replace("duration_s = 20.0\n\n", "duration_s = 1000.0\n\n")
    text = head.replace("duration_s = 20.0, turn", "duration_s = 1000.0, turn") + f"attitudes = [{table}]\n"
    flight = simulate(parse(text + "positions = [{}]\n"), 4)
    (stream,), record = flight.problem.vehicle("car").attitudes, flight.record.sensors["car/attitude"]
    true = flight.record.trajectories["car"].at(stream.t_s).C_nb
    error = log_so3(matrix_from_quat(stream.q_nb) @ np.swapaxes(true, 1, 2))
    np.testing.assert_allclose(error, record.rotation_n, atol=1e-12)
    np.testing.assert_allclose(np.rad2deg(error.std(axis=0)), (0.5, 0.5, 1.5), rtol=0.1)
    late = np.mean(error[20:] * error[:-20], axis=0) / np.var(error, axis=0)
    np.testing.assert_allclose(late, np.exp(-1.0), atol=0.1)
    told = np.hypot((0.02, 0.02, 0.04), np.sqrt(40.0) * np.array((0.5, 0.5, 1.5)))
    np.testing.assert_allclose(np.rad2deg(stream.sigma_rad), np.tile(told, (len(stream.t_s), 1)))
    back = load(write_flight(flight, tmp_path)).problem.vehicle("car").attitudes[0]
    np.testing.assert_allclose(back.sigma_rad, stream.sigma_rad)


def test_a_magnetometer_may_measure_the_model_of_place_and_date(tmp_path: Path) -> None:
    """Bavaria in June 2024: 4.1 deg east of north, 64 deg down, 48.7 microtesla."""
    text = ALL[: ALL.index("imu =")] + 'magnetometers = [{ field_n = "model" }]\npositions = [{}]\n'
    flight = simulate(parse(text), 4)
    stream = flight.problem.vehicle("car").magnetics[0]
    east, north, up = stream.field_n
    assert np.rad2deg(np.arctan2(east, north)) == pytest.approx(4.1, abs=0.2)
    assert np.rad2deg(np.arctan2(-up, np.hypot(east, north))) == pytest.approx(64.0, abs=0.5)
    assert np.linalg.norm(stream.field_n) == pytest.approx(48.7, abs=0.3)
    back = load(write_flight(flight, tmp_path)).problem.vehicle("car").magnetics[0]
    np.testing.assert_allclose(back.field_n, stream.field_n)


def test_an_odometer_in_kilometres_per_hour_and_one_in_distances(tmp_path: Path) -> None:
    t = np.arange(0.5, 9.5, 0.5)
    speed = sensors_flight(
        tmp_path / "kmh",
        '\n[[vehicle.velocities]]\nfile = "more.csv"\ntime = "t"\nforward = "a"\nunit = "km/h"\nlever_b = [0.5, 0.0, 0.0]\n',
        np.column_stack([t, np.full(len(t), 36.0), t, t, t]),
    )
    (stream,) = load(speed).problem.vehicles[0].velocities
    np.testing.assert_allclose(stream.v_b[:, 1], 10.0)
    assert stream.lever_b == (0.5, 0.0, 0.0)
    distance = sensors_flight(
        tmp_path / "steps",
        '\n[[vehicle.velocities]]\nfile = "more.csv"\ntime = "t"\nforward = "a"\nincrements = true\n',
        np.column_stack([t, np.full(len(t), 4.0), t, t, t]),
    )
    (stream,) = load(distance).problem.vehicles[0].velocities
    np.testing.assert_allclose(stream.v_b[:, 1], 8.0)
    np.testing.assert_allclose(stream.t_s, t[1:] - 0.25)


def test_axes_of_a_velocity_sensor(tmp_path: Path) -> None:
    """Front-right-down columns 1, 2, 3 are right 2, front 1, up -3."""
    rows = np.column_stack([np.arange(1.0, 9.0), *(np.full(8, x) for x in (1.0, 2.0, 3.0, 0.0))])
    table = '\n[[vehicle.velocities]]\nfile = "more.csv"\ntime = "t"\nvelocity = ["a", "b", "c"]\naxes = "FRD"\n'
    (stream,) = load(sensors_flight(tmp_path, table, rows)).problem.vehicles[0].velocities
    np.testing.assert_allclose(stream.v_b, np.tile([2.0, 1.0, -3.0], (8, 1)))


@pytest.mark.parametrize("way", ["rpy", "heading", "quaternion"])
def test_attitudes_by_angles(tmp_path: Path, way: str) -> None:
    """Roll 10, pitch -5, heading 30 degrees three ways; of a front-right-down vehicle against north-east-down, too."""
    n = 6
    roll, pitch, heading = np.deg2rad([10.0, -5.0, 30.0])
    half = np.array([roll, pitch, heading]) / 2
    (cr, cp, cy), (sr, sp, sy) = np.cos(half), np.sin(half)
    q = [cr * cp * cy + sr * sp * sy, sr * cp * cy - cr * sp * sy, cr * sp * cy + sr * cp * sy, cr * cp * sy - sr * sp * cy]
    cells = {"rpy": [10.0, -5.0, 30.0, 0.0], "heading": [30.0, 0.0, 0.0, 0.0], "quaternion": q}[way]
    columns = {"rpy": 'rpy = ["a", "b", "c"]', "heading": 'heading = "a"'}
    columns["quaternion"] = 'quaternion = ["a", "b", "c", "d"]\nframe = "ned"'
    table = f'\n[[vehicle.attitudes]]\nfile = "more.csv"\ntime = "t"\n{columns[way]}\n'
    flight_files.write_flight(tmp_path, flight_files.FLIGHT.replace('name = "uav"', 'name = "uav"\naxes = "FRD"') + table)
    flight_files.write_csv(tmp_path / "more.csv", "t,a,b,c,d", np.column_stack([np.arange(1.0, 1.0 + n), np.tile(cells, (n, 1))]))
    (stream,) = load(tmp_path).problem.vehicles[0].attitudes
    angles = np.degrees(np.array(euler_from_matrix(matrix_from_quat(stream.q_nb)))[:, 0])
    np.testing.assert_allclose(angles, [0.0, 0.0, 30.0] if way == "heading" else [-5.0, 10.0, 30.0], atol=1e-6)
    assert np.isinf(stream.sigma_rad[0, :2]).all() == (way == "heading")


def test_calibrations_arrive(tmp_path: Path) -> None:
    text = flight_files.FLIGHT.replace('name = "uav"', 'name = "uav"\nimu_calibration = { time_sigma_s = 0.1 }')
    text = text.replace("sigma_m = [0.1, 0.1, 0.2]", "sigma_m = [0.1, 0.1, 0.2]\nlever_sigma_m = 0.3\ntime_sigma_s = 0.05")
    text += "\n[vehicle.constraints]\nlateral_mps = 0.2\naxle_b = [1.0, 2.0, 3.0]\nmounting_sigma_deg = 90.0\n"
    v = load(flight_files.write_flight(tmp_path, text)).problem.vehicles[0]
    assert v.imu_calibration == ImuCalibration(time_s=0.1)
    assert v.positions[0].calibration == Calibration(lever_m=0.3, time_s=0.05)
    assert v.constraints == Constraints(lateral_mps=0.2, axle_b=(1.0, 2.0, 3.0), mounting_rad=np.pi / 2)


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ('velocities = [{ file = "more.csv" }]', "either forward .* or velocity"),
        ('velocities = [{ file = "more.csv", forward = "a", mounting = { rpy_deg = [0, 0, 9] } }]', "mounting turns all three"),
        ('velocities = [{ file = "more.csv", forward = "a", scale_sgma = 1.0 }]', r"scale_sgma; did you mean scale_sigma\?"),
        ('attitudes = [{ file = "more.csv" }]', "one of quaternion, rpy and heading"),
        ('attitudes = [{ file = "more.csv", heading = "a", tells = "tilt" }]', "does not tell the tilt"),
        ('attitudes = [{ file = "more.csv", time = "t", quaternion = ["a", "b", "c", "d"] }]', r"more.csv: 8 of 8 quaternions"),
        (
            'magnetometers = [{ file = "more.csv", time = "t", field = ["a", "b", "c"], field_m = [0.0, 2e4, -4e4], sigma = 1 }]',
            r"more.csv: the field measured is 3.742, field_m says 4.472e\+04.*unit",
        ),
        ("constraints = { lateral_mps = -1.0 }", "lateral_mps"),
    ],
)
def test_what_is_wrong_is_named(tmp_path: Path, table: str, message: str) -> None:
    text = flight_files.FLIGHT.replace('name = "uav"', f'name = "uav"\n{table}')
    flight_files.write_flight(tmp_path, text)
    rows = np.column_stack([np.arange(1.0, 9.0), *(np.full(8, x) for x in (1.0, 2.0, 3.0, 0.0))])
    flight_files.write_csv(tmp_path / "more.csv", "t,a,b,c,d", rows)
    with pytest.raises(InputError, match=message):
        load(tmp_path)


def test_a_camera_must_see_something_known(tmp_path: Path) -> None:
    vision = """
[[vision]]
file = "more.csv"
time = "t"
observer = { name = "camera", vehicle = "uav" }
target = { name = "lamp", vehicle = "uab" }
azimuth = "a"
"""
    rows = np.column_stack([np.arange(1.0, 9.0), *(np.full(8, x) for x in (1.0, 2.0, 3.0, 0.0))])
    with pytest.raises(InputError, match=r"tag lamp: no vehicle named uab; did you mean uav\?"):
        load(sensors_flight(tmp_path / "a", vision, rows))
    with pytest.raises(InputError, match="both on uav"):
        load(sensors_flight(tmp_path / "b", vision.replace("uab", "uav"), rows))
    seen = vision.replace('vehicle = "uab"', "position_m = [3.0, 4.0, 5.0]")
    (stream,) = load(sensors_flight(tmp_path / "c", seen, rows)).problem.visions
    np.testing.assert_allclose(stream.azimuth_rad, np.deg2rad(1.0))
    assert np.all(np.isnan(stream.range_m))


def test_simulated_cameras_name_what_they_cannot_see() -> None:
    text = ALL.replace('target = { name = "light", vehicle = "other" }', 'target = { name = "light", vehicle = "moon" }')
    with pytest.raises(InputError, match="no vehicle moon"):
        simulate(parse(text), 0)
    with pytest.raises(InputError, match="never within max_range_m 5 m"):
        simulate(parse(ALL.replace("detection = 0.7", "max_range_m = 5.0")), 0)
    with pytest.raises(InputError, match="outages leave no fix"):
        simulate(parse(ALL.replace("start_s = 8.0, end_s = 12.0", "start_s = 0.0, end_s = 99.0")), 0)
