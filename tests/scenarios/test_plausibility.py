"""Flights whose sensors contradict each other: named at the command line, and nothing is said of sound ones.

A car and a quadcopter are simulated once; each test damages a copy of one.
"""

from __future__ import annotations

import dataclasses
import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from factorgraph.attitude import matrix_from_euler
from factorgraph.errors import InputError
from factorgraph.geodesy import LocalFrame
from factorgraph.gpstime import GpsTime
from factorgraph.measurements import ImuStream, PositionStream, RangeStream, Tag
from factorgraph.problem import NavigationProblem, Vehicle
from factorgraph.types import Array
from scenarios import guard, methods
from scenarios.flights import LoadedFlight, antennas, frozen, load
from scenarios.flights.catalogue import locate, names
from scenarios.flights.epochs import code_misfit_m, tag_error_s
from scenarios.flights.motion_match import Fixes, carry, steps_of, time_offset
from scenarios.flights.plausibility import examine, shift_hint
from scenarios.flights.schema import Imu
from scenarios.simulate import simulate
from scenarios.simulate.scenario import parse
from scenarios.simulate.write import write_flight
from tests.helpers import shared_data, wheel_file
from tests.scenarios.damage import Damage, Relnav, both, cells, content, key, later, one_error_line, rows, share

CAR = """
[scenario]
name = "car"
t0 = 2024-03-01T12:00:00
origin = { lat_deg = 45.0, lon_deg = 10.0, h_m = 20.0 }
duration_s = 160.0

[[vehicle]]
name = "base"
is_base = true
trajectory = { kind = "static", r_n = [300.0, 100.0, 2.0] }
gnss = {}

[[vehicle]]
name = "car"
imu = { rate_hz = 50.0 }
gnss = { lever_b = [0.0, -0.5, 0.8] }
positions = [{ sigma_m = [0.05, 0.05, 0.1] }]

[vehicle.trajectory]
kind = "manoeuvres"
attitude = "level"
start_n = [0.0, 0.0, 0.0]
heading_deg = 40.0
repeat = true
blend_s = 2.0
segments = [
    { duration_s = 6.0 },
    { duration_s = 7.0, accel_mps2 = 1.5 },
    { duration_s = 5.0, turn_dps = 14.0 },
    { duration_s = 8.0, turn_dps = -9.0 },
    { duration_s = 7.0, accel_mps2 = -1.5 },
]

[[range]]
rate_hz = 10.0
sigma_m = 0.05
tags = [{ name = "carried", vehicle = "car" }, { name = "anchor", position_m = [40.0, 60.0, 3.0] }]

[[link]]
reference = "base"
rover = "car"
"""
OBS, BASE_OBS, IMU, POSITIONS, RANGES, TRUTH = (
    "car.obs",
    "base.obs",
    "car-imu.csv",
    "car-position.csv",
    "uwb.csv",
    "car-truth.csv",
)
WEEK_S = 604_800.0
CYCLED = np.eye(3)[[1, 2, 0]]


@pytest.fixture(scope="session")
def sound_car(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_flight(simulate(parse(CAR), 1), tmp_path_factory.mktemp("car") / "flight").parent


@pytest.fixture
def car(sound_car: Path, tmp_path: Path) -> Path:
    """A copy to be damaged."""
    return Path(shutil.copytree(sound_car, tmp_path / "flight"))


def columns(file: str, change: Callable[[Array], Array], first: int = 1) -> Damage:
    """Changes the numbers of a table from a column on, all rows at once."""

    def rewrite(body: list[str]) -> list[str]:
        table = np.array([row.split(",") for row in body], float)
        table[:, first:] = change(table[:, first:])
        return [",".join(f"{x:.9g}" for x in row) for row in table]

    return rows(file, rewrite)


def imu(f: Array | None = None, w: Array | None = None) -> Damage:
    """Multiplies what the columns of the IMU (right, front, up) hold by matrices (3, 3)."""
    A, B = (np.eye(3) if x is None else x for x in (f, w))
    return columns(IMU, lambda x: np.hstack([x[:, :3] @ A.T, x[:, 3:6] @ B.T]))


def turned(heading_deg: float) -> Damage:
    C = matrix_from_euler(0.0, 0.0, np.radians(heading_deg))
    return imu(C, C)


def held(file: str, first_column: int, last_column: int, first: int, last: int) -> Damage:
    """Repeats the values of a row up to before another."""

    def change(body: list[str]) -> list[str]:
        split = [row.split(",") for row in body]
        for row in split[first:last]:
            row[first_column:last_column] = split[first][first_column:last_column]
        return [",".join(row) for row in split]

    return rows(file, change)


def frozen_receiver(text: bytes) -> bytes:
    """Epochs 60 to 69 with the observations of epoch 60."""
    head, *epochs = re.split(r"(?m)^(?=>)", text.decode())
    stuck = epochs[60].split("\n", 1)
    for k in range(61, 70):
        line = epochs[k].split("\n", 1)[0]
        epochs[k] = f"{line[:32]}{stuck[0][32:35]}{line[35:]}\n{stuck[1]}"
    return "".join([head, *epochs]).encode()


def utc_tags(text: bytes) -> bytes:
    """The time of every epoch 18 s earlier; the first epochs, which would be of the hour before, are left out."""

    def earlier(match: re.Match[bytes]) -> bytes:
        seconds = 60 * int(match[2]) + float(match[3]) - 18.0
        return match[1] + f"{int(seconds // 60):02d} {seconds % 60:10.7f}".encode()

    head, *epochs = re.split(rb"(?m)^(?=>)", text)
    return head + b"".join(re.sub(rb"^(> 2024 03 01 12 )(\d\d) ([ \d.]{10})", earlier, epoch) for epoch in epochs[18:])


WRONG: dict[str, tuple[Damage, tuple[str, ...]]] = {
    "IMU in UTC": (
        later(IMU, -18.0),
        ("car: the IMU's times are 1", "s earlier than those of position", "counts UTC", "offset_s = 1"),
    ),
    "IMU 18 s late": (later(IMU, 18.0), ("car: the IMU's times are 1", "s later than those of position", "counts UTC")),
    "IMU 5 s late": (later(IMU, 5.0), ("car: the IMU's times are", "s later")),
    "IMU of the next week": (later(IMU, WEEK_S), ("imu 604800 s earlier", "exactly one week", "week")),
    "IMU 1024 weeks early": (later(IMU, -1024 * WEEK_S), ("imu 619315200 s later", "exactly 1024 weeks")),
    "IMU an hour late": (later(IMU, 3600.0), ("imu 3600 s earlier", "1 h", "time zone")),
    "positions in UTC": (later(POSITIONS, -18.0), ("car: the IMU's times are 1", "later than those of position", "counts UTC")),
    "receiver in UTC": (content(OBS, utc_tags), ("car: its pseudoranges miss", "18 s later", "count UTC")),
    "base in UTC": (content(BASE_OBS, utc_tags), ("base: its pseudoranges miss", "18 s later", "count UTC")),
}


@pytest.mark.parametrize("case", WRONG)
def test_what_cannot_be_right_stops_with_one_line(case: str, car: Path, relnav: Relnav) -> None:
    damage, parts = WRONG[case]
    damage(car)
    checked = relnav("check", car)
    line = one_error_line(checked)
    assert all(part in line for part in parts), line
    assert "cannot be right" in checked.printed
    assert one_error_line(relnav("smooth", car)) == line


DOUBTFUL: dict[str, tuple[Damage, tuple[str, ...]]] = {
    "IMU 0.3 s late": (later(IMU, 0.3), ("the IMU's times are 0.", "s later than those of", "offset_s = -0.")),
    "truth 18 s early": (later(TRUTH, -18.0), ("the times of truth are 1", "s earlier", "counts UTC")),
    "gravity along the front": (
        imu(np.eye(3)[[1, 2, 0]], np.eye(3)[[1, 2, 0]]),
        ("gravity along F (", 'axes = "RFU"', "accel[1]"),
    ),
    "backward IMU": (turned(180.0), ("travels along its B axis", '"LBU" would fit')),
    "IMU a quarter turn off": (turned(90.0), ("travels along its", "would fit")),
    "yaw rate of the wrong sign": (imu(w=np.diag([1.0, 1.0, -1.0])), ("(gyro[0], gyro[1], -gyro[2])",)),
    "all rates of the wrong sign": (imu(w=-np.eye(3)), ("gyro",)),
    "left-handed accelerometer": (imu(f=np.diag([-1.0, 1.0, 1.0])), ("(-accel[0], accel[1], accel[2])",)),
    "rates in rad/s for deg/s": (key("gyro = [", 'gyro_unit = "deg/s"\ngyro = ['), ('gyro_unit = "rad/s"',)),
    "frozen axis": (held(IMU, 6, 7, 2000, 2600), ("axis 2 of the gyroscope repeats", "from 40.0 to 52.0 s")),
    "frozen IMU": (held(IMU, 1, 7, 2000, 2200), ("all six axes of the IMU repeat", "from 40.0 to 44.0 s")),
    "gyroscope of zeros": (imu(w=np.zeros((3, 3))), ("gyroscope reads exactly zero",)),
    "frozen position": (held(POSITIONS, 1, 4, 10, 30), ("position repeats one fix from 10.0 to 29.0 s", "jumps by")),
    "frozen receiver": (content(OBS, frozen_receiver), ("the receiver repeats its observations from 60.0 to 69.0 s",)),
    "frozen radio": (held(RANGES, 3, 4, 300, 420), ("the range carried to anchor repeats", "from 30.0 to 41.9 s")),
    "IMU that stops half way": (content(IMU, share(0.45)), ("imu ends at 7", "is its file complete?")),
    "receiver that stops half way": (content(OBS, share(0.45)), ("gnss ends at", "is its file complete?")),
}


@pytest.mark.parametrize("case", DOUBTFUL)
def test_what_is_doubtful_is_named(case: str, car: Path, relnav: Relnav) -> None:
    damage, parts = DOUBTFUL[case]
    damage(car)
    run = relnav("check", car, "--json")
    assert run.code == guard.DEGRADED, run.err
    found = [f"{row['of']}: {row['what']}" for row in json.loads(run.printed)["findings"]]
    assert any(all(part in text for part in parts) for text in found), found


def test_a_doubt_is_told_with_the_result(car: Path, relnav: Relnav) -> None:
    DOUBTFUL["frozen radio"][0](car)
    run = relnav("smooth", car)
    assert run.code == guard.DEGRADED
    assert any(line.startswith("relnav: degraded: uwb: the range carried to anchor repeats") for line in run.err), run.err
    assert any("repeats" in warning for warning in run.solution.diagnostics.warnings)


def test_an_error_after_a_doubt_names_it(car: Path, relnav: Relnav, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise InputError("no start")

    monkeypatch.setattr(methods, "solve", refuse)
    DOUBTFUL["frozen radio"][0](car)
    assert "no start; doubtful in the flight: uwb: the range" in one_error_line(relnav("smooth", car))


def test_sound_sensors_are_not_doubted_and_their_times_are_shown(sound_car: Path, relnav: Relnav) -> None:
    run = relnav("check", sound_car, "--json")
    assert (run.code, run.err) == (guard.DONE, [])
    tables = json.loads(run.printed)
    assert "findings" not in tables
    offsets = {(row["sensor"], row["against"]): row for row in tables["offsets"]}
    for pair in (("imu", "position"), ("imu", "gnss"), ("truth", "imu")):
        assert abs(offsets[pair]["late by s"]) < 3 * offsets[pair]["sigma s"] + 0.03


@pytest.mark.parametrize("seed", [11, 12])
@pytest.mark.parametrize("duration_s", [60.0, 180.0])
def test_other_seeds_and_durations_raise_no_alarm(seed: int, duration_s: float) -> None:
    text = CAR.replace("duration_s = 160.0", f"duration_s = {duration_s}")
    flight = simulate(parse(text), seed)
    found = examine(flight.problem, {"car": Imu(file="x")})
    assert [str(f) for f in found.findings] == []


RECORDINGS = {
    "kitti": ("gtsam", "Data/KittiGps_converted.txt"),
    "plaza1": ("gtsam", "Data/Plaza1_.mat"),
    "plaza2": ("gtsam", "Data/Plaza2_.mat"),
    "cssrlib-static": ("cssrlib", "data/SEPT078M1.21O"),
}


@pytest.mark.parametrize("name", names())
def test_no_recording_raises_an_alarm(name: str) -> None:
    if name in RECORDINGS:
        wheel_file(*RECORDINGS[name])
        flight = load(name)
    else:
        flight = load(name, shared_data())
    assert [str(f) for f in flight.examined.findings] == []


def _shifted(flight: LoadedFlight, shift_s: float) -> NavigationProblem:
    """The first vehicle's IMU with later times."""
    v = flight.problem.vehicles[0]
    assert v.imu is not None
    moved = dataclasses.replace(v, imu=dataclasses.replace(v.imu, t_s=v.imu.t_s + shift_s))
    others = tuple(moved if x is v else x for x in flight.problem.vehicles)
    return dataclasses.replace(flight.problem, vehicles=others)


@pytest.mark.parametrize("name", ["kitti", "rtklibexplorer-drive", "rtklibexplorer-walk"])
@pytest.mark.parametrize("shift_s", [-18.0, 0.4])
def test_shifted_recordings_are_found(name: str, shift_s: float) -> None:
    data = None
    if name in RECORDINGS:
        wheel_file(*RECORDINGS[name])
    else:
        data = shared_data()
    imus = {v.name: v.imu for v in locate(name, data).flight.vehicle if v.imu is not None}
    found = examine(_shifted(load(name, data), shift_s), imus)
    assert any(f.is_wrong == (shift_s < -1) and "the IMU's times are" in f.text for f in found.findings), found.findings
    offset = next(c.offset for c in found.offsets if c.sensor == "imu")
    assert offset.offset_s == pytest.approx(shift_s, abs=0.1)


# parts


def test_the_offset_of_exact_data_is_exact() -> None:
    """A turning, accelerating path and the IMU that flies it, without noise."""
    t = np.arange(0.0, 100.0, 0.01)
    heading = 0.8 * np.sin(0.21 * t) + 0.1 * t
    speed = 8.0 + 3.0 * np.sin(0.37 * t)
    rate, accel = 0.168 * np.cos(0.21 * t) + 0.1, 1.11 * np.cos(0.37 * t)
    imu = ImuStream(
        t,
        np.column_stack([speed * rate, accel, np.full(len(t), 9.8)]),
        np.column_stack([np.zeros(len(t)), np.zeros(len(t)), -rate]),
    )
    v = np.column_stack([speed * np.sin(heading), speed * np.cos(heading), np.zeros(len(t))])
    r = np.cumsum(v, axis=0) * 0.01
    for order, z in ((1, v), (2, r)):
        fixes = Fixes("fixes", order, t[5::100] - 0.7, z[5::100], 0.01)
        steps = steps_of(fixes, np.array([0.0, 0.0, -9.8]))
        offset = time_offset(steps, carry(imu, np.zeros(3)))
        assert offset is not None and offset.contrast > 0.9
        assert offset.offset_s == pytest.approx(0.7, abs=0.01)


@pytest.mark.parametrize(
    ("late_s", "words"),
    [
        (WEEK_S, "exactly one week"),
        (-2 * WEEK_S, "later, exactly 2 weeks"),
        (7200.0, "2 h"),
        (19800.0, "5.5 h"),
        (77.7, ""),
        (18.0, "leap seconds"),
    ],
)
def test_shifts_have_names(late_s: float, words: str) -> None:
    hint = shift_hint("imu", (10.0 + late_s, 20.0 + late_s), (9.0, 21.0))
    assert words in hint and bool(hint) == bool(words)


def test_tags_are_told_by_the_orbits(sound_car: Path) -> None:
    problem = load(sound_car).problem
    gnss = problem.vehicle("car").gnss
    assert gnss is not None
    stream = gnss.stream
    assert code_misfit_m(stream, problem.t0) < 10.0
    moved = dataclasses.replace(stream, sat_pos_ecef=stream.sat_pos_ecef + 17.0 * stream.sat_vel_ecef)
    assert tag_error_s(moved, problem.t0) == 17
    rng = np.random.default_rng(2)
    noise = dataclasses.replace(stream, code_m=stream.code_m + rng.normal(0.0, 1e5, len(stream.code_m)))
    assert tag_error_s(noise, problem.t0) is None


def _two_antennas(swapped: bool, crossed: bool = False) -> tuple[Vehicle, NavigationProblem]:
    t = np.arange(0.0, 120.0, 0.2)
    heading = 0.05 * t
    r = np.column_stack([np.cumsum(5 * np.sin(heading)), np.cumsum(5 * np.cos(heading)), 0 * t]) * 0.2
    forward = np.column_stack([np.sin(heading), np.cos(heading), 0 * t])
    rng = np.random.default_rng(4)
    front, back = (r + s * forward + rng.normal(0.0, 0.02, r.shape) for s in (1.0, -0.4))
    first, second = (back, front) if swapped else (front, back)
    sigma = np.full(r.shape, 0.02)
    levers = ((1.0, 0.0, 0.5), (-0.4, 0.0, 0.5)) if crossed else ((0.0, 1.0, 0.5), (0.0, -0.4, 0.5))
    v = Vehicle(
        "car",
        positions=(PositionStream(t, first, sigma, levers[0], "front"), PositionStream(t, second, sigma, levers[1], "back")),
    )
    return v, NavigationProblem("antennas", GpsTime(0, 0.0), LocalFrame(0.8, 0.2, 0.0), (v,))


def test_interchanged_antennas_are_named() -> None:
    assert list(antennas.doubts(*_two_antennas(False))) == []
    (text,) = antennas.doubts(*_two_antennas(True))
    assert "from front to back it is 1.40 m forward" in text and "interchanged" in text
    (text,) = antennas.doubts(*_two_antennas(False, True))
    assert "axes of lever_b" in text


def _resting_imu(step_f: float, step_w: float, noise: float, hz: float = 100.0) -> ImuStream:
    """A rest of 30 s and then a ride, as a coarse sensor shows them."""
    rng = np.random.default_rng(9)
    n = 6000
    f, w = rng.normal(0.0, noise, (n, 3)) + [0.0, 0.0, 9.81], rng.normal(0.0, noise / 10, (n, 3))
    f[3000:] += rng.normal(0.0, 1.0, (3000, 3))
    w[3000:] += rng.normal(0.0, 0.2, (3000, 3))
    return ImuStream(np.arange(n) / hz, np.round(f / step_f) * step_f, np.round(w / step_w) * step_w)


def test_coarse_and_slow_sensors_are_not_frozen() -> None:
    coarse = _resting_imu(0.3, 0.05, 0.02)
    assert np.mean(np.diff(coarse.f_b[:3000], axis=0) == 0) > 0.9
    assert list(frozen.imu(coarse, np.eye(3))) == []
    fine = _resting_imu(1e-3, 1e-4, 0.02)
    slow = np.arange(6000) // 10 * 10  # sampled at 10 Hz, logged at 100 Hz
    assert list(frozen.imu(ImuStream(fine.t_s, fine.f_b[slow], fine.w_b[slow]), np.eye(3))) == []
    level = np.tile([0.0, 0.0, 9.8], (6000, 1))
    yaw_only = np.column_stack([np.zeros(6000), np.zeros(6000), fine.w_b[:, 2]])
    assert list(frozen.imu(ImuStream(fine.t_s, level, yaw_only), np.eye(3))) == []
    tags = (Tag("a", position_n=(0.0, 0.0, 0.0)), Tag("b", position_n=(9.0, 0.0, 0.0)))
    rng = np.random.default_rng(1)
    zero, one = np.zeros(400, np.int64), np.ones(400, np.int64)
    decimetres = np.round(9.0 + rng.normal(0.0, 0.03, 400), 1)
    assert list(frozen.ranges(RangeStream(np.linspace(0.0, 39.9, 400), zero, one, tags, decimetres, np.full(400, 0.1)))) == []


def test_a_resting_receiver_that_holds_its_position_is_not_frozen() -> None:
    t = np.arange(100.0)
    r = np.zeros((100, 3))
    r[50:, 0] = 0.05 * np.arange(50) ** 2
    assert list(frozen.positions(PositionStream(t, r, np.full((100, 3), 0.5)))) == []


def test_dead_links_are_told(car: Path, tmp_path: Path, relnav: Relnav) -> None:
    (car / IMU).unlink()
    (car / IMU).symlink_to(tmp_path / "gone.csv")
    assert f"{IMU}: a link to {tmp_path / 'gone.csv'}, which is not there" in one_error_line(relnav("check", car))
    out = tmp_path / "results"
    out.symlink_to(tmp_path / "nowhere")
    assert "is a link to" in one_error_line(relnav("simulate", "two-uav", out))


def test_several_findings_are_listed_worst_first(car: Path, relnav: Relnav) -> None:
    both(later(IMU, 5.0), DOUBTFUL["frozen radio"][0], cells(POSITIONS, 3, "7.5", 40, 41))(car)
    run = relnav("check", car, "--json")
    assert "the IMU's times" in one_error_line(run)
    bad = [row["how bad"] for row in json.loads(run.printed)["findings"]]
    assert bad[0] == "cannot be right" and bad[-1] == "doubtful"
