"""Delimited text, MATLAB files, time columns, NMEA and RTKLIB solutions, broken lines included."""

from __future__ import annotations

import gzip
from pathlib import Path

import numpy as np
import pytest
from scipy.io import savemat

from factorgraph.errors import InputError
from factorgraph.geodesy import ecef_from_geodetic
from factorgraph.gpstime import GpsTime
from factorgraph.types import Array
from scenarios.flights.nmea import read_nmea
from scenarios.flights.rtklib_pos import read_pos
from scenarios.flights.schema import TextOptions, TimeColumn
from scenarios.flights.tables import RawTable, ordered, read_columns, read_times
from tests.helpers import shared_data


def _read(path: Path, content: str | bytes, numbers: list[str | int], **options: object) -> RawTable:
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return read_columns(path, TextOptions.model_validate(options), "csv", numbers)


def test_columns_by_name_and_number(tmp_path: Path) -> None:
    table = _read(tmp_path / "a.csv", "\ufeff t , x,y\r\n1,2,3\r\n4,,nan\r\n", ["t", 2, "x"])
    np.testing.assert_array_equal(table.stack(["t", "x", 2]), [[1, 2, 3], [4, np.nan, np.nan]])


def test_no_header_comments_blanks_and_a_cut_first_line(tmp_path: Path) -> None:
    text = "2.5 7\n# note\n  1.0   2.0\t3e0  \n4 5 6\n\n7 8 9\n"
    table = _read(tmp_path / "a.txt", text, [0, 2], delimiter="whitespace", header=False, comment="#")
    np.testing.assert_array_equal(table.stack([0, 2]), [[1, 3], [4, 6], [7, 9]])
    assert table.dropped == {"wrong number of cells": 1}


def test_cells_that_are_no_numbers_become_nan(tmp_path: Path) -> None:
    table = _read(tmp_path / "a.csv", "t,x\n1,2\n2,abc\nthree,4\n4,5\n", ["t", "x"])
    np.testing.assert_array_equal(table.stack(["t", "x"]), [[1, 2], [2, np.nan], [np.nan, 4], [4, 5]])


def test_gzip(tmp_path: Path) -> None:
    assert _read(tmp_path / "a.csv.gz", gzip.compress(b"t\n1\n2\n"), ["t"]).numbers["t"].tolist() == [1, 2]


@pytest.mark.parametrize(
    ("content", "columns", "options", "telling"),
    [
        ("time,accel_x\n1,2\n", ["acel_x"], {}, "no column acel_x; did you mean accel_x?"),
        ("1,2\n3,4\n", ["t"], {"header": False}, "column t is named, but the file is declared without a header"),
        ("1,2\n3,4\n", [2], {"header": False}, "no column 2; there are 2, counted from 0"),
        ("t;x\n1;2\n3;4\n", ["t"], {}, "no column t"),
        ("a b c\n1,2\n3,4\n", [0], {}, "most rows have 2; check delimiter"),
        ("", ["t"], {}, "the file is empty"),
        ("t,x\n", ["t"], {}, "no rows"),
        ("t,x\n1,2\n", ["t"], {"delimiter": "ab"}, "one character"),
    ],
)
def test_wrong_tables(tmp_path: Path, content: str, columns: list[str | int], options: dict[str, object], telling: str) -> None:
    with pytest.raises(InputError) as error:
        _read(tmp_path / "a.csv", content, columns, **options)
    assert telling in str(error.value) and "a.csv" in str(error.value)


def test_a_missing_file_names_its_neighbour(tmp_path: Path) -> None:
    (tmp_path / "imu_px4.csv").write_text("t\n1\n")
    with pytest.raises(InputError, match=r"no such file; did you mean imu_px4\.csv"):
        read_columns(tmp_path / "imu_px.csv", TextOptions(), "csv", ["t"])


def test_matlab_matrices(tmp_path: Path) -> None:
    path = tmp_path / "a.mat"
    savemat(path, {"GT": np.array([[1.0, 2.0], [3.0, 4.0]])})
    table = read_columns(path, TextOptions(variable="GT"), "mat", [1], [0])
    assert table.numbers[1].tolist() == [2, 4] and table.texts[0].tolist() == ["1", "3"]
    for variable, column, telling in (("GTT", 1, "did you mean GT"), ("GT", 2, "no column 2"), ("GT", "x", "number from 0")):
        with pytest.raises(InputError, match=telling):
            read_columns(path, TextOptions(variable=variable), "mat", [column])
    (tmp_path / "b.mat").write_bytes(b"not a matlab file at all, only text that is long enough" * 9)
    with pytest.raises(InputError, match="not a readable MATLAB file"):
        read_columns(tmp_path / "b.mat", TextOptions(variable="GT"), "mat", [0])


def _times(cells: list[float], **time: object) -> Array:
    column = TimeColumn.model_validate({"column": 0, **time})
    return read_times(RawTable(Path("x"), len(cells), {0: np.array(cells)}), column).since(GpsTime(2176, 282_600.0))


def test_time_columns_count_from_their_epochs() -> None:
    """2021-09-22 06:30:00 GPST is week 2176, 282600 s; UTC is 18 s behind."""
    unix_of_gpst = 315_964_800.0 + 2176 * 604_800.0 + 282_600.0
    np.testing.assert_allclose(_times([1000.0, 1500.0], unit="ms", offset_s=0.5), [1.5, 2.0])
    np.testing.assert_allclose(_times([282_601.25], epoch="sow"), [1.25])
    np.testing.assert_allclose(_times([2176 * 604_800.0 + 282_603.0], epoch="gps"), [3.0])
    np.testing.assert_allclose(_times([(unix_of_gpst + 2.5 - 18) * 1e6], epoch="unix", unit="us"), [2.5], atol=1e-6)
    np.testing.assert_allclose(_times([unix_of_gpst + 2.5], epoch="unix-gpst"), [2.5], atol=1e-6)


def test_seconds_of_week_cross_the_week() -> None:
    table = RawTable(Path("x"), 2, {0: np.array([604_799.0, 1.0])})
    times = read_times(table, TimeColumn(epoch="sow"))
    np.testing.assert_allclose(times.since(GpsTime(2176, 604_798.0)), [1.0, 3.0])


def test_calendar_times() -> None:
    texts = np.array(["2021-09-22T06:30:00.25", "2021/09/22 06:30:01", "soon", "2021-09-22T08:30:02+02:00"])
    table = RawTable(Path("x"), 4, {}, {0: texts})
    t0 = GpsTime(2176, 282_600.0)
    np.testing.assert_allclose(read_times(table, TimeColumn(epoch="iso-gpst")).since(t0), [0.25, 1.0, np.nan, 2.0])
    np.testing.assert_allclose(read_times(table, TimeColumn(epoch="iso-utc")).since(t0), [18.25, 19.0, np.nan, 20.0])
    with pytest.raises(InputError, match="not calendar dates"):
        read_times(RawTable(Path("x"), 1, {}, {0: np.array(["soon"])}), TimeColumn(epoch="iso-utc"))


def test_a_wrong_time_unit_is_told() -> None:
    with pytest.raises(InputError, match="unit of the time column"):
        _times([1.6e18], epoch="unix")


def test_rows_out_of_order_are_counted() -> None:
    t = np.array([0, 1, 1, 2, 9, 3, 4, np.nan, 2.5, 5])
    keep, dropped = ordered(t, np.zeros((10, 1)), "x")
    np.testing.assert_array_equal(t[keep], [0, 1, 2, 3, 4, 5])
    assert dropped == {"with empty or non-numeric cells": 1, "with a repeated time stamp": 1, "with a backward time stamp": 2}


def test_one_leap_ahead_does_not_swallow_what_follows() -> None:
    t = np.arange(100.0)
    t[10] = 1e6
    keep, dropped = ordered(t, np.zeros((100, 1)), "x")
    assert keep.sum() == 99 and dropped == {"with a backward time stamp": 1}


def test_mostly_backward_times_are_an_error() -> None:
    with pytest.raises(InputError, match="run backward"):
        ordered(np.arange(100.0)[::-1].copy(), np.zeros((100, 1)), "x")
    with pytest.raises(InputError, match="no usable row; 2 of 2"):
        ordered(np.arange(2.0), np.full((2, 1), np.nan), "x")


def _sentence(body: str) -> str:
    check = 0
    for character in body:
        check ^= ord(character)
    return f"${body}*{check:02X}\r\n"


GGA = "GPGGA,{},4717.11399,N,00833.91590,E,{},08,1.01,499.6,M,48.0,M,,"


def test_nmea_positions(tmp_path: Path) -> None:
    path = tmp_path / "log.nmea"
    good = _sentence(GGA.format("235959.00", 4))
    text = "garbage\r\n" + good + _sentence("GPRMC,235959.50,A,4717.11437,N,00833.91522,E,0.004,77.52,310821,,,A")
    text += _sentence(GGA.format("000000.50", 1)) + _sentence(GGA.format("000001.00", 0)) + good.replace("4717", "4718")
    path.write_text(text + "$GPGGA,00")
    fixes = read_nmea(path)
    np.testing.assert_allclose(fixes.times.since(GpsTime.from_calendar(2021, 8, 31, 23, 59, 59.0) + 18.0), [0.0, 1.5])
    np.testing.assert_allclose(fixes.llh_deg[0], [47 + 17.11399 / 60, 8 + 33.9159 / 60, 547.6])
    assert fixes.dropped["with a wrong checksum or unreadable"] >= 1 and fixes.dropped["without a fix"] == 1
    assert fixes.sigma_enu_m[0, 0] < 0.1 < 1.0 < fixes.sigma_enu_m[1, 0]


def test_nmea_without_a_date(tmp_path: Path) -> None:
    path = tmp_path / "log.nmea"
    path.write_text(_sentence(GGA.format("120000.00", 1)))
    with pytest.raises(InputError, match="has no date"):
        read_nmea(path)
    ref = read_nmea(path, "2021-08-31").times
    assert ref.since(GpsTime.from_calendar(2021, 8, 31, 12) + 18.0) == pytest.approx([0.0])
    with pytest.raises(InputError, match="YYYY-MM-DD"):
        read_nmea(path, "31.8.2021")
    path.write_text("$GPGGA,bad*00\r\n")
    with pytest.raises(InputError, match="no GGA sentence"):
        read_nmea(path)


POS_LLH = """% program   : x
%  GPST  latitude(deg) longitude(deg) height(m) Q ns sdn(m) sde(m) sdu(m) sdne(m) sdeu(m) sdun(m) age(s) ratio
2021/09/22 06:30:00.250   35.000000000  139.000000000  50.0000 1 12 0.0300 0.0200 0.0500 0.0100 -0.0100 0.0200 0.00 6.6
2021/09/22 06:30:xx       35.0
2021/09/22 06:30:01.250   35.000010000  139.000000000  50.0000 2 11 0.3000 0.2000 0.5000 0.0000  0.0000 0.0000 0.00 1.1
"""


def test_pos_geodetic(tmp_path: Path) -> None:
    path = tmp_path / "a.pos"
    path.write_text(POS_LLH)
    pos = read_pos(path)
    assert pos.kind == "llh" and pos.quality.tolist() == [1, 2] and pos.dropped == {"unreadable": 1}
    np.testing.assert_allclose(pos.times.since(GpsTime(2176, 282_600.0)), [0.25, 1.25])
    ecef = pos.ecef()
    assert ecef is not None
    np.testing.assert_allclose(ecef[0], ecef_from_geodetic(np.deg2rad(35.0), np.deg2rad(139.0), 50.0))
    np.testing.assert_allclose(pos.cov[0], [[4e-4, 1e-4, -1e-4], [1e-4, 9e-4, 4e-4], [-1e-4, 4e-4, 25e-4]])


def test_pos_in_utc_with_week_and_seconds_and_baselines(tmp_path: Path) -> None:
    path = tmp_path / "a.pos"
    titles = "%  UTC   e-baseline(m) n-baseline(m) u-baseline(m) Q ns"
    path.write_text(f"% ref pos   : 35.0 139.0 50.0\n{titles}\n2176 282582.000 1.0 2.0 3.0 1 9\n")
    pos = read_pos(path)
    assert pos.kind == "enu" and pos.times.since(GpsTime(2176, 282_600.0)) == pytest.approx([0.0])
    base = ecef_from_geodetic(np.deg2rad(35.0), np.deg2rad(139.0), 50.0)
    ecef = pos.ecef()
    assert ecef is not None and np.linalg.norm(ecef[0] - base) == pytest.approx(np.sqrt(14.0))
    assert np.isnan(pos.cov).any()


def test_what_is_no_pos(tmp_path: Path) -> None:
    path = tmp_path / "a.pos"
    for text, telling in (("1 2 3\n", "not an RTKLIB solution"), (POS_LLH.split("2021/")[0] + "junk\n", "no solution row")):
        path.write_text(text)
        with pytest.raises(InputError, match=telling):
            read_pos(path)


def test_pos_of_rtklib_itself() -> None:
    pos = read_pos(shared_data("reference/cssrlib_kin_rtklib_inst.pos"))
    assert pos.kind == "ecef" and len(pos.quality) > 350 and int(np.sum(pos.quality == 1)) == 327
    assert pos.reference_ecef is not None and pos.reference_ecef[0] == pytest.approx(-3959400.6443)
