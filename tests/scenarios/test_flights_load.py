"""From folders to problems: units, axes, frames, lever arms, and the errors that a user can act on."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from factorgraph.attitude import matrix_from_euler, matrix_from_quat, quat_from_matrix
from factorgraph.errors import InputError
from factorgraph.geodesy import LocalFrame, geodetic_from_ecef
from factorgraph.gpstime import GpsTime
from factorgraph.types import Array
from scenarios.flights import load
from tests.helpers import shared_data, wheel_file
from tests.scenarios.flight_files import FLIGHT, resting_imu, write_csv, write_flight


def _error(folder: Path) -> str:
    with pytest.raises(InputError) as error:
        load(folder)
    assert "\n" not in str(error.value)
    return str(error.value)


def test_a_small_flight(tmp_path: Path) -> None:
    problem = load(write_flight(tmp_path / "hop")).problem
    uav = problem.vehicles[0]
    assert problem.name == "hop" and uav.imu is not None and len(uav.imu.t_s) == 200
    np.testing.assert_allclose(uav.positions[0].r_n[-1], [9, 1, 2])
    np.testing.assert_allclose(uav.positions[0].sigma_m[0], [0.1, 0.1, 0.2])
    assert problem.frame == LocalFrame(np.deg2rad(47.0), np.deg2rad(15.4), 400.0)


def test_a_clock_of_its_own_counts_from_the_first_whole_second(tmp_path: Path) -> None:
    folder = write_flight(tmp_path)
    for name in ("imu.csv", "fixes.csv"):
        rows = np.loadtxt(folder / name, delimiter=",", skiprows=1)
        rows[:, 0] += 5000.3
        write_csv(folder / name, (folder / name).read_text().splitlines()[0], rows)
    problem = load(folder).problem
    assert problem.t0 == GpsTime(0, 5000.0)
    assert problem.vehicles[0].positions[0].t_s[0] == pytest.approx(0.3)


@pytest.mark.parametrize(
    ("axes", "rows"), [("FRD", [[0, 1, 0], [1, 0, 0], [0, 0, -1]]), ("FLU", [[0, 1, 0], [-1, 0, 0], [0, 0, 1]])]
)
def test_units_and_axes(tmp_path: Path, axes: str, rows: list[list[int]]) -> None:
    """The same motion written in g and deg/s in other axes reads as the original."""
    imu = resting_imu()
    written = imu.copy()
    written[:, 1:4] = imu[:, 1:4] @ np.array(rows).T / 9.80665
    written[:, 4:7] = np.rad2deg(imu[:, 4:7] @ np.array(rows).T)
    text = FLIGHT.replace('time = "t"\naccel', f'axes = "{axes}"\naccel_unit = "g"\ngyro_unit = "deg/s"\ntime = "t"\naccel')
    stream = load(write_flight(tmp_path, text, written)).problem.vehicles[0].imu
    assert stream is not None
    np.testing.assert_allclose(stream.f_b, imu[:, 1:4], atol=1e-6)
    np.testing.assert_allclose(stream.w_b, imu[:, 4:7], atol=1e-8)


def _changed(change: str) -> Array:
    imu = resting_imu()
    if change == "g":
        imu[:, 1:4] /= 9.80665
    elif change == "mg":
        imu[:, 1:4] *= 1000 / 9.80665
    elif change == "no gravity":
        imu[:, 3] -= 9.81
    elif change == "upside down":
        imu[:, 2:4] *= -1
    elif change == "swapped":
        imu = imu[:, [0, 4, 5, 6, 1, 2, 3]]
    elif change == "deg/s":
        imu[:, 4:7] *= 57.3 * 100
    return imu


@pytest.mark.parametrize(
    ("change", "telling"),
    [
        ("g", 'write accel_unit = "g"'),
        ("mg", "thousandths"),
        ("no gravity", "gravity looks removed"),
        ("upside down", "upside down with axes RFU; FRD would have it upright"),
        ("swapped", "columns look swapped"),
        ("deg/s", 'gyro_unit = "deg/s" looks right'),
    ],
)
def test_gravity_finds_wrong_units_and_axes(tmp_path: Path, change: str, telling: str) -> None:
    message = _error(write_flight(tmp_path, imu=_changed(change)))
    assert telling in message and "imu.csv" in message


def test_tilted_axes_are_doubted(tmp_path: Path) -> None:
    imu = resting_imu()
    imu[:, 1:4] = imu[:, [3, 1, 2]]
    findings = load(write_flight(tmp_path, imu=imu)).examined.findings
    assert any("gravity along R" in f.text and "check axes and mounting" in f.text and not f.is_wrong for f in findings)


def test_dropped_rows_are_counted(tmp_path: Path) -> None:
    imu = resting_imu()
    imu[20, 2] = np.nan
    imu[30, 0] = imu[29, 0]
    imu[40, 0] = 1.0
    report = load(write_flight(tmp_path, imu=imu)).reports[0]
    assert report.source == "imu.csv" and report.n_rows == 197
    assert report.dropped == {
        "with empty or non-numeric cells": 1,
        "with a repeated time stamp": 1,
        "with a backward time stamp": 1,
    }


@pytest.mark.parametrize(
    ("old", "new", "telling"),
    [
        ('"imu.csv"', '"imux.csv"', "imux.csv: no such file; did you mean imu.csv?"),
        ('"ax"', '"axx"', "imu.csv: no column axx; did you mean ax?"),
        ('file = "fixes.csv"\ntime = "t"', 'file = "fixes.csv"\ntime = { column = "t", offset_s = 900 }', "do not overlap"),
        ("origin =", "# origin =", "flight.origin is needed"),
        ("[flight]", "[flight]\nstart_s = 500", "no IMU samples between"),
        ("[flight]", '[flight]\npackage = "no_such_package"', "pip install no_such_package"),
        ("[flight]", '[flight]\ndata = "nowhere"', "no folder"),
        ('name = "uav"', 'name = "uav"\nheading_hint = 3', "did you mean heading_hint_deg?"),
    ],
)
def test_errors_of_a_folder(tmp_path: Path, old: str, new: str, telling: str) -> None:
    assert telling in _error(write_flight(tmp_path, FLIGHT.replace(old, new, 1)))


def test_only_the_declared_part_is_kept(tmp_path: Path) -> None:
    text = FLIGHT.replace("[flight]", "[flight]\nstart_s = 2\nend_s = 5")
    uav = load(write_flight(tmp_path, text)).problem.vehicles[0]
    assert uav.imu is not None and uav.imu.t_s[[0, -1]].tolist() == [2, 5]
    assert uav.positions[0].t_s.tolist() == [2, 3, 4, 5]


def test_positions_in_every_frame(tmp_path: Path) -> None:
    """One track written local, north-east-down, ECEF and geodetic reads the same."""
    frame = LocalFrame(np.deg2rad(47.0), np.deg2rad(15.4), 400.0)
    r_n = np.column_stack([np.arange(10) * 10.0, np.full(10, 3.0), np.arange(10.0)])
    ecef = frame.to_ecef(r_n)
    lat, lon, h = geodetic_from_ecef(ecef)
    written = {
        "local": r_n,
        "ned": r_n[:, [1, 0, 2]] * [1, 1, -1],
        "ecef": ecef,
        "llh": np.column_stack([np.rad2deg(lat), np.rad2deg(lon), h]),
    }
    for name, rows in written.items():
        folder = write_flight(tmp_path / name, FLIGHT.replace('position = ["e"', f'frame = "{name}"\nposition = ["e"'))
        np.savetxt(
            folder / "fixes.csv",
            np.column_stack([np.arange(10), rows]),
            fmt="%.12g",
            delimiter=",",
            header="t,e,n,u",
            comments="",
        )
        np.testing.assert_allclose(load(folder).problem.vehicles[0].positions[0].r_n, r_n, atol=2e-4, err_msg=name)


TRUTH = """
[vehicle.truth]
file = "truth.csv"
time = "t"
position = ["x", "y", "z"]
quaternion = ["qx", "qy", "qz", "qw"]
quaternion_order = "xyzw"
"""


def test_truth_attitude_lever_arm_and_heading_of_the_room(tmp_path: Path) -> None:
    """In a room whose y axis points east (heading 90 deg) and z up, a vehicle looking along x heads south."""
    text = FLIGHT.replace("h_m = 400.0", "h_m = 400.0, heading_deg = 90").replace('name = "uav"', 'name = "uav"\naxes = "FLU"')
    text = text.replace('file = "imu.csv"', 'file = "imu.csv"\nlever_b = [0.5, 0, 0]') + TRUTH
    folder = write_flight(tmp_path, text)
    rows = np.column_stack([np.arange(5), np.full(5, 1.0), np.full(5, 2.0), np.full(5, 3.0), np.zeros((5, 3)), np.ones(5)])
    write_csv(folder / "truth.csv", "t,x,y,z,qx,qy,qz,qw", rows)
    uav = load(folder).problem.vehicles[0]
    assert uav.truth is not None and uav.truth.q_nb is not None
    np.testing.assert_allclose(matrix_from_quat(uav.truth.q_nb[0]), matrix_from_euler(0, 0, np.pi), atol=1e-12)
    np.testing.assert_allclose(uav.truth.r_n[0], [2.0, -1.5, 3.0], atol=1e-12)  # IMU half a metre further south
    np.testing.assert_allclose(uav.positions[0].r_n[9], [1.0, -9.0, 2.0], atol=1e-12)
    np.testing.assert_allclose(uav.positions[0].lever_b, [0.0, -0.5, 0.0], atol=1e-12)


def test_truth_in_north_east_down(tmp_path: Path) -> None:
    C_ned_frd = np.array([[np.cos(0.3), -np.sin(0.3), 0], [np.sin(0.3), np.cos(0.3), 0], [0, 0, 1]])  # heading 0.3 rad
    q = quat_from_matrix(C_ned_frd)
    text = FLIGHT.replace('name = "uav"', 'name = "uav"\naxes = "FRD"') + TRUTH.replace('"xyzw"', '"xyzw"\nframe = "ned"')
    folder = write_flight(tmp_path, text)
    rows = np.column_stack([np.arange(5), np.tile([1.0, 2.0, -3.0, *q[[1, 2, 3, 0]]], (5, 1))])
    write_csv(folder / "truth.csv", "t,x,y,z,qx,qy,qz,qw", rows)
    truth = load(folder).problem.vehicles[0].truth
    assert truth is not None and truth.q_nb is not None
    np.testing.assert_allclose(truth.r_n[0], [2, 1, 3])
    np.testing.assert_allclose(matrix_from_quat(truth.q_nb[0]), matrix_from_euler(0, 0, 0.3), atol=1e-8)


def test_quaternions_from_wrong_columns_are_refused(tmp_path: Path) -> None:
    folder = write_flight(tmp_path, FLIGHT + TRUTH)
    write_csv(folder / "truth.csv", "t,x,y,z,qx,qy,qz,qw", np.tile(np.arange(8.0), (5, 1)) + np.arange(5)[:, None])
    assert "not of unit length" in _error(folder)


RANGES = """
[[vehicle]]
name = "cart"
heights = [{ constant_m = 1.5, interval_s = 0.5 }]

[[range]]
files = ["a.csv", "b.csv"]
time = "t"
scale = 0.001
tags = [
  { name = "1", vehicle = "uav", lever_b = [1, 0, 0] },
  { name = "2", vehicle = "cart" },
  { name = "A", position_m = [1, 2, 3] },
]
"""


def test_ranges_of_two_logs(tmp_path: Path) -> None:
    folder = write_flight(tmp_path, FLIGHT + RANGES)
    (folder / "a.csv").write_text("t,from_id,to_id,range\n3,1,2,5000\n1,1.0e+00,A,2500\n2,1,7,1000\n4,1,2,\n")
    (folder / "b.csv").write_text("t,from_id,to_id,range\n3,2,1,5000\n5,2,A,-1\n6,2,A,1500\n")
    flight = load(folder)
    stream = flight.problem.ranges[0].stream
    assert stream.t_s.tolist() == [1, 3, 6] and stream.range_m.tolist() == [2.5, 5.0, 1.5]
    assert [stream.tags[i].name for i in stream.tag_b] == ["A", "2", "A"]
    dropped = next(r for r in flight.reports if "a.csv" in r.source).dropped
    assert dropped == {
        "with empty or non-numeric cells": 1,
        "between tags that are not declared": 1,
        "not positive": 1,
        "logged twice": 1,
    }
    heights = flight.problem.vehicles[1].heights[0]
    assert heights.t_s[[0, -1]].tolist() == [3, 6] and len(heights.t_s) == 7 and set(heights.up_m) == {1.5}


def test_ranges_of_unknown_tags(tmp_path: Path) -> None:
    folder = write_flight(tmp_path, FLIGHT + RANGES)
    for name in ("a.csv", "b.csv"):
        (folder / name).write_text("t,from_id,to_id,range\n3,11,12,5000\n")
    assert "no range between declared tags (1, 2, A); the file has tags 11, 12" in _error(folder)
    (folder / "flight.toml").write_text(FLIGHT + RANGES.replace('vehicle = "cart"', 'vehicle = "kart"'))
    assert "no vehicle named kart; did you mean cart?" in _error(folder)


def test_heights_are_gated_and_thinned(tmp_path: Path) -> None:
    text = (
        FLIGHT
        + '[[vehicle.heights]]\nfile = "h.csv"\ntime = "t"\nheight = "h"\noffset_m = 0.1\nvalid_min = 0.3\nmin_interval_s = 1\n'
    )
    folder = write_flight(tmp_path, text)
    rows = np.column_stack([np.arange(40) * 0.1, np.where(np.arange(40) < 10, 0.2, 2.0)])
    write_csv(folder / "h.csv", "t,h", rows)
    flight = load(folder)
    heights = flight.problem.vehicles[0].heights[0]
    np.testing.assert_allclose(heights.t_s, [1, 2, 3])
    np.testing.assert_allclose(heights.up_m, 2.1)
    dropped = next(r for r in flight.reports if r.source == "h.csv").dropped
    assert dropped == {"outside valid_min and valid_max": 10, "thinned by min_interval_s": 27}


# recordings with GNSS

STATIC = """
[[vehicle]]
name = "base"
fixed = {{ ecef_m = [{x}, 3385704.533, 3667523.111] }}
gnss = {{ obs = "{base}", nav = "SEPT078M.21P" }}

[[vehicle]]
name = "rover"
gnss = {{ obs = "{rover}", nav = "SEPT078M.21P" }}

[[link]]
reference = "base"
rover = "rover"
"""
BASE, ROVER = "3034078M1.21O", "SEPT078M1.21O"


def _static(tmp_path: Path, text: str) -> tuple[Path, Path]:
    data = wheel_file("cssrlib", f"data/{BASE}").parent
    (tmp_path / "flight.toml").write_text(text)
    return tmp_path, data


def test_gnss_gives_time_and_place(tmp_path: Path) -> None:
    folder, data = _static(tmp_path, STATIC.format(x=-3959400.631, base=BASE, rover=ROVER))
    problem = load(folder, data).problem
    assert problem.t0 == GpsTime(2149, 475_200.0)
    np.testing.assert_allclose(problem.vehicles[0].fixed_n or (), 0.0, atol=1e-6)
    assert problem.vehicles[1].gnss is not None and len(problem.vehicles[1].gnss.stream.t_s) == 60


def test_a_base_a_kilometre_off_is_found(tmp_path: Path) -> None:
    folder, data = _static(tmp_path, STATIC.format(x=-3958400.631, base=BASE, rover=ROVER))
    with pytest.raises(InputError, match=r"base base: the declared position is (99\d|100\d) m from"):
        load(folder, data)


def test_a_base_a_hundred_metres_off_is_noted(tmp_path: Path) -> None:
    folder, data = _static(tmp_path, STATIC.format(x=-3959300.631, base=BASE, rover=ROVER))
    assert any("m from where its observations place it" in n for r in load(folder, data).reports for n in r.notes)


def test_swapped_base_and_rover_are_found(tmp_path: Path) -> None:
    folder, data = _static(tmp_path, STATIC.format(x=-3959400.631, base=ROVER, rover=BASE))
    with pytest.raises(InputError, match="those of rover fit: are the observation files swapped"):
        load(folder, data)


@pytest.mark.parametrize(
    ("old", "new", "telling"),
    [
        (', nav = "SEPT078M.21P"', "", "gnss.nav is needed"),
        (ROVER, ROVER.replace("SEPT", "SPET"), f"did you mean {ROVER}"),
        ('rover = "rover"', 'rover = "base2"', "no vehicle named base2; there are base, rover"),
        ("[[link]]", "[flight]\nend_s = -5\n[[link]]", "no epoch between"),
    ],
)
def test_errors_of_gnss_flights(tmp_path: Path, old: str, new: str, telling: str) -> None:
    folder, data = _static(tmp_path, STATIC.format(x=-3959400.631, base=BASE, rover=ROVER).replace(old, new))
    with pytest.raises(InputError) as error:
        load(folder, data)
    assert telling in str(error.value)


def test_receivers_that_share_nothing(tmp_path: Path) -> None:
    """A rover of which only GPS L1 is left and a base of which only Galileo is left."""
    folder, data = _static(
        tmp_path, STATIC.format(x=-3959400.631, base="base.21O", rover="rover.21O").replace('nav = "', 'nav = "x')
    )
    for source, name, system in ((BASE, "base.21O", "E"), (ROVER, "rover.21O", "G")):
        lines = (data / source).read_text().splitlines(keepends=True)
        kept = _only(lines, system)
        (tmp_path / name).write_text("".join(kept))
    (tmp_path / "xSEPT078M.21P").write_bytes((data / "SEPT078M.21P").read_bytes())
    with pytest.raises(InputError, match=r"link base-rover: no common satellite .*base has .*E band.*rover has .*G band"):
        load(folder)


def _only(lines: list[str], system: str) -> list[str]:
    """The first ten epochs of a RINEX 3 file with the satellites of one system."""
    end = next(i for i, line in enumerate(lines) if "END OF HEADER" in line) + 1
    out, epochs = lines[:end], 0
    i = end
    while i < len(lines) and epochs < 10:
        n = int(lines[i][32:35])
        kept = [line for line in lines[i + 1 : i + 1 + n] if line[0] == system]
        out += [lines[i][:32] + f"{len(kept):3d}" + lines[i][35:], *kept]
        i, epochs = i + 1 + n, epochs + 1
    return out


def test_levelled_accelerometers_agree_with_motion_capture() -> None:
    """At rest the specific force in the declared body axes points up as the reference attitude says, within a degree."""
    problem = load("miluv", shared_data("miluv_cirObstacles_3_random_0").parent).problem
    for vehicle in problem.vehicles:
        assert vehicle.imu is not None and vehicle.truth is not None and vehicle.truth.q_nb is not None
        rest = vehicle.imu.t_s < 5.0
        f = vehicle.imu.f_b[rest].mean(axis=0)
        up_b = matrix_from_quat(vehicle.truth.q_nb[50])[2]
        assert np.rad2deg(np.arccos(f @ up_b / np.linalg.norm(f))) < 1.0
