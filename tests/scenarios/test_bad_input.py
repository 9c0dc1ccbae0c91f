"""Damaged flights at the command line: one clear line that names file or key, the right exit code, never a traceback.

Two short simulated flights are written once; each test damages a copy.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pytest

from factorgraph.solution import Solution
from scenarios import cli, guard
from scenarios.simulate import simulate
from scenarios.simulate.scenario import parse
from scenarios.simulate.write import write_flight
from tests.helpers import ROOT, interruptible
from tests.scenarios.damage import (
    TOML,
    Damage,
    Relnav,
    Run,
    both,
    cells,
    content,
    key,
    later,
    missing,
    one_error_line,
    rows,
    satellites,
    scaled,
    share,
    swap,
)

DURATION_S = 20.0
BASE_AND_ROVER = f"""
[scenario]
name = "base-and-rover"
t0 = 2024-03-01T12:00:00
origin = {{ lat_deg = 45.0, lon_deg = 10.0, h_m = 20.0 }}
duration_s = {DURATION_S}

[[vehicle]]
name = "base"
is_base = true
trajectory = {{ kind = "static", r_n = [0.0, 0.0, 2.0] }}
gnss = {{}}

[[vehicle]]
name = "rover"
imu = {{ rate_hz = 50.0 }}
gnss = {{ lever_b = [0.0, 0.5, 0.2] }}
heights = [{{ rate_hz = 5.0, sigma_m = 0.3 }}]
positions = [{{}}]

[vehicle.trajectory]
kind = "manoeuvres"
start_n = [300.0, 200.0, 2.0]
speed_mps = 12.0
segments = [{{ duration_s = {DURATION_S}, turn_dps = 6.0 }}]

[[range]]
rate_hz = 5.0
offset_s = 0.05
tags = [{{ name = "carried", vehicle = "rover" }}, {{ name = "anchor", position_m = [0.0, 0.0, 3.0] }}]

[[link]]
reference = "base"
rover = "rover"
"""
SWARM = """
[scenario]
name = "swarm"
origin = { lat_deg = 45.0, lon_deg = 10.0 }
duration_s = 8.0

[[vehicle]]
name = "one"
trajectory = { kind = "waypoints", points = [{ t_s = 0.0, r_n = [0, 0, 10] }, { t_s = 8.0, r_n = [6, 9, 12] }] }
imu = { rate_hz = 50.0 }

[[vehicle]]
name = "two"
trajectory = { kind = "waypoints", points = [{ t_s = 0.0, r_n = [20, 3, 15] }, { t_s = 8.0, r_n = [25, 1, 12] }] }

[[vehicle]]
name = "three"
trajectory = { kind = "waypoints", points = [{ t_s = 0.0, r_n = [5, 25, 8] }, { t_s = 8.0, r_n = [2, 30, 9] }] }

[[range]]
rate_hz = 1.0
tags = [{ name = "1", vehicle = "one" }, { name = "2", vehicle = "two" }, { name = "3", vehicle = "three" }]

[settings]
max_iterations = 12
"""
ROVER_OBS, BASE_OBS, NAV, IMU, RANGES = "rover.obs", "base.obs", "flight.nav", "rover-imu.csv", "uwb.csv"
POSITIONS, HEIGHTS, TRUTH = "rover-position.csv", "rover-height.csv", "rover-truth.csv"
FILES = (ROVER_OBS, BASE_OBS, NAV, IMU, RANGES, POSITIONS, HEIGHTS, TRUTH, TOML)
posix = pytest.mark.skipif(os.name != "posix", reason="signals and limits of POSIX")


@pytest.fixture(scope="session")
def sound(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A flight of a base and a rover with every kind of sensor."""
    return write_flight(simulate(parse(BASE_AND_ROVER), 1), tmp_path_factory.mktemp("sound") / "flight").parent


@pytest.fixture
def flight(sound: Path, tmp_path: Path) -> Path:
    """A copy to be damaged."""
    return Path(shutil.copytree(sound, tmp_path / "flight"))


def noise(seed: int, n: int = 3000) -> bytes:
    return np.random.default_rng(seed).bytes(n)


WRONG: dict[str, tuple[Damage, tuple[str, ...]]] = {
    **{f"empty {file}": (content(file, lambda _: b""), (file, "key is needed" if file == TOML else "empty")) for file in FILES},
    **{f"missing {file}": (missing(file), (file,)) for file in FILES},
    **{
        f"prose in {file}": (
            content(file, lambda _: b"Dear diary,\ntoday we drove\nround the field.\n"),
            (file, "not a RINEX file" if file in FILES[:3] else "line 1" if file == TOML else "no column t_s"),
        )
        for file in FILES
    },
    **{
        f"noise in {file}": (
            content(file, lambda _: noise(3)),
            (file, "not a RINEX file" if file in FILES[:3] else "not UTF-8" if file == TOML else "not a text file"),
        )
        for file in FILES
    },
    "RINEX cut in the header": (content(ROVER_OBS, lambda text: text[:400]), (f"{ROVER_OBS}, line 6", "inside the header")),
    "RINEX without epochs": (content(ROVER_OBS, lambda text: text[: text.index(b">")]), (ROVER_OBS, "no epoch")),
    "broken gzip": (content(ROVER_OBS, lambda _: b"\x1f\x8b" + noise(1)), (ROVER_OBS, "gzip")),
    "broken Unix compress": (content(ROVER_OBS, lambda _: b"\x1f\x9d\x90" + noise(1)), (ROVER_OBS, "decompressed")),
    "broken zip": (content(ROVER_OBS, lambda _: b"PK\x03\x04" + noise(1)), (ROVER_OBS, "decompressed")),
    "broken Hatanaka": (
        content(
            ROVER_OBS, lambda _: b"1.0                 COMPACT RINEX FORMAT                    CRINEX VERS   / TYPE\n" + noise(1)
        ),
        (ROVER_OBS, "decompressed"),
    ),
    "navigation for observations": (lambda f: shutil.copy(f / NAV, f / ROVER_OBS), (ROVER_OBS, "a navigation file", "expected")),
    "observations for navigation": (lambda f: shutil.copy(f / BASE_OBS, f / NAV), (NAV, "an observation file", "expected")),
    "no navigation file named": (key('nav = ["flight.nav"]', ""), (TOML, "gnss.nav is needed")),
    "navigation of another day": (
        content(NAV, lambda text: text.replace(b" 2024 03 01 ", b" 2023 03 01 ")),
        (BASE_OBS, "no message", "same day?"),
    ),
    "no pseudoranges": (
        content(ROVER_OBS, lambda text: re.sub(rb"(?m)^([GE]\d\d) *[\d.]+", rb"\1         0.000", text)),
        (ROVER_OBS, "pseudorange"),
    ),
    "swapped base and rover": (swap(BASE_OBS, ROVER_OBS), ("base base", "those of rover fit", "swapped?")),
    "base 1 km off": (key("local_m = [0.0", "local_m = [1000.0"), ("base base", "1000 m", "correct `fixed`")),
    "no common satellites": (
        both(satellites(BASE_OBS, "G"), satellites(ROVER_OBS, "E")),
        ("link base-rover", "no common satellite", "E band 1"),
    ),
    "three satellites": (satellites(ROVER_OBS, "G", 3), (ROVER_OBS, "at most 3 satellites", "needs 4")),
    "rover an hour later": (
        content(ROVER_OBS, lambda text: text.replace(b"> 2024 03 01 12", b"> 2024 03 01 13")),
        ("vehicle rover", "imu (0.0 to 20.0 s)", "gnss (3600.0 to 3620.0 s)", "do not overlap"),
    ),
    "base an hour later": (
        both(
            content(BASE_OBS, lambda text: text.replace(b"> 2024 03 01 12", b"> 2024 03 01 13")),
            later("base-truth.csv", 3600.0),
        ),
        ("link base-rover", "not on together"),
    ),
    "truth an hour later": (later(TRUTH, 3600.0), ("vehicle rover", "truth (3600.0", "offset_s")),
    "IMU of another time": (later(IMU, 5000.0), ("vehicle rover", "imu (5000.0", "offset_s")),
    "ranges of another time": (later(RANGES, 5000.0), ("vehicle rover", "ranges uwb (5000.", "offset_s")),
    "NaN in all of the IMU": (cells(IMU, 1, "nan"), (IMU, "1001 of 1001")),
    "NaN in all ranges": (cells(RANGES, 3, "nan"), (RANGES, "100 with empty or non-numeric cells")),
    "NaN in all positions": (cells(POSITIONS, 1, "nan"), (POSITIONS, "21 of 21")),
    "NaN in all times": (cells(HEIGHTS, 0, "nan"), (HEIGHTS, "101 of 101")),
    "infinite heights": (cells(HEIGHTS, 1, "-inf"), (HEIGHTS, "101 of 101")),
    "negative ranges": (cells(RANGES, 3, "-5.0"), (RANGES, "100 not positive")),
    "positions beyond the Earth": (cells(POSITIONS, 1, "1e12"), (POSITIONS, "km from the local origin", "frame")),
    "one IMU sample": (rows(IMU, lambda body: body[:1]), (IMU, "1 usable row", "two at least")),
    "IMU without rows": (rows(IMU, lambda body: []), (IMU, "no rows")),
    "IMU in g": (rows(IMU, lambda body: [scaled(row, 1, 4, 1 / 9.80665) for row in body]), (IMU, 'accel_unit = "g"')),
    "time runs backward": (rows(IMU, lambda body: body[::-1]), (IMU, "1000 of 1001 time stamps run backward")),
    "one time for all": (cells(POSITIONS, 0, "3.0"), (POSITIONS, "20 repeat")),
    "unknown key": (
        key("lever_b = [0.0, 0.5, 0.2]", "lever_arm = [0.0, 0.5, 0.2]"),
        (TOML, "vehicle[1].gnss", "did you mean lever_b?"),
    ),
    "value that is no number": (key("lever_b = [0.0, 0.5, 0.2]", "lever_b = [0.0, 0.5, nan]"), (TOML, "lever_b[2]", "finite")),
    "unknown vehicle": (key('reference = "base"', 'reference = "basis"'), (TOML, "no vehicle named basis", "base, rover")),
    "unknown column": (key('range.time]\ncolumn = "t_s"', 'range.time]\ncolumn = "time"'), (RANGES, "no column time", "t_s")),
    "unknown tag": (
        key('name = "carried"', 'name = "tag"'),
        (RANGES, "declared tags (tag, anchor)", "the file has tags carried"),
    ),
    "unknown table": (key("[[link]]", "[[links]]"), (TOML, "unknown key links; did you mean link?")),
}


@pytest.mark.parametrize("case", WRONG)
def test_wrong_input_is_one_line_that_names_it_and_2(case: str, flight: Path, relnav: Relnav) -> None:
    damage, parts = WRONG[case]
    damage(flight)
    smoothed, checked = relnav("smooth", flight), relnav("check", flight)
    line = one_error_line(smoothed)
    assert all(part in line for part in parts), line
    assert one_error_line(checked) == line
    assert not smoothed.out.exists()


# damage that leaves enough: what is dropped is told, the result has no warning

USABLE: dict[str, tuple[Damage, tuple[str, ...]]] = {
    "nothing": (lambda folder: None, ()),
    "rover's RINEX cut short": (content(ROVER_OBS, share(0.8)), (ROVER_OBS, "file cut short")),
    "base's RINEX cut short": (content(BASE_OBS, share(0.8)), (BASE_OBS, "file cut short")),
    "navigation cut short": (content(NAV, share(0.6)), (ROVER_OBS, "without satellite state")),
    "IMU cut short": (content(IMU, share(0.7)), ("rover: the IMU (0.0 to 1", "s are left out")),
    "ranges cut short": (content(RANGES, lambda text: text[:-30]), (RANGES, "1 wrong number of cells")),
    "three satellites for a while": (satellites(ROVER_OBS, "G", 3, 5, 9), ()),
    "no satellite for a while": (satellites(ROVER_OBS, "", 0, 8, 14), (ROVER_OBS, "6 epoch without a usable satellite")),
    "NaN in the IMU": (cells(IMU, 4, "nan", 100, 103), (IMU, "3 with empty or non-numeric cells")),
    "NaN in ranges": (cells(RANGES, 3, "nan", 10, 20), (RANGES, "10 with empty or non-numeric cells")),
    "NaN in positions": (cells(POSITIONS, 2, "nan", 3, 6), (POSITIONS, "3 with empty or non-numeric cells")),
    "infinite ranges": (cells(RANGES, 3, "inf", 10, 13), (RANGES, "3 with empty or non-numeric cells")),
    "absurd ranges": (cells(RANGES, 3, "1e12", 10, 13), ()),
    "absurd positions": (cells(POSITIONS, 1, "1e12", 3, 5), (POSITIONS, "2 farther than 1000 km")),
    "absurd forces": (cells(IMU, 3, "1e30", 100, 102), (IMU, "2 beyond what an IMU measures")),
    "absurd rates": (cells(IMU, 5, "1e9", 100, 103), (IMU, "3 beyond what an IMU measures")),
    "repeated IMU samples": (rows(IMU, lambda body: body[:100] + body[90:]), (IMU, "1 with a repeated", "9 with a backward")),
    "repeated position": (rows(POSITIONS, lambda body: body[:5] + body[4:]), (POSITIONS, "1 with a repeated time stamp")),
    "a time stamp ahead": (cells(POSITIONS, 0, "900", 7, 8), (POSITIONS, "1 with a backward time stamp")),
    "a last time stamp far ahead": (cells(HEIGHTS, 0, "1e9", 100), (HEIGHTS, "1 with a backward time stamp")),
    "repeated epoch": (
        content(ROVER_OBS, lambda text: text + b">" + text.split(b">")[1]),
        (ROVER_OBS, "1 epoch that repeats or goes back in time"),
    ),
    "an epoch far ahead": (
        content(ROVER_OBS, lambda text: text.replace(b"> 2024 03 01 12 00  7.", b"> 2024 03 09 12 00  7.")),
        (ROVER_OBS, "1 epoch with a time far from its neighbours'"),
    ),
    "a last epoch far ahead": (
        content(ROVER_OBS, lambda text: text.replace(b"> 2024 03 01 12 00 20.", b"> 2024 03 09 12 00 20.")),
        (ROVER_OBS, "1 epoch with a time far from its neighbours'"),
    ),
    "NUL bytes of a power failure": (rows(RANGES, lambda body: [*body[:50], "\0" * 60, *body[50:]]), (RANGES, "1 wrong number")),
    "text that is not UTF-8": (content(RANGES, lambda text: text + b"\xb0\xb0\xff,1\n"), (RANGES, "1 wrong number of cells")),
}


@pytest.mark.parametrize("case", USABLE)
def test_what_is_dropped_of_usable_input_is_told(case: str, flight: Path, relnav: Relnav) -> None:
    damage, parts = USABLE[case]
    damage(flight)
    run = relnav("smooth", flight)
    assert run.code == guard.DONE, run.err
    assert all(part in " ".join(run.err) for part in parts), run.err
    assert bool(run.err) == bool(parts)
    (pair,) = run.solution.pairs
    assert pair.truth_enu is not None
    error = np.linalg.norm(pair.baseline_enu - pair.truth_enu, axis=1)
    sigma = np.sqrt(np.trace(pair.P[:, :3, :3], axis1=1, axis2=2))
    assert np.all(error < 5 * sigma + 0.01)


DEGRADED: dict[str, tuple[Damage, tuple[str, ...]]] = {
    "almost no IMU": (
        rows(IMU, lambda body: body[:60]),
        ("18.8 s are left out", "degraded: base-rover: no usable carrier phase"),
    ),
    "almost no satellites": (satellites(ROVER_OBS, "G", 4), ("only 4 common satellites", "degraded: base-rover:")),
    "long IMU gap": (
        rows(IMU, lambda body: body[:301] + body[451:]),
        ("degraded: rover: no IMU samples from 6.00 to 9.02 s",),
    ),
    "NaN for long": (cells(IMU, 1, "nan", 301, 451), (f"{IMU}:", "degraded: rover: no IMU samples from 6.00 to 9.02 s")),
}


@pytest.mark.parametrize("case", DEGRADED)
def test_a_poor_result_is_written_with_its_reasons_and_1(case: str, flight: Path, relnav: Relnav) -> None:
    damage, parts = DEGRADED[case]
    damage(flight)
    run = relnav("smooth", flight)
    assert run.code == guard.DEGRADED, run.err
    assert all(part in " ".join(run.err) for part in parts), run.err
    assert np.all(np.isfinite(run.solution.pairs[0].baseline_enu))


def test_a_base_somewhat_off_is_doubted(flight: Path, relnav: Relnav) -> None:
    key("local_m = [0.0", "local_m = [100.0")(flight)
    run = relnav("check", flight, "--json")
    assert run.code == guard.DONE
    (note,) = (row["notes"] for row in json.loads(run.printed)["reading"] if row["source"] == "base")
    assert note == "the declared position is 100 m from where its observations place it"


@pytest.mark.parametrize("seed", range(6))
def test_random_damage_never_ends_in_a_traceback(seed: int, flight: Path, relnav: Relnav) -> None:
    rng = np.random.default_rng(seed)
    path = flight / FILES[seed % len(FILES)]
    text = bytearray(path.read_bytes())
    for place in rng.integers(len(text), size=rng.integers(1, 100)):
        text[place] = rng.integers(256) if seed % 2 else rng.integers(48, 58)
    path.write_bytes(text[: rng.integers(len(text))] if seed % 3 == 0 else text)
    run = relnav("smooth", flight)
    assert run.code in (guard.DONE, guard.DEGRADED, guard.FAILED)
    assert not any("Traceback" in line or "Warning" in line for line in run.err)
    assert sum(line.startswith("relnav: error: ") for line in run.err) == (run.code == guard.FAILED)


# IMU gaps and outages


def test_a_short_imu_gap_is_bridged_and_noted(flight: Path, relnav: Relnav) -> None:
    rows(IMU, lambda body: body[:310] + body[340:])(flight)
    run = relnav("smooth", flight)
    assert (run.code, run.err) == (guard.DONE, [])
    solution = run.solution
    notes = " ".join(solution.diagnostics.notes)
    assert "rover: no IMU samples from 6.18 to 6.80 s" in notes
    assert "rover: 8 measurements without IMU samples since the last state are left out" in notes
    rover, (pair,) = solution.vehicle("rover"), solution.pairs
    assert pair.truth_enu is not None
    error = np.linalg.norm(pair.baseline_enu - pair.truth_enu, axis=1)
    assert error.max() < 0.3
    sigma = np.sqrt(np.trace(rover.P[:, 6:9, 6:9], axis1=1, axis2=2))
    assert np.all(np.isfinite(sigma)) and np.degrees(sigma.max()) < 10.0  # attitude is found again on both sides


def test_motion_in_an_imu_gap_is_not_that_of_the_last_sample(flight: Path, relnav: Relnav) -> None:
    """The last sample before the gap is wrong; held for three seconds it would turn the rover by 300 degrees."""
    both(cells(IMU, 6, "-1.75", 300, 301), rows(IMU, lambda body: body[:301] + body[451:]))(flight)
    (pair,) = relnav("smooth", flight).solution.pairs
    assert pair.truth_enu is not None
    sigma = np.sqrt(np.trace(pair.P[:, :3, :3], axis1=1, axis2=2))
    assert np.all(np.linalg.norm(pair.baseline_enu - pair.truth_enu, axis=1) < 5 * sigma)


def test_a_long_gnss_outage_is_bridged_by_the_imu(flight: Path, relnav: Relnav) -> None:
    both(satellites(ROVER_OBS, "", 0, 6, 16), rows(POSITIONS, lambda body: body[:6] + body[16:]))(flight)
    run = relnav("smooth", flight)
    assert run.code == guard.DONE, run.err
    (pair,) = run.solution.pairs
    assert pair.truth_enu is not None
    sigma = np.sqrt(np.trace(pair.P[:, :3, :3], axis1=1, axis2=2))
    error = np.linalg.norm(pair.baseline_enu - pair.truth_enu, axis=1)
    assert np.all(error < 5 * sigma) and error.max() < 3.0


def test_vehicles_without_any_absolute_position_are_still_placed_relative_to_each_other(tmp_path: Path, relnav: Relnav) -> None:
    folder = write_flight(simulate(parse(SWARM), 1), tmp_path / "flight").parent
    run = relnav("smooth", folder)
    assert run.code in (guard.DONE, guard.DEGRADED)
    solution = run.solution
    assert "one, two, three: no absolute position is measured" in " ".join(solution.diagnostics.notes)
    for pair in solution.pairs:
        assert pair.truth_enu is not None
        estimated, true = (np.linalg.norm(x, axis=1) for x in (pair.baseline_enu, pair.truth_enu))
        assert np.abs(estimated - true).max() < 0.5


# results, disks, interrupts


def _files(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def test_earlier_results_survive_a_run_that_fails(flight: Path, relnav: Relnav) -> None:
    run = relnav("smooth", flight)
    before = _files(run.out)
    assert run.code == guard.DONE and before
    cells(IMU, 1, "nan")(flight)
    one_error_line(relnav("smooth", flight))
    assert _files(run.out) == before


def test_a_damaged_solution_is_one_line_and_2(flight: Path, relnav: Relnav) -> None:
    out = relnav("smooth", flight).out
    for path in sorted((out / "solution").iterdir()):
        whole = path.read_bytes()
        for damaged in (b"", noise(2), whole[: len(whole) // 2]):
            path.write_bytes(damaged)
            line = one_error_line(relnav("report", out))
            assert str(out / "solution") in line and "relnav smooth" in line
        path.write_bytes(whole)
    assert relnav("report", out).code == guard.DONE


def test_an_interrupt_while_writing_keeps_what_is_written(flight: Path, relnav: Relnav, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(solution: Solution, path: Path) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("scenarios.writers.write_all", interrupted)
    run = relnav("smooth", flight)
    assert run.code == guard.INTERRUPTED
    assert run.err == [f"relnav: stopped; results so far are in {run.out}"]
    assert relnav("report", run.out).code == guard.DONE


@pytest.mark.parametrize("command", ["smooth", "simulate"])
def test_a_file_in_place_of_the_output_folder_is_told(command: str, flight: Path, tmp_path: Path, relnav: Relnav) -> None:
    out = tmp_path / "out"
    out.write_text("mine", encoding="utf-8")
    run = relnav("smooth", flight) if command == "smooth" else relnav("simulate", "two-uav", out)
    assert f"{out} is a file" in one_error_line(run)
    assert out.read_text(encoding="utf-8") == "mine"


@pytest.mark.skipif(not Path("/proc/self").is_dir(), reason="a folder nobody may write in is needed, such as /proc")
def test_an_output_folder_that_refuses_files_is_told(relnav: Relnav) -> None:
    assert "/proc/self/flight" in one_error_line(relnav("simulate", "two-uav", "/proc/self/flight"))


def _process(argv: Iterable[object], cwd: Path, prefix: tuple[str, ...] = ()) -> subprocess.Popen[str]:
    command = interruptible([*prefix, sys.executable, "-m", "scenarios", *map(str, argv)])
    env = {**os.environ, "PYTHONPATH": str(ROOT)}
    return subprocess.Popen(
        command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, cwd=cwd, env=env, start_new_session=True
    )


@posix
def test_a_full_disk_leaves_earlier_results_and_no_half_flight(flight: Path, tmp_path: Path, relnav: Relnav) -> None:
    out = relnav("smooth", flight).out
    before = _files(out)
    scenario = tmp_path / "scenario.toml"
    scenario.write_text(BASE_AND_ROVER, encoding="utf-8")
    limited = ("sh", "-c", 'ulimit -f 16; exec "$@"', "sh")  # no file may become larger than 16 blocks
    for argv in (("smooth", flight, "--out", out), ("simulate", scenario, tmp_path / "simulated")):
        with _process(argv, tmp_path, limited) as process:
            err = process.communicate(timeout=60)[1]
        assert "File too large" in one_error_line(Run(process.returncode, err.splitlines(), "", out))
    assert _files(out) == before
    assert not (tmp_path / "simulated" / TOML).exists()


@posix
@pytest.mark.parametrize("after_s", [0.4, 1.2])
def test_ctrl_c_at_any_time_is_one_line_and_130(after_s: float, flight: Path, tmp_path: Path) -> None:
    with _process(("smooth", flight, "--out", tmp_path / "out"), tmp_path) as process:
        time.sleep(after_s)
        os.killpg(process.pid, signal.SIGINT)
        err = process.communicate(timeout=60)[1]
    assert process.returncode == guard.INTERRUPTED
    (line,) = err.splitlines()
    assert line.startswith("relnav: stopped")
    assert not (tmp_path / "out").exists()


def test_an_error_that_an_interrupt_caused_is_not_told_as_a_bug(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A native library that is interrupted while it loads ends with an ImportError of its own."""
    monkeypatch.setattr(guard, "is_stopping", lambda: True)
    monkeypatch.setattr(os, "_exit", sys.exit)
    with pytest.raises(SystemExit) as ended:
        cli._report_bug(ImportError, ImportError("initialization failed"), None)
    assert ended.value.code == guard.INTERRUPTED
    assert capsys.readouterr().err == "relnav: stopped\n"
