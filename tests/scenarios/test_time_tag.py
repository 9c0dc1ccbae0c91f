"""Counters of text recordings tied to GPST by RTKLIB's tag files."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest

from factorgraph.errors import InputError
from factorgraph.gpstime import GpsTime
from factorgraph.types import Array
from scenarios.flights.schema import TextOptions, TimeColumn
from scenarios.flights.tables import read_columns
from scenarios.flights.time_tag import read_tag, tagged_times
from tests.helpers import shared_data

OPENED = GpsTime(2374, 243_261.854)
RATE, START_MS = 1 + 2e-5, 261_906
OPTIONS = TextOptions(header=False)


def recording(folder: Path, n: int = 3000, line_end: str = "\r\n", written: str | None = None) -> tuple[Path, Array]:
    """A text recording with a counter in column 1 and its tag file; also the true times of its rows since the opening.

    Rows arrive in bursts, 1 to 15 ms after they were measured; `written`: line ends that the text on disk has.
    """
    rng = np.random.default_rng(11)
    true_s = np.asarray(0.146 + 0.01 * np.arange(n), float)
    counter = START_MS + np.round(1e3 * (true_s - true_s[0]) / RATE).astype(int)
    lines = [f"{0.1 * (i % 7):.3f},{ms}" for i, ms in enumerate(counter.tolist())]
    ends = np.cumsum([len(line) + len(line_end) for line in lines])
    last = np.sort(rng.choice(n, n // 3, replace=False))
    arrival_ms = np.maximum.accumulate(np.round(1e3 * true_s[last] + rng.uniform(1.0, 15.0, len(last)))).astype(int)
    path = folder / "imu.csv"
    path.write_bytes((written or line_end).join([*lines, ""]).encode())
    unix = int((OPENED - GpsTime(0, 0.0)) + 315_964_800)
    head = b"TIMETAG RTKLIB demo5".ljust(60, b"\0") + struct.pack("<IId", 1234, unix, 0.854)
    records = b"".join(struct.pack("<II", ms, int(ends[i])) for ms, i in zip(arrival_ms.tolist(), last.tolist(), strict=True))
    (folder / "imu.csv.tag").write_bytes(head + records)
    return path, true_s


def times_of(path: Path, time: TimeColumn) -> Array:
    return tagged_times(read_columns(path, OPTIONS, "csv", [1]), OPTIONS, time).since(OPENED)


@pytest.mark.parametrize("written", ["\r\n", "\n"], ids=["as logged", "carriage returns lost"])
def test_times_of_rows_follow_the_earliest_arrivals(tmp_path: Path, written: str) -> None:
    path, true_s = recording(tmp_path, written=written)
    t = times_of(path, TimeColumn(column=1, unit="ms", tag="imu.csv.tag"))
    late = t - true_s
    assert 0.0 < late.mean() < 0.003  # the shortest latency is 1 ms, the mean one 8 ms
    assert abs(np.polyfit(true_s, late, 1)[0]) < 5e-5


def test_an_offset_is_added(tmp_path: Path) -> None:
    path, _ = recording(tmp_path)
    plain = times_of(path, TimeColumn(column=1, unit="ms", tag="imu.csv.tag"))
    np.testing.assert_allclose(times_of(path, TimeColumn(column=1, unit="ms", tag="imu.csv.tag", offset_s=-0.26)), plain - 0.26)


def test_half_a_record_at_the_end_is_left_out(tmp_path: Path) -> None:
    path, _ = recording(tmp_path)
    tag = tmp_path / "imu.csv.tag"
    whole = read_tag(tag)
    tag.write_bytes(tag.read_bytes()[:-3])
    assert len(read_tag(tag).t_s) == len(whole.t_s) - 1
    assert abs(whole.opened - OPENED) < 1e-6
    assert times_of(path, TimeColumn(column=1, unit="ms", tag="imu.csv.tag")).size == 3000


def test_what_is_wrong_is_said(tmp_path: Path) -> None:
    path, _ = recording(tmp_path)
    with pytest.raises(InputError, match="times as fast"):
        times_of(path, TimeColumn(column=1, unit="us", tag="imu.csv.tag"))
    with pytest.raises(InputError, match="number from 0"):
        tagged_times(read_columns(path, OPTIONS, "csv", [1]), OPTIONS, TimeColumn(column="ms", tag="imu.csv.tag"))
    with pytest.raises(InputError, match="no such file"):
        times_of(path, TimeColumn(column=1, unit="ms", tag="other.tag"))
    (tmp_path / "imu.csv.tag").write_bytes(b"not a tag" * 20)
    with pytest.raises(InputError, match="not a time tag file"):
        times_of(path, TimeColumn(column=1, unit="ms", tag="imu.csv.tag"))


def test_the_tag_of_another_file_is_found_out(tmp_path: Path) -> None:
    path, _ = recording(tmp_path, n=200)
    (tmp_path / "short.csv").write_text("0.1,5\n0.2,6\n")
    with pytest.raises(InputError, match=r"point to \d lines of short\.csv"):
        times_of(tmp_path / "short.csv", TimeColumn(column=1, unit="ms", tag=path.name + ".tag"))


def test_both_recordings_have_a_steady_latency() -> None:
    for name in ("imu_1934.csv", "imu_1730.csv"):
        path = shared_data(f"gnss_imu_rtklibexplorer/{name}")
        table = read_columns(path, OPTIONS, "csv", [6])
        times = tagged_times(table, OPTIONS, TimeColumn(column=6, unit="ms", tag=f"{name}.tag"))
        rate = np.polyfit(table.numbers[6] * 1e-3, times.t_s, 1)[0]
        assert abs(rate - 1) < 5e-5
