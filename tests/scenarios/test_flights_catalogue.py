"""Flights that come with relnav: found by name, read, and true to what is known of them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from factorgraph.attitude import matrix_from_quat
from factorgraph.errors import InputError
from factorgraph.geodesy import LocalFrame
from scenarios.flights import LoadedFlight, load
from scenarios.flights.catalogue import DATA_VARIABLE, locate, names
from tests.helpers import shared_data, wheel_file
from tests.scenarios.flight_files import write_flight


def _range_errors(flight: LoadedFlight, scale: float) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    """Ranges less `scale` times the true distance of tag 0's vehicle to anchors."""
    stream = flight.problem.ranges[0].stream
    truth = flight.problem.vehicles[0].truth
    assert truth is not None
    r = np.column_stack([np.interp(stream.t_s, truth.t_s, truth.r_n[:, i]) for i in range(3)])
    anchors = np.array([tag.position_n or (np.nan,) * 3 for tag in stream.tags])[stream.tag_b]
    return stream.range_m - scale * np.linalg.norm(r - anchors, axis=1)


@pytest.mark.parametrize(("name", "n"), [("plaza1", 3529), ("plaza2", 1816)])
def test_plaza_ranges_fit_truth_and_beacons(name: str, n: int) -> None:
    wheel_file("gtsam", "Data/Plaza1_.mat")
    flight = load(name)
    errors = _range_errors(flight, 1.0696)
    assert len(errors) == n and abs(np.mean(errors)) < 0.1 and 0.4 < np.std(errors) < 0.7


def test_kitti_axes_fit_its_path() -> None:
    """Forward acceleration and heading rate of the IMU follow from the positions."""
    wheel_file("gtsam", "Data/KittiGps_converted.txt")
    car = load("kitti").problem.vehicles[0]
    assert car.imu is not None
    fixes = car.positions[0]
    v = np.diff(fixes.r_n[:, :2], axis=0) / np.diff(fixes.t_s)[:, None]
    t = 0.5 * (fixes.t_s[1:] + fixes.t_s[:-1])
    speed = np.linalg.norm(v, axis=1)
    smooth = np.column_stack(
        [np.convolve(column, np.full(100, 0.01), "same") for column in (car.imu.f_b[:, 1], car.imu.w_b[:, 2])]
    )
    forward, yaw = (np.interp(t, car.imu.t_s, smooth[:, i]) for i in range(2))
    driving = speed > 3
    rate = np.gradient(np.unwrap(np.arctan2(v[:, 1], v[:, 0])), t)
    assert np.corrcoef(np.gradient(speed, t)[driving], forward[driving])[0, 1] > 0.9
    assert np.corrcoef(rate[driving], yaw[driving])[0, 1] > 0.9


def test_the_static_pair_from_the_package() -> None:
    wheel_file("cssrlib", "data/SEPT078M1.21O")
    problem = load("cssrlib-static").problem
    rover = problem.vehicle("rover")
    assert rover.truth is not None
    frame = LocalFrame.at_ecef(np.array([-3959400.631, 3385704.533, 3667523.111]))
    np.testing.assert_allclose(rover.truth.r_n[0], frame.from_ecef(np.array([-3962108.673, 3381309.574, 3668678.638])), atol=1e-6)


def test_miluv_ranges_fit_motion_capture() -> None:
    flight = load("miluv", shared_data("miluv_cirObstacles_3_random_0").parent)
    vehicles = {v.name: v for v in flight.problem.vehicles}
    stream = flight.problem.ranges[0].stream
    ends = []
    for column in (stream.tag_a, stream.tag_b):
        r = np.empty((len(column), 3))
        for i, (k, t) in enumerate(zip(column, stream.t_s, strict=True)):
            tag = stream.tags[k]
            if tag.position_n is not None:
                r[i] = tag.position_n
                continue
            truth = vehicles[str(tag.vehicle)].truth
            assert truth is not None
            j = int(np.argmin(np.abs(truth.t_s - t)))
            assert truth.q_nb is not None
            r[i] = truth.r_n[j] + matrix_from_quat(truth.q_nb[j]) @ np.array(tag.lever_b)
        ends.append(r)
    errors = stream.range_m - np.linalg.norm(ends[0] - ends[1], axis=1)
    assert len(errors) == 317 and abs(np.median(errors)) < 0.05 and np.median(np.abs(errors)) < 0.1
    assert len(load("miluv-no-anchors", shared_data("")).problem.ranges[0].stream.t_s) == 123


def test_miluv_heights_fit_motion_capture() -> None:
    flight = load("miluv", shared_data("miluv_cirObstacles_3_random_0").parent)
    for vehicle in flight.problem.vehicles:
        heights, truth = vehicle.heights[0], vehicle.truth
        assert truth is not None
        errors = heights.up_m - np.interp(heights.t_s, truth.t_s, truth.r_n[:, 2])
        assert np.median(np.abs(errors)) < 0.15 and abs(np.median(errors)) < 0.1


def test_names_and_places(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(DATA_VARIABLE, raising=False)
    assert {"kitti", "plaza1", "plaza2", "cssrlib-static", "miluv", "miluv-no-anchors"} <= set(names())
    for name, data, telling in (
        ("miluvv", None, "did you mean miluv?"),
        ("miluv", None, "give --data DIR"),
        ("miluv", tmp_path / "none", "no such folder"),
        ("miluv", tmp_path, "no folder miluv_cirObstacles_3_random_0"),
        (str(tmp_path), None, "this folder has no flight.toml"),
        (str(tmp_path / "x.toml"), None, "x.toml"),
    ):
        with pytest.raises(InputError, match=telling):
            locate(name, data)
    recordings = tmp_path / "miluv_cirObstacles_3_random_0"
    recordings.mkdir()
    assert locate("miluv", tmp_path).base == locate("miluv", recordings).base == recordings
    monkeypatch.setenv(DATA_VARIABLE, str(tmp_path))
    assert locate("miluv").base == recordings


def test_a_folder_its_file_and_a_file_of_another_name(tmp_path: Path) -> None:
    folder = write_flight(tmp_path / "hop")
    assert locate(folder).name == locate(folder / "flight.toml").name == "hop"
    (folder / "variant.toml").write_text((folder / "flight.toml").read_text())
    assert locate(folder / "variant.toml").name == "variant"
